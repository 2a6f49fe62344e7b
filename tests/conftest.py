"""Paths and fixtures shared by the tests."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared" / "recordings"


@pytest.fixture
def ferraris() -> Path:
    """A real recording made by others; kept beside the project, not in it."""
    path = SHARED / "ferraris_hand.mcap"
    if not path.exists():
        pytest.skip(f"{path} is not there: the recordings of others are kept outside the project")
    return path
