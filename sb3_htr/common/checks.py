"""Says early and in one sentence why an env cannot be meta-trained on."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_htr.common.family_facts import check_same_family, family_facts
from sb3_htr.common.safe_load import box_in_words
from sb3_htr.common.type_aliases import TaskFamily

# Of gymnasium, with statistics of their own
NORMALIZERS: tuple[type[gym.Wrapper], ...] = (gym.wrappers.NormalizeObservation, gym.wrappers.NormalizeReward)
# Of gymnasium's TimeLimit, and of an env that counts the steps itself, as a batched one does
TIME_LIMITS = ("_max_episode_steps", "max_episode_steps")
TASK_ENV_ADVICE = (
    "hide the goal of a GoalEnv with htr_envs.hide_goal, on the command line --env HiddenGoal/ID; derive any other env from "
    "htr_envs.TaskEnv and test it with htr_envs.check_task_env"
)


def check_is_env(env: Any) -> None:
    """
    :param env: that a user gave
    :raises ValueError: if SB3 cannot use it, for which SB3 has a sentence about another library
    """
    if env is None:
        raise ValueError("There is no env: pass one, or the id of one.")
    if isinstance(env, str):
        raise ValueError(f"The env is the id {env!r}, expected an env: make it with sb3_htr.make_task_vec_env(id, n_envs).")
    if isinstance(env, gym.vector.VectorEnv):
        raise ValueError(
            "The env is a gymnasium VectorEnv, expected one of Stable-Baselines3: pass the env's id, or make it with "
            "sb3_htr.make_task_vec_env(id, n_envs)."
        )


def check_has_env(env: VecEnv | None) -> None:
    """
    :param env: of a model that is to learn
    :raises ValueError: if there is none
    """
    if env is None:
        raise ValueError("The model was loaded without an env, which learning needs: pass env to load, or call set_env.")


def check_env_is_given(kind: type[BaseAlgorithm], env: GymEnv | str | None) -> None:
    """
    :param kind: of a model whose networks are about to be made, and not by a file
    :param env: that it was given
    :raises ValueError: if it was given none
    """
    if env is None:
        raise ValueError(f"{kind.__name__} has no env to make its networks for: pass one, or the id of one.")


def check_finite(name: str, values: np.ndarray, envs: Sequence[int] | None = None) -> None:
    """
    :param name: of the values
    :param values: of an env each
    :param envs: which ones, all by default
    :raises ValueError: for NaN and infinity, of which networks become NaN
    """
    finite = np.isfinite(values)
    if not finite.all():
        row = int((~finite).reshape(len(values), -1).any(axis=1).argmax())
        env = row if envs is None else envs[row]
        raise ValueError(f"The {name} of env {env} is {values[row]}, expected finite numbers: mend the env.")


def warn_without_updates(model: OffPolicyAlgorithm, n_updates: int) -> None:
    """
    :param model: after a training; one that was stopped before its end may go on, and is no reason to warn
    :param n_updates: that it had before
    """
    if model._n_updates == n_updates and model.num_timesteps >= model._total_timesteps:
        warnings.warn(
            f"Nothing was learnt: learning begins after {model.learning_starts} env steps, at the end of a rollout, and "
            f"this training had {model.num_timesteps}. Allow more, or lower learning_starts.",
            stacklevel=3,
        )


def check_spaces(env: GymEnv) -> None:
    """
    :param env: env to train on
    :raises ValueError: if observations or actions are not vectors of floats, or actions have no bounds
    """
    for name, space, advice in (
        (
            "observation",
            env.observation_space,
            "flatten it with a wrapper, hide the goal of a GoalEnv with htr_envs.hide_goal, and put images through an encoder "
            "of your own.",
        ),
        ("action", env.action_space, "it has no discrete actions; flatten others with a wrapper."),
    ):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"The {name} space is {space}, expected a Box of one axis: {advice}")
    check_acts_in_floats(env.action_space)
    if not env.action_space.is_bounded():  # type: ignore[attr-defined]
        raise ValueError(f"The action space {env.action_space} has no bounds: give it some, and scale actions in the env.")


def check_acts_in_floats(action_space: spaces.Space[Any]) -> None:
    """
    :param action_space: of an env to train on, or to adapt in
    :raises ValueError: if its actions are whole numbers
    """
    if not np.issubdtype(action_space.dtype, np.floating):
        raise ValueError(
            f"The action space {action_space} has whole numbers, but actions are floats: give the env a Box of float32, and "
            "let it round them."
        )


def check_fits(env: VecEnv, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """
    :param env: to adapt in; a robot need not say how its observations are bounded, and the spaces may have another dtype
    :param observation_space: of training
    :param action_space: of training
    :raises ValueError: if observations have another shape than there, or other bounds where both have some; or actions another
        shape or other bounds
    """
    check_space_fits("Observation", env.observation_space, observation_space)
    check_space_fits("Action", env.action_space, action_space)
    check_acts_in_floats(env.action_space)


def check_space_fits(name: str, here: spaces.Space[Any], there: spaces.Space[Any]) -> None:
    """
    :param name: "Observation" or "Action"
    :param here: space of an env
    :param there: space of training
    :raises ValueError: as :func:`check_fits`
    """
    boxes = isinstance(here, spaces.Box) and isinstance(there, spaces.Box)
    if not boxes or here.shape != there.shape or not _bounds_fit(here, there, name == "Observation"):
        if isinstance(here, spaces.Dict):
            advice = (
                "Of a GoalEnv, take the env that htr_envs.hide_goal makes of it, which stays on a goal; put a robot's own "
                "into htr_envs.HiddenGoalWrapper."
            )
        else:
            advice = "Wrap the env to have those of training (RescaleAction does it for actions), or train another model."
        raise ValueError(f"{name} spaces do not match: {here} here, {there} in training. {advice}")


def check_recorded_spaces(where: Any, data: Mapping[str, Any]) -> None:
    """
    :param where: an env or a model, which has spaces
    :param data: of a model file, as :func:`sb3_htr.common.safe_load.read_model` returns it; what it has in words is compared
    :raises ValueError: if they do not fit
    """
    for name in ("observation", "action"):
        here, there = getattr(where, f"{name}_space"), box_in_words(data.get(f"{name}_space"))
        if there is not None and isinstance(here, spaces.Box):
            check_space_fits(name.capitalize(), here, there)


def _bounds_fit(here: Any, there: Any, may_be_unknown: bool) -> bool:
    both = np.stack([[here.low, here.high], [there.low, there.high]])
    unknown = may_be_unknown & ~np.isfinite(both).all(axis=0)
    return bool((unknown | np.isclose(*both)).all())


def check_has_task_family(has_task_family: bool) -> None:
    """
    :param has_task_family: whether an env has the attribute
    :raises ValueError: if it has not
    """
    if not has_task_family:
        raise ValueError(f"The env has no task_family, so there are no tasks to meta-train on: {TASK_ENV_ADVICE}.")


def get_task_family(env: VecEnv) -> TaskFamily:
    """
    :param env: env to train on
    :return: its task family
    :raises ValueError: if it has none, or its envs have several
    """
    check_has_task_family(env.has_attr("task_family"))
    family: TaskFamily
    family, *others = env.get_attr("task_family")
    for i, other in enumerate(others, start=1):
        if other is not family:
            check_same_family(family_facts(family), family_facts(other), f"Env {i} of the VecEnv", "the first one")
    if not hasattr(family, "train_tasks"):
        raise ValueError(f"The env's task_family has no train_tasks to meta-train on: {TASK_ENV_ADVICE}.")
    tasks = family.train_tasks
    if not isinstance(tasks, np.ndarray) or tasks.ndim != 2 or len(tasks) == 0:
        what = f"of shape {tasks.shape}" if isinstance(tasks, np.ndarray) else f"a {type(tasks).__name__}"
        raise ValueError(
            f"The task_family's train_tasks are {what}, expected an array (n_tasks, task_dim) of at least one task."
        )
    return family


def missing_hook(family: TaskFamily) -> str | None:
    """
    :param family: of an env
    :return: what it lacks for telling rewards and successes of any step under any task; None if nothing
    """
    return next((name for name in ("compute_reward", "is_success", "hindsight_task") if not hasattr(family, name)), None)


def tells_rewards(family: TaskFamily) -> bool:
    """
    :param family: of an env
    :return: whether it tells rewards and successes of any step under any task
    """
    return missing_hook(family) is None


def check_has_hooks(family: TaskFamily) -> None:
    """
    :param family: of an env
    :raises ValueError: if it cannot tell rewards and successes of any step under any task
    """
    if (missing := missing_hook(family)) is not None:
        raise ValueError(
            f"The env's task_family has no {missing}, which hindsight relabelling and dense proxy rewards need: "
            f"{TASK_ENV_ADVICE}, or train plain PEARL, on the command line --method pearl-sparse-prior, in Python "
            "replay_buffer_kwargs={'relabel_probability': 0}, explorer='prior' and train_explorer='prior'."
        )


def get_max_episode_steps(env: VecEnv) -> int:
    """
    :param env: env to train on
    :return: its time limit: of several around one env the shortest, and of the envs the longest. Of envs in other processes,
        the outermost alone can be seen
    :raises ValueError: if it has none
    """
    envs = getattr(env.unwrapped, "envs", None)
    if envs is not None:
        limits: list[int | None] = [min(_time_limits(single), default=None) for single in envs]
    else:
        name = next((name for name in TIME_LIMITS if env.has_attr(name)), None)
        limits = [None] if name is None else env.get_attr(name)
    if None in limits:
        specs = env.get_attr("spec") if env.has_attr("spec") else [None]
        limits = [None if spec is None else spec.max_episode_steps for spec in specs]
    known = [int(limit) for limit in limits if limit is not None]
    if len(known) < len(limits):
        raise ValueError(
            "The env has no time limit, so its episodes may never end: make it with gymnasium.make(id), "
            "registered with max_episode_steps."
        )
    return max(known)


def _time_limits(env: gym.Env[Any, Any]) -> Iterator[int]:
    """Of an env and all wrappers around it."""
    layer: Any = env
    while layer is not None:
        yield from (limit for name in TIME_LIMITS if (limit := getattr(layer, name, None)) is not None)
        layer = layer.env if isinstance(layer, gym.Wrapper) else None


def check_rewards(env: VecEnv) -> None:
    """
    :param env: env to train on
    :raises ValueError: if it is normalized, or returns other rewards than its task family tells
    """
    check_is_not_normalized(env)
    if not tells_rewards(get_task_family(env)):
        return
    if any(env.env_is_wrapped(gym.RewardWrapper)):
        raise ValueError(
            "The env is in gymnasium's RewardWrapper, which changes its rewards, but relabelled rewards are those of its task "
            "family: leave the wrapper out."
        )
    if env.has_attr("reward_type") and env.get_attr("reward_type")[0] != "sparse":
        raise ValueError(
            "The env's reward_type is not 'sparse', but context and relabelled rewards are: make the env with "
            "reward_type='sparse', and for the dense baseline pass replay_buffer_kwargs={'rl_reward_type': 'dense'}."
        )


def check_is_not_normalized(env: VecEnv) -> None:
    """
    :param env: env to train on, or to adapt to
    :raises ValueError: if it is in SB3's VecNormalize, or in gymnasium's wrappers of that kind
    """
    name = next((kind.__name__ for kind in NORMALIZERS if any(env.env_is_wrapped(kind))), None)
    if unwrap_vec_normalize(env) is not None:
        name = "VecNormalize"
    if name is not None:
        raise ValueError(
            f"{name} stands between the env and what is learned from, and is not saved with the model: leave it out. "
            "PEARL's and RL2's policies normalize observations themselves (normalize_observations of policy_kwargs). Rewards "
            "cannot be normalized: all tasks share one scale."
        )


HAND_ON = "its reset, or that of a wrapper around it, must hand on options."


def check_task_ids(env: VecEnv, asked: np.ndarray) -> None:
    """
    :param env: env to train on, after a reset
    :param asked: (n_envs,) int, indices of the training tasks that it was asked for
    :raises ValueError: if it does not say which task it is on, or is on another one
    """
    if any("task_id" not in info for info in env.unwrapped.reset_infos):
        raise ValueError(
            "The env's reset returns no info['task_id'], so its experience cannot be kept apart by task: "
            "add the index of the training task to the infos of reset and step."
        )
    given = [info["task_id"] for info in env.unwrapped.reset_infos]
    if given != asked.tolist():
        raise ValueError(f"The env was asked for the tasks {asked.tolist()}, and is on {given}: {HAND_ON}")


def check_tasks(env: VecEnv, asked: np.ndarray) -> None:
    """
    :param env: after a reset
    :param asked: (n_envs, task_dim), tasks that it was asked for
    :raises ValueError: if it is on other ones
    """
    if env.has_attr("task"):
        given = np.stack(env.get_attr("task"))
        wrong = np.ones(len(asked), dtype=bool)
        if given.shape == asked.shape:
            wrong = ~np.isclose(given, asked, rtol=1e-5, atol=1e-6).all(axis=1)
        if wrong.any():
            i = int(wrong.argmax())
            raise ValueError(f"Env {i} was asked for the task {asked[i]}, and is on {given[i]}: {HAND_ON}")


def check_device(device: th.device | str) -> None:
    """
    Say so where SB3 takes the CPU in place of a GPU that was asked for.

    :param device: torch device, or ``"auto"``
    :raises ValueError: for a device that cannot be used
    """
    try:
        used = get_device(device)
        th.empty(0, device=used)
        usable = used.type in ("cpu", "cuda")  # others, as mps, lack float64
    except (RuntimeError, AssertionError, NotImplementedError, TypeError):
        usable = False
    if not usable:
        raise ValueError(f"The device {str(device)!r} cannot be used: give cpu, cuda or cuda:N.")
    if device != "auto" and th.device(device).type != used.type:
        warnings.warn(f"There is no {device} that torch could use: {used} is used.", stacklevel=3)
