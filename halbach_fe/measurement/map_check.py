"""Maxwell's check of a field map: div B = 0, curl B = 0, and the instrument that this takes.

The map is fitted by a field of sources outside the mapped region (`halbach_fe.measurement.
harmonic_field`), of which no magnet is assumed. An instrument that exchanges axes, reverses signs,
has its three sensors in three places or turns during the scan makes a map that no such field has;
its parameters are fitted together with the field. What remains is the model-free floor: no model of
a magnet can explain the map any better.

Some errors no map can show by itself: a common factor or sign of all components, a shift of the
whole map, a uniform offset, and a position axis that counts backwards (the map of a mirrored
magnet is as good as that of the magnet).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import asdict, dataclass, replace
from itertools import permutations, product

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import linalg
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.measurement.field_map import points_of
from halbach_fe.measurement.harmonic_field import Charges, HarmonicFit, fit_fields, fit_readings
from halbach_fe.measurement.scan_lines import (
    HELD_OUT_EVERY,
    held_out_lines,
    point_spacing,
    scan_lines,
)
from halbach_fe.study.types import COMPONENTS

FEWEST_POINTS = 30
"""Smallest number of complete readings that are checked."""

MOST_POINTS = 3000
"""Number of points that are fitted at most; of larger maps, whole scan lines are left out."""

ORIENTATION_POINTS = 600
"""Number of points by which orientations are compared."""

GAPS = (1.5, 2.5, 4.0)
"""Distances of the charges from the region that are tried, in units of the points' spacing. In a
bore of 46 mm that was mapped to 18 mm in steps of 5 mm, 1.5 left 0.6 mT of held-out lines and 1.0
left 1.9 mT."""

ALIKE = 30.0
"""Orientations whose log probabilities differ by less cannot be told apart. Errors that the
instrument's parameters leave out are no noise; they shift log probabilities by more than noise."""

WORTH_TRYING = 3.0
"""Orientations are tried with an instrument of their own if their rms residuals without one differ
by less than this factor."""

ITERATIONS, FEW_ITERATIONS, NEXT_ITERATIONS = 12, 6, 2
"""Largest number of steps of the fit of field and instrument, while orientations are tried, and
from a fit of nearly the same readings."""

SPIKE = 12.0
"""A reading is a spike if its residual is larger than this multiple of the standard deviation of
the residuals around it and of all, both from their medians."""

ROUNDING = 1e-13
"""Added to the information of the amplitudes, relative to its mean, so that maps without noise have
positive definite matrices too."""

HALVINGS = 8
"""Number of times that a step is halved until it improves the fit."""

AT_REST = 1.0
"""Decrease of chi-squared below which the fit is at rest, of thousands of readings."""

NEIGHBOURS = 26
"""Number of neighbours of a reading, as many as a point of a grid has."""

ROUGH = 1.8
"""Multiple of the largest residual around a row that is far off a function through its neighbours.
A single spike is 2 to 4 times as far off its own as off theirs."""

ROUGH_ROUNDS = 10
"""Number of times that spikes are looked for among the rows that are left."""

PLAUSIBLE = 4.0
"""Prior standard deviations beyond which no instrument is. Such a fit explains what is no error of
an instrument."""

STEEPER = 100.0
"""Ratio of the squared gradients of nine tenths and one tenth of the readings from which the noise
of positions is told from that of readings."""

DETERMINED = 0.5
"""A parameter is determined if its standard deviation is below this part of its prior one."""

SIGNIFICANT = 4.0
"""Standard deviations from which a parameter is reported as found."""

ENOUGH = 0.2
"""Smallest share of readings beyond those that determine the field. With fewer, a field obeys any
map."""

WINDOWS = 6
"""Number of parts along the longest axis for which the residual is given."""


@dataclass(frozen=True)
class InstrumentTerm:
    """A parameter of the instrument as the map alone shows it.

    Attributes
    ----------
    name, unit : str
        Its unit is mm, mrad, % or mT.
    value, sd : float
        Estimate and standard deviation, in that unit.
    determined : bool
        Whether the map tells more about it than its prior.
    plausible : bool
        Whether an instrument may have that value.
    predictive : bool
        Whether scan lines that are left out are predicted better with it.
    """

    name: str
    unit: str
    value: float
    sd: float
    determined: bool
    plausible: bool
    predictive: bool = True

    @property
    def found(self) -> bool:
        """Whether it differs from 0 with certainty."""
        return self.determined and abs(self.value) > SIGNIFICANT * self.sd


@dataclass(frozen=True)
class MapCheck:
    """What a map shows by itself.

    Attributes
    ----------
    readings, points : int
        Number of components that were measured, and of positions.
    spacing_m : float
        Median distance of neighbouring points.
    size_T : float
        Largest |B|.
    orientation : tuple of str
        The component that each column of the map shows, with its sign, such as ``-z``; a common
        sign of all three is unknown.
    alike : tuple of tuple of str
        Other orientations that fit nearly as well.
    rms_as_given_T, rms_T : ndarray, shape (3,)
        Rms residual of each component without and with orientation and instrument.
    floor_T : ndarray, shape (3,)
        Rms difference of held-out scan lines from the field of all others.
    terms : tuple of InstrumentTerm
    broken : dict of str to list of int
        Numbers of the rows that are zero, repeated or spikes, counted from 1.
    windows : tuple
        Axis, and for each part along it its limits in m and the rms residual in T of each
        component.
    noise_T, position_noise_m : float
        Noise of the readings, and of their positions: the part of the residual that grows with the
        field's gradient.
    structure : float
        Correlation of the residuals of neighbours: 0 for noise, near 1 if a smooth part remains.
    redundancy : float
        Share of the readings that are not used up by the field.
    excluded : ndarray of bool, shape (n,)
        Rows that were not fitted.
    residual_T : ndarray, shape (n, 3)
        Residual in the given columns; NaN where nothing was measured.
    corrected_T : ndarray, shape (n, 3)
        What a probe without errors would have read: Bx, By and Bz at the points of the map, by the
        instrument that the lines show which are not held out.
    """

    readings: int
    points: int
    spacing_m: float
    size_T: float
    orientation: tuple[str, str, str]
    alike: tuple[tuple[str, str, str], ...]
    rms_as_given_T: Floats
    rms_T: Floats
    floor_T: Floats
    terms: tuple[InstrumentTerm, ...]
    broken: dict[str, list[int]]
    windows: tuple[str, tuple[tuple[float, float, tuple[float, float, float]], ...]]
    noise_T: float
    position_noise_m: float
    structure: float
    redundancy: float
    excluded: NDArray[np.bool_]
    residual_T: Floats
    corrected_T: Floats

    @property
    def suffices(self) -> bool:
        """Whether the map has enough readings to tell."""
        return self.redundancy >= ENOUGH

    @property
    def floor_rms_T(self) -> float:  # noqa: N802 - a unit
        """The model-free floor: rms over the components of held-out lines."""
        return float(np.sqrt(np.mean(self.floor_T**2)))

    @property
    def is_reoriented(self) -> bool:
        """Whether the components have other signs or axes than the map says."""
        return self.orientation != COMPONENTS

    def plain(self) -> dict[str, object]:
        """Return the results as plain data for JSON, without the arrays over rows."""
        left_out = ("excluded", "residual_T", "corrected_T")
        return {name: value.tolist() if isinstance(value, np.ndarray) else value
                for name, value in self.__dict__.items()
                if name not in left_out and name != "terms"} | {
            "terms": [asdict(term) | {"found": term.found} for term in self.terms],
            "floor_rms_T": self.floor_rms_T, "suffices": self.suffices}


def check_map(data: xr.Dataset, say: Callable[[str], None] = lambda _: None) -> MapCheck:
    """Check whether a field map obeys Maxwell's equations, without a model of the magnet.

    Parameters
    ----------
    data : Dataset
        The map, see `halbach_fe.read_map`.
    say : callable, optional
        Called with a description of each step before it starts.

    Returns
    -------
    MapCheck

    Raises
    ------
    MeasurementError
        If fewer than `FEWEST_POINTS` points have all three components and are not broken, or if
        they lie on a line.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> from halbach_fe.measurement.field_map import field_map
    >>> axis = 0.01 * np.arange(-2, 3)
    >>> points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    >>> field = points * [1.0, 1.0, -2.0] + [0.1, 0.0, 0.0]  # has no divergence and no curl
    >>> hf.check_map(field_map(points, field)).suffices
    True
    """
    points, field = points_of(data), np.asarray(data["B_T"].values, float)
    broken = _broken_rows(points, field)
    usable = np.isfinite(field).all(axis=1)
    for rows in broken.values():
        usable[np.array(rows, int) - 1] = False
    if usable.sum() < FEWEST_POINTS:
        raise MeasurementError(must_be(
            "map", "Maxwell's check", f"of at least {FEWEST_POINTS} points with all three "
            "components, neither all zero nor repeated", f"{int(usable.sum())}",
            "A line of one component obeys Maxwell's equations whatever it is."))
    if (np.ptp(points[usable], axis=0) > point_spacing(points[usable]) / 2).sum() < 2:
        raise MeasurementError(must_be(
            "map", "Maxwell's check", "of points in a plane or a volume", "points on a line",
            "Along a line any field has div B = 0 and curl B = 0."))
    rough = _rough_rows(points, field, usable)
    usable &= ~rough
    lines = scan_lines(points)
    chosen = usable & _some_lines(lines, usable)
    time = _time(data, len(points))
    say("comparing the orientations of the probe")
    places, readings = points[chosen], field[chosen]
    spacing = point_spacing(places)
    directions = _directions(points, lines)
    held_out = _held_out(lines, chosen)  # nothing that follows sees them, until the floor
    train_rows = chosen & ~held_out
    seen = points[train_rows], field[train_rows], time[train_rows], directions[train_rows]
    matrix, alike = _orientation(*seen, spacing)
    say("fitting the field and the instrument")
    gap, first_fit = _gap(seen[0], seen[1] @ matrix.T, *seen[2:], spacing)
    charges = Charges.around(places, gap)
    turned = field @ matrix.T
    model = _Model(charges, points, turned, time, directions)
    train = _fitted(model, train_rows, first_fit)
    # the prior width of the field, now that the instrument no longer counts as noise
    fit = model.fit(train, train_rows)
    say("asking each change of the instrument to predict scan lines")
    model, train = _confirmed(model, train_rows, _held_out(lines, train_rows), fit, train)
    train = _fitted(model, train_rows, fit, train)
    say("fitting all scan lines")
    whole = _fitted(model, chosen, fit, train)
    spikes = _spikes(points, (turned - model.readings(whole)) / model.expected(whole, chosen),
                     usable)
    if rough.any() or spikes.any():
        broken["spike"] = (1 + np.flatnonzero(rough | spikes)).tolist()
    if spikes.any():
        usable, chosen = usable & ~spikes, chosen & ~spikes
        held_out = _held_out(lines, chosen)
        train = _fitted(model, chosen & ~held_out, fit, train)
        whole = _fitted(model, chosen, fit, train)
    floor = turned[held_out] - model.readings(train, held_out)
    residual = turned - model.readings(whole)
    noise, displaced = _noise(charges.gradient(points[chosen], whole.amplitudes), residual[chosen])
    (as_given,) = fit_fields(charges, places, [readings])
    given = readings - charges.fields(places) @ as_given.amplitudes
    return MapCheck(
        readings=int(np.isfinite(field).sum()), points=len(points), spacing_m=spacing,
        size_T=float(np.linalg.norm(field[usable], axis=1).max()),
        orientation=_named(matrix), alike=alike,
        rms_as_given_T=_rms(given), rms_T=_rms(residual[chosen] @ np.abs(matrix)),
        floor_T=_rms(floor @ np.abs(matrix)), terms=_terms(whole), broken=broken,
        windows=_windows(points[chosen], residual[chosen] @ np.abs(matrix)),
        noise_T=noise, position_noise_m=displaced,
        structure=_structure(points[chosen], residual[chosen]),
        redundancy=1 - whole.used / (3 * int(chosen.sum())), excluded=~usable,
        residual_T=residual @ matrix, corrected_T=model.ideal(train))


def _rms(residual: Floats) -> Floats:
    """Return the rms (3,) of residuals (n, 3)."""
    return np.asarray(np.sqrt(np.mean(residual**2, axis=0)))


def _rough_rows(
    points: Floats, field: Floats, usable: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the rows that are far off a quadratic function through their neighbours.

    A row that is far off spoils the functions of its neighbours, but less than its own. A field
    that is steeper than a quadratic function spoils those of neighbours alike.
    """
    found = np.zeros(len(points), bool)
    for _ in range(ROUGH_ROUNDS):
        rows = np.flatnonzero(usable & ~found)
        near = _neighbours(points[rows])
        residual = np.full_like(field, np.nan)
        for part in np.array_split(np.arange(len(rows)), max(1, len(rows) // 1000)):
            away = points[rows[near[part]]] - points[rows[part], None]
            away /= np.maximum(np.abs(away).max(axis=(1, 2), keepdims=True), 1e-12)
            x, y, z = np.moveaxis(away, 2, 0)
            terms = np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x],
                             axis=2)
            weights = np.linalg.pinv(terms, rcond=1e-6)[:, 0]  # of the value at the row itself
            residual[rows[part]] = field[rows[part]] - np.einsum(
                "nk,nkc->nc", weights, field[rows[near[part]]])
        size = np.linalg.norm(residual[rows], axis=1)
        worst = _spikes(points, residual, usable & ~found, 1.0)
        worst[rows] &= size > ROUGH * size[near].max(axis=1)
        if not worst.any():
            break
        found |= worst
    return found


def _time(data: xr.Dataset, count: int) -> Floats:
    """Return the times (n,) of the readings, from -1 to 1; by their order if there are none."""
    time = np.asarray(data["time_s"].values, float) if "time_s" in data else np.arange(count) * 1.0
    time = np.where(np.isfinite(time), time, np.nanmean(time) if np.isfinite(time).any() else 0.0)
    span = float(np.ptp(time))
    return np.asarray((time - time.min()) / span * 2 - 1 if span else np.zeros(count))


def _held_out(lines: Ints, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of the chosen rows are held out: those of some lines, or of no line at all."""
    found = held_out_lines(lines, HELD_OUT_EVERY) & chosen
    if not found.any():
        found[np.flatnonzero(chosen)[::HELD_OUT_EVERY]] = True
    return np.asarray(found)


def _some_lines(lines: Ints, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return whether a row is in one of the scan lines that are fitted, see `MOST_POINTS`."""
    every = max(1, round(int(usable.sum()) / MOST_POINTS))
    # a step that has no factor with HELD_OUT_EVERY, so that held-out lines remain
    while every > 1 and every % HELD_OUT_EVERY == 0:
        every += 1
    return np.asarray(lines % every == 0)


def _broken_rows(points: Floats, field: Floats) -> dict[str, list[int]]:
    """Return the rows that are zero, or repeat the row before them at another position."""
    zero = (field == 0).all(axis=1)
    repeated = np.zeros(len(field), bool)
    repeated[1:] = (field[1:] == field[:-1]).all(axis=1) & (
        points[1:] != points[:-1]).any(axis=1) & ~zero[1:]
    return {name: (1 + np.flatnonzero(rows)).tolist()
            for name, rows in (("zero", zero), ("repeated", repeated)) if rows.any()}


def _directions(points: Floats, lines: Ints) -> Floats:
    """Return the direction (n, 3) in which the stage moved to every point, 0 at jumps."""
    step = np.diff(points, axis=0, prepend=points[:1])
    size = np.linalg.norm(step, axis=1)
    same = np.diff(lines, prepend=lines[:1]) == 0
    return np.asarray(np.where((same & (size > 0))[:, None],
                               step / np.maximum(size, 1e-12)[:, None], 0.0))


# --- orientation --------------------------------------------------------------------------------


def _orientations() -> list[Floats]:
    """Return the matrices that turn columns into components, with the sign of one column fixed."""
    found = [np.eye(3)[list(order)] * np.array(signs) for order in permutations(range(3))
             for signs in product((1, -1), repeat=3) if signs[0] == 1]
    return sorted(found, key=lambda matrix: -float(np.trace(matrix)))  # as given comes first


def _named(matrix: Floats) -> tuple[str, str, str]:
    """Return the component that each column shows."""
    names = [("-" if column.sum() < 0 else "") + COMPONENTS[int(np.abs(column).argmax())]
             for column in matrix.T]
    return names[0], names[1], names[2]


def _orientation(
    points: Floats, field: Floats, time: Floats, directions: Floats, spacing: float
) -> tuple[Floats, tuple[tuple[str, str, str], ...]]:
    """Return the matrix of the orientation, and others that fit as well.

    If orientations fit about equally well with a perfect instrument, each gets its own instrument.
    The axes are taken as they are given if nothing speaks against them.
    """
    some = np.linspace(0, len(points) - 1, min(len(points), ORIENTATION_POINTS)).astype(int)
    charges = Charges.around(points[some], GAPS[-2] * spacing)
    matrices = _orientations()
    fits = fit_fields(charges, points[some], [field[some] @ matrix.T for matrix in matrices])
    sigma = np.array([fit.sigma for fit in fits])
    left = np.flatnonzero(sigma <= WORTH_TRYING * sigma.min())
    if len(left) == 1:
        return matrices[left[0]], ()
    every, against = np.ones(len(some), bool), {}
    for number in left.tolist():
        model = _Model(charges, points[some], field[some] @ matrices[number].T, time[some],
                       directions[some])
        fitted = _fitted(model, every, fits[number], iterations=FEW_ITERATIONS)
        against[number] = float(3 * len(some) * np.log(fitted.sigma)
                                + fitted.instrument @ fitted.instrument / 2)
    alike = [number for number in against if against[number] <= min(against.values()) + ALIKE]
    best = 0 if 0 in alike else min(alike, key=lambda number: against[number])
    return matrices[best], tuple(_named(matrices[number]) for number in alike if number != best)


def _gap(
    points: Floats, field: Floats, time: Floats, directions: Floats, spacing: float
) -> tuple[float, HarmonicFit]:
    """Return the distance in m of the charges from points (n, 3) in m, and the fit by them.

    The instrument is fitted with the charges that are farthest away, which are fewest.
    """
    every = np.ones(len(points), bool)
    models = {gap: _Model(Charges.around(points, gap * spacing), points, field, time, directions)
              for gap in GAPS}
    (perfect,) = fit_fields(models[GAPS[-1]].charges, points, [field])
    instrument = _fitted(models[GAPS[-1]], every, perfect)
    fitted = {gap: model.fit(instrument, every) for gap, model in models.items()}
    gap = max(fitted, key=lambda each: fitted[each].log_evidence)
    return gap * spacing, fitted[gap]


# --- field and instrument -----------------------------------------------------------------------

WAVES = 4
"""Number of Legendre polynomials of the time by which the probe turns and its gain drifts."""

SENSORS, MIXING = slice(0, 9), slice(9, 18)
TURNS = slice(18, 18 + 3 * WAVES)
OFFSETS = slice(TURNS.stop, TURNS.stop + 3)
GAINS = slice(OFFSETS.stop, OFFSETS.stop + WAVES)
LAG = GAINS.stop
"""Places of the parameters: coordinates of the sensors, elements of the matrix between the axes of
probe and stage, turns, changes of offsets, changes of the gain, and the lag."""

PREDICTS = 1.02
"""Factor by which the error of lines that are left out must grow without a change of the instrument
for it to be kept. Without any drift it changed by -2 % to +1.3 % in four maps of 315 points."""

CHANGING = (GAINS, OFFSETS, TURNS)
"""Parameters that change during the scan."""

PRIOR_SD = (*(3e-3,) * 9, *(0.05,) * 9, *(0.01,) * (3 * WAVES), *(2e-3,) * 3, *(0.01,) * WAVES,
            1e-3)
"""Prior standard deviations: in m, 1, rad, of the largest field, 1, and m."""


@dataclass(frozen=True)
class _Fitted:
    """A field together with an instrument.

    Attributes
    ----------
    amplitudes : ndarray, shape (k,)
    instrument : ndarray, shape (p,)
        In units of `PRIOR_SD`.
    covariance : ndarray, shape (p, p)
    sigma : float, in T
    used : float
        Number of parameters that the readings determine.
    prior_sd : ndarray, shape (p,)
        Prior standard deviations in SI.
    lag : bool
        Whether the stage moved in more than one direction along the lines.
    """

    amplitudes: Floats
    instrument: Floats
    covariance: Floats
    sigma: float
    used: float
    prior_sd: Floats
    lag: bool

    @property
    def sensors_m(self) -> Floats:
        """Places (3, 3) of the sensors relative to their mean."""
        places = (self.instrument * self.prior_sd)[SENSORS].reshape(3, 3)
        return np.asarray(places - places.mean(axis=0))

    @property
    def mixing(self) -> Floats:
        """Matrix (3, 3) that is added to 1: reading c is row c times B.

        Its trace is 0, because a common gain is no error that a map can show.
        """
        matrix = (self.instrument * self.prior_sd)[MIXING].reshape(3, 3)
        return np.asarray(matrix - np.eye(3) * np.trace(matrix) / 3)


class _Model:
    """Readings of a three-axis probe in a harmonic field."""

    def __init__(self, charges: Charges, points: Floats, field: Floats, time: Floats,
                 directions: Floats) -> None:
        self.charges, self.points, self.field = charges, points, field
        self.time, self.directions = time, directions
        self.waves = np.polynomial.legendre.legvander(time, WAVES)[:, 1:]
        sd = np.array(PRIOR_SD)
        sd[OFFSETS] *= float(np.nanmax(np.abs(field)))
        self.prior_sd = sd

    def without(self, group: slice) -> _Model:
        """Return a model whose instrument has none of a group of parameters."""
        other = copy(self)
        other.prior_sd = self.prior_sd.copy()
        other.prior_sd[group] = 0.0
        return other

    def allowed(self, at: _Fitted) -> _Fitted:
        """Return a fit as a start for this model, without the parameters that it has not."""
        return replace(at, instrument=np.where(self.prior_sd > 0, at.instrument, 0.0),
                       prior_sd=self.prior_sd)

    def lag_shows(self, rows: NDArray[np.bool_]) -> bool:
        """Tell whether the stage moved both ways, without which a lag is a shift of the map."""
        return bool(np.ptp(self.directions[rows], axis=0).max() > 1.5)

    def start(self, fit: HarmonicFit) -> _Fitted:
        """Return the fit of a perfect instrument."""
        count = len(PRIOR_SD)
        return _Fitted(fit.amplitudes, np.zeros(count), np.eye(count), fit.sigma, fit.used,
                       self.prior_sd, False)

    def fit(self, at: _Fitted, rows: NDArray[np.bool_]) -> HarmonicFit:
        """Return the fit of the field alone, read by an instrument that is known."""
        design = self.by_amplitude(at, rows).reshape(-1, len(self.charges))
        readings = self.field[rows] - self.offsets(at, rows)
        return fit_readings(design, [readings.ravel()])[0]

    def offsets(self, at: _Fitted, rows: NDArray[np.bool_]) -> Floats:
        """Return the change (n, 3) in T of the sensors' offsets."""
        return np.asarray(self.time[rows, None] * (at.instrument * self.prior_sd)[OFFSETS])

    def _sensor(
        self, at: _Fitted, rows: NDArray[np.bool_], sensor: int
    ) -> tuple[Floats, Floats]:
        """Return the places (n, 3) in m of a sensor and the directions (n, 3) that it reads."""
        value, waves, own = at.instrument * self.prior_sd, self.waves[rows], np.eye(3)[sensor]
        turn, gain = waves @ value[TURNS].reshape(WAVES, 3), waves @ value[GAINS]
        reads = own + at.mixing[sensor] + np.cross(turn, own) + gain[:, None] * own
        return (self.points[rows] + at.sensors_m[sensor] - value[LAG] * self.directions[rows],
                reads)

    def by_amplitude(self, at: _Fitted, rows: NDArray[np.bool_]) -> Floats:
        """Return the readings (n, 3, k) per amplitude."""
        found = np.empty((int(rows.sum()), 3, len(self.charges)))
        for sensor in range(3):
            places, reads = self._sensor(at, rows, sensor)
            found[:, sensor] = self.charges.fields_along(places, reads)
        return found

    def by_parameter(self, at: _Fitted, rows: NDArray[np.bool_]) -> Floats:
        """Return the derivatives (n, 3, p) in T of the readings by the parameters / `PRIOR_SD`."""
        found = np.zeros((int(rows.sum()), 3, len(PRIOR_SD)))
        for sensor in range(3):
            places, reads = self._sensor(at, rows, sensor)
            field = self.charges.field(places, at.amplitudes)
            gradient = np.einsum("nc,ncj->nj", reads,
                                 self.charges.gradient(places, at.amplitudes))
            for other in range(3):  # of the mean of the sensors, which stays where it is
                found[:, sensor, 3 * other:3 * other + 3] = gradient * (
                    (sensor == other) - 1 / 3)
            found[:, sensor, 9 + 3 * sensor:12 + 3 * sensor] = field
            for other in range(3):
                found[:, sensor, 9 + 4 * other] -= field[:, sensor] / 3
            found[:, sensor, TURNS] = np.einsum(
                "nw,na->nwa", self.waves[rows], np.cross(np.eye(3)[sensor], field)
            ).reshape(len(found), -1)
            found[:, sensor, OFFSETS.start + sensor] = self.time[rows]
            found[:, sensor, GAINS] = self.waves[rows] * field[:, sensor, None]
            if at.lag:
                found[:, sensor, LAG] = -np.sum(gradient * self.directions[rows], axis=1)
        return found * self.prior_sd

    def readings(self, at: _Fitted, rows: NDArray[np.bool_] | None = None) -> Floats:
        """Return what the instrument reads (n, 3) in T at some rows, by default at all."""
        chosen = np.flatnonzero(np.ones(len(self.points), bool) if rows is None else rows)
        found = np.empty((len(chosen), 3))
        some = np.zeros(len(self.points), bool)
        some[chosen] = True
        for sensor in range(3):
            places, reads = self._sensor(at, some, sensor)
            found[:, sensor] = np.sum(reads * self.charges.field(places, at.amplitudes), axis=1)
        return np.asarray(found + self.offsets(at, some))

    def expected(self, at: _Fitted, rows: NDArray[np.bool_]) -> Floats:
        """Return the standard deviations (n, 3) in T of all residuals, as those of ``rows`` show.

        Residuals are larger where the field is steep. Those of lines that are not fitted are no
        measure of a single reading: at the edge of the map the field there is extrapolated.
        """
        gradient = self.charges.gradient(self.points, at.amplitudes)
        noise, displaced = _noise(gradient[rows], (self.field - self.readings(at))[rows])
        return np.sqrt(noise**2 + displaced**2 * np.sum(gradient**2, axis=2))

    def ideal(self, at: _Fitted) -> Floats:
        """Return what a probe without errors would have read (n, 3) in T.

        What the fit leaves stays in it, along the axes that the sensors read.
        """
        every = np.ones(len(self.points), bool)
        reads = np.stack([self._sensor(at, every, sensor)[1] for sensor in range(3)], axis=1)
        left = self.field - self.readings(at)
        return self.charges.field(self.points, at.amplitudes) + np.linalg.solve(
            reads, left[..., None])[..., 0]


def _confirmed(
    model: _Model, rows: NDArray[np.bool_], left_out: NDArray[np.bool_], fit: HarmonicFit,
    start: _Fitted,
) -> tuple[_Model, _Fitted]:
    """Return the model without the changes that do not help to predict some of the rows.

    What is left of a field that is steeper than the charges, and positions that are off together
    along a line, is no white noise. Slow functions of time take to it with certainty, and fail
    where they were not fitted.
    """
    def predicted(trial: _Model) -> tuple[float, _Fitted]:
        """Return the rms error in T of the rows that are left out, and the fit of the others."""
        fitted = _fitted(trial, rows & ~left_out, fit, trial.allowed(start), NEXT_ITERATIONS)
        off = model.field[left_out] - trial.readings(fitted, left_out)
        return float(np.linalg.norm(_rms(off))), fitted

    error, start = predicted(model)
    for group in CHANGING:
        trial = model.without(group)
        other, fitted = predicted(trial)
        if other <= error * PREDICTS:
            error, model, start = other, trial, fitted
    return model, start


def _fitted(
    model: _Model, rows: NDArray[np.bool_], fit: HarmonicFit, start: _Fitted | None = None,
    iterations: int = ITERATIONS
) -> _Fitted:
    """Fit field and instrument together by Gauss-Newton steps, each of which improves the fit.

    ``fit`` is that of a perfect instrument, and has the prior width of the amplitudes.
    """
    at = replace(start or model.start(fit), lag=model.lag_shows(rows))
    width2 = fit.sigma**2 / fit.penalty
    state = _State.of(model, at, rows, width2)
    for _ in range(iterations):
        step, covariance, used = state.step()
        for halving in range(HALVINGS):
            after = _State.of(model, replace(
                state.at, instrument=state.at.instrument + step / 2**halving), rows, width2)
            if after.chi2 <= state.chi2:
                break
        else:
            return state.at
        sigma = float(np.sqrt(after.left @ after.left / max(len(after.left) - used, 1.0)))
        at_rest = state.chi2 - after.chi2 < AT_REST
        state = after.with_noise(sigma, replace(
            after.at, covariance=sigma**2 * covariance, used=used))
        if at_rest:
            break
    return state.at


@dataclass(frozen=True)
class _State:
    """The field of largest probability for an instrument and a noise.

    Attributes
    ----------
    at : _Fitted
    chi2 : float
        With the prior of amplitudes and instrument.
    left : ndarray, shape (m,), in T
    by_amplitude : ndarray, shape (m, k)
    information : ndarray, shape (k, k)
        Of the amplitudes, without their prior and in units of 1 / sigma^2.
    projected : ndarray, shape (k,)
        Product of ``by_amplitude`` with the readings.
    factor : tuple
        Cholesky factor of the information with the prior.
    """

    model: _Model
    rows: NDArray[np.bool_]
    width2: float
    at: _Fitted
    chi2: float
    left: Floats
    by_amplitude: Floats
    information: Floats
    projected: Floats
    factor: tuple[Floats, bool]

    @classmethod
    def of(cls, model: _Model, at: _Fitted, rows: NDArray[np.bool_], width2: float) -> _State:
        """Fit the field for the instrument and the noise of ``at``."""
        by_amplitude = model.by_amplitude(at, rows).reshape(-1, len(model.charges))
        target = (model.field[rows] - model.offsets(at, rows)).ravel()
        return cls._solved(model, rows, width2, at, target, by_amplitude,
                           by_amplitude.T @ by_amplitude, by_amplitude.T @ target)

    @classmethod
    def _solved(
        cls, model: _Model, rows: NDArray[np.bool_], width2: float, at: _Fitted, target: Floats,
        by_amplitude: Floats, information: Floats, projected: Floats,
    ) -> _State:
        """Solve for the amplitudes."""
        with_prior = information.copy()
        with_prior[np.diag_indices(len(with_prior))] += (
            at.sigma**2 / width2 + ROUNDING * np.trace(information) / len(information))
        factor = linalg.cho_factor(with_prior, lower=True, overwrite_a=True)
        amplitudes = linalg.cho_solve(factor, projected)
        left = target - by_amplitude @ amplitudes
        chi2 = (float(left @ left) / at.sigma**2 + float(amplitudes @ amplitudes) / width2
                + float(at.instrument @ at.instrument))
        return cls(model, rows, width2, replace(at, amplitudes=amplitudes), chi2, left,
                   by_amplitude, information, projected, factor)

    def with_noise(self, sigma: float, at: _Fitted) -> _State:
        """Return the state of the same instrument for another noise in T."""
        target = self.left + self.by_amplitude @ self.at.amplitudes
        return self._solved(self.model, self.rows, self.width2, replace(at, sigma=sigma), target,
                            self.by_amplitude, self.information, self.projected)

    def step(self) -> tuple[Floats, Floats, float]:
        """Return the step (p,) of the instrument, its covariance / sigma^2, and `_Fitted.used`.

        The amplitudes, which are the best for the present instrument, are eliminated from the
        normal equations.
        """
        noise2, count = self.at.sigma**2, len(PRIOR_SD)
        design = self.model.by_parameter(self.at, self.rows).reshape(-1, count)
        mixed = self.by_amplitude.T @ design
        solved = linalg.cho_solve(self.factor, mixed)
        inverse = np.linalg.inv(design.T @ design - mixed.T @ solved + noise2 * np.eye(count))
        step = inverse @ (design.T @ self.left - noise2 * self.at.instrument)
        # traces of the blocks of the inverse of all normal equations
        amplitudes, info = linalg.lapack.dpotri(self.factor[0], lower=1)
        assert info == 0  # the factor is that of a Cholesky decomposition
        by_amplitude = float(np.trace(amplitudes)) + float(np.sum((solved @ inverse) * solved))
        used = (len(mixed) - noise2 / self.width2 * by_amplitude
                + count - noise2 * float(np.trace(inverse)))
        return step, inverse, used


CHANGES = {"from start to end": {0: 2.0, 2: 2.0},
           "from the ends to the middle": {1: -1.5, 3: -0.625}}
"""Differences of the Legendre polynomials 1 to 4 between times of the scan."""


def _terms(fitted: _Fitted) -> tuple[InstrumentTerm, ...]:
    """Return the parameters of the instrument in the units of people."""
    value, found = fitted.instrument * fitted.prior_sd, []
    scaled = fitted.prior_sd[:, None] * fitted.covariance * fitted.prior_sd

    def add(name: str, unit: str, factor: float, weights: dict[int, float]) -> None:
        row = np.zeros(len(value))
        row[list(weights)] = factor * np.array(list(weights.values()))
        sd = float(np.sqrt(row @ scaled @ row))
        prior = float(np.linalg.norm(row * fitted.prior_sd))
        found.append(InstrumentTerm(name, unit, float(row @ value), sd, sd < DETERMINED * prior,
                                    abs(float(row @ value)) <= PLAUSIBLE * prior, prior > 0))

    for sensor, along in product(range(3), repeat=2):
        add(f"{COMPONENTS[along]} of the B{COMPONENTS[sensor]} sensor from the mean of all", "mm",
            1e3, {3 * other + along: (sensor == other) - 1 / 3 for other in range(3)})
    pairs = [((axis + 1) % 3, (axis + 2) % 3) for axis in range(3)]
    mixed = [(9 + 3 * first + second, 9 + 3 * second + first) for first, second in pairs]
    for axis, (one, other) in zip(COMPONENTS, mixed, strict=True):
        add(f"probe turned about {axis}", "mrad", 1e3, {one: 0.5, other: -0.5})
    for (first, second), (one, other) in zip(pairs, mixed, strict=True):
        add(f"B{COMPONENTS[first]} and B{COMPONENTS[second]} not perpendicular", "mrad", 1e3,
            {one: 1.0, other: 1.0})
    for own in range(3):
        add(f"gain of B{COMPONENTS[own]} over the mean of all", "%", 100.0,
            {9 + 4 * other: (own == other) - 1 / 3 for other in range(3)})
    for (when, weights), own in product(CHANGES.items(), range(3)):
        add(f"turn about {COMPONENTS[own]} {when}", "mrad", 1e3,
            {TURNS.start + 3 * wave + own: weight for wave, weight in weights.items()})
    for own in range(3):
        add(f"change of the offset of B{COMPONENTS[own]} from start to end", "mT", 2e3,
            {OFFSETS.start + own: 1.0})
    for when, weights in CHANGES.items():
        add(f"change of the gain {when}", "%", 100.0,
            {GAINS.start + wave: weight for wave, weight in weights.items()})
    add("lag of the readings behind the stage", "mm", 1e3, {LAG: 1.0})
    return tuple(found)


# --- what remains -------------------------------------------------------------------------------


def _spikes(
    points: Floats, residual: Floats, usable: NDArray[np.bool_], over_neighbours: float = SPIKE
) -> NDArray[np.bool_]:
    """Return the usable rows whose residual (n, 3) is far larger than all, and those around."""
    rows = np.flatnonzero(usable)
    size = np.abs(residual[rows])
    near = _neighbours(points[rows])
    least = 1.4826 * np.maximum(over_neighbours * np.median(size[near], axis=1),
                                SPIKE * np.median(size, axis=0))
    found = np.zeros(len(points), bool)
    found[rows] = (size > least).any(axis=1)
    return found


def _neighbours(points: Floats) -> Ints:
    """Return the numbers (n, k) of the nearest neighbours of points (n, 3).

    Coordinates are rounded, so that which of equally distant points count does not depend on the
    last digits of the file.
    """
    places = np.round(points / point_spacing(points), 6)
    count = min(NEIGHBOURS + 1, len(points))
    return np.asarray(KDTree(places).query(places, np.arange(2, count + 1))[1])


def _windows(
    points: Floats, residual: Floats
) -> tuple[str, tuple[tuple[float, float, tuple[float, float, float]], ...]]:
    """Return the rms residual of each component in parts along the longest axis."""
    axis = int(np.argmax(np.ptp(points, axis=0)))
    edges = np.linspace(points[:, axis].min(), points[:, axis].max(), WINDOWS + 1)
    number = np.clip(np.searchsorted(edges, points[:, axis], side="right") - 1, 0, WINDOWS - 1)
    found = []
    for window in range(WINDOWS):
        if (number == window).any():
            x, y, z = _rms(residual[number == window]).tolist()
            found.append((float(edges[window]), float(edges[window + 1]), (x, y, z)))
    return COMPONENTS[axis], tuple(found)


def _noise(gradient: Floats, residual: Floats) -> tuple[float, float]:
    """Return the noise in T of readings and in m of positions that residuals (n, 3) show.

    A position noise s makes an error of s |grad B_c| in component c, for a gradient (n, 3, 3). It
    is 0 if the gradient is about the same everywhere, so that nothing tells the two noises apart.
    """
    steepness = np.sum(gradient**2, axis=2).ravel()
    flat, steep = np.quantile(steepness, [0.1, 0.9])
    squares = residual.ravel()**2
    if steep < STEEPER * flat:
        return float(np.sqrt(squares.mean())), 0.0
    constant = float(squares[steepness <= flat].mean())
    return np.sqrt(constant), np.sqrt(max(squares.mean() - constant, 0.0) / steepness.mean())


def _structure(points: Floats, residual: Floats) -> float:
    """Return the correlation of the residuals (n, 3) of nearest neighbours."""
    nearest = KDTree(points).query(points, 2)[1][:, 1]
    total = float(np.sum(residual**2))
    return float(np.sum(residual * residual[nearest]) / total) if total else 0.0
