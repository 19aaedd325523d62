"""The non-linear posterior of a cross-section with steel: truth by NGSolve, chains by us."""

from __future__ import annotations

import contextlib
import multiprocessing
import shutil
import tomllib
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import ngsolve
import numpy as np
import pytest
import xarray as xr

from halbach_fe.cli import main
from halbach_fe.core.errors import OutputError, SamplingError, StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference import mcmc
from halbach_fe.inference.infer import infer
from halbach_fe.inference.mcmc import (
    _resume,
    _Run,
    _store,
    sample_posterior,
    with_samples,
    write_sampled,
)
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.ngsolve_reaction import Elements, mesh_of
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import circle
from tests.oracles import ngsolve_nonlinear

SPREAD = 0.02
STUDY_FILE = """
name = "steel"
dimension = 2
[array]
blocks_per_ring = 16
inner_radius_m = 0.104
outer_radius_m = 0.1865
first_block_angle_deg = 90.0
first_magnetization_angle_deg = 180.0
recoil_permeability = 1.05
remanence_T = 1.06
block = { shape = "sector" }
[iron_ring]
inner_radius_m = 0.19
outer_radius_m = 0.2
[iron_ring.curve]
kind = "froehlich_kennelly"
initial_relative_permeability = 1000.0
saturation_polarization_T = 2.0
[mesh]
block_size_m = 0.04
[observation]
quantity = "flux_density"
components = ["x", "y"]
positions = { kind = "circles", radius_m = 0.075, angles = 24 }
[[noise.regions]]
name = "all"
sigma_T = 1e-4
[prior]
magnitude_sd = 0.02
direction_sd_deg = 1.146
"""


@pytest.fixture(scope="module", autouse=True)
def models_built_once():
    """Build and verify the model of a study once for all chains of this file.

    It is the same every time, which `tests/response/test_nonlinear.py` checks; a study by another
    name has a model of its own.
    """
    built, build = {}, mcmc.nonlinear_model

    def once(magnet, *arguments):
        if magnet.name not in built:
            built[magnet.name] = build(magnet, *arguments)
        return built[magnet.name]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcmc, "nonlinear_model", once)
        yield


@pytest.fixture(scope="module")
def campaign(getdp, tmp_path_factory):
    """Study, truth, and the linearized update of a map by NGSolve; blocks 2 % and 1.1 deg off."""
    study = parse_study(tomllib.loads(STUDY_FILE) | {"name": "campaign"})
    generator = np.random.default_rng(20231)
    nominal = np.array([block.magnetization[:2] for block in build_magnet(study).blocks])
    truth = nominal + SPREAD * np.linalg.norm(nominal[0]) * generator.standard_normal(nominal.shape)
    points = np.vstack([circle(0.075, 30), circle(0.06, 20, start=0.1)])
    magnet = magnet_of(study).with_magnetizations(truth)
    with ngsolve.TaskManager():
        field = ngsolve_nonlinear.section_field(
            magnet, mesh_of(magnet, points, Elements(0.02)), 4, points)
    field[:, :2] += 1e-4 * generator.standard_normal((len(points), 2))
    field[:, 2] = np.nan
    data = field_map(points, field)
    folder = tmp_path_factory.mktemp("sampled")
    session = Session(getdp, folder / "work", jobs=2)
    return study, truth.ravel(), data, infer(build_magnet(study), data, session), session


def room(session, name):
    return replace(session, folder=session.folder / name)


@pytest.fixture(scope="module")
def found(campaign):
    """Chains of 1000 draws; what was stored of them after 750 is kept as chains-750.nc."""
    folder = room(campaign[4], "undisturbed")

    def keep(text):
        if text.startswith("750"):
            shutil.copy(folder.folder / "chains.nc", folder.folder / "chains-750.nc")

    return sample_posterior(campaign[3], folder, 1000, say=keep)


def draws_in(path):
    """Draws (chains, draws, parameters) of a file of chains, with those of the burn-in."""
    with xr.open_dataset(path, group="posterior", engine="h5netcdf") as stored:
        return stored["magnetization"].values


def test_chains_converge_on_the_truth(campaign, found):
    """32 values: the rms of error over sd is 1 +- 0.13 for a posterior that is right; 4 sigma."""
    truth = campaign[1]
    score = (found.mean - truth) / found.sd
    assert np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.5)
    assert found.agreement_T < 1e-8
    updated = with_samples(campaign[3], found)
    np.testing.assert_allclose(updated.posterior.sd, found.sd, rtol=1e-3)
    residual = (updated.readings - updated.prediction_posterior.mean) / updated.sigma
    assert np.sqrt(np.mean(residual**2)) < 1.3


def test_stored_for_arviz(campaign, found):
    write_sampled(found, campaign[4].folder)
    assert len((campaign[4].folder / "sampled.csv").read_text().splitlines()) == 33
    path = campaign[4].folder / "undisturbed" / "chains.nc"
    with xr.open_dataset(path, group="posterior", engine="h5netcdf") as stored:
        assert stored["magnetization"].dims == ("chain", "draw", "parameter")
    np.testing.assert_array_equal(draws_in(path)[:, 100:], found.draws)


def test_interrupted_chains_go_on(campaign, found):
    """What an interrupted run stored is used, and the result is that of an undisturbed one, also
    if the chains go on at a time, in processes of their own, to which the model travels.

    Two stored chunks suffice, one before and one after the interruption. They may be too short to
    have converged, so that the stored draws are compared.
    """
    session = room(campaign[4], "interrupted")

    def interrupt(text):
        if text.startswith("250"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample_posterior(campaign[3], session, 500, say=interrupt)
    said: list[str] = []
    with (ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool,
          contextlib.suppress(SamplingError)):
        sample_posterior(campaign[3], session, 500, say=said.append, mapped=pool.map)
    assert said[1].startswith("500")
    undisturbed = draws_in(campaign[4].folder / "undisturbed" / "chains.nc")
    again = draws_in(session.folder / "chains.nc")
    np.testing.assert_array_equal(again, undisturbed[:, :500])
    assert not np.array_equal(again, undisturbed[:, 500:])  # the control


def test_longer_chains_go_on_from_shorter_ones_and_other_readings_do_not(campaign, found):
    """Draws are added; a map with other noise starts anew (the control)."""
    session = room(campaign[4], "longer")
    session.folder.mkdir()
    shutil.copy(campaign[4].folder / "undisturbed" / "chains.nc", session.folder)
    said: list[str] = []
    more = sample_posterior(campaign[3], session, 1050, say=said.append)
    assert said[1].startswith("1050")
    np.testing.assert_array_equal(more.draws[:, :895], found.draws[:, 5:])
    other = replace(campaign[3], readings=campaign[3].readings + 1e-6)
    said.clear()
    with pytest.raises(SamplingError, match=r"effective samples|do not agree|cannot be judged"):
        sample_posterior(other, session, 50, effective=1e9, say=said.append)
    assert said[1].startswith("50 of 50")


def test_chains_in_another_external_field_start_anew(campaign):
    """A background is in the readings alone, not in the iron; the stored chains were taken up."""
    update = campaign[3]
    model = mcmc.nonlinear_model(
        update.magnet, update.observation, room(campaign[4], "undisturbed"),
        np.random.default_rng(1), update.prior)
    own, again, other = (mcmc._key(update, replace(model, offset=model.offset + change), 4, 1)
                         for change in (0.0, 0.0, 5e-5))
    assert own == again != other


def test_too_few_draws_are_refused(campaign):
    with pytest.raises(SamplingError, match=r"effective samples|do not agree"):
        sample_posterior(campaign[3], room(campaign[4], "short"), 20)
    with pytest.raises(SamplingError, match="at least 20"):
        sample_posterior(campaign[3], room(campaign[4], "short"), 3)


def test_samples_from_the_command_line(campaign, found, tmp_path, capsys):
    """The summary says that the posterior is sampled; short chains leave none, which would answer
    as if it were the one asked for.

    The command has the model, the readings and the seed of the chains above, so that it goes on
    from what is stored of them, and ends where they do.
    """
    write_map(campaign[2], tmp_path / "map.csv")
    (tmp_path / "study.toml").write_text(STUDY_FILE)
    command = ["infer", str(tmp_path / "study.toml"), "--measurements",
               str(tmp_path / "map.csv"), "-o", str(tmp_path / "out"), "--json", "--samples"]
    assert main([*command, "20"]) == 10
    refused = main(["multipoles", str(tmp_path / "study.toml"), "--posterior",
                    str(tmp_path / "out" / "posterior.h5"), "-o", str(tmp_path / "multipoles")])
    assert refused == 4
    assert not list((tmp_path / "out").glob("summary.json"))
    capsys.readouterr()
    (chains,) = (tmp_path / "out").rglob("chains.nc")
    shutil.copy(campaign[4].folder / "undisturbed" / "chains-750.nc", chains)
    assert main([*command, "1000"]) == 0
    out = capsys.readouterr()
    assert "1000 of 1000 draws" in out.err
    assert "250 of 1000 draws" not in out.err
    np.testing.assert_array_equal(draws_in(chains)[:, 100:], found.draws)
    assert '"posterior": "samples"' in out.out
    assert "needs the non-linear posterior" not in out.err
    assert (tmp_path / "out" / "sampled.json").exists()
    assert "samples" in (tmp_path / "out" / "report.html").read_text()


def test_a_linear_study_needs_no_samples(campaign, tmp_path, capsys):
    write_map(campaign[2], tmp_path / "map.csv")
    (tmp_path / "study.toml").write_text("""
name = "linear"
dimension = 2
[array]
blocks_per_ring = 16
inner_radius_m = 0.104
outer_radius_m = 0.1865
remanence_T = 1.06
block = { shape = "sector" }
[mesh]
block_size_m = 0.02
[observation]
quantity = "flux_density"
positions = { kind = "circles", radius_m = 0.075, angles = 24 }
[[noise.regions]]
name = "all"
sigma_T = 1e-4
""")
    code = main(["infer", str(tmp_path / "study.toml"), "--measurements",
                 str(tmp_path / "map.csv"), "-o", str(tmp_path / "out"), "--samples", "10"])
    assert code == 3
    assert "closed form" in capsys.readouterr().err


@pytest.mark.parametrize(("more", "said"), [
    ({"external": {"neighbours": [{"z_m": 0.3}]}}, r"external\.neighbours.*Leave --samples out"),
    ({"instrument_sd": {"gain": 0.01}}, "instrument_sd.*left out, for --samples"),
    ({"external": {"background_T": [0.0, 1e-4, 0.0]}, "uncertain": [
        {"name": "field", "sd": 1e-4, "change": {"external.background_T[2]": 1.0}}]},
     "uncertain.*left out, for --samples")])
def test_chains_have_no_parameters_but_blocks(more, said):
    """An update without chains estimates the others, blocks of neighbours too: chains do not."""
    table = tomllib.loads(STUDY_FILE)
    table |= {"dimension": 3, "array": table["array"] | {"ring_length_m": 0.1},
              "iron_ring": table["iron_ring"] | {"length_m": 0.1}}
    mcmc.check_sampling(build_magnet(parse_study(table)))  # the control
    with pytest.raises(StudyError, match=said):
        mcmc.check_sampling(build_magnet(parse_study(table | more)))


@pytest.mark.parametrize("small_disk", [64], indirect=True)
def test_chains_on_a_full_disk(small_disk):
    """The HDF5 library must not crash, and what was stored before stays whole."""
    def runs(draws):
        return [_Run(np.random.default_rng(seed), np.ones(2), np.full((draws, 2), seed, float))
                for seed in (1, 2)]

    path, names = small_disk / "chains.nc", ("a", "b")
    _store(path, "key", runs(10), names, 7)
    with pytest.raises(OutputError, match="No space left"):
        _store(path, "key", runs(10_000), names, 8)
    assert [one.name for one in small_disk.iterdir()] == ["chains.nc"]
    assert _resume(path, "key", runs(0), 2) == 7
