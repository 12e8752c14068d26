"""Are the reward model's probabilities of success what they say?"""

import numpy as np
import torch as th

from sb3_htr.adaptation.loop import adaptation_steps
from sb3_htr.common.checks import tells_rewards
from sb3_htr.common.type_aliases import Context, Trajectory
from sb3_htr.common.vec_env import family_of, make_task_vec_env, reset_to_tasks
from sb3_htr.experiments.cell import KwArgs
from sb3_htr.htr.groups import evenly_spread
from sb3_htr.pearl.pearl import PEARL
from sb3_htr.zoo.run.algorithm import Model

# Equal parts of [0, 1]
N_BINS = 10


def calibration(model: Model, env_id: str, env_kwargs: KwArgs, n_episodes: int) -> np.ndarray:
    """
    The model adapts to the validation tasks. Each state that was reached, with each task that was solved, is a pair:
    p(success | s', z), z being the posterior mean given the task's best episode, against whether the state solves the task.

    :param model: at the end of its training
    :param env_id: registered env
    :param env_kwargs: arguments of the env
    :param n_episodes: adaptation episodes on a task
    :return: (N_BINS, 3) float64, of the pairs whose probability is in a bin: how many, sum of probabilities, successes. No
        pairs for a model without a reward model, and for a family without successes
    """
    family = family_of(env_id, env_kwargs)
    if not isinstance(model, PEARL) or not tells_rewards(family):
        return np.zeros((N_BINS, 3))
    tasks = family.validation_tasks
    env = make_task_vec_env(env_id, len(tasks), seed=0, env_kwargs=env_kwargs)
    obs = reset_to_tasks(env, tasks)
    policy, adaptation = model.policy, model.start_adaptation(len(tasks), generator=th.Generator().manual_seed(0))
    steps = list(adaptation_steps(env, adaptation, n_episodes, policy.unscale_action, adaptation.act, obs))
    env.close()
    # (n_tasks, n_steps, ...) each
    obs, actions, rewards, next_obs, dones = (np.stack(column, axis=1) for column in list(zip(*steps, strict=True))[:5])
    traj = Trajectory(obs, policy.unscale_action(actions), next_obs, np.zeros_like(rewards, dtype=np.float32))
    # Without what is task-free: where a reward of 0 is that of a success, -1 is the other one
    gains = family.compute_reward(traj, tasks) * family.is_success(traj, tasks)
    # (n_tasks, n_tasks, n_steps): where the first was adapted to, is the second solved?
    success = family.is_success(Trajectory(*(values[:, None] for values in traj)), tasks)
    solved, means = [], []
    for task in range(len(tasks)):
        episodes = np.split(np.arange(dones.shape[1]), np.flatnonzero(dones[task]) + 1)
        best = max(episodes, key=lambda episode: gains[task, episode].sum())
        if success[task, task, best].any():
            taken, lengths = evenly_spread(np.array([len(best)]), model.context_size, gains[task, best])
            o, a, r, next_o = (th.as_tensor(x[task, best[taken]], dtype=th.float32) for x in (obs, actions, rewards, next_obs))
            with th.no_grad():
                means.append(policy.infer(Context(o, a, r, next_o, th.as_tensor(lengths)))[0])
            solved.append(task)
    if not solved:
        return np.zeros((N_BINS, 3))
    with th.no_grad():
        states = policy.reward_model.state_tower(policy.normalize(th.as_tensor(next_obs, dtype=th.float32)))
        tasks_solved = policy.reward_model.task_tower(th.cat(means))
        # (n_tasks, n_steps, n_solved)
        probability = policy.reward_model.success_logits(states, tasks_solved).sigmoid().double().numpy()
    observed = success[:, solved].swapaxes(1, 2)
    index = np.minimum((probability * N_BINS).astype(np.int64), N_BINS - 1).ravel()
    columns = (np.ones_like(probability), probability, observed)
    return np.stack([np.bincount(index, weights=column.ravel(), minlength=N_BINS) for column in columns], axis=1)


def expected_calibration_error(bins: np.ndarray) -> float:
    """
    :param bins: of :func:`calibration`, or a sum of several
    :return: mean over pairs of the distance between probability and frequency of success in their bin, NaN without pairs
    """
    n, probability, successes = bins.T
    return float(np.abs(probability - successes).sum() / n.sum()) if n.any() else float("nan")
