"""The keys of every command's JSON are those of docs/json.md: none is missing there, none is made up."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

import kf_calib

ROOT = Path(__file__).resolve().parents[1]
SECTIONS = re.split(r"^## (.+)\n", (ROOT / "docs" / "json.md").read_text(), flags=re.MULTILINE)[1:]
DOCUMENTED = dict(zip(SECTIONS[::2], SECTIONS[1::2], strict=True))
HIDDEN = ROOT / "recordings" / "hidden.mcap"
QUICK = ("--orientations", 6, "--dwell-s", 4, "--slew-degps", 360, "--sample-hz", 20)
CSV = "time_s,ax_g,ay_g,az_g,outer_deg,middle_deg,inner_deg\n0,0,1,0,0,0,0\n1,0,1,0,0,0,0\n"
COMMANDS: dict[str, tuple[object, ...]] = {
    "replay": (HIDDEN,),
    "compare": (HIDDEN.with_name("mems_faces.mcap"),),
    "diagnose": (HIDDEN,),
    "improve": (HIDDEN, "--unattended"),
    "fleet": (HIDDEN, HIDDEN.with_name("mems_faces.mcap"), "lines.csv", "-o", "table", "--workers", 1),
    "report": (HIDDEN, "--against", HIDDEN.with_name("navigation_24.mcap")),
    "certificate": ("cal.json", "-o", "certificate.pdf"),
    "live": ("sim://?speed=500&orientations=6&dwell_s=4&slew_degps=360&sample_hz=20",),
    "run": ("--positioner", "sim://?sample_hz=20&seed=4", "--target", "K=20ppm"),
    "live --no-angles": ("sim://?speed=500&orientations=14&dwell_s=4&slew_degps=360&sample_hz=20",),
    "simulate": ("made.mcap", *QUICK),
    "record": ("recorded.mcap", "lines.csv", "--axes", "y z x", "--gravity", "9.81"),
    "export": ("cal.json", "--to", "px4", "-o", "px4.params", "--lossy"),
    "effects": (),
    "info": (HIDDEN,),
    "noise": (HIDDEN,),
    "plan": ("--count", 4),
    "paper": ("--repetitions", 2),
    "apply": ("cal.json", HIDDEN, "-o", "corrected.mcap"),
    "verify": ("cal.json", HIDDEN),
    "history": ("cal.json", "later.json", "--tolerance", "K=20ppm"),
}
NEEDED = {"certificate": "typst", "fleet": "distributed"}
"""Packages that a command needs and the machine may not have."""


def test_every_command_that_prints_json_is_in_the_page() -> None:
    assert DOCUMENTED.keys() == COMMANDS.keys()


@pytest.mark.usefixtures("undrawn", "unmeasured")
@pytest.mark.parametrize("command", COMMANDS)
def test_keys_are_those_of_the_page(command: str, run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lines.csv").write_text(CSV)
    if "cal.json" in COMMANDS[command]:
        save_calibrations()
    if command in NEEDED:
        pytest.importorskip(NEEDED[command], reason=f"{NEEDED[command]} is not there")
    code, out, err = run(*command.split(), *COMMANDS[command], "--json")
    assert code == 0, err
    printed = json.loads(out.splitlines()[-1])
    documented = documented_keys(command)
    missing = {key for key in documented if not _is_there(printed, key)}
    assert missing == set()
    if command == "live --no-angles":
        documented |= documented_keys("replay")
    if command == "run":
        documented |= documented_keys("live")
    if command in ("live", "run"):
        documented |= documented_keys("replay") | documented_keys("diagnose")
    assert set(printed) - {re.split(r"[.\[]", key)[0] for key in documented} == set()


def save_calibrations() -> None:
    """The same calibration of two dates."""
    kf_calib.save_calibration(kf_calib.calibrate(HIDDEN), "cal.json", HIDDEN)
    content = json.loads(Path("cal.json").read_text())
    content["conditions"]["began"] = "2026-01-01T00:00:00+00:00"
    Path("later.json").write_text(json.dumps(content))


def documented_keys(command: str) -> set[str]:
    """What the first column of a command's table names."""
    rows = re.findall(r"^\| (`[^|]*`) \|", DOCUMENTED[command], flags=re.MULTILINE)
    return {key for row in rows for key in re.findall(r"`([^`]+)`", row)}


def _is_there(value: Any, key: str) -> bool:
    """Whether an object has the key ``a.b``, or ``a[].b`` in an object of the list; the inner object may be null."""
    head, _, rest = key.partition(".")
    if not isinstance(value, dict) or head.removesuffix("[]") not in value:
        return False
    inner = value[head.removesuffix("[]")]
    if not rest or inner is None:
        return True
    return any(_is_there(each, rest) for each in inner) if head.endswith("[]") else _is_there(inner, rest)
