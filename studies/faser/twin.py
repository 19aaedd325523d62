"""The FASER campaign's synthetic twin: from block moments and a map at 75 mm to the axis.

What the paper did with its unpublished map, where the truth is known (make_twin.py)::

    python studies/faser/twin.py -o results/faser-twin
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from halbach_fe.cli import common
from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.block_table import read_blocks
from halbach_fe.measurement.field_map import points_of, read_map
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.report.inference_page import page
from halbach_fe.report.page import write_files
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.stats.posteriors import predict
from halbach_fe.study.measurement_keys import FluxDensity, PointPositions
from halbach_fe.study.reader import read_study

sys.path.append(str(Path(__file__).parents[1]))  # for what several studies share
from magnetizations_page import error_summary
from magnetizations_page import page as page_of_magnetizations

HERE = Path(__file__).parent
HOMOGENEOUS_M = (-0.43, 0.42)
REGIONS = ("homogeneous", "fringe")


def medians(z: Floats, errors: Floats) -> dict[str, float]:
    """Median relative error by region."""
    inside = (z >= HOMOGENEOUS_M[0]) & (z <= HOMOGENEOUS_M[1])
    return {name: float(np.median(errors[mask]))
            for name, mask in zip(REGIONS, (inside, ~inside), strict=True)}


def published() -> dict[str, dict[str, float]]:
    """The paper's errors on the axis, of its prior and of its posterior from q_F."""
    index, prior, posterior, _ = np.loadtxt(
        HERE / "fig4_faser_on_axis.csv", delimiter=",", skiprows=1).T
    z = 0.01 * (index - (len(index) + 1) / 2)
    return {"prior": medians(z, prior), "posterior": medians(z, posterior)}


def run(arguments: argparse.Namespace) -> int:
    """Run the twin and print its table."""
    study, axis = read_study(arguments.study), read_map(HERE / "twin" / "axis.csv")
    with common.session(arguments) as session:
        update = infer(build_magnet(study), read_map(HERE / "twin" / "map.csv"), session,
                       read_blocks(HERE / "twin" / "blocks.csv"))
        points = points_of(axis)
        line = study.with_(observation=FluxDensity(
            quantity="flux_density", components=("x",), positions=PointPositions(
                kind="points", points_m=tuple(map(tuple, points.tolist())))))
        seen = observe(line, points, ~np.isnan(axis["B_T"].values))
        on_axis = response_matrix(build_magnet(line), seen,
                                  replace(session, folder=arguments.output / "axis"))
    write_files(page(update), arguments.output)
    measured = seen.apply(np.nan_to_num(axis["B_T"].values))
    blocks = json.loads((HERE / "twin" / "truth" / "truth.json").read_text())["blocks"]
    truth = np.array([one["magnetization_A_per_m"] for one in blocks]).ravel()
    known = {"prior": update.prior, "posterior": update.posterior}

    def errors(one: Gaussian) -> dict[str, float]:
        mean, _ = predict(on_axis.matrix, one)
        return medians(points[:, 2], np.abs(measured - mean) / np.abs(measured))

    results = {"paper": published(), "here": {
        name: errors(one) | error_summary(one, truth) for name, one in known.items()}}
    write_text(arguments.output / "results.json", json.dumps(results, indent=1, allow_nan=False)
               + "\n")
    write_files(page_of_magnetizations(
        build_magnet(study), known, truth, "the magnetizations of FASER's twin", ring=5),
        arguments.output)
    common.print_table(
        [{"region": region, "model": name} | {
            whose: f"{results[whose][name][region]:.2g}" for whose in results}
         for region in REGIONS for name in known],
        "Median relative error of B_x on the axis, by a model updated at 75 mm")
    z = results["here"]["posterior"]["z_rms"]
    common.say(f"Error of all {len(truth)} magnetizations over standard deviation: {z:.2f} rms.\n"
               f"Report: {arguments.output / 'report.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", HERE / "twin.toml", "faser-twin", run))
