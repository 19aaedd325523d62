"""Write the synthetic twin of the campaign: blocks, map, truth, and the profile on the axis.

By magpylib and NGSolve; needs the extra ``campaign``, and some minutes::

    python studies/faser/make_twin.py
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from halbach_fe.measurement.field_map import save_map
from halbach_fe.study.measurement_keys import FluxDensity, LinePositions
from halbach_fe.study.reader import read_study
from halbach_fe.synthetic.simulate import simulate_campaign, write_campaign

HERE = Path(__file__).parent
SEED = 4


def main() -> None:
    """Write the folder twin."""
    study = read_study(HERE / "twin.toml")
    twin = replace(simulate_campaign(study, SEED), held_out=None)  # the axis takes its place
    write_campaign(twin, HERE / "twin")
    axis = FluxDensity(quantity="flux_density", components=("x",), positions=LinePositions(
        kind="line", start_m=(0, 0, -0.775), end_m=(0, 0, 0.775), count=156))
    profile = simulate_campaign(study.with_(observation=axis),
                                SEED)  # the same magnet
    save_map(profile.readings, HERE / "twin" / "axis.csv")


if __name__ == "__main__":
    main()
