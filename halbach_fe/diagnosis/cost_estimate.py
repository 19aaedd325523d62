"""What a diagnosis would solve, counted before it is started."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.diagnosis.diagnose import MAX_ROUNDS
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Effect, Place
from halbach_fe.diagnosis.effects.magnetization import SHORTLIST, AssemblyEffect
from halbach_fe.diagnosis.gross_error_correction import (
    MIN_MISFIT_OF_A_POSE,
    blocks_of,
    correct_map_errors,
    iron_anywhere,
    misfits_of,
)
from halbach_fe.diagnosis.linearization import apply_effects
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import observation_of
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.campaign_maps import Data, check_maps
from halbach_fe.response.resource_estimate import Estimate, estimate_infer, estimate_solve
from halbach_fe.solver.mesh import with_rough_mesh
from halbach_fe.study.model import Study

FEWEST_ROUNDS = 2
"""Rounds of a diagnosis that adds an effect, of which the second confirms it; a map that lacks
nothing takes one."""


@dataclass(frozen=True)
class DiagnosisEstimate:
    """The cost of a diagnosis."""

    update: Estimate
    """Cost of the inference that every round computes."""
    signatures: int
    """Number of hypotheses whose signatures are computed in the first round."""
    fields: int
    """Number of fields of whole magnets that these signatures need, with iron for example."""
    fields_s: float
    """Time in s of these fields."""

    @property
    def shortest_s(self) -> float:
        """Time in s of `FEWEST_ROUNDS`.

        By azimuthal modes, a second round of nearly the same shapes and materials takes the
        solutions of the first one, see `halbach_fe.response.response_matrix.response_matrix`.
        """
        solved = 1 if self.update.route == "azimuthal_modes" else FEWEST_ROUNDS
        return solved * self.update.seconds + self.fields_s

    @property
    def longest_s(self) -> float:
        """Time in s of `MAX_ROUNDS`, each of which solves the model anew."""
        return MAX_ROUNDS * self.update.seconds + self.fields_s

    def as_dict(self) -> dict[str, Any]:
        """Return the estimate as plain data for JSON."""
        return {"rounds": [FEWEST_ROUNDS, MAX_ROUNDS], "signatures": self.signatures,
                "fields": self.fields, "seconds": [self.shortest_s, self.longest_s],
                "each_round": self.update.as_dict()}


def estimate_diagnosis(
    study: Study, data: Data, blocks: BlockTable | None = None,
    effects: Sequence[Effect] | None = None, validation_map: xr.Dataset | None = None,
    jobs: int = 1,
) -> DiagnosisEstimate:
    """Estimate the cost of `halbach_fe.diagnosis.diagnose.diagnose`, with nothing solved.

    Gross errors of the maps are found, as in the diagnosis, because the magnet is solved at the
    corrected positions.

    Raises
    ------
    MeasurementError
        If a map does not lie where the study says: a diagnosis would register it first.
    """
    data = check_maps(study, data)
    known = not iron_anywhere(build_magnet(study.with_(maps=())))  # without a solve
    _, corrected, starts = correct_map_errors(
        study, data, blocks, catalogue()) if known else ((), study, ())
    if known and study.dimension == 3 and not starts and (
            max(misfits_of(corrected, data).values()) > MIN_MISFIT_OF_A_POSE):
        raise MeasurementError(must_be(
            "map", f"study {study.name}", "where the study says, for an estimate", "elsewhere",
            "A diagnosis would find its pose; run `halbach-fe register` and estimate the "
            "registered study."))
    blocks = blocks_of(blocks, study, corrected)
    study = apply_effects(corrected, starts[0]) if starts else corrected
    magnet = build_magnet(study)
    observation = observation_of(magnet, data, blocks, validation_map)
    campaign = Campaign.of(study, data, validation_map)
    first = campaign.maps[0]
    points, own = campaign.points_of(study)[:1], first.study_of(study)
    signatures, fields, seconds = 0, 0, 0.0
    for effect in catalogue() if effects is None else effects:
        places = campaign.places(effect, study)
        if not places:
            continue
        signatures += min(len(places), SHORTLIST) if isinstance(
            effect, AssemblyEffect) else len(places)
        asked = _asked(effect, own, points, places[0], lambda changed: estimate_solve(
            build_magnet(changed), observation, jobs).seconds)
        # all places of an effect need fields of much the same cost
        fields += len(places) * len(asked)
        seconds += len(places) * sum(asked)
    return DiagnosisEstimate(estimate_infer(magnet, observation, jobs), signatures, fields,
                             seconds)


def _asked(
    effect: Effect, study: Study, points: Floats, place: Place, seconds_of: Callable[[Study], float]
) -> list[float]:
    """Return the times in s of the fields that the signature at a place needs, the rough one if
    there is one.

    Their meshes are those that suffice for signatures. ``seconds_of`` is that of the field of a
    magnet, or refuses it as solving it would.
    """
    asked: list[float] = []
    if effect.kind == "instrument":
        return asked

    def solve(changed: Study) -> Floats:
        if changed != study:  # the field of the study itself is shared by all
            asked.append(seconds_of(with_rough_mesh(changed)))
        return np.zeros((len(points), 3))

    nominal = NominalFields(study, points, np.zeros(len(points)), solve)
    if effect.rough_signature(nominal, place) is None:
        asked.clear()
        effect.signature(nominal, place)
    return asked
