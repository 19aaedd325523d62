"""The true magnet of a synthetic campaign as plain data: blocks, iron and other sources of field.

Each body has its own axes: the origin is in its middle, x points radially outward through it, z is
along the magnet's axis, and y is azimuthal (z cross x). These are the axes in which a coil measures
its moment. Its shape may be seated in them at any angle. Angles are in rad, lengths in m,
remanences in T. Iron has a material law, and is in tubes, prisms and balls in any place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Bools, Floats, unit_circle
from halbach_fe.core.errors import MeasurementError, StudyError, must_be
from halbach_fe.geometry import convex_pieces
from halbach_fe.geometry.outline import circle, closed_outline
from halbach_fe.geometry.overlaps import SQUEEZED, Bodies, first_overlap
from halbach_fe.geometry.surface import distance_from_prism, distance_from_tube
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.study import materials
from halbach_fe.study.external_keys import External
from halbach_fe.study.iron_keys import Iron, IronMaterial
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.synthetic.shapes import (
    HALF_TURN,
    CylinderBody,
    Fractions,
    PolygonBody,
    PrismBody,
    SectorBody,
    Shape,
    Vector,
    shoelace,
)

ZERO_VECTOR: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class BodyPart:
    """A part of a body whose magnetization is ``factor`` times that of the rest of the body.

    It lies between the fractions ``u`` of the body's thickness, from 0 inside to 1 outside, and
    ``v`` of its half width or half angle, from -1 to 1. Where parts of a body overlap, the
    deviations of their factors from 1 add up.
    """

    u: Fractions
    v: Fractions
    factor: float


@dataclass(frozen=True)
class LostCell:
    """A part of a body that has lost a part of its remanence."""

    body: Body
    """The block, or a slice of it along z."""
    u: Fractions
    v: Fractions
    """Limits of the cell in the body, see `BodyPart`."""
    part: float
    """Part of the remanence that is lost."""


@dataclass(frozen=True)
class Body:
    """One block of magnet material."""

    ring: int
    slot: int
    """Place of the block in the array, both counted from 1."""
    shape: Shape
    angle: float
    """Angle about z of the body's own x axis, before ``rotation``. In rad."""
    centre: Vector
    """Position of the body's origin, before ``displacement``. In m."""
    remanence: Vector
    """B_r in the body's own axes. In T."""
    easy_axis: Vector
    """Unit vector in the body's own axes."""
    along: float = 1.0
    across: float = 1.0
    """Relative recoil permeability along and across the easy axis."""
    displacement: Vector = ZERO_VECTOR
    """Along the magnet's axes. In m."""
    rotation: Vector = ZERO_VECTOR
    """Rotation vector about the body's origin, along the magnet's axes. In rad."""
    parts: tuple[BodyPart, ...] = ()
    """Parts with another magnetization."""
    meshed_shape: Shape | None = None
    """Shape that the finite elements use instead of ``shape``. It is given where gaps between the
    true shapes would be too narrow for a mesh to resolve."""
    seat: Vector = ZERO_VECTOR
    """Rotation vector that turns the body's own axes into those of its shape. In rad."""
    name: str = ""
    """Name of a block that is not part of a ring."""
    type: str = ""
    """Type of block that the study gives; empty if it gives none."""
    factor: float = 1.0
    """Factor of the magnetization that the block got when, or after, it was mounted."""
    made_for: tuple[int, int] | None = None
    """Ring and slot that the block was made for, if that is another place."""

    @property
    def position(self) -> Floats:
        """Position of the body's origin, (3,) in m."""
        return np.add(self.centre, self.displacement)

    @cached_property
    def orientation(self) -> Rotation:
        """Rotation from the body's own axes to the magnet's."""
        return Rotation.from_rotvec(self.rotation) * Rotation.from_euler("z", self.angle)

    @cached_property
    def seat_orientation(self) -> Rotation:
        """Rotation from the shape's axes to the body's own."""
        return Rotation.from_rotvec(self.seat)

    @cached_property
    def face_orientation(self) -> Rotation:
        """Rotation from the axes of the shape's faces to the body's own."""
        turn = self.shape.turn if isinstance(self.shape, PrismBody) else 0.0
        return self.seat_orientation * Rotation.from_euler("z", turn)

    def carried_from(self, other: Body) -> Rotation:
        """Return the rotation of what is moved here from another body's place, in own axes."""
        return self.face_orientation * other.face_orientation.inv()

    @cached_property
    def shape_orientation(self) -> Rotation:
        """Rotation from the shape's axes to the magnet's."""
        return self.orientation * self.seat_orientation

    @property
    def nominal_orientation(self) -> Rotation:
        """Rotation from the shape's axes to the magnet's, before ``rotation``."""
        return Rotation.from_euler("z", self.angle) * self.seat_orientation

    @property
    def mean_factor(self) -> float:
        """Mean magnetization of the body relative to that outside its parts."""
        if isinstance(self.shape, CylinderBody):
            return 1.0  # it has no parts
        return 1 + sum((part.factor - 1) * self.shape.share(part.u, part.v)
                       for part in self.parts)

    @property
    def permeability(self) -> Floats:
        """Relative recoil permeability in the body's own axes, (3, 3)."""
        outer = np.outer(self.easy_axis, self.easy_axis)
        return self.across * np.eye(3) + (self.along - self.across) * outer

    @property
    def is_vacuum(self) -> bool:
        """Whether its material does not respond to a field."""
        return self.along == self.across == 1.0

    def in_shape(self, points: Floats) -> Floats:
        """Return points (n, 3) in m of the magnet in the axes of the shape."""
        return np.asarray((points - self.position) @ self.shape_orientation.as_matrix())

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

    @property
    def room(self) -> tuple[object, ...]:
        """What tells whether it takes the same room as another body."""
        return (self.shape, self.angle, self.centre, self.displacement, self.rotation, self.seat,
                any(self.remanence))

    def turned(self, angle: float) -> Body:
        """Return the body in its place in a magnet that is turned by ``angle`` rad about z."""
        turn = Rotation.from_euler("z", angle)
        return replace(self, angle=self.angle + angle, centre=vector(turn.apply(self.centre)),
                       displacement=vector(turn.apply(self.displacement)),
                       rotation=vector(turn.apply(self.rotation)))

    def lifted(self, shift: float) -> Body:
        """Return the body at another nominal place, ``shift`` m along z."""
        return replace(self, centre=vector(np.add(self.centre, (0, 0, shift))))

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m are inside or on the surface."""
        near = np.linalg.norm(points - self.position, axis=1) <= self.shape.reach * (1 + 1e-9)
        near[near] = self.shape.holds(self.in_shape(points[near]))
        return near

    @property
    def rim(self) -> Floats:
        """Points (n, 3) in m on the edges of the nominal place; z is 0 for an infinite body."""
        shape = self.shape
        if isinstance(shape, SectorBody):
            arc = np.exp(1j * shape.half_angle * np.linspace(-1, 1, 33))
            plane = np.concatenate([shape.inner * arc, shape.outer * arc]) - shape.middle
        elif isinstance(shape, CylinderBody):
            plane = shape.radius * np.exp(2j * np.pi * np.arange(64) / 64)
        else:
            plane = shape.corners @ [1, 1j]
        ends = [0.0] if np.isinf(shape.length) else [-shape.length / 2, shape.length / 2]
        local = np.vstack([np.column_stack([plane.real, plane.imag, np.full(len(plane), z)])
                           for z in ends])
        return np.asarray(self.nominal_orientation.apply(local) + self.centre)


@dataclass(frozen=True)
class MagnetCopy:
    """A second magnet, displaced by ``shift`` in m along the axis.

    Its bodies and its iron are those of the first without the faults that are hidden in that.
    """

    shift: float
    bodies: tuple[Body, ...] = ()
    iron: TrueIron | None = None


@dataclass(frozen=True)
class SoftSphere:
    """A small sphere of soft iron, centred at ``place`` in m, of a ``volume`` in m^3.

    The field B at its place magnetizes it to the moment 3 V B / mu_0, the limit of high
    permeability.
    """

    place: Vector
    volume: float

    @property
    def radius(self) -> float:
        """Radius in m."""
        return float((3 * self.volume / (4 * np.pi))**(1 / 3))


def _answering_to_nothing(bodies: tuple[Body, ...]) -> tuple[Body, ...]:
    """Return bodies with the permeability of vacuum."""
    return tuple(replace(body, along=1.0, across=1.0) for body in bodies)


@dataclass(frozen=True)
class TrueMagnet:
    """All sources of the field. In two dimensions lengths along z are infinite."""

    dimension: int
    """2 or 3."""
    bodies: tuple[Body, ...]
    """The blocks, ring by ring and slot by slot."""
    iron: TrueIron | None = None
    background: Vector = ZERO_VECTOR
    """A uniform field that is added as it is: neither iron nor blocks respond to it. In T."""
    copies: tuple[MagnetCopy, ...] = ()
    """Neighbouring magnets."""
    objects: tuple[SoftSphere, ...] = ()
    """Ferromagnetic objects in the surroundings."""
    neighbours: tuple[Body, ...] = ()
    """Blocks, in their places, of neighbouring magnets that the study knows of. They are in vacuum,
    and nothing reacts to them."""
    dipoles: tuple[tuple[Vector, Vector], ...] = ()
    """Places in m and moments in A m^2 of distant magnetized objects."""
    losses: tuple[LostCell, ...] = ()
    """What the blocks of a magnet in vacuum have lost."""

    @property
    def all_bodies(self) -> tuple[Body, ...]:
        """The blocks of the magnet and of its copies."""
        return self.bodies + tuple(
            body.lifted(copy.shift) for copy in self.copies for body in copy.bodies)

    @property
    def all_iron(self) -> TrueIron | None:
        """The iron of the magnet and of its copies."""
        found = self.iron
        for copy in self.copies:
            if copy.iron is not None:
                there = tuple(replace(body, origin=vector(np.add(body.origin, (0, 0, copy.shift))))
                              for body in copy.iron.bodies)
                found = replace(copy.iron, bodies=(found.bodies if found else ()) + there)
        return found

    @property
    def half_length(self) -> float:
        """Largest |z| in m of the nominal blocks; infinite in two dimensions."""
        if self.dimension == 2:
            return np.inf
        return max(float(np.abs(body.rim[:, 2]).max()) for body in self.bodies)

    @property
    def is_vacuum(self) -> bool:
        """Whether no material responds to a field: no iron, and all permeabilities 1."""
        return self.iron is None and all(body.is_vacuum for body in self.all_bodies)

    @property
    def answers(self) -> tuple[object, ...]:
        """What of the magnet answers to a field, and how: iron, and permeabilities of blocks."""
        return self.all_iron, [(body.along, body.across) for body in self.all_bodies]

    @cached_property
    def in_vacuum(self) -> TrueMagnet:
        """The magnet without iron, with the remanences of its blocks in vacuum."""
        return replace(
            self, iron=None, bodies=_answering_to_nothing(self.bodies), copies=tuple(
                replace(copy, iron=None, bodies=_answering_to_nothing(copy.bodies))
                for copy in self.copies))

    def with_magnetizations(self, magnetizations: Floats) -> TrueMagnet:
        """Return the magnet with other magnetizations (bodies, dimension) in A/m."""
        full = np.zeros((len(self.bodies), 3))
        full[:, :self.dimension] = magnetizations
        return replace(self, bodies=tuple(
            body.with_magnetization(magnetization)
            for body, magnetization in zip(self.bodies, full, strict=True)))

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m are inside a block or the iron."""
        return np.any([solid.holds(points) for solid in self.solids], axis=0)

    @property
    def solids(self) -> tuple[Solid, ...]:
        """All that no probe can be in: blocks, also of other magnets, and iron."""
        return (*self.all_bodies, *self.neighbours,
                *(self.all_iron.bodies if self.all_iron else ()))


def vector(values: Floats | tuple[float, ...]) -> Vector:
    """Return three numbers as a tuple of Python floats."""
    x, y, z = (float(value) for value in values)
    return x, y, z


def in_places(single: TrueMagnet, measured: BlockTable, placed: BlockTable) -> TrueMagnet:
    """Return the magnet with its blocks in the places of a table.

    A block keeps its magnetization in the axes of its shape, which is seated as the new place asks,
    and turned there as the table says.

    Parameters
    ----------
    single : TrueMagnet
        The blocks before they are mounted, in the places for which they were drawn.
    measured : BlockTable
        The same blocks, with the same places.
    placed : BlockTable
        The blocks with their new places. Those without one are left over.

    Raises
    ------
    MeasurementError
        If the tables are not of the same blocks, a block with parts is turned, or a place remains
        empty.
    """
    drawn = {body.made_for or (body.ring, body.slot): body for body in single.bodies}
    rows = {serial: row for row, serial in enumerate(measured.serial)}
    there: dict[tuple[int, int], Body] = {}
    # difference of two moments, relative to the moment, that rounding in a table may make
    same = 1e-6
    for number, (serial, place) in enumerate(zip(placed.serial, placed.places, strict=True)):
        if serial not in rows:
            raise MeasurementError(must_be(
                f"block {serial}", placed.source, "one of the simulated blocks",
                f"another serial than {measured.serial[0]} to {measured.serial[-1]}",
                "Sort the blocks.csv of a simulation of this study with the same seed."))
        if place not in drawn:
            if place[0]:
                raise MeasurementError(must_be(
                    f"place of block {serial}", placed.source, "that of a block of the study",
                    f"ring {place[0]}, slot {place[1]}"))
            continue
        row, target = rows[serial], drawn[place]
        source = drawn[measured.places[row]]
        turn = target.carried_from(source)
        if placed.turn_deg is not None and placed.turn_deg[number].any() and not source.parts:
            own = Rotation.from_rotvec(placed.turn_deg[number], degrees=True)
            turn = target.face_orientation * own * target.face_orientation.inv() * turn
        moment = turn.apply(measured.moment[row])
        difference = np.linalg.norm(placed.moment[number] - moment) / np.linalg.norm(moment)
        if difference > same:
            raise MeasurementError(must_be(
                f"moment of block {serial}", placed.source, "that of the simulated block in "
                "its slot, turned as the table says", f"another one by {difference:.2g} of its "
                "size", "Sort the blocks.csv of a simulation with the same seed."))
        there[place] = replace(
            target, remanence=vector(turn.apply(source.remanence)), parts=source.parts,
            easy_axis=vector(turn.apply(source.easy_axis)), along=source.along,
            across=source.across, factor=source.factor)
    empty = [place for place in measured.places if place not in there]
    if empty:
        raise MeasurementError(must_be(
            "places", placed.source, "complete, with a block for each slot",
            f"{len(empty)} empty ones, first ring {empty[0][0]}, slot {empty[0][1]}"))
    return replace(single, bodies=tuple(
        there.get((body.ring, body.slot), body) for body in single.bodies))


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


Solid = Body | Tube | Pole | Ball


@lru_cache(maxsize=1024)
def _section(shape: Shape | Tube | Pole) -> convex_pieces.Shape:
    """Return the section of a body in its axes; that of a sector is about the axis of its tube."""
    if isinstance(shape, Tube):
        return convex_pieces.annulus(shape.inner, shape.outer)
    if isinstance(shape, CylinderBody):
        return convex_pieces.Shape(circle(shape.radius))
    if isinstance(shape, Pole):
        shape = PolygonBody(shape.outline, 0.0)
    if not isinstance(shape, SectorBody):
        return convex_pieces.Shape(closed_outline(shape.corners))
    parts = 1 if 2 * shape.half_angle < HALF_TURN else 3
    arc = unit_circle(np.linspace(-shape.half_angle, shape.half_angle, parts + 1))[:, :2]
    return convex_pieces.Shape(closed_outline(
        np.vstack([shape.outer * arc, shape.inner * arc[::-1]]),
        tuple(number for number in range(2 * parts + 1) if number != parts)))


def _prisms(solids: Sequence[Body | Tube | Pole], dimension: int) -> Bodies:
    """Return solids as what the study's own check of overlaps compares."""
    numbers: dict[convex_pieces.Shape, int] = {}
    which, limits, axes, places = [], [], [], []
    for solid in solids:
        if isinstance(solid, Body):
            half, middle = solid.shape.length / 2, 0.0
            turn = solid.shape_orientation if dimension == 3 else Rotation.from_euler(
                "z", solid.rotation[2] + solid.angle) * solid.seat_orientation
            shift = solid.shape.middle if isinstance(solid.shape, SectorBody) else 0.0
            place = solid.position - turn.apply([shift, 0.0, 0.0])
        else:
            half, middle = solid.half_length, solid.middle
            turn, place = Rotation.from_rotvec(solid.turn), np.array(solid.origin)
        section = _section(solid.shape if isinstance(solid, Body) else solid)
        which.append(numbers.setdefault(section, len(numbers)))
        limits.append((middle - half, middle + half))
        axes.append(turn.as_matrix())
        places.append(place)
    return Bodies(list(numbers), np.array(which), np.array(limits), np.array(axes),
                  np.array(places))


def distance_from(solid: Solid, points: Floats, dimension: int) -> Floats:
    """Return the distances (n,) in m of points (n, 3) from a block or iron; negative inside."""
    if isinstance(solid, Ball):
        return np.asarray(np.linalg.norm(points - solid.origin, axis=1) - solid.radius)
    prism = _prisms([solid], dimension)
    there, (low, high) = (points - prism.position[0]) @ prism.axes[0], prism.limits[0]
    if isinstance(solid, Tube):
        return distance_from_tube(solid.inner, solid.outer, low, high, there)
    return distance_from_prism(prism.shapes[0].outline, low, high, there)


def in_words(solid: Solid) -> str:
    """Describe a block or a body of iron."""
    if not isinstance(solid, Body):
        return "iron"
    return f"block {solid.name or f'r{solid.ring:02d}s{solid.slot:02d}'}"


def check_room(magnet: TrueMagnet, before: TrueMagnet) -> None:
    """Raise a StudyError if what hidden effects moved, or added, is where something is already.

    Blocks are compared as the study compares those that its exceptions move: they may be squeezed
    as a tolerance of the assembly squeezes them.

    Parameters
    ----------
    before : TrueMagnet
        The magnet without the effects, whose blocks leave each other room.
    """
    rooms = {body.room for body in before.bodies}
    there = [body for body in (*magnet.all_bodies, *magnet.neighbours) if any(body.remanence)]
    iron = magnet.all_iron.bodies if magnet.all_iron else ()
    for sphere in magnet.objects:
        for solid in (*there, *iron):
            away = float(distance_from(solid, np.array([sphere.place]), magnet.dimension)[0])
            if away < sphere.radius:
                raise StudyError(must_be(
                    "position of --hide ferromagnetic_object", "the study",
                    f"more than {1e3 * sphere.radius:.3g} mm from blocks and iron, the radius of a "
                    "sphere of this volume",
                    f"{1e3 * abs(away):.3g} mm {'from' if away > 0 else 'within'} "
                    f"{in_words(solid)}", "Move the object away, or make its volume smaller."))
    moved = [body for body in there if body.room not in rooms]
    others = [body for body in there if body.room in rooms]
    added = iron if magnet.all_iron != before.all_iron else ()
    for some, rest in ((moved, None), (moved, others), (moved, iron), (others, added),
                       (added, None)):
        if (found := _overlap(some, rest, magnet.dimension)) is not None:
            raise StudyError(
                "What --hide moves or adds must leave blocks and iron room; instead "
                f"{in_words(found[0])} and {in_words(found[1])} overlap by at least "
                f"{1e3 * found[2]:.3g} mm. Hide smaller values, or make room in the study.")


def _overlap(
    some: Sequence[Solid], rest: Sequence[Solid] | None, dimension: int
) -> tuple[Solid, Solid, float] | None:
    """Return two solids, one of ``rest`` if that is given, that overlap, and by how much in m."""
    others = some if rest is None else rest
    flat, beside = ([one for one in each if not isinstance(one, Ball)] for each in (some, others))
    if flat and beside and (found := first_overlap(
            _prisms(flat, dimension), None if rest is None else _prisms(beside, dimension),
            SQUEEZED)):
        return flat[found[0]], beside[found[1]], found[2]
    for ball in (each for each in others if isinstance(each, Ball)):
        for one in some:
            depth = ball.radius - distance_from(one, np.array([ball.origin]), dimension)[0]
            if one is not ball and depth > SQUEEZED * ball.radius:
                return one, ball, float(depth)
    return None
