"""One run as twenty-odd programs write it: twelve poses, three seconds in each, of a sensor that stands beside others.

docs/logs.md shows the beginning of each file; tests/sources/test_logs_of_strangers.py reads them all.
"""

import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

G = 9.80665
K, B = np.array([1.01, 0.99, 1.005]), np.array([0.2, -0.15, 0.3])
"""Scale factors and biases (m/s^2) of the sensor."""
UP = np.array([*np.eye(3), *-np.eye(3), [0.6, 0.8, 0], [0, 0.6, -0.8], [-0.8, 0, 0.6], [0.6, -0.8, 0], [0, 0.6, 0.8],
               [0.8, 0, 0.6]])  # fmt: skip
STILL, TURNING, RATE_HZ = 300, 60, 100
COUNT = len(UP) * (STILL + TURNING)
SECONDS = np.arange(COUNT) / RATE_HZ
EPOCH_NS = 1_779_874_200_000_000_000

Texts = list[str]
Columns = dict[str, Texts]


@cache
def readings() -> np.ndarray:
    """The readings (n, 3) in m/s^2."""
    rng, parts = np.random.default_rng(3), list[np.ndarray]()
    for up in UP:
        force = K * G * up / np.linalg.norm(up) + B
        parts += [force + rng.normal(0.0, 0.02, (STILL, 3)), force + rng.normal(0.0, 3.0, (TURNING, 3))]
    return np.round(np.concatenate(parts), 9)


@cache
def others() -> np.ndarray:
    """What other sensors read (n, 3)."""
    return np.random.default_rng(4).normal(0.0, 0.1, (COUNT, 3))


def texts(values: Any, form: str = "{:.9f}") -> Texts:
    return [form.format(value) for value in np.asarray(values).tolist()]


def three(pattern: str, values: np.ndarray, axes: Sequence[str] = "xyz", form: str = "{:.9f}") -> Columns:
    return {pattern.format(axis): texts(values[:, k], form) for k, axis in enumerate(axes)}


def rates(pattern: str, axes: Sequence[str] = "xyz") -> Columns:
    return three(pattern, others(), axes, "{:.4f}")


def constant(value: str, *names: str) -> Columns:
    return {name: [value] * COUNT for name in names}


def stamps_ns(jitter: bool = False) -> Texts:
    late_ns = np.random.default_rng(5).integers(0, 4_000_000, COUNT) if jitter else np.zeros(COUNT, np.int64)
    return [str(EPOCH_NS + k * 10_000_000 + late) for k, late in enumerate(late_ns.tolist())]


def imu_message(before: str, between: str, covariance: str) -> Columns:
    """The fields of sensor_msgs/Imu, its orientation never filled."""
    angular, linear = (f"{before}{name}{between}{{}}" for name in ("angular_velocity", "linear_acceleration"))
    return (
        constant("0.0", *(f"{before}orientation{between}{axis}" for axis in "xyz"))
        | constant("1.0", f"{before}orientation{between}w")
        | constant("-1.0", *(f"{before}orientation_covariance{covariance.format(k)}" for k in range(9)))
        | rates(angular)
        | constant("0.0", *(f"{before}angular_velocity_covariance{covariance.format(k)}" for k in range(9)))
        | three(linear, readings())
        | constant("0.0", *(f"{before}linear_acceleration_covariance{covariance.format(k)}" for k in range(9)))
    )


COMMA_TABLES: Mapping[str, Callable[[], Columns]] = {
    "rostopic echo -p": lambda: {
        "%time": stamps_ns(jitter=True), "field.header.seq": texts(range(COUNT), "{}"),
        "field.header.stamp": stamps_ns(), **constant("imu", "field.header.frame_id"),
        **imu_message("field.", ".", "{}")},
    "bagpy": lambda: {
        "Time": texts(EPOCH_NS / 1e9 + SECONDS, "{:.6f}"), "header.seq": texts(range(COUNT), "{}"),
        "header.stamp.secs": texts(EPOCH_NS // 10**9 + SECONDS // 1, "{:.0f}"),
        "header.stamp.nsecs": texts(1e9 * (SECONDS % 1), "{:.0f}"), **constant("imu", "header.frame_id"),
        **imu_message("", ".", "_{}")},
    "PlotJuggler": lambda: {
        "__time": texts(EPOCH_NS / 1e9 + SECONDS, "{:.6f}"), **imu_message("/imu/data/", "/", "[{}]"),
        **rates("/imu/data/orientation/{}", ("roll", "pitch", "yaw"))},
    "EuRoC": lambda: {
        "#timestamp [ns]": stamps_ns(), **rates("w_RS_S_{} [rad s^-1]"), **three("a_RS_S_{} [m s^-2]", readings())},
    "ASL without units": lambda: {
        "timestamp": stamps_ns(), **rates("w_RS_S_{}"), **three("a_RS_S_{}", readings())},
    "kalibr_bagextractor": lambda: {
        "timestamp": stamps_ns(), **rates("omega_{}"), **three("alpha_{}", readings())},
    "Klipper": lambda: {"#time": texts(1234.5 + SECONDS), **three("accel_{}", 1e3 * readings())},
    "MPU-6050 sketch": lambda: {
        "millis": texts(1e3 * SECONDS, "{:.0f}"), **three("Ac{}", readings(), "XYZ"), **constant("21.5", "Tmp"),
        **rates("Gy{}", "XYZ")},
    "nine-axis logger": lambda: {
        "time_s": texts(SECONDS, "{:.2f}"), **three("a{}", readings()), **rates("g{}"), **rates("m{}")},
    "WitMotion": lambda: {
        "Time(s)": texts(SECONDS, "{:.2f}"), "ChipTime": texts(SECONDS, "{:.2f}"),
        **three("a{}(g)", readings() / G, form="{:.12f}"), **rates("w{}(deg/s)"), **rates("Angle{}(deg)", "XYZ"),
        **constant("21.5", "T(°)"), **rates("h{}"), **constant("0.5", "q0", "q1", "q2", "q3")},
    "ulog2csv": lambda: {
        "timestamp": texts(1e6 * SECONDS + 2e7, "{:.0f}"), **rates("gyro_rad[{}]", "012"),
        **constant("0", "accelerometer_timestamp_relative"), **three("accelerometer_m_s2[{}]", readings(), "012"),
        **constant("0", "accelerometer_clipping")},
    "mavlogdump": lambda: {
        "TimeUS": texts(1e6 * SECONDS + 2e7, "{:.0f}"), **constant("0", "I"), **rates("Gyr{}", "XYZ"),
        **three("Acc{}", readings(), "XYZ"), **constant("41.5", "T")},
    "MT Manager": lambda: {
        "Timestamp [ms]": texts(1e3 * SECONDS, "{:.0f}"), **three("Acc_{}", readings(), "XYZ"),
        **rates("FreeAcc_{}", "XYZ"), **rates("Gyr_{}", "XYZ"), **rates("Mag_{}", "XYZ"),
        **constant("0.5", *(f"Quat_q{k}" for k in range(4)))},
    "Sensor Logger on a phone": lambda: {
        "seconds_elapsed": texts(SECONDS, "{:.2f}"), **rates("LINEAR ACCELERATION {} (m/s²)", "XYZ"),
        **three("ACCELEROMETER {} (m/s²)", readings(), "XYZ"), **rates("GRAVITY {} (m/s²)", "XYZ"),
        **rates("GYROSCOPE {} (rad/s)", "XYZ"), **rates("MAGNETIC FIELD {} (μT)", "XYZ"),
        **rates("ORIENTATION {} (°)", "XYZ")},
    "WitMotion with a clock": lambda: {
        "Time(s)": [f"09:{30 + int(at) // 60}:{at % 60.0:06.3f}" for at in SECONDS.tolist()],
        **three("a{}(g)", readings() / G, form="{:.12f}"), **rates("w{}(deg/s)"), **constant("21.5", "T(°)")},
    "a table of Grafana": lambda: {
        "Time": [f"2026-05-27 09:{30 + int(at) // 60}:{at % 60.0:06.3f}" for at in SECONDS.tolist()],
        **three("a{}", readings(), form='"{:.9f} m/s²"'), **constant("21.5 °C", "temperature")},
    "a simulator with its truth": lambda: {
        "time_s": texts(SECONDS, "{:.2f}"), **rates("{}_true (g)"),
        **three("{}_mean (g)", readings() / G, form="{:.12f}")},
}  # fmt: skip
"""The columns of tables in which a comma is between cells, by the program that writes them."""


def comma_table(columns: Columns) -> str:
    return "\n".join([",".join(columns), *map(",".join, zip(*columns.values(), strict=True)), ""])


def german_table() -> str:
    """A table as a German Excel saves it: semicolons, decimal commas, the date and the time of day in two columns."""
    rows = ["Datum;Uhrzeit;a_x [m/s²];a_y [m/s²];a_z [m/s²]"]
    for at, values in zip(SECONDS.tolist(), readings().tolist(), strict=True):
        x, y, z = (f"{value:.9f}".replace(".", ",") for value in values)
        rows.append(f"27.05.2026;09:30:{at:06.3f};{x};{y};{z}".replace(f"{at:06.3f}", f"{at:06.3f}".replace(".", ",")))
    return "\n".join([*rows, ""])


def bare_numbers() -> str:
    """Numbers without any heading, blanks between them."""
    rows = zip(SECONDS.tolist(), readings().tolist(), others().tolist(), strict=True)
    return "".join(
        f"{at:.2f} {' '.join(f'{value:.9f}' for value in force)} {' '.join(f'{value:.4f}' for value in other)}\n"
        for at, force, other in rows
    )


def below_a_rate() -> str:
    """As MT Manager writes the counters of a DOT, whose unit no name tells: the rate stands above."""
    counters = {"PacketCounter": texts(range(COUNT), "{:05d}"), "SampleTimeFine": texts(1e4 * SECONDS, "{:.0f}")}
    table = comma_table({**counters, **three("Acc_{}", readings(), "XYZ"), **rates("Gyr_{}", "XYZ")})
    return f"// Start Time: Unknown\n// Sample rate: {RATE_HZ}.0Hz\n// Firmware Version: 2.0.1\n{table}"


def dictionaries() -> str:
    """Dictionaries as Python prints them, with numbers of numpy."""
    rows = zip(SECONDS.tolist(), readings().tolist(), strict=True)
    return "".join(f"{{'t': np.float64({at:.2f}), 'acc': {force}, 'temperature': None}}\n" for at, force in rows)


def line_protocol() -> str:
    """Lines of a database of time series."""
    rows = zip(stamps_ns(), readings().tolist(), strict=True)
    return "".join(f"imu,sensor=mpu ax={x},ay={y},az={z} {at_ns}\n" for at_ns, (x, y, z) in rows)


def json_array() -> str:
    rows = zip(SECONDS.tolist(), *readings().T.tolist(), strict=True)
    return json.dumps(
        [{"sensor": "Accelerometer", "seconds_elapsed": t, "z": z, "y": y, "x": x} for t, x, y, z in rows]
    )


def echoed_messages() -> str:
    """The first fields of each message, as ``ros2 topic echo`` prints them."""
    rows = zip(map(int, stamps_ns()), readings().tolist(), others().tolist(), strict=True)
    return "".join(
        f"header:\n  stamp:\n    sec: {at_ns // 10**9}\n    nanosec: {at_ns % 10**9}\n  frame_id: imu\n"
        + "".join(f"{name}:\n  x: {x}\n  y: {y}\n  z: {z}\n{name}_covariance:\n- 0.0\n- 0.0\n- '...'\n"
                  for name, (x, y, z) in (("angular_velocity", turning), ("linear_acceleration", force)))
        + "---\n"
        for at_ns, force, turning in rows
    )  # fmt: skip


def json_lines() -> str:
    """An object a line, as a script of a web page or a message queue writes it."""
    return "".join(
        json.dumps({"time_ns": EPOCH_NS + k * 10_000_000, "accel_mps2": values}) + "\n"
        for k, values in enumerate(readings().tolist())
    )


def matlab(path: Path) -> None:
    """A struct of MATLAB with the readings, the rates and their time."""
    from scipy.io import savemat

    savemat(path, {"imu": {"t": SECONDS, "acc": readings(), "gyro": others()}, "note": "bench 2"})


def hdf5(path: Path) -> None:
    """A group for each sensor, the unit in an attribute; the magnetometer is slower."""
    import h5py

    with h5py.File(path, "w") as file:
        imu = file.create_group("imu0")
        imu["timestamps"] = SECONDS
        imu.create_dataset("accel", data=readings() / G, compression="gzip").attrs["units"] = "g"
        imu["gyro"] = others()
        file["mag/t"], file["mag/field"] = SECONDS[::10], others()[::10]


def npz(path: Path) -> None:
    """An archive of NumPy, its arrays on their sides, with the rate in a number beside them."""
    np.savez(path, fs=float(RATE_HZ), accel=readings().T, gyro=others().T)


def ros1_bag(path: Path) -> None:
    """A bag of ROS 1 with sensor_msgs/Imu, as its own writer makes it."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kinds = store.types
    vector, quaternion = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Quaternion"]
    with Writer(path) as bag:
        imu = bag.add_connection("/imu/data_raw", "sensor_msgs/msg/Imu", typestore=store)
        words = bag.add_connection("/rosout", "std_msgs/msg/String", typestore=store)
        for k, (force, rate) in enumerate(zip(readings().tolist(), others().tolist(), strict=True)):
            at_ns = EPOCH_NS + k * 10_000_000
            stamp = kinds["builtin_interfaces/msg/Time"](sec=at_ns // 10**9, nanosec=at_ns % 10**9)
            message = kinds["sensor_msgs/msg/Imu"](
                kinds["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id="imu"), quaternion(0.0, 0.0, 0.0, 1.0),
                np.array([-1.0] + [0.0] * 8), vector(*rate), np.zeros(9), vector(*force), np.zeros(9),
            )  # fmt: skip
            bag.write(imu, at_ns, store.serialize_ros1(message, "sensor_msgs/msg/Imu"))
        said = kinds["std_msgs/msg/String"](data="the end")
        bag.write(words, EPOCH_NS, store.serialize_ros1(said, "std_msgs/msg/String"))


def mcap_of_ros2(path: Path) -> None:
    """An MCAP file of ROS 2 with sensor_msgs/Imu."""
    from mcap_ros2.writer import Writer

    definition = _imu_definition()
    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/Imu", definition)
        for k, (force, rate) in enumerate(zip(readings().tolist(), others().tolist(), strict=True)):
            at_ns = EPOCH_NS + k * 10_000_000
            message = {
                "header": {"stamp": {"sec": at_ns // 10**9, "nanosec": at_ns % 10**9}, "frame_id": "imu"},
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}, "orientation_covariance": [-1.0] + [0.0] * 8,
                "angular_velocity": dict(zip("xyz", rate, strict=True)), "angular_velocity_covariance": [0.0] * 9,
                "linear_acceleration": dict(zip("xyz", force, strict=True)),
                "linear_acceleration_covariance": [0.0] * 9,
            }  # fmt: skip
            writer.write_message("/imu/data_raw", schema, message, at_ns, at_ns, k)
        writer.finish()


def _imu_definition() -> str:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE).generate_msgdef("sensor_msgs/msg/Imu", ros_version=2)[0]


def ulog(path: Path) -> None:
    """A flight log of PX4 with two accelerometers and an estimate without gravity, written by its format's own rules
    (https://docs.px4.io/main/en/dev_log/ulog_file_format.html)."""

    def message(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0), message("B", bytes(40))]
    formats = ("sensor_accel:uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;",
               "vehicle_local_position:uint64_t timestamp;float ax;float ay;float az;")  # fmt: skip
    parts += [message("F", each.encode()) for each in formats]
    logged = ("sensor_accel", 0), ("sensor_accel", 1), ("vehicle_local_position", 0)
    for number, (name, instance) in enumerate(logged):
        parts.append(message("A", struct.pack("<BH", instance, number) + name.encode()))
    for k, force in enumerate(readings().tolist()):
        at_us = 20_000_000 + 10_000 * k
        parts.append(message("D", struct.pack("<HQQI3f", 0, at_us, at_us - 100, 7, *force)))
        parts.append(message("D", struct.pack("<HQ3f", 2, at_us, 0.0, 0.0, 9.8)))
        if k % 10 == 0:
            parts.append(message("D", struct.pack("<HQQI3f", 1, at_us, at_us - 100, 8, 1.0, 2.0, 9.0)))
    path.write_bytes(b"".join(parts))


def dataflash(path: Path) -> None:
    """A flight log of ArduPilot with two units by their instance, written by its format's own rules
    (https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html)."""

    def described(number: int, length: int, name: str, form: str, columns: str) -> bytes:
        return struct.pack("<3s2B4s16s64s", b"\xa3\x95\x80", number, length, name.encode(), form.encode(),
                           columns.encode())  # fmt: skip

    parts = [described(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"),
             described(129, 36, "IMU", "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")]  # fmt: skip
    for k, (force, rate) in enumerate(zip(readings().tolist(), others().tolist(), strict=True)):
        at_us = 20_000_000 + 10_000 * k
        parts.append(struct.pack("<3sQB6f", b"\xa3\x95\x81", at_us, 0, *rate, *force))
        if k % 10 == 0:
            parts.append(struct.pack("<3sQB6f", b"\xa3\x95\x81", at_us, 1, *rate, 1.0, 2.0, 9.0))
    path.write_bytes(b"".join(parts))


def tdms(path: Path) -> None:
    """Waveforms of LabVIEW: each channel has the step of its stamps."""
    from nptdms import ChannelObject, TdmsWriter

    channels = {f"Acceleration {axis}": (readings()[:, k] / G, "g") for k, axis in enumerate("XYZ")}
    channels["Rate X"] = others()[:, 0], "deg/s"
    with TdmsWriter(path) as writer:
        writer.write_segment([
            ChannelObject("IMU", name, values, {"unit_string": unit, "wf_increment": 1.0 / RATE_HZ})
            for name, (values, unit) in channels.items()
        ])  # fmt: skip


def parquet(path: Path, *, as_arrow: bool) -> None:
    """Messages as a table, their vectors as structs."""
    import pyarrow as pa
    from pyarrow import feather
    from pyarrow import parquet as files

    vectors = {"linear_acceleration": readings(), "angular_velocity": others()}
    structs = {name: pa.StructArray.from_arrays(list(map(pa.array, values.T)), list("xyz"))
               for name, values in vectors.items()}  # fmt: skip
    table = pa.table({"timestamp": pa.array(list(map(int, stamps_ns())), pa.timestamp("ns", "UTC")), **structs})
    feather.write_feather(table, path) if as_arrow else files.write_table(table, path)


@dataclass(frozen=True)
class ForeignLog:
    """A file as another program writes it. holds: what is in it, where it is no text. digits: to which size its numbers
    are those of the run."""

    file: str
    write: Callable[[Path], Any]
    holds: str = ""
    digits: float = 1e-9

    def at(self, folder: Path) -> Path:
        self.write(folder / self.file)
        return folder / self.file


def _texts_of(columns: Callable[[], Columns]) -> Callable[[Path], Any]:
    return lambda path: path.write_text(comma_table(columns()), encoding="utf-8")


_MESSAGES = f"""\
timestamp            {COUNT}
linear_acceleration  {COUNT}, x, y, z
angular_velocity     {COUNT}, x, y, z"""
FOREIGN_LOGS: Mapping[str, ForeignLog] = {
    **{name: ForeignLog("log.csv", _texts_of(columns)) for name, columns in COMMA_TABLES.items()},
    "a German Excel": ForeignLog("log.csv", lambda path: path.write_text(german_table(), encoding="cp1252")),
    "numbers alone": ForeignLog("log.txt", lambda path: path.write_text(bare_numbers())),
    "a rate above the names": ForeignLog("log.csv", lambda path: path.write_text(below_a_rate())),
    "dictionaries of Python": ForeignLog("log.txt", lambda path: path.write_text(dictionaries())),
    "InfluxDB": ForeignLog("log.txt", lambda path: path.write_text(line_protocol())),
    "JSON lines": ForeignLog("log.jsonl", lambda path: path.write_text(json_lines())),
    "an array of JSON": ForeignLog("log.json", lambda path: path.write_text(json_array())),
    "ros2 topic echo": ForeignLog(
        "log.txt", lambda path: path.write_text(echoed_messages()), echoed_messages().partition("\n---")[0] + "\n---"
    ),
    "a struct of MATLAB": ForeignLog(
        "log.mat",
        matlab,
        f"""\
imu.t     {COUNT}
imu.acc   {COUNT} x 3
imu.gyro  {COUNT} x 3
note      'bench 2'""",
    ),
    "groups of HDF5": ForeignLog(
        "log.h5",
        hdf5,
        f"""\
/imu0/timestamps  {COUNT}
/imu0/accel       {COUNT} x 3, units: g
/imu0/gyro        {COUNT} x 3
/mag/t            {COUNT // 10}
/mag/field        {COUNT // 10} x 3""",
    ),
    "an archive of NumPy": ForeignLog(
        "log.npz",
        npz,
        f"""\
fs     100
accel  3 x {COUNT}
gyro   3 x {COUNT}""",
    ),
    "TDMS of LabVIEW": ForeignLog(
        "log.tdms",
        tdms,
        f"""\
IMU/Acceleration X  {COUNT}, unit_string: g, wf_increment: 0.01
IMU/Acceleration Y  {COUNT}, unit_string: g, wf_increment: 0.01
IMU/Acceleration Z  {COUNT}, unit_string: g, wf_increment: 0.01
IMU/Rate X          {COUNT}, unit_string: deg/s, wf_increment: 0.01""",
    ),
    "a Parquet table": ForeignLog("log.parquet", partial(parquet, as_arrow=False), _MESSAGES),
    "a Feather table": ForeignLog("log.feather", partial(parquet, as_arrow=True), _MESSAGES),
    "a bag of ROS 1": ForeignLog(
        "log.bag",
        ros1_bag,
        f"""\
/imu/data_raw  sensor_msgs/Imu  {COUNT}
/rosout        std_msgs/String  1""",
    ),
    "MCAP of ROS 2": ForeignLog(
        "log.mcap",
        mcap_of_ros2,
        f"""\
/imu/data_raw  sensor_msgs/msg/Imu  {COUNT}""",
    ),
    "a ULog of PX4": ForeignLog(
        "log.ulg",
        ulog,
        f"""\
sensor_accel            {COUNT}  timestamp, timestamp_sample, device_id, x, y, z
sensor_accel.1          {COUNT // 10}  timestamp, timestamp_sample, device_id, x, y, z
vehicle_local_position  {COUNT}  timestamp, ax, ay, az""",
        1e-6,
    ),
    "a DataFlash log of ArduPilot": ForeignLog(
        "log.bin",
        dataflash,
        f"""\
IMU, I = 0  {COUNT}  TimeUS, I, GyrX, GyrY, GyrZ, AccX, AccY, AccZ
IMU, I = 1  {COUNT // 10}  TimeUS, I, GyrX, GyrY, GyrZ, AccX, AccY, AccZ""",
        1e-6,
    ),
}
