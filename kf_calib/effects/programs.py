"""Python files that a model file or a journal names: the classes of effects it needs are in them.

Loading such a file runs it, and whoever wrote it can then do all that the user can. Files from others are therefore
only loaded where the user named the file himself, or says that he trusts what came with it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kf_calib.errors import InputError

_LARGEST_BYTES = 10_000_000


@dataclass(frozen=True)
class Program:
    """A Python file; sha256: of its content when the model or journal was saved, empty where that is not known."""

    path: Path
    sha256: str = ""


@dataclass(frozen=True)
class Allowed:
    """files: what may be loaded. changes: what is not as it was when it was saved, a sentence each."""

    files: tuple[Path, ...] = ()
    changes: tuple[str, ...] = ()


def allowed(origin: Path, programs: Sequence[Program], named: Sequence[Path], trust: bool) -> Allowed:
    """The files to load for the programs of ``origin``; nothing is run.

    named: files that the user named; one of them stands for a program where it is the same file or has the same
    content. trust: whether the others may be run as well. Raises InputError, with what would run, where they may not.
    """
    places = {path.resolve(): path for path in named}
    contents = {sha256_of(path): path for path in named} if programs else {}
    files, changes = list[Path](), list[str]()
    for program in programs:
        now = _sha256_if_there(program.path)
        file = places.get(program.path.resolve()) or contents.get(now) or contents.get(program.sha256)
        if file is None and not (trust and now):
            raise _refusal(origin, program, now)
        files.append(file or program.path)
        content = sha256_of(file) if file else now
        if program.sha256 not in ("", content):
            changes.append(
                f"{origin}: {files[-1]} has changed since it was saved (SHA-256 {program.sha256} then, {content} now), "
                "so results may differ."
            )
    return Allowed(tuple(files), tuple(changes))


def _refusal(origin: Path, program: Program, now: str) -> InputError:
    if not now:
        return InputError(
            f"{origin}: needs the Python file {program.path.resolve()}, which cannot be read: put it there, or name a "
            "copy of it by --effects-from."
        )
    saved = "" if program.sha256 in ("", now) else f"; when it was saved, {program.sha256}"
    return InputError(
        f"{origin}: would run the Python file {program.path.resolve()} (SHA-256 {now}{saved}), which can do all that "
        "you can: read it, then name it by --effects-from, or allow what this file names by --trust."
    )


def sha256_of(path: Path) -> str:
    """Raises InputError where the file cannot be read."""
    sha256 = _sha256_if_there(path)
    if not sha256:
        raise InputError(f"{path}: cannot be read: give a Python file of effect classes.")
    return sha256


def _sha256_if_there(path: Path) -> str:
    """Of a regular file of a sane size, which a device or a pipe is not; empty for anything else."""
    try:
        if not path.is_file() or path.stat().st_size > _LARGEST_BYTES:
            return ""
        with path.open("rb") as file:
            return hashlib.sha256(file.read(_LARGEST_BYTES)).hexdigest()
    except (OSError, ValueError):
        return ""
