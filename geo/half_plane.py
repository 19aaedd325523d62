"""Mesh of the (r, z) half-plane around rotationally symmetric iron, in rectangles.

Only the iron shapes this mesh; blocks are air in it. The grid lines come from
`halbach_fe.solver.iron_grid`. The mesh's x is r and its y is z.
"""

from __future__ import annotations

from pathlib import Path

import gmsh
import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geo.session import gmsh_session, write_mesh
from halbach_fe.geometry import regions as tags
from halbach_fe.geometry.regions import Regions

LINE, QUADRANGLE = 1, 3
"""Gmsh's element types of edges and quadrangles."""


def mesh_half_plane(
    name: str, r: Floats, z: Floats, in_iron: NDArray[np.bool_], mesh_path: Path
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
    mesh_path : Path

    Raises
    ------
    MeshError
        If Gmsh fails.
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
    with gmsh_session(name):
        gmsh.model.addDiscreteEntity(2, tags.AIR_TAG)
        gmsh.model.mesh.addNodes(2, tags.AIR_TAG, np.arange(1, len(points) + 1), points.ravel())
        gmsh.model.addDiscreteEntity(2, tags.IRON_TAG)
        iron = in_iron.ravel()
        _add(2, QUADRANGLE, tags.AIR_TAG, cells[~iron])
        _add(2, QUADRANGLE, tags.IRON_TAG, cells[iron])
        for tag, lines in ((tags.AXIS_TAG, axis), (tags.OUTER_BOUNDARY_TAG, rim)):
            gmsh.model.addDiscreteEntity(1, tag)
            _add(1, LINE, tag, lines)
        write_mesh(mesh_path)
    return Regions(study=name, dimension=2, air=tags.AIR_TAG, iron=tags.IRON_TAG,
                   outer_boundary=tags.OUTER_BOUNDARY_TAG, axis=tags.AXIS_TAG, blocks=())


def _add(dimension: int, kind: int, tag: int, nodes: Ints) -> None:
    """Add elements, rows of ``nodes`` counted from 0, to the discrete entity ``tag``."""
    gmsh.model.mesh.addElementsByType(tag, kind, [], (nodes + 1).ravel())
    gmsh.model.addPhysicalGroup(dimension, [tag], tag)
