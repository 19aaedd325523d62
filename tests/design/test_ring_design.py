"""Designs of rings beside magpylib's field, and the search beside all choices."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations, product

import magpylib
import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.core.errors import StudyError
from halbach_fe.design import ring_catalogue
from halbach_fe.design.ring_catalogue import Catalogue, about_origin, largest_number, tables_of
from halbach_fe.design.ring_catalogue import designed as designed_study
from halbach_fe.design.ring_design import Task, _best_pair, design_rings, search, task_of
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report.page import html_of, write_report
from halbach_fe.report.ring_design_page import STUDY_FILE, answer
from halbach_fe.response.homogeneity import PPM
from halbach_fe.response.region import Region
from halbach_fe.solver.session import Session
from halbach_fe.study.array_keys import Ring
from halbach_fe.study.design_keys import HomogeneityRegion
from halbach_fe.study.reader import parse_study, read_study

REGION = Region.sphere(0.025)
DENSITY = 7500.0

DOCUMENT = {
    "name": "designed", "dimension": 3,
    "array": {
        "blocks_per_ring": 16, "inner_radius_m": 0.06, "outer_radius_m": 0.07,
        "ring_length_m": 0.01, "remanence_T": 1.37, "recoil_permeability": 1.0,
        "block": {"shape": "cuboid", "width_m": 0.01, "orientation": "magnetization"}},
    "design": {"rings": 10, "spacing_m": 0.017, "layer": [
        {"radii_m": [0.058, 0.063, 0.068]}]},
    "mesh": {"block_size_m": 0.006},
    "observation": {"quantity": "flux_density", "positions": {
        "kind": "points", "points_m": [[0, 0, 0]]}}}


def study(array=None, **design):
    """The study with other keys of the design, or of the array."""
    return parse_study(DOCUMENT | {
        "array": DOCUMENT["array"] | (array or {}), "design": DOCUMENT["design"] | design})


def cubes(blocks):
    """The blocks as magpylib's cuboids."""
    return magpylib.Collection(*(magpylib.magnet.Cuboid(
        dimension=(0.01, 0.01, 0.01), position=block.middle,
        polarization=(block.remanence, 0, 0)).rotate_from_angax(
            block.facing_deg, "z", anchor=None) for block in blocks))


def deviations(found, count=4000):
    """Mean |B| in T, and ppm peak to peak and rms, at random points by magpylib."""
    generator = np.random.default_rng(1)
    direction = generator.standard_normal((count, 3))
    surface = 0.025 * direction / np.linalg.norm(direction, axis=1)[:, None]
    inside = surface * generator.uniform(0, 1, count)[:, None]**(1 / 3)
    source = cubes(build_magnet(found.study).blocks)
    on, within = (np.linalg.norm(source.getB(points), axis=1) for points in (surface, inside))
    mean = within.mean()
    return mean, PPM * np.ptp(np.append(on, within)) / mean, PPM * np.std(within) / mean


@pytest.fixture(scope="module")
def designed(getdp, tmp_path_factory):
    return design_rings(study(), Session(getdp, tmp_path_factory.mktemp("designed")), REGION)


def test_the_field_is_that_of_magpylib(designed):
    mean, whole, rms = deviations(designed)
    assert designed.best.mean_T == pytest.approx(mean, rel=1e-4)
    # random points, 1 degree apart, and those 7.5 degrees apart miss the extremes by a little
    assert designed.best.peak_to_peak_ppm == pytest.approx(whole, rel=0.02)
    assert designed.best.rms_ppm == pytest.approx(rms, rel=0.1)


def test_deviations_are_those_of_the_magnitude(designed):
    """At Gauss's points of the volume; the component along the field, the control, differs."""
    points, weights = REGION.points(10)
    inside = weights > 0
    field = cubes(build_magnet(designed.study).blocks).getB(points[inside])
    of_size, of_component = (
        PPM * float(np.sqrt(weights[inside] @ (part / (weights[inside] @ part) - 1)**2))
        for part in (np.linalg.norm(field, axis=1), field[:, 0]))
    # points that are alike to 1e-9 of the field count once; the component is 2e-5 off
    assert designed.best.rms_ppm == pytest.approx(of_size, rel=3e-6)
    assert designed.best.rms_ppm != pytest.approx(of_component, rel=3e-6)


def test_extremes_between_points_beside_blocks_are_found(session):
    """The region ends 4 mm from cubes: points 7.5 degrees apart, the control, miss its extremes."""
    region = Region.sphere(0.047)
    found = design_rings(study(rings=2, layer=[{"radii_m": [0.058]}]), session, region)
    source = cubes(build_magnet(found.study).blocks)
    angle, z = np.meshgrid(np.radians(np.arange(0, 360, 0.5)), np.linspace(-0.4, 0.4, 81))
    unit = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], -1)
    size = np.linalg.norm(source.getB(0.047 * unit.reshape(-1, 3)), axis=1)
    low, high = (find(size) for find in (np.min, np.max))
    sample = Catalogue.of(study(rings=2, layer=[{"radii_m": [0.058]}]), region, DENSITY).sample
    coarse = np.linalg.norm(source.getB(sample.points), axis=1)
    low = min(low, coarse.min())  # of the poles, which the band about the equator leaves out
    true = PPM * (high - low) / found.best.mean_T
    # points half a degree apart miss 1e-3 of what those 15 times as far apart miss
    assert found.best.peak_to_peak_ppm == pytest.approx(true, rel=2e-3)
    assert PPM * np.ptp(coarse) / found.best.mean_T < 0.99 * true


def test_the_best_design_is_marked_on_the_front(session, tmp_path):
    """Also if radii between those of the list are no better than the radii listed."""
    found = design_rings(study(between_radii=True, rings=2, layer=[{"radii_m": [0.063]}]), session,
                         REGION)
    assert any(one is found.best for one in found.front)
    text = write_report(found, tmp_path).read_text(encoding="utf-8")
    assert "best: smallest peak to peak" in text


def test_the_search_finds_the_best_of_all_choices():
    catalogue = Catalogue.of(study(), REGION, DENSITY)
    task = task_of(catalogue, np.zeros(len(catalogue.sample.points)))
    places, options = task.table.shape[:2]
    every = [float(task.value(task.total(np.array(chosen))))
             for chosen in product(range(options), repeat=places)]
    found = search(task, np.zeros(places, int), 20, np.random.default_rng(0))
    assert found.ppm == pytest.approx(min(every))
    assert found.ppm < np.quantile(every, 0.02)  # a random choice would not do


def test_points_that_are_alike_count_once_and_lose_nothing():
    catalogue = Catalogue.of(study(), REGION, DENSITY)
    _, weights = REGION.points(47)
    assert len(catalogue.sample.points) < len(weights) / 3
    assert catalogue.sample.weights.sum() == pytest.approx(1)


def test_a_least_field_costs_homogeneity(designed, session):
    asked = 1.1 * designed.best.mean_T
    stronger = design_rings(study(least_field_T=asked), session, REGION)
    assert stronger.reached
    assert stronger.best.mean_T >= asked
    assert stronger.best.peak_to_peak_ppm > designed.best.peak_to_peak_ppm
    fields = [one.mean_T for one in designed.front]
    ppm = [one.peak_to_peak_ppm for one in designed.front]
    assert fields == sorted(fields)
    assert ppm == sorted(ppm)
    assert designed.best is designed.front[0]


def test_radii_at_the_limits_and_per_cents_are_said(designed):
    best = designed.best
    radii = [option[0].radius_m for z, option in zip(best.z_m, best.rings, strict=True)
             for _ in range(1 if z == 0 else 2)]
    widest = sum(np.isclose(radii, 0.068))
    assert 0 < widest < len(radii)
    assert (f"{widest} rings have the largest radius that [design] allows, 68\u00a0mm"
            in answer(designed).trust)
    # the control: with a larger radius in the list, that of 68 mm is no limit
    layer = designed.study.design.layer[0].with_(radii_m=(0.058, 0.063, 0.068, 0.08))
    wider = replace(designed, study=designed.study.with_(
        design=designed.study.design.with_(layer=(layer,))))
    assert "largest radius" not in answer(wider).trust
    assert "no homogeneous field" not in answer(designed).said
    uneven = replace(best, peak_to_peak_ppm=1e5)
    assert "varies by 10\u00a0%: it is no homogeneous field" in answer(
        replace(designed, best=uneven)).said


def test_what_cannot_be_reached_is_said(session):
    found = design_rings(study(least_field_T=5.0), session, REGION)
    assert not found.reached
    assert answer(found).said.startswith("No design reaches")


def test_a_largest_mass_leaves_places_empty(designed, session):
    layer = DOCUMENT["design"]["layer"][0] | {"may_be_empty": True}
    light = design_rings(study(layer=[layer], most_mass_kg=0.6 * designed.best.mass_kg), session,
                         REGION)
    assert light.reached
    assert light.best.mass_kg <= 0.6 * designed.best.mass_kg
    assert any(option == (None,) for option in light.best.rings)
    blocks = build_magnet(light.study).blocks
    assert len(blocks) == light.best.blocks
    assert light.best.mass_kg == pytest.approx(DENSITY * sum(block.volume for block in blocks))


def test_limits_that_only_an_empty_bore_keeps(session):
    layer = DOCUMENT["design"]["layer"][0] | {"may_be_empty": True}
    with pytest.raises(StudyError, match="some rings can keep"):
        design_rings(study(layer=[layer], most_mass_kg=1e-3), session, REGION)


def test_radii_between_those_of_the_list_do_better(designed, session):
    found = design_rings(study(between_radii=True), session, REGION)
    assert found.best.peak_to_peak_ppm < 0.8 * designed.best.peak_to_peak_ppm
    assert deviations(found)[1] == pytest.approx(found.best.peak_to_peak_ppm, rel=0.05)
    radii = [ring.radius_m for option in found.best.rings for ring in option]
    assert min(radii) >= 0.058 - 1e-9
    assert max(radii) <= 0.068 + 1e-9


def test_the_reaction_of_permeable_blocks_is_in_the_result(session):
    """Each design has that of its own blocks, and not that of the best one."""
    asked = study(array={"recoil_permeability": 1.1}, rings=4)
    found = design_rings(asked, session, REGION)
    mean, _, _ = deviations(found)  # in vacuum
    assert 0.002 < abs(found.best.mean_T / mean - 1) < 0.1
    assert len(found.front) > 1
    for one in found.front:
        magnet = build_magnet(designed_study(asked, tables_of(asked, one.z_m, one.rings)))
        points, weights = REGION.points(4)
        inner = weights > 0
        size = np.linalg.norm(magnet.field_T(points[inner]), axis=1)
        assert one.mean_T == pytest.approx(weights[inner] @ size, rel=1e-5)


def test_layers_together_take_radii_of_the_same_number(session):
    layers = [{"radii_m": [0.058, 0.062, 0.066]}, {"radii_m": [0.075, 0.079, 0.083]}]
    found = design_rings(study(layer=layers, layers_together=True, rings=4), session, REGION)
    for inner, outer in found.best.rings:
        assert outer.radius_m - inner.radius_m == pytest.approx(0.017)


def test_numbers_of_blocks_are_the_largest_that_fit():
    array = study().array
    for orientation, gap in product(("magnetization", "position"), (0.0, 1e-3)):
        block = array.block.with_(orientation=orientation)
        own = array.with_(block=block)
        number = largest_number(own, 0.06, 0.01, gap)
        build_magnet(study(array={"block": block.model_dump(), "inner_radius_m": 0.055,
                                  "outer_radius_m": 0.065, "blocks_per_ring": number}))
        if orientation == "position" and not gap:  # one more would overlap
            with pytest.raises(StudyError, match="overlap"):
                build_magnet(study(array={
                    "block": block.model_dump(), "inner_radius_m": 0.055,
                    "outer_radius_m": 0.065, "blocks_per_ring": number + 1}))


@pytest.mark.parametrize(("changes", "region", "message"), [
    ({"spacing_m": 0.009}, REGION, "the length of a ring"),
    ({"layer": [{"radii_m": [0.06]}, {"radii_m": [0.062]}]}, REGION, "fit inside one another"),
    ({"layer": [{"radii_m": [0.004]}]}, REGION, "so large that four blocks fit"),
    ({"layer": [{"radii_m": [0.063], "gap_m": 0.08}]}, REGION, "four blocks fit.*80 mm apart"),
    ({"layer": [{"radii_m": [0.063], "gap_m": 0.02, "blocks_per_ring": [16]}]}, REGION,
     "20 mm apart; instead received 16. 11 do"),
    ({}, Region.sphere(0.06), "reaches"), ({}, Region.sphere(0.01, (-0.055, 0, 0)), "reaches"),
    ({}, Region.sphere(0.003, (0, 0.062, 0.0765)), "reaches"),
    ({}, Region("cylinder", (0.02, 0.02, 0.06)), None)])
def test_impossible_designs_are_refused(changes, region, message, session):
    if message is None:  # the control; a search would take seconds
        assert Catalogue.of(study(**changes), region, DENSITY).options
        return
    with pytest.raises(StudyError, match=message):
        design_rings(study(**changes), session, region)


@pytest.mark.parametrize(("changes", "message"), [
    ({"design": None}, "the rings to choose from"),
    ({"array": {"free_blocks": {
        "name": ["a"], "shape": ["cuboid"], "x_m": [0.06], "y_m": [0.0], "z_m": [0.0],
        "size_x_m": [0.01], "size_y_m": [0.01], "size_z_m": [0.01], "remanence_T": [1.3]}}},
     r"free blocks or exceptions.*halbach-fe new"),
    ({"dimension": 2}, "dimension"),
    ({"array": DOCUMENT["array"] | {"block": {"shape": "sector"}}, "design": DOCUMENT["design"] | {
        "layer": [{"radii_m": [0.058, 0.063], "gap_m": 0.001}]}}, "gap_m.* left out"),
    ({"iron_ring": {"inner_radius_m": 0.1, "outer_radius_m": 0.12,
                    "relative_permeability": 1000.0}}, "without iron"),
    # the search leaves out what a coil makes: 7650 ppm rms were said of a design of 7818
    ({"external": {"coils": [{"kind": "round", "radius_m": 0.03, "current_A": 200.0,
                              "centre_m": [0.0, 0.0, 0.3]}]}}, "coils or dipoles"),
    ({"external": {"dipoles": [{"position_m": [0.0, 0.5, 0.0],
                                "moment_A_m2": [0.0, 0.0, 10.0]}]}}, "coils or dipoles"),
    ({"external": {"background_T": [0.0, 0.02, 0.0]}}, "background_T"),  # not in its mean field
    ({"array": DOCUMENT["array"] | {"multipole_order": 2}}, "multipole_order"),
    ({"array": DOCUMENT["array"] | {"exceptions": [{"ring": 1, "remanence_T": 1.2}]}},
     "without exceptions")])
def test_studies_that_cannot_be_designed_are_refused(changes, message, session):
    other = parse_study({key: value for key, value in (DOCUMENT | changes).items()
                         if value is not None})
    with pytest.raises(StudyError, match=message):
        design_rings(other, session, REGION)


def test_a_coil_is_refused_before_rings_are_moved_into_it():
    away = parse_study(DOCUMENT | {
        "array": DOCUMENT["array"] | {"ring": [{"z_m": 0.3}]}, "external": {"coils": [{
            "kind": "round", "radius_m": 0.065, "current_A": 200.0,
            "section_m": [0.002, 0.002]}]}})
    assert build_magnet(away)
    with pytest.raises(StudyError, match="coils or dipoles"):
        about_origin(away)


def test_command_line(tmp_path):
    path = tmp_path / "study.toml"
    path.write_text(tomlkit.dumps(study(rings=4).model_dump(
        mode="json", exclude_defaults=True)), encoding="utf-8")
    output = tmp_path / "results"
    assert main(["design", str(path), "-o", str(output), "--cylinder-m", "0.02", "0.05"]) == 0
    summary = json.loads((output / "design.json").read_text(encoding="utf-8"))
    again = read_study(output / STUDY_FILE)
    assert len(build_magnet(again).blocks) == summary["best"]["blocks"]
    # as advised: of the region that was asked for, which the study states now
    assert main(["homogeneity", str(output / STUDY_FILE), "-o", str(tmp_path / "h")]) == 0
    known = json.loads((tmp_path / "h" / "homogeneity.json").read_text(encoding="utf-8"))
    # the search has the points of more angles, 7.5 degrees apart, besides
    assert known["prior"]["peak_to_peak_ppm"] == pytest.approx(
        summary["best"]["peak_to_peak_ppm"], rel=2e-3)


@pytest.mark.parametrize("region", [
    Region.sphere(0.01, (0.0, 0.0, 0.02)), Region("ellipsoid", (0.01, 0.02, 0.03)),
    Region("cylinder", (0.01, 0.01, 0.03))])
def test_a_region_is_stated_as_it_is_read(region):
    table = HomogeneityRegion(**region.table)
    assert Region.of(table.sphere_m, table.ellipsoid_m, table.cylinder_m, table.centre_m) == region


def test_pages(designed, tmp_path):
    page = write_report(designed, tmp_path)
    assert "peak to peak" in page.read_text(encoding="utf-8")
    assert "<table" in html_of(designed)


def test_rings_that_stand_elsewhere_are_designed_about_the_origin(session, tmp_path):
    """Designed rings are about z = 0: so is the region, where the study's rings are not."""
    there = study(array={"ring": [{"z_m": 0.1}]}, rings=4)
    found = design_rings(there, session)
    mean, *_ = deviations(found)
    assert found.region.centre_m == (0.0, 0.0, 0.0)
    # that of the magnet's middle is far from the mean in the fringe, and near in the bore
    assert found.best.mean_T == pytest.approx(mean, rel=1e-2)
    path = tmp_path / "study.toml"
    path.write_text(tomlkit.dumps(there.model_dump(
        mode="json", exclude_defaults=True, exclude_none=True)), encoding="utf-8")
    assert main(["design", str(path), "-o", str(tmp_path / "out"),
                 "--sphere-m", "0.025"]) == 0
    told = json.loads((tmp_path / "out/design.json").read_text(encoding="utf-8"))
    assert told["region"]["centre_m"] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(("centre", "said"), [
    ((0.0, 0.0, 0.0), ""), ((0.0, 0.0, 0.03), ""), ((0.0, 0.0, 1.0), "beyond the end of the rings"),
    ((0.0, 0.0, -0.4), "beyond the end"), ((0.4, 0.0, 0.0), "outside of the bore")])
def test_a_region_off_the_rings_is_no_yes(designed, centre, said):
    """It was "Yes", of a stray field. The first two are the control."""
    found = replace(designed, region=Region.sphere(0.01, centre))
    told = answer(found)
    assert told.trust.startswith("No. The middle of the region is" if said else "Yes")
    assert said in told.trust
    assert told.sound == (not said)
    assert ("--centre-m" in told.step) == bool(said)


def test_one_type_of_blocks_remains_one():
    """A study whose slots are all of one type has one type in any rings, so that `sort` works."""
    one = parse_study(DOCUMENT | {"prior": {"types": {"cube": list(range(1, 17))}}})
    rings = [Ring(blocks_per_ring=count) for count in (12, 20)]
    assert ring_catalogue.designed(one, rings).prior.types == {"cube": tuple(range(1, 21))}
    assert ring_catalogue.designed(study(), rings).prior.types == {}
    two = parse_study(DOCUMENT | {"prior": {"types": {"a": [1], "b": list(range(2, 17))}}})
    with pytest.raises(StudyError, match=r"prior\.types must name every slot from 1 to 20"):
        ring_catalogue.designed(two, rings)


@pytest.mark.parametrize("objective", ["peak_to_peak", "rms"])
@pytest.mark.parametrize("least_field", [0.0, 5.0, 50.0])
def test_best_pair_is_the_best_of_all(generator, objective, least_field):
    """Random tables, with designs that have all, some, or none of the field that is asked."""
    table = generator.normal(1.0, 0.1, (5, 4, 9))
    task = Task(table, np.zeros(9), np.full(7, 1 / 7), objective, least_field, 5.5)
    chosen = generator.integers(4, size=5)
    total = task.total(chosen)
    rest = total - table[np.arange(5), chosen]
    values = {}
    for a, b in combinations(range(5), 2):
        for i, j in product(range(4), repeat=2):
            changed = chosen.copy()
            changed[[a, b]] = i, j
            values[a, i, b, j] = float(task.value(task.total(changed)))
    # all options of every place are tried, as there are fewer than `PAIRED`
    least, new = _best_pair(task, rest, total, task.value(rest[:, None] + table))
    (a, i), (b, j) = new.items()
    assert least == pytest.approx(min(values.values()), rel=1e-9)
    assert values[a, i, b, j] == pytest.approx(least, rel=1e-9)
    assert least < (1 - 1e-5) * sorted(values.values())[1]  # the second best is another value
