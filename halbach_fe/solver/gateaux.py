"""The Gateaux derivative of the field with respect to the magnetization of one block.

The derivative dB solves the linearized problem with the block's change of magnetization as its
source. With linear iron that is the original problem; with non-linear iron the reluctivity nu is
replaced by the differential reluctivity dH/dB at the solution for the nominal array.
"""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.solver.formulation_choice import choose_route, formulation_of
from halbach_fe.solver.magnetostatics import solve_sources, solve_tangent
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import MU_0


def gateaux_derivative(magnet: Magnet, block: int, points: Floats, session: Session) -> Floats:
    """Return the derivative of B along the nominal direction of magnetization of a block.

    The iron is at its operating point in the nominal array.

    Parameters
    ----------
    magnet : Magnet
    block : int
        Number of the block, from 0.
    points : ndarray, shape (n, 3), in m
        Anywhere inside the outer boundary, also in magnet and iron.
    session : Session

    Returns
    -------
    ndarray, shape (n, 3), in T m/A

    Raises
    ------
    StudyError
        If the array has no block of this number.
    """
    blocks = magnet.blocks
    if not 0 <= block < len(blocks):
        raise StudyError(f"Input block of study {magnet.name} must be one of its {len(blocks)} "
                         f"blocks; instead received number {block + 1}. Correct the number.")
    # Solve for B itself by a vector potential: in materials the field in vacuum has no exact form
    # to which a reaction could be added, and the gradient of the scalar potential is H, not B.
    direct = magnet.with_(solver__method="direct", solver__route="auto")
    formulation = formulation_of(direct, choose_route(direct, points))
    if magnet.is_nonlinear:
        fields = solve_tangent(direct, points, (block,), session, formulation, anywhere=True)[1]
    else:
        fields = solve_sources(direct, points, (block,), session, formulation, anywhere=True)
    size, changed = magnet.dimension, blocks[block]
    # the change of remanence in T for a change of magnetization by 1 A/m along the easy axis
    remanence = MU_0 * changed.recoil_tensor @ np.array(changed.easy_axis)
    return np.einsum("knc,k->nc", fields[1:1 + size], remanence[:size])
