"""Leaves: folders of the package on which nothing else builds, and which may be taken out of it."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from types import ModuleType

from kf_calib.errors import InputError

_PACKAGE = Path(__file__).parents[1]


def leaf(module: str, subject: str) -> ModuleType:
    """A module of a leaf; subject: what needs it. Raises InputError where its folder is not there."""
    folder = module.partition(".")[0]
    if not (_PACKAGE / folder / "__init__.py").is_file():
        raise InputError(
            f"{subject} needs kf_calib/{folder}, without which this program was installed: install all of it."
        )
    return import_module(f"kf_calib.{module}")
