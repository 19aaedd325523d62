"""Errors of assembly: whole blocks, rings and layers in wrong orientations, slots and places."""

from __future__ import annotations

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import halbach_fe as hf
from halbach_fe.core.errors import StudyError
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effect_comparison import identify_effects, score_hypotheses
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis, Place
from halbach_fe.diagnosis.linearization import Linearization, NominalSolver, apply_effects
from halbach_fe.diagnosis.result import IdentifiedEffect
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.remounting import mountings, turns_in_slot
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.hidden_effects import EFFECTS as HIDDEN
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.conftest import circle
from tests.diagnosis.campaign import drawn, field
from tests.support.cuboids import DOCUMENT, NOISE_T

EFFECTS = {effect.name: effect for effect in catalogue()}
RIVALS = [EFFECTS[name] for name in (
    "background", "block_demagnetized", "block_displaced", "block_flipped", "block_missing",
    "block_put_in_wrongly", "block_turned", "blocks_swapped", "ferromagnetic_object", "gain_x",
    "halves_apart", "mapper_tilt_x", "mapper_translation", "radial_gap", "ring_demagnetized",
    "ring_shifted", "ring_shifted_along", "ring_tilted", "ring_twisted", "rings_oval",
    "rings_swapped", "rings_turned", "rings_upside_down")]
POINTS = np.vstack([circle(0.065, 12, z, 0.1) for z in np.linspace(-0.15, 0.15, 11)])

QUADRUPOLE = {"multipole_order": 2, "rings": 4, "ring_length_m": 0.045}
STEPPED = {"rings": 3, "remanence_T": 1.2, "ring": [
    {"remanence_T": remanence} for remanence in (1.2, 1.12, 1.2)]}

SKEW = QUADRUPOLE | {"first_magnetization_angle_deg": 225.0}
"""Its easy axes are 45 deg from the radius in the middle of a pole: turned over, it is another."""

SIDE_M, RINGS, CUBES = 0.025, 4, 12


def cubes():
    """Centres (n, 3) in m and angles (n,) in rad of the easy axes of rings of cubes."""
    angle = np.tile(2 * np.pi * np.arange(CUBES) / CUBES, RINGS)
    z = np.repeat(0.04 * (np.arange(RINGS) - (RINGS - 1) / 2), CUBES)
    return np.column_stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), z]), 2 * angle


def mri():
    """A study of rings of free cubes, along their easy axes."""
    centres, angles = cubes()
    x, y, z = centres.T.tolist()
    count = len(angles)
    size = [SIDE_M] * count
    return parse_study(DOCUMENT | {"name": "mri", "array": {"free_blocks": {
        "name": [f"c{k}" for k in range(count)], "shape": ["cuboid"] * count, "x_m": x, "y_m": y,
        "z_m": z, "rotation_z_deg": np.degrees(angles).tolist(), "size_x_m": size,
        "size_y_m": size, "size_z_m": size, "remanence_T": [1.3] * count}}})


def field_of_cubes(polarizations, points, moved=0.0):
    """B (n, 3) in T by magpylib; ``moved`` (cubes, 3) in m."""
    centres, angles = cubes()
    total = np.zeros(points.shape)
    for centre, angle, polarization in zip(
            centres + moved, angles, polarizations, strict=True):
        turn = Rotation.from_euler("z", angle)
        total += magpylib.magnet.Cuboid(
            position=centre, dimension=[SIDE_M] * 3, orientation=turn,
            polarization=turn.inv().apply(polarization)).getB(points)
    return total


def selected(study, true, session, generator):
    """Effects that are selected in the first round of a diagnosis."""
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    result = infer(build_magnet(study), shown, session)
    return identify_effects(study, scored(study, result, shown, session))


def scored(study, result, readings, session):
    """The rivals, compared without any effect in the model."""
    return score_hypotheses(
        Linearization(study, (), result, result.prior.mean, Campaign.of(study, readings),
                      NominalSolver(session)), RIVALS)


def names_of(found):
    """Effects with their places."""
    return [(one.hypothesis.effect.name, one.place.name) for one in found]


def test_signatures_beside_a_reversed_block(session):
    """They are those of the magnet with this block: of 48, one that acts the other way."""
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | QUADRUPOLE})
    reversed_block = IdentifiedEffect(
        Hypothesis(EFFECTS["block_flipped"], Place(2, 5)), np.ones(1), np.zeros(1), None)
    found = apply_effects(study, [reversed_block])
    gap, distance = Hypothesis(EFFECTS["radial_gap"], Place()), 1e-5

    def by_magpylib(one):
        return hf.to_magpylib(build_magnet(one)).getB(POINTS)

    true = by_magpylib(found)
    readings = field_map(POINTS, true)
    true = (by_magpylib(gap.apply(found, [distance])) - true)[None] / distance
    result = infer(build_magnet(found), readings, session)
    beside, alone = (Linearization(
        study, (), result, build_magnet(study).nominal_magnetization, Campaign.of(study, readings),
        NominalSolver(session), effects) for effects in ([reversed_block], ()))
    right = beside.training.shown(true)
    # the difference over 1e-5 m is 3e-4 off, a step over the distance to the blocks
    np.testing.assert_allclose(beside.exact(gap), right, atol=1e-3 * np.abs(right).max())
    # control: those of the magnet without it
    assert np.abs(alone.exact(gap) - right).max() > 0.05 * np.abs(right).max()


def test_a_cube_a_quarter_turn_wrong(session, generator):
    """In full: the diagnosis, and the study that it proposes."""
    study = mri()
    polarizations = drawn(study, generator)
    polarizations[16] = Rotation.from_euler("z", 90, degrees=True).apply(polarizations[16])
    true = field_of_cubes(polarizations, POINTS)
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    found = diagnose(study, shown, session, effects=RIVALS)
    assert names_of(found.identified) == [("block_put_in_wrongly", "c16, a quarter turn about z")]
    assert found.converged
    assert found.unknown is None
    assert found.after.prior_conflict < found.after.conflict_limit


def test_nothing_is_wrong(session, generator):
    """The negative control of all cases here."""
    study = mri()
    assert not selected(study, field_of_cubes(drawn(study, generator), POINTS), session, generator)


def test_a_layer_along_the_axis(session, generator):
    study = mri()
    moved = np.outer(np.arange(RINGS * CUBES) // CUBES == 1, [0, 0, 5e-4])
    true = field_of_cubes(drawn(study, generator), POINTS, moved)
    found = selected(study, true, session, generator)
    assert names_of(found) == [("ring_shifted_along", "r02")]
    (layer,) = found
    assert abs(layer.values[0] - 5e-4) < 3.5 * layer.sd[0] < 5e-4


@pytest.mark.parametrize("name", ["ring_tilted", "halves_apart", "ring_demagnetized"])
def test_what_rings_and_halves_do_as_a_whole(name, session, generator):
    """Not as a sum of other effects: a tilted ring was a tilted mapper and a displaced ring, and an
    open magnet a displaced mapper and blocks that are all farther out.
    """
    study = mri()
    polarizations, (centres, _) = drawn(study, generator), cubes()
    normal = np.array([np.cos(np.pi / 12), np.sin(np.pi / 12), 0.0])  # between two cubes
    ring = np.arange(RINGS * CUBES) // CUBES == 1
    part = (centres @ normal > 0 if name == "halves_apart" else ring)[:, None]
    middle, turn = centres[ring].mean(axis=0), Rotation.identity()
    shift, loss = np.zeros(3), 0.0
    if name == "ring_tilted":
        turn, size = Rotation.from_rotvec([6e-3, 0.0, 0.0]), 6e-3
    elif name == "halves_apart":
        shift, size = 4e-4 * normal, 4e-4
    else:
        loss = size = 0.05
    true = field_of_cubes(polarizations * ~part, POINTS + shift / 2) + (1 - loss) * turn.apply(
        field_of_cubes(polarizations * part,
                       turn.inv().apply(POINTS - shift / 2 - middle) + middle))
    (found,) = selected(study, true, session, generator)
    place = "at the plane whose normal is at 15°" if name == "halves_apart" else "r02"
    assert names_of([found]) == [(name, place)]
    assert abs(found.values[0] - size) < 3.5 * found.sd[0] < 0.8 * size


def test_oval_rings(session, generator):
    study, (centres, angles) = mri(), cubes()
    outwards = centres * [10, 10, 0]  # the radius is 0.1 m, the easy axes turn twice as fast
    true = field_of_cubes(drawn(study, generator), POINTS, 4e-4 * np.cos(angles)[:, None]
                          * outwards)
    (found,) = selected(study, true, session, generator)
    assert found.hypothesis.effect.name == "rings_oval"
    assert abs(found.values[0] - 4e-4) < 3.5 * found.sd[0] < 2e-4
    assert abs(found.values[1]) < 3.5 * found.sd[1] or not found.values[1]


def test_a_dipole_inside_a_body_is_no_object():
    study, effect = mri(), EFFECTS["ferromagnetic_object"]
    places = np.array([place.at_m for place in effect.places(study)])
    assert not build_magnet(study).contains(places).any()
    x, y, z = cubes()[0][16].tolist()
    with pytest.raises(StudyError, match="outside of blocks and iron"):
        effect.apply(study, Place(at_m=(x, y, z)), [0.0, 1.0, 0.0])
    beside = Place(at_m=(x, y, z + 0.55 * SIDE_M))  # the control: 1 mm above the cube
    assert effect.apply(study, beside, [0.0, 1.0, 0.0]).external.dipoles
    outside = Place(at_m=(x, y, z + 0.6 * SIDE_M))  # and from there its place may not go inside
    with pytest.raises(StudyError, match="outside of blocks and iron"):
        effect.apply(study, outside, [0.0, 1.0, 0.0, 0.0, 0.0, -0.2 * SIDE_M])


@pytest.mark.parametrize(("size", "count"), [
    ((0.02, 0.02, 0.02), 5), ((0.02, 0.02, 0.03), 3), ((0.02, 0.025, 0.03), 1),
    ((0.02, 0.0201, 0.0199), 5), ((0.02, 0.021, 0.03), 1)])
def test_orientations_in_which_a_body_fits(size, count):
    """Of a cuboid along its easy axis these are as many as the directions of its equal edges, and
    the opposite one; edges that differ by half a per cent are equal, by 5 % they are not.
    """
    table = {key: [value] for key, value in zip(
        ("size_x_m", "size_y_m", "size_z_m"), size, strict=True)} | {
            "name": ["a"], "shape": ["cuboid"], "x_m": [0.1], "y_m": [0.0], "z_m": [0.0],
            "remanence_T": [1.0], "rotation_z_deg": [30.0]}
    study = parse_study(DOCUMENT | {"array": {"free_blocks": table}})
    (block,) = build_magnet(study).blocks
    turns = np.array(turns_in_slot(block))
    assert len(turns) == count
    directions = turns @ np.array(block.easy_axis)
    assert len(np.unique(directions.round(6), axis=0)) == count
    assert np.linalg.norm(directions - np.array(block.easy_axis), axis=1).min() > 1


@pytest.mark.parametrize("shape", [
    {"shape": ["cuboid"], "size_x_m": [0.02], "size_y_m": [0.025], "remanence_T": [1.0]},
    {"shape": ["cylinder"], "radius_m": [0.01], "remanence_x_T": [1.0], "remanence_y_T": [0.3],
     "remanence_z_T": [0.0]}])
def test_half_a_turn_is_another_than_a_reversed_block_if_a_deviation_is_known(shape):
    """Named as reversed and turned, somebody would look for a block that is loose."""
    table = {"name": ["a"], "x_m": [0.1], "y_m": [0.0], "z_m": [0.0], "size_z_m": [0.03],
             "rotation_z_deg": [30.0]} | shape
    study = parse_study(DOCUMENT | {"array": {"free_blocks": table}})
    magnet, effect = build_magnet(study), EFFECTS["block_put_in_wrongly"]
    easy = np.array(magnet.blocks[0].easy_axis)
    known = magnet.nominal_magnetization + 0.02 * np.linalg.norm(
        magnet.nominal_magnetization) * (np.cross(easy, [0.0, 0, 1]) + np.array([0.0, 0, 1]))
    for mean, count in ((known, 2), (magnet.nominal_magnetization, 0)):
        over = [turn for place in effect.shortlist(study, mean, np.eye(3), np.zeros(3))
                for _, _, turn in effect.sources(magnet, place) if easy @ turn @ easy < -0.999]
        assert len(over) == count
        # places have angles to 1e-6 degrees, which are 0.014 of 8e5 A/m
        assert [(turn @ known + known) @ easy for turn in over] == pytest.approx([0] * count, abs=1)


def turned(polarizations, ring, angle_deg, slots, axis="z"):
    """Polarizations after a ring of 12 is turned, each block to another slot."""
    found = polarizations.copy()
    turn = Rotation.from_euler(axis, angle_deg, degrees=True)
    for slot, source in enumerate(slots):
        found[12 * ring + slot] = turn.apply(polarizations[12 * ring + source])
    return found


def test_equal_moves_are_one():
    """A ring of a regular order that is upside down is one that is turned, unless the directions
    of its blocks are those of no slot (the control); if two equal rings are exchanged, nothing
    changes. Of 4 rings and 2 halves, each has 5 other directions of a quadrupole of 12 slots.
    """
    for array, counts in ((QUADRUPOLE, (0, 30, 0)), (SKEW, (0, 30, 36))):
        study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | array})
        mean = build_magnet(study).nominal_magnetization
        found = [len(EFFECTS[name].shortlist(study, mean, np.eye(len(mean)), 0 * mean))
                 for name in ("rings_swapped", "rings_turned", "rings_upside_down")]
        assert tuple(found) == counts


def half_a_turn(polarizations, study):
    """One block of ring 2 is turned about its radius."""
    found, block = polarizations.copy(), build_magnet(study).blocks[13]
    radius = Rotation.from_euler("z", block.angle_deg, degrees=True).apply([1.0, 0, 0])
    found[13] = Rotation.from_rotvec(np.pi * radius).apply(polarizations[13])
    return found


def exchanged(polarizations, study):
    """Rings 2 and 3 are exchanged."""
    return polarizations.reshape(-1, 12, 3)[[0, 2, 1]].reshape(-1, 3)


def by_a_slot(polarizations, study):
    """Ring 1 is turned by a slot."""
    return turned(polarizations, 0, 30.0, np.roll(np.arange(12), 1))


def upside_down(polarizations, study):
    """Ring 3 is turned over about the y axis, where slot 1 is; a quadrupole is then reversed."""
    return turned(polarizations, 2, 180.0, -np.arange(12) % 12, "y")


CASES = [
    (QUADRUPOLE, half_a_turn, "block_put_in_wrongly", "r02s02, half a turn about its radius"),
    (STEPPED, exchanged, "rings_swapped", "ring 2 and ring 3"),
    (QUADRUPOLE, by_a_slot, "rings_turned", "ring 1 by +1 slot"),
    (SKEW, upside_down, "rings_upside_down", "ring 3 about 90° from x")]


@pytest.mark.parametrize(("array", "change", "name", "place"), CASES)
def test_assembly_of_rings(array, change, name, place, session, generator):
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | array})
    polarizations = change(drawn(study, generator), study)
    found = selected(study, field(study, polarizations, POINTS), session, generator)
    assert names_of(found) == [(name, place)]
    # the study that is written has the blocks in these places, with what they are known to have
    before = build_magnet(study).nominal_magnetization.reshape(-1, 3)
    after = build_magnet(apply_effects(study, found))
    expected = change(before, study)
    assert after.nominal_magnetization.reshape(-1, 3) == pytest.approx(expected, abs=1.0)
    mounted = [matrix @ before[number] for number, matrix in mountings(after)]
    assert np.array(mounted) == pytest.approx(expected, abs=1.0)


def test_a_ring_that_was_filled_from_another_slot_on(session):
    """Bars along the magnetization turn with their slots, so that only their own errors move.

    The control has no such error; in rings whose slots turn as their places (all cases above) a
    ring so filled is a turned one.
    """
    array = {"rings": 2, "block": {
        "shape": "cuboid", "width_m": 0.03, "orientation": "magnetization"}}
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | array})
    expected = {(): [], ((HIDDEN["rings_turned"], (1.0, 1.0)),): [
        ("rings_turned", "the blocks of ring 1 by +1 slot each")]}
    for hidden, names in expected.items():
        campaign = simulate_campaign(study, 45, hide=hidden)
        blocks = campaign.blocks
        result = infer(build_magnet(study), campaign.readings, session, blocks)
        found = identify_effects(study, scored(study, result, campaign.readings, session))
        assert names_of(found) == names
    after = build_magnet(apply_effects(study, found))
    assert [block.mounted_from for block in after.blocks[:2]] == [(1, 12), (1, 1)]
    assert after.nominal_magnetization == pytest.approx(
        build_magnet(study).nominal_magnetization, abs=1.0)


def test_exchanged_blocks_bring_their_remanence_along():
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | STEPPED})
    effect = EFFECTS["blocks_swapped"]
    before = build_magnet(study)
    after = build_magnet(effect.apply(study, Place(1, 2, other=(2, 5)), [1.0]))
    assert [after.blocks[number].remanence for number in (1, 16)] == [1.12, 1.2]
    assert [before.blocks[number].remanence for number in (1, 16)] == [1.2, 1.12]
