"""What a map of |B| alone shows by itself: rows that are no readings, its noise, and its drift.

|B| is the length of a harmonic vector and no solution of a linear equation: Maxwell's equations do
not test it here, nor does it show axes, signs or gains of a probe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.numbers import MAD_TO_SD
from halbach_fe.measurement.field_map import (
    TOTAL_COLUMN,
    check_magnitudes,
    checked_map,
    points_of,
    warn_of_millimetres,
)
from halbach_fe.measurement.suspect_rows import broken_rows, quadratic_residual, rough_rows

FEWEST_REPEATS = 3
"""Places that were read again from which the noise follows."""


@dataclass(frozen=True)
class TotalCheck:
    """What a map of |B| shows by itself."""

    points: int
    """Number of readings."""
    size_T: float
    """Largest |B|."""
    broken: dict[str, list[int]]
    """Numbers of the rows that are zero, repeated or spikes, counted from 1."""
    noise_T: float
    """Upper limit of the noise: rms, by the median, of what quadratic functions through the
    neighbours leave of a reading. NaN if there are too few readings, or all lie on a line."""
    repeats: int
    """Number of places that were read more than once."""
    repeatability_T: float
    """Noise of a reading by these; NaN if there are fewer than `FEWEST_REPEATS`."""
    excluded: NDArray[np.bool_]
    """Rows that are broken. Shape (n,)."""

    def plain(self) -> dict[str, object]:
        """Return the results as plain data for JSON."""
        return {name: None if value != value else value for name, value in self.__dict__.items()
                if name != "excluded"} | {"quantity": "|B|", "checked_by_maxwell": False}


def check_total(data: xr.Dataset) -> TotalCheck:
    """Check a map of |B| alone.

    Raises
    ------
    MeasurementError
        If it holds what no map in m and T does.
    """
    fewest_rows = 30  # rows from which a row can be compared with a function through its neighbours
    data = checked_map(data, "`data`")
    check_magnitudes(data)
    warn_of_millimetres(data)
    points, total = points_of(data), np.asarray(data[TOTAL_COLUMN].values, float)
    if not total.any():
        raise MeasurementError(must_be("|B|", "map", "that of a magnet", "zero at all points",
                                       "Was the probe connected?"))
    broken, usable = broken_rows(points, total[:, None]), np.ones(len(total), bool)
    for rows in broken.values():
        usable[np.array(rows) - 1] = False
    spike, noise = np.zeros(len(total), bool), float("nan")
    if usable.sum() >= fewest_rows and (np.ptp(points[usable], axis=0) > 0).sum() > 1:
        spike = rough_rows(points, total[:, None], usable)
        usable &= ~spike
        residual, size = quadratic_residual(points[usable], total[usable, None])
        noise = float(MAD_TO_SD * np.median(np.abs(residual[:, 0]) / size))
    repeats, repeatability = _repeated(points[usable], total[usable])
    if spike.any():
        broken["spike"] = (1 + np.flatnonzero(spike)).tolist()
    return TotalCheck(len(total), float(total.max()), broken, noise, repeats, repeatability,
                      ~usable)


def _repeated(points: Floats, total: Floats) -> tuple[int, float]:
    """Return how many places were read again, and the noise in T of a reading by these."""
    _, place, count = np.unique(points.round(9), axis=0, return_inverse=True, return_counts=True)
    place = place.ravel()
    mean = np.bincount(place, total) / count
    left, free = float(np.sum((total - mean[place])**2)), int((count - 1).sum())
    repeats = int((count > 1).sum())
    return repeats, float(np.sqrt(left / free)) if repeats >= FEWEST_REPEATS else float("nan")
