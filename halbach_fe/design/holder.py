"""The holder of the blocks: plates across the z axis, with a pocket for every block.

Blocks that overlap in z share a plate, whatever rings they belong to. Every pocket ends below its
own block. Plates of equal shape are one plate, of which several are made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from halbach_fe.core.arrays import Floats, unit_circle
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.outline import (
    Outline,
    Prism,
    circle,
    distance_from_origin,
    rectangle,
    thinnest_wall,
    widened,
    with_notch,
)
from halbach_fe.study.design_keys import Holder, Rods

SEGMENTS = {"0": "abcdef", "1": "bc", "2": "abged", "3": "abgcd", "4": "fgbc", "5": "afgcd",
            "6": "afgedc", "7": "abc", "8": "abcdefg", "9": "abcdfg"}
"""Which of seven bars a digit consists of, from the upper one clockwise; the last is the middle."""

BARS = {"a": (0.25, 0.94, False), "b": (0.5, 0.72, True), "c": (0.5, 0.28, True),
        "d": (0.25, 0.06, False), "e": (0.0, 0.28, True), "f": (0.0, 0.72, True),
        "g": (0.25, 0.5, False)}
"""Middle of each bar, relative to the height of a digit, and whether it is upright."""


def digits(
    text: str, height: float, radius: float, angle: float, bottom: float, top: float
) -> tuple[Prism, ...]:
    """Return the bars of a number whose upper side is away from the z axis.

    Parameters
    ----------
    height : float, in m
    radius, angle : float, in m and rad
        Its middle.
    bottom, top : float, in m
        Limits of z.
    """
    out = unit_circle(angle)[:2]
    axes = np.column_stack([[out[1], -out[0]], out])
    # size of a bar, and distance of two digits, relative to their height
    length, width, pitch = 0.3, 0.12, 0.8
    lying = rectangle(length * height, width * height)
    standing = rectangle(width * height, length * height)
    found = []
    for place, digit in enumerate(text):
        left = pitch * (place - (len(text) - 1) / 2) - 0.25
        for x, y, upright in (BARS[bar] for bar in SEGMENTS[digit]):
            middle = radius * out + height * (axes @ [left + x, y - 0.5])
            found.append(Prism(standing if upright else lying, bottom, top, axes, middle))
    return tuple(found)


LEVEL_M = 1e-5
"""Blocks that overlap by less than this in z are above one another."""


class CannotBeMadeError(Exception):
    """A plate cannot be made.

    Attributes
    ----------
    hint : str
        What to do.
    whatever : bool
        Whether no holder can be made for these blocks, whatever its keys.
    """

    def __init__(self, reason: str, hint: str, whatever: bool = False) -> None:
        super().__init__(reason)
        self.hint, self.whatever = hint, whatever


@dataclass(frozen=True)
class HeldBlock:
    """A block that stands upright."""

    number: int
    """Its number among all blocks."""
    name: str
    prism: Prism
    direction: Floats
    """Unit vector of its magnetization. Shape (3,)."""


@dataclass(frozen=True)
class Plate:
    """A plate, of which one or more are made."""

    number: int
    """From 1; it is engraved."""
    body: Prism
    """The plate without openings; its lower face is at z = 0."""
    openings: tuple[Prism, ...]
    """Bore, pockets, holes and engraved bars. Those below z = 0 go through."""
    heights_m: tuple[float, ...]
    """z of the lower face of every copy."""
    blocks: tuple[tuple[int, ...], ...]
    """Numbers of the blocks in every copy."""
    floor_m: float
    """Thickness below the lowest block; 0 if pockets go through."""
    wall_m: float
    """Thickness of the thinnest wall."""
    inner_radius_m: float
    outer_radius_m: float
    """Of the plate; the inner one is 0 without a bore."""
    bars: tuple[Prism, ...] = ()
    """Those of the openings that are the engraved number."""

    @property
    def thickness_m(self) -> float:
        """Thickness in m."""
        return self.body.z_max


def overlapping(limits: Sequence[tuple[float, float]]) -> list[list[int]]:
    """Return the numbers of blocks that overlap in z, directly or by others, from below.

    ``limits`` are the lowest and the highest z of every block in m.
    """
    found: list[list[int]] = []
    top = -np.inf
    for number in sorted(range(len(limits)), key=lambda one: (limits[one][0], one)):
        if limits[number][0] > top - LEVEL_M:
            found.append([])
        found[-1].append(number)
        top = max(top, limits[number][1])
    return found


def plates(
    groups: Sequence[Sequence[HeldBlock]], holder: Holder, iron: Sequence[IronSolid],
    asked: str | None,
) -> tuple[tuple[Plate, ...], tuple[str, ...]]:
    """Design the plates for groups of blocks, one each.

    Parameters
    ----------
    groups : sequence of sequence of HeldBlock
        From below.
    iron : sequence of IronSolid
        Bodies that plates have to leave room for.
    asked : str or None
        Name of the study if it asks for a holder.

    Returns
    -------
    plates : tuple of Plate
    reasons : tuple of str
        Why there is no holder for some blocks.

    Raises
    ------
    StudyError
        If a holder is asked for, and its keys forbid a plate, or there is no plate at all.
    """
    made: dict[object, Plate] = {}
    failed: list[CannotBeMadeError] = []
    try:
        pockets = {block.number: _pocket(block, holder) for group in groups for block in group}
        frame = _frame(groups, pockets, holder, iron)
    except CannotBeMadeError as error:
        _refuse(error, asked)
        return (), (str(error),)
    for group in groups:
        try:
            plate = _plate(group, pockets, holder, frame, iron)
        except CannotBeMadeError as error:
            if not error.whatever:
                _refuse(error, asked)
            failed.append(error)
            continue
        same = made.setdefault(_shape(plate), plate)
        if same is not plate:
            made[_shape(plate)] = replace(same, heights_m=same.heights_m + plate.heights_m,
                                          blocks=same.blocks + plate.blocks)
    if not made:
        _refuse(failed[0], asked)
    more = f" (the first of {len(failed)} such plates)" if len(failed) > 1 else ""
    return tuple(_numbered(plate, number, holder, frame) for number, plate in enumerate(
        made.values(), start=1)), tuple(f"{error}{more}" for error in failed[:1])


def _refuse(error: CannotBeMadeError, asked: str | None) -> None:
    """Raise StudyError if the study asks for a holder."""
    if asked is not None:
        raise StudyError(must_be("`holder`", f"study {asked}", "one that can be made", str(error),
                                 error.hint)) from None


@dataclass(frozen=True)
class _Frame:
    """What all plates of a magnet have in common; lengths are in m."""

    inner: float
    outer: float
    """Radii of the plates."""
    pockets: float
    """Radius around all pockets."""
    floor: float
    """Thickness below the blocks."""
    rods: tuple[Prism, ...]
    """Holes for rods."""


def _frame(
    groups: Sequence[Sequence[HeldBlock]], pockets: Mapping[int, Prism], holder: Holder,
    iron: Sequence[IronSolid],
) -> _Frame:
    """Return what plates of a magnet have in common.

    CannotBeMadeError if there is no room for plates.
    """
    limits = [(min(block.prism.z_min for block in group), max(block.prism.z_max for block in group))
              for group in groups]
    gap = min((above[0] - below[1] for below, above in pairwise(limits)), default=np.inf)
    floor = holder.floor_m
    # thickness of the floor where there is room for it, and the thinnest one that is made unasked
    usual_floor_m, least_floor_m = 2e-3, 5e-4
    if floor is None:
        floor = min(usual_floor_m, max(gap, 0.0))
        floor = floor if floor >= least_floor_m else 0.0
    for below, above in pairwise(limits):
        top = below[1] if holder.thickness_m is None else below[0] - floor + holder.thickness_m
        if above[0] - floor < top - LEVEL_M:
            raise CannotBeMadeError(
                f"plates that overlap by {_mm(top - above[0] + floor)}, for the blocks at z = "
                f"{_mm(below[0])} to {_mm(below[1])} and at {_mm(above[0])} to {_mm(above[1])}",
                "Reduce floor_m or thickness_m, or leave larger gaps between the blocks.")
    polygons = [pocket.polygon for pocket in pockets.values()]
    outermost = holder.corner_relief_m + max(
        float(np.hypot(*polygon.T).max()) for polygon in polygons)
    most = 10 * outermost  # in m of any plate; lengths of a holder that are in mm are far beyond
    for name in ("floor_m", "thickness_m", "inner_rim_m", "outer_rim_m", "outer_radius_m"):
        if (length := getattr(holder, name) or 0.0) > most:
            raise CannotBeMadeError(
                f"`{name}` of {_mm(length)} about blocks within {_mm(outermost)} of the axis",
                f"Was it meant in millimetres? Then write {length / 1e3:.6g}.")
    innermost = min(map(distance_from_origin, polygons))
    rods = _rods(holder.rods, outermost + holder.least_wall_m) if holder.rods else ()
    reach = max([outermost, *(float(np.hypot(*rod.polygon.T).max()) for rod in rods)])
    outer, inner = reach + holder.outer_rim_m, max(innermost - holder.inner_rim_m, 0.0)
    for body in iron:  # all round the blocks, or within their bore
        if body.inner_radius >= reach:
            outer = min(outer, body.inner_radius - holder.clearance_m)
        if body.outer_radius <= innermost:
            inner = max(inner, body.outer_radius + holder.clearance_m)
    return _Frame(inner if holder.inner_radius_m is None else holder.inner_radius_m,
                  holder.outer_radius_m or outer, outermost, floor, rods)


def _rods(rods: Rods, least: float) -> tuple[Prism, ...]:
    """Return the holes for rods; ``least`` is the radius in m that they leave to the pockets."""
    radius = rods.radius_m or least + rods.diameter_m / 2
    pitch = 360.0 / rods.count
    first = pitch / 2 if rods.first_angle_deg is None else rods.first_angle_deg
    angles = np.radians(first + pitch * np.arange(rods.count))
    hole = circle(rods.diameter_m / 2)
    return tuple(Prism(hole, -1.0, 0.0, origin=radius * unit_circle(angle)[:2])
                 for angle in angles)


def _pocket(block: HeldBlock, holder: Holder) -> Prism:
    """Return the pocket of a block, with the notch that its magnetization points to."""
    prism = block.prism
    outline = widened(prism.outline, holder.clearance_m)
    if outline is None:
        raise CannotBeMadeError(
            f"pockets for blocks like {block.name}, which is too small for a clearance of "
            f"{_mm(holder.clearance_m)}", "Reduce clearance_m.")
    direction = prism.axes.T @ block.direction[:2]
    # part of the magnetization in the plane of a plate below which it is not marked there
    flat = 0.1
    if holder.mark_m and np.linalg.norm(direction) > flat:
        narrow = min(edge.length for edge in prism.outline)
        corners = np.array([edge.start for edge in prism.outline])
        outline = with_notch(outline, corners.mean(axis=0), direction, holder.mark_m,
                             min(holder.mark_m, narrow / 4))
    return replace(prism, outline=outline)


def _plate(
    group: Sequence[HeldBlock], pockets: Mapping[int, Prism], holder: Holder, frame: _Frame,
    iron: Sequence[IronSolid],
) -> Plate:
    """Return the plate of a group, without its number."""
    low = min(block.prism.z_min for block in group) - frame.floor
    top = max(block.prism.z_max for block in group) - low
    thickness = holder.thickness_m or top
    if thickness / 2 < (depth := holder.engraving_m) > Holder().engraving_m:
        raise CannotBeMadeError(f"a number engraved {_mm(depth)} deep, more than half through a "
                                f"plate of {_mm(thickness)}", "Reduce engraving_m.")
    openings: list[tuple[str, Prism]] = []

    def through(prism: Prism) -> Prism:
        return replace(prism, z_min=-thickness, z_max=2 * thickness)

    for block in group:
        bottom = block.prism.z_min - low
        pocket = replace(pockets[block.number], z_max=2 * thickness,
                         z_min=bottom if bottom > LEVEL_M else -thickness)
        if bottom >= thickness:
            raise CannotBeMadeError(f"a plate of {_mm(thickness)} below block {block.name}, which "
                                    f"begins at {_mm(bottom)}", "Increase thickness_m.")
        openings.append((f"block {block.name}", pocket))
        if holder.corner_relief_m:
            relief = circle(holder.corner_relief_m)
            corners = [edge.start for edge in block.prism.outline]
            openings += [(f"block {block.name}", replace(pocket, outline=relief, origin=corner))
                         for corner in block.prism.placed(np.array(corners))]
    openings += [(f"rod {number}", through(rod)) for number, rod in enumerate(frame.rods, start=1)]
    bare, first, second = thinnest_wall([block.prism.polygon for block in group], range(len(group)))
    if bare < LEVEL_M:
        raise CannotBeMadeError(
            f"no wall between blocks {group[first].name} and {group[second].name}, which touch or "
            "lie one above the other", "Leave gaps between the blocks.", whatever=True)
    wall = _thinnest_wall(openings, holder, frame)
    _check_iron(low, low + thickness, frame, iron)
    if frame.inner:
        openings.append(("bore", through(Prism(circle(frame.inner), 0.0, 0.0))))
    return Plate(0, Prism(_rim(frame.outer, holder.mark_m), 0.0, thickness),
                 tuple(prism for _, prism in openings), (low,),
                 (tuple(block.number for block in group),), frame.floor, wall,
                 frame.inner, frame.outer)


def _thinnest_wall(
    openings: Sequence[tuple[str, Prism]], holder: Holder, frame: _Frame
) -> float:
    """Return the thinnest wall in m; raise CannotBeMadeError if it is too thin."""
    names, polygons = [name for name, _ in openings], [prism.polygon for _, prism in openings]
    wall, first, second = thinnest_wall(polygons, names)
    where, hint = f"{names[first]} and {names[second]}", "or leave larger gaps between the blocks"
    if max(first, second) >= len(names) - len(frame.rods):
        hint = "or take fewer or thinner rods, or another radius of their circle"
    for name, polygon in zip(names, polygons, strict=True):
        inside = distance_from_origin(polygon) - frame.inner if frame.inner else np.inf
        outside = frame.outer - 2 * holder.mark_m - float(np.hypot(*polygon.T).max())
        if min(inside, outside) < wall:
            wall, hint = min(inside, outside), "or change the radii of the plates"
            where = f"{name} and the {'bore' if inside < outside else 'edge'} of the plate"
    if wall < holder.least_wall_m * (1 - 1e-6):
        raise CannotBeMadeError(
            f"a wall of {_mm(max(wall, 0.0))} between {where}, thinner than least_wall_m = "
            f"{_mm(holder.least_wall_m)}",
            f"Reduce least_wall_m, clearance_m or mark_m, {hint}.")
    return wall


def _check_iron(low: float, high: float, frame: _Frame, iron: Sequence[IronSolid]) -> None:
    """Raise CannotBeMadeError if a plate between two heights in m meets iron."""
    for number, body in enumerate(iron, start=1):
        if (body.z_min < high - LEVEL_M and body.z_max > low + LEVEL_M
                and body.inner_radius < frame.outer and body.outer_radius > frame.inner):
            raise CannotBeMadeError(
                f"plates from {_mm(frame.inner)} to {_mm(frame.outer)}, where body {number} of "
                "iron is", "Give inner_radius_m and outer_radius_m.")


def _rim(radius: float, mark: float) -> Outline:
    """Return the edge of a plate, with the marks of the x axis and of larger angles."""
    outline = circle(radius)
    if not mark:
        return outline
    x, beside = np.array([1.0, 0.0]), 5 * mark / radius
    outline = with_notch(outline, np.zeros(2), x, -2 * mark, 2 * mark)
    return with_notch(outline, np.zeros(2), unit_circle(beside)[:2], -mark, mark)


def _shape(plate: Plate) -> object:
    """Return the shape of a plate to 1 µm, whatever the order of its openings."""
    return round(1e6 * plate.thickness_m), frozenset(
        (round(1e6 * prism.z_min),
         frozenset(map(tuple, (np.round(1e6 * prism.polygon) + 0.0).tolist())))
        for prism in plate.openings)


def _numbered(plate: Plate, number: int, holder: Holder, frame: _Frame) -> Plate:
    """Return a plate with its number, engraved outside of the pockets where there is room."""
    room = frame.outer - 2 * holder.mark_m - frame.pockets - 2 * holder.least_wall_m
    digit_m = 4e-3  # largest height of the engraved number of a plate
    height, depth = min(digit_m, room), min(holder.engraving_m, plate.thickness_m / 2)
    if depth and height >= digit_m / 2:
        rods = [rod.polygon for rod in frame.rods]
        for angle in np.radians(np.arange(0.0, 360.0, 3.0)):
            bars = digits(str(number), height, frame.pockets + holder.least_wall_m + room / 2,
                          angle, plate.thickness_m - depth, 2 * plate.thickness_m)
            wall, _, _ = thinnest_wall([*rods, *(bar.polygon for bar in bars)],
                                       ["rod"] * len(rods) + ["number"] * len(bars))
            if wall >= holder.least_wall_m:
                return replace(plate, number=number, openings=plate.openings + bars, bars=bars)
    return replace(plate, number=number)


def _mm(length: float) -> str:
    """Return a length in m as text in mm."""
    return f"{1e3 * length:.4g} mm"
