"""The geometry of the magnet that a study describes: blocks, outlines, symmetry, domain."""
