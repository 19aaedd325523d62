"""Simulate a measurement campaign of a magnet whose blocks are not quite what was ordered.

Magnetizations are drawn from the study's prior; the field is by magpylib and NGSolve, never by
halbach-fe's own model. Writes blocks.csv (single blocks in a Helmholtz coil), map.csv, held-out.csv
(half a step between the map's points), truth/truth.json, sealed: the maps name its SHA-256, and
campaign.html with its figures, which show nothing of the truth.
"""

from __future__ import annotations

import argparse

import numpy as np

from halbach_fe.cli import common
from halbach_fe.study.reader import read_study
from halbach_fe.synthetic.hidden_effects import (
    EFFECTS,
    RequestedEffect,
    parse_hidden_effect,
    signature,
)
from halbach_fe.synthetic.ngsolve_reaction import Elements
from halbach_fe.synthetic.simulate import COIL_SD, simulate_campaign, write_campaign


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this verb's options."""
    parser.epilog = "effects to hide:\n" + "\n".join(
        f"  {name}" + (f"={signature(effect)}" if effect.parameters else "")
        for name, effect in EFFECTS.items())
    common.add_study_and_output(parser)
    parser.add_argument("--seed", type=common.positive, default=1, metavar="N",
                        help="of all random numbers (default: %(default)s)")
    parser.add_argument("--coil-sd", type=common.positive_number, default=COIL_SD, metavar="F",
                        help="noise of a block's measured moment, relative (default: %(default)g)")
    parser.add_argument("--hide", type=_effect, action="append", default=[],
                        metavar="NAME[=VALUE,...]",
                        help="an effect that the truth has and the study does not, of a random "
                        "size unless its values are given; again for several")
    parser.add_argument("--hide-random", type=common.positive, default=0, metavar="K",
                        help="hide K effects of the field or the instrument, drawn at random")
    parser.add_argument("--element-size", type=common.positive_number, metavar="M",
                        help="largest element of NGSolve in m (default: a third of the blocks' "
                        "thickness, in 2D half of that)")
    parser.add_argument("--order", type=common.positive, metavar="N",
                        help="order of NGSolve's elements (default: 3, in 2D 5)")
    common.add_json_argument(parser)


def _effect(text: str) -> RequestedEffect:
    try:
        return parse_hidden_effect(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def run(arguments: argparse.Namespace) -> int:
    """Simulate, write everything, print what was written."""
    from halbach_fe.report.campaign import write_campaign_page  # matplotlib loads when needed

    study = read_study(arguments.study)
    elements = Elements(arguments.element_size, arguments.order)
    with common.progress_bar("magpylib") as show:
        campaign = simulate_campaign(study, arguments.seed, arguments.coil_sd, arguments.hide,
                            arguments.hide_random, elements, show)
    written = write_campaign(campaign, arguments.output)
    write_campaign_page(study, campaign.readings, campaign.held_out, campaign.blocks,
                        arguments.output, [common.digest(path) for path in written])
    summary = {
        "study": study.name, "points": campaign.readings.sizes["point"],
        "readings": int(np.isfinite(campaign.readings["B_T"].values).sum()),
        "blocks": len(campaign.blocks), "model": campaign.truth["model"],
        "truth_sha256": campaign.readings.attrs["truth_sha256"],
        "files": [str(path) for path in written]}
    if arguments.json:
        common.print_json(summary)
    else:
        common.print_table([{"what": key, "value": str(value)} for key, value in summary.items()])
        common.say(f"Report: {arguments.output / 'campaign.html'}")
    return 0
