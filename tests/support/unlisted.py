"""A magnet on which causes outside the catalogue are hidden, and what counts as a false name."""

from __future__ import annotations

from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.study.reader import parse_study
from tests.support.cuboids import DOCUMENT

STUDY = parse_study(DOCUMENT | {
    "name": "unlisted",
    "observation": {
        "quantity": "flux_density",
        "positions": {
            "kind": "circles", "radius_m": [0.02, 0.035, 0.05, 0.06, 0.07], "angles": 12,
            "z_min_m": -0.15, "z_max_m": 0.15, "count": 13}},
    "inference": {"held_out": {"every": 5}},
})
"""The cuboids, mapped on circles of five radii."""


def false_names(found: Diagnosis) -> list[str]:
    """Return everything that was named. Nothing of it is there; every symptom counts."""
    names = [" and ".join(error.names) for error in found.gross_errors]
    names += ["outliers"] * bool(found.outliers) + ["vibration"] * bool(found.position_noise)
    return names + [effect.selection.candidate.name for effect in found.identified]
