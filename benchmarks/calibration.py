"""Calibration of the posteriors: the p-values that `make verify-calibration` has found."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.note import Note
from halbach_fe.core.errors import StudyError

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
