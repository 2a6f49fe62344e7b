"""The verdict of a diagnosis in one sentence."""

from __future__ import annotations

import numpy as np

from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.scatter_hypothesis import dwell_noise_is_stated
from kf_calib.diagnosis.unknown_effect import one_digit_seconds
from kf_calib.estimation.oscillation_carrier import holds_its_oscillation
from kf_calib.estimation.results import format_p
from kf_calib.support.units import shown


def verdict_in_words(found: Diagnosis) -> str:
    """The verdict of a diagnosis in one sentence, with what else it could be."""
    test = found.test
    if test.consistent is None:
        return "The model cannot be tested: there are no more measurements than parameters. Visit more orientations."
    if test.consistent:
        blind = f" This run cannot show {len(test.unseen)} of {test.count} effects." if test.unseen else ""
        noise = found.before.noise
        if not (noise.within_seen or noise.scatter_stated):
            return (
                f"No effect explains a significant part of the scatter of the dwells (p {format_p(test.p_value)}), "
                f"from which all noise was estimated.{blind}"
            )
        agreed = f"The model agrees with the measurements (p {format_p(test.p_value)})"
        return f"{agreed}: no effect is missing that this run could show.{blind}"
    start = f"Residuals fail (p {format_p(test.p_value)})."
    if found.missing and found.after is not None:
        return f"{start} {_explanation(found)}.{_held_out(found)}"
    if found.unknown:
        return f"{start} {_why_unknown(found)}"
    noise, nearest = found.before.noise, _nearest(found)
    stated = ("angle_sigma_deg", noise.setting_stated), ("scatter_sigma_mps2", noise.scatter_stated)
    keys = " and ".join(key for key, known in stated if not known)
    effect = f"an effect is missing ({nearest} would fit)" if nearest else "an unknown effect is missing"
    return (
        f"{start} Either the dwells scatter by an amount that was not stated, or {effect}. "
        f"To find out, state {keys} or repeat an orientation."
    )


def second_pass_in_words(found: Diagnosis) -> str:
    """A sentence on what only a second pass over the readings could judge; "" where nothing is left to it."""
    names = [suspect.name for suspect in found.suspects if not holds_its_oscillation(suspect.refit.fit)]
    if found.test.vibration and not found.before.fit.dwells[0].averaged:
        names.append("the lines in their spectrum")
    if not names:
        return ""
    return (
        f" A second pass over the readings is needed to judge {' and '.join(names)}: diagnose the recording, or give "
        "its Refits to diagnose."
    )


def _explanation(found: Diagnosis) -> str:
    """Return the missing effects, and the explanations from which they cannot be distinguished."""
    rivals, (first, *more) = _rivals(found), found.missing
    if more:
        named = f"{' and '.join(found.missing)} together explain it; no single known effect does as well"
    else:
        sure = len(found.ambiguity) <= 1 and not found.as_scatter and not found.back_s
        named = f"{'Missing' if sure else 'Likeliest'}: {first}{_size(found)}"
    return f"{named}. Cannot yet be distinguished from {', '.join(rivals)}" if rivals else named


def _rivals(found: Diagnosis) -> list[str]:
    """Return in words the explanations from which the missing effects cannot be distinguished."""
    instead = "" if len(found.missing) == 1 else "in place of one of them, "
    out = [
        f"{name} alone" if name == found.alone else f"{name} ({instead}overlap {overlap:.2f})"
        for name, overlap in found.overlaps.items()
    ]
    out += [f"{' and '.join(pair)} together" for pair in found.together]
    if found.as_scatter:
        out.append(_scattering(found))
    if found.back_s:
        out.append(f"biases that return to their mean within about {one_digit_seconds(found.back_s)}")
    return out


def _why_unknown(found: Diagnosis) -> str:
    """Return a sentence on why the cause is unknown."""
    nearest = _nearest(found)
    if nearest and found.as_scatter:
        return f"{nearest} would fit, but {_scattering(found)} is likelier: unknown. Repeat an orientation to find out."
    if nearest:
        return f"{nearest} would fit, but a formula that is no known effect explains it better: unknown."
    return "No known effect explains it, alone or in pairs: unknown."


def _nearest(found: Diagnosis) -> str | None:
    """Return the likeliest suspect that fits."""
    return next((each.name for each in found.suspects if each.fits), None)


def _scattering(found: Diagnosis) -> str:
    """Return the words for scatter from dwell to dwell as an explanation."""
    return f"scatter from dwell to dwell larger than {'stated' if dwell_noise_is_stated(found.before) else 'estimated'}"


def _size(found: Diagnosis) -> str:
    """Return, as text, the most significant coefficient of the first missing effect and its constant, with sigmas."""
    assert found.after is not None
    parameters = found.after.parameters
    first = next(each for each in found.after.model.effects if str(each) == found.missing[0])
    sized = [parameters[c.symbol] for c in first.parameters]
    told = [max(sized, key=lambda p: abs(p.value or 0.0) / (p.sigma or np.inf))]
    told += [parameters[first.unknown.symbol]] if first.unknown else []
    return "".join(
        f", {p.symbol} = {shown(p).number(p.value)} ± {shown(p).text(p.sigma, 2)}"
        for p in told
        if p.value is not None and p.sigma
    )


def _held_out(found: Diagnosis) -> str:
    """Return a sentence about the change of the held-out error, or "" where it is not known."""
    before, after = found.before, found.after
    assert after is not None
    if before.held_out_rms_mps2 is None or after.held_out_rms_mps2 is None or not after.held_out_floor_mps2:
        return ""
    floor = after.held_out_floor_mps2
    return (
        f" Adding it changes the held-out rms from {before.held_out_rms_mps2 / floor:.2f} to "
        f"{after.held_out_rms_mps2 / floor:.2f} of the noise floor."
    )
