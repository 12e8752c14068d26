"""SparseTargetSpeed-v0."""

from typing import Any

import numpy as np
import pytest

from htr_envs import TargetSpeedEnv, TargetSpeedFamily, Trajectory


def test_a_sledge_slows_down_and_is_paid_at_its_speed_less_what_thrust_costs() -> None:
    env = TargetSpeedEnv(tolerance=0.05)
    env.reset(seed=0, options={"task": [0.2]})
    # A thrust, the velocity after it, its cost, and whether that is the speed
    steps: list[tuple[Any, Any, float, bool]] = [
        ([3.0, 0.0], [0.2, 0.0], 0.01, True),
        ([0.0, 0.5], [0.19, 0.1], 0.0025, True),
        ([0.4, 0.0], [0.2605, 0.095], 0.0016, False),
    ]
    for thrust, velocity, cost, is_held in steps:
        obs, reward, terminated, _, info = env.step(np.array(thrust, dtype=np.float32))
        np.testing.assert_allclose(obs, velocity, atol=1e-6)
        assert reward == pytest.approx(is_held - cost) and info["task_free_reward"] == pytest.approx(-cost)
        assert info["is_success"] == is_held and not terminated


def test_target_speeds_are_between_the_smallest_and_the_largest() -> None:
    family = TargetSpeedFamily(min_speed=1.0, max_speed=2.0)
    for tasks in (family.train_tasks, family.validation_tasks, family.test_tasks):
        assert tasks.min() >= 1.0 and tasks.max() <= 2.0 and np.ptp(tasks) > 0.9


def test_the_dense_proxy_is_minus_the_difference_to_the_speed() -> None:
    velocity = np.array([[[0.6, 0.8]]], dtype=np.float32)
    traj = Trajectory(velocity, velocity, velocity, np.full((1, 1), -0.01, dtype=np.float32))
    for task in (0.5, 1.5):
        assert TargetSpeedFamily().compute_reward(traj, np.array([task]), "dense").item() == pytest.approx(-0.51)
