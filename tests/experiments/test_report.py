"""From raw results to tables and pictures. The runs are made up; what is said of them must be true."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tables
from matplotlib.figure import Figure

from helpers import ENV_ID
from helpers.results import made_up
from sb3_htr.common.checks import get_task_family
from sb3_htr.experiments import figures, protocol, report
from sb3_htr.experiments.grid import EXPERIMENTS, Experiment, Variant, by
from sb3_htr.experiments.protocol import METRICS
from sb3_htr.experiments.runner import LOGGED, hyperparams_of
from sb3_htr.experiments.table import table as as_markdown
from sb3_htr.zoo.run.method import methods


@pytest.fixture
def rough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are drawn, but once each, and without looking for the room that everything in them needs."""
    save = Figure.savefig

    def save_roughly(figure: Figure, path: Path, **_: Any) -> None:
        figure.set_layout_engine("none")
        save(figure, path, dpi=40)

    monkeypatch.setattr(Figure, "savefig", save_roughly)


def test_without_successes_no_picture_says_how_well_they_are_predicted(tmp_path: Path) -> None:
    (cell, path), *_ = made_up(EXPERIMENTS["point_maze"].cells(1), tmp_path).items()
    np.savez(path, **{**np.load(path), "calibration": np.zeros((10, 3))})
    figures.reliability({cell: path}, tmp_path / "reliability.png")
    assert not (tmp_path / "reliability.png").exists()


def test_what_reward_models_say_is_told_apart_without_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = list[Figure]()
    monkeypatch.setattr(figures, "finish", lambda figure, *_: drawn.append(figure))
    figures.reliability(made_up(EXPERIMENTS["goal_distance"].cells(1), tmp_path), tmp_path / "reliability.png")
    _, *lines = drawn[0].axes[0].lines  # the first is what a perfect model would say
    looks = [(line.get_marker(), line.get_linestyle()) for line in lines]
    assert len(looks) == len(set(looks)) > 10


@pytest.mark.parametrize("name", ["point_robot", "wheeled", "ablation", "goal_distance", "relabelling", "rivals"])
@pytest.mark.parametrize("chosen", [slice(-1, None), slice(1, None, 2)], ids=["the last run", "every other run"])
def test_what_is_finished_of_an_experiment_is_reported_alone(
    name: str, chosen: slice, rough: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    experiment = EXPERIMENTS[name]
    finished = experiment.cells(3)[chosen]
    report.write("command", experiment, made_up(finished, tmp_path), tmp_path / "results")
    summary = json.loads((tmp_path / "results" / "summary.json").read_text())
    rows = summary["rows"]
    # The first variant, also where its first run is not there yet
    order = [variant.name or variant.method for variant in experiment.variants]
    for env_kwargs in {str(cell.env_kwargs) for cell in finished}:
        first = min((cell.variant for cell in finished if str(cell.env_kwargs) == env_kwargs), key=order.index)
        others = [
            row for kind in ("differences", "slowdowns") for row in summary[kind] if str(row["env_kwargs"]) == env_kwargs
        ]
        assert {row["of"] for row in others} <= {first}
    runs = Counter((cell.variant, str(cell.env_kwargs)) for cell in finished)
    assert {(row["variant"], str(row["env_kwargs"])): row["n_seeds"] for row in rows} == runs
    assert (tmp_path / "results" / f"{experiment.name}.png").exists()


@pytest.mark.parametrize("name", ["point_robot", "rivals", "relabelling"])
def test_a_run_may_have_an_evaluation_more_than_others(name: str, rough: None, tmp_path: Path) -> None:
    """As where rollouts are longer than the time between two."""
    results = made_up(EXPERIMENTS[name].cells(2), tmp_path)
    for path in [*results.values()][: len(results) // 2]:
        raw = dict(np.load(path))
        longer = {key: np.concatenate([raw[key], raw[key][-1:]]) for key in ("timesteps", "curve", "solved", "elapsed_s")}
        np.savez(path, **{**raw, **longer})
    EXPERIMENTS[name].figure(results, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").exists()


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_reports_what_its_runs_did(
    name: str, rough: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment, folder = EXPERIMENTS[name], tmp_path / "results" / name
    cells = experiment.cells(3)
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    drawn, finish = dict[str, str](), figures.finish

    def noting(figure: Figure, path: Path, *about: Any) -> None:
        drawn[path.stem] = str([axes.get_legend_handles_labels()[1] for axes in figure.axes])
        finish(figure, path, *about)

    monkeypatch.setattr(figures, "finish", noting)
    report.write(f"sb3-htr experiment {name}", experiment, made_up(cells, tmp_path), folder)
    pictures = {name, *(draw.__name__ for draw in experiment.also)}
    assert {path.name for path in folder.glob("*.png")} == {f"{picture}.png" for picture in pictures}
    # Those of K are one line, and those of a single variant name its explorers
    named = [cell.variant for cell in cells if not cell.variant.startswith("K = ")]
    assert all(variant in text for variant in named for text in drawn.values())
    assert {*drawn} == pictures - ({name} if experiment.figure is figures.evaluations else set())
    for method in {cell.method for cell in cells}:
        raw, own = np.load(folder / f"raw-{method}.npz"), [cell for cell in cells if cell.method == method]
        assert {key.split("/")[0] for key in raw.files} == {cell.name for cell in own}
        assert all((raw[f"{cell.name}/returns_{cell.evaluations[0].name}"] == cell.seed).all() for cell in own)
    summary = json.loads((folder / "summary.json").read_text())
    value = {"last_episode_return": 2.0, "success_rate": 1.0, "episodes_to_first_success": 3.0}
    value |= {"env_steps_to_solved": 3000.0, "seconds_to_solved": 3.0}
    variants = {(cell.variant, str(cell.env_kwargs)): cell for cell in cells}
    for row in summary["rows"]:
        cell = variants[row["variant"], str(row["env_kwargs"])]
        # Elsewhere, all returns are larger by one
        elsewhere = row["metric"] == "last_episode_return" and bool(row["tested_on"])
        assert row["iqm"] == value[row["metric"]] + elsewhere and row["n_seeds"] == 3 and row["calibration_error"] == 0.25
        assert (row["method"], row["settings"], row["env_steps"]) == (cell.method, cell.settings, cell.n_timesteps)
        assert row["low"] <= row["iqm"] <= row["high"] and row["method"] in methods()
    # An agent without explorers is evaluated once in each place
    n_tests = sum(len(cell.evaluations) for cell in variants.values())
    # What is of the training is of one explorer
    assert len(summary["rows"]) == n_tests * 3 + len(variants) * 2
    of_training = [row for row in summary["rows"] if row["metric"] == "env_steps_to_solved"]
    for row in of_training:
        own = hyperparams_of(variants[row["variant"], str(row["env_kwargs"])]).get("explorer", "own")
        assert row["explorer"] == (own["name"] if isinstance(own, dict) else own) and not row["tested_on"]
    of_first = {env_kwargs: len(cell.evaluations) for (_, env_kwargs), cell in reversed(variants.items())}
    assert len(summary["differences"]) == n_tests - sum(of_first.values())
    assert all(difference["low"] <= 0 <= difference["high"] for difference in summary["differences"])
    assert len(summary["slowdowns"]) == len(variants) - len(of_first)
    assert all(slowdown["low"] == slowdown["iqm"] == slowdown["high"] == 1 for slowdown in summary["slowdowns"])
    assert {row["wall_s"] for row in summary["rows"]} == {4.0}
    for difference in summary["explorer_differences"]:
        assert difference["explorer"] != difference["of"] and difference["low"] == difference["iqm"] == difference["high"] == 0
    n_places = len({str(evaluation.tested_on) for evaluation in experiment.evaluations})
    assert len(summary["explorer_differences"]) == n_tests - len(variants) * n_places
    assert {difference["of"] for difference in summary["differences"]} <= {cells[0].variant}
    table = as_markdown(summary)
    at_home = sum(not evaluation.tested_on for cell in variants.values() for evaluation in cell.evaluations)
    assert table.count("| 1.00 [1.00, 1.00] | 3.00 [3.00, 3.00] |") == at_home
    assert "3 runs, **fewer than the 5 that a claim needs**" in table and "5 evaluation seeds" in table
    places = {str(evaluation.tested_on): evaluation.tested_on for evaluation in experiment.evaluations if evaluation.tested_on}
    for place in places.values():
        assert table.count(f"| goal distance {place['goal_distance']}: return, solved |") == 1
    assert table.count("], 1.00 |") == n_tests - at_home
    assert len({line.count("|") for line in table.splitlines() if line.startswith("|")}) == 1
    assert f"`sb3-htr experiment {name}`, commit abc, " in table
    uneven = [{**row, "n_seeds": 5 if row["variant"] == cells[0].variant else 1} for row in summary["rows"]]
    if len({cell.variant for cell in cells}) > 1:
        few = as_markdown({**summary, "rows": uneven})
        assert f"5 runs of {cells[0].variant}; 1 run of {cells[1].variant}" in few and few.count("fewer than the 5") == 1
    assert "fewer than the 5" in as_markdown({**summary, "rows": [{**summary["rows"][0], "n_seeds": n} for n in (1, 5)]})
    assert "commit abc, evaluated by def, " in as_markdown({**summary, "evaluation_commit": "def"})
    for methods_of in tables.HEADLINES.values():
        headline = tables.headline({name: summary}, methods_of, folder.parent).splitlines()[2:]
        shown = [cell for cell in variants.values() if cell.variant in methods_of.get(name, ())]
        assert len(headline) == len(shown)
        for line, cell in zip(headline, shown, strict=True):
            explorers = {e.explorer for e in cell.evaluations if not e.tested_on} & {"belief", "prior"}
            assert f"| {cell.n_timesteps:,} | 3 | {cell.variant} | " in line and line.count("| 2.0 [1.") == len(explorers)
            # Episodes 1, 2, 5 and 20, the third being the first that solves, and the worst run
            assert "| 0% | 0% | 100% | 100% [100%, 100%] | 100% |" in line
    endless = {**summary, "slowdowns": [{**row, "high": None, "at_least": True} for row in summary["slowdowns"]]}
    for methods_of in tables.COMPARED.values():
        others = methods_of.get(name, ())
        lines = tables.differences({name: summary}, {name: (*others, "not there")}).splitlines()[2:]
        for line, variant in zip(lines, others, strict=True):
            assert f"| `{variant}`, 3 runs | 0.0 [" in line
            assert line.endswith("| 1.0 [1.0, 1.0] |") != (name in tables.PASSED)
        n_timed = len(others) * (name not in tables.PASSED)
        assert tables.differences({name: endless}, {name: others}).count("| ≥ 1.0 [1.0, ∞) |") == n_timed


def test_differences_are_of_the_first_one_less_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Variant or explorer."""
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    results = made_up(EXPERIMENTS["held_out_sector"].cells(2), tmp_path)
    for cell, path in results.items():
        raw = dict(np.load(path))
        for evaluation in cell.evaluations:
            raw[f"returns_{evaluation.name}"] -= 3.0 * (cell.method == "pearl-dense") + (evaluation.explorer == "prior")
        np.savez(path, **raw)
    summary = report.summarize("", results)
    assert {row["iqm"] for row in summary["differences"]} == {3.0}
    explorers = {(row["explorer"], row["of"], row["iqm"]) for row in summary["explorer_differences"]}
    assert {explorer for explorer in explorers if explorer[2]} == {("prior", "belief", 1.0)}


def test_returns_at_a_distance_are_shares_of_the_optimum_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment, drawn = EXPERIMENTS["goal_distance"], list[tuple[np.ndarray, np.ndarray]]()
    monkeypatch.setattr(figures, "band", lambda axes, x, scores, *_: drawn.append((x, scores)))
    monkeypatch.setattr(figures, "finish", lambda *_: None)
    results = made_up(experiment.cells(2), tmp_path)
    for cell, path in results.items():
        raw, share = dict(np.load(path)), cell.env_kwargs["goal_distance"]
        raw["returns_belief"][:] = share * figures.optimal_return(**cell.env_kwargs)
        np.savez(path, **raw)
    figures.goal_distance(results, tmp_path / "picture.png")
    assert len(drawn) == 2 * len({cell.variant for cell in results})
    for x, shares in drawn[::2]:
        np.testing.assert_allclose(shares, np.broadcast_to(x, shares.shape), rtol=1e-5)


def test_agents_without_explorers_are_in_the_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    monkeypatch.setattr(figures, "finish", lambda figure, *_: drawn.extend(figure.axes[1].get_legend_handles_labels()[1]))
    figures.learning(made_up(EXPERIMENTS["rivals"].cells(1), tmp_path), tmp_path)
    assert {"htr-ser, belief", "htr-ser, prior", "rl2, own", "sac-her, own"} <= set(drawn)


def test_what_an_algorithm_does_not_tell_is_null(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NaN is no JSON."""
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    results = made_up(EXPERIMENTS["held_out_sector"].cells(1), tmp_path)
    for path in results.values():
        np.savez(path, **{**np.load(path), "calibration": np.zeros((10, 3)), LOGGED[0]: np.nan})
    summary = report.summarize("", results)
    assert all(row["calibration_error"] is None and row[LOGGED[0]] is None for row in summary["rows"])
    json.dumps(summary, allow_nan=False)


@pytest.mark.parametrize("damage", [b"", b"nothing that numpy knows", None])
def test_damaged_results_are_named(damage: bytes | None, tmp_path: Path) -> None:
    results = made_up(EXPERIMENTS["held_out_sector"].cells(1), tmp_path)
    path = list(results.values())[-1]
    path.write_bytes(path.read_bytes()[:1000] if damage is None else damage)
    with pytest.raises(ValueError, match=rf"{path.name} is damaged, or no npz file\. Remove it: the same command then"):
        report.check(results)


def test_runs_that_were_trained_by_another_file_of_settings_are_refused(tmp_path: Path) -> None:
    """All runs of a variant too, as those of another may be of today's."""
    results = made_up(EXPERIMENTS["held_out_sector"].cells(2), tmp_path)
    for cell, path in results.items():
        was = {"gamma": 0.5} if cell.variant == "pearl-dense" else {}
        np.savez(path, **{**np.load(path), "hyperparams": json.dumps({**hyperparams_of(cell), **was})})
    with pytest.raises(ValueError, match=r"pearl-dense.*\.npz was trained with other \['gamma'\] than .* has a YAML file"):
        report.check(results)


def test_a_variant_in_several_envs_is_several_curves(tmp_path: Path) -> None:
    variants = tuple(Variant("htr-ser", env_kwargs={"goal_distance": distance}) for distance in (0.3, 1.0))
    results = made_up(Experiment("two", "", "SparsePointRobot-v0", 100, variants, 2).cells(), tmp_path)
    groups = figures.by_variant(results)
    assert [*groups] == ["htr-ser {'goal_distance': 0.3}", "htr-ser {'goal_distance': 1.0}"]
    assert [len(runs) for runs in groups.values()] == [2, 2]
    with pytest.raises(ValueError, match="Several runs of three would be in the folder K_1-seed1: give the variants names"):
        Experiment("three", "", "SparsePointRobot-v0", 100, (Variant("htr-ser", "K>1"), Variant("htr-ser", "K<1"))).cells()


@pytest.mark.parametrize("lacking", ["solved", "cell", "hyperparams"])
def test_a_result_of_an_older_version_is_named_before_anything_is_written(lacking: str, tmp_path: Path) -> None:
    results = made_up(EXPERIMENTS["held_out_sector"].cells(1), tmp_path)
    path = list(results.values())[-1]
    np.savez(path, **{key: value for key, value in np.load(path).items() if key != lacking})
    message = rf"{path.name} lacks \['{lacking}'\], which held_out_sector needs: it may be of another version\. Remove it"
    with pytest.raises(ValueError, match=message):
        report.write("", EXPERIMENTS["held_out_sector"], results, tmp_path / "results")
    changed = {replace(cell, n_timesteps=7): path for cell, path in results.items()}
    with pytest.raises(ValueError, match=r"has n_timesteps 150000, but held_out_sector/.* needs 7: move it away"):
        report.write("", EXPERIMENTS["held_out_sector"], changed, tmp_path / "results")
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=EXPERIMENTS)
def test_the_grid_is_what_it_says(experiment: Any) -> None:
    cells = experiment.cells()
    assert len(cells) == experiment.seeds * len(experiment.variants)
    assert {cell.seed for cell in cells} == set(range(1, experiment.seeds + 1))
    for cell, variant in zip(cells, experiment.variants * experiment.seeds, strict=True):
        assert (cell.env_id, cell.method, cell.settings) == (experiment.env_id, variant.method, variant.settings)
        assert cell.n_timesteps == experiment.n_timesteps * variant.budget
    few = experiment.cells(1, 0.1)
    assert len(few) == len(experiment.variants)
    assert [10 * cell.n_timesteps for cell in few] == [cell.n_timesteps for cell in cells[: len(few)]]
    assert [10 * cell.eval_freq for cell in few] == [cell.eval_freq for cell in cells[: len(few)]]


def test_metrics() -> None:
    raw = {
        "timesteps": np.arange(1, 6) * 100,
        "elapsed_s": np.arange(1, 6) * 7.5,
        "curve": np.array([[1.0], [9], [8], [5], [7]]),
        "solved": np.array([[0], [0], [1], [0], [1]]),
        "returns_a": np.array([[[0.0, 9, 2], [3, 4, 5]]]),
        "successes_a": np.array([[[False, True, True], [False, False, False]]]),
    }
    values = {name: metric(raw, "a").tolist() for name, metric in METRICS.items()}
    assert values == {
        "last_episode_return": [[2, 5]],  # not the best
        "success_rate": [[1, 0]],
        "episodes_to_first_success": [[2, 4]],
        "env_steps_to_solved": [[300]],
        "seconds_to_solved": [[22.5]],
    }
    never = {name: METRICS[name]({**raw, "solved": np.zeros((5, 1))}, "a").item() for name in METRICS if "_to_solved" in name}
    assert never == {"env_steps_to_solved": 600, "seconds_to_solved": 45}


def test_optimal_return_is_that_of_the_env() -> None:
    assert figures.optimal_return(1.0, 20) == pytest.approx(13.38, abs=0.05)
    assert figures.optimal_return(2.0, 40) > figures.optimal_return(2.0, 30)


def test_tables_are_filled_in_between_their_marks_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- one -->\nold\n<!-- end -->\nbetween\n<!-- two -->\n<!-- end -->\n")
    for _ in range(2):
        tables.fill([page], {"one": "new\n", "two": "2\n", "three": "3\n"})
        assert page.read_text() == ("before\n<!-- one -->\nnew\n<!-- end -->\nbetween\n<!-- two -->\n2\n<!-- end -->\n")


def test_a_slow_learner_needs_times_the_env_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_htr.zoo.plots.intervals.REPS", 50)
    results = made_up(EXPERIMENTS["held_out_sector"].cells(2), tmp_path)
    known = "low", "high"
    for solved, factor, ends in (
        ([0, 20, 20, 20], 2 / 3, known),
        ([0, 0, 0, 15], 5 / 3, known[:1]),
        ([20] * 4, 1 / 3, known[1:]),
    ):
        for cell, path in results.items():
            if cell.method == "pearl-dense":
                np.savez(path, **{**np.load(path), "solved": np.arange(20) < np.array(solved)[:, None]})
        (slowdown,) = report.summarize("", results)["slowdowns"]
        assert slowdown["method"] == "pearl-dense" and slowdown["of"] == "htr-ser"
        assert slowdown["iqm"] == pytest.approx(factor, abs=1e-3), "never counts as one evaluation more than there were"
        shown = {end: slowdown[end] for end in known if slowdown[end] is not None}
        assert shown == {end: pytest.approx(factor, abs=1e-3) for end in ends}, "how much later or sooner it was is not known"
        assert (slowdown["n_unsolved"], slowdown["n_at_first"]) == (2 * (solved[-1] < 16), 2 * (solved[0] > 0))
        assert (slowdown["at_most"], slowdown["at_least"]) == ("low" not in ends, "high" not in ends)


def test_a_final_model_adapts_to_the_test_tasks_once_with_each_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of where it is tested, where that is elsewhere than in training."""
    asked: list[tuple[int, float]] = []

    def noting(model: Any, env: Any, tasks: Any = None, *, n_episodes: int, explorer: Any, seed: int) -> Any:
        assert tasks in (None, "test")
        asked.append((seed, float(np.linalg.norm(get_task_family(env).test_tasks[0]).round(3))))
        return np.zeros((env.num_envs, n_episodes)), np.zeros((env.num_envs, n_episodes), dtype=bool)

    monkeypatch.setattr(protocol, "evaluate_adaptation", noting)
    monkeypatch.setattr(protocol, "calibration", lambda *_: 0.0)
    variant = Variant("htr-ser", env_kwargs={"n_test_tasks": 4, "goal_distance": 1.5})
    evaluations = by(("prior",), {}, {"goal_distance": 2.0})
    (cell,) = Experiment("one", "", ENV_ID, 480, (variant,), 1, evaluations=evaluations).cells()
    arrays = protocol.evaluate(cell, None, None, lambda name, make: make())  # type: ignore[arg-type]
    assert asked == [(seed, distance) for distance in (1.5, 2.0) for seed in (1, 2, 3, 4, 5)]
    assert arrays["returns_prior"].shape == (5, 4, 20)
