"""A recording of any store as a file on this machine, for as long as it is read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem

from kf_calib.errors import InputError
from kf_calib.fleet.run_list import Run


@contextmanager
def local_copy(run: Run) -> Iterator[Path]:
    """The path of the recording itself, or of a copy that is gone when the block ends. Raises InputError where it
    cannot be fetched."""
    try:
        files, path = url_to_fs(run.place)
    except (ValueError, ImportError) as error:
        raise InputError(f"{run.place}: cannot be looked up ({error}): check the name and what is installed.") from None
    if isinstance(files, LocalFileSystem):
        yield Path(str(path))
        return
    with TemporaryDirectory(prefix="kf-calib-") as folder:
        target = Path(folder, Path(str(path)).name)
        try:
            files.get(str(path), str(target), recursive=run.folder)
        except Exception as error:  # each store has errors of its own
            said = " ".join(str(error).split()) or type(error).__name__
            raise InputError(f"{run.place}: cannot be fetched ({said}): check the name and the access.") from None
        yield target
