"""The commented study file that `halbach-fe new` writes."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jinja2

from halbach_fe.core.errors import OutputError, must_be
from halbach_fe.core.files import atomic
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study

TEMPLATE = "new_study.toml.j2"


@dataclass(frozen=True)
class MagnetTemplate:
    """Values of the magnet in a new study file; all other values of the file follow from them.

    Lengths are in m, the remanence is in T. ``ring_length_m`` is None for a cross-section.
    """

    multipole_order: int = 1
    blocks_per_ring: int = 16
    rings: int = 1
    inner_radius_m: float = 0.05
    outer_radius_m: float = 0.09
    ring_length_m: float | None = None
    remanence_T: float = 1.3
    shape: Literal["sector", "trapezoid", "cuboid"] = "sector"
    iron_ring: bool = False


def new_study(name: str, magnet: MagnetTemplate) -> str:
    """Return the text of a valid study file with comments that explain its keys.

    Raises
    ------
    StudyError
        If no valid study has these values.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("halbach_fe.study", "."), undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    text = environment.get_template(TEMPLATE).render(name=_name(name), magnet=magnet)
    parse_new_study(text)
    return text


def parse_new_study(text: str) -> Study:
    """Return the study in a new file; raise StudyError if the options make it invalid."""
    return parse_study(tomllib.loads(text), "new study")


def write_new_study(path: Path, magnet: MagnetTemplate) -> None:
    """Write a new study file; an existing file is never overwritten.

    Raises
    ------
    StudyError
        If no valid study has these values.
    OutputError
        If the file exists already, or cannot be written.
    """
    if path.exists():
        raise OutputError(must_be("path", "new study", "a file that does not exist yet",
                                  f"'{path}'", "Choose another name, or remove it."))
    text = new_study(path.stem, magnet)
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _name(stem: str) -> str:
    """Return a valid name of a study, made from the name of its file."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", stem).lstrip("._-")[:100]
    return name or "magnet"
