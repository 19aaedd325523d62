"""A commented study file to start from."""

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
    """What a new study has to know; the rest follows, and can be changed in the file.

    Lengths in m, remanence in T. ``ring_length_m`` is None for a cross-section.
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
    """The text of a study file, which says of every key what it means, and is valid as it stands.

    Raises
    ------
    StudyError
        If there is no such magnet.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("halbach_fe.study", "."), undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    text = environment.get_template(TEMPLATE).render(name=_name(name), magnet=magnet)
    parse_new_study(text)
    return text


def parse_new_study(text: str) -> Study:
    """The study that a new file holds; StudyError with what the options must be, if none."""
    return parse_study(tomllib.loads(text), "new study")


def write_new_study(path: Path, magnet: MagnetTemplate) -> None:
    """Write a study file where there is none.

    Raises
    ------
    StudyError
        See `new_study`.
    OutputError
        If the file is there already, or cannot be written.
    """
    if path.exists():
        raise OutputError(must_be("path", "new study", "a file that does not exist yet",
                                  f"'{path}'", "Choose another name, or remove it."))
    text = new_study(path.stem, magnet)
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _name(stem: str) -> str:
    """What a study may be called, from a file's name."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", stem).lstrip("._-")[:100]
    return name or "magnet"
