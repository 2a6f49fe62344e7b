"""What to do with a file that is no recording: one sentence each, by what it begins with."""

from __future__ import annotations

from pathlib import Path

_ROS1, _GZIP = b"#ROSBAG V", b"\x1f\x8b"
HEAD_BYTES = 1024
"""Bytes from its start by which a file is known."""


def advice(path: Path, head: bytes) -> str:
    """What a file is that begins with ``head``, and how to make a recording of it."""
    if head.startswith(_ROS1):
        return f"{path} is a bag of ROS 1: convert it by {_by_rosbags(path)}, and give OUT."
    if is_lines(head):
        made = path.with_suffix(".mcap") if path.suffix != ".mcap" else path.with_name(f"{path.stem}_recorded.mcap")
        return (
            f"{path} is not an MCAP file, it holds lines of text: evaluate them as they are, by `kf-calib replay "
            f"{path}`, or record them, by `kf-calib record {made} {path}`, and give {made}."
        )
    if head.startswith(_GZIP):
        return f"{path} is packed by gzip, in which only lines of text are read: unpack it first, by `gunzip`."
    return (
        f"{path} is not an MCAP file (its first bytes differ): give one, or have kf-calib record make one of CSV or "
        "JSON lines."
    )


def _by_rosbags(bag: Path) -> str:
    return f"`rosbags-convert --src {bag} --dst OUT --dst-storage mcap` (after `pip install rosbags`)"


def is_lines(head: bytes) -> bool:
    """JSON lines, or a table."""
    text = head.decode("utf-8-sig", errors="replace")[:-1]  # the last character may be cut
    first = text.lstrip().partition("\n")[0]
    is_printed = "\ufffd" not in text and not any(c < " " and c not in "\t\r\n\f" for c in text)
    return is_printed and (first[:1] in ("{", "[") or any(c in text for c in ",;\t"))
