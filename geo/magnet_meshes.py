"""Meshes of a magnet with its iron: cross-section, layers of it along z, or half-plane (r, z).

**Equal rings.** The cross-section has blocks of any shape, prisms and tubes of iron, and air up to
the boundary. All blocks are prisms along z, so that the same plane mesh serves every ring; the
height of a layer decides which of its cells are magnet, iron or air. (Gmsh takes minutes to extrude
a thousand volumes; stacking the plane mesh takes a second.) The only curved or second-order
elements that GetDP 3.2 supports in 3D are tetrahedra, so every prism of the stack is cut into three
of them.

**The half-plane** is meshed in rectangles. The mesh has r as its x and z as its y. The
azimuthal-mode solver uses that of a magnet; all blocks of a ring form one region, because their
permeability does not depend on the azimuth. In the mesh around iron alone blocks are air, and its
grid lines come from `halbach_fe.solver.iron_modes`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import gmsh
import numpy as np

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.errors import StudyError
from halbach_fe.geo.gmsh_session import gmsh_session, write_mesh
from halbach_fe.geometry import domain as tags
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.domain import BlockRegion, Regions, boundary_half_length, boundary_radius
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Outline

COUNTED = 4000
"""Number of triangles up to which an estimate of a mesh's size builds the mesh itself; finer meshes
are extrapolated from one of about this size, which takes half a second."""

DRAWN = 64
"""Number of blocks up to which an estimate of a mesh's size draws all of them; larger rings are
extrapolated from so many blocks, which takes a second."""


def mesh_2d(magnet: Magnet, mesh_path: Path) -> Regions:
    """Mesh the cross-section with curved second-order triangles and return its regions.

    Raises
    ------
    MeshError
        If Gmsh fails.
    StudyError
        If blocks or the iron ring overlap, or the outer boundary is too close.
    """
    blocks = magnet.blocks
    with gmsh_session(magnet.name):
        radius = boundary_radius(magnet, "cross_section")
        surfaces = draw(magnet, blocks, radius)
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(2)
        for tag, entities in surfaces.items():
            gmsh.model.addPhysicalGroup(2, entities, tag)
        gmsh.model.addPhysicalGroup(1, outer_curves(radius), tags.OUTER_BOUNDARY_TAG)
        write_mesh(mesh_path)
    return regions_of(magnet, blocks)


def draw(
    magnet: Magnet, blocks: tuple[MagnetBlock, ...], radius: float
) -> dict[int, list[int]]:
    """Draw the cross-section in a disk, of the first ring in 3D, and set the element sizes.

    ``radius`` in m: radius of the disk, the outer boundary.

    Returns
    -------
    dict of int to list of int
        The Gmsh surfaces of every physical tag; no list is empty. They are not meshed yet.
    """
    occ = gmsh.model.occ
    disk = [(2, occ.addDisk(0, 0, 0, radius, radius))]
    drawn = [(tags.FIRST_BLOCK_TAG + i, (2, _block_surface(block)))
             for i, block in enumerate(blocks) if magnet.dimension == 2 or block.ring == 1]
    drawn += [(tags.IRON_TAG, (2, _iron_surface(body))) for body in magnet.iron]
    _, children = occ.fragment(disk, [entity for _, entity in drawn])
    occ.synchronize()
    gmsh.model.removeEntities(
        [point for point in gmsh.model.getEntities(0)
         if not len(gmsh.model.getAdjacencies(*point)[0])])
    surfaces: dict[int, list[int]] = {}
    for (tag, _), pieces in zip(drawn, children[1:], strict=True):
        surfaces.setdefault(tag, []).extend(entity for _, entity in pieces)
    _check_shared(surfaces)
    solid = {entity for pieces in surfaces.values() for entity in pieces}
    surfaces[tags.AIR_TAG] = [entity for _, entity in children[0] if entity not in solid]
    set_element_sizes(magnet)
    return surfaces


def _check_shared(surfaces: dict[int, list[int]]) -> None:
    """Raise StudyError if a surface belongs to two regions, which then overlap."""
    owner: dict[int, int] = {}
    for tag, pieces in surfaces.items():
        for piece in pieces:
            if owner.setdefault(piece, tag) != tag:
                raise StudyError(
                    f"Input `array.block` of study must leave neighbours apart; instead regions "
                    f"{owner[piece]} and {tag} overlap. Reduce the block's width.")


def plane_size(magnet: Magnet, kind: str) -> tuple[float, float]:
    """Estimate the numbers of triangles and of edges on the outer circle of the plane mesh.

    ``kind`` is the kind of mesh, a key of `halbach_fe.geometry.domain.BOUNDARY_RATIO`. Small meshes
    are built and counted. The size of a fine mesh is extrapolated from one with larger elements,
    that of a large ring from one or two meshes with a part of its blocks. No file is written.
    """
    blocks = magnet.blocks if magnet.dimension == 2 else magnet.blocks[:magnet.blocks_by_ring[0]]
    radius = boundary_radius(magnet, kind)
    wanted = fewest_triangles(magnet, radius)
    coarser = max(1.0, (wanted / COUNTED) ** 0.5)
    mesh = magnet.study.mesh
    # model_copy does not validate: this mesh may be coarser than a study is allowed to ask for
    drawn = magnet.with_study(magnet.study.model_copy(update={"mesh": mesh.model_copy(update={
        "block_size_m": mesh.block_size_m * coarser,
        "bore_size_m": (mesh.bore_size_m or mesh.block_size_m) * coarser})}))
    triangles, rim = _count_triangles(drawn, blocks[:DRAWN], radius)
    excess = triangles - fewest_triangles(drawn, radius)
    if len(blocks) > DRAWN:  # every further block adds the same number of triangles
        fewer, _ = _count_triangles(drawn, blocks[:DRAWN // 2], radius)
        excess += (triangles - fewer) / (DRAWN // 2) * (len(blocks) - DRAWN)
    # exponent of the refinement with which the number of excess triangles grows. A mesh has more
    # triangles than area and element size imply, because every curve is cut into whole edges.
    # Measured are 0.55 to 0.85 on four cross-sections of trapezoids, cubes and sectors, refined by
    # steps of two. The excess is about a quarter of all triangles, so that this range means an
    # error of 3 %.
    excess_exponent = 0.7
    return wanted + excess * coarser**excess_exponent, rim


def _count_triangles(
    magnet: Magnet, blocks: tuple[MagnetBlock, ...], radius: float
) -> tuple[int, int]:
    """Return the numbers of triangles and of outer edges of the plane mesh of these blocks."""
    line, triangle = 1, 2  # Gmsh's element types of straight edges and triangles
    with gmsh_session(magnet.name):
        draw(magnet, blocks, radius)
        gmsh.model.mesh.generate(2)
        mesh = gmsh.model.mesh
        rim = sum(len(mesh.getElementsByType(line, curve)[0]) for curve in outer_curves(radius))
        return len(mesh.getElementsByType(triangle)[0]), rim


def fewest_triangles(magnet: Magnet, radius: float) -> float:
    """Return the number of equilateral triangles of the wanted size that fill the disk.

    A mesh has more, up to a third, because every curve is cut into whole edges.
    The size depends on the radius as `set_element_sizes` has it.
    """
    mesh, bore = magnet.study.mesh, magnet.bore_radius
    r = np.concatenate([[0.0], np.geomspace(bore, radius, 2000)])
    middle = (r[1:] + r[:-1]) / 2
    size = mesh.block_size_m + (mesh.growth - 1) * np.maximum(middle - magnet.radius, 0)
    size[0] = mesh.bore_size_m or mesh.block_size_m
    return float(np.sum(np.pi * np.diff(r**2) / (np.sqrt(3) / 4 * size**2)))


def outer_curves(radius: float) -> list[int]:
    """Return the Gmsh curves on the outer boundary, a circle of ``radius`` (m)."""
    found = []
    for _, curve in gmsh.model.getEntities(1):
        low, high = gmsh.model.getParametrizationBounds(1, curve)
        middle = gmsh.model.getValue(1, curve, [(low[0] + high[0]) / 2])
        if np.hypot(middle[0], middle[1]) > radius * (1 - 1e-6):
            found.append(curve)
    return found


def regions_of(magnet: Magnet, blocks: tuple[MagnetBlock, ...]) -> Regions:
    """Return the content of the region file; block tags count up from FIRST_BLOCK_TAG."""
    return Regions(
        study=magnet.name, dimension=magnet.dimension, air=tags.AIR_TAG,
        iron=tags.IRON_TAG if magnet.iron else None,
        outer_boundary=tags.OUTER_BOUNDARY_TAG,
        blocks=tuple(
            BlockRegion(name=block.name, ring=block.ring, slot=block.slot,
                        tag=tags.FIRST_BLOCK_TAG + i)
            for i, block in enumerate(blocks)),
    )


def _block_surface(block: MagnetBlock) -> int:
    """Add the cross-section of a block in its nominal place to the Gmsh model; return its tag.

    Displaced blocks of a ring without gaps would overlap.
    """
    nominal = replace(block, displacement_m=(0.0, 0.0, 0.0), rotation_rad=(0.0, 0.0, 0.0))
    return _surface(block.outline, None if nominal.in_magnet_frame else nominal.from_frame)


def _iron_surface(body: IronSolid) -> int:
    """Add the cross-section of a body of iron to the Gmsh model; return its tag."""
    if body.outline is not None:
        return _surface(body.outline)
    occ = gmsh.model.occ
    loops = [occ.addCurveLoop([occ.addCircle(0, 0, 0, radius)])
             for radius in (body.outer_radius, body.inner_radius) if radius]
    return int(occ.addPlaneSurface(loops))


def _surface(outline: Outline, place: Callable[[Floats], Floats] | None = None) -> int:
    """Add the surface inside an outline to the Gmsh model; return its tag.

    ``place`` takes points (n, 3) of the outline's frame to their place in the model.
    """
    occ = gmsh.model.occ
    corners = np.array([[*edge.start, 0.0] for edge in outline] + [[0.0, 0.0, 0.0]])
    if place is not None:
        corners = place(corners)
    points = [occ.addPoint(*corner) for corner in corners[:-1].tolist()]
    curves = []
    for i, edge in enumerate(outline):
        ends = points[i], points[(i + 1) % len(points)]
        if edge.arc:
            centre = occ.addPoint(*corners[-1].tolist())
            curves.append(occ.addCircleArc(ends[0], centre, ends[1]))
            occ.remove([(0, centre)])
        else:
            curves.append(occ.addLine(*ends))
    return int(occ.addPlaneSurface([occ.addCurveLoop(curves)]))


def set_element_sizes(magnet: Magnet) -> None:
    """Set the element sizes in Gmsh.

    The size is constant in the bore and in the magnet, and grows linearly outside. The sizes are
    Gmsh fields, because a Python callback would swallow Ctrl-C during meshing.
    """
    block_size = magnet.study.mesh.block_size_m
    bore_size = magnet.study.mesh.bore_size_m or block_size
    rise, outer_radius = magnet.study.mesh.growth - 1, magnet.radius
    field = gmsh.model.mesh.field
    constant, growing, bore = field.add("MathEval"), field.add("MathEval"), field.add("Cylinder")
    field.setString(constant, "F", f"{block_size:.17g}")
    field.setString(growing, "F",
                    f"{block_size:.17g} + {rise:.17g} * (sqrt(x^2 + y^2) - {outer_radius:.17g})")
    outside = field.add("Max")
    field.setNumbers(outside, "FieldsList", [constant, growing])
    finer = bore_size < block_size
    for name, value in (("Radius", magnet.bore_radius * (1 - 1e-9)), ("ZAxis", 1.0),
                        ("VIn", bore_size), ("VOut", 1e22 if finer else 0.0)):
        field.setNumber(bore, name, value)
    size = field.add("Min" if finer else "Max")
    field.setNumbers(size, "FieldsList", [bore, outside])
    field.setAsBackgroundMesh(size)
    for option in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
        gmsh.option.setNumber(f"Mesh.MeshSize{option}", 0)


TRIANGLE6, TETRAHEDRON10 = 9, 11
"""Gmsh's element types of second-order triangles and tetrahedra."""

TRIANGLE_EDGES = ((0, 1), (1, 2), (2, 0))
"""Corners of a triangle's edges, in Gmsh's order of the nodes on edges."""

TETRAHEDRON_EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (2, 3), (1, 3))
"""Corners of a tetrahedron's edges, in Gmsh's order of the nodes on edges."""

TURNED = [1, 0, 2, 3, 4, 6, 5, 9, 8, 7]
"""Node order of a tetrahedron with two corners exchanged, which inverts its orientation."""

# The three tetrahedra of a prism. A pair is a corner of the triangle (sorted by node index) and a
# level (0 below, 1 above). The diagonals of the prism's sides rise towards the larger node index,
# so that the prisms on both sides of a face cut it in the same way.
CUTS = (((0, 0), (1, 0), (2, 0), (2, 1)), ((0, 0), (1, 0), (1, 1), (2, 1)),
        ((0, 0), (0, 1), (1, 1), (2, 1)))


def mesh_3d(magnet: Magnet, mesh_path: Path) -> Regions:
    """Mesh a 3D study with curved second-order tetrahedra and return its regions.

    Raises
    ------
    MeshError
        If Gmsh fails.
    StudyError
        If blocks or the iron ring overlap, or the outer boundary is too close.
    """
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
    """Return the z limits of the layers in m, ascending from boundary to boundary.

    Layers have equal thickness in the magnet and up to one bore radius beyond its ends, where
    readings are dense; farther out they grow by ``mesh.growth``.
    """
    assert magnet.array.ring_length_m is not None
    iron_end = magnet.iron_half_length
    thickness = magnet.array.ring_length_m / magnet.study.mesh.layers_per_ring
    limits = {limit for ring in magnet.ring_limits for limit in ring} | {-iron_end, iron_end}
    limits |= {end for body in magnet.iron for end in (body.z_min, body.z_max)}
    # Limits that differ only by rounding would make a sliver: keep one of them.
    stops = sorted(limits)
    stops = [stops[0]] + [b for a, b in pairwise(stops) if b - a > 1e-9]
    z: list[float] = [stops[0]]
    for start, stop in pairwise(stops):
        count = max(1, int(np.ceil((stop - start) / thickness - 1e-6)))
        z += list(np.linspace(start, stop, count + 1)[1:])
    outside = _outside_layers(z[-1], thickness, magnet)
    return np.array([-value for value in reversed(outside)] + z + outside)


def _outside_layers(start: float, thickness: float, magnet: Magnet) -> list[float]:
    """Return the upper limits in m of the layers from z = ``start`` to the outer boundary."""
    boundary = boundary_half_length(magnet, "extruded")
    z, size = [], thickness
    position = start
    while position < boundary:
        if position - start > magnet.bore_radius:
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
    """Build the 3D mesh in Gmsh as discrete entities, one per region, ready to be written.

    ``points`` (n, 2) in m, ``triangles`` (m, 6) and ``region`` (m,) are the plane mesh, ``z`` the
    limits of the layers in m. Copies of all plane nodes lie at the limits and half-way between
    them. Half-way copies of corners are middles of vertical edges; half-way copies of the middles
    of triangle edges are middles of the diagonals of the prisms' sides.
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
    """Cut every prism of the lowest layer into three tetrahedra.

    Parameters
    ----------
    triangles : ndarray of int, shape (m, 6)
    count : int
        Number of plane nodes: node i at half level k has the number i + k count.

    Returns
    -------
    ndarray of int, shape (3 m, 10)
        Nodes of the tetrahedra in Gmsh's order, with positive orientation.
    """
    order = np.argsort(triangles[:, :3], axis=1)
    corners = np.take_along_axis(triangles[:, :3], order, axis=1)
    rank = np.argsort(order, axis=1)
    middles = np.empty_like(corners)  # of the edge opposite to each sorted corner
    for edge, (i, j) in enumerate(TRIANGLE_EDGES):
        opposite = 3 - rank[:, i] - rank[:, j]
        middles[np.arange(len(triangles)), opposite] = triangles[:, 3 + edge]
    # an odd permutation by the sorting inverts the orientation, and so does the second cut
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
    """Return the triangles (2 m, 6) of the lowest layer on the outer cylinder.

    They are faces of the tetrahedra. ``rim`` (m, 3) are the nodes of the outer edges: both ends,
    the smaller index first, then the middle.
    """
    a, b, middle = rim.T
    up = 2 * count
    lower = np.column_stack([a, b, b + up, middle, b + count, middle + count])
    upper = np.column_stack([a, b + up, a + up, middle + count, middle + up, a + count])
    return np.vstack([lower, upper])


def _layer_tags(magnet: Magnet, region: Ints, z: float) -> Ints:
    """Return the physical tags (m,) of the cells in the layer around height z (m).

    ``region`` (m,) are the tags of the plane cells: a block's cell is air above or below its ring.
    """
    result = np.full(len(region), tags.AIR_TAG)
    for ring, (low, high) in enumerate(magnet.ring_limits):
        if low < z < high:
            block = region >= tags.FIRST_BLOCK_TAG
            result[block] = region[block] + ring * magnet.array.blocks_per_ring
    for body in magnet.iron:
        if body.z_min < z < body.z_max:
            result[region == tags.IRON_TAG] = tags.IRON_TAG
    return result


def _rim(points: Floats, triangles: Ints, radius: float) -> Ints:
    """Return the nodes (m, 3) of the edges on the outer circle: both ends, then the middle.

    The end with the smaller index is first. ``radius`` is that of the circle in m.
    """
    edges = np.vstack([triangles[:, [i, j, 3 + edge]]
                       for edge, (i, j) in enumerate(TRIANGLE_EDGES)])
    outer = edges[np.hypot(*points[edges[:, 2]].T) > radius * (1 - 1e-9)]
    outer[:, :2].sort(axis=1)
    return outer


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
