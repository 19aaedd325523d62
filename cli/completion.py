"""Print a script that completes halbach-fe's commands and options in a shell.

For bash:

    halbach-fe completion bash > ~/.local/share/bash-completion/completions/halbach-fe
"""

from __future__ import annotations

import argparse

import shtab

from halbach_fe.cli.streams import show

SHELLS = ("bash", "zsh", "tcsh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("shell", choices=SHELLS, help="shell for which the script is printed")


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    from halbach_fe.cli import verbs  # here, because verbs imports this module

    show(shtab.complete(verbs.parser(), shell=arguments.shell) + "\n")
    return 0
