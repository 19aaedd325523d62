"""Turns by which a magnet is turned onto itself."""

from __future__ import annotations

import tomllib

import pytest

from halbach_fe.geometry.blocks import rotation_about_z
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.symmetry import block_images, symmetry_images
from tests.conftest import parse_study
from tests.support.short_dipole import TEXT


@pytest.mark.parametrize(("order", "blocks", "count"), [(1, 8, 1), (2, 8, 3), (3, 12, 5)])
def test_an_ideal_multipole_is_turned_onto_itself(order, blocks, count):
    """Of 2 n poles: by 2 pi / n about z, and by half turns about n axes across it."""
    magnet = build_magnet(parse_study(tomllib.loads(TEXT.replace(
        "multipole_order = 1", f"multipole_order = {order}").replace(
        "blocks_per_ring = 8", f"blocks_per_ring = {blocks}").replace(
        "width_m = 0.016", "width_m = 0.01"))))
    turns = symmetry_images(magnet)
    assert len(turns) == count  # 2 n less the one that leaves all blocks where they are
    assert all(sorted(each) == list(range(len(magnet.blocks))) for each in turns)
    third = block_images(magnet, rotation_about_z(2.0943951023931953))
    assert (third is not None) == (order == 3)
