"""Machines without a screen."""

import os
import sys


def has_screen() -> bool:
    """Whether a window would be seen.

    :return: False on Linux without X11 and Wayland.
    """
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_no_window() -> None:
    """Have MuJoCo draw without a window where there is no screen; gymnasium would try to open one, which ends the process."""
    if not has_screen():
        os.environ.setdefault("MUJOCO_GL", "egl")
