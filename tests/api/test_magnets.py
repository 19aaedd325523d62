"""Magnets that are made in Python, against magpylib, and without any file."""

from __future__ import annotations

import pickle
import re
import tomllib
from functools import partial

import magpylib
import numpy as np
import pandas
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

import halbach_fe as hf
from halbach_fe.cli import main
from halbach_fe.cli.verbs import VERBS
from halbach_fe.core.errors import StudyError
from halbach_fe.core.installation import version
from halbach_fe.magnets import WRITTEN
from halbach_fe.study.reader import parse_study
from tests.conftest import ROOT
from tests.support.short_dipole import TEXT, measured, truth

POINTS = np.array([[0.002, 0.001, 0.003], [-0.004, 0.003, -0.001], [0.0, -0.005, 0.002]])
SLACK_T = 1e-8
"""magpylib's own sectors are exact to 1e-9 of their remanence or so."""


def test_what_a_magnet_and_lines_keep_cannot_be_changed_in_place():
    """A magnetization doubled, or mm for a picture, counted in all that was asked later."""
    magnet = hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04, length_m=0.03)
    lines = hf.Lines((0, 0, -0.01), (0, 0, 0.01))
    for ask in (lambda: magnet.nominal_magnetization, lambda: lines.points):
        kept = ask()
        kept *= 1000
        np.testing.assert_array_equal(1000 * ask(), kept)


def test_a_cell_that_pandas_calls_not_available_is_empty():
    frame = pandas.DataFrame({"shape": ["cuboid"] * 2, "x_m": [-0.04, 0.04], "y_m": 0.0, "z_m": 0.0,
                              "remanence_T": 1.3, **{f"size_{axis}_m": 0.02 for axis in "xyz"}})
    turned = frame.assign(rotation_z_deg=pandas.array([0.0, pandas.NA], dtype="Float64"))
    assert hf.magnet_of_blocks(turned).field_T(POINTS) == pytest.approx(
        hf.magnet_of_blocks(frame).field_T(POINTS), rel=1e-12)


def test_a_ring_is_a_halbach_array():
    """The field of many thin sectors is that of the continuous array, Br ln(b/a), for a dipole."""
    magnet = hf.halbach_ring(blocks=64, inner_radius_m=0.02, outer_radius_m=0.04, remanence_T=1.2)
    assert magnet.dimension == 2
    field = magnet.field_T([0.0, 0.0, 0.0])
    assert field == pytest.approx([1.2 * np.log(2), 0.0, 0.0], rel=2e-3)
    quadrupole = magnet.with_(array__multipole_order=2)
    gradient = (quadrupole.field_T([1e-3, 0, 0]) / 1e-3)[0]
    assert gradient == pytest.approx(2 * 1.2 * (1 / 0.02 - 1 / 0.04), rel=4e-3)
    assert quadrupole.field_T([1e-3, 0, 0])[0] != pytest.approx(field[0], rel=0.5)  # control


def test_magnets_go_to_magpylib_and_back():
    rings = hf.halbach_ring(order=2, blocks=8, rings=2, inner_radius_m=0.01, outer_radius_m=0.03,
                            length_m=0.04, shape="trapezoid")
    prism = hf.magnet_of_blocks({
        "shape": ["prism", "polygon"], "x_m": [0.03, -0.03], "y_m": [0.0, 0.0],
        "z_m": [0.0, 0.01], "rotation_x_deg": [10.0, 40.0], "size_z_m": [0.01, 0.02],
        "outline_m": [((0.0, 0.0), (0.02, 0.0), (0.0, 0.01)), None], "sides": [None, 6],
        "radius_m": [None, 0.008], "remanence_T": [1.3, 1.1]})
    for magnet in (rings, prism):
        there = hf.to_magpylib(magnet)
        assert len(there) == len(magnet.blocks)
        assert magnet.field_T(POINTS) == pytest.approx(there.getB(POINTS), abs=SLACK_T)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5])
    sources = magpylib.Collection(
        magpylib.magnet.Cuboid(dimension=(0.01, 0.02, 0.015), polarization=(0.3, 1.0, -0.2),
                               position=(0.03, 0.0, 0.0), orientation=turn),
        magpylib.Collection(magpylib.magnet.Cylinder(
            dimension=(0.01, 0.02), polarization=(0.0, 0.1, 1.2), position=(-0.03, 0.01, 0.0),
            orientation=turn)),
        magpylib.magnet.CylinderSegment(
            dimension=(0.01, 0.02, 0.01, 30, 80), polarization=(1.0, 0.4, 0.2),
            position=(0.0, 0.02, 0.03), orientation=turn),
        magpylib.magnet.CylinderSegment(dimension=(0.01, 0.02, 0.01, 0, 360),
                                        polarization=(0, 0, 1.0), position=(0, 0, -0.04)))
    magnet = hf.from_magpylib(sources)
    assert magnet.field_T(POINTS) == pytest.approx(sources.getB(POINTS), abs=SLACK_T)
    back = hf.to_magpylib(magnet)
    assert back.getB(POINTS) == pytest.approx(sources.getB(POINTS), abs=SLACK_T)
    # negative control: a source that is turned otherwise
    sources[0].rotate_from_angax(5, "x")
    assert magnet.field_T(POINTS) != pytest.approx(sources.getB(POINTS), abs=1e-4)


def test_the_field_of_many_permeable_blocks_is_that_of_solve(generator):
    """Closed forms, not expansions, which the many points of iron have: of these 72 cubes they are
    up to 2.8e-5 of the field off in the bore, 6e-6 rms, and ppm matter in homogeneous magnets.
    """
    magnet = hf.halbach_ring(1, 12, inner_radius_m=0.06, outer_radius_m=0.075, length_m=0.12,
                             rings=6, remanence_T=1.3, recoil_permeability=1.05, shape="cuboid")
    points = generator.uniform(-0.025, 0.025, (200, 3))
    solved = hf.solve(magnet.with_(observation__positions={
        "kind": "points", "points_m": points.tolist()}))
    size = np.linalg.norm(solved.flux_density, axis=1).mean()
    assert np.abs(magnet.field_T(points) - solved.flux_density).max() < 1e-9 * size


def test_what_magpylib_leaves_out_is_said():
    ring = hf.halbach_ring(blocks=4, inner_radius_m=0.02, outer_radius_m=0.04, length_m=0.03)
    assert hf.to_magpylib(ring)  # control: permeability 1, and nothing else; warnings are errors
    for changes, said in (
            ({"array__recoil_permeability": 1.05}, "the permeability of the blocks of magnet"),
            ({"external__background_T": (0.0, 0.0, 1e-3)}, "the background"),
            ({"demagnetization": {
                "intrinsic_coercivity_A_per_m": 9e5, "remanence_coefficient_per_K": -0.0012,
                "coercivity_coefficient_per_K": -0.006, "irreversible": True}}, "losses of magnet"),
            ({"iron_ring": {"inner_radius_m": 0.05, "outer_radius_m": 0.06,
                            "relative_permeability": 100.0},
              "external__coils": [{"kind": "round", "radius_m": 0.2, "current_A": 1.0}]},
             "iron, coils of magnet")):
        with pytest.warns(hf.HalbachWarning, match=said):
            hf.to_magpylib(ring.with_(**changes))


@pytest.mark.parametrize(("sources", "said"), [
    (magpylib.magnet.Sphere(diameter=0.01, polarization=(0, 0, 1)), "a Sphere"),
    ([], "instead received none"),
    (magpylib.magnet.Cuboid(dimension=(0.01, 0.01, 0.01), polarization=(0, 0, 1),
                            position=[(0, 0, 0), (0, 0, 1)]), "at one place")])
def test_what_magpylib_has_and_blocks_are_not(sources, said):
    with pytest.raises(StudyError, match=said):
        hf.from_magpylib(sources)


def test_a_prism_that_is_not_convex_is_refused():
    magnet = hf.magnet_of_blocks({
        "shape": ["prism"], "x_m": [0.0], "y_m": [0.0], "z_m": [0.0], "size_z_m": [0.01],
        "outline_m": [((0, 0), (0.02, 0), (0.002, 0.002), (0, 0.02))], "remanence_T": [1.3]})
    with pytest.raises(StudyError, match="convex"):
        hf.to_magpylib(magnet)
    ring = hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04, length_m=0.03)
    with pytest.warns(hf.HalbachWarning, match="leave out the background"):
        hf.to_magpylib(ring.with_(external={"background_T": (0.0, 0.01, 0.0)}))
    with pytest.raises(StudyError, match="uniformly"):
        hf.to_magpylib(hf.halbach_ring(
            inner_radius_m=0.02, outer_radius_m=0.04, length_m=0.03).with_(
                array__exceptions=[{"ring": 1, "slot": 1, "inner_corner_loss": 0.5}]))
    with pytest.raises(StudyError, match="cross-section"):
        hf.to_magpylib(hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04))


@pytest.mark.parametrize("size", [1e-4, 3e-4, 1e-3, 2e-3, 3e-3])
def test_a_small_magnet(tmp_path, size):
    """One cube, whose mesh keeps to the limits of the study; its field against magpylib."""
    table = tmp_path / "small.csv"
    table.write_text("name,shape,x_m,y_m,z_m,size_x_m,size_y_m,size_z_m,remanence_T\n"
                     f"a,cuboid,0,0,0,{size},{size},{size},1.3\n")
    made = hf.magnet_of_blocks({
        "shape": ["cuboid"], "x_m": [0.0], "y_m": [0.0], "z_m": [0.0], "size_x_m": [size],
        "size_y_m": [size], "size_z_m": [size], "remanence_T": [1.3]})
    assert main(["new", str(tmp_path / "new.toml"), "--free-blocks", str(table)]) == 0
    point = np.array([[1.0, 0.7, 1.5]]) * size
    expected = magpylib.magnet.Cuboid(polarization=(1.3, 0, 0), dimension=(size,) * 3).getB(point)
    for magnet in (made, hf.build_magnet(hf.read_study(tmp_path / "new.toml"))):
        np.testing.assert_allclose(magnet.field_T(point), [expected], atol=1e-12)


def test_a_study_is_written_and_read_back(tmp_path):
    ring = hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04, length_m=0.03,
                           material="N42").with_(prior__magnitude_sd=0.02)
    with pytest.warns(hf.HalbachWarning, match="the permeability of the blocks"):
        sources = hf.to_magpylib(ring)
    for name, magnet in (("ring", ring), ("free", hf.from_magpylib(sources))):
        hf.write_study(magnet, tmp_path / f"{name}.toml")
        assert hf.read_study(tmp_path / f"{name}.toml") == magnet.study
    other = hf.from_magpylib(list(sources)[:3])
    hf.write_study(other, tmp_path / "few.toml")  # another table beside the same folder's
    assert hf.read_study(tmp_path / "free.toml") == magnet.study
    assert hf.read_study(tmp_path / "few.toml") == other.study


GRID_M = np.stack(np.meshgrid([0.0, 1e-3], [0.0, 1e-3], [0.0, 1e-3], indexing="ij"), -1)


def block_magnet(path):
    return hf.magnet_of_blocks({
        "shape": ["cuboid"], "x_m": [0.0], "y_m": [0.0], "z_m": [0.0], "size_x_m": [0.02],
        "size_y_m": [0.02], "size_z_m": [0.02], "remanence_T": [1.3]})


def a_map(path):
    return hf.field_map(GRID_M.reshape(-1, 3), 0.1 + GRID_M.reshape(-1, 3))


def exported(content, kind):
    return lambda path: hf.export(content(path), path, kind)


def solved(path):
    """Solve by GetDP in the folder of a path; a second time with another mesh."""
    finer = 1.0 - 0.1 * path.exists()
    hf.solve(hf.halbach_ring(**{**RING, "length_m": None}).with_(
        array__recoil_permeability=1.05, mesh__block_size_m=0.01 * finer),
        hf.Session.open(path.parent))


REPLACING = {
    "a.csv": lambda path: hf.write_map(a_map(path), path),
    "a.h5": lambda path: hf.write_map(a_map(path), path),
    "a.vtu": lambda path: hf.write_map(a_map(path), path),
    "bdsim.dat": exported(a_map, "bdsim"), "geant4.table": exported(a_map, "geant4"),
    "openpmd.h5": exported(a_map, "openpmd"), "b.csv": exported(a_map, "csv"),
    "b.vtu": exported(a_map, "vtu"), "blocks.csv": exported(block_magnet, "csv"),
    "blocks.h5": exported(block_magnet, "csv"),
    "a.toml": lambda path: hf.write_study(hf.halbach_ring(**RING), path),
    "b.blocks.csv": lambda path: hf.write_study(block_magnet(path), path.parent / "b.toml"),
    "report.html": lambda path: hf.write_report(hf.solve(hf.halbach_ring(**RING)), path.parent),
    "mesh.msh": solved, "regions.json": solved}
"""What writes a file of a name. `halbach_fe.new` replaces nothing, its own files neither."""


@pytest.mark.parametrize("name", REPLACING)
def test_a_file_of_somebody_else_is_not_replaced(tmp_path, name):
    """Nor one that was changed since. Control: what the function wrote itself is replaced."""
    path = tmp_path / name
    for text in ("# map of a day\nx_m,y_m,z_m,Bx_T\n0,0,0,1\n", "", WRITTEN + "mine"):
        path.write_text(text)
        with pytest.raises(hf.HalbachError, match=rf"{name} .*would replace it"):
            REPLACING[name](path)
        assert path.read_text() == text
        assert {one.name for one in tmp_path.iterdir()} <= {name, "run.json"}
    path.unlink()
    for _ in range(2):
        REPLACING[name](path)
    if name in ("mesh.msh", "regions.json"):  # checked by their content whenever they are read
        return
    path.write_bytes(mine := path.read_bytes() + b"# mine\n")
    with pytest.raises(hf.HalbachError, match=r"changed after .* would replace it"):
        REPLACING[name](path)
    assert path.read_bytes() == mine


class Quantity:
    """A number with a unit, as pint and astropy have."""

    magnitude = 30.0


RING = {"order": 1, "blocks": 8, "inner_radius_m": 0.03, "outer_radius_m": 0.05}


@pytest.mark.parametrize(("call", "said"), [
    (lambda frame: hf.halbach_ring(**RING | {"inner_radius_m": "30 mm"}), "inner_radius_m.*number"),
    (lambda frame: hf.halbach_ring(**RING | {"inner_radius_m": Quantity()}), "a number"),
    (lambda frame: hf.halbach_ring(**RING | {"inner_radius_m": None}), "inner_radius_m.*number"),
    (lambda frame: hf.halbach_ring(**RING).field_T(frame.set_axis(["r", "phi", "z"], axis=1)),
     "r, phi, z in place of x, y, z"),
    (lambda frame: hf.halbach_ring(**RING).field_T(frame.rename(columns={"x": "time_s"})),
     "time_s, y, z in place of"),
    (lambda frame: hf.halbach_ring(**RING).field_T(frame.to_numpy().astype("M8[s]")), "times"),
    (lambda frame: hf.halbach_ring(**RING).field_T(frame.to_numpy() > 0), "true and false"),
    (lambda frame: hf.halbach_ring(**RING).field_T(Quantity()), "unit of their own"),
    (lambda frame: hf.field_map(frame, frame[["x", "y"]].rename(columns="B{}_T".format),
                                components=["y", "z"]), "Bx_T, By_T, of which z is not there"),
    (lambda frame: hf.halbach_ring(**RING).field_T(frame.rename(columns="{}_mm".format)),
     "other units than m and T: x_mm, y_mm, z_mm"),
    (lambda frame: hf.field_map(frame, frame.rename(columns="B{} [mT]".format)), r"Bx \[mT\]"),
    (lambda frame: hf.field_map(3.0, 3.0), "of shapes"),
    (lambda frame: hf.infer(hf.halbach_ring(**RING), frame, [[0.1], [0.1, 0.2]]), "is none"),
    (lambda frame: hf.to_magpylib(hf.halbach_ring(**RING).study), "must be a Magnet"),
    (lambda frame: hf.write_study("ring.toml", hf.halbach_ring(**RING)), "be a Magnet"),
    (lambda frame: hf.field_map(frame, frame, "50 uT"), "sigma_T.*numbers in T"),
    (lambda frame: hf.infer(hf.halbach_ring(**RING), hf.Session.temporary(),
                            hf.field_map(frame, frame)), "must be a Dataset or a dict")])
def test_arrays_that_say_what_they_are(call, said):
    """Columns by name and numbers with units are not read as if they were plain."""
    frame = pandas.DataFrame([[0.0, 0.001, 0.0], [0.0, 0.0, 0.001]], columns=["x", "y", "z"])
    ring = hf.halbach_ring(**RING | {"inner_radius_m": np.array(0.03)})  # the control
    assert np.isfinite(ring.field_T(frame)).all()
    along = hf.field_map(frame, [0.1, 0.2], components=["y"])["B_T"].sel(component="y")
    assert along.values.tolist() == [0.1, 0.2]
    with pytest.raises(hf.HalbachError, match=said):
        call(frame)


def test_positions_and_readings_that_are_exchanged(generator):
    ring = hf.halbach_ring(order=1, blocks=8, inner_radius_m=0.03, outer_radius_m=0.05,
                           length_m=0.06)
    points = generator.uniform(-0.015, 0.015, (40, 3))
    field = ring.field_T(points) + 5e-5 * generator.standard_normal((40, 3))
    with pytest.raises(hf.HalbachError, match="given in this order"):
        hf.infer(ring, field, points, sigma_T=5e-5)
    assert hf.infer(ring, points, field, sigma_T=5e-5).disagreement == ""
    with pytest.warns(hf.HalbachWarning, match="cannot all be right"):  # no page says so
        assert hf.infer(ring, points, -field, sigma_T=5e-5).disagreement


def test_a_magnet_is_inferred_from_arrays_alone(tmp_path, monkeypatch, generator):
    """The truth is magpylib's: one block is 2 % weak. No file and no folder is named."""
    monkeypatch.chdir(tmp_path)
    magnet = hf.halbach_ring(order=2, blocks=8, inner_radius_m=0.015, outer_radius_m=0.03,
                             length_m=0.03)
    truth = hf.to_magpylib(magnet)
    truth[2].polarization = 0.98 * truth[2].polarization
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    points = np.vstack([np.column_stack([0.01 * np.cos(angle), 0.01 * np.sin(angle),
                                         np.full(24, z)]) for z in (-0.02, -0.01, 0.0, 0.01, 0.02)])
    readings = truth.getB(points) + 2e-5 * generator.standard_normal(points.shape)
    result = hf.infer(magnet, points, readings, sigma_T=2e-5)
    of_a_map = hf.infer(magnet, hf.field_map(points, readings, sigma_T=2e-5))
    assert np.array_equal(result.posterior.mean, of_a_map.posterior.mean)
    kept = pickle.loads(pickle.dumps(result))  # as processes that share work do
    assert np.array_equal(kept.posterior.covariance, result.posterior.covariance)
    rows = np.arange(5)
    assert np.array_equal(kept.prediction_posterior.root(rows),
                          result.prediction_posterior.root(rows))
    two = {"components": ["x", "y"], "sigma_T": 2e-5}
    of_two = hf.infer(magnet, points, readings[:, :2], **two)
    assert np.array_equal(of_two.posterior.mean, hf.infer(magnet, hf.field_map(
        points, readings[:, :2], **two)).posterior.mean)
    with pytest.raises(hf.HalbachError, match=r"as in components=\['x', 'y'\]"):
        hf.infer(magnet, points, readings[:, :2])
    with pytest.raises(hf.HalbachError, match=r"shapes \(n, 3\).*received \(119, 3\) and"):
        hf.explain(magnet, points[1:], readings, sigma_T=2e-5)
    # sigma_T is all the noise there is: nobody has said that the positions are uncertain
    used = result.response.matrix[~result.held_out] / 2e-5
    covariance = np.linalg.inv(np.linalg.inv(result.prior.covariance) + used.T @ used)
    sd = np.sqrt(np.diag(covariance))
    assert np.allclose(result.posterior.covariance / np.outer(sd, sd),
                       covariance / np.outer(sd, sd), rtol=0, atol=1e-6)  # inverses are rounded
    sizes = np.linalg.norm(result.posterior.mean.reshape(-1, 3), axis=1) / np.linalg.norm(
        magnet.nominal_magnetization.reshape(-1, 3), axis=1)
    assert sizes[2] == pytest.approx(0.98, abs=2e-3)
    assert np.delete(sizes, 2) == pytest.approx(1.0, abs=3e-3)
    assert not list(tmp_path.iterdir())
    for one in (magnet, magnet.study, result, result.magnet):
        assert "\n" not in repr(one)
        assert len(repr(one)) < 500


def test_a_study_of_keys_names_all_that_are_missing():
    """In the words of a study file, and no error of pydantic. Control: a whole study is one."""
    with pytest.raises(StudyError, match=r"`name`, `array`, `mesh`, `observation` of study must be "
                                         r"given; instead received nothing\. Add the keys\.$"):
        hf.Study(dimension=2)
    with pytest.raises(StudyError, match="by name"):
        hf.Study({"name": "a"})
    whole = hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04).study
    assert hf.Study(**whole.model_dump()) == whole


@pytest.mark.parametrize(("call", "said"), [
    (lambda: hf.halbach_ring(inner_radius_m=0.04, outer_radius_m=0.02), "outer_radius_m"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04, material="N42",
                             remanence_T=1.2), "given alone"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04, length_m=0.1, rings=0),
     "rings .* at least 1"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04, recoil_permeability=0),
     "recoil_permeability"),
    # a ring without length was a cross-section, and a grade without a name one of 1.3 T
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04, length_m=0.0),
     "ring_length_m"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04, material=""), "material"),
    (lambda: hf.magnet_of_blocks({"shape": ["cuboid"], "x_m": [0.0]}), "y_m"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04).field_T([1, 2]), "x, y, z"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04).field_T([0.03, 0, 0]),
     "in air"),
    (lambda: hf.halbach_ring("dipole", inner_radius_m=0.02, outer_radius_m=0.04),
     "order of halbach_ring must be .* received 'dipole'"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04).field_T("0, 0, 0"),
     "a str that is none"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04).field_T([[0, np.nan, 0]]),
     "values that are not finite"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04).field_T([[0, 1e300, 0]]),
     "above 1e30"),
    (lambda: hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04).field_T(
        np.ma.masked_less([[0.0, -1.0, 0.0]], 0)), "values that are not finite"),
    (lambda: hf.magnet_of_blocks({"shape": "cuboid", "x_m": 0.0}), "columns by name"),
    (lambda: hf.magnet_of_blocks([{"shape": "cuboid", "x_m": 0.0}]), "One block is"),
    (lambda: hf.magnet_of_blocks({"shape": ["sphere"], "x_m": [0.0], "y_m": [0.0], "z_m": [0.0],
                                  "radius_m": [0.01], "remanence_T": [1.3]}), "received 'sphere'"),
    (lambda: hf.field_map(np.zeros((9, 3)), np.zeros((9, 3)), np.full(8, 1e-5)), "sigma_T"),
    (lambda: hf.field_map([[0, 0, 0]], [[1.0, 2.0]]), "of shapes"),
    (lambda: hf.field_map([[0, 0, 0]], [[1.0, 2.0j, 3.0]]), "complex numbers"),
    (lambda: hf.Lines((0, 0), (0, 0, 1)), "finite x, y, z in m"),
    (lambda: hf.Lines((0, 0, 0), (0, 0, np.nan)), "finite x, y, z in m"),
    (lambda: hf.Lines((0, 0, 0), (0, 0, 1), across=(np.nan, 0)), "across finite"),
    (lambda: hf.Lines((0, 0, 0), (0, 0, 1), across=0.01), "two arrays of offsets"),
    (lambda: hf.Lines((0, 0, 0), (0, 0, 1), count=3.5), "count of lines must be a whole number"),
    (lambda: hf.export(hf.halbach_ring(inner_radius_m=0.02, outer_radius_m=0.04), "a.vtu", "vtu"),
     "format of hf.export must be left out for a magnet"),
    (lambda: hf.import_blocks("a.csv", fixed="sigma=1 %"), "fixed of hf.import_blocks"),
    (lambda: hf.field_map([[0, 0, 0]], [[1.0, 2.0]], components=["x", "Br"]), "out of x, y, z")])
def test_mistakes_get_a_sentence(call, said):
    with pytest.raises(hf.HalbachError, match=said):
        call()


def test_a_masked_reading_is_none():
    """It was read as if it were not masked."""
    field = np.ma.masked_greater([[0.1, 5.0, 0.2], [0.1, 0.2, 0.3]], 1.0)
    data = hf.field_map(np.zeros((2, 3)), field, np.ma.masked_less([1e-5, 2e-5, 3e-5], 0))
    assert np.isnan(data["B_T"].values).tolist() == [[False, True, False], [False] * 3]
    assert data["sigma_T"].values[0, 0] == 1e-5
    assert hf.Lines((0, 0, 0), (0, 0, 1), across=(0.01, [0.0, 0.02])).points.shape == (2, 201, 3)


def test_names_of_components():
    """Control: another unit, and a component named twice."""
    for names in (["By", "Bx"], ["By_T", "Bx_T"], ["y", "x"], "yx"):
        data = hf.field_map([[0, 0, 0]], [[0.2, 0.1]], components=names)
        assert data["B_T"].values[0, :2].tolist() == [0.1, 0.2]
    for wrong in (["By_mT", "Bx_mT"], ["Bx", "x"], ["Br", "Bz"]):
        with pytest.raises(hf.HalbachError, match=", ".join(["components out of x", "y", "z"])):
            hf.field_map([[0, 0, 0]], [[0.2, 0.1]], components=wrong)


def test_noise_of_three_readings_or_of_three_components():
    """Three numbers may be of either, and were taken as of components. The advice is followed."""
    sigma = np.array([1e-5, 2e-5, 3e-5])
    with pytest.raises(hf.HalbachError, match=r"sigma_T\[:, None\] for each reading"):
        hf.field_map(np.eye(3), np.eye(3), sigma)
    for one in (sigma[None, :], sigma[:, None], [1e-5] * 3):
        expected = np.broadcast_to(one, (3, 3))
        assert np.array_equal(hf.field_map(np.eye(3), np.eye(3), one)["sigma_T"], expected)


def test_noise_of_each_reading_is_that_of_its_components():
    """One sigma a reading, one a component, and one for each value."""
    sigma = np.arange(1.0, 6.0)
    points, field = np.zeros((5, 3)), np.ones((5, 3))
    full = np.tile(sigma[:, None], 3)
    for given, expected in ((sigma, full), (full, full), ([1.0, 2.0, 3.0], full[:3, :1].T)):
        found = hf.field_map(points, field, given)["sigma_T"].values
        np.testing.assert_array_equal(found, np.broadcast_to(expected, (5, 3)))


def test_the_version_is_that_of_the_package():
    assert hf.__version__ == version("halbach-fe")


def test_a_displaced_map_is_explained_in_python(generator):
    """The map lies 1.5 mm off along z, which an update by itself does not explain."""
    source = truth(generator, 0.005)
    data = measured(source, generator, Rotation.identity(), np.array([0.0, 0.0, -0.0435]))
    magnet = hf.build_magnet(parse_study(tomllib.loads(TEXT)).with_(instrument={
        "translation_m": [0.0, 0.0, -0.045]}))
    found = hf.explain(magnet, data)
    assert list(found.answers) == ["check", "inferred", "registered", "updated"]
    assert not found.answers["inferred"].sound
    assert found.sound
    assert found.diagnosis is None
    z = found.inference.magnet.study.instrument.translation_m[2]
    assert z == pytest.approx(-0.0435, abs=5 * found.poses[0].translation_sd_m[2])
    assert "\n" not in repr(found)


OTHER_NAMES = {"check": "check_map", "design": "design_rings", "report": "campaign_report"}
"""Functions whose names say more than those of their commands."""

OF_THE_SHELL = {"cache", "doctor", "schema", "completion"}
"""Commands about the installation and the command line."""


def without_function(verbs, names):
    return [verb for verb in verbs if verb not in OF_THE_SHELL
            and OTHER_NAMES.get(verb, verb).replace("-", "_") not in names]


def test_every_command_is_a_function():
    assert without_function(VERBS, hf.__all__) == []
    assert all(callable(getattr(hf, OTHER_NAMES.get(verb, verb).replace("-", "_")))
               for verb in VERBS if verb not in OF_THE_SHELL)
    assert without_function([*VERBS, "levitate"], hf.__all__) == ["levitate"]  # the control


def without_row(verbs, page):
    text = (ROOT / page).read_text(encoding="utf-8")
    return [verb for verb in verbs if not re.search(rf"\| `{verb}[ `]", text)]


def test_every_command_has_its_rows():
    assert without_row(VERBS, "README.md") == []
    assert without_row(VERBS.keys() - OF_THE_SHELL, "docs/from-python.md") == []
    assert without_row([*VERBS, "levitate"], "README.md") == ["levitate"]  # the control


def test_options_of_other_names_are_refused(tmp_path):
    for call in (partial(hf.new, tmp_path / "a.toml"), partial(hf.import_map, tmp_path / "a.csv")):
        with pytest.raises(hf.HalbachError, match="Input lenght"):
            call(lenght=1)
    with pytest.raises(hf.HalbachError, match=r"format .*'stl'"):
        hf.export(hf.field_map([[0, 0, 0]], [[1, 0, 0]], sigma_T=1e-5), tmp_path / "a", "stl")


def test_a_command_whose_function_has_another_name_is_told():
    """A control: of a name that is no command nothing is told."""
    with pytest.raises(AttributeError, match=r"what `halbach-fe check` does is check_map\(\)$"):
        hf.check  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'chek'$"):
        hf.chek  # noqa: B018


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_posterior_that_was_changed(tmp_path, generator, value):
    """By an assignment to its arrays, of which nothing follows any more. Control: as it was."""
    magnet = hf.halbach_ring(**RING)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    points = 0.02 * np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    result = hf.infer(magnet, points, magnet.field_T(points) + generator.normal(0, 1e-4, (24, 3)),
                      sigma_T=1e-4)
    calls = [lambda: hf.multipoles(magnet, posterior=result),
             lambda: hf.homogeneity(magnet, posterior=result), lambda: hf.shim(result, swaps=1),
             lambda: hf.magnetic_axis(magnet, hf.Session.temporary(), result.posterior),
             lambda: hf.write_report(result, tmp_path / "page")]
    for call in calls[:1]:
        call()
    result.posterior.mean[:] = value
    for call in calls:
        with pytest.raises(hf.HalbachError, match="Was the array changed"):
            call()


def test_labelled_arrays(generator):
    """Their labels say what is what, in any order. Control: labels that are missing are refused."""
    ring = hf.halbach_ring(**RING)
    points = 0.01 * generator.uniform(-1, 1, (4, 3)) * [1, 1, 0]
    field = ring.field_T(points)
    labelled = xr.DataArray(points, dims=("point", "component"), coords={
        "component": ["x", "y", "z"]})
    turned = labelled.sel(component=["z", "x", "y"])
    for one in (labelled, labelled.T, turned, turned.T):
        assert np.array_equal(ring.field_T(one), field)
    read = xr.DataArray(field, dims=("point", "component"), coords={
        "component": ["x", "y", "z"]})
    for one in (read, read.T, read.sel(component=["z", "y", "x"])):
        assert np.array_equal(hf.field_map(turned.T, one)["B_T"], field)
        assert np.array_equal(hf.field_map(points, one, components=["y"])["B_T"][:, 1], field[:, 1])
    for wrong in (read.sel(component=["x", "y"]), read.assign_attrs(units="mT")):
        with pytest.raises(hf.HalbachError, match=r"labelled x, y, of which z|m and T: mT"):
            hf.field_map(points, wrong)


@pytest.mark.parametrize("count", [3, 5])
def test_points_that_say_which_way_they_lie(generator, count):
    """By names of columns, rows or dimensions. Control: a bare array of (3, 3) is by rows, and one
    of (3, 5) is refused.
    """
    ring = hf.halbach_ring(**RING)
    points = 0.01 * generator.uniform(-1, 1, (count, 3)) * [1, 1, 0]
    field = ring.field_T(points)
    frame = pandas.DataFrame(points, columns=["x", "y", "z"])
    for one in (frame[["z", "y", "x"]], frame.T, frame.T.loc[["y", "x", "z"]],
                frame.rename(columns="{}_m".format),
                *(xr.DataArray(points.T, dims=(name, "point")) for name in (
                    "axis", "xyz", "coord", "component"))):
        assert np.array_equal(ring.field_T(one), field)
        assert np.array_equal(hf.field_map(points, one)["B_T"], points)
    row = frame.iloc[0]
    assert np.allclose(ring.field_T(row.iloc[::-1]), field[0], atol=1e-12)  # of one point alone
    if count == 3:
        assert np.array_equal(ring.field_T(points.T), ring.field_T([*points.T]))
        assert not np.allclose(ring.field_T(points.T), field)
    else:
        for bare in (points.T, xr.DataArray(points.T, dims=("a", "b")), frame.T.reset_index(
                drop=True)):
            with pytest.raises(hf.HalbachError, match=r"\(3, 5\)"):
                ring.field_T(bare)


@pytest.mark.parametrize("labels", [
    ["Bz", "By", "Bx"], ["Z", "Y", "X"], ["z_m", "y_m", "x_m"], ["Bz_T", "By_T", "Bx_T"]])
def test_labels_are_read_as_names_of_columns(generator, labels):
    """Control: what is no axis, not all of them, or in another unit is refused."""
    points, field = 0.01 * generator.standard_normal((2, 4, 3))

    def read(names, **options):
        return hf.field_map(points, xr.DataArray(field[:, ::-1], dims=("point", "axis"), coords={
            "axis": names, "point": ["a", "b", "c", "d"]}), **options)["B_T"].values

    assert np.array_equal(read(labels), field)
    assert np.array_equal(read(labels, components=["x"])[:, 0], field[:, 0])
    assert np.array_equal(read([0, 1, 2]), field[:, ::-1])
    for wrong in (["u", "v", "w"], ["radial", "y", "x"], ["By", "By", "Bx"], [
            f"{one[0]}_mm" for one in "zyx"]):
        with pytest.raises(hf.HalbachError, match=r"axis labelled|m and T: z_mm"):
            read(wrong)


@pytest.mark.parametrize("label", [
    "z_nm", "z [\u00b5m]", "z (inches)", "Bz (Gauss)", "Bz [Oe]", "Bz_A/m", "Bz (kA/m)",
    "Bz_\u00b5T", "Bz [mG]", "z [millimetre] "])
def test_labels_that_state_another_unit(label):
    """These were read as m and T. Control: names that end like units, and m and T themselves."""
    points = np.arange(6.0).reshape(2, 3) / 100
    for named in ("z_main", "Bz_long", "z_stage", "z (m)", "Bz [T]"):
        names = [named.replace("z", axis, 1) for axis in "xyz"]
        assert np.array_equal(
            hf.field_map(points, pandas.DataFrame(points, columns=names))["B_T"], points)
    with pytest.raises(hf.HalbachError, match="in other units than m and T"):
        hf.field_map(points, pandas.DataFrame(points, columns=["x", "y", label]))


def test_names_of_series_and_arrays():
    """They were not read: mT were T, and By was Bx. Control: names that fit, and none."""
    points, column = np.zeros((1, 3)), np.array([3.0])
    for name in ("By_T", "By [T]", "B", None):
        data = hf.field_map(points, pandas.Series(column, name=name), components=["y"])
        assert data["B_T"].values[0, 1] == 3.0
    for values, components, said in (
            (pandas.Series(column, name="By [mT]"), ["y"], "in other units than m and T"),
            (pandas.Series(column, name="By_T"), ["x"], "By_T in place of x"),
            (xr.DataArray(points, name="B_mT"), ["x", "y", "z"], "in other units than m and T")):
        with pytest.raises(hf.HalbachError, match=said):
            hf.field_map(points, values, components=components)
    with pytest.raises(hf.HalbachError, match="in other units than m and T: sigma_mT"):
        hf.field_map(points, points, pandas.Series([0.1], name="sigma_mT"))


def test_columns_in_a_dict(generator):
    """So have structured arrays and Datasets them. Control: a dict without one of them."""
    ring = hf.halbach_ring(**RING)
    points = 0.01 * generator.uniform(-1, 1, (4, 3)) * [1, 1, 0]
    columns = {name: points[:, "xyz".index(name)] for name in "zyx"}
    rows = np.array([*zip(*columns.values(), strict=True)], [(name, float) for name in columns])
    for one in (columns, columns | {"z": 0.0}, rows, rows.view(np.recarray), xr.Dataset({
            f"{name}_m": ("point", values) for name, values in columns.items()})):
        assert np.array_equal(ring.field_T(one), ring.field_T(points))
        data = hf.field_map(one, one, {"y": 2e-5, "x": 1e-5, "z": 3e-5})
        assert np.array_equal(data["B_T"], points)
        assert data["sigma_T"].values[0].tolist() == [1e-5, 2e-5, 3e-5]
    for wrong, said in (({"x": [0.0], "y": [0.0]}, "x, y, of which z"), ({}, "make a list"),
                        ((row for row in points), "make a list"),
                        ([{"x": 0.0, "y": 0.0, "z": 0.0}], "make a list"),
                        ({"x_mm": [0.0], "y_mm": [0.0], "z_mm": [0.0]}, "other units")):
        with pytest.raises(hf.HalbachError, match=said):
            ring.field_T(wrong)


def test_a_table_that_was_written_and_read(tmp_path):
    """By pandas, which reads outlines as text."""
    prism = hf.magnet_of_blocks({
        "shape": ["prism"], "x_m": [0.03], "y_m": [0.0], "z_m": [0.0], "size_z_m": [0.01],
        "outline_m": [((0.0, 0.0), (0.02, 0.0), (0.0, 0.01))], "remanence_T": [1.3]})
    path = hf.export(prism, tmp_path / "blocks.csv")
    found = hf.magnet_of_blocks(pandas.read_csv(path))
    assert found.field_T(POINTS) == pytest.approx(prism.field_T(POINTS), rel=1e-12)
    with pytest.raises(hf.HalbachError, match="outline_m"):
        hf.magnet_of_blocks(pandas.read_csv(path).assign(outline_m="0 0; 1"))


@pytest.mark.parametrize(("length", "said"), [
    (0.05, "1, of which `inference.held_out.every` = 4"), (None, "scan_lines_every = 5")])
def test_a_map_of_one_row(tmp_path, length, said):
    """The advice of its refusal is followed; the files of its inference are no maps."""
    ring = hf.halbach_ring(**RING | {"length_m": length})
    one = ([[0.01, 0.0, 0.0]], 1.01 * ring.field_T([[0.01, 0.0, 0.0]]))
    with pytest.raises(hf.HalbachError, match=rf"{said}.*with_\(inference__held_out=None\)"):
        hf.infer(ring, *one, sigma_T=1e-5)
    result = hf.infer(ring.with_(inference__held_out=None), *one, sigma_T=1e-5)
    hf.write_report(result, tmp_path)
    with pytest.raises(hf.HalbachError, match=r"a file of measurements; instead .* a posterior of"):
        hf.read_map(tmp_path / "posterior.h5")


def test_a_folder_in_place_of_a_file(tmp_path):
    for write in (lambda: hf.export(hf.halbach_ring(**RING), tmp_path),
                  lambda: hf.write_map(hf.field_map(POINTS, POINTS), tmp_path)):
        with pytest.raises(hf.HalbachError, match="must be a file; instead received the folder"):
            write()


@pytest.mark.parametrize("sigma", [0.0, -1e-5, [1e-5, -1e-5], np.nan, np.inf,
                                   [1e-5, np.nan]])
def test_noise_that_is_none(sigma):
    """Control: a component without a reading may have none."""
    read = np.array([[0.1, np.nan, 0.2]])
    assert hf.field_map(POINTS[:1], read, sigma_T=[[1e-5, np.nan, 1e-5]])["sigma_T"][0, 0] == 1e-5
    with pytest.raises(hf.HalbachError, match="sigma_T of field_map must be positive"):
        hf.field_map(POINTS[:2], POINTS[:2], sigma_T=sigma)


def test_a_result_without_a_page(tmp_path):
    """What no function has returned; the refusal names the command that writes such files."""
    with pytest.raises(hf.HalbachError, match="the command of this name writes the files"):
        hf.write_report(POINTS, tmp_path)


def test_noise_that_a_plan_misses():
    """Where there is no map yet, none is spoken of. Control: an inference asks for its sigma_T."""
    ring = hf.halbach_ring(**RING | {"length_m": 0.05}).with_(noise=None)
    with pytest.raises(hf.HalbachError, match=r"since no map is there .* to the study\.$"):
        hf.plan(ring)
    points = 0.01 * np.random.default_rng(1).uniform(-1, 1, (20, 3))
    with pytest.raises(hf.HalbachError, match=r"has no sigma_T; .* or sigma_T to the map\.$"):
        hf.infer(ring, points, ring.field_T(points))


@pytest.mark.parametrize(("factor", "said", "other"), [
    (1e3, "in millitesla or gauss.*Bx_mT, .* or Bx_G, .* = 0.001 or 0.0001 in", "kT"),
    (1e4, "in gauss.* = 0.0001 in", "millitesla")])
def test_units_that_a_field_may_have(factor, said, other):
    """88 mT and 880 gauss are 88 times 10 too much each; 8800 are gauss."""
    points = 0.01 * np.random.default_rng(1).uniform(-1, 1, (20, 3))
    ring = hf.halbach_ring(**RING | {"length_m": 0.05})
    with pytest.raises(hf.HalbachError, match=said) as told:
        hf.check_map(hf.field_map(points, factor * ring.field_T(points), sigma_T=1e-3))
    assert other not in str(told.value)
