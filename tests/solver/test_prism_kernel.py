"""The compiled field of prisms against plain NumPy and magpylib."""

from __future__ import annotations

import magpylib
import numpy as np
import pytest

from halbach_fe.solver.exact_block_field import matrix_of
from halbach_fe.solver.field_kernels import arc_table, outline_fields, prism_field
from tests.solver.moments.bodies import OUTLINES, block, cuboid_matrix

ROUNDING = 1e-13
"""Both are sums of some 24 terms of size 1; the difference was at most 1e-15."""

MAGPYLIB_ERROR = 1e-9
"""Of magpylib's polyhedra, whose faces are triangles: at most 4e-12 was measured."""

SIDES = (0.012, 0.01, 0.008)
RECTANGLE = np.array([[-6, -5], [6, -5], [6, 5], [-6, 5]]) * 1e-3


def field(vertices, half, points, cuboid=False):
    vertices = np.ascontiguousarray(vertices)
    return matrix_of(np.array([prism_field(vertices, half, cuboid, *point) for point in points]))


def by_outline(vertices, half, points):
    """The same by the function for outlines that may have arcs."""
    edges = np.hstack([vertices, np.roll(vertices, -1, axis=0)])
    turns, weights = arc_table(0.0)
    found = np.empty((len(points), 6))
    outline_fields(edges, np.empty((0, 3)), turns[None], weights, -half, half, points, 0,
                   len(points), found)
    return matrix_of(found)


def corners(name):
    return np.array([edge.start for edge in OUTLINES[name]])


@pytest.mark.parametrize("cuboid", [True, False])
def test_cuboid_against_numpy(generator, cuboid):
    points = generator.uniform(-0.02, 0.02, (2000, 3))
    np.testing.assert_allclose(field(RECTANGLE, 0.004, points, cuboid),
                               cuboid_matrix(SIDES, points), atol=ROUNDING)


def test_cuboid_near_its_faces_edges_and_corners(generator):
    """The argument of a product of complex numbers is right on all sides of all faces.

    The polygon's solid angles are added edge by edge instead. On edges the field is infinite.
    """
    for _ in range(40):
        sides = 10**generator.uniform(-2, 0, 3)
        base = generator.choice([-1, 0, 1], (500, 3))
        away = generator.choice([-1, 1], (500, 3)) * 10**generator.uniform(-8, 2, (500, 3))
        away *= generator.uniform(size=away.shape) < 0.8
        infinite = ((away == 0) & (base != 0)).sum(axis=1) > 1
        points = (base * sides + away * sides.max())[~infinite]
        flat = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * sides[:2]
        # 1e-8 of the size from an edge the logarithms have lost half of their digits
        np.testing.assert_allclose(field(flat, sides[2], points, cuboid=True),
                                   field(flat, sides[2], points), atol=1e-9)


CONVEX = {"trapezoid": [slice(None)], "triangle": [slice(None)], "hexagon": [slice(None)],
          "L": [[0, 1, 2, 3], [0, 3, 4, 5]]}
"""Corners of the convex pieces of every outline."""


@pytest.mark.parametrize("name", CONVEX)
@pytest.mark.parametrize("method", [field, by_outline])
def test_polygon_against_magpylib(generator, name, method):
    """Polyhedra of triangles, whose field is derived face by face and not edge by edge."""
    points = np.vstack([generator.uniform(-size, size, (200, 3)) for size in (0.03, 0.004)])
    flat = corners(name)
    ours = method(flat, 0.005, points)
    outside = ~block(name).contains(points)
    for axis in range(3):
        pieces = magpylib.Collection([magpylib.magnet.TriangularMesh.from_ConvexHull(
            points=[(x, y, z) for x, y in flat[piece] for z in (-0.005, 0.005)],
            polarization=np.eye(3)[axis]) for piece in CONVEX[name]])
        np.testing.assert_allclose(ours[outside, :, axis], pieces.getB(points[outside]),
                                   atol=MAGPYLIB_ERROR)
        # inside, ours is mu_0 H
        mu0 = 4e-7 * np.pi
        np.testing.assert_allclose(ours[~outside, :, axis], mu0 * pieces.getH(points[~outside]),
                                   atol=1e-8)  # magpylib's mu_0 is the measured one


@pytest.mark.parametrize("name", ["rectangle", "trapezoid", "L"])
def test_trace_tells_inside_from_outside(generator, name):
    points = generator.uniform(-0.012, 0.012, (1000, 3))
    trace = np.trace(field(corners(name), 0.005, points), axis1=1, axis2=2)
    np.testing.assert_allclose(trace, -1.0 * block(name).contains(points), atol=1e-12)


def test_a_clockwise_polygon_has_the_opposite_field(generator):
    """Negative control: the order of the corners matters."""
    points = generator.uniform(-0.03, 0.03, (20, 3))
    flat = corners("trapezoid")
    np.testing.assert_allclose(field(flat[::-1], 0.005, points), -field(flat, 0.005, points),
                               atol=ROUNDING)


def test_on_faces_edges_and_their_prolongations():
    """Finite everywhere; on a face the mean of both sides, on prolongations what is nearby."""
    a, b, c = np.array(SIDES) / 2
    face = np.array([[a, 1e-3, 2e-3], [1e-3, 2e-3, c], [1e-3, -b, -1e-3]])
    out = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    prolonged = np.array([[a, b, 2 * c], [3 * a, b, c], [a, -2 * b, 0], [2 * a, b, 0.0],
                          [0, 0, 2 * c], [a, 2 * b, c]])
    edges = np.array([[a, b, c], [a, b, 0], [0, b, -c]])
    step = 1e-9
    for cuboid in (True, False):
        assert np.isfinite(field(RECTANGLE, c, edges, cuboid)).all()
        mean = (field(RECTANGLE, c, face + step * out, cuboid)
                + field(RECTANGLE, c, face - step * out, cuboid)) / 2
        np.testing.assert_allclose(field(RECTANGLE, c, face, cuboid), mean, atol=1e-6)
        np.testing.assert_allclose(field(RECTANGLE, c, prolonged, cuboid),
                                   field(RECTANGLE, c, prolonged + step, cuboid), atol=1e-6)
