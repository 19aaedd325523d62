"""Campaigns of magnets whose blocks were sorted first: the map is that of the sorted magnet."""

from __future__ import annotations

import csv
import tomllib
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError
from halbach_fe.design.assembly import cad
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.block_prior import prior_from_blocks
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


@pytest.fixture(scope="module")
def turned(campaign):
    """The same with blocks that are turned in their slots, and its table."""
    folder, delivered, _ = campaign
    table = folder / "turned" / "blocks.sorted.csv"
    assert main(["sort", str(folder / "study.toml"), str(delivered), "-o", str(table.parent),
                 "--turns"]) == 0
    return folder, delivered, table


def up_by_moments(delivered, sorted_table, place, columns):
    """Which of its own axes (3,), as measured, a block has along z of the magnet: by the turn of
    ``columns`` of assembly.csv, if it carries the delivered moment to the one of the sorted table.
    """
    row = sorted_table.places.index(place)
    blocks = {(block.ring, block.slot): block for block in build_magnet(study()).blocks}

    def own(table, row, at):
        radial = Rotation.from_euler("z", np.arctan2(*blocks[at].middle[1::-1]))
        faces = Rotation.from_euler("z", blocks[at].facing_deg, degrees=True)
        return faces.inv().apply(radial.apply(table.moment[row]))

    before = delivered.serial.index(sorted_table.serial[row])
    turn = Rotation.from_rotvec(columns, degrees=True)
    # without a place the moment is in the axes of the first slot of its type
    carried = turn.apply(own(delivered, before, (1, 1) if not delivered.ring[before]
                             else delivered.places[before]))
    np.testing.assert_allclose(carried, own(sorted_table, row, place), rtol=0,
                               atol=1e-9 * np.linalg.norm(carried))
    return turn.inv().apply([0.0, 0.0, 1.0])


@pytest.mark.filterwarnings("ignore:.*better than any coil measures")  # so that it is exact
def test_turns_travel_with_the_sorted_table(turned, tmp_path):
    """The plan to assemble says of each block which axis is up; all readers take the table."""
    folder, delivered, path = turned
    table = read_blocks(path)
    assert main(["cad", str(folder / "study.toml"), "--blocks", str(path),
                 "-o", str(tmp_path / "cad")]) == 0
    with (tmp_path / "cad" / "assembly.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    count = 0
    for row in rows:
        columns = [float(row[f"turn_{axis}_deg"]) for axis in "xyz"]
        up = up_by_moments(read_blocks(delivered), table, (int(row["ring"]), int(row["slot"])),
                           columns)
        axis = int(np.argmax(np.abs(up)))
        assert f"; its {'' if up[axis] > 0 else '−'}{'xyz'[axis]} up" in row["way_round"]
        assert ("turned by" in row["way_round"]) == any(columns)
        count += any(columns)
    assert count == np.sum(table.turn_deg.any(axis=1)) > 4  # a quarter of the cubes stays
    html = (tmp_path / "cad" / "assembly.html").read_text()
    assert html.count(" up</text>") == count
    assert "turned by" in html
    # the prior takes the moments as they are, and a block that is sorted again keeps its turn
    assert np.array_equal(prior_from_blocks(build_magnet(study()), table).gaussian.mean,
                          prior_from_blocks(build_magnet(study()), replace(
                              table, turn_deg=None)).gaussian.mean)
    assert main(["sort", str(folder / "study.toml"), str(path), "-o", str(tmp_path / "again"),
                 "--turns"]) == 0
    again = read_blocks(tmp_path / "again" / "blocks.sorted.csv")
    turns = np.zeros((len(again), 3)) if again.turn_deg is None else again.turn_deg
    for place, turn in zip(again.places, turns, strict=True):
        up_by_moments(read_blocks(delivered), again, place, turn)
    # control: the plan of the table without its turns says another axis, as it did
    plain = cad(build_magnet(study()), replace(table, turn_deg=None))
    assert sum(one.way_round != row["way_round"] for one, row in zip(
        plain.blocks, rows, strict=True)) == count
    with pytest.raises(AssertionError):
        turned_row = int(np.flatnonzero(table.turn_deg.any(axis=1))[0])
        up_by_moments(read_blocks(delivered), table, table.places[turned_row], [0.0, 0.0, 0.0])


def test_a_campaign_of_turned_blocks(turned):
    folder, _, path = turned
    assert main(["simulate-measurement", str(folder / "study.toml"), "--coil-sd", str(COIL_SD),
                 "--seed", "3", "--placed", str(path), "-o", str(folder / "of_turned")]) == 0
    data, table = read_map(folder / "of_turned" / "map.csv"), read_blocks(path)
    readings, points = data["B_T"].values, points_of(data)
    tolerance = 3e-6 * np.abs(readings).max()  # as above
    assert np.abs(field_of(table, points) - readings).max() < tolerance
    # control: a table that does not say the turns is not of these blocks
    with pytest.raises(MeasurementError, match="turned as the table says"):
        simulate_campaign(study(), 3, COIL_SD, placed=replace(table, turn_deg=None))


@pytest.mark.parametrize(("change", "said"), [
    (lambda t: replace(t, moment=t.moment[::-1]), "moment of block .* turned as the table says"),
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
