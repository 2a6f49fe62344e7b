"""The seed paper's experiment, again: both sets of orientations, 200 repetitions, Table 2.

Everything that the paper states is a constant here. Its optimal set needs no more. Its non-optimal set cannot give
finite errors with gravity fixed, because two of its four orientations show the accelerometers the same vector; it does
where the platform is held in inertial space and the Earth turns gravity in it. How long the readings take, and where
and which way the bench stands, the paper does not say: ``Conditions`` are inferred from Table 2, and marked so.

Readings are nonlinear in the parameters (``paper_parameters.state_of``); least squares is the paper's, linear in the
deviations with its D; the filter is the package's, on the affine state, without linearisation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, permutations
from typing import TYPE_CHECKING, Literal

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import DEVIATIONS
from kf_calib.estimation import kalman_filterpy
from kf_calib.estimation.settings import PRIORS

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

GRAVITY_MPS2 = 9.81
NOISE_MPS2 = 1e-4
READINGS_PER_DWELL = 100
"""Of each accelerometer in each orientation."""
REPETITIONS = 200
OPTIMAL_PRINTED = {
    "theta1": 0.7152, "phi1": 0.6555, "K1": 1.1370, "b1": 12.0713,
    "nu1": 0.6982, "nu2": 0.6816, "K2": 1.2563, "b2": 10.7666,
    "theta3": 0.7201, "phi3": 0.6652, "K3": 1.0919, "b3": 11.4856,
}  # fmt: skip
"""Table 2: mean of |estimate - truth| / |truth|, per cent."""
NONOPTIMAL_PRINTED = {
    "theta1": 17.5745, "phi1": 19.5877, "K1": 30.1383, "b1": 495.4044,
    "nu1": 7.8072, "nu2": 11.3287, "K2": 56.1574, "b2": 540.8591,
    "theta3": 11.1752, "phi3": 8.5489, "K3": 25.4136, "b3": 551.2224,
}  # fmt: skip

Turns = Literal["platform", "platform-after-2", "bench", "bench-after-2"]
TURNS: dict[Turns, list[tuple[float, float, float]]] = {
    "platform": [(0, 0, 0), (40, 0, 0), (33, 70, 0), (33, 70, 70)],
    "platform-after-2": [(0, 0, 0), (40, 0, 0), (73, 70, 0), (73, 70, 70)],
    "bench": [(0, 0, 0), (40, 0, 0), (0, 70, 33), (70, 70, 33)],
    "bench-after-2": [(0, 0, 0), (40, 0, 0), (0, 70, 73), (70, 70, 73)],
}
"""Ways to read "2: Y 40 deg, 3: Y 33 and Z 70 deg, 4: Y 70 deg": attitudes Rot(Y, a) Rot(Z, b) Rot(Y, c), deg.

Turns are about axes of the platform or of the bench; the third begins at the first orientation, or goes on after the
second; the fourth goes on after the third (counted from the first it would be a third turn about the vertical).
"""
TOGETHER = "together"
SAMPLED = (TOGETHER, *("".join(order) for order in permutations("123")))
"""All three accelerometers read at once, or one after another in each orientation, in that order."""
_SINGULAR = 1e-12  # smallest of the scaled eigenvalues of D^T D, over the largest
_SCALE = np.array([GRAVITY_MPS2, GRAVITY_MPS2, GRAVITY_MPS2, 1.0])
_DIFFUSE = 1e5  # sigmas of a reading


@dataclass(frozen=True)
class Conditions:
    """What the paper leaves open about its non-optimal set. Inferred: none of it is printed.

    The author works in Moscow; the azimuth is the simplest; the period is what then comes nearest to Table 2.
    """

    period_s: float = 25.0
    latitude_deg: float = 55.75
    azimuth_deg: float = 0.0
    turns: Turns = "platform"
    sampled: str = TOGETHER

    @property
    def bench(self) -> Bench:
        """A platform held in inertial space."""
        return Bench((), GRAVITY_MPS2, "inertial", latitude_deg=self.latitude_deg, azimuth_deg=self.azimuth_deg)

    @property
    def duration_s(self) -> float:
        """From the first reading to the end of the last."""
        return 4 * READINGS_PER_DWELL * self.period_s * (1 if self.sampled == TOGETHER else 3)

    def elapsed_s(self) -> Floats:
        """When each accelerometer's readings are taken, (3, n)."""
        if self.sampled == TOGETHER:
            return np.tile(np.asarray(np.arange(4 * READINGS_PER_DWELL) * self.period_s, dtype=np.float64), (3, 1))
        place = np.array([self.sampled.index(i) for i in "123"])
        block = 3 * np.arange(4) + place[:, None]
        count = block[..., None] * READINGS_PER_DWELL + np.arange(READINGS_PER_DWELL)
        return np.asarray(self.period_s * count.reshape(3, -1), dtype=np.float64)


FIXED = Bench((), GRAVITY_MPS2)
"""Gravity that stands still in the bench."""


@dataclass(frozen=True)
class OrientationSet:
    """Four orientations with 100 readings each: the specific force (3, n, 3) that each accelerometer sees."""

    force_mps2: Floats

    @cached_property
    def design(self) -> Floats:
        """The paper's D (3, n, 4) at the nominal parameters."""
        return paper_parameters.design(self.force_mps2, paper_parameters.nominal())

    @cached_property
    def normal(self) -> Floats:
        """D^T D (3, 4, 4)."""
        rows = np.concatenate([self.force_mps2, np.ones((*self.force_mps2.shape[:2], 1))], axis=2)
        return normal_of(rows.swapaxes(1, 2) @ rows)

    @property
    def sigma(self) -> Floats:
        """What least squares leaves uncertain, (12,) rad, rad, 1, m/s^2; infinite where D is rank-deficient."""
        return sigma_of(self.normal)

    @property
    def expected(self) -> Floats:
        """Table 2 without a run, (12,) per cent: the mean of a normal error's size is sqrt(2/pi) of its sigma."""
        return expected_of(self.normal)

    @property
    def condition_numbers(self) -> Floats:
        """Of each accelerometer's D, (3,), with gravity in m/s^2 as the paper has it; infinite for rank 3."""
        return self._conditions(np.ones(4))

    @property
    def condition_numbers_in_g(self) -> Floats:
        """The same with gravity in units of g: the figure that does not hang on a unit."""
        return self._conditions(_SCALE)

    def _conditions(self, unit: Floats) -> Floats:
        singular = np.linalg.svd(self.design / unit, compute_uv=False)
        return np.where(self.rank == 4, singular[:, 0] / np.maximum(singular[:, -1], 1e-300), np.inf)

    @property
    def rank(self) -> Floats:
        """Of each accelerometer's D, (3,); 4 is enough."""
        values = np.linalg.eigvalsh(self.normal / np.outer(_SCALE, _SCALE))
        return (values > _SINGULAR * values[:, -1:]).sum(axis=1)

    @property
    def directions(self) -> Floats:
        """Specific force of the first reading in each orientation, in g (3, 4, 3)."""
        return self.force_mps2[:, ::READINGS_PER_DWELL] / GRAVITY_MPS2

    @property
    def same_vector(self) -> list[tuple[int, int]]:
        """Pairs of orientations, counted from 1, in which all accelerometers see the same vector."""
        by_orientation = self.force_mps2.reshape(3, 4, READINGS_PER_DWELL, 3)
        return [
            (one + 1, other + 1)
            for one, other in combinations(range(4), 2)
            if np.allclose(by_orientation[:, one], by_orientation[:, other], atol=1e-9)
        ]


def normal_of(moments: Floats) -> Floats:
    """D^T D (..., 3, 4, 4) from the sums of [f, 1][f, 1]^T that each accelerometer sees (..., 3, 4, 4)."""
    turned = np.zeros((3, 4, 4))  # a row of D is [f, 1] times this
    turned[:, :3, :3], turned[:, 3, 3] = paper_parameters.h_rows(paper_parameters.nominal()).transpose(0, 2, 1), 1.0
    return turned.swapaxes(1, 2) @ moments @ turned


def expected_of(normal: Floats) -> Floats:
    """Table 2 without a run, (..., 12) per cent: the mean size of a normal error is sqrt(2/pi) of its sigma."""
    return per_cent(math.sqrt(2 / math.pi) * sigma_of(normal))


def sigma_of(normal: Floats) -> Floats:
    """sigma (..., 12) from D^T D (..., 3, 4, 4) and the noise of a reading; infinite where it is singular."""
    values, vectors = np.linalg.eigh(normal / np.outer(_SCALE, _SCALE))
    seen = values[..., :1] > _SINGULAR * values[..., -1:]
    variance = np.sum(vectors**2 / np.maximum(values, 1e-300)[..., None, :], axis=-1)
    return np.where(seen, NOISE_MPS2 * np.sqrt(variance) / _SCALE, np.inf).reshape(*normal.shape[:-3], 12)


def per_cent(error: Floats) -> Floats:
    """Errors (..., 12) over the deviations that were to be found."""
    return 100.0 * error / DEVIATIONS


def printed_column(table: dict[str, float]) -> Floats:
    """A column of Table 2 in the order of ``paper.SYMBOLS``."""
    return np.array([table[symbol] for symbol in paper_parameters.SYMBOLS])


def log_ratio(figures: Floats, column: Floats) -> Floats:
    """Rms over the twelve of ln(figure / print), (...)."""
    return np.sqrt(np.mean(np.log(figures / column) ** 2, axis=-1))


def scatter(repetitions: int) -> float:
    """Relative 1 sigma of a mean of |normal error| over so many runs: sqrt((pi/2 - 1) / r), 5.3 % for 200."""
    return math.sqrt((math.pi / 2 - 1) / repetitions)


def nonoptimal(conditions: Conditions, earth_turns: bool = True) -> OrientationSet:
    """The paper's first set; without the Earth's rotation: as printed."""
    bench = conditions.bench if earth_turns else FIXED
    pose = np.repeat(attitudes(conditions.turns), READINGS_PER_DWELL, axis=0)
    return OrientationSet(np.array([bench.specific_force(each, pose) for each in conditions.elapsed_s()]))


def attitudes(turns: Turns) -> Floats:
    """Quaternions (4, 4), platform -> bench."""
    from scipy.spatial.transform import Rotation  # takes 0.2 s to load: for those alone who run the experiment

    return Rotation.from_euler("YZY", TURNS[turns], degrees=True).as_quat()


def optimal(conditions: Conditions | None = None, turned_after: bool = True) -> OrientationSet:
    """The paper's second set, four orientations for each accelerometer; None: gravity stays where it was pointed.

    turned_after: under ``conditions`` every orientation points at gravity as it stands on arrival, else as at first.
    """
    from scipy.spatial.transform import Rotation

    along = paper_parameters.optimal_directions(paper_parameters.nominal())
    bench, period_s, carried = FIXED, 0.0, Rotation.identity(4)
    if conditions is not None:
        bench, period_s = conditions.bench, conditions.period_s
    elapsed_s = period_s * np.arange(4.0 * READINGS_PER_DWELL)
    if conditions is not None and turned_after:
        carried = Rotation.from_rotvec(np.outer(elapsed_s[::READINGS_PER_DWELL], bench.earth_rate_radps))
    poses = [(carried * _pointing(directions)).as_quat() for directions in along]
    return OrientationSet(
        np.array([bench.specific_force(elapsed_s, np.repeat(pose, READINGS_PER_DWELL, axis=0)) for pose in poses])
    )


def _pointing(directions: Floats) -> Rotation:
    """Attitudes in which the platform sees the bench's vertical along ``directions`` (n, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.concatenate([Rotation.align_vectors([[0.0, 1.0, 0.0]], [each])[0] for each in directions])


@dataclass(frozen=True)
class Column:
    """A set run many times: mean of |error| by least squares and by the filter, (12,) per cent.

    difference_sigma: the largest difference of the two estimates in any repetition.
    """

    orientations: OrientationSet
    least_squares: Floats
    kalman: Floats
    difference_sigma: float


def run_experiment(orientations: OrientationSet, repetitions: int, rng: np.random.Generator) -> Column:
    """Readings of the deviated block with white noise, and both estimates of every repetition."""
    nominal = paper_parameters.nominal()
    truth = nominal + DEVIATIONS
    clean, expected = (_readings(orientations.force_mps2, each)[..., None] for each in (truth, nominal))
    readings = clean + NOISE_MPS2 * rng.standard_normal((*clean.shape[:2], repetitions))
    by_batch = nominal[:, None] + _least_squares(orientations.design, readings - expected)
    diffuse = np.eye(12) * _DIFFUSE * NOISE_MPS2 / np.tile(_SCALE, 3)
    states, _ = _filtered(orientations.force_mps2, readings, diffuse)
    by_filter = paper_parameters.parameters_of(states.T).T
    figures = [per_cent(np.abs(each - truth[:, None]).mean(axis=1)) for each in (by_batch, by_filter)]
    difference = np.abs(by_filter - by_batch).max(axis=1) / orientations.sigma
    return Column(orientations, figures[0], figures[1], float(difference.max()))


def _readings(force_mps2: Floats, parameters: Floats) -> Floats:
    """Eq. 2, not linearised: (3, n)."""
    state = paper_parameters.state_of(parameters).reshape(3, 4)
    return (force_mps2 @ state[:, :3, None])[..., 0] + state[:, 3:]


def _least_squares(design: Floats, differences: Floats) -> Floats:
    """Eq. 6 of each accelerometer: deviations (12, r) from differences (3, n, r)."""
    return np.concatenate([np.linalg.lstsq(own, b, rcond=None)[0] for own, b in zip(design, differences, strict=True)])


def _filtered(force_mps2: Floats, readings: Floats, root: Floats) -> tuple[Floats, Floats]:
    """Affine states (12, r) at the end, and their covariance (n, 12, 12) after every reading.

    The prior is nominal, of covariance L L^T, L = ``root`` (12, 12).
    """
    observations = np.zeros((force_mps2.shape[1], 3, 12))
    for i in range(3):
        observations[:, i, 4 * i : 4 * i + 3], observations[:, i, 4 * i + 3] = force_mps2[i], 1.0
    scale = np.tile(_SCALE, 3)  # in units of m/s^2 all twelve states are of one size
    start = scale * paper_parameters.state_of(paper_parameters.nominal())
    states, covariances = kalman_filterpy.repeated(
        observations / scale, readings.transpose(1, 0, 2), NOISE_MPS2, start, scale[:, None] * root
    )
    return states / scale[:, None], covariances / np.outer(scale, scale)


def shrinking(orientations: OrientationSet, prior: Floats) -> Floats:
    """Covariance of the affine state (n + 1, 12, 12): that of the ``prior`` (12, 12), and after every reading."""
    none, root = np.empty((3, 4 * READINGS_PER_DWELL, 0)), np.linalg.cholesky(prior).astype(float)
    return np.stack([prior, *_filtered(orientations.force_mps2, none, root)[1]])


def falling_sigma(orientations: OrientationSet) -> Floats:
    """Sigmas (n + 1, 12) in SI: of the prior of the navigation grade, and of the filter after every reading."""
    nominal = paper_parameters.nominal()
    jacobian = paper_parameters.jacobian(paper_parameters.state_of(nominal))
    covariances = shrinking(orientations, PRIORS["navigation"].covariance(nominal))
    return np.sqrt(np.diagonal(jacobian @ covariances @ jacobian.T, axis1=1, axis2=2))


@dataclass(frozen=True)
class Experiment:
    """Both sets, run; the non-optimal one also with gravity fixed, as printed."""

    conditions: Conditions
    repetitions: int
    seed: int
    optimal: Column
    nonoptimal: Column
    fixed: OrientationSet


def repeat(conditions: Conditions | None = None, repetitions: int = REPETITIONS, seed: int = 0) -> Experiment:
    """The paper's experiment: the optimal set with gravity fixed, the non-optimal one under inferred conditions."""
    own, rng = conditions or Conditions(), np.random.default_rng(seed)
    best, other = run_experiment(optimal(), repetitions, rng), run_experiment(nonoptimal(own), repetitions, rng)
    return Experiment(own, repetitions, seed, best, other, nonoptimal(own, earth_turns=False))
