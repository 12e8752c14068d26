"""
Adapts the agents in trained_agents/ to all test tasks and writes the table in its README.md: ``python tools/agents_table.py``.

Scores are kept in trained_agents/scores.json with the checksum of the file that they are of: only what is missing is measured.
"""

import json
from pathlib import Path
from typing import Any

from tables import fill

from sb3_htr.adaptation.evaluation import first_success, record_adaptation
from sb3_htr.common.atomic import atomic_path
from sb3_htr.common.digest import sha256
from sb3_htr.common.markdown import markdown_table
from sb3_htr.zoo.run.agents import agent_at
from sb3_htr.zoo.run.method import methods

AGENTS = Path(__file__).parents[1] / "trained_agents"
SCORES = AGENTS / "scores.json"
HEAD = ("file", "env steps", "explorer", "return of the 20th episode", "tasks solved in it", "episodes to the first success")
N_EPISODES = 20
# Beside an agent's own one: PEARL's protocol, with either prior
EXPLORERS = ("learned-prior", "prior")


def files() -> list[Path]:
    """
    :return: the agents, method by method
    """
    order = [*methods()]
    return sorted(AGENTS.glob("*/*.zip"), key=lambda path: (order.index(path.parent.name), path.name))


def measure(path: Path, known: dict[str, list[float]]) -> dict[str, list[float]]:
    """
    :param path: agent
    :param known: scores by explorers that need not be measured again
    :return: mean scores over all test tasks, by explorer
    """
    agent = agent_at(path)
    model = agent.load()
    scores = {}
    for explorer in dict.fromkeys((model.explorer.name, *EXPLORERS)):
        if explorer in known:
            scores[explorer] = known[explorer]
            continue
        print(f"Adapting {path.name} of {path.parent.name} by {explorer}")
        returns, successes, _ = record_adaptation(model, agent.make_vec_env(100), None, N_EPISODES, explorer)
        scores[explorer] = [
            float(returns[:, -1].mean()),
            float(successes[:, -1].mean()),
            float(first_success(successes).mean()),
        ]
    return scores


def read_scores() -> dict[str, dict[str, Any]]:
    """
    :return: checksum and scores of each file that has not changed since
    """
    known = json.loads(SCORES.read_text()) if SCORES.exists() else {}
    now = {str(path.relative_to(AGENTS)): sha256(path) for path in files()}
    return {name: row for name, row in known.items() if now.get(name) == row["sha256"]}


def table(scores: dict[str, dict[str, Any]]) -> str:
    """
    :param scores: of :func:`read_scores`
    :return: Markdown: a line for each agent and explorer, then the commands that made them
    """
    lines: list[list[str]] = []
    commands: list[str] = []
    for path in files():
        name, record = str(path.relative_to(AGENTS)), agent_at(path).record
        agent = [f"`{name}`", f"{record['num_timesteps']:,}"]
        measured = scores.get(name, {"explorers": {}})["explorers"]
        for explorer, (last, solved, first) in sorted(measured.items()):
            lines.append([*agent, f"`{explorer}`", f"{last:.2f}", f"{solved:.0%}", f"{first:.1f}"])
        if not measured:
            lines.append([*agent, "", "not measured by this version", "", ""])
        commands.append(record["command"])
    made = "Earlier code made them (targets of one step; its commit is not in the files), by"
    return f"{markdown_table(HEAD, lines)}\n\n{made}\n\n" + "".join(f"    {command}\n" for command in commands) + "\n"


def main() -> None:
    """Adapt the files that are new, and write scores and table."""
    scores = read_scores()
    for path in files():
        name = str(path.relative_to(AGENTS))
        known = scores.get(name, {"explorers": {}})["explorers"]
        scores[name] = {"sha256": sha256(path), "explorers": measure(path, known)}
    with atomic_path(SCORES) as temporary:
        temporary.write_text(json.dumps(scores, indent=1, sort_keys=True) + "\n")
    fill([AGENTS / "README.md"], {"agents": table(scores)})


if __name__ == "__main__":
    main()
