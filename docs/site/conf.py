"""Sphinx's settings for the site; `build.py` beside it collects the pages and calls Sphinx."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.append(str(Path(__file__).parent))  # the extension `formulas`

project = "epipole"
version = release = version_of("epipole")
author = "the epipole authors"
project_copyright = "2026, the epipole authors"

extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "formulas"]
myst_enable_extensions = ["attrs_inline", "dollarmath"]
myst_heading_anchors = 4  # the same anchors as on a repository's page
highlight_language = "text"

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say more: shapes and units
numpydoc_show_class_members = False
numpydoc_attributes_as_param_list = True

default_role = "code"  # of docstrings
html_theme = "furo"
html_title = f"epipole {release}"
html_math_renderer = "drawn"
html_static_path = [str(Path(__file__).parent / "static")]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}
