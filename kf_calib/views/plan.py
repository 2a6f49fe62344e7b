"""A plan of orientations as a report, as a JSON object, and as CSV that a bench or ``simulate --plan`` can run; and a
plan of sides to turn up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.design.orientation_plan import Plan, papers_sigma
from kf_calib.design.sides import SYMBOLS, HandPlan
from kf_calib.estimation.free_attitude import up_in_words
from kf_calib.support.output_files import write_whole
from kf_calib.support.text import counted
from kf_calib.support.units import Unit, shown
from kf_calib.views.json import members
from kf_calib.views.notation import gimbal_names, symbol
from kf_calib.views.terminal import FOURS, ConsoleTable, note, table


def plan_object(plan: Plan, beside_paper: bool = False) -> dict[str, Any]:
    """The JSON object of ``plan``; angles are in deg, sigmas in SI.

    beside_paper: add the figures of the paper's set of orientations.
    """
    symbols, before = plan.information.symbols, plan.information.last is not None
    document = {
        "axes": plan.information.model.bench.to_metadata()["axes"],
        "count": len(plan.poses),
        "gimbal_deg": plan.gimbal_deg,
        "up": None,
        "directions": plan.directions,
        "begin_s": plan.at_s - 0.5 * plan.timing.dwell_s,
        "duration_s": plan.duration_s,
        "slew_s": float(plan.slews_s.sum()),
        "criterion": plan.search.aim.name,
        "cost": plan.cost,
        "sigma": _by_symbol(symbols, plan.sigma[-1]),
        "sigma_before": _by_symbol(symbols, plan.sigma[0] if before else None),
        "sigma_balanced": _by_symbol(symbols, plan.balanced_sigma),
        **members(plan, "condition_number", "d_efficiency", "d_efficiency_within_reach", "largest_variance"),
        "parameters": len(symbols),
        "time_correlation": plan.correlation,
        "remarks": plan.remarks,
    }
    if beside_paper:
        theirs, twelve = papers_sigma(plan.information), paper_parameters.SYMBOLS
        document["paper"] = {
            "sigma": _by_symbol(twelve, theirs),
            "mean_error_percent": _by_symbol(twelve, mean_error_percent(theirs)),
            "plan_mean_error_percent": _by_symbol(twelve, mean_error_percent(plan.sigma[-1, :STATE_COUNT])),
            "generalised_sigma_ratio": generalised_ratio(plan),
        }
    return document


def _by_symbol(symbols: Sequence[str], values: Floats | None) -> dict[str, Any] | None:
    """Return values by symbol, or None."""
    return None if values is None else dict(zip(symbols, values, strict=True))


def mean_error_percent(sigma: Floats) -> Floats:
    """The mean absolute error as in the paper's Table 2, sqrt(2/pi) sigma over the deviation, in per cent (12,)."""
    return 100.0 * math.sqrt(2.0 / math.pi) * sigma / paper_parameters.DEVIATIONS


def generalised_ratio(made: Plan) -> float:
    """The generalised sigma of the plan, the geometric mean of its principal sigmas, over that of the paper's set."""
    return made.generalised_sigma / made.papers_generalised_sigma


def plan_report(made: Plan, beside_paper: bool = False) -> RenderableType:
    """The report that ``plan`` prints."""
    return Group(_orientations(made), _sigmas(made, beside_paper), *map(Text, sentences(made, beside_paper)),
                 *map(note, made.remarks))  # fmt: skip


def _orientations(made: Plan) -> ConsoleTable:
    """Return the table of the orientations in their order."""
    begins = made.at_s - 0.5 * made.timing.dwell_s
    rows = [
        (str(k), f"{begin:.0f}", *(f"{angle:.2f}" for angle in angles), " ".join(f"{part:+.3f}" for part in up))
        for k, (begin, angles, up) in enumerate(zip(begins, made.gimbal_deg, made.directions, strict=True), 1)
    ]
    gimbals = [f">{name.replace('_', ' ')}, deg" for name in gimbal_names(made.information.model.bench)]
    title = f"{counted(len(made.poses), 'orientation')}, in this order"
    return table(title, (">", ">begins, s", *gimbals, ">up, in the platform"), rows)


def _sigmas(made: Plan, beside_paper: bool) -> ConsoleTable:
    """Return the table of the predicted sigmas."""
    columns = _columns(made, beside_paper)
    units = [*map(shown, paper_parameters.UNITS), *map(shown, made.information.model.coefficients)]
    rows = [
        (symbol(name), *(_figure(values[k], percent, unit) for values, percent in columns.values()), unit.label)
        for k, (name, unit) in enumerate(zip(made.information.symbols, units, strict=True))
    ]
    headings = "parameter", *(f">{name}" for name in columns), "unit"
    return table("Predicted sigma (1σ)", headings, rows, FOURS)


def _columns(plan: Plan, beside_paper: bool) -> dict[str, tuple[Floats, bool]]:
    """Return for each heading of that table the values (p,) and whether they are in per cent."""
    columns = dict[str, tuple[Floats, bool]]()
    if plan.information.last is not None:
        columns["now"] = plan.sigma[0], False
    columns["this plan"] = plan.sigma[-1], False
    if plan.balanced_sigma is not None:
        columns["balanced"] = plan.balanced_sigma, False
    if beside_paper:
        theirs, none = papers_sigma(plan.information), np.full(len(plan.information.symbols) - STATE_COUNT, np.nan)
        columns["paper's set"] = np.append(theirs, none), False
        columns["as in Table 2: plan"] = np.append(mean_error_percent(plan.sigma[-1, :STATE_COUNT]), none), True
        columns["paper"] = np.append(mean_error_percent(theirs), none), True
    return columns


def _figure(value: float, percent: bool, unit: Unit) -> str:
    """Return a number as text; "not seen" where it is not finite."""
    if not math.isfinite(value):
        return "not seen"
    return f"{value:.3g} %" if percent else unit.number(value, zeros=True)


def sentences(made: Plan, beside_paper: bool = False) -> list[str]:
    """The quality of the plan in sentences."""
    count = len(made.information.symbols)
    told = [
        f"Aim {made.search.aim.name}: {made.search.aim.measures} {made.cost:.4g}. Condition number "
        f"{made.condition_number:.4g} (rad, 1, g; the least is √3).",
        f"D-efficiency {made.d_efficiency:.4f} of the bound; {made.d_efficiency_within_reach:.4f} of what these "
        f"gimbals can. Largest variance function {made.largest_variance:.4g} ({count} where D-optimal).",
        f"{made.duration_s:.0f} s, {made.slews_s.sum():.0f} s of them in slews."
        + f" Correlation of time with the direction of gravity: {made.correlation:.2f}."
        * (made.information.last is None),
    ]
    if beside_paper:
        told.append(
            "The paper's set has four orientations for each accelerometer alone, this plan serves the three at "
            f"once; its generalised sigma is {generalised_ratio(made):.3f} of that of the paper's set."
        )
    return told


def write_csv(made: Plan, path: Path) -> None:
    """Write a CSV file with the names of the gimbals, then one line of angles in deg for each dwell."""
    header = ",".join(f"gimbal_{name}_deg" for name in gimbal_names(made.information.model.bench))
    rows = [",".join(repr(float(angle)) for angle in row) for row in made.gimbal_deg]
    write_whole(path, ("\n".join([header, *rows]) + "\n").encode())


_UNITS = dict(zip(paper_parameters.SYMBOLS, paper_parameters.UNITS, strict=True))


def hand_plan_report(made: HandPlan) -> RenderableType:
    """The poses in their order, and the sigmas to expect."""
    turned = [(str(k), up, up_in_words(up)) for k, up in enumerate(made.up, 1)]
    poses = table(f"{len(made.up)} poses to hold still", (">pose", "points up", "in words"), turned)
    expected = [(symbol(name), shown(_UNITS[name]), sigma) for name, sigma in zip(SYMBOLS, made.sigma[-1], strict=True)]
    rows = [(name, f"± {unit.number(sigma, 2)}", unit.label) for name, unit, sigma in expected]
    sigmas = table("Predicted sigma (1σ)", ("parameter", ">sigma", "unit"), rows)
    near = "a pose need not be exact: within some ten degrees of it will do."
    return Group(poses, sigmas, note(near))


def hand_plan_object(made: HandPlan) -> dict[str, Any]:
    """The JSON object of ``plan --no-angles``; sigmas in SI."""
    before, after = (_by_symbol(SYMBOLS, made.sigma[k]) for k in (0, -1))
    return {
        "axes": None,
        "count": len(made.up),
        "gimbal_deg": None,
        "up": made.up,
        "sigma": after,
        "sigma_before": before,
    }
