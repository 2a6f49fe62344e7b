"""A copy of a recording with corrected readings: the original byte for byte, and one topic more; lines as they come."""

import io
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.calibrations import simulated
from helpers.paths import ROOT
from helpers.recordings import read, record
from helpers.synthetic import G
from mcap.reader import make_reader
from mcap.records import DataEnd
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

import kf_calib
from kf_calib.bench.raw_input import PLAIN
from kf_calib.bench.streams import Batch, Stream
from kf_calib.exchange.corrected_file import apply_to_file
from kf_calib.exchange.corrected_lines import CorrectedLines, NormAtRest
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.simulation.physics import Ambient

RECORDING = ROOT / "recordings" / "navigation_24.mcap"
TOPIC, RAW = "/accelerometer/calibrated", "/accelerometer"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a calibration, and one that needs the temperature."""
    folder = tmp_path_factory.mktemp("apply")
    run = kf_calib.calibrate(RECORDING)
    kf_calib.save_calibration(run, folder / "cal.json", RECORDING)
    warm = simulated(0, 20, ambient=Ambient(swing_c=10.0, period_s=40.0))
    kf_calib.save_calibration(kf_calib.calibrate(warm, kf_calib.Settings(effects="thermal-bias")), folder / "warm.json")
    return folder


@pytest.fixture(scope="module")
def copied(folder: Path, run: Any) -> tuple[Path, str]:
    """The recording with corrected readings beside its own, and what is said of it."""
    out = folder / "out.mcap"
    code, said, err = run("apply", folder / "cal.json", RECORDING, "-o", out)
    assert code == 0 and err == ""
    return out, said


def messages(path: Path, topic: str) -> list[Any]:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [each.decoded_message for each in reader.iter_decoded_messages([topic])]


def count_of(path: Path, topic: str) -> int:
    """Of the messages that a reader comes by; to decode them takes long."""
    with path.open("rb") as file:
        return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages([topic]))


@pytest.mark.parametrize("begin_ns", [0, 123_456_789])
@pytest.mark.parametrize("norm", [1.0, G])
def test_a_norm_at_rest_counts_from_three_windows_of_half_a_second(folder: Path, norm: float, begin_ns: int) -> None:
    """Readings in g are told once the third window is over; what moves is no window; parts of any length give the
    same."""
    correction = kf_calib.open_calibration(folder / "cal.json").correction()
    values = np.array([0.6, 0.64, 0.48]) * norm + np.random.default_rng(0).normal(size=(400, 3)) * 1e-3 * norm
    values[100:150] += norm * np.sin(np.arange(50.0))[:, None]
    times, told = begin_ns + np.arange(400) * 10_000_000, dict[int, list[int]]()
    for size in (1, 7, 50):
        at_rest = NormAtRest(correction)
        for first in range(0, 400, size):
            at_rest.add(Stream(times[first : first + size], values[first : first + size]))
            if at_rest.misfit(PLAIN, final=False):
                told.setdefault(size, []).append(first + size)
    assert {size: first[0] for size, first in told.items()} == ({1: 201, 7: 203, 50: 250} if norm == 1.0 else {})


@pytest.mark.parametrize(("count", "told"), [(7, False), (8, True)])
def test_a_window_at_rest_has_eight_readings(folder: Path, count: int, told: bool) -> None:
    at_rest = NormAtRest(kf_calib.open_calibration(folder / "cal.json").correction())
    at_rest.add(Stream(np.arange(count) * 50_000_000, np.tile([0.6, 0.64, 0.48], (count, 1))))
    assert bool(at_rest.misfit(PLAIN, final=True)) == told and not at_rest.misfit(PLAIN, final=False)


def test_the_original_stays_byte_for_byte_and_one_topic_comes_to_it(copied: tuple[Path, str]) -> None:
    out, said = copied
    assert TOPIC in said
    with RECORDING.open("rb") as file:
        records, end = StreamReader(file).records, 0
        for record in records:
            if isinstance(record, DataEnd):
                end = file.tell() - 9 - 4  # before the record that ends the data
                break
    assert end > 500_000 and out.read_bytes()[:end] == RECORDING.read_bytes()[:end]
    with RECORDING.open("rb") as one, out.open("rb") as other:
        before, after = (make_reader(each, validate_crcs=True).get_summary() for each in (one, other))
    assert before is not None and after is not None
    counts = {
        summary.channels[k].topic: count
        for summary in (before, after)
        for k, count in summary.statistics.channel_message_counts.items()
    }
    assert {each.topic for each in after.channels.values()} == {each.topic for each in before.channels.values()} | {
        TOPIC
    }
    assert counts[TOPIC] == counts[RAW] == 9827
    assert after.statistics.message_count == before.statistics.message_count + 9827
    assert after.statistics.message_start_time == before.statistics.message_start_time
    for topic in {each.topic for each in before.channels.values()}:
        assert count_of(out, topic) == count_of(RECORDING, topic) > 0


def test_its_messages_are_the_corrected_readings_with_their_covariance(folder: Path, copied: tuple[Path, str]) -> None:
    before, after = (messages(copied[0], topic) for topic in (RAW, TOPIC))
    raw, found = (
        np.array([(v.x, v.y, v.z) for v in (each.linear_acceleration for each in own)]) for own in (before, after)
    )
    correct = kf_calib.open_calibration(folder / "cal.json").correction()
    np.testing.assert_array_equal(found, correct(raw))
    at_rest = np.linalg.norm(found, axis=1) / correct.bench.gravity_mps2 - 1.0
    assert np.median(np.abs(at_rest)) < 1e-5 < np.median(np.abs(np.linalg.norm(raw, axis=1) / 9.81 - 1.0))
    last_raw, last = before[-1], after[-1]
    assert (last.header.stamp.sec, last.header.stamp.nanosec) == (
        last_raw.header.stamp.sec,
        last_raw.header.stamp.nanosec,
    )
    assert last.header.frame_id == "block"
    covariance = np.reshape(last.linear_acceleration_covariance, (3, 3))
    wanted = correct.covariance_of(correct.gravities, noise=True)
    np.testing.assert_allclose(covariance, wanted[np.argmax(np.einsum("nii->n", wanted))])


def test_progress_rises_to_the_whole_one_half_copied_and_one_half_corrected(folder: Path) -> None:
    correction, told = kf_calib.open_calibration(folder / "cal.json").correction(), list[float]()
    apply_to_file(correction, Recording(RECORDING), folder / "told.mcap", told.append)
    assert told == sorted(told) and 0.0 <= told[0] and 0.99 < told[-1] <= 1.0
    assert any(share == pytest.approx(0.5, abs=1e-3) for share in told)


def test_the_copy_is_evaluated_as_the_original_is(copied: tuple[Path, str], run: Any) -> None:
    assert run.parameters("replay", RECORDING) == run.parameters("replay", copied[0], "--accel-topic", RAW)


@pytest.mark.parametrize(
    ("name", "says"),
    [("cut", "was not finished or has lost its end"), ("empty", "is empty"), ("folder", "is the folder of a bag"),
     ("done", "has a topic /accelerometer/calibrated already"), ("none", "does not exist"), ("text", "lines of text")],
)  # fmt: skip
def test_what_cannot_be_copied_is_refused_in_a_sentence_and_nothing_is_left(
    name: str, says: str, folder: Path, run: Any, tmp_path: Path
) -> None:
    path = tmp_path / f"{name}.mcap"
    if name == "cut":
        path.write_bytes(RECORDING.read_bytes()[:400_000])
    elif name == "empty":
        path.write_bytes(b"")
    elif name == "folder":
        path.mkdir()
        (path / "bag_0.mcap").write_bytes(RECORDING.read_bytes())
    elif name == "done":
        assert run("apply", folder / "cal.json", RECORDING, "-o", path)[0] == 0
    elif name == "text":
        path.write_text("time_s,ax_g,ay_g,az_g\n" + "".join(f"{k / 100},0,1,0\n" for k in range(100)))
    assert says in run.refused("apply", folder / "cal.json", path, "-o", tmp_path / "out.mcap")
    assert [each.name for each in tmp_path.iterdir() if each != path] == []


def test_a_recording_without_the_temperature_that_is_needed_is_refused(folder: Path, run: Any, tmp_path: Path) -> None:
    source = simulated(3, 2)
    whole, cold = read(source), tmp_path / "cold.mcap"
    record(cold, Batch(whole.accel, whole.pose), source.bench)
    err = run.refused("apply", folder / "warm.json", cold, "-o", tmp_path / "out.mcap")
    assert "has no temperature, which the calibration needs" in err
    assert not (tmp_path / "out.mcap").exists()


def test_the_output_is_none_of_the_inputs(folder: Path, run: Any) -> None:
    before = (folder / "cal.json").read_bytes()
    for words in ((RECORDING, "-o", RECORDING), (RECORDING, "-o", folder / "cal.json")):
        assert "is read by this very command" in run.refused("apply", folder / "cal.json", *words, "--overwrite")
    assert (folder / "cal.json").read_bytes() == before


def lines_of(folder: Path, text: str, name: str = "cal.json", **columns: str) -> tuple[list[str], list[str]]:
    """The lines that come out, pushed in pieces of seven bytes, and what is said of them."""
    lines = CorrectedLines(kf_calib.open_calibration(folder / name).correction(), columns)
    given = text.encode()
    out = b"".join(lines.push(given[k : k + 7]) for k in range(0, len(given), 7)) + lines.rest()
    return out.decode().splitlines(), lines.warnings


def test_csv_lines_are_corrected_and_all_else_stays(folder: Path) -> None:
    correct = kf_calib.open_calibration(folder / "cal.json").correction()
    text = 'time_s;note;ax_g;ay_g;az_g;outer_deg\n0;"a; b";0;1;0;5\n0.1000;x;0;1.0001;0;\n0.2;x;0;zz;0;\n0.3;;;;;7.50'
    out, said = lines_of(folder, text)
    (sentence,) = said
    assert "1 of 5 lines were malformed and skipped (first line 4: column 'ay_g' is 'zz', which is no" in sentence
    assert out[0] == text.splitlines()[0] and out[-1] == "0.3;;;;;7.50" and len(out) == 4
    assert out[1].startswith('0;"a; b";') and out[1].endswith(";5") and out[2].startswith("0.1000;x;")
    found = np.array([[float(cell) for cell in line.split(";")[-4:-1]] for line in out[1:3]])
    given = np.array([[0, 1, 0], [0, 1.0001, 0]]) * 9.80665
    np.testing.assert_allclose(found * 9.80665, correct(given), rtol=0, atol=1e-11)


def test_json_lines_are_corrected_and_all_else_stays(folder: Path) -> None:
    correct = kf_calib.open_calibration(folder / "cal.json").correction()
    text = [
        '{"bench": {"axes": "y z x"}}',
        '{"time_ns": 1700000000000000001, "acc": [0.0, 9.81, 1e-3], "foo": 1.50}',
        "broken",
        '{"time_s": 3, "raw": {"acc": [1, 2, 3]}, "acc": [1, 0, 0]}',
        '{"time_s": 3.5, "acc": [NaN, 0, 0]}',
        '{"time_s": 4, "angles_deg": [1.0, 2.0, 3.00]}',
    ]
    out, said = lines_of(folder, "\n".join(text), acc="accel_mps2")
    assert said == ["2 of 6 lines were malformed and skipped (first line 3: it is not a JSON object)."]
    assert [out[0], out[3]] == [text[0], text[5]] and len(out) == 4
    assert out[1].startswith('{"time_ns": 1700000000000000001, "acc": [') and out[1].endswith('], "foo": 1.50}')
    found = [json.loads(line)["acc"] for line in out[1:3]]
    np.testing.assert_allclose(found, correct(np.array([[0.0, 9.81, 1e-3], [1.0, 0.0, 0.0]])), rtol=0, atol=1e-12)
    assert json.loads(out[2])["raw"] == {"acc": [1, 2, 3]}


def test_readings_wait_for_no_temperature(folder: Path) -> None:
    text = "time_s,ax_mps2,ay_mps2,az_mps2,temperature_c\n0,0,9.8,0,\n1,0,9.8,0,20\n2,0,9.8,0,\n3,0,9.8,0,30\n"
    out, said = lines_of(folder, text, "warm.json")
    assert said == [
        "1 of 5 lines were malformed and skipped (first line 2: it came before the first temperature, which the "
        "calibration needs)."
    ]
    y = [float(line.split(",")[2]) for line in out[1:]]
    assert y[0] == y[1] != y[2]


@pytest.mark.parametrize(
    ("text", "says"),
    [("", "no readings to correct in 0 lines: check that the logger wrote any"),
     ("a,b\n1,2\n", "no column gives the time"),
     ("time_s,ax_g,ay_g,az_g\n1,2\n", "it has 2 cells, the header has 4"), ("{}\n", "it has no time stamp")],
)  # fmt: skip
def test_standard_input_without_readings_is_refused_in_a_sentence(
    text: str, says: str, folder: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(text.encode())))
    err = run.refused("apply", folder / "cal.json", "-")
    assert err.startswith("kf-calib: standard input: ") and says in err


def test_standard_input_and_a_copy_exclude_each_other(folder: Path, run: Any) -> None:
    for words in (("-", "-o", "x.mcap"), ("-", "--json"), (RECORDING,)):
        err = run.refused("apply", folder / "cal.json", *words)
        assert "leave out" in err or "name it by -o OUT" in err


def test_all_other_bytes_stay_as_they_are(folder: Path) -> None:
    """Ends of lines, bytes that are no UTF-8, quotes and blanks; a line beyond 1 MiB is left out and counted."""
    lines = CorrectedLines(kf_calib.open_calibration(folder / "cal.json").correction())
    head = b"\r\ntime_s, note ,ax_g,ay_g,az_g\r\n"
    rows = [b'%d, "caf\xe9 ""x""" ,0, 1 ,"0"\r\n' % k for k in range(12)]
    long = b"12," + b"x" * (1 << 20) + b",0,1,0\r\n"
    given = head + b"".join(rows[:6]) + long + b"\n" + b"".join(rows[6:])
    out = b"".join(lines.push(given[k : k + 5000]) for k in range(0, len(given), 5000)) + lines.rest()
    assert out.startswith(head) and out.count(b"\r\n") == 2 + 12 and out.count(b"\n") == 2 + 12 + 1
    assert [line.rsplit(b",", 3)[0] for line in out.splitlines()[2:8]] == [row.rsplit(b",", 3)[0] for row in rows[:6]]
    assert lines.readings == 12 and "(first line 9: it is longer than 1 MiB)" in lines.warnings[0]
