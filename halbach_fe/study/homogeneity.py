"""Settings of a homogeneous field: the region in which the field is to deviate little."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from halbach_fe.study.types import Length, Point, StudyModel


class HomogeneityRegion(StudyModel):
    """The region in which the field is to be homogeneous (in MRI: the DSV).

    It is a sphere of radius ``sphere_m``, an ellipsoid of half axes ``ellipsoid_m`` along x, y and
    z, or a cylinder along z of radius and length ``cylinder_m``, about ``centre_m``. A study with
    this table asks for a homogeneous field: `tolerance` and `sort` work for the deviation of |B|
    in the region in ppm, instead of for multipoles.
    """

    sphere_m: Length | None = None
    ellipsoid_m: tuple[Length, Length, Length] | None = None
    cylinder_m: tuple[Length, Length] | None = None
    centre_m: Point = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        shapes = (self.sphere_m, self.ellipsoid_m, self.cylinder_m)
        if sum(shape is not None for shape in shapes) != 1:
            raise ValueError("give one of sphere_m, ellipsoid_m and cylinder_m as the region of a "
                             "homogeneous field")
        return self
