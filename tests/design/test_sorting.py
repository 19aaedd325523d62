"""Measured blocks sorted into slots, judged by magpylib's field of the true blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import halbach_fe as hf
from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError
from halbach_fe.design.sorting import sort_blocks
from halbach_fe.geometry.blocks import rotation_about_z
from halbach_fe.geometry.magnet import build_magnet, neighbour_blocks
from halbach_fe.inference.block_prior import as_mounted, prior_from_blocks, types_of
from halbach_fe.magnets import halbach_ring
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.report.sorting_page import answer
from halbach_fe.response.multipoles import MultipoleReference, multipole_model
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.session import Session
from halbach_fe.synthetic.simulate import coil_table, draw_magnet
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.design.test_shimming import ORDERS, RADIUS, SQUARES, chi2, study_of, true_multipoles

CUBES = SQUARES | {"prior": {"types": {"a": list(range(1, 13))}, "common_mode_sd": 0.005}}
COIL_SD = 0.002


@pytest.fixture(scope="module")
def session(getdp, tmp_path_factory):
    return Session(getdp, tmp_path_factory.mktemp("work"), jobs=1)


def blocks(study, seed, spare=0):
    """True bodies of a magnet and some spare ones of the same slots, and what a coil says of them
    in a shuffled table without places.
    """
    nominal = magnet_of(study)
    generator = np.random.default_rng(seed)
    count = len(nominal.bodies)
    bodies, tables, moments = [], [], []
    for _ in range(1 + bool(spare)):
        single = draw_magnet(study, nominal, generator).single
        bodies += single.bodies
        tables.append(coil_table(study, nominal, single, COIL_SD, generator)[0])
        # a block without a place is measured as in the first slot of its type
        moments.append(as_mounted(build_magnet(study), tables[-1], np.array([
            types_of(build_magnet(study))[label][0] for label in tables[-1].type])))
    rows = np.arange(count + spare)
    sigma, volume, temperature = (
        np.concatenate([getattr(one, name) for one in tables])[rows]
        for name in ("sigma", "volume", "temperature"))
    return bodies, BlockTable(
        tuple(f"S{row:03d}" for row in rows), tuple((tables[0].type * 2)[row] for row in rows),
        np.zeros(len(rows), int), np.zeros(len(rows), int), np.vstack(moments)[rows], sigma, volume,
        temperature)


def part(table, count):
    """The first rows of a table."""
    return replace(table, **{name: getattr(table, name)[:count] for name in (
        "serial", "type", "ring", "slot", "moment", "sigma", "volume", "temperature")})


def assembled(study, bodies, table):
    """The true magnet of a table with places: every body carried to its slot by hand."""
    nominal = magnet_of(study)
    result = []
    for row, (ring, slot) in enumerate(table.places):
        if ring:
            where, body = nominal.bodies[slot - 1], bodies[row]
            facing = where.angle + getattr(where.shape, "turn", 0.0)
            result.append(replace(body, slot=slot, ring=ring, centre=where.centre,
                                  angle=facing - getattr(body.shape, "turn", 0.0)))
    return result


@pytest.fixture
def few_starts(monkeypatch):
    """Search from 8 random orders in place of 20: what is found is hardly worse."""
    monkeypatch.setattr("halbach_fe.design.sorting.STARTS", 8)


@pytest.mark.usefixtures("few_starts")
def test_sorted_blocks_beat_random_ones(session):
    """Of 20 sets of cubes: sorted, the true multipoles are below those of nearly all random orders,
    and as foretold: chi2 per number is 1 +- 0.11 (160 numbers), three of that.
    """
    study = study_of(**CUBES)
    model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session)
    scores, ratios = [], []
    for seed in range(20):
        bodies, table = blocks(study, seed)
        found = sort_blocks(build_magnet(study), table, model, np.random.default_rng(seed))
        assert sorted(found.table.slot.tolist()) == list(range(1, 13))
        truth, _ = true_multipoles(assembled(study, bodies, found.table), 1, model.turn)
        scores.append(chi2(found.best, truth))
        generator, others = np.random.default_rng(seed), []
        for _ in range(5):
            shuffled = replace(found.table, slot=generator.permutation(12) + 1)
            values, _ = true_multipoles(assembled(study, bodies, shuffled), 1, model.turn)
            others.append(np.sqrt(values @ values))
        ratios.append(np.sqrt(truth @ truth) / np.array(others))
    assert np.mean(scores) == pytest.approx(1, abs=0.35)
    assert np.median(ratios) < 0.3
    assert np.mean(np.array(ratios) < 1) > 0.97  # of 100


@pytest.mark.usefixtures("few_starts")
def test_random_orders_are_as_they_are(session):
    """Negative control: another set's moments sort no better than chance, and what is foretold of
    the own order is true.
    """
    study = study_of(**CUBES)
    model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session)
    wrong, foretold, random = [], [], []
    for seed in range(10):
        _, table = blocks(study, seed)
        others, _ = blocks(study, seed + 50)
        found = sort_blocks(build_magnet(study), table, model, np.random.default_rng(seed))
        truth, _ = true_multipoles(assembled(study, others, found.table), 1, model.turn)
        wrong.append(np.sqrt(np.sum(truth**2) / len(ORDERS)))
        foretold.append(np.sqrt(np.mean(found.best.sizes**2)))
        random.append(np.median(found.random))
    assert np.mean(wrong) == pytest.approx(np.mean(random), rel=0.3)
    assert np.mean(wrong) > 3 * np.mean(foretold)


def test_spare_blocks_help(session):
    study = study_of(**CUBES)
    model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session)
    bodies, table = blocks(study, 3, spare=6)
    found = sort_blocks(build_magnet(study), table, model, np.random.default_rng(1))
    assert found.left_over == 6
    without = sort_blocks(build_magnet(study), part(table, 12), model, np.random.default_rng(1))
    assert np.sum(found.best.mean**2) < np.sum(without.best.mean**2)
    truth, _ = true_multipoles(assembled(study, bodies, found.table), 1, model.turn)
    assert chi2(found.best, truth) < 3  # of 8 numbers: 1 +- 0.5, four of that


def test_sorted_tables_are_priors(session):
    """What `infer --blocks` makes of the sorted table is what `sort` foretells."""
    study = study_of(**CUBES)
    model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session)
    _, table = blocks(study, 5)
    found = sort_blocks(build_magnet(study), table, model, np.random.default_rng(5))
    prior = prior_from_blocks(build_magnet(study), found.table).gaussian
    known = model.of(prior)
    np.testing.assert_allclose(known.mean, found.best.mean, atol=1e-6)
    np.testing.assert_allclose(known.sd, found.best.sd, rtol=1e-6)
    again = sort_blocks(build_magnet(study), found.table, model, np.random.default_rng(6))
    assert again.own_order == "as placed in the table"
    np.testing.assert_allclose(again.numbered.mean, found.best.mean, atol=1e-6)
    # negative control: moments that are not turned into the slots' own axes
    with pytest.raises(MeasurementError, match="moment of block"):
        prior_from_blocks(build_magnet(study), replace(found.table, moment=table.moment))


def test_types_stay_in_their_slots(session):
    """Opposite blocks of a dipole are magnetized in opposite directions from their own axes; and a
    type needs a block for each of its slots.
    """
    study = study_of(prior__types={str(slot): [slot, slot + 6] for slot in range(1, 7)})
    model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session)
    _, table = blocks(study_of(), 3)
    table = replace(table, type=tuple(str((int(name) - 1) % 6 + 1) for name in table.type))
    with pytest.raises(StudyError, match="alike"):
        sort_blocks(build_magnet(study), table, model, np.random.default_rng(1))
    with pytest.raises(MeasurementError, match="enough for the 1 slots"):
        sort_blocks(build_magnet(study_of()), part(blocks(study_of(), 3)[1], 11), model,
                    np.random.default_rng(1))


@pytest.mark.usefixtures("few_starts")
@pytest.mark.parametrize("placed", [True, False])
def test_the_advice_of_types_can_be_followed(session, placed):
    """The table of a coil names the slot of each block as its type; that was refused afterwards."""
    study = study_of(**SQUARES)
    magnet = build_magnet(study)
    model = multipole_model(magnet, MultipoleReference(RADIUS, ORDERS), session)
    nominal = magnet_of(study)
    table, _ = coil_table(study, nominal, nominal, COIL_SD, np.random.default_rng(0))
    assert len(set(table.type)) == len(table)
    none = np.zeros(len(table), int)
    with pytest.warns(HalbachWarning, match=r"type_1 = \[1, 2, \.\.\., 12\]\)") as said:
        found = sort_blocks(magnet, table if placed else replace(table, ring=none, slot=none),
                            model, np.random.default_rng(0))
    advised = study.with_(prior__types=found.alike)
    if not placed:  # only the one who measured them can tell how they were mounted
        assert "column type of the table, with moments as mounted in the first" in str(said[0])
        moment = as_mounted(magnet, table, none)
        table = replace(table, type=("type_1",) * len(table), ring=none, slot=none, moment=moment)
    assert sort_blocks(build_magnet(advised), table, model, np.random.default_rng(0)).has_choice
    if placed:
        with pytest.raises(MeasurementError, match=r"one of the study's: type_1; instead .*'2'"):
            sort_blocks(build_magnet(advised), replace(table, type=("2", *table.type[1:])), model,
                        np.random.default_rng(0))


@pytest.mark.usefixtures("few_starts")
def test_a_table_of_other_blocks_is_not_sorted_with_a_yes(session):
    """All moments 30 % larger than the blocks'; control: the same order without that doubt."""
    study = study_of(**CUBES)
    magnet = build_magnet(study)
    model = multipole_model(magnet, MultipoleReference(RADIUS, ORDERS), session)
    _, table = blocks(study, 8)
    with pytest.warns(HalbachWarning, match=r"\d\d % stronger"):
        found = sort_blocks(magnet, replace(table, moment=1.3 * table.moment), model,
                            np.random.default_rng(1))
    said = answer(found)
    assert (said.trust[:8], said.sound) == ("Not yet.", False)
    assert "Assemble" not in said.step
    assert answer(replace(found, doubts=())).sound


def test_the_seed_decides(session):
    study = study_of(**CUBES)
    model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session)
    _, table = blocks(study, 8)
    one, same, other = (sort_blocks(build_magnet(study), table, model, np.random.default_rng(seed))
                        for seed in (1, 1, 2))
    assert one.table.places == same.table.places
    np.testing.assert_array_equal(one.random, same.random)
    assert (one.random != other.random).any()


@pytest.mark.parametrize("region", [None, {"sphere_m": 0.01}])
def test_sorted_magnets_have_the_bars_of_neighbours_blocks(region):
    """Strengths of single blocks change the field by as much of each block's. The bars were those
    of the magnet's own blocks alone, which were measured to 1e-5.
    """
    strength_sd = 0.02
    magnet = halbach_ring(
        blocks=8, inner_radius_m=0.03, outer_radius_m=0.05, length_m=0.04, remanence_T=1.2).with_(
            external={"neighbours": [{"z_m": 0.06}, {"z_m": -0.07}]}, homogeneity=region,
            prior={"magnitude_sd": strength_sd, "direction_sd_deg": 1e-9})
    size = magnet.blocks[0].volume * 1.2 / (4e-7 * np.pi)
    rows = np.arange(8)
    moment = np.array([rotation_about_z(-np.radians(block.angle_deg)) @ block.easy_axis
                       for block in magnet.blocks]) * size
    table = BlockTable(tuple(f"S{row}" for row in rows), ("",) * 8, np.ones(8, int), rows + 1,
                       moment, np.full(8, 1e-5 * size), np.full(8, np.nan), np.full(8, np.nan))
    reference = None if region else MultipoleReference(0.001, (2, 3), 0.0)
    with pytest.warns(HalbachWarning, match="nothing to sort"):
        found = hf.sort(magnet, table, Session.temporary(), reference)
    middle = np.zeros((1, 3))
    along = magnet.field_T(middle)[0] / np.linalg.norm(magnet.field_T(middle)[0])
    others = neighbour_blocks(magnet.blocks, magnet.external.neighbours)
    expected = strength_sd * np.linalg.norm(
        [along @ field_of([block], middle)[0] for block in others])
    bars = [found.best.main_sd, found.numbered.main_sd]
    if region:  # whose mean is the field in the middle, by some hundred draws
        np.testing.assert_allclose([one.mean_sd_T for one in found.fields], expected, rtol=0.2)
    np.testing.assert_allclose(bars, expected, rtol=0.01)  # of a sphere or circle, not its middle
