"""The command line: one file per verb, each with ``add_arguments`` and ``run``."""

from __future__ import annotations

import argparse
import ast
import importlib
import sys
from collections.abc import Collection, Sequence
from importlib import metadata
from pathlib import Path
from types import ModuleType

from halbach_fe.cli import common
from halbach_fe.core.errors import EXIT_CODES

VERBS = {
    "new": "new", "solve": "solve", "infer": "infer", "diagnose": "diagnose", "verify": "verify",
    "multipoles": "multipoles", "plan": "plan", "prior": "prior", "shim": "shim", "sort": "sort",
    "tolerance": "tolerance", "demagnetization": "demagnetization",
    "simulate-measurement": "simulate_measurement", "import-map": "import_map", "check": "check",
    "register": "register",
    "export": "export",
    "cache": "cache", "doctor": "doctor", "schema": "schema", "completion": "completion"}
"""Name of the module of each verb."""


def module_of(verb: str) -> ModuleType:
    """Import the module of a verb."""
    return importlib.import_module(f"halbach_fe.cli.{VERBS[verb]}")


def parser(verbs: Collection[str] = tuple(VERBS)) -> argparse.ArgumentParser:
    """Return the parser of the command line, with the options of some verbs.

    Of all other verbs it has only the help text. Only the modules of ``verbs`` are imported,
    because some of them import large libraries.
    """
    codes = "\n".join(f"  {code:3d}  {meaning}" for code, meaning in EXIT_CODES.items())
    top = argparse.ArgumentParser(
        prog="halbach-fe", description="Finite elements and Bayesian inference for Halbach arrays.",
        epilog=f"exit codes:\n{codes}", formatter_class=argparse.RawDescriptionHelpFormatter)
    top.add_argument("--version", action="version", version=metadata.version("halbach-fe"))
    subparsers = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, module in VERBS.items():
        text = _docstring(module)
        verb = subparsers.add_parser(name, help=text.splitlines()[0], description=text,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
        if name in verbs:
            module_of(name).add_arguments(verb)
    return top


def _docstring(module: str) -> str:
    """Return the docstring of a verb's module, without importing the module."""
    source = Path(__file__).with_name(f"{module}.py").read_text(encoding="utf-8")
    return ast.get_docstring(ast.parse(source)) or ""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the verb of a command line; return its exit code, see `EXIT_CODES` in core.errors."""
    words = sys.argv[1:] if argv is None else argv
    arguments = parser([word for word in words if word in VERBS][:1]).parse_args(words)
    return common.guarded(lambda: int(module_of(arguments.verb).run(arguments)))
