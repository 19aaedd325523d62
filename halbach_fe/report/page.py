"""What the pages share: colours, figures on disk and inside a page, the frame of the page."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path

import jinja2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from halbach_fe.blocks import blocks_of
from halbach_fe.field_map import atomic
from halbach_fe.study import Study
from halbach_fe.update import write_text

# Okabe and Ito's colours, told apart by every kind of colour vision
PRIOR, POSTERIOR, PUBLISHED, MEASURED = "#E69F00", "#0072B2", "#999999", "#000000"
SECOND = "#009E73"
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


def draw_magnet(axis: Axes, study: Study) -> None:
    """Outlines of a ring's blocks with arrows of their magnetization, and the iron; in mm."""
    t = np.linspace(0, 1, 9)
    for block in blocks_of(study)[:study.array.blocks_per_ring]:
        outline = 1e3 * np.vstack([edge.at(t)[0] for edge in block.outline])
        axis.plot(*outline.T, color="#777777", lw=0.6)
        middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
        length = 150 * (study.array.outer_radius_m - study.array.inner_radius_m)
        axis.annotate("", middle + length * np.array(block.easy_axis[:2]),
                      middle - length * np.array(block.easy_axis[:2]),
                      arrowprops={"arrowstyle": "->", "color": "#777777", "lw": 0.8})
    if study.iron_ring is not None:
        for radius in (study.iron_ring.inner_radius_m, study.iron_ring.outer_radius_m):
            axis.add_patch(Circle((0, 0), 1e3 * radius, fill=False, color=IRON, lw=0.8))
