"""What the program can say stands on one page that a person reads: a sentence that changes changes the page, too."""

import sys

from helpers.paths import ROOT

sys.path.insert(0, str(ROOT / "tools"))

from sentences import PAGE, page, sentences  # tools is no package of the path of tests


def test_the_page_has_all_that_the_program_can_say() -> None:
    assert PAGE.read_text() == page(), "the sentences have changed: run tools/sentences.py, and read what is new"


def test_sentences_are_found_with_their_values_and_docstrings_are_not() -> None:
    source = '''def f(x):
    """This docstring is not printed by anyone."""
    key = "two words"
    raise InputError("what a file is refused with")
    say(f"{x} of the dwells disagree: " "repeat the first of them.")
'''
    assert list(sentences(source)) == ["{x} of the dwells disagree: repeat the first of them."]
    assert list(sentences("def f(a):\n    return 'the ' + a + 'gimbal of the bench is stuck'\n")) == [
        "gimbal of the bench is stuck"
    ]


def test_no_sentence_speaks_of_itself_in_ways_that_were_misread() -> None:
    """Each of these was read twice by a first user."""
    said = page()
    for words in ("p of the run is", "Readings less all but", "of its column is left", "to 0.00 of its value",
                  "that they have no other has probability"):  # fmt: skip
        assert words not in said
