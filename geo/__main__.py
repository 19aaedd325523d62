"""Mesh a study by hand: ``python -m halbach_fe.geo STUDY.toml -o FOLDER``."""

import argparse
import sys
from pathlib import Path

from halbach_fe.core.errors import HalbachError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.mesh import build_mesh
from halbach_fe.study.reader import read_study


def main() -> int:
    """Write FOLDER/mesh.msh (open it in Gmsh) and FOLDER/regions.json."""
    parser = argparse.ArgumentParser(prog="python -m halbach_fe.geo", description=main.__doc__)
    parser.add_argument("study", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    arguments = parser.parse_args()
    try:
        mesh = build_mesh(build_magnet(read_study(arguments.study)), arguments.output)
    except HalbachError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{mesh.mesh}\n{mesh.regions}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
