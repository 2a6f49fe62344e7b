"""The Rerun view of a diagnosis: residuals on spheres, what explanations leave there, and what they go with.

Timeline ``explanation``: 1 is the best, then the others by rank. Entities: ``spheres/{before,left}``,
``driver/CHANNEL/{frame,numbers,residuals,curve}``, ``summary``. Residuals are over the sigma of the means of dwells.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.explanation import Explanation
from kf_calib.diagnosis.hypothesis_table import LISTED, HypothesisTable
from kf_calib.diagnosis.residual_drivers import Driver, is_function_of
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.verdict import format_probability
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import format_p
from kf_calib.support.plain_text import printable
from kf_calib.views.diagnosis import name_of, verdict
from kf_calib.views.rerun.driver_chart import DriverChart, charts_of, charts_view, heading, unit_of
from kf_calib.views.rerun.names import GOLD, rrd_file, thin
from kf_calib.views.rerun.spheres import Log, at_step, forever, log_spheres, spheres

EXPLANATION = "explanation"
_MOST = 5  # explanations


def save_diagnosis_view(diagnosis: Diagnosis, path: Path) -> Path:
    """Write the view of a diagnosis to an .rrd file that opens laid out, at the best explanation."""
    before, explanations = diagnosis.before, diagnosis.explanations[:_MOST]
    sigmas, drivers = mean_sigmas(before), diagnosis.drivers
    ratios = before.residuals_mps2 / sigmas
    with rrd_file(path, _layout(diagnosis)) as stream:
        log_spheres(before, ratios, "spheres/before", 0, stream, forever(stream))
        if drivers:
            readings = [_readings(explanation, sigmas) for explanation in explanations]
            charts = charts_of(drivers[0], [ratios, *readings])
            for chart in charts:
                chart.log_frame(stream)
                if not explanations:
                    forever(stream)(f"{chart.path}/residuals", chart.points(ratios[:, chart.accelerometer]))
            for rank, explanation in enumerate(explanations, 1):
                _log_explanation(explanation, sigmas, charts, at_step(stream, EXPLANATION, rank))
        for rank, explanation in enumerate(explanations, 1):
            log_spheres(
                before, explanation.unexplained_ratios, "spheres/left", 1, stream, at_step(stream, EXPLANATION, rank)
            )
        text = rr.TextDocument(printable(_summary(diagnosis)), media_type=rr.MediaType.MARKDOWN)
        stream.log("summary", text, static=True)
    return path


def _readings(explanation: Explanation, sigmas: Floats) -> Floats:
    """Return the readings less all but what an explanation adds (D, 3), over their sigma."""
    return (explanation.contribution_mps2 + explanation.unexplained_mps2) / sigmas


def _log_explanation(explanation: Explanation, sigmas: Floats, charts: list[DriverChart], log: Log) -> None:
    """Send the readings less all but what an explanation adds, and that as a curve with its 1 sigma.

    Where it does not go with this driver alone there is a dash a dwell instead of the curve.
    """
    readings = _readings(explanation, sigmas)
    effect, spread = explanation.contribution_mps2 / sigmas, explanation.contribution_sigma_mps2 / sigmas
    for i, chart in enumerate(charts):
        log(f"{chart.path}/residuals", chart.points(readings[:, i]))
        if is_function_of(explanation.contribution_mps2, chart.driver):
            order = np.argsort(chart.x)
            lines = [effect[:, i], effect[:, i] - spread[:, i], effect[:, i] + spread[:, i]]
            strips = [chart.at(chart.x[order], line[order]) for line in lines]
            radii = [thin(1.4), thin(0.5), thin(0.5)]
        else:
            strips = [place + np.array([[-6.0, 0.0], [6.0, 0.0]]) for place in chart.at(chart.x, effect[:, i])]
            radii = [thin(1.1)] * len(strips)
        log(f"{chart.path}/curve", rr.LineStrips2D(strips, colors=[GOLD] * len(strips), radii=radii))
    log("driver/heading", heading(printable(f"readings less all but {explanation.name}, which is gold")))


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
    charts = [charts_view(f"against the {each.words}, {unit_of(each).label}") for each in diagnosis.drivers[:1]]
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
