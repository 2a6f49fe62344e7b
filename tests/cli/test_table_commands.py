"""Tables of orientations on the command line."""

import re
from pathlib import Path

import pytest
from helpers.long_runs import slow
from helpers.paths import RECORDINGS, ROOT

import kf_calib
from kf_calib.bench.raw_input import RawInput
from kf_calib.sources.files.record_files import fingerprint

pytestmark = pytest.mark.usefixtures("unmeasured")

TWELVE = ROOT / "recordings" / "twelve_poses.csv"
OPTIONS = (TWELVE, "--axes", "y z x", "--gravity", "9.8123")
GAPS = "Lage;Kanal A;Kanal B;Kanal C;Temp;n\n" + "".join(
    f"{line};\n" for line in ("+x;1003;4;-2;24,1", "-x;-998;1;2;", "+y;3;1001;1;24,5", "-y;1;-996;0;24,4",
                              "+z;0;3;999;-", "-z;3;2;-998;24,6")
)  # fmt: skip
FACES = "face,A,B,C\n+x,1,0,0\n-x,-1,0,0.001\n+y,0,1.002,0\n-y,0,-1,0.001\n+z,0.001,0,1\n-z,0,0.001,-1\n"


@pytest.mark.parametrize("command", [("replay",), ("diagnose",), *slow((("improve",),), (("compare",),))])
def test_a_table_goes_where_a_recording_goes(command: tuple[str, ...], run) -> None:
    said = run.json(*command, *OPTIONS).get("warnings", ["1 g = 9.80665 m/s^2"])
    assert sum("1 g = 9.80665 m/s^2" in warning for warning in said) == 1


def test_a_plan_goes_on_from_a_table(run) -> None:
    assert run.json("plan", "--recording", *OPTIONS)["gimbal_deg"]


def test_columns_and_g_are_settled_by_options(run, tmp_path: Path) -> None:
    path = tmp_path / "faces.csv"
    path.write_text(FACES)
    words = ("replay", path, "--gravity", "9.81", "--g-unit", "local", "--column", "C=az_g")
    run.refused(*words, "--column", "A=ay_g", "--column", "B=ax_g")  # x and y exchanged
    found = run.json(*words, "--column", "A=ax_g", "--column", "B=ay_g")
    assert found["parameters"][2]["value"] == pytest.approx(1.0, abs=1e-5)
    assert found["consistency"]["p_value"] is None
    assert any("1 g = 9.81 m/s^2" in warning for warning in found["warnings"])


def test_samples_in_a_spreadsheet_are_to_be_saved_as_csv(run, tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl", reason="openpyxl is not there")
    book = openpyxl.Workbook()
    book.active.append(["time_s", "outer_deg", "middle_deg", "inner_deg", "ax_g", "ay_g", "az_g"])
    for k in range(200):
        book.active.append([k / 100, 0, 0, 0, 0, 1, 0])
    book.save(tmp_path / "log.xlsx")
    for command in (("replay", tmp_path / "log.xlsx", "--axes", "y z x", "--gravity", "9.81"),
                    ("info", tmp_path / "log.xlsx")):  # fmt: skip
        err = run.refused(*command)
        assert "are samples, 0.01 s apart" in err and "in a CSV file" in err


OF_SAMPLES = [("--settle-s", "1"), ("--still-deg", "1"), ("--no-gate",), ("--gate-sigma", "5"), ("--accel-topic", "/a"),
              ("--pose-topic", "/a"), ("--temperature-topic", "/a"), ("--field", "accel=/a:b"), ("--max-chunk-mb", "9"),
              ("--joints", "a b c")]  # fmt: skip


@pytest.mark.parametrize("option", OF_SAMPLES, ids=lambda option: option[0])
def test_options_of_samples_are_refused_for_a_table(option: tuple[str, ...], run) -> None:
    err = run.refused("replay", *OPTIONS, *option)
    assert f"is a table of mean readings, on which {option[0]} has nothing to act: leave it out." in err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("record", "made.mcap", TWELVE), "is a table of orientations, with a row a dwell, and is evaluated as it is"),
        (("plan", "--recording", "faces.csv", "--gravity", "9.81"), "say which gimbals are to be turned, for example"),
        (("replay", *OPTIONS, "--angle-unit", "rad"), "'außen [°]' is in deg by its name, and --angle-unit is rad"),
        (("replay", "faces.csv", "--gravity", "9.81", "--angle-unit", "rad"), "has no gimbal angles, so leave out"),
        (("replay", *OPTIONS, "--with", "vibration-rectification"), "needs the readings themselves"),
        (("replay", RECORDINGS / "hidden.mcap", "--column", "a=ax_g"), "is no table (.csv, .xlsx)"),
        (
            ("replay", RECORDINGS / "hidden.mcap", "--g-unit", "local"),
            "is no table (.csv, .xlsx) and no log in lines of text, on which --g-unit has nothing",
        ),
    ],
)
def test_what_a_table_cannot_do_is_told(words: tuple[object, ...], says: str, run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("faces.csv").write_text(FACES.replace("A,B,C", "ax,ay,az"))
    assert says in run.refused(*words)


def test_means_without_sigma_are_compared_planned_from_and_verified(run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("faces.csv").write_text(FACES.replace("A,B,C", "ax,ay,az"))
    own = ("faces.csv", "--gravity", "9.81")
    assert run.json("compare", *own)["max_difference_sigma"] < 1e-5
    planned = run.json("plan", "--recording", *own, "--axes", "y z x")
    assert planned["duration_s"] > 30.0
    assert all(planned["sigma"][name] < before for name, before in planned["sigma_before"].items())
    assert run("replay", *own, "--save", "cal.json")[0] == 0
    assert run.json("verify", "cal.json", *own)["holds"]


def test_info_of_a_table_says_what_was_taken_for_what(run, tmp_path: Path) -> None:
    path = tmp_path / "gaps.csv"
    path.write_text(GAPS)
    found, command = run.proposed(path)
    told = {own["header"]: (own["meaning"], own["unit"], own["told_by"]) for own in found["columns"]}
    assert told == {"Lage": ("face", "", "name"), "Kanal A": ("ax", "mg", "content and size"),
                    "Kanal B": ("ay", "mg", "content and size"), "Kanal C": ("az", "mg", "content and size"),
                    "Temp": ("temperature", "", "name"), "n": ("", "", "")}  # fmt: skip
    assert [row["face"] for row in found["dwells"]] == ["+x", "-x", "+y", "-y", "+z", "-z"]
    assert [row["temperature_c"] for row in found["dwells"]] == pytest.approx([24.1, 24.3, 24.5, 24.4, 24.5, 24.6])
    assert [said.partition(":")[0] for said in found["missing"]] == ["local gravity"]
    assert any("has no temperature in rows 3, 6: it is interpolated in time" in said for said in found["warnings"])
    assert run.json(*command)["dwells"] == 6
    path.write_text(GAPS.replace("999", "foo"))
    code, out, _ = run("info", path)
    assert code == 0 and "Missing: " in out and "row 6, column 'Kanal C' is 'foo'" in " ".join(out.split())


@pytest.mark.parametrize("channel", [1, 2, 3])
def test_a_reversed_channel_of_the_table_of_the_docs_is_told_by_the_option_that_mends_it(
    channel: int, run, tmp_path: Path
) -> None:
    header, *rows = re.findall(r"^(?:face|[+-][xyz]),.*", (ROOT / "docs" / "tables.md").read_text(), re.MULTILINE)
    for k, row in enumerate(rows):
        cells = row.split(",")
        cells[channel] = repr(-float(cells[channel]))
        rows[k] = ",".join(cells)
    path = tmp_path / "faces.csv"
    path.write_text("\n".join([header, *rows]))
    order = ",".join(str(-k if k == channel else k) for k in (1, 2, 3))
    said = run.refused("replay", path, "--gravity", "9.81")
    assert said.endswith(f"channel {channel} reversed? Try --channels {order}.\n")
    assert run("replay", path, "--gravity", "9.81", "--channels", order, "--save", tmp_path / "cal.json")[0] == 0
    saved = kf_calib.open_calibration(tmp_path / "cal.json")
    assert saved.bench.input == RawInput.from_metadata({"channels": order, "accel_unit": "g"})
    assert saved.provenance.recording == "faces.csv" and saved.provenance.sha256 == fingerprint(path)


def test_counts_get_a_size_to_try(run, tmp_path: Path) -> None:
    path = tmp_path / "counts.csv"
    path.write_text("face,raw_x,raw_y,raw_z\n+x,16420,30,-20\n-x,-16350,20,10\n+y,20,16400,20\n-y,30,-16330,10\n"
                    "+z,15,25,16390\n-z,25,20,-16360\n")  # fmt: skip
    found, command = run.proposed(path, "--gravity", "9.81")
    (missing,) = found["missing"]
    assert "so they are counts: give the size of one by --accel-scale" in missing
    assert run.parameters(*command)["K1"]["value"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("name", ["twelve_poses.csv", "six_faces.xlsx"])
def test_the_examples_lack_nothing_but_their_bench(name: str, run) -> None:
    if name.endswith("xlsx"):
        pytest.importorskip("openpyxl", reason="openpyxl is not there")
    code, out, _ = run("info", RECORDINGS / name)
    assert code == 0 and "Missing: local gravity" in out
    assert f"--gravity:\nkf-calib replay {RECORDINGS / name}" in out and "Then try, with your own" in out
    bench = ("--axes", "y z x", "--gravity", "9.81")
    found = run.json("info", RECORDINGS / name, *bench)
    assert found["missing"] == [] and found["orientation"] == ("face" if name.endswith("xlsx") else "angles")


def test_the_spreadsheet_of_a_run_gives_what_the_run_does(run) -> None:
    """All of it was rounded to what a display shows."""
    pytest.importorskip("openpyxl", reason="openpyxl is not there")
    bench = run.json("info", RECORDINGS / "mems_faces.mcap")["bench"]
    stated = ("--gravity", "9.81", "--angle-sigma", bench["angle_sigma_deg"], "--scatter-sigma",
              bench["scatter_sigma_mps2"])  # fmt: skip
    written = run.parameters("replay", RECORDINGS / "six_faces.xlsx", *stated)
    for symbol, one in run.parameters("replay", RECORDINGS / "mems_faces.mcap").items():
        other = written[symbol]
        assert abs(one["value"] - other["value"]) < 0.02 * one["sigma"]
        assert other["sigma"] == pytest.approx(one["sigma"], rel=0.01)
