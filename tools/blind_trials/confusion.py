"""The confusion matrix: what was hidden and what was named first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from blind_trials.outcome import Outcome
from blind_trials.task import OUTSIDE


def confusion(outcomes: Sequence[Outcome], figure: str | None = None) -> dict[str, Counter[str]]:
    """Return the counts of what was named first, for each hidden effect.

    Names that mean the same count as the name of the hidden effect, and so does ``unknown`` for one in no catalogue.
    """
    out = dict[str, Counter[str]]()
    for each in outcomes:
        judged = each.refused or not each.error
        if not judged or len(each.truth) > 1 or each.task.family not in ("noise", "name", "unstated", *OUTSIDE):
            continue
        if figure in (None, each.task.figure):
            true = each.truth[0] if each.truth else "(nothing)"
            right = each.right or (each.task.family in OUTSIDE and each.outside_right)
            said = true if right else "(refused)" if each.refused else each.first or "(nothing)"
            out.setdefault(true, Counter())[said] += 1
    return out


def save_picture(outcomes: Sequence[Outcome], path: Path) -> None:
    """Draw the confusion matrix, as shares of each row."""
    from matplotlib.figure import Figure as Sheet

    found = confusion(outcomes)
    rows = list(found)
    said = {name for counter in found.values() for name in counter}
    columns = [*(name for name in rows if name in said), *sorted(said - set(rows))]
    shares = np.array([[found[row][column] / found[row].total() for column in columns] for row in rows])
    sheet = Sheet(figsize=(2.5 + 0.22 * len(columns), 2.5 + 0.2 * len(rows)), layout="constrained")
    axes = sheet.add_subplot()
    image = axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0)
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
    axes.set_yticks(range(len(rows)), rows, fontsize=7)
    axes.set_xlabel("named first")
    axes.set_ylabel("hidden")
    sheet.colorbar(image, shrink=0.5, label="share of trials")
    sheet.savefig(path, dpi=100)
    if path.suffix == ".png":  # a palette keeps it small enough for the repository
        from PIL import Image

        Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)
