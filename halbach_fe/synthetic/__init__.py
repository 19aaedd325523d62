"""Synthetic campaigns, whose truth does not come from the model of the field that they test.

magpylib and NGSolve come with the optional extra ``campaign``.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from halbach_fe.core.errors import ExtraMissingError


def import_extra(module: str) -> Any:
    """Import a module of magpylib or NGSolve by its name.

    Raises
    ------
    ExtraMissingError
        If the module is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ExtraMissingError(
            "Simulated campaigns, and magnets of magpylib, need magpylib and NGSolve, but "
            f"{error.name or module} cannot be imported here. Install them: "
            "pip install halbach-fe[campaign]") from None
