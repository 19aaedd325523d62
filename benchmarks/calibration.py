"""Calibration: p-values that `make verify-calibration` has found, and instruments by `check`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from benchmarks.note import Note
from halbach_fe.core.errors import MeasurementError, StudyError
from halbach_fe.measurement.map_check import SIGNIFICANT, check_map
from halbach_fe.measurement.map_join import join_maps
from tests.support import joined_campaigns
from tests.support.hard_maps import ERRORS, GAIN, gain_of, hard_map

RESULTS = Path(__file__).parent.parent / "results" / "calibration" / "calibration.json"
NAMES = {
    "linear, closed form": "linear", "non-linear, chains": "sampled",
    "control: position noise not stated": "control_positions",
    "control: error of a coarse mesh not stated": "control_mesh",
    "control: the paper's chain, too short": "control_short_chain"}


def run(note: Note) -> None:
    """Note the p-values; they take long, which is why nothing is run here."""
    if not RESULTS.exists():
        raise StudyError(f"There is no {RESULTS}. Run make verify-calibration first.")
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    missing = [name for name in NAMES if name not in found]
    if missing:
        raise StudyError(
            f"{RESULTS} lacks {', '.join(missing)}. Run make verify-calibration again.")
    for name, short in NAMES.items():
        note(f"calibration.{short}_p", found[name]["p_value"], "p-value",
             f"ranks of {found[name]['repeats']} truths of make verify-calibration: {name}")


MAPS = 40
"""Number of maps with a perfect instrument, and of those with an instrument that has one error."""


def instrument(note: Note) -> None:
    """Note how often `check` finds errors of a probe that are not there, and those that are."""
    false = sum(any(term.found for term in check_map(hard_map(seed)).terms)
                for seed in range(MAPS))
    found = within = visible = 0
    for seed in range(MAPS):
        error = list(ERRORS)[seed // 4 % len(ERRORS)]
        data = hard_map(seed, error)
        name, value = ERRORS[error]
        if error == "gain":
            own, share = gain_of(data["B_T"].values)
            name, value = f"gain of B{'xyz'[own]} relative to that of |B|", 100 * GAIN * (1 - share)
        (term,) = [term for term in check_map(data).terms if term.name == name]
        found += term.found
        visible += abs(value) > SIGNIFICANT * term.sd
        within += abs(term.value - value) <= 2 * term.sd
    against = f"of {MAPS} maps near blocks and coils by magpylib"
    note("check.instrument_false_rate", false / MAPS, "ratio",
         f"{against}, with a perfect probe; asked: 0.02 at most")
    note("check.instrument_found_rate", found / MAPS, "ratio",
         f"{against}, with one error of usual size, which is above {SIGNIFICANT:g} of its error "
         f"bars in {visible}; asked: 0.9 at least")
    note("check.instrument_within_2sd", within / MAPS, "ratio",
         "the same maps: share whose error is within 2 sd, found or not")


CAMPAIGNS = 30
"""Number of campaigns of three overlapping maps that are joined without a magnet."""


def joined(note: Note) -> None:
    """Note how far the poses of maps that are joined are off, in units of their bars."""
    off, refused = [], 0
    for seed in range(CAMPAIGNS):
        maps, poses, _ = joined_campaigns.campaign(seed)
        try:
            off.append(joined_campaigns.over_bars(join_maps(maps), poses))
        except MeasurementError:
            refused += 1
    note("joined.pose_z_rms", float(np.sqrt(np.mean(np.square(off)))), "ratio",
         f"errors over bars of {12 * len(off)} numbers of poses in campaigns by magpylib, a "
         f"quadrupole and a dipole of cubes; {refused} of {CAMPAIGNS} refused; asked: 0.9 to 1.1")
