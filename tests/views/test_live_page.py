"""The page of a live run: it shows what the terminal shows, and no browser disturbs the run or is led astray."""

import json
import re
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.client import HTTPConnection, HTTPResponse
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.by_hand import by_hand
from helpers.synthetic import Run
from helpers.warm_command import warm

from kf_calib.errors import InputError
from kf_calib.online.session import HandSession, Session
from kf_calib.sources.live import Status
from kf_calib.views.console import plain
from kf_calib.views.live.content import Doing, content_of, ended
from kf_calib.views.live.page import directions_of, gimbals_of, page_object
from kf_calib.views.live.screen import screen
from kf_calib.views.live.server import PageServer

RUN = "sim://?speed=40&orientations=9&dwell_s=6&sample_hz=50&slew_degps=180&seed=3"
SLOW = RUN.replace("orientations=9", "orientations=60").replace("speed=40", "speed=10")


def answered(port: int, path: str = "/state.json", method: str = "GET", **headers: str) -> tuple[HTTPResponse, bytes]:
    link = HTTPConnection("127.0.0.1", port, timeout=10.0)
    link.putrequest(method, path, skip_host="Host" in headers)
    for name, value in headers.items():
        if value:
            link.putheader(name, value)
    link.endheaders()
    answer = link.getresponse()
    return answer, answer.read()


def port_of(server: PageServer) -> int:
    return int(server.url.rstrip("/").rpartition(":")[2])


@pytest.fixture
def server() -> Iterator[PageServer]:
    served = PageServer(0)
    yield served
    served.close()


def test_page_and_terminal_show_the_same_texts_of_a_bench() -> None:
    session = Session(Run(dwells=8, count=60), wanted={"K1": 1e-9, "b2": 1.0})
    session.run()
    standing = replace(session.standing, notice="second-order accepted")
    content = content_of(
        standing, Status(link="lost", trouble="no answer."), "sim://", "run.mcap", Doing("", "the bench: moving")
    )
    made = json.loads(json.dumps(page_object(content, [], [])))
    shown = plain(screen(content), width=200)
    texts = [made["task"]["what"], made["verdict"][0], *made["remarks"], made["doing"], made["model"][0][0][0]]
    texts += [part for line in made["source"] for part, _ in line]
    texts += [text for row in made["rows"] for text in (row["symbol"], *row["cells"])]
    assert len(texts) > 70 and [text for text in texts if text.strip() not in shown] == []
    assert [row["bar"]["has_target"] for row in made["rows"]].count(True) == 2
    assert [row["bar"]["share"] <= 0.0 for row in made["rows"] if row["bar"]["has_target"]] == [False, True]


@pytest.mark.slow
def test_directions_are_those_of_the_dwells_of_the_open_one_and_of_the_next() -> None:
    session = Session(Run(dwells=8, count=60))
    seen = []
    session.listeners.append(lambda judgement: seen.append(replace(session.standing, judgement=judgement)))
    session.run()
    bench, standing = session.source.bench, seen[5]
    directions = directions_of(standing, bench)
    assert [each.state for each in directions] == [*["done"] * 6, "next"]
    assert [each.number for each in directions] == [1, 2, 3, 4, 5, 6, None]
    force = np.array([visit.dwell.means[1:4] for visit in standing.judgement.result.visits])
    unit = force / np.linalg.norm(force, axis=1, keepdims=True)
    assert np.abs([each.up for each in directions[:-1]] - unit).max() < 2e-4
    following = standing.judgement.next_orientation[0]
    assert np.array(directions[-1].up) == pytest.approx(
        bench.specific_force(np.zeros(1), np.radians([following]))[0] / bench.gravity_mps2, abs=1e-4
    )
    assert [float(angle) for _, angle in gimbals_of(standing, bench)] == pytest.approx(following, abs=0.05)
    assert gimbals_of(standing, bench, (1.0, 2.0, 3.0))[2] == ("gimbal 3 (x)", "3")
    assert gimbals_of(session.standing, bench) == [] and directions_of(Session(session.source).standing, bench) == []


def test_a_sensor_in_the_hand_has_its_sides_and_the_next_one() -> None:
    session = HandSession(by_hand(poses=12))
    session.run()
    bench, going = session.source.bench, replace(session.standing.judgement, final=False)
    assert [each.state for each in directions_of(session.standing, bench)] == ["done"] * 12
    directions = directions_of(replace(session.standing, judgement=going), bench)
    assert [each.state for each in directions] == [*["done"] * 12, "next"]
    assert np.linalg.norm([each.up for each in directions], axis=1) == pytest.approx(1.0, abs=1e-3)
    assert np.array([each.up for each in directions[:-1]]) == pytest.approx(session.standing.sides.up, abs=1e-4)
    content = content_of(replace(session.standing, rest_s=2.5), None, "board")
    assert content.task.done == 0.5 and content.task.colour == "yellow" and len(content.rows) == 9
    over = ended(content, session.standing.judgement, None)
    assert over.task.what == "THE RUN HAS ENDED" and "12 orientations" in over.task.below and over.verdict


def test_a_run_that_failed_says_why() -> None:
    content = content_of(Session(Run(dwells=2, count=20)).standing, None, "sim://")
    made = page_object(ended(content, None, InputError("no dwell was found.")), [], [])
    assert made["task"] == {
        "what": "THE RUN HAS ENDED", "below": "no dwell was found.", "colour": "red", "done": None,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1", 200), ("localhost", 200), ("localhost:9000", 200), ("127.0.0.1:1", 200), ("evil.example", 403),
        ("evil.example:8642", 403), ("127.0.0.1.evil.example", 403), ("localhost.evil", 403), ("localhost:x", 403),
        ("", 403), ("192.168.1.7", 403),
    ],
)  # fmt: skip
def test_only_the_names_of_this_machine_are_answered(server: PageServer, host: str, status: int) -> None:
    for path in ("/", "/state.json"):
        answer, body = answered(port_of(server), path, Host=host)
        assert answer.status == status and (status == 200 or body.endswith(b"only.\n"))


def test_it_listens_on_the_loopback_address_and_nothing_on_the_page_is_from_elsewhere(server: PageServer) -> None:
    assert server._server.socket.getsockname()[0] == "127.0.0.1"
    answer, body = answered(port_of(server), "/")
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy and "http" not in policy
    assert answer.headers["Access-Control-Allow-Origin"] is None and b'src="page.js"' in body
    assert answered(port_of(server), "/../server.py")[0].status == 404
    assert answered(port_of(server), "/", method="POST")[0].status == 501
    for name in ("page.html", "page.css", "page.js"):
        text = files("kf_calib.views.live").joinpath(name).read_text()
        assert re.findall(r"(?:https?:)?//\w[\w.]+/?\w*", re.sub(r"// .*", "", text)) in (
            [],
            ["http://www.w3.org/2000"],
        )


def test_a_taken_port_is_refused_in_one_sentence_before_anything_is_recorded(
    run: Any, server: PageServer, tmp_path: Path
) -> None:
    record = tmp_path / "run.mcap"
    words = ("live", RUN, "--record", record, "--page", "--page-port", port_of(server))
    errors = run.refused(*words)
    assert "Address already in use" in errors and "--page-port" in errors and not record.exists()


def test_a_state_is_made_four_times_a_second_however_many_ask(server: PageServer) -> None:
    made = list[int]()
    server.state = lambda: made.append(1) or {"count": len(made)}
    began = time.monotonic()
    for _ in range(100):
        answered(port_of(server))
    assert len(made) <= 1 + (time.monotonic() - began) / 0.25


def test_a_state_that_cannot_be_made_costs_its_answer_only(server: PageServer) -> None:
    server.state = lambda: {}["missing"]
    with pytest.raises(OSError):
        answered(port_of(server))
    server.state = dict
    assert answered(port_of(server))[0].status == 200


def results(objects: str) -> dict[str, Any]:
    """The last object, less what depends on the computer's time."""
    last = json.loads(objects.splitlines()[-1])
    return {key: value for key, value in last.items() if key not in ("source", "time_left_s")}


@pytest.mark.slow
def test_dead_and_slow_browsers_leave_the_run_as_it_is() -> None:
    plainly = subprocess.run(warm("live", RUN, "--json"), capture_output=True, text=True, timeout=120)
    with live(RUN, "--json") as (process, port):
        links = [socket.create_connection(("127.0.0.1", port)) for _ in range(40)]
        for link in links[:20]:
            link.sendall(b"GET /state.json HTTP/1.1\r\nHost: 127.0.0.1\r\n")  # half a question; nothing is ever read
        began = time.monotonic()
        said, errors = process.communicate(timeout=120)
        assert process.returncode == 0, errors
        assert results(said) == results(plainly.stdout)
        assert time.monotonic() - began < 30.0
        for link in links:
            link.close()


@contextmanager
def live(*words: object, command: str = "live", **streams: Any) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A run with a page, and the port of the page."""
    given = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL} | streams
    words = (command, *words, "--page", "--page-port", 0)
    with subprocess.Popen(warm(*words), text=True, **given) as process:
        try:
            assert process.stderr is not None
            told = process.stderr.readline()
            yield process, int(re.findall(r"127\.0\.0\.1:(\d+)", told)[0])
        finally:
            process.kill()


class Visit:
    """A page that is open in a browser, and what the browser complained of or asked for elsewhere."""

    def __init__(self, browser: Any, port: int, width: int = 400, height: int = 860, colours: str = "light") -> None:
        url = f"http://127.0.0.1:{port}/"
        self.told = list[str]()
        self.page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=colours)
        self.page.on("pageerror", lambda error: self.told.append(str(error)))
        self.page.on("console", lambda message: self.told.append(message.text))
        self.page.on(
            "request", lambda each: None if each.url.startswith((url, "data:")) else self.told.append(each.url)
        )
        self.page.goto(url)

    def until(self, script: str, patience_s: float = 60.0) -> None:
        began = time.monotonic()  # wait_for_function is refused by the page's policy, as it evaluates a text
        while not self.page.evaluate(script):
            assert time.monotonic() - began < patience_s, "waited in vain"
            self.page.wait_for_timeout(50.0)

    def text(self, selector: str) -> str:
        return self.page.locator(selector).inner_text()


DETERMINED = "document.querySelectorAll('#sigmas .bar, #sigmas .reached').length === 12"
OVER = "document.querySelector('#what').textContent === 'THE RUN HAS ENDED'"


@pytest.mark.slow
def test_the_page_fits_a_phone_and_a_large_screen_in_light_and_dark(browser: Any) -> None:
    with live(SLOW, "--target", "K=2ppm", "--json", stdout=subprocess.DEVNULL) as (process, port):
        visits = [
            Visit(browser, port, width, height, colours)
            for width, height in ((400, 860), (1600, 1000))
            for colours in ("light", "dark")
        ]
        for visit in visits:
            visit.until(DETERMINED)
            visit.until("document.querySelectorAll('#sphere .next').length === 1")
            wide = visit.page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
            assert wide[0] <= wide[1], "nothing is wider than the screen"
            size = visit.page.evaluate("parseFloat(getComputedStyle(document.querySelector('#what')).fontSize)")
            assert size >= 30.0, "to be read from a step away"
            assert visit.page.locator("#what").bounding_box()["y"] < 100.0
            assert visit.page.locator("#sphere circle.done").count() >= 4
            assert "target" in visit.text("#sigmas thead") and "ppm" in visit.text("#sigmas tbody")
            assert visit.text("#verdict")
        light, dark = (
            visits[k].page.evaluate("getComputedStyle(document.documentElement).backgroundColor") for k in (0, 1)
        )
        assert light == "rgb(255, 255, 255)" and max(map(int, re.findall(r"\d+", dark)[:3])) < 60
        visits[0].page.close()  # a browser that goes while the run goes on
        visits[1].page.context.close()
        process.send_signal(signal.SIGINT)
        for visit in visits[2:]:
            visit.until(OVER)
            assert visit.told == [] and visit.page.locator("#silence").is_hidden()
        assert process.wait(60) == 0


def test_texts_of_a_stranger_are_text_on_the_page(browser: Any, server: PageServer) -> None:
    evil = "<img src=x onerror=alert(1)><b>x"
    content = content_of(Session(Run(dwells=2, count=20)).standing, Status(trouble=evil), evil, evil)
    made = page_object(replace(content, verdict=(evil, "bold"), remarks=[evil], doing=evil), [], [(evil, "1")])
    server.state = lambda: made
    visit = Visit(browser, port_of(server))
    visit.until("document.querySelector('#verdict').textContent.length > 0")
    assert visit.page.locator("main img, #standing img, #source img, b").count() == 0 and visit.told == []
    assert evil in visit.page.locator("#verdict").text_content()


def test_a_page_that_is_opened_late_has_all_and_one_whose_recorder_is_killed_says_so(browser: Any) -> None:
    with live(SLOW, "--json", stdout=subprocess.DEVNULL) as (process, port):
        early = Visit(browser, port, 1600, 1000)
        early.until("document.querySelectorAll('#sphere .done').length >= 6")
        late = Visit(browser, port)
        late.until("document.querySelectorAll('#sphere .done').length >= 6")
        assert late.text("#sigmas thead") == early.text("#sigmas thead")
        process.kill()
        for visit in (early, late):
            visit.until("!document.querySelector('#silence').hidden", 20.0)
            assert "ended or killed" in visit.text("#silence") and visit.page.locator("#sphere .done").count() >= 6


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("live", ("sim://?speed=60&grade=mems&orientations=14&dwell_s=7&sample_hz=50&seed=2", "--no-angles")),
        ("run", ("--positioner", "sim://?seed=4&sample_hz=20&speed=60", "--target", "K=20ppm")),
    ],
)
def test_the_end_of_a_run_by_hand_and_of_a_bench_that_drives_itself_is_seen(
    command: str, words: tuple[str, ...], browser: Any
) -> None:
    with live(*words, command=command) as (process, port):
        visit = Visit(browser, port, colours="dark")
        visit.until(OVER, 120.0)
        said, errors = process.communicate(timeout=60)
        assert process.returncode == 0, errors
        verdict = " ".join(visit.text("#verdict").split())
        assert visit.told == [] and verdict
        if command == "run":
            assert verdict in " ".join(said.split()), "the verdict of the summary"
