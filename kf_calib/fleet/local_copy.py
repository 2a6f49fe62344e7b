"""A recording of any store as a file on this machine, for as long as it is read."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from kf_calib.errors import InputError
from kf_calib.fleet.run_list import Run

_KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device"}


@contextmanager
def local_copy(run: Run) -> Iterator[Path]:
    """The path of the recording itself, or of a copy that is gone when the block ends. Raises InputError where it
    cannot be fetched."""
    try:
        files, path = url_to_fs(run.place)
    except (ValueError, ImportError) as error:
        raise InputError(f"{run.place}: cannot be looked up ({error}): check the name and what is installed.") from None
    if isinstance(files, LocalFileSystem):
        yield _plain(Path(str(path)))
        return
    with TemporaryDirectory(prefix="kf-calib-") as folder:
        target = Path(folder, Path(str(path)).name)
        try:
            files.get(str(path), str(target), recursive=run.folder)
        except Exception as error:  # each store has errors of its own
            said = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"{run.place}: cannot be fetched ({said}): check the name and the access.") from None
        yield target


def _plain(path: Path) -> Path:
    """The path of a file or folder; InputError for what may be read for ever, as a pipe to which nobody writes."""
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except OSError:  # whoever reads it says why it cannot be read
        return path
    if kind in (stat.S_IFREG, stat.S_IFDIR):
        return path
    raise InputError(f"{path}: is {_KINDS.get(kind, 'no file')}, which may never end: name a recording on a disk.")
