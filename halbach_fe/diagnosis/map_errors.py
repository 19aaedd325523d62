"""Correct the gross errors of all maps of a campaign before any inference.

Every map is compared with the nominal magnet by itself. Another magnet than the study's is only
possible if all maps are of that magnet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import xarray as xr

from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.diagnosis.effects.base import Effect
from halbach_fe.diagnosis.equal_positions import Start, start_of
from halbach_fe.diagnosis.gross_errors import GrossError, find_gross_errors
from halbach_fe.diagnosis.hypothesis import Hypothesis
from halbach_fe.diagnosis.scene import Campaign
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.campaign import Data
from halbach_fe.study.model import Study


def correct_map_errors(
    study: Study, data: Data, blocks: BlockTable | None, effects: Sequence[Effect],
) -> tuple[tuple[GrossError, ...], Study, tuple[Start, ...]]:
    """Find the gross errors of all maps and correct the study for them.

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
        found = _errors_of(study, data, name, blocks)
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
    """Return the measured blocks, without their places if the corrected study has other rings."""
    if blocks is None or corrected.array.blocks_by_ring == study.array.blocks_by_ring:
        return blocks
    unplaced = np.zeros_like(blocks.ring)
    return replace(blocks, ring=unplaced, slot=unplaced)


def beside_amplitudes(blocks: BlockTable | None, study: Study) -> BlockTable | None:
    """Return the measured blocks for a study with effects, whose sizes may be off for a while.

    The first amplitudes can be far from the last ones. Volumes, with which sizes were compared
    before, are left out, unless the length of a cross-section comes from them.
    """
    if blocks is None or (study.dimension == 2 and not study.array.ring_length_m):
        return blocks
    return replace(blocks, volume=np.full_like(blocks.volume, np.nan))


def _errors_of(
    study: Study, data: Data, name: str | None, blocks: BlockTable | None
) -> tuple[GrossError, ...]:
    """Return the gross errors of a map; ``name`` is None for the only one."""
    if isinstance(data, xr.Dataset) or name is None:
        assert isinstance(data, xr.Dataset)
        return find_gross_errors(study, data, blocks)
    own = study.of_map(list(data).index(name))
    return tuple(replace(error, map=name) for error in find_gross_errors(own, data[name], blocks))


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
