"""Update a study's block magnetizations with a measured field map.

Writes posterior.h5, prediction.csv, summary.json, report.html and its figures, and if the map has
full circles multipoles.csv; `halbach-fe multipoles` has those of any posterior.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from halbach_fe.cli import common
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer, observation_of
from halbach_fe.inference.storage import inference_summary, write_inference
from halbach_fe.measurement.block_table import read_blocks
from halbach_fe.measurement.field_map import read_map
from halbach_fe.response.resource_estimate import estimate_infer
from halbach_fe.study.model import is_nonlinear
from halbach_fe.study.reader import read_study


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    common.add_study_arguments(parser)
    common.add_dry_run_argument(parser)
    parser.add_argument("--measurements", type=Path, required=True, metavar="MAP",
                        help="measured field map (CSV or HDF5)")
    parser.add_argument("--held-out", type=Path, metavar="MAP",
                        help="another map, which is only predicted, at positions of its own")
    parser.add_argument("--blocks", type=Path, metavar="CSV",
                        help="moments of the single blocks, in place of the study's prior")
    parser.add_argument("--samples", type=common.positive, metavar="N",
                        help="for iron with an H(B) curve: sample the non-linear posterior, N "
                        "draws of each of four chains, in place of linearizing")
    parser.add_argument("--seed", type=common.positive, default=1, metavar="N",
                        help="of the random numbers of the chains (default: %(default)s)")


def run(arguments: argparse.Namespace) -> int:
    """Infer, write everything, print the before/after table."""
    study, data = read_study(arguments.study), read_map(arguments.measurements)
    magnet = build_magnet(study)
    if arguments.samples and not is_nonlinear(study):
        raise StudyError(
            f"Input --samples must go with iron that has an H(B) curve; study {study.name} is "
            "linear, and its posterior has a closed form. Leave it out.")
    blocks = read_blocks(arguments.blocks) if arguments.blocks else None
    unseen = read_map(arguments.held_out) if arguments.held_out else None
    if arguments.dry_run:
        if arguments.samples:
            common.say("The chains of --samples are not counted.")
        found = estimate_infer(magnet, observation_of(magnet, data, blocks, unseen),
                               common.jobs(arguments))
        return common.print_estimate(found, arguments.json)
    from halbach_fe.report.inference import score_table, write_inference_report

    with common.session(arguments) as session:
        update = infer(magnet, data, session, blocks, linearized_only=bool(arguments.samples),
                       unseen=unseen)
        if arguments.samples:
            write_inference(update, arguments.output)  # should the chains not do
            from halbach_fe.inference.mcmc import sample_posterior, with_samples, write_sampled

            with common.workers(arguments) as pool:
                sampled = sample_posterior(update, session, arguments.samples,
                                           seed=arguments.seed, say=common.say, mapped=pool.map)
            update = with_samples(update, sampled)
            write_sampled(sampled, arguments.output)
    if update.response.reused:
        common.say("The response matrix of an earlier run in this folder fits and was reused.")
    write_inference(update, arguments.output)
    write_inference_report(update, arguments.output, provenance={
        "GetDP": session.getdp.version, **common.digests({
            "study file": arguments.study, "measurements": arguments.measurements,
            "held-out map": arguments.held_out, "blocks": arguments.blocks})})
    if arguments.json:
        common.print_json(inference_summary(update))
    else:
        common.print_table(score_table(update), "Median relative error, before and after")
        common.say(f"Report: {arguments.output / 'report.html'}")
    return 0
