"""3D arrays: the cross-section in quadrangles, stacked in layers of hexahedra along z.

All blocks are prisms along z, so one plane mesh serves every ring; each layer decides which of
its cells are magnet, iron or air. (Extruding a thousand volumes one by one takes Gmsh minutes;
stacking the plane mesh takes a second.)
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import gmsh
import numpy as np
from numpy.typing import NDArray

from halbach_fe import regions as tags
from halbach_fe.blocks import Floats, blocks_of, iron_half_length, ring_limits
from halbach_fe.extent import boundary_half_length, boundary_radius
from halbach_fe.geo.cross_section import draw, regions_of
from halbach_fe.geo.session import gmsh_session, write_mesh
from halbach_fe.regions import Regions
from halbach_fe.study import Study

Ints = NDArray[np.int64]

TRIANGLE, QUADRANGLE, HEXAHEDRON, PRISM = 2, 3, 5, 6  # Gmsh's element types
_CORNERS = {TRIANGLE: 3, QUADRANGLE: 4}
_STACKED = {TRIANGLE: PRISM, QUADRANGLE: HEXAHEDRON}


def mesh_3d(study: Study, mesh_path: Path) -> Regions:
    """Mesh a 3D study with hexahedra (and prisms where quadrangles failed); return its regions."""
    blocks = blocks_of(study)
    with gmsh_session(study.name):
        surfaces = draw(study, blocks, boundary_radius(study, "extruded"))
        gmsh.option.setNumber("Mesh.RecombineAll", 1)
        # Packing of parallelograms: the worst quadrangle stays convex by a wide margin, where
        # the other algorithms make slivers in which GetDP cannot locate points.
        gmsh.option.setNumber("Mesh.Algorithm", 9)
        gmsh.model.mesh.generate(2)
        points, cells = _plane_mesh(surfaces)
        z = layers(study)
        gmsh.model.add(f"{study.name}-3d")
        _stack(study, points, cells, z)
        write_mesh(mesh_path)
    return regions_of(study, blocks)


def layers(study: Study) -> Floats:
    """z of the layer limits in m, from boundary to boundary.

    Layers are uniform within rings and for one bore radius beyond the ends, where readings are
    dense; then they grow.
    """
    assert study.array.ring_length_m is not None
    iron_end = iron_half_length(study)
    thickness = study.array.ring_length_m / study.mesh.layers_per_ring
    limits = {limit for ring in ring_limits(study) for limit in ring} | {-iron_end, iron_end}
    # Rounding must not leave slivers between limits that are meant to be equal.
    stops = sorted(limits)
    stops = [stops[0]] + [b for a, b in pairwise(stops) if b - a > 1e-9]
    z: list[float] = [stops[0]]
    for start, stop in pairwise(stops):
        count = max(1, int(np.ceil((stop - start) / thickness - 1e-6)))
        z += list(np.linspace(start, stop, count + 1)[1:])
    outside = _outside_layers(z[-1], thickness, study)
    return np.array([-value for value in reversed(outside)] + z + outside)


def _outside_layers(start: float, thickness: float, study: Study) -> list[float]:
    boundary = boundary_half_length(study, "extruded")
    z, size = [], thickness
    position = start
    while position < boundary:
        if position - start > study.array.inner_radius_m:
            size *= study.mesh.growth
        position = boundary if boundary - position < 1.5 * size else position + size
        z.append(position)
    return z


def _plane_mesh(surfaces: dict[int, list[int]]) -> tuple[Floats, dict[int, tuple[Ints, Ints]]]:
    """Return points (n, 2) and, per element type, corners (m, k) and region tags (m,)."""
    node_tags, coordinates, _ = gmsh.model.mesh.getNodes()
    index = np.zeros(int(node_tags.max()) + 1, int)
    points = np.asarray(coordinates).reshape(-1, 3)[:, :2]
    collected: dict[int, list[tuple[Ints, Ints]]] = {TRIANGLE: [], QUADRANGLE: []}
    index[node_tags.astype(int)] = np.arange(len(node_tags))
    for tag in sorted(surfaces):
        for surface in surfaces[tag]:
            types, _, nodes = gmsh.model.mesh.getElements(2, surface)
            for kind, flat in zip(types, nodes, strict=True):
                corners = index[np.asarray(flat, int)].reshape(-1, _CORNERS[int(kind)])
                collected[int(kind)].append((corners, np.full(len(corners), tag)))
    cells = {kind: (np.vstack([c for c, _ in parts]), np.concatenate([t for _, t in parts]))
             for kind, parts in collected.items() if parts}
    used = np.unique(np.concatenate([corners.ravel() for corners, _ in cells.values()]))
    renumber = np.zeros(len(points), int)
    renumber[used] = np.arange(len(used))
    return points[used], {kind: (_counter_clockwise(points, corners, renumber), region)
                          for kind, (corners, region) in cells.items()}


def _counter_clockwise(points: Floats, corners: Ints, renumber: Ints) -> Ints:
    """Orient cells so that the stacked elements have positive volume."""
    x, y = points[corners].transpose(2, 0, 1)
    area = np.sum(x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y, axis=1)
    corners = renumber[corners]
    corners[area < 0] = corners[area < 0, ::-1]
    return corners


def _stack(study: Study, points: Floats, cells: dict[int, tuple[Ints, Ints]], z: Floats) -> None:
    """Build the 3D mesh as discrete Gmsh entities, one per region, ready to be written."""
    count, levels = len(points), len(z)
    nodes = np.column_stack([np.tile(points, (levels, 1)), np.repeat(z, count)])
    volumes: dict[int, dict[int, list[Ints]]] = {}
    faces: dict[int, list[Ints]] = {TRIANGLE: [], QUADRANGLE: []}
    for kind, (corners, region) in cells.items():
        for level in range(levels - 1):
            materials = _layer_tags(study, region, (z[level] + z[level + 1]) / 2)
            prism = np.hstack([corners + level * count, corners + (level + 1) * count])
            for tag in np.unique(materials).tolist():
                volumes.setdefault(tag, {}).setdefault(_STACKED[kind], []).append(
                    prism[materials == tag])
        faces[kind] += [corners, corners + (levels - 1) * count]
    rim = _rim(points, cells, boundary_radius(study, "extruded"))
    for level in range(levels - 1):
        lower, upper = rim + level * count, rim + (level + 1) * count
        faces[QUADRANGLE].append(np.hstack([lower, upper[:, ::-1]]))

    model = gmsh.model
    model.addDiscreteEntity(2, tags.OUTER_BOUNDARY_TAG)
    model.mesh.addNodes(2, tags.OUTER_BOUNDARY_TAG, np.arange(1, len(nodes) + 1), nodes.ravel())
    for kind, parts in faces.items():
        if parts:
            model.mesh.addElementsByType(tags.OUTER_BOUNDARY_TAG, kind, [],
                                         (np.vstack(parts) + 1).ravel())
    model.addPhysicalGroup(2, [tags.OUTER_BOUNDARY_TAG], tags.OUTER_BOUNDARY_TAG)
    for tag in sorted(volumes):
        model.addDiscreteEntity(3, tag)
        for kind, parts in volumes[tag].items():
            model.mesh.addElementsByType(tag, kind, [], (np.vstack(parts) + 1).ravel())
        model.addPhysicalGroup(3, [tag], tag)


def _layer_tags(study: Study, region: Ints, z: float) -> Ints:
    """Physical tags of plane cells in the layer around height z."""
    result = np.full(len(region), tags.AIR_TAG)
    for ring, (low, high) in enumerate(ring_limits(study)):
        if low < z < high:
            block = region >= tags.FIRST_BLOCK_TAG
            result[block] = region[block] + ring * study.array.blocks_per_ring
    if abs(z) < iron_half_length(study):
        result[region == tags.IRON_TAG] = tags.IRON_TAG
    return result


def _rim(points: Floats, cells: dict[int, tuple[Ints, Ints]], radius: float) -> Ints:
    """Edges (m, 2) of the plane mesh on the outer circle: those of one cell only."""
    edges = np.vstack([
        np.column_stack([corners[:, i], np.roll(corners, -1, axis=1)[:, i]])
        for corners, _ in cells.values() for i in range(corners.shape[1])])
    _, first, uses = np.unique(np.sort(edges, axis=1), axis=0, return_index=True,
                               return_counts=True)
    rim = edges[first[uses == 1]]
    assert np.allclose(np.hypot(*points[rim.ravel()].T), radius), "the plane mesh has a hole"
    return rim
