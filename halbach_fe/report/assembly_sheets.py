"""Drawings of the sheets of an assembly plan: what goes into every plate, seen from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.design.assembly import AssembledBlock, Assembly
from halbach_fe.design.holder import LEVEL_M, Plate
from halbach_fe.geometry.prism import upright

TABLES, SHORTEST_TABLE = 3, 8
"""Number of tables side by side under a drawing, and of rows from which there is another one."""

FLAT = 0.1
"""Part of a magnetization in the plane of a drawing below which it has no arrow."""

LETTER, LARGEST = 0.6, 1 / 18
"""Width of a letter relative to its height, and largest height relative to the plate's radius."""


@dataclass(frozen=True)
class Sheet:
    """The blocks of one drawing.

    Attributes
    ----------
    title : str
    blocks : sequence of AssembledBlock
    plate : Plate or None
    """

    title: str
    blocks: Sequence[AssembledBlock]
    plate: Plate | None = None

    @property
    def rings(self) -> list[int]:
        """The rings that the blocks belong to."""
        return sorted({one.block.ring for one in self.blocks})


def sheets(assembly: Assembly) -> list[Sheet]:
    """Return what to draw, from below: every copy of a plate, then heights without a plate."""
    copies = sorted((height, plate.number, copy) for plate in assembly.plates
                    for copy, height in enumerate(plate.heights_m))
    found = []
    for height, number, copy in copies:
        plate = assembly.plates[number - 1]
        blocks = [assembly.blocks[one] for one in sorted(plate.blocks[copy])]
        of = f", copy {copy + 1} of {len(plate.heights_m)}" if len(plate.heights_m) > 1 else ""
        found.append(Sheet(f"Holder {number}{of}: {_rings(blocks)}, lower face at z = "
                           f"{height_mm(height)} mm", blocks, plate))
    heights: list[list[AssembledBlock]] = []
    for one in sorted((one for one in assembly.blocks if one.plate is None),
                      key=lambda one: float(one.block.middle[2])):
        z = float(one.block.middle[2])
        if not heights or z - float(heights[-1][-1].block.middle[2]) > LEVEL_M:
            heights.append([])
        heights[-1].append(one)
    for level in heights:
        if len(level) > 1:
            level.sort(key=lambda one: (one.block.ring, one.block.slot))
            found.append(Sheet(f"Without a holder: {_rings(level)}, middle at z = "
                               f"{height_mm(float(level[0].block.middle[2]))} mm", level))
    alone = [level[0] for level in heights if len(level) == 1]
    return found + ([Sheet("Blocks at heights of their own, seen from above", alone)]
                    if alone else [])


def height_mm(z: float) -> str:
    """Return a height in m as text in mm; what is 0 but for rounding is 0."""
    return f"{1e3 * round(z, 9) + 0.0:.5g}"


def _rings(blocks: Sequence[AssembledBlock]) -> str:
    """Return the rings of blocks in words."""
    numbers = sorted({one.block.ring for one in blocks})
    if len(numbers) == 1:
        return f"ring {numbers[0]}"
    return f"rings {', '.join(map(str, numbers[:-1]))} and {numbers[-1]}"


@dataclass(frozen=True)
class Drawn:
    """A block in a drawing; lengths are in mm, and y points down.

    Attributes
    ----------
    path : str
        Its outline.
    arrow : tuple of 4 floats, or None
        Start and end of the arrow of its magnetization.
    width : float
        Width of the arrow.
    label : str
        Number of its slot, and serial number.
    x, y, turn_deg, anchor
        Place and direction of the label, and which of its ends is there.
    size : float
        Height of its letters.
    """

    path: str
    arrow: tuple[float, float, float, float] | None
    width: float
    label: str
    x: float
    y: float
    turn_deg: float
    anchor: str
    size: float


@dataclass(frozen=True)
class Drawing:
    """A sheet as the template draws it, in mm.

    Attributes
    ----------
    title : str
    blocks : list of Drawn
    plate : str
        Path of the plate and its openings.
    engraved : str
        Path of the bars of the engraved number.
    number : int or None
        Number of the plate; None without one.
    reach : float
        Half the size of the drawing.
    tables : list of list of dict
        Rows of text for the tables side by side.
    """

    title: str
    blocks: list[Drawn]
    plate: str
    engraved: str
    number: int | None
    reach: float
    tables: list[list[dict[str, str]]]


def drawing(
    sheet: Sheet, prefix: str, ordered_as: Mapping[int, int] = MappingProxyType({})
) -> Drawing:
    """Return what the template draws for a sheet; serial numbers go without their ``prefix``.

    ``ordered_as`` names for a kind of blocks the kind that it is, turned upside down.

    The labels of the outermost blocks are outside of the plate, those of the innermost, if there
    are others, in its bore, and all others on the blocks.
    """
    outlines = [_outline_mm(one) for one in sheet.blocks]
    plate = sheet.plate
    bars = plate.bars if plate else ()
    parts = [] if plate is None else [1e3 * plate.body.polygon, *(
        1e3 * opening.polygon for opening in plate.openings
        if not any(opening is bar for bar in bars))]
    radius = max(float(np.hypot(*polygon.T).max()) for polygon in [*outlines, *parts])
    bore = min(float(np.hypot(*polygon.T).min()) for polygon in outlines)
    labels = [_label(one, len(sheet.rings) > 1, prefix) for one in sheet.blocks]
    longest = max(map(len, labels))
    layers = _layers(outlines)
    outside = [number for number, layer in enumerate(layers) if layer == max(layers)]
    pitch = 2 * np.pi * radius / len(outside)
    size = min(0.8 * pitch, LARGEST * radius)
    # texts in the bore come nearest to one another at their inner ends
    pitch_over_radius = 0.8 * 2 * np.pi / max(layers.count(0), 1)
    small = min(pitch_over_radius * 0.97 * bore / (1 + pitch_over_radius * LETTER * longest), size)
    drawn = []
    for number, (one, polygon, label) in enumerate(zip(
            sheet.blocks, outlines, labels, strict=True)):
        middle = (polygon.max(axis=0) + polygon.min(axis=0)) / 2
        width = float(np.sqrt(_area(polygon)))
        angle = float(np.arctan2(middle[1], middle[0]))
        place: tuple[float, float, float, str, float]
        if layers[number] == max(layers):
            place = (_upright(angle, radius + size / 2, size, len(label)) if (
                LETTER * len(label) * size < 0.9 * pitch) else
                _radial(angle, radius + size / 2, size, outwards=True))
        elif layers[number] == 0 and LETTER * small * longest < 0.8 * bore:
            place = _radial(angle, 0.97 * bore, small, outwards=False)
        else:
            letters = min(0.4 * width, 0.9 * width / (LETTER * len(label)))
            place = middle[0], -middle[1] + 0.35 * letters, 0.0, "middle", letters
        x, y, turn, anchor, letters = place
        drawn.append(Drawn(_path(polygon), _arrow(one, middle, width), 0.09 * width, label,
                           float(x), float(y), turn, anchor, letters))
    reach = radius + size * (1 + LETTER * longest)
    engraved = " ".join(_path(1e3 * bar.polygon) for bar in bars)
    return Drawing(sheet.title, drawn, " ".join(map(_path, parts)), engraved,
                   plate.number if plate else None, reach, _tables(sheet, ordered_as))


def _layers(outlines: Sequence[Floats]) -> list[int]:
    """Return the number of the layer about the axis of every block, the innermost is 0."""
    radii = np.array([float(np.hypot(*((one.max(axis=0) + one.min(axis=0)) / 2)))
                      for one in outlines])
    widths = np.array([np.sqrt(_area(one)) for one in outlines])
    order = np.argsort(radii, kind="stable")
    steps = np.diff(radii[order]) > 0.5 * widths[order][1:]
    layer = np.zeros(len(radii), int)
    layer[order] = np.concatenate([[0], np.cumsum(steps)])
    return [int(number) for number in layer]


def _label(one: AssembledBlock, several: bool, prefix: str) -> str:
    """Return the label of a block: its slot, or its own name, and its serial number."""
    block = one.block
    place = f"{block.ring}.{block.slot}" if several else str(block.slot)
    if one.has_own_name:
        place = block.name
    return f"{place}: {one.serial.removeprefix(prefix)}" if one.serial else place


def labels_in_words(drawn: Sequence[Sheet], prefix: str) -> str:
    """Say what the labels of blocks are on all sheets, see `_label`."""
    places = {"its name" if one.has_own_name else "its ring and slot" if len(sheet.rings) > 1
              else "its slot" for sheet in drawn for one in sheet.blocks}
    serial = (", then its serial number"
              if any(one.serial for sheet in drawn for one in sheet.blocks) else "")
    without = f" without the {prefix} that all begin with" if serial and prefix else ""
    return f"The label of a block is {' or '.join(sorted(places))}{serial}{without}."


def _radial(
    angle: float, radius: float, size: float, outwards: bool
) -> tuple[float, float, float, str, float]:
    """Return place, direction and end of a text along a radius, that is not upside down."""
    turn = -float(np.degrees(angle))
    flipped = np.cos(angle) < -1e-9
    anchor = "start" if outwards != flipped else "end"
    across = 0.35 * size * (-1 if flipped else 1)  # from the base line to the middle of the letters
    x = radius * np.cos(angle) + across * np.sin(angle)
    y = -radius * np.sin(angle) + across * np.cos(angle)
    return float(x), float(y), turn + (180.0 if flipped else 0.0), anchor, size


def _upright(
    angle: float, radius: float, size: float, letters: int
) -> tuple[float, float, float, str, float]:
    """Return the place of a text that begins at a radius and is not turned."""
    x, y = np.cos(angle), np.sin(angle)
    away = radius + size * (0.5 * LETTER * letters * abs(x) + 0.35 * abs(y))
    return float(away * x), float(-away * y + 0.35 * size), 0.0, "middle", size


def _arrow(
    one: AssembledBlock, middle: Floats, width: float
) -> tuple[float, float, float, float] | None:
    """Return start and end of the line of a magnetization's arrow, None if it is along z.

    The point of the arrow is beyond the line's end, so that the whole is about the block's middle.
    """
    direction = one.direction[:2]
    flat = float(np.linalg.norm(direction))
    if flat < FLAT:
        return None
    along = 0.33 * width * direction / flat
    start, end = middle - along, middle + 2 / 3 * along
    return float(start[0]), -float(start[1]), float(end[0]), -float(end[1])


def _tables(sheet: Sheet, ordered_as: Mapping[int, int]) -> list[list[dict[str, str]]]:
    """Return the rows of the tables under a drawing, side by side."""
    several = len(sheet.rings) > 1
    kinds = len({one.kind.number for one in sheet.blocks}) > 1
    rows = []
    for one in sheet.blocks:
        row = {"": "☐", **({"ring": str(one.block.ring)} if several else {}),
               "slot": str(one.block.slot)}
        if one.has_own_name:
            row["block"] = one.block.name
        if one.serial:
            row["serial"] = one.serial
        if kinds:
            number = one.kind.number
            other = ordered_as.get(number, number)
            row["kind"] = str(number) if other == number else f"{other}, upside down"
        rows.append(row | {"way round": one.way_round.replace("counter-clockwise", "ccw")
                           .replace("clockwise", "cw").replace("from outwards, ", "")})
    tables = min(TABLES, -(-len(rows) // SHORTEST_TABLE))
    length = -(-len(rows) // tables)
    return [rows[start:start + length] for start in range(0, len(rows), length)]


def _outline_mm(one: AssembledBlock) -> Floats:
    """Return the outline (n, 2) of a block in mm; of a tilted one, that of its lower end."""
    prism = upright(one.block)
    if prism is not None:
        return 1e3 * prism.polygon
    corners = np.array([[*edge.start, one.block.z_min] for edge in one.block.outline])
    return np.asarray(1e3 * one.block.from_frame(corners)[:, :2])


def common_beginning(serials: Sequence[str]) -> str:
    """Return what all serial numbers begin with, if they differ after it."""
    first, last = min(serials), max(serials)
    same = next((number for number, (one, other) in enumerate(zip(first, last, strict=False))
                 if one != other), 0)
    return first[:same]


def _area(polygon: Floats) -> float:
    """Return the area of a polygon (n, 2)."""
    x, y = polygon.T
    return float(abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2)


def _path(polygon: Floats) -> str:
    """Return a closed polygon as a path of SVG, whose y axis points down."""
    return "M" + "L".join(f"{x:.2f} {-y:.2f}" for x, y in polygon) + "Z"
