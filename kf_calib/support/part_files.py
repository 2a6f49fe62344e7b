"""Files that are not whole yet, named after the process that writes them: what a killed one left is told by its name.

The name also says on which machine, and among which processes of it, that number means the process: a folder may be
shared by several.
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
    """A new name in the same folder, for what is not whole yet."""
    return target.with_name(f".kf-calib-{_here()}-{os.getpid()}-{os.urandom(4).hex()}.part")


def remove_stale(folder: Path) -> None:
    """Remove what processes of this machine that are no more have left in a folder."""
    with suppress(OSError), os.scandir(folder) as entries:
        names = [entry.name for entry in entries if entry.name.startswith(".kf-calib-")]
        for name in names:
            named = _NAME.fullmatch(name)
            if named and named[1] == _here() and not _is_alive(int(named[2])):
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
def _here() -> str:
    """Where numbers of processes mean what they mean here: this machine, and on Linux this space of processes."""
    space = Path("/proc/self/ns/pid")
    number = space.stat().st_ino if space.exists() else 0
    return f"{zlib.crc32(f'{platform.node()} {number}'.encode()):08x}"
