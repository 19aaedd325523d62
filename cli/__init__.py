"""The command line: one file per verb, each with ``add_arguments`` and ``run``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import metadata

from halbach_fe.cli import (
    cache,
    common,
    completion,
    demagnetization,
    diagnose,
    doctor,
    export,
    import_map,
    infer,
    multipoles,
    new,
    plan,
    prior,
    schema,
    shim,
    simulate_measurement,
    solve,
    sort,
    tolerance,
    verify,
)
from halbach_fe.core.errors import EXIT_CODES

VERBS = {
    "new": new, "solve": solve, "infer": infer, "diagnose": diagnose, "verify": verify,
    "multipoles": multipoles, "plan": plan, "prior": prior, "shim": shim, "sort": sort,
    "tolerance": tolerance, "demagnetization": demagnetization,
    "simulate-measurement": simulate_measurement, "import-map": import_map, "export": export,
    "cache": cache, "doctor": doctor, "schema": schema, "completion": completion}


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    codes = "\n".join(f"  {code:3d}  {meaning}" for code, meaning in EXIT_CODES.items())
    top = argparse.ArgumentParser(
        prog="halbach-fe", description="Finite elements and Bayesian inference for Halbach arrays.",
        epilog=f"exit codes:\n{codes}", formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument("--version", action="version", version=metadata.version("halbach-fe"))
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, module in VERBS.items():
        text = (module.__doc__ or "").strip()
        verb = verbs.add_parser(name, help=text.splitlines()[0], description=text,
                                formatter_class=argparse.RawDescriptionHelpFormatter)
        verb.set_defaults(parser=top)
        module.add_arguments(verb)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; return its exit code (`halbach_fe.core.errors.EXIT_CODES`)."""
    arguments = parser().parse_args(argv)
    return common.guarded(lambda: VERBS[arguments.verb].run(arguments))
