"""The verdict of a diagnosis in one sentence."""

from __future__ import annotations

import numpy as np

from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.scatter_hypothesis import dwell_noise_is_stated
from kf_calib.diagnosis.unknown_effect import one_digit_seconds
from kf_calib.estimation.fit import WALK
from kf_calib.estimation.results import format_p
from kf_calib.support.units import shown


def verdict_in_words(found: Diagnosis) -> str:
    """The verdict of a diagnosis in one sentence, with what else it could be."""
    test = found.test
    if test.consistent is None:
        return "Nothing is left over to judge the model by: visit more orientations."
    if test.consistent:
        blind = f" It cannot see {len(test.unseen)} of {test.count} effects." if test.unseen else ""
        agreed = f"The model agrees with the measurements (p {format_p(test.p_value)})"
        return f"{agreed}: no effect is missing that this run could show.{blind}"
    start = f"Residuals fail (p {format_p(test.p_value)})."
    if found.missing and found.after is not None:
        first = found.missing[0]
        if len(found.missing) > 1:
            named = f"{' and '.join(found.missing)} together explain it; no single known effect does as well"
        else:
            named = f"Missing: {first}{_size(found)}"
            if len(found.ambiguity) > 1 or found.as_scatter or found.back_s:
                named = f"Best: {first}{_size(found)}"
        instead = "" if len(found.missing) == 1 else "in the place of one of them, "
        told = [
            f"{name} alone" if name == found.alone else f"{name} ({instead}overlap {overlap:.2f})"
            for name, overlap in found.overlaps.items()
        ]
        told = [
            *told,
            *(f"{' and '.join(pair)} together" for pair in found.together),
            *([_scattering(found)] if found.as_scatter else []),
            *([f"biases that come back within about {one_digit_seconds(found.back_s)}"] if found.back_s else []),
        ]
        if told:
            named += f". Cannot yet be told from {', '.join(told)}"
        return f"{start} {named}.{_held_out(found)}"
    if found.unknown:
        nearest = next((each.name for each in found.suspects if each.fits), None)
        if nearest and found.as_scatter:
            return (
                f"{start} {nearest} would fit, but {_scattering(found)} are likelier: unknown. "
                "Visit an orientation again to tell."
            )
        if nearest:
            return f"{start} {nearest} would fit, but what no known effect is explains it better: unknown."
        return f"{start} No known effect explains it, alone or in pairs: unknown."
    nearest = next((each.name for each in found.suspects if each.fits), None)
    noise = found.before.noise
    stated = ("angle_sigma_deg", noise.setting_stated), ("scatter_sigma_mps2", noise.scatter_stated)
    keys = " and ".join(key for key, known in stated if not known)
    missing = f"is missing ({nearest} would fit)" if nearest else "is missing that is none of the known ones"
    return (
        f"{start} Either dwells scatter by what was not stated or an effect {missing}: state {keys}, or visit an "
        "orientation again to tell."
    )


def _scattering(found: Diagnosis) -> str:
    """Return the words for scatter from dwell to dwell as an explanation."""
    return f"dwells that scatter by more than is {'stated' if dwell_noise_is_stated(found.before) else 'estimated'}"


def _size(found: Diagnosis) -> str:
    """Return, as text, the most significant coefficient of the first missing effect and its constant, with sigmas."""
    assert found.after is not None
    parameters = found.after.parameters
    first = next(each for each in found.after.model.effects if str(each) == found.missing[0])
    sized = [parameters[c.symbol] for c in ([WALK] if first.walks else first.coefficients)]
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
