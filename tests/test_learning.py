"""The whole thing learns."""

from sb3_htr import PEARL, evaluate_adaptation
from sb3_htr.common.vec_env import make_task_vec_env


def test_it_learns_to_find_and_hold_unseen_goals_from_sparse_rewards() -> None:
    """Goals at half the distance, 8,000 env steps, 450 updates: from nothing to most of the optimum of 17.8."""
    # All of the 100 test tasks side by side
    env, test_env = (make_task_vec_env("SparsePointRobot-v0", n, env_kwargs={"goal_distance": 0.5}) for n in (20, 100))
    model = PEARL("MlpPolicy", env, seed=0, n_episodes_per_task=5, learning_starts=2000, gradient_steps=150)
    returns, _ = evaluate_adaptation(model, test_env, n_episodes=15)
    assert returns[:, -1].mean() < 4
    model.learn(8_000)
    returns, successes = evaluate_adaptation(model, test_env, n_episodes=15)
    assert returns[:, -1].mean() > 9
    assert successes[:, -1].mean() > 0.6
    # It adapts: the last episodes are better than the first
    assert returns[:, -1].mean() > returns[:, 0].mean() + 2
