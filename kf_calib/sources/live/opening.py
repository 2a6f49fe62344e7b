"""From a URL to a live source."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from urllib.parse import parse_qsl, urlencode

from kf_calib.errors import InputError
from kf_calib.sources.live.feed import Feed
from kf_calib.sources.live.source import QUEUED, LiveSource
from kf_calib.sources.recorder import refuse_existing


def open_live(
    url: str,
    overrides: Mapping[str, str] | None = None,
    record: Path | None = None,
    overwrite: bool = False,
    *,
    columns: Mapping[str, str] = MappingProxyType({}),
    header: str = "",
    give_up_s: float = 600.0,
    idle_s: float = math.inf,
    queued: int = QUEUED,
) -> LiveSource:
    """A bench while it runs: a serial port, ``socket://host:port``, ``-``, a growing file, ``sim://?speed=20``.

    overrides: bench metadata keys that win over what the bench says. record: file to record to. columns: our name for
    each foreign column or key. header: of CSV rows that come without one. give_up_s: how long a lost link is tried
    again. idle_s: ends the source where nothing has come for so long. queued: samples that may wait for the consumer.
    Raises InputError where it cannot be opened.
    """
    if record is not None:
        refuse_existing(record, overwrite)
    scheme, separator, rest = url.partition("://")
    if separator and scheme == "sim":
        feed = _simulated(rest, overrides or {})
    else:
        raise InputError(f"{url} cannot be opened.")
    return LiveSource(feed, record, overwrite, queued)


def _simulated(rest: str, overrides: Mapping[str, str]) -> Feed:
    from kf_calib.sources.live.simulated import SimulatedFeed, batch_samples
    from kf_calib.sources.simulated import DEFAULTS, options_from_query, simulation

    pairs = parse_qsl(rest.partition("?")[2], keep_blank_values=True)
    speeds = [text for key, text in pairs if key == "speed"]
    speed = _positive("speed", speeds[-1]) if speeds else 1.0
    options = options_from_query(urlencode([pair for pair in pairs if pair[0] != "speed"]))
    size = batch_samples(options.get("sample_hz", DEFAULTS["sample_hz"]), speed)
    return SimulatedFeed(simulation(options, overrides, size), speed)


def _positive(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not value > 0.0:
        raise InputError(f"{name}={text} is not a positive number: write for example {name}=20.")
    return value
