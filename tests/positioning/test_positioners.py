"""Positioners over a socket, by commands and by hand; profiles; the lock."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.emulated_table import Table, said

from kf_calib.bench.bench import Bench, axes_of
from kf_calib.errors import InputError
from kf_calib.positioning.opening import open_positioner
from kf_calib.positioning.positioner import Positioner, PositionerError
from kf_calib.positioning.profile import SHIPPED, read_profile
from kf_calib.sources.simulation.driven import Servo

BENCH = Bench(axes_of("yzx"), 9.81)


@pytest.fixture
def table() -> Iterator[Table]:
    with fast_table(Servo(rate_degps=40.0)) as made:
        yield made


def fast_table(servo: Servo) -> Table:
    """Whose time passes twenty times as fast as that of the wall."""
    return Table(servo, tick_s=0.1, pause_s=0.005, sample_hz=50.0)


@pytest.mark.parametrize("name", ["acutrol3000", "lines"])
def test_a_shipped_profile_moves_reads_and_stops_a_table_over_a_socket(name: str, table: Table, tmp_path: Path) -> None:
    pytest.importorskip("pyvisa_py", reason="PyVISA is not there")
    with open_positioner(table.profile(tmp_path, name), BENCH, said) as opened:
        positioner = opened.positioner
        assert isinstance(positioner, Positioner)
        assert positioner.read() == pytest.approx((0.0, 0.0, 0.0), abs=1e-4) and positioner.fault() == ""
        positioner.move_to((30.0, -45.5, 10.25))
        wait_until(lambda: positioner.read() == pytest.approx((30.0, -45.5, 10.25), abs=1e-3))
        positioner.move_to((-170.0, 90.0, 0.0))
        wait_until(lambda: abs(positioner.read()[0]) > 31.0)
        positioner.stop()
        wait_until(lambda: not table.bench.moving)
        stands = positioner.read()
        assert abs(stands[0]) < 170.0
        positioner.move_to(stands)  # and it can be moved again
        assert positioner.fault() == ""


def wait_until(is_so: object, seconds: float = 20.0) -> None:
    until_s = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < until_s, "it does not come"
        time.sleep(0.02)


def test_signs_zeros_and_units_are_those_of_the_profile(table: Table, tmp_path: Path) -> None:
    pytest.importorskip("pyvisa_py", reason="PyVISA is not there")
    path = table.profile(tmp_path, more="signs = [1, -1, 1]\nzeros_deg = [10.0, 0.0, -5.0]")
    with open_positioner(path, BENCH, said) as opened:
        opened.positioner.move_to((20.0, 30.0, 40.0))
        wait_until(lambda: not table.bench.moving and table.bench.read_deg()[0] > 29.0)
        assert table.bench.read_deg() == pytest.approx((30.0, -30.0, 35.0), abs=1e-3)
        assert opened.positioner.read() == pytest.approx((20.0, 30.0, 40.0), abs=1e-3)


def test_a_fault_of_the_drive_is_told_and_a_link_that_is_lost_raises(tmp_path: Path) -> None:
    pytest.importorskip("pyvisa_py", reason="PyVISA is not there")
    with (
        fast_table(Servo(fault="drive")) as table,
        open_positioner(table.profile(tmp_path, "acutrol3000"), BENCH, said) as opened,
    ):
        wait_until(lambda: "overcurrent" in opened.positioner.fault())
    with (
        fast_table(Servo(fault="link", fault_s=1.0)) as table,
        open_positioner(table.profile(tmp_path, "acutrol3000", "timeout_s = 0.3"), BENCH, said) as opened,
        pytest.raises(PositionerError, match="acutrol3000 at TCPIP"),
    ):
        wait_until(lambda: opened.positioner.read() is None)


def test_nobody_at_the_address_is_told_in_a_sentence(tmp_path: Path) -> None:
    pytest.importorskip("pyvisa_py", reason="PyVISA is not there")
    path = tmp_path / "nobody.toml"
    path.write_text((SHIPPED / "lines.toml").read_text().replace("::5025::", "::9::"))
    with pytest.raises(PositionerError, match="nobody at TCPIP"), open_positioner(str(path), BENCH, said) as opened:
        opened.positioner.read()


def test_two_programs_at_one_positioner_are_refused(table: Table, tmp_path: Path) -> None:
    pytest.importorskip("pyvisa_py", reason="PyVISA is not there")
    path = table.profile(tmp_path)
    refusal = pytest.raises(InputError, match="drives the positioner")
    with open_positioner(path, BENCH, said), refusal, open_positioner(path, BENCH, said):
        pass
    with open_positioner(path, BENCH, said):
        pass


ROBOT = """
import json, pathlib, sys
place = pathlib.Path({place!r})
match sys.argv[1:]:
    case ["move", *angles]:
        new = place.with_suffix(".new")
        new.write_text(json.dumps([float(angle) for angle in angles]))
        new.replace(place)
    case ["where"]: print(*json.loads(place.read_text()) if place.exists() else (0, 0, 0))
    case ["stop"]: place.with_suffix(".stopped").touch()
    case ["fault"]: print("none")
    case _: sys.exit("what?")
"""


def test_commands_with_angles_as_arguments_move_a_robot(tmp_path: Path) -> None:
    script, place = tmp_path / "robot.py", tmp_path / "place.json"
    script.write_text(ROBOT.format(place=str(place)))
    path = tmp_path / "robot.toml"
    text = (SHIPPED / "command.toml").read_text().replace("my-robot", f"{sys.executable} {script}")
    path.write_text(text)
    with open_positioner(str(path), BENCH, said) as opened:
        positioner = opened.positioner
        assert positioner.read() == (0.0, 0.0, 0.0) and positioner.fault() == ""
        positioner.move_to((10.0, -20.5, 30.0))
        wait_until(lambda: positioner.read() == (10.0, -20.5, 30.0))
        positioner.stop()
        assert place.with_suffix(".stopped").exists()
    path.write_text(text.replace(" move ", " go "))
    with open_positioner(str(path), BENCH, said) as opened:
        opened.positioner.move_to((0.0, 0.0, 0.0))
        wait_until(lambda: "what?" in opened.positioner.fault())
    path.write_text(text.replace(" where", " wherever"))
    refusal = pytest.raises(PositionerError, match=r"exit code 1: what\?")
    with open_positioner(str(path), BENCH, said) as opened, refusal:
        opened.positioner.read()


def test_by_hand_the_gimbals_stand_where_the_person_says() -> None:
    told = list[str]()
    with open_positioner("hand", BENCH, told.append) as opened:
        positioner = opened.positioner
        positioner.move_to((90.0, 0.0, -45.0))
        assert told == ["turn the gimbals to 90.0, 0.0, -45.0 deg, then press Enter"]
        assert positioner.read() == (0.0, 0.0, 0.0)
        positioner.done()
        assert positioner.read() == (90.0, 0.0, -45.0)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (("kind = ", "kin = "), "kin: it is unknown"),
        (('gimbals = ["outer", "middle", "inner"]', 'gimbals = ["1"]'), "names 1 gimbals, and the bench has 3"),
        (("{axis} {deg:.4f}", "{axle}"), "in braces that is not known"),
        (("address = ", "# "), "lacks the address"),
        (('stop = "STOP"', ""), "lacks stop"),
        (('stop = "STOP"', 'stop = "STOP"\nsigns = [1, 2, 1]'), "signs"),
    ],
)
def test_a_profile_that_cannot_be_used_is_refused_by_name(changed: tuple[str, str], words: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text((SHIPPED / "lines.toml").read_text().replace(*changed))
    with pytest.raises(InputError, match=r"mine\.toml") as refusal:
        read_profile(path, 3)
    assert words in str(refusal.value)


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.toml")), ids=lambda path: path.stem)
def test_a_shipped_profile_is_known_by_its_name(path: Path) -> None:
    assert read_profile(Path(path.stem), 3).name == path.stem
