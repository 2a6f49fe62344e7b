"""Makes recordings/six_faces.xlsx and recordings/bench_bag from recordings/mems_faces.mcap (recordings/README.md)."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path

import zstandard
from mcap.reader import make_reader
from openpyxl import Workbook

import kf_calib
from kf_calib.support.units import STANDARD_GRAVITY_MPS2

RECORDINGS = Path(__file__).resolve().parents[1] / "recordings"
RUN = RECORDINGS / "mems_faces.mcap"
MG_PER_MPS2 = 1000.0 / STANDARD_GRAVITY_MPS2
BEGUN = datetime(2026, 5, 4, 9, 30)
METADATA = """rosbag2_bagfile_information:
  version: 5
  storage_identifier: sqlite3
  relative_file_paths:
{files}
  compression_format: zstd
  compression_mode: FILE
"""


def write_table(path: Path) -> None:
    """A row a dwell: what somebody would write down who reads a display."""
    run = kf_calib.calibrate(RUN)
    book = Workbook()
    sheet = book.active
    sheet.title = "Six faces"
    sheet.append(["Block 0417, bench 3"])
    names = "xyz"
    sheet.append(["Time", "Face up", *(f"{c} mean [mg]" for c in names), *(f"{c} SD [mg]" for c in names), "Readings",
                  "Temp. [°C]", "Remarks"])  # fmt: skip
    sigmas = run.noise.effective_sigma_mps2 * MG_PER_MPS2
    for dwell in run.fit.dwells:
        force = dwell.means[1:4]
        axis = int(abs(force).argmax())
        face = f"{'+' if force[axis] > 0 else '-'}{names[axis]}"
        means = [round(float(each) * MG_PER_MPS2, 3) for each in dwell.means[4:]]
        middle = BEGUN + timedelta(seconds=round(0.5 * (dwell.start_s + dwell.end_s)))
        warmth = round(float(dwell.pieces.nodes.temperature_c[0]), 2)
        sheet.append([middle, face, *means, *(round(float(each), 3) for each in sigmas), dwell.count, warmth, None])
    book.save(path)


def write_bag(folder: Path, parts: int = 2) -> None:
    """The same messages as a bag of ROS 2 in SQLite, in several files, each compressed."""
    with RUN.open("rb") as file:
        reader = make_reader(file)
        messages = [(schema.name, channel.topic, message.log_time, message.data)
                    for schema, channel, message in reader.iter_messages()]  # fmt: skip
    topics = {topic: (k + 1, kind) for k, (topic, kind) in enumerate(dict((m[1], m[0]) for m in messages).items())}
    folder.mkdir(exist_ok=True)
    names = list[str]()
    for part in range(parts):
        path = folder / f"{folder.name}_{part}.db3"
        own = messages[len(messages) * part // parts : len(messages) * (part + 1) // parts]
        with closing(sqlite3.connect(path)) as base, base:
            base.execute("create table topics(id integer primary key, name, type, serialization_format)")
            base.execute("create table messages(id integer primary key, topic_id, timestamp, data)")
            base.executemany(
                "insert into topics values(?, ?, ?, 'cdr')", [(k, t, kind) for t, (k, kind) in topics.items()]
            )
            base.executemany("insert into messages(topic_id, timestamp, data) values(?, ?, ?)",
                             [(topics[topic][0], at, data) for _, topic, at, data in own])  # fmt: skip
        packed = path.with_name(f"{path.name}.zstd")
        packed.write_bytes(zstandard.ZstdCompressor(level=19).compress(path.read_bytes()))
        path.unlink()
        names.append(packed.name)
    files = "\n".join(f"    - {name}" for name in names)
    (folder / "metadata.yaml").write_text(METADATA.format(files=files))


if __name__ == "__main__":
    write_table(RECORDINGS / "six_faces.xlsx")
    write_bag(RECORDINGS / "bench_bag")
