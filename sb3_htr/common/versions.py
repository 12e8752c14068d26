"""What a result was made with."""

import platform
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch as th

from sb3_htr.common.digest import digest_of_code

# Of the code that runs, which may be on the path and not installed
VERSION = (Path(__file__).parents[1] / "version.txt").read_text().strip()
PACKAGES = ("stable_baselines3", "sb3_contrib", "gymnasium", "rl_zoo3", "torch", "numpy", "mujoco")
# Older runs and results do not say
UNKNOWN_HARDWARE = "a machine that was not recorded"


def versions() -> dict[str, str]:
    """
    :return: of Python, of this package and of the others that are installed
    """
    result = {"python": platform.python_version(), "sb3_htr": VERSION}
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
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
        for line in lines:  # no further than that of the first CPU: there may be hundreds
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def hardware(device: th.device | str) -> str:
    """
    :param device: torch device that computes
    :return: the processor, and the GPU, if it is one that computes
    """
    device = th.device(device)
    return processor() + (f", {th.cuda.get_device_name(device)}" if device.type == "cuda" else "")


def commit(*paths: str) -> dict[str, str | bool]:
    """
    :param paths: git's, of what counts as changed; all by default
    :return: ``commit`` of the code that runs, and whether its working tree was ``clean``; nothing outside a checkout
    """

    def git(*arguments: str) -> str:
        # Else git refreshes its index as it reads, and a commit that is made meanwhile finds it locked
        command = ["git", "--no-optional-locks", *arguments]
        # A path need not be text
        done = subprocess.run(command, capture_output=True, errors="replace", check=True, cwd=Path(__file__).parent)
        return done.stdout.strip()

    try:
        # An installed package may lie within a checkout of something else
        git("ls-files", "--error-unmatch", Path(__file__).name)
        changes = git("status", "--porcelain", "--untracked-files=no", "--", *paths)
        return {"commit": git("rev-parse", "--short=10", "HEAD"), "clean": not changes}
    except (OSError, subprocess.CalledProcessError):
        return {}


def named(code: Mapping[str, Any]) -> str:
    """
    :param code: ``commit`` and ``clean``, as of :func:`commit`; with ``resumed_by``, those of the code that went on as well
    :return: the commits, and whether they were changed
    """
    names = [
        f"{by.get('commit', 'unknown')}{'' if by.get('clean', True) else ' with changes'}"
        for by in (code, *code.get("resumed_by", ()))
    ]
    return ", then ".join(names)


def made_by() -> dict[str, Any]:
    """
    :return: for the record of a run: ``versions``; ``code``, the digest of that of this project; and ``commit`` and ``clean``
        within a checkout
    """
    return {"versions": versions(), "code": digest_of_code(("sb3_htr", "htr_envs")), **commit()}


def differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """
    :param before: as of :func:`made_by`
    :param now: the same, of other code or another run
    :return: what is not alike, as ``"torch 2.12.0 -> 2.13.0"``
    """
    old, new = ({**code.get("versions", {}), "commit": named({**code, "resumed_by": ()})} for code in (before, now))
    # Two working trees with changes have one name; older records have no digest
    if old["commit"] == new["commit"] and "code" in before and "code" in now:
        old["code"], new["code"] = (str(code["code"])[:10] for code in (before, now))
    return [
        f"{name} {old.get(name, 'unknown')} -> {new.get(name, 'none')}"
        for name in {**old, **new}
        if old.get(name) != new.get(name)
    ]
