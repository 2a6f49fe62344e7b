"""The calibrations of one block over time: drift, repeatability, and when to calibrate again.

Each parameter is modelled by itself. Between calibrations it drifts at a constant rate and walks at random; from run to
run it varies by the repeatability r, which is what handling, mounting and switching off do:

    level(t + dt) = level(t) + drift dt + w,  var w = q^2 dt;   found = level + e,  var e = r^2 + sigma^2,

sigma being that of the calibration. A Kalman filter with diffuse level and drift gives level, drift, and the restricted
likelihood of q and r. Few calibrations tell little of q and r, and a single best pair would make sigmas too small: all
pairs of a grid are weighted by likelihood and prior, flat in ln q and ln r up to the scatter found, falling beyond.

A dozen calibrations cannot tell a walk from poor repeatability, and each of the two makes sure of what the other leaves
open: a walk of the level, repeatability of the drift. Averaged over both, intervals of 95 % cover the next value in 94
to 98 % of simulated histories of whichever kind; the drift in 86 to 94 % where all scatter is a walk, and in every one
where all is repeatability.

Runs of less than a day show repeatability, and neither walk nor drift: what changes a sensor within hours, warmth and
handling, is not what ages it, and a year is thousands of such spans.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.raw_input import RawInput
from kf_calib.errors import InputError
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.support.tail_probabilities import chi_squared_tail
from kf_calib.support.text import parse_date

DAY_S = 86400.0
FEWEST = 2
SHORTEST_DAYS = 1.0
"""Calibrations that span less show no drift."""
_MONTH_DAYS = 30.0
_NAMED = 3
_COVERED = 2.0  # sigmas of a parameter that have to be within its tolerance
_GRID = np.concatenate([[0.0], np.geomspace(0.03, 30.0, 25)])
"""Values of q and r, in units of the scatter that they are to explain."""
_LONGEST_DAYS = 20 * 365.25
_DIFFUSE = 1e8  # variance of level and drift before the first calibration, in units of what is found


@dataclass(frozen=True)
class ParameterTrack:
    """One parameter over the calibrations, in SI and days.

    values (n,), sigmas (n,): as found and calibrated. level, level_sigma: what it is at the last calibration, by all of
    them. drift, drift_sigma: its change per day (None: fewer than three, or within a day); level_drift_covariance: of
    the two. walk: intensity q of its random walk, per square root of a day, rms over what is likely. repeatability: r,
    likewise. constant_p: that a constant parameter shows such differences. predicted, predicted_sigma (n,): each
    calibration as those before it predict it, by the q and r of all; NaN for the first, or the first two where there is
    a drift.
    """

    symbol: str
    unit: str
    values: Floats
    sigmas: Floats
    predicted: Floats
    predicted_sigma: Floats
    level: float
    level_sigma: float
    drift: float | None
    drift_sigma: float | None
    level_drift_covariance: float
    walk: float
    repeatability: float
    constant_p: float

    def known_after(self, days: Floats) -> tuple[Floats, Floats]:
        """Value and sigma (k,) of the parameter in use, so many days (k,) after the last calibration.

        The sigma is by level and drift, by the walk since, and by the repeatability: switched on and mounted once more.
        """
        rate, rate_sigma = (self.drift or 0.0), (self.drift_sigma or 0.0)
        known = self.level_sigma**2 + 2.0 * self.level_drift_covariance * days + (rate_sigma * days) ** 2
        return self.level + rate * days, np.sqrt(known + self.repeatability**2 + self.walk**2 * days)


@dataclass(frozen=True)
class History:
    """All parameters of one block over its calibrations.

    dates (n,): of the calibrations, in order; serial: of the block. due: the date up to which every parameter with a
    tolerance stays within it (95 %), by ``due_by`` (None: no tolerance, longer than twenty years, or, without a drift,
    not to be told). warnings: what its dates and their span do not tell.
    """

    serial: str
    dates: tuple[datetime, ...]
    tracks: tuple[ParameterTrack, ...]
    tolerances: Mapping[str, float]
    due: datetime | None
    due_by: str
    warnings: tuple[str, ...] = ()

    @property
    def days(self) -> Floats:
        """Days (n,) since the first calibration."""
        return np.array([(date - self.dates[0]).total_seconds() / DAY_S for date in self.dates])


def history(calibrations: Sequence[SavedCalibration], tolerances: Mapping[str, float] | None = None) -> History:
    """The history of calibrations of one block, in any order; tolerances: of parameters by symbol, SI.

    Raises InputError for fewer than two, for different blocks or frames, or for two of the same date.
    """
    if len(calibrations) < FEWEST:
        raise InputError(f"a history needs at least {FEWEST} calibrations, {len(calibrations)} is given: save more.")
    ordered = sorted(calibrations, key=date_of)
    serials = {each.provenance.bench.get("block_serial", "") for each in ordered} - {""}
    if len(serials) > 1:
        raise InputError(f"the calibrations are of different blocks ({', '.join(sorted(serials))}): give those of one.")
    if len({bool(each.fixed) for each in ordered}) > 1:
        raise InputError(
            "some of the calibrations were made without angles, in the frame of the sensors, others in that of the "
            "platform: give those of one kind."
        )
    begun = tuple(map(date_of, ordered))
    twice = next((one for one, other in itertools.pairwise(begun) if one == other), None)
    if twice is not None:
        raise InputError(f"two calibrations have the date {twice.isoformat()}: give each once, or its time of day too.")
    days = np.array([(date - begun[0]).total_seconds() / DAY_S for date in begun])
    tracks = tuple(_track(k, ordered, days) for k in _common(ordered))
    wanted = dict(tolerances or {})
    unknown = sorted(set(wanted) - {track.symbol for track in tracks})
    if unknown:
        raise InputError(f"{unknown[0]} has a tolerance, but not all calibrations determine it: leave it out.")
    due, by = _due(tracks, wanted)
    date = None if due is None else begun[-1] + timedelta(days=due)
    warnings = (*_undated(ordered), *_of_other_inputs(ordered), *_of_the_span(days))
    return History(next(iter(serials), ""), begun, tracks, wanted, date, by, warnings)


def date_of(saved: SavedCalibration) -> datetime:
    """When the run of a calibration began, or, where its file does not say that, when it was computed."""
    text = saved.conditions.began or saved.provenance.created
    try:
        return parse_date(text)
    except ValueError:
        raise InputError(f"{text!r} is no date: a calibration needs one (ISO 8601).") from None


def _undated(calibrations: Sequence[SavedCalibration]) -> list[str]:
    """Return a sentence about the calibrations whose files do not say when their runs began, if there are any."""
    those = [own.provenance for own in calibrations if own.conditions.began is None]
    if not those:
        return []
    which = ", ".join(f"{each.recording or 'without a recording'}, {each.created}" for each in those[:_NAMED])
    return [
        f"{len(those)} of the {len(calibrations)} calibrations do not say when their runs began, and are dated by when "
        f"they were computed ({which}{', ...' * (len(those) > _NAMED)}): evaluate those runs again with --date and "
        "--save, if they are older"
    ]


def _of_other_inputs(calibrations: Sequence[SavedCalibration]) -> list[str]:
    """Return a sentence if the calibrations convert raw readings differently: their scale factors then differ, too."""
    inputs = dict.fromkeys(str(RawInput.from_metadata(saved.provenance.bench)) for saved in calibrations)
    if len(inputs) < 2:
        return []
    return [f"the calibrations take different raw readings ({'; '.join(inputs)}): a change of the size of a count is a "
            "step of the scale factors, which is none of the block's"]  # fmt: skip


def _of_the_span(days: Floats) -> list[str]:
    """Return a sentence if the calibrations lie so close together that they tell little or nothing of a drift."""
    span = float(days[-1])
    if span < SHORTEST_DAYS:
        spans = f"{24.0 * span:.1f} h" if span > 1.0 / 24.0 else f"{1440.0 * span:.0f} min"
        return [f"the calibrations span {spans}, too short to tell a drift: they show repeatability alone, and no date "
                "of the next one follows"]  # fmt: skip
    if len(days) == FEWEST:
        return ["two calibrations show no drift apart from repeatability, and no date of the next one: save a third"]
    if span < _MONTH_DAYS:
        return [f"the calibrations span {span:.1f} days, so that the drift of a year is theirs, extrapolated "
                f"{365.25 / span:.0f}-fold: calibrate again some months later to know it"]  # fmt: skip
    return []


def _common(calibrations: Sequence[SavedCalibration]) -> list[str]:
    """Return the parameters that every calibration determines, the twelve first."""
    known = [{p.symbol for p in each.parameters if p.sigma is not None} for each in calibrations]
    both = set.intersection(*known)
    first = [p.symbol for p in calibrations[0].parameters if p.symbol in both]
    return sorted(first, key=lambda symbol: symbol not in paper_parameters.SYMBOLS)  # stable


def _track(symbol: str, calibrations: Sequence[SavedCalibration], days: Floats) -> ParameterTrack:
    """Return the track of one parameter."""
    of_each = [next(p for p in each.parameters if p.symbol == symbol) for each in calibrations]
    if len(units := sorted({p.unit for p in of_each})) > 1:
        raise InputError(f"{symbol} is in {' and in '.join(units)} in these calibrations: give those of one model.")
    values, sigmas = (np.array([getattr(p, key) for p in of_each], float) for key in ("value", "sigma"))
    known = 1.0 / np.maximum(sigmas, 1e-300) ** 2
    mean = float(known @ values / known.sum())
    constant_p = chi_squared_tail(len(values) - 1, float(known @ (values - mean) ** 2))
    with_drift = len(values) > FEWEST and float(days[-1]) >= SHORTEST_DAYS
    found_by = _filtered(values, sigmas, days, *_pairs(values, sigmas, days, with_drift), with_drift)
    weights = found_by.weights
    walk, repeatability = (math.sqrt(weights @ each**2) for each in (found_by.walks, found_by.repeatabilities))
    state = weights @ found_by.states
    apart = found_by.states - state
    covariance = np.einsum("m,mij->ij", weights, found_by.covariances + apart[:, :, None] * apart[:, None, :])
    predicted = weights @ found_by.predicted
    predicted_variance = weights @ (found_by.predicted_variances + (found_by.predicted - predicted) ** 2)
    return ParameterTrack(
        symbol, of_each[0].unit, values, sigmas, predicted, np.sqrt(predicted_variance), float(state[0]),
        math.sqrt(covariance[0, 0]), float(state[1]) if with_drift else None,
        math.sqrt(covariance[1, 1]) if with_drift else None, float(covariance[0, 1]) * with_drift, walk, repeatability,
        constant_p,
    )  # fmt: skip


def _pairs(values: Floats, sigmas: Floats, days: Floats, with_walk: bool) -> tuple[Floats, Floats, Floats]:
    """Return all pairs of walk q and repeatability r, (m,) each, and the logarithm of their prior (m,)."""
    spread = max(float(np.std(values, ddof=1)), float(np.median(sigmas)))
    steps = np.diff(days)
    apart = steps[steps >= SHORTEST_DAYS]  # what differs within a day is repeatability
    step = float(np.median(apart)) if apart.size else SHORTEST_DAYS
    prior = -np.log(np.maximum(_GRID, 1.0))
    count = len(_GRID) if with_walk else 1  # two calibrations, or hours, cannot tell a walk from repeatability
    walks, repeatabilities = np.meshgrid(_GRID[:count] * spread / math.sqrt(step), _GRID * spread, indexing="ij")
    return walks.ravel(), repeatabilities.ravel(), np.add.outer(prior[:count], prior).ravel()


@dataclass(frozen=True)
class _Filtered:
    """What the filter gives with m pairs of walk and repeatability.

    weights (m,): of the pairs, by likelihood and prior, of sum 1. states (m, 2), covariances (m, 2, 2): level and drift
    after the last calibration. predicted (m, n), predicted_variances (m, n): of each calibration by those before it.
    """

    walks: Floats
    repeatabilities: Floats
    weights: Floats
    states: Floats
    covariances: Floats
    predicted: Floats
    predicted_variances: Floats


def _filtered(
    values: Floats, sigmas: Floats, days: Floats, walks: Floats, repeatabilities: Floats, prior: Floats,
    with_drift: bool,
) -> _Filtered:  # fmt: skip
    """Run the filter over the calibrations for all pairs at once.

    The first calibrations, which only fill the diffuse state, predict nothing and do not count in the likelihood.
    """
    size = max(float(np.abs(values - values[0]).max()), float(sigmas.max()), 1e-300)
    span = max(float(days[-1] - days[0]), 1e-9)
    m, n = len(walks), len(values)
    state, covariance = np.tile([values[0], 0.0], (m, 1)), np.zeros((m, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = _DIFFUSE * size**2, with_drift * _DIFFUSE * (size / span) ** 2
    predicted, variances, logarithm = np.full((m, n), np.nan), np.full((m, n), np.nan), prior.copy()
    for k in range(n):
        if k:
            onward = np.array([[1.0, days[k] - days[k - 1]], [0.0, 1.0]])
            state, covariance = state @ onward.T, onward @ covariance @ onward.T
            covariance[:, 0, 0] += walks**2 * (days[k] - days[k - 1])
        noise = repeatabilities**2 + sigmas[k] ** 2
        variance, innovation = covariance[:, 0, 0] + noise, values[k] - state[:, 0]
        if k > with_drift:
            predicted[:, k], variances[:, k] = state[:, 0], variance
            logarithm -= 0.5 * (innovation**2 / variance + np.log(variance))
        gain = covariance[:, :, 0] / variance[:, None]
        state = state + gain * innovation[:, None]
        left = np.eye(2) - gain[:, :, None] * np.array([1.0, 0.0])
        added = noise[:, None, None] * gain[:, :, None] * gain[:, None, :]
        covariance = left @ covariance @ np.swapaxes(left, 1, 2) + added  # Joseph's form
    relative = np.exp(logarithm - logarithm.max())
    return _Filtered(walks, repeatabilities, relative / relative.sum(), state, covariance, predicted, variances)


def _due(tracks: Sequence[ParameterTrack], tolerances: Mapping[str, float]) -> tuple[float | None, str]:
    """Return after how many days the first parameter may leave its tolerance, and which; None beyond twenty years."""
    first: tuple[float | None, str] = (None, "")
    for track in tracks:
        if track.symbol in tolerances:
            days = _within(track, tolerances[track.symbol])
            if days is not None and (first[0] is None or days < first[0]):
                first = days, track.symbol
    return first


def _within(track: ParameterTrack, tolerance: float) -> float | None:
    """Return for how many days the last calibration's value is within a tolerance of a parameter; None beyond twenty
    years.

    |what it is then - what was found last| + 2 sigma, seen every day.
    """
    days = np.arange(0.0, _LONGEST_DAYS)
    value, sigma = track.known_after(days)
    beyond = np.flatnonzero(np.abs(value - track.values[-1]) + _COVERED * sigma > tolerance)
    return None if not beyond.size else float(max(days[beyond[0]] - 1.0, 0.0))
