"""Noise: whitening against dense formulas, the posterior with correlated noise against brute force,
and covariances that are none.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy import stats

from halbach_fe.core.errors import MeasurementError
from halbach_fe.stats.gaussian import Gaussian, NoiseCovariance, independent_noise
from halbach_fe.stats.posteriors import Posterior, laplace, update, whitened


def covariance_of(generator, sizes=(3, 1, 2, 3, 4)):
    """Blocks of several sizes, whose readings stand in any order; dense."""
    blocks = []
    for size in sizes:
        root = generator.standard_normal((size, size))
        blocks.append(root @ root.T + 0.1 * np.eye(size))
    order = generator.permutation(sum(sizes))
    return sparse.block_diag(blocks).toarray()[np.ix_(order, order)]


@pytest.fixture
def dense(generator):
    return covariance_of(generator)


@pytest.fixture
def noise(dense):
    return NoiseCovariance(sparse.csr_array(dense))


def test_whitening_against_the_dense_matrix(noise, dense, generator):
    white = noise.whiten(np.eye(len(dense)))
    np.testing.assert_allclose(white @ dense @ white.T, np.eye(len(dense)), atol=1e-12)
    np.testing.assert_allclose(white.T @ white, np.linalg.inv(dense), rtol=1e-9, atol=1e-9)
    values = generator.standard_normal((len(dense), 4))
    np.testing.assert_allclose(noise.whiten(values), white @ values)
    np.testing.assert_allclose(noise.whiten(values[:, 0]), white @ values[:, 0])
    assert noise.log_sqrt_determinant == pytest.approx(np.linalg.slogdet(dense)[1] / 2)
    np.testing.assert_allclose(noise.sd, np.sqrt(np.diag(dense)))
    # the control: without the correlations it is no whitening
    apart = independent_noise(noise.sd).whiten(np.eye(len(dense)))
    assert np.abs(apart @ dense @ apart.T - np.eye(len(dense))).max() > 0.3


def test_independent_noise(generator):
    sd = generator.uniform(0.5, 2, 6)
    noise, values = independent_noise(sd), generator.standard_normal((6, 3))
    assert noise.independent
    np.testing.assert_allclose(noise.whiten(values), values / sd[:, None])
    np.testing.assert_allclose(noise.whiten(values[:, 1]), values[:, 1] / sd)
    assert noise.log_sqrt_determinant == pytest.approx(np.log(sd).sum())
    assert noise.uniform_error_scale == pytest.approx(sd.min())


def test_finest_bounds_what_an_offset_of_all_readings_does(noise, generator):
    """For the worst signs it is reached."""
    rows = noise.whiten(np.eye(len(noise)))
    worst = np.sign(rows[np.argmax(np.abs(rows).sum(axis=1))])
    assert np.abs(noise.whiten(noise.uniform_error_scale * worst)).max() == pytest.approx(1)
    for _ in range(100):
        signs = generator.choice([-1.0, 1.0], len(noise))
        assert np.abs(noise.whiten(noise.uniform_error_scale * signs)).max() < 1 + 1e-12


def test_parts_and_sums(noise, dense):
    some = np.arange(len(dense)) % 3 > 0
    np.testing.assert_allclose(noise.subset(some).covariance.toarray(), dense[np.ix_(some, some)])
    more = noise.with_independent_errors(np.arange(len(dense)) / 10)
    np.testing.assert_allclose(more.covariance.toarray(),
                               dense + np.diag((np.arange(len(dense)) / 10) ** 2))


def test_samples_have_the_covariance(noise, dense, generator):
    """4000 draws know an entry, over the two sd's, to at most 2.2 %; 5 sigma."""
    draws = np.array([noise.sample(generator) for _ in range(4000)])
    scale = np.outer(noise.sd, noise.sd)
    np.testing.assert_allclose(np.cov(draws.T) / scale, dense / scale, atol=0.11)


def test_posterior_with_correlated_noise(noise, dense, generator):
    """Against the formulas as printed; a posterior that ignored the correlations is another."""
    count = len(dense)
    matrix, readings = generator.standard_normal((count, 4)), generator.standard_normal(count)
    prior = Gaussian(generator.standard_normal(4), np.eye(4) + 0.3 * np.ones((4, 4)))
    weight = matrix.T @ np.linalg.inv(dense)
    covariance = np.linalg.inv(weight @ matrix + np.linalg.inv(prior.covariance))
    mean = covariance @ (weight @ readings + np.linalg.solve(prior.covariance, prior.mean))
    found = update(matrix, readings, noise, prior)
    np.testing.assert_allclose(found.distribution.mean, mean, rtol=1e-8)
    np.testing.assert_allclose(found.distribution.covariance, covariance, rtol=1e-7, atol=1e-12)
    predictive = stats.multivariate_normal(
        matrix @ prior.mean, matrix @ prior.covariance @ matrix.T + dense)
    assert found.log_evidence == pytest.approx(predictive.logpdf(readings))
    apart = update(matrix, readings, independent_noise(noise.sd), prior).distribution
    assert np.abs(apart.mean - mean).max() > 0.1 * np.sqrt(np.diag(covariance)).max()


def test_noise_that_others_foretell(dense, noise):
    """Against the dense regression; what is left is independent of the seen."""
    seen = np.arange(len(dense)) % 2 == 0
    told, left = noise.conditional(~seen, seen)
    cross = dense[np.ix_(~seen, seen)]
    expected = cross @ np.linalg.inv(dense[np.ix_(seen, seen)])
    np.testing.assert_allclose(told.toarray(), expected, atol=1e-12)
    np.testing.assert_allclose(left.covariance.toarray(),
                               dense[np.ix_(~seen, ~seen)] - expected @ cross.T, atol=1e-12)
    assert not independent_noise(noise.sd).conditional(~seen, seen)[0].nnz


def test_prediction_of_readings_whose_noise_was_seen_in_others(generator):
    """Two alike components of each of 20 points share most of their noise; one is held out.
    Residuals with what the other foretells taken off are standard normal over many campaigns;
    those taken for independent of the training noise are not.
    """
    matrix = np.repeat(generator.standard_normal((20, 6)), 2, axis=0)
    matrix[1::2] += 0.3 * generator.standard_normal((20, 6))
    prior = Gaussian(np.zeros(6), np.eye(6))
    noise = NoiseCovariance(sparse.csr_array(np.kron(np.eye(20), [[1.0, 0.9], [0.9, 1.0]])))
    seen = np.arange(40) % 2 == 0
    told, left = noise.conditional(~seen, seen)
    right, wrong = [], []
    for truth in prior.sample(400, generator):
        readings = matrix @ truth + noise.sample(generator)
        after = update(matrix[seen], readings[seen], noise.subset(seen), prior).distribution
        residual, root = readings - matrix @ after.mean, matrix @ after.root
        given = root[~seen] - told @ root[seen]
        right.append(whitened(residual[~seen] - told @ residual[seen], left, given.__getitem__, 6))
        wrong.append(whitened(residual[~seen], noise.subset(~seen), root[~seen].__getitem__, 6))
    # 8000 independent values: the rms of a standard normal is 1 +- 0.008; 5 sigma
    assert np.sqrt(np.mean(np.square(right))) == pytest.approx(1.0, abs=0.04)
    assert np.sqrt(np.mean(np.square(wrong))) != pytest.approx(1.0, abs=0.08)


def test_likelihood_with_correlated_noise(noise, dense, generator):
    """The samplers' likelihood is that of the dense covariance; of a linear model Laplace's
    approximation is the posterior.
    """
    count = len(dense)
    matrix, readings = generator.standard_normal((count, 2)), generator.standard_normal(count)
    prior = Gaussian(np.zeros(2), np.eye(2))
    target = Posterior(lambda p: matrix @ p, readings, noise, prior)
    exact = stats.multivariate_normal(readings, dense)
    one, two = generator.standard_normal((2, 2))
    assert target.log_likelihood(one) - target.log_likelihood(two) == pytest.approx(
        exact.logpdf(matrix @ one) - exact.logpdf(matrix @ two))
    reference, mode = laplace(target, lambda p: matrix)
    expected = update(matrix, readings, noise, prior).distribution
    np.testing.assert_allclose(mode, expected.mean, rtol=1e-8)
    np.testing.assert_allclose(reference.root @ reference.root.T, expected.covariance, rtol=1e-8)


def changed(dense, row, column, value):
    result = dense.copy()
    result[row, column] = value
    return result


@pytest.mark.parametrize(("change", "said"), [
    (lambda c: changed(c, 0, np.flatnonzero(c[0])[-1], 9.0), "symmetric"),
    (lambda c: changed(c, 4, 4, -1.0), "positive variances; instead received -1"),
    (lambda c: changed(c, 4, 4, 0.0), "positive variances; instead received 0"),
    (lambda c: changed(c, 4, 4, np.nan), "finite numbers"),
    (lambda c: changed(c, 4, 4, np.inf), "finite numbers"),
    (lambda c: np.ones_like(c), "singular"),
    (lambda c: np.ones_like(c) + 1e-14 * np.eye(len(c)), "singular.*Is sigma far too"),
    (lambda c: 3 * np.ones_like(c) - 2.5 * np.eye(len(c)), "indefinite"),
    (lambda c: c, None), (lambda c: np.ones_like(c) + 1e-9 * np.eye(len(c)), None),
    (lambda c: 1e-20 * c, None)])
def test_covariances_that_are_none(dense, change, said):
    """Refused by name, whatever the unit; their neighbours are not."""
    made = sparse.csr_array(change(dense))
    if said is None:
        NoiseCovariance(made)
        return
    with pytest.raises(MeasurementError, match=f"covariance of the noise must be .*{said}"):
        NoiseCovariance(made)


@pytest.mark.parametrize("wrong", [-1e-4, 0.0, np.nan, np.inf])
def test_standard_deviations_that_are_none(wrong):
    with pytest.raises(MeasurementError, match="standard deviation of reading 2 of the noise"):
        independent_noise(np.array([1e-4, wrong]))
