"""Maps by magpylib that a field without sources follows badly, and a probe with one error at most.

Points come within 10 to 20 % of the size of a block to the blocks, or to a coil; grids are coarse,
gradients steep, and readings rounded.
"""

from __future__ import annotations

from collections.abc import Callable

import magpylib
import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.field_map import field_map
from tests.support import cube_dipole
from tests.support.short_dipole import sectors, truth

ROLL_RAD, LAG_M, APART_M, GAIN, DRIFT = 0.02, 1e-3, 2e-3, 0.02, 0.02
"""Usual sizes of one error of a probe."""

ERRORS = {"roll": ("probe turned about z", 1e3 * ROLL_RAD),
          "lag": ("lag of the readings behind the stage", 1e3 * LAG_M),
          "apart": ("y of the Bx sensor from the mean of all", 1e3 * APART_M * 2 / 3),
          "gain": ("gain of one component relative to that of |B|", 100 * GAIN),
          "drift": ("change of the gain from start to end", 100 * DRIFT)}
"""The term that each of them is, and its value; a gain counts relative to that of |B|."""

NOISE = 2e-4
"""Noise, and step of rounding, relative to the median field."""


def serpentine(x: Floats, y: Floats, z: Floats, keep: Callable[[Floats], Floats]) -> Floats:
    """Points (n, 3) of lines along z, to and fro, of which those are kept that fit."""
    lines = []
    for first in x:
        for second in y:
            line = np.column_stack([np.full_like(z, first), np.full_like(z, second), z])
            if keep(line[:1]).all():
                lines.append(line[::(-1) ** len(lines)])
    return np.vstack(lines)


def _within(radius: float) -> Callable[[Floats], Floats]:
    return lambda points: np.hypot(*points[:, :2].T) <= radius


def dipole(generator: np.random.Generator) -> tuple[Callable[[Floats], Floats], Floats]:
    """Two rings of sectors of 20 mm, a bore of 40 mm, through their ends."""
    magnets, step = sectors(truth(generator)), generator.choice([0.005, 0.0055, 0.006])
    across = step * np.arange(-3, 4)
    points = serpentine(across, across, 0.008 * np.arange(-2, 6),
                        _within(generator.uniform(0.016, 0.018)))
    return magnets.getB, points


def cubes(generator: np.random.Generator) -> tuple[Callable[[Floats], Floats], Floats]:
    """Two rings of cubes of 12 mm around a bore of 50 mm radius, 22 mm apart."""
    sources = cube_dipole.cubes(generator)
    points = serpentine(np.linspace(0.014, generator.uniform(0.0476, 0.0486), 7),
                        0.006 * np.arange(-2, 3), 0.007 * np.arange(-2, 5), _within(0.0488))
    return sources.getB, points


def quadrupole(generator: np.random.Generator) -> tuple[Callable[[Floats], Floats], Floats]:
    """A ring of 16 bars of 10 mm around a bore of 22 mm radius, whose gradient is 40 T/m."""
    sources = []
    for slot in range(16):
        angle = np.radians(22.5 * slot)
        one = magpylib.magnet.Cuboid(
            dimension=(0.010, 0.010, 0.040), position=(
                0.027 * np.cos(angle), 0.027 * np.sin(angle), 0.0),
            polarization=(1.3 * (1 + 0.01 * generator.standard_normal()), 0.0, 0.0))
        one.rotate_from_angax(3 * 22.5 * slot + 0.5 * generator.standard_normal(), "z")
        sources.append(one)
    points = serpentine(np.linspace(0.0, generator.uniform(0.020, 0.021), 7),
                        0.004 * np.arange(-2, 3), 0.007 * np.arange(-1, 6), _within(0.021))
    return magpylib.Collection(sources).getB, points


def coils(generator: np.random.Generator) -> tuple[Callable[[Floats], Floats], Floats]:
    """A pair of coils of 50 mm radius; a box whose outer points are at the conductor."""
    pair = [magpylib.current.Circle(diameter=0.1 * (1 + 0.005 * generator.standard_normal()),
                                    current=1000.0, position=(
                                        *(5e-4 * generator.standard_normal(2)), z))
            for z in (-0.025, 0.025)]
    points = serpentine(np.linspace(0.012, generator.uniform(0.046, 0.048), 7),
                        0.007 * np.arange(-2, 3), 0.009 * np.arange(-2, 5), _within(0.049))
    return magpylib.Collection(pair).getB, points


KINDS = (dipole, cubes, quadrupole, coils)


def gain_of(field: Floats) -> tuple[int, float]:
    """The component whose gain is wrong, neither the largest nor the least, and its share."""
    squares = np.mean(field**2, axis=0)
    own = int(np.argsort(squares)[1])
    return own, float(squares[own] / squares.sum())


def hard_map(seed: int, error: str = "") -> xr.Dataset:
    """A map of one of `KINDS`, in turn, read by a probe that has one of `ERRORS`, or none."""
    generator = np.random.default_rng([seed, 46])
    field, points = KINDS[seed % len(KINDS)](generator)
    way = np.diff(points, axis=0, prepend=points[:1])
    way[np.abs(way[:, 2]) < 1e-9] = 0.0  # at rest at the begin of a line
    way[:, :2] = 0.0
    at = points - (LAG_M if error == "lag" else 0.0) * np.sign(way)
    read = field(at)
    if error == "apart":
        read[:, 0] = field(at + np.array([0.0, APART_M, 0.0]))[:, 0]
    if error == "roll":
        read = read @ np.array([[1, -ROLL_RAD, 0], [ROLL_RAD, 1, 0], [0, 0, 1]])
    if error == "gain":
        read[:, gain_of(read)[0]] *= 1 + GAIN
    if error == "drift":
        read *= 1 + DRIFT * np.linspace(-0.5, 0.5, len(read))[:, None]
    noise = NOISE * float(np.median(np.linalg.norm(read, axis=1)))
    read += noise * generator.standard_normal(read.shape)
    return field_map(points, noise * np.round(read / noise))
