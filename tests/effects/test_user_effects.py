"""Effects of the user's own: formulas, classes in files and packages, model files, and the checks they must pass."""

import hashlib
import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.own_effect import TEN_LINES
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from kf_calib import effects
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.effects import (
    Bearer,
    RotationEffect,
    SensorEffect,
    as_text,
    checks,
    effect_named,
    load_file,
    names,
    register,
    remarks_of,
)
from kf_calib.effects.checks import EXAMPLE, trial
from kf_calib.effects.expression import LENGTH_LIMIT
from kf_calib.effects.formula import Formula, formula, quantities
from kf_calib.errors import InputError
from kf_calib.estimation import model_file
from kf_calib.estimation.calibration import calibrate
from kf_calib.estimation.measurement_model import Model
from kf_calib.estimation.settings import Settings
from kf_calib.sources.simulation.injected import parse
from kf_calib.sources.simulation.physics import Ambient
from kf_calib.sources.simulation.sensors import GRADES, TrueNoise
from kf_calib.sources.simulation.simulator import Simulation
from kf_calib.sources.simulation.visit_plans import spread_plan
from kf_calib.views.console import model_table, plain

BENCH = checks.EXAMPLE


@pytest.fixture(autouse=True)
def nothing_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effects, "_registered", {})


def made(expression: str, bench: Bench = BENCH) -> Formula:
    effect = effect_named(f"mine = {expression}", bench)
    assert isinstance(effect, Formula)
    return effect


# Formulas


@pytest.mark.parametrize(
    "expression, name",
    [
        ("a*p", "cross-coupling-ip"), ("a*o", "cross-coupling-io"), ("a**2", "second-order"), ("a**3", "third-order"),
        ("0.5*abs(a)", "scale-asymmetry"), ("0.5*sign(a)", "bias-asymmetry"), ("t", "bias-drift"),
        ("t*a", "scale-drift"), ("T", "thermal-bias"), ("T**2", "thermal-bias-2"), ("T*a", "thermal-scale"),
    ],
)  # fmt: skip
def test_a_formula_is_the_class_it_spells_out(expression: str, name: str) -> None:
    """Columns equal to the last bit, and the unit that the catalogue states."""
    effect, theirs, stimulus = made(expression), effect_named(name, BENCH), checks.trial(BENCH)
    np.testing.assert_array_equal(effect.columns(stimulus), theirs.columns(stimulus))
    assert [c.symbol for c in effect.coefficients] == ["mine1", "mine2", "mine3"]
    assert effect.coefficients[0].unit == theirs.coefficients[0].unit
    if not name.endswith("-drift"):  # told by the hour there
        shown = theirs.coefficients[0]
        assert effect.coefficients[0].shown_unit == shown.shown_unit
        assert effect.coefficients[0].per_si == pytest.approx(shown.per_si)


def test_a_formula_gives_the_calibration_of_its_class() -> None:
    source = Simulation(
        Bench(axes_of("yzx"), 9.81, angle_sigma_deg=0.0, scatter_sigma_mps2=0.0), GRADES["navigation"].sensors(5),
        TrueNoise(white_mps2=5e-5), spread_plan(16, dwell_s=4.0, seed=4), sample_hz=20.0, slew_rate_degps=360.0, seed=5,
        ambient=Ambient(swing_c=5.0, period_s=60.0), hidden=parse(["cross-coupling-ip=4ug/g^2"], BENCH.axes, seed=5),
    )  # fmt: skip
    ours, theirs = (calibrate(source, Settings(effects=(name,))) for name in ("mine = a*p", "cross-coupling-ip"))
    np.testing.assert_allclose(ours.estimate.state, theirs.estimate.state, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(ours.estimate.effect_sigma, theirs.estimate.effect_sigma, rtol=1e-9)
    assert "mine = a*p" in str(ours)


@pytest.mark.parametrize(
    "expression, unit, shown",
    [
        ("fx*fy*T", "s^2/m/K", "µg/g²/K"),
        ("dT", "m/s/K", "µg s/K"),
        ("q1*T", "m/rad/s^2/K", "µg/rad/K"),
        ("sin(q1)*g", "1", "ppm"),
        ("exp(-tau/(60*s))*da", "1", "ppm"),
        ("(abs(a) < 0.01*g)*a", "1", "ppm"),
        ("maximum(a, 0)", "1", "ppm"),
        ("sqrt(abs(a))", "m^0.5/s", "m^0.5/s"),
        ("2**(T/(10*K))", "m/s^2", "µg"),
        ("a/(9.81*m/s**2)", "m/s^2", "µg"),
    ],
)
def test_units_follow_from_the_quantities(expression: str, unit: str, shown: str) -> None:
    coefficient = made(expression).coefficients[0]
    assert (coefficient.unit, coefficient.shown_unit) == (unit, shown)


@pytest.mark.parametrize("expression", ["fx*fy*T", "a**3", "t", "q_z", "dT", "a"])
def test_a_coefficient_of_its_scale_adds_about_a_milli_mps2(expression: str) -> None:
    effect = made(expression)
    rms = np.sqrt(np.mean(effect.terms(checks.trial(BENCH)) ** 2))
    assert 3e-4 < rms * effect.coefficients[0].scale < 3.2e-3


def test_gimbals_are_named_by_number_letter_and_place() -> None:
    stimulus = checks.trial(BENCH)
    for name, k in [("q1", 0), ("q_y", 0), ("outer", 0), ("q2", 1), ("q_z", 1), ("q3", 2), ("inner", 2)]:
        np.testing.assert_array_equal(made(name).terms(stimulus)[:, 1], stimulus.pose[:, k])
    twice = quantities(axes_of("zyz"))
    assert {"q1", "q2", "q3", "q_y"} <= set(twice) and "q_z" not in twice
    with pytest.raises(InputError, match="no quantity is called q1"):
        made("q1", Bench((), 9.81))  # attitude only


REFUSED = {
    "fx + T": "m/s^2 and K cannot be added",
    "maximum(a, T)": "m/s^2 and K cannot be compared",
    "a > 1": "m/s^2 and 1 cannot be compared",
    "exp(tau)": "what exp is taken of must be a number without unit, and here it is in s: divide what is in it",
    "sin(fx)": "in m/s^2: divide what is in it by a constant of that unit, for example by (10*m/s**2)",
    "a**T": "an exponent must be a number without unit",
    "a**20": "a power of 20 is too high",
    "temperature": "did you mean T or dT? Known are fx fy",
    "Fx": "did you mean fx?",
    "arctan2(a, p)": "arctan2 is not a function of formulas: use sin cos",
    "sin(a, p)": "sin takes 1 value",
    "sin": "sin is a function",
    "": "no formula after the equals sign",
    "a *": "not a formula (invalid syntax",
    "0*a": "adds nothing",
    "log(T/K)": "T = -",
    "1/(p - p)": "not finite",
    "1e200*a": "values up to",
    "a < p < o": "more than two",
}


@pytest.mark.parametrize("expression", REFUSED)
def test_what_cannot_be_meant_is_refused_with_a_sentence(expression: str) -> None:
    with pytest.raises(InputError, match=re.escape(REFUSED[expression])):
        made(expression)


HOSTILE = [
    "9**9**9", "9**9**9**9", "().__class__.__bases__", "__import__('os').system('true')", "[x for x in (1, 2)]",
    "(lambda: 1)()", "'x'*10**9", "a.__class__", "a[0]", "f'{a}'", "open('/etc/passwd')", "sin.__self__",
    "a if T else p",
    "x" * 10_000, "a" + "+a" * 5_000, "-" * 250 + "a", "9" * 290, "1j*a", "True", "a := 1",
    "a; a", "a\na", "\0", "import os", "sin(*[a])", "sin(x=a)", "{1: a}", "yield a", "await a", "a @ p", "...",
    "a == a", "[" + "-" * 250 + "a]", "(" * 290 + "a",
]  # fmt: skip


@pytest.mark.parametrize("expression", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_texts_are_refused_with_a_sentence(expression: str) -> None:
    with pytest.raises(InputError) as raised:
        made(expression)
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 2 * LENGTH_LIMIT + 100


# fmt: off
WORDS = ["a", "fx", "T", "tau", "q1", "sin", "exp", "sqrt", "maximum", "1e9", "0", "2", "(", ")", "+", "-", "*", "/",
         "**", "<", ",", " ", ".", "_", "[", "]", "'", "=", "lambda", "if", "for", ":", "\\", "\n", "#", "é"]
# fmt: on


@pytest.mark.parametrize("examples", [20, *slow(500)])
def test_any_text_is_a_finite_effect_or_a_sentence(examples: int) -> None:
    @settings(max_examples=examples, deadline=None, database=None)
    @given(st.one_of(st.text(max_size=40), st.lists(st.sampled_from(WORDS), max_size=14).map("".join)))
    def tried(text: str) -> None:
        try:
            effect = effect_named(f"mine = {text}", BENCH)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert np.isfinite(effect.columns(checks.trial(BENCH))).all()

    tried()


@pytest.mark.parametrize(
    "text, says",
    [
        ("second-order = a*a", "second-order is the name of an effect of the catalogue.*my-second-order = a"),
        ("encoder-scale = a*a", "of the catalogue"),
        ("K = a*a", "coefficient K1, which is one of the twelve parameters"),
        ("beta = a*a", "coefficient beta1, which is one of bias-drift"),
        ("my effect = a*a", "cannot name an effect: write NAME = FORMULA"),
        (" = a", "cannot name an effect"),
        ("a <= p", "cannot name an effect"),
        ("x" * 41 + " = a", "at most 40"),
        ("mine:z = a*a", "one for the whole block"),
        ("mine:w = q1", "names no gimbal"),
        (":z = q1", "cannot name"),
    ],
)
def test_names_of_formulas(text: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        effect_named(text, BENCH)


def test_symbols_of_a_name_that_ends_in_a_digit() -> None:
    assert [c.symbol for c in effect_named("x2 = a*a", BENCH).coefficients] == ["x2_1", "x2_2", "x2_3"]


def test_a_formula_that_fails_on_measured_data_says_where() -> None:
    """1/T is finite on the trial, and not where no temperature was recorded."""
    effect, stimulus = made("1/T"), checks.trial(BENCH)
    stimulus.temperature_c[7] = np.nan
    with pytest.raises(InputError, match=r"mine is not finite at 35 s, where .* T = 0 K"):
        effect.columns(stimulus)


# Classes of the user's


def written(folder: Path, text: str, name: str = "own.py") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_class_of_ten_lines_is_completed(tmp_path: Path) -> None:
    assert load_file(written(tmp_path, TEN_LINES)) == ["bend"]
    effect = effect_named("bend", BENCH)
    assert (effect.title, effect.source) == ("bend", "user") and names(BENCH)[-1] == "bend"
    first = effect.coefficients[0]
    assert (first.symbol, first.unit, first.scale, first.shown_unit) == ("bend1", "s^2/m", 1, "µg/g²")
    assert load_file(tmp_path / "own.py") == ["bend"]  # again: replaces
    assert not list(tmp_path.glob("__pycache__"))


SENSOR = "from kf_calib.effects import *\nclass Own(SensorEffect):\n    def terms(self, s):\n        "
FRAME = """from kf_calib.effects import *
import numpy as np
class Own(RotationEffect):
    coefficients = (Coefficient("own", "rad", 1e-3, "rad", 1.0),)
    def rotations(self, s):
        return np.zeros((len(s), 1, 3)) + [0.0, 0.0, 1.0]
"""
DECAY = (
    SENSOR
    + """return s.step * np.exp(-s.since_arrival_s / self.value)[:, None]
    unknown, value = Unknown("tauOwn", "s", 1.0, 100.0, "s", 1.0), 10.0
    def derivative(self, s, coefficients):
        return (s.since_arrival_s / self.value)[:, None, None] * (self.columns(s) @ coefficients)[:, :, None]
import numpy as np
"""
)
BAD_FILES = {
    "no file": (None, "own.py: cannot be read"),
    "syntax": ("import os\ndef f(:\n", "own.py, line 2: cannot be run (SyntaxError"),
    "fails": ("x = 1\ny = x / 0\n", "own.py, line 2: cannot be run (ZeroDivisionError: division by zero)"),
    "fails deeper": ("import json\n\njson.loads('{')\n", "own.py, line 3: cannot be run (JSONDecodeError"),
    "exits": ("import sys\nsys.exit(3)\n", "own.py, line 2: cannot be run (SystemExit"),
    "binary": ("\0\0", "own.py"),
    "no effect": ("from kf_calib.effects import SensorEffect\n", "own.py: defines no effect"),
    "abstract": ("from kf_calib.effects import *\nclass Own(SensorEffect):\n    pass\n", "class Own of .*lacks terms"),
    "arguments": (SENSOR + "pass\n    def __init__(self, size): ...\n", "cannot be made without arguments"),
    "catalogue": (SENSOR + "return s.along**2\n    name = 'second-order'\n", "already has an effect second-order"),
    "twice": (TEN_LINES + TEN_LINES.replace("Bend(", "BEND("), "own.py defines an effect bend: rename one of the two"),
    "name": (SENSOR + "return s.along**2\n    name = 'a b'\n", "is called 'a b'"),
    "symbol": (SENSOR + "return s.along**2\n    symbol = 'K'\n", "coefficient K1, which is one of the twelve"),
    "raises": (SENSOR + "return s.temp**2\n", "own: its columns failed at .*own.py, line 4 (AttributeError"),
    "shape": (SENSOR + "return s.elapsed_s[:7]\n", "own: its columns failed"),
    "not finite": (SENSOR + "return s.step / s.step\n", "own is not finite at 1 s, where a ="),
    "writes": (SENSOR + "s.along[:] *= 2.0\n        return s.along**2\n", "own writes into along"),
    "nothing": (SENSOR + "return 0.0 * s.along\n", "own adds nothing to any reading"),
    "rotations": (FRAME.replace("1, 3)", "2, 3)"), "rotations have the shape"),
    "derivative": (FRAME + "    def columns(self, s):\n        return 2.0 * super().columns(s)\n", "finite rotation"),
    "slope": (DECAY.replace("return (s.since", "return 2 * (s.since"), "own: its derivative is"),
    "columns": (FRAME + "    def columns(self, s):\n        return s.along\n", "columns have the shape (300, 3)"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_are_one_sentence(tmp_path: Path, name: str) -> None:
    text, says = BAD_FILES[name]
    path = tmp_path / "own.py" if text is None else written(tmp_path, text)
    with pytest.raises(InputError, match=says.replace("(", r"\(").replace(")", r"\)")) as raised:
        load_file(path)
    assert "\n" not in str(raised.value)


def test_an_effect_of_the_users_is_of_either_unless_it_says(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    own = TEN_LINES.replace("Bend", "Wobble").replace("    unit", "    borne_by = Bearer.BENCH\n    unit")
    path.write_text(TEN_LINES + own.replace("import SensorEffect", "import Bearer, SensorEffect"))
    load_file(path)
    assert effect_named("bend", BENCH).borne_by is Bearer.EITHER
    assert effect_named("wobble", BENCH).borne_by is Bearer.BENCH
    assert effect_named("mine = a*p", BENCH).borne_by is Bearer.EITHER
    assert effect_named("mine:z = sin(3*q_z)", BENCH).borne_by is Bearer.EITHER


def test_a_frame_effect_of_the_users_passes(tmp_path: Path) -> None:
    assert load_file(written(tmp_path, FRAME)) == ["own"] and remarks_of(effect_named("own", BENCH)) == ()


def test_an_effect_with_an_unknown_of_the_users_passes(tmp_path: Path) -> None:
    load_file(written(tmp_path, DECAY))
    assert effect_named("own", BENCH).at(20.0).value == 20.0


def test_two_files_with_one_name(tmp_path: Path) -> None:
    load_file(written(tmp_path, TEN_LINES))
    with pytest.raises(InputError, match=r"own.py and .*other.py both define an effect bend: rename"):
        load_file(written(tmp_path, TEN_LINES, "other.py"))
    with pytest.raises(InputError, match=r"bend is the name of an effect of .*own.py"):
        effect_named("bend = a*a", BENCH)


def test_an_effect_that_needs_the_whole_run_is_remarked_on(tmp_path: Path) -> None:
    load_file(written(tmp_path, SENSOR + "return s.along - s.along.mean(axis=0)\n"))
    assert "when others are left out" in remarks_of(effect_named("own", BENCH))[0]


def test_a_class_that_fails_on_measured_data_says_where(tmp_path: Path) -> None:
    load_file(written(tmp_path, SENSOR + "return 1.0 / (s.along - 1.25)\n"))
    stimulus = checks.trial(BENCH)
    stimulus.force_mps2[3] = 1.25
    with pytest.raises(InputError, match="own is not finite"):
        effect_named("own", BENCH).columns(stimulus)


def test_register_is_a_decorator() -> None:
    @register
    class OwnIdea(SensorEffect):
        def terms(self, s):
            return s.along * s.step

    assert OwnIdea.name == "own-idea" and "own-idea" in names(BENCH) and register(OwnIdea) is OwnIdea


@pytest.mark.parametrize("name", names(BENCH))
def test_the_catalogue_passes_the_checks(name: str) -> None:
    effect = effect_named(name, BENCH)
    checks.check_effect(effect)
    if isinstance(effect, RotationEffect):
        assert checks.trial(BENCH).force_mps2.shape == (300, 3)


# The command line and model files


@pytest.fixture(scope="module")
def recording(run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("user") / "run.mcap"
    words = ["--orientations", 14, "--dwell-s", 4, "--slew-degps", 360, "--sample-hz", 25, "--temperature-swing", 5]
    assert run("simulate", path, *words, "--hide", "second-order=40ug/g^2", "--seed", 3)[0] == 0
    return path


def test_a_class_file_through_the_command_line(run, recording: Path, tmp_path: Path) -> None:
    """Ten lines mend the misfit, and find what the catalogue's class finds."""
    own = written(tmp_path, "print('loading')\n" + TEN_LINES)
    code, out, err = run("replay", recording, "--json", "--effects-from", own, "--with", "bend")
    mine, theirs = json.loads(out), run.json("replay", recording, "--with", "second-order")
    assert code == 0 and "loading" in err
    assert mine["model"] == ["bend"] and mine["consistency"]["consistent"] is True
    for one, other in zip(mine["parameters"], theirs["parameters"], strict=True):
        assert one["value"] == pytest.approx(other["value"], rel=1e-9, abs=1e-3 * one["sigma"])
    assert run.json("replay", recording)["consistency"]["consistent"] is False


def test_a_model_file_gives_the_same_again(run, recording: Path, tmp_path: Path) -> None:
    own, saved = written(tmp_path, TEN_LINES), tmp_path / "deep" / "model.toml"
    saved.parent.mkdir()
    words = ["--effects-from", own, "--with", "bend", "--with", "mine = fx*fy*T", "--with", "bias-drift"]
    code, first, _ = run("replay", recording, "--json", *words, "--save-model", saved)
    assert code == 0 and [path.name for path in saved.parent.iterdir()] == ["model.toml"]
    effects._registered.clear()
    assert run("replay", recording, "--json", "--model", saved, "--effects-from", own)[1] == first
    table, result = tomllib.loads(saved.read_text()), json.loads(first)
    assert table["effects"] == ["bend", "mine = fx*fy*T", "bias-drift"] and table["effects_from"] == ["../own.py"]
    assert table["sha256"] == {"../own.py": hashlib.sha256(own.read_bytes()).hexdigest()}
    assert [c["symbol"] for c in table["coefficients"]] == [p["symbol"] for p in result["parameters"][12:]]
    assert table["coefficients"][3]["unit"] == "s^2/m/K"
    again = ["--with", "mine=fx * fy * T", "--with", "bend", "--with", "hysteresis"]  # merged, the file's first
    assert json.loads(run("replay", recording, "--json", "--model", saved, "--trust", *again)[1])["model"] == [
        "bend", "mine", "bias-drift", "hysteresis",
    ]  # fmt: skip


def test_a_model_that_cannot_be_saved_leaves_the_old_one(run, recording: Path, tmp_path: Path) -> None:
    saved = written(tmp_path, "effects = []\n", "model.toml")
    err = run.refused("replay", recording, "--save-model", tmp_path / "absent" / "model.toml")
    assert "cannot be created" in err
    run.refused("replay", recording, "--with", "mine = a + T", "--save-model", saved, "--overwrite")
    assert saved.read_text() == "effects = []\n" and list(tmp_path.iterdir()) == [saved]


@pytest.mark.parametrize(
    "text, says",
    [
        (None, "cannot be read"),
        ("effects: [a]", "is not TOML"),
        ("efects = []", "a key 'efects', which no model has: did you mean effects?"),
        ("[coefficients]", "names no effects"),
        ("effects = 'second-order'", "effects: it must be a valid list"),
        ("effects = [1]", "effects.0: it must be a valid string"),
        ("effects = []\neffects_from = 'a.py'", "effects_from: it must be a valid list"),
        ('effects = []\neffects_from = ["a\\u0000.py"]', "effects_from.0: it must hold no control characters"),
        ('effects = ["a = \\u001b[2J"]', "effects.0: it must hold no control characters"),
        ("effects = []\n[sha256]\na = 1", "sha256.a: it must be a valid string"),
        ("effects = []\n[[coefficients]]\nvalue = nan", "coefficients.0"),
        ("effects = []\ncoefficients = 0x" + "f" * 9000, "coefficients: it must be a valid list"),
        ("effects = []\nx = " + "9" * 9000, "is not TOML"),
        ("effects = []\n" + "x" * 1_000_000 + " = 1", "which no model has"),
        ("effects = ['second-ordr']", "did you mean second-order"),
        ("effects = ['my mine = a']", "cannot name an effect"),
        ("effects = []\neffects_from = ['absent.py']", "absent.py, which cannot be read"),
        ("effects = ['second-ordr']\neffects_from = ['/dev/zero']", "/dev/zero, which cannot be read"),
        ("a = " + "[" * 2000, "is not TOML"),
    ],
)
def test_bad_model_files_are_one_sentence(tmp_path: Path, text: str | None, says: str) -> None:
    path = tmp_path / "model.toml" if text is None else written(tmp_path, text, "model.toml")
    with pytest.raises(InputError) as raised:
        model_file.read_model_file(path).load(trust=True)
    said = str(raised.value)
    assert says in said and str(path) in said and "\n" not in said and len(said) < 1000


def test_the_catalogue_is_listed(run, tmp_path: Path) -> None:
    listed = {effect["effect"]: effect for effect in run.json("effects")["effects"]}
    assert list(listed) == names(BENCH)
    assert listed["second-order"]["coefficients"][0]["unit"] == "s^2/m" and listed["second-order"]["source"]
    assert listed["settling"]["unknown"]["symbol"] == "tauSettle" and listed["second-order"]["unknown"] is None
    code, out, _ = run("effects", "--axes", "z y")
    assert code == 0 and "encoder-offset:z" in out and "encoder-offset:x" not in out


def test_effects_in_detail(run, tmp_path: Path) -> None:
    own = written(tmp_path, TEN_LINES)
    code, out, _ = run("effects", "mine = fx*fy*T", "bend", "settling", "bias-walk", "--effects-from", own)
    assert code == 0 and "minei * (fx*fy*T)" in out and "981 µg/g²/K" in out and "3 to 600 s" in out
    assert "did you mean bend" in run.refused("effects", "bent", "--effects-from", own)


def test_a_model_prints_itself() -> None:
    model = Model.of(BENCH, ["second-order", "mine = fx*fy*T", "bias-walk"])
    text = str(model)
    assert text == plain(model_table(model)) and model.sum == "twelve parameters + second-order + mine + bias-walk"
    assert "twelve parameters" in text and "K2_3" in text and "981 µg/g²/K" in text and "bias-walk" in text


@pytest.mark.parametrize(
    "text, same_as",
    [("mine:z = 1*rad", "encoder-offset:z"), ("mine:x = q_x", "encoder-scale:x"), ("mine:base = 1*rad", "base-tilt"),
     ("mine:base = t*rad/(1*s)", "base-tilt-drift"), ("mine:platform = t*rad/(1*s)", "platform-drift")],
)  # fmt: skip
def test_a_formula_of_a_place_turns_it(text: str, same_as: str) -> None:
    """An error of a gimbal's angle, a tilt of the base or a turn of the platform, as those of the catalogue are."""
    effect, known = effect_named(text, EXAMPLE), effect_named(same_as, EXAMPLE)
    stimulus = trial(EXAMPLE)
    np.testing.assert_allclose(effect.columns(stimulus), known.columns(stimulus), rtol=1e-12, atol=1e-12)
    assert as_text(effect) == text
    assert len(effect.coefficients) == len(known.coefficients)


def test_the_angle_in_the_dwell_before() -> None:
    stimulus = trial(EXAMPLE)
    before = effect_named("mine = q2_before", EXAMPLE).columns(stimulus)[:, 0, 0]
    own = effect_named("mine = q2", EXAMPLE).columns(stimulus)[:, 0, 0]
    np.testing.assert_allclose(before[5:], own[:-5])


def test_the_last_move_is_zero_where_a_gimbal_stood_still_whatever_its_encoder_says() -> None:
    """A change of 1e-17 rad has a sign, and so has one of the noise of an encoder."""
    stimulus = trial(EXAMPLE)
    pose = stimulus.previous_pose.copy()
    pose[:, 1] += np.resize([0.5, -0.5, 1e-17, -1e-6, 0.0], len(pose))
    stimulus = replace(stimulus, pose=pose)
    senses = effect_named("mine = sign(q2_move)", EXAMPLE).columns(stimulus)[:, 0, 0]
    np.testing.assert_array_equal(senses, np.resize([1.0, -1.0, 0.0, 0.0, 0.0], len(pose)))
    moves = effect_named("mine = q2_move", EXAMPLE).columns(stimulus)[:, 0, 0]
    np.testing.assert_allclose(moves, 0.5 * senses)


def test_what_follows_a_quantity_is_its_differential_equation() -> None:
    """tau dL/dt = x - L, by scipy; a part of the run has what the whole has, and the way of a gimbal sums its moves."""
    stimulus = trial(EXAMPLE)
    pose = stimulus.pose[:, 1]
    way = effect_named("mine = q2_way", EXAMPLE).columns(stimulus)[:, 0, 0]
    np.testing.assert_allclose(way[4::5], np.append(0.0, np.abs(np.diff(pose[::5])).cumsum()), atol=1e-2)
    times_s = stimulus.elapsed_s
    left_s, come_s = times_s[4:-1:5], (times_s - stimulus.since_arrival_s)[5::5]

    def turned(at_s: float) -> float:
        """Until it has arrived, a gimbal turns slowly at both ends."""
        shares = np.clip((at_s - left_s) / (come_s - left_s), 0.0, 1.0)
        return float(np.diff(way[4::5]) @ (shares**2 * (3.0 - 2.0 * shares)))

    solved = solve_ivp(lambda at_s, lag: (turned(at_s) - lag) / 60.0, times_s[[0, -1]], way[:1], t_eval=times_s,
                       max_step=1.0, rtol=1e-8, atol=1e-8)  # fmt: skip
    warmth = effect_named("mine = q2_way - lag(q2_way, 60*s)", EXAMPLE)
    near = slice(200)  # afterwards ways take an hour, which have eight parts
    np.testing.assert_allclose(warmth.columns(stimulus)[near, 0, 0], (way - solved.y[0])[near], atol=2e-4)
    part = slice(100, 130)
    np.testing.assert_array_equal(warmth.columns(stimulus.at(part)), warmth.columns(stimulus)[part])
    assert warmth.remarks == ()


@pytest.mark.parametrize(
    "text, words",
    [("lag(T, 60)", "unit of time"), ("lag(T, t)", "one time constant"), ("lag(T, -5*s)", "one time constant"),
     ("lag(T)", "takes 2 values"), ("lag + 1", "in parentheses")],
)  # fmt: skip
def test_a_time_constant_is_one_constant_time(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        effect_named(f"mine = {text}", EXAMPLE)


def test_what_a_recording_shows_of_an_effect(run, recording: Path) -> None:
    """A formula that spells out an effect of the catalogue cannot be told from it; wrong gravity is a scale factor."""
    words = ["effects", "mine = a*a", "second-order", "gravity-error", "latency", "--recording", recording]
    seen = {each["effect"]: each for each in run.json(*words)["effects"]}
    assert list(seen) == ["mine", "second-order", "gravity-error", "latency"]
    mine, theirs = seen["mine"], seen["second-order"]
    assert mine["visible"] and 0.0 < mine["share_left"] <= 1.0
    assert mine["overlaps"]["second-order"] == pytest.approx(1.0, abs=1e-6)
    assert mine["smallest"]["size"] == pytest.approx(theirs["smallest"]["size"], rel=1e-6)
    assert seen["gravity-error"]["visible"] is False and "scale factor" in seen["gravity-error"]["degeneracy"]
    assert seen["latency"]["visible"] is None and "slews" in seen["latency"]["why"]
    code, out, _ = run(*words)
    assert code == 0 and "second-order (1.00)" in out and "no orientation tells the two apart" in out


def test_a_users_own_effect_is_reported_on_at_once(run, recording: Path) -> None:
    warnings = run.json("replay", recording, "--with", "mine = a*a")["warnings"]
    note = next(each for each in warnings if each.startswith("mine: visible"))
    assert "smallest size" in note and "cannot be told from second-order (1.00)" in note
    warnings = run.json("replay", recording, "--with", "second-order")["warnings"]
    assert not any("visible" in each for each in warnings)


@pytest.mark.parametrize("command", ["replay", "compare", "diagnose", "effects"])
@pytest.mark.parametrize(
    "effect, says", [("mine = a + T", "m/s^2 and K"), ("second-ordr", "did you mean second-order")]
)
def test_a_bad_effect_is_refused_before_a_reading_is_read(
    run, recording: Path, monkeypatch: pytest.MonkeyPatch, command: str, effect: str, says: str
) -> None:
    from kf_calib.sources.files.recording import Recording

    monkeypatch.setattr(Recording, "__iter__", lambda self: pytest.fail("the recording was read"))
    place = ["--recording", recording] if command == "effects" else [recording]
    assert says in run.refused(command, *place, "--with", effect)


def test_the_rate_of_temperature_needs_no_remark() -> None:
    assert remarks_of(made("dT")) == ()


def test_a_decay_of_another_run_may_be_nothing_on_the_trial_run() -> None:
    """The program writes jumps that decay for runs of days: after 300 time constants hardly anything is left."""
    text = "mine = (t > 5*s)*exp(-abs(t-5*s)/(0.2*s))"
    axes = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    assert formula(text, axes, 9.81, checked=False).coefficients[0].scale > 0.0
