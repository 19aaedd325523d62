"""Write the synthetic campaigns of the study.

Fields are by magpylib and NGSolve (another mesher, order 5, the steel's law written anew), with
noise. Needs ``halbach-fe[campaign]``::

    python studies/nonlinear-2d/make_campaign.py

``map-paper.csv`` is of the truth that the paper publishes; ``map-drawn.csv`` of one drawn from the
paper's prior, as which the published one, 0.44 of the prior's standard deviations away, is not.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map, save_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.study.reader import read_study
from halbach_fe.synthetic.ngsolve_reaction import Elements
from halbach_fe.synthetic.simulate import true_field
from halbach_fe.synthetic.true_magnet_of_study import magnet_of

HERE = Path(__file__).parent
SEED = 3


def main() -> None:
    """Write maps and truths."""
    study = read_study(HERE / "study.toml")
    points = points_from(study.observation.positions)
    table = np.genfromtxt(HERE / "fig3_nonlinear_2d_dM.csv", delimiter=",", names=True)
    generator = np.random.default_rng(SEED)
    nominal = np.array([block.magnetization[:2] for block in build_magnet(study).blocks])
    sd = np.abs(table["prior_edge_1_A_per_m"] - table["prior_edge_2_A_per_m"]) / 2
    drawn = table["prior_mean_A_per_m"] + sd * generator.standard_normal(len(sd))
    assert study.noise is not None
    sigma = study.noise.regions[0].sigma_T
    for name, deviation in (("paper", table["truth_A_per_m"]), ("drawn", drawn)):
        truth = nominal + deviation.reshape(2, -1).T
        field = true_field(magnet_of(study).with_magnetizations(truth), points, Elements(0.01))
        field[:, :2] += sigma * generator.standard_normal((len(points), 2))
        field[:, 2] = np.nan
        save_map(field_map(points, field, attributes={
            "source": f"magpylib and NGSolve, order 5, {name} magnetizations",
            "noise": f"{sigma:g} T, seed {SEED}"}), HERE / f"map-{name}.csv")
        np.savetxt(HERE / f"truth-{name}.csv", truth, "%.6f", ",", header="Mx_A_per_m,My_A_per_m",
                   comments="")


if __name__ == "__main__":
    main()
