"""Errors of assembly: whole blocks, rings and layers in wrong orientations, slots and places."""

from __future__ import annotations

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Place
from halbach_fe.geometry.fitting_turns import turns_in_slot
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.mounting import mountings
from halbach_fe.measurement.field_map import field_map
from halbach_fe.study.reader import parse_study
from tests.conftest import circle
from tests.diagnosis.campaign import drawn, field
from tests.support.cuboids import DOCUMENT, NOISE_T

EFFECTS = {effect.name: effect for effect in catalogue()}
RIVALS = [EFFECTS[name] for name in (
    "background", "block_demagnetized", "block_displaced", "block_flipped", "block_missing",
    "block_put_in_wrongly", "block_turned", "blocks_swapped", "ferromagnetic_object", "gain_x",
    "mapper_translation", "ring_shifted", "ring_shifted_along", "ring_twisted", "rings_swapped",
    "rings_turned", "rings_upside_down")]
POINTS = np.vstack([circle(0.065, 12, z, 0.1) for z in np.linspace(-0.15, 0.15, 11)])

QUADRUPOLE = {"multipole_order": 2, "rings": 4, "ring_length_m": 0.045}
STEPPED = {"rings": 3, "remanence_T": 1.2, "ring": [
    {"remanence_T": remanence} for remanence in (1.2, 1.12, 1.2)]}

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
    """B (n, 3) in T by magpylib; ``moved`` (cubes,) in m along z."""
    centres, angles = cubes()
    total = np.zeros(points.shape)
    z = moved + np.zeros(len(angles))
    for centre, angle, polarization, shift in zip(centres, angles, polarizations, z, strict=True):
        turn = Rotation.from_euler("z", angle)
        total += magpylib.magnet.Cuboid(
            position=centre + [0, 0, shift], dimension=[SIDE_M] * 3, orientation=turn,
            polarization=turn.inv().apply(polarization)).getB(points)
    return total


def named(study, true, session, generator, effects=RIVALS):
    """Effects, with their places, that a diagnosis names."""
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    found = diagnose(study, shown, session, effects=effects)
    assert found.unknown is None
    return [(one.hypothesis.effect.name, one.place.name) for one in found.identified], found


def test_a_cube_a_quarter_turn_wrong(session, generator):
    study = mri()
    polarizations = drawn(study, generator)
    before = polarizations.copy()
    polarizations[16] = Rotation.from_euler("z", 90, degrees=True).apply(polarizations[16])
    true = field_of_cubes(polarizations, POINTS)
    names, found = named(study, true, session, generator)
    assert names == [("block_put_in_wrongly", "c16, a quarter turn about z")]
    assert found.converged
    # negative control: without that effect nothing inside the cube is an object
    others = [effect for effect in RIVALS if effect.name != "block_put_in_wrongly"]
    shown = field_map(POINTS, true)
    wrong = diagnose(study, shown, session.within("others"), effects=others).identified
    objects = [one for one in wrong if one.hypothesis.effect.name == "ferromagnetic_object"]
    assert not build_magnet(study).contains(
        np.array([one.place.at_m for one in objects]).reshape(-1, 3)).any()
    # another: all cubes as they should be
    assert named(study, field_of_cubes(before, POINTS), session.within("clean"), generator)[0] == []


def test_a_layer_along_the_axis(session, generator):
    study = mri()
    moved = np.where(np.arange(RINGS * CUBES) // CUBES == 1, 5e-4, 0.0)
    true = field_of_cubes(drawn(study, generator), POINTS, moved)
    names, found = named(study, true, session, generator)
    assert names == [("ring_shifted_along", "r02")]
    (layer,) = found.identified
    assert abs(layer.values[0] - 5e-4) < 3.5 * layer.sd[0] < 5e-4
