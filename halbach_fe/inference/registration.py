"""The pose of one or several maps in the magnet, found from nothing, and the probe's axes.

A stage has coordinates of its own: its origin is somewhere, its axes point somewhere, and the axes
of the probe point elsewhere again. Two steps find the rotation and the translation that bring the
map's coordinates to those of the magnet.

1. Every rotation by right angles is combined with translations along the magnet's axis. The nominal
   blocks in vacuum and those of neighbouring magnets, multiplied by any factor, are compared with
   the map; the best candidates are improved by least squares, and those that end in the same place
   are one.
2. For each of the best, least squares with the magnet's own model: pose and probe are fitted
   together with the magnetizations of the blocks, whose prior is that of the study. The evidence
   compares the candidates. A symmetric magnet makes some of them equal, and all of these are
   results.

Of several maps the first is registered with the study's prior of the blocks, every later one with
the blocks as the maps before have updated them. A later map therefore also tells apart poses
between which the nominal magnet looks the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, StudyError, must_be
from halbach_fe.core.numbers import check_number
from halbach_fe.core.progress import QUIET_S, Pace, duration
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.pose_fit import PoseFit
from halbach_fe.inference.pose_result import OpenKey, PosePrior, ProbePrior, Registration, StagePose
from halbach_fe.inference.pose_search import coarse_poses, right_angles
from halbach_fe.measurement.campaign_maps import Map, refuse_unordered
from halbach_fe.measurement.doubted_terms import Term, doubts
from halbach_fe.measurement.field_map import checked_map, directed, is_undirected, taking_arrays
from halbach_fe.measurement.map_join import MapPose
from halbach_fe.measurement.probe_law import turn_of
from halbach_fe.solver.session import NOT_KEPT, Session, alone
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.measurement_keys import POSE_KEYS, PROBE_KEYS, Instrument, InstrumentSd
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS, look_like_mm

EQUAL_LOG_EVIDENCE = 0.1
"""Difference in log evidence up to which poses are equally probable: their odds are 1.1 : 1."""

UNDECIDED_LOG_EVIDENCE = 3.0
"""The same up to which readings do not decide between poses: odds of 20 : 1. Fits of poses that a
symmetric magnet makes equal end up to 1 apart, since they end when chi-squared hardly falls."""


@taking_arrays
@alone
def register(
    magnet: Magnet, data: xr.Dataset, session: Session = NOT_KEPT,
    probe: ProbePrior | None = None, open_keys: Sequence[OpenKey] = (),
    say: Callable[[str], None] = lambda _: None, blocks: Gaussian | None = None,
    pose: PosePrior | None = None, alternatives: Sequence[Sequence[OpenKey]] = (),
    most: int | None = None,
) -> list[Registration]:
    """Find the pose of a map in a magnet.

    Parameters
    ----------
    magnet : Magnet
        Its study states the noise, what is held out, and units, axes and law of the instrument; the
        pose that it states is not used.
    data : Dataset
        The map, see `halbach_fe.read_map`, with components along axes of one sign; see
        `halbach_fe.check_map`. A line of readings, or a single component, determines a part of the
        pose only; the prior holds the others, as the standard deviations say. A component of which
        nobody has said which it is is taken for Bx, By and Bz, and the evidence compares them.
    session : Session, optional
    probe : ProbePrior, optional
        By default that of the study's ``instrument_sd``, where it is wider than the usual one.
    open_keys : sequence of OpenKey, optional
        Numbers of the study that are fitted too.
    say : callable, optional
        Called with a description of each step before it starts, and now and then with what is left
        of a step that takes long.
    blocks : Gaussian, optional
        `Registration.blocks` of another map, which replace the study's prior.
    pose : PosePrior, optional
    alternatives : sequence of sequence of OpenKey, optional
        Other hypotheses: numbers that are fitted in place of ``open_keys``. The evidence compares
        all of them.
    most : int, optional
        Largest number of poses that every hypothesis fits, of those that the search finds.

    Returns
    -------
    list of Registration
        The most probable pose first, see `least_turned_first`.

    Raises
    ------
    MeasurementError
        If no pose puts the map's points in air, no pose explains half of its field, or none is
        turned as it is known to be; or if the map holds what none does.
    StudyError
        If the study is a cross-section, an open key is no number that it gives, or ``most`` is no
        whole number of at least 1.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("mri.toml"))
    >>> axis = 0.01 * np.arange(-2, 3)
    >>> points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    >>> displaced = hf.field_map(points - [0, 0, 0.001], magnet.field_T(points), 1e-5)
    >>> best = hf.register(magnet, displaced)[0]
    >>> np.round(best.instrument.translation_m, 4) + 0.0
    array([0.   , 0.   , 0.001])
    """
    if most is not None:
        check_number("most", "register", most, 1, whole=True)
    data = checked_map(data, "`data`")
    refuse_unordered("data", data, magnet.study)
    prior = pose or PosePrior()
    probe = probe or ProbePrior.of(magnet.study.instrument_sd)

    def fits_of(readings: xr.Dataset) -> list[PoseFit]:
        return [PoseFit.of(magnet, readings, session, probe, tuple(keys), prior, blocks)
                for keys in (open_keys, *alternatives)]

    if not is_undirected(data):
        return least_turned_first(_registered(fits_of(data), prior, most, say))
    found: list[Registration] = []
    refused: MeasurementError | None = None
    for name in COMPONENTS:
        say(f"taking the readings for those of B{name}")
        try:
            found += [replace(each, component=name) for each in _registered(
                fits_of(directed(data, name)), prior, most, say)]
        except MeasurementError as error:
            refused = error
    if refused is not None and not found:
        raise refused
    return least_turned_first(found)


def _registered(
    fits: Sequence[PoseFit], prior: PosePrior, most: int | None, say: Callable[[str], None]
) -> list[Registration]:
    """Return the poses of a map by some hypotheses about what is open, see `register`."""
    fit, magnet, pace = fits[0], fits[0].magnet, Pace(say)
    reach = float(np.hypot(magnet.radius, magnet.half_length))
    extent = np.linalg.norm(np.ptp(fit.points, axis=0))
    if look_like_mm(np.ptp(fit.points, axis=0)[None], reach)[0]:
        raise MeasurementError(must_be(
            "positions", "the map", f"within reach of the magnet, {reach:.2g} m from its middle",
            f"a map that extends over {extent:.3g} m", "Are they in millimetres? Then set "
            "instrument.length_unit_m = 0.001 in the study."))
    say("searching the pose among rotations by right angles and shifts along the axis")
    starts = coarse_poses(magnet, fit.points, fit.readings, fit.training, prior.sd(magnet)[0],
                          pace, fit.total)
    starts = [each for each in starts if fit.is_possible(np.zeros(len(fit.prior_sd())), each)]
    left_out = len(starts) - len(starts[:most])
    starts = starts[:most]
    if prior.stage is not None and starts:
        starts = _on_stage(starts, prior.stage)
    if not starts:
        raise MeasurementError(must_be(
            "map", "registration", "one that fits into the bore, or beside the magnet",
            "points inside blocks in every likely pose", "Check its unit of length."))
    found: list[Registration] = []
    by_fit: list[list[Registration]] = []
    begun = time.monotonic()
    for fit in fits:
        by_fit.append([])
        for number, start in enumerate(starts):
            what = f"fitting pose {number + 1} of {len(starts)} with the blocks" + (
                f" and {', '.join(each.key for each in fit.open)}" if fit.open else "")
            say(what + _time_left(begun, sum(map(len, by_fit)), len(starts) * len(fits)))
            pace.begin(f"{what}, steps of the fit")
            by_fit[-1].append(fit.refined(start, pace))
    best = max((each for own in by_fit for each in own), key=lambda each: each.log_evidence)
    for fit, own in zip(fits, by_fit, strict=True):
        # no hypothesis shall lose because it came to rest somewhere else
        if not any(each is best for each in own):
            own.append(fit.refined(np.append(best.middle_m, best.instrument.rotation_rad)))
        own.sort(key=lambda each: -each.log_evidence)
        found += [replace(each, left_out=left_out) for number, each in enumerate(own)
                  if not any(_same(each, other) for other in own[:number])]
    return found


def _time_left(begun: float, done: int, total: int) -> str:
    """Return words about the time left of fits that take long; nothing before the first."""
    left = (time.monotonic() - begun) * (total - done) / max(done, 1)
    return f" (about {duration(left)} left)" if done and left >= QUIET_S else ""


def least_turned_first(found: Sequence[Registration]) -> list[Registration]:
    """Return poses by their evidence, the likeliest first.

    Of those between which the readings do not decide, which a symmetric magnet makes equal, the one
    whose axes are turned least from those of the map is first: most people lay a map as they draw
    it.
    """
    ordered = sorted(found, key=lambda each: -each.log_evidence)
    equal = [each for each in ordered
             if each.log_evidence > ordered[0].log_evidence - UNDECIDED_LOG_EVIDENCE]
    first = min(equal, key=lambda each: (  # right angles, as small turns are for the readings
        round(float(np.linalg.norm(each.instrument.rotation_rad)) / (np.pi / 2)),
        -each.log_evidence))
    return [first, *(each for each in ordered if each is not first)]


def _on_stage(starts: Sequence[Floats], stage: StagePose) -> list[Floats]:
    """Return the poses (6,) on a stage near those that are turned like another map on it."""
    # Angle in rad up to which a map is turned like another on its stage: more than the error of the
    # search, and far less than between poses that a symmetric magnet makes equal.
    same_turn = 0.1
    apart = [float((Rotation.from_rotvec(each[3:]) * stage.turn.inv()).magnitude())
             for each in starts]
    found = [stage.nearest(each) for each, angle in zip(starts, apart, strict=True)
             if angle < same_turn]
    if not found:
        raise MeasurementError(must_be(
            "map", "registration", "turned like the one before it on the same stage",
            f"turned by {np.degrees(min(apart)):.2g}° against it",
            "Leave `stage` out, or check the axes of both files."))
    return found


def _same(one: Registration, other: Registration) -> bool:
    """Tell whether two fits have ended in the same place, within its standard deviation."""
    turn = Rotation.from_rotvec(one.instrument.rotation_rad) * Rotation.from_rotvec(
        other.instrument.rotation_rad).inv()
    moved, turned = np.abs(one.middle_m - other.middle_m), np.abs(turn.as_rotvec())
    return bool((moved < other.translation_sd_m).all() and (turned < other.rotation_sd_rad).all())


def odds(found: Sequence[Registration]) -> Floats:
    """Return the probabilities (n,) of poses among each other."""
    logs = np.array([each.log_evidence for each in found])
    weights = np.exp(logs - logs.max())
    return np.asarray(weights / weights.sum())


def turn_from_axes(instrument: Instrument) -> Floats:
    """Return the rotation vector (3,) in rad, in the magnet's axes, that remains after the map's
    axes were put along those of `axes_of_map`.
    """
    matrix = Rotation.from_rotvec(instrument.rotation_rad).as_matrix()
    return np.asarray(Rotation.from_matrix(
        matrix @ nearest_right_angles(instrument).T).as_rotvec())


def nearest_right_angles(instrument: Instrument) -> Floats:
    """Return the rotation by right angles (3, 3) that is nearest to that of a map."""
    matrix = Rotation.from_rotvec(instrument.rotation_rad).as_matrix()
    return max(right_angles(), key=lambda other: float(np.sum(other * matrix)))


def axes_of_map(instrument: Instrument) -> dict[str, str]:
    """Return for each axis of the map that of the magnet, such as ``-z``, by the rotation by right
    angles that is nearest.
    """
    matrix = nearest_right_angles(instrument)
    found: dict[str, str] = {}
    for number, name in enumerate(COMPONENTS):
        column = matrix[:, number]
        largest = int(np.abs(column).argmax())
        found[name] = ("-" if column[largest] < 0 else "") + COMPONENTS[largest]
    return found


Table = TypeVar("Table", Instrument, InstrumentSd)

Joined = tuple[str, tuple[MapPose, ...]]
"""The name of the map in whose frame others lie, and their poses, see `read_joined`."""


def register_maps(
    magnet: Magnet, maps: Sequence[Map], session: Session, open_keys: Sequence[OpenKey] = (),
    say: Callable[[str], None] = lambda _: None, joined: Joined | None = None,
) -> dict[str, list[Registration]]:
    """Find the poses of several maps in a magnet.

    Parameters
    ----------
    maps : sequence of Map
        In the order in which they are registered: best the one first that says most about the
        blocks. Maps of one probe have the probe that the first of them finds, and those on one
        stage are turned alike.
    open_keys : sequence of OpenKey, optional
        Numbers of the study that are fitted with the first map.
    say : callable, optional
        Called with a description of each step before it starts.
    joined : Joined, optional
        Where overlaps of the maps have them, without a magnet. A pose that contradicts it says so,
        and if all of them do, so does that of the map in whose frame they lie.

    Returns
    -------
    dict of str to list of Registration
        For each map its poses, the most probable one first, given the best poses of the maps
        before.

    Raises
    ------
    StudyError
        If ``joined`` has none of the maps.
    """
    known_poses = _known_poses(maps, joined)
    found: dict[str, list[Registration]] = {}
    blocks: Gaussian | None = None
    probes: dict[str, Registration] = {}
    stages: dict[str, Map] = {}
    for one in maps:
        study = one.study
        for key, (value, _) in (found[maps[0].name][0].open_keys.items() if found else ()):
            study = OpenKey(key, 1.0).apply(study, value)
        known = probes.get(one.probe)
        if known is not None:
            study = study.with_(instrument=_with_keys(
                study.instrument, known.instrument, PROBE_KEYS))
        say(f"map {one.name}")
        first = stages.setdefault(one.pose, one)
        pose = None if first is one else PosePrior(
            stage=_stage_pose(one, first, found[first.name][0]))
        found[one.name] = register(
            magnet.with_study(study), one.data, session.within(one.name),
            None if known is None else _of_known_probe(known, study.instrument_sd),
            () if found else open_keys, say, blocks, pose)
        blocks = found[one.name][0].blocks
        probes.setdefault(one.probe, found[one.name][0])
    if joined is not None:
        frame = found[joined[0]][0]
        apart = {name: contradictions(found[name][0], by_overlap, frame)
                 for name, by_overlap in known_poses.items()}
        if all(apart.values()):  # the frame may be the one that lies wrong
            nearest = min(apart.values(), key=lambda terms: terms[0].distance)
            apart[joined[0]] = tuple(replace(term, value=-term.value) for term in nearest)
        for name, terms in apart.items():
            best, *others = found[name]
            found[name] = [replace(best, apart=terms), *others]
    return found


def _known_poses(maps: Sequence[Map], joined: Joined | None) -> dict[str, MapPose]:
    """Return what overlaps say of the maps; StudyError if that is nothing."""
    if joined is None:
        return {}
    frame, poses = joined
    names = [one.name for one in maps]
    known = {one.name: one for one in poses if one.name in names and frame in names}
    if not known:
        raise StudyError(must_be(
            "joined maps", "the campaign", f"of at least two of its maps ({', '.join(names)})",
            f"of {', '.join([frame, *(one.name for one in poses)])}",
            "Name the maps in the study as their files are named that `halbach-fe check` joined."))
    (own,) = (one for one in maps if one.name == frame)
    first = next(one for one in maps if one.pose == own.pose)
    if first is not own:  # the study states where maps lie by the first one of their stage
        raise StudyError(must_be(
            "joined maps", "the campaign", f"in the frame of the first map of their stage, "
            f"{first.name}", f"in that of {frame}", f"List {frame} before {first.name} in the "
            f"study, or join the maps again with {first.name} first."))
    return known


def contradictions(best: Registration, known: MapPose, frame: Registration) -> tuple[Term, ...]:
    """Return the numbers of a pose that contradict where a map lies in the frame of another one.

    A turn of the frame moves what is off its middle.
    """
    own, other = turn_of(best.instrument), turn_of(frame.instrument)
    by_overlap = known.middle_m + known.shift_m
    arm = other.apply(by_overlap) + frame.instrument.translation_m - frame.middle_m
    off = other.inv().apply(own.apply(known.middle_m) + best.instrument.translation_m
                            - frame.instrument.translation_m) - by_overlap
    turn = (other.inv() * own * Rotation.from_rotvec(known.rotation_rad).inv()).as_rotvec()
    axes = other.inv().as_matrix()**2  # bars of the magnet's axes along those of the stage
    placed = axes @ (best.translation_sd_m**2 + frame.translation_sd_m**2
                     + moved_by_turns(arm, frame.rotation_sd_rad)**2)
    turned = axes @ (best.rotation_sd_rad**2 + frame.rotation_sd_rad**2)
    return doubts([
        Term(f"{kind}_{axis}", unit, value, float(np.hypot(np.sqrt(square), sd)))
        for kind, unit, values, squares, bars in (
            ("along", "m", off, placed, known.shift_sd_m),
            ("about", "rad", turn, turned, known.rotation_sd_rad))
        for axis, value, square, sd in zip("xyz", values.tolist(), squares, bars, strict=True)])


def moved_by_turns(arm: Floats, sd: Floats) -> Floats:
    """Return the standard deviations (3,) in m by which uncertain turns (3,) move an arm's end."""
    return np.sqrt([arm[[1, 2]]**2 @ sd[[2, 1]]**2, arm[[2, 0]]**2 @ sd[[0, 2]]**2,
                    arm[[0, 1]]**2 @ sd[[1, 0]]**2])


def _of_known_probe(first: Registration, stated: InstrumentSd) -> ProbePrior:
    """Return what is open of a probe that another map has found, but for its offsets, which change
    from map to map. Of a probe of |B| neither axes nor sensors were found.
    """
    usual = ProbePrior.of(stated)
    return replace(usual, gain=first.probe.gain) if first.total else replace(
        first.probe, offset_T=usual.offset_T)


def registered_study(
    study: Study, maps: Sequence[Map], found: dict[str, list[Registration]],
    joined: Joined | None = None,
) -> Study:
    """Return the study of a campaign with the most probable pose of each map.

    What overlaps say of a map on the stage of the one in whose frame it lies is a datum of the
    update: its place is that of the overlap, and its own shift is as uncertain as that.
    """
    known_poses = _known_poses(maps, joined)
    probes: dict[str, Study] = {}
    stages: dict[str, tuple[Map, Study]] = {}
    listed = []
    for each, one in zip(study.maps, maps, strict=True):
        own = found[one.name][0].study
        probe = probes.setdefault(one.probe, own)
        instrument = _with_keys(own.instrument, probe.instrument, PROBE_KEYS)
        first, of_first = stages.setdefault(one.pose, (one, own))
        if first is not one:
            instrument = _moved_along(one, instrument, first, of_first.instrument)
            known = known_poses.get(one.name)
            if known is not None and joined is not None and joined[0] == first.name:
                instrument = _placed(instrument, known, of_first.instrument)
                each = each.with_(stage_shift_sd_m=tuple(known.shift_sd_m.tolist()))
        listed.append(each.with_(instrument=instrument, instrument_sd=_with_keys(
            _with_keys(own.instrument_sd, probe.instrument_sd, PROBE_KEYS),
            of_first.instrument_sd, POSE_KEYS)))
    study = study.with_(maps=tuple(listed))
    for key, (value, _) in found[maps[0].name][0].open_keys.items():
        study = OpenKey(key, 1.0).apply(study, value)
    return study


def _stage_pose(one: Map, first: Map, found: Registration) -> StagePose:
    """Return where a map lies by the first one on its stage."""
    turn, apart = _relative(one, first)
    stage = turn_of(found.instrument)
    arm = stage.apply(turn.apply(one.middle_m) + apart - first.middle_m)
    moved = moved_by_turns(arm, found.rotation_sd_rad)
    return StagePose(
        stage * turn, stage.apply(turn.apply(one.middle_m) + apart)
        + found.instrument.translation_m, stage.as_matrix(), np.array(one.shift_sd_m),
        np.hypot(found.translation_sd_m, moved), found.rotation_sd_rad)


def _moved_along(
    one: Map, instrument: Instrument, first: Map, of_first: Instrument
) -> Instrument:
    """Return an instrument at the place on a stage that is nearest to where it was found.

    From its place relative to the first map, which the study states, it moves only along those axes
    of the stage that are open.
    """
    turn, apart = _relative(one, first)
    stage = turn_of(of_first)
    place = turn_of(instrument).apply(one.middle_m) + instrument.translation_m
    shift = (stage.inv().apply(place - of_first.translation_m)
             - turn.apply(one.middle_m) - apart)
    shift[np.array(one.shift_sd_m) == 0] = 0.0
    x, y, z = (stage.apply(apart + shift) + of_first.translation_m).tolist()
    alpha, beta, gamma = (stage * turn).as_rotvec().tolist()
    return instrument.with_(translation_m=(x, y, z), rotation_rad=(alpha, beta, gamma))


def _placed(instrument: Instrument, known: MapPose, of_frame: Instrument) -> Instrument:
    """Return an instrument, turned as it is, with the middle of its map where an overlap has it."""
    place = turn_of(of_frame).apply(known.middle_m + known.shift_m) + of_frame.translation_m
    x, y, z = (place - turn_of(instrument).apply(known.middle_m)).tolist()
    return instrument.with_(translation_m=(x, y, z))


def _relative(one: Map, first: Map) -> tuple[Rotation, Floats]:
    """Return the turn, and the place (3,) in m, of a map against the first one on its stage."""
    own, other = one.study.instrument, first.study.instrument
    back = turn_of(other).inv()
    return back * turn_of(own), back.apply(np.subtract(own.translation_m, other.translation_m))


def _with_keys(table: Table, other: Table, keys: Sequence[str]) -> Table:
    """Return an instrument, or what is open of it, with some keys of another."""
    return table.with_(**{key: getattr(other, key) for key in keys if hasattr(other, key)})
