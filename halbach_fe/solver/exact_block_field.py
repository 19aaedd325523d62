"""Exact field in vacuum: of uniformly magnetized prisms by their surface charge, and of coils.

**Blocks.** A block of uniform polarization J = B_r (recoil permeability 1) has the surface charge J
. n. For a prism along z with outline C between z1 and z2 the field outside is a sum of line
integrals over C only. With R the distance from the source to the point, rho the vector from the
source to the point in the plane, and u = z - z':

* side faces, charge J_t . n: integrating along z in closed form leaves
  ``B_t = 1/4pi int (J.n) rho/rho^2 [-u/R] dl`` and ``B_z = 1/4pi int (J.n) [1/R] dl``,
  the brackets being differences between z' = z2 and z1;
* end faces, charge +-J_z: the divergence theorem in the plane of the face gives
  ``B_t = +- J_z/4pi int n/R dl`` (+ at the upper face) and the solid angle
  ``B_z = +- J_z/4pi int (rho.n/rho^2) (sign u - u/R) dl``, where rho points the other way, from
  the point's projection to the source.

See J. D. Jackson, Classical Electrodynamics, 3rd ed., section 5.9, for the charge model. The
brackets are evaluated in a form without cancellation, so that points on the prolongation of a
vertical edge, above or below the block, are not singular. In two dimensions [-u/R] is 2 and only
B_t remains.

On straight edges the integrals are elementary; on arcs they are evaluated by Gauss-Legendre
quadrature on panels that are no longer than their distance from the point, to an error of 1e-15 of
the field. `halbach_fe.solver.field_kernels` has them in compiled form.

Fields of external sources (background, neighbouring magnets, objects, coils) are added in
vacuum: the magnet's permeability and iron do not react to them, but for iron of any shape, see
`halbach_fe.solver.separate_blocks`.

**Coils** follow Biot and Savart's law in closed forms. A round coil is the sum over radii, by
Gauss-Legendre quadrature, of thin solenoids (N. Derby, S. Olbert, Am. J. Phys. 78 (2010) 229, with
Carlson's integrals) or, without a length, of loops (J. D. Jackson, Classical Electrodynamics, 3rd
ed., section 5.5). Other coils are filaments of straight segments (J. D. Hanson, S. P. Hirshman,
Phys. Plasmas 9 (2002) 4410). For points nearer than half a side of the section the winding is
halved across that side, again and again, until 8 radii, or 4 x 4 filaments, serve for each part;
corners near a point have more chords than 12.

Against many more loops the field of a round coil was measured to be 1e-6 of the largest one off at
1 mm from a winding of 20 mm, and that of racetracks, with round corners of 100 mm, 5e-4 from 0.1 to
20 mm. Beside the thin wire of such a corner it is 1e-3 at 1 mm, and 4e-3 at 0.1 mm. `closest` says
where windings begin.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from scipy import special

from halbach_fe.core.arrays import Floats, azimuths_of, radii_of, slices, unit_circle
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.threads import in_threads, share_out
from halbach_fe.geometry.blocks import MagnetBlock, frames_of, rotation_about_z, rotation_matrix
from halbach_fe.geometry.coils import closed_polygon, closest, distance, turn_corners
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Outline, ring_radii
from halbach_fe.solver.field_kernels import arc_table, cuboid_fields, outline_fields
from halbach_fe.solver.moments.cells import cells_of
from halbach_fe.study.external_keys import AnyCoil, Neighbour, Racetrack, RoundCoil, check_apart
from halbach_fe.study.materials import MU_0

_AT_ONCE = 100_000
"""Number of points at which blocks of the same shape are evaluated at once: some 10 MB."""

_DIGITS = 13
"""Of lengths in m, of blocks of the same shape: more than some rounding errors."""

_RECTANGULAR = 1e-13
"""Largest deviation of a rectangle's corners, relative to its sides: some rounding errors."""


def unit_field(block: MagnetBlock, points: Floats) -> Floats:
    """Return the field of one block in vacuum for remanences of 1 T along x, y and z.

    Parameters
    ----------
    block : MagnetBlock
        Infinite ``z_min``, ``z_max`` give the field of the two-dimensional cross-section.
    points : ndarray, shape (n, 3), in m
        Points off the block's edges, where the field is infinite. On a face the result is the limit
        from outside. Inside the block it is mu_0 H instead of B.

    Returns
    -------
    ndarray, shape (n, 3, 3)
        ``[i, c, k]``: component c of B in T at point i for a remanence of 1 T along k.
    """
    field = matrix_of(_local_field(block, points))
    return field if block.in_magnet_frame else block.axes @ field @ block.axes.T


def _local_field(block: MagnetBlock, points: Floats) -> Floats:
    """Return the field matrices (n, 6) of a block along its own axes, at points of the magnet."""
    return _frame_field(block, points if block.in_magnet_frame else block.to_frame(points))


def _frame_field(block: MagnetBlock, points: Floats) -> Floats:
    """Return the field matrices (n, 6) of a block at points (n, 3) of its frame."""
    points = np.ascontiguousarray(points, float)
    contact = block.contact_in_frame(points)
    if contact.on_face.any():
        points = points + contact.outward
    weighted = [factor * _outline_field(part, points) for factor, part in block.parts]
    return weighted[0] if len(weighted) == 1 else np.sum(weighted, axis=0)


def unit_fields(blocks: Sequence[MagnetBlock], points: Floats) -> Iterator[Floats]:
    """Yield `unit_field` of every block, in order; blocks of one shape are evaluated at once."""
    most = 1 + _AT_ONCE // max(1, len(points))
    basis = matrix_of(np.eye(6))
    for some in (blocks[part] for part in slices(len(blocks), most)):
        found = np.empty((len(some), len(points), 6))
        for same in _alike(some):
            alike = _Alike.of([some[number] for number in same])
            fields, axes = alike.fields(points), alike.axes
            turned = axes[:, None] @ basis @ axes[:, None].transpose(0, 1, 3, 2)
            found[same] = fields @ turned[..., [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        yield from map(matrix_of, found)


def _outline_field(block: MagnetBlock, points: Floats) -> Floats:
    """Return the field matrices (n, 6) of a uniform block at points (n, 3) of its frame.

    The order of the components is xx, yy, zz, xy, xz, yz.
    """
    out = np.empty((len(points), 6))
    rectangle = _rectangle(block.outline)
    # number of points that a thread evaluates at a time: several milliseconds of work, beside which
    # 0.3 ms of starting a thread do not count. A point takes 0.1 us by the closed form of cuboids.
    points_per_thread, cuboid_points_per_thread = 10_000, 30_000
    if rectangle is not None and np.isfinite(block.z_max):
        (x, y), (a, b), cosine, sine = rectangle
        share = cuboid_points_per_thread
        work = partial(
            cuboid_fields, np.array([x, y, (block.z_min + block.z_max) / 2]),
            np.array([a, b, (block.z_max - block.z_min) / 2]), cosine, sine, points)
    else:
        share = points_per_thread
        edges = [(*edge.start, *edge.end) for edge in block.outline if not edge.arc
                 and not ring_radii(block.outline)]  # charges on both sides of a seam cancel
        arcs = [(edge.radius, *edge.angles) for edge in block.outline if edge.arc]
        tables = [arc_table(sweep) for _, _, sweep in arcs] or [arc_table(0.0)]
        work = partial(
            outline_fields, np.array(edges).reshape(-1, 4), np.array(arcs).reshape(-1, 3),
            np.stack([turns for turns, _ in tables]), tables[0][1], block.z_min, block.z_max,
            points)
    in_threads(lambda first, last: work(first, last, out),
               share_out(len(points), 1 + len(points) // share))
    return out


@lru_cache(maxsize=4096)
def _rectangle(outline: Outline) -> tuple[Floats, Floats, float, float] | None:
    """Return middle (2,) and half sides (2,) in m of a rectangle, and cosine and sine of the angle
    from x to its first side; None if an outline is none.
    """
    if len(outline) != 4 or any(edge.arc for edge in outline):
        return None
    corners = np.array([edge.start for edge in outline])
    first, second = corners[1] - corners[0], corners[3] - corners[0]
    length, width = np.hypot(*first), np.hypot(*second)
    small = _RECTANGULAR * (length + width)
    if np.abs(corners[2] - corners[1] - second).max() > small or (
            abs(first @ second) > small * min(length, width)):
        return None
    cosine, sine = (first / length).tolist()
    return corners.mean(axis=0), np.array([length, width]) / 2, cosine, sine


def matrix_of(six: Floats) -> Floats:
    """Return symmetric matrices (..., 3, 3) of components (..., 6) xx, yy, zz, xy, xz, yz."""
    return six[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]


def field_of(blocks: Sequence[MagnetBlock], points: Floats) -> Floats:
    """Return B (n, 3) in T of blocks with their nominal remanence in vacuum.

    Blocks of the same shape, such as those of a ring, are evaluated at once, each at the points of
    its frame. At points inside a block the result lacks the block's own remanence, see
    `unit_field`.
    """
    return _sum_of(_all_alike(blocks), points)


def _sum_of(groups: Sequence[_Alike], points: Floats) -> Floats:
    """Return `field_of` all blocks of groups."""
    total, most = np.zeros((len(points), 3)), 1 + _AT_ONCE // max(1, len(points))
    for group in groups:
        for part in slices(len(group.axes), most):
            total += (group.fields(points, part) @ group.sums[part]).sum(axis=0)
    return total


def _all_alike(blocks: Sequence[MagnetBlock]) -> list[_Alike]:
    """Return blocks in groups of the same shape."""
    return [_Alike.of([blocks[number] for number in same]) for same in _alike(blocks)]


def _alike(blocks: Sequence[MagnetBlock]) -> list[list[int]]:
    """Return the numbers of blocks of the same shape, but for turns and shifts in their frames."""
    alike: dict[object, list[int]] = defaultdict(list)
    for number, block in enumerate(blocks):
        alike[_upright(block.outline, _turn_deg(block)), round(block.z_max - block.z_min, _DIGITS),
              block.gradient, block.corner_loss].append(number)
    return list(alike.values())


def _turn_deg(block: MagnetBlock) -> float:
    """Return the angle by which a block's outline is turned in its frame, in degrees."""
    return 0.0 if any(block.origin_m) or any(block.orientation_rad) else block.angle_deg


@lru_cache(maxsize=4096)
def _upright(outline: Outline, angle_deg: float) -> tuple[object, ...]:
    """Return what outlines have in common that are turned by different angles about z."""
    corners = [corner for edge in outline for corner in (edge.start, edge.end)]
    turned = np.round(corners @ rotation_about_z(np.radians(angle_deg))[:2, :2], _DIGITS)
    return tuple(turned.ravel().tolist()), tuple(edge.arc for edge in outline)


@dataclass(frozen=True)
class _Alike:
    """Blocks of the same shape, and what of their fields does not depend on the points."""

    first: MagnetBlock
    positions: Floats
    axes: Floats
    """Of frames, with the axes as columns, in which the outlines of all blocks are that of the
    first one. Shapes (blocks, 3) in m and (blocks, 3, 3)."""
    sums: Floats
    """From the field matrices in such a frame to the field of the nominal remanence.
    Shape (blocks, 6, 3), in T."""

    @classmethod
    def of(cls, blocks: Sequence[MagnetBlock]) -> _Alike:
        """Prepare `_alike` blocks."""
        positions, axes = frames_of(blocks)
        axes = axes @ np.array([
            rotation_about_z(np.radians(_turn_deg(block) - _turn_deg(blocks[0])))
            for block in blocks])
        if np.isfinite(blocks[0].z_min):
            z = np.array([block.z_min for block in blocks])
            positions = positions + (z - z[0])[:, None] * axes[:, :, 2]
        remanences = np.array([block.polarization for block in blocks])
        sums = _sums(np.einsum("bik,bi->bk", axes, remanences)) @ axes.transpose(0, 2, 1)
        return cls(blocks[0], positions, axes, sums)

    def fields(self, points: Floats, part: slice = slice(None)) -> Floats:
        """Return the field matrices (blocks, n, 6) of a part of the blocks along their axes."""
        places = (points - self.positions[part, None]) @ self.axes[part]
        return _frame_field(self.first, places.reshape(-1, 3)).reshape(len(places), -1, 6)


def _sums(polarization: Floats) -> Floats:
    """Return the matrices (..., 6, 3) that multiply six components of a field matrix from the
    right, as a polarization (..., 3) in T multiplies the matrix, see `matrix_of`.
    """
    x, y, z = np.moveaxis(polarization, -1, 0)
    zero = np.zeros_like(x)
    return np.moveaxis(np.array([
        [x, zero, zero], [zero, y, zero], [zero, zero, z], [y, x, zero], [z, zero, x],
        [zero, z, y]]), (0, 1), (-2, -1))


class FieldOfBlocks:
    """`field_of` blocks as a function: for many calls, and in less time on circles around z.

    Points (angles k, 3) at equidistant angles, angle by angle, are mapped onto each other by turns
    about z. Of blocks that such turns map onto each other, as those of a ring, one is evaluated.
    """

    def __init__(self, blocks: Sequence[MagnetBlock]) -> None:
        self.blocks = blocks
        self._groups = _all_alike(blocks)

    def __call__(self, points: Floats) -> Floats:
        """Return B (n, 3) in T at points (n, 3) in m."""
        angles = _equidistant_angles(points)
        if angles == 1:
            return _sum_of(self._groups, points)
        total = np.zeros((angles, len(points) // angles, 3))
        for members in _turned_blocks(
                self.blocks, points[[0, len(points) // 3, 2 * len(points) // 3]], angles):
            first = members[0][1]
            local = _local_field(first, points)
            for steps, block in members:
                turn = rotation_about_z(2 * np.pi * steps / angles)
                axes = first.axes
                sums = _sums(axes.T @ turn.T @ block.polarization)
                field = (local @ (sums @ axes.T @ turn.T)).reshape(total.shape)
                total[steps:] += field[:angles - steps]
                total[:steps] += field[angles - steps:]
        return total.reshape(-1, 3)


def _equidistant_angles(points: Floats) -> int:
    """Return at how many equidistant angles points (angles k, 3) on circles lie; 1 for others."""
    if len(points) < 2:
        return 1
    radius = radii_of(points)
    # distance, relative to the largest coordinate, below which points are the same: some rounding
    # errors
    rounding = 1e-13
    small = rounding * max(float(radius.max()), float(np.abs(points[:, 2]).max()))
    again = np.flatnonzero(np.hypot(radius - radius[0], points[:, 2] - points[0, 2]) <= small)
    count = int(again[1]) if len(again) > 1 else 0
    if not count or len(points) % count:
        return 1
    angles = len(points) // count
    turns = np.array([rotation_about_z(angle)
                      for angle in 2 * np.pi * np.arange(angles) / angles])
    expected = np.einsum("acd,kd->akc", turns, points[:count]).reshape(-1, 3)
    return angles if np.abs(expected - points).max() <= small else 1


def _turned_blocks(
    blocks: Sequence[MagnetBlock], probes: Floats, angles: int
) -> list[list[tuple[int, MagnetBlock]]]:
    """Return the blocks in groups of the same shape, but for turns about z by whole steps.

    Every block is given with its number of steps, each an ``angles``-th of a turn, from the first
    block of its group. Blocks of the same field at three probes (3, 3) in m have the same shape.
    """
    groups: list[list[tuple[int, MagnetBlock]]] = []
    # relative difference of the fields of two blocks that is rounding. A block that is displaced by
    # a nanometre differs by more.
    rounding = 1e-11
    for block in blocks:
        own = unit_field(block, probes)
        for group in groups:
            first = group[0][1]
            if (first.z_min, first.z_max) != (block.z_min, block.z_max):
                continue
            steps = (block.angle_deg - first.angle_deg) / 360 * angles
            turn = rotation_about_z(2 * np.pi * round(steps) / angles)
            turned = turn @ unit_field(first, probes @ turn) @ turn.T
            if np.abs(turned - own).max() <= rounding * np.abs(own).max():
                group.append((round(steps) % angles, block))
                break
        else:
            groups.append([(0, block)])
    return groups


def gradient_of(blocks: Sequence[MagnetBlock], points: Floats) -> Floats:
    """Return the gradient of `field_of` at points (n, 3) in m off the blocks, (n, 3, 3) in T/m.

    ``[i, c, k]`` is the derivative of component c along k. Its relative error is 1e-4 at a distance
    of a hundredth of the radius from a block, which suffices for the size of a noise or the
    signature of an effect.
    """
    total = np.zeros((len(points), 3, 3))
    for gradient in block_gradients(blocks, points):
        total += gradient
    return total


def block_gradients(blocks: Sequence[MagnetBlock], points: Floats) -> Iterator[Floats]:
    """Yield the contribution of every block to `gradient_of`, (n, 3, 3) in T/m.

    The radial and azimuthal derivatives are central differences, or one-sided ones where a step
    would lead into the block. Those along z follow from curl B = 0 and div B = 0.
    """
    angle = azimuths_of(points)
    zero = np.zeros(len(points))
    radial = np.column_stack([np.cos(angle), np.sin(angle), zero])
    azimuthal = np.column_stack([-np.sin(angle), np.cos(angle), zero])
    # step of finite differences, relative to the largest radius of the blocks. Their relative error
    # is the square of the step over the distance to a block.
    relative_step = 1e-4
    step = relative_step * max(edge.radius for block in blocks for edge in block.outline)
    places = np.vstack([points + sign * step * along for along in (radial, azimuthal)
                        for sign in (1, -1)])
    for block in blocks:
        inside = block.contains(places).reshape(2, 2, -1)
        inside &= ~inside.all(axis=1, keepdims=True)
        own = np.where(inside.reshape(-1, 1), np.tile(points, (4, 1)), places)
        fields = (unit_field(block, own) @ (
            block.polarization)).reshape(2, 2, -1, 3)
        across = step * (2 - inside.sum(axis=1))
        by_radius, by_angle = (fields[:, 0] - fields[:, 1]) / across[..., None]
        expansion = np.sum(by_radius * radial + by_angle * azimuthal, axis=1)
        by_z = by_radius[:, 2:] * radial + by_angle[:, 2:] * azimuthal
        by_z[:, 2] = -expansion
        yield (by_radius[:, :, None] * radial[:, None] + by_angle[:, :, None] * azimuthal[:, None]
               + by_z[:, :, None] * np.eye(3)[2])


def demagnetizing_tensors(blocks: Sequence[MagnetBlock]) -> Floats:
    """Return the magnetometric demagnetizing tensors N (blocks, 3, 3), of whatever outline.

    If a block is magnetized uniformly, its own field averaged over its volume is H = -N M. The
    average is computed by Gauss quadrature of the exact field in cells, with an error of 3e-4, as
    the field has logarithmic singularities along the edges; of rods and rings, whose arcs are
    chords of cells, it is 1e-3. (The usual approximation by a cuboid with the block's mean sides
    would have an error of 1e-2 for sectors.)
    """
    per_side, divisions = 2, 4  # cells along a side of a cube, and nodes along one of a cell
    tensors = np.empty((len(blocks), 3, 3))
    for same in _alike(blocks):  # of which one tells what all have along their own axes
        alike = _Alike.of([blocks[number] for number in same])
        cells = cells_of([alike.first], per_side, divisions)
        points = alike.first.to_frame(cells.nodes.reshape(-1, 3))
        # chords leave arcs: the field of nodes beyond them is not that in the block
        inside = alike.first.contact_in_frame(points).inside
        weights = (cells.weights * cells.volume[:, None]).ravel() * inside
        average = matrix_of(weights @ _outline_field(alike.first, points)) / weights.sum()
        tensors[same] = -alike.axes @ average @ alike.axes.transpose(0, 2, 1)
    return tensors


def remanence_per_polarization(blocks: Sequence[MagnetBlock]) -> list[Floats]:
    """Return ``1 + (mu - 1) N`` (3, 3) of every block, with its demagnetizing tensor N.

    It turns the mean polarization of the lone block, mu_0 times the moment per volume, into B_r:
    with the mean H = -N M, ``B = mu_0 mu H + B_r`` gives ``B_r = (1 + (mu - 1) N) mu_0 M``.
    """
    return [np.eye(3) + (block.recoil_tensor - np.eye(3)) @ tensor
            for block, tensor in zip(blocks, demagnetizing_tensors(blocks), strict=True)]


def external_field(magnet: Magnet, points: Floats) -> Floats:
    """Return B (n, 3) in T of the study's external sources at points (n, 3) in m.

    Raises
    ------
    StudyError
        If a point is at a dipole or in a coil.
    """
    external = magnet.external
    check_apart(external, points, magnet.name)
    field = np.tile(external.background_T, (len(points), 1)).astype(float)
    for neighbour in external.neighbours:
        field += neighbour_field(magnet, neighbour, points)
    for dipole in external.dipoles:
        field += dipole_field(np.array(dipole.position_m), np.array(dipole.moment_A_m2), points)
    for coil in external.coils:
        field += coil_field(coil, points, magnet.name)
    return field


def external_gradient(magnet: Magnet, points: Floats) -> Floats:
    """Return the gradient of `external_field`, (n, 3, 3) in T/m, by central differences.

    Element ``[i, c, j]`` is the derivative of component c along direction j.
    """
    external = magnet.external
    if not (external.neighbours or external.dipoles or external.coils):
        return np.zeros((len(points), 3, 3))
    step = 1e-4 * np.eye(3)  # in m, small beside the distance of any source
    return np.stack([external_field(magnet, points + one) - external_field(magnet, points - one)
                     for one in step], axis=2) / 2e-4


def neighbour_field(magnet: Magnet, neighbour: Neighbour, points: Floats) -> Floats:
    """Return B (n, 3) in T of a second magnet of the study's blocks, shifted along z and turned.

    Its permeability is that of vacuum, and its remanence is scaled by ``neighbour.factor``.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    """
    turn = rotation_about_z(np.radians(neighbour.turn_deg))
    local_points = (points - [0.0, 0.0, neighbour.z_m]) @ turn
    return np.asarray(neighbour.factor * field_of(magnet.blocks, local_points) @ turn.T)


def dipole_field(position: Floats, moment: Floats, points: Floats) -> Floats:
    """Return B (n, 3) in T of a point dipole at points (n, 3) in m.

    ``position`` (3,) is in m and ``moment`` (3,) in A m^2. See J. D. Jackson, Classical
    Electrodynamics, 3rd ed., eq. 5.56.
    """
    offset = points - position
    distance = np.linalg.norm(offset, axis=1)[:, None]
    direction = offset / distance
    along = (direction @ moment)[:, None]
    return np.asarray(MU_0 / (4 * np.pi) * (3 * along * direction - moment) / distance**3)


def coil_field(coil: AnyCoil, points: Floats, name: str) -> Floats:
    """Return B (n, 3) in T of a coil of study ``name`` at points (n, 3) in m.

    Raises
    ------
    StudyError
        If a point lies in the winding, or nearer to it than `closest`.
    """
    axes = rotation_matrix(tuple(np.radians(coil.rotation_deg).tolist()))
    own = (points - coil.centre_m) @ axes
    near = np.flatnonzero(distance(coil, own) < closest(coil))
    if len(near):
        x, y, z = points[near[0]]
        raise StudyError(must_be(
            "`external.coils`", f"study {name}", "clear of readings, blocks and iron",
            f"a coil ({coil.kind}) whose winding holds, or all but touches, the point ({x:g}, "
            f"{y:g}, {z:g}) m", "Move the coil, or what is in its winding; they must stay "
            f"{1e3 * closest(coil):.2g} mm apart."))
    current = MU_0 * coil.current_A * coil.turns
    if coil.kind == "polygon":
        found = _straight(np.ones(1), closed_polygon(coil)[None], own)
    else:
        found = _round(coil, own) if coil.kind == "round" else _racetrack(coil, own)
    return np.asarray(current * found @ axes.T)


def _gauss(side: float, count: int) -> tuple[Floats, Floats]:
    """Return places in m across a side and their weights, which add up to 1."""
    if not side:
        return np.zeros(1), np.ones(1)
    places, weights = np.polynomial.legendre.leggauss(count)
    return places * side / 2, weights / 2


def _round(coil: RoundCoil, points: Floats) -> Floats:
    """Return B (n, 3) of a round coil of mu_0 N I = 1 at points in its own axes."""
    near = distance(coil, points) < coil.section_m[0] / 2
    found = np.zeros((len(points), 3))
    found[~near] = _thin_solenoids(coil, points[~near])
    if near.any():
        width, length = coil.section_m
        for offset in (-width / 4, width / 4):
            half = coil.model_copy(update={
                "section_m": (width / 2, length), "radius_m": coil.radius_m + offset})
            found[near] += _round(half, points[near]) / 2
    return found


def _thin_solenoids(coil: RoundCoil, points: Floats) -> Floats:
    """Return B (n, 3) of a round coil as the sum over 8 radii."""
    rho, z = np.hypot(*points[:, :2].T), points[:, 2]
    half = coil.section_m[1] / 2
    along_rho, along_z = np.zeros(len(points)), np.zeros(len(points))
    for offset, weight in zip(*_gauss(coil.section_m[0], 8), strict=True):
        part = (_sheet(coil.radius_m + offset, half, rho, z) if half
                else _loop(coil.radius_m + offset, rho, z))
        along_rho += weight * part[0]
        along_z += weight * part[1]
    direction = points[:, :2] / np.maximum(rho, 1e-300)[:, None]
    return np.column_stack([along_rho[:, None] * direction, along_z])


def _loop(radius: float, rho: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return B_rho and B_z (n,) of a loop of mu_0 I = 1."""
    far, near = (radius + rho) ** 2 + z**2, (radius - rho) ** 2 + z**2
    first, second = special.ellipkm1(near / far), special.ellipe(1 - near / far)
    scale = 1 / (2 * np.pi * np.sqrt(far))
    square = rho**2 + z**2
    on_axis = rho < 1e-9 * radius
    along_rho = scale * z / np.where(on_axis, 1.0, rho) * (
        (radius**2 + square) / near * second - first)
    return np.where(on_axis, 0.0, along_rho), scale * (
        first + (radius**2 - square) / near * second)


def _sheet(radius: float, half: float, rho: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return B_rho and B_z (n,) of a thin solenoid with mu_0 N I = 1, ``half`` as long as it is."""
    ratio = (radius - rho) / (radius + rho)
    ratio = np.where(np.abs(ratio) < 1e-10, 1e-10, ratio)  # its limit, beyond the ends
    found = np.zeros((2, len(rho)))
    for sign in (1.0, -1.0):
        end = z + sign * half
        far = end**2 + (radius + rho) ** 2
        square = (end**2 + (radius - rho) ** 2) / far
        first = special.elliprf(0.0, square, 1.0)
        found[0] += sign * radius / np.sqrt(far) * (
            first - 2 / 3 * special.elliprd(0.0, square, 1.0))
        found[1] += sign * end / np.sqrt(far) * radius / (radius + rho) * (
            first + (ratio - ratio**2) / 3 * special.elliprj(0.0, square, 1.0, ratio**2))
    along_rho, along_z = found / (2 * np.pi * half)
    return along_rho, along_z


def _racetrack(coil: Racetrack, points: Floats, chords: int = 12) -> Floats:
    """Return B (n, 3) of a racetrack of mu_0 N I = 1 at points in its own axes."""
    radius = coil.corner_radius_m + coil.section_m[0] / 2
    chord = np.pi / 2 / chords * radius
    # Chords serve at twice their length, or where the point is 100 times as far from them as the
    # arc, chord^2 / (8 radius).
    needed = np.array([*np.array(coil.section_m) / 2,
                       min(2 * chord, 12.5 * chord**2 / (radius or 1.0))])
    side = int(needed.argmax())
    near = distance(coil, points) < needed[side]
    found = np.zeros((len(points), 3))
    found[~near] = _straight(*_filaments(coil, chords), points[~near])
    if near.any() and side == 2:
        found[near] = _racetrack(coil, points[near], 2 * chords)
    elif near.any():
        for sign in (-1, 1):
            half, place = _half(coil, side, sign)
            found[near] += _racetrack(half, points[near] - place, chords) / 2
    return found


def _half(coil: Racetrack, side: int, sign: int) -> tuple[Racetrack, Floats]:
    """Return the half of a racetrack on one side of its section's middle, and its place (3,)."""
    section = np.array(coil.section_m)
    section[side] /= 2
    offset = sign * section[side] / 2
    changes: dict[str, object] = {"section_m": tuple(section.tolist())}
    if side == 0:
        changes |= {"corner_radius_m": coil.corner_radius_m + offset,
                    "size_m": tuple(size + 2 * offset for size in coil.size_m)}
    return coil.model_copy(update=changes), np.array([0.0, 0.0, side * offset])


def _filaments(
    coil: Racetrack, chords: int, counts: tuple[int, int] = (4, 4)
) -> tuple[Floats, Floats]:
    """Return closed filaments: their shares (k,) of the current, and corners (k, m, 3) in m.

    ``counts`` are those of filaments across the turns and along z.
    """
    shares, found = [], []
    for across, share in zip(*_gauss(coil.section_m[0], counts[0]), strict=True):
        turn = turn_corners(coil, across, chords)
        for height, part in zip(*_gauss(coil.section_m[1], counts[1]), strict=True):
            shares.append(share * part)
            found.append(turn + np.array([0.0, 0.0, height]))
    return np.array(shares), np.array(found)


def current_elements(coil: AnyCoil, longest: float, most: int) -> tuple[Floats, Floats]:
    """Return places (n, 3) in m of pieces of a coil and I dl (n, 3) in A m, for forces on it.

    Pieces are at most ``longest`` in m, and Gauss points of the section as near to each other in
    the mean; both are larger where there would be more than ``most`` or so. Those of a circle are
    equal parts of it, whose sum converges faster than any power of their length.
    """
    part = 1 / 100  # of a turn that a piece may be
    sides = (0.0, 0.0) if coil.kind == "polygon" else coil.section_m
    if coil.kind == "round":
        line = coil.radius_m * unit_circle(np.linspace(0, 2 * np.pi, 101))
    else:
        line = closed_polygon(coil) if coil.kind == "polygon" else turn_corners(coil, 0.0, 12)
    turn = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
    longest = max(longest, turn / most)
    while True:
        piece = min(longest, part * turn)
        across, along = (max(4, int(np.ceil(side / longest))) if side else 1 for side in sides)
        if turn / piece * across * along <= most:
            break
        longest *= 1.1
    turns: Sequence[Floats] | Floats
    if coil.kind == "polygon":
        shares, turns = np.ones(1), [line]
    elif coil.kind == "racetrack":
        shares, turns = _filaments(coil, 12, (across, along))
    else:
        angle = np.linspace(0, 2 * np.pi, int(np.ceil(turn / piece - 1e-9)) + 1)
        # a polygon whose sides touch the circle in their middles, and are as long as its arcs
        circle = unit_circle(angle) / np.cos(angle[1] / 2)
        rules = _gauss(sides[0], across), _gauss(sides[1], along)
        shares = np.outer(*(rule[1] for rule in rules)).ravel()
        shares *= angle[1] / 2 / np.tan(angle[1] / 2)
        turns = [(coil.radius_m + off) * circle + np.array([0.0, 0.0, height])
                 for off in rules[0][0] for height in rules[1][0]]
    places, currents = [], []
    for share, one in zip(shares, turns, strict=True):
        parts = np.diff(one, axis=0)
        lengths = np.linalg.norm(parts, axis=1)
        exactly = lengths / (piece / turn * lengths.sum())
        counts = np.maximum(np.ceil(exactly - 1e-9).astype(int), 1)  # but for rounding
        number = np.repeat(np.arange(len(parts)), counts)
        within = (np.arange(len(number)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5)
        places.append(one[number] + (within / counts[number])[:, None] * parts[number])
        currents.append(share * parts[number] / counts[number][:, None])
    axes = rotation_matrix(tuple(np.radians(coil.rotation_deg).tolist()))
    return (np.vstack(places) @ axes.T + coil.centre_m,
            coil.current_A * coil.turns * np.vstack(currents) @ axes.T)


def _straight(shares: Floats, corners: Floats, points: Floats) -> Floats:
    """Return B (n, 3) of filaments of mu_0 I = 1, shares (k,) and corners (k, m, 3) in m."""
    starts, along = corners[:, :-1].reshape(-1, 3), np.diff(corners, axis=1).reshape(-1, 3)
    lengths = np.linalg.norm(along, axis=1)
    share = np.repeat(shares, corners.shape[1] - 1)[lengths > 0]
    starts, along, lengths = (part[lengths > 0] for part in (starts, along, lengths))
    found = np.zeros((len(points), 3))
    at_once = max(1, 100_000 // len(starts))  # so that arrays stay in the cache
    for some in slices(len(points), at_once):
        x, y, z = (points[some, None, i] - starts[:, i] for i in range(3))
        u, v, w = along.T
        near = np.sqrt(x**2 + y**2 + z**2)
        far = np.sqrt((x - u)**2 + (y - v)**2 + (z - w)**2)
        total = near + far
        factor = share * 2 * total / (near * far * (total**2 - lengths**2))
        found[some] = np.column_stack([
            np.einsum("nm,nm->n", factor, part)
            for part in (v * z - w * y, w * x - u * z, u * y - v * x)])
    return found / (4 * np.pi)
