"""What the functions and results of the Python interface share: arguments of the types that are
named, and results that show their main figure in a notebook, and one line elsewhere.

A result knows nothing of figures: the report room draws them. So the drawing is looked up by the
type of the result when a notebook asks for it, in `halbach_fe.report.page`.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import os
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from fractions import Fraction
from itertools import islice
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeVar

from halbach_fe.core.errors import MeasurementError, StudyError, must_be

P = ParamSpec("P")
R = TypeVar("R")

READERS = {"BlockTable": "Read the file by hf.read_blocks.",
           "Study": "Read the file by hf.read_study.",
           "Magnet": "hf.build_magnet makes one of a study.",
           "Session": "hf.Session.open makes one.",
           "Dataset": "Read the file by read_map, and the maps that a study lists by read_maps.",
           "FreeBlocks": 'One block is {"shape": ["cuboid"], "x_m": [0.0], ...}.',
           "path": "Give it as text."}
"""How to come by an object of a class."""
ONCE = "It can be read only once; make a list of it."
"""What to do with a generator or another iterator, which a look at its kinds would empty."""
MOST = 1000
"""Most elements of a list whose kinds are looked at."""


def typed(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that refuses missing and unknown arguments, and those of other kinds than
    it is annotated with: objects of classes, numbers, texts, lists, mappings, functions.

    It raises a StudyError, of a map a MeasurementError. Whether a number or a name is one that the
    function takes, it tells itself.
    """
    signature = inspect.signature(function)

    @functools.cache
    def hints() -> dict[str, Any]:
        named = typing.get_type_hints(function)
        return {name: named[name] for name, one in signature.parameters.items()
                if name in named and one.kind is not one.VAR_KEYWORD}

    @functools.wraps(function)
    def checked(*arguments: P.args, **options: P.kwargs) -> R:
        called = function.__qualname__
        try:
            bound = signature.bind(*arguments, **options)
        except TypeError as error:
            names = [name for name in signature.parameters if name != "cls"]
            raise StudyError(f"Arguments of {called} must be {', '.join(names)}; instead: "
                             f"{error}.") from None
        for name, value in bound.arguments.items():
            if name in hints() and not _fits(value, hints()[name]):
                raise _refusal(name, called, value, hints()[name])
        return function(*arguments, **options)

    return checked


def _refusal(name: str, where: str, value: object, hint: Any) -> MeasurementError | StudyError:
    """Return the error of a value that is not of the kind that an annotation names."""
    wanted = _kinds(hint)
    text = isinstance(value, str) and "a number" in wanted
    refusal = MeasurementError if "a Dataset" in wanted else StudyError
    kind = type(value).__name__
    if isinstance(value, list | tuple):  # of which an element may be wrong
        kind += next((f" of {type(one).__name__}" for one in value if not _fits([one], hint)), "")
    return refusal(must_be(
        name, where, " or ".join(wanted),
        repr(value) if text else value if isinstance(value, Real) else f"a {kind}",
        ONCE if isinstance(value, Iterator) and any(one.startswith("a list") for one in wanted) else
        "Take float() of it." if isinstance(value, Fraction) and "a number" in wanted else
        READERS.get(wanted[0].split()[-1], "")))


def _fits(value: object, hint: Any) -> bool:
    """Tell whether a value is of the kind that an annotation names, as far as that is known."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if hint in (int, float):
        return _is_number(value)
    if hint is bool:
        return isinstance(value, bool) or (type(value).__module__ == "numpy" and (
            str(getattr(value, "dtype", "")) == "bool"))
    if hint is str or origin is Literal:
        return isinstance(value, str)
    if hint is Path:
        return isinstance(value, os.PathLike)
    if origin in (Sequence, list, tuple):
        if isinstance(value, str):
            return str in parts or any(str in typing.get_args(part) for part in parts)
        return isinstance(value, Iterable) and not isinstance(
            value, bytes | Iterator | Mapping) and (
                getattr(value, "shape", None) != () and all(
                _fits(one, part) for part in parts[:1] for one in islice(value, MOST)))
    if origin in (Mapping, dict):  # or a DataFrame
        return isinstance(value, Mapping) or (
            hasattr(value, "keys") and not isinstance(value, type))
    if origin is Callable:
        return callable(value)
    try:
        return not isinstance(hint, type) or isinstance(value, hint)
    except TypeError:  # some protocols cannot be asked for
        return True


def _is_number(value: object) -> bool:
    """Tell whether a value is a real number, or an array of one alone."""
    try:
        float(typing.cast(Any, value))
    except (TypeError, ValueError, OverflowError):
        return False
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    return kind in "iuf" if kind else (
        isinstance(value, float | Integral) and not isinstance(value, bool))


def _kinds(hint: Any) -> list[str]:
    """Return the kinds that an annotation names, in words; None is left out."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if parts == (str, Path):
        return ["a path"]
    if origin in (typing.Union, UnionType):
        return list(dict.fromkeys(kind for part in parts for kind in _kinds(part)))
    if hint is NoneType:
        return []
    if origin in (Sequence, list, tuple) and parts[0] in (str, int, float):
        return ["a list of text" if parts[0] is str else "a list of numbers"]
    words = {int: "a number", float: "a number", bool: "True or False", str: "text",
             Literal: "text", Path: "a path", Sequence: "a list", list: "a list", tuple: "a list",
             Mapping: "a dict", dict: "a dict", Callable: "a function"}
    name = getattr(hint, "__name__", str(hint))
    return [words.get(origin or hint) or f"{'an' if name[0] in 'AEIO' else 'a'} {name}"]


def check_options(given: Mapping[str, object], kind: type, where: str, *unused: str) -> None:
    """Refuse options that are no fields of a dataclass, or are of other kinds than it annotates.

    Fields that are ``unused`` are refused too; so is a text in place of a list.

    Raises
    ------
    StudyError
    """
    hints = {name: hint for name, hint in typing.get_type_hints(kind).items()
             if name in {one.name for one in fields(kind)} - {*unused}}
    for name, value in given.items():
        if name not in hints:
            raise StudyError(must_be(name, where, f"left out, or one of {', '.join(hints)}",
                                     repr(value)))
        of_list = typing.get_origin(hints[name]) is tuple and isinstance(value, str)
        if of_list or not _fits(value, hints[name]):
            raise _refusal(name, where, value, hints[name])


DRAWN_BY = "halbach_fe.report.page"

LONGEST = 60
"""Length of a text that a line of a result still shows."""


class ShownInNotebook:
    """Base of results with a figure or table of their own, which are dataclasses."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Keep the dataclass from making a text of all numbers of a result."""
        super().__init_subclass__(**options)
        if "__repr__" not in vars(cls):
            cls.__repr__ = ShownInNotebook.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        """Return a line: short values in full, names and shapes of the others."""
        said = (f"{one.name}={short}" for one in fields(self)  # type: ignore[arg-type]
                if one.repr and (short := _short(getattr(self, one.name))))
        return f"{type(self).__name__}({', '.join(said)})"

    def _repr_html_(self) -> str:
        """Return the main figure, or table, as HTML without any reference to other files."""
        return str(importlib.import_module(DRAWN_BY).html_of(self))


def _short(value: object) -> str:
    """Return a short text of a value; nothing if it has none."""
    if value is None or isinstance(value, bool | int | float | str):
        text = f"{value:.4g}" if isinstance(value, float) else repr(value)
        return text if len(text) <= LONGEST else ""
    shape, name = getattr(value, "shape", None), getattr(value, "name", None)
    if isinstance(shape, tuple):
        return f"{' x '.join(map(str, shape))} values"
    return f"'{name}'" if isinstance(name, str) else ""
