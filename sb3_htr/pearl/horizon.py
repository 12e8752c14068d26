"""Settings that follow from how long an episode is."""

from typing import Any

from sb3_htr.common.settings import check_numbers

# Env steps on each training task of a rollout, as far as from 2 to 10 episodes can have as many
STEPS_PER_TASK = 400
# Env steps of a rollout for each update
STEPS_PER_UPDATE = 20
# The discount reaches as far as the time limit, within these; after a single step nothing comes
MIN_GAMMA, MAX_GAMMA = 0.5, 0.98
# By measurement, 3 for the Wheeled robot and the ant (200 steps an episode) and 10 for a maze (600)
STEPS_PER_RETURN, MAX_N_STEPS = 60, 10
# Transitions per task in an update: an episode, up to so many
MAX_TRANSITIONS = 24
# Of a training: by measurement, the Point Robot (20 steps an episode) has learnt after 40,000, the rest is for the last digit;
# Wheeled robot and ant (200) need 3,000 episodes
MIN_TIMESTEPS, N_EPISODES = 150_000, 3_000
# Arguments of PEARL
BY_HORIZON = ("gamma", "n_steps", "n_episodes_per_task", "learning_starts", "gradient_steps", "batch_size", "context_size")


def settings_for(max_episode_steps: int, n_tasks_per_rollout: int, n_episodes_per_task: int | None = None) -> dict[str, Any]:
    """
    What suits a family of tasks, as far as its time limit tells. For 20 and for 200 steps these are the settings that were
    found by measurement for the Point Robot, and chosen for the Wheeled robot.

    :param max_episode_steps: time limit
    :param n_tasks_per_rollout: training tasks per rollout
    :param n_episodes_per_task: episodes on each of them, if that is given
    :return: discount, sizes of rollouts and updates; arguments of PEARL by their names
    """
    n_episodes = n_episodes_per_task or min(max(STEPS_PER_TASK // max_episode_steps, 2), 10)
    rollout = n_tasks_per_rollout * n_episodes * max_episode_steps
    n_transitions = min(max_episode_steps, MAX_TRANSITIONS)
    return {
        "gamma": min(max(1 - 2 / max_episode_steps, MIN_GAMMA * (max_episode_steps > 1)), MAX_GAMMA),
        "n_steps": min(max(max_episode_steps // STEPS_PER_RETURN, 1), MAX_N_STEPS),
        "n_episodes_per_task": n_episodes,
        # SB3 learns beyond so many steps, and this is after the first rollout
        "learning_starts": rollout - 1,
        "gradient_steps": max(rollout // STEPS_PER_UPDATE, 1),
        "batch_size": n_transitions,
        "context_size": n_transitions,
    }


def complete(given: dict[str, Any], max_episode_steps: int, n_tasks_per_rollout: int) -> dict[str, Any]:
    """
    :param given: of the settings of :func:`settings_for`, those that a user gave; the others are None
    :param max_episode_steps: time limit
    :param n_tasks_per_rollout: training tasks per rollout
    :return: all of them
    :raises ValueError: for one that is out of its range
    """
    chosen = {name: value for name, value in given.items() if value is not None}
    limits: dict[str, Any] = {"gamma": (0.0, 1.0), "learning_starts": (0,)}
    check_numbers(**{name: (value, *limits.get(name, (1,))) for name, value in chosen.items()})
    return settings_for(max_episode_steps, n_tasks_per_rollout, chosen.get("n_episodes_per_task")) | chosen


def timesteps_for(max_episode_steps: int) -> int:
    """
    :param max_episode_steps: time limit
    :return: env steps of a training
    """
    return max(MIN_TIMESTEPS, N_EPISODES * max_episode_steps)
