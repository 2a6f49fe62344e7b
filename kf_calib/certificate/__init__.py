"""Calibration certificates: what one says, its uncertainty budget, as a PDF for people and as XML for programs."""
