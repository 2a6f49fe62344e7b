"""Logs and tables as others write them: ``info`` proposes a command that works, and gives what the recording gives."""

import gzip
import json
import random
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.bounded import traced
from helpers.damage import damaged
from helpers.long_runs import slow
from helpers.paths import REAL, ROOT
from helpers.recordings import read

import kf_calib
from kf_calib.errors import InputError
from kf_calib.sources.file_kind import FileKind
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.opening import kind_of, opened
from kf_calib.sources.text.lines import Lines
from kf_calib.sources.text.means import Survey

pytestmark = pytest.mark.usefixtures("unmeasured")

FACES = ROOT / "recordings" / "mems_faces.mcap"
G = 9.80665
BENCH = ("--axes", "y z x", "--gravity", "9.81", "--angle-sigma", "0.2", "--scatter-sigma", "0.0")
BY_HAND = ("--gravity", "9.81", "--no-angles")


@cache
def samples() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times in s, readings in m/s^2 and angles in deg at these times, of a recording of six faces."""
    whole = read(Recording(FACES))
    time_s = (whole.accel.time_ns - whole.accel.time_ns[0]) / 1e9
    pose = [np.interp(whole.accel.time_ns, whole.pose.time_ns, angle) for angle in whole.pose.values.T]
    return time_s, whole.accel.values, np.degrees(pose).T


def rows(line: Callable[[float, np.ndarray, np.ndarray], Sequence[float | str]], delimiter: str = ",") -> str:
    cells = (line(*own) for own in zip(*samples(), strict=True))
    return "".join(delimiter.join(f"{c:.6f}" if isinstance(c, float) else str(c) for c in own) + "\n" for own in cells)


def german() -> str:
    text = rows(lambda t, f, q: (t, *(f / G), *q, 24.5), ";").replace(".", ",")
    return "Zeit [s];Beschl. X [g];Beschl. Y [g];Beschl. Z [g];außen [°];Mitte [°];innen [°];Temp [°C]\n" + text


def titled() -> str:
    head = "# logger 3.1\nBlock 0417\n\ntime,ax,ay,az,roll,pitch,yaw\ns,g,g,g,deg,deg,deg\n"
    return head + rows(lambda t, f, q: (t, *(f / G), *q))


def dated() -> str:
    def line(t: float, f: np.ndarray, _: np.ndarray) -> Sequence[float | str]:
        return (f"2026-05-04T13:{int(t // 60):02d}:{t % 60:09.6f}+02:00", *(1000 * f / G))

    return "timestamp,accel_x [mg],accel_y [mg],accel_z [mg]\n" + rows(line)


def in_two_columns() -> str:
    def line(t: float, f: np.ndarray, _: np.ndarray) -> Sequence[float | str]:
        return ("5/4/2026", f"1:{int(t // 60):02d}:{t % 60:09.6f} PM", *f)

    return "Date,Time,acc x,acc y,acc z\n" + rows(line)


def with_a_gyroscope() -> str:
    head = "timestamp,ax,ay,az,gx [rad/s],gy [rad/s],gz [rad/s],mx,my,mz\n"
    return head + rows(
        lambda t, f, _: (str(round(1_750_000_000_000 + 1000 * t)), *(f / G), 0.0, 0.0, 0.0, 1.0, 2.0, 3.0)
    )


def phyphox() -> str:
    head = '"Time (s)","Acceleration x (m/s^2)","Acceleration y (m/s^2)","Acceleration z (m/s^2)"'
    return head + ',"Absolute acceleration (m/s^2)"\n' + rows(lambda t, f, _: (t, *f, float(np.linalg.norm(f))))


def json_lines() -> str:
    return "".join(json.dumps({"t": t, "f": (f / G).tolist(), "q": q.tolist()}) + "\n"
                   for t, f, q in zip(*samples(), strict=True))  # fmt: skip


JSON_NAMES = ("--column", "t=time_s", "--column", "f=accel_g", "--column", "q=angles_deg")
WITH_ANGLES = {
    "semicolons and decimal commas in Windows-1252": (german().encode("cp1252"), ()),
    "UTF-16": (german().encode("utf-16"), ()),
    "lines above the header and units below it": (titled().encode(), ()),
    "packed": (gzip.compress(titled().encode()), ()),
    "JSON lines": (json_lines().encode(), JSON_NAMES),
}
BY_READINGS = {
    "a phone": (phyphox().encode(), ()),
    "names alone": (("t,x,y,z\n" + rows(lambda t, f, _: (t, *(f / G)))).encode(), ()),
    "dates": (dated().encode(), ()),
    "date and time of day": (in_two_columns().encode(), ()),
    "other sensors beside it": (with_a_gyroscope().encode(), ()),
    "angles that are not used": (german().encode(), ("--no-angles",)),
}  # fmt: skip


def written(folder: Path, content: bytes) -> Path:
    suffix = ".jsonl" if content.startswith(b"{") else ".csv.gz" if content.startswith(b"\x1f\x8b") else ".csv"
    path = folder / f"my log{suffix}"
    path.write_bytes(content)
    return path


RECORDED = dict[tuple[str, ...], dict[str, Any]]()
"""Parameters of the recording, by what is stated of the bench."""


@pytest.mark.parametrize("how", [*WITH_ANGLES, *BY_READINGS])
def test_a_foreign_log_is_evaluated_by_the_command_that_info_proposes(how: str, run: Any, tmp_path: Path) -> None:
    """It gives the same parameters as the recording that it was written of, to the digits that were written; where
    angles were interpolated to the readings, dwells may begin and end a few readings apart."""
    content, options = (WITH_ANGLES | BY_READINGS)[how]
    path = written(tmp_path, content)
    stated = BENCH if how in WITH_ANGLES else BY_HAND[:2]
    found, command = run.proposed(path, *options, *stated)
    assert len(found["dwells"]) == 6 and set(options) | set(stated) <= set(command)
    norms = [dwell["norm_mps2"] for dwell in found["dwells"]]
    assert 8.5 < min(norms) < max(norms) < 11.5
    values = run.parameters(*command)
    stated = BENCH if how in WITH_ANGLES else BY_HAND
    if stated not in RECORDED:
        RECORDED[stated] = run.parameters("replay", FACES, *stated)
    expected = RECORDED[stated]
    for symbol, own in expected.items():
        if own["value"] is not None and own["sigma"]:
            allowed = (0.1 if how in WITH_ANGLES else 0.02) * own["sigma"]
            assert values[symbol]["value"] == pytest.approx(own["value"], abs=allowed), symbol
            assert values[symbol]["sigma"] == pytest.approx(own["sigma"], rel=0.02), symbol


def test_counts_get_a_size_to_try(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "counts.csv"
    path.write_text("time_ms,ax_raw,ay_raw,az_raw\n"
                    + rows(lambda t, f, _: (1000 * t, *(str(round(c)) for c in 16384 * f / G))))  # fmt: skip
    found, command = run.proposed(path, "--gravity", "9.81")
    assert any("so they are counts: give the size of one by --accel-scale" in said for said in found["missing"])
    assert "--accel-scale" in command and "--no-angles" in command
    assert run.parameters(*command)["K1"]["value"] == pytest.approx(1.0, abs=0.15)
    assert "so they are counts" in run.refused("replay", path, *BY_HAND)


IN_OTHER_UNITS = {
    "counts under a name in g": ("time_s,ax_g,ay_g,az_g", 2.5e5 / G, "--accel-scale 4.08e-06 --restate-input"),
    "g under a name in m/s^2": ("time_s,ax_mps2,ay_mps2,az_mps2", 1.0 / G, "--accel-unit g --restate-input"),
}


@pytest.mark.parametrize("how", IN_OTHER_UNITS)
def test_a_unit_that_is_not_that_of_the_name_is_told_by_the_norm(how: str, run: Any, tmp_path: Path) -> None:
    """``info`` proposes a command that works, with the user's own options in it but for the wrong one."""
    header, factor, option = IN_OTHER_UNITS[how]
    path = tmp_path / "log.csv"
    path.write_text(header + ",outer_deg,middle_deg,inner_deg\n" + rows(lambda t, f, q: (t, *(factor * f), *q)))
    found, command = run.proposed(path, *BENCH)
    assert any("have a norm of" in said for said in found["missing"])
    assert [*BENCH, *option.split()] == [word for word in command if word not in ("replay", str(path))]
    values = run.parameters(*command)
    expected = run.parameters("replay", FACES, *BENCH)
    for symbol in ("K1", "K2", "K3"):
        assert values[symbol]["value"] == pytest.approx(expected[symbol]["value"], rel=0.05)
    assert option.split()[0] in run.refused("replay", path, *BENCH)
    if "--accel-unit" in option:
        err = run.refused("replay", path, *BENCH, "--accel-unit", "g")
        assert "in m/s2 by its name" in err and "--restate-input" in err


@pytest.mark.parametrize("factor", [1.0, 1.0 / G, 2.5e5], ids=["m/s2", "g", "counts"])
def test_json_lines_without_a_unit_get_one_to_try(factor: float, run: Any, tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    path.write_text("".join(json.dumps({"time_s": float(t), "accel": (factor * f).tolist(), "angles_deg": q.tolist()})
                            + "\n" for t, f, q in zip(*samples(), strict=True)))  # fmt: skip
    _, command = run.proposed(path, *BENCH)
    assert run.parameters(*command)["K1"]["value"] == pytest.approx(1.0, abs=0.15)


def test_two_angles_get_two_axes(run: Any, tmp_path: Path) -> None:
    path = tmp_path / "two.csv"
    path.write_text("time_s,ax_g,ay_g,az_g,outer_deg,inner_deg\n" + rows(lambda t, f, q: (t, *(f / G), *q[1:])))
    found, command = run.proposed(path)
    assert command[-4:] == ["--axes", "z x", "--gravity", "9.81"] and len(found["dwells"]) == 6
    assert len(run.parameters(*command)) == 12


ANGLES = "time_s,ax_g,ay_g,az_g,outer_deg,middle_deg,inner_deg\n"
BROKEN = {
    "no time": ("ax,ay,az\n" + rows(lambda _, f, q: f / G), "no column gives the time: name it time_s"),
    "whole numbers for a time": ("t,ax,ay,az\n" + rows(lambda t, f, _: (str(round(50 * t) * 20), *f)),
                                 "say which 't' has, for example --column 't=time_ms'"),
    "angles of no unit": ("time_s,ax_g,ay_g,az_g,outer,inner\n" + rows(lambda t, f, _: (t, *(f / G), 1.0, 2.0)),
                          "with their unit: name them outer_deg, inner_deg"),
    "a word": (ANGLES + rows(lambda t, f, q: (t, "broken", *(f[1:] / G), *q)),
               "first line 2: column 'ax_g' is 'broken', which is no number"),
    "a column twice": ("time_s,ax,ay,az,acc_x,outer_deg\n" + rows(lambda t, f, _: (t, *f, 0.0, 0.0)),
                       "columns 'ax', 'acc_x' are all taken for ax: say which it is, for example by --column 'ax=ax'"),
}  # fmt: skip


@pytest.mark.parametrize("how", BROKEN)
def test_a_log_that_cannot_be_used_is_one_sentence(how: str, run: Any, tmp_path: Path) -> None:
    text, says = BROKEN[how]
    (tmp_path / "log.csv").write_text(text)
    err = run.refused("replay", tmp_path / "log.csv", *BENCH)
    assert says in err and len(err) < 700, err


def test_numbers_of_two_kinds_are_not_mixed(tmp_path: Path) -> None:
    """Where decimals follow a comma, a point separates thousands, or the line is refused."""
    head = "time_s;ax_mg;ay_mg;az_mg\n"
    (tmp_path / "log.csv").write_text(head + "0,5;1.003,5;-2,5;1.003\n1,5;1;2;0.5\n")
    source = Lines(tmp_path / "log.csv", {"gravity_mps2": "9.81"}, angles=False)
    (batch,) = [batch for batch in source if len(batch.accel)]
    np.testing.assert_allclose(batch.accel.values / (G / 1000), [[1003.5, -2.5, 1003.0]])
    assert any("column 'az_mg' is '0.5', which is no number" in said for said in source.warnings)


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("run.mcap", FACES.read_bytes(), FileKind.RECORDING),
        ("a.csv", german().encode("utf-16"), FileKind.SAMPLES),
        ("a.log", titled().encode(), FileKind.SAMPLES),
        ("a.json", b'\xef\xbb\xbf\n{"time_s": 1}\n', FileKind.SAMPLES),
        ("twelve.csv", (ROOT / "recordings" / "twelve_poses.csv").read_bytes(), FileKind.TABLE),
        ("twelve.csv.gz", gzip.compress((ROOT / "recordings" / "twelve_poses.csv").read_bytes()), FileKind.TABLE),
        ("bursts.csv", ("time_s,ax_g,ay_g,az_g,n\n" + rows(lambda t, f, _: (t, *f, "9"))).encode(), FileKind.TABLE),
        ("slow.csv", ("time_s,ax_g,ay_g,az_g\n" + rows(lambda t, f, _: (100 * t, *f))).encode(), FileKind.TABLE),
        ("empty.csv", b"", FileKind.TABLE),
        ("book.xlsx", b"PK\x03\x04", FileKind.TABLE),
        ("bag.db3", b"SQLite format 3\0" + bytes(2000), FileKind.RECORDING),
        ("bag.txt", b"SQLite format 3\0" + bytes(2000), FileKind.RECORDING),
        ("run.csv", FACES.read_bytes(), FileKind.RECORDING),
        ("run.xls", FACES.read_bytes(), FileKind.RECORDING),
        ("noise", np.random.default_rng(1).bytes(5000), FileKind.RECORDING),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_file_is_told_by_what_is_in_it(name: str, content: bytes, kind: FileKind, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    assert kind_of(tmp_path / name) is kind


def test_a_log_is_read_again_for_every_pass_and_engines_agree(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time_s,ax_mps2,ay_mps2,az_mps2\n" + rows(lambda t, f, _: (t, *f)))
    compared = kf_calib.compare(kf_calib.open_log(path, {"gravity_mps2": "9.81"}, angles=False))
    assert compared.max_difference_sigma < 1e-5


def test_a_path_alone_is_enough_in_python(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    first = {"bench": {"axes": "y z x", "gravity_mps2": 9.81}}
    names = {"t": "time_s", "f": "accel_g", "q": "angles_deg"}
    text = json_lines()
    for theirs, ours in names.items():
        text = text.replace(f'"{theirs}"', f'"{ours}"')
    path.write_text(json.dumps(first) + "\n" + text)
    assert len(kf_calib.calibrate(path).visits) == 6
    assert opened(path).bench.gravity_mps2 == 9.81


def test_a_packed_file_is_unpacked_piece_by_piece(tmp_path: Path) -> None:
    bomb = tmp_path / "log.csv.gz"
    with gzip.open(bomb, "wb", 1) as file:
        for _ in range(64):
            file.write(b" " * (1 << 20))
    with traced() as peak, pytest.raises(InputError, match="holds no lines"):
        list(Lines(bomb, {"gravity_mps2": "9.81"}, angles=False))
    assert peak.bytes < 40 << 20


def test_a_packed_file_that_lost_its_end_is_used_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(titled().encode())[:-5000])
    source = Lines(path, {"gravity_mps2": "9.81"}, angles=False)
    count = sum(len(batch.accel) for batch in source)
    assert 0 < count < len(samples()[0])
    assert any("its end cannot be unpacked" in said for said in source.warnings)


# -- tables without angles --


def hand_table(has_spread: bool) -> str:
    """Means of eighteen poses of one sensor, in g, with noise of 0.2 mg of each mean."""
    rng = np.random.default_rng(3)
    directions = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(12, 3))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sensitivity = np.array([[1.01, 0.0, 0.0], [0.004, 0.99, 0.0], [-0.003, 0.002, 1.02]])
    means = directions @ sensitivity.T + [0.02, -0.01, 0.03] + 2e-4 * rng.normal(size=(18, 3))
    head = "time [s],ax [g],ay [g],az [g]" + ",sd [mg],n" * has_spread + "\n"
    spread = ",4,400" * has_spread
    return head + "".join(f"{10 * k},{x:.7f},{y:.7f},{z:.7f}{spread}\n" for k, (x, y, z) in enumerate(means))


@pytest.mark.parametrize("has_spread", [True, False])
def test_a_table_without_angles_gives_what_least_squares_of_the_norms_gives(
    has_spread: bool, run: Any, tmp_path: Path
) -> None:
    """The nine parameters of |S^-1 (z - b)| = 1 by scipy, for means of equal noise."""
    optimize = pytest.importorskip("scipy.optimize")
    path = tmp_path / "hand.csv"
    path.write_text(hand_table(has_spread))
    found, command = run.proposed(path, "--gravity", "9.81", "--g-unit", "local")
    assert "--no-angles" in command and found["orientation"] is None and len(found["dwells"]) == 18
    assert found["dwells"][0]["pose"] == [] and found["dwells"][0]["up"] == pytest.approx([1.0, 0.0, 0.0], abs=0.04)
    values = run.parameters(*command)
    means = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1:4]

    def size_of(q: np.ndarray) -> np.ndarray:
        return np.array([[q[0], 0.0, 0.0], [q[3], q[1], 0.0], [q[4], q[5], q[2]]])

    def misfit(q: np.ndarray) -> np.ndarray:
        matrix = size_of(q)
        force = np.linalg.solve(matrix, (means - q[6:]).T).T
        across = np.linalg.solve(matrix.T, (force / np.linalg.norm(force, axis=1, keepdims=True)).T)
        return (np.linalg.norm(force, axis=1) - 1.0) / np.linalg.norm(across, axis=0)

    best = optimize.least_squares(misfit, [1, 1, 1, 0, 0, 0, 0, 0, 0], xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    scales = np.linalg.norm(size_of(best), axis=1)
    for k in range(3):
        for symbol, expected in ((f"K{k + 1}", scales[k]), (f"b{k + 1}", 9.81 * best[6 + k])):
            assert values[symbol]["value"] == pytest.approx(expected, abs=0.05 * values[symbol]["sigma"]), symbol
    assert run.parameters("replay", path, *BY_HAND)["K1"]["sigma"] > 0.0


@pytest.mark.slow
def test_a_table_with_faces_may_do_without_them(run: Any) -> None:
    twelve = ROOT / "recordings" / "twelve_poses.csv"
    found = run.json("replay", twelve, "--no-angles", "--gravity", "9.8123")
    assert found["dwells"] == 12
    assert any("'außen [°]', 'mitte [°]', 'innen [°]'" in said and "not used" in said for said in found["warnings"])
    run.json("diagnose", twelve, "--no-angles", "--gravity", "9.8123")


@pytest.mark.skipif(not REAL.exists(), reason="the real recordings are not on this machine")
@pytest.mark.parametrize(
    ("name", "poses"), [("mpu6050", 10), ("nexus5_d1", 9), *slow(("xsens_mti", 38), ("mpu9150_0", 23))]
)
def test_real_logs_are_evaluated_as_they_are(name: str, poses: int, run: Any) -> None:
    path = REAL / f"{name}.csv.gz"
    found, command = run.proposed(path)
    assert len(found["dwells"]) == poses and "--no-angles" in command
    assert all(0.8 * G < dwell["norm_mps2"] < 1.2 * G for dwell in found["dwells"])
    values = run.parameters(*command)
    assert all(0.9 < values[f"K{k}"]["value"] < 1.1 for k in (1, 2, 3))


# -- damage --

SCRAPS = (
    b'"',
    b";",
    b",",
    b"\n",
    b"\0",
    b"\xff",
    b"e999",
    b"e-999",
    b"nan",
    b"-",
    b"[g]",
    b"\r",
    b"\t",
    b"#",
    b"9999-01-01",
)


@pytest.mark.parametrize("seed", [1, *slow(*range(2, 20))])
def test_a_damaged_log_or_table_raises_nothing_but_input_errors(seed: int, tmp_path: Path) -> None:
    rng, path = random.Random(seed), tmp_path / "damaged.csv"
    plain = [content[:6000] for content, _ in (WITH_ANGLES | BY_READINGS).values() if not content.startswith(b"\x1f")]
    plain += [gzip.compress(plain[0]), (ROOT / "recordings" / "twelve_poses.csv").read_bytes()]
    kinds = set[FileKind]()
    for _ in range(100):
        path.write_bytes(damaged(rng.choice(plain), rng, SCRAPS) or b"x")
        kind = kind_of(path)
        kinds.add(kind)
        for angles in (True, False):
            bench = {"axes": "y z x", "gravity_mps2": "9.81"}
            try:
                if kind is FileKind.SAMPLES:
                    list(Lines(path, bench, angles=angles))
                elif kind is FileKind.TABLE:
                    Survey(path, bench, angles=angles)
            except InputError as error:
                assert "\n" not in str(error) and len(str(error)) < 1200
    assert {FileKind.SAMPLES, FileKind.TABLE} <= kinds
