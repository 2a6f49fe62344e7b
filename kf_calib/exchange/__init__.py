"""Calibrations in and out: saved, applied to other readings, verified, compared over time; and the noise of sensors."""
