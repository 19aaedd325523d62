"""Update a study's block magnetizations with a measured field map.

Writes posterior.h5, prediction.csv, summary.json, report.html and its figures, and, if the map has
full circles, multipoles.csv. `halbach-fe multipoles` computes the multipoles from posterior.h5 for
any map. If the study lists maps, all of them update the magnet together, and test each other where
they overlap. Terms of instruments of which the study states a standard deviation are estimated with
the magnetizations; study.updated.toml, the study's own file, then has the instruments that were
found.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from halbach_fe.cli import common
from halbach_fe.core.errors import StudyError, must_be


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    from halbach_fe.cli.format_options import add_map_format_arguments

    common.add_study_arguments(parser)
    common.add_dry_run_argument(parser)
    common.add_measurement_arguments(parser, several=True)
    common.add_held_out_argument(parser)
    add_map_format_arguments(parser, "--measurements and --held-out")
    parser.add_argument("--samples", type=common.positive, metavar="N",
                        help="for iron with an H(B) curve: sample the non-linear posterior by four "
                        "Markov chains of N draws each, instead of linearizing")
    parser.add_argument("--seed", type=common.positive, metavar="N",
                        help="seed of the random numbers of the chains of --samples (default: 1)")


def run(arguments: argparse.Namespace) -> int:
    """Infer, write the results, print the table of errors before and after."""
    from halbach_fe.geometry.magnet import build_magnet
    from halbach_fe.inference.infer import infer, observation_of
    from halbach_fe.inference.storage import write_inference
    from halbach_fe.measurement.campaign import refuse_open_instruments, refuse_uncertain
    from halbach_fe.measurement.field_map import refuse_total_field
    from halbach_fe.report.inference import page
    from halbach_fe.response.magnetic_axis import magnetic_axis
    from halbach_fe.response.stray_field import stray_field
    from halbach_fe.study.reader import read_study

    study = read_study(arguments.study)
    magnet = build_magnet(study)
    data = common.read_measurements(arguments, study)
    blocks, validation_map = common.blocks_and_held_out(arguments)
    if arguments.samples and not magnet.is_nonlinear:
        raise StudyError(
            f"Input --samples must go with iron that has an H(B) curve; study {magnet.name} is "
            "linear, and its posterior has a closed form. Leave it out.")
    if arguments.seed and not arguments.samples:
        raise StudyError(must_be(
            "--seed", "the command line", "beside --samples, whose chains alone are random",
            "given alone", "Leave it out."))
    if arguments.samples:
        from halbach_fe.inference.mcmc import check_sampling

        check_sampling(magnet)
        refuse_open_instruments(study, "--samples")
        for one in [validation_map, *(data.values() if isinstance(data, dict) else [data])]:
            if one is not None:
                refuse_total_field(one, "--samples")
        refuse_uncertain(study, "--samples")
    if arguments.dry_run:
        from halbach_fe.response.resource_estimate import estimate_infer

        if arguments.samples:
            common.say("The estimate does not include the chains of --samples.")
        observation = observation_of(magnet, data, blocks, validation_map)
        return common.print_estimate(
            estimate_infer(magnet, observation, common.jobs(arguments)), arguments.json)
    with common.session(arguments, study) as session:
        result = infer(magnet, data, session, blocks, linearized_only=bool(arguments.samples),
                       validation_map=validation_map, say=common.say)
        if arguments.samples:
            from halbach_fe.inference.mcmc import sample_posterior, with_samples, write_sampled

            write_inference(result, arguments.output)  # to be kept even if the chains fail
            with common.workers(arguments) as pool:
                sampled = sample_posterior(
                    result, session, arguments.samples, seed=arguments.seed or 1, say=common.say,
                    mapped=pool.map)
            result = with_samples(result, sampled)
            write_sampled(sampled, arguments.output)
        result = replace(
            result, magnetic_axis=magnetic_axis(magnet, session, result.posterior),
            stray_field=stray_field(magnet, session, result.posterior))
    if result.response.reused:
        common.say("The response matrix of an earlier run in this folder fits and was reused.")
    return common.finish(arguments, page(result))
