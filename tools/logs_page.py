#!/usr/bin/env python
"""The page of logs that other programs write, docs/logs.md, from the files that the tests read: this renews it."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

from helpers.foreign_logs import FOREIGN_LOGS, ForeignLog  # noqa: E402

PAGE = ROOT / "docs" / "logs.md"
COMMAND = "kf-calib replay {} --gravity 9.80665"
VERDICT = "Model and measurements agree: noise alone gives a misfit this large with probability p = 0.8"
_LINES, _WIDTH = 3, 100
_HEAD = """# Logs of other programs

One and the same run, twelve poses of a sensor in the hand, as {count} programs write it. Each file goes to its
verdict by the one command below it, with no option but gravity, and each ends in the same nine numbers and the same
sentence:

> {verdict} ...

(`tests/sources/test_logs_of_strangers.py` writes these files and runs these commands.)

What stands beside the accelerometer, a gyroscope, a magnetometer, an attitude that the device itself estimated,
covariances, is recognised by its name and left out. Of two stamps the one that goes up evenly is the time. A unit
that no name tells is told by the size of gravity, and said. `kf-calib info FILE` shows, of any file, what it would be
taken for and the command to try. Where readings are counts, that command has the option with their size
(`--accel-scale`).

With the angles of a platform in the same file all twelve parameters are estimated: see [a CSV file](own_csv.md) and
[a bag](bags.md).

Files of MATLAB, HDF5, NumPy and LabVIEW (`.tdms`), tables in Parquet and Arrow, flight logs and bags of ROS 1 are read
by libraries that come with `pip install 'kf_calib[logs]'` (MATLAB up to version 7 and NumPy need nothing). All arrays
of a file that have the same length are taken together, whatever their groups; a number called `fs` or `dt` gives the
time where no array does, and an attribute `units` the unit. Where a file holds several accelerometers, or sensors at
several rates, the dataset with the most readings is taken and the others are named; `--accel-topic` chooses:
`--accel-topic sensor_accel.1`. What lies outside of the file, and objects whose reading could run code, are not
followed. Such a file is read whole into memory, so it may have up to 1 GB; text, MCAP and bags may have any size.
"""


def page() -> str:
    """The whole page."""
    with tempfile.TemporaryDirectory() as folder:
        parts = [_section(name, log, Path(folder)) for name, log in FOREIGN_LOGS.items()]
    return "\n".join([_HEAD.format(count=len(parts), verdict=VERDICT), *parts])


def _section(name: str, log: ForeignLog, folder: Path) -> str:
    title = name[0].upper() + name[1:] if name.startswith("a") else name
    shown = log.holds or _beginning(log.at(folder))
    return f"## {title}\n\n```text\n{shown}\n```\n\n```sh\n{COMMAND.format(log.file)}\n```\n"


def _beginning(path: Path) -> str:
    content = path.read_bytes()
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = content.decode("cp1252")
    lines = text.splitlines()[:_LINES]
    return "\n".join(line if len(line) <= _WIDTH else line[: _WIDTH - 4] + " ..." for line in lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)
