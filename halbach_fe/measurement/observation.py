"""From B at points to the readings that an inference compares: labelled rows of numbers.

The mapper's probe turns B where it was into a map (`halbach_fe.measurement.instrument`); an
analysis turns the map into readings: a selection for flux densities, Fourier's for circles. An
`Observation` is both.
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
from halbach_fe.measurement.instrument import probe
from halbach_fe.study.measurement import (
    CirclePositions,
    FluxDensity,
    FourierCoefficients,
)
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS

RADIUS_M = 1e-4
"""How well a radius is met: maps have rounded coordinates, and circles lie farther apart."""


@dataclass(frozen=True)
class Observation:
    """Readings as linear functions of B at points.

    Attributes
    ----------
    points : ndarray, shape (n, 3), in m
        Where sensors were.
    operator : sparse array, shape (readings, 3 n)
        Applied to B in T there, flattened point by point.
    analysis : sparse array, shape (readings, 3 m)
        Applied to a map of m points, flattened point by point.
    map_points : ndarray, shape (m, 3), in m
        Where the map says they were.
    labels : tuple of str
        Of each reading: ``Bx``, ``By``, ``Bz``, or ``A1`` ... ``B8`` of a circle.
    positions : ndarray, shape (readings, 3), in m
        Where each reading belongs; for a Fourier coefficient where its circle begins, at angle 0.
    """

    points: Floats
    operator: sparse.csr_array
    analysis: sparse.csr_array
    map_points: Floats
    labels: tuple[str, ...]
    positions: Floats

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def components(self) -> tuple[str, ...]:
        """x, y or z of each reading; nothing for a Fourier coefficient."""
        return tuple(label[1:] if label[1:] in COMPONENTS else "" for label in self.labels)

    @property
    def radii(self) -> Floats:
        """Distance of each reading from the z axis, (readings,) in m: of its point or circle."""
        return np.hypot(self.positions[:, 0], self.positions[:, 1])

    def apply(self, fields: Floats) -> Floats:
        """Readings of fields (..., n, 3) in T; shape (..., readings)."""
        flat = fields.reshape(-1, 3 * len(self.points))
        return np.asarray(self.operator @ flat.T).T.reshape(*fields.shape[:-2], len(self))

    def part(self, rows: slice) -> tuple[Ints, sparse.csr_array]:
        """Indices (k,) of the points that some readings see, and the operator (rows, 3 k) there."""
        own = self.operator[rows]
        seen, place = np.unique(own.indices // 3, return_inverse=True)
        return seen, sparse.csr_array((own.data, 3 * place + own.indices % 3, own.indptr),
                                      shape=(own.shape[0], 3 * len(seen)))

    def read(self, map_fields: Floats) -> Floats:
        """Readings (..., readings) of what a map shows, (..., m, 3) in T."""
        flat = map_fields.reshape(-1, self.analysis.shape[1])
        return np.asarray(self.analysis @ flat.T).T.reshape(*map_fields.shape[:-2], len(self))

    def magnitude(self, field: Floats) -> Floats:
        """Size of a field (n, 3) in T as every reading sees it, whatever its direction or phase:
        ``|B|`` at the point, or the amplitude of the harmonic.
        """
        sensors = 3 * len(self.points) // self.analysis.shape[1]  # at each point of the map
        single = np.diff(self.analysis.indptr) == 1  # one component at one point
        point = self.analysis.indices[self.analysis.indptr[:-1]] // len(COMPONENTS)
        result = np.linalg.norm(field, axis=1)[::sensors][point]
        if not single.all():
            harmonics = max(int(label[1:]) for label, one in zip(self.labels, single, strict=True)
                            if not one)
            # A_1 ... A_K, B_1 ... B_K of each circle
            parts = self.apply(field)[~single].reshape(-1, 2, harmonics)
            result[~single] = np.repeat(np.hypot(*parts.swapaxes(0, 1))[:, None], 2, axis=1).ravel()
        return result


def together(one: Observation, other: Observation) -> Observation:
    """The readings of two maps, one after the other."""
    def joined(first: sparse.csr_array, second: sparse.csr_array) -> sparse.csr_array:
        return sparse.csr_array(sparse.block_diag([first, second]))

    return Observation(
        np.vstack([one.points, other.points]), joined(one.operator, other.operator),
        joined(one.analysis, other.analysis), np.vstack([one.map_points, other.map_points]),
        one.labels + other.labels, np.vstack([one.positions, other.positions]))


def observe(study: Study, points: Floats, measured: NDArray[np.bool_]) -> Observation:
    """The study's observation on the points of a map.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    measured : ndarray of bool, shape (n, 3)
        Which components the map holds at each point.
    """
    if study.observation.quantity == "fourier_coefficients":
        if not measured[:, :2].all():
            raise MeasurementError(must_be("components", "map",
                                           "Bx and By at every point, for the Fourier "
                                           "coefficients of B_r", "points without them"))
        analysis, labels, positions = fourier_analysis(points, study.observation)
    else:
        wanted = np.array([name in study.observation.components for name in COMPONENTS])
        point, component = np.nonzero(measured & wanted)
        if not len(point):
            raise MeasurementError(must_be(
                "components", "map", f"some of {', '.join(study.observation.components)}, which "
                "the study observes", "none of them"))
        analysis = sparse.csr_array(
            (np.ones(len(point)), (np.arange(len(point)), 3 * point + component)),
            shape=(len(point), 3 * len(points)))
        labels, positions = tuple(f"B{COMPONENTS[c]}" for c in component), points[point]
    used = probe(study.instrument, points)
    return Observation(used.points, sparse.csr_array(analysis @ used.operator), analysis, points,
                       labels, positions)


def _on_circles(points: Floats, positions: CirclePositions) -> NDArray[np.bool_]:
    """Which points (n, 3) in m have which of the radii (n, radii)."""
    radius = np.hypot(points[:, 0], points[:, 1])
    return np.isclose(radius[:, None], positions.radius_m, rtol=1e-6)


def predicted_as(study: Study, data: xr.Dataset) -> Study:
    """The study as it observes another map, which is only predicted: itself, or if it observes
    Fourier coefficients and the map has points on none of its circles, flux densities there.

    Raises
    ------
    MeasurementError
        If such a map does not say how noisy it is; the study's noise is that of the coefficients.
    """
    observed = study.observation
    if observed.quantity == "flux_density" or _on_circles(
            points_of(data), observed.positions).any():
        return study
    if "sigma_T" not in data:
        raise MeasurementError(must_be(
            "sigma_T", "map", "given, as the study's noise is that of Fourier coefficients and the "
            "map has points on none of its circles", "nothing", "Add the column sigma_T."))
    return study.with_(
        observation=FluxDensity(quantity="flux_density", positions=observed.positions))


def circles(
    points: Floats, settings: FourierCoefficients
) -> list[tuple[float, NDArray[np.int64]]]:
    """Group points into full circles of the study's radii: for each its radius in m and the
    indices of its points by angle.

    Raises
    ------
    MeasurementError
        If the points are not circles of equally spaced points about the z axis.
    """
    radii = np.array(settings.positions.radius_m)
    on_circle = _on_circles(points, settings.positions)
    if not on_circle.any(axis=1).all():
        raise MeasurementError(must_be(
            "points", "map", f"on circles of radius {', '.join(f'{one:g}' for one in radii)} m, "
            "as the study's Fourier coefficients need", "points at other radii",
            "Observe flux_density instead."))
    found = []
    own = radii[np.argmax(on_circle, axis=1)]
    for radius, z in np.unique(np.column_stack([own, np.round(points[:, 2], 9)]), axis=0):
        index = np.flatnonzero((own == radius) & (np.abs(points[:, 2] - z) < 1e-9))
        angle = np.arctan2(points[index, 1], points[index, 0]) % (2 * np.pi)
        order = np.argsort(angle)
        steps = np.diff(angle[order], append=angle[order][0] + 2 * np.pi)
        if len(index) <= 2 * settings.harmonics or not np.allclose(
                steps, 2 * np.pi / len(index), atol=1e-6):
            raise MeasurementError(must_be(
                f"circle of radius {radius:g} m at z = {z:g} m", "map",
                f"more than {2 * settings.harmonics} equally spaced points", f"{len(index)} points"
            ))
        found.append((float(radius), index[order]))
    return found


def fourier_analysis(
    points: Floats, settings: FourierCoefficients
) -> tuple[sparse.csr_array, tuple[str, ...], Floats]:
    """Fourier coefficients of B_r on the circles that points (n, 3) in m form: matrix (readings,
    3 n), labels and positions (readings, 3) in m.
    """
    order = np.arange(1, settings.harmonics + 1)
    rows, columns, values = [], [], []
    labels: list[str] = []
    positions = []
    for radius, index in circles(points, settings):
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


def excluded(study: Study, count: int) -> NDArray[np.bool_]:
    """Tell which components (count, 3) of a map of so many rows the study leaves out.

    Raises
    ------
    MeasurementError
        If the map has no such row.
    """
    found = np.zeros((count, len(COMPONENTS)), bool)
    for one in study.inference.excluded_readings:
        if one.row > count:
            raise MeasurementError(must_be(
                "rows", "map", f"at least the {one.row} that inference.excluded_readings names",
                f"{count}", "Is it another map?"))
        found[one.row - 1, [COMPONENTS.index(name) for name in one.components]] = True
    return found


def held_out(study: Study, observation: Observation) -> NDArray[np.bool_]:
    """Tell which readings the study keeps from the update, (readings,).

    Raises
    ------
    MeasurementError
        If a key of the study holds out none, or all together hold out all.
    """
    settings = study.inference.held_out
    chosen = np.zeros(len(observation), bool)
    if settings is None:
        return chosen
    z = observation.positions[:, 2]
    if settings.every is not None:
        _, rank = np.unique(np.round(z, 9), return_inverse=True)
        chosen = (rank // settings.window) % settings.every == settings.every - 1
        if not chosen.any():
            raise MeasurementError(must_be(
                "readings", "map", "at enough z positions for the study to hold some out",
                f"{rank.max() + 1} positions",
                "Remove inference.held_out, or make its window smaller."))
    named = {f"radii_m = {radius:g}": np.isclose(observation.radii, radius, 0, RADIUS_M)
             for radius in settings.radii_m}
    named |= {f"components = {one}": np.array(observation.components) == one
              for one in settings.components}
    named |= {f"z_ranges_m = {low:g}, {high:g}": (z >= low) & (z <= high)
              for low, high in settings.z_ranges_m}
    for name, mask in named.items():
        if not mask.any():
            raise MeasurementError(must_be(
                "readings", "map", f"such that `inference.held_out.{name}` holds some of them out",
                "none", "Correct or remove it."))
        chosen = chosen | mask
    if chosen.all():
        raise MeasurementError(must_be(
            "readings", "map", "enough for the study to leave some for the update",
            f"{len(chosen)}, all held out", "Change inference.held_out."))
    return chosen
