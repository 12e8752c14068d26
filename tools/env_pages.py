"""Writes what the docstrings of the envs say into their pages, docs/envs/*.md: ``python tools/env_pages.py``.

Docstrings of envs are Markdown, as in gymnasium, and so the pages can be read wherever Markdown can.
"""

import inspect
from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
from tables import fill

from htr_envs import HiddenGoalEnv, PointRobotEnv, TargetSpeedEnv
from htr_envs.ant import AntEnv
from htr_envs.wheeled import WheeledEnv

PAGES = Path(__file__).parents[1] / "docs" / "envs"
ENVS: dict[str, type[gym.Env]] = {
    "sparse_point_robot": PointRobotEnv,
    "sparse_target_speed": TargetSpeedEnv,
    "sparse_wheeled": WheeledEnv,
    "sparse_ant": AntEnv,
    "hidden_goal": HiddenGoalEnv,
}


def tables(env: type[gym.Env]) -> dict[str, str]:
    """
    :param env: class of an env
    :return: what to fill into its page
    """
    return {"docstring": f"\n{inspect.cleandoc(env.__doc__ or '')}\n\n"}


def draw_target_speed(path: Path) -> None:
    """
    :param path: picture of an episode of SparseTargetSpeed-v0 that reaches the ring of its target speed, and turns along it
    """
    # To the ring, then along it: the velocity is multiplied by 0.95 and gets 0.2 times the thrust
    angle = np.pi / 4 - 0.06 * np.arange(27)
    ring = 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    thrust = np.concatenate([np.full((14, 2), 0.69), (ring[1:] - 0.95 * ring[:-1]) / 0.2]).astype(np.float32)
    env = gym.make("SparseTargetSpeed-v0", render_mode="rgb_array")
    env.reset(options={"task": [2.0]})
    for action in thrust:
        env.step(action)
    plt.imsave(path, np.asarray(env.render()))


def main() -> None:
    """All pages."""
    for name, env in ENVS.items():
        fill([PAGES / f"{name}.md"], tables(env))
    draw_target_speed(PAGES / "target_speed.png")


if __name__ == "__main__":
    main()
