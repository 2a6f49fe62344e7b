"""How Sphinx builds the documentation (tools/docs). No page fetches anything from the network."""

import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))

project = "kf_calib"
author = "kf_calib contributors"
copyright = author  # no year: a page that is built again is the same
version = release = version_of("kf_calib")

extensions = ["myst_parser", "mathml"]
exclude_patterns = ["_extensions", "_static"]
nitpicky = False
suppress_warnings = ["misc.highlighting_failure"]  # output of commands is no program

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"kf_calib {version}"
html_static_path = ["_static"]
html_css_files = ["kf_calib.css"]
html_show_sphinx = False
html_copy_source = False
