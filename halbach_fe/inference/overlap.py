"""Readings that an update has not seen as a whole: those of another map, or the ends of the map.

Where two maps overlap, the readings of one are compared with what an update by the other alone
predicts there, by the covariance of prediction, noise, and what is not known about the instruments.
A magnet is judged where nobody measured: by a map, or ends of the only one, that are left out.
Lines that are held out between others say nothing of that.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats
from halbach_fe.inference.readings import Readings
from halbach_fe.inference.result import HELD_OUT, HELD_OUT_MAP, LeftOut, Overlap, Stretch
from halbach_fe.measurement.positions import point_spacing
from halbach_fe.stats import linear_gaussian
from halbach_fe.stats.gaussian import Gaussian, NoiseCovariance
from halbach_fe.stats.linear_gaussian import Rows
from halbach_fe.study.types import COMPONENTS

NEAR = 0.87
"""Distance from the nearest point of another map, in units of that map's spacing, up to which maps
overlap: half the diagonal of a cell of its grid."""

END = 0.15
"""Part of the length of a single map that is left out at each end."""

ENOUGH = 20
"""Fewest readings that are left out, and that are left: chi-squared of 20 has a sd of a third."""

STRETCHES = 7
"""Number of parts of a map that was left out, along its longest axis, that are told apart."""


def overlaps(
    matrix: Rows, residual: Floats, errors: NoiseCovariance, prior: Gaussian, readings: Readings
) -> tuple[Overlap, ...]:
    """Return the agreement of all pairs of maps that overlap, in both directions.

    Parameters
    ----------
    matrix : Rows, shape (readings, parameters)
        Response of the readings to all parameters, those of instruments too.
    residual : ndarray, shape (readings,), in T
        Readings less the constant part of the model.
    errors : NoiseCovariance
        Noise of the readings and error of the solver.
    prior : Gaussian
        Of all parameters.
    """
    maps, training = np.array(readings.maps), readings.training
    held_out = np.array(readings.parts) == HELD_OUT
    places, stated = readings.observation.places, readings.observation.positions
    near: dict[tuple[str, str], np.ndarray] = {}
    for name, by in permutations(dict.fromkeys(maps[training].tolist()), 2):
        theirs = maps == by
        spacing = point_spacing(np.unique(stated[theirs], axis=0))  # three readings to a point
        chosen = (maps == name) & (KDTree(places[theirs]).query(places)[0] <= NEAR * spacing)
        if (chosen & held_out).any():
            chosen &= held_out
        if chosen.any():
            near[name, by] = chosen
    found = []
    for by in dict.fromkeys(by for _, by in near):
        rows = np.flatnonzero(training & (maps == by))
        updated = linear_gaussian.update(
            matrix, residual[rows], errors.subset(rows), prior, rows).distribution
        for (name, other), chosen in near.items():
            if other != by:
                continue
            index = np.flatnonzero(chosen)
            response = matrix[index]
            off = residual[index] - response @ updated.mean
            root = response @ updated.root
            white = linear_gaussian.whitened(off, errors.subset(index), root.__getitem__,
                                             root.shape[1])
            found.append(Overlap(name, by, len(index), bool(held_out[index].all()),
                                 float(np.sqrt(np.mean(off**2))), float(np.mean(white**2))))
    return tuple(found)


def left_out(
    matrix: Rows, residual: Floats, errors: NoiseCovariance, prior: Gaussian, readings: Readings
) -> tuple[LeftOut, ...]:
    """Return how an update by the others predicts each map, or that by its middle the ends of one.

    The arguments are those of `overlaps`. The response is the one of the update by all readings.
    Where a map lies and what only its probe does, no other map tells: the rms, not chi-squared, is
    that with these terms fitted to the map itself.
    """
    found = []
    # largest number of readings that are compared: chi-squared of 4 000 is known to 2 %
    most = 4000
    for name, chosen in _regions(readings).items():
        rows, index = np.flatnonzero(readings.training & ~chosen), np.flatnonzero(chosen)
        if min(len(rows), len(index)) < ENOUGH:
            continue
        index = index[::-(-len(index) // most)]
        updated = linear_gaussian.update(
            matrix, residual[rows], errors.subset(rows), prior, rows).distribution
        response, noise = matrix[index], errors.subset(index)
        off, root = residual[index] - response @ updated.mean, response @ updated.root
        white = linear_gaussian.whitened(off, noise, root.__getitem__, root.shape[1])
        own = ~np.any([matrix[rows[each]].any(axis=0) for each in linear_gaussian.row_slices(
            len(rows), response.shape[1])], axis=0)
        fitted = linear_gaussian.update(response, residual[index], noise, updated).distribution
        off = off - response[:, own] @ (fitted.mean - updated.mean)[own]
        allowed = np.hypot(np.linalg.norm(np.where(own, 0.0, response) @ updated.root, axis=1),
                           noise.sd)
        found.append(LeftOut(name, len(index), _rms(off), _rms(noise.sd), _rms(allowed),
                             float(np.mean(white**2)), _stretches(
                                 readings.observation.places[index], off, noise.sd)))
    return tuple(found)


def _stretches(places: Floats, off: Floats, noise: Floats) -> tuple[Stretch, ...]:
    """Return how far readings (n,) at places (n, 3) in m are off, along their longest axis."""
    axis = int(np.argmax(np.ptp(places, axis=0)))
    along = places[:, axis]
    limits = np.linspace(along.min(), along.max(), STRETCHES + 1)[1:-1]
    owner = np.searchsorted(limits, along)
    return tuple(
        Stretch(COMPONENTS[axis], float(along[rows].min()), float(along[rows].max()), len(rows),
                _rms(off[rows]), _rms(noise[rows]))
        for rows in (np.flatnonzero(owner == number) for number in range(STRETCHES))
        if len(rows) >= ENOUGH)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _regions(readings: Readings) -> dict[str, NDArray[np.bool_]]:
    """Return the masks (readings,) of what is left out, by the name of a map; of one map, its ends
    along the longest axis.
    """
    maps, own = np.array(readings.maps), np.array(readings.parts) != HELD_OUT_MAP
    names = list(dict.fromkeys(maps[own].tolist()))
    if len(names) > 1:
        return {name: own & (maps == name) for name in names}
    places = readings.observation.places
    along = places[:, int(np.argmax(np.ptp(places[own], axis=0)))]
    low, high = along[own].min(), along[own].max()
    return {"": own & (np.abs(along - (low + high) / 2) > (0.5 - END) * (high - low))}
