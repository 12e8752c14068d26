"""Sphinx settings of the manual."""

import inspect
from pathlib import Path

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

from htr_envs import HiddenGoalEnv, PointRobotEnv, TargetSpeedEnv
from htr_envs.ant import AntEnv
from htr_envs.wheeled import WheeledEnv

HERE = Path(__file__).parent

project = "sb3_htr"
author = "The sb3_htr team"
release = (HERE.parent / "sb3_htr" / "version.txt").read_text().strip()
extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"sb3_htr {release}"
autodoc_member_order = "bysource"
autodoc_typehints = "none"
myst_heading_anchors = 3


def picture(env_id: str, task: list[float], actions: np.ndarray) -> np.ndarray:
    """The last frame of an episode."""
    env = gymnasium.make(env_id, render_mode="rgb_array")
    env.reset(options={"task": task})
    for action in actions:
        env.step(action)
    return np.asarray(env.render())


# Docstrings of envs are Markdown, as in gymnasium: the pages in envs/ include these copies
(HERE / "_build").mkdir(exist_ok=True)
pages = {
    "point_robot": PointRobotEnv,
    "target_speed": TargetSpeedEnv,
    "wheeled": WheeledEnv,
    "ant": AntEnv,
    "hidden_goal": HiddenGoalEnv,
}
for name, env in pages.items():
    (HERE / "_build" / f"{name}.md").write_text(inspect.cleandoc(env.__doc__ or ""))
# To the ring, then along it: the velocity is multiplied by 0.95 and gets 0.2 times the thrust
angle = np.pi / 4 - 0.06 * np.arange(27)
ring = 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
thrust = np.concatenate([np.full((14, 2), 0.69), (ring[1:] - 0.95 * ring[:-1]) / 0.2]).astype(np.float32)
plt.imsave(HERE / "_build" / "target_speed.png", picture("SparseTargetSpeed-v0", [2.0], thrust))
