"""Magnets without a bore: single blocks, linear arrays, blocks on the z axis, in 2D and 3D."""

from __future__ import annotations

import re
import tomllib

import matplotlib.pyplot as plt
import numpy as np
import pytest
import tomlkit

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report import magnet_view_3d, page, point_maps
from halbach_fe.report import solution_page as solution_page
from halbach_fe.report.magnet_view_3d import cut_trace
from halbach_fe.report.page import write_files
from halbach_fe.report.words import in_one_line, magnet_rows
from halbach_fe.response.multipoles import MultipoleReference, multipole_model
from halbach_fe.response.solution import solve
from halbach_fe.solver.routes import finer_in_words
from halbach_fe.study.reader import parse_study


def magnet_of(places, dimension=3, permeability=1.0):
    count = len(places)
    columns = {"name": [f"b{number}" for number in range(count)], "shape": ["cuboid"] * count,
               **{f"{axis}_m": [place[i] for place in places] for i, axis in enumerate("xyz")},
               "size_x_m": [0.02] * count, "size_y_m": [0.02] * count,
               "remanence_T": [1.3] * count}
    if dimension == 3:
        columns["size_z_m"] = [0.02] * count
    return build_magnet(parse_study({
        "name": "no-bore", "dimension": dimension, "mesh": {"block_size_m": 0.004},
        "array": {"recoil_permeability": permeability, "free_blocks": columns},
        "observation": {"quantity": "flux_density", "components": ["x", "y"], "positions": {
            "kind": "points", "points_m": [[0.05, 0, 0], [0.06, 0.001, 0]]}}}))


ONE, LINE = [(0.0, 0.0, 0.0)], [(0.0, 0.021 * k, 0.0) for k in range(-2, 3)]
BESIDE = [(0.04, 0.021 * k, 0.0) for k in range(-2, 3)]
POLES = [(0.0, -0.03, 0.0), (0.0, 0.03, 0.0)]


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("places", "bore"), [
    (ONE, False), (LINE, False), (BESIDE, False), (POLES, True)])
def test_pages(places, bore, dimension, session, tmp_path):
    magnet = magnet_of(places, dimension)
    assert magnet.has_bore == bore
    assert ("no bore" in in_one_line(magnet)) == (not bore)
    assert any("radius of the bore" in name for name in magnet_rows(magnet)) == bore
    if places is LINE:  # their poles are the control of the pictures
        return
    if places is ONE:
        magnet = magnet_of([(0.0, 0.0, 0.0)], dimension)
        found = solve(magnet, session)
        shown = solution_page.page(found)
        write_files(shown, tmp_path)
        assert "halbach-fe plan" in shown.answer.command
        assert (tmp_path / "report.html").exists()
    cut = cut_trace(magnet)
    shown = np.isfinite(np.array(cut.surfacecolor, float))
    assert shown.any()
    assert np.all(np.array(cut.surfacecolor)[shown] > 0)


def test_bar_in_two_dimensions(session):
    """Bx of an infinite bar 2a x 2b magnetized along x: both pole faces are charged sheets, each of
    the angle it is seen at, over 2 pi.
    """
    found = solve(magnet_of(ONE, 2), session)
    angles = [2 * np.arctan(0.01 / (0.05 + sign * 0.01)) for sign in (-1, 1)]
    assert found.flux_density[0, 0] == pytest.approx(
        1.3 / (2 * np.pi) * (angles[0] - angles[1]), abs=1e-12)


def test_permeable_bar_over_the_origin(session):
    """The cross-section is meshed; a bar of permeability 1.05 has a little less field."""
    vacuum, permeable = (solve(magnet_of(ONE, 2, mu), session).flux_density[0, 0]
                         for mu in (1.0, 1.05))
    assert 0.94 < permeable / vacuum < 0.995


@pytest.mark.parametrize("dimension", [2, 3])
def test_multipoles_say_that_there_is_no_axis(dimension, session):
    with pytest.raises(StudyError, match=r"the reference circle of multipoles of study no-bore "
                                         r"must be in air.*which has no bore there"):
        multipole_model(magnet_of(ONE, dimension), MultipoleReference(), session)
    # the control: two poles have an axis
    multipole_model(magnet_of(POLES, dimension), MultipoleReference(), session)


def test_very_many_blocks(monkeypatch):
    """Above their limits pictures draw less and say so."""
    for module, name in ((magnet_view_3d, "MOST_UNEQUAL"), (point_maps, "MOST_POINTING"),
                         (point_maps, "MOST_MEASURED"), (magnet_view_3d, "MOST_SUMMED")):
        monkeypatch.setattr(module, name, 20)
    places = [(0.025 * i, 0.025 * j, 0.03 * k)
              for i in range(-2, 3) for j in range(-2, 3) for k in range(2)]
    magnet = magnet_of(places)
    values = magnet_view_3d.BlockValues(np.zeros((50, 3)), magnet_view_3d.Colours(
        np.where(np.arange(50) == 31, -5.0, 1.0), "change", [f"w{i}" for i in range(50)]))
    blocks, kept = magnet_view_3d._merge_rings(magnet, values)
    assert len(blocks) == 17
    assert kept.colours.values.min() == -5.0  # the block that matters most is drawn
    assert kept.colours.words[[block.name for block in blocks].index("b31")] == "w31"
    assert cut_trace(magnet) is None
    figure, axis = plt.subplots()
    point_maps.draw_cross_section(axis, magnet)
    assert len(axis.lines) == 1
    assert not axis.texts
    plt.close(figure)
    view = str(magnet_view_3d.magnet_view(magnet, values))
    assert "17 of 50 blocks" in view
    # the control: below the limits all are drawn
    monkeypatch.setattr(magnet_view_3d, "MOST_UNEQUAL", 50)
    assert len(magnet_view_3d._merge_rings(magnet, values)[0]) == 50


def two_permeable_prisms(**mesh):
    return build_magnet(parse_study({
        "name": "two-prisms", "dimension": 3, "mesh": {"block_size_m": 0.01, **mesh},
        "array": {"recoil_permeability": 1.06, "free_blocks": {
            "name": ["a", "b"], "shape": 2 * ["cuboid"], "x_m": [0, 0], "y_m": [-0.0268, 0.0268],
            "z_m": [0, 0], "size_x_m": 2 * [0.04], "size_y_m": 2 * [0.04], "size_z_m": 2 * [0.013],
            **{f"remanence_{axis}_T": 2 * [1.3 * (axis == "y")] for axis in "xyz"}}},
        "observation": {"quantity": "flux_density", "positions": {
            "kind": "line", "start_m": [0, 0, -0.03], "end_m": [0, 0, 0.03], "count": 21}}}))


def test_the_advised_key_lowers_the_solver_s_error(session):
    """It is the route's own: the control is the key of another route, which changes no digit."""
    found = solve(two_permeable_prisms(), session)
    bar = found.errors.max()
    advised = solution_page.answer(found).step
    assert "a larger mesh.cells_per_side (now 2)" in advised
    assert "block_size_m" not in advised
    # 2.77 and 0.12 mT were measured: cells of half the size divide it by more than four
    assert solve(two_permeable_prisms(cells_per_side=4), session).errors.max() < bar / 4
    assert solve(two_permeable_prisms(block_size_m=0.001), session).errors.max() == bar


def test_keys_by_route(short_dipole):
    ring = {"iron_ring": {"inner_radius_m": 0.25, "outer_radius_m": 0.26,
                          "relative_permeability": 1000.0}}
    cuboids = {"array__block": {"shape": "cuboid", "width_m": 0.02}}
    far, near = np.array([[0.02, 0.0, 0.0]]), np.array([[0.1035, 0.0, 0.0]])
    for changes, points, keys in (
            ({}, far, ["meridian_size_m"]),
            ({}, near, ["cells_per_side"]),
            ({}, np.vstack([far, near]), ["cells_per_side", "meridian_size_m"]),
            (cuboids, far, ["cells_per_side"]),
            (ring | cuboids, far, ["cells_per_side"]),
            # the grid of the iron is fixed on the route moments
            (ring | cuboids | {"array__recoil_permeability": 1.0}, far, []),
            ({"solver__route": "scalar_potential"}, far, ["block_size_m"]),
            ({"solver__method": "direct"}, far, ["block_size_m"])):
        said = finer_in_words(build_magnet(short_dipole(**changes)), points)
        assert re.findall(r"mesh\.(\w+)", said) == keys


def test_the_study_on_a_page_is_written_in_linear_time(monkeypatch):
    """tomlkit's insertion into an array takes a time that grows with its length: 97 336 cubes took
    hours. The text reads back to the table; of a very large one it names the file that has it.
    """
    def refused(*_):
        raise AssertionError("inserted one by one")

    magnet = magnet_of([(0.1 * i, 0.0, 0.0) for i in range(12)])
    monkeypatch.setattr(tomlkit.items.Array, "insert", refused)
    free = tomllib.loads(page._study_text(magnet.study))["array"]["free_blocks"]
    assert tuple(free["x_m"]) == magnet.study.array.free_blocks.x_m
    assert free["name"][11] == "b11"
    with pytest.raises(AssertionError, match="one by one"):  # the control
        tomlkit.dumps({"x": [1, 2]})
    monkeypatch.setattr(page, "MOST_MEASURED", 11)
    text = page._study_text(magnet.study)
    assert "a table of 12 blocks, is in page.json" in text
    assert "free_blocks" not in tomllib.loads(text)["array"]
