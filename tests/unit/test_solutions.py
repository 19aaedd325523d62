"""Dumped solutions: read back, evaluated as GetDP evaluates them, and refused when damaged."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from halbach_fe import solve
from halbach_fe.errors import GetDPError, PointsOutsideError
from halbach_fe.evaluation import coordinates, locate, probes_of, shape_functions
from halbach_fe.mesh import build_meridian, build_mesh, verify_mesh
from halbach_fe.routes import finite_element_part
from halbach_fe.solutions import read_solutions, read_unknowns
from tests.conftest import circle


def vectors(rows):
    """PETSc's binary format."""
    return b"".join(np.array([1211214, len(row)], ">i4").tobytes()
                    + np.array(row, ">f8").tobytes() for row in rows)


def test_solutions_come_back(tmp_path):
    path = tmp_path / "x.bin"
    path.write_bytes(vectors([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    assert read_solutions(path, 3, 2).tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(("content", "said"), [
    (vectors([[1.0, 2.0, 3.0]]), "in place of 2 solutions"),
    (vectors([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])[:-1], "in place of 2 solutions"),
    (vectors([[1.0, 2.0, 3.0], [4.0, np.nan, 6.0]]), "not finite"),
    (vectors([[1.0, 2.0, 3.0], [4.0, np.inf, 6.0]]), "not finite"),
    (vectors([[1.0, 2.0, 3.0, 0.0], [4.0, 5.0]]), "does not hold 2 PETSc vectors"),
    (b"", "cannot be read"), (None, "cannot be read")])
def test_damaged_solutions_are_refused(tmp_path, content, said):
    path = tmp_path / "x.bin"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(GetDPError, match=said):
        read_solutions(path, 3, 2)


@pytest.mark.parametrize("content", [None, "", "$DofData /* #0 */\n0 0\n", "nonsense\n" * 9])
def test_damaged_lists_of_unknowns_are_refused(tmp_path, content):
    path = tmp_path / "x.pre"
    if content is not None:
        path.write_text(content)
    with pytest.raises(GetDPError, match="list of unknowns"):
        read_unknowns(path, "tetra10")


@pytest.mark.parametrize(("route", "order", "part", "corners_only"), [
    *(("azimuthal_modes", 1, part, False) for part in range(3)),
    ("scalar_potential", 1, 0, False), ("scalar_potential", 1, 0, True),
    ("edge_elements", 1, 0, False), *(("edge_elements", 2, part, False) for part in range(3))])
def test_other_numbering_is_noticed(
    short_dipole, workshop, monkeypatch, route, order, part, corners_only
):
    """Negative control of the comparison with GetDP's own print: unknowns in another order."""
    study = short_dipole(solver={"route": route, "edge_order": order},
                         mesh__block_size_m=0.06, mesh__meridian_size_m=0.03, mesh__growth=3.0)
    points = circle(0.05, 5, 0.013)
    finite_element_part(study, points, workshop, columns=False)
    mesh = None if route == "azimuthal_modes" else verify_mesh(
        build_mesh(study, workshop.folder / "again"))

    def shifted(path, cell_type):
        unknowns = read_unknowns(path, cell_type)
        some = unknowns.functions[part].copy()
        if corners_only:
            corners = np.unique(mesh.cells[:, :4]) + 1
            some[corners] = np.roll(some[corners], 7)
        else:
            some = np.roll(some, 7)
        return dataclasses.replace(unknowns, functions=(
            *unknowns.functions[:part], some, *unknowns.functions[part + 1:]))

    monkeypatch.setattr(solve, "read_unknowns", shifted)
    monkeypatch.setattr("halbach_fe.azimuthal.read_unknowns", shifted)
    with pytest.raises(GetDPError, match="numbered in another way"):
        finite_element_part(study, points, workshop, columns=False)


@given(st.sampled_from([("triangle6", 2), ("tetra10", 3), ("quad", 2)]), st.integers(0, 10**6))
def test_shape_functions(kind, seed):
    """They add up to one, and their derivatives are those of differences."""
    name, dimension = kind
    at = np.random.default_rng(seed).uniform(0, 0.3, (1, dimension))
    values, slopes = shape_functions(name, at)
    assert values.sum() == pytest.approx(1)
    for axis in range(dimension):
        step = 1e-6 * np.eye(dimension)[axis]
        difference = (shape_functions(name, at + step)[0] - shape_functions(name, at - step)[0])
        np.testing.assert_allclose(slopes[..., axis], difference / 2e-6, atol=1e-8)


def test_points_are_found_where_they_are(short_dipole, dipole, tmp_path, generator):
    points = np.vstack([circle(0.05, 9, 0.02), circle(0.104 * (1 - 1e-9), 9, 0.0),
                        generator.uniform(-0.07, 0.07, (200, 3))])
    r_z = np.column_stack([np.hypot(*points[:, :2].T), points[:, 2], np.zeros(len(points))])
    for mesh, where in (
            (verify_mesh(build_mesh(short_dipole(), tmp_path / "3d")), points),
            (verify_mesh(build_mesh(dipole(), tmp_path / "2d")), points * [1, 1, 0]),
            (verify_mesh(build_meridian(short_dipole(), tmp_path / "rz")), r_z)):
        located = locate(mesh, where)
        np.testing.assert_allclose(coordinates(mesh, located),
                                   where[:, :mesh.points.shape[1]], atol=1e-9)
        assert mesh.in_air[located.cells].all()
        probes, places = probes_of(mesh, located)
        np.testing.assert_allclose(coordinates(mesh, probes), places[:, :mesh.points.shape[1]])
        with pytest.raises(PointsOutsideError):
            locate(mesh, np.array([[100.0, 0, 0]]))
        with pytest.raises(PointsOutsideError):  # in a block
            locate(mesh, np.array([[0.15, 0.0, 0.0]]))
