"""Exact field of uniformly magnetized prisms in vacuum, by their surface charge.

A block of uniform polarization J = B_r (recoil permeability 1) has the surface charge J . n.
For a prism along z with outline C between z1 and z2 the field outside is a sum of line integrals
over C only, with R the distance from source to point, rho its part in the plane, and u = z - z':

* side faces, charge J_t . n: integrating along z in closed form leaves
  ``B_t = 1/4pi int (J.n) rho/rho^2 [-u/R] dl`` and ``B_z = 1/4pi int (J.n) [1/R] dl``,
  the brackets being differences between z' = z2 and z1;
* end faces, charge +-J_z: the divergence theorem in the plane of the face gives
  ``B_t = +- J_z/4pi int n/R dl`` (+ at the upper face) and the solid angle
  ``B_z = +- J_z/4pi int (rho.n/rho^2) (sign u - u/R) dl``, rho counted from the point's
  projection to the source.

J. D. Jackson, Classical Electrodynamics, 3rd ed., section 5.9, for the charge model. The brackets
are evaluated in a form without cancellation, so that points above the prolongation of a vertical
edge are ordinary points. In two dimensions [-u/R] is 2 and only B_t remains.

The line integrals are taken by Gauss-Legendre panels no longer than the distance to the nearest
point, which converges geometrically (to about 1e-12 of the field for the default order).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry.blocks import MagnetBlock, rotation_matrix
from halbach_fe.geometry.outline import Edge, Outline
from halbach_fe.geometry.symmetry import Frame, frame_of, rotation_about_z, unique_points

_ORDER = 12
_STEP = 1e-4
"""Of the array's radius, for differences: the relative error is the square of the step over the
distance to a block. Of four Gauss points, measured at 3 % of the radius from the blocks, it is 1e-4
too."""

_CHUNK = 20_000_000  # numbers in one temporary array: 160 MB
_AT_ONCE = 4_000_000  # blocks times points whose places are compared at once


def unit_field(
    block: MagnetBlock, points: Floats, order: int = _ORDER, panel: float | None = None
) -> Floats:
    """Field of one block for remanences of 1 T along x, y and z, in vacuum.

    Parameters
    ----------
    block : MagnetBlock
        Infinite ``z_min``, ``z_max`` give the field of the two-dimensional cross-section.
    points : ndarray, shape (n, 3), in m
        Points off the block's surface, where the result is not defined; inside it, mu_0 H.
    order : int
        Gauss points per panel of the outline.
    panel : float, optional
        Longest panel in m (default: the distance to the nearest point); what is nearer to the block
        is less exact.

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

    Congruent blocks share the integrals: readings on circles see many blocks from the same place.
    """
    at_once = max(1, _AT_ONCE // max(1, len(points)))
    for first in range(0, len(blocks), at_once):
        yield from _fields_of_some(blocks[first:first + at_once], points, order, panel)


def _fields_of_some(
    blocks: Sequence[MagnetBlock], points: Floats, order: int, panel: float | None
) -> Iterator[Floats]:
    seen_by = [points if block.in_place else block.to_place(points) for block in blocks]
    pieces = [(number, factor, part) for number, block in enumerate(blocks)
              for factor, part in block.parts]
    frames = [frame_of(part) for _, _, part in pieces]
    groups: dict[tuple[object, ...], list[int]] = {}
    for number, frame in enumerate(frames):
        groups.setdefault(frame.shape, []).append(number)
    fields: dict[tuple[object, ...], Floats] = {}
    places: dict[int, Ints] = {}
    for shape, members in groups.items():
        seen = np.vstack([frames[number].local(seen_by[pieces[number][0]])[0]
                          for number in members])
        union, inverse = unique_points(seen)
        fields[shape] = unit_field(_in_frame(pieces[members[0]][2], frames[members[0]]), union,
                                   order, panel)
        places.update(zip(members, inverse.reshape(len(members), len(points)), strict=True))
    remaining = iter(range(len(pieces)))
    for number, block in enumerate(blocks):
        total = np.zeros((len(points), 3, 3))
        for piece in islice(remaining, len(block.parts)):
            frame, factor = frames[piece], pieces[piece][1]
            signs = frame.local(seen_by[number])[1]
            total += factor * frame.unfold(fields[frame.shape][places[piece]], signs)
        if not block.in_place:
            turn = rotation_matrix(block.rotation_rad)
            total = turn @ total @ turn.T
        yield total


def _in_frame(block: MagnetBlock, frame: Frame) -> MagnetBlock:
    """The block moved into its own frame."""
    turn = rotation_about_z(frame.angle)[:2, :2]

    def moved(point: tuple[float, float]) -> tuple[float, float]:
        x, y = np.array(point) @ turn
        return float(x), float(y)

    outline = tuple(Edge(moved(e.start), moved(e.end), e.arc) for e in block.outline)
    return replace(block, outline=outline, z_min=block.z_min - frame.centre,
                   z_max=block.z_max - frame.centre)


def field_of(blocks: Sequence[MagnetBlock], points: Floats, order: int = _ORDER) -> Floats:
    """Field in vacuum of blocks with their nominal remanence, (n, 3) in T."""
    total = np.zeros((len(points), 3))
    for block, field in zip(blocks, unit_fields(blocks, points, order), strict=True):
        total += field @ (np.array(block.easy_axis) * block.remanence)
    return total


def gradient_of(blocks: Sequence[MagnetBlock], points: Floats) -> Floats:
    """Gradient of `field_of` at points (n, 3) in m off the blocks, (n, 3, 3) in T/m.

    ``[i, c, k]`` is the derivative of component c along k, to 1e-4 at a hundredth of the radius
    from a block: for the scale of a noise, or the signature of an effect.
    """
    total = np.zeros((len(points), 3, 3))
    for gradient in block_gradients(blocks, points):
        total += gradient
    return total


def block_gradients(blocks: Sequence[MagnetBlock], points: Floats) -> Iterator[Floats]:
    """Yield the share of every block in `gradient_of`.

    By central differences, radially and azimuthally, for which points on circles share integrals;
    along z by curl B = 0 and div B = 0.
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
    """Magnetometric demagnetizing tensor (3, 3) of every block: H = -N M on average over it, if
    it is magnetized uniformly.

    By Gauss quadrature of the exact field, to 6e-4: the field is logarithmic along the edges.
    (A cuboid of the block's mean sides, as is usual, would be off by 1e-2 for sectors.) Congruent
    blocks share it.
    """
    found: dict[tuple[object, ...], Floats] = {}
    tensors = []
    for block in blocks:
        frame = frame_of(block)
        if frame.shape not in found:
            local = _in_frame(block, frame)
            points, weights = _inside(local)
            average = np.einsum("p,pij->ij", weights, unit_field(local, points)) / local.volume
            found[frame.shape] = -average
        turn = rotation_about_z(frame.angle)
        tensors.append(turn @ found[frame.shape] @ turn.T)
    return tensors


def _inside(block: MagnetBlock, order: int = 6) -> tuple[Floats, Floats]:
    """Gauss points (n, 3) in m in a block and their weights (n,) in m^3.

    The outline's second and fourth edge, from inner to outer corners and back in all shapes, are
    joined by straight lines.
    """
    nodes, weights = np.polynomial.legendre.leggauss(order)
    t, weights = (nodes + 1) / 2, weights / 2
    (far, far_normal), (near, near_normal) = block.outline[1].at(t), block.outline[3].at(1 - t)
    s = t[:, None, None]
    place = (1 - s) * near + s * far  # (s, t, 2)
    normal = (1 - s) * -near_normal + s * far_normal  # tangent turned by -90 degrees
    area = np.einsum("ti,sti->st", far - near, normal) * weights[:, None] * weights
    height = block.z_max - block.z_min
    points = np.concatenate([np.dstack([place, np.full_like(area, block.z_min + height * one)])
                             for one in t])
    return points.reshape(-1, 3), np.outer(height * weights, area).ravel()


def panel_quadrature(outline: Outline, distance: float, order: int) -> tuple[Floats, Floats]:
    """Nodes (q, 2) on an outline and outward normals times weight (q, 2), both in m.

    Panels are at most ``distance`` long.
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
    """Smallest in-plane distance in m between points and outline, by sampling the outline.

    Points that pass over or under a block may come arbitrarily near in the plane without being
    near in space; the panel count is capped where this is used.
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
    return np.where(u < 0, -1.0, 1.0)


def _one_minus_over_rho2(u: Floats, r: Floats) -> Floats:
    """(1 - |u|/R) / rho^2 without cancellation: 1 / (R (R + |u|))."""
    return 1 / (r * (r + np.abs(u)))


def _difference_over_rho2(
    upper: Floats, r_upper: Floats, lower: Floats, r_lower: Floats, rho2: Floats
) -> Floats:
    """(u_lower/R_lower - u_upper/R_upper) / rho^2, regular at rho = 0 beyond either end.

    With u/R = sign(u) (1 - rho^2/(R (R + |u|))) the ones cancel when both ends are on one side;
    between the ends they add up to 2/rho^2, which is the field near a charged edge.
    """
    regular = (_sign(upper) / (r_upper * (r_upper + np.abs(upper)))
               - _sign(lower) / (r_lower * (r_lower + np.abs(lower))))
    between = _sign(lower) != _sign(upper)
    with np.errstate(divide="ignore"):
        return regular + np.where(between, 2 / rho2, 0.0)

