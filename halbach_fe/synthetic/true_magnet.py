"""The true magnet of a synthetic campaign as plain data: blocks, iron and other sources of field.

Each body has its own axes: the origin is in its middle, x points radially outward through it, z is
along the magnet's axis, and y is azimuthal (z cross x). These are the axes in which a coil measures
its moment. Its shape may be seated in them at any angle. Angles are in rad, lengths in m,
remanences in T.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Bools, Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.iron import TrueIron
from halbach_fe.synthetic.shapes import (
    CylinderBody,
    Fractions,
    PrismBody,
    SectorBody,
    Shape,
    Vector,
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
class VacuumNeighbour:
    """A second magnet with the same blocks in vacuum, to which nothing reacts.

    It is turned by ``turn`` in rad about the axis and displaced by ``shift`` in m along it; its
    remanences are multiplied by ``factor``.
    """

    shift: float
    turn: float
    factor: float


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
    neighbours: tuple[VacuumNeighbour, ...] = ()
    """Neighbouring magnets in vacuum that the study knows of."""
    dipoles: tuple[tuple[Vector, Vector], ...] = ()
    """Places in m and moments in A m^2 of distant magnetized objects."""
    losses: tuple[LostCell, ...] = ()
    """What the blocks of a magnet in vacuum have lost."""

    @property
    def all_bodies(self) -> tuple[Body, ...]:
        """The blocks of the magnet and of its copies."""
        return self.bodies + tuple(
            replace(body, centre=vector(np.add(body.centre, (0, 0, copy.shift))))
            for copy in self.copies for body in self.bodies)

    @property
    def all_iron(self) -> TrueIron | None:
        """The iron of the magnet and of its copies."""
        iron = self.iron
        if iron is None or not self.copies:
            return iron
        return replace(iron, bodies=iron.bodies + tuple(
            replace(body, origin=vector(np.add(body.origin, (0, 0, copy.shift))))
            for copy in self.copies for body in iron.bodies))

    @property
    def half_length(self) -> float:
        """Largest |z| in m of the nominal blocks; infinite in two dimensions."""
        if self.dimension == 2:
            return np.inf
        return max(float(np.abs(body.rim[:, 2]).max()) for body in self.bodies)

    @property
    def is_vacuum(self) -> bool:
        """Whether no material responds to a field: no iron, and all permeabilities 1."""
        return self.iron is None and all(body.is_vacuum for body in self.bodies)

    def with_magnetizations(self, magnetizations: Floats) -> TrueMagnet:
        """Return the magnet with other magnetizations (bodies, dimension) in A/m."""
        full = np.zeros((len(self.bodies), 3))
        full[:, :self.dimension] = magnetizations
        return replace(self, bodies=tuple(
            body.with_magnetization(magnetization)
            for body, magnetization in zip(self.bodies, full, strict=True)))

    def holds(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m are inside a block or the iron."""
        inside = np.zeros(len(points), bool)
        for body in self.all_bodies:
            inside |= body.holds(points)
        for solid in self.all_iron.bodies if self.all_iron else ():
            inside |= solid.holds(points)
        return inside


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
