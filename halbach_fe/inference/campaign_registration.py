"""The poses of several maps in one magnet.

The first map is registered with the study's prior of the blocks, every later one with the blocks as
the maps before have updated them. A later map therefore also tells apart poses between which the
nominal magnet looks the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.pose_result import OpenKey, PosePrior, ProbePrior, Registration, StagePose
from halbach_fe.inference.registration import register
from halbach_fe.measurement.campaign import Map
from halbach_fe.measurement.doubted_terms import Term, doubts
from halbach_fe.measurement.instrument import turn_of
from halbach_fe.measurement.map_join import MapPose
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.inference import POSE_KEYS, PROBE_KEYS, InstrumentSd
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.model import Study

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
