"""The information that future dwells will give: their whitened rows for any orientation, before it is visited.

The states are the paper's parameters about their expected values, in rad, 1 and g, then the coefficients of effects in
their scale. A row is whitened by its noise: that of the readings, averaged over the dwell, and the dwell's setting
error and scatter (``noise_model.mean_covariances``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.qr import triangle
from kf_calib.dwells.stationarity import Stillness
from kf_calib.effects import Effect, Stimulus
from kf_calib.estimation import square_root_information
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import Model, effect_columns
from kf_calib.estimation.settings import Prior
from kf_calib.noise import random_walk
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import Noise, considered_information, lift_rounding, mean_covariances
from kf_calib.noise.terms import Scatter, SettingError

PAUSE_S = 60.0
"""Pause before the first dwell of a plan that continues a run, and between dwells if the run has a single dwell."""

_SINCE_ARRIVAL_S = 15.0


def _icosahedron() -> Floats:
    """Return the vertices (12, 3) of an icosahedron; means over them of polynomials up to degree 5 equal those over the
    sphere."""
    golden = 0.5 * (1.0 + math.sqrt(5.0))
    corners = np.array([[0.0, one, other * golden] for one in (1.0, -1.0) for other in (1.0, -1.0)])
    return np.concatenate([np.roll(corners, k, axis=1) for k in range(3)]) / math.hypot(1.0, golden)


_ICOSAHEDRON = _icosahedron()


@dataclass(frozen=True)
class Last:
    """The dwell before the future ones.

    - end_s: when it ended.
    - pose (k,), force_mps2 (3,), temperature_c: its conditions.
    - variance_mps2_2 (3,): variances of its readings.
    """

    end_s: float
    pose: Floats
    force_mps2: Floats
    temperature_c: float = math.nan
    variance_mps2_2: Floats = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True)
class PredictedInformation:
    """The expected measurements of future dwells.

    - model, state (p,): what is estimated, and where it is linearised.
    - noise, readings, dwell_s: noise, number of readings and duration of a dwell.
    - known (p, p): information factor of what is known already; zeros for nothing.
    - last: the dwell before; None if there is none.
    - pause_s: time from its end to the beginning of the next dwell.
    """

    model: Model
    state: Floats
    noise: Noise
    readings: float
    dwell_s: float
    known: Floats
    last: Last | None = None
    pause_s: float = PAUSE_S

    @classmethod
    def of_bench(cls, bench: Bench, sigma_mps2: float, readings: float, dwell_s: float) -> PredictedInformation:
        """The information of a run that has not begun: nothing is known, and dwells scatter as the bench states."""
        model = Model(bench)
        scatter = np.full(3, bench.scatter_sigma_mps2 or 0.0)
        setting_rad = math.radians(bench.angle_sigma_deg or 0.0)
        terms = SettingError(setting_rad, stated=True), Scatter(scatter, stated=True)
        noise = Noise(np.full(3, sigma_mps2), np.ones(3), terms)
        return cls(model, model.nominal_state(), noise, readings, dwell_s, np.zeros((model.count, model.count)))

    @classmethod
    def following(cls, fitted: Fit) -> PredictedInformation:
        """The information after a run so far, with dwells like those of the run; the information from the run is not
        included."""
        linearised, last = fitted.linearised, fitted.dwells[-1]
        dwell_s = float(np.median(np.diff(fitted.dwells.folded.ends_s)))
        temperature_c = float(last.pieces.nodes.temperature_c[-1])
        before = Last(last.end_s, last.pose, last.means[1:4], temperature_c, fitted.dwells.folded.variances[-1])
        readings, nothing = float(np.median(linearised.means.counts)), np.zeros((linearised.model.count,) * 2)
        ends_s = fitted.dwells.folded.ends_s
        pause_s = float(np.median(ends_s[1:, 0] - ends_s[:-1, 1])) if len(ends_s) > 1 else PAUSE_S
        return cls(linearised.model, linearised.state, fitted.noise, readings, dwell_s, nothing, before, pause_s)

    @classmethod
    def after(cls, fitted: Fit, prior: Prior | None = None) -> PredictedInformation:
        """The information after a run so far, with the information from it: the filter's own factor."""
        linearised, noise, following = fitted.linearised, fitted.noise, replace(cls.following(fitted), pause_s=PAUSE_S)
        first = square_root_information.start(prior or Prior(), linearised.model)
        steps = square_root_information.run(first, fitted.rows(), fitted.steps, fitted.following)
        waited = noise.walk_mps2_per_sqrt_s**2 * (following.pause_s + following.dwell_s / 3.0)
        known = random_walk.predict(steps[-1].factor, waited)[:, :-1]
        more = considered_information(noise, linearised.means, linearised.state).sum(axis=0) + fitted.considered
        return replace(following, known=_less(known, more))

    @cached_property
    def units(self) -> Floats:
        """Size (p,) in SI of the unit of each state: rad, 1, g, and the scale of effects."""
        scales = np.array([coefficient.scale for coefficient in self.model.coefficients])
        return np.append(np.tile([1.0, 1.0, 1.0, self.model.bench.gravity_mps2], 3), scales)

    @cached_property
    def transform(self) -> Floats:
        """The Jacobian d affine state / d state of the information, (p, p)."""
        jacobian = np.diag(self.units)
        twelve = paper_parameters.sensitivity_jacobian(paper_parameters.parameters_of(self.state[:STATE_COUNT]))
        jacobian[:STATE_COUNT, :STATE_COUNT] = twelve * self.units[:STATE_COUNT]
        return jacobian

    @cached_property
    def start(self) -> Floats:
        """Information factor (p, p) of what is known already, for the states of the information."""
        return triangle(self.known @ self.transform)

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols of the states."""
        return (*paper_parameters.SYMBOLS, *(coefficient.symbol for coefficient in self.model.coefficients))

    @property
    def still_s(self) -> float:
        """Duration of the part of a dwell whose readings are used, s."""
        margins = Stillness()
        return max(self.dwell_s - margins.settle_s - margins.lead_s, 0.5 * self.dwell_s)

    def rows(self, poses: Floats, at_s: Floats | None = None) -> Floats:
        """Whitened rows (n, 3, p) of dwells at poses (n, k), rad.

        ``at_s`` (n,) are the middles of consecutive dwells; without it, each pose is that of the next dwell.
        """
        stimulus = self.stimulus(poses, at_s)
        return self.whiten(self.model.columns(stimulus, self.state), stimulus) @ self.transform

    def balanced(self, count: int) -> Floats | None:
        """Whitened rows (12, 3, p) equivalent to ``count`` dwells in directions spread as the vertices of an
        icosahedron, without regard to limits.

        None if there are effects in the model, which may depend on more than the direction.
        """
        if self.model.effects:
            return None
        stimulus = self.stimulus(np.zeros((len(_ICOSAHEDRON), len(self.model.bench.axes))))
        stimulus = replace(stimulus, force_mps2=self.model.bench.gravity_mps2 * _ICOSAHEDRON)
        rows = self.whiten(self.model.columns(stimulus, self.state), stimulus) @ self.transform
        return math.sqrt(count / len(_ICOSAHEDRON)) * rows

    def columns(self, effects: Sequence[Effect], poses: Floats, wait_s: float = 0.0) -> Floats:
        """Whitened columns (n, 3, p + q) of the affine model and further effects for the next dwell at each pose.

        The dwell has the usual length but begins ``wait_s`` later after the arrival.
        """
        stimulus = self.stimulus(poses)
        since_arrival_s = stimulus.since_arrival_s + wait_s
        stimulus = replace(stimulus, elapsed_s=stimulus.elapsed_s + wait_s, since_arrival_s=since_arrival_s)
        own = self.model.columns(stimulus, self.state), effect_columns(effects, stimulus)
        return self.whiten(np.concatenate(own, axis=2), stimulus)

    def whiten(self, design: Floats, stimulus: Stimulus) -> Floats:
        """The design (n, 3, p) of dwells' means, whitened by their noise."""
        count = len(stimulus)
        means = Means(design, np.zeros((count, 3)), stimulus.force_mps2, np.full((count, 3), self.readings),
                      np.zeros((count, 2)))  # fmt: skip
        root = np.linalg.cholesky(lift_rounding(mean_covariances(self.noise, means, self.state)))
        return np.asarray(np.linalg.solve(root, design), float)

    def stimulus(self, poses: Floats, at_s: Floats | None = None) -> Stimulus:
        """The expected conditions at poses (n, k)."""
        bench, count, last = self.model.bench, len(poses), self.last
        following = at_s is not None
        if at_s is None:
            middle_s = (last.end_s + self.pause_s if last else 0.0) + 0.5 * self.dwell_s
            at_s = np.linspace(middle_s, middle_s + 0.1, count)
        force = bench.specific_force(at_s, poses)
        before = last or Last(0.0, poses[0], force[0])
        earlier = [
            np.concatenate([own[None], those[:-1] if following else np.repeat(own[None], count - 1, axis=0)])
            for own, those in ((before.force_mps2, force), (before.pose, poses))
        ]
        return Stimulus(
            bench=bench,
            elapsed_s=at_s,
            since_arrival_s=np.full(count, _SINCE_ARRIVAL_S),
            force_mps2=force,
            previous_force_mps2=earlier[0],
            pose=poses,
            previous_pose=earlier[1],
            temperature_c=np.full(count, before.temperature_c),
            sensitivity=self.state[:STATE_COUNT].reshape(3, 4)[:, :3],
            variance_mps2_2=np.repeat(before.variance_mps2_2[None], count, axis=0),
        )


def _less(factor: Floats, more: Floats) -> Floats:
    """Return the factor (p, p) of the covariance P + P B P, where B = ``more`` (p, p) is due to considered parameters
    (``noise_model.considered_information``)."""
    if not more.any() or np.linalg.matrix_rank(
        square_root_information.scale_columns(np.column_stack([factor, factor[:, :1]]))[0]
    ) < len(factor):
        return factor
    inverse = np.linalg.inv(factor)  # P = inverse inverse^T; P + P B P = inverse (1 + inverse^T B inverse) inverse^T
    inflated = np.linalg.cholesky(np.eye(len(factor)) + inverse.T @ more @ inverse)
    return triangle(np.linalg.solve(inflated, factor))
