"""The main job: a source in, the twelve parameters with their covariance, the noise and the misfit out.

One pass folds the recording into a factor a dwell (``folding.Folder``); everything after it (noise model, filter
steps, leave-one-orientation-out) works on the factors. The estimate after each dwell is reported with the noise model
of the whole run, so the curves of a replay do not jump when the noise becomes better known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from kf_calib import information, kalman, paper
from kf_calib.bench import Bench
from kf_calib.dwells import Segmenter, Stillness, Tally, dwell_blocks
from kf_calib.errors import InputError, UnobservableError
from kf_calib.folding import DwellFactor, Folder, informative
from kf_calib.information import Step
from kf_calib.model import PRIORS, STATE_COUNT, Prior, Rows, model_rows
from kf_calib.noise import Noise, considered, mean_covariances, mean_design, with_dwell_parts, within_dwells
from kf_calib.samples import Floats, Mask, Source

SAME_POSE_DEG = 1.0
"""Dwells whose gravity directions are closer than this are visits of one orientation."""

_HOPELESS = {"rad": np.radians(10.0), "1": 0.2, "m/s^2": 2.0}  # a larger sigma means: not seen by this run
Engine = Literal["block", "filterpy"]


@dataclass(frozen=True)
class Settings:
    """How a run is evaluated. ``walk_mps2_per_sqrt_s``: random walk of the biases (process noise), 0: none."""

    engine: Engine = "block"
    prior: Prior = PRIORS["diffuse"]
    stillness: Stillness = field(default_factory=Stillness)
    gate_sigma: float | None = 6.0
    walk_mps2_per_sqrt_s: float = 0.0


@dataclass(frozen=True)
class Parameter:
    """An estimate with its sigma and unit; value and sigma are None where the orientations cannot see it."""

    symbol: str
    value: float | None
    sigma: float | None
    unit: str
    nominal: float


@dataclass(frozen=True)
class Estimate:
    """The affine state, its covariance, and the basis (12, q) of the combinations that are not determined."""

    state: Floats
    covariance: Floats
    undetermined: Floats

    @cached_property
    def parameters(self) -> Floats:
        """The paper's parameters (12,)."""
        return paper.parameters_of(self.state)

    @cached_property
    def parameter_covariance(self) -> Floats:
        """Their covariance (12, 12), carried over by the closed-form Jacobian."""
        jacobian = paper.jacobian(self.state)
        return jacobian @ self.covariance @ jacobian.T

    @cached_property
    def unseen(self) -> Mask:
        """Which parameters the orientations do not determine, (12,) bool."""
        sigma = np.sqrt(np.diag(self.parameter_covariance))
        unseen = sigma > np.array([_HOPELESS[unit] for unit in paper.UNITS])
        if self.undetermined.size:
            basis = self.undetermined / np.linalg.norm(self.undetermined, axis=0)
            unseen |= np.linalg.norm(paper.jacobian(self.state) @ basis, axis=1) > 1e-6
        return np.asarray(unseen)

    @cached_property
    def sigma(self) -> Floats:
        """1 sigma of the parameters (12,); NaN where not determined."""
        return np.where(self.unseen, np.nan, np.sqrt(np.diag(self.parameter_covariance)))


@dataclass(frozen=True)
class Visit:
    """One dwell as the filter saw it; the estimate is the one after it.

    innovation_mps2 (3,) is the dwell's mean reading less its prediction from the dwells before, with its sigma
    (NaN while the prediction is undetermined); residual_mps2 (3,) is against the final estimate. dof may be 0.
    """

    dwell: DwellFactor
    estimate: Estimate
    nis: float
    dof: int
    innovation_mps2: Floats
    innovation_sigma_mps2: Floats
    residual_mps2: Floats


@dataclass(frozen=True)
class Consistency:
    """Do the dwells agree with the model within the noise? None where nothing is left over to judge by.

    The statistic is the sum of the normalised innovations squared, chi-squared with ``dof`` (F with ``noise_dof`` where
    the noise itself was estimated from few readings). Scatter that was estimated from the same misfit is left out.
    """

    statistic: float
    dof: int
    p_value: float | None
    consistent: bool | None

    @property
    def nis_per_dof(self) -> float | None:
        return self.statistic / self.dof if self.dof > 0 else None


@dataclass(frozen=True)
class Calibration:
    """The result of a run."""

    bench: Bench
    settings: Settings
    noise: Noise
    linearised_at: Floats  # affine state (12,) at which the setting error was linearised
    visits: tuple[Visit, ...]
    estimate: Estimate
    consistency: Consistency
    residual_rms_mps2: float
    held_out_rms_mps2: float | None
    held_out_floor_mps2: float | None
    tally: Tally
    warnings: tuple[str, ...]

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The twelve parameters by symbol."""
        estimate, nominal = self.estimate, paper.nominal(self.bench.nominal)
        return {
            symbol: Parameter(
                symbol,
                None if estimate.unseen[k] else float(estimate.parameters[k]),
                None if estimate.unseen[k] else float(estimate.sigma[k]),
                paper.UNITS[k],
                float(nominal[k]),
            )
            for k, symbol in enumerate(paper.SYMBOLS)
        }

    def considering(self, state: Floats, covariance: Floats) -> Estimate:
        """Another engine's state and covariance, the latter enlarged by what is considered only."""
        extra = considered(self.noise, *_means([visit.dwell for visit in self.visits]), self.linearised_at).sum(axis=0)
        return Estimate(state, covariance + covariance @ extra @ covariance, self.estimate.undetermined)

    def __str__(self) -> str:
        from kf_calib.views.console import plain_summary

        return plain_summary(self)

    def trace(self) -> Iterator[tuple[float, int, Estimate]]:
        """(elapsed_s, dwell index, estimate) within and after every dwell: after a second, two, four ...."""
        nominal_state = paper.state_of(paper.nominal(self.bench.nominal))
        walks = _walk_variances([visit.dwell for visit in self.visits], self.settings)
        factor = information.start(self.settings.prior, paper.nominal(self.bench.nominal), nominal_state)
        extra = np.zeros((STATE_COUNT, STATE_COUNT))
        for index, (visit, walk) in enumerate(zip(self.visits, walks, strict=True)):
            before, extra_before, dwell = information.predict(factor, walk), extra, visit.dwell
            for part in dwell.prefixes():
                rows = information.whitened([part], self.noise.weights, self.linearised_at)[0]
                factor = information.update(before, rows).factor
                extra = extra_before + considered(self.noise, *_means([part]), self.linearised_at)[0]
                yield part.end_s, index, _estimate(factor, nominal_state, extra)


@dataclass
class Pass:
    """One pass over a source: the rows as they come, what was counted, and the dwells folded so far."""

    source: Source
    settings: Settings
    tally: Tally = field(default_factory=Tally)
    folder: Folder = field(default_factory=Folder)

    def rows(self) -> Iterator[Rows]:
        segmenter = Segmenter(self.source.bench, self.settings.stillness, self.tally)
        blocks = dwell_blocks(self.source, segmenter)
        return model_rows(blocks, self.source.bench, self.tally, self.settings.gate_sigma)

    def fold(self, on_progress: Callable[[float], None] | None = None) -> list[DwellFactor]:
        """All dwells of the source that hold enough readings to be used."""
        for rows in self.rows():
            self.folder.add(rows)
            if on_progress is not None:
                on_progress(self.source.fraction)
        return usable(self.folder.dwells)


def usable(dwells: list[DwellFactor]) -> list[DwellFactor]:
    """Dwells of at least 8 readings: fewer cannot show their own noise."""
    return [dwell for dwell in dwells if dwell.count >= 8]


def calibrate(
    source: Source, settings: Settings | None = None, on_progress: Callable[[float], None] | None = None
) -> Calibration:
    """Evaluate a source: fold its dwells, model the noise, run the filter, judge the misfit.

    Raises InputError where the source holds nothing usable, UnobservableError where one orientation was visited only.
    """
    settings = settings or Settings()
    passed = Pass(source, settings)
    with threadpool_limits(1, user_api="blas"):  # small decompositions: with threads they take three times as long
        dwells = passed.fold(on_progress)
        refuse_unusable(dwells, passed.tally, source.bench)
        result = evaluate(dwells, source.bench, settings)
    refuse_unseen(result)
    if settings.engine == "filterpy":
        result = replace(result, estimate=filterpy_estimate(source, result))
    said = [*source.warnings, *passed.tally.sentences(), *result.warnings]
    return replace(result, tally=passed.tally, warnings=tuple(said))


def evaluate(dwells: list[DwellFactor], bench: Bench, settings: Settings) -> Calibration:
    """The calibration from dwell factors alone; no pass over the data."""
    nominal = paper.nominal(bench.nominal)
    nominal_state = paper.state_of(nominal)
    walks = _walk_variances(dwells, settings)
    noise, state = _noise_and_state(dwells, bench, nominal_state)
    rows = information.whitened(dwells, noise.weights, state)
    steps = information.run(information.start(settings.prior, nominal, nominal_state), rows, walks)
    extra = considered(noise, *_means(dwells), state)
    final = _estimate(steps[-1].factor, nominal_state, extra.sum(axis=0))
    means, _ = _means(dwells)
    residuals = means[:, 4:] - _predicted(means, final.state)
    visits = _visits(dwells, steps, residuals, noise, extra, nominal_state, settings, bench)
    held_out, floor = _held_out(dwells, noise.judging, state, nominal_state)
    judged = _consistency(dwells, noise, state)
    return Calibration(
        bench, settings, noise, state, visits, final, judged, float(np.sqrt(np.mean(residuals**2))), held_out, floor,
        Tally(), tuple(_remarks(bench, noise, final, judged, residuals, dwells)),
    )  # fmt: skip


def filterpy_estimate(
    source: Source, result: Calibration, form: Literal["square-root", "plain"] = "square-root"
) -> Estimate:
    """The same posterior by filterpy's filter, sample by sample: a second pass over the source."""
    nominal = paper.nominal(result.bench.nominal)
    prior, q = result.settings.prior, result.settings.walk_mps2_per_sqrt_s
    counted = {visit.dwell.number for visit in result.visits}
    posterior = kalman.estimate(
        (rows for rows in Pass(source, result.settings).rows() if rows.dwell in counted),
        result.noise.weights,
        paper.state_of(nominal),
        None if prior.diffuse else prior.covariance(nominal),
        result.linearised_at,
        result.bench.gravity_mps2,
        (lambda elapsed_s: np.full(3, q**2 * elapsed_s)) if q else None,
        form,
    )
    return result.considering(posterior.state, posterior.covariance)


def refuse_unusable(dwells: list[DwellFactor], tally: Tally, bench: Bench) -> None:
    """Raise InputError where there is nothing to calibrate from, or where the readings are not in m/s^2."""
    if not tally.read:
        raise InputError("the recording holds no accelerometer readings: check that the logger wrote any.")
    if not tally.poses:
        raise InputError(
            "the recording holds no platform angles (or attitude), so the direction of gravity is not known: "
            "record them on /platform/angles, at any rate."
        )
    if not dwells:
        raise InputError(
            f"no dwell was found in {tally.read} readings ({tally.moving} moving, {tally.settling} settling, "
            f"{tally.not_finite} not finite, {tally.without_pose} without an angle): the platform must stand still; "
            "if it did, raise --still-deg or lower --settle-s."
        )
    level = float(np.median([np.linalg.norm(dwell.means[4:]) for dwell in dwells])) / bench.gravity_mps2
    if 0.5 <= level <= 2.0:
        return
    units = {"g": 1 / 9.80665, "mg": 1e3 / 9.80665, "ug": 1e6 / 9.80665}
    measured = level * bench.gravity_mps2
    for unit, per_mps2 in units.items():
        if 0.8 <= measured / (bench.gravity_mps2 * per_mps2) <= 1.25:
            raise InputError(
                f"the readings have a norm of {measured:.4g} at rest, which is gravity in {unit}, not in m/s^2: "
                f"state it with --accel-unit {unit}."
            )
    raise InputError(
        f"the readings have a norm of {measured:.4g} at rest where gravity is {bench.gravity_mps2:.4g} m/s^2: they "
        "look like counts; give the size of one count in m/s^2 with --accel-scale."
    )


def refuse_unseen(result: Calibration) -> None:
    """Raise UnobservableError where the orientations determine none of the twelve parameters."""
    if result.estimate.unseen.all():
        dwells = (
            "1 dwell of this run shows" if len(result.visits) == 1 else f"{len(result.visits)} dwells of this run show"
        )
        raise UnobservableError(
            f"the {dwells} too few different directions of gravity, so none "
            f"of the parameters can be seen ({', '.join(paper.SYMBOLS)}): visit at least four spread orientations, "
            "or state a --prior."
        )


def _noise_and_state(dwells: list[DwellFactor], bench: Bench, nominal_state: Floats) -> tuple[Noise, Floats]:
    """The noise model, and the state at which it is linearised: estimated in turn, twice."""
    within = within_dwells(dwells)
    noise, state = within, nominal_state
    for _ in range(3):
        rows = information.whitened(dwells, noise.weights, state)
        empty = information.start(Prior(), nominal_state, nominal_state)
        factor = information.update(empty, rows.reshape(-1, STATE_COUNT + 1)).factor
        state = information.solve(factor, nominal_state)[0]
        noise = with_dwell_parts(within, dwells, state, bench.angle_sigma_deg, bench.scatter_sigma_mps2)
    return noise, state


def _walk_variances(dwells: list[DwellFactor], settings: Settings) -> Floats:
    """Variance (D, 3) of the biases' steps before each dwell: q^2 times the time between the dwells' starts."""
    starts = np.array([dwell.start_s for dwell in dwells])
    gaps = np.diff(starts, prepend=starts[:1])
    return np.repeat(settings.walk_mps2_per_sqrt_s**2 * gaps[:, None], 3, axis=1)


def _means(dwells: list[DwellFactor]) -> tuple[Floats, Floats]:
    """Mean regressors and readings (D, 7) of the dwells, and their counts (D,)."""
    return np.array([dwell.means for dwell in dwells]), np.array([dwell.count for dwell in dwells], float)


def _estimate(factor: Floats, nominal_state: Floats, extra: Floats) -> Estimate:
    """The estimate of a factor, its covariance P enlarged by what is considered: P + P B P, B = ``extra`` (12, 12)."""
    state, covariance, undetermined = information.solve(factor, nominal_state)
    return Estimate(state, covariance + covariance @ extra @ covariance, undetermined)


def _predicted(means: Floats, state: Floats) -> Floats:
    """Mean readings (..., 3) of dwells with mean regressors (..., 4+)."""
    sensitivity = state.reshape(3, 4)
    return means[..., 1:4] @ sensitivity[:, :3].T + sensitivity[:, 3]


def _visits(
    dwells: list[DwellFactor], steps: list[Step], residuals: Floats, noise: Noise,
    extra: Floats, nominal_state: Floats, settings: Settings, bench: Bench,
) -> tuple[Visit, ...]:  # fmt: skip
    means, counts = _means(dwells)
    own = mean_covariances(noise, means, counts, nominal_state)
    extra = np.cumsum(extra, axis=0)
    walks = _walk_variances(dwells, settings)
    before = information.start(settings.prior, paper.nominal(bench.nominal), nominal_state)
    visits = list[Visit]()
    for k, (dwell, step) in enumerate(zip(dwells, steps, strict=True)):
        known = _estimate(information.predict(before, walks[k]), nominal_state, extra[k - 1] if k else 0.0 * extra[0])
        innovation, sigma = np.full(3, np.nan), np.full(3, np.nan)
        if not known.undetermined.size:
            rows = mean_design(means[k])
            innovation = means[k, 4:] - _predicted(means[k], known.state)
            sigma = np.sqrt(np.diag(rows @ known.covariance @ rows.T + own[k]))
        estimate = _estimate(step.factor, nominal_state, extra[k])
        visits.append(Visit(dwell, estimate, step.nis, step.dof, innovation, sigma, residuals[k]))
        before = step.factor
    return tuple(visits)


def _consistency(dwells: list[DwellFactor], noise: Noise, state: Floats) -> Consistency:
    from scipy.special import fdtrc

    rows = information.whitened(dwells, noise.judging, state).reshape(-1, STATE_COUNT + 1)
    step = information.update(information.start(Prior(), state, state), rows)
    factors = np.array([dwell.factor for dwell in dwells])
    dof = 3 * int(informative(factors).sum()) - information.rank(step.factor)
    dof -= int(not noise.setting_stated and noise.setting_rad > 0)
    if dof <= 0:
        return Consistency(step.nis, 0, None, None)
    noise_dof = float(sum(max(dwell.count - 4, 1) for dwell in dwells) / noise.inflation.mean())
    p_value = float(fdtrc(dof, max(noise_dof, 1.0), step.nis / dof))
    return Consistency(step.nis, dof, p_value, p_value >= 0.01)


def format_p(p_value: float | None) -> str:
    """``= 0.034``, or a bound where the number has underflowed."""
    return "= -" if p_value is None else "< 1e-300" if p_value < 1e-300 else f"= {p_value:.2g}"


def orientations(dwells: list[DwellFactor]) -> list[list[int]]:
    """Dwells grouped by orientation: the same direction of gravity in the platform, and nearly the same pose."""
    means, _ = _means(dwells)
    direction = means[:, 1:4] / np.linalg.norm(means[:, 1:4], axis=1, keepdims=True)
    place = np.column_stack([direction, [dwell.pose for dwell in dwells]])
    groups, heads = list[list[int]](), np.empty((0, place.shape[1]))
    for k, here in enumerate(place):
        near = np.flatnonzero(np.abs(heads - here).max(axis=1) < np.radians(SAME_POSE_DEG))
        if near.size:
            groups[near[0]].append(k)
        else:
            groups.append([k])
            heads = np.vstack([heads, here])
    return groups


def _held_out(
    dwells: list[DwellFactor], noise: Noise, state: Floats, nominal_state: Floats
) -> tuple[float | None, float | None]:
    """Rms error of the dwell means of orientations left out of the fit, and the rms that ``noise`` alone would give.

    Factors of the orientations before and after the one left out are merged: no refit from the start. None where a
    fit without one of the orientations is undetermined.
    """
    rows = information.whitened(dwells, noise.weights, state)
    extra = considered(noise, *_means(dwells), state)
    groups = orientations(dwells)
    own = [information.update(information.start(Prior(), state, state), rows[g].reshape(-1, 13)).factor for g in groups]
    heads, tails = [np.zeros((12, 13))], [np.zeros((12, 13))]
    for factor in own[:-1]:
        heads.append(information.update(heads[-1], factor).factor)
    for factor in own[:0:-1]:
        tails.insert(0, information.update(tails[0], factor).factor)
    errors, expected = list[Floats](), list[Floats]()
    for group, head, tail in zip(groups, heads, tails, strict=True):
        rest = extra.sum(axis=0) - extra[group].sum(axis=0)
        left = _estimate(information.update(head, tail).factor, nominal_state, rest)
        if left.undetermined.size:
            return None, None
        means, counts = _means([dwells[k] for k in group])
        design = mean_design(means)
        spread = design @ left.covariance @ np.swapaxes(design, 1, 2) + mean_covariances(noise, means, counts, state)
        errors.append(((means[:, 4:] - _predicted(means, left.state)) ** 2).ravel())
        expected.append(np.einsum("dii->di", spread).ravel())
    return float(np.sqrt(np.mean(np.concatenate(errors)))), float(np.sqrt(np.mean(np.concatenate(expected))))


def _remarks(
    bench: Bench, noise: Noise, estimate: Estimate, judged: Consistency, residuals: Floats, dwells: list[DwellFactor]
) -> Iterator[str]:
    """What a reader of the numbers must know, one sentence each."""
    unseen = [symbol for symbol, hidden in zip(paper.SYMBOLS, estimate.unseen, strict=True) if hidden]
    if unseen:
        yield f"these orientations do not determine {', '.join(unseen)}: visit more, spread over the sphere."
    if judged.dof == 0:
        yield (
            f"{len(dwells)} dwell{'s' * (len(dwells) > 1)} leave nothing over to judge the model by: "
            "visit at least five spread orientations."
        )
    rms = float(np.sqrt(np.mean(residuals**2)))
    if rms > 0.03 * bench.gravity_mps2:
        yield (
            f"the angles do not explain the readings (residual {rms:.2g} m/s^2 rms between dwells): check the order "
            "and sign of the axes, the unit of the angles, and which channel is which."
        )
    elif judged.consistent is False:
        yield (
            f"the dwells scatter about the model by more than the noise (p {format_p(judged.p_value)}): an effect is "
            "missing in the model, or noise from dwell to dwell was not stated (angle_sigma_deg, scatter_sigma_mps2)."
        )
    if noise.inflation.max() > 1.5:
        kappa = ", ".join(f"{value:.3g}" for value in noise.inflation)
        yield f"the noise within a dwell is correlated: sigmas allow for it by inflating its variance by {kappa}."
    if not noise.checked and noise.scatter_mps2.any() and not noise.scatter_stated:
        yield (
            f"{len(orientations(dwells))} orientations cannot tell a setting error of the angles from scatter of the "
            f"sensors: dwells are weighted alike and their whole misfit ({noise.scatter_mps2[0]:.2g} m/s^2) counts in "
            "every sigma; at least 12 spread orientations would tell."
        )
    if not noise.setting_stated and noise.setting_rad > 0:
        yield (
            f"angle_sigma_deg was not stated; {np.degrees(noise.setting_rad):.2g} deg was estimated from the misfit "
            "between dwells, which an effect not in the model could also cause."
        )
