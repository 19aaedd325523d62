"""Exact field of uniformly magnetized prisms in vacuum, by their surface charge.

A block of uniform polarization J = B_r (recoil permeability 1) has the surface charge J . n.
For a prism along z with outline C between z1 and z2 the field outside is a sum of line integrals
over C only. With R the distance from the source to the point, rho the vector from the source to the
point in the plane, and u = z - z':

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
the field. `halbach_fe.solver.prism_kernel` has them in compiled form.

Fields of external sources (background, neighbouring magnets, objects, coils) are added in
vacuum: the magnet's permeability and iron do not react to them, but for iron of any shape, see
`halbach_fe.solver.separate_blocks`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from halbach_fe.core.arrays import Floats, azimuths_of, radii_of, slices
from halbach_fe.core.threads import in_threads, share_out
from halbach_fe.geometry.blocks import MagnetBlock, frames_of, rotation_about_z
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Outline, ring_radii
from halbach_fe.solver.coil_field import coil_field
from halbach_fe.solver.moments.cells import cells_of
from halbach_fe.solver.prism_kernel import arc_table, cuboid_fields, outline_fields
from halbach_fe.study.magnet import Neighbour, check_apart
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
