"""Editing of a user's study file in place, so that its comments and the order of its keys stay.

Every key whose value differs between the study in the file and the wanted study is set, with a note
beside it that says why; a key that is removed stays as a comment. Numbers are written with all
digits: the edited file reads back to exactly the wanted study.

A table of free blocks does not change. The edited file, which may lie in another folder, refers to
a copy of it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, MutableMapping
from copy import deepcopy
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import BaseModel
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Array, InlineTable, Item, Table

from halbach_fe.core.errors import StudyError
from halbach_fe.core.files import write_text
from halbach_fe.study.free_blocks_file import write_free_blocks
from halbach_fe.study.inference import ExcludedReading
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study

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
    _set(document["array"]["free_blocks"], "file", FREE_BLOCKS_FILE, COPIED_NOTE)
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

    ``after`` is at least as long as ``before``.
    """
    if name not in table:
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
