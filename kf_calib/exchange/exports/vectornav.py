"""VectorNav: the command that writes register 25, acceleration compensation.

    f = C (reading - B)

Bias first, then the matrix, row by row (VN-100 user manual, "Acceleration Compensation"). Units: m/s^2. It comes on top
of the calibration of the factory, so the readings that are calibrated must be those with register 25 at its default.
The register holds reals of 32 bits. The sensor keeps it over a restart after $VNWNV*57.
"""

from __future__ import annotations

import math
from functools import reduce
from operator import xor

from kf_calib.exchange.exports.affine import AffineTarget


def _decimal(number: float) -> str:
    """The number without an exponent, to nine decimals or, where it is small, nine digits."""
    exponent = math.floor(math.log10(abs(number))) if number else 0
    return f"{number:.{max(9, 8 - exponent)}f}"


class VectorNav(AffineTarget):
    """Matrix and offset."""

    title = "VectorNav"

    def text(self) -> str:
        numbers = [*self.affine.matrix.ravel(), *self.affine.offset]
        command = ",".join(["VNWRG", "25", *map(_decimal, numbers)])
        return f"${command}*{reduce(xor, command.encode()):02X}\r\n"
