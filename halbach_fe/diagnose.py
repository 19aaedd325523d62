"""From a disagreement to its name: which effects a study lacks, and the study that has them.

First what spoils all else is put right: a map that was misread, and single readings that are off.
Where the solver's own error explains the misfit, that is all there is to say.
Then effects are searched with their signatures, linear and cheap; those found go into the study in
full and are solved for again, which moves the point of linearization, until nothing changes: a
Gauss-Newton method whose model is the real one. In every round all effects compete anew, the found
ones with their signatures at that point. Positions that shake are noise, with which all is judged
once more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import xarray as xr
from pydantic import ValidationError

from halbach_fe.block_table import BlockTable
from halbach_fe.blocks import Floats, points_in_material
from halbach_fe.diagnosis.discrepancy import (
    Terms,
    harmonic_fields,
    judge,
    of_size,
    sensor_errors,
)
from halbach_fe.diagnosis.evidence import Evidence, Marginal
from halbach_fe.diagnosis.gross import Gross, find_gross
from halbach_fe.diagnosis.numerical import Numerical, numerical_of
from halbach_fe.diagnosis.outliers import Outlier, excluding, outliers_of
from halbach_fe.diagnosis.residuals import Group, groups, left_out
from halbach_fe.diagnosis.selection import (
    ALIKE,
    EFFECT_ODDS,
    FOUND,
    Candidate,
    Found,
    gains,
    log_evidence,
    prior_log_odds,
    probabilities,
    select,
    tailored,
    with_candidates,
)
from halbach_fe.diagnosis.vibration import Vibration, settled, shaking, vibration_of
from halbach_fe.effects import catalogue
from halbach_fe.effects.base import Effect, Parameter, Place
from halbach_fe.errors import HalbachError
from halbach_fe.instrument import map_time, probe_points
from halbach_fe.routes import solve_nominal
from halbach_fe.scene import Scene
from halbach_fe.solve import Progress, Workshop
from halbach_fe.study import FIELD_KEYS, Study
from halbach_fe.update import Update, infer

MOST_ROUNDS = 8
SETTLED = 0.2
"""Of an amplitude's standard deviation: less between rounds is no change."""

ON_AXIS_M = 1e-6
"""Distance from the axis below which a point has no angle."""

Say = Callable[[str], None]
Solver = Callable[[Study, Floats], Floats]
Signatures = dict[tuple[str, Place], Floats]
"""Whitened training readings (rows, k) per unit of each parameter, by effect and place."""


@dataclass(frozen=True)
class Hypothesis:
    """An effect at a place."""

    effect: Effect
    place: Place


@dataclass(frozen=True)
class Named:
    """An effect that is missing from the study.

    Attributes
    ----------
    hypothesis : Hypothesis
    values, sd : ndarray, shape (k,)
        Its amplitudes, in the units of its parameters, and of its refinements once it is in the
        model.
    found : Found
        Odds, and what could be meant instead.
    """

    hypothesis: Hypothesis
    values: Floats
    sd: Floats
    found: Found

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What the amplitudes are."""
        effect = self.hypothesis.effect
        return (*effect.parameters, *effect.refinements)[:len(self.values)]


@dataclass(frozen=True)
class Search:
    """All effects compared at one point of linearization.

    ``columns`` are the whitened signatures (rows, k), ``residual`` (rows,) what they explain;
    ``training`` is the whitened residual of the training readings from the prior mean, with named
    effects in the model.
    """

    hypotheses: tuple[Hypothesis, ...]
    candidates: tuple[Candidate, ...]
    evidence: Evidence
    columns: Floats
    residual: Floats
    marginal: Marginal
    training: Floats


@dataclass(frozen=True)
class Unknown:
    """Something that no effect of the catalogue explains.

    Attributes
    ----------
    kind : str
        ``field``: it solves Maxwell's equations in the bore, so that a source is missing;
        ``instrument``: it cannot; ``either``: the readings do not tell.
    log_bayes_factor : float
        Over the named effects alone.
    alone : bool
        Whether it is the better explanation by itself: no effect is named then.
    as_well : bool
        Whether it is about as good as several named effects together, in place of which it may be.
    largest_T : float
        Of it at any training reading.
    at_m : tuple of float
        Where that is.
    source_m : tuple of float or None
        Where a point dipole would have to be that is the best source, if a field is missing.
    """

    kind: Literal["field", "instrument", "either"]
    log_bayes_factor: float
    alone: bool
    as_well: bool
    largest_T: float
    at_m: tuple[float, ...]
    source_m: tuple[float, ...] | None


@dataclass(frozen=True)
class Diagnosis:
    """What a study lacks.

    Attributes
    ----------
    read : Study
        The study that reads the map right, without outliers; all else is compared with it.
    before, after : Update
        The inference with that study, and with the effects that were named.
    named : tuple of Named
    unknown : Unknown or None
        What they leave unexplained, if anything.
    probabilities : dict
        Of each effect, and of none, if at most one is missing.
    evidence : Evidence
    candidates : tuple of Candidate
        From which all that is said of the study as it was follows.
    groups_before, groups_after : list of Group
        Where readings disagree.
    left_out_before, left_out_after : ndarray, shape (n,)
        Standardized residuals of the training readings.
    rounds : int
    gross : tuple of Gross
        How the map was misread.
    outliers : tuple of Outlier
        Readings that are off singly.
    vibration : Vibration or None
        Of the probe, if the readings show it.
    numerical : Numerical or None
        The solver's own error, if it explains the misfit; then nothing else is looked for.
    at_rest : bool
        Whether the last round changed nothing.
    """

    read: Study
    before: Update
    after: Update
    named: tuple[Named, ...]
    unknown: Unknown | None
    probabilities: dict[str, float]
    evidence: Evidence
    candidates: tuple[Candidate, ...]
    groups_before: list[Group]
    groups_after: list[Group]
    left_out_before: Floats
    left_out_after: Floats
    rounds: int
    gross: tuple[Gross, ...] = ()
    outliers: tuple[Outlier, ...] = ()
    vibration: Vibration | None = None
    numerical: Numerical | None = None
    at_rest: bool = True

    @property
    def study(self) -> Study:
        """The study with what was missing."""
        return self.after.study

    @property
    def anything(self) -> bool:
        """Whether anything was named: an error, outliers, an effect, or vibration."""
        return bool(self.gross or self.outliers or self.named or self.vibration)


def diagnose(
    study: Study, data: xr.Dataset, workshop: Workshop, blocks: BlockTable | None = None,
    effects: Sequence[Effect] | None = None, unseen: xr.Dataset | None = None,
    say: Say = lambda text: None, solver: Solver | None = None,
) -> Diagnosis:
    """Find which effects a study lacks to explain a map.

    Parameters
    ----------
    effects : sequence of Effect, optional
        To choose from; default the whole catalogue.
    unseen : Dataset, optional
        Another map, which is only predicted.
    solver : callable, optional
        Of nominal magnets, see `remembering`; default one of its own.
    """
    effects = catalogue() if effects is None else effects
    gross, read, start = _read_right(study, data, blocks, effects)
    for one in gross:
        say(f"gross error: {one.reading.text}")
    if blocks is not None and read.array.rings != study.array.rings:
        nowhere = np.zeros_like(blocks.ring)  # which ring is which is not known then
        blocks = replace(blocks, ring=nowhere, slot=nowhere)
    signatures: Signatures = {}
    solver = solver or remembering(replace(_room(workshop, "signatures"), progress=None))
    times = np.concatenate([map_time(one) for one in (data, unseen) if one is not None])
    first: tuple[Update, Search] | None = None
    named, vibration, at_rest = start, None, True
    outliers: tuple[Outlier, ...] = ()
    numerical: Numerical | None = None

    def updated(name: str) -> Update:
        return infer(shaking(applied(read, named), vibration), data, _room(workshop, name), blocks,
                     unseen=unseen)

    for number in range(MOST_ROUNDS):
        say(f"round {number + 1}: the model with "
            f"{', '.join(one.found.candidate.name for one in named) or 'nothing added'}")
        update = updated(f"round-{number + 1}")
        if number == 0:
            outliers = outliers_of(update)
        if number == 0 and outliers:
            say(f"outliers: {len(outliers)}; without them")
            read = excluding(read, outliers)
            update = updated("without-outliers")
        known = (first[0] if first else update).prior.mean
        search = look(read, start, update, known, times, solver, effects, named, signatures,
                      workshop.progress or (lambda done, total: None))
        first = first or (update, search)
        numerical = None if named else numerical_of(update)
        if numerical:
            say("the solver's own error explains the misfit")
            break
        shaken = vibration_of(update, search.marginal, search.columns, search.training, vibration)
        if not settled(vibration, shaken):
            say(f"vibration: {1e3 * shaken.sd_m if shaken else 0:.2g} mm; with it in the noise")
            vibration = shaken
            signatures.clear()  # whitened by the noise that it was
            continue
        found = _found(read, search, update.observation.map_points)
        at_rest = _settled(named, found)
        if at_rest:
            break
        named = found
    assert first is not None
    rest = None if numerical else unknown(search, update, named)
    if rest is not None and rest.alone:
        named, vibration, (update, search) = start, None, first
    return Diagnosis(
        read=read, before=first[0], after=update, named=named, unknown=rest,
        probabilities=probabilities(first[1].evidence, first[1].candidates),
        evidence=first[1].evidence, candidates=first[1].candidates,
        groups_before=_groups(first[0], first[1].marginal, first[1].training),
        groups_after=_groups(update, search.marginal, search.training),
        left_out_before=left_out(first[1].marginal, first[1].training),
        left_out_after=left_out(search.marginal, search.training), rounds=number + 1,
        gross=gross, outliers=outliers, vibration=vibration, numerical=numerical,
        at_rest=at_rest)


def _read_right(
    study: Study, data: xr.Dataset, blocks: BlockTable | None, effects: Sequence[Effect]
) -> tuple[tuple[Gross, ...], Study, tuple[Named, ...]]:
    """Gross errors and the study that reads the map right; of points that were elsewhere by what an
    effect of the catalogue can be, that effect, with which a search is to start.
    """
    found = find_gross(study, data, blocks)
    known = {effect.name: effect for effect in effects}
    start: tuple[Named, ...] = ()
    if found and found[-1].start and found[-1].start.keys() <= known.keys():
        start = tuple(
            Named(Hypothesis(known[name], Place()), np.array(values), np.zeros(len(values)),
                  Found(Candidate(name, "", ()), 0.0, 0.0, ()))
            for name, values in found[-1].start.items())
        found = found[:-1]
    for one in found:
        study = one.apply(study)
    return found, study, start


def applied(study: Study, named: Sequence[Named]) -> Study:
    """The study with effects in full."""
    for one in named:
        study = one.hypothesis.effect.apply(study, one.hypothesis.place, one.values.tolist())
    return study


def look(
    read: Study, start: Sequence[Named], update: Update, known: Floats, times: Floats,
    solver: Solver, effects: Sequence[Effect], named: Sequence[Named], signatures: Signatures,
    progress: Progress = lambda done, total: None,
) -> Search:
    """Compare all effects at the point where some are in the model already.

    The residual is that of the study ``read`` without them: what they do is added back, by their
    signatures at this point. Other effects keep the ``signatures`` that they had first, with those
    in the model with which the search ``start``s. ``known`` are the magnetizations (parameters,) in
    A/m that the prior expects without any effects.
    """
    rows = np.flatnonzero(~update.held_out)
    noise = update.errors.part(rows)

    def whitened(readings: Floats) -> Floats:
        """All readings (..., readings) to training ones (rows, ...)."""
        return noise.whiten(np.ascontiguousarray(readings[..., rows].T))

    response = noise.whiten(update.response.matrix[rows])
    marginal = Marginal.of(np.hstack([response @ update.prior.root,
                                      whitened(_solver_error(update))]))
    training = whitened(update.readings - update.response.offset
                        - update.response.matrix @ update.prior.mean)
    residual = training
    study = applied(read, start)

    def scene_of(other: Study) -> Scene:
        points = probe_points(other.instrument, update.observation.map_points)
        return Scene(other, points, times, lambda one: solver(one, points),
                     known=known.reshape(-1, other.dimension))

    scene, bare = scene_of(update.study), scene_of(study)
    there = {(one.hypothesis.effect.name, one.hypothesis.place): one for one in named}
    kept = marginal.remove(response)
    information, score = response.T @ kept, kept.T @ training
    worth_a_look = [Hypothesis(effect, place) for effect in effects if effect.places(study)
                    for place in dict.fromkeys((
                        *effect.shortlist(update.study, update.prior.mean, information, score),
                        *(place for name, place in (*signatures, *there) if name == effect.name)))]
    candidates: list[Candidate] = []
    columns: list[Floats] = []
    width = 0
    for number, hypothesis in enumerate(worth_a_look):
        progress(number, len(worth_a_look))
        effect, place = hypothesis.effect, hypothesis.place
        key = effect.name, place
        present = there.get(key)
        if present is None:
            seen = signatures.get(key)
            if seen is None:
                seen = signatures[key] = whitened(update.observation.read(
                    effect.signature(bare, place)))
        elif effect.discrete:
            others = applied(read, [one for one in named if one is not present])
            amounts = np.pad(present.values, (0, len(_scale(effect)) - len(present.values)))
            amounts[0] = 1.0
            seen = whitened(update.observation.read(_whole(
                present.hypothesis, amounts, scene_of(others))))
            residual = residual + seen @ amounts
        else:
            seen = whitened(update.observation.read(effect.signature(scene, place)))
            residual = residual + seen @ present.values
        columns.append(seen * _scale(effect)[:seen.shape[1]])
        candidates.append(Candidate(
            effect.name, place.name, tuple(range(width, width + seen.shape[1])),
            effect.certain or seen.shape[1] > len(effect.parameters), effect.only))
        width += seen.shape[1]
    stacked = np.hstack(columns)
    return Search(tuple(worth_a_look), tuple(candidates), marginal.evidence(stacked, residual),
                  stacked, residual, marginal, training)


def _solver_error(update: Update) -> Floats:
    """Readings (k, n) of smooth fields as large as the solver's error, which no noise is; it is
    part of what is integrated out with the blocks.
    """
    size = float(np.sqrt(np.mean(update.response.error**2)))
    points = probe_points(update.study.instrument, update.observation.map_points)
    fields = of_size(harmonic_fields(points), size) if size else np.zeros((1, *points.shape))
    return update.observation.read(fields)


def unknown(search: Search, update: Update, named: Sequence[Named]) -> Unknown | None:
    """Judge what named effects leave: a smooth field, or a smooth error of the sensors."""
    rows = np.flatnonzero(~update.held_out)
    noise, observation = update.errors.part(rows), update.observation
    points = probe_points(update.study.instrument, observation.map_points)
    scale = float(np.median(update.errors.sd))
    # columns of this search: other places may have been looked at in the one that found them
    numbers = [search.hypotheses.index(one.hypothesis) for one in named]
    mine = [search.candidates[number] for number in numbers]
    held = [column for one in mine for column in one.columns]
    own = [replace(one, columns=tuple(held.index(column) for column in one.columns))
           for one in mine]
    kinds: dict[Literal["field", "instrument", "either"], Terms] = {
        "field": harmonic_fields(points), "instrument": sensor_errors(points)}
    beside, instead = [], []
    for kind, terms in kinds.items():
        readings = observation.read(scale * terms.fields)
        smooth = noise.whiten(np.ascontiguousarray(readings[:, rows].T))
        both = search.marginal.evidence(
            np.hstack([search.columns[:, held], smooth]), search.residual)
        added = range(len(held), both.information.shape[0])
        rest = judge(with_candidates(both, own).only(added), terms.fineness)
        only = judge(both.only(added), terms.fineness)
        beside.append((rest.log_bayes_factor, kind, rest))
        instead.append((only.log_bayes_factor, kind, only))
    beside.sort(key=lambda one: -one[0])
    instead.sort(key=lambda one: -one[0])
    outside = float(np.log(EFFECT_ODDS))
    remains = beside[0][0] + outside >= FOUND
    # several effects that happen to add up to one thing pay for each of them
    odds = log_evidence(both, own) + prior_log_odds(search.candidates)[numbers].sum()
    ahead = instead[0][0] + outside - odds if mine else -np.inf
    alone = bool(ahead > ALIKE)
    as_well = bool(len(mine) > 1 and abs(ahead) <= ALIKE and not remains)
    if not (remains or alone or as_well):
        return None
    (factor, kind, best), (second, *_) = instead if alone or as_well else beside
    size = scale * np.linalg.norm(np.tensordot(best.mean, kinds[kind].fields, 1), axis=1)
    source = None
    if kind == "field":
        others = [] if alone or as_well else mine
        factors = gains(with_candidates(search.evidence, others), search.candidates)
        dipoles = [number for number, one in enumerate(search.hypotheses)
                   if one.effect.name == "ferromagnetic_object"]
        if dipoles:
            source = search.hypotheses[max(dipoles, key=lambda k: factors[k])].place.at_m
    return Unknown("either" if factor - second < ALIKE else kind, factor,
                   alone or not mine, as_well, float(size.max()),
                   tuple(points[int(np.argmax(size))].tolist()), source)


def _whole(hypothesis: Hypothesis, amounts: Floats, scene: Scene) -> Floats:
    """Signatures (k, n, 3) of an effect that is there as a whole, in a scene without it: what it
    does at these amounts, less what its refinements do of that, and these.
    """
    effect, place, values = hypothesis.effect, hypothesis.place, amounts.tolist()
    if not effect.refinements:
        return effect.signature(scene, place)
    refined = effect.refine(scene, place, values)
    there = scene.solve(effect.apply(scene.study, place, values)) - scene.solved
    return np.concatenate([(there - np.tensordot(amounts[1:], refined, 1))[None], refined])


def remembering(workshop: Workshop) -> Solver:
    """Solve for the fields (n, 3) in T of nominal magnets at points (n, 3) in m, each once."""
    known: dict[tuple[str, bytes], Floats] = {}

    def solve(study: Study, points: Floats) -> Floats:
        key = study.model_dump_json(include=FIELD_KEYS), points.tobytes()
        if key not in known:
            known[key] = solve_nominal(study, points, workshop)
        return known[key]
    return solve


def _found(read: Study, search: Search, points: Floats) -> tuple[Named, ...]:
    """What is missing, of what can be: no gap is negative, and the points (n, 3) in m of the map
    are in air.
    """
    barred: set[int] = set()
    while True:
        found = _amplitudes(
            search, select(search.evidence, search.candidates, barred=barred))
        bad = next((number for number in range(len(found))
                    if not _possible(read, found[:number + 1], points)), None)
        if bad is None:
            return found
        barred.add(search.candidates.index(found[bad].found.candidate))


def _possible(study: Study, named: Sequence[Named], points: Floats) -> bool:
    """Tell whether a study can have effects of their amplitudes."""
    if any(value < parameter.least for one in named
           for value, parameter in zip(one.values, one.parameters, strict=True)):
        return False
    try:
        changed = Study.model_validate(applied(study, named).model_dump())
        inside = points_in_material(changed, probe_points(changed.instrument, points))
    except (ValidationError, HalbachError):
        return False
    return not inside.any()


def _amplitudes(search: Search, found: Sequence[Found]) -> tuple[Named, ...]:
    """Amplitudes of found effects, all together."""
    evidence = search.evidence
    for one in found:
        if one.candidate.certain:
            evidence = evidence.shifted(one.candidate.columns[0])
    fit = tailored(evidence, [one.candidate for one in found]).fit(
        [column for one in found for column in one.candidate.free])
    deviation = np.sqrt(np.diag(fit.covariance))
    named, first = [], 0
    for one in found:
        hypothesis = search.hypotheses[search.candidates.index(one.candidate)]
        free, fixed = len(one.candidate.free), int(one.candidate.certain)
        scale = _scale(hypothesis.effect)[fixed:fixed + free]
        part = slice(first, first + free)
        named.append(Named(
            hypothesis, np.concatenate([np.ones(fixed), scale * fit.mean[part]]),
            np.concatenate([np.zeros(fixed), scale * deviation[part]]), one))
        first += free
    return tuple(named)


def _scale(effect: Effect) -> Floats:
    """Prior standard deviations of all amplitudes, refinements too."""
    return np.array([parameter.sd for parameter in (*effect.parameters, *effect.refinements)])


def _settled(old: Sequence[Named], new: Sequence[Named]) -> bool:
    """Tell whether a round changed nothing."""
    before = {one.hypothesis: one for one in old}
    return before.keys() == {one.hypothesis for one in new} and all(
        _alike(before[one.hypothesis], one) for one in new)


def _alike(one: Named, other: Named) -> bool:
    """Tell whether amplitudes are the same; of what is there or not the strength does not count."""
    if len(one.values) != len(other.values):
        return False
    close = np.abs(one.values - other.values) <= SETTLED * other.sd
    return bool(close[one.hypothesis.effect.discrete:].all())


def _groups(update: Update, marginal: Marginal, residual: Floats) -> list[Group]:
    """Disagreement by z window, angle, radius, component."""
    chosen = ~update.held_out
    x, y, z = update.observation.positions[chosen].T
    angle, radius = np.degrees(np.arctan2(y, x)) % 360, np.hypot(x, y)
    edges = np.linspace(z.min(), z.max() + 1e-9, 13)
    window = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, 11)
    members = {
        "z": [f"{edges[k]:.3f} ... {edges[k + 1]:.3f} m" for k in window],
        "angle": [f"{30 * int(one // 30)} ... {30 * int(one // 30) + 30} deg"
                  if distance > ON_AXIS_M else "on the axis"
                  for one, distance in zip(angle, radius, strict=True)],
        "radius": [f"{one:.4f} m" for one in radius],
        "label": [label for label, keep in zip(update.observation.labels, chosen, strict=True)
                  if keep]}
    used = {kind: names for kind, names in members.items() if 1 < len(set(names)) <= 40}
    return groups(marginal, residual, used)


def _room(workshop: Workshop, name: str) -> Workshop:
    return replace(workshop, folder=workshop.folder / name)
