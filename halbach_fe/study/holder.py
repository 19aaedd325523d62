"""Settings of the holder of the blocks: plates with a pocket for every block."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from halbach_fe.study.types import Angle, Gap, Length, StudyModel

SmallGap = Annotated[float, Field(ge=0.0, le=0.02, allow_inf_nan=False)]


class Rods(StudyModel):
    """Holes for threaded rods through all plates, at equal angles on a circle about the z axis.

    ``radius_m`` is that of the circle, by default as small as walls outside of the pockets allow.
    ``first_angle_deg`` is the angle of the first hole to the x axis, by default half a pitch.
    """

    count: Annotated[int, Field(ge=1, le=100)]
    diameter_m: Length
    radius_m: Length | None = None
    first_angle_deg: Angle | None = None


class Holder(StudyModel):
    """Plates across the z axis, each for all blocks at one height, with a pocket for every block.

    Pockets are larger than the blocks by ``clearance_m`` on each side, and open towards +z.
    ``floor_m`` is the thickness of the plate below its blocks: by default 2 mm, or what the gap
    between rings allows; with 0 pockets go through. ``thickness_m`` is the thickness of the plate,
    by default up to the top of its blocks.

    Plates reach from ``inner_radius_m`` (0: they have no bore) to ``outer_radius_m``, by default
    ``inner_rim_m`` and ``outer_rim_m`` beyond the pockets of all plates and the rods. No wall is
    thinner than ``least_wall_m``.

    ``mark_m`` is the depth of the notch in each pocket towards which the magnetization points; 0
    leaves it out. A notch twice as deep in the outer edge shows the x axis, and a small one beside
    it the direction in which angles count. The number of the plate is engraved into its upper face,
    ``engraving_m`` deep; 0 leaves it out. ``corner_relief_m`` is the radius of holes at the corners
    of pockets that a cutter leaves round.
    """

    clearance_m: SmallGap = 1e-4
    floor_m: Gap | None = None
    thickness_m: Length | None = None
    inner_rim_m: Length = 0.003
    outer_rim_m: Length = 0.008
    inner_radius_m: Gap | None = None
    outer_radius_m: Length | None = None
    least_wall_m: SmallGap = 0.001
    mark_m: SmallGap = 0.001
    engraving_m: SmallGap = 5e-4
    corner_relief_m: SmallGap = 0.0
    rods: Rods | None = None

    @model_validator(mode="after")
    def _has_material(self) -> Self:
        inner, outer = self.inner_radius_m, self.outer_radius_m
        if inner is not None and outer is not None and inner >= outer:
            raise ValueError(f"outer_radius_m ({outer}) of the holder must be larger than "
                             f"inner_radius_m ({inner})")
        if self.floor_m is not None and self.thickness_m is not None and (
                self.floor_m >= self.thickness_m):
            raise ValueError(f"thickness_m ({self.thickness_m}) of the holder must be larger than "
                             f"floor_m ({self.floor_m}), which is a part of it")
        return self
