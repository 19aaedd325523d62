"""Write the stored field maps that CI recomputes: ``python -m tests.regression.make_references``.

Run it only when a change of the numbers is meant, and say why in the commit.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.solver.getdp import find_getdp
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session
from tests.regression.cases import CASES, FOLDER, points_of_case


def main() -> None:
    """Solve every case and store its map."""
    getdp = find_getdp()
    for name, study in CASES.items():
        points = points_of_case(study)
        with tempfile.TemporaryDirectory() as folder:
            field = solve_nominal(build_magnet(study), points, Session(getdp, Path(folder), jobs=2))
        write_map(field_map(points, field, attributes={"case": name, "getdp": getdp.version}),
                  FOLDER / f"{name}.h5")


if __name__ == "__main__":
    main()
