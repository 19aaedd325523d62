"""Sentences, tables and page of maps that were joined."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import xarray as xr

from halbach_fe.measurement.field_map import readings_sha256, write_map
from halbach_fe.measurement.map_join import JoinedMaps, MapPose
from halbach_fe.report import map_check
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import Items, Page, Section, Table, Text
from halbach_fe.report.words import flux_density, in_a_row, with_error
from halbach_fe.study.types import COMPONENTS


def answer(joined: JoinedMaps) -> Answer:
    """Say where the maps lie to each other, and whether they agree."""
    first, *others = joined.checks
    said = "; ".join(f"the middle of {pose.name} is {_shift(pose)} from where it would be if its "
                     f"stage were that of {first}" for pose in joined.poses)
    question = "Where do the maps lie to each other, and are they of one field?"
    if not joined.agree:
        worst = max(joined.overlaps, key=lambda one: one.chi2)
        return Answer(
            question, f"If they are of one field, {said}.",
            f"No: where {worst.name} overlaps other maps, the readings contradict each other, with "
            f"chi² {worst.chi2:.3g} per reading. The bars are widened by its root.",
            "Look for what changed between the maps: temperature, gain, positions of the stage.",
            sound=False)
    if turned := [pose.name for pose in joined.poses if pose.is_turned]:
        return Answer(
            question, f"{said[0].upper()}{said[1:]}.",
            f"Only if the stage of {in_a_row(turned)} stood turned by right angles: with the axes "
            "that it states, no place fits. A smooth field is much like itself elsewhere.",
            "Look how the stage stood, or measure with a larger overlap.", sound=False)
    if _open(joined):
        return Answer(
            question, f"{said[0].upper()}{said[1:]}.",
            f"Only in part: the overlap does not determine {in_a_row(_open(joined))}.",
            "Measure with a larger overlap, where the field changes along these axes.",
            sound=False)
    return Answer(
        question, f"{said[0].upper()}{said[1:]}.",
        f"Yes: where {in_a_row([first, *others])} overlap, chi² is at most "
        f"{max(one.chi2 for one in joined.overlaps):.2f} per reading; no magnet is assumed.",
        f"Find where the joined map, in the frame of {first}, lies in the magnet.",
        "halbach-fe register STUDY --measurements DIR/joined.csv -o DIR")


def _shift(pose: MapPose) -> str:
    """Return a shift in mm with its bars."""
    return "(" + ", ".join(with_error(1e3 * value, 1e3 * sd) for value, sd in zip(
        pose.shift_m, pose.shift_sd_m, strict=True)) + ")\u00a0mm"


def _open(joined: JoinedMaps) -> list[str]:
    """Return the parts of poses that no overlap determines."""
    names = [f"{what} {axis}" for what in ("shift along", "turn about") for axis in COMPONENTS]
    return [f"the {name} of {pose.name}" for pose in joined.poses
            for name, known in zip(names, pose.determined, strict=True) if not known]


def sentences(joined: JoinedMaps) -> list[str]:
    """Return what else was found."""
    found = [f"The readings of {pose.name} have the opposite sign of those of "
             f"{next(iter(joined.checks))}: the joined map has them reversed."
             for pose in joined.poses if pose.sign < 0]
    found += [f"{pose.name} fits only with its stage turned by right angles (rotation_rad). If it "
              "did not stand so, it does not overlap the other maps."
              for pose in joined.poses if pose.is_turned]
    found += [f"{one.name} contradicts the other maps where they overlap: chi² is {one.chi2:.3g} "
              f"per reading, rms {flux_density(one.rms_T)} by one field for all, "
              f"{flux_density(one.alone_T)} by a field of its own."
              for one in joined.overlaps if not one.agrees]
    return found


def pose_table(joined: JoinedMaps) -> list[dict[str, str]]:
    """Return the poses as rows of text."""
    return [{"map": pose.name} | {
        f"{axis} in mm": with_error(1e3 * pose.shift_m[number], 1e3 * pose.shift_sd_m[number])
        for number, axis in enumerate(COMPONENTS)} | {
        f"about {axis} in mrad": with_error(
            1e3 * pose.rotation_rad[number], 1e3 * pose.rotation_sd_rad[number])
        for number, axis in enumerate(COMPONENTS)} for pose in joined.poses]


def overlap_table(joined: JoinedMaps) -> list[dict[str, str]]:
    """Return the overlaps as rows of text."""
    return [{"map": one.name, "readings": str(one.readings), "chi² per reading": f"{one.chi2:.2f}",
             "alone, rms": flux_density(one.alone_T), "jointly, rms": flux_density(one.rms_T)}
            for one in joined.overlaps]


def term_table(joined: JoinedMaps) -> list[dict[str, str]]:
    """Return the terms of the instrument as rows of text."""
    return [{"parameter": term.name,
             "value": f"{with_error(term.value, term.sd)}\u00a0{term.unit}"}
            for term in joined.terms]


def page(maps: Mapping[str, xr.Dataset], joined: JoinedMaps) -> Page:
    """Return the page of joined maps, with that of the check of each map."""
    found, poses, terms = sentences(joined), pose_table(joined), term_table(joined)
    summary = joined.plain() | {
        "maps_sha256": {name: readings_sha256(data) for name, data in maps.items()},
        "joined_sha256": readings_sha256(joined.data)}
    return Page(
        "check", "Field maps, joined", None, answer(joined), summary, [
            Section([*([Items(found)] if found else []), Text(
                "No magnet is assumed. One field of sources outside all maps was fitted to them "
                "together with their relative poses; each map was checked by itself before.",
                "small")]),
            Section(["Shift of the middle of each map, and turn about it, in the frame of the "
                     "first map. joined.json has the covariance of all of them, and translation_m "
                     "and rotation_rad as a study's [instrument] has them.", Table(poses)],
                    "Where the maps lie"),
            Section(["chi² per reading compares the readings that other maps have around them with "
                     "what those maps predict, noise included; 1 is expected. The last columns are "
                     "what the fit leaves of these readings, with a field of the map alone and "
                     "with one field for all maps:", Table(overlap_table(joined))],
                    "Where they overlap"),
            Section([Table(terms) if terms else
                     "The maps show no error of the probe, neither a common one nor one that only "
                     "a part of them has: one gain explains all."], "The instrument")],
        {"Where the maps lie in the frame of the first one": poses,
         "The instrument, by all maps together": terms},
        files={"joined.csv": partial(write_map, joined.data)}, stem="joined", remarks=found,
        folders={name: map_check.page(data, joined.checks[name]) for name, data in maps.items()})
