"""Benches drawn at random."""

from __future__ import annotations

import numpy as np


def draw_bench(drawn: np.random.Generator) -> tuple[tuple[str, ...], str, list[str]]:
    """Return the options of a bench whose noise is stated, its setting error in deg as text, and its axes."""

    def one(*values: str) -> str:
        """Return one of the values, each with the same probability."""
        return values[drawn.integers(len(values))]

    mems = drawn.random() < 0.5
    count, dwell_s, rate_hz, size = (
        one("12", "18", "24", "36"),
        one("10", "20", "60", "120"),
        one("4", "10", "40"),
        5e-5,
    )
    if float(count) * float(dwell_s) * float(rate_hz) > 90_000:
        rate_hz = "10"
    size *= 100.0 if mems else 1.0
    noises = (), (), ("--ar1", "0.5"), ("--ar1", "0.9"), ("--flicker", repr(size / 5)), ("--scatter", repr(size))
    axes = one("y z x", "y z x", "x y z", "z x", "y x")
    options = [
        "--grade", "mems" if mems else "navigation", "--orientations", count, "--dwell-s", dwell_s,
        "--sample-hz", rate_hz, "--angle-hz", one("1", "4", "10"), "--slew-degps", one("5", "20", "60"),
        "--temperature-swing", one("0", "2", "5", "10"), "--temperature-period-s", one("700", "3600"),
        "--warm-up-c", one("0", "4"), "--axes", axes, *noises[drawn.integers(len(noises))],
    ]  # fmt: skip
    if drawn.random() < 0.3:
        options += ["--encoder-sigma", one("0.0001", "0.001")]
    if drawn.random() < 0.2:
        options += ["--outlier-rate", "0.001", "--outlier-size", repr(100 * size)]
    return tuple(options), one("0", "0.002", "0.02") if mems else one("0", "0.0002", "0.002"), axes.split()
