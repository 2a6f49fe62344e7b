"""The date of a run: as stated, by its stamps, or by the computer that received them; never that of its evaluation."""

import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from helpers.calibrations import simulated
from helpers.links import Given
from helpers.paths import RECORDINGS
from helpers.recordings import START_NS, made_batch, read, record

import kf_calib
from kf_calib.bench.bench import Bench
from kf_calib.errors import BenchError
from kf_calib.exchange import calibration_file
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.live import LiveSource
from kf_calib.sources.opening import run_date

SINCE_START_NS = 5_000_000_000


def recorded(path: Path, start_ns: int, patient: bool = False) -> LiveSource:
    """A run that was received live and recorded."""
    with LiveSource(Given(made_batch(50, start_ns), made_batch(50, start_ns + 10**9), patient=patient), path) as source:
        read(source)
    return source


def test_stamps_that_are_dates_tell_it(tmp_path: Path) -> None:
    source = recorded(tmp_path / "a.mcap", START_NS)
    stamped = datetime.fromtimestamp(START_NS / 1e9, UTC)
    assert run_date(source) == run_date(Recording(tmp_path / "a.mcap")) == stamped
    assert source.received is None


def test_stamps_since_the_start_of_a_board_are_dated_by_the_computer_that_received_them(tmp_path: Path) -> None:
    before = datetime.now(UTC)
    source = recorded(tmp_path / "a.mcap", SINCE_START_NS)
    live, replayed = run_date(source), run_date(Recording(tmp_path / "a.mcap"))
    assert live is not None and before <= live <= datetime.now(UTC)
    assert replayed is not None and abs(replayed - live) < timedelta(milliseconds=1)
    time.sleep(0.002)
    assert run_date(Recording(tmp_path / "a.mcap")) == replayed  # whenever it is evaluated


def test_what_was_written_beforehand_was_not_received_now(tmp_path: Path) -> None:
    source = recorded(tmp_path / "a.mcap", SINCE_START_NS, patient=True)
    assert run_date(source) is None and run_date(Recording(tmp_path / "a.mcap")) is None


def test_a_stated_date_goes_before_all_others(tmp_path: Path) -> None:
    record(tmp_path / "a.mcap", made_batch(20))
    stated = Recording(tmp_path / "a.mcap", {"date": "2021-03-04T05:06+01:00"})
    assert run_date(stated) == datetime(2021, 3, 4, 4, 6, tzinfo=UTC)
    assert Bench.from_metadata(stated.bench.to_metadata()) == stated.bench
    assert run_date(Recording(tmp_path / "a.mcap", {"date": "2021-03-04"})) == datetime(2021, 3, 4, tzinfo=UTC)


@pytest.mark.parametrize("text", ["yesterday", "2021-02-30", "", "0001-01-01T00:00+05:00", "2021-03-04\x1b"])
def test_what_is_no_date_is_refused(text: str) -> None:
    keys = {"axes": "y z x", "gravity_mps2": "9.81", "date": text}
    with pytest.raises(BenchError, match=r"bench key date is .*2024-05-31T14:05"):
        Bench.from_metadata(keys)


def test_a_calibration_carries_the_date_of_its_run(run, tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text("date = 2023-07-08\n")
    for options, date in (
        ((), "2025-06-15T15:06"),
        (("--date", "2022-01-02T03:04"), "2022-01-02T03:04:00.000+00:00"),
        (("--bench", tmp_path / "bench.toml"), "2023-07-08T00:00:00.000+00:00"),
    ):
        words = ("replay", RECORDINGS / "mems_faces.mcap", *options, "--save", tmp_path / "cal.json", "--overwrite")
        assert run(*words)[0] == 0
        began = calibration_file.open_calibration(tmp_path / "cal.json").conditions.began
        assert began is not None and began.startswith(date)
    assert calibration_file.of_source(kf_calib.calibrate(simulated(0)), simulated(0)).conditions.began is None
