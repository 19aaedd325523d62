"""Hidden effects: the rates of the sealed cases, which `make verify-diagnosis` has run."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.note import Note
from halbach_fe.core.errors import StudyError

SUMMARY = Path(__file__).parent.parent / "results" / "diagnosis" / "summary.json"
COUNTED = {
    "naming_rate_single": ("ratio", "single_cases", "single effects that can be seen"),
    "naming_rate_pairs": ("ratio", "pair_cases", "pairs that can be seen"),
    "others_named_per_case": ("names per case", "effects_cases", "cases with effects"),
    "yes_beside_wrong": ("ratio", "cases", "cases"),
    "clean_named_rate": ("ratio", "clean_cases", "clean cases"),
    "amplitude_z_rms": ("sd", "amplitudes", "amplitudes of right names; 1 if the bars are right"),
    "posterior_chi2": ("ratio", "updates", "updates, median; 1 if their bars are right"),
    "posterior_chi2_max": ("ratio", "updates", "updates"),
    "axis_coverage": ("ratio", "axis_numbers", "rolls, centres and slopes in 95 % bars"),
    "heldout_recovered_rate": ("ratio", "recovered_of", "cases with all named"),
    "iron_fringe_reduction": ("ratio", "iron_cases", "iron rings"),
    "naming_ece": ("ratio", "naming_statements", "statements")}
"""Unit of each rate, of how many it is, and of what."""


def run(note: Note) -> None:
    """Note the rates; they take hours, which is why nothing is run here.

    Those of kinds of which no case was run are left as they were.
    """
    if not SUMMARY.exists():
        raise StudyError(f"There is no {SUMMARY}. Run make verify-diagnosis first.")
    rates = json.loads(SUMMARY.read_text(encoding="utf-8"))["rates"]
    for name, (unit, count, what) in COUNTED.items():
        if rates.get(name) is not None:
            note(f"diagnosis.{name}", rates[name], unit,
                 f"{rates[count]:.0f} {what}, of {rates['cases']:.0f} sealed cases of "
                 f"{rates['magnets']:.0f} kinds of magnets")
