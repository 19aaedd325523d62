"""Regular grids of points, which some export formats need."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.field_map import points_of, refuse_total_field
from halbach_fe.study.types import COMPONENTS

TOLERANCE = 1e-3
"""Largest deviation of a coordinate from the regular grid, relative to the grid step. Coordinates
of maps are rounded (for example to 1 um with steps of 1 mm). The field error of such a deviation is
1e-3 of the difference between neighbouring points, less than the error of the linear interpolation
between them."""

HINT = ('A study with observation positions kind = "grid" has such points (start_m, end_m, count); '
        "halbach-fe solve computes its map.")


@dataclass(frozen=True)
class Grid:
    """B on a regular grid of points.

    Attributes
    ----------
    axes : tuple of three ndarray, in m
        Equally spaced, increasing coordinates along x, y and z.
    field : ndarray, shape (nx, ny, nz, 3), in T
    """

    axes: tuple[Floats, Floats, Floats]
    field: Floats

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of points along x, y and z."""
        return len(self.axes[0]), len(self.axes[1]), len(self.axes[2])

    @property
    def spacing(self) -> Floats:
        """Grid steps (3,) in m along x, y and z."""
        return np.array([(axis[-1] - axis[0]) / (len(axis) - 1) for axis in self.axes])


def grid_of(data: xr.Dataset, where: str) -> Grid:
    """Return the grid that the points of a map form; they may come in any order.

    Raises
    ------
    MeasurementError
        If an axis has a single coordinate or unequal steps, if points are missing or repeated, or
        if a component was not measured at a point.
    """
    refuse_total_field(data, "export on a grid")
    points, values = points_of(data), data["B_T"].values
    if np.isnan(values).any():
        row, component = np.argwhere(np.isnan(values))[0]
        raise MeasurementError(must_be("B", where, "known with all components at every point",
                                       f"none of B{COMPONENTS[component]} in reading {row + 1}"))
    found = [_axis(points[:, i], name, where) for i, name in enumerate(COMPONENTS)]
    axes = found[0][0], found[1][0], found[2][0]
    shape = len(axes[0]), len(axes[1]), len(axes[2])
    total = int(np.prod([float(count) for count in shape]))
    expected = f"a full grid, {shape[0]} x {shape[1]} x {shape[2]} = {total} points, each once"
    if total != len(points):
        raise MeasurementError(must_be("points", where, expected, f"{len(points)}", HINT))
    flat = np.ravel_multi_index([index for _, index in found], shape)
    if len(np.unique(flat)) < total:
        raise MeasurementError(must_be("points", where, expected, "some twice and others never",
                                       HINT))
    field = np.empty((total, 3))
    field[flat] = values
    return Grid(axes, field.reshape(*shape, 3))


def _axis(values: Floats, name: str, where: str) -> tuple[Floats, NDArray[np.intp]]:
    """Return equally spaced coordinates, and the index of each value in them."""
    ordered = np.sort(values)
    gaps = np.diff(ordered)
    widest = gaps.max(initial=0.0)
    if widest == 0:
        raise MeasurementError(must_be(f"{name} of the points", where,
                                       "of at least two different values, since programs "
                                       "interpolate between them", f"{values[0]:g} m alone", HINT))
    # on a regular grid each gap is either a step or rounding
    count = 1 + int((gaps > widest / 2).sum())
    axis = np.linspace(ordered[0], ordered[-1], count)
    step = (axis[-1] - axis[0]) / (count - 1)
    index = np.rint((values - axis[0]) / step).astype(np.intp)
    off = np.abs(values - axis[index])
    worst = int(np.argmax(off))
    if off[worst] > TOLERANCE * step:
        raise MeasurementError(must_be(
            f"{name} of the points", where, f"equally spaced within {TOLERANCE:g} of a step, here "
            f"{step:.6g} m", f"{values[worst]:.9g} m, {off[worst]:.3g} m off", HINT))
    return axis, index
