"""Commands that are killed at random moments and run again: what is lost, broken or left over."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import common
from tests.support.interruption import command, environment_of, kill_and_run_again, undisturbed

EXAMPLE = Path(__file__).parent.parent / "studies" / "quadrupole"
KILLS = {"solve": 8, "infer": 9, "diagnose": 6}


def run(note: Note) -> None:
    """Kill solve, infer and diagnose of an example at random moments of their time."""
    generator = np.random.default_rng(8)
    for verb, kills in KILLS.items():
        with tempfile.TemporaryDirectory() as name:
            root = Path(name)
            study, campaign = EXAMPLE / "study.toml", EXAMPLE / "campaign"
            alone_s = undisturbed(command(verb, study, campaign, root / "alone"),
                                  environment_of(root / "cache"))
            ends = []
            for number in range(kills):
                output = root / str(number)
                ends.append(kill_and_run_again(
                    command(verb, study, campaign, output),
                    environment_of(root / f"cache-{number}"), output, root / "alone",
                    float(generator.uniform(0.3, alone_s))))
                common.say(f"{verb} {number + 1}/{kills}: {ends[-1]}")
        hits = [one for one in ends if one.hit]
        note(f"recovery.{verb}_kills", len(hits), "kills that hit", "of random moments")
        note(f"recovery.{verb}_broken", sum(len(one.broken) for one in ends), "defects",
             "files broken, differing or left behind, processes surviving")
        resumed_s = float(np.median([one.resumed_s for one in hits]))
        note(f"recovery.{verb}_resumed", resumed_s / alone_s,
             "of the undisturbed run's time", "what the run after a kill takes (median)")
