"""Type aliases of NumPy arrays, and the geometry of points, polygons and vectors."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import chain
from numbers import Number
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

T = TypeVar("T", bound=np.generic)
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def radii_of(points: Floats) -> Floats:
    """Return the distances (n,) of points (n, 2 or 3) from the z axis."""
    return np.asarray(np.hypot(points[:, 0], points[:, 1]), np.float64)


def azimuths_of(points: Floats) -> Floats:
    """Return the angles (n,) in rad of points (n, 2 or 3) about the z axis, from -pi to pi."""
    return np.asarray(np.arctan2(points[:, 1], points[:, 0]), np.float64)


def degrees_of(points: Floats) -> Floats:
    """Return the angles (n,) in degrees of points (n, 2 or 3) about the z axis, from 0 to 360."""
    rounding = 1e-3  # an angle of -1e-17 is 0, not 360
    angle = np.degrees(azimuths_of(points)) % 360
    return np.asarray(np.where(angle > 360 - rounding, 0.0, angle), np.float64)


def box_middle(points: Floats) -> Floats:
    """Return the middle (D,) of the box around points (n, D)."""
    return np.asarray((points.max(axis=0) + points.min(axis=0)) / 2)


def polygon_area(corners: Floats) -> float:
    """Return the area of a polygon (n, 2), which is negative if it runs clockwise."""
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2


def face_vectors(triangles: Floats) -> Floats:
    """Return normals (n, 3) of triangles (n, 3, 3); their length is twice the area."""
    return np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])


def unit_circle(angles: ArrayLike) -> Floats:
    """Return the points (..., 3) at angles (...) in rad on the unit circle about the z axis."""
    return np.stack([np.cos(angles), np.sin(angles), np.zeros(np.shape(angles))], axis=-1)


def slices(count: int, most: int) -> list[slice]:
    """Return slices that divide ``count`` rows into parts of at most ``most``, in order."""
    return [slice(first, min(first + most, count)) for first in range(0, count, most)]


def spread(rows: NDArray[T], most: int) -> NDArray[T]:
    """Return at most so many of some rows (n, ...), from the first to the last, evenly spread."""
    return rows[np.linspace(0, len(rows) - 1, min(most, len(rows))).astype(int)]


AXIS = re.compile(r"[bB]?_?([xyzXYZ])(?![A-Za-z])")
"""How the name of a column of a DataFrame begins that is of an axis: x, x_m, Bx, Bx_T."""

OTHER_UNIT = re.compile(
    r"(?<![a-z])([kcdmunpµμ](m|metres?|meters?|t)|(milli|micro|centi|kilo)\w+|microns?|in(ch|ches)?"
    r"|ft|mils?|[km]?(g|gs|gauss|oe|oersted)|[km]?a */ *m)\W*$", re.IGNORECASE)
"""How such a name ends that states another unit than m or T: x_mm, Bx [mT], Bx (kA/m)."""


AXIS_DIMENSION = re.compile(r"components?|ax[ei]s|xyz|coord\w*|cartesian|directions?|space")
"""Names of the dimension along which a DataArray without labels has x, y and z."""


def plain(values: ArrayLike, axes: Sequence[str] = ("x", "y", "z")) -> Floats:
    """Return a copy of numbers as floats, NaN where an array is masked.

    A DataArray, DataFrame, Series, dict or structured array whose labels name x, y and z has those
    of ``axes`` along the last dimension; so has a DataArray without labels if a dimension is called
    component or axis.
    Whatever says nothing of itself is taken as it is: x, y and z along its last dimension.

    Raises
    ------
    TypeError, ValueError
        If they are no real numbers, have a unit of their own, or are named or labelled by a unit
        but m or T, by only some of the axes, or by something else.
    """
    values = _by_labels(_labelled(values), axes)
    if np.iscomplexobj(values):
        raise TypeError("complex numbers")
    if any(hasattr(values, name) for name in ("magnitude", "to_value")):  # of pint, of astropy
        raise TypeError("numbers with a unit of their own; convert them to SI, and give their "
                        "values alone")
    given: Any = np.ma.asarray(values)
    if given.dtype.kind in "Mmb":  # whose numbers are nanoseconds, or 0 and 1
        raise TypeError("times" if given.dtype.kind in "Mm" else "true and false")
    try:
        return np.array(np.ma.filled(given.astype(float), np.nan))
    except TypeError:  # a generator, an empty dict, a list of dicts
        raise TypeError("other than numbers; make a list or an array of them") from None


def rms(values: Floats) -> float:
    """Return the root of the mean square of numbers."""
    return float(np.sqrt(np.mean(values**2)))


def of_length(vectors: Floats, length: Floats) -> Floats:
    """Return vectors (n, 3) along others, of given lengths (n,); along x where those are 0."""
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    along = np.divide(vectors, size, out=np.tile([1.0, 0.0, 0.0], (len(vectors), 1)),
                      where=size > 0)
    return np.asarray(along * length[:, None])


def _labelled(values: Any) -> Any:
    """Return columns by name (a dict, a Dataset, a structured array, a table or series of pandas
    or polars) as a DataArray; anything else as it is.
    """
    names = list(getattr(values, "data_vars", values)) if isinstance(values, Mapping) else (
        list(getattr(getattr(values, "dtype", None), "names", None) or ()))
    if names:
        columns = np.broadcast_arrays(*(plain(values[name]) for name in names))
        dims = [*map("axis {}".format, range(columns[0].ndim)), "column"]
        return xr.DataArray(np.stack(columns, axis=-1), dims=dims,
                            coords={"column": list(map(str, names))})
    if isinstance(values, xr.DataArray) or not hasattr(values, "to_numpy"):
        return values
    numbers = values.to_numpy()
    labels = [getattr(values, "index", ()), getattr(values, "columns", ())]
    own = getattr(values, "name", None) if numbers.ndim == 1 else None  # no column of a table
    return xr.DataArray(numbers, dims=("row", "column")[:numbers.ndim], name=own, coords={
        name: [one if isinstance(one, Number) else str(one) for one in found]
        for name, found in zip(("row", "column")[:numbers.ndim], labels, strict=False)
        if len(found)})


def _by_labels(values: Any, axes: Sequence[str]) -> Any:
    """Return an array whose labels name axes (a DataArray) with ``axes`` along its last dimension;
    anything else as it is. Numbers as labels say nothing.
    """
    if not isinstance(values, xr.DataArray):
        return values
    labels = {name: [str(label) for label in values.coords[name].values]
              for name in values.dims if name in values.coords
              and not all(isinstance(label, Number) for label in values.coords[name].values)}
    own = str(values.name or "")
    if scaled := [text for text in (str(values.attrs.get("units", "")), own,
                                    *chain(*labels.values())) if OTHER_UNIT.search(text)]:
        raise ValueError(f"numbers in other units than m and T: {', '.join(scaled)}; convert them "
                         "and name them anew")
    if len(axes) == 1 and (other := AXIS.match(own)) and other[1].lower() != axes[0]:
        raise ValueError(f"{own} in place of {axes[0]}; name it anew")
    for name in [*values.dims][::-1]:
        found = [AXIS.match(label) for label in labels.get(name, [])]
        named = [one[1].lower() for one in found if one]
        if named and all(found):
            if lacking := [axis for axis in axes if named.count(axis) != 1]:
                raise ValueError(f"{name} labelled {', '.join(labels[name])}, of which "
                                 f"{lacking[0]} is not there once")
            return values.isel({name: [named.index(axis) for axis in axes]}).transpose(..., name)
    last = next((name for name in values.dims if AXIS_DIMENSION.fullmatch(str(name).lower())),
                ["", *values.dims][-1])
    if last in labels and (last == "component" or len(labels[last]) == len(axes)):
        raise ValueError(f"{last} labelled {', '.join(labels[last])} in place of "
                         f"{', '.join(axes)}; name or drop these labels")
    return values.transpose(..., last) if last else values
