"""Write the synthetic campaign of the study: the paper's truth, its field by NGSolve (another
mesher, order 5, the steel's law written anew), and noise. Needs the tests' dependencies::

    python -m studies.nonlinear-2d.make_campaign
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import ngsolve
import numpy as np

from halbach_fe.blocks import blocks_of
from halbach_fe.field_map import field_map, write_map
from halbach_fe.observation import points_from
from halbach_fe.study import read_study
from tests.oracles import ngsolve_nonlinear, section_of

HERE = Path(__file__).parent
SEED = 3


def main() -> None:
    """Write map.csv."""
    study = read_study(HERE / "study.toml")
    points = points_from(study.observation.positions)
    table = np.genfromtxt(HERE / "fig3_nonlinear_2d_dM.csv", delimiter=",", names=True)
    nominal = np.array([block.magnetization[:2] for block in blocks_of(study)])
    truth = nominal + table["truth_A_per_m"].reshape(2, -1).T
    section = replace(section_of(study), magnetizations=truth)
    with ngsolve.TaskManager():
        mesh = ngsolve_nonlinear.disk(section, 0.01)
        field = ngsolve_nonlinear.section_field(section, mesh, 5, points)
    assert study.noise is not None
    sigma = study.noise.regions[0].sigma_T
    field[:, :2] += sigma * np.random.default_rng(SEED).standard_normal((len(points), 2))
    field[:, 2] = np.nan
    write_map(field_map(points, field, attributes={
        "source": "NGSolve, order 5, magnetizations of the paper's Fig. 3",
        "noise": f"{sigma:g} T, seed {SEED}"}), HERE / "map.csv")


if __name__ == "__main__":
    main()
