"""The function in C, compiled and compared with the correction in Python."""

import ctypes
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers.stated_sensors import BENCH, Formula, correction, samples, saved

from kf_calib import effects
from kf_calib.effects.inputs import beyond_force_and_temperature
from kf_calib.errors import InputError
from kf_calib.exports import exported

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
compiled_only = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler: the header is not compiled")
BY_FORCE_AND_TEMPERATURE = [
    name for name in effects.names(BENCH) if not beyond_force_and_temperature(effects.effect_named(name, BENCH), BENCH)
]
FORMULAS = [
    "mine = sin(fx/g) + 0.5*a*abs(p)/g**2", "mine = (abs(a)/g)**2.5*(a > 0)",
    "mine = -minimum(a, o)*T/K + g*exp(-T/(40*K))", "mine = maximum(fy, fz)*sign(a)/(2 + cos(a/g))",
    "mine = sqrt(g*g + a*a)/g - tanh(p/g) - arctan(o/g)*log(3) + 2**3*T/K*deg",
]  # fmt: skip


def compiled(text: str, folder: Path) -> Formula:
    """The function of the header, compiled with every warning an error."""
    return compiled_together([text], folder)[0]


def compiled_together(texts: Sequence[str], folder: Path) -> list[Formula]:
    """The functions of headers, in one program: compiled with every warning an error."""
    shim = list[str]()
    for k, text in enumerate(texts):
        (folder / f"header_{k}.h").write_text(text)
        names = sorted(set(re.findall(r"kf_calib_\w+(?=\()", text)))
        shim += [
            *(f"#define {name} {name}_{k}" for name in names), f'#include "header_{k}.h"',
            f"void all_{k}(long n, double *z, double *t) "
            f"{{ for (long j = 0; j < n; j++) kf_calib_correct(z + 3 * j, t[j], z + 3 * j); }}",
            *(f"#undef {name}" for name in [*names, "KF_CALIB_CORRECT_H"]),
        ]  # fmt: skip
    (folder / "shim.c").write_text("\n".join([*shim, ""]))
    flags = ["-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
    libraries = ["-lm"] if any("math.h" in text for text in texts) else []
    words = [str(COMPILER), *flags, "shim.c", "-o", "shim.so", *libraries]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    library = ctypes.CDLL(str(folder / "shim.so"))
    return [partial(_corrected, getattr(library, f"all_{k}")) for k in range(len(texts))]


def _corrected(function: Callable[..., None], readings: np.ndarray, temperature: np.ndarray) -> np.ndarray:
    values, warmth = np.array(readings, float, order="C"), np.array(temperature, float)
    pointer = ctypes.POINTER(ctypes.c_double)
    function(ctypes.c_long(len(values)), values.ctypes.data_as(pointer), warmth.ctypes.data_as(pointer))
    return values


@compiled_only
@pytest.mark.parametrize("names", [(), *((name,) for name in [*BY_FORCE_AND_TEMPERATURE, *FORMULAS]),
                                   ("second-order", "thermal-bias", "cross-coupling-ip", "mine = a**3")])  # fmt: skip
def test_the_function_in_c_corrects_as_we_do(names: tuple[str, ...], tmp_path: Path) -> None:
    own = correction(*names)
    text = exported(saved(), own, "c").text()
    force, temperature = samples(5000, (0.0, 2.0))
    force[:500] *= 1e-4  # where a dead zone is, too
    force[500:1000, 0] *= 1e-5
    readings = own.predicted(force, temperature)
    expected = own(readings, temperature)
    if names:
        assert np.abs(expected - (readings - own.bias_mps2) @ own.matrix.T).max() > 1e-6  # the effect does matter
    found = compiled(text, tmp_path)(readings, temperature)
    assert np.abs(found - expected).max() <= 1e-12 * BENCH.gravity_mps2
    assert ("math.h" in text) == any(re.search(r"sin|cos|exp|log|sqrt|2\.5", name) for name in names)


@compiled_only
def test_the_function_in_c_takes_an_unknown_temperature_for_the_reference(tmp_path: Path) -> None:
    own = correction("thermal-bias")
    function = compiled(exported(saved(), own, "c").text(), tmp_path)
    readings = own.predicted(samples(10)[0], 25.0)
    np.testing.assert_array_equal(function(readings, np.full(10, np.nan)), function(readings, np.full(10, 25.0)))


def test_effects_of_the_run_and_the_platform_are_named_and_left_out() -> None:
    target = exported(saved(), correction("second-order", "bias-drift", "base-tilt"), "c")
    assert "// Not corrected for bias-drift." in target.text() and "// Not corrected for base-tilt." in target.text()
    assert set(target.correction.left_out) == {"bias-drift", "base-tilt"}


def test_a_class_in_python_is_refused_in_c_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(effects, "_registered", {})

    class Fifth(effects.SensorEffect):
        """c a^5."""

        name, title, source = "fifth", "fifth order", "test"
        symbol, unit, scale = "Q5_", "s^8/m^4", 1e-8

        def terms(self, s: effects.Stimulus) -> np.ndarray:
            return s.along**5

    effects.register(Fifth)
    with pytest.raises(InputError, match=r"fifth is a class in Python, which cannot be written in C"):
        exported(saved(), correction("fifth"), "c").text()
