"""Convex pieces of outlines: they fill the shape, and stay inside of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from halbach_fe.geometry.array_layout import sector_outline
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.convex_pieces import Shape, annulus
from halbach_fe.geometry.outline import closed_outline, outline_contains


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def area(corners):
    return cross(corners, np.roll(corners, -1, axis=0)).sum() / 2


def checked_area(pieces):
    """Sum of the areas of pieces, all of which must be convex and counter-clockwise."""
    for corners, directions in pieces:
        edges = np.roll(corners, -1, axis=0) - corners
        assert (cross(edges, np.roll(edges, -1, axis=0)) >= -1e-12).all()
        aligned = np.abs(cross(edges[:, None], directions[None])).min(axis=1)
        assert aligned.max() < 1e-9  # every edge has its direction
    return sum(area(corners) for corners, _ in pieces)


def exact_area(outline):
    return MagnetBlock(1, 1, outline, 0.0, 1.0, (1.0, 0.0, 0.0), 1.0, 1.0, 1.0).area


@given(radii=st.lists(st.floats(0.1, 1.0), min_size=3, max_size=40), repeat=st.booleans())
def test_polygons_are_filled(radii, repeat):
    """Stars with any radii are simple, and mostly not convex; repeated corners do no harm."""
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    corners = np.array(radii)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    if repeat:
        corners = np.repeat(corners, 2, axis=0)
    pieces = Shape(closed_outline(corners)).pieces(4e-5, 1.0)
    assert checked_area(pieces) == pytest.approx(area(corners), rel=1e-9)


def sickle():
    """A convex and a concave arc with straight sides that do not lead to the axis."""
    return closed_outline(np.array([(0.5, -0.5), (1.0, -0.5), (1.0, 0.5), (0.5, 0.5)]), (1, 3))


@pytest.mark.parametrize("outline", [
    sector_outline(0.5, 1.0, -0.2, 0.4), sector_outline(0.1, 1.0, -3.0, 3.0), sickle(),
    closed_outline(np.array([(0.5, 0), (0, 0.5), (-0.5, 0), (0, -0.5)]), (0, 1, 2, 3))])
@pytest.mark.parametrize("chords", [4e-5, 1e-3])
def test_pieces_of_arcs_lie_inside(outline, chords):
    """What is missing is at most the error along the whole boundary, and nothing sticks out."""
    shape = Shape(outline)
    pieces = shape.pieces(chords, 2.0)
    missing = exact_area(outline) - checked_area(pieces)
    boundary = sum(edge.length for edge in outline if edge.arc)
    assert 0 < missing < 2 * shape.reach * chords * boundary
    for corners, _ in pieces:
        middle = corners.mean(axis=0)
        assert outline_contains(outline, middle + (1 - 1e-9) * (corners - middle)).all()
        assert (np.hypot(*(corners - shape.centre).T) <= shape.reach * (1 + 1e-12)).all()


def test_only_sectors_about_the_axis_are_polar():
    assert Shape(sector_outline(0.5, 1.0, 0.2, 0.8)).polar == pytest.approx((0.5, 1.0, 0.5, 0.3))
    assert Shape(sector_outline(0.5, 1.0, -3.0, 3.0)).polar[3] == pytest.approx(3.0)
    assert Shape(sickle()).polar is None
    assert Shape(closed_outline(np.array([(0, 0), (1, 0), (1, 1.0)]))).polar is None


def test_annulus_and_disc():
    for inner in (0.0, 0.5):
        found = checked_area(annulus(inner, 1.0).pieces(4e-5, 2.0))
        assert found == pytest.approx(np.pi * (1 - inner**2), rel=1e-3)
