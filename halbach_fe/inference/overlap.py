"""Maps of one magnet test each other where they overlap.

The readings of one map are compared with what an update by another map alone predicts there, by the
covariance of prediction, noise, and what is not known about the instruments.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats
from halbach_fe.inference.readings import Readings
from halbach_fe.inference.result import HELD_OUT, Overlap
from halbach_fe.measurement.scan_lines import point_spacing
from halbach_fe.stats import linear_gaussian
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.linear_gaussian import Rows
from halbach_fe.stats.noise import NoiseCovariance

NEAR = 0.87
"""Distance from the nearest point of another map, in units of that map's spacing, up to which maps
overlap: half the diagonal of a cell of its grid."""


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
    readings : Readings
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
