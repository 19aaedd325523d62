"""Campaigns of overlapping maps of one magnet by magpylib, each on a stage of its own."""

from __future__ import annotations

from collections.abc import Callable

import magpylib
import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.map_check import MapCheck
from halbach_fe.measurement.map_join import Checked, JoinedMaps
from tests.support.cube_dipole import cubes

NOISE_T = 2e-5

STEP_M = 0.005
POINTS = np.stack(np.meshgrid(*(STEP_M * np.arange(n) for n in (4, 4, 8)), indexing="ij"),
                  axis=-1).reshape(-1, 3)
"""Of a stage, whose origin is at a corner; lines run along z."""

Pose = tuple[Rotation, Floats]


def quadrupole(generator: np.random.Generator) -> magpylib.Collection:
    """A ring of 16 bars of 10 mm around a bore of 25 mm radius, with errors of the bars."""
    sources = []
    for slot in range(16):
        angle = np.radians(22.5 * slot)
        one = magpylib.magnet.Cuboid(
            dimension=(0.010, 0.010, 0.060), position=(
                0.030 * np.cos(angle), 0.030 * np.sin(angle), 1e-3 * generator.standard_normal()),
            polarization=(1.3 * (1 + 0.01 * generator.standard_normal()), 0.0, 0.0))
        one.rotate_from_angax(3 * 22.5 * slot + 0.5 * generator.standard_normal(), "z")
        sources.append(one)
    return magpylib.Collection(sources)


MAGNETS = (quadrupole, cubes)


def campaign(
    seed: int, maps: int = 3, noise: float = NOISE_T,
    changed: Callable[[magpylib.Collection], None] = lambda _: None,
) -> tuple[dict[str, xr.Dataset], list[Pose], magpylib.Collection]:
    """Maps along the magnet that overlap by 20 mm, where their stages stand, and the magnet.

    A place p of a stage is turn p + shift: turns are some 10 mrad, shifts off by millimetres.
    The magnet may be ``changed`` before it is mapped.
    """
    generator = np.random.default_rng([seed, 460])
    magnet = MAGNETS[seed % len(MAGNETS)](generator)
    changed(magnet)
    found, poses = {}, []
    for number in range(maps):
        pose = (Rotation.from_rotvec(0.01 * generator.standard_normal(3)),
                np.array([-0.0075, -0.0075, -0.035 + 0.015 * number])
                + 1e-3 * generator.standard_normal(3))
        found[f"part{number}"] = read(magnet, pose, generator, noise)
        poses.append(pose)
    return found, poses, magnet


def read(
    magnet: magpylib.Collection, pose: Pose, generator: np.random.Generator,
    noise: float = NOISE_T, gain: float = 1.0, were: Floats = POINTS,
) -> xr.Dataset:
    """The map that a stage with a pose makes of a magnet; its points were somewhere."""
    matrix = pose[0].as_matrix()
    field = gain * magnet.getB(were @ matrix.T + pose[1]) @ matrix
    return field_map(POINTS, field + noise * generator.standard_normal(field.shape))


def as_checked(maps: dict[str, xr.Dataset], floor: float = 1.6 * NOISE_T) -> list[Checked]:
    """The maps as a check leaves them that finds a perfect probe, which takes no time.

    Held-out lines were off by 1.6 times the noise in `test_map_check`.
    """
    found = []
    for name, data in maps.items():
        field = np.asarray(data["B_T"].values)
        check = MapCheck(
            data=data, readings=field.size, points=len(field), spacing_m=STEP_M,
            size_T=float(np.linalg.norm(field, axis=1).max()), orientation=("x", "y", "z"),
            alike=(), rms_as_given_T=np.zeros(3), rms_T=np.zeros(3), floor_T=np.full(3, floor),
            terms=(), broken={}, windows=("z", ()), noise_T=NOISE_T, position_noise_m=0.0,
            reach=None, structure=0.0, redundancy=1.0, excluded=np.zeros(len(field), bool),
            residual_T=0 * field, unseen_T=0 * field, corrected_T=field, gap_m=2.5 * STEP_M)
        found.append(Checked.of(name, check))
    return found


def errors(joined: JoinedMaps, poses: list[Pose]) -> Floats:
    """Errors (6 k,) of shift in m and turn in rad of the maps that were joined to the first one."""
    (first, origin), found = poses[0], []
    for one, (turn, shift) in zip(joined.poses, poses[1:], strict=True):
        place = first.inv().apply(turn.apply(one.middle_m) + shift - origin)
        true = first.inv() * turn
        found += [*(one.middle_m + one.shift_m - place),
                  *(Rotation.from_rotvec(one.rotation_rad) * true.inv()).as_rotvec()]
    return np.array(found)


def over_bars(joined: JoinedMaps, poses: list[Pose]) -> Floats:
    """These errors (6 k,), made independent of each other and divided by their bars."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(joined.covariance),
                                      errors(joined, poses)))
