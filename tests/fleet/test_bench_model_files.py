"""The files of bench models: what the fleet wrote is replaced and removed, what anybody else did is left alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.run_factors import run_factor_of

from kf_calib.errors import InputError
from kf_calib.estimation import bench_model
from kf_calib.fleet.pooled_diagnosis import PooledDiagnosis, pooled_diagnosis
from kf_calib.fleet.results import BenchModelFiles

BENCHES = ("a b", "a/b")  # the same in the name of a file


@pytest.fixture(scope="module")
def found() -> PooledDiagnosis:
    """Two benches that bend."""
    sizes = np.array([[8.0, -6.0, 8.0], [5.0, 7.0, -3.0]])
    runs = [run_factor_of(k, lambda number: {"flexure": sizes[number % 2]}) for k in range(12)]
    return pooled_diagnosis([replace(run, bench=BENCHES[k % 2]) for k, run in enumerate(runs)])


def written(files: BenchModelFiles) -> list[Path]:
    for path in files.models:
        files.write(path)
    return list(files.models)


def test_what_the_fleet_wrote_is_replaced_and_removed(found: PooledDiagnosis, tmp_path: Path) -> None:
    paths = written(BenchModelFiles(tmp_path, found))
    assert [path.name for path in paths] == ["a_b.toml", "a_b-2.toml"]
    assert tuple(bench_model.read_bench_model(path).bench for path in paths) == BENCHES
    assert written(BenchModelFiles(tmp_path, found)) == paths
    only = replace(found, findings=(replace(found.findings[0], benches=found.findings[0].benches[:1]),))
    assert BenchModelFiles(tmp_path, only).outdated == paths[1:]
    assert BenchModelFiles(tmp_path, None).outdated == []


def test_what_is_somebody_elses_stays(found: PooledDiagnosis, tmp_path: Path) -> None:
    files = BenchModelFiles(tmp_path, found)
    own, copied = written(files)
    text = own.read_text()
    (files.folder / "copy.toml").write_text(text)
    (files.folder / "folder.toml").mkdir()
    copied.unlink()
    copied.symlink_to(files.folder / "copy.toml")
    own.write_text(text.replace("runs = 12", "runs = 13"))
    none_found = replace(found, findings=())
    assert BenchModelFiles(tmp_path, none_found).outdated == []
    for path in (own, copied):
        with pytest.raises(InputError, match="is not as kf-calib fleet wrote it, and was left"):
            files.write(path)
    assert "runs = 13" in own.read_text() and (files.folder / "copy.toml").read_text() == text
    BenchModelFiles(tmp_path, found, overwrite=True).write(own)
    assert own.read_text() == text


def test_a_file_in_place_of_the_folder_is_one_sentence(found: PooledDiagnosis, tmp_path: Path) -> None:
    (tmp_path / "bench_models").touch()
    files = BenchModelFiles(tmp_path, found)
    with pytest.raises(InputError, match=r"bench_models cannot be made \(File exists\): move away what is there"):
        files.write(next(iter(files.models)))
    assert files.outdated == []


def test_a_bench_whose_last_runs_determine_nothing_has_no_model(found: PooledDiagnosis, tmp_path: Path) -> None:
    """Since a repair, say: the command once ended there with a sentence that no error was found."""
    finding = found.findings[0]
    before, other = finding.benches
    unseen = tuple(replace(each, value=None, sigma=None) for each in before.coefficients)
    benches = before, replace(before, since="2026-01-01", coefficients=unseen), other
    repaired = replace(found, findings=(replace(finding, benches=benches),))
    assert [model.bench for model in BenchModelFiles(tmp_path, repaired).models.values()] == [BENCHES[1]]
