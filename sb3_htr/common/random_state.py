"""The states of random generators: as plain data, and for a while another one."""

import json
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.common.settings import check_numbers

# The largest that all generators take
MAX_SEED = 2**32 - 1
# Parts of a model that draw, each apart from the others
STREAMS = ("replay", "relabelling", "rollouts", "bank")


def stream(seed: int | None, name: str) -> np.random.Generator:
    """
    :param seed: of a model
    :param name: one of :data:`STREAMS`
    :return: generator of this part, whose draws say nothing about those of other parts and of the envs
    """
    return np.random.default_rng(np.random.SeedSequence(seed).spawn(len(STREAMS))[STREAMS.index(name)])


def checked_seed(seed: int | np.integer[Any] | None) -> int | None:
    """
    :param seed: of a model
    :return: the same, as Python's own generator takes it
    :raises ValueError: if some generator does not take it
    """
    if seed is None:
        return None
    check_numbers(seed=(seed, 0, MAX_SEED))
    return int(seed)


def get_generator_state(generator: np.random.Generator) -> str:
    """
    :param generator: any
    :return: its state as JSON
    """
    return json.dumps(generator.bit_generator.state, default=lambda array: array.tolist())


def set_generator_state(generator: np.random.Generator, state: str) -> None:
    """
    :param generator: of the same kind as the one that the state is from
    :param state: of :func:`get_generator_state`
    """
    generator.bit_generator.state = json.loads(state)


def get_env_states(env: VecEnv) -> list[str]:
    """
    :param env: of gymnasium's envs
    :return: state of the generator of each
    :raises ValueError: for a generator of another kind than gymnasium's
    """
    generators = env.get_attr("np_random")
    for generator in generators:
        if not isinstance(generator, np.random.Generator):
            raise ValueError(
                f"The env's np_random is a {type(generator).__name__}, expected numpy's Generator, whose state is kept: "
                "leave it to gymnasium.Env.reset(seed=...), which makes one."
            )
    return [get_generator_state(generator) for generator in generators]


def set_env_states(env: VecEnv, states: list[str]) -> None:
    """
    :param env: of as many envs
    :param states: of :func:`get_env_states`
    """
    for i, (generator, state) in enumerate(zip(env.get_attr("np_random"), states, strict=True)):
        set_generator_state(generator, state)
        env.set_attr("np_random", generator, indices=i)


@contextmanager
def kept_env_states(env: VecEnv) -> Iterator[None]:
    """
    The generators of envs are afterwards as they were before, whatever is seeded and drawn within, unless it is interrupted.

    :param env: those of envs that have no generator of gymnasium's are left alone
    """
    generators = env.get_attr("np_random") if env.has_attr("np_random") else [None]
    states = get_env_states(env) if all(isinstance(each, np.random.Generator) for each in generators) else None
    try:
        yield
    except (EOFError, ConnectionError, KeyboardInterrupt):
        # The process of an env died, which has no state any more, or is amid an answer, which would be read as that to another
        states = None
        raise
    finally:
        if states is not None:
            set_env_states(env, states)


def get_global_state() -> dict[str, Any]:
    """
    :return: state of the global generators of python, numpy and torch
    """
    name, keys, position, has_gauss, cached = np.random.get_state(legacy=True)
    version, internal, gauss = random.getstate()
    return {
        "python": [version, list(internal), gauss],
        "numpy": [name, [int(key) for key in keys], position, has_gauss, cached],
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_initialized() else [],
    }


def set_global_state(state: dict[str, Any]) -> None:
    """
    :param state: of :func:`get_global_state`
    """
    version, internal, gauss = state["python"]
    random.setstate((version, tuple(internal), gauss))
    name, keys, position, has_gauss, cached = state["numpy"]
    np.random.set_state((name, np.array(keys, dtype=np.uint32), position, has_gauss, cached))
    th.set_rng_state(state["torch"].cpu())
    # The machine before may have had more of them
    for device, cuda in zip(range(th.cuda.device_count()), state["cuda"], strict=False):
        th.cuda.set_rng_state(cuda.cpu(), device)


@contextmanager
def seeded_actions(seed: int | tuple[int, ...], deterministic: bool) -> Iterator[None]:
    """
    Actions that are drawn within, by torch's global generator, are those of a seed; then the generator is as it was before.

    :param seed: of an evaluation, or of a part of it; other draws of it, as those of z, have generators of this very seed
    :param deterministic: whether none are drawn
    """
    # By default it starts all GPUs, also where the CPU computes
    gpus = range(th.cuda.device_count()) if th.cuda.is_initialized() else ()
    with th.random.fork_rng(gpus, enabled=not deterministic):
        if not deterministic:
            th.manual_seed(int(np.random.SeedSequence(seed).generate_state(1)[0]))
        yield
