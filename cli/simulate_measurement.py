"""Simulate a measurement campaign of a magnet whose blocks deviate from their nominal values.

Magnetizations are drawn from the study's prior. magpylib and NGSolve compute the field, never
halbach-fe's own model. Writes blocks.csv (single blocks in a Helmholtz coil), map.csv, held-out.csv
(points halfway between those of the map), truth/truth.json, and campaign.html with its figures,
which do not reveal the truth. The maps name the SHA-256 of truth.json, so that the truth cannot be
changed afterwards.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

from halbach_fe.cli import common
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import read_blocks
from halbach_fe.measurement.instrument import check_total_field
from halbach_fe.study.reader import read_study
from halbach_fe.synthetic.hidden_effects import (
    EFFECTS,
    RequestedEffect,
    parse_hidden_effect,
    signature,
)
from halbach_fe.synthetic.ngsolve_reaction import Elements
from halbach_fe.synthetic.simulate import COIL_SD, simulate_campaign


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.epilog = "effects to hide:\n" + "\n".join(
        f"  {name}" + (f"={signature(effect)}" if effect.parameters else "")
        for name, effect in EFFECTS.items())
    common.add_study_and_output(parser)
    parser.add_argument("--seed", type=common.positive, default=1, metavar="N",
                        help="seed of the random numbers (default: %(default)s)")
    parser.add_argument("--coil-sd", type=common.within(common.finite_number, 1e-9, 0.3),
                        default=COIL_SD, metavar="F",
                        help="noise of the measured moment of a block, relative to the moment "
                        "(default: %(default)g)")
    parser.add_argument("--placed", type=common.input_file, metavar="CSV",
                        help="assemble the blocks of this seed in the places of this table: the "
                        "blocks.sorted.csv that halbach-fe sort made of the blocks.csv of an "
                        "earlier simulation with the same seed")
    parser.add_argument("--hide", type=_effect, action="append", default=[],
                        metavar="NAME[=VALUE,...]",
                        help="hide an effect: the simulated magnet has it, the study does not; "
                        "its size is random unless VALUE is given; may be repeated")
    parser.add_argument("--hide-random", type=common.positive, default=0, metavar="K",
                        help="hide K effects of the field or the instrument that are drawn at "
                        "random")
    parser.add_argument("--component", choices=("abs",),
                        help="make maps of |B| alone, as of an NMR teslameter; the components of B "
                        "are those of observation.components in the study")
    parser.add_argument("--element-size", type=common.within(common.finite_number, 1e-5, 10),
                        metavar="M",
                        help="size in m of the largest elements of NGSolve (default: a third of "
                        "the blocks' thickness, in 2D half of that)")
    parser.add_argument("--order", type=common.within(common.whole, 1, 10), metavar="N",
                        help="order of NGSolve's elements (default: 3 in 3D, 5 in 2D)")
    common.add_json_argument(parser)


def _effect(text: str) -> RequestedEffect:
    """Parse ``NAME`` or ``NAME=VALUE,...``."""
    try:
        return parse_hidden_effect(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def run(arguments: argparse.Namespace) -> int:
    """Simulate the campaign, write the results, print a summary."""
    from halbach_fe.report.campaign import page

    study = read_study(arguments.study)
    magnet = build_magnet(study)  # refuses, as every command does, what cannot be built
    if arguments.component == "abs":
        check_total_field(study.instrument)
    # before the simulation, which may take long; a refused study leaves no folder all the same
    common.own_folder(arguments, "halbach-fe simulate-measurement", study.name)
    elements = Elements(arguments.element_size, arguments.order)
    placed = read_blocks(arguments.placed) if arguments.placed else None
    said = arguments.json

    def progress(done: int, total: int) -> None:
        """Say that the computation has begun: what is hidden has been checked by then."""
        nonlocal said
        if not said:
            common.say("Computing the field with magpylib" + (
                "." if magnet.is_vacuum else " and NGSolve, which may take minutes."))
        said = True
        show(done, total)

    with common.progress_bar("magpylib") as show:
        campaign = simulate_campaign(study, arguments.seed, arguments.coil_sd, arguments.hide,
                                     arguments.hide_random, elements, progress, placed,
                                     arguments.component == "abs")
    made = page(campaign)
    return common.finish(arguments, replace(made, summary={**made.summary, "files": [
        str(arguments.output / name) for name in made.files]}))
