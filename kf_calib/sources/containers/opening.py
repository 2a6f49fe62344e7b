"""Which container a file is, by its first bytes, and the dataset of it that is read."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Iterator
from enum import Enum
from functools import lru_cache
from pathlib import Path

from kf_calib.errors import InputError, KfCalibError
from kf_calib.sources.containers.dataset import Dataset, chosen
from kf_calib.support.leaves import leaf

_HDF5, _DATAFLASH = b"\x89HDF\r\n\x1a\n", b"\xa3\x95"
_AFTER_A_BLOCK = 512  # bytes for the user, which MATLAB fills
_LARGEST_BYTES = 1 << 30


class ContainerKind(Enum):
    """A kind of container, as it is called."""

    MATLAB = "MATLAB"
    HDF5 = "HDF5"
    NUMPY = "NumPy"
    TDMS = "TDMS"
    PARQUET = "Parquet"
    ARROW = "Arrow"
    ULOG = "ULog"
    DATAFLASH = "DataFlash"


def kind_of_container(path: Path) -> ContainerKind | None:
    """What container a file is; None where it is none, or cannot be read."""
    try:
        with path.open("rb") as file:
            start = file.read(_AFTER_A_BLOCK + len(_HDF5))
    except OSError:  # said where the file is opened to be read
        return None
    if start.startswith(_HDF5) or start[_AFTER_A_BLOCK:] == _HDF5:
        return ContainerKind.HDF5
    if start.startswith(b"MATLAB 5.0") or (path.suffix.lower() == ".mat" and start[:1] in (b"\0", b"\xe8")):
        return ContainerKind.MATLAB
    if start.startswith(b"\x93NUMPY") or (start.startswith(b"PK") and path.suffix.lower() == ".npz"):
        return ContainerKind.NUMPY
    if start.startswith(b"TDSm"):
        return ContainerKind.TDMS
    if start.startswith((b"PAR1", b"ARROW1")):
        return ContainerKind.PARQUET if start.startswith(b"PAR1") else ContainerKind.ARROW
    if start.startswith(b"ULog\x01\x12\x35"):
        return ContainerKind.ULOG
    return ContainerKind.DATAFLASH if start.startswith((_DATAFLASH, b"FMT, 128,")) else None


def datasets_in(path: Path) -> tuple[Dataset, ...]:
    """All datasets of a container, in the order of the file. Raises InputError where it cannot be read, and
    MissingExtraError where a library is missing."""
    kind = kind_of_container(path)
    assert kind is not None
    status = path.stat()
    if status.st_size > _LARGEST_BYTES:
        raise InputError(f"{path}: is larger than 1 GB, and would be read into memory whole: save the run alone.")
    return _read(path, kind, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=2)
def _read(path: Path, kind: ContainerKind, *state: int) -> tuple[Dataset, ...]:
    """Return the datasets of a file in this state."""
    logs = leaf("logs.reading", f"{path}, a file of {kind.value},")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of libraries, on files that are odd and can be read, or that they leave open
        try:
            return tuple(logs.read_datasets(path, kind))
        except KfCalibError:
            raise
        except Exception as error:  # libraries raise what they like on a damaged file
            said = " ".join(str(error).split())[:100] or type(error).__name__
        gc.collect()  # closes what they left open
    raise InputError(f"{path}: cannot be read as a file of {kind.value} ({said}): copy it anew.")


def dataset_of(path: Path, name: str = "") -> Dataset:
    """The dataset of that name, or the one that is taken where none is stated; raises as ``datasets_in``."""
    return chosen(datasets_in(path), name, path)


class DatasetText:
    """The lines of a dataset as a file of text, to be read once."""

    def __init__(self, dataset: Dataset) -> None:
        self._pieces: Iterator[bytes] = dataset.lines()
        self._left, self._rows, self._read = b"", max(len(dataset), 1), 0

    @property
    def fraction(self) -> float:
        """The share that has been read."""
        return min(self._read / self._rows, 1.0)

    def read1(self, size: int) -> bytes:
        """The next bytes, no more than so many; none at the end."""
        if not self._left:
            self._left = next(self._pieces, b"")
            self._read += self._left.count(b"\n")
        block, self._left = self._left[:size], self._left[size:]
        return block
