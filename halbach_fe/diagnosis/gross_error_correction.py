"""Correct the gross errors of all maps of a campaign before any inference, and find where they lie.

Every map is compared with the nominal magnet by itself. Another magnet than the study's is only
possible if all maps are of that magnet. Positions of a displaced map that a symmetric magnet hardly
distinguishes are compared by evidence.

A stage has coordinates of its own. A map in these may be half a metre away from where the study
says, and turned by a right angle and a few degrees. No effect of the catalogue, and no gross error
of units or axes, reaches so far, and so such maps are registered from nothing before anything else
is compared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import xarray as xr

from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.progress import Say
from halbach_fe.diagnosis.effect_selection import (
    INDISTINGUISHABLE_LOG_EVIDENCE,
    Candidate,
    SelectedEffect,
)
from halbach_fe.diagnosis.effects.base import Effect, Hypothesis
from halbach_fe.diagnosis.gross_errors import MIN_READINGS, GrossError, find_gross_errors, misfit_of
from halbach_fe.diagnosis.linearization import Training
from halbach_fe.diagnosis.result import FoundPose, IdentifiedEffect, PossiblePosition
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.block_prior import with_types
from halbach_fe.inference.registration import odds, register, register_maps, registered_study
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.campaign_maps import Data, maps_of
from halbach_fe.solver.separate_blocks import Field, applies, solve_separate
from halbach_fe.solver.session import Session
from halbach_fe.study.model import Study

MIN_MISFIT_OF_A_POSE = 0.3
"""Smallest misfit of a map in its stated place, relative to the map's rms, from which its pose is
searched. In a bore of radius 20 mm a displacement by 4 mm leaves up to 0.13 and one by 6 mm, which
is found as a gross error, up to 0.2."""


Start = tuple[IdentifiedEffect, ...]
"""Effects that amount to a displacement of the map."""


def possible_positions(
    starts: Sequence[Start], updated: Callable[[Start, str], InferenceResult], campaign: Campaign,
) -> tuple[Start, tuple[PossiblePosition, ...]]:
    """Return the most probable position, and all that the readings do not exclude.

    Parameters
    ----------
    starts : sequence of Start
        The positions.
    updated : callable
        Takes a position and a name, and returns the inference with that position.

    Returns
    -------
    start : tuple of IdentifiedEffect
        The most probable position.
    positions : tuple of PossiblePosition
        It and the others, the most probable first. The tuple is empty if there are no others.
    """
    if len(starts) < 2:
        return (starts[0] if starts else ()), ()
    refined = sorted((_refined(start, f"position-{number}", updated, campaign)
                      for number, start in enumerate(starts, start=1)), key=lambda each: -each[1])
    best, largest = refined[0]
    near = [(start, evidence - largest) for start, evidence in refined
            if evidence >= largest - INDISTINGUISHABLE_LOG_EVIDENCE]
    weights = np.exp([less for _, less in near])
    return best, tuple(
        PossiblePosition({effect.name: tuple(effect.values.tolist())
                          for effect in start}, float(weight / weights.sum()))
        for (start, _), weight in zip(near, weights, strict=True)) if len(near) > 1 else ()


def start_of(
    amplitudes: Mapping[str, tuple[float, ...]], hypotheses: Mapping[str, Hypothesis]
) -> Start:
    """Return effects of given amplitudes, by name, as if they had been found."""
    return tuple(
        IdentifiedEffect(hypotheses[name], np.array(values), np.zeros(len(values)),
                         SelectedEffect(Candidate(name, hypotheses[name].place.name, ()),
                                        0.0, 0.0, ()))
        for name, values in amplitudes.items())


def _refined(
    start: Start, name: str, updated: Callable[[Start, str], InferenceResult],
    campaign: Campaign,
) -> tuple[Start, float]:
    """Return the position to which a few steps lead, and its log evidence."""
    # number of steps that refine a position: it starts from a fit of nominal blocks, within 2 mm
    steps = 2
    for step in range(steps + 1):
        update = updated(start, name)
        if step == steps:
            break
        training = Training.of(update, campaign)
        scene = campaign.scene(update.study)  # displacements need the field in vacuum only
        columns = np.hstack([
            training.shown(scene.signature(effect.hypothesis)) for effect in start])
        sd = np.array([parameter.sd for effect in start for parameter in effect.parameters])
        change = sd * training.marginal.evidence(
            columns * sd, training.residual).fit(range(len(sd))).mean
        ends = np.cumsum([len(effect.values) for effect in start])[:-1]
        start = tuple(replace(effect, values=effect.values + part) for effect, part in zip(
            start, np.split(change, ends), strict=True))
    return start, update.log_evidence


def correct_map_errors(
    study: Study, data: Data, blocks: BlockTable | None, effects: Sequence[Effect],
    iron: Field | None = None,
) -> tuple[tuple[GrossError, ...], Study, tuple[Start, ...]]:
    """Find the gross errors of all maps and correct the study for them.

    ``iron`` is what `field_of_iron` returns.

    Returns
    -------
    errors : tuple of GrossError
    study : Study
        The study whose instruments or magnet are corrected for these errors.
    starts : tuple of Start
        Effects from which the search starts, one set for each position of the maps that may be
        equal to the others by symmetry. An error of the points' positions that is also an effect of
        the catalogue (`wrong_radius`, `wrong_line`) is not corrected in the study but returned
        here, so that the search refines its amplitude.

    Raises
    ------
    MeasurementError
        If one of several maps is of another magnet than the others.
    """
    names = {effect.name for effect in effects}
    kept: list[GrossError] = []
    displaced: list[GrossError] = []
    for name in [None] if isinstance(data, xr.Dataset) else list(data):
        found = _errors_of(study, data, name, blocks, iron)
        for error in found:
            others = [] if isinstance(data, xr.Dataset) or error.convention.magnet is None else [
                other for other in data if other != name]
            for other in others:
                _check_same_magnet(error, error.apply(study), data, other, blocks)
            if error is found[-1] and error.starts and error.starts[0].keys() <= names:
                displaced.append(error)
            else:
                study = error.apply(study)
                kept.append(error)
    return tuple(kept), study, _starts(study, data, displaced, effects)


def blocks_of(blocks: BlockTable | None, study: Study, corrected: Study) -> BlockTable | None:
    """Return the measured blocks as they are to be used with the corrected study.

    Those of the study's own rings, if the corrected study has others, are samples of their types:
    where they are mounted is not known then. A table of other rings is left as it is, since it may
    be of the corrected ones.
    """
    rings = len(study.array.blocks_by_ring)
    if blocks is None or corrected.array.blocks_by_ring == study.array.blocks_by_ring or (
            blocks.ring.max() != rings):
        return blocks
    unplaced = np.zeros_like(blocks.ring)
    return replace(with_types(build_magnet(study), blocks), ring=unplaced, slot=unplaced)


def beside_amplitudes(blocks: BlockTable | None, study: Study) -> BlockTable | None:
    """Return the measured blocks for a study with effects, whose sizes may be off for a while.

    The first amplitudes can be far from the last ones. Volumes, with which sizes were compared
    before, are left out, unless the length of a cross-section comes from them.
    """
    if blocks is None or (study.dimension == 2 and not study.array.ring_length_m):
        return blocks
    return replace(blocks, volume=np.full_like(blocks.volume, np.nan))


def _errors_of(
    study: Study, data: Data, name: str | None, blocks: BlockTable | None,
    iron: Field | None = None,
) -> tuple[GrossError, ...]:
    """Return the gross errors of a map; ``name`` is None for the only one."""
    if isinstance(data, xr.Dataset) or name is None:
        assert isinstance(data, xr.Dataset)
        return find_gross_errors(study, data, blocks, iron)
    own = study.of_map(list(data).index(name))
    return tuple(replace(error, map=name) for error in find_gross_errors(
        own, data[name], blocks, iron))


def _check_same_magnet(
    error: GrossError, changed: Study, data: Data, other: str, blocks: BlockTable | None
) -> None:
    """Raise a MeasurementError if another map is not of the magnet that one of them shows."""
    if any(each.convention.magnet for each in _errors_of(changed, data, other, blocks)):
        raise MeasurementError(must_be(
            f"map '{error.map}'", f"study {changed.name}", "of the same magnet, in the same "
            f"orientation, as map '{other}'", f"one that would need {error.convention.text}",
            "Find the poses of the maps by halbach-fe register, or remove the map."))


def _starts(
    study: Study, data: Data, displaced: Sequence[GrossError], effects: Sequence[Effect]
) -> tuple[Start, ...]:
    """Return all combinations of the possible positions of the displaced maps."""
    if not displaced:
        return ()
    campaign = Campaign.of(study, data)
    catalogued = {effect.name: effect for effect in effects}
    by_map = []
    for error in displaced:
        hypotheses = {
            name: Hypothesis(catalogued[name], next(
                place for place in campaign.places(catalogued[name], study)
                if error.map is None or error.map in place.maps))
            for start in error.starts for name in start if name in catalogued}
        by_map.append([start_of(start, hypotheses) for start in error.starts
                       if start.keys() <= catalogued.keys()])
    return tuple(sum(parts, ()) for parts in product(*by_map))


def with_poses(study: Study, poses: Sequence[FoundPose]) -> Study:
    """Return the study with its maps in these poses, all at once: they may share probe and stage,
    whose terms must agree.
    """
    tables = {one.map or "": {"instrument": one.instrument, "instrument_sd": one.open}
              for one in poses}
    return study.with_(**tables[""]) if "" in tables else study.with_tables(tables)


def field_of_iron(study: Study, session: Session) -> Field | None:
    """Return what iron of any shape adds to the field of the blocks, see `find_gross_errors`.

    None if the study has none, or if no function of the points has its field.
    """
    magnet = build_magnet(study.with_(maps=()))
    if not iron_anywhere(magnet):
        return None
    return solve_separate(magnet, session, estimate=False).field


def iron_anywhere(magnet: Magnet) -> bool:
    """Tell whether iron of any shape is solved for beside blocks that no mesh follows."""
    return applies(magnet) and bool(magnet.iron) and not magnet.iron_is_axisymmetric


def misfits_of(study: Study, data: Data, iron: Field | None = None) -> dict[str, float]:
    """Return the `misfit_of` of each map in its stated place, by name.

    It is 0 for maps with so few readings that some pose would fit any of them.
    """
    return {one.name: misfit_of(one.study, one.data, iron) if one.data["B_T"].notnull().sum()
            >= MIN_READINGS else 0.0 for one in maps_of(study, data)}


def find_poses(
    study: Study, data: Data, session: Session, say: Say,
    iron: Field | None = None,
) -> tuple[tuple[FoundPose, ...], Study]:
    """Register the maps if one of them is far from the magnet's field where the study states it.

    Several maps of one study are registered together, since a stage may be common to them.

    Parameters
    ----------
    study : Study
        Corrected for gross errors.
    data : Dataset or dict of str to Dataset
        The map, or the maps that the study lists.
    say : callable
        Called with a description of each step before it starts.
    iron : callable, optional
        What `field_of_iron` returns.

    Returns
    -------
    poses : tuple of FoundPose
        Empty if the maps lie about where the study says, if no pose explains them, or if the study
        is a cross-section.
    study : Study
        The study with the instruments of these poses.
    """
    possible = 0.05  # odds from which another pose is named beside the best one
    min_reduction = 3.0  # factor by which the registered pose must reduce the misfit to be believed
    before = misfits_of(study, data, iron)
    if study.dimension == 2 or max(before.values()) < MIN_MISFIT_OF_A_POSE:
        return (), study
    several, maps = isinstance(data, dict), maps_of(study, data)
    say("the field is not that of the place that the study states: searching the pose")
    magnet = build_magnet(study.with_(maps=()))
    try:
        if several:
            found = register_maps(magnet, maps, session, say=say)
            registered = registered_study(study, maps, found)
        else:
            found = {maps[0].name: register(magnet, maps[0].data, session, say=say)}
            registered = found[maps[0].name][0].study
    except MeasurementError as error:
        say(f"no pose explains the map: {error}")
        return (), study
    after = misfits_of(registered, data, iron)
    # misfit that is good enough even if it was not larger in the stated place: of a map that lies
    # right beside another one that does not
    good = 0.05
    if any(after[name] > min(MIN_MISFIT_OF_A_POSE, max(misfit / min_reduction, good))
           for name, misfit in before.items()):
        say("no pose explains the map")
        return (), study
    poses = [FoundPose(
        found[one.name][0], one.study.instrument, one.study.instrument_sd,
        tuple(float(each) for each in odds(found[one.name])[1:] if each > possible),
        before[one.name], after[one.name], one.name if several else None)
        for one in maps_of(registered, data)]
    return tuple(poses), with_poses(study, poses)
