"""The commented study file that `halbach-fe new` writes."""

from __future__ import annotations

import os
import re
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import jinja2
import numpy as np

from halbach_fe.core.errors import OutputError, must_be
from halbach_fe.core.files import atomic
from halbach_fe.study.free_blocks import FreeBlocks
from halbach_fe.study.free_blocks_file import free_blocks_of_file
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study, with_free_blocks
from halbach_fe.study.types import MIN_LENGTH_M

TEMPLATE = "new_study.toml.j2"

LATITUDES, ANGLES = 9, 16
"""Number of latitudes, and of points on each, of a sphere that is measured: they determine the
spherical harmonics up to degree 8."""


OUTER_RADIUS = 1.8
"""Outer radius of the blocks of a new study, relative to the inner one, if it is not given."""

AROUND = 1.2
"""Radius of the points about a magnet without a bore, relative to that of the magnet."""


@dataclass(frozen=True)
class MagnetTemplate:
    """Values of the magnet in a new study file; all other values of the file follow from them.

    Lengths are in m, the remanence is in T. ``ring_length_m`` is None for a cross-section.
    ``material`` names a grade of magnet in place of the remanence. ``inner_radii_m`` are the inner
    radii of rings of their own, in the order of z. ``free_blocks`` is the path of a table of blocks
    that takes the place of the rings, from the folder of the study file. ``cube_m`` is the
    edge of cubes, ``steel`` the name of the steel of the iron ring, ``dsv_m`` the diameter of a
    sphere that is measured in place of circles along the magnet. ``sigma_T`` and ``position_sd_m``
    are the noise of readings and positions.
    """

    multipole_order: int = 1
    blocks_per_ring: int = 16
    rings: int = 1
    inner_radius_m: float = 0.05
    outer_radius_m: float = 0.09
    ring_length_m: float | None = None
    remanence_T: float = 1.3
    shape: Literal["sector", "trapezoid", "cuboid"] = "sector"
    iron_ring: bool = False
    material: str | None = None
    inner_radii_m: tuple[float, ...] = ()
    free_blocks: str | None = None
    cube_m: float | None = None
    steel: str | None = None
    dsv_m: float | None = None
    sigma_T: float = 5e-5
    position_sd_m: float = 1e-4


def new_study(
    name: str, magnet: MagnetTemplate, folder: Path = Path(), table: FreeBlocks | None = None
) -> str:
    """Return the text of a valid study file in a folder, with comments that explain its keys.

    ``table`` holds the blocks if they are those of no file yet.

    Raises
    ------
    StudyError
        If no valid study has these values.
    """
    bored = True
    if magnet.free_blocks is not None:
        table = free_blocks_of_file(folder / magnet.free_blocks)
    if table is not None:
        inner, outer = table.radii_m
        bored = inner > MIN_LENGTH_M
        magnet = replace(magnet, outer_radius_m=float(f"{outer:.4g}"), inner_radius_m=float(
            f"{inner if bored else outer / 4:.4g}"))  # of no bore: a scale of the mesh alone
    elif magnet.inner_radii_m:
        magnet = replace(magnet, rings=len(magnet.inner_radii_m),
                         inner_radius_m=min(magnet.inner_radii_m))
    half = _half_length(magnet, table)
    around = 0.0  # radius of the points about a magnet that has no bore to measure in
    if table is not None and not bored and magnet.dsv_m is None:
        around = AROUND * float(np.hypot(magnet.outer_radius_m, half or 0.0))
    points = around or (magnet.dsv_m or 0.0) / 2
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("halbach_fe.study", "."), undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    text = environment.get_template(TEMPLATE).render(
        name=_name(name), magnet=magnet, table=table, half=half, around=around,
        sphere=_sphere(points, flat=half is None and around > 0) if points else [])
    parse_new_study(text, folder, table)
    return text


def _sphere(radius: float, flat: bool = False) -> list[str]:
    """Return points on a sphere about the origin as TOML, a line for each of Gauss' latitudes.

    If ``flat``, of a cross-section, they are those of the equator alone.
    """
    angle = 2 * np.pi * np.arange(ANGLES) / ANGLES
    lines = []
    for height in np.polynomial.legendre.leggauss(1 if flat else LATITUDES)[0]:
        across = radius * np.sqrt(1 - height**2)
        lines.append(", ".join(f"[{x:.5g}, {y:.5g}, {radius * height:.5g}]" for x, y in zip(
            (across * np.cos(angle)).round(9) + 0.0, (across * np.sin(angle)).round(9) + 0.0,
            strict=True)))
    return lines


def _half_length(magnet: MagnetTemplate, table: FreeBlocks | None) -> float | None:
    """Return the half length of the magnet in m, None for a cross-section."""
    if table is not None:
        return max(abs(z) + (size or 0.0) / 2 for z, size in zip(
            table.z_m, table.size_z_m, strict=True)) if table.size_z_m else None
    return None if magnet.ring_length_m is None else magnet.rings * magnet.ring_length_m / 2


def parse_new_study(text: str, folder: Path = Path(), table: FreeBlocks | None = None) -> Study:
    """Return the study in a new file; raise StudyError if the options make it invalid."""
    where, document = "new study", tomllib.loads(text)
    if table is not None:
        document["array"]["free_blocks"] = table
    return parse_study(with_free_blocks(document, folder, where), where)


def write_new_study(path: Path, magnet: MagnetTemplate) -> None:
    """Write a new study file; an existing file is never overwritten.

    Raises
    ------
    StudyError
        If no valid study has these values.
    OutputError
        If the file exists already, or cannot be written.
    """
    if os.path.lexists(path):
        raise OutputError(must_be("path", "new study", "a file that does not exist yet",
                                  f"'{path}'", "Choose another name, or remove it."))
    text = new_study(path.stem, magnet, path.parent)
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _name(stem: str) -> str:
    """Return a valid name of a study, made from the name of its file."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", stem).lstrip("._-")[:100]
    return name or "magnet"
