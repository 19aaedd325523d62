"""What the three-dimensional view shows of the field: arrows of residuals, and |B| in a plane."""

from __future__ import annotations

import numpy as np
import plotly.graph_objects as go

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.report.page import SECOND
from halbach_fe.report.words import flux_density
from halbach_fe.solver.exact_block_field import field_of

UNSIGNED = "Cividis"
"""Colour scale of unsigned numbers, readable with any colour vision."""

CUT = (19, 27)
"""Numbers of points of the plane in which |B| is shown."""

AROUND = 1.5
"""How far that plane reaches around a magnet without a bore, relative to its outer radius."""

LONGEST = 0.3
"""Length of the longest arrow of a residual relative to the radius of the bore."""

NEAR_BLOCKS = 0.9
"""Part of the plane that the colours span: beside the blocks |B| is many times larger."""

MOST_SUMMED = 20_000
"""Largest number of blocks whose field is drawn in the plane: it takes 0.2 ms per block."""

MOST_ARROWS = 5000
"""Largest number of arrows that are drawn: those of the largest residuals."""


def residuals_trace(positions: Floats, residual: Floats, bore_radius: float) -> go.Scatter3d:
    """Return arrows of what the model lacks, B (n, 3) in T at points (n, 3) in m."""
    size = np.linalg.norm(residual, axis=1)
    kept = np.sort(np.argsort(-size)[:MOST_ARROWS])
    longest = float(size.max()) or 1.0
    ends = positions[kept] + LONGEST * bore_radius / longest * residual[kept]
    gap = np.full_like(ends, np.nan)
    x, y, z = np.stack([positions[kept], ends, gap], axis=1).reshape(-1, 3).T
    return go.Scatter3d(
        x=x, y=y, z=z, mode="lines", line={"color": SECOND, "width": 3}, visible="legendonly",
        name=f"residuals, up to {flux_density(longest, 2)}", hoverinfo="skip")


def cut_trace(magnet: Magnet) -> go.Surface | None:
    """Return the plane y = 0 of the bore, in 2D the bore itself, coloured by |B| of the nominal
    blocks in vacuum, as contours.

    Without a bore it is the plane through and around the magnet. It is None if nothing of the plane
    is in air, or of more than `MOST_SUMMED` blocks.
    """
    if len(magnet.blocks) > MOST_SUMMED:
        return None
    reach = 0.9 * magnet.bore_radius if magnet.has_bore else AROUND * magnet.radius
    first = np.linspace(-reach, reach, CUT[0])
    far = reach if magnet.dimension == 2 else magnet.half_length + reach
    a, b = np.meshgrid(first, np.linspace(-far, far, CUT[1]))
    x, y, z = (a, b, 0 * a) if magnet.dimension == 2 else (a, 0 * a, b)
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    size = 1e3 * np.linalg.norm(field_of(magnet.blocks, points), axis=1)
    hidden = magnet.contains(points)
    if magnet.dimension == 2 and magnet.has_bore:
        hidden |= np.hypot(*points[:, :2].T) > reach
    if hidden.all():
        return None
    low, high = np.quantile(size[~hidden], (0.0, NEAR_BLOCKS))
    return go.Surface(
        x=x, y=y, z=z, surfacecolor=np.where(hidden, np.nan, size).reshape(x.shape), opacity=0.9,
        colorscale=UNSIGNED, cmin=low, cmax=high, visible="legendonly", showlegend=True,
        name="|B| in a plane",
        colorbar={"title": {"text": "|B| of the nominal<br>blocks in vacuum,<br>in mT"},
                  "len": 0.45, "y": 0.23, "x": 0.0, "xanchor": "left"},
        hovertemplate="(%{x:.1f}, %{y:.1f}, %{z:.1f}) mm<br>|B| = %{surfacecolor:.5g} mT"
                      "<extra></extra>")
