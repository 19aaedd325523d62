"""Sensitivity of the field to the blocks, and where to measure it, in a cross-section with iron.

The map of |B'| for block 13 is that of the paper's figure 1; the plans choose positions on the
paper's circle, and wherever a probe could go::

    python studies/sensitivity/run.py -o results/sensitivity
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import sensitivity_page
from sensitivity_page import Sensitivity, plan_rows

from halbach_fe.cli import common
from halbach_fe.core.arrays import Floats
from halbach_fe.core.numbers import MU_0
from halbach_fe.design.measurement_plan import plan_measurement
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.report.page import write_files
from halbach_fe.report.plan_page import page, plan_summary
from halbach_fe.response.response_matrix import Response, response_matrix
from halbach_fe.solver.magnetostatics import solve_sources, solve_tangent
from halbach_fe.solver.routes import choose_route
from halbach_fe.solver.session import Session
from halbach_fe.study.model import Study, curve_of
from halbach_fe.study.reader import read_study

HERE = Path(__file__).parent
BLOCK = 13
"""Slot of the paper's figure."""

MAP_HALF_WIDTH_M, MAP_POINTS = 0.25, 201


def gateaux_derivative(magnet: Magnet, block: int, points: Floats, session: Session) -> Floats:
    """Derivative (n, 3) in T m/A of B along the nominal magnetization of a block, counted from 0.

    The points (n, 3) in m may be in magnet and iron, which is at its operating point in the nominal
    array.
    """
    # Solve for B itself by a vector potential: in materials the field in vacuum has no exact form
    # to which a reaction could be added, and the gradient of the scalar potential is H, not B.
    direct = magnet.with_(solver__method="direct", solver__route="auto")
    formulation = choose_route(direct, points).formulation(direct)
    if magnet.is_nonlinear:
        fields = solve_tangent(direct, points, (block,), session, formulation, anywhere=True)[1]
    else:
        fields = solve_sources(direct, points, (block,), session, formulation, anywhere=True)
    size, changed = magnet.dimension, magnet.blocks[block]
    # the change of remanence in T for a change of magnetization by 1 A/m along the easy axis
    remanence = MU_0 * changed.recoil_tensor @ np.array(changed.easy_axis)
    return np.einsum("knc,k->nc", fields[1:1 + size], remanence[:size])


def plane(study: Study, session: Session) -> tuple[Floats, Floats]:
    """The map's axis (n,) in m, and |B'| (n, n) in T m/A."""
    # off the lines of symmetry, where the derivative of an edge between elements is two-valued
    axis = np.linspace(-MAP_HALF_WIDTH_M, MAP_HALF_WIDTH_M, MAP_POINTS) + 1e-6
    x, y = np.meshgrid(axis, axis)
    points = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    found = gateaux_derivative(build_magnet(study), BLOCK - 1, points, session)
    return axis, np.linalg.norm(found, axis=1).reshape(x.shape)


def by_block(study: Study, model: Response) -> tuple[Floats, Floats]:
    """|B'| (readings, blocks) in T for 1 % more magnetization, and for a turn of 1 degree."""
    size = []
    for turned in (False, True):
        columns = []
        for number, block in enumerate(build_magnet(study).blocks):
            x, y = block.magnetization[:2]
            change = 0.01 * np.array([x, y]) if not turned else np.radians(1) * np.array([-y, x])
            column = model.matrix[:, 2 * number:2 * number + 2] @ change
            columns.append(np.linalg.norm(column.reshape(-1, 2), axis=1))
        size.append(np.column_stack(columns))
    return size[0], size[1]


def printed_form_error(study: Study, model: Response, session: Session) -> float:
    """Largest relative error on the circle if the iron is that of the derivative's own, small,
    field: at its initial permeability.
    """
    curve, ring = curve_of(study), study.iron_ring
    assert curve is not None
    assert ring is not None
    initial = study.with_(iron_ring=ring.with_(curve=None, relative_permeability=curve.initial))
    points = points_from(study.observation.positions)
    other = response_matrix(build_magnet(initial),
                            observe(study, points, np.ones_like(points, bool)),
                     replace(session, folder=session.folder / "printed-form"))
    column = 2 * (BLOCK - 1)
    change = build_magnet(study).blocks[BLOCK - 1].magnetization[:2]
    ours, theirs = (one.matrix[:, column:column + 2] @ change for one in (model, other))
    return float(np.abs(ours - theirs).max() / np.abs(ours).max())


def run(options: argparse.Namespace) -> int:
    """Run the study and print its table."""
    study = read_study(options.study)
    points = points_from(study.observation.positions)
    observation = observe(study, points, np.ones_like(points, bool))
    with common.session(options) as session:
        def room(name: str) -> Session:
            return replace(session, folder=session.folder / name)

        axis, size = plane(study, room("map"))
        model = response_matrix(build_magnet(study), observation, room("circle"))
        on_circle = study.with_(
            plan__candidates=tuple(one for one in study.plan.candidates
                                   if one.radius_m == study.observation.positions.radius_m))
        plans = {"on the circle": plan_measurement(build_magnet(on_circle), room("plan-circle")),
                 "wherever the probe can go": plan_measurement(build_magnet(study), room("plan"))}
        error = printed_form_error(study, model, session)
    along, across = by_block(study, model)
    one = plans["on the circle"]
    information = {"equally spaced circle": (one.baseline_counts, one.baseline_gain)} | {
        f"plan {name}": (np.arange(1, len(found.gain) + 1), found.gain)
        for name, found in plans.items()}
    write_files(page(plans["on the circle"]), options.output / "plan-circle")
    write_files(page(plans["wherever the probe can go"]), options.output / "plan")
    summaries = {name: plan_summary(found) for name, found in plans.items()}
    write_files(sensitivity_page.page(build_magnet(study), Sensitivity(
        BLOCK, axis, axis, size, np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi), along,
        across, error, information, model.matrix.shape[1]), summaries), options.output)
    common.print_table(plan_rows(summaries), "Where to measure")
    common.say(f"Report: {options.output / 'sensitivity.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", HERE / "study.toml", "sensitivity", run))
