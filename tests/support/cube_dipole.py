"""A small MRI dipole of cubes by magpylib, its study, and maps of all or of one component."""

from __future__ import annotations

import magpylib
import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.field_map import field_map

TEXT = """
name = "cubes"
[array]
multipole_order = 1
rings = 2
blocks_per_ring = 12
inner_radius_m = 0.050
outer_radius_m = 0.062
ring_length_m = 0.012
ring_gap_m = 0.010
remanence_T = 1.27
recoil_permeability = 1.0
[array.block]
shape = "cuboid"
width_m = 0.012
orientation = "magnetization"
[mesh]
block_size_m = 0.008
[observation]
quantity = "flux_density"
[observation.positions]
kind = "circles"
radius_m = 0.03
angles = 8
[[noise.regions]]
name = "bore"
sigma_T = 1e-4
[prior]
magnitude_sd = 0.01
direction_sd_deg = 1.0
[inference.held_out]
scan_lines_every = 5
"""

GRID = np.stack(np.meshgrid(0.008 * np.arange(-2, 3), 0.008 * np.arange(-2, 3),
                            0.01 * np.arange(-3, 4), indexing="ij"), axis=-1).reshape(-1, 3)

NOISE_T = 1e-4


def noisier(sigma: float) -> str:
    """The study of another noise in T."""
    return TEXT.replace("sigma_T = 1e-4", f"sigma_T = {sigma:g}")


def cubes(generator: np.random.Generator) -> magpylib.Collection:
    """Cubes of 12 mm, 1 % and half a degree off, in two rings 22 mm apart."""
    sources = []
    for z in (-0.011, 0.011):
        for slot in range(12):
            angle = np.radians(30.0 * slot)
            one = magpylib.magnet.Cuboid(
                dimension=(0.012,) * 3, position=(0.056 * np.cos(angle), 0.056 * np.sin(angle), z),
                polarization=(1.27 * (1 + 0.01 * generator.standard_normal()), 0.0, 0.0))
            one.rotate_from_angax(60.0 * slot + 0.5 * generator.standard_normal(), "z")
            sources.append(one)
    return magpylib.Collection(*sources)


def read_map(
    generator: np.random.Generator, factor: float = 1.0, noise: float = NOISE_T,
) -> xr.Dataset:
    """A map in the magnet's own axes, times a factor."""
    field = factor * cubes(generator).getB(GRID)
    return field_map(GRID, field + noise * generator.standard_normal(field.shape))


def component(data: xr.Dataset, is_really: str, named: str) -> xr.Dataset:
    """The map of one component, under a name that may be wrong."""
    field: Floats = np.full_like(data["B_T"].values, np.nan)
    field[:, "xyz".index(named)] = data["B_T"].values[:, "xyz".index(is_really)]
    return field_map(GRID, field)
