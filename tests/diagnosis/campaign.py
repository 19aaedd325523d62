"""A small magnet of cuboids in vacuum, measured in magpylib."""

from __future__ import annotations

import magpylib
import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.field_map import field_map
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study
from tests.conftest import circle
from tests.support.cuboids import DOCUMENT, NOISE_T

STUDY = parse_study(DOCUMENT)
CIRCLES = np.vstack([circle(radius, 12, z, 0.1) for radius in (0.05, 0.07)
                     for z in np.linspace(-0.2, 0.2, 11)])


def with_array(**keys) -> Study:
    return parse_study(DOCUMENT | {"array": DOCUMENT["array"] | keys})


def drawn(study: Study, generator: np.random.Generator, sd=0.01) -> np.ndarray:
    """Polarizations (blocks, 3) in T of blocks that are off by 1 % and 1 deg, and all by 1 %."""
    nominal = np.array(
        [np.array(one.easy_axis) * one.remanence for one in build_magnet(study).blocks])
    size = sd * np.linalg.norm(nominal, axis=1)[:, None]
    return (nominal * (1 + sd * generator.standard_normal())
            + size * np.array([1.0, 1.0, np.pi / 1.8]) * generator.standard_normal(nominal.shape))


def field(study: Study, polarizations: np.ndarray, points: np.ndarray) -> np.ndarray:
    """B (n, 3) in T by magpylib, of blocks in their places."""
    array, total = study.array, np.zeros(points.shape)
    size = (array.outer_radius_m - array.inner_radius_m, array.block.width_m, array.ring_length_m)
    radius = (array.outer_radius_m + array.inner_radius_m) / 2
    for block, polarization in zip(build_magnet(study).blocks, polarizations, strict=True):
        angle = np.radians(position_angle_deg(array, block.slot))
        cuboid = magpylib.magnet.Cuboid(dimension=size, position=(
            radius * np.cos(angle), radius * np.sin(angle), (block.z_min + block.z_max) / 2))
        cuboid.rotate_from_angax(np.degrees(angle), "z", anchor=None)
        cuboid.polarization = cuboid.orientation.inv().apply(polarization)
        total += cuboid.getB(points)
    return total


def table_of(
    study: Study, polarizations: np.ndarray, generator: np.random.Generator, sd: float = 1e-3
) -> BlockTable:
    """The blocks (n, 3) in T as a coil would have measured them, each to 0.1 %."""
    blocks = build_magnet(study).blocks
    volume, count, ones = blocks[0].volume, len(blocks), np.ones(len(blocks))
    moments = volume / MU_0 * np.array([
        Rotation.from_euler("z", -block.angle_deg, degrees=True).apply(polarization)
        for block, polarization in zip(blocks, polarizations, strict=True)])
    sds = sd * np.linalg.norm(moments, axis=1)
    return BlockTable(
        tuple(map(str, range(count))), ("",) * count, np.array([block.ring for block in blocks]),
        np.array([block.slot for block in blocks]),
        moments + sds[:, None] * generator.standard_normal(moments.shape), sds, volume * ones,
        np.nan * ones)


def measured(study, generator, points=CIRCLES, at=None):
    """A map of a magnet as it might be built, of points that may have been elsewhere."""
    true = field(study, drawn(study, generator), points if at is None else at)
    return field_map(points, true + NOISE_T * generator.standard_normal(true.shape))
