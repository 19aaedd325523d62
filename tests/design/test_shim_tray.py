"""Filled shim trays beside magpylib's field of their magnets, and the search beside all choices."""

from __future__ import annotations

import csv
import json
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import magpylib
import numpy as np
import pytest
import tomlkit
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from halbach_fe.cli import main
from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.design.shim_tray import EMPTY, Filled, _Search, shim_tray
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.report.page import html_of, write_report
from halbach_fe.response.homogeneity import PPM, extremes
from halbach_fe.response.region import Region
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study, read_study

NOISE_T, STRENGTH_SD = 2e-6, 0.02
REGION = Region.sphere(0.03)

DOCUMENT = {
    "name": "tray", "dimension": 3,
    "array": {
        "blocks_per_ring": 8, "rings": 6, "inner_radius_m": 0.1, "outer_radius_m": 0.15,
        "ring_length_m": 0.05, "ring_gap_m": 0.02, "remanence_T": 1.2, "recoil_permeability": 1.0,
        "block": {"shape": "cuboid", "width_m": 0.05, "orientation": "magnetization"}},
    "mesh": {"block_size_m": 0.03},
    "observation": {"quantity": "flux_density", "positions": {
        "kind": "circles", "radius_m": [0.03, 0.06], "angles": 16, "z_min_m": -0.06,
        "z_max_m": 0.06, "count": 7}},
    "noise": {"regions": [{"name": "bore", "sigma_T": NOISE_T}]},
    "prior": {"magnitude_sd": 0.01, "direction_sd_deg": 1.0},
    "shim_tray": {
        "rings": [{"radius_m": 0.08, "count": 16, "z_m": [-0.09, -0.045, 0.0, 0.045, 0.09]}],
        "strength_sd": STRENGTH_SD,
        "magnets": [{"name": f"{size} mm", "size_m": [1e-3 * size] * 3, "remanence_T": 1.2,
                     "count": 40} for size in (10, 6, 4)]}}


def tray(**changes):
    """The study with another tray."""
    return parse_study(DOCUMENT | {"shim_tray": DOCUMENT["shim_tray"] | changes})


def cuboid(size: Sequence[float], polarization: Floats, position: Sequence[float] | Floats,
           orientation: Rotation) -> magpylib.magnet.Cuboid:
    return magpylib.magnet.Cuboid(
        dimension=size, polarization=orientation.inv().apply(polarization), position=position,
        orientation=orientation)


def true_magnet(magnet, generator):
    """magpylib's cuboids with errors of 1 % and 1 degree."""
    sources = []
    for block in magnet.blocks:
        nominal = block.remanence * np.array(block.easy_axis)
        polarization = nominal * (1 + 0.01 * generator.standard_normal()) + np.radians(
            1.0) * block.remanence * generator.standard_normal(3)
        middle = block.middle
        sources.append(cuboid((0.05, 0.05, 0.05), polarization, middle,
                              Rotation.from_euler("z", block.facing_deg, degrees=True)))
    return magpylib.Collection(*sources)


def shims(filled: Sequence[Filled], generator: np.random.Generator | None = None,
          turned_deg: float = 0.0) -> magpylib.Collection:
    """magpylib's magnets of a tray, perhaps of uncertain strength, or all turned."""
    sources, common = [], STRENGTH_SD * generator.standard_normal() if generator else 0.0
    for one in filled:
        own = STRENGTH_SD * generator.standard_normal() if generator else 0.0
        strength = 1.2 * (1 + common + own)
        angle = np.radians(one.direction_deg + turned_deg)
        x, y, _ = one.position_m
        sources.append(cuboid(
            one.magnet.size_m, strength * np.array([np.cos(angle), np.sin(angle), 0.0]),
            one.position_m, Rotation.from_euler("z", np.arctan2(y, x))))
    return magpylib.Collection(*sources)


def rms_ppm(field):
    """Rms deviation of |B| (n, 3) over the volume of the region."""
    _, weights = REGION.points(36)
    size = np.linalg.norm(field, axis=1)
    mean = weights @ size
    return PPM * np.sqrt(weights @ (size / mean - 1)**2)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The study, its magnet as magpylib builds it, and what a map says of it."""
    study, generator = parse_study(DOCUMENT), np.random.default_rng(4)
    magnet = build_magnet(study)
    points = points_from(study.observation.positions)
    truth = true_magnet(magnet, generator)
    data = field_map(points, truth.getB(points) + NOISE_T * generator.standard_normal(points.shape))
    session = Session.open(tmp_path_factory.mktemp("inferred"))
    return study, truth, data, infer(magnet, data, session).posterior


def test_the_field_becomes_homogeneous_as_foretold(measured, tmp_path):
    study, truth, _, posterior = measured
    found = shim_tray(build_magnet(study), Session.open(tmp_path), posterior, REGION)
    points, _ = REGION.points(36)
    bare = truth.getB(points)
    assert found.before.rms_ppm == pytest.approx(rms_ppm(bare), rel=0.01)
    assert "tray" in html_of(found)
    assert write_report(found, tmp_path / "report").name == "shim_tray.html"
    generator = np.random.default_rng(5)
    after = [rms_ppm(bare + shims(found.filled, generator).getB(points)) for _ in range(20)]
    low, middle, high = found.after.rms_range_ppm
    # of 20 trays of shims with their tolerance, about one is outside of 95 %; they share the map
    assert sum(low <= each <= high for each in after) >= 15
    assert np.median(after) == pytest.approx(middle, rel=0.1)
    assert np.median(after) < rms_ppm(bare) / 5
    counts = {each.name: each.count for each in study.shim_tray.magnets}
    for name, left in found.left.items():
        assert left >= 0
        assert left == counts[name] - sum(one.magnet.name == name for one in found.filled)
    # control: the same magnets a quarter of a turn off
    assert rms_ppm(bare + shims(found.filled, turned_deg=90).getB(points)) > 0.9 * rms_ppm(bare)


def test_the_filled_study_is_the_filled_magnet(measured, tmp_path):
    """The map of magpylib's magnet with its shims agrees with the study that is written; the
    control is the study without them, which the advice before had updated.
    """
    study, truth, _, posterior = measured
    found = shim_tray(build_magnet(study), Session.open(tmp_path), posterior, REGION)
    write_report(found, tmp_path / "report")
    points, generator = points_from(study.observation.positions), np.random.default_rng(6)
    field = truth.getB(points) + shims(found.filled).getB(points)
    data = field_map(points, field + NOISE_T * generator.standard_normal(points.shape))
    filled = build_magnet(read_study(tmp_path / "report" / "study.filled.toml"))
    assert len(filled.blocks) == len(build_magnet(study).blocks) + len(found.filled)
    new, old = (infer(each, data, Session.open(tmp_path / str(number)))
                for number, each in enumerate((filled, build_magnet(study))))
    assert new.prior_conflict < new.conflict_limit
    assert old.prior_conflict > 10 * old.conflict_limit


def test_what_the_study_says_of_its_blocks_is_not_of_the_shims(measured, tmp_path):
    """Exceptions for all blocks, or for a slot of all rings, types, and free blocks of its own."""
    study, _, _, posterior = measured
    found = shim_tray(build_magnet(study), Session.open(tmp_path), posterior, REGION)
    shim = {"name": ["own"], "shape": ["cuboid"], "x_m": [0.0], "y_m": [0.0], "z_m": [0.3],
            "size_x_m": [0.01], "size_y_m": [0.01], "size_z_m": [0.01], "remanence_T": [1.0]}
    other = build_magnet(study.with_(
        array__exceptions=[{"magnetization_factor": 0.9}, {"slot": 1, "magnetization_factor": 0.5}],
        array__free_blocks=shim, prior__types={"a": tuple(range(1, 9))}))
    plain, changed = (build_magnet(replace(found, magnet=each).filled_study).blocks
                      for each in (build_magnet(study), other))
    assert changed[:len(other.blocks)] == other.blocks
    count = len(found.filled)
    np.testing.assert_allclose(*([each.magnetization for each in blocks[-count:]]
                                 for blocks in (changed, plain)), atol=1.0)  # of 1e6 A/m
    np.testing.assert_allclose([each.middle for each in changed[-count:]],
                               [one.position_m for one in found.filled])
    of_grade = build_magnet(replace(found, filled=tuple(
        replace(one, magnet=one.magnet.with_(remanence_T=None, material="N42"))
        for one in found.filled)).filled_study)
    assert of_grade.materials == (None,) * (len(of_grade.blocks) - count) + ("N42",) * count


def test_the_tray_is_filled_for_neighbours_as_they_were_found(tmp_path):
    """Blocks of a neighbour that an update has found a quarter stronger call for the tray of a
    neighbour of that factor. It was filled for the nominal one, which is the control.
    """
    study = tray(rings=[{"radius_m": 0.08, "count": 8, "z_m": [-0.09, 0.0, 0.09]}])
    nominal = build_magnet(study).nominal_magnetization
    exact = np.zeros((len(nominal), 1))
    found = []
    for factor, deviation in ((1.0, 0.25), (1.25, 0.0), (1.0, 0.0)):
        magnet = build_magnet(study.with_(external={
            "neighbours": [{"z_m": 0.41, "factor": factor}]}))
        posterior = Gaussian(nominal, exact, Gaussian(deviation * nominal, exact))
        found.append(shim_tray(magnet, Session.open(tmp_path / str(len(found))), posterior, REGION))
    one, same, control = found
    assert one.filled == same.filled
    assert one.after.rms_ppm == pytest.approx(same.after.rms_ppm, rel=1e-9)
    assert one.filled != control.filled


def test_shims_next_to_the_region(tmp_path):
    """Cubes of 3 mm that are 1 mm off it, beside magpylib's field at evenly spread points."""
    region, generator = Region.sphere(0.022), np.random.default_rng(6)
    array = {"blocks_per_ring": 10, "rings": 3, "inner_radius_m": 0.048, "outer_radius_m": 0.062,
             "ring_length_m": 0.014, "remanence_T": 1.2, "recoil_permeability": 1.0,
             "block": {"shape": "cuboid", "width_m": 0.014, "orientation": "magnetization"}}
    magnet = build_magnet(parse_study(DOCUMENT | {"array": array, "observation": {
        "quantity": "flux_density", "positions": {"kind": "points", "points_m": [[0, 0, 0]]}},
        "shim_tray": {"rings": [{"radius_m": 0.0247, "count": 8, "z_m": [0.0, 0.01]}],
                      "strength_sd": STRENGTH_SD, "magnets": [{
                          "name": "cube", "size_m": [0.003] * 3, "remanence_T": 1.2,
                          "count": 16}]}}))
    mean = magnet.nominal_magnetization
    found = shim_tray(magnet, Session.open(tmp_path), Gaussian(
        mean, np.zeros((len(mean), 1))), region)
    assert found.filled
    truth = magpylib.Collection(
        shims(found.filled), *(cuboid([0.014] * 3, own * MU_0, block.middle, Rotation.from_euler(
            "z", block.facing_deg, degrees=True)) for block, own in zip(
                magnet.blocks, mean.reshape(-1, 3), strict=True)))
    unit = 2 * qmc.Halton(3, seed=generator).random(60_000) - 1
    size = np.linalg.norm(truth.getB(0.022 * unit[np.linalg.norm(unit, axis=1) <= 1]), axis=1)
    rms = PPM * size.std() / size.mean()
    # measured 4e-5 of the mean and 0.2 % of the rms, as much as these points leave open
    assert found.after.mean_T == pytest.approx(size.mean(), rel=2e-4)
    assert found.after.rms_ppm == pytest.approx(rms, rel=5e-3)
    beside = np.vstack([one.position_m + 0.002 * generator.standard_normal((3000, 3))
                        for one in found.filled])
    beside *= 0.022 / np.linalg.norm(beside, axis=1)[:, None]
    whole = np.append(size, np.linalg.norm(truth.getB(beside), axis=1))
    assert found.after.peak_to_peak_ppm == pytest.approx(
        PPM * np.ptp(whole) / size.mean(), rel=0.02)
    points, _ = region.points(36)  # the control: points that do not mind the shims
    coarse = truth.getB(points)[..., None]
    low, high = extremes(region, points, np.full(points.shape, 2 * np.pi / 37), coarse)
    assert high[0] - low[0] != pytest.approx(np.ptp(whole), rel=0.02)


@pytest.mark.parametrize("counts", [[9, 9], [1, 2], [0, 1]])
def test_the_search_finds_the_best_of_all(counts):
    """Four places, three choices of two kinds of magnets: all 256 trays are tried."""
    generator, excess = np.random.default_rng(8), []
    kinds = np.tile([0, 0, 1], 4)
    for _ in range(20):
        effect, target = generator.standard_normal((12, 6)), 2 * generator.standard_normal(6)
        found = _Search(effect @ effect.T, effect @ target, target @ target, 0.01, kinds, 4,
                        np.array(counts)).run()

        def size(chosen, effect=effect, target=target):
            rows = [3 * place + one for place, one in enumerate(chosen) if one != EMPTY]
            used = np.bincount(kinds[rows], minlength=2) if rows else np.zeros(2)
            if (used > counts).any():
                return np.inf
            return np.sum((target + effect[rows].sum(axis=0))**2) + 0.01 * np.sum(effect[rows]**2)

        best = min(size(each) for each in product([EMPTY, 0, 1, 2], repeat=4))
        excess.append((size(found) - best) / (target @ target))
    assert max(excess) < 1e-9  # rounding


def test_a_tray_that_cannot_help_stays_empty(measured, tmp_path):
    study, _, _, posterior = measured
    huge = [{"name": "huge", "size_m": [0.03] * 3, "remanence_T": 1.4, "count": 4}]
    other = study.with_(shim_tray=DOCUMENT["shim_tray"] | {
        "magnets": huge, "rings": [{"radius_m": 0.07, "count": 2}], "strength_sd": 0.5})
    found = shim_tray(build_magnet(other), Session.open(tmp_path), posterior, REGION)
    assert found.filled == ()
    assert found.after.rms_ppm == pytest.approx(found.before.rms_ppm)


def test_cubes_and_bars_fill_one_tray(measured, tmp_path):
    """The largest of both is as wide as a cube and as long as a bar, and turns as bars do."""
    _, truth, _, posterior = measured
    bar = {"name": "bar", "size_m": [0.004, 0.004, 0.008], "remanence_T": 1.2, "count": 8}
    flat = bar | {"name": "flat", "size_m": [0.003, 0.006, 0.003], "angles_deg": [0, 180],
                  "count": 40}
    both = tray(magnets=[bar, flat], rings=[{"radius_m": 0.08, "count": 16, "z_m": [-0.09, 0.09]}])
    found = shim_tray(build_magnet(both), Session.open(tmp_path), posterior, REGION)
    assert {one.magnet.name for one in found.filled} == {"bar", "flat"}
    points, _ = REGION.points(36)
    # shims have their nominal strength here, and the update is right to 1 % of what is left
    assert found.after.rms_ppm == pytest.approx(
        rms_ppm(truth.getB(points) + shims(found.filled).getB(points)), rel=0.02)


@pytest.mark.parametrize(("changes", "said"), [
    ({"rings": [{"radius_m": 0.098, "count": 8, "z_m": 0.035}]}, "place 1 .*touches block"),
    ({"rings": [{"radius_m": 0.3, "count": 8}]}, "within the magnet"),
    ({"rings": [{"radius_m": 0.08, "count": 8, "z_m": [-20.0, 0.0, 20.0]}]},
     "Was it meant in millimetres"),
    ({"rings": [{"radius_m": 0.025, "count": 4}]}, "touches the region"),
    ({"rings": [{"radius_m": 0.0345, "count": 4}]}, "touches the region"),
    ({"rings": [{"radius_m": 0.08, "count": 70}]}, "touches that of place"),
    ({"rings": [{"radius_m": 0.08, "count": 900}]}, "at most 6000 choices"),
])
def test_trays_that_do_not_fit(measured, tmp_path, changes, said):
    _, _, _, posterior = measured
    with pytest.raises(StudyError, match=said):
        shim_tray(build_magnet(tray(**changes)), Session.open(tmp_path), posterior, REGION)


@pytest.mark.parametrize(("changes", "said"), [
    ({"rings": []}, "needs 1 to 2000 places"),
    ({"magnets": []}, "1 or more elements"),
    ({"magnets": [{"name": "bar", "size_m": [0.005, 0.01, 0.005], "remanence_T": 1.0,
                   "count": 1}]}, r"multiples of 180.* write angles_deg = \[0, 180\]"),
    ({"magnets": [DOCUMENT["shim_tray"]["magnets"][0] | {"material": "N42"}]}, "give either"),
    ({"magnets": [DOCUMENT["shim_tray"]["magnets"][0] | {"count": 0}]}, "count"),
    ({"magnets": DOCUMENT["shim_tray"]["magnets"][:1] * 2}, "two of the shim magnets are called"),
])
def test_trays_that_are_wrong(changes, said):
    with pytest.raises(StudyError, match=said):
        tray(**changes)


def test_a_study_without_a_tray(measured, tmp_path):
    """The table that the message gives is one."""
    study, _, _, posterior = measured
    with pytest.raises(StudyError, match=r"Add a table \[shim_tray\]") as refused:
        shim_tray(build_magnet(study.with_(shim_tray=None)), Session.open(tmp_path), posterior)
    keys = str(refused.value).partition("for example, ")[2].removesuffix(".").split(" and ")
    assert study.with_(shim_tray=tomllib.loads("\n".join(keys))).shim_tray is not None


def test_command(measured, tmp_path, capsys):
    """A tray of fewer places, which is searched twice."""
    _, _, data, _ = measured
    ring = {"radius_m": 0.08, "count": 8, "z_m": [-0.09, 0.0, 0.09]}
    document = DOCUMENT | {"shim_tray": DOCUMENT["shim_tray"] | {"rings": [ring]}}
    path = tmp_path / "study.toml"
    path.write_text(tomlkit.dumps(document))
    write_map(data, tmp_path / "map.csv")
    inferred, out = tmp_path / "inferred", tmp_path / "tray"
    assert main(["infer", str(path), "-o", str(inferred), "--measurements",
                 str(tmp_path / "map.csv")]) == 0
    arguments = ["shim-tray", str(path), "--posterior", str(inferred / "posterior.h5"),
                 "--sphere-m", "0.03", "-o", str(out)]
    assert main(arguments) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "magnets in the 24 places of the tray" in said
    summary = json.loads((out / "shim_tray.json").read_text())
    with (out / "shim_tray.csv").open() as file:
        table = list(csv.DictReader(line for line in file if line[0] != "#"))
    assert len(table) == summary["places"] == 24
    assert sum(bool(row["magnet"]) for row in table) == summary["magnets"]
    page = (out / "shim_tray.html").read_text()
    assert ", without them by" in page
    assert "(None" not in page
    assert "rms deviation without and with the tray" in page
    assert main([*arguments[:-1], str(tmp_path / "json"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == summary
