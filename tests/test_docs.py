"""The Python of the manual and of the README runs, and so do the commands."""

import pkgutil
import re
import runpy
import shlex
import shutil
import subprocess
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

import agents_table
import benchmark_tables
import env_pages
import gymnasium as gym
import pytest
import state
import tables
from tables import filled

from helpers.pages import of_a_moment
from helpers.runs import SMALL
from sb3_htr.experiments import grid
from sb3_htr.htr.relabel import RELABELLERS
from sb3_htr.zoo.cli import main

ROOT = Path(__file__).parents[1]


def python_blocks(path: Path) -> str:
    """The blocks of a page, in order: later ones go on from earlier ones."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", path.read_text(), flags=re.MULTILINE | re.DOTALL))


MANUAL = sorted(page for folder in ("docs", "docs/results", "docs/api") for page in (ROOT / folder).glob("*.md"))
PAGES = [path for path in (ROOT / "README.md", *MANUAL) if python_blocks(path)]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
@pytest.mark.filterwarnings("ignore:No reward was found")
def test_the_code_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("results").symlink_to(ROOT / "results")  # a page reads what a checkout has
    monkeypatch.setattr(grid, "EXPERIMENTS", dict(grid.EXPERIMENTS))  # a page adds one
    monkeypatch.setitem(gym.spec("SparsePointRobot-v0").kwargs, "n_test_tasks", 20)  # in place of 100
    code = of_a_moment(python_blocks(page))
    (tmp_path / "page.py").write_text(code)
    with patch.dict(RELABELLERS):  # and another one registers one
        names = runpy.run_path("page.py", run_name="__main__")
    assert "model.learn(" not in code or names["model"]._n_updates > 0, "its training is so short that nothing is learnt"


def test_pages_can_be_read_where_they_are_not_built() -> None:
    """Blocks that only Sphinx understands are kept out of what is read on the web page of the repository."""
    for page in ROOT.glob("docs/**/*.md"):
        only_sphinx = {"eval-rst", "include"} & set(re.findall(r"^```\{([a-z-]+)\}", page.read_text(), flags=re.MULTILINE))
        assert not only_sphinx or page.parent.name == "api", page


def test_links_and_pictures_are_there() -> None:
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("trained_agents/*.md")):
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
            assert target.startswith("https://") or (page.parent / target).exists(), f"{page}: {target}"


def test_names_that_messages_and_docstrings_give_are_there() -> None:
    for file in (*ROOT.glob("sb3_htr/**/*.py"), *ROOT.glob("htr_envs/**/*.py")):
        for name in re.findall(r"(?<![\w/.-])(?:sb3_htr|htr_envs)(?:\.[A-Za-z_]\w*)+", file.read_text()):
            try:
                pkgutil.resolve_name(name)
            except (ImportError, AttributeError) as error:
                pytest.fail(f"{file} says {name}: {error}")


@pytest.mark.parametrize("page", env_pages.ENVS)
def test_pages_of_envs_say_what_the_docstrings_say(page: str) -> None:
    text = (env_pages.PAGES / f"{page}.md").read_text()
    assert text == filled(text, env_pages.tables(env_pages.ENVS[page])), "run python tools/env_pages.py"


def test_the_table_of_agents_is_that_of_the_files() -> None:
    text = (agents_table.AGENTS / "README.md").read_text()
    scores = agents_table.read_scores()
    assert text == filled(text, {"agents": agents_table.table(scores)}), "run python tools/agents_table.py"


def has_history() -> bool:
    """What an archive of the sources, and a checkout of the last commit alone, have not."""
    if shutil.which("git") is None:
        return False
    command = ["git", "rev-parse", "--is-shallow-repository", "--show-toplevel"]
    asked = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return asked.stdout.split() == ["false", str(ROOT.resolve())]


@pytest.mark.parametrize("tool", [tables, benchmark_tables, state], ids=lambda tool: tool.__name__)
def test_tables_are_those_of_the_results(tool: ModuleType) -> None:
    if tool is state and not has_history():
        pytest.skip("needs all of git's history")
    texts, contents = [document.read_text() for document in tool.DOCUMENTS], tool.tables()
    assert texts == [filled(text, contents) for text in texts], f"run python tools/{tool.__name__}.py"
    shown = {mark for text in texts for mark in re.findall(r"<!-- (\S+) -->\n", text)} - {"end"}
    assert contents.keys() <= shown, "a table that no page shows"


def test_the_tests_that_repeat_a_figure_are_there() -> None:
    commands = re.findall(r"`[^`]*\bpytest ([^`]+)`", "".join(page.read_text() for page in MANUAL))
    files = [word for command in commands for word in command.split() if word.startswith("tests/")]
    assert len(files) > 5 and all((ROOT / file).exists() for file in files), files


def test_a_new_family_takes_less_than_60_lines() -> None:
    assert len(python_blocks(ROOT / "docs" / "own_task_family.md").splitlines()) < 60


# Later arguments win, so these make each command of the manual a short one
SHORT = {
    "train": ["-n", "480", "--eval-freq", "480", "--eval-episodes", "2", "--verbose", "0", "-params", *SMALL],
    "optimize": [
        *["-n", "480", "--eval-episodes", "2", "--verbose", "0"],
        *["-params", *(setting for setting in SMALL if "policy_kwargs" not in setting)],
    ],
    "evaluate": ["--n-episodes", "2"],
    "enjoy": ["--n-episodes", "2"],
    "record": ["--n-episodes", "1"],
    "plot": ["--n-episodes", "2"],
    "export": ["--n-episodes", "2"],
}


def test_the_commands_run(
    quick: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A day of a user: the commands of the page, one after the other in an empty folder."""
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "cli.md").read_text()
    commands = [shlex.split(line)[1:] for line in re.findall(r"^\$ (sb3-htr .*)", text, flags=re.MULTILINE)]
    assert {command for command, *_ in commands} == SHORT.keys()
    for command, *arguments in commands:
        assert main([command, *arguments, *SHORT[command]]) == 0, arguments
    written = ("runs/htr-ser/SparsePointRobot-v0_1/adaptation_curve.png", "adaptation.gif", "pictures/learning_curves.png")
    for name in (*written, "plots/adaptation_paths.png", "study.db", "my_agent/README.md"):
        assert (tmp_path / name).stat().st_size > 1000, name
