"""What ``--model`` reads: a model file (TOML), or the effects of a calibration file (JSON)."""

from __future__ import annotations

from pathlib import Path

from kf_calib.estimation import model_file
from kf_calib.estimation.model_file import ModelFile
from kf_calib.exchange import calibration_file


def read(path: str | Path) -> ModelFile:
    """Read the model of a file of either kind, told by its first character; no Python file that it names is run.

    Raises InputError, with the path, if the file cannot be read or used.
    """
    path = Path(path)
    return calibration_file.read(path).model_file(path) if _is_json(path) else model_file.read(path)


def _is_json(path: Path) -> bool:
    """Whether a file begins as a JSON object, which no TOML does; one that cannot be read is for others to refuse."""
    try:
        with path.open("rb") as file:
            return file.read(64).lstrip().startswith(b"{")
    except (OSError, ValueError):
        return False
