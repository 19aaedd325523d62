"""How time and memory grow: with blocks, readings, unknowns of the mesh, and workers.

Each size runs in a process of its own, whose peak memory the system tells (with GetDP's largest
process beside it); `halbach-fe infer` runs as a user runs it, files and report included. Truth and
maps are magpylib's. Exponents are slopes of least squares in logarithms over the sizes from
``SLOPE_FROM`` on, those of time by the processor's seconds: others may use the machine. All points
go into benchmarks/scaling.json. ``python -m benchmarks.scaling --quick`` tries it with small sizes,
and writes nothing.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from benchmarks.note import Note
from halbach_fe.cli import common
from halbach_fe.cli import main as halbach_fe
from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.resource_estimate import estimate_infer
from halbach_fe.solver.azimuthal_modes import solve_modes
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import nominal_prior
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study
from tests.conftest import DIPOLE, changed
from tests.oracles.cuboids import cuboid_field, long_dipole
from tests.support.memory import Weighed, own_peak

POINTS = Path(__file__).parent / "scaling.json"
FEW = 42  # circles of 8 points: 1008 readings

BLOCKS = (1, 4, 16, 64, 160, 320, 640)
"""Rings of 16 blocks."""

READINGS = ((42, 8), (140, 24), (420, 80), (1302, 256))
"""Circles and points on each, of a dipole of three rings: three readings a point."""

BOTH = ((64, 42), (64, 420), (640, 126))
"""Rings and circles: 3 072 parameters from 1 008 and 10 080 readings, 30 720 from 3 024."""

MESHES = (0.016, 0.008, 0.004)
"""Elements in m of the half-plane, of a dipole of 12 rings: 36 columns and the nominal array."""

SOLIDS = (0.035, 0.025, 0.018)
"""Elements in m of the 3D mesh of two rings: the nominal array, factorized."""

SLOPE_FROM = {"blocks": 2560, "readings": 100_000, "azimuthal modes": 0, "scalar potential": 0}
"""Sizes from which on growth is that of the work itself, not of what every run takes."""


def measured(work: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """What work returns, with its seconds and its peak memory, in a new process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_timed, (work, arguments))


def _timed(work: Callable[..., dict[str, Any]], arguments: Sequence[Any]) -> dict[str, Any]:
    started = time.monotonic()
    found = work(*arguments)
    return {"seconds": time.monotonic() - started, "memory_GiB": own_peak(),
            "processor_s": sum(one.ru_utime + one.ru_stime for one in map(
                resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))} | found


def write_campaign(document: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A study and a map of it by magpylib, the truth being drawn from its prior."""
    generator = np.random.default_rng(1)
    study = parse_study(document)
    nominal = np.concatenate([block.magnetization for block in build_magnet(study).blocks])
    prior = study.prior
    truth = nominal_prior(nominal, 3, prior.magnitude_sd, prior.direction_sd_deg,
                        prior.shared_sd).sample(1, generator)[0]
    points = points_from(study.observation.positions)
    field = cuboid_field(document, truth.reshape(-1, 3), points)
    assert study.noise is not None
    field += study.noise.regions[0].sigma_T * generator.standard_normal(field.shape)
    write_map(field_map(points, field), folder / "map.csv")
    write_text(folder / "study.toml", tomlkit.dumps(document))
    return {}


def infer(document: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The verb, from files to files."""
    if halbach_fe(["infer", str(folder / "study.toml"), "--measurements", str(folder / "map.csv"),
                   "-o", str(folder / "out"), "--json"]):
        raise RuntimeError("halbach-fe infer failed")
    study = parse_study(document)
    points = points_from(study.observation.positions)
    foretold = estimate_infer(build_magnet(study),
                              observe(study, points, np.ones_like(points, bool)), 1)
    summary = json.loads((folder / "out" / "summary.json").read_text(encoding="utf-8"))
    written = {path.name: path.stat().st_size / 2**20 for path in (folder / "out").iterdir()}
    unseen = next(one for one in summary["scores"] if one["part"] != "training")
    return {
        "blocks": len(build_magnet(study).blocks), "readings": summary["readings"],
        "parameters": summary["parameters"], "learnt": summary["parameters_learnt"],
        "chi2_held_out": unseen["chi2_posterior"], "held_out": unseen["readings"],
        "foretold_GiB": foretold.memory_GiB, "foretold_s": foretold.seconds,
        "disk_MiB": sum(written.values()), "page_MiB": written["report.html"]}


def campaign(rings: int, circles: int, angles: int = 8) -> dict[str, Any]:
    """Time of an inference from a map of magpylib."""
    document = long_dipole(rings, circles, angles)
    with tempfile.TemporaryDirectory() as name:
        measured(write_campaign, document, Path(name))
        found = measured(infer, document, Path(name))
    common.say(f"{found['blocks']} blocks, {found['readings']} readings: "
               f"{found['seconds']:.1f} s, {found['memory_GiB']:.2f} GiB, chi2 "
               f"{found['chi2_held_out']:.2f}")
    return found


def twelve_rings(size: float) -> Study:
    """The FASER dipole's magnet, mapped at 50 mm, with an element size of the half-plane."""
    return parse_study(changed(
        DIPOLE, dimension=3, array__rings=12, array__ring_length_m=1 / 12,
        mesh__meridian_size_m=size, observation__positions={
            "kind": "circles", "radius_m": 0.05, "angles": 8, "count": 20, "z_min_m": -0.5,
            "z_max_m": 0.5}))


def measured_solve(
    study: Study, jobs: int, solve: Callable[[Magnet, Floats, Session], object]
) -> dict[str, Any]:
    """Solve for the field at the study's positions; return its cost and number of unknowns."""
    points, magnet = points_from(study.observation.positions), build_magnet(study)
    with tempfile.TemporaryDirectory() as name:
        scales = Weighed.of(find_getdp(), Path(name))
        started = time.monotonic()
        solve(magnet, points, Session(scales.getdp, Path(name), jobs=jobs))
        seconds, peak = time.monotonic() - started, scales.peak
    problem = max(
        estimate_infer(magnet, observe(study, points, np.ones_like(points, bool)), 1).problems,
        key=lambda one: one.unknowns)
    return {"unknowns": problem.unknowns, "jobs": jobs, "seconds": seconds, "getdp_GiB": peak}


def modes(size: float, jobs: int) -> dict[str, Any]:
    """All columns by azimuthal modes."""
    return measured_solve(twelve_rings(size), jobs, lambda magnet, points, session: solve_modes(
        magnet, points, range(0, 96, 16), session))


def solid(size: float) -> dict[str, Any]:
    """The nominal array of two rings on a 3D mesh."""
    return measured_solve(parse_study(changed(
        DIPOLE, dimension=3, array__rings=2, array__ring_length_m=0.08,
        mesh={"block_size_m": size, "layers_per_ring": max(1, round(0.06 / size)), "growth": 1.6},
        solver__route="scalar_potential", observation__positions={
            "kind": "circles", "radius_m": 0.05, "angles": 8, "count": 5, "z_min_m": -0.1,
            "z_max_m": 0.1})), 1, solve_nominal)


def slope(points: Sequence[dict[str, Any]], size: str, what: str, start: float) -> float:
    """Exponent of growth of a figure with a size, from a size on."""
    used = [one for one in points if one[size] >= start]
    return float(np.polyfit(np.log([one[size] for one in used]),
                            np.log([one[what] for one in used]), 1)[0])


def measure(quick: bool) -> dict[str, list[dict[str, Any]]]:
    """All points; with ``quick`` the smaller half of them."""
    def some(sizes: Sequence[Any]) -> Sequence[Any]:
        return sizes[:len(sizes) // 2] if quick else sizes

    return {
        "blocks": [campaign(rings, FEW) for rings in some(BLOCKS)],
        "readings": [campaign(3, *circles) for circles in some(READINGS)],
        "both": [campaign(rings, circles) for rings, circles in some(BOTH)],
        "azimuthal modes": [measured(modes, size, 1) for size in some(MESHES)],
        "scalar potential": [measured(solid, size) for size in some(SOLIDS)],
        "workers": [measured(modes, MESHES[0 if quick else 1], jobs) for jobs in (1, 2)]}


def run(note: Note) -> None:
    """Measure, write all points, and note exponents and the largest."""
    found = measure(quick=False)
    write_text(POINTS, json.dumps(found, indent=1) + "\n")
    for name, size in (("blocks", "blocks"), ("readings", "readings"),
                       ("azimuthal modes", "unknowns"), ("scalar potential", "unknowns")):
        points, start = found[name], SLOPE_FROM[name]
        first = max(start, points[0][size])
        title = "scaling." + name.replace(" ", "_")
        where = f"from {first:g} to {points[-1][size]:g} {size}"
        note(f"{title}_time_exponent", slope(points, size, "processor_s", start), "", where)
        memory = "getdp_GiB" if "getdp_GiB" in points[0] else "memory_GiB"
        note(f"{title}_memory_exponent", slope(points, size, memory, start), "", where)
    largest, most = found["blocks"][-1], found["readings"][-1]
    for name, one in (("10240_blocks", largest), ("million_readings", most),
                      ("10240_blocks_3024_readings", found["both"][-1])):
        against = f"halbach-fe infer, {one['blocks']} blocks, {one['readings']} readings"
        note(f"scaling.{name}_processor_s", one["processor_s"], "s", against)
        note(f"scaling.{name}_memory_GiB", one["memory_GiB"], "GiB", against)
        note(f"scaling.{name}_chi2", one["chi2_held_out"], "per reading",
             f"{one['held_out']} held-out readings, truth by magpylib")
    alone, together = (one["seconds"] for one in found["workers"])
    note("scaling.two_workers_speedup", alone / together, "ratio",
         f"azimuthal modes, {found['workers'][0]['unknowns']} unknowns, --jobs 1")


def main() -> None:
    """Try it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", required=True,
                        help="small sizes only; all: python -m benchmarks.run scaling")
    parser.parse_args()
    common.say(json.dumps(measure(quick=True), indent=1))


if __name__ == "__main__":
    main()
