"""Journals of improvement: every step with its figures as TOML, to keep beside a calibration.

    version = "0.1.0"
    stopped_because = "consistent"
    reason = "Nothing is left that noise would not leave (p = 0.31)."
    model = ["second-order"]

    [recording]
    name = "hidden.mcap"
    sha256 = "4f0e..."

    [options]                               # those given on the command line
    angle_sigma_deg = "0.002"

    [sha256]                                # of the Python files under effects_from
    "/home/me/my_effects.py" = "9c1a..."

    [start]                                 # figures of the first model in SI, with all digits
    held_out_rms_mps2 = 1.4e-5

    [[steps]]
    added = "second-order"
    probability = 0.998                     # with which it was missing before the step
    by = "diagnosis"
    undone = false
    ...

Figures keep all their digits, so that they can be compared to the last bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement, SelectionStep
from kf_calib.effects.user import Program
from kf_calib.support.output_files import write_whole


@dataclass(frozen=True)
class Origin:
    """What an improvement was made from.

    name: of the recording. sha256: fingerprint of the recording. options: those of the command line. programs: Python
    files with effects.
    """

    name: str
    sha256: str
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    programs: tuple[Program, ...] = ()


def figures(diagnosis: Diagnosis) -> dict[str, float]:
    """The p-value, the errors, and every parameter with its sigma (SI)."""
    result, values = diagnosis.before, dict[str, float | None]()
    values |= {
        "p_value": diagnosis.test.p_value,
        "residual_rms_mps2": result.residual_rms_mps2,
        "held_out_rms_mps2": result.held_out_rms_mps2,
        "held_out_floor_mps2": result.held_out_floor_mps2,
    }
    for parameter in result.parameters.values():
        values |= {parameter.symbol: parameter.value, f"sigma {parameter.symbol}": parameter.sigma}
    return {key: value for key, value in values.items() if value is not None}


def write_journal(path: Path, state: Improvement, origin: Origin) -> None:
    """Write a journal of the steps so far.

    An existing file of that name is replaced as a whole; it is never left half written.
    """
    from importlib.metadata import version

    import tomli_w

    table: dict[str, Any] = {
        "version": version("kf_calib"),
        "stopped_because": state.because,
        "reason": state.reason,
        "model": list(state.effects),
        "recording": {"name": origin.name, "sha256": origin.sha256},
        "options": {**origin.options, "effects_from": [str(each.path) for each in origin.programs]},
        "sha256": {str(each.path): each.sha256 for each in origin.programs},
        "start": figures(state.start),
        "steps": [_entry(step) for step in state.history],
    }
    head = "# Journal of kf-calib improve\n"
    write_whole(path, (head + tomli_w.dumps(table)).encode())


def _entry(step: SelectionStep) -> dict[str, Any]:
    """Return the table of one step."""
    entry: dict[str, Any] = {} if step.added is None else {"added": step.added}
    entry |= {} if step.probability is None else {"probability": step.probability}
    tests = [vars(each) for each in step.dropped]
    return entry | {"by": step.by, "undone": step.undone, "dropped": tests, "figures": figures(step.diagnosis)}
