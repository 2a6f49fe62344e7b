"""Trial of the probabilities: runs drawn from the program's own priors, and how often what it says is so.

usage: .venv/bin/python tools/prior_trial.py FOLDER [--runs 2000] [--first 0] [--jobs 2] [--scheduler ADDRESS]

Rows go to FOLDER as Parquet, some at a time; the same command goes on where it was stopped. A row is repeated by its
seed. With --runs 0 the report of what is there is printed again.
"""

from __future__ import annotations

from prior_trials.command import main

if __name__ == "__main__":
    main()
