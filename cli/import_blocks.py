"""Convert a table of blocks from own columns and units to one that halbach-fe reads.

A table with positions becomes one of free blocks, which a study names as array.free_blocks; any
other one becomes one of measured blocks, for prior, sort and infer. FILE is text or a workbook
(.xlsx). What the table does not say must be given as options; nothing is guessed.
"""

from __future__ import annotations

import argparse

from halbach_fe.cli import common
from halbach_fe.cli.format_options import add_table_arguments, names
from halbach_fe.core.result_folder import single_file
from halbach_fe.measurement.block_table import BlockTable, write_blocks
from halbach_fe.measurement.formats.blocks import QUANTITIES, DeclaredBlocks, import_blocks
from halbach_fe.study.free_blocks_file import write_free_blocks
from halbach_fe.study.types import COMPONENTS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("file", type=common.input_file, metavar="FILE",
                        help="table as it is: text or .xlsx")
    parser.add_argument("-o", "--output", type=common.path, required=True, metavar="TABLE",
                        help="table to write (CSV)")
    add_table_arguments(parser)
    parser.add_argument("--columns", type=names, default=(), metavar="NAME,NAME...",
                        help=f"content of each column: {', '.join(QUANTITIES)}, or - for one that "
                        "is ignored; a unit may follow, as in moment_x[mA m^2], volume[mm^3]")
    parser.add_argument("--fixed", type=_fixed, default={}, metavar="NAME=VALUE,...",
                        help="what all blocks share and the table does not say, as in "
                        "'volume=12 cm^3,sigma=0.2 %%,type=1,shape=cuboid'")
    parser.add_argument("--axes", type=_axes, default=COMPONENTS, metavar="AXIS,AXIS,AXIS",
                        help="axis along which each component of the strength lies, as z,-y,x; for "
                        "measured blocks x is radial, y azimuthal, z that of the magnet")
    parser.add_argument("--along-block", action="store_true",
                        help="components of the strength of free blocks are along their own axes")
    common.add_json_argument(parser)


def _fixed(text: str) -> dict[str, str]:
    """Parse values such as ``volume=12 cm^3,type=1``."""
    pairs = [part.partition("=") for part in text.split(",")]
    for name, _, value in pairs:
        if name.strip() not in QUANTITIES or not value.strip():
            raise argparse.ArgumentTypeError(
                f"must be like 'volume=12 cm^3', with one of {', '.join(QUANTITIES)}, not {text!r}")
    return {name.strip(): value.strip() for name, _, value in pairs}


def _axes(text: str) -> tuple[str, str, str]:
    """Parse three axes, each once, with a sign or not."""
    x, y, z = [*names(text), "", "", ""][:3]
    if sorted(one.removeprefix("-") for one in names(text)) != sorted(COMPONENTS):
        raise argparse.ArgumentTypeError(f"must be x, y and z in some order, not {text!r}")
    return x, y, z


def run(arguments: argparse.Namespace) -> int:
    """Read the table, convert it, write it, and say what it is."""
    common.keep_input(arguments.output, arguments.file)
    arguments.at_end.enter_context(single_file(arguments.output, "halbach-fe import-blocks"))
    table = import_blocks(arguments.file, DeclaredBlocks(**{
        name: getattr(arguments, name) for name in (
            "length_unit", "field_unit", "angle_unit", "columns", "decimal_comma", "encoding",
            "skip_lines", "delimiter", "axes", "along_block", "fixed")}))
    kind = "measured blocks" if isinstance(table, BlockTable) else "free blocks"
    if isinstance(table, BlockTable):
        write_blocks(table, arguments.output)
        after = f"halbach-fe prior STUDY {arguments.output} -o DIR"
    else:
        write_free_blocks(table, arguments.output)
        after = f"halbach-fe new STUDY --free-blocks {arguments.output}"
    if arguments.json:
        common.print_json({"blocks": len(table), "kind": kind, "table": str(arguments.output)})
    else:
        common.say(f"Wrote {len(table)} {kind}: {arguments.output}. Next: {after}")
    return 0
