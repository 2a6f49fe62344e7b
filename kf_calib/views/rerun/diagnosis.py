"""The Rerun view of a diagnosis: residuals on spheres, what explanations leave there, and the shape of each.

Timeline ``explanation``: 1 is the best, then the others by rank. Entities: ``spheres/{before,left}``,
``driver/CHANNEL/{frame,numbers,residuals,curve}``, ``summary``. Residuals are over the sigma of the means of dwells.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.effect_shape import EffectShape
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.hypothesis_table import LISTED, HypothesisTable
from kf_calib.diagnosis.residual_drivers import Driver
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import format_p
from kf_calib.support.plain_text import printable
from kf_calib.support.units import shown_whole
from kf_calib.views.diagnosis import name_of, verdict
from kf_calib.views.rerun.driver_chart import Chart, charts_of, charts_view, clear, heading
from kf_calib.views.rerun.names import GOLD, rrd_file, thin
from kf_calib.views.rerun.spheres import Log, at_step, forever, log_spheres, spheres

EXPLANATION = "explanation"
_MOST = 5  # explanations


def save_diagnosis_view(diagnosis: Diagnosis, path: Path) -> Path:
    """Write the view of a diagnosis to an .rrd file that opens laid out, at the best explanation."""
    before, explanations = diagnosis.before, diagnosis.explanations[:_MOST]
    ratios = before.residuals_mps2 / mean_sigmas(before)
    with rrd_file(path, _layout(diagnosis)) as stream:
        log_spheres(before, ratios, "spheres/before", 0, stream, forever(stream))
        if diagnosis.drivers and not explanations:
            _log_residuals(diagnosis.drivers[0], ratios, forever(stream))
        for rank, explanation in enumerate(explanations, 1):
            log = at_step(stream, EXPLANATION, rank)
            for shape in explanation.shapes[:1]:
                _log_shape(shape, log)
            log_spheres(before, explanation.unexplained_ratios, "spheres/left", 1, stream, log)
        text = rr.TextDocument(printable(_summary(diagnosis)), media_type=rr.MediaType.MARKDOWN)
        stream.log("summary", text, static=True)
    return path


def _log_residuals(driver: Driver, ratios: Floats, log: Log) -> None:
    """Send the residuals over their sigma against the quantity that they go with most."""
    unit = shown_whole(driver.unit, float(np.abs(driver.values).max()))
    titles = [f"accelerometer {i}: residual / σ" for i in (1, 2, 3)]
    for k, chart in enumerate(charts_of(driver.values * unit.per_si, titles, ratios)):
        chart.log_frame(log)
        log(f"{chart.path}/residuals", chart.points(ratios[:, k]))
    log("driver/heading", heading(printable(f"residuals against the {driver.words}, {unit.label}")))


def _log_shape(shape: EffectShape, log: Log) -> None:
    """Send what an effect must explain of the readings, and what it adds as a curve with its 1 sigma.

    Where it does not go with its quantity alone there is a dash a dwell instead of the curve.
    """
    unit = shown_whole(shape.unit, float(np.nanmax(np.abs(shape.values))))
    ratios = shape.readings / shape.sigma
    charts = charts_of(shape.values * unit.per_si, [f"{channel}, σ" for channel in shape.channels], ratios)
    clear(log, range(len(charts), 3))
    for k, chart in enumerate(charts):
        chart.log_frame(log)
        log(f"{chart.path}/residuals", chart.points(ratios[:, k]))
        log(f"{chart.path}/curve", _curve(shape, chart, unit.per_si))
    said = f"what {shape.effect} must explain, against {shape.words}, {unit.label}"
    log("driver/heading", heading(printable(said)))


def _curve(shape: EffectShape, chart: Chart, per_si: float) -> rr.LineStrips2D:
    """Return what an effect adds: a curve, and the same less and plus 1 sigma; or a dash a dwell."""
    k = chart.place
    sigma = float(np.nanmedian(shape.sigma[:, k]))
    if shape.is_curve:
        at, middle, spread = shape.curve(k)
        strips = [chart.at(at * per_si, line / sigma) for line in (middle, middle - spread, middle + spread)]
        radii = [thin(1.4), thin(0.5), thin(0.5)]
    else:
        places = chart.at(chart.x, shape.component[:, k] / shape.sigma[:, k])
        strips = [place + np.array([[-6.0, 0.0], [6.0, 0.0]]) for place in places if np.isfinite(place).all()]
        radii = [thin(1.1)] * len(strips)
    return rr.LineStrips2D(strips, colors=[GOLD] * len(strips), radii=radii)


def _summary(diagnosis: Diagnosis) -> str:
    """The verdict, the next orientation, the explanations by rank, and the quantities by what they explain."""
    blocks = [f"**{verdict(diagnosis)}**"]
    if diagnosis.table is not None:
        blocks.append(_probabilities(diagnosis.table))
    if diagnosis.next_orientation is not None:
        advice, why = diagnosis.next_orientation
        angles = ", ".join(f"{angle:.4g}" for angle in advice.gimbal_deg)
        blocks.append(f"**Next orientation**: gimbals at {angles} deg: {why}.")
    if explanations := diagnosis.explanations[:_MOST]:
        rows = [
            f"| {rank} | {each.name} | {'yes' if each.fits else 'no'} | {_p(each)} |"
            for rank, each in enumerate(explanations, 1)
        ]
        blocks.append("\n".join(["| explanation | adds | fits | p of the model with it |", "|:--|:--|:--|:--|", *rows]))
        blocks.append("Move the cursor of the timeline *explanation* to see what each leaves.")
    if diagnosis.drivers:
        rows = [f"| {each.words} | {_share(each)} | p {format_p(each.p_value)} |" for each in diagnosis.drivers]
        blocks.append("\n".join(["| quantity | goes with | |", "|:--|:--|:--|", *rows]))
    return "\n\n".join(blocks) + "\n"


def _share(driver: Driver) -> str:
    """How much of the misfit goes with a driver, in a few words."""
    if driver.p_value > 0.01 or driver.share < 0.005:
        return "no more than noise"
    return f"{100 * driver.share:.0f} % of the misfit"


def _probabilities(table: HypothesisTable) -> str:
    """Families and explanations with their probabilities, the likeliest first, without the unlikely."""
    families = [(name, share) for name, share in table.families.items() if share >= LISTED]
    rows = [*families, ("", None), *((name_of(row), row.probability) for row in table.listed)]
    lines = ["| | |" if share is None else f"| {name} | {format_probability(share)} |" for name, share in rows]
    return "\n".join(["| it may be | probability |", "|:--|--:|", *lines])


def _p(explanation: Explanation) -> str:
    return format_p(explanation.after.consistency.p_value).removeprefix("= ")


def _layout(diagnosis: Diagnosis) -> rrb.Blueprint:
    name = "what the effect must explain" if diagnosis.explanations else "what residuals go with"
    charts = [charts_view(name)] if diagnosis.drivers else []
    return rrb.Blueprint(
        rrb.Horizontal(
            spheres("spheres", 2 if diagnosis.explanations else 1),
            *charts,
            rrb.TextDocumentView(origin="summary", name="verdict"),
            column_shares=[5, *(4.4 for _ in charts), 3.8],
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=EXPLANATION, play_state="paused"),
    )
