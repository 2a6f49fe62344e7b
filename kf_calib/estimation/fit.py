"""The iterated fit of the model and the noise model to the dwells; the filter runs on its result.

Small rotations and input axes are linearised at the current estimate. Constants inside an effect's formula (time
constants, frequencies) are searched on a grid and refined by Gauss-Newton steps, in which the derivative with respect
to the constant is one more column. The setting error, the scatter and the random walk of the biases are estimated by
restricted likelihood.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import DwellFactor
from kf_calib.effects import Effect
from kf_calib.errors import UnobservableError
from kf_calib.estimation import free_attitude, square_root_information
from kf_calib.estimation.attitude import facing_readings, without_attitude
from kf_calib.estimation.dwell_columns import LinearisedDwells, candidate_columns, change_by_temperature, stimulus_of
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.relinearisation import SETTLED, UNSETTLED, descended, left_to_settle, relinearised
from kf_calib.estimation.score_test import delta_chi2
from kf_calib.noise.flicker import flicker_within
from kf_calib.noise.means import Means
from kf_calib.noise.noise_model import ATTITUDE_UNKNOWN_RAD, FLOOR_MPS2, Noise, slow_waves, steps, within_dwells
from kf_calib.noise.nuisance_states import along_force, sensitivities_of
from kf_calib.noise.reml import (
    Part,
    estimate_variance_components,
    gain_of,
    gauss_markov_gains,
    misfit,
    with_shared_noise,
)
from kf_calib.noise.thermometer_error import sensitivity_to_temperature, thermometer_errors

_PASSES = 3
_PASSES_WITH_UNKNOWNS = 10
_EXACT_RAD = 1e-9
_TURNS = 50  # most times that forces and state are found in turn
_SINGULAR = 100.0
_STILL = 2.5e-4  # the search ends when no step of ln(value) exceeds this share of its largest allowed step


@dataclass(frozen=True, repr=False)
class Fit:
    """The dwells with the columns of the fitted model, and the noise by which they are weighted.

    ``spreads`` gives, by effect, the sigma of ln(value) of each constant without a derivative.
    """

    linearised: LinearisedDwells
    noise: Noise
    spreads: Mapping[str, float] = field(default_factory=dict[str, float])

    @property
    def dwells(self) -> list[DwellFactor]:
        """The dwells that were fitted."""
        return self.linearised.dwells

    @property
    def steps(self) -> Floats:
        """Variances (D, 2) of the biases' steps before and within each dwell; zeros if they do not walk."""
        return steps(self.dwells, self.noise)

    @property
    def state(self) -> Floats:
        """The estimate (p,) from all readings; if the biases walk, it holds their values after the last dwell."""
        return self._solution[0]

    @property
    def sigma(self) -> Floats:
        """Sigmas (p,) of the estimate from all readings, without considered parameters and what is not determined."""
        return np.sqrt(np.diag(self._solution[1]))

    @cached_property
    def _solution(self) -> tuple[Floats, Floats, Floats]:
        factor = square_root_information.accumulate(self.all_rows(), self.steps)[:-1]
        return square_root_information.solve(factor, self.linearised.model.nominal_state())

    @cached_property
    def misfit_rows(self) -> list[Floats]:
        """Whitened rows [H | W | z] by which the misfit is judged, see ``square_root_information.misfit_rows``."""
        linearised = self.linearised
        rows, _ = square_root_information.misfit_rows(
            linearised.dwells_at_state,
            linearised.columns,
            self.noise.for_goodness_of_fit,
            linearised.state,
            linearised.model.count,
        )
        return square_root_information.with_frame(rows, linearised.model, self.noise, len(rows) - len(self.dwells))

    @cached_property
    def following(self) -> list[Floats]:
        """Whitened rows [H | z] of the slews that follow each dwell; (0, p + 1) where none is used."""
        linearised, noise = self.linearised, self.noise.weights.of(moving=True)
        out = [np.zeros((0, linearised.model.count + 1))] * len(self.dwells)
        if linearised.slews:
            rows = square_root_information.whiten(linearised.slews, linearised.slew_columns, noise, linearised.state)
            numbers = [dwell.number for dwell in self.dwells]
            for slew, own in zip(linearised.slews, rows, strict=True):
                place = bisect.bisect_right(numbers, slew.number) - 1
                out[place] = np.vstack([out[place], own])
        return out

    def all_rows(self, noise: Noise | None = None) -> list[Floats]:
        """Whitened rows of each dwell together with those of the slews after it; within a slew the biases are
        constant."""
        out = list[Floats]()
        for own, more in zip(self.rows(noise), self.following, strict=True):
            standing = np.zeros((len(more), own.shape[1] - more.shape[1]))
            out.append(np.vstack([own, np.hstack([standing, more])]) if len(more) else own)
        return out

    @cached_property
    def considered(self) -> Floats:
        """Contribution B (p, p) of considered parameters to the covariance, which becomes P + P B P: constants without
        a derivative, known effects, and the error of the temperature.

        B is the sum of b b^T with b = A^T W g, where A is the design, W the weights and g the change of the readings if
        the constant changes by 1 sigma. The constants are considered parameters: known to be uncertain, but not
        estimated (Schmidt-Kalman filter).
        """
        linearised, out = self.linearised, np.zeros((self.linearised.model.count,) * 2)
        if linearised.model.square:
            out += self._considered(free_attitude.square_changes(linearised))
        if not linearised.model.bench.angles and linearised.model.effects:
            out += self._considered(free_attitude.triad_changes(linearised))
        if self.noise.sensitivity_mps2_per_k is not None:
            out += self._considered(thermometer_errors(linearised.dwells_at_state, self.noise.sensitivity_mps2_per_k))
        for known in linearised.model.known:
            columns = candidate_columns(
                linearised.dwells_at_state, [known.effect], linearised.model.bench, linearised.state
            )
            out += self._considered([own @ known.root for own in columns])
        for effect in linearised.model.stepped:
            spread, part = self.spreads.get(str(effect), 0.0), linearised.model.parts[str(effect)]
            ends = [effect.at(effect.value * math.exp(step)) for step in (spread, -spread)]
            more, less = (
                candidate_columns(linearised.dwells_at_state, [end], linearised.model.bench, linearised.state)
                for end in ends
            )
            out += self._considered(
                [0.5 * (a - b) @ linearised.state[part, None] for a, b in zip(more, less, strict=True)]
            )
        if (flicker_mps2 := self.noise.flicker_mps2) is not None and linearised.model.effects:
            out += self._considered_of_effects(flicker_mps2)
        return out

    def _considered_of_effects(self, flicker_mps2: Floats) -> Floats:
        """Return B (p, p) of the waves of 1/f noise that are slower than a dwell, as far as they enter the coefficients
        of effects: noise that is alike in consecutive dwells looks like a drift, and the scatter from dwell to dwell
        has all of it for the twelve parameters, which do not."""
        columns, sigma = slow_waves(self.linearised.dwells_at_state, flicker_mps2)
        extra = self._considered([values * sigma for values in columns])
        covariance = self._solution[1]
        gained = (covariance @ extra @ covariance)[STATE_COUNT:, STATE_COUNT:]
        seen = np.zeros_like(extra)
        seen[STATE_COUNT:, STATE_COUNT:] = gained
        sizes = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        sizes = np.where(sizes > 0.0, sizes, 1.0)
        inverse = np.linalg.pinv(covariance / np.outer(sizes, sizes), hermitian=True) / np.outer(sizes, sizes)
        return inverse @ seen @ inverse

    def _considered(self, changes: Sequence[Floats]) -> Floats:
        """Return B (p, p) of considered constants from the changes (pieces, K nodes, 3, c) of each dwell's readings by
        1 sigma of each."""
        linearised, count = self.linearised, self.linearised.model.count
        columns = [np.concatenate(both, axis=3) for both in zip(linearised.columns, changes, strict=True)]
        rows = square_root_information.whiten(
            linearised.dwells_at_state,
            columns,
            self.noise.weights,
            linearised.state,
            flicker_mps2=self.noise.flicker_mps2,
        )
        upper = square_root_information.accumulate(rows, self.steps)
        gains = upper[:count, :count].T @ upper[:count, count:-1]
        return gains @ gains.T

    @cached_property
    def walk_gain(self) -> float:
        """Gain in log-likelihood of a random walk of the biases over none, given the stated scatter.

        Scatter that was estimated from the same misfit is left out.
        """
        return self._gain_of("walk")

    @cached_property
    def scatter_gain(self) -> float:
        """Gain in log-likelihood of more noise that is independent from dwell to dwell, scatter or setting error, than
        was stated."""
        return max(self._gain_of("common"), self._gain_of("setting"))

    @cached_property
    def misfit(self) -> float:
        """Chi-squared of the dwells' means under the same likelihood as ``walk_gain`` and ``scatter_gain``."""
        noise, means, prior = self._wandering
        return misfit(noise, means, self.linearised.state, prior)

    def _gain_of(self, part: Part) -> float:
        """Return the gain in log-likelihood of one part of the noise."""
        noise, means, prior = self._wandering
        return gain_of(part, noise, means, self.linearised.state, prior)

    @cached_property
    def _wandering(self) -> tuple[Noise, Means, Floats]:
        """Return the noise without a walk, the means with columns for slow scatter, and the prior of these columns."""
        noise, linearised = replace(self.noise.for_goodness_of_fit, walk_mps2_per_sqrt_s=0.0), self.linearised
        return noise, *with_shared_noise(linearised.dwells, noise, linearised.means)

    @cached_property
    def gauss_markov_gains(self) -> tuple[Floats, Floats]:
        """Gains in log-likelihood (k,) of mean-reverting (Gauss-Markov) walks over the likeliest random walk, and their
        time constants (k,), s.

        The slow part of a stated scatter is allowed for.
        """
        _, means, prior = self._wandering
        return gauss_markov_gains(self.noise.for_goodness_of_fit, means, self.linearised.state, prior)

    @property
    def gauss_markov_gain(self) -> tuple[float, float]:
        """The largest of these gains, 0 where none gains anything, and its time constant, s."""
        gains, times_s = self.gauss_markov_gains
        best = int(np.argmax(gains))
        return max(float(gains[best]), 0.0), float(times_s[best])

    def rows(self, noise: Noise | None = None) -> list[Floats]:
        """Whitened rows [H | z] of each dwell, with the weights of the fit or with another noise."""
        return self._weighted if noise is None else self._whitened(noise)

    @cached_property
    def _weighted(self) -> list[Floats]:
        return self._whitened(self.noise.weights)

    def _whitened(self, noise: Noise) -> list[Floats]:
        linearised = self.linearised
        rows = square_root_information.whiten(
            linearised.dwells_at_state, linearised.columns, noise, linearised.state, flicker_mps2=noise.flicker_mps2
        )
        return square_root_information.with_frame(rows, linearised.model, noise)


def fit(
    dwells: list[DwellFactor],
    model: Model,
    walk_mps2_per_sqrt_s: float = 0.0,
    slews: Sequence[DwellFactor] = (),
    must_settle: bool = True,
) -> Fit:
    """Estimate the noise, the linearisation and the model's unknown constants in turn until they no longer change.

    - dwells: the dwells in order of time.
    - model: the model to fit.
    - walk_mps2_per_sqrt_s: stated intensity of the random walk of the biases, m/s^2/s^(1/2).
    - slews: the slews; used only if the model has effects that show in slews only.
    - must_settle: whether a fit that does not converge is an error; else it is returned as far as it came.

    Raises UnobservableError if the poses tell too little, or if the fit does not converge.
    """
    slews = [slew for slew in slews if slew.number >= dwells[0].number] if model.dynamic else []
    fitted = _begun(dwells, model, slews, walk_mps2_per_sqrt_s)
    model, within, bench = fitted.linearised.model, fitted.noise, model.bench
    searching, sizes, left = False, None, 0.0
    for number in range(_most_passes(model)):
        if number == 1 and model.unknowns:
            model, searching = _placed(fitted), True
            fitted = replace(
                fitted, linearised=relinearised(fitted.linearised, fitted.noise, model, fitted.linearised.state)
            )
        if number and model.stepped:
            model, spreads = _averaged(fitted)
            linearised = relinearised(fitted.linearised, fitted.noise, model, fitted.linearised.state)
            fitted = replace(fitted, linearised=linearised, spreads=spreads)
        state, moved = _solved(fitted)
        if not (bench.angles or _sensible(state)):
            if must_settle:
                raise UnobservableError(_not_sensible(model))
            return fitted
        reach, left = _reach(fitted), _left_to_settle(fitted, state)
        if searching:
            model = model.moved(np.clip(moved, -reach, reach))
        linearised = _moved_to(fitted, model, state)
        state = linearised.state
        stated = _setting_deg(dwells, bench), bench.scatter_sigma_mps2
        within = replace(within, sensitivity_mps2_per_k=_sensitivity_to_temperature(linearised, within))
        means, prior = with_shared_noise(linearised.dwells, within, linearised.means)
        noise, sizes = estimate_variance_components(
            within, means, state, *stated, walks=model.walks, start=sizes, prior=prior
        )
        noise = replace(noise, slew_sigma_mps2=_slew_sigma(fitted, state) if slews else None)
        flicker_mps2 = flicker_within(linearised.dwells_at_state, linearised.columns, state, noise)
        noise = replace(noise, flicker_mps2=flicker_mps2 if flicker_mps2.any() else None)
        turning = noise.weights.setting_rad > 0.0
        fitted = replace(fitted, linearised=linearised, noise=noise)
        if model.walks or noise.attitude_unknown:
            along = _along(linearised, noise)
            own = within_dwells(linearised.dwells, noise.walk_mps2_per_sqrt_s, along)
            within = replace(within, sigma_mps2=own.sigma_mps2, inflation=own.inflation)
        # a constant without a derivative holds the input axes near their linearisation, so that convergence is slow
        still = (np.abs(moved) <= _STILL * reach).all() and not model.stepped
        if number >= _PASSES - 1 and still and (left < SETTLED or not turning):
            return fitted
    if must_settle and not bench.angles and left > UNSETTLED:
        raise UnobservableError(_not_settled(model))
    return fitted


def _sensitivity_to_temperature(linearised: LinearisedDwells, within: Noise) -> Floats | None:
    """Return ``sensitivity_to_temperature`` of the model at its state; None without effects."""
    if not linearised.model.effects:
        return None
    return sensitivity_to_temperature(
        linearised.dwells_at_state, lambda: change_by_temperature(linearised), within.effective_sigma_mps2
    )


def _along(linearised: LinearisedDwells, noise: Noise) -> Floats | None:
    """Return the weights (D, 3) of the channels in the size of the force where attitudes are not known, else None."""
    if not noise.attitude_unknown:
        return None
    return along_force(linearised.dwells_at_state, sensitivities_of(linearised.dwells_at_state, linearised.state))


def _not_settled(model: Model) -> str:
    effects = " and ".join(map(str, model.effects))
    return (
        "the sizes of the readings at rest do not determine "
        + (f"{effects} beside the nine parameters: leave {effects} out" if effects else "the nine parameters")
        + ", or turn it to more sides (the fit does not converge)."
    )


def _not_sensible(model: Model) -> str:
    if model.effects:
        return _not_settled(model)
    return (
        "the sizes of the readings at rest lead to no sensible set of scale factors, biases and angles: check the unit "
        "of the readings (--accel-unit) and gravity, and turn it to more sides."
    )


def _most_passes(model: Model) -> int:
    """Return how often noise, linearisation and constants are estimated in turn at most."""
    if not model.bench.angles:
        return _TURNS
    return _PASSES_WITH_UNKNOWNS


def _begun(dwells: list[DwellFactor], model: Model, slews: Sequence[DwellFactor], walk_mps2_per_sqrt_s: float) -> Fit:
    """Return the fit from which estimation begins: with angles at the nominal state, without at that of the nine
    parameters alone, or of six with square axes where the poses do not tell the rest.

    Raises UnobservableError if the poses tell too little.
    """
    if model.bench.angles:
        within = replace(within_dwells(dwells, walk_mps2_per_sqrt_s), walk_mps2_per_sqrt_s=walk_mps2_per_sqrt_s)
        dwells = [without_attitude(dwell) for dwell in dwells]
        return Fit(LinearisedDwells(dwells, model, model.nominal_state(), slews), within)
    readings, stated = np.array([dwell.means[4:] for dwell in dwells]), model.bench.scatter_sigma_mps2
    facing_up = readings / np.linalg.norm(readings, axis=1, keepdims=True)
    within = within_dwells(dwells, walk_mps2_per_sqrt_s, facing_up)
    noise = replace(
        within, walk_mps2_per_sqrt_s=walk_mps2_per_sqrt_s, setting_rad=ATTITUDE_UNKNOWN_RAD, setting_stated=True,
        scatter_mps2=np.full(3, stated or 0.0), scatter_stated=stated is not None,
    )  # fmt: skip
    bare = Model(model.bench, square=True)
    facing = facing_readings(dwells, bare.nominal_state(), bare.bench.gravity_mps2)
    begun = Fit(LinearisedDwells(facing, bare, bare.nominal_state()), noise)
    free_attitude.refuse_poses(begun.linearised, noise)
    settled = _settled(begun)
    if free_attitude.tells_angles(settled.linearised, noise):
        bare = Model(model.bench)
        settled = _settled(Fit(relinearised(settled.linearised, noise, bare, settled.linearised.state), noise))
    state = np.append(settled.linearised.state, np.zeros(model.count - STATE_COUNT))
    whole = replace(model, square=settled.linearised.model.square)
    return Fit(LinearisedDwells(settled.dwells, whole, state), noise)


def _settled(fitted: Fit) -> Fit:
    """Return the fit of the nine parameters with forces and state found in turn until neither moves."""
    for _ in range(_TURNS):
        state = fitted.state
        if not _sensible(state):
            break
        left = _left_to_settle(fitted, state)
        fitted = replace(fitted, linearised=_moved_to(fitted, fitted.linearised.model, state))
        if left < SETTLED:
            return fitted
    raise UnobservableError(_not_sensible(fitted.linearised.model))


def _left_to_settle(fitted: Fit, state: Floats) -> float:
    """Return by how many sigmas the fit moves from its linearisation; 0 where no attitude moves with it."""
    turning = fitted.noise.weights.setting_rad > 0.0
    return left_to_settle(state, fitted.linearised.state, fitted.sigma) if turning else 0.0


def _moved_to(fitted: Fit, model: Model, state: Floats) -> LinearisedDwells:
    """Return the dwells linearised at a state; nearer where attitudes are not known and the misfit would grow."""
    linearised, noise = fitted.linearised, fitted.noise
    if model is linearised.model and noise.attitude_unknown and not noise.walk_mps2_per_sqrt_s:
        return descended(linearised, noise, state, lambda there: _misfit(replace(fitted, linearised=there)))
    return relinearised(linearised, noise, model, state)


def _misfit(fitted: Fit) -> float:
    """Return chi-squared of a linearisation at its own state."""
    state = fitted.linearised.state
    return float(sum(np.sum((rows[:, -1] - rows[:, :-1] @ state) ** 2) for rows in fitted.all_rows()))


def _sensible(state: Floats) -> bool:
    """Tell whether a state (p,) tells the specific force from the readings."""
    sensitivity = state[:STATE_COUNT].reshape(3, 4)[:, :3]
    return bool(np.isfinite(state).all() and np.linalg.cond(sensitivity) < _SINGULAR)


def _setting_deg(dwells: Sequence[DwellFactor], bench: Bench) -> float | None:
    """Return the stated setting error, deg, combined with the uncertainty of the dwells' poses from noise of the
    angles."""
    pose_rad = float(np.sqrt(np.mean([dwell.pose_sigma_rad**2 for dwell in dwells])))
    if bench.angle_sigma_deg is None or pose_rad < _EXACT_RAD:
        return bench.angle_sigma_deg
    return math.hypot(bench.angle_sigma_deg, math.degrees(pose_rad))


def _solved(fitted: Fit) -> tuple[Floats, Floats]:
    """Return the estimate (p,) with the unknown constants at zero, and the steps (p,) of these constants, zeros
    elsewhere."""
    state = fitted.state.copy()
    moved = np.zeros_like(state)
    places = list(fitted.linearised.model.unknowns)
    moved[places], state[places] = state[places], 0.0
    return state, moved


def _reach(fitted: Fit) -> Floats:
    """Return the largest allowed step (p,) of each state: for an unknown constant by its kind, 1 for the others, which
    are not moved."""
    model, reach = fitted.linearised.model, np.ones(fitted.linearised.model.count)
    if model.unknowns:
        stimulus = stimulus_of(fitted.linearised.dwells_at_state, model.bench, fitted.linearised.state)
        for k, effect in model.unknowns.items():
            reach[k] = effect.reach(stimulus)
    return reach


def _slew_sigma(fitted: Fit, state: Floats) -> Floats:
    """Return the sigmas (3,) of white readings that explain the residuals of the slews about ``state``.

    The ratio of the channels is that of their residuals. The level is set so that the mean square of the whitened
    residuals is one. The rows are weighted sums over whole slews, so that noise that is correlated along a slew (of
    angles, by vibration) is included.
    """
    linearised, rows = fitted.linearised, np.concatenate(fitted.following)
    squares, counts = np.zeros(3), 0
    for slew, columns in zip(linearised.slews, linearised.slew_columns, strict=True):
        model = np.moveaxis(columns @ state, 2, 1)  # (pieces, channels, nodes)
        own = slew.triangles[:, :, slew.width :].copy()
        own[:, : slew.width] -= slew.triangles[:, : slew.width, : slew.width] @ on_basis(np.moveaxis(model, 1, 2))
        squares, counts = squares + (own**2).sum(axis=(0, 1)), counts + slew.count
    sizes = np.sqrt(squares / counts) + FLOOR_MPS2
    factor = square_root_information.accumulate(fitted.all_rows(), fitted.steps)[:-1]
    covariance = square_root_information.solve(factor, state)[1]
    freedom = square_root_information.row_rank(rows) - float(
        np.einsum("rp,pq,rq->", rows[:, :-1], covariance, rows[:, :-1])
    )
    level = np.linalg.norm(rows[:, -1] - rows[:, :-1] @ state) / np.sqrt(max(freedom, 1.0))
    before = fitted.noise.of(moving=True).effective_sigma_mps2
    return np.maximum(level * sizes * np.exp(np.mean(np.log(before / sizes))), FLOOR_MPS2)


def _placed(fitted: Fit) -> Model:
    """Return the model with each unknown constant at the grid value at which its effect lowers chi-squared most."""
    model = fitted.linearised.model
    stimulus = stimulus_of(fitted.linearised.dwells_at_state, model.bench, fitted.linearised.state)
    for effect in model.unknowns.values():
        grid = [effect.at(value) for value in effect.grid(stimulus)]
        model = model.with_effect(grid[_best(fitted, model - effect, grid)])
    return model


def _averaged(fitted: Fit) -> tuple[Model, dict[str, float]]:
    """Return the model with each constant without a derivative at its posterior mean, and the sigma of each constant's
    logarithm.

    The likelihood is exp(decrease of chi^2 / 2) and the prior is flat in ln(value). The likelihood is constant between
    values at which the columns step.
    """
    model, spreads = fitted.linearised.model, dict[str, float]()
    stimulus = stimulus_of(fitted.linearised.dwells_at_state, model.bench, fitted.linearised.state)
    for effect in model.stepped:
        edges = np.log(effect.edges(stimulus))
        middles, widths = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
        deltas = _falls(fitted, model - effect, [effect.at(value) for value in np.exp(middles)])
        weights = np.exp(0.5 * (deltas - deltas.max())) * widths
        mean = float(np.average(middles, weights=weights))
        spreads[str(effect)] = float(np.sqrt(np.average((middles - mean) ** 2 + widths**2 / 12.0, weights=weights)))
        model = model.with_effect(effect.at(math.exp(mean)))
    return model, spreads


def _best(fitted: Fit, rest: Model, grid: Sequence[Effect]) -> int:
    """Return the index of the value in ``grid`` at which the effect lowers chi-squared most beside the ``rest`` of the
    model."""
    return int(np.argmax(_falls(fitted, rest, grid)))


def _falls(fitted: Fit, rest: Model, grid: Sequence[Effect]) -> Floats:
    """Return the decrease of chi-squared for the same effect at several values, each added to the ``rest`` of the
    model."""
    parts, state = fitted.linearised.model.parts, fitted.linearised.state
    state = np.concatenate([state[:STATE_COUNT], *(state[parts[str(effect)]] for effect in rest.effects)])
    return delta_chi2(LinearisedDwells(fitted.dwells, rest, state), fitted.noise.weights, grid)
