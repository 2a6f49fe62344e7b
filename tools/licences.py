"""The licence of every locked package, as its own metadata state it: docs/licences.md, which tools/licences writes."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from email.message import Message
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "licences.md"
INTRODUCTION = """\
# Licences

`kf_calib` is under the MIT licence ([LICENSE](../LICENSE)). The packages it needs are installed beside it, each under
the licence that its own metadata state. `tools/licences` writes this page from the locked versions.

One library comes within `kf_calib`, and is in every page that `report` makes: uPlot {uplot}, under the MIT licence
([uPlot.LICENSE](../kf_calib/report/uPlot.LICENSE)).
"""
UPLOT = ROOT / "kf_calib" / "report" / "uPlot.iife.min.js"
TABLES = {"What a user installs": "requirements.lock", "Besides, for development": "requirements-dev.lock"}


def introduction() -> str:
    """What stands above the tables, with the version of uPlot that its first line states."""
    (version,) = re.findall(r"uPlot \(v([\d.]+)\)", UPLOT.read_text()[:200])
    return INTRODUCTION.format(uplot=version)


def locked(lock: str) -> dict[str, str]:
    """Name and version of each package of a lock file."""
    return dict(re.findall(r"^([\w.-]+)==([^\s;]+)", (ROOT / lock).read_text(), re.MULTILINE))


def found(versions: Mapping[str, str]) -> dict[str, Message]:
    """The metadata of packages; those that are not installed, being for other systems, are fetched to be read."""
    absent = [f"{name}=={version}" for name, version in versions.items() if not _installed(name, version)]
    with tempfile.TemporaryDirectory() as folder:
        if absent:
            quiet = ["--quiet", "--disable-pip-version-check", "--no-deps", "--target", folder]
            subprocess.run([sys.executable, "-m", "pip", "install", *quiet, *absent], check=True)
        fetched = {normal(each.name): each for each in metadata.distributions(path=[folder])}
        return {name: (fetched.get(normal(name)) or metadata.distribution(name)).metadata for name in versions}


def licence(about: Message) -> str:
    """What a package states: an SPDX expression or, where it is older, the classifier or the line for it."""
    if expression := about.get("License-Expression"):
        return expression
    classified = [text for text in about.get_all("Classifier", []) if text.startswith("License :: ")]
    if classified:
        return ", ".join(text.rpartition(" :: ")[2] for text in classified)
    return about.get("License", "").strip().partition("\n")[0]


def table(heading: str, packages: Iterable[tuple[str, Message]]) -> str:
    rows = [f"| {name} | {about['Version']} | {licence(about)} |" for name, about in packages]
    return "\n".join([f"\n## {heading}\n", "| package | version | licence |", "|---|---|---|", *rows, ""])


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _installed(name: str, version: str) -> bool:
    try:
        return metadata.version(name) == version
    except metadata.PackageNotFoundError:
        return False


def main() -> None:
    page, done = introduction(), dict[str, str]()
    for heading, lock in TABLES.items():
        versions = {name: version for name, version in locked(lock).items() if name not in done}
        page += table(heading, found(versions).items())
        done |= versions
    PAGE.write_text(page)


if __name__ == "__main__":
    main()
