"""Page of `cad`: the plan to assemble a magnet, with a drawing for every plate."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np
from markupsafe import Markup

from halbach_fe.core.arrays import Floats, box_middle, face_vectors, polygon_area, slices
from halbach_fe.core.files import atomic, write_text
from halbach_fe.core.progress import Progress, quiet
from halbach_fe.design.assembly import AssembledBlock, Assembly
from halbach_fe.design.holder import LEVEL_M, Plate
from halbach_fe.geo.step_solids import PER_M, Group, Occurrence, Solid, solid, step_text
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.outline import Prism, at_heights, circle, upright
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import (
    Page,
    Plain,
    Rows,
    Section,
    Table,
    attributes,
    columns_by_axis,
    csv_file,
    rendered,
)
from halbach_fe.report.words import counted, in_a_row

FLAT = 0.1
"""Part of a magnetization in the plane of a drawing below which it has no arrow."""

LETTER, LARGEST = 0.6, 1 / 18
"""Width of a letter relative to its height, and largest height relative to the plate's radius."""


@dataclass(frozen=True)
class Sheet:
    """The blocks of one drawing."""

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
            level.sort(key=lambda one: one.block.place)
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
    numbers = [str(ring) for ring in sorted({one.block.ring for one in blocks})]
    return f"ring{'s' * (len(numbers) > 1)} {in_a_row(numbers)}"


@dataclass(frozen=True)
class Drawn:
    """A block in a drawing; lengths are in mm, and y points down."""

    path: str
    """Its outline."""
    arrow: tuple[float, float, float, float] | None
    """Start and end of the arrow of its magnetization."""
    width: float
    """Width of the arrow."""
    label: str
    """Number of its slot, and serial number."""
    x: float
    y: float
    turn_deg: float
    anchor: str
    """Place and direction of the label, and which of its ends is there."""
    size: float
    """Height of its letters."""


@dataclass(frozen=True)
class Drawing:
    """A sheet as the template draws it, in mm."""

    title: str
    blocks: list[Drawn]
    plate: str
    """Path of the plate and its openings."""
    engraved: str
    """Path of the bars of the engraved number."""
    number: int | None
    """Number of the plate; None without one."""
    reach: float
    """Half the size of the drawing."""
    tables: list[Rows]
    """Rows of text for the tables side by side."""


def drawing(
    sheet: Sheet, prefix: str, ordered_as: Mapping[int, int] = MappingProxyType({})
) -> Drawing:
    """Return what the template draws for a sheet; serial numbers go without their ``prefix``.

    ``ordered_as`` names for a kind of blocks the kind that it is, turned over or about.

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
        middle = box_middle(polygon)
        width = float(np.sqrt(abs(polygon_area(polygon))))
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
    radii = np.array([float(np.hypot(*box_middle(one))) for one in outlines])
    widths = np.array([np.sqrt(abs(polygon_area(one))) for one in outlines])
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
    turned = f", {one.up or '−z'} up" if any(one.turn_deg) else ""
    return f"{place}: {one.serial.removeprefix(prefix)}{turned}" if one.serial else place


def labels_in_words(drawn: Sequence[Sheet], prefix: str) -> str:
    """Say what the labels of blocks are on all sheets, see `_label`."""
    places = {"its name" if one.has_own_name else "its ring and slot" if len(sheet.rings) > 1
              else "its slot" for sheet in drawn for one in sheet.blocks}
    serial = (", then its serial number"
              if any(one.serial for sheet in drawn for one in sheet.blocks) else "")
    without = f" without the {prefix} that all begin with" if serial and prefix else ""
    turned = any(any(one.turn_deg) for sheet in drawn for one in sheet.blocks)
    return (f"The label of a block is {' or '.join(sorted(places))}{serial}{without}"
            + (", and of a block that is turned in its place, which of its axes is up." * turned
               or "."))


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


def _tables(sheet: Sheet, ordered_as: Mapping[int, int]) -> list[Rows]:
    """Return the rows of the tables under a drawing, side by side."""
    # Number of tables side by side under a drawing, and of rows from which there is another one.
    most_tables, shortest = 3, 8
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
            row["kind"] = str(number) if other == number else f"{other}, turned"
        rows.append(row | {"way round": one.way_round.replace("counter-clockwise", "ccw")
                           .replace("clockwise", "cw").replace("from outwards, ", "")})
    tables = min(most_tables, -(-len(rows) // shortest))
    length = -(-len(rows) // tables)
    return [rows[part] for part in slices(len(rows), length)]


def _outline_mm(one: AssembledBlock) -> Floats:
    """Return the outline (n, 2) of a block in mm; of a tilted one, that of its lower end."""
    prism = upright(one.block)
    if prism is not None:
        return 1e3 * prism.polygon
    corners = np.array([edge.start for edge in one.block.outline])
    return np.asarray(1e3 * one.block.from_frame(at_heights(corners, one.block.z_min))[:, :2])


def common_beginning(serials: Sequence[str]) -> str:
    """Return what all serial numbers begin with, if they differ after it."""
    first, last = min(serials), max(serials)
    same = next((number for number, (one, other) in enumerate(zip(first, last, strict=False))
                 if one != other), 0)
    return first[:same]


def _path(polygon: Floats) -> str:
    """Return a closed polygon as a path of SVG, whose y axis points down."""
    return "M" + "L".join(f"{x:.2f} {-y:.2f}" for x, y in polygon) + "Z"


UNIT = "Unit: mm. z is the axis of the magnet; angles count from x, counter-clockwise from +z"


def holder_name(plate: Plate) -> str:
    """Return the name of the files of a plate, without their endings."""
    return f"holder_{plate.number:02d}"


def solid_names(assembly: Assembly) -> list[str]:
    """Return the names of the files of `write_solids`."""
    stems = ["blocks", *map(holder_name, assembly.plates)]
    whole = ["magnet.step"] if assembly.plates or assembly.magnet.iron else []
    return [*(f"{stem}.{ending}" for stem in stems for ending in ("step", "stl")), *whole]


def write_solids(assembly: Assembly, folder: Path, progress: Progress) -> None:
    """Write blocks, plates and the whole magnet as STEP and STL files."""
    name, iron = assembly.magnet.name, assembly.magnet.iron
    total, done = len(assembly.kinds) + len(assembly.plates) + len(iron), 0

    def made(part: str, body: Prism, openings: tuple[Prism, ...] = ()) -> tuple[Solid, Floats]:
        nonlocal done
        progress(done, total)
        text, triangles = solid(part, body, openings)
        done += 1
        return Solid(part, text), triangles

    def write(stem: str, top: Solid | Group, triangles: Floats) -> None:
        write_text(folder / f"{stem}.step", step_text(top, UNIT))
        write_stl(triangles, f"{top.name}, unit mm", folder / f"{stem}.stl")

    parts = [made(f"{kind.shape}, magnetized {kind.magnetized}", kind.solid)
             for kind in assembly.kinds]
    rings = _by_ring(assembly, {kind.number: part for kind, (part, _) in zip(
        assembly.kinds, parts, strict=True)})
    write("blocks", Group(f"blocks of {name}", rings), np.concatenate([
        _placed(parts[one.kind.number - 1][1], one) for one in assembly.blocks]))
    others = []
    for plate in assembly.plates:
        count = len(plate.heights_m)
        part, triangles = made(f"holder {plate.number}", plate.body, plate.openings)
        write(holder_name(plate), part, triangles)
        others += [Occurrence(part, f"{part.name}, copy {copy} of {count}",
                              np.array([0.0, 0.0, PER_M * height]))
                   for copy, height in enumerate(plate.heights_m, start=1)]
    for number, body in enumerate(iron, start=1):
        part, _ = made(f"iron {number}", *_iron_prisms(body))
        others.append(Occurrence(part, part.name))
    if others:
        write_text(folder / "magnet.step",
                   step_text(Group(name, [*rings, *others]), UNIT))
    progress(total, total)


def _by_ring(assembly: Assembly, parts: dict[int, Solid]) -> list[Occurrence]:
    """Return the blocks as one group for each ring; ``parts`` are the solids of the kinds."""
    rings: dict[int, list[Occurrence]] = {}
    for one in assembly.blocks:
        rings.setdefault(one.block.ring, []).append(Occurrence(
            parts[one.kind.number], one.name, PER_M * one.block.position, one.block.axes))
    return [Occurrence(Group(f"ring {ring}", members), f"ring {ring}")
            for ring, members in rings.items()]


def _iron_prisms(body: IronSolid) -> tuple[Prism, tuple[Prism, ...]]:
    """Return a body of iron as a prism and its openings."""
    if body.outline is not None:
        return Prism(body.outline, body.z_min, body.z_max), ()
    bore = (Prism(circle(body.inner_radius), body.z_min, body.z_max),) if body.inner_radius else ()
    return Prism(circle(body.outer_radius), body.z_min, body.z_max), bore


def _placed(triangles: Floats, one: AssembledBlock) -> Floats:
    """Return triangles (n, 3, 3) in mm of a block's own frame where the block is."""
    return np.asarray(triangles @ one.block.axes.T + PER_M * one.block.position)


def write_stl(triangles: Floats, title: str, path: Path) -> None:
    """Write triangles (n, 3, 3) as a binary STL file; corners run counter-clockwise from outside.

    ``title`` stands at the beginning of the file.
    """
    normals = face_vectors(triangles)
    records = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)),
                                        ("attributes", "<u2")])
    records["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    records["corners"] = triangles
    head = title.encode("ascii", "replace")[:80].ljust(80)
    with atomic(path) as temporary, temporary.open("wb") as file:
        file.write(head + np.uint32(len(triangles)).astype("<u4").tobytes())
        file.write(records.tobytes())


FRAME = ("x, y, z of the magnet; x is at the large notch of a plate, the pockets are open towards "
         "+z, and angles count counter-clockwise as seen from +z")


def answer(assembly: Assembly) -> Answer:
    """Say what to order and to make, how far that is certain, and what to do next."""
    copies = sum(len(plate.heights_m) for plate in assembly.plates)
    said = [f"{counted(len(assembly.blocks), 'block')} of {counted(len(assembly.kinds), 'kind')}"
            + (f" go into {counted(copies, 'plate')} of {counted(len(assembly.plates), 'shape')}."
               if copies else ".")]
    different = len(set(assembly.ordered_as))
    if different < len(assembly.kinds):
        said.append(f"To order are {counted(different, 'kind')}: the others are the same blocks, "
                    "turned over or about.")
    if not any(kind.material for kind in assembly.kinds):
        said.append("The study names no grade (array.material): order one that has the remanence "
                    "of the table, and bears the temperature and the field of the others, which "
                    "halbach-fe demagnetization tells.")
    said += [f"Some are without a plate, which would have {reason}." if copies else
             f"No plates are drawn, as they would have {reason}."
             for reason in assembly.reasons]
    trust = ("Yes, as far as shapes and places of the study are right."
             + (" Whether the plates bear the forces was not computed." if copies else ""))
    if assembly.plates:
        wall = min(plate.wall_m for plate in assembly.plates)
        said.append(f"Pockets are {1e3 * assembly.holder.clearance_m:.3g}\u00a0mm larger than the "
                    "blocks on each side" + (
                        "." if np.isinf(wall) else
                        f", and the thinnest wall is {1e3 * wall:.3g}\u00a0mm."))
        step = ("Make one pocket first and try a block in it; then print the page of this plan, "
                "and go sheet by sheet. See which forces the blocks will feel.")
    else:
        step = "See which forces the blocks feel, for tools and glue."
    if assembly.left_over:
        said.append(f"{counted(assembly.left_over, 'measured block is', 'measured blocks are')} "
                    "left over.")
    return Answer("What is to be ordered and made?", " ".join(said), trust, step,
                  "halbach-fe forces STUDY -o DIR")


def _kind_rows(assembly: Assembly) -> Rows:
    """Return a row of text for every kind of blocks."""
    graded = any(kind.material for kind in assembly.kinds)
    ordered_as = assembly.ordered_as
    total = {first: sum(kind.count for kind, other in zip(assembly.kinds, ordered_as, strict=True)
                        if other == first) for first in ordered_as}
    fewer = len(total) < len(assembly.kinds)
    return [{"kind": str(kind.number), "shape": kind.shape.replace(" × ", "\u00a0×\u00a0"),
             "magnetized": kind.magnetized, "remanence": f"{kind.remanence_T:.4g}\u00a0T",
             **({"grade": kind.material or ""} if graded else {}),
             "blocks": str(kind.count),
             **({"to order": str(total[kind.number]) if first == kind.number else
                 f"kind {first}, turned"} if fewer else {})}
            for kind, first in zip(assembly.kinds, ordered_as, strict=True)]


def _plate_rows(assembly: Assembly) -> Rows:
    """Return a row of text for every plate."""
    return [{"holder": str(plate.number), "files": f"{holder_name(plate)}.step, .stl",
             "to make": str(len(plate.heights_m)), "pockets": str(len(plate.blocks[0])),
             "thickness": f"{1e3 * plate.thickness_m:.4g}\u00a0mm",
             "floor": f"{1e3 * plate.floor_m:.3g}\u00a0mm" if plate.floor_m else "none",
             "thinnest wall": f"{1e3 * plate.wall_m:.3g}\u00a0mm",
             "lower faces at z": ", ".join(map(height_mm, sorted(plate.heights_m)))
             + "\u00a0mm"} for plate in assembly.plates]


def _diameters(assembly: Assembly) -> str:
    """Return the diameters of the plates in words; all have the same."""
    if not assembly.plates:
        return ""
    outer, inner = (2e3 * radius for radius in (
        assembly.plates[0].outer_radius_m, assembly.plates[0].inner_radius_m))
    bore = f"and a bore of {inner:.5g}\u00a0mm" if inner else "and no bore"
    return f"All plates have an outer diameter of {outer:.5g}\u00a0mm {bore}."


def spacers(assembly: Assembly) -> str:
    """Say how far neighbouring plates are apart; empty if there are no two plates.

    Plates that touch, or lie beside each other, have no spacer between them.
    """
    shortest_mm = 1e-3  # distance between plates below which they touch, but for rounding
    limits = sorted((low, low + plate.thickness_m) for plate in assembly.plates
                    for low in plate.heights_m)
    if len(limits) < 2:
        return ""
    lengths = [1e3 * (low - high) for (_, high), (low, _) in itertools.pairwise(limits)]
    if min(lengths) < shortest_mm:
        return "Keep the distances between the lower faces, by spacers where plates do not touch."
    gaps = [f"{length:.4g}" for length in lengths]
    length = gaps[0] if len(set(gaps)) == 1 else f"from the lowest up, {', '.join(gaps)}"
    return f"The spacers between neighbouring plates are {length}\u00a0mm long."


def _summary(assembly: Assembly) -> Plain:
    """Return the content of assembly.json."""
    return {
        "study": assembly.magnet.name, "blocks": len(assembly.blocks),
        "left_over": assembly.left_over, "frame": FRAME, "unit_of_solids": "mm",
        "kinds": [{"kind": kind.number, **attributes(
            kind, "shape", "magnetized", "remanence_T", "material", "count")}
            for kind in assembly.kinds],
        "holder": assembly.holder.model_dump(mode="json"),
        "plates": [{"holder": plate.number, "file": f"{holder_name(plate)}.step",
                    "lower_faces_z_m": list(plate.heights_m), "pockets": len(plate.blocks[0]),
                    **attributes(plate, "inner_radius_m", "outer_radius_m", "thickness_m",
                                 "floor_m"), "thinnest_wall_m": plate.wall_m}
                   for plate in assembly.plates],
        "without_holder": list(assembly.reasons), "files": solid_names(assembly)}


def _columns(assembly: Assembly) -> dict[str, Iterable[object]]:
    """Return the columns of assembly.csv, with a row for every block."""
    blocks = assembly.blocks
    return {
        "ring": [one.block.ring for one in blocks], "slot": [one.block.slot for one in blocks],
        "name": [one.block.name for one in blocks], "serial": [one.serial for one in blocks],
        "kind": [one.kind.number for one in blocks],
        "holder": [one.plate.number if one.plate else "" for one in blocks],
        **columns_by_axis("{}_m", np.array([one.block.middle for one in blocks])),
        "angle_deg": [one.angle_deg for one in blocks],
        **columns_by_axis("magnetization_{}", np.array([one.direction for one in blocks])),
        "magnetization_angle_deg": [one.magnetization_angle_deg for one in blocks],
        "from_radius_deg": [one.from_radius_deg for one in blocks],
        "elevation_deg": [one.elevation_deg for one in blocks],
        **(columns_by_axis("turn_{}_deg", np.array([one.turn_deg for one in blocks]))
           if any(any(one.turn_deg) for one in blocks) else {}),
        "way_round": [one.way_round for one in blocks]}


def page(assembly: Assembly, progress: Progress = quiet) -> Page:
    """Return the page of what is to be ordered and made; its files are the solids, too."""
    kinds, plates = _kind_rows(assembly), _plate_rows(assembly)
    turned = ("" if not kinds or "to order" not in kinds[0] else " Where the shape looks the same "
              "upside down, a cube or bar on another side, or a cylinder turned about its axis, "
              "kinds whose magnetization turns with it are the same block.")
    first, *solids = solid_names(assembly)
    return Page("cad", "assembly", assembly.magnet.study, answer(assembly), _summary(assembly), [
        Section([
            Table(kinds), "Sizes are along the block's own x × y × z: in a ring x points outwards, "
            "or along the magnetization where cubes turn with it, and z along the magnet. The "
            f"magnetization points to the north pole.{turned}"], "Blocks to order"),
        Section([Table(plates), _of_the_plates(assembly)], "Plates to make", about=plates),
        Section(["Magnets attract one another from decimetres away: `halbach-fe forces` computes "
                 "what each block feels while it is inserted.", partial(_sheets, assembly)])],
        {"Blocks to order": kinds, "Plates to make": plates}, stem="assembly", files={
            first: lambda path: write_solids(assembly, path.parent, progress),
            **dict.fromkeys(solids),
            "assembly.csv": csv_file(_columns(assembly), {
                "study": assembly.magnet.name, "frame": FRAME})})


def _of_the_plates(assembly: Assembly) -> str:
    """Say what the files of the plates hold, and how plates lie above one another."""
    holder, through = assembly.holder, any(not plate.floor_m for plate in assembly.plates)
    mark = (", and the notch in each pocket is where the north pole of its block goes"
            if holder.mark_m else "")
    number = (" The number of the holder is engraved into the upper face."
              if holder.engraving_m else "")
    return (f"{_diameters(assembly)} The STEP and STL files are in mm. Every file of a plate has "
            "its lower face at z = 0. Pockets are open at the top"
            f"{', and go through where there is no floor' * through}; the large notch in the outer "
            "edge is at the angle 0 (the x axis), the small one beside it on the side of larger "
            f"angles{mark}.{number} {spacers(assembly)}")


def _sheets(assembly: Assembly) -> Markup:
    """Return a drawing of every plate, with the blocks in their places, as HTML."""
    ordered_as = dict(zip((kind.number for kind in assembly.kinds), assembly.ordered_as,
                          strict=True))
    prefix = common_beginning([one.serial for one in assembly.blocks])
    drawn = sheets(assembly)
    return Markup(rendered(
        "assembly.html.j2", labels=labels_in_words(drawn, prefix), holder=assembly.holder,
        measured=any(one.serial for one in assembly.blocks),
        sheets=[drawing(sheet, prefix, ordered_as) for sheet in drawn]))
