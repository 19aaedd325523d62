"""Results that show their main figure in a notebook, and one line elsewhere.

A result knows nothing of figures: the report room draws them. So the drawing is looked up by the
type of the result when a notebook asks for it, in `halbach_fe.report.page`.
"""

from __future__ import annotations

import importlib
from dataclasses import fields
from typing import Any

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
