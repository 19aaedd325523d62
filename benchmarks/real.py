"""Measured magnets, from the raw map to the updated model, on lines of the scan that were held out.

Every fifth line is set aside before anything is fitted: by the check, the registration and the
update alike. The floor is that of Maxwell's check, which assumes no magnet. Studies with a target
in the Makefile are made by it.
"""

from __future__ import annotations

import csv
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import main
from halbach_fe.core.errors import HalbachError
from halbach_fe.measurement.field_map import field_map, write_map

ROOT = Path(__file__).parents[1]
STUDIES = ROOT / "studies"

FASER_STEP_M = 0.010
"""Step of the profile from which the registration starts; it is not published."""

FASER_FRINGE = (35, 121)
"""Last and first index of the fringe field, as published."""

WITHIN = 1.96
"""Standard deviations of the interval that holds 95 %."""


def emphatic(note: Note) -> None:
    """Note the figures of the spectrometer dipole, updated by both of its maps."""
    folder = _made("emphatic")
    inferred = folder / "measured"
    _note_figures(note, "real", "body_scan.csv", folder / "body", folder / "registered" / "body",
                  inferred, "body")
    _note_second(note, "real", "small_aperture_fringe.csv", folder / "fringe", inferred)


def overlap(note: Note) -> None:
    """Note where the second map of the dipole lies by the first one, without a magnet.

    One stage made both, and was shifted between them.
    """
    maps = [_made("emphatic", f"{name}.csv") / f"{name}.csv" for name in ("body", "fringe")]
    with tempfile.TemporaryDirectory() as temporary:
        _do("check", *maps, "--turn-rad", "0.001", "-o", Path(temporary) / "joined")
        found = json.loads((Path(temporary) / "joined" / "joined.json").read_text("utf-8"))
    (pose,) = found["poses"]
    note("real.overlap_z_mm", -1e3 * pose["shift_m"][2], "mm",
         f"by which the second map's middle lies before its place on the first one's stage, "
         f"± {1e3 * pose['shift_sd_m'][2]:.3f}; one gain and 810 readings of the overlap alone "
         "say 252.460 ± 0.002; asked: within 0.05")
    note("real.joined_chi2", max(one["chi2"] for one in found["overlaps"]), "ratio",
         "per reading of the overlap, predicted by the other map; asked: 0.8 to 1.2. Left out: "
         + "; ".join(f"{one['points']} rows of {one['name']} at {one['axis']} = "
                     f"{1e3 * one['place_m']:.1f} mm, off by {1e3 * one['off_m']:.2f} mm"
                     for one in found["displaced"]))


def mri(note: Note) -> None:
    """Note the figures of the magnet for MRI."""
    folder = _made("mri4all")
    inferred = folder / "measured"
    _note_figures(note, "real_mri", "cube_10cm_11_steps.csv", folder / "check",
                  folder / "registered", inferred)
    _note_deviation(note, "real_mri", *_held_out(inferred))


def faser(note: Note) -> None:
    """Note the errors of the published profile of the FASER dipole, as its paper defines them.

    Every fifth reading is set aside before anything is fitted. The profile is registered from
    nothing on a line along the magnet, with its step open.
    """
    index, _, paper, measured = np.loadtxt(
        STUDIES / "faser" / "fig4_faser_on_axis.csv", delimiter=",", skiprows=1).T
    z = np.round((index - (len(index) + 1) / 2) * FASER_STEP_M, 9)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        unread = np.full(len(z), np.nan)
        write_map(field_map(np.column_stack([0 * z, 0 * z, z]),
                            np.column_stack([measured, unread, unread])), folder / "map.csv")
        _do("register", STUDIES / "faser" / "profile.toml", "--measurements", folder / "map.csv",
            "--fit", "instrument.z_scale=0.05", "--turn-rad", "0.02",
            "--most", "1",  # equal poses predict the same
            "-o", folder / "pose")
        _do("infer", folder / "pose" / "study.registered.toml", "--measurements",
            folder / "map.csv", "-o", folder / "inferred")
        with (folder / "inferred" / "prediction.csv").open() as file:
            rows = list(csv.DictReader(file))
    left = np.array([float(row["measured_T"]) - float(row["posterior_mean_T"]) for row in rows])
    held_out = np.array([row["held_out"] == "1" for row in rows])
    error = np.abs(left) / measured  # the fitted offset of the probe counts as predicted
    fringe = (index <= FASER_FRINGE[0]) | (index >= FASER_FRINGE[1])
    for name, region, asked in (("fringe", fringe, "0.03"), ("homogeneous", ~fringe, "9e-4")):
        chosen = region & held_out
        note(f"faser.{name}_median_error", float(np.median(error[chosen])), "ratio",
             f"{chosen.sum()} readings of every fifth, held out; the paper's errors there are "
             f"{np.median(paper[chosen]):.2g}; asked: {asked} at most")


def _do(*arguments: str | Path) -> None:
    """Run a verb of the command line."""
    if main([str(each) for each in arguments]):
        raise HalbachError(f"halbach-fe {arguments[0]} failed; its message is above.")


def _made(name: str, target: str = "measured/report.html") -> Path:
    """Make a study of the Makefile from its raw maps to its page, or a part of it; return the
    folder of results.

    What is up to date is not made again: remove the folder to measure anew.
    """
    subprocess.run(["make", f"results/{name}/{target}"], cwd=ROOT, check=True)
    return ROOT / "results" / name


def _held_out(
    inferred: Path, of_map: str | None = None
) -> tuple[list[dict[str, str]], np.ndarray, np.ndarray]:
    """Return the rows of held-out readings of an update, the readings and their predictions."""
    with (inferred / "prediction.csv").open() as file:
        rows = [row for row in csv.DictReader(file)
                if row["held_out"] == "1" and of_map in (None, row["map"])]
    readings, mean = (np.array([float(row[key]) for row in rows]) for key in (
        "measured_T", "posterior_mean_T"))
    return rows, readings, mean


def _rms(rows: list[dict[str, str]], residual: np.ndarray) -> float:
    """Return the rms over the three components of the rms residual of each."""
    labels = np.array([row["label"] for row in rows])
    return float(np.sqrt(np.mean([np.mean(residual[labels == f"B{component}"]**2)
                                  for component in "xyz"])))


def _within(rows: list[dict[str, str]]) -> float:
    """Return the share of readings within their 95 % band."""
    return float(np.mean([abs(float(row["standardized_residual"])) <= WITHIN for row in rows]))


def _chi2(inferred: Path, region: str | None = None) -> float:
    """Return chi-squared per held-out reading of an update, of all or of one region."""
    scores = [each for each in json.loads((inferred / "summary.json").read_text())["scores"]
              if each["part"] == "held out" and region in (None, each["region"])]
    return float(np.average([each["chi2_posterior"] for each in scores],
                            weights=[each["readings"] for each in scores]))


def _note_figures(
    note: Note, name: str, raw: str, checked: Path, pose: Path, inferred: Path,
    of_map: str | None = None,
) -> None:
    """Note what a check, a registration and an update say of one map, under a name."""
    floor = json.loads((checked / "check.json").read_text())["floor_rms_T"]
    best = json.loads((pose / "registration.json").read_text())["poses"][0]
    rows, readings, mean = _held_out(inferred, of_map)
    posterior = _rms(rows, readings - mean)
    nominal = float(np.sqrt(np.mean(np.square(best["held_out_nominal_rms_T"]))))
    against = f"{len(rows)} readings of every fifth scan line of {raw}, held out"
    note(f"{name}.floor_mT", 1e3 * floor, "mT", f"{against}; rms over the components")
    note(f"{name}.posterior_mT", 1e3 * posterior, "mT", "the same lines, updated magnet")
    note(f"{name}.posterior_over_floor", posterior / floor, "ratio", "asked: 1.3 at most")
    note(f"{name}.nominal_mT", 1e3 * nominal, "mT", "nominal magnet after registration only")
    note(f"{name}.gain", nominal / posterior, "ratio", "nominal over posterior")
    note(f"{name}.coverage95", _within(rows), "ratio", against)
    note(f"{name}.heldout_chi2", _chi2(inferred, of_map), "per reading", against)


def _note_second(note: Note, name: str, raw: str, checked: Path, both: Path) -> None:
    """Note what an update by two maps says of the second one, ``fringe``."""
    summary = json.loads((both / "summary.json").read_text())
    sd = max(summary["poses"]["fringe"]["middle_sd_m"])
    note(f"{name}.second_map_pose_sd_mm", 1e3 * sd, "mm",
         f"largest over the axes, of the middle of {raw} in the magnet; asked: 0.05 at most")
    shifts = [term["sd"] for term_name, term in summary["instrument_terms"].items()
              if term_name.startswith("fringe.stage_shift_")]
    note(f"{name}.second_map_shift_sd_mm", 1e3 * max(shifts), "mm",
         "largest over the axes, of its place against that of the first map on the same stage")
    (overlap,) = [each for each in summary["overlaps"]
                  if (each["name"], each["by"]) == ("fringe", "body")]
    note(f"{name}.overlap_chi2", overlap["chi2"], "per reading",
         f"{overlap['readings']} held-out readings of {raw} within the first map, by an update "
         "with the first map only")
    for one in summary["regions_left_out"]:
        own = json.loads((checked.parent / one["name"] / "check.json").read_text())
        note(f"{name}.left_out_over_floor_{one['name']}",
             one["rms_T"] / own["floor_rms_T"], "ratio",
             f"{one['readings']} readings of the whole map, predicted by the update with the other "
             f"one to {1e6 * one['rms_T']:.0f} µT, where its error bars allow "
             f"{1e6 * one['allowed_T']:.0f} µT; {one['over_noise']:.2g} times the noise that is "
             f"stated, chi² per reading {one['chi2']:.2g}; asked: 2 at most")
    floor = json.loads((checked / "check.json").read_text())["floor_rms_T"]
    rows, readings, mean = _held_out(both, "fringe")
    note(f"{name}.second_map_floor_mT", 1e3 * floor, "mT",
         f"{len(rows)} held-out readings of {raw}")
    note(f"{name}.second_map_posterior_mT", 1e3 * _rms(rows, readings - mean), "mT",
         "the same lines, updated by both maps")
    note(f"{name}.second_map_coverage95", _within(rows), "ratio", "the same lines")
    note(f"{name}.second_map_heldout_chi2", _chi2(both, "fringe"), "per reading", "the same lines")


def _note_deviation(
    note: Note, name: str, rows: list[dict[str, str]], readings: np.ndarray, mean: np.ndarray
) -> None:
    """Note the rms deviation of |B| of held-out points, in ppm of the field there."""
    places: dict[tuple[str, str, str], list[int]] = {}
    for number, row in enumerate(rows):
        places.setdefault((row["x_m"], row["y_m"], row["z_m"]), []).append(number)
    whole = np.array([numbers for numbers in places.values() if len(numbers) == 3])
    measured, predicted = (np.linalg.norm(values[whole], axis=1) for values in (readings, mean))
    note(f"{name}.deviation_ppm_rms", 1e6 * float(np.sqrt(np.mean(
        (predicted / measured - 1)**2))), "ppm", f"|B| at {len(whole)} held-out points")
