"""How the field answers a change of one block: the Gateaux derivative, anywhere in the plane."""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.solver.field import choose_route, formulation_of
from halbach_fe.solver.magnetostatics import solve_sources, solve_tangent
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import MU_0


def gateaux_derivative(magnet: Magnet, block: int, points: Floats, session: Session) -> Floats:
    """Derivative of B along the nominal magnetization of a block, iron at its operating point.

    Parameters
    ----------
    block : int
        Number of the block, from 0.
    points : ndarray, shape (n, 3), in m
        Anywhere inside the boundary, magnet and iron included.

    Returns
    -------
    ndarray, shape (n, 3), in T m/A
    """
    blocks = magnet.blocks
    if not 0 <= block < len(blocks):
        raise StudyError(f"Input block of study {magnet.name} must be one of its {len(blocks)}; "
                         f"instead received {block + 1}.")
    # the field in materials has no exact form, and the scalar potential gives H there
    direct = magnet.with_(solver__method="direct", solver__route="auto")
    formulation = formulation_of(direct, choose_route(direct, points))
    if magnet.is_nonlinear:
        fields = solve_tangent(direct, points, (block,), session, formulation, anywhere=True)[1]
    else:
        fields = solve_sources(direct, points, (block,), session, formulation, anywhere=True)
    size, one = magnet.dimension, blocks[block]
    remanence = MU_0 * one.recoil_tensor @ np.array(one.easy_axis)  # of 1 A/m
    return np.einsum("knc,k->nc", fields[1:1 + size], remanence[:size])
