"""A ferromagnetic object near the magnet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.external_field import dipole_field
from halbach_fe.study.magnet import PointDipole
from halbach_fe.study.model import Study

STEP_M = 1e-4
"""Step of the finite differences with respect to the position."""

BEYOND_M = (0.03, 0.08, 0.15, 0.25)
"""Distances of the candidate places from the magnet's ends."""


NEAREST_M = 1e-3
"""Distance in m from the object below which a reading shows nothing of it: a place of the grid may
be one where the probe was, and the field of a point dipole is infinite there."""


class FerromagneticObjectEffect(Effect):
    """A small magnetized object, modelled as a point dipole.

    The places are a coarse grid. The refinements are the displacement of the object from its place,
    by short steps: far from the object the field does not say where it is.
    """

    name = "ferromagnetic_object"
    title = "ferromagnetic object near the bore"
    kind = "field"
    is_divisible = False
    parameters = (
        Parameter("x", "A m2", 3.0), Parameter("y", "A m2", 3.0), Parameter("z", "A m2", 3.0),)
    refinements = tuple(Parameter(f"at {axis}", "m", 0.05, longest_step=0.02) for axis in "xyz")

    def places(self, study: Study) -> Sequence[Place]:
        """See `Effect.places`."""
        if study.dimension == 2:
            return []
        magnet = build_magnet(study)
        half, outer = magnet.array_half_length, magnet.array_outer_radius
        radii = [magnet.bore_radius, outer, 1.4 * outer]
        heights = [side * (half + beyond) for side in (-1, 1) for beyond in BEYOND_M]
        ends = [(r, z) for r in radii for z in heights]
        outside = [(1.2 * outer, z) for z in np.linspace(-half, half, 7)]
        angles = 2 * np.pi * np.arange(12) / 12
        axis = [Place(at_m=(0.0, 0.0, float(z))) for z in heights if abs(z) > half + 0.1]
        found = axis + [Place(at_m=(float(r * np.cos(a)), float(r * np.sin(a)), float(z)))
                        for r, z in ends + outside for a in angles]
        inside = magnet.contains(np.array([place.at_m for place in found]))
        return [place for place, within in zip(found, inside, strict=True) if not within]

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        position = np.array(place.at_m)
        return np.array([_field(position, moment, nominal.points) for moment in np.eye(3)])

    def derivative(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.derivative`."""
        position, moment = _at(place, values), np.array(values[:3])
        slopes = [(_field(position + step, moment, nominal.points)
                   - _field(position - step, moment, nominal.points)) / (2 * STEP_M)
                  for step in STEP_M * np.eye(3)]
        fields = [_field(position, unit, nominal.points) for unit in np.eye(3)]
        return np.array([*fields, *slopes])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`.

        Raises
        ------
        StudyError
            If the object is inside a block or iron, where there is no room for it: what a dipole
            there explains is an error of that block.
        """
        if build_magnet(study).contains(_at(place, values)[None]).any():
            raise StudyError(must_be(
                "the ferromagnetic object", f"study {study.name}", "outside of blocks and iron",
                f"{place.name}, inside"))
        x, y, z = map(float, values[:3])
        position_x, position_y, position_z = _at(place, values).tolist()
        dipole = PointDipole(position_m=(position_x, position_y, position_z), moment_A_m2=(x, y, z))
        return study.with_(external__dipoles=(*study.external.dipoles, dipole))

    def refined_place(self, place: Place, values: Sequence[float]) -> Place:
        """See `Effect.refined_place`."""
        return Place(at_m=tuple(_at(place, values).tolist()))

    def reported(self, place: Place, values: Floats, sd: Floats) -> tuple[Floats, Floats]:
        """See `Effect.reported`."""
        if len(values) == len(self.parameters):
            return values, sd
        return np.concatenate([values[:3], _at(place, values.tolist())]), sd


def _field(position: Floats, moment: Floats, points: Floats) -> Floats:
    """Return B (n, 3) in T of a dipole at points (n, 3) in m, 0 nearer than `NEAREST_M`."""
    field = np.zeros_like(points)
    far = np.linalg.norm(points - position, axis=1) >= NEAREST_M
    field[far] = dipole_field(position, moment, points[far])
    return field


def _at(place: Place, values: Sequence[float]) -> Floats:
    """Return the position (3,) in m of the object."""
    return np.array(place.at_m) + (np.array(values[3:]) if len(values) > 3 else 0.0)


EFFECTS = (FerromagneticObjectEffect(),)
