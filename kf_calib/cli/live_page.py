"""The page of a live run in a browser on this machine, for the commands that evaluate a run while it goes on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import rich_click as click

from kf_calib.cli.command import OUTPUT, option
from kf_calib.cli.echo import complain
from kf_calib.cli.live_run import LiveRun

if TYPE_CHECKING:
    from kf_calib.views.live.server import PageServer

_of_output = partial(option, panel=OUTPUT)


@dataclass(frozen=True)
class PageOptions:
    """Whether there is a page, and where."""

    # fmt: off
    with_page: Annotated[bool, _of_output(
        "--page", help="Show the run as a page in a browser on this machine, too.")] = False
    page_port: Annotated[int, _of_output(
        "--page-port", type=click.IntRange(0, 65535), metavar="PORT", help="Its port; 0: any that is free.")] = 8642
    # fmt: on


@contextmanager
def page_server(options: PageOptions) -> Iterator[PageServer | None]:
    """The server of the page, where there is to be one. Raises InputError where its port cannot be had."""
    if not options.with_page:
        yield None
        return
    from kf_calib.views.live.server import PageServer

    server = PageServer(options.page_port)
    complain(f"the page of this run is at {server.url}")
    try:
        yield server
    finally:
        server.close()


def page_state(run: LiveRun, name: str) -> Mapping[str, Any]:
    """What the page shows of a run now."""
    from kf_calib.views.live.content import ended
    from kf_calib.views.live.page import directions_of, gimbals_of, page_object

    session, doing, content = run.session, run.doing(), run.content(name)
    if run.final is not None or run.error is not None:
        content = ended(content, run.final, run.error)
    if session is None:  # the bench is not known yet, and asking for it would wait
        return page_object(content, [], [])
    standing, bench, heading = session.standing, session.source.bench, doing.heading_deg if doing else ()
    return page_object(content, directions_of(standing, bench, heading), gimbals_of(standing, bench, heading))
