"""Whether this machine can draw at all, found out without the code that is tested."""

from functools import cache

import pytest

from htr_envs.headless import open_no_window


@cache
def _obstacle() -> str:
    import mujoco
    from gymnasium.envs.mujoco.mujoco_rendering import OffScreenViewer

    open_no_window()
    model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><body><freejoint/><geom size="1"/></body></worldbody></mujoco>')
    try:
        OffScreenViewer(model, mujoco.MjData(model), 16, 16).close()
    except Exception as error:
        return repr(error)
    return ""


def skip_where_mujoco_cannot_draw() -> None:
    """For the rest of a test."""
    if _obstacle():
        pytest.skip(f"MuJoCo cannot draw on this machine: {_obstacle()}")
