"""How long the windows are over which readings are averaged, and what they leave of an oscillation."""

from __future__ import annotations

import numpy as np
import pytest

from kf_calib.dwells.line_spectrum import SpectralLine
from kf_calib.dwells.window_average import window_s


@pytest.mark.parametrize(("frequencies", "expected_s"), [
    ({}, 1.0), ({50.0: 1.0}, 1.0), ({4.0: 1.0}, 5.0), ({4.0: 1.0, 0.5: 0.9}, 5.0), ({4.0: 1.0, 0.5: 1.1}, 40.0),
])  # fmt: skip
def test_a_window_has_twenty_cycles_of_the_strongest_line_and_lasts_a_second(
    frequencies: dict[float, float], expected_s: float
) -> None:
    """Of amplitudes that are compared over all three accelerometers."""
    lines = [SpectralLine(hz, 1e-9, 0, size * np.array([0.6, 0.0, 0.8])) for hz, size in frequencies.items()]
    assert window_s(lines) == pytest.approx(expected_s)
