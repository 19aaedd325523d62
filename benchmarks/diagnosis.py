"""Hidden effects: the rates of the sealed cases, which `make verify-diagnosis` has run."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.note import Note
from halbach_fe.core.errors import StudyError

SUMMARY = Path(__file__).parent.parent / "results" / "diagnosis" / "summary.json"
COUNTED = {
    "naming_rate_single": "single_cases", "naming_rate_pairs": "pair_cases",
    "false_alarm_rate": "clean_cases",
    "heldout_recovered_rate": "recovered_of", "iron_fringe_reduction": "iron_cases",
    "others_named_per_case": "effects_cases", "naming_ece": "naming_statements"}
"""Rates, and of how many cases they are."""


def run(note: Note) -> None:
    """Note the rates; they take hours, which is why nothing is run here."""
    if not SUMMARY.exists():
        raise StudyError(f"There is no {SUMMARY}. Run make verify-diagnosis first.")
    rates = json.loads(SUMMARY.read_text(encoding="utf-8"))["rates"]
    unknown = [name for name in COUNTED if rates.get(name) is None]
    if unknown:
        raise StudyError(f"{SUMMARY} lacks {', '.join(unknown)}. Run all of make verify-diagnosis.")
    for name, count in COUNTED.items():
        note(f"diagnosis.{name}", rates[name], "ratio",
             f"sealed cases of make verify-diagnosis, {rates[count]:.0f} of this kind")
