"""docs/fleet.png: errors of the bench of a simulated fleet; it was repaired in the middle of the campaign.

`tools/pictures fleet` draws it again, which takes a minute.
"""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
from pathlib import Path

from fleet_generator import Campaign, recorded
from PIL import Image

import kf_calib

_WIDTH_PX = 1200


def drawn() -> Image.Image:
    """The picture."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = Campaign(Path(folder), runs=72, units=12, benches=1, of_bench=("flexure=4sigma",), repaired=0.5,
                            of_unit=("second-order=5sigma",), share=0.25, seed=2)  # fmt: skip
        for _ in recorded(campaign, 2):
            pass
        table, picture = Path(folder, "fleet"), Path(folder, "fleet.png")
        command = [sys.executable, "-m", "kf_calib", "fleet", str(campaign.folder / "runs"), "-o", str(table)]
        subprocess.run([*command, "--no-pooled"], check=True)
        figures = kf_calib.plot.figures(kf_calib.open_fleet(table).overview())
        kf_calib.plot.save(figures["Errors of the bench over time"](), picture, width_px=_WIDTH_PX)
        return Image.open(io.BytesIO(picture.read_bytes())).convert("RGB")
