"""A folder is a recording as a file is; what is none says what to do with it."""

from pathlib import Path

import pytest
import zstandard
from helpers.recordings import ACCEL, ANGLES, BATCH, BENCH, HEAT, assert_equal, part_of, read, stamped, write_officially
from mcap.writer import Writer

from kf_calib.errors import InputError
from kf_calib.sources.files.record_files import fingerprint
from kf_calib.sources.files.recording import Recording

METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: mcap
  relative_file_paths:
{}
  duration:
    nanoseconds: 10
  files:
    - path: not_this.mcap
"""


def split(folder: Path, names: list[str], **options: object) -> Path:
    """Our batch in several files, whose topics come in another order each; the temperature from the second on."""
    folder.mkdir()
    for k, name in enumerate(names):
        own = [part_of(topic, k, len(names)) for topic in (ACCEL, ANGLES, HEAT)]
        own = own[:2] if k == 0 else own[::-1]
        write_officially(folder / name, tuple(own), **({} if k == 0 else {"metadata": {}}), **options)
    return folder


NAMES = ["bag_0.mcap", "bag_2.mcap", "bag_10.mcap"]


def test_one_file_in_a_folder_is_the_recording(tmp_path: Path) -> None:
    write_officially(tmp_path / "any.mcap")
    assert_equal(read(Recording(tmp_path)), BATCH)


@pytest.mark.parametrize("finish", [True, False])
def test_the_files_of_a_split_bag_follow_each_other(tmp_path: Path, finish: bool) -> None:
    recording = Recording(split(tmp_path / "bag", NAMES, finish=finish))
    first_heat = len(HEAT[3]) // 3
    for _ in range(2):
        found = read(recording)
        assert recording.fraction == 1.0
        for one, other in ((found.accel, BATCH.accel), (found.pose, BATCH.pose)):
            assert one.time_ns.tolist() == other.time_ns.tolist() and one.values.tobytes() == other.values.tobytes()
        assert found.temperature.time_ns.tolist() == BATCH.temperature.time_ns[first_heat:].tolist()
    assert len(recording.warnings) == (0 if finish else 3)


def test_metadata_says_which_files_and_in_which_order(tmp_path: Path) -> None:
    names = ["z.mcap", "a.mcap", "m.mcap"]
    folder = split(tmp_path / "bag", names)
    (folder / "metadata.yaml").write_text(METADATA.format("\n".join(f"    - {name}" for name in names)))
    assert read(Recording(folder)).accel.time_ns.tolist() == BATCH.accel.time_ns.tolist()
    one, other = fingerprint(folder), fingerprint(folder / "z.mcap")
    assert one != other
    (folder / "a.mcap").unlink()
    with pytest.raises(InputError, match=r"lacks a\.mcap, which its metadata.yaml names"):
        Recording(folder)


def test_recordings_that_only_lie_in_one_folder_are_not_joined(tmp_path: Path) -> None:
    folder = split(tmp_path / "bag", ["monday.mcap", "tuesday.mcap"])
    with pytest.raises(InputError, match=r"several recordings \(monday.mcap, tuesday.mcap\).*give one of them"):
        Recording(folder)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.csv", b"time_s,ax_mps2\n1,2\n", r"holds lines of text: .*`kf-calib record \S*a.mcap \S*a.csv`"),
        ("a.jsonl", b'{"time_s": 1}\n', r"`kf-calib record \S*a.mcap \S*a.jsonl`, and give \S*a.mcap"),
        ("named.mcap", b"\xef\xbb\xbfa;b\n", r"`kf-calib record \S*named_recorded.mcap \S*named.mcap`"),
        (
            "x.mcap.zstd",
            b"\x28\xb5\x2f\xfd....",
            r"x.mcap.zstd does not decompress \(.*\): it is damaged, copy it anew",
        ),
    ],
)
def test_other_files_say_what_to_do(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=says):
        Recording(tmp_path / name)


def test_messages_compressed_one_by_one(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    pack = zstandard.ZstdCompressor().compress
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8_000)
        writer.start(profile="ros2")
        channels = [writer.register_channel(topic, "cdr", writer.register_schema(kind.name, "ros2msg", b""))
                    for topic, kind, *_ in (ACCEL, ANGLES, HEAT)]  # fmt: skip
        for stamp, k, data in stamped((ACCEL, ANGLES, HEAT)):
            writer.add_message(channels[k - 1], stamp, pack(data), stamp)
        writer.finish()
    assert_equal(read(Recording(path, BENCH.to_metadata())), BATCH)
