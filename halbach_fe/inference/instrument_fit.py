"""Terms of the instruments as parameters of the update, beside the magnetizations.

The readings are linear in small changes of the terms, by the gradient of the nominal magnet's
field. The update is therefore repeated about the terms that it found, until they are at rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.readings import Readings
from halbach_fe.measurement.campaign import Map
from halbach_fe.measurement.field_map import points_of
from halbach_fe.measurement.instrument import (
    in_si_and_magnet_axes,
    map_time,
    sensor_matrix,
    sensor_positions,
)
from halbach_fe.measurement.instrument_terms import (
    APART,
    NAMES,
    POSE,
    SENSORS,
    by_terms,
    field_at_sensors,
    prior_sd,
    seen,
    with_terms,
)
from halbach_fe.solver.formulation_choice import field_function
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import CovarianceFactor, Gaussian, root_matrix, stacked_root
from halbach_fe.stats.linear_gaussian import Rows
from halbach_fe.study.measurement import Instrument

DEVIATION = 0.05
"""Deviations of the blocks relative to their magnetization. A response matrix is kept as long as a
shift of the sensors changes the field of such deviations by less than the noise."""


@dataclass(frozen=True)
class OpenTerms:
    """The terms of the instruments of some maps that are not known exactly.

    Attributes
    ----------
    names : tuple of str
        Of each term, after the name of its map or probe: ``fringe.translation_x_m``.
    sd : ndarray, shape (terms,)
        Prior standard deviations.
    places : tuple of ndarray of int, shape (30,)
        For each map the number among all open terms of each term of its instrument; -1 for those
        that are known. Maps of one probe share numbers.
    """

    names: tuple[str, ...]
    sd: Floats
    places: tuple[NDArray[np.int64], ...]

    @classmethod
    def of(cls, maps: Sequence[Map]) -> OpenTerms:
        """Return the open terms of all maps."""
        names: dict[str, float] = {}
        places = []
        for one in maps:
            place = np.full(len(NAMES), -1)
            for number, sd in enumerate(prior_sd(one.study.instrument_sd)):
                owner = one.pose if number < POSE.stop else one.probe
                name = f"{owner}.{NAMES[number]}"
                if sd > 0:
                    names.setdefault(name, float(sd))
                    place[number] = list(names).index(name)
            places.append(place)
        return cls(tuple(names), np.array(list(names.values())), tuple(places))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def counted(self) -> Floats:
        """Matrix (terms, terms) to the terms as they count: sensors relative to their mean."""
        found = np.eye(len(self))
        for place in self.places:
            sensors = place[SENSORS]
            if (sensors >= 0).all():
                found[np.ix_(sensors, sensors)] = np.kron(APART, np.eye(3))
        return found

    def applied(self, maps: Sequence[Map], changes: Floats) -> list[Map]:
        """Return the maps after changes (terms,) of the instruments.

        Raises
        ------
        StudyError
            If the terms become larger than an instrument may have.
        """
        return [replace(one, study=one.study.with_(instrument=self._changed(one, place, changes)))
                for one, place in zip(maps, self.places, strict=True)]

    def _changed(self, one: Map, place: NDArray[np.int64], changes: Floats) -> Instrument:
        own = np.where(place >= 0, changes[place], 0.0)
        return with_terms(one.study.instrument, one.middle_m, own)

    def linearized(
        self, magnet: Magnet, maps: Sequence[Map], readings: Readings, session: Session
    ) -> Linearization:
        """Return how the readings of the nominal magnet depend on the open terms."""
        field = field_function(magnet, session)
        nominal, columns, sensors, steepness = [], [], [], []
        for one, place in zip(maps, self.places, strict=True):
            instrument = one.study.instrument
            data = in_si_and_magnet_axes(instrument, one.data)
            points = points_of(data)
            at_sensors, gradient = field_at_sensors(field, sensor_positions(instrument, points))
            found = by_terms(instrument, points, one.middle_m, map_time(data), at_sensors, gradient)
            own = np.zeros((3 * len(points), len(self)))
            own[:, place[place >= 0]] = found.reshape(len(own), -1)[:, place >= 0]
            columns.append(own)
            nominal.append(seen(sensor_matrix(instrument), at_sensors))
            sensors.append(sensor_positions(instrument, points).reshape(-1, 3))
            steepness.append(np.linalg.norm(gradient.reshape(-1, 9), axis=1))
        read = readings.observation.read
        return Linearization(
            np.concatenate(sensors), np.concatenate(steepness), read(np.concatenate(nominal)),
            read(np.concatenate(columns).T.reshape(len(self), -1, 3)).T)


@dataclass(frozen=True)
class Linearization:
    """Readings of the nominal magnet about some terms of the instruments.

    Attributes
    ----------
    sensors : ndarray, shape (n, 3), in m
        Places of all sensors.
    steepness : ndarray, shape (n,), in T/m
        Norm of the gradient there.
    nominal : ndarray, shape (readings,), in T
        Readings of the nominal magnet, without offset and drift.
    columns : ndarray, shape (readings, terms)
        Derivatives by the terms.
    """

    sensors: Floats
    steepness: Floats
    nominal: Floats
    columns: Floats

    def is_near(self, other: Linearization, sigma_T: float) -> bool:
        """Tell whether the same response matrix serves both for a noise of ``sigma_T``."""
        moved = np.linalg.norm(self.sensors - other.sensors, axis=1)
        return float((moved * self.steepness).max()) * DEVIATION < sigma_T


@dataclass(frozen=True)
class Beside:
    """The rows of a matrix (n, m), with columns (n, k) beside it. See `Rows`."""

    matrix: Rows
    columns: Floats

    def __len__(self) -> int:
        return len(self.columns)

    def __getitem__(self, rows: NDArray[np.int64]) -> Floats:
        return np.hstack([self.matrix[rows], self.columns[rows]])


def joined(magnet_prior: Gaussian, mean: Floats, sd: Floats) -> Gaussian:
    """Return the prior of magnetizations and of terms of instruments, which are independent."""
    root = sparse.block_diag([sparse.csr_array(root_matrix(magnet_prior.root)),
                              sparse.diags_array(sd)])
    return Gaussian(np.concatenate([magnet_prior.mean, mean]), stacked_root(root))


def of_the_first(distributions: Sequence[Gaussian], count: int) -> list[Gaussian]:
    """Return the distributions of the first parameters of some that share an outer root."""
    outer = root_matrix(distributions[0].root)[:count]
    found = []
    for each in distributions:
        root = each.root
        assert isinstance(root, CovarianceFactor)
        found.append(Gaussian(each.mean[:count],
                              CovarianceFactor(outer, root.directions, root.remaining)))
    return found
