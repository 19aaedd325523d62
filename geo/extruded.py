"""3D arrays: the cross-section in curved triangles, stacked in layers of tetrahedra along z.

All blocks are prisms along z, so one plane mesh serves every ring; each layer decides which of
its cells are magnet, iron or air. (Extruding a thousand volumes one by one takes Gmsh minutes;
stacking the plane mesh takes a second.) GetDP 3.2 knows curved elements and elements of second
order in 3D as tetrahedra only, so every prism of the stack is cut into three.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import gmsh
import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geo.cross_section import draw, regions_of
from halbach_fe.geo.session import gmsh_session, write_mesh
from halbach_fe.geometry import regions as tags
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.regions import Regions

TRIANGLE6, TETRAHEDRON10 = 9, 11  # Gmsh's element types
TRIANGLE_EDGES = ((0, 1), (1, 2), (2, 0))
TETRAHEDRON_EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (2, 3), (1, 3))  # Gmsh's order
TURNED = [1, 0, 2, 3, 4, 6, 5, 9, 8, 7]  # a tetrahedron with its first two corners exchanged
# A prism, by corner (of the triangle, sorted) and level. Diagonals of its sides rise towards the
# larger index, on both sides of a face.
CUTS = (((0, 0), (1, 0), (2, 0), (2, 1)), ((0, 0), (1, 0), (1, 1), (2, 1)),
        ((0, 0), (0, 1), (1, 1), (2, 1)))


def mesh_3d(magnet: Magnet, mesh_path: Path) -> Regions:
    """Mesh a 3D study with curved second-order tetrahedra and return its regions."""
    blocks = magnet.blocks
    with gmsh_session(magnet.name):
        surfaces = draw(magnet, blocks, boundary_radius(magnet, "extruded"))
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(2)
        points, triangles, region = _plane_mesh(surfaces)
        z = layers(magnet)
        gmsh.model.add(f"{magnet.name}-3d")
        _stack(magnet, points, triangles, region, z)
        write_mesh(mesh_path)
    return regions_of(magnet, blocks)


def layers(magnet: Magnet) -> Floats:
    """z of the layer limits in m, from boundary to boundary.

    Layers are uniform within rings and for one bore radius beyond the ends, where readings are
    dense; then they grow.
    """
    assert magnet.array.ring_length_m is not None
    iron_end = magnet.iron_half_length
    thickness = magnet.array.ring_length_m / magnet.study.mesh.layers_per_ring
    limits = {limit for ring in magnet.ring_limits for limit in ring} | {-iron_end, iron_end}
    # Rounding must not leave slivers between limits that are meant to be equal.
    stops = sorted(limits)
    stops = [stops[0]] + [b for a, b in pairwise(stops) if b - a > 1e-9]
    z: list[float] = [stops[0]]
    for start, stop in pairwise(stops):
        count = max(1, int(np.ceil((stop - start) / thickness - 1e-6)))
        z += list(np.linspace(start, stop, count + 1)[1:])
    outside = _outside_layers(z[-1], thickness, magnet)
    return np.array([-value for value in reversed(outside)] + z + outside)


def _outside_layers(start: float, thickness: float, magnet: Magnet) -> list[float]:
    boundary = boundary_half_length(magnet, "extruded")
    z, size = [], thickness
    position = start
    while position < boundary:
        if position - start > magnet.array.inner_radius_m:
            size *= magnet.study.mesh.growth
        position = boundary if boundary - position < 1.5 * size else position + size
        z.append(position)
    return z


def _plane_mesh(surfaces: dict[int, list[int]]) -> tuple[Floats, Ints, Ints]:
    """Return points (n, 2), six-node triangles (m, 6), counter-clockwise, and region tags (m,)."""
    node_tags, coordinates, _ = gmsh.model.mesh.getNodes()
    points = np.asarray(coordinates).reshape(-1, 3)[:, :2]
    index = np.zeros(int(node_tags.max()) + 1, int)
    index[node_tags.astype(int)] = np.arange(len(node_tags))
    collected: list[Ints] = []
    region: list[Ints] = []
    for tag in sorted(surfaces):
        for surface in surfaces[tag]:
            _, nodes = gmsh.model.mesh.getElementsByType(TRIANGLE6, surface)
            collected.append(index[np.asarray(nodes, int)].reshape(-1, 6))
            region.append(np.full(len(collected[-1]), tag))
    triangles = np.vstack(collected)
    used, flat = np.unique(triangles, return_inverse=True)
    triangles, points = flat.reshape(triangles.shape), points[used]
    a, b, c = points[triangles[:, :3]].transpose(1, 2, 0)
    clockwise = (b - a)[0] * (c - a)[1] < (b - a)[1] * (c - a)[0]
    triangles[clockwise] = triangles[clockwise][:, [0, 2, 1, 5, 4, 3]]
    return points, triangles, np.concatenate(region)


def _stack(
    magnet: Magnet, points: Floats, triangles: Ints, region: Ints, z: Floats
) -> None:
    """Build the 3D mesh as discrete Gmsh entities, one per region, ready to be written.

    Nodes stand on every level and half-way between: those of the triangles' edges half-way are
    the middles of diagonals.
    """
    count, levels = len(points), len(z)
    heights = np.sort(np.concatenate([z, (z[1:] + z[:-1]) / 2]))
    nodes = np.column_stack([np.tile(points, (len(heights), 1)), np.repeat(heights, count)])
    cells = _tetrahedra(triangles, count)
    faces = [triangles, triangles + 2 * (levels - 1) * count]
    rim = _rim(points, triangles, boundary_radius(magnet, "extruded"))
    volumes: dict[int, list[Ints]] = {}
    for level in range(levels - 1):
        materials = np.repeat(_layer_tags(magnet, region, (z[level] + z[level + 1]) / 2), len(CUTS))
        shifted = cells + 2 * level * count
        for tag in np.unique(materials).tolist():
            volumes.setdefault(tag, []).append(shifted[materials == tag])
        faces.append(_side_faces(rim, count) + 2 * level * count)

    model = gmsh.model
    model.addDiscreteEntity(2, tags.OUTER_BOUNDARY_TAG)
    model.mesh.addNodes(2, tags.OUTER_BOUNDARY_TAG, np.arange(1, len(nodes) + 1), nodes.ravel())
    model.mesh.addElementsByType(tags.OUTER_BOUNDARY_TAG, TRIANGLE6, [],
                                 (np.vstack(faces) + 1).ravel())
    model.addPhysicalGroup(2, [tags.OUTER_BOUNDARY_TAG], tags.OUTER_BOUNDARY_TAG)
    for tag in sorted(volumes):
        model.addDiscreteEntity(3, tag)
        model.mesh.addElementsByType(tag, TETRAHEDRON10, [],
                                     (np.vstack(volumes[tag]) + 1).ravel())
        model.addPhysicalGroup(3, [tag], tag)


def _tetrahedra(triangles: Ints, count: int) -> Ints:
    """Cut the prisms on the lowest layer; (3 triangles, 10) nodes, three cells a triangle."""
    order = np.argsort(triangles[:, :3], axis=1)
    corners = np.take_along_axis(triangles[:, :3], order, axis=1)
    rank = np.argsort(order, axis=1)
    middles = np.empty_like(corners)  # of the edge opposite to each sorted corner
    for edge, (i, j) in enumerate(TRIANGLE_EDGES):
        opposite = 3 - rank[:, i] - rank[:, j]
        middles[np.arange(len(triangles)), opposite] = triangles[:, 3 + edge]
    # sorting may have turned the triangle over, and the middle cut is turned by itself
    odd = np.linalg.det(np.eye(3)[order]) < 0
    cells = np.empty((len(triangles), len(CUTS), 10), int)
    for number, cut in enumerate(CUTS):
        for place, (corner, level) in enumerate(cut):
            cells[:, number, place] = corners[:, corner] + 2 * level * count
        for place, (i, j) in enumerate(TETRAHEDRON_EDGES, start=4):
            (a, low), (b, high) = cut[i], cut[j]
            plane = corners[:, a] if a == b else middles[:, 3 - a - b]
            cells[:, number, place] = plane + (low + high) * count
        turned = odd ^ (number == 1)
        cells[turned, number] = cells[turned, number][:, TURNED]
    return cells.reshape(-1, 10)


def _side_faces(rim: Ints, count: int) -> Ints:
    """Triangles (2 m, 6) of the lowest layer on the outer cylinder, cut as the tetrahedra are.

    ``rim`` (m, 3) holds ends, the smaller index first, and middle of the outer edges.
    """
    a, b, middle = rim.T
    up = 2 * count
    lower = np.column_stack([a, b, b + up, middle, b + count, middle + count])
    upper = np.column_stack([a, b + up, a + up, middle + count, middle + up, a + count])
    return np.vstack([lower, upper])


def _layer_tags(magnet: Magnet, region: Ints, z: float) -> Ints:
    """Physical tags of plane cells in the layer around height z."""
    result = np.full(len(region), tags.AIR_TAG)
    for ring, (low, high) in enumerate(magnet.ring_limits):
        if low < z < high:
            block = region >= tags.FIRST_BLOCK_TAG
            result[block] = region[block] + ring * magnet.array.blocks_per_ring
    if abs(z) < magnet.iron_half_length:
        result[region == tags.IRON_TAG] = tags.IRON_TAG
    return result


def _rim(points: Floats, triangles: Ints, radius: float) -> Ints:
    """Ends, smaller index first, and middle (m, 3) of the plane mesh's edges on the outer
    circle.
    """
    edges = np.vstack([triangles[:, [i, j, 3 + edge]]
                       for edge, (i, j) in enumerate(TRIANGLE_EDGES)])
    outer = edges[np.hypot(*points[edges[:, 2]].T) > radius * (1 - 1e-9)]
    outer[:, :2].sort(axis=1)
    return outer
