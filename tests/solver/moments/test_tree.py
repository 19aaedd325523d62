"""Expansions of clusters against direct sums."""

from __future__ import annotations

from dataclasses import replace

import magpylib
import numpy as np
import pytest

from halbach_fe.solver.moments import kernels
from halbach_fe.solver.moments.cells import cells_of
from halbach_fe.solver.moments.interaction import QUADRATURES, Interaction
from tests.solver.moments.bodies import block, cuboid

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
    kernels.regular(*y, 12, near)
    kernels.irregular(*x, 12, far)
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


def ring(turned=0.0):
    """A ring of 8 sectors, the first of which is turned about its middle by an angle in rad."""
    turns = np.arange(8) * np.pi / 4
    blocks = [block("sector", turn=(0.0, 0.0, turn)) for turn in turns]
    return [replace(blocks[0], orientation_rad=(0.0, 0.0, turned)), *blocks[1:]]


def test_congruent_pairs_share_their_matrices():
    """In a ring all blocks are alike, so that an eighth of the pairs represent all of them,
    and fewer where layers are alike too. The matrices are those of every pair by itself.
    """
    interaction = Interaction(cells_of(ring(), 2), opening=0.0)
    close, (first, _, quadrature) = interaction._pairs[1], interaction._kinds
    assert len(close.sources) / 16 < len(first) <= len(close.sources) / 8
    targets, sources = close.targets, close.sources
    for number, (nodes, is_graded) in enumerate(QUADRATURES):
        some = np.flatnonzero(quadrature[interaction._kinds[1]] == number)[::7]
        np.testing.assert_allclose(
            interaction._matrices[some],
            interaction._means(targets[some], sources[some], nodes, is_graded), atol=1e-8)
    # a block that is turned a little shares nothing with the others but what is inside it
    other = Interaction(cells_of(ring(1e-5), 2), opening=0.0)
    assert len(other._kinds[0]) > 1.5 * len(first)


@pytest.mark.parametrize("most", [10**6, 0])
def test_field_along_an_axis(monkeypatch, generator, most):
    """Whether matrices are kept, in single precision, or computed each time. Measured 1e-7 T, of
    fields of some T.
    """
    monkeypatch.setattr("halbach_fe.solver.moments.interaction.MOST_KEPT", most)
    interaction = Interaction(cells_of(ring(), 2))
    polarization = generator.normal(size=(len(interaction.cells), 3))
    along = generator.normal(size=polarization.shape)
    at_nodes, mean = interaction.field_along(along)(polarization)
    expected = interaction.node_field(polarization)
    np.testing.assert_allclose(at_nodes, np.einsum("nqi,ni->nq", expected, along), atol=1e-6)
    np.testing.assert_allclose(mean, interaction.mean_field(polarization), atol=1e-12)
    assert np.abs(at_nodes - np.einsum("nqi,ni->nq", expected, along[::-1])).max() > 0.1


@pytest.mark.parametrize("divisions", [2, 3])
def test_varying_cells_do_not_jump_where_dipoles_replace_parts(divisions, generator, monkeypatch):
    """A cube whose polarization varies, against 20^3 small cubes by magpylib.

    Errors are relative to the amplitude of the polarization, on both sides of the distance at which
    dipoles replace parts. Control: parts with the values of their nodes.
    """
    side, small = 0.01, 20

    def polarization(places):
        return np.stack([places[..., 0] / side, 0 * places[..., 0], places[..., 1] / side], axis=-1)

    cells = cells_of([cuboid((side, side, side))], 1, divisions)
    interaction = Interaction(cells)
    step = side / small
    places = (np.stack(np.meshgrid(*[np.arange(small)] * 3), axis=-1).reshape(-1, 3) + 0.5
              ) * step - side / 2
    of_small = [magpylib.magnet.Cuboid(dimension=[step] * 3, polarization=each, position=place)
                for place, each in zip(places, polarization(places), strict=True)]
    direction = generator.standard_normal((30, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    errors = {}
    for matrix in ("moments", "values"):
        if matrix == "values":
            monkeypatch.setitem(cells.__dict__, "of_parts", np.eye(divisions**3))
        for name, factor in (("parts", 0.999), ("dipoles", 1.001)):
            points = factor * interaction._reach * cells.radius[0] * direction
            right = magpylib.getB(of_small, points, sumup=True)
            for found in (
                    interaction.field_at(points, polarization(cells.nodes)),
                    np.einsum("kinqj,nqj->ki", interaction.readings(points),
                              polarization(cells.nodes))):
                errors.setdefault((matrix, name), []).append(np.sqrt(np.mean((found - right)**2)))
    # measured 1.3e-5 by parts and 3.5e-5 by dipoles, and 1.1e-4 or more by the control
    assert max(errors["moments", "parts"]) < 3e-5
    assert max(errors["moments", "dipoles"]) < 5e-5
    assert min(errors["values", "parts"]) > 8e-5
