"""Type aliases of NumPy arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def plain(values: ArrayLike) -> Floats:
    """Return a copy of numbers as floats, NaN where an array is masked.

    Raises
    ------
    TypeError, ValueError
        If they are no real numbers.
    """
    if np.iscomplexobj(values):
        raise TypeError("complex numbers")
    return np.array(np.ma.filled(np.ma.asarray(values, float), np.nan))
