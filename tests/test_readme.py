"""What the README prints is what its commands give."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def block_after(marker: str, kind: str) -> str:
    found = re.search(rf"```{kind}\n(.*?)\n```", README[README.index(marker) :], re.DOTALL)
    assert found
    return found[1]


def test_the_ten_lines_print_what_is_shown(tmp_path: Path) -> None:
    code = block_after("## Ten lines", "python")
    assert len(code.splitlines()) == 11
    code = code.replace('"run.rrd"', repr(str(tmp_path / "run.rrd")))
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    # the last digits of a residual may differ between processors
    assert _without_last_digits(done.stdout) == _without_last_digits(block_after("kf_calib.save_view(run", "text"))
    assert (tmp_path / "run.rrd").exists()


def test_the_demo_prints_the_tables_that_are_shown(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "kf_calib.cli", "demo", str(tmp_path / "out")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    shown, printed = block_after("tools/demo", "text"), done.stdout
    table = slice(3, 27)  # parameters, and the heading of the noise
    assert printed.splitlines()[table] == shown.splitlines()[table]


def _without_last_digits(text: str) -> str:
    return re.sub(r"\d{6,}\b|p = [\d.]+", "#", text).strip()
