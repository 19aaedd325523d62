"""What a map would have shown: changes above the limit are named, those below are not."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effect_selection import Candidate, log_bayes_factors
from halbach_fe.diagnosis.effects.magnetization import BlockDemagnetizedEffect
from halbach_fe.diagnosis.effects.places_and_shapes import BLOCK_DISPLACED
from halbach_fe.diagnosis.marginal_evidence import Evidence
from halbach_fe.diagnosis.summary import limits_in_words
from halbach_fe.diagnosis.uncertain_effects import smallest_amplitude
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map
from halbach_fe.solver.exact_block_field import field_of
from tests.diagnosis.campaign import CIRCLES, NOISE_T, STUDY, drawn, field

WELL_ABOVE, WELL_BELOW = 1.6, 0.5
"""Multiples of a limit. The log Bayes factor grows with their square, from 12.5 at the limit: by
about 20 at 1.6, and it falls by 9 at 0.5. Its sd by noise is about 5 at the limit."""


@pytest.mark.parametrize("size", [1, 3])
def test_it_is_the_amplitude_at_the_threshold(generator, size):
    root = generator.standard_normal((size, size + 2))
    information, threshold = 30 * root @ root.T, 12.5
    amplitude = smallest_amplitude(information, threshold)
    direction = np.linalg.eigh(information)[1][:, 0]
    for factor, above in ((0.95, False), (1.0, True), (1.05, True)):
        evidence = Evidence.of(information, factor * amplitude * information @ direction, 0.0, 9)
        (found,) = log_bayes_factors(evidence, [Candidate("one", "", tuple(range(size)))])
        assert (found >= threshold) == above
    assert smallest_amplitude(np.zeros((size, size)), threshold) == np.inf


@pytest.mark.parametrize("worst", [False, True])
def test_losses_about_the_limit(session, generator, worst):
    """A map by magpylib of a magnet with tolerances, and one block weaker."""
    effect = [BlockDemagnetizedEffect()]
    polarizations = drawn(STUDY, generator)
    noise = NOISE_T * generator.standard_normal(CIRCLES.shape)
    clean = diagnose(STUDY, field_map(CIRCLES, field(STUDY, polarizations, CIRCLES) + noise),
                     session, effects=effect)
    assert clean.identified == ()
    limits = clean.limits.loss
    order = np.argsort(limits)
    number = int(order[-1] if worst else order[len(order) // 2])
    for factor in (WELL_BELOW, WELL_ABOVE):
        weaker = polarizations.copy()
        weaker[number] *= 1 - factor * limits[number]
        data = field_map(CIRCLES, field(STUDY, weaker, CIRCLES) + noise)
        named = [each.hypothesis.place.name
                 for each in diagnose(STUDY, data, session, effects=effect).identified]
        assert named == ([clean.limits.blocks[number]] if factor > 1 else [])


def test_displacements_about_the_limit(session, generator):
    effect = BLOCK_DISPLACED
    nominal = field_of(build_magnet(STUDY).blocks, CIRCLES)
    noise = NOISE_T * generator.standard_normal(CIRCLES.shape)
    clean = diagnose(STUDY, field_map(CIRCLES, nominal + noise), session, effects=[effect])
    assert clean.identified == ()
    limits = clean.limits.displacement_m
    number = int(np.argsort(limits)[len(limits) // 2])
    place = effect.places(STUDY)[number]
    sizes = {}
    for axis in np.eye(3):
        moved = effect.apply(STUDY, place, (WELL_ABOVE * limits[number] * axis).tolist())
        data = field_map(CIRCLES, field_of(build_magnet(moved).blocks, CIRCLES) + noise)
        found = diagnose(STUDY, data, session, effects=[effect]).identified
        sizes[tuple(axis)] = [each.hypothesis.place for each in found]
    assert all(named == [place] for named in sizes.values())


def test_a_longer_map_shows_less_if_it_is_farther(session):
    """Negative control of the number itself: from half the distance to the axis less is seen."""
    limits = []
    for factor in (1.0, 0.5):
        points = CIRCLES * [factor, factor, 1.0]
        data = field_map(points, field_of(build_magnet(STUDY).blocks, points))
        found = diagnose(STUDY, data, session, effects=[BlockDemagnetizedEffect()])
        limits.append(float(np.median(found.limits.loss)))
        assert f"{100 * limits[-1]:.2g} %" in limits_in_words(found.limits)
    assert limits[1] > 1.5 * limits[0]
