"""Draw the pictures of the gallery: the magnet of every study under studies/.

The left half shows a ring of blocks in the (x, y) plane, coloured by the direction of their nominal
magnetization, with the iron and the measurement positions; a magnet of finite length also gets a
side view. Nothing is solved, so all pictures together take seconds::

    python docs/gallery.py [FOLDER]      # default: docs/_static/gallery
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Annulus, Polygon, Rectangle

from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.measurement.positions import points_from
from halbach_fe.study.reader import read_study

DOCS = Path(__file__).parent
STUDIES = DOCS.parent / "studies"
DIRECTIONS = colormaps["hsv"]
"""A cyclic scale: 0 and 360 degrees have the same colour."""

IRON, POSITIONS = "#c9ced6", "#000000"
ARROW = 0.7
"""Length of an arrow relative to the radial thickness of a block."""

LARGEST_HEAD = 10.0
"""Size of an arrow's head in points, which small blocks reduce."""

MM = 1e3


def main(folder: Path) -> None:
    """Write one PNG per folder of studies/ that has a study.toml."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(STUDIES.glob("*/study.toml")):
        target = folder / f"{path.parent.name}.png"
        picture(build_magnet(read_study(path))).savefig(
            target, dpi=90, pil_kwargs={"optimize": True},
            metadata={"Software": None})  # the same file from every version of Matplotlib
        print(f"{target}: {target.stat().st_size / 1024:.0f} kB")  # noqa: T201


def picture(magnet: Magnet) -> Figure:
    """Draw the cross-section of a magnet and, if its length is finite, its side view."""
    points = points_from(magnet.study.observation.positions)
    flat = magnet.dimension == 2
    figure = Figure(figsize=(4.6, 4.6) if flat else (9.2, 4.6), layout="constrained")
    axes = figure.subplots(1, 1 if flat else 2, squeeze=False)[0]
    cross_section(axes[0], magnet)
    x, y, z = MM * points.T
    draw_points(axes[0], x, y)
    if not flat:
        side_view(axes[1], magnet)
        draw_points(axes[1], z, np.hypot(x, y))
    return figure


def draw_points(axis: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Draw measurement positions, each place in the picture once."""
    axis.plot(*np.unique(np.column_stack([x, y]).round(6), axis=0).T, ".", ms=2, color=POSITIONS)


def cross_section(axis: Axes, magnet: Magnet) -> None:
    """Draw one ring of blocks with its magnetization, and the iron, in the (x, y) plane in mm."""
    if magnet.iron_ring is not None:
        inner, outer = magnet.iron_ring.inner_radius_m, magnet.iron_ring.outer_radius_m
        axis.add_patch(Annulus((0, 0), MM * outer, MM * (outer - inner), color=IRON))
    along = np.linspace(0, 1, 13)
    thickness = magnet.array.outer_radius_m - magnet.array.inner_radius_m
    head = min(LARGEST_HEAD, 48 * thickness / magnet.radius)
    for block in magnet.blocks[:magnet.array.blocks_per_ring]:
        outline = MM * np.vstack([edge.at(along)[0] for edge in block.outline])
        direction = np.array(block.easy_axis[:2])
        turn = np.arctan2(direction[1], direction[0]) / (2 * np.pi) % 1
        axis.add_patch(Polygon(outline, facecolor=(*DIRECTIONS(turn)[:3], 0.45),
                               edgecolor="#555555", lw=0.6))
        middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
        half = ARROW / 2 * MM * thickness * direction
        axis.annotate("", middle + half, middle - half, arrowprops={
            "arrowstyle": "-|>", "color": "#222222", "lw": 1.0, "shrinkA": 0, "shrinkB": 0,
            "mutation_scale": head})
    limit = 1.06 * MM * magnet.radius
    axis.set(aspect="equal", xlim=(-limit, limit), ylim=(-limit, limit),
             xlabel="x in mm", ylabel="y in mm")


def side_view(axis: Axes, magnet: Magnet) -> None:
    """Draw the rings and the iron by z and distance from the axis, in mm."""
    if magnet.iron_ring is not None:
        inner, outer = magnet.iron_ring.inner_radius_m, magnet.iron_ring.outer_radius_m
        half = magnet.iron_half_length
        axis.add_patch(Rectangle((-MM * half, MM * inner), 2 * MM * half, MM * (outer - inner),
                                 color=IRON))
    low, high = magnet.array.inner_radius_m, magnet.array.outer_radius_m
    for start, end in magnet.ring_limits:
        axis.add_patch(Rectangle((MM * start, MM * low), MM * (end - start), MM * (high - low),
                                 facecolor="#e8e8e8", edgecolor="#555555", lw=0.6))
    limit = 1.06 * MM * magnet.half_length
    axis.set(xlim=(-limit, limit), xlabel="z in mm", ylabel="distance from the axis in mm")
    axis.set_ylim(-0.02 * MM * magnet.radius, 1.06 * MM * magnet.radius)
    axis.autoscale(axis="x")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / "_static" / "gallery")
