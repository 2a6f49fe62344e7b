"""Decisions of a bench that drives itself, in the metadata of its recording: what was decided, when, and why."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata

from kf_calib.errors import KfCalibError
from kf_calib.sources.files.mcap_file import McapFile
from kf_calib.sources.files.mcap_records import DamagedError, MessageFinder, parse_record

DECISION_RECORD = "kf_calib.decision"
"""Where something was decided: number, at_s, purpose, gimbal_deg (JSON list), stay_s, why."""
END_RECORD = "kf_calib.drive"
"""After the last decision: ended, why, stands_at_deg (JSON list), stopped, lasted_s."""


def decision_records(path: Path, name: str = DECISION_RECORD) -> list[Mapping[str, str]]:
    """The records of a name in an MCAP file, in their order; none in a file that is none or cannot be read."""
    find, records = MessageFinder(), list[Mapping[str, str]]()
    try:
        for block in McapFile(path).blocks(lambda said: None):
            for opcode, content in find(block).others:
                if opcode == Opcode.METADATA and (record := parse_record(Metadata.read, content)).name == name:
                    records.append(record.metadata)
    except (KfCalibError, OSError, DamagedError):
        return records
    return records


def number_of(record: Mapping[str, str], key: str) -> float:
    """A number of a record; NaN where there is none."""
    try:
        return float(record[key])
    except (KeyError, ValueError):
        return math.nan


def angles_of(text: str) -> tuple[float, ...]:
    """The angles of a record, deg; none where the text is no list of numbers."""
    try:
        return tuple(float(angle) for angle in json.loads(text))
    except (TypeError, ValueError):
        return ()
