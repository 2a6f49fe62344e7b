"""A plan of sides to turn up as a report and as a JSON object."""

from __future__ import annotations

from typing import Any

from rich.console import Group, RenderableType

from kf_calib.bench import paper_parameters
from kf_calib.design.hand_poses import SYMBOLS, HandPlan
from kf_calib.estimation.free_attitude import up_in_words
from kf_calib.support.units import shown
from kf_calib.views.console import symbol
from kf_calib.views.json import clean
from kf_calib.views.tables import Table
from kf_calib.views.terminal import note

_UNITS = dict(zip(paper_parameters.SYMBOLS, paper_parameters.UNITS, strict=True))


def hand_plan_report(made: HandPlan) -> RenderableType:
    """The poses in their order, and the sigmas to expect."""
    poses = Table(title=f"{len(made.up)} poses to hold still", title_justify="left")
    for heading in ("pose", "points up", "in words"):
        poses.add_column(heading, justify="right" if heading == "pose" else "left")
    for k, up in enumerate(made.up, 1):
        poses.add_row(str(k), up, up_in_words(up))
    sigmas = Table(title="Predicted sigma (1σ)", title_justify="left")
    for heading in ("parameter", "sigma", "unit"):
        sigmas.add_column(heading, justify="right" if heading == "sigma" else "left")
    for name, sigma in zip(SYMBOLS, made.sigma[-1], strict=True):
        unit = shown(_UNITS[name])
        sigmas.add_row(symbol(name), f"± {unit.number(sigma, 2)}", unit.label)
    near = "a pose need not be exact: within some ten degrees of it will do."
    return Group(poses, sigmas, note(near))


def hand_plan_object(made: HandPlan) -> dict[str, Any]:
    """The JSON object of ``plan --no-angles``; sigmas in SI."""
    before, after = (dict(zip(SYMBOLS, made.sigma[k], strict=True)) for k in (0, -1))
    return clean({"axes": None, "count": len(made.up), "gimbal_deg": None, "up": made.up, "sigma": after,
                  "sigma_before": before})  # fmt: skip
