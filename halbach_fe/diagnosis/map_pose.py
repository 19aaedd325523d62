"""Find from nothing where maps lie whose stated place explains nothing.

A stage has coordinates of its own. A map in these may be half a metre away from where the study
says, and turned by a right angle and a few degrees. No effect of the catalogue, and no gross error
of units or axes, reaches so far, and so such maps are registered before anything else is compared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from halbach_fe.core.errors import MeasurementError
from halbach_fe.diagnosis.gross_errors import MIN_READINGS, misfit_of
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.campaign_registration import register_maps, registered_study
from halbach_fe.inference.pose_result import Registration
from halbach_fe.inference.registration import axes_of_map, odds, register
from halbach_fe.measurement.campaign import Data, maps_of
from halbach_fe.solver.session import Session
from halbach_fe.study.inference import InstrumentSd
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.model import Study

MIN_MISFIT_OF_A_POSE = 0.3
"""Smallest misfit of a map in its stated place, relative to the map's rms, from which its pose is
searched. In a bore of radius 20 mm a displacement by 4 mm leaves up to 0.13 and one by 6 mm, which
is found as a gross error, up to 0.2."""


@dataclass(frozen=True)
class FoundPose:
    """Where a map lies, found from nothing.

    Attributes
    ----------
    best : Registration
        The most probable pose.
    instrument : Instrument
        The instrument of the study with that pose.
    open : InstrumentSd
        How far that pose, and the probe, are open from then on.
    others : tuple of float
        Probabilities of the other poses that the map hardly tells from the best one.
    misfit_before, misfit_after : float
        Rms difference from the nominal magnet in the stated and in the best pose, relative to the
        map's rms; infinite for points that the study states inside of material.
    map : str or None
        Name of the map among those that the study lists; None if it lists none.
    """

    best: Registration
    instrument: Instrument
    open: InstrumentSd
    others: tuple[float, ...]
    misfit_before: float
    misfit_after: float
    map: str | None = None

    @property
    def text(self) -> str:
        """Where the map lies, in words."""
        place = ", ".join(
            f"{1e3 * value:.2f} ± {1e3 * sd:.2g}" for value, sd in zip(
                self.best.middle_m, self.best.translation_sd_m, strict=True)).replace("-", "−")
        axes = ", ".join(f"{name} along {axis}" for name, axis in axes_of_map(
            self.best.instrument).items()).replace("-", "−")
        return (f"the middle of {f'map {self.map}' if self.map else 'the map'} lies at ({place}) "
                f"mm in the magnet, with its axis {axes} of the magnet")


def with_poses(study: Study, poses: Sequence[FoundPose]) -> Study:
    """Return the study with its maps in these poses, all at once: they may share probe and stage,
    whose terms must agree.
    """
    tables = {one.map or "": {"instrument": one.instrument, "instrument_sd": one.open}
              for one in poses}
    return study.with_(**tables[""]) if "" in tables else study.with_tables(tables)


def misfits_of(study: Study, data: Data) -> dict[str, float]:
    """Return the `misfit_of` of each map in its stated place, by name.

    It is 0 for maps with so few readings that some pose would fit any of them.
    """
    return {one.name: misfit_of(one.study, one.data) if one.data["B_T"].notnull().sum()
            >= MIN_READINGS else 0.0 for one in maps_of(study, data)}


def find_poses(
    study: Study, data: Data, session: Session, say: Callable[[str], None]
) -> tuple[tuple[FoundPose, ...], Study]:
    """Register the maps if one of them is far from the magnet's field where the study states it.

    Several maps of one study are registered together, since a stage may be common to them.

    Parameters
    ----------
    study : Study
        Corrected for gross errors.
    data : Dataset or dict of str to Dataset
        The map, or the maps that the study lists.
    session : Session
    say : callable
        Called with a description of each step before it starts.

    Returns
    -------
    poses : tuple of FoundPose
        Empty if the maps lie about where the study says, if no pose explains them, or if the study
        is a cross-section.
    study : Study
        The study with the instruments of these poses.
    """
    possible = 0.05  # odds from which another pose is named beside the best one
    min_reduction = 3.0  # factor by which the registered pose must reduce the misfit to be believed
    before = misfits_of(study, data)
    if study.dimension == 2 or max(before.values()) < MIN_MISFIT_OF_A_POSE:
        return (), study
    several, maps = isinstance(data, dict), maps_of(study, data)
    say("the field is not that of the place that the study states: searching the pose")
    magnet = build_magnet(study.with_(maps=()))
    try:
        if several:
            found = register_maps(magnet, maps, session, say=say)
            registered = registered_study(study, maps, found)
        else:
            found = {maps[0].name: register(magnet, maps[0].data, session, say=say)}
            registered = found[maps[0].name][0].study
    except MeasurementError as error:
        say(f"no pose explains the map: {error}")
        return (), study
    after = misfits_of(registered, data)
    # misfit that is good enough even if it was not larger in the stated place: of a map that lies
    # right beside another one that does not
    good = 0.05
    if any(after[name] > min(MIN_MISFIT_OF_A_POSE, max(misfit / min_reduction, good))
           for name, misfit in before.items()):
        say("no pose explains the map")
        return (), study
    poses = [FoundPose(
        found[one.name][0], one.study.instrument, one.study.instrument_sd,
        tuple(float(each) for each in odds(found[one.name])[1:] if each > possible),
        before[one.name], after[one.name], one.name if several else None)
        for one in maps_of(registered, data)]
    return tuple(poses), with_poses(study, poses)
