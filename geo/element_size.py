"""Element sizes of plane meshes: in the bore, in blocks and iron, and towards the boundary.

3D meshes are stacked from plane ones, in the layers of `halbach_fe.geo.extruded.layers`. The
(r, z) half-plane has a grid of its own (`halbach_fe.geo.meridian`).
"""

from __future__ import annotations

import gmsh

from halbach_fe.geometry.magnet import Magnet


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
