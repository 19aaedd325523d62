"""A magnet on which causes outside the catalogue are hidden, and what counts as a false name."""

from __future__ import annotations

from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.study.reader import parse_study

STUDY = parse_study({
    "name": "unlisted", "dimension": 3,
    "array": {
        "blocks_per_ring": 12, "rings": 3, "inner_radius_m": 0.1, "outer_radius_m": 0.15,
        "ring_length_m": 0.06, "first_block_angle_deg": 90.0,
        "first_magnetization_angle_deg": 180.0, "remanence_T": 1.2,
        "block": {"shape": "cuboid", "width_m": 0.04}},
    "mesh": {"block_size_m": 0.02},
    "observation": {
        "quantity": "flux_density",
        "positions": {
            "kind": "circles", "radius_m": [0.02, 0.035, 0.05, 0.06, 0.07], "angles": 12,
            "z_min_m": -0.15, "z_max_m": 0.15, "count": 13}},
    "noise": {"regions": [{"name": "all", "sigma_T": 5e-5}]},
    "prior": {"magnitude_sd": 0.01, "direction_sd_deg": 1.0, "common_mode_sd": 0.01},
    "inference": {"held_out": {"every": 5}},
})
"""Three rings of 12 cuboids, mapped on circles of five radii, so that a case takes seconds."""


def false_names(found: Diagnosis) -> list[str]:
    """Return everything that was named. Nothing of it is there; every symptom counts."""
    names = [" and ".join(error.names) for error in found.gross_errors]
    names += ["outliers"] * bool(found.outliers) + ["vibration"] * bool(found.position_noise)
    return names + [effect.selection.candidate.name for effect in found.identified]
