"""What a run that goes on aims at: targets of the sigmas, the verdict so far, and where to go next."""

from __future__ import annotations

import numpy as np
import rerun as rr

from kf_calib.bench.arrays import Floats
from kf_calib.online.status import Judgement
from kf_calib.views.rerun.names import Colour

NEXT: Colour = (255, 160, 205)


def words(judgement: Judgement) -> str:
    """The verdict so far, what is suspected, and the next orientation, in Markdown."""
    going = judgement.next_orientation
    lines = [f"**So far**: {judgement.verdict}"]
    if going is not None:
        lines.append(f"**Next**: gimbals at {_angles(going[0])} deg: {going[1]}")
    return "\n\n".join(lines)


def log_next(judgement: Judgement, stream: rr.RecordingStream) -> None:
    """Where gravity will point in the platform in the orientation that is advised; nothing where none is."""
    going, bench = judgement.next_orientation, judgement.result.bench
    vectors, labels = np.zeros((0, 3)), list[str]()
    if going is not None and bench.axes:
        now_s = np.array([judgement.result.visits[-1].dwell.end_s])
        force: Floats = bench.specific_force(now_s, np.radians([going[0]]))
        vectors, labels = 1.25 * force / np.linalg.norm(force), [f"next: {_angles(going[0])} deg"]
    arrow = rr.Arrows3D(vectors=vectors, colors=[NEXT] * len(vectors), radii=[0.012] * len(vectors), labels=labels)
    stream.log("platform/next", arrow, static=True)


def _angles(degrees: tuple[float, ...]) -> str:
    return ", ".join(f"{round(angle, 1):g}" for angle in degrees)
