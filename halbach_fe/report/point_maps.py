"""Pictures of numbers at the points of a map that fit how these lie: on a line, around a circle,
over angle and z, or in slices.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.measurement.scan_lines import point_spacing
from halbach_fe.report.page import figure_of

SAME = 1e-3
"""Part of the size of a map within which lengths count as equal."""


@dataclass(frozen=True)
class Panel:
    """Points of a map that are drawn in a plane.

    Attributes
    ----------
    title : str
        Where they are.
    points : ndarray of int, shape (n,)
        Their numbers.
    first, second : ndarray, shape (n,)
        Abscissae and ordinates, in the units of the labels.
    labels : tuple of two str
    lengths : bool
        Whether both are lengths, drawn to scale if that leaves something to see.
    """

    title: str
    points: Ints
    first: Floats
    second: Floats
    labels: tuple[str, str]
    lengths: bool


def curve(points: Floats) -> tuple[Floats, str] | None:
    """Return the abscissae (n,) along the line or circle of points (n, 3) in m, and their label.

    Returns
    -------
    tuple, or None
        None if the points lie on neither.
    """
    centred = points - points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    if len(sizes) < 2 or sizes[1] <= SAME * sizes[0]:
        along = axes[0]
        number = int(np.argmax(np.abs(along)))
        if abs(along[number]) > 1 - SAME:
            return 1e3 * points[:, number], f"{'xyz'[number]} in mm"
        return 1e3 * (centred @ along), "distance along the line in mm"
    radii = np.hypot(points[:, 0], points[:, 1])
    if np.ptp(points[:, 2]) <= SAME * radii.max() and np.ptp(radii) <= SAME * radii.max():
        return _angle(points), "angle in degrees"
    return None


def panels(points: Floats) -> list[Panel]:
    """Return the planes in which points (n, 3) in m are drawn, which lie on no `curve`."""
    fewest = 12  # fewest points in a slice; with fewer all points are drawn by angle and z
    few_radii = 3  # largest number of radii for which points count as circles about the axis
    every, z = np.arange(len(points)), 1e3 * points[:, 2]
    size = float(np.ptp(points, axis=0).max())
    radii = np.hypot(points[:, 0], points[:, 1])
    if np.ptp(points[:, 2]) <= SAME * size:
        return [_slice(points, every, 2)]
    from_middle = np.linalg.norm(points - _centre(points), axis=1)

    def unrolled(title: str, chosen: Ints) -> Panel:
        return Panel(title, chosen, z[chosen], _angle(points[chosen]),
                     ("z in mm", "angle in degrees"), lengths=False)

    if np.ptp(from_middle) <= 10 * SAME * from_middle.max():
        return [unrolled(f"on the sphere of {2e3 * from_middle.mean():.4g} mm diameter", every)]
    different, number = _different(radii, SAME * size)
    if len(different) <= few_radii and np.abs(radii - different[number]).max() <= SAME * size:
        return [unrolled(f"at the radius of {1e3 * radius:.4g} mm", np.flatnonzero(number == one))
                for one, radius in reversed(list(enumerate(different))) if radius > SAME * size]
    spacing = point_spacing(points)
    found = []
    for axis in (1, 2):  # from the side, and from the end
        middle = points[np.argmin(np.abs(points[:, axis] - np.median(points[:, axis]))), axis]
        chosen = np.flatnonzero(np.abs(points[:, axis] - middle) <= spacing / 2)
        if len(chosen) >= fewest:
            found.append(_slice(points, chosen, axis))
    return found or [unrolled("all points", every)]


def _centre(points: Floats) -> Floats:
    """Return the centre (3,) of the sphere on which points (n, 3) lie, if they do.

    It solves p² = 2 c·p + constant by least squares.
    """
    matrix = np.column_stack([2 * points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(matrix, np.sum(points**2, axis=1))[0][:3])


def _different(values: Floats, apart: float) -> tuple[Floats, Ints]:
    """Return the different ones (m,) of values (n,), increasing, and the number (n,) of each value.

    Values that differ from their neighbours by no more than ``apart``, such as by rounding, are the
    same; their mean stands for them.
    """
    order = np.argsort(values, kind="stable")
    number = np.empty(len(values), np.intp)
    number[order] = np.append(0, np.cumsum(np.diff(values[order]) > apart))
    return np.asarray(np.bincount(number, values) / np.bincount(number)), number


def _angle(points: Floats) -> Floats:
    """Return the angles (n,) of points (n, 3) about z, from 0 to 360 degrees."""
    angle = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    return np.asarray(np.where(angle > 360 - SAME, 0.0, angle), np.float64)  # -1e-17 is 0


def _slice(points: Floats, chosen: Ints, across: int) -> Panel:
    """Return the panel of points in a plane across an axis."""
    first, second = {0: (2, 1), 1: (2, 0), 2: (0, 1)}[across]
    middle = 1e3 * float(np.median(points[chosen, across])) + 0.0
    return Panel(f"at {'xyz'[across]} = {round(middle, 3):g} mm", chosen,
                 1e3 * points[chosen, first], 1e3 * points[chosen, second],
                 (f"{'xyz'[first]} in mm", f"{'xyz'[second]} in mm"), lengths=True)


def draw(axis: Axes, panel: Panel, values: Floats, **colours: Any) -> ScalarMappable:
    """Draw values (n,) at the points of a panel: as cells if they fill a grid, else as squares."""
    # Largest ratio of the sides of a slice that is drawn to scale. A longer one would be a line.
    most_aspect = 4.0
    columns, column = _different(panel.first, SAME * float(np.ptp(panel.first)))
    rows, row = _different(panel.second, SAME * float(np.ptp(panel.second)))
    if len(columns) * len(rows) == len(values) and min(len(columns), len(rows)) > 1:
        grid = np.full((len(rows), len(columns)), np.nan)
        grid[row, column] = values
        drawn: ScalarMappable = axis.pcolormesh(columns, rows, grid, shading="nearest",
                                                rasterized=True, **colours)
    else:
        drawn = axis.scatter(panel.first, panel.second, c=values, marker="s",
                             s=float(np.clip(6000 / len(values), 4, 60)), **colours)
    axis.set(xlabel=panel.labels[0], ylabel=panel.labels[1])
    if panel.lengths:
        sides = sorted(float(np.ptp(side)) for side in (panel.first, panel.second))
        axis.set_aspect("equal" if sides[1] <= most_aspect * sides[0] else "auto")
    else:
        axis.set_yticks(range(0, 361, 90))
    axis.set_facecolor("#eeeeee")
    return drawn


def maps_figure(points: Floats, rows: Mapping[str, Floats], unit: str) -> Figure:
    """Draw values (n,) at points (n, 3) in m: a row for each name, a column for each panel."""
    shown = panels(points)
    kept = _not_zero(rows)
    figure, axes = _grid(len(kept), len(shown))
    for number, (line, (name, values)) in enumerate(zip(axes, kept.items(), strict=True)):
        seen = np.concatenate([values[panel.points] for panel in shown])
        for axis, panel in zip(line, shown, strict=True):
            drawn = draw(axis, panel, values[panel.points], cmap="cividis", vmin=np.nanmin(seen),
                         vmax=np.nanmax(seen))
            _name(axis, panel.title, number, len(axes))
        figure.colorbar(drawn, ax=list(line), label=f"{name} in {unit}")
    return figure


def residual_figure(points: Floats, rows: Mapping[str, Mapping[str, Floats]], unit: str) -> Figure:
    """Draw residuals (n,) at points (n, 3) in m: a row for each outer name, a column for each inner
    one, with colours of their own that are symmetric about 0.
    """
    panel = panels(points)[0]
    rows = {name: row for name, row in rows.items()
            if all(np.isfinite(values[panel.points]).any() for values in row.values())} or rows
    figure, axes = _grid(len(rows), len(next(iter(rows.values()))))
    for number, (line, (name, row)) in enumerate(zip(axes, rows.items(), strict=True)):
        for axis, (title, values) in zip(line, row.items(), strict=True):
            seen = values[panel.points]
            limit = float(np.nanquantile(np.abs(seen), 0.99)) or 1.0
            drawn = draw(axis, panel, seen, cmap="RdBu_r", vmin=-limit, vmax=limit)
            figure.colorbar(drawn, ax=axis, label=f"{name} in {unit}", extend="both")
            _name(axis, f"{title}, {panel.title}", number, len(axes))
        for axis in line[1:]:
            axis.set_ylabel("")
    return figure


def _not_zero(rows: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the values that are not zero everywhere; the first ones if all are."""
    sizes = {name: float(np.nanmax(np.abs(values), initial=0.0)) for name, values in rows.items()}
    # part of the largest value of all components below which a component is zero, and not drawn
    nothing = 1e-9
    return {name: values for name, values in rows.items()
            if sizes[name] > nothing * max(sizes.values())} or dict(list(rows.items())[:1])


def _grid(rows: int, columns: int) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure and its axes in rows and columns."""
    figure = figure_of(0.4 + 2.4 * rows, max(4.6 * columns, 6.0))
    # the layout is made before axes are drawn to scale, which moves their labels outwards
    figure.set_layout_engine("constrained", rect=(0.03, 0.0, 0.95, 1.0))
    return figure, figure.subplots(rows, columns, squeeze=False).tolist()


def _name(axis: Axes, title: str, row: int, rows: int) -> None:
    """Give the axes of the first row a title, and those of the last one only the label of x."""
    if not row:
        axis.set_title(title, fontsize="medium")
    if row < rows - 1:
        axis.set_xlabel("")


def unit_for(largest: float) -> tuple[float, str]:
    """Return the factor and the name of the unit in which flux densities in T are drawn."""
    return (1e3, "mT") if largest >= 1e-3 else (1e6, "µT")
