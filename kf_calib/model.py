"""The model of the readings: columns that do not depend on the state, and the state's map onto them.

``reading_i(t) = X(t) . M_i x`` with regressors X = [1, f_x, f_y, f_z] and the state
x = (s1, b1, s2, b2, s3, b3): exactly linear for any scale factor, bias and misalignment.
A small rotation alpha of the platform (setting error) adds ``s_i . (alpha x f) = alpha . (f x s_i)``, linear in the
same regressors once the s_i are known to first order.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from kf_calib import gate, paper
from kf_calib.bench import Bench
from kf_calib.dwells import Block, Tally
from kf_calib.samples import Floats

STATE_COUNT = 12
REGRESSORS = ("1", "f_x", "f_y", "f_z")
DWELL_STATES = 6
"""Nuisance states of a dwell: three small rotations (setting error), three offsets (sensor scatter)."""


@dataclass(frozen=True, slots=True)
class Rows:
    """Model columns and readings of one block: columns (n, 4), readings (n, 3), innovation within the block (3, n).

    static: the columns are the same in every row, and the innovation is the readings less their mean.
    """

    dwell: int
    elapsed_s: Floats
    columns: Floats
    readings: Floats
    innovation: Floats
    static: bool
    pose: Floats  # (k,), the block's mean
    temperature_c: float


def state_map() -> Floats:
    """M (3, 4, 12): which state multiplies which regressor in which channel."""
    out = np.zeros((3, len(REGRESSORS), STATE_COUNT))
    for i in range(3):
        out[i, 0, 4 * i + 3] = 1.0
        out[i, 1:, 4 * i : 4 * i + 3] = np.eye(3)
    return out


def dwell_map(state: Floats) -> Floats:
    """N (3, 4, 6): the nuisance states of a dwell on the regressors, linearised at ``state``.

    Columns 0-2: rotation alpha, whose coefficient in channel i is f x s_i; columns 3-5: offset of sensor i.
    """
    out = np.zeros((3, len(REGRESSORS), DWELL_STATES))
    for i in range(3):
        sx, sy, sz = state[4 * i : 4 * i + 3]
        out[i, 1:, :3] = np.array([[0.0, -sz, sy], [sz, 0.0, -sx], [-sy, sx, 0.0]])  # (f x s) = f^T [s]
        out[i, 0, 3 + i] = 1.0
    return out


def regressors(elapsed_s: Floats, pose: Floats, bench: Bench) -> Floats:
    """X (n, 4) at ``elapsed_s`` (n,) and poses (n, k) or (1, k)."""
    still = bench.reference == "base" and len(pose) == 1
    force = bench.specific_force(elapsed_s[: 1 if still else None], pose)
    out = np.concatenate([np.ones((len(force), 1)), force], axis=1)
    return np.broadcast_to(out, (len(elapsed_s), out.shape[1]))


def model_rows(blocks: Iterable[Block], bench: Bench, tally: Tally, gate_sigma: float | None = 6.0) -> Iterator[Rows]:
    """Rows of every block, outliers gated out; the same rows feed both engines and batch least squares."""
    for block in blocks:
        elapsed_s, readings = block.elapsed_s, block.accel_mps2
        columns = regressors(elapsed_s, block.pose, bench)
        static = len(block.pose) == 1 and bench.reference == "base"
        innovation = gate.innovations(columns, readings, static)
        if gate_sigma is not None:
            keep = gate.inliers(columns, readings, innovation, static, gate_sigma)
            if keep is not None:
                tally.gated += int((~keep).sum())
                elapsed_s, columns, readings = elapsed_s[keep], columns[keep], readings[keep]
                innovation = gate.innovations(columns, readings, static)
        pose, warm = block.pose.mean(axis=0), float(block.temperature_c.mean())
        yield Rows(block.dwell, elapsed_s, columns, readings, innovation, static, pose, warm)


@dataclass(frozen=True)
class Prior:
    """What is believed before the first sample: 1 sigma of misalignment (rad), scale factor (1) and bias (m/s^2).

    ``Prior()`` is diffuse: it says nothing, and the estimate equals least squares.
    """

    misalignment_rad: float | None = None
    scale: float | None = None
    bias_mps2: float | None = None

    @property
    def diffuse(self) -> bool:
        return self.misalignment_rad is None or self.scale is None or self.bias_mps2 is None

    def covariance(self, parameters: Floats) -> Floats:
        """Covariance (12, 12) of the affine state about the nominal ``parameters`` (12,)."""
        if self.misalignment_rad is None or self.scale is None or self.bias_mps2 is None:
            raise ValueError("a diffuse prior has no covariance")
        sigma = np.array([self.misalignment_rad, self.misalignment_rad, self.scale, self.bias_mps2] * 3)
        jacobian = paper.sensitivity_jacobian(parameters)
        return jacobian @ np.diag(sigma**2) @ jacobian.T


PRIORS: dict[str, Prior] = {
    "diffuse": Prior(),
    "navigation": Prior(misalignment_rad=5e-3, scale=2e-3, bias_mps2=2e-2),
    "mems": Prior(misalignment_rad=0.1, scale=0.1, bias_mps2=1.0),
}
"""Grades a user can state; each is about twice what a sensor of that grade is sold with."""
