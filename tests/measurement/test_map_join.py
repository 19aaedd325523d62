"""Maps of one magnet that are joined without a model of it, and maps that cannot be."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import halbach_fe as hf
from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError, StudyError
from halbach_fe.core.progress import Pace
from halbach_fe.measurement import map_join
from halbach_fe.measurement.campaign_maps import refuse_shared
from halbach_fe.measurement.field_map import (
    field_map,
    points_of,
    read_map,
    readings_sha256,
    write_map,
)
from halbach_fe.measurement.map_check import InstrumentTerm, check_map, scan_of
from halbach_fe.measurement.map_join import join_checked, join_maps, read_joined
from halbach_fe.measurement.map_join_fit import TERMS, JoinedModel, Pose
from halbach_fe.measurement.probe_fit import LAG
from halbach_fe.measurement.source_free_field import Charges
from halbach_fe.report.map_check_page import joined_answer as answer
from halbach_fe.report.map_check_page import joined_sentences as sentences
from tests.support.joined_campaigns import (
    MAGNETS,
    NOISE_T,
    POINTS,
    as_checked,
    campaign,
    errors,
    over_bars,
    read,
)

QUIET = Pace(lambda _: None)


@pytest.fixture(autouse=True)
def checked_once(monkeypatch, checks):
    """Check a map once, whatever it is joined with."""
    def once(data, *told):
        key = readings_sha256(data)
        if key not in checks:
            checks[key] = check_map(data, *told)
        return checks[key]

    monkeypatch.setattr(map_join, "check_map", once)


@pytest.fixture(scope="module")
def checks():
    """What was found, by the readings."""
    return {}


def joined_of(maps):
    return join_checked(as_checked(maps), QUIET)


def test_derivatives_of_joined_readings(generator):
    """By all numbers of poses and probes, beside differences."""
    maps, _, _ = campaign(0, maps=2)
    scans = [scan_of(data)[0] for data in maps.values()]
    starts = [Pose(np.eye(3), np.zeros(3)), Pose(
        Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.001, 0.002, 0.02]))]
    charges = Charges.around(np.vstack([start.places(scan.points) for start, scan in zip(
        starts, scans, strict=True)]), 0.03)
    model = JoinedModel(charges, [scan.model(charges) for scan in scans], starts)
    rows = np.arange(len(model.points)) % 5 == 0
    at = model.perfect()
    at = replace(at, amplitudes=generator.standard_normal(len(charges)),
                 # the derivative by a turn is that at a small one, which poses start from
                 instrument=0.01 * generator.standard_normal(len(at.instrument)))
    by_parameter = model.by_parameter(at, rows)
    # of a stage that goes one way, a lag is a shift of the map, which is not asked
    unseen = [number * TERMS + LAG for number in range(len(scans) + 1)]
    for number in [*range(0, len(at.instrument), 7), *range(len(at.instrument) - 7,
                                                            len(at.instrument))]:
        if number in unseen:
            continue
        step = 1e-4 * np.eye(len(at.instrument))[number]
        there, before = (model.readings(replace(at, instrument=at.instrument + sign * step), rows)
                         for sign in (1, -1))
        difference = (there - before) / 2e-4 * model.weights[rows]
        # the turn of 0.5 mrad from which it is taken
        np.testing.assert_allclose(by_parameter[..., number], difference,
                                   atol=2e-3 * max(np.abs(difference).max(), 1e-9))


@pytest.mark.parametrize("seed", [17, 2])
def test_three_maps_lie_where_they_were_made(seed):
    """A dipole of cubes and a quadrupole; errors are as large as their bars.

    Two maps of the dipole share 36 points: with 40 as the least number for axes as stated too, the
    third one was placed upside down elsewhere, where this magnet is much like itself.
    """
    maps, poses, _ = campaign(seed)
    joined = joined_of(maps)
    # 12 numbers have an rms of 0.5 to 1.6 in 99.9 % of all draws; the benchmark has 360
    assert 0.4 < np.sqrt(np.mean(over_bars(joined, poses)**2)) < 1.6
    assert joined.agree
    assert not joined.terms
    assert all(one.determined.all() for one in joined.poses)
    assert (np.abs(errors(joined, poses)[:3]) < 3e-4).all()  # stages were 1 mm off
    assert [(one.chi2 < 1.5, one.readings > 100) for one in joined.overlaps] == [(True, True)] * 3
    assert answer(joined).sound
    assert sentences(joined) == []
    first = points_of(joined.data)[:len(points_of(maps["part0"]))]
    np.testing.assert_allclose(first, points_of(maps["part0"]))
    assert sorted(set(joined.data["scan"].values.tolist())) == list(maps)


def test_a_drift_that_one_check_found_is_no_term_of_the_join():
    """It may be a slope along the slow axis, which moves the other map. Nor is a scale of the stage
    that a check preferred to gains, without finding it. What the probe has in every map is taken
    over, the control.
    """
    maps = as_checked(campaign(2, maps=2)[0])
    terms = tuple(InstrumentTerm(name, unit, 1.0, 0.1, True, True) for name, unit in (
        ("change of the gain from start to end", "%"), ("probe turned about z", "mrad")))
    assert all(term.found for term in terms)
    # of the measured dipole's end; as a term of both maps it moved one by 0.6 mm
    scale = InstrumentTerm("scale of the stage along y", "%", 0.8, 0.65, False, True,
                           likes_sd=0.648)
    assert scale.is_chosen
    found = [replace(one, check=replace(one.check, terms=(*terms, scale))) for one in maps]
    charges = Charges.around(points_of(maps[0].data), 0.03)
    model = JoinedModel(charges, [scan_of(one.data)[0].model(charges) for one in maps],
                        [Pose(np.eye(3), np.zeros(3))] * 2)
    fitted = map_join._kept(found, model)
    assert not fitted[model.own(0)].any()
    assert not fitted[model.own(1)].any()
    assert fitted.sum() == 1 + 6  # the turn of the probe, and the pose of the second map


@pytest.mark.parametrize("found", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_scale_of_a_stage_that_the_checks_found_is_one_of_the_join(seed, found):
    """Of a stage whose z is 1 % too long poses hold, and the joined map is that of the magnet.
    Control: without the term places are off by 1 % of the shift, 43 and 12 bars.
    """
    maps, poses, magnet = campaign(seed, maps=2)
    generator, middle = np.random.default_rng(seed), (POINTS.max(axis=0) + POINTS.min(axis=0)) / 2
    were = middle + (POINTS - middle) / [1, 1, 1.01]
    long = as_checked({name: read(magnet, pose, generator, were=were)
                       for name, pose in zip(maps, poses, strict=True)})
    term = InstrumentTerm("scale of the stage along z", "%", -1.0, 0.1, True, True)
    joined = join_checked([replace(one, check=replace(one.check, terms=(term,) * found))
                           for one in long], QUIET)
    assert [one.name for one in joined.terms] == [f"{term.name}, in all maps"] * found
    assert (np.abs(over_bars(joined, poses)).max() < 4) == found
    turn, shift = poses[0][0].as_matrix(), poses[0][1]
    ideal = magnet.getB(points_of(joined.data) @ turn.T + shift) @ turn
    off = np.sqrt(np.mean((joined.data["B_T"].values - ideal)**2))
    assert (off < 1.2 * NOISE_T) == found  # 1.0 to 1.1 were measured, and 2.1 and 14 without


def test_the_joined_map_is_that_of_one_stage(generator):
    """A gain that only one map has is found, and taken out of the joined map."""
    maps, poses, magnet = campaign(1, maps=2)
    maps["part1"] = read(magnet, poses[1], generator, gain=1.01)
    maps["part1"]["sigma_T"] = 2 * NOISE_T + 0 * maps["part1"]["B_T"]
    joined = joined_of(maps)
    # a turn of equal sigmas leaves them; the other map has the noise of its check
    sigma = np.asarray(joined.data["sigma_T"].values) / NOISE_T
    np.testing.assert_allclose(sigma[:len(points_of(maps["part0"]))], 1.0)
    np.testing.assert_allclose(sigma[len(points_of(maps["part0"])):], 2.0)
    (term,) = joined.terms
    assert term.name == "gain of part1 relative to part0"
    assert abs(term.value - 1) < 4 * term.sd
    assert term.sd < 0.1
    turn, shift = poses[0]
    field = magnet.getB(points_of(joined.data) @ turn.as_matrix().T + shift) @ turn.as_matrix()
    left = np.asarray(joined.data["B_T"].values) - field
    assert np.sqrt(np.mean(left**2)) < 2 * NOISE_T  # 1 % of the field is 16 times as much
    assert np.sqrt(np.mean((np.asarray(maps["part1"]["B_T"].values)
                            - field[len(points_of(maps["part0"])):])**2)) > 10 * NOISE_T


def mirrored(data):
    """A map whose z axis counts backwards: a map too, of a mirrored magnet."""
    return field_map(points_of(data) * [1, 1, -1], np.asarray(data["B_T"].values) * [1, 1, -1])


def test_maps_that_cannot_be_joined(generator):
    """A mirrored one, and one of another magnet of the same design."""
    maps, poses, _ = campaign(0, maps=2)
    with pytest.raises(MeasurementError, match=r"mirror.*backwards"):
        joined_of(maps | {"part1": mirrored(maps["part1"])})
    foreign = read(MAGNETS[0](np.random.default_rng(5)), poses[1], generator)
    with pytest.raises(MeasurementError, match="another magnet"):
        joined_of(maps | {"part1": foreign})


def test_a_mirror_image_that_fits_may_be_of_another_magnet():
    """Of two quadrupoles of one design the mirror image may fit nearly, which is no mirrored axis.
    Control: a map of another magnet of which nothing fits is told without a mirror image that does.
    """
    one, other = (SimpleNamespace(name=name, floor_T=3e-6) for name in ("one", "other"))
    pose = Pose(np.diag([1.0, 1.0, -1.0]), np.zeros(3))
    found = map_join._Match(pose, 1, off=1.4, rms_T=6e-6, odds=100.0)
    assert found.fits
    said = str(map_join._refused(one, other, found))
    assert "mirror image fits to 6\u00a0µT rms, at a noise of 4.24\u00a0µT" in said
    assert "or they are maps of two magnets of one design" in said
    assert "reverse z" in said
    said = str(map_join._refused(one, other, replace(found, off=100.0)))
    assert "whose mirror image fits" not in said


def test_a_copy_of_a_map_is_refused(generator):
    """Its readings would count twice. Control: the same places, measured again."""
    maps, *_ = campaign(3)
    one = maps["part0"]
    with pytest.raises(MeasurementError, match=r"'one' and 'copy'.* must not count twice"):
        join_maps({"one": one, "copy": one.copy()})
    again = one["B_T"] + 2e-5 * generator.standard_normal(one["B_T"].shape)
    assert join_maps({"one": one, "again": one.assign(B_T=again)}).poses


def test_the_sign_that_no_single_map_shows():
    maps, poses, _ = campaign(1, maps=2)
    opposite = maps["part1"].assign(B_T=-maps["part1"]["B_T"])
    joined = joined_of(maps | {"part1": opposite})
    assert joined.poses[0].sign == -1
    assert (np.abs(errors(joined, poses)[:3]) < 3e-4).all()
    assert "opposite sign" in sentences(joined)[0]


def test_the_sign_is_tried_before_other_axes(generator, monkeypatch):
    """Of such a dipole many axes may be likelier at first, of which none fits; its own sign, then
    not tried, was called a map of another magnet. Here there are no other axes at all.
    """
    monkeypatch.setattr(map_join, "_axes", lambda: iter(()))
    magpylib = pytest.importorskip("magpylib")
    cubes = []
    for z in (-0.0225, 0.0225):
        for angle in 2 * np.pi * np.arange(12) / 12:
            easy = 1.3 * np.array([np.cos(2 * angle), np.sin(2 * angle), 0.0])
            cubes.append(magpylib.magnet.Cuboid(
                polarization=easy + 0.026 * generator.standard_normal(3), dimension=(0.02,) * 3,
                position=(0.06 * np.cos(angle), 0.06 * np.sin(angle), z)))
    side = np.linspace(-0.015, 0.015, 7)
    turn, middle = Rotation.from_euler("z", 0.01), np.array([0.001, -0.002, 0.06])
    maps = {}
    for name, z in (("body", np.linspace(-0.03, 0.03, 13)), ("back", np.linspace(-0.04, 0.04, 17))):
        points = np.stack(np.meshgrid(side, side, z, indexing="ij"), axis=-1).reshape(-1, 3)
        field = magpylib.getB(cubes, points, sumup=True) if name == "body" else -turn.inv().apply(
            magpylib.getB(cubes, turn.apply(points) + middle, sumup=True))
        maps[name] = field_map(points, field + 2e-5 * generator.standard_normal(points.shape))
    _, (pose, sign) = map_join._places(as_checked(maps))
    assert sign == -1
    np.testing.assert_allclose(pose.turn, turn.as_matrix(), atol=2e-3)


@pytest.mark.parametrize(("off", "sign"), [(10.0, 1), (1.0, -1)])
def test_a_sign_that_fits_roughly_does_not_end_the_search(monkeypatch, off, sign):
    """As of a quadrupole on a stage that is turned by 90 degrees, which is nearly its opposite. The
    control fits well.
    """
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()

    def matched(one, other, axes):
        if len(axes) > 1:
            return map_join._Match(Pose(turn, np.zeros(3)), 1, 1.0, 1e-5, 4000.0)
        sign = axes[0][1]
        return map_join._Match(Pose(np.eye(3), np.zeros(3)), sign, off if sign < 0 else 100.0,
                               1e-4, 3000.0)

    monkeypatch.setattr(map_join, "_match_of", matched)
    _, (_, found) = map_join._places([None, None])
    assert found == sign


def test_a_reversed_map_of_a_symmetric_magnet(generator):
    """It fitted beside the other map, face to face: two components of three agree there. That it
    is turned half round, or mirrored, is as likely as its sign, which is simpler.
    """
    magnet = hf.to_magpylib(hf.halbach_ring(blocks=8, inner_radius_m=0.04, outer_radius_m=0.056,
                                            length_m=0.012))
    axes = np.linspace(-0.01, 0.01, 4), np.linspace(-0.01, 0.01, 4), np.linspace(-0.02, 0.02, 5)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    maps = {name: field_map(points, sign * magnet.getB(points)
                            + 5e-6 * generator.standard_normal(points.shape))
            for name, sign in (("here", 1), ("back", -1))}
    (_, own), (pose, sign) = map_join._places(as_checked(maps))
    assert (own, sign) == (1, -1)
    np.testing.assert_allclose(pose.turn, np.eye(3), atol=1e-2)  # bars of a turn are 1e-3 or less
    assert np.linalg.norm(pose.shift_m) < 1e-4


def test_contradictions_are_refused_or_named(monkeypatch):
    """A sextupole that was there for one map only, and obeys Maxwell; the bars are widened."""
    maps, _, _ = campaign(0, maps=2)
    points = points_of(maps["part1"])
    x, y = points[:, 0] - 0.0075, points[:, 1] - 0.0075
    more = 2.5 * np.column_stack([x**2 - y**2, -2 * x * y, 0 * x])  # 0.1 mT, 5 times noise
    torn = field_map(points, maps["part1"]["B_T"].values + more)
    plain = joined_of(maps)
    monkeypatch.setattr(map_join, "DIFFERS", np.inf)
    joined = joined_of(maps | {"part1": torn})
    assert not joined.agree
    assert not answer(joined).sound
    assert "contradict" in answer(joined).trust
    assert "contradicts" in sentences(joined)[0]
    assert (joined.poses[0].shift_sd_m > 1.3 * plain.poses[0].shift_sd_m).all()
    monkeypatch.setattr(map_join, "DIFFERS", 1.0)
    with pytest.raises(MeasurementError, match="noise explains"):
        joined_of(maps | {"part1": torn})


def test_a_map_under_two_names():
    """Is refused as what it was given to. Control: in a study it is one of the campaign."""
    part = campaign(0, maps=2)[0]["part0"]
    with pytest.raises(MeasurementError, match="'one' and 'again' of join_maps must be different"):
        join_maps({"one": part, "again": part})
    rows = points_of(part), part["B_T"].values, 2e-5
    with pytest.raises(MeasurementError, match="'one' and 'again' of the campaign"):
        refuse_shared({"one": rows, "again": rows})


def test_positions_that_lines_have_in_common_widen_the_bars(monkeypatch):
    """A stage is off by 0.1 mm along z. Control: without the scatter of halves, by 5 bars."""
    maps, poses, _ = campaign(0, maps=2)
    points = points_of(maps["part1"])
    off = points + 1e-4 * np.sin(2 * np.pi * points[:, 2:] / 0.035) * [0, 0, 1]
    torn = maps | {"part1": field_map(off, maps["part1"]["B_T"].values)}
    assert np.abs(over_bars(joined_of(torn), poses)).max() < 4
    monkeypatch.setattr(map_join._Joined, "_beyond", lambda _, places: np.zeros(len(places)))
    assert np.abs(over_bars(joined_of(torn), poses)).max() > 4


def test_a_plane_that_the_stage_came_to_from_the_other_side(generator, monkeypatch):
    """It is named and left out; before, the join was 0.1 mm off and both maps contradicted each
    other. A scale of the stage, the control, displaces all planes and is no such one. The overlap
    has four planes, of which otherwise none is left out.
    """
    monkeypatch.setattr(map_join, "FEWEST_LAYERS", 4)
    maps, poses, magnet = campaign(0, maps=2)
    first = POINTS[:, 2] == 0
    late = read(magnet, poses[1], generator, were=POINTS + 3e-4 * first[:, None] * [0, 0, 1])
    joined = joined_of(maps | {"part1": late})
    (layer,) = joined.displaced
    assert (layer.name, layer.axis, layer.place_m, layer.points) == ("part1", "z", 0, first.sum())
    assert layer.off_m == pytest.approx(3e-4, rel=0.3)  # the field follows the rows a little
    assert np.abs(over_bars(joined, poses)).max() < 4
    assert joined.agree
    assert len(points_of(joined.data)) == 2 * len(POINTS) - first.sum()
    assert "z = 0 mm, the stage was some 0.2" in sentences(joined)[0].replace("\u00a0", " ")
    assert joined.plain()["displaced"][0]["points"] == first.sum()
    longer = read(magnet, poses[1], generator, were=POINTS * [1, 1, 1.005])
    for control in (maps, maps | {"part1": longer}):
        assert not joined_of(control).displaced


def dipole_maps(gain, late=0.0, three=False, here=(1, 1, 1), starts=(-0.04, -0.005)):
    """Maps of two rings of cubes that share 5 mm on either side of the middle plane, the last one
    with gains (3,) of its own, and its first plane ``late`` in m; of ``three`` two are alike.

    The first one has the gains ``here`` (3,); ``starts`` are where it and the others begin, in m.
    """
    generator, magnet = np.random.default_rng(12), magpylib.Collection()
    for z, angle in ((z, 2 * np.pi * slot / 8) for z in (-0.008, 0.008) for slot in range(8)):
        turn = Rotation.from_euler("z", 2 * angle) * Rotation.from_rotvec(
            np.radians(1.0) * generator.standard_normal(3))
        magnet.add(magpylib.magnet.Cuboid(
            dimension=(0.012,) * 3, position=(0.04 * np.cos(angle), 0.04 * np.sin(angle), z),
            polarization=(1.3 * (1 + 0.01 * generator.standard_normal()), 0, 0), orientation=turn))
    maps = {}
    parts = (("here", starts[0], 0.0, here, 0.0), ("beside", starts[1], 0.1, (1, 1, 1), 0.0),
             ("there", starts[1], 0.1, gain, late))
    for name, first, off, gains, step in parts if three else parts[::2]:
        angles = off + 2 * np.pi * np.arange(12) / 12
        points = np.array([[r * np.cos(a), r * np.sin(a), z] for z in first + 0.005 * np.arange(10)
                           for r in (0.01, 0.02) for a in angles])
        were = points + step * (points[:, 2:] < first + 1e-4) * [0, 0, 1]
        maps[name] = field_map(points, gains * (
            magnet.getB(were) + 2e-5 * generator.standard_normal(points.shape)))
    return maps


@pytest.mark.parametrize(("gain", "three"), [
    ((1.01, 1, 1), True), ((1.01, 1, 1), False), ((1, 1, 0.99), False),
    ((1.01, 1.01, 1.01), False)])
def test_a_gain_of_one_component_of_one_map(gain, three):
    """Of three maps its first plane seemed to be displaced, of two one seemed to be mirrored, or
    the gain to be one of all maps. Each component is as it was made; |B| is nearly Bx.
    """
    joined = join_maps(dipole_maps(gain, three=three))
    assert not joined.displaced
    assert joined.agree
    assert all(np.linalg.norm(one.shift_m) < 1e-4 for one in joined.poses)
    terms = {term.name: term for term in joined.terms}
    share = 0.967  # of Bx in the mean square of the field here
    of_size = 100 * (share * (gain[0] - 1) + (1 - share) * ((gain[1] + gain[2]) / 2 - 1))
    size = terms.get("gain of there relative to here")
    assert abs(size.value - of_size if size else of_size) < 4 * np.hypot(
        size.sd if size else 0.01, 0.005)
    for axis, own in zip("xyz", gain, strict=True):
        term = terms.get(f"gain of B{axis} relative to that of |B|, in there only")
        if term is None:
            assert len(set(gain)) == 1  # only then none differs
        else:
            assert abs(term.value - 100 * (own - 1) + of_size) < 4 * np.hypot(term.sd, 0.005)
    for axis in "xz":
        term = terms.get(f"gain of B{axis} relative to that of |B|, in all maps")
        assert term is None or abs(term.value) < 4 * term.sd


@pytest.mark.parametrize("other", [1.01, 1.0])
def test_one_gain_where_the_field_has_another_direction(other):
    """One probe in the bore and at the end: what its gain is of |B| differs, and is no gain of one
    map. The two maps of a dipole had it, and lay 0.7 mm off. Control: a gain of the other map.
    """
    maps = dipole_maps((1, 1, 1.01), here=(1, 1, other), starts=(-0.025, 0.01))
    joined = join_maps(maps)
    own = [term.name for term in joined.terms if "in there only" in term.name
           or term.name == "gain of there relative to here"]
    assert bool(own) == (other == 1.0), own
    (pose,) = joined.poses
    assert np.linalg.norm(pose.shift_m) < 1e-4


def test_a_displaced_plane_and_a_mirror_beside_a_gain():
    """Control: a plane 1 mm off is named beside a gain too, and a mirrored map is refused."""
    for gain in ((1, 1, 1), (1.01, 1, 1)):
        (layer,) = join_maps(dipole_maps(gain, late=1e-3, three=True)).displaced
        assert (layer.name, layer.axis, layer.place_m) == ("there", "z", pytest.approx(-0.005))
        assert layer.off_m == pytest.approx(1e-3, rel=0.3)
    maps, _, _ = campaign(0, maps=2)
    gained = maps["part1"].assign(B_T=maps["part1"]["B_T"] * np.array([1.01, 1, 1]))
    assert joined_of(maps | {"part1": gained}).agree
    with pytest.raises(MeasurementError, match=r"mirror.*backwards"):
        joined_of(maps | {"part1": mirrored(gained)})


def test_a_shuffled_map_is_refused(generator):
    """By its own check, and with a sentence that names it; as it was read, it is accepted."""
    maps, _, _ = campaign(0, maps=2)
    shuffled = maps["part1"].copy(deep=True)
    shuffled["B_T"].values[:] = generator.permutation(shuffled["B_T"].values)
    with pytest.raises(MeasurementError, match=r"'part1'.*obeys Maxwell's equations.*shuffled"):
        join_maps({"part1": shuffled, "part0": maps["part0"]})


def test_a_map_of_few_readings_is_not_called_shuffled():
    """No check of it would find anything: it is to be measured again, or joined by the magnet."""
    few = SimpleNamespace(is_whole=True, suffices=False)
    with pytest.raises(MeasurementError, match=r"too few readings to tell\. Measure it .*register"):
        map_join._refuse_disobedient("part0", few)


def test_check_of_several_maps(tmp_path, monkeypatch, capsys):
    """The command, from files to the page; a map that fails its own check is refused."""
    maps, _, _ = campaign(1, maps=2)
    checked = {id(one.data): one.check for one in as_checked(maps)}
    checks = iter(checked.values())
    monkeypatch.setattr(map_join, "check_map", lambda *_: next(checks))
    for name, data in maps.items():
        write_map(data, tmp_path / f"{name}.csv")
    out = tmp_path / "out"
    assert main(["check", *(str(tmp_path / f"{name}.csv") for name in maps), "-o", str(out)]) == 0
    said = " ".join("".join(capsys.readouterr()).split())
    assert "Yes: where part0 and part1 overlap" in said
    summary = json.loads((out / "joined.json").read_text())
    assert summary["frame"] == "part0"
    assert summary["agree"]
    assert np.array(summary["covariance"]).shape == (6, 6)
    (pose,) = summary["poses"]
    frame, (again,) = read_joined(out / "joined.json")
    assert (frame, again.name) == ("part0", "part1")
    np.testing.assert_allclose(again.translation_m, pose["translation_m"], atol=1e-15)
    np.testing.assert_array_equal(again.shift_sd_m, pose["shift_sd_m"])
    turn = Rotation.from_rotvec(pose["rotation_rad"]).as_matrix()
    written = read_map(out / "joined.csv")
    count = maps["part0"].sizes["point"]
    np.testing.assert_allclose(  # as the `[instrument]` of a study places a map
        points_of(written)[count:], points_of(maps["part1"]) @ turn.T + pose["translation_m"],
        atol=1e-9)
    page = (out / "joined.html").read_text()
    assert "Where they overlap" in page
    assert "<h2>Pictures</h2>" not in page  # it has none
    assert (out / "part1" / "check.json").exists()
    assert main(["check", str(tmp_path / "part0.csv"), str(tmp_path / "part0.csv")]) == 2
    assert main(["check", str(tmp_path / "part0.csv"), "--turn-rad", "0.001"]) == 2
    with pytest.raises(StudyError, match="two maps or more"):
        join_maps({"part0": maps["part0"]})
    for turn_rad in (0.0, -0.001, 2.0, np.nan, "0.001"):
        with pytest.raises(StudyError, match=r"turn_rad of join_maps must be a (finite )?number"):
            join_maps(maps, turn_rad=turn_rad)
    check = as_checked(maps)[0].check
    left_T = np.full(3, 0.03 * check.size_T)
    disobedient = replace(check, floor_T=left_T, rms_T=left_T)  # as of shuffled rows
    monkeypatch.setattr(map_join, "check_map", lambda *_: disobedient)
    with pytest.raises(MeasurementError, match=r"'part0'.*obeys Maxwell's equations"):
        join_maps(maps)


def pole_maps(generator, *grids):
    """Maps of the field of a pole, each with a floor and the spacing of its own grid."""
    found = []
    for number, (points, step, shift) in enumerate(grids):
        away = points + shift - [0.1, 0.05, 0.08]
        field = 1e-4 * away / np.linalg.norm(away, axis=1)[:, None]**3
        data = field_map(points, field + 1e-6 * generator.standard_normal(field.shape))
        (one,) = as_checked({f"part{number}": data}, 1.6e-6)
        found.append(map_join.Checked.of(one.name, replace(
            one.check, spacing_m=step, gap_m=max(2.5 * step, 0.03), noise_T=1e-6)))
    return found


def lattice(count, step, start):
    return np.stack(np.meshgrid(*3 * [step * np.arange(count)], indexing="ij"),
                    axis=-1).reshape(-1, 3) + start


@pytest.mark.parametrize("order", [1, -1])
def test_a_fine_map_between_the_points_of_a_coarse_one(generator, order):
    """The coarse one has no point in the fine one, which has all of its own in the coarse one."""
    shift = np.array([0.0, 0.0, 0.003])
    maps = pole_maps(generator, (lattice(6, 0.01, 0.0), 0.01, 0 * shift),
                     (lattice(5, 0.0018, [0.021, 0.021, 0.018]), 0.0018, shift))[::order]
    joined = join_checked(maps, QUIET)
    (pose,) = joined.poses
    assert order * pose.shift_m == pytest.approx(shift, abs=max(5 * pose.shift_sd_m.max(), 1e-6))
    # its pose has bars of 6 to 9 mm: one point of the coarse map may come into the fine one
    assert joined.overlaps[0].name == "part1"
    assert all(one.readings <= 3 for one in joined.overlaps[1:])
    json.dumps(joined.plain(), allow_nan=False)


def test_rows_whose_order_tells_nothing(generator):
    """No term of a scan is asked of them, and the joined map has all of their readings."""
    maps, poses, _ = campaign(1, maps=2)
    maps["part1"] = maps["part1"].isel(point=generator.permutation(maps["part1"].sizes["point"]))
    joined = joined_of(maps)
    assert np.abs(over_bars(joined, poses)).max() < 4  # of six numbers
    assert np.isfinite(joined.data["B_T"].values).all()


def test_too_few_points_in_common_are_said(generator):
    maps = pole_maps(generator, (lattice(2, 0.01, 0.0), 0.01, np.zeros(3)),
                     (lattice(2, 0.01, 0.0), 0.01, np.zeros(3)))
    with pytest.raises(MeasurementError, match="shares 20 points"):
        join_checked(maps, QUIET)


def coarse_maps(seed, far):
    """Two maps of 4 x 4 x 4 points of far dipoles, 20 mm apart, and where the second one stands.

    One dipole is the same from everywhere around its axis; two, the control, are not.
    """
    generator = np.random.default_rng([seed, 50])
    places = np.array([[0.1, 0.05, 0.08], [-0.1, 0.05, 0.024]])[:far]
    magnets = magpylib.Collection([magpylib.misc.Dipole(
        moment=10 * generator.standard_normal(3), position=place) for place in places])
    turn = Rotation.from_rotvec(0.01 * generator.standard_normal(3))
    shift = np.array([0, 0, 0.02]) + 1e-3 * generator.standard_normal(3)
    points, maps = lattice(4, 0.01, 0.0), []
    for name, (way, start) in {"first": (Rotation.identity(), 0 * shift),
                               "second": (turn, shift)}.items():
        field = magnets.getB(way.apply(points) + start) @ way.as_matrix()
        noise = 2e-4 * np.median(np.linalg.norm(field, axis=1))
        data = field_map(points, field + noise * generator.standard_normal(field.shape))
        (one,) = as_checked({name: data}, 1.6 * noise)
        maps.append(map_join.Checked.of(name, replace(
            one.check, spacing_m=0.01, gap_m=0.025, noise_T=noise)))
    return maps, [(Rotation.identity(), 0 * shift), (turn, shift)]


def test_a_turn_about_a_far_dipole_is_not_determined(monkeypatch):
    """What fields that readings leave open would feign is no information, and the page says so.

    Control: counted as such, it makes bars of which errors are many.
    """
    off = []
    for seed in (7, 5):  # the control is of the second
        maps, poses = coarse_maps(seed, 1)
        joined = join_checked(maps, QUIET)
        assert "does not determine the turn about" in answer(joined).trust
        off.append(errors(joined, poses) / np.sqrt(np.diag(joined.covariance)))
    assert np.abs(off).max() < 2.5  # a turn that is not determined has the bar of its prior
    monkeypatch.setattr(map_join, "FEIGNED", 0.0)
    joined = join_checked(maps, QUIET)
    assert np.abs(errors(joined, poses) / np.sqrt(np.diag(joined.covariance))).max() > 4


def test_what_is_known_of_the_turn_of_a_stage(generator):
    """It bounds the turn about a far pole, and with it the shift; the stage stood within it. The
    control, a statement that is wrong, is contradicted by the readings.
    """
    for seed in (5, 7):
        maps, poses = coarse_maps(seed, 1)
        free, known = join_checked(maps, QUIET), join_checked(maps, QUIET, 0.01)
        assert (known.poses[0].rotation_sd_rad < 0.0101).all()
        assert (known.poses[0].shift_sd_m.max() < 0.2 * free.poses[0].shift_sd_m.max())
        assert known.agree
        assert known.poses[0].determined.all()
        # Of each number by itself: four draws gave 0.9 to 2.5. Of combinations that the readings
        # determine far better, 64 readings of a far pole make errors of up to 16 bars.
        assert np.abs(errors(known, poses) / np.sqrt(np.diag(known.covariance))).max() < 3
    _, poses, magnet = campaign(0, maps=2)
    maps = {"part0": read(magnet, poses[0], generator),
            "part1": read(magnet, (poses[0][0] * Rotation.from_rotvec([0.01, 0, 0]), poses[1][1]),
                          generator)}
    assert joined_of(maps).agree
    with pytest.raises(MeasurementError, match="noise explains"):
        join_checked(as_checked(maps), QUIET, 1e-4)


def test_two_far_dipoles_determine_a_pose():
    """In coarse maps, too: errors are as large as their bars, and these are small."""
    off = []
    for seed in range(2):
        maps, poses = coarse_maps(seed, 2)
        joined = join_checked(maps, QUIET)
        assert joined.poses[0].determined.all()
        assert (joined.poses[0].shift_sd_m < 3e-4).all()
        off.append(over_bars(joined, poses))
    # 12 normal numbers have an rms of 0.5 to 1.6 in 99 % of all draws
    assert 0.4 < np.sqrt(np.mean(np.square(off))) < 1.6
