"""Options of ``simulate`` that say what is hidden and how warm it is."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from kf_calib.errors import InputError
from kf_calib.sources.files.recording import Recording
from kf_calib.sources.simulation.injected import catalogue
from kf_calib.sources.simulation.physics import Ambient

QUICK = ["--orientations", "12", "--dwell-s", "6", "--slew-degps", "360", "--sample-hz", "20"]


def test_hide_help_lists_every_effect_and_needs_no_recording(run):
    code, out, err = run("simulate", "--hide", "help")
    assert code == 0 and err == ""
    lines = out.splitlines()
    for kind in catalogue().values():
        row = next(line.split() for line in lines if line.split()[:1] == [kind.name + ":AXIS" * kind.per_axis])
        assert row[1:3] == ["yes" if kind.known else "no", kind.unit]
        assert kind.navigation[0] in row and kind.title.split()[0] in out
    assert "tau=1200 s" in out and "10sigma" in out and "random-unknown" in out
    assert max(map(len, lines)) <= 120


def test_a_size_in_sigma_comes_into_the_truth(run, tmp_path: Path):
    path = tmp_path / "run.mcap"
    words = ["--hide", "encoder-harmonic-1:z=10 sigma", "--hide", "random-unknown=8sigma", "--setting", "0.001"]
    assert run("simulate", path, *QUICK, *words)[0] == 0
    truth = json.loads(path.with_suffix(".truth.json").read_text())
    harmonic, other = truth["effects"]
    assert harmonic["name"] == "encoder-harmonic-1:z" and not other["in_catalogue"]
    assert [effect["size_sigma"] for effect in (harmonic, other)] == pytest.approx([10, 8], rel=0.01)
    assert truth["noise"]["setting_sigma_deg"] == 0.001
    err = run.refused("simulate", path, "--overwrite", *QUICK, "--hide", "gravity-error=10sigma")
    assert "gravity-error cannot be seen with these orientations, so no size in sigma exists for it" in err


def test_temperature_is_as_the_options_say(run, tmp_path: Path):
    path = tmp_path / "run.mcap"
    words = ["--temperature", 40, "--temperature-swing", 5, "--temperature-period-s", 50]
    assert run("simulate", path, *QUICK, *words, "--warm-up-c", 8, "--warm-up-s", 20)[0] == 0
    streams = [batch.temperature for batch in Recording(path)]
    time_s = (np.concatenate([stream.time_ns for stream in streams]) - streams[0].time_ns[0]) * 1e-9
    expected = 40 + 5 * np.sin(2 * math.pi * time_s / 50) - 8 * np.exp(-time_s / 20)
    np.testing.assert_allclose(np.concatenate([stream.values for stream in streams])[:, 0], expected, atol=0.06)
    assert run("simulate", path, "--overwrite", *QUICK)[0] == 0
    ambient = json.loads(path.with_suffix(".truth.json").read_text())["ambient"]
    usual = {"constant_c": 25.0, "swing_c": 0.0, "period_s": 3600.0, "warm_up_c": 0.0, "warm_up_s": 1800.0}
    assert ambient == usual | {"sigma_c": 0.01, "step_c": 0.0}


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--temperature-period-s", "0"], "the period of the temperature is 0 s: give a positive time."),
        (["--temperature-period-s", "-5"], "the period of the temperature is -5 s: give a positive time."),
        (["--warm-up-s", "0"], "the warm-up time is 0 s: give a positive time."),
        (["--warm-up-c", "nan"], "not a finite number"),
        (["--temperature", "inf"], "not a finite number"),
        (["--temperature", "-280"], "the temperature falls to -280 degC, below absolute zero"),
        (["--temperature-swing", "300"], "the temperature falls to -275 degC, below absolute zero"),
    ],
)
def test_impossible_temperatures_are_refused_in_one_sentence(run, tmp_path: Path, words, sentence):
    assert sentence in run.refused("simulate", tmp_path / "run.mcap", *words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("query", "sentence"),
    [
        ("grade=foo", "there is no grade 'foo': use paper, navigation, mems."),
        ("seed=-3", "seed is -3: give zero or a positive number."),
        ("orientations=abc", "orientations=abc is not a number."),
        ("nothing=3", "has no setting 'nothing'"),
        ("plan=/not/there.csv", "the plan cannot be read"),
    ],
)
def test_impossible_settings_of_a_simulated_source_are_refused_in_one_sentence(run, tmp_path: Path, query, sentence):
    assert sentence in run.refused("live", f"sim://?{query}&speed=inf")
    assert run("plan", "--axes", "y z x", "--seed", "-1")[0] == 2


def test_thermometer_noise_cannot_be_negative():
    with pytest.raises(InputError, match="thermometer"):
        Ambient(sigma_c=-1.0)
