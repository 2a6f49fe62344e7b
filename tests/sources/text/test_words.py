"""The table of words by which columns are told, as somebody extends it who knows another language."""

import tomllib
from collections import Counter

import pytest
from helpers.paths import ROOT

from kf_calib.sources.text.names import ACCEL, ANGLE, TEMPERATURE, TIME, Meaning, is_unit, meaning_of

WORDS = tomllib.loads((ROOT / "kf_calib" / "sources" / "text" / "words.toml").read_text("utf-8"))
UNITS = {unit: words.split() for unit, words in WORDS["units"].items()}
KINDS = {kind: words.split() for kind, words in WORDS["kinds"].items()}


def test_each_word_of_a_unit_is_of_one_unit_that_is_known() -> None:
    counts = Counter(word for words in UNITS.values() for word in words)
    assert [word for word, count in counts.items() if count > 1] == []
    assert set(UNITS) == {*ACCEL, *ANGLE, *TIME, *TEMPERATURE}
    assert all(map(is_unit, counts))


@pytest.mark.parametrize("kind", KINDS)
def test_the_words_of_a_kind_are_there_once_and_as_names_are_compared(kind: str) -> None:
    assert [word for word, count in Counter(KINDS[kind]).items() if count > 1 or word != word.lower()] == []


@pytest.mark.parametrize("word", KINDS["force"])
def test_each_word_for_a_force_makes_a_reading(word: str) -> None:
    assert meaning_of(f"{word} x [g]") == Meaning("ax", "g")


@pytest.mark.parametrize(("kind", "ours"), [("time", "time"), ("angle", "angle"), ("count", "count")])
def test_each_word_of_a_kind_makes_a_column_of_it(kind: str, ours: str) -> None:
    assert {word: meaning_of(word).ours for word in KINDS[kind]} == dict.fromkeys(KINDS[kind], ours)
