"""Maxwell's check of a field map: div B = 0, curl B = 0, and the instrument that this takes.

The map is fitted by a field of sources outside the mapped region (`halbach_fe.measurement.
source_free_field`), of which no magnet is assumed. An instrument that exchanges axes, reverses
signs, has its three sensors in three places or turns during the scan makes a map that no such field
has; its parameters are fitted together with the field. What remains is the model-free floor: no
model of a magnet explains the map any better, except within a spacing of the points from edges of
magnets, where the sources outside follow the field less well.

Some errors no map can show by itself: a common factor or sign of all components, a shift of the
whole map, a uniform offset, and a position axis that counts backwards (the map of a mirrored
magnet is as good as that of the magnet).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, permutations, product
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Floats, Ints, rms, spread
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.interface import ShownInNotebook, typed
from halbach_fe.core.numbers import MAD_TO_SD, in_a_row
from halbach_fe.core.progress import Pace, Progress
from halbach_fe.measurement.doubted_terms import doubted_from
from halbach_fe.measurement.field_map import (
    check_magnitudes,
    checked_map,
    has_times,
    points_of,
    refuse_total_field,
    refuse_undirected,
    warn_of_millimetres,
)
from halbach_fe.measurement.positions import (
    HELD_OUT_EVERY,
    held_out_lines,
    motion,
    point_spacing,
    scan_lines,
)
from halbach_fe.measurement.probe_fit import (
    COARSE_WAVES,
    FEW_ITERATIONS,
    GAINS,
    LAG,
    MATRICES,
    MIXING,
    OFFSETS,
    PAIRS,
    SCALES,
    TURNS,
    WAVES,
    Evidence,
    ProbeFit,
    ProbeModel,
    fit_probe,
    scatter_of,
)
from halbach_fe.measurement.source_free_field import NO_FIT, Charges, HarmonicFit, spacing_of
from halbach_fe.measurement.suspect_rows import (
    at_border,
    broken_rows,
    contradicted_rows,
    neighbours,
    quadratic_residual,
    rough_rows,
    scatter_around,
    spikes,
    stands_out,
)
from halbach_fe.study.types import COMPONENTS

FEWEST_POINTS = 30
"""Smallest number of complete readings that are checked."""

MOST_POINTS = 3000
"""Number of points that are fitted at most; of larger maps, whole scan lines are left out."""

SOME_POINTS = 600
"""Number of points by which orientations are compared, and with which the first fit is made."""

GAPS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
"""Distances of the charges from the region that are tried, in units of the points' spacing. The
last one is tried always, the others if the charges are near each other, see `TOO_FAR_APART`."""

MIDDLING = 2.5
"""That of the charges by which orientations are compared."""

FIRST_FIT_PARTS = 3 * (len(GAPS) + 1)
"""Parts of the first fit, for the time left: all fits by charges at some distance take about as
long as the search of combinations of charges, and as the fit with an instrument."""

TOO_FAR_APART = 0.8
"""Distance of charges from each other, relative to that from the region, from which their field is
rough. In a bore of 46 mm that was mapped to 18 mm in steps of 5 mm, 5.5 mm at a distance of 7.5 mm
left 0.6 mT of held-out lines, and 5.5 mm at 5 mm 1.9 mT."""

WEIGHTINGS = 2
"""Number of times that the readings are weighted anew, after the first. In six maps with sensors
millimetres apart, the largest of nine errors of their places was 5 to 19 standard deviations with
the first weights, 3.3 with these, and 3.3 with more."""

ROUNDS = 2
"""Number of times that parameters are chosen: weights and linearization are those of the choice
before."""

NOT_FOLLOWED = 1.5
"""Ratio of the scatter of a tenth of the readings to that of most from which charges do not follow
the field there. Noise that is the same everywhere makes it 1.2."""

CUT_BACK = (0.85, 0.7)
"""Shares of the readings that are asked again for the instrument, where the field is least rough.
In three maps near cubes and coils by magpylib in which the whole did not tell of a turn of 20 mrad
or a drift of 2 %, both did, with bars 4 to 16 times as short; in three others one alone showed
terms that were not there."""

MOST_UNSTEADY = 3
"""Number of parameters that are left out at most because the fit with them contradicts them; after
three of the measured map of an MRI magnet it contradicted none."""

SHOWN = 3.0
"""Standard deviations from which another region of a map shows what is found in one. With those of
`SIGNIFICANT`, 29 of 40 errors of probes near blocks and coils were found, with these 31."""

SEEN = 2.0
"""Standard deviations of a part from which it can tell whether a parameter is there."""

ALIKE_PARTS, PARTS_OF_A_CHANGE = (0.5, 1.5), (0.25, 4.0)
"""Share of a parameter that a part of the map shows at least and at most, if its bar does not allow
more; and that of a change during the scan, which need not be even. Of a turn by -27 mrad, on the
measured map of an MRI magnet, the first half of the scan by itself showed 0.47."""

ALIKE = 30.0
"""Orientations whose log probabilities differ by less cannot be told apart. Errors that the
instrument's parameters leave out are no noise; they shift log probabilities by more than noise."""

WORTH_TRYING = 3.0
"""Orientations are tried with an instrument of their own, and poses in a magnet improved, if their
rms residuals without that differ by less than this factor."""

ALMOST_ALIKE = float(np.log(20.0))
"""Log odds within which one parameter may as well be another, as for causes in the diagnosis."""

SIGNIFICANT = 4.0
"""Standard deviations from which a parameter is reported as found."""

DETERMINED = 0.5
"""Part of its prior standard deviation below which that of a parameter must be to be determined."""

ENOUGH = 0.2
"""Smallest share of readings beyond those that determine the field. With fewer, a field obeys any
map."""

VIOLATED = 0.02
"""A map whose floor is above this share of the largest field does not obey Maxwell's equations."""

ALTERNATES = -0.3
"""Correlation of neighbouring residuals below which they change sign from point to point: the field
varies more than the spacing shows. Of a field with a curl or of shuffled lines it is positive or
near 0."""

FAR_OFF = 5.0
"""Times the noise from which held-out lines are far off: charges follow the field badly there, or
the map is wrong. It was 1.1 to 2.9 in four maps by magpylib that end some spacings from magnets,
and 16 to 36 in the outer lines of three maps in steps of 20 mm that end 30 mm from magnets."""

SAME_M = 2e-6
"""Difference of places that are the same: points of a ring differ by rounding."""

UNEVEN = 2.0
"""Ratio of the largest to the smallest rms residual of those parts from which the residual is not
that of a noise which is the same everywhere. Fits take more of the noise along at the ends of a
map: maps with such a noise had ratios of 1.3 to 1.7, maps whose field the fit cannot follow in the
middle 2.9 to 7."""

SCATTERED_M = 1e-6
"""Noise of positions from which it is stated. It makes residuals that differ between the parts."""


@dataclass(frozen=True)
class InstrumentTerm:
    """A parameter of the instrument as the map alone shows it."""

    name: str
    unit: str
    """Its unit is mm, mrad, % or mT."""
    value: float
    sd: float
    """Estimate and standard deviation, in that unit."""
    determined: bool
    """Whether the map tells more about it than its prior."""
    plausible: bool
    """Whether an instrument may have that value, see `halbach_fe.measurement.doubted_terms`."""
    predictive: bool = True
    """Whether no part of the map contradicts the others about it, see `_shown`."""
    rivals: tuple[str, ...] = ()
    """Other parameters of which each by itself explains the map as well: one of all these is off,
    and the map does not tell which."""
    likes_sd: float = 0.0
    """Part of ``sd`` by others that change many maps nearly alike, see `_beside_likes`. It is the
    same in all maps of one probe and stage."""
    beaten: tuple[str, ...] = ()
    """Such others that would be found in its place, but explain the map less well."""

    @property
    def found(self) -> bool:
        """Whether it differs from 0 with certainty."""
        return (self.determined and self.plausible and self.predictive
                and abs(self.value) > SIGNIFICANT * self.sd)

    @property
    def own_sd(self) -> float:
        """Standard deviation if none of those others is off."""
        return float(np.sqrt(max(0.0, self.sd**2 - self.likes_sd**2)))

    @property
    def is_chosen(self) -> bool:
        """Whether it is what explains the map best, however well its value is told."""
        return self.found or bool(
            self.likes_sd and self.plausible and self.predictive
            and abs(self.value) > SIGNIFICANT * self.own_sd)


@dataclass(frozen=True)
class Reach:
    """The region of a map in which held-out scan lines are predicted to about their noise."""

    along: str
    """What limits it: x, y or z, or "r", the distance from the line through the middle of the map
    along its longest axis."""
    below: bool
    """Whether it is what is below the limit."""
    limit_m: float
    """Coordinate or distance of the farthest held-out readings in it; NaN if no region is."""
    inside_T: float
    beyond_T: float
    """Rms difference of held-out lines from the field of all others in and beyond it."""
    noise_T: float
    """Noise with which they are compared."""

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell whether points (n, 3) in m, which span the map, are in it."""
        place = (distance_from_middle(points, points) if self.along == "r"
                 else points[:, COMPONENTS.index(self.along)])
        inside = place <= self.limit_m + SAME_M if self.below else place >= self.limit_m - SAME_M
        return np.asarray(inside)

    @property
    def times(self) -> float:
        """How many times the noise the readings beyond it are off."""
        return self.beyond_T / self.noise_T


@dataclass(frozen=True)
class MapCheck(ShownInNotebook):
    """What a map shows by itself.

    Attributes
    ----------
    data : Dataset
        The map.
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
    position_noise_sd_m, position_noise_at_most : float and bool
        Standard deviation of the latter, and whether it is an upper limit only, as what is left
        grows faster with the gradient than positions explain.
    reach : Reach or None
        Where held-out lines are predicted; None if all are within `FAR_OFF` times the noise.
    structure : float
        Correlation of the residuals of neighbours: 0 for noise, near 1 if a smooth part remains.
    redundancy : float
        Share of the readings that are not used up by the field.
    excluded : ndarray of bool, shape (n,)
        Rows that were not fitted.
    residual_T : ndarray, shape (n, 3)
        Residual in the given columns; NaN where nothing was measured.
    unseen_T : ndarray, shape (n, 3)
        Difference of held-out scan lines from the field of all others, in the given columns; NaN in
        other rows.
    corrected_T : ndarray, shape (n, 3)
        What a probe without errors would have read: Bx, By and Bz at the points of the map, by the
        instrument that the lines show which are not held out.
    contradicted : tuple of int
        Numbers of the rows whose column of |B| is not that of their components, from 1.
    gap_m : float
        Distance of the charges from where the field was read, by the evidence of the readings.
    order : str
        What tells when each reading was taken: ``time_s``, the ``rows`` as they follow each other,
        or ``none``, if the map has no times and no stage goes from row to row.
    """

    data: xr.Dataset
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
    reach: Reach | None
    structure: float
    redundancy: float
    excluded: NDArray[np.bool_]
    residual_T: Floats
    unseen_T: Floats
    corrected_T: Floats
    position_noise_sd_m: float = 0.0
    position_noise_at_most: bool = False
    contradicted: tuple[int, ...] = ()
    gap_m: float = 0.0
    order: str = "rows"

    @property
    def measured(self) -> str:
        """The components that the map has, such as "Bx and By"."""
        return in_a_row([f"B{name}" for name, rms in zip(COMPONENTS, self.rms_T, strict=True)
                         if np.isfinite(rms)])

    @property
    def is_whole(self) -> bool:
        """Whether the map has all components."""
        return bool(np.isfinite(self.rms_T).all())

    @property
    def noise_is_limit(self) -> bool:
        """Whether the noise may be smaller than what the fit leaves.

        So it is where the fit follows the field by many parameters for its readings: where it
        follows the field no better, the rest is taken for noise.
        """
        # Seven times the noise was left on a grid of 20 mm in a ring of cubes, with a redundancy of
        # 0.76; maps of which the noise is known to some per cent have 0.85 and more.
        clear = 0.8
        return self.position_noise_at_most or not self.is_whole or self.redundancy < clear

    @property
    def suffices(self) -> bool:
        """Whether the map has enough readings to tell, and near enough to each other."""
        return bool(self.redundancy >= ENOUGH and not self.is_too_coarse)

    @property
    def is_too_coarse(self) -> bool:
        """Whether held-out lines are far off, but not as of a field with sources: what is left
        changes sign from point to point, or a field without sources describes all readings.
        """
        limit_T = VIOLATED * self.size_T
        alternates = self.structure < ALTERNATES and self.floor_rms_T > limit_T
        return bool(alternates or (not self.obeys and np.nanmean(
            self.rms_T**2) <= self.redundancy * limit_T**2))

    @property
    def left_T(self) -> float:  # noqa: N802 - a unit
        """Rms of what a field without sources leaves of all readings, for each that tests it."""
        return float(np.sqrt(np.nanmean(self.rms_T**2) / self.redundancy))

    @property
    def floor_rms_T(self) -> float:  # noqa: N802 - a unit
        """The model-free floor: rms over the components of held-out lines."""
        return float(np.sqrt(np.nanmean(self.floor_T**2)))

    @property
    def obeys(self) -> bool:
        """Whether the field that is left is small, everywhere or in the region of `reach`."""
        if self.reach is not None and np.isfinite(self.reach.limit_m):
            return self.reach.inside_T <= VIOLATED * self.size_T
        return self.floor_rms_T <= VIOLATED * self.size_T

    @property
    def uneven(self) -> tuple[tuple[float, float, float], tuple[float, float, float]] | None:
        """The parts with the least and with the most residual, if these are not of one noise.

        Each has its limits in m and its rms in T over the components. It is None if noise that is
        the same everywhere, or positions that scatter, explain how the parts differ.
        """
        parts = [(low, high, float(np.sqrt(np.nanmean(np.square(each)))))
                 for low, high, each in self.windows[1]]
        least, most = (pick(parts, key=lambda one: one[2], default=(0.0, 0.0, 0.0))
                       for pick in (min, max))
        differs = most[2] > UNEVEN * least[2] and self.position_noise_m < SCATTERED_M
        return (least, most) if differs else None

    @property
    def is_displaced(self) -> bool:
        """Whether readings scatter as if positions were farther off than those of any stage."""
        # Noise of positions, in units of the spacing of the points, from which it is none: a stage
        # whose readings are that far from where it says does not place them.
        no_stage = 0.2
        return not self.position_noise_at_most and (
            self.position_noise_m > no_stage * self.spacing_m)

    @property
    def is_reoriented(self) -> bool:
        """Whether the components have other signs or axes than the map says."""
        return self.orientation != COMPONENTS

    def plain(self) -> dict[str, object]:
        """Return the results as plain data for JSON, without the arrays over rows."""
        left_out = ("data", "excluded", "residual_T", "unseen_T", "corrected_T", "gap_m")
        plain = {name: value.tolist() if isinstance(value, np.ndarray) else value
                 for name, value in self.__dict__.items()
                 if name not in left_out and name not in ("terms", "reach")}
        return {name: _finite(value) for name, value in plain.items()} | {
            "terms": [asdict(term) | {"found": term.found} for term in self.terms],
            "reach": None if self.reach is None else {
                name: _finite(value) for name, value in asdict(self.reach).items()},
            "floor_rms_T": self.floor_rms_T, "suffices": self.suffices}


def _finite(value: object) -> object:
    """Return plain data with None for NaN, which JSON does not have."""
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if value != value else value


@typed
def check_map(
    data: xr.Dataset, say: Callable[[str], None] = lambda _: None,
    progress: Progress | None = None,
) -> MapCheck:
    """Check whether a field map obeys Maxwell's equations, without a model of the magnet.

    Parameters
    ----------
    data : Dataset
        The map, see `halbach_fe.read_map`.
    say : callable, optional
        Called with a description of each step before it starts, and now and then with the time
        left of a step that takes long.
    progress : callable, optional
        Called with the numbers of finished and of all parts of a step.

    Returns
    -------
    MapCheck

    Raises
    ------
    MeasurementError
        If fewer than `FEWEST_POINTS` points have all components of the map and are not broken, if
        they lie on a line or circle, or if the map holds what none does in m and T.

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
    given, data = data, _checkable(data)
    pace = Pace(say, progress)
    _begin(pace, 1, "looking for rows that are no readings")
    scan, usable, broken = scan_of(data, pace)
    lines = scan_lines(scan.points)
    rows = _Rows(lines, usable, usable & some_lines(lines, usable))
    _begin(pace, 2, "comparing the orientations of the probe")
    some = _thinned(scan.of(rows.train))
    matrix, alike = _orientation(some, pace)
    _begin(pace, 3, "fitting the field and the instrument")
    matrix, alike, placed = _confirmed(matrix, alike, scan.of(rows.few), some, pace)
    fitted = _first_fit(scan.turned(matrix), placed, rows, pace)
    _begin(pace, 4, "asking every part of the map for each error of the instrument")
    fitted, terms = _instrument_of_map(fitted, scan, rows.train, pace)
    terms = _beside_likes(fitted, terms)
    _begin(pace, 5, "fitting all scan lines")
    whole, fitted, rows = _without_spikes(fitted, rows, broken)
    return MapCheck(
        data=given, readings=int(np.isfinite(scan.field).sum()), points=len(usable),
        spacing_m=point_spacing(scan.points[rows.chosen]),
        size_T=float(np.linalg.norm(fitted.model.field[rows.usable], axis=1).max()),
        order=_order(data),
        orientation=_named(matrix), alike=alike, terms=terms, broken=broken,
        excluded=~rows.usable, contradicted=contradicted_rows(data),
        corrected_T=fitted.model.ideal(_without_open_terms(fitted, terms)), gap_m=placed.gap_m,
        **_remaining(fitted, whole, scan, matrix, rows))


def oriented(check: MapCheck) -> xr.Dataset:
    """Return the map without broken rows, with its columns along the axes that they belong to."""
    kept = check.data.isel(point=np.flatnonzero(~check.excluded))
    turned = kept.copy(deep=True)
    for column, name in enumerate(check.orientation):
        axis, sign = COMPONENTS.index(name[-1]), -1.0 if name.startswith("-") else 1.0
        turned["B_T"][:, axis] = sign * kept["B_T"].values[:, column]
        if "sigma_T" in kept:
            turned["sigma_T"][:, axis] = kept["sigma_T"].values[:, column]
    return turned


def inner(check: MapCheck) -> xr.Dataset | None:
    """Return the oriented map in the region that a field without sources describes, if not all."""
    if check.reach is None or not np.isfinite(check.reach.limit_m):
        return None
    return oriented(check).isel(point=np.flatnonzero(
        check.reach.holds(points_of(check.data))[~check.excluded]))


def _remaining(
    fitted: _Fitted, whole: _Fitted, scan: Scan, matrix: Floats, rows: _Rows
) -> dict[str, Any]:
    """Return what `MapCheck` has of residuals.

    ``fitted`` is the fit of the rows that are not held out, ``whole`` that of all that are chosen,
    ``matrix`` (3, 3) turns the columns of the map.
    """
    # Smallest share of a reading's noise variance that its residual counts to have: where the field
    # takes nearly all of it along, what is left tells of the field.
    least_left = 0.05
    model, points, chosen, held_out = whole.model, whole.model.points, rows.chosen, rows.held_out
    floor = model.field[held_out] - model.readings(fitted.at, held_out)
    unseen = np.full(scan.field.shape, np.nan)
    unseen[held_out] = model.columns(floor)
    residual, sensors = whole.left, model.sensors
    # a fit takes its part of the noise along, the most at the edges of a map
    left = residual[chosen] / np.sqrt(np.maximum(
        model.noise_left(whole.at, chosen, whole.width2), least_left))
    scatter = scatter_of(
        model.charges.gradient(points[chosen], whole.at.amplitudes)[:, sensors], left)
    given, even = scan.field[chosen][:, sensors], model.even()
    fields = even.free(even.start(NO_FIT), chosen, 0.0)
    as_given = fields.most_probable(given.ravel())

    def by_column(values: Floats) -> Floats:
        """Return the size of what sensors show, in the columns of the map."""
        return _turned(np.abs(model.columns(values)), np.abs(matrix).T)

    return {
        "rms_as_given_T": _rms(model.columns(given - (
            fields.by_amplitude @ as_given.amplitudes).reshape(given.shape))),
        "rms_T": _rms(by_column(residual[chosen])), "floor_T": _rms(by_column(floor)),
        "windows": _windows(points[chosen], by_column(residual[chosen])),
        "noise_T": scatter.noise_T, "position_noise_m": scatter.position_m,
        "position_noise_sd_m": scatter.position_sd_m, "position_noise_at_most": scatter.at_most,
        "structure": _structure(points[chosen], (residual * model.weights)[chosen]),
        "reach": _reach(points[held_out], floor, points[chosen],
                        float(MAD_TO_SD * np.median(np.abs(left)))),
        "redundancy": 1 - whole.at.used / given.size,
        "residual_T": _turned(model.columns(residual), matrix.T),
        "unseen_T": _turned(unseen, matrix.T)}


def _turned(values: Floats, matrix: Floats) -> Floats:
    """Return vectors (n, 3) turned by a matrix (3, 3); empty columns stay if it is 1."""
    return values if np.array_equal(matrix, np.eye(3)) else np.asarray(values @ matrix.T)


def _begin(pace: Pace, step: int, what: str) -> None:
    """Say which step begins."""
    pace.say(f"step {step} of 5: {what}")
    pace.begin(f"step {step} of 5")


def _rms(residual: Floats) -> Floats:
    """Return the rms (3,) of residuals (n, 3)."""
    return np.asarray(np.sqrt(np.mean(residual**2, axis=0)))


def _order(data: xr.Dataset) -> str:
    """Return what tells when each reading was taken, see `MapCheck.order`."""
    return "time_s" if has_times(data) else order_of(data)


def order_of(data: xr.Dataset) -> str:
    """Return "rows" if the rows go the way of a stage, or "none".

    A stage goes along lines or circles, or on short ways. In maps in a random order, or sorted by
    their readings, 1 to 24 % of the rows were on lines, and in scans 80 to 99 %; the next row was
    as far as any other, and in scans a third to a sixth of that.
    """
    points = points_of(data)
    if len(points) < 2:
        return "rows"
    step = np.median(np.linalg.norm(np.diff(points, axis=0), axis=1))
    to_any_other = np.sqrt(2 * np.sum(np.var(points, axis=0)))
    on_lines = np.mean(motion(points).any(axis=1))
    return "rows" if on_lines >= 1 / 2 or step <= to_any_other / 2 else "none"


def _time(data: xr.Dataset, count: int) -> Floats:
    """Return the times (n,) of the readings, from -1 to 1; 0 if nothing tells their order."""
    order = _order(data)
    if order == "none":
        return np.zeros(count)
    time = np.asarray(data["time_s"].values, float) if order == "time_s" else np.arange(count) * 1.0
    time = np.where(np.isfinite(time), time, np.nanmean(time) if np.isfinite(time).any() else 0.0)
    span = float(np.ptp(time))
    return np.asarray((time - time.min()) / span * 2 - 1 if span else np.zeros(count))


def _held_out(lines: Ints, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of the chosen rows are held out: those of some lines, or of no line at all."""
    found = held_out_lines(lines, HELD_OUT_EVERY) & chosen
    if not found.any():
        found[np.flatnonzero(chosen)[::HELD_OUT_EVERY]] = True
    return np.asarray(found)


def some_lines(
    lines: Ints, usable: NDArray[np.bool_], most: int = MOST_POINTS
) -> NDArray[np.bool_]:
    """Return whether a row is in one of the scan lines that are fitted, of ``most`` rows."""
    every = max(1, round(int(usable.sum()) / most))
    # a step that has no factor with HELD_OUT_EVERY, so that held-out lines remain
    while every > 1 and every % HELD_OUT_EVERY == 0:
        every += 1
    return np.asarray(lines % every == 0)


# --- what is fitted -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Scan:
    """Readings (n, 3) in T at points (n, 3) in m.

    ``scatter`` (n,) in T is by how much readings around are off functions through neighbours,
    ``directions`` (n, 3) are those along which the stage came, ``time`` (n,) is from -1 to 1.
    """

    points: Floats
    field: Floats
    time: Floats
    directions: Floats
    scatter: Floats

    def of(self, rows: NDArray[np.bool_] | Ints) -> Scan:
        """Return some of the rows."""
        return Scan(*(values[rows] for values in self.__dict__.values()))

    def turned(self, matrix: Floats) -> Scan:
        """Return the components that a matrix (3, 3) makes of the columns."""
        return replace(self, field=_turned(self.field, matrix))

    def model(self, charges: Charges) -> ProbeModel:
        """Return the model of the readings."""
        return ProbeModel(charges, *self.__dict__.values())


@dataclass(frozen=True)
class _Fitted:
    """A model, its fit, and the fit of the field alone that has the width of its prior."""

    model: ProbeModel
    at: ProbeFit
    fit: HarmonicFit

    @property
    def width2(self) -> float:
        """Prior variance of the amplitudes in T^2."""
        return self.fit.sigma**2 / self.fit.penalty

    def weighted(self, rows: NDArray[np.bool_]) -> _Fitted:
        """Return the fit of some rows that are weighted anew."""
        fitted = self
        for number in range(WEIGHTINGS):
            model, fit = fitted.model.weighted(fitted.at, rows, fitted.width2), fitted.fit
            if not number:  # the width of the prior, now that the instrument is no noise
                fit = model.fit(fitted.at, rows)
            fitted = _Fitted(model, fit_probe(model, rows, fit, fitted.at, FEW_ITERATIONS), fit)
        return fitted

    def by(self, rows: NDArray[np.bool_]) -> _Fitted:
        """Return the fit of other rows."""
        return replace(self, at=fit_probe(self.model, rows, self.fit, self.at, FEW_ITERATIONS))

    @property
    def left(self) -> Floats:
        """What the fit leaves of all readings (n, 3) in T."""
        return np.asarray(self.model.field - self.model.readings(self.at))

    def only(self, kept: NDArray[np.bool_], rows: NDArray[np.bool_]) -> _Fitted:
        """Return the fit of some rows by an instrument that has some of the parameters (p,)."""
        model = self.model.with_terms(kept)
        return replace(self, model=model, at=model.allowed(self.at)).by(rows)


@dataclass(frozen=True)
class _Rows:
    """The scan line (n,) of every row, and whether it is usable, and chosen to be fitted."""

    lines: Ints
    usable: NDArray[np.bool_]
    chosen: NDArray[np.bool_]

    @property
    def held_out(self) -> NDArray[np.bool_]:
        """Chosen rows that nothing sees until the floor."""
        return _held_out(self.lines, self.chosen)

    @property
    def train(self) -> NDArray[np.bool_]:
        """Chosen rows that are not held out."""
        return self.chosen & ~self.held_out

    @property
    def few(self) -> NDArray[np.bool_]:
        """The rows of some of these lines, about `SOME_POINTS`."""
        found = self.train
        number = np.unique(self.lines[found], return_inverse=True)[1].ravel()
        found[found] = some_lines(number, np.ones(len(number), bool), SOME_POINTS)
        return found


def _first_fit(scan: Scan, placed: _Placed, rows: _Rows, pace: Pace) -> _Fitted:
    """Return the fit of the field and of all parameters of the instrument to a few lines.

    The combinations of charges are those that all chosen rows determine.
    """
    few, probe = rows.few, placed.probe
    # around all rows, of which those that are not fitted are read too
    charges = Charges.around(probe.read_at(scan.points[rows.usable]), placed.gap_m)
    model = scan.model(charges)
    start = replace(model.start(NO_FIT), instrument=probe.instrument)
    model = model.few(start, rows.chosen, placed.fit.penalty)
    pace.advance(2 * FIRST_FIT_PARTS // 3, FIRST_FIT_PARTS)
    fit = model.fit(start, few)
    start = replace(start, amplitudes=fit.amplitudes, sigma=fit.sigma)
    fitted = _Fitted(model, fit_probe(model, few, fit, start), fit).weighted(few)
    pace.advance(FIRST_FIT_PARTS, FIRST_FIT_PARTS)
    return fitted


def _without_spikes(
    fitted: _Fitted, rows: _Rows, broken: dict[str, list[int]]
) -> tuple[_Fitted, _Fitted, _Rows]:
    """Return the fits of all chosen rows and of those that are not held out, and the rows.

    Spikes among the rows are added to ``broken`` and left out. At the border of a map near a magnet
    a row that is far off is none where it is not fitted but extrapolated, and where another one
    is nearly as far off at which the field is as steep: the field is what was not fitted there, as
    at three corners 6 mm from edges of magnets.
    """
    whole = fitted.by(rows.chosen)
    points, left = whole.model.points, whole.left / whole.model.scatter[:, None]
    border = np.zeros(len(points), bool)
    border[rows.usable] = at_border(points[rows.usable], neighbours(points[rows.usable]))
    spike = (rows.chosen | ~border) & spikes(points, left, rows.usable)
    steepness = np.linalg.norm(
        whole.model.charges.gradient(points, whole.at.amplitudes), axis=(1, 2))
    spike[border] &= stands_out(np.linalg.norm(left[border], axis=1), steepness[border])
    if not spike.any():
        return whole, fitted, rows
    broken["spike"] = sorted([*broken.get("spike", ()), *(1 + np.flatnonzero(spike)).tolist()])
    rows = _Rows(rows.lines, rows.usable & ~spike, rows.chosen & ~spike)
    fitted = fitted.weighted(rows.train)  # the spikes took part in the weights
    return fitted.by(rows.chosen), fitted, rows


def _checkable(data: xr.Dataset) -> xr.Dataset:
    """Return the map as it is checked; MeasurementError if it holds what no map does."""
    data = checked_map(data, "`data`")
    refuse_undirected(data)
    refuse_total_field(data, "Maxwell's check")
    check_magnitudes(data)
    warn_of_millimetres(data)
    return data


def _where(data: xr.Dataset) -> str:
    """Return how error messages call the map."""
    return f"map {data.encoding['source']}" if "source" in data.encoding else "map"


def _is_curve(points: Floats) -> bool:
    """Tell whether points (n, 3) lie on one line or circle, to a quarter of their spacing.

    On these alone two equations hold that are linear in x, y, z and x^2 + y^2 + z^2.
    """
    placed = points - points.mean(axis=0)
    square = np.sum(placed**2, axis=1)
    size = float(np.sqrt(square.max()))
    lifted = np.column_stack([placed, (square - square.mean()) / size]) / np.sqrt(len(points))
    return bool(np.linalg.svd(lifted, compute_uv=False)[2] < point_spacing(points) / 4)


def scan_of(
    data: xr.Dataset, pace: Pace | None = None
) -> tuple[Scan, NDArray[np.bool_], dict[str, list[int]]]:
    """Return the readings, which of them are usable, and the rows that are broken.

    MeasurementError if too few are usable, see `check_map`.
    """
    # Largest field of a map that is no measurement: SQUIDs resolve it, no probe of a magnet does.
    smallest_field_t = 1e-12
    points, field = points_of(data), np.array(data["B_T"].values, float)
    measured = np.isfinite(field).any(axis=0)
    time = _time(data, len(points))
    order = np.argsort(time, kind="stable")  # rows that have times may be sorted otherwise
    broken = {kind: sorted((1 + order[np.array(rows) - 1]).tolist()) for kind, rows in broken_rows(
        points[order], field[order][:, measured]).items()}
    usable = np.isfinite(field[:, measured]).all(axis=1)
    for rows in (*broken.values(), contradicted_rows(data)):
        usable[np.array(rows, int) - 1] = False
    if usable.sum() < FEWEST_POINTS:
        raise MeasurementError(must_be(
            _where(data), "Maxwell's check", f"of at least {FEWEST_POINTS} points with all its "
            "components, neither all zero nor repeated", f"{int(usable.sum())}",
            "A line of one component obeys Maxwell's equations whatever it is."))
    if _is_curve(points[usable]):
        raise MeasurementError(must_be(
            _where(data), "Maxwell's check", "of points in a plane or a volume",
            "points on a line or circle",
            "Along one curve a field with div B = 0 and curl B = 0 follows any readings."))
    if np.nanmax(np.abs(field[usable])) < smallest_field_t:
        raise MeasurementError(must_be(
            _where(data), "Maxwell's check", f"of a field of at least {smallest_field_t:g} T "
            "somewhere", f"{np.nanmax(np.abs(field[usable])):.3g} T", "Is it in tesla?"))
    rough = rough_rows(points, field[:, measured], usable, pace)
    if rough.any():
        broken["spike"] = (1 + np.flatnonzero(rough)).tolist()
    usable &= ~rough
    off, sd = quadratic_residual(points[usable], field[usable][:, measured], pace)
    scatter = scatter_around(points, points[usable], off / sd[:, None])
    directions = motion(points, time) if np.ptp(time) else np.zeros_like(points)
    return Scan(points, field, time, directions, scatter), usable, broken


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


def _thinned(scan: Scan) -> ProbeModel:
    """Return the model of at most `SOME_POINTS` throughout a scan.

    Its charges are neither near nor far: those of a map near edges of magnets, fitted by far ones,
    gave sensors 10 mm off.
    """
    some = scan.of(spread(np.arange(len(scan.points)), SOME_POINTS))
    return some.model(Charges.around(some.points, MIDDLING * point_spacing(scan.points)))


def _orientation(
    given: ProbeModel, pace: Pace
) -> tuple[Floats, tuple[tuple[str, str, str], ...]]:
    """Return the matrix of the orientation, and others that fit as well.

    If orientations fit about equally well with a perfect instrument, each gets its own instrument,
    which must be a possible one. The axes are taken as they are given if nothing speaks against
    them.
    """
    # The same in a linear instrument, from which orientations are no longer tried: errors of usual
    # sizes are not quite linear.
    nearly_alike = 300.0
    if len(given.sensors) < len(COMPONENTS):  # a component by itself has no axes
        return np.eye(3), ()
    every, matrices = np.ones(len(given.points), bool), _orientations()
    perfect = given.start(NO_FIT)
    free = given.free(perfect, every, 0.0)
    fits = [free.most_probable(given.turned(matrix).target(perfect, every))
            for matrix in matrices]
    sigma = np.array([fit.sigma for fit in fits])
    left = np.flatnonzero(sigma <= WORTH_TRYING * sigma.min()).tolist()
    if len(left) == 1:
        return matrices[left[0]], ()
    nearly = {number: _linear_against(given.turned(matrices[number]), fits[number])
              for number in left}
    left = [number for number, value in nearly.items()
            if not number or value <= min(nearly.values()) + nearly_alike]
    against = {}
    for number in left:
        fitted = fit_probe(given.turned(matrices[number]), every, fits[number],
                           iterations=FEW_ITERATIONS)
        impossible = np.abs(fitted.instrument).max() > doubted_from(len(fitted.instrument))
        against[number] = np.inf if impossible and number else float(
            3 * len(every) * np.log(fitted.sigma) + fitted.instrument @ fitted.instrument / 2)
        pace.advance(len(against), len(left))
    alike = [number for number in against if against[number] <= min(against.values()) + ALIKE]
    best = 0 if 0 in alike else min(alike, key=lambda number: against[number])
    return matrices[best], tuple(_named(matrices[number]) for number in alike if number != best)


def _linear_against(model: ProbeModel, fit: HarmonicFit) -> float:
    """Return how improbable readings are, with an instrument in which they are linear."""
    every = np.ones(len(model.points), bool)
    (told,) = Evidence.of(model, every, model.start(fit), fit.sigma**2 / fit.penalty)
    instrument, _ = told.estimate(np.arange(len(told.sums)))
    readings = 3 * len(every)
    return float(readings * (np.log(fit.sigma) + np.log(
        1 - told.sums @ instrument / readings) / 2) + instrument @ instrument / 2)


@dataclass(frozen=True)
class _Placed:
    """Charges as near as the readings of a scan ask for."""

    gap_m: float
    """Their distance from where sensors read the field."""
    probe: ProbeFit
    """The instrument with which they were tried."""
    fit: HarmonicFit
    """The fit of the field."""

    @property
    def log_evidence(self) -> float:
        """Log evidence of the readings, with the prior of the instrument."""
        return self.fit.log_evidence - float(self.probe.instrument @ self.probe.instrument) / 2


def _placed(scan: Scan, some: ProbeModel, pace: Pace) -> _Placed:
    """Return the charges of a scan.

    The instrument is perfect, or is first fitted to ``some`` points. Charges are tried from far to
    near, which are more, until the evidence of the readings falls.
    """
    spacing, perfect = point_spacing(scan.points), some.start(NO_FIT)
    every = np.ones(len(some.points), bool)
    first = some.fit(perfect, every)
    probe, every = fit_probe(some, every, first), np.ones(len(scan.points), bool)
    found: list[_Placed] = []

    def tried(gap_m: float, probe: ProbeFit) -> float:
        charges = Charges.around(probe.read_at(scan.points), gap_m)
        found.append(_Placed(gap_m, probe, scan.model(charges).fit(probe, every)))
        pace.advance(len(found), FIRST_FIT_PARTS)
        return found[-1].log_evidence

    last, read_at = -np.inf, probe.read_at(scan.points)
    for gap in reversed(GAPS):
        near = spacing_of(read_at, gap * spacing) <= TOO_FAR_APART * gap * spacing
        if near or gap == GAPS[-1]:
            now = tried(gap * spacing, probe)
            if now < last:
                break
            last = now
    tried(max(found, key=lambda each: each.log_evidence).gap_m, some.start(first))
    pace.advance(FIRST_FIT_PARTS // 3, FIRST_FIT_PARTS)
    return max(found, key=lambda each: each.log_evidence)


def _confirmed(
    matrix: Floats, alike: tuple[tuple[str, str, str], ...], scan: Scan, some: ProbeModel,
    pace: Pace
) -> tuple[Floats, tuple[tuple[str, str, str], ...], _Placed]:
    """Return the matrix of the orientation, others that fit as well, and the charges for it.

    Charges of one distance, by which orientations are compared, may fit better with wrong axes:
    maps of two circles or lines determine few of them, and their field may need nearer ones. Other
    axes than those that are given must therefore be far likelier by charges as near as needed, too.
    """
    placed, given = _placed(scan.turned(matrix), some.turned(matrix), pace), np.eye(3)
    if np.array_equal(matrix, given):
        return matrix, alike, placed
    as_given = _placed(scan, some, pace)
    better = placed.log_evidence - as_given.log_evidence
    # true exchanges were better by 240 and more, wrong ones in maps of two curves by 53 at most
    sure = 100.0
    if better >= sure:
        return matrix, alike, placed
    return given, (_named(matrix), *alike) if better > -ALIKE else (), as_given


# --- instrument ---------------------------------------------------------------------------------


CHANGES = {"from start to end": dict.fromkeys(range(0, WAVES, 2), 2.0),
           "from the ends to the middle": {
               wave: float(np.polynomial.Legendre.basis(wave + 1)(0)) - 1
               for wave in range(1, WAVES, 2)}}
"""Differences of the Legendre polynomials 1 to `WAVES` between times of the scan."""


@dataclass(frozen=True)
class Parameter:
    """A parameter in the unit of people: the product of ``row`` (p,) and `ProbeFit.instrument`.

    It is left out of a model without the parameters ``own`` of a `ProbeFit`, and asked with those
    ``beside`` it: a change during the scan need not be even, and halves of the map show other parts
    of it.
    """

    name: str
    unit: str
    row: Floats
    own: tuple[int, ...]
    beside: tuple[int, ...] = ()
    likes: tuple[int, ...] = ()
    """Parameters that change many maps nearly alike, which its bar contains."""
    apart: Floats | None = None
    """Row (p,) to which that bar belongs, if not ``row``."""

    @property
    def apart_row(self) -> Floats:
        """The row (p,) of that bar."""
        return self.row if self.apart is None else self.apart


@dataclass(frozen=True)
class EvidenceByPart:
    """What a map tells of the instrument, and what each of pairs of halves of it does.

    ``flat`` is the number of the pair of which the first half is where the field is flat; None if
    the map has no such half.
    """

    whole: Evidence
    halves: tuple[tuple[Evidence, Evidence], ...]
    flat: int | None = None

    @classmethod
    def of(cls, told: Sequence[Evidence], flat: int | None = None) -> EvidenceByPart:
        """Return what `Evidence.of` yields, with the halves in pairs."""
        whole, *parts = told
        return cls(whole, tuple(zip(parts[::2], parts[1::2], strict=True)), flat)


def all_parameters(prior_sd: Floats, shares: Floats) -> list[Parameter]:
    """Return all parameters of the instrument, the same ones in the same order for every map.

    ``shares`` (3, 3) is how much each element of the matrix of gains and crosstalk changes |B|, see
    `ProbeModel.shares`. What no map of such shares can tell has a ``row`` of 0.
    """
    # Share of a component in the mean square of the field from which its gain is that of |B|.
    all_of_it = 0.99
    found = []

    def row_of(factor: float, weights: dict[int, float]) -> Floats:
        row = np.zeros(len(prior_sd))
        row[list(weights)] = factor * np.array(list(weights.values()))
        return row * prior_sd

    def add(name: str, unit: str, factor: float, weights: dict[int, float],
            own: tuple[int, ...] = (), **more: Any) -> None:
        found.append(Parameter(name, unit, row_of(factor, weights), own or tuple(weights), **more))

    for sensor, along in product(range(3), repeat=2):
        add(f"{COMPONENTS[along]} of the B{COMPONENTS[sensor]} sensor from the mean of all", "mm",
            1e3, {3 * other + along: (sensor == other) - 1 / 3 for other in range(3)},
            (3 * sensor + along,))
    for axis in range(3):
        add(f"probe turned about {COMPONENTS[axis]}", "mrad", 1e3, {MIXING.start + axis: 1.0})
    for axis, (first, second) in enumerate(PAIRS):
        add(f"B{COMPONENTS[first]} and B{COMPONENTS[second]} not perpendicular", "mrad", 1e3,
            {MIXING.start + 3 + axis: 1.0})
    of_size = np.einsum("mij,ij->m", MATRICES, shares)
    likes = (*range(MIXING.stop - 3, MIXING.stop), *range(SCALES.start, SCALES.stop))
    for own in range(3):
        weights = (MATRICES[:, own, own] - of_size) * (shares[own, own] < all_of_it)
        add(f"gain of B{COMPONENTS[own]} relative to that of |B|", "%", 100.0,
            dict(enumerate(weights.tolist(), MIXING.start)), (MIXING.start + 6 + own,),
            likes=likes)
    for (when, by_wave), own in product(CHANGES.items(), range(3)):
        add(f"turn about {COMPONENTS[own]} {when}", "mrad", 1e3,
            {TURNS.start + 3 * wave + own: weight for wave, weight in by_wave.items()},
            (TURNS.start + 3 * min(by_wave) + own,),
            beside=tuple(TURNS.start + 3 * min(each) + own for each in CHANGES.values()))
    for own in range(3):
        add(f"change of the offset of B{COMPONENTS[own]} from start to end", "mT", 2e3,
            {OFFSETS.start + own: 1.0})
    for when, by_wave in CHANGES.items():
        add(f"change of the gain {when}", "%", 100.0,
            {GAINS.start + wave: weight for wave, weight in by_wave.items()},
            (GAINS.start + min(by_wave),),
            beside=tuple(GAINS.start + min(each) for each in CHANGES.values()))
    add("lag of the readings behind the stage", "mm", 1e3, {LAG: 1.0})
    for own, others in enumerate(PAIRS):
        axis, *rest = (SCALES.start + one for one in (own, *others))
        add(f"scale of the stage along {COMPONENTS[own]}", "%", 100.0, {axis: 1.0}, likes=likes,
            apart=row_of(100.0, {axis: 1.0} | dict.fromkeys(rest, -0.5)))
    return found


def _instrument_of_map(
    fitted: _Fitted, scan: Scan, rows: NDArray[np.bool_], pace: Pace
) -> tuple[_Fitted, tuple[InstrumentTerm, ...]]:
    """Return the fit by what the map shows of the instrument, and what it shows.

    Where charges do not follow the field, near its sources, what they leave is large and smooth: it
    makes the parts of the map disagree, and bars long. If there are such readings, the map is asked
    again without the tenths of it that are roughest. Its instrument is that of the region which
    shows most, and, if that is not all of the map, the field elsewhere is fitted with it as it is.
    By how much the regions differ beyond their bars is what the charges do to a term: bars contain
    it, see `_with_other_regions`.
    """
    regions = [rows]
    rough = fitted.model.scatter[rows]
    if np.quantile(rough, 0.9) > NOT_FOLLOWED * np.median(rough):
        regions += [rows & (scan.scatter <= np.quantile(scan.scatter[rows], share))
                    for share in CUT_BACK]
    asked = []
    for number, region in enumerate(regions):
        start = fitted if number == 0 else fitted.weighted(region)

        def advance(done: int, of: int, before: int = number) -> None:
            pace.advance(before * of + done, len(regions) * of)

        asked.append(_instrument_of_region(start, region, advance))
    supported = [np.array([term.found and (number == 0 or _is_supported(term, others))
                           for term, *others in zip(terms, *(
                               other for _, other in asked[:number] + asked[number + 1:]),
                               strict=True)]) for number, (_, terms) in enumerate(asked)]
    best = int(np.argmax([each.sum() for each in supported]))  # the largest that shows as much
    (whole, _), (inner, terms) = asked[0], asked[best]
    terms = tuple(_with_other_regions(
        replace(term, predictive=term.predictive and (not term.found or bool(stated))), others)
        for term, stated, *others in zip(terms, supported[best], *(
            told for _, told in asked[:best] + asked[best + 1:]), strict=True))
    if best == 0:
        return whole, terms
    model = whole.model.with_terms(inner.model.prior_sd > 0).settled()
    settled = replace(whole, model=model, at=replace(inner.at, amplitudes=whole.at.amplitudes))
    return settled.weighted(rows), terms


def _without_open_terms(fitted: _Fitted, terms: tuple[InstrumentTerm, ...]) -> ProbeFit:
    """Return the fit without the parameters of which the map does not tell which is off, and those
    whose bar other regions made too long, but for those, such as parts of a change, that one which
    was found has as well.
    """
    model = fitted.model
    open_ones = stated = np.zeros(len(fitted.at.instrument), bool)
    for parameter, term in zip(all_parameters(model.prior_sd, model.shares(fitted.at)), terms,
                               strict=True):
        waves = (parameter.row != 0) if parameter.beside else np.isin(
            np.arange(len(open_ones)), parameter.own)
        if term.found and not term.rivals:
            stated = stated | waves
        else:
            open_ones = open_ones | waves
    return replace(fitted.at, instrument=np.where(open_ones & ~stated, 0.0, fitted.at.instrument))


def _is_supported(term: InstrumentTerm, others: list[InstrumentTerm]) -> bool:
    """Tell whether no other region of the map contradicts a term, and another one shows it too."""
    told = [other for other in others if other.determined]
    return any(other.predictive and abs(other.value) > SHOWN * other.sd for other in told) and all(
        abs(term.value - other.value) <= SEEN * np.hypot(term.sd, other.sd) for other in told)


def _with_other_regions(term: InstrumentTerm, others: list[InstrumentTerm]) -> InstrumentTerm:
    """Return a term; if it was found, with a bar that contains how other regions differ from it,
    and what does nearly the same as far as that region tells them apart which does so best.

    Of two regions of which one contains the other, estimates differ by the root of the difference
    of their variances. A measured dipole's probe was turned by 49.4 +- 1.2 mrad by all of a map
    that touches its blocks, by 55.7 +- 0.4 without the roughest tenths, and by 56.2 +- 0.4 in
    another map: the readings near the blocks lead astray by five of their bars.
    """
    beyond = [max(0.0, (other.value - term.value)**2 - abs(other.sd**2 - term.sd**2))
              for other in others if other.determined]
    if not (term.found and beyond):
        return term
    return replace(term, sd=float(np.hypot(term.sd, np.sqrt(np.mean(beyond)))), likes_sd=min(
        term.likes_sd, *(other.likes_sd if other.found else np.inf for other in others)))


def _instrument_of_region(
    fitted: _Fitted, rows: NDArray[np.bool_], advance: Progress
) -> tuple[_Fitted, tuple[InstrumentTerm, ...]]:
    """Return the fit by what all parts of a region show of the instrument, and what they show.

    Parameters are added to a perfect instrument one by one, the most certain first. What is left of
    a field that is steeper than the charges, and positions that are off together along a line, is
    no white noise: parameters take to it with certainty, but differently in every part of the map.
    One that is not certain any more after the fit with it is left out, and the others are asked
    again: what else was found beside it holds beside it only.
    """
    no_terms = np.zeros(len(fitted.at.instrument), bool)
    fitted = replace(fitted, at=replace(fitted.at, instrument=np.zeros(len(no_terms))))
    unsteady: set[str] = set()
    for number in range(ROUNDS + MOST_UNSTEADY):
        model = fitted.model.with_terms(~no_terms)
        halves = _halves(model, fitted.at, rows)
        steps = 2 + 2 * len(halves)
        done = min(number, ROUNDS - 1) * steps
        told: list[Evidence] = []
        for each in Evidence.of(model, rows, fitted.at, fitted.width2, list(halves.values())):
            told.append(each)
            advance(done + len(told), ROUNDS * steps)
        parameters = [replace(one, row=0 * one.row) if one.name in unsteady else one
                      for one in all_parameters(model.prior_sd, model.shares(fitted.at))]
        kept, terms = found_terms(parameters, EvidenceByPart.of(
            told, list(halves).index("steepness") if "steepness" in halves else None))
        fitted = replace(fitted, model=model).only(kept, rows).weighted(rows)
        advance(done + steps, ROUNDS * steps)
        steady = [_as_fitted(term, float(parameter.row @ fitted.at.instrument))
                  for term, parameter in zip(terms, parameters, strict=True)]
        lost = [now for before, now in zip(terms, steady, strict=True)
                if before.found and not now.found]
        if number >= ROUNDS - 1:
            if not lost:
                break
            unsteady.add(min(lost, key=lambda one: abs(one.value) / one.sd).name)
    return fitted, tuple(steady)


def _as_fitted(term: InstrumentTerm, value: float) -> InstrumentTerm:
    """Return a term; if it was found, with the value of the last fit and a bar that reaches there.

    The fit may move a term from where the parts of the map were asked: of large turns that is no
    straight line, and the bar there does not reach as far.
    """
    if not term.found:
        return term
    return replace(term, value=value, sd=float(np.hypot(term.sd, value - term.value)))


def found_terms(
    parameters: list[Parameter], told: EvidenceByPart, known: NDArray[np.bool_] | None = None,
    with_rivals: bool = True,
) -> tuple[NDArray[np.bool_], tuple[InstrumentTerm, ...]]:
    """Return which parameters (p,) of a `ProbeFit` are found, and all terms.

    ``known`` (p,) are kept already. Parameters of which one is enough, and that explain the map
    about as well, are kept together: in the flat field of an MRI magnet a gain that drifts along x
    is a gradient of the field and a sensor that is off along x. None is found then, as none has a
    value without the others, unless later ones help. Not ``with_rivals``, the most probable one is
    kept alone. ``sd`` is without ``likes_sd``.
    """
    kept = np.zeros(len(told.whole.sums), bool) if known is None else known.copy()
    rivals: dict[str, tuple[str, ...]] = {}
    beaten: dict[str, tuple[str, ...]] = {}
    while True:
        terms = [_term(parameter, kept, told) for parameter in parameters]
        with_own = {parameter.name: (parameter, _most_probable(parameter, kept, told.whole))
                    for parameter, term in zip(parameters, terms, strict=True)
                    if term.found and not kept[list(parameter.own)].all()}
        new = {name: own for name, (parameter, own) in with_own.items()
               if not _is_told(parameter, own, kept, told.whole)}
        finer = [] if new else _finer(parameters, kept, told)
        if finer:
            kept[finer] = True
        elif not new:
            found = {term.name for term in terms if term.found}
            return kept, tuple(
                replace(term, likes_sd=_by_likes(parameter, kept, told),
                        beaten=beaten.get(term.name, ()),
                        rivals=() if found & {term.name, *rivals.get(term.name, ())}
                        else rivals.get(term.name, ()))
                for term, parameter in zip(terms, parameters, strict=True))
        else:
            alike = _alike(new, told.whole)[:None if with_rivals else 1]
            rivals |= {name: tuple(other for other in alike if other != name) for name in alike}
            for one in [each for each in parameters if each.name in alike]:
                kept[list(one.own)] = True
                beaten[one.name] = tuple(
                    other.name for other in parameters if other is not one
                    and other.name in new and set(other.own) <= set(one.likes))


def _is_told(
    parameter: Parameter, with_own: NDArray[np.bool_], kept: NDArray[np.bool_], whole: Evidence
) -> bool:
    """Tell whether what is kept (p,) has a parameter already, as the gain of one component has that
    of another one relative to |B|: the map is no more probable ``with_own`` (p,).
    """
    return bool(parameter.likes) and bool(parameter.row[kept].any()) and (
        whole.log_evidence(with_own) <= whole.log_evidence(kept))


def _by_likes(
    parameter: Parameter, kept: NDArray[np.bool_], told: EvidenceByPart
) -> float:
    """Return the standard deviation by others that change many maps nearly alike, in its unit."""
    if not parameter.likes or not parameter.row.any():
        return 0.0
    apart = replace(parameter, row=parameter.apart_row)
    with_likes = kept.copy()
    with_likes[list(parameter.likes)] = True
    alone, beside = (_shown(apart, each, told, ALIKE_PARTS) for each in (kept, with_likes))
    return float(np.hypot(beside.sd, beside.value - alone.value))


def _beside_likes(
    fitted: _Fitted, terms: tuple[InstrumentTerm, ...]
) -> tuple[InstrumentTerm, ...]:
    """Return terms with bars that contain others which change many maps nearly alike.

    A stage that was 1 % too long along z was read as +0.7 % of Bz. Which of the two is off the
    evidence tells of most maps; but both may be, by as much as probes and stages are. Where that
    bar is too long, those that would have been found in its place are rivals.
    """
    found = []
    for term, parameter in zip(terms, all_parameters(
            fitted.model.any_sd, fitted.model.shares(fitted.at)), strict=True):
        sd = float(np.hypot(term.sd, term.likes_sd))
        prior = float(np.linalg.norm(parameter.apart_row))
        wide = replace(term, sd=sd, determined=term.determined and (
            not term.likes_sd or sd < DETERMINED * prior))
        lost = term.found and not (wide.found or term.rivals)
        found.append(replace(wide, rivals=term.beaten if lost else term.rivals))
    return tuple(found)


def _most_probable(
    parameter: Parameter, kept: NDArray[np.bool_], whole: Evidence
) -> NDArray[np.bool_]:
    """Return all that is kept (p,) with a parameter, or with its uneven part if that is more
    probable.
    """
    number = np.arange(len(kept))
    even = kept | np.isin(number, parameter.own)
    return max(even, even | np.isin(number, parameter.beside), key=whole.log_evidence)


def _alike(new: dict[str, NDArray[np.bool_]], whole: Evidence) -> list[str]:
    """Return the parameter, of all that are found, that explains the map best, and those that do so
    nearly as well in its place but add nothing to it.

    ``new`` is what is kept (p,) with each of them. Of two changes with their uneven parts one may
    contain the other, and is no other explanation.
    """
    evidence = {name: whole.log_evidence(kept) for name, kept in new.items()}
    best = max(evidence, key=evidence.__getitem__)
    return [best, *(name for name, kept in new.items()
                    if (kept & ~new[best]).any() and (new[best] & ~kept).any()
                    and evidence[best] - evidence[name] < ALMOST_ALIKE
                    and whole.log_evidence(kept | new[best]) - evidence[best] < ALMOST_ALIKE)]


def _finer(
    parameters: list[Parameter], kept: NDArray[np.bool_], told: EvidenceByPart
) -> list[int]:
    """Return the finer parts of changes during the scan that are kept, which are found too.

    The smooth ones are asked first, by themselves: beside all others each of them has a longer bar.
    """
    for most in (COARSE_WAVES, WAVES):
        found = []
        for parameter in parameters:
            if not parameter.beside or not kept[list(parameter.own)].all():
                continue
            waves = _waves_of(parameter, parameters, most)
            for part in [each for each in waves if parameter.row[each] and not kept[each]]:
                alone = np.where(np.arange(len(kept)) == part, parameter.row, 0.0)
                if _shown(replace(parameter, row=alone, own=waves), kept, told,
                          PARTS_OF_A_CHANGE).found:
                    found.append(part)
        if found:
            return found
    return []


def _waves_of(
    parameter: Parameter, parameters: list[Parameter], most: int
) -> tuple[int, ...]:
    """Return the first parts of all changes during the scan that differ in their waves only."""
    every = np.flatnonzero(np.any([
        other.row != 0 for other in parameters if other.beside == parameter.beside], axis=0))
    return tuple(every[:most].tolist())


def _halves(
    model: ProbeModel, at: ProbeFit, rows: NDArray[np.bool_]
) -> dict[str, NDArray[np.bool_]]:
    """Return one half of the map each along x, y and z, and by how steep the field is."""
    # Smallest number of readings of a part of the map that tells of the instrument by itself.
    fewest_in_part = 40
    steepness = np.linalg.norm(model.charges.gradient(model.points, at.amplitudes), axis=(1, 2))
    found = {}
    for name, values in zip((*COMPONENTS, "steepness"), (*model.points.T, steepness), strict=True):
        middle = (float(np.median(values[rows])) if name == "steepness"
                  else (values[rows].max() + values[rows].min()) / 2)
        half = rows & (values <= middle)
        if min(half.sum(), rows.sum() - half.sum()) >= fewest_in_part:
            found[name] = half
    return found


def _term(
    parameter: Parameter, kept: NDArray[np.bool_], told: EvidenceByPart
) -> InstrumentTerm:
    """Return what the whole map and its halves show of a parameter, see `_shown`.

    A change during the scan that they do not show alike by itself is asked with its uneven part.
    """
    even = _shown(parameter, kept, told, ALIKE_PARTS)
    if even.found or not parameter.beside:
        return even
    uneven = _shown(replace(parameter, own=parameter.own + parameter.beside), kept, told,
                    PARTS_OF_A_CHANGE)
    return uneven if uneven.found else even


def _shown(
    parameter: Parameter, kept: NDArray[np.bool_], told: EvidenceByPart,
    alike: tuple[float, float]
) -> InstrumentTerm:
    """Return what the whole map and its halves show of a parameter, besides those that are kept.

    If the halves scatter about the whole by more than their bars, its bar is as much longer. They
    support it if both of a pair could tell whether it is there, and none that could contradicts it.
    What the charges do not follow is where the field is steep, in both halves along other axes:
    the half in which it is flat must be able to tell, too.
    """
    if not parameter.row.any():  # it is not asked, see `all_parameters`
        return InstrumentTerm(parameter.name, parameter.unit, 0.0, 0.0, False, True)
    used = np.flatnonzero(kept | np.isin(np.arange(len(kept)), parameter.own))
    row = parameter.row[used]
    parts = [each.estimate(used) for each in (told.whole, *chain(*told.halves))]
    value, *by_half = (float(row @ mean) for mean, _ in parts)
    sd, *sd_by_half = (float(np.sqrt(row @ covariance @ row)) for _, covariance in parts)
    values, sds = (np.reshape(each, (-1, 2)) for each in (by_half, sd_by_half))  # a pair a row
    alone = np.sqrt(np.maximum(sds**2 - sd**2, 0.1 * sds**2))
    beyond = max(1.0, rms((values - value) / alone)) if sds.size else 1.0
    sees = SEEN * beyond * sds < abs(value)
    share = values / value if value else np.zeros(values.shape)
    off = (np.abs(values - value) > SEEN * sds) & ((share < alike[0]) | (share > alike[1]))
    supported = bool(sees.all(axis=1).any() and not (sees & off).any() and (
        told.flat is None or SEEN * sds[told.flat, 0] < abs(value)))
    prior = float(np.linalg.norm(row))
    away = float(np.abs(parts[0][0][np.isin(used, parameter.own)]).max())
    return InstrumentTerm(
        parameter.name, parameter.unit, value, beyond * sd, beyond * sd < DETERMINED * prior,
        away <= doubted_from(len(kept)),
        supported or abs(value) <= SIGNIFICANT * beyond * sd)


# --- what remains -------------------------------------------------------------------------------


def _windows(
    points: Floats, residual: Floats
) -> tuple[str, tuple[tuple[float, float, tuple[float, float, float]], ...]]:
    """Return the rms residual of each component in parts along the longest axis."""
    windows = 6  # number of parts along the longest axis for which the residual is given
    axis = int(np.argmax(np.ptp(points, axis=0)))
    edges = np.linspace(points[:, axis].min(), points[:, axis].max(), windows + 1)
    number = np.clip(np.searchsorted(edges, points[:, axis], side="right") - 1, 0, windows - 1)
    found = []
    for window in range(windows):
        if (number == window).any():
            x, y, z = _rms(residual[number == window]).tolist()
            found.append((float(edges[window]), float(edges[window + 1]), (x, y, z)))
    return COMPONENTS[axis], tuple(found)


def _reach(
    points: Floats, floor: Floats, every: Floats, noise_T: float
) -> Reach | None:
    """Return where held-out readings (n, 3) at points (n, 3) in m are off by little; see `Reach`.

    The middle is that of ``every`` point (m, 3) of the map. Of all regions on one side of a plane
    across x, y or z, or within a distance from the line through the middle, it is the one with the
    most readings; None if that is all of them.
    """
    # Smallest part of the held-out readings that makes a region in which they are well predicted.
    fewest_kept = 0.1
    squares = np.mean(floor**2, axis=1)
    limit = (FAR_OFF * noise_T) ** 2
    if not noise_T or squares.mean() <= limit:
        return None
    families = [("r", True, distance_from_middle(points, every))]
    families += [(name, below, column if below else -column) for below in (True, False)
                 for name, column in zip(COMPONENTS, points.T, strict=True)]
    best, most = Reach("r", True, np.nan, np.nan, float(np.sqrt(squares.mean())), noise_T), (
        fewest_kept * len(points))
    for along, below, place in families:
        place = place.round(6)  # points of a ring differ by rounding
        for end in np.unique(place)[:-1]:
            inside = place <= end
            # each of its parts must be good, not their mean only
            if squares[inside].mean() > limit or squares[place == end].mean() > limit:
                break
            if inside.sum() > most:
                most = inside.sum()
                within, beyond = (float(np.sqrt(squares[part].mean()))
                                  for part in (inside, ~inside))
                best = Reach(along, below, float(end if below else -end), within, beyond, noise_T)
    return best


def distance_from_middle(points: Floats, every: Floats) -> Floats:
    """Return the distances (n,) in m from the middle of a map of ``every`` point (m, 3).

    It is the line through its middle along its longest axis.
    """
    middle = (every.max(axis=0) + every.min(axis=0)) / 2
    return np.asarray(np.linalg.norm(np.delete(
        points - middle, int(np.argmax(np.ptp(every, axis=0))), axis=1), axis=1))


def _structure(points: Floats, residual: Floats) -> float:
    """Return the correlation of the residuals (n, 3) of nearest neighbours."""
    nearest = KDTree(points).query(points, 2)[1][:, 1]
    total = float(np.sum(residual**2))
    return float(np.sum(residual * residual[nearest]) / total) if total else 0.0
