"""Residuals of a run over their sigma against the number of the orientation.

Entities: ``residuals/{grid,ticks,...}``, ``residuals/bound``, ``residuals/CHANNEL``.
"""

from __future__ import annotations

import numpy as np
import rerun as rr

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration
from kf_calib.views.rerun.chart import Axis, Chart, thin
from kf_calib.views.rerun.names import ACCELEROMETERS, CHANNELS, GREY
from kf_calib.views.rerun.series import ends

BOUND = 2.0


def ratios(result: Calibration) -> Floats:
    """Residuals (D, 3) over the sigma of the means, as the misfit is judged."""
    return result.residuals_mps2 / mean_sigmas(result)


def residual_chart(result: Calibration) -> Chart:
    """The chart of all residuals of a run."""
    number, shown = ends(result.visits)[1], ratios(result)
    reach = np.array([-1.0, 1.0]) * max(1.2 * BOUND, float(np.abs(shown).max()))
    across = Axis.counted(int(number[0]), int(number[-1]), "orientation")
    return Chart("residuals", across, Axis.around(reach), width=560.0, height=300.0)


def log_residuals(result: Calibration, stream: rr.RecordingStream) -> None:
    """Send the chart; the accelerometers of a dwell stand side by side."""
    chart, shown = residual_chart(result), ratios(result)
    number = ends(result.visits)[1].astype(float)
    chart.frame(stream)
    bounds = [chart.level(each) for each in (-BOUND, BOUND)]
    stream.log("residuals/bound", rr.LineStrips2D(bounds, colors=GREY, radii=thin(0.8)), static=True)
    for i, (channel, colour) in enumerate(zip(CHANNELS, ACCELEROMETERS, strict=True)):
        points = chart.at(number + 0.15 * (i - 1), shown[:, i])
        radius = thin(3.5 if len(points) < 60 else 1.6)
        stream.log(f"residuals/{channel}", rr.Points2D(points, colors=colour, radii=radius), static=True)
