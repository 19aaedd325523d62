"""Fit of a three-axis probe, together with the field without sources in which it was.

The readings are linear in the amplitudes of the field's charges (`halbach_fe.measurement.
source_free_field`), and nearly so in the parameters of the probe: the places of its sensors, the
matrix between the axes of probe and stage, turns and changes of gain and offset during the scan,
and the lag of the readings behind the stage. Gauss-Newton steps of the probe's parameters are
taken with the amplitudes eliminated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.measurement.source_free_field import Charges, FewCharges, FreeField, HarmonicFit
from halbach_fe.measurement.suspect_rows import scatter_around
from halbach_fe.study.types import COMPONENTS

ITERATIONS, FEW_ITERATIONS = 12, 2
"""Largest number of steps of the fit of field and instrument before the last, linear one, and while
orientations are tried or from a fit of nearly the same readings."""

HALVINGS = 8
"""Number of times that a step is halved until it improves the fit."""

NEAR = 0.1
"""Change of an instrument, in units of its prior, up to which a design is used again: readings per
amplitude change by some per cent, and residuals are those of the exact ones."""

AT_REST, NEARLY_AT_REST = 1.0, 10.0
"""Decreases of chi-squared, of thousands of readings, below which the fit is at rest, and below
which a small step is taken as if they were linear in it."""

WAVES, COARSE_WAVES = 8, 4
"""Number of Legendre polynomials of the time by which the probe turns and its gain drifts, and of
those that are not small. A probe that settles turns fast at first: on the measured map of an MRI
magnet 4 left 13.8 µT of held-out lines, 6 9.7, 8 8.2 and 12 8.3."""

SENSORS, MIXING = slice(0, 9), slice(9, 18)
TURNS = slice(18, 18 + 3 * WAVES)
OFFSETS = slice(TURNS.stop, TURNS.stop + 3)
GAINS = slice(OFFSETS.stop, OFFSETS.stop + WAVES)
LAG = GAINS.stop
SCALES = slice(LAG + 1, LAG + 4)
"""Places of the parameters: coordinates of the sensors, the matrix between the axes of probe and
stage (see `MATRICES`), turns, changes of offsets, changes of the gain, the lag, and the scales of
the stage along its axes."""

_OF_WAVES = (0.01,) * COARSE_WAVES + (3e-3,) * (WAVES - COARSE_WAVES)
PRIOR_SD = (*(3e-3,) * 9, *(0.05,) * 3, *(0.02,) * 6, *np.repeat(_OF_WAVES, 3).tolist(),
            *(2e-3,) * 3, *_OF_WAVES, 1e-3, *(3e-3,) * 3)
"""Prior standard deviations: in m, rad, rad, 1, rad, of the largest field, 1, m, and 1. A lead
screw is true to parts in 10 000, belts and steps per mm that somebody typed in to some 3e-3, as in
hidden effects of simulated campaigns at most; 1 % is 3.3 of these, which is not yet doubted."""

PAIRS = tuple(((axis + 1) % 3, (axis + 2) % 3) for axis in range(3))
"""The other two axes of every axis."""


def _matrices() -> Floats:
    """Return the matrices (9, 3, 3) of turns about the axes, of angles between them, and gains.

    An angle is by how much less than 90 degrees two sensors are apart.
    """
    found = np.zeros((9, 3, 3))
    for axis, (first, second) in enumerate(PAIRS):
        found[axis, first, second], found[axis, second, first] = 1.0, -1.0
        found[3 + axis, first, second] = found[3 + axis, second, first] = 0.5
        found[6 + axis, axis, axis] = 1.0
    found[6:] -= np.eye(3) / 3  # a common gain is no error that a map can show
    return found


MATRICES = _matrices()


@dataclass(frozen=True)
class ProbeFit:
    """A field together with an instrument."""

    amplitudes: Floats
    """Shape (k,)."""
    instrument: Floats
    """In units of `PRIOR_SD`. Shape (p,)."""
    covariance: Floats
    """Shape (p, p)."""
    sigma: float
    """In T."""
    used: float
    """Number of parameters that the readings determine."""
    prior_sd: Floats
    """Prior standard deviations in SI. Shape (p,)."""
    lag: bool
    """Whether the stage moved in more than one direction along the lines."""

    @property
    def sensors_m(self) -> Floats:
        """Places (3, 3) of the sensors relative to their mean."""
        places = (self.instrument * self.prior_sd)[SENSORS].reshape(3, 3)
        return np.asarray(places - places.mean(axis=0))

    def read_at(self, points: Floats) -> Floats:
        """Return where sensors read the field (3 n, 3) at points (n, 3) of the map, both in m."""
        scaled = points + (self.instrument * self.prior_sd)[SCALES] * from_middle(points)
        return np.asarray((scaled[:, None] + self.sensors_m).reshape(-1, 3))

    @property
    def mixing(self) -> Floats:
        """Matrix (3, 3) that is added to 1: reading c is row c times B.

        Its trace is 0, because a common gain is no error that a map can show. (Where one component
        is most of the field, that changes the field's size: `ProbeModel.ideal` takes it back.)
        """
        return np.einsum("m,mij->ij", (self.instrument * self.prior_sd)[MIXING], MATRICES)


def from_middle(points: Floats) -> Floats:
    """Return points (n, 3) in m as they lie to the middle of all of them, about which a stage of
    another scale displaces them: where else it is right is a shift of the map.
    """
    return np.asarray(points - (points.max(axis=0) + points.min(axis=0)) / 2)


LEAST_OWN = 0.05
"""Smallest share of a reading that the fit counts to leave: beyond, its residual is rounding."""


def weights_of(scatter: Floats, sensors: int = 3) -> Floats:
    """Return weights (n, s), whose median is 1, of readings that scatter by as much (n,) in T."""
    # Smallest standard deviation by which a reading is weighted, relative to the median one: the
    # flattest readings of a small map may be fitted by chance.
    least_error = 0.3
    median = float(np.median(scatter))
    if not median:
        return np.ones((len(scatter), sensors))
    return np.repeat(median / np.maximum(scatter, least_error * median)[:, None], sensors, axis=1)


class ProbeModel:
    """Readings of a three-axis probe in a harmonic field.

    ``weights`` (n, s) multiply the residuals. They follow from ``scatter`` (n,) in T, by which
    readings are expected to be off a field without sources. ``sensors`` (s,) are those whose
    columns of the map (n, 3) are not empty: of one or two, only what changes during the scan is
    asked, as one component says nothing of another. Nor is that if all times are the same. Scales
    of the stage are in models `with_terms` only: with them in the fit of everything at once, in
    which nothing is asked, weights moved, and a turn and a drift near blocks were missed.
    """

    sensors: tuple[int, ...] = (0, 1, 2)
    is_settled: bool = False

    def __init__(self, charges: Charges, points: Floats, field: Floats, time: Floats,
                 directions: Floats, scatter: Floats) -> None:
        self.sensors = tuple(np.flatnonzero(np.isfinite(field).any(axis=0)).tolist())
        self.charges, self.points, self.field = charges, points, field[:, self.sensors]
        self.time, self.directions = time, directions
        self.arms = from_middle(points)
        self.waves = np.polynomial.legendre.legvander(time, WAVES)[:, 1:]
        sd = np.array(PRIOR_SD)
        sd[OFFSETS] *= float(np.nanmax(np.abs(field)))
        step = np.linalg.norm(np.diff(points, axis=0), axis=1)[directions[1:].any(axis=1)]
        sd[LAG] = max(sd[LAG], float(np.median(step)) if len(step) else 0.0)  # a row late
        if len(self.sensors) < len(COMPONENTS):
            sd[:OFFSETS.start] = sd[SCALES] = 0.0
        if not np.ptp(time):
            sd[TURNS.start:SCALES.start] = 0.0
        self.prior_sd, self.any_sd = sd.copy(), sd
        self.prior_sd[SCALES] = 0.0
        self.scatter, self.weights = scatter, weights_of(scatter, len(self.sensors))
        self._last: list[Any] = []
        self.near = NEAR * sd

    def turned(self, matrix: Floats) -> Self:
        """Return a model of the components that a matrix (3, 3) makes of the readings."""
        other = copy(self)
        if len(self.sensors) == len(COMPONENTS):  # the columns of fewer stay as they are given
            other.field = self.field @ matrix.T
        return other

    def with_terms(self, kept: NDArray[np.bool_]) -> Self:
        """Return a model whose instrument has some of all parameters (p,) only."""
        other = copy(self)
        other.prior_sd = np.where(kept, self.any_sd, 0.0)
        return other

    def weighted(self, at: ProbeFit, rows: NDArray[np.bool_], width2: float) -> ProbeModel:
        """Return a model that weights readings by how far those around are off the field of others.

        Near edges of magnets charges follow the field less well than the probe reads it. There are
        few such readings, but without weights they are what decides on the instrument: it is given
        errors of many standard deviations that it does not have.
        """
        own = self.free(at, rows, at.sigma**2 / width2).diagonal().reshape(-1, len(self.sensors))
        left = (self.field[rows] - self.readings(at, rows)) / np.maximum(own, LEAST_OWN)
        other = copy(self)
        other.scatter = scatter_around(self.points, self.points[rows], left)
        other.weights = weights_of(other.scatter, len(self.sensors))
        return other

    def allowed(self, at: ProbeFit) -> ProbeFit:
        """Return a fit to start from, with 0 for the parameters that this model leaves out."""
        return replace(at, instrument=np.where(self.prior_sd > 0, at.instrument, 0.0),
                       prior_sd=self.prior_sd)

    def lag_shows(self, rows: NDArray[np.bool_]) -> bool:
        """Tell whether the stage moved both ways, without which a lag is a shift of the map."""
        return bool(np.ptp(self.directions[rows], axis=0).max() > 1.5)

    def start(self, fit: HarmonicFit) -> ProbeFit:
        """Return the fit of a perfect instrument."""
        count = len(self.prior_sd)
        return ProbeFit(fit.amplitudes, np.zeros(count), np.eye(count), fit.sigma, fit.used,
                       self.prior_sd, False)

    def fit(self, at: ProbeFit, rows: NDArray[np.bool_]) -> HarmonicFit:
        """Return the fit of the field alone, read by an instrument that is known."""
        return self.free(at, rows, 0.0).most_probable(self.target(at, rows))

    def few(self, at: ProbeFit, rows: NDArray[np.bool_], penalty: float) -> Self:
        """Return a model of the same field by those combinations of charges that rows determine."""
        other, design = copy(self), self.free(at, rows, 0.0)
        chosen, vectors = design.determined(penalty)
        other.charges = FewCharges(self.charges.places[chosen[:-3]], self.charges.scale, vectors)
        other._last = [other.charges, rows, at.instrument * self.prior_sd, self.weights,
                       FreeField(design.by_amplitude[:, chosen] @ vectors, 0.0)]
        return other

    def settled(self) -> Self:
        """Return a model whose instrument is known: fits of it change the field alone."""
        other = copy(self)
        other.is_settled = True
        return other

    def even(self) -> Self:
        """Return a model without weights, whose designs are exact."""
        other = copy(self)
        other.weights, other.near = np.ones_like(self.weights), np.zeros_like(self.near)
        other._last = list(self._last)
        return other

    def free(self, at: ProbeFit, rows: NDArray[np.bool_], penalty: float) -> FreeField:
        """Return what the field leaves of the readings of some rows, for a penalty.

        The last design is kept, which most calls share: weights scale it, and for an instrument
        that has hardly changed it is one by which the fit still converges, see `target`.
        """
        value = at.instrument * self.prior_sd
        kept = self._last and self._last[0] is self.charges and bool(
            (rows <= self._last[1]).all() and (np.abs(value - self._last[2]) <= self.near).all())
        if kept and not np.array_equal(rows, self._last[1]):
            some = np.repeat(rows[self._last[1]], len(self.sensors))
            self._last[1:] = [rows, *self._last[2:4], FreeField(
                self._last[4].by_amplitude[some], 0.0)]
        if not kept:
            self._last.clear()  # before the next one is made, which is as large
            self._last += [self.charges, rows, value, self.weights, FreeField(
                self.by_amplitude(at, rows).reshape(-1, len(self.charges)), 0.0)]
        elif self._last[3] is not self.weights:
            ratio = (self.weights / self._last[3])[rows].ravel()
            self._last[3:] = [self.weights, FreeField(
                ratio[:, None] * self._last[4].by_amplitude, 0.0)]
        return self._last[4].of_noise(penalty)

    def target(self, at: ProbeFit, rows: NDArray[np.bool_]) -> Floats:
        """Return the weighted readings (3 n,) in T that the amplitudes explain, by `free`.

        They are those without the change of the sensors' offsets, and with what the kept design
        differs from that of ``at``.
        """
        self.free(at, rows, 0.0)
        if len(at.amplitudes) != len(self.charges) or self.is_exact(at):
            return np.asarray(((self.field[rows] - self.offsets(at, rows))
                               * self.weights[rows]).ravel())
        left = (self.field[rows] - self.readings(at, rows)) * self.weights[rows]
        return left.ravel() + self.free(at, rows, 0.0).by_amplitude @ at.amplitudes

    def is_exact(self, at: ProbeFit) -> bool:
        """Tell whether the kept design is that of the instrument of ``at``, see `free`."""
        return bool(self._last) and np.array_equal(self._last[2], at.instrument * self.prior_sd)

    def offsets(self, at: ProbeFit, rows: NDArray[np.bool_]) -> Floats:
        """Return the change (n, s) in T of the sensors' offsets."""
        change = (at.instrument * self.prior_sd)[OFFSETS][list(self.sensors)]
        return np.asarray(self.time[rows, None] * change)

    def read_by(
        self, at: ProbeFit, rows: NDArray[np.bool_], sensor: int
    ) -> tuple[Floats, Floats]:
        """Return the places (n, 3) in m of a sensor and the directions (n, 3) that it reads."""
        value, waves, own = at.instrument * self.prior_sd, self.waves[rows], np.eye(3)[sensor]
        turn, gain = waves @ value[TURNS].reshape(WAVES, 3), waves @ value[GAINS]
        reads = own + at.mixing[sensor] + np.cross(turn, own) + gain[:, None] * own
        return (self.points[rows] + at.sensors_m[sensor] - value[LAG] * self.directions[rows]
                + value[SCALES] * self.arms[rows], reads)

    def by_amplitude(self, at: ProbeFit, rows: NDArray[np.bool_]) -> Floats:
        """Return the weighted readings (n, s, k) per amplitude."""
        places, reads = (np.stack(each, axis=1) for each in zip(*(
            self.read_by(at, rows, sensor) for sensor in self.sensors), strict=True))
        reads = reads * self.weights[rows, :, None]
        return self.charges.fields_along(places.reshape(-1, 3), reads.reshape(-1, 3)).reshape(
            len(places), len(self.sensors), -1)

    def by_parameter(self, at: ProbeFit, rows: NDArray[np.bool_]) -> Floats:
        """Return the weighted derivatives (n, s, p) in T by the parameters / `PRIOR_SD`."""
        found = np.zeros((int(rows.sum()), len(self.sensors), len(PRIOR_SD)))
        if self.is_settled or not self.prior_sd.any():
            return found
        for number, sensor in enumerate(self.sensors):
            places, reads = self.read_by(at, rows, sensor)
            field = self.charges.field(places, at.amplitudes)
            gradient = np.einsum("nc,ncj->nj", reads,
                                 self.charges.gradient(places, at.amplitudes))
            for other in range(3):  # of the mean of the sensors, which stays where it is
                found[:, number, 3 * other:3 * other + 3] = gradient * (
                    (sensor == other) - 1 / 3)
            found[:, number, MIXING] = field @ MATRICES[:, sensor].T
            found[:, number, TURNS] = np.einsum(
                "nw,na->nwa", self.waves[rows], np.cross(np.eye(3)[sensor], field)
            ).reshape(len(found), -1)
            found[:, number, OFFSETS.start + sensor] = self.time[rows]
            found[:, number, GAINS] = self.waves[rows] * field[:, sensor, None]
            if at.lag:
                found[:, number, LAG] = -np.sum(gradient * self.directions[rows], axis=1)
            found[:, number, SCALES] = gradient * self.arms[rows]
        return found * self.prior_sd * self.weights[rows, :, None]

    def readings(self, at: ProbeFit, rows: NDArray[np.bool_] | None = None) -> Floats:
        """Return what the instrument reads (n, s) in T at some rows, by default at all."""
        chosen = np.flatnonzero(np.ones(len(self.points), bool) if rows is None else rows)
        found = np.empty((len(chosen), len(self.sensors)))
        some = np.zeros(len(self.points), bool)
        some[chosen] = True
        for number, sensor in enumerate(self.sensors):
            places, reads = self.read_by(at, some, sensor)
            found[:, number] = np.sum(reads * self.charges.field(places, at.amplitudes), axis=1)
        return np.asarray(found + self.offsets(at, some))

    def noise_left(
        self, at: ProbeFit, rows: NDArray[np.bool_], width2: float
    ) -> Floats:
        """Return how much of the variance of each reading (n, s) the fit of the field leaves.

        The rest the field takes along, the most at the edges of a map. For the prior variance
        ``width2`` of the amplitudes in T^2 it is the diagonal of P^2 of `FreeField`, and that of P
        is the share of a reading which is left: a residual divided by it is that of a fit without
        the reading. The few numbers of the instrument are left out.
        """
        left = self.free(at, rows, at.sigma**2 / width2).diagonals()[1]
        return left.reshape(-1, len(self.sensors))

    def ideal(self, at: ProbeFit) -> Floats:
        """Return what a probe without errors would have read (n, 3) in T.

        What the fit leaves stays in it, along the axes that the sensors read. The gain of |B| is
        that of the readings, because no map can show a common gain.
        """
        every = np.ones(len(self.points), bool)
        reads = np.stack([self.read_by(at, every, sensor)[1] for sensor in range(3)], axis=1)
        read, field = self.readings(at), self.charges.field(self.points, at.amplitudes)
        if len(self.sensors) < len(COMPONENTS):
            return np.asarray(self.columns(self.field - read + field[:, self.sensors]))
        gain = 1 + float(np.sum(self.shares(at) * at.mixing))
        return np.asarray(gain * (field + np.linalg.solve(
            reads, (self.field - read)[..., None])[..., 0]))

    def columns(self, values: Floats) -> Floats:
        """Return values (n, s) of the sensors as columns (n, 3) of a map, empty without one."""
        found = np.full((len(values), len(COMPONENTS)), np.nan)
        found[:, self.sensors] = values
        return found

    def shares(self, at: ProbeFit) -> Floats:
        """Return the mean products (3, 3) of two components, relative to the mean square of |B|.

        They are how much each element of the matrix of gains and crosstalk changes |B|.
        """
        field = self.charges.field(self.points, at.amplitudes)
        return np.asarray(field.T @ field / np.sum(field**2))


def fit_probe(
    model: ProbeModel, rows: NDArray[np.bool_], fit: HarmonicFit, start: ProbeFit | None = None,
    iterations: int = ITERATIONS
) -> ProbeFit:
    """Fit field and instrument together by Gauss-Newton steps, each of which improves the fit.

    ``fit`` is that of a perfect instrument, and has the prior width of the amplitudes.
    """
    at = replace(start or model.start(fit), lag=model.lag_shows(rows))
    width2 = fit.sigma**2 / fit.penalty
    state = State.of(model, at, rows, width2)
    for number in range(iterations + 1):
        design, by_field, covariance = state.normal()
        step, used = state.step(design, covariance), state.used(design, by_field, covariance)
        lower, small = state.decrease(design, step), bool(
            (np.abs(step * model.prior_sd) <= model.near).all())
        if last := number == iterations or lower < (NEARLY_AT_REST if small else AT_REST):
            after = state.linear(step, design, by_field) if small else state
        else:
            after = state.stepped(step)
        sigma = float(np.sqrt(after.left @ after.left / max(len(after.left) - used, 1.0)))
        found = replace(after.at, sigma=sigma, covariance=sigma**2 * covariance, used=used)
        if last or after is state:
            return found
        state = after.with_noise(sigma, found)
    raise AssertionError  # the last step is a linear one


@dataclass(frozen=True)
class Evidence:
    """What some readings tell of the instrument: ``information @ instrument = sums``."""

    information: Floats
    """Shape (p, p)."""
    sums: Floats
    """The instrument is in units of `PRIOR_SD`. The field is that of these readings, too.
    Shape (p,)."""

    @classmethod
    def of(
        cls, model: ProbeModel, rows: NDArray[np.bool_], at: ProbeFit, width2: float,
        parts: Sequence[NDArray[np.bool_]] = (),
    ) -> Iterator[Evidence]:
        """Yield what some rows tell, and what each half of them does, near a fit.

        ``parts`` are one half of pairs of halves; the other one has the other rows. ``width2`` is
        the prior variance of amplitudes in T^2.
        """
        state = State.of(model, at, rows, width2)
        design, *_ = state.normal()
        target, whole = state.target + design @ at.instrument, state.free

        def told(free: FreeField, own: NDArray[np.bool_]) -> Evidence:
            by_term = design[own]
            return cls(*(by_term.T @ free.left(each) / at.sigma**2
                         for each in (by_term, target[own])))

        yield told(whole, np.ones(len(target), bool))
        for part in parts:
            own = np.repeat(part[rows], len(model.sensors))
            first = whole.part(own)
            yield told(first, own)
            yield told(whole.part(~own, first), ~own)

    def log_evidence(self, kept: NDArray[np.bool_]) -> float:
        """Return the log Bayes factor of an instrument of some parameters (p,) to a perfect one."""
        sums = self.sums[kept]
        information = self.information[np.ix_(kept, kept)] + np.eye(len(sums))
        return float(sums @ np.linalg.solve(information, sums)
                     - np.linalg.slogdet(information)[1]) / 2

    def estimate(self, kept: Ints) -> tuple[Floats, Floats]:
        """Return the values (k,) and covariance (k, k) of an instrument of some parameters only."""
        covariance = np.linalg.inv(self.information[np.ix_(kept, kept)] + np.eye(len(kept)))
        return covariance @ self.sums[kept], np.asarray(covariance)


@dataclass(frozen=True)
class State:
    """The field of largest probability for an instrument and a noise."""

    model: ProbeModel
    rows: NDArray[np.bool_]
    width2: float
    at: ProbeFit
    chi2: float
    """With the prior of amplitudes and instrument."""
    left: Floats
    """Shape (m,), in T."""
    target: Floats
    """Shape (m,), in T."""
    free: FreeField

    @classmethod
    def of(cls, model: ProbeModel, at: ProbeFit, rows: NDArray[np.bool_], width2: float) -> State:
        """Fit the field for the instrument and the noise of ``at``."""
        free = model.free(at, rows, at.sigma**2 / width2)
        state = cls._solved(model, rows, width2, at, model.target(at, rows), free)
        # a design that is used again is off by some per cent of what the amplitudes change
        return state if model.is_exact(at) else cls._solved(
            model, rows, width2, at, model.target(state.at, rows), free)

    @classmethod
    def _solved(
        cls, model: ProbeModel, rows: NDArray[np.bool_], width2: float, at: ProbeFit,
        target: Floats, free: FreeField,
    ) -> State:
        """Solve for the amplitudes."""
        amplitudes = free.amplitudes(target)
        left = target - free.by_amplitude @ amplitudes
        chi2 = (float(left @ left) / at.sigma**2 + float(amplitudes @ amplitudes) / width2
                + float(at.instrument @ at.instrument))
        return cls(model, rows, width2, replace(at, amplitudes=amplitudes), chi2, left, target,
                   free)

    def with_noise(self, sigma: float, at: ProbeFit) -> State:
        """Return the state of the same instrument for another noise in T."""
        return self._solved(self.model, self.rows, self.width2, replace(at, sigma=sigma),
                            self.target, self.free.of_noise(sigma**2 / self.width2))

    def normal(self) -> tuple[Floats, Floats, Floats]:
        """Return the design (m, p) of the instrument, what the field leaves of it, its covariance.

        The amplitudes, which are the best for the present instrument, are eliminated from the
        normal equations. The covariance (p, p) is relative to sigma^2.
        """
        count = len(self.at.instrument)
        design = self.model.by_parameter(self.at, self.rows).reshape(-1, count)
        left = self.free.left(design)
        return design, left, np.asarray(np.linalg.inv(
            design.T @ left + self.at.sigma**2 * np.eye(count)))

    def feigned(self) -> Floats:
        """Return the information (p, p) that an unknown field would feign, see `normal`.

        It is that of fields drawn from what the readings leave open. Where `normal` has no more,
        it is not the field that tells of a parameter, but what is not known of the field.
        """
        draws = 8  # they know each information to some 30 %
        nothing = np.zeros(len(self.at.amplitudes))
        known = self.model.by_parameter(replace(self.at, amplitudes=nothing), self.rows)
        generator = np.random.default_rng(0)  # results are the same every time
        found = np.zeros(2 * (len(self.at.instrument),))
        for _ in range(draws):
            prior = np.sqrt(self.width2) * generator.standard_normal(len(self.at.amplitudes))
            read = self.free.by_amplitude @ prior + self.at.sigma * generator.standard_normal(
                len(self.left))
            design = (self.model.by_parameter(replace(
                self.at, amplitudes=prior - self.free.amplitudes(read)), self.rows)
                - known).reshape(-1, len(found))  # offsets and drifts need no field
            found += design.T @ self.free.left(design) / draws
        return found

    def step(self, design: Floats, inverse: Floats) -> Floats:
        """Return the step (p,) of the instrument, see `normal`."""
        if self.model.is_settled:
            return np.zeros(len(inverse))
        return np.asarray(inverse @ (
            design.T @ self.left - self.at.sigma**2 * self.at.instrument))

    def decrease(self, design: Floats, step: Floats) -> float:
        """Return by how much a step decreases `chi2`, if the readings are linear in it."""
        return float(step @ (design.T @ self.left / self.at.sigma**2 - self.at.instrument))

    def linear(self, step: Floats, design: Floats, left: Floats) -> State:
        """Return the state after a step in which the readings are linear, see `normal`."""
        at = replace(self.at, instrument=self.at.instrument + step, amplitudes=(
            self.at.amplitudes - self.free.amplitudes(design @ step)))
        return replace(self, at=at, left=self.left - left @ step)

    def stepped(self, step: Floats) -> State:
        """Return the state after a step, or a part of it that improves the fit; this one if none
        does.
        """
        for halving in range(HALVINGS):
            after = State.of(self.model, replace(
                self.at, instrument=self.at.instrument + step / 2**halving), self.rows, self.width2)
            if after.chi2 <= self.chi2:
                return after
        return self

    def used(self, design: Floats, left: Floats, inverse: Floats) -> float:
        """Return `ProbeFit.used`, by the traces of the inverse of all normal equations."""
        by_field = len(design) - self.free.trace - float(
            np.sum(inverse * (design.T @ left - left.T @ left)))
        return by_field + len(inverse) - self.at.sigma**2 * float(np.trace(inverse))


def noise_of(gradient: Floats, residual: Floats) -> tuple[float, float]:
    """Return the noise in T of readings and in m of positions that residuals (n, 3) show.

    A position noise s makes an error of s |grad B_c| in component c, for a gradient (n, 3, 3). It
    is 0 if the gradient is about the same everywhere, so that nothing tells the two noises apart.
    """
    # Ratio of the squared gradients of nine tenths and one tenth of the readings from which the
    # noise of positions is told from that of readings.
    steeper = 100.0
    steepness = np.sum(gradient**2, axis=2).ravel()
    flat, steep = np.quantile(steepness, [0.1, 0.9])
    squares = residual.ravel()**2
    if steep <= steeper * flat:  # of a uniform field both are 0
        return float(np.sqrt(squares.mean())), 0.0
    constant = float(squares[steepness <= flat].mean())
    return np.sqrt(constant), np.sqrt(max(squares.mean() - constant, 0.0) / steepness.mean())


@dataclass(frozen=True)
class Scatter:
    """What residuals tell of the noise of readings and of positions."""

    noise_T: float
    position_m: float
    position_sd_m: float = 0.0
    """Noise of positions and its standard deviation; 0 if nothing tells it."""
    at_most: bool = False
    """Whether ``position_m`` is an upper limit, as more than positions is left."""


def scatter_of(gradient: Floats, residual: Floats) -> Scatter:
    """Return the noise that residuals (n, 3) in T show, in a field of a gradient (n, 3, 3) in T/m.

    Positions that scatter by s make a variance of ``s^2 |grad B_c|^2`` everywhere. What the charges
    do not follow, near edges of magnets, grows faster. Then the group of readings in which the
    least is left for each T/m tells what positions may be at most: everything else only adds.
    """
    upper = 2.0  # standard deviations above a scatter up to which its true value is taken to lie
    # Standard deviations by which a group may be off a line of scatter over steepness: of six
    # groups one is beyond by chance in one of 3 000 maps.
    no_line = 4.0
    # Number of groups of readings, by the steepness of the field, whose scatter is compared.
    groups_of_steepness = 6
    noise, displaced = map(float, noise_of(gradient, residual))
    if not displaced:
        return Scatter(noise, 0.0)
    steepness, squares = np.sum(gradient**2, axis=2).ravel(), residual.ravel()**2
    groups = np.array_split(np.argsort(steepness), groups_of_steepness)
    steep, mean = (np.array([values[group].mean() for group in groups])
                   for values in (steepness, squares))
    # a mean of n squares of normal numbers has a relative error of sqrt(2 / n)
    sd = mean * np.sqrt(2 / np.array([len(group) for group in groups]))
    design = np.column_stack([np.ones_like(steep), steep]) / sd[:, None]
    (_, slope), *_ = np.linalg.lstsq(design, mean / sd, rcond=None)
    constant = max(0.0, float(np.sum((mean - slope * steep) / sd**2) / np.sum(sd**-2.0)))
    slope = float(np.sum((mean - constant) * steep / sd**2) / np.sum(steep**2 / sd**2))
    off = np.abs(mean - constant - slope * steep) / sd
    if slope <= 0 or off.max() > no_line:
        return Scatter(noise, float(np.sqrt(np.min((mean + upper * sd) / steep))), at_most=True)
    slope_sd = float(np.linalg.inv(design.T @ design)[1, 1]**0.5 * max(1.0, np.sqrt(
        np.sum(off**2) / (groups_of_steepness - 2))))
    position = float(np.sqrt(slope))
    flat = steepness <= np.quantile(steepness, 0.1)
    least = upper * noise**2 * np.sqrt(2 / flat.sum())  # the error of what is subtracted from
    alone = np.sqrt(max(noise**2 - slope * steepness[flat].mean(), least))
    return Scatter(float(min(alone, noise)), position, slope_sd / (2 * position))
