"""The numbers of the program are those that are stored: a change of any of them is meant, or is found here."""

from pathlib import Path

import pytest
from helpers import stored_numbers
from helpers.long_runs import slow
from helpers.numbered_cases import FAST, SLOW


@pytest.mark.parametrize("case", [*FAST, *slow(*SLOW)])
def test_numbers_are_as_stored(case: str, tmp_path: Path) -> None:
    found = stored_numbers.changed(case, stored_numbers.plain((FAST | SLOW)[case](tmp_path)))
    assert not found, stored_numbers.told(found)


def test_a_number_is_alike_within_a_hundred_thousandth_or_a_ten_thousandth_of_its_sigma() -> None:
    stored = {"a": [1.0, 2], "p": {"value": 1.0, "sigma": 0.1}, "figures": {"x": [4, 1.0, 1.0]}, "name": "K1"}
    same = {"a": [1.0 + 5e-6, 2], "p": {"value": 1.000009, "sigma": 0.1}, "figures": {"x": [4, 1.00001, 1.0]}}
    assert not list(stored_numbers.differences(stored, same | {"name": "K1"}))
    changed = {"a": [1.0 + 2e-5, 3], "p": {"value": 1.00003, "sigma": 0.1}, "figures": {"x": [5, 1.0001, 1.0]}}
    found = [each.path for each in stored_numbers.differences(stored, changed | {"name": "K2"})]
    assert found == ["/a/0", "/a/1", "/p/value", "/figures/x (numbers)", "/figures/x (sizes)", "/name"]
    told = stored_numbers.told(list(stored_numbers.differences(stored, {})))
    assert "4 numbers changed:\n/a: stored [1.0, 2], now None" in told and told.endswith(stored_numbers.RENEW)


def test_all_cases_are_small() -> None:
    assert sum(path.stat().st_size for path in stored_numbers.FOLDER.glob("*.json")) < 750_000
