"""Keys of a study that describe fields from outside the magnet: coils, neighbours and dipoles."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study.types import (
    Angle,
    FluxDensityVector,
    Gap,
    Length,
    Moment,
    Place,
    Places,
    Point,
    Rotation,
    StudyModel,
)


class Neighbour(StudyModel):
    """Another magnet with the same blocks, in vacuum, on the same axis.

    It is moved by ``z_m`` from where this magnet is, and rotated by ``turn_deg`` about the axis;
    its magnetizations are those of this magnet multiplied by ``factor``. It must stand clear of
    this magnet and of other neighbours, and needs a 3D study.
    """

    z_m: Place
    turn_deg: Angle = 0.0
    factor: Annotated[float, Field(ge=-10.0, le=10.0)] = 1.0


class PointDipole(StudyModel):
    """A distant magnetized object, approximated by a point dipole."""

    position_m: Point
    moment_A_m2: tuple[Moment, Moment, Moment]


class Coil(StudyModel):
    """A coil of ``turns`` turns, through which ``current_A`` flows counter-clockwise about its z.

    ``centre_m`` is where the origin of its own axes lies, and the rotation vector ``rotation_deg``
    turns the magnet's axes into them.
    """

    current_A: Annotated[float, Field(ge=-1e7, le=1e7)]
    turns: Annotated[int, Field(ge=1, le=10**6)] = 1
    centre_m: Places = (0.0, 0.0, 0.0)
    rotation_deg: Rotation = (0.0, 0.0, 0.0)


class WoundCoil(Coil):
    """A coil wound in a rectangular section, ``section_m``: across the turns, and along its z.

    The current is uniform in the section; a side of 0 makes a sheet, and two of them a thin wire.
    """

    section_m: tuple[Gap, Gap] = (0.0, 0.0)


class RoundCoil(WoundCoil):
    """A loop or, if its section is long, a solenoid, of the mean radius ``radius_m``."""

    kind: Literal["round"]
    radius_m: Length

    @model_validator(mode="after")
    def _wound(self) -> RoundCoil:
        if self.section_m[0] >= 2 * self.radius_m:
            raise ValueError(f"section_m[0] ({self.section_m[0]}) must be less than twice radius_m")
        return self


class Racetrack(WoundCoil):
    """A rectangle with round corners, of ``size_m`` along its own x and y, in the section's middle.

    ``corner_radius_m`` is there too. The field takes each corner as chords around the same
    area, 12 or, near them, more.
    """

    kind: Literal["racetrack"]
    size_m: tuple[Length, Length]
    corner_radius_m: Gap = 0.0

    @model_validator(mode="after")
    def _closed(self) -> Racetrack:
        if 2 * self.corner_radius_m > min(self.size_m):
            raise ValueError(f"corner_radius_m ({self.corner_radius_m}) must be at most half of "
                             "both sides of size_m")
        if self.section_m[0] > 2 * self.corner_radius_m:
            raise ValueError(f"corner_radius_m ({self.corner_radius_m}) must be at least half of "
                             "section_m[0]: turns are bent around the inner ones")
        return self


class PolygonCoil(Coil):
    """A closed polygon of thin wire with the corners ``points_m`` along its own axes.

    The current flows in their order.
    """

    kind: Literal["polygon"]
    points_m: Annotated[tuple[Point, ...], Field(min_length=3, max_length=10_000)]


AnyCoil = Annotated[RoundCoil | Racetrack | PolygonCoil, Field(discriminator="kind")]


class External(StudyModel):
    """Fields of sources outside the magnet, added to its field.

    ``background_T`` is uniform. Iron that is no coaxial tube or disc, nor a prism with equal rings,
    and the blocks beside it answer to external fields, as do blocks with irreversible losses
    without iron. In all other magnets that is neglected.
    """

    background_T: FluxDensityVector = (0.0, 0.0, 0.0)
    neighbours: tuple[Neighbour, ...] = ()
    dipoles: tuple[PointDipole, ...] = ()
    coils: Annotated[tuple[AnyCoil, ...], Field(max_length=1000)] = ()

    @property
    def stated(self) -> list[str]:
        """The kinds of sources that are stated, in words."""
        return [name for name, given in (
            ("coils", self.coils), ("neighbours", self.neighbours), ("dipoles", self.dipoles),
            ("the background", any(self.background_T))) if given]

    @property
    def doubts(self) -> list[str]:
        """Sentences about fields that are stronger than surroundings make them."""
        strong_t = 0.02  # 400 times the earth's field; some rooms of MRI magnets have that
        found = []
        if (size := float(np.linalg.norm(self.background_T))) > strong_t:
            found.append(
                f"`external.background_T` is {1e3 * size:.3g} mT, {size / 5e-5:.0f} times the "
                "earth's field of 5e-5 T. Was another unit than tesla meant? 1 G is 1e-4 T.")
        for number, one in enumerate(self.dipoles, start=1):
            distance = max(float(np.linalg.norm(one.position_m)), 1e-6)
            field = 2e-7 * float(np.linalg.norm(one.moment_A_m2)) / distance**3  # on its axis
            if field > strong_t:
                found.append(
                    f"`external.dipoles[{number}]` makes up to {1e3 * field:.3g} mT at the origin, "
                    f"{field / 5e-5:.3g} times the earth's field. Are position_m in metres and "
                    "moment_A_m2 in A m²? 1 A mm² is 1e-6 A m².")
        return found


def check_apart(external: External, points: Floats, study: str) -> None:
    """Refuse points (n, 3) in m at a dipole, where its field is infinite.

    Raises
    ------
    StudyError
    """
    # Smallest distance of a reading from a point dipole: nearer than any probe can be.
    closest_m = 1e-6
    for number, dipole in enumerate(external.dipoles, start=1):
        distance = np.linalg.norm(points - np.array(dipole.position_m), axis=1)
        if len(points) and distance.min() < closest_m:
            x, y, z = points[np.argmin(distance)]
            raise StudyError(must_be(
                f"`external.dipoles[{number}].position_m`", f"study {study}",
                f"at least {1e6 * closest_m:g} µm from the readings",
                f"the place of the reading at ({x:g}, {y:g}, {z:g}) m",
                "An object that near is no point; leave it or the reading out."))
