"""From what a device sends to corrected readings: three devices, every way in and every way out."""

import csv
import io
import itertools
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import openpyxl
import pytest
from exports.test_c_header import compiled_only, compiled_together
from exports.test_exports import READERS, ROUNDING
from helpers.altered import short_run
from helpers.long_runs import slow
from helpers.recordings import record
from helpers.stated_sensors import correction, samples, saved
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import kf_calib
from kf_calib.bench.bench import Bench
from kf_calib.bench.raw_input import UNITS, RawInput, merged_metadata
from kf_calib.bench.streams import Batch, Stream
from kf_calib.errors import BenchError
from kf_calib.exports import exported

ORDERS = [
    tuple(sign * place for sign, place in zip(signs, places, strict=True))
    for places in itertools.permutations((1, 2, 3))
    for signs in itertools.product((1, -1), repeat=3)
]
SCALES = [1e-9, 2.5e-7, 3.9e-6, 1 / 16384, 1e-3, 0.061, 1.0, 1.7, 42.0, 1e5]
WIRINGS = {"in turn": list(zip(ORDERS, itertools.cycle(SCALES), strict=False)),
           "every": list(itertools.product(ORDERS, SCALES))}  # fmt: skip
"""All 48 orders of channels with the ten sizes in turn, and all 480 pairs of them."""


def devices() -> Iterator[tuple[str, RawInput]]:
    """Counts of a data acquisition, with one channel reversed and two swapped; readings in g; readings in m/s^2."""
    yield "counts", RawInput((2, -1, 3), (3.9e-6, 3.9e-6, 3.9e-6), "g")
    yield "g", RawInput((1, -2, 3), unit="g")
    yield "m/s2", RawInput((3, 1, 2))


@pytest.mark.parametrize("channels", ORDERS, ids=str)
def test_a_raw_input_is_its_matrix_and_can_be_undone(channels: Any) -> None:
    raw = np.random.default_rng(1).normal(size=(50, 3)) * 1e4
    for scale, unit in itertools.product(SCALES, UNITS):
        own = RawInput(channels, (scale, scale, scale), unit)
        readings = own.readings(raw)
        np.testing.assert_allclose(readings, raw @ own.matrix.T, rtol=1e-14)
        np.testing.assert_allclose(own.raw(readings), raw, rtol=1e-14)
        for i, channel in enumerate(channels):  # as it is said: accelerometer i is channel |channels_i|
            expected = np.sign(channel) * raw[:, abs(channel) - 1] * scale * UNITS[unit]
            np.testing.assert_allclose(readings[:, i], expected, rtol=1e-14)
        assert RawInput.from_metadata(own.to_metadata()) == own


@pytest.mark.parametrize("wirings", ["in turn", *slow("every")])
@pytest.mark.parametrize("to", READERS)
def test_every_program_takes_raw_readings_of_any_wiring_and_size(to: str, wirings: str) -> None:
    """By the formula of the program; one that has no room for it takes readings in m/s^2, and says what to do."""
    own = correction(
        turned=0.0 if to in ("px4", "ardupilot") else 1e-2, bias=0.0 if to in ("kalibr", "openvins") else 0.05
    )
    content = saved()
    own = content.correction() if to == "csv" else own
    force, temperature = samples(200)
    readings = own.predicted(force, temperature)
    for channels, scale in WIRINGS[wirings]:
        made = RawInput(channels, (scale, scale, scale), "g")
        wired = replace(own, bench=replace(own.bench, input=made))
        target = exported(content, wired, to, lossy=True)
        given, in_order = made.raw(readings), tuple(map(abs, channels)) == (1, 2, 3)
        assert target.folds == (to not in ("px4", "ardupilot") and (to != "imu_tk" or in_order))
        if not target.folds:
            assert target.to_be_done_before
            given = _done_before(target.to_be_done_before, given)
        found = READERS[to](target.text())(given, temperature)
        close = 2.0 * ROUNDING.get(to, 1e-12 if target.folds else 1e-10)  # 32 bits; digits of the sentence
        np.testing.assert_allclose(found, force, rtol=0, atol=close)
        if to not in ("imu_tk", "vectornav"):
            assert str(target.input) in target.text().replace("\\u00b2", "2") or to == "csv"


def _done_before(said: str, raw: np.ndarray) -> np.ndarray:
    """Readings made of raw ones as the sentence says: x = 3.8e-05 channel2, y = ..."""
    terms = re.findall(r"[xyz] = (\S+) channel([123])", said)
    return np.column_stack([float(size) * raw[:, int(channel) - 1] for size, channel in terms])


@compiled_only
@pytest.mark.parametrize(
    ("names", "wirings"), [((), "in turn"), *slow((("second-order", "thermal-bias"), "in turn"), ((), "every"))]
)
def test_the_function_in_c_takes_raw_readings_of_any_wiring(
    names: tuple[str, ...], wirings: str, tmp_path: Path
) -> None:
    """Compiled into one library."""
    own = correction(*names)
    force, temperature = samples(100)
    readings = own.predicted(force, temperature)
    devices = [RawInput(order, (size, size, size), "mg") for order, size in WIRINGS[wirings]]
    wired = [replace(own, bench=replace(own.bench, input=made)) for made in devices]
    texts = [exported(saved(), each, "c").text() for each in wired]
    for made, by_python, text, in_c in zip(devices, wired, texts, compiled_together(texts, tmp_path), strict=True):
        assert f"// It takes {made}." in text
        raw = made.raw(readings)
        np.testing.assert_allclose(in_c(raw, temperature), force, rtol=0, atol=1e-11, err_msg=str(made))
        np.testing.assert_allclose(by_python(raw, temperature), force, rtol=0, atol=1e-11)


@dataclass(frozen=True)
class Taken:
    """A device on the bench: what it sends in a run (time, raw, angles), and the calibration made of it."""

    input: RawInput
    time_ns: np.ndarray
    raw: np.ndarray
    pose: Stream
    force: np.ndarray
    calibration: Path
    options: tuple[str, ...]

    def rows(self, header: str) -> str:
        """CSV lines of all readings, with the last angles before each."""
        at = np.clip(np.searchsorted(self.pose.time_ns, self.time_ns, side="right") - 1, 0, None)
        angles = np.degrees(self.pose.values[at])
        lines = [
            ",".join([str(int(stamp)), *(repr(each) for each in [*own.tolist(), *turn.tolist()])])
            for stamp, own, turn in zip(self.time_ns, self.raw, angles, strict=True)
        ]
        return "\n".join([f"time_ns,{header},outer_deg,middle_deg,inner_deg", *lines, ""])


COUNTS, IN_G, IN_MPS2 = devices()


@pytest.fixture(
    scope="module", params=[COUNTS, IN_G, pytest.param(IN_MPS2, marks=pytest.mark.slow)], ids=lambda param: param[0]
)
def device(request: Any, tmp_path_factory: pytest.TempPathFactory, run: Any) -> Taken:
    """Recorded from lines, with what it sends stated once, and calibrated with no further word."""
    name, own = request.param
    folder = tmp_path_factory.mktemp(name.replace("/", "_"))
    source = short_run(count=16, dwell_s=2.0, sample_hz=50.0, seed=4)
    batches = list(source)
    accel = Stream.joined([batch.accel for batch in batches])
    raw = own.raw(accel.values)
    raw = np.rint(raw).astype(np.int32) if own.sizes != RawInput().sizes else raw
    options = ["--channels", own.order]
    if own.sizes != RawInput().sizes:
        options += ["--accel-scale", own.scale, "--accel-unit", own.unit]
    pose = Stream.joined([batch.pose for batch in batches])
    taken = Taken(own, accel.time_ns, raw, pose, accel.values, folder / "cal.json", tuple(options))
    header = {"counts": "ax,ay,az", "g": "ax_g,ay_g,az_g", "m/s2": "ax_mps2,ay_mps2,az_mps2"}[name]
    (folder / "lines.csv").write_text(taken.rows(header))
    words = ("record", folder / "run.mcap", folder / "lines.csv", "--axes", "y z x", "--gravity", "9.81", *options)
    code, _, err = run(*words)
    assert code == 0, err
    code, said, err = run("replay", folder / "run.mcap", "--save", taken.calibration)
    assert code == 0, err
    assert str(own) in said  # printed, so that a wrong word is seen
    return taken


def without_keys(path: Path, accel: Stream) -> Path:
    """Readings as a driver records them, which says nothing of the bench."""
    return record(path, Batch(accel, Stream.empty(4)), Bench((), 9.81, angles=False))


def forces_in_csv(text: str) -> np.ndarray:
    """Specific force in m/s^2 from lines with the unit in their header."""
    rows = list(csv.DictReader(text.splitlines()))
    unit = next(name.partition("_")[2] for name in rows[0] if name.startswith("ax"))
    factor = {"mps2": 1.0, "g": 9.80665}[unit]
    return factor * np.array([[float(row[f"a{axis}_{unit}"]) for axis in "xyz"] for row in rows])


def test_every_way_in_gives_the_same_specific_force(
    device: Taken, run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """CSV, JSON lines, MCAP as it came and as it was recorded, standard input, Excel, Python: nothing is said again."""
    correct = kf_calib.open_calibration(device.calibration).correction()
    assert correct.input == device.input
    expected = correct(device.raw)
    last = np.linalg.norm(expected[-20:], axis=1)  # the run ends at rest
    np.testing.assert_allclose(last, 9.81, rtol=5e-5)
    count_mps2 = float(device.input.factors.max()) if device.raw.dtype == np.int32 else 1e-9
    np.testing.assert_allclose(expected, correct.of_readings(device.force), rtol=0, atol=2.0 * count_mps2)
    folder, cal, close = device.calibration.parent, device.calibration, dict(rtol=0, atol=1e-11)

    lines = folder / "lines.csv"
    assert run("apply", cal, lines, "-o", tmp_path / "lines.csv")[0] == 0
    text = (tmp_path / "lines.csv").read_text()
    np.testing.assert_allclose(forces_in_csv(text), expected, **close)
    assert [line.split(",")[0] for line in text.splitlines()] == [
        line.split(",")[0] for line in lines.read_text().splitlines()
    ]

    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(lines.read_bytes())))
    assert run("apply", cal, "-")[1] == text

    key = {"g": "accel_g", "m/s2": "accel_mps2"}[device.input.unit]
    pairs = zip(device.time_ns.tolist(), device.raw.tolist(), strict=True)
    objects = [json.dumps({"time_ns": time_ns, key: own}) for time_ns, own in pairs]
    (tmp_path / "in.jsonl").write_text("\n".join(objects))
    assert run("apply", cal, tmp_path / "in.jsonl", "-o", tmp_path / "out.jsonl")[0] == 0
    found = np.array([json.loads(line)[key] for line in (tmp_path / "out.jsonl").read_text().splitlines()])
    np.testing.assert_allclose(found * UNITS[device.input.unit], expected, **close)

    without_keys(tmp_path / "raw.mcap", Stream(device.time_ns, device.raw.astype(float)))
    for recording in (tmp_path / "raw.mcap", folder / "run.mcap"):
        out = tmp_path / f"out_{recording.name}"
        code, _, err = run("apply", cal, recording, "-o", out)
        assert code == 0, err
        with out.open("rb") as file:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            every = reader.iter_decoded_messages(["/accelerometer/calibrated"])
            found = np.array([[v.x, v.y, v.z] for v in (each.decoded_message.linear_acceleration for each in every)])
        np.testing.assert_allclose(found, expected, **close)

    book = openpyxl.Workbook()
    sheet: Any = book.active
    sheet.append(["when", "time_s", "ax", "ay", "az"])
    chosen = range(0, len(device.raw), 40)
    for k in chosen:
        sheet.append([f"row {k}", 60.0 * k, *(float(each) for each in device.raw[k])])
    book.save(tmp_path / "means.xlsx")
    code, _, err = run("apply", cal, tmp_path / "means.xlsx", "-o", tmp_path / "out.xlsx")
    assert code == 0, err
    rows = list(openpyxl.load_workbook(tmp_path / "out.xlsx").active.values)  # type: ignore[union-attr]
    assert rows[0] == ("when", "time_s", "ax_mps2", "ay_mps2", "az_mps2") and rows[2][0] == "row 40"
    np.testing.assert_allclose([row[2:] for row in rows[1:]], expected[list(chosen)], **close)


def test_the_recording_holds_readings_and_says_what_they_were_made_of(device: Taken, run: Any) -> None:
    path = device.calibration.parent / "run.mcap"
    recording = kf_calib.open_recording(path)
    assert recording.bench.input == device.input
    held = Stream.joined([batch.accel for batch in recording])
    np.testing.assert_allclose(held.values, device.input.readings(device.raw), rtol=1e-13)
    _, said, _ = run("info", path)
    assert f"channels = {device.input.order}" in said and "converted = true" in said


def test_an_option_that_contradicts_what_is_stored_is_refused(device: Taken, run: Any, tmp_path: Path) -> None:
    cal, folder = device.calibration, device.calibration.parent
    for words in (("replay", folder / "run.mcap"), ("apply", cal, folder / "run.mcap", "-o", tmp_path / "o.mcap"),
                  ("apply", cal, folder / "lines.csv", "-o", tmp_path / "o.csv"),
                  ("verify", cal, folder / "run.mcap")):  # fmt: skip
        err = run.refused(*words, "--channels", "1,2,-3")
        assert f"1,2,-3, and the {'calibration' if 'lines' in str(words) else 'recording'}" in err
        assert f"states {device.input.order}" in err and "--restate-input" in err
    assert run("replay", folder / "run.mcap", *device.options)[0] == 0  # to repeat it does no harm


def test_what_was_stated_wrongly_can_be_restated(device: Taken, run: Any, tmp_path: Path) -> None:
    wrong = ["--channels", "1,2,3", *device.options[2:]]
    folder = device.calibration.parent
    words = ("record", tmp_path / "wrong.mcap", folder / "lines.csv", "--axes", "y z x", "--gravity", "9.81", *wrong)
    assert run(*words)[0] == 0
    assert f"--channels {device.input.order}" in run.refused("replay", tmp_path / "wrong.mcap")
    found = run.parameters("replay", tmp_path / "wrong.mcap", "--channels", device.input.order, "--restate-input")
    for symbol, expected in run.parameters("replay", folder / "run.mcap").items():
        assert found[symbol]["value"] == pytest.approx(expected["value"], rel=1e-9, abs=1e-10)


def test_readings_of_another_unit_are_refused_with_the_likely_cause(device: Taken, run: Any, tmp_path: Path) -> None:
    factor = 1e3 if device.input.sizes == RawInput().sizes else 1e-3
    other, out = without_keys(tmp_path / "other.mcap", Stream(device.time_ns, factor * device.raw)), tmp_path / "o.mcap"
    err = run.refused("apply", device.calibration, other, "-o", out)
    assert "have a norm of" in err and "--accel-" in err and not out.exists()
    assert run("apply", device.calibration, other, "-o", out, "--unchecked")[0] == 0


@pytest.mark.parametrize("sent", [RawInput(), RawInput(unit="g"), RawInput((2, -1, 3), (1e-4,) * 3)], ids=str)
def test_another_order_of_channels_shows_in_the_norm_at_rest(sent: RawInput, run: Any, tmp_path: Path) -> None:
    """What it says then does it; what is stated is restated only where something states it."""
    source = short_run(count=16, dwell_s=2.0, seed=4, grade="mems")
    readings = Stream.joined([batch.accel for batch in source])
    pose = Stream.joined([batch.pose for batch in source])
    raw = Stream(readings.time_ns, sent.raw(readings.values))
    record(tmp_path / "run.mcap", Batch(raw, pose), source.bench)
    stated = [] if sent.is_plain else ["--channels", sent.order, "--accel-scale", sent.scale, "--accel-unit", sent.unit]
    code, _, err = run("replay", tmp_path / "run.mcap", *stated, "--save", tmp_path / "cal.json")
    assert code == 0, err
    orders = ((True, (1, -2, 3)), (True, (2, 1, 3)), (False, sent.channels))
    for refused, channels in orders:
        path, copy = tmp_path / f"{channels}.mcap", tmp_path / f"o{channels}.mcap"
        without_keys(path, Stream(readings.time_ns, replace(sent, channels=channels).raw(readings.values)))
        code, _, err = run("apply", tmp_path / "cal.json", path, "-o", copy)
        assert code == (2 if refused else 0), err
        if refused:
            advice = re.search(r"with (--channels \S+( --restate-input)?): add that", err)
            assert advice and f"--channels {RawInput(channels).order}" in err
            assert bool(advice[2]) == (not sent.is_plain)
            code, _, err = run("apply", tmp_path / "cal.json", path, "-o", copy, *advice[1].split())
            assert code == 0, err
            if advice[2]:
                assert run("apply", tmp_path / "cal.json", path, "-o", copy, *advice[1].split()[:2])[0] == 2


def test_what_a_later_statement_may_say() -> None:
    stated = RawInput((1, -2, 3), (3.9e-6,) * 3, "g").to_metadata()
    assert merged_metadata(stated, {"accel_scale": "0.0000039", "accel_unit": "g"}, "it")["accel_scale"] == "0.0000039"
    with pytest.raises(BenchError, match=r"--accel-unit is m/s2, and it states g"):
        merged_metadata(stated, {"accel_unit": "m/s2"}, "it")
    assert merged_metadata(stated, {"accel_unit": "m/s2", "restate_input": "true"}, "it")["accel_unit"] == "m/s2"
    assert merged_metadata({}, {"axes": "y"}, "it", RawInput.from_metadata(stated))["channels"] == "1,-2,3"
    with pytest.raises(BenchError, match="and the calibration states 1,-2,3"):
        merged_metadata({}, {"channels": "1,2,3"}, "it", RawInput.from_metadata(stated))
