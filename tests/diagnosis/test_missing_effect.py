"""When lines in the spectrum are vibration, and which tests count once it is averaged out."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from kf_calib.diagnosis import missing_effect
from kf_calib.diagnosis.missing_effect import _of_all_dwells, _without_vibration


def refits_to(amplitudes: tuple[float, float], misfit: float = 0.0, dof: int = 0) -> Any:
    """Refits that find an oscillation of these amplitudes, in phase and out of phase, with so much more misfit."""
    refit = SimpleNamespace(
        estimate=SimpleNamespace(state=np.array([9.0, *amplitudes])),
        model=SimpleNamespace(parts={"oscillation": slice(1, 3)}),
        consistency=SimpleNamespace(dof=50 + dof, statistic=60.0 + misfit),
    )
    return SimpleNamespace(with_effects=lambda before, effects: refit)


BEFORE: Any = SimpleNamespace(consistency=SimpleNamespace(dof=50, statistic=60.0))


def with_a_line(amplitude: tuple[float, float, float]) -> Any:
    line = SimpleNamespace(amplitude_mps2=np.array(amplitude))
    lines = SimpleNamespace(oscillation="oscillation", significant=[line])
    return SimpleNamespace(lines=lines, without_lines="with vibration")


@pytest.mark.parametrize(("share", "coherent"), [(0.3, False), (0.48, False), (0.52, True), (1.0, True)])
def test_a_line_is_vibration_if_a_coherent_wave_has_less_than_half_of_its_amplitude(
    share: float, coherent: bool
) -> None:
    """A line of 3, 4 and 12 has the amplitude 13."""
    test = with_a_line((3.0, 4.0, 12.0))
    judged = _without_vibration(refits_to((0.6 * 13.0 * share, 0.8 * 13.0 * share)), BEFORE, test)
    assert judged is (test if coherent else test.without_lines)


@pytest.mark.parametrize(("tail", "noise"), [(1e-5, True), (1.5e-6, True), (0.7e-6, False), (1e-9, False)])
def test_a_wave_must_leave_noise_in_what_is_kept_for_its_sake(tail: float, noise: bool) -> None:
    """Of 40 rows that are kept more, at one in a million."""
    test = with_a_line((3.0, 4.0, 12.0))
    judged = _without_vibration(refits_to((0.0, 13.0), float(chi2.isf(tail, 40)), 40), BEFORE, test)
    assert judged is (test if noise else test.without_lines)


def test_a_run_without_lines_is_judged_as_it_is() -> None:
    test: Any = SimpleNamespace(without_lines=None)
    assert _without_vibration(refits_to((0.0, 0.0)), BEFORE, test) is test


@pytest.mark.parametrize("lines_left", [False, True])
@pytest.mark.parametrize("angles", [False, True])
@pytest.mark.parametrize("averaged_before", [False, True])
@pytest.mark.parametrize("source", [False, True])
def test_vibration_is_averaged_once_and_lines_that_are_left_are_vibration_too(
    lines_left: bool, angles: bool, averaged_before: bool, source: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the angles are known and the readings can be read again; else the tests of the run itself count."""
    explained = list[tuple[Any, str]]()

    class Tests:
        def __init__(self, name: str, without_lines: Any = None) -> None:
            self.name, self.without_lines, self.lines = name, without_lines, SimpleNamespace(vibration=("a line",))

        def with_vibration(self, lines: tuple[str, ...]) -> Tests:
            assert lines == ("a line",)
            return Tests(f"{self.name}, vibration told")

    def remember(refits: Any, run: Any, test: Tests) -> Any:
        explained.append((run, test.name))
        return SimpleNamespace(unknown=False)

    monkeypatch.setattr(missing_effect, "_explained", remember)
    monkeypatch.setattr(missing_effect, "_without_vibration", lambda refits, run, test: test)
    monkeypatch.setattr(missing_effect, "replace", lambda diagnosis, **changes: diagnosis)
    for name in [name for name in vars(missing_effect) if name.endswith("_in_words")]:
        monkeypatch.setattr(missing_effect, name, lambda *_: "")
    monkeypatch.setattr(missing_effect.window_average, "window_s", lambda lines: 0.5)
    averaged = Tests("averaged", Tests("averaged without lines") if lines_left else None)
    fit = SimpleNamespace(dwells=SimpleNamespace(folded=SimpleNamespace(averaged=averaged_before)))
    run: Any = SimpleNamespace(outlying=(), bench=SimpleNamespace(angles=angles), fit=fit)
    refits: Any = SimpleNamespace(
        assess=lambda which: Tests("first") if which is run else averaged,
        averaged=lambda which, window_s: "averaged run" if source and window_s == 0.5 else None,
    )
    _of_all_dwells(refits, run)
    last = "averaged without lines, vibration told" if lines_left else "averaged, vibration told"
    again = [("averaged run", last)] if angles and source and not averaged_before else []
    assert explained == [(run, "first"), *again]
