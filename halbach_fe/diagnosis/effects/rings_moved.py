"""Rings, or halves of the magnet, that were exchanged, turned by slots, or put in upside down."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.diagnosis.effects.assembly import AssemblyEffect, Sources
from halbach_fe.diagnosis.effects.base import Place
from halbach_fe.geometry.fitting_turns import moves_of_rings
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.study.model import Study

KINDS = ("exchanged", "turned", "upside down")
"""Moves of rings, the simplest first."""


class RingsMovedEffect(AssemblyEffect):
    """Whole rings are moved, after which every block fits a slot again."""

    def __init__(self, name: str, title: str, move: str) -> None:
        self.name = name  # type: ignore[misc]
        self.title = title  # type: ignore[misc]
        self.move = move

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        return [Place(words=words) for words in moves_of_rings(build_magnet(study), self.move)]

    def simpler(self, magnet: Magnet) -> Sequence[Sources]:
        """See `AssemblyEffect.simpler`: a ring of a regular order that is upside down may be equal
        to one that is turned, and exchanged halves to turned ones.
        """
        kinds = KINDS[:KINDS.index(self.move)]
        return [(move.pairs, np.array(move.turn)) for kind in kinds
                for move in moves_of_rings(magnet, kind).values()]

    def sources(self, magnet: Magnet, place: Place) -> Sources:
        """See `AssemblyEffect.sources`."""
        move = moves_of_rings(magnet, self.move)[place.words]
        return move.pairs, np.array(move.turn)


EFFECTS = (
    RingsMovedEffect("rings_swapped", "two rings or halves that changed places", "exchanged"),
    RingsMovedEffect("rings_turned", "ring or half turned by slots", "turned"),
    RingsMovedEffect("rings_upside_down", "ring or half put in upside down", "upside down"))
