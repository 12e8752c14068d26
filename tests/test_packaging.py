"""Every package of the repository is in the wheel."""

from configparser import ConfigParser
from pathlib import Path

ROOT = Path(__file__).parents[1]


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
