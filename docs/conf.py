"""How Sphinx builds the documentation (tools/docs). No page fetches anything from the network."""

import os
import sys
from importlib.metadata import version as version_of
from pathlib import Path

os.environ.pop("COLUMNS", None)  # commands that print into the pages would make their tables that narrow
sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "kf_calib"
author = "kf_calib contributors"
copyright = author  # no year: a page that is built again is the same
version = release = version_of("kf_calib")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_click", "mathml", "catalogue", "public_names"]
exclude_patterns = ["_extensions", "_static"]
nitpicky = False
suppress_warnings = ["misc.highlighting_failure"]  # output of commands is no program

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {name: name for name in ("ArrayLike", "Floats", "Mask")}

html_theme = "furo"
html_title = f"kf_calib {version}"
html_static_path = ["_static"]
html_css_files = ["kf_calib.css"]
html_show_sphinx = False
html_copy_source = False
