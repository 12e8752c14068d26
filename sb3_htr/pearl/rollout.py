"""Data collection of one meta-iteration: adaptations to training tasks, several at once."""

from typing import TYPE_CHECKING

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import RolloutReturn
from stable_baselines3.common.vec_env import VecEnv

from sb3_htr.common.checks import check_task_ids
from sb3_htr.htr.multi_task_replay_buffer import MultiTaskReplayBuffer
from sb3_htr.pearl.adaptation import Adaptation

if TYPE_CHECKING:
    from sb3_htr.pearl.pearl import PEARL


def collect_adaptations(
    model: "PEARL", env: VecEnv, callback: BaseCallback, replay_buffer: MultiTaskReplayBuffer, learning_starts: int
) -> RolloutReturn:
    """
    Adapt to ``model.n_tasks_per_rollout`` training tasks, one per env at a time.

    Each env stays on its task until every env has finished ``model.n_episodes_per_task`` episodes; envs whose episodes are
    shorter go on with more of them.

    :param model: acts, and counts the steps
    :param env: training env
    :param callback: called at every step
    :param replay_buffer: where the steps go
    :param learning_starts: env steps with random actions
    :return: what was collected, and whether a callback wants to go on
    """
    n_steps, n_episodes = 0, 0
    for _ in range(-(-model.n_tasks_per_rollout // env.num_envs)):
        tasks = _next_tasks(model, env.num_envs)
        adaptation = _begin(model, env, replay_buffer, tasks)
        remaining = np.full(env.num_envs, model.n_episodes_per_task)
        while (remaining > 0).any():
            obs = model._last_obs
            assert isinstance(obs, np.ndarray)
            actions, buffer_actions = _choose_actions(model, obs, adaptation, learning_starts)
            try:
                new_obs, rewards, dones, infos = env.step(actions)
            except ValueError as error:
                raise ValueError(
                    f"An env failed at env step {model.num_timesteps}, on one of the training tasks {tasks.tolist()} "
                    f"({error}): its observations must have the shape of its observation_space."
                ) from error
            except (EOFError, ConnectionError) as error:
                raise RuntimeError(
                    f"The process of an env died at env step {model.num_timesteps}, on one of the training tasks "
                    f"{tasks.tolist()}: its own traceback is printed above. Envs in one process (vec_env dummy) show it here."
                ) from error
            model.num_timesteps += env.num_envs
            n_steps += env.num_envs
            # Give access to local variables
            callback.update_locals(locals())
            if not callback.on_step():
                return RolloutReturn(n_steps, n_episodes, continue_training=False)
            model._update_info_buffer(infos, dones)
            model._store_transition(replay_buffer, buffer_actions, new_obs, rewards, dones, infos)  # type: ignore[arg-type]
            task_free = np.array([info.get("task_free_reward", 0.0) for info in infos])
            adaptation.observe(obs, buffer_actions, rewards, task_free, dones)
            model._update_current_progress_remaining(model.num_timesteps, model._total_timesteps)
            remaining -= dones
            n_episodes += int(dones.sum())
            model._episode_num += int(dones.sum())
    return RolloutReturn(n_steps, n_episodes, continue_training=True)


def _begin(model: "PEARL", env: VecEnv, replay_buffer: MultiTaskReplayBuffer, tasks: np.ndarray) -> Adaptation:
    """Give every env its training task."""
    env.set_options([{"task_id": int(task)} for task in tasks])
    model._last_obs = env.reset()  # type: ignore[assignment]
    check_task_ids(env)
    if model._vec_normalize_env is not None:
        model._last_original_obs = model._vec_normalize_env.get_original_obs()
    replay_buffer.discard_open_episodes()
    return model.start_adaptation(env.num_envs, explorer=model.train_explorer)


def _next_tasks(model: "PEARL", n: int) -> np.ndarray:
    assert model.task_bank is not None
    n_tasks = len(model.task_bank.task_family.train_tasks)
    while len(model._task_queue) < n:
        model._task_queue = np.append(model._task_queue, model._rng.permutation(n_tasks))
    tasks, model._task_queue = model._task_queue[:n], model._task_queue[n:]
    return tasks


def _choose_actions(
    model: "PEARL", obs: np.ndarray, adaptation: Adaptation, learning_starts: int
) -> tuple[np.ndarray, np.ndarray]:
    """Actions for the envs, and the same scaled to [-1, 1]."""
    if model.num_timesteps < learning_starts:
        scaled = model._rng.uniform(-1, 1, (len(obs), *model.action_space.shape)).astype(np.float32)  # type: ignore[misc]
    else:
        scaled = model.policy.act(obs.astype(np.float32, copy=False), adaptation.z)
    return model.policy.unscale_action(scaled), scaled
