"""JSON and CSV lines: what goes in comes out, to the nanosecond; what is broken is counted and never stops the rest."""

import io
import json
import math
import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.bounded import traced
from helpers.recordings import read
from hypothesis import given, settings
from hypothesis import strategies as st

from kf_calib.errors import InputError
from kf_calib.sources.text.lines import Lines
from kf_calib.sources.text.units import Units

BENCH = {"axes": "y z x", "gravity_mps2": "9.81"}
HEADER = "time_s,ax_mps2,ay_mps2,az_mps2,outer_deg,middle_deg,inner_deg,temperature_c"
ROW = "1.5,0.1,9.8,-0.2,10,20,30,25.5"
OBJECT = {"time_ns": 1_500_000_000, "accel_mps2": [0.1, 9.8, -0.2], "angles_rad": [0.1, 0.2, 0.3], "temperature_c": 25}
START_NS = 1_750_000_000_123_456_789


def lines_of(text: str | bytes, bench=BENCH, **options) -> Lines:
    return Lines(io.BytesIO(text.encode() if isinstance(text, str) else text), bench, **options)


def json_text(*entries) -> str:
    return "".join((entry if isinstance(entry, str) else json.dumps(entry)) + "\n" for entry in entries)


def recorded(count: int = 500) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    stamps = START_NS + np.cumsum(rng.integers(1, 10**7, count))
    return stamps, rng.normal(size=(count, 3)), rng.uniform(-3, 3, (count, 3))


# -- what goes in comes out --


def test_json_round_trip_with_the_bench_on_the_first_line(tmp_path):
    stamps, accel, pose = recorded()
    entries = [{"time_ns": t, "accel_mps2": a, "angles_rad": q, "temperature_c": 20.0}
               for t, a, q in zip(stamps.tolist(), accel.tolist(), pose.tolist(), strict=True)]  # fmt: skip
    path = tmp_path / "run.jsonl"
    path.write_text(json_text({"bench": {"axes": "y z x", "gravity_mps2": 9.8, "nominal": {"theta1": 0}}}, *entries))
    source = Lines(path)
    for _ in range(2):  # a file can be read again
        batch = read(source)
        np.testing.assert_array_equal(batch.accel.time_ns, stamps)
        np.testing.assert_array_equal(batch.accel.values, accel)
        np.testing.assert_array_equal(batch.pose.values, pose)
        np.testing.assert_array_equal(batch.temperature.values, np.full((500, 1), 20.0))
    assert (source.bench.gravity_mps2, source.bench.nominal) == (9.8, {"theta1": 0.0})
    assert (source.warnings, source.fraction) == ([], 1.0)


def test_csv_round_trip_keeps_nanoseconds():
    stamps, accel, pose = recorded()
    rows = [f"{t // 10**9}.{t % 10**9:09d}," + ",".join(map(repr, [*a, *q, 21.5]))
            for t, a, q in zip(stamps.tolist(), accel.tolist(), np.degrees(pose).tolist(), strict=True)]  # fmt: skip
    batch = read(lines_of("\n".join([HEADER, *rows])))  # no newline at the end
    np.testing.assert_array_equal(batch.accel.time_ns, stamps)
    np.testing.assert_array_equal(batch.accel.values, accel)
    np.testing.assert_allclose(batch.pose.values, pose, rtol=1e-15)
    assert len(batch.temperature) == 500


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("time_s", "1750000000.123456789"),
        ("time_s", "1.750000000123456789e9"),
        ("time_ms", "1750000000123.456789"),
        ("time_us", "1750000000123456.789"),
        ("time_ns", "1750000000123456789"),
    ],
)
def test_stamps_are_exact_in_every_unit(name, text):
    csv = HEADER.replace("time_s", name) + f"\n{text},1,2,3,4,5,6,7\n"
    line = f'{{"{name}": {text}, "accel_mps2": [1, 2, 3], "angles_rad": [0, 0, 0]}}\n'
    for source in (lines_of(csv), lines_of(line)):
        assert read(source).accel.time_ns.tolist() == [START_NS]


def test_negative_and_zero_stamps():
    assert read(lines_of(f"{HEADER}\n-0.5,1,2,3,4,5,6,7\n0,1,2,3,4,5,6,7")).accel.time_ns.tolist() == [-500_000_000, 0]


@pytest.mark.parametrize(("unit", "size"), [("mps2", 1.0), ("g", 9.80665), ("mg", 9.80665e-3)])
def test_units_of_readings(unit, size):
    csv = lines_of(HEADER.replace("mps2", unit) + "\n" + ROW)
    line = lines_of(json_text(OBJECT).replace("accel_mps2", f"accel_{unit}"))
    for source in (csv, line):
        np.testing.assert_allclose(read(source).accel.values, size * np.array([[0.1, 9.8, -0.2]]), rtol=1e-15)


def test_units_of_angles_and_their_order():
    mixed = HEADER.replace("outer_deg,middle_deg,inner_deg", "inner_rad,outer_deg,middle_deg")
    np.testing.assert_allclose(read(lines_of(f"{mixed}\n1,0,0,0,0.5,180,90,20")).pose.values, [[np.pi, np.pi / 2, 0.5]])
    other = "time_s,ax_g,ay_g,az_g,roll_deg,tilt_rad"
    batch = read(lines_of(f"{other}\n1,0,0,1,90,0.25", BENCH | {"axes": "z x"}))
    np.testing.assert_allclose(batch.pose.values, [[np.pi / 2, 0.25]])
    degrees = {"time_s": 1, "accel_g": [0, 1, 0], "angles_deg": [180, 0, 90]}
    np.testing.assert_allclose(read(lines_of(json_text(degrees))).pose.values, [[np.pi, 0, np.pi / 2]])


def test_attitudes_in_place_of_angles():
    quaternion = [0.5, 0.5, -0.5, 0.5]
    csv = "time_s,ax_g,ay_g,az_g,qx,qy,qz,qw\n1,0,1,0,0.5,0.5,-0.5,0.5"
    line = json_text({"time_s": 1, "accel_g": [0, 1, 0], "attitude_xyzw": quaternion})
    for text in (csv, line):
        source = lines_of(text, {"gravity_mps2": "9.81"})
        np.testing.assert_array_equal(read(source).pose.values, [quaternion])
        assert source.bench.axes == ()


def test_readings_and_poses_on_lines_of_their_own():
    text = json_text(
        {"time_ns": 1, "accel_mps2": [1, 2, 3]},
        {"time_ns": 2, "accel_mps2": [4, 5, 6], "temperature_c": None},
        {"time_ns": 3, "angles_rad": [0.1, 0.2, 0.3]},
        {"time_ns": 4, "temperature_c": 20},
    )
    batch = read(lines_of(text))
    assert [stream.time_ns.tolist() for stream in (batch.accel, batch.pose, batch.temperature)] == [[1, 2], [3], [4]]


def test_empty_cells_are_not_measured():
    rows = ["1,1,2,3,,,,", "2,,,,4,5,6,", "3,,,,,,,21", "4,7,8,9, , , ,", "\r", '"5","1","2","3",7,8,9,""']
    source = lines_of("\ufeff" + "\r\n".join([HEADER, *rows]) + "\r\n")
    batch = read(source)
    assert source.warnings == []
    stamps = [(stream.time_ns // 10**9).tolist() for stream in (batch.accel, batch.pose, batch.temperature)]
    assert stamps == [[1, 4, 5], [2, 5], [3]]


def test_foreign_names_are_renamed():
    csv = "Stamp,acc_x[g],acc_y[g],acc_z[g],Outer_Deg,mid,inner_deg\n1,0,1,0,1,2,3"
    ours = {"Stamp": "time_s", "acc_x[g]": "ax_g", "acc_y[g]": "ay_g", "acc_z[g]": "az_g", "mid": "middle_deg"}
    assert read(lines_of(csv, columns=ours)).accel.values.tolist() == [[0.0, 9.80665, 0.0]]
    line = json_text({"t": 1.5, "f": [1, 2, 3], "q": [0, 0, 0]})
    source = lines_of(line, columns={"t": "time_s", "f": "accel_mps2", "q": "angles_rad"})
    assert read(source).accel.time_ns.tolist() == [1_500_000_000]


def test_unknown_names_are_counted_and_named_once():
    many = {f"key{i}": i for i in range(50)}
    source = lines_of(json_text(*[OBJECT | {"gyro": [1, 2, 3]}] * 5, OBJECT | many))
    assert len(read(source).accel) == 6
    (warning,) = source.warnings
    assert "'gyro' (5)" in warning and "'others' (43)" in warning and len(warning) < 400
    table = lines_of(f"{HEADER},note\n{ROW},hello world\n")
    assert len(read(table).accel) == 1
    assert "'note'" in table.warnings[0]


def test_options_win_over_the_first_line():
    text = json_text({"bench": {"axes": "x", "gravity_mps2": 9.7}}, OBJECT)
    assert lines_of(text, {"axes": "y z x"}).bench.gravity_mps2 == 9.7
    assert len(lines_of(text, {"axes": "y z x"}).bench.axes) == 3


# -- broken lines --

BROKEN_JSON = [
    "not JSON",
    "{",
    "[1, 2]",
    "7",
    "\x00\x01\x02",
    "[" * 100_000,
    '{"a":' * 100_000,
    '{"time_ns": 1, "accel_mps2": [NaN, 1, 2]}',
    '{"time_ns": 1, "accel_mps2": [Infinity, 1, 2]}',
    '{"time_ns": 1, "accel_mps2": [1e999, 1, 2]}',
    '{"time_ns": 1, "accel_mps2": [true, 1, 2]}',
    '{"time_ns": 1, "accel_mps2": ["1", 1, 2]}',
    '{"time_ns": 1, "accel_mps2": [1, 2]}',
    '{"time_ns": 1, "accel_mps2": {"x": 1}}',
    '{"time_ns": 1, "accel_mps2": [' + "9" * 400 + ", 1, 2]}",
    '{"time_ns": 1, "accel_mps2": [' + "9" * 5000 + ", 1, 2]}",
    '{"time_ns": 9223372036854775808, "accel_mps2": [1, 1, 2]}',
    '{"time_s": 1e999999999, "accel_mps2": [1, 1, 2]}',
    '{"time_s": NaN, "accel_mps2": [1, 1, 2]}',
    '{"time_ns": "1", "accel_mps2": [1, 1, 2]}',
    '{"time_ns": true, "accel_mps2": [1, 1, 2]}',
    '{"accel_mps2": [1, 1, 2]}',
    '{"time_ns": 1, "accel_mps2": [1, 1, 2], "angles_rad": [1, 2]}',
    '{"time_ns": 1, "accel_mps2": [1, 1, 2], "angles_rad": []}',
    '{"time_ns": 1, "accel_mps2": [1, 1, 2], "attitude_xyzw": [0, 0, 0, 1]}',
    '{"time_ns": 1, "accel_mps2": [1, 1, 2], "temperature_c": "hot"}',
    '{"time_ns": 1, "note": "' + "x" * (1 << 20) + '", "accel_mps2": [1, 1, 2]}',
]


@pytest.mark.parametrize("line", BROKEN_JSON, ids=lambda line: line[:40])
def test_a_broken_json_line_costs_itself_only(line):
    check_broken(json_text(OBJECT, line, OBJECT), 2)


def check_broken(text: str, number: int) -> None:
    """All lines but one are used, and the warning names it."""
    source = lines_of(text)
    assert len(read(source).accel) == 2
    (warning,) = source.warnings
    assert f"1 of {number + 1} lines were malformed and skipped (first line {number}: " in warning


BROKEN_CSV = [
    "1,2,3",
    ROW + ",1",
    ROW.replace("9.8", "nine"),
    ROW.replace("9.8", "nan"),
    ROW.replace("9.8", "inf"),
    ROW.replace("9.8", "1e999"),
    ROW.replace("9.8", ""),
    ROW.replace("1.5", ""),
    ROW.replace("1.5", "1e999999999"),
    ROW.replace("1.5", "NaN"),
    ROW.replace("1.5", "sNaN"),
    ROW.replace("1.5", "-Infinity"),
    ROW.replace("1.5", "9" * 30),
    ROW.replace("1.5", "2025-01-01T00:00:00"),
    ROW.replace("0.1", '"0.1'),
    ROW.replace("20", "\x00"),
    "x" * ((1 << 20) + 1),
    "\ufffd\x07garbage",
]


@pytest.mark.parametrize("line", BROKEN_CSV, ids=lambda line: line[:40])
def test_a_broken_csv_line_costs_itself_only(line):
    check_broken("\n".join([HEADER, ROW, line, ROW]), 3)


def test_the_first_malformed_line_is_named_by_its_number_in_the_file():
    rows = [ROW] * 20_000  # several blocks
    rows[15_000] = "broken"
    rows[17_000] = ROW.replace("9.8", "?")
    source = lines_of("\n".join([HEADER, *rows]))
    assert len(read(source).accel) == 19_998
    assert "2 of 20001 lines were malformed and skipped (first line 15002: it has 1 cells" in source.warnings[0]


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=400), st.sampled_from([b"", json_text(OBJECT).encode(), f"{HEADER}\n{ROW}\n".encode()]))
def test_garbage_raises_nothing_but_input_errors(garbage, before):
    source = lines_of(before + garbage + b"\n" + before)
    try:
        assert len(read(source).accel) >= 1
    except InputError as error:
        assert not before, error


@pytest.mark.parametrize("text", [b"\x00" * (32 << 20), b"{" * (32 << 20), b"\xff\xfe\n" * 100_000, b"\n" * (1 << 20)])
def test_hostile_input_ends_soon_and_in_little_memory(text):
    start = time.perf_counter()
    with traced() as peak, pytest.raises(InputError):
        read(lines_of(text))
    assert time.perf_counter() - start < 10.0
    assert peak.bytes < 40 << 20


@pytest.mark.slow
def test_memory_does_not_grow_with_the_lines():
    class Feed:
        """A header, then ``blocks`` blocks of rows, made as they are read."""

        def __init__(self, blocks: int) -> None:
            self.left = iter([f"{HEADER}\n".encode(), *[b""] * blocks])

        def read(self, size: int) -> bytes:
            block = next(self.left, None)
            return b"" if block is None else block or f"{ROW}\n".encode() * 400

    def peak(blocks: int) -> int:
        source = Lines(Feed(blocks), BENCH)
        with traced() as found:
            assert sum(len(batch.accel) for batch in source) == 400 * blocks
        return found.bytes

    peak(2)
    assert peak(18) < 1.3 * peak(6)


# -- live --


def test_a_live_stream_is_read_as_it_arrives():
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as stream, os.fdopen(writer, "wb", buffering=0) as feed:
        feed.write(json_text({"bench": {"axes": "y z x", "gravity_mps2": 9.81}}, OBJECT).encode())
        source = Lines(stream)
        assert source.bench.gravity_mps2 == 9.81
        assert math.isnan(source.fraction)
        batches = iter(source)
        assert len(next(batches).accel) == 1
        later = json_text(OBJECT).encode()
        feed.write(later[:20])  # half a line waits for its other half
        threading.Timer(0.1, feed.write, [later[20:]]).start()
        assert len(next(batches).accel) == 1
        feed.close()
        assert [len(batch.accel) for batch in batches] == []
    with pytest.raises(InputError, match="only once"):
        list(source)


# -- refusals --


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no lines"),
        ("\n \n", "holds no lines"),
        (HEADER, "no readings in 1 lines"),
        (f"{HEADER}\nx\ny", "no readings in 3 lines; 2 of 3 lines were malformed"),
        (f"{HEADER}\n1,1,2,3,,,,", "no platform angles in 2 lines"),
        ("ax_g,ay_g,az_g,outer_deg\n1,1,1,1", "no column gives the time: name it time_s"),
        ("time_s,ax,ay,az,outer_deg\n", "with their unit: name them ax_mps2"),
        ("time_s,ax,ay,az,outer_deg\n1,9000,9000,9000,1", "so they are counts: give the size of one by --accel-scale"),
        ("t,ax_g,ay_g,az_g,outer_deg\n10,1,1,1,1\n20,1,1,1,1", "which 't' has, for example --column 't=time_ms'"),
        ("time_s,ax_g,ay_g,az_g,outer\n1,1,1,1,1", "name them outer_deg"),
        ("time_s,ax_g,ay_g,az_g,ax_g,outer_deg\n", "two columns are named 'ax_g'"),
        ("time_s,ax_g,ay_g,az_g,outer_deg\n1,1,1,1,1", "1 angles and the bench has 3 axes"),
        (json_text({"time_ns": 1, "acc": [1, 2, 3], "angles_rad": [1]}), "'acc'.*name the readings accel_mps2 or acc"),
        (json_text({"time_ns": 1, "accel": [1, 2, 3], "angles_rad": [1]}), "do not tell their unit: name them"),
        (json_text({"time_ns": 1, "accel_g": [1, 2, 3]}), "no platform angles in 1 lines"),
        (json_text({"time_ns": 1, "angles_rad": [1, 2, 3]}), "no readings in 1 lines"),
        ("{]\n", "no platform angles in 1 lines; 1 of 1 lines were malformed"),
    ],
)
def test_unusable_lines_say_what_is_missing_and_what_to_do(text, words):
    with pytest.raises(InputError, match=words) as caught:
        read(lines_of(text, name="logger"))
    assert str(caught.value).startswith("logger")
    assert "\n" not in str(caught.value)


def test_a_bench_that_is_not_described_is_asked_for():
    with pytest.raises(InputError, match=r"standard input.*axes"):
        _ = lines_of(f"{HEADER}\n{ROW}", {}).bench
    with pytest.raises(InputError, match="gravty"):
        _ = lines_of(json_text({"bench": {"gravty": 9.81}}, OBJECT)).bench


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"absent\.csv: cannot be read"):
        list(Lines(tmp_path / "absent.csv", BENCH))


# -- what other programs write --


@pytest.mark.parametrize("first", [OBJECT, {"bench": BENCH}])
def test_a_byte_order_mark_costs_no_line(first):
    stated = BENCH if first is OBJECT else {}
    lines = lines_of(b"\xef\xbb\xbf" + json_text(first, OBJECT | {"time_ns": 1_600_000_000}).encode(), stated)
    assert len(read(lines).accel) == 1 + (first is OBJECT) and not lines.warnings


def test_a_bench_that_changes_in_the_run_is_told_as_that():
    lines = lines_of(json_text({"bench": BENCH}, OBJECT, {"bench": BENCH}, {"bench": BENCH | {"gravity_mps2": "9.7"}},
                               OBJECT | {"time_ns": 1_600_000_000}), {})  # fmt: skip
    assert len(read(lines).accel) == 2
    (said,) = lines.warnings
    assert "another bench than the first line (gravity_mps2: '9.7', first '9.81')" in said and "line 4" in said
    assert "time stamp" not in said


@pytest.mark.parametrize("text", ["0_1.1_0", "1_0"])
def test_what_python_alone_takes_for_a_number_is_none(text):
    good = ROW.replace("1.5,0.1", "1.6,0.1")
    lines = lines_of(f"{HEADER}\n{ROW.replace('0.1', text, 1)}\n{good}\n")
    assert len(read(lines).accel) == 1 and len(lines.warnings) == 1


def test_a_heading_of_many_columns_is_read_in_a_moment():
    names = [f"c{k}" for k in range(32_000)]
    text = f"{HEADER},{','.join(names)}\n{ROW}{',1' * len(names)}\n"
    began_s = time.process_time()
    lines = lines_of(text)
    assert len(read(lines).accel) == 1
    assert time.process_time() - began_s < 5.0  # it took 35 s, by the square of their number


def rows_of_units(bias_mps2: float, label: str = "I") -> str:
    """Two sensors whose rows take turns, the second with another bias, in poses that follow each other."""
    rng, rows = np.random.default_rng(1), [f"TimeUS,{label},AccX,AccY,AccZ"]
    for k in range(800):
        level = np.roll([0.0, 0.0, 9.81], k // 200) + rng.normal(0.0, 0.05, 3) + (k % 2) * bias_mps2
        rows.append(f"{1_000_000 + 5000 * k},{k % 2},{level[0]:.5f},{level[1]:.5f},{level[2]:.5f}")
    return "\n".join(rows) + "\n"


def test_rows_of_several_sensors_are_told_and_no_other_column_is(tmp_path: Path) -> None:
    path = tmp_path / "two.csv"
    path.write_text(rows_of_units(0.03))
    with pytest.raises(InputError, match=r"several sensors, told apart by the column 'I' \(0, 1\).*--where 'I=0'"):
        list(Lines(path, angles=False))
    path.write_text(rows_of_units(0.0, label="flag"))
    assert sum(len(batch.accel) for batch in Lines(path, angles=False)) == 800
    path.write_text(rows_of_units(0.03))
    assert sum(len(batch.accel) for batch in Lines(path, columns={"I": "-"}, angles=False)) == 800
    for unit in "01":
        lines = Lines(path, units=Units(where=f"I={unit}"), angles=False)
        means = np.concatenate([batch.accel.values for batch in lines]).sum(axis=1)
        assert len(means) == 400 and means.mean() == pytest.approx(9.81 + 0.09 * int(unit), abs=0.02)
    with pytest.raises(InputError, match=r"no row among the first has '7' in column 'I' \(--where\), they have 0, 1\."):
        list(Lines(path, units=Units(where="I=7"), angles=False))
    with pytest.raises(InputError, match=r"has no column 'J' \(--where\)"):
        list(Lines(path, units=Units(where="J=7"), angles=False))


def test_info_proposes_one_of_several_sensors(run, tmp_path: Path) -> None:
    path = tmp_path / "two.csv"
    path.write_text(rows_of_units(0.5))
    said = run.json("info", path, "--gravity", "9.81", "--no-angles")
    assert "--where 'I=0'" in " ".join(said["missing"])
    assert not said["command"], "one pose, which no option makes a calibration of"
