"""Task-indexed replay with Single Episode Relabelling (SER) at sample time."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_htr.common.checks import check_numbers
from sb3_htr.common.random_state import get_generator_state, set_generator_state
from sb3_htr.common.type_aliases import MultiTaskSamples, TaskFamily, Trajectory
from sb3_htr.htr.episode_store import EpisodeIndex, EpisodeStore
from sb3_htr.htr.hindsight_task import HindsightTaskStrategy, choose_rare, select_step, to_hindsight_task_strategy

# Rows that candidates for hindsight tasks are compared with: enough to tell common from rare, in linear time
MAX_COMPARED = 64


def spread(rng: np.random.Generator, ranges: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Draw up to ``width`` integers from each of several ranges, evenly spread: one from each of as many parts of the range.

    Every integer of a range has the same chance to be drawn, and none is drawn twice: a product of Gaussians would count a
    duplicate in the context as evidence, and a loss that is a mean gains nothing from one.

    :param rng: source of randomness
    :param ranges: (n, 2) int, first and last + 1 of each range
    :param width: how many to draw from each range; all of it, where it holds fewer
    :return: the integers, one range after another, and (n,) int, how many of them are of each range
    """
    length = ranges[:, 1] - ranges[:, 0]
    size = np.minimum(length, width)
    # Parts differ in size by one, which a random rotation of the range makes up for
    rotation = (rng.random(len(ranges)) * length).astype(np.int64)
    # As many random numbers for each range, so that what is drawn from one does not depend on the others
    uniform = rng.random((len(ranges), width))[np.arange(width) < size[:, None]]
    n = np.repeat(size, size)
    part = np.arange(len(n)) - np.repeat(np.cumsum(size) - size, size)
    range_length = np.repeat(length, size)
    first = part * range_length // n
    end = (part + 1) * range_length // n
    position = first + (uniform * (end - first)).astype(np.int64) + np.repeat(rotation, size)
    position -= np.where(position >= range_length, range_length, 0)
    return position + np.repeat(ranges[:, 0], size), size


class MultiTaskReplayBuffer(ReplayBuffer):
    """
    Replay buffer of a family of tasks, with hindsight task relabelling in :meth:`sample`.

    A transition's task is ``infos[i]["task_id"]``; an episode becomes visible to :meth:`sample` when it is complete.

    Single Episode Relabelling (HTR paper, B.2): with probability K, a row of the meta-batch takes ONE episode of its task's
    replay, ONE hindsight task that this episode reached, and both context and RL batch are steps of that episode with the
    rewards of that task. (Algorithm 2, line 12 of the paper has the comparison with K inverted; A.2 and B.3 call K the
    probability of relabelling, which is what it is here.)

    :param buffer_size: capacity in transitions, shared equally by all training tasks
    :param observation_space: Box
    :param action_space: Box
    :param device: where samples are put
    :param n_envs: number of envs that :meth:`add` receives
    :param optimize_memory_usage: for SB3's signature; must be False, episodes are stored whole
    :param task_family: the env's ``task_family``: reward hook and training tasks
    :param max_episode_steps: time limit of the env
    :param relabel_probability: K, in [0, 1]. K = 0 is plain PEARL, bit for bit. The default was chosen by measurement
        (the paper sweeps .1 to 1 and does not name its best)
    :param hindsight_task_strategy: which state of an episode is the hindsight task. ``"random"``: any; ``"final"``: the last;
        ``"even"`` (default): any, those that few others resemble being more probable. The paper says "e.g., select a state
        reached"; the default is our choice, by measurement
    :param rl_batch_source: ``"episode"`` (B.2, default) draws the RL batch of a relabelled row from the same episode as its
        context; ``"task"`` is the ablation of B.2, the RL batch comes from all of the task's replay
    :param rl_reward_type: ``"sparse"``, or ``"dense"`` for the oracle baseline: RL batches carry the dense proxy reward of
        their task while the context stays sparse
    :param context_episodes: without relabelling, the context is drawn from this many latest episodes of the task (PEARL
        draws context from recently collected data)
    :param seed: seed of the buffer's own random generators
    """

    # Whether rewards of hindsight tasks are computed when they are drawn ("lazy"), or are stored ("eager")
    relabels_at_sample_time = True

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        *,
        task_family: TaskFamily,
        max_episode_steps: int,
        relabel_probability: float = 0.8,
        hindsight_task_strategy: HindsightTaskStrategy | str = "even",
        rl_batch_source: str = "episode",
        rl_reward_type: str = "sparse",
        context_episodes: int = 10,
        seed: int | None = None,
    ) -> None:
        check_numbers(
            relabel_probability=(relabel_probability, 0.0, 1.0),
            context_episodes=(context_episodes, 1, float("inf")),
            buffer_size=(buffer_size, 1, float("inf")),
        )
        if rl_batch_source not in ("episode", "task"):
            raise ValueError(f'rl_batch_source is {rl_batch_source!r}, expected "episode" or "task".')
        if rl_reward_type not in ("sparse", "dense"):
            raise ValueError(f'rl_reward_type is {rl_reward_type!r}, expected "sparse" or "dense".')
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage is not supported: MultiTaskReplayBuffer stores whole episodes.")
        n_tasks = len(task_family.train_tasks)
        episodes_per_task = buffer_size // (n_tasks * max_episode_steps)
        if episodes_per_task < 1:
            raise ValueError(
                f"buffer_size is {buffer_size}, too small for one episode of {max_episode_steps} steps for each of "
                f"{n_tasks} training tasks: expected at least {n_tasks * max_episode_steps}."
            )
        # ReplayBuffer's own constructor would allocate everything at once
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        self.optimize_memory_usage = False
        self.handle_timeout_termination = True
        self.task_family = task_family
        self.max_episode_steps = max_episode_steps
        self.relabel_probability = relabel_probability
        self.hindsight_task_strategy = to_hindsight_task_strategy(hindsight_task_strategy)
        self.rl_batch_source = rl_batch_source
        self.rl_reward_type = rl_reward_type
        self.context_episodes = context_episodes
        self.obs_dim = int(np.prod(observation_space.shape or ()))
        # Columns of a transition. (o, a, r) come first: they are what the context encoder sees.
        o, a = self.obs_dim, self.action_dim
        self._obs, self._action, self._reward = slice(0, o), slice(o, o + a), o + a
        self._next_obs = slice(o + a + 1, 2 * o + a + 1)
        self._task_free_reward, self._done = 2 * o + a + 1, 2 * o + a + 2
        self.episodes = EpisodeStore(n_tasks, episodes_per_task, max_episode_steps, 2 * o + a + 3)
        self._open = np.zeros((n_envs, max_episode_steps, 2 * o + a + 3), dtype=np.float32)
        self._open_length = np.zeros(n_envs, dtype=np.int64)
        self._open_task = np.full(n_envs, -1, dtype=np.int64)
        self.seed(seed)

    def seed(self, seed: int | None) -> None:
        """
        :param seed: seed of the two generators. Relabelling has its own, so that K = 0 changes nothing else.
        """
        sequence = np.random.SeedSequence(seed)
        self._rng, self._relabel_rng = (np.random.default_rng(child) for child in sequence.spawn(2))

    @property
    def n_tasks(self) -> int:
        """Number of training tasks."""
        return len(self.task_family.train_tasks)

    @property
    def n_episodes(self) -> np.ndarray:
        """(n_tasks,) int, complete episodes stored for each training task."""
        return np.diff(self.episodes.index().task_episode)[: self.n_tasks]

    @property
    def context_dim(self) -> int:
        """Length of a context row (o, a, r), the first columns of a stored transition."""
        return self._reward + 1

    def size(self) -> int:
        """
        :return: number of stored transitions, unfinished episodes not counted
        """
        return int(self.episodes.index().task_row[self.n_tasks])

    def stats(self) -> dict[str, float]:
        """
        :return: what is worth logging, by its key
        """
        return {"replay/transitions": self.size(), "replay/megabytes": self.episodes.nbytes / 1e6}

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one step of each env.

        :param obs: (n_envs, obs_dim)
        :param next_obs: (n_envs, obs_dim), the terminal observation where an episode ended
        :param action: (n_envs, action_dim), scaled to [-1, 1]
        :param reward: (n_envs,)
        :param done: (n_envs,)
        :param infos: one dict per env with ``task_id`` and ``task_free_reward``
        :raises ValueError: NaN or infinite values, a task id that is no training task, a task that changed within an episode,
            an episode longer than the time limit
        """
        task = np.array([info.get("task_id", -1) for info in infos], dtype=np.int64)
        timeout = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        env, step = np.arange(self.n_envs), self._open_length
        if (bad := (task < 0) | (task >= self.n_tasks)).any():
            raise ValueError(
                f"info['task_id'] is {infos[int(bad.argmax())].get('task_id')}, expected a training task from 0 to "
                f"{self.n_tasks - 1}: only training tasks may enter the replay buffer."
            )
        if (bad := (step > 0) & (task != self._open_task)).any():
            i = int(bad.argmax())
            raise ValueError(
                f"The task of env {i} changed from {self._open_task[i]} to {task[i]} within an episode: change tasks at reset."
            )
        if (step >= self.max_episode_steps).any():
            raise ValueError(f"An episode is longer than the env's time limit of {self.max_episode_steps} steps.")
        self._open[env, step, self._obs] = np.reshape(obs, (self.n_envs, -1))
        self._open[env, step, self._action] = np.reshape(action, (self.n_envs, -1))
        self._open[env, step, self._reward] = reward
        self._open[env, step, self._next_obs] = np.reshape(next_obs, (self.n_envs, -1))
        self._open[env, step, self._task_free_reward] = [info.get("task_free_reward", 0.0) for info in infos]
        self._open[env, step, self._done] = done & ~timeout
        if not np.isfinite(self._open[env, step]).all():
            self._raise_not_finite(self._open[env, step], task)
        self._open_task = task
        self._open_length = step + 1
        for ended in np.flatnonzero(done):
            self._end_episode(int(task[ended]), self._open[ended, : self._open_length[ended]])
            self._open_length[ended] = 0

    def _end_episode(self, task: int, episode: np.ndarray) -> None:
        self.episodes.add(task, episode)

    def _raise_not_finite(self, rows: np.ndarray, task: np.ndarray) -> None:
        i = int((~np.isfinite(rows)).any(axis=1).argmax())
        columns: dict[str, slice | int] = {
            "observation": self._obs,
            "action": self._action,
            "reward": self._reward,
            "next observation": self._next_obs,
            "task_free_reward": self._task_free_reward,
        }
        name = next(name for name, column in columns.items() if not np.isfinite(rows[i, column]).all())
        raise ValueError(f"The {name} of task {task[i]} (env {i}) is {rows[i, columns[name]]}, expected finite numbers.")

    def check_reward_hook(self) -> None:
        """
        :raises ValueError: if the reward hook disagrees with what the env gave for the stored episodes
        """
        index = self.episodes.index()
        rows = self.episodes.rows[index.rows[: self.size()]]
        task = np.repeat(np.arange(self.n_tasks), np.diff(index.task_row[: self.n_tasks + 1]))
        traj = self.trajectory(rows[:, None])
        computed = self.task_family.compute_reward(traj, self.task_family.train_tasks[task])[:, 0]
        given = rows[:, self._reward]
        wrong = ~np.isclose(given, computed, rtol=1e-4, atol=1e-4)
        if wrong.any():
            i = int(wrong.argmax())
            raise ValueError(
                f"The env gave {given[i]:g} for a step of task {task[i]}, but its compute_reward gives {computed[i]:g}: "
                "relabelled rewards would be of another task family. Run htr_envs.check_task_env(env) to find out why."
            )

    def discard_open_episodes(self) -> None:
        """Forget unfinished episodes; to be called when the envs are reset before their episodes end."""
        self._open_length = np.zeros(self.n_envs, dtype=np.int64)

    def reset(self) -> None:
        """Remove all episodes."""
        store = self.episodes
        self.episodes = EpisodeStore(self.n_tasks, store.episodes_per_task, store.episode_length, store.rows.shape[1])
        self.discard_open_episodes()

    def state_dict(self) -> dict[str, Any]:
        """
        :return: all complete episodes and the random generators, for :meth:`load_state_dict`
        """
        return {
            "episodes": self.episodes.state_dict(),
            "random": [get_generator_state(generator) for generator in (self._rng, self._relabel_rng)],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict` of a buffer with the same settings
        """
        self.episodes.load_state_dict(state["episodes"])
        for generator, saved in zip((self._rng, self._relabel_rng), state["random"], strict=True):
            set_generator_state(generator, saved)
        self.discard_open_episodes()

    def trajectory(self, rows: np.ndarray) -> Trajectory:
        """
        :param rows: (..., T, row_dim) stored transitions
        :return: what the reward hook needs of them
        """
        return Trajectory(
            observations=rows[..., self._obs],
            actions=self._unscale(rows[..., self._action]),
            next_observations=rows[..., self._next_obs],
            task_free_reward=rows[..., self._task_free_reward],
        )

    def _unscale(self, action: np.ndarray) -> np.ndarray:
        low, high = self.action_space.low.ravel(), self.action_space.high.ravel()  # type: ignore[attr-defined]
        if (low == -1).all() and (high == 1).all():
            return action
        return low + 0.5 * (action + 1.0) * (high - low)

    def sample(  # type: ignore[override]
        self,
        batch_size: int,
        env: VecNormalize | None = None,
        *,
        meta_batch_size: int = 16,
        context_size: int = 64,
    ) -> MultiTaskSamples:
        """
        Draw a meta-batch: tasks with replacement (as PEARL's reference does), and for each of them context and RL batch.

        No transition is drawn twice: where the episodes that a task's context or RL batch comes from hold fewer than asked
        for, it is all of them. A loss that weighs tasks equally has the same expectation as with duplicates, for less work.

        :param batch_size: transitions per task for actor and critics, at most
        :param env: normalizes observations, if given
        :param meta_batch_size: number of tasks, M
        :param context_size: transitions per task for the context, at most
        :return: the meta-batch
        :raises ValueError: if no episode is complete yet, or the reward hook returns NaN or infinity
        """
        index = self.episodes.index()
        collected = index.tasks[index.tasks < self.n_tasks]
        if len(collected) == 0:
            raise ValueError("The replay buffer holds no complete episode of any task: collect some before sampling.")
        tasks = collected[self._rng.integers(len(collected), size=meta_batch_size)]
        sources = self._task_sources(index, tasks)
        relabelled = self._draw_relabelled(meta_batch_size)
        reward_task = self.task_family.train_tasks[tasks]
        if relabelled.any():
            sources[:, relabelled], reward_task[relabelled] = self._draw_hindsight(index, tasks[relabelled])
        context, n_context = spread(self._rng, sources[0], context_size)
        batch, n_batch = spread(self._rng, sources[1], batch_size)
        rows = self.episodes.rows.take(index.rows.take(np.concatenate([context, batch])), axis=0)
        task_of_row = np.concatenate([np.repeat(np.arange(meta_batch_size), n) for n in (n_context, n_batch)])
        if self.relabels_at_sample_time and relabelled.any():
            where = np.flatnonzero(relabelled[task_of_row])
            self._write_rewards(rows, where, reward_task[task_of_row[where]], "sparse")
        if self.rl_reward_type == "dense":
            where = np.arange(len(context), len(rows))
            self._write_rewards(rows, where, reward_task[task_of_row[where]], "dense")
        if env is not None:
            for column in (self._obs, self._next_obs):
                rows[:, column] = env.normalize_obs(rows[:, column])
        data = self.to_torch(rows, copy=False)
        context_rows, rl_rows = data[: len(context)], data[len(context) :]
        unrewarded = rows[len(context) :, self._reward] == rows[len(context) :, self._task_free_reward]
        return MultiTaskSamples(
            context=context_rows[:, : self.context_dim],
            context_lengths=self.to_torch(n_context, copy=False),
            observations=rl_rows[:, self._obs],
            actions=rl_rows[:, self._action],
            next_observations=rl_rows[:, self._next_obs],
            rewards=rl_rows[:, self._reward],
            dones=rl_rows[:, self._done],
            lengths=self.to_torch(n_batch, copy=False),
            task_ids=tasks,
            relabelled=relabelled,
            unrewarded=np.logical_and.reduceat(unrewarded, np.cumsum(n_batch) - n_batch),
        )

    def _draw_relabelled(self, meta_batch_size: int) -> np.ndarray:
        """(M,) bool, which rows of the meta-batch are relabelled."""
        return self._relabel_rng.random(meta_batch_size) < self.relabel_probability

    def _task_sources(self, index: EpisodeIndex, tasks: np.ndarray) -> np.ndarray:
        """As PEARL: where context and RL batch come from, the latest episodes and all of a task's replay. (2, M, 2) rows."""
        first, end = index.task_episode[tasks], index.task_episode[tasks + 1]
        latest = np.maximum(end - self.context_episodes, first)
        return np.stack([index.episode_row[np.stack([start, end], axis=1)] for start in (latest, first)])

    def _draw_hindsight(self, index: EpisodeIndex, tasks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """SER: one episode, the source of context and RL batch, and one hindsight task that it reached."""
        rng = self._relabel_rng
        first, end = index.task_episode[tasks, None], index.task_episode[tasks + 1, None]
        n_candidates = self.hindsight_task_strategy.n_candidates
        episode = first + (rng.random((len(tasks), n_candidates)) * (end - first)).astype(np.int64)
        start, end = index.episode_row[episode], index.episode_row[episode + 1]
        step = start + select_step(self.hindsight_task_strategy, end - start, rng)
        reached = self.trajectory(self.episodes.rows[index.rows[step]][..., None, :])
        hindsight_task = self.task_family.hindsight_task(reached, 0)
        chosen = np.arange(len(tasks)), choose_rare(self._count_alike(reached, hindsight_task), rng)
        source = np.stack([start[chosen], end[chosen]], axis=1)
        rl_source = source if self.rl_batch_source == "episode" else self._task_sources(index, tasks)[1]
        return np.stack([source, rl_source]), hindsight_task[chosen]

    def _count_alike(self, reached: Trajectory, task: np.ndarray) -> np.ndarray:
        """(n, n_candidates), how many of some other rows solve each candidate's task with their first candidate, plus 1."""
        if task.shape[1] == 1:
            return np.ones(task.shape[:2])
        first = Trajectory(*(values[:MAX_COMPARED, 0] for values in reached))
        return 1 + self.task_family.is_success(first, task[:, :, None])[..., 0].sum(axis=-1)

    def _write_rewards(self, rows: np.ndarray, where: np.ndarray, tasks: np.ndarray, reward_type: str) -> None:
        """Give ``rows[where]`` the rewards of ``tasks``, one for each of them, in one call of the reward hook."""
        traj = self.trajectory(rows.take(where, axis=0)[:, None])
        reward = self.task_family.compute_reward(traj, tasks, reward_type=reward_type)[:, 0]
        if not np.isfinite(reward).all():
            raise ValueError("compute_reward returned NaN or infinity for a hindsight task, expected finite rewards.")
        rows[where, self._reward] = reward
