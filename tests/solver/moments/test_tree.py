"""Expansions of clusters against direct sums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.solver.moments import tree
from halbach_fe.solver.moments.cells import cells_of
from halbach_fe.solver.moments.interaction import Interaction
from tests.solver.moments.bodies import cuboid

SIDE = 0.01


def lattice(generator):
    """80 cubes with gaps, turned at random."""
    places = np.stack(np.meshgrid(*(np.arange(n) for n in (5, 4, 4)), indexing="ij"), -1)
    return [cuboid((SIDE,) * 3, place=tuple(0.018 * place), turn=tuple(generator.normal(size=3)))
            for place in places.reshape(-1, 3)]


@pytest.fixture
def cells(generator):
    return cells_of(lattice(generator), 1)


def error(interaction, polarization):
    """Largest error of the mean field, relative to that with exact interactions only."""
    exact = replace(interaction, opening=0.0).mean_field(polarization)
    return np.abs(interaction.mean_field(polarization) - exact).max() / np.abs(exact).max()


def test_harmonics(generator):
    """1/|x - y| is the sum of conj(R(y)) I(x); its first missing term is (y/x)^13 of it."""
    x, y = np.array([1.0, -0.7, 0.4]), 0.2 * generator.normal(size=3)
    near, far = (np.empty(13**2, complex) for _ in range(2))
    tree.regular(*y, 12, near)
    tree.irregular(*x, 12, far)
    assert np.sum(near.conj() * far).real == pytest.approx(
        1 / np.linalg.norm(x - y), rel=(np.linalg.norm(y) / np.linalg.norm(x)) ** 12)


def test_error_decreases_with_degree(cells, generator):
    """The polarizations all point the same way, as far fields of neighbours add up."""
    polarization = np.tile([1.0, 0.5, -0.2], (len(cells), 1))
    errors = [error(Interaction(cells, degree=degree), polarization) for degree in (2, 4, 6)]
    assert errors[2] < 5e-4  # measured 1e-4; times chi it is below all other errors
    assert errors[0] > 4 * errors[1] > 16 * errors[2]


def test_a_wrong_opening_criterion_is_wrong(cells):
    """Negative control: clusters that touch do not converge."""
    polarization = np.tile([1.0, 0.5, -0.2], (len(cells), 1))
    assert error(Interaction(cells, opening=1.1), polarization) > 1e-3


def test_every_pair_counts_once(cells):
    """Far pairs of clusters and near pairs of cells together are all pairs."""
    interaction = Interaction(cells)
    own = interaction.clusters
    far, near = interaction._pairs
    sizes = np.diff(own.limits, axis=1)[:, 0]
    assert sizes[far.targets] @ sizes[far.sources] + len(near.sources) == len(cells) ** 2
    assert np.array_equal(np.sort(own.order), np.arange(len(cells)))


def test_points(cells, generator):
    """At points too, where parts and dipoles at nodes stand for the same polarization.

    At the nearest points that are treated as far from a cell, 2 nodes per direction have an error
    of 1e-2 of the cell's field, which is 3e-3 of the largest field here.
    """
    points = generator.uniform(-0.05, 0.15, (300, 3))
    interaction = Interaction(cells)
    polarization = np.tile([1.0, 0.5, -0.2], (*cells.weights.shape, 1))
    exact = replace(interaction, opening=0.0).field_at(points, polarization)
    found = interaction.field_at(points, polarization)
    np.testing.assert_allclose(found, exact, atol=5e-3 * np.abs(exact).max())
    coarse = replace(interaction, reading_degree=1).field_at(points, polarization)
    assert np.abs(coarse - exact).max() > 1e-2 * np.abs(exact).max()
