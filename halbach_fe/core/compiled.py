"""Decorators that compile functions with numba.

This module imports numba, which takes a second; functions that need it import it themselves.
"""

from __future__ import annotations

from typing import Any

import numba

compiled: Any = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
"""Decorator of all compiled functions. Threads run them side by side, since they release the GIL;
numba's own threads must not be entered from several Python threads."""

reordered: Any = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
"""The same for sums whose terms may be added in any order, several at a time."""
