"""Which process writes a growing file: a lock of the operating system, which ends with the process in any case."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO

if sys.platform == "win32":  # where a file that is open cannot be replaced anyway

    def lock(file: IO[bytes]) -> bool:
        """Take a file for this process for as long as it is open; whether nobody else has it."""
        return True

    def writer(path: Path) -> str:
        """Who has taken a file, for a message; empty where nobody has."""
        return ""

else:
    import fcntl

    def lock(file: IO[bytes]) -> bool:
        """Take a file for this process for as long as it is open; whether nobody else has it."""
        return _is_free(file, fcntl.LOCK_EX)

    def writer(path: Path) -> str:
        """Who has taken a file, for a message; empty where nobody has."""
        try:
            with path.open("rb") as file:
                return "" if _is_free(file, fcntl.LOCK_SH) else _holder(os.fstat(file.fileno()).st_ino)
        except OSError:
            return ""

    def _is_free(file: IO[bytes], kind: int) -> bool:
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system that has no locks
            return True
        return True

    def _holder(inode: int) -> str:
        """The process that has the file of this number, as far as Linux tells it."""
        pids = set[int]()
        with suppress(OSError, ValueError, IndexError):
            for line in Path("/proc/locks").read_text().splitlines():
                fields = line.split()
                if fields[1] == "FLOCK" and fields[3] == "WRITE" and int(fields[5].split(":")[2]) == inode:
                    pids.add(int(fields[4]))
        return f"another run (process {pids.pop()})" if len(pids) == 1 and min(pids) > 0 else "another run"
