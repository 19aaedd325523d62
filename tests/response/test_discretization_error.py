"""Error bars of readings: they cover the true error where it is known, and reach the inference."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.core.errors import HalbachWarning
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.observation import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.response.discretization_error import reading_errors
from halbach_fe.solver.formulation_choice import check_points, finite_element_part, vacuum_part
from halbach_fe.solver.ring_harmonics_2d import ideal_sectors, layered_bore_field
from tests.conftest import circle

IRON = {"inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 1000.0}
FOURIER = {"quantity": "fourier_coefficients", "harmonics": 8,
           "positions": {"kind": "circles", "radius_m": 0.075, "angles": 24}}


def bars(study, session):
    """Error bars and actual readings of a 2D study, and the readings of the closed form."""
    points = points_from(study.observation.positions)
    observation = observe(study, points, np.ones_like(points, bool) & [True, True, False])
    part = finite_element_part(build_magnet(study), points, session, columns=False)
    iron = study.iron_ring and (0.19, 0.2, 1000.0)
    truth = np.zeros_like(points)
    truth[:, :2] = layered_bore_field(ideal_sectors(1, 16, 1.06, np.pi / 2, np.pi), 0.104, 0.1865,
                                      1.05, points[:, :2], iron)
    found = observation.apply(vacuum_part(build_magnet(study), points) + part.nominal)
    return (reading_errors(build_magnet(study), observation, part, session),
            np.abs(found - observation.apply(truth)))


@pytest.mark.parametrize("method", ["direct", "reaction"])
@pytest.mark.parametrize("observation", [None, FOURIER], ids=["points", "fourier"])
def test_bars_cover_the_error(dipole, session, method, observation):
    """Four of five readings lie within their bar (measured 88 to 94 %), and bars are not much too
    long: an estimate, not a guess (measured 2.2 to 2.5 times the error, rms).
    """
    changes = {} if observation is None else {"observation": observation}
    stated, true = bars(dipole(iron_ring=IRON, solver={"method": method}, **changes), session)
    assert np.mean(true <= stated) > 0.8
    assert np.sqrt(np.mean(stated**2)) < 5 * np.sqrt(np.mean(true**2))


def test_bars_shrink_with_the_mesh(dipole, session):
    """Negative control: bars that ignored the mesh would stay."""
    coarse, fine = (bars(dipole(iron_ring=IRON, mesh__block_size_m=size), session)[0]
                    for size in (0.024, 0.006))
    assert np.sqrt(np.mean(fine**2)) < np.sqrt(np.mean(coarse**2)) / 4


def test_dual_formulations_bracket_the_modes(short_dipole, session):
    """In 3D the bar is the difference of the dual formulations; the azimuthal modes, far more
    exact, lie within it nearly everywhere (measured: at all readings of these, at 98 % of others),
    and it is short beside the reaction (measured 12 %).
    """
    changes = {"mesh": {"block_size_m": 0.03, "layers_per_ring": 3, "growth": 1.5}}
    study = short_dipole(solver__route="scalar_potential", **changes)
    points = np.vstack([circle(0.05, 7, z, 0.2 + z) for z in (-0.12, -0.03, 0.0, 0.05, 0.11)])
    observation = observe(study, points, np.ones_like(points, bool))
    parts = finite_element_part(build_magnet(study), points, session, columns=False)
    part, stated = parts.nominal, reading_errors(build_magnet(study), observation, parts, session)
    truth = finite_element_part(build_magnet(short_dipole(mesh__meridian_size_m=0.01)), points,
                                session,
                                columns=False).nominal
    assert np.mean(np.abs(part - truth).ravel() <= stated) > 0.95
    assert stated.max() < 0.3 * np.abs(part).max()


def test_the_error_is_part_of_the_inference(dipole, session):
    """Noise far below the solver's error must not make the posterior narrower than the latter."""
    study = dipole(iron_ring=IRON, mesh__block_size_m=0.03,
                   noise={"regions": [{"name": "all", "sigma_T": 1e-9}]},
                   observation__components=["x", "y"])
    points = points_from(study.observation.positions)
    field = vacuum_part(build_magnet(study), points) + finite_element_part(build_magnet(study),
                                                                           points, session,
                                                            columns=False).nominal
    update = infer(build_magnet(study), field_map(points, field), session)
    error = update.response.error
    assert error.min() > 1e-7
    np.testing.assert_allclose(update.sigma, np.hypot(1e-9, error))
    assert np.median(update.prediction_posterior.sd) > 0.05 * np.median(error)


def test_readings_near_the_boundary_are_warned_of(dipole):
    study = dipole(open_boundary={"radius_m": 1.0})
    check_points(build_magnet(study), circle(0.5))
    with pytest.warns(HalbachWarning, match="half-way from the magnet to the boundary"):
        check_points(build_magnet(study), circle(0.8))
