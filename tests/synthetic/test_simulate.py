"""Synthetic campaigns: what is drawn, what is written, and that an inference finds it again."""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
import warnings

import numpy as np
import pytest
import xarray as xr

from halbach_fe.cli import main
from halbach_fe.core.errors import EXIT_CODES, HalbachWarning, StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.measurement.block_table import read_blocks
from halbach_fe.measurement.field_map import field_map, points_of, read_map
from halbach_fe.measurement.observation_operator import fourier_analysis, observe
from halbach_fe.measurement.positions import between, points_from
from halbach_fe.measurement.reading_noise import reading_noise
from halbach_fe.report.words import flux_density
from halbach_fe.solver.exact_block_field import demagnetizing_tensors, gradient_of
from halbach_fe.solver.getdp_cache import FOLDER_VARIABLE, LIMIT_VARIABLE
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study, read_study
from halbach_fe.synthetic.ngsolve_reaction import Elements
from halbach_fe.synthetic.reaction import lone_moment_matrix
from halbach_fe.synthetic.simulate import (
    coil_table,
    draw_magnet,
    real_places,
    simulate_campaign,
    write_campaign,
)
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import DIPOLE, changed
from tests.support import short_dipole
from tests.support.pages import page

NOISE = {"regions": [{"name": "all", "sigma_T": 1e-4}]}
RINGS = {"array__recoil_permeability": 1.0, "noise": NOISE, "observation__positions": {
    "kind": "circles", "radius_m": 0.075, "angles": 16, "z_min_m": -0.1, "z_max_m": 0.1,
    "count": 5}}

STUDY = """
name = "campaign"
dimension = 2
[array]
blocks_per_ring = 16
inner_radius_m = 0.104
outer_radius_m = 0.1865
first_block_angle_deg = 90.0
first_magnetization_angle_deg = 180.0
remanence_T = 1.06
recoil_permeability = 1.05
[array.block]
shape = "sector"
[mesh]
block_size_m = 0.012
[observation]
quantity = "flux_density"
components = ["x", "y"]
[observation.positions]
kind = "circles"
radius_m = 0.075
angles = 90
[[noise.regions]]
name = "bore"
sigma_T = 5e-5
[prior]
common_mode_sd = 0.005
"""


@pytest.fixture(autouse=True)
def similar_figures_once():
    """All pictures are drawn, because files are compared."""


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """The study's file, and folders of campaigns of two seeds, made on the command line."""
    folder = tmp_path_factory.mktemp("campaigns")
    study = folder / "study.toml"
    study.write_text(STUDY)
    for seed in (5, 6):
        assert main(["simulate-measurement", str(study), "-o", str(folder / str(seed)),
                     "--seed", str(seed), "--json"]) == 0
    return study, folder / "5", folder / "6"


# --- from the command line to the inference ----------------------------------------------------


def inferred(study, readings, blocks, out, capsys):
    """Summary of an inference, and its magnetizations and standard deviations.

    The study's response is solved once for all maps.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(FOLDER_VARIABLE, str(study.parent / "cache"))
        patch.setenv(LIMIT_VARIABLE, "1")
        assert main(["infer", str(study), "--measurements", str(readings), "--blocks", str(blocks),
                     "-o", str(out), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    with xr.open_dataset(out / "posterior.h5", engine="h5netcdf") as data:
        found = data.load()
    table = np.genfromtxt(out / "prediction.csv", delimiter=",", names=True, dtype=None,
                          encoding=None)
    score = (table["measured_T"] - table["posterior_mean_T"]) / np.hypot(
        table["sigma_T"], table["solver_error_T"])
    return summary, found, np.mean(score**2)


def test_inference_finds_the_truth(campaigns, tmp_path, capsys):
    """32 magnetizations: the rms of error over standard deviation is 1 +- 0.13, and somewhat less
    as they share the coil's error. 180 readings, of which the blocks take up some 30: chi2 per
    reading is 0.83 +- 0.1.
    """
    study, folder, other = campaigns
    summary, found, chi2 = inferred(study, folder / "map.csv", folder / "blocks.csv",
                                    tmp_path / "own", capsys)
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    drawn = np.array([block["magnetization_A_per_m"][:2] for block in truth["blocks"]]).ravel()
    score = (drawn - found["posterior_mean"].values) / found["posterior_sd"].values
    assert 0.8 < np.sqrt(np.mean(score**2)) < 1.2
    assert 0.6 < chi2 < 1.2
    assert summary["prior_conflict"] < summary["prior_conflict_limit"]
    before = (drawn - found["prior_mean"].values) / found["prior_sd"].values
    assert np.sqrt(np.mean(before**2)) < 3.5  # nearly one number: the coil's calibration
    # negative controls: another magnet's map, or blocks, conflict with what is known of this one
    for name, readings, blocks in (("map", other, folder), ("blocks", folder, other)):
        summary, found, _ = inferred(study, readings / "map.csv", blocks / "blocks.csv",
                                     tmp_path / name, capsys)
        assert summary["prior_conflict"] > 2 * summary["prior_conflict_limit"]
        score = (drawn - found["posterior_mean"].values) / found["posterior_sd"].values
        assert np.sqrt(np.mean(score**2)) > 2


def test_the_truth_is_sealed(campaigns):
    """Maps name the hash of the truth; the truth has all that was drawn."""
    study, folder, other = campaigns
    text = (folder / "truth" / "truth.json").read_bytes()
    for name in ("map.csv", "held-out.csv"):
        assert read_map(folder / name).attrs["truth_sha256"] == hashlib.sha256(text).hexdigest()
    assert read_map(other / "map.csv").attrs["truth_sha256"] != hashlib.sha256(text).hexdigest()
    truth = json.loads(text)
    assert {"seed", "blocks", "effects", "model", "coil_calibration", "noise_free"} <= set(truth)
    assert truth["model"].keys() == {"vacuum", "reaction"}
    for name in ("map.csv", "blocks.csv"):  # nothing of it is in the open
        assert "seed" not in (folder / name).read_text()
    assert hashlib.sha256(text).hexdigest() in page(folder / "campaign.html")
    digests = json.loads((folder / "run.json").read_text())["files"]
    for name in ("map.csv", "held-out.csv", "blocks.csv", "truth/truth.json"):
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digests[name]
    text = page(folder / "campaign.html")
    largest = np.nanmax(np.abs(read_map(folder / "map.csv")["B_T"].values))
    assert f">{flux_density(largest, 5)}</td>" in text
    # blocks are shown as they were ordered, not as they were drawn
    shown = set(re.findall(r"M = \(([^)]*)\)", text.rpartition("<h2>Pictures")[0]))
    assert shown == _words(block.magnetization[:2]
                           for block in build_magnet(read_study(study)).blocks)
    assert not shown & _words(block["magnetization_A_per_m"][:2] for block in truth["blocks"])


def _words(magnetizations):
    return {", ".join(f"{1e-3 * one:.1f}" for one in each) for each in magnetizations}


def test_the_same_seed_gives_the_same_files(campaigns, tmp_path):
    study, folder, other = campaigns
    assert main(["simulate-measurement", str(study), "-o", str(tmp_path), "--seed", "5",
                 "--json"]) == 0
    files = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert [str(path) for path in files] == [
        "blocks.csv", "campaign.html", "campaign_field.png", "campaign_geometry.png",
        "held-out.csv", "map.csv", "page.json", "run.json", "truth/truth.json"]
    records = [json.loads((each / "run.json").read_text()) | {"ended": ""}
               for each in (folder, tmp_path)]
    for each in records:
        del each["files"]["campaign.html"]  # its command names the folder
    assert records[0] == records[1]  # but for the time
    pages = [(each / "campaign.html").read_text() for each in (folder, tmp_path)]
    assert pages[0].replace(str(folder), "DIR") == pages[1].replace(str(tmp_path), "DIR")
    for path in (path for path in files if path.name not in ("run.json", "campaign.html")):
        assert (tmp_path / path).read_bytes() == (folder / path).read_bytes()
        assert path.name == "campaign_geometry.png" or (
            tmp_path / path).read_bytes() != (other / path).read_bytes()


def test_refusals_on_the_command_line(campaigns, tmp_path, capsys):
    study, *_ = campaigns
    quiet = tmp_path / "quiet.toml"
    quiet.write_text(STUDY.split("[[noise.regions]]", maxsplit=1)[0])
    arguments = ["simulate-measurement", str(quiet), "-o", str(tmp_path / "out")]
    assert main(arguments) == StudyError.exit_code
    assert "[[noise.regions]]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    for wrong in ("0", "-1", "nan", "inf", "many"):
        with pytest.raises(SystemExit) as stop:
            main(["simulate-measurement", str(study), "-o", str(tmp_path), "--coil-sd", wrong])
        assert stop.value.code == 2
    assert 11 in EXIT_CODES


def test_an_instrument_of_the_study(tmp_path):
    """The map is written in the units that the study states, so that it is read back in m."""
    study = tmp_path / "study.toml"
    for unit in ("1.0", "0.001"):
        study.write_text(STUDY + f"\n[instrument]\nlength_unit_m = {unit}\n")
        assert main(["simulate-measurement", str(study), "-o", str(tmp_path / unit)]) == 0
    metres, millimetres = (points_of(read_map(tmp_path / unit / "map.csv"))
                           for unit in ("1.0", "0.001"))
    np.testing.assert_allclose(millimetres, 1000 * metres, rtol=0, atol=1e-9)  # of rounding


def test_output_that_cannot_be_written(tmp_path, capsys, monkeypatch):
    """It is found out before the simulation."""
    monkeypatch.setattr("halbach_fe.synthetic.simulate.simulate_campaign", None)
    (tmp_path / "file").write_text("")
    study = tmp_path / "vacuum.toml"
    study.write_text(STUDY.replace("1.05", "1.0"))
    assert main(["simulate-measurement", str(study), "-o", str(tmp_path / "file")]) == 8
    assert "Cannot make folder" in capsys.readouterr().err


# --- what is drawn -----------------------------------------------------------------------------


def test_blocks_have_the_priors_spread(dipole):
    """16 blocks, 300 magnets: standard deviations to 1/sqrt(2 * 4800) = 1 %, or 4 % of the common
    mode; 4 sigma.
    """
    study = dipole(prior={"magnitude_sd": 0.01, "direction_sd_deg": 0.5, "common_mode_sd": 0.02})
    nominal = magnet_of(study)
    deviations, common = [], []
    for seed in range(300):
        drawn = draw_magnet(study, nominal, np.random.default_rng(seed))
        common.append(drawn.common[0])
        for body, ideal in zip(drawn.mounted.bodies, nominal.bodies, strict=True):
            along = ideal.magnetization
            across = np.cross([0, 0, 1], along)
            off = (body.magnetization - ideal.magnetization) / (along @ along)
            deviations.append([off @ along - drawn.common[0], off @ across])
            assert body.magnetization[2] == 0
    spread = np.std(deviations, axis=0)
    assert spread[0] == pytest.approx(0.01, rel=0.04)
    assert spread[1] == pytest.approx(np.radians(0.5), rel=0.04)
    assert np.std(common) == pytest.approx(0.02, rel=0.16)


def test_what_is_not_drawn_is_said(short_dipole):
    """It looked as if magnetizations varied inside the blocks that were measured."""
    study = short_dipole(prior={"variation_sd": 0.02, "variation_length_m": 0.02})
    with pytest.warns(HalbachWarning, match=r"uniformly magnetized: `prior\.variation_sd`"):
        draw_magnet(study, magnet_of(study), np.random.default_rng(1))


def test_mounting_turns_magnetizations(short_dipole):
    """The block that the coil saw is not turned; 32 blocks of two angles that change it: 1/8."""
    study = short_dipole(prior={"mounting_sd_deg": 2.0})
    drawn = draw_magnet(study, magnet_of(study), np.random.default_rng(1))
    size, angle = [], []
    for one, other in zip(drawn.single.bodies, drawn.mounted.bodies, strict=True):
        a, b = one.magnetization, other.magnetization
        size.append(np.linalg.norm(b) / np.linalg.norm(a))
        angle.append(np.degrees(np.linalg.norm(np.cross(a, b)) / (a @ b)))
        assert other.rotation == (0, 0, 0)  # the block's shape stays where it is
    np.testing.assert_allclose(size, 1, rtol=1e-12)
    assert np.sqrt(np.mean(np.square(angle)) / 2) == pytest.approx(2.0, rel=0.5)


@pytest.mark.filterwarnings("ignore:.*better than any coil measures")  # so that it is exact
def test_block_table_gives_the_magnetizations_back(short_dipole):
    """halbach-fe's conversion of moments, to 1e-3 by its own account; coil and blocks have other
    random numbers. Without noise but for 1e-6.
    """
    study = short_dipole(array__recoil_permeability=1.1, noise=NOISE)
    nominal = magnet_of(study)
    drawn = draw_magnet(study, nominal, np.random.default_rng(1))
    table, calibration = coil_table(study, nominal, drawn.single, 1e-6, np.random.default_rng(2))
    assert calibration == 0  # the prior has no common mode
    found = prior_from_blocks(build_magnet(study), table).gaussian.mean.reshape(-1, 3)
    true = np.array([body.magnetization for body in drawn.single.bodies])
    size = np.linalg.norm(true[0])
    assert np.linalg.norm(found - true, axis=1).max() < 1.5e-3 * size
    nothing = np.array([body.magnetization for body in nominal.bodies])
    assert np.linalg.norm(nothing - true, axis=1).max() > 1e-2 * size


def test_lone_moment(short_dipole):
    """Against ``V (1 + (mu - 1) N)^-1 B_r / mu_0`` with halbach-fe's tensor N, to second order in
    mu - 1 and the tensor's 6e-4: measured 1.4e-4 apart. Without N it would be 3e-2.
    """
    study = short_dipole(array__first_block_angle_deg=0.0, array__recoil_permeability=1.1)
    block, body = build_magnet(study).blocks[0], magnet_of(study).bodies[0]
    (tensor,) = demagnetizing_tensors([block])
    expected = block.volume / MU_0 * np.linalg.inv(np.eye(3) + 0.1 * tensor)
    found = lone_moment_matrix(body.shape, body.permeability)
    np.testing.assert_allclose(found, expected, atol=1e-3 * expected[0, 0])
    assert np.abs(found - block.volume / MU_0 * np.eye(3)).max() > 2e-2 * expected[0, 0]


def test_calibration_and_noise_of_the_coil(short_dipole):
    """The table's moments are one factor off, and scatter by coil_sd: 96 values, 4 sigma 30 %."""
    study = short_dipole(array__recoil_permeability=1.0, prior={"common_mode_sd": 0.03})
    nominal = magnet_of(study)
    table, calibration = coil_table(study, nominal, nominal, 1e-3, np.random.default_rng(3))
    volume = nominal.bodies[0].shape.volume
    exact = np.array([body.remanence for body in nominal.bodies]) * volume / MU_0
    size = np.linalg.norm(exact[0])
    assert abs(calibration) > 1e-3
    off = (table.moment * (1 + calibration) - exact) / size
    assert np.std(off) == pytest.approx(1e-3, rel=0.3)
    assert np.abs(table.moment - exact).max() > abs(calibration) / 2 * size
    np.testing.assert_allclose(table.sigma, 1e-3 * size)


# --- what is measured --------------------------------------------------------------------------


def test_noise_and_components(short_dipole):
    """Readings scatter about the field by the region's sigma; what is not observed is left out."""
    study = short_dipole(**RINGS, observation__components=["x", "z"])
    campaign, other = simulate_campaign(study, 1), simulate_campaign(
        study.with_(
            noise__regions=tuple(region.with_(sigma_T=1e-9) for region in study.noise.regions)), 1)
    noise = (campaign.readings["B_T"] - other.readings["B_T"]).values
    assert np.isnan(noise[:, 1]).all()
    assert np.std(noise[:, [0, 2]]) == pytest.approx(1e-4, rel=0.23)  # 160 values, 4 sigma
    assert "sigma_T" not in campaign.readings
    np.testing.assert_array_equal(points_of(campaign.readings),
                                  points_from(study.observation.positions))


def test_noise_by_component(short_dipole):
    """Of the first region that fits; 80 values, 4 sigma."""
    regions = [{"name": "z", "components": ["z"], "sigma_T": 1e-3}, *NOISE["regions"]]
    campaign, quiet = (simulate_campaign(short_dipole(**RINGS | {"noise": {"regions": some}}), 1)
                       for some in (regions, [regions[1] | {"sigma_T": 1e-9}]))
    noise = (campaign.readings["B_T"] - quiet.readings["B_T"]).values
    assert noise.std(axis=0) == pytest.approx([1e-4, 1e-4, 1e-3], rel=0.32)
    with pytest.raises(StudyError, match="given for a simulated measurement"):
        simulate_campaign(short_dipole(**RINGS | {"noise": {"position_sd_m": 1e-4}}), 1)


def test_noise_of_fourier_coefficients(dipole):
    """The map's sigma gives every coefficient the region's; the readings have it."""
    study = dipole(array__recoil_permeability=1.0, noise=NOISE, observation={
        "quantity": "fourier_coefficients", "harmonics": 5,
        "positions": {"kind": "circles", "radius_m": 0.075, "angles": 24}})
    data = simulate_campaign(study, 1).readings
    observation = observe(study, points_of(data), ~np.isnan(data["B_T"].values))
    np.testing.assert_allclose(reading_noise(build_magnet(study), observation, data).sd, 1e-4)
    quiet = simulate_campaign(
        study.with_(noise__regions=(study.noise.regions[0].with_(sigma_T=1e-9),)), 1).readings
    noise = (data["B_T"] - quiet["B_T"]).values
    assert np.isnan(noise[:, 2]).all()
    assert np.std(noise[:, :2]) == pytest.approx(1e-4 * np.sqrt(12), rel=0.41)  # 48, 4 sigma
    matrix, *_ = fourier_analysis(points_of(data), study.observation)
    assert (matrix @ np.nan_to_num(noise).ravel()).std() == pytest.approx(1e-4, rel=0.9)  # 10


def test_held_out_points_are_between(short_dipole):
    study = short_dipole(**RINGS)
    points, others = points_from(study.observation.positions), between(study.observation.positions)
    np.testing.assert_allclose(np.unique(others[:, 2].round(12)), [-0.075, -0.025, 0.025, 0.075])
    distance = np.linalg.norm(points[:, None] - others, axis=2)
    nearest = np.hypot(2 * 0.075 * np.sin(np.pi / 32), 0.025)
    assert distance.min() == pytest.approx(nearest)
    two = short_dipole(observation__positions=RINGS["observation__positions"] | {
        "radius_m": [0.05, 0.075]})
    both = between(two.observation.positions)
    np.testing.assert_array_equal(both[len(others):], others)
    assert np.hypot(*both[:len(others), :2].T) == pytest.approx(0.05)
    one = short_dipole(observation__positions={"kind": "points", "points_m": [[0, 0, 0]]})
    assert not len(between(one.observation.positions))
    line = short_dipole(observation__positions={
        "kind": "line", "start_m": [0, 0, 0], "end_m": [0, 0, 0.3], "count": 4})
    np.testing.assert_allclose(between(line.observation.positions)[:, 2], [0.05, 0.15, 0.25])
    grid = short_dipole(observation__positions={
        "kind": "grid", "start_m": [0, 0.01, -0.1], "end_m": [0.02, 0.01, 0.1],
        "count": [2, 1, 3]})
    np.testing.assert_allclose(between(grid.observation.positions),
                               [[0.01, 0.01, -0.05], [0.01, 0.01, 0.05]])
    some = short_dipole(observation__positions={
        "kind": "points", "points_m": [[0, 0, 0], [0, 0, 0.01], [0.05, 0, 0]]})
    np.testing.assert_allclose(between(some.observation.positions), [[0, 0, 0.005], [0.025, 0, 0]])


def test_one_point_has_no_held_out_map(short_dipole, tmp_path):
    study = short_dipole(**RINGS, observation__components=["x"])
    study = study.with_(observation__positions=short_dipole(
        observation__positions={ "kind": "points", "points_m": [[0, 0, 0]]}).observation.positions)
    campaign = simulate_campaign(study, 1)
    assert campaign.held_out is None
    names = {path.name for path in write_campaign(campaign, tmp_path)}
    assert names == {"map.csv", "blocks.csv", "truth.json"}


def test_large_maps_are_hdf5(short_dipole, tmp_path, monkeypatch):
    monkeypatch.setattr("halbach_fe.synthetic.simulate.LARGEST_CSV", 100)
    campaign = simulate_campaign(short_dipole(**RINGS), 1)
    write_campaign(campaign, tmp_path)
    again = read_map(tmp_path / "map.h5")
    xr.testing.assert_identical(again, campaign.readings)
    assert len(read_blocks(tmp_path / "blocks.csv")) == 32


@pytest.mark.parametrize("radius", [0.11, 0.104])
def test_points_inside_of_material_are_refused(short_dipole, radius):
    study = short_dipole(**RINGS)
    inside = {**RINGS["observation__positions"], "radius_m": radius}
    assert simulate_campaign(study, 1).truth["blocks"]
    with pytest.raises(StudyError, match="in air"):
        simulate_campaign(short_dipole(**RINGS | {"observation__positions": inside}), 1)


def test_a_study_can_be_read_and_simulated(campaigns):
    """The nominal field of the truth is near the study's, by its noise-free summary."""
    study, folder, _ = campaigns
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    assert truth["study"] == read_study(study).name
    assert 0.5 < truth["noise_free"]["largest_T"] < 0.65


def test_uncertain_positions_move_the_probe():
    """Two campaigns of one seed differ by the gradient times the displacements of one."""
    study = parse_study(changed(
        DIPOLE, noise={"regions": [{"name": "all", "sigma_T": 1e-9}]},
        array__recoil_permeability=1.0,
        prior={"magnitude_sd": 1e-6, "direction_sd_deg": 1e-4}))  # the nominal gradient holds
    loose = study.with_(noise__position_sd_m=(1e-4, 1e-4, 1e-4))
    points = points_from(study.observation.positions)
    moved = real_places(loose, points, np.random.default_rng(1)) - points
    assert np.std(moved) == pytest.approx(1e-4, rel=0.3)  # 72 draws
    assert real_places(study, points, np.random.default_rng(1)) is points
    one, other = (simulate_campaign(each, 2).readings["B_T"].values for each in (study, loose))
    gradient = gradient_of(build_magnet(study).blocks, points)
    spread = np.sqrt(np.mean((gradient[:, :2] ** 2).sum(axis=2))) * 1e-4
    assert np.sqrt(np.nanmean((one - other)[:, :2] ** 2)) == pytest.approx(spread, rel=0.3)


def test_uncertain_positions_are_along_the_axes_of_a_turned_stage():
    """Of a stage whose z is x of the magnet, readings scatter as `infer` expects, which is compared
    with the exact field elsewhere. They scattered along z of the magnet: that is the control.
    """
    sd, seeds = [1e-7, 1e-7, 1e-4], 40
    known = tomllib.loads(short_dipole.TEXT) | {
        "instrument": {"rotation_rad": [0.0, np.pi / 2, 0.0]},
        "prior": {"magnitude_sd": 1e-9, "direction_sd_deg": 1e-9},
        "observation": {"quantity": "flux_density", "positions": {
            "kind": "points", "points_m": [[-0.035, 0.005, 0.003], [0.03, 0.0, 0.005]]}}}
    exact, study = (parse_study(known | {"noise": {
        "regions": [{"name": "all", "sigma_T": 1e-9}], **noise}})
        for noise in ({}, {"position_sd_m": sd}))
    points = points_from(study.observation.positions)
    shown = simulate_campaign(exact, 1).without_noise
    drawn = [simulate_campaign(study, seed).without_noise - shown for seed in range(seeds)]
    noise, along_magnet = (reading_noise(build_magnet(each), observe(
        each, points, np.ones(points.shape, bool)), field_map(points, shown)).sd.reshape(-1, 3)
        for each in (study, study.with_(noise__position_sd_m=sd[::-1])))
    seen = noise > 1e-6
    # five standard errors of a standard deviation of so many draws
    share = 5 / np.sqrt(2 * seeds)
    ratio = np.sqrt(np.mean(np.square(drawn), axis=0))[seen] / noise[seen]
    assert (np.abs(np.log(ratio)) < share).all()
    assert np.abs(np.log(along_magnet / noise))[seen].max() > 2 * share


def test_elements_that_are_rougher_than_the_noise_are_told():
    """Of the field that permeability adds, an order less is off by what is said, compared with the
    usual order. Controls: with 10 times that noise, and by the usual elements, nothing is said.
    """
    def simulated(sigma_T, order):
        study = parse_study(tomllib.loads(STUDY)).with_(noise={"regions": [
            {"name": "all", "sigma_T": sigma_T}]})
        return simulate_campaign(study, 1, elements=Elements(order=order))

    with pytest.warns(HalbachWarning, match="rougher than its noise of 0.01 µT") as caught:
        rough = simulated(1e-8, 1)
    fine = simulated(1e-5, None)
    off = (rough.without_noise - fine.without_noise)[:, :2]
    said = float(re.search(r"([\d.e-]+) µT at most", str(caught[0].message))[1])
    assert said == pytest.approx(1e6 * np.abs(off).max(), rel=0.3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        simulated(1e-5 * said, 1)
        simulated(1e-5 * said, 5)
