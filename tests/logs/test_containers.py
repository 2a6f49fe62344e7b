"""Files of arrays: which dataset is read, what of it, and that damaged and hostile ones are refused in a sentence."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.bounded import bounded
from helpers.foreign_logs import FOREIGN_LOGS, RATE_HZ, SECONDS, UP, B, G, K, dataflash, others, readings, ulog
from helpers.long_runs import slow
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat

from kf_calib import errors
from kf_calib.bench.streams import Table
from kf_calib.errors import InputError, KfCalibError, MissingExtraError
from kf_calib.sources.containers.opening import ContainerKind, dataset_of, datasets_in, kind_of_container
from kf_calib.sources.opening import opened
from kf_calib.sources.text.lines import Lines
from kf_calib.sources.text.units import Units

GRAVITY = {"gravity_mps2": str(G)}
ARRAYS = {
    "log.mat": ContainerKind.MATLAB, "log.h5": ContainerKind.HDF5, "log.npz": ContainerKind.NUMPY,
    "log.tdms": ContainerKind.TDMS, "log.parquet": ContainerKind.PARQUET, "log.feather": ContainerKind.ARROW,
    "log.ulg": ContainerKind.ULOG, "log.bin": ContainerKind.DATAFLASH,
}  # fmt: skip
LOGS = {log.file: log for log in FOREIGN_LOGS.values() if log.file in ARRAYS}


def read(path: Path, dataset: str = "") -> tuple[np.ndarray, np.ndarray]:
    """Times in s since the first, and readings."""
    batches = list(Lines(path, GRAVITY, units=Units(dataset=dataset), angles=False))
    times = np.concatenate([batch.accel.time_ns for batch in batches])
    return (times - times[0]) / 1e9, np.concatenate([batch.accel.values for batch in batches])


def of_two_units(path: Path) -> None:
    unit = {"t": SECONDS, "accel": readings(), "gyro": others()}
    savemat(path, {"imu0": unit, "imu1": unit | {"accel": readings()[::-1]}})


def of_structs_in_a_list(path: Path) -> None:
    unit = {"t": SECONDS, "accel": readings()}
    savemat(path, {"imu": np.array([unit, unit | {"accel": readings()[::-1]}], dtype=object)})


def of_version_73(path: Path) -> None:
    """As MATLAB writes it: HDF5 after 512 bytes, arrays with their dimensions the other way round."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["acc"], file["t"], file["#refs#/a"] = readings().T, SECONDS[None], np.zeros(2)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(128))


def of_records(path: Path) -> None:
    rows = np.zeros(len(SECONDS), dtype=[("time_ns", "i8"), ("ax_mps2", "f8"), ("ay_mps2", "f8"), ("az_mps2", "f8")])
    rows["time_ns"] = np.rint(SECONDS * 1e9).astype(np.int64) + 1_700_000_000_000_000_000
    rows["ax_mps2"], rows["ay_mps2"], rows["az_mps2"] = readings().T
    with h5py.File(path, "w") as file:
        file["log"] = rows


def of_pandas(path: Path) -> None:
    """The blocks in which pandas writes a DataFrame by default."""
    names = [b"acc_x (m/s^2)", b"acc_y (m/s^2)", b"acc_z (m/s^2)"]
    with h5py.File(path, "w") as file:
        group = file.create_group("df")
        group["axis0"], group["axis1"] = names, SECONDS
        group["block0_items"], group["block0_values"] = names, readings()


def of_a_matrix(path: Path) -> None:
    np.save(path, np.column_stack([SECONDS, readings(), others()]))


SHAPES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "two units in structs": ("a.mat", of_two_units),
    "structs in a list": ("a.mat", of_structs_in_a_list),
    "version 4": ("a.mat", lambda path: savemat(path, {"t": SECONDS, "acc": readings()}, format="4")),
    "version 7.3": ("a.mat", of_version_73),
    "compressed": ("a.mat", lambda path: savemat(path, {"t": SECONDS, "acc": readings()}, do_compression=True)),
    "one matrix": ("a.npy", of_a_matrix),
    "records": ("a.h5", of_records),
    "pandas": ("a.h5", of_pandas),
    "whatever the name ends in": ("a.dat", of_records),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_whatever_the_arrays_lie_in_the_readings_are_the_same(shape: str, tmp_path: Path) -> None:
    name, write = SHAPES[shape]
    write(tmp_path / name)
    times, found = read(tmp_path / name)
    np.testing.assert_array_equal(found, readings())
    np.testing.assert_allclose(times, SECONDS, atol=1e-9)


@pytest.mark.parametrize("file", LOGS)
def test_kinds_are_told_by_the_first_bytes(file: str, tmp_path: Path) -> None:
    path = LOGS[file].at(tmp_path)
    assert kind_of_container(path) is ARRAYS[file]


def test_of_several_datasets_the_one_with_the_most_rows_is_read_and_any_can_be_chosen(tmp_path: Path, run: Any) -> None:
    of_two_units(tmp_path / "two.mat")
    np.testing.assert_array_equal(read(tmp_path / "two.mat", "/imu1")[1], readings()[::-1])
    warnings = run.json("replay", tmp_path / "two.mat", "--gravity", G)["warnings"]
    assert any("/imu0 was read, not /imu1 (4320 rows): --accel-topic" in said for said in warnings)
    told = run.json("info", tmp_path / "two.mat", "--accel-topic", "/imu1")
    assert told["format"] == "matlab" and [each["topic"] for each in told["topics"]] == ["readings", "/imu0"]
    assert "--accel-topic /imu1" in told["command"] and told["topics"][1]["rate_hz"] == pytest.approx(RATE_HZ)
    err = run.refused("replay", tmp_path / "two.mat", "--gravity", G, "--accel-topic", "/imu2")
    assert "has no dataset '/imu2' (--accel-topic), it has /imu0 (4320 rows), /imu1" in err
    ulog(tmp_path / "log.ulg")
    dataflash(tmp_path / "log.bin")
    assert [each.name for each in datasets_in(tmp_path / "log.bin")] == ["IMU.0", "IMU.1"]
    assert len(read(tmp_path / "log.bin", "IMU.1")[1]) == len(read(tmp_path / "log.ulg", "sensor_accel.1")[1]) == 432
    estimate = next(each for each in datasets_in(tmp_path / "log.ulg") if each.name == "vehicle_local_position")
    assert not estimate.has_readings  # it has ax, ay and az, of which gravity was taken off


def test_poses_of_a_table_in_arrays(tmp_path: Path, run: Any) -> None:
    """A row a pose, with gimbal angles and a column of names: what a spreadsheet would hold."""
    up = np.vstack([UP, UP[:6]])
    savemat(tmp_path / "poses.mat", {"acc_mean": K * G * up + B, "n": np.arange(18.0)})
    source = opened(tmp_path / "poses.mat", GRAVITY, angles=False)
    assert isinstance(source, Table)
    np.testing.assert_allclose(source.orientations.mean_mps2, K * G * up + B, rtol=1e-12)
    code, _, err = run("info", tmp_path / "poses.mat", "--gravity", G)
    assert code == 0, err


def test_a_rate_beside_the_readings_gives_their_time_and_is_said(tmp_path: Path, run: Any) -> None:
    savemat(tmp_path / "rate.mat", {"dt": 0.01, "accel": readings()})
    np.testing.assert_allclose(read(tmp_path / "rate.mat")[0], SECONDS, atol=1e-9)
    code, out, err = run("replay", tmp_path / "rate.mat", "--gravity", G)
    assert code == 0, err
    assert "time of / from 100 rows a second, as 'dt' states" in out + err
    savemat(tmp_path / "none.mat", {"accel": readings()})
    assert "--rate 100" in run.refused("replay", tmp_path / "none.mat", "--gravity", G)
    code, out, err = run("replay", tmp_path / "none.mat", "--gravity", G, "--rate", "100")
    assert code == 0, err


def test_a_corrected_copy_is_a_table_of_the_dataset(tmp_path: Path, run: Any) -> None:
    log = LOGS["log.mat"].at(tmp_path)
    code, _, err = run("replay", log, "--gravity", G, "--save", tmp_path / "cal.json")
    assert code == 0, err
    code, _, err = run("apply", tmp_path / "cal.json", log, "-o", tmp_path / "force.csv")
    assert code == 0, err
    _, force = read(tmp_path / "force.csv")
    norms = np.linalg.norm(force[:300], axis=1)
    assert np.mean(norms) == pytest.approx(G, abs=0.01)


def of_an_external_link(path: Path) -> None:
    with h5py.File(path.with_name("secret.h5"), "w") as file:
        file["accel"] = readings()
    with h5py.File(path, "w") as file:
        file["accel"] = h5py.ExternalLink("secret.h5", "/accel")
        file["t"] = SECONDS


def of_a_virtual_dataset(path: Path) -> None:
    with h5py.File(path.with_name("secret.h5"), "w") as file:
        file["accel"] = readings()
    layout = h5py.VirtualLayout(shape=readings().shape, dtype="f8")
    layout[:] = h5py.VirtualSource("secret.h5", "accel", shape=readings().shape)
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset("accel", layout)
        file["t"] = SECONDS


def of_a_huge_array(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("accel", shape=(1 << 30, 3), dtype="f8", chunks=(1 << 16, 3), compression="gzip")


def of_objects(path: Path) -> None:
    np.save(path, np.array([{"a": 1}, print], dtype=object), allow_pickle=True)


def of_a_circle(path: Path) -> None:
    with h5py.File(path, "w") as file:
        group = file.create_group("a")
        group["back"] = h5py.SoftLink("/a")
        group["hard"] = file["a"]


def of_nested_structs(path: Path) -> None:
    value: Any = np.zeros(3)
    for _ in range(60):
        value = {"s": value}
    savemat(path, value)


HOSTILE: dict[str, tuple[str, Callable[[Path], Any], str]] = {
    "a link to another file": ("a.h5", of_an_external_link, "no dataset holds three readings"),
    "a dataset of another file": ("a.h5", of_a_virtual_dataset, "no dataset holds three readings"),
    "26 GB of zeros": ("a.h5", of_a_huge_array, "its arrays take 25.8 GB"),
    "objects of Python": ("a.npy", of_objects, "cannot be read as a file of NumPy"),
    "a circle of groups": ("a.h5", of_a_circle, "no array of numbers"),
    "structs in structs": ("a.mat", of_nested_structs, "no array of numbers"),
    "texts alone": ("a.mat", partial(savemat, mdict={"note": "hi"}), "no array of numbers"),
    "complex numbers": ("a.mat", partial(savemat, mdict={"acc": readings() + 0j}), "no array of numbers"),
    "three dimensions": ("a.mat", partial(savemat, mdict={"acc": np.zeros((9, 9, 9))}), "no array of numbers"),
    "other lengths": ("a.mat", partial(savemat, mdict={"ax": SECONDS, "ay": SECONDS[1:], "az": SECONDS[2:]}),
                      "no dataset holds three readings"),
    "no array": ("a.npz", partial(np.savez), "no array of numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_no_log_is_refused_in_a_sentence(name: str, run: Any, tmp_path: Path) -> None:
    file, write, said = HOSTILE[name]
    write(tmp_path / file)
    for command in (["info"], ["replay", "--gravity", "9.81"]):
        with bounded(megabytes=900.0):
            assert said in run.refused(command[0], tmp_path / file, *command[1:])


@pytest.mark.parametrize("file", [*LOGS, "log.bag"])
@pytest.mark.parametrize("count", [12, *slow(200)])
def test_damaged_files_are_read_or_refused_in_a_sentence(file: str, count: int, tmp_path: Path) -> None:
    """Cut off, and with bytes that are others."""
    log = next(log for log in FOREIGN_LOGS.values() if log.file == file)
    content, rng = log.at(tmp_path).read_bytes(), np.random.default_rng(count)
    for k in range(count):
        changed = bytearray(content[: int(rng.integers(len(content)))] if k % 2 else content)
        for at in rng.integers(0, max(len(changed), 1), 0 if k % 4 == 1 else int(rng.integers(1, 40))):
            if len(changed) > at:
                changed[at] = rng.integers(256)
        path = tmp_path / f"{k}{Path(file).suffix}"
        path.write_bytes(changed)
        try:
            with bounded(megabytes=900.0):
                for batch in opened(path, GRAVITY, angles=False):
                    assert np.isfinite(batch.accel.values).all()
        except KfCalibError as error:
            assert str(error).count("\n") == 0


@pytest.mark.parametrize(("file", "package"), [("log.h5", "h5py"), ("log.ulg", "pyulog"), ("log.bin", "pymavlink"),
                                              ("log.bag", "rosbags")])  # fmt: skip
def test_a_library_that_is_missing_is_named(
    file: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = next(log for log in FOREIGN_LOGS.values() if log.file == file).at(tmp_path)
    monkeypatch.setattr(errors, "find_spec", lambda name: None if name == package else object())
    with pytest.raises(MissingExtraError, match=rf"needs {package}, .*pip install 'kf_calib\[logs\]'"):
        list(opened(path, GRAVITY, angles=False))


def test_a_dataset_that_is_changed_on_the_disk_is_read_anew(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"t": SECONDS, "acc": readings()})
    assert len(dataset_of(path)) == len(SECONDS)
    savemat(path, {"t": SECONDS[:50], "acc": readings()[:50]})
    assert len(dataset_of(path)) == 50
    with pytest.raises(InputError, match="no dataset 'x'"):
        dataset_of(path, "x")


def test_gyroscopes_are_those_of_the_dataset_that_is_chosen(tmp_path: Path, run: Any) -> None:
    unit = {"t": SECONDS, "accel": np.tile([0.0, 0.0, G], (len(SECONDS), 1)) + 0.1 * others(), "gyro": others()}
    savemat(tmp_path / "two.mat", {"imu0": unit, "imu1": unit | {"gyro": 3.0 * others()}})
    white = list[float]()
    for dataset in ("/imu0", "/imu1"):
        words = ("--accel-topic", dataset, "--gyro", "gyro_x,gyro_y,gyro_z")
        channels = run.json("noise", tmp_path / "two.mat", *words)["channels"]
        channel = next(each for each in channels if each["unit"] == "rad/s")
        white.append(channel["intervals"]["white"]["value"])
    assert white[1] == pytest.approx(3.0 * white[0])


def tdms_at_two_rates(path: Path) -> None:
    waves = [("IMU", f"Acceleration {axis}", readings()[:, k], 1.0 / RATE_HZ) for k, axis in enumerate("XYZ")]
    others_of_1_hz = [(group, "Temperature", np.full(40, 21.5), 1.0) for group in ("IMU", "Room")]
    with TdmsWriter(path) as writer:
        writer.write_segment([
            ChannelObject(group, name, values, {"wf_increment": step_s})
            for group, name, values, step_s in [*waves, *others_of_1_hz]
        ])  # fmt: skip


def hdf5_at_two_rates(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["imu/acc"], file["imu/fs"], file["mag/field"], file["mag/fs"] = readings(), RATE_HZ, others()[::10], 10.0


def hdf5_at_a_rate_beside(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["imu/acc"], file["about/fs"] = readings(), RATE_HZ


@pytest.mark.parametrize(
    ("file", "write"),
    [("a.tdms", tdms_at_two_rates), ("a.h5", hdf5_at_two_rates), ("a.h5", hdf5_at_a_rate_beside)],
)
def test_readings_have_the_rate_that_stands_nearest_to_them(
    file: str, write: Callable[[Path], None], tmp_path: Path
) -> None:
    """The last rate of the file was that of all: readings at 100 Hz had 1 Hz or 10 Hz."""
    write(tmp_path / file)
    np.testing.assert_allclose(read(tmp_path / file)[0], SECONDS, atol=1e-9)


def test_two_rates_that_stand_as_near_give_no_time(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["imu/acc"], file["one/fs"], file["two/fs"] = readings(), RATE_HZ, 10.0
    with pytest.raises(InputError, match="no column gives the time"):
        read(tmp_path / "a.h5")
