"""Logs and tables as other programs write them: of all their columns, the accelerometer's are taken, with no option."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kf_calib.bench.streams import Table
from kf_calib.errors import CountsError, InputError
from kf_calib.sources.opening import opened
from kf_calib.sources.text.names import Meaning, meaning_of, meanings_of

G = 9.80665
RNG = np.random.default_rng(7)
COUNT = 900
SECONDS = 0.01 * np.arange(COUNT)
UP = np.repeat([(0, 0, 1), (0, 1, 0), (1, 0, 0)], COUNT // 3, axis=0)
FORCE = G * UP + RNG.normal(0.0, 0.02, (COUNT, 3))
OTHER = RNG.normal(0.0, 0.1, (COUNT, 12))
EPOCH_NS = 1_518_107_778_381_125_295

Cells = list[str]
Columns = dict[str, Cells]


def cells(values: object, form: str = "{:.9f}") -> Cells:
    return [form.format(value) for value in np.asarray(values).tolist()]


def three(pattern: str, values: np.ndarray, axes: str = "xyz") -> Columns:
    return {pattern.format(axis): cells(values[:, k]) for k, axis in enumerate(axes)}


def nanoseconds(jitter: float = 0.0) -> Cells:
    steps = np.rint(1e9 * (SECONDS + jitter * RNG.uniform(0.0, 0.004, COUNT))).astype(np.int64)
    return [str(EPOCH_NS + step) for step in steps.tolist()]


def constant(value: str, *names: str) -> Columns:
    return {name: [value] * COUNT for name in names}


def imu_message(before: str, between: str, covariance: str) -> Columns:
    """The fields of sensor_msgs/Imu, its orientation never filled."""
    orientation = {f"{before}orientation{between}{axis}": ["0.0" if axis != "w" else "1.0"] * COUNT for axis in "xyzw"}
    return (
        orientation
        | constant("-1.0", *(f"{before}orientation_covariance{covariance.format(k)}" for k in range(9)))
        | three(f"{before}angular_velocity{between}{{}}", OTHER)
        | constant("0.0", *(f"{before}angular_velocity_covariance{covariance.format(k)}" for k in range(9)))
        | three(f"{before}linear_acceleration{between}{{}}", FORCE)
        | constant("0.0", *(f"{before}linear_acceleration_covariance{covariance.format(k)}" for k in range(9)))
    )


LAYOUTS: dict[str, Callable[[], Columns]] = {
    "rostopic echo -p": lambda: {"%time": nanoseconds(1.0), "field.header.seq": cells(range(COUNT), "{}"),
                                 "field.header.stamp": nanoseconds(), **constant("imu", "field.header.frame_id"),
                                 **imu_message("field.", ".", "{}")},
    "bagpy": lambda: {"Time": cells(1.518e9 + SECONDS, "{:.6f}"), "header.seq": cells(range(COUNT), "{}"),
                      "header.stamp.secs": cells(1518107778 + SECONDS // 1, "{:.0f}"),
                      "header.stamp.nsecs": cells(1e9 * (SECONDS % 1), "{:.0f}"),
                      **constant("imu", "header.frame_id"), **imu_message("", ".", "_{}")},
    "PlotJuggler": lambda: {"__time": cells(1.518e9 + SECONDS, "{:.6f}"), **imu_message("/imu/data/", "/", "[{}]"),
                            **three("/imu/data/orientation/{}", OTHER, ("roll", "pitch", "yaw"))},
    "EuRoC": lambda: {"#timestamp [ns]": nanoseconds(), **three("w_RS_S_{} [rad s^-1]", OTHER),
                      **three("a_RS_S_{} [m s^-2]", FORCE)},
    "EuRoC without units": lambda: {"timestamp": nanoseconds(), **three("w_RS_S_{}", OTHER),
                                    **three("a_RS_S_{}", FORCE)},
    "Kalibr": lambda: {"timestamp": nanoseconds(), **three("omega_{}", OTHER), **three("alpha_{}", FORCE)},
    "Klipper": lambda: {"#time": cells(1234.5 + SECONDS), **three("accel_{}", 1e3 * FORCE)},
    "MPU6050": lambda: {"millis": cells(1e3 * SECONDS, "{:.0f}"), **three("Ac{}", FORCE, "XYZ"),
                        **constant("21.5", "Tmp"), **three("Gy{}", OTHER, "XYZ")},
    "nine axes": lambda: {"time_s": cells(SECONDS), **three("a{}", FORCE), **three("g{}", OTHER),
                          **three("m{}", 40.0 * OTHER)},
    "WitMotion": lambda: {"Time(s)": cells(SECONDS), "ChipTime": cells(SECONDS), **three("a{}(g)", FORCE / G),
                          **three("w{}(deg/s)", OTHER), **three("Angle{}(deg)", OTHER, "XYZ"),
                          **constant("21.5", "T(°)"), **three("h{}", OTHER), **constant("0.5", "q0", "q1", "q2", "q3")},
    "PX4": lambda: {"timestamp": cells(1e6 * SECONDS + 2e7, "{:.0f}"), **three("gyro_rad[{}]", OTHER, "012"),
                    **constant("0", "accelerometer_timestamp_relative"),
                    **three("accelerometer_m_s2[{}]", FORCE, "012"), **constant("0", "accelerometer_clipping")},
    "ArduPilot": lambda: {"TimeUS": cells(1e6 * SECONDS + 2e7, "{:.0f}"), **constant("0", "I"),
                          **three("Gyr{}", OTHER, "XYZ"), **three("Acc{}", FORCE, "XYZ"), **constant("41.5", "T")},
    "Xsens": lambda: {"Timestamp [ms]": cells(1e3 * SECONDS, "{:.0f}"), **three("Acc_{}", FORCE, "XYZ"),
                      **three("FreeAcc_{}", OTHER, "XYZ"), **three("Gyr_{}", OTHER, "XYZ"),
                      **three("Mag_{}", OTHER, "XYZ"), **constant("0.5", *(f"Quat_q{k}" for k in range(4)))},
    "a phone": lambda: {"seconds_elapsed": cells(SECONDS), **three("LINEAR ACCELERATION {} (m/s²)", OTHER, "XYZ"),
                        **three("ACCELEROMETER {} (m/s²)", FORCE, "XYZ"), **three("GRAVITY {} (m/s²)", G * UP, "XYZ"),
                        **three("GYROSCOPE {} (rad/s)", OTHER, "XYZ"), **three("MAGNETIC FIELD {} (μT)", OTHER, "XYZ"),
                        **three("ORIENTATION {} (°)", OTHER, "XYZ")},
    "truth beside it": lambda: {"time_s": cells(SECONDS), **three("{}_true (g)", UP),
                                **three("{}_mean (g)", FORCE / G)},
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_accelerometer_is_found_in_the_logs_of_others(layout: str, tmp_path: Path) -> None:
    columns = LAYOUTS[layout]()
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(columns), *map(",".join, zip(*columns.values(), strict=True)), ""]))
    source = opened(path, {"gravity_mps2": str(G)}, angles=False)
    assert not isinstance(source, Table)
    batches = list(source)
    readings = np.concatenate([source.bench.input.readings(batch.accel.values) for batch in batches])
    np.testing.assert_allclose(np.concatenate([batch.accel.values for batch in batches]), FORCE, atol=2e-8)
    assert len(readings) == COUNT
    times = np.concatenate([batch.accel.time_ns for batch in batches])
    np.testing.assert_allclose(np.diff(times), 1e7, atol=1e3)  # of two stamps the even one


def test_a_blackbox_gets_the_size_of_its_counts_by_option(tmp_path: Path) -> None:
    path = tmp_path / "LOG00001.01.csv"
    columns = {"loopIteration": cells(range(COUNT), "{}"), " time (us)": cells(1e6 * SECONDS + 2e7, "{:.0f}"),
               **constant("0", " axisP[0]", " axisP[1]", " axisP[2]"), **three(" gyroADC[{}]", 9 * OTHER, "012"),
               **three(" accSmooth[{}]", np.rint(2048 * FORCE / G), "012"),
               **constant("IDLE", " failsafePhase (flags)"),
               **three(" {}", OTHER, ("roll", "pitch", "heading"))}  # fmt: skip
    path.write_text("\n".join([",".join(columns), *map(",".join, zip(*columns.values(), strict=True)), ""]))
    option = {"accel_unit": "g", "accel_scale": "0.00048828125"}
    with pytest.raises(CountsError, match=r"--accel-unit g --accel-scale 0\.00048828125") as caught:
        opened(path, {"gravity_mps2": str(G)}, angles=False).bench  # noqa: B018 (the bench is read by the asking)
    assert caught.value.keys == option
    source = opened(path, {"gravity_mps2": str(G), **option}, angles=False)
    np.testing.assert_allclose(np.concatenate([batch.accel.values for batch in source]), FORCE, atol=G / 4000)


def test_a_table_of_nine_axes_is_of_the_accelerometer_alone(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    rows = [[*up, *other] for up, other in zip(G * UP[::100], OTHER[::100, :6], strict=True)]
    path.write_text("ax,ay,az,gx,gy,gz,mx,my,mz\n" + "\n".join(",".join(map(str, row)) for row in rows))
    source = opened(path, {"gravity_mps2": str(G)}, angles=False)
    assert isinstance(source, Table)
    np.testing.assert_allclose(source.orientations.mean_mps2, G * UP[::100], atol=1e-9)


@pytest.mark.parametrize("names", [
    ("q0", "q1", "q2", "q3"), ("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"), ("QuatW", "QuatX", "QuatY", "QuatZ"),
    ("Quaternion.w", "Quaternion.x", "Quaternion.y", "Quaternion.z"), ("qw", "qx", "qy", "qz"),
    ("quat_w", "quat_x", "quat_y", "quat_z"),
])  # fmt: skip
def test_four_parts_of_a_quaternion_are_no_gimbals(names: tuple[str, ...]) -> None:
    assert [own.ours for own in meanings_of(names, {})] == ["qw", "qx", "qy", "qz"]


def test_joints_of_a_robot_are_gimbals_still() -> None:
    names = ("q1 [deg]", "q2 [deg]", "q3 [deg]", "axis 1", "Achse 2")
    assert {own.ours for own in meanings_of(names, {})} == {"angle"}
    assert meaning_of("axisP[1]").ours == ""


def test_what_is_stated_goes_before_what_is_guessed() -> None:
    names = ("acc1_x [g]", "acc2_x [g]", "Roll", "gyro_x")
    assert [own.ours for own in meanings_of(names, {})] == ["ax", "ax", "", ""]
    stated = meanings_of(names, {"acc2_x [g]": "ax", "Roll": "outer_deg"})
    assert stated[:3] == [Meaning("", "g"), Meaning("ax", "g"), Meaning("angle", "deg", 1)]


def test_two_accelerometers_are_a_choice_that_a_hint_makes_possible(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    columns = {"time_s": cells(SECONDS), **three("acc1_{}", FORCE), **three("acc2_{}", FORCE)}
    path.write_text("\n".join([",".join(columns), *map(",".join, zip(*columns.values(), strict=True)), ""]))
    with pytest.raises(InputError, match="say which it is, for example by --column 'acc1_x=ax'"):
        opened(path, {"gravity_mps2": "9.81"}, angles=False).bench  # noqa: B018 (the bench is read by the asking)
