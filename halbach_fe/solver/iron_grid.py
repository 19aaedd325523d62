"""Rotationally symmetric iron as rectangles of the (r, z) half-plane, and the grid around it.

Blocks do not shape the grid. Its lines are dense at the edges of the iron, where the field is
singular, and their distances grow geometrically away from the edges.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.study.materials import Curve

SAME = 1e-9
"""Grid lines that are closer than this, in m, are one."""


@dataclass(frozen=True)
class IronRectangle:
    """A tube or disc about the z axis: a rectangle of the half-plane.

    Attributes
    ----------
    inner_radius_m, outer_radius_m : float
        Radii; the inner radius of a disc is 0.
    z_min_m, z_max_m : float
        Ends.
    law : float or Curve
        Relative permeability, or magnetization curve.
    """

    inner_radius_m: float
    outer_radius_m: float
    z_min_m: float
    z_max_m: float
    law: float | Curve

    def contains(self, r: Floats, z: Floats) -> NDArray[np.bool_]:
        """Tell which points with r and z (n,) in m lie inside the rectangle."""
        return np.asarray((r > self.inner_radius_m) & (r < self.outer_radius_m)
                          & (z > self.z_min_m) & (z < self.z_max_m))


@dataclass(frozen=True)
class Resolution:
    """How finely the iron and its neighbourhood are resolved.

    Attributes
    ----------
    edge : float
        Size of the elements at the edges of iron, relative to the thickness of the thinnest iron.
    growth : float
        Ratio of the sizes of neighbouring elements.
    largest : float
        Largest size of elements near the iron, relative to its outer radius.
    modes : int, optional
        Highest azimuthal mode; by default as many as the source needs, see `SOURCE_MODES`.
    boundary : float
        Distance of the outer boundary, relative to the largest extent of the iron.
    """

    edge: float = 0.35
    growth: float = 1.7
    largest: float = 0.08
    modes: int | None = None
    boundary: float = 20.0

    def coarser(self, modes: int) -> Resolution:
        """Return a resolution with about twice the error, where ``modes`` are used here."""
        return Resolution(1.5 * self.edge, 1.15 * self.growth, 1.5 * self.largest,
                          max(1, round(2 * modes / 3)), 0.6 * self.boundary)


def check_bodies(bodies: Sequence[IronRectangle]) -> None:
    """Refuse bodies that are empty or overlap.

    Raises
    ------
    StudyError
    """
    for body in bodies:
        if not (0 <= body.inner_radius_m < body.outer_radius_m and body.z_min_m < body.z_max_m):
            raise StudyError(must_be("Iron", "the magnet", "a rectangle of the (r, z) half-plane",
                                     f"{body}", "Correct its radii and ends."))
    for a, b in combinations(bodies, 2):
        if (min(a.outer_radius_m, b.outer_radius_m) - max(a.inner_radius_m, b.inner_radius_m) > SAME
                and min(a.z_max_m, b.z_max_m) - max(a.z_min_m, b.z_min_m) > SAME):
            raise StudyError(must_be("Iron", "the magnet", "bodies that do not overlap",
                                     f"{a} and {b}", "Split them into separate rectangles."))


def grid_lines(bodies: Sequence[IronRectangle], resolution: Resolution) -> tuple[Floats, Floats]:
    """Return the grid lines in r (from 0) and in z, in m, ascending.

    They include all edges of the bodies, and end at the outer boundary.
    """
    outer = max(body.outer_radius_m for body in bodies)
    extent = max(outer, *(abs(end) for body in bodies for end in (body.z_min_m, body.z_max_m)))
    thinnest = min(min(body.outer_radius_m - body.inner_radius_m, body.z_max_m - body.z_min_m)
                   for body in bodies)
    size, most = resolution.edge * thinnest, resolution.largest * outer
    far = resolution.boundary * extent
    r = _distinct(radius for body in bodies
                  for radius in (body.inner_radius_m, body.outer_radius_m))
    z = _distinct(end for body in bodies for end in (body.z_min_m, body.z_max_m))
    growth = resolution.growth
    radii = [] if r[0] < SAME else [0.0, *(r[0] - _growing(r[0], size, growth, most))[::-1][1:]]
    middle = [line for low, high in pairwise(r)
              for line in low + _between(high - low, size, growth, most)]
    radii = [*radii, *([0.0] if r[0] < SAME else [r[0]]), *middle,
             *r[-1] + _outward(far - r[-1], size, growth, most, extent / 2)]
    heights = [*(z[0] - _outward(far + z[0], size, growth, most, extent / 2))[::-1], z[0],
               *(line for low, high in pairwise(z)
                 for line in low + _between(high - low, size, growth, most)),
               *z[-1] + _outward(far - z[-1], size, growth, most, extent / 2)]
    return np.array(radii), np.array(heights)


def iron_cells(bodies: Sequence[IronRectangle], r: Floats, z: Floats) -> NDArray[np.int64]:
    """Return for every rectangle of a grid the number of the body that it is part of, or -1."""
    middles = np.meshgrid((r[1:] + r[:-1]) / 2, (z[1:] + z[:-1]) / 2, indexing="ij")
    result = np.full(middles[0].shape, -1, np.int64)
    for number, body in enumerate(bodies):
        result[body.contains(*middles)] = number
    return result


def _distinct(values: Iterable[float]) -> list[float]:
    """Return values in ascending order, without those that repeat the one before."""
    ordered = sorted(values)
    return ordered[:1] + [b for a, b in pairwise(ordered) if b - a > SAME]


def _growing(length: float, size: float, growth: float, most: float) -> Floats:
    """Return positions up to ``length`` with distances that grow from ``size`` up to ``most``.

    All distances are then scaled to end at ``length``.
    """
    steps = [min(size, length)]
    while sum(steps) < length:
        steps.append(min(steps[-1] * growth, most))
    positions = np.cumsum(steps)
    return np.asarray(positions * (length / positions[-1]))


def _between(length: float, size: float, growth: float, most: float) -> Floats:
    """Return positions up to ``length`` with distances that grow from both ends to the middle."""
    half = _growing(length / 2, size, growth, most)
    return np.concatenate([half, length - half[-2::-1], [length]])


def _outward(length: float, size: float, growth: float, most: float, near: float) -> Floats:
    """Return positions up to ``length``; the distances are limited up to the distance ``near``."""
    steps = [size]
    while (position := sum(steps)) < length:
        step = steps[-1] * growth
        steps.append(min(step, most) if position < near else step)
    positions = np.cumsum(steps)
    return np.asarray(positions * (length / positions[-1]))
