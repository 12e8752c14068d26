"""Pictures by OpenGL on machines without a screen."""

import os
import sys

from gymnasium.error import DependencyNotInstalled


def open_no_window() -> None:
    """Have MuJoCo draw without a window where there is no screen; gymnasium would try to open one, which ends the process.

    :raises DependencyNotInstalled: if a window is asked for.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        if os.environ.setdefault("MUJOCO_GL", "egl") == "glfw":
            raise DependencyNotInstalled(
                "MUJOCO_GL is glfw, which needs a screen, and there is none: set MUJOCO_GL=egl, or osmesa without a GPU."
            )
