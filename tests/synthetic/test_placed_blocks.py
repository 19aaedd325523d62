"""Campaigns of magnets whose blocks were sorted first: the map is that of the sorted magnet."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import read_blocks, write_blocks
from halbach_fe.measurement.field_map import points_of, read_map
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.simulate import simulate_campaign, simulate_delivery

SIDE_M, COIL_SD, NOISE_T = 0.012, 1e-6, 1e-9

STUDY = f"""
name = "sorted"
[array]
rings = 2
blocks_per_ring = 8
inner_radius_m = 0.04
outer_radius_m = {0.04 + SIDE_M}
ring_length_m = {SIDE_M}
ring_gap_m = 0.01
remanence_T = 1.3
recoil_permeability = 1.0
block = {{ shape = "cuboid", width_m = {SIDE_M}, orientation = "magnetization" }}
[homogeneity]
sphere_m = 0.02
[mesh]
block_size_m = 0.006
[observation]
quantity = "flux_density"
[observation.positions]
kind = "circles"
radius_m = 0.02
angles = 4
z_min_m = -0.02
z_max_m = 0.02
count = 2
[[noise.regions]]
name = "bore"
sigma_T = {NOISE_T}
[prior]
magnitude_sd = 0.01
direction_sd_deg = 1.0
types = {{ cube = [1, 2, 3, 4, 5, 6, 7, 8] }}
"""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A folder with the campaign of sorted blocks, the delivered table, and the sorted one."""
    folder = tmp_path_factory.mktemp("placed")
    study = folder / "study.toml"
    study.write_text(STUDY)
    options = ["--coil-sd", str(COIL_SD), "--seed", "3"]
    delivered, placed = folder / "delivered.csv", folder / "sorted" / "blocks.sorted.csv"
    write_blocks(simulate_delivery(parse_study(tomllib.loads(STUDY)), 3, COIL_SD), delivered)
    assert main(["sort", str(study), str(delivered), "-o", str(placed.parent)]) == 0
    assert main(["simulate-measurement", str(study), *options, "--placed", str(placed),
                 "-o", str(folder / "built")]) == 0
    return folder, delivered, placed


def field_of(table, points):
    """magpylib's field (n, 3) in T of cubes with the moments of a table, in its places."""
    place = {(block.ring, block.slot): block for block in build_magnet(study()).blocks}
    field = np.zeros_like(points)
    for row, moment in zip(table.places, table.moment, strict=True):
        block = place[row]
        radial = Rotation.from_euler("z", np.arctan2(*block.middle[1::-1]))
        faces = Rotation.from_euler("z", block.facing_deg, degrees=True)
        polarization = faces.inv().apply(radial.apply(MU_0 * moment / SIDE_M**3))
        field += magpylib.magnet.Cuboid(
            dimension=(SIDE_M,) * 3, polarization=polarization, position=block.middle,
            orientation=faces).getB(points)
    return field


def study():
    return parse_study(tomllib.loads(STUDY))


def test_the_map_is_that_of_the_sorted_magnet(campaign):
    folder, delivered, placed = campaign
    data, table = read_map(folder / "built" / "map.csv"), read_blocks(placed)
    assert table.places != read_blocks(delivered).places
    assert read_blocks(folder / "built" / "blocks.csv").places == table.places
    readings = data["B_T"].values
    # the coil's noise of 1e-6 makes some 1e-6 / sqrt(16) of the field
    tolerance = 3e-6 * np.abs(readings).max()
    points = points_of(data)
    assert np.abs(field_of(table, points) - readings).max() < tolerance
    # control: the blocks in the order of their delivery
    other = field_of(read_blocks(delivered), points) - readings
    assert np.abs(other).max() > 100 * tolerance


@pytest.mark.parametrize(("change", "said"), [
    (lambda t: replace(t, moment=t.moment[::-1]), "moment of block .* without --turns"),
    (lambda t: replace(t, serial=("X1", *t.serial[1:])), "block X1 .* one of the simulated"),
    (lambda t: replace(t, ring=np.where(t.ring == 2, 3, t.ring)), "place of block"),
    (lambda t: replace(t, ring=0 * t.ring, slot=0 * t.slot), "16 empty ones, first ring 1, slot"),
])
def test_tables_of_other_blocks(campaign, tmp_path, change, said):
    _, _, placed = campaign
    table = tmp_path / "blocks.csv"
    write_blocks(change(read_blocks(placed)), table)
    with pytest.raises(MeasurementError, match=said):
        simulate_campaign(study(), 3, COIL_SD, placed=read_blocks(table))
