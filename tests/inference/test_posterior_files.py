"""Stored results are taken for those of the same magnet only, and only as they were written."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

from halbach_fe.api import homogeneity, multipoles
from halbach_fe.core.errors import HalbachWarning, MeasurementError, OutputError, StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference import mcmc
from halbach_fe.inference.infer import infer
from halbach_fe.inference.mcmc import _Run
from halbach_fe.inference.posterior_files import disagreement_of, read_posterior, write_inference
from halbach_fe.inference.result import Reservation
from halbach_fe.measurement.field_map import field_map
from halbach_fe.response import response_matrix as matrix_module
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.session import NOT_KEPT
from tests.conftest import circle

NOISE = {"regions": [{"name": "bore", "sigma_T": 1e-4}]}


@pytest.fixture
def inferred(dipole, session):
    """The update of a dipole in vacuum by its own field, which needs no solve."""
    study = dipole(noise=NOISE, array__recoil_permeability=1.0, observation__components=["x", "y"])
    magnet = build_magnet(study)
    field = field_of(magnet.blocks, circle(0.07, 24))
    field[:, 2] = np.nan
    update = infer(magnet, field_map(circle(0.07, 24), field), session)
    write_inference(update, session.folder)
    return update, session.folder / "posterior.h5"


def measured_again(update, path, generator):
    """Return the update by readings with their noise, which agrees with them, and its path."""
    field = field_of(update.magnet.blocks, circle(0.07, 24))
    field += NOISE["regions"][0]["sigma_T"] * generator.standard_normal(field.shape)
    field[:, 2] = np.nan
    return infer(update.magnet, field_map(circle(0.07, 24), field), NOT_KEPT), path


def test_posterior_of_the_same_magnet(inferred):
    """Whatever else differs, such as the mesh or what is measured."""
    update, path = inferred
    study = update.study.with_(
        name="other", mesh__block_size_m=0.01, noise=None,
        external={"background_T": [1e-5, 0, 0]})
    found = read_posterior(build_magnet(study), path)
    np.testing.assert_array_equal(found["posterior"].mean, update.posterior.mean)


@pytest.mark.parametrize(("changes", "key"), [
    ({"instrument__rotation_rad": (0.0, 0.0, 0.01)}, "instrument.rotation_rad"),
    ({"noise__regions": [{"name": "all", "sigma_T": 2e-3}]}, "noise.regions"),
    ({"external__background_T": (1e-4, 0.0, 0.0)}, "external.background_T"),
    ({"prior__magnitude_sd": 0.002}, "prior.magnitude_sd"),
    ({"mesh__block_size_m": 0.01, "prior__types": {"a": [*range(1, 17)]}, "name": "other"}, None)])
def test_posterior_of_another_version_of_the_study_says_so(inferred, generator, changes, key):
    """What was inferred of another place of the map, say, is no update of this study."""
    update, path = measured_again(*inferred, generator)
    write_inference(update, path.parent)
    magnet = build_magnet(update.study.with_(**changes))
    for said in (read_posterior(magnet, path).disagreement, disagreement_of(update, magnet)):
        assert isinstance(said, Reservation)
        assert said == ("" if key is None else (
            f"Only of another version of the study, with another `{key}`."))


@pytest.mark.parametrize(("shift_sd_m", "changes", "key"), [
    (0.0, {"file": "elsewhere/b.csv"}, None),
    (0.0, {"instrument": {"translation_m": (0.0, 0.0, 1e-3)}}, "maps"),
    (5e-3, {"file": "elsewhere/b.csv"}, None),
    (5e-3, {"instrument": {"translation_m": (0.0, 0.0, 1e-3)}}, None)])
def test_versions_of_a_study_that_lists_maps(inferred, generator, shift_sd_m, changes, key):
    """Where its files are makes no difference, nor where a map lies if the update estimated its
    shift along the stage: a study with what was found is the same one.
    """
    update, _ = measured_again(*inferred, generator)

    def magnet(**own):
        maps = [{"name": name, "file": f"{name}.csv", "stage": "table"} for name in "ab"]
        maps[1] |= {"stage_shift_sd_m": (0.0, 0.0, shift_sd_m)} | own
        return build_magnet(update.study.with_(maps=maps))

    of_maps = replace(update, magnet=magnet())
    said = disagreement_of(of_maps, magnet(**changes))
    assert said.startswith("" if key is None else (
        f"Only of another version of the study, with another `{key}"))
    assert bool(said) == bool(key)


@pytest.mark.parametrize(("changes", "key"), [
    ({"array__inner_radius_m": 0.1}, "array.inner_radius_m"),
    ({"array__block": {"shape": "trapezoid"}}, "array.block.shape"),
    ({"array__recoil_permeability": 1.05}, "array.recoil_permeability"),
    ({"array__remanence_T": 1.07}, "array.remanence_T"),
    ({"iron_ring": {"inner_radius_m": 0.19, "outer_radius_m": 0.2,
                    "relative_permeability": 1000.0}}, "iron_ring"),
], ids=["radius", "shape", "permeability", "remanence", "iron"])
def test_posterior_of_another_magnet(inferred, dipole, changes, key):
    """Even where its blocks are magnetized alike."""
    _, path = inferred
    other = dipole(**{"noise": NOISE, "array__recoil_permeability": 1.0} | changes)
    with pytest.raises(MeasurementError, match=f"another magnet, with another `{key}`"):
        read_posterior(build_magnet(other), path)


def test_results_of_another_magnet(inferred, dipole, short_dipole, session):
    """In Python too, and whatever it shares with the magnet."""
    update, _ = inferred
    alike = build_magnet(dipole(array__remanence_T=1.07, array__recoil_permeability=1.0))
    larger = build_magnet(short_dipole(noise=NOISE, array__recoil_permeability=1.0))
    known, data = {"posterior": update.posterior}, field_map([[0, 0, 0]], [[0.1, 0, 0]])
    for use, said in (
        (lambda: multipoles(alike, session, posterior=update), "with another `array.remanence_T`"),
        (lambda: multipoles(larger, session, posterior=known), "96 parameters.*received 32"),
        (lambda: multipoles(alike, session, posterior="posterior.h5"), "received a str"),
        (lambda: homogeneity(larger, session, posterior=update), "another `dimension`"),
        (lambda: homogeneity(larger, session, posterior=known), "96 parameters"),
        (lambda: infer(larger, data, session, prior=update.posterior), "96 parameters"),
        (lambda: infer(alike, data, session, prior=np.zeros(32)), "a Gaussian.*a ndarray"),
    ):
        with pytest.raises((MeasurementError, StudyError), match=said):
            use()
    assert multipoles(update.magnet, session, posterior=update).tables


def test_changed_posterior(inferred):
    update, path = inferred
    with h5py.File(path, "r+") as file:
        file["posterior_mean"][3] += 1e-3
    with pytest.raises(OutputError, match="differs from its checksum") as raised:
        read_posterior(update.magnet, path)
    assert raised.value.exit_code == 8


def test_another_hdf5_file_as_a_posterior(inferred, tmp_path):
    """It is no posterior, rather than a changed one."""
    update, _ = inferred
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["values"] = np.ones(3)
    with pytest.raises(MeasurementError, match=r"a posterior\.h5 that halbach-fe infer wrote"):
        read_posterior(update.magnet, tmp_path / "other.h5")


def points_observed(update):
    return update.magnet, update.observation


def test_changed_response(inferred, session):
    """It is computed again, with a sentence: whether the matrix is in the file or beside it."""
    update, _ = inferred
    path = session.folder / "response.h5"
    assert response_matrix(*points_observed(update), session).reused
    with h5py.File(path, "r+") as file:
        file["H"][0, 0] *= 1 + 1e-15
    with pytest.warns(HalbachWarning, match="response.h5 cannot be used"):
        again = response_matrix(*points_observed(update), session)
    assert not again.reused
    np.testing.assert_array_equal(again.matrix, update.response.matrix)
    assert response_matrix(*points_observed(update), session).reused


def test_changed_matrix_beside(inferred, session, monkeypatch):
    update, _ = inferred
    monkeypatch.setattr(matrix_module, "LOADED_BYTES", 1000)
    (session.folder / "response.h5").unlink()
    parts = response_matrix(*points_observed(update), session)
    assert response_matrix(*points_observed(update), session).reused
    content = bytearray(parts.matrix.path.read_bytes())
    content[-3] ^= 1
    parts.matrix.path.write_bytes(content)
    with pytest.warns(HalbachWarning, match="differs from its checksum"):
        assert not response_matrix(*points_observed(update), session).reused


@pytest.mark.parametrize(("group", "name"), [("posterior", "magnetization"), ("state", "last")])
def test_changed_chains(tmp_path, group, name):
    """Sampling starts anew, with a sentence."""
    path = tmp_path / "chains.nc"

    def runs():
        return [_Run(np.random.default_rng(n), np.zeros(2), np.ones((5, 2)), 0.3)
                for n in range(2)]

    mcmc._store(path, "key", runs(), ("a", "b"), 7)
    assert mcmc._resume(path, "key", runs(), 2) == 7
    assert mcmc._resume(path, "other key", runs(), 2) == 0
    with h5py.File(path, "r+") as file:
        file[group][name][(0,) * file[group][name].ndim] += 1e-9
    with pytest.warns(HalbachWarning, match="starts anew"):
        assert mcmc._resume(path, "key", runs(), 2) == 0
