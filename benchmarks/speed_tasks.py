"""Tasks of `benchmarks.speed`, run as a script, so that the old code can run them too.

They use only what both have: the study's keys, `build_magnet`, `unit_field`, the command line.
"""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

SECTORS: dict[str, Any] = {
    "name": "speed", "dimension": 3,
    "array": {"blocks_per_ring": 16, "rings": 12, "inner_radius_m": 0.104,
              "outer_radius_m": 0.1865, "ring_length_m": 1 / 12, "remanence_T": 1.06,
              "recoil_permeability": 1.0, "block": {"shape": "sector"}},
    "mesh": {"block_size_m": 0.027},
    "observation": {"quantity": "flux_density", "positions": {
        "kind": "circles", "radius_m": [0.04, 0.075], "angles": 16, "z_min_m": -0.7,
        "z_max_m": 0.7, "count": 40}},
    "noise": {"regions": [{"name": "all", "sigma_T": 5e-5}]},
    "prior": {"magnitude_sd": 0.01, "direction_sd_deg": 1.0, "common_mode_sd": 0.01}}
POINTS = 10_000
DISPLACED, SHIFT_M = (6, 5), (3.0e-3, 0.0, 0.0)
"""Ring and slot of the block that is displaced in the truth, and how far: twice what the map
shows."""


def changed(document: dict[str, Any], **keys: Any) -> dict[str, Any]:
    """A document with keys of its tables replaced; a double underscore separates table and key."""
    found = json.loads(json.dumps(document))
    for key, value in keys.items():
        *tables, last = key.split("__")
        here = found
        for table in tables:
            here = here.setdefault(table, {})
        here[last] = value
    return found


def truth(document: dict[str, Any], points: Any) -> Any:
    """Field (n, 3) in T by magpylib, of blocks that deviate and one that is displaced."""
    import magpylib

    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.study.reader import parse_study

    generator = np.random.default_rng(3)
    total = np.zeros((len(points), 3))
    array = document["array"]
    for block in build_magnet(parse_study(document)).blocks:
        middle = np.degrees(np.arctan2(*block.middle[1::-1]))
        half = 180 / array["blocks_per_ring"]
        own = block.remanence * (np.array(block.easy_axis) + 0.01 * generator.standard_normal(3))
        part = magpylib.magnet.CylinderSegment(
            dimension=(array["inner_radius_m"], array["outer_radius_m"], block.z_max - block.z_min,
                       middle - half, middle + half),
            position=(0, 0, (block.z_min + block.z_max) / 2), polarization=own)
        if (block.ring, block.slot) == DISPLACED:
            part.move(SHIFT_M)
        total += part.getB(points)
    return total + 5e-5 * generator.standard_normal(total.shape)


def exact() -> dict[str, float]:
    """Processor seconds for three unit columns of every block at points that follow no pattern."""
    import magpylib

    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.solver.exact_block_field import unit_field
    from halbach_fe.study.reader import parse_study

    generator = np.random.default_rng(1)
    found: dict[str, float] = {}
    for shape in ("sectors", "cuboids"):
        document = SECTORS if shape == "sectors" else changed(
            SECTORS, array__block={"shape": "cuboid", "width_m": 0.03})
        blocks = build_magnet(parse_study(document)).blocks[:48]
        radius, angle = 0.095 * np.sqrt(generator.uniform(size=POINTS)), generator.uniform(
            0, 2 * np.pi, POINTS)
        points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle),
                                  generator.uniform(-0.5, 0.5, POINTS)])
        unit_field(blocks[0], points)  # compiled, or loaded
        start = time.process_time()
        ours = [unit_field(block, points) for block in blocks]
        found[f"{shape}_s"] = time.process_time() - start
        start, error, largest = time.process_time(), 0.0, 0.0
        bodies = [_body(magpylib, block) for block in blocks]
        theirs = []
        for body in bodies:
            columns = np.empty((len(points), 3, 3))
            for axis in range(3):
                body.polarization = np.eye(3)[axis]
                columns[:, :, axis] = body.getB(points)
            theirs.append(columns)
        found[f"{shape}_magpylib_s"] = time.process_time() - start
        for own, other, body in zip(ours, theirs, bodies, strict=True):
            turned = own if shape == "sectors" else own @ body.orientation.as_matrix()
            error = max(error, float(np.abs(turned - other).max()))
            largest = max(largest, float(np.abs(other).max()))
        found[f"{shape}_error"] = error / largest
    return found


def _body(magpylib: Any, block: Any) -> Any:
    """The block in magpylib: a sector about the axis, or a cuboid."""
    from scipy.spatial.transform import Rotation

    z, length = (block.z_min + block.z_max) / 2, block.z_max - block.z_min
    arcs = [edge for edge in block.outline if edge.arc]
    if arcs:
        radii = sorted(float(edge.radius) for edge in arcs)
        middle = np.degrees(np.arctan2(block.middle[1], block.middle[0]))
        half = abs(np.degrees(arcs[0].angles[1])) / 2
        return magpylib.magnet.CylinderSegment(
            dimension=(radii[0], radii[1], length, middle - half, middle + half),
            position=(0, 0, z), polarization=(0, 0, 1))
    corners = np.array([edge.start for edge in block.outline])
    along, across = corners[1] - corners[0], corners[2] - corners[1]
    body = magpylib.magnet.Cuboid(
        dimension=(np.linalg.norm(along), np.linalg.norm(across), length),
        position=(*corners.mean(axis=0), z), polarization=(0, 0, 1))
    body.orientation = Rotation.from_euler("z", np.arctan2(along[1], along[0]))
    return body


def start() -> dict[str, float]:
    """Wall seconds of `halbach-fe --help`, and of an interpreter that does nothing."""
    found = {}
    for name, code in (("help", "from halbach_fe.cli import main; main(['--help'])"),
                       ("python", "pass")):
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
        found[f"{name}_s"] = time.perf_counter() - begin
    return found


def make_map(folder: Path) -> dict[str, float]:
    """Write ``study.toml`` of the magnet in vacuum, and a map of it, into a folder."""
    from halbach_fe.measurement.field_map import field_map, write_map
    from halbach_fe.measurement.positions import points_from
    from halbach_fe.study.reader import parse_study

    points = points_from(parse_study(SECTORS).observation.positions)
    (folder / "study.toml").write_text(tomlkit.dumps(SECTORS))
    write_map(field_map(points, truth(SECTORS, points)), folder / "map.csv")
    return {}


def diagnose_map(folder: Path) -> dict[str, float]:
    """Run the command on ``study.toml`` and ``map.csv`` of a folder; say whether it named the
    displaced block, and how many other effects.
    """
    from halbach_fe.cli import main

    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as name, contextlib.redirect_stdout(io.StringIO()) as shown:
        code = main(["diagnose", str(folder / "study.toml"), "--measurements",
                     str(folder / "map.csv"), "-o", str(Path(name) / "out"), "--json",
                     "--no-cache"])
    if code:
        raise SystemExit(code)
    found = json.loads(shown.getvalue())
    names = [each["effect"] for each in found["effects"]]
    return {"named": float("block_displaced" in names),
            "others": float(sum(name != "block_displaced" for name in names)),
            "wall_s": time.perf_counter() - begin}


def solve(study: Path) -> dict[str, float]:
    """Solve a study, error bars included, by the command."""
    from halbach_fe.cli import main

    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as name, contextlib.redirect_stdout(io.StringIO()):
        code = main(["solve", str(study), "-o", str(Path(name) / "out"), "--no-cache", "--json"])
    if code:
        raise SystemExit(code)
    return {"wall_s": time.perf_counter() - begin}


def response(study: Path) -> dict[str, float]:
    """Build the response matrix of a study, error bars included."""
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.measurement.observation import observe
    from halbach_fe.measurement.positions import points_from
    from halbach_fe.response.matrix import response_matrix
    from halbach_fe.solver.getdp import find_getdp
    from halbach_fe.solver.session import Session
    from halbach_fe.study.reader import read_study

    known = read_study(study)
    points = points_from(known.observation.positions)
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        response_matrix(build_magnet(known), observe(known, points, np.ones_like(points, bool)),
                        Session(find_getdp(), Path(name), jobs=2))
    return {"wall_s": time.perf_counter() - begin}


TASKS: dict[str, Callable[..., dict[str, float]]] = {
    "exact": exact, "help": start, "make-map": make_map,
    "diagnose-map": diagnose_map, "solve": solve, "response": response}


if __name__ == "__main__":
    print(json.dumps(TASKS[sys.argv[1]](*map(Path, sys.argv[2:]))))  # noqa: T201
