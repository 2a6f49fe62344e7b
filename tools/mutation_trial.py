"""Single changes of the program, made at random, and which of them its fast tests notice.

usage: .venv/bin/python tools/mutation_trial.py PATH... [--count N] [--seed S] [-o TABLE.tsv]
"""

from __future__ import annotations

from mutation_trials.command import main

if __name__ == "__main__":
    main()
