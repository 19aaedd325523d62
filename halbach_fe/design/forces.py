"""Forces and torques on the blocks of a magnet, in place and as they are inserted one by one.

A block of polarization J in the field B of all others feels the force and torque on its surface
charge,

    ``F = 1/mu_0 int (J.n) B dS``,  ``T = 1/mu_0 int (J.n) (r - m) x B dS``,

with n the outward normal and m the centre of mass of the block (J. D. Jackson, Classical
Electrodynamics, 3rd ed., problem 5.20). B is the exact field of the others' surface charge, and the
integrals are sums over Gauss points of the faces, of high order where the other block is near. The
order grows until the forces of two successive orders differ by at most 1 %; that difference is the
error bar.

Blocks of another permeability than vacuum, or with irreversible losses, have the polarization that
the method of moments finds in the finished magnet, as its mean over the block. How it varies inside
a block is left out. The force of iron is that of its reaction to all blocks, with the change from a
coarser mesh as its error bar. A block that is inserted feels the blocks before it and external
fields; iron is not there yet.

The force of blocks and coils on a body is, by Newton's third law, minus that of the body's own
field on them: on the surface charge of the blocks and on the current
of the coils. Blocks may touch the iron. The force between two bodies is the integral of the mixed
part of Maxwell's stress tensor,

    ``1/mu_0 int (B_1 (B_2.n) + B_2 (B_1.n) - (B_1.B_2) n) dS``,

with B_1 and B_2 the fields of the polarization of each alone, over a plane that separates them (J.
D. Jackson, Classical Electrodynamics, 3rd ed., section 6.7); whatever else lies across the plane
takes no part. Bodies that touch, or that no plane separates, feel one force together. The change
from a mesh twice as coarse, and from pieces of coils twice as long, is the error bar.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import HalbachWarning, StudyError, must_be
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.core.numbers import DENSITY, check_number
from halbach_fe.geometry.blocks import MagnetBlock, present_blocks, rotation_matrix, vector
from halbach_fe.geometry.coils import points_in_winding
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import along_edges, at_heights
from halbach_fe.solver.axisymmetric_iron import IronReaction
from halbach_fe.solver.exact_block_field import current_elements, external_field, field_of
from halbach_fe.solver.iron_bodies import BodiesReaction
from halbach_fe.solver.separate_blocks import SeparateReaction, applies, solve_separate
from halbach_fe.solver.session import NOT_KEPT, Session, alone
from halbach_fe.study.materials import MU_0, grade

SMALL = 0.1
"""Forces smaller than this share of the largest one have the error that it would have: symmetry
makes some of them zero."""

NEAR_ORDERS = (6, 9, 14, 21, 32)
"""Gauss points along a side of a face, for the field of near blocks."""

FAR_ORDERS = (1, 2, 3, 4, 5)
"""The same for the field of other blocks."""

Field = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns B (n, 3) in T."""

DENSITY_KG_PER_M3 = 7500.0
"""Density of sintered NdFeB, for blocks whose grade is not known."""


@dataclass(frozen=True)
class Loads:
    """Forces and torques on the blocks of a magnet."""

    force_N: Floats
    torque_Nm: Floats
    """Along x, y and z of the magnet; torques about the centres of mass of the blocks.
    Shape (blocks, 3)."""
    error_N: Floats
    error_Nm: Floats
    """Error bars of the quadrature. Shape (blocks,)."""

    @property
    def magnitude(self) -> Floats:
        """Magnitudes of the forces, (blocks,)."""
        return np.asarray(np.linalg.norm(self.force_N, axis=1))


@dataclass(frozen=True)
class IronLoads:
    """Forces on bodies of iron."""

    names: tuple[str, ...]
    """``iron 1`` for the first body; bodies that feel one force together are one name."""
    force_N: Floats
    """Along x, y and z of the magnet. Shape (bodies, 3)."""
    error_N: Floats
    """Error bars. Shape (bodies,)."""


@dataclass(frozen=True)
class Forces(ShownInNotebook):
    """Forces and torques on every block, in place and as the next one to be inserted.

    Attributes
    ----------
    magnet : Magnet
    blocks : tuple of MagnetBlock
        The blocks that are there: missing ones feel no force.
    in_place : Loads
        With all other blocks, iron and external fields.
    inserted : Loads
        With the blocks before it in ``order`` and external fields.
    order : ndarray of int, shape (blocks,)
        Numbers of ``blocks`` in the order in which they are inserted.
    imbalance_N : float
        Magnitude of the sum of the forces of blocks on blocks, which Newton's third law makes zero.
    mass_kg : ndarray, shape (blocks,)
    price_per_kg : float or None
    iron : IronLoads or None
        Forces on the iron of the finished magnet; None without iron, and beside dipoles and
        neighbours, whose part in them is not computed.
    """

    magnet: Magnet
    blocks: tuple[MagnetBlock, ...]
    in_place: Loads
    inserted: Loads
    order: Ints
    imbalance_N: float
    mass_kg: Floats
    price_per_kg: float | None = None
    iron: IronLoads | None = None

    @property
    def cost(self) -> float | None:
        """Price of all blocks, or None if their price per kg is not known."""
        return None if self.price_per_kg is None else float(
            self.price_per_kg * self.mass_kg.sum())

    @cached_property
    def step(self) -> Ints:
        """Place of every block in the order of insertion, (blocks,), from 1."""
        found = np.empty(len(self.order), int)
        found[self.order] = np.arange(1, len(self.order) + 1)
        return found


@alone
def forces(
    magnet: Magnet, session: Session = NOT_KEPT, order: Sequence[str] | None = None,
    density_kg_per_m3: float | None = None, price_per_kg: float | None = None,
) -> Forces:
    """Compute forces and torques on every block, in place and as it is inserted.

    Parameters
    ----------
    magnet : Magnet
    session : Session, optional
        Its folder receives the runs of GetDP, if the magnet has iron.
    order : sequence of str, optional
        Names of all blocks in the order in which they are inserted; by default ring by ring, slot
        by slot.
    density_kg_per_m3 : float, optional
        Density of all blocks; by default that of their grade, or 7500 (NdFeB).
    price_per_kg : float, optional
        Price of the blocks, from which their total cost follows.

    Returns
    -------
    Forces

    Raises
    ------
    StudyError
        If the study is a cross-section, beside iron of any shape its method is ``direct``, a number
        is out of its range, or ``order`` does not name every block once.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("mri.toml"))
    >>> found = hf.forces(magnet, hf.Session.open("results"))
    >>> found.in_place.force_N.shape, bool(found.mass_kg.sum() > 0)
    ((36, 3), True)
    """
    if magnet.dimension == 2:
        raise StudyError(must_be("`dimension`", f"study {magnet.name}",
                                 "3, for the forces on blocks", "2"))
    if not (magnet.iron_is_axisymmetric or applies(magnet)):
        raise StudyError(must_be(
            "`solver.method`", f"study {magnet.name}", "reaction, for the forces beside this iron",
            magnet.study.solver.method, "Leave it out."))
    if density_kg_per_m3 is not None:
        check_number("density_kg_per_m3", "forces", density_kg_per_m3, *DENSITY)
    if price_per_kg is not None:
        check_number("price_per_kg", "forces", price_per_kg, 0)
    names = {block.name: block for block in present_blocks(magnet.blocks)}
    sequence = _sequence(list(names), order, magnet.name)
    blocks, reaction = _polarized(magnet, session)
    iron = None if reaction is None else reaction.iron
    rank = np.empty(len(blocks), int)
    rank[sequence] = np.arange(len(blocks))
    mutual, in_place, inserted = _converged(
        blocks, rank, lambda points: external_field(magnet, points),
        None if iron is None else iron.field)
    of_iron = None
    if iron is not None:
        charges = [Charges.of(blocks, order) for order in NEAR_ORDERS[1::-1]]
        in_place = _with_error_of_iron(in_place, charges[1], blocks, iron)
        if not (magnet.external.dipoles or magnet.external.neighbours):
            of_iron = iron_loads(magnet, [(each.points, each.charge) for each in charges], iron)
    density = _densities(magnet, density_kg_per_m3)
    return Forces(
        magnet, tuple(names.values()), in_place, inserted, sequence,
        float(np.linalg.norm(mutual.sum(axis=0))),
        density * np.array([block.volume for block in blocks]), price_per_kg, of_iron)


def _with_error_of_iron(loads: Loads, charges: Charges, blocks: Sequence[MagnetBlock],
                        iron: IronReaction | BodiesReaction) -> Loads:
    """Add what a coarser mesh of the iron changes to the error bars of loads.

    On a single block the change may vanish by chance. Therefore it counts as at least the share of
    the iron's loads that it is of those on all blocks together.
    """
    if iron.coarse is None:
        return loads
    middles = np.array([block.centre_of_mass for block in blocks])
    whole, coarse = (charges.loads(each.field(charges.points), middles, len(blocks))
                     for each in (iron, iron.coarse))
    bars = []
    for part, other in zip(np.hsplit(whole, 2), np.hsplit(coarse, 2), strict=True):
        size, change = (np.linalg.norm(one, axis=1) for one in (part, part - other))
        share = np.linalg.norm(change) / (np.linalg.norm(size) or 1.0)
        bars.append(np.maximum(change, share * size))
    return replace(loads, error_N=loads.error_N + bars[0], error_Nm=loads.error_Nm + bars[1])


def _sequence(names: Sequence[str], order: Sequence[str] | None, study: str) -> Ints:
    """Return the numbers of blocks in the order in which they are inserted, (blocks,)."""
    if order is None:
        return np.arange(len(names))
    known = {name: number for number, name in enumerate(names)}
    for name in order:
        if name not in known:
            raise StudyError(must_be("order", f"study {study}", "one of the blocks of the magnet",
                                     f"'{name}'", f"Their names are like {names[0]}."))
    if len(set(order)) != len(order) or len(order) != len(names):
        wrong = next((name for name in names if list(order).count(name) != 1), names[0])
        raise StudyError(must_be(
            "order", f"study {study}", f"each of the {len(names)} blocks once",
            f"{len(order)} names, {wrong} {list(order).count(wrong)} times among them"))
    return np.array([known[name] for name in order])


def _polarized(
    magnet: Magnet, session: Session
) -> tuple[tuple[MagnetBlock, ...], SeparateReaction | None]:
    """Return the blocks that are there with their mean polarization, and the reaction."""
    blocks = present_blocks(magnet.blocks)
    if magnet.is_vacuum:
        return blocks, None
    reaction = solve_separate(magnet, session, estimate=bool(magnet.iron))
    if reaction.blocks:
        induced = reaction.blocks[0].block_moments()
        found = []
        for block, moment in zip(blocks, induced, strict=True):
            mean = block.polarization + moment / block.volume
            size = float(np.linalg.norm(mean))
            found.append(replace(block, remanence=size, easy_axis=vector(mean / size)))
        blocks = tuple(found)
    return blocks, reaction


def _densities(magnet: Magnet, given: float | None) -> Floats:
    """Return the density of every block that is there, in kg/m^3."""
    return np.array([
        given or (np.mean(grade(name).density_kg_per_m3) if name else DENSITY_KG_PER_M3)
        for block, name in zip(magnet.blocks, magnet.materials, strict=True)
        if present_blocks((block,))])


def _converged(
    blocks: Sequence[MagnetBlock], rank: Ints, external: Field, iron: Field | None
) -> tuple[Floats, Loads, Loads]:
    """Return the mutual forces (blocks, 3) in N, and the loads in place and at insertion.

    Warns
    -----
    HalbachWarning
        If the forces on some blocks do not reach the tolerance.
    """
    todo = np.arange(len(blocks))
    loads = np.zeros((len(blocks), 3, 6))  # mutual, in place, inserted; force and torque
    errors = np.zeros((len(blocks), 3, 2))
    # largest difference of forces of successive orders, relative to the force on the block
    tolerance = 0.01
    # error in N that matters to nobody: symmetry, or a uniform field, makes all forces zero
    least_n = 1e-9
    for level, orders in enumerate(zip(NEAR_ORDERS, FAR_ORDERS, strict=True)):
        now = _loads(blocks, rank, todo, *orders, external, iron)
        change = (now - loads[todo]).reshape(-1, 3, 2, 3)
        loads[todo], errors[todo] = now, np.linalg.norm(change, axis=3)
        if not level:
            continue
        size = np.linalg.norm(loads[:, 1:, :3], axis=2)
        least = np.maximum(tolerance * np.maximum(size, SMALL * size.max(axis=0)), least_n)
        todo = np.flatnonzero((errors[:, 1:, 0] > least).any(axis=1))
        if not len(todo):
            break
    if len(todo):
        # What the forces of blocks on blocks do not add up to, zero by Newton's third law, is an
        # error of these blocks: two orders may differ by less.
        missing = float(np.linalg.norm(loads[:, 0, :3].sum(axis=0)))
        stated = float(np.linalg.norm(errors[todo, 0, 0]))
        errors[todo] *= missing / stated if missing > stated > 0 else 1.0
        warnings.warn(
            f"The forces on {len(todo)} of {len(blocks)} blocks, {blocks[todo[0]].name} among "
            f"them, are less certain than {100 * tolerance:g} %: see their error bars.",
            HalbachWarning, stacklevel=3)
    in_place, inserted = (
        Loads(loads[:, case, :3], loads[:, case, 3:], errors[:, case, 0], errors[:, case, 1])
        for case in (1, 2))
    return loads[:, 0, :3], in_place, inserted


def _loads(
    blocks: Sequence[MagnetBlock], rank: Ints, targets: Ints, near_order: int, far_order: int,
    external: Field, iron: Field | None,
) -> Floats:
    """Return force in N and torque in N m of target blocks, (targets, 3, 6).

    The cases are those of other blocks only, of everything in place, and of the blocks of lower
    rank and external fields.
    """
    near, far = (Charges.of([blocks[number] for number in targets], order)
                 for order in (near_order, far_order))
    middles = np.array([block.centre_of_mass for block in blocks])
    reach = np.array([_reach(block) for block in blocks])
    tree = KDTree(middles[targets])
    near_field, far_field = (np.zeros((2, len(each.points), 3)) for each in (near, far))
    # distance of the middles of two blocks, relative to the sum of the radii of the spheres around
    # them, up to which they are near
    near_ratio = 2.5
    for number, block in enumerate(blocks):
        around = np.array(tree.query_ball_point(
            middles[number], near_ratio * (reach[number] + reach[targets].max())), int)
        distance = np.linalg.norm(middles[targets[around]] - middles[number], axis=1)
        is_near = np.zeros(len(targets), bool)
        is_near[around[distance <= near_ratio * (reach[number] + reach[targets[around]])]] = True
        later = rank[targets] > rank[number]
        for charges, field, chosen in ((near, near_field, is_near), (far, far_field, ~is_near)):
            here = np.flatnonzero((chosen & (targets != number))[charges.owner])
            found = field_of([block], charges.points[here])
            if charges is near:
                found += _jump(block, charges.points[here], charges.normals[here])
            field[0, here] += found
            after = later[charges.owner[here]]
            field[1, here[after]] += found[after]
    outer = external(near.points)
    own_middles = middles[targets]
    mutual, before = (near.loads(one, own_middles, len(targets))
                      + far.loads(other, own_middles, len(targets))
                      for one, other in zip(near_field, far_field, strict=True))
    of_external = near.loads(outer, own_middles, len(targets))
    of_iron = 0.0 if iron is None else near.loads(iron(near.points), own_middles, len(targets))
    return np.stack([mutual, mutual + of_external + of_iron, before + of_external], axis=1)


def _jump(block: MagnetBlock, points: Floats, normals: Floats) -> Floats:
    """Return what turns mu_0 H inside a block into the field just outside of it, (n, 3) in T.

    Blocks that touch may overlap by rounding, or by what an exception moved them. On a face with
    these normals the component of B across it and those of H along it are continuous.
    """
    inside = block.contains(points)
    jump = np.zeros_like(points)
    polarization = block.polarization
    jump[inside] = (normals[inside] @ polarization)[:, None] * normals[inside]
    return jump


def _reach(block: MagnetBlock) -> float:
    """Return the radius in m of a sphere about the middle that contains the block."""
    points = block.from_frame(at_heights(along_edges(block.outline, 5), block.z_min, block.z_max))
    return float(np.linalg.norm(points - block.centre_of_mass, axis=1).max())


@dataclass(frozen=True)
class Charges:
    """Gauss points on the faces of blocks, and the magnetic charges that they stand for."""

    points: Floats
    normals: Floats
    """Along the axes of the magnet; points in m, normals outward. Shape (n, 3)."""
    charge: Floats
    """(J . n) dS / mu_0. Shape (n,), in A m."""
    owner: Ints
    """Number of the block. Shape (n,)."""

    @classmethod
    def of(cls, blocks: Sequence[MagnetBlock], order: int) -> Charges:
        """Put ``order`` points along every side of a face; faces without charge have none."""
        parts: list[tuple[Floats, Floats, Floats, Ints]] = []
        # distance of the points from the face, relative to the size of the block: the field of
        # blocks that touch is that just outside of them
        inwards = 1e-6
        # charge of a face relative to that of one across the polarization, below which it has none
        rounding = 1e-9
        for number, block in enumerate(blocks):
            size = block.volume ** (1 / 3)
            polarization = block.polarization
            for factor, part in block.parts:
                points, vectors = (np.vstack(each) for each in zip(
                    *_faces(part, order, size), strict=True))
                areas, vectors = np.linalg.norm(vectors, axis=1), vectors @ block.axes.T
                charge = factor / MU_0 * (vectors @ polarization)
                kept = np.abs(charge) > rounding * areas * abs(block.remanence) / MU_0
                normals = vectors[kept] / areas[kept, None]  # points of corners have no area
                points = block.from_frame(points[kept]) - inwards * size * normals
                parts.append((points, normals, charge[kept], np.full(len(points), number)))
        points, normals, charge, owner = (np.concatenate(each)
                                          for each in zip(*parts, strict=True))
        return cls(points, normals, charge, owner)

    def loads(self, field: Floats, middles: Floats, count: int) -> Floats:
        """Return force and torque (count, 6) of the blocks in B (n, 3) in T at the points."""
        force = self.charge[:, None] * field
        torque = np.cross(self.points - middles[self.owner], force)
        both = np.hstack([force, torque])
        return np.column_stack([np.bincount(self.owner, column, count) for column in both.T])


def _faces(block: MagnetBlock, order: int, size: float) -> Iterator[tuple[Floats, Floats]]:
    """Yield points (n, 3) in m of a block's faces and their area vectors (n, 3) in m^2.

    Both are along the axes of its frame. Faces longer than ``size`` in m are divided. The points
    are concentrated at the edges of the faces, where the field of blocks that touch is singular.
    """
    t, weight = _graded(order)
    height = block.z_max - block.z_min
    z, z_weight = _panels(t, weight, height, size)
    z, z_weight = block.z_min + height * z, height * z_weight
    corners = np.array([edge.start for edge in block.outline])
    four = len(corners) == 4 and not any(block.outline[k].arc for k in (0, 2))
    most_turn = 0.5  # largest angle in rad of a part of a curved face
    for edge in block.outline:
        s, s_weight = _panels(t, weight, edge.length, min(
            size, most_turn * edge.radius if edge.arc else np.inf))
        place, normal = edge.at(s)
        area = np.column_stack([normal * s_weight[:, None], np.zeros(len(s))])
        yield (np.column_stack([np.repeat(place, len(z), axis=0), np.tile(z, len(s))]),
               (area[:, None] * z_weight[None, :, None]).reshape(-1, 3))
        if not four:  # triangles from the middle to the edge
            middle = corners.mean(axis=0)
            r, r_weight = (t, weight * t)
            flat = middle + r[:, None, None] * (place - middle)
            share = np.outer(r_weight, s_weight * np.sum((place - middle) * normal, axis=1))
            yield from _ends(block, flat.reshape(-1, 2), share.ravel())
    if four:
        near, far = block.outline[3], block.outline[1]
        length = max(far.length, near.length)
        s, s_weight = _panels(t, weight, length, size)
        depth = max(block.outline[k].length for k in (0, 2))
        r, r_weight = _panels(t, weight, depth, size)
        (outer, outer_normal), (inner, inner_normal) = far.at(s), near.at(1 - s)
        flat = inner + r[:, None, None] * (outer - inner)
        normal = -inner_normal + r[:, None, None] * (outer_normal + inner_normal)
        share = np.einsum("ti,sti->st", outer - inner, normal) * np.outer(r_weight, s_weight)
        yield from _ends(block, flat.reshape(-1, 2), share.ravel())


def _ends(block: MagnetBlock, flat: Floats, area: Floats) -> Iterator[tuple[Floats, Floats]]:
    """Yield points and area vectors of both ends of a block, see `_faces`."""
    zero = np.zeros(len(flat))
    for z, sign in ((block.z_min, -1), (block.z_max, 1)):
        yield at_heights(flat, z), np.column_stack([zero, zero, sign * area])


def _graded(order: int) -> tuple[Floats, Floats]:
    """Return points and weights (order,) of a quadrature from 0 to 1, by ``t = 3 x^2 - 2 x^3``.

    A few points, which smooth fields have, are those of Gauss and Legendre.
    """
    nodes, weights = np.polynomial.legendre.leggauss(order)
    x, weights = (nodes + 1) / 2, weights / 2
    if order < NEAR_ORDERS[0]:
        return x, weights
    return x * x * (3 - 2 * x), weights * 6 * x * (1 - x)


def _panels(t: Floats, weight: Floats, length: float, size: float) -> tuple[Floats, Floats]:
    """Repeat a quadrature from 0 to 1 on equal parts of a length that are not longer than size."""
    # largest side of a part of a face, relative to the cube root of the block's volume
    longest = 1.5
    count = max(1, int(np.ceil(length / size * (1 - 1e-9) / longest)))
    starts = np.arange(count)[:, None]
    return ((starts + t) / count).ravel(), np.tile(weight / count, count)


@dataclass(frozen=True)
class Gap:
    """A plane through ``origin`` (3,) in m between two bodies, with ``normal`` (3,) to the second.

    ``width`` in m is the distance of the bodies across it; ``low`` and ``high`` (2,) in m are how
    far both reach along it, on the axes of `_tangents`.
    """

    origin: Floats
    normal: Floats
    width: float
    low: Floats
    high: Floats

    def points(self, panels: int) -> tuple[Floats, Floats]:
        """Return points (n, 3) in m of the plane and their areas (n,), to infinity.

        Each side has at most ``panels`` parts of four Gauss points, as wide as the gap or wider.
        """
        rules = [_line(low, high, max(1, min(panels, int(np.ceil((high - low) / self.width)))))
                 for low, high in zip(self.low, self.high, strict=True)]
        (u, of_u), (v, of_v) = rules
        first, second = _tangents(self.normal)
        places = (u[:, None, None] * first + v[:, None] * second
                  + (self.origin @ self.normal) * self.normal)
        return places.reshape(-1, 3), np.outer(of_u, of_v).ravel()


def _tangents(normal: Floats) -> Floats:
    """Return two unit vectors (2, 3) along a plane."""
    seed = np.eye(3)[np.abs(normal).argmin()]
    first = np.cross(normal, seed)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(normal, first)])


def _line(low: float, high: float, panels: int) -> tuple[Floats, Floats]:
    """Return points and weights from minus to plus infinity, in equal panels between two places."""
    x, weight = np.polynomial.legendre.leggauss(4)
    x, weight = (x + 1) / 2, weight / 2
    step = (high - low) / panels
    inner = (low + step * (np.arange(panels)[:, None] + x)).ravel()
    # outside, x = high + size t / (1 - t): products of two dipoles' fields fall with the power 6
    t, of_t = np.polynomial.legendre.leggauss(8)
    t, of_t = (t + 1) / 2, of_t / 2
    away, of_away = (high - low) * t / (1 - t), (high - low) * of_t / (1 - t) ** 2
    return (np.concatenate([low - away, inner, high + away]),
            np.concatenate([of_away, np.tile(step * weight, panels), of_away]))


def iron_loads(magnet: Magnet, charges: Sequence[tuple[Floats, Floats]],
               iron: IronReaction | BodiesReaction) -> IronLoads:
    """Compute the forces on the iron of a magnet.

    Parameters
    ----------
    charges : sequence of two pairs
        Points (n, 3) in m on the faces of the blocks, and their magnetic charges (n,) in A m: of a
        good quadrature, and of a coarser one for the error bar.
    iron : IronReaction or BodiesReaction
        Its solution, with a coarser one for the error bar.
    """
    sources = [(*charge, *coils) for charge, coils in zip(
        charges, _coil_elements(magnet, iron), strict=True)]
    if not isinstance(iron, BodiesReaction):
        rough = iron.coarse or iron
        found, other = (_of_sources(source, each.field)
                        for source, each in zip(sources, (iron, rough), strict=True))
        return IronLoads(("iron",), found[None], np.array([np.linalg.norm(found - other)]))
    groups, gaps = _groups(iron)
    found, other = (_of_bodies(source, each, groups, gaps, panels) for source, each, panels
                    in zip(sources, (iron, iron.coarse or iron), (40, 20), strict=True))
    return IronLoads(tuple(f"iron {' and '.join(str(number + 1) for number in group)}"
                           for group in groups), found, np.linalg.norm(found - other, axis=1))


Sources = tuple[Floats, Floats, Floats, Floats]
"""Points (n, 3) in m and magnetic charges (n,) in A m of blocks; places (m, 3) in m of pieces of
coils, and I dl (m, 3) in A m."""


def _coil_elements(
    magnet: Magnet, iron: IronReaction | BodiesReaction
) -> Iterator[tuple[Floats, Floats]]:
    """Yield places and I dl of the pieces of all coils, of a fine and a coarser division.

    The field of iron varies along a winding over the distance of the iron: pieces are shorter than
    that by a factor by which Gauss's rule is right to 1e-5, and twice as long for the error bar;
    also where there would be too many, and they are as long as the number that they may have.
    """
    coils = magnet.external.coils
    tree = KDTree(iron.nodes(64)) if coils else None
    apart = [float(tree.query(points_in_winding(coil))[0].min()) for coil in coils if tree]
    for share, most in ((0.3, 40_000), (0.6, 5_000)):
        pieces = [(np.zeros((0, 3)), np.zeros((0, 3))), *(
            current_elements(coil, share * away, most)
            for coil, away in zip(coils, apart, strict=True))]
        places, currents = (np.vstack(each) for each in zip(*pieces, strict=True))
        yield places, currents


def _of_bodies(
    sources: Sources, iron: BodiesReaction, groups: Sequence[tuple[int, ...]],
    gaps: dict[tuple[int, int], Gap], panels: int,
) -> Floats:
    """Return the forces (groups, 3) in N on groups of bodies, see `iron_loads` and `_groups`."""
    def field(number: int) -> Field:
        return lambda points: iron.field_of_bodies(groups[number], points)

    found = np.array([_of_sources(sources, field(number)) for number in range(len(groups))])
    for (first, second), gap in gaps.items():
        points, areas = gap.points(panels)
        one, other = field(first)(points), field(second)(points)
        stress = (one * (other @ gap.normal)[:, None] + other * (one @ gap.normal)[:, None]
                  - np.einsum("ni,ni->n", one, other)[:, None] * gap.normal)
        force = areas @ stress / MU_0
        found[first] += force
        found[second] -= force
    return found


def _of_sources(sources: Sources, field: Field) -> Floats:
    """Return the force (3,) in N of blocks and coils on iron with a field of its own."""
    points, charges, places, currents = sources
    found = -charges @ field(points)
    if len(places):
        found -= np.cross(currents, field(places)).sum(axis=0)
    return np.asarray(found)


def _groups(iron: BodiesReaction) -> tuple[list[tuple[int, ...]], dict[tuple[int, int], Gap]]:
    """Return the bodies that feel a force together, and the gaps between two such groups."""
    problem = iron.problem
    places = [problem.places[problem.body == number].reshape(-1, 3)
              for number in range(len(problem.bodies))]
    label = np.arange(len(places))
    while True:
        numbers = [tuple(np.flatnonzero(label == one).tolist()) for one in np.unique(label)]
        gaps, joined = {}, np.eye(len(numbers))
        for first, second in combinations(range(len(numbers)), 2):
            axes = [rotation_matrix(problem.bodies[number].turn_rad).T
                    for number in (*numbers[first], *numbers[second])]
            one, other = (np.vstack([places[number] for number in numbers[each]])
                          for each in (first, second))
            gap = _gap(one, other, np.vstack([np.eye(3), *axes]))
            if gap is None:
                joined[first, second] = 1.0
            else:
                gaps[first, second] = gap
        count, group = connected_components(sparse.csr_array(joined), directed=False)
        if count == len(numbers):
            return numbers, gaps
        for members, together in zip(numbers, group, strict=True):
            label[list(members)] = together


def _gap(first: Floats, second: Floats, axes: Floats) -> Gap | None:
    """Return the widest gap between points (n, 3) and (m, 3) across one of the axes (k, 3)."""
    both = np.vstack([first, second])
    between = second.mean(axis=0) - first.mean(axis=0)
    axes = np.vstack([axes, between / (np.linalg.norm(between) or 1.0)])
    axes = np.vstack([axes, -axes])
    widths = (second @ axes.T).min(axis=0) - (first @ axes.T).max(axis=0)
    best = int(widths.argmax())
    touching = 1e-6 * float(np.ptp(both, axis=0).max())
    if widths[best] <= touching:
        return None
    normal = axes[best]
    along = both @ _tangents(normal).T
    return Gap(((first @ normal).max() + widths[best] / 2) * normal, normal, float(widths[best]),
               along.min(axis=0), along.max(axis=0))
