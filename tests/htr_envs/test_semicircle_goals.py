"""Goals on a semicircle, without the robots that go there."""

import numpy as np
import pytest

from htr_envs import AntGoalFamily, Trajectory


@pytest.mark.parametrize("goal_distance", [1.0, 2.0, 3.5])
def test_the_dense_proxy_of_an_ant_is_nothing_at_the_start(goal_distance: float) -> None:
    family, start = AntGoalFamily(goal_distance=goal_distance), np.zeros((1, 3), dtype=np.float32)
    traj = Trajectory(start, start, start, np.zeros(1, dtype=np.float32))
    for task in family.train_tasks:
        assert family.compute_reward(traj, task, "dense").item() == pytest.approx(0, abs=1e-6)
