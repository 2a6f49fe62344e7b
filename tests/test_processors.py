"""The numbers that are stored come out on processors that round otherwise: without the widest instructions, or old."""

import os
import subprocess
import sys

import numpy as np
import pytest
from helpers.paths import ROOT

_CORES = {"Haswell": ("X86_V3",), "Prescott": ()}
"""Kernels of OpenBLAS by its name for a processor, and which of its wider instructions numpy may use."""

# not without angles: what counts as determined by its first dwells is at the level of rounding there
_CASES = "plans or mems or second_order or orientations or position_feedback"


@pytest.mark.slow
@pytest.mark.parametrize("core", _CORES)
def test_stored_numbers_hold_on_another_processor(core: str) -> None:
    known = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    if "X86_V3" not in known:
        pytest.skip("this processor has nothing that could be left out")
    left_out = " ".join(name for name in known if name not in _CORES[core])
    kinds = {"OPENBLAS_CORETYPE": core, "NPY_DISABLE_CPU_FEATURES": left_out}
    words = ["-n", "0", "-p", "no:cacheprovider", "tests/test_golden_numbers.py", "-k", _CASES]
    ended = subprocess.run(
        [sys.executable, "-m", "pytest", *words], cwd=ROOT, env=os.environ | kinds, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stdout[-4000:]
