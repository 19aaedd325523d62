"""Fields that are not the magnet's own: background, neighbouring magnets, magnetized objects."""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import rotation_about_z
from halbach_fe.solver.vacuum_field import field_of
from halbach_fe.study.magnet import Neighbour
from halbach_fe.study.materials import MU_0

EXACT = 12
"""Gauss points per panel for the field as exact as it is computed anywhere."""


def external_field(magnet: Magnet, points: Floats) -> Floats:
    """B (n, 3) in T at points (n, 3) in m of what the study has outside the magnet."""
    external = magnet.external
    field = np.tile(external.background_T, (len(points), 1)).astype(float)
    for neighbour in external.neighbours:
        field += neighbour_field(magnet, neighbour, points)
    for dipole in external.dipoles:
        field += dipole_field(np.array(dipole.position_m), np.array(dipole.moment_A_m2), points)
    return field


def neighbour_field(
    magnet: Magnet, neighbour: Neighbour, points: Floats, order: int = EXACT
) -> Floats:
    """B (n, 3) in T of a magnet like the study's, in vacuum, by ``order`` Gauss points a panel."""
    turn = rotation_about_z(np.radians(neighbour.turn_deg))
    seen = (points - [0.0, 0.0, neighbour.z_m]) @ turn
    return np.asarray(neighbour.factor * field_of(magnet.blocks, seen, order) @ turn.T)


def dipole_field(position: Floats, moment: Floats, points: Floats) -> Floats:
    """B (n, 3) in T of a point dipole with a moment in A m^2 (Jackson, 3rd ed., eq. 5.56)."""
    offset = points - position
    distance = np.linalg.norm(offset, axis=1)[:, None]
    direction = offset / distance
    along = (direction @ moment)[:, None]
    return np.asarray(MU_0 / (4 * np.pi) * (3 * along * direction - moment) / distance**3)
