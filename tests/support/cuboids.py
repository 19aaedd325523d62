"""A small magnet of three rings of 12 cuboids in vacuum, so that a case takes seconds."""

from __future__ import annotations

NOISE_T = 5e-5

DOCUMENT = {
    "name": "cuboids", "dimension": 3,
    "array": {
        "blocks_per_ring": 12, "rings": 3, "inner_radius_m": 0.1, "outer_radius_m": 0.15,
        "ring_length_m": 0.06, "first_block_angle_deg": 90.0,
        "first_magnetization_angle_deg": 180.0, "remanence_T": 1.2,
        "block": {"shape": "cuboid", "width_m": 0.04}},
    "mesh": {"block_size_m": 0.02},
    "observation": {
        "quantity": "flux_density",
        "positions": {"kind": "circles", "radius_m": [0.05, 0.07], "angles": 12,
                      "z_min_m": -0.2, "z_max_m": 0.2, "count": 11}},
    "noise": {"regions": [{"name": "all", "sigma_T": NOISE_T}]},
    "prior": {"magnitude_sd": 0.01, "direction_sd_deg": 1.0, "common_mode_sd": 0.01},
}
