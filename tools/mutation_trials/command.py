"""The command: draws changes, has them made, and tells which were noticed."""

from __future__ import annotations

import argparse
import itertools
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mutation_trials.changes import Change, changes_in, is_program
from mutation_trials.runner import Answer, Runner, content_hash, copied
from mutation_trials.test_map import static_map

ROOT = Path(__file__).resolve().parents[2]
_ABOUT = """
An operator, a comparison or a constant is changed at random in a private copy of the checkout. The fast tests that call
the function are run until one fails, in a process that has everything loaded: files that import the module first, and
quick ones before slow ones. A change is noticed where a test fails or takes ten times as long, does so again, and does
not without the change. If it passes when it is run again, or fails without the change, too, the line says UNSURE. What
survives changes no result, or shows that a test is missing: which of the two, a reader decides. Give --line to try
those of a line.
"""


@dataclass(frozen=True)
class Trial:
    """One change of a module, and what the tests said."""

    path: Path
    change: Change
    seconds: float
    answer: Answer

    def __str__(self) -> str:
        return "\t".join(map(str, (self.path, self.change.line, self.change, f"{self.seconds:.0f} s", self.answer)))


def drawn(paths: Sequence[Path], count: int, seed: int, line: int | None = None) -> list[tuple[Path, Change]]:
    """Changes drawn from all that are possible in modules, in the order of the modules."""
    sources = {path: (ROOT / path).read_text() for path in paths}
    every = [(path, change) for path, source in sources.items() for change in changes_in(source)
             if line is None or change.line == line]  # fmt: skip
    random.Random(seed).shuffle(every)
    sound = (task for task in every if is_program(task[1].of(sources[task[0]])))
    return sorted(itertools.islice(sound, count))


def modules(names: Sequence[str]) -> list[Path]:
    """The modules at paths, which may be folders, relative to the checkout."""
    places = [(ROOT / name).resolve() for name in names]
    paths = [path for place in places for path in (sorted(place.rglob("*.py")) if place.is_dir() else [place])]
    return [path.relative_to(ROOT) for path in paths]


def counts(trials: Sequence[Trial]) -> str:
    """How many were noticed, by folder, of those of which the tests tell anything; and of how many they do not."""
    total = Counter(trial.path.parent for trial in trials if not trial.answer.unsure)
    noticed = Counter(trial.path.parent for trial in trials if trial.answer.noticed_by)
    lines = [f"{folder}: {noticed[folder]} of {total[folder]} changes noticed" for folder in sorted(total)]
    unsure = sum(bool(trial.answer.unsure) for trial in trials)
    return "\n".join([*lines, *([f"{unsure} unsure"] if unsure else [])])


def main(words: Sequence[str] | None = None) -> None:
    """Print a line a change, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__, epilog=_ABOUT)
    parser.add_argument("paths", nargs="+", help="modules or folders, relative to the checkout")
    parser.add_argument("--count", type=int, default=sys.maxsize, help="changes to draw (all, where it is left out)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--line", type=int, help="only changes of this line")
    parser.add_argument("--budget", type=float, default=60.0, metavar="S", help="of the tests of one change, s")
    parser.add_argument("--map", type=Path, help="which tests call what, written where it is not there")
    words_on_unmapped = "do not run all tests once to learn what they call: take those that import the module"
    parser.add_argument("--unmapped", action="store_true", help=words_on_unmapped)
    words_on_whole = (
        "make all that survives at once, run all tests that call any of it, and try each on those that fail"
    )
    parser.add_argument("--whole", action="store_true", help=words_on_whole)
    parser.add_argument("-o", "--out", type=Path, help="write the table here, too")
    options = parser.parse_args(words)
    tasks = drawn(modules(options.paths), options.count, options.seed, options.line)
    if options.out is not None:
        options.out.write_text("")
    with tempfile.TemporaryDirectory(prefix="mutation") as folder:
        copy = copied(ROOT, Path(folder, "copy"))
        map_file = options.map or ROOT / "out" / "mutation" / f"{content_hash(ROOT)}.json"
        if options.unmapped:
            map_file = Path(folder, "map.json")
            static_map(copy).write(map_file)
        map_file.parent.mkdir(parents=True, exist_ok=True)
        with Runner(copy, {path for path, _ in tasks}, map_file.resolve(), options.budget) as runner:
            trials = list(_tried(runner, tasks, options.out))
            if options.whole:
                trials = list(_tried_together(runner, trials, options.out))
    print(counts(trials))


def _tried(runner: Runner, tasks: Sequence[tuple[Path, Change]], out: Path | None) -> Iterator[Trial]:
    for path, change in tasks:
        begun_s = time.monotonic()
        answer = runner.noticed_by(path, change)
        trial = Trial(path, change, time.monotonic() - begun_s, answer)
        _tell(trial, out)
        yield trial


def _tried_together(runner: Runner, trials: Sequence[Trial], out: Path | None) -> Iterator[Trial]:
    """Yield the trials, those of changes that survived tried on the tests that fail where all of these are made."""
    survived = [trial for trial in trials if not (trial.answer.noticed_by or trial.answer.unsure)]
    tests = runner.failing_together((trial.path, trial.change) for trial in survived)
    for trial in trials:
        if trial in survived:
            answer = runner.noticed_by(trial.path, trial.change, tests)
            trial = replace(trial, answer=replace(answer, tried=answer.calling))
            _tell(trial, out)
        yield trial


def _tell(trial: Trial, out: Path | None) -> None:
    print(trial, flush=True)
    if out is not None:
        with out.open("a") as file:
            print(trial, file=file)
