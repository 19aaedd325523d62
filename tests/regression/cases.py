"""The studies whose field maps are stored, and how a recomputed map is compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from halbach_fe.study import Study, parse_study
from tests.conftest import DIPOLE, changed, circle

FOLDER = Path(__file__).parent

_IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}
_SHORT = changed(DIPOLE, dimension=3, array__rings=2, array__ring_length_m=0.08,
                 array__ring_gap_m=0.002, mesh={"block_size_m": 0.03, "layers_per_ring": 2})

CASES: dict[str, Study] = {
    "dipole_2d_direct": parse_study(changed(DIPOLE, iron_ring=_IRON,
                                            solver={"method": "direct"})),
    "dipole_2d_reaction": parse_study(changed(DIPOLE, iron_ring=_IRON)),
    "dipole_3d_direct": parse_study(changed(_SHORT, iron_ring=_IRON,
                                            solver={"method": "direct"})),
    "dipole_3d_reaction": parse_study(changed(_SHORT, iron_ring=_IRON)),
}

TOLERANCE = {(2, "direct"): 3e-3, (2, "reaction"): 1e-3, (3, "direct"): 2e-2,
             (3, "reaction"): 1e-3}
"""Of the largest field, by dimension and method. One version of Gmsh repeats a map to 1e-12.
Another may mesh differently, and then a map moves within its discretization error: 2e-3 for the
direct field in 2D and some per cent in 3D, and far less for the reaction. In 2D the iron alone is
7e-3 of the field."""


def tolerance(study: Study) -> float:
    """The tolerance for a study's map."""
    return TOLERANCE[study.dimension, study.solver.method]


def points_of_case(study: Study) -> np.ndarray:
    """Circles in the bore, and beyond the ends in 3D."""
    heights = (0.0,) if study.dimension == 2 else (-0.15, 0.013, 0.07)
    return np.vstack([circle(0.06, 8, z) for z in heights])


def difference(found: np.ndarray, stored: np.ndarray) -> float:
    """Largest difference over the largest stored field."""
    if found.shape != stored.shape or not np.isfinite(found).all():
        return np.inf
    return float(np.abs(found - stored).max() / np.abs(stored).max())
