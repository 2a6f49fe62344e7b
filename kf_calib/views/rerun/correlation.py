"""The correlation matrix of the twelve parameters after each orientation, as a picture with its rows named."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from kf_calib.bench import paper_parameters
from kf_calib.bench.arrays import Floats
from kf_calib.estimation.results import Estimate, Visit
from kf_calib.views.rerun.names import LABELS, colour_of
from kf_calib.views.rerun.series import ends, times

NEGATIVE, ZERO, POSITIVE = np.array([70, 140, 255]), np.array([18, 18, 22]), np.array([255, 110, 50])
UNKNOWN = np.array([80, 80, 84])
COUNT = len(paper_parameters.SYMBOLS)
LIFT = 0.45  # a label hangs below its point


def correlation(estimate: Estimate) -> Floats:
    """(12, 12), NaN in the rows and columns of parameters that are not determined."""
    return estimate.parameter_covariance / np.outer(estimate.sigma, estimate.sigma)


def picture(matrix: Floats) -> NDArray[np.uint8]:
    """RGB (12, 12, 3): blue for -1, black for 0, orange for +1, grey where not determined."""
    weight = np.abs(np.nan_to_num(matrix))[..., None]
    end = np.where(np.nan_to_num(matrix)[..., None] < 0, NEGATIVE, POSITIVE)
    colours = np.where(np.isnan(matrix)[..., None], UNKNOWN, ZERO + weight * (end - ZERO))
    return np.round(colours).clip(0, 255).astype(np.uint8)


def log_correlation(visits: Sequence[Visit], stream: rr.RecordingStream) -> None:
    """The picture after each dwell, the matrix itself (144 numbers, row by row), and the names of rows and columns."""
    matrices = [correlation(visit.estimate) for visit in visits]
    index = times(*ends(visits))
    image = rr.Image.columns(
        buffer=[picture(matrix).tobytes() for matrix in matrices],
        format=[rr.components.ImageFormat(width=COUNT, height=COUNT, color_model="RGB", channel_datatype="U8")]
        * len(visits),
    )
    rr.send_columns("correlation/picture", index, image, recording=stream)
    numbers = rr.Scalars.columns(scalars=np.array(matrices).ravel()).partition([COUNT**2] * len(visits))
    rr.send_columns("correlation/matrix", index, numbers, recording=stream)
    names = [LABELS[symbol] for symbol in paper_parameters.SYMBOLS]
    middle = np.arange(COUNT) + 0.5
    for side, places in (("rows", np.column_stack([np.full(COUNT, -0.7), middle - LIFT])),
                         ("columns", np.column_stack([middle, np.full(COUNT, -0.6) - LIFT]))):  # fmt: skip
        colours = [colour_of(symbol) for symbol in paper_parameters.SYMBOLS]
        points = rr.Points2D(places, labels=names, show_labels=True, radii=0.0, colors=colours)
        stream.log(f"correlation/{side}", points, static=True)
