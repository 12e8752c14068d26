"""A family whose tasks change the dynamics: gymnasium's Walker2d with masses, damping and friction that it is not told.

    python examples/walker_random_params.py      # meta-train by plain PEARL and adapt; hours on one core

PEARL's walker-rand-params, but for the walker, which is gymnasium's: it acts every four physics steps, theirs every five. The
reward is the same in all tasks, and old experience says nothing about another body: there is nothing to relabel. Contexts have
the next observation, too.
"""

from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv

from htr_envs import MetaEnv, TaskDistribution
from htr_envs.headless import open_no_window
from htr_envs.task_env import FloatArray

# Arrays of MuJoCo's model, and the base that to the power of one number of the task multiplies each of their numbers
PARAMETERS = {"body_mass": 1.5, "body_inertia": 1.5, "dof_damping": 1.3, "geom_friction": 1.5}
LIMIT = 3.0


class ScaleDistribution(TaskDistribution):
    """
    Exponents, uniform from -3 to 3.

    :param n_parameters: length of a task
    :param task_seed: seed of the 40 training, 10 validation and 10 test tasks
    """

    def __init__(self, n_parameters: int, task_seed: int = 1337) -> None:
        self.n_parameters = n_parameters
        tasks = self.sample_tasks(60, np.random.default_rng(task_seed))
        super().__init__(spaces.Box(-LIMIT, LIMIT, (n_parameters,), np.float32), tasks[:40], tasks[40:50], tasks[50:])

    def sample_tasks(self, n: int, rng: np.random.Generator) -> FloatArray:
        return rng.uniform(-LIMIT, LIMIT, (n, self.n_parameters)).astype(np.float32)


class WalkerRandomParamsEnv(MetaEnv):
    """
    Walker2d-v5 with a body of its own in each task.

    :param render_mode: ``"rgb_array"`` or None
    :param family_kwargs: of :class:`ScaleDistribution`
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 125}  # type: ignore[misc]

    def __init__(self, render_mode: str | None = None, **family_kwargs: Any) -> None:
        if render_mode is not None:
            open_no_window(render_mode)
        self.walker = Walker2dEnv(render_mode=render_mode)
        self.original = {name: getattr(self.walker.model, name).copy() for name in PARAMETERS}
        super().__init__(ScaleDistribution(sum(values.size for values in self.original.values()), **family_kwargs))
        self.render_mode = render_mode
        self.observation_space = self.walker.observation_space
        self.action_space = self.walker.action_space

    def _reset_state(self) -> FloatArray:
        exponents = self.task.astype(np.float64)
        for name, values in self.original.items():
            scale = PARAMETERS[name] ** exponents[: values.size]
            getattr(self.walker.model, name)[:] = values * scale.reshape(values.shape)
            exponents = exponents[values.size :]
        mujoco.mj_setConst(self.walker.model, self.walker.data)
        obs, _ = self.walker.reset(seed=int(self.np_random.integers(2**31)))
        return obs

    def _step_state(self, action: FloatArray) -> tuple[FloatArray, float, bool]:
        obs, reward, terminated, _, _ = self.walker.step(np.clip(action, -1, 1))
        return obs, reward, terminated

    def render(self) -> Any:
        """Picture (480, 480, 3), uint8; None without a render mode."""
        return self.walker.render() if self.render_mode else None

    def close(self) -> None:
        """Release what draws the pictures."""
        self.walker.close()


gym.register("WalkerRandomParams-v0", entry_point=WalkerRandomParamsEnv, max_episode_steps=200)


if __name__ == "__main__":
    from sb3_htr import PEARL, evaluate_adaptation

    # One episode with a z of the prior, then of the posterior
    prior = {"name": "prior", "n_exploration_episodes": 1}
    plain: dict[str, Any] = {"replay_buffer_kwargs": {"relabel_probability": 0.0}, "explorer": prior, "train_explorer": prior}
    plain["policy_kwargs"] = {"use_next_obs_in_context": True}
    model = PEARL("MlpPolicy", "WalkerRandomParams-v0", **plain, n_episodes_per_task=3, context_size=100, seed=0, verbose=1)
    returns, _ = evaluate_adaptation(model.learn(1_000_000), "WalkerRandomParams-v0", n_episodes=3)
    print(f"return of episodes 1 to 3: {returns.mean(axis=0).round(1)}")
