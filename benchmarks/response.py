"""The response matrix of the full FASER dipole: error, time and memory."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import magpylib
import ngsolve
import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import common
from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.discretization_error import reading_errors, refined, verify
from halbach_fe.response.response_matrix import Response, response_matrix
from halbach_fe.solver import getdp as runner
from halbach_fe.solver.azimuthal_modes import solve_modes
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.routes import finite_element_part, vacuum_part
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import nominal_prior
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study, read_study
from tests.conftest import changed
from tests.oracles import dipole_of
from tests.oracles import ngsolve_model as oracle
from tests.support.memory import Weighed, own_peak

HERE = Path(__file__).parent
CAMPAIGN = HERE.parent / "studies" / "faser" / "campaign.toml"
COLUMNS_BY_PROCESS = 2
ORACLE_POINTS = 13  # every 13th point of the map is compared with NGSolve


def built(study: Study, points: np.ndarray, session: Session) -> tuple[Response, float]:
    """H from nothing, with permeability and iron, and the seconds it took."""
    observation = observe(study, points, np.ones_like(points, bool))
    started = time.monotonic()
    found = response_matrix(build_magnet(study), observation, session)
    return found, time.monotonic() - started


def errors(study: Study, points: np.ndarray, folder: Path, note: Note) -> None:
    """The full array: by refinement, and against NGSolve's vector potential of high order."""
    session = Session(find_getdp(), folder, jobs=2)
    common.say("error of the full array by refinement")
    found = verify(build_magnet(study), session, common.say)
    note("response.error_pointwise", found.error_pointwise, "of the main field",
         "refinement and farther boundary, extrapolated")
    note("response.error_fourier", found.error_fourier or np.nan, "of the main field",
         "refinement and farther boundary, extrapolated; K = 8")
    common.say("error of the full array against NGSolve")
    dipole = dipole_of(study)
    some = points[::ORACLE_POINTS]
    ours = finite_element_part(build_magnet(study), some, session, columns=False).nominal
    main_field = float(np.abs(vacuum_part(build_magnet(study), some) + ours).max())
    with ngsolve.TaskManager():
        theirs = oracle.vector_potential(dipole, oracle.eighth(dipole, 0.02), 4, some)
    note("response.error_against_ngsolve",
         float(np.linalg.norm(ours - theirs, axis=1).max()) / main_field, "of the main field",
         f"NGSolve, curl-curl of order 4 in 3D, curved; {len(some)} points, fringe included")


def matrix_error(
    study: Study, points: np.ndarray, base: Response, session: Session
) -> float:
    """Largest change of predicted readings by a finer mesh, over 20 draws of magnetizations (1 %,
    1 degree), relative to the main field.
    """
    finer, _ = built(refined(build_magnet(study), 4 / 3).study, points, session)
    draws = nominal_prior(base.nominal, 3, 0.01, 1.0).sample(20, np.random.default_rng(1)).T
    scale = np.abs(base.matrix @ base.nominal).max()
    return float(np.abs(finer.matrix @ draws - base.matrix @ draws).max() / scale)


def process_per_column_seconds(folder: Path) -> float:
    """Seconds of one column by GetDP processes of its own, two at a time, at the same accuracy.

    Runs the problem files that the response left, with a single source.
    """
    seconds = []
    for column in range(COLUMNS_BY_PROCESS):
        started = time.monotonic()
        for run in sorted(folder.glob("getdp-*-mode*")):
            modes = int((run / "case.pro").read_text().split("N_MODES = ")[1].split(";")[0])
            source = 2 + 7 * column
            runner.run(find_getdp(), runner.Job(
                problem="azimuthal_modes.pro", mesh="meridian.msh", resolution="Modes",
                outputs=("gradients.txt",), solutions="solutions.bin", solves=modes,
                numbers={"VACUUM": "vacuum" in run.name, "FIRST_SOURCE": source,
                         "LAST_SOURCE": source, "PRINTED_SOURCE": source}), run)
        seconds.append((time.monotonic() - started) / 2)
    return float(np.mean(seconds))


def magpylib_seconds(study: Study, points: np.ndarray) -> float:
    """Seconds for magpylib to compute the same columns at recoil permeability 1, no iron.

    One ring is measured; the others are the same work.
    """
    started = time.monotonic()
    ring = [block for block in build_magnet(study).blocks if block.ring == 1]
    for block in ring:
        middle = position_angle_deg(study.array, block.slot)
        half = 180 / study.array.blocks_per_ring
        source = magpylib.magnet.CylinderSegment(
            dimension=(study.array.inner_radius_m, study.array.outer_radius_m,
                       block.z_max - block.z_min, middle - half, middle + half),
            position=(0, 0, (block.z_min + block.z_max) / 2))
        for axis in np.eye(3):
            source.polarization = axis
            source.getB(points)
    return (time.monotonic() - started) * study.array.rings


def against_ngsolve(
    study: Study, points: np.ndarray, seconds: float, alone: float, folder: Path, note: Note
) -> None:
    """One column and all of them by NGSolve, scalar potential of order 3 on the whole magnet.

    On this mesh it is less exact than ours, which favours it. One column takes conjugate gradients;
    all of them one factorization.
    """
    dipole = dipole_of(study)
    number = study.array.blocks_per_ring * (study.array.rings // 2 - 1) + 3
    block = build_magnet(study).blocks[number]
    ours = solve_modes(build_magnet(study), points, [number],
                       Session(find_getdp(), folder, jobs=2))[1]
    started = time.monotonic()
    mesh = oracle.whole(dipole, block.slot - 1, block.z_min, block.z_max, 0.04)
    meshing = time.monotonic() - started
    with ngsolve.TaskManager():
        one, many = (oracle.scalar_potential_column(dipole, mesh, 3, (1.0, 0.0, 0.0), points, how)
                     for how in (False, True))
    difference = np.linalg.norm(one.reaction - ours, axis=1)
    note("response.column_difference_to_ngsolve", float(np.sqrt(np.mean(difference**2))),
         "T per T of remanence, rms", f"NGSolve, order 3, {one.unknowns} unknowns")
    total = meshing + one.setup + one.solve
    note("response.time_over_ngsolve_one_column", alone / total, "ratio",
         f"one column each; NGSolve {total:.0f} s by conjugate gradients")
    total = meshing + many.setup + many.solve * 3 * len(build_magnet(study).blocks)
    note("response.time_over_ngsolve", seconds / total, "ratio",
         f"all columns; NGSolve {total:.0f} s, extrapolated from one: factorized once, "
         f"{many.solve:.1f} s each")


def symmetry(study: Study, folder: Path, note: Note) -> None:
    """Two rings of trapezoids on a 3D mesh, every column solved against those by symmetry."""
    document = changed(
        study.model_dump(exclude_none=True), iron_ring=None, array__rings=2,
        solver__route="scalar_potential",
        array__block={"shape": "trapezoid", "side_gap_m": 0.001}, mesh__block_size_m=0.04,
        mesh__bore_size_m=0.05, mesh__growth=2.0, mesh__layers_per_ring=2,
        observation__positions={"kind": "circles", "radius_m": 0.06, "angles": 12,
                                "z_min_m": -0.2, "z_max_m": 0.2, "count": 9})
    short = parse_study(document)
    points = points_from(short.observation.positions)
    session = Session(find_getdp(), folder, jobs=2)
    fields, seconds = [], []
    for used in (True, False):
        started = time.monotonic()
        variant = parse_study(changed(document, solver__symmetry=used))
        parts = finite_element_part(build_magnet(variant), points, session)
        fields.append(sum(parts.block(n, slice(None)) @ (np.array(b.easy_axis) * b.remanence)
                          for n, b in enumerate(build_magnet(short).blocks)))
        seconds.append(time.monotonic() - started)
    note("response.symmetry_speedup", seconds[1] / seconds[0], "ratio",
         f"all {3 * len(build_magnet(short).blocks)} columns of 2 rings on one 3D mesh, one by one")
    observation = observe(short, points, np.ones_like(points, bool))
    stated = reading_errors(build_magnet(short), observation, parts, session).max()
    note("response.symmetry_difference", float(np.abs(fields[0] - fields[1]).max() / stated),
         "of the stated error", "the array's reaction, with and without symmetry")


def run(note: Note) -> None:
    """Measure and note."""
    study = read_study(CAMPAIGN)
    points = points_from(study.observation.positions)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        common.say("response matrix from nothing")
        scales = Weighed.of(find_getdp(), folder)
        base, seconds = built(study, points, Session(scales.getdp, folder / "response", jobs=2))
        note("response.seconds", seconds, "s",
             f"{base.matrix.shape[1]} columns x {base.matrix.shape[0]} readings")
        note("response.memory_GiB", own_peak() + 2 * scales.peak, "GiB",
             "peak of this process and of two of GetDP's")
        common.say("one GetDP process per column")
        alone = process_per_column_seconds(folder / "response")
        note("response.speedup_vs_process_per_column", alone * base.matrix.shape[1] / seconds,
             "ratio", f"{COLUMNS_BY_PROCESS} columns measured, {alone:.1f} s each")
        common.say("the same columns by magpylib, without permeability and iron")
        note("response.time_over_magpylib", seconds / magpylib_seconds(study, points), "ratio",
             "magpylib CylinderSegment, recoil permeability 1, no iron, one process")
        note("response.matrix_error", matrix_error(
            study, points, base, Session(find_getdp(), folder / "finer", jobs=2)),
             "of the main field", "mesh finer by 4/3, 20 draws of block errors of 1 %, 1 deg")
        errors(study, points, folder / "errors", note)
        symmetry(study, folder / "symmetry", note)
        against_ngsolve(study, points[::5], seconds, alone, folder / "ngsolve", note)
