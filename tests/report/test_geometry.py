"""Where points are drawn beside the magnet."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report.point_maps import geometry_figure
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
        DIPOLE, dimension=3, array__ring_length_m=0.05,
        array__block={"shape": "trapezoid", "side_gap_m": 0.003})))
    figure = geometry_figure(magnet, np.vstack([circle(0.02, 8, z) for z in (-0.01, 0.01)]))
    for patch, (z, radii) in zip(figure.axes[1].patches, magnet.ring_sections, strict=True):
        assert patch.get_y() == pytest.approx(1e3 * magnet.bore_radius)
        assert patch.get_y() + patch.get_height() == pytest.approx(1e3 * radii[1])
        assert patch.get_x() == pytest.approx(1e3 * z[0])
        assert radii[0] > 1.01 * magnet.bore_radius  # the control: corners are farther away


@pytest.mark.parametrize(("body", "inner_mm", "outer_mm"), [
    ({"kind": "box", "size_m": [0.02, 0.02, 0.01], "centre_m": [0.22, 0.0, 0.0]}, 210.0, 230.2),
    ({"kind": "sphere", "radius_m": 0.01, "centre_m": [0.0, 0.22, 0.0]}, 210.0, 230.0),
    ({"kind": "revolved", "profile_m": [[0.2, -0.02], [0.22, -0.02], [0.22, 0.02], [0.2, 0.02]]},
     200.0, 220.0),
])
def test_iron_is_in_the_side_view(body, inner_mm, outer_mm):
    """From its bore on. A cross-section has no ends, and no side view of points that are tilted."""
    study = {"dimension": 3, "array__ring_length_m": 0.05, "iron": {
        "relative_permeability": 100.0, "bodies": [body]}}
    points = np.vstack([circle(0.02, 8, z) for z in (-0.01, 0.01)])
    figure = geometry_figure(build_magnet(parse_study(changed(DIPOLE, **study))), points)
    patch = figure.axes[1].patches[-1]
    # 96 chords about the axis are nearer to it by 5e-4
    assert patch.get_y() == pytest.approx(inner_mm, rel=1e-3)
    assert patch.get_y() + patch.get_height() == pytest.approx(outer_mm, rel=1e-3)
    flat = build_magnet(parse_study(changed(DIPOLE, iron_ring={
        "inner_radius_m": 0.2, "outer_radius_m": 0.22, "relative_permeability": 100.0})))
    assert len(geometry_figure(flat, points).axes) == 1
