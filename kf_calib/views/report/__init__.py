"""A result as one HTML page for an engineer: verdict, figures, tables, and how to get the numbers again.

    report.save(found, "report.html", [report.Measured.of(path, ("kf-calib report run.mcap",))])

The page holds all that it needs, and asks the network for nothing: figures as SVG, the residual explorer with uPlot.
"""

from __future__ import annotations

from kf_calib.support.extras import need

need("jinja2", "report", "a report")
need("matplotlib", "report", "a report")

from kf_calib.views.report.contents import page_of  # noqa: E402  # after the check
from kf_calib.views.report.measured import Measured  # noqa: E402
from kf_calib.views.report.page import save  # noqa: E402

__all__ = ["Measured", "page_of", "save"]
