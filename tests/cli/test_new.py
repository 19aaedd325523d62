"""A new study file is valid, with and without what is optional in it."""

from __future__ import annotations

import contextlib
import itertools
import re
import shlex

import numpy as np
import pytest

import halbach_fe as hf
from halbach_fe.cli import main
from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.geometry.array_layout import blocks_table
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation_operator import held_out_readings, observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.report.words import in_one_line
from halbach_fe.study.free_blocks import write_free_blocks
from halbach_fe.study.materials import grade
from halbach_fe.study.reader import read_study
from halbach_fe.study.writer import MagnetTemplate, new_study, parse_new_study
from tests.cli.test_cli import refused
from tests.conftest import ROOT

MAGNETS = [
    MagnetTemplate(shape=shape, iron_ring=iron, ring_length_m=length, rings=3 if length else 1,
                  multipole_order=order)
           for shape, iron, length, order in itertools.product(
               ("sector", "trapezoid", "cuboid"), (False, True), (None, 0.03), (1, 2))]
MAGNETS += [MagnetTemplate(material="N42"),
            MagnetTemplate(shape="cuboid", cube_m=0.012, ring_length_m=0.012, inner_radius_m=0.13,
                           outer_radius_m=0.142, blocks_per_ring=24, dsv_m=0.16, iron_ring=True),
            MagnetTemplate(steel="aisi_1010", iron_ring=True),
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


@pytest.mark.parametrize("row", [
    "prism,0,-0.0068,0,,0.013,-0.02 -0.05; 0.02 -0.05; 0.02 0; -0.02 0,,,,0,1.3,0",
    "sector,0,0,0,,0.0015875,,0.0015875,0.003175,360,0,0,1.32"])
def test_prisms_counted_from_their_tip_and_a_ring(tmp_path, capsys, row):
    """The bore of the first was 0.03 mm, and refused; the second's angle had to be below 360."""
    table, path = tmp_path / "blocks.csv", tmp_path / "study.toml"
    second = f"b,{row}\n".replace("-0.0068", "0.0068").replace(",,0.013", ",180,0.013")
    table.write_text(
        "name,shape,x_m,y_m,z_m,rotation_z_deg,size_z_m,outline_m,inner_radius_m,outer_radius_m,"
        f"angle_deg,remanence_x_T,remanence_y_T,remanence_z_T\na,{row}\n"
        + (second if "prism" in row else ""))
    assert main(["new", str(path), "--free-blocks", str(table)]) == 0
    magnet = build_magnet(read_study(path))
    points = points_from(read_study(path).observation.positions)
    assert not magnet.contains(points).any()
    assert np.isfinite(magnet.field_T(points)).all()
    assert "halbach-fe solve" in capsys.readouterr().err


@pytest.mark.parametrize("solid", [True, False])
@pytest.mark.parametrize(("places", "bore"), [
    ([(0, 0)], False), ([(0, 0.012), (0, -0.012)], False), ([(0.04, 0), (-0.04, 0)], True)])
def test_free_blocks_without_a_bore_are_measured_around_the_magnet(tmp_path, places, bore, solid):
    """A single block, poles that reach past the axis, and two poles that leave a bore."""
    table, path = tmp_path / "blocks.csv", tmp_path / "study.toml"
    table.write_text("name,shape,x_m,y_m,z_m,size_x_m,size_y_m,size_z_m,remanence_T\n" + "".join(
        f"b{i},cuboid,{x},{y},0,0.04,0.02,{0.02 if solid else ''},1.3\n"
        for i, (x, y) in enumerate(places)))
    assert main(["new", str(path), "--free-blocks", str(table)]) == 0
    study = read_study(path)
    magnet, points = build_magnet(study), points_from(study.observation.positions)
    assert not magnet.contains(points).any()
    assert study.homogeneity is None
    # with a bore circles within it, else points beyond the farthest corner
    corner = np.hypot(*np.add(np.abs(places[0]), (0.02, 0.01)))
    assert (np.hypot(*points[:, :2].T).max() < 0.02) if bore else (
        np.linalg.norm(points, axis=1).min() > corner)


@pytest.mark.parametrize(("options", "said"), [
    (["--rings", "3"], "--ring-length-m of the command line must be given with --rings"),
    (["--cube-m", "12", "--radius-m", "0.07"],
     "--cube-m of the command line must be less than twice --radius-m, 0.07")])
def test_a_refused_option_is_named_as_it_was_given(tmp_path, capsys, options, said):
    """Users of `new` do not know the keys yet, and a radius of -5.93 m was none of theirs."""
    assert main(["new", str(tmp_path / "wrong.toml"), *options]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "wrong.toml").exists()


CUBES = ["--cube-m", "0.012", "--radius-m", "0.136", "--blocks-per-ring", "24"]


def study_without_sphere(folder):
    """A dipole that is measured on circles."""
    path = folder / "circles.toml"
    assert main(["new", str(path), *CUBES, "--rings", "4"]) == 0
    return path


@pytest.mark.parametrize(("values", "said"), [
    ({"cube_m": 0.012}, "radius_m"),
    ({"cube_m": 0.012, "radius_m": 0.05, "shape": "sector"}, "shape"),
    ({"dsv_m": 0.04}, "ring_length_m"), ({"rings": 3}, "ring_length_m"),
    ({"material": "N42", "remanence_T": 1.0}, "remanence_T"), ({"sigma_T": 1e-3}, "sigma_T"),
    ({"inner_radii_m": (0.02, 0.03), "ring_length_m": 0.03, "rings": 5}, "rings"),
    ({"ring_length_m": 0.04, "dsv_m": 0.12}, "the region")])
def test_values_without_effect_are_refused_in_python_too(tmp_path, values, said):
    """Cubes were sectors of a cross-section there, and a grade took the place of a remanence."""
    with pytest.raises(StudyError, match=f"^Input {said} of"):
        hf.new(tmp_path / "new.toml", **values)
    assert not (tmp_path / "new.toml").exists()


@pytest.mark.parametrize(("options", "values"), [
    (["--cube-m", "0.012", "--radius-m", "0.05", "--rings", "2", "--iron-ring"],
     {"cube_m": 0.012, "radius_m": 0.05, "rings": 2, "iron_ring": True}),
    (["--steel", "aisi_1010"], {"steel": "aisi_1010"}),
    (["--inner-radii-m", "0.06,0.1", "--ring-length-m", "0.03"],
     {"inner_radii_m": (0.06, 0.1), "ring_length_m": 0.03})])
def test_python_makes_the_study_of_the_command(tmp_path, options, values):
    path = tmp_path / "cli" / "magnet.toml"
    path.parent.mkdir()
    assert main(["new", str(path), *options]) == 0
    assert hf.new(tmp_path / "magnet.toml", **values).study == read_study(path)


@pytest.mark.parametrize(("options", "code", "said"), [
    (["--ring-length-m", "0.04", "--dsv-m", "0.12"], 3, "is inside magnet or iron"),
    (["--ring-length-m", "0.04", "--dsv-m", "0.5"], 3, "which contains blocks"),
    (["--ring-length-m", "0.04", "--dsv-m", "20"], 3, "Was it meant in millimetres?"),
    (["--dsv-m", "0.05"], 2, "A cross-section has no volume")])
def test_spheres_that_are_no_volume_of_the_bore(tmp_path, capsys, options, code, said):
    found, sentence = refused(["new", tmp_path / "new.toml", *options], capsys)
    assert found == code
    assert said in sentence
    assert not (tmp_path / "new.toml").exists()


@pytest.mark.parametrize("away", [0.0, 0.3])
def test_blocks_are_measured_where_they_are(tmp_path, away):
    """Sphere and region were about the origin, 0.3 m beside these blocks, which were said to be
    660 mm long. Iron without a length is as long, and about z = 0, which is said.
    """
    table, path = tmp_path / "blocks.csv", tmp_path / "study.toml"
    ring = hf.halbach_ring(inner_radius_m=0.04, outer_radius_m=0.06, length_m=0.06, rings=2)
    columns = blocks_table(ring)
    write_free_blocks(columns | {"z_m": np.array(columns["z_m"]) + away}, table)
    assert main(["new", str(path), "--free-blocks", str(table), "--dsv-m", "0.03"]) == 0
    study = read_study(path)
    magnet, middle = build_magnet(study), (0.0, 0.0, away)
    assert study.homogeneity.centre_m == (middle if away else None)  # the middle of the blocks
    np.testing.assert_allclose(np.linalg.norm(
        points_from(study.observation.positions) - middle, axis=1), 0.015, rtol=1e-3)
    assert ", 60 mm long," in in_one_line(magnet)
    with pytest.warns(HalbachWarning, match=r"it is 0.66 m long") if away else (
            contextlib.nullcontext()):
        iron = magnet.with_(iron_ring={
            "inner_radius_m": 0.07, "outer_radius_m": 0.08, "relative_permeability": 1000.0})
    assert iron.with_(iron_ring__length_m=0.7)  # without a word


def test_cubes_around_a_sphere_with_noise_that_suits_them(tmp_path):
    """A magnet of cubes makes some 10 mT, and a cross-section of sectors some 0.7 T."""
    path, strong = tmp_path / "cubes.toml", tmp_path / "strong.toml"
    assert main(["new", str(path), *CUBES, "--rings", "4", "--dsv-m", "0.16"]) == 0
    study = read_study(path)
    points = points_from(study.observation.positions)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.08, rtol=1e-3)
    assert study.homogeneity.sphere_m == 0.08  # its field is to be homogeneous there
    assert read_study(study_without_sphere(tmp_path)).homogeneity is None
    assert study.array.block.width_m == study.array.ring_length_m == 0.012
    hidden = held_out_readings(study, observe(study, points, np.ones_like(points, bool)))
    assert hidden.mean() == pytest.approx(1 / 5, abs=0.01)
    assert main(["new", str(strong), "--steel", "aisi_1010"]) == 0
    assert read_study(strong).iron_ring.curve.name == "aisi_1010"
    noise, other = study.noise, read_study(strong).noise
    assert 1e-6 <= noise.regions[0].sigma_T <= 3e-6
    assert 5e-5 <= other.regions[0].sigma_T <= 1e-4  # the control: not that of every magnet
    assert 1e-5 <= noise.position_sd_m[0] <= 1e-4


@pytest.mark.parametrize(("options", "code", "said"), [
    (["--cube-m", "0.012"], 2, "--radius-m"), ([*CUBES, "--shape", "sector"], 2, "--shape"),
    (["--inner-radii-m", "0.02,0.03"], 2, "--ring-length-m"),
    (["--inner-radii-m", "0.02,0.03", "--ring-length-m", "0.03", "--rings", "2"], 2, "--rings"),
    (["--free-blocks", "{overlapping}"], 3, "overlap"),
    *((["--free-blocks", str(ROOT / "studies/mri4all/blocks.csv"), option, value], 2, option)
      for option, value in (("--remanence-T", "1.2"), ("--shape", "sector"), ("--rings", "1"),
                            ("--blocks-per-ring", "16"), ("--ring-length-m", "0.1"),
                            ("--material", "N42"), ("--outer-radius-m", "0.2")))])
def test_options_that_a_study_would_not_show(tmp_path, capsys, options, code, said):
    """Nor is a study written that no command could use."""
    path, overlapping = tmp_path / "magnet.toml", tmp_path / "overlapping.csv"
    overlapping.write_text(
        "name,shape,x_m,y_m,z_m,size_x_m,size_y_m,size_z_m,remanence_T\n"
        "a,cuboid,-0.03,0,0,0.02,0.02,0.02,1.3\nb,cuboid,-0.02,0,0,0.02,0.02,0.02,1.3\n")
    options = [each.format(overlapping=overlapping) for each in options]
    assert main(["new", str(path), *options]) == code
    assert said in capsys.readouterr().err
    assert not path.exists()


@pytest.mark.parametrize("name", ["my magnet.toml", "-x.toml"])
def test_the_command_that_is_proposed_works(tmp_path, capsys, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "--", name]) == 0
    proposed = capsys.readouterr().err.partition("Next: halbach-fe ")[2]
    words = shlex.split(proposed)
    assert words[0] == "solve"
    assert main(["multipoles", words[1], "-o", "out"]) == 0


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


def test_prisms_whose_outlines_begin_at_their_tip(tmp_path):
    """Their origin is no middle of the block: the farthest corner is no size of a mesh."""
    (tmp_path / "wedges.csv").write_text(
        "name,shape,x_m,y_m,z_m,rotation_z_deg,size_z_m,outline_m,remanence_T\n" + "".join(
            f"w{n},prism,0.02,0,0,{angle},0.03,0 0; 0.03 -0.008; 0.03 0.008,1.2\n".replace(
                ",0.02,0,", f",{0.02 * np.cos(np.radians(angle)):.6f},"
                f"{0.02 * np.sin(np.radians(angle)):.6f},")
            for n, angle in enumerate((0, 90, 180, 270))))
    study = tmp_path / "study.toml"
    assert main(["new", str(study), "--free-blocks", str(tmp_path / "wedges.csv")]) == 0
    magnet = build_magnet(read_study(study))
    assert len(magnet.blocks) == 4
    assert magnet.blocks[0].contains(np.array([[0.045, 0.0, 0.0], [0.015, 0.0, 0.0]])).tolist() == [
        True, False]
