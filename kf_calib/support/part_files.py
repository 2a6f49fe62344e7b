"""Temporary files, named after the process that writes them, so that those of killed processes can be recognised.

Because several machines or containers may share a folder, the name also identifies the machine and, on Linux, the
namespace in which the process number is valid.
"""

from __future__ import annotations

import os
import platform
import re
import sys
import zlib
from contextlib import suppress
from functools import cache
from pathlib import Path

_NAME = re.compile(r"\.kf-calib-([0-9a-f]{8})-(\d{1,10})-[0-9a-f]{8}\.part")


def beside(target: Path) -> Path:
    """A new temporary name in the same folder."""
    return target.with_name(f".kf-calib-{_machine()}-{os.getpid()}-{os.urandom(4).hex()}.part")


def remove_stale(folder: Path) -> None:
    """Remove the temporary files that ended processes of this machine have left in a folder."""
    with suppress(OSError), os.scandir(folder) as entries:
        names = [entry.name for entry in entries if entry.name.startswith(".kf-calib-")]
        for name in names:
            match = _NAME.fullmatch(name)
            if match and match[1] == _machine() and not _is_alive(int(match[2])):
                with suppress(OSError):
                    (folder / name).unlink()


def _is_alive(pid: int) -> bool:
    """Whether there is such a process; on Windows, where asking would end it, there always is."""
    if sys.platform == "win32":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # that of somebody else
        return True
    return True


@cache
def _machine() -> str:
    """A hash of the machine's name and, on Linux, of its namespace of process numbers."""
    space = Path("/proc/self/ns/pid")
    number = space.stat().st_ino if space.exists() else 0
    return f"{zlib.crc32(f'{platform.node()} {number}'.encode()):08x}"
