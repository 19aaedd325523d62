"""STEP and STL files in mm of the blocks, of the plates that hold them, and of the whole magnet."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import atomic, write_text
from halbach_fe.core.pace import Progress
from halbach_fe.design.assembly import AssembledBlock, Assembly
from halbach_fe.design.holder import Plate
from halbach_fe.geo.solid import PER_M, Group, Occurrence, Solid, solid, step_text
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.prism import Prism, circle

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
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    records = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)),
                                        ("attributes", "<u2")])
    records["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    records["corners"] = triangles
    head = title.encode("ascii", "replace")[:80].ljust(80)
    with atomic(path) as temporary, temporary.open("wb") as file:
        file.write(head + np.uint32(len(triangles)).astype("<u4").tobytes())
        file.write(records.tobytes())
