"""Optional packages, which come with extras of kf_calib; a missing one is reported in one sentence."""

from __future__ import annotations

from importlib.util import find_spec

from kf_calib.errors import KfCalibError


class MissingExtraError(KfCalibError):
    """A package is not installed that this needs; the message has the command that brings it."""


def need(package: str, extra: str | None, purpose: str) -> None:
    """Raise MissingExtraError unless ``package`` can be imported; extra: of kf_calib, that brings it, if one does."""
    if find_spec(package) is None:
        wanted = package if extra is None else f"'kf_calib[{extra}]'"
        raise MissingExtraError(f"{purpose} needs {package}, which is not installed: pip install {wanted}.")
