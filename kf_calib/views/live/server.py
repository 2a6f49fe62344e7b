"""The server of the page of a live run: on this machine's loopback address, for reading only.

A browser asks for the state twice a second. Nothing is kept for one, so that a browser that is slow, asleep or gone
leaves nothing behind, and one that comes late sees all. What is shown is made when it is asked for, at most four times
a second however many ask; at most 16 connections are served at once, each for 5 s at most: a run does not wait for any.

The name in the request must be this machine's (``Host``): a page of a stranger's whose name was made to lead to
127.0.0.1 (DNS rebinding) is refused. Nothing on the page comes from elsewhere, which its content security policy says.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from contextvars import copy_context
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from socketserver import TCPServer
from typing import Any

from kf_calib.errors import InputError

PORT = 8642
_FRESH_S = 0.25
_LONGEST_S = 5.0  # a connection
_MOST = 16  # connections at once
_WATCHED_S = 3.0  # since a page has asked, as long as it counts as open
_TOLD_S = 1.5  # in which an open page has asked for the end of the run
_HOSTS = "127.0.0.1", "localhost"
_FILES = {
    "/": ("page.html", "text/html"), "/page.css": ("page.css", "text/css"), "/page.js": ("page.js", "text/javascript"),
}  # fmt: skip
_HEADERS = {
    "Content-Security-Policy": "; ".join((
        "default-src 'none'", "script-src 'self'", "style-src 'self'", "connect-src 'self'", "img-src data:",
        "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'",
    )),
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}  # fmt: skip


class PageServer:
    """Serves the page from threads of its own until it is closed.

    port: 0 for any that is free. state: makes what is shown now, as an object for JSON; called from those threads, one
    at a time, in the context of whoever makes the server. Raises InputError where the port cannot be had.
    """

    def __init__(self, port: int = PORT) -> None:
        self.state: Callable[[], Mapping[str, Any]] = dict
        self._context, self._lock = copy_context(), threading.Lock()
        self._body, self._made_s, self._asked_s, self._ended_s = b"", -_FRESH_S, -_WATCHED_S, math.nan
        self._run = secrets.token_hex(4)
        try:
            self._server = _Server(port)
        except OSError as error:
            raise InputError(
                f"no page can be served on port {port} of 127.0.0.1 ({error.strerror}): choose another one with "
                "--page-port, or 0 for any that is free."
            ) from None
        self._server.state = self._state
        threading.Thread(target=self._server.serve_forever, args=(0.1,), name="page", daemon=True).start()

    @property
    def url(self) -> str:
        """Where the page is, on this machine."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/"

    def end(self) -> None:
        """The run is over: what is shown from now on is its end."""
        with self._lock:
            self._made_s, self._ended_s = -_FRESH_S, time.monotonic()

    def close(self) -> None:
        """Stop serving; where the run has ended and a page is open, not before it has had the time to ask for that."""
        if time.monotonic() - self._asked_s < _WATCHED_S and not math.isnan(self._ended_s):
            time.sleep(max(self._ended_s + _TOLD_S - time.monotonic(), 0.0))
        self._server.shutdown()
        self._server.server_close()

    def _state(self) -> bytes:
        """The state as JSON, made anew where it is no longer fresh."""
        with self._lock:
            now_s = self._asked_s = time.monotonic()
            if now_s - self._made_s >= _FRESH_S:
                made = {**self._context.run(self.state), "over": not math.isnan(self._ended_s), "run": self._run}
                self._body, self._made_s = json.dumps(made).encode(), now_s
            return self._body


class _Server(ThreadingHTTPServer):
    """state: gives the state of the page."""

    daemon_threads, block_on_close = True, False
    allow_reuse_address = os.name == "posix"  # elsewhere it would let two programs have the same port
    state: Callable[[], bytes]

    def __init__(self, port: int) -> None:
        self._places = threading.Semaphore(_MOST)
        super().__init__(("127.0.0.1", port), _Handler)

    def server_bind(self) -> None:
        """Without asking for the name of the address, which may go to a name server."""
        TCPServer.server_bind(self)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._places.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing: a browser that is gone is no trouble of the run."""


class _Handler(BaseHTTPRequestHandler):
    timeout = _LONGEST_S
    server_version, sys_version = "kf-calib", ""

    def do_GET(self) -> None:
        assert isinstance(self.server, _Server)
        host, _, port = self.headers.get("Host", "").partition(":")
        if host not in _HOSTS or not (port.isdigit() or not port):
            self._send(HTTPStatus.FORBIDDEN, "text/plain", b"This page is for 127.0.0.1 and localhost only.\n")
        elif self.path == "/state.json":
            self._send(HTTPStatus.OK, "application/json", self.server.state())
        elif self.path in _FILES:
            name, kind = _FILES[self.path]
            content = files("kf_calib.views.live").joinpath(name).read_bytes()
            self._send(HTTPStatus.OK, f"{kind}; charset=utf-8", content)
        else:
            self._send(HTTPStatus.NOT_FOUND, "text/plain", b"There is nothing here but the page at /.\n")

    def _send(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        for name, value in {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Write no log: standard error is for the run."""
