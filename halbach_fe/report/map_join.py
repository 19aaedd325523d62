"""Sentences, tables, files and page of maps that were joined."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import xarray as xr

from halbach_fe.core.files import make_folder, write_text
from halbach_fe.measurement.field_map import readings_sha256, write_map
from halbach_fe.measurement.map_join import JoinedMaps, MapPose
from halbach_fe.report.answer import Answer
from halbach_fe.report.map_check import write_map_check
from halbach_fe.report.page import write_page
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


def write_joined(
    maps: Mapping[str, xr.Dataset], joined: JoinedMaps, folder: Path,
    provenance: Mapping[str, str],
) -> None:
    """Write joined.json, joined.csv and joined.html, and a folder with the check of each map."""
    for name, data in maps.items():
        write_map_check(data, joined.checks[name], make_folder(folder / name),
                        {"map": provenance[f"map {name}"]})
    write_map(joined.data, folder / "joined.csv")
    summary = joined.plain() | {
        "maps_sha256": {name: readings_sha256(data) for name, data in maps.items()},
        "joined_sha256": readings_sha256(joined.data)}
    write_text(folder / "joined.json", json.dumps(summary, indent=1, allow_nan=False) + "\n")
    write_page(folder / "joined.html", "map_join.html.j2", [], provenance=provenance,
               answer=answer(joined), rows=pose_table(joined), found=sentences(joined),
               overlaps=overlap_table(joined), terms=term_table(joined))
