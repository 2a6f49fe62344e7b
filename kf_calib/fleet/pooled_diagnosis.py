"""The diagnosis of many runs together: which effects they have, and whether each is the bench's or the sensors'."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kf_calib.bench.arrays import Floats, one_blas_thread
from kf_calib.effects import described
from kf_calib.errors import InputError
from kf_calib.fleet.attribution import Attributed, AttributionTable, attributed, chosen
from kf_calib.fleet.campaign import FLAT, Campaign, Factors, Group, RunKey
from kf_calib.fleet.own_coefficients import UnitsAndCommon, population
from kf_calib.fleet.pooled_terms import Attribution, BenchEstimate, DatedSums, PooledTerms, Term
from kf_calib.fleet.run_factor import ReferenceUnit
from kf_calib.fleet.shape import SomeUnits

RIVAL = 0.01
"""Probability above which another effect is named as a rival."""
_ABSURD = (
    "the runs cannot be diagnosed together, as the factor of at least one has numbers that no run has: evaluate them "
    "again into a new folder (-o)."
)
_SEEN = 3.0  # sigmas from which a coefficient is told
_MAY_BE = 0.05  # of the probability of an effect: above it all units may have it
_LEVEL = 0.95
_LIKELY = 1e-3  # of a part of a campaign: above it the part is looked at run by run


@dataclass(frozen=True)
class PooledEstimate:
    """A coefficient: symbol, value and sigma in an SI unit; None where the runs do not tell."""

    symbol: str
    value: float | None
    sigma: float | None
    unit: str


@dataclass(frozen=True)
class BenchCoefficients:
    """Coefficients that all runs on a bench have in common, those from a repair on apart.

    since: date of the first run that has them, if it is not the first on that bench. covariance: of the coefficients,
    SI; large where one of them is not determined.
    """

    bench: str
    since: str | None
    coefficients: tuple[PooledEstimate, ...]
    covariance: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class PopulationFigures:
    """Mean of the coefficients over the units that have the effect, and their spread about it with its 95 % interval,
    SI."""

    mean: tuple[PooledEstimate, ...]
    spread: float
    spread_interval: tuple[float, float]


@dataclass(frozen=True)
class UnitFigures:
    """What one unit has of an effect: the probability that it has it, and its coefficients if it does."""

    unit: str
    probability: float
    coefficients: tuple[PooledEstimate, ...]

    @property
    def is_seen(self) -> bool:
        """Whether a coefficient is beyond three sigma."""
        known = [(each.value, each.sigma) for each in self.coefficients]
        return any(value is not None and sigma is not None and abs(value) > _SEEN * sigma for value, sigma in known)


@dataclass(frozen=True)
class Finding:
    """An effect that the runs have.

    - attribution: of what it is, most likely. probabilities: of every attribution of it.
    - rivals: other effects that may be there in its place, with their probabilities.
    - benches: the coefficients of each bench; empty if the effect is the sensors'.
    - over_time: the same from the runs of one part of the campaign after another; ``since``: when the part begins.
    - population, units, share, share_interval: of the units; None or empty if it is the bench's. ``population`` is not
      given for a single unit, nor ``share``, that of these units that have it, if the effect is each run's own.
    - repair: when it changed, if it did.
    """

    effect: str
    attribution: Attribution
    probabilities: Mapping[Attribution, float]
    rivals: Mapping[str, float]
    benches: tuple[BenchCoefficients, ...] = ()
    over_time: tuple[BenchCoefficients, ...] = ()
    population: PopulationFigures | None = None
    units: tuple[UnitFigures, ...] = ()
    share: float | None = None
    share_interval: tuple[float, float] | None = None
    repair: RepairDate | None = None


@dataclass(frozen=True)
class EffectRow:
    """One effect of the catalogue: the probability of each attribution and that no run has it.

    benches: what it would be as one of the bench, beside what was found; empty where it cannot be of one.
    Probabilities are None where no run can show the effect.
    """

    effect: str
    probabilities: Mapping[Attribution, float] | None
    no_one: float | None
    benches: tuple[BenchCoefficients, ...]


@dataclass(frozen=True)
class PooledDiagnosis:
    """The diagnosis of many runs together. no_more: probability that they have no effect besides those found."""

    runs: int
    units: int
    benches: tuple[str, ...]
    findings: tuple[Finding, ...]
    effects: tuple[EffectRow, ...]
    no_more: float


def pooled_diagnosis(factors: Factors, *, reference_unit: ReferenceUnit | None = None) -> PooledDiagnosis:
    """Diagnose many runs together.

    - factors: the reduced factors of the runs, or a function that reads them anew each time it is called, such as
      ``open_fleet("fleet").factors``, so that memory does not grow with their number.
    - reference_unit: a unit whose scale factors are known, so that an error of gravity can be seen.

    Raises InputError if there are no runs, or if their numbers are none that runs have.
    """
    with one_blas_thread():
        try:
            campaign = Campaign(factors, reference_unit)
            attribution = attributed(campaign)
            findings = [_finding(campaign, attribution, k) for k in range(len(attribution.terms))]
            rows = tuple(_rows(campaign, attribution, {each.effect: each for each in findings}))
        except np.linalg.LinAlgError:
            raise InputError(_ABSURD) from None
    units = len({key.unit for key in campaign.keys})
    return PooledDiagnosis(
        len(campaign.keys), units, tuple(campaign.benches), tuple(findings), rows, attribution.rest.none
    )


def _finding(campaign: Campaign, attribution: Attributed, number: int) -> Finding:
    """Return what is to be said of one term, from its table beside the others."""
    term, table = attribution.terms[number], attribution.tables[number]
    shares = dict(table.of(term.group.name))
    rivals = {name: share for name, share in table.effects().items() if share > RIVAL and name != term.group.name}
    so_far = Finding(term.group.name, chosen(table).attribution, shares, rivals)
    if not so_far.attribution.common:
        return _of_units(campaign, attribution, number, so_far)
    sums = DatedSums.of(campaign, _free(campaign, attribution, number), [term.repair] if term.repair else [])
    benches = tuple(_bench_coefficients(campaign, term.group, each) for each in sums.estimates(term.group, term.repair))
    followed = tuple(
        replace(_bench_coefficients(campaign, term.group, each), since=campaign.by_date[each.since].date)
        for bench in range(len(campaign.benches))
        for each in sums.over_time(term.group, bench)
    )
    when = repair_date(campaign, _others(campaign, attribution, number), term) if term.repair else None
    return replace(so_far, benches=benches, over_time=followed, repair=when)


def _others(campaign: Campaign, attribution: Attributed, number: int) -> PooledTerms:
    """Return all terms but one, with their sizes: what is likely of that one is said beside these."""
    return PooledTerms([*attribution.terms[:number], *attribution.terms[number + 1 :]], len(campaign.benches))


def _free(campaign: Campaign, attribution: Attributed, number: int | None = None) -> PooledTerms:
    """Return all terms, or all but one, with nothing supposed of their coefficients: values are estimated beside these.

    A term of some units is one of all of them where that may well be so.
    """
    free = [term.free() for term in attribution.terms]
    chances = [table.of(term.group.name) for term, table in zip(attribution.terms, attribution.tables, strict=True)]
    every = [shares.get(Attribution.SENSORS, 0.0) > _MAY_BE * sum(shares.values()) for shares in chances]
    free = [replace(term, units=None) if all_have_it else term for term, all_have_it in zip(free, every, strict=True)]
    return PooledTerms([term for k, term in enumerate(free) if k != number], len(campaign.benches))


def _of_units(campaign: Campaign, attribution: Attributed, number: int, so_far: Finding) -> Finding:
    """Return the finding with population, units and share."""
    term, free = attribution.terms[number], _free(campaign, attribution, number)
    information = _told(campaign, term, free)
    if term.attribution is Attribution.RUN:
        has, share, interval = np.ones(len(information.of_units.units)), None, None
    else:
        some = SomeUnits(term.group, _told(campaign, term, _others(campaign, attribution, number)).integrated())
        chance = so_far.probabilities
        of_all = chance[Attribution.SENSORS] / (chance[Attribution.SENSORS] + chance[Attribution.SOME])
        has = of_all + (1.0 - of_all) * some.probabilities
        share, interval = some.share(of_all)
    people, figures = population(information, has > 0.5, term.group.largest), None
    if people is not None:
        sigma, (low, high) = term.group.sigma, people.spread_interval
        mean = _estimates(term.group, people.mean, people.covariance)
        figures = PopulationFigures(mean, people.spread * sigma, (low * sigma, high * sigma))
    rows = zip(information.of_units.units, has.tolist(), information.integrated().estimates(), strict=True)
    units = tuple(UnitFigures(unit, chance, _estimates(term.group, *values)) for unit, chance, values in rows)
    return replace(so_far, population=figures, units=units, share=share, share_interval=interval)


def _told(campaign: Campaign, term: Term, others: PooledTerms) -> UnitsAndCommon:
    """Return what units tell of the coefficients of a term, or single runs where these are theirs."""
    of_runs = term.attribution is Attribution.RUN
    level = campaign.runs() if of_runs else campaign.units(others.repairs)
    told = UnitsAndCommon.joined([UnitsAndCommon.of(term.group, others, others.beside_own(blocks)) for blocks in level])
    return told if of_runs else told.by_unit()


def _rows(campaign: Campaign, attribution: Attributed, findings: Mapping[str, Finding]) -> Iterable[EffectRow]:
    """Yield a row for every effect, those found first."""
    sums = DatedSums.of(campaign, _free(campaign, attribution))
    order = {name: k for k, name in enumerate(findings)}
    for group in sorted(campaign.groups, key=lambda group: order.get(group.name, len(order))):
        if group.name in findings:
            finding = findings[group.name]
            yield EffectRow(group.name, finding.probabilities, _rest(finding.probabilities), finding.benches)
        elif not group.sigma:
            yield EffectRow(group.name, None, None, ())
        else:
            shares = _likeliest(group.name, [attribution.rest, *attribution.tables])
            of_bench = sums.estimates(group) if Attribution.BENCH.possible(group.borne_by) else []
            benches = tuple(_bench_coefficients(campaign, group, each) for each in of_bench)
            yield EffectRow(group.name, shares, _rest(shares), benches)


def _rest(shares: Mapping[Attribution, float]) -> float:
    """Return what probabilities leave of one."""
    return max(1.0 - sum(shares.values()), 0.0)


def _likeliest(name: str, tables: Sequence[AttributionTable]) -> dict[Attribution, float]:
    """Return the probabilities of an effect in the table in which it is likeliest."""
    each = [dict(table.of(name)) for table in tables]
    return max(each, key=lambda shares: sum(shares.values()))


def _bench_coefficients(campaign: Campaign, group: Group, estimate: BenchEstimate) -> BenchCoefficients:
    since = campaign.by_date[estimate.since].date if estimate.since else None
    values = _estimates(group, estimate.mean, estimate.covariance)
    covariance = tuple(tuple(row) for row in (estimate.covariance * group.sigma**2).tolist())
    return BenchCoefficients(campaign.benches[estimate.bench], since, values, covariance)


def _estimates(group: Group, mean: Floats, covariance: Floats) -> tuple[PooledEstimate, ...]:
    """Return coefficients in SI."""
    effect, estimates = described(group.name), list[PooledEstimate]()
    units = {each.symbol: each.unit for each in effect.coefficients} if effect is not None else {}
    sigmas = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    for symbol, value, sigma in zip(group.symbols, mean.tolist(), sigmas, strict=True):
        seen = (value * group.sigma, sigma * group.sigma) if sigma < 0.1 * FLAT else (None, None)
        estimates.append(PooledEstimate(symbol, *seen, units.get(symbol, "")))
    return tuple(estimates)


@dataclass(frozen=True)
class Gap:
    """The time between two runs of one bench that follow each other, and the probability that it was repaired then."""

    after: str
    before: str
    after_run: str
    before_run: str
    probability: float


@dataclass(frozen=True)
class RepairDate:
    """gaps: in the order of their probabilities, as few as hold 95 % of it together."""

    bench: str
    gaps: tuple[Gap, ...]


def repair_date(campaign: Campaign, others: PooledTerms, term: Term) -> RepairDate:
    """The date at which the coefficients of a term changed, beside the other terms."""
    assert term.repair is not None
    bench = term.repair[0]
    runs = [key for key in campaign.by_date if key.bench == campaign.benches[bench]]
    first, chances = DatedSums.of(campaign, others).dates(term.group, bench)
    if len(first) + 1 < len(runs):
        near = _near(first.tolist(), chances.tolist(), [key.rank for key in runs])
        first, chances = DatedSums.of(campaign, others, [(bench, rank) for rank in near]).dates(term.group, bench)
    places = {key.rank: k for k, key in enumerate(runs)}
    order = np.argsort(-chances)
    count = int(np.searchsorted(np.cumsum(chances[order]), _LEVEL)) + 1
    gaps = [_gap(runs, places[int(first[k])], float(chances[k])) for k in order[:count]]
    return RepairDate(campaign.benches[bench], tuple(gaps))


def _near(first: list[int], chances: list[float], ranks: list[int]) -> list[int]:
    """Return the ranks of all runs in the parts on either side of each date that is likely."""
    edges, nearby = [ranks[0], *first, ranks[-1] + 1], list[int]()
    for k, chance in enumerate(chances, start=1):
        if chance > _LIKELY:
            nearby += [rank for rank in ranks if edges[k - 1] <= rank < edges[k + 1]]
    return sorted(set(nearby))


def _gap(runs: list[RunKey], place: int, probability: float) -> Gap:
    before, after = runs[place - 1], runs[place]
    return Gap(before.date, after.date, before.run, after.run, probability)
