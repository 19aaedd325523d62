"""What blocks have lost by the knee of their demagnetization curve, for the truth of a campaign.

Every block is divided into cells. A cell keeps the part ``tanh((h + h_c) / (2 w))`` of its
remanence, for the component h of mu_0 H along the easy axis at the cell's middle; the width w puts
the knee, where 0.9 is left, at ``squareness`` times the coercivity h_c. The losses change the field
that the other cells are in, so that a damped iteration repeats both until nothing changes. magpylib
computes the fields, which are those of blocks in vacuum: losses of permeable blocks are not
simulated.

What is lost in layers thinner than a cell is missed, and the error falls with the square of the
size of the cells. Losses in cells of two sizes are therefore extrapolated to none (Richardson), as
the sum of those in the smaller cells, times more than 1, and in the larger ones, times a negative
number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import CheckFailedError
from halbach_fe.synthetic.magpylib_field import WHOLE, piece_field, vacuum_field
from halbach_fe.synthetic.shapes import CylinderBody, Fractions, PrismBody, SectorBody, Shape
from halbach_fe.synthetic.true_magnet import Body, LostCell, TrueMagnet, vector

ALONG_SIDE, FEW_BLOCKS, ALONG_SIDE_OF_MANY = (4, 6), 24, (3, 4)
"""Numbers of cells along each side of a block from which losses are extrapolated, for magnets of
few and of more blocks. The time grows with the square of all cells.

In a ring of 12 cuboids the field of such losses differs by 1.5 % from that by 6 and 8 cells, and
that of 6 cells alone by 14 %.
"""

TOLERANCE, MAX_STEPS = 1e-7, 5000
"""Largest change of the part that a cell keeps, which ends the iteration, and the largest number of
steps."""

NEAR = 6.0
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
    near = distance <= NEAR * size
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
