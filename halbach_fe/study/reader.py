"""Reading and validation of study files.

Every error message is one sentence that names the file, the key, and what to do.
"""

from __future__ import annotations

import re
import tomllib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from halbach_fe.core.errors import (
    MAX_QUOTED,
    HalbachWarning,
    StudyError,
    must_be,
    not_utf8,
    printable,
)
from halbach_fe.core.files import as_path
from halbach_fe.core.interface import typed
from halbach_fe.study import materials
from halbach_fe.study.free_blocks import MAX_PATH, free_blocks_of_file
from halbach_fe.study.iron_keys import (
    Iron,
    IronBody,
    IronCurve,
    TableCurve,
    closed_surface,
    read_stl,
)
from halbach_fe.study.model import Study, iron_of
from halbach_fe.study.types import reason, sentence


@typed
def read_study(path: str | Path) -> Study:
    """Read and validate a study file.

    Parameters
    ----------
    path : str or Path
        A TOML file. If it names a file with the H(B) curve of the iron, or a table of free blocks,
        that file is read too; its path is relative to the folder of the study file.

    Returns
    -------
    Study

    Raises
    ------
    StudyError
        If the file cannot be read or is not a valid study. The message is one sentence that names
        the file, the key, what was expected and what to do.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hf.read_study("dipole.toml").array.blocks_per_ring
    16
    """
    path = as_path(path)
    where = f"study file {path}"
    try:
        raw = path.read_bytes()
    except OSError as error:
        reason = error.strerror or str(error)
        raise StudyError(
            must_be("path", where, "a readable file", f"'{reason}'", "Check the path.")
        ) from None
    if not raw.strip():
        raise StudyError(
            must_be("content", where, "a TOML document", "an empty file",
                    "Start from one of the files under studies/.")
        )
    try:
        text = raw.decode("utf-8-sig")  # some editors write a byte order mark
    except UnicodeDecodeError as error:
        raise StudyError(not_utf8(where, error)) from None
    try:
        document = tomllib.loads(text)
    except RecursionError:
        raise StudyError(must_be("syntax", where, "TOML of a few levels", "hundreds of them")
                         ) from None
    except ValueError as error:  # a syntax error, or an integer with thousands of digits
        raise StudyError(
            must_be("syntax", where, "complete TOML", f"'{error}'", "Is it a map or a table of "
                    "blocks? Commands take the study file first." if path.suffix == ".csv"
                    else _syntax_hint(text, str(error)))
        ) from None
    document = with_free_blocks(document, path.parent, where)
    study = _with_table(parse_study(document, where), path.parent, where)
    for doubt in _doubted_units(study):
        warnings.warn(f"{where[0].upper()}{where[1:]}: {doubt}", HalbachWarning, stacklevel=3)
    return study


def _syntax_hint(text: str, error: str) -> str:
    """Return what to do about a line that TOML does not allow."""
    place = re.search(r"at line (\d+), column", error)
    line = text.split("\n")[int(place[1]) - 1] if place else ""
    if re.search(r"=\s*-?\d+,\d", line):
        return f"Write decimals with a point in “{printable(line.strip(), MAX_QUOTED)}”."
    if "twice" in error:
        return "Join the two tables or keys into one."
    return "Correct that line."


def _doubted_units(study: Study) -> list[str]:
    """Return sentences about numbers that are possible, but rather in another unit, or idle."""
    # Angle above which no mapper is turned by mistake, and the distance, in steps of 15 degrees,
    # from the next one beyond which it is not turned on purpose.
    large_turn_rad, off_step = 0.3, 0.05
    large_block_m = 1.0  # size of no block of a magnet: it would weigh some tons
    small_iron_m = 1e-3  # size of no body of iron that is worth a file
    found = []
    for instrument in (study.instrument, *(one.instrument for one in study.maps)):
        for turn in instrument.rotation_rad if instrument else ():
            steps = turn / (np.pi / 12)  # on purpose mappers are turned by some 15 degrees
            by_hand = round(turn, 2) == turn  # what halbach-fe register finds has more digits
            if by_hand and abs(turn) > large_turn_rad and abs(steps - round(steps)) > off_step:
                found.append(f"`instrument.rotation_rad` turns the map by {np.degrees(turn):.0f}°. "
                             f"Were degrees meant? Then write {np.radians(turn):.3g} for "
                             f"{turn:.4g}.")
        if instrument and instrument.memory_rows and not instrument.memory:
            found.append("`instrument.memory_rows` is without effect, as `instrument.memory`, how "
                         "much of each reading comes from those before it, is 0.")
    thick = study.array.outer_radius_m - study.array.inner_radius_m
    if study.array.rings and thick > large_block_m:
        found.append(f"its blocks are {thick:.3g} m thick. Were other units than metres meant?")
    for number, body in enumerate(study.iron.bodies if study.iron else (), start=1):
        if body.kind == "stl" and body.triangles_m:
            largest = np.ptp(np.array(body.triangles_m).reshape(-1, 3), axis=0).max()
            if largest < small_iron_m:
                found.append(f"`iron.bodies[{number}]` is only {1e3 * largest:.3g} mm large. Were "
                             "metres or inches meant? Then set its unit_m to 1 or 0.0254.")
    found += _doubted_curves(study)
    found += (f"`array{key}`: {doubt}" for key, one in (
        ("", study.array), *((f".ring[{number}]", ring)
                             for number, ring in enumerate(study.array.ring, start=1)))
        if (doubt := one.doubt))
    return found


def _doubted_curves(study: Study) -> Iterator[str]:
    """Yield sentences about tables of steel whose H is rather in another unit."""
    high_permeability = 2e4  # relative; of steels that are not grain-oriented at most some 15 000
    of_all = "iron_ring" if study.iron_ring else "iron"
    irons = [(of_all, iron_of(study)), *(
        (f"iron.bodies[{number}]", body)
        for number, body in enumerate(study.iron.bodies if study.iron else (), start=1))]
    for key, iron in irons:
        if iron and isinstance(iron.curve, TableCurve):
            found = np.max(np.divide(iron.curve.B_T[1:], iron.curve.H_A_per_m[1:])) / materials.MU_0
            if found > high_permeability:
                yield (f"`{key}.curve` has a relative permeability of up to {found:.2g}, as only "
                       "nickel-iron and grain-oriented sheet have. Was its H in Oe or A/cm? Then "
                       "multiply H by 79.58 or 100.")


def parse_study(document: dict[str, Any], where: str = "study") -> Study:
    """Validate a study given as nested dictionaries; raise StudyError as `read_study` does."""
    try:
        return Study.model_validate(document)
    except ValidationError as error:
        raise StudyError(sentence(error, where, Study)) from None


def with_free_blocks(document: dict[str, Any], folder: Path, where: str) -> dict[str, Any]:
    """Return the document with the table of free blocks in place of its file's name."""
    array = document.get("array")
    free = array.get("free_blocks") if isinstance(array, dict) else None
    if not (isinstance(array, dict) and isinstance(free, dict)):
        return document
    file = free.get("file")
    if not (isinstance(file, str) and file.isprintable() and 0 < len(file) <= MAX_PATH):
        return document  # the validation says what is wrong
    if len(free) > 1:
        raise StudyError(must_be("`array.free_blocks`", where, "either a file or columns", "both"))
    table = free_blocks_of_file(folder / file, f" of {where}")
    return document | {"array": array | {"free_blocks": table}}


def _with_table(study: Study, folder: Path, where: str) -> Study:
    """Return the study with the numbers of its H(B) files in place of the files' names."""
    key = "iron_ring" if study.iron_ring is not None else "iron"
    iron = iron_of(study)
    if iron is None:
        return study
    found = iron.with_(curve=_read_curve(iron.curve, key, folder, where))
    if isinstance(found, Iron):
        found = found.with_(bodies=tuple(
            _with_triangles(body, f"{key}.bodies[{number}]", folder, where).with_(
                curve=_read_curve(body.curve, f"{key}.bodies[{number}]", folder, where))
            for number, body in enumerate(found.bodies, start=1)))
    return study if found == iron else study.with_(**{key: found})


def _with_triangles(body: IronBody, key: str, folder: Path, where: str) -> IronBody:
    """Return a body of iron with the triangles of its file, if it has one."""
    if body.kind != "stl" or body.file is None:
        return body
    with _reading(folder / body.file, f"{key}.file", where, "a closed surface in an STL file"
                  ) as path:
        triangles = closed_surface(body.unit_m * read_stl(path)).tolist()
        # the triangles are in m: the unit was that of the file
        return body.with_(file=None, triangles_m=triangles,
                          unit_m=type(body).model_fields["unit_m"].default)


@contextmanager
def _reading(path: Path, key: str, where: str, what: str) -> Iterator[Path]:
    """Tell in one sentence why a file that the study names cannot be used."""
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ValueError("it must be a file")  # reading a device might never end
        yield path
    except OSError as error:
        raise StudyError(must_be(f"`{key}`", where, "a readable file",
                                 f"{str(path)!r} ({error.strerror})",
                                 "Give its path from the study's folder.")) from None
    except ValueError as error:
        wrong = reason(error) if isinstance(error, ValidationError) else error
        raise StudyError(must_be(f"`{key}`", where, what,
                                 f"{str(path)!r}, which cannot be used: {wrong}")) from None


def _read_curve(curve: IronCurve | None, key: str, folder: Path, where: str) -> IronCurve | None:
    """Return a curve with the numbers of its file, if it has one."""
    if curve is None or curve.kind != "table" or not curve.file:
        return curve
    with _reading(folder / curve.file, f"{key}.curve.file", where, "a table of H(B)") as path:
        field, flux_density = materials.read_table(path)
        return TableCurve(kind="table", H_A_per_m=field, B_T=flux_density)
