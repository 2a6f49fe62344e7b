"""Blind trial of the pooled diagnosis: campaigns of many runs with a hidden effect, and how often it is right.

usage: .venv/bin/python tools/pooled_trial.py [--campaigns N] [--seed S] [--only KIND ...] [--simulated] [--resume FILE]
"""

from __future__ import annotations

from pooled_trials.command import main

if __name__ == "__main__":
    main()
