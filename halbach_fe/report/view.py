"""A view of the magnet in three dimensions, to turn and point at, inside a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import plotly.graph_objects as go
import plotly.io
import scipy.sparse as sparse
from markupsafe import Markup
from scipy.spatial import Delaunay

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.geometry.blocks import MagnetBlock, rotation_matrix
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import outline_contains
from halbach_fe.inference.result import InferenceResult
from halbach_fe.report.page import IRON, MEASURED

ARC_POINTS = 5
SIGNED, UNSIGNED = "RdBu_r", "Cividis"
"""Scales that every kind of colour vision can read."""

ARROW, HEAD = 0.7, 0.35
"""Length of an arrow over the thickness of a block, and of its head over its own."""

FLAT = 0.2
"""Height of a cross-section over its radius."""

MOST_POINTS = 10_000
"""Of a map; more would make the page slow."""

MOST_BLOCKS = 2000
"""Of an array; of more, those of neighbouring rings are drawn as one."""

LARGE = 4.0
"""Residuals over their standard deviations from which the colour is the same."""

FROM_AHEAD, FROM_ASIDE = {"x": 0.3, "y": 0.3, "z": 2.5}, {"x": 1.4, "y": 1.0, "z": 1.2}

IDENTITY = "magnet-view"


@dataclass(frozen=True)
class Colours:
    """A number of each block, as its colour.

    Attributes
    ----------
    values : ndarray, shape (blocks,)
    title : str
        Of the scale.
    words : sequence of str
        What is said of each block.
    limits : tuple of float, or None
        Of the scale; None for a scale of signed numbers, even about 0.
    """

    values: Floats
    title: str
    words: Sequence[str]
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Known:
    """What a page knows of the blocks.

    Attributes
    ----------
    magnetization : ndarray, shape (blocks, D), in A/m
        Drawn as arrows.
    colours : Colours or None
        None before a measurement.
    """

    magnetization: Floats
    colours: Colours | None = None


@dataclass(frozen=True)
class Points:
    """Points of a map, coloured by a number of each.

    Attributes
    ----------
    positions : ndarray, shape (n, 3), in m
    values : ndarray, shape (n,)
    name, title : str
        Of the points, and of the scale of colours.
    words : str
        What is said of a point, with %{customdata} for its value.
    limits : tuple of float
        Of the scale; of magnitudes, where values have a sign.
    """

    positions: Floats
    values: Floats
    name: str
    title: str
    words: str
    limits: tuple[float, float]


def residuals(positions: Floats, standardized: Floats) -> Points:
    """Measured points: positions (n, 3) in m and residuals (n,) over their standard deviations."""
    return Points(positions, standardized, "measured points", "largest residual<br>over its sd",
                  "largest residual %{customdata:+.2f} sd", (0.0, LARGE))


def field_points(positions: Floats, flux_density: Floats) -> Points:
    """Points (n, 3) in m of a computed field B (n, 3) in T, coloured by its magnitude."""
    size = np.linalg.norm(flux_density, axis=1)
    return Points(positions, size, "points", "|B| in T", "|B| = %{customdata:.5g} T",
                  (float(size.min()), float(size.max())))


def of_nominal(magnet: Magnet, points: Points) -> Markup:
    """The view of a nominal magnet, and points of a map."""
    known = Known(np.array([block.magnetization[:magnet.dimension] for block in magnet.blocks]))
    count = len(points.positions)
    few = np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(int)
    return magnet_view(magnet, known, replace(
        points, positions=points.positions[few], values=points.values[few]))


def of_update(update: InferenceResult) -> Markup:
    """The view of an update: the posterior, and what it leaves of each reading."""
    size = update.study.dimension
    nominal = update.response.nominal.reshape(-1, size)
    easy = nominal / np.linalg.norm(nominal, axis=1)[:, None]
    length = np.einsum("ij,ij->i", nominal, easy)
    mean = update.posterior.mean.reshape(-1, size)
    number = np.arange(len(easy) + 1)
    along = sparse.csr_array(sparse.bsr_array((easy[:, None], number[:-1], number)))
    change = 100 * np.einsum("ij,ij->i", mean - nominal, easy) / length
    sd = 100 * update.posterior.sd_of(along) / length
    known = Known(mean, Colours(change, "posterior change<br>along the easy axis in %", [
        f"{one:+.2f} ± {error:.2f} % along the easy axis"
        for one, error in zip(change, sd, strict=True)]))
    scores = update.standardized(update.prediction_posterior)
    return magnet_view(update.magnet, known, _by_point(update.observation.positions, scores))


def _by_point(positions: Floats, scores: Floats) -> Points:
    """Of all readings at a point the one that is farthest off; of too many points these first."""
    points, inverse = np.unique(positions.round(9), axis=0, return_inverse=True)
    order = np.argsort(np.abs(scores))
    worst = np.zeros(len(points))
    worst[inverse.ravel()[order]] = scores[order]
    if len(points) > MOST_POINTS:
        kept = np.sort(np.argsort(-np.abs(worst))[:MOST_POINTS // 2])
        evenly = np.linspace(0, len(points) - 1, MOST_POINTS // 2).astype(int)
        chosen = np.union1d(kept, evenly)
        points, worst = points[chosen], worst[chosen]
    return residuals(points, worst)


def magnet_view(magnet: Magnet, known: Known, points: Points | None = None) -> Markup:
    """A part of a page, with all that it needs."""
    blocks, known = _few(magnet, known)
    figure = go.Figure([_blocks(magnet, blocks, known), *_arrows(magnet, blocks, known)])
    if magnet.iron_ring is not None:
        figure.add_trace(_iron(magnet))
    if points is not None:
        figure.add_trace(_markers(points))
    figure.update_layout(
        height=620, margin={"l": 0, "r": 0, "t": 0, "b": 0}, legend={"x": 0, "y": 1},
        scene={"aspectmode": "data", "xaxis": {"title": {"text": "x in m"}},
               "yaxis": {"title": {"text": "y in m"}}, "zaxis": {"title": {"text": "z in m"}},
               "camera": {"eye": FROM_AHEAD if magnet.dimension == 2 else FROM_ASIDE,
                          "up": {"x": 0, "y": 1, "z": 0}}})
    return Markup(plotly.io.to_html(
        figure, full_html=False, include_plotlyjs=True, div_id=IDENTITY,
        config={"displaylogo": False, "responsive": True}))


def _rings_in_one(magnet: Magnet) -> int:
    """How many rings are drawn as one."""
    return math.ceil(magnet.array.rings * magnet.array.blocks_per_ring / MOST_BLOCKS)


def _few(magnet: Magnet, known: Known) -> tuple[Sequence[MagnetBlock], Known]:
    """The blocks to draw, and what is known of them: of too many, one for each slot of several
    rings, with their mean magnetization and the number of that which has the largest.
    """
    blocks, slots = magnet.blocks, magnet.array.blocks_per_ring
    step = _rings_in_one(magnet)
    if step == 1:
        return blocks, known
    groups = [range(first + slot, min(first + step * slots, len(blocks)), slots)
              for first in range(0, len(blocks), step * slots) for slot in range(slots)]
    colours = known.colours
    if colours is not None:
        size = np.abs(colours.values)
        worst = [group[int(np.argmax(size[group]))] for group in groups]
        colours = replace(colours, values=colours.values[worst], words=[
            f"most in ring {blocks[one].ring}: {colours.words[one]}" for one in worst])
    return ([replace(blocks[group[0]], z_max=blocks[group[-1]].z_max) for group in groups],
            Known(np.array([known.magnetization[group].mean(axis=0) for group in groups]), colours))


def _blocks(magnet: Magnet, blocks: Sequence[MagnetBlock], known: Known) -> go.Mesh3d:
    """All blocks as one surface, each with vertices of its own, which carry its words."""
    vertices, triangles, owner = [], [], []
    first = 0
    for number, block in enumerate(blocks):
        corners, faces = prism(block, _height(magnet))
        vertices.append(corners)
        triangles.append(faces + first)
        owner += [number] * len(corners)
        first += len(corners)
    points, faces = np.vstack(vertices), np.vstack(triangles)
    more = _rings_in_one(magnet) - 1
    words = [_words(block, min(more, magnet.array.rings - block.ring), known, number)
             for number, block in enumerate(blocks)]
    look: dict[str, object] = {"color": "#BBBBBB"}
    if known.colours is not None:
        values = known.colours.values
        limit = float(np.abs(values).max()) or 1.0
        low, high = known.colours.limits or (-limit, limit)
        look = {"intensity": values[np.array(owner)[faces[:, 0]]], "intensitymode": "cell",
                "colorscale": UNSIGNED if known.colours.limits else SIGNED, "cmin": low,
                "cmax": high, "colorbar": {
                    "title": {"text": known.colours.title}, "len": 0.45, "y": 0.7}}
    return go.Mesh3d(
        x=points[:, 0], y=points[:, 1], z=points[:, 2], i=faces[:, 0], j=faces[:, 1],
        k=faces[:, 2], text=[words[one] for one in owner], hoverinfo="text", flatshading=True,
        name="blocks", showlegend=True, lighting={"ambient": 0.8, "diffuse": 0.4}, **look)


def _words(block: MagnetBlock, more: int, known: Known, number: int) -> str:
    """Of a block that stands for those of so many more rings."""
    moment = known.magnetization[number]
    rings = f"rings {block.ring} to {block.ring + more}" if more else f"ring {block.ring}"
    lines = [f"{rings}, slot {block.slot}",
             "M = (" + ", ".join(f"{1e-3 * one:.1f}" for one in moment) + ") kA/m"]
    if known.colours is not None:
        lines.append(known.colours.words[number])
    return "<br>".join(lines)


def prism(block: MagnetBlock, height: float) -> tuple[Floats, Ints]:
    """Corners (n, 3) in m of a block's surface and triangles (m, 3) of it.

    ``height`` is that of a block of infinite length.
    """
    flat = np.vstack([edge.at(np.linspace(0, 1, ARC_POINTS)[:-1] if edge.arc else np.zeros(1))[0]
                      for edge in block.outline])
    count = len(flat)
    inside = Delaunay(flat).simplices
    face = inside[outline_contains(block.outline, flat[inside].mean(axis=1))]
    low, high = (block.z_min, block.z_max) if np.isfinite(block.z_max) else (
        -height / 2, height / 2)
    ring = np.arange(count)
    ahead = (ring + 1) % count
    sides = np.vstack([np.column_stack([ring, ahead, ahead + count]),
                       np.column_stack([ring, ahead + count, ring + count])])
    corners = np.vstack([np.column_stack([flat, np.full(count, z)]) for z in (low, high)])
    corners = (corners - block.middle) @ rotation_matrix(block.turn).T + block.middle + block.shift
    return corners, np.vstack([face, face + count, sides])


def _height(magnet: Magnet) -> float:
    return FLAT * magnet.array.outer_radius_m


def _arrows(
    magnet: Magnet, blocks: Sequence[MagnetBlock], known: Known
) -> list[go.Scatter3d | go.Cone]:
    """Directions of magnetization, on the upper faces of the blocks."""
    middles = np.array([[*(block.middle + block.shift)[:2],
                         prism(block, _height(magnet))[0][:, 2].max()] for block in blocks])
    vectors = np.zeros((len(blocks), 3))
    vectors[:, :known.magnetization.shape[1]] = known.magnetization
    vectors *= (ARROW * (magnet.array.outer_radius_m - magnet.array.inner_radius_m)
                / np.linalg.norm(vectors, axis=1).max())
    gap = np.full_like(middles, np.nan)  # no line from one arrow to the next
    x, y, z = np.stack([middles - vectors / 2, middles + vectors / 2, gap], axis=1).reshape(-1, 3).T
    shafts = go.Scatter3d(x=x, y=y, z=z, mode="lines", line={"color": MEASURED, "width": 4},
                          name="magnetization", legendgroup="arrows", hoverinfo="skip")
    (x, y, z), (u, v, w) = (middles + vectors / 2).T, (HEAD * vectors).T
    heads = go.Cone(
        x=x, y=y, z=z, u=u, v=v, w=w, sizemode="raw", anchor="tip", showscale=False,
        colorscale=[[0, MEASURED], [1, MEASURED]], legendgroup="arrows", hoverinfo="skip")
    return [shafts, heads]


def _iron(magnet: Magnet) -> go.Surface:
    ring = magnet.iron_ring
    assert ring is not None
    blocks = magnet.blocks
    length = ring.length_m or (blocks[-1].z_max - blocks[0].z_min)
    half = (length if np.isfinite(length) else _height(magnet)) / 2
    angle = np.linspace(0, 2 * np.pi, 97)
    radius = np.array([ring.inner_radius_m, ring.outer_radius_m, ring.outer_radius_m,
                       ring.inner_radius_m, ring.inner_radius_m])[:, None]
    z = np.array([-half, -half, half, half, -half])[:, None]
    return go.Surface(
        x=radius * np.cos(angle), y=radius * np.sin(angle), z=z + 0 * angle, opacity=0.25,
        showscale=False, colorscale=[[0, IRON], [1, IRON]], name="iron", showlegend=True,
        hoverinfo="name")


def _markers(points: Points) -> go.Scatter3d:
    x, y, z = points.positions.T
    low, high = points.limits
    return go.Scatter3d(
        x=x, y=y, z=z, mode="markers", name=points.name, customdata=points.values,
        hovertemplate=f"(%{{x:.4f}}, %{{y:.4f}}, %{{z:.4f}}) m<br>{points.words}<extra></extra>",
        marker={"size": 2.5, "color": np.abs(points.values), "colorscale": UNSIGNED, "cmin": low,
                "cmax": high, "colorbar": {"title": {"text": points.title}, "len": 0.45,
                                           "y": 0.23}})
