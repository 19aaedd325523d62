"""Several maps of one magnet, joined without a model of it: their poses by where they overlap.

Each map is checked by itself first (`halbach_fe.measurement.map_check`). Where the field of one map
is that of another one is searched over all shifts at once, by correlations. From there one field
without sources is fitted to all maps, together with their poses and with what the probes have in
common. Terms of the probe that only one map has are added if all parts of the overlaps show them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations, product
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import linalg, special
from scipy.ndimage import maximum_filter
from scipy.optimize import least_squares
from scipy.signal import correlate
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats, Ints, rms, spread
from halbach_fe.core.errors import MeasurementError, StudyError, must_be
from halbach_fe.core.files import file_bytes
from halbach_fe.core.interface import ShownInNotebook, typed
from halbach_fe.core.numbers import MAD_TO_SD, check_number, decimals
from halbach_fe.core.progress import Pace, Progress
from halbach_fe.measurement.campaign_maps import refuse_shared
from halbach_fe.measurement.field_map import field_map, points_of
from halbach_fe.measurement.map_check import (
    FAR_OFF,
    MOST_POINTS,
    SIGNIFICANT,
    SOME_POINTS,
    TOO_FAR_APART,
    WEIGHTINGS,
    EvidenceByPart,
    InstrumentTerm,
    MapCheck,
    Parameter,
    Scan,
    all_parameters,
    check_map,
    found_terms,
    inner,
    oriented,
    scan_of,
    some_lines,
)
from halbach_fe.measurement.map_join_fit import (
    GAIN,
    PLACED_SD,
    TERMS,
    TURN_RAD,
    JoinedModel,
    Pose,
    PosedCharges,
)
from halbach_fe.measurement.positions import scan_lines
from halbach_fe.measurement.probe_fit import (
    LAG,
    MATRICES,
    MIXING,
    PRIOR_SD,
    SCALES,
    SENSORS,
    Evidence,
    ProbeFit,
    State,
    fit_probe,
    from_middle,
)
from halbach_fe.measurement.source_free_field import Charges, fit_fields, spacing_of
from halbach_fe.study.types import COMPONENTS

FEWEST_SHARED = 40
"""Smallest number of points of a map that another one has around them. Half as many do where the
axes are as stated, one of 96 ways to name them."""

MARGIN = 0.25
"""Distance outside of the box about a map, in units of its spacing, up to which it knows the field
as well as inside."""

PLACES = 6
"""Number of shifts of best correlation from which poses are refined."""

CERTAIN = 30.0
"""Log odds of a place against chance: of some millions of shifts one has 15 by chance."""

NEARLY = 20.0
"""Difference in an overlap, in units of what the single maps leave, above which a place is none.
The field of a single map is known badly at its edge: 8 times what its held-out lines are off in a
quadrupole. The field of all maps decides. Below `FAR_OFF`, axes are taken as they are stated."""

DISAGREES = 2.0
"""chi2 per reading of an overlap from which maps contradict each other: errors of positions that
scan lines have in common made 1.5 in maps of one magnet."""

BY_CHANCE = 1e-3
"""Probability of a larger chi2 in an overlap of few readings, up to which maps still agree."""

DIFFERS = FAR_OFF**2
"""chi2 per reading of an overlap from which maps are not joined. If axes of a stage are not those
that it states, `DISAGREES` is: a smooth field that is nearly symmetric is much like itself."""

FEIGNED = 10.0
"""Information about poses that counts as none, in units of what an unknown field would feign. It
was 0.4 to 19 times that for turns about far poles, dipoles and ends of bars, and 80 and more in
dipoles and quadrupoles whose bars were right."""

START_OFF = 2.0
"""Standard deviation of what the readings do not determine of a pose, in units of `PLACED_SD`: the
fit starts from where single maps seemed to agree. Turns about far poles were off by 0.1 rad."""

STANDS_OFF, OUT_OF_LINE = 6.0, 5.0
"""Displacement of a layer of a scan from which its rows are left out, in units of its standard
deviation, and of the scatter of all other layers along the axis. The first plane of a measured
dipole, which the stage came to from the other side, was off by 0.36 mm: 26 and 9 of these units,
and no other layer by more than 7 and 4."""

FEWEST_IN_LAYER, FEWEST_LAYERS = 8, 5
"""Smallest number of points in an overlap that are a layer, and of layers that are compared. Of
four layers of a stage with a periodic error of 0.1 mm one seemed to be off the others, and the pose
by these was 22 bars off."""

OWN_GAIN = PLACED_SD[GAIN]
"""Prior standard deviation of the gain of a component in one map only, relative to others."""

TURNED_RAD = 0.5
"""Turn from which a stage has other axes than it states."""


@dataclass(frozen=True)
class Overlap:
    """What the readings of a map say that others have around them."""

    name: str
    readings: int
    chi2: float
    """Per reading, with the covariance of the field that the other maps predict: 1 if they
    agree."""
    limit: float
    """Largest chi2 of maps that agree, the larger the fewer readings there are."""
    rms_T: float
    """Rms of what the joined field leaves of them."""
    alone_T: float
    """Rms of what a field of the map alone leaves of them."""

    @property
    def agrees(self) -> bool:
        """Whether what differs may be noise."""
        return self.chi2 <= self.limit


@dataclass(frozen=True)
class Layer:
    """Points that a stage read at one place of one of its axes, but that are of another place."""

    name: str
    """Of the map."""
    axis: str
    """Of the stage: x, y or z."""
    place_m: float
    """What the map says, along this axis."""
    points: int
    """Rows there, all of which were left out; of a map that is joined in part, of that part."""
    off_m: float
    off_sd_m: float
    """Where they were along this axis, by the readings of all maps, less where they should be, with
    the standard deviation that noise makes. The field that was fitted follows such rows: a fifth of
    0.3 mm was lost at the border of a map."""


@dataclass(frozen=True)
class MapPose:
    """Where a map lies in the frame of the first one.

    A place p of the map is ``turn p + translation_m``, for the turn of ``rotation_rad``: these are
    keys of an `[instrument]`.
    """

    name: str
    middle_m: Floats
    """The middle of the map's points, in its own coordinates. Shape (3,)."""
    shift_m: Floats
    shift_sd_m: Floats
    """Place of that middle in the frame of the first map, less ``middle_m``. Shape (3,)."""
    rotation_rad: Floats
    rotation_sd_rad: Floats
    """Shape (3,)."""
    sign: int
    """-1 if the readings have the opposite sign of those of the first map."""

    @property
    def translation_m(self) -> Floats:
        """Place (3,) in m of the origin of the map in the frame of the first one."""
        turn = Rotation.from_rotvec(self.rotation_rad).as_matrix()
        return np.asarray(self.middle_m + self.shift_m - turn @ self.middle_m)

    @property
    def is_turned(self) -> bool:
        """Whether the axes of the stage are not those that it states."""
        return bool(np.linalg.norm(self.rotation_rad) > TURNED_RAD)

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Whether the overlap says more (6,) of shift and turn than what a stage may be off."""
        sd = np.concatenate([self.shift_sd_m, self.rotation_sd_rad])
        return np.asarray(sd < np.array(PLACED_SD[:6]) / 2)


def read_joined(path: Path) -> tuple[str, tuple[MapPose, ...]]:
    """Return the name of the map whose frame is that of others, and their poses in it.

    Raises
    ------
    MeasurementError
        If the file is no joined.json of `halbach-fe check MAP MAP`.
    """
    raw = file_bytes(path, f"file {path}")
    try:
        found = json.loads(raw)
        poses = tuple(MapPose(sign=int(one["sign"]), name=str(one["name"]), **{
            key: np.array(one[key], float) for key in (
                "middle_m", "shift_m", "shift_sd_m", "rotation_rad", "rotation_sd_rad")})
            for one in found["poses"])
        numbers = np.array([list(vars(one).values())[1:-1] for one in poses], float)
        bars = numbers[:, [2, 4]] if numbers.shape[1:] == (5, 3) else np.zeros(1)
        names = [str(found["frame"]), *(one.name for one in poses)]
        if not np.isfinite(numbers).all() or not (bars > 0).all() or not all(
                name.isprintable() for name in names):
            raise ValueError
        return names[0], poses
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError,
            IndexError):
        raise MeasurementError(must_be(
            f"file {path}", "joined maps", "a joined.json that `halbach-fe check MAP MAP` wrote",
            "another file")) from None


@dataclass(frozen=True)
class JoinedMaps(ShownInNotebook):
    """Maps of one magnet in the frame of the first one.

    Attributes
    ----------
    checks : dict of str to MapCheck
        Maxwell's check of each map by itself.
    poses : tuple of MapPose
        Of all maps but the first.
    covariance : ndarray, shape (6 k, 6 k)
        Of shift in m and turn in rad of these poses, one after the other.
    terms : tuple of InstrumentTerm
        What the probe has in common in all maps, and what single maps have in addition.
    overlaps : tuple of Overlap
    data : Dataset
        The joined map: the rows of all maps that were fitted or could be, in the frame of the first
        one, as the common probe reads there. ``scan`` has the name of the map, and its own scans.
    displaced : tuple of Layer
        Layers that were left out, as the stage was not where it says.
    """

    checks: dict[str, MapCheck]
    poses: tuple[MapPose, ...]
    covariance: Floats
    terms: tuple[InstrumentTerm, ...]
    overlaps: tuple[Overlap, ...]
    data: xr.Dataset
    displaced: tuple[Layer, ...] = ()

    @property
    def agree(self) -> bool:
        """Whether no map contradicts the others."""
        return all(one.agrees for one in self.overlaps)

    def plain(self) -> dict[str, object]:
        """Return the results as plain data for JSON."""
        poses = [{name: value.tolist() if isinstance(value, np.ndarray) else value
                  for name, value in (vars(one) | {"translation_m": one.translation_m,
                                                   "determined": one.determined}).items()}
                 for one in self.poses]
        return {"frame": next(iter(self.checks)), "poses": poses,
                "covariance_of": [f"{one.name} {what} {axis}" for one in self.poses
                                  for what in ("shift_m", "rotation_rad") for axis in COMPONENTS],
                "covariance": self.covariance.tolist(), "agree": self.agree,
                "overlaps": [asdict(one) | {"agrees": one.agrees} for one in self.overlaps],
                "displaced": [asdict(one) for one in self.displaced],
                "terms": [asdict(one) | {"found": one.found} for one in self.terms],
                "maps": {name: {"floor_rms_T": one.floor_rms_T, "noise_T": one.noise_T,
                                "points": one.points} for name, one in self.checks.items()}}


@dataclass(frozen=True)
class Checked:
    """A map after its check: the rows that obey, and the field alone that fits them."""

    name: str
    data: xr.Dataset
    """The map with its columns along the right axes, without rows that were left out."""
    check: MapCheck
    ideal_T: Floats
    """What a probe without the errors that were found would have read. Shape (n, 3)."""
    floor_T: float
    """Rms of what the field alone predicts badly."""
    charges: Charges
    amplitudes: Floats
    """Shape (k,)."""

    @classmethod
    def of(cls, name: str, check: MapCheck) -> Checked:
        """Take the part of a map that obeys Maxwell's equations."""
        rows = ~check.excluded
        floor, within = check.floor_rms_T, inner(check)
        if within is not None and check.reach is not None:
            rows = rows & check.reach.holds(points_of(check.data))
            floor = check.reach.inside_T
        kept = oriented(check) if within is None else within
        points, ideal = points_of(kept), check.corrected_T[rows]
        some = spread(np.arange(len(points)), SOME_POINTS)
        charges = Charges.around(points, check.gap_m)
        (fit,) = fit_fields(charges, points[some], [ideal[some]])
        return cls(name, kept, check, ideal, floor, charges, fit.amplitudes)

    @property
    def points(self) -> Floats:
        """The points (n, 3) in m."""
        return points_of(self.data)

    @property
    def box(self) -> tuple[Floats, Floats]:
        """The corners (3,) of the box about the points."""
        return self.points.min(axis=0), self.points.max(axis=0)

    def layers(self, points: Floats) -> Ints:
        """Return numbers (n, 3) that points (n, 3) at one place along an axis have in common."""
        return np.round(points / (self.check.spacing_m / 4)).astype(int)

    def without(self, layers: Sequence[Layer]) -> Checked:
        """Return the map without the rows of some layers."""
        own, kept = self.layers(self.points), np.ones(len(self.points), bool)
        for one in layers:
            if one.name == self.name:
                axis = COMPONENTS.index(one.axis)
                kept &= own[:, axis] != self.layers(np.full((1, 3), one.place_m))[0, axis]
        return replace(self, data=self.data.isel(point=np.flatnonzero(kept)),
                       ideal_T=self.ideal_T[kept])

    def holds(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which of points (n, 3) are among those of the map."""
        low, high = self.box
        margin = MARGIN * self.check.spacing_m
        return np.asarray(((points > low - margin) & (points < high + margin)).all(axis=1))


@typed
def join_maps(
    maps: Mapping[str, xr.Dataset], say: Callable[[str], None] = lambda _: None,
    progress: Progress | None = None, turn_rad: float = TURN_RAD,
) -> JoinedMaps:
    """Find where maps of one magnet lie to each other, without a model of the magnet.

    Parameters
    ----------
    maps : dict of str to Dataset
        The maps by name; the first one is the frame of the others.
    say : callable, optional
        Called with a description of each step before it starts.
    progress : callable, optional
        Called with the numbers of finished and of all parts of a step.
    turn_rad : float, optional
        Prior standard deviation of the turns of the stages against each other, from right angles.
        Of one stage that was shifted between the maps it is some 0.001: overlaps at the end of
        long maps hardly tell such a turn from a shift.

    Returns
    -------
    JoinedMaps

    Raises
    ------
    StudyError
        If there are fewer than two maps, or ``turn_rad`` is no such number.
    MeasurementError
        If a map does not obey Maxwell's equations by itself, or there is no place where its
        readings are those of the others: it is mirrored, of another magnet, or overlaps none. If
        two maps hold the same readings.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("mri.toml"))
    >>> axis = 0.01 * np.arange(5)
    >>> points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    >>> maps = {name: hf.field_map(points, magnet.field_T(points + [-0.01, -0.02, place])
    ...                            + 1e-6 * np.random.default_rng(1).standard_normal(points.shape))
    ...         for name, place in (("one", 0.03), ("other", 0.05))}  # the zero of the stage
    >>> (1e3 * hf.join_maps(maps).poses[0].shift_m).round(0) + 0.0
    array([ 0.,  0., 20.])
    """
    if not isinstance(maps, Mapping) or len(maps) < 2:
        raise StudyError(must_be("`maps`", "join_maps", "two maps or more, by name",
                                 "fewer", "check_map checks a single one."))
    check_number("turn_rad", "join_maps", turn_rad, 1e-12, np.pi / 2)
    checked = []
    for name, data in maps.items():
        say(f"checking {name}")
        check = check_map(data, say, progress)
        _refuse_disobedient(name, check)
        checked.append(Checked.of(name, check))
    refuse_shared({one.name: (points_of(one.data), one.data["B_T"].values, one.check.noise_T)
                   for one in checked}, "join_maps")
    return join_checked(checked, Pace(say, progress), turn_rad)


def _refuse_disobedient(name: str, check: MapCheck) -> None:
    """Raise a MeasurementError if a map is none by itself."""
    if not check.is_whole:
        raise MeasurementError(must_be(
            f"map '{name}'", "the maps that are joined", "with all three components of B",
            f"one of {check.measured}", "Join it by the magnet: halbach-fe register."))
    if not check.suffices or not check.obeys or check.is_displaced:
        raise MeasurementError(must_be(
            f"map '{name}'", "the maps that are joined", "one that obeys Maxwell's equations by "
            "itself",
            f"one of which held-out lines are off by {decimals(1e3 * check.floor_rms_T)} mT rms"
            if check.suffices else "one with too few readings to tell",
            "Look at `halbach-fe check` of this map alone: rows that were shuffled, or columns "
            "that are not what they say." if check.suffices else
            "Measure it in a volume with a smaller spacing, or join it by the magnet: "
            "halbach-fe register."))


def join_checked(
    maps: Sequence[Checked], pace: Pace, turn_rad: float = TURN_RAD
) -> JoinedMaps:
    """Join maps that were checked, see `join_maps`."""
    pace.say("searching the places where the maps overlap")
    places = _places(maps)
    maps = [replace(one, data=one.data.assign(B_T=sign * one.data["B_T"]))
            for one, (_, sign) in zip(maps, places, strict=True)]
    pace.say("fitting one field and all poses")
    poses = [pose for pose, _ in places]
    if turn_rad < TURN_RAD:
        poses = _as_stated(maps, poses)
    joined = _Joined.of(maps, poses, pace, turn_rad)
    if displaced := joined.displaced():
        pace.say("fitting without rows of which the stage was elsewhere")
        joined = _Joined.of([one.without(displaced) for one in maps], poses, pace,
                            turn_rad)
    terms, joined = joined.with_terms()
    overlaps = joined.overlaps()
    result = replace(joined.result([sign for _, sign in places], terms, overlaps),
                     displaced=displaced)
    turned = any(one.is_turned for one in result.poses)
    for one in overlaps:
        if one.chi2 > (one.limit if turned else max(one.limit, DIFFERS)):
            raise _contradiction(one.name, one.rms_T, one.alone_T)
    return result


def _contradiction(name: str, off_T: float, noise_T: float) -> MeasurementError:
    """Return the error for a map that is not of the same field."""
    if not np.isfinite(off_T):
        return MeasurementError(must_be(
            f"map '{name}'", "the maps that are joined",
            f"one that shares {FEWEST_SHARED // 2} points or more with another one",
            "fewer, in every place, of those that obey Maxwell's "
            "equations by themselves", "Measure more of the overlap, or with a smaller spacing "
            "(`halbach-fe check` of each map names the part that obeys), or find the map's place "
            "in the magnet by `halbach-fe register`."))
    return MeasurementError(must_be(
        f"map '{name}'", "the maps that are joined", "one that overlaps another one of the same "
        "magnet", f"one whose readings are off those of the others by {decimals(1e3 * off_T)} mT "
        f"in the place where they fit best, of which noise explains {decimals(1e3 * noise_T)} mT",
        "It is of another magnet, mirrored (a position axis counts backwards), was changed, or no "
        "other map reaches into it: such maps can be joined by the magnet only, with `halbach-fe "
        "register`."))


# --- where maps overlap -------------------------------------------------------------------------


@dataclass(frozen=True)
class _Match:
    """A pose of a map on another one, and how well the readings agree there.

    ``off`` is the difference, by its median, in units of what both maps leave, ``odds`` the log
    odds against a place where both have nothing to do with each other.
    """

    pose: Pose
    sign: int
    off: float
    rms_T: float
    odds: float

    @property
    def fits(self) -> bool:
        """Whether both may be of one field."""
        return self.off <= NEARLY and self.odds > CERTAIN

    @property
    def is_mirrored(self) -> bool:
        """Whether it is the mirror image of the map that fits."""
        return bool(np.linalg.det(self.pose.turn) < 0)


def _axes() -> Iterator[tuple[Floats, int]]:
    """Yield the ways, with the sign of the readings, in which axes of two stages may be named."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            yield from ((np.eye(3)[list(order)] * signs, sign) for sign in (1, -1))


def _places(maps: Sequence[Checked]) -> list[tuple[Pose, int]]:
    """Return the pose of each map in the frame of the first one, and the sign of its readings.

    MeasurementError if one has no place.
    """
    found: dict[int, tuple[Pose, int]] = {0: (Pose(np.eye(3), np.zeros(3)), 1)}
    as_stated = {(one, other): _match_of(maps[one], maps[other], [(np.eye(3), 1)])
                 for one in range(len(maps)) for other in range(1, len(maps)) if one != other}
    turned: dict[tuple[int, int], _Match] = {}
    while len(found) < len(maps):
        pairs = [pair for pair in as_stated if pair[0] in found and pair[1] not in found]
        known = {pair: as_stated[pair] for pair in pairs if as_stated[pair].off <= FAR_OFF
                 and as_stated[pair].fits}
        if not known:
            for pair in pairs:
                if pair not in turned:
                    one, other = pair
                    turned[pair] = _by_any_axes(maps[one], maps[other], as_stated[pair])
            known = {pair: turned[pair] for pair in pairs}
        first, other = max(known, key=lambda pair: (
            known[pair].fits, not known[pair].is_mirrored, known[pair].odds))
        best = known[first, other]
        if not best.fits or best.is_mirrored:
            raise _refused(maps[first], maps[other], best)
        pose, sign = found[first]
        found[other] = (pose.of(best.pose), sign * best.sign)
    return [found[number] for number in range(len(maps))]


def _by_any_axes(one: Checked, other: Checked, best: _Match) -> _Match:
    """Return the best place of a map on another one, however the axes of its stage are named.

    ``best`` is that with the axes as stated, which stays if others are not certainly likelier.
    """
    # of many ways only the likeliest are tried, so the opposite sign alone first
    for axes in ([(np.eye(3), -1)], list(_axes())):
        if best.fits and best.off <= FAR_OFF:
            break
        match = _match_of(one, other, axes)
        if not best.fits or (match.fits and match.odds > best.odds + CERTAIN):
            best = match
    return best


def _refused(one: Checked, other: Checked, best: _Match) -> MeasurementError:
    """Return the error for a map that has no place on another one."""
    noise = float(np.hypot(one.floor_T, other.floor_T))
    if not best.fits:
        return _contradiction(other.name, best.rms_T, noise)
    axis = COMPONENTS[int(np.argmin(np.diag(best.pose.turn)))]
    return MeasurementError(must_be(
        f"map '{other.name}'", "the maps that are joined", "one that fits where it overlaps "
        f"'{one.name}'", f"one that fits nowhere, but whose mirror image fits to "
        f"{1e6 * best.rms_T:.3g}\u00a0\u00b5T rms, at a noise of {1e6 * noise:.3g}\u00a0\u00b5T",
        "Either one of the two counts a position axis backwards, or they are maps of two magnets "
        f"of one design, which these readings do not tell apart. Of one magnet, reverse {axis}, "
        f"for example, and B{axis} in the map that is wrong."))


def _match_of(
    one: Checked, other: Checked, axes: Sequence[tuple[Floats, int]]
) -> _Match:
    """Return the best place of a map on another one, by the points of either in the other's box: a
    coarse map may have few in that of a fine one.
    """
    found = _match(one, other, axes)
    if found.fits:
        return found
    back = _match(other, one, axes)
    back = replace(back, pose=back.pose.inverse)
    return max(found, back, key=lambda match: (match.fits, match.odds))


def _match(one: Checked, other: Checked, axes: Sequence[tuple[Floats, int]]) -> _Match:
    """Return the best place of a map on another one, for some axes of its stage."""
    starts: list[tuple[float, Pose, int]] = []
    for turn, sign in axes:
        starts += [(odds, pose, sign) for odds, pose in _shifts(one, other, turn, sign)]
    # of places that are as likely, as in a symmetric magnet, the one with the simplest axes
    starts.sort(key=lambda each: -round(each[0] / CERTAIN))
    nothing = _Match(Pose(np.eye(3), np.zeros(3)), 1, np.inf, np.nan, -np.inf)
    found = [nothing]
    for _, pose, sign in starts[:PLACES]:
        found.append(_refined(one, other, pose, sign))
        if found[-1].fits and found[-1].off <= FAR_OFF:
            break
    return max(found, key=lambda match: (match.fits, match.odds))


def _step(one: Checked, other: Checked) -> float:
    """Return the step in m of the grids on which two maps are compared."""
    # Largest number of points of the grid on which the field of a map is compared with others.
    most_cells = 30_000
    step = min(one.check.spacing_m, other.check.spacing_m)
    for each in (one, other):
        sides = np.maximum(np.ptp(each.points, axis=0), step)
        step = max(step, float((np.prod(sides) / most_cells) ** (1 / 3)))
    return step


def _gridded(one: Checked, turn: Floats, sign: int, step: float) -> tuple[Floats, Floats]:
    """Return the first point (3,) of a grid over a map that is turned, and B (3, a, b, c) there."""
    low, high = (np.sort(np.array(one.box) @ turn.T, axis=0))
    axes = [low[axis] + step * np.arange(1 + int((high - low)[axis] / step + 1e-6))
            for axis in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    field = sign * one.charges.field(points.reshape(-1, 3) @ turn, one.amplitudes) @ turn.T
    return low, np.moveaxis(field.reshape(points.shape), -1, 0)


def _shifts(
    one: Checked, other: Checked, turn: Floats, sign: int
) -> list[tuple[float, Pose]]:
    """Return the shifts of a map that is turned for which it is most like another one.

    Correlations of both fields give, for all shifts by whole steps, the mean square of their
    difference in the overlap. The odds are those of normal readings with that variance against
    those with the mean square of the fields.
    """
    step = _step(one, other)
    (low, field), (start, moved) = (_gridded(one, np.eye(3), 1, step),
                                    _gridded(other, turn, sign, step))

    def over(first: Floats, second: Floats) -> Floats:
        return np.asarray(correlate(first, second, "full", "fft"))

    here, there = np.ones(field.shape[1:]), np.ones(moved.shape[1:])
    count = np.maximum(over(here, there), 0.5)
    size = over(np.sum(field**2, axis=0), there) + over(here, np.sum(moved**2, axis=0))
    left = size - 2 * sum(over(first, second) for first, second in zip(field, moved, strict=True))
    noise = 3 * count * (one.floor_T**2 + other.floor_T**2)
    readings = count * len(other.points) / there.size
    odds = 1.5 * readings * np.log((np.maximum(size, 0) / 2 + noise) / (
        np.maximum(left, 0) + noise))
    odds[readings < _fewest_shared(turn, sign)] = -np.inf
    peaks = np.argwhere((odds == maximum_filter(odds, 5)) & np.isfinite(odds))
    best = sorted(peaks.tolist(), key=lambda place: -odds[tuple(place)])[:PLACES]
    return [(float(odds[tuple(place)]), Pose(turn, low + step * (
        np.array(place) - np.array(there.shape) + 1) - start)) for place in best]


def _fewest_shared(turn: Floats, sign: int) -> float:
    """Return the least number of shared points for axes with a turn (3, 3)."""
    as_stated = sign == 1 and np.linalg.norm(turn - np.eye(3)) < TURNED_RAD
    return FEWEST_SHARED / 2 if as_stated else FEWEST_SHARED


def _refined(one: Checked, other: Checked, pose: Pose, sign: int) -> _Match:
    """Return the pose, from a first one, by which the readings of a map are those of another one.

    Readings that are far off count less, by their first power. The map may have gains of its own
    for each component: with 1 % in one of them its mirror image seemed to fit a symmetric magnet.
    """
    compared = 200  # largest number of points by which a pose is refined from the correlation
    middle, noise = np.mean(other.box, axis=0), float(np.hypot(one.floor_T, other.floor_T))
    noise = noise or 1e-6 * other.check.size_T
    for _ in range(2):  # with the readings of the overlap that the first pose has, then the second
        rows = np.flatnonzero(one.holds(pose.places(other.points)))
        if len(rows) < _fewest_shared(pose.turn, sign):
            return _Match(pose, sign, np.inf, np.nan, -np.inf)
        rows = spread(rows, compared)
        points, read = other.points[rows], sign * other.ideal_T[rows]

        def left(values: Floats, start: Pose = pose, at: Floats = points,
                 read: Floats = read) -> Floats:
            posed = PosedCharges.seen_from(one.charges, start.moved(middle, *_two(values)))
            reads = posed.field(at, one.amplitudes) * (1 + values[6:])
            return np.concatenate([(reads - read).ravel() / noise, values[6:] / OWN_GAIN])

        def by_pose(values: Floats, start: Pose = pose, at: Floats = points,
                    read: Floats = read) -> Floats:
            posed = PosedCharges.seen_from(one.charges, start.moved(middle, *_two(values)))
            field = posed.field(at, one.amplitudes)
            found = posed.by_pose(at, np.broadcast_to(np.eye(3), (len(at), 3, 3)),
                                  at - middle, one.amplitudes) * (1 + values[6:, None])
            by_gain = field[:, :, None] * np.eye(3)
            return np.vstack([np.concatenate([found, by_gain], axis=2).reshape(-1, 9) / noise,
                              np.eye(9)[6:] / OWN_GAIN])

        found = least_squares(left, np.zeros(9), by_pose, loss="soft_l1", f_scale=FAR_OFF,
                              max_nfev=40, x_scale=[other.check.spacing_m] * 3 + [0.01] * 6)
        pose = pose.moved(middle, *_two(found.x))
    # at the edge of the other map its field is not known as well as the noise is
    # and of two components that agree, the third may have the opposite sign
    medians = np.median(np.abs(found.fun[:-3].reshape(-1, 3)), axis=0)
    off = float(MAD_TO_SD * np.sqrt(np.mean(medians**2)))
    size = rms(read) / noise
    odds = float(3 * len(rows) * np.log(np.hypot(size, 1) / np.hypot(off, 1)))
    if np.linalg.norm(found.x[:3]) > 10 * other.check.spacing_m or np.abs(found.x[3:6]).max() > 0.3:
        odds = -np.inf  # it has left the place
    return _Match(pose, sign, off, off * noise, odds)


def _two(values: Floats) -> tuple[Floats, Floats]:
    """Return shift (3,) and turn (3,) of the values of a fit."""
    return values[:3], values[3:6]


# --- one field for all --------------------------------------------------------------------------


@dataclass(frozen=True)
class _Joined:
    """Maps in one field, with their fit."""

    maps: Sequence[Checked]
    scans: Sequence[Scan]
    model: JoinedModel
    at: ProbeFit
    rows: NDArray[np.bool_]
    """Rows that are fitted. Shape (n,)."""
    width2: float
    """Prior variance of the amplitudes in T^2."""

    @classmethod
    def of(
        cls, maps: Sequence[Checked], starts: Sequence[Pose], pace: Pace, turn_rad: float
    ) -> _Joined:
        """Fit the poses, and what the probes have in common by the checks of the single maps."""
        scans, chosen = [], []
        for number, one in enumerate(maps):
            scan, usable, _ = scan_of(one.data)
            lines, most = scan_lines(scan.points), max(1, MOST_POINTS // len(maps))
            shared = usable & _within_others(maps, starts, number, scan.points)
            # lines that are left out regularly may be just those that other maps reach
            chosen.append(usable & some_lines(lines, usable, most)
                          | shared & some_lines(np.unique(lines, return_inverse=True)[1], shared,
                                                most))
            scans.append(scan)
        rows = np.concatenate(chosen)

        charges = Charges.around(*_around(maps, scans, starts))
        model = JoinedModel(charges, [scan.model(charges) for scan in scans], starts, turn_rad)
        best = model.with_terms(_kept(maps, model))
        at = best.perfect()
        fit = best.fit(at, rows)
        for number in range(1 + WEIGHTINGS):
            at = fit_probe(best, rows, fit, best.allowed(replace(
                at, amplitudes=fit.amplitudes, sigma=fit.sigma)))
            pace.advance(number + 1, 1 + WEIGHTINGS)
            if number < WEIGHTINGS:
                best = best.weighted(at, rows, fit.sigma**2 / fit.penalty)
            if not number:  # the prior width of the field, now that the poses are known
                fit = best.fit(at, rows)
        width2 = fit.sigma**2 / fit.penalty
        return cls(maps, scans, best, at, rows, width2)

    def with_terms(self) -> tuple[tuple[InstrumentTerm, ...], _Joined]:
        """Return the terms of the probe that are common, or of one map, and the fit with these."""
        open_terms, parameters = _own_terms(self.maps, self.model, self._shares())
        (whole,) = self._evidence(open_terms, self._overlap)
        kept = self.model.prior_sd > 0
        found = self
        at = np.flatnonzero(kept)
        if any(_stands_out(parameter, whole, at) for parameter in parameters):
            told = EvidenceByPart.of(
                list(self._evidence(open_terms, self._overlap, self._halves())))
            # that one probe or its electronics has another gain in a map is likelier than anything
            # else that differs between maps, whatever the overlap alone can tell
            new, _ = found_terms(parameters, told, kept, with_rivals=False)
            for number in range(1, len(self.maps)):  # those of components leave that of |B|
                gains = _gains_of(self.model, number)
                new[gains[0]] |= (new & ~kept)[gains[1:]].any()
            if (new & ~kept).any():
                found = self._with(new)
        common = [found._stated(parameter) for parameter in _common_terms(
            self.model, self._shares())]
        own = [found._stated(parameter) for parameter in parameters
               if found.model.prior_sd[list(parameter.own)].all()]
        return (*common, *own), found

    def displaced(self) -> tuple[Layer, ...]:
        """Return the layers of the overlaps that alone are displaced along their axis.

        The displacement of a layer is fitted beside the field and all that is fitted already. What
        grows along an axis (a scale, a turn, a field that the charges do not follow) displaces all
        layers, and is none of these. Where the field changes fast along an axis, a gain of 1 % of
        one component displaced a layer by 0.5 mm: gains that a map may have of its own must not
        explain the readings better, or the layer must be off beside them.
        """
        gains = self.model.prior_sd > 0
        gains[np.concatenate([_gains_of(self.model, one) for one in range(1, len(self.maps))])
              ] = True
        plain, beside_gains = (_Told.of(self, kept) for kept in (self.model.prior_sd > 0, gains))
        by_gains = beside_gains.gained - plain.gained
        places = [np.arange(len(self.model.any_sd))[self.model.placed(number)][:3]
                  for number in range(len(self.maps))]
        kept = self.model.prior_sd > 0
        kept[np.concatenate(places)] = True
        moved = self.model.with_terms(kept).by_parameter(self.at, self.rows)
        stated = np.vstack([scan.points for scan in self.scans])[self.rows]
        shared, found = self._overlap[self.rows], []
        for number, one in enumerate(self.maps):
            rows = np.flatnonzero(self.model.only(number, self.rows)[self.rows] & shared)
            along = (moved[rows][..., places[number]] / self.model.any_sd[places[number]]
                     @ self.model.pose(self.at, number).turn)
            numbers = one.layers(stated[rows])
            for axis, name in enumerate(COMPONENTS):
                layers, owner, count = np.unique(
                    numbers[:, axis], return_inverse=True, return_counts=True)
                large = np.flatnonzero(count >= FEWEST_IN_LAYER)
                if len(large) < FEWEST_LAYERS:
                    continue
                columns = np.zeros((*moved.shape[:2], len(large)))
                for column, layer in enumerate(large):
                    of_layer = owner.ravel() == layer
                    columns[rows[of_layer], :, column] = along[of_layer, :, axis]
                (off, sd), beside = (told.off(columns.reshape(-1, len(large)))
                                     for told in (plain, beside_gains))
                out = (_out_of_line(off, sd) & ((off / sd)**2 > by_gains)) | _out_of_line(*beside)
                found += [Layer(
                    one.name, name, float(np.median(stated[rows][owner.ravel() == large[layer],
                                                                 axis])),
                    int(np.sum(one.layers(one.points)[:, axis] == layers[large[layer]])),
                    float(off[layer]), float(sd[layer])) for layer in np.flatnonzero(out)]
        return tuple(found)

    def _with(self, kept: NDArray[np.bool_]) -> _Joined:
        """Return the fit with other terms of the probe."""
        model = self.model.with_terms(kept)
        fit = model.fit(self.at, self.rows)
        return replace(self, model=model, at=fit_probe(
            model, self.rows, fit, replace(self.at, prior_sd=model.prior_sd)))

    def _evidence(
        self, open_terms: NDArray[np.bool_], rows: NDArray[np.bool_],
        halves: Sequence[NDArray[np.bool_]] = (),
    ) -> Iterator[Evidence]:
        """Return what some rows tell of some terms of the probe, and what halves of them do."""
        return Evidence.of(self.model.with_terms(open_terms), rows, self.at, self.width2, halves)

    @property
    def _overlap(self) -> NDArray[np.bool_]:
        """The rows that are fitted, of points that another map has around them."""
        return self.rows & np.concatenate([self._shared(number)
                                           for number in range(len(self.maps))])

    def _halves(self) -> list[NDArray[np.bool_]]:
        """Return one half of the rows along x, y and z each, which halve the overlaps."""
        places, found = self._points(), []
        for column in places.T:
            middle = float(np.median(column[self._overlap]))
            found.append(self.rows & (column <= middle))
        return found

    def _beyond(self, places: Ints) -> Floats:
        """Return by how many bars the halves scatter about the whole (p,) in numbers of poses."""
        whole, *halves = self._evidence(self.model.prior_sd > 0, self.rows, self._halves())
        used = np.flatnonzero(self.model.prior_sd > 0)
        chosen = np.searchsorted(used, places)
        (value, bars), *parts = [(mean[chosen], np.diag(covariance)[chosen]) for mean, covariance
                                 in (told.estimate(used) for told in (whole, *halves))]
        squares = [(mean - value)**2 / np.maximum(own - bars, 0.1 * own) for mean, own in parts]
        return np.asarray(np.sqrt(np.mean(squares, axis=0)))

    def _covariance(self, places: Ints, wider: Floats) -> Floats:
        """Return the covariance (p, p) of numbers of poses whose bars are ``wider`` (p,) times.

        A pole is the same from everywhere around it, and far sources are nearly so: a turn about
        them changes the readings only by what is not known of their field. Of such information
        there is left what exceeds `FEIGNED` times that of fields which the readings leave open.
        """
        state = State.of(self.model, self.at, self.rows, self.width2)
        design, left, _ = state.normal()
        there, none = design.T @ left, state.feigned()
        whole = there + none + 1e-12 * np.trace(there) * np.eye(len(there))
        share, vectors = linalg.eigh(there, whole)
        share = np.maximum(share - FEIGNED * (1 - share), 0.0)
        known = (whole @ vectors * share) @ (whole @ vectors).T / self.at.sigma**2
        by_prior, scale = np.ones(len(there)), np.ones(len(there))
        by_prior[places], scale[places] = 1 / START_OFF**2, wider
        stated = places[self.model.any_sd[places] < np.tile(PLACED_SD[:6], len(places) // 6)]
        by_prior[stated] = 1.0  # where a turn is known, the fit starts from there
        found = np.linalg.inv(known / np.outer(scale, scale) + np.diag(by_prior))
        sd = self.model.prior_sd[places]
        found = found[np.ix_(places, places)] * np.outer(sd, sd)
        for first in range(0, len(places), 6):  # a large turn goes along a circle, no line
            shift, turn = (np.trace(found[part, part]) for part in (
                slice(first, first + 3), slice(first + 3, first + 6)))
            found[range(first, first + 3), range(first, first + 3)] += shift * turn / 4
        return np.asarray(found)

    def _shares(self) -> Floats:
        """Return how much gains and crosstalk change |B|, see `ProbeModel.shares`."""
        field = self.model.charges.field(self._points(), self.at.amplitudes)
        return np.asarray(field.T @ field / np.sum(field**2))

    def _points(self) -> Floats:
        """Return all points (n, 3) in the frame of the first map."""
        return np.vstack([self.model.pose(self.at, number).places(scan.points)
                          for number, scan in enumerate(self.scans)])

    def _shared(self, number: int) -> NDArray[np.bool_]:
        """Return which points of a map any other map has around them."""
        poses = [self.model.pose(self.at, one) for one in range(len(self.maps))]
        return _within_others(self.maps, poses, number, self.scans[number].points)

    def _stated(self, parameter: Parameter) -> InstrumentTerm:
        """Return a term of the probe as all maps show it."""
        row = np.where(self.model.prior_sd > 0, parameter.row, 0.0)  # without what is not fitted
        value, sd = float(row @ self.at.instrument), float(np.sqrt(row @ self.at.covariance @ row))
        return InstrumentTerm(parameter.name, parameter.unit, value, sd, True, True)

    def overlaps(self) -> tuple[Overlap, ...]:
        """Compare the readings of each map in its overlaps with what the other maps predict."""
        sigma = self._noise()
        at, found = replace(self.at, sigma=sigma), []
        for number, one in enumerate(self.maps):
            own = self.model.only(number, self.rows)
            shared = own.copy()
            shared[self.model.rows_of(number)] &= self._shared(number)
            if not shared.any():  # it may reach around a map between its own points
                continue
            rest = State.of(self.model, at, self.rows & ~own, self.width2)
            both = State.of(self.model, at, (self.rows & ~own) | shared, self.width2)
            alone = self.model.alone(at, number, self.rows, self.width2)
            count = 3 * int(shared.sum())
            limit = max(DISAGREES, float(special.chdtri(count, BY_CHANCE)) / count)
            left, left_alone = (
                rms((self.model.field - self.model.readings(fit))[shared])
                for fit in (self.at, alone.at))
            found.append(Overlap(one.name, count, (both.chi2 - rest.chi2) / count, limit,
                                 left, left_alone))
        return tuple(found)

    def _noise(self) -> float:
        """Return the noise in T of a reading of mean weight that fields of each map alone leave."""
        squares = count = 0.0
        for number in range(len(self.maps)):
            alone = self.model.alone(self.at, number, self.rows, self.width2)
            squares += float(alone.left @ alone.left)
            count += alone.free.trace
        return float(np.sqrt(squares / max(count, 1.0)))

    def result(
        self, signs: Sequence[int], terms: tuple[InstrumentTerm, ...],
        overlaps: tuple[Overlap, ...],
    ) -> JoinedMaps:
        """Return the poses with their covariance.

        The largest chi2 of an overlap widens it, and so does what its halves say: positions that
        are off and what the charges do not follow are no noise, but differ by region.
        """
        wider = max(1.0, *(one.chi2 for one in overlaps))
        model, numbers = self.model, range(1, len(self.maps))
        places = np.concatenate([np.arange(len(model.any_sd))[model.placed(number)][:6]
                                 for number in numbers])
        covariance = self._covariance(places, np.maximum(np.sqrt(wider), self._beyond(places)))
        poses = []
        for number in numbers:
            pose, middle = model.pose(self.at, number), model.middles[number]
            bars = np.sqrt(np.diag(covariance))[6 * (number - 1):6 * number]
            poses.append(MapPose(
                self.maps[number].name, middle, pose.places(middle) - middle, bars[:3],
                Rotation.from_matrix(pose.turn).as_rotvec(), bars[3:], signs[number]))
        widened = tuple(replace(term, sd=float(np.sqrt(wider)) * term.sd) for term in terms)
        return JoinedMaps({one.name: one.check for one in self.maps}, tuple(poses), covariance,
                          widened, overlaps, self._data())

    def _data(self) -> xr.Dataset:
        """Return the joined map, see `JoinedMaps`.

        What the common probe reads at the place follows from the field, what the fit leaves of a
        reading from the map. Places are those of a stage whose scale is right.
        """
        value = self.at.instrument * self.model.prior_sd
        there = [self.model.pose(self.at, number).places(
            scan.points + value[SCALES] * from_middle(scan.points))
            for number, scan in enumerate(self.scans)]
        first = JoinedModel(self.model.charges, [replace(scan, points=points).model(
            self.model.charges) for scan, points in zip(self.scans, there, strict=True)],
            [Pose(np.eye(3), np.zeros(3))] * len(there))
        value[SCALES] = value[TERMS:] = 0.0
        common = replace(self.at, instrument=value / np.where(
            first.prior_sd > 0, first.prior_sd, np.inf))
        left, read = self.model.field - self.model.readings(self.at), first.readings(common)
        for number in range(len(there)):
            part = self.model.rows_of(number)
            read[part] += left[part] @ self.model.pose(self.at, number).turn.T
        data = field_map(np.vstack(there), read, self._sigma())
        return data.assign_coords(scan=("point", np.concatenate(
            [_scans(one) for one in self.maps])))


    def _sigma(self) -> Floats | None:
        """Return the noise (n, 3) in T that the maps state of their readings; None if none does.

        A map that states none has that of its check.
        """
        if not any("sigma_T" in one.data for one in self.maps):
            return None
        squares = []
        for number, one in enumerate(self.maps):
            sigma = (one.data["sigma_T"].values if "sigma_T" in one.data
                     else np.full((len(one.points), 3), one.check.noise_T))
            squares.append(sigma**2 @ (self.model.pose(self.at, number).turn**2).T)
        return np.asarray(np.sqrt(np.vstack(squares)))


@dataclass(frozen=True)
class _Told:
    """What the readings tell of other causes beside the field and some terms."""

    state: State
    left: Floats
    """What the field leaves of the design of the terms. Shape (m, p)."""
    covariance: Floats
    """Of the terms, relative to sigma^2. Shape (p, p)."""
    step: Floats
    """By which the terms fit best. Shape (p,)."""
    gained: float
    """By how much chi2 is smaller then."""

    @classmethod
    def of(cls, joined: _Joined, kept: NDArray[np.bool_]) -> _Told:
        """Return it of a fit, with other terms ``kept`` (p,)."""
        model = joined.model.with_terms(kept)
        state = State.of(model, model.allowed(joined.at), joined.rows, joined.width2)
        _, left, covariance = state.normal()
        slope = left.T @ state.left - state.at.sigma**2 * state.at.instrument
        step = covariance @ slope
        return cls(state, left, covariance, step, float(slope @ step) / state.at.sigma**2)

    def off(self, columns: Floats) -> tuple[Floats, Floats]:
        """Return values (n,), and their standard deviations, of causes with derivatives (m, n)."""
        by_design = self.left.T @ columns
        known = (np.sum(columns * self.state.free.left(columns), axis=0)
                 - np.sum(by_design * (self.covariance @ by_design), axis=0))
        return ((columns.T @ self.state.left - by_design.T @ self.step) / known,
                self.state.at.sigma / np.sqrt(known))


def _as_stated(maps: Sequence[Checked], poses: Sequence[Pose]) -> list[Pose]:
    """Return poses that are turned by right angles only, with the overlaps where they are."""
    found = []
    for number, (one, pose) in enumerate(zip(maps, poses, strict=True)):
        shared = _within_others(maps, poses, number, one.points)
        middle = one.points[shared if shared.any() else slice(None)].mean(axis=0)
        turn = np.round(pose.turn)
        found.append(Pose(turn, pose.places(middle) - turn @ middle))
    return found


def _within_others(
    maps: Sequence[Checked], poses: Sequence[Pose], number: int, points: Floats
) -> NDArray[np.bool_]:
    """Return which points (n, 3) of a map, in its coordinates, any other map has around them."""
    there = poses[number].places(points)
    found = np.zeros(len(there), bool)
    for other, (one, pose) in enumerate(zip(maps, poses, strict=True)):
        if other != number:
            found |= one.holds(pose.inverse.places(there))
    return found


def _scans(one: Checked) -> NDArray[np.str_]:
    """Return the names (n,) of the scans of a joined map."""
    if "scan" not in one.data:
        return np.full(len(one.points), one.name)
    return np.array([f"{one.name} {scan}" for scan in one.data["scan"].values])


def _around(
    maps: Sequence[Checked], scans: Sequence[Scan], starts: Sequence[Pose]
) -> tuple[Floats, float]:
    """Return the points (n, 3) in m of all maps, and the distance in m of the charges from them.

    It is that of the map which needs the nearest ones, or larger, until they are close together.
    """
    points = np.vstack([start.places(scan.points)
                        for start, scan in zip(starts, scans, strict=True)])
    gap = min(one.check.gap_m for one in maps)
    while spacing_of(points, gap) > TOO_FAR_APART * gap:
        gap *= 1.1
    return points, gap


def _out_of_line(off: Floats, sd: Floats) -> NDArray[np.bool_]:
    """Tell which of the displacements (n,) of layers, with bars (n,), are of one layer only."""
    found = np.zeros(len(off), bool)
    for number in np.flatnonzero(np.abs(off) > STANDS_OFF * sd):
        others = np.delete(off, number)
        middle = np.median(others)
        scatter = max(MAD_TO_SD * float(np.median(np.abs(others - middle))), float(sd[number]))
        found[number] = abs(off[number] - middle) > OUT_OF_LINE * scatter
    return found


COMMON = np.zeros(TERMS, bool)
"""Terms that probe and stage have in every map; turns, drifts and offsets are of one scan."""
COMMON[[*range(TERMS)[SENSORS], *range(TERMS)[MIXING], LAG, *range(TERMS)[SCALES]]] = True


GAINS_OF_AXES = range(MIXING.stop - 3, MIXING.stop)
"""Gains of single components, without that of |B|."""


def _kept(maps: Sequence[Checked], model: JoinedModel) -> NDArray[np.bool_]:
    """Return which terms are fitted: those of a probe that the checks have found, and the poses.

    What changes during a scan is not taken from the check of a map alone. A stage that goes along
    the magnet makes a drift of the gain one along the field, which what the charges do not follow
    may feign: 3 % in a map of a dipole moved its neighbour by 0.2 mm, 7 bars. A gain of a component
    that another check contradicts is one of its map only, too. A scale must be found with
    certainty: one of 0.9 % along y, which a map near the blocks preferred to gains, moved its
    neighbour by 0.6 mm.
    """
    kept = np.zeros(len(model.any_sd), bool)
    for number, one in enumerate(maps):
        for parameter in all_parameters(np.array(PRIOR_SD), np.eye(3) / 3):
            own = list(parameter.own)
            is_scale = own[0] in range(TERMS)[SCALES]
            if any((term.found if is_scale else term.is_chosen) and term.name == parameter.name
                   for term in one.check.terms):
                kept[own] |= COMMON[own]
                if number and own[0] in GAINS_OF_AXES and _contradicted(
                        one, maps, own[0] - GAINS_OF_AXES.start):
                    kept[_gains_of(model, number)] = True
        if number:
            kept[np.arange(len(kept))[model.placed(number)][:6]] = True
    return kept


def _contradicted(one: Checked, maps: Sequence[Checked], axis: int) -> bool:
    """Tell whether the check of another map has another gain of a component of the probe.

    Gains are compared with those of the other components: that of |B| is of the component along
    which the field is, in the bore of a dipole another one than at its end.
    """
    value, variance = _gains(one)
    for theirs, their_variance in map(_gains, maps):
        off, variances = value - theirs, variance + their_variance
        if (np.abs(off[axis] - off) > SIGNIFICANT * np.sqrt(variances[axis] + variances)).any():
            return True
    return False


def _gains(one: Checked) -> tuple[Floats, Floats]:
    """Return the gain of each component relative to that of |B| in %, and its variance, (3,) each,
    but for what maps of one stage have in common.

    A component along which the field is has none: it is that of |B|.
    """
    terms = {term.name: term for term in one.check.terms}
    value, sd = np.array([(terms[name].value, terms[name].own_sd) if name in terms else (0.0, 0.0)
                          for name in (f"gain of B{axis} relative to that of |B|"
                                       for axis in COMPONENTS)]).T
    return value, sd**2


def _gains_of(model: JoinedModel, number: int) -> Ints:
    """Return the places in the instrument of a map's gain of |B|, and of those of its components.

    The latter leave the mean of all three as it is.
    """
    return np.array([model.placed(number).start + GAIN, *(
        model.own(number).start + np.array(GAINS_OF_AXES))])


def _own_terms(
    maps: Sequence[Checked], model: JoinedModel, shares: Floats
) -> tuple[NDArray[np.bool_], list[Parameter]]:
    """Return the terms that may be of one map only, as parameters, and with all that are kept."""
    open_terms, found = model.prior_sd > 0, []
    for number, one in enumerate(maps):
        if not number:
            continue
        gain = model.placed(number).start + GAIN
        row = np.zeros(len(open_terms))
        row[gain] = 100 * model.any_sd[gain]
        mixing = np.arange(len(row))[model.own(number)][MIXING]  # which change |B| too, if kept
        row[mixing] = 100 * model.any_sd[mixing] * np.einsum("mij,ij->m", MATRICES, shares)
        found.append(Parameter(f"gain of {one.name} relative to {maps[0].name}", "%", row, (gain,)))
        open_terms[gain] = True
        first = model.own(number).start
        for parameter in all_parameters(model.any_sd[model.own(number)], shares):
            if parameter.row.any() and set(parameter.own) <= set(range(TERMS)[MIXING]):
                row = np.zeros(len(open_terms))
                row[model.own(number)] = parameter.row
                own = tuple(first + each for each in parameter.own)
                found.append(Parameter(f"{parameter.name}, in {one.name} only", parameter.unit,
                                       row, own))
                open_terms[list(own)] = True
    return open_terms, found


def _common_terms(model: JoinedModel, shares: Floats) -> list[Parameter]:
    """Return the terms that all maps have in common, as parameters."""
    found = []
    for parameter in all_parameters(model.any_sd[:TERMS], shares):
        own = list(parameter.own)
        if parameter.row.any() and COMMON[own].all() and (model.prior_sd[own] > 0).all():
            row = np.zeros(len(model.any_sd))
            row[:TERMS] = parameter.row
            found.append(Parameter(f"{parameter.name}, in all maps", parameter.unit, row,
                                   parameter.own))
    return found


def _stands_out(parameter: Parameter, told: Evidence, kept: NDArray[np.intp]) -> bool:
    """Tell whether a term differs from 0 by the readings of all maps."""
    used = np.union1d(kept, parameter.own)
    mean, covariance = told.estimate(used)
    row = parameter.row[used]
    return bool(abs(row @ mean) > SIGNIFICANT * np.sqrt(row @ covariance @ row))
