"""Smooth fields and smooth errors of sensors."""

from __future__ import annotations

from dataclasses import replace

import magpylib
import numpy as np
import pytest
from scipy import special

from halbach_fe.diagnosis.flexible_causes import (
    SIZES,
    field_family,
    fit_family,
    harmonic_fields,
    instrument_families,
    sensor_errors,
)
from halbach_fe.diagnosis.marginal_evidence import Evidence, Marginal
from tests.conftest import circle

STEP = 1e-5
POINTS = np.vstack([circle(radius, 16, z) for radius in (0.03, 0.06)
                    for z in np.linspace(-0.2, 0.2, 15)])
SIGMA = 5e-5


def derivatives(points):
    """Of all harmonic fields, (k, n, component, direction)."""
    moved = [points + sign * STEP * axis for axis in np.eye(3) for sign in (1, -1)]
    ends = np.array([[0.06, 0, 0.2], [-0.06, 0, -0.2]])  # the same map's extent for all
    fields = harmonic_fields(np.vstack([*moved, ends])).fields
    parts = fields[:, :-2].reshape(len(fields), 3, 2, len(points), 3)
    return np.moveaxis((parts[:, :, 0] - parts[:, :, 1]) / (2 * STEP), 1, 3)


def test_harmonic_fields_have_no_source_in_the_bore():
    points = np.random.default_rng(1).uniform(-0.03, 0.03, (12, 3))
    gradient = derivatives(points)
    size = np.abs(gradient).max()
    # differences of STEP are off by rounding, 1e-16 / STEP, and by its square
    assert np.abs(np.trace(gradient, axis1=2, axis2=3)).max() < 1e-5 * size
    assert np.abs(gradient - np.swapaxes(gradient, 2, 3)).max() < 1e-5 * size


def test_a_plane_that_is_slightly_tilted_is_a_plane():
    plane = circle(0.03, 16, 0.0)
    tilted = plane + 1e-3 * plane[:, :1] * [0, 0, 1]
    for terms in (harmonic_fields, sensor_errors):
        there, level = terms(tilted).fields, terms(plane).fields
        assert there.shape == level.shape
        assert np.abs(there - level).max() < 2e-3 * np.abs(level).max()  # twice the tilt


def test_a_slab_is_no_plane():
    """Along which a sensor may drift; thin ones have finite fields."""
    slab = np.vstack([circle(0.05, 16, z) for z in (-0.005, 0.0, 0.005)])
    drift = np.zeros(slab.shape)
    drift[:, 0] = slab[:, 2]
    columns = sensor_errors(slab).fields.reshape(-1, drift.size).T
    left = drift.ravel() - columns @ np.linalg.lstsq(columns, drift.ravel(), rcond=None)[0]
    assert np.linalg.norm(left) < 0.01 * np.linalg.norm(drift)
    for thin in (1.0, 0.1, 0.01):
        assert np.isfinite(harmonic_fields(slab * [1, 1, thin]).fields).all()


def factors(field):
    """Log Bayes factors of both kinds for a field in T, with noise."""
    noise = np.random.default_rng(3).standard_normal(field.size)
    residual = field.ravel() / SIGMA + noise
    marginal = Marginal.of(np.zeros((field.size, 1)))
    nothing = np.zeros_like(POINTS)  # no field: no gains, and no gradient
    every = [field_family(POINTS, SIGMA), *instrument_families(
        POINTS, np.linspace(0, 1, len(POINTS)), nothing, np.zeros((*POINTS.shape, 3)), SIGMA)]
    found = {}
    for family in every:
        fields = family.fields()
        evidence = marginal.evidence(fields.reshape(len(fields), -1).T / SIGMA, residual)
        kind = "field" if family.acts_on == "field" else "instrument"
        found[kind] = max(found.get(kind, -np.inf), fit_family(family, evidence).log_bayes_factor)
    return found["field"], found["instrument"]


@pytest.mark.parametrize("count", [1, 2, 60])
def test_the_evidence_of_a_family_is_that_of_the_distribution_of_the_readings(count):
    """Averaged over sizes and spectra. Control: without the price of the amplitudes."""
    generator = np.random.default_rng(4)
    readings, columns = generator.standard_normal(40), generator.standard_normal((40, count))
    family = replace(field_family(POINTS, SIGMA), axis=np.full(count, -1),
                     spectra=np.array([np.ones(count), 0.5**np.arange(count)]),
                     smooth=(True, False))
    every = []
    for spectrum in family.spectra:
        for size in SIZES:
            whole = np.eye(40) + (columns * (size * spectrum)**2) @ columns.T
            gain = (readings @ readings - readings @ np.linalg.solve(whole, readings)) / 2
            every.append((gain, gain - np.linalg.slogdet(whole)[1] / 2))
    by_likelihood, expected = special.logsumexp(every, axis=0) - np.log(len(every))
    found = fit_family(family, Evidence.of(
        columns.T @ columns, columns.T @ readings, float(readings @ readings), 40))
    # rounding of the factors of a covariance of 1e8
    assert found.log_bayes_factor == pytest.approx(expected, abs=1e-6)
    assert found.log_bayes_factor != pytest.approx(by_likelihood, abs=0.1)
    used = columns * found.deviations
    mean = found.deviations * np.linalg.solve(used.T @ used + np.eye(count), used.T @ readings)
    np.testing.assert_allclose(found.mean, mean, atol=1e-6 * np.abs(mean).max())


def test_a_coil_is_a_field():
    coil = magpylib.current.Circle(current=100, diameter=0.4, position=(0.02, 0, 0.1))
    field, instrument = factors(coil.getB(POINTS))
    assert field > instrument + 20
    assert field > 50


def test_a_ripple_of_one_sensor_is_the_instrument():
    ripple = np.zeros_like(POINTS)
    ripple[:, 0] = 2e-4 * np.sin(2 * np.pi * POINTS[:, 2] / 0.15)
    field, instrument = factors(ripple)
    assert instrument > field + 50
    assert instrument > 50


@pytest.mark.parametrize("size", [0.0, 1e-9])
def test_noise_is_neither(size):
    assert max(factors(size * np.ones_like(POINTS))) < 0


def test_a_coil_is_a_field_in_a_plane_too():
    """Across a magnet its field varies along z as well. The control has terms that do not."""
    points = np.vstack([circle(radius, 16, 0.0) for radius in (0.02, 0.04, 0.06)])
    coil = magpylib.current.Circle(current=100, diameter=0.4, position=(0.02, 0, 0.1))
    field = coil.getB(points).ravel()
    left = []
    for waves in (4, 0):
        terms = harmonic_fields(points, in_plane=waves).fields.reshape(-1, field.size).T
        rest = field - terms @ np.linalg.lstsq(terms, field, rcond=None)[0]
        left.append(float(np.linalg.norm(rest) / np.linalg.norm(field)))
    assert left[0] < 2e-3  # four half waves are no complete set
    assert left[1] > 0.05
