"""Print a script that completes halbach-fe's commands and options in a shell.

For bash:

    halbach-fe completion bash > ~/.local/share/bash-completion/completions/halbach-fe
"""

from __future__ import annotations

import argparse
import sys

import shtab

SHELLS = ("bash", "zsh", "tcsh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("shell", choices=SHELLS, help="shell for which the script is printed")


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    import halbach_fe.cli  # here, because the command line itself imports this module

    whole = halbach_fe.cli.parser()
    sys.stdout.write(shtab.complete(whole, shell=arguments.shell) + "\n")
    return 0
