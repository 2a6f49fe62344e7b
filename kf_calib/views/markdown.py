"""What the console draws, in Markdown: paragraphs, remarks as a list, and tables; for the pages of text in Rerun."""

from __future__ import annotations

from rich.console import RenderableType

from kf_calib.views.html import PageTable, parts_of


def markdown(drawn: RenderableType) -> str:
    """The parts of what is drawn, in its order; asterisks and bars in a text, as of a formula, stay what they are."""
    return "\n\n".join(
        _table(part) if isinstance(part, PageTable) else "- " * (part.kind == "note") + literal(part.text)
        for part in parts_of(drawn)
    )


def _table(table: PageTable) -> str:
    heads = " | ".join(literal(each.text) for each in table.headings)
    sides = "|".join("--:" if each.is_number else ":--" for each in table.headings)
    rows = (" | ".join(literal(str(cell)) for cell in row) for row in table.rows)
    title = f"**{literal(table.title)}**\n\n" if table.title else ""
    return title + "\n".join(f"| {row} |" for row in (heads, *rows)).replace("\n", f"\n|{sides}|\n", 1)


def literal(text: str) -> str:
    """Text without markup of Markdown in it."""
    return text.replace("*", r"\*").replace("|", r"\|")
