"""The studies whose field maps are stored, and how a recomputed map is compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from halbach_fe.study.model import Study, is_nonlinear
from halbach_fe.study.reader import parse_study
from tests.conftest import DIPOLE, changed, circle

FOLDER = Path(__file__).parent

_IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}
_SATURATED = {"inner_radius_m": 0.19, "outer_radius_m": 0.192,
              "curve": {"kind": "steel", "name": "aisi_1010"}}
_SHORT = changed(DIPOLE, dimension=3, array__rings=2, array__ring_length_m=0.08,
                 array__ring_gap_m=0.002, mesh={"block_size_m": 0.03, "layers_per_ring": 2})

CASES: dict[str, Study] = {
    "dipole_2d_direct": parse_study(changed(DIPOLE, iron_ring=_IRON,
                                            solver={"method": "direct"})),
    "dipole_2d_reaction": parse_study(changed(DIPOLE, iron_ring=_IRON)),
    "dipole_2d_saturated": parse_study(changed(DIPOLE, iron_ring=_SATURATED)),
    "dipole_3d_direct": parse_study(changed(_SHORT, iron_ring=_IRON,
                                            solver={"method": "direct"})),
    "dipole_3d_reaction": parse_study(changed(_SHORT, iron_ring=_IRON)),
}

TOLERANCE = {(2, "direct"): 1e-3, (2, "reaction"): 3e-5, (3, "direct"): 2e-2,
             (3, "reaction"): 3e-5}
"""Of the largest field, by dimension and method. One version of Gmsh repeats a map exactly. Another
may mesh differently, and then a map moves within its discretization error. Measured with elements
2 to 5 % larger or smaller: up to 3e-4 (direct) and 9e-6 (reaction) in 2D, 7e-6 for the reaction in
3D (azimuthal modes). The direct field in 3D, by edge elements of order 1, moves by 0.2 where it is
worst: another mesh needs a new reference there. The iron alone is 7e-3 of the field in 2D, 4e-2 in
3D."""


SATURATED = 2e-4
"""The same for the saturated ring, 2 mm of elements of 20 mm: 7e-5 on meshes 2 to 5 % off. Linear
iron of any permeability is 1e-3 away."""


def tolerance(study: Study) -> float:
    """The tolerance for a study's map."""
    return SATURATED if is_nonlinear(study) else TOLERANCE[study.dimension, study.solver.method]


def points_of_case(study: Study) -> np.ndarray:
    """Circles in the bore, and beyond the ends in 3D."""
    heights = (0.0,) if study.dimension == 2 else (-0.15, 0.013, 0.07)
    return np.vstack([circle(0.06, 8, z) for z in heights])


def difference(found: np.ndarray, stored: np.ndarray) -> float:
    """Largest difference over the largest stored field."""
    if found.shape != stored.shape or not np.isfinite(found).all():
        return np.inf
    return float(np.abs(found - stored).max() / np.abs(stored).max())
