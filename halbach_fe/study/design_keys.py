"""Keys of a study that describe what is designed: rings, region, shim tray and holder."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from halbach_fe.study.array_keys import BlocksPerRing
from halbach_fe.study.materials import Material
from halbach_fe.study.types import (
    Angle,
    Gap,
    Length,
    Line,
    Place,
    Point,
    Remanence,
    StudyModel,
    one_or_list,
)

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


class HomogeneityRegion(StudyModel):
    """The region in which the field is to be homogeneous (in MRI: the DSV).

    It is a sphere of radius ``sphere_m``, an ellipsoid of half axes ``ellipsoid_m`` along x, y and
    z, or a cylinder along z of radius and length ``cylinder_m``, about ``centre_m`` (default: the
    middle of the magnet along z, on the z axis). A study with this table asks for a homogeneous
    field: `tolerance` and `sort` work for the deviation of |B| in the region in ppm, instead of for
    multipoles.
    """

    sphere_m: Length | None = None
    ellipsoid_m: tuple[Length, Length, Length] | None = None
    cylinder_m: tuple[Length, Length] | None = None
    centre_m: Point | None = None

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        shapes = (self.sphere_m, self.ellipsoid_m, self.cylinder_m)
        if sum(shape is not None for shape in shapes) != 1:
            raise ValueError("give one of sphere_m, ellipsoid_m and cylinder_m as the region of a "
                             "homogeneous field")
        return self


MOST_PLACES = 2000
"""Largest number of places of a tray, which limits memory and time."""


class TrayRing(StudyModel):
    """Places at equal angles on circles about the z axis.

    ``first_angle_deg`` is the angle of the first place to the x axis.
    """

    radius_m: Length
    count: Annotated[int, Field(ge=1, le=MOST_PLACES)]
    z_m: Annotated[tuple[Place, ...], one_or_list(Place), Field(min_length=1)] = (0.0,)
    first_angle_deg: Angle = 0.0


class ShimMagnet(StudyModel):
    """Cuboids of one kind that are there to fill a tray.

    ``size_m`` is along the radius, the azimuth and z of a place; the radius of a place on the z
    axis is the x axis. The polarization lies across z, at one of ``angles_deg`` from the radius,
    counted counter-clockwise: multiples of 90 degrees for a square, those of 180 degrees otherwise,
    as magnets are turned in their place.
    """

    name: Annotated[Line, Field(min_length=1, max_length=100)]
    size_m: tuple[Length, Length, Length]
    remanence_T: Remanence | None = None
    material: Material | None = None
    count: Annotated[int, Field(ge=1, le=1_000_000)]
    angles_deg: Annotated[tuple[Angle, ...], Field(min_length=1, max_length=4)] = (
        0.0, 90.0, 180.0, 270.0)

    @model_validator(mode="after")
    def _turns_in_its_place(self) -> Self:
        step = 90 if self.size_m[0] == self.size_m[1] else 180
        if any(angle % step for angle in self.angles_deg):
            raise ValueError(f"angles_deg of shim magnet '{self.name}' must be multiples of "
                             f"{step}, so that it fits into its place; write angles_deg = "
                             f"{list(range(0, 360, step))}")
        return self

    @model_validator(mode="after")
    def _has_strength(self) -> Self:
        if (self.remanence_T is None) == (self.material is None):
            raise ValueError("give either remanence_T or material of a shim magnet")
        return self


class ShimTray(StudyModel):
    """Places for small magnets, and the magnets that are there.

    Places are those of ``rings``, in their order, followed by ``places_m``. ``strength_sd`` is the
    relative standard deviation of the field of each magnet, and ``common_sd`` that of all together:
    of the remanence of a delivery, and of what permeable blocks answer, which is left out.
    """

    rings: tuple[TrayRing, ...] = ()
    places_m: tuple[Point, ...] = ()
    magnets: Annotated[tuple[ShimMagnet, ...], Field(min_length=1)]
    strength_sd: Annotated[float, Field(ge=0.0, le=0.5)] = 0.02
    common_sd: Annotated[float, Field(ge=0.0, le=0.5)] = 0.02

    @model_validator(mode="after")
    def _has_places(self) -> Self:
        count = sum(ring.count * len(ring.z_m) for ring in self.rings) + len(self.places_m)
        if not 0 < count <= MOST_PLACES:
            raise ValueError(f"a shim tray needs 1 to {MOST_PLACES} places by rings or places_m, "
                             f"not {count}")
        names = [magnet.name for magnet in self.magnets]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"two of the shim magnets are called '{twice}'")
        return self


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
        for side, rim, radius in (("inner", self.inner_rim_m, inner),
                                  ("outer", self.outer_rim_m, outer)):
            # a study that halbach-fe wrote states defaults too
            if radius is not None and rim != type(self).model_fields[f"{side}_rim_m"].default:
                raise ValueError(f"give either {side}_radius_m ({radius}) or {side}_rim_m ({rim}) "
                                 "of the holder; the radius leaves the rim no effect")
        if self.floor_m is not None and self.thickness_m is not None and (
                self.floor_m >= self.thickness_m):
            raise ValueError(f"thickness_m ({self.thickness_m}) of the holder must be larger than "
                             f"floor_m ({self.floor_m}), which is a part of it")
        return self
