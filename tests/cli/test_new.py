"""A new study file is valid, with and without what is optional in it."""

from __future__ import annotations

import contextlib
import itertools
import re

import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation import held_out_readings, observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.study.grades import grade
from halbach_fe.study.reader import read_study
from halbach_fe.study.template import MagnetTemplate, new_study, parse_new_study
from tests.conftest import ROOT

MAGNETS = [
    MagnetTemplate(shape=shape, iron_ring=iron, ring_length_m=length, rings=3 if length else 1,
                  multipole_order=order)
           for shape, iron, length, order in itertools.product(
               ("sector", "trapezoid", "cuboid"), (False, True), (None, 0.03), (1, 2))]
MAGNETS += [MagnetTemplate(material="N42"),
            MagnetTemplate(inner_radii_m=(0.05, 0.06), ring_length_m=0.03, shape="trapezoid"),
            MagnetTemplate(free_blocks=str(ROOT / "studies/mri4all/blocks.csv")),
            MagnetTemplate(free_blocks=str(ROOT / "studies/hybrid-quadrupole/blocks.csv"),
                           multipole_order=2)]


@pytest.mark.parametrize("magnet", MAGNETS, ids=str)
def test_every_option_can_be_used_as_it_stands(magnet):
    text = new_study("a-magnet", magnet)
    optional = [line for line in text.splitlines() if line.startswith("#: ")]
    assert optional
    whole = re.sub(r"(?m)^#: ", "", text)
    if magnet.shape == "cuboid":
        assert "side_gap_m" not in whole
    assert parse_new_study(whole) != parse_new_study(text)
    spoiled = whole.replace("direction_sd_deg", "direktion_sd_deg")  # the comparison would see it
    with pytest.raises(StudyError, match="direktion_sd_deg"):
        parse_new_study(spoiled)


def test_command_writes_what_was_asked_for(tmp_path):
    path = tmp_path / "my magnet.toml"
    assert main(["new", str(path), "--multipole-order", "2", "--inner-radius-m", "0.02",
                 "--ring-length-m", "0.01", "--rings", "4", "--iron-ring"]) == 0
    study = read_study(path)
    assert study.name == "my-magnet"
    assert study.dimension == 3
    assert study.array.multipole_order == 2
    assert study.array.rings == 4
    assert study.array.outer_radius_m == pytest.approx(0.036)
    assert study.iron_ring is not None


def test_command_writes_rings_of_their_own_and_free_blocks(tmp_path, capsys):
    stepped, free = tmp_path / "stepped.toml", tmp_path / "free.toml"
    assert main(["new", str(stepped), "--inner-radii-m", "0.02,0.03", "--ring-length-m", "0.05",
                 "--material", "N42"]) == 0
    magnet = build_magnet(read_study(stepped))
    assert [section[1][0] for section in magnet.ring_sections] == pytest.approx([0.02, 0.03])
    assert magnet.blocks[0].remanence == pytest.approx(grade("N42").nominal_remanence)
    table = ROOT / "studies/mri4all/blocks.csv"
    assert main(["new", str(free), "--free-blocks", str(table)]) == 0
    magnet = build_magnet(read_study(free))
    assert len(magnet.blocks) == 990
    points = points_from(read_study(free).observation.positions)
    assert not magnet.contains(points).any()
    assert np.abs(points[:, 2]).max() > magnet.half_length
    capsys.readouterr()
    for wrong in (["--material", "N99"], ["--free-blocks", "absent.csv"],
                  ["--inner-radii-m", "0.02,0.03", "--free-blocks", str(table)],
                  ["--inner-radii-m", "0.02,x"]):
        with contextlib.suppress(SystemExit):  # of argparse
            assert main(["new", str(tmp_path / "wrong.toml"), *wrong]) == 3
        assert capsys.readouterr().err
        assert not (tmp_path / "wrong.toml").exists()


def test_nothing_is_overwritten_and_nonsense_is_refused(tmp_path, capsys):
    path = tmp_path / "magnet.toml"
    path.write_text("mine")
    assert main(["new", str(path)]) == 8
    assert path.read_text() == "mine"
    other = tmp_path / "other.toml"
    assert main(["new", str(other), "--inner-radius-m", "0.1", "--outer-radius-m", "0.09"]) == 3
    assert "outer_radius_m" in capsys.readouterr().err
    assert not other.exists()


@pytest.mark.parametrize("options", [[], ["--ring-length-m", "0.1"]], ids=["2d", "3d"])
def test_new_study_can_be_measured(tmp_path, options):
    path = tmp_path / "magnet.toml"
    assert main(["new", str(path), "--blocks-per-ring", "8", *options]) == 0
    study = read_study(path)
    points = points_from(study.observation.positions)
    readings = observe(study, points, np.ones_like(points, bool))
    hidden = held_out_readings(study, readings)
    assert 0 < hidden.sum() < len(hidden) / 1.9
