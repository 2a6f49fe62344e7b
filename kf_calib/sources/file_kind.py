"""The kinds of files that are told apart."""

from __future__ import annotations

from enum import Enum


class FileKind(Enum):
    """What a file holds.

    - RECORDING: messages in MCAP or SQLite, or nothing that is known.
    - SAMPLES: lines of CSV or JSON, one or more for each sample.
    - TABLE: a row of means for each dwell, in CSV or a spreadsheet.
    - CALIBRATION: the result of a run, as --save writes it.
    """

    RECORDING = "recording"
    SAMPLES = "samples"
    TABLE = "table"
    CALIBRATION = "calibration"
