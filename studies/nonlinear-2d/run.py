"""The paper's non-linear validation: 32 magnetizations in a steel ring, from B on a circle.

The prior is the paper's (Fig. 3); the maps are NGSolve's, of the truth that the paper publishes and
of one drawn from that prior (make_campaign.py)::

    python studies/nonlinear-2d/run.py -o results/nonlinear-2d
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from halbach_fe.cli import common
from halbach_fe.cli.shared_options import positive
from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.mcmc import sample_posterior, sampled_summary, with_samples, write_sampled
from halbach_fe.measurement.field_map import read_map
from halbach_fe.report.page import write_files
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.model import Study
from halbach_fe.study.reader import read_study

sys.path.append(str(Path(__file__).parents[1]))  # for what several studies share
from magnetizations_page import error_summary, page

HERE = Path(__file__).parent
CASES = {"paper": "the paper's truth", "drawn": "a truth drawn from the prior"}
EFFECTIVE = 1000.0


def published(study: Study) -> tuple[Gaussian, dict[str, float]]:
    """The paper's prior, and its own figures."""
    table = np.genfromtxt(HERE / "fig3_nonlinear_2d_dM.csv", delimiter=",", names=True)

    def by_block(values: Floats) -> Floats:
        return values.reshape(2, -1).T.ravel()

    nominal = np.concatenate([block.magnetization[:2] for block in build_magnet(study).blocks])
    sd = {name: np.abs(table[f"{name}_edge_1_A_per_m"] - table[f"{name}_edge_2_A_per_m"]) / 2
          for name in ("prior", "posterior_B")}
    error = table["posterior_B_mean_A_per_m"] - table["truth_A_per_m"]
    prior = Gaussian(nominal + by_block(table["prior_mean_A_per_m"]), np.diag(by_block(
        sd["prior"])))
    return prior, {"rms_error_A_per_m": float(np.sqrt(np.mean(error**2))),
                   "largest_error_A_per_m": float(np.abs(error).max()),
                   "z_rms": float(np.sqrt(np.mean((error / sd["posterior_B"]) ** 2)))}


def run(arguments: argparse.Namespace) -> int:
    """Run both cases and print their table."""
    study = read_study(arguments.study)
    prior, paper = published(study)
    results: dict[str, dict[str, object]] = {"paper, posterior": dict(paper)}
    for case, what in CASES.items():
        truth = np.loadtxt(HERE / f"truth-{case}.csv", delimiter=",", skiprows=1).ravel()
        folder = arguments.output / case
        with common.session(arguments) as session:
            there = replace(session, folder=folder)
            update = infer(build_magnet(study), read_map(HERE / f"map-{case}.csv"), there,
                           prior=prior)
            with common.workers(arguments) as pool:
                found = sample_posterior(update, there, arguments.samples, effective=EFFECTIVE,
                                         say=common.say, mapped=pool.map)
        write_sampled(found, folder)
        updated = with_samples(update, found)
        results[f"{what}: prior"] = dict(error_summary(prior, truth))
        results[f"{what}: posterior"] = error_summary(
            updated.posterior, truth) | sampled_summary(found)
        write_files(page(
            build_magnet(study), {"prior": prior, "posterior": updated.posterior}, truth,
            f"the magnetizations of {what}", sampled_summary(found)), folder)
    write_text(arguments.output / "results.json", json.dumps(results, indent=1, allow_nan=False)
               + "\n")
    common.print_table([{"what": name} | {key: f"{row[key]:.4g}" for key in paper}
                        for name, row in results.items()],
                       "Magnetizations: error, and error over standard deviation")
    common.say(f"Reports: {arguments.output}/*/magnetizations.html")
    return 0


def options(parser: argparse.ArgumentParser) -> None:
    """Add this study's own options."""
    parser.add_argument("--samples", type=positive, default=1500,
                        help="draws of each chain (default: %(default)s)")


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", HERE / "study.toml", "nonlinear-2d", run, options))
