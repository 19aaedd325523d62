"""Effects of the catalogue compete with causes of any shape, alone and together.

Several effects can add up to something that they are not. So every explanation consists of effects
and of terms of any shape (`halbach_fe.diagnosis.flexible_causes`), and the best one is searched
for from several starts: from the effects that the catalogue alone would give, from their first, and
from none. Terms are added while the readings demand them, and effects that these make needless are
dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.diagnosis.evidence import Evidence, Marginal
from halbach_fe.diagnosis.flexible_causes import Family, Fitted, fit_family
from halbach_fe.diagnosis.model_selection import (
    DETECTION_LOG_ODDS,
    EFFECT_PRIOR_ODDS,
    INDISTINGUISHABLE_LOG_EVIDENCE,
    MAX_EFFECTS,
    Candidate,
    log_bayes_factors,
    log_evidence,
    prior_log_odds,
    with_candidates,
)

MOST_TERMS = 3
"""Largest number of families in one explanation."""

MANY = 3
"""Number of effects from which one unlisted cause is reported if it explains the readings as well:
so many effects seldom come together."""

FITS = 1.2
"""Chi-squared per reading up to which terms alone are a full explanation, so that no other has to
be looked for."""

LARGE_SIZE = 30.0
"""Rms size, in units of the noise, of causes of any shape that shall leave nothing to an effect but
what is its own."""


@dataclass(frozen=True)
class Term:
    """A family in an explanation.

    Attributes
    ----------
    family : Family
    fitted : Fitted
    columns : ndarray of int, shape (k,)
        Numbers of its terms among those of all families.
    deviations : ndarray, shape (k,)
        Standard deviations of the amplitudes of these terms.
    """

    family: Family
    fitted: Fitted
    columns: Ints
    deviations: Floats


@dataclass(frozen=True)
class Explanation:
    """Effects and terms of any shape that explain the readings together.

    Attributes
    ----------
    effects : tuple of int
        Numbers of the candidates.
    terms : tuple of Term
    log_odds : float
        Log posterior odds over that nothing is missing.
    chi2 : float
        Chi-squared per training reading that remains.
    """

    effects: tuple[int, ...]
    terms: tuple[Term, ...]
    log_odds: float
    chi2: float


class Competition:
    """The comparison of explanations for one set of readings.

    Parameters
    ----------
    marginal : Marginal
        The readings with the blocks integrated out.
    columns : ndarray, shape (rows, k)
        Whitened signatures of all candidates.
    residual : ndarray, shape (rows,)
    candidates : sequence of Candidate
    families : sequence of Family
    whiten : callable
        Function of the changes (k, n, 3) in T of a map that returns whitened readings (rows, k).
    """

    def __init__(
        self, marginal: Marginal, columns: Floats, residual: Floats,
        candidates: Sequence[Candidate], families: Sequence[Family],
        whiten: Callable[[Floats], Floats],
    ) -> None:
        self.candidates, self.families = candidates, families
        self.prior = prior_log_odds(candidates)
        self.prior_of_family = float(np.log(EFFECT_PRIOR_ODDS / max(len(families), 1)))
        whitened = [whiten(family.fields()) for family in families]
        ends = np.cumsum([0, *(part.shape[1] for part in whitened)]).tolist()
        self._parts = [np.arange(*ends[number:number + 2]) for number in range(len(families))]
        self._columns, self._terms = columns, np.hstack(whitened)
        self._kept = marginal.remove(columns)
        self.evidence = marginal.evidence(columns, residual)
        self._evidence_of_terms = marginal.evidence(self._terms, residual)

    def _given(
        self, terms: Sequence[Term], columns: Sequence[int], family: Ints | None = None
    ) -> Evidence:
        """Return the evidence of effects' columns, and of a family's terms after them, with terms
        integrated out.
        """
        of_terms, family = self._evidence_of_terms, np.zeros(0, int) if family is None else family
        index = np.asarray(columns, int)
        added = np.concatenate([family, *(term.columns for term in terms)])
        scale = np.concatenate([np.ones(len(family)), *(term.deviations for term in terms)])
        cross = self._kept[:, index].T @ self._terms[:, added] * scale
        own = of_terms.information[np.ix_(added, added)] * scale * scale[:, None]
        evidence = replace(
            self.evidence,
            information=np.block([[self.evidence.information[np.ix_(index, index)], cross],
                                  [cross.T, own]]),
            score=np.concatenate([self.evidence.score[index], of_terms.score[added] * scale]),
            prior=np.ones(len(index) + len(added)))
        kept = len(index) + len(family)
        return evidence.given(range(kept, len(index) + len(added))).only(range(kept))

    def given(self, terms: Sequence[Term]) -> Evidence:
        """Return the evidence of all effects with terms integrated out."""
        return self._given(terms, range(len(self.evidence.score))) if terms else self.evidence

    def explanation(self, effects: Sequence[int], terms: Sequence[Term]) -> Explanation:
        """Judge effects and terms together."""
        chosen = [self.candidates[number] for number in effects]
        total = float(self.prior[list(effects)].sum()) + len(terms) * self.prior_of_family
        if terms:
            chosen_terms = np.concatenate([term.columns for term in terms])
            scale = np.concatenate([term.deviations for term in terms])
            of_terms = self._evidence_of_terms
            own = replace(
                of_terms, score=of_terms.score[chosen_terms] * scale,
                information=of_terms.information[np.ix_(chosen_terms, chosen_terms)]
                * scale * scale[:, None], prior=np.ones(len(scale)))
            total += own.fit(range(len(scale))).log_evidence
            total -= sum(term.fitted.at_best - term.fitted.log_bayes_factor for term in terms)
        evidence = self.given(terms)
        total += log_evidence(evidence, chosen)
        rest = with_candidates(evidence, chosen)
        return Explanation(tuple(effects), tuple(terms), total, rest.chi2 / rest.readings)

    def terms_beside(self, effects: Sequence[int], terms: Sequence[Term]) -> list[Term]:
        """Return all other families beside effects and terms, the likeliest first."""
        chosen = [self.candidates[number] for number in effects]
        columns = [column for candidate in chosen for column in candidate.columns]
        renumbered = [replace(candidate, columns=tuple(
            columns.index(column) for column in candidate.columns)) for candidate in chosen]
        found: list[Term] = []
        for family, part in zip(self.families, self._parts, strict=True):
            if any(term.family is family for term in terms):
                continue
            both = with_candidates(self._given(terms, columns, part), renumbered)
            fitted = fit_family(family, both.only(
                range(len(columns), len(columns) + len(part))))
            used = fitted.deviations > 0
            found.append(Term(family, fitted, part[used], fitted.deviations[used]))
        return sorted(found, key=lambda term: -term.fitted.log_bayes_factor)

    def extended(self, effects: Sequence[int]) -> Explanation:
        """Add terms while the readings demand them, and drop effects that these make needless."""
        kept = list(effects)
        terms: list[Term] = []
        while len(terms) < MOST_TERMS:
            term = self.terms_beside(kept, terms)[0]
            if term.fitted.log_bayes_factor + self.prior_of_family < DETECTION_LOG_ODDS:
                break
            terms.append(term)
            kept = self.needed(kept, terms)
        return self.explanation(kept, terms)

    def tempered(self, effects: Sequence[int], terms: Sequence[Term]) -> Evidence:
        """Return the evidence of the effects beside terms, by the scatter that all of them leave.

        What terms of a limited fineness leave is no longer noise of the stated size.
        """
        return self._tempered(self.given(terms), effects)

    def _tempered(self, evidence: Evidence, effects: Sequence[int]) -> Evidence:
        left = with_candidates(evidence, [self.candidates[k] for k in effects])
        factor = max(1.0, left.chi2 / left.readings)
        return replace(evidence, information=evidence.information / factor,
                       score=evidence.score / factor, chi2=evidence.chi2 / factor)

    def needed(self, effects: Sequence[int], terms: Sequence[Term]) -> list[int]:
        """Drop effects whose odds beside the others and the terms are too small."""
        return self._needed(effects, self.given(terms))

    def _needed(self, effects: Sequence[int], evidence: Evidence) -> list[int]:
        kept = list(effects)
        while kept:
            tempered = self._tempered(evidence, kept)
            odds = [float(log_bayes_factors(with_candidates(
                tempered, [self.candidates[k] for k in kept if k != number]),
                [self.candidates[number]])[0]) + self.prior[number] for number in kept]
            worst = int(np.argmin(odds))
            if odds[worst] >= DETECTION_LOG_ODDS:
                break
            del kept[worst]
        return kept

    def with_more_effects(self, start: Explanation) -> Explanation:
        """Add effects beside the terms of an explanation, one at a time."""
        kept = list(start.effects)
        while start.terms and len(kept) < MAX_EFFECTS:
            odds = log_bayes_factors(with_candidates(
                self.tempered(kept, start.terms), [self.candidates[k] for k in kept]),
                self.candidates) + self.prior
            taken = {self.candidates[k].effect for k in kept if self.candidates[k].unique}
            odds[[number for number, candidate in enumerate(self.candidates)
                  if number in kept or candidate.effect in taken]] = -np.inf
            if not len(odds):  # there was no time for any hypothesis
                break
            best = int(np.argmax(odds))
            if odds[best] < DETECTION_LOG_ODDS:
                break
            kept = self.needed([*kept, best], start.terms)
            if best not in kept:
                break
        return self.explanation(kept, start.terms)

    def necessary(self, effects: Sequence[int]) -> list[int]:
        """Return those effects that nothing of any shape could replace: all families together,
        each as large as may be.
        """
        terms = []
        for family, part in zip(self.families, self._parts, strict=True):
            deviations = LARGE_SIZE * family.spectra[-2]
            terms.append(Term(family, Fitted(0.0, 0.0, (), False, deviations, deviations), part,
                              deviations))
        return self._needed(effects, self.given(terms))

    def best_explanations(
        self, catalogued: Sequence[int], scattered: bool = False
    ) -> tuple[Explanation, Explanation]:
        """Return the best explanation, with such effects only as may be named, and the best one
        without any effect.

        Parameters
        ----------
        catalogued : sequence of int
            The effects that are the best explanation by the catalogue alone, the first found first.
        scattered : bool
            Whether these are sources at so many places that they could make up any field, and so
            name nothing.
        """
        by_catalogue = self.explanation(catalogued, ())
        without = self.extended(())
        beside = self.with_more_effects(without)
        if beside == without and without.chi2 < FITS and (
                without.log_odds > by_catalogue.log_odds + DETECTION_LOG_ODDS):
            return without, without
        found = [without, beside]
        for start in dict.fromkeys((tuple(catalogued), tuple(catalogued[:1]))):
            if start:
                extended = self.extended(start)
                found += [extended, self.with_more_effects(extended)]
        best = max((by_catalogue, *found), key=lambda one: one.log_odds)
        if not best.terms:
            tie = without.log_odds > best.log_odds - INDISTINGUISHABLE_LOG_EVIDENCE
            instead = scattered or (tie and len(best.effects) >= MANY)
            return without if instead and without.terms else by_catalogue, without
        if not best.effects:
            return best, without
        by_terms = best.log_odds - self.explanation(best.effects, ()).log_odds
        kept: list[int] = []
        doubtful: list[int] = []
        for number in best.effects:
            others = [other for other in best.effects if other != number]
            rest = self.extended(others) if others else without
            (kept if best.log_odds - rest.log_odds > by_terms else doubtful).append(number)
        kept += [number for number in self.necessary(best.effects) if number in doubtful]
        if not kept:
            return without, without
        return best if len(kept) == len(best.effects) else self.extended(kept), without
