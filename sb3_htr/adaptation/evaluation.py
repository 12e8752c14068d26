"""Meta-test: how well does an agent adapt to tasks that it has never seen?"""

from collections.abc import Callable
from contextlib import closing
from functools import partial
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
import torch as th
from numpy.typing import ArrayLike
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.adaptation.explorers import Explorer
from sb3_htr.adaptation.loop import Adapting, adaptation_steps
from sb3_htr.common.checks import check_is_env, get_task_family
from sb3_htr.common.random_state import MAX_SEED, kept_env_states, seeded_actions
from sb3_htr.common.settings import check_numbers
from sb3_htr.common.type_aliases import TaskFamily
from sb3_htr.common.vec_env import N_ENVS, family_of, make_task_vec_env, reset_to_tasks
from sb3_htr.common.vec_wrappers import seed_envs

#: Sets of tasks that a family has
TASK_SETS = ("test", "validation", "train")


class MetaLearner(Protocol):
    """What :func:`evaluate_adaptation` asks of a model; :class:`sb3_htr.PEARL` is one."""

    @property
    def policy(self) -> Any:
        """Networks, an SB3 policy."""
        ...

    @property
    def explorer(self) -> Any:
        """How it explores unless told otherwise; it has a ``name``."""
        ...

    def check_env(self, env: VecEnv) -> None:
        """Refuse an env that it cannot act in."""
        ...

    def start_adaptation(self, n_envs: int, explorer: Any = None, generator: th.Generator | None = None) -> Adapting:
        """Begin to adapt to one task per env."""
        ...


def check_adapts(model: Any) -> None:
    """
    :param model: of any kind
    :raises ValueError: if it is no :class:`MetaLearner`
    """
    if not hasattr(model, "start_adaptation"):
        raise ValueError(
            f"{type(model).__name__} does not adapt: pass the model of meta-training, or evaluate an adapted agent by "
            "stable_baselines3's evaluate_policy."
        )


class AdaptationRecord(NamedTuple):
    """
    What happened in the adaptation episodes of some tasks.

    :param returns: (n_tasks, n_episodes) float64, undiscounted returns as the env gave them
    :param successes: (n_tasks, n_episodes) bool, whether some step of the episode solved the task; never, if the env does not
        tell (``info["is_success"]``)
    :param achieved: (n_tasks, n_episodes, T, task_dim) float32, the task that each step achieved, NaN after an episode's end;
        task_dim is 0 if the env does not tell (``info["achieved_task"]``)
    """

    returns: np.ndarray
    successes: np.ndarray
    achieved: np.ndarray


def first_success(successes: np.ndarray) -> np.ndarray:
    """
    :param successes: (..., n_episodes) bool, whether each adaptation episode solved its task
    :return: (...) int, number of the first that did, from 1 on; one more than there are where none did
    """
    return np.where(successes.any(axis=-1), successes.argmax(axis=-1) + 1, successes.shape[-1] + 1)


def run_adaptation(
    policy: BasePolicy,
    env: VecEnv,
    adaptation: Adapting,
    obs: np.ndarray,
    n_episodes: int,
    deterministic: bool = True,
    seed: int | tuple[int, ...] = 0,
) -> AdaptationRecord:
    """
    Run ``n_episodes`` episodes of each env.

    :param policy: knows the action space
    :param env: after a reset
    :param adaptation: acts, and learns from the episodes
    :param obs: (n_envs, obs_dim) of that reset
    :param n_episodes: episodes per env
    :param deterministic: mean actions instead of samples
    :param seed: seed of sampled actions; the random state of training is left alone
    :return: one row per env
    :raises ValueError: if there are no episodes
    """
    check_numbers(n_episodes=(n_episodes, 1))
    n_envs = env.num_envs
    episode, envs = np.zeros(n_envs, dtype=np.int64), np.arange(n_envs)
    returns = np.zeros((n_envs, n_episodes + 1))
    successes = np.zeros((n_envs, n_episodes + 1), dtype=bool)
    steps: list[np.ndarray] = []
    episode_of_step: list[np.ndarray] = []
    act = partial(adaptation.act, deterministic=deterministic)
    with seeded_actions(seed, deterministic):
        for step in adaptation_steps(env, adaptation, n_episodes, policy.unscale_action, act, obs):
            # Envs that are ahead of the others write to a column that is cut off
            column = np.minimum(episode, n_episodes)
            returns[envs, column] += step.rewards
            successes[envs, column] |= [bool(info.get("is_success", False)) for info in step.infos]
            steps.append(np.array([info.get("achieved_task", ()) for info in step.infos], dtype=np.float32))
            episode_of_step.append(column)
            episode += step.dones
    # Of tasks of one dimension, some envs tell a number
    rows = np.stack(steps, axis=1).reshape(n_envs, len(steps), -1)
    achieved = _by_episode(rows, np.stack(episode_of_step, axis=1), n_episodes)
    return AdaptationRecord(returns[:, :n_episodes], successes[:, :n_episodes], achieved)


def _by_episode(steps: np.ndarray, episode: np.ndarray, n_episodes: int) -> np.ndarray:
    """(n, total_steps, dim) and the episode of each step (n, total_steps) -> (n, n_episodes, T, dim), padded with NaN."""
    start = np.stack([np.argmax(episode == i, axis=1) for i in range(n_episodes + 1)], axis=1)
    position = np.arange(episode.shape[1]) - np.take_along_axis(start, episode, axis=1)
    kept = episode < n_episodes
    result = np.full((len(steps), n_episodes, position[kept].max() + 1, steps.shape[2]), np.nan, dtype=np.float32)
    env = np.broadcast_to(np.arange(len(steps))[:, None], episode.shape)
    result[env[kept], episode[kept], position[kept]] = steps[kept]
    return result


def task_set(family: TaskFamily, tasks: str | ArrayLike) -> np.ndarray:
    """
    :param family: of an env
    :param tasks: ``"train"``, ``"validation"``, ``"test"``, or task vectors
    :return: (n_tasks, task_dim) float32
    :raises ValueError: for another word, a set that the family lacks, or an array of another shape
    """
    if isinstance(tasks, str):
        if tasks not in TASK_SETS:
            raise ValueError(f"tasks is {tasks!r}, expected one of {list(TASK_SETS)}, or an array of task vectors.")
        name = f"{tasks}_tasks"
        if not hasattr(family, name):
            raise ValueError(f"The env's task_family has no {name}: add them, or pass an array of task vectors.")
        tasks = getattr(family, name)
    vectors = np.asarray(tasks, dtype=np.float32)
    if vectors.ndim != 2 or len(vectors) == 0:
        raise ValueError(f"tasks have shape {vectors.shape}, expected (n_tasks, task_dim) with at least one task.")
    own = np.shape(family.train_tasks)[1:]
    if vectors.shape[1:] != own:
        raise ValueError(f"tasks have {vectors.shape[1]} numbers each, expected {own[0]}, as those that the family trains on.")
    # A family may know where its tasks lie
    check: Any = getattr(family, "task_vectors", lambda tasks, _: tasks)
    return np.asarray(check(vectors, vectors.shape))


def record_adaptation(
    model: MetaLearner,
    env: VecEnv | gym.Env | str,
    tasks: str | ArrayLike | None = None,
    n_episodes: int = 20,
    explorer: Explorer | dict[str, Any] | str | None = None,
    deterministic: bool = True,
    seed: int = 0,
    on_end: Callable[[Adapting, np.ndarray], None] | None = None,
) -> AdaptationRecord:
    """
    As :func:`evaluate_adaptation`, with what each step achieved.

    :param model: as for :func:`evaluate_adaptation`, and so are all arguments and what is raised
    :param env: env, VecEnv or registered id
    :param tasks: (n_tasks, task_dim), or the name of a set
    :param n_episodes: adaptation episodes per task
    :param explorer: an explorer, its name, or its name and settings
    :param deterministic: mean actions instead of samples
    :param seed: seed of env, z and sampled actions
    :param on_end: is shown each adaptation as it ends, and the tasks of its envs, (n, task_dim); the last one may have more
        envs than tasks
    :return: returns, successes and achieved tasks
    """
    check_adapts(model)
    check_numbers(seed=(seed, 0, MAX_SEED))
    tasks = "test" if tasks is None else tasks
    if isinstance(env, str):
        # Of how many tasks, one env tells. Draws depend on the number of envs: the same tasks have it by name and as an array
        n_tasks = len(task_set(family_of(env), tasks))
        with closing(make_task_vec_env(env, min(n_tasks, N_ENVS), seed)) as made:
            return record_adaptation(model, made, tasks, n_episodes, explorer, deterministic, seed, on_end)
    check_is_env(env)
    if isinstance(env, gym.Env):
        env = BaseAlgorithm._wrap_env(env, monitor_wrapper=False)
    model.check_env(env)
    tasks = task_set(get_task_family(env), tasks)
    seed = int(seed)  # torch takes no numbers of numpy
    generator = th.Generator().manual_seed(seed)
    records = []
    # It may be the env of training
    with kept_env_states(env):
        seed_envs(env, seed)
        for first in range(0, len(tasks), env.num_envs):
            # Envs without a task of their own repeat the last one
            index = np.minimum(np.arange(first, first + env.num_envs), len(tasks) - 1)
            obs = reset_to_tasks(env, tasks[index])
            adaptation = model.start_adaptation(env.num_envs, explorer, generator)
            record = run_adaptation(model.policy, env, adaptation, obs, n_episodes, deterministic, (seed, first))
            own_tasks = tasks[first : first + env.num_envs]
            records.append([values[: len(own_tasks)] for values in record])
            if on_end is not None:
                on_end(adaptation, own_tasks)
    length = max(achieved.shape[2] for _, _, achieved in records)
    for record_ in records:
        padding = ((0, 0), (0, 0), (0, length - record_[2].shape[2]), (0, 0))
        record_[2] = np.pad(record_[2], padding, constant_values=np.nan)
    return AdaptationRecord(*(np.concatenate(values) for values in zip(*records, strict=True)))


def evaluate_adaptation(
    model: MetaLearner,
    env: VecEnv | gym.Env | str,
    tasks: str | ArrayLike | None = None,
    n_episodes: int = 20,
    explorer: Explorer | dict[str, Any] | str | None = None,
    deterministic: bool = True,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Adapt to each task from scratch and report every episode (the protocol of PEARL's reference implementation).

    The context of a task's posterior comes from the episodes of this very adaptation and from nowhere else. The envs keep
    their last task, as after :meth:`sb3_htr.PEARL.adapt`: ``set_task(None)`` has them draw one at each reset again.

    :param model: a PEARL, or a rival
    :param env: env, VecEnv (its envs adapt side by side, each to a task of its own) or registered id, of
        which as many are made as there are tasks, up to 20
    :param tasks: (n_tasks, task_dim), or ``"train"``, ``"validation"`` or ``"test"`` (default), tasks of the env
    :param n_episodes: adaptation episodes per task; 20 in PEARL's reference, for the sparse point robot
    :param explorer: an :class:`sb3_htr.adaptation.Explorer`, its name, or its name and settings; the model's own by default;
        ``"prior"`` is PEARL's protocol
    :param deterministic: mean actions instead of samples
    :param seed: seed of env, z and sampled actions; the random state of training is left alone
    :return: returns and successes, (n_tasks, n_episodes) each
    :raises ValueError: if there are no tasks or episodes, or the env has no task family, or other spaces than in training
    """
    record = record_adaptation(model, env, tasks, n_episodes, explorer, deterministic, seed)
    return record.returns, record.successes
