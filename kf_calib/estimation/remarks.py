"""Sentences on what a user must know about a calibration."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.bench.bench import Bench
from kf_calib.dwells import window_average
from kf_calib.effects import Effect, RotationEffect, remarks_of
from kf_calib.effects.effect import Coefficient, Unknown
from kf_calib.estimation import free_attitude, setup_blunders
from kf_calib.estimation.dwell_columns import LinearisedDwells
from kf_calib.estimation.estimate import Estimate
from kf_calib.estimation.mountings import NOISE
from kf_calib.estimation.results import Consistency, format_p
from kf_calib.noise.noise_model import Noise
from kf_calib.noise.reml import ENOUGH_DIRECTIONS, FEWEST, degrees_of_freedom, directions
from kf_calib.noise.temperature_course import temperature_course
from kf_calib.noise.terms import RandomWalk, ThermometerError
from kf_calib.noise.within_dwells import TOO_SHORT
from kf_calib.support.text import listing
from kf_calib.support.units import shown

MISSING_OR_NOISE = "the dwells scatter about the model by more than the noise: an effect is missing in the model, or "
"""How the sentence begins on a misfit of which no more is known."""


def misfit_remark(judged: Consistency, residuals: Floats, bench: Bench, noise: Noise) -> str:
    """A sentence on what may be wrong if the dwells do not fit the model, from residuals (D, 3); '' if they fit."""
    if judged.trend is not None:
        return (
            f"the readings change within dwells by {judged.trend.ratio:.2f} times the power of noise (p "
            f"{format_p(judged.trend.p_value)}), {judged.trend.most_in_words}: something disturbed "
            "it, or an effect that shows within dwells is missing; diagnose tells which."
        )
    rms = float(np.sqrt(np.mean(residuals**2)))
    if not bench.angles and judged.consistent is False:
        return (
            "the sizes of the readings at rest differ by more than the noise: gravity is not felt alone (a hand that "
            "moves, vibration), or there is scatter or an effect that the nine parameters have not."
        )
    if rms > 0.03 * bench.gravity_mps2:
        return (
            f"the angles do not explain the readings (residual {shown('m/s^2').text(rms, 2)} rms between dwells): "
            "check the order and sign of the axes, the unit of the angles, and which channel is which."
        )
    if judged.consistent is False:
        return f"{MISSING_OR_NOISE}{_beyond_noise(noise)}."
    return ""


def unstated(noise: Noise) -> list[str]:
    """The bench keys of the noise from dwell to dwell that the recording does not state."""
    known = {"angle_sigma_deg": noise.setting.stated, "scatter_sigma_mps2": noise.scatter.stated}
    return [key for key, stated in known.items() if not stated]


def beyond_stated(noise: Noise, bench: Bench) -> bool:
    """Tell whether the setting error is larger than stated, because noise of the angles makes the poses uncertain."""
    return bench.angle_sigma_deg is not None and np.degrees(noise.setting_rad) > 1.1 * bench.angle_sigma_deg


def _beyond_noise(noise: Noise) -> str:
    """Return what else than an effect may make the dwells scatter."""
    keys = listing(unstated(noise))
    if keys:
        return f"there is noise from dwell to dwell, which was not stated ({keys})"
    return "there is more noise from dwell to dwell than is stated (angle_sigma_deg, scatter_sigma_mps2)"


def remarks_on(
    linearised: LinearisedDwells, noise: Noise, estimate: Estimate, judged: Consistency, residuals: Floats
) -> Iterator[str]:
    """Yield one sentence on each thing that a reader of the numbers must know."""
    model, dwells = linearised.model, linearised.dwells
    if model.dynamic and not linearised.slews:
        yield (
            f"{listing(map(str, model.dynamic))} cannot be seen in this recording: it needs slew samples, "
            "readings and angles recorded all through the motions, angles at least every half second."
        )
    yield from (remark for effect in model.effects for remark in remarks_of(effect))
    if model.intensity is not None and not noise.walk.is_alike:
        yield _on_walks(noise.walk, model.intensity)
    if noise.term(ThermometerError) is not None:
        left_c = np.sqrt(np.mean(np.sum(temperature_course(dwells.folded).errors_c ** 2, axis=1)))
        yield (
            f"the noise of the thermometer leaves the temperature uncertain by {left_c:.1g} K, which counts as noise "
            "of the readings: a quieter thermometer would show smaller effects."
        )
    unseen = [symbol for symbol, hidden in zip(paper_parameters.SYMBOLS, estimate.unseen, strict=True) if hidden]
    unseen += [c.symbol for c, s in zip(model.coefficients, estimate.effect_sigma, strict=True) if np.isnan(s)]
    if at_zero := [symbol for each in model.effects if isinstance(each, RotationEffect) for symbol in each.at_zero]:
        yield (
            f"{listing(sorted(at_zero))} {'are' if len(at_zero) > 1 else 'is'} zero by convention: in these "
            "orientations other coefficients do the same, and no reading tells them apart."
        )
    for effect in model.effects:
        if effect.held and effect.unknown is not None:
            yield _on_held(effect, effect.unknown)
    if not model.bench.angles:
        yield from _without_angles(linearised, noise, judged)
    elif unseen:
        names = ", ".join(unseen)
        if is_gross(noise, model.bench):
            yield f"the dwells scatter too much to determine {names}: poses, channels or axes are not what they seem."
        else:
            yield f"these orientations do not determine {names}: visit more, spread over the sphere."
    for effect in model.effects:
        exact = effect.degeneracy(model.bench)
        if exact and any(coefficient.symbol in unseen for coefficient in effect.coefficients):
            yield f"{exact}."
    if judged.dof == 0 and model.bench.angles:
        yield (
            f"{len(dwells)} dwell{'s are' if len(dwells) > 1 else ' is'} too few to test the model: "
            "visit at least five spread orientations."
        )
    elif judged.p_value is None:
        yield (
            "no standard deviation and number of readings were given: the noise is what the dwells scatter about the "
            "model, so whether an effect is missing can be judged only by what that effect would explain of it."
        )
    if misfit := misfit_remark(judged, residuals, model.bench, noise):
        yield misfit
    scales, expected = estimate.parameters[2::4], paper_parameters.nominal(model.bench.nominal)[2::4]
    if not estimate.unseen[2::4].any() and (
        common := setup_blunders.common_scale(scales / expected, estimate.sigma[2::4] / np.abs(expected), model.bench)
    ):
        yield common
    windows = window_average.inflation() if dwells.folded.averaged else 1.0
    if noise.inflation.max() > 1.5 * windows:
        kappa = ", ".join(f"{value / windows:.3g}" for value in noise.inflation)
        usual = float(np.median(dwells.folded.counts))
        short = not dwells.folded.averaged and usual < TOO_SHORT * noise.inflation.max()
        slow = "; dwells are too short to tell how slow it is: stay longer in each" if short else ""
        if judged.quiet:
            slow = "; yet the dwells differ by much less than such noise lets them: what goes on within them alike may "
            slow += "be an oscillation, for which diagnose looks"
        yield f"the noise within a dwell is correlated: sigmas allow for it by inflating its variance by {kappa}{slow}."
    least, most = dwells.folded.weights.min(), dwells.folded.weights.max()
    if least < most:
        yield (
            f"the noise within dwells differs, {most**-0.5:.2g} to {least**-0.5:.2g} times that of "
            "the run: each dwell has the weight of its own."
        )
    if dwells.folded.correlated:
        largest = float(np.abs(dwells.folded.correlations - np.eye(3)).max())
        yield (
            f"the accelerometers share noise within dwells, with a correlation of their means of up to {largest:.2g}, "
            "as of a base that shakes: each dwell is weighted by what they share."
        )
    if noise.setting.considered and noise.scatter_mps2.any() and not noise.scatter.stated:
        known, freedom = directions(linearised.means.force_mps2), degrees_of_freedom(linearised.means)
        yield (
            f"these orientations have gravity in {known} different direction{'s' * (known != 1)}, too few to "
            "distinguish a setting error of the angles from scatter of the sensors: all dwells have the same weight, "
            f"and their whole misfit ({_scatter_in_words(noise, freedom)}) enters every sigma. Visit "
            f"{ENOUGH_DIRECTIONS} spread directions to distinguish them."
        )
    elif model.bench.angles and unstated(noise) and degrees_of_freedom(linearised.means) < FEWEST:
        yield (
            f"{len(dwells)} dwell{'s are' if len(dwells) > 1 else ' is'} too few to estimate what was not stated "
            f"({listing(unstated(noise))}): it is taken as zero; if it is not zero, the sigmas are too small."
        )
    stated_deg = model.bench.angle_sigma_deg
    if stated_deg is not None and beyond_stated(noise, model.bench):
        yield (
            f"the angles are noisy themselves: together with the stated setting error of {stated_deg:g} deg, each "
            f"pose is uncertain by {np.degrees(noise.setting_rad):.2g} deg, which is used to weight the dwells."
        )
    if not noise.setting.stated and noise.for_goodness_of_fit.setting_rad > 0:
        yield (
            f"angle_sigma_deg was not stated; {np.degrees(noise.setting_rad):.2g} deg was estimated from the misfit "
            "between dwells, which an effect not in the model could also cause."
        )


def is_gross(noise: Noise, bench: Bench) -> bool:
    """Tell whether dwells scatter, by an amount that nobody stated, as no sensor does."""
    return not noise.scatter.stated and float(noise.scatter_mps2.max()) > NOISE * bench.gravity_mps2


def _scatter_in_words(noise: Noise, freedom: int) -> str:
    """Return the size of scatter that was estimated; from few degrees of freedom, with how uncertain it is itself: by 1
    / sqrt(2 nu), the standard deviation of a root of chi-squared with nu degrees of freedom."""
    size = shown("m/s^2").text(noise.scatter_mps2[0], 2)
    if freedom >= FEWEST:
        return size
    percent = 100.0 * math.sqrt(0.5 / max(freedom, 1))
    return f"{size}, itself uncertain by {percent:.0f} % with {freedom} degree{'s' * (freedom != 1)} of freedom"


def _on_walks(walk: RandomWalk, intensity: Coefficient) -> str:
    """Return a remark on biases that walk by another amount each."""
    unit, walking = shown(intensity), np.flatnonzero(walk.spreads)
    sizes = [f"{unit.text(float(walk.sizes[k]), 2)} in accelerometer {k + 1}" for k in walking]
    still = listing(str(k + 1) for k in range(3) if k not in walking)
    rest = f"; in accelerometer {still} no walk is seen" if still else ""
    return f"the biases do not walk alike: by {listing(sizes)}{rest}. {intensity.symbol} is their root mean square."


def _on_held(effect: Effect, unknown: Unknown) -> str:
    """Return a remark on a constant that is held at an end of its range."""
    end = "greatest" if effect.value >= unknown.high else "least"
    return (
        f"{unknown.symbol} is held at {shown(unknown).text(effect.value)}, the {end} value that is searched: the "
        f"readings do not bound it on that side, and {effect} may be another effect that looks the same."
    )


def _without_angles(linearised: LinearisedDwells, noise: Noise, judged: Consistency) -> Iterator[str]:
    """Yield what a reader must know of a run without angles: the frame, and what the poses do not tell."""
    model, count = linearised.model, len(linearised.dwells)
    yield (
        "no angles are used: of each pose only |f| = g is known. The frame is that of the sensors: x is the axis of "
        "accelerometer 1, and accelerometer 2 lies in the plane of x and y (theta1, phi1 and nu2 are zero by that); "
        "how the block is mounted, left or right hand, cannot be seen."
    )
    turn = f"next, turn it so that {free_attitude.next_in_words(linearised, noise)}"
    if model.square:
        yield (
            f"these poses do not tell all angles between the axes: {', '.join(model.square)} taken for square to "
            f"{np.degrees(model.bench.square_rad):.3g} deg (--square-sigma), as sigmas and misfit allow for: {turn}."
        )
    elif judged.dof < FEWEST and noise.scatter_mps2.any() and not noise.scatter.stated:
        yield (
            f"scatter between poses ({_scatter_in_words(noise, judged.dof)}) was estimated from the misfit of {count} "
            f"poses and enters every sigma: {turn}."
        )
    elif judged.dof < FEWEST:
        yield f"{count} poses leave {judged.dof} degrees of freedom, too few to see scatter between poses: {turn}."
