"""The command ``sb3-htr``."""

import difflib
import importlib
import os
import select
import sys
import sysconfig
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import gymnasium
import torch as th

import htr_envs
import sb3_htr
from sb3_htr.common.versions import versions
from sb3_htr.zoo.run.soft_interrupt import terminated_as_interrupted

COMMANDS = {
    "train": "meta-train an agent, with rl_zoo3's arguments and YAML files",
    "evaluate": "adapt an agent to unseen tasks: a table, two pictures and the data",
    "enjoy": "watch an agent adapt, task by task",
    "record": "film an agent that adapts, as mp4 or gif",
    "plot": "learning curves, adaptation curves, paths and the latent space, of one or several runs",
    "optimize": "search for hyperparameters with Optuna, by the return after adaptation",
    "experiment": "repeat one of the experiments of this project",
    "export": "a small file to share, with a model card; can upload both to the Hugging Face Hub",
    "load_from_hub": "download an agent from there",
}
# Experiments use the commands of the zoo, and not the other way round
MODULES = {name: f"sb3_htr.zoo.commands.{name}" for name in COMMANDS} | {"experiment": "sb3_htr.experiments.command"}
USAGE = (
    "usage: sb3-htr COMMAND [ARGUMENTS]; sb3-htr COMMAND --help explains the arguments, sb3-htr --version the versions.\n\n"
    + "\n".join(f"  {name:<13} {text}" for name, text in COMMANDS.items())
    + "\n\nTo begin with, an agent that comes with the package:\n\n  sb3-htr enjoy --env SparsePointRobot-v0"
)
# Packages that the base installation does not bring, and the extra that does
EXTRAS = {
    **dict.fromkeys(("rl_zoo3", "optuna", "sqlalchemy", "yaml", "huggingface_hub", "filelock", "sb3_contrib"), "zoo"),
    **dict.fromkeys(("matplotlib", "rliable", "pandas", "scipy", "seaborn", "requests", "fsspec"), "zoo"),
    "PIL": "video",
    "pygame": "video",
    "imageio_ffmpeg": "video",
    "mujoco": "mujoco",
    "gymnasium_robotics": "robotics",
    "panda_gym": "panda",
    "metaworld": "metaworld",
    "tensorboard": "tensorboard",
    "psycopg": "postgresql",
    "ray": "ray",
}
# What a user can put right, and has a sentence of its own: bad settings and files, missing packages, unknown envs, training
# that diverges
MISTAKES = (ValueError, OSError, ImportError, gymnasium.error.Error, FloatingPointError)


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: arguments, by default those of the process
    :return: exit status: 0, 1 if a package is missing, 2 for arguments that cannot be understood
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    if arguments and arguments[0] == "--version":
        print("\n".join(f"{name} {version}" for name, version in versions().items()))
        return 0
    if not arguments or arguments[0] not in COMMANDS:
        if arguments:
            nearest = difflib.get_close_matches(arguments[0], COMMANDS, n=1)
            meant = f", did you mean {nearest[0]}?" if nearest else "."
            print(f"sb3-htr has no command {arguments[0]!r}{meant}\n", file=sys.stderr)
        print(USAGE, file=sys.stderr)
        return 2
    command, *rest = arguments
    try:
        importlib.import_module(MODULES[command]).main(rest)
    except ModuleNotFoundError as error:
        package, *inside = (error.name or "").split(".")
        if package in rest:
            raise ImportError(f"The module {package} is not found: install it, or add its folder to PYTHONPATH.") from None
        if package not in EXTRAS:
            raise
        missing = f"{error.name}, which another version of {package} has" if inside else f"{package}, which is not installed"
        update = "--upgrade " if inside else ""
        print(f"sb3-htr {command} needs {missing}: pip install {update}'sb3_htr[{EXTRAS[package]}]'", file=sys.stderr)
        return 1
    return 0


def _nobody_reads() -> bool:
    """Whether who reads the output, as `head` does, has seen enough. Then nothing more is written at the end either."""
    try:
        sys.stdout.flush()
        closed = _is_closed(sys.stdout)
    except BrokenPipeError:
        closed = True
    if closed:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return closed


def _is_closed(stream: TextIO) -> bool:
    """Whether the reader of a pipe is gone; flushing does not reveal it where the stream has no buffer."""
    if not hasattr(select, "poll"):
        return False
    try:
        poll = select.poll()
        poll.register(stream, 0)
    except (OSError, ValueError):  # no file, as where output is captured
        return False
    return any(event & select.POLLERR for _, event in poll.poll(0))


def _where(error: Exception) -> str:
    """Where a user's own code failed: a bug in an env may show up after hours. Nothing for an error of ours."""
    while isinstance(error.__cause__, Exception):
        error = error.__cause__
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename.endswith(".py")]
    if isinstance(error, MISTAKES):
        frames = frames[-1:]
    own = [frame for frame in frames if _is_own(Path(frame.filename))]
    return "".join(f" ({frame.filename}, line {frame.lineno}, in {frame.name})" for frame in own[-1:])


def _is_own(file: Path) -> bool:
    ours = [Path(package.__file__ or "").parent for package in (sb3_htr, htr_envs)]
    installed = {"site-packages", "dist-packages"} & {*file.parts}
    return not installed and not any(map(file.is_relative_to, [*ours, Path(sysconfig.get_path("stdlib"))]))


def console() -> int:
    """
    :return: exit status of :func:`main`; 1 and a sentence, without the way to it, for an error; 130 after Ctrl-C
    """
    # Products are small: beside another process, an evaluation on two threads takes three times as long as on one
    if "OMP_NUM_THREADS" not in os.environ:
        th.set_num_threads(1)
    try:
        with terminated_as_interrupted():
            return main()
    except KeyboardInterrupt:
        print("sb3-htr: stopped", file=sys.stderr)
        return 130
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _nobody_reads():
            return 1
        if os.environ.get("SB3_HTR_TRACEBACK"):
            raise
        name = "" if isinstance(error, MISTAKES) else f"{type(error).__name__}: "
        print(
            f"sb3-htr: {name}{error}{_where(error)}\n(SB3_HTR_TRACEBACK=1 in the environment shows where this comes from)",
            file=sys.stderr,
        )
        return 1
    finally:
        _nobody_reads()


if __name__ == "__main__":
    sys.exit(console())
