"""Logs in layouts that their loggers chose: readings and stamps are those of the file, without an option."""

import json
import zipfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kf_calib.errors import InputError
from kf_calib.sources.file_kind import FileKind
from kf_calib.sources.opening import kind_of, opened
from kf_calib.sources.text.documents import Objects, cut_array, cut_echo
from kf_calib.sources.text.lines import Lines
from kf_calib.sources.text.names import Meaning, meaning_of
from kf_calib.sources.text.units import Units

G = 9.80665
UP = np.array([(0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0.6, 0.8, 0), (0, 0.6, 0.8)])
FORCES = np.round(np.repeat(G * UP, 90, axis=0) + np.random.default_rng(1).normal(0.0, 0.02, (720, 3)), 4)
STEP_S = 0.02
Row = Callable[[float, str, str, str], str]


def of_clock(t: float, fraction: str = ".") -> str:
    """The time of day, which begins a little before midnight."""
    at_ms = (86_390_000 + round(1000 * t)) % 86_400_000
    return f"{at_ms // 3_600_000:02d}:{at_ms // 60_000 % 60:02d}:{at_ms // 1000 % 60:02d}{fraction}{at_ms % 1000:03d}"


def whole(t: float, unit_s: float) -> tuple[int, int]:
    """A time in whole units since an epoch, and what is over in ns."""
    at_ns = 1_700_000_000_000_000_000 + round(t * 1e9)
    return divmod(at_ns, round(1e9 * unit_s))


LAYOUTS: dict[str, tuple[str, Row]] = {
    "seconds and nanoseconds": ("header.stamp.sec,header.stamp.nanosec,ax,ay,az",
                                lambda t, *f: ",".join(map(str, (*whole(t, 1.0), *f)))),
    "whole seconds without a unit, and microseconds": (
        "Unix Time Stamp,Microseconds,Accelerometer X (m/s/s),Accelerometer Y (m/s/s),Accelerometer Z (m/s/s)",
        lambda t, *f: ",".join(map(str, (whole(t, 1.0)[0], whole(t, 1.0)[1] // 1000, *f)))),
    "a stamp that is late, and its parts": (
        "Time,stamp.secs,stamp.nsecs,ax,ay,az",
        lambda t, *f: ",".join(map(str, (1.7e9 + t + t % 0.04 / 8, *whole(t, 1.0), *f)))),
    "hours, minutes and seconds": ("Year,Month,Day,Hour,Minute,Second,ax,ay,az",
                                   lambda t, *f: f"2026,5,4,13,{50 + int(t // 60)},{t % 60:.2f},{','.join(f)}"),
    "a date, a time to the second, and milliseconds": (
        "Date,Time,ms,X (m/s2),Y (m/s2),Z (m/s2)",
        lambda t, *f: f"2026-05-27,{of_clock(t - 20)[:8]},{of_clock(t)[9:]},{','.join(f)}"),
    "the time of day": ("Time,ax,ay,az", lambda t, *f: ",".join((of_clock(t), *f))),
    "a time difference": ("time,ax,ay,az", lambda t, *f: ",".join((f"0 days 00:00:{t:09.6f}", *f))),
    "minutes and seconds": ("elapsed,ax,ay,az", lambda t, *f: ",".join((f"00:{t:06.3f}", *f))),
    "the name of a month": ("Timestamp,X,Y,Z", lambda t, *f: f"27-May-2026 09:30:{t:06.3f},{','.join(f)}"),
    "a colon before milliseconds": ("time,ax,ay,az", lambda t, *f: f"2026-05-27 {of_clock(t - 20, ':')},{','.join(f)}"),
    "a date and a time without names": ("日期,时间,X(m/s2),Y(m/s2),Z(m/s2)",
                                        lambda t, *f: f"2026-05-27,09:30:{t:06.3f},{','.join(f)}"),
    "a stamp, and no names": ("", lambda t, *f: f"2026-05-27 09:30:{t:06.3f},{','.join(f)},12,0,24.8"),
    "nanoseconds since the device was started": ("timestamp,x,y,z",
                                                 lambda t, *f: f"{81_234_000_000_000 + round(1e9 * t)},{','.join(f)}"),
    "an empty time beside a full one": ("Timestamp,UTC Time [s],ax,ay,az", lambda t, *f: f",{t:.2f},{','.join(f)}"),
    "an axis of a plot": ("X[s],ACC.X,X[s],ACC.Y,X[s],ACC.Z",
                          lambda t, x, y, z: f"{t:.2f},{x},{t:.2f},{y},{t:.2f},{z}"),
    "any units in a row": ('"sep=\t"\nS_Time_CAL\tS_Accel_X_CAL\tS_Accel_Y_CAL\tS_Accel_Z_CAL\tS_Gyro_X_CAL\tStatus\n'
                           "(ms)\tm/(s^2)\tm/(s^2)\tm/(s^2)\tdeg/s\tna",
                           lambda t, *f: "\t".join((f"{1000 * t:.0f}", *f, "0.1", "0x1F"))),
    "lists above": ("DEVICE\nName,Model,Serial,Rate\nimu,7,12,50\nDATA\nTime [s],7-GX5:scaledAccelX,7-GX5:scaledAccelY,"
                    "7-GX5:scaledAccelZ", lambda t, *f: ",".join((f"{t:.2f}", *f))),
    "numbers above": ("Writer\t2\nSamples\t720\t720\t720\nDelta_X\t0.02\t0.02\t0.02\n"
                      "X_Value\tAccel X\tAccel Y\tAccel Z\tComment",
                      lambda t, *f: "\t".join((f"{t:.2f}", *f))),
    "names behind a word in a comment": (";Title, of a run, by me\n;Headers, time [s],Ax,Ay,Az",
                                         lambda t, *f: ",".join((f"{t:.2f}", *f))),
    "a number of the row": ("time_s,frame_number,ax,ay,az,samples",
                            lambda t, *f: f"{t:.2f},{round(t / STEP_S)},{','.join(f)},1"),
    "counts beside": ("time_s,Acc_Raw_X,Acc_Raw_Y,Acc_Raw_Z,Acc_ms2_X,Acc_ms2_Y,Acc_ms2_Z",
                      lambda t, *f: ",".join((f"{t:.2f}", *(f"{1000 * float(each):.0f}" for each in f), *f))),
    "nested JSON": ("", lambda t, x, y, z: f'{{"ts": {whole(t, 1e-3)[0]}, "id": "a", "acc": {{"x": {x}, "y": {y}, '
                                           f'"z": {z}}}, "gyro": [0.1, {t}, null]}}'),
    "plain JSON": ("", lambda t, x, y, z: f'{{"time_s":{t:.2f},"ax":{x},"ay":{y},"az":{z}}}'),
    "a stamp before a print": ("", lambda t, *f: f"{of_clock(t)} -> {chr(9).join(f)}"),
    "vectors in a print": ("", lambda t, *f: f"[{t:.3f}] accel=({', '.join(f)}) gyro=(0.1, {t}, 0.2)"),
    "a stamp before labels": ("", lambda t, x, y, z: f"2026-05-27 09:30:{t:06.3f} I imu: acce_x:{x}, acce_y:{y}, "
                                                     f"acce_z:{z}"),
}  # fmt: skip
WITHOUT_TIME: dict[str, Row] = {
    "NMEA": lambda t, *f: f"$VNACC,{','.join(f)}*{round(100 * t) % 256:02X}",
    "tuples": lambda _, *f: f"({', '.join(f)})",
    "brackets": lambda _, *f: f"[{' '.join(f)}]",
    "columns that never change": lambda _, *f: f"imu 0.0 0.0 0.0 1.0 {' '.join(f)} 0.0 0.0 0.0",
}


def text(heading: str, row: Row) -> str:
    rows = (row(STEP_S * k, *(f"{each:.4f}" for each in force)) for k, force in enumerate(FORCES.tolist()))
    return "\n".join([*filter(None, [heading]), *rows, ""])


def forces_in(source: Lines) -> np.ndarray:
    return np.concatenate([batch.accel.values for batch in source])


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_log_of_a_stranger_is_read(name: str, tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text(text(*LAYOUTS[name]), encoding="utf-8")
    assert kind_of(path) is FileKind.SAMPLES
    batches = list(opened(path, {"gravity_mps2": str(G)}, angles=False))
    np.testing.assert_allclose(np.concatenate([batch.accel.values for batch in batches]), FORCES, atol=1e-9)
    times_ns = np.concatenate([batch.accel.time_ns for batch in batches])
    np.testing.assert_allclose(np.diff(times_ns), 1e9 * STEP_S, atol=1e6)


@pytest.mark.parametrize("name", WITHOUT_TIME)
def test_a_print_without_a_time_needs_its_rate_only(name: str, tmp_path: Path) -> None:
    path = tmp_path / "log.txt"
    path.write_text(text("", WITHOUT_TIME[name]))
    with pytest.raises(InputError, match="--rate"):
        list(Lines(path, angles=False))
    source = Lines(path, {"gravity_mps2": str(G)}, units=Units(rate_hz=50.0), angles=False)
    np.testing.assert_allclose(forces_in(source), FORCES, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "told"),
    [("ax [m/(s^2)]", "m/s2"), ("ay (m.s^-2)", "m/s2"), ("az [m·s⁻²]", "m/s2"), ("ax [gₙ]", "g"),
     ("ax (ft/s²)", "ft/s2"), ("ay [cm/s^2]", "cm/s2"), ("az [Gal]", "cm/s2")],
)  # fmt: skip
def test_a_unit_may_be_written_with_any_signs_of_powers_and_products(name: str, told: str) -> None:
    assert meaning_of(name) == Meaning(name[:2], told)


def echoed(vector: str, secs: str, nsecs: str, t: float, force: list[float]) -> str:
    """A message as the tools of ROS print it; a covariance is a list in a line, or an item a line."""
    stamp, values = whole(t, 1.0), "\n".join(f"  {axis}: {value!r}" for axis, value in zip("xyz", force, strict=True))
    covariance = "[-1.0, 0.0, 0.0]" if secs == "secs" else "\n- -1.0\n- 0.0\n- '...'"
    return (f"header: \n  stamp: \n    {secs}: {stamp[0]}\n    {nsecs}: {stamp[1]}\n  frame_id: \"imu: left\"\n"
            f"{vector}_covariance: {covariance}\n{vector}: \n{values}\n---\n")  # fmt: skip


@pytest.mark.parametrize("layout", ["an array", "an array over many lines", "rostopic echo", "ros2 topic echo"])
def test_objects_of_many_lines_are_read(layout: str, tmp_path: Path) -> None:
    rows = [(STEP_S * k, force) for k, force in enumerate(FORCES.tolist())]
    if layout.startswith("an array"):
        objects = [{"time": t, "note": 'a } or \\" in words', "acc": dict(zip("xyz", f, strict=True))} for t, f in rows]
        content = json.dumps(objects, indent=1 if "many" in layout else None)
    else:
        stamp = ("secs", "nsecs") if layout == "rostopic echo" else ("sec", "nanosec")
        content = "".join(echoed("linear_acceleration", *stamp, *row) for row in rows)
    path = tmp_path / "log.txt"
    path.write_text(content, encoding="utf-16" if "many" in layout else "utf-8")
    assert kind_of(path) is FileKind.SAMPLES
    batches = list(opened(path, {"gravity_mps2": str(G)}, angles=False))
    np.testing.assert_allclose(np.concatenate([batch.accel.values for batch in batches]), FORCES, atol=1e-9)
    times_ns = np.concatenate([batch.accel.time_ns for batch in batches])
    np.testing.assert_allclose(np.diff(times_ns), 1e9 * STEP_S, atol=1e6)


@pytest.mark.parametrize("size", [1, 7, 100_000])
def test_objects_do_not_depend_on_the_blocks_that_they_come_in(size: int) -> None:
    array = json.dumps([{"t": k, "a": [1, {"b": 'x } \\" {'}]} for k in range(50)], indent=2).encode()
    objects = Objects(cut_array)
    lines = b"".join(objects.push(array[k : k + size]) for k in range(0, len(array), size)).splitlines()
    assert [json.loads(line)["t"] for line in lines] == [*range(50)]


@pytest.mark.parametrize("size", [1, 4, 100_000])
def test_messages_do_not_depend_on_the_blocks_that_they_come_in(size: int) -> None:
    """A line that begins like a border is none."""
    text = "".join(f"header:\n  seq: {k}\nnote: 'a'\n---b: 1\nvalues:\n- {k}.5\n- µ\n---\n" for k in range(50)).encode()
    objects = Objects(cut_echo)
    lines = b"".join(objects.push(text[k : k + size]) for k in range(0, len(text), size)).splitlines()
    assert [json.loads(line)["values.0"] for line in lines] == [k + 0.5 for k in range(50)]
    assert json.loads(lines[7]) == {"header.seq": 7, "note": "a", "---b": 1, "values.0": 7.5, "values.1": "µ"}
    assert objects.rest() == b""


@pytest.mark.parametrize("end", range(1, 45, 7))
@pytest.mark.parametrize("layout", ["an array", "ros2 topic echo"])
def test_of_a_log_that_was_cut_the_last_object_is_counted_and_not_read(layout: str, end: int, tmp_path: Path) -> None:
    """A number of it may lack its last digits."""
    rows = [(STEP_S * k, force) for k, force in enumerate(FORCES.tolist())]
    if layout == "an array":
        content = json.dumps([{"t": t, "x": f[0], "y": f[1], "z": f[2]} for t, f in rows])[:-1]
    else:
        content = "".join(echoed("acc", "sec", "nanosec", *row) for row in rows).removesuffix("---\n")
    path = tmp_path / "log.txt"
    path.write_text(content[:-end])
    source = Lines(path, {"gravity_mps2": str(G)}, angles=False)
    np.testing.assert_allclose(forces_in(source), FORCES[:-1], atol=1e-9)
    assert any("1 of 720 lines were malformed" in warning for warning in source.warnings)


def test_an_object_without_an_end_is_a_line_that_is_refused() -> None:
    objects = Objects(cut_array)
    assert objects.push(b'[{"t": 1}, {"x": "' + bytes(2_000_000)).splitlines()[0] == b'{"t": 1}'
    assert objects.push(b"") == b""  # it is not kept


def test_one_array_of_json_as_a_stream_is_refused_with_what_makes_lines_of_it() -> None:
    with pytest.raises(InputError, match="jq -c"):
        list(Lines(BytesIO(b'[\n{"t": 0, "ax": 1}\n]\n'), angles=False))


def test_an_archive_is_to_be_unpacked(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "experiment.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("Raw Data.csv", text(*LAYOUTS["plain JSON"]))
    assert "unpack it" in run.refused("info", path)


@pytest.mark.parametrize(
    ("line", "rate_hz"),
    [
        ("// Sample rate: 50.0Hz", 50.0), ("Abtastrate = 12,5 Hz", 12.5), ("Sampling Frequency: 100 Hz", 100.0),
        ("date format M/d/yyyy at 50 Hz  Filter Normal", 50.0), ("low-pass at 20 Hz", None), ("cut-off 20 Hz", None),
        ("sample rate 50 Hz, output rate 10 Hz", None), ("rate 50", None),
    ],
)  # fmt: skip
def test_the_rate_of_rows_without_a_time_is_that_stated_above_them(
    line: str, rate_hz: float | None, tmp_path: Path
) -> None:
    path = tmp_path / "log.csv"
    path.write_text("\n".join([line, "ax_mps2,ay_mps2,az_mps2", *(",".join(map(str, f)) for f in FORCES.tolist()), ""]))
    source = Lines(path, {"gravity_mps2": "9.80665"}, angles=False)
    if rate_hz is None:
        with pytest.raises(InputError, match="no column gives the time"):
            next(iter(source))
        return
    times_ns = np.concatenate([batch.accel.time_ns for batch in source])
    np.testing.assert_allclose(np.diff(times_ns), 1e9 / rate_hz, atol=1.0)
    assert any(f"{rate_hz:g} of them a second, as is stated above them" in said for said in source.warnings)


def test_a_cell_in_another_unit_than_its_column_is_no_number(tmp_path: Path) -> None:
    rows = [f'{STEP_S * k:.2f},"{x} m/s²","{y} m/s²","{z} m/s²"' for k, (x, y, z) in enumerate(FORCES.tolist())]
    rows[400:410] = [row.replace("m/s²", "mm/s²") for row in rows[400:410]]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["t,ax,ay,az", *rows, ""]))
    source = Lines(path, {"gravity_mps2": "9.80665"}, angles=False)
    kept = np.concatenate([batch.accel.values for batch in source])
    np.testing.assert_allclose(kept, np.delete(FORCES, range(400, 410), axis=0))
    assert any("10 of 721 lines were malformed and skipped" in said for said in source.warnings)
