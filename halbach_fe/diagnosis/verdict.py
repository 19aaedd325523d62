"""The verdict: which effects are named, which are suspected, and whether a cause is unknown.

Effects are selected by their odds (`halbach_fe.diagnosis.effect_selection`: the thresholds, and
when the amplitude that gives an effect its name is determined). They then compete with causes of
any shape (`halbach_fe.diagnosis.competing_causes`). Effects of the best explanation are named. What
wins beside them, or in their place, is described: what it acts on, along which coordinate it
varies, and how large it is.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg as linalg
from pydantic import ValidationError
from scipy.sparse.csgraph import connected_components
from scipy.special import logsumexp

from halbach_fe.core.arrays import Floats, radii_of
from halbach_fe.core.errors import HalbachError
from halbach_fe.diagnosis.competing_causes import Competition, Explanation, Term
from halbach_fe.diagnosis.effect_comparison import SHOWN_PROBABILITY, Search, amplitudes, possible
from halbach_fe.diagnosis.effect_selection import (
    DETECTION_LOG_ODDS,
    INDISTINGUISHABLE_LOG_EVIDENCE,
    Candidate,
    SelectedEffect,
    log_bayes_factors,
    odds_beside,
    selected_effect,
    with_candidates,
    with_wide_priors,
)
from halbach_fe.diagnosis.effects.base import Hypothesis
from halbach_fe.diagnosis.flexible_causes import Family, field_family, instrument_families
from halbach_fe.diagnosis.result import (
    IdentifiedEffect,
    Imitation,
    Suspicion,
    UnknownCause,
    UnknownPart,
)
from halbach_fe.diagnosis.uncertain_effects import can_be_uncertain
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.result import InferenceResult
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

FAR_BETTER = 0.5
"""Share of the best explanation's log odds below which the catalogue's own explanation is given up
in the first round, in which the signatures of large effects are not yet exact: a shift by 2.3 mm
that is the whole cause had 0.84 in a quadrupole of 26 mm. What is kept costs a round, and is judged
anew with its exact signature."""

SUSPECTED = 0.5
"""Probability from which an effect that is not certain enough to be named is suspected."""


@dataclass(frozen=True)
class Judgement:
    """The outcome of the competition in one round."""

    competition: Competition
    catalogued: Explanation
    """The effects that the catalogue alone would give."""
    best: Explanation
    """The best explanation, with such effects only as may be named."""
    without: Explanation
    """The best explanation without any effect."""

    @property
    def is_clear(self) -> bool:
        """Whether the catalogue's effects explain far less than what is not in the catalogue."""
        return self.catalogued.log_odds < FAR_BETTER * self.best.log_odds

    @property
    def fits(self) -> bool:
        """Whether terms account for most of what the effects leave beyond the noise.

        Random errors of single positions are no function of any coordinate. Terms that account for
        most of a misfit are therefore the better explanation of it than vibration.
        """
        if not self.best.terms:
            return False
        before = self.competition.explanation(self.best.effects, ()).chi2
        # share of the excess of chi-squared that terms may leave if they account for most of it. Of
        # independent errors at hundreds of points they account for a fifth, as they have
        # `MOST_WAVES` functions for each component.
        most = 0.5
        return self.best.chi2 - 1 < most * (before - 1)

    def whitened_terms(self) -> list[Floats]:
        """Return the columns (rows, k) of each term, per standard deviation of its amplitudes."""
        return [self.competition.whiten(term.family.fields()) * term.fitted.deviations
                for term in self.best.terms]


def families_of(search: Search, update: InferenceResult) -> list[Family]:
    """Return the causes of any shape that compete with the effects of a search.

    A field acts on all maps; what an instrument does, on one of them.
    """
    scene, noise = search.nominal, update.errors.sd
    found = [field_family(scene.points, float(np.median(noise)),
                          lambda fields: search.campaign.seen(update.study, fields))]
    listed = search.campaign.is_listed  # if not, another map has the same instrument
    for own in [[one] for one in scene.maps if not one.is_validation] if listed else [scene.maps]:
        rows = slice(own[0].rows.start, own[-1].rows.stop)
        families = instrument_families(
            scene.points[rows], np.concatenate([one.time for one in own]), scene.field[rows],
            scene.gradient[rows],
            float(np.median(noise[np.isin(update.maps, [one.name for one in own])])),
            all(one.timed for one in own))
        found += [family.of_map(own[0].name, rows, len(scene.points)) for family in families
                  ] if listed else families
    return found


def judge(
    search: Search, update: InferenceResult, identified: Sequence[IdentifiedEffect],
    flexible: Sequence[Family],
) -> Judgement:
    """Compare the identified effects with causes of any shape."""
    rows = np.flatnonzero(~update.held_out)
    noise, observation = update.errors.subset(rows), update.observation

    def whiten(fields: Floats) -> Floats:
        return noise.whiten(np.ascontiguousarray(observation.read(fields)[:, rows].T))

    competition = Competition(search.marginal, search.columns, search.absorbed, search.residual,
                              search.evidence, search.candidates, flexible, whiten, search.excluded)
    numbers = [search.hypotheses.index(effect.hypothesis) for effect in identified]
    sources = {number: effect.hypothesis.place.at_m
               for number, effect in zip(numbers, identified, strict=True)
               if effect.hypothesis.effect.name == "ferromagnetic_object"}
    best, without = competition.best_explanations(
        numbers, list(sources) if are_scattered(list(sources.values())) else ())
    return Judgement(competition, competition.explanation(numbers, ()), best, without)


def are_scattered(places: Sequence[tuple[float, ...]]) -> bool:
    """Tell whether many sources are in several places, rather than beside one between them."""
    # Distance, relative to that from the axis, within which two magnetized objects may stand for
    # one between them: the places that are compared are 30 degrees apart, which is 0.52.
    near_sources = 0.6
    # number of sources from which they may stand for a field of any shape
    many = 3
    if len(places) < many:
        return False
    points = np.array(places)
    radius = radii_of(points)
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    near = apart < near_sources * np.maximum(radius[:, None], radius)
    return bool(connected_components(near)[0] > 1)


def named_effects(
    corrected: Study, search: Search, judgement: Judgement,
    identified: Sequence[IdentifiedEffect],
) -> tuple[IdentifiedEffect, ...]:
    """Return the effects of the best explanation, with their amplitudes beside its terms."""
    best, competition = judgement.best, judgement.competition
    if best == judgement.catalogued:
        return tuple(identified)
    evidence = competition.evidence_beside(best.terms)
    selected = [selected_effect(evidence, search.candidates, best.effects, number,
                                competition.prior, ()) for number in best.effects]
    found = amplitudes(replace(search, evidence=evidence), selected)
    while found and not possible(corrected, found, search.campaign):
        found = found[:-1]
    return found


def describe_unknown(
    judgement: Judgement, update: InferenceResult, search: Search,
    identified: Sequence[IdentifiedEffect],
) -> UnknownCause | None:
    """Describe what is not in the catalogue; None if nothing is missing but the effects."""
    competition, best = judgement.competition, judgement.best
    tie = judgement.without.log_odds - best.log_odds
    ambiguous = bool(not best.terms and len(best.effects) > 1 and judgement.without.terms
                     and tie > -INDISTINGUISHABLE_LOG_EVIDENCE)
    if not (best.terms or ambiguous):
        return None
    shown = judgement.without if ambiguous else best
    alone = competition.explanation(shown.effects, ())
    factor = (shown.log_odds - alone.log_odds
              - len(shown.terms) * competition.prior_of_family)
    if not ambiguous and _over_larger_noise(
            factor, alone.chi2, shown.chi2, competition.evidence.readings) < DETECTION_LOG_ODDS:
        return None
    first = competition.terms_beside(shown.effects, ())
    factors = {kind: max(term.fitted.log_bayes_factor for term in first
                         if (term.family.acts_on == "field") == (kind == "field"))
               for kind in ("field", "instrument")}
    points = search.nominal.points
    parts, total = [], np.zeros(points.shape)
    for number, term in enumerate(shown.terms):
        field = np.tensordot(term.fitted.mean, term.family.fields(), 1)
        total += field
        rivals = [] if number else [
            one for one in first if one.family is not term.family and one.fitted.log_bayes_factor
            > first[0].fitted.log_bayes_factor - INDISTINGUISHABLE_LOG_EVIDENCE]
        parts.append(_part(term, field, rivals))
    size = np.linalg.norm(total, axis=1)
    source = None
    if shown.terms[0].family.acts_on == "field":
        given = with_candidates(search.evidence, [search.candidates[k] for k in shown.effects])
        odds = log_bayes_factors(given, search.candidates)
        dipoles = [number for number, hypothesis in enumerate(search.hypotheses)
                   if hypothesis.effect.name == "ferromagnetic_object"]
        if dipoles:
            source = search.hypotheses[max(dipoles, key=lambda k: odds[k])].place.at_m
    return UnknownCause(
        kind_of([term.family.acts_on == "field" for term in shown.terms], factors), factor,
        not identified, ambiguous, float(size.max()),
        tuple(points[int(np.argmax(size))].tolist()), source, tuple(parts))


def kind_of(
    are_fields: Sequence[bool], factors: Mapping[str, float]
) -> Literal["field", "instrument", "either"]:
    """Return what a cause of any shape is, from whether its terms are fields, the largest first.

    ``factors`` are the largest log Bayes factors of a ``field`` and of an ``instrument`` as its
    first term. A displaced probe reads a field that Maxwell's equations allow, too, as long as it
    is displaced alike on all lines: most of what a stage does looks like a field, and not all.
    """
    kind: Literal["field", "instrument"] = "field" if are_fields[0] else "instrument"
    other = factors["instrument" if kind == "field" else "field"]
    mixed = are_fields[0] and not all(are_fields)
    return "either" if mixed or factors[kind] - other < INDISTINGUISHABLE_LOG_EVIDENCE else kind


def _over_larger_noise(
    log_bayes_factor: float, before: float, after: float, readings: int
) -> float:
    """Return the log Bayes factor of terms if the size of the noise is unknown, with and without
    them.

    Noise of another size is the other explanation of a large chi-squared. With noise of the stated
    size, terms that take chi-squared per reading from ``before`` to ``after`` explain
    ``readings (before - after) / 2``, and with the likeliest size ``readings log(before / after) /
    2``. What the freedom of the terms costs remains. A chi-squared below 1 counts as 1: noise may
    be larger than it is stated, but is not smaller.
    """
    before, after = max(before, 1.0), max(after, 1.0)
    return log_bayes_factor - readings * (before - after - float(np.log(before / after))) / 2


def _part(term: Term, field: Floats, rivals: Sequence[Term]) -> UnknownPart:
    """Describe one term, whose posterior mean is ``field`` (n, 3) in T."""
    family, mean = term.family, term.fitted.mean
    field = field[family.rows]
    power = mean**2
    waves = float(np.sqrt(power @ family.waves**2 / max(power.sum(), 1e-300)))
    size = family.unit * float(np.sqrt(power.sum()))
    return UnknownPart(
        family.acts_on, family.along,
        tuple(one.family.name for one in rivals),
        tuple(COMPONENTS[axis] for axis in term.fitted.axes), term.fitted.smooth,
        float(np.sqrt(np.mean(np.sum(field**2, axis=1)))),
        float(np.linalg.norm(field, axis=1).max()), size,
        family.span / waves if waves > 0 else None, term.fitted.log_bayes_factor, family.map)


@dataclass(frozen=True)
class Further:
    """What else may be missing beside the effects of the best explanation.

    The probabilities assume that at most one more thing is missing: an effect of the catalogue, or
    a cause of any shape.
    """

    odds: Floats
    """Log posterior odds of every candidate; -inf for those that are in the explanation.
    Shape (candidates,)."""
    probabilities: Floats
    """Shape (candidates,)."""

    @classmethod
    def of(cls, judgement: Judgement) -> Further:
        """Compare all candidates beside the effects of the best explanation."""
        competition, best = judgement.competition, judgement.best
        odds = odds_beside(
            competition.evidence, competition.candidates, best.effects, competition.prior)
        others = [term.fitted.log_bayes_factor + competition.prior_of_family
                  for term in competition.terms_beside(best.effects, ())]
        return cls(odds, np.exp(odds - logsumexp([0.0, *others, *odds])))

    def by_effect(
        self, candidates: Sequence[Candidate], chosen: Collection[int] | None = None
    ) -> dict[str, float]:
        """Return the probability of every effect, the likeliest first; of some candidates only, if
        their numbers are given.
        """
        found: dict[str, float] = {}
        for number, (candidate, probability) in enumerate(zip(
                candidates, self.probabilities.tolist(), strict=True)):
            if chosen is None or number in chosen:
                found[candidate.effect] = found.get(candidate.effect, 0.0) + probability
        return dict(sorted(found.items(), key=lambda one: -one[1]))


def _together(by_name: dict[str, float]) -> dict[str, float]:
    """Return the likeliest effects that have most of the probability together."""
    # Share of the suspects' probability that those that are listed have together.
    share_of_suspects = 0.9
    most = share_of_suspects * sum(by_name.values())
    found: dict[str, float] = {}
    for name, probability in by_name.items():
        if sum(found.values()) >= most:
            break
        found[name] = probability
    return found


def suspicions(
    judgement: Judgement, further: Further, corrected: Study, search: Search
) -> tuple[Suspicion, ...]:
    """Return what is likelier than not to be missing, but not certain enough to be named.

    Effects that share a probability are one suspicion.
    """
    competition, best = judgement.competition, judgement.best
    candidates, odds = competition.candidates, further.odds
    named = _together(further.by_effect(candidates))
    probability = sum(named.values())
    if best.terms or probability < SUSPECTED:
        return ()
    likeliest = int(np.argmax(odds))
    best_of = [max((number for number, one in enumerate(candidates) if one.effect == name),
                   key=lambda number: odds[number]) for name in named]
    fitted = [_beside(judgement, further, search, number)
              for number in best_of if number not in search.rough]
    return (Suspicion(
        tuple(named), probability, search.hypotheses[likeliest], tuple(named.values()),
        float(odds[likeliest] - competition.prior[likeliest]),
        _why_not_named(judgement, corrected, search, likeliest, probability),
        tuple(one[-1] for one in fitted if possible(corrected, one, search.campaign))),)


def imitated(
    judgement: Judgement, further: Further, update: InferenceResult, search: Search,
    suspected: Sequence[Suspicion] = ()
) -> Imitation | None:
    """Return what may be missing that blocks imitate, so that an update is less sure than its bars.

    What is suspected is in the study already. Of the rest, everything that would make an update
    wrong by itself and can be an uncertain number is returned, and as much as leaves less than
    `least_chi2` of what is expected, weighed with its probability.
    """
    # Expected chi-squared per parameter of an update's blocks, beyond that of their error bars,
    # from which what they imitate has to be in the model: the mean is to be below 1.2.
    least_chi2 = 0.2
    # The same if an effect is there, from which it has to be in the model however improbable it
    # is: chi-squared is to be below 2 whichever of the effects is missing.
    wrong_chi2 = 0.8
    candidates, best = search.candidates, judgement.best
    if best.terms:
        return None
    beside = with_candidates(search.evidence, [candidates[k] for k in best.effects])
    errors = _ErrorsOfUpdate(update, search)
    expected, if_there = dict[int, float](), dict[int, float]()
    known = {name for suspicion in suspected for name in suspicion.effects}
    for number in np.flatnonzero(further.probabilities > SHOWN_PROBABILITY).tolist():
        candidate = candidates[number]
        if number in search.rough or candidate.is_binary or candidate.effect in known:
            continue
        off = errors.of(number)
        if off is None:
            continue
        fit = with_wide_priors(beside, [candidate]).fit(candidate.free)
        if_there[number] = float(np.sum((off @ fit.mean)**2) + np.sum(
            (off @ fit.covariance) * off)) / len(update.magnet.parameter_names)
        expected[number] = float(further.probabilities[number]) * if_there[number]
    wrong = {number for number, chi2 in if_there.items()
             if chi2 >= wrong_chi2 and can_be_uncertain(
                 update.study, _beside(judgement, further, search, number)[-1])}
    rest, chosen, placed = sum(expected.values()), [], set[str]()
    for number in sorted(expected, key=lambda each: (each not in wrong, -expected[each])):
        if candidates[number].effect in placed:  # its place is fitted
            rest -= expected[number]
        elif number in wrong or rest >= least_chi2:
            chosen.append(number)
            rest -= expected[number]
            if search.hypotheses[number].effect.refinements:
                placed.add(candidates[number].effect)
    if not chosen:
        return None
    named = further.by_effect(candidates, chosen)
    return Imitation(sum(named.values()), tuple(named), tuple(named.values()), tuple(
        _beside(judgement, further, search, number)[-1] for number in chosen))


class _ErrorsOfUpdate:
    """How far the blocks of an update are off if an effect is missing from its study.

    An effect that changes the readings by J theta changes the posterior mean of the magnetizations
    by ``C_0 H' S^-1 J theta``. What it changes of the magnetizations themselves is no error.
    """

    def __init__(self, update: InferenceResult, search: Search) -> None:
        # number of parameters whose covariance is factorized in a second or two; of more, effects
        # that change magnetizations are left out
        most_parameters = 3000
        rounding = 1e-12  # of the largest variance; missing blocks have none
        self.study, self.search = update.study, search
        self.before = build_magnet(update.study).nominal_magnetization
        self.factor: Floats | None = None
        if len(self.before) > most_parameters:
            return
        rows, count = np.flatnonzero(~update.held_out), len(self.before)
        variance = update.posterior.covariance[:count, :count]  # uncertain amplitudes come after
        self.response = update.errors.subset(rows).whiten(update.response.matrix[rows])
        self.prior = np.asarray(update.prior.root)
        self.factor = linalg.cholesky(
            variance + rounding * np.diag(variance).max() * np.eye(count), lower=True)

    def of(self, number: int) -> Floats | None:
        """Return the errors (n, k) of the parameters, rotated and in posterior standard deviations,
        per amplitude of a candidate; None if they are not known.
        """
        free = list(self.search.candidates[number].free)
        change = self._change(self.search.hypotheses[number])
        if change is None or (self.factor is None and change.any()):
            return None
        if self.factor is None:
            return self.search.absorbed[:, free]
        off = self.prior[:len(self.before)] @ (self.prior.T @ (
            self.response.T @ self.search.marginal.remove(self.search.columns[:, free])))
        own = change[:, :len(free)]  # the refinements, which are places, change none
        off[:, :own.shape[1]] -= own
        return np.asarray(linalg.solve_triangular(self.factor, off, lower=True))

    def _change(self, hypothesis: Hypothesis) -> Floats | None:
        """Return by how much an effect changes the nominal magnetizations (m, k), in A/m per prior
        standard deviation of its k parameters; None if the magnet has other blocks with it.
        """
        effect, step = hypothesis.effect, 0.1
        found = np.zeros((len(self.before), len(effect.parameters)))
        if effect.kind == "instrument":
            return found
        for which, parameter in enumerate(effect.parameters):
            values = step * parameter.sd * np.eye(len(effect.parameters))[which]
            try:
                changed = build_magnet(
                    hypothesis.apply(self.study, values.tolist())).nominal_magnetization
            except (HalbachError, ValidationError):
                return None
            if len(changed) != len(self.before):
                return None
            found[:, which] = (changed - self.before) / step
        return found


def _beside(
    judgement: Judgement, further: Further, search: Search, number: int
) -> tuple[IdentifiedEffect, ...]:
    """Return the effects of the best explanation, and one more candidate, with their amplitudes."""
    candidates, odds = search.candidates, further.odds[number]
    return amplitudes(search, [
        *(SelectedEffect(candidates[own], 0.0, 0.0, ()) for own in judgement.best.effects),
        SelectedEffect(candidates[number], float(odds - judgement.competition.prior[number]),
                       float(odds), ())])


def _why_not_named(
    judgement: Judgement, corrected: Study, search: Search, likeliest: int, probability: float
) -> Literal["odds", "which", "impossible", "roughly", "dropped"]:
    """Return why the likeliest candidate beside the named effects is only suspected."""
    competition, effects = judgement.competition, judgement.best.effects
    own = selected_effect(competition.evidence, competition.candidates, (*effects, likeliest),
                          likeliest, competition.prior, ())
    if own.log_odds < DETECTION_LOG_ODDS:
        certain = probability > (1 - probability) * np.exp(DETECTION_LOG_ODDS)
        return "which" if certain else "odds"
    if likeliest in search.rough:
        return "roughly"
    found = amplitudes(replace(search, evidence=competition.evidence), [own])
    return "dropped" if possible(corrected, found, search.campaign) else "impossible"
