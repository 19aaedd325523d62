"""Solids of blocks and holders, read back by Gmsh, and the plan: which block goes where."""

from __future__ import annotations

import csv
from dataclasses import replace

import gmsh
import numpy as np
import pytest
import tomlkit

import halbach_fe as hf
from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError, StudyError
from halbach_fe.design.assembly import cad
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import read_blocks, write_blocks
from halbach_fe.report.assembly_page import drawing, height_mm, labels_in_words, sheets, spacers
from halbach_fe.report.page import rendered
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.simulate import simulate_delivery

SIDE, GAP, CLEARANCE, FLOOR = 0.012, 0.010, 2e-4, 0.003
INNER, OUTER, SLOTS = 0.03, 0.075, 8

DOCUMENT = {
    "name": "held", "dimension": 3,
    "array": {
        "blocks_per_ring": SLOTS, "rings": 2, "inner_radius_m": 0.04, "outer_radius_m": 0.04 + SIDE,
        "ring_length_m": SIDE, "ring_gap_m": GAP, "remanence_T": 1.3, "recoil_permeability": 1.0,
        "block": {"shape": "cuboid", "width_m": SIDE, "orientation": "magnetization"}},
    "mesh": {"block_size_m": 0.006},
    "observation": {"quantity": "flux_density",
                    "positions": {"kind": "points", "points_m": [[0, 0, 0]]}},
    "prior": {"magnitude_sd": 0.01, "types": {"cube": list(range(1, SLOTS + 1))}},
    # without marks the volume of a plate has a closed form
    "holder": {"clearance_m": CLEARANCE, "floor_m": FLOOR, "inner_radius_m": INNER,
               "outer_radius_m": OUTER, "mark_m": 0.0, "engraving_m": 0.0}}


def study(**holder):
    return parse_study(DOCUMENT | {"holder": DOCUMENT["holder"] | holder})


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of `halbach-fe cad`, and the measured blocks, half of them exchanged."""
    folder = tmp_path_factory.mktemp("cad")
    (folder / "study.toml").write_text(tomlkit.dumps(DOCUMENT))
    table = simulate_delivery(study(), 2)
    write_blocks(replace(table, serial=table.serial[::-1]), folder / "blocks.csv")
    assert main(["cad", str(folder / "study.toml"), "--blocks", str(folder / "blocks.csv"),
                 "-o", str(folder / "cad")]) == 0
    return folder / "cad", read_blocks(folder / "blocks.csv")


def solids(path):
    """Volumes (n,) in mm^3 and centres of mass (n, 3) in mm of the solids of a STEP file."""
    gmsh.initialize()
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.importShapes(str(path))
        gmsh.model.occ.synchronize()
        tags = [tag for _, tag in gmsh.model.getEntities(3)]
        return (np.array([gmsh.model.occ.getMass(3, tag) for tag in tags]),
                np.array([gmsh.model.occ.getCenterOfMass(3, tag) for tag in tags]))
    finally:
        gmsh.finalize()


def stl_volume(path):
    """Volume in mm^3 of a closed surface, by the divergence theorem."""
    data = path.read_bytes()
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    a, b, c = np.frombuffer(data, kind, offset=84)["corners"].astype(float).swapaxes(0, 1)
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6


def sorted_rows(places):
    return places[np.lexsort(places.round(3).T)]


def test_blocks_have_their_volume_and_place(made):
    folder, _ = made
    volume, centre = solids(folder / "blocks.step")
    blocks = build_magnet(study()).blocks
    assert volume == pytest.approx(np.full(2 * SLOTS, (1e3 * SIDE)**3), rel=1e-9)
    places = 1e3 * np.array([block.middle for block in blocks])
    assert sorted_rows(centre) == pytest.approx(sorted_rows(places), abs=1e-6)
    assert stl_volume(folder / "blocks.stl") == pytest.approx(volume.sum(), rel=1e-5)  # 4 bytes


def plate_volume(clearance):
    """Volume in mm^3 of a ring with pockets that leave a floor."""
    ring = np.pi * (OUTER**2 - INNER**2) * (FLOOR + SIDE)
    return 1e9 * (ring - SLOTS * (SIDE + 2 * clearance)**2 * SIDE)


def test_plates_have_pockets_with_their_clearance(made):
    folder, _ = made
    volume, centre = solids(folder / "holder_01.step")
    assert volume == pytest.approx([plate_volume(CLEARANCE)], rel=1e-6)
    assert centre[0, :2] == pytest.approx([0, 0], abs=1e-6)
    # control: pockets 0.01 mm narrower on each side
    assert plate_volume(CLEARANCE - 1e-5) != pytest.approx(volume[0], rel=1e-5)
    assert stl_volume(folder / "holder_01.stl") == pytest.approx(volume[0], rel=2e-3)  # chords
    assert not (folder / "holder_02.step").exists()  # both rings have equal plates


def test_the_whole_magnet(made):
    folder, _ = made
    volume, _ = solids(folder / "magnet.step")
    assert sorted(volume) == pytest.approx(
        [(1e3 * SIDE)**3] * 2 * SLOTS + [plate_volume(CLEARANCE)] * 2, rel=1e-6)


def test_the_plan_says_which_block_goes_where(made):
    folder, table = made
    with (folder / "assembly.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    serial = dict(zip(table.places, table.serial, strict=True))
    assert len(rows) == 2 * SLOTS
    for row in rows:
        ring, slot = int(row["ring"]), int(row["slot"])
        assert row["serial"] == serial[ring, slot]
        angle = 360.0 / SLOTS * (slot - 1)  # a dipole turns twice as fast as the place
        assert np.exp(1j * np.radians(float(row["magnetization_angle_deg"]))) == pytest.approx(
            np.exp(2j * np.radians(angle)), abs=1e-6)
        north = {0: "outwards", 2: "counter-clockwise", 4: "inwards", 6: " clockwise"}
        assert north.get((slot - 1) % 8, "") in row["way_round"]
    assert rows[0]["serial"] != "B0001"  # the table says another one
    page = (folder / "assembly.html").read_text().replace("\u00a0", " ")
    # the diameters of the ring whose volume the plates have
    assert all(one in page for one in ("holder_01.step", "ring 1", (
        f"outer diameter of {2e3 * OUTER:.5g} mm and a bore of {2e3 * INNER:.5g} mm")))


def test_blocks_of_one_part_are_ordered_together():
    """Cubes of one grade magnetized along x, -x, y or z, and bars of which one lies along x and is
    magnetized so; another one, along z and magnetized along x, is another part. It was six kinds.
    A cylinder may be turned about its axis by any angle.
    """
    columns = {"shape": ["cuboid"] * 7 + ["cylinder"] * 2, "x_m": 0.05 * np.arange(9),
               "y_m": np.zeros(9), "z_m": np.zeros(9), "radius_m": [None] * 7 + [0.005] * 2,
               "remanence_x_T": [1.3, -1.3, 0, 0, 1.3, 0, 1.3, 1.3, 0.78],
               "remanence_y_T": [0, 0, 1.3, 0, 0, 0, 0, 0, 1.04],
               "remanence_z_T": [0, 0, 0, 1.3, 0, 1.3, 0, 0, 0]}
    for axis, sides in zip("xyz", ([0.01] * 4 + [0.02, 0.01, 0.01], [0.01] * 7,
                                   [0.01] * 4 + [0.01, 0.02, 0.02]), strict=True):
        columns[f"size_{axis}_m"] = [*sides, *([0.01] * 2 if axis == "z" else [None] * 2)]
    plan = cad(hf.magnet_of_blocks(columns), None)
    assert [plan.ordered_as[one.kind.number - 1] for one in plan.blocks] == [
        1, 1, 1, 1, 5, 5, 7, 8, 8]


def test_blocks_that_are_the_same_upside_down_are_ordered_together():
    """Bars of square ends magnetized at the same angle from any of their long sides."""
    array = DOCUMENT["array"] | {"block": {"shape": "cuboid", "width_m": SIDE}}
    plan = cad(build_magnet(parse_study(DOCUMENT | {"array": array})), None)
    angle = {kind.number: round(np.degrees(np.arctan2(*kind.direction[1::-1]))) % 90
             for kind in plan.kinds}
    assert len(set(plan.ordered_as)) == len(set(angle.values())) < len(plan.kinds)
    for kind, first in zip(plan.kinds, plan.ordered_as, strict=True):
        assert angle[kind.number] == angle[first]
    # control: ends that are no squares
    longer = replace(plan, kinds=tuple(replace(kind, sizes=kind.sizes | {"size_x_m": 2 * SIDE})
                                       for kind in plan.kinds))
    assert len(set(longer.ordered_as)) > len(set(plan.ordered_as))


def test_a_prism_that_is_turned_by_a_side_is_the_same_part():
    """Hexagons magnetized at 0, 60 and -120 degrees from their own x; one at 30 is another part,
    and one that leans out of the plane is that upside down. It was five kinds. Of a blade with
    three corners out of line only a third of a turn, and not its mirror image, is the same.
    """
    def plan_of(degrees, rise=0.0, **columns):
        angle, count = np.radians(degrees), len(degrees)
        zero = np.zeros(count)
        rise = np.radians(np.broadcast_to(rise, count))
        return cad(hf.magnet_of_blocks({
            "x_m": 0.05 * np.arange(count), "y_m": zero, "z_m": zero, "size_z_m": zero + 0.01,
            "remanence_x_T": 1.3 * np.cos(angle) * np.cos(rise),
            "remanence_y_T": 1.3 * np.sin(angle) * np.cos(rise),
            "remanence_z_T": 1.3 * np.sin(rise),
            **{name: [value] * count for name, value in columns.items()}}), None)

    def parts(plan):
        return [plan.ordered_as[one.kind.number - 1] for one in plan.blocks]

    degrees, rise = [0, 60, -120, 30, 90, 60, 0], [0, 0, 0, 0, 0, 40, -40]
    hexagon = [[0.01 * np.cos(np.pi / 3 * n), 0.01 * np.sin(np.pi / 3 * n)] for n in range(6)]
    for columns in ({"shape": "polygon", "sides": 6, "radius_m": 0.01},
                    {"shape": "prism", "outline_m": hexagon}):
        assert parts(plan_of(degrees, rise, **columns)) == [1, 1, 1, 4, 4, 6, 6]
    turns = np.radians([0, 120, 240])
    blade = [[size * np.cos(turn + off), size * np.sin(turn + off)] for turn in turns
             for size, off in ((0.01, 0.0), (0.006, 0.4))]
    assert parts(plan_of([10, 130, -110, -10, 60], shape="prism", outline_m=blade)) == [
        1, 1, 1, 4, 5]


EXPLAINED = {"engraved number of this holder": "engraving_m", "notch in a pocket": "mark_m"}
"""Words of the key of a drawing, and the depth of the mark that they explain."""


@pytest.mark.parametrize("there", [*EXPLAINED.values(), ""])
def test_a_drawing_explains_the_marks_that_it_has(there):
    """And only these; bars of the number are drawn apart from the other openings."""
    plan = cad(build_magnet(study(**({there: 5e-4} if there else {}))), None)
    found = [drawing(sheet, "") for sheet in sheets(plan)]
    page = rendered("assembly.html.j2", study=plan.magnet.study, answer=None, pictures=[],
                    provenance={},
                    sheets=found, holder=plan.holder, labels="", measured=False, kinds=[],
                    plates=[], diameters="", spacers="", files=[])
    for words, key in EXPLAINED.items():
        assert (words in page) == (key == there)
    assert all(bool(one.engraved) == (there == "engraving_m") for one in found)
    (plate,) = plan.plates
    outlines = found[0].plate.count("M")
    assert outlines == 1 + len(plate.openings) - len(plate.bars)


def test_spacers_fill_what_is_between_plates():
    """Two plates of one ring each, whose distance the study gives."""
    plan = cad(build_magnet(study()), None)
    (low, high) = sorted((height, plate.thickness_m) for plate in plan.plates
                         for height in plate.heights_m)[:2]
    gap = 1e3 * (high[0] - low[0] - low[1])
    assert f"plates are {gap:.4g}\u00a0mm long" in spacers(plan)
    (plate,) = plan.plates
    alone = replace(plan, plates=(replace(plate, heights_m=plate.heights_m[:1]),))
    assert spacers(alone) == ""
    touching = replace(plate, heights_m=(0.0, plate.thickness_m))
    assert "where plates do not touch" in spacers(replace(plan, plates=(touching,)))


def test_the_sheet_names_the_kind_that_was_ordered():
    """A kind that is another one upside down is not in the order."""
    array = DOCUMENT["array"] | {"block": {"shape": "cuboid", "width_m": SIDE}}
    plan = cad(build_magnet(parse_study(DOCUMENT | {"array": array})), None)
    (sheet, *_) = sheets(plan)
    turned = {kind.number: first for kind, first in zip(plan.kinds, plan.ordered_as, strict=True)}
    rows = [row for rows in drawing(sheet, "", turned).tables for row in rows]
    assert {row["kind"] for row in rows} == {
        str(one.kind.number) if turned[one.kind.number] == one.kind.number
        else f"{turned[one.kind.number]}, turned" for one in sheet.blocks}
    assert any("turned" in row["kind"] for row in rows)
    assert not any("turned" in row["kind"]  # the control
                   for rows in drawing(sheet, "").tables for row in rows)


def test_labels_are_said_to_be_what_they_are():
    """Of free blocks they are names, and no slots. Control: blocks of rings have slots."""
    free = cad(hf.magnet_of_blocks({
        "name": ["left", "right"], "shape": ["cuboid"] * 2, "x_m": [0.03, -0.03], "y_m": [0.0] * 2,
        "z_m": [0.0] * 2, "size_x_m": [0.01] * 2, "size_y_m": [0.01] * 2, "size_z_m": [0.01] * 2,
        "remanence_T": [1.3] * 2}))
    assert labels_in_words(sheets(free), "") == "The label of a block is its name."
    ring = cad(hf.halbach_ring(inner_radius_m=0.03, outer_radius_m=0.05, length_m=0.03))
    assert labels_in_words(sheets(ring), "") == "The label of a block is its slot."


def test_heights_that_are_zero_but_for_rounding_are_zero():
    assert [height_mm(z) for z in (1.7e-18, -1.7e-18, -0.034)] == ["0", "0", "-34"]


@pytest.mark.parametrize(("holder", "said"), [
    ({"clearance_m": 9e-3}, "wall of 0 mm between block"),
    ({"least_wall_m": 9e-3}, "thinner than least_wall_m = 9 mm.*Reduce least_wall_m"),
    ({"thickness_m": 0.03}, "plates that overlap by .*Reduce floor_m or thickness_m"),
    ({"outer_radius_m": 0.05}, "edge of the plate"),
    ({"outer_radius_m": None, "outer_rim_m": 8.0}, "`outer_rim_m` of 8000 mm .* Then write 0.008"),
    ({"outer_radius_m": 9.9}, "meant in millimetres"),
    ({"engraving_m": 8e-3}, "more than half through.*Reduce engraving_m"),
    ({"inner_rim_m": 0.004}, "either inner_radius_m .* or inner_rim_m"),
    ({"outer_rim_m": 0.004}, "either outer_radius_m .* or outer_rim_m"),
])
def test_holders_that_cannot_be_made(holder, said):
    with pytest.raises(StudyError, match=said):
        cad(build_magnet(study(**holder)))


BOX = {"kind": "box", "size_m": [0.02, 0.02, 0.01]}
PLATE = {"kind": "prism", "outline_m": [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]],
         "length_m": 0.01, "z_m": 0.1}


def with_iron(body):
    return build_magnet(parse_study(DOCUMENT | {"iron": {
        "relative_permeability": 1000.0, "bodies": [body]}}))


@pytest.mark.parametrize(("body", "said"), [
    ({"kind": "sphere", "radius_m": 0.01, "centre_m": [0, 0, 0.1]}, "a sphere"),
    (PLATE | {"holes": [{"radius_m": 0.01}]}, "a prism with holes"),
    ({"kind": "revolved", "profile_m": [[0, 0.1], [0.02, 0.1], [0, 0.12]]},
     "a body of the kind 'revolved'"),
    ({"kind": "stl", "triangles_m": [[[0, 0, 0.1], [0, 0.1, 0.1], [0.1, 0, 0.1]],
                                     [[0, 0, 0.1], [0.1, 0, 0.1], [0, 0, 0.2]],
                                     [[0, 0, 0.1], [0, 0, 0.2], [0, 0.1, 0.1]],
                                     [[0.1, 0, 0.1], [0, 0.1, 0.1], [0, 0, 0.2]]]},
     "a body of the kind 'stl'"),
    (BOX | {"centre_m": [0, 0, 0.1]}, "a body with centre_m, step_m or rotation_deg"),
    (PLATE | {"rotation_deg": [0, 0, 9]}, "a body with centre_m, step_m or rotation_deg"),
    (PLATE | {"repeats": 2, "step_m": [0, 0, 0.1]}, "a body with centre_m, step_m or rot")])
def test_iron_that_has_no_solid_is_named(body, said):
    with pytest.raises(StudyError, match=f"`iron.bodies` of study held must be .*received {said}"):
        cad(with_iron(body))


@pytest.mark.parametrize("body", [
    BOX, PLATE, {"kind": "tube", "inner_radius_m": 0.09, "outer_radius_m": 0.1}])
def test_iron_that_has_a_solid(body):
    assert len(cad(with_iron(body)).magnet.iron) == 1


def test_blocks_without_places():
    table = simulate_delivery(study(), 2)
    loose = replace(table, ring=0 * table.ring, slot=0 * table.slot)
    with pytest.raises(MeasurementError, match=r"give its blocks\.sorted\.csv"):
        cad(build_magnet(study()), loose)
