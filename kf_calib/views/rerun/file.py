"""An .rrd file, whole or not there.

Rerun's own way to a file waits for ever where the disk is full, and raises nothing where it could not write: here it
encodes in memory (a view has a few MB), and what it encoded is written as every other output is.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from kf_calib.support.output_files import write_whole


def new_stream() -> rr.RecordingStream:
    """A stream with an identity of its own: two views written by one process would else be merged by the viewer."""
    return rr.RecordingStream("kf_calib", recording_id=uuid.uuid4())


@contextmanager
def strict() -> Iterator[None]:
    """Mistakes in what is logged raise, rather than leave a hole in the view; the caller's mode is given back."""
    before = rr.strict_mode()
    rr.set_strict_mode(True)
    try:
        yield
    finally:
        rr.set_strict_mode(before)


@contextmanager
def rrd_file(path: Path, blueprint: rrb.Blueprint) -> Iterator[rr.RecordingStream]:
    """A stream whose content is the file when the block has ended. Raises InputError where it cannot be written."""
    with strict(), new_stream() as stream:
        memory = stream.memory_recording()
        stream.send_blueprint(blueprint)
        yield stream
        content = memory.drain_as_bytes()
        stream.disconnect()
    write_whole(path, content)
