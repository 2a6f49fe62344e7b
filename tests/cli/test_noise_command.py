"""``kf-calib noise``: what it prints and writes, and its way into other programs' files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.paths import ROOT
from helpers.resting import PERIOD_S, level, noisy

import kf_calib
from kf_calib import plot
from kf_calib.sources.files import cdr
from kf_calib.views.noise import remarks

COLUMNS = "time_s,ax_mps2,ay_mps2,az_mps2,wx,wy,wz,temperature_c"


@pytest.fixture
def rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log of a minute at rest, with gyroscopes and a thermometer."""
    monkeypatch.chdir(tmp_path)
    rng, count = np.random.default_rng(4), 6000
    accel = level(np.array([noisy(rng, count, 1e-3) for _ in range(3)]).T)
    rates = np.array([noisy(rng, count, 1e-3) for _ in range(3)]).T
    warm = 25.0 + noisy(rng, count, 1e-3)
    table = np.column_stack([PERIOD_S * np.arange(count), accel, rates, warm])
    np.savetxt("rest.csv", table, "%.7f", ",", header=COLUMNS, comments="")
    return Path("rest.csv")


def test_a_rest_of_a_minute_has_its_noise(run: Any, rest: Path) -> None:
    found = run.json("noise", rest)
    assert found["readings"] == 6000 and found["rate_hz"] == pytest.approx(100.0) and len(found["channels"]) == 3
    for channel in found["channels"]:
        assert channel["white_mps2_per_sqrt_hz"] == pytest.approx(1e-3, rel=0.05)
        assert channel["bias_instability_mps2"] is None and channel["random_walk_mps2_per_sqrt_s"] is None
        assert len(channel["taus_s"]) == len(channel["deviations_mps2"]) == 11
    assert not any("gravity" in warning for warning in found["warnings"])


def test_it_prints_a_table_and_says_what_was_left_out(run: Any, rest: Path) -> None:
    code, out, err = run("noise", rest)
    assert (code, err) == (0, "") and "6000 readings at rest at 100 Hz, 60 s in one stretch." in out
    assert out.count("white noise") == 3 and "µg/√Hz" in out and "not seen" in out
    code, out, _ = run("noise", ROOT / "recordings" / "hidden.mcap", "--units", "si")
    assert code == 0 and "24 stretches" in out and "while it moved" in out and "m/s^2/Hz^(1/2)" in out


@pytest.mark.parametrize(("unit", "size"), [("rad/s", 1.0), ("deg/s", np.radians(1.0))])
def test_gyroscopes_and_thermometer_are_taken_along(run: Any, rest: Path, unit: str, size: float) -> None:
    found = run.json("noise", rest, "--gyro", "wx,wy,wz", "--gyro-unit", unit, "--temperature")
    channels = {channel["channel"]: channel for channel in found["channels"]}
    assert len(channels) == 7
    assert channels["gyroscope y"]["white_radps_per_sqrt_hz"] == pytest.approx(1e-3 * size, rel=0.05)
    assert channels["temperature"]["white_k_per_sqrt_hz"] == pytest.approx(1e-3, rel=0.05)
    assert channels["accelerometer 3"]["white_mps2_per_sqrt_hz"] == pytest.approx(1e-3, rel=0.05)


@pytest.mark.parametrize(
    "header", ["t,ax_mps2,ay_mps2,az_mps2,wx,wy,wz,T", "Timestamp [s],ax_mps2,ay_mps2,az_mps2,wx,wy,wz,T [C]"]
)
def test_beside_gyroscopes_a_temperature_is_no_time(run: Any, rest: Path, header: str) -> None:
    """The names of a log mean the same to the gyroscopes as to the accelerometers."""
    rest.write_text(rest.read_text().replace(COLUMNS, header, 1))
    found = run.json("noise", rest, "--gyro", "wx,wy,wz")
    rates = [channel for channel in found["channels"] if channel["channel"].startswith("gyroscope")]
    assert [each["white_radps_per_sqrt_hz"] for each in rates] == pytest.approx([1e-3] * 3, rel=0.05)


@pytest.mark.parametrize(
    ("gyro", "said"),
    [("wx,wy", "three names"), ("a", "three names"), ("wx,wy,w", "no column 'w'"), ("wx,wy,wz,wx", "three")],
)
def test_gyroscopes_that_are_not_there_are_refused(run: Any, rest: Path, gyro: str, said: str) -> None:
    assert said in run.refused("noise", rest, "--gyro", gyro)


def imu_bag(path: Path) -> Path:
    """A minute of sensor_msgs/msg/Imu at 100 Hz, by ROS's own way of writing."""
    ros = pytest.importorskip("mcap_ros2.writer", reason="mcap-ros2-support is not there")
    rng, count = np.random.default_rng(5), 6000
    accel = level(np.array([noisy(rng, count, 1e-3) for _ in range(3)]).T)
    rates = np.array([noisy(rng, count, 1e-4) for _ in range(3)]).T
    with path.open("wb") as file:
        writer = ros.Writer(file)
        schema = writer.register_msgdef(cdr.IMU.name, cdr.IMU.schema)
        for k in range(count):
            stamp = 1_750_000_000_000_000_000 + k * 10_000_000
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "imu"}
            vectors = {"angular_velocity": rates[k], "linear_acceleration": accel[k]}
            named = {name: dict(zip("xyz", own.tolist(), strict=True)) for name, own in vectors.items()}
            writer.write_message("/imu", schema, {"header": header, **named}, stamp, stamp)
        writer.finish()
    return path


def test_gyroscopes_of_a_bag_are_named_by_their_paths(run: Any, tmp_path: Path) -> None:
    bag = imu_bag(tmp_path / "imu.mcap")
    paths = "/imu:angular_velocity.x,angular_velocity.y,angular_velocity.z"
    channels = run.json("noise", bag, "--gyro", paths)["channels"]
    assert channels[0]["white_mps2_per_sqrt_hz"] == pytest.approx(1e-3, rel=0.05)
    assert channels[3]["white_radps_per_sqrt_hz"] == pytest.approx(1e-4, rel=0.05)
    assert "names no topic" in run.refused("noise", bag, "--gyro", "wx,wy,wz")
    assert "does not exist" in run.refused("noise", bag.with_name("none.mcap"), "--gyro", "wx,wy,wz")


def test_what_is_saved_goes_into_other_programs(run: Any, rest: Path) -> None:
    assert run("noise", rest, "--gyro", "wx,wy,wz", "--save", "noise.json")[0] == 0
    assert run("noise", rest, "--save", "noise.json")[0] == 2  # it is there already
    printed = run.json("export", "noise.json", "--to", "kalibr", "-o", "imu.yaml")
    content = yaml.safe_load(Path("imu.yaml").read_text())
    assert content["accelerometer_noise_density"] == pytest.approx(1e-3, rel=0.05)
    assert printed["keys"]["gyroscope_noise_density"] == pytest.approx(content["gyroscope_noise_density"], rel=1e-6)
    assert "accelerometer_random_walk" in printed["limits"]
    code, out, _ = run("export", "noise.json", "--to", "robot_localization", "-o", "covariance.yaml")
    assert code == 0 and "is the noise for robot_localization" in out
    err = run.refused("export", "noise.json", "--to", "ardupilot", "-o", "a.param")
    assert "takes no noise" in err and not Path("a.param").exists()


@pytest.mark.parametrize("to", ["kalibr", "openvins", "px4"])
def test_a_calibration_takes_the_noise_into_its_file(run: Any, rest: Path, to: str) -> None:
    recording = ROOT / "recordings" / "mems_faces.mcap"
    kf_calib.save_calibration(kf_calib.calibrate(recording), "cal.json", recording)
    assert run("noise", rest, "--save", "noise.json")[0] == 0
    for out, more in (("with", ("--noise", "noise.json")), ("without", ())):
        code, _, err = run("export", "cal.json", *more, "--to", to, "--lossy", "-o", out)
        assert code == 0, err
    added = set(Path("with").read_text().splitlines()) - set(Path("without").read_text().splitlines())
    assert len(added) == (2 if to == "px4" else 3)
    key = "EKF2_ACC_NOISE" if to == "px4" else "accelerometer_noise_density"
    assert any(key in line for line in added)
    if to == "kalibr":
        imu = yaml.safe_load(Path("with").read_text())["imu0"]
        assert imu["accelerometer_noise_density"] == pytest.approx(1e-3, rel=0.05) and imu["accelerometers"]["M"]


def test_noise_where_none_can_be_is_refused(run: Any, rest: Path) -> None:
    assert run("noise", rest, "--save", "noise.json")[0] == 0
    assert "noise already" in run.refused("export", "noise.json", "--noise", "noise.json", "--to", "px4", "-o", "x")
    recording = ROOT / "recordings" / "mems_faces.mcap"
    kf_calib.save_calibration(kf_calib.calibrate(recording), "cal.json", recording)
    assert "--noise" in run.refused("export", "cal.json", "--to", "robot_localization", "-o", "x")
    err = run.refused("export", "cal.json", "--noise", "noise.json", "--to", "csv", "-o", "x")
    assert "takes no noise" in err and not Path("x").exists()
    code, _, _ = run("export", "cal.json", "--noise", "noise.json", "--to", "robot_localization", "-o", "x")
    assert code == 0 and "linear_acceleration_covariance" in Path("x").read_text()


def test_the_figure_has_the_deviations_and_the_lines_through_them(run: Any, rest: Path) -> None:
    from kf_calib.noise.rest_noise import noise_at_rest
    from kf_calib.sources.text.lines import Lines

    assert run("noise", rest, "--png", "noise.png")[0] == 0 and Path("noise.png").read_bytes()[:4] == b"\x89PNG"
    found = noise_at_rest(Lines(rest, angles=False), with_temperature=True)
    figure = plot.noise(found)
    panels = [axes for axes in figure.axes if axes.axison]
    assert [axes.get_title(loc="left") for axes in panels] == [
        "accelerometer 1", "accelerometer 2", "accelerometer 3", "temperature",
    ]  # fmt: skip
    first, channel = panels[0], found.channels[0]
    points, total, white = first.get_lines()[:3]
    assert points.get_ydata() == pytest.approx(channel.deviation / 9.80665e-6)
    assert total.get_ydata() == pytest.approx(channel.model(channel.tau_s) / 9.80665e-6)
    assert white.get_label() == "white noise N, slope −½"
    assert first.get_xscale() == first.get_yscale() == "log"
    assert white.get_label() in [text.get_text() for text in figure.legends[0].get_texts()]


def test_remarks_are_told_once_for_channels_that_are_alike() -> None:
    from helpers.resting import Resting

    from kf_calib.noise.rest_noise import noise_at_rest

    readings = level(np.zeros((3000, 3)))
    (only,) = remarks(noise_at_rest(Resting(readings)))
    assert only == ("accelerometer 1, accelerometer 2, accelerometer 3: its readings do not change: it has no sizes.")
