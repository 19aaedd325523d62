"""Meshes of magnets: built by `halbach_fe.geo`, and verified before GetDP uses them.

GetDP reads a truncated mesh, or a mesh that lacks a region, without an error. Therefore every mesh
is read back here and checked, and the number of unknowns that GetDP must report is derived from its
numbers of nodes, edges and faces. For estimates these numbers are also computed without meshing.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import meshio
import numpy as np

from halbach_fe.core import untrusted_files
from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.errors import MeshError, OutputError, must_be
from halbach_fe.core.threads import available_memory
from halbach_fe.geometry.domain import Regions, boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.study.model import Study

MESH_NAME = "mesh.msh"

LEAST_BYTES = {2: 7200, 3: 2000}
"""Fewest bytes that the solve needs per element, by dimension: in a plane GetDP's 3600 for each of
two unknowns (`halbach_fe.response.resource_estimate`), in space those of this program alone."""

# Dimension of a cell by meshio's name of its type.
_DIMENSION = {"vertex": 0, "line": 1, "line3": 1, "triangle6": 2, "quad": 2, "tetra10": 3}
# By meshio's name of the cell type: number of corners (nodes in the middle of edges do not count),
# and the corners of each edge and of each face.
_CORNERS = {"line": 2, "line3": 2, "triangle6": 3, "quad": 4, "tetra10": 4}
_EDGES = {"line": ((0, 1),), "line3": ((0, 1),), "triangle6": ((0, 1), (1, 2), (2, 0)),
          "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
          "tetra10": ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))}
_FACES = {"line": (), "line3": (), "triangle6": ((0, 1, 2),), "quad": ((0, 1, 2, 3),),
          "tetra10": ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))}


@dataclass(frozen=True)
class Entities:
    """Numbers of entities of a mesh, or of a part of it."""

    nodes: int
    """All nodes, including those in the middle of edges."""
    corners: int
    """Nodes that are corners of elements."""
    edges: int
    faces: int


@dataclass(frozen=True)
class MeshFiles:
    """Paths of a mesh and of the file that names its regions."""

    mesh: Path
    regions: Path


@dataclass(frozen=True)
class VerifiedMesh:
    """A mesh that was checked to hold every region and its outer boundary."""

    path: Path
    regions: Regions
    """Tags and names of the regions."""
    points: Floats
    """Coordinates of the nodes; in a half-plane x is r and y is z. Shape (nodes, d), in m."""
    cells: Ints
    """Nodes of every element, in the order of the file. All elements are of one type.
    Shape (elements, k)."""
    cell_type: str
    """meshio's name of this type: ``triangle6``, ``quad`` or ``tetra10``."""
    in_air: Bools
    in_iron: Bools
    """Shape (elements,)."""
    tags: Ints
    """Region of every element. Shape (elements,)."""
    inner: Entities
    """Numbers of entities off the outer boundary, from which the number of unknowns follows."""
    axis: Entities
    """Of these, the numbers on the axis of a half-plane; 0 for other meshes."""
    radius: float
    half_length: float
    """Extent of the mesh in m; the half length of a cross-section is infinite."""

    @property
    def elements(self) -> int:
        """Number of elements."""
        return len(self.cells)


@dataclass(frozen=True)
class CountedMesh:
    """Expected numbers of entities of a mesh that has not been built."""

    elements: int
    inner: Entities
    """Off the outer boundary."""
    axis: Entities
    """Of these, the numbers on the axis of a half-plane; 0 for other meshes."""
    radius: float
    half_length: float
    """Extent of the mesh in m; the half length of a cross-section is infinite."""


@dataclass(frozen=True)
class MeshedCase:
    """A magnet and its mesh, which all runs for it share."""

    magnet: Magnet
    mesh: VerifiedMesh | CountedMesh

    @property
    def real_mesh(self) -> VerifiedMesh:
        """The mesh of a run that is solved; a `CountedMesh` serves estimates only."""
        assert isinstance(self.mesh, VerifiedMesh)
        return self.mesh


def build_mesh(magnet: Magnet, folder: Path) -> MeshFiles:
    """Mesh the cross-section of a 2D magnet, or a 3D magnet, into ``folder``.

    The same magnet always gives the same mesh.

    Raises
    ------
    OutputError
        If the files cannot be written.
    MeshError
        If this machine has too little memory for it.
    """
    from halbach_fe import geo  # imports Gmsh, which only meshing needs

    _check_memory(magnet)
    return write_files(folder, "", partial(
        geo.mesh_2d if magnet.dimension == 2 else geo.mesh_3d, magnet))


def write_files(folder: Path, name: str, draw: Callable[[Path], Regions]) -> MeshFiles:
    """Write a mesh into ``folder`` by ``draw``, and the regions that it returns beside it.

    Raises
    ------
    OutputError
        If the files cannot be written.
    """
    files = MeshFiles(folder / (f"{name}.msh" if name else MESH_NAME),
                      folder / f"{name}{'-' if name else ''}regions.json")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        draw(files.mesh).write(files.regions)
    except OSError as error:
        raise OutputError(f"Cannot write the mesh into {folder}: {error.strerror}.") from None
    return files


def _check_memory(magnet: Magnet) -> None:
    """Refuse a mesh for which all memory of this machine is too little, before Gmsh begins it."""
    # Times the radius of the blocks, beyond which iron is rather in another unit than a shield.
    far_iron = 10.0
    from halbach_fe import geo

    kind = "cross_section" if magnet.dimension == 2 else "extruded"
    elements = geo.fewest_triangles(magnet, boundary_radius(magnet, kind))
    if magnet.dimension == 3:
        elements *= 3 * (len(geo.layers(magnet)) - 1)
    needed, left = elements * LEAST_BYTES[magnet.dimension] / 2**30, available_memory()
    if left is None or needed <= left:
        return
    times = max((body.radius for body in magnet.iron), default=0.0) / magnet.array.outer_radius_m
    hint = "Enlarge mesh.block_size_m or mesh.growth."
    if times > far_iron:
        hint = (f"The iron reaches {times:.0f} times as far out as the blocks: is it in another "
                f"unit? If it is not, e{hint[1:]}")
    raise MeshError(must_be(
        "mesh", f"study {magnet.name}", f"small enough for the {left:.3g} GiB of memory "
        "that are left", f"some {elements / 1e6:.3g} million elements, which need more than "
        f"{needed:.0f} GiB", hint))


def meridian_size(magnet: Magnet) -> float:
    """Return the element size in m at the magnet in the mesh of the (r, z) half-plane."""
    thickness = min(radii[1] - radii[0] for _, radii in magnet.ring_sections)
    meridian_elements = 12  # default number of elements across the blocks in the (r, z) half-plane
    return magnet.study.mesh.meridian_size_m or thickness / meridian_elements


def with_rough_mesh(study: Study) -> Study:
    """Return a study with a coarse mesh of the (r, z) half-plane.

    With three elements through the thickness of a ring, what iron or permeability change
    in the field of a magnet of sectors is right to 0.2 % (rms) in a sixth of the time of the usual
    mesh. That suffices to tell whether readings speak for such an effect.
    """
    if study.dimension == 2:
        return study
    radii = (radii for _, radii in build_magnet(study).ring_sections)
    rough_meridian_elements = 3  # across the blocks, where a tenth of the accuracy suffices
    rough = min(outer - inner for inner, outer in radii) / rough_meridian_elements
    if not rough:  # a block on the axis, whose ring is a point
        return study
    return study.with_(mesh__meridian_size_m=max(rough, study.mesh.meridian_size_m or 0.0))


def build_meridian(magnet: Magnet, folder: Path) -> MeshFiles:
    """Mesh the (r, z) half-plane of a rotationally symmetric magnet into ``folder``, see
    `write_files`.
    """
    from halbach_fe import geo

    return write_files(folder, "meridian", partial(
        geo.mesh_meridian, magnet, meridian_size(magnet)))


def verify_mesh(files: MeshFiles) -> VerifiedMesh:
    """Read a mesh and its regions, and check that they match.

    Raises
    ------
    MeshError
        If the file is truncated or damaged, lacks a region or its outer boundary, holds an unknown
        region, or has elements of several types.
    """
    regions = Regions.read(files.regions)
    mesh = _read(files.mesh)
    physical = mesh.cell_data.get("gmsh:physical")
    if physical is None:
        raise MeshError(f"Mesh {files.mesh} holds no physical groups; mesh the study again.")
    counts: dict[int, dict[int, int]] = {}  # number of cells by dimension and region
    for cells, tags in zip(mesh.cells, physical, strict=True):
        by_tag = counts.setdefault(_DIMENSION.get(cells.type, -1), {})
        for tag, count in zip(*np.unique(tags, return_counts=True), strict=True):
            by_tag[int(tag)] = by_tag.get(int(tag), 0) + int(count)
    volumes = counts.get(regions.dimension, {})
    for tag in regions.volume_tags:
        if tag not in volumes:
            raise MeshError(
                f"Mesh {files.mesh} lacks region {tag} ({regions.names[tag]}); GetDP would leave "
                "it out without a warning. Mesh the study again."
            )
    unknown = set(volumes) - set(regions.volume_tags)
    if unknown:
        raise MeshError(
            f"Mesh {files.mesh} holds region {min(unknown)}, which {files.regions.name} does not "
            "name; GetDP would ignore it. Mesh the study again."
        )
    if regions.outer_boundary not in counts.get(regions.dimension - 1, {}):
        raise MeshError(
            f"Mesh {files.mesh} lacks its outer boundary (region {regions.outer_boundary}); GetDP "
            "would solve without a boundary condition. Mesh the study again."
        )
    chosen = [_DIMENSION.get(c.type) == regions.dimension for c in mesh.cells]
    kind, cells = _joined(files.mesh, [
        (c.type, c.data) for c, yes in zip(mesh.cells, chosen, strict=True) if yes])
    material = np.concatenate([tags for tags, yes in zip(physical, chosen, strict=True) if yes])
    edge, boundary = _on(files.mesh, mesh, physical, regions.outer_boundary)
    axis = boundary[:0] if regions.axis is None else _on(
        files.mesh, mesh, physical, regions.axis)[1]
    extent = np.abs(mesh.points).max(axis=0)
    if regions.axis is not None:  # x is r, y is z
        radius, half_length = float(extent[0]), float(extent[1])
    else:
        radius = float(np.hypot(*mesh.points[:, :2].T).max())
        half_length = float(extent[2]) if regions.dimension == 3 else np.inf
    return VerifiedMesh(
        path=files.mesh, regions=regions, points=mesh.points[:, :regions.dimension], cells=cells,
        cell_type=kind, in_air=material == regions.air,
        in_iron=material == regions.iron, tags=material,
        inner=_less(_count(cells, kind), _count(boundary, edge)),
        axis=_less(_count(np.vstack([axis, boundary]), edge), _count(boundary, edge)),
        radius=radius, half_length=half_length)


def _read(path: Path) -> meshio.Mesh:
    """Read a mesh in format MSH 2.2, and check that it is complete."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise MeshError(f"Cannot read mesh {path}: {error.strerror}.") from None
    if not raw.startswith(b"$MeshFormat") or b"2.2" not in raw[:32]:
        raise MeshError(f"Mesh {path} is not an MSH 2.2 file, the newest that GetDP reads.")
    counts = re.findall(rb"\$(?:Nodes|Elements)\s+(\d{1,20})", raw)
    if not raw[-32:].rstrip().endswith(b"$EndElements") or max(map(int, counts), default=0) > len(
            raw):
        raise MeshError(f"Mesh {path} is truncated; mesh the study again.")
    try:
        mesh = untrusted_files.read_mesh(path)
    except ValueError as error:
        raise MeshError(f"Mesh {path} is damaged ({error}); mesh the study again.") from None
    if not np.isfinite(mesh.points).all():
        raise MeshError(f"Mesh {path} has nodes without finite coordinates; mesh the study again.")
    return mesh


def _on(path: Path, mesh: meshio.Mesh, physical: list[Ints], tag: int) -> tuple[str, Ints]:
    """Return the type and the elements of the region ``tag``, a part of the boundary."""
    return _joined(path, [
        (c.type, c.data[tags == tag]) for c, tags in zip(mesh.cells, physical, strict=True)
        if (tags == tag).any()])


def _joined(path: Path, parts: list[tuple[str, Ints]]) -> tuple[str, Ints]:
    """Join elements (type, nodes) that must all be of one type; return the type and the nodes."""
    kinds = {kind for kind, _ in parts}
    if len(kinds) != 1 or not kinds <= set(_CORNERS):
        raise MeshError(f"Mesh {path} holds elements of types {', '.join(sorted(kinds)) or 'none'} "
                        "in place of one type; mesh the study again.")
    return kinds.pop(), np.vstack([data for _, data in parts])


def _count(cells: Ints, kind: str) -> Entities:
    """Count the different nodes, corners, edges and faces of cells of one type."""
    corners = cells[:, :_CORNERS[kind]]
    return Entities(len(np.unique(cells)), len(np.unique(corners)),
                    _different(corners, _EDGES[kind]), _different(corners, _FACES[kind]))


def _different(corners: Ints, parts: tuple[tuple[int, ...], ...]) -> int:
    """Count the different edges or faces of cells.

    Parameters
    ----------
    corners : ndarray of int, shape (cells, k)
    parts : tuple of tuple of int
        The corners, from 0 to k - 1, of each edge or face of a cell. Edges or faces with the same
        corners in any order are the same.
    """
    if not parts or not len(corners):
        return 0
    ordered = np.sort(np.vstack([corners[:, list(part)] for part in parts]), axis=1)
    ordered = ordered.astype(np.int64)
    key = ordered[:, 0]
    for column in ordered.T[1:]:
        key = np.unique(key, return_inverse=True)[1] * (int(ordered.max()) + 1) + column
    return len(np.unique(key))


def _less(all_: Entities, some: Entities) -> Entities:
    """Return the difference of two sets of numbers of entities."""
    return Entities(all_.nodes - some.nodes, all_.corners - some.corners,
                    all_.edges - some.edges, all_.faces - some.faces)


def count_mesh(magnet: Magnet, kind: str) -> CountedMesh:
    """Estimate the numbers of entities of a mesh without building it.

    ``kind`` is a key of `halbach_fe.geometry.domain.BOUNDARY_RATIO`. The numbers of a half-plane
    are exact. The other meshes are unstructured: their number of triangles in a plane is estimated,
    and Euler's formula gives the rest.
    """
    radius = boundary_radius(magnet, kind)
    half_length = boundary_half_length(magnet, kind) if magnet.dimension == 3 else np.inf
    from halbach_fe import geo  # imports Gmsh, which only meshing needs

    if kind == "meridian":
        columns, rows = geo.grid_size(magnet, meridian_size(magnet))
        cells = (columns - 1) * (rows - 1)
        nodes = (columns - 1) * (rows - 2)  # the outer boundary is three sides of the half-plane
        return CountedMesh(cells, Entities(nodes, nodes, nodes + cells, cells),
                           Entities(rows - 2, rows - 2, rows - 1, 0), radius, half_length)
    triangles, rim = (round(number) for number in geo.plane_size(magnet, kind))
    # a disk of T triangles with R edges on its rim has E = (3 T + R) / 2 edges, since every inner
    # edge belongs to two triangles, and by Euler's formula V = 1 + E - T corners
    edges = (3 * triangles + rim) // 2
    corners = 1 + edges - triangles
    none = Entities(0, 0, 0, 0)
    if kind == "cross_section":
        inner = Entities(corners + edges - 2 * rim, corners - rim, edges - rim, triangles)
        return CountedMesh(triangles, inner, none, radius, half_length)
    # the mesh is extruded in layers: every prism on a triangle is cut into three tetrahedra, every
    # rectangle on an edge into two triangles by a diagonal
    layers = len(geo.layers(magnet)) - 1
    inner_corners = (corners - rim) * (layers - 1)
    inner_edges = ((corners - rim) * layers + (edges - rim) * (layers - 1)  # along z, in planes
                   + (edges - rim) * layers)  # diagonals of the rectangles
    inner_faces = triangles * (layers - 1) + 2 * (edges - rim) * layers + 2 * triangles * layers
    return CountedMesh(3 * triangles * layers, Entities(
        inner_corners + inner_edges, inner_corners, inner_edges, inner_faces), none, radius,
                       half_length)
