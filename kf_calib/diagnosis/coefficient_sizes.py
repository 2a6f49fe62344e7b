"""The sizes of an effect's coefficients: the prior of those that are usual, and the smallest that a run would show.

The coefficients c of one effect are normal with a common standard deviation s, and log s is uniform over the sizes that
such coefficients usually have in sensors of the grade at hand (``Effect.typical``), with tails on both sides: the
density falls by a factor e for each decade beyond. The prior is proper, and says what physics says: an effect that
would have a size that it never has is an unlikely name, however well its columns fit. An effect that is too small to be
seen is none: sizes below one sigma count as its absence. A coefficient whose value is known, as the rate of the Earth
is, is normal about that value. Where no usual size is known, as of formulas, every size from 1 to 1e7 sigma is equally
likely, in common for all such effects of an explanation.

The smallest size at which an effect would be found is computed from its columns alone.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from kf_calib.bench.arrays import Floats
from kf_calib.diagnosis.candidate_tests import CandidateTests
from kf_calib.effects import Coefficient, Effect, FrameEffect, Stimulus
from kf_calib.effects.effect import Grade, Typical
from kf_calib.estimation.dwell_columns import stimulus_of
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import effect_columns

_TAIL = 1.0  # decades beyond the usual sizes in which the density falls by a factor e
_SHARPER = 100.0  # where only the greatest usual size is known, the least one is smaller by this factor
_UNKNOWN_DECADES = 7.0  # above one sigma: where no usual size is known
_STEPS = {1: 120, 2: 40, 3: 16}  # sizes that are tried, by number of effects
_HIDDEN = 1e20  # SI: sigma of a coefficient of which rounding alone is seen
_ABOVE = 300.0  # times the estimate: beyond it, sizes differ no more in evidence
_SIZES = np.exp(np.linspace(0.0, math.log(1e14), 120))  # prior variance of a coefficient over that of its estimate

QUIET = 1e-4
"""Density of white noise below which sensors are of navigation grade, m/s^2/sqrt(Hz) (10 ug/sqrt(Hz))."""
_CONDITIONS = {
    "temperature_c": "the temperature does not change in this run, or is not recorded",
    "variance_mps2_2": "the strength of vibration does not change in this run, or is not looked at",
}
"""Conditions, other than orientations, that effects may depend on, and what is said where they do not vary."""


def size_evidence(dof: int, delta_chi2: Floats | float) -> Floats:
    """Log Bayes factor of an effect whose size and direction are unknown, against no effect.

    The coefficients have the prior N(0, g C) with C the covariance of their estimate, and ln g is uniform from 0 to
    ln 1e14, which is a size of 1 to 1e7 sigma (the g-prior of A. Zellner, 1986, mixed over g; F. Liang et al., 2008):

      B = mean over g of (1 + g)^(-k/2) exp(g / (1 + g) F / 2)

    dof: number of coefficients k. delta_chi2: decrease F of chi-squared with them; a number or an array. Returns
    ln B.
    """
    log_terms = -0.5 * dof * np.log1p(_SIZES) + 0.5 * np.asarray(delta_chi2, float)[..., None] * (
        _SIZES / (1.0 + _SIZES)
    )
    return np.logaddexp.reduce(log_terms, axis=-1) - math.log(len(_SIZES))


@dataclass(frozen=True)
class SizePrior:
    """The prior of the common standard deviation s of some coefficients, in SI.

    low, high: sizes that are usual. tail: decades beyond them in which the density of log s falls by a factor e. value:
    about which the coefficients are normal.
    """

    low: float
    high: float
    tail: float = _TAIL
    value: float = 0.0

    def below(self, sizes: Floats) -> Floats:
        """Probability that s is below each of these sizes."""
        low, high, at = np.log10(self.low), np.log10(self.high), np.log10(sizes)
        before = self.tail * np.exp(np.minimum(at - low, 0.0) / self.tail)
        after = self.tail * -np.expm1(-np.maximum(at - high, 0.0) / self.tail)
        return np.asarray((before + np.clip(at - low, 0.0, high - low) + after) / (high - low + 2.0 * self.tail), float)


_ANY_SIZE = SizePrior(1.0, 10.0**_UNKNOWN_DECADES, 0.1)
"""Where no usual size is known, of coefficients that are determined to one."""


def usual_sizes(effect: Effect, grade: Grade) -> SizePrior | None:
    """The prior of an effect from the sizes that its coefficients usually have; None where these are not known."""
    if effect.expected is not None:
        value, spread = effect.expected
        return SizePrior(spread, spread, 0.01, value)
    usual = effect.typical.of(grade)
    return None if usual is None else SizePrior(usual[0] or usual[1] / _SHARPER, usual[1])


def log_bayes_of_sizes(
    delta_chi2: float, root: Floats, estimate: Floats, groups: NDArray[np.intp], priors: Sequence[SizePrior]
) -> float:
    """Log Bayes factor of effects whose sizes are averaged over their priors, against no effect.

      B = exp(F / 2) mean over s of N(c; m, C + S^2) / N(c; c, C),  C = (R^T R)^-1

    - delta_chi2: the decrease F of chi-squared with them.
    - root (r, q): a root R of the information on their coefficients, all else averaged out.
    - estimate (q,): the coefficients c, in any directions that R does not see.
    - groups (q,): the number of the effect that each coefficient belongs to. priors: of these effects.
    """
    centre = np.array([prior.value for prior in priors])[groups]
    left = root @ (estimate - centre)
    nodes = [_nodes(root[:, groups == k], estimate[groups == k], prior, len(priors)) for k, prior in enumerate(priors)]
    if len(nodes) == 1:
        return 0.5 * delta_chi2 + _log_density(root, left, *nodes[0])
    mesh = np.meshgrid(*(sizes for sizes, _ in nodes), indexing="ij")
    log_weights = sum(np.meshgrid(*(np.log(weights) for _, weights in nodes), indexing="ij"))
    sizes = np.stack([each.ravel() for each in mesh], axis=1)[:, groups]
    scaled = root * sizes[:, None, :]  # (n, r, q)
    spread = np.eye(len(groups)) + np.swapaxes(scaled, 1, 2) @ scaled
    along = left @ scaled
    misfit = left @ left - np.einsum("nq,nq->n", along, np.linalg.solve(spread, along[..., None])[..., 0])
    logs = np.ravel(log_weights) - 0.5 * (np.linalg.slogdet(spread)[1] + misfit)
    return 0.5 * delta_chi2 + float(np.logaddexp.reduce(logs))


def _log_density(root: Floats, left: Floats, sizes: Floats, weights: Floats) -> float:
    """Return log mean over s of N(c; m, C + s^2) / N(c; c, C) of the coefficients of one effect, which share their
    size s, from the singular values w of R: C + s^2 has the information w^2 / (1 + s^2 w^2) along their directions."""
    along, singular, _ = np.linalg.svd(root, full_matrices=False)
    scaled = (sizes[:, None] * singular) ** 2
    misfit = left @ left - np.sum((left @ along) ** 2 * scaled / (1.0 + scaled), axis=1)
    return float(np.logaddexp.reduce(np.log(weights) - 0.5 * (np.log1p(scaled).sum(axis=1) + misfit)))


def _nodes(root: Floats, estimate: Floats, prior: SizePrior, effects: int) -> tuple[Floats, Floats]:
    """Return sizes (n,) and their prior probabilities (n,), of all sizes from one sigma of the coefficient that is
    determined best: an effect that is smaller shows nothing, and belongs to the explanation without it. One of which
    nothing is seen beside the others changes nothing: its size is zero."""
    least = best_sigma(root)
    if least > _HIDDEN:
        return np.zeros(1), np.ones(1)
    if prior.value:
        return np.array([prior.low]), np.ones(1)
    most = _ABOVE * max(float(np.abs(estimate).max(initial=0.0)), least)
    edges = np.geomspace(least, most, _STEPS.get(effects, 8) + 1)
    sizes = np.sqrt(edges[1:] * edges[:-1])
    weights = np.diff(prior.below(edges))
    weights[-1] += 1.0 - prior.below(edges[-1:])[0]
    return sizes, np.maximum(weights, 1e-300)


@dataclass(frozen=True)
class AddedEffects:
    """What is known beforehand of the coefficients of effects that are added to a model.

    - effects: those of them that have coefficients. grade: of the sensors.
    - dof: the number of coefficients that are seen.
    """

    effects: Sequence[Effect]
    grade: Grade
    dof: int

    def log_bayes(self, delta_chi2: float, root: Floats, readings: Floats) -> float:
        """The log Bayes factor of the effects against none, averaged over all relations that the coefficients may have.

        delta_chi2: decrease of chi-squared with them. root (r, q), readings (r,): what the run says of the coefficients
        is root @ c = readings, in noise of unit size.
        """
        blocks = [effect.relations or [np.eye(len(effect.coefficients))] for effect in self.effects]
        readings = root @ _solved(root, readings)
        logs = [self._log_bayes(delta_chi2, root, readings, relation) for relation in itertools.product(*blocks)]
        return float(np.logaddexp.reduce(logs)) - math.log(len(logs))

    def _log_bayes(self, delta_chi2: float, root: Floats, readings: Floats, relation: Sequence[Floats]) -> float:
        """Return the log Bayes factor where the coefficients of each effect are a matrix times free numbers."""
        widths = [matrix.shape[1] for matrix in relation]
        usual = [usual_sizes(effect, self.grade) for effect in self.effects]
        related, groups = root @ np.asarray(block_diag(*relation), float), np.repeat(np.arange(len(widths)), widths)
        sized, priors = [k for k, prior in enumerate(usual) if prior], [*filter(None, usual)]
        others = ~np.isin(groups, sized)
        if sized and others.any():
            shared = _directions(related[:, others])
            groups = np.append(np.searchsorted(sized, groups[~others]), np.full(shared.shape[1], len(sized)))
            related = np.column_stack([related[:, ~others], shared])
            priors += [_ANY_SIZE] if shared.shape[1] else []
        estimate = _solved(related, readings)
        left = readings - related @ estimate
        delta_chi2 = max(delta_chi2 - float(left @ left), 0.0)
        if not sized:
            return float(size_evidence(min(self.dof, sum(widths)), delta_chi2))
        return log_bayes_of_sizes(delta_chi2, related, estimate, groups, priors)


def _directions(root: Floats) -> Floats:
    """Return orthonormal columns (r, k) that span those of a root (r, q): coefficients of one sigma each, whatever the
    units were, so that one size of them all is that of the g-prior (``size_evidence``)."""
    lengths = np.linalg.norm(root, axis=0)
    left, singular, _ = np.linalg.svd(root / np.where(lengths > 0.0, lengths, 1.0), full_matrices=False)
    return left[:, singular > 1e-9]


def _solved(root: Floats, readings: Floats) -> Floats:
    """Return the shortest least-squares solution of root @ x = readings, with columns of any scale; zero where
    rounding alone is seen."""
    lengths = np.linalg.norm(root, axis=0)
    lengths = np.where(lengths * _HIDDEN > 1.0, lengths, 1.0)
    return np.asarray(np.linalg.lstsq(root / lengths, readings, rcond=1e-9)[0] / lengths, float)


def best_sigma(root: Floats) -> float:
    """Sigma of the coefficient that is determined best, from a root (r, q) of the information on them all."""
    return float(1.0 / max(np.linalg.norm(root, axis=0).max(initial=0.0), 1e-300))


@dataclass(frozen=True)
class Detectable:
    """The size of a coefficient at which an effect is found in 90 of 100 runs; of several, that of the least visible.

    name: of the effect. minimum: the size in SI. coefficient: which of them it is the size of. typical: usual sizes of
    such coefficients, in SI.
    """

    name: str
    minimum: float
    coefficient: Coefficient
    typical: Typical

    @property
    def unit(self) -> str:
        """The SI unit of the coefficient."""
        return self.coefficient.unit


@dataclass(frozen=True)
class Unseen:
    """An effect of which a run shows nothing, and why."""

    name: str
    why: str


def detectable(test: CandidateTests) -> list[Detectable]:
    """The smallest detectable size of every visible effect, from its columns and not from the readings."""
    limits = list[Detectable]()
    for name in test.effects.best:
        if name not in test.invisible and (smallest := test.effects.smallest_size(name)) is not None:
            coefficient, minimum = smallest
            limits.append(Detectable(name, minimum, coefficient, test.effects.candidate(name).effect.typical))
    return limits


def unseen(fitted: Fit, test: CandidateTests) -> list[Unseen]:
    """The effects of which a run shows nothing, each with the reason; then frequencies that were not searched."""
    bench, dwells = fitted.linearised.model.bench, fitted.dwells
    stimulus = stimulus_of(dwells, bench, fitted.linearised.state)
    in_dwells = [name for name in test.effects.unseen if name not in test.effects.in_slews_only]
    effects = [Unseen(name, _reason(test.effects.candidate(name).effect, stimulus)) for name in in_dwells]
    effects += [
        Unseen(name, "shows while the platform turns, and only dwells are tested")
        for name in test.effects.in_slews_only
    ]
    if test.lines.untested_band:
        effects.append(Unseen(test.lines.untested_band, "not among the frequencies that are searched in this run"))
    return effects


def _reason(effect: Effect, stimulus: Stimulus) -> str:
    """Return why nothing of an effect is seen in dwells."""
    columns = effect_columns([effect], stimulus)
    if not stimulus.bench.angles and not columns.any() and _needs_angles(effect, stimulus):
        return "depends on how the platform stands, which is not known without angles"
    for quantity, words in _CONDITIONS.items():
        values = np.nan_to_num(getattr(stimulus, quantity))
        ramp = np.arange(len(values), dtype=float).reshape(-1, *[1] * (values.ndim - 1)) / len(values)
        if not np.ptp(values, axis=0).any():
            changed = effect_columns([effect], replace(stimulus, **{quantity: values + ramp}))
            if not np.array_equal(changed, columns):
                return words
    if not columns.any():
        return "adds nothing to a reading in these orientations"
    return effect.degeneracy(stimulus.bench) or "adds to every dwell what the model adds already"


def _needs_angles(effect: Effect, stimulus: Stimulus) -> bool:
    """Tell whether an effect would have columns if some attitude were known."""
    if isinstance(effect, FrameEffect):
        return True
    poses = np.random.default_rng(1).normal(size=stimulus.pose.shape)
    return bool(effect_columns([effect], replace(stimulus, pose=poses, previous_pose=poses)).any())


def sensor_grade(fitted: Fit) -> Grade:
    """The grade of the sensors, by the noise of this run: navigation grade below 10 ug/sqrt(Hz), otherwise MEMS.

    The density of a reading's noise is its effective sigma (as if white) times the square root of the time from one
    reading to the next; that of the quietest accelerometer counts. Quartz-flexure accelerometers have about
    1 ug/sqrt(Hz), consumer chips 100 and more; 10 is half way between in logarithm.
    """
    dwells = fitted.dwells
    readings, lasting_s = sum(dwell.count - 1 for dwell in dwells), sum(d.end_s - d.start_s for d in dwells)
    density = fitted.noise.effective_sigma_mps2 * np.sqrt(lasting_s / max(readings, 1))
    return "navigation" if float(density.min()) < QUIET else "mems"
