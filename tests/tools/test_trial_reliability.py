"""Stated probabilities of the blind trial against the truth, in outcomes that are made up."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blind_trials.figure import Figure
from blind_trials.figures import figures
from blind_trials.outcome import NOISE, NONE, NOTHING, Hypothesis, Outcome
from blind_trials.reliability import bins, reliability_rows, save_reliability
from blind_trials.report import markdown
from blind_trials.statements import family_statements, name_statements, probability_of_truth
from blind_trials.task import NOISES, Task
from scipy.stats import beta

BIAS, HEAT = "bias in time", "temperature"


def hypothesis(what: str, probability: float) -> Hypothesis:
    """Return the explanation by effects ``a+b``, a ``formula``, ``noise`` or ``nothing``."""
    families = {"formula": NONE, "noise": NOISE, "nothing": NOTHING}
    if what in families:
        return Hypothesis(formula="t > 3*s" if what == "formula" else "", families=(families[what],),
                          probability=probability)  # fmt: skip
    return Hypothesis(tuple(what.split("+")), "", (BIAS,), probability)


def outcome(figure: str, truth: str = "", options: tuple[str, ...] = (), **more: Any) -> Outcome:
    """Return an outcome whose hidden effects ``a+b`` are in the catalogue unless ``outside`` says otherwise."""
    weighed = [hypothesis(what, p) for what, p in more.pop("weighed", {}).items()]
    hidden = tuple(filter(None, truth.split("+")))
    same = (*((name, name) for name in hidden), *more.pop("same", ()))
    families = tuple(more.pop("families", {}).items())
    return Outcome(
        Task(figure, "diagnose", 1, options=options), hidden, weighed[0].effects[0] if truth and weighed else None,
        same=same, consistent=not hidden, hypotheses=tuple(weighed), families=families, **more,
    )  # fmt: skip


def by_name(outcomes: list[Outcome]) -> dict[str, Figure]:
    """Return the figures of outcomes by name."""
    return {each.name: each for each in figures(outcomes)}


ALL = {"a": 0.4, "a2": 0.2, "b": 0.1, "a+b": 0.05, "formula": 0.12, "noise": 0.08, "nothing": 0.05}
"""One run's explanations; a2 means the same as a."""


@pytest.mark.parametrize(
    ("made", "right"),
    [
        (outcome("name@8", "a", weighed=ALL, same=[("a", "a2")]), 0.4 + 0.2),
        (outcome("name@8", "a2", weighed=ALL, same=[("a2", "a")]), 0.4 + 0.2),
        (outcome("pair@10", "a+b", weighed=ALL), 0.05),
        (outcome("name@8", "c", weighed=ALL), 0.0),
        (outcome("outside@15", "z", outside=("z",), true_families=(BIAS,), weighed=ALL), 0.12),
        (outcome("outside@15", "z", outside=("z",), alike=(("a", "b"),), true_families=(BIAS,), weighed=ALL), 0.17),
        (outcome("outside@15", "loose", outside=("loose",), true_families=(NOISE,), weighed=ALL), 0.12 + 0.08),
        (outcome("noise@white", weighed=ALL), 0.05),
        (outcome("noise@unstated", options=NOISES["unstated"], weighed=ALL), 0.08),
        (outcome("understated@scatter", weighed=ALL), 0.08),
    ],
    ids=["equal", "the other", "pair", "another", "outside", "parts", "loose", "nothing", "unstated", "understated"],
)
def test_which_explanations_are_true(made: Outcome, right: float) -> None:
    assert probability_of_truth(made) == pytest.approx(right)
    stated = name_statements(made)
    assert sum(each.probability for each in stated) == pytest.approx(1.0)
    assert sum(each.true for each in stated) == (right > 0.0)  # those that mean the same are one statement


def test_families_are_judged_as_names_are() -> None:
    said = {BIAS: 0.7, HEAT: 0.2, NONE: 0.1, NOISE: 0.05}
    alone = outcome("name@10", "a", families=said, true_families=(BIAS,))
    both = outcome("pair@10", "a+b", families=said, true_families=(BIAS, HEAT))
    equal = outcome("name@10", "a", families=said, true_families=(BIAS, HEAT))  # by a name that means the same
    free = outcome("outside@15", "z", families=said, outside=("z",), true_families=(NONE,))
    quiet = outcome("understated@scatter", families=said)
    true = [[each.probability for each in family_statements(made) if each.true] for made in (alone, both, equal, free)]
    assert true == [[0.7], [0.7, 0.2], [pytest.approx(0.9)], [0.1]]
    assert [each.probability for each in family_statements(quiet) if each.true] == [0.05]
    assert [each.family_right for each in (alone, both, equal, free)] == [True, True, True, False]
    found = by_name([alone, outcome("name@10", "a", families=said, true_families=(HEAT,)), outcome("name@10", "a")])
    assert found["family right, n = 10"].value == pytest.approx(1 / 3)


def test_what_is_outside_the_catalogue_is_unknown_or_noise_and_has_a_family() -> None:
    def made(first: str | None, family: str, said: str, **more: Any) -> Outcome:
        task = Task(f"{more.pop('figure', 'outside')}@15", "outside", 1, options=more.pop("options", ()))
        return Outcome(
            task, (f"of {family}",), first, outside=(f"of {family}",), true_families=(family,), families=((said, 0.9),),
            extra={"overlap": 0.1, "true_drivers": ["time"], "driver": "time"}, **more,
        )  # fmt: skip

    unstated = {"figure": "unstated-outside", "options": NOISES["unstated"]}
    found = by_name([made("unknown", BIAS, BIAS), made("warm", BIAS, BIAS), made("noise", NOISE, NOISE),
                     made("unknown", NONE, NONE), made("noise", BIAS, NOISE), made(None, NOISE, NOISE),
                     made("one", BIAS, BIAS, names=("two", "one"), alike=(("one", "two"),)),
                     made(None, NOISE, NOISE, **unstated), made("warm", NONE, BIAS, **unstated)])  # fmt: skip
    assert found["outside the catalogue, n = 15: unknown"].value == pytest.approx(4 / 7)
    assert found["outside the catalogue: a wrong name"].value == pytest.approx(1 / 7)
    assert found["outside the catalogue: family right, of those that belong to one"].value == pytest.approx(5 / 6)
    assert found[f"outside the catalogue: family right, worst effect: of {BIAS}"].value == pytest.approx(3 / 4)
    assert found["nothing stated, outside the catalogue, n = 15: unknown"].value == 0.5
    assert found["nothing stated, outside the catalogue: a wrong name"].value == 0.5
    assert found["nothing stated, outside the catalogue: family right, of those that belong to one"].count == 1


def test_scores_are_those_of_the_formulas() -> None:
    first = outcome("name@10", "a", weighed={"a": 0.6, "b": 0.3, "formula": 0.1}, families={BIAS: 0.9, HEAT: 0.2},
                    true_families=(BIAS,))  # fmt: skip
    never = outcome("name@10", "c", weighed={"a": 1.0}, families={HEAT: 1.0}, true_families=(BIAS,))
    found = by_name([first, never])
    logs = {"names": (0.6, 1e-6), "families": (0.9, 1e-6)}
    squares = {"names": 0.4**2 + 0.3**2 + 0.1**2, "families": 0.1**2 + 0.2**2}
    for what in ("names", "families"):
        score = found[f"{what}: log score, -ln of the probability of the truth, mean"]
        assert score.value == pytest.approx(-np.mean(np.log(logs[what]))) and score.count == 2
        brier = found[f"{what}: Brier score, sum of squared errors, mean"]
        assert brier.value == pytest.approx((squares[what] + 2.0) / 2)
    share = found["probability of the truth, n = 10, mean"]
    assert share.value == pytest.approx(0.3) and share.meets is None  # too few to judge
    assert by_name([first, never] * 10)["probability of the truth, n = 10, mean"].meets is False
    assert not [name for name in by_name([outcome("name@10", "a")]) if "score" in name or "probability" in name]


def test_the_diagram_is_that_of_the_draws(tmp_path: Path) -> None:
    """Statements that are true as often as stated lie within the limits of their bin; others do not."""
    rng, honest, boastful = np.random.default_rng(2), list[Outcome](), list[Outcome]()
    for p in rng.uniform(0.5, 1.0, 800):
        truth = "a" if rng.random() < p else "b"
        said = {"a": float(p), "b": float(1.0 - p)}
        honest.append(outcome("name@8", truth, weighed=said, families={BIAS: 1.0}, true_families=(BIAS,)))
        sure = {"a": 1.0 - (1.0 - said["a"]) / 10.0, "b": said["b"] / 10.0}
        boastful.append(outcome("name@8", truth, weighed=sure))
    found = bins(honest)
    assert [each.words for each in found if each.what == "names"] == [
        "0 to 1 %", "1 to 5 %", "5 to 20 %", "20 to 50 %", "50 to 80 %", "80 to 90 %", "90 to 95 %", "95 to 99 %",
        "99 to 100 %",
    ]  # fmt: skip
    assert sum(each.true.count for each in found) == 1600 + 800
    assert sum(each.calibrated for each in found if each.what == "names") >= 8
    assert not any(each.calibrated for each in bins(boastful) if each.stated > 0.95)
    last = found[-1]
    assert (last.what, last.low, last.stated, last.true.value, last.true.count) == ("families", 0.99, 1.0, 1.0, 800)
    assert last.true.low == pytest.approx(beta.ppf(0.025, 800, 1)) and last.calibrated
    assert reliability_rows(honest)[-1] == ["families", "99 to 100 %", "1.000", "1.000", "0.995 to 1.000", "800",
                                            "within"]  # fmt: skip
    assert "| of | stated | mean | true | 95 % limits | statements |  |" in markdown(honest)
    assert "statements" not in markdown([outcome("name@8", "a")])
    save_reliability(honest, tmp_path / "reliability.png")
    assert 10_000 < (tmp_path / "reliability.png").stat().st_size < 150_000


def test_a_trial_without_an_answer_states_nothing() -> None:
    refused = Outcome(Task("name@8", "diagnose", 1), ("a",), error="no.", refused=True)
    right = outcome("name@8", "a", weighed={"a": 1.0}, families={BIAS: 1.0}, true_families=(BIAS,))
    found = by_name([right, refused])
    assert found["family right, n = 8"].value == 0.5 and found["probability of the truth, n = 8, mean"].value == 0.5
    assert [each.true.count for each in bins([right, refused])] == [1, 1]
