"""The table of an experiment, from its ``summary.json``."""

from typing import Any

from sb3_htr.common.markdown import markdown_table
from sb3_htr.experiments.protocol import MIN_RUNS

COLUMNS = {
    "last_episode_return": "return of episode {n_episodes}",
    "success_rate": "tasks solved in it",
    "episodes_to_first_success": "episodes to the first success",
}


def columns(summary: dict[str, Any]) -> dict[str, str]:
    """
    :param summary: content of a ``summary.json``
    :return: metrics and heads of the columns of scores
    """
    n_episodes = summary["rows"][0]["n_episodes"]
    # A family that tells no successes has none
    has_successes = any(row["metric"] == "success_rate" and (row["high"] or row["iqm"]) > 0 for row in summary["rows"])
    shown = COLUMNS if has_successes else ("last_episode_return",)
    return {metric: COLUMNS[metric].format(n_episodes=n_episodes) for metric in shown}


def table(summary: dict[str, Any]) -> str:
    """
    :param summary: content of a ``summary.json``
    :return: Markdown table, one line per env argument, method and explorer; tasks unlike those of training have a column each
    """
    rows = summary["rows"]
    lines: dict[tuple[str, ...], dict[str, dict[str, dict[str, Any]]]] = {}
    settings = sorted({key for row in rows for key in row["env_kwargs"]})
    for row in rows:
        # Where a variant leaves an argument at its default, the cell is empty
        key = (*(str(row["env_kwargs"].get(setting, "")) for setting in settings), row["variant"], f"`{row['explorer']}`")
        lines.setdefault(key, {}).setdefault(place(row), {})[row["metric"]] = row
    settings = [setting.replace("_", " ") for setting in settings]
    shown = columns(summary)
    elsewhere = [where for where in dict.fromkeys(map(place, rows)) if where]
    head = [*settings, "method", "explorer", *shown.values(), *(f"{where}: return, solved" for where in elsewhere)]
    body = [
        [
            *key,
            *(_score(places.get("", {}), metric) for metric in shown),
            *(_both(places.get(where, {})) for where in elsewhere),
        ]
        for key, places in lines.items()
    ]
    env_steps = " / ".join(f"{n:,}" for n in sorted({row["env_steps"] for row in rows}))
    about = f"{rows[0]['env']}, {env_steps} env steps, {_runs(rows)}."
    later = summary["evaluation_commit"]
    fewest = min(row["n_seeds"] for row in rows)
    # Interquartile means of three runs trim none
    of_few = ["of three or fewer, their mean"] * (fewest <= 3) + ["of one, no interval"] * (fewest == 1)
    middle = f"IQM over runs ({'; '.join(of_few)})" if of_few else "IQM over runs"
    commits = summary["commit"] if later == summary["commit"] else f"{summary['commit']}, evaluated by {later}"
    return (
        f"{markdown_table(head, body)}\n\n{about} Final models on the test tasks: {middle}, "
        f"95 % bootstrap interval over runs, tasks and {summary['n_eval_seeds']} evaluation seeds. "
        f"`{summary['command']}`, commit {commits}, {summary['machine']}.\n"
    )


def _score(rows: dict[str, dict[str, Any]], metric: str) -> str:
    if metric not in rows:
        return ""
    return numbers(rows[metric], 2)


def _both(rows: dict[str, dict[str, Any]]) -> str:
    """Return with its interval, and tasks solved."""
    return f"{_score(rows, 'last_episode_return')}, {rows['success_rate']['iqm']:.2f}" if rows else ""


def _runs(rows: list[dict[str, Any]]) -> str:
    """How many there are, of which methods, and whether these are enough."""
    # In the env where there are fewest
    n_runs = {row["variant"]: row["n_seeds"] for row in sorted(rows, key=lambda row: -row["n_seeds"])}
    texts = []
    for n in sorted({*n_runs.values()}, reverse=True):
        few = f", **fewer than the {MIN_RUNS} that a claim needs**" if n < MIN_RUNS else ""
        of = ", ".join(variant for variant, m in n_runs.items() if m == n)
        texts.append(f"{n} run{'s' * (n > 1)}{f' of {of}' if len({*n_runs.values()}) > 1 else ''}{few}")
    return "; ".join(texts)


def place(row: dict[str, Any]) -> str:
    """
    :param row: of a ``summary.json``
    :return: what env a model was tested on, other than in training; empty if it was that
    """
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in row["tested_on"].items())


def numbers(row: dict[str, Any], digits: int) -> str:
    """
    :param row: of a ``summary.json``
    :param digits: after the point
    :return: IQM and interval, which a single run has not
    """
    # Adding 0 turns -0 into 0
    iqm, *ends = (f"{round(row[key], digits) + 0.0:.{digits}f}" for key in ("iqm", "low", "high") if row[key] is not None)
    return f"{iqm} [{', '.join(ends)}]" if len(ends) == 2 else iqm
