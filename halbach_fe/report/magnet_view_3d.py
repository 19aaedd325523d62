"""The interactive three-dimensional view of a magnet (Plotly) that pages embed."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import plotly.graph_objects as go
import plotly.io
import scipy.sparse as sparse
from markupsafe import Markup
from scipy.spatial import Delaunay

from halbach_fe.core.arrays import Floats, Ints, spread
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.outline import Edge, at_heights, outline_contains
from halbach_fe.inference.result import InferenceResult
from halbach_fe.report.inference_answer import along_easy_axes, easy_axes
from halbach_fe.report.page import IRON, MEASURED, SECOND, Plain
from halbach_fe.report.words import flux_density, place_of
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.types import COMPONENTS

UNSIGNED = "Cividis"
"""Colour scale of unsigned numbers, readable with any colour vision."""

LONGEST = 0.3
"""Length of the longest arrow of a residual relative to the radius of the bore."""

MOST_SUMMED = 20_000
"""Largest number of blocks whose field is drawn in the plane: it takes 0.2 ms per block."""


def _lines(starts: Floats, ends: Floats) -> dict[str, Floats]:
    """Return the coordinates of lines between points (n, 3), which NaN separates."""
    gap = np.full_like(ends, np.nan)
    return dict(zip("xyz", np.stack([starts, ends, gap], axis=1).reshape(-1, 3).T, strict=True))


def residuals_trace(positions: Floats, residual: Floats, bore_radius: float) -> go.Scatter3d:
    """Return arrows of what the model lacks, B (n, 3) in T at points (n, 3) in m."""
    most_arrows = 5000  # largest number of arrows that are drawn: those of the largest residuals
    size = np.linalg.norm(residual, axis=1)
    kept = np.sort(np.argsort(-size)[:most_arrows])
    longest = float(size.max()) or 1.0
    ends = positions[kept] + LONGEST * bore_radius / longest * residual[kept]
    return go.Scatter3d(
        **_lines(positions[kept], ends), mode="lines", line={"color": SECOND, "width": 3},
        visible="legendonly", name=f"residuals, up to {flux_density(longest, 2)}", hoverinfo="skip")


def cut_trace(magnet: Magnet) -> go.Surface | None:
    """Return the plane y = 0 of the bore, in 2D the bore itself, coloured by |B| of the nominal
    blocks in vacuum, as contours.

    Without a bore it is the plane through and around the magnet. It is None if nothing of the plane
    is in air, or of more than `MOST_SUMMED` blocks.
    """
    cut = (19, 27)  # numbers of points of the plane in which |B| is shown
    # Part of the plane that the colours span: beside the blocks |B| is many times larger.
    near_blocks = 0.9
    if len(magnet.blocks) > MOST_SUMMED:
        return None
    # how far the plane reaches around a magnet without a bore, relative to its outer radius
    around = 1.5
    reach = 0.9 * magnet.bore_radius if magnet.has_bore else around * magnet.radius
    first = np.linspace(-reach, reach, cut[0])
    far = reach if magnet.dimension == 2 else magnet.half_length + reach
    a, b = np.meshgrid(first, np.linspace(-far, far, cut[1]))
    x, y, z = (a, b, 0 * a) if magnet.dimension == 2 else (a, 0 * a, b)
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    size = 1e3 * np.linalg.norm(field_of(magnet.blocks, points), axis=1)
    hidden = magnet.contains(points)
    if magnet.dimension == 2 and magnet.has_bore:
        hidden |= np.hypot(*points[:, :2].T) > reach
    if hidden.all():
        return None
    low, high = np.quantile(size[~hidden], (0.0, near_blocks))
    return go.Surface(
        x=x, y=y, z=z, surfacecolor=np.where(hidden, np.nan, size).reshape(x.shape), opacity=0.9,
        colorscale=UNSIGNED, cmin=low, cmax=high, visible="legendonly", showlegend=True,
        name="|B| in a plane",
        colorbar={"title": {"text": "|B| of the nominal<br>blocks in vacuum,<br>in mT"},
                  "len": 0.45, "y": 0.23, "x": 0.0, "xanchor": "left"},
        hovertemplate="(%{x:.1f}, %{y:.1f}, %{z:.1f}) mm<br>|B| = %{surfacecolor:.5g} mT"
                      "<extra></extra>")


SIGNED = "RdBu_r"
"""Colour scale of signed numbers, readable with any colour vision."""

OUTSIDE = 1.3
"""Distance from the axis at which a block is named, relative to the magnet's outer radius."""

ARROW, HEAD = 0.7, 0.35
"""Length of an arrow relative to the radial thickness of a block; length of the arrow's head
relative to the arrow."""

LEGEND = {"orientation": "h", "x": 0, "y": 0, "yanchor": "top"}
"""Place of the names: below the picture, where they hide nothing at any width."""

MOST_POINTS = 10_000
"""Largest number of points of a field map that are drawn; more would make the page slow."""

MOST_BLOCKS = 2000
"""Largest number of blocks that are drawn one by one. In a larger array neighbouring rings are
merged."""

MOST_UNEQUAL = 10_000
"""Largest number of blocks that are drawn of other magnets, whose rings cannot be merged."""

LARGE = 4.0
"""Upper end of the colour scale of standardized residuals."""

CAMERA_2D, CAMERA_3D = {"x": 0.3, "y": 0.3, "z": 2.5}, {"x": 1.4, "y": 1.0, "z": 1.2}

SCRIPT = """
var view = document.getElementById('{plot_id}');
var owners = view.data[0].customdata, texts = view.data[0].meta;
if (texts) Plotly.restyle(view, {text: [Array.from(owners, function(one) {
    return texts[one]; })]}, [0]);
var eye = view._fullLayout.scene.camera.eye, left = view._fullLayout._size, wide = left.w / left.h;
var far = 1.15 / wide;
if (wide < 1) Plotly.relayout(view, {'scene.camera.eye':
    {x: far * eye.x, y: far * eye.y, z: far * eye.z}});
"""
"""Runs when the view is there: gives the vertices the text of their block, which the page holds
once, and takes the camera back where what the colour scales leave of the view is narrow (a little
more than in proportion, as numbers beside the axes have the same size on any screen)."""

MM = 1e3

IDENTITY = "magnet-view"
"""HTML id of the view."""


@dataclass(frozen=True)
class Colours:
    """Numbers that are shown as the colours of the blocks."""

    values: Floats
    """The number of each block. Shape (blocks,)."""
    title: str
    """Title of the colour scale."""
    words: Sequence[str]
    """Text that appears when the pointer is over a block, one for each block."""
    limits: tuple[float, float] | None = None
    """Ends of an unsigned colour scale. If None, the scale is signed and symmetric about 0."""


@dataclass(frozen=True)
class BlockValues:
    """Values of the blocks that a view shows."""

    magnetization: Floats
    """Magnetization vectors, drawn as arrows. Shape (blocks, D), in A/m."""
    colours: Colours | None = None
    """Colours of the blocks. If None, all blocks are grey (before a measurement)."""


@dataclass(frozen=True)
class ViewPoints:
    """Points of a field map, coloured by the magnitude of a value at each point."""

    positions: Floats
    """Shape (n, 3), in m."""
    values: Floats
    """May be signed; the colour shows the magnitude. Shape (n,)."""
    name: str
    """Name of the points in the legend."""
    title: str
    """Title of the colour scale."""
    words: str
    """Text that appears when the pointer is over a point; %{customdata} stands for its value."""
    limits: tuple[float, float] | None = None
    """Ends of the colour scale, which are magnitudes; by default those of the values."""


def field_points(positions: Floats, flux_density: Floats) -> ViewPoints:
    """Return points (n, 3) in m that are coloured by the magnitude of a field B (n, 3) in T."""
    return ViewPoints(positions, 1e3 * np.linalg.norm(flux_density, axis=1), "points",
                      "|B| in mT", "|B| = %{customdata:.5g} mT")


def view_of_nominal_magnet(magnet: Magnet, points: ViewPoints) -> Markup:
    """Return the view of a nominal magnet and the points of a map, `MOST_POINTS` at most."""
    drawn = spread(np.arange(len(points.positions)), MOST_POINTS)
    return magnet_view(
        magnet, BlockValues(magnet.nominal_magnetization.reshape(len(magnet.blocks), -1)), replace(
            points, positions=points.positions[drawn], values=points.values[drawn],
            limits=_limits(points)))


def _limits(points: ViewPoints) -> tuple[float, float]:
    """Return the ends of the colour scale of points."""
    return points.limits or (float(points.values.min()), float(points.values.max()))


def view_of_inference(
    result: InferenceResult, named: Collection[tuple[int, int]] = ()
) -> Markup:
    """Return the view of an inference result: posterior magnetizations and residuals.

    ``named`` are ring and slot of blocks whose numbers are written beside them.
    """
    there, axes, size = easy_axes(result)
    along = sparse.csr_array(sparse.bsr_array((axes[:, None], there, np.arange(len(there) + 1))))
    along.resize(len(there), len(result.posterior.mean))  # variations in blocks do not count
    sd = 100 * result.posterior.sd_of(along) / size
    change, words = 100 * along_easy_axes(result), ["missing"] * len(result.magnet.blocks)
    for number, error in zip(there.tolist(), sd, strict=True):
        words[number] = f"{change[number]:+.2f} ± {error:.2f} % along the easy axis"
    values = BlockValues(result.by_block(result.posterior.mean), Colours(
        np.nan_to_num(change), "posterior change<br>along the easy axis in %", words))
    scores = result.standardized(result.prediction_posterior)
    points = (residual_points(result.observation.positions, scores)
              if any(result.observation.components) else None)
    return magnet_view(result.magnet, values, points, _residual_vectors(result), named)


def colours_in_words(result: InferenceResult) -> str:
    """Say what the colours of `view_of_inference` show."""
    blocks = "blocks by their change along the easy axis"
    return f"{blocks}, and measured points by the largest residual at each, over the standard " \
        "deviation of prediction and noise" if any(result.observation.components) else blocks


def _residual_vectors(result: InferenceResult) -> tuple[Floats, Floats] | None:
    """Return points (n, 3) in m and what the posterior lacks there, B (n, 3) in T.

    Components that were not read are zero; of |B| it is along the field. None if the readings are
    Fourier coefficients.
    """
    observation = result.observation
    if not all(observation.components):
        return None
    points, number = np.unique(observation.places.round(9), axis=0, return_inverse=True)
    lacking = np.zeros((len(points), 3))
    left = result.readings - result.prediction_posterior.mean
    total = observation.of_total_field  # |B| lacks what it does along the field
    lacking[number.ravel()[total]] = left[total, None] * observation.directions
    column = [COMPONENTS.index(label[1]) for label in np.array(observation.labels)[~total]]
    lacking[number.ravel()[~total], column] = left[~total]
    return points, lacking


def residual_points(positions: Floats, scores: Floats) -> ViewPoints:
    """Return each measured point with the largest standardized residual of its readings.

    If there are more than `MOST_POINTS` points, half of the points drawn are those with the
    largest residuals; the other half is spread evenly.
    """
    points, inverse = np.unique(positions.round(9), axis=0, return_inverse=True)
    order = np.argsort(np.abs(scores))
    worst = np.zeros(len(points))
    worst[inverse.ravel()[order]] = scores[order]
    if len(points) > MOST_POINTS:
        kept = np.sort(np.argsort(-np.abs(worst))[:MOST_POINTS // 2])
        chosen = np.union1d(kept, spread(np.arange(len(points)), MOST_POINTS // 2))
        points, worst = points[chosen], worst[chosen]
    return ViewPoints(points, worst, "measured points", "largest standardized<br>residual in sd",
                      "largest residual %{customdata:+.2f} sd", (0.0, LARGE))


def magnet_view(
    magnet: Magnet, values: BlockValues, points: ViewPoints | None = None,
    residuals: tuple[Floats, Floats] | None = None, named: Collection[tuple[int, int]] = (),
) -> Markup:
    """Return the view as HTML that includes all its scripts, to be placed in a page.

    ``residuals`` are points (n, 3) in m and what the model lacks there, B (n, 3) in T. They and the
    plane with |B| are hidden until their names are clicked. ``named`` are ring and slot of blocks
    that were found.
    """
    # Height at which the camera looks, in plotly's own length: axes have their names at the bottom.
    below = -0.1
    blocks, values = _merge_rings(magnet, values)
    bodies = [prism(block, _prism_height(magnet)) for block in blocks]
    figure = go.Figure([_blocks_trace(magnet, blocks, values, bodies),
                        *_arrow_traces(blocks, values, [corners for corners, _ in bodies])])
    for number, body in enumerate(magnet.iron):  # one entry of the legend for all of them
        figure.add_trace(_iron_trace(body, _prism_height(magnet)).update(showlegend=not number))
    if found := [block for block in magnet.blocks if block.place in named]:
        figure.add_trace(_named_trace(found, max(
            float(np.nanmax(np.hypot(trace.x, trace.y))) for trace in figure.data
            if trace.x is not None and len(trace.x))))
    if points is not None:
        figure.add_trace(_points_trace(points))
    if residuals is not None:
        figure.add_trace(residuals_trace(*residuals, magnet.bore_radius))
    camera = _camera(figure, magnet.dimension)
    if found and magnet.dimension == 3:  # from their side, as the map would hide them
        x, _, z = np.mean([block.middle for block in found], axis=0).tolist()
        camera |= {"x": math.copysign(camera["x"], x), "z": math.copysign(camera["z"], z)}
    cut = cut_trace(magnet)
    if cut is not None:
        figure.add_trace(cut)
    _to_mm(figure)
    # to update the layout of a figure takes ten times as long as to make one with it
    figure = go.Figure(figure.data, layout={
        "height": 620, "margin": {"l": 0, "r": 0, "t": 0, "b": 0}, "legend": LEGEND,
        "scene": {"aspectmode": "data",
                  **{f"{axis}axis": {"title": {"text": f"{axis} in mm"}, "nticks": 6}
                     for axis in "xyz"},
                  **({"zaxis": {"visible": False}} if magnet.dimension == 2 else {}),
                  "camera": {"eye": camera, "center": {"x": 0, "y": below, "z": 0},
                             "up": {"x": 0, "y": 1, "z": 0}}}})
    return Markup(plotly.io.to_html(
        figure, full_html=False, include_plotlyjs=True, div_id=IDENTITY, post_script=SCRIPT,
        config={"displaylogo": False, "responsive": True, "toImageButtonOptions": {
            "filename": magnet.name, "scale": 2}}))


def _named_trace(blocks: Sequence[MagnetBlock], outer: float) -> go.Scatter3d:
    """Draw the names of blocks beyond the outer radius in m, with a line to each block."""
    middles = np.array([block.middle for block in blocks])
    outside, radius = middles.copy(), np.hypot(*middles[:, :2].T)
    outside[radius < 1e-9 * outer, 0] = outer  # blocks on the axis
    outside[:, :2] *= OUTSIDE * outer / np.hypot(*outside[:, :2].T)[:, None]
    texts = [text for block in blocks for text in ("", place_of(block), "")]
    return go.Scatter3d(
        **_lines(middles, outside), text=texts, mode="lines+text", name="found", hoverinfo="skip",
        line={"color": MEASURED, "width": 5}, textposition="top center",
        textfont={"color": MEASURED, "size": 14})


def _to_mm(figure: go.Figure) -> None:
    """Scale all that is drawn from m to mm, in place and in its own precision."""
    for trace in figure.data:
        for key in "xyzuvw":
            if key in trace and trace[key] is not None:
                trace[key] = np.asarray(trace[key]) * np.float32(MM)


def _camera(figure: go.Figure, dimension: int) -> dict[str, float]:
    """Return the place of a camera that sees all that is drawn.

    plotly divides lengths by the geometric mean of the three sides of the drawn box, so that long
    and flat magnets need a camera farther off.
    """
    # Diagonals of the drawn box, in plotly's own length, that these cameras see as a whole.
    diagonal_2d, diagonal_3d = 2.4, 1.5
    drawn = [np.array([np.ravel(trace[axis]) for axis in "xyz"], float) for trace in figure.data
             if trace.x is not None and len(trace.x)]
    sides = np.nanmax(np.hstack(drawn), axis=1) - np.nanmin(np.hstack(drawn), axis=1)
    sides = np.maximum(sides, 1e-3 * sides.max())
    diagonal = float(np.linalg.norm(sides / np.cbrt(sides.prod())))
    place, whole = ((CAMERA_2D, diagonal_2d) if dimension == 2 else (CAMERA_3D, diagonal_3d))
    return {axis: max(1.0, diagonal / whole) * value for axis, value in place.items()}


def _rings_per_prism(magnet: Magnet) -> int:
    """Return the number of neighbouring rings that are merged for drawing."""
    return math.ceil(len(magnet.blocks) / MOST_BLOCKS) if magnet.array.is_uniform else 1


def _merge_rings(
    magnet: Magnet, values: BlockValues
) -> tuple[Sequence[MagnetBlock], BlockValues]:
    """Return the blocks to draw and their values, with neighbouring rings merged if necessary.

    Missing blocks are not drawn.

    In an array of more than `MOST_BLOCKS` blocks, the blocks of several neighbouring rings in the
    same slot are drawn as a single block. It has their mean magnetization, and the colour and text
    of the block whose value is largest in magnitude. Of other magnets some blocks are drawn, see
    `_some`.
    """
    if not magnet.array.is_uniform and len(magnet.blocks) > MOST_UNEQUAL:
        return _some(magnet, values)
    blocks, slots = magnet.blocks, magnet.array.blocks_per_ring
    step = _rings_per_prism(magnet)
    groups = [[number for number in range(first + slot, min(first + step * slots, len(blocks)),
                                          slots) if blocks[number].remanence]
              for first in range(0, len(blocks), step * slots) for slot in range(slots)
              ] if step > 1 else [[number] for number, block in enumerate(blocks)
                                  if block.remanence]
    groups = [group for group in groups if group]
    if step == 1 and len(groups) == len(blocks):
        return blocks, values
    colours = values.colours
    if colours is not None:
        magnitude = np.abs(colours.values)
        worst = [group[int(np.argmax(magnitude[group]))] for group in groups]
        colours = replace(colours, values=colours.values[worst], words=[
            (f"largest in ring {blocks[number].ring}: " if step > 1 else "") + colours.words[number]
            for number in worst])
    magnetization = np.array([values.magnetization[group].mean(axis=0) for group in groups])
    return ([replace(blocks[group[0]], z_max=blocks[group[-1]].z_max) for group in groups],
            BlockValues(magnetization, colours))


def _some(magnet: Magnet, values: BlockValues) -> tuple[Sequence[MagnetBlock], BlockValues]:
    """Return `MOST_UNEQUAL` blocks at most and their values.

    Of as many blocks that follow each other, the one whose colour is largest in magnitude is drawn.
    """
    there = np.flatnonzero([block.remanence != 0 for block in magnet.blocks])
    colours = values.colours
    magnitude = np.zeros(len(magnet.blocks)) if colours is None else np.abs(colours.values)
    step = math.ceil(len(there) / MOST_UNEQUAL)
    chosen = [int(some[np.argmax(magnitude[some])])
              for some in np.split(there, range(step, len(there), step))]
    if colours is not None:
        colours = replace(colours, values=colours.values[chosen],
                          words=[colours.words[number] for number in chosen])
    return ([magnet.blocks[number] for number in chosen],
            BlockValues(values.magnetization[chosen], colours))


def _blocks_trace(
    magnet: Magnet, blocks: Sequence[MagnetBlock], values: BlockValues,
    bodies: Sequence[tuple[Floats, Ints]],
) -> go.Mesh3d:
    """Return all blocks as a single surface mesh of their bodies, see `prism`.

    No two blocks share vertices, because the text of a block is attached to its vertices.
    """
    vertices, triangles, owner = [], [], []
    first = 0
    for number, (corners, faces) in enumerate(bodies):
        vertices.append(corners)
        triangles.append(faces + first)
        owner += [number] * len(corners)
        first += len(corners)
    points = np.vstack(vertices).astype(np.float32)  # half the bytes, and exact enough to look at
    faces = np.vstack(triangles).astype(np.int32)
    more = _rings_per_prism(magnet) - 1
    texts = [_hover_text(block, min(more, magnet.array.rings - block.ring), values, number)
             for number, block in enumerate(blocks)]
    look: Plain = {"color": "#BBBBBB"}
    if (colours := values.colours) is not None:
        limit = float(np.abs(colours.values).max()) or 1.0
        low, high = colours.limits or (-limit, limit)
        look = {"intensity": colours.values[np.array(owner)[faces[:, 0]]],
                "intensitymode": "cell",
                "colorscale": UNSIGNED if colours.limits else SIGNED, "cmin": low,
                "cmax": high, "colorbar": {
                    "title": {"text": colours.title}, "len": 0.45, "y": 0.7}}
    return go.Mesh3d(
        x=points[:, 0], y=points[:, 1], z=points[:, 2], i=faces[:, 0], j=faces[:, 1],
        k=faces[:, 2], customdata=owner, meta=texts, hoverinfo="text",
        flatshading=True, showlegend=True,
        name="blocks" if magnet.array.is_uniform or len(magnet.blocks) <= MOST_UNEQUAL
        else f"{len(blocks)} of {len(magnet.blocks)} blocks",
        lighting={"ambient": 0.8, "diffuse": 0.4}, **look)


def _hover_text(block: MagnetBlock, more: int, values: BlockValues, number: int) -> str:
    """Return the text of a block; ``more`` is the number of further rings merged into it."""
    magnetization = values.magnetization[number]
    rings = f"rings {block.ring} to {block.ring + more}" if more else f"ring {block.ring}"
    lines = [block.label or f"{rings}, slot {block.slot}",
             "M = (" + ", ".join(f"{1e-3 * part:.1f}" for part in magnetization) + ") kA/m"]
    if values.colours is not None:
        lines.append(values.colours.words[number])
    return "<br>".join(lines)


def prism(block: MagnetBlock, height: float) -> tuple[Floats, Ints]:
    """Triangulate the surface of a block.

    ``height``: drawn height in m of a block of infinite length.

    Returns
    -------
    corners : ndarray, shape (n, 3), in m
    triangles : ndarray of int, shape (m, 3)
        Numbers of the corners of each triangle.
    """
    arc_points = 5
    flat = np.vstack([edge.at(np.linspace(0, 1, arc_points)[:-1] if edge.arc else np.zeros(1))[0]
                      for edge in block.outline])
    count = len(flat)
    face = _triangles(block.outline, flat)
    low, high = (block.z_min, block.z_max) if np.isfinite(block.z_max) else (
        -height / 2, height / 2)
    ring = np.arange(count)
    ahead = (ring + 1) % count
    sides = np.vstack([np.column_stack([ring, ahead, ahead + count]),
                       np.column_stack([ring, ahead + count, ring + count])])
    return block.from_frame(at_heights(flat, low, high)), np.vstack([face, face + count, sides])


def _triangles(outline: tuple[Edge, ...], flat: Floats) -> Ints:
    """Return triangles (m, 3) that fill the polygon of the points (n, 2) of an outline."""
    edges = np.roll(flat, -1, axis=0) - flat
    ahead = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * ahead[:, 1] - edges[:, 1] * ahead[:, 0]
    if (turns > 0).all() or (turns < 0).all():  # of a convex polygon, all from its first corner
        corner = np.arange(1, len(flat) - 1)
        return np.column_stack([0 * corner, corner, corner + 1])
    inside = Delaunay(flat).simplices
    return np.asarray(inside[outline_contains(outline, flat[inside].mean(axis=1))])


def _prism_height(magnet: Magnet) -> float:
    """Return the drawn height in m of blocks of infinite length."""
    # drawn height of a two-dimensional magnet relative to its outer radius
    flat = 0.2
    return flat * magnet.array_outer_radius


def _arrow_traces(
    blocks: Sequence[MagnetBlock], values: BlockValues, corners: Sequence[Floats]
) -> list[go.Scatter3d | go.Cone]:
    """Return arrows of the magnetization on the upper faces of the blocks with these corners."""
    # Largest number of blocks whose arrows have heads; more would make the page slow.
    most_cones = 2000
    middles = np.array([[*block.mounted_middle[:2], own[:, 2].max()]
                        for block, own in zip(blocks, corners, strict=True)])
    vectors = np.zeros((len(blocks), 3))
    vectors[:, :values.magnetization.shape[1]] = values.magnetization
    size = np.median([np.ptp(prism(block, 0.0)[0], axis=0).max() for block in blocks[:100]])
    vectors *= ARROW * size / (np.linalg.norm(vectors, axis=1).max() or 1.0)
    shafts = go.Scatter3d(**_lines(middles - vectors / 2, middles + vectors / 2), mode="lines",
                          line={"color": MEASURED, "width": 4}, name="magnetization",
                          legendgroup="arrows", hoverinfo="skip")
    if len(blocks) > most_cones:
        return [shafts]
    (x, y, z), (u, v, w) = (middles + vectors / 2).T, (HEAD * vectors).T
    heads = go.Cone(
        x=x, y=y, z=z, u=u, v=v, w=w, sizemode="raw", anchor="tip", showscale=False,
        colorscale=[[0, MEASURED], [1, MEASURED]], legendgroup="arrows", hoverinfo="skip")
    return [shafts, heads]


def _iron_trace(body: IronSolid, height: float) -> go.Surface | go.Mesh3d:
    """Return the surface of a body of iron; ``height`` in m is drawn if it is infinitely long."""
    if np.isinf(body.z_max):
        body = replace(body, z_min=-height / 2, z_max=height / 2)
    x, y, z = body.surface
    if body.triangles is not None:
        first = 3 * np.arange(len(x))
        return go.Mesh3d(x=x.ravel(), y=y.ravel(), z=z.ravel(), i=first, j=first + 1, k=first + 2,
                         opacity=0.25, color=IRON, name="iron", legendgroup="iron",
                         showlegend=True, hoverinfo="name")
    return go.Surface(
        x=x, y=y, z=z, opacity=0.25, showscale=False, colorscale=[[0, IRON], [1, IRON]],
        name="iron", legendgroup="iron", showlegend=True, hoverinfo="name")


def _points_trace(points: ViewPoints) -> go.Scatter3d:
    """Return the points of the map as markers."""
    x, y, z = points.positions.T
    low, high = _limits(points)
    return go.Scatter3d(
        x=x, y=y, z=z, mode="markers", name=points.name, customdata=points.values,
        hovertemplate=f"(%{{x:.1f}}, %{{y:.1f}}, %{{z:.1f}}) mm<br>{points.words}<extra></extra>",
        marker={"size": 2.5, "color": np.abs(points.values), "colorscale": UNSIGNED, "cmin": low,
                "cmax": high, "colorbar": {"title": {"text": points.title}, "len": 0.45,
                                           "y": 0.23}})
