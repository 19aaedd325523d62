"""The moment of a single block that a Helmholtz coil measures.

The demagnetizing field of a block of recoil permeability mu changes its moment, which is
``int (B_r + (mu - 1) mu_0 H) dV / mu_0``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.synthetic.separate_reaction import lone_moment_matrix
from halbach_fe.synthetic.shapes import Shape
from halbach_fe.synthetic.true_magnet import Body


def moments(bodies: tuple[Body, ...], length: float) -> Floats:
    """Return the moments (n, 3) in A m^2 of single bodies, each in its own axes.

    Bodies of infinite length are given the finite ``length`` in m. Bodies of the same shape and
    permeability share their `lone_moment_matrix`, which is good to some 1e-4.
    """
    found = []
    for body in bodies:
        shape, seat = body.shape, body.seat_orientation.as_matrix()
        if np.isinf(shape.length):
            shape = replace(shape, length=length)
        tensor = seat.T @ body.permeability @ seat
        matrix = _known_matrix(shape, tuple((tensor.round(12) + 0.0).ravel().tolist()))
        own = body.seat_orientation.inv().apply(body.remanence) * body.mean_factor
        found.append(body.seat_orientation.apply(matrix @ own))
    return np.array(found)


@lru_cache(maxsize=4096)
def _known_matrix(shape: Shape, permeability: tuple[float, ...]) -> Floats:
    """Return `lone_moment_matrix`, cached; ``permeability`` is the tensor row by row.

    The tensor does not depend on the sign of the easy axis, so opposite blocks share a matrix.
    """
    return lone_moment_matrix(shape, np.reshape(permeability, (3, 3)))
