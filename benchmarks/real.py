"""Measured magnets, from the raw map to the updated model, on lines of the scan that were held out.

Every fifth line is set aside before anything is fitted: by the check, the registration and the
update alike. The floor is that of Maxwell's check, which assumes no magnet.
"""

from __future__ import annotations

import csv
import json
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import common, main
from halbach_fe.core.errors import HalbachError

STUDIES = Path(__file__).parents[1] / "studies"
EMPHATIC = "x[inch],y[inch],z[inch],-,Bx[T],By[T],Bz[T],t[s],-"
MRI = "-,dx[mm],dy[mm],dz[mm],Bx[G],By[G],Bz[G],-,-"
WITHIN = 1.96
"""Standard deviations of the interval that holds 95 %."""


def emphatic(note: Note) -> None:
    """Note the figures of the spectrometer dipole."""
    _magnet(note, "real", "emphatic", "body_scan.csv", EMPHATIC, "oriented_map.csv")


def mri(note: Note) -> None:
    """Note the figures of the magnet for MRI."""
    _magnet(note, "real_mri", "mri4all", "cube_10cm_11_steps.csv", MRI, "corrected_map.csv")


def _do(*arguments: str | Path) -> None:
    """Run a verb of the command line."""
    if main([str(each) for each in arguments]):
        raise HalbachError(f"halbach-fe {arguments[0]} failed; its message is above.")


def _magnet(note: Note, name: str, study: str, raw: str, columns: str, checked: str) -> None:
    """Take the map of one magnet through all steps, and note its figures under a name."""
    measured = STUDIES / study / "measured"
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        common.say(f"{name}: {raw}")
        _do("import-map", measured / raw, "-o", folder / "map.csv", f"--columns={columns}")
        _do("check", folder / "map.csv", "-o", folder / "check")
        given = folder / "check" / checked
        _do("register", measured / "study.toml", "--measurements", given, "-o", folder / "pose")
        registered = folder / "pose" / "study.registered.toml"
        _do("infer", registered, "--measurements", given, "-o", folder / "inferred")
        check = json.loads((folder / "check" / "check.json").read_text())
        pose = json.loads((folder / "pose" / "registration.json").read_text())["poses"][0]
        scores = json.loads((folder / "inferred" / "summary.json").read_text())["scores"]
        with (folder / "inferred" / "prediction.csv").open() as file:
            rows = [row for row in csv.DictReader(file) if row["held_out"] == "1"]
    floor = check["floor_rms_T"]
    readings, mean, score = (np.array([float(row[key]) for row in rows]) for key in (
        "measured_T", "posterior_mean_T", "standardized_residual"))
    rms = {component: float(np.sqrt(np.mean((readings - mean)[
        [row["label"] == f"B{component}" for row in rows]]**2))) for component in "xyz"}
    posterior = float(np.sqrt(np.mean(np.square(list(rms.values())))))
    nominal = float(np.sqrt(np.mean(np.square(pose["held_out_nominal_rms_T"]))))
    against = f"{len(rows)} readings of every fifth scan line of {raw}, held out"
    note(f"{name}.floor_mT", 1e3 * floor, "mT", f"{against}; rms over the components")
    note(f"{name}.posterior_mT", 1e3 * posterior, "mT", "the same lines, updated magnet")
    note(f"{name}.posterior_over_floor", posterior / floor, "ratio", "asked: 1.3 at most")
    note(f"{name}.nominal_mT", 1e3 * nominal, "mT", "nominal magnet after registration only")
    note(f"{name}.gain", nominal / posterior, "ratio", "nominal over posterior")
    note(f"{name}.coverage95", float(np.mean(np.abs(score) <= WITHIN)), "ratio", against)
    held_out = [each for each in scores if each["part"] == "held out"]
    note(f"{name}.heldout_chi2", float(np.average(
        [each["chi2_posterior"] for each in held_out],
        weights=[each["readings"] for each in held_out])), "per reading", against)
    if name == "real_mri":
        _note_deviation(note, name, rows, readings, mean)


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
