"""Detection of mistakes in the set-up that make any estimate from the run meaningless.

The model is linear in s_i = K_i E_i. Reversed or exchanged channels and a reversed gimbal can therefore be fitted
exactly, and no p-value shows them; but the axes are then far from nominal.

``refuse`` compares what may have been done: what is stated; another order or sign of the channels, or channels that are
dead; another sense or order of the gimbals, unit of the angles or axis that is up; channels that change in the course
of the run; one reading of the wrong sign. Each explains the mean readings to within a misfit (``Misfits``), to which
every change adds what makes it improbable beforehand. If the least misfit is not that of what is stated,
``BlunderError`` says what is wrong, and which options state it. No correction is applied automatically, and all changes
that give the same readings are named.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NoReturn

import numpy as np

from kf_calib.bench.arrays import ROUNDING, Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.paper_parameters import STATE_COUNT
from kf_calib.bench.raw_input import CHANNELS
from kf_calib.dwells.table import DwellTable
from kf_calib.errors import BlunderError
from kf_calib.estimation.mountings import (
    FARTHEST,
    GAIN_RANGE,
    NOISE,
    AffineFit,
    Channels,
    DwellMeans,
    Misfits,
    Mounting,
    determines_axes,
    fit_affine,
    mountings,
    nominal_sensitivity,
)
from kf_calib.noise.reml import FEWEST
from kf_calib.support.tail_probabilities import LEVEL
from kf_calib.support.text import SHOWN, listing
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

_MOST_DWELLS = 96  # so many dwells are used at most, spread over the run
_ALIKE = 0.05  # three scale factors share a deviation if they differ by less than this share of it
_LITTLE = 20e-6  # a smaller deviation of the scale factors is not reported
_CHANGE = -math.log(LEVEL)
"""What every change adds to a misfit, as it has the prior probability LEVEL."""


def refuse(dwells: DwellTable, bench: Bench) -> None:
    """Raise BlunderError, saying what is probably wrong, if these cannot be dwells of the bench as it is stated.

    Nothing is raised while there are too few orientations to tell.
    """
    step = -(-len(dwells) // _MOST_DWELLS)
    means, stated = DwellMeans.of(dwells[::step]), Mounting.stated(bench)
    _refuse_stuck(means, stated)
    affine, misfit = fit_affine(means, stated), float(Misfits.of_mounting(means, stated).of([CHANNELS])[0])
    is_near_nominal = affine is None or affine.is_near_nominal()
    if affine is not None and affine.left < NOISE and affine.is_along():
        _refuse_wrong_gain(means, affine, bench)
    if misfit > _CHANGE:  # else no change could explain more than it costs
        in_course = min(_one_dwell(means, stated), _exchange(means, stated))
        least = min(misfit if is_near_nominal else math.inf, in_course[0])
        _refuse_mounting(means, stated, affine, least)
        if in_course[0] == least < math.inf:
            if in_course[1]:
                raise BlunderError(in_course[1])
            return  # one dwell alone is off
    if not is_near_nominal or (affine is None and determines_axes(means.readings / bench.gravity_mps2)):
        raise BlunderError(
            f"{_what_is_wrong(means, affine, bench)}, and no order or sign of channels, gimbals or angles brings all "
            "axes near nominal: check what the channels and the angles are, and state --nominal where the block is "
            "mounted so."
        )


def _refuse_mounting(means: DwellMeans, stated: Mounting, affine: AffineFit | None, limit: float) -> None:
    """Refuse a run that another mounting or assignment explains, with a misfit below a limit."""
    mendings, bench = list(_mendings(means, stated)), stated.bench
    likeliest = min(mendings, key=lambda each: each.misfit, default=None)
    if likeliest is None or likeliest.misfit >= limit:
        return
    if 0 in likeliest.channels:
        _refuse_dead(means, bench, likeliest.channels.index(0))
    alive = [each for each in mendings if each.changes == likeliest.changes and 0 not in each.channels]
    alike = [each for each in alive if each.misfit < likeliest.misfit + _CHANGE]
    alike.sort(key=lambda each: each.mounting.changes > 0 and each.channels != CHANNELS)  # mixed changes last
    options = "" if _words(bench, alike[0]) else " ".join(_options(bench, alike[0]))
    single = len({_advice(bench, each) for each in alike}) == 1
    raise BlunderError(f"{_what_is_wrong(means, affine, bench)}: {_question(bench, alike)}", options * single)


def _refuse_dead(means: DwellMeans, bench: Bench, i: int) -> NoReturn:
    """Refuse a channel that does not feel gravity."""
    raise BlunderError(
        f"channel {abs(bench.input.channels[i])} is dead: its mean stays within {np.ptp(means.readings[:, i]):.2g} "
        f"m/s^2 in {len(means.numbers)} dwells in which gravity along it should change; check that it is connected and "
        "on."
    )


def _refuse_stuck(means: DwellMeans, stated: Mounting) -> None:
    """Refuse a channel that reads exactly the same in the last dwells, although gravity along it should change."""
    readings, count = means.readings, len(means.readings)
    expected = means.force(stated) @ nominal_sensitivity(stated.bench).T
    same = np.abs(readings - readings[-1]) <= ROUNDING * np.abs(readings[-1])
    for i, channel in enumerate(map(abs, stated.bench.input.channels)):
        first = count - int(np.argmin(np.append(same[::-1, i], False)))
        if count - first >= 3 and np.ptp(expected[first:, i]) > 2.0 * NOISE:
            since = f"from dwell {means.numbers[first]} on (at {means.middle_s[first]:.0f} s)" if first else "all along"
            raise BlunderError(
                f"channel {channel} is stuck: {since} it reads {readings[-1, i]:.6g} m/s^2 in every orientation; check "
                "its cable and converter, and evaluate what was recorded before."
            )


def _refuse_wrong_gain(means: DwellMeans, fitted: AffineFit, bench: Bench) -> None:
    """Refuse a channel that measures gravity by another factor than the others, as in another unit."""
    for i, scale in enumerate(fitted.scales.tolist()):
        if scale < NOISE:
            _refuse_dead(means, bench, i)
        if not GAIN_RANGE[0] < scale < GAIN_RANGE[1]:
            others = listing(f"{other:.3g}" for other in np.delete(fitted.scales, i))
            raise BlunderError(
                f"channel {abs(bench.input.channels[i])} feels {scale:.3g} times gravity, the others {others}: check "
                "its unit and its range; all channels must be in one unit."
            )


@dataclass(frozen=True)
class Mending:
    """A mounting and an assignment of the channels that explain the readings, and the misfit that they leave."""

    mounting: Mounting
    channels: Channels
    misfit: float = 0.0

    @property
    def changes(self) -> int:
        """Number of changes from what is stated."""
        return self.mounting.changes + _changes_of(self.channels)


def _changes_of(channels: Channels) -> int:
    """Return the number of changes in an assignment of the channels.

    A different order counts as one change, as does each sign and each channel that is dead; if all signs are reversed,
    they count as one, the sense of the readings.
    """
    reversed_, dead = sum(channel < 0 for channel in channels), channels.count(0)
    order = any(abs(channel) not in (0, k) for k, channel in zip(CHANNELS, channels, strict=True))
    return order + dead + (1 if reversed_ == 3 else reversed_)


_WIRINGS: tuple[Channels, ...] = tuple(
    (i * a, j * b, k * c)
    for a, b, c in itertools.permutations(CHANNELS)
    for i, j, k in itertools.product((1, -1), repeat=3)
)
"""The 48 assignments of channels, with signs, to accelerometers."""
_WITH_DEAD: tuple[Channels, ...] = (*_WIRINGS, (0, 2, 3), (1, 0, 3), (1, 2, 0), (0, 0, 3), (0, 2, 0), (1, 0, 0))
"""These, and one or two channels that are dead, 0."""


def _mendings(means: DwellMeans, stated: Mounting) -> Iterator[Mending]:
    """Yield the mountings and assignments other than those stated that explain the readings."""
    for mounting in mountings(stated):
        misfits = Misfits.of_mounting(means, mounting).within_noise(_WITH_DEAD)
        for k in np.flatnonzero(np.isfinite(misfits)).tolist():
            mending = Mending(mounting, _WITH_DEAD[k])
            if mending.changes:
                yield replace(mending, misfit=float(misfits[k]) + _CHANGE * mending.changes)


def _what_is_wrong(means: DwellMeans, affine: AffineFit | None, bench: Bench) -> str:
    """Name the channels whose axes are far from nominal or, if there are none, say that the angles do not explain the
    readings."""
    if affine is None and not determines_axes(means.readings / bench.gravity_mps2):
        return "the readings are not those of the stated mounting"
    if affine is None:
        return "the readings show the platform in many orientations, the angles in few"
    cosines, numbers = np.diag(affine.cosines), [abs(channel) for channel in bench.input.channels]
    opposite = [channel for channel, cosine in zip(numbers, cosines, strict=True) if cosine < -FARTHEST]
    reasons = list[str]()
    if opposite:
        reasons.append(f"{_channels(opposite)} -g where +g is expected")
    for channel, cosine in zip(numbers, cosines.tolist(), strict=True):
        if abs(cosine) < FARTHEST:
            reasons.append(f"the axis of channel {channel} lies {math.degrees(math.acos(cosine)):.0f} deg from nominal")
    return ", ".join(reasons) or f"the angles do not explain the readings ({affine.left:.2g} g rms are left)"


def _channels(numbers: Sequence[int]) -> str:
    """Write ``channel 2 reads`` or ``channels 1, 3 read``."""
    return f"channel {numbers[0]} reads" if len(numbers) == 1 else f"channels {', '.join(map(str, numbers))} read"


def _question(stated: Bench, mendings: Sequence[Mending]) -> str:
    """Say what each of several equally good changes means, and which options state it."""
    said = list(dict.fromkeys((listing(_reasons(stated, each)), _advice(stated, each)) for each in mendings))
    if len(said) == 1:
        reason, advice = said[0]
        return f"{reason}? Try {advice}."
    more = f" (or one of {len(said) - SHOWN} more)" if len(said) > SHOWN else ""
    named = ", or ".join(f"{reason} ({advice})" for reason, advice in said[:SHOWN])
    return f"{named}{more}? Each would give these readings: look at the bench to tell."


def _reasons(stated: Bench, mending: Mending) -> list[str]:
    """Return the changes in words."""
    words, channels = list(mending.mounting.words), mending.channels
    moved = [k for k, channel in enumerate(channels, 1) if abs(channel) != k]
    negative = sorted(-channel for channel in channels if channel < 0)
    if stated.input.channels != CHANNELS and (moved or negative):
        return [*words, f"accelerometers 1, 2, 3 are channels {_wired(stated, channels)}"]
    if len(moved) == 2:
        words.append(f"channels {moved[0]} and {moved[1]} are exchanged")
    elif moved:
        words.append(f"accelerometers 1, 2, 3 are channels {', '.join(str(abs(channel)) for channel in channels)}")
    if len(negative) == 3:
        words.append("all readings have the opposite sign (acceleration in place of specific force)")
    elif negative:
        words.append(f"channel {listing(map(str, negative))} reversed")
    return words


def _wired(stated: Bench, channels: Channels) -> str:
    """Return the option's value for channels in the order and with the signs ``channels``, relative to those stated."""
    return ",".join(
        str(int(math.copysign(1, channel)) * stated.input.channels[abs(channel) - 1]) for channel in channels
    )


def _advice(stated: Bench, mending: Mending) -> str:
    """Return the options that state a mounting and, where there is no option, what to do."""
    options = _options(stated, mending)
    return listing([*([" ".join(options)] if options else []), *_words(stated, mending)])


def _options(stated: Bench, mending: Mending) -> list[str]:
    """Return the options that state a mounting."""
    mounting, options = mending.mounting, list[str]()
    if mounting.bench.axes != stated.axes:
        options.append(f'--axes "{mounting.bench.to_metadata()["axes"]}"')
    if mounting.bench.up != stated.up:
        options.append(f"--up {mounting.bench.up}")
    if mounting.angle_unit < 1.0:
        options.append("--angle-unit deg")
    if mending.channels != CHANNELS:
        options.append(f"--channels {_wired(stated, mending.channels)}{stated.input.restating('channels')}")
    return options


def _words(stated: Bench, mending: Mending) -> list[str]:
    """Return what to do where no option states a mounting."""
    mounting, words = mending.mounting, list[str]()
    if stated.axes and mounting.order != tuple(range(len(stated.axes))):
        words.append("--joints with the names of the angles, outer to inner")
    if mounting.angle_unit > 1.0:
        words.append("angles that are converted once")
    if mounting.conjugate or mounting.real_first:
        words.append("quaternions of the platform in the bench, x y z w")
    return words


def _misfit_within_noise(means: DwellMeans, stated: Mounting) -> float:
    """Return the misfit of a mounting with the channels as stated; infinite where noise would not leave so much."""
    return float(Misfits.of_mounting(means, stated).within_noise([CHANNELS])[0])


def _one_dwell(means: DwellMeans, stated: Mounting) -> tuple[float, str]:
    """Return the misfit where one dwell alone is off, which is told from its own misfit; of so few that the others do
    not tell their noise, where the sign of one of its readings is taken for wrong, and a sentence that says so."""
    count = len(means.numbers)
    if 3 * (count - 1) >= STATE_COUNT + FEWEST:
        rest = (means[np.arange(count) != k] for k in range(count))
        least = min(_misfit_within_noise(each, stated) for each in rest)
        return least + _CHANGE + math.log(count), ""
    places, misfits = list(np.ndindex(count, 3)), list[float]()
    for place in places:
        readings = means.readings.copy()
        readings[place] *= -1.0
        misfits.append(_misfit_within_noise(replace(means, readings=readings), stated))
    k, i = places[int(np.argmin(misfits))]
    channel, reading, number = abs(stated.bench.input.channels[i]), means.readings[k, i], means.numbers[k]
    return min(misfits) + _CHANGE + math.log(len(places)), (
        f"dwell {number} (at {means.middle_s[k]:.0f} s): channel {channel} reads {reading:.5g} m/s^2, and "
        f"{-reading:+.5g} would fit with all other readings: either the sign of this reading is wrong, or the pose; "
        f"correct it, or leave the dwell out (--leave-out {number})."
    )


def _exchange(means: DwellMeans, stated: Mounting) -> tuple[float, str]:
    """Return the misfit and a sentence where the channels change their order or signs between two dwells, which is a
    change itself.

    The assignments of both parts are those that are nearest to nominal, but for what changes cost; a sign shows in no
    dwell in which gravity is across.
    """
    bench, count, least, said = stated.bench, len(means.numbers), math.inf, ""
    expected = means.force(stated) @ nominal_sensitivity(bench).T
    wired = np.stack([means.readings[:, np.abs(own) - 1] * np.sign(own) for own in _WIRINGS])  # (48, D, 3)
    squares = ((wired / bench.gravity_mps2 - expected) ** 2).sum(axis=2) / (2.0 * NOISE**2)
    costs = _CHANGE * np.array([[_changes_of(channels)] for channels in _WIRINGS])
    before = np.cumsum(squares, axis=1)  # sums over the dwells up to k, for each assignment
    after = squares.sum(axis=1, keepdims=True) - before
    for k in range(1, count - 2):
        first, then = (int((part[:, k] + costs[:, 0]).argmin()) for part in (before, after))
        readings = np.vstack([wired[first, : k + 1], wired[then, k + 1 :]])
        misfit = _misfit_within_noise(replace(means, readings=readings), stated)
        misfit += _CHANGE + math.log(count) + float(costs[first, 0] + costs[then, 0])
        if misfit < least:
            parts = (listing(_reasons(bench, Mending(stated, _WIRINGS[own]))) for own in (first, then))
            one, other = (part or "channels are as stated" for part in parts)
            at = f"dwell {means.numbers[k + 1]} on (at {means.middle_s[k + 1]:.0f} s)"
            said = f"up to dwell {means.numbers[k]} {one}, from {at} {other}"
            least = misfit
    return least, f"the channels change in the course of the run: {said}; evaluate the two parts apart."


def common_scale(scales: Floats, sigmas: Floats, bench: Bench) -> str:
    """A sentence on three scale factors (3,), relative to nominal, that all deviate by the same amount; '' if they do
    not."""
    off = scales - 1.0
    level = float(off.mean())
    same = np.abs(off - level).max() < max(3.0 * float(sigmas.max()), _ALIKE * abs(level))
    if not (same and abs(level) > max(5.0 * float(sigmas.max()), _LITTLE)):
        return ""
    said = f"the three scale factors are off by the same {1e6 * level:+.0f} ppm, as they are where"
    factor = bench.gravity_mps2 / STANDARD_GRAVITY_MPS2
    if abs(level - (1.0 / factor - 1.0)) < max(5.0 * float(sigmas.max()), _ALIKE * abs(level)):
        return (
            f"{said} readings in units of local gravity ({bench.gravity_mps2:.6g} m/s^2) are taken for such of "
            f"standard gravity ({STANDARD_GRAVITY_MPS2}): if they are, state "
            f"--accel-scale {factor * bench.input.sizes[0]:.8g}{bench.input.restating('accel_scale')}."
        )
    seen_mps2 = bench.gravity_mps2 * (1.0 + level)
    return f"{said} gravity is not {bench.gravity_mps2:.6g} m/s^2 as stated, but {seen_mps2:.6g}."
