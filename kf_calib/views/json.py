"""Results as JSON objects with the keys on which other programs rely; their values are those of the results."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from kf_calib.estimation.cross_validation import orientations
from kf_calib.estimation.results import Calibration, OutlyingDwell
from kf_calib.estimation.signal_quality import Readings

if TYPE_CHECKING:
    from kf_calib.diagnosis.results import SideBySide
    from kf_calib.estimation.engine_comparison import Comparison


def replay_object(result: Calibration) -> dict[str, Any]:
    """The JSON object of ``replay``."""
    judged, noise, dwells = result.consistency, result.noise, result.fit.dwells
    return {
        "samples": result.counts.read,
        "dwells": len(dwells),
        "orientations": len(orientations(dwells)),
        "engine": result.settings.engine,
        "model": list(map(str, result.model.effects)),
        "parameters": parameters_object(result),
        "frame": frame_object(result),
        "biases_at_s": dwells[-1].end_s if noise.walk.steps else None,
        "noise": {
            "sigma_mps2": noise.sigma_mps2,
            "inflation": noise.inflation,
            "dwell_sigma_mps2": noise.scatter_mps2,
            "dwell_sigma_stated": noise.scatter.stated,
            "angle_sigma_deg": None if noise.attitude_unknown else math.degrees(noise.setting_rad),
            "angle_sigma_stated": noise.setting.stated and not noise.attitude_unknown,
            "walk_mps2_per_sqrt_s": noise.walk_mps2_per_sqrt_s,
        },
        "consistency": {
            "consistent": judged.unconditional,
            "conditional_on": judged.condition,
            **members(judged, "p_value", "nis_per_dof", "dof"),
        },
        **members(result, "residual_rms_mps2", "held_out_rms_mps2", "held_out_floor_mps2"),
        "counts": {key: value for key, value in vars(result.counts).items() if isinstance(value, int)},
        "readings": readings_object(result.readings),
        "outlying_dwells": [outlying_object(each) for each in result.outlying],
        "warnings": result.warnings,
    }


def parameters_object(result: Calibration) -> list[dict[str, Any]]:
    """All parameters of a calibration as JSON objects, in SI units."""
    return [
        members(p, "symbol", "value", "sigma") | {"low": low, "high": high} | members(p, "unit", "nominal")
        for p in result.parameters.values()
        for low, high in [result.interval(p)]
    ]


def frame_object(result: Calibration) -> dict[str, Any] | None:
    """Without angles: the parameters that the frame fixes, and those of axes taken for square; else None."""
    if result.bench.angles:
        return None
    return {
        "x": "axis of accelerometer 1",
        "xy": "plane of the axes of accelerometers 1 and 2",
        "fixed": [symbol for symbol, by in result.fixed.items() if by == "frame"],
        "square": [symbol for symbol, by in result.fixed.items() if by == "square"],
        "square_sigma_deg": math.degrees(result.bench.square_rad),
    }


def outlying_object(outlying: OutlyingDwell) -> dict[str, Any]:
    """A dwell that alone does not fit, the gimbal errors that would explain it, and the parameters without it."""
    return {
        "dwell": outlying.number,
        "gimbal_deg": np.degrees(outlying.dwell.recorded_pose) if outlying.without.bench.axes else None,
        **members(outlying, "error_mps2", "p_value"),
        "turns": [vars(turn) | {"gimbal": turn.gimbal + 1} for turn in outlying.turns],
        "without": {"p_value": outlying.without.consistency.p_value, "parameters": parameters_object(outlying.without)},
    }


def readings_object(readings: Readings) -> dict[str, Any]:
    """Quantisation, saturation and outliers of the readings."""
    return {
        "quantisation": [{**vars(each), "rms_mps2": each.rms_mps2} for each in readings.quantisation],
        **members(readings, "saturation", "outliers"),
    }


def compare_object(compared: Comparison) -> dict[str, Any]:
    """The JSON object of ``compare``: parameters, time, memory and differences of each way of computing."""
    return {
        "max_difference_sigma": compared.max_difference_sigma,
        "engines": {
            name: {
                **members(way, "wall_s", "peak_mb", "max_difference_sigma", "max_relative_variance"),
                "values": way.estimate.parameters,
                "sigmas": way.estimate.sigma,
            }
            for name, way in compared.ways.items()
        },
        "parameters": [p.symbol for p in compared.result.parameters.values()],
        "remarks": compared.remarks,
        "warnings": compared.result.warnings,
    }


def side_by_side_object(pair: SideBySide) -> dict[str, Any]:
    """What ``report --json`` adds for a second evaluation: that one, and the differences from it in SI units."""
    return {
        "against": {
            "consistent": pair.first.consistent,
            "p_value": pair.first.test.p_value,
            "verdict": pair.first.verdict,
        },
        "differences": [
            {
                "symbol": difference.symbol,
                "first": difference.first.value,
                "second": difference.second.value,
                "sigmas": difference.sigmas,
                "unit": difference.first.unit,
            }
            for difference in pair.differences
        ],
        "differences_p_value": pair.p_value,
    }


def members(of: object, *names: str) -> dict[str, Any]:
    """What an object has by these names, which are the keys of JSON."""
    return {name: getattr(of, name) for name in names}
