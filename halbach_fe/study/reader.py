"""Reading and validation of study files.

Every error message is one sentence that names the file, the key, and what to do.
"""

from __future__ import annotations

import difflib
import re
import tomllib
import types
import typing
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ValidationError

from halbach_fe.core.arguments import typed
from halbach_fe.core.errors import MAX_QUOTED, HalbachWarning, StudyError, must_be, printable
from halbach_fe.core.files import as_path
from halbach_fe.study import materials, sentences
from halbach_fe.study.free_blocks import MAX_PATH
from halbach_fe.study.free_blocks_file import free_blocks_of_file
from halbach_fe.study.iron import Iron, IronCurve, TableCurve
from halbach_fe.study.model import Study, iron_of

LARGE_TURN_RAD, OFF_STEP = 0.3, 0.05
"""Angle above which no mapper is turned by mistake, and the distance, in steps of 15 degrees, from
the next one beyond which it is not turned on purpose."""


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
        raise StudyError(
            must_be("encoding", where, "UTF-8", f"byte 0x{raw[error.start]:02x} at {error.start}",
                    "Save it as UTF-8 text.")
        ) from None
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
    """Return sentences about numbers that are possible, but rather in another unit."""
    large_block_m = 1.0  # size of no block of a magnet: it would weigh some tons
    found = []
    for instrument in (study.instrument, *(one.instrument for one in study.maps)):
        for turn in instrument.rotation_rad if instrument else ():
            steps = turn / (np.pi / 12)  # on purpose mappers are turned by some 15 degrees
            by_hand = round(turn, 2) == turn  # what halbach-fe register finds has more digits
            if by_hand and abs(turn) > LARGE_TURN_RAD and abs(steps - round(steps)) > OFF_STEP:
                found.append(f"`instrument.rotation_rad` turns the map by {np.degrees(turn):.0f}°. "
                             f"Were degrees meant? Then write {np.radians(turn):.3g} for "
                             f"{turn:.4g}.")
    thick = study.array.outer_radius_m - study.array.inner_radius_m
    if study.array.rings and thick > large_block_m:
        found.append(f"its blocks are {thick:.3g} m thick. Were other units than metres meant?")
    return found


def parse_study(document: dict[str, Any], where: str = "study") -> Study:
    """Validate a study given as nested dictionaries; raise StudyError as `read_study` does."""
    try:
        return Study.model_validate(document)
    except ValidationError as error:
        raise StudyError(_sentence(error, where)) from None


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
            body.with_(curve=_read_curve(body.curve, f"{key}.bodies[{number}]", folder, where))
            for number, body in enumerate(found.bodies)))
    return study if found == iron else study.with_(**{key: found})


def _read_curve(curve: IronCurve | None, key: str, folder: Path, where: str) -> IronCurve | None:
    """Return a curve with the numbers of its file, if it has one."""
    if curve is None or curve.kind != "table" or not curve.file:
        return curve
    path = folder / curve.file
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ValueError("it must be a file")  # reading a device might never end
        field, flux_density = materials.read_table(path)
        return TableCurve(kind="table", H_A_per_m=field, B_T=flux_density)
    except OSError as error:
        raise StudyError(must_be(f"`{key}.curve.file`", where, "a readable file",
                                 f"{str(path)!r} ({error.strerror})",
                                 "Give its path from the study's folder.")) from None
    except ValueError as error:
        wrong = sentences.reason(error) if isinstance(error, ValidationError) else error
        raise StudyError(must_be(f"`{key}.curve.file`", where, "a table of H(B)",
                                 f"{str(path)!r}, which cannot be used: {wrong}")) from None


def _sentence(error: ValidationError, where: str) -> str:
    """Return one sentence about the first of pydantic's errors, and the number of the others."""
    errors = error.errors(include_url=False)
    # An unknown key is the likeliest cause of the others: a misspelt key is also a missing key.
    errors.sort(key=lambda e: e["type"] != "extra_forbidden")
    first = errors[0]
    key, model = _locate(first["loc"])
    value, kind = first.get("input"), first["type"]
    expected, received, hint = sentences.expected(first), sentences.received(value), ""
    if (ours := sentences.contradiction(first)) is not None:
        return (f"Input `{key or 'the whole'}` of {where} must be consistent: {ours}."
                + _more(errors))
    if kind == "extra_forbidden":
        name = str(first["loc"][-1])
        near = difflib.get_close_matches(name, model.model_fields if model else [], 1, 0.5)
        hint = (sentences.did_you_mean(near[0], name) if near
                else f"Known keys here: {', '.join(model.model_fields)}." if model else "")
        if not near and len(first["loc"]) > 1 and name in Study.model_fields and not isinstance(
                value, Mapping):
            hint = f"`{name}` stands at the top of the file, above the first table."
        received = f"`{name}`"
    elif kind == "missing":
        received, hint = "nothing", "Add the key."
    elif kind.startswith("union_tag"):  # pydantic locates the table, of which one key says its kind
        name = first["ctx"]["discriminator"].strip("'")
        key, received = f"{key}.{name}", sentences.received(value.get(name))
        tags = _tags_at(first["loc"], name)
        near = difflib.get_close_matches(str(value.get(name)), tags, 1, 0.5)
        hint = f"Did you mean '{near[0]}'?" if near else ""
        if kind == "union_tag_not_found":
            hint = f"Add the key, as one of {', '.join(map(repr, tags))}."
    elif kind == "model_type" and isinstance(value, list) and all(
            isinstance(one, dict) for one in value):
        hint = f"Write [{key}] for [[{key}]], and all keys in that one table."
    elif kind == "tuple_type" and isinstance(value, dict) and _holds_tables(model, first["loc"]):
        hint = f"Write [[{key}]] for [{key}], and once more for each further one."
    else:
        hint = sentences.hint(key, first)
    return must_be(f"`{key}`", where, expected, received, hint) + _more(errors)


def _holds_tables(model: type[BaseModel] | None, location: tuple[int | str, ...]) -> bool:
    """Return whether a key of a model is a list of tables."""
    field = model.model_fields.get(str(location[-1])) if model else None
    return field is not None and any(map(_models_in, typing.get_args(field.annotation)))


def _more(errors: list[Any]) -> str:
    return f" ({len(errors) - 1} more in this file.)" if len(errors) > 1 else ""


def _locate(location: tuple[int | str, ...]) -> tuple[str, type[BaseModel] | None]:
    """Return the dotted key of a pydantic location, and the model that holds its last part.

    pydantic puts the tag of a discriminated union into the location. It is left out here, because
    it is no key of the file.
    """
    models: list[type[BaseModel]] = [Study]
    owner: type[BaseModel] | None = Study
    parts: list[str] = []
    for part in location:
        if part == sentences.KEY:
            continue
        if isinstance(part, int):
            parts[-1] += f"[{part}]"
            continue
        tagged = [m for m in models if len(models) > 1 and part in _tags(m)]
        if tagged:
            models = owner_models = tagged
            owner = owner_models[0]
            continue
        owner = models[0] if models else None
        parts.append(part)
        field = owner.model_fields.get(part) if owner else None
        models = _models_in(field.annotation) if field else []
    return ".".join(parts), owner


def _tags_at(location: tuple[int | str, ...], name: str) -> list[str]:
    """Return the possible values of the key ``name``, the kind of table, at a pydantic location."""
    models: list[type[BaseModel]] = [Study]
    for part in location:
        tagged = [model for model in models if len(models) > 1 and part in _tags(model)]
        if tagged or isinstance(part, int):
            models = tagged or models
            continue
        field = models[0].model_fields.get(part) if models else None
        models = _models_in(field.annotation) if field else []
    return [str(tag) for model in models for tag in get_args(model.model_fields[name].annotation)]


def _tags(model: type[BaseModel]) -> set[str]:
    """Return the values of a model's literal keys, which tag it in a discriminated union."""
    return {
        str(value)
        for field in model.model_fields.values()
        if get_origin(field.annotation) is Literal
        for value in get_args(field.annotation)
    }


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return all models that a type annotation mentions, in order."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    if get_origin(annotation) in (Union, types.UnionType, Annotated, tuple):
        return [model for arg in get_args(annotation) for model in _models_in(arg)]
    return []
