"""Keys of a study that describe fields of other sources, and the resistance to demagnetization."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study.types import (
    RISING_PER_K,
    Angle,
    FluxDensityVector,
    Gap,
    Length,
    Moment,
    Place,
    Places,
    Point,
    ReferenceTemperature,
    RemanenceCoefficient,
    Rotation,
    StudyModel,
    Temperature,
)

MOST_SQUARE = 0.99
"""Largest squareness for which irreversible losses are computed."""


class Neighbour(StudyModel):
    """Another magnet with the same blocks, in vacuum, on the same axis.

    Its middle is at ``z_m``; it is rotated by ``turn_deg`` about the axis, and its magnetizations
    are those of this magnet multiplied by ``factor``. It must stand clear of this magnet and of
    other neighbours, and needs a 3D study.
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
    and the blocks beside it answer to external fields. In all other magnets that is neglected.
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


class Demagnetization(StudyModel):
    """Resistance of the magnet material to demagnetization, and the temperature to assess it at.

    Remanence (of ``array``) and intrinsic coercivity are the data-sheet values at
    ``reference_temperature_C``; both change linearly with temperature, by the fraction
    ``..._coefficient_per_K`` per kelvin. ``temperature_C`` is the highest temperature of the
    magnet. The knee of the demagnetization curve is at ``squareness`` times the intrinsic
    coercivity, where the polarization is a tenth below the remanence (H_k of IEC 60404-8-1).

    With ``irreversible`` the blocks have lost for good what the field that they are in takes, and
    the field of the magnet is that with the losses; see `halbach_fe.solver.moments.solve`.
    The remanence is then that of blocks which have lost nothing. This needs a magnet in 3D.
    """

    # of AlNiCo at least 38e3 A/m; numbers of NdFeB in oersted end at 36e3
    intrinsic_coercivity_A_per_m: Annotated[float, Field(ge=3.6e4, le=5e6)]
    squareness: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9
    remanence_coefficient_per_K: RemanenceCoefficient
    coercivity_coefficient_per_K: Annotated[float, Field(ge=-0.02, le=0.02)]
    reference_temperature_C: ReferenceTemperature = 20.0
    temperature_C: Temperature = 20.0
    irreversible: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> Demagnetization:
        # Temperature coefficient of the remanence above which a magnet is no ferrite, which has
        # -0.002/K; that of NdFeB is -0.0012/K, of SmCo -0.0004/K and of AlNiCo -0.0002/K.
        ferrite_per_k = -1.5e-3
        if self.irreversible and self.squareness > MOST_SQUARE:
            raise ValueError(f"squareness must be at most {MOST_SQUARE} for irreversible losses, "
                             f"not {self.squareness}; the polarization would jump at the knee")
        if self.coercivity_coefficient_per_K > RISING_PER_K and (
                self.remanence_coefficient_per_K > ferrite_per_k):
            raise ValueError(
                f"coercivity_coefficient_per_K ({self.coercivity_coefficient_per_K}) lets the "
                "coercivity rise with the temperature, as that of ferrite alone does, but "
                f"remanence_coefficient_per_K ({self.remanence_coefficient_per_K}) is not that of "
                "ferrite; other magnets have a negative one")
        if self.remanence_coefficient_per_K < ferrite_per_k and self.worst_when_cold and (
                self.coercivity_coefficient_per_K <= RISING_PER_K):
            raise ValueError(
                f"remanence_coefficient_per_K ({self.remanence_coefficient_per_K}) is that of "
                "ferrite, whose coercivity rises with the temperature, but "
                f"coercivity_coefficient_per_K is {self.coercivity_coefficient_per_K}; are the two "
                "exchanged?")
        for name, coefficient in (("remanence", self.remanence_coefficient_per_K),
                                  ("coercivity", self.coercivity_coefficient_per_K)):
            if 1 + coefficient * (self.temperature_C - self.reference_temperature_C) <= 0:
                raise ValueError(f"{name}_coefficient_per_K ({coefficient}) makes the {name} zero "
                                 f"or negative at {self.temperature_C:g} °C; use a fraction per "
                                 "kelvin, not per cent, and a temperature in °C, not in kelvin, "
                                 "that the linear law holds for")
        return self

    @property
    def worst_when_cold(self) -> bool:
        """Whether the coercivity falls less with the temperature than the field that opposes it.

        That field is proportional to the remanence. The coercivity of ferrite even rises.
        """
        return self.coercivity_coefficient_per_K > self.remanence_coefficient_per_K
