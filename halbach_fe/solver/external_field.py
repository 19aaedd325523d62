"""Fields of external sources: background, neighbouring magnets, magnetized objects.

They are added in vacuum: the magnet's permeability and iron do not react to them.
"""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import rotation_about_z
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.magnet import Neighbour, check_apart
from halbach_fe.study.materials import MU_0


def external_field(magnet: Magnet, points: Floats) -> Floats:
    """Return B (n, 3) in T of the study's external sources at points (n, 3) in m.

    Raises
    ------
    StudyError
        If a point is at a dipole.
    """
    external = magnet.external
    check_apart(external, points, magnet.name)
    field = np.tile(external.background_T, (len(points), 1)).astype(float)
    for neighbour in external.neighbours:
        field += neighbour_field(magnet, neighbour, points)
    for dipole in external.dipoles:
        field += dipole_field(np.array(dipole.position_m), np.array(dipole.moment_A_m2), points)
    return field


def neighbour_field(magnet: Magnet, neighbour: Neighbour, points: Floats) -> Floats:
    """Return B of a second magnet with the study's blocks, shifted along z and turned about z.

    Its permeability is that of vacuum, and its remanence is scaled by ``neighbour.factor``.

    Parameters
    ----------
    magnet : Magnet
    neighbour : Neighbour
    points : ndarray, shape (n, 3), in m

    Returns
    -------
    ndarray, shape (n, 3), in T
    """
    turn = rotation_about_z(np.radians(neighbour.turn_deg))
    local_points = (points - [0.0, 0.0, neighbour.z_m]) @ turn
    return np.asarray(neighbour.factor * field_of(magnet.blocks, local_points) @ turn.T)


def dipole_field(position: Floats, moment: Floats, points: Floats) -> Floats:
    """Return B (n, 3) in T of a point dipole at points (n, 3) in m.

    ``position`` (3,) is in m and ``moment`` (3,) in A m^2. See J. D. Jackson, Classical
    Electrodynamics, 3rd ed., eq. 5.56.
    """
    offset = points - position
    distance = np.linalg.norm(offset, axis=1)[:, None]
    direction = offset / distance
    along = (direction @ moment)[:, None]
    return np.asarray(MU_0 / (4 * np.pi) * (3 * along * direction - moment) / distance**3)
