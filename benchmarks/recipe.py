"""README's recipe on six maps that a new user would bring: ``new``, then ``explain``.

``python -m benchmarks.run recipe`` brings them, and judges by `tests.support.brought_maps`.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.note import Note
from tests.support.brought_maps import Brought, bring, judged

RING = "--blocks-per-ring 12 --inner-radius-m 0.02 --outer-radius-m 0.035 --ring-length-m 0.04"
CUBES = "--blocks-per-ring 12 --rings 2 --cube-m 0.012 --radius-m 0.056 --dsv-m 0.05"
SIX = (
    Brought("dipole in mm and mT, displaced", RING, (0.012, 0.03), (1e3, 1e3),
            shift_m=(0.0, 0.0006, 0.001), seed=1),
    Brought("dipole of permeability 1.05, displaced", RING, (0.012, 0.03), assumed=1.05, true=1.05,
            shift_m=(0.001, 0.0, -0.0005), seed=2),
    Brought("quadrupole in mm, turned by 4 degrees", f"{RING} --multipole-order 2", (0.012, 0.03),
            (1e3, 1.0), turn_deg=(0.0, 0.0, 4.0), seed=3),
    Brought("quadrupole of unknown permeability, displaced", f"{RING} --multipole-order 2",
            (0.012, 0.03), assumed=1.05, true=1.10, shift_m=(0.0005, -0.001, 0.0), seed=4),
    Brought("MRI cubes in mm and mT, turned by 90 degrees", CUBES, (0.025, 0.025), (1e3, 1e3),
            shift_m=(0.0, 0.0, 0.001), turn_deg=(0.0, 0.0, 90.0), seed=5),
    Brought("MRI cubes of permeability 1.05, turned by 3 degrees", CUBES, (0.025, 0.025),
            (1e3, 1e3), 1.05, 1.05, (0.001, 0.0, 0.0), (0.0, 3.0, 0.0), seed=6))


def run(note: Note) -> None:
    """Note for each map how far off pose, weak block and field are, and what was named."""
    for number, case in enumerate(SIX, 1):
        with TemporaryDirectory() as folder:
            bring(case, Path(folder))
            found = judged(case, Path(folder))
        for name, (value, unit) in found.items():
            note(f"recipe.{number}.{name}", value, unit, case.name)
