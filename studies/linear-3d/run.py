"""The paper's linear validation: 576 magnetizations from B, and from its Fourier coefficients.

The field is magpylib's and NGSolve's (make_campaign.py); the noise is the paper's::

    python studies/linear-3d/run.py -o results/linear-3d
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
from halbach_fe.inference.posterior_files import write_inference
from halbach_fe.measurement.field_map import field_map, points_of, read_map, write_map
from halbach_fe.report.page import write_files
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.measurement_keys import FourierCoefficients
from halbach_fe.study.model import Study
from halbach_fe.study.reader import read_study

sys.path.append(str(Path(__file__).parents[1]))  # for what several studies share
from magnetizations_page import error_summary, expected_spread, page

HERE = Path(__file__).parent
SEED = 11
FOURIER_SIGMA_T = 1e-6
HARMONICS = 8
RING = 5
COMPONENTS = ("Mx", "Mz")
DRAWS = 500


def published() -> dict[str, dict[str, float]]:
    """Reductions of the largest error, and rms of error over sd, in the paper's ring 5."""
    rows: dict[str, dict[str, float]] = {}
    for reading in ("B", "F"):
        for component in COMPONENTS:
            table = np.genfromtxt(HERE / f"fig2_linear_ring5_d{component}.csv", delimiter=",",
                                  names=True)
            before, after = (table[f"{name}_mean_A_per_m"] - table["truth_A_per_m"]
                             for name in ("prior", f"posterior_{reading}"))
            sd = np.abs(table[f"posterior_{reading}_edge_1_A_per_m"]
                        - table[f"posterior_{reading}_edge_2_A_per_m"]) / 2
            rows.setdefault(reading, {})[f"reduction_{component}"] = reduction(before, after)
            rows[reading][f"z_rms_{component}"] = float(np.sqrt(np.mean((after / sd) ** 2)))
    return rows


def reduction(before: Floats, after: Floats) -> float:
    """By how much the largest error shrank."""
    return float(1 - np.abs(after).max() / np.abs(before).max())


def fourier(study: Study) -> Study:
    """The same study, observing Fourier coefficients."""
    positions = study.observation.positions
    assert positions.kind == "circles"
    return study.with_(name=f"{study.name}-fourier", observation=FourierCoefficients(
        quantity="fourier_coefficients", harmonics=HARMONICS, positions=positions))


def figures(prior: Gaussian, posterior: Gaussian, truth: Floats) -> dict[str, float]:
    """What is compared with the paper, of the paper's ring and of all; and what chance would do.

    ``z_rms_spread`` is the standard deviation of ``z_rms`` that the posterior itself foretells (its
    errors are correlated: what readings leave open are few combinations); ``chi2_per_parameter``
    knows the correlations.
    """
    found: dict[str, float] = {}
    generator = np.random.default_rng(SEED)
    values, vectors = np.linalg.eigh(prior.covariance - posterior.covariance)
    learnt = Gaussian(0 * truth, vectors * np.sqrt(np.maximum(values, 0)))
    after_draws = Gaussian(0 * truth, posterior.root).sample(DRAWS, generator)
    draws = after_draws + learnt.sample(DRAWS, generator), after_draws  # the prior's errors first
    for component in COMPONENTS:
        axis = "xyz".index(component[1])

        def of(errors: Floats, axis: int = axis) -> Floats:
            return np.asarray(errors.reshape(*errors.shape[:-1], 12, -1, 3)[..., axis])

        before, after = of(prior.mean - truth), of(posterior.mean - truth)
        found[f"reduction_{component}"] = reduction(before[RING - 1], after[RING - 1])
        found[f"reduction_{component}_all_rings"] = reduction(before, after)
        for percent in (5, 95):
            found[f"reduction_{component}_of_{percent}_percent"] = float(np.percentile(
                [reduction(of(one)[RING - 1], of(other)[RING - 1])
                 for one, other in zip(*draws, strict=True)], percent))
    error, covariance = posterior.mean - truth, posterior.covariance
    return found | error_summary(posterior, truth) | {
        "z_rms_spread": expected_spread(posterior),
        "chi2_per_parameter": float(error @ np.linalg.solve(covariance, error) / len(truth))}


def run(arguments: argparse.Namespace) -> int:
    """Run both inferences and print their table."""
    study, field = read_study(arguments.study), read_map(HERE / "field.h5")
    truth = np.loadtxt(HERE / "truth.csv", delimiter=",", skiprows=1).ravel()
    points, generator = points_of(field), np.random.default_rng(SEED)
    assert study.noise is not None
    cases = {"B": (study, study.noise.regions[0].sigma_T),
             # n equally spaced points average their noise to sigma sqrt(2/n) in a coefficient
             "F": (fourier(study),
                   FOURIER_SIGMA_T * np.sqrt(study.observation.positions.angles / 2))}
    known: dict[str, Gaussian] = {}
    results: dict[str, dict[str, dict[str, float]]] = {"paper": published(), "here": {}}
    for reading, (one, sigma) in cases.items():
        noisy = field["B_T"].values + sigma * generator.standard_normal((len(points), 3))
        measured = field_map(points, noisy, np.full(noisy.shape, sigma),
                             dict(field.attrs) | {"noise": f"{sigma:g} T, seed {SEED}"})
        folder = arguments.output / reading
        write_map(measured, folder / "map.h5")
        with common.session(arguments) as session:
            update = infer(build_magnet(one), measured, replace(session, folder=folder))
        write_inference(update, folder)
        known = {"prior": update.prior} | known | {f"posterior from {reading}": update.posterior}
        results["here"][reading] = figures(update.prior, update.posterior, truth)
        common.say(f"q_{reading}: {len(update.readings)} readings, solver's error up to "
                   f"{update.response.error.max():.1e} T, "
                   f"{update.parameters_learnt:.0f} parameters learnt")
    write_text(arguments.output / "results.json", json.dumps(results, indent=1, allow_nan=False)
               + "\n")
    write_files(page(
        build_magnet(study), known, truth, "576 magnetizations from a map of the bore",
        {f"{whose}, q_{reading}, {name}": value for whose, one in results.items()
         for reading, row in one.items() for name, value in row.items()}, ring=RING),
        arguments.output)
    common.print_table(
        [{"readings": f"q_{reading}", "figure": name} | {
            "paper": f"{paper[name]:.2f}" if name in paper else "-",
            "here": f"{value:.4g}"}
         for reading, row in results["here"].items() for paper in [results["paper"][reading]]
         for name, value in row.items()],
        "Reduction of the largest error of ring 5, and errors of all 576 magnetizations")
    common.say(f"Report: {arguments.output / 'magnetizations.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", HERE / "study.toml", "linear-3d", run))
