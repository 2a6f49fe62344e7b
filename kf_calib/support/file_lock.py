"""Which process writes a growing file: a lock of the operating system, which ends with the process in any case."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO

if sys.platform == "win32":
    import ctypes
    import msvcrt

    class _Place(ctypes.Structure):
        """Of the byte that is locked (OVERLAPPED), far behind the content: nobody else can read what is locked."""

        _fields_ = [
            ("internal", ctypes.c_void_p),
            ("internal_high", ctypes.c_void_p),
            ("offset", ctypes.c_uint32),
            ("offset_high", ctypes.c_uint32),
            ("event", ctypes.c_void_p),
        ]

    _AT_ONCE, _EXCLUSIVE = 1, 2
    _kernel = ctypes.WinDLL("kernel32")

    def lock(file: IO[bytes]) -> bool:
        """Take a file for this process for as long as it is open; whether nobody else has it."""
        place = ctypes.byref(_Place(offset_high=2**30))
        return bool(_kernel.LockFileEx(_handle(file), _AT_ONCE | _EXCLUSIVE, 0, 1, 0, place))

    def writer(path: Path) -> str:
        """Who has taken a file, for a message; empty where nobody has."""
        try:
            with path.open("r+b") as file:
                is_free = lock(file)
                if is_free:  # at once: what is closed is free only in a while
                    _kernel.UnlockFileEx(_handle(file), 0, 1, 0, ctypes.byref(_Place(offset_high=2**30)))
        except OSError:
            return ""
        return "" if is_free else "another run"

    def _handle(file: IO[bytes]) -> ctypes.c_void_p:
        return ctypes.c_void_p(msvcrt.get_osfhandle(file.fileno()))

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
            for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
                fields = line.split()
                if fields[1] == "FLOCK" and fields[3] == "WRITE" and int(fields[5].split(":")[2]) == inode:
                    pids.add(int(fields[4]))
        return f"another run (process {pids.pop()})" if len(pids) == 1 and min(pids) > 0 else "another run"
