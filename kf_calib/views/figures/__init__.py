"""Figures of results for reports, by matplotlib: ``kf_calib.plot``.

    found = kf_calib.diagnose("run.mcap")
    kf_calib.plot.residuals(found)                  # a matplotlib Figure, shown by a notebook
    kf_calib.plot.save(kf_calib.plot.figures(found), "run.pdf")

``figures`` gives all figures of a result, by title, the one that tells most first; each is drawn when it is asked for.
A function of each figure has the same name here as in its module.
"""

from __future__ import annotations

from kf_calib.errors import need

need("matplotlib", "plot", "a figure")

from kf_calib.views.figures.collection import Figures, figures, save  # noqa: E402  # after the check
from kf_calib.views.figures.convergence import convergence, estimates, history  # noqa: E402
from kf_calib.views.figures.engines import allan_deviation, three_ways, whiteness  # noqa: E402
from kf_calib.views.figures.explanations import detection_limits, hypotheses, suspects  # noqa: E402
from kf_calib.views.figures.improvement import improvement  # noqa: E402
from kf_calib.views.figures.noise import noise  # noqa: E402
from kf_calib.views.figures.orientations import (  # noqa: E402
    correlations,
    directions,
    information,
    on_the_sphere,
    plan,
    predicted_sigmas,
)  # fmt: skip
from kf_calib.views.figures.residuals import disturbed_dwell, dwell, residuals, what_they_go_with  # noqa: E402

__all__ = [
    "Figures", "allan_deviation", "convergence", "correlations", "detection_limits", "directions",
    "disturbed_dwell", "dwell", "estimates", "figures", "history", "hypotheses", "improvement", "information", "noise",
    "on_the_sphere", "plan", "predicted_sigmas", "residuals", "save", "suspects", "three_ways",
    "what_they_go_with", "whiteness",
]  # fmt: skip
