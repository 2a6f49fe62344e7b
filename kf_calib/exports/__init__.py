"""A calibration in the form of another program: a module for each, with the formula of that program.

    exports.exported(saved, correction, "px4", lossy=True).text()

All give specific force in the frame of the block, m/s^2, from raw readings as the device sends them; those that have
no room for order, sign and size take readings in m/s^2, and say how to make them.
"""

from __future__ import annotations

from kf_calib.bench.counts import SIGNED
from kf_calib.errors import InputError
from kf_calib.estimation.correction import Correction
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exports.affine import ArduPilot, Imucal, ImuCalib, ImuTk, Kalibr, OpenVins, Px4, VectorNav
from kf_calib.exports.c_header import CHeader
from kf_calib.exports.target import CsvTable, Target
from kf_calib.support.units import shown

TARGETS: dict[str, type[Target]] = {
    "px4": Px4, "ardupilot": ArduPilot, "imucal": Imucal, "imu_calib": ImuCalib, "kalibr": Kalibr,
    "openvins": OpenVins, "imu_tk": ImuTk, "vectornav": VectorNav, "csv": CsvTable, "c": CHeader,
}  # fmt: skip


def exported(saved: SavedCalibration, correction: Correction, to: str, lossy: bool = False) -> Target:
    """A calibration in the form of the program ``to``.

    Raises InputError where the program cannot hold all of it, with the size of the error that is left, unless
    ``lossy``.
    """
    if correction.input.counts != SIGNED:
        raise InputError(
            f"the device sends {correction.input}, and what is exported takes numbers about zero: have the device send "
            "such, and calibrate with those; apply takes what it sends now."
        )
    target = TARGETS[to](saved, correction)
    if target.to_be_done_before and not lossy:
        raise InputError(
            f"{target.title} takes readings in m/s^2 in the order of the accelerometers, but the device sends "
            f"{correction.input}. If you convert them before they go in ({target.to_be_done_before}), confirm it by "
            "--lossy; or export to c or csv, which take what the device sends."
        )
    if target.error_left is not None and not lossy:
        unit, (rms, worst) = shown("m/s^2"), target.error_left
        raise InputError(
            f"{target.title} cannot hold {', '.join(target.lost)}, which leaves an error of {unit.text(rms)} rms and "
            f"{unit.text(worst)} at worst over all directions of gravity{_range(target)}: accept it with --lossy, or "
            "export to c or csv, which hold all."
        )
    return target


def _range(target: Target) -> str:
    """The temperatures, where they matter."""
    if not target.correction.needs_temperature:
        return ""
    return f" at {target.grid.low_c:.1f} to {target.grid.high_c:.1f} °C"
