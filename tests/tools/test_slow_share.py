"""Every slow test has its turn within a round of commits, whatever the commits' hashes are."""

import itertools
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from helpers.paths import ROOT
from helpers.slow_share import SHARES, Share, SlowShare, drawn, order_of_round

TESTS = [f"tests/test_{name}.py::test_{k}[{k}]" for name in "abcdef" for k in range(80)]


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """A checkout of two rounds, and its commits, the first one first."""
    root = tmp_path_factory.mktemp("checkout")
    git(root, "init", "-q")
    for k in range(2 * SHARES):
        git(root, "commit", "-q", "--allow-empty", "-m", f"commit {k}")
    return root, git(root, "rev-list", "--reverse", "HEAD").split()


def git(root: Path, *words: str) -> str:
    named = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    command = ["git", *named, *words]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, check=True, timeout=300).stdout


def test_each_test_is_taken_once_a_round(history: tuple[Path, list[str]]) -> None:
    root, commits = history
    for k in (0, SHARES):
        shares = [Share.of_commit(root, commit) for commit in commits[k : k + SHARES]]
        taken = Counter(test for share in shares for test in TESTS if share.takes(test))
        assert taken == Counter(TESTS)
    assert Share.of_commit(root, "HEAD") == Share.of_commit(root, commits[-1])


def test_shares_are_of_about_one_size_and_their_order_is_drawn() -> None:
    sizes = Counter(map(drawn, TESTS))
    assert set(sizes) == set(range(SHARES)) and max(sizes.values()) < 1.6 * len(TESTS) / SHARES
    orders = {tuple(order_of_round(f"{k:040x}")) for k in range(20)}
    assert len(orders) == 20 and all(sorted(order) == [*range(SHARES)] for order in orders)


def test_in_a_shallow_clone_the_hash_of_the_commit_draws_the_share(
    history: tuple[Path, list[str]], tmp_path: Path
) -> None:
    root, commits = history
    git(tmp_path, "clone", "-q", "--depth", "1", root.as_uri(), "shallow")
    assert Share.of_commit(tmp_path / "shallow", "HEAD").number == drawn(commits[-1])


def test_what_is_no_commit_is_said(history: tuple[Path, list[str]]) -> None:
    with pytest.raises(pytest.UsageError, match="name a commit of this checkout"):
        Share.of_commit(history[0], "--none")


def test_files_stay_together_and_come_in_an_order_of_the_commit(history: tuple[Path, list[str]]) -> None:
    root, commits = history
    orders = set[tuple[str, ...]]()
    for commit in commits:
        share = Share.of_commit(root, commit)
        files = [test.partition("::")[0] for test in sorted(TESTS, key=share.key)]
        orders.add(tuple(dict.fromkeys(files)))
        assert sum(one != other for one, other in itertools.pairwise(files)) == len(set(files)) - 1
    assert len(orders) > 5


def test_no_test_is_begun_when_the_time_is_over(history: tuple[Path, list[str]]) -> None:
    share = Share.of_commit(history[0], "HEAD")
    SlowShare(share, 1.0).pytest_runtest_setup()
    with pytest.raises(pytest.skip.Exception, match="not begun after -1 minutes"):
        SlowShare(share, -1.0).pytest_runtest_setup()


def test_the_option_leaves_the_tests_of_the_share(history: tuple[Path, list[str]]) -> None:
    """Asked of the slow tests of one file, in this checkout."""
    if subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, timeout=300).returncode:
        pytest.skip("this is no checkout")
    words = [sys.executable, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", "-q", "--collect-only", "-m", "slow",
             "tests/estimation/test_setup_blunders.py"]  # fmt: skip
    share = Share.of_commit(ROOT, "HEAD")
    every, taken = (
        set(re.findall(r"^tests/.*::.*$", done.stdout, re.MULTILINE))
        for done in (
            subprocess.run([*words, "-o", "addopts=", *more], cwd=ROOT, capture_output=True, text=True, timeout=300)
            for more in ((), ("--slow-share", "HEAD"))
        )
    )
    assert len(every) > 50 and taken == {test for test in every if share.takes(test)}
