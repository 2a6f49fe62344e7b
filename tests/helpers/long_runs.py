"""Cases of a test that take long: left out unless asked for with ``-m slow``."""

from typing import Any

import pytest


def slow(*cases: Any) -> list[Any]:
    """A case is the value of the one parameter, or the tuple of the values of several."""
    values = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [pytest.param(*own, marks=pytest.mark.slow) for own in values]
