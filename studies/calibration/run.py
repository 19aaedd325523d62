"""Simulation-based calibration of the linear and the non-linear posterior, and a control.

In the cross-section of studies/nonlinear-2d: truths drawn from a prior, readings from the model
with noise, posteriors sampled, and the ranks of the truths tested for uniformity. The paper's
sampler, pCN with s = 1/80 from the prior's mean, is the control: so few steps must fail::

    python studies/calibration/run.py -o results/calibration
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
from halbach_fe.core.errors import CheckFailedError
from halbach_fe.core.files import write_text
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.mcmc import LAPLACE_STEPS, PRIOR_STEP
from halbach_fe.measurement.observation import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.report.calibration import write_calibration
from halbach_fe.response.nonlinear import nonlinear_model
from halbach_fe.stats import linear_gaussian
from halbach_fe.stats.gaussian import nominal_prior
from halbach_fe.stats.noise import independent_noise
from halbach_fe.stats.pcn import Posterior, Proposal, laplace, prior_reference, sample
from halbach_fe.stats.sbc import ranks, uniformity
from halbach_fe.study.reader import read_study

STUDY = Path(__file__).parent.parent / "nonlinear-2d" / "study.toml"
DRAWS, THIN, WARM_UP = 99, 4, 40
PCN_STEP, PCN_STEPS = 1 / 80, 1000  # each repeat; the paper's one chain had 18 000
SIGMA_T = 1e-4
TOLERANCE_T = 1e-7
PASS, FAIL = 0.01, 1e-4
"""p-values, corrected for 32 parameters: above the first is calibrated, below the second is not."""


def run(arguments: argparse.Namespace) -> int:
    """Run all three, write the ranks, print the table; CheckFailedError if one is off."""
    study = read_study(arguments.study)
    study = study.with_(mesh__block_size_m=arguments.block_size_m)
    points = points_from(study.observation.positions)[::2]
    measured = np.ones_like(points, bool)
    observation = observe(study, points, measured)
    generator = np.random.default_rng(arguments.seed)
    with common.session(arguments) as session:
        model = nonlinear_model(build_magnet(study), observation, replace(
            session, folder=session.folder / "model"), generator)
    prior = nominal_prior(model.nominal, 2, 0.01, 1.0)
    noise = independent_noise(np.full(len(observation), SIGMA_T))
    tangent = model.jacobian(model.nominal)

    def closed_form(readings: Floats, generator: np.random.Generator) -> Floats:
        return linear_gaussian.posterior(tangent, readings, noise, prior).sample(DRAWS, generator)

    def target(readings: Floats) -> Posterior:
        return Posterior(lambda p: model(p, TOLERANCE_T), readings, noise, prior)

    def chains(readings: Floats, generator: np.random.Generator) -> Floats:
        posterior = target(readings)
        reference, _ = laplace(posterior, model.jacobian)
        moves = [Proposal(reference, step) for step in LAPLACE_STEPS] + [
            Proposal(prior_reference(prior), PRIOR_STEP)]
        chain = sample(posterior, moves, WARM_UP + THIN * DRAWS, generator, reference.centre)
        return chain.samples[WARM_UP::THIN]

    def short(readings: Floats, generator: np.random.Generator) -> Floats:
        chain = sample(target(readings), [Proposal(prior_reference(prior), PCN_STEP)], PCN_STEPS,
                       generator, np.zeros(prior.root.shape[1]))
        return chain.samples[:: PCN_STEPS // DRAWS][:DRAWS]

    cases = {
        "linear, closed form": (lambda p: tangent @ p, closed_form, arguments.repeats, True),
        "non-linear, chains": (lambda p: model(p, TOLERANCE_T), chains, arguments.repeats, True),
        "control: the paper's chain, too short": (
            lambda p: model(p, TOLERANCE_T), short, max(40, arguments.repeats // 5), False)}
    results, found = {}, {}
    for name, (forward, sampler, repeats, good) in cases.items():
        common.say(f"{name}: {repeats} truths")
        found[name], draws = ranks(prior, forward, noise, sampler, repeats, generator)
        values, together = uniformity(found[name], draws)
        results[name] = {"repeats": repeats, "p_value": together,
                         "smallest_p_of_a_parameter": float(values.min()),
                         "as_expected": together > PASS if good else together < FAIL}
    write_calibration(found, DRAWS, results, arguments.output)
    write_text(arguments.output / "calibration.json", json.dumps(results, indent=1) + "\n")
    common.print_table([{"what": name} | {key: f"{value:.3g}" if isinstance(value, float)
                                          else str(value) for key, value in row.items()}
                        for name, row in results.items()], "Ranks of the truth: uniform?")
    wrong = [name for name, row in results.items() if not row["as_expected"]]
    if wrong:
        raise CheckFailedError(f"Calibration is not as expected: {', '.join(wrong)}.")
    return 0


def options(parser: argparse.ArgumentParser) -> None:
    """Add this study's own options."""
    parser.add_argument("--repeats", type=common.positive, default=200, metavar="N",
                        help="truths drawn (default: %(default)s)")
    parser.add_argument("--seed", type=common.positive, default=5, metavar="N")
    parser.add_argument("--block-size-m", type=float, default=0.02,
                        help="of the mesh (default: %(default)s)")


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", STUDY, "calibration", run, options))
