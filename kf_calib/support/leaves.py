"""Leaves: folders of the package on which nothing else builds, and which may be taken out of it."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

from kf_calib.errors import InputError


def leaf(module: str, subject: str) -> ModuleType:
    """A module of a leaf; subject: what needs it. Raises InputError where its folder is not there."""
    folder = module.partition(".")[0]
    if find_spec(f"kf_calib.{folder}") is None:
        raise InputError(
            f"{subject} needs kf_calib/{folder}, without which this program was installed: install all of it."
        )
    return import_module(f"kf_calib.{module}")
