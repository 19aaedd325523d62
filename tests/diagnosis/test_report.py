"""The page of a diagnosis, for studies of all kinds."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.discriminating_measurements import separations
from halbach_fe.diagnosis.effect_selection import MAX_EFFECTS, Candidate
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis, Parameter, Place
from halbach_fe.diagnosis.gross_errors import GrossError
from halbach_fe.diagnosis.map_conventions import MapConvention
from halbach_fe.diagnosis.random_errors import Outlier
from halbach_fe.diagnosis.result import (
    IdentifiedEffect,
    Imitation,
    Suspicion,
    UnknownCause,
    UnknownPart,
)
from halbach_fe.diagnosis.summary import (
    amounts,
    diagnosis_summary,
    human_unit,
    note,
    place_in_words,
)
from halbach_fe.diagnosis.uncertain_effects import with_uncertain_effects
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import read_blocks
from halbach_fe.measurement.field_map import field_map
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.report.diagnosis_page import change_table, found_table
from halbach_fe.report.diagnosis_page import page as page_of_diagnosis
from halbach_fe.report.page import write_files
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.reader import parse_study
from tests.conftest import circle
from tests.diagnosis.campaign import STUDY, drawn, table_of
from tests.support.pages import write_result
from tests.support.short_dipole import TEXT

EFFECTS = {effect.name: effect for effect in catalogue()}
NOISE = {"regions": [{"name": "all", "sigma_T": 2e-5}]}


def verdict(diagnosis):
    """All that the page says first, in one text."""
    return " ".join(answer(diagnosis).sentences)


def diagnosed(study, points, add, names, session, generator):
    """Diagnose the nominal map with something added and noise."""
    field = field_of(build_magnet(study).blocks, points)
    data = field_map(points, field + add(field) + 2e-5 * generator.standard_normal(points.shape))
    effects = [EFFECTS[name] for name in names]
    found = diagnose(study, data, session, effects=effects)
    # the words are those of a diagnosis that looked for all effects, which would take minutes
    found = replace(found, looked_for=None)
    return found, separations(found, data, session, effects)


@pytest.fixture
def flat(dipole, session, generator):
    """A cross-section by Fourier coefficients; the sensor of x shows 2 % more."""
    study = dipole(array__recoil_permeability=1.0, noise=NOISE,
                   observation={"quantity": "fourier_coefficients", "harmonics": 6, "positions": {
                       "kind": "circles", "radius_m": [0.05, 0.075], "angles": 24}})
    points = np.vstack([circle(0.05, 24), circle(0.075, 24)])
    return diagnosed(study, points, lambda field: field * [0.02, 0, 0],
                     ["background", "gain_x", "offset_y"], session, generator)


def test_a_cross_section(flat, tmp_path):
    found, further = flat
    assert [one.hypothesis.effect.name for one in found.identified] == ["gain_x"]
    write_files(page_of_diagnosis(found, further), tmp_path)
    page = (tmp_path / "diagnosis.html").read_text()
    assert page.count("<img alt=") == 5
    assert "along z" not in page.split("<h2>Structure")[1].split("<img")[0]  # no M_z
    assert "sensitivity of the Bx sensor, " in verdict(found)
    assert " %" in verdict(found)


def test_a_line(short_dipole, session, generator, tmp_path):
    study = short_dipole(array__recoil_permeability=1.0, noise=NOISE, observation={
        "quantity": "flux_density", "components": ["x"], "positions": {
            "kind": "line", "start_m": [0, 0, -0.2], "end_m": [0, 0, 0.2], "count": 41}})
    points = np.linspace([0, 0, -0.2], [0, 0, 0.2], 41)
    points[:, :2] = 0 * points[:, 2:]  # -0 below the middle, which is no angle of 180 degrees
    found, further = diagnosed(study, points, lambda _: [3e-4, 0, 0],
                               ["background", "gain_x", "offset_x"], session, generator)
    (one,) = found.identified
    rivals = {candidate.effect for candidate, _ in one.selection.alternatives}
    assert {one.hypothesis.effect.name, *rivals} >= {"background", "offset_x"}
    write_files(page_of_diagnosis(found, further), tmp_path)
    page = (tmp_path / "diagnosis.html").read_text()
    assert "The map does not tell" in page
    assert "<strong>Measure next: the same map with the probe turned by 180° about z." in page
    assert "against offset_x" in page or "against background" in page
    assert [row["count"] for row in change_table(found)] == ["41"]
    (row,) = found_table(found)
    titles = {effect.name: effect.title for effect in catalogue()}
    for candidate, _ in one.selection.alternatives:
        assert titles[candidate.effect] in row["it could be"]
    assert not any(group.kind == "angle" for group in found.groups_before)  # on the axis
    write_result(found, tmp_path)  # nothing would tell
    assert "Measure next" not in (tmp_path / "diagnosis.html").read_text()
    alone = replace(one, selection=replace(one.selection, alternatives=()))
    write_result(replace(found, identified=(alone,)), tmp_path)
    page = (tmp_path / "diagnosis.html").read_text()
    assert "The map does not tell" not in page
    assert "no other effect explains the readings as well" in page


def test_places_are_named_without_rounding_errors():
    assert Place(at_m=(-0.07566, 9.3e-18, -1e-17)).name == "at -0.07566, 0, 0 m"


def test_verdicts(flat, tmp_path):
    found, _ = flat
    unknown = UnknownCause("either", 40.0, False, False, 2e-4, (0.05, 0.0, 0.0), None)
    assert "nothing" not in verdict(found)
    assert "outside the catalogue remains" in verdict(replace(found, unknown=unknown))
    odd = Outlier(7, "z", (0.05, 0.0, 0.0), 1e-3, 1e-5)
    for what in (None, unknown):  # a rough cause may leave single readings that look like outliers
        said = answer(replace(found, outliers=(odd,), unknown=what)).said
        assert ("is an outlier and excluded (row 7 of the map), unless what is unknown is largest"
                in said) == bool(what)
        assert "is an outlier and excluded (row 7 of the map)" in said
    tie = replace(unknown, ambiguous=True)
    assert "A single cause outside the catalogue could equally well" in verdict(
        replace(found, unknown=tie))
    assert list(diagnosis_summary(replace(found, unknown=tie))["unknown"]) == [
        "kind", "log_bayes_factor", "alone", "as_well", "largest_T", "at_m", "source_m", "parts"]
    (one,) = found.identified
    usual = max(abs(one.values) / [parameter.sd for parameter in one.parameters])
    huge = replace(one, values=one.values * 30 / usual)
    assert "(30 times)" in verdict(replace(found, identified=(huge,)))
    assert answer(replace(found, identified=(huge,))).trust.startswith("Only in part. ")
    for ratio, said in ((8, "Yes. "), (12, "Only in part. ")):
        assert answer(replace(found, identified=(replace(
            one, values=one.values * ratio / usual),))).trust.startswith(said)
    assert answer(replace(found, unknown=unknown)).trust.startswith("No. ")
    assert answer(replace(found, after=found.before)).trust.startswith("No. ")
    assert answer(found).trust.startswith("Yes. ")
    imitation = Imitation(0.3, ("radial_gap", "length"), (0.28, 0.01))
    assert answer(replace(found, imitated=imitation)).trust.startswith("Only in part. ")
    clean = replace(found, identified=(), imitated=imitation)
    assert answer(clean).trust.startswith("Only as far as this map shows: ")
    assert "With a probability of 30 % something is missing" in answer(clean).trust
    assert "28 %" in answer(clean).trust
    covered = replace(imitation, fitted=found.identified)  # which the study has as uncertain
    assert answer(replace(found, imitated=covered)).trust.startswith("Yes. ")
    there = answer(replace(clean, imitated=covered))
    assert there.trust.startswith("Yes: ")
    assert "uncertain about 0" in there.trust
    assert "study.diagnosed.toml" in there.command
    assert diagnosis_summary(clean)["imitated"]["probability"] == 0.3
    assert answer(replace(clean, imitated=None)).trust.startswith("Yes: ")
    for kind, said in (("block_missing", "Only in part. "), ("ferromagnetic_object", "Yes. ")):
        own = Hypothesis(EFFECTS[kind], Place(1, 2) if kind == "block_missing" else Place(
            at_m=(0.3, 0.0, 0.0)))
        tie = replace(one, hypothesis=own, values=np.ones(len(own.effect.parameters)),
                      sd=np.ones(len(own.effect.parameters)), selection=replace(
            one.selection, alternatives=((Candidate(kind, "r01s05", ()), 1.0),)))
        told = answer(replace(found, identified=(tie,))).trust
        assert told.startswith(said)  # an object has one place, with a bar
        assert ("missing block, ring 1, slot 2 from missing block, ring 1, slot 5" in told) == (
            kind == "block_missing")
    suspicion = Suspicion(("gain_x",), 0.9, Hypothesis(EFFECTS["gain_x"], Place()), (0.9,), 5.5)
    besides = answer(replace(found, suspected=(suspicion,)))
    assert besides.sound  # what was named stands, and is used
    assert besides.trust.startswith("Yes, but what is suspected is not in the model. ")
    assert "Measure the same map 2 times in all" in besides.step
    assert "infer" in besides.command
    beside = [replace(one, hypothesis=Hypothesis(EFFECTS[name], Place(at_m=(0.3,) * count)),
                      values=np.ones(count), sd=np.ones(count))
              for name, count in (("neighbour_magnet", 1), ("ferromagnetic_object", 3))]
    assert answer(replace(found, identified=tuple(beside))).trust.startswith("Only in part. ")
    for each in beside:
        assert answer(replace(found, identified=(each,))).trust.startswith("Yes. ")
    others = [IdentifiedEffect(Hypothesis(EFFECTS[name], Place(1, 1)), np.ones(1), np.ones(1), None)
              for name in ("block_demagnetized", "block_missing")]
    several = replace(one, rivals=tuple(others), selection=replace(one.selection, alternatives=(
        (Candidate("block_demagnetized", "r01s01", ()), 1.0),)))
    assert answer(replace(found, identified=(several,), study=with_uncertain_effects(
        found.corrected_study, [several]))).step.endswith(
            "an update is right whichever it is; without missing block.")
    assert "Far larger" not in verdict(found)
    assert "had not converged" in verdict(replace(found, converged=False))
    assert not answer(replace(found, converged=False)).sound
    earlier = answer(replace(found, rounds=5, answer=2))  # later rounds predict worse
    assert "of which round 2 predicts held-out readings best" in earlier.trust
    assert not earlier.sound
    assert earlier.command.startswith("halbach-fe diagnose")
    assert answer(replace(found, converged=False, uncompared=3)).sound  # the time was up
    assert "had not converged" not in verdict(found)
    many = verdict(replace(found, identified=found.identified[:1] * MAX_EFFECTS))
    assert "a fit rather than a diagnosis" in many
    assert "a fit rather than" not in verdict(replace(found, identified=found.identified[:1]))
    nothing = replace(found, identified=(), after=found.before)
    assert "no effect of the catalogue" in verdict(nothing)
    some = replace(nothing, looked_for=("gain_x",))
    none = f"none of the effects that were compared (1 of {len(EFFECTS)}: gain_x) explains"
    assert none in verdict(some)
    assert answer(some).step.endswith("diagnose again without --effects.")
    cut = replace(nothing, uncompared=7)
    assert "that were compared (7 hypotheses were not compared" in verdict(cut)
    assert answer(cut).step.endswith("diagnose again without --time-limit.")
    for partial in (some, cut):
        beyond = verdict(replace(partial, unknown=replace(unknown, alone=True)))
        assert beyond.startswith("Something outside the effects that were compared (")
        for said in (verdict(partial), beyond):
            assert not re.search("of the catalogue explains|outside the catalogue", said)
        assert "The cause may be another effect of the catalogue." in verdict(partial)
    assert diagnosis_summary(some)["compared"] == {"effects": ["gain_x"], "of": len(EFFECTS)}
    assert diagnosis_summary(nothing)["compared"] is None
    (tmp_path / "some").mkdir()
    write_result(some, tmp_path / "some")
    page = (tmp_path / "some/diagnosis.html").read_text()
    assert "No effect that was compared explains the disagreement." in page
    alone = replace(nothing, unknown=replace(unknown, alone=True, source_m=(0.2, 0.0, 0.0)))
    assert verdict(alone).startswith("Something outside the catalogue is missing")
    assert "near (200, 0, 0) mm" in verdict(alone)
    assert "No: what is missing can be described" in verdict(alone)
    assert "Yes: " not in verdict(alone)
    part = UnknownPart("positions", "angle", ("readings z",), ("x", "y"), False, 2e-4, 6e-4, 3e-4,
                       40.0, 90.0)
    assert (
        "It looks like an error of 0.3 mm rms of the probe's position along x, y, a rough function "
        "of the azimuth that changes within some 40 ° (0.2 mT rms and 0.6 mT at most in the "
        "readings; as well explained by readings along z).") in verdict(
            replace(nothing, unknown=replace(unknown, alone=True, parts=(part,))))
    suspicion = Suspicion(("gain_x", "gain_y"), 0.9, Hypothesis(EFFECTS["gain_x"], Place()),
                          (0.6, 0.3), 5.5)
    doubt = replace(nothing, suspected=(suspicion,))
    text = verdict(doubt)
    assert "Suspected with a probability of 90 % (odds 9.0 : 1)" in text
    assert "Nothing is missing" not in text
    assert "Only in part: a suspicion is no certainty" in text
    assert "Measure the same map 2 times in all" in text
    assert diagnosis_summary(doubt)["verdict"] == "suspected"
    assert diagnosis_summary(doubt)["suspected"][0]["effects"] == {"gain_x": 0.6, "gain_y": 0.3}
    assert diagnosis_summary(doubt)["suspected"][0]["not_named"] == "odds"
    zero = IdentifiedEffect(Hypothesis(EFFECTS["gain_x"], Place()), np.ones(1), np.ones(1), None)
    assert "right whether it is there or not" in answer(replace(
        doubt, suspected=(replace(suspicion, fitted=(zero,)),),
        study=with_uncertain_effects(doubt.corrected_study, [], [zero]))).step
    assert "right whether it is there or not" not in answer(doubt).step
    for reason, said in (("which", "the map does not tell which"), ("impossible", "no valid study"),
                         ("roughly", "only estimated"), ("dropped", "dropped it again")):
        text = verdict(replace(nothing, suspected=(replace(
            suspicion, probability=1 - 1e-5, reason=reason),)))
        assert said in text
        assert "(odds over 1000 : 1)" in text
        assert "too little" not in text
        assert ("Measure the same map" in text) == (reason == "which")
    fine = replace(found.before, prior_conflict=1.0)
    assert verdict(replace(nothing, before=fine, after=fine)).startswith("Nothing is missing")
    assert "Yes: the readings are explained" in verdict(replace(nothing, before=fine, after=fine))


@pytest.mark.parametrize(("inner", "outer", "named", "said"), [
    (0.0, 0.0, [], "Yes: the readings are explained"),
    (0.02, 0.0, [], "No. Held-out readings are farther from their predictions"),
    (0.0, 0.02, ["gain_x"], "No. With this effect"),
    (0.02, 0.02, ["gain_x"], "Yes. With this effect")])
def test_held_out_readings_are_heard(
    dipole, session, generator, inner, outer, named, said
):
    """The sensor of x shows more in the circle that is not fitted only, or in the other one."""
    study = dipole(
        array__recoil_permeability=1.0, noise=NOISE, inference={"held_out": {"radii_m": [0.05]}},
        observation={"quantity": "flux_density", "components": ["x", "y"], "positions": {
            "kind": "circles", "radius_m": [0.05, 0.075], "angles": 24}})
    points = np.vstack([circle(0.05, 24), circle(0.075, 24)])
    gain = np.outer(np.repeat([inner, outer], 24), [1, 0, 0])
    found, further = diagnosed(study, points, lambda field: gain * field, ["gain_x"], session,
                               generator)
    assert [one.hypothesis.effect.name for one in found.identified] == named
    told = answer(found)
    assert told.trust.startswith(said)
    assert told.sound == said.startswith("Yes")
    assert told.said.startswith("The map is explained" if named and told.sound else "Nothing is"
                                if told.sound else "The best explanation" if named else
                                "Something is missing that was not found")
    assert told.command.startswith(f"halbach-fe {'infer' if told.sound else 'diagnose'}")
    summary = diagnosis_summary(found, further)
    assert bool(summary["held_out_conflict"]) != told.sound
    assert summary["verdict"] == (
        "named" if named else "nothing" if told.sound else "unexplained")


def test_the_page_of_what_is_unknown(flat, tmp_path):
    found, _ = flat
    unknown = UnknownCause("either", 40.0, True, False, 2e-4, (0.05, 0.0, 0.0), None)
    write_result(replace(found, identified=(), after=found.before, unknown=unknown), tmp_path)
    page = (tmp_path / "diagnosis.html").read_text()
    assert 'class="answer doubtful"' in page
    assert "tells a field from the sensors" in page
    assert "not to be believed" in page
    part = UnknownPart(acts_on="positions", along="z", or_else=(), components=("z",), smooth=False,
                       rms_T=1e-3, largest_T=4e-3, size=1e-4, half_wave=0.016,
                       log_bayes_factor=300.0)
    look = replace(unknown, parts=(part,))
    assert answer(replace(found, identified=(), after=found.before, unknown=look)).headline == (
        "Something outside the catalogue is missing. It looks like an error of 0.1 mm rms of the "
        "probe's position along z.")


def test_blocks_of_other_rings_than_the_map_shows_are_written_as_samples(flat, generator, tmp_path):
    """The command that goes on gets them. Negative control: blocks of the rings that it shows."""
    found, _ = flat
    table = table_of(STUDY, drawn(STUDY, generator), generator)
    page = page_of_diagnosis(found, (), STUDY, table)
    assert page.answer.command.endswith(" --blocks DIR/blocks.csv -o DIR")
    page.files["blocks.csv"](tmp_path / "blocks.csv")
    written = read_blocks(tmp_path / "blocks.csv")
    assert not written.ring.any()
    assert written.type == tuple(str(slot) for slot in table.slot)
    own = page_of_diagnosis(replace(found, study=STUDY), (), STUDY, table)
    assert not own.files
    assert "--blocks" not in own.answer.command


def test_numbers_for_people(flat):
    found, _ = flat
    one = found.identified[0]
    certain = replace(one, hypothesis=replace(one.hypothesis, effect=EFFECTS["block_missing"]),
                      values=np.ones(1), sd=np.zeros(1))
    assert amounts(certain) == ["present"]
    sag = replace(one, hypothesis=replace(one.hypothesis, effect=EFFECTS["arm_sag"]),
                  selection=replace(one.selection, candidate=Candidate("arm_sag", "", (0,)),
                                log_bayes_factor=31.25),
                  values=np.array([-1.2345e-3]), sd=np.array([2.7e-5]))
    assert amounts(sag) == ["−1.234 ± 0.027 mm"]
    assert note(sag) == "arm_sag: sag -0.001234 ± 0.000027 m, log Bayes factor 31.2"
    tiny = replace(sag, values=np.array([-1.2e-7]), sd=np.array([2.5e-9]))
    assert note(tiny) == "arm_sag: sag (-1.200 ± 0.025)e-7 m, log Bayes factor 31.2"
    assert human_unit(Parameter("gain", "1", 1.0)) == ("%", 100.0)
    assert human_unit(Parameter("factor", "1", 1.0)) == ("", 1.0)
    assert human_unit(Parameter("spin", "furlong", 1.0)) == ("furlong", 1.0)
    assert place_in_words(Place(2, 11)) == "ring 2, slot 11"
    assert place_in_words(Place(2, 0)) == "ring 2"
    assert place_in_words(Place(2, 11, words="r02s11, half a turn about its radius")) == (
        "ring 2, slot 11, half a turn about its radius")
    assert place_in_words(Place(at_m=(0.5,))) == "at 0.5 m"
    assert place_in_words(Place()) == ""


def test_both_of_two_swapped_blocks_are_named(flat):
    found, _ = flat
    one, swapped = found.identified[0], EFFECTS["blocks_swapped"]
    place = Place(1, 3, other=(1, 12), labels=("r01s03", "r01s12"))
    candidate = Candidate("blocks_swapped", place.name, (0,), is_binary=True)
    both = replace(found, identified=(replace(
        one, hypothesis=Hypothesis(swapped, place), values=np.ones(1), sd=np.zeros(1),
        selection=replace(one.selection, candidate=candidate, alternatives=())),))
    words = "ring 1, slot 3 and ring 1, slot 12"
    assert words in verdict(both)
    assert found_table(both)[0]["place"] == words
    said = answer(both)  # an error of assembly can be put right, others cannot
    assert f"exchange the blocks of {words}, and measure again" in said.step
    assert "study.diagnosed.toml" in said.command
    assert words in said.concern
    assert answer(found).concern == ""
    assert "Look at the magnet" not in answer(found).step
    assert diagnosis_summary(both)["effects"][0]["place"] == "r01s03, r01s12"
    assert "r01s03, r01s12" in note(both.identified[0])
    own = Place(1, 3, other=(1, 4), labels=("A7", "r01s04"))  # a free block has its own label
    assert place_in_words(own) == "block A7 and ring 1, slot 4"


def test_a_turn_of_the_magnet_exchanges_names(flat, monkeypatch):
    """Half a turn about the field of an ideal dipole exchanges its rings. A map whose place in the
    magnet was found from the map itself does not tell a block from its image.
    """
    found, _ = flat
    one = found.identified[0]
    placed = parse_study(tomllib.loads(TEXT + "\n[instrument]\nrotation_rad = [0.01, 0.0, 0.0]\n"))
    # the update is that of a cross-section
    monkeypatch.setattr(type(found.before), "common_factor", "")

    block, two = Place(1, 3), Place(1, 3, other=(1, 4))

    def said(study, place=block, name="block_flipped", **changes):
        hypothesis = Hypothesis(EFFECTS[name], place)
        candidate = Candidate(name, place.name, (0,), is_binary=True)
        return answer(replace(
            found, imitated=None,
            before=replace(found.before, magnet=build_magnet(study), **changes),
            identified=(replace(one, hypothesis=hypothesis, values=np.ones(1), sd=np.zeros(1),
                                selection=replace(one.selection, candidate=candidate,
                                                  alternatives=())),))).trust

    assert "ring 1, slot 3 may be ring 2, slot 7 as well" in said(placed)
    pair = "ring 1, slot 3 and ring 1, slot 4 may be ring 2, slot 6 and ring 2, slot 7 as well"
    assert pair in said(placed, two, "blocks_swapped")
    assert said(placed).startswith(said(parse_study(tomllib.loads(TEXT))))  # it is no doubt more
    images = Place(1, 1, other=(2, 1))  # which are exchanged with each other
    assert "as well" not in said(placed, images, "blocks_swapped")
    # controls: the study leaves the map where it is, one block differs, something is turned not
    # with the magnet, blocks were measured
    with_field = parse_study(tomllib.loads(
        TEXT + "\n[external]\nbackground_T = [0.0, 0.0, 1e-3]\n"
        "\n[instrument]\nrotation_rad = [0.01, 0.0, 0.0]\n"))
    assert "as well" not in said(with_field)
    assert "as well" not in said(parse_study(tomllib.loads(TEXT)))
    uneven = parse_study(tomllib.loads(
        TEXT + "\n[[array.exceptions]]\nring = 1\nslot = 2\nremanence_T = 1.25\n"
        "\n[instrument]\nrotation_rad = [0.01, 0.0, 0.0]\n"))
    assert "as well" not in said(uneven)
    assert "as well" not in said(placed, measured_blocks=("r01s01",))


def test_a_map_that_can_be_read_in_two_ways_is_no_plain_yes(flat):
    """Of a magnet that is its own mirror image the other way gives other blocks, 26 of their bars
    off in one case.
    """
    found, _ = flat
    found = replace(found, identified=(), suspected=(), imitated=None, after=replace(
        found.after, prior_conflict=1.0))
    reversed_z, of_field = (MapConvention(**{key: ("x", "y", "-z")})
                            for key in ("positions", "fields"))
    only = GrossError(reversed_z, (), 1.0, 0.0)
    text = verdict(replace(found, gross_errors=(replace(only, alternatives=(of_field,)),)))
    assert "Only in part: the map can be read in several ways that explain it alike." in text
    assert f"would be the same with {of_field.text}, and blocks of an update others" in text
    assert "Find out how the map was taken" in text
    # controls: it is the only way; blocks were measured, which tell them apart
    assert "Yes: " in verdict(replace(found, gross_errors=(only,)))
    assert "Yes: " in verdict(replace(
        found, gross_errors=(replace(only, alternatives=(of_field,)),),
        before=replace(found.before, measured_blocks=("r01s01",))))


def test_what_the_error_of_the_solver_hides(flat):
    """Readings far nearer to the model than the solver's error allows are no plain yes."""
    found, _ = flat
    noise, same = found.after.noise.sd, found.after.response
    wide = replace(found.after, prior_conflict=0.2, response=replace(same, error=3 * noise))
    nothing = replace(found, identified=(), suspected=(), gross_errors=(), imitated=None)
    for diagnosis in (replace(found, identified=found.identified[:1]), nothing):
        text = verdict(replace(diagnosis, before=wide, after=wide))
        assert "error is 3 times the noise and hides what is smaller" in text
        assert ("Only in part." if diagnosis.identified else "Only as far as this map") in text
        for other in (replace(wide, prior_conflict=0.8),
                      replace(wide, response=replace(same, error=0.5 * noise))):
            assert "hides what is smaller" not in verdict(
                replace(diagnosis, before=other, after=other))
    assert "Yes: " in verdict(replace(nothing, before=other, after=other))


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=lambda effect: effect.name)
def test_every_parameter_has_a_unit_that_is_told(effect):
    assert all(human_unit(parameter)[0] or parameter.unit == "1"
               for parameter in effect.parameters)
