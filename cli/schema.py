"""Print the JSON schema of the study file."""

from __future__ import annotations

import argparse

from halbach_fe.cli import common
from halbach_fe.study.model import Study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add no options: this verb has none."""


def run(arguments: argparse.Namespace) -> int:
    """Print the schema."""
    common.print_json(Study.model_json_schema())
    return 0
