"""Diagnosed amplitudes stay uncertain in the study, and are estimated with the blocks."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.api import shim
from halbach_fe.core.errors import MeasurementError, StudyError
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis, MagnetizationEffect, Place
from halbach_fe.diagnosis.result import IdentifiedEffect
from halbach_fe.diagnosis.summary import STUDY_FILE
from halbach_fe.diagnosis.uncertain_effects import can_be_uncertain, with_uncertain_effects
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.posterior_files import read_posterior, write_inference
from halbach_fe.measurement.field_map import field_map
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.report.inference_answer import answer as inference_answer
from halbach_fe.report.inference_page import STUDY_FILE as UPDATED
from halbach_fe.response.block_variation import shared_deviations
from halbach_fe.response.magnetic_axis import magnetic_axis
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.inference_keys import number_changes, shifted
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study, read_study
from tests.conftest import ROOT, circle
from tests.diagnosis.campaign import drawn, field, table_of
from tests.support.cuboids import DOCUMENT, NOISE_T
from tests.support.pages import write_result

QUADRUPOLE = {"multipole_order": 2, "rings": 4, "ring_length_m": 0.045}
SHORT = {"rings": 2, "ring_length_m": 0.08, "inner_radius_m": 0.09, "block": {
    "shape": "cuboid", "width_m": 0.035}}
PRECISE = 0.003
"""Tolerance of the blocks of a magnet with a twisted ring, whose blocks imitate a twist."""

MAGNETS = {"dipole": {}, "quadrupole": QUADRUPOLE}
POINTS = np.vstack([circle(radius, 12, z, 0.1) for radius in (0.03, 0.06)
                    for z in np.linspace(-0.15, 0.15, 9)])
TILT_RAD, TWIST_RAD, MORE_T = 3e-3, 0.02, 0.03


def twisted(study, polarizations, angle_rad):
    """B (n, 3) in T at `POINTS`, and the polarizations, with the first ring turned about z."""
    turn = Rotation.from_rotvec([0.0, 0.0, angle_rad])
    first = np.array([block.ring == 1 for block in build_magnet(study).blocks])[:, None]
    own = polarizations * first
    true = field(study, polarizations - own, POINTS) + turn.apply(
        field(study, own, turn.inv().apply(POINTS)))
    return true, np.where(first, turn.apply(polarizations), polarizations)


def update(study, shown, polarizations, session, blocks=None):
    """Chi-squared per parameter of all blocks against the truth, and the result."""
    magnet = build_magnet(study)
    result = infer(magnet, shown, session, blocks)
    count = len(magnet.parameter_names)
    off = polarizations.ravel() / MU_0 - result.posterior.mean[:count]
    covariance = result.posterior.covariance[:count, :count]
    return float(off @ np.linalg.solve(covariance, off)) / count, result


def check_axis(result, true_study, polarizations, session):
    """Compare roll, and centre or slope, with those of the true magnetizations, by their bars."""
    size = polarizations.size
    true = magnetic_axis(build_magnet(true_study), session.within("true"), Gaussian(
        polarizations.ravel() / MU_0, np.zeros((size, 1))))
    found = magnetic_axis(result.magnet, session.within("found"), result.posterior)
    off = []
    # the roll is that from the nominal field, which must be one: that of an object 27 mm away from
    # where it is turns the nominal field by 0.08 mrad, four error bars
    if all(getattr(true_study, key) == getattr(result.study, key) for key in ("array", "external")):
        off.append((found.roll_rad - true.roll_rad) / found.roll_sd_rad)
    off += list((np.array(found.centre_m) - true.centre_m) / found.centre_sd_m)
    if found.slope_rad:
        off += list((np.array(found.slope_rad) - true.slope_rad) / found.slope_sd_rad)
    assert np.abs(off).max() < 3.5  # 0.3 % of six normal numbers


@pytest.mark.parametrize("magnet", ["dipole", "quadrupole"])
def test_the_update_after_a_diagnosis_is_no_surer_than_it_may_be(
        magnet, session, tmp_path, generator):
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | MAGNETS[magnet]})
    polarizations = drawn(study, generator)
    turn = Rotation.from_rotvec([TILT_RAD, 0.0, 0.0])
    true = turn.inv().apply(field(study, polarizations, turn.apply(POINTS)))
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    effects = [effect for effect in catalogue()
               if effect.name in ("mapper_tilt_x", "gain_x", "offset_z")]
    found = diagnose(study, shown, session.within("diagnosis"), effects=effects)
    (tilt,) = found.identified
    assert tilt.hypothesis.effect.name == "mapper_tilt_x"
    write_result(found, tmp_path)
    again = read_study(tmp_path / STUDY_FILE)
    assert again == found.study  # the file says the same
    chi2, result = update(again, shown, polarizations, session.within("update"))
    exact, _ = update(again.with_(uncertain=()), shown, polarizations, session.within("exact"))
    least = 4 * np.sqrt(2 / polarizations.size)  # four standard deviations of chi-squared
    assert abs(chi2 - 1) < least
    assert exact > 1 + least  # the control: the amplitude as an exact number
    check_axis(result, study, polarizations, session)
    # its prior, and not what these readings say of it, is in the study: they are used again
    (sd,) = result.amplitudes.sd
    assert sd == pytest.approx(tilt.sd[0], rel=0.05)  # 2 % are the wide prior's, about another mean
    assert result.amplitudes.prior_sd[0] > 3 * sd
    assert abs(tilt.values[0] + result.amplitudes.change[0] - TILT_RAD) < 3.5 * sd


def test_what_the_map_does_not_tell_apart_is_estimated_together(session, tmp_path):
    """Blocks with another inner radius, or farther out: whichever is the first name."""
    generator = np.random.default_rng(1)  # other noise tells them apart
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | SHORT})
    polarizations = drawn(study, generator)
    wider = study.with_(array__inner_radius_m=study.array.inner_radius_m + 6e-4)
    shown = field_map(POINTS, field(wider, polarizations, POINTS)
                      + NOISE_T * generator.standard_normal(POINTS.shape))
    effects = [one for one in catalogue() if one.name in ("radial_gap", "inner_radius")]
    found = diagnose(study, shown, session.within("diagnosis"), effects=effects)
    (named,) = found.identified
    (rival,) = named.rivals
    assert {named.name, rival.name} == {"radial_gap", "inner_radius"}
    assert found.study == with_uncertain_effects(study, [named])
    write_result(found, tmp_path)
    assert read_study(tmp_path / STUDY_FILE) == found.study
    assert "the others with uncertain amplitudes about 0" in answer(found).step
    assert answer(found).trust.startswith("Only in part")
    least = 4 * np.sqrt(2 / polarizations.size)
    for one, other in ((named, rival), (rival, named)):
        both = with_uncertain_effects(study, [replace(one, rivals=(other,))])
        chi2, result = update(both, shown, polarizations, session.within(one.name))
        assert chi2 < 1 + least
        change = dict(zip(result.amplitudes.names, result.amplitudes.change, strict=True))
        assert len(change) == 2
    first = both.with_(uncertain=both.uncertain[:1])  # the control: the wrong name alone
    assert one.name == "radial_gap"
    assert update(first, shown, polarizations, session.within("first"))[0] > 10


def test_what_blocks_imitate_is_estimated_with_them(session):
    """A gain of 1 % is one of all remanences in a map of By alone, and none in one of all axes."""
    generator, noise_T, points = np.random.default_rng(2), NOISE_T / 10, POINTS[::3]
    effects = [one for one in catalogue() if one.name in ("gain_y", "offset_y")]
    noise = {"regions": [{"name": "all", "sigma_T": noise_T}]}
    document = DOCUMENT | {"array": DOCUMENT["array"] | SHORT, "noise": noise}
    for components, gain in ((["y"], 0.01), (["x", "y", "z"], 0.0)):
        study = parse_study(document | {
            "observation": DOCUMENT["observation"] | {"components": components}})
        polarizations = drawn(study, generator, 0.001)
        table = table_of(study, polarizations, generator, 2e-4)
        true = field(study, polarizations, points) * [1.0, 1 + gain, 1.0]
        shown = field_map(points, true + noise_T * generator.standard_normal(true.shape))
        found = diagnose(study, shown, session.within("diagnosis"), table, effects)
        said = answer(found)
        assert not found.identified
        assert said.trust.startswith("Yes")
        chi2, _ = update(found.study, shown, polarizations, session.within("update"), table)
        assert abs(chi2 - 1) < 4 * np.sqrt(2 / polarizations.size)
        assert (STUDY_FILE in said.command) is bool(gain)
        if gain:
            assert "sensitivity of the By sensor" in said.trust
            assert found.imitated.probability < 0.1  # that before the map: no reading shows it
            exact, _ = update(study, shown, polarizations, session.within("exact"), table)
            assert exact > 10  # the control: the study as it was
        else:
            assert found.imitated is None


def test_a_ring_that_moves_with_its_blocks_is_imitated_too(session):
    """Blocks whose magnetizations turn imitate a twisted ring by turning the other way."""
    generator = np.random.default_rng(3)
    effects = [one for one in catalogue() if one.name in ("ring_twisted", "offset_z")]
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | QUADRUPOLE})
    true, polarizations = twisted(study, drawn(study, generator), 3e-3)
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    found = diagnose(study, shown, session.within("diagnosis"), effects=effects)
    assert not found.identified
    assert "ring_twisted" in found.imitated.effects
    assert "offset_z" not in found.imitated.effects  # the readings show that there is none
    chi2, _ = update(found.study, shown, polarizations, session.within("update"))
    exact, _ = update(study, shown, polarizations, session.within("exact"))
    assert abs(chi2 - 1) < 4 * np.sqrt(2 / polarizations.size)
    assert exact > 10  # the control: the study as it was


def test_rotations_that_are_rounded_stay_uncertain(generator):
    """Those of a mapper follow each other: an angle of 0 beside another changes the last digit."""
    study = parse_study(DOCUMENT)
    tilt, roll = (next(one for one in catalogue() if one.name == name)
                  for name in ("mapper_tilt_x", "mapper_roll"))
    for angle in generator.uniform(2e-3, 4e-3, 20).tolist():
        one, other = (IdentifiedEffect(Hypothesis(effect, Place()), np.array([value]), np.ones(1),
                                       None) for effect, value in ((tilt, angle), (roll, 1e-3)))
        names = [each.name for each in with_uncertain_effects(study, [one], [other]).uncertain]
        assert names == ["mapper_tilt_x.angle_rad", "mapper_roll.angle_rad"]


def test_only_what_changes_nothing_is_put_beside_a_named_effect():
    """Amplitudes of 0, and all parts of an effect. That a block is missing is no number, and a
    memory over other rows would change that of the named one.
    """
    study = parse_study(DOCUMENT)
    by_name = {one.name: one for one in catalogue()}

    def found(name, values, place=None, rivals=()):
        values = np.array(values)
        return IdentifiedEffect(Hypothesis(by_name[name], place or Place()), values,
                                np.abs(values), None, rivals)

    slow = by_name["slow_readings"].places(study)
    gap = found("ring_gap", [2e-4, 0.0], Place(1), (
        found("block_missing", [1.0], Place(1, 1)), found("ring_gap", [3e-4, 0.0], Place(2)),
        found("slow_readings", [2e-3], slow[1]), found("gain_z", [0.1])))
    names = {one.name: one.sd for one in with_uncertain_effects(study, [gap]).uncertain}
    assert names == {
        "ring_gap r01.gap_m": 2e-4, "ring_gap r01.shift_m": 1e-4,  # 0 in its likeliest part
        "ring_gap r02.gap_m": 2e-4, "ring_gap r02.shift_m": 1e-4, "gain_z.gain": 0.015}  # wide
    moved = with_uncertain_effects(study, [gap]).array.exceptions
    apart = [sum(one.shift_m[2] for one in moved if one.ring == ring) for ring in (1, 2, 3)]
    assert np.ptp(apart) == pytest.approx(2e-4)  # the named gap alone


def test_amplitudes_of_a_magnet_are_estimated_with_its_blocks(session, generator):
    """A ring is twisted by one standard deviation, and all remanences are larger by one."""
    twist = {"ring": 1, "twist_deg": 0.0}
    study = parse_study(DOCUMENT | {
        "array": DOCUMENT["array"] | SHORT | {"exceptions": [twist]},
        "prior": {"magnitude_sd": PRECISE, "direction_sd_deg": np.degrees(PRECISE)},
        "uncertain": [
            {"name": "twist_rad", "sd": TWIST_RAD,
             "change": {"array.exceptions[1].twist_deg": float(np.degrees(1.0))}},
            {"name": "remanence_T", "sd": MORE_T, "change": {"array.remanence_T": 1.0}}]})
    blocks = build_magnet(study).blocks
    drawn_T = np.array([block.easy_axis for block in blocks]) * (blocks[0].remanence + MORE_T)
    drawn_T += PRECISE * blocks[0].remanence * generator.standard_normal(drawn_T.shape)
    true, drawn_T = twisted(study, drawn_T, TWIST_RAD)
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    chi2, result = update(study, shown, drawn_T, session.within("update"))
    exact, _ = update(study.with_(uncertain=()), shown, drawn_T, session.within("exact"))
    least = 4 * np.sqrt(2 / drawn_T.size)
    assert abs(chi2 - 1) < least
    assert exact > 1 + least
    found = result.amplitudes
    assert found.names == ("twist_rad", "remanence_T")
    assert (np.abs(found.change - [TWIST_RAD, MORE_T]) < 3.5 * found.sd).all()
    assert (found.sd < 0.3 * found.prior_sd).all()
    # what the file of the posterior holds serves other commands, with the twist in it
    as_it_is = study.with_(uncertain=(), array__exceptions=[
        twist | {"twist_deg": float(np.degrees(TWIST_RAD))}])
    check_axis(result, as_it_is, drawn_T, session)
    write_inference(result, session.folder)
    stored = read_posterior(result.magnet, session.folder / "posterior.h5")["posterior"]
    np.testing.assert_allclose(stored.covariance, result.posterior.covariance, rtol=1e-9)
    alone = result.of_blocks  # for what moves blocks
    assert alone.posterior.covariance == pytest.approx(
        result.posterior.covariance[:drawn_T.size, :drawn_T.size], rel=1e-9)
    assert shim(result, session.within("shim"), swaps=1, turns=0).before.orders
    with pytest.raises(MeasurementError, match="uncertain"):
        read_posterior(build_magnet(study.with_(uncertain=())), session.folder / "posterior.h5")


def test_an_update_of_the_study_as_found_comes_to_rest(session, tmp_path, generator):
    """A block is 3 mm farther in, of which the readings are no linear function: the first update,
    the control, is off by more than its bars, does not say Yes and writes the study as found.
    """
    place, moved_m = {"ring": 1, "slot": 3, "displacement_m": [0.0, 0.0, 0.0]}, -3e-3
    study = parse_study(DOCUMENT | {
        "array": DOCUMENT["array"] | SHORT | {"exceptions": [place]},
        "uncertain": [{"name": "out_m", "sd": 4e-3,
                       "change": {"array.exceptions[1].displacement_m[1]": 1.0}}]})
    blocks, polarizations = build_magnet(study).blocks, drawn(study, generator)
    mine = np.array([(block.ring, block.slot) == (1, 3) for block in blocks])
    angle = np.radians(study.array.first_block_angle_deg + 2 * 360 / study.array.blocks_per_ring)
    moved = moved_m * np.array([np.cos(angle), np.sin(angle), 0.0])
    own = polarizations * mine[:, None]
    true = field(study, polarizations - own, POINTS) + field(
        study, own, POINTS - moved)
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    first = infer(build_magnet(study), shown, session.within("first"))
    (change,), (sd,) = first.amplitudes.change, first.amplitudes.sd
    assert abs(change - moved_m) > 3.5 * sd
    assert not inference_answer(first).trust.startswith("Yes")
    write_result(first, tmp_path)
    assert f"halbach-fe infer DIR/{UPDATED}" in inference_answer(first).command
    again = read_study(tmp_path / UPDATED)
    assert again.uncertain == study.uncertain
    found = again.array.exceptions[0].displacement_m[0]
    assert found == pytest.approx(change, rel=1e-12)
    second = infer(build_magnet(again), shown, session.within("second"))
    assert abs(found + second.amplitudes.change[0] - moved_m) < 3.5 * second.amplitudes.sd[0]
    assert second.far_amplitudes == ()
    assert inference_answer(second).trust.startswith("Yes")


def test_the_current_of_a_coil_is_estimated_with_the_blocks(session, generator):
    """It is known to 5 %, and 3 % more than stated; as an exact number it is blamed on blocks."""
    coil = {"kind": "round", "radius_m": 0.3, "current_A": 2e3}
    known = parse_study(DOCUMENT | {"external": {"coils": [coil]}})
    study = parse_study(DOCUMENT | {"external": {"coils": [coil]}, "uncertain": [
        {"name": "current", "sd": 100.0, "change": {"external.coils[1].current_A": 1.0}}]})
    polarizations = drawn(study, generator)
    true = field(study, polarizations, POINTS) + magpylib.current.Circle(
        diameter=0.6, current=1.03 * 2e3).getB(POINTS)
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    least = 4 * np.sqrt(2 / polarizations.size)
    chi2, result = update(study, shown, polarizations, session.within("update"))
    assert abs(chi2 - 1) < least
    assert abs(result.amplitudes.change[0] - 60.0) < 3.5 * result.amplitudes.sd[0]
    assert result.amplitudes.sd[0] < 50.0
    assert update(known, shown, polarizations, session.within("exact"))[0] > 1 + least


def test_the_place_of_an_object_has_a_bar(session, generator):
    document = DOCUMENT | {"array": DOCUMENT["array"] | SHORT}
    study = parse_study(document)
    polarizations = drawn(study, generator)
    at_m, moment = np.array([0.05, 0.19, 0.16]), np.array([0.0, 8.0, 4.0])
    true = field(study, polarizations, POINTS) + magpylib.misc.Dipole(
        position=at_m, moment=moment).getB(POINTS)
    shown = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    effects = [effect for effect in catalogue()
               if effect.name in ("ferromagnetic_object", "gain_x")]
    found = diagnose(study, shown, session.within("diagnosis"), effects=effects)
    assert [one.hypothesis.effect.name for one in found.identified] == ["ferromagnetic_object"]
    assert len(found.study.uncertain) == 6  # moment and place
    chi2, result = update(found.study, shown, polarizations, session.within("update"))
    assert abs(chi2 - 1) < 4 * np.sqrt(2 / polarizations.size)
    amplitudes = result.amplitudes
    (dipole,) = found.study.external.dipoles
    off = np.concatenate([dipole.moment_A_m2 - moment, dipole.position_m - at_m])
    assert (np.abs(off + amplitudes.change) < 3.5 * amplitudes.sd).all()
    # the readings say half of the moment, and three quarters of the place
    assert (amplitudes.sd < 0.6 * amplitudes.prior_sd).all()
    beside = study.with_(external__dipoles=[
        {"position_m": at_m.tolist(), "moment_A_m2": moment.tolist()}])  # its field counts too
    check_axis(result, beside, polarizations, session)


def test_all_laws_of_an_instrument_can_be_uncertain(session, generator):
    """Each by itself, at values that the readings show: they are found where they are."""
    names = {"offset_T[1]": 2e-4, "planar_hall_per_T[2]": 5e-3, "quadratic_per_T[1]": 3e-3,
             "radius_offset_m": 1e-4, "z_scale": 1e-3, "gain[3]": 5e-3, "translation_m[1]": 3e-4}
    study = parse_study(DOCUMENT)
    true = field(study, drawn(study, generator), POINTS)
    read = field_map(POINTS, true + NOISE_T * generator.standard_normal(true.shape))
    for name, sd in names.items():
        one = study.with_(uncertain=[{"name": name, "sd": sd, "change": {f"instrument.{name}": 1}}])
        off = shifted(one, one.uncertain[0], 0.5 * sd)  # an instrument that is not as good
        found = infer(build_magnet(off.with_(uncertain=one.uncertain)), read,
                      session.within(name)).amplitudes
        assert abs(found.change[0] + 0.5 * sd) < 3.5 * found.sd[0]
        assert found.sd[0] < 0.5 * sd, name


@pytest.mark.parametrize("effect", [
    effect for effect in catalogue() if isinstance(effect, MagnetizationEffect)],
    ids=lambda effect: effect.name)
@pytest.mark.parametrize("magnet", MAGNETS)
def test_a_study_at_an_amplitude_of_zero_has_the_numbers_that_change_with_it(effect, magnet):
    """A temperature gradient of 0 was one exception of all blocks, and one per slot beside it."""
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | MAGNETS[magnet]})
    for place in effect.places(study)[:2]:
        none = effect.apply(study, place, [0.0] * len(effect.parameters))
        for which, parameter in enumerate(effect.parameters):
            values = parameter.sd * np.eye(len(effect.parameters))[which]
            assert number_changes(none, effect.apply(study, place, values.tolist()))


def test_what_two_effects_write_of_blocks_may_be_uncertain_together():
    """Permeabilities along and across the easy axes were no numbers of one study.

    The diagnosis of these blocks, where several effects may hide, ended with an error.
    """
    study = read_study(ROOT / "studies/hybrid-quadrupole/study.toml")
    none = [IdentifiedEffect(
        Hypothesis(effect, place), *np.zeros((2, len(effect.parameters))), None)
            for effect in catalogue() for place in effect.places(study)[:1]]
    of_blocks = [one for one in none if one.hypothesis.apply(
        study, one.values.tolist()).array.exceptions and can_be_uncertain(study, one)]
    assert len(of_blocks) > 5
    for pair in permutations(of_blocks, 2):
        assert len(with_uncertain_effects(study, (), pair).uncertain) >= len(pair)


@pytest.mark.parametrize(("changes", "sentence"), [
    ({"array.remanance_T": 1.0}, "number with a fraction .* did you mean 'remanence_T'"),
    ({"instrument.gain": 1.0}, r"it has 3 of them, the first of which is 'instrument.gain\[1\]'"),
    ({"noise.position_sd_m[1]": 1.0}, "which no update estimates"),
    ({"instrument.gain[0]": 1.0}, r"its elements are \[1\] to \[3\]"),
    ({"array.rings": 1.0}, "which must be a number with a fraction"),
    ({"array.exceptions[2].twist_deg": 1.0}, "which must be a number with a fraction"),
    ({"array.remanence_T": 0.0}, "'a' changes all its numbers by 0"),
    ({"array.remanence_T": 1.0, "instrument.gain[1]": 1.0}, "both the magnet and an instrument")])
def test_names_that_a_study_does_not_have(changes, sentence):
    array = DOCUMENT["array"] | {"exceptions": [{"ring": 1}]}
    with pytest.raises(StudyError, match=sentence):
        noise = {**DOCUMENT["noise"], "position_sd_m": 1e-5}
        parse_study(DOCUMENT | {"array": array, "noise": noise,
                                "uncertain": [{"name": "a", "sd": 1.0, "change": changes}]})


def test_a_standard_deviation_that_no_magnet_can_have_is_named():
    """10 m, or 10 mm in another unit, for a radius of decimetres. Control: 10 um."""
    def with_sd(sd):
        return build_magnet(parse_study(DOCUMENT | {"uncertain": [
            {"name": "radius", "sd": sd, "change": {"array.inner_radius_m": 1.0}}]}))
    with pytest.raises(StudyError, match=r"`uncertain.sd` of 'radius' .* 1000 .* inner_radius_m"):
        shared_deviations(with_sd(1000.0))
    assert np.isfinite(shared_deviations(with_sd(1e-5))).all()


def test_the_page_of_a_magnet_that_alone_is_uncertain(session, generator, tmp_path):
    """It has the amplitude, and says nothing of instruments, of which none was estimated."""
    study = parse_study(DOCUMENT | {"uncertain": [
        {"name": "remanence", "sd": 0.01, "change": {"array.remanence_T": 1.0}}]})
    shown = field_map(POINTS, field(study, drawn(study, generator), POINTS))
    write_result(infer(build_magnet(study), shown, session), tmp_path)
    page = (tmp_path / "report.html").read_text()
    assert "remanence" in page
    assert "has the instruments that were found" not in page


def test_changes_of_numbers():
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | {"exceptions": [{"ring": 1}]}})
    other = study.with_(array__remanence_T=1.25, instrument__gain=(0.0, 0.01, 0.0))
    changes = number_changes(study, other)
    assert changes == pytest.approx({"array.remanence_T": 0.05, "instrument.gain[2]": 0.01})
    with pytest.raises(ValueError, match="rings differs"):
        number_changes(study, study.with_(array__rings=2, array__exceptions=()))
