"""Free blocks of several shapes, and a plain NumPy field of cuboids."""

from __future__ import annotations

import numpy as np

from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.outline import Outline, closed_outline

RIGHT_ANGLES = np.arange(4) * np.pi / 2
OUTLINES = {
    "rectangle": closed_outline(np.array([[-6, -5], [6, -5], [6, 5], [-6, 5]]) * 1e-3),
    "trapezoid": closed_outline(np.array([[-5, -3], [5, -5], [5, 5], [-5, 3]]) * 1e-3),
    "triangle": closed_outline(np.array([[0, 0], [12, 1], [4, 9]]) * 1e-3),
    "hexagon": closed_outline(6e-3 * np.column_stack([
        np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)])),
    "L": closed_outline(np.array([[0, 0], [10, 0], [10, 4], [4, 4], [4, 10], [0, 10]]) * 1e-3),
    "cylinder": closed_outline(
        6e-3 * np.column_stack([np.cos(RIGHT_ANGLES), np.sin(RIGHT_ANGLES)]), (0, 1, 2, 3)),
    # inner side 3, outer side 1; 40 degrees about the axis
    "sector": closed_outline(np.array([
        [20 * np.cos(0.2), 20 * np.sin(0.2)], [30 * np.cos(0.2), 30 * np.sin(0.2)],
        [30 * np.cos(0.9), 30 * np.sin(0.9)], [20 * np.cos(0.9), 20 * np.sin(0.9)]]) * 1e-3,
        (1, 3)),
}


def block(outline: str | Outline = "rectangle", height=0.01, place=(0.0, 0.0, 0.0),
          turn=(0.0, 0.0, 0.0), easy=(1.0, 0.0, 0.0), remanence=1.4, along=1.05, across=None):
    """A free block; by default of 12 x 10 x 10 mm."""
    return MagnetBlock(
        ring=1, slot=1, outline=OUTLINES[outline] if isinstance(outline, str) else outline,
        z_min=-height / 2, z_max=height / 2, easy_axis=easy, remanence=remanence,
        recoil_permeability=along, recoil_permeability_across=along if across is None else across,
        origin_m=place, orientation_rad=turn)


def cuboid(sides, **others):
    """A cuboid of three sides in m."""
    a, b, c = np.array(sides) / 2
    return block(closed_outline(np.array([[-a, -b], [a, -b], [a, b], [-a, b]])), 2 * c, **others)


def cuboid_matrix(sides, points):
    """mu_0 H (n, 3, 3) per T of a cuboid at points (n, 3), as sums over its corners in NumPy."""
    found = np.zeros((len(points), 3, 3))
    for signs in np.ndindex(2, 2, 2):
        sign = np.prod(2 * np.array(signs) - 1)
        x, y, z = (points - (2 * np.array(signs) - 1) * np.array(sides) / 2).T
        r = np.sqrt(x**2 + y**2 + z**2)
        for i, (u, v, w) in enumerate(((x, y, z), (y, z, x), (z, x, y))):
            found[:, i, i] += sign * np.arctan(v * w / (u * r)) / (4 * np.pi)
            j = (i + 1) % 3
            off = -sign * np.arcsinh(w / np.hypot(u, v)) / (4 * np.pi)
            found[:, i, j] += off
            found[:, j, i] += off
    return found


def graded(sides, number=24):
    """Points (n, 3) in a cuboid and weights (n,), whose sum is 1, concentrated at its faces.

    The weights vanish there as those of the field's logarithms along edges should.
    """
    t, weight = np.polynomial.legendre.leggauss(number)
    t, weight = (t + 1) / 2, weight / 2
    weight, t = weight * 6 * t * (1 - t), t * t * (3 - 2 * t) - 0.5
    grids = np.meshgrid(*(t * side for side in sides), indexing="ij")
    weights = np.einsum("i,j,k->ijk", weight, weight, weight)
    return np.stack(grids, -1).reshape(-1, 3), weights.ravel()
