"""In which keys two descriptions of a magnet differ."""

from __future__ import annotations

from typing import Any


def differences(one: Any, other: Any, key: str = "") -> dict[str, tuple[Any, Any]]:
    """Return both values of every key in which two trees of plain data differ, by dotted key.

    Examples
    --------
    >>> differences({"array": {"rings": 1, "ring": []}}, {"array": {"rings": 2, "ring": []}})
    {'array.rings': (1, 2)}
    """
    if isinstance(one, dict) and isinstance(other, dict):
        found: dict[str, tuple[Any, Any]] = {}
        for name in one | other:
            found |= differences(one.get(name), other.get(name), f"{key}.{name}".lstrip("."))
        return found
    return {} if one == other else {key: (one, other)}
