"""Files of arrays: MATLAB's .mat of versions 4 to 7.3, HDF5, NumPy's, LabVIEW's .tdms, tables in Parquet and Arrow."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kf_calib.errors import InputError
from kf_calib.logs.groups import ArrayGroup, Values
from kf_calib.sources.containers.dataset import ArrayColumn
from kf_calib.sources.text.names import is_unit

if TYPE_CHECKING:
    import h5py
    import pyarrow

_LARGEST_BYTES = 2 << 30  # of all arrays of a file, unpacked
_MOST_LEVELS, _MOST_STRUCTS = 16, 1000


def matlab_arrays(path: Path) -> ArrayGroup:
    """The arrays of a .mat file up to version 7."""
    from scipy.io import loadmat, whosmat

    _refuse_large(path, sum(8 * math.prod(shape) for _, shape, _ in whosmat(path)))
    root = ArrayGroup()
    _put_structs(root, (), loadmat(path, simplify_cells=True))
    return root


def _put_structs(root: ArrayGroup, path: tuple[str, ...], value: Any) -> None:
    """Put what a variable of MATLAB holds: a struct, a list of these, or an array."""
    if len(path) > _MOST_LEVELS:
        return
    if isinstance(value, Mapping):
        for name, part in value.items():
            if not name.startswith("__"):
                _put_structs(root, (*path, name), part)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object and value.ndim == 1):
        for k, part in enumerate(value[:_MOST_STRUCTS], start=1):
            _put_structs(root, (*path, str(k)), part)
    else:
        root.put(path, value)


def hdf5_arrays(path: Path) -> ArrayGroup:
    """The arrays of an HDF5 file, of its attributes the single numbers; what lies in other files is not followed."""
    import h5py

    root, size = ArrayGroup(), 0
    with h5py.File(path, "r") as file:

        def put(name: str, node: h5py.Dataset | h5py.Group | h5py.Datatype) -> None:
            nonlocal size
            place = tuple(name.split("/")) if name else ()
            is_array = isinstance(node, h5py.Dataset)
            for key, value in node.attrs.items():
                if np.ndim(value) == 0:
                    root.put((*(place[:-1] if is_array else place), key), value)
            if is_array and not node.is_virtual and not node.external and node.ndim <= 2:
                size += (node.size or 0) * max(node.dtype.itemsize, 1)
                _refuse_large(path, size)
                root.put(place, _read(node), _unit_of(node))

        put("", file["/"])
        file.visititems(put)  # each object once, no links to other files
    _name_pandas_blocks(root)
    return root


def _read(node: h5py.Dataset) -> ArrayColumn:
    """Return the values of a dataset; texts as such."""
    import h5py

    is_text = h5py.check_string_dtype(node.dtype) is not None
    return np.asarray(node.asstr(errors="replace")[()], dtype=str) if is_text else np.asarray(node[()])


def _unit_of(node: h5py.Dataset) -> str:
    """Return the unit that the attributes of a dataset state; nothing where they state none."""
    value = next((node.attrs[key] for key in ("units", "unit", "Units", "Unit") if key in node.attrs), "")
    return _unit(value.decode(errors="replace") if isinstance(value, bytes) else value)


def _unit(text: object) -> str:
    """Return a text that is a unit; nothing for any other."""
    return text if isinstance(text, str) and is_unit(text) else ""


def _name_pandas_blocks(group: ArrayGroup) -> None:
    """Give the blocks of a DataFrame, as pandas writes it, the names of their columns, and its index that of a time."""
    for each in group.groups.values():
        _name_pandas_blocks(each)
    arrays, k = group.arrays, 0
    while f"block{k}_items" in arrays and f"block{k}_values" in arrays:
        names, values = arrays.pop(f"block{k}_items").array, arrays.pop(f"block{k}_values").array
        for name, column in zip(names.tolist(), np.atleast_2d(values).T, strict=False):
            arrays[name.decode(errors="replace") if isinstance(name, bytes) else str(name)] = Values(column)
        k += 1
    if k and "axis0" in arrays and "axis1" in arrays:
        del arrays["axis0"]
        arrays["t"] = arrays.pop("axis1")


def numpy_arrays(path: Path) -> ArrayGroup:
    """The arrays of a .npy or .npz file; objects in them are not read, for that could run code."""
    root = ArrayGroup()
    with path.open("rb") as file:  # NumPy leaves its own open where it is damaged
        loaded: Any = np.load(file, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            root.put(() if loaded.dtype.names else (path.stem,), loaded)
            return root
        _refuse_large(path, sum(part.file_size for part in loaded.zip.infolist()))
        for name in loaded.files:
            root.put((name,), loaded[name])
    return root


def tdms_arrays(path: Path) -> ArrayGroup:
    """The channels of a TDMS file of LabVIEW, by their groups, with the step of their waveforms."""
    from nptdms import TdmsFile
    from nptdms.log import log_manager

    log_manager.set_level(logging.ERROR)  # that a file ends early is seen by what it holds
    root = ArrayGroup()
    with path.open("rb") as opened, TdmsFile.open(opened) as file:  # which leaves its own open where it is damaged
        groups = file.groups()
        _refuse_large(path, sum(8 * len(channel) for group in groups for channel in group.channels()))
        for group in groups:
            for channel in group.channels():
                stated = channel.properties
                root.put((group.name, channel.name), channel[:], _unit(stated.get("unit_string")))
                if step_s := stated.get("wf_increment"):
                    root.put((group.name, channel.name, "dt"), step_s)
    return root


def parquet_arrays(path: Path) -> ArrayGroup:
    """The columns of a table in a Parquet file."""
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        groups = range(file.metadata.num_row_groups)
        _refuse_large(path, sum(file.metadata.row_group(k).total_byte_size for k in groups))
        return _of_table(file.read())


def arrow_arrays(path: Path) -> ArrayGroup:
    """The columns of a table in a file of Arrow, which Feather is, too."""
    from pyarrow import feather

    return _of_table(feather.read_table(path))


def _of_table(table: pyarrow.Table) -> ArrayGroup:
    """Return the columns of a table; the parts of a struct are columns, and vectors of one length an array."""
    from pyarrow import types

    root = ArrayGroup()
    while any(types.is_struct(each.type) for each in table.schema):
        table = table.flatten()
    for name, column in zip(table.column_names, table.columns, strict=True):
        is_text = types.is_string(column.type) or types.is_large_string(column.type)
        is_vector = types.is_list(column.type) or types.is_fixed_size_list(column.type)
        values = np.array(column.to_pylist()) if is_vector or is_text else column.to_numpy()
        root.put(tuple(name.split(".")), values)
    return root


def _refuse_large(path: Path, size: float) -> None:
    if size > _LARGEST_BYTES:
        raise InputError(f"{path}: its arrays take {size / 1e9:.1f} GB: save those of the run alone.")
