"""Many parameters, many readings: the same posterior without any matrix of all of them."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy import stats

from halbach_fe.core.errors import HalbachWarning
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.posterior_files import read_posterior, write_inference
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.response import response_matrix as response_module
from halbach_fe.response.response_matrix import StoredMatrix, response_matrix
from halbach_fe.stats import posteriors
from halbach_fe.stats.gaussian import (
    CovarianceFactor,
    Gaussian,
    NoiseCovariance,
    independent_noise,
    nominal_prior,
)
from halbach_fe.stats.posteriors import update, whitened
from halbach_fe.study.reader import parse_study
from tests.oracles.cuboids import cuboid_field, long_dipole
from tests.support.pages import write_result


def correlated(generator, count):
    """Noise of readings by three, those of a point, that err together."""
    lower = np.tril(generator.standard_normal((count // 3, 3, 3))) + 3 * np.eye(3)
    blocks = 0.01 * lower @ lower.transpose(0, 2, 1)
    number = np.arange(len(blocks) + 1)
    return NoiseCovariance(sparse.csr_array(sparse.bsr_array((blocks, number[:-1], number))))


def problem(generator, readings, blocks):
    """Smooth fields of blocks in a row, one of them missing, with a common mode."""
    nominal = np.tile([1.0, 0.2, 0.0], blocks) * np.where(np.arange(3 * blocks) // 3 == 2, 0, 1)
    prior = nominal_prior(nominal, 3, 0.1, 3.0, 0.05)
    place = np.linspace(0, 1, readings)[:, None] - np.linspace(0, 1, 3 * blocks)
    matrix = np.exp(-(place / 0.1) ** 2)
    noise = correlated(generator, readings)
    truth = prior.sample(1, generator)[0]
    return matrix, matrix @ truth + noise.sample(generator), noise, prior


def dense(matrix, readings, noise, prior):
    """Mean, covariance, evidence, learnt and conflict by the formula for the readings' own
    covariance, whose matrices are all there.
    """
    predictive = matrix @ prior.covariance @ matrix.T + noise.covariance.toarray()
    gain = np.linalg.solve(predictive, matrix @ prior.covariance).T
    residual = readings - matrix @ prior.mean
    covariance = prior.covariance - gain @ matrix @ prior.covariance
    learnt = np.trace(np.linalg.solve(predictive, predictive - noise.covariance.toarray()))
    evidence = stats.multivariate_normal(matrix @ prior.mean, predictive).logpdf(readings)
    return (prior.mean + gain @ residual, covariance, evidence, learnt,
            residual @ np.linalg.solve(predictive, residual) / len(readings))


def farthest(case, found):
    """Largest difference from `dense`: of means in prior standard deviations, of standard
    deviations relative to them, of the figures relative.
    """
    mean, covariance, *figures = dense(*case)
    there = case[3].sd > 0
    scale = case[3].sd[there]
    off = [np.abs(found.distribution.mean - mean)[there] / scale,
           np.abs(found.distribution.sd - np.sqrt(np.diag(covariance).clip(0)))[there] / scale,
           np.abs(found.distribution.covariance - covariance)[there][:, there]
           / np.outer(scale, scale)]
    return max([one.max() for one in off] + [
        abs(one / other - 1) for one, other in zip(
            (found.log_evidence, found.parameters_learnt, found.prior_conflict), figures,
            strict=True)])


@pytest.mark.parametrize(("readings", "blocks"), [(60, 100), (600, 30), (300, 100)])
def test_against_the_dense_formula(generator, readings, blocks):
    """With correlated noise, a common mode, and a block that is missing, whose prior is singular.

    The formula subtracts covariances; 1e-9 is what rounding leaves of that here.
    """
    case = problem(generator, readings, blocks)
    found = update(*case)
    assert farthest(case, found) < 1e-9
    assert found.discarded_information == 0
    assert np.all(found.distribution.sd[6:9] == 0)
    # negative control: 1 % less noise
    matrix, values, noise, prior = case
    other = update(matrix, values, NoiseCovariance(0.98 * noise.covariance), prior)
    assert farthest(case, other) > 1e-3


@pytest.mark.parametrize("blocks", [30, 200])
def test_in_parts_and_compressed(generator, monkeypatch, blocks):
    """Parts of 7 readings, which split those of a point; and no more held than 100 rows: of few
    parameters without any loss, of many without those combinations of readings that say nothing.
    """
    case = problem(generator, 600, blocks)
    monkeypatch.setattr(posteriors, "READINGS_AT_ONCE", 7)
    monkeypatch.setattr(posteriors, "NUMBERS_HELD", 100 * 3 * blocks)
    monkeypatch.setattr(posteriors, "WORST_CONDITION", 0.0)  # by rows in any case
    found = update(*case)
    assert (found.discarded_information > 0) == (blocks == 200)
    # what is left out bounds the change of variances; of the mean it is its root that does
    assert found.discarded_information < 1e-6
    assert farthest(case, found) < max(1e-9, 3 * np.sqrt(found.discarded_information))
    root = found.distribution.root
    assert isinstance(root, CovarianceFactor)
    assert root.directions.shape[1] <= min(600, 3 * blocks + 1)
    if blocks == 200:  # negative control: what says something must not be left out
        monkeypatch.setattr(posteriors, "NEGLIGIBLE", 0.5)
        coarse = update(*case)
        assert coarse.discarded_information > 0.1
        assert farthest(case, coarse) > 1e-2


def test_parts_that_cut_correlations_are_wrong(generator, monkeypatch):
    """Negative control: every part whitened by itself, as if its readings' noise had nothing to do
    with that of the next part.
    """
    matrix, readings, noise, prior = problem(generator, 60, 30)
    monkeypatch.setattr(posteriors, "READINGS_AT_ONCE", 7)
    part = np.arange(60) // 7
    entries = noise.covariance.tocoo()
    rows, columns = entries.coords
    same = part[rows] == part[columns]
    cut = NoiseCovariance(sparse.csr_array((entries.data[same], (rows[same], columns[same]))))
    case = matrix, readings, noise, prior
    assert farthest(case, update(*case)) < 1e-9
    assert farthest(case, update(matrix, readings, cut, prior)) > 1e-3


def test_whitened_residuals_of_many_parameters(generator, monkeypatch):
    """Against the eigenvectors of the dense covariance; a root 10 % too large is seen."""
    matrix, readings, noise, prior = problem(generator, 60, 100)
    residual, root = readings - matrix @ prior.mean, matrix @ prior.root
    covariance = root @ root.T + noise.covariance.toarray()
    white = noise.whitening.toarray()
    values, vectors = np.linalg.eigh(white @ covariance @ white.T)
    expected = (vectors / np.sqrt(values)) @ vectors.T @ (white @ residual)
    monkeypatch.setattr(posteriors, "READINGS_AT_ONCE", 7)
    columns = root.shape[1]
    np.testing.assert_allclose(whitened(residual, noise, root.__getitem__, columns), expected,
                               atol=1e-9)
    larger = whitened(residual, noise, (1.1 * root).__getitem__, columns)
    assert np.abs(larger - expected).max() > 1e-3


class Made:
    """A matrix (count, columns) whose rows are made when they are asked for."""

    def __init__(self, count, columns):
        self.shape = count, columns

    def __len__(self):
        return self.shape[0]

    def __getitem__(self, rows):
        return np.sin(np.outer(rows + 1.0, np.arange(self.shape[1]) + 0.5))


def peak(work):
    """Most bytes that numpy held meanwhile."""
    tracemalloc.start()
    work()
    found = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found


def test_memory_does_not_grow_with_readings_times_parameters(monkeypatch):
    monkeypatch.setattr(posteriors, "READINGS_AT_ONCE", 500)
    prior = Gaussian(np.zeros(120), np.eye(120))

    def used(count):
        noise, readings = independent_noise(np.ones(count)), np.zeros(count)
        return peak(lambda: update(Made(count, 120), readings, noise, prior))

    few, many = used(10_000), used(20_000)
    # of a reading some numbers are kept, of its row nothing: 120 numbers would be 960 bytes
    assert (many - few) / 10_000 < 100
    # negative control: the whole matrix
    assert peak(lambda: Made(20_000, 120)[np.arange(20_000)]) > 120 * 20_000 * 8


def test_a_matrix_on_the_disk(monkeypatch, session, tmp_path):
    """One that is too large for the memory: the same rows, reused, and made anew if it is gone."""
    document = long_dipole(2, 5)
    study = parse_study(document)
    points = points_from(study.observation.positions)
    observation = observe(study, points, np.ones_like(points, bool))
    whole = response_matrix(build_magnet(study), observation, session)
    monkeypatch.setattr(response_module, "LOADED_BYTES", 1000)
    monkeypatch.setattr(posteriors, "NUMBERS_AT_ONCE", 700)
    (session.folder / "response.h5").unlink()
    parts = response_matrix(build_magnet(study), observation, session)
    assert isinstance(parts.matrix, StoredMatrix)
    scale = np.abs(whole.matrix).max()
    # panels of the exact field depend on the points that are taken together: 1e-12
    np.testing.assert_allclose(parts.matrix[np.arange(len(observation))], whole.matrix,
                               atol=1e-11 * scale)
    np.testing.assert_allclose(parts.matrix @ parts.nominal, whole.matrix @ whole.nominal,
                               atol=1e-12)
    again = response_matrix(build_magnet(study), observation, session)
    assert again.reused
    np.testing.assert_array_equal(again.matrix[np.arange(9)], parts.matrix[np.arange(9)])
    parts.matrix.path.write_bytes(b"")
    with pytest.warns(HalbachWarning, match="is computed again"):
        assert not response_matrix(build_magnet(study), observation, session).reused
    assert len(list(session.folder.glob("response-*.npy"))) == 1


@pytest.fixture
def long_array(generator, session):
    """The update of 2 000 blocks with a map of 252 readings by magpylib; and the truth."""
    document = long_dipole(125, 21, angles=4)
    study = parse_study(document)
    nominal = np.array([block.magnetization for block in build_magnet(study).blocks])
    truth = nominal_prior(nominal.ravel(), 3, 0.01, 1.0, 0.005).sample(1, generator)[0]
    points = points_from(study.observation.positions)
    field = cuboid_field(document, truth.reshape(-1, 3), points)
    field += 5e-5 * generator.standard_normal(field.shape)
    return infer(build_magnet(study), field_map(points, field), session), truth


def test_two_thousand_blocks(long_array, tmp_path):
    """Truth by magpylib: what was held out is predicted as well as is said; files stay small."""
    update, truth = long_array
    unseen = update.scores[1]
    # 48 readings: sd 0.2
    assert unseen.chi2_posterior == pytest.approx(1.0, abs=0.8)
    score = (update.posterior.mean - truth) / update.posterior.sd
    # 6000 values, of which the prior draws most: 1 +- 0.01, but for the common mode that they share
    assert np.sqrt(np.mean(score**2)) == pytest.approx(1.0, abs=0.1)
    assert 100 < update.parameters_learnt < 204
    root = update.posterior.root
    assert isinstance(root, CovarianceFactor)
    assert root.directions.shape == (6001, 204)
    write_inference(update, tmp_path)
    # far below the 288 MB of one covariance
    assert Path(tmp_path / "posterior.h5").stat().st_size < 20e6
    stored = read_posterior(build_magnet(update.study), tmp_path / "posterior.h5")
    for name, one in (("prior", update.prior), ("posterior", update.posterior)):
        np.testing.assert_allclose(stored[name].mean, one.mean)
        np.testing.assert_allclose(stored[name].sd, one.sd)
    assert np.abs(stored["posterior"].sd - stored["prior"].sd).max() > 0.01 * update.prior.sd.max()
    write_result(update, tmp_path)
    assert Path(tmp_path / "report.html").stat().st_size < 15e6


def test_exact_readings_of_many_parameters(generator):
    """Noise of a millionth of the prior: what readings leave of their own prediction is theirs."""
    parameters, readings = 120, 40
    prior = Gaussian(np.zeros(parameters), CovarianceFactor(
        sparse.eye_array(parameters, format="csr"), np.zeros((parameters, 0)), np.zeros(0)))
    matrix = generator.standard_normal((readings, parameters))
    noise = 1e-6
    found = update(matrix, np.zeros(readings), independent_noise(np.full(readings, noise)), prior)
    np.testing.assert_allclose(found.distribution.sd_of(matrix), noise, rtol=1e-4)
    # the control: squares subtracted from squares leave rounding
    root = found.distribution.root
    seen = matrix @ root.outer
    along = seen @ root.directions
    lost = np.sqrt(np.maximum(0, (seen**2).sum(1) - (along**2).sum(1)) + (
        (along * root.remaining) ** 2).sum(1))
    assert np.abs(lost / noise - 1).max() > 1e-3
