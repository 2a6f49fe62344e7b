"""docs/fleet.png: errors of the bench of a simulated fleet; it was repaired in the middle of the campaign.

`.venv/bin/python tools/fleet_picture.py` draws it again, which takes a minute.
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

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "fleet.png"
_COLOURS = 96
_WIDTH_PX = 1200


def main() -> None:
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
        drawn = Image.open(io.BytesIO(picture.read_bytes())).convert("RGB")
    drawn.quantize(_COLOURS, dither=Image.Dither.NONE).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
