"""Gradients from the nodes around a point, against the exact field and beside materials."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.core.errors import GetDPError
from halbach_fe.core.files import make_folder
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.response.response_matrix import response_matrix
from halbach_fe.solver import azimuthal_modes, interpolation
from halbach_fe.solver.azimuthal_modes import solve_modes
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.interpolation import SAME_LINE, nodal_operators
from halbach_fe.solver.mesh import build_meridian, verify_mesh
from tests.conftest import circle

SMOOTH = np.vstack([circle(radius, 7, z, 0.1 + z) for radius in (0.0, 0.03, 0.06)
                    for z in np.linspace(-0.15, 0.15, 31)])
"""Points of a bore of 104 mm that are 4 elements of 10 mm from the blocks, the fringe included."""

BESIDE = np.vstack([circle(0.095, 7, z, 0.1 + z) for z in np.linspace(-0.07, 0.07, 9)])
"""Points one element from the blocks."""


def test_gradients_are_more_exact_than_in_elements_and_the_same_beside_blocks(
        short_dipole, session, monkeypatch):
    """Blocks in vacuum by finite elements alone, whose exact field is known.

    Control: the gradients of elements. Measured 6.5e-5 and 1.4e-3 of the field.
    """
    magnet = build_magnet(short_dipole(
        array__recoil_permeability=1.0, mesh__meridian_size_m=0.01,
        solver={"method": "direct", "route": "azimuthal_modes"}))
    points = np.vstack([SMOOTH, BESIDE])
    exact, found = field_of(magnet.blocks, points), {}
    for name in ("grid", "elements"):
        if name == "elements":
            monkeypatch.setattr(azimuthal_modes, "grid_operators", nodal_operators)
        found[name] = solve_modes(magnet, points, (), session.within(name), highest=33)[0]
    smooth, beside = slice(len(SMOOTH)), slice(len(SMOOTH), None)
    by_grid, by_elements = (np.abs(each - exact)[smooth].max() / np.abs(exact[smooth]).max()
                            for each in found.values())
    assert by_grid < 1.3e-4
    assert by_elements > 7e-4
    np.testing.assert_array_equal(found["grid"][beside], found["elements"][beside])


def test_readings_on_grid_lines_have_columns_that_add_up(short_dipole, session, monkeypatch):
    """Columns follow from each other by the mirror at z = 0, and so must the polynomials.

    Control: the polynomial of one side alone, on whose windows a mirror image has other nodes.
    """
    magnet = build_magnet(short_dipole(mesh__meridian_size_m=0.01))
    lines = np.unique(np.round(verify_mesh(build_meridian(
        magnet, make_folder(session.folder / "mesh"))).points[:, 1], SAME_LINE))
    on_lines = lines[np.abs(lines) < 0.16]
    points = np.vstack([circle(0.015, 4, z, 0.1) for z in on_lines])
    observation = observe(magnet.study, points, np.ones_like(points, bool))
    found = response_matrix(magnet, observation, session.within("both"))
    assert found.superposition_error < 1e-11  # rounding; measured 2e-13 for such a magnet

    first_line = interpolation._first_line
    monkeypatch.setattr(interpolation, "_first_line", lambda lines, at, side, *given, **more:
                        first_line(lines, at, "right", *given, **more))
    with pytest.raises(GetDPError, match="do not add up"):
        response_matrix(magnet, observation, session.within("one"))
