"""Pictures by OpenGL on machines without a screen."""

import os
import sys


def open_no_window() -> None:
    """Have MuJoCo draw without a window where there is no screen; gymnasium would try to open one, which ends the process."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("MUJOCO_GL", "egl")
