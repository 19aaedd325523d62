"""Write a map, or the blocks of a magnet, in the file format of another program.

The formats openpmd (openPMD-beamphysics field mesh, HDF5), bdsim (BDSIM's three-dimensional text
format) and geant4 (table of Geant4's PurgMagTabulatedField3D) need points on a regular grid; csv
and vtu accept any points.

With the format blocks, the input is a study, and the file a table of free blocks (CSV or HDF5): all
blocks where and as they are, with their exceptions. A study reads it as array.free_blocks.
"""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path

from halbach_fe.cli import common
from halbach_fe.core.result_folder import single_file
from halbach_fe.geometry.free_blocks import blocks_table
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import read_map
from halbach_fe.measurement.formats.files import WRITERS, export_map
from halbach_fe.study.free_blocks_file import write_free_blocks
from halbach_fe.study.reader import read_study

BLOCKS = "blocks"
"""Name of the format of tables of free blocks."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("input", type=common.input_file, metavar="MAP",
                        help="map in m and T (CSV, HDF5 or VTU); for the format blocks, a study")
    parser.add_argument("--format", choices=(*WRITERS, BLOCKS), required=True,
                        help="format of FILE")
    parser.add_argument("-o", "--output", type=common.path, required=True, metavar="FILE",
                        help="file to write")


def free_blocks_files(study: Path) -> list[Path]:
    """Return the file of the free blocks of a valid study, if it has one.

    Written over it, a table would have the study's exceptions, which the study then adds again.
    """
    table = tomllib.loads(study.read_text("utf-8-sig"))["array"].get("free_blocks", {})
    return [study.parent / table["file"]] if "file" in table else []


def run(arguments: argparse.Namespace) -> int:
    """Read the map or study, write it in the other format, and report its size."""
    common.keep_input(arguments.output, arguments.input)
    if arguments.format == BLOCKS:
        columns = blocks_table(build_magnet(read_study(arguments.input)))
        common.keep_input(arguments.output, *free_blocks_files(arguments.input))
        arguments.at_end.enter_context(single_file(arguments.output, "halbach-fe export"))
        write_free_blocks(columns, arguments.output)
        common.say(f"Wrote {len(columns['name'])} blocks: {arguments.output}")
        return 0
    arguments.at_end.enter_context(single_file(arguments.output, "halbach-fe export"))
    data = read_map(arguments.input)
    export_map(data, arguments.format, arguments.output)
    common.say(f"Wrote {data.sizes['point']} points: {arguments.output}")
    return 0
