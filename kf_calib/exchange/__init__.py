"""Calibrations in and out: saved, applied, verified, compared over time, exported to other programs, certified."""
