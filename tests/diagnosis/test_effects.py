"""The catalogue: signatures are the derivatives of what the effects do to a study."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from halbach_fe.core.errors import StudyError
from halbach_fe.diagnosis.effects import catalogue, magnetization
from halbach_fe.diagnosis.effects.base import Hypothesis, Place
from halbach_fe.diagnosis.linearization import amplitude_scale, apply_effects
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.diagnosis.result import IdentifiedEffect
from halbach_fe.geometry.array_layout import blocks_table
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.remounting import mountings, properties
from halbach_fe.measurement.probe_law import nonlinear_part, probe_points, sensor_model, with_memory
from halbach_fe.solver.exact_block_field import external_field, field_of
from halbach_fe.study.reader import parse_study
from studies.diagnosis.drawn_studies import drawn_study
from tests.conftest import DIPOLE, changed, circle

STUDY = parse_study(changed(
    DIPOLE, dimension=3, array__rings=4, array__ring_length_m=0.083,
    array__recoil_permeability=1.0, external={"coils": [
        {"kind": "round", "radius_m": 0.25, "current_A": 1e3, "centre_m": [0.0, 0.05, 0.1]}]}))
IN_IRON = STUDY.with_(external={}, iron={"relative_permeability": 30.0, "bodies": [
    {"kind": "tube", "inner_radius_m": 0.2, "outer_radius_m": 0.21},
    {"kind": "box", "size_m": [0.1] * 3, "centre_m": [0.0, 0.0, 0.4],
     "curve": {"kind": "steel", "name": "aisi_1010"}},
    {"kind": "sphere", "radius_m": 0.05, "centre_m": [0.4, 0.0, 0.0],
     "relative_permeability": 1.2}]})
SPACED = STUDY.with_(
    external={}, array__rings=3, array__blocks_per_ring=8, array__ring_gap_m=0.01,
    array__first_magnetization_angle_deg=30.0,
    array__block={"shape": "trapezoid", "side_gap_m": 0.005})
"""Rings and blocks that are turned by some degrees without overlaps."""

POINTS = np.vstack([circle(0.06, 8, z, 0.1) for z in np.linspace(-0.25, 0.25, 7)])
TIME = np.linspace(0, 1, len(POINTS))
EFFECTS = {effect.name: effect for effect in catalogue()}
SOLVED = {name for name, effect in EFFECTS.items() if effect.is_solved}
EQUAL = {"rings_swapped"}
"""Changes nothing in a magnet of equal rings; see test_assembly.py."""

STEP = 0.05
"""Of the amplitudes' standard deviations: as far as most effects are linear."""

LARGE = {"wrong_line", "wrong_radius"}
"""Those of these are ten times the others'."""


def shown(study):
    """What a map of a study shows, without what permeability and iron add."""
    used = sensor_model(study.instrument, POINTS)
    field = field_of(build_magnet(study).blocks, used.points) + external_field(build_magnet(study),
                                                                               used.points)
    linear = (used.operator @ field.ravel()).reshape(-1, 3)
    return with_memory(study.instrument, linear + nonlinear_part(study.instrument, linear, TIME),
                       TIME)


@pytest.fixture(scope="module")
def nominal():
    return NominalFields(STUDY, POINTS, TIME,
                         lambda study: field_of(build_magnet(study).blocks, POINTS))


@pytest.mark.parametrize("name", sorted(EFFECTS.keys() - SOLVED - EQUAL))
def test_signatures_are_derivatives(name, nominal):
    effect = EFFECTS[name]
    places = effect.places(STUDY)
    for place in (places[0], places[len(places) // 3]):
        signature = effect.signature(nominal, place)
        assert signature.shape == (len(effect.parameters), len(POINTS), 3)
        for number, parameter in enumerate(effect.parameters):
            step = parameter.sd * (1 if effect.is_binary or effect.applied_in_full else STEP)
            if name in LARGE:
                step /= 10
            values = step * np.eye(len(effect.parameters))[number]
            change = shown(effect.apply(STUDY, place, values.tolist())) - shown(STUDY)
            size = np.abs(change).max()
            # what is not linear: 4e-3 at most (length), mostly 1e-4
            assert np.abs(change - step * signature[number]).max() < 1e-2 * size
            # negative controls: the wrong sign, another component
            assert np.abs(change + step * signature[number]).max() > size
            exchanged = np.abs(change - step * signature[number][:, [1, 2, 0]]).max()
            assert exchanged > 0.5 * size or effect.of_total_field  # in which all are alike


OF_ITS_OWN = {
    "weaker": [{"ring": 1, "slot": 2, "magnetization_factor": 0.8}],
    "ring": [{"ring": 1, "magnetization_factor": 0.9, "twist_deg": 0.5}],
    "reversed": [{"ring": 1, "slot": 2, "magnetization_factor": -1.0}],
    "missing": [{"ring": 1, "slot": 2, "magnetization_factor": 0.0}],
    "angle": [{"ring": 1, "slot": 2, "magnetization_angle_deg": 77.0}],
    "exchanged": [{"ring": 1, "slot": 2, "mounted_from": (1, 3)},
                  {"ring": 1, "slot": 3, "mounted_from": (1, 2), "rotation_deg": (180, 0, 0)}],
    "turned": [{"ring": 1, "slot": 2, "rotation_deg": (3.0, 2.0, 1.0)}],
    "uneven": [{"ring": 1, "slot": 2, "magnetization_gradient": 0.05},
               {"ring": 2, "inner_corner_loss": 0.1}],
    "permeable": [{"ring": 1, "slot": 2, "recoil_permeability": 1.1,
                   "recoil_permeability_across": 1.15}]}
"""Exceptions that a study, or an effect found before, has made of blocks that are then moved."""


@pytest.mark.parametrize("exceptions", OF_ITS_OWN.values(), ids=OF_ITS_OWN)
def test_blocks_are_moved_as_they_are(exceptions):
    """With all that the study says of them: what is built is what the signature changes."""
    study = SPACED.with_(array__exceptions=exceptions)
    before = build_magnet(study)
    nominal = NominalFields(study, POINTS, TIME, None)
    for name in ("block_put_in_wrongly", "blocks_swapped", "rings_swapped", "rings_turned",
                 "rings_upside_down"):
        for place in EFFECTS[name].places(study)[:4]:
            after = build_magnet(EFFECTS[name].apply(study, place, [1.0]))
            expected = before.nominal_magnetization.reshape(-1, 3)
            for number, change in EFFECTS[name].magnetization_change(nominal, place).items():
                expected[number] += change
            np.testing.assert_allclose(after.nominal_magnetization, expected.ravel(), atol=1.0)
            for to, source, _ in EFFECTS[name].sources(before, place):
                assert properties(after.blocks[to])[1:] == pytest.approx(
                    properties(before.blocks[source])[1:], rel=1e-9)


EXCEPTIONAL = SPACED.with_(array__exceptions=[
    {"magnetization_gradient": 0.02}, {"ring": 2, "twist_deg": 0.5, "tilt_deg": (0.2, 0.1)},
    {"ring": 3, "inner_corner_loss": 0.1}, {"ring": 1, "slot": 1, "magnetization_factor": -0.8},
    {"ring": 2, "slot": 1, "displacement_m": (2e-3, 1e-3, 2e-3), "rotation_deg": (180, 1, 2),
     "magnetization_gradient": 0.05},
    {"ring": 2, "slot": 2, "magnetization_angle_deg": 77.0},
    {"ring": 3, "slot": 1, "mounted_from": (1, 2), "magnetization_factor": 0.9},
    {"ring": 3, "slot": 2, "recoil_permeability_across": 1.1}])
IN_VACUUM = sorted(name for name, effect in EFFECTS.items() if effect.kind == "field" and not (
    effect.is_solved or effect.applied_in_full or name == "coil_current"))


@pytest.mark.parametrize("name", IN_VACUUM)
def test_signatures_are_derivatives_of_a_study_with_exceptions(name):
    """What effects do to blocks that are not as the array says already, at amplitude 0 nothing."""
    effect, study = EFFECTS[name], EXCEPTIONAL
    nominal = NominalFields(study, POINTS, TIME, None)
    places = effect.places(study)
    for place in [one for one in places if one.slot in (1, 2)] or places[:3]:
        signature = effect.signature(nominal, place)
        nothing = [0.0] * len(effect.parameters)
        assert shown(effect.apply(study, place, nothing)) == pytest.approx(shown(study), abs=1e-12)
        for number, parameter in enumerate(effect.parameters):
            step = 0.01 * parameter.sd
            values = (step * np.eye(len(nothing))[number]).tolist()
            change = (shown(effect.apply(study, place, values)) - shown(study)) / step
            # What is not linear: 1.1e-2 of the step of 1 mm by a length, else 1e-3 at most. What a
            # second twist or tilt adds to a place is that of the nominal place, from which these
            # blocks are 2 mm of 0.14 m, or 0.5 degrees.
            tolerance = {"length": 1.5e-2, "ring_tilted": 3e-2, "ring_twisted": 3e-2}.get(
                name, 3e-3)
            np.testing.assert_allclose(change, signature[number],
                                       atol=tolerance * np.abs(signature).max())


def test_effects_of_a_block_are_those_of_the_one_that_is_moved_there():
    """In which order ever they were found: one that was weaker before is another one's loss."""
    place = EFFECTS["blocks_swapped"].places(SPACED)[1]
    swap, loss = (IdentifiedEffect(Hypothesis(EFFECTS[name], where), np.array([value]), np.zeros(1),
                                   None)
                  for name, where, value in (("blocks_swapped", place, 1.0), (
                      "block_demagnetized", Place(place.ring, place.slot), 0.2)))
    found = [build_magnet(apply_effects(SPACED, order)).blocks
             for order in ([swap, loss], [loss, swap])]
    assert found[0] == found[1]
    whole = build_magnet(SPACED).blocks[0].remanence
    assert [block.remanence / whole for block in found[0][:3]] == pytest.approx([1, 0.8, 1])


def solved(study):
    """A stand-in for the solver: a field in which all acts that has to be solved for."""
    blocks, bodies = build_magnet(study).blocks, study.iron.bodies
    told = sum(block.recoil_permeability + 2 * block.recoil_permeability_across
               for block in blocks) / len(blocks) + 0.03 * study.iron.relative_permeability
    return told + sum(np.dot(body.centre_m, (1, 2, 3)) for body in bodies) + 0 * POINTS


FEWER = {"block_turned": 1, "ferromagnetic_object": 1, "corners_demagnetized": 8,
         "ring_tilted": 5, "wrong_radius": 5}
"""Prior standard deviations that a study can have of effects of which it cannot have ten."""


def of_model(name):
    """Return signature, derivative in the model and finite difference of an effect, per prior
    standard deviation of every amplitude, all of which are as large as a study can have them.
    """
    effect, study = EFFECTS[name], IN_IRON if name in SOLVED else STUDY
    place = effect.places(study)[len(effect.places(study)) // 3]
    sd = amplitude_scale(effect)
    values = FEWER.get(name, 10) * sd

    def seen(amounts):
        applied = effect.apply(study, place, amounts.tolist())
        return (solved if name in SOLVED else shown)(applied)

    def fields(study):
        points = probe_points(study.instrument, POINTS)
        return NominalFields(study, points, TIME, solved, stated=POINTS)

    there = effect.apply(study, place, values.tolist())
    slopes = [(seen(values + 0.01 * step) - seen(values - 0.01 * step)) / 0.02
              for step in np.diag(sd)]
    return effect.signature(fields(study), place), effect.derivative(
        fields(there), place, values.tolist()) * sd[:, None, None], np.array(slopes)


@pytest.mark.parametrize("name", sorted(
    name for name, effect in EFFECTS.items() if not effect.applied_in_full))
def test_derivatives_are_those_of_the_model_that_has_the_effect(name):
    """Or the search takes steps, and states error bars, of what it counts twice: a loss of a loss.

    What multiplies or adds has the slope that it has without it, to the step of `length`, 6e-3. Of
    other effects that slope is farther off; sensors far apart are in a field linear about their
    middle, which leaves 0.82 of that.
    """
    sd = np.array([parameter.sd for parameter in EFFECTS[name].parameters])[:, None, None]
    signature, derivative, slope = of_model(name)
    without = np.abs(slope[:len(sd)] - sd * signature).max()
    assert np.abs(slope - derivative).max() < max(6e-3 * np.abs(slope).max(), 0.85 * without)


@pytest.mark.parametrize("loss", [0.4, 1.0, 2.0])
def test_what_a_block_has_lost_is_no_part_of_the_derivative(nominal, loss):
    """Or a search for the loss of a block upside down goes astray."""
    effect = EFFECTS["block_demagnetized"]
    place = effect.places(STUDY)[5]
    there = replace(nominal, study=effect.apply(STUDY, place, [loss]))
    assert effect.derivative(there, place, [loss]) == pytest.approx(
        effect.signature(nominal, place))


@pytest.mark.parametrize("loss", [-0.3, 0.4])
def test_the_loss_of_a_reversed_block_has_the_other_sign(nominal, loss):
    """Or a search that has found both runs away from the model of the reversed block alone."""
    effect = EFFECTS["block_demagnetized"]
    place = effect.places(STUDY)[5]
    reversed_block = EFFECTS["block_flipped"].apply(STUDY, place, [1.0])
    there = replace(nominal, study=effect.apply(reversed_block, place, [loss]))
    change = (shown(effect.apply(reversed_block, place, [loss + STEP]))
              - shown(effect.apply(reversed_block, place, [loss])))
    assert STEP * effect.derivative(there, place, [loss])[0] == pytest.approx(change, abs=1e-12)
    assert effect.derivative(there, place, [loss]) == pytest.approx(
        -effect.signature(nominal, place))


@pytest.mark.parametrize("name", ["block_missing", "block_flipped", "blocks_swapped"])
def test_whole_blocks_count_as_they_were_measured(nominal, name, generator):
    effect = EFFECTS[name]
    place = effect.places(STUDY)[5]
    expected = nominal.magnetizations
    measured = expected * (1 + 0.02 * generator.standard_normal((len(expected), 1)))
    signature = effect.signature(replace(nominal, measured_magnetizations=measured), place)[0]
    mountings_of = mountings(build_magnet(effect.apply(STUDY, place, [1.0])))
    mounted = np.array([matrix @ measured[number] for number, matrix in mountings_of])
    change = sum(nominal.field_with(number, mounted[number] - measured[number])
                 for number in range(len(measured)))
    assert signature == pytest.approx(change, abs=1e-12)
    assert np.abs(signature - effect.signature(nominal, place)[0]).max() > 1e-3 * np.abs(
        change).max()  # negative control: nominal blocks


def test_changes_of_magnetizations_have_the_signature_in_vacuum(nominal):
    """The response matrix turns them into readings where blocks are permeable."""
    found = {name: effect for name, effect in EFFECTS.items()
             if any(effect.magnetization_change(nominal, place) is not None
                    for place in effect.places(STUDY)[:1])}
    assert set(found) >= {
        "block_missing", "block_flipped", "blocks_swapped", "block_demagnetized",
        "block_put_in_wrongly", "rings_swapped", "rings_turned", "rings_upside_down"}
    for effect in found.values():
        place = effect.places(STUDY)[:6][-1]
        field = sum(nominal.field_with(block, change) for block, change in
                    effect.magnetization_change(nominal, place).items())
        assert effect.signature(nominal, place)[0] == pytest.approx(field, abs=1e-12)


def test_refinements_are_derivatives(nominal):
    effect = EFFECTS["neighbour_magnet"]
    place = effect.places(STUDY)[3]
    values = np.array([1.0, 0.3, -0.02])
    refined = effect.refine(nominal, place, values.tolist())
    for number, step in enumerate((1e-3, 1e-5), start=1):
        there, here = (shown(effect.apply(STUDY, place, one.tolist()))
                       for one in (values + step * np.eye(3)[number], values))
        change = (there - here) / step
        assert np.abs(change - refined[number - 1]).max() < 1e-2 * np.abs(change).max()
        assert np.abs(change - refined[2 - number]).max() > 0.5 * np.abs(change).max()


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_effects_of_no_size_change_nothing(name):
    effect = EFFECTS[name]
    if effect.applied_in_full:
        pytest.skip("all or nothing")
    study = IN_IRON if name in ("iron_displaced", "iron_permeability") else STUDY
    place = effect.places(study)[0]
    applied = effect.apply(study, place, [0.0] * len(effect.parameters))
    assert applied.iron == study.iron
    assert shown(applied) == pytest.approx(shown(study), abs=1e-15)


@pytest.mark.filterwarnings("ignore:.*about the z axis. The blocks lie")
def test_what_is_outside_the_magnet_lies_about_its_own_middle():
    """Blocks of a table need not lie about z = 0, nor about the z axis."""
    names = ("neighbour_magnet", "ferromagnetic_object", "iron_ring")
    pair = STUDY.with_(array__rings=2, external={})

    def moved(along_m, across_m=0.0):
        table = blocks_table(build_magnet(pair))
        table["z_m"] = [z + along_m for z in table["z_m"]]
        table["x_m"] = [x + across_m for x in table["x_m"]]
        return parse_study(changed(DIPOLE, dimension=3, array={"free_blocks": table}))

    nominal, away = moved(0.0), moved(0.7)
    for name in names:
        here, there = (EFFECTS[name].places(study) for study in (nominal, away))
        shift = [0.0, 0.0, 0.7] if name == "ferromagnetic_object" else [0.0]
        assert here  # negative control: there is something to compare
        assert np.array([place.at_m for place in there]) == pytest.approx(
            np.array([place.at_m for place in here]) + shift)
    ring = EFFECTS["iron_ring"]
    iron, = build_magnet(ring.apply(away, ring.places(away)[0], [1.0])).iron
    low, high = build_magnet(away).array_ends
    assert (iron.z_min, iron.z_max) == pytest.approx((low, high))
    assert ring.places(moved(0.0, 0.9)) == []  # a tube is about the z axis


def test_places_are_in_the_magnet():
    assert len(EFFECTS["block_displaced"].places(STUDY)) == 64
    assert len(EFFECTS["ring_gap"].places(STUDY)) == 3
    flat = parse_study(changed(DIPOLE))
    for name in ("ring_gap", "ring_twisted", "ring_shifted", "length", "neighbour_magnet"):
        assert EFFECTS[name].places(flat) == []


STEPPED = parse_study(changed(
    DIPOLE, dimension=3, array__rings=6, array__ring_length_m=0.083,
    array__recoil_permeability=1.0, array__ring=[
        {"inner_radius_m": 0.09}, {"count": 2}, {"inner_radius_m": 0.12},
        {"count": 2, "layer": 2, "ring_length_m": 0.166,
         "inner_radius_m": 0.2, "outer_radius_m": 0.25}]))
"""A bore with steps in an outer layer, whose middle is the only plane that no ring crosses."""


@pytest.mark.parametrize("name", ["length", "inner_radius", "azimuthal_gap", "ring_gap"])
def test_sections_of_a_stepped_bore_have_lengths_radii_and_gaps_of_their_own(name):
    """What moves a section along z is in the catalogue wherever rings are listed."""
    effect = EFFECTS[name]
    nominal = NominalFields(STEPPED, POINTS, TIME, None)
    places = effect.places(STEPPED)
    assert [place.ring for place in places] == ([2] if name == "ring_gap" else [1, 2, 3, 4, 5, 6])
    for place in places:
        signature = effect.signature(nominal, place)[0]
        step = STEP * effect.parameters[0].sd
        values = (step * np.eye(len(effect.parameters))[0]).tolist()
        change = shown(effect.apply(STEPPED, place, values)) - shown(STEPPED)
        size = np.abs(change).max()
        assert size > 0
        assert np.abs(change - step * signature).max() < 1e-2 * size
        assert np.abs(change + step * signature).max() > size  # negative control
    if name == "ring_gap":  # of all layers
        moved = [block.displacement_m[2] for block in build_magnet(
            effect.apply(STEPPED, places[0], [1e-3, 0.0])).blocks[::16]]
        assert moved == pytest.approx([-5e-4, -5e-4, 5e-4, 5e-4, -5e-4, 5e-4])
    else:  # a ring of another moment has no remanence that stays
        by_moment = STEPPED.with_(array__ring=(STEPPED.array.ring[0].with_(
            block_moment_A_m2=100.0), *STEPPED.array.ring[1:]))
        assert [place.ring for place in effect.places(by_moment)] == [2, 3, 4, 5, 6]


def test_blocks_that_vary_inside_are_beside_no_iron():
    """Or the diagnosis of such a study stops: no study has both."""
    assert EFFECTS["iron_ring"].places(STUDY)
    assert not EFFECTS["iron_ring"].places(STUDY.with_(
        prior={"variation_sd": 0.1, "variation_length_m": 0.01}))


def test_seams_move_what_is_beyond_them_outwards():
    effect = EFFECTS["ring_gap"]
    moved = [
        [block.displacement_m[2]
         for block in build_magnet(effect.apply(STUDY, place, [1e-3, 0.0])).blocks[::16]]
        for place in effect.places(STUDY)]
    assert moved == pytest.approx(np.array([
        [-1e-3, 0, 0, 0], [-5e-4, -5e-4, 5e-4, 5e-4], [0, 0, 0, 1e-3]]))
    half_held = effect.apply(STUDY, effect.places(STUDY)[1], [1e-3, 5e-4])
    assert [block.displacement_m[2] for block in build_magnet(half_held).blocks[::16]] == (
        pytest.approx([0, 0, 1e-3, 1e-3]))


def test_losses_of_corners_add_up_and_are_no_gains():
    corners, shifted = EFFECTS["corners_demagnetized"], EFFECTS["ring_shifted"]
    study = corners.apply(STUDY, Place(), [0.2])
    study = shifted.apply(study, shifted.places(study)[0], [1e-3, 0.0])
    assert corners.apply(study, Place(), [0.1]).array.exceptions[-1].inner_corner_loss == (
        pytest.approx(0.3))
    with pytest.raises(ValidationError, match="inner_corner_loss"):
        corners.apply(study, Place(), [-0.3])


@pytest.mark.parametrize(("magnet", "uneven"), [("rods", False), ("cubes", True)])
def test_only_blocks_of_four_edges_have_corners(magnet, uneven):
    """The outline of a rod has four arcs, of which none is a side."""
    study = drawn_study(magnet, np.random.default_rng(1))
    for name in ("corners_demagnetized", "magnetization_gradient"):
        places = EFFECTS[name].places(study)
        assert bool(places) == uneven
        for place in places[:1]:
            build_magnet(EFFECTS[name].apply(study, place, [0.01]))


AWAY = parse_study(changed(DIPOLE, dimension=3, array__recoil_permeability=1.0, array__ring=[
    {"ring_length_m": 0.1, "z_m": 0.0}]))
"""One ring, which lies elsewhere along z in the test below."""


@pytest.mark.parametrize("name", ["neighbour_magnet", "ferromagnetic_object", "iron_ring"])
def test_what_is_beside_a_magnet_is_where_the_magnet_is(name):
    """Of a magnet 0.5 m away from z = 0, too."""
    effect, found = EFFECTS[name], []
    for z in (0.0, 0.5):
        study = AWAY.with_(array__ring=[{"ring_length_m": 0.1, "z_m": z}])
        place = effect.places(study)[0]
        magnet = build_magnet(effect.apply(study, place, [1.0] * len(effect.parameters)))
        heights = [*(np.ravel(place.at_m)[-1:] if name == "ferromagnetic_object" else []),
                   *(limit for body in magnet.iron for limit in (body.z_min, body.z_max)),
                   *(one.z_m + z for one in magnet.external.neighbours)]
        found.append(np.array(heights) - z)
    assert len(found[0])
    np.testing.assert_allclose(found[1], found[0], atol=1e-9)


PERMEABLE = {"recoil_permeability": 1.05, "recoil_permeability_across": 1.15}


@pytest.mark.parametrize(("array", "along", "across"), [
    (PERMEABLE, 1.07, 1.15), ({"recoil_permeability": 1.05}, 1.07, 1.07),
    ({"ring": [PERMEABLE] * 4}, 1.07, 1.15), ({"exceptions": [PERMEABLE]}, 1.07, 1.15),
    ({"exceptions": [{"recoil_permeability": 1.05}]}, 1.07, 1.07)])
def test_permeabilities_along_and_across_are_two(array, along, across):
    """Whichever table of a study states them."""
    study = STUDY.with_(**{f"array__{key}": value for key, value in array.items()})
    for name, expected in (("recoil_permeability", (along, across)),
                           ("recoil_permeability_across", (1.05, across + (
                               0.0 if along == across else 0.02)))):
        for block in build_magnet(EFFECTS[name].apply(study, Place(), [0.02])).blocks:
            assert (block.recoil_permeability, block.recoil_permeability_across) == (
                pytest.approx(expected))


@pytest.mark.parametrize(("keys", "rate"), [
    ({}, -1e-3), ({"array__material": "YX20", "array__remanence_T": 0.915}, -4e-4),  # SmCo5
    ({"demagnetization": {
        "intrinsic_coercivity_A_per_m": 2e6, "coercivity_coefficient_per_K": -2e-3,
        "remanence_coefficient_per_K": -3.5e-4}}, -3.5e-4),
    ({"prior": {"temperature_coefficient_per_K": -4e-4, "reference_temperature_C": 20.0}}, -4e-4)])
def test_a_temperature_acts_as_the_study_says(keys, rate):
    study = STUDY.with_(**keys)
    warmer = EFFECTS["temperature"].apply(study, Place(), [30.0])
    assert build_magnet(warmer).blocks[0].remanence == pytest.approx(
        (1 + 30 * rate) * build_magnet(study).blocks[0].remanence)


def test_iron_of_another_permeability():
    """What is common to all bodies and what is a body's own; none is below 1."""
    effect = EFFECTS["iron_permeability"]
    common, own = effect.places(IN_IRON)
    assert [place.name for place in (common, own)] == ["the iron", "body 3 of iron"]
    assert effect.apply(IN_IRON, common, [0.5]).iron.relative_permeability == 45.0
    changed_one = effect.apply(IN_IRON, own, [-0.5]).iron
    assert changed_one.bodies[2].relative_permeability == 1.0
    assert changed_one.bodies[:2] == IN_IRON.iron.bodies[:2]
    assert effect.places(STUDY) == []


def test_iron_is_displaced_where_there_is_room():
    """The field of a stand-in for the solver is the height of the box in m."""
    effect = EFFECTS["iron_displaced"]
    assert [place.name for place in effect.places(IN_IRON)] == [
        f"body {number} of iron" for number in (1, 2, 3)]
    assert effect.places(STUDY) == []
    beside = IN_IRON.with_(iron__bodies=[{
        "kind": "box", "size_m": [0.1] * 3, "centre_m": [0.0, 0.0, height]}
        for height in (0.3, 0.4, 0.5 + 3e-4)])  # the last one is 0.3 mm above the one below it

    def height_of(number):
        def solve(study):
            heights = [body.centre_m[2] for body in study.iron.bodies]
            if min(np.diff(heights)) < 0.1 - 1e-9:
                raise StudyError("iron in iron")
            in_place = study.iron == beside.iron  # where another route is 1 mm off
            return heights[number] + 1e-3 * in_place + 0 * POINTS

        return solve

    x, y, z = effect.signature(NominalFields(beside, POINTS, TIME, height_of(2)),
                               effect.places(beside)[2])
    assert x == pytest.approx(0 * POINTS)
    assert y == pytest.approx(0 * POINTS)
    assert z == pytest.approx(1 + 0 * POINTS)  # upwards only
    between = effect.signature(NominalFields(beside, POINTS, TIME, height_of(1)),
                               effect.places(beside)[1])
    assert between[2] == pytest.approx(0 * POINTS)  # it can move to neither side


@pytest.mark.parametrize("fraction", [-2.0, -1.0, -0.5, 0.5])
def test_what_is_multiplied_is_known_per_unit_of_what_the_study_says(fraction):
    """In the model, too, where the coil of 1 kA is off, or the iron of 30 has 15."""
    def in_model(name, study, place, solve):
        effect = EFFECTS[name]
        return effect.derivative(NominalFields(
            effect.apply(study, place, [fraction]), POINTS, TIME, solve), place, [fraction])

    effect = EFFECTS["coil_current"]
    (coil,) = effect.places(STUDY)
    more, less = (shown(effect.apply(STUDY, coil, [fraction + step])) for step in (0.1, -0.1))
    np.testing.assert_allclose(in_model("coil_current", STUDY, coil, None)[0],
                               (more - less) / 0.2, rtol=1e-9, atol=1e-15)
    if fraction > -1:
        iron = EFFECTS["iron_permeability"].places(IN_IRON)[0]
        slope = in_model("iron_permeability", IN_IRON, iron,
                         lambda study: study.iron.relative_permeability + 0 * POINTS)
        np.testing.assert_allclose(slope, 30.0 + 0 * slope, rtol=1e-9)


@pytest.mark.parametrize("listed", [lambda effects: [*effects, effects[0]],
                                    lambda effects: [*effects, "no effect"]])
def test_lists_of_effects_have_each_name_once(monkeypatch, listed):
    """A second effect of a name would take the place of the first. Control: lists as they are."""
    assert catalogue()
    monkeypatch.setattr(magnetization, "EFFECTS", listed(magnetization.EFFECTS))
    with pytest.raises(StudyError, match=r"module magnetization .* names of their own"):
        catalogue()
