"""``kf-calib`` in a process of its own, without its start: forked from a server that has imported the package.

To start takes a second of the processor, most of it imports. Tests of signals, terminals, full disks and streams need a
process of their own, and no start. ``warm(...)`` is what they start: a launcher of a hundredth of a second, which hands
its streams, folder, environment, ignored signals and limits to the command, passes signals on to it, and ends as it
does. Of the server, all is as in a fresh process but what is imported.

    subprocess.Popen(warm("live", "sim://", "--json"), stdout=subprocess.PIPE)

Run as a script, this file is the server (``serve SOCKET``) or the launcher (``launch SOCKET WORD ...``).
"""

import contextlib
import io
import os
import signal
import socket
import sys

PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2)
MOST_BYTES, STREAMS = 1 << 20, (0, 1, 2)


def warm(*words: object) -> list[str]:
    """The command line that starts ``kf-calib WORDS``."""
    return [sys.executable, "-I", "-S", __file__, "launch", _server(), *map(str, words)]


_socket = list[str]()


def _server() -> str:
    """The socket of this process's server, which ends with it."""
    import atexit
    import subprocess
    import tempfile

    if not _socket:
        folder = tempfile.TemporaryDirectory(prefix="kf-calib-warm-")
        _socket.append(f"{folder.name}/socket")
        words = [sys.executable, __file__, "serve", *_socket]
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True)
        atexit.register(folder.cleanup)
        atexit.register(process.communicate)  # its standard input ends, and it
        assert process.stdout is not None and process.stdout.readline() == b"ready\n", "the server does not start"
    return _socket[0]


def launch(path: str, words: list[str]) -> None:
    """The launcher: ends as the command does, by its exit code or by its signal."""
    import json
    import resource

    ignored = [int(each) for each in PASSED_ON if signal.getsignal(each) == signal.SIG_IGN]
    told = {
        "words": words, "cwd": os.getcwd(), "env": dict(os.environ), "ignored": ignored,  # noqa: PTH109
        "session": os.getsid(0) == os.getpid(), "file_bytes": resource.getrlimit(resource.RLIMIT_FSIZE),
    }  # fmt: skip
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(path)
        signal.pthread_sigmask(signal.SIG_BLOCK, PASSED_ON)  # what comes now is passed on later
        told_bytes = json.dumps(told).encode()
        socket.send_fds(link, [len(told_bytes).to_bytes(8)], STREAMS)
        link.sendall(told_bytes)
        answers = link.makefile()
        pid = int(answers.readline())
        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in STREAMS:  # the command alone has them now: nobody waits for an end that is ours
            os.dup2(nothing, stream)
        for each in PASSED_ON:  # those that are ignored, too: the command may have a mind of its own
            signal.signal(each, lambda number, _: os.kill(pid, number))
        signal.pthread_sigmask(signal.SIG_UNBLOCK, PASSED_ON)
        status = int(answers.readline())
    if status < 0:
        signal.signal(-status, signal.SIG_DFL) if -status != signal.SIGKILL else None
        os.kill(os.getpid(), -status)
    os._exit(status)


def serve(path: str) -> None:
    """The server: forks a keeper for each launcher, until its own standard input ends. A command returns from here."""
    import gc
    import importlib
    import select

    for module in IMPORTED:
        importlib.import_module(module)
    gc.freeze()
    with socket.socket(socket.AF_UNIX) as entry:
        entry.bind(path)
        entry.listen(16)
        os.write(1, b"ready\n")
        keepers = set[int]()
        while 0 not in select.select([entry, 0], [], [])[0]:
            link = entry.accept()[0]
            keepers -= {keeper for keeper in keepers if os.waitpid(keeper, os.WNOHANG)[0]}
            if (keeper := os.fork()) == 0:
                entry.close()
                return keep(link)
            keepers.add(keeper)
            link.close()


IMPORTED = (
    "kf_calib.cli.live", "kf_calib.positioning.command", "kf_calib.cli.plan", "kf_calib.cli.acquire",
    "kf_calib.cli.evaluate", "kf_calib.cli.improve", "kf_calib.cli.replay",
    "kf_calib.diagnosis.missing_effect", "kf_calib.online.session", "kf_calib.sources.live",
    "kf_calib.views.live.screen",
    "kf_calib.views.json", "kf_calib.views.console", "kf_calib.sources.simulation.options", "scipy.optimize",
    "rich.live",
)  # fmt: skip
"""What most of the commands use, and import only when they do."""


def keep(link: socket.socket) -> None:
    """The keeper of a command: forks it, tells its number and how it ended, and kills it where the launcher is gone."""
    import json
    import select

    size, streams, _, _ = socket.recv_fds(link, 8, len(STREAMS))
    told = json.loads(link.makefile("rb").read(int.from_bytes(size)))
    pid = os.fork()
    if pid == 0:
        link.close()
        return become(told, streams)
    watched = os.pidfd_open(pid)
    link.sendall(f"{pid}\n".encode())
    for stream in {*streams, *STREAMS}:
        os.close(stream)
    if link in select.select([watched, link], [], [])[0]:
        signal.pidfd_send_signal(watched, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    with contextlib.suppress(OSError):
        link.sendall(f"{status}\n".encode())
    os._exit(0)


def become(told: dict, streams: list[int]) -> None:
    """The command: what a fresh process has of its launcher, then the package's entry, to its end."""
    import resource
    import runpy

    for stream, given in zip(STREAMS, streams, strict=True):
        os.dup2(given, stream)
    for given in streams:
        os.close(given)
    if told["session"]:
        os.setsid()
    for each in PASSED_ON:
        usual = signal.default_int_handler if each == signal.SIGINT else signal.SIG_DFL
        signal.signal(each, signal.SIG_IGN if int(each) in told["ignored"] else usual)
    os.environ.clear()
    os.environ.update(told["env"])
    os.chdir(told["cwd"])
    resource.setrlimit(resource.RLIMIT_FSIZE, tuple(told["file_bytes"]))
    sys.dont_write_bytecode = "PYTHONDONTWRITEBYTECODE" in os.environ  # which Python reads when it starts
    at_once = bool(os.environ.get("PYTHONUNBUFFERED"))
    for name, stream, mode in (("stdin", 0, "rb"), ("stdout", 1, "wb"), ("stderr", 2, "wb")):
        was, written = getattr(sys, name), mode == "wb"
        lines = name == "stderr" or os.isatty(stream)
        raw = open(stream, mode, 0 if at_once and written else -1, closefd=False)  # noqa: SIM115
        opened = io.TextIOWrapper(
            raw, was.encoding, was.errors, newline="\n" if written else None,
            line_buffering=lines, write_through=at_once and written,
        )  # fmt: skip
        setattr(sys, name, opened)
        setattr(sys, f"__{name}__", opened)
    sys.argv = ["kf-calib", *told["words"]]
    runpy.run_module("kf_calib.cli", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2])
    else:
        launch(sys.argv[2], sys.argv[3:])
