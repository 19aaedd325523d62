"""Mesh of the (r, z) half-plane around rotationally symmetric iron, in rectangles.

Only the iron shapes this mesh; blocks are air in it. The grid lines come from
`halbach_fe.solver.iron_grid`. The mesh's x is r and its y is z.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.geo.grid import add_grid
from halbach_fe.geo.session import gmsh_session, write_mesh
from halbach_fe.geometry import domain as tags
from halbach_fe.geometry.domain import Regions


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
    with gmsh_session(name):
        add_grid(r, z, np.where(in_iron, tags.IRON_TAG, tags.AIR_TAG))
        write_mesh(mesh_path)
    return Regions(study=name, dimension=2, air=tags.AIR_TAG, iron=tags.IRON_TAG,
                   outer_boundary=tags.OUTER_BOUNDARY_TAG, axis=tags.AXIS_TAG, blocks=())
