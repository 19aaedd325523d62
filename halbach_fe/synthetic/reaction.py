"""The field that materials add to that of bodies in vacuum: by elements, or by separate blocks.

Of many separate blocks it needs no mesh. NGSolve would need millions of elements for hundreds of
cubes in air. Here every block has Gauss points, at which its material answers
``P = (mu_r - 1) mu_0 H``. H has two parts:

* the field of all remanences in vacuum, at every Gauss point, by magpylib's closed forms for the
  block itself and its neighbours, and by eight dipoles for each block farther away;
* the field of all answers P, in which each block counts with its mean. The means are the unknowns
  of a linear system, with one equation per block, again by closed forms nearby and by dipoles
  farther away.

The first answer, of first order in mu_r - 1, is thus resolved within the block. The answer to the
answers, of second order, is that to the mean of each block, and the mean answer to its deviations
from the mean: by reciprocity, the mean field that deviations in one block have in another is that
of the uniformly polarized other block, weighted with the deviations.

`halbach_fe.solver.moments` is another method: it divides blocks into cells, integrates their
interactions over both cells with kernels of its own, and solves for every cell.

What blocks lose by the knee of their demagnetization curve changes that field too. Every block is
divided into cells. A cell keeps the part ``tanh((h + h_c) / (2 w))`` of its remanence, for the
component h of mu_0 H along the easy axis at the cell's middle; the width w puts the knee, where 0.9
is left, at ``squareness`` times the coercivity h_c. The losses change the field that the other
cells are in, so that a damped iteration repeats both until nothing changes. magpylib computes the
fields, which are those of blocks in vacuum: losses of permeable blocks are not simulated.

What is lost in layers thinner than a cell is missed, and the error falls with the square of the
size of the cells. Losses in cells of two sizes are therefore extrapolated to none (Richardson), as
the sum of those in the smaller cells, times more than 1, and in the larger ones, times a negative
number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse.linalg import LinearOperator, gmres
from scipy.spatial import cKDTree

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import CheckFailedError, StudyError, must_be
from halbach_fe.core.progress import Progress
from halbach_fe.study.materials import MU_0
from halbach_fe.synthetic import ngsolve_reaction
from halbach_fe.synthetic.magpylib_field import (
    WHOLE,
    no_progress,
    piece_field,
    unit_fields,
    vacuum_field,
)
from halbach_fe.synthetic.ngsolve_reaction import Elements, moment_field
from halbach_fe.synthetic.shapes import CylinderBody, Fractions, PrismBody, SectorBody, Shape
from halbach_fe.synthetic.true_magnet import Body, LostCell, TrueMagnet, vector

NEAR = 1.5
"""Distance of two blocks, relative to the sum of the radii of spheres around them, up to which
closed forms are used. Beyond it the eight dipoles of a cube are good to 1e-3 of its field."""

NODES = {100: 6, 400: 4, 1500: 3}
"""Gauss points along a side of a block, by the largest number of blocks; 2 for more blocks."""


@dataclass(frozen=True)
class _Block:
    """A body with its Gauss points."""

    body: Body
    nodes: Floats
    """Along the magnet's axes. Shape (n, 3), in m."""
    volumes: Floats
    """Shape (n,), in m^3."""
    answer: Floats
    """``mu_r - 1`` along the magnet's axes. Shape (3, 3)."""

    def mean(self, values: Floats) -> Floats:
        """Return the mean over the block of values at its nodes, (n, ...)."""
        return np.tensordot(self.volumes / self.volumes.sum(), values, axes=1)


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
    extra = np.zeros((len(blocks), 3))
    for _ in range(2):  # without and with the deviations of the answers from their means
        means = _solve_means(blocks, answering, near, first, extra, tensors)
        far = _far_of_means(blocks, answering, near, means) + extra
        answers = [(first[row] + far[row] + sum(
            tensor @ means[column] for column, tensor in tensors[row].items()))
            @ block.answer.T for row, block in enumerate(blocks)]
        extra = _of_deviations(blocks, tensors, answers)
        answers = [own + _within(block, own) @ block.answer.T
                   for block, own in zip(blocks, answers, strict=True)]
    places, moments, uniform = [], [], []
    for block, own in zip(blocks, answers, strict=True):
        mean = block.mean(own)
        places.append(block.nodes)
        moments.append((own - mean) * block.volumes[:, None])
        uniform.append(replace(block.body, parts=(), remanence=vector(
            block.body.orientation.inv().apply(mean))))
    return vacuum_field(uniform, points) + moment_field(
        np.vstack(places), np.vstack(moments), points)


def lone_moment_matrix(shape: Shape, permeability: Floats) -> Floats:
    """Return the matrix (3, 3) in A m^2 / T from a lone block's remanence to its moment.

    ``permeability`` (3, 3) is the relative recoil permeability in the shape's axes.
    """
    # Gauss points along a side of a block that is measured alone. With 12 the moment of a sector of
    # permeability 1.05 changes by 2e-5.
    lone_nodes = 6
    if np.array_equal(permeability, np.eye(3)):
        return shape.volume / MU_0 * np.eye(3)
    nodes, volumes = shape.nodes(lone_nodes)
    fields = np.stack([piece_field((shape, *WHOLE), axis, nodes) for axis in np.eye(3)], axis=2)
    share, chi = volumes / volumes.sum(), permeability - np.eye(3)
    mean = np.tensordot(share, fields, axes=1)
    solved = np.linalg.inv(np.eye(3) - chi @ mean)  # polarization and mean answer, per remanence
    answers = chi @ fields @ solved
    deviations = answers - np.tensordot(share, answers, axes=1)
    extra = np.einsum("n,nji,njk->ik", share, fields, deviations)
    return np.asarray(shape.volume / MU_0 * solved @ (np.eye(3) + chi @ extra))


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
    first: Sequence[Floats], extra: Floats, tensors: Sequence[dict[int, Floats]],
) -> Floats:
    """Return the mean answer (blocks, 3) in T of every block.

    ``extra`` (blocks, 3) in T is added to the field ``first`` at the nodes.
    """
    # Relative residual of the linear system. The method's own error was measured to be 3e-3 of the
    # reaction at 0.6 times the size of a block from its face, for permeabilities of 1.06 and 1.15.
    precision = 1e-8
    coupling = [{column: block.answer @ block.mean(tensor) for column, tensor in own.items()}
                for block, own in zip(blocks, tensors, strict=True)]
    right = np.array([block.answer @ (block.mean(field) + more)
                      for block, field, more in zip(blocks, first, extra, strict=True)])

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
                             right.ravel(), x0=right.ravel(), rtol=precision, restart=50)
    if failed:
        raise CheckFailedError("The answers of separate blocks to one another do not converge.")
    return np.asarray(solution.reshape(-1, 3))


def _of_deviations(
    blocks: Sequence[_Block], tensors: Sequence[dict[int, Floats]], answers: Sequence[Floats]
) -> Floats:
    """Return the mean field (blocks, 3) in T, in every block, of what deviates from means nearby.

    The field is that of the deviations of ``answers`` (n, 3) in T, in the block and its neighbours,
    from their means.
    """
    field = np.zeros((len(blocks), 3))
    for block, own, values in zip(blocks, tensors, answers, strict=True):
        deviations = (values - block.mean(values)) * block.volumes[:, None]
        for column, tensor in own.items():
            field[column] += np.einsum("nji,nj->i", tensor, deviations) / (
                blocks[column].volumes.sum())
    return field


def _within(block: _Block, answers: Floats) -> Floats:
    """Return how the field (n, 3) in T of a block's own deviations deviates from its mean in it.

    The answer at each node fills a sphere of the node's share of the block's volume. Outside the
    sphere its field is that of a dipole; inside, mu_0 H is -1/3 of the polarization. The mean is
    left to `_of_deviations`, which is exact.
    """
    deviations = answers - block.mean(answers)
    offset = block.nodes[:, None] - block.nodes
    distance = np.linalg.norm(offset, axis=2)
    inside = distance < np.cbrt(3 * block.volumes / (4 * np.pi))
    distance[inside] = np.inf
    moments = deviations * block.volumes[:, None] / (4 * np.pi)
    along = 3 * np.einsum("ijk,jk->ij", offset, moments) / distance**5
    field = (np.einsum("ij,ijk->ik", along, offset) - distance**-3 @ moments
             - inside @ deviations / 3)
    return np.asarray(field - block.mean(field))


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


def reaction_field(
    magnet: TrueMagnet, points: Floats, elements: Elements | None = None,
    progress: Progress = no_progress,
) -> Floats:
    """Return the part of B (n, 3) in T, at points (n, 3) in m in air, that the materials add.

    It is the difference between the field with their response and that of `vacuum_field`.

    Raises
    ------
    StudyError
        If the magnet has iron and more separate blocks than can be meshed with it.
    """
    if magnet.is_vacuum:
        return np.zeros((len(points), 3))
    if by_elements(magnet):
        return ngsolve_reaction.reaction_field(magnet, points, elements)
    return separate_reaction(magnet, points, progress)


def by_elements(magnet: TrueMagnet) -> bool:
    """Tell whether NGSolve computes the reaction, or `separate_reaction` does.

    NGSolve meshes cross-sections, rings of sectors and trapezoids, and all magnets with iron.
    Cuboids and free blocks in three dimensions, whose gaps need many elements, are meshed only with
    iron.

    Raises
    ------
    StudyError
        If the magnet has iron and more separate blocks than can be meshed with it.
    """
    # Largest number of separate blocks that are meshed together with iron, in three dimensions.
    # Each has some 1000 elements of order 3, which is some 3 GB for all.
    most_in_iron = 400
    bodies = magnet.all_bodies
    separate = sum(bool(body.name) or (isinstance(body.shape, PrismBody) and body.shape.is_cuboid)
                   for body in bodies)
    if magnet.dimension == 2 or not separate:
        return True
    if magnet.iron is None:
        return False
    if separate > most_in_iron:
        raise StudyError(must_be(
            "`array` with iron", "the study", f"of at most {most_in_iron} cuboids and free blocks "
            "for a simulated measurement in 3D", str(separate),
            "Leave the iron out, or use fewer blocks."))
    return True


ALONG_SIDE, FEW_BLOCKS, ALONG_SIDE_OF_MANY = (4, 6), 24, (3, 4)
"""Numbers of cells along each side of a block from which losses are extrapolated, for magnets of
few and of more blocks. The time grows with the square of all cells.

In a ring of 12 cuboids the field of such losses differs by 1.5 % from that by 6 and 8 cells, and
that of 6 cells alone by 14 %.
"""

TOLERANCE, MAX_STEPS = 1e-7, 5000
"""Largest change of the part that a cell keeps, which ends the iteration, and the largest number of
steps."""

NEAR_A_CELL = 6.0
"""Distance of a cell, in cube roots of its volume, beyond which it is a dipole."""


@dataclass(frozen=True)
class _Cell:
    """A part of a body, see `BodyPart`, and its middle (3,) in m."""

    body: Body
    u: Fractions
    v: Fractions
    middle: Floats

    def lost(self, part: float) -> LostCell:
        """Return the cell with the loss of a part of its remanence."""
        return LostCell(self.body, self.u, self.v, part)


def with_knee_losses(magnet: TrueMagnet, coercivity_T: float, squareness: float) -> TrueMagnet:
    """Return the magnet with the losses of its blocks, extrapolated from cells of two sizes.

    ``coercivity_T`` is mu_0 H_cJ in T.

    Raises
    ------
    CheckFailedError
        If the iteration does not come to rest.
    """
    count = sum(bool(np.any(body.remanence)) for body in magnet.bodies)
    fewer, more = ALONG_SIDE if count <= FEW_BLOCKS else ALONG_SIDE_OF_MANY
    beyond = 1 / ((more / fewer)**2 - 1)
    # losses below this part of the remanence are left out
    negligible = 1e-6
    return replace(magnet, losses=(*magnet.losses, *(
        cell.lost(factor * part)
        for along_side, factor in ((more, 1 + beyond), (fewer, -beyond))
        for cell, part in losses_in_cells(magnet, coercivity_T, squareness, along_side)
        if part > negligible)))


def losses_in_cells(
    magnet: TrueMagnet, coercivity_T: float, squareness: float, along_side: int
) -> list[tuple[_Cell, float]]:
    """Return all cells, ``along_side`` on each side of a block, and the part that each has lost.

    Raises
    ------
    CheckFailedError
        If the iteration does not come to rest.
    """
    bodies = [body for body in magnet.bodies if np.any(body.remanence)]
    cells = [cell for body in bodies for cell in _cells(body, along_side)]
    middles = np.array([cell.middle for cell in cells])
    easy = np.array([cell.body.orientation.apply(cell.body.remanence) for cell in cells])
    strength = np.linalg.norm(easy, axis=1)
    easy = easy / strength[:, None]
    outer = np.einsum("ni,ni->n", vacuum_field(magnet.bodies, middles), easy)
    by_loss = np.array([np.einsum("ni,ni->n", _field_of_loss(cell, middles), easy)
                        for cell in cells]).T  # along the easy axis, if another loses everything
    width = coercivity_T * (1 - squareness) / (2 * float(np.arctanh(0.9)))
    lost = np.zeros(len(cells))
    # a loss changes the field by at most the remanence, and that the loss by 1 / (2 w)
    damping = 1 / (1 + float(strength.max()) / (2 * width))
    for _ in range(MAX_STEPS):
        now = 1 - np.tanh((outer + by_loss @ lost + coercivity_T) / (2 * width))
        change = damping * (now - lost)
        lost = lost + change
        if np.abs(change).max() < TOLERANCE:
            return list(zip(cells, lost.tolist(), strict=True))
    raise CheckFailedError("The losses of the blocks do not come to rest.")


def lost_field(losses: Sequence[LostCell], points: Floats) -> Floats:
    """Return the change (n, 3) in T of mu_0 H by lost magnetization at points (n, 3) in m."""
    total = np.zeros((len(points), 3))
    for cell in losses:
        body = cell.body
        polarization = -cell.part * body.seat_orientation.inv().apply(body.remanence)
        own = piece_field((body.shape, cell.u, cell.v), polarization, body.in_shape(points))
        total += own @ body.shape_orientation.as_matrix().T
    return total


def _field_of_loss(cell: _Cell, points: Floats) -> Floats:
    """Return mu_0 H (n, 3) in T at points (n, 3) in m if a cell loses all its remanence.

    Far away that is the field of a dipole, which is in error by the square of size by distance.
    """
    body, away = cell.body, points - cell.middle
    distance = np.linalg.norm(away, axis=1)
    assert not isinstance(body.shape, CylinderBody)  # it has no parts
    size = np.cbrt(body.shape.volume * body.shape.share(cell.u, cell.v))
    near = distance <= NEAR_A_CELL * size
    field = np.zeros((len(points), 3))
    field[near] = lost_field([cell.lost(1.0)], points[near])
    far = away[~near] / distance[~near, None]
    moment = -size**3 / (4 * np.pi) * body.orientation.apply(body.remanence)
    field[~near] = (3 * far * (far @ moment)[:, None] - moment) / distance[~near, None]**3
    return field


def _cells(body: Body, count: int) -> list[_Cell]:
    """Divide a body of four edges into ``count`` cells along each of its sides."""
    shape = replace(body.shape, length=body.shape.length / count)
    found = []
    for k in range(count):
        z = body.shape.length * ((k + 0.5) / count - 0.5)
        for i in range(count):
            for j in range(count):
                u = i / count, (i + 1) / count
                v = 2 * j / count - 1, 2 * (j + 1) / count - 1
                local = np.append(_middle(body, u, v), z)
                if isinstance(shape, PrismBody) and shape.is_cuboid:  # which magpylib does faster
                    width = shape.inner_width / count
                    own = replace(shape, depth=shape.depth / count, inner_width=width,
                                  outer_width=width)
                    cell, u, v = _moved(body, own, local), *WHOLE
                else:
                    cell = _moved(body, shape, np.array([0.0, 0.0, z]))
                found.append(_Cell(cell, u, v, body.shape_orientation.apply(local) + body.position))
    return found


def _moved(body: Body, shape: Shape, by: Floats) -> Body:
    """Return a body of another shape, moved by a vector (3,) in m in the axes of its shape."""
    moved = body.displacement + body.shape_orientation.apply(by)
    return replace(body, shape=shape, parts=(), displacement=vector(moved))


def _middle(body: Body, u: Fractions, v: Fractions) -> Floats:
    """Return the middle (2,) in m of a part of a body, in the axes of its shape."""
    shape = body.shape
    assert not isinstance(shape, CylinderBody)  # it has no parts
    if isinstance(shape, SectorBody):
        (radius, angle) = (float(np.mean(limits)) for limits in shape.part(u, v))
        return np.array([radius * np.cos(angle) - shape.middle, radius * np.sin(angle)])
    return np.asarray(shape.part(u, v).mean(axis=0))
