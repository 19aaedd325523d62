"""Thin saturating tubes around sectors in 3D: error, and coverage of the bars near the axis.

The truth is a solution with elements of 0.6 times the size, half as many modes more, and a boundary
at 1.5 times the distance; tests/solver/test_axisymmetric_iron.py compares the same solver with
NGSolve. The bars come from a resolution that is coarser by a factor of 1.5.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import common
from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.axisymmetric_iron import solve_iron
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.iron_modes import Resolution
from halbach_fe.solver.routes import finite_element_part
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study

BORE = 0.03
FINE = {"edge": 0.21, "growth": 1.4, "largest": 0.05, "boundary": 30.0}
MORE_MODES = 1.5


@dataclass(frozen=True)
class Tube:
    """A tube around two rings of sectors, between 30 and 50 mm."""

    gap_m: float = 0.001
    thickness_m: float = 0.002
    half_length_m: float = 0.03
    saturation_T: float = 2.0
    blocks: int = 8
    order: int = 1


CASES = (Tube(), Tube(gap_m=0.002), Tube(thickness_m=0.003), Tube(half_length_m=0.04),
         Tube(saturation_T=1.2), Tube(blocks=16, order=2), Tube(gap_m=0.004, thickness_m=0.001))


def study_of(tube: Tube, recoil_permeability: float) -> dict[str, object]:
    """The study of a case; without changes that of the issue that asked for it."""
    inner = 0.05 + tube.gap_m
    return {
        "name": "thin-tube", "dimension": 3,
        "array": {
            "blocks_per_ring": tube.blocks, "rings": 2, "inner_radius_m": BORE,
            "outer_radius_m": 0.05, "ring_length_m": 0.03, "remanence_T": 1.3,
            "multipole_order": tube.order, "recoil_permeability": recoil_permeability,
            "block": {"shape": "sector"}},
        "iron": {"bodies": [{"kind": "tube", "inner_radius_m": inner,
                             "outer_radius_m": inner + tube.thickness_m,
                             "length_m": 2 * tube.half_length_m}],
                 "curve": {"kind": "froehlich_kennelly", "initial_relative_permeability": 1000.0,
                           "saturation_polarization_T": tube.saturation_T}},
        "mesh": {"block_size_m": 0.011, "growth": 1.8},
        "observation": {"quantity": "flux_density",
                        "positions": {"kind": "points", "points_m": [[0, 0, 0]]}}}


def readings() -> Floats:
    """Points (n, 3) in m below a third of the bore, in the middle and the fringe."""
    generator = np.random.default_rng(4)
    radius, angle = BORE / 3 * np.sqrt(generator.random(60)), 2 * np.pi * generator.random(60)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle),
                            generator.uniform(-0.05, 0.05, 60)])


def main_field(blocks: tuple[MagnetBlock, ...]) -> float:
    """The largest field of the blocks in the bore, in T, to two thirds of its radius."""
    angle = np.linspace(0, 2 * np.pi, 48)
    ring = 2 * BORE / 3 * np.column_stack([np.cos(angle), np.sin(angle), 0.75 + 0 * angle])
    return float(np.linalg.norm(field_of(blocks, ring), axis=1).max())


def run(note: Note) -> None:
    """Measure and note."""
    ratios, worst, points = [], 0.0, readings()
    with tempfile.TemporaryDirectory() as name:
        session = Session(find_getdp(), Path(name), jobs=2)
        for number, tube in enumerate(CASES):
            magnet = build_magnet(parse_study(study_of(tube, 1.0)))
            blocks = magnet.blocks

            def source(places: Floats, blocks: tuple[MagnetBlock, ...] = blocks) -> Floats:
                return field_of(blocks, places)

            here, bodies = session.within(f"case-{number}"), magnet.iron
            found = solve_iron(bodies, source, here.within("found"))
            modes = round(MORE_MODES * int(found.problem.numbers[-1]))
            truth = solve_iron(bodies, source, here.within("truth"), estimate=False,
                               resolution=Resolution(**FINE, modes=modes)).field(points)
            difference = np.abs(found.field(points) - truth)
            ratios.append(difference / found.error(points))
            main = main_field(blocks)
            error = float(difference.max()) / main
            common.say(f"{tube}: reaction {np.abs(truth).max() * 1e3:.2f} mT of {main:.3f} T, "
                       f"error {error:.1e} of it, {np.mean(ratios[-1] <= 2):.3f} within 2 bars, "
                       f"{found.problem.numbers[-1]} modes")
            worst = max(worst, error)
        magnet = build_magnet(parse_study(study_of(CASES[0], 1.05)))
        started = time.monotonic()
        finite_element_part(magnet, points, session.within("permeable"), columns=False)
        note("iron3d.thin_tube_seconds", time.monotonic() - started, "s",
             "mu_r 1.05: blocks by moments, iron by modes, in turn, with bars")
    ratio = np.concatenate(ratios)
    note("iron3d.thin_tube_error", worst, "of the main field",
         f"largest of {len(CASES)} tubes of 1 to 3 mm around sectors; finer elements, more modes")
    note("iron3d.thin_tube_coverage", float(np.mean(ratio <= 2)), "ratio",
         f"{ratio.size} components with r below a third of the bore, within 2 bars")
    note("iron3d.thin_tube_coverage_1_sd", float(np.mean(ratio <= 1)), "ratio", "within 1 bar")
