"""All keys of a magnet with all commands: what `solve` knows of a magnet, every command knows."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.core.errors import EXIT_CODES
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.geometry.mounting import as_meant, mountings
from halbach_fe.geometry.symmetry import rotation_about_z
from halbach_fe.measurement.block_table import BlockTable, read_blocks, write_blocks
from halbach_fe.measurement.field_map import field_map, points_of, read_map, write_map
from halbach_fe.study.free_blocks_file import write_free_blocks
from halbach_fe.study.reader import read_study
from tests.conftest import changed

BASE: dict[str, Any] = {
    "name": "base", "dimension": 3,
    "array": {
        "blocks_per_ring": 4, "rings": 2, "inner_radius_m": 0.05, "outer_radius_m": 0.08,
        "ring_length_m": 0.03, "ring_gap_m": 0.004, "remanence_T": 1.2,
        "block": {"shape": "sector", "angular_gap_deg": 6.0}},
    "mesh": {"block_size_m": 0.03, "growth": 3.0, "cells_per_side": 1},
    "observation": {
        "quantity": "flux_density", "components": ["x", "y"],
        "positions": {"kind": "circles", "radius_m": 0.03, "angles": 8}},
    "noise": {"regions": [{"name": "bore", "sigma_T": 1e-4}]},
    "prior": {"mounting_sd_deg": 0.05},
    "plan": {"points": 3},
    "demagnetization": {
        "intrinsic_coercivity_A_per_m": 1e6, "remanence_coefficient_per_K": -1.2e-3,
        "coercivity_coefficient_per_K": -6e-3, "temperature_C": 60.0},
}
"""A dipole of two rings, eight blocks in vacuum, whose field has a closed form."""

FLAT = changed(BASE, name="flat", dimension=2, array__rings=1, array__blocks_per_ring=8,
               array__block__angular_gap_deg=3.0)


def with_exception(document=BASE, **exception):
    """The study with an exception of its second block."""
    return changed(document, array__exceptions=[{"ring": 1, "slot": 2, **exception}])


def without(document, *keys):
    """The study without some keys of its array."""
    return changed(document, array={key: value for key, value in document["array"].items()
                                    if key not in keys})


def rings(document, *own):
    """The study with rings of their own."""
    return changed(without(document, "rings"), array__ring=list(own))


def cubes(count=6, **columns):
    """Columns of free cuboids on a circle, a dipole."""
    turn = 2 * np.pi * np.arange(count) / count
    return {"name": [f"cube-{number}" for number in range(count)], "shape": ["cuboid"] * count,
            "x_m": (0.065 * np.cos(turn)).tolist(), "y_m": (0.065 * np.sin(turn)).tolist(),
            "z_m": [0.0] * count, "rotation_z_deg": np.degrees(2 * turn).tolist(),
            "remanence_T": [1.2] * count,
            **{f"size_{axis}_m": [0.02] * count for axis in "xyz"}, **columns}


def free(document=BASE, **columns):
    """The study with free blocks in place of its rings."""
    found = changed(document, array={"free_blocks": cubes(**columns)})
    return changed(found, mesh={"block_size_m": 0.02, "cells_per_side": 1})


CLOSED = changed(BASE, array__block={"shape": "sector"}, array__rings=1,
                 array__recoil_permeability=1.05)
"""Sectors that touch, as azimuthal modes need them."""

TUBE = {"kind": "tube", "inner_radius_m": 0.09, "outer_radius_m": 0.1, "length_m": 0.04}
PRISM = {"kind": "prism", "outline_m": [[0.09, -0.02], [0.1, -0.02], [0.1, 0.02], [0.09, 0.02]],
         "copies": 2}
MISSING = {"magnetization_factor": 0.0}

STUDIES: dict[str, dict[str, Any]] = {
    "base": BASE,
    "remanence": with_exception(remanence_T=1.0),
    "angle": with_exception(magnetization_angle_deg=40.0),
    "mounted-from": changed(BASE, array__exceptions=[
        {"ring": 1, "slot": 2, "mounted_from": [2, 3]},
        {"ring": 2, "slot": 3, "mounted_from": [1, 2]}]),
    "missing": with_exception(**MISSING),
    "missing-slot": changed(BASE, array__exceptions=[{"slot": 2, **MISSING}]),
    "upside-down": with_exception(magnetization_factor=-1.0),
    "gradient": with_exception(magnetization_gradient=0.1),
    "corner-loss": with_exception(inner_corner_loss=0.3),
    "displaced": with_exception(displacement_m=[1e-3, 0.0, 5e-4]),
    "rotated": with_exception(rotation_deg=[0.5, 0.5, 1.0]),
    "shifted": with_exception(shift_m=[0.0, 5e-4, 5e-4]),
    "twisted": changed(BASE, array__exceptions=[{"ring": 2, "twist_deg": 2.0}]),
    "permeability": with_exception(recoil_permeability=1.1),
    "permeability-across": changed(BASE, array__recoil_permeability=1.05,
                                   array__recoil_permeability_across=1.15),
    "missing-permeable": with_exception(changed(BASE, array__recoil_permeability=1.05), **MISSING),
    "missing-closed": with_exception(CLOSED, **MISSING),
    "material": changed(without(BASE, "remanence_T"), array__material="N42SH", demagnetization={
        "temperature_C": 60.0}),
    "own-rings": rings(BASE, {"blocks_per_ring": 4}, {"blocks_per_ring": 5, "remanence_T": 1.3}),
    "layers": rings(BASE, {}, {"layer": 2, "blocks_per_ring": 6, "inner_radius_m": 0.085,
                               "outer_radius_m": 0.1}),
    "layers-missing": with_exception(rings(BASE, {}, {
        "layer": 2, "blocks_per_ring": 6, "inner_radius_m": 0.085, "outer_radius_m": 0.1}),
        **MISSING),
    "free": free(),
    "free-turned": free(rotation_x_deg=[8.0 * number for number in range(6)],
                        rotation_z_deg=[50.0 * number for number in range(6)]),
    "free-missing": with_exception(free(), **MISSING),
    "free-and-rings": changed(BASE, array__rings=1, array__free_blocks=cubes(
        x_m=[0.1, -0.1], y_m=[0.0, 0.0], count=2)),
    "free-places": free(ring=[1, 1, 1, 2, 2, 2], slot=[1, 2, 4, 3, 4, 1]),
    "free-shapes": changed(BASE, array={"free_blocks": {
        "name": ["rod", "bar", "pie"], "shape": ["cylinder", "polygon", "sector"],
        "x_m": [0.06, -0.06, 0.0], "y_m": [0.0, 0.0, 0.0], "z_m": [0.0, 0.0, 0.0],
        "rotation_z_deg": [0.0, 0.0, 90.0], "size_z_m": [0.02, 0.02, 0.02],
        "radius_m": [0.01, 0.01, None], "sides": [None, 5, None],
        "inner_radius_m": [None, None, 0.05], "outer_radius_m": [None, None, 0.07],
        "angle_deg": [None, None, 30.0], "remanence_x_T": [1.0, 1.0, 0.0],
        "remanence_y_T": [0.0, 0.0, 1.0], "remanence_z_T": [0.0, 0.0, 0.5]}}, mesh={
            "block_size_m": 0.02}),
    "free-permeable": free(recoil_permeability=[1.05] * 6),
    "iron-ring": changed(CLOSED, array__recoil_permeability=1.0, iron_ring={
        "inner_radius_m": 0.09, "outer_radius_m": 0.1, "relative_permeability": 100.0}),
    "iron-tube": changed(BASE, iron={"bodies": [TUBE], "relative_permeability": 100.0}),
    "iron-prisms": changed(BASE, array__rings=1, iron={
        "bodies": [PRISM], "relative_permeability": 100.0}),
    "iron-curve": changed(BASE, array__rings=1, iron={"bodies": [TUBE], "curve": {
        "kind": "froehlich_kennelly", "initial_relative_permeability": 200.0,
        "saturation_polarization_T": 2.0}}),
    "flat": FLAT,
    "flat-missing": with_exception(FLAT, **MISSING),
    "flat-displaced": with_exception(FLAT, displacement_m=[1e-3, 0.0, 0.0]),
    "flat-layers": rings(FLAT, {}, {"blocks_per_ring": 6, "inner_radius_m": 0.085,
                                    "outer_radius_m": 0.1, "recoil_permeability": 1.05}),
    "flat-free": changed(free(FLAT), array__free_blocks=cubes(
        recoil_permeability=[1.05] * 6)),
    "flat-prisms": changed(FLAT, iron={"bodies": [PRISM], "relative_permeability": 100.0}),
}
"""Studies by the keys that they add to `BASE`."""

USUAL = ["--json"]
TARGET = ["--orders", "2..4", "--reference-radius-m", "0.03"]
COMMANDS: dict[str, list[str]] = {
    "solve": [],
    "solve-dry": ["--dry-run"],
    "verify-dry": ["--dry-run"],
    "verify": [],
    "infer": ["--measurements", "{map}"],
    "infer-dry": ["--measurements", "{map}", "--dry-run"],
    "infer-blocks": ["--measurements", "{map}", "--blocks", "{blocks}"],
    "diagnose": ["--measurements", "{map}", "--effects",
                 "offset_x,block_missing,block_displaced,blocks_swapped"],
    "multipoles": [*TARGET, "--at-z-m", "0"],
    "plan": [],
    "prior": ["{blocks}"],
    "tolerance": [*TARGET, "--draws", "100"],
    "sort": ["{blocks}", *TARGET],
    "shim": ["--measurements", "{map}", *TARGET, "--swaps", "1", "--turns", "1"],
    "demagnetization": ["--across", "1"],
    "export": ["--format", "blocks"],
    "simulate-measurement": [],
}
"""Options of every command."""

REFUSED: dict[tuple[str, str], str] = {}
"""What a command refuses, with words of its sentence, by study and command."""


@dataclass
class Case:
    """A study on disk, with a map and a table of blocks of its own magnet."""

    name: str
    folder: Path
    study: Path
    magnet: Magnet
    map: Path
    blocks: Path


@pytest.fixture(scope="module")
def case(tmp_path_factory, getdp):
    """Make a case, once."""
    made: dict[str, Case] = {}

    def of(name):
        if name not in made:
            made[name] = _made(name, tmp_path_factory.mktemp(name))
        return made[name]

    return of


def _made(name, folder, document=None):
    study = folder / "study.toml"
    study.write_text(tomlkit.dumps(_with_file(document or STUDIES[name], folder)))
    magnet = build_magnet(read_study(study))
    assert main(["solve", str(study), "-o", str(folder / "solved"), "--json", "--no-cache"]) == 0
    data = read_map(folder / "solved" / "field_map.h5")
    write_map(field_map(points_of(data), data["B_T"].values), folder / "map.csv")
    write_blocks(measured_blocks(magnet), folder / "blocks.csv")
    return Case(name, folder, study, magnet, folder / "map.csv", folder / "blocks.csv")


def _with_file(document, folder):
    """The document with its free blocks in a file: TOML has no empty cells."""
    document = copy.deepcopy(document)
    columns = document["array"].get("free_blocks")
    if columns is not None:
        write_free_blocks(columns, folder / "free.csv")
        document["array"]["free_blocks"] = {"file": "free.csv"}
    return document


def measured_blocks(magnet: Magnet) -> BlockTable:
    """Every block that is there, at the place that it was made for, 1 % too strong."""
    meant = as_meant(magnet)
    there = sorted({number for number, matrix in mountings(magnet) if matrix.any()})
    blocks = [meant.blocks[number] for number in there]
    length = magnet.array.ring_length_m or 0.02
    sizes = np.array([block.area * (length if magnet.dimension == 2 else block.z_max - block.z_min)
                      for block in blocks])
    moments = np.array([
        1.01 * size * rotation_about_z(-np.radians(block.angle_deg)) @ block.magnetization
        for block, size in zip(blocks, sizes, strict=True)])
    return BlockTable(
        tuple(f"no-{number}" for number in there), tuple(str(block.slot) for block in blocks),
        np.array([block.ring for block in blocks]), np.array([block.slot for block in blocks]),
        moments, np.linalg.norm(moments, axis=1) / 1000, sizes, np.full(len(blocks), np.nan))


def run(case: Case, command: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, Path]:
    """Run a command; return its exit code, what it printed or said, and its folder."""
    folder = case.folder / command
    verb = command.removesuffix("-dry").removesuffix("-blocks")
    options = [option.format(map=case.map, blocks=case.blocks) for option in COMMANDS[command]]
    if case.magnet.dimension == 2 and "--at-z-m" in options:
        options = options[:options.index("--at-z-m")]
    output = folder / "blocks.csv" if verb == "export" else folder
    folder.mkdir(exist_ok=True)
    if verb == "solve" and "--dry-run" not in options:
        output = case.folder / "solved"
    extra = [] if verb == "export" else ["--json"]
    if verb not in ("export", "prior", "simulate-measurement"):
        extra.append("--no-cache")
    capsys.readouterr()
    code = main([verb, str(case.study), *options, "-o", str(output), *extra])
    shown = capsys.readouterr()
    return code, shown.out if code == 0 else shown.err, folder


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("name", STUDIES)
def test_all(case, capsys, name, command):
    here = case(name)
    code, said, folder = run(here, command, capsys)
    refused = REFUSED.get((name, command))
    if refused is not None:
        assert code in EXIT_CODES
        assert code > 1, said
        assert refused in said
        assert "Traceback" not in said
        return
    assert code == 0, said
    shown = {} if command == "export" else json.loads(said, parse_constant=_no_number)
    for path in folder.rglob("*.json"):
        json.loads(path.read_text(), parse_constant=_no_number)
    for path in folder.glob("*.html"):
        assert not re.search(r"(?<![\w./+])nan(?![\w/])", _words(path.read_text())), path


def _no_number(name):
    raise AssertionError(f"{name} in JSON")


def _words(page):
    """A page without its embedded files and scripts."""
    return re.sub(r"data:[^\"']*|<script.*?</script>|<svg.*?</svg>", "", page, flags=re.S)
