"""Cells: volume, centroid, numbers, and nodes."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.moments.cells import area_and_centroid, cells_of, gauss_nodes
from tests.solver.moments.bodies import OUTLINES, block, cuboid

TURN = (0.3, -0.8, 0.5)
PLACE = (0.01, -0.02, 0.03)


def centroid(name):
    """Centroid of an outline by dense sampling of its boundary, (2,) in m."""
    t = (np.arange(4000)) / 4000
    boundary = np.vstack([edge.at(t)[0] for edge in OUTLINES[name]])
    return area_and_centroid(boundary[None])[1][0]


@pytest.mark.parametrize("per_side", [1, 2, 3])
@pytest.mark.parametrize("name", OUTLINES)
def test_volume_and_centroid(name, per_side):
    """They are exact, up to 1e-7 of the samples on arcs of `centroid`."""
    body = block(name, place=PLACE, turn=TURN)
    cells = cells_of([body], per_side)
    assert (cells.volume > 0).all()
    assert cells.volume.sum() == pytest.approx(body.volume, rel=1e-12)
    middle = cells.volume @ cells.centre / cells.volume.sum()
    expected = body.from_frame(np.array([[*centroid(name), 0.0]]))[0]
    np.testing.assert_allclose(middle, expected, atol=1e-8)


@pytest.mark.parametrize("name", OUTLINES)
def test_nodes_lie_in_the_block_and_have_its_moments(name):
    """Nodes integrate polynomials up to degree 3 within straight outlines."""
    body = block(name, place=PLACE, turn=TURN)
    cells = cells_of([body], 2, divisions=3)
    np.testing.assert_allclose(cells.weights.sum(axis=1), 1)
    np.testing.assert_allclose(cells.mean(cells.nodes), cells.centre, atol=1e-12)
    inside = body.contains(cells.nodes.reshape(-1, 3))
    assert inside.all()


def test_cuboids_and_proportions():
    cells = cells_of([cuboid((0.04, 0.01, 0.01), place=PLACE, turn=TURN)], 2)
    assert cells.cuboid.all()
    assert len(cells) == 5 * 2 * 2  # a cube of the same volume has sides of 15.9 mm
    assert len(cells_of([cuboid((0.01, 0.01, 0.01))], 3)) == 27
    assert not cells_of([block("trapezoid")], 1).cuboid.any()


def test_polygons_have_as_few_cells_as_possible():
    """The time of columns grows with the square of the cells, and of a lattice of prisms."""
    flat = {"triangle": (1, 3), "hexagon": (2, 6)}  # of the height of a cube of the same volume
    for name, (least, finer) in flat.items():
        body = block(name, height=float(np.cbrt(block(name, height=1.0).volume**1.5)))
        assert len(cells_of([body], 1)) == least
        assert len(cells_of([body], 2)) >= 2 * finer


def test_blocks_of_an_array(short_dipole):
    """Sectors and cuboids of rings; chords of sectors without gaps do not overlap."""
    for shape in ({"shape": "sector"}, {"shape": "cuboid", "width_m": 0.03}):
        blocks = build_magnet(short_dipole(array__block=shape)).blocks
        cells = cells_of(blocks, 2)
        volumes = np.bincount(cells.block, cells.volume)
        np.testing.assert_allclose(volumes, [body.volume for body in blocks], rtol=1e-12)
        assert cells.cuboid.all() == (shape["shape"] == "cuboid")


def test_graded_nodes_integrate_logarithms_better():
    """The mean of ln(x) over 0 < x < 1 is -1."""
    square, half = np.array([[[0, 0], [1, 0], [1, 1], [0, 1.0]]]), np.array([1.0])
    errors = [abs(weights[0] @ np.log(nodes[0, :, 0]) + 1) for nodes, weights in (
        gauss_nodes(square, half, 8, graded) for graded in (False, True))]
    assert errors[1] < 1e-3 < errors[0]
