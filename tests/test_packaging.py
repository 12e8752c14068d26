"""What is in the sdist and in the wheel that is built from it, tried from an empty folder."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from configparser import ConfigParser
from pathlib import Path

import pytest
import yaml

from helpers.runs import SMALL

ROOT = Path(__file__).parents[1]
BESIDE = ("CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "constraints.txt", "pyproject.toml", "README.md", "LICENSE")
SOURCES = ("sb3_htr", "htr_envs", "hyperparams", "trained_agents", "tests", "setup.cfg", "MANIFEST.in", *BESIDE)


def test_setup_cfg_lists_every_package() -> None:
    config = ConfigParser()
    config.read(ROOT / "setup.cfg")
    listed = set(config["options"]["packages"].split())
    found = {
        ".".join(init.parent.relative_to(ROOT).parts)
        for package in ("sb3_htr", "htr_envs")
        for init in (ROOT / package).rglob("__init__.py")
    }
    # These stay at the top of the repository and have no modules
    assert listed == found | {"sb3_htr.hyperparams", "sb3_htr.trained_agents"}


def test_one_version_is_told_everywhere() -> None:
    version = (ROOT / "sb3_htr" / "version.txt").read_text().strip()
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert (ROOT / "CHANGELOG.md").read_text().startswith(f"# Changelog\n\n## Release {version} ")


def test_what_is_cited_is_the_same_everywhere() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    titles = {reference["title"] for reference in citation["references"]}
    of_manual = re.findall(r"^  title +=(.*),$", (ROOT / "docs" / "index.md").read_text(), flags=re.MULTILINE)
    assert len(of_manual) == 2 and {re.sub("[{}]", "", title).strip() for title in of_manual} <= titles
    rivals = set(re.findall(r"https://arxiv.org/abs/[\d.]+", (ROOT / "docs" / "rivals.md").read_text()))
    # SAC and HER are those of Stable-Baselines3
    assert rivals - {reference["url"] for reference in citation["references"]} == {"https://arxiv.org/abs/1707.01495"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the wheel is unpacked."""
    source, dist, site = (tmp_path_factory.mktemp(name) for name in ("source", "dist", "site"))
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, source)
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(dist), str(source)]
    subprocess.run(build, check=True, capture_output=True)
    (sdist,) = dist.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert inside.issuperset(BESIDE) and not any(name.startswith("tests") for name in inside)
    (wheel,) = dist.glob("*.whl")
    with zipfile.ZipFile(wheel) as unpacked:
        unpacked.extractall(site)
    (about,) = site.glob("*.dist-info")
    assert {path.name for path in site.iterdir()} == {"sb3_htr", "htr_envs", about.name}
    assert "\nLicense-Expression: MIT\n" in (about / "METADATA").read_text() and (about / "licenses" / "LICENSE").exists()
    return site


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (["train", "--env", "SparseWheeled-v0", "-n", "480", "--eval-episodes", "2", "-params", *SMALL], "Log path"),
        (["enjoy", "--env", "SparsePointRobot-v0", "--n-episodes", "2", "--n-tasks", "1"], "htr-ser/SparsePointRobot-v0"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_the_wheel_works_from_an_empty_folder(site: Path, tmp_path: Path, command: list[str], says: str) -> None:
    """With its YAML files, its MuJoCo model and its trained agents; what it imports is checked not to be the checkout."""
    code = f"from sb3_htr.zoo import cli; assert cli.__file__.startswith({str(site)!r}); cli.console()"
    environment = {**os.environ, "PYTHONPATH": str(site)}
    run = subprocess.run(
        [sys.executable, "-c", code, *command], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0 and says in run.stdout, run.stdout + run.stderr
