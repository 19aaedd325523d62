"""Write a map in the file format of another program.

The formats openpmd (openPMD-beamphysics field mesh, HDF5), bdsim (BDSIM's three-dimensional text
format) and geant4 (table of Geant4's PurgMagTabulatedField3D) need points on a regular grid; csv
and vtu accept any points.
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
    parser.add_argument("--format", choices=WRITERS, required=True,
                        help="format of FILE")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE",
                        help="file to write")


def run(arguments: argparse.Namespace) -> int:
    """Read the map, write it in the other format, and report its size."""
    data = read_map(arguments.map)
    export_map(data, arguments.format, arguments.output)
    common.say(f"Wrote {data.sizes['point']} points: {arguments.output}")
    return 0
