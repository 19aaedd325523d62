"""The error of coarse cells is shared by all readings, and no block takes its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference import infer as inference
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.moments.solve import solve_moments
from halbach_fe.study.reader import parse_study
from tests.conftest import circle

SIGMA = 1e-4
POINTS = np.vstack([circle(radius, 24, z) for radius in (0.01, 0.02) for z in (-0.01, 0.0, 0.01)])
CUBES = {
    "name": "cubes", "mesh": {"block_size_m": 0.02, "cells_per_side": 2},
    "array": {"free_blocks": {
        "name": list("abcd"), "shape": ["cuboid"] * 4, "x_m": [0.045, 0.0, -0.045, 0.0],
        "y_m": [0.0, 0.045, 0.0, -0.05], "z_m": [0.0, 0.01, 0.0, 0.0],
        **{f"size_{axis}_m": [0.03] * 4 for axis in "xyz"},
        "remanence_x_T": [1.2, -1.2, 1.2, -1.2], "remanence_y_T": [0.0] * 4,
        "remanence_z_T": [0.0] * 4, "recoil_permeability": [1.5] * 4}},
    "noise": {"regions": [{"name": "all", "sigma_T": SIGMA}]},
    "prior": {"magnitude_sd": 0.01, "direction_sd_deg": 0.5},
    "observation": {"quantity": "flux_density",
                    "positions": {"kind": "circles", "radius_m": 0.02, "angles": 12}}}


def chi2_of_blocks(session, generator):
    """Chi-squared per parameter of the magnetizations, by cells of half a side, of the readings of
    blocks in cells of an eighth.
    """
    magnet, found = build_magnet(parse_study(CUBES)), []
    for _ in range(4):
        change = generator.normal(size=(4, 3)) * [0.012, 0.01, 0.01]
        blocks = [replace(one, remanence=one.remanence + each)
                  for one, each in zip(magnet.blocks, change, strict=True)]
        field = field_of(blocks, POINTS) + solve_moments(blocks, cells_per_side=8).reaction(POINTS)
        readings = field + SIGMA * generator.standard_normal(POINTS.shape)
        result = infer(magnet, field_map(POINTS, readings), session)
        off = result.posterior.mean - np.concatenate([one.magnetization for one in blocks])
        found.append(off @ np.linalg.solve(result.posterior.covariance, off) / len(off))
    assert result.solver_over_noise > 1
    return np.mean(found)


def test_blocks_are_within_their_bars(session, generator, monkeypatch):
    """Taken for independent from reading to reading (the control), the error of the cells averages
    out, and the blocks take its place. 0.4 and 2.2 were measured; 1 is expected within 0.2.
    """
    assert chi2_of_blocks(session, generator) < 1.4
    monkeypatch.setattr(
        inference, "seen_columns", lambda columns, readings: np.zeros((len(columns), 0)))
    assert chi2_of_blocks(session, generator) > 1.6
