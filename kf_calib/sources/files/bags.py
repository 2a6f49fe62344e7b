"""The files of a recording: one, or those of a ROS 2 bag's folder in the order in which they were written."""

from __future__ import annotations

import re
from pathlib import Path

from kf_calib.errors import InputError
from kf_calib.sources.files.foreign import folder_advice

_NUMBERED = re.compile(r"(.*)_(\d+)")
_SHOWN = 6  # names in a message
_LISTED = re.compile(r"^( *)relative_file_paths:\s*\n((?:\1 *- .*(?:\n|$))+)", re.MULTILINE)


def files_of(path: Path) -> list[Path]:
    """The MCAP files at ``path``, in order of time. Raises InputError where a folder is not one bag of such files."""
    if not path.is_dir():
        return [path]
    listed = _files_in_metadata(path / "metadata.yaml")
    lost = [name for name in listed if not (path / name).is_file()]
    if lost:
        raise InputError(
            f"{path} lacks {', '.join(lost)}, which its metadata.yaml names: bring the whole bag, or give one of its "
            ".mcap files."
        )
    files = [path / name for name in listed if name.endswith(".mcap")] or sorted(path.glob("*.mcap"), key=_place)
    if not files:
        raise InputError(folder_advice(path))
    if not listed and len({_place(file)[0] for file in files}) > 1:
        raise InputError(
            f"{path} holds several recordings ({', '.join(file.name for file in files[:_SHOWN])}"
            f"{' ...' * (len(files) > _SHOWN)}) and no metadata.yaml that makes them one: give one of them."
        )
    return files


def _place(file: Path) -> tuple[str, int]:
    """The name of the bag that a file is part of, and its number in it."""
    numbered = _NUMBERED.fullmatch(file.stem)
    return (numbered[1], int(numbered[2])) if numbered else (file.stem, 0)


def _files_in_metadata(metadata: Path) -> list[str]:
    """The files that a bag's metadata.yaml lists, in order; none where there is no such file."""
    try:
        found = _LISTED.search(metadata.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return []
    names = re.findall(r"^ *- *(.+?) *$", found[2], re.MULTILINE) if found else []
    return [Path(name.strip("'\"")).name for name in names]
