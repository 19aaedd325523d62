"""A magnetic field in free space, expanded in charges around the region where it is known.

Where there are no currents and no magnets, div B = 0 and curl B = 0, so that ``B = -grad psi`` with
a harmonic psi. Fictitious magnetic charges on a box around the region make such fields only, and
with enough of them any such field (C. Runge's theorem for harmonic functions; the method of
fundamental solutions, R. Mathon and R. L. Johnston, SIAM J. Numer. Anal. 14 (1977) 638). Their
amplitudes have a normal prior of mean 0, whose width the evidence of the readings chooses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.threads import in_threads, share_out

MOST_CHARGES = 3300
"""Largest number of charges, which limits memory and time."""

CLOSENESS = 0.6
"""Distance of charges from each other, relative to that from the region: where they are as far from
each other as from a point, the field there is rough."""

UNIFORM = 1e3
"""Prior width of the uniform field in units of the charges' field: it is as good as free."""


@dataclass(frozen=True)
class Charges:
    """Charges around a region, and a uniform field.

    Attributes
    ----------
    places : ndarray, shape (k, 3), in m
    scale : float, in m^2
        A charge of amplitude 1 has the field ``scale R / |R|^3`` at the distance R, which has an
        rms of some 1/sqrt(k) in the region.
    """

    places: Floats
    scale: float

    @classmethod
    def around(cls, points: Floats, gap: float) -> Charges:
        """Place charges on a box that is ``gap`` in m larger than points (n, 3) in m on all sides.

        See `spacing_of` for their distance from each other.
        """
        low, high = points.min(axis=0) - gap, points.max(axis=0) + gap
        sides, step = high - low, spacing_of(points, gap)
        found = []
        for axis in range(3):
            first, second = (other for other in range(3) if other != axis)
            grids = np.meshgrid(*(
                np.linspace(low[other], high[other], 1 + max(1, round(sides[other] / step)))
                for other in (first, second)), indexing="ij")
            face = np.empty((grids[0].size, 3))
            face[:, first], face[:, second] = grids[0].ravel(), grids[1].ravel()
            for value in (low[axis], high[axis]):
                face[:, axis] = value
                found.append(face.copy())
        places = np.unique(np.vstack(found).round(9), axis=0)
        some = points[::max(1, len(points) // 200)]
        field = _fields(some, places)
        return cls(places, float(1 / np.sqrt(np.mean(field**2) * len(places))))

    def __len__(self) -> int:
        """Return the number of amplitudes: of the charges, and of three uniform fields."""
        return len(self.places) + 3

    def fields(self, points: Floats) -> Floats:
        """Return B (n, 3, amplitudes) at points (n, 3) in m per amplitude."""
        result = np.empty((len(points), 3, len(self)))
        result[..., :-3] = _fields(points, self.places) * self.scale
        result[..., -3:] = UNIFORM * np.eye(3)
        return result

    def fields_along(self, points: Floats, directions: Floats) -> Floats:
        """Return B . u (n, amplitudes) per amplitude at points (n, 3) in m, for u (n, 3)."""
        result = np.empty((len(points), len(self)))
        self._compute("fields_along", points, np.ascontiguousarray(directions, float), self.places,
                      self.scale, out=result)
        result[:, -3:] = UNIFORM * directions
        return result

    def field(self, points: Floats, amplitudes: Floats) -> Floats:
        """Return B (n, 3) in T at points (n, 3) in m for amplitudes (k,) in T."""
        result = np.empty((len(points), 3))
        self._compute("field", points, self.places, self.scale * amplitudes[:-3], out=result)
        return result + UNIFORM * amplitudes[-3:]

    def gradient(self, points: Floats, amplitudes: Floats) -> Floats:
        """Return the gradient (n, 3, 3) in 1/m of the field of amplitudes (k,).

        ``[i, c, j]`` is the derivative of component c along direction j.
        """
        result = np.empty((len(points), 3, 3))
        self._compute("gradient", points, self.places, self.scale * amplitudes[:-3], out=result)
        return result

    def _compute(self, name: str, points: Floats, *values: Any, out: Floats) -> None:
        """Call a function of `halbach_fe.measurement.charge_kernel` in threads."""
        from halbach_fe.measurement import charge_kernel  # imports numba

        points = np.ascontiguousarray(points, float)
        in_threads(lambda first, last: getattr(charge_kernel, name)(
            points, *values, first, last, out), share_out(len(points)))


def spacing_of(points: Floats, gap: float) -> float:
    """Return the distance in m from each other of charges at a distance in m around points (n, 3).

    It is `CLOSENESS` of that distance, or larger if there were too many.
    """
    sides = np.ptp(points, axis=0) + 2 * gap
    area = 2 * float(np.sum(sides * np.roll(sides, 1)))
    return float(max(CLOSENESS * gap, np.sqrt(area / MOST_CHARGES)))


def _fields(points: Floats, places: Floats) -> Floats:
    """Return R/|R|^3 (n, 3, k) in 1/m^2 for distances R from places (k, 3) to points (n, 3)."""
    away = points[:, :, None] - places.T
    return np.asarray(away / np.linalg.norm(away, axis=1)[:, None] ** 3)


def solid_harmonic_fields(points: Floats, degrees: int) -> Floats:
    """Return the gradients (n, 3, k) of the regular solid harmonics of degrees 1 to ``degrees``.

    Each is scaled to an rms of 1 on the unit sphere, from whose middle the points (n, 3) count. The
    functions are the real and imaginary parts of ``R_lm = r^l P_lm(cos theta) exp(i m phi) /
    (l + m)!``, whose derivatives are functions of the next lower degree: ``d/dz R_lm = R_(l-1)m``,
    ``(d/dx + i d/dy) R_lm = R_(l-1)(m+1)``, ``(d/dx - i d/dy) R_lm = -R_(l-1)(m-1)``.
    """
    x, y, z = points.T
    square = x**2 + y**2 + z**2
    known = {(0, 0): np.ones(len(points), complex)}
    for m in range(degrees):
        if m:
            known[m, m] = -(x + 1j * y) / (2 * m) * known[m - 1, m - 1]
        for degree in range(m + 1, degrees):
            below = known.get((degree - 2, m), 0.0)
            known[degree, m] = ((2 * degree - 1) * z * known[degree - 1, m] - square * below) / (
                degree**2 - m**2)

    def function(degree: int, m: int) -> NDArray[np.complex128]:
        """Return R_lm of any m."""
        if abs(m) > degree:
            return np.zeros(len(points), complex)
        return known[degree, m] if m >= 0 else (-1) ** m * np.conj(known[degree, -m])

    columns = []
    for degree in range(1, degrees + 1):
        for m in range(degree + 1):
            plus, minus = function(degree - 1, m + 1), -function(degree - 1, m - 1)
            gradient = np.stack([(plus + minus) / 2, (plus - minus) / 2j,
                                 function(degree - 1, m)], axis=1)
            size = np.sqrt(degree / (factorial(degree + m) * factorial(degree - m)) / (
                2 if m else 1))
            columns += [gradient.real / size] + ([gradient.imag / size] if m else [])
    return np.stack(columns, axis=2)


@dataclass(frozen=True)
class HarmonicFit:
    """Amplitudes of charges, or of solid harmonics, that fit readings without any instrument.

    Attributes
    ----------
    amplitudes : ndarray, shape (k,), in T
    penalty : float
        Ratio of the variances of the noise and of an amplitude.
    sigma : float, in T
        Standard deviation of the readings from the fit.
    log_evidence : float
        Log probability of the readings, up to a constant, at the most probable penalty and sigma.
    used : float
        Number of amplitudes that the readings determine.
    """

    amplitudes: Floats
    penalty: float
    sigma: float
    log_evidence: float
    used: float


ROUNDING = 1e-14
"""Relative size of eigenvalues below which they are rounding."""

PENALTIES = 10.0 ** np.arange(-12, 3, 0.5)
"""Penalties among which the evidence chooses, in units of the mean information per amplitude."""


def fit_fields(charges: Charges, points: Floats, fields: Sequence[Floats]) -> list[HarmonicFit]:
    """Fit each of some fields B (n, 3) in T at points (n, 3) in m by charges.

    The width of their prior and the noise are those of largest evidence (D. J. C. MacKay, Neural
    Comput. 4 (1992) 415).
    """
    return fit_readings(charges.fields(points).reshape(-1, len(charges)),
                        [field.ravel() for field in fields])


def fit_readings(design: Floats, readings: Sequence[Floats]) -> list[HarmonicFit]:
    """Fit each of some readings (m,) in T, of which ``design`` (m, k) is that per amplitude."""
    count = design.shape[1]
    if len(design) < count:  # the same by the smaller matrix
        values, left = np.linalg.eigh(design @ design.T)
        kept = values > ROUNDING * values[-1]
        values, left = values[kept], left[:, kept]
        vectors, projections = design.T @ (left / np.sqrt(values)), left * np.sqrt(values)
    else:
        values, vectors = np.linalg.eigh(design.T @ design)
        values, projections = np.maximum(values, 0.0), design @ vectors
    return [_most_probable(values, vectors, projections.T @ each, each, count)
            for each in readings]


def _most_probable(
    values: Floats, vectors: Floats, projected: Floats, readings: Floats, count: int
) -> HarmonicFit:
    """Return the fit of largest evidence.

    ``values`` and ``vectors`` belong to the information of ``count`` amplitudes, but for values of
    0, and ``projected`` are the products of the vectors with it.
    """
    best: HarmonicFit | None = None
    for penalty in PENALTIES * values.sum() / count:
        rest = float(readings @ readings - np.sum(projected**2 / (values + penalty)))
        sigma = np.sqrt(max(rest, 1e-30) / len(readings))
        evidence = (-len(readings) * np.log(sigma)
                    - float(np.log1p(values / penalty).sum()) / 2)
        if best is None or evidence > best.log_evidence:
            best = HarmonicFit(vectors @ (projected / (values + penalty)), float(penalty),
                               float(sigma), evidence, float(np.sum(values / (values + penalty))))
    assert best is not None  # there are penalties
    return best
