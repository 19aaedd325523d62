"""Diagnosed amplitudes stay uncertain in the study, and are estimated with the blocks."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
import tomlkit
from scipy.spatial.transform import Rotation

from halbach_fe.core.errors import StudyError
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.summary import STUDY_FILE, write_study
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.response.magnetic_axis import magnetic_axis
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study, read_study
from halbach_fe.study.uncertain import number_changes, shifted
from tests.conftest import circle
from tests.diagnosis.campaign import drawn, field
from tests.support.cuboids import DOCUMENT, NOISE_T

QUADRUPOLE = {"multipole_order": 2, "rings": 4, "ring_length_m": 0.045}
SHORT = {"rings": 2, "ring_length_m": 0.08, "inner_radius_m": 0.09, "block": {
    "shape": "cuboid", "width_m": 0.035}}
MAGNETS = {"dipole": {}, "quadrupole": QUADRUPOLE, "two rings": SHORT}
POINTS = np.vstack([circle(radius, 12, z, 0.1) for radius in (0.03, 0.06)
                    for z in np.linspace(-0.15, 0.15, 9)])
TILT_RAD, MOVED_M, WARMER = 3e-3, 4e-4, -0.006


def hidden(study, name, polarizations):
    """B (n, 3) in T that a map shows at `POINTS` of a magnet with a hidden effect."""
    if name == "mapper_tilt_x":
        turn = Rotation.from_rotvec([TILT_RAD, 0.0, 0.0])
        return turn.inv().apply(field(study, polarizations, turn.apply(POINTS)))
    if name == "temperature":
        return field(study, polarizations, POINTS)
    rings = np.array([block.ring for block in build_magnet(study).blocks])
    moved = polarizations * (rings == 1)[:, None]
    return field(study, polarizations - moved, POINTS) + field(
        study, moved, POINTS - [MOVED_M, 0.0, 0.0])


def update(study, shown, polarizations, session):
    """Chi-squared per parameter of all blocks against the truth, and the magnetic axis."""
    magnet = build_magnet(study)
    result = infer(magnet, shown, session)
    count = len(magnet.parameter_names)
    off = polarizations.ravel() / MU_0 - result.posterior.mean[:count]
    covariance = result.posterior.covariance[:count, :count]
    return (float(off @ np.linalg.solve(covariance, off)) / count, result,
            magnetic_axis(magnet, session.within("axis"), result.posterior))


@pytest.mark.parametrize(("magnet", "name"), [
    ("dipole", "mapper_tilt_x"), ("quadrupole", "mapper_tilt_x"), ("two rings", "ring_shifted")])
def test_the_update_after_a_diagnosis_is_no_surer_than_it_may_be(
        magnet, name, session, tmp_path, generator):
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | MAGNETS[magnet]})
    polarizations = drawn(study, generator)
    true = hidden(study, name, polarizations)
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    effects = [effect for effect in catalogue() if effect.name in (name, "gain_x", "offset_z")]
    found = diagnose(study, shown, session.within("diagnosis"), effects=effects)
    assert [effect.hypothesis.effect.name for effect in found.identified] == [name]
    write_study(tomlkit.dumps(study.model_dump(mode="json", exclude_none=True)), study, found,
                tmp_path)
    again = read_study(tmp_path / STUDY_FILE)
    assert again == found.study  # the file says the same
    chi2, result, axis = update(again, shown, polarizations, session.within("update"))
    exact, _, _ = update(again.with_(uncertain=()), shown, polarizations, session.within("exact"))
    print(chi2, exact, result.amplitudes, axis)
    count = polarizations.size
    assert abs(chi2 - 1) < 4 * np.sqrt(2 / count)  # four standard deviations of chi-squared
    assert exact > 1 + 4 * np.sqrt(2 / count)  # the control: amplitudes as exact numbers
