"""What the pages share: colours, figures on disk and inside a page, the frame of the page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path

import jinja2
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from halbach_fe.field_map import atomic
from halbach_fe.update import write_text

# Okabe and Ito's colours, told apart by every kind of colour vision
PRIOR, POSTERIOR, PUBLISHED, MEASURED = "#E69F00", "#0072B2", "#999999", "#000000"
IRON = "#56B4E9"

Picture = tuple[str, str]
"""A PNG in base64, and what it shows."""


def save(figures: Mapping[str, tuple[Figure, str]], folder: Path) -> list[Picture]:
    """Write figures, by file name with what each shows, as PNG; return them for a page."""
    pictures = []
    for name, (figure, text) in figures.items():
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=130)
        with atomic(folder / name) as temporary:
            temporary.write_bytes(buffer.getvalue())
        pictures.append((base64.b64encode(buffer.getvalue()).decode(), text))
    return pictures


def write_page(path: Path, template: str, pictures: Sequence[Picture], **data: object) -> None:
    """Write a self-contained page from a template of this folder."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("halbach_fe", "report"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    write_text(path, environment.get_template(template).render(
        pictures=pictures, version=metadata.version("halbach-fe"), **data))


def axes_along(rows: int, ratios: Sequence[float] | None = None) -> tuple[Figure, list[Axes]]:
    """A figure of rows that share their x axis."""
    figure = Figure(figsize=(8, 2.4 + 1.7 * rows), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False,
                           gridspec_kw={"height_ratios": ratios or [1] * rows})
    for axis in axes[:, 0]:
        axis.grid(alpha=0.3)
    return figure, list(axes[:, 0])
