"""The Python of the manual and of the README runs."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def python_blocks(path: Path) -> str:
    """The blocks of a page, in order: later ones go on from earlier ones."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", path.read_text(), flags=re.MULTILINE | re.DOTALL))


PAGES = [path for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))) if python_blocks(path)]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
@pytest.mark.filterwarnings("ignore:No reward was found")
def test_the_code_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # The README trains for minutes; here it is for a moment
    code = python_blocks(page).replace("model.learn()", "model.learn(8000)")
    (tmp_path / f"page_{page.stem}.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module(f"page_{page.stem}")


def test_a_new_family_takes_less_than_60_lines() -> None:
    assert len(python_blocks(ROOT / "docs" / "own_task_family.md").splitlines()) < 60
