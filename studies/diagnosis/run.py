"""Sealed cases of hidden effects, and how often the diagnosis names them.

Campaigns are by magpylib and NGSolve; every case is kept, and an interrupted run goes on::

    python studies/diagnosis/run.py -o results/diagnosis
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from halbach_fe.campaign.effects import EFFECTS as CAN_BE_HIDDEN
from halbach_fe.campaign.extras import needed
from halbach_fe.campaign.simulate import simulate
from halbach_fe.cli import common
from halbach_fe.diagnose import Diagnosis, diagnose
from halbach_fe.effects import catalogue
from halbach_fe.field_map import points_of
from halbach_fe.solve import Workshop
from halbach_fe.study import Study, read_study
from halbach_fe.update import HELD_OUT, write_text

HERE = Path(__file__).parent
DETECTABLE = 5.0
"""Log Bayes factor of the true effect, from which a case counts."""

NONE, UNKNOWN = "none", "unknown"
BACK = (0.9, 1.1)
"""chi2 per held-out reading of a model that lacks nothing."""


@dataclass(frozen=True)
class Case:
    """What is hidden in one campaign."""

    seed: int
    hidden: tuple[str, ...] = ()
    outside: str = ""

    @property
    def name(self) -> str:
        """Its file."""
        return f"{self.seed:03d}-{'-'.join(self.hidden) or self.outside or NONE}"


def cases(study: Study, singles: int, clean: int, pairs: int, outside: int) -> list[Case]:
    """Effects that both the campaign and the catalogue know, alone and in pairs; none; others."""
    known = {effect.name for effect in catalogue()}
    names = [name for name in CAN_BE_HIDDEN if name in known]
    generator = np.random.default_rng(1)
    drawn = [(name,) for _ in range(singles) for name in names]
    drawn += [tuple(generator.choice(names, 2, replace=False).tolist()) for _ in range(pairs)]
    found = [Case(number, hidden) for number, hidden in enumerate(drawn)]
    found += [Case(len(found) + number) for number in range(clean)]
    return found + [Case(len(found) + number, outside=list(OUTSIDE)[number % len(OUTSIDE)])
                    for number in range(outside)]


def coil(points: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Field (n, 3) in T of a loop of current around the magnet."""
    magpylib = needed("magpylib")
    loop = magpylib.current.Circle(
        current=generator.uniform(50, 200), diameter=generator.uniform(0.4, 0.6),
        position=(0, 0, generator.uniform(-0.15, 0.15)))
    return np.asarray(loop.getB(points))


def ripple(points: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Error (n, 3) in T of one sensor, periodic along z."""
    error = np.zeros_like(points)
    error[:, generator.integers(3)] = generator.uniform(1e-4, 4e-4) * np.sin(
        2 * np.pi * points[:, 2] / generator.uniform(0.1, 0.25) + generator.uniform(0, 6))
    return error


def quadrupole(points: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Field (n, 3) in T of a long quadrupole, in T/m of either sign."""
    strength = generator.choice([-1, 1]) * generator.uniform(2e-3, 1e-2)
    return np.asarray(strength * points * [1, -1, 0])


OUTSIDE = {"coil": coil, "ripple": ripple, "quadrupole": quadrupole}


def run_case(study: Study, case: Case, workshop: Workshop) -> dict[str, object]:
    """Simulate, diagnose, and compare with what is sealed."""
    campaign = simulate(study, case.seed, hide=[(CAN_BE_HIDDEN[name], None)
                                                for name in case.hidden])
    readings = campaign.readings
    if case.outside:
        added = OUTSIDE[case.outside](points_of(readings), np.random.default_rng(case.seed))
        readings = readings.assign(B_T=readings["B_T"] + added)
    found = diagnose(study, readings, workshop, campaign.blocks)
    return {"case": case.name, "hidden": list(case.hidden), "outside": case.outside,
            "truth": campaign.truth["effects"], **outcome(found)}


def outcome(found: Diagnosis) -> dict[str, object]:
    """What is scored of a diagnosis."""
    chi2 = {name: [score.chi2_posterior for score in update.scores if score.part == HELD_OUT]
            for name, update in (("before", found.before), ("after", found.after))}
    return {
        "named": [list(one.found.effects) for one in found.named],
        "factors": [one.found.log_bayes_factor for one in found.named],
        "unknown": None if found.unknown is None else found.unknown.kind,
        "probabilities": found.probabilities, "best": found.best_factors,
        "chi2_before": chi2["before"][0], "chi2_after": chi2["after"][0], "rounds": found.rounds}


def detectable(result: dict[str, object], name: str) -> bool:
    """Whether readings can tell of an effect at all, by its own evidence."""
    return bool(result["best"].get(name, -np.inf) > DETECTABLE)


def summary(results: list[dict[str, object]]) -> dict[str, float]:
    """Rates over all cases."""
    def named(result: dict[str, object], name: str) -> bool:
        return any(name in names for names in result["named"])

    single = [one for one in results if len(one["hidden"]) == 1
              and detectable(one, one["hidden"][0])]
    pairs = [one for one in results if len(one["hidden"]) == 2
             and all(detectable(one, name) for name in one["hidden"])]
    clean = [one for one in results if not one["hidden"] and not one["outside"]]
    outside = [one for one in results if one["outside"]]
    right = [one for one in single + pairs if all(named(one, name) for name in one["hidden"])]

    def rate(hits: list[bool]) -> float:
        return float(np.mean(hits)) if hits else float("nan")

    return {
        "naming_rate_single": rate([named(one, one["hidden"][0]) for one in single]),
        "single_cases": len(single),
        "naming_rate_pairs": rate([all(named(one, name) for name in one["hidden"])
                                   for one in pairs]),
        "pair_cases": len(pairs),
        "false_alarm_rate": rate([bool(one["named"] or one["unknown"]) for one in clean]),
        "clean_cases": len(clean),
        "unknown_rate": rate([one["unknown"] is not None for one in outside]),
        "outside_cases": len(outside),
        "heldout_recovered_rate": rate([BACK[0] <= one["chi2_after"] <= BACK[1]
                                        for one in right])}


def run(arguments: argparse.Namespace) -> int:
    """Run all cases and print the rates."""
    study, results = read_study(arguments.study), []
    chosen = cases(study, arguments.singles, arguments.clean, arguments.pairs, arguments.outside)
    for number, case in enumerate(chosen, start=1):
        path = arguments.output / "cases" / f"{case.name}.json"
        if not path.exists():
            with common.workshop(arguments) as workshop:
                there = replace(workshop, folder=arguments.output / "work")
                result = run_case(study, case, there)
            write_text(path, json.dumps(result, indent=1) + "\n")
        results.append(json.loads(path.read_text()))
        one = results[-1]
        common.say(f"{number}/{len(chosen)} {case.name}: {one['named']} {one['unknown'] or ''} "
                   f"chi2 {one['chi2_before']:.2f} -> {one['chi2_after']:.2f}")
    rates = summary(results)
    write_text(arguments.output / "summary.json", json.dumps(rates, indent=1) + "\n")
    confusion = Counter((one["hidden"][0], tuple(names)) for one in results
                        if len(one["hidden"]) == 1 for names in one["named"] or [[NONE]])
    common.print_table([{"hidden": hidden, "named": ", ".join(names), "cases": str(count)}
                        for (hidden, names), count in sorted(confusion.items())],
                       "What was hidden alone, and what was named")
    common.print_table([{"figure": name, "value": f"{value:.3g}"} for name, value in rates.items()],
                       "Rates")
    return 0


def options(parser: argparse.ArgumentParser) -> None:
    """Add this study's own options."""
    for name, count in (("singles", 2), ("clean", 20), ("pairs", 20), ("outside", 12)):
        parser.add_argument(f"--{name}", type=int, default=count, metavar="N",
                            help="cases (of each effect, for singles; default: %(default)s)")


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", HERE / "study.toml", "diagnosis", run, options))
