"""Effects of the catalogue compete with causes of any shape, alone and together.

Several effects can add up to something that they are not. So every explanation consists of effects
and of terms of any shape (`halbach_fe.diagnosis.flexible_causes`), and the best one is searched
for from several starts: from the effects that the catalogue alone would give, from their first, and
from none. Terms are added while the readings demand them, and effects that these make needless are
dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.diagnosis.effect_selection import (
    DETECTION_LOG_ODDS,
    EFFECT_PRIOR_ODDS,
    INDISTINGUISHABLE_LOG_EVIDENCE,
    MAX_EFFECTS,
    Candidate,
    log_evidence,
    odds_beside,
    prior_log_odds,
    tempered,
    with_candidates,
    without_needless,
)
from halbach_fe.diagnosis.flexible_causes import Family, Fitted, fit_family, largest_factor
from halbach_fe.diagnosis.marginal_evidence import Evidence, Marginal


@dataclass(frozen=True, eq=False)
class Term:
    """A family in an explanation."""

    family: Family
    fitted: Fitted
    columns: Ints
    """Numbers of its terms among those of all families. Shape (k,)."""
    deviations: Floats
    """Standard deviations of the amplitudes of these terms. Shape (k,)."""


@dataclass(frozen=True)
class Explanation:
    """Effects and terms of any shape that explain the readings together."""

    effects: tuple[int, ...]
    """Numbers of the candidates."""
    terms: tuple[Term, ...]
    log_odds: float
    """Log posterior odds over that nothing is missing."""
    chi2: float
    """Chi-squared per training reading that remains."""


class Competition:
    """The comparison of explanations for one set of readings.

    Parameters
    ----------
    marginal : Marginal
        The readings with the blocks integrated out.
    columns : ndarray, shape (rows, k)
        Whitened signatures of all candidates.
    absorbed : ndarray, shape (m, k + 1)
        `Marginal.absorbed` of these and of the residual.
    residual : ndarray, shape (rows,)
    evidence : Evidence
        Of these columns for this residual.
    candidates : sequence of Candidate
    families : sequence of Family
    whiten : callable
        Function of the changes (k, n, 3) in T of a map that returns whitened readings (rows, k).
    excluded : collection of int
        Numbers of candidates that are not added to an explanation.
    """

    def __init__(
        self, marginal: Marginal, columns: Floats, absorbed: Floats, residual: Floats,
        evidence: Evidence, candidates: Sequence[Candidate], families: Sequence[Family],
        whiten: Callable[[Floats], Floats], excluded: Collection[int] = (),
    ) -> None:
        self.candidates, self.families, self.evidence = candidates, families, evidence
        self.excluded, self.whiten = frozenset(excluded), whiten
        self.prior = prior_log_odds(candidates)
        self.prior_of_family = float(np.log(EFFECT_PRIOR_ODDS / max(len(families), 1)))
        ends = np.cumsum([0, *(len(family.axis) for family in families)]).tolist()
        self._parts = [np.arange(*ends[number:number + 2]) for number in range(len(families))]
        # one by one: of 8 892 points all of them have 0.6 GiB
        self._terms, self._columns = np.empty((len(residual), ends[-1])), columns
        for family, first in zip(families, ends, strict=False):
            self._terms[:, first:first + len(family.axis)] = whiten(family.fields())
        self._absorbed_terms = marginal.absorbed(self._terms)
        self._absorbed_columns = absorbed[:, :-1]
        self._score = self._terms.T @ residual - self._absorbed_terms.T @ absorbed[:, -1]
        # information between two families, of a column with all terms, of a term with all columns
        self._products: dict[tuple[int, int], Floats] = {}
        self._by_column: dict[int, Floats] = {}
        self._by_term: dict[int, Floats] = {}
        self._extensions: dict[tuple[int, ...], Explanation] = {}
        # the terms that were integrated out last, and what this came to
        self._last: tuple[tuple[Term, ...], tuple[Ints, Floats, Floats]] | None = None

    def _of_terms(self, rows: Ints, columns: Ints) -> Floats:
        """Return the information between some terms of any shape and others."""
        found = np.empty((len(rows), len(columns)))
        lasts = [part[-1] for part in self._parts]
        families = [np.searchsorted(lasts, numbers) for numbers in (rows, columns)]
        for one in np.unique(families[0]).tolist():
            for other in np.unique(families[1]).tolist():
                here, there = np.flatnonzero(families[0] == one), np.flatnonzero(
                    families[1] == other)
                found[np.ix_(here, there)] = self._product(one, other)[np.ix_(
                    rows[here] - self._parts[one][0], columns[there] - self._parts[other][0])]
        return found

    def _product(self, one: int, other: int) -> Floats:
        """Return the information between the terms of two families."""
        if one > other:
            return self._product(other, one).T
        if (one, other) not in self._products:
            a, b = self._parts[one], self._parts[other]
            self._products[one, other] = (
                self._terms[:, a].T @ self._terms[:, b]
                - self._absorbed_terms[:, a].T @ self._absorbed_terms[:, b])
        return self._products[one, other]

    def _cross(self, rows: Ints, columns: Ints) -> Floats:
        """Return the information between some terms of any shape and some effects' columns."""
        found = np.empty((len(rows), len(columns)))
        for number, column in enumerate(columns.tolist()):
            if column not in self._by_column:
                self._by_column[column] = (
                    self._terms.T @ self._columns[:, column]
                    - self._absorbed_terms.T @ self._absorbed_columns[:, column])
            found[:, number] = self._by_column[column][rows]
        return found

    def _cross_of_all(self, rows: Ints) -> Floats:
        """Return the information between some terms and the columns of all effects."""
        missing = np.array([row for row in rows.tolist() if row not in self._by_term], int)
        if len(missing):
            found = (self._terms[:, missing].T @ self._columns
                     - self._absorbed_terms[:, missing].T @ self._absorbed_columns)
            self._by_term |= dict(zip(missing.tolist(), found, strict=True))
        return np.array([self._by_term[row] for row in rows.tolist()])

    def _integrated(self, terms: Sequence[Term]) -> tuple[Ints, Floats, Floats]:
        """Return the columns (d,) of terms, the prior standard deviations of their amplitudes, and
        the Cholesky factor (d, d) of the precision of these amplitudes, whose unit is the latter.
        """
        key = tuple(terms)
        if self._last is None or self._last[0] != key:
            rows = np.concatenate([term.columns for term in terms])
            scale = np.concatenate([term.deviations for term in terms])
            precision = self._of_terms(rows, rows) * scale * scale[:, None] + np.eye(len(rows))
            self._last = key, (rows, scale, linalg.cholesky(precision, lower=True))
        return self._last[1]

    def evidence_beside(self, terms: Sequence[Term]) -> Evidence:
        """Return the evidence of all effects with terms integrated out."""
        if not terms:
            return self.evidence
        rows, scale, root = self._integrated(terms)
        return self.evidence.beside(root, self._cross_of_all(rows) * scale[:, None],
                                    self._score[rows] * scale)

    def _joint_evidence(
        self, terms: Sequence[Term], columns: Sequence[int], family: Ints | None = None
    ) -> Evidence:
        """Return the evidence of effects' columns, and of a family's terms after them, with terms
        integrated out.
        """
        family = np.zeros(0, int) if family is None else family
        index = np.asarray(columns, int)
        cross = self._cross(family, index)
        evidence = Evidence.of(
            np.block([[self.evidence.part(index), cross.T],
                      [cross, self._of_terms(family, family)]]),
            np.concatenate([self.evidence.score[index], self._score[family]]),
            self.evidence.chi2, self.evidence.readings)
        if not terms:
            return evidence
        rows, scale, root = self._integrated(terms)
        beside = np.hstack([self._cross(rows, index), self._of_terms(rows, family)])
        return evidence.beside(root, beside * scale[:, None], self._score[rows] * scale).only(
            range(len(index) + len(family)))

    def _evidence_of(
        self, effects: Sequence[int], terms: Sequence[Term]
    ) -> tuple[Evidence, list[Candidate]]:
        """Return the evidence of some effects only beside terms, and these effects as its
        candidates.
        """
        columns, chosen = self._renumbered(effects)
        return self._joint_evidence(terms, columns), chosen

    def _renumbered(self, effects: Sequence[int]) -> tuple[list[int], list[Candidate]]:
        """Return the columns of some effects, and the effects with their numbers among these."""
        chosen = [self.candidates[number] for number in effects]
        columns = [column for candidate in chosen for column in candidate.columns]
        return columns, [replace(candidate, columns=tuple(
            columns.index(column) for column in candidate.columns)) for candidate in chosen]

    def explanation(self, effects: Sequence[int], terms: Sequence[Term]) -> Explanation:
        """Judge effects and terms together."""
        total = float(self.prior[list(effects)].sum()) + len(terms) * self.prior_of_family
        if terms:
            own = self._joint_evidence((), (), np.concatenate([term.columns for term in terms]))
            scale = np.concatenate([term.deviations for term in terms])
            own = replace(own, score=own.score * scale,
                          information=own.information * scale * scale[:, None])
            total += own.fit(range(len(scale))).log_evidence
            total -= sum(term.fitted.at_best - term.fitted.log_bayes_factor for term in terms)
        evidence, chosen = self._evidence_of(effects, terms)
        total += log_evidence(evidence, chosen)
        rest = with_candidates(evidence, chosen)
        return Explanation(tuple(effects), tuple(terms), total, rest.chi2 / rest.readings)

    def terms_beside(self, effects: Sequence[int], terms: Sequence[Term]) -> list[Term]:
        """Return all other families beside effects and terms, the likeliest first."""
        found = [self._term(number, evidence)
                 for number, evidence in self._families_beside(effects, terms)]
        return sorted(found, key=lambda term: -term.fitted.log_bayes_factor)

    def likeliest_term(self, effects: Sequence[int], terms: Sequence[Term]) -> Term | None:
        """Return the likeliest other family beside effects and terms; None if the readings do not
        demand any.

        Families that cannot be likelier are not fitted.
        """
        least, best = DETECTION_LOG_ODDS - self.prior_of_family, None
        bounded = [(largest_factor(self.families[number], evidence), number, evidence)
                   for number, evidence in self._families_beside(effects, terms)]
        for bound, number, evidence in sorted(bounded, key=lambda each: -each[0]):
            if bound < least:
                break
            term = self._term(number, evidence)
            if term.fitted.log_bayes_factor >= least:
                least, best = term.fitted.log_bayes_factor, term
        return best

    def _families_beside(
        self, effects: Sequence[int], terms: Sequence[Term]
    ) -> Iterator[tuple[int, Evidence]]:
        """Yield the number of every other family, and its evidence beside effects and terms."""
        columns, renumbered = self._renumbered(effects)
        for number, (family, part) in enumerate(zip(self.families, self._parts, strict=True)):
            if not any(term.family is family for term in terms):
                both = with_candidates(self._joint_evidence(terms, columns, part), renumbered)
                yield number, both.only(range(len(columns), len(columns) + len(part)))

    def _term(self, number: int, evidence: Evidence) -> Term:
        """Return a family at its likeliest form."""
        family, part = self.families[number], self._parts[number]
        fitted = fit_family(family, evidence)
        used = fitted.deviations > 0
        return Term(family, fitted, part[used], fitted.deviations[used])

    def extension(self, effects: Sequence[int]) -> Explanation:
        """Add terms while the readings demand them, and drop effects that these make needless."""
        most_terms = 3  # largest number of families in one explanation
        key = tuple(effects)
        if key not in self._extensions:
            kept, terms = list(effects), list[Term]()
            while len(terms) < most_terms and (term := self.likeliest_term(kept, terms)):
                terms.append(term)
                kept = self.detected_effects(kept, terms)
            self._extensions[key] = self.explanation(kept, terms)
        return self._extensions[key]

    def detected_effects(self, effects: Sequence[int], terms: Sequence[Term]) -> list[int]:
        """Drop effects whose odds beside the others and the terms are too small."""
        evidence, candidates = self._evidence_of(effects, terms)
        kept = without_needless(evidence, candidates, range(len(effects)),
                                self.prior[list(effects)], by_scatter=True)
        return [effects[number] for number in kept]

    def with_more_effects(self, start: Explanation) -> Explanation:
        """Add effects beside the terms of an explanation, one at a time."""
        kept, evidence = list(start.effects), self.evidence_beside(start.terms)
        while start.terms and len(kept) < MAX_EFFECTS:
            odds = odds_beside(
                tempered(evidence, [self.candidates[k] for k in kept]), self.candidates, kept,
                self.prior, self.excluded)
            if not len(odds):  # there was no time for any hypothesis
                break
            best = int(np.argmax(odds))
            if odds[best] < DETECTION_LOG_ODDS:
                break
            kept = self.detected_effects([*kept, best], start.terms)
            if best not in kept:
                break
        return self.explanation(kept, start.terms)

    def irreplaceable_effects(self, effects: Sequence[int]) -> list[int]:
        """Return those effects that nothing of any shape could replace: all families together,
        each as large as may be.
        """
        # Rms size, in units of the noise, of causes of any shape that shall leave nothing to an
        # effect but what is its own.
        large_size = 30.0
        terms = []
        for family, part in zip(self.families, self._parts, strict=True):
            deviations = large_size * family.spectra[-2]
            terms.append(Term(family, Fitted(0.0, 0.0, (), False, deviations, deviations), part,
                              deviations))
        return self.detected_effects(effects, terms)

    def best_explanations(
        self, catalogued: Sequence[int], scattered: Collection[int] = ()
    ) -> tuple[Explanation, Explanation]:
        """Return the best explanation, with such effects only as may be named, and the best one
        without any effect.

        Parameters
        ----------
        catalogued : sequence of int
            The effects that are the best explanation by the catalogue alone, the first found first.
        scattered : collection of int
            Those of them that are sources at so many places that they could make up any field, and
            so name nothing. They are left to terms; the other effects are judged beside these.
        """
        # Chi-squared per reading up to which terms alone are a full explanation, so that no other
        # has to be looked for.
        fits = 1.2
        # Number of effects from which one unlisted cause is reported if it explains the readings as
        # well: effects seldom come together.
        several = 2
        by_catalogue = self.explanation(catalogued, ())
        without = self.extension(())
        beside = self.with_more_effects(without)
        if beside == without and without.chi2 < fits and (
                without.log_odds > by_catalogue.log_odds + DETECTION_LOG_ODDS):
            return without, without
        found = [without, beside]
        for start in dict.fromkeys((tuple(catalogued), tuple(catalogued[:1]))):
            if start:
                extended = self.extension(start)
                found += [extended, self.with_more_effects(extended)]
        best = max((by_catalogue, *found), key=lambda one: one.log_odds)
        if not best.terms and set(scattered) & set(best.effects):
            others = [number for number in best.effects if number not in scattered]
            best = self.extension(others) if others else without
        if not best.terms:
            tie = without.log_odds > best.log_odds - INDISTINGUISHABLE_LOG_EVIDENCE
            instead = tie and len(best.effects) >= several
            return without if instead and without.terms else by_catalogue, without
        if not best.effects:
            return best, without
        by_terms = best.log_odds - self.explanation(best.effects, ()).log_odds
        kept: list[int] = []
        doubtful: list[int] = []
        for number in best.effects:
            others = [other for other in best.effects if other != number]
            rest = self.extension(others) if others else without
            (kept if best.log_odds - rest.log_odds > by_terms else doubtful).append(number)
        kept += [number for number in self.irreplaceable_effects(best.effects)
                 if number in doubtful]
        if not kept:
            return without, without
        return best if len(kept) == len(best.effects) else self.extension(kept), without
