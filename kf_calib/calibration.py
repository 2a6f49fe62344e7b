"""The main job: a source in, the twelve parameters with their covariance, the noise and the misfit out.

One pass folds the recording into a factor a dwell (``folding.Folder``); everything after it (noise model, filter
steps, leave-one-orientation-out) works on the factors. The estimate after each dwell is reported with the noise model
of the whole run, so the curves of a replay do not jump when the noise becomes better known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from os import PathLike
from typing import Literal, get_args

import numpy as np
from threadpoolctl import threadpool_limits

from kf_calib import averaging, blunders, information, kalman, paper, stage
from kf_calib.bench import Bench
from kf_calib.dwells import LARGEST_RAD, Block, Segmenter, Tally, dwell_blocks
from kf_calib.effects import of_the_users, remarks_of
from kf_calib.errors import InputError, UnobservableError, check_number
from kf_calib.fitting import WALK, Fit, fit
from kf_calib.folding import (
    Carried,
    DwellFactor,
    Folder,
    Samples,
    columns_of,
    lines_of,
    means_of,
    samples_of,
    without,
)
from kf_calib.held_out import HeldOut, held_out
from kf_calib.information import Step
from kf_calib.likelihood import ENOUGH_DIRECTIONS, FEWEST, directions, freedom
from kf_calib.model import PRIORS, STATE_COUNT, Model, Prior, Rows, model_rows
from kf_calib.noise import TOO_SHORT, Noise, considered, mean_covariances, steps
from kf_calib.outlying import OutlyingDwell, in_words, outlying_dwells
from kf_calib.readings import Readings, Watch
from kf_calib.samples import Floats, Mask, Source
from kf_calib.scan import Frame
from kf_calib.sources.recording import opened
from kf_calib.stillness import Stillness
from kf_calib.tails import f_tail
from kf_calib.visibility import sights
from kf_calib.walk import predicted, to_mean

_HOPELESS = {"rad": np.radians(10.0), "1": 0.2, "m/s^2": 2.0}  # a larger sigma means: not seen by this run
_SHOWN = {"rad": ("arcsec", math.degrees(3600.0)), "1": ("ppm", 1e6), "m/s^2": ("m/s^2", 1.0)}
_CARRIERS = 3  # passes at most in search of one
_CYCLES = 50.0  # a dwell, of a line that may be what is left of a slow oscillation
_SLOW = 0.3  # cycles of a slow oscillation in a dwell: its parabola leaves less than a thousandth of its power
_NEAR = 0.06  # cycles between oscillation and carrier in a piece: a parabola then leaves 1e-3 of its amplitude
Engine = Literal["block", "filterpy"]


@dataclass(frozen=True)
class Settings:
    """How a run is evaluated. Raises InputError where a value cannot be.

    walk_mps2_per_sqrt_s: random walk of the biases (process noise), 0: none. effects: names of those in the model, or
    the name of one.
    window_s: readings are averaged over windows of that length first; 0: only for effects that go with vibration, then
    over windows of a second, or as long as the vibration needs that is seen. left_out: numbers of dwells (from 1) that
    are not used.
    """

    engine: Engine = "block"
    prior: Prior = PRIORS["diffuse"]
    stillness: Stillness = field(default_factory=Stillness)
    gate_sigma: float | None = 6.0
    walk_mps2_per_sqrt_s: float = 0.0
    effects: Sequence[str] = ()
    window_s: float = 0.0
    left_out: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "effects", (self.effects,) if isinstance(self.effects, str) else tuple(self.effects))
        if self.engine not in get_args(Engine):
            raise InputError(f"engine {self.engine!r} is not known: use {' or '.join(get_args(Engine))}.")
        if not isinstance(self.prior, Prior):
            raise InputError(f'prior is {self.prior!r}: give a Prior, for example kf_calib.model.PRIORS["navigation"].')
        if not isinstance(self.stillness, Stillness):
            raise InputError(f"stillness is {self.stillness!r}: give a kf_calib.stillness.Stillness.")
        if self.gate_sigma is not None:
            check_number("gate_sigma (--gate-sigma)", self.gate_sigma, 3.0)
        check_number("walk_mps2_per_sqrt_s (--bias-walk)", self.walk_mps2_per_sqrt_s)
        check_number("window_s", self.window_s)


@dataclass(frozen=True)
class Parameter:
    """An estimate with its sigma in SI units; value and sigma are None where the orientations cannot see it.

    Deviations times ``per_si`` are in ``shown_unit``, the unit of the field.
    """

    symbol: str
    value: float | None
    sigma: float | None
    unit: str
    nominal: float
    shown_unit: str
    per_si: float


@dataclass(frozen=True)
class Estimate:
    """State (p,): the affine twelve, then effects; its covariance; basis (p, q) of the combinations not determined."""

    state: Floats
    covariance: Floats
    undetermined: Floats

    @cached_property
    def parameters(self) -> Floats:
        """The paper's parameters (12,)."""
        return paper.parameters_of(self.state[:STATE_COUNT])

    @cached_property
    def parameter_covariance(self) -> Floats:
        """Their covariance (12, 12), carried over by the closed-form Jacobian."""
        jacobian = paper.jacobian(self.state[:STATE_COUNT])
        return jacobian @ self.covariance[:STATE_COUNT, :STATE_COUNT] @ jacobian.T

    @cached_property
    def unseen(self) -> Mask:
        """Which of the twelve the orientations do not determine, (12,) bool."""
        sigma = np.sqrt(np.diag(self.parameter_covariance))
        unseen = sigma > np.array([_HOPELESS[unit] for unit in paper.UNITS])
        if self.undetermined.size:
            jacobian = paper.jacobian(self.state[:STATE_COUNT])
            unseen |= np.linalg.norm(jacobian @ self._lost[:STATE_COUNT], axis=1) > 1e-6
        return np.asarray(unseen)

    @cached_property
    def _lost(self) -> Floats:
        return self.undetermined / np.linalg.norm(self.undetermined, axis=0)

    @cached_property
    def determined(self) -> Mask:
        """Which numbers of the state the orientations determine, (p,) bool."""
        return np.asarray(np.linalg.norm(self._lost, axis=1) < 1e-9)

    @cached_property
    def sigma(self) -> Floats:
        """1 sigma of the twelve (12,); NaN where not determined."""
        return np.where(self.unseen, np.nan, np.sqrt(np.diag(self.parameter_covariance)))

    @cached_property
    def effects(self) -> Floats:
        """Coefficients of the effects (q,)."""
        return self.state[STATE_COUNT:]

    @cached_property
    def effect_sigma(self) -> Floats:
        """1 sigma of the coefficients (q,); NaN where not determined."""
        sigma = np.sqrt(np.diag(self.covariance)[STATE_COUNT:])
        if self.undetermined.size:
            lost = np.abs(self.undetermined[STATE_COUNT:]).max(axis=1)
            largest = np.abs(self.undetermined).max()
            sigma = np.where(lost > 1e-9 * largest, np.nan, sigma)
        return sigma


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
    fit: Fit
    visits: tuple[Visit, ...]
    estimate: Estimate
    consistency: Consistency
    residual_rms_mps2: float
    tally: Tally
    warnings: tuple[str, ...]
    reread: Callable[..., Calibration] | None = field(default=None, repr=False, compare=False)
    """The same source evaluated anew: for models that need its readings folded otherwise."""
    readings: Readings = field(default_factory=Readings)
    """What the readings themselves show, whatever the model."""
    outlying: tuple[OutlyingDwell, ...] = ()
    """The dwell that alone does not fit, or those of which any one could be it."""
    frames: list[Frame] = field(default_factory=list[Frame], repr=False, compare=False)
    """The candidates' columns, kept for all models of the run."""

    @cached_property
    def refits(self) -> dict[tuple[str, ...], Calibration]:
        """The models that were asked for (``refitted``), by their effects: none is fitted twice."""
        return {}

    @cached_property
    def held_out(self) -> HeldOut | None:
        """What each orientation is predicted to read by a fit without it; None where there are too few."""
        with threadpool_limits(1, user_api="blas"):  # small decompositions
            return held_out(self.fit)

    @property
    def held_out_rms_mps2(self) -> float | None:
        """Rms error of the mean readings of orientations that were left out."""
        return None if self.held_out is None else self.held_out.rms_mps2

    @property
    def held_out_floor_mps2(self) -> float | None:
        """What noise alone would give."""
        return None if self.held_out is None else self.held_out.floor_mps2

    @property
    def noise(self) -> Noise:
        return self.fit.noise

    @property
    def carried(self) -> Carried:
        return self.fit.carried

    @property
    def model(self) -> Model:
        return self.carried.model

    @property
    def parameters(self) -> dict[str, Parameter]:
        """The twelve parameters, then the effects' coefficients, by symbol."""
        estimate, nominal = self.estimate, paper.nominal(self.bench.nominal)
        coefficients, (effects, gains) = self.model.coefficients, self.model.natural(self.estimate.state)
        sigmas = estimate.effect_sigma * gains
        sigmas = np.where((gains != 1.0) & (sigmas > effects), np.nan, sigmas)  # a constant not known within itself
        found = [
            *zip(paper.SYMBOLS, estimate.parameters, estimate.sigma, nominal, paper.UNITS, strict=True),
            *((c.symbol, *own, 0.0, c.unit) for c, *own in zip(coefficients, effects, sigmas, strict=True)),
        ]
        shown = [*(_SHOWN[unit] for unit in paper.UNITS), *((c.shown_unit, c.per_si) for c in coefficients)]
        if self.model.walks:
            intensity, spread = self.noise.walk_mps2_per_sqrt_s, self.noise.walk_spread
            found.append((WALK.symbol, intensity, intensity * spread if spread else math.nan, 0.0, WALK.unit))
            shown.append((WALK.shown_unit, WALK.per_si))
        for effect in self.model.stepped:
            assert effect.unknown is not None
            constant, spread = effect.unknown, self.fit.spreads[str(effect)]
            sigma = effect.value * spread if spread < 1.0 else math.nan  # not known within itself
            found.append((constant.symbol, effect.value, sigma, 0.0, constant.unit))
            shown.append((constant.shown_unit, constant.per_si))
        return {
            symbol: Parameter(
                symbol,
                float(value) if np.isfinite(sigma) else None,
                float(sigma) if np.isfinite(sigma) else None,
                unit,
                float(expected),
                *own,
            )
            for (symbol, value, sigma, expected, unit), own in zip(found, shown, strict=True)
        }

    @property
    def residuals_mps2(self) -> Floats:
        """Mean readings of the dwells less the final estimate, (D, 3)."""
        return np.array([visit.residual_mps2 for visit in self.visits])

    def considering(self, state: Floats, covariance: Floats) -> Estimate:
        """Another engine's state and covariance, the latter enlarged by what is considered only."""
        extra = considered(self.noise, self.carried.means, self.carried.state).sum(axis=0) + self.fit.considered
        return Estimate(state, covariance + covariance @ extra @ covariance, self.estimate.undetermined)

    def __str__(self) -> str:
        from kf_calib.views.console import plain_summary

        return plain_summary(self)

    def __repr__(self) -> str:  # of all arrays in it, it would be megabytes
        return f"<Calibration: {self.model.sum}, {len(self.visits)} dwells, p {format_p(self.consistency.p_value)}>"

    def trace(self) -> Iterator[tuple[float, int, Estimate]]:
        """(elapsed_s, number of the dwell, estimate) within and after every dwell: after a second, two, four ..."""
        model, state, around = self.model, self.carried.state, self.model.nominal_state()
        factor = information.start(self.settings.prior, model)
        extra = np.zeros((model.count, model.count))
        for index, (dwell, columns, (pause, _)) in enumerate(
            zip(self.carried.dwells, self.carried.columns, self.fit.steps, strict=True)
        ):
            before, extra_before = factor, extra
            for part in dwell.prefixes():
                own = [columns[: len(part.pieces)]]
                rows = information.whitened([part], own, self.noise.weights, state)[0]
                walked = np.array([pause, steps([part], self.noise)[0, 1]])
                factor, _ = information.update(before, rows, walked)
                extra = extra_before + considered(self.noise, means_of([part], own), state)[0]
                yield part.end_s, dwell.number, _estimate(factor, around, extra)
            if len(self.fit.following[index]):
                factor, _ = information.update(factor, self.fit.following[index])

    def during(self, dwell: DwellFactor) -> Estimate:
        """The estimate were a dwell that follows the run, and is not in it yet, to end as it is now."""
        fitted, (factor, extra) = self.fit, self.reached
        both, state = [fitted.dwells[-1], dwell], self.carried.state
        own = columns_of(both, self.model, state)[1:]
        rows = information.whitened([dwell], own, self.noise.weights, state)[0]
        factor, _ = information.update(factor, rows, steps(both, self.noise)[-1])
        extra = extra + considered(self.noise, means_of([dwell], own), state)[0]
        return _estimate(factor, self.model.nominal_state(), extra)

    @cached_property
    def reached(self) -> tuple[Floats, Floats]:
        """The filter's factor after the last dwell, and what is considered only, as in the covariance."""
        fitted, first = self.fit, information.start(self.settings.prior, self.model)
        last = information.run(first, fitted.rows(), fitted.steps, fitted.following)[-1]
        extra = considered(self.noise, self.carried.means, self.carried.state)
        return last.factor, extra.sum(axis=0) + fitted.considered


@dataclass
class Pass:
    """One pass over a source: the rows as they come, what was counted and seen, and the dwells folded so far."""

    source: Source
    settings: Settings
    tally: Tally = field(default_factory=Tally)
    folder: Folder = field(default_factory=Folder)
    watch: Watch = field(default_factory=Watch)

    def segmenter(self) -> Segmenter:
        """What cuts the source into dwells, and into slews where an effect of the model shows in them."""
        slews = bool(Model.of(self.source.bench, self.settings.effects).dynamic)
        return Segmenter(self.source.bench, self.settings.stillness, self.tally, slews)

    def rows(self) -> Iterator[Rows]:
        return self.rows_of(dwell_blocks(self.source, self.segmenter()))

    def rows_of(self, blocks: Iterable[Block]) -> Iterator[Rows]:
        model = Model.of(self.source.bench, self.settings.effects)
        usual_s = averaging.WINDOW_S if model.averages else 0.0
        window_s = 0.0 if model.oscillates else self.settings.window_s or usual_s
        return model_rows(blocks, self.source.bench, self.tally, self.settings.gate_sigma, window_s)

    def add(self, rows: Rows) -> None:
        self.folder.add(rows)
        self.watch.add(rows.raw or rows)

    def fold(self, on_progress: Callable[[float], None] | None = None) -> list[DwellFactor]:
        """All dwells of the source that hold enough readings to be used."""
        for rows in self.rows():
            self.add(rows)
            if on_progress is not None:
                on_progress(self.source.fraction)
        return self.dwells

    @property
    def dwells(self) -> list[DwellFactor]:
        """Those folded so far that are used: of at least 8 readings, fewer cannot show their own noise, and not left
        out by the settings."""
        left_out = self.settings.left_out
        if not left_out:
            return [dwell for dwell in self.folder.dwells if dwell.count >= 8]
        unused = {k for k, each in enumerate(self.folder.dwells) if each.count < 8 or each.number in left_out}
        return without(self.folder.dwells, unused)


def calibrate(
    source: Source | str | PathLike[str],
    settings: Settings | None = None,
    on_progress: Callable[[float], None] | None = None,
    plain: Fit | None = None,
) -> Calibration:
    """Evaluate a source (or the recording at a path): fold dwells, model the noise, run the filter, judge the misfit.

    plain: the fit of the same model to the dwells as they are, which is known to need them folded on a carrier.
    Raises InputError where the source holds nothing usable, UnobservableError where one orientation was visited only.
    """
    source, settings = opened(source), settings or Settings()
    with threadpool_limits(1, user_api="blas"):  # small decompositions: with threads they take three times as long
        if Model.of(source.bench, settings.effects).averages and not settings.window_s:
            stage.say("reading how it vibrates")
            settings = replace(settings, window_s=_window_s(source, settings, on_progress))
            stage.say("reading")
        passed = Pass(source, settings)
        if plain is None:
            passed.fold(on_progress)
        return concluded(passed, source, on_progress, plain)


def _window_s(source: Source, settings: Settings, on_progress: Callable[[float], None] | None) -> float:
    """Length of the windows that average the vibration in a source away: from a pass of its own."""
    plain = Pass(source, replace(settings, effects=()))
    return averaging.window_s(lines_of(plain.fold(on_progress)))


def concluded(
    passed: Pass,
    again: Source | None = None,
    on_progress: Callable[[float], None] | None = None,
    plain: Fit | None = None,
) -> Calibration:
    """The calibration of a pass that has come to its end.

    again: the same samples to be read once more, for models that need them folded otherwise; None: they are gone.
    plain: the pass has not begun, since its fit is known, and does not do.
    """
    settings, bench = passed.settings, passed.source.bench
    dwells = passed.dwells if plain is None else plain.dwells
    if plain is None:
        _refuse_absent(settings.left_out, passed.folder.dwells)
        refuse_unusable(dwells, passed.tally, bench)
    stage.say("estimating")
    if again is not None and Model.of(bench, settings.effects).oscillates:
        passed, fitted = _on_carrier(replace(passed, source=again), dwells, plain, on_progress)
    else:
        fitted = _fitted(passed, dwells)
    result = evaluated(fitted, settings)
    refuse_unseen(result)
    if again is not None and settings.engine == "filterpy":
        stage.say("filterpy, reading by reading")
        result = replace(result, estimate=filterpy_estimate(again, result, on_progress=on_progress))
    reread = None if again is None else partial(calibrate, again)
    return replace(told(result, passed), reread=reread)


def told(result: Calibration, passed: Pass) -> Calibration:
    """The result with what its pass counted and saw, and a sentence on each thing that a user must know."""
    outlying = outlying_dwells(result, lambda some: evaluated(_fit_again(result, some), result.settings))
    own = [effect for effect in result.model.effects if of_the_users(effect)]
    notes = [f"{sight}." for sight in sights(result.fit, own)]
    readings = passed.watch.judged(result.fit.dwells, result.noise)
    found = [in_words(outlying)] if outlying else []
    misfit = _misfit(result.consistency, result.residuals_mps2, result.bench, result.noise)
    usual = [each for each in result.warnings if each != misfit or not (outlying or readings.saturation)]
    counted = [*passed.tally.sentences(), *passed.tally.unmet(passed.settings.stillness)]
    said = [*passed.source.warnings, *counted, *readings.warnings, *found, *usual, *notes]
    return replace(result, tally=passed.tally, readings=readings, warnings=tuple(said), outlying=outlying)


def _fit_again(result: Calibration, dwells: list[DwellFactor]) -> Fit:
    """The same model fitted to some of the dwells."""
    return fit(dwells, result.model, result.settings.walk_mps2_per_sqrt_s, result.carried.slews)


def refitted(before: Calibration, effects: Sequence[str]) -> Calibration:
    """The same run with these effects in the model, whatever was in it before: from the dwell factors alone.

    Only effects that need other factors (an oscillation its carrier, some the slews, some averages of the readings)
    cost another pass over the source.
    """
    key = tuple(effects)
    if key not in before.refits:
        before.refits[key] = replace(_refitted(before, key), frames=before.frames)
    return before.refits[key]


def _refitted(before: Calibration, effects: tuple[str, ...]) -> Calibration:
    settings = replace(before.settings, effects=effects)
    model = Model.of(before.bench, settings.effects)
    stage.say(f"refitting with {' + '.join(map(str, model.effects))}" if model.effects else "refitting the twelve")
    other = model.averages and not all(dwell.averaged for dwell in before.fit.dwells)
    if before.reread is not None and (other or (model.dynamic and not before.carried.slews)):
        return before.reread(settings)
    with threadpool_limits(1, user_api="blas"):  # small decompositions, and the same bits every time
        fitted = fit(before.fit.dwells, model, settings.walk_mps2_per_sqrt_s, before.carried.slews)
        if before.reread is not None and not _followed(fitted):
            return before.reread(settings, None, None if fitted.dwells[0].averaged else fitted)
        again = evaluated(fitted, settings)
        return replace(again, tally=before.tally, readings=before.readings, reread=before.reread)


def _on_carrier(
    passed: Pass, dwells: list[DwellFactor], plain: Fit | None, on_progress: Callable[[float], None] | None
) -> tuple[Pass, Fit]:
    """The source folded again on a carrier at the frequency of the model's oscillation, until it is near enough.

    The first carrier is the line in the spectrum; without one, the oscillation is slow, and found on the plain dwells.
    What a parabola leaves of a slow one makes a line of a few cycles a dwell: there the likelier one is taken.
    """
    seen = lines_of(dwells)
    if not seen:
        plain = plain or _fitted(passed, dwells)
        return (passed, plain) if _followed(plain) else _nearer(passed, plain, on_progress)
    shortest_s = min(dwell.end_s - dwell.start_s for dwell in dwells if dwell.count > dwells[0].count // 2)
    found = [_nearer(passed, seen[0].frequency_hz, on_progress)]
    if seen[0].frequency_hz * shortest_s < _CYCLES:
        found.append(_nearer(passed, plain or _fitted(passed, dwells), on_progress))
    return min(found, key=lambda each: _unlikeliness(each[1]))


def _unlikeliness(fitted: Fit) -> float:
    """-2 ln of the likelihood of the noise within dwells and of the misfit of the model, but for a constant."""
    sigma, count = fitted.noise.effective_sigma_mps2, sum(dwell.count for dwell in fitted.dwells)
    return 2.0 * count * float(np.log(sigma).sum()) + consistency(fitted).statistic


def _followed(fitted: Fit) -> bool:
    """Whether the dwells are folded so that they hold the model's oscillation, if it has one: on a carrier, or it is so
    slow that a parabola over a dwell does, or what that leaves would count as correlated noise."""
    dwells = fitted.dwells
    if not fitted.carried.model.oscillates or dwells[0].carrier_hz:
        return True
    longest_s = max(dwell.end_s - dwell.start_s for dwell in dwells)
    return _oscillation_hz(fitted) * longest_s < _SLOW and not lines_of(dwells)


def _nearer(passed: Pass, carrier: float | Fit, on_progress: Callable[[float], None] | None) -> tuple[Pass, Fit]:
    """The source folded on a carrier, in Hz or where a fit has the oscillation, and the fit there."""
    carrier_hz = _oscillation_hz(carrier) if isinstance(carrier, Fit) else carrier
    for left in reversed(range(_CARRIERS)):
        stage.say(f"reading on a carrier of {carrier_hz:.3g} Hz")
        passed = Pass(passed.source, passed.settings, folder=Folder(carrier_hz))
        dwells = passed.fold(on_progress)
        fitted = _fitted(passed, dwells)
        longest_s = max(float(np.ptp(piece.nodes.elapsed_s)) for dwell in dwells for piece in dwell.pieces)
        if not left or abs(_oscillation_hz(fitted) - carrier_hz) * longest_s < _NEAR:
            return passed, fitted
        carrier_hz = _oscillation_hz(fitted)
    raise AssertionError("unreachable: the last of the carriers is taken as it is")


def _fitted(passed: Pass, dwells: list[DwellFactor]) -> Fit:
    settings = passed.settings
    model = Model.of(passed.source.bench, settings.effects)
    return fit(dwells, model, settings.walk_mps2_per_sqrt_s, passed.folder.slews)


def _oscillation_hz(fitted: Fit) -> float:
    return next(effect.value for effect in fitted.carried.model.effects if effect.oscillates)


def evaluate(
    dwells: list[DwellFactor], bench: Bench, settings: Settings, slews: Sequence[DwellFactor] = ()
) -> Calibration:
    """The calibration from dwell factors alone, and those of slews if effects show in them; no pass over the data."""
    return evaluated(fit(dwells, Model.of(bench, settings.effects), settings.walk_mps2_per_sqrt_s, slews), settings)


def evaluated(fitted: Fit, settings: Settings) -> Calibration:
    """The filter run over a fit, its innovations, and the judgement of the misfit."""
    carried, noise, model = fitted.carried, fitted.noise, fitted.carried.model
    first = information.start(settings.prior, model)
    steps = information.run(first, fitted.rows(), fitted.steps, fitted.following)
    extra = considered(noise, carried.means, carried.state)
    final = _estimate(steps[-1].factor, model.nominal_state(), extra.sum(axis=0) + fitted.considered)
    residuals = carried.means.readings - carried.means.design @ final.state
    visits = _visits(fitted, steps, residuals, extra, settings)
    judged = consistency(fitted)
    return Calibration(
        model.bench, settings, fitted, visits, final, judged, float(np.sqrt(np.mean(residuals**2))),
        Tally(), tuple(_remarks(carried, noise, final, judged, residuals)),
    )  # fmt: skip


def filterpy_estimate(
    source: Source,
    result: Calibration,
    form: Literal["square-root", "plain"] = "square-root",
    on_progress: Callable[[float], None] | None = None,
    at_most: float = math.inf,
) -> Estimate:
    """The same posterior by filterpy's filter, sample by sample: a second pass over the source.

    on_progress: with the share of readings that are done. at_most: stop after about so many readings.
    """
    prior, model = result.settings.prior, result.model
    scale = np.concatenate([np.tile([*[result.bench.gravity_mps2] * 3, 1.0], 3), result.carried.sizes[STATE_COUNT:]])
    samples = samples_of(Pass(source, result.settings).rows(), result.carried)
    posterior = kalman.estimate(
        _counted(samples, result.carried, on_progress, at_most),
        result.noise.weights,
        model.nominal_state(),
        None if prior.diffuse else information.prior_covariance(prior, model),
        result.carried.state,
        scale,
        form,
    )
    return result.considering(posterior.state, posterior.covariance)


def _counted(
    samples: Iterable[Samples], carried: Carried, on_progress: Callable[[float], None] | None, at_most: float
) -> Iterator[Samples]:
    """The same samples, their share told as each stretch of them is done, up to a number of readings."""
    total, done = sum(dwell.count for dwell in [*carried.dwells, *carried.slews]), 0
    for piece in samples:
        yield piece
        done += len(piece.readings)
        if on_progress is not None:
            on_progress(done / total)
        if done >= at_most:
            return


def _refuse_absent(left_out: Sequence[int], dwells: Sequence[DwellFactor]) -> None:
    """Raise InputError where a dwell is to be left out that is not there: another one was meant."""
    absent = sorted(set(left_out) - {dwell.number for dwell in dwells})
    if absent and dwells:
        raise InputError(
            f"there is no dwell {absent[0]} to leave out (--leave-out): the run has dwells {dwells[0].number} to "
            f"{dwells[-1].number}."
        )


def refuse_unusable(dwells: list[DwellFactor], tally: Tally, bench: Bench) -> None:
    """Raise InputError where there is nothing to calibrate from, or where the readings are not in m/s^2."""
    if not tally.read:
        raise InputError("the recording holds no accelerometer readings: check that the logger wrote any.")
    if tally.poses_dropped and not tally.poses:
        raise InputError(
            f"none of the {tally.poses_dropped} angle messages can be used: they are not finite, beyond "
            f"{LARGEST_RAD:.0e} rad (counts of an encoder?) or no unit quaternions; record angles in rad or deg, or "
            "unit quaternions."
        )
    if not tally.poses:
        raise InputError(
            "the recording holds no platform angles (or attitude), so the direction of gravity is not known: "
            "record them on /platform/angles, at any rate."
        )
    if not dwells:
        turns = tally.farthest_rad / (2.0 * math.pi)
        unit = f"; angles of up to {turns:.0f} turns look like degrees (--angle-unit deg)" if turns > 3.0 else ""
        raise InputError(
            f"no dwell was found in {tally.read} readings ({tally.moving} moving, {tally.settling} settling, "
            f"{tally.not_finite} not finite, {tally.too_large} too large, {tally.without_pose} without an angle): the "
            f"platform must stand still; if it did, raise --still-deg or lower --settle-s{unit}."
        )
    level = float(np.median([np.linalg.norm(dwell.means[4:]) for dwell in dwells])) / bench.gravity_mps2
    if 0.5 <= level <= 2.0:
        blunders.refuse(dwells, bench)
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


def _estimate(factor: Floats, nominal_state: Floats, extra: Floats) -> Estimate:
    """The estimate of a factor, its covariance P enlarged by what is considered: P + P B P, B = ``extra`` (12, 12)."""
    return _estimates(factor[None], nominal_state, extra)[0]


def _estimates(factors: Floats, nominal_state: Floats, extra: Floats) -> list[Estimate]:
    """The same of many factors (n, p, p + 1), ``extra`` (n, p, p)."""
    states, covariances, undetermined = zip(*information.solved(factors, nominal_state), strict=True)
    covariance = np.array(covariances)
    covariance = covariance + covariance @ extra @ covariance
    return [Estimate(*each) for each in zip(states, covariance, undetermined, strict=True)]


def _visits(fitted: Fit, steps: list[Step], residuals: Floats, extra: Floats, settings: Settings) -> tuple[Visit, ...]:
    carried, means, around = fitted.carried, fitted.carried.means, fitted.carried.model.nominal_state()
    own, walked = mean_covariances(fitted.noise, means, carried.state), to_mean(fitted.steps)
    first, extra = information.start(settings.prior, carried.model), np.concatenate([0.0 * extra[:1], extra])
    factors, extra = np.array([first, *(step.factor for step in steps)]), np.cumsum(extra, axis=0)
    reached = _estimates(factors, around, extra)
    known, visits = reached[:-1], list[Visit]()
    if walked.any():
        before = [predicted(factor, float(step)) for factor, step in zip(factors, walked, strict=False)]
        known = _estimates(np.array(before), around, extra[:-1])
    for k, (dwell, step) in enumerate(zip(carried.dwells, steps, strict=True)):
        innovation, sigma = np.full(3, np.nan), np.full(3, np.nan)
        if not known[k].undetermined.size:
            rows = means.design[k]
            innovation = means.readings[k] - rows @ known[k].state
            predicted_by = np.maximum(np.diag(rows @ known[k].covariance @ rows.T), 0.0)  # rounding, where known little
            sigma = np.sqrt(predicted_by + np.diag(own[k]))
        visits.append(Visit(dwell, reached[k + 1], step.nis, step.dof, innovation, sigma, residuals[k]))
    return tuple(visits)


def consistency(fitted: Fit) -> Consistency:
    """Whether the dwells agree with the fitted model within the noise it is judged by."""
    noise, dwells, rows = fitted.noise, fitted.dwells, fitted.judged
    upper = information.accumulated(rows, fitted.steps)
    statistic = float(upper[-1, -1] ** 2)
    dof = sum(information.row_rank(own) for own in rows) - information.rank(upper[:-1])
    dof -= int(not noise.setting_stated and noise.setting_rad > 0)
    if dof <= 0:
        return Consistency(statistic, 0, None, None)
    noise_dof = float(sum(max(dwell.count - 4, 1) for dwell in dwells) / noise.inflation.mean())
    p_value = f_tail(dof, max(noise_dof, 1.0), statistic / dof)
    return Consistency(statistic, dof, p_value, p_value >= 0.01)


def format_p(p_value: float | None) -> str:
    """``= 0.034``, or a bound where the number has underflowed."""
    return "= -" if p_value is None else "< 1e-300" if p_value < 1e-300 else f"= {p_value:.2g}"


def _misfit(judged: Consistency, residuals: Floats, bench: Bench, noise: Noise) -> str:
    """What may be the matter where the dwells do not fit the model, from residuals (D, 3); '' where they fit."""
    rms = float(np.sqrt(np.mean(residuals**2)))
    if rms > 0.03 * bench.gravity_mps2:
        return (
            f"the angles do not explain the readings (residual {rms:.2g} m/s^2 rms between dwells): check the order "
            "and sign of the axes, the unit of the angles, and which channel is which."
        )
    if judged.consistent is False:
        return (
            "the dwells scatter about the model by more than the noise: an effect is missing in the model, or "
            f"{_beyond_noise(noise)}."
        )
    return ""


def unstated(noise: Noise) -> list[str]:
    """Bench keys of the noise from dwell to dwell that the recording does not state."""
    known = {"angle_sigma_deg": noise.setting_stated, "scatter_sigma_mps2": noise.scatter_stated}
    return [key for key, stated in known.items() if not stated]


def beyond_stated(noise: Noise, bench: Bench) -> bool:
    """Whether the setting error holds more than is stated: what the angles' own noise leaves uncertain of a pose."""
    return bench.angle_sigma_deg is not None and np.degrees(noise.setting_rad) > 1.1 * bench.angle_sigma_deg


def _beyond_noise(noise: Noise) -> str:
    """What dwells may scatter by beside an effect."""
    keys = " and ".join(unstated(noise))
    if keys:
        return f"there is noise from dwell to dwell, which was not stated ({keys})"
    return "there is more noise from dwell to dwell than is stated (angle_sigma_deg, scatter_sigma_mps2)"


def _remarks(
    carried: Carried, noise: Noise, estimate: Estimate, judged: Consistency, residuals: Floats
) -> Iterator[str]:
    """What a reader of the numbers must know, one sentence each."""
    model, dwells = carried.model, carried.dwells
    if model.dynamic and not carried.slews:
        yield (
            f"{' and '.join(map(str, model.dynamic))} cannot be seen in this recording: it needs slew samples, "
            "readings and angles recorded all through the motions, angles at least every half second."
        )
    yield from (remark for effect in model.effects for remark in remarks_of(effect))
    unseen = [symbol for symbol, hidden in zip(paper.SYMBOLS, estimate.unseen, strict=True) if hidden]
    unseen += [c.symbol for c, s in zip(model.coefficients, estimate.effect_sigma, strict=True) if np.isnan(s)]
    if unseen:
        yield f"these orientations do not determine {', '.join(unseen)}: visit more, spread over the sphere."
    for effect in model.effects:
        exact = effect.degeneracy(model.bench)
        if exact and any(coefficient.symbol in unseen for coefficient in effect.coefficients):
            yield f"{exact}."
    if judged.dof == 0:
        yield (
            f"{len(dwells)} dwell{'s leave' if len(dwells) > 1 else ' leaves'} nothing over to judge the model by: "
            "visit at least five spread orientations."
        )
    if misfit := _misfit(judged, residuals, model.bench, noise):
        yield misfit
    scales, expected = estimate.parameters[2::4], paper.nominal(model.bench.nominal)[2::4]
    if not estimate.unseen[2::4].any() and (
        common := blunders.common_scale(scales / expected, estimate.sigma[2::4] / np.abs(expected), model.bench)
    ):
        yield common
    windows = averaging.inflation() if dwells[0].averaged else 1.0
    if noise.inflation.max() > 1.5 * windows:
        kappa = ", ".join(f"{value / windows:.3g}" for value in noise.inflation)
        usual = float(np.median([dwell.count for dwell in dwells]))
        short = not dwells[0].averaged and usual < TOO_SHORT * noise.inflation.max()
        slow = "; dwells are too short to tell how slow it is: stay longer in each" if short else ""
        yield f"the noise within a dwell is correlated: sigmas allow for it by inflating its variance by {kappa}{slow}."
    if not noise.checked and noise.scatter_mps2.any() and not noise.scatter_stated:
        known = directions(carried.means.force_mps2)
        yield (
            f"these orientations have gravity in {known} different direction{'s' * (known != 1)}, which cannot tell a "
            "setting error of the angles from scatter of the sensors: dwells are weighted alike and their whole misfit "
            f"({noise.scatter_mps2[0]:.2g} m/s^2) counts in every sigma; {ENOUGH_DIRECTIONS} directions, spread, would "
            "tell."
        )
    if unstated(noise) and freedom(carried.means) < FEWEST:
        yield (
            f"{len(dwells)} dwell{'s are' if len(dwells) > 1 else ' is'} too few to estimate what was not stated "
            f"({' and '.join(unstated(noise))}): it is taken as zero, and where it is not, sigmas are too small."
        )
    stated_deg = model.bench.angle_sigma_deg
    if stated_deg is not None and beyond_stated(noise, model.bench):
        yield (
            f"the angles' own noise leaves {np.degrees(noise.setting_rad):.2g} deg uncertain of a pose, with the "
            f"{stated_deg:g} deg stated for its setting: that is what dwells are weighted by."
        )
    if not noise.setting_stated and noise.setting_rad > 0:
        yield (
            f"angle_sigma_deg was not stated; {np.degrees(noise.setting_rad):.2g} deg was estimated from the misfit "
            "between dwells, which an effect not in the model could also cause."
        )
