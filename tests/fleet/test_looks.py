"""Which units need another look, in which order, and what their runs say of them."""

from typing import Any

import pytest

from kf_calib.fleet.overview import looks


def row(
    unit: str, run: str, p_value: float = 0.5, missing: str | None = None, error: str | None = None
) -> dict[str, Any]:
    return {"unit": unit, "run": f"lab/{run}.mcap", "error": error, "consistent": None if error else p_value > 0.01,
            "p_value": None if error else p_value, "missing": missing}  # fmt: skip


def test_the_unit_with_the_smallest_chance_comes_first_and_so_does_its_worst_run() -> None:
    """Chances are 1 - (1 - p)^n for the smallest of n runs; one that is no surprise then needs no look."""
    rows = [row("a", "1", 1e-4), row("a", "2", 1e-6, "flexure"), row("b", "3", error="lost"), row("c", "4"),
            row("d", "5", 3e-3), row("a", "6")]  # fmt: skip
    first, second = looks(rows, (), (), None)  # 1 - (1 - 0.003)^6 is 1.8 %: by chance
    assert (first.unit, first.chance, first.reasons) == ("b", 0.0, ("3.mcap failed",))
    assert second.unit == "a" and second.chance == pytest.approx(1.0 - (1.0 - 1e-6) ** 6)
    assert second.reasons == ("2.mcap shows flexure (p = 1e-06)", "1.mcap does not fit its model (p = 0.0001)")


def test_of_two_that_are_as_unlikely_the_one_with_more_reasons_comes_first() -> None:
    rows = [row("a", "1", error="lost"), row("b", "2", error="lost"), row("b", "3", 1e-5), row("c", "4", error="lost")]
    assert [look.unit for look in looks(rows, (), (), None)] == ["b", "a", "c"]
