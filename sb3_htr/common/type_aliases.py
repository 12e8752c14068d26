"""Types shared by all of ``sb3_htr``: what it expects of a task family, and what the replay buffer hands out."""

from typing import Any, NamedTuple, Protocol

import numpy as np
import torch as th


class Trajectory(NamedTuple):
    """
    Steps handed to a task family's reward hook; has the attributes of ``htr_envs.Trajectory``.

    :param observations: (..., T, obs_dim) float32
    :param actions: (..., T, action_dim) float32, in the bounds of the env's action space
    :param next_observations: (..., T, obs_dim) float32
    :param task_free_reward: (..., T) float32, the part of the reward that depends on no task
    """

    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    task_free_reward: np.ndarray


class TaskFamily(Protocol):
    """
    What PEARL asks of an env's ``task_family``: a small picklable object without state.

    It is a protocol, so that envs need not import ``sb3_htr``; ``htr_envs.TaskFamily`` fulfils it. Without the three methods
    (``htr_envs.TaskDistribution``), nothing can be relabelled and no success be told: PEARL then learns with K = 0.
    """

    train_tasks: np.ndarray
    validation_tasks: np.ndarray
    test_tasks: np.ndarray

    def compute_reward(self, traj: Any, task: np.ndarray, reward_type: str = "sparse") -> np.ndarray:
        """Reward (..., T) float32 of each step of ``traj`` under ``task`` (..., task_dim)."""
        ...

    def is_success(self, traj: Any, task: np.ndarray) -> np.ndarray:
        """Whether each step of ``traj`` solves ``task``: (..., T) bool."""
        ...

    def hindsight_task(self, traj: Any, index: Any) -> np.ndarray:
        """The task (..., task_dim) that step ``index`` of ``traj`` solves."""
        ...


class Context(NamedTuple):
    """
    Transitions of M tasks, those of the first task first: what a posterior is inferred from. All float32 but the lengths.

    :param observations: (n, obs_dim)
    :param actions: (n, action_dim), scaled to [-1, 1]
    :param rewards: (n,)
    :param next_observations: (n, obs_dim), the last one of its episode where one ended
    :param lengths: (M,) int64, how many of these transitions are of each task
    """

    observations: th.Tensor
    actions: th.Tensor
    rewards: th.Tensor
    next_observations: th.Tensor
    lengths: th.Tensor


class RewardLabels(NamedTuple):
    """
    What n of the transitions of a meta-batch would return under each of its M tasks: what a model of rewards learns from.

    :param rows: (n,) int64, which transitions of the RL batch
    :param weights: (n,) float32, of each in a mean over them
    :param next_observations: (n, obs_dim), where their one step leads
    :param reward: (n, M) float32, its reward beside the task-free one, above 0 where the transition solves the task
    :param task_free: (n,) float32, the task-free one
    :param inferred: (M,) float32, 1 for tasks with a reward in their context, from which they can be inferred
    """

    rows: th.Tensor
    weights: th.Tensor
    next_observations: th.Tensor
    reward: th.Tensor
    task_free: th.Tensor
    inferred: th.Tensor


class MultiTaskSamples(NamedTuple):
    """
    One meta-batch of M tasks: a context, and N transitions for actor and critics, those of the first task first. With n-step
    returns, what follows a transition is what follows n steps, or fewer where the episode ends.

    All tensors are on the buffer's device, and float32, unless said otherwise.

    :param context: of at least one transition of each task
    :param observations: (N, obs_dim)
    :param actions: (N, action_dim), scaled to [-1, 1]
    :param next_observations: (N, obs_dim)
    :param rewards: (N,), discounted sum of these steps' rewards
    :param dones: (N,), 1 where the episode terminated (time limits do not count)
    :param discounts: (N,), of the value of the next observation
    :param lengths: (M,) int64, how many of these transitions are of each task, at least 1
    :param task_weights: (M,), of each task in a mean over tasks, whatever its length
    :param task_ids: (M,) int array, the training task that was drawn for each row of the meta-batch; a relabelled row may
        have the experience of other ones
    :param relabelled: (M,) bool array, whether context and RL batch carry rewards of a hindsight task
    :param unrewarded: (M,) bool array, whether no transition of the RL batch has a reward with a part that depends on the task
    :param labels: of some of these transitions, None unless asked for, and where the family tells no rewards
    """

    context: Context
    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    rewards: th.Tensor
    dones: th.Tensor
    discounts: th.Tensor
    lengths: th.Tensor
    task_weights: th.Tensor
    task_ids: np.ndarray
    relabelled: np.ndarray
    unrewarded: np.ndarray
    labels: RewardLabels | None
