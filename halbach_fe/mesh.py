"""Meshes on disk: built by `halbach_fe.geo`, and verified before anything is solved on them.

GetDP reads a truncated mesh, or one that lacks a region, without complaint; so what a mesh holds
is read here, and the number of unknowns that GetDP must find is derived from it.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np

from halbach_fe.errors import MeshError, OutputError
from halbach_fe.regions import Regions
from halbach_fe.study import Study

MESH_NAME = "mesh.msh"
REGIONS_NAME = "regions.json"
MERIDIAN = "meridian"
"""Prefix of the mesh of the (r, z) half-plane."""

MERIDIAN_ELEMENTS = 8
"""Default number of elements across the blocks in the (r, z) half-plane."""

# Edges of meshio's cells, by corner.
_EDGES = {
    "tetra": [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)],
    "wedge": [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)],
    "hexahedron": [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4),
                   (0, 4), (1, 5), (2, 6), (3, 7)],
    "triangle": [(0, 1), (1, 2), (2, 0)],
    "quad": [(0, 1), (1, 2), (2, 3), (3, 0)],
}
_DIMENSION = {"vertex": 0, "line": 1, "line3": 1, "triangle": 2, "triangle6": 2, "quad": 2,
              "quad9": 2, "tetra": 3, "wedge": 3, "hexahedron": 3}


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
    inner_nodes, inner_edges : int
        Off the outer boundary; edges of a 3D mesh only.
    axis_nodes : int
        Of the inner nodes, those on the axis of a half-plane.
    radius, half_length : float
        Extent in m.
    """

    path: Path
    regions: Regions
    nodes: int
    inner_nodes: int
    inner_edges: int
    axis_nodes: int
    radius: float
    half_length: float


def build_mesh(study: Study, folder: Path) -> MeshFiles:
    """Mesh a study into ``folder``; the same study always gives the same mesh."""
    from halbach_fe import geo  # Gmsh loads only when a mesh is built

    try:
        folder.mkdir(parents=True, exist_ok=True)
        files = MeshFiles(folder / MESH_NAME, folder / REGIONS_NAME)
        builder = geo.mesh_2d if study.dimension == 2 else geo.mesh_3d
        builder(study, files.mesh).write(files.regions)
    except OSError as error:
        raise OutputError(f"Cannot write the mesh into {folder}: {error.strerror}.") from None
    return files


def meridian_size(study: Study) -> float:
    """Element size in m of the half-plane at the magnet."""
    thickness = study.array.outer_radius_m - study.array.inner_radius_m
    return study.mesh.meridian_size_m or thickness / MERIDIAN_ELEMENTS


def build_meridian(study: Study, folder: Path) -> MeshFiles:
    """Mesh the (r, z) half-plane of a rotationally symmetric study into ``folder``."""
    from halbach_fe import geo

    files = MeshFiles(folder / f"{MERIDIAN}.msh", folder / f"{MERIDIAN}-regions.json")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        geo.mesh_meridian(study, meridian_size(study), files.mesh).write(files.regions)
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
    inner_nodes, inner_edges = _count_inner(mesh, physical, regions)
    extent = np.abs(mesh.points).max(axis=0)
    if regions.axis is not None:  # x is r, y is z
        radius, half_length = float(extent[0]), float(extent[1])
    else:
        radius = float(np.hypot(*mesh.points[:, :2].T).max())
        half_length = float(extent[2]) if regions.dimension == 3 else np.inf
    return VerifiedMesh(
        path=files.mesh, regions=regions, nodes=len(mesh.points),
        inner_nodes=inner_nodes, inner_edges=inner_edges,
        axis_nodes=_count_axis_nodes(mesh, physical, regions),
        radius=radius, half_length=half_length,
    )


def _read(path: Path) -> meshio.Mesh:
    try:
        with path.open("rb") as file:
            head = file.read(32)
            file.seek(max(0, path.stat().st_size - 32))
            tail = file.read()
    except OSError as error:
        raise MeshError(f"Cannot read mesh {path}: {error.strerror}.") from None
    if not head.startswith(b"$MeshFormat") or b"2.2" not in head:
        raise MeshError(f"Mesh {path} is not an MSH 2.2 file, the newest that GetDP reads.")
    if not tail.rstrip().endswith(b"$EndElements"):
        raise MeshError(f"Mesh {path} is truncated; mesh the study again.")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # meshio prints
            return meshio.read(path)
    except Exception as error:  # meshio raises whatever its parser meets
        raise MeshError(f"Mesh {path} is damaged ({error}); mesh the study again.") from None


def _count_inner(
    mesh: meshio.Mesh, physical: list[np.ndarray], regions: Regions
) -> tuple[int, int]:
    """Nodes, and in 3D edges, that are not on the outer boundary."""
    volume = [c for c in mesh.cells if _DIMENSION[c.type] == regions.dimension]
    faces = [(c.type, c.data[tags == regions.outer_boundary])
             for c, tags in zip(mesh.cells, physical, strict=True)
             if _DIMENSION[c.type] == regions.dimension - 1]
    nodes = (len(np.unique(np.concatenate([c.data.ravel() for c in volume])))
             - len(np.unique(np.concatenate([data.ravel() for _, data in faces]))))
    if regions.dimension == 2:
        return nodes, 0
    edges = _count_edges([(c.type, c.data) for c in volume], len(mesh.points))
    return nodes, edges - _count_edges(faces, len(mesh.points))


def _count_axis_nodes(mesh: meshio.Mesh, physical: list[np.ndarray], regions: Regions) -> int:
    """Nodes on the axis and off the outer boundary; 0 where the mesh has no axis."""
    nodes = {
        tag: np.unique(np.concatenate([
            c.data[tags == tag].ravel() for c, tags in zip(mesh.cells, physical, strict=True)
            if _DIMENSION[c.type] == regions.dimension - 1]))
        for tag in (regions.axis, regions.outer_boundary) if tag is not None}
    if regions.axis is None:
        return 0
    return len(np.setdiff1d(nodes[regions.axis], nodes[regions.outer_boundary]))


def _count_edges(cells: list[tuple[str, np.ndarray]], nodes: int) -> int:
    pairs = np.vstack([data[:, list(pair)] for kind, data in cells for pair in _EDGES[kind]])
    pairs = np.sort(pairs, axis=1).astype(np.int64)
    return len(np.unique(pairs[:, 0] * nodes + pairs[:, 1]))
