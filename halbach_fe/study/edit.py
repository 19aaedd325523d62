"""Changes of a study written into the user's own file, whose comments and order stay.

What differs between the study of the file and another one is set key by key, each with a note; keys
that go become comments. Numbers are written in full: the file reads back to exactly that study.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, MutableMapping
from typing import Any

import tomlkit
from pydantic import BaseModel
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, Array, InlineTable, Item, Table

from halbach_fe.core.errors import StudyError
from halbach_fe.study.inference import ExcludedReading
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study

LOST = ("Written anew: the study's own file cannot be changed key by key, so that its comments are "
        "there only.")

Keys = MutableMapping[str, Any]


def edited_text(text: str, steps: Iterable[tuple[Study, str]]) -> str:
    """A study file changed step by step.

    A file whose layout defeats that (tables that come in several pieces) is written anew.

    Parameters
    ----------
    text : str
        Of the file.
    steps : iterable of (Study, str)
        Studies, each with what its difference from the one before is for. Where the file names an
        H(B) table, a study holds its numbers, and so will the file.

    Raises
    ------
    StudyError
        If a study is none that a file could hold.
    """
    notes = []
    for study, note in steps:
        parse_study(study.model_dump(), f"changed study {study.name}")
        before = parse_study(tomllib.loads(text))
        if before == study:
            continue
        notes.append(note)
        try:
            document = tomlkit.parse(text)
            _change(document, before, study, note)
            text = tomlkit.dumps(document)
            whole = parse_study(tomllib.loads(text)) == study
        except (TOMLKitError, tomllib.TOMLDecodeError, StudyError):
            whole = False
        if not whole:
            text = _anew(study, [LOST, *notes])
        elif note not in text:  # tables in several pieces have no room for it
            text = f"# {note}\n{text}"
    return text


def _change(table: Keys, before: BaseModel, after: BaseModel, note: str) -> None:
    """Set in a table what differs between two models of it."""
    there = set(table)
    for name in type(after).model_fields:
        old, new = getattr(before, name), getattr(after, name)
        if old == new:
            continue
        if new is None:
            _retire(table, name)
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
    """Set what differs between two lists of tables, the second not shorter than the first."""
    if name not in table:
        in_rows = _in_line(table) or isinstance(after[0], ExcludedReading)  # many, and short
        table[name] = [] if in_rows else tomlkit.aot()
    there = table[name]
    for number, (old, new) in enumerate(zip(before, after, strict=False)):
        _change(there[number], old, new, _inside(there, note))
    for new in after[len(before):]:
        if isinstance(there, AoT):
            there.append(_table(new, note))
            there[-1].trivia.indent = ""  # of two empty lines one is enough
        else:
            there.append(_plain(new))
    _note_beside(there, note)


def _set(table: Keys, name: str, value: object, note: str) -> None:
    """Set a key, with a note beside it where there is room for one."""
    if isinstance(value, BaseModel) and not _in_line(table):
        table[name] = _table(value, note)
        return
    table[name] = _plain(value)
    _add_note(table[name], note)


def _move_up(table: Keys, old: set[str]) -> None:
    """Put new keys right behind the old ones, before comments that belong to what follows."""
    if not isinstance(table, Table) or not old:
        return
    body = table.value.body
    names = {number: key.key for number, (key, item) in enumerate(body)
             if key and not isinstance(item, Table | AoT)}
    last = max((number for number, name in names.items() if name in old), default=-1)
    moved = [number for number, name in names.items() if name not in old and number > last]
    rest = [pair for number, pair in enumerate(body) if number not in moved]
    body[:] = [*rest[:last + 1], *(body[number] for number in moved), *rest[last + 1:]]


def _retire(table: Keys, name: str) -> None:
    """Take a key away; its line stays as a comment, where a comment may stand."""
    if not isinstance(table, Table):
        table.pop(name)
        return
    body, item = table.value.body, table[name]
    place = next(number for number, (key, _) in enumerate(body) if key and key.key == name)
    line = f"{name} = {item.as_string()}  {item.trivia.comment}"
    table.remove(name)
    body[place] = (None, tomlkit.comment(line.strip()))


def _in_line(item: object) -> bool:
    """Whether it stands on one line, and has no room for notes in it."""
    return isinstance(item, InlineTable | Array)


def _table(model: BaseModel, note: str) -> Table:
    """A table of its own, what is in it in line."""
    table = tomlkit.table()
    for name, value in model.model_dump(mode="json", exclude_defaults=True).items():
        table[name] = _plain(value)
    _add_note(table, note)
    table.add(tomlkit.nl())
    return table


def _plain(value: object) -> object:
    """A value to stand on one line."""
    if isinstance(value, BaseModel):
        value = value.model_dump(mode="json", exclude_defaults=True)
    if isinstance(value, tuple | list):
        return [_plain(one) for one in value]
    if not isinstance(value, dict):
        return value
    table = tomlkit.inline_table()
    for name, one in value.items():
        table[name] = _plain(one)
    return table


def _inside(item: object, note: str) -> str:
    """The note for changes within an item, if there is room for one."""
    return "" if _in_line(item) else note


def _note_beside(item: Any, note: str) -> None:
    """A note for changes within what has no room for one."""
    if _in_line(item):
        _add_note(item, note)


def _add_note(item: Item, note: str) -> None:
    there = item.trivia.comment.lstrip("# ").rstrip()
    if note and note not in there:
        item.comment(f"{there}; {note}" if there else note)
        item.trivia.comment_ws = "  "


def _anew(study: Study, notes: list[str]) -> str:
    lines = "".join(f"# {note}\n" for note in notes if note)
    return f"{lines}\n{tomlkit.dumps(study.model_dump(mode='json', exclude_defaults=True))}"
