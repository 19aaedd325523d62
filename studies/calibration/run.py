"""Simulation-based calibration of the linear and the non-linear posterior, and its controls.

In the cross-section of studies/nonlinear-2d, truths are drawn from the prior. Their fields are not
those of the model that fits them: with linear iron they are a closed form, with iron that saturates
those of a mesh of half the size. The probe reads them at positions that are moved by the stated
standard deviation, with noise; the model knows neither the moves nor its own error, only their
stated sizes. The ranks of the truths among draws of the posterior must be uniform.

Three controls must fail: position noise that is not stated, the error of a coarse mesh that is not
stated, and the paper's sampler, pCN with s = 1/80 from the prior's mean, which takes too few
steps::

    python studies/calibration/run.py -o results/calibration
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from calibration_page import page
from truth_ranks import Sampler, Simulator, ranks, uniformity

from halbach_fe.cli import common
from halbach_fe.cli.shared_options import positive, positive_number
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import CheckFailedError
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.mcmc import LAPLACE_STEPS, PRIOR_STEP
from halbach_fe.measurement.observation_operator import Observation, observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.reading_noise import reading_noise
from halbach_fe.report.page import write_files
from halbach_fe.response.block_variation import with_magnetizations
from halbach_fe.response.nonlinear import NonlinearModel, nonlinear_model
from halbach_fe.response.response_matrix import Response, response_matrix
from halbach_fe.solver.ring_harmonics_2d import SectorMagnetization, layered_bore_field
from halbach_fe.solver.session import Session
from halbach_fe.stats import posteriors
from halbach_fe.stats.gaussian import Gaussian, NoiseCovariance, independent_noise, nominal_prior
from halbach_fe.stats.posteriors import Posterior, Proposal, laplace, prior_reference, sample
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study
from halbach_fe.study.reader import read_study

STUDY = Path(__file__).parent.parent / "nonlinear-2d" / "study.toml"
DRAWS, THIN, WARM_UP = 19, 4, 24
PCN_STEP, PCN_STEPS = 1 / 80, 300  # each repeat; the paper's one chain had 18 000

RADIUS_M = 0.08
"""Radius of the circle of readings. The deviations of the blocks have a gradient of their own,
which makes a tenth of the noise of positions here: the noise is estimated in the gradient of the
updated magnet."""

SIGMA_T, POSITION_SD_M = 5e-5, 3e-4
"""Standard deviations of a reading, and of the probe's position along each axis. The latter makes
twice as much noise as the former."""

LINEAR_PERMEABILITY = 1000.0
FINER = 2.0
"""Ratio of the element sizes of the model and of the truth, with iron that saturates."""

COARSE_M = 0.04
"""Element size of the control in which the model's own error is not stated. It is larger than the
noise there."""

TRUTH_RADIUS, TRUTH_ANGLES = 0.9, 192
"""Circle on which the truth is computed, relative to the inner radius of the blocks, and number of
points. Multipoles beyond that number are taken for lower ones; they are below 0.9^192 = 2e-9 of the
field."""

TOLERANCE_T = 1e-7
PASS, FAIL = 0.01, 1e-4
"""p-values, corrected for 32 parameters: above the first is calibrated, below the second is not."""


@dataclass(frozen=True)
class Truth:
    """The field in the bore of any magnetizations, at any points.

    In a cross-section B_x - i B_y is a power series of x + i y in the bore. Its coefficients are
    those of the field on a circle around all points.

    Attributes
    ----------
    on_circle : callable
        Maps magnetizations (32,) in A/m to B (angles, 2) in T at `circle`.
    radius : float
        Of the circle, in m.
    """

    on_circle: Callable[[Floats], Floats]
    radius: float

    def field(self, magnetizations: Floats, points: Floats) -> Floats:
        """Return B (n, 3) in T at points (n, 3) in m within the circle."""
        field = self.on_circle(magnetizations)
        powers = np.fft.fft(field[:, 0] - 1j * field[:, 1]) / len(field)
        z = (points[:, 0] + 1j * points[:, 1]) / self.radius
        series = np.polynomial.polynomial.polyval(z, powers[:len(field) // 2])
        return np.column_stack([series.real, -series.imag, 0 * series.real])


def circle(magnet: Magnet) -> tuple[Floats, float]:
    """Return the points (angles, 3) in m at which a truth is computed, and their radius in m."""
    radius = TRUTH_RADIUS * magnet.bore_radius
    angle = 2 * np.pi * np.arange(TRUTH_ANGLES) / TRUTH_ANGLES
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle]), radius


def closed_form_truth(magnet: Magnet, permeability: float) -> Truth:
    """Return the exact field of sectors of recoil permeability in a tube of linear iron."""
    points, radius = circle(magnet)
    array, (tube,) = magnet.array, magnet.iron
    columns = []
    for block in magnet.blocks:
        for direction in (1, 1j):
            sector = SectorMagnetization(np.radians(block.angle_deg), np.pi / len(magnet.blocks),
                                         MU_0 * block.recoil_permeability * direction)
            columns.append(layered_bore_field(
                [sector], array.inner_radius_m, array.outer_radius_m, block.recoil_permeability,
                points[:, :2], (tube.inner_radius, tube.outer_radius, permeability)))
    matrix = np.stack(columns, axis=-1)  # (angles, 2, parameters)
    return Truth(lambda p: matrix @ p, radius)


def fine_truth(study: Study, session: Session, generator: np.random.Generator) -> Truth:
    """Return the field of a finer mesh, with iron that saturates."""
    magnet = build_magnet(study.with_(
        mesh__block_size_m=study.mesh.block_size_m / FINER))
    points, radius = circle(magnet)
    model = nonlinear_model(magnet, observe(study, points, np.ones_like(points, bool)), session,
                            generator)
    return Truth(lambda p: model(p, TOLERANCE_T).reshape(-1, 2), radius)


def simulator(truth: Truth, observation: Observation) -> Simulator:
    """Return the measurement of a truth: at positions that are moved, with noise."""
    def simulate(parameters: Floats, generator: np.random.Generator) -> Floats:
        moved = observation.points + POSITION_SD_M * generator.standard_normal(
            observation.points.shape)
        readings = observation.apply(truth.field(parameters, moved))
        return readings + SIGMA_T * generator.standard_normal(len(readings))

    return simulate


def stated_noise(magnet: Magnet, observation: Observation) -> NoiseCovariance:
    """Return the noise of readings and positions as `halbach-fe infer` states it."""
    noise = magnet.study.noise
    assert noise is not None  # the study has a noise region
    stated = magnet.with_(noise=noise.with_(
        regions=(noise.regions[0].with_(sigma_T=SIGMA_T),), position_sd_m=(POSITION_SD_M,)))
    return reading_noise(stated, observation, xr.Dataset())


Noise = Callable[[Floats], NoiseCovariance]
"""Noise of the readings, with the error of the model, if blocks have magnetizations (parameters,)
in A/m; nominal ones if there are none."""


def noise_of_positions(magnet: Magnet, observation: Observation, error: Floats) -> Noise:
    """Return the noise that `halbach-fe infer` states, in the gradient of an estimated magnet."""
    def noise(magnetizations: Floats) -> NoiseCovariance:
        blocks = (with_magnetizations(magnet, magnetizations) if len(magnetizations)
                  else magnet.blocks)
        return stated_noise(replace(magnet, blocks=blocks),
                            observation).with_independent_errors(error)

    return noise


def always(noise: NoiseCovariance) -> Noise:
    """Return a noise that does not depend on the magnet."""
    return lambda magnetizations: noise


def linear_sampler(response: Response, noise: Noise, prior: Gaussian) -> Sampler:
    """Return draws of the linear posterior, in closed form, as `halbach-fe infer` finds it but for
    the multiple of the solver's error that readings share, which makes its bars longer.
    """
    matrix, nominal = response.whole, noise(np.zeros(0))

    def draw(readings: Floats, generator: np.random.Generator) -> Floats:
        residual = readings - response.offset
        mean = posteriors.posterior(matrix, residual, nominal, prior).mean
        return posteriors.posterior(matrix, residual, noise(mean), prior).sample(
            DRAWS, generator)

    return draw


def chain_sampler(model: NonlinearModel, noise: Noise, prior: Gaussian) -> Sampler:
    """Return draws of the non-linear posterior, by the Markov chains of `halbach-fe infer`."""
    nominal = noise(np.zeros(0))

    def draw(readings: Floats, generator: np.random.Generator) -> Floats:
        posterior = Posterior(lambda p: model(p, TOLERANCE_T), readings, nominal, prior)
        _, mode = laplace(posterior, model.jacobian)
        posterior = replace(posterior, noise=noise(mode))
        reference, _ = laplace(posterior, model.jacobian)
        moves = [Proposal(reference, step) for step in LAPLACE_STEPS] + [
            Proposal(prior_reference(prior), PRIOR_STEP)]
        chain = sample(posterior, moves, WARM_UP + THIN * DRAWS, generator, reference.centre)
        return chain.samples[WARM_UP::THIN]

    return draw


def short_sampler(model: NonlinearModel, noise: NoiseCovariance, prior: Gaussian) -> Sampler:
    """Return draws of the paper's chain, which is too short."""
    def draw(readings: Floats, generator: np.random.Generator) -> Floats:
        posterior = Posterior(lambda p: model(p, TOLERANCE_T), readings, noise, prior)
        chain = sample(posterior, [Proposal(prior_reference(prior), PCN_STEP)], PCN_STEPS,
                       generator, np.zeros(prior.root.shape[1]))
        return chain.samples[:: PCN_STEPS // DRAWS][:DRAWS]

    return draw


@dataclass(frozen=True)
class Case:
    """One calibration.

    Attributes
    ----------
    simulate : callable
    sampler : callable
    repeats : int
        Number of truths.
    good : bool
        Whether the ranks must be uniform; a control's must not.
    error_over_noise : float
        Stated error of the model over the stated noise, rms over the readings.
    """

    simulate: Simulator
    sampler: Sampler
    repeats: int
    good: bool
    error_over_noise: float


def linear_cases(
    study: Study, session: Session, prior: Gaussian, repeats: int
) -> dict[str, Case]:
    """Return the linear posterior, and the controls that leave something out of its noise."""
    iron = study.iron_ring
    assert iron is not None
    study = study.with_(iron_ring=iron.with_(
        curve=None, relative_permeability=LINEAR_PERMEABILITY))
    truth = closed_form_truth(build_magnet(study), LINEAR_PERMEABILITY)
    cases = {}

    def add(name: str, size: float, left_out: str = "") -> None:
        magnet = build_magnet(study.with_(mesh__block_size_m=size))
        observation = observation_of(study)
        response = response_matrix(magnet, observation, session.within(f"linear-{size:g}"))
        stated = stated_noise(magnet, observation)
        error = response.error * (left_out != "error")
        noise = noise_of_positions(magnet, observation, error)
        if left_out == "positions":
            own = independent_noise(np.full(len(observation), SIGMA_T))
            noise = always(own.with_independent_errors(error))
        cases[name] = Case(
            simulator(truth, observation), linear_sampler(response, noise, prior),
            repeats, not left_out, error_over_noise(response.error, stated))

    add("linear, closed form", study.mesh.block_size_m)
    add("control: position noise not stated", study.mesh.block_size_m, "positions")
    add("control: error of a coarse mesh not stated", COARSE_M, "error")
    return cases


def sampled_cases(
    study: Study, session: Session, prior: Gaussian, repeats: int, generator: np.random.Generator
) -> dict[str, Case]:
    """Return the sampled posterior with iron that saturates, and chains that are too short."""
    observation = observation_of(study)
    model = nonlinear_model(build_magnet(study), observation, session.within("model"), generator)
    truth = fine_truth(study, session.within("truth"), generator)
    magnet = build_magnet(study)
    stated = stated_noise(magnet, observation)
    noise = noise_of_positions(magnet, observation, model.error)
    simulate, ratio = simulator(truth, observation), error_over_noise(model.error, stated)
    return {
        "non-linear, chains": Case(simulate, chain_sampler(model, noise, prior), repeats, True,
                                   ratio),
        "control: the paper's chain, too short": Case(
            simulate, short_sampler(model, noise(np.zeros(0)), prior),
            max(40, repeats // 10), False, ratio)}


def observation_of(study: Study) -> Observation:
    """Return the readings: every second point of the study's circle."""
    points = points_from(study.observation.positions)[::2]
    return observe(study, points, np.ones_like(points, bool))


def error_over_noise(error: Floats, noise: NoiseCovariance) -> float:
    """Return the ratio of two standard deviations (readings,), rms over the readings."""
    return float(np.sqrt(np.mean(error**2) / np.mean(noise.sd**2)))


def run(arguments: argparse.Namespace) -> int:
    """Run all cases, write the ranks, print the table; CheckFailedError if one is off."""
    study = read_study(arguments.study)
    study = study.with_(mesh__block_size_m=arguments.block_size_m,
                        observation__positions__radius_m=RADIUS_M)
    generator = np.random.default_rng(arguments.seed)
    prior = nominal_prior(nominal_magnetizations(build_magnet(study)), 2, 0.01, 1.0)
    results, found = {}, {}
    with common.session(arguments) as session:
        cases = linear_cases(study, session, prior, arguments.repeats) | sampled_cases(
            study, session, prior, arguments.repeats, generator)
    for name, case in cases.items():
        common.say(f"{name}: {case.repeats} truths")
        with common.progress_bar("truths") as progress:
            found[name], draws = ranks(prior, case.simulate, case.sampler, case.repeats, generator,
                                       progress)
        values, together = uniformity(found[name], draws)
        results[name] = {
            "repeats": case.repeats, "p_value": together,
            "smallest_p_of_a_parameter": float(values.min()),
            "model_error_over_noise": case.error_over_noise,
            "as_expected": together > PASS if case.good else together < FAIL}
    write_files(page(found, DRAWS, results), arguments.output)
    common.print_table([{"what": name} | {key: f"{value:.3g}" if isinstance(value, float)
                                          else str(value) for key, value in row.items()}
                        for name, row in results.items()], "Ranks of the truth: uniform?")
    wrong = [name for name, row in results.items() if not row["as_expected"]]
    if wrong:
        raise CheckFailedError(f"Calibration is not as expected: {', '.join(wrong)}.")
    return 0


def nominal_magnetizations(magnet: Magnet) -> Floats:
    """Return the nominal M_x, M_y of all blocks (32,) in A/m."""
    return np.concatenate([
        block.remanence / (MU_0 * block.recoil_permeability) * np.array(block.easy_axis)[:2]
        for block in magnet.blocks])


def options(parser: argparse.ArgumentParser) -> None:
    """Add this study's own options."""
    parser.add_argument("--repeats", type=positive, default=500, metavar="N",
                        help="truths drawn (default: %(default)s)")
    parser.add_argument("--seed", type=positive, default=5, metavar="N")
    parser.add_argument("--block-size-m", type=positive_number, default=0.01,
                        help="of the mesh (default: %(default)s)")


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", STUDY, "calibration", run, options))
