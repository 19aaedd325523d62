"""Writing of study files: new ones with comments, and changes of a user's file in place.

A change leaves comments and the order of keys as they are. Every key whose value differs between
the study in the file and the wanted study is set, with a note beside it that says why; a key that
is removed stays as a comment. Numbers are written with all digits: the edited file reads back to
exactly the wanted study.

A table of free blocks does not change. The edited file, which may lie in another folder, refers to
a copy of it.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterable, Mapping, MutableMapping
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jinja2
import numpy as np
import tomlkit
from pydantic import BaseModel
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Array, InlineTable, Item, Table

from halbach_fe.core.errors import OutputError, StudyError, must_be
from halbach_fe.core.files import write_text
from halbach_fe.study.free_blocks import FreeBlocks, free_blocks_of_file, write_free_blocks
from halbach_fe.study.inference_keys import ExcludedReading
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study, with_free_blocks
from halbach_fe.study.types import MIN_LENGTH_M

REWRITTEN_NOTE = ("Rewritten in full: the original study file could not be changed key by key. Its "
                  "comments are in the original only.")
"""First line of a file that could not be edited in place."""

FREE_BLOCKS_FILE = "free_blocks.csv"
"""Name of the table of free blocks beside an edited file."""

COPIED_NOTE = "a copy beside this file"

Keys = MutableMapping[str, Any]


def edited_text(text: str, steps: Iterable[tuple[Study, str]]) -> str:
    """Return the text of a study file after a series of changes.

    If the layout of the file prevents an edit in place (tables that are split into several pieces,
    for example), the whole file is rewritten from the study, and a comment at its top says so.

    Parameters
    ----------
    text : str
        Content of the study file.
    steps : iterable of (Study, str)
        The successive studies, each with a note that says why it differs from the study before.
        Where the file refers to a file of an H(B) curve, the studies hold the numbers of that
        curve, and so does the returned text. If the file refers to a table of free blocks, the
        returned text refers to `FREE_BLOCKS_FILE`, see `write_edited`.

    Raises
    ------
    StudyError
        If a study is not valid.
    """
    notes = []
    text = text.removeprefix("\ufeff")  # a byte order mark, which TOML does not know
    for study, note in steps:
        parse_study(study.model_dump(), f"changed study {study.name}")
        before = _parsed(text, study)
        if before == study:
            continue
        notes.append(note)
        try:
            document = tomlkit.parse(text)
            _change(document, before, study, note)
            text = tomlkit.dumps(document)
            whole = _parsed(text, study) == study
        except (TOMLKitError, tomllib.TOMLDecodeError, StudyError):
            whole = False
        if not whole:
            text = _rewritten(study, [REWRITTEN_NOTE, *notes])
        elif note not in text:  # a table in several pieces has no line to put the note on
            text = f"# {note}\n{text}"
    return _with_copy(text)


def write_edited(path: Path, text: str, steps: Iterable[tuple[Study, str]]) -> None:
    """Write the text of a study file after a series of changes, see `edited_text`.

    A table of free blocks is written beside it.
    """
    studies = list(steps)
    write_text(path, edited_text(text, studies))
    table = studies[-1][0].array.free_blocks if studies else None
    if table is not None:
        write_free_blocks(table, path.with_name(FREE_BLOCKS_FILE))


def _parsed(text: str, study: Study) -> Study:
    """Return the study of a text; a table of free blocks that it refers to is that of ``study``."""
    document = tomllib.loads(text)
    if _refers_to_blocks(document):
        array = document["array"] | {"free_blocks": study.array.free_blocks}
        document |= {"array": array}
    return parse_study(document)


def _refers_to_blocks(document: Mapping[str, Any]) -> bool:
    """Tell whether a document refers to a file of free blocks."""
    array = document.get("array")
    free = array.get("free_blocks") if isinstance(array, Mapping) else None
    return isinstance(free, Mapping) and "file" in free


def _with_copy(text: str) -> str:
    """Return the text with a reference to the copy of the table of free blocks, if it has one."""
    document = tomlkit.parse(text)
    if not _refers_to_blocks(document):
        return text
    free = document["array"]["free_blocks"]
    _set(free, "file", FREE_BLOCKS_FILE, _inside(free, COPIED_NOTE))
    return tomlkit.dumps(document)


def _change(table: Keys, before: BaseModel, after: BaseModel, note: str) -> None:
    """Set those keys of a table that differ between two models, and leave the others alone."""
    there = set(table)
    for name in type(after).model_fields:
        old, new = getattr(before, name), getattr(after, name)
        if old == new:
            continue
        if new is None:
            _comment_out(table, name)
        elif isinstance(new, FreeBlocks):
            _set(table, name, {"file": FREE_BLOCKS_FILE}, note)
        elif isinstance(new, BaseModel) and type(old) is type(new):
            if name not in table:
                table[name] = tomlkit.inline_table() if _in_line(table) else tomlkit.table()
            _change(table[name], old, new, _inside(table[name], note))
            _note_beside(table[name], note)
        elif isinstance(new, tuple) and new and isinstance(new[0], BaseModel):
            _change_list(table, name, old, new, note)
        elif isinstance(new, dict) and name in table and not _in_line(table[name]):
            for key in [key for key in new if old.get(key) != new[key]]:
                _set(table[name], key, new[key], note)
        else:
            _set(table, name, new, note)
    _move_up(table, there)


def _change_list(
    table: Keys, name: str, before: tuple[BaseModel, ...], after: tuple[BaseModel, ...], note: str
) -> None:
    """Set the keys that differ between two lists of tables, and append the new tables.

    Where some are gone, all are written anew.
    """
    if name not in table or len(after) < len(before):
        before = ()
        # excluded readings are many and short: one inline list reads better than many tables
        in_rows = _in_line(table) or isinstance(after[0], ExcludedReading)
        table[name] = [] if in_rows else tomlkit.aot()
    there = table[name]
    place = number = 0
    while number < len(before):
        old, table = before[number], there[place]
        # of equal rings, which are one table of the file
        count = table.get("count", 1) if getattr(old, "count", None) == 1 else 1
        if count > 1 and before[number:number + count] != after[number:number + count]:
            del table["count"]
            for _ in range(1, count):
                there.insert(place + 1, deepcopy(table))
            count = 1
        if count == 1:
            _change(table, old, after[number], _inside(there, note))
        place, number = place + 1, number + count
    for new in after[len(before):]:
        if isinstance(there, AoT):
            there.append(_table(new, note))
            there[-1].trivia.indent = ""  # tomlkit would add a second empty line
        else:
            there.append(_plain(new))
    _note_beside(there, note)


def _set(table: Keys, name: str, value: object, note: str) -> None:
    """Set a key, with a note beside it if it stands on a line of its own."""
    if isinstance(value, BaseModel) and not _in_line(table):
        table[name] = _table(value, note)
        return
    plain = _plain(value)
    truth = tomlkit.item(plain) if isinstance(plain, bool) else None  # tables give it back as bool
    table[name] = plain if truth is None else truth
    _add_note(table[name] if truth is None else truth, note)


def _move_up(table: Keys, old: set[str]) -> None:
    """Move new keys right after the old ones, before comments that belong to the next table."""
    if not isinstance(table, Table) or not old:
        return
    body = table.value.body
    names = {number: key.key for number, (key, item) in enumerate(body)
             if key and not isinstance(item, Table | AoT)}
    last = max((number for number, name in names.items() if name in old), default=-1)
    moved = [number for number, name in names.items() if name not in old and number > last]
    rest = [pair for number, pair in enumerate(body) if number not in moved]
    body[:] = [*rest[:last + 1], *(body[number] for number in moved), *rest[last + 1:]]


def _comment_out(table: Keys, name: str) -> None:
    """Remove a key; its line stays as a comment, except in inline tables, which have no lines."""
    if not isinstance(table, Table):
        table.pop(name)
        return
    body, item = table.value.body, table[name]
    place = next(number for number, (key, _) in enumerate(body) if key and key.key == name)
    line = f"{name} = {item.as_string()}  {item.trivia.comment}"
    table.remove(name)
    body[place] = (None, tomlkit.comment(line.strip()))


def _in_line(item: object) -> bool:
    """Whether an item stands on one line, so that notes cannot stand inside it."""
    return isinstance(item, InlineTable | Array)


def _table(model: BaseModel, note: str) -> Table:
    """Return a model as a table with a header of its own; tables within it are inline."""
    table = tomlkit.table()
    for name, value in model.model_dump(mode="json", exclude_defaults=True).items():
        table[name] = _plain(value)
    _add_note(table, note)
    table.add(tomlkit.nl())
    return table


def _plain(value: object) -> object:
    """Return a value in a form that TOML writes on one line."""
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json", exclude_defaults=True)
    if isinstance(value, tuple | list):
        return [_plain(element) for element in value]
    if not isinstance(value, dict):
        return value
    table = tomlkit.inline_table()
    for name, element in value.items():
        table[name] = _plain(element)
    return table


def _inside(item: object, note: str) -> str:
    """Return the note for changes inside an item, or an empty one if the item is inline."""
    return "" if _in_line(item) else note


def _note_beside(item: Any, note: str) -> None:
    """Add the note beside an inline item, for changes inside it."""
    if _in_line(item):
        _add_note(item, note)


def _add_note(item: Item, note: str) -> None:
    """Append a note to the comment at the end of an item's line, unless the comment has it."""
    there = item.trivia.comment.lstrip("# ").rstrip()
    if note and note not in there:
        item.comment(f"{there}; {note}" if there else note)
        item.trivia.comment_ws = "  "


def _rewritten(study: Study, notes: list[str]) -> str:
    """Return `study_text` after some comments."""
    lines = "".join(f"# {note}\n" for note in notes if note)
    return f"{lines}\n{study_text(study)}"


def study_text(study: Study, blocks: str = FREE_BLOCKS_FILE) -> str:
    """Return a study file with all keys of a study that are not defaults.

    It refers to a table of free blocks beside it, the file ``blocks``, see `write_edited`.
    """
    keys = study.model_dump(mode="json", exclude_defaults=True)
    if study.array.free_blocks is not None:
        keys["array"]["free_blocks"] = {"file": blocks}
    return tomlkit.dumps(keys)


TEMPLATE = "new_study.toml.j2"

LATITUDES, ANGLES = 9, 16
"""Number of latitudes, and of points on each, of a sphere that is measured: they determine the
spherical harmonics up to degree 8."""


OUTER_RADIUS = 1.8
"""Outer radius of the blocks of a new study, relative to the inner one, if it is not given."""

AROUND = 1.2
"""Radius of the points about a magnet without a bore, relative to that of the magnet."""


@dataclass(frozen=True)
class MagnetTemplate:
    """Values of the magnet in a new study file; all other values of the file follow from them.

    Lengths are in m, the remanence is in T. ``ring_length_m`` is None for a cross-section.
    ``material`` names a grade of magnet in place of the remanence. ``inner_radii_m`` are the inner
    radii of rings of their own, in the order of z. ``free_blocks`` is the path of a table of blocks
    that takes the place of the rings, from the folder of the study file. ``cube_m`` is the
    edge of cubes, ``radius_m`` the radius of their middles, ``steel`` the name of the steel of the
    iron ring, ``dsv_m`` the diameter of a sphere that is measured in place of circles along the
    magnet. ``sigma_T`` and ``position_sd_m`` are the noise of readings and positions.
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
    material: str | None = None
    inner_radii_m: tuple[float, ...] = ()
    free_blocks: str | None = None
    cube_m: float | None = None
    radius_m: float | None = None
    steel: str | None = None
    dsv_m: float | None = None
    sigma_T: float = 5e-5
    position_sd_m: float = 1e-4


def new_study(
    name: str, magnet: MagnetTemplate, folder: Path = Path(), table: FreeBlocks | None = None
) -> str:
    """Return the text of a valid study file in a folder, with comments that explain its keys.

    ``table`` holds the blocks if they are those of no file yet.

    Raises
    ------
    StudyError
        If no valid study has these values.
    """
    bored = True
    if magnet.free_blocks is not None:
        table = free_blocks_of_file(folder / magnet.free_blocks)
    if table is not None:
        inner, outer = table.radii_m
        bored = inner > MIN_LENGTH_M
        magnet = replace(magnet, outer_radius_m=float(f"{outer:.4g}"), inner_radius_m=float(
            f"{inner if bored else outer / 4:.4g}"))  # of no bore: a scale of the mesh alone
    elif magnet.inner_radii_m:
        magnet = replace(magnet, rings=len(magnet.inner_radii_m),
                         inner_radius_m=min(magnet.inner_radii_m))
    ends = _ends(magnet, table)
    low, high = ends or (0.0, 0.0)
    middle = round((low + high) / 2, 6) + 0.0
    around = 0.0  # radius of the points about a magnet that has no bore to measure in
    if table is not None and not bored and magnet.dsv_m is None:
        around = AROUND * float(np.hypot(magnet.outer_radius_m, (high - low) / 2))
    points = around or (magnet.dsv_m or 0.0) / 2
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("halbach_fe.study", "."), undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    text = environment.get_template(TEMPLATE).render(
        name=_name(name), magnet=magnet, table=table, solid=ends is not None, low=low, high=high,
        middle=middle, around=around, min_length=MIN_LENGTH_M,
        sphere=_sphere(points, middle, flat=ends is None and around > 0) if points else [])
    parse_new_study(text, folder, table)
    return text


def _sphere(radius: float, middle: float, flat: bool) -> list[str]:
    """Return points on a sphere about a ``middle`` on the z axis as TOML, a line for each of Gauss'
    latitudes.

    If ``flat``, of a cross-section, they are those of the equator alone.
    """
    angle = 2 * np.pi * np.arange(ANGLES) / ANGLES
    lines = []
    for height in np.polynomial.legendre.leggauss(1 if flat else LATITUDES)[0]:
        across, z = radius * np.sqrt(1 - height**2), middle + radius * height
        lines.append(", ".join(f"[{x:.5g}, {y:.5g}, {z:.5g}]" for x, y in zip(
            (across * np.cos(angle)).round(9) + 0.0, (across * np.sin(angle)).round(9) + 0.0,
            strict=True)))
    return lines


def _ends(magnet: MagnetTemplate, table: FreeBlocks | None) -> tuple[float, float] | None:
    """Return the lowest and the highest z of the magnet in m, None for a cross-section."""
    if table is not None:
        z, half = table.numbers("z_m", 0.0), table.numbers("size_z_m", 0.0) / 2
        return (float((z - half).min()), float((z + half).max())) if table.size_z_m else None
    end = magnet.rings * (magnet.ring_length_m or 0.0) / 2
    return (-end, end) if end else None


def parse_new_study(text: str, folder: Path = Path(), table: FreeBlocks | None = None) -> Study:
    """Return the study in a new file; raise StudyError if the options make it invalid."""
    where, document = "new study", tomllib.loads(text)
    if table is not None:
        document["array"]["free_blocks"] = table
    return parse_study(with_free_blocks(document, folder, where), where)


def write_new_study(path: Path, magnet: MagnetTemplate) -> None:
    """Write a new study file; an existing file is never overwritten.

    Raises
    ------
    StudyError
        If no valid study has these values.
    OutputError
        If the file exists already, or cannot be written.
    """
    if os.path.lexists(path):
        raise OutputError(must_be("path", "new study", "a file that does not exist yet",
                                  f"'{path}'", "Choose another name, or remove it."))
    write_text(path, new_study(path.stem, magnet, path.parent))


def _name(stem: str) -> str:
    """Return a valid name of a study, made from the name of its file."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", stem).lstrip("._-")[:100]
    return name or "magnet"
