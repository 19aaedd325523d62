"""Gmsh geometry: from a study to a mesh and its region file.

`cross_section` builds the (x, y) plane of an array of any block shape; `extruded` stacks it in
layers along z. Both run by hand::

    python -m halbach_fe.geo STUDY.toml -o FOLDER
"""

from halbach_fe.geo.cross_section import mesh_2d
from halbach_fe.geo.extruded import mesh_3d
from halbach_fe.geo.meridian import mesh_meridian

__all__ = ["mesh_2d", "mesh_3d", "mesh_meridian"]
