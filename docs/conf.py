"""Sphinx settings of the manual."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]

project = "sb3_htr"
author = "The sb3_htr team"
copyright = f"2026, {author}"
release = (ROOT / "sb3_htr" / "version.txt").read_text().strip()
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"sb3_htr {release}"
myst_heading_anchors = 3

# The repository that this is built from, as Read the Docs and GitHub's workflows name it
repository = os.environ.get("READTHEDOCS_GIT_CLONE_URL", "").removesuffix(".git")
if not repository and "GITHUB_REPOSITORY" in os.environ:
    repository = f"{os.environ['GITHUB_SERVER_URL']}/{os.environ['GITHUB_REPOSITORY']}"
if repository:
    html_theme_options = {"source_repository": repository, "source_branch": "main", "source_directory": "docs/"}

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_type_aliases = {name: name for name in ("FloatArray", "BoolArray", "ArrayLike", "Context", "GymEnv", "Schedule")}
python_maximum_signature_line_length = 100
python_use_unqualified_type_names = True
