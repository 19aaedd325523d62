"""Dumped solutions: read back, evaluated as GetDP evaluates them, and refused when damaged."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from halbach_fe.core.errors import GetDPError, PointsOutsideError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver import magnetostatics
from halbach_fe.solver.getdp_cache import Cache
from halbach_fe.solver.getdp_files import read_matrix, read_saved, read_solutions, read_unknowns
from halbach_fe.solver.interpolation import (
    coordinates,
    elements_of,
    locate,
    probes_of,
    shape_functions,
)
from halbach_fe.solver.mesh import build_meridian, build_mesh, verify_mesh
from halbach_fe.solver.routes import finite_element_part
from halbach_fe.solver.session import Session
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


def complexified(content, skip, rows=1):
    """The same file of a complex PETSc: an imaginary part of 0 behind every value."""
    length = len(content) // rows
    parts = [content[start:start + length] for start in range(0, len(content), length)]
    return b"".join(part[:skip] + b"".join(part[at:at + 8] + bytes(8)
                                           for at in range(skip, length, 8)) for part in parts)


def test_a_complex_petsc_gives_the_same(tmp_path):
    """Its files have imaginary parts of 0; one that is not 0 is refused."""
    path, text = tmp_path / "x.bin", tmp_path / "x.res"
    solutions = complexified(vectors([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), 8, rows=2)
    path.write_bytes(solutions)
    assert read_solutions(path, 3, 2).tolist() == [[1, 2, 3], [4, 5, 6]]
    assert read_solutions(path, 3, 1, before=1).tolist() == [[4, 5, 6]]
    path.write_bytes(solutions[:-8] + np.array(1e-30, ">f8").tobytes())
    with pytest.raises(GetDPError, match="imaginary"):
        read_solutions(path, 3, 2)
    head = 16 + 4 * 3 + 4 * 3  # sizes, lengths of rows, columns
    path.write_bytes(complexified(matrix(ROWS), head))
    assert read_matrix(path, 3).toarray().tolist() == [[1, 0, 2], [0, 0, 0], [0, -3.5, 0]]
    path.write_bytes(complexified(matrix(ROWS), head)[:-8] + np.array(1.0, ">f8").tobytes())
    with pytest.raises(GetDPError, match="imaginary"):
        read_matrix(path, 3)
    text.write_text(saved(SOLUTIONS).replace(".0\n", ".0 0\n").replace("e-17\n", "e-17 0\n"))
    assert read_saved(text, 3, 2).tolist() == SOLUTIONS
    text.write_text(text.read_text().replace("6.0 0", "6.0 1e-9"))
    with pytest.raises(GetDPError, match="imaginary"):
        read_saved(text, 3, 2)


def matrix(rows, unknowns=3, identifier=1211216, lengths=None):
    """PETSc's binary format of sparse rows, {column: value} each."""
    lengths = lengths or [len(row) for row in rows]
    columns = [column for row in rows for column in row]
    values = [value for row in rows for value in row.values()]
    return (np.array([identifier, unknowns, unknowns, len(values), *lengths, *columns], ">i4")
            .tobytes() + np.array(values, ">f8").tobytes())


ROWS = [{0: 1.0, 2: 2.0}, {}, {1: -3.5}]


def test_a_matrix_comes_back(tmp_path):
    path = tmp_path / "x.bin"
    path.write_bytes(matrix(ROWS))
    assert read_matrix(path, 3).toarray().tolist() == [[1, 0, 2], [0, 0, 0], [0, -3.5, 0]]


@pytest.mark.parametrize(("content", "said"), [
    (matrix(ROWS, unknowns=4), "another header"), (matrix(ROWS, identifier=1211214), "another"),
    (vectors([[1.0, 2.0, 3.0]]), "another header"), (matrix(ROWS) + b"\0", "truncated"),
    (matrix([{0: 1.0, 2: np.nan}, {}, {1: 1.0}]), "not finite"),
    (matrix([{0: 1.0, 2: np.inf}, {}, {1: 1.0}]), "not finite"),
    (matrix([{0: 1.0, 3: 2.0}, {}, {1: 1.0}]), "outside the matrix"),
    (matrix([{0: 1.0, -1: 2.0}, {}, {1: 1.0}]), "outside the matrix"),
    (matrix(ROWS, lengths=[4, -1, 0]), "outside the matrix"),
    (None, "cannot be read")])
def test_damaged_matrices_are_refused(tmp_path, content, said):
    path = tmp_path / "x.bin"
    if content is not None:
        assert content != matrix(ROWS)
        path.write_bytes(content)
    with pytest.raises(GetDPError, match=said):
        read_matrix(path, 3)


def test_every_truncation_of_a_matrix_is_refused(tmp_path):
    path = tmp_path / "x.bin"
    for cut in range(len(matrix(ROWS))):
        path.write_bytes(matrix(ROWS)[:cut])
        with pytest.raises(GetDPError, match="cannot be read"):
            read_matrix(path, 3)


def saved(rows):
    """GetDP's .res file."""
    return "$ResFormat /* GetDP 3.2.0, ascii */\n1.1 0\n$EndResFormat\n" + "".join(
        f"$Solution  /* DofData #0 */\n0 0 0 {number}\n"
        + "".join(f"{value!r}\n" for value in row) + "$EndSolution\n"
        for number, row in enumerate(rows))


SOLUTIONS = [[1.0, 2.0, 3e-17], [4.0, -5.0, 6.0]]


def test_saved_solutions_come_back(tmp_path):
    path = tmp_path / "x.res"
    path.write_text(saved(SOLUTIONS))
    assert read_saved(path, 3, 2).tolist() == SOLUTIONS


def test_getdps_own_file_is_like_that(dipole, session, monkeypatch):
    """What is made by hand here has the format of the real one."""
    study = dipole(mesh__block_size_m=0.06, mesh__growth=3.0, iron_ring={
        "inner_radius_m": 0.2, "outer_radius_m": 0.24,
        "curve": {"kind": "steel", "name": "aisi_1010"}})
    seen = []

    def keep(path, unknowns, count):
        seen.append((path.read_text(), unknowns, read_saved(path, unknowns, count)))
        return seen[-1][2]

    monkeypatch.setattr(magnetostatics, "read_saved", keep)
    finite_element_part(build_magnet(study), circle(0.05, 5), session, columns=False)
    for text, unknowns, solutions in seen:
        real, ours = text.splitlines(), saved(solutions.tolist()).splitlines()
        assert len(real) == len(ours)
        assert real[3].split() == ours[3].split()
        assert [float(line) for line in real[5:-1]] == [float(line) for line in ours[5:-1]]
        assert len(ours) == unknowns + 6
    assert seen


@pytest.mark.parametrize(("content", "said"), [
    (saved(SOLUTIONS[:1]), r"\(1, 3\) in place of 2 of 3"),
    (saved([[1.0, 2.0], [4.0, 5.0]]), r"\(2, 2\) in place"),
    (saved([[1.0, 2.0, 3.0], [4.0, 5.0]]), "cannot be read"), ("", "in place of 2"),
    (saved([[1.0, 2.0, 3.0], [4.0, np.nan, 6.0]]).replace("np.", ""), "not finite"),
    (saved([[1.0, 2.0, 3.0], [4.0, np.inf, 6.0]]), "not finite"),
    (saved(SOLUTIONS).replace("4.0", "four"), "cannot be read"),
    (saved(SOLUTIONS).replace("$Sol", "$Dof"), "in place of 2"), ("\xb5", "cannot be read"),
    (None, "cannot be read")])
def test_damaged_saved_solutions_are_refused(tmp_path, content, said):
    path = tmp_path / "x.res"
    if content is not None:
        path.write_bytes(content.encode("latin-1"))
    with pytest.raises(GetDPError, match=said):
        read_saved(path, 3, 2)


def test_every_truncation_of_saved_solutions_is_refused_or_complete(tmp_path):
    """What ends behind the last line of numbers has them all."""
    path, text = tmp_path / "x.res", saved(SOLUTIONS)
    complete = text.rindex("6.0\n") + len("6.0\n")
    for cut in range(len(text)):
        path.write_text(text[:cut])
        if cut < complete:
            with pytest.raises(GetDPError):
                read_saved(path, 3, 2)
        else:
            assert read_saved(path, 3, 2).tolist() == SOLUTIONS


@pytest.mark.parametrize("content", [None, "", "$DofData /* #0 */\n0 0\n", "nonsense\n" * 9])
def test_damaged_lists_of_unknowns_are_refused(tmp_path, content):
    path = tmp_path / "x.pre"
    if content is not None:
        path.write_text(content)
    with pytest.raises(GetDPError, match="list of unknowns"):
        read_unknowns(path, "tetra10")


@pytest.fixture(scope="module")
def accepted(request, short_dipole, getdp, tmp_path_factory):
    """The study of a route and an order, points, and a session that keeps the run: unknowns in
    GetDP's own order are accepted.
    """
    route, order = request.param
    study = short_dipole(solver={"route": route, "edge_order": order},
                         array__rings=1, array__blocks_per_ring=8,
                         mesh__block_size_m=0.06, mesh__meridian_size_m=0.03, mesh__growth=3.0)
    points = circle(0.05, 5, 0.013)
    folder = tmp_path_factory.mktemp("accepted")
    session = Session(getdp, folder, jobs=2, cache=Cache(folder / "cache"))
    finite_element_part(build_magnet(study), points, session, columns=False)
    return study, points, session


@pytest.mark.parametrize(("accepted", "part", "corners_only"), [
    *((("azimuthal_modes", 1), part, False) for part in range(3)),
    (("scalar_potential", 1), 0, False), (("scalar_potential", 1), 0, True),
    (("edge_elements", 1), 0, False),
    *((("edge_elements", 2), part, False) for part in range(3))],
    indirect=["accepted"], ids=lambda value: "-".join(map(str, value))
    if isinstance(value, tuple) else None)
def test_other_numbering_is_noticed(accepted, monkeypatch, part, corners_only):
    """Negative control of the comparison with GetDP's own print: unknowns in another order."""
    study, points, session = accepted
    route = study.solver.route
    mesh = None if route == "azimuthal_modes" else verify_mesh(
        build_mesh(build_magnet(study), session.folder / "again"))

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

    monkeypatch.setattr(magnetostatics, "read_unknowns", shifted)
    monkeypatch.setattr("halbach_fe.solver.azimuthal_modes.read_unknowns", shifted)
    with pytest.raises(GetDPError, match="unknowns in another way"):
        finite_element_part(build_magnet(study), points, session, columns=False)


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
            (verify_mesh(build_mesh(build_magnet(short_dipole()), tmp_path / "3d")), points),
            (verify_mesh(build_mesh(build_magnet(dipole()), tmp_path / "2d")), points * [1, 1, 0]),
            (verify_mesh(build_meridian(build_magnet(short_dipole()), tmp_path / "rz")), r_z)):
        located = locate(mesh, where)
        np.testing.assert_allclose(coordinates(mesh, located),
                                   where[:, :mesh.points.shape[1]], atol=1e-9)
        assert mesh.in_air[located.cells].all()
        probes, places = probes_of(mesh, located.cells)
        np.testing.assert_allclose(coordinates(mesh, probes), places[:, :mesh.points.shape[1]])
        with pytest.raises(PointsOutsideError):
            locate(mesh, np.array([[100.0, 0, 0]]))
        with pytest.raises(PointsOutsideError):  # in a block
            locate(mesh, np.array([[0.15, 0.0, 0.0]]))


@pytest.mark.parametrize("kind", ["quad", "triangle6", "tetra10"])
def test_points_of_curved_elements_are_found(kind, generator):
    """Edges bulge by 6 % of their length, and by 0.6 % of an element beyond the box of its nodes.
    Control: a third and more beyond that box no point is in it.
    """
    dimension = 3 if kind == "tetra10" else 2
    corners = {"quad": [[-1, -1], [1, -1], [1, 1], [-1, 1]]}.get(
        kind, np.vstack([np.zeros(dimension), np.eye(dimension)]).tolist())
    if kind != "quad":
        pairs = [(0, 1), (1, 2), (0, 2)] if dimension == 2 else [
            (0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
        corners += [np.add(corners[a], corners[b]) / 2 for a, b in pairs]
    for _ in range(20):
        nodes = np.array([corners]) + generator.uniform(-0.06, 0.06, (1, len(corners), dimension))
        inside = generator.dirichlet(np.ones(dimension + 1), 200)[:, 1:]
        reference = 2 * generator.random((200, 2)) - 1 if kind == "quad" else inside
        values, _ = shape_functions(kind, reference)
        points = np.einsum("nk,kd->nd", values, nodes[0])
        rows, _, found, missing = elements_of(nodes, points)
        assert not len(missing)
        np.testing.assert_allclose(found[np.argsort(rows)], reference, atol=1e-9)
    low, high = nodes[0].min(axis=0), nodes[0].max(axis=0)
    assert elements_of(nodes, (high + 0.34 * (high - low))[None])[3].size == 1
