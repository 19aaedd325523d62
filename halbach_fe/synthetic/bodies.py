"""The true magnet of a synthetic campaign as plain data: blocks, iron and other sources of field.

Everything is built from a study's radii and angles without `halbach_fe.geometry`, so that an error
of the geometry of halbach-fe cannot hide in the synthetic data as well.

Each body has its own axes: the origin is in its middle, x points radially outward through it, z is
along the magnet's axis, and y is azimuthal (z cross x). Angles are in rad, lengths in m, remanences
in T.
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
from halbach_fe.study.array import Array
from halbach_fe.study.iron import IronRing
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study

Vector = tuple[float, float, float]
ZERO_VECTOR: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class SectorBody:
    """A sector of a tube, whose axis is at x = -(inner + outer) / 2 in the body's own axes.

    Attributes
    ----------
    inner, outer : float, in m
        Radii.
    half_angle : float, in rad
        Half of the angle that the sector spans.
    length : float, in m
        Length along z; infinite in two dimensions.
    """

    inner: float
    outer: float
    half_angle: float
    length: float

    @property
    def middle(self) -> float:
        """Distance in m from the tube's axis to the body's origin, the mean radius."""
        return (self.inner + self.outer) / 2

    @property
    def volume(self) -> float:
        """The volume in m^3."""
        return self.half_angle * (self.outer**2 - self.inner**2) * self.length

    def share(self, u: tuple[float, float], v: tuple[float, float]) -> float:
        """Return the fraction of the body's volume that a part has; u and v are as in `part`."""
        radii, angles = self.part(u, v)
        return float(np.diff(angles)[0] * np.diff(radii**2)[0] / 2 / (
            self.half_angle * (self.outer**2 - self.inner**2)))

    def part(self, u: tuple[float, float], v: tuple[float, float]) -> tuple[Floats, Floats]:
        """Return the limiting radii (2,) in m and angles (2,) in rad of a part.

        The part lies between the fractions u of the thickness, from 0 inside to 1 outside, and
        between the fractions v of the half angle, from -1 to 1.
        """
        return (self.inner + (self.outer - self.inner) * np.array(u),
                self.half_angle * np.array(v))

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m, in the body's own axes, are inside or on the surface."""
        x, y, z = points.T
        x = x + self.middle
        radius = np.hypot(x, y)
        return ((radius >= self.inner) & (radius <= self.outer) & (np.abs(z) <= self.length / 2)
                & (np.abs(np.arctan2(y, x)) <= self.half_angle))


@dataclass(frozen=True)
class PrismBody:
    """A trapezoidal prism or a cuboid.

    Attributes
    ----------
    depth : float, in m
        Extent along x.
    inner_width, outer_width : float, in m
        Extents along y at the inner and the outer face.
    length : float, in m
        Length along z; infinite in two dimensions.
    turn : float, in rad
        Angle about z by which the prism is turned relative to the body's own axes.
    """

    depth: float
    inner_width: float
    outer_width: float
    length: float
    turn: float = 0.0

    @property
    def volume(self) -> float:
        """The volume in m^3."""
        return self.depth * (self.inner_width + self.outer_width) / 2 * self.length

    def share(self, u: tuple[float, float], v: tuple[float, float]) -> float:
        """Return the fraction of the body's volume that a part has; u and v are as in `part`."""
        middle = self.inner_width + (self.outer_width - self.inner_width) * (u[0] + u[1]) / 2
        return middle * (v[1] - v[0]) * (u[1] - u[0]) / (self.inner_width + self.outer_width)

    def part(self, u: tuple[float, float] = (0.0, 1.0), v: tuple[float, float] = (-1.0, 1.0)
             ) -> Floats:
        """Return the corners (4, 2) in m, counter-clockwise, of a part; by default of the whole.

        The part lies between the fractions u of the depth, from 0 inside to 1 outside, and between
        the fractions v of the half width, from -1 to 1.
        """
        def corner(a: float, b: float) -> tuple[float, float]:
            width = self.inner_width + (self.outer_width - self.inner_width) * a
            return self.depth * (a - 0.5), width / 2 * b

        local = np.array([corner(u[0], v[0]), corner(u[1], v[0]), corner(u[1], v[1]),
                          corner(u[0], v[1])])
        c, s = np.cos(self.turn), np.sin(self.turn)
        return local @ np.array([[c, s], [-s, c]])

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m, in the body's own axes, are inside or on the surface."""
        corners = self.part()
        inside = np.abs(points[:, 2]) <= self.length / 2
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            (dx, dy), to = end - start, points[:, :2] - start
            inside &= dx * to[:, 1] - dy * to[:, 0] >= 0
        return inside


Shape = SectorBody | PrismBody


@dataclass(frozen=True)
class BodyPart:
    """A part of a body whose magnetization is ``factor`` times that of the rest of the body.

    It lies between the fractions ``u`` of the body's thickness, from 0 inside to 1 outside, and
    ``v`` of its half width or half angle, from -1 to 1. Where parts of a body overlap, the
    deviations of their factors from 1 add up.
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
        Place of the block in the array, both counted from 1.
    shape : SectorBody or PrismBody
    angle : float, in rad
        Angle about z of the body's own x axis, before ``rotation``.
    centre : tuple, in m
        Position of the body's origin, before ``displacement``.
    remanence : tuple, in T
        B_r in the body's own axes.
    easy_axis : tuple
        Unit vector in the body's own axes.
    along, across : float
        Relative recoil permeability along and across the easy axis.
    displacement : tuple, in m
        Along the magnet's axes.
    rotation : tuple, in rad
        Rotation vector about the body's origin, along the magnet's axes.
    parts : tuple of BodyPart
        Parts with another magnetization.
    meshed_shape : SectorBody or PrismBody, optional
        Shape that the finite elements use instead of ``shape``. It is given where gaps between the
        true shapes would be too narrow for a mesh to resolve.
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
    displacement: Vector = ZERO_VECTOR
    rotation: Vector = ZERO_VECTOR
    parts: tuple[BodyPart, ...] = ()
    meshed_shape: Shape | None = None

    @property
    def position(self) -> Floats:
        """Position of the body's origin, (3,) in m."""
        return np.add(self.centre, self.displacement)

    @property
    def orientation(self) -> Rotation:
        """Rotation from the body's own axes to the magnet's."""
        return Rotation.from_rotvec(self.rotation) * Rotation.from_euler("z", self.angle)

    @property
    def mean_factor(self) -> float:
        """Mean magnetization of the body relative to that outside its parts."""
        return 1 + sum((part.factor - 1) * self.shape.share(part.u, part.v)
                       for part in self.parts)

    @property
    def permeability(self) -> Floats:
        """Relative recoil permeability in the body's own axes, (3, 3)."""
        outer = np.outer(self.easy_axis, self.easy_axis)
        return self.across * np.eye(3) + (self.along - self.across) * outer

    @property
    def magnetization(self) -> Floats:
        """M = B_r / (mu_0 mu_r) along the magnet's axes, (3,) in A/m.

        It is the magnetization of the material law ``B / (mu_0 mu_r) = H + M``.
        """
        return self.orientation.apply(
            np.linalg.solve(MU_0 * self.permeability, np.array(self.remanence)))

    def with_magnetization(self, magnetization: Floats) -> Body:
        """Return the body with another `magnetization`, (3,) in A/m along the magnet's axes."""
        own = self.orientation.inv().apply(magnetization)
        return replace(self, remanence=vector(MU_0 * self.permeability @ own))

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m are inside or on the surface."""
        return self.shape.holds(self.orientation.inv().apply(points - self.position))


@dataclass(frozen=True)
class FroehlichLaw:
    """The Froehlich-Kennelly law of iron, B = mu_0 H + J_s H / (H + h).

    Attributes
    ----------
    initial : float
        Initial relative permeability, from which h follows.
    saturation : float, in T
        Saturation polarization J_s.
    """

    initial: float
    saturation: float


@dataclass(frozen=True)
class TableLaw:
    """An H(B) table of iron.

    Attributes
    ----------
    field, flux_density : tuple of float
        H in A/m and B in T, rising from 0. The polarization J = B - mu_0 H is constant beyond the
        last entry.
    """

    field: tuple[float, ...]
    flux_density: tuple[float, ...]


IronLaw = float | FroehlichLaw | TableLaw
"""Material law of iron: a constant relative permeability, or a curve."""


@dataclass(frozen=True)
class Tube:
    """An iron tube about the z axis.

    Attributes
    ----------
    inner, outer : float, in m
        Radii.
    half_length : float, in m
        Distance from the middle to each end.
    law : IronLaw
    middle : float, in m
        Position of the middle along z.
    """

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
class MagnetCopy:
    """A second magnet like the first, displaced by ``shift`` in m along the axis."""

    shift: float


@dataclass(frozen=True)
class SoftSphere:
    """A small sphere of soft iron, centred at ``place`` in m, of a ``volume`` in m^3.

    The field B at its place magnetizes it to the moment 3 V B / mu_0, the limit of high
    permeability.
    """

    place: Vector
    volume: float


@dataclass(frozen=True)
class TrueMagnet:
    """All sources of the field. In two dimensions lengths along z are infinite.

    Attributes
    ----------
    dimension : int
        2 or 3.
    bodies : tuple of Body
        The blocks, ring by ring and slot by slot.
    iron : Tube, optional
    background : tuple, in T
        A uniform field that is added as it is: neither iron nor blocks respond to it.
    copies : tuple of MagnetCopy
        Neighbouring magnets.
    objects : tuple of SoftSphere
        Ferromagnetic objects in the surroundings.
    """

    dimension: int
    bodies: tuple[Body, ...]
    iron: Tube | None = None
    background: Vector = ZERO_VECTOR
    copies: tuple[MagnetCopy, ...] = ()
    objects: tuple[SoftSphere, ...] = ()

    @property
    def all_bodies(self) -> tuple[Body, ...]:
        """The blocks of the magnet and of its copies."""
        return self.bodies + tuple(
            replace(body, centre=vector(np.add(body.centre, (0, 0, copy.shift))))
            for copy in self.copies for body in self.bodies)

    @property
    def all_iron(self) -> tuple[Tube, ...]:
        """The iron of the magnet and of its copies."""
        if self.iron is None:
            return ()
        iron = self.iron
        return (iron, *(replace(iron, middle=iron.middle + copy.shift) for copy in self.copies))

    @property
    def is_vacuum(self) -> bool:
        """Whether no material responds to a field: no iron, and all permeabilities 1."""
        return self.iron is None and all(
            body.along == body.across == 1.0 for body in self.bodies)

    def with_magnetizations(self, magnetizations: Floats) -> TrueMagnet:
        """Return the magnet with other magnetizations (bodies, dimension) in A/m."""
        full = np.zeros((len(self.bodies), 3))
        full[:, :self.dimension] = magnetizations
        return replace(self, bodies=tuple(
            body.with_magnetization(magnetization)
            for body, magnetization in zip(self.bodies, full, strict=True)))

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m are inside a block or the iron."""
        inside = np.zeros(len(points), bool)
        for body in self.all_bodies:
            inside |= body.holds(points)
        for tube in self.all_iron:
            inside |= tube.holds(points)
        return inside


def vector(values: Floats | tuple[float, ...]) -> Vector:
    """Return three numbers as a tuple of Python floats."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def magnet_of(study: Study) -> TrueMagnet:
    """Return the nominal magnet of a study."""
    array = study.array
    bodies = tuple(_body(array, ring, slot, z, study.dimension)
                   for ring, z in enumerate(_ring_middles(study), start=1)
                   for slot in range(1, array.blocks_per_ring + 1))
    return TrueMagnet(study.dimension, bodies, _tube(study, study.iron_ring))


def ring_length(study: Study) -> float:
    """Return the length of a ring in m; infinite in two dimensions."""
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
    for exception in array.exceptions:  # of several with the same key the last counts
        if (exception.ring or ring, exception.slot or slot) != (ring, slot):
            continue
        if exception.magnetization_angle_deg is not None:
            direction = np.radians(exception.magnetization_angle_deg)
        if exception.recoil_permeability is not None:
            along = across = exception.recoil_permeability
        if exception.recoil_permeability_across is not None:
            across = exception.recoil_permeability_across
        if exception.remanence_T is not None:
            remanence = exception.remanence_T
    length = np.inf if dimension == 2 else float(array.ring_length_m or 0.0)
    shape = _shape(array, length, nominal - angle)
    if remanence is None:
        assert array.block_moment_A_m2 is not None  # a study has the remanence or the moment
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
    """Return the material law of a study's iron.

    Raises
    ------
    StudyError
        If the H(B) curve is in a file that has not been read.
    """
    curve = ring.curve
    if curve is None:
        assert ring.relative_permeability is not None  # a study has the permeability or a curve
        return ring.relative_permeability
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
        raise StudyError(must_be("`iron_ring.curve.file`", "study",
                                 "read together with the study's own file", f"'{curve.file}'",
                                 "Read the study with halbach_fe.study.reader.read_study."))
    else:
        field, flux_density = curve.H_A_per_m, curve.B_T
    start = () if field[0] == 0 else (0.0,)
    return TableLaw((*start, *field), (*start, *flux_density))
