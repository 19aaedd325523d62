"""The method of moments for separate blocks: error, coverage of its bars, time, and two peers.

The peers run in interpreters of their own, see `benchmarks.moments_peers`: `MATERIAL_RESPONSE` and
`MAGTENSE` are environment variables with their paths (default: this interpreter). A peer that
cannot be imported there is left out. ``python -m benchmarks.moments BLOCKS`` solves once and prints
seconds and GiB.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
from pathlib import Path

import numpy as np

from benchmarks.note import Note
from halbach_fe.cli import common
from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.outline import closed_outline
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.moments.solve import reaction_columns, solve_moments
from tests.solver.moments.test_solve import (
    around,
    errors_in_bars,
    ngsolve_reaction,
    reaction_with_errors,
    three,
)
from tests.support.memory import own_peak

SIDE, REMANENCE, PERMEABILITY = 0.012, 1.4, 1.05
PEERS = {"material_response": "MATERIAL_RESPONSE", "magtense": "MAGTENSE"}
PEER_CELLS = (1, 2, 3)
SIZES = (125, 12_500)  # blocks of eight cells: 1e3 and 1e5


def ring(radius: float, count: int, z: float) -> list[MagnetBlock]:
    """Cubes of a Halbach dipole, turned with their magnetization."""
    half, found = SIDE / 2, []
    square = closed_outline(half * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]))
    for slot in range(count):
        place = 2 * np.pi * slot / count
        turn = 2 * place
        found.append(MagnetBlock(
            ring=1, slot=slot + 1, outline=square, z_min=-half, z_max=half,
            easy_axis=(float(np.cos(turn)), float(np.sin(turn)), 0.0), remanence=REMANENCE,
            recoil_permeability=PERMEABILITY, recoil_permeability_across=PERMEABILITY,
            origin_m=(radius * float(np.cos(place)), radius * float(np.sin(place)), z),
            orientation_rad=(0.0, 0.0, turn)))
    return found


def four_rings() -> list[MagnetBlock]:
    """96 cubes."""
    return [block for z in (-0.045, -0.015, 0.015, 0.045) for block in ring(0.15, 24, z)]


def large(count: int) -> list[MagnetBlock]:
    """About ``count`` cubes in three layers, as in a magnet for imaging."""
    rings = max(1, round(count / 160))
    return [block for number in range(rings)
            for radius, slots in ((0.15, 50), (0.17, 52), (0.19, 58))
            for block in ring(radius, slots, 0.02 * (number - (rings - 1) / 2))]


def ball(radius: float, count: int) -> Floats:
    """Points (n, 3) in m within a sphere."""
    generator = np.random.default_rng(1)
    found = generator.normal(size=(count, 3))
    found *= (radius * generator.uniform(0, 1, count) ** (1 / 3)
              / np.linalg.norm(found, axis=1))[:, None]
    return found


def peer(name: str, cells: int, blocks: list[MagnetBlock], points: Floats,
         folder: Path) -> tuple[Floats, float] | None:
    """The reaction by another program and the seconds it took; None if it is not there."""
    source, target = folder / "in.npz", folder / "out.npz"
    np.savez(source, centres=[block.middle for block in blocks],
             axes=[block.axes for block in blocks], sides=np.full((len(blocks), 3), SIDE),
             polarizations=[block.remanence * np.array(block.easy_axis) for block in blocks],
             points=points, chi=PERMEABILITY - 1)
    script = Path(__file__).with_name("moments_peers.py")
    done = subprocess.run(
        [os.environ.get(PEERS[name], sys.executable), "-W", "ignore", str(script), name, str(cells),
         str(source), str(target)], capture_output=True, text=True, check=False)
    if done.returncode:
        common.say(f"{name} is left out: {done.stderr.strip().splitlines()[-1:]}")
        return None
    with np.load(target) as found:
        return found["reaction"], float(found["seconds"])


def against_peers(note: Note, folder: Path) -> None:
    """96 cubes: error relative to four cells a side, and peers with as many as they need."""
    blocks, points = four_rings(), ball(0.04, 200)
    main = float(np.linalg.norm(field_of(blocks, points), axis=1).max())
    truth = solve_moments(blocks, cells_per_side=4, divisions=3).reaction(points)
    started = time.monotonic()
    ours = solve_moments(blocks).reaction(points)
    seconds = time.monotonic() - started
    error = float(np.abs(ours - truth).max()) / main
    for name in PEERS:
        for cells in PEER_CELLS:
            found = peer(name, cells, blocks, points, folder)
            if found is None:
                break
            theirs = float(np.abs(found[0] - truth).max()) / main
            common.say(f"{name}, {cells} cells a side: {found[1]:.2f} s, error {theirs:.1e}")
            if theirs <= error or cells == PEER_CELLS[-1]:
                note(f"moments.time_over_{name}", seconds / found[1], "ratio",
                     f"{cells} cells a side, {found[1]:.1f} s, error {theirs:.1e} of the main "
                     f"field; ours {error:.1e} in {seconds:.2f} s")
                if name == "magtense":
                    note("moments.difference_from_magtense",
                         float(np.abs(found[0] - ours).max()) / main, "of the main field",
                         f"{cells} cells a side")
                break
    note("moments.error_96_cubes", error, "of the main field",
         "4 cells a side with 3 nodes per direction, r <= 40 mm")


def close_cubes(note: Note) -> None:
    """Three cubes 5 mm apart, and one against NGSolve."""
    generator = np.random.default_rng(1)
    points = around(generator)
    truth = solve_moments(three(), cells_per_side=4, divisions=3).reaction(points)
    note("moments.close_cubes_error", float(np.abs(
        solve_moments(three()).reaction(points) - truth).max() / np.abs(truth).max()),
        "of the reaction", "three cubes 5 mm apart, 20 mm off them; 4 cells a side")
    body = three()[0]
    points = around(generator, 30, 0.03)
    exact = REMANENCE * ngsolve_reaction((SIDE,) * 3, PERMEABILITY - 1, points)
    note("moments.cube_against_ngsolve", float(np.abs(
        solve_moments([body]).reaction(points) - exact).max() / np.abs(exact).max()),
        "of the reaction", "one cube; NGSolve's potential of order 4")


def coverage(note: Note) -> None:
    """Random magnets, readings far from and at a tenth of a block from them."""
    ratio = errors_in_bars(np.random.default_rng(2), np.repeat(
        [0.05, 0.05, 0.1, 0.1, 0.5, 1.0], 3), 40)
    for bars in (1, 2):
        note(f"moments.coverage_{bars}_sd", float(np.mean(ratio <= bars)), "ratio",
             f"{ratio.size} components, 18 magnets, half the points within half a block of one; "
             "4 cells a side")


def size(note: Note) -> None:
    """4 000 cubes, and how time and memory grow."""
    blocks = large(4000)
    reaction_with_errors(blocks[:20], ball(0.1, 20))  # compiles
    reaction_columns(blocks[:20], ball(0.1, 20))
    started = time.monotonic()
    reaction_with_errors(blocks, ball(0.1, 2000))
    note("moments.seconds_4000_cubes", time.monotonic() - started, "s",
         f"{len(blocks)} cubes of 8 cells, 2000 points, with bars")
    started = time.monotonic()
    reaction_columns(blocks, ball(0.1, 500))
    note("moments.seconds_columns_4000_cubes", time.monotonic() - started, "s",
         f"{3 * len(blocks)} columns, 500 points")
    note("moments.memory_4000_cubes_GiB", own_peak(), "GiB", "peak of this process")
    (small, small_memory), (big, big_memory) = (json.loads(subprocess.run(
        [sys.executable, "-m", "benchmarks.moments", str(count)], capture_output=True, text=True,
        check=True).stdout) for count in SIZES)
    ratio = np.log(SIZES[1] / SIZES[0])
    note("moments.time_exponent", float(np.log(big / small) / ratio), "",
         f"{8 * SIZES[0]} to {8 * SIZES[1]} cells: {small:.2f} s to {big:.0f} s")
    note("moments.memory_exponent", float(np.log(big_memory / small_memory) / ratio), "",
         f"peak of the arrays: {small_memory:.4f} to {big_memory:.2f} GiB")


def alone(count: int) -> tuple[float, float]:
    """Seconds of a solve of ``count`` cubes, compiled beforehand, and GiB of arrays of another."""
    solve_moments(large(160)[:20]).reaction(ball(0.1, 20))
    blocks = large(count) if count > 200 else large(160)[:count]
    started = time.monotonic()
    solve_moments(blocks).reaction(ball(0.1, 100))
    seconds = time.monotonic() - started
    tracemalloc.start()
    solve_moments(blocks).reaction(ball(0.1, 100))
    return seconds, tracemalloc.get_traced_memory()[1] / 2**30


def run(note: Note) -> None:
    """Measure and note."""
    with tempfile.TemporaryDirectory() as name:
        against_peers(note, Path(name))
    close_cubes(note)
    coverage(note)
    size(note)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(alone(int(sys.argv[1]))))
