"""The datasets of a file, by what reads each kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from kf_calib.errors import need
from kf_calib.logs.arrays import arrow_arrays, hdf5_arrays, matlab_arrays, numpy_arrays, parquet_arrays, tdms_arrays
from kf_calib.logs.flight_logs import dataflash_datasets, ulog_datasets
from kf_calib.logs.groups import ArrayGroup, datasets_of
from kf_calib.sources.containers.dataset import Dataset
from kf_calib.sources.containers.opening import ContainerKind

_READERS: dict[ContainerKind, tuple[str, Callable[[Path], list[Dataset] | ArrayGroup]]] = {
    ContainerKind.MATLAB: ("scipy", matlab_arrays),
    ContainerKind.HDF5: ("h5py", hdf5_arrays),
    ContainerKind.NUMPY: ("numpy", numpy_arrays),
    ContainerKind.TDMS: ("nptdms", tdms_arrays),
    ContainerKind.PARQUET: ("pyarrow", parquet_arrays),
    ContainerKind.ARROW: ("pyarrow", arrow_arrays),
    ContainerKind.ULOG: ("pyulog", ulog_datasets),
    ContainerKind.DATAFLASH: ("pymavlink", dataflash_datasets),
}


def read_datasets(path: Path, kind: ContainerKind) -> list[Dataset]:
    """All datasets, in the order of the file; raises MissingExtraError where a library is missing, and what that raises
    on a damaged file."""
    package, read = _READERS[kind]
    need(package, "logs", f"{path}, a file of {kind.value},")
    content = read(path)
    return datasets_of(content) if isinstance(content, ArrayGroup) else content
