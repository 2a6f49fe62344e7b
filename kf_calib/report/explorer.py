"""What the residual explorer of a page draws: residuals of every dwell against everything that varies in the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.explanation import EffectShape
from kf_calib.diagnosis.residual_drivers import Driver, drivers_of
from kf_calib.estimation.residual_table import mean_sigmas
from kf_calib.estimation.results import Calibration
from kf_calib.support.json_values import json_value
from kf_calib.support.units import shown
from kf_calib.views.diagnosis import explains
from kf_calib.views.notation import unit_across

_DIGITS = 5  # significant ones, which a page needs


@dataclass(frozen=True)
class Explorer:
    """A part of a page; content: what its program reads."""

    kind: ClassVar[str] = "explorer"
    content: dict[str, Any]


def explorer(first: Calibration, others: Mapping[str, Floats], shapes: Sequence[EffectShape] = ()) -> Explorer:
    """The explorer of a run.

    others: residuals (D, 3) that other models leave, m/s^2, by what each is called. shapes: of effects; they come
    first.
    """
    dwells = first.linearised.dwells
    models, unit = {f"{first.model.sum}": first.residuals_mps2, **others}, shown("m/s^2")
    return Explorer(
        json_value(
            {
                "dwells": [dwell.number for dwell in dwells],
                "begin_s": [dwell.start_s for dwell in dwells],
                "gimbals_deg": np.degrees([dwell.recorded_pose for dwell in dwells]) if first.bench.axes else None,
                "unit": unit.label,
                "sigma": mean_sigmas(first) * unit.per_si,
                "drivers": [*map(_shape, shapes), *map(_driver, drivers_of(first))],
                "models": [{"name": name, "residual": left_mps2 * unit.per_si} for name, left_mps2 in models.items()],
            },
            _DIGITS,
        )
    )


def _shape(shape: EffectShape) -> dict[str, Any]:
    """Return what an effect must explain, over the quantity that it goes with, in the units of people."""
    across, unit = unit_across(shape), shown(shape.quantity)
    return {
        "name": shape.words, "unit": across.label, "explains": "", "values": shape.values * across.per_si,
        "shown": f"what {shape.effect} must explain", "shown_unit": unit.label, "channels": shape.channels,
        "readings": shape.readings * unit.per_si, "sigma": shape.sigma * unit.per_si,
        "component": shape.component * unit.per_si,
    }  # fmt: skip


def _driver(driver: Driver) -> dict[str, Any]:
    """Return a driver with its values in the unit in which people read them."""
    unit, share = unit_across(driver), f"explains {driver.share:.0%}" if explains(driver) else ""
    of_all = driver.values[:, 0] if np.ptp(driver.values, axis=1).max() == 0.0 else driver.values  # such as an angle
    return {"name": driver.words, "unit": unit.label, "explains": share, "values": of_all * unit.per_si}
