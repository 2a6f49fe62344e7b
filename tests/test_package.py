"""What is published: metadata, licences, the tutorial's recordings, and the wheel without the checkout."""

import importlib
import json
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
RECORDINGS = ROOT / "recordings"
PACKAGE_TOOL = ROOT / "tools" / "package"
PYTHONS = re.findall(r'"(3\.\d+)"', next(line for line in PACKAGE_TOOL.read_text().splitlines() if "PYTHONS =" in line))


@pytest.fixture
def licences(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("licences")


@pytest.fixture
def consoles(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("consoles")


def test_the_package_runs_as_a_module(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "kf_calib", "--version"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=300)
    assert done.stdout.strip().endswith(f"version {metadata.version('kf_calib')}")


def test_the_citation_is_of_this_version_and_licence() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = dict(re.findall(r"^([\w-]+): *\"?(.*?)\"?$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    assert cited["title"] == project["name"]
    for key in ("version", "license"):
        assert cited[key] == project[key]
    assert cited["abstract"].rstrip(".") == project["description"]


def test_the_licence_of_every_locked_package_is_listed(licences: ModuleType) -> None:
    rows = re.findall(r"^\| ([\w.-]+) \| (\d[\w.]*) \| (.*) \|$", licences.PAGE.read_text(), re.MULTILINE)
    listed = {name: (version, licence) for name, version, licence in rows}
    wanted = {name: version for lock in licences.TABLES.values() for name, version in licences.locked(lock).items()}
    assert {name: version for name, (version, _) in listed.items()} == wanted, "run tools/licences"
    assert all(licence for _, licence in listed.values())
    assert licences.PAGE.read_text().startswith(licences.introduction()), "run tools/licences"
    for each in metadata.distributions():
        name = licences.normal(each.name)
        if wanted.get(name) == each.version:
            assert listed[name][1] == licences.licence(each.metadata), "run tools/licences"


def test_the_recordings_of_the_tutorial_come_with_the_package(run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = run("demo", "--tutorial")
    assert (code, err) == (0, "") and "kf-calib replay recordings/hidden.mcap" in out
    copies, own = (
        {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (Path("recordings"), RECORDINGS)
    )
    assert copies == {name: content for name, content in own.items() if not name.endswith(".md")}
    Path("recordings/hidden.mcap").unlink()  # the others stay as they are
    code, out, _ = run("demo", "--tutorial", "--json")
    assert code == 0 and "recordings/hidden.mcap" in json.loads(out)["recordings"]
    assert Path("recordings/hidden.mcap").read_bytes() == copies["hidden.mcap"]


def test_a_file_of_the_users_is_not_taken_for_a_recording_of_the_tutorial(run, tmp_path: Path) -> None:
    (tmp_path / "navigation_24.mcap").write_text("mine")
    code, out, err = run("demo", tmp_path, "--tutorial")
    assert (code, out) == (2, "") and "navigation_24.mcap is there, and is not the tutorial's" in err
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_the_folder_of_the_tutorial_must_be_one(run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("recordings").write_text("mine")
    code, out, err = run("demo", "--tutorial")
    assert (code, out) == (2, "") and "'recordings' is a file" in err


def test_what_a_page_shows_is_found_in_what_is_printed_in_its_order(consoles: ModuleType) -> None:
    page = "```console\n$ one \\\n    --more\na b\n...\nc\n$ two\n```\n"
    (first, shown), second = consoles.consoles(page)
    assert (first.split(), second) == (["one", "--more"], ("two", ""))
    assert consoles.not_printed(shown, "a\nb x\nc\n") == ""
    assert consoles.not_printed(shown, "c a b") == "c"
    assert consoles.not_printed(shown, "a x b c") == "a b"


def test_each_direct_requirement_has_a_lowest_version() -> None:
    """tools/package tries the wheel with all of them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert [wanted for wanted in project["dependencies"] if ">=" not in wanted] == []


def test_workflows_call_scripts_that_are_there_with_the_oldest_and_the_newest_python() -> None:
    workflows = {path.name: yaml.safe_load(path.read_text()) for path in (ROOT / ".github" / "workflows").glob("*.yml")}
    jobs = [job for workflow in workflows.values() for job in workflow["jobs"].values()]
    commands = [step["run"] for job in jobs for step in job["steps"] if "run" in step]
    scripts = set(re.findall(r"(?<![\w/])(?:tools/[\w.]+|\.ci/run)", "\n".join(commands)))
    assert scripts == {"tools/test", "tools/checkout.py", "tools/docs", "tools/package", ".ci/run"}
    assert all((ROOT / script).exists() for script in scripts)
    matrix = workflows["tests.yml"]["jobs"]["fast-tests"]["strategy"]["matrix"]
    assert matrix["python"] == [PYTHONS[-1], PYTHONS[0]]
    assert {name.partition("-")[0] for name in matrix["os"]} == {"ubuntu", "macos", "windows"}
    assert all(job["permissions"] == {"id-token": "write"} for job in jobs if job.get("environment") == "release")


@pytest.mark.slow
def test_wheel_and_sdist_are_fit_to_publish() -> None:
    """In environments of their own; tools/package says what it found."""
    done = subprocess.run([PACKAGE_TOOL], capture_output=True, text=True, timeout=900)
    if done.returncode == 3:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stdout + done.stderr
    assert "commands of the tutorial" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("python", PYTHONS)
def test_locked_packages_have_wheels_for(python: str, tmp_path: Path) -> None:
    lock = (ROOT / "requirements-dev.lock").read_text()
    packages = re.findall(r"^[\w.-]+==[^\\\n]+", lock, re.MULTILINE)  # without hashes: no file is fetched to be hashed
    if _lookup(python, tmp_path, ["packaging"]).returncode:
        pytest.skip("no package index can be asked here")
    environment = {"python_version": python, "python_full_version": f"{python}.0"}
    wanted = [each for each in map(Requirement, packages) if not each.marker or each.marker.evaluate(environment)]
    done = _lookup(python, tmp_path, [f"{each.name}{each.specifier}" for each in wanted])
    assert done.returncode == 0, done.stderr


def _lookup(python: str, folder: Path, packages: list[str]) -> subprocess.CompletedProcess[str]:
    """Asks the index for wheels for a Python that need not be on this machine; installs nothing."""
    (asked := folder / "packages.txt").write_text("\n".join(packages))
    words = ["--dry-run", "--no-deps", "--only-binary", ":all:", "--python-version", python, "--ignore-installed",
             "--target", folder / "none", "--requirement", asked]  # fmt: skip
    return subprocess.run([sys.executable, "-m", "pip", "install", *words], capture_output=True, text=True, timeout=900)
