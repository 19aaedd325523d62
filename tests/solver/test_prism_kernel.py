"""The compiled field of prisms against plain NumPy, the exact field by quadrature, and magpylib."""

from __future__ import annotations

import magpylib
import numpy as np
import pytest

from halbach_fe.solver.exact_block_field import matrix_of, unit_field
from halbach_fe.solver.prism_kernel import fields_at
from tests.solver.moments.bodies import OUTLINES, block, cuboid_matrix

ROUNDING = 1e-13
"""Both are sums of some 24 terms of size 1; the difference was at most 1e-15."""

QUADRATURE = 1e-9
"""unit_field integrates by quadrature, with an error of some 1e-12 of the field."""

SIDES = (0.012, 0.01, 0.008)
RECTANGLE = np.array([[-6, -5], [6, -5], [6, 5], [-6, 5]]) * 1e-3


def field(vertices, half, points, cuboid=False):
    found = np.empty((len(points), 6))
    fields_at(np.ascontiguousarray(vertices), half, cuboid, np.ascontiguousarray(points), found)
    return matrix_of(found)


def corners(name):
    return np.array([edge.start for edge in OUTLINES[name]])


@pytest.mark.parametrize("cuboid", [True, False])
def test_cuboid_against_numpy(generator, cuboid):
    points = generator.uniform(-0.02, 0.02, (2000, 3))
    np.testing.assert_allclose(field(RECTANGLE, 0.004, points, cuboid),
                               cuboid_matrix(SIDES, points), atol=ROUNDING)


@pytest.mark.parametrize("name", ["trapezoid", "triangle", "hexagon", "L"])
def test_polygon_against_quadrature(generator, name):
    points = generator.uniform(-0.03, 0.03, (400, 3))
    points = points[np.abs(np.abs(points[:, 2]) - 0.005) > 1e-3]
    prism = block(name)
    away = ~block(name, 0.012).contains(points)  # quadrature is slow near a surface
    points = points[away]
    np.testing.assert_allclose(field(corners(name), 0.005, points), unit_field(prism, points),
                               atol=QUADRATURE)


def test_polygon_against_magpylib(generator):
    points = np.vstack([generator.uniform(-size, size, (200, 3)) for size in (0.03, 0.004)])
    flat = corners("hexagon")
    hull = [(x, y, z) for x, y in flat for z in (-0.005, 0.005)]
    ours = field(flat, 0.005, points)
    outside = ~block("hexagon").contains(points)
    for axis in range(3):
        body = magpylib.magnet.TriangularMesh.from_ConvexHull(
            points=hull, polarization=np.eye(3)[axis])
        np.testing.assert_allclose(ours[outside, :, axis], body.getB(points[outside]), atol=1e-9)
        # inside, ours is mu_0 H
        mu0 = 4e-7 * np.pi
        np.testing.assert_allclose(ours[~outside, :, axis], mu0 * body.getH(points[~outside]),
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
