"""A magnetic field without sources, expanded in charges around the region where it is known.

Where there are no currents and no magnets, div B = 0 and curl B = 0, so that ``B = -grad psi`` with
a harmonic psi. Fictitious magnetic charges on a box around the region make such fields only, and
with enough of them any such field (C. Runge's theorem for harmonic functions; the method of
fundamental solutions, R. Mathon and R. L. Johnston, SIAM J. Numer. Anal. 14 (1977) 638). Their
amplitudes have a normal prior of mean 0, whose width the evidence of the readings chooses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import factorial, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from halbach_fe.core.arrays import Floats, Ints, slices
from halbach_fe.core.threads import in_threads, reordered, share_out

CLOSENESS = 0.45
"""Distance of charges from each other, relative to that from the region: where they are as far from
each other as from a point, the field there is rough. In a clean map of 945 readings charges at 0.6
left 1.3 times the noise, at 0.45 and at 0.35 1.03 times, with a log evidence larger by 120."""

FEW = 1200
"""Size of a matrix up to which eigenvectors are sought of all of it."""

AT_ONCE = 4096
"""Number of readings whose remaining noise is computed at a time, which limits the memory."""

EXACTLY = 1 / 16
"""Accuracy, in units of what is left out, to which chosen charges stand for all: with 1 instead,
terms of two maps moved by up to 0.21 and 0.35 of their bars, with this by 0.06 and 0.19."""

UNIFORM = 1e3
"""Prior width of the uniform field in units of the charges' field: it is as good as free."""


@reordered
def _fields_of_charges(points: Floats, directions: Floats, places: Floats, scale: float,
                       first: int, last: int, out: Floats) -> None:
    """Write the component along ``directions`` (n, 3) of the field of every charge.

    A charge of amplitude a at the place c has the field ``a R / |R|^3`` at the distance R = x - c.

    ``out`` (n, k or more) is at points ``first`` to ``last`` of (n, 3) in m, for charges at
    ``places`` (k, 3) in m whose amplitude is ``scale``.
    """
    px, py, pz = places[:, 0].copy(), places[:, 1].copy(), places[:, 2].copy()
    for n in range(first, last):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        u, v, w = scale * directions[n, 0], scale * directions[n, 1], scale * directions[n, 2]
        row = out[n]
        for k in range(len(px)):
            x, y, z = a - px[k], b - py[k], c - pz[k]
            square = x * x + y * y + z * z
            row[k] = (x * u + y * v + z * w) / (square * sqrt(square))


@reordered
def _field_of_charges(points: Floats, places: Floats, amplitudes: Floats, first: int, last: int,
                      out: Floats) -> None:
    """Write the field (n, 3) of all charges at points ``first`` to ``last``."""
    for n in range(first, last):
        bx = by = bz = 0.0
        for k in range(len(places)):
            x, y, z = (points[n, 0] - places[k, 0], points[n, 1] - places[k, 1],
                       points[n, 2] - places[k, 2])
            square = x * x + y * y + z * z
            weight = amplitudes[k] / (square * sqrt(square))
            bx += weight * x
            by += weight * y
            bz += weight * z
        out[n, 0], out[n, 1], out[n, 2] = bx, by, bz


@reordered
def _gradient_of_charges(points: Floats, places: Floats, amplitudes: Floats, first: int,
                         last: int, out: Floats) -> None:
    """Write the gradient (n, 3, 3) of the field of all charges at points ``first`` to ``last``."""
    for n in range(first, last):
        xx = yy = xy = xz = yz = 0.0
        for k in range(len(places)):
            x, y, z = (points[n, 0] - places[k, 0], points[n, 1] - places[k, 1],
                       points[n, 2] - places[k, 2])
            square = x * x + y * y + z * z
            weight = amplitudes[k] / (square * sqrt(square))
            more = 3 * weight / square
            xx += weight - more * x * x
            yy += weight - more * y * y
            xy -= more * x * y
            xz -= more * x * z
            yz -= more * y * z
        out[n, 0, 0], out[n, 1, 1], out[n, 2, 2] = xx, yy, -xx - yy
        out[n, 0, 1] = out[n, 1, 0] = xy
        out[n, 0, 2] = out[n, 2, 0] = xz
        out[n, 1, 2] = out[n, 2, 1] = yz


@dataclass(frozen=True)
class Charges:
    """Charges around a region, and a uniform field."""

    places: Floats
    """Shape (k, 3), in m."""
    scale: float
    """A charge of amplitude 1 has the field ``scale R / |R|^3`` at the distance R, which has an rms
    of some 1/sqrt(k) in the region. In m^2."""

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
        return self.fields_along(np.repeat(points, 3, axis=0), np.tile(np.eye(3), (
            len(points), 1))).reshape(len(points), 3, -1)

    def fields_along(self, points: Floats, directions: Floats) -> Floats:
        """Return B . u (n, amplitudes) per amplitude at points (n, 3) in m, for u (n, 3)."""
        result = np.empty((len(points), len(self)))
        self._compute(_fields_of_charges, points, np.ascontiguousarray(directions, float),
                      self.places, self.scale, out=result)
        result[:, -3:] = UNIFORM * directions
        return result

    def field(self, points: Floats, amplitudes: Floats) -> Floats:
        """Return B (n, 3) in T at points (n, 3) in m for amplitudes (k,) in T."""
        result = np.empty((len(points), 3))
        self._compute(_field_of_charges, points, self.places, self.scale * amplitudes[:-3],
                      out=result)
        return result + UNIFORM * amplitudes[-3:]

    def gradient(self, points: Floats, amplitudes: Floats) -> Floats:
        """Return the gradient (n, 3, 3) in 1/m of the field of amplitudes (k,).

        ``[i, c, j]`` is the derivative of component c along direction j.
        """
        result = np.empty((len(points), 3, 3))
        self._compute(_gradient_of_charges, points, self.places, self.scale * amplitudes[:-3],
                      out=result)
        return result

    def _compute(
        self, kernel: Callable[..., None], points: Floats, *values: Any, out: Floats
    ) -> None:
        """Call a compiled function in threads."""
        # Number of pairs of points and charges that a thread computes in some milliseconds, in
        # which many could be started.
        enough_for_a_thread = 500_000
        points = np.ascontiguousarray(points, float)
        in_threads(lambda first, last: kernel(
            points, *values, first, last, out), share_out(
                len(points), 1 + len(points) * len(self.places) // enough_for_a_thread))


@dataclass(frozen=True)
class FewCharges(Charges):
    """Combinations of charges that readings determine: amplitudes (r,) of ``vectors`` (k, r), see
    `FreeField.determined`.
    """

    vectors: Floats

    def __len__(self) -> int:
        """Return the number of combinations."""
        return self.vectors.shape[1]

    def fields_along(self, points: Floats, directions: Floats) -> Floats:
        """Return B . u (n, r) per amplitude, for u (n, 3)."""
        result = np.empty((len(points), len(self)))
        of_all = Charges(self.places, self.scale)
        for some in slices(len(points), AT_ONCE):
            np.matmul(of_all.fields_along(points[some], directions[some]), self.vectors,
                      out=result[some])
        return result

    def field(self, points: Floats, amplitudes: Floats) -> Floats:
        """Return B (n, 3) in T for amplitudes (r,)."""
        return super().field(points, self.vectors @ amplitudes)

    def gradient(self, points: Floats, amplitudes: Floats) -> Floats:
        """Return the gradient (n, 3, 3) in 1/m of the field of amplitudes (r,)."""
        return super().gradient(points, self.vectors @ amplitudes)


def spacing_of(points: Floats, gap: float) -> float:
    """Return the distance in m from each other of charges at a distance in m around points (n, 3).

    It is `CLOSENESS` of that distance, or larger if there were too many.
    """
    most_charges = 3300  # largest number of charges, which limits memory and time
    sides = np.ptp(points, axis=0) + 2 * gap
    area = 2 * float(np.sum(sides * np.roll(sides, 1)))
    return float(max(CLOSENESS * gap, np.sqrt(area / most_charges)))


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


PENALTIES = 10.0 ** np.arange(-12, 3, 0.5)
"""Penalties among which the evidence chooses, in units of the mean information per amplitude."""

LEAST_KNOWN = 0.03
"""Information that readings have of a combination of amplitudes, in units of that of the prior, up
to which it is left out: the fit has 3 % of it at most."""


@dataclass(frozen=True)
class HarmonicFit:
    """Amplitudes of charges, or of solid harmonics, that fit readings without any instrument."""

    amplitudes: Floats
    """Shape (k,), in T."""
    penalty: float
    """Ratio of the variances of the noise and of an amplitude."""
    sigma: float
    """Standard deviation of the readings from the fit. In T."""
    log_evidence: float
    """Log probability of the readings, up to a constant, at the most probable penalty and sigma."""
    used: float
    """Number of amplitudes that the readings determine."""


NO_FIT = HarmonicFit(np.zeros(0), 1.0, 1.0, 0.0, 0.0)
"""What a search starts from that does not use it."""


def _range_of(gram: Floats, least: float) -> tuple[Floats, Floats, Ints]:
    """Return an orthonormal basis (n, r) of what a matrix (n, n) holds beyond a size, a root (r, r)
    of the matrix in that basis, and the numbers (r,) of the columns that make it.
    """
    # What the decomposition leaves out, in units of what is kept: columns together hold more than
    # each by itself.
    deeper = 1 / 16
    factor, pivots, rank, _ = linalg.lapack.dpstrf(gram, tol=deeper * least, lower=1)
    lower = np.empty((len(factor), rank))
    lower[pivots - 1] = np.tril(factor[:, :rank])
    basis, root = linalg.qr(lower, mode="economic", overwrite_a=True, check_finite=False)
    return basis, root, pivots[:rank] - 1


class FreeField:
    """What the prior field of the charges leaves of readings: ``P = (1 + A A^T / penalty)^-1``.

    ``A`` (m, k) are the readings by amplitude, and ``penalty`` is the ratio of the variances of
    noise and amplitudes. ``P`` follows from the smaller one of A A^T and A^T A, the ``gram``. The
    penalty is at least what rounding makes of it, so that maps without noise, and those that read
    twice at a place, have positive definite matrices too.
    """

    def __init__(self, by_amplitude: Floats, penalty: float, gram: Floats | None = None,
                 dual: bool | None = None) -> None:
        self.by_amplitude = by_amplitude
        self.dual = len(by_amplitude) <= by_amplitude.shape[1] if dual is None else dual
        tall = by_amplitude if self.dual else by_amplitude.T
        self.gram = tall @ tall.T if gram is None else gram
        trace = float(np.trace(self.gram))  # no eigenvalue is larger
        self.mean, self.least = trace / by_amplitude.shape[1], 2 * np.finfo(float).eps * trace
        self.penalty = max(penalty, self.least)

    def of_noise(self, penalty: float) -> FreeField:
        """Return the same for another penalty."""
        if max(penalty, self.least) == self.penalty:
            return self
        return FreeField(self.by_amplitude, penalty, self.gram, self.dual)

    @cached_property
    def spectrum(self) -> tuple[Floats, Floats]:
        """The eigenvalues (r,) of the gram beyond its rounding, and its eigenvectors (m or k, r).

        A Cholesky decomposition with pivots stops where nothing but rounding is left: fields far
        from their sources have few combinations, of which alone eigenvectors are sought. Those of
        its factor by itself are not perpendicular where values are near to rounding, which took up
        to 9 off log evidences; of an orthonormal basis of its columns they are.
        """
        gram, basis = self.gram, None
        if len(gram) >= FEW:
            basis, *_ = _range_of(gram, self.least)
            gram = basis.T @ gram @ basis
        values, vectors = linalg.eigh(gram, check_finite=False)
        kept = values > self.least
        return values[kept], vectors[:, kept] if basis is None else basis @ vectors[:, kept]

    def determined(self, penalty: float) -> tuple[Ints, Floats]:
        """Return the numbers (c,) of some amplitudes, and combinations (c, r) of these, which stand
        for all combinations that readings tell more of than a share `LEAST_KNOWN` of what is known
        before them. The last three, of uniform fields, are among them.

        A Cholesky decomposition with pivots chooses amplitudes whose fields make those of all
        others (H. Cheng et al., SIAM J. Sci. Comput. 26 (2005) 1389). Combinations Q of all
        amplitudes are then those of the chosen ones by the inverse of their rows of Q, transposed.
        """
        gram = self.by_amplitude.T @ self.by_amplitude if self.dual else self.gram
        least = LEAST_KNOWN * max(penalty, self.least)
        basis, root, numbers = _range_of(gram, EXACTLY * least)
        values, directions = linalg.eigh(root @ root.T, check_finite=False)
        known = directions[:, values > least]
        chosen = np.union1d(numbers, np.arange(len(gram) - 3, len(gram)))
        vectors = np.zeros((len(chosen), known.shape[1]))
        vectors[np.searchsorted(chosen, numbers)] = np.linalg.solve(basis[numbers].T, known)
        return chosen, vectors

    def part(self, rows: NDArray[np.bool_], rest: FreeField | None = None) -> FreeField:
        """Return the same for some of the readings (m,), of which ``rest`` has all others."""
        gram = None if rest is None or self.dual else self.gram - rest.gram
        if self.dual:
            gram = self.gram[np.ix_(rows, rows)]
        return FreeField(self.by_amplitude[rows], self.penalty, gram, self.dual)

    @cached_property
    def lower(self) -> Floats:
        """The lower triangle of the Cholesky decomposition of the gram and the penalty."""
        with_prior = self.gram.copy()
        with_prior[np.diag_indices(len(with_prior))] += self.penalty
        return np.asarray(linalg.cholesky(with_prior, lower=True, overwrite_a=True,
                                          check_finite=False))

    def solve(self, values: Floats) -> Floats:
        """Return the inverse of gram and penalty times values."""
        return np.asarray(linalg.cho_solve((self.lower, True), values, check_finite=False))

    def left(self, readings: Floats) -> Floats:
        """Return P times readings (m,) or (m, p)."""
        if self.dual:
            return self.penalty * self.solve(readings)
        return np.asarray(readings - self.by_amplitude @ self.amplitudes(readings))

    def amplitudes(self, readings: Floats) -> Floats:
        """Return the most probable amplitudes (k,) or (k, p)."""
        if self.dual:
            return np.asarray(self.by_amplitude.T @ self.solve(readings))
        return self.solve(self.by_amplitude.T @ readings)

    @cached_property
    def trace(self) -> float:
        """Trace of P: the number of readings that the field does not use up."""
        inverse, info = linalg.lapack.dtrtri(self.lower, lower=1)
        assert info == 0  # the factor is that of a Cholesky decomposition
        rest = 0 if self.dual else len(self.by_amplitude) - self.by_amplitude.shape[1]
        return rest + self.penalty * float(np.vdot(inverse, inverse))

    def diagonal(self) -> Floats:
        """Return the diagonal (m,) of P."""
        if self.dual:
            inverse, _ = linalg.lapack.dtrtri(self.lower, lower=1)
            return np.asarray(self.penalty * np.einsum("ij,ij->j", inverse, inverse))
        return np.concatenate([1 - np.sum(half**2, axis=0) for half in self._halves()])

    def diagonals(self) -> tuple[Floats, Floats]:
        """Return the diagonals (m,) of P and of P^2."""
        if self.dual:
            whole = self.penalty * self.solve(np.eye(len(self.gram)))
            return np.diag(whole).copy(), np.sum(whole**2, axis=0)
        once, twice = [], []
        for half in self._halves():
            once.append(1 - np.sum(half**2, axis=0))
            solved = linalg.solve_triangular(self.lower, half, trans=1, lower=True,
                                             check_finite=False)
            twice.append(once[-1] - self.penalty * np.sum(solved**2, axis=0))
        return np.concatenate(once), np.concatenate(twice)

    def _halves(self) -> Iterator[Floats]:
        """Yield half of the way to the solutions for some columns (k, m) of A^T at a time."""
        for part in slices(len(self.by_amplitude), AT_ONCE):
            yield np.asarray(linalg.solve_triangular(
                self.lower, self.by_amplitude[part].T, lower=True, check_finite=False))

    def most_probable(self, readings: Floats) -> HarmonicFit:
        """Return the fit of readings (m,) by that one of `PENALTIES` which has most evidence.

        All are tried: readings near magnets have two maxima, as far from sources they have another
        noise.
        """
        values, vectors = self.spectrum
        if self.dual:
            along = vectors.T @ readings
            beyond = readings - vectors @ along
        else:
            along = (vectors.T @ (self.by_amplitude.T @ readings)) / np.sqrt(values)
            beyond = readings - self.by_amplitude @ (vectors @ (along / np.sqrt(values)))
        penalties = np.maximum(PENALTIES * self.mean, self.least)
        share = penalties[:, None] / (values + penalties[:, None])  # of each one that is left
        sigma = np.sqrt(np.maximum(beyond @ beyond + share @ along**2, 1e-30) / len(readings))
        evidence = np.log(share).sum(axis=1) / 2 - len(readings) * np.log(sigma)
        best = int(np.argmax(evidence))
        weights = (1 - share[best]) * along / np.sqrt(values)
        amplitudes = (self.by_amplitude.T @ (vectors @ (weights / np.sqrt(values))) if self.dual
                      else vectors @ weights)
        return HarmonicFit(amplitudes, float(penalties[best]), float(sigma[best]),
                           float(evidence[best]), float(np.sum(1 - share[best])))


def fit_fields(charges: Charges, points: Floats, fields: Sequence[Floats]) -> list[HarmonicFit]:
    """Fit each of some fields B (n, 3) in T at points (n, 3) in m by charges.

    The width of their prior and the noise are those of largest evidence (D. J. C. MacKay, Neural
    Comput. 4 (1992) 415).
    """
    return fit_readings(charges.fields(points).reshape(-1, len(charges)),
                        [field.ravel() for field in fields])


def fit_readings(design: Floats, readings: Sequence[Floats]) -> list[HarmonicFit]:
    """Fit each of some readings (m,) in T, of which ``design`` (m, k) is that per amplitude."""
    free = FreeField(design, 0.0)
    return [free.most_probable(each) for each in readings]
