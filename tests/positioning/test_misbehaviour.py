"""A controller that lies in every way: what is told of it is true, and no table is said to stand that may move."""

import json
import os
import stat
import threading
import time
import tomllib
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.emulated_table import Table, said
from hypothesis import given, settings
from hypothesis import strategies as st
from positioner_emulator import MISBEHAVIOURS

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.design.gimbal_limits import GimbalLimits
from kf_calib.errors import InputError, KfCalibError
from kf_calib.online.session import Session
from kf_calib.online.suggestion import Itinerary
from kf_calib.positioning.command import halt_in_words
from kf_calib.positioning.drive import Drive
from kf_calib.positioning.link import device_of, refuse_address
from kf_calib.positioning.loop import Rules
from kf_calib.positioning.opening import Opened, _locked, open_positioner, programs_of
from kf_calib.positioning.positioner import PositionerError
from kf_calib.positioning.profile import SHIPPED, angles_in, read_profile
from kf_calib.sources.simulation.driven import Servo

pytest.importorskip("pyvisa_py", reason="PyVISA is not there")

BENCH = Bench(axes_of("yzx"), 9.81)


@pytest.fixture
def table() -> Iterator[Table]:
    """Whose time passes as that of the wall."""
    with Table(Servo(rate_degps=10.0)) as made:
        yield made


def opened_at(table: Table, folder: Path, timeout_s: float = 0.4) -> AbstractContextManager[Opened]:
    return open_positioner(table.profile(folder, more=f"timeout_s = {timeout_s}\nstand_s = 0.3\n"), BENCH, said)


@pytest.mark.parametrize(("misbehaviour", "words"), [
    ("endless", "without an end of line|longer than"), ("trickle", "without an end of line"),
    ("slow", "nothing came within 0.4 s"), ("silent", "nothing came"), ("error-text", "'ERR 0' is not an angle"),
    ("escape", "is not an angle"), ("two-numbers", "is not an angle"), ("immense", "'1e999' is not an angle"),
])  # fmt: skip
def test_an_answer_is_the_angle_whole_and_in_time_or_it_is_none(
    misbehaviour: str, words: str, table: Table, tmp_path: Path
) -> None:
    with opened_at(table, tmp_path) as opened:
        assert opened.positioner.read() == (0.0, 0.0, 0.0)
        table.server.misbehaviour, began_s = misbehaviour, time.monotonic()
        with pytest.raises(PositionerError, match=words):
            opened.positioner.read()
        assert time.monotonic() - began_s < 1.0


@pytest.mark.parametrize("misbehaviour", ["late", "chatter"])
def test_what_comes_too_late_or_unasked_answers_no_later_question(
    misbehaviour: str, table: Table, tmp_path: Path
) -> None:
    with opened_at(table, tmp_path) as opened:
        opened.positioner.move_to((0.0, 3.0, -2.0))
        until_s = time.monotonic() + 5.0
        while np.abs(np.array(table.bench.read_deg()) - [0.0, 3.0, -2.0]).max() > 1e-3 and time.monotonic() < until_s:
            time.sleep(0.02)
        table.server.misbehaviour = misbehaviour
        for _ in range(4):
            try:
                assert opened.positioner.read() == pytest.approx((0.0, 3.0, -2.0), abs=1e-3)
            except PositionerError:
                assert misbehaviour == "late"
        assert opened.positioner.read() == pytest.approx((0.0, 3.0, -2.0), abs=1e-3)


def drive_of(opened: Opened, table: Table) -> Drive:
    session = Session.fed(table.bench.run.bench)
    return Drive(
        opened.positioner, session, Itinerary(session.source.bench), Rules(GimbalLimits.of(BENCH), watch=opened.watch)
    )


def halted(table: Table, folder: Path, after_s: float, misbehaviour: str) -> Drive:
    """A drive that is broken off amid a move, with a controller that misbehaves from then on."""
    with opened_at(table, folder) as opened:
        drive = drive_of(opened, table)
        opened.positioner.move_to((170.0, 60.0, -60.0))
        time.sleep(after_s)
        table.server.misbehaviour = misbehaviour
        thread = threading.Thread(target=drive.run)
        thread.start()
        drive.break_off("Ctrl-C was pressed")
        thread.join(30.0)
        assert drive.outcome is not None
        return drive


@pytest.mark.slow
def test_a_table_that_ignores_the_stop_is_said_to_move(table: Table, tmp_path: Path) -> None:
    drive = halted(table, tmp_path, 0.3, "ignores-stop")
    assert drive.outcome is not None and not drive.outcome.stopped
    assert "IT MAY STILL MOVE" in halt_in_words(drive.outcome) and "stands at" not in halt_in_words(drive.outcome)


def test_a_table_that_stops_is_said_to_stand_where_it_does(table: Table, tmp_path: Path) -> None:
    drive = halted(table, tmp_path, 0.3, "")
    assert drive.outcome is not None and drive.outcome.stopped
    assert drive.outcome.stands_at == pytest.approx(table.bench.read_deg(), abs=0.01)


@pytest.mark.parametrize("misbehaviour", ["far", "error-text", "silent"])
def test_where_no_place_can_be_believed_none_is_told(misbehaviour: str, table: Table, tmp_path: Path) -> None:
    drive = halted(table, tmp_path, 0.2, misbehaviour)
    assert drive.outcome is not None and not drive.outcome.stopped
    assert all(abs(angle) < 90.0 for angle in drive.outcome.stands_at)
    assert "IT MAY STILL MOVE" in halt_in_words(drive.outcome) and "100000" not in halt_in_words(drive.outcome)


def test_the_stop_is_said_within_half_a_second_though_answers_take_longer(table: Table, tmp_path: Path) -> None:
    with opened_at(table, tmp_path, timeout_s=5.0) as opened:
        drive = drive_of(opened, table)
        table.server.misbehaviour = "slow"
        thread = threading.Thread(target=drive.run)
        thread.start()
        time.sleep(0.5)
        before, began_s = len(table.server.lines), time.monotonic()
        drive.break_off("Ctrl-C was pressed")
        table.server.misbehaviour = ""
        while not any("STOP" in line for line in table.server.lines[before:]) and time.monotonic() - began_s < 3.0:
            time.sleep(0.01)
        waited_s = time.monotonic() - began_s
        thread.join(20.0)
    assert drive.outcome is not None and drive.outcome.why == "Ctrl-C was pressed"
    assert waited_s < 2.0  # the emulator itself reads the line after its answer of 1.8 s


@pytest.mark.parametrize("answer", ["12.5", " 12.5 ", "outer 12.5", "OUTER: 12.5", "[12.5]", "+1.25e1"])
def test_an_angle_may_have_its_gimbal_before_it(answer: str) -> None:
    assert angles_in(answer, "", ["outer"]) == (12.5,)


def test_all_angles_may_come_at_once_and_stand_in_words() -> None:
    assert angles_in("1.0, -2; 3e0", "", ["a", "b", "c"]) == (1.0, -2.0, 3.0)
    assert angles_in("POS=4.5 deg", "POS={deg} deg", ["a"]) == (4.5,)
    for answer in ("POS=4.5", "4.5 deg", "POS=x deg", "POS=4.5 5 deg"):
        with pytest.raises(PositionerError):
            angles_in(answer, "POS={deg} deg", ["a"])


@pytest.mark.parametrize("address", [
    "ASRLspy:///dev/null?file=/tmp/x::INSTR", "ASRLloop://::INSTR", "ASRLsocket://1.2.3.4:5::INSTR",
    "ASRL/dev/../tmp/x::INSTR", "ASRLhwgrep://.*::INSTR", "TCPIP::1.2.3.4::INSTR\nx", "ASRL alt://x::INSTR",
    "PRLGX-TCPIP::1.2.3.4::1234::INTFC", "", "/dev/ttyUSB0",
])  # fmt: skip
def test_an_address_that_is_no_devices_is_refused(address: str) -> None:
    with pytest.raises(InputError, match="is no address of a controller"):
        refuse_address("profile.toml", address)


@pytest.mark.parametrize("address", [
    "TCPIP::192.168.53.1::9878::SOCKET", "TCPIP0::localhost::5025::SOCKET", "ASRL/dev/ttyUSB0::INSTR", "ASRL3::INSTR",
    "ASRLCOM3::INSTR", "GPIB0::12::INSTR", "USB0::0x1234::0x5678::SN01::INSTR", "TCPIP::table.lab::inst0::INSTR",
])  # fmt: skip
def test_addresses_of_devices_are_taken(address: str) -> None:
    refuse_address("profile.toml", address)


def test_a_file_that_a_profile_names_is_left_as_it_is(tmp_path: Path) -> None:
    kept, profile = tmp_path / "kept.txt", tmp_path / "p.toml"
    kept.write_text("all my work")
    address = f"ASRLspy:///dev/null?file={kept}::INSTR"
    profile.write_text((SHIPPED / "lines.toml").read_text().replace("TCPIP::127.0.0.1::5025::SOCKET", address))
    with pytest.raises(InputError), open_positioner(str(profile), BENCH, said):
        pass
    assert kept.read_text() == "all my work"


@pytest.mark.parametrize("lines", ["fault = 'FAULT?'", "fault = 'FAULT?'\nfault_word = ' '"])
def test_a_profile_that_cannot_tell_a_fault_is_refused(lines: str, tmp_path: Path) -> None:
    text = [line for line in (SHIPPED / "lines.toml").read_text().splitlines() if "fault" not in line]
    path = tmp_path / "p.toml"
    path.write_text("\n".join([*text, lines]))
    with pytest.raises(InputError, match="add no_fault"):
        read_profile(path, 3)


def test_programs_of_a_profile_run_only_where_they_are_trusted(tmp_path: Path, run: Any) -> None:
    """Nobody is there to be asked: the tests have no terminal."""
    made, profile, source = tmp_path / "made", tmp_path / "p.toml", tmp_path / "in.jsonl"
    profile.write_text((SHIPPED / "command.toml").read_text().replace("my-robot where", f"touch {made}"))
    source.write_text('{"bench": {"axes": "y z x", "gravity_mps2": 9.81}}\n')
    assert programs_of(str(profile))[1] == f"touch {made}" and programs_of("command") == []
    assert "add --trust-profile" in run.refused("run", "--positioner", profile, "--source", source)
    assert not made.exists()


def test_one_device_has_one_name(tmp_path: Path) -> None:
    port = tmp_path / "ttyX"
    port.touch()
    (tmp_path / "by-id").symlink_to(port)
    assert device_of("TCPIP::127.0.0.1::5::SOCKET") == device_of("tcpip0::localhost::5::socket")
    assert device_of(f"ASRL{port}::INSTR") == device_of(f"ASRL{tmp_path / 'by-id'}::INSTR")
    assert device_of("GPIB::1::INSTR") != device_of("GPIB1::1::INSTR")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with a name here")
@pytest.mark.parametrize("kind", ["symlink", "fifo"])
def test_a_lock_is_a_plain_file_in_a_folder_of_ones_own(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with _locked("TCPIP::1.2.3.4::5::SOCKET"):
        (lock,) = (tmp_path / "kf_calib").iterdir()
    assert stat.S_IMODE((tmp_path / "kf_calib").stat().st_mode) == 0o700 and stat.S_IMODE(lock.stat().st_mode) == 0o600
    lock.unlink()
    aim = tmp_path / "aim"
    aim.write_text("mine")
    if kind == "symlink":
        lock.symlink_to(aim)
    else:
        os.mkfifo(lock)
    with pytest.raises(InputError, match="remove it"), _locked("TCPIP::1.2.3.4::5::SOCKET"):
        pass
    assert aim.read_text() == "mine"


KEYS = st.sampled_from(
    ["kind", "address", "gimbals", "move", "read", "stop", "fault", "no_fault", "answer", "signs", "unit", "x"]
)
VALUES = st.one_of(
    st.text(max_size=30), st.integers(), st.lists(st.text(max_size=5), max_size=3), st.booleans(), st.floats()
)


@settings(max_examples=150, deadline=None)
@given(st.dictionaries(KEYS, VALUES, max_size=5), st.sampled_from(["lines", "acutrol3000", "command"]))
def test_whatever_a_profile_says_it_is_one_sentence_or_a_profile(
    tmp_path_factory: pytest.TempPathFactory, changes: dict[str, object], name: str
) -> None:
    """Reading it opens nothing, writes nothing and runs nothing."""
    content = tomllib.loads((SHIPPED / f"{name}.toml").read_text()) | changes
    folder = tmp_path_factory.mktemp("profile")
    path = folder / "p.toml"
    path.write_text(
        "\n".join(f"{key} = {_toml(value)}" for key, value in content.items()), encoding="utf-8", errors="replace"
    )
    try:
        read_profile(path, 3)
    except KfCalibError as error:
        assert str(error) and "Traceback" not in str(error)
    assert [each.name for each in folder.iterdir()] == ["p.toml"]


def _toml(value: object) -> str:
    """A value as TOML, strings as escaped as JSON has them."""
    return json.dumps(value) if not isinstance(value, float) else repr(value)


def test_every_misbehaviour_is_played() -> None:
    played = Path(__file__).read_text()
    assert all(f'"{name}"' in played for name in MISBEHAVIOURS if name and name != "one-late")
