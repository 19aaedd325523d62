"""The verbs on single files: new studies, import-map, import-blocks and export."""

from __future__ import annotations

import argparse
import os
import shlex
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import halbach_fe as hf
from halbach_fe.cli import common
from halbach_fe.cli.shared_options import (
    AXES,
    JSON,
    MAP_FORMAT,
    TABLE_FORMAT,
    choice,
    declared,
    flag,
    input_file,
    names,
    option,
    path,
    positive,
    positive_number,
    verb,
)
from halbach_fe.core.errors import CommandLineError, MeasurementError, must_be

if TYPE_CHECKING:
    from halbach_fe.core.arrays import Floats
    from halbach_fe.measurement.formats.columns_to_map import ImportedMap


def _template(parser: argparse.ArgumentParser) -> None:
    """Add the options of a new study."""
    from halbach_fe.study.writer import MagnetTemplate

    template = MagnetTemplate()
    option("study", path, "STUDY", "file to write (TOML)")(parser)
    strength = parser.add_mutually_exclusive_group()
    rings = parser.add_mutually_exclusive_group()
    groups = {"remanence-T": strength, "inner-radius-m": rings}
    for name, kind, text in (
            ("multipole-order", positive, "main multipole: 1 dipole, 2 quadrupole, ..."),
            ("blocks-per-ring", positive, "number of blocks in each ring"),
            ("rings", positive, "number of rings along z"),
            ("inner-radius-m", positive_number, "inner radius of the blocks"),
            ("outer-radius-m", positive_number, "outer radius of the blocks (default: 1.8 "
             "times the inner radius)"),
            ("ring-length-m", positive_number, "length of a ring along z; without it the "
             "study is a cross-section"),
            ("remanence-T", positive_number, "remanence of the blocks")):
        default = getattr(template, name.replace("-", "_"))
        option(f"--{name}", kind, "N" if kind is positive else "X",
               text if "default" in text or default is None
               else f"{text} (default: {default})")(groups.get(name, parser))
    choice("--shape", ("sector", "trapezoid", "cuboid"),
           f"shape of the blocks (default: {template.shape})")(parser)
    option("--material", str, "GRADE",
           "grade of the blocks, such as N42, in place of the remanence")(strength)
    option("--inner-radii-m", _radii, "X,X,...",
           "inner radii of rings that differ, in the order of z; needs --ring-length-m",
           default=())(rings)
    option("--free-blocks", path, "TABLE",
           "table of the blocks (CSV or HDF5), in place of rings")(rings)
    option("--cube-m", positive_number, "X",
           "edge of cubes in rings on --radius-m; sets shape, radii and length")(rings)
    option("--radius-m", positive_number, "X",
           "radius of the middles of the cubes of --cube-m")(parser)
    flag("--iron-ring", "add an iron tube around the blocks")(parser)
    option("--steel", str, "NAME", "steel of the iron tube, whose magnetization curve is known, "
           "such as aisi_1010; adds the tube")(parser)
    option("--dsv-m", positive_number, "X",
           "diameter of a spherical volume in the middle, on whose surface the field is measured, "
           "and in which that of a dipole is to be homogeneous (default: circles along the "
           "magnet)")(parser)


def _radii(text: str) -> tuple[float, ...]:
    """Return the radii in m of a list, or refuse it."""
    return tuple(map(positive_number, text.split(",")))


@verb(_template)
def new(arguments: argparse.Namespace) -> int:
    """Write a commented study file to start from.

    The file is a valid study, and a comment explains every key.
    """
    from halbach_fe.magnets import template_of, write_template
    from halbach_fe.study.writer import MagnetTemplate

    given = {name: value for name, value in vars(arguments).items()
             if name in MagnetTemplate.__dataclass_fields__ and value}
    path = arguments.study
    if "free_blocks" in given:
        given["free_blocks"] = os.path.relpath(given["free_blocks"], path.parent)
    _, template = write_template(path, template_of(
        given, "the command line", lambda key: f"--{key.replace('_', '-')}", CommandLineError))
    name = str(path) if not str(path).startswith("-") else f"./{path}"
    common.say(f"Wrote {path}. Its noise suits the field of the magnet: "
               f"{1e6 * template.sigma_T:g} µT for a reading, {1e6 * template.position_sd_m:g} µm "
               f"for a position. Next: halbach-fe solve {shlex.quote(name)} -o DIR")
    return 0


def _calibration(parser: argparse.ArgumentParser) -> None:
    """Add --calibration."""
    from halbach_fe.measurement.formats.import_export import HEADER

    option("--calibration", input_file, "TABLE",
           "CSV file with the errors of the probe's sensors against a reference, "
           "by which the readings are corrected; its header is like "
           f"{HEADER.replace('%', '%%')}")(parser)


@verb(
    option("file", input_file, "FILE", "map as it was delivered"),
    option("-o --output", path, "MAP", "map to write: .csv, .h5 or .vtu", required=True),
    MAP_FORMAT, _calibration, JSON)
def import_map(arguments: argparse.Namespace) -> int:
    """Convert a measured map from another file format, to metres, tesla and columns of halbach-fe.

    Reads tables of columns (separated by commas, semicolons, tabs or spaces, with or without a
    header), Opera's .table files, text files exported by COMSOL, maps of G4beamline, BDSIM, SRW and
    FLUKA, openPMD-beamphysics field meshes, and vectors of ParaView's .vtk and .vtu files. Units,
    columns and constant coordinates that the file does not state must be given as options; nothing
    is guessed.
    """
    import numpy as np

    from halbach_fe.measurement.field_map import refuse_total_field
    from halbach_fe.measurement.formats.declared_format import DeclaredFormat
    from halbach_fe.measurement.formats.import_export import import_map, read_calibration

    common.own_file(arguments, arguments.file, *filter(None, [arguments.calibration]))
    imported = import_map(arguments.file, declared(arguments, DeclaredFormat), arguments.format)
    corrections = {}
    if arguments.calibration:
        refuse_total_field(imported.data, "--calibration")
        if imported.cylindrical:
            raise MeasurementError(must_be(
                "--calibration", arguments.file.name, "beside Bx, By and Bz as the sensors read "
                "them", "beside Br and Bphi", "Import the readings of the three sensors."))
        before, imported = imported.data["B_T"].values, replace(
            imported, data=read_calibration(arguments.calibration).corrected(
                imported.data, arguments.file.name))
        corrections["largest_correction_T"] = float(
            np.nanmax(np.abs(imported.data["B_T"].values - before)))
    hf.write_map(imported.data, arguments.output)
    properties = _properties(imported) | corrections
    if arguments.json:
        common.print_json(properties | {"map": str(arguments.output)})
    else:
        common.print_table([{"property": key, "value": _text(value)}
                            for key, value in properties.items() if key != "remarks"],
                           f"Read as {imported.format}")
        for remark in imported.remarks:
            common.say(remark)
        common.say(f"Map: {arguments.output}")
    return 0


def _properties(file: ImportedMap) -> dict[str, object]:
    """Return the properties of the imported map as plain data, for the user to check."""
    import numpy as np

    from halbach_fe.measurement.field_map import TOTAL_COLUMN, UNDIRECTED, is_undirected, points_of

    points, field = points_of(file.data), file.data["B_T"].values
    columns: dict[str, Floats] = {name: field[:, i] for i, name in enumerate(AXES)}
    if TOTAL_COLUMN in file.data:
        columns["abs"] = file.data[TOTAL_COLUMN].values
    columns = {name: values for name, values in columns.items() if not np.isnan(values).all()}
    return {
        "format": file.format, "readings": len(points),
        "components": [UNDIRECTED] if is_undirected(file.data) else list(columns),
        "length_units": list(file.length_units),
        "field_units": list(file.field_units),
        "ignored_columns": list(file.ignored),
        "also_read": [name for name in ("sigma_T", "time_s", "scan") if name in file.data],
        "remarks": list(file.remarks),
        "points_without_reading": file.dropped,
        "from_m": points.min(axis=0).tolist(), "to_m": points.max(axis=0).tolist(),
        "min_B_T": [float(np.nanmin(values)) for values in columns.values()],
        "max_B_T": [float(np.nanmax(values)) for values in columns.values()]}


def _text(value: object) -> str:
    """Return a value as text for the table."""
    if isinstance(value, list):
        return ", ".join(
            f"{element:.6g}" if isinstance(element, float) else str(element) for element in value)
    return str(value)


def _block_columns(parser: argparse.ArgumentParser) -> None:
    """Add the options that say what a table of blocks holds."""
    from halbach_fe.measurement.formats.block_tables import QUANTITIES

    def fixed(text: str) -> dict[str, str]:
        """Parse values such as ``volume=12 cm^3,type=1``."""
        pairs = [part.partition("=") for part in text.split(",")]
        for name, _, value in pairs:
            if name.strip() not in QUANTITIES or not value.strip():
                raise argparse.ArgumentTypeError(
                    f"must be like 'volume=12 cm^3', with one of {', '.join(QUANTITIES)}, not "
                    f"{text!r}")
        given = [name.strip() for name, _, _ in pairs]
        if twice := next((name for name in given if given.count(name) > 1), ""):
            raise argparse.ArgumentTypeError(f"must give {twice} once, not {text!r}")
        return {name.strip(): value.strip() for name, _, value in pairs}

    option("--columns", names, "NAME,NAME...",
           f"content of each column: {', '.join(QUANTITIES)}, or - for one that is ignored; a "
           "unit may follow, as in moment_x[mA m^2], volume[mm^3]", default=())(parser)
    option("--fixed", fixed, "NAME=VALUE,...", "what all blocks share and the table does not say, "
           "as in 'volume=12 cm^3,sigma=0.2 %%,type=1,shape=cuboid'", default={})(parser)


def _axes(text: str) -> tuple[str, ...]:
    """Parse three axes, each once, with a sign or not."""
    if sorted(one.removeprefix("-") for one in names(text)) != sorted(AXES):
        raise argparse.ArgumentTypeError(f"must be x, y and z in some order, not {text!r}")
    return names(text)


@verb(
    option("file", input_file, "FILE", "table as it is: text or .xlsx"),
    option("-o --output", path, "TABLE", "table to write (CSV)", required=True),
    TABLE_FORMAT, _block_columns,
    option("--axes", _axes, "AXIS,AXIS,AXIS", "axis along which each component of the strength "
           "lies, as z,-y,x; for measured blocks x is radial, y azimuthal, z that of the magnet",
           default=AXES),
    flag("--along-block", "components of the strength of free blocks are along their own axes"),
    JSON)
def import_blocks(arguments: argparse.Namespace) -> int:
    """Convert a table of blocks from own columns and units to one that halbach-fe reads.

    A table with positions becomes one of free blocks, which a study names as array.free_blocks; any
    other one becomes one of measured blocks, for prior, sort and infer. FILE is text or a workbook
    (.xlsx). What the table does not say must be given as options; nothing is guessed.
    """
    from halbach_fe.measurement.block_table import write_blocks
    from halbach_fe.measurement.formats.block_tables import DeclaredBlocks, import_blocks
    from halbach_fe.study.free_blocks import write_free_blocks

    common.own_file(arguments, arguments.file)
    table = import_blocks(arguments.file, declared(arguments, DeclaredBlocks))
    kind = "measured blocks" if isinstance(table, hf.BlockTable) else "free blocks"
    if isinstance(table, hf.BlockTable):
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


def _export_format(parser: argparse.ArgumentParser) -> None:
    """Add --format."""
    from halbach_fe.measurement.formats.import_export import WRITERS

    choice("--format", (*WRITERS, "blocks"), "format of FILE", required=True)(parser)


@verb(
    option("input", input_file, "MAP",
           "map in m and T (CSV, HDF5 or VTU); for the format blocks, a study"),
    _export_format,
    option("-o --output", path, "FILE", "file to write", required=True))
def export(arguments: argparse.Namespace) -> int:
    """Write a map, or the blocks of a magnet, in the file format of another program.

    The formats openpmd (openPMD-beamphysics field mesh, HDF5), bdsim (BDSIM's three-dimensional
    text format) and geant4 (table of Geant4's PurgMagTabulatedField3D) need points on a regular
    grid; csv and vtu accept any points.

    With the format blocks, the input is a study, and the file a table of free blocks (CSV or HDF5):
    all blocks where and as they are, with their exceptions. A study reads it as array.free_blocks.
    """
    from halbach_fe.geometry.array_layout import beside_blocks, blocks_table
    from halbach_fe.measurement.formats.import_export import export_map
    from halbach_fe.study.free_blocks import write_free_blocks

    if arguments.format != "blocks":
        common.own_file(arguments, arguments.input)
        data = hf.read_map(arguments.input)
        export_map(data, arguments.format, arguments.output)
        common.say(f"Wrote {data.sizes['point']} points: {arguments.output}")
        return 0
    magnet = hf.build_magnet(hf.read_study(arguments.input))
    columns, others = blocks_table(magnet), beside_blocks(magnet)
    common.own_file(arguments, arguments.input, *_free_blocks_files(arguments.input))
    write_free_blocks(columns, arguments.output)
    common.say(f"Wrote {len(columns['name'])} blocks: {arguments.output}"
               + (f". Left out, as it is no block: {', '.join(others)}." if others else ""))
    return 0


def _free_blocks_files(study: Path) -> list[Path]:
    """Return the file of the free blocks of a valid study, if it has one.

    Written over it, a table would have the study's exceptions, which the study then adds again.
    """
    table = tomllib.loads(study.read_text("utf-8-sig"))["array"].get("free_blocks", {})
    return [study.parent / table["file"]] if "file" in table else []
