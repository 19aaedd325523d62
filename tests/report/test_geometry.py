"""Where points are drawn beside the magnet."""

from __future__ import annotations

import numpy as np

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report.page import geometry_figure
from halbach_fe.study.reader import read_study
from tests.conftest import ROOT, circle


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
