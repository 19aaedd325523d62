"""Magnetostatics: B of a magnet at points, in closed form in vacuum and by finite elements.

`routes` chooses between `exact_block_field`, `separate_blocks` (by `moments`, `axisymmetric_iron`
and `iron_bodies`), `azimuthal_modes` and `magnetostatics` on a mesh of all.
"""
