#!/usr/bin/env python3
"""Sets up .venv of this checkout from the locked packages when needed, and runs the demo or the tests, on any system.

usage: py tools/checkout.py demo [ARGUMENTS of kf-calib demo]
       py tools/checkout.py test [ARGUMENTS of pytest]

For Windows, which has no shell for tools/demo and tools/test; those need less of the Python that they find.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LOCKS = {"demo": "requirements.lock", "test": "requirements-dev.lock"}
PIP = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input")
Run = Callable[[Sequence[str]], int]


def python_of(environment: Path) -> Path:
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def steps(job: str, environment: Path, python: str) -> list[list[str]]:
    """The commands that make the environment of a job: locked packages, checked by their hashes, and the project.

    Its build backend came with the lock.
    """
    inside = str(python_of(environment))
    return [
        [python, "-m", "venv", "--clear", str(environment)],
        [inside, *PIP, "--only-binary", ":all:", "--require-hashes", "-r", str(ROOT / LOCKS[job])],
        [inside, *PIP, "--no-deps", "--no-build-isolation", "--editable", str(ROOT)],
    ]


def stamp_of(job: str) -> str:
    """What an environment that is right was made from."""
    content = b"".join((ROOT / name).read_bytes() for name in ("pyproject.toml", LOCKS[job], "tools/checkout.py"))
    return f"{job} {ROOT} {sys.version} {hashlib.sha256(content).hexdigest()}"


def main(words: Sequence[str], run: Run, environment: Path = ROOT / ".venv") -> int:
    if not words or words[0] not in LOCKS:
        print(__doc__, file=sys.stderr)
        return 2
    if sys.version_info < (3, 11):  # noqa: UP036 (it is run by whatever Python there is)
        print(
            "tools/checkout.py: Python 3.11 or newer is needed; on Windows: py -3.13 tools/checkout.py", file=sys.stderr
        )
        return 2
    job, stamp = words[0], environment / "kf_calib-checkout"
    if not (stamp.exists() and stamp_of(job) in stamp.read_text(encoding="utf-8").splitlines()):
        print(
            "setting up .venv (once): some 500 MB of packages come now, which takes a minute or more ...",
            file=sys.stderr,
        )
        for command in steps(job, environment, sys.executable):
            if code := run(command):
                print(
                    f"tools/checkout.py: {' '.join(command)} ended with {code}: mend that, and run it again.",
                    file=sys.stderr,
                )
                return code
        stamp.write_text(f"{stamp_of(job)}\n", encoding="utf-8")
    program = ["-m", "kf_calib", "demo"] if job == "demo" else ["-m", "pytest"]
    return run([str(python_of(environment)), *program, *words[1:]])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], lambda command: subprocess.run(command, cwd=ROOT).returncode))
