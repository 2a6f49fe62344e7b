"""A file of a user's own effect, as docs have it: ten lines."""

TEN_LINES = """
from kf_calib.effects import SensorEffect

class Bend(SensorEffect):
    unit = "s^2/m"

    def terms(self, s):
        return s.along**2
"""
