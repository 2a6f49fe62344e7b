"""The parts of ``tools/prior_trial.py``."""
