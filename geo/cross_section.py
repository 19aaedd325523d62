"""Mesh of an array's cross-section: blocks of any shape, iron ring, and air up to the boundary."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import gmsh
import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.geo.session import gmsh_session, write_mesh
from halbach_fe.geometry import domain as tags
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.domain import BlockRegion, Regions, boundary_radius
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

    Parameters
    ----------
    radius : float, in m
        Radius of the disk, the outer boundary.

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
