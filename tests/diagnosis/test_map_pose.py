"""Maps in the coordinates of a stage, whose place a diagnosis finds from nothing."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError, StudyError
from halbach_fe.diagnosis import verdict
from halbach_fe.diagnosis.cost_estimate import estimate_diagnosis
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.gross_error_correction import (
    MIN_MISFIT_OF_A_POSE,
    correct_map_errors,
    field_of_iron,
    find_poses,
    misfits_of,
    with_poses,
)
from halbach_fe.diagnosis.result import FoundPose
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map, read_map, write_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.study.measurement_keys import Instrument, InstrumentSd
from halbach_fe.study.reader import parse_study, read_study
from tests.support.short_dipole import GRID, NOISE_T, TEXT, measured, truth

STAGE_M = np.array([0.3, -0.2, 0.4])
"""Origin of the map in the coordinates of its stage."""

TURN = Rotation.from_rotvec([0.02, -0.03, 0.04]) * Rotation.from_matrix(
    [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SYMMETRIES = Rotation.identity(), Rotation.from_rotvec([np.pi, 0.0, 0.0])
MIDDLE_M = np.array([0.0008, -0.0005, 0.012])

CUBES = """
name = "cubes"
[array]
multipole_order = 2
rings = 1
blocks_per_ring = 16
inner_radius_m = 0.026
outer_radius_m = 0.036
ring_length_m = 0.010
remanence_T = 1.3
recoil_permeability = 1.0
[array.block]
shape = "cuboid"
width_m = 0.010
orientation = "magnetization"
[mesh]
block_size_m = 0.006
[observation]
quantity = "flux_density"
[observation.positions]
kind = "circles"
radius_m = 0.01
angles = 8
[[noise.regions]]
name = "bore"
sigma_T = 1e-5
[prior]
magnitude_sd = 0.01
direction_sd_deg = 1.0
"""


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


def fail(text: str) -> None:
    raise AssertionError(text)


def test_what_lies_where_the_study_says_is_not_searched(study, generator, tmp_path):
    """A few millimetres are left to the catalogue."""
    data = measured(truth(generator), generator, Rotation.identity(),
                    np.array([0.002, 0.0, -0.045]))
    study = study.with_(instrument__translation_m=(0.0, 0.0, -0.045))
    assert find_poses(study, data, Session.open(tmp_path), fail) == ((), study)


def test_no_pose_makes_another_field_that_of_the_magnet(study, generator, tmp_path):
    """The control: a map of nothing, which every pose leaves as it is."""
    said: list[str] = []
    noise = field_map(GRID + STAGE_M, NOISE_T * generator.standard_normal(GRID.shape))
    assert find_poses(study, noise, Session.open(tmp_path), said.append) == ((), study)
    assert "no pose explains" in said[-1]


def test_a_shift_that_is_far_from_linear_is_named(generator, tmp_path, monkeypatch):
    """In a narrow quadrupole of cubes, linear signatures of a shift by 2.3 mm leave 16 % of what it
    does, which a field and a probe of any shape explain better. Control: if that counts for more
    than a tenth it is unknown, and the probabilities say what the answer says.
    """
    study = parse_study(tomllib.loads(CUBES))
    magnets = []
    for slot in range(16):
        angle = np.radians(22.5 * slot)
        cube = magpylib.magnet.Cuboid(
            dimension=(0.01,) * 3, position=(0.031 * np.cos(angle), 0.031 * np.sin(angle), 0.0),
            polarization=(1.3 * (1 + 0.01 * generator.standard_normal()), 0.0, 0.0))
        magnets.append(cube.rotate_from_angax(67.5 * slot, "z", anchor=None))
    magnet = magpylib.Collection(*magnets)
    some = [each for each in catalogue() if each.name in ("mapper_translation", "gain_x")]
    shift = np.array([0.001, 0.0005, 0.002])
    grid = np.stack(np.meshgrid(0.0055 * np.arange(-2, 3), 0.0055 * np.arange(-2, 3),
                                0.01 * np.arange(-1, 2), indexing="ij"), -1).reshape(-1, 3)
    data = field_map(grid, magnet.getB(grid + shift)
                     + 1e-5 * generator.standard_normal(grid.shape))
    named = diagnose(study, data, Session.open(tmp_path), effects=some)
    assert named.unknown is None
    (effect,) = named.identified
    assert effect.values == pytest.approx(shift, abs=4 * max(effect.sd))
    assert max(named.probabilities, key=named.probabilities.get) == "mapper_translation"
    monkeypatch.setattr(verdict, "FAR_BETTER", 0.9)
    other = diagnose(study, data, Session.open(tmp_path), effects=some)
    assert other.unknown is not None
    assert other.unknown.alone
    assert max(other.probabilities, key=other.probabilities.get) == "unknown"


def test_poses_of_maps_that_share_stage_and_probe_are_stated_together():
    """Stated one after the other, they contradict each other: the negative control."""
    maps = [{"name": name, "file": f"{name}.csv", "stage": "table", "probe": "hall",
             "stage_shift_sd_m": [0, 0, 1e-3]} for name in ("body", "fringe")]
    study = parse_study(tomllib.loads(TEXT) | {"maps": maps})
    poses = [FoundPose(None, Instrument(translation_m=(0.0, 0.0, z), rotation_rad=(0, 0, 0.01)),
                       InstrumentSd(translation_m=1e-3, gain=3e-3), (), 1.0, 0.1, name)
             for name, z in (("body", 0.1), ("fringe", 0.2))]
    found = with_poses(study, poses)
    assert [one.instrument.translation_m[2] for one in found.maps] == [0.1, 0.2]
    with pytest.raises(StudyError, match="maps of one"):
        with_poses(study, poses[:1])
    alone = with_poses(parse_study(tomllib.loads(TEXT)), [replace(poses[0], map=None)])
    assert alone.instrument_sd.gain == 3e-3


PLATES = {"name": "plates", "mesh": {"block_size_m": 0.02, "growth": 2.6}, "array": {
    "free_blocks": {
        "name": ["left", "right"], "shape": ["cuboid"] * 2, "x_m": [-0.05, 0.05], "y_m": [0.0] * 2,
        "z_m": [0.0, 0.0], "size_x_m": [0.02] * 2, "size_y_m": [0.04] * 2, "size_z_m": [0.04] * 2,
        "remanence_x_T": [0.0] * 2, "remanence_y_T": [1.2] * 2, "remanence_z_T": [0.0] * 2}},
    "noise": {"regions": [{"name": "all", "sigma_T": 1e-4}]},
    "iron": {"relative_permeability": 1000.0, "bodies": [{
        "kind": "box", "size_m": [0.12, 0.01, 0.05], "centre_m": [0.003, 0.026, 0.0],
        "mirrored": ["y"]}]},
    "observation": {"quantity": "flux_density", "positions": {
        "kind": "grid", "start_m": [-0.02, -0.01, -0.02], "end_m": [0.02, 0.01, 0.02],
        "count": [4, 3, 4]}}}


def test_iron_of_any_shape_is_no_pose(session):
    """Two plates multiply the field between them: the map lies where it should, whatever the field
    of the blocks in vacuum is like. An error of its axes is found beside them, and only with them.
    """
    study = parse_study(PLATES)
    points = points_from(study.observation.positions)
    truth = solve_nominal(build_magnet(study.with_(mesh__growth=1.8)), points, session.within("t"))
    data = field_map(points, truth)
    assert misfits_of(study, data)["map"] > MIN_MISFIT_OF_A_POSE  # as if there were no iron
    iron = field_of_iron(study, session.within("iron"))
    assert misfits_of(study, data, iron)["map"] < 0.05  # two meshes, 0.8 % were measured
    assert find_poses(study, data, session, fail, iron) == ((), study)
    assert estimate_diagnosis(study, data, effects=[]).signatures == 0  # it refuses no map
    assert correct_map_errors(study, data, None, [], iron)[0] == ()
    turned = field_map(points, truth[:, [1, 0, 2]])
    (error,), corrected, _ = correct_map_errors(study, turned, None, [], iron)
    assert corrected.instrument.field_axes == ("y", "x", "z")
    assert error.misfit_after < 0.05
    assert correct_map_errors(study, turned, None, [])[0] == ()
