"""What is put around the VecEnv of a training."""

import contextlib
import copy
import inspect
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_htr.common.errors import training_goes_on
from sb3_htr.common.random_state import checked_seed


class PatientResultsWriter(ResultsWriter):
    """Writes SB3's monitor file as long as that is possible: a disk that is full stops no training."""

    def write_row(self, epinfo: dict[str, float]) -> None:
        with training_goes_on(self.file_handler.name):
            super().write_row(epinfo)

    def close(self) -> None:
        with contextlib.suppress(OSError):  # what could not be written before
            super().close()


class CopiedWrapper(VecEnvWrapper):
    """
    A wrapper that can be deep-copied and pickled; SB3's cannot, because they pass on to the env within what ``copy`` asks of
    them, and keep what no pickle takes.
    """

    def __getstate__(self) -> dict[str, Any]:
        # Two monitors would write into one file
        left_out = ("class_attributes", "results_writer")
        return {name: None if name in left_out else value for name, value in vars(self).items()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, class_attributes=dict(inspect.getmembers(type(self))))

    def __deepcopy__(self, memo: dict[int, Any]) -> "CopiedWrapper":
        result = memo[id(self)] = type(self).__new__(type(self))
        result.__setstate__(copy.deepcopy(self.__getstate__(), memo))
        return result


class TaskVecMonitor(CopiedWrapper, VecMonitor):
    """SB3's monitor. A deep copy writes no file, and envs have seeds that no other run has."""

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """
        :param seed: see :func:`seed_envs`
        :return: seeds of all
        """
        return seed_envs(self.venv, seed)

    def step_wait(self) -> VecEnvStepReturn:
        try:
            return super().step_wait()
        except KeyError as missing:
            if missing.args[0] not in self.info_keywords:
                raise
            raise ValueError(
                f"The env's step returns no info[{missing}], though its task family tells successes: add it to the info."
            ) from None


class Float32VecEnv(CopiedWrapper):
    """
    Rounds observations to float32, in which all networks see them and the replay buffer keeps them.

    :param venv: its observations are of another type, as those of most MuJoCo envs
    """

    def __init__(self, venv: VecEnv) -> None:
        space = venv.observation_space
        assert isinstance(space, spaces.Box)
        with np.errstate(over="ignore"):  # the largest float64 becomes infinity, as it is meant
            low, high = (bound.astype(np.float32) for bound in (space.low, space.high))
        super().__init__(venv, spaces.Box(low, high, dtype=np.float32))

    def reset(self) -> VecEnvObs:
        return np.asarray(self.venv.reset(), dtype=np.float32)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = np.asarray(infos[i]["terminal_observation"], dtype=np.float32)
        return np.asarray(obs, dtype=np.float32), rewards, dones, infos


def in_float32(venv: VecEnv) -> VecEnv:
    """
    :param venv: any
    :return: the same where its observations are float32 already, or no numbers in a Box
    """
    space = venv.observation_space
    return Float32VecEnv(venv) if isinstance(space, spaces.Box) and space.dtype != np.float32 else venv


def seed_envs(env: VecEnv, seed: int | None) -> Sequence[int | None]:
    """
    Of SB3's envs, number i has the seed ``seed + i``, so that runs and evaluations of consecutive seeds would share all of
    them but one. Here only the first one has a seed that others could have, its own.

    :param env: VecEnv
    :param seed: of the first env
    :return: seeds of all
    :raises ValueError: if some generator does not take it
    """
    seed = checked_seed(seed)
    seeds = env.seed(seed)
    env.unwrapped._seeds = [seeds[0], *np.random.SeedSequence(seeds[0]).generate_state(env.num_envs)[1:].tolist()]
    return env.unwrapped._seeds
