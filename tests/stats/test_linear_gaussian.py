"""The closed-form posterior against hand-worked numbers, the textbook formula, and sampling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from halbach_fe.core.errors import StudyError
from halbach_fe.stats import posteriors
from halbach_fe.stats.gaussian import (
    Gaussian,
    by_readings_alone,
    independent_noise,
    largest_directions,
    nominal_prior,
)
from halbach_fe.stats.posteriors import contraction, posterior, predict, update, whitened


def textbook(matrix, readings, noise, prior):
    """C_1 = (H' S^-1 H + C_0^-1)^-1 and its mean, as printed; sound only for tame numbers."""
    weight = matrix.T @ np.linalg.inv(noise.covariance.toarray())
    precision = np.linalg.inv(prior.covariance)
    covariance = np.linalg.inv(weight @ matrix + precision)
    return covariance @ (weight @ readings + precision @ prior.mean), covariance


def problem(generator, n=12, m=5):
    root = np.eye(m) + 0.2 * generator.standard_normal((m, m))
    prior = Gaussian(generator.standard_normal(m), root)
    matrix, sigma = generator.standard_normal((n, m)), generator.uniform(0.1, 0.5, n)
    return matrix, generator.standard_normal(n), independent_noise(sigma), prior


@pytest.mark.parametrize(("count", "generator", "said"), [
    (-1, np.random.default_rng(1), "at least 0"), (2.5, np.random.default_rng(1), "a whole number"),
    (3, 1, "a random generator; instead received a int. Give numpy")])
def test_samples_that_cannot_be_drawn(count, generator, said):
    known = Gaussian(np.zeros(2), np.eye(2))
    assert known.sample(3, np.random.default_rng(1)).shape == (3, 2)
    with pytest.raises(StudyError, match=said):
        known.sample(count, generator)


def test_one_reading_of_one_parameter():
    """Prior 1 +- 2, reading 5 +- 1 of it: mean (1/4 + 5)/(1/4 + 1), variance 1/(1/4 + 1)."""
    found = posterior(np.array([[1.0]]), np.array([5.0]), independent_noise(np.ones(1)),
                      Gaussian(np.array([1.0]), np.array([[2.0]])))
    assert found.mean == pytest.approx([5.25 / 1.25])
    assert found.sd == pytest.approx([1 / np.sqrt(1.25)])


@pytest.mark.parametrize(("n", "m"), [(12, 5), (3, 8), (1, 1)])
def test_against_the_textbook_formula(generator, n, m):
    case = problem(generator, n, m)
    mean, covariance = textbook(*case)
    found = posterior(*case)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize(("n", "m"), [(12, 5), (3, 8)])
def test_what_readings_alone_say_of_a_direction(generator, n, m):
    """As with a prior that is wide along it. Negative controls: the posterior itself, and a wide
    prior along another direction.
    """
    matrix, readings, noise, prior = problem(generator, n, m)
    direction, other = np.linalg.qr(generator.standard_normal((m, 2)))[0].T
    mean, sd = (value[0] for value in by_readings_alone(
        prior, posterior(matrix, readings, noise, prior), direction[None]))

    def wide(along):
        found = posterior(matrix, readings, noise, Gaussian(
            prior.mean, np.column_stack([prior.root, 1e4 * along])))
        return direction @ (found.mean - prior.mean), found.sd_of(direction[None])[0]

    assert (mean, sd) == pytest.approx(wide(direction), rel=1e-5, abs=1e-6)
    for control in (0 * other, other):
        assert abs(wide(control)[1] / sd - 1) > 1e-3


def test_what_is_exact_stays_so_beside_the_readings_alone():
    """As a missing block beside others; a direction that is exact in part is told of nothing."""
    prior = Gaussian(np.zeros(3), np.diag([1e4, 0.5, 0.0]))  # of parameters in different units
    matrix, noise = np.array([[1e-4, 1.0, 1.0], [0.0, 1.0, 2.0]]), independent_noise(np.ones(2))
    found = posterior(matrix, np.ones(2), noise, prior)
    smaller = Gaussian(np.zeros(2), np.diag([1e4, 0.5]))
    expected = by_readings_alone(smaller, posterior(matrix[:, :2], np.ones(2), noise, smaller),
                                 np.eye(2))
    mean, sd = by_readings_alone(prior, found, np.array([[1, 0, 0], [0, 1, 0], [0.6, 0, 0.8]]))
    np.testing.assert_allclose((mean[:2], sd[:2]), expected, rtol=1e-6)
    assert sd[2] == np.inf


def test_readings_that_say_nothing_leave_a_direction_open():
    prior = Gaussian(np.zeros(2), np.eye(2))
    found = posterior(np.array([[1.0, 0.0]]), np.ones(1), independent_noise(np.ones(1)), prior)
    mean, sd = by_readings_alone(prior, found, np.eye(2))
    assert (mean[0], sd[0]) == pytest.approx((1.0, 1.0))
    assert sd[1] > 1e5


def test_against_brute_force_sampling(generator):
    """Weights of 400 000 prior draws; 3 of 4 readings are vague, so that some draws count."""
    matrix, readings, _, prior = problem(generator, 4, 2)
    sigma = np.array([1.0, 2.0, 2.0, 2.0])
    draws = prior.sample(400_000, generator)
    weight = np.exp(-0.5 * np.sum(((draws @ matrix.T - readings) / sigma) ** 2, axis=1))
    weight /= weight.sum()
    mean = weight @ draws
    spread = np.sqrt(weight @ (draws - mean) ** 2)
    effective = 1 / np.sum(weight**2)
    found = posterior(matrix, readings, independent_noise(sigma), prior)
    assert effective > 10_000
    assert np.all(np.abs(mean - found.mean) < 5 * found.sd / np.sqrt(effective))
    assert spread == pytest.approx(found.sd, rel=5 / np.sqrt(effective))


def test_sound_where_the_textbook_formula_breaks(generator):
    """Two readings that differ by 1e-7: the normal equations square that and lose the
    difference in rounding; singular values keep half of the digits.
    """
    prior = Gaussian(np.zeros(2), np.eye(2))
    matrix = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-7]])
    truth = np.array([0.3, -0.2])
    found = posterior(matrix, matrix @ truth, independent_noise(np.full(2, 1e-12)), prior)
    np.testing.assert_allclose(found.mean, truth, atol=1e-5)
    wrong, _ = textbook(matrix, matrix @ truth, independent_noise(np.full(2, 1e-12)), prior)
    assert np.abs(wrong - truth).max() > 1e-5


def test_singular_prior_is_respected(generator):
    """A common mode alone: the posterior stays on its line."""
    nominal = np.array([1.0, 0.0, 0.0, 2.0])
    prior = Gaussian(nominal, 0.1 * nominal[:, None])
    found = posterior(generator.standard_normal((3, 4)), generator.standard_normal(3),
                      independent_noise(np.ones(3)), prior)
    assert found.root.shape == (4, 1)
    assert np.linalg.matrix_rank(np.column_stack([found.mean, nominal]), tol=1e-9) == 1


def test_uninformative_data_leave_the_prior(generator):
    matrix, readings, noise, prior = problem(generator)
    found = posterior(matrix, readings, independent_noise(noise.sd * 1e9), prior)
    np.testing.assert_allclose(found.mean, prior.mean, atol=1e-6)
    np.testing.assert_allclose(found.covariance, prior.covariance, atol=1e-6)


def test_calibration_over_many_truths(generator):
    """Truth drawn from the prior: z-scores are standard normal. Twice too small an error bar is
    seen by the same figure.
    """
    matrix, _, noise, prior = problem(generator)
    scores = []
    for truth in prior.sample(2000, generator):
        found = posterior(matrix, matrix @ truth + noise.sample(generator), noise, prior)
        scores.append((truth - found.mean) / found.sd)
    rms = np.sqrt(np.mean(np.square(scores)))
    # 10 000 correlated values: at least 2000 effective, 1.6 % in the rms; 0.07 is over 4 sigma
    assert rms == pytest.approx(1.0, abs=0.07)
    assert 2 * rms != pytest.approx(1.0, abs=0.07)


def test_prediction(generator):
    matrix, _, _, prior = problem(generator, 400, 5)
    mean, sd = predict(matrix, prior)
    draws = prior.sample(20_000, generator) @ matrix.T
    np.testing.assert_allclose(sd, draws.std(axis=0), rtol=0.05)
    np.testing.assert_allclose(mean, matrix @ prior.mean)


def test_whitened_residuals(generator):
    """Against the dense covariance; and over many draws they are independent and standard normal,
    which those divided by their sd's are not.
    """
    matrix, _, noise, prior = problem(generator, 12, 5)
    covariance = matrix @ prior.covariance @ matrix.T + noise.covariance.toarray()
    root, residual = matrix @ prior.root, generator.standard_normal(12)
    values, vectors = np.linalg.eigh(covariance / np.outer(noise.sd, noise.sd))
    expected = (vectors / np.sqrt(values)) @ vectors.T @ (residual / noise.sd)
    np.testing.assert_allclose(whitened(residual, noise, root.__getitem__, 5), expected, rtol=1e-9)
    # the same figure as the update's, which is tested against the dense formula
    readings = residual + matrix @ prior.mean
    assert np.mean(whitened(residual, noise, root.__getitem__, 5) ** 2) == pytest.approx(
        update(matrix, readings, noise, prior).prior_conflict)
    draws = generator.multivariate_normal(np.zeros(12), covariance, 4000)
    white = np.array([whitened(draw, noise, root.__getitem__, 5) for draw in draws])
    # 4000 draws: each correlation has an sd of 1.6 %; 4 sigma
    assert np.abs(np.cov(white.T) - np.eye(12)).max() < 0.1
    assert np.abs(np.corrcoef(draws.T) - np.eye(12)).max() > 0.5


def test_prior_conflict_is_the_prior_predictive_distance(generator):
    matrix, readings, noise, prior = problem(generator)
    covariance = matrix @ prior.covariance @ matrix.T + noise.covariance.toarray()
    residual = readings - matrix @ prior.mean
    expected = residual @ np.linalg.solve(covariance, residual) / len(readings)
    assert update(matrix, readings, noise, prior).prior_conflict == pytest.approx(expected)


def test_prior_conflict_sees_noise_that_was_understated(generator):
    """Even with more parameters than readings, where every fit is perfect."""
    matrix, _, _, prior = problem(generator, 40, 200)
    noise = independent_noise(np.full(40, 5.0))
    truth = prior.sample(1, generator)[0]
    error = noise.sample(generator)
    # 40 readings: sd 0.22
    assert update(matrix, matrix @ truth + error, noise, prior).prior_conflict < 1.9
    assert update(matrix, matrix @ truth + 10 * error, noise, prior).prior_conflict > 1.9


def test_evidence_and_parameters_learnt(generator):
    """Against the density of the readings, and the trace of the textbook's matrices."""
    matrix, readings, noise, prior = problem(generator)
    found = update(matrix, readings, noise, prior)
    predictive = stats.multivariate_normal(
        matrix @ prior.mean, matrix @ prior.covariance @ matrix.T + noise.covariance.toarray())
    assert found.log_evidence == pytest.approx(predictive.logpdf(readings))
    learnt = np.trace(np.eye(5) - found.distribution.covariance @ np.linalg.inv(prior.covariance))
    assert found.parameters_learnt == pytest.approx(learnt)
    # many vague readings teach little, exact ones everything
    vague, exact = (independent_noise(noise.sd * factor) for factor in (1e3, 1e-3))
    assert update(matrix, readings, vague, prior).parameters_learnt < 1e-2
    assert update(matrix, readings, exact, prior).parameters_learnt == pytest.approx(5, abs=1e-4)


def test_chunks_of_readings_add_up(generator, monkeypatch):
    case = problem(generator, 50, 5)
    whole = update(*case)
    monkeypatch.setattr(posteriors, "READINGS_AT_ONCE", 7)
    parts = update(*case)
    np.testing.assert_allclose(parts.distribution.mean, whole.distribution.mean, rtol=1e-10)
    assert parts.log_evidence == pytest.approx(whole.log_evidence, rel=1e-12)
    np.testing.assert_allclose(predict(case[0], parts.distribution)[1],
                               predict(case[0], whole.distribution)[1], rtol=1e-9)


def test_both_ways_agree(generator, monkeypatch):
    """The product, and where it would lose digits, rows."""
    case = problem(generator, 50, 5)
    one = update(*case)
    monkeypatch.setattr(posteriors, "WORST_CONDITION", 0.0)
    other = update(*case)
    np.testing.assert_allclose(other.distribution.covariance, one.distribution.covariance,
                               rtol=1e-9)
    assert other.parameters_learnt == pytest.approx(one.parameters_learnt)
    assert other.log_evidence == pytest.approx(one.log_evidence)


def test_rows_take_over_where_the_product_is_not_exact_enough(generator, monkeypatch):
    """Many readings that tell two parameters apart by 1e-7: with the product they do not."""
    matrix = np.tile([[1.0, 1.0], [1.0, 1.0 + 1e-7]], (25, 1))
    truth = np.array([0.3, -0.2])
    case = (matrix, matrix @ truth, independent_noise(np.full(50, 1e-12)),
            Gaussian(np.zeros(2), np.eye(2)))
    found = update(*case)
    np.testing.assert_allclose(found.distribution.mean, truth, atol=1e-5)
    assert 0 <= found.prior_conflict < 1  # no noise was added
    monkeypatch.setattr(posteriors, "WORST_CONDITION", np.inf)  # negative control
    assert np.abs(update(*case).distribution.mean - truth).max() > 1e-5


def test_contraction_by_block(generator):
    prior = Gaussian(np.zeros(4), np.eye(4))
    after = Gaussian(np.zeros(4), np.diag([1.0, 1.0, 0.1, 0.1]))
    assert contraction(*(each.sd.reshape(-1, 2) for each in (prior, after))) == pytest.approx(
        [0.0, 0.99])


def test_block_prior_along_and_across(generator):
    nominal = np.array([3.0, 4.0, 0.0, 0.0, 0.0, 2.0])
    prior = nominal_prior(nominal, 3, magnitude_sd=0.01, direction_sd_deg=1.0, shared_sds=0.02)
    covariance = prior.covariance
    along = np.array([0.6, 0.8, 0.0])
    block = covariance[:3, :3]
    assert along @ block @ along == pytest.approx(25 * (0.01**2 + 0.02**2))
    across = np.array([0.0, 0.0, 1.0])
    assert across @ block @ across == pytest.approx(25 * np.radians(1.0) ** 2)
    assert along @ block @ across == pytest.approx(0, abs=1e-15)
    # the common mode correlates the magnitudes of different blocks
    assert along @ covariance[:3, 5] == pytest.approx(5 * 2 * 0.02**2)
    alone = nominal_prior(nominal, 3, 0.01, 1.0)
    assert alone.covariance[:3, 3:] == pytest.approx(0)


def test_a_missing_block_is_known_to_be_missing():
    prior = nominal_prior(np.array([0.0, 0, 0, 100, 0, 0]), 3, 0.01, 1.0)
    assert not prior.sd[:3].any()
    assert prior.sd[3:].all()


@pytest.mark.parametrize(("rows", "columns", "decay"), [
    (500, 400, 0.85), (300, 400, 0.85), (500, 400, 0.9999), (30, 20, 0.5)])
def test_largest_directions_are_those_of_the_singular_values(generator, rows, columns, decay):
    """Of matrices of many rows and of few, whose values decay as those of a field, or hardly.

    A subspace that is iterated leaves 1e-2 of the smallest value outside; without the iteration,
    a part as large as the value would be.
    """
    left, right = (np.linalg.qr(generator.standard_normal((size, min(rows, columns))))[0]
                   for size in (rows, columns))
    values = decay**np.arange(min(rows, columns))
    matrix, smallest = left * values @ right.T, 1e-4 if decay < 0.9999 else 0.95
    found = largest_directions(matrix, smallest)
    wanted = right[:, values > smallest]
    assert found.shape == wanted.shape
    assert np.allclose(found.T @ found, np.eye(found.shape[1]), rtol=0, atol=1e-6)
    outside = matrix @ (wanted - found @ (found.T @ wanted))
    assert np.linalg.norm(outside, ord=2) < 0.01 * smallest


def test_small_directions_are_perpendicular(generator):
    """Of few readings with little noise: values near the rounding of the Gram matrix."""
    left, right = (np.linalg.qr(generator.standard_normal((size, 200)))[0] for size in (200, 600))
    found = largest_directions(left * np.logspace(0, -8, 200) @ right.T, 1e-7)
    assert found.shape[1] == 175
    assert np.allclose(found.T @ found, np.eye(175), rtol=0, atol=1e-10)  # 0.05 without QR
