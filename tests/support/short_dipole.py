"""A short dipole of two rings of cuboids, with errors that magpylib computes, and its map.

Of cuboids, as magpylib's field of a sector takes 50 us a point, of a cuboid less than 2.
"""

from __future__ import annotations

import tomllib
from typing import Any

import magpylib
import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.field_map import field_map
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study

TEXT = """
name = "short"
[array]
multipole_order = 1
rings = 2
blocks_per_ring = 8
inner_radius_m = 0.02
outer_radius_m = 0.04
ring_length_m = 0.03
remanence_T = 1.3
[array.block]
shape = "cuboid"
width_m = 0.016
[mesh]
block_size_m = 0.01
[observation]
quantity = "flux_density"
[observation.positions]
kind = "circles"
radius_m = 0.01
angles = 8
[[noise.regions]]
name = "bore"
sigma_T = 2e-5
[prior]
magnitude_sd = 0.01
direction_sd_deg = 0.6
common_mode_sd = 0.01
[inference.held_out]
scan_lines_every = 5
"""
SECTORS = TEXT.replace('shape = "cuboid"\nwidth_m = 0.016', 'shape = "sector"')
"""The same of the blocks of `sectors`."""
GRID = np.stack(np.meshgrid(0.005 * np.arange(-2, 3), 0.005 * np.arange(-2, 3),
                            0.006 * np.arange(16), indexing="ij"), axis=-1).reshape(-1, 3)
"""Points of a stage, in scan lines along the bore."""

NOISE_T = 2e-5


def truth(
    generator: np.random.Generator, magnitude: float = 0.01, stretch: float = 1.0,
    twist_deg: float = 0.0,
) -> magpylib.Collection:
    """A magnet of magpylib with errors of its blocks.

    It is longer than the study says by a factor, and its second ring is turned about z.
    """
    sources = []
    for z, twist in ((-0.015, 0.0), (0.015, twist_deg)):
        for slot in range(8):
            angle = 45.0 * slot + twist
            direction = np.radians(90.0 * slot + twist) + 0.01 * generator.standard_normal()
            polarization = 1.3 * (1 + magnitude * generator.standard_normal()) * np.array([
                np.cos(direction), np.sin(direction), 0.01 * generator.standard_normal()])
            turn = Rotation.from_euler("z", angle, degrees=True)
            sources.append(magpylib.magnet.Cuboid(
                dimension=(0.02, 0.016, 0.03 * stretch), orientation=turn,
                polarization=turn.inv().apply(polarization),
                position=turn.apply((0.03, 0.0, z * stretch))))
    return magpylib.Collection(*sources)


def polarization_of(source: magpylib.magnet.Cuboid) -> Floats:
    """Polarization (3,) in T of a block of `truth`, along the magnet's axes."""
    return source.orientation.apply(source.polarization)


def sectors(cuboids: magpylib.Collection) -> magpylib.Collection:
    """The blocks of `truth` as sectors that touch: a smoother field, and one that is larger."""
    found = []
    for source in cuboids.sources:
        x, y, z = source.position
        angle = np.degrees(np.arctan2(y, x))
        found.append(magpylib.magnet.CylinderSegment(
            dimension=(0.02, 0.04, 0.03, angle - 22.5, angle + 22.5), position=(0.0, 0.0, z),
            polarization=polarization_of(source)))
    return magpylib.Collection(*found)


def measured(
    magnet_of: magpylib.Collection, generator: np.random.Generator, turn: Rotation, shift: Floats,
    mixing: Floats | None = None, noise: float = NOISE_T,
) -> xr.Dataset:
    """A map in coordinates s of a stage: the place in the magnet is turn s + shift."""
    matrix = turn.as_matrix()
    field = magnet_of.getB(GRID @ matrix.T + shift) @ matrix
    field = field @ (np.eye(3) if mixing is None else mixing).T
    return field_map(GRID, field + noise * generator.standard_normal(field.shape))


BODY, FRINGE = (np.stack(np.meshgrid(
    0.005 * np.arange(-2, 3), 0.005 * np.arange(-2, 3), z, indexing="ij"),
    axis=-1).reshape(-1, 3) for z in (0.006 * np.arange(-6, 7), 0.006 * np.arange(4, 14)))
"""Points in the magnet: through the bore of 60 mm, and from within it to 50 mm before it."""


def reading(
    magnet_of: magpylib.Collection, generator: np.random.Generator, points: Floats,
    pose: tuple[Rotation, Floats], mixing: Floats | None = None, noise: float = NOISE_T,
) -> xr.Dataset:
    """A map of a magnet by magpylib, in the coordinates s of its stage.

    The place in the magnet is turn s + shift, and ``pose`` is turn and shift.
    """
    turn, shift = pose
    matrix = turn.as_matrix()
    field = magnet_of.getB(points) @ matrix @ (np.eye(3) if mixing is None else mixing).T
    return field_map((points - shift) @ matrix,
                     field + noise * generator.standard_normal(field.shape))


def campaign_study(probe: str | None = None, **uncertain: Any) -> Study:
    """The study of both maps: of their stages a millimetre is known."""
    known = {"translation_m": 1e-3, "rotation_rad": 0.01}
    maps = [{"name": "body", "file": "body.csv"},
            {"name": "fringe", "file": "fringe.csv",
             "instrument": {"translation_m": [0, 0, 0.05]}}]
    return parse_study(tomllib.loads(TEXT) | {"instrument_sd": known | uncertain, "maps": [
        one | ({"probe": probe} if probe else {}) for one in maps]})
