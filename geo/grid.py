"""Writer of meshes of the (r, z) half-plane: rectangles between grid lines.

The mesh's x is r and its y is z.
"""

from __future__ import annotations

import gmsh
import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry import domain as tags

LINE, QUADRANGLE = 1, 3
"""Gmsh's element types of edges and quadrangles."""


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
    for tag in present:
        _add(2, QUADRANGLE, tag, cells[material.ravel() == tag])
    for tag, lines in ((tags.AXIS_TAG, axis), (tags.OUTER_BOUNDARY_TAG, rim)):
        gmsh.model.addDiscreteEntity(1, tag)
        _add(1, LINE, tag, lines)


def _add(dimension: int, kind: int, tag: int, nodes: Ints) -> None:
    """Add elements, rows of ``nodes`` counted from 0, to the discrete entity ``tag``."""
    gmsh.model.mesh.addElementsByType(tag, kind, [], (nodes + 1).ravel())
    gmsh.model.addPhysicalGroup(dimension, [tag], tag)
