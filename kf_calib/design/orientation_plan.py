"""Plans of a calibration: which orientations, in which order, and how well the parameters will be known.

  information = PredictedInformation.of_bench(bench, sigma_mps2=1e-4, readings=100, dwell_s=30.0)  # or after(run.fit)
  search = Search(information, GimbalLimits(bench, {1: (-90.0, 90.0)}), optimality_criteria.D)
  made = plan(search, 12, Timing(dwell_s=30.0, slew_degps=20.0))
  made.gimbal_deg, made.sigma[-1], made.d_efficiency

Any function of the information factor can be planned for (``optimality_criteria``). The predicted sigmas are those of
the filter after each dwell, in the order of the plan.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.design import optimality_criteria
from kf_calib.design.exact_design import Search
from kf_calib.design.gimbal_limits import Timing, middles_s, order, slews_s, time_correlation
from kf_calib.design.predicted_information import PAUSE_S, PredictedInformation
from kf_calib.dwells.qr import triangle
from kf_calib.errors import InputError, UnobservableError
from kf_calib.noise.reml import directions

_DIGITS = 2  # decimals of an angle in deg
_LITTLE = 1  # with so few degrees of freedom the model cannot be judged
_WEAK = 10.0  # relative to the sigma with balanced directions
_MOST = 400  # largest number of dwells with --fewest


@dataclass(frozen=True)
class Plan:
    """A plan with its poses (n, k), rad, in the order of the visits."""

    search: Search
    poses: Floats
    timing: Timing

    @property
    def information(self) -> PredictedInformation:
        """The predicted information of the search."""
        return self.search.information

    @property
    def gimbal_deg(self) -> Floats:
        """The gimbal angles (n, k), deg."""
        return np.degrees(self.poses).round(10) + 0.0

    @cached_property
    def at_s(self) -> Floats:
        """Middles of the dwells (n,), s, on the clock of the run so far."""
        last = self.information.last
        return middles_s(self.poses, self.timing) + (last.end_s + PAUSE_S if last else 0.0)

    @cached_property
    def factors(self) -> Floats:
        """Information factors (n + 1, p, p) before the first dwell and after each."""
        factors = [self.information.start]
        for rows in self.information.rows(self.poses, self.at_s):
            factors.append(triangle(np.vstack([factors[-1], rows])))
        return np.array(factors)

    @cached_property
    def sigma(self) -> Floats:
        """Sigmas (n + 1, p) of the parameters in SI before the first dwell and after each; NaN if not determined."""
        out = optimality_criteria.sigmas(self.factors) * self.information.units
        return np.where([optimality_criteria.is_unseen(factor) for factor in self.factors], np.nan, out)

    @property
    def targets(self) -> Floats:
        """Sigmas (p,) in SI that the plan aims at; infinite where none is asked for."""
        targets, asked = np.full(len(self.information.units), np.inf), self.search.aim.tolerated
        if asked is not None:
            targets[:STATE_COUNT] = asked * self.information.units[:STATE_COUNT]
        return targets

    @cached_property
    def directions(self) -> Floats:
        """Unit vectors (n, 3) of the specific force in the platform frame."""
        force = self.information.stimulus(self.poses, self.at_s).force_mps2
        return force / np.linalg.norm(force, axis=1, keepdims=True)

    @cached_property
    def condition_number(self) -> float:
        """The paper's condition number: that of the readings' derivatives by the twelve parameters (rad, 1, g).

        For a plan that continues a run it is that of the factor, which includes the run's dwells.
        """
        if self.information.last is not None:
            return float(np.linalg.cond(self.factors[-1][:STATE_COUNT, :STATE_COUNT]))
        stimulus = self.information.stimulus(self.poses, self.at_s)
        design = self.information.model.columns(stimulus, self.information.state) @ self.information.transform
        return float(np.linalg.cond(design[:, :, :STATE_COUNT].reshape(-1, STATE_COUNT)))

    @cached_property
    def cost(self) -> float:
        """The quantity that the aim measures, after the last dwell."""
        return float(np.exp(self.search.aim(self.factors[-1])))

    @cached_property
    def generalised_sigma(self) -> float:
        """Geometric mean of the principal sigmas of the twelve (rad, 1, g) from this plan alone."""
        rows = self.information.rows(self.poses, self.at_s)[:, :, :STATE_COUNT].reshape(-1, STATE_COUNT)
        return math.exp(float(optimality_criteria.D(triangle(rows))))

    @cached_property
    def papers_generalised_sigma(self) -> float:
        """The same for the paper's optimal set with as many readings in each of its orientations."""
        covariances = papers_covariances(self.information)
        units = self.information.units[:STATE_COUNT].reshape(3, 4)
        scaled = covariances / (units[:, :, None] * units[:, None, :])
        return math.exp(float(np.linalg.slogdet(scaled)[1].sum()) / (2 * STATE_COUNT))

    @cached_property
    def _rows(self) -> Floats:
        """Return the whitened rows of the plan's dwells."""
        return self.information.rows(self.poses)

    @cached_property
    def _everywhere(self) -> Search:
        """Return the search without limits of the gimbals."""
        return self.search.without_limits()

    @cached_property
    def d_efficiency(self) -> float:
        """A lower bound of the D-efficiency (det M / det M*)^(1/p), where M* is the best information of as many dwells
        without limits of the gimbals."""
        return self._efficiency(self._everywhere)

    @cached_property
    def d_efficiency_within_reach(self) -> float:
        """The same where M* observes the limits."""
        return self._efficiency(replace(self.search, scheme=type(self.search.scheme)()))

    def _efficiency(self, search: Search) -> float:
        """Return a lower bound of the D-efficiency relative to the best design of a search."""
        own = -2.0 * float(optimality_criteria.D(search.factor(self._rows)))
        return math.exp(own - search.d_bound(self._rows))

    @cached_property
    def largest_variance(self) -> float:
        """N max_x tr(I(x) M^-1) + tr(M0 M^-1) without limits of the gimbals; the number of parameters if the plan is
        D-optimal."""
        known, largest = self._everywhere.variance_function(self._rows, self._everywhere.candidates)
        return known + len(self.poses) * largest

    @cached_property
    def balanced_sigma(self) -> Floats | None:
        """Sigmas (p,) in SI from as many dwells in balanced directions; None if there are effects in the model.

        In white noise these are sigma sqrt(3/N)/g for angles and scale factors and sigma/sqrt(N) for biases.
        """
        balanced = self.information.balanced(len(self.poses))
        return (
            None
            if balanced is None
            else optimality_criteria.sigmas(self.search.factor(balanced)) * self.information.units
        )

    @cached_property
    def correlation(self) -> float:
        """Multiple correlation of the times of the visits with the direction of gravity, 0 to 1."""
        return time_correlation(self.at_s, self.directions)

    @cached_property
    def slews_s(self) -> Floats:
        """Durations of the slews between the dwells (n - 1,), s, preceded by that to the first if the present pose is
        known."""
        last = self.information.last
        way = self.poses if last is None else np.vstack([last.pose, self.poses])
        return slews_s(way[1:], way[:-1], self.timing.slew_degps)

    @property
    def duration_s(self) -> float:
        """Duration of the whole plan, s."""
        return float(len(self.poses) * self.timing.dwell_s + self.slews_s.sum())

    @cached_property
    def remarks(self) -> list[str]:
        """One sentence on each thing that a reader of the plan must know."""
        sentences = list[str]()
        through = int(self.search.limits.crosses(self.poses[:-1], self.poses[1:]).sum())
        if through:
            sentences.append(f"{through} of the slews would lead straight through a forbidden zone: go round it.")
        if self.correlation > self.timing.correlation + 0.005 and len(self.poses) > 1 and self.information.last is None:
            sentences.append(
                f"time goes with the direction of gravity (correlation {self.correlation:.2f}), so a drift would pass "
                "for a change of the parameters: visit more orientations, or repeat them (--repeats 2)."
            )
        return [*sentences, *self._weaknesses()]

    def _weaknesses(self) -> Iterator[str]:
        """Yield the weaknesses of a plan that does not continue a run."""
        if self.information.last is not None:
            return
        different, count = directions(self.directions), len(self.information.symbols)
        left = 3 * different - count
        if left <= _LITTLE:
            over = f"only {left} is" if left > 0 else "nothing is"
            yield (
                f"{different} directions of gravity × 3 readings = {3 * different} for {count} parameters: {over} left "
                "over to judge the model by: visit more orientations."
            )
        worse = np.ones(count) if self.balanced_sigma is None else self.sigma[-1] / self.balanced_sigma
        worst = int(np.argmax(worse))
        if worse[worst] > _WEAK:
            yield (
                f"{self.information.symbols[worst]} is known {worse[worst]:.2g} times worse than by as many dwells in "
                "directions that are spread, and what the model or the angles are off by goes into it as much: widen "
                "what the gimbals reach (--limit, --forbid, --positions), or choose another --criterion."
            )


def plan(search: Search, count: int, timing: Timing, seed: int = 0) -> Plan:
    """The plan of ``count`` dwells; raises UnobservableError, naming them, if parameters would remain undetermined."""
    copies = search.scheme.copies
    if count < 1 or count % copies:
        raise InputError(f"{count} dwells are no whole number of {copies} visits each: ask for a multiple of {copies}.")
    with one_blas_thread():
        search.refuse_unseen()
        adaptive = count == 1 and search.information.last is not None
        chosen = search.next()[None] if adaptive else search.best(count // copies)
        poses = _rounded(search, search.scheme.visits(chosen))
        last, bench = search.information.last, search.information.model.bench
        force = bench.specific_force(np.zeros(len(poses)), poses)
        poses = poses[order(poses, force, timing, search.limits, last.pose if last else None, seed)]
        ordered = Plan(search, poses, timing)
        if search.limits.continuous and bench.reference == "inertial" and copies == 1:
            sequence = replace(search, at_s=ordered.at_s)  # gravity turns with the Earth during the plan
            ordered = Plan(search, _rounded(search, sequence.polish(ordered.poses)), timing)
        _refuse_unseen(ordered)
        return ordered


def fewest(search: Search, timing: Timing, seed: int = 0) -> Plan:
    """The plan with the fewest dwells whose aim, relative sigmas, is at most 1 (``optimality_criteria.minimax``).

    Raises InputError if too many dwells would be needed.
    """
    copies, tried = search.scheme.copies, dict[int, float]()

    def ratio(count: int) -> float:
        """Return the aim of the best ``count`` orientations; infinite if they leave parameters undetermined."""
        if count not in tried:
            enough = not optimality_criteria.is_unseen(
                search.factor(search.candidate_rows[search.exchange(count)])
            ).any()
            tried[count] = math.exp(search.measure(search.best(count))) if enough else math.inf
        return tried[count]

    with one_blas_thread():
        search.refuse_unseen()
        count = 1
        while (excess := ratio(count)) > 1.0:
            # sigma falls at best with the root of the number, so that without a prior such a step never goes too far
            guess = count + 1 if math.isinf(excess) else max(math.floor(count * excess**2), count + 1)
            if guess * copies > _MOST:
                raise InputError(
                    f"the targets need about {guess * copies} dwells of {timing.dwell_s:g} s: dwell longer "
                    "(--dwell-s), or allow larger sigmas."
                )
            count = guess
        while count > 1 and ratio(count - 1) <= 1.0:
            count -= 1
    return plan(search, count * copies, timing, seed)


def papers_covariances(information: PredictedInformation) -> Floats:
    """Covariances (3, 4, 4) in SI of each accelerometer's four parameters from its own four orientations in the paper's
    optimal set."""
    parameters = paper_parameters.nominal(information.model.bench.nominal)
    force = information.model.bench.gravity_mps2 * paper_parameters.optimal_directions(parameters)
    design = paper_parameters.design(force, parameters)
    inverse = np.linalg.inv(np.swapaxes(design, 1, 2) @ design)
    return inverse * (information.noise.effective_sigma_mps2**2 / information.readings)[:, None, None]


def papers_sigma(information: PredictedInformation) -> Floats:
    """Sigmas (12,) in SI from the paper's optimal set."""
    return np.sqrt(np.einsum("ijj->ij", papers_covariances(information))).ravel()


def _rounded(search: Search, poses: Floats) -> Floats:
    """Return angles rounded to what can be dialled, within the limits."""
    if not search.limits.continuous:
        return poses
    rounded = np.radians(np.degrees(poses).round(_DIGITS))
    low, high = search.limits.bounds.T
    rounded = np.clip(rounded, low, high)
    return np.where(search.limits.allowed(rounded)[:, None], rounded, poses)


def _refuse_unseen(plan: Plan) -> None:
    """Raise UnobservableError if the plan leaves parameters undetermined."""
    lost = optimality_criteria.is_unseen(plan.factors[-1])
    if lost.any():
        names = ", ".join(symbol for symbol, own in zip(plan.information.symbols, lost, strict=True) if own)
        raise UnobservableError(f"{len(plan.poses)} dwells leave {names} undetermined: plan more of them (--count).")
