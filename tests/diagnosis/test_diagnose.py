"""Effects on a magnet by magpylib, from the map to the name."""

from __future__ import annotations

from types import SimpleNamespace

import magpylib
import numpy as np
import pytest

import halbach_fe as hf
from halbach_fe import explanation
from halbach_fe.core.errors import ColumnsError, HalbachWarning, MeasurementError
from halbach_fe.diagnosis import diagnose as module
from halbach_fe.diagnosis.cost_estimate import estimate_diagnosis
from halbach_fe.diagnosis.diagnose import diagnose, dropped_with_rivals, only_equals_took_turns
from halbach_fe.diagnosis.effect_comparison import possible
from halbach_fe.diagnosis.effect_selection import Candidate, SelectedEffect
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis, InstrumentEffect, Parameter, Place
from halbach_fe.diagnosis.effects.magnetization import BlocksSwappedEffect
from halbach_fe.diagnosis.gross_error_correction import beside_amplitudes, blocks_of
from halbach_fe.diagnosis.random_errors import Outlier
from halbach_fe.diagnosis.result import IdentifiedEffect
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.diagnosis.summary import diagnosis_summary
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.measurement.field_map import field_map, points_of
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.ring_harmonics_2d import ideal_sectors, layered_bore_field
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.simulate import simulate_delivery
from tests.conftest import DIPOLE, changed, circle
from tests.diagnosis.campaign import (
    CIRCLES,
    DOCUMENT,
    NOISE_T,
    STUDY,
    drawn,
    field,
    measured,
    table_of,
    with_array,
)


class Restless(BlocksSwappedEffect):
    """Looks at more pairs in every round."""

    looked = 0

    def shortlist(self, study, mean, information, score):
        self.looked += 7
        return super().shortlist(study, mean, information, score)[:self.looked]


@pytest.mark.parametrize("still", [False, True])
def test_outliers_are_judged_again_with_the_effects(still, session, generator, monkeypatch):
    """Without them a reading may seem to be one; if it still is, it is excluded."""
    study = with_array(rings=1)
    shown = uniform(measured(study, generator, CIRCLES[::5]))
    said, judged = (Outlier(7, "x", tuple(CIRCLES[30]), 1e-3, 5e-5),), []

    def outliers_of(update, campaign):
        judged.append(update.study.instrument.offset_T[0])
        return said if still or len(judged) == 1 else ()

    monkeypatch.setattr(module, "outliers_of", outliers_of)
    effects = [effect for effect in catalogue() if effect.name in ("offset_x", "gain_z")]
    found = diagnose(study, shown, session, effects=effects)
    assert [one.hypothesis.effect.name for one in found.identified] == ["offset_x"]
    assert found.outliers == (said if still else ())
    assert len(found.study.inference.excluded_readings) == still
    assert judged == [0.0, pytest.approx(4e-4, abs=5e-5)]


def test_sizes_of_a_round_are_not_compared_with_those_of_a_table():
    """The first amplitudes may be far off: of blocks 15 % narrower than those of the table."""
    blocks = simulate_delivery(STUDY, 1)
    narrower = build_magnet(with_array(block={"shape": "cuboid", "width_m": 0.034}))
    with pytest.raises(MeasurementError, match="volume_m3 of block B0001"):
        prior_from_blocks(narrower, blocks)
    with pytest.warns(HalbachWarning, match="14 % stronger"):
        prior = prior_from_blocks(narrower, beside_amplitudes(blocks, STUDY))
    # with the moments that were measured
    moment = prior.gaussian.mean.reshape(-1, 3)[0] * 0.05 * 0.034 * 0.06
    assert np.linalg.norm(moment) == pytest.approx(np.linalg.norm(blocks.moment[0]), rel=1e-6)
    assert beside_amplitudes(None, STUDY) is None


def uniform(data):
    return field_map(points_of(data), np.add(data["B_T"].values, [4e-4, 0.0, 0.0]))


@pytest.mark.parametrize("name", ["offset_x", "z_scale", "none"])
def test_a_search_among_pairs_of_blocks(name, session, generator):
    """Which pairs are looked at closely changes from round to round; the rest is the same."""
    if name == "z_scale":  # 1 mm at the ends of the map
        data = measured(STUDY, generator, at=CIRCLES * [1.0, 1.0, 1.005])
    else:
        data = measured(STUDY, generator)
        data = uniform(data) if name == "offset_x" else data
    some = [effect for effect in catalogue() if effect.name in (
        "background", "gain_x", "gain_z", "length", "offset_x", "z_scale")]
    found = diagnose(STUDY, data, session, effects=[Restless(), *some])
    assert found.unknown is None
    assert [name] == [
        one for each in found.identified for one in each.selection.effects if one == name] or (
        name == "none" and not found.identified)
    assert found.after.prior_conflict < found.after.conflict_limit
    if name == "z_scale":
        scale = found.identified[0]
        assert scale.values == pytest.approx([0.005], abs=4 * scale.sd[0])
    assert np.isfinite(found.loo_residuals_after).all()


@pytest.mark.parametrize("solved", [0, 1])
def test_a_step_to_a_model_without_a_solution_ends_the_search(
        solved, session, generator, monkeypatch):
    """The answer is that of the rounds before, and not sound; without any there is none."""
    rounds = iter(range(10))

    def infer(*arguments, **options):
        if next(rounds) >= solved:
            raise ColumnsError("The columns do not add up.")
        return inferred(*arguments, **options)

    inferred = module.infer
    monkeypatch.setattr(module, "infer", infer)
    data = uniform(measured(STUDY, generator))
    some = [effect for effect in catalogue() if effect.name in ("background", "offset_x")]
    if not solved:
        with pytest.raises(ColumnsError):
            diagnose(STUDY, data, session, effects=some)
        return
    found = diagnose(STUDY, data, session, effects=some)
    assert (found.converged, found.unsolved, found.rounds) == (False, True, 1)
    assert not found.identified
    assert not answer(found).sound
    assert "led to a model without a solution" in answer(found).trust


@pytest.mark.parametrize("fraction", [0.03, -1.0, -2.0])
def test_the_current_of_a_coil(fraction, session, generator):
    """It is 3 % larger than stated, or the coil is off, or connected the wrong way round."""
    ring = {"radius_m": 0.3, "current_A": 2e3}
    study = parse_study(DOCUMENT | {"external": {"coils": [
        {"kind": "round", "centre_m": [0.0, 0.0, z]} | ring for z in (-0.1, 0.1)]}})
    shown = measured(study, generator)
    for z, factor in ((-0.1, 1.0), (0.1, 1.0 + fraction)):
        shown["B_T"].values[:] += magpylib.current.Circle(
            diameter=0.6, current=2e3 * factor, position=(0, 0, z)).getB(CIRCLES)
    some = [effect for effect in catalogue() if effect.name in (
        "coil_current", "background", "gain_z", "offset_z", "block_missing")]
    (named,) = diagnose(study, shown, session, effects=some).identified
    assert named.hypothesis.key == ("coil_current", Place(slot=2, words="coil 2"))
    assert named.values == pytest.approx([fraction], abs=4 * named.sd[0])
    assert named.sd[0] < max(0.01, abs(fraction) / 100)  # or a background has changed too


def test_iron_of_another_permeability(session, generator):
    """A tube in cross-section, and the exact field of a magnet with another one."""
    tube = {"inner_radius_m": 0.19, "outer_radius_m": 0.2}
    study = parse_study(changed(
        DIPOLE, array__blocks_per_ring=8, iron_ring=tube | {"relative_permeability": 20.0},
        prior={"magnitude_sd": 1e-3, "direction_sd_deg": 0.1}, mesh__block_size_m=0.007,
        noise={"regions": [{"name": "bore", "sigma_T": 1e-4}]},
        observation__positions={"kind": "circles", "radius_m": 0.09, "angles": 96}))
    points = circle(0.09, 96)
    exact = np.zeros((96, 3))
    exact[:, :2] = layered_bore_field(ideal_sectors(1, 8, 1.06, np.pi / 2, np.pi), 0.104, 0.1865,
                                      1.05, points[:, :2], (0.19, 0.2, 40.0))
    shown = field_map(points, exact + 1e-4 * generator.standard_normal(exact.shape))
    some = [effect for effect in catalogue() if effect.name in (
        "iron_permeability", "temperature_gradient", "gain_x")]
    found = diagnose(study, shown, session, effects=some)
    (named,) = found.identified
    assert named.hypothesis.effect.name == "iron_permeability"
    assert named.values == pytest.approx([1.0], abs=4 * named.sd[0])


def test_an_estimate_of_iron_that_touches(generator):
    """Two boxes on each other can move along z to one side only, there by two steps."""
    box = {"kind": "box", "size_m": [0.05, 0.05, 0.02]}
    study = parse_study(DOCUMENT | {"iron": {"relative_permeability": 500.0, "bodies": [
        box | {"centre_m": [0.12, 0.0, height]} for height in (0.12, 0.14)]}})
    (effect,) = (one for one in catalogue() if one.name == "iron_displaced")
    estimate = estimate_diagnosis(study, measured(STUDY, generator), effects=[effect])
    assert (estimate.signatures, estimate.fields) == (2, 12)
    assert estimate.fields_s > 5 * estimate.update.seconds


@pytest.mark.parametrize("name", ["azimuthal_gap", "radial_gap"])
def test_impossible_amplitudes_are_no_explanation(session, generator, name):
    """Blocks that are wider than their sectors, or nearer to the axis than their neighbours let
    them: what that does is not called a gap.
    """
    gap = next(effect for effect in catalogue() if effect.name == name)
    study = parse_study(DOCUMENT | {"array": DOCUMENT["array"] | {
        "outer_radius_m": 0.15, "block": {"shape": "sector"}}})
    nominal = field_of(build_magnet(study).blocks, CIRCLES)
    change = field_of(build_magnet(gap.apply(study, Place(), [3e-4])).blocks, CIRCLES) - nominal
    noise = NOISE_T * generator.standard_normal(CIRCLES.shape)
    wider, narrower = (field_map(CIRCLES, nominal + sign * change + noise) for sign in (-1, 1))
    tight = study.with_(prior__magnitude_sd=1e-4, prior__direction_sd_deg=0.01,
                        prior__common_mode_sd=1e-4)
    (named,) = diagnose(tight, narrower, session, effects=[gap]).identified
    assert named.values == pytest.approx([3e-4], abs=4 * named.sd[0])
    assert diagnose(tight, wider, session, effects=[gap]).identified == ()


@pytest.mark.parametrize("name", ["recoil_permeability_across", "corners_demagnetized"])
def test_limits_of_keys_are_limits_of_amplitudes(name):
    """No recoil permeability is below one, and no corner has more than its magnetization."""
    effect = next(one for one in catalogue() if one.name == name)
    study = with_array(recoil_permeability=1.05)
    for value, there in ((0.1, True), (-0.1, False)):
        named = IdentifiedEffect(Hypothesis(effect, Place()), np.array([value]), np.array([0.01]),
                                 SelectedEffect(Candidate(name, "", (0,)), 9.0, 5.0, ()))
        assert possible(study, [named],
                        Campaign.of(STUDY, field_map(CIRCLES, 0 * CIRCLES))) == there


def test_sides_that_are_equal_are_told_with_their_odds(session, generator):
    """Bx of a line beside the axis, which is the same on the other side."""
    line = np.column_stack([np.zeros((41, 2)), np.linspace(-0.2, 0.2, 41)])
    data = measured(STUDY, generator, line, at=np.add(line, [0.04, 0.0, 0.0]))
    data["B_T"].values[:, 1:] = np.nan
    some = [effect for effect in catalogue() if effect.name in ("wrong_line", "gain_x")]
    found = diagnose(STUDY, data, session, effects=some)
    named = next(one for one in found.identified if one.hypothesis.effect.name == "wrong_line")
    assert found.after.prior_conflict < found.after.conflict_limit
    across = [position.amplitudes["wrong_line"][0] for position in found.positions]
    assert min(across) == pytest.approx(-max(across), abs=5e-3)
    assert sum(position.probability for position in found.positions) == pytest.approx(1)
    # the magnet is symmetric: neither side can be sure
    assert max(position.probability for position in found.positions) < 0.9
    assert abs(named.values[0]) == pytest.approx(0.04, abs=4 * named.sd[0])
    assert "The magnet is the same from several sides" in " ".join(answer(found).sentences)
    assert len(diagnosis_summary(found)["positions"]) == len(found.positions) > 1


@pytest.mark.parametrize("name", ["block_flipped", "block_missing", "blocks_swapped"])
def test_whole_blocks_beside_a_wrong_calibration_of_the_coil(session, generator, name):
    """All measured blocks are 1.5 % too strong, and each of them is known to 0.1 %. The block that
    is reversed or elsewhere differs from its own measurement more than all others, and another
    effect of that block would explain it better.
    """
    blocks, polarizations = build_magnet(STUDY).blocks, drawn(STUDY, generator)
    number, table = 16, table_of(STUDY, 1.015 * polarizations, generator)
    built = polarizations.copy()
    if name == "blocks_swapped":  # on opposite sides of a ring
        opposite = number + 6 if number % 12 < 6 else number - 6
        built[[number, opposite]] = -polarizations[[opposite, number]] * [1, 1, -1]
    else:
        built[number] *= -1 if name == "block_flipped" else 0
    true = field(STUDY, built, CIRCLES)
    data = field_map(CIRCLES, true + NOISE_T * generator.standard_normal(true.shape))
    some = [effect for effect in catalogue() if effect.name in (
        name, "block_demagnetized", "block_turned", "ferromagnetic_object")]
    found = diagnose(STUDY, data, session, table, effects=some)
    (named,) = found.identified
    assert named.hypothesis.effect.name == name
    assert found.unknown is None
    block = blocks[number]
    assert (block.ring, block.slot) in [
        (named.hypothesis.place.ring, named.hypothesis.place.slot), named.hypothesis.place.other]
    assert found.converged
    assert found.rounds <= 3
    assert found.after.prior_conflict < found.after.conflict_limit


def identified(name, value, *equals):
    """An effect with an amplitude of standard deviation 1, and the names of its alternatives."""
    (effect,) = [one for one in catalogue() if one.name == name]
    return IdentifiedEffect(
        Hypothesis(effect, Place()), np.array([value]), np.array([1.0]),
        SelectedEffect(Candidate(name, "", (0,)), 50.0, 45.0, tuple(
            (Candidate(other, "", (0,)), 49.0) for other in equals)))


def test_equals_that_take_turns_have_come_to_rest():
    """An offset that a background explains as well would give way to it in every other round."""
    before = [identified("z_scale", 3.0), identified("offset_x", 9.0)]
    equal = identified("background", 9.0, "offset_x")
    assert only_equals_took_turns(before, [identified("z_scale", 3.1), equal])
    # controls: another effect moves, the new one explains more, is more, or replaces nothing
    assert not only_equals_took_turns(before, [identified("z_scale", 4.0), equal])
    assert not only_equals_took_turns(before, [before[0], identified("background", 9.0)])
    assert not only_equals_took_turns(before, [*before, equal])
    assert not only_equals_took_turns(before, [equal])
    assert not only_equals_took_turns(before, before)


class CommonGain(InstrumentEffect):
    """All sensors have the same relative error, as in docs/how-to/own-effect.md."""

    name = "common_gain"
    title = "gain of the whole probe"
    parameters = (Parameter("fraction", "1", 3e-3),)

    def change(self, instrument, values):
        return {"gain": tuple(gain + values[0] for gain in instrument.gain)}


@pytest.mark.parametrize("gain", [0.01, 0.0])
def test_an_effect_of_ones_own_is_searched_for(session, generator, gain):
    """Its signature follows from the law of the instrument. Blocks of 0.01 % do not imitate it."""
    true = field(STUDY, drawn(STUDY, generator, 1e-4), CIRCLES)
    data = field_map(CIRCLES, (1 + gain) * true + NOISE_T * generator.standard_normal(true.shape))
    exact = STUDY.with_(prior__magnitude_sd=1e-4, prior__direction_sd_deg=0.006,
                        prior__common_mode_sd=1e-4)
    found = hf.diagnose(build_magnet(exact), data, session, effects=[CommonGain(), "drift"])
    if not gain:  # negative control: without it nothing is found
        assert found.identified == ()
        return
    (identified,) = found.identified
    assert identified.hypothesis.effect.name == "common_gain"
    assert identified.values[0] == pytest.approx(0.01, abs=4 * np.hypot(identified.sd[0], 1e-4))
    assert found.study.instrument.gain == pytest.approx([identified.values[0]] * 3)
    assert "gain of the whole probe" in " ".join(answer(found).sentences)


class ShyGain(CommonGain):
    """Likelier than a common gain, as long as it is not in the model."""

    name = "shy_gain"
    relative_odds = 2.0

    def derivative(self, nominal, place, values):
        return 0 * self.signature(nominal, place)


@pytest.mark.parametrize("goes_on", [True, False])
def test_an_effect_that_is_dropped_in_its_own_model_leaves_the_place_to_others(
        goes_on, session, generator, monkeypatch):
    """As an iron ring whose solution has an error that hides what the ring was to explain."""
    if not goes_on:  # negative control: the search goes round in circles
        monkeypatch.setattr(module, "dropped_with_rivals", lambda *given: set())
    true = field(STUDY, drawn(STUDY, generator, 1e-4), CIRCLES)
    data = field_map(CIRCLES, 1.01 * true + NOISE_T * generator.standard_normal(true.shape))
    exact = STUDY.with_(prior__magnitude_sd=1e-4, prior__direction_sd_deg=0.006,
                        prior__common_mode_sd=1e-4)
    found = diagnose(exact, data, session, effects=[ShyGain(), CommonGain()])
    assert found.is_at_rest == goes_on
    assert [one.name for one in found.identified] == ["common_gain"] * goes_on
    assert answer(found).trust.startswith("Yes") == goes_on


def test_only_what_leads_back_and_has_rivals_is_given_up():
    first, second = identified("z_scale", 3.0, "length"), identified("offset_x", 9.0)
    nothing, one = frozenset(), frozenset([first.hypothesis])
    assert dropped_with_rivals([nothing], [first, second], []) == {"z_scale"}
    assert dropped_with_rivals([nothing, one], [first, second], [first]) == set()  # has no rival
    assert dropped_with_rivals([nothing], [first, second], [second]) == set()  # leads on
    assert dropped_with_rivals([nothing, one], [first], [first]) == set()  # is at rest
    itself = identified("z_scale", 3.0, "z_scale")  # at another place
    assert dropped_with_rivals([nothing], [itself], []) == set()


def test_blocks_of_another_number_of_rings_lose_their_places(generator, monkeypatch):
    """In the update after a diagnosis that has corrected it, as in the diagnosis itself."""
    table = table_of(STUDY, drawn(STUDY, generator), generator)  # which states no types
    for rings in (1 + STUDY.array.rings, STUDY.array.rings):  # the second one is the control
        steps = explanation._InMemory(
            build_magnet(STUDY), None, explanation.NOT_KEPT, table, lambda text: None)
        found = SimpleNamespace(study=STUDY.with_(array__rings=rings))
        monkeypatch.setattr(explanation, "diagnose", lambda *_, found=found, **__: found)
        monkeypatch.setattr(explanation.diagnosis_answer, "answer", lambda _: SimpleNamespace(
            changes_study=True, said="", trust="", sound=True))
        assert steps.diagnose()
        assert steps.blocks.ring.any() == (rings == STUDY.array.rings)
        assert len(prior_from_blocks(steps.magnet, steps.blocks).types) == (
            STUDY.array.blocks_per_ring)


@pytest.mark.parametrize("more", [1, -1])
def test_blocks_of_the_corrected_number_of_rings_keep_their_places(more, generator):
    """The study as first written has another number, and says so of the table."""
    true = STUDY.with_(array__rings=STUDY.array.rings + more)
    table = table_of(true, drawn(true, generator), generator)
    kept = blocks_of(table, STUDY, true)
    assert prior_from_blocks(build_magnet(true), kept).placed
    with pytest.raises(MeasurementError, match=r"rings and blocks of \[array\] in the study"):
        prior_from_blocks(build_magnet(STUDY), table)
