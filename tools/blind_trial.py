"""Blind trial: recordings with a hidden effect through the command line, and how often the program is right.

usage: .venv/bin/python tools/blind_trial.py [--runs N] [--seed S] [--only FIGURE ...] [--resume FILE] [--pool FILE ...]
"""

from __future__ import annotations

from blind_trials.command import main

if __name__ == "__main__":
    main()
