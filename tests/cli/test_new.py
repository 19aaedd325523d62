"""A new study file is valid, with and without what is optional in it."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest

from halbach_fe.cli import main
from halbach_fe.core.errors import StudyError
from halbach_fe.measurement.observation import held_out_readings, observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.study.reader import read_study
from halbach_fe.study.template import MagnetTemplate, new_study, parse_new_study

MAGNETS = [
    MagnetTemplate(shape=shape, iron_ring=iron, ring_length_m=length, rings=3 if length else 1,
                  multipole_order=order)
           for shape, iron, length, order in itertools.product(
               ("sector", "trapezoid", "cuboid"), (False, True), (None, 0.03), (1, 2))]


@pytest.mark.parametrize("magnet", MAGNETS, ids=str)
def test_every_option_can_be_used_as_it_stands(magnet):
    text = new_study("a-magnet", magnet)
    optional = [line for line in text.splitlines() if line.startswith("#: ")]
    assert optional
    whole = re.sub(r"(?m)^#: ", "", text)
    if magnet.shape == "cuboid":
        assert "side_gap_m" not in whole
    assert parse_new_study(whole) != parse_new_study(text)
    spoiled = whole.replace("remanence_T", "remanance_T")  # the comparison would see it
    with pytest.raises(StudyError, match="remanance_T"):
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
