"""Neighbouring magnets stand beside the magnet, and readings beside both."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import build_magnet, neighbour_blocks
from halbach_fe.solver.exact_block_field import external_field, field_of, neighbour_field
from halbach_fe.solver.routes import check_points
from halbach_fe.study.external_keys import Neighbour
from tests.conftest import circle


def with_neighbours(*neighbours):
    return {"external": {"neighbours": list(neighbours)}}


def test_a_cross_section_has_no_neighbours(dipole):
    """In 2D blocks are infinite along z: another magnet would be in the same place."""
    with pytest.raises(StudyError, match=r"external\.neighbours needs a 3D study"):
        dipole(**with_neighbours({"z_m": 1.0}))


@pytest.mark.parametrize(("neighbours", "z"), [
    ([{"z_m": 0.0}], "0"),
    ([{"z_m": 0.0, "turn_deg": 45.0, "factor": -1.0}], "0"),
    ([{"z_m": 0.15}], "0.15"),  # the magnet is 0.16 m long
    ([{"z_m": -0.15, "turn_deg": 10.0}], "-0.15"),
    ([{"z_m": 0.3}, {"z_m": 0.4}], "0.4"),
], ids=["same place", "turned", "partly", "other side", "two neighbours"])
def test_neighbours_in_the_same_place(short_dipole, neighbours, z):
    with pytest.raises(StudyError, match=rf"external\.neighbours.*z_m = {z} whose block"):
        build_magnet(short_dipole(**with_neighbours(*neighbours)))


def test_neighbours_in_iron(short_dipole):
    """Which is longer than the blocks."""
    iron = {"iron": {"relative_permeability": 1000.0, "bodies": [
        {"kind": "tube", "inner_radius_m": 0.0, "outer_radius_m": 0.2, "length_m": 0.02,
         "z_m": 0.11}]}}
    build_magnet(short_dipole(**iron, **with_neighbours({"z_m": 0.3})))
    with pytest.raises(StudyError, match=r"external\.neighbours"):
        build_magnet(short_dipole(**iron, **with_neighbours({"z_m": 0.19})))


def test_readings_inside_a_neighbour(short_dipole):
    magnet = build_magnet(short_dipole(**with_neighbours({"z_m": 0.17}, {"z_m": -0.5})))
    check_points(magnet, circle(0.05, z=0.17))
    with pytest.raises(StudyError, match="24 of 24 points lie inside magnet or iron"):
        check_points(magnet, circle(0.14, z=0.172))
    with pytest.raises(StudyError, match="24 of 24 points lie between r01s13 and r02s13, which"):
        check_points(magnet, circle(0.14, z=0.17))  # where its rings touch
    # negative control: without the neighbour there is air
    check_points(build_magnet(short_dipole()), circle(0.14, z=0.17))


def test_blocks_of_a_neighbour(short_dipole, generator):
    """They are where its field comes from, also of blocks that are mounted askew."""
    magnet = build_magnet(short_dipole(array__exceptions=[
        {"ring": 1, "slot": 3, "displacement_m": [1e-3, 0, 2e-3], "rotation_deg": [0, 0.5, 0.2]}]))
    neighbour = Neighbour(z_m=0.25, turn_deg=33.0, factor=-0.7)
    points = generator.uniform([-0.07, -0.07, 0.13], [0.07, 0.07, 0.27], (20, 3))
    np.testing.assert_allclose(
        field_of(neighbour_blocks(magnet.blocks, (neighbour,)), points),
        neighbour_field(magnet, neighbour, points), atol=1e-12)
    whole = magnet.with_(external__neighbours=(neighbour,))
    assert np.abs(external_field(whole, points)).max() > 1e-3
