"""What a diagnosis says of an unknown misfit, and where it advises to go next."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from kf_calib.design import next_orientation as advise
from kf_calib.diagnosis import results
from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.unknown_effect import Description

LIKELIEST = {
    "dwells": (),
    "formulas": ("mine = T",),
    "driver": "temperature",
    "refit": SimpleNamespace(consistency="of refit"),
}


@pytest.mark.parametrize(("unknown", "likeliest", "expected"), [
    (False, LIKELIEST, None), (True, None, "looked for"),
    (True, LIKELIEST | {"formulas": ()}, "looked for"), (True, LIKELIEST | {"refit": None}, "looked for"),
    (True, LIKELIEST | {"dwells": (3,)}, None),
    (True, LIKELIEST, Description("z", "temperature", 0.8, ("mine = T",))),
])  # fmt: skip
def test_an_unknown_misfit_is_described_by_the_formulas_that_were_refitted_or_looked_for(
    unknown: bool, likeliest: dict[str, Any] | None, expected: Description | str | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(results, "describe_irregular", lambda *_: "looked for")
    monkeypatch.setattr(results, "explained_share", lambda *_: 0.8)
    monkeypatch.setattr(results, "channel_of", lambda _: "z")
    before: Any = SimpleNamespace(residuals_mps2=None, fit=None, consistency=None)
    made: Any = SimpleNamespace(
        unknown=unknown, before=before, likeliest=likeliest and SimpleNamespace(**likeliest),
        test=SimpleNamespace(trend=None),
    )  # fmt: skip
    assert Diagnosis.description.func(made) == expected


@pytest.mark.parametrize(("missing", "rivals"), [
    (("a",), ["b", "c", "d", "e"]), (("a", "b"), []), ((), []),
])  # fmt: skip
def test_the_next_orientation_tells_a_single_effect_from_its_four_likeliest_rivals(
    missing: tuple[str, ...], rivals: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that are alone and can be seen; a pair is not told from others, but sized."""
    asked = list[tuple[Any, ...]]()
    monkeypatch.setattr(advise, "to_tell_apart", lambda *given: asked.append(given))
    rows = [SimpleNamespace(effects=tuple(names)) for names in ("b", "bc", "x", "c", "d", "e", "f")]
    effects = SimpleNamespace(
        best=dict.fromkeys("abcdef"), scan=SimpleNamespace(coefficients=lambda _: "sizes"),
        candidate=lambda name: SimpleNamespace(effect=name),
    )  # fmt: skip
    made: Any = SimpleNamespace(
        before_in_noise_left=None, before=SimpleNamespace(fit="fit"), test=SimpleNamespace(effects=effects),
        ambiguity=("x", "a"), unknown=False, table=SimpleNamespace(rivals=rows), missing=missing,
    )  # fmt: skip
    assert Diagnosis.next_orientation.func(made) is None
    assert asked == [("fit", "a", "sizes", rivals)]
