"""Settings of a shim tray: the places of small magnets, and an inventory to fill them from."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from halbach_fe.study.material_keys import Material
from halbach_fe.study.types import (
    Angle,
    Coordinate,
    Length,
    Line,
    Point,
    Remanence,
    StudyModel,
    one_or_list,
)

MOST_PLACES = 2000
"""Largest number of places of a tray, which limits memory and time."""


class TrayRing(StudyModel):
    """Places at equal angles on circles about the z axis.

    ``first_angle_deg`` is the angle of the first place to the x axis.
    """

    radius_m: Length
    count: Annotated[int, Field(ge=1, le=MOST_PLACES)]
    z_m: Annotated[tuple[Coordinate, ...], one_or_list(Coordinate), Field(min_length=1)] = (0.0,)
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
                             f"{step}, so that it fits into its place")
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
