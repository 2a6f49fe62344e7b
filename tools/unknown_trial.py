"""Trial of the diagnosis on effects of no catalogue: how often it says that it does not know.

usage: .venv/bin/python tools/unknown_trial.py [--runs N] [--sizes 10 --sizes 15 ...] [--jobs N] [--resume FILE]
"""

from __future__ import annotations

from unknown_trials.command import main

if __name__ == "__main__":
    main()
