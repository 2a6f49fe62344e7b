"""The noise of sensors at rest as a report and as a JSON object."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from rich.console import Group, RenderableType
from rich.text import Text

from kf_calib.noise.power_laws import TERMS
from kf_calib.noise.rest_noise import ChannelNoise, RestNoise
from kf_calib.support.units import Unit, shown, significant, span
from kf_calib.views.json import members
from kf_calib.views.terminal import note, table

TITLES = {
    "quantisation": "quantisation",
    "white": "white noise",
    "bias_instability": "bias instability",
    "random_walk": "random walk",
}
_KEYS = {
    "m/s^2": ("quantisation_mps", "white_mps2_per_sqrt_hz", "bias_instability_mps2", "random_walk_mps2_per_sqrt_s"),
    "rad/s": ("quantisation_rad", "white_radps_per_sqrt_hz", "bias_instability_radps", "random_walk_radps_per_sqrt_s"),
    "K": ("quantisation_k_s", "white_k_per_sqrt_hz", "bias_instability_k", "random_walk_k_per_sqrt_s"),
}
_SUFFIX = {"m/s^2": "mps2", "rad/s": "radps", "K": "k"}
_SI = {
    "m/s^2": ("m/s^2 s", "m/s^2/Hz^(1/2)", "m/s^2", "m/s^2/s^(1/2)"),
    "rad/s": ("rad", "rad/s/Hz^(1/2)", "rad/s", "rad/s^2/Hz^(1/2)"),
    "K": ("K s", "K/Hz^(1/2)", "K", "K/s^(1/2)"),
}
_FIELD = {"rad/s": Unit("°/h", math.degrees(3600.0)), "K": Unit("mK", 1e3)}


def unit_of(unit: str, term: str) -> Unit:
    """The unit in which people are shown the size of a term of a channel that is in an SI unit."""
    si = _SI[unit][TERMS.index(term)]
    return _FIELD[si] if si in _FIELD and shown("1").label != "1" else shown(si)


def channel_title(channel: ChannelNoise) -> str:
    """What a channel is called."""
    return {"m/s^2": f"accelerometer {channel.name}", "rad/s": f"gyroscope {channel.name}"}.get(
        channel.unit, channel.name
    )


def noise_object(noise: RestNoise) -> dict[str, Any]:
    """The JSON object of ``noise``."""
    return {
        **members(noise, "readings", "rate_hz", "rest_s", "stretches", "longest_s", "gaps"),
        "left_out": {"moving": noise.moving, "next_to_motion": noise.settling, "unusable": noise.unusable},
        "channels": [_channel_object(channel) for channel in noise.channels],
        "warnings": [*noise.warnings, *remarks(noise)],
    }


def _channel_object(channel: ChannelNoise) -> dict[str, Any]:
    names, suffix, has_terms = _KEYS[channel.unit], _SUFFIX[channel.unit], bool(channel.terms)
    values = {key: channel.terms[term].value if has_terms else None for key, term in zip(names, TERMS, strict=True)}
    return {
        "channel": channel_title(channel),
        "unit": channel.unit,
        "rate_hz": 1.0 / channel.period_s,
        **values,
        "intervals": {term: members(size, "value", "low", "high") for term, size in channel.terms.items()},
        "by_allan": {term: members(size, "value", "low", "high") for term, size in channel.by_allan.items()},
        **members(channel, "unclear", "from_s", "p_value"),
        f"reading_sigma_{suffix}": channel.reading_sigma,
        f"step_{suffix}": channel.step or None,
        "taus_s": channel.tau_s,
        f"deviations_{suffix}": channel.deviation,
        f"deviations_low_{suffix}": channel.low,
        f"deviations_high_{suffix}": channel.high,
        "why_not": channel.why_not or None,
    }


def noise_report(noise: RestNoise) -> RenderableType:
    """The report that ``noise`` prints."""
    rows = [row for channel in noise.channels for row in _rows(channel)]
    headings = "channel", "term", ">size", ">from", ">to", "unit", ">by Allan variance"
    ends = range(len(TERMS) - 1, len(rows), len(TERMS))
    sizes = table("Noise at rest, with 95 % intervals", headings, rows, ends)
    return Group(Text(_readings_sentence(noise)), sizes, *map(note, [*noise.warnings, *remarks(noise)]))


def _rows(channel: ChannelNoise) -> Iterator[tuple[str, ...]]:
    for term in reversed(TERMS) if channel.terms else ():
        unit, size, other = unit_of(channel.unit, term), channel.terms[term], channel.by_allan[term]
        ends = [unit.number(end) for end in (size.low, size.high)]
        cells = ["not seen", "0", f"< {ends[1]}"] if size.value is None else [unit.number(size.value), *ends]
        by_allan = f"< {unit.number(other.high)}" if other.value is None else unit.number(other.value)
        name = channel_title(channel) if term == TERMS[-1] else ""
        yield name, TITLES[term], *cells, unit.label, by_allan


def _readings_sentence(noise: RestNoise) -> str:
    stretches = (
        "one stretch"
        if noise.stretches == 1
        else f"{noise.stretches} stretches, the longest of " + span(noise.longest_s)
    )
    left_out = [
        text for count, text in (
            (noise.moving, f"{noise.moving} while it moved"),
            (noise.settling, f"{noise.settling} next to a motion"),
            (noise.unusable, f"{noise.unusable} that are no numbers or have stamps that cannot be"),
        ) if count
    ]  # fmt: skip
    left = f" Left out: {', '.join(left_out)}." if left_out else ""
    gaps = (
        f" No difference reaches over any of the {noise.gaps} gaps."
        if noise.gaps > 1
        else (" No difference reaches over the gap." * noise.gaps)
    )
    return (
        f"{noise.readings} readings at rest at {significant(noise.rate_hz, 4)} Hz, {span(noise.rest_s)} in "
        f"{stretches}.{gaps}{left}"
    )


def remarks(noise: RestNoise) -> list[str]:
    """What to know of the channels, in sentences; those that are alike are told once."""
    told = dict[str, list[str]]()
    for channel in noise.channels:
        for sentence in _remarks_of(channel):
            told.setdefault(sentence, []).append(channel_title(channel))
    return [f"{', '.join(channels)}: {sentence}" for sentence, channels in told.items()]


def _remarks_of(channel: ChannelNoise) -> list[str]:
    if channel.why_not:
        return [f"{channel.why_not}: it has no sizes."]
    sentences = list[str]()
    if channel.is_coarse:
        sentences.append("its noise is less than half a step of its readings, so that what is found is as much that of "
                         "rounding: read it out with more digits.")  # fmt: skip
    if channel.from_s > 1.5 * channel.period_s:
        sentences.append(f"its terms describe clusters of {significant(channel.from_s, 2)} s and more; shorter ones "
                         "have another slope, as a filter, a vibration or rounding gives.")  # fmt: skip
    if channel.inflation > 1.0:
        sentences.append(f"no sum of the four terms fits (p = {significant(channel.p_value, 2)}): look at the figure "
                         "for a vibration or the course of temperature; intervals are wider for it.")  # fmt: skip
    if channel.unclear:
        names = " or ".join(TITLES[term] for term in channel.unclear)
        sentences.append(f"something besides the terms that are seen is there, likeliest {names}, which this recording "
                         "cannot tell from its neighbours: a longer rest can.")  # fmt: skip
    return sentences
