"""Mesh generation with Gmsh: from a magnet to a mesh and its region file.

`mesh_2d` meshes the (x, y) plane of an array of blocks of any shape, `mesh_3d` stacks this plane
mesh in layers along z, and `mesh_meridian` meshes the (r, z) half-plane of a rotationally symmetric
magnet. To write the plane or extruded mesh of a study by hand::

    python -m halbach_fe.geo STUDY.toml -o FOLDER
"""

from halbach_fe.geo.magnet_meshes import (
    fewest_triangles,
    grid_size,
    layers,
    mesh_2d,
    mesh_3d,
    mesh_meridian,
    plane_size,
)

__all__ = [
    "fewest_triangles", "grid_size", "layers", "mesh_2d", "mesh_3d", "mesh_meridian", "plane_size"]
