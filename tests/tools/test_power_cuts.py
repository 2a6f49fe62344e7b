"""Power that goes: a share of the cuts of tools/power_cuts.py, and the order in which result files reach the disk."""

import os
from pathlib import Path

import numpy as np
import power_cuts
import pytest

from kf_calib.errors import InputError
from kf_calib.support import output_files


@pytest.mark.slow
def test_no_cut_takes_what_was_on_the_disk_or_makes_up_what_was_not() -> None:
    wrong = {number: said for number in range(150) if (said := power_cuts.play(number, seed=57))}
    assert not wrong, f"play one again: tools/power_cuts.py --seed 57 --only {next(iter(wrong))}"


def test_cuts_do_lose_what_was_not_on_the_disk() -> None:
    """Else the tool would play none."""
    disk, _ = power_cuts.recorded(3)
    held = [power_cuts.after_cut(disk, np.random.default_rng(k)) for k in range(50)]
    assert len({len(content) for content, _ in held}) > 10 and len({safe for _, safe in held}) > 5


@pytest.mark.parametrize("exists", [False, True])
def test_a_result_is_on_the_disk_before_it_has_its_name_and_the_name_after(
    exists: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a cut at any moment the name leads to the old content or the new, whole."""
    path, steps = tmp_path / "result.json", list[str]()
    if exists:
        path.write_text("old")
    sync, replace = os.fsync, Path.replace

    def synced(descriptor: int) -> None:
        of_folder = Path(f"/proc/self/fd/{descriptor}").is_dir()
        steps.append("folder" if of_folder else "file")
        sync(descriptor)

    def replaced(self: Path, target: Path) -> Path:
        steps.append("name")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", replaced)
    output_files.write_whole(path, b"new")
    assert path.read_text() == "new" and steps == ["file", "name", "folder"]


def test_a_disk_that_refuses_leaves_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "result.json"
    path.write_text("old")

    def refuse(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(InputError, match="cannot be written"):
        output_files.write_whole(path, b"new")
    assert path.read_text() == "old" and [each.name for each in tmp_path.iterdir()] == ["result.json"]
