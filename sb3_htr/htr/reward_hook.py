"""Says whether what an env gives is what its task family tells."""

import warnings
from collections.abc import Sequence

import numpy as np

from sb3_htr.common.task_reward import ROUNDING, task_reward
from sb3_htr.common.type_aliases import TaskFamily
from sb3_htr.htr.transitions import Transitions

# What a success may be worth without a warning: by measurement, 1 and 10 are learnt, 0.1 and 100 are not
WORTH = 0.3, 30.0
# Share of the successes that may be worth nothing: a reward that falls to 0 at the rim of a goal rounds some of them to it
UNPAID = 0.1
# Of how many episodes the hook is also asked as a whole, to see that it says the same as of their steps one by one
MAX_WHOLE = 8


def check_reward_hook(
    family: TaskFamily, columns: Transitions, episodes: Sequence[tuple[int, np.ndarray]], is_relabelled: bool
) -> None:
    """
    Warns of successes that are worth far less or more than the settings suit, and of those that end their episode.

    :param family: tells rewards and successes
    :param columns: of transitions
    :param episodes: training tasks and transitions (length, width) of some episodes
    :param is_relabelled: whether episodes get other tasks
    :raises ValueError: if the reward hook disagrees with what the env gave, or with itself; if a success is worth nothing, or
        something else is worth something
    """
    rows = np.concatenate([episode for _, episode in episodes])
    task = np.repeat([task for task, _ in episodes], [len(episode) for _, episode in episodes])
    tasks = family.train_tasks[task]
    traj = columns.trajectory(rows[:, None])
    rewards = np.asarray(family.compute_reward(traj, tasks))
    check_returned_rewards(rewards, (len(rows), 1))
    given, computed = rows[:, columns.reward], rewards[:, 0]
    successes = np.asarray(family.is_success(traj, tasks))
    if successes.dtype != np.bool_:
        raise ValueError(f"is_success must return bool, one for each step, and returned {successes.dtype}.")
    solved = successes[:, 0]
    check_rewards_told(given, computed, task)
    _check_whole_episodes(family, columns, episodes[:MAX_WHOLE], computed, solved)
    _check_worth(family, columns, np.stack([episode[-1] for _, episode in episodes]))
    # What is more than rounding is a success to all that learns from it
    beside = np.maximum(*(np.abs(reward - traj.task_free_reward[:, 0]) for reward in (given, computed)))
    worthless = ~solved & (beside > ROUNDING)
    if worthless.any():
        i = int(worthless.argmax())
        raise ValueError(
            f"A step that does not solve its task, by is_success, returned {given[i]:.7g}, by compute_reward "
            f"{computed[i]:.7g}, and its info['task_free_reward'] is {traj.task_free_reward[i, 0]:.7g}: they must be the "
            "same. compute_reward is what the task pays plus traj.task_free_reward."
        )
    _check_reached(family, columns, episodes[:MAX_WHOLE])
    ended = rows[:, columns.done] > 0
    if is_relabelled and ended.any() and (ended == solved).all():
        warnings.warn(
            "Episodes end where their task is solved, and only there. Relabelled ones do not: nothing is learnt of staying at "
            "a goal, and ends tell what the task is. Let the env go on up to its time limit.",
            stacklevel=2,
        )


def check_returned_rewards(rewards: np.ndarray, expected: tuple[int, ...], when: str = "") -> None:
    """
    :param rewards: what the reward hook returned
    :param expected: shape that they should have
    :param when: further words for the message
    :raises ValueError: if it is no finite number for each step
    """
    if np.shape(rewards) != expected:
        raise ValueError(f"compute_reward{when} returned shape {np.shape(rewards)}, expected {expected}: one for each step.")
    if not np.isfinite(rewards).all():
        raise ValueError(f"compute_reward{when} returned NaN or infinity, expected finite rewards.")


def check_achieved(tasks: np.ndarray, expected: tuple[int, int] | None = None) -> None:
    """
    :param tasks: what ``hindsight_task`` returned
    :param expected: shape that they should have, of a task for each of several steps
    :raises ValueError: if they have another, or are not finite
    """
    if expected is not None and np.shape(tasks) != expected:
        raise ValueError(
            f"hindsight_task returned shape {np.shape(tasks)} for {expected[0]} steps, expected {expected}: a task for each."
        )
    if not np.isfinite(tasks).all():
        raise ValueError("hindsight_task returned NaN or infinity for a step of finite numbers, expected a task.")


def check_rewards_told(given: np.ndarray, computed: np.ndarray, tasks: np.ndarray) -> None:
    """
    :param given: (n,), rewards that the env gave
    :param computed: (n,), what the reward hook tells of these steps
    :param tasks: (n, ...), their tasks, or indices of these, for the message
    :raises ValueError: if they differ
    """
    wrong = ~np.isclose(given, computed, rtol=1e-4, atol=1e-4)
    if wrong.any():
        i = int(wrong.argmax())
        raise ValueError(
            f"The env gave {given[i]:g} for a step of task {tasks[i]}, but its compute_reward gives {computed[i]:g}: "
            "relabelled rewards would be of another task family. Run htr_envs.check_task_env(env) to find out why."
        )


def _check_whole_episodes(
    family: TaskFamily,
    columns: Transitions,
    episodes: Sequence[tuple[int, np.ndarray]],
    computed: np.ndarray,
    solved: np.ndarray,
) -> None:
    end = 0
    for task, episode in episodes:
        start, end = end, end + len(episode)
        whole, own = columns.trajectory(episode[None]), family.train_tasks[[task]]
        for name, of_all, of_each in (
            ("compute_reward", family.compute_reward(whole, own), computed[start:end]),
            ("is_success", family.is_success(whole, own), solved[start:end]),
        ):
            if not np.allclose(of_all, of_each, rtol=1e-4, atol=1e-4):
                raise ValueError(
                    f"{name} of a whole episode differs from {name} of its steps one by one: it must tell of each step alone, "
                    "whatever was before. Run htr_envs.check_task_env(env) to find out more."
                )


def _check_reached(family: TaskFamily, columns: Transitions, episodes: Sequence[tuple[int, np.ndarray]]) -> None:
    """Under a task that was reached, as few are solved of one's own at first: rewards must pay for what success asks alone."""
    worth: list[np.ndarray] = []
    for _, episode in episodes:
        traj = columns.trajectory(episode[None])
        reached = family.hindsight_task(traj, len(episode) - 1)
        check_achieved(reached)
        solved = np.asarray(family.is_success(traj, reached))
        reward = family.compute_reward(traj, reached)
        worth.append(task_reward(reward, traj.task_free_reward)[solved])
        beside = (reward - traj.task_free_reward)[~solved]
        if (wrong := np.abs(beside) > ROUNDING).any():
            raise ValueError(
                f"A step that does not solve a task which was reached, by is_success, is worth {beside[wrong][0]:.2g} beside "
                "its task-free reward, by compute_reward, where failures are worth 0: pay for successes alone, or let "
                "is_success ask for less."
            )
    unpaid = np.concatenate(worth) <= 0
    if unpaid.mean() > UNPAID:
        raise ValueError(
            f"{int(unpaid.sum())} of {len(unpaid)} steps that solve a task which was reached, by is_success, are worth "
            "nothing beside their task-free reward, by compute_reward: pay for each success, or let is_success ask for more."
        )


def _check_worth(family: TaskFamily, columns: Transitions, last: np.ndarray) -> None:
    traj = columns.trajectory(last[:, None])
    achieved = family.hindsight_task(traj, 0)
    check_achieved(achieved, (len(last), family.train_tasks.shape[1]))
    if not family.is_success(traj, achieved).all():
        raise ValueError(
            "hindsight_task names a task that its own step does not solve, by is_success: hindsight would teach what did "
            "not happen. Run htr_envs.check_task_env(env) to find out more."
        )
    reward = family.compute_reward(traj, achieved)
    check_returned_rewards(reward, (len(last), 1), " for the task that hindsight_task named")
    worth = task_reward(reward, traj.task_free_reward)[:, 0]
    if (worth <= 0).any():
        i = int(worth.argmin())
        raise ValueError(
            f"A step is worth {reward[i, 0]:g} under the task that it solves, and its task-free reward is "
            f"{traj.task_free_reward[i, 0]:g}, so that nothing tells the success: info['task_free_reward'] must be what a "
            "step returns that solves nothing, which is -1 where rewards are -1 and 0."
        )
    if not WORTH[0] <= (typical := float(np.median(worth))) <= WORTH[1]:
        warnings.warn(
            f"A success is worth about {typical:.2g} here, and the settings suit 1 to 10: with 0.1 or 100, the "
            "Point Robot is not learnt. Scale the rewards of the task family.",
            stacklevel=2,
        )
