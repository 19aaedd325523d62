"""A hypothesis of a diagnosis: an effect at a place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from halbach_fe.diagnosis.effects.base import Effect, Place
from halbach_fe.study.model import Study


@dataclass(frozen=True)
class Hypothesis:
    """An effect at a place.

    Attributes
    ----------
    effect : Effect
    place : Place
        Block, ring, seam or point at which the effect acts, or the instrument that it changes;
        empty for effects of the whole magnet.
    """

    effect: Effect
    place: Place

    def apply(self, study: Study, values: Sequence[float]) -> Study:
        """Return the study with the effect, see `Effect.apply`; in a campaign, in its maps."""
        if not self.place.maps:
            return self.effect.apply(study, self.place, values)
        return study.with_tables({
            one.name: {"instrument": self.effect.apply(
                study.of_map(number), self.place, values).instrument}
            for number, one in enumerate(study.maps) if one.name in self.place.maps})
