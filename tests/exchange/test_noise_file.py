"""The file of noise and its keys in other programs."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.resting import Resting, level, noisy

from kf_calib.errors import InputError
from kf_calib.exchange.noise_file import SavedRestNoise, is_noise_file, open_noise, saved_noise, write_noise
from kf_calib.exports.noise_keys import NoiseExport
from kf_calib.noise.rest_noise import RestNoise, noise_at_rest

WHITE = (1e-3, 2e-3, 1.5e-3)


@cache
def found(with_gyroscopes: bool = True) -> RestNoise:
    rng = np.random.default_rng(2)
    readings = level(np.array([noisy(rng, 20_000, white, 1e-3) for white in WHITE]).T)
    rates = np.array([noisy(rng, 20_000, 1e-4) for _ in range(3)]).T
    return noise_at_rest(Resting(readings), gyroscopes=Resting(rates) if with_gyroscopes else None)


@cache
def saved(with_gyroscopes: bool = True) -> SavedRestNoise:
    return saved_noise(found(with_gyroscopes), "rest.csv", "0" * 64)


def test_a_file_holds_what_was_found(tmp_path: Path) -> None:
    path = tmp_path / "noise.json"
    write_noise(path, saved())
    again = open_noise(path)
    assert again == saved() and is_noise_file(path)
    for channel, kept in zip(found().channels, again.channels, strict=True):
        assert kept.terms is not None and kept.taus_s == channel.tau_s.tolist()
        assert kept.terms["white"].value == channel.terms["white"].value
        assert (kept.terms["random_walk"].low, kept.unit) == (channel.terms["random_walk"].low, channel.unit)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"version": 2}, "version"),
        ({"channels": [{}]}, "channels.0"),
        ({"more": 1}, "more"),
        ({"rest_s": -1.0}, "rest_s"),
        ({"rest_s": float("inf")}, "rest_s"),
    ],
)
def test_a_file_that_is_none_is_refused(tmp_path: Path, change: dict[str, object], said: str) -> None:
    path = tmp_path / "noise.json"
    path.write_text(json.dumps(saved().model_dump(mode="json") | change))
    with pytest.raises(InputError, match=said):
        open_noise(path)


def test_an_interval_upside_down_and_terms_that_lack_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "noise.json"
    for key, value in (("low", 1e9), ("high", 0.0), ("value", 1e9)):
        content = saved().model_dump(mode="json")
        content["channels"][0]["terms"]["white"][key] = value
        path.write_text(json.dumps(content))
        with pytest.raises(InputError, match="ascending"):
            open_noise(path)
    content = saved().model_dump(mode="json")
    del content["channels"][0]["terms"]["white"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="terms must be"):
        open_noise(path)


def test_a_file_that_is_absent_or_large_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        open_noise(tmp_path / "none.json")
    large = tmp_path / "large.json"
    large.write_bytes(b" " * 1_000_001)
    with pytest.raises(InputError, match="larger"):
        open_noise(large)
    assert not is_noise_file(tmp_path / "none.json") and not is_noise_file(large)


@pytest.mark.parametrize("to", ["kalibr", "openvins"])
def test_keys_in_yaml_are_the_largest_of_three_axes(to: str) -> None:
    text = NoiseExport(saved(), to).text()  # type: ignore[arg-type]
    content = yaml.safe_load(text.removeprefix("%YAML:1.0\n"))
    content = content["imu0"] if to == "openvins" else content
    assert content["accelerometer_noise_density"] == pytest.approx(2e-3, rel=0.03)
    assert content["accelerometer_random_walk"] == pytest.approx(1e-3, rel=0.3)
    assert content["gyroscope_noise_density"] == pytest.approx(1e-4, rel=0.03)
    assert content["update_rate"] == pytest.approx(100.0)
    limit = max(channel.terms["random_walk"].high for channel in found().of_unit("rad/s"))
    assert content["gyroscope_random_walk"] == pytest.approx(limit, rel=1e-5)
    assert "gyroscope_random_walk: not seen" in text


def test_without_gyroscopes_their_keys_are_to_be_added() -> None:
    export = NoiseExport(saved(with_gyroscopes=False), "kalibr")
    assert not any("gyroscope" in key.name for key in export.keys)
    assert any("gyroscopes are not in it" in remark for remark in export.remarks)


def test_px4_adds_as_much_in_a_second_as_the_noise_does() -> None:
    """Its velocity gets (NOISE dt)^2 each 10 ms: N^2 a second; its bias likewise K^2."""
    values = {key.name: key.value for key in NoiseExport(saved(), "px4").keys}
    assert values.keys() == {"EKF2_ACC_NOISE", "EKF2_ACC_B_NOISE", "EKF2_GYR_NOISE", "EKF2_GYR_B_NOISE"}
    assert 100 * (values["EKF2_ACC_NOISE"] * 0.01) ** 2 == pytest.approx(4e-6, rel=0.06)
    assert 100 * (values["EKF2_ACC_B_NOISE"] * 0.01) ** 2 == pytest.approx(1e-6, rel=0.6)
    lines = NoiseExport(saved(), "px4").text().splitlines()
    (line,) = [line.split("\t") for line in lines if "EKF2_ACC_NOISE" in line]
    assert line[:2] == ["1", "1"] and line[4] == "9" and float(line[3]) == pytest.approx(values["EKF2_ACC_NOISE"])


def test_a_covariance_is_that_of_readings_row_by_row() -> None:
    content = yaml.safe_load(NoiseExport(saved(), "robot_localization").text())
    matrix = np.array(content["linear_acceleration_covariance"]).reshape(3, 3)
    assert np.diag(matrix) == pytest.approx(np.square(WHITE) * 100.0, rel=0.06)
    assert matrix - np.diag(np.diag(matrix)) == pytest.approx(0.0)
    assert np.array(content["angular_velocity_covariance"])[4] == pytest.approx(1e-6, rel=0.06)


def test_a_filter_in_the_sensor_does_not_make_a_covariance_small() -> None:
    rng = np.random.default_rng(3)
    smooth = np.array([np.convolve(noisy(rng, 60_000, 1e-3), np.ones(8) / 8, mode="valid") for _ in range(3)]).T
    text = NoiseExport(saved_noise(noise_at_rest(Resting(level(smooth)))), "robot_localization").text()
    assert yaml.safe_load(text)["linear_acceleration_covariance"][0] == pytest.approx(1e-4, rel=0.2)


def test_noise_without_sizes_is_refused() -> None:
    content = saved().model_copy(update={"channels": [c for c in saved().channels if c.unit == "rad/s"]})
    with pytest.raises(InputError, match="no accelerometer"):
        NoiseExport(content, "kalibr")


def test_a_name_of_a_recording_is_no_more_than_text() -> None:
    text = NoiseExport(saved().model_copy(update={"recording": "x\nevil: 1"}), "kalibr").text()
    assert "evil" not in yaml.safe_load(text)
