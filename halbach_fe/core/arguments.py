"""Whether functions of the Python interface are called with objects of the types that they name."""

from __future__ import annotations

import functools
import inspect
import os
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ParamSpec, TypeVar

from halbach_fe.core.errors import StudyError, must_be

P = ParamSpec("P")
R = TypeVar("R")

READERS = {"BlockTable": "Read the file by hf.read_blocks.",
           "Study": "Read the file by hf.read_study.",
           "Magnet": "hf.build_magnet makes one of a study.",
           "Session": "hf.Session.open makes one.",
           "path": "Give it as text."}
"""How to come by an object of a class."""


def typed(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function that refuses, by a StudyError, missing arguments and those of other
    classes than its own.

    Only arguments that are annotated by classes of halbach-fe, by ``str | Path``, or by such a
    class or None, are checked.
    """
    signature = inspect.signature(function)

    @functools.cache
    def classes() -> dict[str, tuple[type, ...]]:
        return {name: found for name, hint in typing.get_type_hints(function).items()
                if name != "return" and (found := _own_classes(hint))}

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
            expected = classes().get(name)
            if expected and not isinstance(value, expected):
                wanted = "path" if expected[0] is str else expected[0].__name__
                article = "an" if wanted[0] in "AEIO" else "a"
                raise StudyError(must_be(name, called, f"{article} {wanted}",
                                         f"a {type(value).__name__}", READERS.get(wanted, "")))
        return function(*arguments, **options)

    return checked


def _own_classes(hint: Any) -> tuple[type, ...]:
    """Return the classes of an annotation that are halbach-fe's, paths or None; else nothing."""
    if typing.get_args(hint) == (str, Path):
        return str, os.PathLike
    parts = typing.get_args(hint) if isinstance(hint, UnionType) else (hint,)
    own = tuple(part for part in parts if isinstance(part, type)
                and part.__module__.startswith("halbach_fe."))
    return (*own, NoneType) if own and {*parts} - {*own} == {NoneType} else (
        own if len(own) == len(parts) else ())


def refuse_unknown(given: Mapping[str, object], names: Sequence[str], where: str) -> None:
    """Refuse options of other names by a StudyError."""
    if unknown := sorted(given.keys() - {*names}):
        raise StudyError(must_be(unknown[0], where, f"left out, or one of {', '.join(names)}",
                                 repr(given[unknown[0]])))
