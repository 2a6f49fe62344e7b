"""What to do with a file or folder that is no MCAP recording: one sentence each, by what it begins with."""

from __future__ import annotations

from pathlib import Path

_SQLITE, _ROS1, _ZSTD = b"SQLite format 3\0", b"#ROSBAG V", b"\x28\xb5\x2f\xfd"
HEAD_BYTES = 1024
"""Bytes from its start by which a file is known."""


def advice(path: Path, head: bytes) -> str:
    """What a file is that begins with ``head``, and how to make a recording of it."""
    if head.startswith(_SQLITE):
        return f"{path} is a ROS 2 bag in SQLite: {_to_mcap(_bag_of(path))}."
    if head.startswith(_ROS1):
        return f"{path} is a bag of ROS 1: convert it by {_by_rosbags(path)}, and give OUT."
    if head.startswith(_ZSTD):
        return f"{path} is compressed as a whole: unpack it by `zstd -d {path} -o OUT.mcap`, and give OUT.mcap."
    if _is_lines(head):
        made = path.with_suffix(".mcap") if path.suffix != ".mcap" else path.with_name(f"{path.stem}_recorded.mcap")
        return (
            f"{path} is not an MCAP file, it holds lines of text: record them first, by "
            f"`kf-calib record {made} {path}`, and give {made}."
        )
    return (
        f"{path} is not an MCAP file (its first bytes differ): give one, or have kf-calib record make one of CSV or "
        "JSON lines."
    )


def folder_advice(path: Path) -> str:
    """What is in a folder without MCAP files, and how to make a recording of it."""
    if any(path.glob("*.db3")):
        return f"{path} is a ROS 2 bag in SQLite (.db3): {_to_mcap(path)}."
    packed = next(path.glob("*.mcap.zstd"), None)
    if packed is not None:
        return advice(packed, _ZSTD)
    return f"{path} holds no .mcap file: give the folder of a bag recorded with -s mcap."


def _bag_of(path: Path) -> Path:
    """The folder of a bag's file; the file itself where it lies alone."""
    return path.parent if (path.parent / "metadata.yaml").exists() else path


def _to_mcap(bag: Path) -> str:
    return (
        f"convert it to MCAP, with ROS by `ros2 bag convert -i {bag} -o convert.yaml`, the file convert.yaml being "
        "`output_bags: [{uri: OUT, storage_id: mcap, all: true}]`, or without ROS by "
        f"{_by_rosbags(bag)}, and give OUT"
    )


def _by_rosbags(bag: Path) -> str:
    return f"`rosbags-convert --src {bag} --dst OUT --dst-storage mcap` (after `pip install rosbags`)"


def _is_lines(head: bytes) -> bool:
    """JSON lines, or a table."""
    text = head.decode("utf-8-sig", errors="replace")[:-1]  # the last character may be cut
    first = text.lstrip().partition("\n")[0]
    return "\0" not in text and "\ufffd" not in text and (first[:1] in ("{", "[") or any(c in first for c in ",;\t"))
