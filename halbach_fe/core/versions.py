"""Versions of installed packages."""

from __future__ import annotations

from functools import cache
from importlib import metadata


@cache
def version(package: str) -> str:
    """Return the version of an installed package, read once: its metadata take 5 ms to parse."""
    return metadata.version(package)
