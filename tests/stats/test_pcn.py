"""Samplers on problems whose posterior is known, and the proof that wrong ones would be noticed."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.core.errors import SamplingError
from halbach_fe.stats.gaussian import Gaussian, independent_noise
from halbach_fe.stats.posteriors import (
    ConvergenceDiagnostics,
    Posterior,
    Proposal,
    assess_convergence,
    laplace,
    prior_reference,
    require_convergence,
    sample,
    update,
)
from studies.calibration.truth_ranks import ranks, uniformity

SIZE = 3


def linear_problem(generator, sigma=0.5):
    matrix = generator.standard_normal((6, SIZE))
    prior = Gaussian(np.array([3.0, -2.0, 1.0]), np.diag([1.0, 0.5, 2.0]))
    readings = matrix @ prior.sample(1, generator)[0] + sigma * generator.standard_normal(6)
    noise = independent_noise(np.full(6, sigma))
    posterior = Posterior(lambda p: matrix @ p, readings, noise, prior)
    return posterior, matrix


def bent_problem(generator):
    """A model that is far from linear over its prior, and a posterior that is no Gaussian."""
    prior = Gaussian(np.array([1.0, 0.5]), np.eye(2))

    def model(p):
        return np.array([p[0] + 0.5 * p[1] ** 2, p[1]])

    def jacobian(p):
        return np.array([[1.0, p[1]], [0.0, 1.0]])

    readings = np.array([1.5, 0.6])
    return Posterior(model, readings, independent_noise(np.array([0.3, 1.0])), prior), jacobian


def run(posterior, reference, step, count, generator, start=None, **options):
    start = np.zeros(reference.root.shape[1]) if start is None else start
    return sample(posterior, [Proposal(reference, step)], count, generator, start, **options)


def printed_pcn(prior, step, count, generator):
    """The proposal as the paper prints it, about 0 and with s C_0, everything accepted."""
    p, samples = prior.mean, []
    for _ in range(count):
        p = np.sqrt(1 - step**2) * p + np.sqrt(step) * prior.root @ generator.standard_normal(
            prior.root.shape[1])
        samples.append(p)
    return np.array(samples)


def test_pcn_leaves_the_prior_invariant(generator):
    """With the likelihood switched off; centred on the prior's mean, which is not zero."""
    prior = Gaussian(np.array([3.0, -2.0]), np.array([[1.0, 0.0], [0.4, 0.5]]))
    flat = Posterior(lambda p: np.zeros(1), np.zeros(1), independent_noise(np.ones(1)), prior)
    chain = run(flat, prior_reference(prior), 0.8, 20_000, generator)
    assert chain.accepted == 1.0
    # autocorrelation 0.6 a step: 1/4 of the samples count; 5 sigma
    assert chain.samples.mean(axis=0) == pytest.approx(prior.mean, abs=5 / np.sqrt(5000))
    np.testing.assert_allclose(np.cov(chain.samples.T), prior.covariance, atol=0.08)


def test_the_printed_proposal_does_not(generator):
    """Negative control: the uncentred form shrinks every sample towards zero."""
    prior = Gaussian(np.array([3.0, -2.0]), np.array([[1.0, 0.0], [0.4, 0.5]]))
    samples = printed_pcn(prior, 0.8, 20_000, generator)
    assert np.abs(samples.mean(axis=0) - prior.mean).max() > 1
    assert np.abs(np.cov(samples.T) - prior.covariance).max() > 0.2


@pytest.mark.parametrize("kind", ["pcn", "laplace", "independence"])
def test_linear_posterior_in_closed_form(generator, kind):
    posterior, matrix = linear_problem(generator)
    exact = update(matrix, posterior.readings, posterior.noise, posterior.prior).distribution
    if kind == "pcn":
        reference, step = prior_reference(posterior.prior), 0.4
    else:
        reference, mode = laplace(posterior, lambda p: matrix)
        np.testing.assert_allclose(mode, exact.mean, rtol=1e-8)
        step = 0.7 if kind == "laplace" else 1.0
    chains = np.array([run(posterior, reference, step, 8000, generator).samples
                       for _ in range(4)])
    found = assess_convergence(chains)
    assert found.r_hat.max() < 1.02
    error = (chains.mean(axis=(0, 1)) - exact.mean) / found.mcse
    assert np.abs(error).max() < 4.5
    ratio = chains.std(axis=(0, 1)) / exact.sd
    assert ratio == pytest.approx(1, abs=5 / np.sqrt(found.bulk.min()))
    if kind == "independence":
        assert found.bulk.min() > 0.9 * found.samples  # the reference is the posterior


def test_bent_posterior_against_quadrature(generator):
    posterior, jacobian = bent_problem(generator)
    reference, _ = laplace(posterior, jacobian)
    moves = [Proposal(reference, 0.9), Proposal(prior_reference(posterior.prior), 0.5)]
    chains = np.array([sample(posterior, moves, 10_000, generator, np.zeros(2)).samples
                       for _ in range(4)])
    axis = np.linspace(-5, 6, 801)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    log = np.array([posterior.log_likelihood(p) for p in zip(x.ravel(), y.ravel(), strict=True)])
    log = log.reshape(x.shape) - ((x - 1) ** 2 + (y - 0.5) ** 2) / 2
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    found = assess_convergence(chains)
    for number, grid in enumerate((x, y)):
        mean = (weight * grid).sum()
        sd = np.sqrt((weight * (grid - mean) ** 2).sum())
        assert chains[..., number].mean() == pytest.approx(mean, abs=4.5 * found.mcse[number])
        assert chains[..., number].std() == pytest.approx(sd, rel=0.05)
        # Laplace's approximation itself is visibly another distribution
    marginal = weight.sum(axis=1)
    skew = (marginal * ((axis - (marginal * axis).sum()) ** 3)).sum()
    assert abs(skew) > 0.05


def test_a_short_chain_is_refused(generator):
    posterior, _ = linear_problem(generator)
    reference = prior_reference(posterior.prior)
    chains = np.array([run(posterior, reference, 1 / 80, 2000, generator).samples
                       for _ in range(4)])
    with pytest.raises(SamplingError, match=r"autocorrelation time \d+"):
        require_convergence(assess_convergence(chains), ["a", "b", "c"])
    good = generator.standard_normal((4, 2000, 3))
    require_convergence(assess_convergence(good), ["a", "b", "c"])


@pytest.mark.parametrize(("r_hat", "bulk", "draws"), [(1.0, 37.0, 778), (1.018, 440.0, 784)])
def test_refused_chains_are_told_how_many_draws_will_do(r_hat, bulk, draws):
    """Of a dipole with iron, 36 draws were told to become 392. Those were refused without a number;
    784 are accepted.
    """
    samples = 4 * 392 if r_hat > 1 else 144
    ones = np.ones(1)
    found = ConvergenceDiagnostics(r_hat * ones, bulk * ones, 500 * ones, ones, 4, samples)
    with pytest.raises(SamplingError, match=f"{draws} draws per chain"):
        require_convergence(found, ["a"])


def test_mode_that_is_not_there_is_said():
    prior = Gaussian(np.zeros(1), np.eye(1))
    noise = independent_noise(np.array([1e-3]))
    nowhere = Posterior(lambda p: np.sign(p), np.array([0.5]), noise, prior)
    with pytest.raises(SamplingError, match="mode was not found"):
        laplace(nowhere, lambda p: np.array([[1.0]]))


def test_rank_statistics_tell_a_posterior_that_is_too_sure(generator):
    """The linear posterior is calibrated; with half its spread, or twice, it is not."""
    problem, matrix = linear_problem(generator)
    prior, noise = problem.prior, problem.noise

    def sampler(spread):
        def draw(readings, generator):
            exact = update(matrix, readings, noise, prior).distribution
            return exact.mean + spread * (exact.sample(99, generator) - exact.mean)
        return draw

    for spread, good in ((1.0, True), (0.5, False), (2.0, False)):
        found, draws = ranks(prior, lambda p, generator: matrix @ p + noise.sample(generator),
                             sampler(spread), 200, generator)
        assert found.shape == (200, SIZE)
        values, together = uniformity(found, draws)
        assert (together > 1e-3) == good
        assert values.shape == (SIZE,)
