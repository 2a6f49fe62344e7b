#!/usr/bin/env python
"""The numbers that the program gives, stored in tests/golden/numbers: this renews them, and says what changed.

usage: .venv/bin/python tools/golden_numbers.py [CASE...] [--fast]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from helpers import stored_numbers
from helpers.numbered_cases import FAST, SLOW

MOST = 40  # differences that are printed of a case


def main() -> None:
    """Renew the cases that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join([*FAST, *SLOW])}; all if left out")
    parser.add_argument("--fast", action="store_true", help="only those of the fast tests")
    options = parser.parse_args()
    for name in options.cases or ([*FAST] if options.fast else [*FAST, *SLOW]):
        with tempfile.TemporaryDirectory() as folder:
            tree = stored_numbers.plain((FAST | SLOW)[name](Path(folder)))
        is_new = stored_numbers.read(name) is None
        changed = [] if is_new else stored_numbers.changed(name, tree)
        if is_new or changed:
            stored_numbers.write(name, tree)
        told = [f"{len(changed)} changed", *map(str, changed[:MOST])] if changed else ["new" if is_new else "as it was"]
        print(f"{name}:", *told, sep="\n  ", flush=True)


if __name__ == "__main__":
    main()
