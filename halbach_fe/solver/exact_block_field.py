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

The line integrals are evaluated by Gauss-Legendre quadrature on panels that are no longer than the
distance to the nearest point. It converges geometrically with the order, to an error of about 1e-12
of the field for the default order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.outline import Edge, Outline
from halbach_fe.geometry.symmetry import Frame, frame_of, rotation_about_z, unique_points

_ORDER = 12
"""Default number of Gauss points per panel."""

_STEP = 1e-4
"""Step of finite differences, relative to the largest radius of the blocks. Their relative error is
the square of the step over the distance to a block. The quadrature with four Gauss points adds an
error of 1e-4, measured at a distance of 3 % of the radius from the blocks."""

_CHUNK = 20_000_000  # largest number of values in the temporary arrays, 160 MB
_AT_ONCE = 4_000_000  # largest number of blocks times points that are searched for equal positions


def unit_field(
    block: MagnetBlock, points: Floats, order: int = _ORDER, panel: float | None = None
) -> Floats:
    """Return the field of one block in vacuum for remanences of 1 T along x, y and z.

    Parameters
    ----------
    block : MagnetBlock
        Infinite ``z_min``, ``z_max`` give the field of the two-dimensional cross-section.
    points : ndarray, shape (n, 3), in m
        Points off the block's surface, where the field is not defined. Inside the block the result
        is mu_0 H instead of B.
    order : int
        Gauss points per panel of the outline.
    panel : float, optional
        Longest panel in m (default: the distance to the nearest point). The result is less accurate
        at points that are nearer to the block than this length.

    Returns
    -------
    ndarray, shape (n, 3, 3)
        ``[i, c, k]``: component c of B in T at point i for a remanence of 1 T along k.
    """
    points = np.asarray(points, float)
    result = np.empty((len(points), 3, 3))
    if not len(points):
        return result
    distance = _nearest(block.outline, points) if panel is None else panel
    sources, normals = panel_quadrature(block.outline, distance, order)
    step = max(1, _CHUNK // (8 * len(sources)))
    for first in range(0, len(points), step):
        part = slice(first, first + step)
        result[part] = _prism_field(points[part], sources, normals, block.z_min, block.z_max)
    return result


def unit_fields(
    blocks: Sequence[MagnetBlock], points: Floats, order: int = _ORDER,
    panel: float | None = None,
) -> Iterator[Floats]:
    """Yield `unit_field` of every block, in order.

    Congruent blocks share the integrals. Points on circles have the same positions relative to many
    blocks, and each such position is integrated once.
    """
    at_once = max(1, _AT_ONCE // max(1, len(points)))
    for first in range(0, len(blocks), at_once):
        yield from _fields_of_some(blocks[first:first + at_once], points, order, panel)


def _fields_of_some(
    blocks: Sequence[MagnetBlock], points: Floats, order: int, panel: float | None
) -> Iterator[Floats]:
    """Yield `unit_field` of blocks that are few enough to be compared at once.

    Every block is evaluated in its own frame, into which the points are moved; a block that
    consists of several parts is the weighted sum of their fields.
    """
    points_by_block = [points if block.in_magnet_frame else block.to_frame(points)
                       for block in blocks]
    pieces = [(number, factor, part) for number, block in enumerate(blocks)
              for factor, part in block.parts]
    frames = [frame_of(part) for _, _, part in pieces]
    groups: dict[tuple[object, ...], list[int]] = {}
    for number, frame in enumerate(frames):
        groups.setdefault(frame.shape, []).append(number)
    fields: dict[tuple[object, ...], Floats] = {}
    places: dict[int, Ints] = {}
    for shape, members in groups.items():
        local_points = np.vstack([frames[number].local(points_by_block[pieces[number][0]])[0]
                          for number in members])
        union, inverse = unique_points(local_points)
        fields[shape] = unit_field(_in_frame(pieces[members[0]][2], frames[members[0]]), union,
                                   order, panel)
        places.update(zip(members, inverse.reshape(len(members), len(points)), strict=True))
    remaining = iter(range(len(pieces)))
    for number, block in enumerate(blocks):
        total = np.zeros((len(points), 3, 3))
        for piece in islice(remaining, len(block.parts)):
            frame, factor = frames[piece], pieces[piece][1]
            signs = frame.local(points_by_block[number])[1]
            total += factor * frame.unfold(fields[frame.shape][places[piece]], signs)
        if not block.in_magnet_frame:
            total = block.axes @ total @ block.axes.T
        yield total


def _in_frame(block: MagnetBlock, frame: Frame) -> MagnetBlock:
    """Return the block moved into its frame, which congruent blocks have in common."""
    turn = rotation_about_z(frame.angle)[:2, :2]

    def moved(point: tuple[float, float]) -> tuple[float, float]:
        x, y = np.array(point) @ turn
        return float(x), float(y)

    outline = tuple(Edge(moved(e.start), moved(e.end), e.arc) for e in block.outline)
    return replace(block, outline=outline, z_min=block.z_min - frame.centre,
                   z_max=block.z_max - frame.centre)


def field_of(blocks: Sequence[MagnetBlock], points: Floats, order: int = _ORDER) -> Floats:
    """Return B (n, 3) in T of blocks with their nominal remanence in vacuum.

    At points inside a block the result lacks the block's own remanence, see `unit_field`.
    """
    total = np.zeros((len(points), 3))
    for block, field in zip(blocks, unit_fields(blocks, points, order), strict=True):
        total += field @ (np.array(block.easy_axis) * block.remanence)
    return total


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

    The radial and azimuthal derivatives are central differences, for which points on circles share
    integrals. The derivatives along z follow from curl B = 0 and div B = 0.
    """
    angle = np.arctan2(points[:, 1], points[:, 0])
    zero = np.zeros(len(points))
    radial = np.column_stack([np.cos(angle), np.sin(angle), zero])
    azimuthal = np.column_stack([-np.sin(angle), np.cos(angle), zero])
    step = _STEP * max(edge.radius for block in blocks for edge in block.outline)
    places = np.vstack([points + sign * step * along for along in (radial, azimuthal)
                        for sign in (1, -1)])
    for block, unit in zip(blocks, unit_fields(blocks, places, order=4), strict=True):
        fields = (unit @ (np.array(block.easy_axis) * block.remanence)).reshape(2, 2, -1, 3)
        by_radius, by_angle = (fields[:, 0] - fields[:, 1]) / (2 * step)
        expansion = np.sum(by_radius * radial + by_angle * azimuthal, axis=1)
        by_z = by_radius[:, 2:] * radial + by_angle[:, 2:] * azimuthal
        by_z[:, 2] = -expansion
        yield (by_radius[:, :, None] * radial[:, None] + by_angle[:, :, None] * azimuthal[:, None]
               + by_z[:, :, None] * np.eye(3)[2])


def demagnetizing_tensors(blocks: Sequence[MagnetBlock]) -> list[Floats]:
    """Return the magnetometric demagnetizing tensor N (3, 3) of every block.

    If a block is magnetized uniformly, its own field averaged over its volume is H = -N M. The
    average is computed by Gauss quadrature of the exact field, with an error of 6e-4, because the
    field has logarithmic singularities along the edges. (The usual approximation by a cuboid with
    the block's mean sides would have an error of 1e-2 for sectors.) Congruent blocks share the
    computation.
    """
    by_shape: dict[tuple[object, ...], Floats] = {}
    tensors = []
    for block in blocks:
        frame = frame_of(block)
        if frame.shape not in by_shape:
            local = _in_frame(block, frame)
            points, weights = _inside(local)
            average = np.einsum("p,pij->ij", weights, unit_field(local, points)) / local.volume
            by_shape[frame.shape] = -average
        turn = block.axes @ rotation_about_z(frame.angle)
        tensors.append(turn @ by_shape[frame.shape] @ turn.T)
    return tensors


def _inside(block: MagnetBlock, order: int = 6) -> tuple[Floats, Floats]:
    """Return Gauss points (n, 3) in m inside a block and their weights (n,) in m^3.

    The cross-section is parametrized by straight lines between the outline's second and fourth
    edge, which are opposite to each other in all shapes.
    """
    nodes, weights = np.polynomial.legendre.leggauss(order)
    t, weights = (nodes + 1) / 2, weights / 2
    # the fourth edge runs the opposite way, so that its normal changes sign too
    (far, far_normal), (near, near_normal) = block.outline[1].at(t), block.outline[3].at(1 - t)
    s = t[:, None, None]
    place = (1 - s) * near + s * far  # (s, t, 2)
    normal = (1 - s) * -near_normal + s * far_normal  # tangent turned by -90 degrees
    area = np.einsum("ti,sti->st", far - near, normal) * weights[:, None] * weights
    height = block.z_max - block.z_min
    points = np.concatenate([np.dstack([place, np.full_like(area, block.z_min + height * level)])
                             for level in t])
    return points.reshape(-1, 3), np.outer(height * weights, area).ravel()


def panel_quadrature(outline: Outline, distance: float, order: int) -> tuple[Floats, Floats]:
    """Return quadrature nodes (q, 2) on an outline and outward normals times weights, both in m.

    Panels are at most ``distance`` in m long, unless an edge would need more than 200 of them.
    """
    nodes, weights = np.polynomial.legendre.leggauss(order)
    sources, normals = [], []
    for edge in outline:
        panels = int(np.clip(np.ceil(edge.length / max(distance, 1e-12)), 1, 200))
        starts = np.arange(panels) / panels
        t = (starts[:, None] + (nodes + 1) / 2 / panels).ravel()
        position, normal = edge.at(t)
        sources.append(position)
        normals.append(normal * np.tile(weights / 2 / panels, panels)[:, None])
    return np.vstack(sources), np.vstack(normals)


def _nearest(outline: Outline, points: Floats) -> float:
    """Return the smallest in-plane distance in m between points and a sampled outline.

    Points above or below a block may be arbitrarily near to the outline in the plane without being
    near in space; `panel_quadrature` limits the number of panels for them.
    """
    t = np.linspace(0, 1, 33)
    samples = np.vstack([edge.at(t)[0] for edge in outline])
    return min(
        float(np.min(np.hypot(*(samples[None] - part[:, None, :2]).transpose(2, 0, 1))))
        for part in np.array_split(points, len(points) // 20_000 + 1)
    )


def _prism_field(
    points: Floats, sources: Floats, normals: Floats, z_min: float, z_max: float
) -> Floats:
    """Return the unit field (n, 3, 3) of a prism by the integrals at the top of this module.

    ``sources`` and ``normals`` (q, 2) in m come from `panel_quadrature`.
    """
    rho = points[:, None, :2] - sources  # from source to point
    rho2 = np.einsum("ijk,ijk->ij", rho, rho)
    result = np.zeros((len(points), 3, 3))
    if np.isinf(z_min):
        kernel = 2 * rho / rho2[..., None]
        result[:, :2, :2] = np.einsum("ijc,jk->ick", kernel, normals)
        return result / (4 * np.pi)
    upper, lower = points[:, 2:] - z_max, points[:, 2:] - z_min  # u at the two ends
    r_upper, r_lower = np.sqrt(rho2 + upper**2), np.sqrt(rho2 + lower**2)
    # side faces
    bracket = _difference_over_rho2(upper, r_upper, lower, r_lower, rho2)
    result[:, :2, :2] = np.einsum("ijc,ij,jk->ick", rho, bracket, normals, optimize=True)
    result[:, 2, :2] = (1 / r_upper - 1 / r_lower) @ normals
    # end faces
    result[:, :2, 2] = (1 / r_upper - 1 / r_lower) @ normals
    flux = np.einsum("ijc,jc->ij", -rho, normals)
    result[:, 2, 2] = np.sum(
        flux * (_one_minus_over_rho2(upper, r_upper) * _sign(upper)
                - _one_minus_over_rho2(lower, r_lower) * _sign(lower)), axis=1)
    return result / (4 * np.pi)


def _sign(u: Floats) -> Floats:
    """Return the sign of u, with 1 for u = 0."""
    return np.where(u < 0, -1.0, 1.0)


def _one_minus_over_rho2(u: Floats, r: Floats) -> Floats:
    """Return (1 - |u|/R) / rho^2 without cancellation, as 1 / (R (R + |u|))."""
    return 1 / (r * (r + np.abs(u)))


def _difference_over_rho2(
    upper: Floats, r_upper: Floats, lower: Floats, r_lower: Floats, rho2: Floats
) -> Floats:
    """Return (u_lower/R_lower - u_upper/R_upper) / rho^2, regular at rho = 0 beyond an end.

    Insert u/R = sign(u) (1 - rho^2/(R (R + |u|))). If both ends of the block are on the same side
    of the point, the terms sign(u) cancel. Between the ends they add up to 2/rho^2, which is the
    field near a charged edge.
    """
    regular = (_sign(upper) / (r_upper * (r_upper + np.abs(upper)))
               - _sign(lower) / (r_lower * (r_lower + np.abs(lower))))
    between = _sign(lower) != _sign(upper)
    with np.errstate(divide="ignore"):
        return regular + np.where(between, 2 / rho2, 0.0)

