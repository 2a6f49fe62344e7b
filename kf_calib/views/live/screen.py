"""A live run on a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.text import Text

from kf_calib.views import terminal
from kf_calib.views.live.content import Content, Headings, Side, SigmaBar, SigmaRow, Task

_BAR = 18  # characters


def screen(content: Content, hint: str = "") -> RenderableType:
    """All that is known of a run now, for a terminal of 80 x 24 characters; of a smaller one, what stands last is cut
    off: what to do and the verdict stand first. hint: line at the bottom."""
    parts: list[RenderableType] = [_frame(content.task)]
    parts += [Text(*content.verdict)] if content.verdict else []
    parts += [Text(remark, style="yellow") for remark in content.remarks]
    parts += [Text(content.doing)] if content.doing else []
    parts += [Text.assemble(*line) for line in content.source]
    parts.append(_sigmas(content.headings, content.rows))
    parts += [Text.assemble(*line) for line in content.model]
    parts += [Text(hint, style="dim")] if hint else []
    return Group(*parts)


def _frame(task: Task) -> Panel:
    below = task.below
    if task.done is not None:
        full = round(_BAR * task.done)
        below = f"{'█' * full}{'·' * (_BAR - full)}  {below}"
    text = Text.assemble((task.what, f"bold {task.colour}"), *([f"\n{below}"] if below else []))
    return Panel(text, border_style=task.colour, padding=(0, 1))


def _sigmas(headings: Headings, rows: Sequence[SigmaRow]) -> RenderableType:
    table = terminal.ConsoleTable.grid(padding=(0, 1))
    sides: list[Side] = ["left", *(side for _, side in headings), "left"]
    for side in sides:
        table.add_column(justify=side, no_wrap=True)
    table.add_row("", *(heading for heading, _ in headings), "", style="dim")
    for row in rows:
        table.add_row(row.symbol, *row.cells, _drawn(row.bar))
    return table


def _drawn(bar: SigmaBar | None) -> terminal.Bar:
    if bar is None or bar.is_reached:
        return terminal.Bar("reached" if bar else "", style="green")
    full = round(_BAR * min(max(bar.share, 0.0), 1.0))
    return terminal.Bar("█" * full + "·" * (_BAR - full), style="cyan" if bar.has_target else "blue")
