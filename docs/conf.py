"""Sphinx settings of the manual."""

from pathlib import Path

project = "sb3_htr"
author = "The sb3_htr team"
release = (Path(__file__).parents[1] / "sb3_htr" / "version.txt").read_text().strip()
extensions = ["myst_parser", "sphinx.ext.autodoc"]
html_theme = "furo"
exclude_patterns = ["_build"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"
