"""Measure the figures that the README quotes, in one run, and write benchmarks/results.json.

``make benchmark``. Ratios compare two ways of doing the same thing on the same machine, one after
the other; seconds are there to be read, not to be asserted.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import tempfile
import time
from pathlib import Path

import magpylib
import numpy as np

from halbach_fe.blocks import blocks_of, position_angle_deg
from halbach_fe.cli import common
from halbach_fe.getdp import find_getdp
from halbach_fe.observation import observe, points_from
from halbach_fe.response import response
from halbach_fe.solve import Workshop
from halbach_fe.study import Study, read_study
from halbach_fe.update import write_text
from halbach_fe.verification import verify

HERE = Path(__file__).parent
CAMPAIGN = HERE.parent / "studies" / "faser" / "campaign.toml"
FOURIER = {"quantity": "fourier_coefficients", "harmonics": 8}


def response_seconds(study: Study, points: np.ndarray, folder: Path) -> tuple[float, int]:
    """Seconds to build H from nothing, with permeability and iron; and its columns."""
    observation = observe(study, points, np.ones_like(points, bool))
    started = time.monotonic()
    built = response(study, observation, Workshop(find_getdp(), folder, jobs=2))
    return time.monotonic() - started, built.matrix.shape[1]


def magpylib_seconds(study: Study, points: np.ndarray) -> float:
    """Seconds for magpylib to compute the same columns at recoil permeability 1, no iron.

    One ring is measured; the others are the same work.
    """
    started = time.monotonic()
    ring = [block for block in blocks_of(study) if block.ring == 1]
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


def main() -> None:
    """Measure, print, write."""
    study = read_study(CAMPAIGN)
    points = points_from(study.observation.positions)
    results: dict[str, dict[str, object]] = {}

    def note(name: str, value: float, unit: str, against: str) -> None:
        results[name] = {
            "value": float(f"{value:.3g}"), "unit": unit, "compared_with": against,
            "date": datetime.date.today().isoformat(),
            "machine": f"{platform.machine()}, {os.cpu_count()} cores"}

    with tempfile.TemporaryDirectory() as folder:
        workshop = Workshop(find_getdp(), Path(folder), jobs=2)
        common.say("error of the full array by refinement")
        found = verify(study, workshop, common.say)
        fourier = study.model_dump(exclude_none=True)
        positions = fourier["observation"]["positions"]
        by_circle = Study.model_validate(
            fourier | {"observation": FOURIER | {"positions": positions}})
        coefficients = verify(by_circle, workshop, common.say)
        note("response.error_pointwise", found.error_pointwise, "of the main field",
             "refinement and farther boundary, extrapolated")
        note("response.error_fourier", coefficients.error_readings, "of the main field",
             "refinement and farther boundary, extrapolated; K = 8")
        common.say("response matrix from nothing")
        seconds, columns = response_seconds(study, points, Path(folder))
        note("response.seconds", seconds, "s", f"{columns} columns x {3 * len(points)} readings")
        common.say("the same columns by magpylib, without permeability and iron")
        note("response.time_over_magpylib", seconds / magpylib_seconds(study, points), "ratio",
             "magpylib CylinderSegment, recoil permeability 1, no iron, one process")
    write_text(HERE / "results.json", json.dumps(results, indent=1) + "\n")
    common.print_table([{"name": name} | {key: str(value) for key, value in entry.items()}
                        for name, entry in results.items()])


if __name__ == "__main__":
    main()
