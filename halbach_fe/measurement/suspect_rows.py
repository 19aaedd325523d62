"""Rows of a map that cannot be readings of a field without sources: zeros, repetitions, spikes.

Of a map of |B| alone they, its noise and its drift are all that it shows by itself: |B| is the
length of a harmonic vector and no solution of a linear equation. Maxwell's equations do not test
it, nor does it show axes, signs or gains of a probe.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import gammainc

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.numbers import MAD_TO_SD
from halbach_fe.core.progress import Pace
from halbach_fe.measurement.field_map import (
    TOTAL_COLUMN,
    check_magnitudes,
    checked_map,
    points_of,
    warn_of_millimetres,
)
from halbach_fe.measurement.positions import point_spacing

SPIKE = 12.0
"""A reading is a spike if its residual is larger than this multiple of the standard deviation of
the residuals around it and of all, both from their medians."""

NEIGHBOURS = 26
"""Number of neighbours of a reading, as many as a point of a grid has."""

ROUGH = 1.8
"""Multiple of the largest residual around a row that is far off a function through its neighbours.
A single spike is 2 to 4 times as far off its own as off theirs."""


def broken_rows(points: Floats, field: Floats) -> dict[str, list[int]]:
    """Return the rows (n, c) that are zero, or repeat the row before them at another position, or
    another row at their own position (``copied``).
    """
    zero = (field == 0).all(axis=1)
    alike = field[1:] == field[:-1]
    moved = (points[1:] != points[:-1]).any(axis=1) & ~zero[1:]
    repeated, copied = np.zeros(len(field), bool), np.zeros(len(field), bool)
    repeated[1:] = _no_chance(alike, moved)
    if field.shape[1] == 3:  # single components repeat where they are measured again
        order = np.lexsort(np.hstack([field, points]).T)  # copies follow each other, in order
        there = (points[order[1:]] == points[order[:-1]]).all(axis=1) & ~zero[order[1:]]
        copied[order[1:]] = _no_chance(field[order[1:]] == field[order[:-1]], there)
    return {name: (1 + np.flatnonzero(rows)).tolist()
            for name, rows in (("zero", zero), ("repeated", repeated), ("copied", copied))
            if rows.any()}


def _no_chance(alike: NDArray[np.bool_], pairs: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which pairs (n,) of rows have all components (n, c) alike; none if that is chance.

    Where the field is uniform, rounded readings repeat by chance. How often all three components do
    is estimated from pairs that repeat only two: they are times the odds that the third one
    repeats, which pairs tell that repeat one of the two. Repetitions count only if there are more,
    of fewer than three components if they are a tenth of all rows.
    """
    many = 0.1
    found = alike.all(axis=1) & pairs
    if alike.shape[1] < 3:  # which the estimate needs
        return found & bool(found.sum() > 1 + many * len(found))
    by_chance = max(_all_alike_by_chance(alike[pairs][:, order])
                    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1]))
    # probability below which so many repetitions are no chance
    chance = 1e-3
    if found.any() and gammainc(found.sum(), by_chance) > chance:  # of Poisson's distribution
        found[:] = False
    return found


def contradicted_rows(data: xr.Dataset) -> tuple[int, ...]:
    """Return the rows, counted from 1, whose column of |B| is not that of their components.

    Gains make both differ everywhere: a row is named if it differs otherwise than most rows do. It
    is then not known which of the two is wrong.
    """
    # Smallest difference of |B| from that of the components that is a contradiction, in units of
    # the largest |B|: below that of most probes, above what rounding to four digits leaves of it.
    contradiction = 1e-4
    if TOTAL_COLUMN not in data:
        return ()
    total = data[TOTAL_COLUMN].values
    off = np.linalg.norm(data["B_T"].values, axis=1) - total
    known = np.isfinite(off)
    if not known.any():
        return ()
    off = off - np.median(off[known])
    limit = max(SPIKE * MAD_TO_SD * float(np.median(np.abs(off[known]))),
                contradiction * float(total[known].max()))
    return tuple((1 + np.flatnonzero(known & (np.abs(off) > limit))).tolist())


def _all_alike_by_chance(alike: NDArray[np.bool_]) -> float:
    """Return the expected number of rows (n, 3) that repeat all components.

    The odds of the third one are those in rows that repeat one of the first two alone.
    """
    first, second, third = alike.T
    one_of_two = first != second
    repeats, changes = int((one_of_two & third).sum()), int((one_of_two & ~third).sum())
    return float((first & second & ~third).sum() * repeats / max(changes, 1))


def rough_rows(
    points: Floats, field: Floats, usable: NDArray[np.bool_], pace: Pace | None = None
) -> NDArray[np.bool_]:
    """Return the rows that are far off a quadratic function through their neighbours.

    A row that is far off spoils the functions of its neighbours, but less than its own. A field
    that is steeper than a quadratic function spoils those of neighbours alike.
    """
    rough_rounds = 10  # number of times that spikes are looked for among the rows that are left
    # Smallest residual of such a row, relative to the range of its neighbours' field. At the corner
    # of a map that ends 6 mm from the edges of magnets a quadratic function is off by 0.1 of it.
    # Smaller spikes are left to the fit of a field without sources. A row at the map's border has
    # neighbours on one side only: there it is 1, as quadratic functions were off by up to 0.65 in
    # clean maps that end 12 mm from magnets. A row at a tip, as of a grid cut to a sphere, has them
    # a whole spacing away: off by 1.02 in a clean map of |B| 20 mm apart in a ring of cubes.
    of_range, at_tip = 0.2, 3.0
    found = np.zeros(len(points), bool)
    for _ in range(rough_rounds):
        rows = np.flatnonzero(usable & ~found)
        near = neighbours(points[rows])
        residual = np.full_like(field, np.nan)
        residual[rows], _ = quadratic_residual(points[rows], field[rows], pace)
        size = np.linalg.norm(residual[rows], axis=1)
        worst = spikes(points, residual, usable & ~found, 1.0)
        around = np.linalg.norm(np.ptp(field[rows[near]], axis=1), axis=1)
        limit = np.where(at_border(points[rows], near), 1.0, of_range)
        limit[at_border(points[rows], near, -0.5)] = at_tip
        worst[rows] &= (size > ROUGH * size[near].max(axis=1)) & (size > limit * around)
        if not worst.any():
            break
        found |= worst
    return found


def at_border(points: Floats, near: Ints, beside: float = 0.5) -> NDArray[np.bool_]:
    """Tell which points (n, 3) have all their neighbours (n, k) on one side, along any axis.

    Those that lie at most ``beside`` spacings on the other side count to it: by default rows in the
    same plane; with −0.5 only a row without any in its plane is at the border.
    """
    away = (points[near] - points[:, None]) / point_spacing(points)
    low, high = away.min(axis=1), away.max(axis=1)
    return np.asarray((((low > -beside) | (high < beside)) & (high - low > 0.5)).any(axis=1))


def quadratic_residual(
    points: Floats, field: Floats, pace: Pace | None = None
) -> tuple[Floats, Floats]:
    """Return how far rows (n, c) are off a quadratic function through their neighbours.

    The second array (n,) is the standard deviation of that for noise of 1.
    """
    near = neighbours(points)
    residual, sd = np.empty_like(field), np.empty(len(points))
    parts = np.array_split(np.arange(len(points)), max(1, len(points) // 1000))
    if pace is not None:
        pace.advance(0, len(parts))  # the search of neighbours is no measure of what is left
    for number, part in enumerate(parts, 1):
        away = points[near[part]] - points[part, None]
        away /= np.maximum(np.abs(away).max(axis=(1, 2), keepdims=True), 1e-12)
        x, y, z = np.moveaxis(away, 2, 0)
        terms = np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x],
                         axis=2)
        weights = np.linalg.pinv(terms, rcond=1e-6)[:, 0]  # of the value at the row itself
        residual[part] = field[part] - np.einsum("nk,nkc->nc", weights, field[near[part]])
        sd[part] = np.sqrt(1 + np.sum(weights**2, axis=1))
        if pace is not None:
            pace.advance(number, len(parts))
    return residual, sd


def spikes(
    points: Floats, residual: Floats, usable: NDArray[np.bool_], over_neighbours: float = SPIKE
) -> NDArray[np.bool_]:
    """Return the usable rows whose residual (n, 3) is far larger than all, and those around.

    What is nearly as large at three neighbours is no spike, but a field that was not fitted.
    """
    rows = np.flatnonzero(usable)
    size = np.abs(residual[rows])
    near = neighbours(points[rows])
    around = np.sort(size[near], axis=1)
    least = np.maximum(MAD_TO_SD * np.maximum(over_neighbours * np.median(around, axis=1),
                                           SPIKE * np.median(size, axis=0)),
                       ROUGH * around[:, -min(3, around.shape[1])])
    found = np.zeros(len(points), bool)
    found[rows] = (size > least).any(axis=1)
    return found


def stands_out(size: Floats, steepness: Floats) -> NDArray[np.bool_]:
    """Tell which residuals (n,) are far larger than those at which the field is about as steep.

    The steepness is (n,) in any unit; as many rows are compared as a row has neighbours.
    """
    order = np.argsort(steepness)
    ahead = np.pad(size[order], NEIGHBOURS // 2)
    windows = np.lib.stride_tricks.sliding_window_view(ahead, 2 * (NEIGHBOURS // 2) + 1)
    second = np.sort(windows, axis=1)[:, -2]  # the largest of the others, if it is not the largest
    found = np.empty(len(size), bool)
    found[order] = size[order] > ROUGH * second
    return found


def scatter_around(points: Floats, known: Floats, residual: Floats) -> Floats:
    """Return the standard deviation (n,) around points (n, 3) of residuals (k, c) at known ones.

    It is that of the median, which single rows that are far off do not change.
    """
    near = KDTree(known).query(points, np.arange(1, min(NEIGHBOURS + 1, len(known)) + 1))[1]
    return np.asarray(MAD_TO_SD * np.median(np.abs(residual[near]), axis=(1, 2)))


def neighbours(points: Floats) -> Ints:
    """Return the numbers (n, k) of the nearest neighbours of points (n, 3).

    Coordinates are rounded, so that which of equally distant points count does not depend on the
    last digits of the file.
    """
    places = np.round(points / point_spacing(points), 6)
    count = min(NEIGHBOURS + 1, len(points))
    return np.asarray(KDTree(places).query(places, np.arange(2, count + 1))[1])


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
