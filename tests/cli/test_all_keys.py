"""All keys of a magnet with all commands: what `solve` knows of a magnet, every command knows."""

from __future__ import annotations

import copy
import csv
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.core.errors import EXIT_CODES
from halbach_fe.geo.iron_mesh import Sizes
from halbach_fe.geometry.blocks import rotation_about_z
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.geometry.remounting import as_meant, mountings
from halbach_fe.inference.block_prior import types_of
from halbach_fe.measurement.block_table import BlockTable, read_blocks, write_blocks
from halbach_fe.measurement.field_map import field_map, points_of, read_map, write_map
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.getdp_cache import FOLDER_VARIABLE, LIMIT_VARIABLE
from halbach_fe.solver.iron_modes import Resolution
from halbach_fe.study.array_keys import Array
from halbach_fe.study.free_blocks import read_free_blocks, write_free_blocks
from halbach_fe.study.reader import read_study
from tests.conftest import changed
from tests.support.pages import answer_of

BASE: dict[str, Any] = {
    "name": "base", "dimension": 3,
    "array": {
        "blocks_per_ring": 4, "rings": 2, "inner_radius_m": 0.05, "outer_radius_m": 0.08,
        "ring_length_m": 0.03, "ring_gap_m": 0.004, "remanence_T": 1.2,
        "block": {"shape": "sector", "angular_gap_deg": 6.0}},
    "mesh": {"block_size_m": 0.02, "cells_per_side": 1},
    "observation": {
        "quantity": "flux_density", "components": ["x", "y"],
        "positions": {"kind": "circles", "radius_m": 0.03, "angles": 16}},
    "noise": {"regions": [{"name": "bore", "sigma_T": 1e-4}]},
    "prior": {"mounting_sd_deg": 0.05, "direction_sd_deg": 0.3},
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
    return changed(found, mesh__block_size_m=0.015)


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
    "tilted": changed(BASE, array__exceptions=[{"ring": 2, "tilt_deg": [2.0, 0.0]}]),
    "permeability": with_exception(recoil_permeability=1.1),
    "permeability-across": changed(BASE, array__recoil_permeability=1.05,
                                   array__recoil_permeability_across=1.15),
    "missing-permeable": with_exception(changed(BASE, array__recoil_permeability=1.05), **MISSING),
    "missing-closed": with_exception(CLOSED, **MISSING),
    "material": changed(without(BASE, "remanence_T"), array__material="N42SH", demagnetization={
        "temperature_C": 60.0}),
    "losses": changed(BASE, array__recoil_permeability=1.05, demagnetization__irreversible=True,
                      demagnetization__intrinsic_coercivity_A_per_m=6e5),
    "varying": changed(BASE, prior__variation_sd=0.05, prior__variation_length_m=0.02),
    "own-rings": rings(BASE, {"blocks_per_ring": 4}, {"blocks_per_ring": 5, "remanence_T": 1.3}),
    "layers": rings(BASE, {}, {"layer": 2, "blocks_per_ring": 6, "inner_radius_m": 0.085,
                               "outer_radius_m": 0.1}),
    "layers-missing": with_exception(rings(BASE, {}, {
        "layer": 2, "blocks_per_ring": 6, "inner_radius_m": 0.085, "outer_radius_m": 0.1}),
        **MISSING),
    "free": free(),
    "free-turned": free(rotation_x_deg=[8.0 * number for number in range(6)],
                        rotation_z_deg=[50.0 * number for number in range(6)]),
    "free-types": free(type=["cube"] * 6),
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
    "iron-ring": changed(
        CLOSED, mesh__meridian_size_m=0.025, mesh__growth=2.0, array__recoil_permeability=1.0,
        iron_ring={"inner_radius_m": 0.09, "outer_radius_m": 0.1, "relative_permeability": 100.0}),
    "iron-tube": changed(BASE, iron={
        "bodies": [TUBE], "relative_permeability": 100.0}),
    "iron-prisms": changed(BASE, array__rings=1, mesh__growth=4.0, mesh__block_size_m=0.03, iron={
        "bodies": [PRISM], "relative_permeability": 100.0}),
    "iron-curve": changed(BASE, array__rings=1, iron={
        "bodies": [TUBE], "curve": {
        "kind": "froehlich_kennelly", "initial_relative_permeability": 200.0,
        "saturation_polarization_T": 2.0}}),
    "iron-curve-free": changed(free(), iron={
        "bodies": [TUBE], "curve": {
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

TARGET = ["--orders", "2..4", "--reference-radius-m", "0.03"]
COMMANDS: dict[str, tuple[str, list[str]]] = {
    "solve-dry": ("dry", ["--dry-run"]),
    "verify-dry": ("dry", ["--dry-run"]),
    "verify": ("verify", []),
    "infer": ("infer", ["--measurements", "{map}"]),
    "infer-dry": ("dry", ["--measurements", "{map}", "--dry-run"]),
    "infer-blocks": ("infer", ["--measurements", "{map}", "--blocks", "{blocks}"]),
    "shim": ("shim", ["--measurements", "{map}", *TARGET, "--swaps", "1", "--turns", "1",
                      "--replace", "1"]),
    "diagnose": ("diagnose", ["--measurements", "{map}", "--effects",
                              "block_missing,block_displaced,blocks_swapped"]),
    "multipoles": ("multipoles", TARGET),
    "tolerance": ("tolerance", [*TARGET, "--draws", "100"]),
    "sort": ("sort", ["{blocks}", *TARGET]),
    "plan": ("plan", []),
    "prior": ("prior", ["{blocks}"]),
    "demagnetization": ("demagnetization", ["--across", "2"]),
    "export": ("export", ["--format", "blocks"]),
    # coarse, as only keys are tried here
    "simulate-measurement": ("simulated", ["--element-size", "0.02", "--order", "2"]),
}
"""Folder and options of every command but `solve`, which makes the map for the others."""

WHOLE = ("missing", "displaced", "missing-permeable", "layers-missing", "free-turned",
         "free-missing", "flat-missing", "flat-layers", "losses", "varying")
"""Studies for every command, which among them have every kind of magnet."""

OF_TYPES = ("shim", "sort", "prior")
"""Commands to which the types of free blocks matter, besides those of `BRIEF`."""

BRIEF = ("infer-blocks", "diagnose", "multipoles", "demagnetization", "export")
"""Commands for every study: each has a way of its own from the keys to a field."""

SLOW = {"iron-ring": "infer-blocks", "iron-curve": "infer-dry", "iron-curve-free": "infer-blocks",
        "iron-prisms": "infer-blocks"}
"""Studies whose fields take seconds, and the single command that they go through beside `solve`. A
diagnosis, of many fields, takes minutes with iron of any kind."""

# a simulated measurement of layers in a plane takes a minute of fine finite elements, for keys that
# "layers-missing" tries in space
PAIRS = [(name, command) for name in STUDIES for command in COMMANDS
         if (name in WHOLE and (name, command) != ("flat-layers", "simulate-measurement"))
         or command == SLOW.get(name)
         or (name == "free-types" and command in OF_TYPES)
         or (command in BRIEF and name not in SLOW
             and not (command == "diagnose" and name.startswith("iron")))]
DRAWN = [pytest.param(*pair, marks=pytest.mark.every_figure) if pair[0] in WHOLE else pair
         for pair in PAIRS]

UNLIKE = "Where rings differ, list the blocks as `array.free_blocks`"
REFUSED: dict[tuple[str, str], str] = {
    ("layers-missing", "sort"): UNLIKE, ("flat-layers", "sort"): UNLIKE,
    ("varying", "shim"): "0 for shimming",
    ("losses", "simulate-measurement"): "know no irreversible losses",
}
"""What a command refuses, with words of its sentence, by study and command."""


@dataclass(frozen=True)
class Case:
    """A study on disk, with a map and a table of blocks of its own magnet."""

    name: str
    folder: Path
    study: Path
    magnet: Magnet
    map: Path
    blocks: Path

    @property
    def flux_density(self):
        """B (n, 3) in T at the study's positions, as solved."""
        return read_map(self.map)["B_T"].values

    @property
    def present(self):
        """The blocks that are not missing."""
        return [block for block in self.magnet.blocks if block.remanence]


@pytest.fixture(scope="module", autouse=True)
def quick(getdp, tmp_path_factory):
    """Find GetDP once.

    Elements of iron are three times as large as usual, twice if it is coaxial: only keys are tried
    here. Commands share their runs of GetDP by a cache: one that passes over a key asks for another
    run than `solve`.
    """
    fine, usual = Sizes.of, Resolution()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(FOLDER_VARIABLE, str(tmp_path_factory.mktemp("cache")))
        patch.setenv(LIMIT_VARIABLE, "1")
        patch.setattr("halbach_fe.solver.getdp.find_getdp", lambda path=None: getdp)
        patch.setattr(Sizes, "of", lambda mesh, coarseness=1.0: fine(mesh, 3.0 * coarseness))
        patch.setattr(Resolution.__init__, "__defaults__", (
            2 * usual.edge, usual.growth, 2 * usual.largest, None, usual.boundary))
        yield


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Make a case, once."""
    made: dict[str, Case] = {}

    def of(name):
        if name not in made:
            made[name] = made_case(name, STUDIES[name], tmp_path_factory.mktemp(name))
        return made[name]

    return of


def made_case(name, document, folder):
    """Write a study, solve it, and write the map and the table of its blocks."""
    study = folder / "study.toml"
    study.write_text(tomlkit.dumps(_with_file(document, folder)))
    assert main(["solve", str(study), "-o", str(folder / "solved"), "--json"]) == 0
    data = read_map(folder / "solved" / "field_map.h5")
    write_map(field_map(points_of(data), data["B_T"].values), folder / "map.csv")
    magnet = build_magnet(read_study(study))
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


STRONGER = 1.01
"""Strength of the measured blocks relative to the nominal ones."""


def measured_blocks(magnet: Magnet) -> BlockTable:
    """Every block that is there, at the place that it was made for, 1 % too strong."""
    meant = as_meant(magnet)
    there = sorted({number for number, matrix in mountings(magnet) if matrix.any()})
    blocks = [meant.blocks[number] for number in there]
    length = magnet.array.ring_length_m or 0.02
    sizes = np.array([block.area * (length if magnet.dimension == 2 else block.z_max - block.z_min)
                      for block in blocks])
    moments = np.array([
        STRONGER * size * rotation_about_z(-np.radians(block.angle_deg)) @ block.magnetization
        for block, size in zip(blocks, sizes, strict=True)])
    label = {number: label for label, own in types_of(magnet).items() for number in own}
    return BlockTable(
        tuple(f"no-{number}" for number in there), tuple(label[number] for number in there),
        np.array([block.ring for block in blocks]), np.array([block.slot for block in blocks]),
        moments, np.linalg.norm(moments, axis=1) / 1000, sizes, np.full(len(blocks), np.nan))


def run(case: Case, command: str, capsys: pytest.CaptureFixture[str]) -> tuple[int, str, Path]:
    """Run a command; return its exit code, what it printed or said, and its folder."""
    name, options = COMMANDS[command]
    folder = case.folder / name
    verb = command.removesuffix("-dry").removesuffix("-blocks")
    options = [option.format(map=case.map, blocks=case.blocks) for option in options]
    folder.mkdir(exist_ok=True)
    output = folder / "blocks.csv" if verb == "export" else folder
    more = [] if verb == "export" else ["--json"]
    capsys.readouterr()
    code = main([verb, str(case.study), *options, "-o", str(output), *more])
    shown = capsys.readouterr()
    return code, shown.out if code == 0 else shown.err, folder


@pytest.mark.parametrize(("name", "command"), DRAWN)
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
    for path in folder.glob("*.json"):
        json.loads(path.read_text(), parse_constant=_no_number)
    for path in folder.glob("*.html"):
        assert not re.search(r"(?<![\w./+])nan(?![\w/])", _words(path.read_text())), path
        answer_of(path)
    if command in CHECKS:
        CHECKS[command](here, folder, shown)


def _no_number(name):
    raise AssertionError(f"{name} in JSON")


def _words(page):
    """A page without its embedded files, scripts and drawings."""
    for start, end in (("<script", "</script>"), ("<svg", "</svg>")):
        first, *others = page.split(start)
        page = first + "".join(part.partition(end)[2] for part in others)
    return re.sub(r"data:[^\"']*", "", page)


def _predicted(case, folder):
    """Solved readings, the prior's prediction of them, and the error bars of the solver, in T."""
    rows = np.genfromtxt(folder / "prediction.csv", delimiter=",", names=True, dtype=None,
                         encoding=None)
    np.testing.assert_allclose(rows["measured_T"], case.flux_density[:, :2].ravel(), atol=1e-15)
    return rows["measured_T"], rows["prior_mean_T"], rows["solver_error_T"]


def _infers_from_nominal(case, folder, shown):
    """The nominal field of the inference is that of `solve`."""
    solved, prior, error = _predicted(case, folder)
    assert (np.abs(prior - solved) <= 1.5 * error + 1e-7 * np.abs(solved).max()).all()
    contraction = shown["contraction_by_block"]
    assert [value is None for value in contraction] == [
        not block.remanence for block in case.magnet.blocks]


def _infers_from_blocks(case, folder, shown):
    """Blocks that are 1 % stronger make a field that is 1 % stronger.

    With permeability the moment of a block that stands alone is not its magnetization times its
    volume, but smaller by the demagnetizing factor times 5 to 10 %.
    """
    solved, prior, error = _predicted(case, folder)
    bare = case.magnet.is_vacuum or all(
        block.isotropic and block.recoil_permeability == 1 for block in case.magnet.blocks)
    if bare and not case.magnet.is_nonlinear:
        assert (np.abs(prior - STRONGER * solved)
                <= 1.5 * error + 1e-7 * np.abs(solved).max()).all()
    assert shown["measured_blocks"] == len(np.loadtxt(
        case.blocks, delimiter=",", skiprows=1, dtype=str, comments="#", ndmin=2))


def _finds_nothing(case, folder, shown):
    """The map of the study's own magnet lacks no effect.

    On the coarse meshes of this file the solver's error is larger than the noise, which the verdict
    may say.
    """
    assert shown["effects"] == []
    assert shown["verdict"] in ("nothing", "numerical")


def _same_main(case, folder, shown):
    """The main multipole of a cross-section is that of the solved circle.

    16 angles add the order 15, which falls to (3/5)^14 = 8e-4 of what it is at the blocks.
    """
    if case.magnet.dimension == 2:
        angle = 2 * np.pi * np.arange(16) / 16
        radial = case.flux_density[:, 0] * np.cos(angle) + case.flux_density[:, 1] * np.sin(angle)
        main = abs(2 * np.mean(radial * np.exp(1j * angle)))
        tables = shown["tables"][0]["prior"] if "tables" in shown else shown["closed_form"]
        assert tables["main_T"] == pytest.approx(main, rel=5e-3)


def _sorts_present_blocks(case, folder, shown):
    """Every slot gets a block, but not that of a missing one."""
    table = read_blocks(folder / "blocks.sorted.csv")
    placed = [place for place in table.places if place[0]]
    assert sorted(placed) == sorted((block.ring, block.slot) for block in case.present)


def _moves_present_blocks(case, folder, shown):
    """No block comes from the place of a missing one, which a block may fill."""
    missing = {(block.ring, block.slot) for block in case.magnet.blocks if not block.remanence}
    taken = {tuple(block["from"]) for move in shown["moves"] for block in move["blocks"]
             if isinstance(block["from"], list)}
    assert not missing & taken


def _maps_present_blocks(case, folder, shown):
    """The map of the demagnetization has a row for every block that is there."""
    with (folder / "demagnetization.csv").open() as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    assert [row["block"] for row in rows] == [block.name for block in case.present]


def _exports_the_same_magnet(case, folder, shown):
    """A study of the exported blocks has the same field of the blocks in vacuum."""
    points = points_of(read_map(case.map))
    study = case.magnet.study
    again = build_magnet(study.with_(array=Array(free_blocks=read_free_blocks(
        folder / "blocks.csv"))))
    expected = field_of(case.magnet.blocks, points)
    np.testing.assert_allclose(field_of(again.blocks, points), expected,
                               atol=1e-9 * np.abs(expected).max())


CHECKS = {
    "infer": _infers_from_nominal, "infer-blocks": _infers_from_blocks, "diagnose": _finds_nothing,
    "multipoles": _same_main, "tolerance": _same_main, "sort": _sorts_present_blocks,
    "shim": _moves_present_blocks, "demagnetization": _maps_present_blocks,
    "export": _exports_the_same_magnet,
}


@pytest.mark.parametrize("name", [name for name in STUDIES
                                  if name not in ("base", "flat", "varying")])
def test_every_key_changes_the_field(case, name):
    """By more than the closed-form field's rounding: no key is passed over by `solve`."""
    base = case("flat" if name.startswith("flat") else "base").flux_density
    change = np.abs(case(name).flux_density - base)[:, :2].max()
    assert change > 1e-6 * np.abs(base).max()


def test_the_checks_notice_another_magnet(case, capsys):
    """The map of a magnet without exceptions is not that of a magnet with one."""
    other = case("flat-missing")
    wrong = replace(other, map=case("flat").map)
    for command in ("infer", "diagnose", "multipoles"):
        code, said, folder = run(wrong, command, capsys)
        assert code == 0
        with pytest.raises(AssertionError):
            CHECKS[command](wrong, folder, json.loads(said))
    for check in (_exports_the_same_magnet, _maps_present_blocks):
        command = next(name for name, own in CHECKS.items() if own is check)
        _, _, folder = run(other, command, capsys)
        with pytest.raises(AssertionError):
            check(case("flat"), folder, {})
