"""Trial of the diagnosis on effects of no catalogue: how often it says that it does not know.

usage: .venv/bin/python tools/unknown_trial.py [--runs N] [--sizes 10 --sizes 15 ...] [--jobs N] [--resume FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

from unknown_trials.command import main  # noqa: E402

if __name__ == "__main__":
    main()
