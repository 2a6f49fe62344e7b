"""Detection of mistakes in the set-up that make any estimate from the run meaningless.

The model is linear in s_i = K_i E_i. Reversed or exchanged channels and a reversed gimbal can therefore be fitted
exactly, and no p-value shows them. The estimate itself does: the axis of an accelerometer then lies more than 45 deg
from nominal.

  mean reading of dwell d, channel i:  z_di = s_i . f_d + b_i        (D dwells; f_d from the angles)

``refuse`` fits this to the means of the dwells and raises ``BlunderError`` if the result cannot be a calibration. The
message says what is wrong and, if the cause is known, which options correct it. To find the cause it tries the orders
and signs of the channels (48), the sense and order of the gimbals, the unit of the angles and the axis that is up, with
the fewest changes first. No correction is applied automatically, and all changes that give the same readings are named.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.bench.raw_input import CHANNELS
from kf_calib.dwells.table import DwellTable
from kf_calib.errors import BlunderError
from kf_calib.estimation.mountings import (
    _FARTHEST,
    GAIN_RANGE,
    AffineFit,
    Channels,
    DwellMeans,
    Mounting,
    determines_axes,
    fit_affine,
    mountings,
    nominal_sensitivity,
)
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

_DEAD = 0.05  # g; a channel whose means vary by less is dead
_TURNED = 1.0  # g; if gravity along it should have changed by more
_CHANGED = 0.1  # g; a constant reading is stuck if gravity along it should have changed by more
_UNEXPLAINED = 0.05  # g; if the residual rms is larger, the angles do not explain the mean readings
_BETTER = 0.2  # a change explains the readings if it leaves less than this share of the residual
_FAR = 0.75  # g; readings farther from those of a nominal block have another mounting
_NOMINAL = 0.15  # g; largest rms deviation from nominal without a mistake, from biases, scale factors and mounting
_INDISTINCT = 0.25  # g^2; assignments whose sums of squares differ by less explain the readings alike
_MOST_DWELLS = 96  # so many dwells are used at most, spread over the run
_MOST_CHANGES = 4  # largest number of changes of gimbals and channels together
_MOST_NAMED = 3  # largest number of equally good changes in a message
_ALIKE = 0.05  # three scale factors share a deviation if they differ by less than this share of it
_LITTLE = 20e-6  # a smaller deviation of the scale factors is not reported
_FEW_DWELLS = 8  # with more, the other dwells tell the noise, and so a dwell that does not fit
_IN_PLANE = 0.3  # g; gravity has to turn by as much in a plane to show the axes that lie in it
_STUCK = 1e-9  # readings with a smaller relative difference are equal


def refuse(dwells: DwellTable, bench: Bench) -> None:
    """Raise BlunderError, saying what is probably wrong, if these cannot be dwells of the bench as it is stated.

    Nothing is raised while there are too few orientations to tell.
    """
    step = -(-len(dwells) // _MOST_DWELLS)
    means, stated = DwellMeans.of(dwells[::step]), Mounting.stated(bench)
    affine = fit_affine(means, stated)
    is_open = affine is None and not determines_axes(means.readings / bench.gravity_mps2)
    if is_open:
        _refuse_far_from_nominal(means, stated)
    _refuse_silent(means, stated)
    if is_open:
        _refuse_reversed_in_plane(means, stated)
        return
    if affine is not None and affine.left < _UNEXPLAINED:
        if affine.is_near():
            return
        _refuse_wrong_gain(affine, bench)
    wrong = _what_is_wrong(affine, bench)
    _refuse_one_sign(means, stated)
    _refuse_exchange(means, stated)
    mending = _mendings(means, stated, affine)
    if mending:
        one = mending[0] if len({_advice(bench, each) for each in mending}) == 1 else None
        options = "" if one is None or _words(bench, one) else " ".join(_options(bench, one))
        raise BlunderError(f"{wrong}: {_question(bench, mending)}", options)
    if (affine is None or not affine.is_near()) and not _one_dwell(means, stated):
        raise BlunderError(
            f"{wrong}, and no order or sign of channels, gimbals or angles brings all axes near nominal: check what "
            "the channels and the angles are, and state --nominal where the block is mounted so."
        )


def _refuse_silent(means: DwellMeans, stated: Mounting) -> None:
    """Refuse a channel that is constant, or nearly so, although gravity along it should change much."""
    readings, count = means.readings, len(means.readings)
    expected = means.force(stated) @ nominal_sensitivity(stated.bench).T
    same = np.abs(readings - readings[-1]) <= _STUCK * np.abs(readings[-1])
    for i, channel in enumerate(map(abs, stated.bench.input.channels)):
        first = count - int(np.argmin(np.append(same[::-1, i], False)))
        if count - first >= 3 and np.ptp(expected[first:, i]) > _CHANGED:
            since = f"from dwell {means.numbers[first]} on (at {means.middle_s[first]:.0f} s)" if first else "all along"
            raise BlunderError(
                f"channel {channel} is stuck: {since} it reads {readings[-1, i]:.6g} m/s^2 in every orientation; check "
                "its cable and converter, and evaluate what was recorded before."
            )
        spread_mps2 = float(np.ptp(readings[:, i]))
        if spread_mps2 < _DEAD * stated.bench.gravity_mps2 and np.ptp(expected[:, i]) > _TURNED:
            raise BlunderError(
                f"channel {channel} is dead: its mean stays within {spread_mps2:.2g} m/s^2 in {count} dwells in which "
                "gravity along it should change by more than g; check that it is connected and on."
            )


def _refuse_reversed_in_plane(means: DwellMeans, stated: Mounting) -> None:
    """Refuse a run whose gravity stays in one plane, and in which a channel that lies near this plane follows gravity
    with the opposite sign: the plane shows so much of its axis."""
    force, bench = means.force(stated), stated.bench
    readings, count = means.readings / bench.gravity_mps2, len(means.readings)
    _, sizes, directions = np.linalg.svd(force - force.mean(axis=0), full_matrices=False)
    plane = directions[:2]
    if count < 4 or sizes[1] < _IN_PLANE * math.sqrt(count):
        return
    columns = np.column_stack([force @ plane.T, np.ones(count)])
    solution = np.linalg.lstsq(columns, readings, rcond=None)[0]
    left = np.sqrt(np.mean((readings - columns @ solution) ** 2, axis=0))
    nominal = nominal_sensitivity(bench) @ plane.T
    sizes_of = np.linalg.norm(nominal, axis=1) * np.linalg.norm(solution[:2], axis=0)
    cosines = np.sum(nominal * solution[:2].T, axis=1) / np.where(sizes_of > 0.0, sizes_of, np.inf)
    opposite = (np.linalg.norm(nominal, axis=1) > _FARTHEST) & (cosines < -_FARTHEST) & (left < _UNEXPLAINED)
    if not opposite.any():
        return
    one, two, three = (-k if wrong else k for k, wrong in zip(CHANNELS, opposite.tolist(), strict=True))
    numbers = [abs(channel) for channel, wrong in zip(bench.input.channels, opposite.tolist(), strict=True) if wrong]
    wired = _wired(bench, (one, two, three)) + bench.input.restating("channels")
    raise BlunderError(
        f"{_channels(numbers)} -g where +g is expected. Gravity stays in one plane, which does not tell why: the "
        f"channel is reversed (--channels {wired}), or the gimbal turns the other way (a minus in --axes)."
    )


def _refuse_far_from_nominal(means: DwellMeans, stated: Mounting) -> None:
    """Refuse a run in orientations too few to show the axes, whose readings no calibration near nominal gives, if some
    other mounting gives them."""

    def far(mending: Mending) -> float:
        """Return the distance of the readings from those of a nominal block, rms of the dwells, g."""
        expected = means.force(mending.mounting) @ nominal_sensitivity(mending.mounting.bench).T
        readings = means.readings[:, np.abs(mending.channels) - 1] * np.sign(mending.channels)
        return float(np.sqrt(np.mean(np.sum((readings / stated.bench.gravity_mps2 - expected) ** 2, axis=1))))

    if far(Mending(stated, CHANNELS)) < _FAR:
        return
    tried = [Mending(mounting, channels) for mounting in mountings(stated) for channels in _WIRINGS]
    near = [mending for mending in tried if far(mending) < _NOMINAL]
    fewest = min((mending.changes for mending in near), default=0)
    if fewest:
        mendings = sorted((m for m in near if m.changes == fewest), key=lambda m: m.channels != CHANNELS)
        raise BlunderError(f"the readings are not those of the stated mounting: {_question(stated.bench, mendings)}")


def _refuse_wrong_gain(fitted: AffineFit, bench: Bench) -> None:
    """Refuse a channel that measures gravity by another factor than the others, as in another unit."""
    for i, scale in enumerate(fitted.scales.tolist()):
        if not GAIN_RANGE[0] < scale < GAIN_RANGE[1]:
            others = " and ".join(f"{other:.3g}" for other in np.delete(fitted.scales, i))
            raise BlunderError(
                f"channel {abs(bench.input.channels[i])} feels {scale:.3g} times gravity, the others {others}: check "
                "its unit and its range; all channels must be in one unit."
            )


@dataclass(frozen=True)
class Mending:
    """A mounting and an assignment of the channels with which all axes are near nominal."""

    mounting: Mounting
    channels: Channels

    @property
    def changes(self) -> int:
        """Number of changes from what is stated."""
        return self.mounting.changes + _changes_of(self.channels)


def _changes_of(channels: Channels) -> int:
    """Return the number of changes in an assignment of the channels.

    A different order counts as one change and each sign as one; if all signs are reversed, they count as one, the sense
    of the readings.
    """
    reversed_ = sum(channel < 0 for channel in channels)
    order = tuple(map(abs, channels)) != CHANNELS
    return order + (1 if reversed_ == 3 else reversed_)


_WIRINGS: tuple[Channels, ...] = tuple(
    (i * a, j * b, k * c)
    for a, b, c in itertools.permutations(CHANNELS)
    for i, j, k in itertools.product((1, -1), repeat=3)
)
"""The 48 assignments of channels, with signs, to accelerometers."""


def _mendings(means: DwellMeans, stated: Mounting, affine: AffineFit | None) -> list[Mending]:
    """Return the mountings and assignments with the fewest changes that explain the readings with all axes near
    nominal."""
    left = _UNEXPLAINED if affine is None or affine.left < _UNEXPLAINED else max(_BETTER * affine.left, 0.01)
    mendings, fewest = list[Mending](), _MOST_CHANGES
    for mounting in mountings(stated):
        if mounting.changes > fewest:
            break
        fitted = affine if not mounting.changes else fit_affine(means, mounting)
        if fitted is None or fitted.left > left:
            continue
        for channels in _WIRINGS:
            mending = Mending(mounting, channels)
            if mending.changes and mending.changes <= fewest and fitted.is_near(channels):
                fewest = mending.changes
                mendings.append(mending)
    equal = [each for each in mendings if each.changes == fewest]
    return sorted(equal, key=lambda each: each.mounting.changes > 0 and each.channels != CHANNELS)  # mixed changes last


def _what_is_wrong(affine: AffineFit | None, bench: Bench) -> str:
    """Name the channels whose axes are far from nominal or, if there are none, say that the angles do not explain the
    readings."""
    if affine is None:
        return "the readings show the platform in many orientations, the angles in few"
    cosines, numbers = np.diag(affine.cosines), [abs(channel) for channel in bench.input.channels]
    opposite = [channel for channel, cosine in zip(numbers, cosines, strict=True) if cosine < -_FARTHEST]
    reasons = list[str]()
    if opposite:
        reasons.append(f"{_channels(opposite)} -g where +g is expected")
    for channel, cosine in zip(numbers, cosines.tolist(), strict=True):
        if abs(cosine) < _FARTHEST:
            reasons.append(f"the axis of channel {channel} lies {math.degrees(math.acos(cosine)):.0f} deg from nominal")
    return ", ".join(reasons) or f"the angles do not explain the readings ({affine.left:.2g} g rms are left)"


def _channels(numbers: Sequence[int]) -> str:
    """Write ``channel 2 reads`` or ``channels 1, 3 read``."""
    return f"channel {numbers[0]} reads" if len(numbers) == 1 else f"channels {', '.join(map(str, numbers))} read"


def _question(stated: Bench, mendings: Sequence[Mending]) -> str:
    """Say what each of several equally good changes means, and which options state it."""
    said = list(dict.fromkeys((" and ".join(_reasons(stated, each)), _advice(stated, each)) for each in mendings))
    if len(said) == 1:
        reason, advice = said[0]
        return f"{reason}? Try {advice}."
    more = f" (or one of {len(said) - _MOST_NAMED} more)" if len(said) > _MOST_NAMED else ""
    named = ", or ".join(f"{reason} ({advice})" for reason, advice in said[:_MOST_NAMED])
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
        words.append(f"channel {' and '.join(map(str, negative))} reversed")
    return words


def _wired(stated: Bench, channels: Channels) -> str:
    """Return the option's value for channels in the order and with the signs ``channels``, relative to those stated."""
    return ",".join(
        str(int(math.copysign(1, channel)) * stated.input.channels[abs(channel) - 1]) for channel in channels
    )


def _advice(stated: Bench, mending: Mending) -> str:
    """Return the options that state a mounting and, where there is no option, what to do."""
    options = _options(stated, mending)
    return " and ".join([*([" ".join(options)] if options else []), *_words(stated, mending)])


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


def _refuse_one_sign(means: DwellMeans, stated: Mounting) -> None:
    """Refuse a run of few dwells in which all readings are near nominal but one, which has the opposite sign. With more
    dwells an outlying one is told from its own misfit."""
    if not 3 <= len(means.numbers) <= _FEW_DWELLS:
        return
    bench = stated.bench
    expected, readings = means.force(stated) @ nominal_sensitivity(bench).T, means.readings / bench.gravity_mps2
    errors = np.abs(readings - expected)
    k, i = np.unravel_index(int(np.argmax(errors)), errors.shape)
    mended = errors.copy()
    mended[k, i] = abs(readings[k, i] + expected[k, i])
    if errors[k, i] < 1.0 or np.sqrt(np.mean(mended**2)) > _NOMINAL:
        return
    channel, sign = abs(bench.input.channels[i]), "+-"[int(expected[k, i] < 0.0)]
    raise BlunderError(
        f"dwell {means.numbers[k]} (at {means.middle_s[k]:.0f} s): channel {channel} reads {means.readings[k, i]:.5g} "
        f"m/s^2, and {sign}{abs(means.readings[k, i]):.5g} would fit with all other readings: either the sign of this "
        f"reading is wrong, or the pose; correct it, or leave the dwell out (--leave-out {means.numbers[k]})."
    )


def _refuse_exchange(means: DwellMeans, stated: Mounting) -> None:
    """Refuse a run in which the channels change their order or signs between two dwells, with both parts near nominal,
    and which no one assignment explains: a sign shows in no dwell in which gravity is across."""
    if len(means.numbers) < 6:
        return
    bench = stated.bench
    expected, readings = means.force(stated) @ nominal_sensitivity(bench).T, means.readings / bench.gravity_mps2
    wired = np.stack([readings[:, np.abs(own) - 1] * np.sign(own) for own in _WIRINGS])  # (48, D, 3)
    squares = ((wired - expected) ** 2).sum(axis=2)
    before = np.cumsum(squares, axis=1)[:, :-1]  # sums over the dwells up to k, for each assignment
    after = squares.sum(axis=1, keepdims=True) - before
    k = int(np.argmin(before.min(axis=0) + after.min(axis=0)))
    explaining = [part <= part.min() + _INDISTINCT for part in (before[:, k], after[:, k])]
    if (explaining[0] & explaining[1]).any() or not 2 <= k + 1 <= len(readings) - 2:
        return
    first, then = (min(np.flatnonzero(own), key=lambda i: _changes_of(_WIRINGS[i])) for own in explaining)
    if math.sqrt((before[first, k] + after[then, k]) / expected.size) > _NOMINAL:
        return
    wirings = (Mending(stated, _WIRINGS[own]) for own in (first, then))
    told = [" and ".join(_reasons(bench, each)) or "channels are as stated" for each in wirings]
    raise BlunderError(
        f"the channels change in the course of the run: up to dwell {means.numbers[k]} {told[0]}, from dwell "
        f"{means.numbers[k + 1]} on (at {means.middle_s[k + 1]:.0f} s) {told[1]}; evaluate the two parts apart."
    )


def _one_dwell(means: DwellMeans, stated: Mounting) -> bool:
    """Tell whether without some single dwell all axes are near nominal and the angles explain the readings."""
    for k in range(len(means.numbers)):
        found = fit_affine(means[np.arange(len(means.numbers)) != k], stated)
        if found is not None and found.is_near() and found.left < _UNEXPLAINED:
            return True
    return False


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
