"""The catalogue: signatures are the derivatives of what the effects do to a study."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Place
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.mounting import mountings
from halbach_fe.measurement.instrument import nonlinear_part, sensor_model, with_memory
from halbach_fe.solver.exact_block_field import external_field, field_of
from halbach_fe.study.reader import parse_study
from studies.diagnosis.drawn_studies import drawn_study
from tests.conftest import DIPOLE, changed, circle

STUDY = parse_study(changed(
    DIPOLE, dimension=3, array__rings=4, array__ring_length_m=0.083,
    array__recoil_permeability=1.0))
POINTS = np.vstack([circle(0.06, 8, z, 0.1) for z in np.linspace(-0.25, 0.25, 7)])
TIME = np.linspace(0, 1, len(POINTS))
EFFECTS = {effect.name: effect for effect in catalogue()}
SOLVED = {"iron_ring", "iron_saturation", "knee", "recoil_permeability",
          "recoil_permeability_across"}
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
    place = effect.places(STUDY)[0]
    applied = effect.apply(STUDY, place, [0.0] * len(effect.parameters))
    assert shown(applied) == pytest.approx(shown(STUDY), abs=1e-15)


def test_places_are_in_the_magnet():
    assert len(EFFECTS["block_displaced"].places(STUDY)) == 64
    assert len(EFFECTS["ring_gap"].places(STUDY)) == 3
    flat = parse_study(changed(DIPOLE))
    for name in ("ring_gap", "ring_twisted", "ring_shifted", "length", "neighbour_magnet"):
        assert EFFECTS[name].places(flat) == []


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
