"""Lines of JSON: one object a line, readings and poses together or on lines of their own (docs/format.md)."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal
from typing import Any

from kf_calib.bench.bench import metadata_of
from kf_calib.bench.raw_input import UNITS
from kf_calib.sources.text.cells import LineError, stamp_ns, written
from kf_calib.sources.text.heading import scalars, with_texts
from kf_calib.sources.text.reader import LineCounts, LineReader, SampleRow

_MARK = "\ufeff"  # some write it before the first line
_TIME_NS = {"time_ns": 1, "time_us": 10**3, "time_ms": 10**6, "time_s": 10**9}
"""Names of the stamp, and its unit."""
_ACCEL = {"accel_mps2": "m/s2", "accel_g": "g", "accel_mg": "mg"}
_READINGS = (*_ACCEL, "accel", "accel_counts", "accel_raw")
"""The names of the last three tell no unit: options state it."""
_ANGLES = {"angles_rad": 1.0, "angles_deg": math.pi / 180.0}
_ATTITUDE = "attitude_xyzw"
POSE_KEYS = (*_ANGLES, _ATTITUDE)
"""Under which a line of JSON has an orientation."""
_TEMPERATURE = "temperature_c"
_KNOWN = frozenset([*_TIME_NS, *_READINGS, *POSE_KEYS, _TEMPERATURE])

_decode_exactly = json.JSONDecoder(parse_float=Decimal).decode
_find_tiny = re.compile(r"[0-9][eE]-[0-9]{3}").search  # a number as small as this is rare, and may be two


def are_ours(lines: Sequence[str], columns: Mapping[str, str]) -> bool:
    """Whether lines of JSON have names of ours, or such as ``columns`` say are."""
    theirs = [name for name, ours in columns.items() if ours in _KNOWN]
    lists = "|".join(map(re.escape, (*_READINGS, *POSE_KEYS, *theirs)))
    ours = re.compile(rf'"(?:bench|{lists})"\s*:\s*[\[{{]'), re.compile(r'"(?:bench|time_[num]?s)"\s*:')
    return bool(theirs) or all(any(map(name.search, lines)) for name in ours)


class JsonLines(LineReader):
    """Reads JSON lines block by block.

    columns: our names of foreign keys; angles: whether poses count. ``metadata`` is the first line's ``{"bench": ...}``
    as strings. The first pose settles whether poses are angles and how many; the first readings settle the unit that
    all are brought to.
    """

    advice = "name the readings accel_mps2 or accel_g, and the poses angles_rad, angles_deg or attitude_xyzw"

    def __init__(self, columns: Mapping[str, str], counts: LineCounts, angles: bool = True) -> None:
        super().__init__(counts)
        self._columns, self._is_first, self.wants_pose = columns, True, angles

    def with_readings(self, line: str, readings_mps2: Sequence[float]) -> str:
        entry = json.loads(line.lstrip(_MARK))
        theirs = {self._columns.get(key, key): key for key in entry}
        name = _first_of({ours: entry[key] for ours, key in theirs.items()}, _READINGS)
        key, texts = theirs[name], [written(value / UNITS[_ACCEL.get(name, "m/s2")]) for value in readings_mps2]
        places = {path: (start, end) for path, start, end in scalars(line)}
        line = with_texts(line, [places[f"{key}.{k}"] for k in range(3)], dict(enumerate(map(repr, texts))))
        return line if name in _ACCEL else re.sub(rf"{re.escape(json.dumps(key))}(?=\s*:)", '"accel_mps2"', line)

    def _row(self, line: str) -> SampleRow | None:
        line = line.lstrip(_MARK) if self._is_first else line
        if not line.lstrip().startswith("{"):  # found out at a tenth of the cost, where a link brings much of it
            raise LineError("it is not a JSON object")
        entry = self._entry(line, json.loads)
        if self._takes_bench(entry):
            return None
        name = next((name for name in _TIME_NS if name in entry), None)
        if name is None:
            raise LineError("it has no time stamp (time_ns or time_s)")
        if type(entry[name]) is float or (("e-" in line or "E-" in line) and _find_tiny(line)):
            entry = self._entry(line, _decode_exactly)  # floats have lost digits
        if type(entry[name]) not in (int, Decimal):
            raise LineError(f"{name} is not a number")
        time_ns = stamp_ns(entry[name], _TIME_NS[name])
        readings, pose = self._readings(entry), self._pose(entry)
        is_warm = entry.get(_TEMPERATURE) is not None
        degrees = _numbers([entry[_TEMPERATURE]], _TEMPERATURE) if is_warm else None
        if pose and not self.pose_width:  # all on the line is understood before any of it is used
            self.pose_width, self.has_angles = len(pose), _first_of(entry, POSE_KEYS) != _ATTITUDE
        if not entry.keys() <= _KNOWN:
            self._counts.leave_out(key for key in entry if key not in _KNOWN)
        return time_ns, readings, pose, degrees

    def _entry(self, line: str, decode: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
        """Return what is on a line by our names. Raises LineError where it cannot be decoded."""
        try:
            entry = decode(line)
        except ArithmeticError:
            raise LineError("a number is out of range") from None
        except RecursionError:
            raise LineError("it is nested too deeply") from None
        except ValueError:
            raise LineError("it is not JSON") from None
        return {self._columns.get(key, key): value for key, value in entry.items()} if self._columns else entry

    def _takes_bench(self, entry: dict[str, Any]) -> bool:
        """Whether the line describes the bench: the first one is kept, and no other may contradict it."""
        is_first, self._is_first = self._is_first, False
        if "bench" not in entry or not (is_first or _TIME_NS.keys().isdisjoint(entry)):
            return False
        bench = entry["bench"]
        if not isinstance(bench, dict):
            raise LineError("bench is not a JSON object")
        metadata = metadata_of({key: value for key, value in bench.items() if value is not None})
        if is_first:
            self.metadata = metadata
        elif changed := [key for key, value in metadata.items() if self.metadata.get(key) != value]:
            before, after = (ascii(each.get(changed[0]))[:40] for each in (self.metadata, metadata))
            raise LineError(
                f"it describes another bench than the first line ({changed[0]}: {after}, first {before}), which counts "
                "for the whole run: begin a new run where the bench changes"
            )
        return True

    def _readings(self, entry: dict[str, Any]) -> list[float] | None:
        if not (name := _first_of(entry, _READINGS)):
            return None
        values, unit = _numbers(entry[name], name), _ACCEL.get(name, "")
        if len(values) != 3:
            raise LineError(f"{name} has {len(values)} numbers, not 3")
        self.unit = unit if self.unit is None else self.unit
        if bool(unit) != bool(self.unit):
            raise LineError(f"{name} is not like the readings before it")
        return values if unit == self.unit else [UNITS[unit] / UNITS[self.unit] * value for value in values]

    def _pose(self, entry: dict[str, Any]) -> list[float] | None:
        if not (name := _first_of(entry, POSE_KEYS)):
            return None
        values, has_angles = _numbers(entry[name], name), name != _ATTITUDE
        if not has_angles and (len(values) != 4 or not any(values)):
            raise LineError(f"{name} is not a quaternion")
        if not values:
            raise LineError(f"{name} is empty")
        if self.pose_width and (len(values), has_angles) != (self.pose_width, self.has_angles):
            raise LineError(f"{name} is not like the poses before it")
        return [_ANGLES.get(name, 1.0) * value for value in values]


def _first_of(entry: Mapping[str, Any], names: Sequence[str]) -> str:
    """Return the first of these names under which there is anything; empty where there is none."""
    for name in names:
        if entry.get(name) is not None:
            return name
    return ""


def _numbers(values: Any, name: str) -> list[float]:
    """Finite numbers; true, "1", NaN, 1e999 and 1e-999 are none."""
    if type(values) is not list:
        raise LineError(f"{name} is not a list of numbers")
    if not all(type(value) in (float, int, Decimal) for value in values):
        raise LineError(f"{name} holds what is not a number")
    try:
        numbers = [float(value) for value in values]
    except OverflowError:
        numbers = [math.inf]
    if not all(map(math.isfinite, numbers)) or numbers.count(0.0) != values.count(0):
        raise LineError(f"{name} is out of range")
    return numbers
