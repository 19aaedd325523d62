"""Scores of all effects of the catalogue at one point of linearization, and which are missing."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from pydantic import ValidationError

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachError, HalbachWarning
from halbach_fe.core.progress import Progress, quiet
from halbach_fe.diagnosis.effect_selection import (
    DETECTION_LOG_ODDS,
    PINNED_SD,
    Candidate,
    SelectedEffect,
    is_noticeable,
    log_evidence,
    most_likely,
    near_the_likeliest,
    prior_log_odds,
    renumbered,
    select_effects,
    with_wide_priors,
)
from halbach_fe.diagnosis.effects.base import Effect, Hypothesis, Place
from halbach_fe.diagnosis.linearization import Linearization, amplitude_scale, apply_effects
from halbach_fe.diagnosis.marginal_evidence import Evidence, Marginal
from halbach_fe.diagnosis.result import IdentifiedEffect
from halbach_fe.diagnosis.scanned_maps import Campaign, Scene
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.study.model import Study

SHOWN_PROBABILITY = 1e-3
"""Probability of a candidate below which it is not asked what would be otherwise with it."""


@dataclass(frozen=True)
class Search:
    """The comparison of all hypotheses at one point of linearization."""

    hypotheses: tuple[Hypothesis, ...]
    candidates: tuple[Candidate, ...]
    """The same hypotheses, with the numbers of their columns."""
    evidence: Evidence
    """Evidence of all columns."""
    columns: Floats
    """Whitened signatures of all hypotheses, per prior standard deviation of their amplitudes;
    rough ones, see `Effect.rough_signature`, may have any size. Shape (rows, k)."""
    absorbed: Floats
    """`Marginal.absorbed` of the columns and the residual. Shape (m, k + 1)."""
    residual: Floats
    """Whitened residual of the training readings from the prior mean of the study without the
    identified effects; the columns are fitted to it. Shape (rows,)."""
    marginal: Marginal
    """The readings with blocks and solver error integrated out."""
    training: Floats
    """Whitened residual of the training readings with the identified effects in the model.
    Shape (rows,)."""
    campaign: Campaign
    nominal: Scene
    """Of the study from which the search started."""
    uncompared: int = 0
    """Number of hypotheses for which there was no time."""
    rough: frozenset[int] = frozenset()
    """Numbers of the hypotheses with rough signatures. They explain too little to be solved for,
    and cannot be selected."""
    given_up: frozenset[int] = frozenset()
    """Numbers of hypotheses that cannot be selected as the search dropped them in their own
    model."""

    @property
    def excluded(self) -> frozenset[int]:
        """Numbers of the hypotheses that cannot be selected."""
        return self.rough | self.given_up

    def without(self, effects: Collection[str]) -> Search:
        """Return the search that cannot select some effects, by name."""
        return replace(self, given_up=frozenset(
            number for number, one in enumerate(self.candidates) if one.effect in effects))


@dataclass(frozen=True)
class _Competitor:
    """A hypothesis in the comparison.

    The columns (rows, k) are its whitened signature per prior standard deviation. A rough one may
    have any size.
    """

    hypothesis: Hypothesis
    candidate: Candidate
    columns: Floats
    in_model: bool
    is_rough: bool

    @property
    def can_improve(self) -> bool:
        """Whether its place is one of a grid, between whose points there are better ones."""
        effect = self.hypothesis.effect
        return not self.in_model and bool(effect.refinements) and not effect.applied_in_full


class _Comparison:
    """The competitors at one point of linearization, as long as there is time."""

    def __init__(
        self, point: Linearization, effects: Sequence[Effect], progress: Progress,
        is_over: Callable[[], bool],
    ) -> None:
        self.point, self.progress, self.is_over = point, progress, is_over
        self.places = point.places(effects)
        self.hypotheses = [Hypothesis(effect, place) for effect in effects
                           for place in self.places[effect.name]]
        self.marginal, self.residual = point.training.marginal, point.training.residual
        self.competitors: list[_Competitor] = []
        self.uncompared = self._done = 0

    def compare_all(self) -> None:
        """Compare the representatives of every effect, and then other places of noticed ones.

        What is in the model or known already is compared in any case.
        """
        first = {(effect.name, place) for effect in {one.effect for one in self.hypotheses}
                 for place in effect.representatives(self.places[effect.name])}
        first |= {*self.point.in_model, *self.point.signatures}
        # what has to be solved is compared after all else, in case there is no time
        at_once = [one for one in self.hypotheses if one.key in first]
        for hypothesis in sorted(at_once, key=lambda one: one.effect.is_solved):
            self._compare(hypothesis)
        order = {one.key: number for number, one in enumerate(self.hypotheses)}
        self.competitors.sort(key=lambda one: order[one.hypothesis.key])
        later = [one for one in self.hypotheses if one.key not in first]
        fixed, few = self._fixed(), {one.effect.name for one in later}
        noticed = {one.candidate.effect for one in self.competitors
                   if one.candidate.effect in few
                   and is_noticeable(one.columns, fixed, self.marginal, self.residual)}
        for hypothesis in later:
            if hypothesis.effect.name in noticed:
                self._compare(hypothesis)
        self.progress(len(self.hypotheses), len(self.hypotheses))
        self._improve_places(fixed)

    def search(self) -> Search:
        """Return the comparison of the most likely ones, of which none that is near is rough."""
        while True:
            compared = most_likely(
                [one.candidate for one in self.competitors],
                [one.columns for one in self.competitors], self.marginal, self.residual,
                {number for number, one in enumerate(self.competitors) if one.in_model})
            chosen = [self.competitors[number] for number in compared.numbers]
            candidates = tuple(renumbered([one.candidate for one in chosen]))
            rough = frozenset(number for number, one in enumerate(chosen) if one.is_rough)
            near = [compared.numbers[number] for number in near_the_likeliest(
                compared.evidence, candidates, rough)]
            if not near:
                return Search(
                    tuple(one.hypothesis for one in chosen), candidates, compared.evidence,
                    compared.columns, compared.absorbed, self.residual, self.marginal,
                    self.point.training.residual, self.point.campaign, self.point.scene_at_start,
                    self.uncompared, rough)
            if self.is_over():  # no time is left to solve for them
                self.uncompared += len(near)
                self.competitors = [one for number, one in enumerate(self.competitors)
                                    if number not in near]
                continue
            for done, number in enumerate(near):
                self.progress(done, len(near))
                hypothesis = self.competitors[number].hypothesis
                self.competitors[number] = self._competitor(
                    hypothesis, self.point.exact(hypothesis))
            self.progress(len(near), len(near))

    def _compare(self, hypothesis: Hypothesis) -> None:
        """Add a hypothesis, unless its signature is not known and the time is up.

        The contribution of one in the model is added back to the residual.
        """
        self.progress(self._done, len(self.hypotheses))
        self._done += 1
        present = self.point.in_model.get(hypothesis.key)
        if present is not None:
            signature, amounts = self.point.of_identified(present)
            self.residual = self.residual + signature @ amounts
            self.competitors.append(self._competitor(hypothesis, signature))
            return
        known, is_rough = self.point.stored(hypothesis), False
        if known is None:
            over = self.is_over()
            known = self.point.rough(hypothesis, over)
            is_rough = known is not None
            if known is None and over:
                self.uncompared += 1
                return
        self.competitors.append(self._competitor(
            hypothesis, self.point.exact(hypothesis) if known is None else known, is_rough))

    def _competitor(
        self, hypothesis: Hypothesis, signature: Floats, is_rough: bool = False
    ) -> _Competitor:
        """Return the competitor that has a whitened signature (rows, k)."""
        effect, in_model = hypothesis.effect, hypothesis.key in self.point.in_model
        columns = signature * amplitude_scale(effect)[:signature.shape[1]]
        # What all blocks share is known this well only, or the calibration of the coil. A block
        # that is reversed or elsewhere has it with another sign or direction, which the prior does
        # not know.
        update = self.point.update
        common = (update.study.prior.shared_sd if update.measured_blocks is None else
                  update.study.prior.calibration_sd)
        if effect.is_binary and common and not in_model and not is_rough:
            columns = np.hstack([columns, common * columns])
        count = columns.shape[1]
        is_binary = effect.is_binary or (effect.applied_in_full and count > len(effect.parameters))
        return _Competitor(hypothesis, Candidate(
            effect.name, hypothesis.place.name, tuple(range(count)), is_binary and not is_rough,
            effect.unique, len(self.places[effect.name]), _parts(effect, count), effect.shared,
            effect.relative_odds), columns, in_model, is_rough)

    def _fixed(self) -> Floats:
        """Return the columns (rows, f) of what is in the model."""
        return np.hstack([np.zeros((len(self.residual), 0)), *(
            one.columns for one in self.competitors if one.in_model)])

    def _improve_places(self, fixed: Floats) -> None:
        """Add a better place than those of the grid of each effect that has one."""
        grids: dict[str, list[_Competitor]] = {}
        for one in self.competitors:
            if one.can_improve:
                grids.setdefault(one.candidate.effect, []).append(one)
        for name, grid in grids.items():
            effect = grid[0].hypothesis.effect

            def slopes(place: Place, amounts: Floats, effect: Effect = effect) -> Floats:
                return self.point.training.shown(self.point.scene_outside(effect).derivative(
                    Hypothesis(effect, place), amounts))

            better = _improved_place(
                effect, [one.hypothesis.place for one in grid], [one.columns for one in grid],
                slopes, fixed, self.marginal, self.residual)
            if better is not None and (name, better) not in self.point.signatures:
                self.places[name].append(better)
                hypothesis = Hypothesis(effect, better)
                self.competitors.append(self._competitor(
                    hypothesis, self.point.refined(hypothesis)))


def score_hypotheses(
    point: Linearization, effects: Sequence[Effect],
    progress: Progress = quiet, is_over: Callable[[], bool] = lambda: False,
) -> Search:
    """Compare all effects at a point where some effects are in the model already.

    The residual is that of the corrected study without the identified effects: their contribution
    is added back to the residual of the current model by their signatures at this point.

    Parameters
    ----------
    progress : callable, optional
        Called with the numbers of finished and of all hypotheses.
    is_over : callable, optional
        Tells whether the time is up. Signatures that are not known by then are left out.
    """
    comparison = _Comparison(point, effects, progress, is_over)
    comparison.compare_all()
    return comparison.search()


def _improved_place(
    effect: Effect, places: Sequence[Place], columns: Sequence[Floats],
    derivative: Callable[[Place, Floats], Floats], fixed: Floats, marginal: Marginal,
    residual: Floats,
) -> Place | None:
    """Return a better place than the best of a grid, by steps of Gauss and Newton.

    Only effects whose field adds to that of the magnet come here, so that nothing has to be solved.

    Parameters
    ----------
    columns : sequence of ndarray, shape (rows, k)
        Whitened signatures at these places per prior standard deviation.
    derivative : callable
        Takes a place and all amplitudes; returns whitened derivatives (rows, k + r).
    fixed : ndarray, shape (rows, f)
        Whitened signatures of effects in the model, whose amplitudes are free.
    residual : ndarray, shape (rows,)

    Returns
    -------
    Place or None
        None if no place explains anything.
    """
    # Largest number of steps that improve a place, and the length in standard deviations of a step
    # that ends them.
    max_place_steps, place_tolerance = 20, 0.1
    size, scale = len(effect.parameters), amplitude_scale(effect)
    # one product with the response for all places, instead of one for each
    shared, own = fixed.shape[1], np.cumsum([0, *(part.shape[1] for part in columns)])
    absorbed = marginal.absorbed(np.hstack([fixed, residual[:, None], *columns]))
    parts = [absorbed[:, shared + 1 + first:shared + 1 + last]
             for first, last in pairwise(own)]
    fits = [marginal.evidence(np.hstack([fixed, part]), residual, np.hstack([
        absorbed[:, :shared], half, absorbed[:, shared:shared + 1]])).fit(range(shared + size))
            for part, half in zip(columns, parts, strict=True)]
    best = int(np.argmax([fit.log_evidence for fit in fits]))
    alone = marginal.evidence(fixed, residual, absorbed[:, :shared + 1]).fit(
        range(shared)).log_evidence
    if fits[best].log_evidence - alone < DETECTION_LOG_ODDS:
        return None
    values = np.zeros(len(scale))
    values[:size] = scale[:size] * fits[best].mean[fixed.shape[1]:]
    longest = np.array([parameter.longest_step for parameter in (
        *effect.parameters, *effect.refinements)])
    for _ in range(max_place_steps):
        slopes = derivative(places[best], values)
        evidence = marginal.evidence(np.hstack([fixed, slopes * scale]),
                                     residual + slopes[:, size:] @ values[size:])
        fit = evidence.fit(range(len(evidence.prior)))
        sd = scale * np.sqrt(np.diag(fit.covariance))[fixed.shape[1]:]
        step = np.clip(scale * fit.mean[fixed.shape[1]:] - values, -longest, longest)
        values = values + step
        if (np.abs(step[size:]) <= place_tolerance * sd[size:]).all():
            break
    return effect.refined_place(places[best], values.tolist())


def identify_effects(
    corrected: Study, search: Search
) -> tuple[IdentifiedEffect, ...]:
    """Select the missing effects and fit their amplitudes, without impossible ones.

    An effect is impossible if an amplitude is below its parameter's minimum (a negative gap, for
    example), if no valid study has it, or if it puts points of the map inside material. Such a
    candidate is excluded and the selection repeated. Those with rough signatures are excluded: they
    explain too little, also in place of one that is impossible.

    ``corrected``: the study corrected for gross errors and outliers.
    """
    excluded = set(search.excluded)
    while True:
        found = amplitudes(
            search, select_effects(search.evidence, search.candidates, excluded=excluded))
        impossible = next((number for number in range(len(found)) if not possible(
            corrected, found[:number + 1], search.campaign)), None)
        if impossible is None:
            return found
        excluded.add(search.candidates.index(found[impossible].selection.candidate))


def possible(study: Study, identified: Sequence[IdentifiedEffect], campaign: Campaign) -> bool:
    """Tell whether a valid study can have effects of these amplitudes, with all points in air, and
    with the blocks that were measured.
    """
    if any(value < parameter.minimum for effect in identified
           for value, parameter in zip(effect.values, effect.parameters, strict=True)):
        return False
    try:
        changed = apply_effects(study, identified)
        magnet = build_magnet(changed)
        inside = magnet.contains(campaign.points_of(changed))
        if campaign.blocks is not None and identified:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", HalbachWarning)
                prior_from_blocks(magnet, campaign.blocks)
    except (HalbachError, ValidationError):  # an amplitude beyond its key's limits is the latter
        return False
    return not inside.any()


def amplitudes(search: Search, selected: Sequence[SelectedEffect]) -> tuple[IdentifiedEffect, ...]:
    """Fit the amplitudes of all selected effects jointly."""
    evidence = search.evidence
    for selection in selected:
        if selection.candidate.is_binary:
            evidence = evidence.shifted(selection.candidate.columns[0])
    fit = with_wide_priors(evidence, [selection.candidate for selection in selected]).fit(
        [column for selection in selected for column in selection.candidate.free])
    deviation = np.sqrt(np.diag(fit.covariance))
    mean, deviation = (np.where(deviation > 2 * PINNED_SD, each, 0.0)  # outside the likeliest part
                       for each in (fit.mean, deviation))
    identified, first = [], 0
    for selection in selected:
        hypothesis = search.hypotheses[search.candidates.index(selection.candidate)]
        free, fixed = len(selection.candidate.free), int(selection.candidate.is_binary)
        scale = amplitude_scale(hypothesis.effect)[fixed:fixed + free]
        part = slice(first, first + len(scale))  # without the tolerance of binary effects
        identified.append(IdentifiedEffect(
            hypothesis, np.concatenate([np.ones(fixed), scale * mean[part]]),
            np.concatenate([np.zeros(fixed), scale * deviation[part]]), selection))
        first += free
    return tuple(identified)


def with_rivals(
    search: Search, identified: Sequence[IdentifiedEffect]
) -> tuple[IdentifiedEffect, ...]:
    """Return identified effects with their alternatives, each fitted in place of its effect.

    The error bars of all other amplitudes are those of not knowing which of both it is, nor whether
    amplitudes outside the likeliest parts are 0. Alternatives that this search does not compare are
    left out.
    """
    own = [search.hypotheses.index(effect.hypothesis) for effect in identified]
    prior = prior_log_odds(search.candidates)
    numbers = {(one.effect, one.place): k for k, one in enumerate(search.candidates)}
    variances = _of_all_parts(search, identified, own)
    every = []
    for number, effect in enumerate(identified):
        others = [k for k in range(len(own)) if k != number]
        beside = [replace(identified[k].selection, candidate=search.candidates[own[k]])
                  for k in others]
        fits = [amplitudes(search, [*beside, SelectedEffect(
            search.candidates[k], factor, float(factor + prior[k]), ())])
            for one, factor in effect.selection.alternatives
            if (k := numbers.get((one.effect, one.place))) is not None]
        every.append(tuple(fit[-1] for fit in fits))
        odds = np.exp([each.selection.log_odds - effect.selection.log_odds for each in every[-1]])
        for place, k in enumerate(others):
            known = identified[k]
            more = [fit[place].sd**2 + (fit[place].values - known.values)**2 for fit in fits
                    if len(fit[place].values) == len(known.values)]
            if len(more) == len(odds) and more:
                variances[k] = np.where(known.sd > 0, np.maximum(variances[k], (
                    known.sd**2 + odds @ np.array(more)) / (1 + odds.sum())), 0.0)
    return tuple(replace(effect, sd=np.sqrt(variance), rivals=rivals)
                 for effect, variance, rivals in zip(identified, variances, every, strict=True))


def with_further_causes(
    search: Search, identified: Sequence[IdentifiedEffect], probabilities: Floats
) -> tuple[IdentifiedEffect, ...]:
    """Return identified effects whose error bars contain that one more effect may be missing.

    Amplitudes are a mixture of those beside every further candidate, each at the best place of its
    effect, and of those without any. ``probabilities`` (candidates,) are those of one more.
    """
    own = [search.hypotheses.index(effect.hypothesis) for effect in identified]
    beside = [replace(effect.selection, candidate=search.candidates[number])
              for effect, number in zip(identified, own, strict=True)]
    best: dict[str, tuple[float, int]] = {}
    total: dict[str, float] = {}
    for number, probability in enumerate(probabilities.tolist()):
        name = search.candidates[number].effect
        best[name] = max(best.get(name, (0.0, -1)), (probability, number))
        total[name] = total.get(name, 0.0) + probability
    variances = [effect.sd**2 for effect in identified]
    known = amplitudes(search, beside)
    for name, (probability, number) in best.items():
        if probability < SHOWN_PROBABILITY or number in (*search.rough, *own):
            continue
        with_more = amplitudes(search, [*beside, SelectedEffect(
            search.candidates[number], 0.0, 0.0, ())])
        for k, (one, other) in enumerate(zip(known, with_more, strict=False)):
            if len(one.values) == len(variances[k]):
                variances[k] += total[name] * np.maximum(
                    other.sd**2 + (other.values - one.values)**2 - one.sd**2, 0.0)
    return tuple(replace(effect, sd=np.where(effect.sd > 0, np.sqrt(variance), 0.0))
                 for effect, variance in zip(identified, variances, strict=True))


def _of_all_parts(
    search: Search, identified: Sequence[IdentifiedEffect], own: Sequence[int]
) -> list[Floats]:
    """Return the variances of the amplitudes of effects, whose candidates have the numbers ``own``,
    if those outside of the likeliest parts may be free as well. Of these they stay 0.
    """
    chosen = [search.candidates[number] for number in own]
    whole = replace(search, candidates=tuple(
        replace(one, parts=()) for one in search.candidates))
    free = [whole.candidates[number] for number in own]
    gain = (log_evidence(search.evidence, chosen) - log_evidence(search.evidence, free)
            + sum(float(np.log(max(1, len(one.parts)))) for one in chosen))
    share = 1 / (1 + np.exp(gain))  # all parts are equally probable before
    found = []
    for effect, other in zip(identified, amplitudes(whole, [
            replace(effect.selection, candidate=one)
            for effect, one in zip(identified, free, strict=True)]), strict=True):
        if len(other.values) != len(effect.values):  # refinements are not fitted yet
            found.append(effect.sd**2)
            continue
        wider = (1 - share) * effect.sd**2 + share * (
            other.sd**2 + (other.values - effect.values)**2)
        found.append(np.where(effect.sd > 0, np.maximum(effect.sd**2, wider), 0.0))
    return found


def with_short_steps(
    found: Sequence[IdentifiedEffect], before: Sequence[IdentifiedEffect]
) -> tuple[IdentifiedEffect, ...]:
    """Return identified effects whose amplitudes are not too far from those of the last round.

    Effects that are far from linear could run away otherwise, see `Parameter.longest_step`.
    """
    last = {effect.hypothesis: effect.values for effect in before}
    limited = []
    for effect in found:
        start = np.zeros(len(effect.values))
        known = last.get(effect.hypothesis, start)[:len(start)]
        start[:len(known)] = known
        longest = np.array([parameter.longest_step for parameter in effect.parameters])
        limited.append(replace(effect, values=start + np.clip(
            effect.values - start, -longest, longest)))
    return tuple(limited)


def _parts(effect: Effect, columns: int) -> tuple[tuple[int, ...], ...]:
    """Return the parts of an effect, of which every one has all refinements."""
    refinements = tuple(range(len(effect.parameters), columns))
    return tuple((*part, *refinements) for part in effect.parts)
