"""What a result was made with."""

import platform
import subprocess
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("sb3_htr", "stable_baselines3", "sb3_contrib", "gymnasium", "rl_zoo3", "torch", "numpy", "mujoco")


def versions() -> dict[str, str]:
    """
    :return: of Python and of the packages that are installed
    """
    result = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            result[package] = version(package)
        except PackageNotFoundError:
            continue
    return result


def processor() -> str:
    """
    :return: name of the processor, as far as the system tells
    """
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def commit(*paths: str) -> dict[str, str | bool]:
    """
    :param paths: git's, of what counts as changed; all by default
    :return: ``commit`` of the code that runs, and whether its working tree was ``clean``; nothing outside a checkout
    """

    def git(*arguments: str) -> str:
        command = ["git", *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parent).stdout.strip()

    try:
        # An installed package may lie within a checkout of something else
        git("ls-files", "--error-unmatch", Path(__file__).name)
        changes = git("status", "--porcelain", "--untracked-files=no", "--", *paths)
        return {"commit": git("rev-parse", "--short=10", "HEAD"), "clean": not changes}
    except (OSError, subprocess.CalledProcessError):
        return {}


def named(code: Mapping[str, Any]) -> str:
    """
    :param code: ``commit`` and ``clean``, as of :func:`commit`
    :return: the commit, and whether it was changed
    """
    return f"{code.get('commit', 'unknown')}{'' if code.get('clean', True) else ' with changes'}"
