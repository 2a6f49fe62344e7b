"""Where things are."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
RECORDINGS = ROOT / "recordings"
SHARED = ROOT.parent / "shared" / "recordings"
"""Recordings of others, beside the checkout; tests that need them skip where they are absent."""
REAL = ROOT.parent / "shared" / "real"
"""Recordings of hand-held boards and phones; absent on a clean clone."""
