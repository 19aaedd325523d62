"""Two blocks that changed places."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.symmetry import rotation_about_z
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.model import Study

SHORTLIST = 40
"""Pairs that are looked at closely, of tens of thousands."""


class BlocksSwappedEffect(Effect):
    """Each block mounted, in its own axes, where the other should be."""

    name = "blocks_swapped"
    title = "two blocks that changed places"
    kind = "field"
    parameters = (Parameter("there", "1", 1.0),)
    certain = True
    discrete = True

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`: neighbours, as examples of what `shortlist` chooses from."""
        array = study.array
        return [Place(ring, slot, other=(ring, slot % array.blocks_per_ring + 1))
                for ring in range(1, array.rings + 1)
                for slot in range(1, array.blocks_per_ring + 1)]

    def shortlist(
        self, study: Study, mean: Floats, information: Floats, score: Floats
    ) -> Sequence[Place]:
        """See `Effect.shortlist`: the exchange of two blocks is a change of their magnetizations,
        whose evidence is a quadratic form of that of all blocks.
        """
        blocks, size = build_magnet(study).blocks, study.dimension
        angles = np.radians([position_angle_deg(study.array, block.slot) for block in blocks])
        vectors = mean.reshape(len(blocks), size)
        own = np.array([rotation_about_z(-angle)[:size, :size] @ vector
                        for angle, vector in zip(angles, vectors, strict=True)])
        turns = np.array([rotation_about_z(angle)[:size, :size] for angle in angles])
        change = np.einsum("iab,jb->ija", turns, own) - vectors[:, None]  # at i, of the block of j
        weights = information.reshape(len(blocks), size, len(blocks), size)
        here = np.einsum("ija,iaib,ijb->ij", change, weights, change, optimize=True)
        cross = np.einsum("ija,iajb,jib->ij", change, weights, change, optimize=True)
        gain = np.einsum("ija,ia->ij", change, score.reshape(len(blocks), size))
        evidence = gain + gain.T - (here + here.T + 2 * cross) / 2
        one, other = np.triu_indices(len(blocks), 1)
        best = np.argsort(-evidence[one, other])[:SHORTLIST]
        return [Place(blocks[i].ring, blocks[i].slot, other=(blocks[j].ring, blocks[j].slot))
                for i, j in zip(one[best], other[best], strict=True)]

    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        where = [(block.ring, block.slot) for block in scene.blocks]
        here, there = where.index((place.ring, place.slot)), where.index(place.other)
        size, array = scene.study.dimension, scene.study.array
        total = np.zeros_like(scene.points)
        for to, source in ((here, there), (there, here)):
            turn = rotation_about_z(np.radians(position_angle_deg(array, where[to][1])
                                          - position_angle_deg(array, where[source][1])))
            total += scene.field_with(to, turn[:size, :size] @ scene.magnetizations[source]
                                      - scene.magnetizations[to])
        return total[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        here = place.ring, place.slot
        return with_exceptions(study, [
            BlockException(ring=here[0], slot=here[1], mounted_from=place.other),
            BlockException(ring=place.other[0], slot=place.other[1], mounted_from=here)])


EFFECTS = (BlocksSwappedEffect(),)
