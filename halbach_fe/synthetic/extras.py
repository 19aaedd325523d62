"""The programs that make the fields; they come with the extra ``campaign``."""

from __future__ import annotations

from importlib import import_module, metadata
from typing import Any

from halbach_fe.core.errors import ExtraMissingError


def needed(module: str) -> Any:
    """Import a module of magpylib or NGSolve.

    Raises
    ------
    ExtraMissingError
        If it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ExtraMissingError(
            f"Synthetic campaigns need magpylib and NGSolve, but {error.name or module} cannot be "
            "imported here. Install them: pip install halbach-fe[campaign]") from None


def version_of(name: str) -> str:
    """Version of an installed distribution."""
    return metadata.version(name)
