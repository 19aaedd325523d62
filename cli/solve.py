"""Compute the field of a study's nominal magnet at the study's positions.

Iron with an H(B) curve is solved by Newton's method. Writes field_map.h5, field_map.csv and
field_map.vtu (open it in ParaView), readings.csv with the study's observation, multipoles.csv if it
has circles, report.html, and the GetDP run folders, which can be run by hand.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from importlib import metadata

import numpy as np

from halbach_fe.cli import common
from halbach_fe.core.files import write_text
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.measurement.observation import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.discretization_error import error_bar_session, reading_errors
from halbach_fe.response.resource_estimate import estimate_solve
from halbach_fe.solver.field import check_points, finite_element_part, vacuum_part
from halbach_fe.solver.runs import newton_history
from halbach_fe.study.model import is_nonlinear
from halbach_fe.study.reader import read_study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    common.add_dry_run_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Solve, write the maps, print a summary."""
    study = read_study(arguments.study)
    magnet = build_magnet(study)
    points = points_from(study.observation.positions)
    started = time.monotonic()
    observation = observe(study, points, np.ones_like(points, bool))
    read_at = observation.points  # where the instrument's probe is then
    elsewhere = not np.array_equal(read_at, points)
    places = np.vstack([points, read_at]) if elsewhere else points
    check_points(magnet, places)
    if arguments.dry_run:
        return common.print_estimate(
            estimate_solve(magnet, observation, common.jobs(arguments)),
            arguments.json)
    from halbach_fe.report.solution import Solution, write_solution_report  # matplotlib when needed

    with common.session(arguments) as session:
        part = finite_element_part(magnet, places, session, columns=False)
        field = vacuum_part(magnet, places) + part.nominal
        flux_density = field[:len(points)]
        data = field_map(points, flux_density, attributes={
            "study": study.name, "halbach_fe": metadata.version("halbach-fe"),
            "getdp": session.getdp.version, "method": study.solver.method})
        for suffix in (".h5", ".csv", ".vtu"):
            write_map(data, arguments.output / f"field_map{suffix}")
        last = slice(-len(read_at), None)
        errors = reading_errors(magnet, observation, replace(
            part, nominal=part.nominal[last], error=None if part.error is None
            else part.error[last]), error_bar_session(session))
    readings = observation.apply(field[last])
    lines = ["label,x_m,y_m,z_m,value_T,error_T"] + [
        f"{label},{x!r},{y!r},{z!r},{value!r},{error!r}"
        for label, (x, y, z), value, error in zip(
            observation.labels, observation.positions.tolist(), readings.tolist(),
            errors.tolist(), strict=True)]
    write_text(arguments.output / "readings.csv", "\n".join([*lines, ""]))
    size = np.linalg.norm(flux_density, axis=1)
    strongest = int(np.argmax(size))
    summary = {
        "study": study.name, "points": len(points), "readings": len(readings),
        "method": study.solver.method, "max_B_T": float(size.max()),
        "max_B_at_m": points[strongest].tolist(), "min_B_T": float(size.min()),
        "largest_error_T": float(errors.max()), "mean_B_T": flux_density.mean(axis=0).tolist(),
        "seconds": round(time.monotonic() - started, 2), "output": str(arguments.output),
    }
    write_solution_report(Solution(magnet, points, flux_density, observation, readings, errors, {
        "study file": common.digest(arguments.study), "GetDP": session.getdp.version,
        "method": study.solver.method, "points, readings": f"{len(points)}, {len(readings)}",
        "solved in": f"{summary['seconds']} s"}), arguments.output)
    if is_nonlinear(study):
        summary["newton_residuals"] = newton_history(arguments.output)
    if arguments.json:
        common.print_json(summary)
    else:
        common.print_table([{"what": key, "value": str(value)} for key, value in summary.items()])
        common.say(f"Report: {arguments.output / 'report.html'}")
    return 0
