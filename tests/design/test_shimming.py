"""Moves that shim a magnet, judged by the magnet that they make: magpylib's, of the true blocks."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import halbach_fe as hf
from halbach_fe.core.errors import MeasurementError, StudyError
from halbach_fe.design.shimming import gain, shim, taken_out
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.remounting import (
    mountings,
    mounts_of,
    remounted,
    rotation_deg,
    shape_turns,
)
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.report.shimming_page import answer
from halbach_fe.report.words import faults_in_words
from halbach_fe.response.homogeneity import PPM
from halbach_fe.response.multipoles import MultipoleReference, Multipoles, multipole_model
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.magpylib_field import vacuum_field
from halbach_fe.synthetic.simulate import coil_table, draw_magnet, simulate_campaign, true_field
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import DIPOLE, changed
from tests.support.moved_blocks import moved, unturned

RADIUS, ORDERS = 0.07, (2, 3, 4, 5)
SQUARES = {
    "array__block": {"shape": "cuboid", "width_m": 0.03, "orientation": "magnetization"},
    "array__inner_radius_m": 0.105, "array__outer_radius_m": 0.135,
    "array__first_block_angle_deg": 15.0, "array__first_magnetization_angle_deg": 100.0}
BUDGET = {"swap": 4, "turn": 2, "replace": 0}
SEEDS = range(1, 21)


def study_of(**changes):
    """A cross-section of 12 blocks in vacuum, measured on a circle."""
    base = changed(
        DIPOLE, array__blocks_per_ring=12, array__recoil_permeability=1.0,
        noise={"regions": [{"name": "all", "sigma_T": 2e-5}]},
        observation__positions={"kind": "circles", "radius_m": RADIUS, "angles": 32},
        prior={"common_mode_sd": 0.005})
    return parse_study(changed(base, **changes))


@pytest.fixture(scope="module")
def session(getdp, tmp_path_factory):
    return Session(getdp, tmp_path_factory.mktemp("work"), jobs=1)


def true_multipoles(bodies, main, turn, orders=ORDERS, radius=RADIUS):
    """b_n, then a_n in units, of magpylib's field of bodies, and |C_N|, by Fourier's sum of
    B_y + i B_x in axes turned by ``turn``.
    """
    angle = 2 * np.pi * np.arange(128) / 128
    points = radius * np.column_stack([np.cos(angle + turn), np.sin(angle + turn), 0 * angle])
    x, y = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) @ vacuum_field(
        bodies, points)[:, :2].T
    field = y + 1j * x
    found = {n: np.mean(field * np.exp(-1j * (n - 1) * angle)) for n in (main, *orders)}
    relative = 1e4 * np.array([found[n] for n in orders]) / abs(found[main])
    return np.concatenate([relative.real, relative.imag]), abs(found[main])


def chi2(known, truth):
    """Mean square of the whitened difference: 1 if the covariance is right."""
    return float(np.mean(np.linalg.solve(np.linalg.cholesky(known.covariance),
                                         truth - known.mean) ** 2))


def campaign(study, seed, coil_sd=0.002):
    """The same magnet as `simulate_campaign` draws: its bodies before and after mounting, too."""
    made = simulate_campaign(study, seed, coil_sd)
    nominal = magnet_of(study)
    drawn = draw_magnet(study, nominal,
                        np.random.default_rng(np.random.SeedSequence(seed).spawn(5)[0]))
    for body, block in zip(drawn.mounted.bodies, made.truth["blocks"], strict=True):
        np.testing.assert_allclose(body.magnetization, block["magnetization_A_per_m"], atol=1e-5)
    return made, drawn


def shimmed_magnets(study, session, with_blocks, **options):
    """For every seed: what was to be expected, and the truth before and after the moves, done
    rightly and wrongly.
    """
    model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session)
    sd = np.radians(study.prior.mounting_sd_deg)
    for seed in SEEDS:
        made, drawn = campaign(study, seed)
        update = infer(build_magnet(study), made.readings, session,
                       made.blocks if with_blocks else None)
        generator = np.random.default_rng(seed)
        found = shim(update, model, generator, BUDGET, **options)

        def remount(generator=generator):
            return Rotation.from_rotvec([0.0, 0.0, sd * generator.standard_normal()])

        bodies, loose = drawn.mounted.bodies, drawn.single.bodies
        yield found, *(true_multipoles(some, 1, model.turn)[0] for some in (
            bodies, moved(bodies, loose, found, remount), unturned(bodies, loose, found)))


@pytest.mark.parametrize(("changes", "with_blocks"), [
    ({}, False), (SQUARES, False), (SQUARES | {"prior__mounting_sd_deg": 0.25}, True),
    (SQUARES | {"prior__mounting_sd_deg": 0.25}, False)],
    ids=["sectors", "squares", "squares that are mounted anew", "without a table of blocks"])
def test_the_shimmed_magnet_is_as_foretold(session, changes, with_blocks):
    """20 magnets of 8 multipoles: chi2 per number is 1 +- 0.11 (sqrt(2/160)); three of that."""
    study = study_of(**changes)
    before, after, wrong, falls, foretold = [], [], [], [], []
    for found, was, now, mistaken in shimmed_magnets(study, session, with_blocks):
        before.append(chi2(found.before, was))
        if not found.steps:
            continue
        after.append(chi2(found.after, now))
        wrong.append(chi2(found.after, mistaken))
        falls.append(was @ was - now @ now)
        mean, sd = gain(found.before, found.after)
        foretold.append(((falls[-1] - mean) / sd, np.sqrt(now @ now) / np.sqrt(was @ was)))
    assert len(after) > 10  # in some nothing is worth it
    assert np.mean(before) == pytest.approx(1, abs=0.35)
    assert np.mean(after) == pytest.approx(1, abs=0.35)
    scores, ratios = np.array(foretold).T
    # the fall is as foretold, within its sd: mean 0 +- 0.25 and rms 1 of up to 20 magnets, which
    # share nothing; four sd's, as a quadratic form has longer tails than a normal number
    assert abs(np.mean(scores)) < 4 / np.sqrt(len(scores))
    assert np.sqrt(np.mean(scores**2)) < 1.6
    assert np.median(ratios) < 0.9
    # negative control: magnetizations that keep their direction in the magnet's axes
    assert np.median(wrong) > 100


def local_multipoles(bodies, turn):
    """b_n, then a_n in units, of B_r on the circle at z = 0 in axes turned by ``turn``."""
    angle = 2 * np.pi * np.arange(64) / 64
    direction = np.column_stack([np.cos(angle + turn), np.sin(angle + turn), 0 * angle])
    radial = np.sum(vacuum_field(bodies, RADIUS * direction) * direction, axis=1)
    found = {n: 2 * np.mean(radial * (np.sin(n * angle) + 1j * np.cos(n * angle)))
             for n in (1, *ORDERS)}
    relative = 1e4 * np.array([found[n] for n in ORDERS]) / abs(found[1])
    return np.concatenate([relative.real, relative.imag])


def test_the_same_in_three_dimensions(session):
    """10 magnets of two rings, their components along z turned too: chi2 per number is 1 +- 0.16
    (80 numbers); three of that.
    """
    study = study_of(
        dimension=3, array__rings=2, array__ring_length_m=0.05, array__blocks_per_ring=8,
        prior__mounting_sd_deg=0.1, observation__positions={
            "kind": "circles", "radius_m": RADIUS, "angles": 16, "z_min_m": -0.06,
            "z_max_m": 0.06, "count": 4})
    model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS, 0.0), session)
    before, after, wrong, turned = [], [], [], 0
    for seed in SEEDS[:10]:
        made, drawn = campaign(study, seed)
        update = infer(build_magnet(study), made.readings, session, made.blocks)
        generator = np.random.default_rng(seed)
        found = shim(update, model, generator, BUDGET)
        sd, bodies, loose = np.radians(0.1), drawn.mounted.bodies, drawn.single.bodies
        before.append(chi2(found.before, local_multipoles(bodies, model.turn)))
        now = moved(bodies, loose, found, lambda generator=generator, sd=sd: Rotation.from_rotvec(
            sd * generator.standard_normal(3)))
        after.append(chi2(found.after, local_multipoles(now, model.turn)))
        turned += sum(one.turn > 0 for step in found.steps for one in step.move.placements)
        wrong.append(chi2(found.after, local_multipoles(
            unturned(bodies, loose, found), model.turn)))
        assert found.after.expected_square < found.before.expected_square
    assert turned > 0
    assert np.mean(before) == pytest.approx(1, abs=0.5)
    assert np.mean(after) == pytest.approx(1, abs=0.5)
    assert np.median(wrong) > 100


def test_a_new_mounting_undoes_the_old_one(session):
    """The blocks' own magnetizations are known as well as the coil and the map tell: for 20 magnets
    of 24 numbers the rms of error over sd is 1 +- 0.03, less sure as they share the calibration.
    """
    study = study_of(**SQUARES, prior__mounting_sd_deg=0.5)
    scores, naive = [], []
    for seed in SEEDS:
        made, drawn = campaign(study, seed)
        update = infer(build_magnet(study), made.readings, session, made.blocks)
        mean, loose, placed = taken_out(update)
        truth = np.array([body.magnetization[:2] for body in drawn.single.bodies]).ravel()
        scores += ((truth - mean) / np.linalg.norm(loose, axis=1)).tolist()
        naive += ((truth - update.posterior.mean) / update.posterior.sd).tolist()
        np.testing.assert_allclose(np.linalg.norm(placed, axis=1), update.posterior.sd)
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1, abs=0.15)
    # negative control: blocks as they stand are turned by their mounting
    assert np.sqrt(np.mean(np.square(naive))) > 1.3


def test_blocks_are_taken_out_after_two_updates_as_after_one(session):
    """The prior of the second update is the first, which knows the blocks better than their
    mounting does: their bars were 31 times as long.
    """
    study = study_of(**SQUARES, prior__mounting_sd_deg=0.5)
    data, magnet = campaign(study, 0)[0].readings, build_magnet(study)
    first, second = (data.isel(point=slice(start, None, 2)) for start in range(2))
    update = infer(magnet, second, session, prior=infer(magnet, first, session).posterior)
    (mean, loose, _), (same, other, _) = map(taken_out, (infer(magnet, data, session), update))
    sd = np.linalg.norm(loose, axis=1)
    np.testing.assert_allclose(np.linalg.norm(other, axis=1), sd, rtol=1e-6)
    np.testing.assert_allclose(same, mean, atol=1e-3 * sd.min())


OBJECT_M = (0.3, 0.06, 0.0)


@pytest.mark.parametrize("region", [None, {"sphere_m": 0.03}], ids=["multipoles", "homogeneity"])
def test_an_object_that_an_update_found_is_there_when_blocks_are_moved(session, region):
    """Of a magnet beside magpylib's dipole, whose moment is uncertain, what is to be shimmed is the
    field of both, before and after the moves. It was that of the blocks, 124 bars off (rms).
    """
    moment = np.array([300.0, 150.0, 0.0])
    study = study_of(
        dimension=3, array__rings=2, array__ring_length_m=0.05, array__blocks_per_ring=8,
        prior={"magnitude_sd": 0.01, "direction_sd_deg": 1e-3}, homogeneity=region,
        observation__positions={"kind": "circles", "radius_m": RADIUS, "angles": 16,
                                "z_min_m": -0.06, "z_max_m": 0.06, "count": 5},
        external={"dipoles": [{"position_m": OBJECT_M, "moment_A_m2": [0.0, 0.0, 0.0]}]},
        uncertain=[{"name": f"object.{axis}_A_m2", "sd": 300.0, "change": {
            f"external.dipoles[1].moment_A_m2[{number}]": 1.0}}
            for number, axis in enumerate("xyz", start=1)])
    bodies = draw_magnet(study, magnet_of(study), np.random.default_rng(1)).mounted.bodies

    def field(bodies, points):
        return vacuum_field(bodies, points) + magpylib.misc.Dipole(
            moment=moment, position=OBJECT_M).getB(points)

    points, generator = points_from(study.observation.positions), np.random.default_rng(2)
    data = field_map(points, field(bodies, points) + 2e-5 * generator.standard_normal(points.shape))
    update = infer(build_magnet(study), data, session)
    reference = None if region else MultipoleReference(RADIUS, ORDERS, 0.0)
    found = hf.shim(update, session.within("shim"), reference, swaps=2, turns=0)
    assert found.steps
    moved_bodies, model = moved(bodies, bodies, found, Rotation.identity), found.model
    if region is None:
        angle = 2 * np.pi * np.arange(64) / 64
        radial = np.column_stack([
            np.cos(angle + model.turn), np.sin(angle + model.turn), 0 * angle])
        for known, some in ((found.before, bodies), (found.after, moved_bodies)):
            shown = np.sum(field(some, RADIUS * radial) * radial, axis=1)
            true = model.units(2j / 64 * np.exp(-1j * np.outer((1, *ORDERS), angle)) @ shown)
            # of 8 numbers, which have an rms above 2 with a probability of 1e-4
            assert np.sqrt(np.mean(((known.mean - true) / known.sd)**2)) < 2
    else:
        sampling = model.homogeneity.sampling
        for known, some in zip(found.fields, (bodies, moved_bodies), strict=True):
            size = np.linalg.norm(field(some, sampling.points), axis=1)
            mean = sampling.weights @ size
            assert known.mean_T == pytest.approx(mean, abs=4 * known.mean_sd_T)
            assert known.rms_ppm == pytest.approx(PPM * np.sqrt(
                sampling.weights @ (size / mean - 1)**2), rel=0.01)
    assert found.shimmed_study.uncertain == study.uncertain


def test_gains_are_those_of_samples(generator):
    """Mean and sd of the fall of a quadratic form, by 20 000 draws: the sd to 1 %, as its tails are
    long.
    """
    size, known = 6, []
    for columns in (10, 12):
        root = generator.standard_normal((size, columns))
        known.append(Multipoles((2, 3, 4), 1.0, 0.0, 0.0, 0.0, generator.standard_normal(size),
                                root, np.zeros(size), root))
    z = generator.standard_normal((20_000, 12))
    fall = (np.sum((known[0].mean + z[:, :10] @ known[0].root.T) ** 2, axis=1)
            - np.sum((known[1].mean + z @ known[1].root.T) ** 2, axis=1))
    mean, sd = gain(*known)
    assert mean == pytest.approx(fall.mean(), abs=4 * fall.std() / np.sqrt(20_000))
    assert sd == pytest.approx(fall.std(), rel=0.03)
    # negative control: roots that share no columns
    apart = Multipoles((2, 3, 4), 1.0, 0.0, 0.0, 0.0, known[1].mean,
                       np.hstack([np.zeros((size, 12)), known[1].root]), np.zeros(size),
                       known[1].root_T)
    assert gain(known[0], apart)[1] != pytest.approx(fall.std(), rel=0.03)


@pytest.fixture(scope="module")
def one_magnet(session):
    """Study, update and model of one magnet of squares."""
    study = study_of(**SQUARES)
    made, _ = campaign(study, 3)
    return (study, infer(build_magnet(study), made.readings, session),
            multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session), made)


def test_a_limit_ends_the_search(one_magnet, generator):
    _, update, model, _ = one_magnet
    lax = shim(update, model, generator, BUDGET, limit=1e4)
    assert (lax.stop, lax.steps, lax.within) == ("target", (), (1.0, 1.0))
    free = shim(update, model, generator, BUDGET)
    middle = float(np.sqrt(free.before.sizes.max() * free.after.sizes.max()))
    met = shim(update, model, generator, BUDGET, limit=middle)
    assert met.stop == "target"
    assert met.within[0] < 0.95 <= met.within[1]
    assert len(met.steps) <= len(free.steps)
    strict = shim(update, model, generator, BUDGET, limit=1e-3)
    assert strict.stop in ("uncertainty", "budget")
    assert strict.within[1] < 0.95


def test_budgets_hold_and_more_moves_do_more(one_magnet, generator):
    _, update, model, _ = one_magnet
    left = []
    for swaps in (0, 1, 4):
        found = shim(update, model, generator, {"swap": swaps, "turn": 0, "replace": 0})
        assert len(found.steps) <= swaps
        left.append(found.after.expected_square)
    assert left[0] > left[1] > left[2]
    slots = [one.to for step in found.steps for one in step.move.placements]
    assert len(slots) == len(set(slots))


def test_the_best_swap_is_found(one_magnet, generator):
    """Of one swap, every pair and turn is tried here by hand."""
    study, update, model, _ = one_magnet
    found = shim(update, model, generator, {"swap": 1, "turn": 0, "replace": 0})
    mounts, p = mounts_of(build_magnet(study)), update.posterior.mean.reshape(-1, 2)
    best = np.inf
    for i in range(12):
        for j in range(i):
            for one in mounts.turns:
                for other in mounts.turns:
                    new, ok = p.copy(), True
                    for to, source, turn in ((i, j, one), (j, i, other)):
                        matrix = mounts.frames[to] @ turn @ mounts.frames[source].T
                        new[to] = matrix[:2, :2] @ p[source]
                        aim = model.nominal.reshape(-1, 2)[to]
                        ok &= new[to] @ aim > np.cos(0.1) * np.linalg.norm(new[to]) * (
                            np.linalg.norm(aim))
                    values = model.units(model.offset + model.matrix @ new.ravel())
                    best = min(best, float(values @ values)) if ok else best
    # the best by the mean need not be that of the largest expected gain: by the variances only
    assert float(found.after.mean @ found.after.mean) < best + np.sum(found.after.root**2)


def test_the_best_cycle_is_found(one_magnet, generator):
    """Of one cyclic exchange of three blocks, every one and every turn is tried here by hand. What
    is found is as good as the best percent of them; the control is one swap, which is worse.
    """
    study, update, model, _ = one_magnet
    found = shim(update, model, generator, {"cycle": 1})
    (step,) = found.steps
    assert step.move.kind == "cycle"
    assert len({one.to for one in step.move.placements}) == 3
    assert {one.to for one in step.move.placements} == {
        one.block for one in step.move.placements}
    assert found.tried == {"cycle": 440}  # two ways round of each three of 12 slots
    mounts, p = mounts_of(build_magnet(study)), update.posterior.mean.reshape(-1, 2)
    aim = model.nominal.reshape(-1, 2)
    there = np.empty((len(mounts.turns), 12, 12, 2))  # block b in slot s, turned
    for number, turn in enumerate(mounts.turns):
        for slot in range(12):
            matrix = mounts.frames[slot] @ turn @ mounts.frames.swapaxes(1, 2)
            there[number, slot] = np.einsum("bij,bj->bi", matrix[:, :2, :2], p)
    size = np.linalg.norm(there, axis=-1) * np.linalg.norm(aim, axis=-1)[:, None]
    fits = np.einsum("tsbi,si->tsb", there, aim) > np.cos(0.1) * size
    sums = []
    for i, j, k in permutations(range(12), 3):
        if i == min(i, j, k):
            pairs = ((j, i), (k, j), (i, k))
            for turns in product(*(np.flatnonzero(fits[:, to, block]) for to, block in pairs)):
                new = p.copy()
                for turn, (to, block) in zip(turns, pairs, strict=True):
                    new[to] = there[turn, to, block]
                values = model.units(model.offset + model.matrix @ new.ravel())
                sums.append(float(values @ values))
    assert float(found.after.mean @ found.after.mean) <= np.quantile(sums, 0.01)
    swapped = shim(update, model, generator, {"swap": 1})
    assert found.after.expected_square < swapped.after.expected_square


def test_the_shimmed_study_is_the_shimmed_magnet(one_magnet, generator):
    _, update, model, _ = one_magnet
    found = shim(update, model, generator, BUDGET)
    shimmed = found.shimmed_study
    assert shimmed is not None
    p, new = update.posterior.mean.reshape(-1, 2), update.posterior.mean.reshape(-1, 2).copy()
    for number, (source, matrix) in enumerate(mountings(build_magnet(shimmed))):
        new[number] = matrix[:2, :2] @ p[source]
    known = model.of(Gaussian(new.ravel(), np.zeros((24, 1))))
    np.testing.assert_allclose(known.mean, found.after.mean, atol=1e-6)
    # negative control: without the turns it is another magnet
    plain = parse_study(changed(shimmed.model_dump(mode="json"), array__exceptions=[
        one.model_dump(mode="json") | {"rotation_deg": (0.0, 0.0, 0.0)}
        for one in shimmed.array.exceptions]))
    for number, (source, matrix) in enumerate(mountings(build_magnet(plain))):
        new[number] = matrix[:2, :2] @ p[source]
    wrong = model.of(Gaussian(new.ravel(), np.zeros((24, 1))))
    # 36 units were seen: the same blocks, but errors of the turned ones point elsewhere
    assert np.abs(wrong.mean - found.after.mean).max() > 10


def test_moved_cubes_lie_in_their_places_as_before(one_magnet, generator):
    """Cubes that are oriented along their magnetization: what a study says of moved ones turns them
    by right angles only, so that they fit. The control turns with the places about the axis.
    """
    _, update, model, _ = one_magnet
    shimmed = shim(update, model, generator, BUDGET).shimmed_study
    assert shimmed is not None
    assert not faults_in_words(shimmed)  # it is what was advised
    moved_blocks = [block for block in build_magnet(shimmed).blocks if block.mounted_from]
    assert len(moved_blocks) >= 2
    off = []
    for block in moved_blocks:
        turned = block.shape_axes.T @ rotation_matrix(block.rotation_rad) @ block.shape_axes
        np.testing.assert_allclose(turned, turned.round(), atol=1e-9)
        source = build_magnet(shimmed).blocks[build_magnet(shimmed).number_of(*block.mounted_from)]
        about = np.radians(block.angle_deg - source.angle_deg)
        angle = np.radians(block.facing_deg - source.facing_deg) - about
        off.append(abs(np.sin(2 * angle)))
    assert max(off) > 0.1  # the control


def test_a_bad_block_is_replaced(one_magnet, session, generator):
    """One block is 10 % weak; a stock has a good one, and a bad one."""
    study, _, model, _ = one_magnet
    nominal = magnet_of(study)
    weak = list(draw_magnet(study, nominal, np.random.default_rng(4)).mounted.bodies)
    weak[5] = weak[5].with_magnetization(0.9 * weak[5].magnetization)
    points = points_from(study.observation.positions)
    made = field_map(points, vacuum_field(weak, points))
    wide = study.with_(prior__magnitude_sd=0.04)
    update = infer(build_magnet(wide), made, session)
    table, _ = coil_table(study, nominal, nominal, 1e-3, generator)
    rows = [5, 5]
    stock = replace(
        table, serial=("good", "bad"), type=("6", "6"), ring=np.zeros(2, int),
        slot=np.zeros(2, int), moment=table.moment[rows] * [[1.0], [0.8]], sigma=table.sigma[rows],
        volume=table.volume[rows], temperature=table.temperature[rows])
    found = shim(update, model, generator, {"swap": 0, "turn": 0, "replace": 1}, stock=stock)
    (step,) = found.steps
    assert found.spares[step.move.placements[0].block - 12] == "good"
    bodies = list(weak)
    for one in step.move.placements:
        bodies[one.to] = nominal.bodies[one.to]
    truth, _ = true_multipoles(bodies, 1, model.turn)
    was, _ = true_multipoles(weak, 1, model.turn)
    assert truth @ truth < 0.5 * (was @ was)
    assert chi2(found.after, truth) < 3  # of 8 numbers: 1 +- 0.5, four of that
    new = shim(update, model, generator, {"swap": 0, "turn": 0, "replace": 1})
    assert [one.move.kind for one in new.steps] == ["replace"]
    assert new.shimmed_study is None


def test_what_shapes_allow():
    """End for end; and the rotation groups of a box, a square prism and a cube."""
    assert [len(shape_turns(sides)) for sides in (None, (1, 2, 3), (1, 1, 3), (1, 1, 1))] == [
        2, 4, 8, 24]
    for turn in shape_turns((1.0, 1.0, 1.0)):
        assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_array_equal(shape_turns(None), [np.eye(3), np.diag([1.0, -1.0, -1.0])])


def test_what_fits_where():
    """A sector magnetized at 30 degrees from its radius fits its twins at +-30 degrees, turned
    for the latter; blocks of another permeability do not.
    """
    study = study_of(array__exceptions=[{"slot": 9, "recoil_permeability": 1.1}])
    mounts = mounts_of(build_magnet(study))
    fits = mounts.fits(mounts.current, mounts.current_kinds)
    angles = np.degrees(np.arctan2(mounts.designed[:, 1], mounts.designed[:, 0])).round()
    for slot in range(12):
        expected = {(0, i) for i in range(12) if (angles[i] - angles[slot]) % 360 == 0}
        expected |= {(1, i) for i in range(12) if (angles[i] + angles[slot]) % 360 == 0}
        expected = {(turn, i) for turn, i in expected if (i == 8) == (slot == 8)}
        assert set(zip(*np.nonzero(fits[:, slot]), strict=True)) == expected
    assert rotation_deg(np.diag([1.0, -1.0, -1.0])) == (180.0, 0.0, 0.0)


@pytest.mark.parametrize(("block", "position"), [
    ({"magnetization_factor": 0.9}, {}),
    ({"magnetization_factor": -1.0}, {}),
    ({"remanence_T": 1.1, "recoil_permeability": 1.1, "magnetization_gradient": 0.1}, {}),
    ({"rotation_deg": (0.0, 0.0, 90.0)}, {}),
    ({"rotation_deg": (0.0, 0.0, 3.0), "inner_corner_loss": 0.2}, {"displacement_m": (0, 1e-4, 0)}),
    ({}, {"twist_deg": 2.0})])
def test_a_moved_block_takes_its_exceptions_along(block, position):
    """What the study says of the block goes with it, how it was put in is replaced by how it is
    put in now, and what it says of the slot stays. Of several exceptions for all blocks too.
    """
    every = {"magnetization_factor": 0.98, "rotation_deg": (0.0, 0.0, 1.0)}
    study = study_of(**SQUARES, array__exceptions=[
        every, {"ring": 1, "slot": 3, **block, **position}, {"slot": 7, "twist_deg": -1.0}])
    magnet = build_magnet(study)
    mounts = mounts_of(magnet)
    moves = [(to, source, mounts.frames[to] @ mounts.frames[source].T)
             for to, source in ((2, 4), (4, 2))]
    moved = remounted(magnet, moves)
    for to, source, turn in moves:
        assert moved.blocks[to].displacement_m == magnet.blocks[to].displacement_m
        for name in ("recoil_permeability", "gradient", "corner_loss"):
            assert getattr(moved.blocks[to], name) == getattr(magnet.blocks[source], name)
        np.testing.assert_allclose(moved.blocks[to].magnetization,
                                   turn @ magnet.blocks[source].magnetization, rtol=1e-9, atol=1e-3)
    others = [number for number in range(12) if number not in (2, 4)]
    assert [moved.blocks[n] for n in others] == [magnet.blocks[n] for n in others]
    new = remounted(magnet, [], [2]).blocks[2]  # a new block in the third slot
    plain = build_magnet(study.with_(array__exceptions=[every, {"slot": 3, **position}])).blocks[2]
    assert new == plain


def test_moves_that_a_study_cannot_say():
    """A block comes to a ring of which the study says that it has a third of the strength, so that
    the block would have thrice that; the control is a half.
    """
    def after(factor):
        study = study_of(**SQUARES, dimension=3, array__rings=2, array__ring_length_m=0.02,
                         array__exceptions=[{"ring": 2, "magnetization_factor": factor}])
        mounts = mounts_of(magnet := build_magnet(study))
        return remounted(magnet, [(to, source, mounts.frames[to] @ mounts.frames[source].T)
                                  for to, source in ((2, 14), (14, 2))])

    assert after(0.5) is not None
    assert after(0.3) is None


def test_it_is_said_that_there_is_no_study(one_magnet, generator, monkeypatch):
    """Where the study cannot say the moves, it is not advised to update it after them."""
    _, update, model, _ = one_magnet
    assert "study.shimmed.toml" in answer(shim(update, model, generator, BUDGET)).command
    monkeypatch.setattr("halbach_fe.design.shimming.remounted", lambda *_: None)
    said = answer(shim(update, model, generator, BUDGET))
    assert said.step.startswith("No study.shimmed.toml is written")
    assert said.command.startswith("halbach-fe shim STUDY")


@pytest.mark.parametrize(("reference", "said"), [
    (MultipoleReference(0.2), "as the blocks' inner radius is.* 0.2. Choose a smaller one.$"),
    (MultipoleReference(1e3 * RADIUS), "Was it meant in millimetres"),
    (MultipoleReference(RADIUS, (1,)), "unwanted multipoles")])
def test_references_that_make_no_sense(session, reference, said):
    with pytest.raises(StudyError, match=said):
        multipole_model(build_magnet(study_of()), reference, session)


def test_stock_of_another_magnet(one_magnet, generator):
    _, update, model, made = one_magnet
    moves = {"swap": 0, "turn": 0, "replace": 1}
    with pytest.raises(MeasurementError, match="a block of the stock stands in no slot"):
        shim(update, model, generator, moves, stock=made.blocks)
    stock = replace(made.blocks, type=("x",) * 12, ring=np.zeros(12, int), slot=np.zeros(12, int))
    with pytest.raises(MeasurementError, match="type of block"):
        shim(update, model, generator, moves, stock=stock)


def test_a_shimmed_study_solves(session):
    """Blocks turned end for end in a magnet with permeability are the same nominal magnet: its
    matrix is that of the blocks where they are, to 1e-6 of its largest column.
    """
    study = study_of(array__recoil_permeability=1.05)
    mounts = mounts_of(build_magnet(study))
    fits = mounts.fits(mounts.current, mounts.current_kinds)
    turn, to, source = (int(numbers[0]) for numbers in np.nonzero(
        fits[1:] & ~np.eye(12, dtype=bool)))
    turns = mounts.turns[1 + turn]
    shimmed = remounted(build_magnet(study), [
        (i, j, mounts.frames[i] @ turns @ mounts.frames[j].T)
        for i, j in ((to, source), (source, to))])
    assert shimmed is not None
    assert any(one.rotation_deg != (0.0, 0.0, 0.0) for one in shimmed.array.exceptions)
    one, other = (multipole_model(some, MultipoleReference(RADIUS, ORDERS), session)
                  for some in (build_magnet(study), shimmed))
    np.testing.assert_allclose(one.nominal, other.nominal, atol=1e-6 * np.abs(one.nominal).max())
    scale = np.abs(one.matrix).max()
    np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-6 * scale)


def test_a_magnet_with_permeability(session):
    """Sectors of permeability 1.05, whose true field is magpylib's and NGSolve's: chi2 of 8
    numbers, the solver's error included, is 1 +- 0.5; four of that.
    """
    study = study_of(array__recoil_permeability=1.05, mesh__block_size_m=0.012)
    model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session)
    generator = np.random.default_rng(2)
    drawn = draw_magnet(study, magnet_of(study), generator)
    places = points_from(study.observation.positions)
    readings = true_field(drawn.mounted, places)
    update = infer(build_magnet(study),
                   field_map(places, readings + 2e-5 * generator.standard_normal(
        readings.shape)), session)
    found = shim(update, model, generator, BUDGET)
    assert found.steps
    angle = 2 * np.pi * np.arange(64) / 64
    points = RADIUS * np.column_stack([np.cos(angle + model.turn), np.sin(angle + model.turn),
                                       0 * angle])
    bodies = drawn.mounted.bodies
    results = {}
    for name, some in (("before", bodies), ("after", moved(bodies, drawn.single.bodies, found)),
                       ("wrong", unturned(bodies, drawn.single.bodies, found))):
        field = true_field(replace(drawn.mounted, bodies=tuple(some)), points)
        c, s = np.cos(model.turn), np.sin(model.turn)
        values = (c * field[:, 1] - s * field[:, 0]) + 1j * (c * field[:, 0] + s * field[:, 1])
        terms = np.array([np.mean(values * np.exp(-1j * (n - 1) * angle)) for n in (1, *ORDERS)])
        relative = 1e4 * terms[1:] / abs(terms[0])
        results[name] = np.concatenate([relative.real, relative.imag])
    for known, name in ((found.before, "before"), (found.after, "after")):
        scores = (results[name] - known.mean) / known.sd
        assert np.mean(scores**2) < 3
    assert np.sum(results["after"] ** 2) < np.sum(results["before"] ** 2)
    # negative control
    assert np.mean(((results["wrong"] - found.after.mean) / found.after.sd) ** 2) > 100


def test_what_a_diagnosis_found_is_put_right(session, generator):
    """A missing block is put in, and two that changed places are changed back."""
    nominal = magnet_of(study_of())
    places = points_from(study_of().observation.positions)

    def found(bodies, exceptions, **budget):
        study = study_of(array__exceptions=exceptions)
        readings = vacuum_field(bodies, places)
        update = infer(build_magnet(study), field_map(places, readings), session)
        model = multipole_model(build_magnet(study), MultipoleReference(RADIUS, ORDERS), session)
        return shim(update, model, generator, {"swap": 0, "turn": 0, "replace": 0} | budget)

    missing = list(nominal.bodies)
    missing[2] = missing[2].with_magnetization(np.zeros(3))
    (step,) = found(missing, [{"slot": 3, "magnetization_factor": 0.0}], replace=1).steps
    assert step.move.kind == "replace"
    assert step.move.placements[0].to == 2
    swapped = list(nominal.bodies)
    for here, there in ((2, 4), (4, 2)):
        turn = Rotation.from_euler("z", nominal.bodies[here].angle - nominal.bodies[there].angle)
        swapped[here] = swapped[here].with_magnetization(
            turn.apply(nominal.bodies[there].magnetization))
    exceptions = [{"slot": 3, "mounted_from": [1, 5]}, {"slot": 5, "mounted_from": [1, 3]}]
    result = found(swapped, exceptions, swap=1)
    (step,) = result.steps
    assert {(one.to, one.block) for one in step.move.placements} == {(2, 4), (4, 2)}
    assert np.abs(result.before.mean).max() > 1000
    assert np.abs(result.after.mean).max() < 10  # of thousands; the prior draws a little
    shimmed = result.shimmed_study
    assert "made for another place" in faults_in_words(result.study)
    assert not faults_in_words(shimmed)
    assert [source for source, _ in mountings(build_magnet(shimmed))] == list(range(12))
    # negative control: what is nominal as it stands is left alone
    assert not found(nominal.bodies, [], swap=4, turn=4, replace=4).steps
