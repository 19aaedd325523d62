"""The field of deviations of magnetizations, beside what the response matrix makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.response.block_variation import Deviations
from halbach_fe.response.response_matrix import response_matrix
from tests.conftest import circle

POINTS = np.vstack([circle(0.03, 8, z) for z in (0.0, 0.03, 0.09)])


@pytest.mark.parametrize("permeability", [1.0, 1.06])
def test_deviations_are_answered_by_permeable_blocks(short_dipole, generator, session,
                                                     permeability):
    """As in the response matrix. Control: the field in vacuum lacks some per cent of it."""
    magnet = build_magnet(short_dipole(
        array__recoil_permeability=permeability, array__block={"shape": "cuboid", "width_m": 0.02}))
    observation = observe(magnet.study, POINTS, np.ones_like(POINTS, bool))
    response = response_matrix(magnet, observation, session)
    of_deviations = Deviations.of(magnet)
    deviations = 1e4 * generator.standard_normal(of_deviations.count)
    right = response.matrix @ deviations

    def error(field):
        return np.linalg.norm(observation.apply(field) - right) / np.linalg.norm(right)

    points = observation.points
    assert error(of_deviations.answered(deviations)(points)) < 1e-3  # measured 2e-4
    in_vacuum = error(of_deviations.field(deviations, points))
    assert in_vacuum < 1e-12 if permeability == 1.0 else in_vacuum > 1e-2
