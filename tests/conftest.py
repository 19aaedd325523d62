"""Fixtures: GetDP, and small studies that solve in about a second."""

from __future__ import annotations

import copy
import functools
import gc
import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from matplotlib.figure import Figure

from halbach_fe.report import page
from halbach_fe.report.page import png_of, save
from halbach_fe.solver.getdp import GetDP, find_getdp
from halbach_fe.solver.getdp_cache import LIMIT_VARIABLE
from halbach_fe.solver.session import Session
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study

ROOT = Path(__file__).parent.parent

# On a busy machine time says nothing; and the same examples each time, as a test that fails now and
# then is of no use to whoever changed something else. `make fuzz` tries others.
settings.register_profile("patient", deadline=None, derandomize=True)
settings.load_profile("patient")

os.environ[LIMIT_VARIABLE] = "0"  # tests compute; those of the cache name one of their own

# A second thread of NGSolve spins while it waits: these small problems become no faster and take
# twice the processor time, and `make test` has a worker on each core. ngsolve reads the variable
# when it is imported.
os.environ.setdefault("NGS_NUM_THREADS", "1")

# A dipole of FASER's cross-section; sizes coarse enough for tests.
DIPOLE: dict[str, Any] = {
    "name": "dipole",
    "dimension": 2,
    "array": {
        "blocks_per_ring": 16, "rings": 1, "inner_radius_m": 0.104, "outer_radius_m": 0.1865,
        "first_block_angle_deg": 90.0, "first_magnetization_angle_deg": 180.0,
        "remanence_T": 1.06, "recoil_permeability": 1.05, "block": {"shape": "sector"},
    },
    "mesh": {"block_size_m": 0.02},
    "observation": {
        "quantity": "flux_density",
        "positions": {"kind": "circles", "radius_m": 0.075, "angles": 24},
    },
}

StudyMaker = Callable[..., Study]

LONGEST = [
    "cli/test_all_keys.py", "docs/test_docs.py", "solver/test_iron_bodies.py",
    "report/test_view.py", "cli/test_cli.py", "diagnosis/test_iron_faults.py",
    "inference/test_doubted_terms.py", "inference/test_infer.py", "design/test_demagnetization.py",
    "diagnosis/test_diagnose.py", "measurement/test_map_join.py", "synthetic/test_reaction.py",
    "measurement/test_map_check.py", "response/test_nonlinear.py",
    "diagnosis/test_sealed_cases.py", "report/test_answers.py",
    "diagnosis/test_unlisted_causes.py", "synthetic/test_fields.py",
    "solver/test_axisymmetric_iron.py", "solver/test_azimuthal_modes.py", "solver/test_oracles.py",
    "design/test_forces.py", "cli/test_killed.py", "design/test_shim_tray.py",
    "design/test_homogeneity_objective.py", "solver/moments/test_solve.py",
    "synthetic/test_hidden_effects.py", "diagnosis/test_gross_errors.py",
    "diagnosis/test_assembly.py", "diagnosis/test_screening.py", "geometry/test_symmetry.py",
    "response/test_homogeneity.py", "solver/test_dask_cluster.py",
    "inference/test_line_registration.py", "response/test_field_on_lines.py",
]
"""Files that take half a minute or more of processor time, the longest first."""

QUICK = {
    "cli": "completion dry_run explain export formats new",
    "core": "hdf5 installation progress result_folder threads",
    "design": "cad tolerance",
    "diagnosis": "discriminating_measurements marginal_evidence smooth_discrepancy",
    "docs": "describe_your_magnet figures",
    "geometry": (
        "block_export blocks convex_pieces equal_blocks free_blocks iron neighbours "
        "surface"),
    "inference": "held_out_map posterior_files repeated_readings",
    "measurement": (
        "block_table calibration export_map field_map import_map observation_operator one_reader "
        "probe_law total_field"),
    "report": "figures geometry inference_answer no_bore point_maps study_pages",
    "response": "block_variation deviation_field",
    "solver/moments": "cells irreversible tree",
    "solver": "coil_field exact_block_field getdp prism_kernel runs",
    "stats": "d_optimal linear_gaussian noise small_samples stated_probabilities",
    "study": "array free_blocks free_blocks_file grades halbach_order materials sentences study",
    "synthetic": "placed_blocks stated_instrument",
    "": "structure",
}
"""Files of `make test-quick`, by room: of every room but `fuzz` those that take a few seconds."""
QUICK_FILES = {ROOT / "tests" / room / f"test_{name}.py"
               for room, names in QUICK.items() for name in names.split()}


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out the files that are not asked for: to import all takes as long as some of them."""
    left_out = collection_path.suffix == ".py" and collection_path not in QUICK_FILES
    return True if config.option.markexpr == "quick" and left_out else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files: one that a worker begins last keeps the others waiting."""
    place = {ROOT / "tests" / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(LONGEST)))
    for item in items:
        if item.path in QUICK_FILES:
            item.add_marker("quick")


def pytest_collection_finish() -> None:
    """Leave what was imported and collected out of garbage collections, which took 7 % of the time,
    and collect after ten thousand new objects in place of 700.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)


def changed(document: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A copy with some keys changed; ``array__rings=2`` goes one level down."""
    result = copy.deepcopy(document)
    for key, value in changes.items():
        *path, last = key.split("__")
        table = result
        for part in path:
            table = table.setdefault(part, {})
        table[last] = value
    return result


def processor_time(function: Callable[..., object], *arguments: object) -> float:
    """Return the processor time of a call, in s, in which Python does not collect garbage.

    That takes up to a second late in the suite, and has nothing to do with the call. Compare the
    times of two calls; never assert one.
    """
    gc.disable()
    try:
        began = time.process_time()
        function(*arguments)
        return time.process_time() - began
    finally:
        gc.enable()


def module_of(name: str, script: Path) -> ModuleType:
    """A script as a module, as if it were run in its folder."""
    spec = importlib.util.spec_from_file_location(name, script)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # for its dataclasses
    sys.path.insert(0, str(script.parent))
    spec.loader.exec_module(module)
    sys.path.remove(str(script.parent))
    return module


@pytest.fixture(scope="session")
def drawn_figures() -> dict[str, Figure]:
    """The figures that were drawn, by the names of their files."""
    return {}


@pytest.fixture(autouse=True)
def similar_figures_once(request, monkeypatch, drawn_figures):
    """Draw figures of the same name once, but in the tests of pages.

    To lay out their texts again and again would take a third of the time of all tests, and to draw
    them a seventh of that of commands. Tests marked with ``every_figure`` draw what is to be
    written, and write the first of its name.
    """
    if request.path.parent.name == "report":
        return
    every = request.node.get_closest_marker("every_figure")

    def once(figures, folder):
        for name, (draw, _) in figures.items():
            if name not in drawn_figures or every:
                drawn_figures.setdefault(name, draw())
        return save({name: (drawn_figures[name], caption)
                     for name, (_, caption) in figures.items()}, folder)

    monkeypatch.setattr(page, "save", once)
    monkeypatch.setattr(page, "png_of", picture_of)


@functools.cache
def picture_of(figure: Figure) -> bytes:
    """The content of a PNG file."""
    return png_of(figure)


@pytest.fixture(scope="session")
def dipole() -> StudyMaker:
    """Make the 2D dipole study, with changes."""
    return lambda **changes: parse_study(changed(DIPOLE, **changes))


@pytest.fixture(scope="session")
def short_dipole() -> StudyMaker:
    """Make a 3D dipole of two rings, with changes."""
    base = changed(DIPOLE, dimension=3, array__rings=2, array__ring_length_m=0.08,
                   mesh={"block_size_m": 0.03, "layers_per_ring": 2, "growth": 2.0})
    return lambda **changes: parse_study(changed(base, **changes))


@pytest.fixture(scope="session")
def getdp() -> GetDP:
    """GetDP is a requirement of the tests, not an option."""
    return find_getdp()


@pytest.fixture
def session(getdp: GetDP, tmp_path: Path) -> Session:
    return Session(getdp, tmp_path / "work", jobs=2)


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(20231)


@pytest.fixture
def small_disk(tmp_path, request):
    """A file system of a few kilobytes, where the test may mount one."""
    path = tmp_path / "disk"
    path.mkdir()
    options = f"size={request.param}k,mode=755"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(path)],
                             capture_output=True, check=False)
    if mounted.returncode:
        pytest.skip("mounting a small file system needs root")
    yield path
    for _ in range(60):  # on a busy machine what was killed may take a while to end
        gc.collect()  # what an exception kept open
        if not subprocess.run(["umount", str(path)], capture_output=True, check=False).returncode:
            return
        time.sleep(0.5)
    # still something holds a file there: the disk goes when that ends
    subprocess.run(["umount", "--lazy", str(path)], check=True)


def circle(radius: float, count: int = 24, z: float = 0.0, start: float = 0.03) -> np.ndarray:
    """Points (count, 3) on a circle; ``start`` in rad keeps them off lines of symmetry."""
    angle = start + 2 * np.pi * np.arange(count) / count
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)])
