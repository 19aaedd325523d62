"""The operator from B at the sensors to readings: components, |B|, or Fourier coefficients.

Two linear steps lead from the field to the readings. The mapper's sensors turn B at their positions
into a field map (`halbach_fe.measurement.probe_law`). The analysis turns the map into readings:
flux densities are a selection of the map's components, Fourier coefficients are sums over the
points of circles. An `Observation` holds the second step, and both steps combined.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import xarray as xr
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.field_map import points_of
from halbach_fe.measurement.positions import held_out_lines, scan_lines
from halbach_fe.measurement.probe_law import by_stated_units, sensor_model
from halbach_fe.study.measurement_keys import CirclePositions, FluxDensity, FourierCoefficients
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

TOTAL = "abs"
"""What stands for the component of a reading of |B|."""

TOTAL_LABEL = "|B|"


@dataclass(frozen=True)
class Observation:
    """Readings as linear functions of B at the sensors, and of a field map."""

    points: Floats
    """Positions of the sensors, by the study's instrument. Shape (n, 3), in m."""
    operator: sparse.csr_array
    """Maps B in T at the sensors, flattened point by point, to the readings; both steps combined.
    Shape (readings, 3 n)."""
    analysis: sparse.csr_array
    """Maps B in T of the field map's m points, flattened point by point, to the readings.
    Shape (readings, 3 m)."""
    map_points: Floats
    """Positions as the map states them. Shape (m, 3), in m."""
    labels: tuple[str, ...]
    """Name of each reading: ``Bx``, ``By``, ``Bz``, ``|B|``, or ``A1`` ... ``B8`` of a circle. A
    reading of |B| is linear in B about a field of given direction, see `observe_total`."""
    positions: Floats
    """Position of each reading as the map states it; for a Fourier coefficient the point of its
    circle at angle 0. Shape (readings, 3), in m."""

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def components(self) -> tuple[str, ...]:
        """Component x, y or z of each reading, `TOTAL` of |B|; empty for a Fourier coefficient."""
        return tuple(TOTAL if label == TOTAL_LABEL else label[1:] if label[1:] in COMPONENTS else ""
                     for label in self.labels)

    @property
    def of_total_field(self) -> NDArray[np.bool_]:
        """Which readings (readings,) are |B|."""
        return np.array([label == TOTAL_LABEL for label in self.labels])

    @property
    def directions(self) -> Floats:
        """Unit vectors (k, 3) of the field along which the readings of |B| are linear."""
        entries = self.analysis[self.of_total_field].tocoo()
        rows, columns = entries.coords
        found = np.zeros((entries.shape[0], len(COMPONENTS)))
        found[rows, columns % len(COMPONENTS)] = entries.data
        return found

    @property
    def map_rows(self) -> Ints:
        """Number (readings,) of the map's point of each reading, of a circle that of the first."""
        return np.asarray(self.analysis.indices[self.analysis.indptr[:-1]] // len(COMPONENTS))

    @property
    def radii(self) -> Floats:
        """Distance in m of each reading's point, or radius of its circle, from the z axis."""
        return np.hypot(self.positions[:, 0], self.positions[:, 1])

    @property
    def places(self) -> Floats:
        """Place (readings, 3) in m of each reading in the magnet: the first point it depends on."""
        return self.points[self.operator.indices[self.operator.indptr[:-1]] // len(COMPONENTS)]

    @property
    def sensitivities(self) -> Floats:
        """Change (readings, 3) of each reading per component of B at its `places`.

        Those of a flux density by an exact sensor are a unit vector. They are NaN for a Fourier
        coefficient, which depends on B at all points of its circle.
        """
        rows = np.repeat(np.arange(len(self)), np.diff(self.operator.indptr))
        found = np.zeros((len(self), len(COMPONENTS)))
        np.add.at(found, (rows, self.operator.indices % 3), self.operator.data)
        found[[not name for name in self.components]] = np.nan
        return found

    def apply(self, fields: Floats) -> Floats:
        """Return the readings (..., readings) that the sensors give of fields B (..., n, 3) in T.

        Use this method for a computed field at ``points``; for the values of a map use `read`.
        """
        flat = fields.reshape(-1, 3 * len(self.points))
        return np.asarray(self.operator @ flat.T).T.reshape(*fields.shape[:-2], len(self))

    def part(self, rows: slice) -> tuple[Ints, sparse.csr_array]:
        """Restrict the operator to some readings and the points that they depend on.

        ``rows``: the r readings.

        Returns
        -------
        used : ndarray of int, shape (k,)
            Indices of the points on which the readings depend.
        operator : sparse array, shape (r, 3 k)
            Maps B at these points to the readings.
        """
        operator = self.operator[rows]
        used, place = np.unique(operator.indices // 3, return_inverse=True)
        return used, sparse.csr_array((operator.data, 3 * place + operator.indices % 3,
                                       operator.indptr),
                                      shape=(operator.shape[0], 3 * len(used)))

    def read(self, map_fields: Floats) -> Floats:
        """Return the readings (..., readings) of the values (..., m, 3) in T of a field map.

        The map already contains the response of the sensors, so that only the analysis is applied;
        for a field B at the sensors use `apply`.
        """
        flat = map_fields.reshape(-1, self.analysis.shape[1])
        return np.asarray(self.analysis @ flat.T).T.reshape(*map_fields.shape[:-2], len(self))

    def magnitude(self, field: Floats) -> Floats:
        """Return the magnitude (readings,) in T of a field (n, 3) in T at each reading.

        The magnitude does not depend on the direction or phase of the field: it is ``|B|`` at the
        point of a flux density, and the amplitude ``hypot(A_k, B_k)`` of the harmonic of a Fourier
        coefficient.
        """
        single = np.array([bool(name) for name in self.components])  # of one point of the map
        sensor = self.operator.indices[self.operator.indptr[:-1]] // len(COMPONENTS)
        result = np.linalg.norm(field, axis=1)[sensor]
        if not single.all():
            harmonics = max(int(label[1:])
                            for label, flux_density in zip(self.labels, single, strict=True)
                            if not flux_density)
            # the coefficients of each circle are A_1 ... A_K, B_1 ... B_K
            parts = self.apply(field)[~single].reshape(-1, 2, harmonics)
            result[~single] = np.repeat(np.hypot(*parts.swapaxes(0, 1))[:, None], 2, axis=1).ravel()
        return result

    def largest(self, lengths: Floats) -> Floats:
        """Return the largest readings (readings,) in T of fields of given lengths (n,) in T.

        Their directions are any: error bars have none.
        """
        entries = self.operator.tocoo()
        rows, columns = entries.coords
        weights = sparse.csr_array(  # adds up the squares of one point's components
            (entries.data**2, (rows, columns // len(COMPONENTS))), (len(self), len(lengths)))
        return np.asarray(np.sqrt(weights) @ lengths)


def flux_density_at(points: Floats) -> Observation:
    """Return the readings Bx, By and Bz at points (n, 3) in m, by exact sensors."""
    identity = sparse.csr_array(sparse.eye_array(3 * len(points)))
    return Observation(points, identity, identity, points,
                       tuple(f"B{axis}" for axis in COMPONENTS) * len(points),
                       np.repeat(points, len(COMPONENTS), axis=0))


def concatenate(first: Observation, second: Observation) -> Observation:
    """Return the readings of a first map, followed by those of a second."""
    def joined(upper: sparse.csr_array, lower: sparse.csr_array) -> sparse.csr_array:
        return sparse.csr_array(sparse.block_diag([upper, lower]))

    return Observation(
        np.vstack([first.points, second.points]), joined(first.operator, second.operator),
        joined(first.analysis, second.analysis), np.vstack([first.map_points, second.map_points]),
        first.labels + second.labels, np.vstack([first.positions, second.positions]))


def observe_total(
    study: Study, points: Floats, measured: NDArray[np.bool_], directions: Floats | None,
    where: str = "map",
) -> Observation:
    """Return the observation of |B| at the points of a map, linear about fields of known direction.

    The length of B along the direction of a near field B_0 is |B| but for
    ``|B across B_0|^2 / 2 |B|``.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
        Positions as the map states them.
    measured : ndarray of bool, shape (n,)
        Whether the map holds |B| at a point.
    directions : ndarray, shape (n, 3), or None
        Unit vectors of the field, as a probe of three components would show it. Without them, the
        three components are observed in place of each |B|.
    where : str
        What error messages call the map.

    Raises
    ------
    MeasurementError
        If the study observes Fourier coefficients.
    """
    if study.observation.quantity != "flux_density":
        raise MeasurementError(must_be(
            "components", where, "Bx and By at every point, for the Fourier coefficients of B_r",
            "a map of |B| alone", "Observe flux_density instead."))
    rows = np.flatnonzero(measured)
    entries = 3 * rows[:, None] + np.arange(3)
    count = len(rows) if directions is not None else 3 * len(rows)
    values = np.ones(3 * len(rows)) if directions is None else directions[rows].ravel()
    analysis = sparse.csr_array(
        (values, entries.ravel(), np.linspace(0, 3 * len(rows), count + 1).astype(int)),
        shape=(count, 3 * len(points)))
    sensors = sensor_model(study.instrument, points)
    operator = sparse.csr_array(analysis @ sensors.operator)
    if directions is not None:
        return Observation(sensors.points, operator, analysis, points,
                           (TOTAL_LABEL,) * len(rows), points[rows])
    return Observation(sensors.points, operator, analysis, points,
                       tuple(f"B{axis}" for axis in COMPONENTS) * len(rows),
                       np.repeat(points[rows], 3, axis=0))


def observe(
    study: Study, points: Floats, measured: NDArray[np.bool_], where: str = "map"
) -> Observation:
    """Return the study's observation of components at the points of a map.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
        Positions as the map states them.
    measured : ndarray of bool, shape (n, 3)
        Whether the map holds a component at a point.
    where : str
        What error messages call the map.

    Raises
    ------
    MeasurementError
        If the map lacks the components that the study observes, or its points do not form the
        circles that Fourier coefficients need.
    """
    if study.observation.quantity == "fourier_coefficients":
        if not measured[:, :2].all():
            raise MeasurementError(must_be("components", where,
                                           "Bx and By at every point, for the Fourier "
                                           "coefficients of B_r", "points without them"))
        analysis, labels, positions = fourier_analysis(points, study.observation, where)
    else:
        wanted = np.array([name in study.observation.components for name in COMPONENTS])
        point, component = np.nonzero(measured & wanted)
        if not len(point):
            raise MeasurementError(must_be(
                "components", where, f"some of {', '.join(study.observation.components)}, which "
                "the study observes", "none of them"))
        analysis = sparse.csr_array(
            (np.ones(len(point)), (np.arange(len(point)), 3 * point + component)),
            shape=(len(point), 3 * len(points)))
        labels, positions = tuple(f"B{COMPONENTS[c]}" for c in component), points[point]
    sensors = sensor_model(study.instrument, points)
    return Observation(sensors.points, sparse.csr_array(analysis @ sensors.operator), analysis,
                       points, labels, positions)


def _on_circles(points: Floats, positions: CirclePositions) -> NDArray[np.bool_]:
    """Return whether each of points (n, 3) in m lies at each of the radii, (n, radii)."""
    radius = np.hypot(points[:, 0], points[:, 1])
    return np.isclose(radius[:, None], positions.radius_m, rtol=1e-6)


def study_for_validation_map(study: Study, data: xr.Dataset) -> Study:
    """Return the study with an observation that fits a validation map.

    A validation map is predicted, not used for the update. Its points may differ from those of the
    main map: if the study observes Fourier coefficients but no point of the validation map lies on
    the study's circles, flux densities at its points are observed instead. Otherwise the study is
    returned unchanged.

    Raises
    ------
    MeasurementError
        If flux densities are observed instead and the map does not state their noise; the study's
        noise is that of the Fourier coefficients.
    """
    observed = study.observation
    if observed.quantity == "flux_density" or _on_circles(
            points_of(by_stated_units(study.instrument, data)), observed.positions).any():
        return study
    if "sigma_T" not in data:
        raise MeasurementError(must_be(
            "sigma_T", "held-out map", "given, as the study's noise is that of Fourier "
            "coefficients and the map has points on none of its circles", "nothing",
            "Add the column sigma_T."))
    return study.with_(
        observation=FluxDensity(quantity="flux_density", positions=observed.positions))


def circles(
    points: Floats, settings: FourierCoefficients, where: str = "map"
) -> list[tuple[float, NDArray[np.int64]]]:
    """Group points into full circles about the z axis at the study's radii.

    Returns
    -------
    circles : list of (float, ndarray of int)
        For each circle its radius in m, and the indices of its points in the order of their angle.

    Raises
    ------
    MeasurementError
        If a point is at none of the radii, or the points of a circle are too few for the study's
        harmonics or not equally spaced.
    """
    radii = np.array(settings.positions.radius_m)
    on_circle = _on_circles(points, settings.positions)
    if not on_circle.any(axis=1).all():
        raise MeasurementError(must_be(
            "points", where,
            f"on circles of radius {', '.join(f'{radius:g}' for radius in radii)} m, as the study's"
            " Fourier coefficients need", "points at other radii",
            "Observe flux_density instead."))
    found = []
    radius_of = radii[np.argmax(on_circle, axis=1)]
    for radius, z in np.unique(np.column_stack([radius_of, np.round(points[:, 2], 9)]), axis=0):
        index = np.flatnonzero((radius_of == radius) & (np.abs(points[:, 2] - z) < 1e-9))
        angle = np.arctan2(points[index, 1], points[index, 0]) % (2 * np.pi)
        order = np.argsort(angle)
        steps = np.diff(angle[order], append=angle[order][0] + 2 * np.pi)
        if len(index) <= 2 * settings.harmonics or not np.allclose(
                steps, 2 * np.pi / len(index), atol=1e-6):
            raise MeasurementError(must_be(
                f"circle of radius {radius:g} m at z = {z:g} m", where,
                f"more than {2 * settings.harmonics} equally spaced points", f"{len(index)} points"
            ))
        found.append((float(radius), index[order]))
    return found


def fourier_analysis(
    points: Floats, settings: FourierCoefficients, where: str = "map"
) -> tuple[sparse.csr_array, tuple[str, ...], Floats]:
    """Return the Fourier analysis of B_r on the circles that the points of a map form.

    On a circle ``B_r = sum_k A_k cos(k phi) + B_k sin(k phi)``.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m

    Returns
    -------
    matrix : sparse array, shape (readings, 3 n)
        Maps B, flattened point by point, to the coefficients A_1 ... A_K, B_1 ... B_K of each
        circle.
    labels : tuple of str
        ``A1`` ... ``B8`` of each reading.
    positions : ndarray, shape (readings, 3), in m
        Point of the circle at angle 0.
    """
    order = np.arange(1, settings.harmonics + 1)
    rows, columns, values = [], [], []
    labels: list[str] = []
    positions = []
    for radius, index in circles(points, settings, where):
        angle = np.arctan2(points[index, 1], points[index, 0])
        wave = np.vstack([np.cos(np.outer(order, angle)), np.sin(np.outer(order, angle))])
        wave *= 2 / len(index)
        for axis, direction in enumerate((np.cos(angle), np.sin(angle))):
            values.append((wave * direction).ravel())
            columns.append(np.tile(3 * index + axis, len(wave)))
            rows.append(len(labels) + np.repeat(np.arange(len(wave)), len(index)))
        labels += [f"A{k}" for k in order] + [f"B{k}" for k in order]
        positions += [(radius, 0.0, points[index[0], 2])] * (2 * len(order))
    matrix = sparse.csr_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(len(labels), 3 * len(points)))
    return matrix, tuple(labels), np.array(positions)


def excluded_components(study: Study, count: int, where: str = "map") -> NDArray[np.bool_]:
    """Return which components (count, 3) of a map with ``count`` rows the study excludes.

    Error messages call the map ``where``.

    Raises
    ------
    MeasurementError
        If the study excludes a reading in a row that the map does not have.
    """
    found = np.zeros((count, len(COMPONENTS)), bool)
    for reading in study.inference.excluded_readings:
        if reading.row > count:
            raise MeasurementError(must_be(
                "rows", where, f"at least the {reading.row} that inference.excluded_readings names",
                f"{count}", "Is it another map?"))
        found[reading.row - 1, [COMPONENTS.index(name) for name in reading.components]] = True
    return found


def held_out_readings(
    study: Study, observation: Observation, where: str = "map"
) -> NDArray[np.bool_]:
    """Return which readings (readings,) the study holds out of the update.

    A reading is held out if any key of the study's ``inference.held_out`` selects it. Error
    messages call the map ``where``.

    Raises
    ------
    MeasurementError
        If a key selects no reading, or all keys together select all readings.
    """
    settings = study.inference.held_out
    chosen = np.zeros(len(observation), bool)
    remove = ("Remove inference.held_out (in Python magnet.with_(inference__held_out=None)) to "
              "update by all readings.")
    if settings is None:
        return chosen
    z = observation.positions[:, 2]
    if settings.every is not None:
        _, rank = np.unique(np.round(z, 9), return_inverse=True)
        chosen = (rank // settings.window) % settings.every == settings.every - 1
        if not chosen.any():
            raise MeasurementError(must_be(
                "readings", where, "at enough z positions for the study to hold some out",
                f"{rank.max() + 1}, of which `inference.held_out.every` = {settings.every} with "
                f"window = {settings.window} holds out none", remove))
    # largest distance in m of a reading from a held-out radius. Coordinates of maps are rounded,
    # and the radii of circles differ by more than this tolerance.
    same_radius_m = 1e-4
    named = {f"radii_m = {radius:g}": np.isclose(observation.radii, radius, 0, same_radius_m)
             for radius in settings.radii_m}
    named |= {f"components = {component}": np.array(observation.components) == component
              for component in settings.components}
    named |= {f"z_ranges_m = {low:g}, {high:g}": (z >= low) & (z <= high)
              for low, high in settings.z_ranges_m}
    if settings.scan_lines_every is not None:
        if study.observation.quantity != "flux_density":
            raise MeasurementError(must_be(
                "readings", where, "flux densities, to hold out lines of the scan by "
                "`inference.held_out.scan_lines_every`", "Fourier coefficients"))
        apart = held_out_lines(scan_lines(observation.map_points), settings.scan_lines_every)
        named[f"scan_lines_every = {settings.scan_lines_every}"] = apart[observation.map_rows]
    for name, mask in named.items():
        if not mask.any():
            raise MeasurementError(must_be(
                "readings", where, f"such that `inference.held_out.{name}` holds some of them out",
                f"none, at radii from {observation.radii.min():g} to {observation.radii.max():g} m "
                f"and z from {z.min():g} to {z.max():g} m", f"{remove} Or correct it" + (
                    "." if name.startswith("scan") else
                    "; or are they in mm? Then set `instrument.length_unit_m`.")))
        chosen = chosen | mask
    if chosen.all():
        raise MeasurementError(must_be(
            "readings", where, "enough for the study to leave some for the update",
            f"{len(chosen)}, all held out", remove))
    return chosen
