"""VectorNav: the command that writes register 25, acceleration compensation.

    f = C (reading - B)

Bias first, then the matrix, row by row (VN-100 user manual, "Acceleration Compensation"). Units: m/s^2. It comes on top
of the calibration of the factory, so the readings that are calibrated must be those with register 25 at its default.
The register holds reals of 32 bits. The sensor keeps it over a restart after $VNWNV*57.
"""

from __future__ import annotations

from functools import reduce
from operator import xor

from kf_calib.exchange.exports.affine import AffineTarget


class VectorNav(AffineTarget):
    """Matrix and offset."""

    title = "VectorNav"

    def text(self) -> str:
        numbers = [*self.affine.matrix.ravel(), *self.affine.offset_mps2]
        command = ",".join(["VNWRG", "25", *(f"{each:.9f}" for each in numbers)])
        return f"${command}*{reduce(xor, command.encode()):02X}\r\n"
