"""Results in a notebook: what the console prints of them, as HTML; registered for ``as_html`` when imported.

Without Jinja2, which comes with the extra ``report``, a notebook shows them as text.
"""

from __future__ import annotations

from importlib.util import find_spec

from rich.console import RenderableType

from kf_calib.diagnosis.results import Diagnosis
from kf_calib.diagnosis.stepwise_selection import Improvement
from kf_calib.estimation.results import Calibration
from kf_calib.support.printing import as_html
from kf_calib.views import console, diagnosis, improvement


@as_html.register
def _(result: Calibration) -> str | None:
    return _html(console.summary(result))


@as_html.register
def _(found: Diagnosis) -> str | None:
    return _html(diagnosis.diagnosis_report(found))


@as_html.register
def _(state: Improvement) -> str | None:
    return _html(improvement.improvement_report(state, None, None))


def _html(drawn: RenderableType) -> str | None:
    """Return what the console draws as HTML, or None where the package that fills in templates is not installed."""
    if find_spec("jinja2") is None:
        return None
    from kf_calib.views.report.page import fragment
    from kf_calib.views.report.parts import parts_of

    return fragment(parts_of(drawn))
