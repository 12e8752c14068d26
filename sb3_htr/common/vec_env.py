"""Batched task envs for Stable-Baselines3."""

import importlib
import os
import re
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from itertools import count
from multiprocessing import active_children
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_htr.common.checks import check_has_task_family, check_tasks, get_task_family, tells_rewards
from sb3_htr.common.settings import check_numbers
from sb3_htr.common.type_aliases import TaskFamily
from sb3_htr.common.vec_wrappers import PatientResultsWriter, TaskVecMonitor

# Side by side, where nobody says how many
N_ENVS = 20
# Attributes of a single task env, and where a batched one keeps those of all envs
PER_ENV = {"task": "tasks", "task_id": "task_ids"}
# And what else a batched one has by another name: its own spaces are those of all envs together
NAMES = {**PER_ENV, "action_space": "single_action_space", "observation_space": "single_observation_space"}


class BatchedTaskVecEnv(VecEnv):
    """
    Presents a natively batched gymnasium ``VectorEnv`` of a task family as SB3 ``VecEnv``.

    Tasks are set as in any VecEnv: ``set_options([{"task_id": i}, ...])`` (or ``{"task": vector}``), then ``reset()``.

    :param vector_env: env with SAME_STEP autoreset (SB3 resets within the step that ends the episode)
    """

    def __init__(self, vector_env: VectorEnv) -> None:
        mode = vector_env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"The vector env's autoreset_mode is {mode}, expected AutoresetMode.SAME_STEP.")
        self.vector_env = vector_env
        super().__init__(vector_env.num_envs, vector_env.single_observation_space, vector_env.single_action_space)

    def reset(self) -> VecEnvObs:
        given = self._options
        # Before any of them is refused, so that the next reset does not meet them again
        self._reset_options()
        # A batch has one random generator, so the first env's seed is the batch's
        obs, info = self.vector_env.reset(seed=self._seeds[0], options=self._batch_options(given))
        self.reset_infos = self._split(info)
        self._reset_seeds()
        return obs.copy()  # an env may write into the same array at each step, and this one is kept

    def _batch_options(self, given: list[dict[str, Any]]) -> dict[str, Any] | None:
        keys = {key for options in given for key in options}
        if not keys:
            return None
        if any(options.keys() != keys for options in given):
            raise ValueError(f"Envs of one batch need options with the same keys, got {sorted(keys)} in some of them only.")
        return {key: np.array([options[key] for options in given]) for key in keys}

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, terminated, truncated, info = self.vector_env.step(self._actions)
        dones = terminated | truncated
        final_obs = info.pop("final_obs")
        info.pop("_final_obs", None)
        infos = self._split(info)
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = final_obs[i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
            self.reset_infos[i] = {"task_id": int(self.vector_env.task_ids[i])}  # type: ignore[attr-defined]
        return obs.copy(), rewards, dones, infos  # as in reset

    def _split(self, info: dict[str, Any]) -> list[dict[str, Any]]:
        columns = [value.tolist() if value.ndim == 1 else list(value) for value in info.values()]
        return [dict(zip(info, values, strict=True)) for values in zip(*columns, strict=True)]

    def close(self) -> None:
        self.vector_env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        value = getattr(self.vector_env, NAMES.get(attr_name, attr_name))
        return [value[i] if attr_name in PER_ENV else value for i in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        return hasattr(self.vector_env, NAMES.get(attr_name, attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        if attr_name in PER_ENV:
            raise ValueError(f"A batch takes no {attr_name}: call set_options, with {attr_name!r} for each env, and reset.")
        # For all, as they share what they are made of, a generator too
        if attr_name != "np_random":
            self._check_is_for_all(indices)
        setattr(self.vector_env, NAMES.get(attr_name, attr_name), value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        self._check_is_for_all(indices)
        method = self._set_task if method_name == "set_task" else getattr(self.vector_env, method_name)
        return [method(*args, **kwargs)] * self.num_envs

    def _set_task(self, task: Any) -> None:
        # A batch would take a vector for an index of each env
        cast(Any, self.vector_env).set_task(np.tile(task, (self.num_envs, 1)) if np.ndim(task) == 1 else task)

    def _check_is_for_all(self, indices: VecEnvIndices) -> None:
        if len(list(self._get_indices(indices))) < self.num_envs:
            raise ValueError(
                "One call serves the whole batch of envs, not some of them: leave indices out, or make the envs one by one, "
                "with vec_env_class=DummyVecEnv."
            )

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [None] * self.num_envs


def reset_to_tasks(env: VecEnv, tasks: np.ndarray) -> np.ndarray:
    """
    :param env: env of a task family
    :param tasks: (n_envs, task_dim)
    :return: (n_envs, obs_dim), first observations of episodes of these tasks
    :raises ValueError: if an env is on another task afterwards
    """
    env.set_options([{"task": task} for task in tasks])
    obs = env.reset()
    check_tasks(env, tasks)
    assert isinstance(obs, np.ndarray)
    return obs


def set_tasks(env: VecEnv, task_ids: np.ndarray | None, indices: np.ndarray) -> None:
    """
    Choose the tasks of some envs from their next resets on.

    :param env: env of a task family
    :param task_ids: (n,) int, indices into the training tasks, or None to let the envs draw one at each reset
    :param indices: (n,) int, which envs are meant
    """
    if isinstance(env.unwrapped, BatchedTaskVecEnv):
        cast(Any, env.unwrapped.vector_env).set_task(task_ids, indices)
    else:
        for i, index in enumerate(indices):
            env.env_method("set_task", None if task_ids is None else int(task_ids[i]), indices=int(index))


def make_task_vec_env(
    env_id: str,
    n_envs: int = 1,
    seed: int | None = None,
    monitor_dir: str | None = None,
    env_kwargs: dict[str, Any] | None = None,
    wrapper: Callable[[gym.Env], gym.Env] | None = None,
    vec_env_class: type[DummyVecEnv | SubprocVecEnv] | None = None,
) -> VecEnv:
    """
    Make ``n_envs`` copies of a registered task env: natively batched where its registration offers that, else one by one.

    :param env_id: a registered id; ``"module:id"`` imports the module first
    :param n_envs: number of envs stepped together
    :param seed: seed of the envs' own randomness
    :param monitor_dir: folder for the CSV of episode returns, beside those that are there; none by default
    :param env_kwargs: arguments of the env
    :param wrapper: of each single env
    :param vec_env_class: of single envs; by default they are natively batched if they can be, else in this process
    :return: a monitored VecEnv
    :raises ValueError: for an env without tasks, no envs, or what is no id
    :raises gymnasium.error.NameNotFound: for an id that is not registered
    :raises RuntimeError: for an env that cannot be made in a process of its own
    """
    check_numbers(n_envs=(n_envs, 1))
    if not isinstance(env_id, str):
        raise ValueError(f"env_id is {env_id!r}, expected the id of a registered env, which is made n_envs times.")
    module, _, env_id = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    try:
        spec, env_kwargs = gym.spec(env_id), env_kwargs or {}
    except (gym.error.NameNotFound, gym.error.NamespaceNotFound) as error:
        namespace, _, goal_env = env_id.partition("/")
        if namespace == "HiddenGoal":
            advice = f"Have it registered before, by `htr_envs.hide_goal({goal_env!r})`."
        else:
            advice = "Import the package that registers it before, as in `import htr_envs`."
        raise type(error)(f"{error} {advice}") from None
    venv: VecEnv
    # A batch draws no pictures
    if spec.vector_entry_point is None or wrapper is not None or vec_env_class is not None or "render_mode" in env_kwargs:
        kind = vec_env_class or DummyVecEnv
        in_processes = issubclass(kind, SubprocVecEnv)

        def make_env() -> gym.Env:
            if in_processes:
                # For the training, which ends a rollout, and then these
                signal.signal(signal.SIGINT, signal.SIG_IGN)
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
            # Not by its id alone: in a process of its own, the registry may not have it
            env = gym.make(spec, **env_kwargs)
            return env if wrapper is None else wrapper(env)

        with arguments_are_known(env_id, env_kwargs), _all_or_none(env_id) if in_processes else nullcontext():
            venv = kind([make_env] * n_envs)
            has_task_family = venv.has_attr("task_family")  # asks all of them
        if isinstance(venv, SubprocVecEnv):
            # Where nobody closes it: at exit, multiprocessing waits for these processes, after a SIGTERM, which they ignore
            Finalize(venv, _kill, [venv.processes], exitpriority=0)
        check_has_task_family(has_task_family)
    else:
        with arguments_are_known(env_id, env_kwargs):
            vector_env = gym.make_vec(env_id, n_envs, vectorization_mode="vector_entry_point", **env_kwargs)
        check_has_task_family(hasattr(vector_env, "task_family"))
        venv = BatchedTaskVecEnv(vector_env)
    family = venv.get_attr("task_family", [0])[0]
    monitored = TaskVecMonitor(venv, info_keywords=("is_success",) if tells_rewards(family) else ())
    if monitor_dir is not None:
        header: dict[str, Any] = {"t_start": monitored.t_start, "env_id": env_id}
        os.makedirs(monitor_dir, exist_ok=True)
        # A run that goes on has those of before, too
        paths = (os.path.join(monitor_dir, f"{number}.monitor.csv") for number in count())
        path = next(path for path in paths if _is_made(path))
        monitored.results_writer = PatientResultsWriter(path, header, monitored.info_keywords)
    # Without one, SB3 would draw it from numpy's global generator
    if seed is not None:
        monitored.seed(seed)
    return monitored


def _is_made(path: str) -> bool:
    """Whether the file was not there: of processes that begin at once, it is one's alone."""
    try:
        open(path, "x").close()
    except FileExistsError:
        return False
    return True


@contextmanager
def arguments_are_known(env_id: str, env_kwargs: dict[str, Any]) -> Iterator[None]:
    """
    Around what makes an env, as Python names the class of ours, or of whoever made it, that lacks an argument.

    :param env_id: a registered id
    :param env_kwargs: arguments of the env
    :raises ValueError: if it takes one of them not
    """
    try:
        yield
    except TypeError as error:
        unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
        if unknown is None or unknown[1] not in env_kwargs:
            raise
        raise ValueError(
            f"{env_id} takes no argument {unknown[1]!r}: leave it out, or correct it. The documentation of the env, and of "
            "its task family, has those that it takes."
        ) from error


@contextmanager
def _all_or_none(env_id: str) -> Iterator[None]:
    """Around what makes envs in processes: if some cannot be made, or it is interrupted, the others would be waited for."""
    before = active_children()
    try:
        yield
    except BaseException as error:
        _kill([process for process in active_children() if process not in before])
        if not isinstance(error, EOFError | ConnectionError):
            raise
        raise RuntimeError(
            f"The process of an env died as {env_id} was made in it: its own traceback is printed above. Envs in one process "
            "(DummyVecEnv) show it here."
        ) from error


def _kill(processes: list[BaseProcess]) -> None:
    for process in processes:
        process.kill()


def family_of(env_id: str, env_kwargs: dict[str, Any] | None = None) -> TaskFamily:
    """
    :param env_id: registered env
    :param env_kwargs: arguments of the env
    :return: its task family
    """
    with closing(make_task_vec_env(env_id, env_kwargs=env_kwargs)) as single:
        return get_task_family(single)
