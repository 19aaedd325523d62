"""Results that show their main figure in a notebook.

A result knows nothing of figures: the report room draws them. So the drawing is looked up by the
type of the result when a notebook asks for it, in `halbach_fe.report.notebook`.
"""

from __future__ import annotations

import importlib

DRAWN_BY = "halbach_fe.report.notebook"


class ShownInNotebook:
    """Base of results with a figure or table of their own."""

    def _repr_html_(self) -> str:
        """Return the main figure, or table, as HTML without any reference to other files."""
        return str(importlib.import_module(DRAWN_BY).html_of(self))
