"""The command line as a user meets it: keys, exit codes, one sentence on stderr."""

import json
import re
from dataclasses import is_dataclass
from pathlib import Path
from typing import get_type_hints

import click
import numpy as np
import pytest
from click.testing import CliRunner
from helpers.recordings import read, record

from kf_calib.bench.streams import Batch, Stream
from kf_calib.cli import cli
from kf_calib.cli.command import grouped
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.simulation.settings import Ambient, SimulationOptions

PARAMETERS = ["theta1", "phi1", "K1", "b1", "nu1", "nu2", "K2", "b2", "theta3", "phi3", "K3", "b3"]
QUICK = ["--orientations", "12", "--dwell-s", "6", "--slew-degps", "360", "--sample-hz", "50"]


@pytest.fixture(scope="module")
def recording(run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "run.mcap"
    assert run("simulate", path, *QUICK, "--seed", "3")[0] == 0
    return path


def changed(recording: Path, path: Path, accel=lambda stream: stream, pose=lambda stream: stream) -> Path:
    source = Recording(recording)
    whole = read(source)
    return record(path, Batch(accel(whole.accel), pose(whole.pose), whole.temperature), source.bench)


def test_replay_prints_the_agreed_keys(run, recording: Path) -> None:
    result = run.json("replay", recording)
    assert [p["symbol"] for p in result["parameters"]] == PARAMETERS
    assert [p["unit"] for p in result["parameters"]] == ["rad", "rad", "1", "m/s^2"] * 3
    assert result["dwells"] == 12 and result["model"] == []
    assert len(result["noise"]["sigma_mps2"]) == len(result["noise"]["dwell_sigma_mps2"]) == 3
    assert result["consistency"]["consistent"] is True and 0 < result["consistency"]["p_value"] <= 1
    for key in ("samples", "residual_rms_mps2", "held_out_rms_mps2", "held_out_floor_mps2", "warnings"):
        assert key in result
    truth = json.loads(recording.with_suffix(".truth.json").read_text())["parameters"]
    ratios = [(p["value"] - truth[p["symbol"]]) / p["sigma"] for p in result["parameters"]]
    assert np.abs(ratios).max() < 4.5


def test_options_of_the_library_have_the_defaults_of_the_command_line() -> None:
    context = click.Context(cli)
    simulated = SimulationOptions(ambient=Ambient(period_s=3600.0))
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        assert command is not None and command.callback is not None
        asked = command.make_context(name, [], resilient_parsing=True).params
        for kind in filter(is_dataclass, get_type_hints(command.callback).values()):
            assert grouped(kind, asked) == (simulated if kind is SimulationOptions else kind()), name


def test_people_read_units_of_the_field_or_si_and_programs_si(run, recording: Path) -> None:
    bias = run.parameters("replay", recording)["b1"]
    field, si = run("replay", recording)[1], run("replay", recording, "--units", "si")[1]
    for text, unit, size in ((field, "µg", 9.80665e-6), (si, "m/s^2", 1.0)):
        (row,) = re.findall(rf"│ b1 +│ +(\S+) {re.escape(unit)} +│ +(\S+) │ ± (\S+) │ {re.escape(unit)} ", text)
        value, deviation, sigma = (float(figure) * size for figure in row)
        assert [value, deviation] == pytest.approx([bias["value"]] * 2, abs=0.05 * bias["sigma"])
        assert sigma == pytest.approx(bias["sigma"], rel=0.05)
    assert "m/s^2" not in field
    assert not any(word in si for word in ("µg", "arcsec", "ppm", " deg"))
    assert run("replay", recording, "--units", "si", "--json")[1] == run("replay", recording, "--json")[1]
    assert run("replay", recording)[1] == field


def test_truth_is_not_in_the_recording(recording: Path) -> None:
    content = recording.read_bytes()
    assert b"truth" not in content and b"grade" not in content and b"seed" not in content


def test_a_folder_and_angles_in_degrees_give_the_same(run, recording: Path, tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    changed(recording, tmp_path / "bag" / "bag_0.mcap")
    degrees = changed(recording, tmp_path / "deg.mcap", pose=lambda s: Stream(s.time_ns, np.degrees(s.values)))
    assert run.json("replay", recording) == run.json("replay", tmp_path / "bag")
    assert_alike(run.parameters("replay", recording), run.parameters("replay", degrees, "--angle-unit", "deg"), 1e-6)


def assert_alike(found: dict[str, dict], others: dict[str, dict], sigmas: float) -> None:
    """Values differ by so many of their sigmas at most."""
    for symbol, one in found.items():
        assert abs(one["value"] - others[symbol]["value"]) < sigmas * one["sigma"]


def test_engines_give_one_answer(run, recording: Path) -> None:
    block, reference = (run.parameters("replay", recording, "--engine", name) for name in ("block", "filterpy"))
    assert_alike(block, reference, 1e-6)
    for symbol, one in block.items():
        assert one["sigma"] == pytest.approx(reference[symbol]["sigma"], rel=1e-8)


@pytest.mark.slow
def test_compare_prints_the_agreed_keys(run, recording: Path) -> None:
    result = run.json("compare", recording)
    assert result["max_difference_sigma"] <= 1e-6
    assert set(result["engines"]) == {"block", "filterpy", "batch"}
    assert all(way["wall_s"] > 0 and way["peak_mb"] > 0 for way in result["engines"].values())


def test_strict_exits_with_one_on_a_misfit(run, recording: Path, tmp_path: Path) -> None:
    bent = changed(recording, tmp_path / "bent.mcap", lambda s: Stream(s.time_ns, s.values + 1e-5 * s.values**2))
    assert run("replay", bent)[0] == 0
    code, out, _ = run("replay", bent, "--strict", "--json")
    assert code == 1 and json.loads(out)["consistency"]["consistent"] is False


def test_lines_round_trip(run, recording: Path, tmp_path: Path) -> None:
    """A bench's logger writes CSV; recording it gives the same calibration."""
    table = tmp_path / "lines.csv"
    source = Recording(recording)
    with table.open("w") as file:
        file.write("time_ns,acc x [mg],acc y [mg],acc z [mg],outer_deg,middle_deg,inner_deg\n")
        for batch in source:
            rows: dict[int, list[str]] = {}
            for stamp, values in zip(batch.accel.time_ns.tolist(), batch.accel.values / 9.80665e-3, strict=True):
                rows.setdefault(stamp, [""] * 6)[:3] = [repr(float(value)) for value in values]
            for stamp, values in zip(batch.pose.time_ns.tolist(), np.degrees(batch.pose.values), strict=True):
                rows.setdefault(stamp, [""] * 6)[3:] = [repr(float(value)) for value in values]
            file.writelines(f"{stamp},{','.join(cells)}\n" for stamp, cells in sorted(rows.items()))
    columns = [word for axis in "xyz" for word in ("--column", f"acc {axis} [mg]=a{axis}_mg")]
    out = tmp_path / "again.mcap"
    code, _, err = run("record", out, table, *columns, "--axes", "y z x", "--gravity", "9.81", "--angle-sigma", 0)
    assert code == 0, err
    assert_alike(*(run.parameters("replay", path) for path in (recording, out)), 1e-3)


def test_recording_says_how_long_it_is_and_what_will_not_be_used(run, tmp_path: Path) -> None:
    """Stamps begin at zero, and one jumps back."""
    table, out = tmp_path / "lines.csv", tmp_path / "lines.mcap"
    stamps = [0.1 * k if k != 150 else 2.0 for k in range(300)]
    rows = [f"{stamp:.2f},0,0,1,0,0,0" for stamp in stamps]
    table.write_text("\n".join(["time_s,ax_g,ay_g,az_g,outer_deg,middle_deg,inner_deg", *rows]) + "\n")
    words = "record", out, table, "--axes", "y z x", "--gravity", "9.81"
    code, said, err = run(*words)
    assert code == 0, err
    assert "300 readings, 1 dwell, 30 s" in said and "stamps jumped back (first at 14.900 s), dropped: 1" in said
    told = run.json(*words, "--overwrite")
    assert told["duration_s"] == pytest.approx(29.9) and len(told["warnings"]) == 2


def test_the_bench_from_a_toml_file(run, recording: Path, tmp_path: Path) -> None:
    toml = tmp_path / "bench.toml"
    toml.write_text("gravity_mps2 = 9.9\nangle_sigma_deg = 0.5\n[nominal]\ntheta1 = 0.25\n")
    result = run.json("replay", recording, "--bench", toml)
    assert result["noise"]["angle_sigma_deg"] == pytest.approx(0.5)
    assert result["parameters"][0]["nominal"] == 0.25
    assert result["parameters"][2]["value"] == pytest.approx(9.81 / 9.9, abs=2e-3)


BAD = {
    "readings in g": (dict(accel=lambda s: Stream(s.time_ns, s.values / 9.80665)), "--accel-unit g"),
    "counts": (dict(accel=lambda s: Stream(s.time_ns, np.round(s.values * 1e4))), "counts"),
    "no angles": (dict(pose=lambda s: Stream.empty(3)), "angles"),
    "no readings": (dict(accel=lambda s: Stream.empty(3)), "no accelerometer readings"),
    "one orientation": (dict(accel=lambda s: s[s.time_ns < s.time_ns[0] + 5 * 10**9]), "can be seen"),
    "all too large": (dict(accel=lambda s: Stream(s.time_ns, 1e200 * s.values)), "too large"),
    "all NaN": (dict(accel=lambda s: Stream(s.time_ns, np.nan * s.values)), "not finite"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_recordings_are_one_sentence(run, recording: Path, tmp_path: Path, name: str) -> None:
    how, says = BAD[name]
    assert says in run.refused("replay", changed(recording, tmp_path / "bad.mcap", **how), "--json")


@pytest.mark.parametrize(
    "words, says",
    [
        (["replay", "{tmp}/absent.mcap"], "absent.mcap"),
        (["replay", "{tmp}"], "holds several recordings (empty.mcap, text.mcap)"),
        (["replay", "{tmp}/empty.mcap"], "empty"),
        (["replay", "{tmp}/text.mcap"], "a header and no rows"),
        (["replay", "{run}", "--axes", "y q x"], "'q'"),
        (["replay", "{run}", "--axes", "y z"], "2 gimbal axes"),
        (["replay", "{run}", "--gravity", "981"], "m/s^2"),
        (["replay", "{run}", "--reference", "inertial"], "latitude"),
        (["replay", "{run}", "--engine", "unscented"], "unscented"),
        (["replay", "{run}", "--bench", "{tmp}/text.mcap"], "TOML"),
        (["replay"], "RECORDING"),
        (["repeat", "{run}"], "repeat"),
        (["diagnos", "{run}"], "'diagnose'"),
        (["replay", "{run}", "--with", "second-ordr"], "did you mean second-order"),
        (["record", "{run}", "{tmp}/text.mcap", "--axes", "y z x", "--gravity", "9.8"], "."),
        (["record", "{tmp}/log.csv", "{run}", "--overwrite"], "the recording goes before the lines: kf-calib record "),
        (["simulate", "{run}"], "exists"),
        (["replay", "{run}", "--gravity", "9,81"], "write 9.81 with a point"),
        (["replay", "{run}", "--gravity", "nan"], "not a finite number"),
        (["replay", "{run}", "--angle-sigma", "-1"], "x>=0"),
        (["replay", "{run}", "--bench", "{tmp}/comma.toml"], "comma.toml: bench key gravity_mps2 is '9,81'"),
        (["replay", "{run}", "--bench", "{tmp}/nan.toml"], "(theta1: it must be a finite number)"),
        (["replay", "{run}", "--still-deg", "1000"], "above 0 and up to 5"),
        (["plan", "--target", "K=2,5ppm"], "write 2.5 with a point"),
        (["simulate", "{tmp}/new.mcap", "--hide", "base-tilt=4,1arcsec"], "write 4.1 with a point"),
        (["simulate", "{tmp}/new.mcap", "--dwell-s", "1e8"], "or begin nevertheless with --large"),
        (["simulate", "{tmp}/new.mcap", "--dwell-s", "1e9", "--large"], "years"),
        (["simulate", "{tmp}/new.mcap", "--plan", "{tmp}/text.mcap"], "no orientation"),
    ],
)
def test_bad_usage_is_one_sentence(run, recording: Path, tmp_path: Path, words: list[str], says: str) -> None:
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("1, 2, three\n")
    (tmp_path / "comma.toml").write_text('gravity_mps2 = "9,81"\n')
    (tmp_path / "nan.toml").write_text("[nominal]\ntheta1 = nan\n")
    before = recording.read_bytes()
    assert says in run.refused(*(word.format(tmp=tmp_path, run=recording) for word in words))
    assert recording.read_bytes() == before


def test_a_setting_that_cannot_be_kept_to_is_said(run, recording: Path) -> None:
    (said,) = run.json("replay", recording, "--settle-s", 1000)["warnings"]
    assert said.startswith("10 dwells are too short to leave out 1000 s") and "of the shortest" in said
    assert run.json("replay", recording)["warnings"] == []


def test_noise_is_stated_estimated_or_neither(run, tmp_path: Path) -> None:
    """The table beside the notes, with dwells that are too few, cannot tell, and can tell what was not stated."""
    for count, rows in (4, "neither"), (5, "scatter"), (7, "scatter"), (14, "both"):
        path = tmp_path / f"{count}.mcap"
        words = ["--orientations", count, "--unstated", "--setting", "0.005", "--seed", 3]
        assert run("simulate", path, *QUICK, *words)[0] == 0
        _, out, _ = run("replay", path)
        assert ("dwell to dwell, estimated" in out) == (rows != "neither")
        assert ("setting of angles, estimated" in out) == (rows == "both")
        assert ("too few to estimate what was not stated" in out) == (rows == "neither")
        assert (f"gravity in {count} different directions" in out) == (rows == "scatter")
        assert ", stated" not in out


@pytest.mark.parametrize("command", ["replay", "diagnose", "improve", "live", "plan", "simulate", "record", "effects"])
def test_help_groups_options_with_what_is_usual_first(run, command: str) -> None:
    code, out, _ = run(command, "--help")
    assert code == 0 and "…" not in out
    groups = [line.rstrip(": ") for line in out.splitlines() if line[:1].isupper() and line.rstrip().endswith(":")]
    assert {"Input and bench", "Output", "Examples"} <= set(groups)
    left = out[out.index("Options:") : out.index("Examples:")]
    assert left.count("--") == 2 and "--help-all" in left, "an option without a group: give it panel="


@pytest.mark.parametrize("name", cli.list_commands(click.Context(cli)))
def test_help_fits_two_screens_and_help_all_has_every_option(run, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    code, out, _ = run(name, "--help")
    assert code == 0 and len(out.splitlines()) <= 50
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    options = {param.opts[-1] for param in command.params if isinstance(param, click.Option) and not param.hidden}
    code, everything, _ = run(name, "--help-all")
    assert code == 0 and not {option for option in options if option not in everything}
    assert ("--help-all" in out) == any(option not in out for option in options)


def test_help_is_asked_for_alike_where_a_command_is_called_by_itself() -> None:
    """click keeps the names with which help was asked for first."""
    command = cli.get_command(click.Context(cli), "paper")
    assert command is not None
    for asked in ("-h", "--help"):
        assert CliRunner().invoke(command, [asked]).exit_code == 0


def test_a_plan_from_a_file_is_visited(run, tmp_path: Path) -> None:
    plan = tmp_path / "plan.csv"
    plan.write_text("outer,middle,inner\n0,0,0\n0, 90, 0  # x up\n45,-90,0\n")
    assert run.json("simulate", tmp_path / "a.mcap", "--plan", plan, "--dwell-s", 5)["dwells"] == 3


def test_a_hidden_effect_fails_and_the_right_one_mends_it(run, tmp_path: Path) -> None:
    """Compare the model with the measurements, see it fail, add the effect, watch the error fall; also in Rerun."""
    path = tmp_path / "hidden.mcap"
    assert run("simulate", path, *QUICK, "--hide", "second-order=40ug/g^2", "--seed", 8)[0] == 0
    plain = run.json("replay", path)
    mended = run.json("replay", path, "--with", "second-order", "--rrd", tmp_path / "view.rrd")
    assert plain["consistency"]["consistent"] is False and mended["consistency"]["consistent"] is True
    assert (tmp_path / "view.rrd").stat().st_size > 10_000
    assert mended["model"] == ["second-order"]
    assert mended["held_out_rms_mps2"] < 0.1 * plain["held_out_rms_mps2"]
    truth = json.loads(path.with_suffix(".truth.json").read_text())["effects"][0]["sizes"]
    found = {p["symbol"]: p for p in mended["parameters"]}
    for i in "123":
        coefficient = found[f"K2_{i}"]
        assert abs(coefficient["value"] - truth[i]) < 4 * coefficient["sigma"]
        assert coefficient["unit"] == "s^2/m"
    assert b"second-order" not in path.read_bytes()
