"""ROS 1 bags, which rosbags turns into a temporary MCAP file with the same messages as ROS 2 writes them."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.writer import CompressionType, Writer

from kf_calib.errors import InputError, need
from kf_calib.support.text import cut

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader
    from rosbags.typesys.store import Typestore

_LARGE = ("Image", "CompressedImage", "PointCloud", "PointCloud2", "LaserScan", "OccupancyGrid")
"""Types in which nothing of an accelerometer is, and which are most of the bytes of a bag."""
_SHOWN = 6  # topics in a message


def mcap_of_bag(path: Path) -> tuple[Path, str]:
    """A temporary MCAP file with the messages of a ROS 1 bag, and which topics it leaves out, in a sentence.

    Raises InputError where it cannot be read, and MissingExtraError without rosbags.
    """
    need("rosbags", "logs", f"{path}, a bag of ROS 1,")
    from rosbags.rosbag1 import Reader
    from rosbags.typesys import Stores, get_typestore

    descriptor, name = tempfile.mkstemp(prefix="kf_calib_", suffix=".mcap")
    try:
        with os.fdopen(descriptor, "wb") as target, Reader(path) as reader:
            writer = Writer(target, compression=CompressionType.NONE)
            writer.start(profile="ros2", library="kf_calib")
            left_out = _copy(reader, get_typestore(Stores.ROS2_HUMBLE), writer)
            writer.finish()
    except BaseException as error:
        Path(name).unlink()
        if isinstance(error, OSError):
            raise InputError(f"{path} cannot be turned into {name} ({error.strerror}): make room there, or let the "
                             "variable TMPDIR name another place.") from None  # fmt: skip
        if isinstance(error, Exception):  # rosbags raises what it likes on a damaged bag
            said = cut(" ".join(str(error).split()) or type(error).__name__, 100)
            raise InputError(f"{path} is a bag of ROS 1 that cannot be read ({said}): try rosbag reindex on it, or "
                             "copy it anew.") from None  # fmt: skip
        raise
    said = f"{path}: topics of other kinds were not read: {', '.join(left_out[:_SHOWN])}." if left_out else ""
    return Path(name), said


def _copy(reader: Reader, types: Typestore, writer: Writer) -> list[str]:
    """Write the messages of all topics but large ones; return the names of those that are left out."""
    from rosbags.typesys import get_types_from_msg

    channels, left_out = dict[int, tuple[int, str]](), list[str]()
    for connection in reader.connections:
        kind = connection.msgtype
        if kind.endswith(_LARGE):
            left_out.append(connection.topic)
            continue
        if kind not in types.fielddefs:
            types.register(get_types_from_msg(connection.msgdef.data, kind))
        definition, _ = types.generate_msgdef(kind, ros_version=2)
        schema = writer.register_schema(kind, "ros2msg", definition.encode())
        channels[connection.id] = writer.register_channel(connection.topic, "cdr", schema), kind
    kept = [connection for connection in reader.connections if connection.id in channels]
    for connection, stamp_ns, raw in reader.messages(kept) if kept else ():
        channel, kind = channels[connection.id]
        writer.add_message(channel, stamp_ns, bytes(types.ros1_to_cdr(raw, kind)), stamp_ns)
    return left_out
