"""The reaction of the permeability of many separate blocks, without a mesh.

NGSolve would need millions of elements for hundreds of cubes in air. Here every block has Gauss
points, at which its material answers ``P = (mu_r - 1) mu_0 H``. H has two parts:

* the field of all remanences in vacuum, at every Gauss point, by magpylib's closed forms for the
  block itself and its neighbours, and by eight dipoles for each block farther away;
* the field of all answers P, in which each block counts with its mean. The means are the unknowns
  of a linear system, with one equation per block, again by closed forms nearby and by dipoles
  farther away.

The first answer, of first order in mu_r - 1, is thus resolved within the block, and the answer to
the answers, of second order, is uniform in it. `halbach_fe.solver.moments` is another method: it
divides blocks into cells, integrates their interactions over both cells with kernels of its own,
and solves for every cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres
from scipy.spatial import cKDTree

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import CheckFailedError
from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic.magpylib_field import (
    WHOLE,
    Progress,
    no_progress,
    piece_field,
    unit_fields,
    vacuum_field,
)
from halbach_fe.synthetic.ngsolve_reaction import moment_field
from halbach_fe.synthetic.shapes import Shape
from halbach_fe.synthetic.true_magnet import Body, TrueMagnet, vector

NEAR = 1.5
"""Distance of two blocks, relative to the sum of the radii of spheres around them, up to which
closed forms are used. Beyond it the eight dipoles of a cube are good to 1e-3 of its field."""

NODES = {100: 5, 400: 4, 1500: 3}
"""Gauss points along a side of a block, by the largest number of blocks; 2 for more blocks."""

LONE_NODES = 6
"""Gauss points along a side of a block that is measured alone."""

PRECISION = 1e-8
"""Relative residual of the linear system; the method's own error is 1e-3 of the reaction."""


@dataclass(frozen=True)
class _Block:
    """A body with its Gauss points.

    Attributes
    ----------
    body : Body
    nodes : ndarray, shape (n, 3), in m
        Along the magnet's axes.
    volumes : ndarray, shape (n,), in m^3
    answer : ndarray, shape (3, 3)
        ``mu_r - 1`` along the magnet's axes.
    """

    body: Body
    nodes: Floats
    volumes: Floats
    answer: Floats


def separate_reaction(
    magnet: TrueMagnet, points: Floats, progress: Progress = no_progress
) -> Floats:
    """Return the part of B (n, 3) in T, at points (n, 3) in m in air, that permeability adds.

    Raises
    ------
    CheckFailedError
        If the linear system is not solved.
    """
    sources = [body for body in magnet.all_bodies if any(body.remanence) or not body.is_vacuum]
    count = next((nodes for most, nodes in NODES.items() if len(sources) <= most), 2)
    answering = [number for number, body in enumerate(sources) if not body.is_vacuum]
    blocks = [_block(sources[number], count) for number in answering]
    near = _neighbours(sources)
    first, tensors = _of_remanences(sources, blocks, answering, near, progress)
    means = _solve_means(blocks, answering, near, first, tensors)
    far = _far_of_means(blocks, answering, near, means)
    places, moments, uniform = [], [], []
    for row, block in enumerate(blocks):
        field = first[row] + far[row]
        for column, tensor in tensors[row].items():
            field = field + tensor @ means[column]
        places.append(block.nodes)
        moments.append((field @ block.answer.T - means[row]) * block.volumes[:, None])
        own = block.body.orientation.inv().apply(means[row])
        uniform.append(replace(block.body, remanence=vector(own), parts=()))
    return vacuum_field(uniform, points) + moment_field(
        np.vstack(places), np.vstack(moments), points)


def lone_moment_matrix(shape: Shape, permeability: Floats) -> Floats:
    """Return the matrix (3, 3) in A m^2 / T from a lone block's remanence to its moment.

    ``permeability`` (3, 3) is the relative recoil permeability in the shape's axes.
    """
    nodes, volumes = shape.nodes(LONE_NODES)
    fields = np.stack([piece_field((shape, *WHOLE), axis, nodes) for axis in np.eye(3)], axis=2)
    mean = np.einsum("n,nij->ij", volumes / volumes.sum(), fields)
    response = (permeability - np.eye(3)) @ mean
    return np.asarray(shape.volume / MU_0 * np.linalg.inv(np.eye(3) - response))


def _block(body: Body, count: int) -> _Block:
    nodes, volumes = body.shape.nodes(count)
    turn = body.shape_orientation.as_matrix()
    axes = body.orientation.as_matrix()
    return _Block(body, nodes @ turn.T + body.position, volumes,
                  axes @ body.permeability @ axes.T - np.eye(3))


def _neighbours(sources: Sequence[Body]) -> list[Ints]:
    """Return the numbers of the bodies near each body, itself among them."""
    places = np.array([body.position for body in sources])
    reach = np.array([body.shape.reach for body in sources])
    candidates = cKDTree(places).query_ball_point(places, NEAR * (reach + reach.max()))
    found = []
    for number, others in enumerate(candidates):
        some = np.array(sorted(others))
        distance = np.linalg.norm(places[some] - places[number], axis=1)
        found.append(some[distance <= NEAR * (reach[some] + reach[number])])
    return found


def _of_remanences(
    sources: Sequence[Body], blocks: Sequence[_Block], answering: Sequence[int],
    near: Sequence[Ints], progress: Progress,
) -> tuple[list[Floats], list[dict[int, Floats]]]:
    """Return the field of all remanences at the nodes of every block, and tensors of neighbours.

    The tensors (n, 3, 3) are the fields of neighbours at the block's nodes per T of polarization;
    they are listed by the numbers of block and neighbour.
    """
    row_of = {number: row for row, number in enumerate(answering)}
    first = [np.zeros(block.nodes.shape) for block in blocks]
    tensors: list[dict[int, Floats]] = [{} for _ in blocks]
    total = len(sources) + len(blocks)
    for number, body in enumerate(sources):
        rows = [row_of[other] for other in near[number] if other in row_of]
        if rows:
            nodes = np.vstack([blocks[row].nodes for row in rows])
            fields = unit_fields(body, nodes)
            direct = (vacuum_field([body], nodes) if body.parts
                      else fields @ body.orientation.apply(body.remanence))
            ends = np.cumsum([len(blocks[row].nodes) for row in rows])[:-1]
            for row, tensor, field in zip(rows, np.split(fields, ends), np.split(direct, ends),
                                          strict=True):
                first[row] += field
                if number in row_of:
                    tensors[row][row_of[number]] = tensor
        progress(number + 1, total)
    places, moments = [], []
    for body in sources:
        nodes, volumes = body.shape.nodes(2)
        places.append(nodes @ body.shape_orientation.as_matrix().T + body.position)
        moments.append(np.outer(volumes, body.orientation.apply(body.remanence))
                       * body.mean_factor)
    owner = np.repeat(np.arange(len(sources)), [len(one) for one in places])
    every, strength = np.vstack(places), np.vstack(moments)
    for row, number in enumerate(answering):
        distant = ~np.isin(owner, near[number])
        if distant.any():
            first[row] += moment_field(every[distant], strength[distant], blocks[row].nodes)
        progress(len(sources) + row + 1, total)
    return first, tensors


def _solve_means(
    blocks: Sequence[_Block], answering: Sequence[int], near: Sequence[Ints],
    first: Sequence[Floats], tensors: Sequence[dict[int, Floats]],
) -> Floats:
    """Return the mean answer (blocks, 3) in T of every block."""
    def mean(row: int, values: Floats) -> Floats:
        share = blocks[row].volumes / blocks[row].volumes.sum()
        return np.tensordot(share, values, axes=1)

    coupling = [{column: blocks[row].answer @ mean(row, tensor)
                 for column, tensor in tensors[row].items()} for row in range(len(blocks))]
    right = np.array([block.answer @ mean(row, first[row]) for row, block in enumerate(blocks)])

    def apply(flat: Floats) -> Floats:
        means = flat.reshape(-1, 3)
        far = _far_of_means(blocks, answering, near, means)
        result = means.copy()
        for row, block in enumerate(blocks):
            result[row] -= block.answer @ far[row]
            for column, matrix in coupling[row].items():
                result[row] -= matrix @ means[column]
        return result.ravel()

    size = 3 * len(blocks)
    solution, failed = gmres(LinearOperator((size, size), matvec=apply, dtype=float),
                             right.ravel(), x0=right.ravel(), rtol=PRECISION, restart=50)
    if failed:
        raise CheckFailedError("The answers of separate blocks to one another do not converge.")
    return np.asarray(solution.reshape(-1, 3))


def _far_of_means(
    blocks: Sequence[_Block], answering: Sequence[int], near: Sequence[Ints], means: Floats
) -> Floats:
    """Return the field (blocks, 3) in T, in every block's middle, of the answers far from it."""
    places = np.array([block.volumes @ block.nodes / block.volumes.sum() for block in blocks])
    moments = means * np.array([block.volumes.sum() for block in blocks])[:, None]
    number = np.array(answering)
    far = np.zeros_like(means)
    for row in range(len(blocks)):
        distant = ~np.isin(number, near[number[row]])
        if distant.any():
            far[row] = moment_field(places[distant], moments[distant], places[row:row + 1])[0]
    return far
