"""The true iron: material laws, and tubes, prisms and balls in any place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Bools, Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study import materials
from halbach_fe.study.iron import Iron, IronMaterial
from halbach_fe.study.magnet import External
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.synthetic.shapes import PolygonBody, Vector, shoelace


@dataclass(frozen=True)
class FroehlichLaw:
    """The Froehlich-Kennelly law of iron, B = mu_0 H + J_s H / (H + h)."""

    initial: float
    """Initial relative permeability, from which h follows."""
    saturation: float
    """Saturation polarization J_s. In T."""


@dataclass(frozen=True)
class TableLaw:
    """An H(B) table of iron."""

    field: tuple[float, ...]
    flux_density: tuple[float, ...]
    """H in A/m and B in T, rising from 0. The polarization J = B - mu_0 H is constant beyond the
    last entry."""


IronLaw = float | FroehlichLaw | TableLaw
"""Material law of iron: a constant relative permeability, or a curve."""


@dataclass(frozen=True, kw_only=True)
class IronShape:
    """What all bodies of iron have: a place, and perhaps a material of their own."""

    origin: Vector = (0.0, 0.0, 0.0)
    turn: Vector = (0.0, 0.0, 0.0)
    """Place of the origin of the body's own axes, and the rotation vector that turns the magnet's
    axes into them. In m and rad."""
    law: IronLaw | None = None
    """Its own material."""

    def in_own_axes(self, points: Floats) -> Floats:
        """Return the coordinates (n, 3) in m, in the body's axes, of points (n, 3) in m."""
        return np.asarray(Rotation.from_rotvec(self.turn).inv().apply(points - self.origin))


@dataclass(frozen=True)
class Tube(IronShape):
    """An iron tube about its z axis; a disc if its inner radius is 0."""

    inner: float
    outer: float
    """Radii. In m."""
    half_length: float
    """Distance from the middle to each end. In m."""
    middle: float = 0.0
    """Position of the middle along z. In m."""

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m are inside or on the surface."""
        x, y, z = self.in_own_axes(points).T
        radius = np.hypot(x, y)
        return ((radius >= self.inner) & (radius <= self.outer)
                & (np.abs(z - self.middle) <= self.half_length))


@dataclass(frozen=True)
class Pole(IronShape):
    """A prism of iron along its z axis."""

    outline: tuple[complex, ...]
    """Corners x + iy of its section, counter-clockwise. In m."""
    half_length: float
    """Distance from the middle to each end. In m."""
    middle: float = 0.0
    """Position of the middle along z. In m."""

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m are inside or on the surface."""
        return PolygonBody(self.outline, 2 * self.half_length).holds(
            self.in_own_axes(points) - [0, 0, self.middle])


@dataclass(frozen=True)
class Ball(IronShape):
    """A sphere of iron of a ``radius`` in m about its origin."""

    radius: float

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m are inside or on the surface."""
        return np.asarray(np.linalg.norm(points - self.origin, axis=1) <= self.radius)


@dataclass(frozen=True)
class TrueIron:
    """Bodies of iron, and the material of those without their own."""

    bodies: tuple[Tube | Pole | Ball, ...]
    law: IronLaw

    @property
    def laws(self) -> dict[str, IronLaw]:
        """The materials by the names of their regions, see `region`."""
        return {self.region(number): body.law or self.law
                for number, body in enumerate(self.bodies)}

    def region(self, number: int) -> str:
        """Return the name of the region in a mesh of a body: all of one material share theirs."""
        return "iron" if self.bodies[number].law is None else f"iron{number}"


def iron_of_study(study: Study, half_length: float) -> TrueIron | None:
    """Return the iron of a study whose nominal blocks end at z = +- ``half_length`` in m.

    Raises
    ------
    StudyError
        If the iron would answer to an external field, which no truth knows.
    """
    def half(length: float | None) -> float:
        if study.dimension == 2:
            return np.inf
        return half_length if length is None else length / 2

    ring, iron = study.iron_ring, study.iron
    if ring is not None:
        return TrueIron((Tube(ring.inner_radius_m, ring.outer_radius_m, half(ring.length_m)),),
                        law_of(ring))
    if iron is None:
        return None
    bodies: list[Tube | Pole | Ball] = []
    for body in iron.each:
        if body.kind == "stl" or body.kind == "revolved" or (
                body.kind == "prism" and body.holes):
            raise StudyError(must_be(
                "`iron.bodies`", f"study {study.name}", "of boxes, prisms without holes, tubes and "
                "spheres to simulate a campaign", "a body of an STL file, a profile or with holes",
                "The field of the magnet can be computed with it."))
        own = body.own_material
        placed: dict[str, Any] = {
            "origin": body.centre_m, "law": None if own is None else law_of(own),
            "turn": tuple(np.radians(body.rotation_deg).tolist())}
        if body.kind == "sphere":
            bodies.append(Ball(body.radius_m, **placed))
        elif body.kind == "box":
            x, y, z = (size / 2 for size in body.size_m)
            bodies.append(Pole((-x - 1j * y, x - 1j * y, x + 1j * y, -x + 1j * y), z, **placed))
        elif body.kind == "tube":
            bodies.append(Tube(body.inner_radius_m, body.outer_radius_m, half(body.length_m),
                               0.0 if study.dimension == 2 else body.z_m, **placed))
        else:
            corners = np.array([complex(x, y) for x, y in body.outline_m])
            if shoelace(corners) < 0:
                corners = corners[::-1]
            for turn in np.exp(2j * np.pi * np.arange(body.copies) / body.copies):
                bodies.append(Pole(
                    tuple((corners * turn).tolist()), half(body.length_m),
                    0.0 if study.dimension == 2 else body.z_m, **placed))
    found = TrueIron(tuple(bodies), law_of(iron))
    if study.external != External() and ((study.array.free_blocks is not None and not all(
            isinstance(body, Tube) for body in bodies)) or any(map(_is_anywhere, bodies))):
        raise StudyError(must_be(
            "`external`", f"study {study.name}", "left out to simulate a campaign of a magnet with "
            "such iron", "given", "The field of the magnet can be computed with it."))
    return found


def _is_anywhere(body: Tube | Pole | Ball) -> bool:
    """Tell whether a body is none of the tubes and prisms along z of one material."""
    return isinstance(body, Ball) or body.law is not None or any((*body.origin, *body.turn))


def law_of(iron: IronMaterial | Iron) -> IronLaw:
    """Return the material law of a study's iron.

    Raises
    ------
    StudyError
        If the H(B) curve is in a file that has not been read.
    """
    curve = iron.curve
    if curve is None:
        return iron.relative_permeability or 1.0  # without it, every body has its own material
    if curve.kind == "froehlich_kennelly":
        return FroehlichLaw(curve.initial_relative_permeability, curve.saturation_polarization_T)
    if curve.kind == "brauer":
        # up to the flux density where dB/dH falls to mu_0: beyond it Brauer's law is unphysical
        b = np.linspace(0, materials.MAX_FLUX_DENSITY, 20_001)
        exponent = np.minimum(curve.k2_per_T2 * b**2, 500)
        slope = curve.k1_m_per_H * np.exp(exponent) * (1 + 2 * exponent) + curve.k3_m_per_H
        b = b[:max(2, int(np.argmax(slope * MU_0 > 1)))]
        h = (curve.k1_m_per_H * np.exp(curve.k2_per_T2 * b**2) + curve.k3_m_per_H) * b
        return TableLaw(tuple(h.tolist()), tuple(b.tolist()))
    if curve.kind == "steel":
        field, flux_density = materials.read_table(materials.steels()[curve.name])
    elif curve.file is not None:
        raise StudyError(must_be("`curve.file` of the iron", "study",
                                 "read together with the study's own file", f"'{curve.file}'",
                                 "Read the study with halbach_fe.study.reader.read_study."))
    else:
        field, flux_density = curve.H_A_per_m, curve.B_T
    start = () if field[0] == 0 else (0.0,)
    return TableLaw((*start, *field), (*start, *flux_density))
