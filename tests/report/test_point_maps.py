"""How the points of a map lie, and which of them a picture shows."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.collections import QuadMesh

from halbach_fe.measurement.positions import on_grid
from halbach_fe.report.diagnosis_figures import _line
from halbach_fe.report.point_maps import curve, maps_figure, panels, residual_figure
from halbach_fe.study.writer import MagnetTemplate, new_study, parse_new_study
from tests.conftest import circle

CIRCLES = np.vstack([circle(0.03, 12, z) for z in np.linspace(-0.05, 0.05, 7)])
TWO_RADII = np.vstack([CIRCLES, CIRCLES * [0.5, 0.5, 1]])
GRID = on_grid([0.01 * np.arange(-2, 3)] * 3)
FLAT = on_grid([0.01 * np.arange(-2, 3), 0.01 * np.arange(-2, 3), np.zeros(1)])
SPHERE = np.array(parse_new_study(new_study("s", MagnetTemplate(
    ring_length_m=0.05, dsv_m=0.04))).observation.positions.points_m)


NUMBER = np.arange(64)
SPIRAL = 0.03 * np.column_stack([
    np.sqrt(1 - (HEIGHT := 1 - (2 * NUMBER + 1) / 80) ** 2) * np.cos(2.4 * NUMBER),
    np.sqrt(1 - HEIGHT**2) * np.sin(2.4 * NUMBER), HEIGHT]) + [0.001, 0.0, 0.002]
"""Scattered points on a part of a sphere, whose centre is not that of their extremes."""


@pytest.mark.parametrize(("points", "label"), [
    (np.linspace([0, 0, -1], [0, 0, 1], 9), "z in mm"),
    (np.linspace([-1, 0.2, 0], [1, 0.2, 0], 9), "x in mm"),
    (np.linspace([0, 0, 0], [1, 1, 1], 9), "distance along the line in mm"),
    (circle(0.03, 9), "angle in degrees")])
def test_lines_and_circles(points, label):
    place, name = curve(points)
    assert name == label
    assert len(place) == 9
    assert (np.diff(place) > 0).all()


@pytest.mark.parametrize(("points", "titles", "lengths"), [
    (CIRCLES, ["at the radius of 30 mm"], False),
    (TWO_RADII, ["at the radius of 30 mm", "at the radius of 15 mm"], False),
    (SPHERE, ["on the sphere of 40 mm diameter"], False),
    (SPIRAL, ["on the sphere of 60 mm diameter"], False),
    (GRID, ["at y = 0 mm", "at z = 0 mm"], True), (FLAT, ["at z = 0 mm"], True)])
def test_every_panel_shows_many_points(points, titles, lengths):
    """No panel shows a single one, as the equator of a sphere of many latitudes would."""
    assert curve(points) is None
    found = panels(points)
    assert [panel.title for panel in found] == titles
    for panel in found:
        assert panel.lengths == lengths
        assert len(panel.points) > 20
        assert len(np.unique(np.column_stack([panel.first, panel.second]).round(3), axis=0)) == len(
            panel.points)


def test_rounding_does_not_tear_a_circle_apart(generator):
    """Radii and angles that differ in the last bits are the same; the control is 1 mm."""
    points = np.vstack([circle(0.075, 64, z, start=0.0) for z in np.linspace(-0.2, 0.2, 9)])
    points *= 1 + 1e-14 * generator.standard_normal(points.shape)
    shown, = panels(points)
    assert len(shown.points) == len(points)
    figure = maps_figure(points, {"Bx": points[:, 0]}, "mT")
    mesh, = (part for part in figure.axes[0].collections if isinstance(part, QuadMesh))
    assert mesh.get_array().shape == (64, 9)
    points[:64, :2] *= 0.076 / 0.075
    assert len(panels(points)) == 2


@pytest.mark.parametrize(("points", "shown", "on_a_line"), [
    (SPIRAL, len(SPIRAL), False), (CIRCLES, 7, True)])
def test_the_profile_of_a_diagnosis_shows_many_points(points, shown, on_a_line):
    """Of scattered points every one has a line of its own."""
    observation = SimpleNamespace(positions=points, places=points, labels=["Bx"] * len(points),
                                  components=[True] * len(points),
                                  radii=np.hypot(*points[:, :2].T))
    update = SimpleNamespace(readings=np.ones(len(points)), held_out=np.zeros(len(points), bool),
                             observation=observation, is_campaign=False)
    label, index, along, name, connected = _line(update, np.arange(1.0, len(points) + 1))
    assert (label, name, connected) == ("Bx", "z in mm", on_a_line)
    assert len(index) == len(along) == shown


def test_what_is_zero_is_not_drawn():
    """A component of rounding errors has no colours; the control is one part in a million."""
    field = {"Bx": np.linspace(1, 2, len(CIRCLES)), "By": np.full(len(CIRCLES), 1e-13)}
    assert len(maps_figure(CIRCLES, field, "mT").axes) == 2  # the map and its colours
    assert len(maps_figure(CIRCLES, field | {"By": 1e-6 * field["Bx"]}, "mT").axes) == 4
    assert len(maps_figure(CIRCLES, {"Bx": 0 * field["Bx"]}, "mT").axes) == 2


def test_residuals_stand_side_by_side():
    residual = np.linspace(-1, 1, len(CIRCLES))
    figure = residual_figure(CIRCLES, {"Bx": {"before": residual, "after": 0.1 * residual}}, "µT")
    before, after = figure.axes[:2]
    assert before.get_title().startswith("before, at the radius")
    assert (before.collections[0].get_clim()[1] / after.collections[0].get_clim()[1]
            == pytest.approx(10))
