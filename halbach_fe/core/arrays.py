"""Type aliases of NumPy arrays."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import chain
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

    A DataArray whose labels name x, y and z has those of ``axes`` along the last dimension.

    Raises
    ------
    TypeError, ValueError
        If they are no real numbers, have a unit of their own, are a DataFrame whose columns are
        named after other axes than ``axes``, are in another order, or state a unit but m or T, or
        a DataArray that lacks one of the axes or has labels of another meaning.
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
    """Return an array whose labels name axes (a DataArray), as columns of a DataFrame do, with
    ``axes`` along its last dimension; anything else as it is. Numbers as labels say nothing.
    """
    if not (hasattr(values, "dims") and hasattr(values, "coords")):
        return values
    labels = {name: [str(label) for label in values.coords[name].values]
              for name in values.dims if name in values.coords
              and any(isinstance(label, str) for label in values.coords[name].values)}
    for text in (str(values.attrs.get("units", "")), *chain(*labels.values())):
        if OTHER_UNIT.search(text):
            raise ValueError(f"numbers in {text}; convert them to m and T")
    for name in [*values.dims][::-1]:
        found = [AXIS.match(label) for label in labels.get(name, [])]
        named = [one[1].lower() for one in found if one]
        if named and all(found):
            if lacking := [axis for axis in axes if named.count(axis) != 1]:
                raise ValueError(f"{name} labelled {', '.join(labels[name])}, of which "
                                 f"{lacking[0]} is not there once")
            return values.isel({name: [named.index(axis) for axis in axes]}).transpose(..., name)
    last = "component" if "component" in values.dims else ["", *values.dims][-1]
    if last in labels and (last == "component" or len(labels[last]) == len(axes)):
        raise ValueError(f"{last} labelled {', '.join(labels[last])} in place of "
                         f"{', '.join(axes)}; name or drop these labels")
    return values.transpose(..., "component") if last == "component" else values
