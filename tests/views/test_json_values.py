"""What is printed as JSON: results of any kind in types that JSON has."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from kf_calib.bench.arrays import Floats
from kf_calib.cli.echo import json_line
from kf_calib.support.json_values import json_value


class Range(NamedTuple):
    low: float
    high: float


@dataclass(frozen=True)
class Part:
    name: str
    sizes: Floats
    range: Range | None = None


def test_a_result_is_the_mapping_of_its_fields() -> None:
    part = Part("K1", np.array([[1.0, np.nan], [2.0, -np.inf]]), Range(0.5, np.inf))
    plain = {"name": "K1", "sizes": [[1.0, None], [2.0, None]], "range": [0.5, None]}
    assert json_value({"parts": (part,), "file": Path("a") / "b"}) == {"parts": [plain], "file": str(Path("a/b"))}
    assert json.loads(json_line({"part": part})) == {"part": plain}


def test_numbers_of_numpy_are_plain_numbers() -> None:
    values = json_value([np.bool_(True), np.int64(3), np.float32(0.5), np.float64(np.nan), True, 7])
    assert values == [True, 3, 0.5, None, True, 7]
    assert [type(each) for each in values] == [bool, int, float, type(None), bool, int]


def test_numbers_of_a_page_have_the_digits_that_it_needs() -> None:
    assert json_value({"x": np.array([1.23456789, 1e-9 / 3.0])}, 3) == {"x": [1.23, 3.33e-10]}


def test_what_json_has_no_type_for_is_refused() -> None:
    with pytest.raises(TypeError):
        json_line({"what": object()})
