"""Draw the pictures of the gallery: the magnet of every study under studies/.

The left half shows a ring of blocks in the (x, y) plane, coloured by the direction of their nominal
magnetization, with the iron and the measurement positions; a magnet of finite length also gets a
side view. The magnets on the page "Describe your magnet" are drawn from the studies on that page.
Nothing is solved, so all pictures together take seconds::

    python docs/gallery.py [FOLDER]      # default: docs/_static
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Annulus, Polygon, Rectangle
from matplotlib.path import Path as Outline
from scipy.spatial import ConvexHull

from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.measurement.positions import points_from
from halbach_fe.study.reader import read_study

DOCS = Path(__file__).parent
STUDIES = DOCS.parent / "studies"
EXAMPLES = DOCS / "how-to" / "describe-your-magnet.md"
REST = """
name = "example"
mesh = { block_size_m = 0.01 }
observation = { quantity = "flux_density", positions = { kind = "points", points_m = [[0, 0, 0]] } }
"""
"""What a part of a study that describes a magnet lacks."""

DIRECTIONS = colormaps["hsv"]
"""A cyclic scale: 0 and 360 degrees have the same colour."""

IRON, POSITIONS = "#c9ced6", "#000000"
ARROW = 0.7
"""Length of an arrow relative to the radial thickness of a block."""

LARGEST_HEAD = 10.0
"""Size of an arrow's head in points, which small blocks reduce."""

MM = 1e3


def main(folder: Path) -> None:
    """Write one PNG per folder of studies/ that has a study.toml, and one per example."""
    page = EXAMPLES.read_text(encoding="utf-8")
    drawn = {f"gallery/{path.parent.name}": picture(build_magnet(read_study(path)))
             for path in sorted(STUDIES.glob("*/study.toml"))}
    drawn |= {f"magnets/{name}": picture(magnet_of(text, page), points=False)
              for name, text in fragments(page).items() if f"magnets/{name}.png" in page}
    drawn["team-13"] = measured_plates((DOCS / "accuracy.md").read_text(encoding="utf-8"))
    for name, figure in drawn.items():
        target = folder / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(
            target, dpi=90, pil_kwargs={"optimize": True},
            metadata={"Software": None})  # the same file from every version of Matplotlib
        print(f"{target}: {target.stat().st_size / 1024:.0f} kB")  # noqa: T201


def measured_plates(page: str) -> Figure:
    """Draw the mean flux densities of the table of TEAM problem 13 on the page of accuracy."""
    table = page[page.index("| section | at |"):].split("\n\n")[0].splitlines()[2:]
    rows = np.array([[line.split("|")[column] for column in (1, 3, 4, 5, 8)] for line in table],
                    float)
    figure = Figure(figsize=(9.2, 3.6), layout="constrained")
    axis = figure.subplots()
    axis.plot(rows[:, 0], rows[:, 1], "k_", ms=14, mew=2, label="measured")
    axis.errorbar(rows[:, 0], rows[:, 2], rows[:, 3], fmt="o", color="#1f77b4", ms=4, capsize=3,
                  label="computed, with bars")
    axis.plot(rows[:, 0], rows[:, 4], "x", color="#d62728", ms=5, zorder=3,
              label="NGSolve, published")
    for last, name in ((0, "plate"), (7, "arm of the channel"), (18, "back")):
        axis.axvline(last + 0.5, color="#999999", lw=0.6)
        axis.text(last + 0.7, 0.05, name)
    axis.set(xlabel="section", ylabel="mean flux density in T", ylim=(0, 1.6), xlim=(0.5, 25.5))
    axis.legend(loc="upper right")
    axis.grid(alpha=0.3)
    return figure


def picture(magnet: Magnet, points: bool = True) -> Figure:
    """Draw the cross-section of a magnet and, if its length is finite, its side view.

    ``points`` are the positions of the readings.
    """
    flat = magnet.dimension == 2
    figure = Figure(figsize=(4.6, 4.6) if flat else (9.2, 4.6), layout="constrained")
    axes = figure.subplots(1, 1 if flat else 2, squeeze=False)[0]
    cross_section(axes[0], magnet)
    if not flat:
        side_view(axes[1], magnet)
    if points:
        x, y, z = MM * points_from(magnet.study.observation.positions).T
        draw_points(axes[0], x, y)
        if not flat:
            draw_points(axes[1], z, np.hypot(x, y))
    return figure


def draw_points(axis: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Draw measurement positions, each place in the picture once."""
    axis.plot(*np.unique(np.column_stack([x, y]).round(6), axis=0).T, ".", ms=2, color=POSITIONS)


def cross_section(axis: Axes, magnet: Magnet) -> None:
    """Draw the blocks nearest to the middle with their magnetization, and its iron, in mm.

    Of equal rings the first one is drawn.
    """
    for body in magnet.iron:
        if body.triangles is not None:  # which leave holes along z open
            for triangle in np.stack(body.surface[:2], axis=2):
                axis.add_patch(Polygon(MM * triangle, color=IRON, lw=0.3))
            continue
        if body.sphere or not body.in_place:
            hull = np.column_stack([part.ravel() for part in body.surface[:2]])
            axis.add_patch(Polygon(MM * hull[ConvexHull(hull).vertices], color=IRON))
            continue
        if body.z_min > 0 or body.z_max < 0:
            continue
        if body.outline is None:
            axis.add_patch(Annulus((0, 0), MM * body.outer_radius, MM * (
                body.outer_radius - body.inner_radius - 1e-9), color=IRON))
        else:
            corners = MM * np.array([edge.start for edge in body.outline])
            axis.add_patch(Polygon(corners, color=IRON))
    for block in middle_blocks(magnet):
        outline = MM * shadow(block, (0, 1))
        size = np.ptp(outline, axis=0).min() if block.origin_m != (0.0, 0.0, 0.0) else MM * (
            max(edge.radius for edge in block.outline) - min(edge.radius for edge in block.outline))
        direction = np.array(block.easy_axis[:2]) * np.sign(block.remanence)
        turn = np.arctan2(direction[1], direction[0]) / (2 * np.pi) % 1
        axis.add_patch(Polygon(outline, facecolor=(*DIRECTIONS(turn)[:3], 0.45),
                               edgecolor="#555555", lw=0.6))
        middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
        half = ARROW / 2 * size * direction
        if np.hypot(*half) > 0:
            axis.annotate("", middle + half, middle - half, arrowprops={
                "arrowstyle": "-|>", "color": "#222222", "lw": 1.0, "shrinkA": 0, "shrinkB": 0,
                "mutation_scale": min(LARGEST_HEAD, 48 * size / MM / magnet.radius)})
    limit = 1.06 * MM * magnet.radius
    axis.set(aspect="equal", xlim=(-limit, limit), ylim=(-limit, limit),
             xlabel="x in mm", ylabel="y in mm")


def middle_blocks(magnet: Magnet) -> list[MagnetBlock]:
    """Return the blocks that the plane z = 0 cuts, or that are nearest above it."""
    if magnet.array.is_uniform:
        found = magnet.blocks[:magnet.array.blocks_per_ring]
    else:
        heights = [[0.0] if np.isinf(block.z_max) else shadow(block, (2, 0))[:, 0]
                   for block in magnet.blocks]
        distance = np.array([np.inf if max(z) < 0 else max(min(z), 0.0) for z in heights])
        nearest = distance <= distance.min() + 1e-6
        found = [block for block, near in zip(magnet.blocks, nearest, strict=True) if near]
    return [block for block in found if block.remanence]  # the others are missing


def side_view(axis: Axes, magnet: Magnet) -> None:
    """Draw the rings, or free blocks, and the iron by z and distance from the axis, in mm."""
    for body in magnet.iron:
        if body.sphere or not body.in_place:
            across = np.column_stack([part.ravel() for part in body.surface[:2]])
            hull = across[ConvexHull(across).vertices]
            low, high = radii(hull)
            if Outline(hull).contains_point((0.0, 0.0)):  # it lies across the axis
                low = 0.0
            start, end = body.surface[2].min(), body.surface[2].max()
        else:
            low, high, start, end = body.inner_radius, body.outer_radius, body.z_min, body.z_max
        axis.add_patch(Rectangle((MM * start, MM * low), MM * (end - start), MM * (high - low),
                                 color=IRON))
    sections = list(magnet.ring_sections[:magnet.array.rings])
    for block in magnet.blocks:
        if block.ring > magnet.array.rings:  # a free block
            z = shadow(block, (2, 0))[:, 0]
            sections.append(((z.min(), z.max()), radii(shadow(block, (0, 1)))))
    for (start, end), (low, high) in sections:
        axis.add_patch(Rectangle((MM * start, MM * low), MM * (end - start), MM * (high - low),
                                 facecolor="#e8e8e8", edgecolor="#555555", lw=0.6))
    limit = 1.06 * MM * magnet.half_length
    axis.set(xlim=(-limit, limit), xlabel="z in mm", ylabel="distance from the axis in mm")
    axis.set_ylim(-0.02 * MM * magnet.radius, 1.06 * MM * magnet.radius)
    axis.autoscale(axis="x")


def radii(polygon: np.ndarray) -> tuple[float, float]:
    """Return the least and largest distance in m of a polygon (n, 2) from the origin outside it."""
    after, along = np.roll(polygon, -1, axis=0), np.linspace(0, 1, 33)[:, None, None]
    distances = np.linalg.norm(polygon + along * (after - polygon), axis=2)
    return float(distances.min()), float(distances.max())


def shadow(block: MagnetBlock, axes: tuple[int, int]) -> np.ndarray:
    """Return a polygon (n, 2) in m: a block seen along the third axis."""
    outline = np.vstack([edge.at(np.linspace(0, 1, 13))[0] for edge in block.outline])
    ends = [0.0] if np.isinf(block.z_max) else [block.z_min, block.z_max]
    points = np.vstack([block.from_frame(np.column_stack([outline, np.full(len(outline), z)]))
                        for z in ends])[:, axes]
    if abs(block.axes[2, 2]) > 1 - 1e-3 and 2 not in axes:  # hardly tilted, and perhaps not convex
        return points[:len(outline)]
    return points[ConvexHull(points).vertices]


def fragments(page: str) -> dict[str, str]:
    """Return the blocks of TOML that have a name, by name, in the order of a page."""
    return dict(re.findall(
        r"^```\{code-block\} toml\n:name: (\S+)\n\n(.*?)^```$", page, re.M | re.S))


def magnet_of(fragment: str, page: str) -> Magnet:
    """Return the magnet of a part of a study, and of the tables that its page shows."""
    with TemporaryDirectory() as folder:
        for name, body in re.findall(
                r"^```\{code-block\} text\n:caption: (\S+\.csv)\n\n(.*?)^```$", page, re.M | re.S):
            Path(folder, name).write_text(body, encoding="utf-8")
        path = Path(folder, "study.toml")
        path.write_text(REST + fragment, encoding="utf-8")
        return build_magnet(read_study(path))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / "_static")
