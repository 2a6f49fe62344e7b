"""Trial of the diagnosis on real noise: recordings of others, with an effect injected into their readings, and without.

usage: .venv/bin/python tools/real_trial.py [--folder FOLDER] [--sizes 8 --sizes 10 ...] [--jobs N] [--resume FILE]
"""

from __future__ import annotations

from real_trials.command import main

if __name__ == "__main__":
    main()
