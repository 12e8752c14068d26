"""Task-indexed replay with hindsight task relabelling at sample time."""

import copy
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer

from sb3_htr.common.checkpoint import check_state
from sb3_htr.common.checks import check_has_hooks, tells_rewards
from sb3_htr.common.family_facts import check_same_family, family_facts
from sb3_htr.common.random_state import get_generator_state, set_generator_state, stream
from sb3_htr.common.settings import check_numbers, make
from sb3_htr.common.task_reward import ROUNDING, task_reward
from sb3_htr.common.type_aliases import MultiTaskSamples, RewardLabels, TaskFamily
from sb3_htr.htr.episode_store import EpisodeStore
from sb3_htr.htr.groups import ascending, first_rows, stratified_draw
from sb3_htr.htr.n_step import n_step_returns, steps_ahead
from sb3_htr.htr.relabel import RELABELLERS, HindsightDraw, Relabeller
from sb3_htr.htr.reward_hook import check_achieved, check_returned_rewards, check_rewards_told
from sb3_htr.htr.transitions import Transitions

# Of what was saved, how many rewards are compared with those of the task family
N_COMPARED = 1000


def _equal_weights(n: int) -> np.ndarray:
    """(n,), of each in a mean over all."""
    return np.full(n, 1.0 / n, dtype=np.float32)


class MultiTaskReplayBuffer(ReplayBuffer):
    """
    Replay buffer of a family of tasks, with hindsight task relabelling in :meth:`sample`.

    A transition's task is ``infos[i]["task_id"]``; an episode becomes visible to :meth:`sample` when it is complete.

    With probability K, a row of the meta-batch is what the relabeller makes of its task's experience, by default by Single
    Episode Relabelling (HTR paper, B.2): context and RL batch are steps of one episode with the rewards of a task that this
    episode reached. (Algorithm 2, line 12 of the paper has the comparison with K inverted; A.2 and B.3 call K the probability
    of relabelling, which is what it is here.)

    :param buffer_size: capacity in transitions, shared equally by all training tasks, and counted in episodes of
        ``max_episode_steps``: of shorter ones there are as many, with fewer transitions
    :param observation_space: Box
    :param action_space: Box
    :param device: where samples are put
    :param n_envs: number of envs that :meth:`add` receives
    :param task_family: the env's ``task_family``: reward hook and training tasks. Where it has no hook, as
        ``htr_envs.TaskDistribution`` has none, K must be 0
    :param max_episode_steps: time limit of the env
    :param relabel_probability: K, in [0, 1]. K = 0 draws what PEARL draws. The default was chosen by measurement
        (the paper sweeps .1 to 1 and does not name its best)
    :param relabeller: a :class:`Relabeller`, its name, or its name and settings,
        ``{"name": "EpisodeClustering", "cell_size": 0.2}``
    :param rl_reward_type: ``"sparse"``, or ``"dense"`` for the oracle baseline: RL batches carry the dense proxy reward of
        their task while the context stays sparse
    :param context_episodes: without relabelling, the context is drawn from this many latest episodes of the task.
        PEARL's reference has those of its latest collection; by measurement on the Wheeled robot, where that is two, the dense
        proxy learns better from ten, and for HTR no difference is shown
    :param seed: seed of the buffer's own random generators
    :raises ValueError: for a setting that is unknown or out of its range, a family without the hooks that it needs, and a
        capacity below one episode of each task
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        *,
        task_family: TaskFamily,
        max_episode_steps: int,
        relabel_probability: float = 0.8,
        relabeller: Relabeller | Mapping[str, Any] | str = "SingleEpisodeRelabelling",
        rl_reward_type: str = "sparse",
        context_episodes: int = 10,
        seed: int | None = None,
    ) -> None:
        check_numbers(
            relabel_probability=(relabel_probability, 0.0, 1.0),
            context_episodes=(context_episodes, 1),
            buffer_size=(buffer_size, 1),
        )
        if rl_reward_type not in ("sparse", "dense"):
            raise ValueError(f'rl_reward_type is {rl_reward_type!r}, expected "sparse" or "dense".')
        if relabel_probability > 0 or rl_reward_type == "dense":
            check_has_hooks(task_family)
        n_tasks = len(task_family.train_tasks)
        episodes_per_task = buffer_size // (n_tasks * max_episode_steps)
        if episodes_per_task < 1:
            raise ValueError(
                f"buffer_size is {buffer_size}, too small for one episode of {max_episode_steps} steps for each of "
                f"{n_tasks} training tasks: expected at least {n_tasks * max_episode_steps}."
            )
        # ReplayBuffer's own constructor would allocate everything at once
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        self.task_family = task_family
        #: Whether the task family tells rewards and successes of any step under any task
        self.tells_rewards = tells_rewards(task_family)
        self.max_episode_steps = max_episode_steps
        self.relabel_probability = relabel_probability
        self.rl_reward_type = rl_reward_type
        self.context_episodes = context_episodes
        self.transitions = Transitions(observation_space, action_space)
        self.episodes = EpisodeStore(n_tasks, episodes_per_task, max_episode_steps, self.transitions.width)
        self._open = np.zeros((n_envs, max_episode_steps, self.transitions.width), dtype=np.float32)
        self._open_length = np.zeros(n_envs, dtype=np.int64)
        self._open_task = np.full(n_envs, -1, dtype=np.int64)
        self.seed(seed)
        # A copy: what the user gave holds settings, and can be given to another buffer
        self.relabeller = copy.deepcopy(make("relabeller", relabeller, RELABELLERS, Relabeller))
        self.relabeller.bind(self)
        if getattr(self.relabeller, "buffer", None) is not self:
            raise ValueError(f"bind of {type(self.relabeller).__name__} does not call super().bind(buffer), which it needs.")
        # Told of every finished episode: the training task that it was collected on, and its transitions
        self.episode_listeners: list[Callable[[int, np.ndarray], None]] = []
        if relabel_probability > 0:
            self.episode_listeners.append(self.relabeller.on_episode)

    def seed(self, seed: int | None) -> None:
        """
        :param seed: seed of the two generators. Relabelling has its own, so that K = 0 changes nothing else.
        """
        self._rng, self.relabel_rng = stream(seed, "replay"), stream(seed, "relabelling")

    @property
    def _relabelled_by(self) -> str:
        """Name of the relabeller, if it has experience of its own."""
        return type(self.relabeller).__name__ if self.relabeller.keeps_experience and self.relabel_probability > 0 else ""

    @property
    def n_tasks(self) -> int:
        """Number of training tasks."""
        return len(self.task_family.train_tasks)

    @property
    def n_episodes(self) -> np.ndarray:
        """(n_tasks,) int, complete episodes stored for each training task."""
        return np.diff(self.episodes.index().task_episode)

    def size(self) -> int:
        """
        :return: number of stored transitions, unfinished episodes not counted
        """
        return len(self.episodes.index().rows)

    def rewarded(self, episodes: EpisodeStore) -> np.ndarray:
        """
        :param episodes: the buffer's own, or those of a relabeller
        :return: (n_episodes,) bool, which of them have a reward beside the task-free one, in the order of their index
        """
        index, columns = episodes.index(), self.transitions
        if len(index.rows) == 0:
            return np.zeros(0, dtype=bool)
        rewarded = np.abs(episodes.rows[:, columns.reward] - episodes.rows[:, columns.task_free_reward]) > ROUNDING
        return np.logical_or.reduceat(rewarded[index.rows], index.episode_row[:-1])

    def stats(self) -> dict[str, float]:
        """
        :return: what is worth logging, by its key
        """
        own = {"replay/transitions": self.size(), "replay/megabytes": self.episodes.nbytes / 1e6}
        if self.tells_rewards:
            task = np.repeat(np.arange(self.n_tasks), self.n_episodes)
            own["replay/tasks_rewarded"] = len(np.unique(task[self.rewarded(self.episodes)]))
        return {**own, **self.relabeller.stats()}

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
        :raises ValueError: NaN or infinite values, actions that are not scaled, a task id that is no training task, a task
            that changed within an episode, an episode longer than the time limit, another achieved task than the family tells
        """
        task = np.array([info.get("task_id", -1) for info in infos], dtype=np.int64)
        timeout = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        env, step = np.arange(self.n_envs), self._open_length
        if (bad := (task < 0) | (task >= self.n_tasks)).any():
            raise ValueError(
                f"info['task_id'] is {infos[int(bad.argmax())].get('task_id')}, expected a training task from 0 to "
                f"{self.n_tasks - 1}: only training tasks may enter the replay buffer. A callback that gives the envs of "
                "training another one, as one that evaluates in them does, needs envs of its own."
            )
        if (bad := (step > 0) & (task != self._open_task)).any():
            i = int(bad.argmax())
            raise ValueError(
                f"The task of env {i} changed from {self._open_task[i]} to {task[i]} within an episode: change tasks at reset."
            )
        if (step >= self.max_episode_steps).any():
            raise ValueError(
                f"An episode is longer than the env's time limit of {self.max_episode_steps} steps: the env does not end it, "
                "or a callback stepped the envs of training, as one that evaluates in them does; give it envs of its own."
            )
        if (beyond := np.abs(action) > 1 + 1e-5).any():
            raise ValueError(
                f"An action of {np.asarray(action)[beyond].flat[0]:.3g} was to be stored, expected numbers from -1 to 1: "
                "policy.scale_action makes those of an env so."
            )
        columns = self.transitions
        self._open[env, step, columns.observation] = np.reshape(obs, (self.n_envs, -1))
        self._open[env, step, columns.action] = np.reshape(action, (self.n_envs, -1))
        self._open[env, step, columns.reward] = reward
        self._open[env, step, columns.next_observation] = np.reshape(next_obs, (self.n_envs, -1))
        self._open[env, step, columns.task_free_reward] = [info.get("task_free_reward", 0.0) for info in infos]
        self._open[env, step, columns.done] = done & ~timeout
        if not np.isfinite(self._open[env, step]).all():
            self._raise_not_finite(self._open[env, step], task)
        self._open_task = task
        self._open_length = step + 1
        for ended in np.flatnonzero(done):
            episode = self._open[ended, : self._open_length[ended]]
            self._check_achieved(episode[-1:], infos[ended], int(ended))
            self.episodes.add(int(task[ended]), episode)
            # One that keeps it must not see the next episode in its place, nor change what the others are told
            finished = episode.copy()
            finished.flags.writeable = False
            for listener in self.episode_listeners:
                listener(int(task[ended]), finished)
            self._open_length[ended] = 0

    def _check_achieved(self, last: np.ndarray, info: dict[str, Any], env: int) -> None:
        """The env names what its last step achieved, by what it sees itself."""
        if "achieved_task" not in info or not self.tells_rewards:
            return
        achieved = self.task_family.hindsight_task(self.transitions.trajectory(last), 0)
        check_achieved(achieved)
        if not np.allclose(achieved, info["achieved_task"], rtol=1e-3, atol=1e-4):
            told = info["achieved_task"]
            raise ValueError(
                f"A step of env {env} achieved {told}, by its info, and {achieved} by hindsight_task of what arrives here: "
                "a wrapper changes observations, and hindsight rewards would be wrong. Make what it does a part of the task "
                "family and its env."
            )

    def _raise_not_finite(self, rows: np.ndarray, task: np.ndarray) -> None:
        i = int((~np.isfinite(rows)).any(axis=1).argmax())
        names = ("observation", "action", "reward", "next_observation", "task_free_reward")
        columns: dict[str, slice | int] = {name: getattr(self.transitions, name) for name in names}
        name = next(name for name, column in columns.items() if not np.isfinite(rows[i, column]).all())
        raise ValueError(f"The {name} of task {task[i]} (env {i}) is {rows[i, columns[name]]}, expected finite numbers.")

    def discard_open_episodes(self) -> None:
        """Forget unfinished episodes; to be called when the envs are reset before their episodes end."""
        self._open_length = np.zeros(self.n_envs, dtype=np.int64)

    def reset(self) -> None:
        """Remove all episodes."""
        self.episodes = self._empty_store()
        self.relabeller.reset()
        self.discard_open_episodes()

    def _empty_store(self) -> EpisodeStore:
        store = self.episodes
        return EpisodeStore(self.n_tasks, store.episodes_per_task, store.episode_length, self.transitions.width)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: all complete episodes and the random generators, for :meth:`load_state_dict`
        :raises ValueError: if the relabeller's could not be read again
        """
        relabeller = self.relabeller.state_dict()
        check_state(type(self.relabeller).__name__, relabeller)
        return {
            "episodes": self.episodes.state_dict(),
            "relabeller": relabeller,
            "relabelled_by": self._relabelled_by,
            "task_family": family_facts(self.task_family),
            "random": [get_generator_state(generator) for generator in (self._rng, self.relabel_rng)],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: of :meth:`state_dict` of a buffer with the same settings
        :raises ValueError: if it is of another task family, by its attributes or its rewards, or of a store of other sizes
        """
        check_same_family(state["task_family"], family_facts(self.task_family), "This model's env")
        own, by = self._relabelled_by, state["relabelled_by"]
        if own and by != own:
            raise ValueError(
                f"{own} keeps what it has relabelled, and what was saved is of {by or 'a relabeller that does not'}: make the "
                "model with the relabeller that it was saved with."
            )
        episodes = self._empty_store()
        episodes.load_state_dict(state["episodes"])
        self.check_rewards_of(self.task_family, episodes)
        self.relabeller.load_state_dict(state["relabeller"])
        self.episodes = episodes
        for generator, saved in zip((self._rng, self.relabel_rng), state["random"], strict=True):
            set_generator_state(generator, saved)
        self.discard_open_episodes()

    def check_rewards_of(self, family: TaskFamily, episodes: EpisodeStore) -> None:
        """
        Attributes do not tell all that a reward depends on.

        :param family: that is to tell rewards of what is stored
        :param episodes: the buffer's own, or those that are to replace them
        :raises ValueError: if it tells others than were stored
        """
        index, columns = episodes.index(), self.transitions
        if len(index.rows) == 0 or not tells_rewards(family):
            return
        rewarded = np.flatnonzero(np.repeat(self.rewarded(episodes), np.diff(index.episode_row)))
        # Not drawn: as many random numbers are to follow as without
        some = [of[:: max(1, 2 * len(of) // N_COMPARED)] for of in (np.arange(len(index.rows)), rewarded)]
        virtual = np.concatenate(some)
        task = np.searchsorted(index.task_row, virtual, side="right") - 1
        rows = episodes.take(virtual)
        computed = family.compute_reward(columns.trajectory(rows[:, None]), family.train_tasks[task])
        try:
            check_rewards_told(rows[:, columns.reward], np.asarray(computed)[:, 0], task)
        except ValueError as error:
            raise ValueError(f"What was collected is of another task family than that of this env. {error}") from None

    def sample(  # type: ignore[override]
        self,
        batch_size: int,
        *,
        meta_batch_size: int = 16,
        context_size: int = 64,
        n_labelled: int = 0,
        n_steps: int = 1,
        gamma: float = 0.98,
    ) -> MultiTaskSamples:
        """
        Draw a meta-batch: tasks with replacement (as PEARL's reference does), and for each of them context and RL batch.

        Where the episodes that a task's context or RL batch comes from hold fewer transitions than asked for, it is all of
        them, and none is drawn twice (but for the share that a relabeller draws from anywhere). A loss that weighs tasks
        equally has the same expectation as with duplicates, for less work.

        :param batch_size: transitions per task for actor and critics, at most
        :param meta_batch_size: number of tasks, M
        :param context_size: transitions per task for the context, at most
        :param n_labelled: transitions that are rewarded under all tasks of the meta-batch, at most
        :param n_steps: steps of each transition of the RL batch, under one task, to the end of the episode at most
        :param gamma: discount of a step
        :return: the meta-batch
        :raises ValueError: if no episode is complete yet, or the reward hook returns NaN or infinity
        """
        index = self.episodes.index()
        if len(index.tasks) == 0:
            raise ValueError("The replay buffer holds no complete episode of any task: collect some before sampling.")
        tasks = index.tasks[self._rng.integers(len(index.tasks), size=meta_batch_size)]
        context_source, batch_source = index.latest_episodes(tasks, self.context_episodes), index.all_episodes(tasks)
        reward_task = self.task_family.train_tasks[tasks].astype(np.float32)
        relabelled = self.relabel_rng.random(meta_batch_size) < self.relabel_probability
        hindsight = self._draw_hindsight(tasks[relabelled]) if relabelled.any() else None
        if hindsight is not None:
            context_source[relabelled], batch_source[relabelled] = hindsight.context, hindsight.batch
            reward_task[relabelled] = hindsight.tasks
        context, n_context = stratified_draw(self._rng, context_source, context_size)
        context = ascending(context, n_context)  # an encoder may read it in the order of time
        batch, n_batch = stratified_draw(self._rng, batch_source, batch_size)
        virtual = np.concatenate([context, batch])
        task_of_row = np.concatenate([np.repeat(np.arange(meta_batch_size), n) for n in (n_context, n_batch)])
        store, of_store, rl = self.episodes, relabelled[task_of_row], slice(len(context), None)
        if hindsight is not None:
            store = hindsight.store
            if hindsight.elsewhere:
                self._draw_elsewhere(virtual[rl], of_store[rl], hindsight.elsewhere)
        # From here on, n_steps rows for each of the RL batch; no episode has more than its time limit
        n_steps = min(n_steps, self.max_episode_steps)
        ahead, n_ahead = self._steps_ahead(virtual[rl], of_store[rl], store, n_steps)
        times = np.repeat([1, n_steps], [len(context), len(batch)])
        of_task = np.repeat(task_of_row, times)
        rows = self.take(np.append(context, ahead), np.repeat(of_store, times), store)
        if hindsight is not None and not hindsight.is_relabelled:
            where = np.flatnonzero(relabelled[of_task])
            self.write_rewards(rows, where, reward_task[of_task[where]])
        if self.rl_reward_type == "dense":
            where = np.arange(len(context), len(rows))
            self.write_rewards(rows, where, reward_task[of_task[where]], "dense")
        columns = self.transitions
        context_rows, steps = rows[: len(context)], rows[rl].reshape(len(batch), n_steps, -1)
        first, last = steps[:, 0], steps[:, -1]
        returns, discounts = n_step_returns(steps[..., columns.reward], n_ahead, gamma)
        beside = np.abs(steps[..., columns.reward] - steps[..., columns.task_free_reward]).max(axis=1)
        return MultiTaskSamples(
            context=columns.context(context_rows, n_context, self.device),
            observations=self._tensor(first[:, columns.observation]),
            actions=self._tensor(first[:, columns.action]),
            next_observations=self._tensor(last[:, columns.next_observation]),
            rewards=self._tensor(returns),
            dones=self._tensor(last[:, columns.done]),
            discounts=self._tensor(discounts),
            lengths=self._tensor(n_batch),
            task_weights=self._tensor(_equal_weights(meta_batch_size)),
            task_ids=tasks,
            relabelled=relabelled,
            unrewarded=np.logical_and.reduceat(beside <= ROUNDING, first_rows(n_batch)),
            labels=self._label(first, context_rows, n_context, reward_task, n_labelled),
        )

    def _draw_hindsight(self, tasks: np.ndarray) -> HindsightDraw:
        """What the relabeller says of rows of these training tasks."""
        drawn = self.relabeller.draw(tasks)
        if not isinstance(drawn, HindsightDraw):
            name = type(self.relabeller).__name__
            raise ValueError(f"draw of {name} returned a {type(drawn).__name__}, expected a HindsightDraw.")
        drawn.check(len(tasks), self.task_family.train_tasks.shape[1])
        return drawn

    def _draw_elsewhere(self, virtual: np.ndarray, of_store: np.ndarray, share: float) -> None:
        """A share of the rows that are of the relabeller's store: any of the replay in their place."""
        rows = np.flatnonzero(of_store)
        rows = rows[self.relabel_rng.random(len(rows)) < share]
        virtual[rows] = self.relabel_rng.integers(len(self.episodes.index().rows), size=len(rows))
        of_store[rows] = False

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return self.to_torch(array, copy=False)

    def _steps_ahead(
        self, virtual: np.ndarray, of_store: np.ndarray, store: EpisodeStore, n_steps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """See :func:`sb3_htr.htr.n_step.steps_ahead`; each row may be of either store, see :meth:`take`."""
        if store is self.episodes:
            return steps_ahead(store.index(), virtual, n_steps)
        ahead, n = np.empty((len(virtual), n_steps), dtype=np.int64), np.empty(len(virtual), dtype=np.int64)
        for of_this, episodes in ((~of_store, self.episodes), (of_store, store)):
            ahead[of_this], n[of_this] = steps_ahead(episodes.index(), virtual[of_this], n_steps)
        return ahead, n

    def _label(
        self, rows: np.ndarray, context: np.ndarray, n_context: np.ndarray, tasks: np.ndarray, n_labelled: int
    ) -> RewardLabels | None:
        """Some rows under all tasks; which of the tasks have a reward in their context."""
        if n_labelled == 0 or not self.tells_rewards:
            return None
        columns = self.transitions
        chosen = self._rng.permutation(len(rows))[:n_labelled]
        traj = columns.trajectory(rows[chosen])
        told = self.task_family.compute_reward(traj, tasks)
        check_returned_rewards(told, (len(tasks), len(chosen)), " under all tasks of a meta-batch")
        reward = task_reward(told, traj.task_free_reward)
        rewarded = task_reward(context[:, columns.reward], context[:, columns.task_free_reward]) > 0
        inferred = np.logical_or.reduceat(rewarded, first_rows(n_context))
        return RewardLabels(
            rows=self._tensor(chosen),
            weights=self._tensor(_equal_weights(len(chosen))),
            next_observations=self._tensor(traj.next_observations),
            reward=self._tensor(np.ascontiguousarray(reward.T, dtype=np.float32)),
            task_free=self._tensor(traj.task_free_reward),
            inferred=self._tensor(inferred.astype(np.float32)),
        )

    def take(self, virtual: np.ndarray, of_store: np.ndarray, store: EpisodeStore) -> np.ndarray:
        """
        :param virtual: (n,) int, virtual rows
        :param of_store: (n,) bool, which of them are of another store than the buffer's own
        :param store: the other store
        :return: (n, width) float32, copies of these transitions
        """
        if store is self.episodes:
            return self.episodes.take(virtual)
        rows = np.empty((len(virtual), self.transitions.width), dtype=np.float32)
        rows[~of_store], rows[of_store] = self.episodes.take(virtual[~of_store]), store.take(virtual[of_store])
        return rows

    def write_rewards(self, rows: np.ndarray, where: np.ndarray, tasks: np.ndarray, reward_type: str = "sparse") -> None:
        """
        Give ``rows[where]`` the rewards of ``tasks``, in one call of the reward hook.

        :param rows: (n, width) transitions, changed in place
        :param where: (m,) int
        :param tasks: (m, task_dim), one for each of them
        :param reward_type: ``"sparse"`` or ``"dense"``
        :raises ValueError: if the reward hook returns another shape, NaN or infinity
        """
        traj = self.transitions.trajectory(rows.take(where, axis=0)[:, None])
        reward = self.task_family.compute_reward(traj, tasks, reward_type=reward_type)
        check_returned_rewards(reward, (len(where), 1), f" with reward_type={reward_type!r}, for a hindsight task,")
        rows[where, self.transitions.reward] = reward[:, 0]
