"""Keys of a study whose values are uncertain, and changes of the numbers of a study by name."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, Field

from halbach_fe.study.types import Line, StudyModel

if TYPE_CHECKING:
    from halbach_fe.study.model import Study

OF_INSTRUMENTS = ("instrument.", "maps[")
"""Beginnings of the names of numbers that describe an instrument, and not the magnet."""

Derivative = Annotated[float, Field(allow_inf_nan=False)]


class Uncertain(StudyModel):
    """An amplitude of the study whose value is uncertain, and estimated with the blocks.

    ``sd`` is its standard deviation about what the study says, as it was known without the map.
    ``change`` says what a unit of the amplitude changes: numbers of the study by their names, with
    elements of lists counted from 1 (``"array.exceptions[1].shift_m[3]"``), and their changes.
    Changes of the magnet are parameters of its posterior, in units of ``sd``; changes of an
    instrument widen the error bars of the blocks. One amplitude changes either the magnet or
    instruments. `halbach-fe diagnose` writes such tables for the amplitudes that it finds.
    """

    name: Annotated[Line, Field(min_length=1, max_length=200)]
    sd: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
    change: Annotated[dict[Line, Derivative], Field(min_length=1)]

    @property
    def is_of_instrument(self) -> bool:
        """Whether it changes instruments, rather than the magnet."""
        return all(name.startswith(OF_INSTRUMENTS) for name in self.change)


def check_uncertain(study: Study) -> None:
    """Check that every name is that of a number of the study, and no amplitude is listed twice.

    Raises
    ------
    ValueError
        If one is not, or an amplitude changes nothing, or both the magnet and an instrument.
    """
    names = [one.name for one in study.uncertain]
    for one in study.uncertain:
        if names.count(one.name) > 1:
            raise ValueError(f"every table [[uncertain]] needs a name of its own, but two of them "
                             f"have '{one.name}'")
        if not any(one.change.values()):
            raise ValueError(f"uncertain '{one.name}' changes all its numbers by 0; give the "
                             "change of each per unit of the amplitude")
        of_instrument = [name.startswith(OF_INSTRUMENTS) for name in one.change]
        if any(of_instrument) and not all(of_instrument):
            raise ValueError(f"uncertain '{one.name}' changes both the magnet and an instrument; "
                             "give each of them a table of its own")
        for name in one.change:
            if study.maps or not name.startswith("maps["):  # else it is the study of one of them
                _check_number(study, name)


def _check_number(study: Study, name: str) -> None:
    """Check that a name is that of a number that a study states."""
    value: Any = study
    hint = ""
    for step in _steps(name):
        known = dict(_parts(value))
        near = [] if step in known else difflib.get_close_matches(
            str(step), [key for key in known if isinstance(key, str)], 1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        value = known.get(step)
        if value is None:
            break
    if isinstance(value, tuple) and value and isinstance(value[0], float):
        hint = f"; it has {len(value)} of them, the first of which is '{name}[1]'"
    if not isinstance(value, float):
        raise ValueError(f"uncertain.change names '{name}', which must be a number with a "
                         f"fraction that the study states{hint}")


def shifted(study: Study, uncertain: Uncertain, amount: float) -> Study:
    """Return a study in which an uncertain amplitude is larger by an amount.

    Raises
    ------
    StudyError
        If the result is no valid study.
    """
    found: Study = _with_changes(study.with_(uncertain=()), {
        tuple(_steps(name)): amount * change for name, change in uncertain.change.items()})
    return found


def number_changes(one: Any, other: Any, name: str = "") -> dict[str, float]:
    """Return by how much the numbers of two studies differ, by their names.

    Raises
    ------
    ValueError
        If they differ in something that is no number with a fraction.

    Examples
    --------
    >>> number_changes([1.0, {"b": 2.0}], [1.0, {"b": 2.5}])
    {'[2].b': 0.5}
    """
    if one is other or one == other:
        return {}
    both = list(_parts(one)), list(_parts(other))
    if [key for key, _ in both[0]] == [key for key, _ in both[1]] and both[0]:
        found: dict[str, float] = {}
        for (key, first), (_, second) in zip(*both, strict=True):
            inner = f"{name}[{key}]" if isinstance(key, int) else f"{name}.{key}".lstrip(".")
            found |= number_changes(first, second, inner)
        return found
    if isinstance(one, float) and isinstance(other, float):
        return {name: other - one}
    raise ValueError(f"{name} differs, and is no number")


def _parts(value: Any) -> Iterator[tuple[str | int, Any]]:
    """Yield the keys of a table, or the numbers of a list from 1, with what is there."""
    if isinstance(value, BaseModel):
        yield from ((key, getattr(value, key)) for key in type(value).model_fields)
    elif isinstance(value, dict):
        yield from value.items()
    elif isinstance(value, list | tuple):
        yield from enumerate(value, start=1)


def _steps(name: str) -> Iterator[str | int]:
    """Yield the keys and numbers of elements of which a name consists."""
    for key, number in re.findall(r"([^.\[\]]+)|\[(\d+)\]", name):
        if key:
            yield key
        else:
            yield int(number)


def _with_changes(value: Any, changes: Mapping[tuple[str | int, ...], float]) -> Any:
    """Return a value with some of its numbers changed, by the steps to them.

    Numbers that depend on each other are changed together.
    """
    if () in changes:
        return value + changes[()]
    parts = dict(_parts(value))
    for first in {steps[0] for steps in changes}:
        parts[first] = _with_changes(parts[first], {
            steps[1:]: change for steps, change in changes.items() if steps[0] == first})
    if isinstance(value, StudyModel):
        return value.with_(**{str(key): part for key, part in parts.items()
                              if part is not getattr(value, str(key))})
    return parts if isinstance(value, dict) else type(value)(parts.values())
