"""Sphinx settings of the manual."""

import inspect
from pathlib import Path

from htr_envs import PointRobotEnv

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

# Docstrings of envs are Markdown, as in gymnasium: envs.md includes this copy
(HERE / "_build").mkdir(exist_ok=True)
(HERE / "_build" / "point_robot.md").write_text(inspect.cleandoc(PointRobotEnv.__doc__ or ""))
