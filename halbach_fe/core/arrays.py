"""Type aliases of NumPy arrays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


AXIS = re.compile(r"[bB]?_?([xyzXYZ])(?![A-Za-z])")
"""How the name of a column of a DataFrame begins that is of an axis: x, x_m, Bx, Bx_T."""

OTHER_UNIT = re.compile(r"(?<![A-Za-z])(mm|cm|um|inch|mT|uT|nT|k?G|gauss)\W?$")
"""How such a name ends that states another unit than m or T: x_mm, Bx [mT]."""


def plain(values: ArrayLike, axes: Sequence[str] = ("x", "y", "z")) -> Floats:
    """Return a copy of numbers as floats, NaN where an array is masked.

    A DataArray with labels x, y and z has those of ``axes`` along the last dimension.

    Raises
    ------
    TypeError, ValueError
        If they are no real numbers, have a unit of their own, are a DataFrame whose columns are
        named after other axes than ``axes``, are in another order, or state a unit but m or T, or
        a DataArray that lacks one of the axes.
    """
    values = _by_labels(values, axes)
    if np.iscomplexobj(values):
        raise TypeError("complex numbers")
    if any(hasattr(values, name) for name in ("magnitude", "to_value")):  # of pint, of astropy
        raise TypeError("numbers with a unit of their own; convert them to SI, and give their "
                        "values alone")
    named = [AXIS.match(str(name)) for name in getattr(values, "columns", ())]
    if named and all(named) and [one[1].lower() for one in named if one] != list(axes):
        raise ValueError(f"columns named {', '.join(map(str, values.columns))} in place of "  # type: ignore[union-attr]
                         f"{', '.join(axes)}, in this order")
    if scaled := [name for name in map(str, getattr(values, "columns", ()))
                  if OTHER_UNIT.search(name)]:
        raise ValueError(f"columns in other units than m and T: {', '.join(scaled)}; convert them "
                         "and name them anew")
    return np.array(np.ma.filled(np.ma.asarray(values, float), np.nan))


def _by_labels(values: Any, axes: Sequence[str]) -> Any:
    """Return an array whose labels name the axes (a DataArray) with ``axes`` along its last
    dimension; anything else as it is.
    """
    if not (hasattr(values, "dims") and hasattr(values, "coords")):
        return values
    unit = str(values.attrs.get("units", ""))
    if OTHER_UNIT.search(unit):
        raise ValueError(f"numbers in {unit}; convert them to m and T")
    for name in values.dims:
        labels = [str(label) for label in values.coords[name].values] if (
            name in values.coords) else []
        if labels and {*labels} <= {"x", "y", "z"}:
            if lacking := [axis for axis in axes if labels.count(axis) != 1]:
                raise ValueError(f"{name} labelled {', '.join(labels)}, of which {lacking[0]} is "
                                 "not there once")
            return values.sel({name: list(axes)}).transpose(..., name)
    if "component" in values.dims:
        return values.transpose(..., "component")
    return values
