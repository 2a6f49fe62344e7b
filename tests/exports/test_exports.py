"""What is exported, read as the receiving program reads it and applied by its formula."""

import csv
import io
import json
import re
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.paths import RECORDINGS
from helpers.stated_sensors import Formula, correction, samples, saved

from kf_calib.bench import paper_parameters
from kf_calib.errors import InputError, UnobservableError
from kf_calib.exchange import calibration_file
from kf_calib.exports import TARGETS, exported
from kf_calib.exports.affine import AffineTarget
from kf_calib.exports.command import export as command
from kf_calib.exports.target import in_cell


def px4(text: str) -> Formula:
    """Correct of sensor_calibration/Accelerometer.hpp and calc_thermal_offsets_3D of temperature_compensation."""
    lines = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    assert all(line[:2] == ["1", "1"] and line[4] == ("6" if line[2] == "TC_A_ENABLE" else "9") for line in lines)
    value = {line[2]: np.float32(line[3]) for line in lines}
    offset, scale = (np.array([value[f"CAL_ACC0_{axis}{name}"] for axis in "XYZ"]) for name in ("OFF", "SCALE"))

    def corrected(readings: np.ndarray, temperature: np.ndarray) -> np.ndarray:
        thermal = np.zeros(3)
        if value.get("TC_A_ENABLE") == 1:
            delta = np.clip(temperature, value["TC_A0_TMIN"], value["TC_A0_TMAX"])[:, None] - value["TC_A0_TREF"]
            thermal = sum(np.array([value[f"TC_A0_X{k}_{i}"] for i in range(3)]) * delta**k for k in range(4))
        return (readings - thermal - offset) * scale

    return corrected


def ardupilot(text: str) -> Formula:
    """_rotate_and_correct_accel and TCal::correct_sensor of AP_InertialSensor."""
    value = {name: float(np.float32(number)) for name, number in
             (line.split(",") for line in text.splitlines() if not line.startswith("#"))}  # fmt: skip
    offset, scale = (np.array([value[f"INS_ACC{name}_{axis}"] for axis in "XYZ"]) for name in ("OFFS", "SCAL"))

    def polynomial(temperature: Any) -> np.ndarray:
        low, high = value["INS_TCAL1_TMIN"], value["INS_TCAL1_TMAX"]
        u = np.clip(np.atleast_1d(temperature), low, high)[:, None] - 35.0
        c = [np.array([value[f"INS_TCAL1_ACC{k}_{axis}"] for axis in "XYZ"]) for k in (1, 2, 3)]
        return (c[0] + (c[1] + c[2] * u) * u) * u * 1e-6

    def corrected(readings: np.ndarray, temperature: np.ndarray) -> np.ndarray:
        if value.get("INS_TCAL1_ENABLE") == 1:
            readings = readings - polynomial(temperature) + polynomial(value["INS_ACC1_CALTEMP"])
        return (readings - offset) * scale

    return corrected


def imucal(text: str) -> Formula:
    """FerrarisCalibrationInfo._calibrate_acc; all seven matrices must be there, and no other key."""
    content = json.loads(text)
    assert (content.pop("_format_version"), content.pop("cal_type")) == ("2.0.0", "Ferraris")
    k, r, b = (np.array(content.pop(name)) for name in ("K_a", "R_a", "b_a"))
    assert [np.shape(content.pop(name)) for name in ("K_g", "R_g", "K_ga", "b_g")] == [(3, 3)] * 3 + [(3,)]
    assert set(content) == {"acc_unit", "gyr_unit", "from_acc_unit", "from_gyr_unit", "comment"}
    assert np.count_nonzero(k - np.diag(np.diag(k))) == 0
    return lambda readings, _: (np.linalg.inv(r) @ np.linalg.inv(k) @ (readings - b).T).T


def imu_calib(text: str) -> Formula:
    """AccelCalib::loadCalib and applyCalib."""
    lines = dict(line.split(": ") for line in text.splitlines() if not line.startswith("#"))
    matrix, bias = np.reshape(json.loads(lines["SM"]), (3, 3)), np.array(json.loads(lines["bias"]))
    return lambda readings, _: readings @ matrix.T - bias


def _rows(text: str, name: str) -> np.ndarray:
    """A matrix of a YAML file, a row a line."""
    return np.array([json.loads(row) for row in re.findall(r"- (\[.*\])", text.split(f" {name}:\n")[1])[:3]])


def kalibr(text: str) -> Formula:
    """reading = M f + bias, the bias unknown."""
    assert "model: scale-misalignment" in text
    matrix = _rows(text, "M")
    return lambda readings, _: np.linalg.solve(matrix, readings.T).T


def openvins(text: str) -> Formula:
    """Of the inverse of Ta the lower triangle is kept (VioManagerOptions.h); the bias begins at zero."""
    assert text.startswith("%YAML:1.0\n") and 'model: "kalibr"' in text
    da, rotation = np.tril(np.linalg.inv(_rows(text, "Ta"))), _rows(text, "R_IMUtoACC").T
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    return lambda readings, _: readings @ (rotation @ da).T


def imu_tk(text: str) -> Formula:
    """CalibratedTriad_::load and unbiasNormalize."""
    numbers = np.array(text.split(), float)
    t, k, b = numbers[:9].reshape(3, 3), numbers[9:18].reshape(3, 3), numbers[18:]
    np.testing.assert_array_equal(np.diag(t), 1.0)
    assert len(b) == 3 and np.count_nonzero(k - np.diag(np.diag(k))) == 0
    return lambda readings, _: (readings - b) @ (t @ k).T


def vectornav(text: str) -> Formula:
    """The equation of the manual; checksum: all bytes between $ and * by exclusive or."""
    body, checksum = text.removeprefix("$").removesuffix("\r\n").split("*")
    assert int(checksum, 16) == reduce(xor, body.encode())
    name, register, *numbers = body.split(",")
    assert (name, register, len(numbers)) == ("VNWRG", "25", 12)
    c, b = np.array(numbers[:9], np.float32).reshape(3, 3), np.array(numbers[9:], np.float32)
    return lambda readings, _: (readings - b) @ c.T


def table(text: str) -> Formula:
    """The matrix and the offsets of the table."""
    value = {row["name"]: float(row["value"]) for row in csv.DictReader(text.splitlines())}
    c = np.array([[value[f"C{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)])
    return lambda readings, _: (readings - [value["o1"], value["o2"], value["o3"]]) @ c.T


READERS: dict[str, Callable[[str], Formula]] = {
    "px4": px4, "ardupilot": ardupilot, "imucal": imucal, "imu_calib": imu_calib, "kalibr": kalibr,
    "openvins": openvins, "imu_tk": imu_tk, "vectornav": vectornav, "csv": table,
}  # fmt: skip
ROUNDING = {"px4": 3e-6, "ardupilot": 3e-6, "vectornav": 3e-6}
"""Of programs that count with 32 bits, m/s^2."""


HOSTILE = "x\n1\t1\tCOM_ARM_WO_GPS\t1\t6\\\r*/ __attribute__((constructor)) ?\u2028=cmd|'/c calc'!A1"


def _hostile() -> calibration_file.SavedCalibration:
    """A calibration with texts that no file can have, as reading refuses them: exports must not rely on that."""
    own = saved()
    made = own.provenance.model_copy(
        update={"recording": HOSTILE, "created": HOSTILE, "versions": {"kf_calib": HOSTILE}}
    )
    parameters = [each.model_copy(update={"symbol": f"={HOSTILE}", "unit": f"@{HOSTILE}"}) for each in own.parameters]
    return own.model_copy(update={"provenance": made, "parameters": parameters})


@pytest.mark.parametrize("to", TARGETS)
def test_no_text_of_a_file_is_more_than_text_in_an_export(to: str) -> None:
    good, bad = (exported(own, own.correction(), to, lossy=True).text() for own in (saved(), _hostile()))
    if to == "csv":
        cells = [cell for row in csv.reader(good.splitlines()) for cell in row]
        risky = [cell for row in csv.reader(io.StringIO(bad, newline="")) for cell in row]
        assert len(risky) == len(cells)
        assert not [cell for cell in risky if cell[:1] in ("=", "@", "+", "\t", "\r") and cell]
        assert all(re.fullmatch(r"-[0-9.e-]+", cell) for cell in risky if cell.startswith("-"))
        return
    marks = {"c": "//", "imucal": '    "comment":'}

    def told(text: str) -> list[str]:
        return [line for line in text.splitlines() if not line.startswith(marks.get(to, "#"))]

    assert told(bad) == told(good) and len(bad.splitlines()) == len(good.splitlines())
    assert all(each.isprintable() or each in "\n\r\t" for each in bad) and "\\" not in bad


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", " =1", "\uff1d1", "\uff0b1"])
def test_a_cell_never_begins_a_formula(text: str) -> None:
    assert in_cell(text) == f"'{text}"
    assert in_cell("") == "" and in_cell("m/s^2") == "m/s^2"


def test_the_command_names_the_programs_there_are() -> None:
    (option,) = [each for each in command.params if each.name == "to"]
    assert set(option.type.choices) == {*TARGETS, "robot_localization"} and TARGETS.keys() == {*READERS, "c"}


@pytest.mark.parametrize("to", READERS)
def test_what_a_program_holds_it_corrects_as_we_do(to: str) -> None:
    """Sensors that stand straight for those that know no alignment, and have no bias for those that know none."""
    own = correction(
        turned=0.0 if to in ("px4", "ardupilot") else 1e-2, bias=0.0 if to in ("kalibr", "openvins") else 0.05
    )
    # the table's biases are those of the file
    content = saved()
    if to == "csv":
        content, own = content, content.correction()
    target = exported(content, own, to)
    assert target.lost == () and target.error_left is None
    force, temperature = samples()
    found = READERS[to](target.text())(own.predicted(force, temperature), temperature)
    np.testing.assert_allclose(found, own(own.predicted(force, temperature)), rtol=0, atol=ROUNDING.get(to, 1e-13))


@pytest.mark.parametrize("to", ["px4", "ardupilot"])
@pytest.mark.parametrize("names", [("thermal-bias",), ("thermal-bias", "thermal-bias-2"), ("mine = T**3",)])
def test_a_bias_that_follows_the_temperature_is_held_as_a_cubic(to: str, names: tuple[str, ...]) -> None:
    own = correction(*names, turned=0.0)
    target = exported(saved(), own, to)
    assert target.lost == ()
    force, temperature = samples()
    readings = own.predicted(force, temperature)
    assert np.abs(own.predicted(force, 25.0) - readings).max() > 1e-3  # it does matter
    np.testing.assert_allclose(READERS[to](target.text())(readings, temperature), force, rtol=0, atol=5e-6)


@pytest.mark.parametrize("to", ["imucal", "imu_calib", "imu_tk", "vectornav"])
def test_an_effect_that_is_linear_in_the_force_is_held_by_a_matrix(to: str) -> None:
    own = correction("cross-talk")
    target = exported(saved(), own, to)
    assert target.lost == ()
    force, temperature = samples()
    found = READERS[to](target.text())(own.predicted(force, temperature), temperature)
    np.testing.assert_allclose(found, force, rtol=0, atol=ROUNDING.get(to, 1e-12))


LOSSES = [
    ("px4", (), ("alignment",)), ("ardupilot", (), ("alignment",)),
    ("px4", ("thermal-bias", "thermal-scale"), ("alignment", "thermal-scale")),
    ("ardupilot", ("thermal-bias", "second-order"), ("alignment", "second-order")),
    ("kalibr", (), ("bias",)), ("openvins", ("third-order",), ("bias", "third-order")),
    ("imucal", ("second-order",), ("second-order",)), ("imu_calib", ("scale-asymmetry",), ("scale-asymmetry",)),
    ("imu_tk", ("thermal-bias",), ("thermal-bias",)), ("vectornav", ("cross-coupling-ip",), ("cross-coupling-ip",)),
]  # fmt: skip


@pytest.mark.parametrize(("to", "names", "lost"), LOSSES)
def test_the_error_left_is_that_of_readings_at_random(to: str, names: tuple[str, ...], lost: tuple[str, ...]) -> None:
    own = correction(*names)
    with pytest.raises(InputError, match="--lossy"):
        exported(saved(), own, to)
    target = exported(saved(), own, to, lossy=True)
    force, temperature = samples(200_000)
    found = READERS[to](target.text())(own.predicted(force, temperature), temperature)
    errors = np.linalg.norm(found - force, axis=1)
    assert target.lost == lost and target.error_left is not None
    assert target.error_left.rms_mps2 == pytest.approx(np.sqrt(np.mean(errors**2)), rel=0.01)
    assert target.error_left.worst_mps2 == pytest.approx(errors.max(), rel=0.01)


@pytest.mark.parametrize("to", ["px4", "imucal"])
@pytest.mark.parametrize("seen_c", [None, 20.0])
def test_a_drift_is_lost_where_the_run_had_one_temperature(to: str, seen_c: float | None) -> None:
    conditions = saved().conditions.model_copy(update={"temperature_min_c": seen_c, "temperature_max_c": seen_c})
    content = saved().model_copy(update={"conditions": conditions})
    assert exported(content, correction("thermal-bias", turned=0.0), to, lossy=True).lost == ("thermal-bias",)


@pytest.mark.parametrize("to", ["px4", "ardupilot"])
def test_no_other_offset_and_scale_leave_a_smaller_error(to: str) -> None:
    own = correction("second-order")
    target = exported(saved(), own, to, lossy=True)
    force, temperature = samples(50_000)
    readings = own.predicted(force, temperature)
    assert isinstance(target, AffineTarget)
    affine = target.affine
    offset, scale = affine.offset, np.diag(affine.matrix)

    def rms(offset: np.ndarray, scale: np.ndarray) -> float:
        return float(np.sqrt(np.mean(((readings - offset) * scale - force) ** 2)))

    best = rms(offset, scale)
    for i in range(3):
        for sign in (-1.0, 1.0):
            step = sign * np.eye(3)[i]
            assert rms(offset + 1e-2 * step, scale) > best and rms(offset, scale + 1e-3 * step) > best
    assert rms(own.bias_mps2, 1.0 / np.diag(own.sensitivity)) > best


def test_what_ardupilot_does_not_take_is_refused() -> None:
    with pytest.raises(InputError, match=r"INS_ACCOFFS_. would be .* takes -3.5 to 3.5 m/s\^2"):
        exported(saved(), correction(bias=20.0), "ardupilot", lossy=True).text()
    own = correction()
    own.state[:3] *= 1.5
    with pytest.raises(InputError, match=r"INS_ACCSCAL_X would be 0\.\d+, and ArduPilot takes 0.8 to 1.2:"):
        exported(saved(), own, "ardupilot", lossy=True).text()


def test_axes_that_are_not_those_of_the_program_are_refused() -> None:
    own = correction()
    own.state[:3] *= -1.0
    with pytest.raises(InputError, match=r"PX4 takes no scale factor of -.*--channels"):
        exported(saved(), own, "px4", lossy=True).text()
    own = correction(bias=0.0)
    own.state[:8] = np.roll(own.state[:8], 4)  # accelerometers 1 and 2 have changed places
    with pytest.raises(InputError, match=r"imu_tk .*--channels"):
        exported(saved(), own, "imu_tk").text()
    force, temperature = samples(100)  # mirrored: a rotation, and a scale factor that is negative
    found = openvins(exported(saved(), own, "openvins").text())(own.predicted(force), temperature)
    np.testing.assert_allclose(found, force, rtol=0, atol=1e-12)


def test_parameters_that_the_run_did_not_determine_are_refused(run: Any, tmp_path: Path) -> None:
    """In one sentence, for every program; a coefficient of an effect that is not corrected does not matter."""
    content = saved().model_dump(mode="json")
    content["state"]["undetermined"] = ["phi1"]
    content["parameters"][1] |= {"value": None, "sigma": None}
    (tmp_path / "cal.json").write_text(json.dumps(content))
    for to in TARGETS:
        err = run.refused("export", tmp_path / "cal.json", "--to", to, "-o", tmp_path / "out", "--lossy")
        assert "did not determine phi1" in err
    assert not (tmp_path / "out").exists()
    with pytest.raises(UnobservableError):
        calibration_file.open_calibration(tmp_path / "cal.json").correction()


@pytest.mark.parametrize(
    ("turned", "bias", "in_use"), [(1e-2, 0.5, True), (0.0, 0.5, False), (1e-2, 1e-4, False), (0.0, 1e-4, False)]
)
def test_offsets_and_changes_of_scale_below_a_hundredth_may_not_be_in_use(
    turned: float, bias: float, in_use: bool
) -> None:
    """By the length of the vector of either: scale factors of sensors that are turned by nothing change by 0.002."""
    remarks = exported(saved(), correction(turned=turned, bias=bias), "px4", lossy=True).remarks
    assert [remark.partition(",")[0] for remark in remarks] == ["some releases of PX4 ignore offsets"] * (not in_use)


def test_the_command_says_what_is_lost_and_needs_leave_for_it(run: Any, tmp_path: Path) -> None:
    cal, out = tmp_path / "cal.json", tmp_path / "out.param"
    calibration_file.write_calibration(cal, saved())
    err = run.refused("export", cal, "--to", "px4", "-o", out, "--units", "si")
    assert not out.exists()
    rms, worst = map(float, re.findall(r"([\d.]+) m/s\^2", err))
    found = run.json("export", cal, "--to", "px4", "-o", out, "--lossy")
    assert (found["out"], found["format"], found["lost"]) == (str(out), "px4", ["alignment"])
    assert found["error_left_rms_mps2"] == pytest.approx(rms, rel=0.01)
    assert found["error_left_worst_mps2"] == pytest.approx(worst, rel=0.01)
    assert "some releases of PX4 ignore" in found["warnings"][0]  # these sensors are good to 0.001
    assert run.json("export", cal, "--to", "csv", "-o", tmp_path / "out.csv")["error_left_rms_mps2"] is None


def test_a_comment_holds_no_name_that_could_end_it() -> None:
    made = saved().provenance.model_copy(update={"recording": "a */ \\\\ # ${x} 'b'\".mcap"})
    text = exported(saved().model_copy(update={"provenance": made}), correction(), "c").text()
    assert "a_x_b_.mcap" in text


def test_the_table_has_every_parameter_coefficient_and_constant(run: Any, tmp_path: Path) -> None:
    cal = tmp_path / "cal.json"
    run("replay", RECORDINGS / "navigation_24.mcap", "--with", "second-order", "--save", cal)
    code, _, err = run("export", cal, "--to", "csv", "-o", tmp_path / "out.csv")
    assert code == 0, err
    rows = {row["name"]: row for row in csv.DictReader((tmp_path / "out.csv").read_text().splitlines())}
    expected = {*paper_parameters.SYMBOLS, "K2_1", "K2_2", "K2_3"}
    expected |= {f"{name}{i}" for name in ("channel", "count", "o") for i in (1, 2, 3)}
    assert rows.keys() == expected | {f"{name}{i}{j}" for name in "CE" for i in (1, 2, 3) for j in (1, 2, 3)}
    assert "dZone,0.0001,,m/s^2" in exported(saved(), correction("dead-zone"), "csv").text().splitlines()
    for own in calibration_file.open_calibration(cal).parameters:
        assert float(rows[own.symbol]["value"]) == own.value and rows[own.symbol]["unit"] == own.unit
