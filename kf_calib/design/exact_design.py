"""Exact optimal designs: the orientations that serve an aim best, and a bound on how far they are from the optimum.

The search begins by exchange over candidates and continues with scipy's L-BFGS-B over the continuous angles within
their bounds. The gradient is computed from the aim as a function of the information factor alone
(``optimality_criteria.slope``), so that any such aim can be planned for.

For D-optimality there is a bound that does not require the optimum (Kiefer and Wolfowitz, 1960). With M the information
of any design of N dwells, M0 the prior information and I(x) the information of a dwell at x,

  det M*^(1/p) <= det M^(1/p) (tr(M0 M^-1) + N max_x tr(I(x) M^-1)) / p.

Without prior information, N tr(I(x) M^-1) is the variance function; its maximum is p at the optimum and only there.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats, Ints, Mask, first_least
from kf_calib.design import optimality_criteria
from kf_calib.design.gimbal_limits import GimbalLimits, wrap
from kf_calib.design.optimality_criteria import Aim, Score
from kf_calib.design.predicted_information import PredictedInformation
from kf_calib.dwells.qr import triangle
from kf_calib.errors import InputError, UnobservableError

_TIE = 1e-3
_UNTIL = {"maxiter": 200, "ftol": 1e-11, "gtol": 1e-9}
_FIRST = 32  # the most promising candidates, which are evaluated exactly
_SWEEPS = 12
_SCATTERED, _ABOUT = 256, 48
_OTHERS = 6  # random starts of an exchange without continuous refinement
_FEW = 16  # up to this number of orientations, several starts are needed
_STEP_RAD = 1e-5
_FAINT = 1e-5  # information on each parameter at the beginning, as a share of that of all candidates
_SAME = 1e-7  # of costs of designs that the refinement leads to from several starts
_WEIGHINGS = 1000


@dataclass(frozen=True)
class Scheme:
    """The visits for each chosen orientation: ``repeats`` visits of it and, optionally, of its antipode (gravity
    reversed).

    ``turned`` is the gimbal that reverses gravity if it is rotated by 180 deg and the others are multiplied by
    ``signs``; None for no antipodes.
    """

    repeats: int = 1
    turned: int | None = None
    signs: tuple[float, ...] = ()

    @property
    def copies(self) -> int:
        """Number of visits for each orientation."""
        return self.repeats * (1 if self.turned is None else 2)

    def visits(self, poses: Floats) -> Floats:
        """Poses (copies * n, k) of orientations (n, k); the visits of one orientation are consecutive."""
        if self.turned is None:
            return np.repeat(poses, self.repeats, axis=0)
        both = np.stack([poses, self.antipodes(poses)], axis=1)
        return np.repeat(both, self.repeats, axis=0).reshape(-1, poses.shape[1])

    def antipodes(self, poses: Floats) -> Floats:
        """Poses (n, k) at which gravity is reversed."""
        other = poses * np.array(self.signs)
        other[:, self.turned] += np.pi
        return wrap(other)

    @classmethod
    def of(cls, limits: GimbalLimits, repeats: int, antipodal: bool) -> Scheme:
        """The scheme for a bench; raises InputError if antipodes are wanted and no gimbal reverses gravity."""
        if not antipodal:
            return cls(repeats)
        bench, width = limits.bench, len(limits.bench.axes)
        poses = np.random.default_rng(0).uniform(-np.pi, np.pi, (32, width))
        schemes = list[tuple[int, Scheme]]()
        for j, signs in itertools.product(range(width), itertools.product((1.0, -1.0), repeat=width)):
            scheme = cls(repeats, j, signs)
            forces = (bench.specific_force(np.zeros(32), each) for each in (poses, scheme.antipodes(poses)))
            if np.abs(sum(forces)).max() < 1e-9 * bench.gravity_mps2:
                schemes.append((int(limits.allowed(scheme.antipodes(limits.candidates)).sum()), scheme))
        if not schemes:
            raise InputError(
                "no gimbal of these axes turns gravity over by half a turn, so there are no antipodal pairs: leave out "
                "--antipodal."
            )
        return max(schemes, key=lambda each: each[0])[1]


@dataclass(frozen=True)
class Search:
    """A search for the orientations within ``limits`` that minimise ``aim``."""

    information: PredictedInformation
    limits: GimbalLimits
    aim: Aim
    scheme: Scheme = Scheme()
    at_s: Floats | None = None
    """Middles of the dwells if the orientations are a sequence of visits; None if each might be the next."""

    @cached_property
    def candidates(self) -> Floats:
        """Orientations (n, k) to choose from; of several with the same information, the one that is rotated least."""
        poses = self.limits.candidates
        if self.scheme.turned is not None:
            poses = poses[self.limits.allowed(self.scheme.antipodes(poses))]
            if not len(poses):
                raise InputError("no orientation has its antipode within the limits: leave out --antipodal.")
        rows = self.rows(poses).reshape(len(poses), -1)
        _, first = np.unique((rows / np.abs(rows).max()).round(9) + 0.0, axis=0, return_index=True)
        return poses[np.sort(first)]

    @cached_property
    def candidate_rows(self) -> Floats:
        """Whitened rows of the candidates."""
        return self.rows(self.candidates)

    def rows(self, poses: Floats) -> Floats:
        """Whitened rows (n, r, p) of all visits for each orientation (n, k)."""
        rows = self.information.rows(self.scheme.visits(poses), self.at_s)
        return rows.reshape(len(poses), -1, rows.shape[2])

    def factor(self, rows: Floats) -> Floats:
        """Information factor (p, p) of the prior information and rows (n, r, p)."""
        return triangle(np.vstack([self.information.start, rows.reshape(-1, rows.shape[-1])]))

    def refuse_unseen(self) -> None:
        """Raise UnobservableError if all candidates together leave parameters undetermined."""
        if not optimality_criteria.is_unseen(self.information.start).any():
            return
        lost = optimality_criteria.is_unseen(self.factor(self.candidate_rows))
        if lost.any():
            names = ", ".join(symbol for symbol, own in zip(self.information.symbols, lost, strict=True) if own)
            raise UnobservableError(
                f"no set of the orientations that can be reached determines {names}: widen the limits (--limit, "
                "--forbid, --positions), or add a gimbal axis."
            )

    def best(self, count: int) -> Floats:
        """The best ``count`` orientations found, (count, k)."""
        chosen = self.exchange(count)
        poses = self.candidates[chosen]
        if not self.limits.continuous:
            return poses
        starts = [poses]
        if count <= _FEW:
            starts += [np.random.default_rng(seed).choice(self.candidates, count) for seed in range(2)]
        polished = [self.polish(start) for start in starts]
        designs = [poses, *polished]
        return designs[first_least(np.array([self.cost(each) for each in designs]), _SAME)]

    def measure(self, poses: Floats) -> float:
        """Value of the aim for orientations (n, k)."""
        return float(self.aim(self.factor(self.rows(poses))))

    def cost(self, poses: Floats) -> float:
        """The cost that is minimised, for orientations (n, k)."""
        return float(self._score(self.factor(self.rows(poses))))

    def _score(self, factors: Floats, power: float = math.inf) -> Floats:
        """Return the aim plus a small share of D, which decides between designs of equal aim."""
        return self.aim(factors, power) + _TIE * optimality_criteria.D(factors)

    def exchange(self, count: int) -> list[int]:
        """Indices of the best candidates, found by greedy choice followed by exchange.

        If the candidates are the only possible orientations, random starts are tried as well. The greedy choice uses D,
        which every dwell improves; a maximum over several sigmas falls only if all of the largest ones do. A little
        information on every parameter is there from the beginning: without it, rounding would decide what the first
        dwells are worth.
        """
        rows, greedy = self.candidate_rows, list[int]()
        known = triangle(np.vstack([self.information.start, np.diag(_FAINT * np.linalg.norm(rows, axis=(0, 1)))]))
        for _ in range(count):
            greedy.append(self._choice(optimality_criteria.D, known)[0])
            known = triangle(np.vstack([known, rows[greedy[-1]]]))
        rng = np.random.default_rng(0)
        others = [] if self.limits.continuous else [rng.choice(len(rows), count).tolist() for _ in range(_OTHERS)]
        found = [self._exchange_from(start) for start in (greedy, *others)]
        return found[first_least(np.array([float(self._score(self.factor(rows[each]))) for each in found]))]

    def _exchange_from(self, start: list[int]) -> list[int]:
        """Exchange each dwell for the best candidate until none changes."""
        rows, chosen = self.candidate_rows, list(start)
        for _ in range(_SWEEPS):
            before = list(chosen)
            for place in range(len(chosen)):
                rest = chosen[:place] + chosen[place + 1 :]
                best, cost = self._choice(self._score, self.factor(rows[rest]))
                if cost < float(self._score(self.factor(rows[chosen]))) - 1e-9:
                    chosen[place] = best
            if chosen == before:
                break
        return chosen

    def _choice(self, score: Score, upper: Floats) -> tuple[int, float]:
        """Return the candidate that goes best with information of factor ``upper`` (p, p), and the cost of both.

        If there are many candidates, only the most promising ones are evaluated.
        """
        rows = self.candidate_rows
        wide = len(rows) > 8 * _FIRST
        tried = self._promising(score, upper) if wide else np.arange(len(rows))
        both = np.concatenate([np.broadcast_to(upper, (len(tried), *upper.shape)), rows[tried]], axis=1)
        costs = score(triangle(both), math.inf)
        k = first_least(costs)
        return int(tried[k]), float(costs[k])

    def _promising(self, score: Score, upper: Floats) -> Ints:
        """Return the candidates that the gradient of the aim favours.

        To make the gradient finite, a little of all candidates is added to the rows so far.
        """
        rows = self.candidate_rows
        some = (0.1 / math.sqrt(len(rows))) * rows.reshape(-1, rows.shape[2])
        spread = triangle(np.vstack([upper, some]))
        white = rows @ np.linalg.inv(spread)
        promise = np.einsum("nri,ij,nrj->n", white, optimality_criteria.slope(score, spread, self.aim.powers[0]), white)
        return np.argsort((promise / np.abs(promise).max()).round(9), kind="stable")[:_FIRST]

    def polish(self, poses: Floats) -> Floats:
        """The orientations moved within their bounds to a local minimum of the cost."""
        from scipy.optimize import minimize  # takes 0.4 s to load, which figures of a plan need not wait for

        shape, rooms = poses.shape, self._rooms(poses)
        for power in self.aim.powers:
            optimum = minimize(
                self._with_slope, poses.ravel(), (shape, power), "L-BFGS-B", jac=True, bounds=rooms.reshape(-1, 2),
                options=_UNTIL,
            )  # fmt: skip
            poses = optimum.x.reshape(shape)
        return np.where(np.isfinite(rooms).any(axis=2), poses, wrap(poses))

    def _rooms(self, poses: Floats) -> Floats:
        """Return the bounds (n, k, 2) of each orientation within which it and its antipode are allowed."""
        rooms = self.limits.rooms(poses)
        if self.scheme.turned is None:
            return rooms
        other = self.scheme.antipodes(poses)
        theirs = self.limits.rooms(other) - other[:, :, None]
        mirrored = np.array(self.scheme.signs) < 0
        theirs[:, mirrored] = -theirs[:, mirrored, ::-1]
        theirs += poses[:, :, None]
        return np.stack([np.maximum(rooms, theirs)[..., 0], np.minimum(rooms, theirs)[..., 1]], axis=2)

    def _with_slope(self, flat: Floats, shape: tuple[int, int], power: float) -> tuple[float, Floats]:
        """Return the cost and its gradient by all angles."""
        poses, gradient = flat.reshape(shape), np.empty(shape)
        rows = self.rows(poses)
        upper = self.factor(rows)
        inverse = np.linalg.inv(optimality_criteria.regular(upper))
        weights = rows @ inverse @ optimality_criteria.slope(self._score, upper, power) @ inverse.T
        for j in range(shape[1]):
            step = _STEP_RAD * np.eye(shape[1])[j]
            change = (self.rows(poses + step) - self.rows(poses - step)) / (2.0 * _STEP_RAD)
            gradient[:, j] = 2.0 * np.einsum("nrp,nrp->n", weights, change)
        return float(self._score(upper, power)), gradient.ravel()

    def variance_function(self, rows: Floats, poses: Floats) -> tuple[float, float]:
        """tr(M0 M^-1) and the largest tr(I(x) M^-1) that can be reached, where M is the information of the design
        ``rows`` (n, r, p)."""
        from scipy.optimize import minimize

        inverse = np.linalg.inv(self.factor(rows))

        def at(poses: Floats) -> Floats:
            return np.square(self.rows(poses) @ inverse).sum(axis=(1, 2))

        there = at(poses)
        largest = float(there.max())
        if self.limits.continuous:
            for k in np.argsort(there)[-3:]:
                room = self._rooms(poses[k : k + 1])[0]
                found = minimize(lambda q: -float(at(q[None])[0]), poses[k], method="L-BFGS-B", bounds=room)
                largest = max(largest, -float(found.fun))
        return float(np.square(self.information.start @ inverse).sum()), largest

    def d_bound(self, rows: Floats) -> float:
        """An upper bound of log det M*^(1/p) over all designs of as many orientations as ``rows`` (n, r, p) has.

        It is the least of three bounds: from the design itself, which is tight at the optimum, from the best weights of
        the candidates, and from balanced directions.
        """
        bounds, balanced = list[float](), self.information.balanced(len(rows) * self.scheme.copies)
        for design in (rows, self._weighted_rows(len(rows)), *([] if balanced is None else [balanced])):
            known, largest = self.variance_function(design, self.candidates)
            width = design.shape[2]
            ratio = (known + len(rows) * largest) / width
            bounds.append(-float(optimality_criteria.D(self.factor(design))) * 2.0 + math.log(ratio))
        return min(bounds)

    def _weighted_rows(self, count: int) -> Floats:
        """Return the rows (c, r, p) of the candidates times the roots of their D-optimal weights, found by
        multiplicative updates."""
        rows = self.candidate_rows
        weights = np.full(len(rows), 1.0 / len(rows))
        for _ in range(_WEIGHINGS):
            upper = self.factor(np.sqrt(count * weights)[:, None, None] * rows)
            gain = np.square(rows @ np.linalg.inv(upper)).sum(axis=(1, 2))
            mean = float(weights @ gain)
            weights = weights * gain / mean
            if gain.max() < mean * (1.0 + 1e-6):
                break
        return np.sqrt(count * weights)[:, None, None] * rows

    def next(self) -> Floats:
        """The next orientation (k,) after which the cost is least, found by random search that narrows about the
        best."""
        if not self.limits.continuous:
            return self._first_of(self.candidates)
        rng, (low, high) = np.random.default_rng(0), self.limits.bounds.T
        scattered = rng.uniform(low, high, (_SCATTERED, len(low)))
        best = self._first_of(np.vstack([scattered[self._is_allowed(scattered)], self.limits.candidates[:1]]))
        for reach_deg in (24.0, 8.0, 2.5, 0.8):
            about = best + np.radians(rng.uniform(-reach_deg, reach_deg, (_ABOUT, len(best))))
            best = self._first_of(np.vstack([best, about[self._is_allowed(about)]]))
        return wrap(best)

    def _is_allowed(self, poses: Floats) -> Mask:
        """Return a mask of the poses that are allowed together with their antipodes."""
        inside = self.limits.allowed(wrap(poses))
        return inside if self.scheme.turned is None else inside & self.limits.allowed(self.scheme.antipodes(poses))

    def _first_of(self, poses: Floats) -> Floats:
        """Return the pose after which the cost is least."""
        rows, start = self.rows(poses), self.information.start
        so_far = np.broadcast_to(start, (len(rows), *start.shape))
        return poses[first_least(self._score(triangle(np.concatenate([so_far, rows], axis=1))))]

    def without_limits(self) -> Search:
        """The same search over all orientations that the axes can reach."""
        return replace(self, limits=GimbalLimits(self.limits.bench), scheme=Scheme())
