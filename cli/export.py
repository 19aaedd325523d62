"""Write a map for another program.

openpmd (openPMD-beamphysics field mesh, HDF5), bdsim (BDSIM's text, three-dimensional) and geant4
(PurgMagTabulatedField3D's table) need a regular grid; csv and vtu take any points.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from halbach_fe.cli import common
from halbach_fe.measurement.field_map import read_map
from halbach_fe.measurement.formats import WRITERS, export_map


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("map", type=Path, metavar="MAP", help="map in m and T (CSV, HDF5 or VTU)")
    parser.add_argument("--format", choices=WRITERS, required=True, help="of FILE")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE",
                        help="file to write")


def run(arguments: argparse.Namespace) -> int:
    """Read, write, say so."""
    data = read_map(arguments.map)
    export_map(data, arguments.format, arguments.output)
    common.say(f"Wrote {data.sizes['point']} points: {arguments.output}")
    return 0
