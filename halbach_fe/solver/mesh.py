"""Meshes on disk: built by `halbach_fe.geo`, and verified before anything is solved on them.

GetDP reads a truncated mesh, or one that lacks a region, without complaint; so what a mesh holds
is read here, and the number of unknowns that GetDP must find is derived from it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np
from numpy.typing import NDArray

from halbach_fe.core import untrusted
from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import MeshError, OutputError
from halbach_fe.geometry.domain import boundary_half_length, boundary_radius
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.regions import Regions

MESH_NAME = "mesh.msh"
REGIONS_NAME = "regions.json"
MERIDIAN = "meridian"
"""Prefix of the mesh of the (r, z) half-plane."""

MERIDIAN_ELEMENTS = 12
"""Default number of elements across the blocks in the (r, z) half-plane."""

_DIMENSION = {"vertex": 0, "line": 1, "line3": 1, "triangle6": 2, "quad": 2, "tetra10": 3}
# Corners of the parts of cells, by meshio's type; middles of edges do not count as corners.
_CORNERS = {"line": 2, "line3": 2, "triangle6": 3, "quad": 4, "tetra10": 4}
_EDGES = {"line": ((0, 1),), "line3": ((0, 1),), "triangle6": ((0, 1), (1, 2), (2, 0)),
          "quad": ((0, 1), (1, 2), (2, 3), (3, 0)),
          "tetra10": ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))}
_FACES = {"line": (), "line3": (), "triangle6": ((0, 1, 2),), "quad": ((0, 1, 2, 3),),
          "tetra10": ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))}


@dataclass(frozen=True)
class Entities:
    """Numbers of nodes, of those that are corners, of edges and of faces."""

    nodes: int
    corners: int
    edges: int
    faces: int


@dataclass(frozen=True)
class MeshFiles:
    """A mesh and its region file."""

    mesh: Path
    regions: Path


@dataclass(frozen=True)
class VerifiedMesh:
    """A mesh that holds every region, and what the number of unknowns follows from.

    Attributes
    ----------
    points : ndarray, shape (nodes, d), in m
        In a half-plane x is r and y is z.
    cells : ndarray, shape (elements, k)
        Nodes of every element, in the order of the file, all of one type.
    cell_type : str
        meshio's name of it: ``triangle6``, ``quad`` or ``tetra10``.
    in_air, in_iron : ndarray of bool, shape (elements,)
    inner : Entities
        Off the outer boundary.
    axis : Entities
        Of these, those on the axis of a half-plane.
    radius, half_length : float
        Extent in m.
    """

    path: Path
    regions: Regions
    points: Floats
    cells: Ints
    cell_type: str
    in_air: NDArray[np.bool_]
    in_iron: NDArray[np.bool_]
    inner: Entities
    axis: Entities
    radius: float
    half_length: float

    @property
    def elements(self) -> int:
        """Number of elements."""
        return len(self.cells)


@dataclass(frozen=True)
class CountedMesh:
    """How many parts a mesh will have, before it is made.

    Attributes
    ----------
    elements : int
    inner : Entities
        Off the outer boundary.
    axis : Entities
        Of these, those on the axis of a half-plane.
    radius, half_length : float
        Extent in m.
    """

    elements: int
    inner: Entities
    axis: Entities
    radius: float
    half_length: float


def build_mesh(magnet: Magnet, folder: Path) -> MeshFiles:
    """Mesh a study into ``folder``; the same study always gives the same mesh."""
    from halbach_fe import geo  # Gmsh loads only when a mesh is built

    try:
        folder.mkdir(parents=True, exist_ok=True)
        files = MeshFiles(folder / MESH_NAME, folder / REGIONS_NAME)
        builder = geo.mesh_2d if magnet.dimension == 2 else geo.mesh_3d
        builder(magnet, files.mesh).write(files.regions)
    except OSError as error:
        raise OutputError(f"Cannot write the mesh into {folder}: {error.strerror}.") from None
    return files


def meridian_size(magnet: Magnet) -> float:
    """Element size in m of the half-plane at the magnet."""
    thickness = magnet.array.outer_radius_m - magnet.array.inner_radius_m
    return magnet.study.mesh.meridian_size_m or thickness / MERIDIAN_ELEMENTS


def build_meridian(magnet: Magnet, folder: Path) -> MeshFiles:
    """Mesh the (r, z) half-plane of a rotationally symmetric study into ``folder``."""
    from halbach_fe import geo

    files = MeshFiles(folder / f"{MERIDIAN}.msh", folder / f"{MERIDIAN}-regions.json")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        geo.mesh_meridian(magnet, meridian_size(magnet), files.mesh).write(files.regions)
    except OSError as error:
        raise OutputError(f"Cannot write the mesh into {folder}: {error.strerror}.") from None
    return files


def verify_mesh(files: MeshFiles) -> VerifiedMesh:
    """Read a mesh and its regions back, and check that they belong together.

    Raises
    ------
    MeshError
        Truncated file, missing or unknown region, missing outer boundary.
    """
    regions = Regions.read(files.regions)
    mesh = _read(files.mesh)
    physical = mesh.cell_data.get("gmsh:physical")
    if physical is None:
        raise MeshError(f"Mesh {files.mesh} holds no physical groups; mesh the study again.")
    found: dict[int, dict[int, int]] = {}
    for cells, tags in zip(mesh.cells, physical, strict=True):
        by_tag = found.setdefault(_DIMENSION.get(cells.type, -1), {})
        for tag, count in zip(*np.unique(tags, return_counts=True), strict=True):
            by_tag[int(tag)] = by_tag.get(int(tag), 0) + int(count)
    volumes = found.get(regions.dimension, {})
    for tag in regions.volume_tags:
        if tag not in volumes:
            raise MeshError(
                f"Mesh {files.mesh} lacks region {tag} ({regions.names[tag]}); GetDP would leave "
                "it out without a word. Mesh the study again."
            )
    unknown = set(volumes) - set(regions.volume_tags)
    if unknown:
        raise MeshError(
            f"Mesh {files.mesh} holds region {min(unknown)}, which {files.regions.name} does not "
            "name; GetDP would ignore it. Mesh the study again."
        )
    if regions.outer_boundary not in found.get(regions.dimension - 1, {}):
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
        in_iron=material == regions.iron,
        inner=_less(_count(cells, kind), _count(boundary, edge)),
        axis=_less(_count(np.vstack([axis, boundary]), edge), _count(boundary, edge)),
        radius=radius, half_length=half_length)


def _read(path: Path) -> meshio.Mesh:
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
        mesh = untrusted.read_mesh(path)
    except ValueError as error:
        raise MeshError(f"Mesh {path} is damaged ({error}); mesh the study again.") from None
    if not np.isfinite(mesh.points).all():
        raise MeshError(f"Mesh {path} has nodes without a place; mesh the study again.")
    return mesh


def _on(path: Path, mesh: meshio.Mesh, physical: list[Ints], tag: int) -> tuple[str, Ints]:
    """Type and elements of a part of the boundary."""
    return _joined(path, [
        (c.type, c.data[tags == tag]) for c, tags in zip(mesh.cells, physical, strict=True)
        if (tags == tag).any()])


def _joined(path: Path, parts: list[tuple[str, Ints]]) -> tuple[str, Ints]:
    """Elements that are of one type, and which."""
    kinds = {kind for kind, _ in parts}
    if len(kinds) != 1 or not kinds <= set(_CORNERS):
        raise MeshError(f"Mesh {path} holds elements of types {', '.join(sorted(kinds)) or 'none'} "
                        "in place of one; mesh the study again.")
    return kinds.pop(), np.vstack([data for _, data in parts])


def _count(cells: Ints, kind: str) -> Entities:
    """How many different nodes, corners, edges and faces cells of one type have."""
    corners = cells[:, :_CORNERS[kind]]
    return Entities(len(np.unique(cells)), len(np.unique(corners)),
                    _different(corners, _EDGES[kind]), _different(corners, _FACES[kind]))


def _different(corners: Ints, parts: tuple[tuple[int, ...], ...]) -> int:
    """How many parts of cells, by their corners in any order, differ."""
    if not parts or not len(corners):
        return 0
    ordered = np.sort(np.vstack([corners[:, list(part)] for part in parts]), axis=1)
    ordered = ordered.astype(np.int64)
    key = ordered[:, 0]
    for column in ordered.T[1:]:
        key = np.unique(key, return_inverse=True)[1] * (int(ordered.max()) + 1) + column
    return len(np.unique(key))


def _less(all_: Entities, some: Entities) -> Entities:
    return Entities(all_.nodes - some.nodes, all_.corners - some.corners,
                    all_.edges - some.edges, all_.faces - some.faces)


def count_mesh(magnet: Magnet, kind: str) -> CountedMesh:
    """Count the parts of a kind of mesh (a key of `BOUNDARY_RATIO`) without making it."""
    radius = boundary_radius(magnet, kind)
    half_length = boundary_half_length(magnet, kind) if magnet.dimension == 3 else np.inf
    from halbach_fe import geo  # Gmsh loads only when something is meshed

    if kind == "meridian":
        columns, rows = geo.grid_size(magnet, meridian_size(magnet))
        cells = (columns - 1) * (rows - 1)
        nodes = (columns - 1) * (rows - 2)  # the outer boundary is three sides of the half-plane
        return CountedMesh(cells, Entities(nodes, nodes, nodes + cells, cells),
                           Entities(rows - 2, rows - 2, rows - 1, 0), radius, half_length)
    triangles, rim = (round(number) for number in geo.plane_size(magnet, kind))
    # Euler: a disk of T triangles with R edges on its rim has E edges and V corners
    edges = (3 * triangles + rim) // 2
    corners = 1 + edges - triangles
    none = Entities(0, 0, 0, 0)
    if kind == "cross_section":
        inner = Entities(corners + edges - 2 * rim, corners - rim, edges - rim, triangles)
        return CountedMesh(triangles, inner, none, radius, half_length)
    # every prism on a triangle is cut into three, every rectangle on an edge into two
    layers = len(geo.layers(magnet)) - 1
    inner_corners = (corners - rim) * (layers - 1)
    inner_edges = ((corners - rim) * layers + (edges - rim) * (layers - 1)  # upright, level
                   + (edges - rim) * layers)  # and across the rectangles
    inner_faces = triangles * (layers - 1) + 2 * (edges - rim) * layers + 2 * triangles * layers
    return CountedMesh(3 * triangles * layers, Entities(
        inner_corners + inner_edges, inner_corners, inner_edges, inner_faces), none, radius,
                       half_length)
