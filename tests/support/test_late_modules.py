"""What libraries import and nobody here uses is not run, and is whole for whoever asks for it."""

from __future__ import annotations

import subprocess
import sys

from helpers.paths import ROOT

BEGIN = "import sys; from kf_calib.support.late_modules import put_off; put_off(); put_off(); "


def printed(program: str) -> str:
    """What a program prints that begins as a command does."""
    words = [sys.executable, "-c", BEGIN + program]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert not done.stderr, done.stderr
    return done.stdout


def test_what_scipy_imports_and_does_not_use_is_run_when_asked_for() -> None:
    """Where scipy does not import it any more, late_modules can go."""
    told = "print('numpy.f2py' in sys.modules, 'numpy.f2py.crackfortran' in sys.modules, 'unittest' in sys.modules); "
    used = "numpy.testing.assert_allclose(1.0, 1.0); numpy.f2py.get_include(); "
    said = printed(f"import numpy, scipy.special; {told}{used}{told}")
    assert said == "True False False\nTrue True True\n"


def test_units_need_no_dask_and_others_have_it_all_the_same() -> None:
    told = "print('dask' in sys.modules, pint.compat.HAS_DASK, str(pint.UnitRegistry()('3 m') / 2)); "
    assert printed(f"import pint; {told}import dask; {told}") == "False False 1.5 meter\nTrue False 1.5 meter\n"
    assert printed(f"import dask, pint; {told}") == "True True 1.5 meter\n"
