"""Settings of a design search: which rings may stand where, and what is asked of the magnet."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from halbach_fe.study.array import BlocksPerRing
from halbach_fe.study.types import Gap, Length, StudyModel

MOST_RADII = 200
"""Largest number of radii of a layer, which limits memory and time."""


class DesignLayer(StudyModel):
    """Rings of one layer, of which every place along z holds one.

    ``radii_m`` are those of the blocks' middles. ``sizes_m`` are thicknesses along the radius, by
    default the array's; cuboids are cubes of these sizes. ``blocks_per_ring`` has a number for
    each radius, by default the largest for which blocks are at least ``gap_m`` apart. If
    ``may_be_empty``, a place may have no ring of this layer.
    """

    radii_m: Annotated[tuple[Length, ...], Field(min_length=1, max_length=MOST_RADII)]
    sizes_m: tuple[Length, ...] = ()
    blocks_per_ring: tuple[BlocksPerRing, ...] = ()
    gap_m: Gap = 0.0
    may_be_empty: bool = False

    @model_validator(mode="after")
    def _one_number_for_each(self) -> Self:
        if self.blocks_per_ring and len(self.blocks_per_ring) != len(self.radii_m):
            raise ValueError(f"blocks_per_ring of a layer has {len(self.blocks_per_ring)} numbers "
                             f"for {len(self.radii_m)} radii_m; give one for each, or none")
        if len(set(self.radii_m)) < len(self.radii_m):
            raise ValueError("two radii_m of a layer are equal")
        return self


class Design(StudyModel):
    """What a design search may choose, and what it must reach.

    ``rings`` places are ``spacing_m`` apart along z, middle to middle, and centred at z = 0. Places
    at z and -z hold equal rings. With ``layers_together`` the layers of a place take the radius of
    the same number in their lists, and are empty together.

    The search makes ``objective`` small, the deviation of the field in a region, with a mean field
    of at least ``least_field_T`` and a mass of blocks of at most ``most_mass_kg``. If
    ``between_radii``, any radius between the smallest and the largest of a layer is allowed.
    """

    rings: Annotated[int, Field(ge=1, le=200)]
    spacing_m: Length
    layer: Annotated[tuple[DesignLayer, ...], Field(min_length=1, max_length=4)]
    layers_together: bool = False
    objective: Literal["peak_to_peak", "rms"] = "peak_to_peak"
    least_field_T: Annotated[float, Field(gt=0.0, le=10.0)] | None = None
    most_mass_kg: Annotated[float, Field(gt=0.0, le=1e6)] | None = None
    between_radii: bool = False

    @model_validator(mode="after")
    def _equal_lists(self) -> Self:
        if self.layers_together and len({
                (len(layer.radii_m), len(layer.sizes_m)) for layer in self.layer}) > 1:
            raise ValueError("layers_together needs as many radii_m and sizes_m in every layer")
        if self.between_radii and self.objective == "rms":
            raise ValueError("between_radii needs the objective peak_to_peak")
        return self
