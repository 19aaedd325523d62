"""Estimate the error of a study's field: refinement, a farther boundary, the dual formulation.

Solves the nominal array at the study's positions on a coarser, its own and a finer mesh, with the
boundary farther away, and where there is one by the dual formulation. Writes verification.json.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

from halbach_fe.cli import common
from halbach_fe.cost import of_verify
from halbach_fe.study import read_study
from halbach_fe.update import write_text
from halbach_fe.verification import verify


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    common.add_dry_run_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Verify, write, print."""
    study = read_study(arguments.study)
    if arguments.dry_run:
        return common.print_estimate(of_verify(study, arguments.jobs), arguments.json)
    with common.workshop(arguments) as workshop:
        found = verify(study, workshop, say=lambda what: common.say(f"solving {what}"))
    write_text(arguments.output / "verification.json",
               json.dumps(asdict(found), indent=1, allow_nan=False) + "\n")
    if arguments.json:
        common.print_json(asdict(found))
        return 0
    def row(what: str, pointwise: float, fourier: float | None) -> dict[str, str]:
        return {"change": what, "pointwise": f"{pointwise:.1e}",
                "Fourier": "" if fourier is None else f"{fourier:.1e}"}

    rows = [row(d.what, d.pointwise, d.fourier)
            | {name: f"{value:.1e}" for name, value in d.by_region.items()}
            for d in found.differences]
    rows.append(row(f"estimated error (order {found.order:.1f})", found.error_pointwise,
                    found.error_fourier) | dict.fromkeys(found.differences[0].by_region, ""))
    common.print_table(rows, f"Route {found.route}; relative to {found.main_field_T:.4g} T")
    return 0
