"""A calibration file holds all of a calibration, and refuses what is none in one sentence."""

import copy
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.calibrations import SENSORS, simulated, warming_up
from helpers.command_line import CommandLine
from helpers.paths import ROOT

import kf_calib
from kf_calib import effects
from kf_calib.bench import paper_parameters
from kf_calib.bench.bench import Bench
from kf_calib.errors import InputError
from kf_calib.exchange import calibration_file
from kf_calib.sources.simulation.sensors import TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import PlannedVisit

SCHEMA = ROOT / "kf_calib" / "exchange" / "calibration.schema.json"
OWN = '''
from kf_calib.effects import SensorEffect


class Cube(SensorEffect):
    """a^3, once more."""

    name, title, source = "my-cube", "my cube", "me"
    symbol, unit, scale = "Cu", "s^4/m^2", 1e-5

    def terms(self, s):
        return s.along**3
'''


@pytest.fixture(scope="module")
def run() -> kf_calib.Calibration:
    settings = kf_calib.Settings(effects=("second-order", "warm-up", "mine = fx*fy"))
    return kf_calib.calibrate(warming_up(0, 14), settings)


@pytest.fixture(scope="module")
def content(run: kf_calib.Calibration) -> dict[str, Any]:
    return calibration_file.saved(run).model_dump(mode="json")


def test_the_schema_in_the_package_is_that_of_the_program() -> None:
    made = json.dumps(calibration_file.schema(), indent=1) + "\n"
    assert SCHEMA.read_text() == made, (
        "write it anew: python -c 'import json; from kf_calib.exchange import calibration_file as c; "
        f"print(json.dumps(c.schema(), indent=1))' > {SCHEMA.relative_to(ROOT)}"
    )
    patterns = re.findall(r'"pattern": (".*")', made)
    assert patterns and not any(r"\\A" in each or r"\\z" in each for each in patterns)  # which JSON Schema has not


def test_a_constant_that_was_held_is_no_state_and_is_read_again_as_it_is(tmp_path: Path) -> None:
    """Of a run that does not warm up, the time constant is at an end of its range."""
    result = kf_calib.calibrate(simulated(0, 14), kf_calib.Settings(effects=("warm-up",)))
    kf_calib.save_calibration(result, tmp_path / "cal.json")
    saved = kf_calib.open_calibration(tmp_path / "cal.json")
    (effect,) = saved.model().effects
    (fitted,) = result.model.effects
    assert effect.held and fitted.held and effect.value == fitted.value
    assert saved.state.symbols[12:] == ["B1", "B2", "B3"] and not saved.state.undetermined
    assert saved.parameters[-1].symbol == "tauWarm" and saved.parameters[-1].value is None
    assert all(np.isfinite(visit.innovation_mps2).all() for visit in result.visits[6:])


def test_what_is_saved_is_read_again(run: kf_calib.Calibration, tmp_path: Path) -> None:
    kf_calib.save_calibration(run, tmp_path / "cal.json")
    saved = kf_calib.open_calibration(tmp_path / "cal.json")
    assert saved == calibration_file.saved(run).model_copy(update={"provenance": saved.provenance})
    np.testing.assert_array_equal(saved.state.values, run.estimate.state)
    np.testing.assert_array_equal(saved.state.covariance, run.estimate.covariance)
    values, covariance = saved.twelve
    np.testing.assert_array_equal(values, run.estimate.parameters)
    np.testing.assert_allclose(covariance, run.estimate.parameter_covariance, rtol=1e-12)
    model = saved.model()
    assert model.sum == run.model.sum
    assert [each.value for each in model.effects] == [each.value for each in run.model.effects]
    readings = np.array([[0.1, 9.8, -0.1], [5.0, 5.0, 7.0]])
    np.testing.assert_array_equal(saved.correction()(readings), run.apply(readings).force_mps2)


@pytest.mark.parametrize("axes", ["y z x", "0.6,0.8,0 z", "z x z y"])
def test_any_bench_is_kept(axes: str) -> None:
    bench = Bench.from_metadata({"axes": axes, "gravity_mps2": "9.8012345678901234", "up": "z", "block_serial": "A 7"})
    rng = np.random.default_rng(0)
    plan = [PlannedVisit(tuple(rng.uniform(-180, 180, len(bench.axes))), 3.0) for _ in range(8)]
    source = Simulation(bench, SENSORS, TrueNoise(white_mps2=5e-5), plan, sample_hz=20.0, slew_rate_degps=np.inf)
    saved = calibration_file.saved(kf_calib.calibrate(source))
    assert saved.bench == bench and saved.bench.notes["block_serial"] == "A 7"


def test_a_recording_gives_its_name_checksum_and_date(tmp_path: Path) -> None:
    path = ROOT / "recordings" / "mems_faces.mcap"
    kf_calib.save_calibration(kf_calib.calibrate(path), tmp_path / "cal.json", path)
    saved = kf_calib.open_calibration(tmp_path / "cal.json")
    assert saved.provenance.recording == "mems_faces.mcap"
    assert saved.provenance.sha256 == calibration_file.fingerprint(path)
    assert saved.conditions.began is not None and saved.conditions.began.startswith("2025-06-15T15:06:4")
    assert saved.conditions.temperature_mean_c == pytest.approx(25.0, abs=5.0)


def test_the_model_option_reads_its_effects(run: kf_calib.Calibration, tmp_path: Path) -> None:
    kf_calib.save_calibration(run, tmp_path / "named.toml")  # what is in it decides, not its name
    assert calibration_file.read_model(tmp_path / "named.toml").effects == ("second-order", "warm-up", "mine = fx*fy")


def test_programs_are_run_only_where_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own, cal, recording = tmp_path / "my.py", tmp_path / "cal.json", ROOT / "recordings" / "navigation_24.mcap"
    own.write_text(OWN)
    monkeypatch.chdir(tmp_path)

    def called(*words: object) -> tuple[int, str, str]:
        """Where no effect of a user's is known yet."""
        monkeypatch.setattr(effects, "_registered", {})
        return CommandLine()(*words)

    code, _, err = called("replay", recording, "--with", "my-cube", "--effects-from", own, "--save", cal)
    assert code == 0, err
    for words in (["replay", recording, "--model", cal], ["verify", cal, recording]):
        code, _, err = called(*words)
        assert code == 2 and "would run the Python file" in err and err.count("\n") == 1
        assert called(*words, "--trust")[0] == called(*words, "--effects-from", own)[0] == 0


def put(*path: str | int, value: object) -> Callable[[dict[str, Any]], None]:
    def change(content: Any) -> None:
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = value

    return change


def scaled_covariance(factor: float) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content["state"]["covariance"] = (factor * np.array(content["state"]["covariance"])).tolist()

    return change


def correlated(content: dict[str, Any]) -> None:
    """Symmetric, of positive variances, and no covariance: a correlation of 2."""
    covariance = content["state"]["covariance"]
    covariance[1][2] = covariance[2][1] = 2.0 * math.sqrt(covariance[1][1] * covariance[2][2])


def mean_temperature_of(mean_c: float) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        names = ("temperature_min_c", "temperature_mean_c", "temperature_max_c")
        content["conditions"] |= dict(zip(names, (20.0, mean_c, 30.0), strict=True))

    return change


def dependent_axes(content: dict[str, Any]) -> None:
    """Accelerometers 1 and 3 along one axis, and every number that follows from it as it must be."""
    state = np.array(content["state"]["values"])
    state[8:11] = state[0:3]
    content["state"]["values"] = state.tolist()
    jacobian = paper_parameters.jacobian(state[:12])
    covariance = jacobian @ np.array(content["state"]["covariance"])[:12, :12] @ jacobian.T
    sigmas, values = np.sqrt(np.diag(covariance)), paper_parameters.parameters_of(state[:12])
    for own, value, sigma in zip(content["parameters"], values.tolist(), sigmas.tolist(), strict=False):
        own |= {"value": value, "sigma": sigma}


BROKEN: dict[str, tuple[str | Callable[[dict[str, Any]], None], str]] = {
    "empty": ("", "is no JSON"),
    "text": ("hello", "is no JSON"),
    "list": ("[]", "is no calibration"),
    "nested": ("[" * 100_000, "is no JSON"),
    "long number": ('{"format": "kf_calib.calibration", "x": ' + "9" * 5000 + "}", "is no JSON"),
    "another format": (put("format", value="x"), "is no calibration"),
    "another version": (put("version", value=2), "is of version 2, this program reads version 1"),
    "key too many": (put("foo", value=1), "foo: Extra inputs"),
    "NaN": (put("state", "values", 0, value=math.nan), "state.values.0: Input should be a finite number"),
    "infinite": (put("noise", "sigma_mps2", 0, value=math.inf), "noise.sigma_mps2.0"),
    "huge": (put("state", "values", 0, value=1e300), "parameters say theta1"),
    "huge variance": (put("state", "covariance", 0, 0, value=1e308), "numbers that no calibration has"),
    "negative variance": (put("state", "covariance", 0, 0, value=-1.0), "is no covariance"),
    "zero variance": (scaled_covariance(0.0), "no positive variance of sx1"),
    "another covariance": (scaled_covariance(4.0), "parameters say theta1 has sigma"),
    "not positive definite": (correlated, "is no covariance: it has a negative variance"),
    "another sigma": (put("parameters", 3, "sigma", value=1.0), "parameters say b1 has sigma 1.0, but its covariance"),
    "another coefficient": (put("parameters", 12, "value", value=96170384.0), "= 96170384.0, but its state says"),
    "another sigma of a coefficient": (put("parameters", 12, "sigma", value=1e-30), "has sigma 1e-30"),
    "another unit of a coefficient": (put("parameters", 12, "unit", value="1"), "after the twelve, as its effects"),
    "another symbol": (put("parameters", 12, "symbol", value="q1"), "after the twelve, as the state has"),
    "a parameter too few": (lambda content: content["parameters"].pop(), "after the twelve"),
    "a parameter too many": (
        lambda content: content["parameters"].append(content["parameters"][12] | {"symbol": "x"}),
        "after the twelve, as its effects",
    ),
    "another nominal value": (put("parameters", 0, "nominal", value=0.1), "theta1 is nominally 0.1, but its bench"),
    "a constant left out": (put("effects", 1, "constant", value=None), "warm-up has the constant None"),
    "a constant out of its range": (put("effects", 1, "constant", value=1e9), "has the constant 1000000000.0"),
    "a constant of an effect without": (put("effects", 0, "constant", value=3.0), "has the constant 3.0"),
    "determined and not": (put("state", "undetermined", value=["b1"]), "whether b1 was determined"),
    "an unknown symbol": (put("state", "undetermined", value=["zz"]), "state.undetermined names zz"),
    "an effect twice": (put("effects", 2, "text", value="second-order"), "effects names 'second-order' twice"),
    "effects without coefficients": (
        lambda content: content["effects"].extend({"text": f"f{k} = fx*T", "constant": None} for k in range(9)),
        "there are 12 effects, but only 10 coefficients",
    ),
    "no date": (put("conditions", "began", value="yesterday"), "conditions.began is 'yesterday', which is no date"),
    "no date of saving": (put("provenance", "created", value="1"), "provenance.created is '1', which is no date"),
    "a date beyond time": (put("conditions", "began", value="9999-12-31T23:59:59+00:00"), "is no date"),
    "a duration beyond time": (put("conditions", "duration_s", value=1e300), "conditions.duration_s"),
    "a duration of five thousand years": (put("conditions", "duration_s", value=1.5e11), "conditions.duration_s"),
    "a negative count": (put("conditions", "dwells", 0, "readings", value=-5), "conditions.dwells.0.readings"),
    "negative degrees of freedom": (put("consistency", "dof", value=-3), "consistency.dof"),
    "a probability above 1": (put("consistency", "p_value", value=1.5), "consistency.p_value"),
    "a verdict of its own": (put("consistency", "p_value", value=1e-9), "which is not what its p_value says"),
    "a gimbal too many": (put("conditions", "dwells", 0, "gimbal_deg", value=[0.0] * 4), "has 4 gimbal angles"),
    "a dwell that ends first": (put("conditions", "dwells", 1, "end_s", value=-9.0), "number 2 ends before it begins"),
    "a mean that is none": (mean_temperature_of(99.0), "a mean temperature that is not between"),
    "a line end in a text": (
        put("provenance", "created", value="2026-01-01\n#include"),
        "provenance.created: it must be text on one line, without control characters",
    ),
    "a tab in a text": (put("provenance", "versions", "kf_calib", value="1\t1"), "provenance.versions.kf_calib"),
    "axes in a plane": (dependent_axes, "three input axes that lie in one plane"),
    "not symmetric": (put("state", "covariance", 0, 1, value=1.0), "is no symmetric matrix"),
    "too small": (put("state", "covariance", value=[[1.0]]), "is no symmetric matrix"),
    "text for a list": (put("effects", value="second-order"), "effects: Input should be a valid list"),
    "true for a number": (put("consistency", "dof", value=True), "consistency.dof"),
    "zeros": (put("state", "values", value=[0.0] * 22), "parameters say theta1"),
    "other symbols": (put("state", "symbols", 0, value="q"), "other symbols"),
    "axes": (put("provenance", "bench", "axes", value="q"), "provenance.bench: axis 'q' is not known"),
    "contradiction": (put("parameters", 0, "value", value=1.0), "parameters say theta1 = 1.0"),
    "command of a terminal": (put("provenance", "recording", value="\x1b[2J"), "provenance.recording"),
    "no such effect": (put("effects", 0, "text", value="no-such"), "no effect is called 'no-such'"),
    "a formula that is a program": (put("effects", 2, "text", value="x = __import__('os')"), "not a function"),
    "an effect too few": (put("effects", value=[]), "was saved by another version"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_is_no_calibration_is_refused_in_a_sentence(kind: str, content: dict[str, Any], tmp_path: Path) -> None:
    change, says = BROKEN[kind]
    path, changed = tmp_path / "broken.json", copy.deepcopy(content)
    if isinstance(change, str):
        path.write_text(change)
    else:
        change(changed)
        path.write_text(json.dumps(changed))
    with pytest.raises(InputError) as error:
        kf_calib.open_calibration(path).correction(path)
    assert says in str(error.value) and "\n" not in str(error.value) and str(error.value).endswith((".", "?"))
