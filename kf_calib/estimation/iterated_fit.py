"""The iterated fit of the model and the noise model to the dwells; the filter runs on its result.

Small rotations and input axes are linearised at the current estimate, unknown constants of effects are moved,
and the setting error, the scatter and the random walk of the biases are estimated by restricted
likelihood, in turn until nothing changes any more.

The constants inside effects' formulas (time constants, frequencies, widths) are searched on a grid and refined by
Gauss-Newton steps, in which the derivative with respect to the constant is one more column. A constant without a
derivative is averaged over its posterior.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from kf_calib.bench.arrays import ROUNDING, Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.dwells.rows import on_basis
from kf_calib.dwells.sufficient_statistics import Dwell
from kf_calib.dwells.table import DwellTable
from kf_calib.effects import Effect, RotationEffect
from kf_calib.errors import UnobservableError
from kf_calib.estimation import free_attitude, square_root_information
from kf_calib.estimation.attitude import (
    SETTLED,
    UNSETTLED,
    descended,
    facing_readings,
    left_to_settle,
    relinearised,
    without_attitudes,
)
from kf_calib.estimation.axes_across import AxesAcross
from kf_calib.estimation.dwell_columns import LinearisedDwells, change_by_temperature, stimulus_of
from kf_calib.estimation.fit import Fit
from kf_calib.estimation.measurement_model import SQUARE, Model
from kf_calib.estimation.score_test import delta_chi2
from kf_calib.noise.flicker import with_waves_in_dwells
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.noise_of_readings import with_own_noise
from kf_calib.noise.reml import VarianceComponents, with_shared_noise
from kf_calib.noise.rotations import along_force, sensitivities_of
from kf_calib.noise.temperature_course import sensitivity_to_temperature
from kf_calib.noise.terms import (
    ATTITUDE_UNKNOWN_RAD,
    FLOOR_MPS2,
    RandomWalk,
    Scatter,
    SettingError,
    SquareAxes,
    ThermometerError,
)
from kf_calib.noise.within_dwells import within_dwells
from kf_calib.support.searches import MOST_STEPS
from kf_calib.support.text import listing

_PASSES = 3
_PASSES_WITH_UNKNOWNS = 10
_MANY = 8192  # dwells by which variances are known to one percent, which is enough until the fit nearly settles
_SINGULAR = 100.0
_PASSES_WITH_NOISE = 5  # after which the estimate of the noise does not move the fit any more
_BACK, _ON = -0.5, 0.9  # cosine of a step with the last one
_LEAST_SHARE, _MOST_SHARE = 0.125, 3.0


def fit(
    dwells: DwellTable,
    model: Model,
    walk_mps2_per_sqrt_s: float = 0.0,
    slews: Sequence[Dwell] = (),
    must_settle: bool = True,
    beginning: Fit | None = None,
) -> Fit:
    """Estimate the noise, the linearisation and the model's unknown constants in turn until they no longer change.

    - dwells: the dwells in order of time.
    - model: the model to fit.
    - walk_mps2_per_sqrt_s: stated intensity of the random walk of the biases, m/s^2/s^(1/2).
    - slews: the slews; used only if the model has effects that show in slews only.
    - must_settle: whether a fit that does not converge is an error; else it is returned as far as it came.
    - beginning: that of another fit to the same dwells, where there is one: it need not be searched again.

    Raises UnobservableError if the poses tell too little, or if the fit does not converge.
    """
    slews = [slew for slew in slews if slew.number >= dwells[0].number] if model.dynamic else []
    fitted = _begun(dwells, model, slews, walk_mps2_per_sqrt_s, beginning)
    within, bench = fitted.noise, model.bench
    components = VarianceComponents(_setting_deg(dwells, bench), bench.scatter_sigma_mps2, model.walks)
    left, relaxation = 0.0, _Relaxation()
    for number in range(_most_passes(model)):
        fitted = _with_constants_searched(fitted, number)
        state, constant_steps = estimate_and_steps(fitted)
        if not _sensible(state, model):
            if must_settle:
                raise UnobservableError(_not_sensible(model))
            return fitted
        left, reach = _left_to_settle(fitted, state), largest_steps(fitted)
        if not bench.angles and number > _PASSES_WITH_NOISE:
            state, constant_steps = relaxation.of(fitted, state, constant_steps)
        before, fitted = fitted if slews else None, replace(fitted)  # without its rows, which need much memory
        moved, held = _with_constants_moved(fitted, constant_steps, reach, number)
        linearised = _moved_to(fitted, moved, np.delete(state, held))
        fitted = replace(fitted, linearised=linearised)
        slews_at = state if held else linearised.state  # a constant that is held leaves the model
        slew_sigma_mps2 = _slew_sigma(before, slews_at) if before else None
        fitted = replace(fitted, noise=_noise_at(linearised, within, components, number < _PASSES - 1))
        fitted = replace(fitted, noise=replace(fitted.noise, slew_sigma_mps2=slew_sigma_mps2))
        within = _within_again(fitted, within)
        # a constant without a derivative holds the input axes near their linearisation, so that convergence is slow
        still = (np.abs(constant_steps) <= SETTLED * reach).all() and not model.stepped
        if number >= _PASSES - 1 and still and left < SETTLED:
            return fitted
    if must_settle and not bench.angles and left > UNSETTLED:
        raise UnobservableError(_not_settled(model))
    return fitted


class _Relaxation:
    """How much of a step is taken: half as much as before where it goes back, so that a fit does not swing between two
    places, and more where it goes on in the same direction, so that a slow one arrives."""

    def __init__(self) -> None:
        self.share, self._last = 1.0, np.zeros(0)

    def of(self, fitted: Fit, state: Floats, constant_steps: Floats) -> tuple[Floats, Floats]:
        """Return the state to go to, and the steps of the unknown constants, from those of a fit."""
        start = fitted.linearised.state
        sigma = fitted.sigma_of_determined
        step = np.where(sigma > 0.0, (state - start) / np.where(sigma > 0.0, sigma, 1.0), 0.0)
        if len(self._last) == len(step):
            cosine = float(step @ self._last) / max(float(np.linalg.norm(step) * np.linalg.norm(self._last)), 1e-300)
            if cosine < _BACK:
                self.share = max(0.5 * self.share, _LEAST_SHARE)
            elif cosine > _ON:
                self.share = min(1.25 * self.share, _MOST_SHARE)
        self._last = step
        return start + self.share * (state - start), self.share * constant_steps


def _with_constants_searched(fitted: Fit, number: int) -> Fit:
    """Return the fit with unknown constants on their grids (after the first pass, ``number`` 0), and those without a
    derivative averaged over their posterior."""
    linearised, noise = fitted.linearised, fitted.noise
    if number == 1 and linearised.model.unknowns:
        linearised = relinearised(linearised, noise, placed_on_grid(fitted), linearised.state)
        fitted = replace(fitted, linearised=linearised)
    if number and linearised.model.stepped:
        model, spreads = averaged_over_posterior(fitted)
        fitted = replace(fitted, linearised=relinearised(linearised, noise, model, linearised.state), spreads=spreads)
    return fitted


def _with_constants_moved(fitted: Fit, constant_steps: Floats, reach: Floats, number: int) -> tuple[Model, list[int]]:
    """Return the model with its unknown constants moved by their steps, at most by ``reach``, as it is before they are
    on their grids; and the states that are none any more, since their constants are at an end of their range."""
    model = fitted.linearised.model
    if not number or not model.unknowns:
        return model, []
    held, places = model.held_at_ends(constant_steps) if number >= _PASSES else (model, [])
    return (held, places) if places else (model.moved(np.clip(constant_steps, -reach, reach)), [])


def _noise_at(linearised: LinearisedDwells, within: Noise, components: VarianceComponents, roughly: bool) -> Noise:
    """Return the noise within dwells completed by all that is estimated from the residuals of a linearisation. Of very
    many dwells, some tell ``roughly`` what it is."""
    sensitivity = _sensitivity_to_temperature(linearised, within)
    within = within.without(ThermometerError)
    within = within if sensitivity is None else within.with_terms(ThermometerError(sensitivity))
    if linearised.model.effects:
        within = within.with_terms(AxesAcross(linearised.model, linearised.state))
    means, prior = with_shared_noise(linearised.dwells, within, linearised.means, linearised.state)
    if roughly and not prior.size:
        means = means[:: max(len(means.counts) // _MANY, 1)]
    noise = components.completed(within, means, linearised.state, prior)
    return with_waves_in_dwells(noise, linearised.dwells_at_state, linearised.columns, linearised.state)


def _within_again(fitted: Fit, within: Noise) -> Noise:
    """Return the noise within dwells; estimated anew where it depends on the walk, or on the direction of the force."""
    linearised, noise = fitted.linearised, fitted.noise
    if not (linearised.model.walks or noise.attitude_unknown):
        return within
    again = within_dwells(linearised.dwells, noise.walk_mps2_per_sqrt_s, _along(linearised, noise))
    return replace(within, sigma_mps2=again.sigma_mps2, inflation=again.inflation)


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
    if model.bench.angles:
        effects = ", ".join(map(str, model.effects))
        return (
            f"this run does not tell {effects} and the scale factors apart (the fit does not converge): leave out an "
            "effect, or visit more orientations."
        )
    effects = listing(map(str, model.effects))
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
    return _PASSES_WITH_UNKNOWNS if model.bench.angles or model.stepped else MOST_STEPS


def _begun(
    dwells: DwellTable, model: Model, slews: Sequence[Dwell], walk_mps2_per_sqrt_s: float, beginning: Fit | None
) -> Fit:
    """Return the fit from which estimation begins: with angles at the nominal state, without at that of the nine
    parameters alone."""
    if model.bench.angles:
        dwells = with_own_noise(dwells)
        within = within_dwells(dwells, walk_mps2_per_sqrt_s).with_terms(RandomWalk(np.full(3, walk_mps2_per_sqrt_s)))
        whole = _without(model, ())
        begun = Fit(LinearisedDwells(without_attitudes(dwells), whole, whole.nominal_state(), slews), within)
        if not (redundant := begun.redundant):
            return begun
        model = _without(whole, redundant)
        return replace(begun, linearised=LinearisedDwells(begun.dwells, model, model.nominal_state(), slews))
    nine = beginning or _nine_parameters(dwells, model.bench, walk_mps2_per_sqrt_s)
    state = np.append(nine.linearised.state, np.zeros(model.count - STATE_COUNT))
    whole = replace(model, square=nine.linearised.model.square)
    return Fit(LinearisedDwells(nine.dwells, whole, state), nine.noise, beginning=nine)


def _without(model: Model, symbols: Collection[str]) -> Model:
    """Return a model whose rotations have all coefficients but those of these symbols."""
    without = (each.without(symbols) if isinstance(each, RotationEffect) else each for each in model.effects)
    return replace(model, effects=tuple(without))


def _nine_parameters(dwells: DwellTable, bench: Bench, walk_mps2_per_sqrt_s: float) -> Fit:
    """Return the fit of the nine parameters that tell themselves without angles, or of six with square axes where the
    poses do not tell the rest.

    Raises UnobservableError if the poses tell too little.
    """
    stated, readings = bench.scatter_sigma_mps2, dwells.means[:, 4:]
    facing_up = readings / np.linalg.norm(readings, axis=1, keepdims=True)
    dwells = with_own_noise(dwells, facing_up)
    within = within_dwells(dwells, walk_mps2_per_sqrt_s, facing_up)
    noise = within.with_terms(
        SettingError(ATTITUDE_UNKNOWN_RAD, stated=True),
        Scatter(np.full(3, stated or 0.0), stated=stated is not None),
        RandomWalk(np.full(3, walk_mps2_per_sqrt_s)),
    )
    bare = Model(bench, square=tuple(SQUARE))
    facing = facing_readings(dwells, bare.nominal_state(), bare.bench.gravity_mps2)
    begun = Fit(LinearisedDwells(facing, bare, bare.nominal_state()), noise)
    free_attitude.refuse_poses(begun.linearised, noise)
    settled = _settled(begun, must_settle=False)  # axes that are not square may let it swing between two places
    untold = free_attitude.untold_angles(settled.linearised, noise)
    if untold == bare.square:
        settled = _settled(settled)
    else:
        bare = Model(bench, square=untold)
        settled = _settled(Fit(relinearised(settled.linearised, noise, bare, settled.linearised.state), noise))
    sigmas = free_attitude.square_sigmas(bare, settled.linearised.state)
    return settled if sigmas is None else replace(settled, noise=noise.with_terms(SquareAxes(sigmas)))


def _settled(fitted: Fit, must_settle: bool = True) -> Fit:
    """Return the fit of the nine parameters with forces and state found in turn until neither moves; must_settle:
    whether it is an error if they move for ever."""
    for _ in range(MOST_STEPS):
        state = fitted.state
        if not _sensible(state, fitted.linearised.model):
            break
        left = _left_to_settle(fitted, state)
        fitted = replace(fitted, linearised=_moved_to(fitted, fitted.linearised.model, state))
        if left < SETTLED:
            return fitted
    else:
        if not must_settle:
            return fitted
    raise UnobservableError(_not_sensible(fitted.linearised.model))


def _left_to_settle(fitted: Fit, state: Floats) -> float:
    """Return by how many sigmas the fit moves from its linearisation."""
    return left_to_settle(state, fitted.linearised.state, fitted.sigma_of_determined)


def _moved_to(fitted: Fit, model: Model, state: Floats) -> LinearisedDwells:
    """Return the dwells linearised at a state; nearer where attitudes are not known and the misfit would grow."""
    linearised, noise = fitted.linearised, fitted.noise
    if model is linearised.model and noise.attitude_unknown and not noise.walk.steps:
        return descended(linearised, noise, state, lambda there: _misfit(replace(fitted, linearised=there)))
    return relinearised(linearised, noise, model, state)


def _misfit(fitted: Fit) -> float:
    """Return chi-squared of a linearisation at its own state."""
    state = fitted.linearised.state
    return float(sum(np.sum((rows[:, -1] - rows[:, :-1] @ state) ** 2) for rows in fitted.all_rows()))


def _sensible(state: Floats, model: Model) -> bool:
    """Tell whether a state (p,) can be that of a block: its scale factors are finite and not many times nominal, and
    without angles they tell the specific force from the readings. With angles, effects alone may lead a fit astray."""
    if model.bench.angles and not model.effects:
        return True
    sensitivity, usual = (each[:STATE_COUNT].reshape(3, 4)[:, :3] for each in (state, model.nominal_state()))
    if not np.isfinite(state).all() or np.abs(sensitivity).max() > _SINGULAR * np.abs(usual).max():
        return False
    return model.bench.angles or bool(np.linalg.cond(sensitivity) < _SINGULAR)


def _setting_deg(dwells: DwellTable, bench: Bench) -> float | None:
    """Return the stated setting error, deg, combined with the uncertainty of the dwells' poses from noise of the
    angles."""
    pose_rad = float(np.sqrt(np.mean(dwells.folded.pose_sigmas_rad**2)))
    if bench.angle_sigma_deg is None or pose_rad < ROUNDING:
        return bench.angle_sigma_deg
    return math.hypot(bench.angle_sigma_deg, math.degrees(pose_rad))


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
        own = slew.pieces.plus(-on_basis(np.moveaxis(model, 1, 2)))[:, :, slew.pieces.width :]
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


def estimate_and_steps(fitted: Fit) -> tuple[Floats, Floats]:
    """The estimate (p,) with the unknown constants at zero, and the steps (p,) of these constants, zeros
    elsewhere."""
    state = fitted.state.copy()
    moved = np.zeros_like(state)
    places = list(fitted.linearised.model.unknowns)
    moved[places], state[places] = state[places], 0.0
    return state, moved


def largest_steps(fitted: Fit) -> Floats:
    """The largest allowed step (p,) of each state: for an unknown constant by its kind, 1 for the others, which
    are not moved."""
    model, reach = fitted.linearised.model, np.ones(fitted.linearised.model.count)
    if model.unknowns:
        stimulus = stimulus_of(fitted.linearised.dwells_at_state, model.bench, fitted.linearised.state)
        for k, effect in model.unknowns.items():
            reach[k] = effect.reach(stimulus)
    return reach


def placed_on_grid(fitted: Fit) -> Model:
    """The model with each unknown constant at the grid value at which its effect lowers chi-squared most."""
    model = fitted.linearised.model
    stimulus = stimulus_of(fitted.linearised.dwells_at_state, model.bench, fitted.linearised.state)
    for effect in model.unknowns.values():
        grid = [effect.at(value) for value in effect.grid(stimulus)]
        model = model.with_effect(grid[int(np.argmax(_delta_chi2(fitted, model - effect, grid)))])
    return model


def averaged_over_posterior(fitted: Fit) -> tuple[Model, dict[str, float]]:
    """The model with each constant without a derivative at its posterior mean, and the sigma of each constant's
    logarithm.

    The likelihood is exp(decrease of chi^2 / 2) and the prior is flat in ln(value). The likelihood is constant between
    values at which the columns step.
    """
    model, spreads = fitted.linearised.model, dict[str, float]()
    stimulus = stimulus_of(fitted.linearised.dwells_at_state, model.bench, fitted.linearised.state)
    for effect in model.stepped:
        edges = np.log(effect.edges(stimulus))
        middles, widths = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
        deltas = _delta_chi2(fitted, model - effect, [effect.at(value) for value in np.exp(middles)])
        weights = np.exp(0.5 * (deltas - deltas.max())) * widths
        mean = float(np.average(middles, weights=weights))
        spreads[str(effect)] = float(np.sqrt(np.average((middles - mean) ** 2 + widths**2 / 12.0, weights=weights)))
        model = model.with_effect(effect.at(math.exp(mean)))
    return model, spreads


def _delta_chi2(fitted: Fit, rest: Model, grid: Sequence[Effect]) -> Floats:
    """Return the decrease of chi-squared for the same effect at several values, each added to the ``rest`` of the
    model."""
    parts, state = fitted.linearised.model.parts, fitted.linearised.state
    state = np.concatenate([state[:STATE_COUNT], *(state[parts[str(effect)]] for effect in rest.effects)])
    return delta_chi2(LinearisedDwells(fitted.dwells, rest, state), fitted.noise.weights, grid)
