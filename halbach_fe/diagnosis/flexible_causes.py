"""Causes of any shape that compete with the effects of the catalogue.

What is outside the catalogue may be a field from a source that nobody listed, or an instrument that
does what nobody listed. The first is any field that is harmonic in the bore. The second is any
function of one coordinate (z, the azimuth, the radius, the time or the magnitude of the field) that
is added to the readings, is a gain of the sensors, or displaces the probe. Each function is a
Gaussian process, written as a cosine series whose amplitudes are independent (the spectral form of
C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning, section 4.2): the
evidence is averaged over its size and over spectra from smooth to rough.

Such a family can explain much with many amplitudes, each of which costs evidence. An effect of the
catalogue with one amplitude is the better explanation where both explain the readings equally well.

A field whose sources are outside the bore is ``-grad phi`` with ``phi`` harmonic: modified Bessel
functions times ``cos n phi``, ``cos k z`` and their sines, and polynomials that do not depend on z
(J. D. Jackson, Classical Electrodynamics, 3rd ed., section 3.7). The solver's own error is also
such a field, smooth and of known size: no effect may be identified for a misfit that it can
explain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from scipy import linalg, special

from halbach_fe.core.arrays import Floats, azimuths_of, radii_of, rms, unit_circle
from halbach_fe.diagnosis.marginal_evidence import Evidence
from halbach_fe.geometry.surface import is_in_plane

DECAY_RATES = ((0.25, 0.125), (1.0, 0.4), (2.0, 1.0))
"""Candidate decay rates of the logarithm of the amplitudes: per azimuthal order, and per half wave
in z."""


@dataclass(frozen=True)
class SmoothTerms:
    """The terms of a smooth discrepancy."""

    fields: Floats
    """Normalized fields at the points of a map. Shape (k, n, 3)."""
    fineness: Floats
    """Azimuthal order and number of half waves in z of each term. Shape (k, 2)."""


def harmonic_fields(
    points: Floats, orders: int = 6, waves: int = 10, in_plane: int = 0
) -> SmoothTerms:
    """Return fields without sources at the points, each with an rms magnitude of 1.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    orders : int
        Largest azimuthal order.
    waves : int
        Largest number of half waves over the length of the map.
    in_plane : int
        The same of a map in one plane, over its diameter: the field varies along z there, too.
    """
    radius = radii_of(points)
    angle = azimuths_of(points)
    z = points[:, 2] - points[:, 2].mean()
    # longer than the map, on which the terms must not be periodic
    flat, scale = is_in_plane(points), max(radius.max(), 1e-9)
    length = (2 * scale if flat else max(np.ptp(z), 1e-9)) * 1.2
    along, across = np.eye(3)[2], unit_circle(angle)
    around = np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle])
    found: list[Floats] = []
    fineness: list[tuple[int, int]] = []

    def add(radial: Floats, azimuthal: Floats, axial: Floats, order: int, wave: int) -> None:
        field = radial[:, None] * across + azimuthal[:, None] * around + axial[:, None] * along
        size = float(np.sqrt(np.mean(field**2) * 3))
        if size > 0:
            found.append(field / size)
            fineness.append((order, wave))

    for order in range(1, orders + 1):
        power = order * (radius / scale) ** (order - 1)
        for phase in (0.0, np.pi / 2):
            add(power * np.cos(order * angle - phase), -power * np.sin(order * angle - phase),
                0 * radius, order, 0)
    add(0 * radius, 0 * radius, np.ones_like(radius), 0, 0)
    for wave in range(1, (in_plane if flat else waves) + 1):
        k = wave * np.pi / length
        if k * scale > 300:  # of a thin slab: it falls off within a hundredth of the radius
            break
        for order in range(orders + 1):
            bessel, slope = special.iv(order, k * radius), special.ivp(order, k * radius)
            over = np.where(radius > 0, bessel / np.maximum(radius, 1e-12),
                            k / 2 if order == 1 else 0.0)
            for phase in (0.0, np.pi / 2)[:1 + (order > 0)]:
                turn, sine = np.cos(order * angle - phase), -np.sin(order * angle - phase)
                for shift in (0.0, np.pi / 2):
                    wave_z, slope_z = np.cos(k * z - shift), -np.sin(k * z - shift)
                    add(k * slope * turn * wave_z, order * over * sine * wave_z,
                        k * bessel * turn * slope_z, order, wave)
    return SmoothTerms(np.array(found), np.array(fineness, float))


def fields_of_rms(terms: SmoothTerms, size: float) -> Floats:
    """Return fields (k, n, 3) whose sum has an rms of ``size`` in each component.

    The amplitudes of the sum are independent with a standard deviation of 1. Finer terms are
    smaller by the first of `DECAY_RATES`.
    """
    weights = np.exp(-terms.fineness @ DECAY_RATES[0])
    weights *= np.sqrt(3) * size / np.linalg.norm(weights)
    return weights[:, None, None] * terms.fields


def sensor_errors(points: Floats, orders: int = 3, waves: int = 8) -> SmoothTerms:
    """Return smooth errors at the points, of one component each with an rms of sqrt(3).

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    orders : int
        Largest azimuthal order.
    waves : int
        Largest number of half waves over the length of the map.
    """
    angle = azimuths_of(points)
    z = points[:, 2] - points[:, 2].mean()
    length = max(np.ptp(z), 1e-9)
    found: list[Floats] = []
    fineness: list[tuple[int, int]] = []
    for wave in range(1 if is_in_plane(points) else waves + 1):
        for shift in (0.0, np.pi / 2)[:1 + (wave > 0)]:
            along = np.cos(wave * np.pi * z / length - shift)
            for order in range(orders + 1):
                for phase in (0.0, np.pi / 2)[:1 + (order > 0)]:
                    shape = along * np.cos(order * angle - phase)
                    shape = shape / max(rms(shape), 1e-12)
                    for axis in np.eye(3):
                        found.append(np.sqrt(3) * shape[:, None] * axis)
                        fineness.append((order, wave))
    return SmoothTerms(np.array(found), np.array(fineness, float))


ActsOn = Literal["field", "readings", "gains", "positions"]

SIZES = np.geomspace(0.1, 1000, 17)
"""Candidate rms sizes, in units of the noise of a reading."""

MOST_WAVES = 48
"""Largest number of half waves; finer structure is noise to this comparison."""

AXES = ((0,), (1,), (2,), (0, 1, 2))
"""Components on which a cause may act: one of them, or each by a function of its own."""


@dataclass(frozen=True)
class Family:
    """Causes of one kind."""

    acts_on: ActsOn
    """``field``, ``readings``, ``gains`` or ``positions``."""
    along: str
    """Coordinate on which the functions depend; empty for fields."""
    fields: Callable[[], Floats] = field(repr=False)
    """Returns changes (k, n, 3) in T of the map's values by the terms, each with an rms of about
    one reading's noise. They are large, and are computed whenever they are asked for."""
    axis: np.ndarray[tuple[int], np.dtype[np.int_]] = field(repr=False)
    """Component on which each term acts; -1 for terms that act on all. Shape (k,)."""
    spectra: Floats = field(repr=False)
    """Relative standard deviations of the amplitudes, from smooth to rough. Shape (spectra, k)."""
    smooth: tuple[bool, ...] = field(repr=False)
    """Whether the functions of each spectrum are smooth."""
    waves: Floats = field(repr=False)
    """Half waves of each term over the range of the coordinate (over 360 degrees of azimuth).
    Shape (k,)."""
    span: float = 0.0
    """Range of the coordinate, in m, degrees, T or as a fraction of the map's time."""
    unit: float = 0.0
    """Error of the readings in T, of the gains, or of the positions in m, by a term of amplitude 1;
    0 for fields, whose size is that of `fields`."""
    map: str | None = None
    """Name of the map on whose instrument it acts, of several; None if it acts on all."""
    rows: slice = field(default_factory=lambda: slice(None))
    """Of the points on which it acts, among those of all maps."""

    @property
    def name(self) -> str:
        """What it acts on, the coordinate, and the map among several."""
        return f"{self.acts_on} {self.along}".strip() + (f" in map {self.map}" if self.map else "")

    def of_map(self, name: str, rows: slice, count: int) -> Family:
        """Return the same causes in one of several maps, which have ``count`` points together."""
        def fields() -> Floats:
            own = self.fields()
            found = np.zeros((len(own), count, 3))
            found[:, rows] = own
            return found

        return replace(self, fields=fields, map=name, rows=rows)


@dataclass(frozen=True)
class Fitted:
    """A family at its likeliest components, spectrum and size."""

    log_bayes_factor: float
    """Log Bayes factor over no such cause, averaged over components, spectra and sizes."""
    at_best: float
    """The same at the likeliest ones, without the average."""
    axes: tuple[int, ...]
    """Components on which it acts; empty for a field."""
    smooth: bool
    deviations: Floats
    """Standard deviations of the amplitudes of all terms; 0 for terms that are left out.
    Shape (k,)."""
    mean: Floats
    """Posterior mean of the amplitudes. Shape (k,)."""


def fit_family(family: Family, evidence: Evidence) -> Fitted:
    """Return the evidence of a family, from the evidence of its terms (and of nothing else)."""
    factors: list[float] = []
    best: tuple[float, tuple[int, ...], bool, Floats, Floats] | None = None
    # largest information of the readings about a term, in units of the inverse of its prior
    # variance at the largest size, for which it is left out: a residual of a thousand standard
    # deviations along it would change the log evidence by less than 1e-6
    negligible = 1e-12
    for axes in _axes_seen(family, evidence) if (family.axis >= 0).any() else ((),):
        used = np.flatnonzero(np.isin(family.axis, axes)) if axes else np.arange(len(family.axis))
        information = evidence.information[np.ix_(used, used)]
        for spectrum, smooth in zip(family.spectra[:, used], family.smooth, strict=True):
            # terms that are too small to change anything cost most of the time
            kept = np.flatnonzero(
                (SIZES[-1] * spectrum)**2 * np.diag(information) > negligible)
            weights = spectrum[kept]
            whitened = weights[:, None] * information[np.ix_(kept, kept)] * weights
            # more than rounding, which may leave less than nothing if a few readings are far more
            # exact than all others
            whitened += 1e-14 * np.trace(whitened) * np.eye(len(kept))
            score = weights * evidence.score[used[kept]]
            some = _log_evidences(whitened, score)
            factors += some.tolist()
            top = int(np.argmax(some))
            if best is None or some[top] > best[0]:
                deviations, mean = np.zeros(len(family.axis)), np.zeros(len(family.axis))
                deviations[used] = SIZES[top] * spectrum
                mean[used[kept]] = weights * linalg.solve(
                    whitened + np.eye(len(kept)) / SIZES[top]**2, score, assume_a="pos")
                best = float(some[top]), axes, smooth, deviations, mean
    assert best is not None
    return Fitted(float(special.logsumexp(factors) - np.log(len(factors))), *best)


def _log_evidences(information: Floats, score: Floats) -> Floats:
    """Return the log evidences (sizes,) of terms whose amplitudes have each of `SIZES` as their
    prior standard deviation, over that of none.

    A tridiagonal form of their information (k, k) serves all sizes, and takes a quarter of the time
    of eigenvectors.
    """
    count, variances = len(score), SIZES**2
    if count < 2:
        grown = variances * information.sum()
        return (variances * (score @ score) / (1 + grown) - np.log1p(grown)) / 2
    reduced, along, beside, reflections, _ = linalg.lapack.dsytrd(
        information, lower=1, lwork=32 * count)
    turned = np.append(score[:1], linalg.lapack.dormqr(
        "L", "T", reduced[1:, :-1], reflections, score[1:, None], lwork=32 * count)[0])
    found = np.empty(len(variances))
    for number, variance in enumerate(variances):
        pivots, _, mean, _ = linalg.lapack.dptsv(
            1 + variance * along, variance * beside, turned)
        found[number] = (variance * (turned @ mean) - np.log(pivots).sum()) / 2
    return found


def _axes_seen(family: Family, evidence: Evidence) -> list[tuple[int, ...]]:
    """Return those of `AXES` that the readings see: a map of one component has one sensor."""
    size = np.diag(evidence.information)
    seen = [axis for axis in range(3) if size[family.axis == axis].any()]
    found = dict.fromkeys(tuple(axis for axis in axes if axis in seen) for axes in AXES)
    return [axes for axes in found if axes] or list(AXES)


def largest_factor(family: Family, evidence: Evidence) -> float:
    """Return a bound that `Fitted.log_bayes_factor` cannot exceed, in little time.

    It is the gain in log likelihood at the largest prior variance of each amplitude, without the
    price of the amplitudes.
    """
    variance = (SIZES[-1] * family.spectra.max(axis=0))**2
    precision = evidence.information + np.diag(1 / variance)
    return float(evidence.score @ linalg.solve(precision, evidence.score, assume_a="pos")) / 2


def field_family(
    points: Floats, noise_T: float, seen: Callable[[Floats], Floats] = np.asarray
) -> Family:
    """Return the family of fields from outside the bore.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    noise_T : float
        Noise of a reading.
    seen : callable, optional
        Returns what the maps show (k, n, 3) in T of fields (k, n, 3) in T.
    """
    waves_in_plane = 4  # of a source outside the bore, with which the field falls off in a radius
    terms = harmonic_fields(points, in_plane=waves_in_plane)
    return _of_smooth_terms("field", "", replace(terms, fields=seen(terms.fields)), noise_T, False,
                            np.ptp(points[:, 2]))


def instrument_families(
    points: Floats, time: Floats, nominal: Floats, gradient: Floats, noise_T: float,
    timed: bool = True
) -> list[Family]:
    """Return all families of what an instrument may do in a map.

    Parameters
    ----------
    points : ndarray, shape (n, 3), in m
    time : ndarray, shape (n,)
        From 0 to 1; without ``timed``, the map has no times, and this is the order of its rows.
    nominal : ndarray, shape (n, 3), in T
        What the map shows of the model.
    gradient : ndarray, shape (n, 3, 3), in T/m
        Its derivatives; the last axis is the direction in the magnet.
    noise_T : float
        Noise of a reading.
    """
    # Numbers of half waves over the range of a coordinate at which the spectrum of a smooth
    # function (squared-exponential covariance) and of a rough one (exponential covariance) falls
    # off.
    smooth_waves, rough_waves = (2.0, 5.0), (3.0, 15.0)
    angle, radius = azimuths_of(points), radii_of(points)
    found = [_of_smooth_terms("readings", "z and angle", sensor_errors(points), noise_T, True,
                              np.ptp(points[:, 2]))]
    coordinates = {"z": points[:, 2], "angle": angle, "radius": radius,
                   "time" if timed else "order": time,
                   "field": np.linalg.norm(nominal, axis=1)}
    if _on_a_line_along_z(points):  # where azimuth and radius are functions of z
        del coordinates["angle"], coordinates["radius"]
    unit = np.eye(3)[:, None] * np.ones((len(points), 1))
    shapes: dict[ActsOn, Floats] = {  # (axis, n, 3)
        "readings": unit, "gains": unit * nominal, "positions": np.moveaxis(gradient, 2, 0)}
    for name, coordinate in coordinates.items():
        waves, functions = (_around if name == "angle" else _along)(coordinate)
        if len(waves) < 2:
            continue
        spectra = np.array([
            *(np.exp(-(waves / size)**2 / 4) for size in smooth_waves),
            *(1 / np.sqrt(1 + (waves / size)**2) for size in rough_waves)])
        spectra /= np.linalg.norm(spectra, axis=1)[:, None]
        for acts_on, shape in shapes.items():
            size = float(np.sqrt(np.mean(shape**2) * 3))
            if not size > 0:
                continue
            found.append(Family(
                acts_on, name, partial(_products, functions, shape * noise_T / size),
                np.repeat(np.arange(3), len(waves)), np.tile(spectra, 3),
                tuple(number < len(smooth_waves) for number in range(len(spectra))),
                np.tile(waves, 3), 360.0 if name == "angle" else float(np.ptp(coordinate)),
                noise_T / size))
    return found


def _on_a_line_along_z(points: Floats) -> bool:
    """Tell whether points (n, 3) in m lie on one line, rather along the magnet than across."""
    slender = 1e-3  # width of a line relative to its length, up to which it is one
    centred = points - points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    return len(points) > 2 and bool(sizes[1] < slender * sizes[0]) and abs(axes[0, 2]) > 0.5**0.5


def _products(functions: Floats, shape: Floats) -> Floats:
    """Return every function (k, n) times every shape (axes, n, 3), as (axes k, n, 3)."""
    return (functions[None, :, :, None] * shape[:, None]).reshape(-1, *shape.shape[1:])


def _of_smooth_terms(
    acts_on: ActsOn, along: str, terms: SmoothTerms, noise_T: float, by_axis: bool,
    span: float,
) -> Family:
    """Return the family of smooth terms of two dimensions."""
    fineness, fields = terms.fineness, terms.fields
    spectra = np.array([np.exp(-fineness @ decay) for decay in DECAY_RATES])
    spectra /= np.linalg.norm(spectra, axis=1)[:, None]
    axis = np.tile(np.arange(3), len(fields) // 3) if by_axis else np.full(len(fields), -1)
    return Family(acts_on, along, lambda: noise_T * fields, axis, spectra,
                  (True,) * len(spectra), fineness[:, 1], float(span), noise_T if by_axis else 0.0)


def _along(coordinate: Floats) -> tuple[Floats, Floats]:
    """Return half waves (k,) and cosines (k, n) of an rms of 1 over the range of a coordinate."""
    span = np.ptp(coordinate)
    different = len(np.unique((coordinate - coordinate.min()).round(9))) if span > 1e-9 else 1
    waves = np.arange(min(different, MOST_WAVES + 1), dtype=float)
    scaled = (coordinate - coordinate.min()) / (span or 1.0)
    return waves, np.where(waves > 0, np.sqrt(2), 1.0)[:, None] * np.cos(
        np.pi * waves[:, None] * scaled)


def _around(angle: Floats) -> tuple[Floats, Floats]:
    """Return half waves (k,) and the Fourier series (k, n) of an rms of 1 of the azimuth."""
    turned = np.mod(angle - angle[0], 2 * np.pi)
    different = len(np.unique(np.mod(turned.round(6), round(2 * np.pi, 6))))
    orders = np.arange(1, min((different - 1) // 2, MOST_WAVES // 2) + 1)
    waves = np.concatenate([[0.0], 2.0 * orders, 2.0 * orders])
    series = np.vstack([np.ones((1, len(angle))), np.sqrt(2) * np.cos(orders[:, None] * turned),
                        np.sqrt(2) * np.sin(orders[:, None] * turned)])
    if different == len(waves) + 1:  # equal steps of an even number: the finest term has no sine
        waves = np.append(waves, different)
        series = np.vstack([series, np.cos(different // 2 * turned)])
    return waves, series
