"""Convert a measured map from another file format, to metres, tesla and halbach-fe's own columns.

Reads tables of columns (separated by commas, semicolons, tabs or spaces, with or without a header),
Opera's .table files, text files exported by COMSOL, maps of G4beamline, BDSIM, SRW and FLUKA, and
openPMD-beamphysics field meshes. Units, columns and constant coordinates that the file does not
state must be given as options; nothing is guessed.
"""

from __future__ import annotations

import argparse

import numpy as np

from halbach_fe.cli import common
from halbach_fe.cli.format_options import add_format_arguments, declared_format
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import MeasurementError, must_be
from halbach_fe.core.result_folder import single_file
from halbach_fe.measurement.calibration import HEADER, read_calibration
from halbach_fe.measurement.field_map import (
    TOTAL_COLUMN,
    UNDIRECTED,
    is_undirected,
    points_of,
    refuse_total_field,
    write_map,
)
from halbach_fe.measurement.formats.files import ImportedFile, import_map
from halbach_fe.study.types import COMPONENTS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.add_argument("file", type=common.input_file, metavar="FILE",
                        help="map as it was delivered")
    parser.add_argument("-o", "--output", type=common.path, required=True, metavar="MAP",
                        help="map to write: .csv, .h5 or .vtu")
    add_format_arguments(parser)
    parser.add_argument("--calibration", type=common.input_file, metavar="TABLE",
                        help="CSV file with the errors of the probe's sensors against a reference, "
                        "by which the readings are corrected; its header is like "
                        f"{HEADER.replace('%', '%%')}")
    common.add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read the file, convert it, write the map, and print how the file was understood."""
    common.keep_input(arguments.output, arguments.file, *(
        [arguments.calibration] if arguments.calibration else []))
    arguments.at_end.enter_context(single_file(arguments.output, "halbach-fe import-map"))
    imported = import_map(arguments.file, declared_format(arguments), arguments.format)
    corrections = {}
    if arguments.calibration:
        refuse_total_field(imported.data, "--calibration")
        if imported.imported.cylindrical:
            raise MeasurementError(must_be(
                "--calibration", arguments.file.name, "beside Bx, By and Bz as the sensors read "
                "them", "beside Br and Bphi", "Import the readings of the three sensors."))
        before, imported = imported.data["B_T"].values, imported.with_data(
            read_calibration(arguments.calibration).corrected(
                imported.data, arguments.file.name))
        corrections["largest_correction_T"] = float(
            np.nanmax(np.abs(imported.data["B_T"].values - before)))
    write_map(imported.data, arguments.output)
    properties = summary(imported) | corrections
    if arguments.json:
        common.print_json(properties | {"map": str(arguments.output)})
    else:
        common.print_table([{"property": key, "value": text(value)}
                            for key, value in properties.items() if key != "remarks"],
                           f"Read as {imported.format}")
        for remark in imported.imported.remarks:
            common.say(remark)
        common.say(f"Map: {arguments.output}")
    return 0


def summary(file: ImportedFile) -> dict[str, object]:
    """Return the properties of the imported map as plain data, for the user to check."""
    points, field = points_of(file.data), file.data["B_T"].values
    columns: dict[str, Floats] = {name: field[:, i] for i, name in enumerate(COMPONENTS)}
    if TOTAL_COLUMN in file.data:
        columns["abs"] = file.data[TOTAL_COLUMN].values
    columns = {name: values for name, values in columns.items() if not np.isnan(values).all()}
    return {
        "format": file.format, "readings": len(points),
        "components": [UNDIRECTED] if is_undirected(file.data) else list(columns),
        "length_units": list(file.imported.length_units),
        "field_units": list(file.imported.field_units),
        "ignored_columns": list(file.imported.ignored),
        "also_read": [name for name in ("sigma_T", "time_s", "scan") if name in file.data],
        "remarks": list(file.imported.remarks),
        "points_without_reading": file.imported.dropped,
        "from_m": points.min(axis=0).tolist(), "to_m": points.max(axis=0).tolist(),
        "min_B_T": [float(np.nanmin(values)) for values in columns.values()],
        "max_B_T": [float(np.nanmax(values)) for values in columns.values()]}


def text(value: object) -> str:
    """Return a value as text for the table."""
    if isinstance(value, list):
        return ", ".join(
            f"{element:.6g}" if isinstance(element, float) else str(element) for element in value)
    return str(value)
