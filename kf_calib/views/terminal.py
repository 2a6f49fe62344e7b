"""The Rich console that results are drawn on: what it draws is text, and nothing in it reaches the terminal as more."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from kf_calib.support.plain_text import printable, sentence


class PlainConsole(Console):
    """Reads no markup in what it is given, and draws characters that command a terminal as their codes."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **settings)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)


def note(said: str) -> Text:
    """What is worth knowing beside a result, in a line of its own."""
    return Text(f"Note: {sentence(said)}", style="yellow")
