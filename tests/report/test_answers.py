"""What every page says first: its numbers are those of the result, and its command exists."""

from __future__ import annotations

import argparse
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tomlkit

import halbach_fe as hf
from halbach_fe.cli import main
from halbach_fe.cli.common import _paths_of
from halbach_fe.cli.verbs import parser
from halbach_fe.core.errors import StudyError
from halbach_fe.core.files import write_text
from halbach_fe.core.result_folder import result_folder
from halbach_fe.diagnosis.effects.base import Parameter
from halbach_fe.diagnosis.effects.magnetization import BlockDemagnetizedEffect
from halbach_fe.diagnosis.summary import amounts
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.inference.posterior_files import read_posterior, write_inference
from halbach_fe.inference.result import OWN_NOISE
from halbach_fe.report import (
    demagnetization_page,
    diagnosis_figures,
    field_page,
    forces_page,
    homogeneity_page,
    inference_answer,
    multipoles_page,
    plan_page,
    prior_page,
    shimming_page,
    simulated_campaign_page,
    solution_page,
    sorting_page,
    tolerance_page,
    verification_page,
)
from halbach_fe.report.answer import LISTED_MAPS, MOST_WORDS, Answer, known_paths, of_a_conflict
from halbach_fe.report.page import write_files
from halbach_fe.report.words import (
    bayes_factor,
    decimals,
    faults_in_words,
    flux_density,
    ppm,
    share_in_words,
    with_error,
)
from halbach_fe.response.multipoles import MultipoleReference, Multipoles
from halbach_fe.response.region import Region
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.conftest import DIPOLE, ROOT, changed
from tests.support.pages import answer_of, command_of

MAGNET = {
    "name": "answers", "dimension": 3,
    "array": {"blocks_per_ring": 8, "rings": 2, "inner_radius_m": 0.05, "outer_radius_m": 0.07,
              "ring_length_m": 0.02, "ring_gap_m": 0.01, "remanence_T": 1.3,
              "block": {"shape": "cuboid", "width_m": 0.02, "orientation": "magnetization"}},
    "mesh": {"block_size_m": 0.01},
    "observation": {"quantity": "flux_density", "positions": {
        "kind": "circles", "radius_m": 0.03, "angles": 8, "z_min_m": -0.03, "z_max_m": 0.03,
        "count": 5}},
    "noise": {"regions": [{"name": "all", "sigma_T": 1e-5}]},
    "prior": {"magnitude_sd": 0.01, "direction_sd_deg": 1.0,
              "types": {"a": list(range(1, 9))}},
    "demagnetization": {
        "intrinsic_coercivity_A_per_m": 9.55e5, "remanence_coefficient_per_K": -0.0012,
        "coercivity_coefficient_per_K": -0.006, "temperature_C": 60}}
"""Sixteen cubes in vacuum, where nothing has to be solved."""

ALIASES = 0.05
"""Part of a main multipole that eight angles may mistake for it, and that the answer subtracts: the
order 8 - n of eight cubes, at 0.6 of their radius."""


class Given:
    """The magnet, and what the commands need."""

    def __init__(self, folder):
        self.study = parse_study(MAGNET)
        self.magnet = build_magnet(self.study)
        self.session = Session.open(folder)
        self.campaign = simulate_campaign(self.study, 3)
        self.updated = hf.infer(self.magnet, self.campaign.readings, self.session)


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    return Given(tmp_path_factory.mktemp("answers"))


def of_solve(given):
    found = hf.solve(given.magnet, given.session)
    size = np.linalg.norm(found.flux_density, axis=1)
    return solution_page.answer(found), [flux_density(size.max(), 4), "exact", "homogeneity STUDY"]


def test_the_field_in_the_middle_is_said_first(given):
    """A dipole by its field, a quadrupole by its gradient; without circles nothing is known. In 3D
    they are those of the circle, which the field in the middle of a short magnet is not.
    """
    for order, name, scale, unit in (
            (1, "dipole harmonic", 1e-3, "mT"),
            (2, "gradient, by the quadrupole harmonic,", 0.03, "T/m"),
            (3, "main multipole, of order 3,", 1e-3, "mT")):
        magnet = build_magnet(given.study.with_(array__multipole_order=order))
        found = hf.solve(magnet, given.session)
        on_circle = np.isclose(found.points[:, 2], 0)  # B_r at 8 angles
        angle = np.arctan2(*found.points[on_circle, 1::-1].T)
        radial = (found.flux_density[on_circle, :2] * np.column_stack(
            [np.cos(angle), np.sin(angle)])).sum(axis=1)
        size = 2 * abs(np.mean(radial * np.exp(-1j * order * angle)))
        said = solution_page.page(found).answer.said
        assert re.match("On the circle r = 30\u00a0mm at z = 0\u00a0mm the "
                        f"{name} is ([0-9.]+)\u00a0{unit}", said)
        value = float(re.search("is ([0-9.]+)", said)[1])
        assert value == pytest.approx(size / scale, rel=ALIASES)
    assert "On the circle" not in solution_page.answer(found).said
    rounded = given.study.observation.positions.model_copy(update={
        "z_min_m": -0.055, "z_max_m": 0.055, "count": 21})  # the 11th at -7e-18 m
    found = hf.solve(build_magnet(given.study.with_(
        observation__positions=rounded.model_dump())), given.session)
    assert "at z = 0\u00a0mm" in solution_page.page(found).answer.said


def test_blocks_that_are_not_as_designed_are_named(given):
    """Below the title of every page, so that no number of theirs is read as the design's."""
    def said(*exceptions, study=given.study):
        return faults_in_words(study.with_(array__exceptions=exceptions))

    assert said() == ""
    assert said({"ring": 1, "slot": 3, "displacement_m": (1e-4, 0, 0)}) == ""
    assert said({"ring": 1, "slot": 3, "magnetization_factor": -0.98},
                {"ring": 1, "slot": 5, "magnetization_factor": 0}) == (
        "reversed: ring 1, slot 3; missing: ring 1, slot 5")
    exchanged = ({"ring": 1, "slot": 1, "mounted_from": (1, 2)},
                 {"ring": 1, "slot": 2, "mounted_from": (1, 1)})
    along_radius = parse_study(changed(MAGNET, array__block={"shape": "sector"}))
    assert said(*exchanged, study=along_radius) == (
        "made for another place: ring 1, slot 1; ring 1, slot 2")
    assert said(*exchanged) == ""  # equal cubes, each along its magnetization, as `shim` swaps them
    assert said({"ring": 1, "slot": 3, "rotation_deg": (0, 5.0, 0)},  # a slot allows that
                {"ring": 1, "slot": 4, "rotation_deg": (-180.0, 0, 0)}) == (
        "put in the wrong way: ring 1, slot 4")
    # Turned about its magnetization: a cube is as designed, a bar that fits the slot is not.
    turned = {"ring": 1, "slot": 1, "rotation_deg": (90.0, 0, 0)}
    assert said(turned) == ""
    bars = given.study.with_(array__ring_length_m=0.028)
    assert said(turned, study=bars) == "put in the wrong way: ring 1, slot 1"
    half = turned | {"rotation_deg": (0, 0, 180.0)}
    assert said(half | {"magnetization_factor": -1}) == ""
    assert said(half) == "put in the wrong way: ring 1, slot 1"
    flat = parse_study(changed(DIPOLE, array__first_block_angle_deg=0,
                               array__first_magnetization_angle_deg=0))
    assert said({"ring": 1, "slot": 2, "rotation_deg": (180.0, 0, 0)}, study=flat)
    assert not said({"ring": 1, "slot": 1, "rotation_deg": (180.0, 0, 0)}, study=flat)
    assert "6 blocks" in said(*(
        {"ring": 1, "slot": slot, "magnetization_factor": -1} for slot in range(1, 7)))


def of_verify(given):
    found = hf.verify(given.magnet, given.session)
    return verification_page.answer(found), [flux_density(found.main_field_T, 4), "exact"]


def test_a_field_beside_iron_is_never_called_a_closed_form(given):
    """A sphere 5 m away changes it by less than the computer rounds: pages said there was none."""
    beside = given.magnet.with_(iron={"relative_permeability": 1000.0, "bodies": [
        {"kind": "sphere", "radius_m": 0.005, "centre_m": [5.0, 0.0, 0.0]}]})
    for found, answer in ((hf.solve(given.magnet, given.session), solution_page.answer),
                          (hf.verify(given.magnet, given.session), verification_page.answer)):
        for magnet, is_exact in ((given.magnet, True), (beside, False)):
            said = answer(replace(found, magnet=magnet))
            assert ("exact" in said.said + said.trust) == is_exact
    assert verification_page.difference_table(replace(found, magnet=beside))


def test_the_integrated_field_of_coils_is_never_called_exact(given):
    """A racetrack's is 1e-3 off beside it; wire along straight segments has a closed form."""
    racetrack = {"kind": "racetrack", "size_m": [0.4, 0.2], "corner_radius_m": 0.05,
                 "current_A": 100.0, "section_m": [0.01, 0.01], "centre_m": [0.0, 0.0, 2.0]}
    polygon = {"kind": "polygon", "points_m": [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]],
               "current_A": 100.0, "centre_m": [0.0, 0.0, 2.0]}
    for found, answer in ((hf.solve(given.magnet, given.session), solution_page.answer),
                          (hf.verify(given.magnet, given.session), verification_page.answer)):
        for coil, said in ((racetrack, True), (polygon, False)):
            shown = answer(replace(found, magnet=given.magnet.with_(external__coils=[coil])))
            assert ("integrated, and up to 1e-3" in shown.said + shown.trust) == said
            assert ("that is exact" in shown.trust or "rounding" in shown.trust) != said


def test_errors_of_readings_and_of_the_vector_are_told_apart(dipole, session):
    """A Fourier coefficient is off by less than B at a point: each answer says what is meant."""
    for quantity, settings in (("flux_density", {}), (
            "fourier_coefficients", {"observation__harmonics": 5})):
        magnet = build_magnet(dipole(
            observation__quantity=quantity, mesh__block_size_m=0.04, **settings))
        solved, verified = hf.solve(magnet, session), hf.verify(magnet, session)
        coefficient = quantity == "fourier_coefficients"
        said = solution_page.answer(solved).said
        assert ("a Fourier coefficient of B_r" in said) == coefficient
        assert ("a component of B" in said) != coefficient
        assert flux_density(solved.errors.max()) in said
        said = verification_page.answer(verified).said
        off = flux_density(verified.error_pointwise * verified.main_field_T)
        assert f"the vector B is off by {off}" in said
        own = flux_density(verified.error_fourier * verified.main_field_T)
        assert (f"is off by {own} at most: over a circle" in said) == coefficient


def test_the_mean_of_a_multipole_is_zero_and_that_of_its_size_is_not(session):
    """A quadrupole of twelve sectors: on its circle B turns twice."""
    study = parse_study(changed(DIPOLE, array__multipole_order=2, array__recoil_permeability=1.0,
                                array__blocks_per_ring=12))
    rows = {row["B"]: row for row in solution_page.field_table(
        hf.solve(build_magnet(study), session))}
    assert rows["mean of the vector B"]["|B|"] == "0\u00a0mT"
    assert float(rows["mean of |B|"]["|B|"].split()[0]) > 100
    assert rows["mean of |B|"]["Bx"] == ""


def test_a_field_that_cancels_has_no_direction(given):
    """Sixteen cubes as a quadrupole: |B| has a mean, the vector B has none."""
    four = parse_study(changed(MAGNET, array__multipole_order=2))
    for study, cancels in ((four, True), (given.study, False)):
        found = hf.homogeneity(build_magnet(study), given.session, degrees=2)
        row, = homogeneity_page.homogeneity_rows(found.by_name)
        assert (row["direction of the mean B"] == "none: it cancels") == cancels
        assert float(row["mean of |B|"].split("\u00a0")[0]) > 1
        said = homogeneity_page.answer(found)
        assert said.trust.startswith("Only" if cancels else "Yes")
        assert ("multipoles" in said.command) == cancels
        if cancels:  # of a study of a dipole, whose multipoles would be refused
            other = homogeneity_page.answer(replace(found, magnet=given.magnet))
            assert other.command.startswith("halbach-fe field STUDY --from-m 0 0 -")
        assert bool(homogeneity_page.harmonic_rows(found)) != cancels


@pytest.mark.parametrize(("mean", "root"), [  # b_n and a_n in units; columns are independent
    ((0, 0), ((50, 0), (0, 50))), ((-7000, 0), ((0.01, 0), (0, 90))),
    ((300, 400), ((30, 0), (-10, 20))), ((0, 90), ((90, 0), (0, 0.01))),
    ((40, 0), ((10, 0), (0, 80)))])
def test_error_of_a_multipoles_size(mean, root):
    """It is that of drawn magnets; parts across a large multipole only turn it."""
    known = Multipoles((3,), 1.0, 0.0, 0.0, 0.0, np.array(mean, float), np.array(root, float),
                          np.zeros(2), np.array(root, float))
    drawn = known.sizes_of(np.random.default_rng(1).standard_normal((20_000, 2)))
    spread, = multipoles_page._size_sd(known)
    # where the mean is 0 the rms of a part is stated, 1.5 times the sd of a Rayleigh distribution
    assert 0.85 < spread / np.std(drawn) < 1.6


def of_multipoles(given):
    tables = hf.multipoles(given.magnet, given.session).tables
    known = [magnets["prior"] for _, magnets in tables]
    # the largest one that the answer states is in the table
    largest = [max(multipoles_page.multipole_rows(magnets), key=lambda row: float(
        row["|c_n| prior"].split("\u00a0")[0]))["|c_n| prior"] for _, magnets in tables]
    return multipoles_page.answer(tables, 50.0), [
        *(f"{size} units" for size in largest),
        *(with_error(1e3 * one.main, 1e3 * one.main_sd) for one in known), "within 50 units",
        "as ordered"]


@pytest.mark.filterwarnings("ignore:The field integrated along z has no multipole")
def test_what_was_asked_on_a_circle_is_advised_there(given, tmp_path):
    """Of rings of opposite fields, along which the main multipole cancels, without the circle the
    advised command is refused. The control is a magnet whose multipoles are integrated along z.
    """
    document = changed(MAGNET, array__ring=[{}, {"first_magnetization_angle_deg": 180.0}])
    del document["array"]["rings"]
    study, there = parse_study(document), MultipoleReference(0.02, (2, 3), 0.015)
    magnet, campaign = build_magnet(study), simulate_campaign(study, 3)
    updated = hf.infer(magnet, campaign.readings, given.session)
    option = " --at-z-m 0.015 "
    said = [multipoles_page.page(hf.multipoles(magnet, given.session, there, updated)).answer,
            tolerance_page.answer(hf.tolerance(magnet, given.session, None, there, draws=100)),
            sorting_page.answer(replace(hf.sort(magnet, campaign.blocks, given.session, there),
                                        doubts=("Is it?",)))]
    assert [option in one.command for one in said] == [True, True, True]
    with pytest.raises(StudyError, match="--at-z-m Z"):
        hf.shim(updated, given.session)
    assert hf.shim(updated, given.session, there, swaps=1, turns=0).tried
    plain = [multipoles_page.page(hf.multipoles(given.magnet, given.session, None, given.updated)),
             tolerance_page.page(hf.tolerance(given.magnet, given.session, draws=100))]
    assert not any("--at-z-m" in one.answer.command for one in plain)


def of_homogeneity(given):
    found = hf.homogeneity(given.magnet, given.session, degrees=2)
    known = found.by_name["prior"]
    return homogeneity_page.answer(found), [f"{ppm(known.rms_ppm)} ppm rms", "exact", "as ordered"]


@pytest.mark.parametrize("free", [True, False])
def test_only_rings_are_sent_to_the_design_of_rings(tmp_path, session, free):
    """`halbach-fe design` refuses free blocks: the advice is another one, and it works."""
    blocks = {"name": ["a"], "shape": ["cuboid"], "x_m": [0.0], "y_m": [0.0], "z_m": [-0.05],
              "size_x_m": [0.02], "size_y_m": [0.02], "size_z_m": [0.02],
              "remanence_x_T": [0.0], "remanence_y_T": [0.0], "remanence_z_T": [1.3]}
    document = changed(MAGNET)
    if free:
        document["array"] = {"free_blocks": blocks}
        del document["prior"]["types"]
    study = tmp_path / "study.toml"
    study.write_text(tomlkit.dumps(document))
    magnet = build_magnet(hf.read_study(study))
    said = homogeneity_page.answer(hf.homogeneity(magnet, session, Region.sphere(0.01), degrees=2))
    assert ("design" in said.command) != free
    if free:
        words = shlex.split(said.command.replace("STUDY", str(study)).replace(
            " R ", " 0.005 ").replace("DIR", str(tmp_path / "out")))
        assert main(words[1:]) == 0


def of_forces(given):
    found = hf.forces(given.magnet, given.session)
    return forces_page.answer(found), [
        f"{decimals(found.in_place.magnitude.max())}\u00a0N", "of 16",
        f"{found.mass_kg.sum():.4g} kg"]


def test_the_force_on_a_ring_is_that_of_its_blocks_together(given):
    """Two equal rings feel opposite forces along z; the control is one ring, which feels none."""
    found = hf.forces(given.magnet, given.session)
    ring = np.array([block.ring for block in found.blocks])
    together = found.in_place.force_N[ring == 1].sum(axis=0)
    assert abs(together[2]) > 10 * np.hypot(*together[:2])
    said = forces_page.answer(found).said
    assert f"pushed by {forces_page._newton(float(np.linalg.norm(together)))}" in said
    named = int(re.search(r"the blocks of ring (\d) are pushed", said)[1])
    sign = "+" if found.in_place.force_N[ring == named].sum(axis=0)[2] > 0 else "−"
    assert f"(x, y, z: +0.00, +0.00, {sign}1.00)" in said
    single = build_magnet(given.study.with_(array__rings=1))
    assert "are pushed by" not in forces_page.answer(hf.forces(single, given.session)).said


def test_the_block_that_loses_most_is_named(given):
    """At a temperature at which some lose; the control is the magnet that loses nothing."""
    def said(temperature):
        magnet = build_magnet(given.study.with_(demagnetization__temperature_C=temperature))
        found = hf.demagnetization(magnet, given.session, across=2)
        return demagnetization_page.answer(found), found

    hot, found = said(140.0)
    most = max(found.by_block(), key=lambda row: row["share_beyond_knee"])
    assert most["share_beyond_knee"] > 0
    assert f"of which {100 * most['share_beyond_knee']:.3g} % is past the knee" in hot.said
    assert hot.concern.startswith("At 140")
    assert "remanence counts as that at 20\u00a0°C" in hot.trust
    cold, kept = said(20.0)
    assert "loses most" not in cold.said
    assert cold.concern == ""
    assert "remanence counts" not in cold.trust
    # 1.5 % of a single block are no very edges, though it is 0.1 % of the magnet; 0.5 % are
    whole = kept.cells.volumes[kept.cells.block == 0].sum()
    for share, word in ((0.015, "No"), (0.005, "Yes")):
        along, volumes = kept.places.along.copy(), kept.places.volumes.copy()
        one = np.flatnonzero(kept.cells.block[kept.places.cell] == 0)[0]
        along[one], volumes[one] = -1e8, share * whole
        lost = replace(kept, places=replace(kept.places, along=along, volumes=volumes))
        assert 0 < lost.share_beyond_now < demagnetization_page.VERY_EDGES
        assert demagnetization_page.answer(lost).said.startswith(word)


def of_plan(given):
    found = hf.plan(given.magnet, given.session, points=6)
    left = np.exp(-found.gain[-1] / len(found.parameters))
    every = np.exp(-found.baseline_gain[-1] / len(found.parameters))
    return plan_page.answer(found), ["6 positions", f"{100 * left:.1f}", f"{100 * every:.1f}"]


def of_prior(given):
    found = prior_from_blocks(given.magnet, given.campaign.blocks)
    spread = np.sqrt(np.mean(found.gaussian.sd**2) / np.mean(found.nominal**2))
    return prior_page.answer(found), ["16 measured blocks", f"{100 * spread:.1f}"]


def of_sort(given):
    found = hf.sort(given.magnet, given.campaign.blocks, given.session)
    size = np.sqrt(np.mean(found.best.sizes**2))
    low, high = np.quantile(found.random, [0.025, 0.975])
    return sorting_page.answer(found), [f"{size:.3g} units", "blocks.sorted.csv",
                                        f"in 95 % of random orders {low:.3g} to {high:.3g}"]


def test_sort_says_whether_its_limit_is_met(given):
    """An answer without a word of it said "Yes" of magnets 30 times beyond; a wide one is met."""
    found = hf.sort(given.magnet, given.campaign.blocks, given.session)
    assert "with a probability" not in sorting_page.answer(found).said  # without a limit
    largest = found.best.sizes.max()
    narrow, wide = (sorting_page.answer(replace(found, limit=float(part * largest))).said
                    for part in (0.5, 10.0))
    assert "probability of less than 0.1\u00a0%. Sorting does not reach that limit." in narrow
    assert "with a probability of more than 99.9\u00a0%." in wide
    assert "reach" not in wide
    content = sorting_page.page(replace(found, limit=float(10 * largest))).summary
    assert content["probability_within_limit"] == 1.0


def test_sort_of_blocks_that_are_alike_says_that_they_are(given):
    """The slots of a type may all take the same blocks: not only those at one angle may change."""
    found = hf.sort(given.magnet, given.campaign.blocks, given.session)
    found = replace(found, random=np.full(len(found.random), found.best.rms_of_mean))
    said = sorting_page.answer(found)
    assert said.said.startswith("It does not matter")
    assert "alike as measured" in said.trust
    assert "at the same angle" not in said.trust


@pytest.mark.filterwarnings("ignore:Every block of study")
@pytest.mark.parametrize(("rings", "types", "said"), [
    (2, {"a": list(range(1, 9))}, "random orders"), (2, None, "It does not matter"),
    (1, None, "there is no choice")])
def test_without_a_choice_no_order_stands_beside_another(given, tmp_path, rings, types, said):
    """A slot's own type lets a block change its ring alone, which the field along z does not see.

    Random orders are in the units of the sorted one: where all are alike they are equal to it.
    """
    study = parse_study(changed(MAGNET, array__rings=rings, prior={
        "magnitude_sd": 0.05, "direction_sd_deg": 1.0} | ({"types": types} if types else {})))
    found = hf.sort(build_magnet(study), simulate_campaign(study, 3).blocks, given.session)
    write_files(sorting_page.page(found), tmp_path)
    text = (tmp_path / "sort.html").read_text()
    assert said in text
    assert ("as placed in the table" in text) == (said == "random orders")
    assert "The order hardly matters" not in text  # the control of the test of that
    named = ", ".join(row["blocks, slot by slot"] for row in sorting_page.place_table(found))
    order = np.lexsort((found.table.slot, found.table.ring)).tolist()
    assert named.split(", ") == [found.table.serial[row] for row in order]
    assert "1 to 8" in text
    assert ("b_n" in sorting_page.order_table(found)[0]) != (said == "random orders")
    if said == "random orders":
        assert found.best.rms_of_mean < found.random.min()
    else:
        # 4e-7 were measured: the integral along z ends somewhere; a main multipole that is that
        # of blocks of median strength was 2e-3 off
        np.testing.assert_allclose(found.random, found.best.rms_of_mean, rtol=1e-5)


def of_shim(given):
    found = hf.shim(given.updated, given.session, swaps=1, turns=0)
    after = np.sqrt(found.after.expected_square / len(found.after.orders))
    return shimming_page.answer(found), [
        f"{after:.3g} units", f"{len(found.steps)} move" if found.steps else "No move"]


def of_tolerance(given):
    sizes = hf.tolerance(given.magnet, given.session, draws=200).sizes.max(axis=1)
    found = hf.tolerance(given.magnet, given.session, draws=200,
                         limit_units=float(np.quantile(sizes, 0.3)))
    return tolerance_page.answer(found), [
        with_error(100 * found.share, 100 * found.share_sd), "200 magnets"]


@pytest.mark.parametrize(("types", "told"), [({}, True), ({"a": [1, 2, 3, 4, 5, 6, 7, 8]}, False)])
def test_tolerance_sends_to_sort_where_blocks_can_change_places(types, told):
    """Of one ring without prior.types `sort` has nothing to sort."""
    magnet = hf.halbach_ring(order=2, blocks=8, inner_radius_m=0.02, outer_radius_m=0.04).with_(
        prior__types=types)
    step = tolerance_page.answer(hf.tolerance(magnet, draws=200)).step
    assert ("Every slot is a type of its own" in step) == told
    assert "prior.types" in step or not told


def of_demagnetization(given):
    found = hf.demagnetization(given.magnet, given.session, across=2)
    return demagnetization_page.answer(found), [
        f"{1e-3 * found.margin.min():+.0f} kA/m", "Yes: at 60\u00a0°C", "ring "]


def of_simulate(given):
    readings = given.campaign.readings
    return (simulated_campaign_page.answer(given.study, readings, given.campaign.held_out,
                                           len(given.campaign.blocks)),
            ["40 points", "16 single blocks", flux_density(
                float(np.nanmax(np.abs(readings["B_T"].values))), 4), "10\u00a0µT"])


def of_infer(given):
    off = given.updated.readings - given.updated.prediction_posterior.mean
    return inference_answer.answer(given.updated), [
        flux_density(float(np.sqrt(np.mean(off**2)))), f"{given.updated.prior_conflict:.3g}"]


def of_field(given):
    lines = hf.Lines((0, 0, -0.2), (0, 0, 0.2), count=41)
    found = hf.field(given.magnet, lines, given.session)
    first, sd = found.integrals(1)
    return field_page.answer(found), [
        flux_density(float(np.linalg.norm(found.mean, axis=2).max()), 4), "1 line of 41 points",
        with_error(float(first[0, 0]), float(sd[0, 0])), "as ordered"]


ANSWERS = (of_solve, of_verify, of_field, of_multipoles, of_homogeneity, of_forces, of_plan,
           of_prior, of_sort, of_shim, of_tolerance, of_demagnetization, of_simulate, of_infer)


@pytest.mark.parametrize("of", ANSWERS, ids=lambda of: of.__name__)
def test_the_answer_has_the_numbers_of_its_result(given, of):
    found, numbers = of(given)
    check(found, numbers)
    with pytest.raises(AssertionError):  # the control: a number of no result
        check(found, ["123456.789"])


def check(found, numbers):
    text = " ".join(found.sentences) + found.command
    for number in numbers:
        assert number in text, number
    assert found.question.endswith("?")
    assert found.sound
    assert re.match("Yes|No|Only", found.trust), found.trust
    for word in ("nan", "None", "e-0", "e+0", "r01s", "nats"):
        assert word not in text, word
    program, *words = shlex.split(found.command)
    assert program == "halbach-fe"
    assert parser(words[:1]).parse_args(words).verb == words[0]


def test_a_mere_verdict_stands_with_its_reason():
    for trust, short in (("Only in part. A block is open. More.", "Only in part. A block is open."),
                         ("No. It is off. More.", "No. It is off."),
                         ("The fit is good. More.", "The fit is good.")):
        assert Answer("?", "Said.", trust, "Step.").short_trust == short


def test_page_and_terminal_say_the_same(tmp_path, capsys, monkeypatch):
    """With the paths of the files in the command."""
    study = ROOT / "studies" / "quadrupole" / "study.toml"
    blocks = study.parent / "campaign" / "blocks.csv"
    assert main(["prior", str(study), str(blocks), "-o", str(tmp_path)]) == 0
    said, shown = capsys.readouterr().err, answer_of(tmp_path / "prior.html")
    for part in ("said", "trust", "step"):
        assert shown[part].replace("\u00a0", " ") in said.replace("\u00a0", " ")
    assert f"infer {study} --measurements MAP --blocks {blocks}" in said
    assert "12 measured blocks" in shown["said"]
    # the page names them from the current folder, and without one that is running, none
    monkeypatch.chdir(ROOT)
    assert main(["prior", str(study), str(blocks), "-o", str(tmp_path)]) == 0
    named = command_of(tmp_path / "prior.html")
    assert named == (f"halbach-fe infer {study.relative_to(ROOT)} --measurements MAP --blocks "
                     f"{blocks.relative_to(ROOT)} -o DIR")
    assert json.loads((tmp_path / "page.json").read_text())["answer"]["command"] == named
    assert Answer("?", "", "", "", "halbach-fe solve STUDY -o DIR").with_known_paths().command == (
        "halbach-fe solve STUDY -o DIR")
    assert json.loads((tmp_path / "prior.json").read_text())["blocks"] == 12


@pytest.mark.parametrize(("nats", "said"), [
    (np.log(2.5), "2.5 : 1"), (np.log(140), "140 : 1"), (83.0, "10³⁶ : 1"),
    (5e5, "over 10¹⁰⁰ : 1"), (np.nan, "–")])
def test_bayes_factors_in_words(nats, said):
    """Of 83 nats the power of ten is 36.05."""
    assert bayes_factor(nats).replace("\u00a0", " ") == said


@pytest.mark.parametrize(("value", "digits", "said"), [
    (43870.0, 3, "43\u202f900"), (999.6, 3, "1\u202f000"), (0.50649, 3, "0.506"),
    (2e-5, 2, "0.0000200"), (1e-9, 3, "0"), (-1234.0, 2, "-1\u202f200")])
def test_decimals_have_no_exponent(value, digits, said):
    assert decimals(value, digits) == said


@pytest.mark.parametrize(("said", "headline"), [
    ("The middle lies at 1.5 mm. Its odds are 1 : 1.", "The middle lies at 1.5 mm."),
    ("Passed. The map obeys. More.", "Passed. The map obeys."), ("Yes", "Yes"),
    ("word, " * 100, ("word, " * 35).rstrip(", ") + " …"),
    ("word " * 32 + "78 ± 3 mm from " + "word " * 9, "word " * 32 + "…")])
def test_large_type_has_forty_words(said, headline):
    """Those of the numbers are among them: `before` and `3 mT`, with a space of two words."""
    answer = Answer("?", said, "Yes.", "", numbers=(("off before", "3 mT"),))
    assert answer.headline == headline
    shown = " ".join([answer.headline, *(" ".join(each) for each in answer.numbers)])
    assert len(shown.split(" ")) <= MOST_WORDS


def test_what_holds_only_in_part_is_no_yes():
    """Its box has another colour than one that may be used as it stands."""
    levels = [Answer("?", "1", trust, "", sound=sound).level for trust, sound in (
        ("Yes.", True), ("Only in part.", True), ("Only in part.", False), ("No.", False))]
    assert levels == ["", "partial", "partial", "doubtful"]


def test_paths_in_a_command_are_quoted():
    found = Answer("?", "", "", "", "halbach-fe infer STUDY --measurements MAP -o DIR").with_paths(
        {"STUDY": "my study.toml", "MAP": None})
    assert found.command == "halbach-fe infer 'my study.toml' --measurements MAP -o DIR"


def test_the_command_has_the_files_of_the_user(tmp_path):
    """Quoted for a shell; a folder for other results is not that of these."""
    command = "halbach-fe homogeneity STUDY --posterior POSTERIOR --blocks DIR/b.csv -o DIR"
    answer = Answer("?", "", "", "", command)
    assert answer.with_paths({"DIR": None}).command == command
    found = answer.with_paths({"STUDY": tmp_path / "my study.toml", "DIR": "a b", "POSTERIOR": "p"})
    assert shlex.split(found.command)[2:] == [
        str(tmp_path / "my study.toml"), "--posterior", "p", "--blocks", "a b/b.csv", "-o", "DIR"]


@pytest.mark.parametrize(("verb", "held_out"), [
    ("infer", True), ("diagnose", True), ("register", False), ("shim", False)])
def test_the_command_has_the_held_out_map_where_it_takes_one(verb, held_out):
    answer = Answer("?", "", "", "", f"halbach-fe {verb} STUDY --measurements MAP -o DIR")
    found = answer.with_paths({"MAP": "m.csv", "HELD_OUT": "h.csv"}).command
    assert found.endswith(f"m.csv{' --held-out h.csv' if held_out else ''} -o DIR")
    assert answer.with_paths({"MAP": "m.csv"}).command.endswith("m.csv -o DIR")
    new = replace(answer, command=answer.command.replace("MAP", "NEW_MAP"))
    assert "--held-out" not in new.with_paths({"HELD_OUT": "h.csv"}).command


@pytest.mark.parametrize("verb", ["infer", "diagnose", "register", "shim"])
def test_a_study_that_lists_its_maps_gets_no_other(verb):
    """`infer`, `diagnose` and `register` refuse one beside them; `shim` takes a single map."""
    answer = Answer("?", "", "", "", f"halbach-fe {verb} STUDY --measurements MAP -o DIR")
    found = answer.with_paths({"STUDY": "s.toml", LISTED_MAPS: True})
    assert found.command == (f"halbach-fe {verb} s.toml -o DIR" if verb != "shim" else
                             "halbach-fe shim s.toml --measurements MAP -o DIR")
    assert "MAP" in answer.with_paths({LISTED_MAPS: False}).command


def test_a_study_file_that_lists_its_maps_is_known(tmp_path):
    from halbach_fe.cli.common import _lists_maps

    path = tmp_path / "study.toml"
    for text, lists in (("[[maps]]\nname = 'a'\n", True), ("maps = [{name = 'a'}]", True),
                        ("# [[maps]]\n[mesh]\n", False)):
        path.write_text(text)
        assert _lists_maps(path) == lists
    assert not _lists_maps(None)
    assert not _lists_maps(tmp_path / "gone.toml")


def test_words_that_stand_for_no_known_path_are_explained():
    answer = Answer("?", "", "", "", "halbach-fe infer STUDY --measurements MAP -o DIR")
    said = answer.with_paths({"STUDY": "a.toml"}).to_fill_in
    assert said == ("In this command MAP is the file of your field map (CSV or HDF5) and DIR is a "
                    "new folder for the results.")
    assert "STUDY is your study file" in answer.to_fill_in
    assert not replace(answer, command="halbach-fe check MAPS").to_fill_in  # the control


def test_the_map_behind_a_posterior_is_named(tmp_path, monkeypatch):
    """The record of the update names it, as long as it is there unchanged."""
    monkeypatch.chdir(tmp_path)
    study, map_ = tmp_path / "study.toml", tmp_path / "map.csv"
    study.write_text("name = 1")
    map_.write_text("1,2")
    with result_folder(tmp_path / "inferred", "halbach-fe infer", "a", [study, map_],
                       {"STUDY": Path("study.toml"), "MAP": map_}):
        write_text(tmp_path / "inferred" / "posterior.h5", "")
    arguments = argparse.Namespace(study=study, posterior=tmp_path / "inferred" / "posterior.h5")
    assert _paths_of(arguments)["MAP"] == map_
    assert _paths_of(argparse.Namespace(study=study)).get("MAP") is None  # the control
    map_.write_text("2,1")
    assert _paths_of(arguments).get("MAP") is None


def test_a_reversed_block_is_no_loss_of_200_per_cent(given):
    """It is said in words by the update, and by the diagnosis of a demagnetized block."""
    found = replace(given.updated, posterior=replace(
        given.updated.posterior, mean=given.updated.response.nominal * np.where(
            np.arange(len(given.updated.response.nominal)) < 3, -0.9, 1.0)))
    said = inference_answer.answer(found).said
    assert re.search(r"ring 1, slot 1, which is reversed: .* with 90\.0+\xa0±\xa0\S+\xa0% of its "
                     "strength", said), said
    assert "reversed" not in inference_answer.answer(given.updated).said  # the control
    loss = BlockDemagnetizedEffect.parameters
    for value, words in ((1.9, "reversed, with 90.0 ± 1.0 % of its strength"),
                         (0.9, "90.0 ± 1.0 %")):
        effect = SimpleNamespace(
            parameters=loss, reported=(np.array([value]), np.array([0.01])),
            hypothesis=SimpleNamespace(effect=SimpleNamespace(title="a title")))
        assert amounts(effect)[0].endswith(words)


def test_an_amplitude_that_the_readings_say_nothing_of_is_left_out():
    """The z of a map of a cross-section is 0 ± its prior; one that is small but known is not."""
    parameters = tuple(Parameter(name, "m", 1e-3) for name in "xyz")
    effect = SimpleNamespace(
        parameters=parameters,
        reported=(np.array([3e-4, 1e-8, 1e-17]), np.array([5e-6, 5e-6, 1e-3])),
        hypothesis=SimpleNamespace(effect=SimpleNamespace(title="a title")))
    assert [one.split()[0] for one in amounts(effect)] == ["x", "y"]


def test_the_parts_of_a_deviation_add_up(given):
    """By squares, to what the answer says; an angle in degrees is a part of the length."""
    found = prior_from_blocks(given.magnet, given.campaign.blocks)
    assert len(found.nominal) == 3 * len(given.magnet.blocks)
    for row, size in zip(prior_page.parts_table(found), (
            found.gaussian.mean - found.nominal, found.gaussian.sd), strict=True):
        _, length, *angles, together = row.values()
        assert len(angles) == 2
        parts = [float(text.split("= ")[-1].split("\u00a0")[0]) for text in (length, *angles)]
        whole = float(together.split("\u00a0")[0])
        assert np.linalg.norm(parts) == pytest.approx(whole, abs=0.01)  # of rounding
        expected = 100 * np.sqrt(np.mean(size**2) / np.mean(found.nominal**2))
        assert whole == pytest.approx(expected, abs=0.006)
        for text in angles:
            degrees, share = (float(one.split("°")[0].split("\u00a0")[0])
                              for one in text.split(" = "))
            assert share == pytest.approx(100 * np.radians(degrees), abs=0.01)


def test_paths_that_are_known_are_those_of_the_command_that_runs():
    """A page names its own folder, and its record for machines leaves it open."""
    answer = Answer("?", "", "", "", "halbach-fe shim STUDY --posterior DIR/p.h5 -o DIR")
    with known_paths({"STUDY": "a.toml", "MAP": None, "DIR": "out"}):
        assert answer.with_known_paths().command == (
            "halbach-fe shim a.toml --posterior out/p.h5 -o DIR")
        assert answer.with_known_paths(folder=False).command == (
            "halbach-fe shim a.toml --posterior DIR/p.h5 -o DIR")
    assert answer.with_known_paths() == answer  # the control: the command has ended


def test_commands_name_the_posterior_that_was_read(given):
    """It lies in the folder of the update, not in that of the command which read it."""
    still = hf.shim(given.updated, given.session, swaps=0, turns=0)
    assert still.stop == "budget"  # other blocks would fit
    of_field = hf.homogeneity(given.magnet, given.session, posterior=given.updated)
    name, known = list(of_field.by_name.items())[-1]
    even = replace(of_field, by_name={name: replace(known, rms_ppm=900.0)})
    for found in (homogeneity_page.answer(even), shimming_page.answer(still)):
        assert "DIR/posterior.h5" not in found.command
        assert "--posterior POSTERIOR" in found.command
    # the control: no tray makes up for per cents
    assert homogeneity_page.answer(of_field).command == "halbach-fe design STUDY -o DIR"
    assert f"A deviation of {1e-4 * known.rms_ppm:.2g} %" in homogeneity_page.answer(of_field).step


def test_an_update_that_conflicts_with_its_map_is_not_to_be_trusted(given, tmp_path):
    wrong = given.campaign.readings.copy(deep=True)
    wrong["B_T"][::2] *= 1.02  # which no magnet makes at every second point
    off = hf.infer(given.magnet, wrong, given.session)
    assert off.disagreement
    for name, update, sound in (("right", given.updated, True), ("wrong", off, False)):
        (folder := tmp_path / name).mkdir()
        write_inference(update, folder)
        stored = read_posterior(given.magnet, folder / "posterior.h5")
        assert stored.disagreement == update.disagreement
        found = hf.multipoles(given.magnet, given.session, posterior=stored)
        said = multipoles_page.answer(found.tables, None, found.disagreement)
        even = homogeneity_page.answer(
            hf.homogeneity(given.magnet, given.session, posterior=update))
        for one in (said, even):
            assert one.sound == sound
            assert one.trust.startswith("Yes: " if sound else "No. ")
            assert ("diagnose" in one.command) != sound
    near = of_a_conflict("?", "It is so.", f"It is nearer. {OWN_NOISE}")  # than the noise
    assert not near.sound
    assert near.command == "halbach-fe check MAP -o DIR"
    assert "agree better than the stated noise allows" in near.said
    assert "diagnose" in of_a_conflict("?", "It is so.", "It is far.").command  # the control
    unknown = hf.multipoles(given.magnet, given.session, posterior=dict(stored))
    assert "which its own page says" in multipoles_page.answer(unknown.tables, None,
                                                               unknown.disagreement).trust


def test_a_plan_of_all_candidates_says_how_many_nearly_suffice(given):
    everything = hf.plan(given.magnet, given.session)
    said = plan_page.answer(everything)
    few = int(said.said.split("the first ")[1].split(" ")[0])
    assert 0 < few < len(everything.points)
    left = np.exp(-everything.gain / len(everything.parameters))
    assert left[few - 1] <= 1.2 * left[-1] < left[few - 2]
    assert "tell more" not in said.said
    assert "plan.points" in said.step
    assert "more than" not in str(plan_page.plan_table(everything))
    six = hf.plan(given.magnet, given.session, points=6)
    assert "plan.points" not in plan_page.answer(six).step


def test_blocks_that_share_the_largest_force_are_named(given):
    """By symmetry; a force that is 1 % less is no tie."""
    found = hf.forces(given.magnet, given.session)
    size = found.in_place.magnitude
    equal = np.flatnonzero(size >= 0.999 * size.max())
    assert 1 < len(equal) < len(size)
    said = forces_page.answer(found).said
    assert f"as large on {len(equal) - 1} other" in said
    for number in equal[equal != np.argmax(size)]:
        block = found.blocks[number]
        row, = re.findall(rf"ring {block.ring}, slots? ([\d, and]+)",
                          said.split("as large")[1].split(" While ")[0])
        assert str(block.slot) in re.findall(r"\d+", row)
    vectors = found.in_place.force_N.copy()
    vectors[np.argmax(size)] *= 1.01
    alone = replace(found, in_place=replace(found.in_place, force_N=vectors))
    assert "as large on" not in forces_page.answer(alone).said
    figure = forces_page.forces_figure(found)
    numbers = {text.get_text() for text in figure.axes[0].texts}
    assert numbers == {str(slot) for slot in range(1, 9)}


def test_means_that_are_zero_but_for_the_mesh_are_zero(given):
    found = hf.tolerance(given.magnet, given.session, draws=50)
    (table,) = tolerance_page.page(found).tables.values()
    rows = {row["n"]: row["|c_n| of the mean magnet"] for row in table}
    assert rows["2"] == "0"  # forbidden by the symmetry
    assert float(rows["9"]) > 1  # which eight cubes do make


@pytest.mark.parametrize("scattered", [True, False])
def test_scattered_points_have_maps_and_no_profile(given, scattered):
    """40 points on a sphere; the control: 12 circles of 8 points, which are lines along z too."""
    turn = np.pi * (1 + 5**0.5) * (np.arange(40) + 0.5)
    height = 1 - 2 * (np.arange(40) + 0.5) / 40
    across = np.sqrt(1 - height**2)
    points = 0.03 * np.column_stack([across * np.cos(turn), across * np.sin(turn), height])
    positions = {"kind": "points", "points_m": points.tolist()} if scattered else {
        **MAGNET["observation"]["positions"], "count": 12}
    study = parse_study(changed(MAGNET, observation__positions=positions))
    update = hf.infer(build_magnet(study), simulate_campaign(study, 3).readings, given.session)
    assert diagnosis_figures.is_scattered(update) == scattered


def test_a_plan_lists_its_positions_in_mm_and_names_its_two_deviations(given, tmp_path):
    """The table has what plan.csv has; blocks and patterns are two quantities with two names."""
    found = hf.plan(given.magnet, given.session, points=6)
    write_files(plan_page.page(found), tmp_path)
    rows = plan_page.chosen_table(found)
    stored = np.genfromtxt(tmp_path / "plan.csv", delimiter=",", names=True)
    # 1 µm is the last digit of the table
    np.testing.assert_allclose([[float(row[f"{axis} in mm"]) for axis in "xyz"] for row in rows],
                               1e3 * found.points, atol=6e-4)
    np.testing.assert_allclose(1e3 * stored["x_m"], 1e3 * found.points[:, 0])
    assert "-0.000" not in str(rows)
    text = (tmp_path / "plan.html").read_text()
    assert all(f">{row['x in mm']}<" in text for row in rows)
    assert "uncertainty that remains" not in text
    assert "The stage's own" not in text
    turned = plan_page.page(replace(found, magnet=found.magnet.with_(
        instrument__position_axes=("y", "-x", "z"), instrument__length_unit_m=1e-3)))
    assert "x, y and z are y, -x, z of these, in units of 0.001 m" in str(turned.sections)
    left, of_study = (plan_page.plan_table(found)[3][key] for key in ("plan", "the study's"))
    # each is rounded to 0.1 %
    assert float(left[:-2]) / float(of_study[:-2]) == pytest.approx(found.volume_ratio, abs=3e-3)


def test_moves_that_the_answer_is_against_are_no_instructions(given, tmp_path):
    """The titles of table and picture say so, and those of worthwhile moves do not."""
    found = hf.shim(given.updated, given.session, swaps=1, turns=0)
    assert found.steps
    wrong = replace(given.updated, prior_conflict=10 * given.updated.conflict_limit)
    assert wrong.disagreement

    def that_leave(part):
        first = replace(found.before, mean=part * found.before.mean, root=part * found.before.root,
                        error=part * found.before.error)
        return replace(found, steps=(replace(found.steps[0], after=first),))

    little, worthwhile = that_leave(0.97), that_leave(0.5)
    for name, moves, result, against in (
            ("worthwhile", worthwhile, given.updated, False), ("little", little, given.updated,
                                                               True),
            ("conflict", worthwhile, wrong, True)):
        moves = replace(moves, result=result)
        write_files(shimming_page.page(moves), tmp_path / name)
        text = (tmp_path / name / "shim.html").read_text()
        assert ("Moves that would be made" in text) == against
        assert shimming_page.answer(moves).step.startswith("Make the moves") != against
    drawn = shimming_page._moves_figure(found).legends[0].texts
    assert [text.get_text() for text in drawn] == ["blocks that are exchanged"]


@pytest.mark.parametrize(("value", "sd", "shown"), [
    (-253083.2, 35.84, "-253\u202f083 ± 36"), (74090.4, 0.0, "+74\u202f090 ± 0"),
    (1263.4, 4.34, "+1\u202f263.4 ± 4.3"), (0.0, 1594.2, "0 ± 1\u202f594"),
    (0.01, 2.71, "0.0 ± 2.7"), (-3.2, 0.012, "-3.200 ± 0.012")])
def test_harmonics_and_their_errors_end_with_one_digit(value, sd, shown):
    assert homogeneity_page._ppm_with_sd(value, sd) == shown


def test_none_and_all_of_the_magnets_have_no_error_bar():
    assert share_in_words(0.0, 0.01) == "None"
    assert share_in_words(1.0, 0.01) == "All"
    assert share_in_words(0.25, 0.011) == "25.0\u00a0±\u00a01.1\u00a0%"


def test_a_boundary_that_is_too_near_is_moved_before_the_mesh_is_refined(dipole, session):
    """If the study puts it there: the usual one is far away, and what changes is the mesh."""
    for radius, moved in ((0.3, True), (None, False)):
        magnet = build_magnet(dipole(
            open_boundary={} if radius is None else {"radius_m": radius},
            array__recoil_permeability=1.05,
            noise={"regions": [{"name": "bore", "sigma_T": 1e-9}]}))
        said = verification_page.answer(hf.verify(magnet, session)).step
        assert ("open_boundary.radius_m larger (now 300 mm)" in said) == moved
        assert ("smaller mesh.block_size_m" in said) != moved


def test_shim_says_how_few_moves_suffice_and_what_is_uncertainty(given, tmp_path):
    """Without moves there is one magnet, neither before nor after anything."""
    found = hf.shim(given.updated, given.session, swaps=1, turns=0)

    def sized(part):
        return replace(found.before, mean=part * found.before.mean, root=part * found.before.root)

    def of_sizes(*parts):
        return replace(found, steps=tuple(replace(found.steps[0], after=sized(part))
                                          for part in parts))

    said = shimming_page.answer(of_sizes(0.5, 0.3, 0.28, 0.27)).said
    assert (" The first 2 make 96\u00a0% of that gain: stop after them if a move costs more than "
            "the rest is worth. What remains is mostly b_9, ") in said
    assert "The first" not in shimming_page.answer(of_sizes(0.8, 0.5)).said  # control
    assert "together" not in said
    paired = shimming_page.answer(of_sizes(0.5, 0.52, 0.53, 0.45, 0.46, 0.3)).said
    assert "Moves 2, 3 and 4 gain only together" in paired
    assert "Moves 5 and 6 gain only together" in paired
    still = replace(found, steps=(), within=None)
    assert shimming_page.answer(still).said.startswith("No move is worthwhile: of ")
    # without any move allowed, nothing is known of moves
    untried = shimming_page.answer(replace(still, tried=dict.fromkeys(still.tried, 0)))
    assert untried.said.startswith("No move was tried: the unwanted multipoles are ")
    vague = replace(still, before=replace(found.before, mean=0.1 * found.before.root[:, 0],
                                          root=found.before.root))
    assert "which is most of it" in shimming_page.answer(vague).said
    sure = replace(still, before=replace(found.before, root=1e-3 * found.before.root))
    assert "which is most of it" not in shimming_page.answer(sure).said  # the control
    write_files(shimming_page.page(sure), tmp_path / "still")
    text = (tmp_path / "still" / "shim.html").read_text()
    assert "b_n after" not in text
    assert [*shimming_page.page(sure).rows[0]] == ["n", "b_n", "a_n"]
    assert "before and after" not in text.partition("</header>")[2].partition("<details")[0]
    assert [*shimming_page.page(found).rows[0]] == ["n", "b_n before", "b_n after", "a_n before",
                                                      "a_n after"]


def test_a_plan_of_the_study_itself_is_not_compared_with_it(given):
    """And says that a map which tells little of the blocks does so."""
    every = plan_page.answer(hf.plan(given.magnet, given.session)).said
    assert "the positions of the study, and the plan only orders them" in every
    assert "as many of the study's own positions" not in every
    assert "the first 1 " not in every
    open_terms = replace(hf.plan(given.magnet, given.session),
                         magnet=given.magnet.with_(instrument_sd={"gain": 0.02}))
    assert "instrument" not in plan_page.answer(open_terms).trust  # which is in the plan
    assert "drift that [instrument_sd] leaves open is not in them" in plan_page.answer(replace(
        open_terms, magnet=given.magnet.with_(instrument_sd={"drift_T": 1e-5}))).trust
    assert "tells little of the single blocks" not in every  # the control
    noisy = build_magnet(given.study.with_(noise={"regions": [{"name": "all", "sigma_T": 1.0}]}))
    vague = plan_page.answer(hf.plan(noisy, given.session)).said
    assert "tells little of the single blocks" in vague
    assert "the first 1 " not in vague


def test_candidates_that_tell_less_than_the_study_are_no_places_to_measure(given, monkeypatch):
    """Of far candidates the page said that the study's own positions tell "hardly more", and of
    others that 48.5 % left are hardly more than 54.6 %.
    """
    far = given.magnet.with_(plan={"candidates": [{
        "kind": "line", "start_m": (0.3, 0.0, 0.0), "end_m": (0.34, 0.0, 0.0), "count": 5}]})
    said = plan_page.answer(hf.plan(far, given.session, points=3))
    assert "so that these are better places" in said.said
    assert "hardly more" not in said.said
    assert not said.sound
    assert "plan.candidates" in said.step
    found = hf.plan(given.magnet, given.session, points=3)
    near = plan_page.answer(found)  # the control
    assert near.sound
    assert "better places" not in near.said
    monkeypatch.setattr(plan_page, "_patterns", lambda _: (0.546, 0.485))
    assert re.search(r"own positions to 48\.5\s%, about as far\.", plan_page.answer(found).said)


def test_a_plan_says_that_its_readings_are_not_held_out(given):
    """The update that it advises holds some out; without such readings nothing is said."""
    trust = [plan_page.answer(hf.plan(given.magnet.with_(inference={"held_out": held_out}),
                                      given.session, points=3)).trust
             for held_out in ({"every": 4}, None)]
    assert ["inference.held_out" in each for each in trust] == [True, False]


def test_an_update_without_circles_states_its_strongest_reading(given):
    """The control has a table of multipoles, whose main one is said instead."""
    said = inference_answer.answer(given.updated).said
    strongest = 1e3 * np.abs(given.updated.prediction_posterior.mean).max()
    name, value = re.match("The strongest component of the updated field at the map's positions, "
                           r"(B[xyz]) at \([^)]+\) mm, is ([0-9.]+)\xa0±", said).groups()
    assert name == "Bx"  # a dipole along x
    assert float(value) == pytest.approx(strongest, rel=1e-3)
    model, magnets = hf.multipoles(
        given.magnet, given.session, hf.MultipoleReference(z_m=0.0), posterior=given.updated
    ).tables[0]
    assert "strongest component" not in inference_answer.answer(
        given.updated, [(model, magnets)]).said


def undulator(**axial):
    """Return two periods of blocks above and below the beam, whose polarization turns along z."""
    turn = np.pi / 2 * np.arange(8)
    rows = [(0.0, sign * 0.02, 0.01 * n - 0.035, np.cos(angle), sign * np.sin(angle))
            for sign in (-1, 1) for n, angle in enumerate(turn)]
    columns = dict(zip(("x_m", "y_m", "z_m", "remanence_y_T", "remanence_z_T"),
                       np.transpose(rows).round(12).tolist(), strict=True))
    count = len(rows)
    return hf.magnet_of_blocks(columns | {"shape": ["cuboid"] * count, "size_x_m": [0.04] * count,
        "size_y_m": [0.02] * count, "size_z_m": [0.01] * count, "remanence_x_T": [0.0] * count}
        | {name: [value] * count for name, value in axial.items()})


def test_an_undulator_is_sent_to_its_axis(tmp_path, monkeypatch):
    """Both were sent to `homogeneity`, of a field that has no mean; the command runs. Controls: a
    dipole, axial magnets with a field along z, a single block, a quadrupole (which has no field on
    its axis at all), one of whose blocks is shifted, and a region that the study names.
    """
    monkeypatch.chdir(tmp_path)
    magnet = undulator()
    hf.write_study(magnet, "study.toml")
    points = [[x, y, z] for x in (-2e-3, 2e-3) for y in (-2e-3, 2e-3)
              for z in np.linspace(-0.04, 0.04, 21)]
    noise = 1e-5 * np.random.default_rng(1).standard_normal((len(points), 3))
    found = hf.infer(magnet, points, magnet.field_T(points) + noise, sigma_T=1e-5)
    hf.write_report(found, "inferred")
    for said, measured in ((solution_page.answer(hf.solve(magnet, Session.temporary())), False),
                           (inference_answer.answer(found), True)):
        assert "an undulator has no mean field" in said.step
        words = said.command.replace("STUDY", "study.toml").replace(
            "DIR/posterior.h5", "inferred/posterior.h5").replace("DIR", f"axis-{measured}").split()
        assert main([*words[1:], "--json"]) == 0
        assert ("--posterior" in words) == measured
    regional = replace(found, magnet=magnet.with_(homogeneity={"sphere_m": 0.002}))
    assert "homogeneity STUDY" in inference_answer.answer(regional).command
    dipole = hf.halbach_ring(order=1, blocks=8, inner_radius_m=0.02, outer_radius_m=0.03,
                             length_m=0.05)
    axial = undulator(remanence_y_T=0.0, remanence_z_T=1.2)
    single = hf.magnet_of_blocks({name: [value] for name, value in {
        "shape": "cuboid", "x_m": 0.04, "y_m": 0.0, "z_m": 0.0, "size_x_m": 0.02,
        "size_y_m": 0.02, "size_z_m": 0.02, "remanence_T": 1.3}.items()})
    quadrupole = dipole.with_(array__multipole_order=2)
    shifted = quadrupole.with_(array__exceptions=[{"slot": 3, "shift_m": [0.0, 0.0, 3e-4]}])
    assert [one.cancels_along_z for one in (
        magnet, dipole, axial, single, quadrupole, shifted)] == [True] + 5 * [False]


def test_an_order_that_hardly_matters(given):
    """The one that was found is as good as the table's; the control of more gain is above."""
    magnet = build_magnet(given.study.with_(array__rings=2))
    found = hf.sort(magnet, given.campaign.blocks, given.session)
    own = found.numbered
    alike = replace(found, best=replace(own, mean=0.99 * own.mean),
                    random=own.rms_of_mean * np.linspace(1, 1.0003, len(found.random)))
    said = sorting_page.answer(alike)
    assert said.said.startswith("The order hardly matters: the sorted one is 1\u00a0% better")
    assert "in all random orders about" in said.said
    assert "or in another one that you write into blocks.sorted.csv" in said.step
    assert "To gain more, measure spare blocks" in said.step  # all that are alike are of one type
    apart = replace(alike, study=alike.study.with_(prior__types={}))
    assert "To gain more, let more slots take the same blocks" in sorting_page.answer(apart).step


def test_an_order_is_compared_with_the_table_and_with_random_ones(given):
    """The table may be sorted already, where random orders are far worse; and the other way."""
    magnet = build_magnet(given.study.with_(array__rings=2))
    found = hf.sort(magnet, given.campaign.blocks, given.session)
    own = found.numbered
    best = replace(own, mean=0.99 * own.mean)
    said = sorting_page.answer(replace(found, best=best, random=2 * found.random)).said
    assert said.startswith("The order of the table is nearly as good already.")
    random = own.rms_of_mean * np.linspace(1, 1.0003, len(found.random))
    said = sorting_page.answer(replace(
        found, best=best, numbered=replace(own, mean=2 * own.mean), random=random)).said
    assert said.startswith("A random order is nearly as good.")


def test_what_only_the_tolerances_make_is_named_beside_the_design():
    """Of order 3, as the design makes order 9; of a design that makes all there is nothing."""
    found = SimpleNamespace(
        model=SimpleNamespace(orders=(2, 3, 9)), known=SimpleNamespace(sizes=np.array([0, 1, 148])),
        quantiles=np.array([[1, 2, 147], [5, 25.9, 148], [9, 54, 149], [10, 60, 150]]))
    assert ("The largest multipole that only the tolerances make is c_3: below 25.9 units in half "
            "of the magnets, below 54 in 95 %.") in tolerance_page._made_by_tolerances(found)
    found.known.sizes = np.array([5, 25, 148])
    assert tolerance_page._made_by_tolerances(found) == ""


def test_error_bars_that_take_the_probe_as_exact_say_so(given):
    """Not if the study says how well its gain is known."""
    exact = inference_answer.answer(given.updated).trust
    assert "take the calibration of the probe as exact" in exact
    known = given.updated.magnet.with_(instrument_sd={"gain": 1e-3})
    updated = replace(given.updated, magnet=known)
    assert "as exact" not in inference_answer.answer(updated).trust
    offset = known.with_(instrument={"offset_T": (-8e-4, 0.0, 0.0)})
    assert "take its offset of 800" in inference_answer.answer(
        replace(given.updated, magnet=offset)).trust
    open_offset = offset.with_(instrument_sd={"gain": 1e-3, "offset_T": 1e-3})
    assert "as exact" not in inference_answer.answer(
        replace(given.updated, magnet=open_offset)).trust
