"""The true magnet as plain data: bodies of magnet material, iron, and what else makes a field.

Everything is built anew from a study's radii and angles. A body has axes of its own: x radially
outward through its middle, z along the magnet's axis, y azimuthal (z cross x), the origin in its
middle. Angles are in rad, lengths in m, remanences in T.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study import materials
from halbach_fe.study.magnet import Array, IronRing
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study

Vector = tuple[float, float, float]
NOWHERE: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class SectorBody:
    """A sector of a tube about an axis at x = -(inner + outer) / 2 of its own axes."""

    inner: float
    outer: float
    half_angle: float
    length: float

    @property
    def middle(self) -> float:
        """Distance from the tube's axis to the body's origin."""
        return (self.inner + self.outer) / 2

    @property
    def volume(self) -> float:
        """In m^3."""
        return self.half_angle * (self.outer**2 - self.inner**2) * self.length

    def share(self, u: tuple[float, float], v: tuple[float, float]) -> float:
        """Part of the volume between such fractions, see `part`."""
        radii, angles = self.part(u, v)
        return float(np.diff(angles)[0] * np.diff(radii**2)[0] / 2 / (
            self.half_angle * (self.outer**2 - self.inner**2)))

    def part(self, u: tuple[float, float], v: tuple[float, float]) -> tuple[Floats, Floats]:
        """Radii (2,) and angles (2,) of the part between fractions u of the thickness, from
        inside, and v of the half angle.
        """
        return (self.inner + (self.outer - self.inner) * np.array(u),
                self.half_angle * np.array(v))

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3), in its own axes, are inside or on the surface."""
        x, y, z = points.T
        x = x + self.middle
        radius = np.hypot(x, y)
        return ((radius >= self.inner) & (radius <= self.outer) & (np.abs(z) <= self.length / 2)
                & (np.abs(np.arctan2(y, x)) <= self.half_angle))


@dataclass(frozen=True)
class PrismBody:
    """A trapezoid or cuboid: ``depth`` along x, its widths along y at the inner and outer face.

    ``turn`` is by how much it is turned about z from its own axes.
    """

    depth: float
    inner_width: float
    outer_width: float
    length: float
    turn: float = 0.0

    @property
    def volume(self) -> float:
        """In m^3."""
        return self.depth * (self.inner_width + self.outer_width) / 2 * self.length

    def share(self, u: tuple[float, float], v: tuple[float, float]) -> float:
        """Part of the volume between such fractions, see `part`."""
        middle = self.inner_width + (self.outer_width - self.inner_width) * (u[0] + u[1]) / 2
        return middle * (v[1] - v[0]) * (u[1] - u[0]) / (self.inner_width + self.outer_width)

    def part(self, u: tuple[float, float] = (0.0, 1.0), v: tuple[float, float] = (-1.0, 1.0)
             ) -> Floats:
        """Corners (4, 2), counter-clockwise, of the part between fractions u of the depth, from
        inside, and v of the half width.
        """
        def corner(a: float, b: float) -> tuple[float, float]:
            width = self.inner_width + (self.outer_width - self.inner_width) * a
            return self.depth * (a - 0.5), width / 2 * b

        local = np.array([corner(u[0], v[0]), corner(u[1], v[0]), corner(u[1], v[1]),
                          corner(u[0], v[1])])
        c, s = np.cos(self.turn), np.sin(self.turn)
        return local @ np.array([[c, s], [-s, c]])

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3), in its own axes, are inside or on the surface."""
        corners = self.part()
        inside = np.abs(points[:, 2]) <= self.length / 2
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            (dx, dy), to = end - start, points[:, :2] - start
            inside &= dx * to[:, 1] - dy * to[:, 0] >= 0
        return inside


Shape = SectorBody | PrismBody


@dataclass(frozen=True)
class Part:
    """A part of a body, between fractions of its thickness and half width, whose magnetization is
    ``factor`` times the body's. Where parts of one body overlap, their deviations add up.
    """

    u: tuple[float, float]
    v: tuple[float, float]
    factor: float


@dataclass(frozen=True)
class Body:
    """One block of magnet material.

    Attributes
    ----------
    ring, slot : int
        From 1.
    shape : Sector or Prism
    angle : float
        Of its own x axis about z, before ``rotation``.
    centre : tuple, in m
        Of its own origin, before ``displacement``.
    remanence, easy_axis : tuple
        B_r in T, and the unit vector of the easy axis, in its own axes.
    along, across : float
        Relative recoil permeability along and across the easy axis.
    displacement, rotation : tuple
        In m, and a rotation vector in rad about its own origin, both along the magnet's axes.
    parts : tuple of Part
    room : Sector or Prism, optional
        The shape that finite elements take it for, where its own would leave slits that no mesh
        resolves.
    """

    ring: int
    slot: int
    shape: Shape
    angle: float
    centre: Vector
    remanence: Vector
    easy_axis: Vector
    along: float = 1.0
    across: float = 1.0
    displacement: Vector = NOWHERE
    rotation: Vector = NOWHERE
    parts: tuple[Part, ...] = ()
    room: Shape | None = None

    @property
    def position(self) -> Floats:
        """Of its own origin, (3,) in m."""
        return np.add(self.centre, self.displacement)

    @property
    def orientation(self) -> Rotation:
        """From its own axes to the magnet's."""
        return Rotation.from_rotvec(self.rotation) * Rotation.from_euler("z", self.angle)

    @property
    def mean_factor(self) -> float:
        """Mean magnetization over that outside of its parts."""
        return 1 + sum((part.factor - 1) * self.shape.share(part.u, part.v)
                       for part in self.parts)

    @property
    def permeability(self) -> Floats:
        """Relative recoil permeability in its own axes, (3, 3)."""
        outer = np.outer(self.easy_axis, self.easy_axis)
        return self.across * np.eye(3) + (self.along - self.across) * outer

    @property
    def magnetization(self) -> Floats:
        """M = B_r / (mu_0 mu_r) of ``nu B = H + M`` along the magnet's axes, (3,) in A/m."""
        return self.orientation.apply(
            np.linalg.solve(MU_0 * self.permeability, np.array(self.remanence)))

    def with_magnetization(self, magnetization: Floats) -> Body:
        """The same body with another M, (3,) in A/m along the magnet's axes."""
        own = self.orientation.inv().apply(magnetization)
        return replace(self, remanence=vector(MU_0 * self.permeability @ own))

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m are inside or on the surface."""
        return self.shape.holds(self.orientation.inv().apply(points - self.position))


@dataclass(frozen=True)
class FroehlichLaw:
    """B = mu_0 H + J_s H / (H + h), h following from the initial relative permeability."""

    initial: float
    saturation: float


@dataclass(frozen=True)
class TableLaw:
    """B (n,) in T at H (n,) in A/m, both from 0; J = B - mu_0 H is constant beyond the last."""

    field: tuple[float, ...]
    flux_density: tuple[float, ...]


IronLaw = float | FroehlichLaw | TableLaw
"""Of iron: a constant relative permeability, or a curve."""


@dataclass(frozen=True)
class Tube:
    """An iron tube about the z axis, ``half_length`` to both sides of ``middle``."""

    inner: float
    outer: float
    half_length: float
    law: IronLaw
    middle: float = 0.0

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m are inside or on the surface."""
        radius = np.hypot(points[:, 0], points[:, 1])
        return ((radius >= self.inner) & (radius <= self.outer)
                & (np.abs(points[:, 2] - self.middle) <= self.half_length))


@dataclass(frozen=True)
class Copy:
    """The same magnet once more, elsewhere on its axis, ``shift`` in m along z."""

    shift: float


@dataclass(frozen=True)
class SoftSphere:
    """A small sphere of soft iron of a volume in m^3: the field B where it is gives it the moment
    3 V B / mu_0.
    """

    place: Vector
    volume: float


@dataclass(frozen=True)
class TrueMagnet:
    """All that makes the field. In two dimensions lengths along z are infinite.

    Attributes
    ----------
    bodies : tuple of Body
        Ring by ring, slot by slot.
    iron : Tube, optional
    background : tuple, in T
        A uniform field, which iron and magnets leave as it is.
    copies, objects : tuple
        What else is near.
    """

    dimension: int
    bodies: tuple[Body, ...]
    iron: Tube | None = None
    background: Vector = NOWHERE
    copies: tuple[Copy, ...] = ()
    objects: tuple[SoftSphere, ...] = ()

    @property
    def all_bodies(self) -> tuple[Body, ...]:
        """Those of the copies too."""
        return self.bodies + tuple(
            replace(body, centre=vector(np.add(body.centre, (0, 0, copy.shift))))
            for copy in self.copies for body in self.bodies)

    @property
    def all_iron(self) -> tuple[Tube, ...]:
        """That of the copies too."""
        if self.iron is None:
            return ()
        iron = self.iron
        return (iron, *(replace(iron, middle=iron.middle + copy.shift) for copy in self.copies))

    @property
    def is_vacuum(self) -> bool:
        """Tell whether nothing in it responds to a field."""
        return self.iron is None and all(
            body.along == body.across == 1.0 for body in self.bodies)

    def with_magnetizations(self, magnetizations: Floats) -> TrueMagnet:
        """The same magnet with other M, (bodies, dimension) in A/m along its axes."""
        full = np.zeros((len(self.bodies), 3))
        full[:, :self.dimension] = magnetizations
        return replace(self, bodies=tuple(
            body.with_magnetization(one) for body, one in zip(self.bodies, full, strict=True)))

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m are inside of some material."""
        inside = np.zeros(len(points), bool)
        for body in self.all_bodies:
            inside |= body.holds(points)
        for tube in self.all_iron:
            inside |= tube.holds(points)
        return inside


def vector(values: Floats | tuple[float, ...]) -> Vector:
    """Three numbers as plain ones."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def magnet_of(study: Study) -> TrueMagnet:
    """The nominal magnet of a study."""
    array = study.array
    bodies = tuple(_body(array, ring, slot, z, study.dimension)
                   for ring, z in enumerate(_ring_middles(study), start=1)
                   for slot in range(1, array.blocks_per_ring + 1))
    return TrueMagnet(study.dimension, bodies, _tube(study, study.iron_ring))


def ring_length(study: Study) -> float:
    """Length of a ring in m; infinite in two dimensions."""
    length = study.array.ring_length_m
    return np.inf if study.dimension == 2 or length is None else length


def _ring_middles(study: Study) -> Iterator[float]:
    array = study.array
    if study.dimension == 2:
        yield 0.0
        return
    pitch = ring_length(study) + array.ring_gap_m
    for ring in range(array.rings):
        yield (ring - (array.rings - 1) / 2) * pitch


def _body(array: Array, ring: int, slot: int, z: float, dimension: int) -> Body:
    step = 2 * np.pi / array.blocks_per_ring
    angle = np.radians(array.first_block_angle_deg) + (slot - 1) * step
    nominal = np.radians(array.first_magnetization_angle_deg) + (
        slot - 1) * (array.multipole_order + 1) * step
    direction, remanence = nominal, array.remanence_T
    along = array.recoil_permeability
    across = array.recoil_permeability_across or along
    for one in array.exceptions:  # the last one counts
        if (one.ring or ring, one.slot or slot) != (ring, slot):
            continue
        if one.magnetization_angle_deg is not None:
            direction = np.radians(one.magnetization_angle_deg)
        if one.recoil_permeability is not None:
            along = across = one.recoil_permeability
        if one.recoil_permeability_across is not None:
            across = one.recoil_permeability_across
        if one.remanence_T is not None:
            remanence = one.remanence_T
    length = np.inf if dimension == 2 else float(array.ring_length_m or 0.0)
    shape = _shape(array, length, nominal - angle)
    if remanence is None:
        assert array.block_moment_A_m2 is not None  # the study has one of the two
        solid = replace(shape, length=float(array.ring_length_m or 0.0))
        remanence = MU_0 * array.block_moment_A_m2 / solid.volume
    middle = (array.inner_radius_m + array.outer_radius_m) / 2
    easy = (float(np.cos(direction - angle)), float(np.sin(direction - angle)), 0.0)
    return Body(ring, slot, shape, float(angle),
                (float(middle * np.cos(angle)), float(middle * np.sin(angle)), z),
                vector(remanence * np.array(easy)), easy, along, across)


def _shape(array: Array, length: float, facing: float) -> Shape:
    inner, outer, block = array.inner_radius_m, array.outer_radius_m, array.block
    half = np.pi / array.blocks_per_ring
    if block.shape == "sector":
        return SectorBody(inner, outer, float(half - np.radians(block.angular_gap_deg) / 2), length)
    if block.shape == "trapezoid":
        clearance = block.side_gap_m / np.cos(half)
        inside, outside = (2 * radius * np.tan(half) - clearance for radius in (inner, outer))
        return PrismBody(outer - inner, float(inside), float(outside), length)
    turn = facing if block.orientation == "magnetization" else 0.0
    return PrismBody(outer - inner, block.width_m, block.width_m, length, float(turn))


def _tube(study: Study, ring: IronRing | None) -> Tube | None:
    if ring is None:
        return None
    array = study.array
    half = (array.rings * (ring_length(study) + array.ring_gap_m) - array.ring_gap_m) / 2
    if study.dimension == 3 and ring.length_m is not None:
        half = ring.length_m / 2
    return Tube(ring.inner_radius_m, ring.outer_radius_m, half, law_of(ring))


def law_of(ring: IronRing) -> IronLaw:
    """The law of a study's iron."""
    curve = ring.curve
    if curve is None:
        assert ring.relative_permeability is not None  # the study has one of the two
        return ring.relative_permeability
    if curve.kind == "froehlich_kennelly":
        return FroehlichLaw(curve.initial_relative_permeability, curve.saturation_polarization_T)
    if curve.kind == "brauer":
        # as far as it is a material's: where its slope reaches vacuum's
        b = np.linspace(0, materials.MAX_FLUX_DENSITY, 20_001)
        exponent = np.minimum(curve.k2_per_T2 * b**2, 500)
        slope = curve.k1_m_per_H * np.exp(exponent) * (1 + 2 * exponent) + curve.k3_m_per_H
        b = b[:max(2, int(np.argmax(slope * MU_0 > 1)))]
        h = (curve.k1_m_per_H * np.exp(curve.k2_per_T2 * b**2) + curve.k3_m_per_H) * b
        return TableLaw(tuple(h.tolist()), tuple(b.tolist()))
    if curve.kind == "steel":
        field, flux_density = materials.read_table(materials.steels()[curve.name])
    elif curve.file is not None:
        raise StudyError(must_be("`iron_ring.curve.file`", "study",
                                 "read together with the study's own file", f"'{curve.file}'"))
    else:
        field, flux_density = curve.H_A_per_m, curve.B_T
    start = () if field[0] == 0 else (0.0,)
    return TableLaw((*start, *field), (*start, *flux_density))
