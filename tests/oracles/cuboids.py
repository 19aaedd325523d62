"""The field of arrays of thousands of cuboids in vacuum, by magpylib."""

from __future__ import annotations

from typing import Any

import magpylib
import numpy as np
from numpy.typing import NDArray

from tests.conftest import DIPOLE, changed

Floats = NDArray[np.float64]
PITCH = 0.02  # m, of the rings
AT_ONCE = 500_000


def long_dipole(rings: int, count: int, angles: int = 8, **changes: Any) -> dict[str, Any]:
    """Document of a dipole of 16 cuboids a ring, mapped on ``count`` circles from end to end."""
    return changed(DIPOLE, **{
        "name": "long-dipole", "dimension": 3, "array__rings": rings,
        "array__ring_length_m": PITCH, "array__recoil_permeability": 1.0,
        "array__first_block_angle_deg": 0.0, "array__first_magnetization_angle_deg": 0.0,
        "array__block": {"shape": "cuboid", "width_m": 0.04},
        "mesh": {"block_size_m": 0.02}, "noise": {"regions": [{"name": "map", "sigma_T": 5e-5}]},
        "prior": {"magnitude_sd": 0.01, "direction_sd_deg": 1.0, "common_mode_sd": 0.005},
        "inference": {"held_out": {"every": 5}},
        "observation__positions": {
            "kind": "circles", "radius_m": 0.07, "angles": angles, "count": count,
            "z_min_m": -PITCH * rings / 2, "z_max_m": PITCH * rings / 2}, **changes})


def cuboid_field(document: dict[str, Any], magnetization: Floats, points: Floats) -> Floats:
    """B (n, 3) in T at points (n, 3) in m of cuboids with magnetizations (blocks, 3) in A/m."""
    array = document["array"]
    inner, outer, slots = (array[name] for name in (
        "inner_radius_m", "outer_radius_m", "blocks_per_ring"))
    polarization = 4e-7 * np.pi * magnetization.reshape(array["rings"], slots, 3)
    z = PITCH * (np.arange(array["rings"]) - (array["rings"] - 1) / 2)
    size = np.array([outer - inner, array["block"]["width_m"], PITCH])
    total = np.zeros_like(points)
    step = max(1, AT_ONCE // len(z))
    for slot in range(slots):
        angle = 2 * np.pi * slot / slots
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0],
                         [0, 0, 1]])
        own = polarization[:, slot] @ turn
        for first in range(0, len(points), step):
            seen = points[first:first + step] @ turn - [(inner + outer) / 2, 0, 0]
            count = len(seen)
            places = np.repeat(seen, len(z), axis=0)
            places[:, 2] -= np.tile(z, count)
            field = magpylib.core.magnet_cuboid_Bfield(
                places, np.tile(size, (len(places), 1)), np.tile(own, (count, 1)))
            total[first:first + count] += field.reshape(count, len(z), 3).sum(axis=1) @ turn.T
    return total


def aharoni(a, b, c):
    """Demagnetizing factor along c of a cuboid: A. Aharoni, J. Appl. Phys. 83 (1998) 3432."""
    ab, ac, bc = np.hypot(a, b), np.hypot(a, c), np.hypot(b, c)
    r = np.sqrt(a * a + b * b + c * c)
    return ((b * b - c * c) / (2 * b * c) * np.log((r - a) / (r + a))
            + (a * a - c * c) / (2 * a * c) * np.log((r - b) / (r + b))
            + b / (2 * c) * np.log((ab + a) / (ab - a))
            + a / (2 * c) * np.log((ab + b) / (ab - b))
            + c / (2 * a) * np.log((bc - b) / (bc + b))
            + c / (2 * b) * np.log((ac - a) / (ac + a)) + 2 * np.arctan(a * b / (c * r))
            + (a**3 + b**3 - 2 * c**3) / (3 * a * b * c)
            + (a * a + b * b - 2 * c * c) / (3 * a * b * c) * r + c / (a * b) * (ac + bc)
            - (ab**3 + bc**3 + ac**3) / (3 * a * b * c)) / np.pi
