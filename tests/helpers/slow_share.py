"""The share of the slow tests that belongs to a commit: all of them together would take hours.

The slow tests are divided into ``SHARES`` by their names. Commits count in rounds of ``SHARES``, and the hash of the
first commit of a round draws the order in which its commits take the shares: every test has its turn once a round.
Where the history is not there (a shallow clone), the hash of the commit alone draws its share.
"""

from __future__ import annotations

import hashlib
import subprocess
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest

SHARES = 10


@dataclass(frozen=True)
class Share:
    """number: which, from 0. commit: whose; it draws the order, so that not always the same come last."""

    number: int
    commit: str

    def __str__(self) -> str:
        return f"share {self.number + 1} of {SHARES} of the slow tests, that of commit {self.commit[:12]}"

    @classmethod
    def of_commit(cls, root: Path, name: str) -> Share:
        """The share of a commit by its name (a hash, HEAD, a tag); raises pytest.UsageError for what is none."""
        commit = _git(root, "rev-parse", "--verify", "--end-of-options", f"{name}^{{commit}}")
        if _git(root, "rev-parse", "--is-shallow-repository") == "true":
            return cls(drawn(commit), commit)
        history = _git(root, "rev-list", "--first-parent", commit).split()  # the last one first
        place = (len(history) - 1) % SHARES
        return cls(order_of_round(history[place])[place], commit)

    def takes(self, test: str) -> bool:
        """Whether a test, by its name, belongs to it."""
        return drawn(test) == self.number

    def key(self, test: str) -> tuple[int, str]:
        """Sorts tests by files in an order of the commit's, so that what files share is made once."""
        file = test.partition("::")[0]
        return drawn(self.commit + file, 1 << 32), file


def order_of_round(first: str) -> list[int]:
    """The shares in the order in which the commits of a round take them, by the hash of its first."""
    return sorted(range(SHARES), key=lambda share: drawn(f"{first} {share}", 1 << 64))


def drawn(text: str, below: int = SHARES) -> int:
    """A number that looks drawn at random, and is always the same for the same text."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16]) % below


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, timeout=120)
    if done.returncode:
        raise pytest.UsageError(f"git {' '.join(words)}: {done.stderr.strip()}: name a commit of this checkout.")
    return done.stdout.strip()


class SlowShare:
    """A plugin of pytest: runs one share, begins no test after some minutes, and says what it ran."""

    def __init__(self, share: Share, minutes: float) -> None:
        self._share, self._minutes, self._begun_s = share, minutes, time.monotonic()

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        kept, left_out = list[pytest.Item](), list[pytest.Item]()
        for item in items:
            (kept if self._share.takes(item.nodeid) else left_out).append(item)
        items[:] = sorted(kept, key=lambda item: self._share.key(item.nodeid))
        config.hook.pytest_deselected(items=left_out)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self) -> None:
        if time.monotonic() - self._begun_s > 60.0 * self._minutes:
            pytest.skip(f"not begun after {self._minutes:g} minutes: it comes first with another commit, or by hand")

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        reports = [report for key in ("passed", "failed", "error") for report in terminalreporter.stats.get(key, [])]
        names = Counter(report.nodeid.partition("[")[0] for report in reports)
        terminalreporter.section(str(self._share))
        for name, count in sorted(names.items()):
            terminalreporter.write_line(f"{name}{f' ({count} cases)' * (count > 1)}")
