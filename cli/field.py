"""Compute B and H on lines with error bars, their first and second integrals, and kick maps.

The lines run from --from-m to --to-m, and beside it at the offsets of --across-m. With --posterior
the bars are those of the measured magnet, otherwise those of the study's prior. With --inside
points may lie inside blocks and iron. Writes field.csv, field_map.csv (B as a map, which halbach-fe
export turns into other formats) and integrals.csv, and for a grid of lines kick_map.txt in the text
format of Radia, with kicks in T^2 m^2.
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from halbach_fe.cli import common
from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.core.tables import csv_text
from halbach_fe.study.types import COMPONENTS

if TYPE_CHECKING:
    from halbach_fe.response.field_on_lines import FieldOnLines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    for end in ("from", "to"):
        parser.add_argument(f"--{end}-m", type=common.finite_number, nargs=3, required=True,
                            metavar=("X", "Y", "Z"), help=f"where the line goes {end}")
    parser.add_argument("--count", type=partial(common.at_least, 3), default=201, metavar="N",
                        help="number of points of a line (default: 201)")
    parser.add_argument("--across-m", type=common.finite_number, nargs=2, default=(0.0, 0.0),
                        metavar=("U", "V"), help="half widths of a grid of parallel lines: of a "
                        "line along z those along x and y")
    parser.add_argument("--lines", type=common.positive, default=5, metavar="N",
                        help="number of lines along each half width (default: 5)")
    parser.add_argument("--posterior", type=common.input_file, metavar="H5",
                        help="posterior.h5 that halbach-fe infer wrote for this study")
    parser.add_argument("--inside", action="store_true",
                        help="points may lie inside blocks and iron")


def run(arguments: argparse.Namespace) -> int:
    """Compute the field, write the tables, print the integrals of the middle line."""
    from halbach_fe.api import field
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.same_magnet import disagreement_of
    from halbach_fe.inference.storage import read_posterior
    from halbach_fe.measurement.field_map import field_map, write_map
    from halbach_fe.report.words import with_error
    from halbach_fe.response.field_on_lines import Lines
    from halbach_fe.study.reader import read_study

    offsets = tuple(np.linspace(-half, half, arguments.lines) if half else np.zeros(1)
                    for half in arguments.across_m)
    lines = Lines(np.array(arguments.from_m), np.array(arguments.to_m), (offsets[0], offsets[1]),
                  arguments.count)
    magnet = build_magnet(read_study(arguments.study))
    read = read_posterior(magnet, arguments.posterior) if arguments.posterior else None
    with common.session(arguments, magnet.study) as session:
        found = field(magnet, lines, session, read, arguments.inside)
    folder = arguments.output
    write_text(folder / "field.csv", csv_text(_points(found)))
    write_map(field_map(lines.points.reshape(-1, 3), found.mean.reshape(-1, 3), attributes={
        "study": magnet.name}), folder / "field_map.csv")
    grid = np.meshgrid(*offsets, indexing="ij")
    columns: dict[str, Floats] = {"u_m": grid[0].ravel(), "v_m": grid[1].ravel()}
    for order, unit in ((1, "T_m"), (2, "T_m2")):
        mean, sd = found.integrals(order)
        for axis, values, bars in zip(COMPONENTS, mean.T, sd.T, strict=True):
            columns |= {f"I{order}{axis}_{unit}": values, f"sd_I{order}{axis}_{unit}": bars}
    columns["Phi_T2_m3"], columns["sd_Phi_T2_m3"] = found.kick_potential()
    if min(map(len, offsets)) > 1:
        kicks = found.kicks()
        for across, (kick, sd) in zip("uv", kicks, strict=True):
            columns |= {f"kick_{across}_T2_m2": kick.ravel(),
                        f"sd_kick_{across}_T2_m2": sd.ravel()}
        write_text(folder / "kick_map.txt", kick_map(
            found.lines.length, offsets, (kicks[0][0], kicks[1][0])))
    write_text(folder / "integrals.csv", csv_text(columns))
    doubt = disagreement_of(read)
    if arguments.json:
        common.print_json({"lines": len(lines.points), "points_per_line": lines.count,
                           "reservation": doubt or None, "folder": str(folder),
                           **{name: values.tolist() for name, values in columns.items()}})
        return 0
    middle = len(columns["u_m"]) // 2
    common.print_table([{
        "component": axis, **{
            f"{name} integral, {unit}": with_error(columns[f"I{order}{axis}_{key}"][middle],
                                                   columns[f"sd_I{order}{axis}_{key}"][middle])
            for order, name, unit, key in ((1, "first", "T m", "T_m"), (2, "second", "T m²",
                                                                         "T_m2"))}}
        for axis in COMPONENTS], "Integrals of B along the middle line")
    if doubt:
        common.say(doubt)
    common.say(f"Wrote {lines.points.shape[0]} lines of {lines.count} points: {folder}")
    return 0


def _points(found: FieldOnLines) -> dict[str, NDArray[Any]]:
    """Return the columns of the table of points."""
    strength, strength_sd = found.strength
    columns: dict[str, NDArray[Any]] = {}
    for name, values in (("{}_m", found.lines.points), ("B{}_T", found.mean),
                         ("sd_B{}_T", found.sd), ("H{}_A_per_m", strength),
                         ("sd_H{}_A_per_m", strength_sd)):
        columns |= {name.format(axis): values[..., number].ravel()
                    for number, axis in enumerate(COMPONENTS)}
    return columns | {"in_block": found.in_block.ravel()}


def kick_map(length: float, offsets: tuple[Floats, ...], kicks: tuple[Floats, Floats]) -> str:
    """Return a kick map in the text format of Radia; rows begin at the highest offset."""
    text = ["# kick map of halbach-fe", "# Length [m]", f"{length:.9g}",
            "# Number of Horizontal Points", f"{len(offsets[0])}",
            "# Number of Vertical Points", f"{len(offsets[1])}"]
    for name, kick in zip(("Horizontal", "Vertical"), kicks, strict=True):
        text += [f"# {name} 2nd Order Kick [T2m2]", "START",
                 "\t" + "\t".join(f"{u:.9g}" for u in offsets[0])]
        text += ["\t".join([f"{offsets[1][row]:.9g}", *(f"{value:.12g}" for value in kick[:, row])])
                 for row in range(len(offsets[1]) - 1, -1, -1)]
    return "\n".join(text) + "\n"
