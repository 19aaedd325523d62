"""Meshes: the same study gives the same mesh, of the right size, and damage is noticed."""

from __future__ import annotations

import json
import re

import meshio
import numpy as np
import pytest

from halbach_fe.core.errors import MeshError, StudyError
from halbach_fe.core.untrusted_files import read_mesh
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.mesh import MeshFiles, build_meridian, build_mesh, verify_mesh
from halbach_fe.study.reader import read_study
from tests.conftest import ROOT


def volumes(path, dimension):
    """Area or volume of each region of a mesh, by its straight elements."""
    mesh = meshio.read(path)
    found: dict[int, float] = {}
    for cells, tags in zip(mesh.cells, mesh.cell_data["gmsh:physical"], strict=True):
        points = mesh.points[cells.data]
        if dimension == 2 and cells.type == "triangle6":
            a, b = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
            size = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        elif dimension == 3 and cells.type == "tetra10":
            a, b, c = (points[:, i] - points[:, 0] for i in (1, 2, 3))
            size = np.einsum("ij,ij->i", np.cross(a, b), c) / 6
            assert (size > 0).all()
        else:
            continue
        for tag in np.unique(tags):
            found[int(tag)] = found.get(int(tag), 0.0) + float(size[tags == tag].sum())
    return found


@pytest.mark.parametrize(("name", "larger"), [("faser", 1), ("quadrupole", 1), ("cubes", 2)])
def test_shipped_studies_mesh_to_their_volumes(tmp_path, name, larger):
    """Chords cut some per cent off sectors; cuboids and trapezoids are met exactly.

    The air is coarser than a solve has it, and elements of blocks may be ``larger`` by a factor: no
    solve meshes the cubes of the MRI magnet.
    """
    study = read_study(ROOT / f"studies/{name}/study.toml")
    study = study.with_(mesh__block_size_m=larger * study.mesh.block_size_m, mesh__growth=2.0)
    mesh = verify_mesh(build_mesh(build_magnet(study), tmp_path))
    found = volumes(mesh.path, study.dimension)
    tolerance = 0.02 if study.array.block.shape == "sector" else 1e-6
    for block, region in zip(build_magnet(study).blocks, mesh.regions.blocks, strict=True):
        expected = block.area if study.dimension == 2 else block.volume
        assert found[region.tag] == pytest.approx(expected, rel=tolerance), region.name


@pytest.mark.parametrize(("size_m", "radius_m"), [(0.05, 0.3), (0.001, 9.0)])
def test_a_mesh_beyond_the_memory_is_refused(tmp_path, dipole, size_m, radius_m):
    """Iron in other units than the blocks: Gmsh would mesh for hours. The near iron is the control.

    The far one would need 3 TB.
    """
    magnet = build_magnet(dipole(mesh={"block_size_m": size_m, "growth": 2.0}, iron_ring={
        "inner_radius_m": radius_m, "outer_radius_m": radius_m + 0.3,
        "relative_permeability": 1000.0}))
    if radius_m < 1:
        assert build_mesh(magnet, tmp_path).mesh.exists()
        return
    with pytest.raises(MeshError, match=r"The iron reaches 50 times as far out as the blocks"):
        build_mesh(magnet, tmp_path)


def test_same_study_same_mesh(tmp_path, dipole, short_dipole):
    for study in (dipole(), short_dipole()):
        first = build_mesh(build_magnet(study), tmp_path / "a")
        second = build_mesh(build_magnet(study), tmp_path / "b")
        assert first.mesh.read_bytes() == second.mesh.read_bytes()
        assert first.regions.read_bytes() == second.regions.read_bytes()
    other = build_mesh(build_magnet(short_dipole(mesh__block_size_m=0.031)), tmp_path / "c")
    assert other.mesh.read_bytes() != first.mesh.read_bytes()


def test_meshes_are_read_as_meshio_reads_them(tmp_path, dipole, short_dipole, monkeypatch):
    """Of lines, triangles, tetrahedra and quadrangles, without meshio, which takes 70 times as
    long; what Gmsh does not write, here elements without a tag, goes to meshio.
    """
    files = [build_mesh(build_magnet(dipole()), tmp_path / "2d").mesh,
             build_mesh(build_magnet(short_dipole(mesh__block_size_m=0.06)), tmp_path / "3d").mesh,
             build_meridian(build_magnet(short_dipole()), tmp_path / "half-plane").mesh]
    theirs = [meshio.read(path) for path in files]
    monkeypatch.setattr(meshio, "read", lambda path: pytest.fail(f"{path} goes to meshio"))
    for path, expected in zip(files, theirs, strict=True):
        mesh = read_mesh(path)
        np.testing.assert_array_equal(mesh.points, expected.points)
        for one, other in zip(mesh.cells, expected.cells, strict=True):
            assert one.type == other.type
            np.testing.assert_array_equal(one.data, other.data)
        for one, other in zip(*(found.cell_data["gmsh:physical"] for found in (mesh, expected)),
                              strict=True):
            np.testing.assert_array_equal(one, other)
    raw = files[0].read_bytes()
    place = re.search(rb"\$Elements\n\d+\n", raw).end() + 8
    files[0].write_bytes(raw[:place] + b"\0" + raw[place + 1:])
    with pytest.raises(pytest.fail.Exception, match="goes to meshio"):
        read_mesh(files[0])


def with_regions(files: MeshFiles, change) -> MeshFiles:
    document = json.loads(files.regions.read_text())
    change(document)
    files.regions.write_text(json.dumps(document))
    return files


def test_region_missing_from_the_mesh(tmp_path, dipole):
    files = build_mesh(build_magnet(dipole()), tmp_path)
    extra = {"name": "r01s17", "ring": 1, "slot": 17, "tag": 1999}
    with_regions(files, lambda d: d["blocks"].append(extra))
    with pytest.raises(MeshError, match=r"lacks region 1999 \(block r01s17\)"):
        verify_mesh(files)


def test_region_unknown_to_the_region_file(tmp_path, dipole):
    files = with_regions(build_mesh(build_magnet(dipole()), tmp_path), lambda d: d["blocks"].pop())
    with pytest.raises(MeshError, match="holds region 1016"):
        verify_mesh(files)


def test_mesh_without_outer_boundary(tmp_path, dipole):
    files = with_regions(build_mesh(build_magnet(dipole()), tmp_path),
                         lambda d: d.update(outer_boundary=11))
    with pytest.raises(MeshError, match="lacks its outer boundary"):
        verify_mesh(files)


@pytest.mark.parametrize("part", [0.0, 0.3, 0.9, 0.999])
def test_truncated_mesh(tmp_path, dipole, part):
    files = build_mesh(build_magnet(dipole()), tmp_path)
    whole = files.mesh.read_bytes()
    files.mesh.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(MeshError, match=r"truncated|not an MSH"):
        verify_mesh(files)


def test_damaged_region_file(tmp_path, dipole):
    files = build_mesh(build_magnet(dipole()), tmp_path)
    files.regions.write_text("{")
    with pytest.raises(MeshError, match="Mesh the study again"):
        verify_mesh(files)


def test_iron_inside_the_blocks_is_refused(tmp_path, dipole):
    iron = {"inner_radius_m": 0.18, "outer_radius_m": 0.2, "relative_permeability": 100.0}
    with pytest.raises(StudyError, match="where the blocks end"):
        build_mesh(build_magnet(dipole(iron_ring=iron)), tmp_path)


def test_boundary_inside_the_magnet_is_refused(tmp_path, short_dipole):
    with pytest.raises(StudyError, match=r"open_boundary\.radius_m"):
        build_mesh(build_magnet(short_dipole(open_boundary={"radius_m": 0.19})), tmp_path)
    with pytest.raises(StudyError, match=r"open_boundary\.half_length_m"):
        build_mesh(build_magnet(short_dipole(open_boundary={"half_length_m": 0.05})), tmp_path)


def test_gaps_and_shorter_iron_get_layers_of_their_own(tmp_path, short_dipole):
    study = short_dipole(array__ring_gap_m=0.004, iron_ring={
        "inner_radius_m": 0.19, "outer_radius_m": 0.2, "relative_permeability": 100.0,
        "length_m": 0.1})
    mesh = verify_mesh(build_mesh(build_magnet(study), tmp_path))
    iron = volumes(mesh.path, 3)[mesh.regions.iron]
    assert iron == pytest.approx(np.pi * (0.2**2 - 0.19**2) * 0.1, rel=0.02)
