"""Files that are written: one rule for every output of every command, so that nothing of the user's is harmed.

- Never the input: no output is a file that the command reads, under whatever name (links too), nor another output.
- A file is replaced only with ``--overwrite``; a folder, a device or a write-protected file is never replaced. A link
  stays, and the file that it points to is written.
- All this, and whether the folder is writable, is checked before the work begins.
- A file is written under a temporary name in the same folder, brought to the disk and renamed when it is complete
  (``whole``), so that others see either the old or the new content, after a power cut, too. If two runs write the same
  name without ``--overwrite``, the second to finish gets an error. Temporary files of killed runs are removed by the
  next run.
- A file that grows during the whole run (``Growing``) must survive if the run is killed. It has its final name from the
  start; where it replaces an earlier file, it is renamed as soon as its first readings are on the disk, and until then
  the earlier file stays. If no reading came, no file is left. Both files are locked, so that no other run can write
  them. Windows renames no open file: there the earlier file is put aside first, and comes back if no reading came.

Commands print their result first and then write files. A file that cannot be written is one sentence and exit 2; a
picture that the viewer cannot draw, for example because there is no graphics driver, is a warning and exit 0.

Temporary files are named after the process that writes them, so that those of killed processes can be recognised.
Because several machines or containers may share a folder, the name also identifies the machine and, on Linux, the
namespace in which the process number is valid.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import stat
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import IO

from kf_calib.errors import InputError
from kf_calib.support.file_lock import lock, writer

_new: ContextVar[frozenset[Path]] = ContextVar("_new", default=frozenset())
"""Files that must not be there before they are written."""
_RENAMES_OPEN_FILES = sys.platform != "win32"
_STREAMS = {0: "standard input", 1: "standard output"}


class Outputs:
    """The files that one run of a command writes, each with the option or argument that asks for it (None: left out).

    inputs: what the run reads; of a folder, all that is in it. Raises InputError, before anything is written, where
    the rule forbids one of them.
    """

    def __init__(
        self, files: Mapping[str, Path | None], inputs: Iterable[Path | None] = (), overwrite: bool = False
    ) -> None:
        self._files = {name: path for name, path in files.items() if path is not None}
        self._overwrite = overwrite
        self._written = set[Path]()
        self.spare(inputs)
        for (name, path), (other, other_path) in combinations(self._files.items(), 2):
            if _same(path, other_path):
                raise InputError(f"{name} and {other} name the same file, {path}: give each a name of its own.")
        for name, path in self._files.items():
            refuse_output(path, overwrite, name)

    def spare(self, inputs: Iterable[Path | None]) -> None:
        """Raise InputError where an output is one of these files, which the run reads."""
        read = [read_path for path in inputs if path is not None
                for read_path in ([path, *path.iterdir()] if path.is_dir() else [path])]  # fmt: skip
        for name, path in self._files.items():
            for read_path in read:
                if _same(path, read_path):
                    alias = "" if path == read_path else f", the same file as {read_path},"
                    raise InputError(f"{path}{alias} is read by this very command: give another {name}.")
            for descriptor, stream in _STREAMS.items():
                if _is_open(path, descriptor):
                    raise InputError(f"{path} is the {stream} of this very command: give another {name}.")

    def write(self, path: Path, save: Callable[[Path], object]) -> None:
        """Have ``save`` write the file; raises InputError if another process has created one there in the meantime."""
        if path in self._written or self._overwrite:
            save(path)
        else:
            _refuse_newcomer(path)
            with _new_names(target_of(path)):
                save(path)
        self._written.add(path)

    def allow_replacing(self, path: Path) -> None:
        """Let this file be replaced from now on: its writer itself makes sure that nobody else's file is lost, because
        this run has created it or because the writer recognises its content."""
        self._written.add(path)


def refuse_output(path: Path, overwrite: bool = False, name: str = "name") -> None:
    """Raise InputError, which asks for another ``name``, where no file can be written at ``path``."""
    target = target_of(path)
    try:
        if not target.parent.is_dir():
            raise InputError(f"{path} cannot be created, there is no folder {target.parent}: give another {name}.")
        with suppress(FileNotFoundError):
            _refuse_existing(path, target.lstat(), overwrite, name)
        remove_stale(target.parent)
        trial = beside(target)
        trial.open("xb").close()
        trial.unlink()
    except OSError as error:
        raise InputError(f"{path} cannot be created ({error.strerror}): give another {name}.") from None


def _refuse_existing(path: Path, status: os.stat_result, overwrite: bool, name: str) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{path} is a folder: give {name} a file's name in it.")
    _refuse_device(path, status, name)
    if who := writer(path):
        raise InputError(f"{path} is being written by {who}: end that one first, or give another {name}.")
    if not overwrite:
        raise InputError(f"{path} exists already: give another name, or --overwrite to replace it.")
    if not (status.st_mode & 0o222 and os.access(path, os.W_OK)):
        raise InputError(f"{path} is protected from writing: give another {name}.")


def _refuse_device(path: Path, status: os.stat_result, name: str = "name") -> None:
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path} is not a plain file but a device, a pipe or the like: give another {name}.")


def target_of(path: Path) -> Path:
    """Where writing to ``path`` ends up: the file a link points to."""
    return Path(os.path.realpath(path))


def bring_to_disk(path: Path) -> None:
    """Wait until the disk has a file, or the names in a folder: till then a power cut may take them. Raises OSError
    where the disk refuses a file; a file system that cannot say it of a folder is taken at its word."""
    is_folder = path.is_dir()
    if is_folder and sys.platform == "win32":  # it has no such call, and keeps the order of names
        return
    descriptor = os.open(path, os.O_RDONLY if is_folder else os.O_RDWR)
    try:
        os.fsync(descriptor)
    except OSError:
        if not is_folder:
            raise
    finally:
        os.close(descriptor)


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A name to write under; ``path`` is the file when the block ends, and stays as it was where the block fails.

    Raises InputError where it cannot be written.
    """
    target = target_of(path)
    part = beside(target)
    if not target.parent.is_dir():
        raise InputError(f"{path} cannot be written: there is no folder {target.parent}.")
    with suppress(FileNotFoundError):
        _refuse_device(path, target.lstat())
    try:
        yield part
        bring_to_disk(part)
        if target in _new.get():
            _give_new_name(part, path, target)
        else:
            _rename(part, target)
        bring_to_disk(target.parent)
    except OSError as error:
        raise InputError(
            f"{path} cannot be written ({error.strerror or error}): make room, or give another place."
        ) from None
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file at once, or not at all. Raises InputError where it cannot be written."""
    with whole(path) as part:
        part.write_bytes(content)


class Growing:
    """The path ``at`` of a file that grows: a temporary one until ``settle``, then the one that was asked for.

    Where open files cannot be renamed (Windows) the earlier file has the temporary name until then.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._target = path, target_of(path)
        self._temporary = beside(self._target) if self._target.exists() else None
        self._earlier: IO[bytes] | None = None

    @property
    def at(self) -> Path:
        return self._temporary if self._temporary is not None and _RENAMES_OPEN_FILES else self._target

    @property
    def settled(self) -> bool:
        return self._temporary is None

    def open(self) -> IO[bytes]:
        """Create the file, which nobody else can write or replace while it is open. Raises InputError where another
        run has it."""
        if self._temporary is not None:
            self._earlier = self._target.open("r+b")
            if not (lock(self._earlier) and os.path.samestat(os.fstat(self._earlier.fileno()), self._target.stat())):
                self._let_go()
                self._refuse()
            if not _RENAMES_OPEN_FILES:
                self._let_go()
                self._target.replace(self._temporary)
        file = self.at.open("xb")
        if not lock(file):
            file.close()
            self._refuse()
        bring_to_disk(self.at.parent)  # else a power cut may lose its name, whatever is brought there of its content
        return file

    def settle(self) -> None:
        """Replace the earlier file, if there is one, now that the new one has content."""
        if self._temporary is None:
            return
        if _RENAMES_OPEN_FILES:
            _rename(self._temporary, self._target)
            bring_to_disk(self._target.parent)
        else:
            self._temporary.unlink()
        self._temporary = None
        self._let_go()

    def discard(self) -> None:
        """Remove the file, in which nothing was written; an earlier one stays. It must be closed."""
        self.at.unlink(missing_ok=True)
        if self._temporary is not None and not _RENAMES_OPEN_FILES:
            self._temporary.replace(self._target)
        self._let_go()

    def _let_go(self) -> None:
        if self._earlier is not None:
            self._earlier.close()
            self._earlier = None

    def _refuse(self) -> None:
        who = writer(self._target) or "another run"
        raise InputError(f"{self._path} is being written by {who}: end that one first, or give another name.")


@contextmanager
def _new_names(target: Path) -> Iterator[None]:
    """Within this, ``whole`` replaces no file at ``target``."""
    token = _new.set(_new.get() | {target})
    try:
        yield
    finally:
        _new.reset(token)


def _give_new_name(part: Path, path: Path, target: Path) -> None:
    """Rename a file to a name that does not exist yet; raises InputError if it does by now."""
    try:
        try:
            os.link(part, target)
        except FileExistsError:
            raise
        except OSError:  # a file system without links: an empty file holds the name for an instant
            target.open("xb").close()
            part.replace(target)
    except FileExistsError:
        _refuse_newcomer(path)
        raise


def _refuse_newcomer(path: Path) -> None:
    if path.exists():
        raise InputError(f"{path} came to be during the run and was left as it is: run again with another name.")


def _rename(part: Path, target: Path) -> None:
    """Rename a file; it gets the permissions of the one that it replaces."""
    if target.exists():
        shutil.copymode(target, part)
    part.replace(target)


def _same(one: Path, other: Path) -> bool:
    """Whether two names lead to one file, or would."""
    try:
        return one.samefile(other)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(other)


def _is_open(path: Path, descriptor: int) -> bool:
    """Whether a standard stream reads or writes this plain file; a device or a pipe cannot be harmed."""
    try:
        file, stream = path.stat(), os.fstat(descriptor)
    except OSError:
        return False
    return stat.S_ISREG(file.st_mode) and os.path.samestat(file, stream)


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
