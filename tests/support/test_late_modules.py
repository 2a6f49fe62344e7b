"""What scipy imports and nobody uses is not run, and is whole for whoever asks for it."""

from __future__ import annotations

import subprocess
import sys

from helpers.paths import ROOT

RUN = """
import sys
from kf_calib.support.late_modules import put_off
put_off()
put_off()
import numpy, scipy.special
assert "numpy.f2py" in sys.modules, "scipy does not import it any more: late_modules can go"
print("numpy.f2py.crackfortran" in sys.modules, "unittest" in sys.modules)
numpy.testing.assert_allclose(1.0, 1.0)
print("unittest" in sys.modules, callable(numpy.f2py.get_include), "numpy.f2py.crackfortran" in sys.modules)
"""


def test_what_scipy_imports_and_does_not_use_is_run_when_asked_for() -> None:
    done = subprocess.run([sys.executable, "-c", RUN], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("False False\nTrue True True\n", "")
