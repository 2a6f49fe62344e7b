"""By how much the numbers of a calibration file may differ from each other before it is refused."""

import copy
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.calibrations import simulated
from helpers.thresholds import begins_at
from pydantic import ValidationError

import kf_calib
from kf_calib.errors import InputError
from kf_calib.exchange import calibration_file
from kf_calib.exchange.calibration_file import SavedCalibration
from kf_calib.exchange.calibration_parts import _refuse_variances, refuse_dependent_axes, refuse_judgement


@pytest.fixture(scope="module")
def content() -> dict[str, Any]:
    settings = kf_calib.Settings(effects="second-order")
    return calibration_file.saved(kf_calib.calibrate(simulated(0, 14), settings), "run.mcap").model_dump(mode="json")


def refusal(content: dict[str, Any], place: tuple[Any, ...], change: Callable[[Any], Any]) -> str:
    """What is said of a file with another value at a place; "" where it is used."""
    made = copy.deepcopy(content)
    *way, key = place
    parent: Any = made
    for step in way:
        parent = parent[step]
    parent[key] = change(parent[key])
    try:
        SavedCalibration.model_validate_json(json.dumps(made)).model()
    except (ValidationError, InputError) as error:
        return str(error)
    return ""


def raises(check: Callable[[], object]) -> bool:
    try:
        check()
    except ValueError:
        return True
    return False


@pytest.mark.parametrize(("place", "share"), [
    (("parameters", 2, "value"), 1e-9), (("parameters", 12, "value"), 1e-9), (("parameters", 6, "nominal"), 1e-9),
    (("parameters", 2, "sigma"), 1e-6), (("parameters", 12, "sigma"), 1e-6),
    (("state", "covariance", 0, 1), 1e-9), (("state", "values", 0), 1e-9),
])  # fmt: skip
def test_numbers_that_are_written_twice_may_differ_by_rounding(
    content: dict[str, Any], place: tuple[Any, ...], share: float
) -> None:
    found = begins_at(lambda more: refusal(content, place, lambda value: value * (1.0 + more)), 1e-13, 1e-2)
    assert found == pytest.approx(share, rel=1e-3)


@pytest.mark.parametrize(("date", "used"), [
    ("1899-12-30T12:00:00+00:00", False), ("1900-01-02T12:00:00+00:00", True), ("8999-12-30T12:00:00+00:00", True),
    ("9000-01-02T12:00:00+00:00", False), ("2026-02-30T12:00:00+00:00", False),
])  # fmt: skip
def test_dates_are_of_years_that_have_four_digits(content: dict[str, Any], date: str, used: bool) -> None:
    assert ("which is no date" in refusal(content, ("provenance", "created"), lambda _: date)) == (not used)


def test_dwells_and_temperatures_are_in_order(content: dict[str, Any]) -> None:
    end = content["conditions"]["dwells"][2]["end_s"]
    place = "conditions", "dwells", 2, "start_s"
    assert "number 3 ends before it begins" in refusal(content, place, lambda _: end + 1e-6)
    assert not refusal(content, place, lambda _: end)
    given = content["conditions"] | {"temperature_min_c": 19.0, "temperature_mean_c": 20.0, "temperature_max_c": 21.0}
    warm = content | {"conditions": given}
    for mean, used in ((19.0, True), (21.0, True), (18.9, False), (21.1, False), (None, False)):
        said = refusal(warm, ("conditions", "temperature_mean_c"), lambda _, mean=mean: mean)
        assert ("not between the lowest and the highest" in said) == (not used)


def test_axes_span_a_millionth_of_what_unit_vectors_can() -> None:
    def spans(volume: float) -> bool:
        rows = np.array([[1.0, 0.0, 0.0, 0.1], [0.0, 2.0, 0.0, 0.1], [3.0, 0.0, 3.0 * volume, 0.1]])
        state: Any = SimpleNamespace(values=rows.ravel().tolist(), undetermined=[])
        return not raises(lambda: refuse_dependent_axes(state))

    assert begins_at(spans, 1e-9, 1.0) == pytest.approx(1e-6, rel=1e-6)


def test_a_covariance_may_be_negative_by_a_millionth_of_its_variances() -> None:
    """That of two states whose correlation is beyond one by so much; a variance of zero is none of an estimate."""
    state: Any = SimpleNamespace(symbols=[f"x{k}" for k in range(13)], undetermined=[])

    def refused(beyond: float) -> bool:
        covariance = np.diag(10.0 ** np.arange(-12.0, 1.0))
        covariance[3, 7] = covariance[7, 3] = (1.0 + beyond) * np.sqrt(covariance[3, 3] * covariance[7, 7])
        return raises(lambda: _refuse_variances(covariance, state, ()))

    assert begins_at(refused, 1e-9, 1.0) == pytest.approx(1e-6, rel=1e-3)
    variances = np.ones(13)
    variances[5] = 0.0
    assert raises(lambda: _refuse_variances(np.diag(variances), state, ()))


def test_a_verdict_is_that_of_one_per_cent() -> None:
    def agrees(p_value: float) -> bool:
        judged: Any = SimpleNamespace(consistent=True, p_value=p_value)
        return not raises(lambda: refuse_judgement(judged))

    assert begins_at(agrees, 1e-6, 1.0) == pytest.approx(0.01)


def test_a_file_says_which_effects_its_run_could_not_show(content: dict[str, Any]) -> None:
    """Of one temperature, at rest, with an outer gimbal about the vertical; a wrong gravity is three scale factors."""
    unseen, shown = set(content["not_seen"]), {"third-order", "hysteresis", "bias-drift", "encoder-scale:z", "flexure"}
    assert unseen >= {"thermal-bias", "thermal-scale", "latency", "lever-arm", "gravity-error", "encoder-scale:y"}
    assert not unseen & (shown | {"second-order", "bias-walk"})
