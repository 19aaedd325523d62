"""Tasks of `benchmarks.speed`, run as a script, so that the old code can run them too.

They use only what both have: the study's keys, `build_magnet`, `unit_field`, the command line.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
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
    """Run the command on ``study.toml`` and ``map.csv`` of a folder; say how many effects it named,
    and which of those that may be hidden are among them.
    """
    from halbach_fe.cli import main

    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as name, contextlib.redirect_stdout(io.StringIO()) as shown:
        os.environ["HALBACH_FE_CACHE"] = str(Path(name) / "cache")  # empty, as on the first day
        code = main(["diagnose", str(folder / "study.toml"), "--measurements",
                     str(folder / "map.csv"), "-o", str(Path(name) / "out"), "--json"])
    if code:
        raise SystemExit(code)
    found = json.loads(shown.getvalue())
    names = [each["effect"] for each in found["effects"]]
    return {"effects": float(len(names)), "wall_s": time.perf_counter() - begin,
            **{name: float(name in names) for name in ("block_displaced", "mapper_translation")}}


def make_waiting(folder: Path) -> dict[str, float]:
    """Write a study and a map for each command that people wait for, into a folder each.

    ``register`` has 338 cubes and 833 points of a map that is displaced and turned, and
    ``register-many`` 400 and 4023, ``infer`` 404 hexagonal prisms with permeability and 637 points;
    ``check`` three maps of the cubes.
    """
    from scipy.spatial.transform import Rotation

    generator = np.random.default_rng(4)
    cubes, many = ([(0.14 * np.cos(a), 0.14 * np.sin(a), z, 2 * a)
                    for z in 0.02 * (np.arange(rings) - (rings - 1) / 2)
                    for a in 2 * np.pi * np.arange(around) / around]
                   for rings, around in ((13, 26), (16, 25)))
    factors, of_many = (1 + 0.01 * generator.standard_normal(len(each)) for each in (cubes, many))
    cube = {"shape": "cuboid", "size_x_m": 0.012, "size_y_m": 0.012, "size_z_m": 0.012}
    pose = Rotation.from_rotvec([0.01, -0.02, 0.03])
    lattice = [(x, y, z, 2 * np.arctan2(y, x)) for z in (-0.03, -0.01, 0.01, 0.03)
               for x, y in ((0.0084 * (i + 0.5 * (j % 2)), 0.00756 * j)
                            for i in range(-12, 13) for j in range(-12, 13))
               if 0.033 < np.hypot(x, y) < 0.0655][:404]
    tables = {
        "register": (cubes, factors, _grid(9, 0.05, 17, 0.06), pose, cube),
        "register-many": (many, of_many, _grid(15, 0.05, 27, 0.06), pose, cube),
        "infer": (lattice, np.ones(404), _grid(9, 0.02, 13, 0.04), None, {
            "shape": "polygon", "sides": 6, "radius_m": 0.004, "size_z_m": 0.018,
            "recoil_permeability": 1.05}),
        "check-2565": (cubes, factors, _grid(9, 0.05, 45, 0.06), pose, {}),
        "check-8892": (cubes, factors, _grid(15, 0.05, 52, 0.06), pose, {}),
        "check-50000": (cubes, factors, _grid(29, 0.05, 80, 0.06), pose, {})}
    for name, (places, strengths, points, turned, shape) in tables.items():
        here = folder / name
        here.mkdir(parents=True, exist_ok=True)
        if shape:
            _write_blocks(here / "blocks.csv", places, shape)
        _write_map(here / "map.csv", points, _field_of(
            places, strengths, points, turned, cubes=name != "infer"), generator)
    return {}


def _grid(across: int, radius: float, along: int, half: float) -> Any:
    """Points (n, 3) in m of a lattice within a cylinder about z."""
    side = np.linspace(-radius, radius, across)
    return np.array([(x, y, z) for x in side for y in side for z in np.linspace(-half, half, along)
                     if np.hypot(x, y) <= 1.01 * radius])


def _field_of(
    places: Any, strengths: Any, points: Any, pose: Any, cubes: bool
) -> Any:
    """Field (n, 3) in T by magpylib in a map that is displaced by (1, -0.5, 2) mm and turned."""
    import magpylib
    from scipy.spatial.transform import Rotation

    seen = points if pose is None else pose.apply(points) + np.array([1e-3, -5e-4, 2e-3])
    total = np.zeros_like(points)
    for (x, y, z, angle), strength in zip(places, strengths, strict=True):
        body: Any = magpylib.magnet.Cuboid(
            polarization=(1.3 * strength, 0, 0), dimension=(0.012,) * 3, position=(x, y, z),
            orientation=Rotation.from_rotvec([0, 0, angle])) if cubes else (
            magpylib.misc.Dipole(
                moment=np.array([np.cos(angle), np.sin(angle), 0]) * 1.3 / (4e-7 * np.pi)
                * 6 * np.sqrt(3) / 4 * 0.004**2 * 0.018, position=(x, y, z)))
        total += body.getB(seen)
    return total if pose is None else pose.inv().apply(total)


def _write_blocks(path: Path, places: Any, shape: dict[str, Any]) -> None:
    """Write a table of free blocks of 1.3 T."""
    names = ["name", "x_m", "y_m", "z_m", "remanence_x_T", "remanence_y_T", "remanence_z_T"]
    turned = shape["shape"] == "cuboid"
    own = {"rotation_z_deg", "remanence_T"} if turned else set(names[4:])
    columns = [*names[:4], *sorted(own), *shape]
    lines = [",".join(columns)]
    for number, (x, y, z, angle) in enumerate(places):
        known = {"name": f"b{number}", "x_m": x, "y_m": y, "z_m": z, "remanence_T": 1.3,
                 "rotation_z_deg": np.degrees(angle), "remanence_x_T": 1.3 * np.cos(angle),
                 "remanence_y_T": 1.3 * np.sin(angle), "remanence_z_T": 0.0, **shape}
        lines.append(",".join(str(known[column]) for column in columns))
    path.write_text("\n".join(lines) + "\n")


def _write_map(path: Path, points: Any, field: Any, generator: Any) -> None:
    """Write a map in T with noise of 20 µT."""
    readings = field + 2e-5 * generator.standard_normal(field.shape)
    np.savetxt(path, np.column_stack([points, readings, np.full(len(points), 2e-5)]),
               delimiter=",", comments="", header="x_m,y_m,z_m,Bx_T,By_T,Bz_T,sigma_T")


def command(folder: Path) -> dict[str, float]:
    """Run the command that a folder is named by on its map, and return how good its answer is."""
    from halbach_fe.cli import main

    verb = folder.name.split("-")[0]
    study = folder / "study.toml"
    begin = time.perf_counter()
    with tempfile.TemporaryDirectory() as name, contextlib.redirect_stdout(io.StringIO()):
        if verb != "check" and not study.exists():
            main(["new", str(study), "--free-blocks", str(folder / "blocks.csv")])
        words = [str(folder / "map.csv")] if verb == "check" else [
            str(study), "--measurements", str(folder / "map.csv")]
        code = main([verb, *words, "-o", str(Path(name) / "out")])
        found: dict[str, float] = {}
        if verb == "register":
            pose = json.loads((Path(name) / "out" / "registration.json").read_text())["poses"][0]
            found = {f"{axis}_mm": 1e3 * value for axis, value in zip(
                "xyz", pose["instrument"]["translation_m"], strict=True)}
    if code:
        raise SystemExit(code)
    return found | {"wall_s": time.perf_counter() - begin, "peak_GiB": resource.getrusage(
        resource.RUSAGE_SELF).ru_maxrss / 2**20}


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
    from halbach_fe.measurement.observation_operator import observe
    from halbach_fe.measurement.positions import points_from
    from halbach_fe.response.response_matrix import response_matrix
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
    "make-waiting": make_waiting, "command": command,
    "diagnose-map": diagnose_map, "solve": solve, "response": response}


if __name__ == "__main__":
    print(json.dumps(TASKS[sys.argv[1]](*map(Path, sys.argv[2:]))))  # noqa: T201
