"""Where points are drawn beside the magnet."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report.page import geometry_figure
from halbach_fe.study.reader import parse_study, read_study
from tests.conftest import DIPOLE, ROOT, changed, circle


def test_points_and_blocks_are_in_view():
    """Off one plane there is a side view; its limits hold all that is drawn, from the axis on."""
    study = read_study(ROOT / "studies" / "cubes" / "study.toml")
    points = np.vstack([circle(0.08, 8, z) for z in (-0.05, 0.05)])
    _, side = geometry_figure(build_magnet(study), points).axes
    (low, high), (left, right) = side.get_ylim(), side.get_xlim()
    assert low == 0
    assert high > 1e3 * study.array.outer_radius_m
    assert left < -50
    assert right > 50
    assert len(geometry_figure(build_magnet(study), points[:8]).axes) == 1


def test_rings_are_drawn_from_their_bore_on():
    """The flat inner side of a trapezoid is nearer to the axis than its corners."""
    magnet = build_magnet(parse_study(changed(
        DIPOLE, array__block={"shape": "trapezoid", "side_gap_m": 0.003})))
    figure = geometry_figure(magnet, np.vstack([circle(0.02, 8, z) for z in (-0.01, 0.01)]))
    for patch, (z, radii) in zip(figure.axes[1].patches, magnet.ring_sections, strict=True):
        assert patch.get_y() == pytest.approx(1e3 * magnet.bore_radius)
        assert patch.get_y() + patch.get_height() == pytest.approx(1e3 * radii[1])
        assert patch.get_x() == pytest.approx(1e3 * z[0])
        assert radii[0] > 1.01 * magnet.bore_radius  # the control: corners are farther away
