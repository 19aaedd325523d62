"""`halbach-fe export STUDY --format blocks` as a user meets it."""

from __future__ import annotations

import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.reader import read_study
from tests.cli.test_cli import refused
from tests.conftest import DIPOLE, ROOT, circle

HEAD = """
name = "again"
array = { free_blocks = { file = "FILE" } }
mesh = { block_size_m = 0.02 }
observation = { quantity = "flux_density", positions = { kind = "points", points_m = [[0, 0, 0]] } }
"""


@pytest.mark.parametrize("study", ["cubes", "quadrupole"])
@pytest.mark.parametrize("name", ["blocks.csv", "blocks.h5"])
def test_blocks_of_a_study(tmp_path, capsys, study, name):
    """The shipped studies, exported and read back, have the same field in vacuum."""
    path = ROOT / "studies" / study / "study.toml"
    assert main(["export", str(path), "--format", "blocks", "-o", str(tmp_path / name)]) == 0
    magnet = build_magnet(read_study(path))
    assert f"Wrote {len(magnet.blocks)} blocks" in capsys.readouterr().err
    (tmp_path / "study.toml").write_text(
        f"dimension = {magnet.dimension}\n" + HEAD.replace("FILE", name))
    found = build_magnet(read_study(tmp_path / "study.toml"))
    points = circle(0.5 * magnet.bore_radius, 8, 0.0)
    field, other = (field_of(one.blocks, points) for one in (magnet, found))
    assert np.abs(field - other).max() < 1e-12 * np.abs(field).max()  # rounding leaves 1e-15
    assert [block.recoil_permeability for block in found.blocks] == [
        block.recoil_permeability for block in magnet.blocks]
    turned = field_of(magnet.blocks[1:], points)  # the control: a block is missing
    assert np.abs(turned - other).max() > 1e-4 * np.abs(field).max()


def test_refusals(tmp_path, capsys):
    study, map_ = ROOT / "studies" / "cubes" / "study.toml", tmp_path / "map.csv"
    code, sentence = refused(["export", study, "--format", "blocks", "-o", tmp_path / "b.xls"],
                             capsys)
    assert (code, ".csv, .h5" in sentence) == (8, True)
    map_.write_text("x_m,y_m,z_m,Bx_T,By_T,Bz_T\n0,0,0,1,0,0\n")
    code, sentence = refused(["export", map_, "--format", "blocks", "-o", tmp_path / "b.csv"],
                             capsys)
    assert (code, "TOML" in sentence) == (3, True)
    code, _ = refused(["export", study, "--format", "csv", "-o", tmp_path / "m.csv"], capsys)
    assert code == 4
    assert list(tmp_path.iterdir()) == [map_]


def test_what_is_no_block_is_named(tmp_path, capsys):
    """A background is in no table of blocks. Control: a magnet without."""
    study = tmp_path / "study.toml"
    for background, said in (([0.01, 0.0, 0.0], True), ([0.0, 0.0, 0.0], False)):
        study.write_text(tomlkit.dumps(DIPOLE | {"external": {"background_T": background}}))
        assert main(["export", str(study), "--format", "blocks",
                     "-o", str(tmp_path / "blocks.csv")]) == 0
        assert ("Left out, as it is no block: the background." in capsys.readouterr().err) == said
