"""Machines without a screen."""

import os
import sys

from gymnasium.error import DependencyNotInstalled


def has_screen() -> bool:
    """Whether a window would be seen.

    :return: False on Linux without X11 and Wayland.
    """
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_no_window(render_mode: str = "rgb_array") -> None:
    """Have MuJoCo draw without a window where there is no screen; gymnasium would try to open one, which ends the process.

    :param render_mode: of the env.
    :raises DependencyNotInstalled: if a window is asked for.
    """
    if not has_screen() and render_mode == "human":
        raise DependencyNotInstalled(
            "render_mode 'human' opens a window, which needs a screen, and there is none: take 'rgb_array'."
        )
    if not has_screen() and os.environ.setdefault("MUJOCO_GL", "egl") == "glfw":
        raise DependencyNotInstalled(
            "MUJOCO_GL is glfw, which needs a screen, and there is none: set MUJOCO_GL=egl, or osmesa without a GPU."
        )
