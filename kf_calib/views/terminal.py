"""The Rich console on which results are drawn: control characters in a text never reach the terminal as commands."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from kf_calib.support.plain_text import printable, sentence


class PlainConsole(Console):
    """A console that reads no markup in its text, and shows control characters as their codes."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """The segments of a renderable with control characters in its text replaced."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)


class Note(Text):
    """A remark beside a result, on a line of its own."""


def note(said: str) -> Note:
    """The remark of these words."""
    return Note(f"Note: {sentence(said)}", style="yellow")
