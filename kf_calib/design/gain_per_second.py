"""Which orientation next, and for how long: the largest gain per second, with the slew and the settling in the time.

What is still missing of the targets is measured by G = ln(mean over targets of max(sigma / target, 1)^2) / 2, which is
zero when all are reached. A stay gains the fall of G that it is expected to bring. Where the noise of a mean falls with
the length of a stay and its scatter does not, the best stay is about sqrt(white / scatter x time to get there).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.design.gimbal_limits import Reach
from kf_calib.design.next_orientation import factor_of, is_elsewhere, poses_within, root_after, sigmas_of
from kf_calib.design.predicted_information import Prospect
from kf_calib.design.safe_path import can_be_reached
from kf_calib.dwells.qr import triangle
from kf_calib.estimation.fit import Fit

STAYS_S = (2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 96.0)
"""Lengths of a stay that are compared, s, of readings that count."""


@dataclass(frozen=True)
class Pace:
    """How fast a bench is.

    rate_degps, acceleration_degps2: of its gimbals. overhead_s: what a stay takes beside the readings that count, s:
    until the platform stands, has settled, and is told to go on.
    """

    rate_degps: float = 20.0
    acceleration_degps2: float = 40.0
    overhead_s: float = 2.5

    def slews_s(self, start: Floats, end: Floats) -> Floats:
        """Durations of slews between poses (..., k), rad, in s: that of the gimbal with the longest way."""
        way = np.degrees(np.abs(start - end)).max(axis=-1)
        rising = self.rate_degps / self.acceleration_degps2
        short = way < self.rate_degps * rising
        return np.where(short, 2.0 * np.sqrt(way / self.acceleration_degps2), way / self.rate_degps + rising)


@dataclass(frozen=True)
class Stay:
    """A stay in an orientation (k,), rad, for ``stay_s`` of readings that count; ``seconds`` is all the time that it
    takes. sigma (12,): what is expected after it."""

    pose: Floats
    stay_s: float
    seconds: float
    sigma: Floats


@dataclass(frozen=True)
class Outlook:
    """What further stays will bring.

    fitted: the run so far. wanted (12,): targets of the sigmas, infinite where there is none. pending: poses (k,) and
    seconds of readings that are not in ``fitted``; the last of them is where the platform stands. reach, pace: of the
    bench.
    """

    fitted: Fit
    wanted: Floats
    pending: Sequence[tuple[Floats, float]]
    reach: Reach
    pace: Pace

    @cached_property
    def _prospect(self) -> Prospect:
        return replace(Prospect.following(self.fitted), noise=self.fitted.noise)

    @cached_property
    def rate_hz(self) -> float:
        """Readings a second."""
        seconds = sum(dwell.end_s - dwell.start_s for dwell in self.fitted.dwells)
        return sum(dwell.count for dwell in self.fitted.dwells) / max(seconds, 1e-9)

    def _rows(self, poses: Floats, seconds: float) -> Floats:
        """Return the whitened rows (m, 3, p) of a stay at each pose (m, k)."""
        readings = max(self.rate_hz * seconds, 1.0)
        return replace(self._prospect, readings=readings).columns([], poses)

    @cached_property
    def _root(self) -> Floats:
        """Return a root of the covariance with the pending stays included; of the size of g where nothing is known."""
        factor, linearised = factor_of(self.fitted), self.fitted.linearised
        rows = [self._rows(pose[None], seconds)[0] for pose, seconds in self.pending if seconds > 0.0]
        at_least = np.diag(1.0 / np.maximum(linearised.sizes, 1.0))
        return np.asarray(np.linalg.inv(triangle(np.vstack([factor, at_least, *rows]))), float)

    @cached_property
    def _jacobian(self) -> Floats:
        return paper_parameters.jacobian(self.fitted.linearised.state[:STATE_COUNT])

    @cached_property
    def sigma(self) -> Floats:
        """Sigmas (12,) with the pending stays included."""
        return sigmas_of(self._root, self._jacobian)

    def missing(self, sigma: Floats) -> Floats:
        """G (...) of sigmas (..., 12); zero where all targets are reached."""
        ratios = sigma[..., np.isfinite(self.wanted)] / self.wanted[np.isfinite(self.wanted)]
        return np.asarray(0.5 * np.log(np.mean(np.maximum(ratios, 1.0) ** 2, axis=-1)))

    def best(self, stays_s: Sequence[float] = STAYS_S) -> Stay | None:
        """The stay with the largest gain per second; None where no other orientation can be reached."""
        here = self.pending[-1][0]
        poses = poses_within(self.reach)
        poses = poses[is_elsewhere(poses, here)]
        poses = poses[can_be_reached(self.reach, here, poses)]
        if not len(poses):
            return None
        going_s, before = self.pace.slews_s(here, poses) + self.pace.overhead_s, self.missing(self.sigma)
        stays = list[tuple[float, Stay]]()
        for stay_s in stays_s:
            sigma = sigmas_of(root_after(self._root, self._rows(poses, stay_s)), self._jacobian)
            rates = (before - self.missing(sigma)) / (going_s + stay_s)
            k = int(np.argmax(rates))
            stays.append((float(rates[k]), Stay(poses[k], stay_s, float(going_s[k] + stay_s), sigma[k])))
        return max(stays, key=lambda stay: stay[0])[1]

    def share_s(self, poses: Floats, stays_s: Sequence[float] = STAYS_S) -> float:
        """How long to stay in each of the poses (n, k) that are to be visited anyway, s.

        The length with which the targets are expected soonest: if they are missed after the last pose, the time is
        taken to grow with the variance.
        """
        way = np.vstack([self.pending[-1][0], poses])
        going_s = float(self.pace.slews_s(way[:-1], way[1:]).sum()) + len(poses) * self.pace.overhead_s
        expected_s = list[float]()
        for stay_s in stays_s:
            rows = self._rows(poses, stay_s).reshape(-1, len(self._root))
            sigma = sigmas_of(root_after(self._root, rows[None])[0], self._jacobian)
            worst = float(np.max(sigma / self.wanted))
            expected_s.append((going_s + len(poses) * stay_s) * max(worst, 1.0) ** 2)
        return stays_s[int(np.argmin(expected_s))]
