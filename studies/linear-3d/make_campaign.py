"""Write the field of the study, without noise, and the magnetizations that make it.

By magpylib and NGSolve; needs the extra ``campaign``, and some minutes::

    python studies/linear-3d/make_campaign.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from halbach_fe.measurement.field_map import field_map, save_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.study.reader import read_study
from halbach_fe.synthetic.ngsolve_reaction import Elements
from halbach_fe.synthetic.simulate import draw_magnet, model_of, true_field
from halbach_fe.synthetic.true_magnet_of_study import magnet_of

HERE = Path(__file__).parent
SEED = 3
ELEMENTS = Elements(order=5)
"""Within 1e-6 T rms of another formulation of order 6, and of the study's own model."""


def main() -> None:
    """Write field.h5 and truth.csv."""
    study = read_study(HERE / "study.toml")
    points = points_from(study.observation.positions)
    magnet = draw_magnet(study, magnet_of(study), np.random.default_rng(SEED)).mounted
    field = true_field(magnet, points, ELEMENTS).astype(np.float32)  # to 3e-8 T, to be stored
    save_map(field_map(points, field, attributes={
        "source": ", ".join(model_of(magnet).values()) + f", magnetizations of seed {SEED}"}),
        HERE / "field.h5")
    np.savetxt(HERE / "truth.csv", [body.magnetization for body in magnet.bodies], "%.6f", ",",
               header="Mx_A_per_m,My_A_per_m,Mz_A_per_m", comments="")


if __name__ == "__main__":
    main()
