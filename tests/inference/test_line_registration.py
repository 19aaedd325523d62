"""Profiles on a line that magpylib computed: registered beside the axis, with the step open."""

from __future__ import annotations

import json
import tomllib

import magpylib
import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.pose_result import OpenKey, PosePrior
from halbach_fe.inference.pose_search import line_of
from halbach_fe.inference.registration import odds, register
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.report.registration_page import answer, by_hypothesis, sentences
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from tests.support.short_dipole import TEXT as CIRCLES
from tests.support.short_dipole import sectors, truth

TEXT = CIRCLES.replace("scan_lines_every = 5", "every = 5").replace(
    'shape = "cuboid"\nwidth_m = 0.016', 'shape = "sector"').replace(
    "magnitude_sd = 0.01", "magnitude_sd = 0.003").replace(
    "direction_sd_deg = 0.6", "direction_sd_deg = 0.2").replace("sigma_T = 2e-5", "sigma_T = 5e-5")
NOISE_T = 5e-5
STEP = OpenKey("instrument.z_scale", 0.03)
PLACE = np.array([0.012, 0.005])
"""Of the line, in m, in a bore of 20 mm."""
SCALE, SHIFT_M = 1.02, 0.003
SMALL_TURNS = PosePrior(turn_rad=0.01)


@pytest.fixture(scope="module")
def magnet():
    return build_magnet(parse_study(tomllib.loads(TEXT)))


def profile(source, generator, place=PLACE, components=(0,)):
    """B_x on a line beside the axis; the map's own z is too short by a factor."""
    z = 0.002 * np.arange(-40, 41)
    points = np.column_stack([np.tile(place, (len(z), 1)), z * SCALE + SHIFT_M])
    field = np.full((len(z), 3), np.nan)
    clean = source.getB(points)[:, list(components)]
    field[:, list(components)] = clean + NOISE_T * generator.standard_normal(clean.shape)
    return field_map(np.column_stack([0 * z, 0 * z, z]), field)


def test_a_line_is_told_from_a_map(generator):
    z = np.linspace(-1, 1, 20)
    along = np.column_stack([0.2 * z, 0.1 * z, z]) + 1e-5 * generator.standard_normal((20, 3))
    direction = line_of(along, 1e-3)
    assert np.abs(direction @ [0.2, 0.1, 1.0]) == pytest.approx(np.sqrt(1.05), abs=1e-4)
    assert line_of(along + np.outer(np.arange(20) % 2, [0.01, 0, 0]), 1e-3) is None
    assert line_of(along[:2], 1e-3) is None


def test_a_profile_beside_the_axis_with_a_wrong_step(magnet, generator, tmp_path):
    data = profile(sectors(truth(generator, 0.003)), generator)
    found = register(magnet, data, Session.open(tmp_path), open_keys=[STEP],
                     alternatives=[()], pose=SMALL_TURNS)
    best = found[0]
    assert best.explains
    assert best.at_rest
    # B_x is even in x, y and z: four lines in two directions
    equal = [each for each in found if each.log_evidence > best.log_evidence - 3]
    assert len(equal) == 8
    quadrants = {tuple(np.sign(each.middle_m[:2])) for each in equal}
    assert len(quadrants) == 4
    for each in equal:
        off = (np.abs(each.middle_m[:2]) - PLACE) / each.translation_sd_m[:2]
        assert np.abs(off).max() < 4
        value, sd = each.open_keys[STEP.key]
        assert value == pytest.approx(SCALE - 1, abs=4 * sd)
        assert sd < 3e-3
        assert abs(each.middle_m[2]) == pytest.approx(SHIFT_M, abs=4 * each.translation_sd_m[2])
        assert each.translation_sd_m.max() < 3e-3
        # a turn about the line changes B_x in second order only
        assert "turn about z" in each.undetermined
        assert each.rotation_sd_rad[2] > 0.5 * SMALL_TURNS.turn_rad
    # without the step it fits worse: a control
    assert by_hypothesis(found)["nothing open"] < 1e-3
    assert odds(found).sum() == pytest.approx(1.0)
    said = " ".join([answer(found).trust, *sentences(found)])
    assert "7 other poses" in said
    assert "does not determine the" in said


def test_a_profile_of_another_magnet_is_not_explained(magnet, generator, tmp_path):
    """Controls: a wider dipole, and a quadrupole of the same size."""
    wider = magpylib.Collection(*[magpylib.magnet.CylinderSegment(
        dimension=(0.035, 0.05, 0.06, 45 * slot - 22.5, 45 * slot + 22.5),
        polarization=(1.5 * np.cos(np.radians(90 * slot)), 1.5 * np.sin(np.radians(90 * slot)), 0.0)
    ) for slot in range(8)])
    quadrupole = magpylib.Collection(*[magpylib.magnet.CylinderSegment(
        dimension=(0.02, 0.04, 0.06, 45 * slot - 22.5, 45 * slot + 22.5),
        polarization=(1.3 * np.cos(np.radians(135 * slot)), 1.3 * np.sin(np.radians(135 * slot)),
                      0.0)) for slot in range(8)])
    for source, name in ((wider, "wider"), (quadrupole, "quadrupole")):
        data = profile(source, generator, components=(0, 1, 2))
        try:
            found = register(magnet, data, Session.open(tmp_path / name), open_keys=[STEP],
                             pose=SMALL_TURNS, most=2)
        except MeasurementError as error:
            assert "unexplained" in str(error)
            continue
        assert not found[0].explains
        assert "does not explain the map" in answer(found).said
        assert not answer(found).sound


def test_the_command_compares_what_may_be_open(generator, tmp_path, capsys):
    (tmp_path / "study.toml").write_text(TEXT)
    write_map(profile(sectors(truth(generator, 0.003)), generator), tmp_path / "map.csv")
    arguments = ["register", str(tmp_path / "study.toml"), "--measurements",
                 str(tmp_path / "map.csv"), "-o", str(tmp_path / "out"), "--turn-rad", "0.01"]
    assert main([*arguments, "--fit", "instrument.z_scale=0.03",
                 "--alternative", "array.ring_length_m=0.001"]) == 0
    assert "Odds of what is open" in capsys.readouterr().err
    poses = json.loads((tmp_path / "out" / "registration.json").read_text())["poses"]
    assert {key for pose in poses for key in pose["open_keys"]} == {
        "instrument.z_scale", "array.ring_length_m"}
    assert poses[0]["explains"]
    with pytest.raises(SystemExit, match="2"):
        main([*arguments, "--alternative", "array.rings,array.ring_length_m=1"])
