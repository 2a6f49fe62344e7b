"""Files from others: they run no code that was not asked for, and command no terminal."""

import hashlib
import json
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from helpers.long_runs import slow
from helpers.own_effect import TEN_LINES

from kf_calib import effects
from kf_calib.bench.bench import Bench, axes_of
from kf_calib.bench.streams import Batch
from kf_calib.cli import cli
from kf_calib.errors import InputError
from kf_calib.estimation import model_file
from kf_calib.sources.files.recorder import Recorder
from kf_calib.sources.files.recording import Recording
from kf_calib.support.text import LONGEST, cut, printable, sentence

ESCAPES = "\x1b[31m\x1b]0;title\x07\x9b2J\x7f\u202e[red]"


ALARM = f'{TEN_LINES}\nfrom pathlib import Path\nPath(__file__).with_name("RAN").touch()\n'


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trust") / "run.mcap"
    words = ["simulate", str(out), "--dwell-s", "4", "--slew-degps", "180", "--orientations", "12",
             "--sample-hz", "25"]  # fmt: skip
    assert cli.main(words, standalone_mode=False) in (0, None)
    return out


@pytest.fixture
def received(tmp_path: Path, original: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a recording, and a model file that names a Python file beside it."""
    monkeypatch.setattr(effects, "_registered", {})
    folder = tmp_path / "received"
    folder.mkdir()
    shutil.copy(original, folder / "run.mcap")
    own = folder / "own.txt"  # of whatever extension
    own.write_text(ALARM)
    digest = hashlib.sha256(own.read_bytes()).hexdigest()
    (folder / "model.toml").write_text(
        f'effects = ["bend"]\neffects_from = ["own.txt"]\n[sha256]\n"own.txt" = "{digest}"\n'
    )
    return folder


COMMANDS = [
    "replay {f}/run.mcap --model {f}/model.toml", "compare {f}/run.mcap --model {f}/model.toml",
    "diagnose {f}/run.mcap --model {f}/model.toml", "effects --model {f}/model.toml",
    "improve {f}/run.mcap --unattended --model {f}/model.toml", "live sim://?speed=100 --model {f}/model.toml",
    "plan --recording {f}/run.mcap --model {f}/model.toml",
]  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_a_received_file_runs_no_code(run, received: Path, command: str) -> None:
    err = run.refused(*command.format(f=received).split())
    own = received / "own.txt"
    assert not (received / "RAN").exists()
    digest = hashlib.sha256(own.read_bytes()).hexdigest()
    assert all(said in err for said in (f"would run the Python file {own}", digest, "--trust", "--effects-from"))


@pytest.mark.parametrize(
    "words", [["--trust"], ["--effects-from", "{f}/own.txt"], ["--effects-from", "{f}/../copy.py"]]
)
@pytest.mark.parametrize("command", ["effects --model {f}/model.toml",
                                     "improve {f}/run.mcap --model {f}/model.toml"])  # fmt: skip
def test_code_runs_where_the_user_says_so(run, received: Path, words: list[str], command: str) -> None:
    (received.parent / "copy.py").write_text(ALARM)
    assert run.json(*(f"{command} {' '.join(words)}").format(f=received).split())
    assert (received / "RAN").exists() != ("copy.py" in words[-1])  # a copy that was named runs in place of the other


def test_a_file_that_has_changed_is_told(run, received: Path) -> None:
    with (received / "own.txt").open("a") as file:
        file.write("# changed\n")
    words = ["effects", "--model", received / "model.toml", "--json"]
    code, out, err = run(*words)
    assert (code, out) == (2, "") and "; when it was saved, " in err and not (received / "RAN").exists()
    code, out, err = run(*words, "--trust")
    assert code == 0 and json.loads(out) and "has changed since it was saved" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    "line", ["effects = ['my mine = a', 'bend']", "effects = [3]", "effects = ['bend']\nother = 1"]
)
def test_the_rest_of_a_file_is_checked_first(received: Path, line: str) -> None:
    path = received / "model.toml"
    path.write_text(f"{line}\neffects_from = ['own.txt']\n")
    with pytest.raises(InputError):
        model_file.read_model_file(path).load(trust=True)
    assert not (received / "RAN").exists()


def test_in_python_too(received: Path) -> None:
    found = model_file.read_model_file(received / "model.toml")
    with pytest.raises(InputError, match="would run"):
        found.load()
    assert not (received / "RAN").exists()
    assert found.load(named=[received / "own.txt"]) == () and (received / "RAN").exists()


def hostile(path: Path, original: Path) -> Path:
    """A recording whose gap reasons and name hold commands to the terminal."""
    path = path / f"a{ESCAPES.replace('/', '')}.mcap"
    source = Recording(original)
    with Recorder(path, Bench(axes_of("yzx"), 9.81)) as recorder:
        for k, batch in enumerate(source):
            assert isinstance(batch, Batch)
            recorder.write(batch)
            if k == 0:
                recorder.mark("kf_calib.gap", {"reason": ESCAPES * 1000, "seconds": "3"})
    return path


def commands_nothing(text: str) -> bool:
    return all(each == "\n" or each.isprintable() for each in text)


READERS = ["replay", "compare", "diagnose", "improve", "effects", "plan"]
LONG = [(command, ["--json"]) for command in ("compare", "diagnose", "improve")]
"""Their JSON is made as that of the others, and what they print on a terminal takes as long."""


@pytest.mark.usefixtures("unmeasured")
@pytest.mark.parametrize(
    "command, words",
    [
        *(
            case
            for words in ([], ["--json"], ["--pose-topic", ESCAPES], ["--with", ESCAPES])
            for case in ((command, words) for command in READERS)
            if case not in LONG
        ),
        *slow(*LONG),
    ],
)
def test_a_hostile_recording_commands_no_terminal(
    run, tmp_path: Path, original: Path, command: str, words: list[str]
) -> None:
    path = hostile(tmp_path, original)
    place = ["--recording", path] if command in ("effects", "plan") else [path]
    code, out, err = run(command, *place, *words)
    assert commands_nothing(out) and commands_nothing(err) and len(err) < LONGEST + 2
    assert code == (2 if len(words) == 2 else 0), err
    if words == ["--json"]:
        json.loads(out)


def test_text_is_made_printable() -> None:
    assert printable("σ ± µg/g²\nK1") == "σ ± µg/g²\nK1"
    assert printable("\x1b[2J\x9b\u202e\ud800\t") == r"\x1b[2J\x9b\u202e\ud800\t"
    assert sentence("a\nb") == r"a\nb" and len(sentence("\x1b" * 10**6)) == LONGEST
    long = cut("what " + "x" * 10**6 + " next", 100)
    assert len(long) == 100 and long.startswith("what") and long.endswith("next") and " … " in long
    assert np.all([len(cut("x" * n, 90)) == min(n, 90) for n in range(80, 200)])


def test_markup_is_text(run, tmp_path: Path) -> None:
    assert "[red]no[/red].mcap" in run.refused("replay", tmp_path / "[red]no[/red].mcap")


def test_a_saved_model_says_what_it_was_saved_with(run, received: Path) -> None:
    saved = received / "saved.toml"
    words = ["--effects-from", received / "own.txt", "--with", "bend", "--save-model", saved]
    assert run("replay", received / "run.mcap", *words)[0] == 0
    digest = hashlib.sha256((received / "own.txt").read_bytes()).hexdigest()
    assert tomllib.loads(saved.read_text())["sha256"] == {"own.txt": digest}
