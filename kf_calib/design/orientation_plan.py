"""Orientations for the bench at hand: which ones, in which order, and how well the parameters will be known.

    prospect = Prospect.of_bench(bench, sigma_mps2=1e-4, readings=100, dwell_s=30.0)   # or Prospect.after(run.fit)
    search = Search(prospect, Reach(bench, {1: (-90.0, 90.0)}), aims.D)
    made = plan(search, 12, Timing(dwell_s=30.0, slew_degps=20.0))
    made.gimbal_deg, made.sigma[-1], made.d_efficiency

Whatever is a function of the information factor can be planned for (``optimality_criteria``); the sigmas predicted are
those of the filter after each dwell, the dwells in their order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from threadpoolctl import threadpool_limits

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.design import optimality_criteria
from kf_calib.design.exact_design import Search
from kf_calib.design.predicted_information import PAUSE_S, Prospect
from kf_calib.design.visit_order import Timing, middles_s, order, slews_s, time_correlation
from kf_calib.dwells.qr import triangle
from kf_calib.errors import InputError, UnobservableError
from kf_calib.estimation.measurement_model import STATE_COUNT
from kf_calib.estimation.reml import directions

_DIGITS = 2  # of an angle in deg
_LITTLE = 1  # of degrees of freedom: no judgement of a model
_WEAK = 10.0  # times the sigma by balanced directions
_MOST = 400  # dwells a plan with --fewest may have


@dataclass(frozen=True)
class Plan:
    """poses (n, k), rad, in the order they are visited."""

    search: Search
    poses: Floats
    timing: Timing

    @property
    def prospect(self) -> Prospect:
        return self.search.prospect

    @property
    def gimbal_deg(self) -> Floats:
        return np.degrees(self.poses).round(10) + 0.0

    @cached_property
    def at_s(self) -> Floats:
        """The middle of each dwell (n,), on the clock of the run so far."""
        last = self.prospect.last
        return middles_s(self.poses, self.timing) + (last.end_s + PAUSE_S if last else 0.0)

    @cached_property
    def factors(self) -> Floats:
        """What is known before the first dwell and after each, (n + 1, p, p)."""
        out = [self.prospect.start]
        for rows in self.prospect.rows(self.poses, self.at_s):
            out.append(triangle(np.vstack([out[-1], rows])))
        return np.array(out)

    @cached_property
    def sigma(self) -> Floats:
        """1 sigma (n + 1, p) of the parameters in SI, before the first dwell and after each; NaN: not determined."""
        out = optimality_criteria.sigmas(self.factors) * self.prospect.units
        return np.where([optimality_criteria.unseen(factor) for factor in self.factors], np.nan, out)

    @cached_property
    def directions(self) -> Floats:
        """Where the specific force points in the platform frame, (n, 3)."""
        force = self.prospect.stimulus(self.poses, self.at_s).force_mps2
        return force / np.linalg.norm(force, axis=1, keepdims=True)

    @cached_property
    def condition_number(self) -> float:
        """The paper's: of the readings per unit of the twelve parameters (rad, 1, g), a row for a dwell and channel.

        After a run so far: of the factor, which has its dwells, too.
        """
        if self.prospect.last is not None:
            return float(np.linalg.cond(self.factors[-1][:STATE_COUNT, :STATE_COUNT]))
        stimulus = self.prospect.stimulus(self.poses, self.at_s)
        design = self.prospect.model.columns(stimulus, self.prospect.state) @ self.prospect.transform
        return float(np.linalg.cond(design[:, :, :STATE_COUNT].reshape(-1, STATE_COUNT)))

    @cached_property
    def cost(self) -> float:
        """What the aim measures, after the last dwell."""
        return float(np.exp(self.search.aim(self.factors[-1])))

    @cached_property
    def generalised_sigma(self) -> float:
        """Geometric mean of the principal sigmas of the twelve (rad, 1, g) that this plan adds by itself."""
        rows = self.prospect.rows(self.poses, self.at_s)[:, :, :STATE_COUNT].reshape(-1, STATE_COUNT)
        return math.exp(float(optimality_criteria.D(triangle(rows))))

    @cached_property
    def papers_generalised_sigma(self) -> float:
        """The same of the paper's set, as many readings in each of its orientations."""
        covariances = papers_covariances(self.prospect)
        units = self.prospect.units[:STATE_COUNT].reshape(3, 4)
        scaled = covariances / (units[:, :, None] * units[:, None, :])
        return math.exp(float(np.linalg.slogdet(scaled)[1].sum()) / (2 * STATE_COUNT))

    @cached_property
    def _rows(self) -> Floats:
        return self.prospect.rows(self.poses)

    @cached_property
    def _everywhere(self) -> Search:
        return self.search.without_limits()

    @cached_property
    def d_efficiency(self) -> float:
        """(det M / det M*)^(1/p), at least: M* the best information of as many dwells, no limits on the gimbals."""
        return self._efficiency(self._everywhere)

    @cached_property
    def d_efficiency_within_reach(self) -> float:
        """The same where M* keeps the limits."""
        return self._efficiency(replace(self.search, scheme=type(self.search.scheme)()))

    def _efficiency(self, search: Search) -> float:
        own = -2.0 * float(optimality_criteria.D(search.factor(self._rows)))
        return math.exp(own - search.d_bound(self._rows))

    @cached_property
    def largest_variance(self) -> float:
        """N max_x tr(I(x) M^-1) + tr(M0 M^-1), no limits on the gimbals; the number of parameters where D-optimal."""
        known, largest = self._everywhere.variance_function(self._rows, self._everywhere.candidates)
        return known + len(self.poses) * largest

    @cached_property
    def balanced_sigma(self) -> Floats | None:
        """1 sigma (p,) in SI by as many dwells in balanced directions; of white noise the closed form
        sigma sqrt(3/N)/g of angles and scale factors, sigma/sqrt(N) of biases. None with effects in the model."""
        balanced = self.prospect.balanced(len(self.poses))
        return (
            None if balanced is None else optimality_criteria.sigmas(self.search.factor(balanced)) * self.prospect.units
        )

    @cached_property
    def correlation(self) -> float:
        """Multiple correlation of the times of the visits with the direction of gravity, 0 to 1."""
        return time_correlation(self.at_s, self.directions)

    @cached_property
    def slews_s(self) -> Floats:
        """Seconds of the slews between the dwells (n - 1,), and to the first where the platform stands somewhere."""
        last = self.prospect.last
        way = self.poses if last is None else np.vstack([last.pose, self.poses])
        return slews_s(way[1:], way[:-1], self.timing.slew_degps)

    @property
    def duration_s(self) -> float:
        return float(len(self.poses) * self.timing.dwell_s + self.slews_s.sum())

    @cached_property
    def remarks(self) -> list[str]:
        """What a reader of the plan must know, one sentence each."""
        said = list[str]()
        through = int(self.search.reach.crosses(self.poses[:-1], self.poses[1:]).sum())
        if through:
            said.append(f"{through} of the slews would lead straight through a forbidden zone: go round it.")
        if self.correlation > self.timing.correlation + 0.005 and len(self.poses) > 1:
            said.append(
                f"time goes with the direction of gravity (correlation {self.correlation:.2f}), so a drift would pass "
                "for a change of the parameters: visit more orientations, or repeat them (--repeats 2)."
            )
        return [*said, *self._weaknesses()]

    def _weaknesses(self) -> Iterator[str]:
        """Where a plan from nothing leaves little to go by."""
        if self.prospect.last is not None:
            return
        different, count = directions(self.directions), len(self.prospect.symbols)
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
                f"{self.prospect.symbols[worst]} is known {worse[worst]:.2g} times worse than by as many dwells in "
                "directions that are spread, and what the model or the angles are off by goes into it as much: widen "
                "what the gimbals reach (--limit, --forbid, --positions), or choose another --criterion."
            )


def plan(search: Search, count: int, timing: Timing, seed: int = 0) -> Plan:
    """The plan of ``count`` dwells; raises UnobservableError where it would leave parameters unseen, naming them."""
    copies = search.scheme.copies
    if count < 1 or count % copies:
        raise InputError(f"{count} dwells are no whole number of {copies} visits each: ask for a multiple of {copies}.")
    with threadpool_limits(1, user_api="blas"):  # small decompositions
        search.refuse_unseen()
        adaptive = count == 1 and search.prospect.last is not None
        chosen = search.next()[None] if adaptive else search.best(count // copies)
        poses = _rounded(search, search.scheme.visits(chosen))
        made = Plan(search, _ordered(search, poses, timing, seed), timing)
        if search.reach.continuous and search.prospect.model.bench.reference == "inertial" and copies == 1:
            sequence = replace(search, at_s=made.at_s)  # gravity turns on while the visits follow each other
            made = Plan(search, _rounded(search, sequence.polished(made.poses)), timing)
        _refuse_unseen(made)
        return made


def fewest(search: Search, timing: Timing, seed: int = 0, on_try: Callable[[int], None] = lambda count: None) -> Plan:
    """The plan of fewest dwells whose aim, relative sigmas, is at most 1 (``optimality_criteria.minimax`` of what is
    tolerated)."""
    copies, tried = search.scheme.copies, dict[int, float]()

    def ratio(count: int) -> float:
        """What the best ``count`` orientations measure."""
        if count not in tried:
            on_try(count * copies)
            enough = not optimality_criteria.unseen(search.factor(search.candidate_rows[search.exchanged(count)])).any()
            tried[count] = math.exp(search.measure(search.best(count))) if enough else math.inf
        return tried[count]

    with threadpool_limits(1, user_api="blas"):
        search.refuse_unseen()
        count = 1
        while (excess := ratio(count)) > 1.0:
            # sigma falls with the root of the number at best: a step by that never goes too far without a prior
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


def papers_covariances(prospect: Prospect) -> Floats:
    """Covariances (3, 4, 4) in SI of each accelerometer's four parameters by the paper's optimal set: four orientations
    for each alone."""
    parameters = paper_parameters.nominal(prospect.model.bench.nominal)
    force = prospect.model.bench.gravity_mps2 * paper_parameters.optimal_directions(parameters)
    made = paper_parameters.design(force, parameters)
    inverse = np.linalg.inv(np.swapaxes(made, 1, 2) @ made)
    return inverse * (prospect.noise.effective_sigma_mps2**2 / prospect.readings)[:, None, None]


def papers_sigma(prospect: Prospect) -> Floats:
    """1 sigma (12,) in SI by the paper's optimal set."""
    return np.sqrt(np.einsum("ijj->ij", papers_covariances(prospect))).ravel()


def _rounded(search: Search, poses: Floats) -> Floats:
    """Angles that can be dialled, still within the limits."""
    if not search.reach.continuous:
        return poses
    rounded = np.radians(np.degrees(poses).round(_DIGITS))
    low, high = search.reach.bounds.T
    rounded = np.clip(rounded, low, high)
    return np.where(search.reach.allowed(rounded)[:, None], rounded, poses)


def _ordered(search: Search, poses: Floats, timing: Timing, seed: int) -> Floats:
    last, bench = search.prospect.last, search.prospect.model.bench
    force = bench.specific_force(np.zeros(len(poses)), poses)
    return poses[order(poses, force, timing, search.reach, last.pose if last else None, seed)]


def _refuse_unseen(made: Plan) -> None:
    lost = optimality_criteria.unseen(made.factors[-1])
    if lost.any():
        names = ", ".join(symbol for symbol, own in zip(made.prospect.symbols, lost, strict=True) if own)
        raise UnobservableError(f"{len(made.poses)} dwells leave {names} undetermined: plan more of them (--count).")
