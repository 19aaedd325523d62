"""How a benchmark hands on a figure."""

from __future__ import annotations

from collections.abc import Callable

Note = Callable[[str, float, str, str], None]
"""Called with name, value, unit and what it is compared with."""
