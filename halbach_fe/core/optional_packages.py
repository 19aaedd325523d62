"""Packages that come with optional extras, and the command that installs an extra."""

from __future__ import annotations

import json
from importlib import import_module, metadata
from typing import Any
from urllib.parse import unquote, urlsplit

from halbach_fe.core.errors import ExtraMissingError

_CAMPAIGN = "Simulated campaigns, and magnets of magpylib, need magpylib and NGSolve"


def install_command(extra: str) -> str:
    """Return the command that adds an extra to halbach-fe from where it was installed (PEP 610).

    A clone or a wheel is named by its own place: an index of packages may not hold it.
    """
    # a folder of sources on the path has records of its own, without the place
    records = (one.read_text("direct_url.json") for one in metadata.distributions(
        name="halbach-fe"))
    origin = json.loads(next(filter(None, records), "{}"))
    url = origin.get("url", "")
    if "dir_info" in origin:
        editable = "-e " if origin["dir_info"].get("editable") else ""
        return f"pip install {editable}'{unquote(urlsplit(url).path)}[{extra}]'"
    if "vcs_info" in origin:
        url = f"{origin['vcs_info']['vcs']}+{url}"
    return f"pip install 'halbach-fe[{extra}]{' @ ' if url else ''}{url}'"


def import_extra(module: str, extra: str = "campaign", purpose: str = _CAMPAIGN) -> Any:
    """Import a module of an optional extra by its name; `purpose` begins the error's sentence.

    Raises
    ------
    ExtraMissingError
        If the module, or one that it needs, is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ExtraMissingError(
            f"{purpose}, but {error.name or module} cannot be imported here. Install what is "
            f"missing: {install_command(extra)}") from None
