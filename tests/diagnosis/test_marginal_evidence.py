"""Evidence of signatures with the blocks integrated out, against dense normal distributions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import special, stats

from halbach_fe.diagnosis.effect_selection import (
    Candidate,
    best_factors,
    log_bayes_factors,
    log_evidence,
    prior_log_odds,
    select_effects,
    with_wide_priors,
)
from halbach_fe.diagnosis.marginal_evidence import (
    Marginal,
    loo_residuals,
    residual_groups,
    with_fewer_columns,
)


@pytest.fixture
def problem():
    """Whitened response of 6 parameters and 5 signatures on 40 readings, and a residual."""
    generator = np.random.default_rng(4)
    response, signatures = generator.standard_normal((40, 6)), generator.standard_normal((40, 5))
    residual = (3 * signatures[:, 1] + response @ generator.standard_normal(6)
                + generator.standard_normal(40))
    return response, signatures, residual


def dense(response, signatures, residual):
    """Log density of a residual whose covariance has these parts."""
    covariance = np.eye(len(residual)) + response @ response.T + signatures @ signatures.T
    return stats.multivariate_normal(cov=covariance).logpdf(residual)


@pytest.mark.parametrize("chosen", [[1], [0, 3], [4, 1, 2]])
def test_log_evidence_is_that_of_the_dense_covariance(problem, chosen):
    response, signatures, residual = problem
    evidence = Marginal.of(response).evidence(signatures, residual)
    expected = dense(response, signatures[:, chosen], residual) - dense(
        response, signatures[:, :0], residual)
    assert evidence.fit(chosen).log_evidence == pytest.approx(expected)
    assert evidence.log_evidences([chosen])[0] == pytest.approx(expected)
    # negative control: blocks that are not integrated out make another of it
    bare = Marginal.of(0 * response).evidence(signatures, residual)
    assert abs(bare.fit(chosen).log_evidence - expected) > 1


def test_amplitudes_are_those_of_the_joint_regression(problem):
    response, signatures, residual = problem
    fit = Marginal.of(response).evidence(signatures, residual).fit([0, 1])
    joint = np.hstack([response, signatures[:, :2]])
    covariance = np.linalg.inv(joint.T @ joint + np.eye(8))
    assert fit.mean == pytest.approx((covariance @ joint.T @ residual)[6:])
    assert fit.covariance == pytest.approx(covariance[6:, 6:])


def test_given_is_the_evidence_of_what_remains(problem):
    response, signatures, residual = problem
    evidence = Marginal.of(response).evidence(signatures, residual)
    both = evidence.fit([1, 2]).log_evidence
    assert evidence.given([1]).fit([2]).log_evidence == pytest.approx(
        both - evidence.fit([1]).log_evidence)
    assert evidence.given([1]).chi2 == pytest.approx(residual @ np.linalg.solve(
        np.eye(40) + response @ response.T + np.outer(signatures[:, 1], signatures[:, 1]),
        residual))


def test_a_certain_effect_shifts_the_readings(problem):
    response, signatures, residual = problem
    evidence = Marginal.of(response).evidence(signatures, residual)
    expected = dense(response, signatures[:, :0], residual - signatures[:, 1]) - dense(
        response, signatures[:, :0], residual)
    certain = Candidate("missing", "", (1,), is_binary=True)
    assert log_bayes_factors(evidence, [certain])[0] == pytest.approx(expected)
    other = Candidate("other", "", (3,))
    together = dense(response, signatures[:, [3]], residual - signatures[:, 1]) - dense(
        response, signatures[:, :0], residual)
    # a small amplitude, of two prior widths that were equally likely
    assert log_evidence(evidence, [certain, other]) == pytest.approx(together - np.log(2))


def test_left_out_residuals_are_those_of_each_reading_given_the_others(problem):
    response, _, residual = problem
    covariance = np.eye(40) + response @ response.T
    others = np.arange(1, 40)
    weights = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, 0])
    mean, variance = weights @ residual[others], covariance[0, 0] - weights @ covariance[others, 0]
    assert loo_residuals(Marginal.of(response), residual)[0] == pytest.approx(
        (residual[0] - mean) / np.sqrt(variance))


@pytest.mark.parametrize("parameters", [3, 30], ids=["few parameters", "many parameters"])
def test_groups_are_judged_given_all_other_readings(problem, generator, parameters):
    _, _, residual = problem
    response = generator.standard_normal((40, parameters))
    members = {"half": ["first"] * 15 + ["second"] * 25}
    found = residual_groups(Marginal.of(response), residual, members)
    covariance = np.eye(40) + response @ response.T
    one, two = np.arange(15), np.arange(15, 40)
    weights = np.linalg.solve(covariance[np.ix_(two, two)], covariance[np.ix_(two, one)])
    rest = residual[one] - weights.T @ residual[two]
    spread = covariance[np.ix_(one, one)] - weights.T @ covariance[np.ix_(two, one)]
    assert found[0].chi2_per_reading == pytest.approx(rest @ np.linalg.solve(spread, rest) / 15)


def test_a_group_disagrees_where_readings_do():
    generator = np.random.default_rng(2)
    response = generator.standard_normal((60, 4))
    names = {"third": [str(number // 20) for number in range(60)]}
    clean = response @ generator.standard_normal(4) + generator.standard_normal(60)
    marginal = Marginal.of(response)
    assert not any(group.disagrees for group in residual_groups(marginal, clean, names))
    clean[20:40] += 3.0 * (-1) ** np.arange(20)
    wrong = residual_groups(marginal, clean, names)
    assert wrong[1].disagrees
    assert wrong[1].chi2_per_reading > 2 * max(wrong[0].chi2_per_reading, wrong[2].chi2_per_reading)


def hidden(amplitudes, seed=0, readings=200):
    """Evidence of 20 signatures, of which some are in the readings, and their candidates."""
    generator = np.random.default_rng(seed)
    response = generator.standard_normal((readings, 10))
    signatures = generator.standard_normal((readings, 20))
    signatures[:, 19] = signatures[:, 0] + 0.02 * generator.standard_normal(readings)  # a twin
    residual = (response @ generator.standard_normal(10) + generator.standard_normal(readings)
                + sum(size * signatures[:, column] for column, size in amplitudes.items()))
    candidates = [Candidate(f"effect {number}", "", (number,)) for number in range(20)]
    return Marginal.of(response).evidence(signatures, residual), candidates


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_found_where_nothing_is(seed):
    assert select_effects(*hidden({}, seed)) == []


@pytest.mark.parametrize("seed", range(5))
def test_several_effects_are_found_together(seed):
    found = select_effects(*hidden({3: 1.0, 7: -0.8}, seed))
    assert {one.candidate.effect for one in found} == {"effect 3", "effect 7"}
    assert all(one.effects == (one.candidate.effect,) for one in found)


def test_twins_are_named_together():
    (found,) = select_effects(*hidden({0: 1.0}))
    assert set(found.effects) == {"effect 0", "effect 19"}


@pytest.mark.parametrize(("apart", "named"), [(0.1, {"true", "late"}), (0.02, {"mixed", "late"})])
def test_what_came_first_gives_way_to_what_is_likelier_in_the_end(generator, apart, named):
    """A cause that looks like two together comes first; beside the second, the first is likelier.

    Negative control: one that is hardly apart from it then stays, and the true one is a rival.
    """
    first, late, other = generator.standard_normal((3, 400))
    signatures = np.column_stack([first, late, first + 0.6 * late + apart * other])
    residual = first + 0.6 * late + 0.5 * generator.standard_normal(400)
    candidates = [Candidate(name, "", (number,)) for number, name in enumerate(
        ("true", "late", "mixed"))]
    residual = residual + 0.3 * late
    evidence = Marginal.of(np.zeros((400, 1))).evidence(2 * signatures, 2 * residual)
    found = {one.candidate.effect: one for one in select_effects(evidence, candidates)}
    assert found.keys() == named
    if "mixed" in named:
        assert "true" in found["mixed"].effects


def test_factors_beside_others_are_what_is_left_for_an_effect():
    evidence, candidates = hidden({0: 1.0, 3: 1.0})
    alone = best_factors(evidence, candidates)
    beside = best_factors(evidence, candidates, [["effect 0", "effect 5"]])
    assert alone["effect 0"] > 20
    assert alone["effect 19"] > 20
    assert beside["effect 19"] < 3  # its twin is there
    assert beside["effect 3"] > 20
    pair = [candidates[0], candidates[3]]
    assert beside["effect 3"] == pytest.approx(
        log_evidence(evidence, pair) - log_evidence(evidence, pair[:1]), abs=1.0)


def test_one_large_effect_is_not_two(monkeypatch):
    """Twenty standard deviations; with the usual prior alone, a twin takes half of it."""
    (found,) = select_effects(*hidden({0: 20.0}))
    assert found.candidate.effect == "effect 0"
    monkeypatch.setattr("halbach_fe.diagnosis.effect_selection.WIDE_PRIOR_SD", 1.0)
    both = select_effects(*hidden({0: 20.0}))
    assert {one.candidate.effect for one in both} == {"effect 0", "effect 19"}


def test_shuffled_signatures_break_the_naming():
    evidence, candidates = hidden({3: 1.0, 7: -0.8})
    names = [candidate.effect for candidate in candidates]
    wrong = [Candidate(names[(number + 5) % 20], "", candidate.columns)
             for number, candidate in enumerate(candidates)]
    assert {one.candidate.effect for one in select_effects(evidence, wrong)}.isdisjoint(
        {"effect 3", "effect 7"})


def moved(amplitudes, parts, shared=(), seed=0):
    """Evidence of an effect of three amplitudes in units of their priors, and the effect."""
    generator = np.random.default_rng(seed)
    signatures = 30 * generator.standard_normal((200, 3)) / np.sqrt(200)
    residual = signatures @ np.array(amplitudes) + generator.standard_normal(200)
    return (Marginal.of(np.zeros((200, 1))).evidence(signatures, residual),
            Candidate("moved", "", (0, 1, 2), parts=parts, shared=shared))


ALL_PARTS = ((0,), (1,), (2,), (0, 1), (0, 2), (1, 2), (0, 1, 2))


def test_an_effect_competes_by_its_parts():
    """The mean evidence of all parts, each with the price of its own amplitudes only."""
    evidence, effect = moved((0.0, 0.0, 1.0), ALL_PARTS)
    parts = [log_bayes_factors(evidence, [Candidate("moved", "", part)])[0] for part in ALL_PARTS]
    factor, = log_bayes_factors(evidence, [effect])
    assert factor == pytest.approx(special.logsumexp(parts) - np.log(7))
    assert factor > parts[-1]  # of all amplitudes, two of which are not needed
    assert log_evidence(evidence, [effect]) == pytest.approx(
        log_evidence(evidence, [Candidate("moved", "", (2,))]) - np.log(7), abs=1e-6)
    fit = with_wide_priors(evidence, [effect]).fit(effect.free)
    alone = evidence.fit([2])
    assert fit.mean == pytest.approx([0, 0, alone.mean[0]], abs=1e-6)
    assert fit.covariance[2, 2] == pytest.approx(alone.covariance[0, 0])
    # the negative control: all that moved is free
    evidence, effect = moved((1.0, -1.0, 1.0), ALL_PARTS)
    assert np.abs(with_wide_priors(evidence, [effect]).fit(effect.free).mean).min() > 0.5


@pytest.mark.parametrize("apart", [0.0, 0.3])
def test_two_effects_give_way_to_two_that_are_likelier_together(generator, apart):
    """A background with an amplitude beside that of an offset, and a non-linearity that is with it
    what a gain is: neither gives way alone. Control: a background that is there stays.
    """
    offset, beside, nonlinearity = 2.0 * generator.standard_normal((3, 400))
    gain = nonlinearity + 0.3 * beside
    signatures = np.column_stack([offset, beside, nonlinearity, gain])
    residual = offset + gain + apart * beside + generator.standard_normal(400)
    candidates = [Candidate("background", "", (0, 1), parts=((0,), (1,), (0, 1))),
                  Candidate("nonlinearity", "", (2,)), Candidate("offset", "", (0,)),
                  Candidate("gain", "", (3,))]
    evidence = Marginal.of(np.zeros((400, 1))).evidence(signatures, residual)
    found = {one.candidate.effect for one in select_effects(evidence, candidates)}
    assert found == {"background" if apart else "offset", "gain"}


@pytest.mark.parametrize(("amplitudes", "named"), [((0.0, 0, 1.0), False), ((0.5, 0, 1.0), True)])
def test_what_effects_share_names_none_of_them(amplitudes, named):
    """A gap with a common shift: the shift alone is no gap, and its own effect is named."""
    evidence, gap = moved(amplitudes, ((0,), (0, 2)), shared=(2,))
    shift = Candidate("shift", "", (2,))
    found = {one.candidate.effect for one in select_effects(evidence, [gap, shift])}
    assert ("moved" in found) == named
    factor, alone = log_bayes_factors(evidence, [gap, shift])
    assert alone > 100
    assert (factor > alone) if named else (factor < 0)


def test_relative_odds_are_prior_odds():
    rare = Candidate("rare", "", (0,), relative_odds=0.1)
    usual, fewer = prior_log_odds([Candidate("usual", "", (1,)), rare])
    assert usual - fewer == pytest.approx(np.log(10))


def test_fewer_columns_have_the_same_covariance(generator):
    for shape in ((5, 40), (40, 5)):
        root = generator.standard_normal(shape)
        fewer = with_fewer_columns(root)
        assert fewer.shape == (shape[0], 5)
        np.testing.assert_allclose(fewer @ fewer.T, root @ root.T, atol=1e-12)
