"""Flight logs: PX4's ULog by pyulog, ArduPilot's DataFlash by pymavlink; every sensor's messages are a dataset."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from kf_calib.sources.containers.dataset import ArrayColumn, Dataset

DATAFLASH = b"\xa3\x95"
"""First bytes of a file of ArduPilot, unless it is written in letters."""
_ULOG_SENSORS = "sensor_accel", "sensor_combined"
"""Messages with what a sensor reads; others with accelerations are estimates."""
_DATAFLASH_SENSORS = "ACC", "IMU"
_OF_INSTANCES = [f"{name}{k}" for name in _DATAFLASH_SENSORS for k in ("", *range(1, 10))]


def ulog_datasets(path: Path) -> list[Dataset]:
    """The messages of a ULog file. A stamp counts microseconds."""
    from pyulog import ULog

    made = list[Dataset]()
    for each in ULog(str(path)).data_list:
        name = f"{each.name}.{each.multi_id}" if each.multi_id else each.name
        fields = {"time_us" if field == "timestamp" else field: np.asarray(values)
                  for field, values in each.data.items()}  # fmt: skip
        if each.name.startswith(_ULOG_SENSORS):
            fields.pop("timestamp_sample", None)
            fields = {field if field == "time_us" else f"{each.name}.{field}": values
                      for field, values in fields.items() if "timestamp" not in field}  # fmt: skip
            made.append(Dataset(name, fields, is_log=True))
        else:  # an estimate of the flight controller may have accelerations, which are not to be taken for readings
            made.append(Dataset(name, {"time_us": fields["time_us"]}, is_log=True))
    return sorted(made, key=lambda each: not each.has_readings)


def dataflash_datasets(path: Path) -> list[Dataset]:
    """The messages of accelerometers in a DataFlash file, those of each instance (``I``) for themselves."""
    from pymavlink.DFReader import DFReader_binary, DFReader_text

    with path.open("rb") as file:
        is_binary = file.read(len(DATAFLASH)) == DATAFLASH
    reader = DFReader_binary(str(path)) if is_binary else DFReader_text(str(path))
    rows = dict[str, list[list[float]]]()
    fields = dict[str, list[str]]()
    try:
        while (message := reader.recv_match(type=_OF_INSTANCES)) is not None:
            names = list(message.fmt.columns)
            instance = f".{message.I}" if "I" in names else ""
            key = message.get_type() + instance
            fields.setdefault(key, names)
            rows.setdefault(key, []).append([getattr(message, name) for name in names])
    finally:
        close = getattr(getattr(reader, "filehandle", None), "close", None)
        if close:
            close()
    made = [Dataset(key, _columns(fields[key], values), is_log=True) for key, values in rows.items()]
    return sorted(made, key=lambda each: not each.has_readings)


def _columns(names: Iterable[str], rows: list[list[float]]) -> dict[str, ArrayColumn]:
    """Return the columns of messages; the stamp counts microseconds, as the name of its field says."""
    renamed = ["time_us" if name == "TimeUS" else name for name in names if name != "SampleUS"]
    kept = [k for k, name in enumerate(names) if name != "SampleUS"]
    table = [np.array([row[k] for row in rows]) for k in kept]
    return dict(zip(renamed, table, strict=True))
