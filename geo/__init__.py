"""Gmsh geometry: from a study to a mesh and its region file.

`cross_section` builds the (x, y) plane of an array of any block shape; `extruded` stacks it in
layers along z. Both run by hand::

    python -m halbach_fe.geo STUDY.toml -o FOLDER
"""

from halbach_fe.geo.cross_section import mesh_2d, plane_size
from halbach_fe.geo.extruded import layers, mesh_3d
from halbach_fe.geo.meridian import grid_size, mesh_meridian

__all__ = ["grid_size", "layers", "mesh_2d", "mesh_3d", "mesh_meridian", "plane_size"]
