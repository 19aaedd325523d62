"""Maps in the coordinates of a stage, whose place a diagnosis finds from nothing."""

from __future__ import annotations

import json
import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError
from halbach_fe.diagnosis.cost import estimate_diagnosis
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.map_pose import find_poses
from halbach_fe.measurement.field_map import field_map, read_map, write_map
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study, read_study
from tests.support.short_dipole import GRID, NOISE_T, TEXT, measured, truth

STAGE_M = np.array([0.3, -0.2, 0.4])
"""Origin of the map in the coordinates of its stage."""

TURN = Rotation.from_rotvec([0.02, -0.03, 0.04]) * Rotation.from_matrix(
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SYMMETRIES = Rotation.identity(), Rotation.from_rotvec([np.pi, 0.0, 0.0])
MIDDLE_M = np.array([0.0008, -0.0005, 0.012])


@pytest.fixture
def study():
    return parse_study(tomllib.loads(TEXT))


def test_a_map_on_a_stage_is_registered_first(study, generator, tmp_path):
    """The truth is magpylib's; the pose is right, and with it nothing else is missing."""
    data = measured(truth(generator, 0.004), generator, TURN,
                    MIDDLE_M - TURN.apply(GRID.mean(axis=0)))
    write_map(field_map(GRID + STAGE_M, data["B_T"].values), tmp_path / "map.csv")
    (tmp_path / "study.toml").write_text(TEXT)
    with pytest.raises(MeasurementError, match="halbach-fe register"):
        estimate_diagnosis(study, read_map(tmp_path / "map.csv"))
    names = ",".join(each.name for each in catalogue() if each.name.startswith(("gain", "mapper")))
    assert main(["diagnose", str(tmp_path / "study.toml"), "--measurements",
                 str(tmp_path / "map.csv"), "--effects", names, "-o", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    (pose,) = found["poses"]
    assert found["verdict"] == "named"
    assert found["effects"] == []
    assert pose["misfit_before"] is None or pose["misfit_before"] > 0.3
    assert pose["misfit_after"] < 0.02  # blocks of 0.4 %
    # half a turn about the direction of the field leaves a dipole as it is
    turned = Rotation.from_rotvec(pose["rotation_rad"]) * TURN.inv()
    same = min(SYMMETRIES, key=lambda each: (turned * each.inv()).magnitude())
    assert (turned * same.inv()).magnitude() < 4 * np.linalg.norm(pose["rotation_sd_rad"])
    off = np.abs(pose["middle_m"] - same.apply(MIDDLE_M))
    assert (off < 4 * np.array(pose["translation_sd_m"])).all()
    assert max(pose["translation_sd_m"]) < 3e-4
    assert all(score["chi2_per_reading"] < 1.3 for score in found["scores"]["after"]
               if score["part"] == "held out")
    changed = read_study(tmp_path / "out" / "study.diagnosed.toml")
    assert changed.instrument.rotation_rad == pytest.approx(pose["rotation_rad"])
    page = (tmp_path / "out" / "diagnosis.html").read_text()
    assert "The map is not where the study says" in page


def test_what_lies_where_the_study_says_is_not_searched(study, generator, tmp_path):
    """A few millimetres are left to the catalogue."""
    data = measured(truth(generator), generator, Rotation.identity(),
                    np.array([0.002, 0.0, -0.045]))
    study = study.with_(instrument__translation_m=(0.0, 0.0, -0.045))

    def fail(text: str) -> None:
        raise AssertionError(text)

    assert find_poses(study, data, Session.open(tmp_path), fail) == ((), study)


def test_no_pose_makes_another_field_that_of_the_magnet(study, generator, tmp_path):
    """The control: a map of nothing, which every pose leaves as it is."""
    said: list[str] = []
    noise = field_map(GRID + STAGE_M, NOISE_T * generator.standard_normal(GRID.shape))
    assert find_poses(study, noise, Session.open(tmp_path), said.append) == ((), study)
    assert "no pose explains" in said[-1]
