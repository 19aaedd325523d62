"""Tables of results as CSV text, every number in full."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

WITH_COMMAS = "Separate columns by commas, and write decimals with points."
"""What to do about a table with other separators."""


def csv_text(columns: Mapping[str, NDArray[Any] | Sequence[object]]) -> str:
    """Return columns of equal length, by name, as CSV; numbers read back to the last bit.

    Examples
    --------
    >>> print(csv_text({"label": ["Bx", "By"], "value_T": np.array([0.1, 1e-9])}), end="")
    label,value_T
    Bx,0.1
    By,1e-09
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(np.asarray(column).tolist() for column in columns.values()),
                         strict=True))
    return text.getvalue()


def other_separator(header: str) -> str | None:
    """Return what separates the names in a header that has no commas; None if nothing does."""
    for character, name in ((";", "semicolons"), ("\t", "tabs")):
        if "," not in header and character in header.strip():
            return name
    return None
