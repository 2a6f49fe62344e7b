"""The correlations of parameters and coefficients after each orientation, as a picture with its rows named."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from kf_calib.bench.arrays import Floats
from kf_calib.estimation.correlation import correlation
from kf_calib.estimation.results import Visit
from kf_calib.views.rerun.names import Quantity
from kf_calib.views.rerun.series import ends, times

NEGATIVE, ZERO, POSITIVE = np.array([70, 140, 255]), np.array([18, 18, 22]), np.array([255, 110, 50])
UNKNOWN = np.array([80, 80, 84])
LIFT = 0.45  # a label hangs below its point


def picture(matrix: Floats) -> NDArray[np.uint8]:
    """RGB (n, n, 3): blue for -1, black for 0, orange for +1, grey where not determined."""
    weight = np.abs(np.nan_to_num(matrix))[..., None]
    end = np.where(np.nan_to_num(matrix)[..., None] < 0, NEGATIVE, POSITIVE)
    colours = np.where(np.isnan(matrix)[..., None], UNKNOWN, ZERO + weight * (end - ZERO))
    return np.round(colours).clip(0, 255).astype(np.uint8)


def log_correlation(visits: Sequence[Visit], shown: Sequence[Quantity], stream: rr.RecordingStream) -> None:
    """The picture after each dwell, the matrix itself (row by row), and the names of rows and columns."""
    matrices, count = [correlation(visit.estimate) for visit in visits], len(shown)
    index = times(*ends(visits))
    image = rr.Image.columns(
        buffer=[picture(matrix).tobytes() for matrix in matrices],
        format=[rr.components.ImageFormat(width=count, height=count, color_model="RGB", channel_datatype="U8")]
        * len(visits),
    )
    rr.send_columns("correlation/picture", index, image, recording=stream)
    numbers = rr.Scalars.columns(scalars=np.array(matrices).ravel()).partition([count**2] * len(visits))
    rr.send_columns("correlation/matrix", index, numbers, recording=stream)
    middle = np.arange(count) + 0.5
    across = np.column_stack([middle, np.full(count, -0.6) - LIFT - 0.9 * (np.arange(count) >= 12)])
    for side, places in (("rows", np.column_stack([np.full(count, -0.7), middle - LIFT])), ("columns", across)):
        points = rr.Points2D(places, labels=[each.label for each in shown], show_labels=True, radii=0.0,
                             colors=[each.colour for each in shown])  # fmt: skip
        stream.log(f"correlation/{side}", points, static=True)
