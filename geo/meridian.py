"""Meshes of the (r, z) half-plane in rectangles: of a magnet, and of rotationally symmetric iron.

The mesh has r as its x and z as its y. The azimuthal-mode solver uses that of a magnet; all blocks
of a ring form one region, because their permeability does not depend on the azimuth. In the mesh
around iron alone blocks are air, and its grid lines come from `halbach_fe.solver.iron_modes`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import gmsh
import numpy as np

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.geo.session import gmsh_session, write_mesh
from halbach_fe.geometry import domain as tags
from halbach_fe.geometry.domain import BlockRegion, Regions, boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet


def mesh_meridian(magnet: Magnet, size: float, mesh_path: Path) -> Regions:
    """Mesh the half-plane with elements of ``size`` (m) in the magnet; return its regions.

    Raises
    ------
    MeshError
        If Gmsh fails.
    """
    r, z = _radii(magnet, size), _heights(magnet, size)
    with gmsh_session(magnet.name):
        add_grid(r, z, _materials(magnet, r, z))
        write_mesh(mesh_path)
    return Regions(
        study=magnet.name, dimension=2, air=tags.AIR_TAG,
        iron=tags.IRON_TAG if magnet.iron else None,
        outer_boundary=tags.OUTER_BOUNDARY_TAG, axis=tags.AXIS_TAG,
        blocks=tuple(BlockRegion(name=f"r{ring:02d}", ring=ring, slot=0,
                                 tag=tags.FIRST_BLOCK_TAG + ring - 1)
                     for ring in range(1, len(magnet.blocks_by_ring) + 1)))


def grid_size(magnet: Magnet, size: float) -> tuple[int, int]:
    """Return the numbers of nodes along r and z of the half-plane's mesh."""
    return len(_radii(magnet, size)), len(_heights(magnet, size))


def _radii(magnet: Magnet, size: float) -> Floats:
    """Return the radii of the grid lines in m, ascending from 0."""
    stops = sorted({0.0} | {
        radius for low, high, _, _, _ in _rectangles(magnet) for radius in (low, high)})
    r = [*_uniform(stops, size), *_growing(stops[-1], size, boundary_radius(magnet, "meridian"))]
    return _graded(r, stops[1:])


def _heights(magnet: Magnet, size: float) -> Floats:
    """Return the z of the grid lines in m, ascending."""
    end = magnet.half_length
    rectangles = _rectangles(magnet)
    stops = {limit for rectangle in rectangles for limit in rectangle[2:4]} | {-end, end}
    # uniform elements up to two bore radii beyond the ends: the fringe field matters as much
    boundary = boundary_half_length(magnet, "meridian")
    uniform = min(end + 2 * magnet.bore_radius, 0.5 * (end + boundary))
    outside = _growing(uniform, size, boundary)
    inside = _uniform(sorted(stops | {-uniform, uniform}), size)
    z = [*(-value for value in reversed(outside)), *inside, *outside]
    return _graded(z, _free_ends(rectangles))


def _free_ends(rectangles: Sequence[Rectangle]) -> list[float]:
    """Return the z in m at which rectangles end without a neighbour of the same radii."""
    faces: Counter[tuple[float, float, float]] = Counter(
        (low, high, round(z, 9)) for low, high, bottom, top, _ in rectangles
        for z in (bottom, top))
    return sorted({z for (_, _, z), count in faces.items() if count == 1})


Rectangle = tuple[float, float, float, float, int]
"""Radii and heights in m of a body of the half-plane, and its physical tag."""


def _rectangles(magnet: Magnet) -> list[Rectangle]:
    """Return the rings and the bodies of iron as rectangles of the half-plane."""
    found = []
    for ring, (low, high) in enumerate(magnet.ring_limits):
        array = magnet.array.of_ring(ring + 1)
        found.append((array.inner_radius_m, array.outer_radius_m, low, high,
                      tags.FIRST_BLOCK_TAG + ring))
    found += [(body.inner_radius, body.outer_radius, body.z_min, body.z_max, tags.IRON_TAG)
              for body in magnet.iron]
    return found


def _graded(positions: list[float], corners: list[float]) -> Floats:
    """Return grid lines with the elements beside corners of materials subdivided geometrically.

    The field is singular at these corners.
    """
    x = np.array(positions)
    added = []
    # refinement at corners of materials: ratio of successive subdivisions, and their number
    grading, levels = 0.3, 2
    for corner in corners:
        i = int(np.argmin(np.abs(x - corner)))
        for neighbour in (i - 1, i + 1):
            step = x[neighbour] - x[i]
            added += [x[i] + step * grading**level for level in range(1, levels + 1)]
    return np.unique(np.concatenate([x, added]))


def _uniform(stops: list[float], size: float) -> list[float]:
    """Return positions at most ``size`` apart that include the stops.

    Stops that are less than 1e-9 m apart count as one.
    """
    result = [stops[0]]
    for start, stop in pairwise(stops):
        if stop - start > 1e-9:
            count = int(np.ceil((stop - start) / size - 1e-6))
            result += list(np.linspace(start, stop, count + 1)[1:])
    return result


def _growing(start: float, size: float, stop: float) -> list[float]:
    """Return positions after ``start`` up to ``stop`` with geometrically growing distances."""
    result, position = [], start
    growth = 1.35  # ratio of the sizes of neighbouring elements towards the outer boundary
    while position < stop:
        size *= growth
        position = stop if stop - position < 1.5 * size else position + size
        result.append(position)
    return result


def _materials(magnet: Magnet, r: Floats, z: Floats) -> Ints:
    """Return the physical tags (len(r) - 1, len(z) - 1) of the rectangles between grid lines."""
    r, z = np.meshgrid((r[1:] + r[:-1]) / 2, (z[1:] + z[:-1]) / 2, indexing="ij")
    result = np.full(r.shape, tags.AIR_TAG)
    for inner, outer, low, high, tag in _rectangles(magnet):
        result[(r > inner) & (r < outer) & (z > low) & (z < high)] = tag
    return result


def mesh_half_plane(
    name: str, r: Floats, z: Floats, in_iron: Bools, mesh_path: Path
) -> Regions:
    """Mesh the half-plane by a grid, write the mesh, and return its regions.

    Parameters
    ----------
    name : str
        Name of the study.
    r, z : ndarray, in m
        Grid lines, ascending; ``r`` starts at 0.
    in_iron : ndarray of bool, shape (len(r) - 1, len(z) - 1)
        The rectangles of the grid that are iron.

    Raises
    ------
    MeshError
        If Gmsh fails.
    """
    with gmsh_session(name):
        add_grid(r, z, np.where(in_iron, tags.IRON_TAG, tags.AIR_TAG))
        write_mesh(mesh_path)
    return Regions(study=name, dimension=2, air=tags.AIR_TAG, iron=tags.IRON_TAG,
                   outer_boundary=tags.OUTER_BOUNDARY_TAG, axis=tags.AXIS_TAG, blocks=())


def add_grid(r: Floats, z: Floats, material: Ints) -> None:
    """Add the rectangles of a grid to the Gmsh model, as one discrete entity per material.

    The axis and the other limits of the grid become physical curves.

    Parameters
    ----------
    r, z : ndarray, in m
        Grid lines, ascending; ``r`` starts at 0.
    material : ndarray of int, shape (len(r) - 1, len(z) - 1)
        Physical tags of the rectangles.
    """
    columns, rows = len(r), len(z)
    points = np.zeros((columns * rows, 3))
    points[:, 0] = np.repeat(r, rows)
    points[:, 1] = np.tile(z, columns)
    i, j = (index.ravel() for index in np.meshgrid(
        np.arange(columns - 1), np.arange(rows - 1), indexing="ij"))
    corner = i * rows + j
    cells = np.column_stack([corner, corner + rows, corner + rows + 1, corner + 1])
    up, out = np.arange(rows - 1), np.arange(columns - 1) * rows
    axis = np.column_stack([up, up + 1])
    rim = np.vstack([axis + (columns - 1) * rows] + [
        np.column_stack([out, out + rows]) + level for level in (0, rows - 1)])
    present = np.unique(material).tolist()
    for tag in present:
        gmsh.model.addDiscreteEntity(2, tag)
    gmsh.model.mesh.addNodes(2, present[0], np.arange(1, len(points) + 1), points.ravel())
    line, quadrangle = 1, 3  # Gmsh's element types of edges and quadrangles
    for tag in present:
        _add(2, quadrangle, tag, cells[material.ravel() == tag])
    for tag, lines in ((tags.AXIS_TAG, axis), (tags.OUTER_BOUNDARY_TAG, rim)):
        gmsh.model.addDiscreteEntity(1, tag)
        _add(1, line, tag, lines)


def _add(dimension: int, kind: int, tag: int, nodes: Ints) -> None:
    """Add elements, rows of ``nodes`` counted from 0, to the discrete entity ``tag``."""
    gmsh.model.mesh.addElementsByType(tag, kind, [], (nodes + 1).ravel())
    gmsh.model.addPhysicalGroup(dimension, [tag], tag)
