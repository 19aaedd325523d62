"""Two maps of one magnet by magpylib: what is missing, and of which map it is."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.discriminating_measurements import SEPARATING_GAIN, separations
from halbach_fe.diagnosis.effect_selection import Candidate
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis
from halbach_fe.diagnosis.gross_error_correction import correct_map_errors
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.diagnosis.summary import diagnosis_summary, region_scores
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.campaign_maps import read_maps
from halbach_fe.measurement.field_map import field_map, points_of, readings_sha256, write_map
from halbach_fe.measurement.probe_law import nonlinear_part, sensor_model, with_memory
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study, read_study
from tests.inference.test_campaign import two_maps as displaced_maps
from tests.support.short_dipole import BODY, FRINGE, NOISE_T, TEXT, campaign_study, truth

POSES = {"body": (Rotation.from_rotvec([0.0, 0.0, 0.006]), np.array([3e-4, -2e-4, 5e-4])),
         "fringe": (Rotation.from_rotvec([np.pi, 0.0, 0.0]), np.array([-4e-4, 3e-4, 0.0503]))}
"""A stage has coordinates s; the place in the magnet is turn s + shift. One is upside down."""

POINTS = {name: points[np.round(points[:, 2] / 0.006) % 2 == 0]
          for name, points in (("body", BODY), ("fringe", FRINGE))}
"""Of each scan line every other point, which suffices to name what is missing."""

SOME = [effect for effect in catalogue() if effect.name in (
    "arm_sag", "background", "block_demagnetized", "block_displaced", "block_turned", "drift",
    "gain_x", "gain_y", "mapper_roll", "mapper_tilt_x", "mapper_tilt_y", "mapper_translation",
    "misalignment_xy", "misalignment_yx", "offset_x", "offset_z", "temperature", "z_scale")]

WEAK = 0.3
ROLLED_RAD = 0.006
GAIN = 0.006


def text_of(probe=None):
    """The study file of both maps, whose poses are known."""
    return TEXT + "".join(f"""
[[maps]]
name = "{name}"   # of two
file = "{name}.csv"
{f'probe = "{probe}"' if probe else ""}
[maps.instrument]
translation_m = {shift.tolist()}
rotation_rad = {turn.as_rotvec().tolist()}
""" for name, (turn, shift) in POSES.items())


def study_of(probe=None):
    return parse_study(tomllib.loads(text_of(probe)))


def two_maps(generator, magnet_of, rolled="", read=None):
    """Maps of a magnet by magpylib; one stage may be rolled about the magnet's axis."""
    found = {}
    for name, points in POINTS.items():
        turn, shift = POSES[name]
        stated = (points - shift) @ turn.as_matrix()
        extra = Rotation.from_rotvec([0.0, 0.0, ROLLED_RAD if name == rolled else 0.0])
        field = magnet_of.getB(extra.apply(points)) @ (extra * turn).as_matrix()
        if read:
            field = read(name, field)
        found[name] = field_map(stated, field + NOISE_T * generator.standard_normal(field.shape))
    return found


def with_offset(data, offset):
    return field_map(points_of(data), data["B_T"].values + offset)


def held_out(update, residuals):
    """Chi-squared per held-out reading of each map."""
    return {fit.region: fit.chi2_per_reading for fit in region_scores(update, residuals)
            if fit.part == "held out" and fit.region != "all"}


def limit(update, name):
    """Chi-squared per held-out reading of a map that chance explains: five sd above 1."""
    count = sum(part == "held out" and each == name
                for part, each in zip(update.parts, update.maps, strict=True))
    return 1 + 5 * np.sqrt(2 / count)


def named(found):
    return [(effect.hypothesis.effect.name, effect.place.name) for effect in found.identified]


def test_a_weak_block_is_named_once_and_explains_both_maps(generator, tmp_path):
    magnet_of = truth(generator)
    weak = next(one for one in magnet_of.sources if one.position[2] > 0)  # ring 2, slot 1
    weak.polarization = np.array(weak.polarization) * (1 - WEAK)
    found = diagnose(study_of(), two_maps(generator, magnet_of), Session.open(tmp_path),
                     effects=SOME)
    assert named(found) == [("block_demagnetized", "r02s01")]
    (loss,), (sd,) = found.identified[0].values, found.identified[0].sd
    assert loss == pytest.approx(WEAK, abs=4 * np.hypot(sd, 0.01))  # 1 % is the block's own error
    assert found.unknown is None
    after = held_out(found.after, found.loo_residuals_after)
    assert set(after) == {"body", "fringe"}
    for name, chi2 in after.items():
        assert chi2 < limit(found.after, name)
    assert found.before.prior_conflict > found.before.conflict_limit
    assert found.after.prior_conflict < found.after.conflict_limit


@pytest.mark.parametrize("rolled", ["body", "fringe"])
def test_a_stage_that_is_rolled_is_named_with_its_map(generator, tmp_path, rolled):
    maps = two_maps(generator, truth(generator), rolled)
    found = diagnose(study_of(), maps, Session.open(tmp_path), effects=SOME)
    assert named(found) == [("mapper_roll", f"map {rolled}")]
    assert found.identified[0].values == pytest.approx([ROLLED_RAD],
                                                       abs=4 * found.identified[0].sd[0])
    (effect,) = diagnosis_summary(found)["effects"]
    assert effect["maps"] == [rolled]
    other = ({"body", "fringe"} - {rolled}).pop()
    assert found.study.maps[[one.name for one in found.study.maps].index(other)] == (
        found.corrected_study.maps[[one.name for one in found.study.maps].index(other)])
    assert f"map {rolled}" in " ".join(answer(found).sentences)
    # if it could not be told from another effect, that map would be measured again
    (roll,) = found.identified
    rival = Candidate("misalignment_xy", f"map {rolled}", ())
    doubtful = replace(found, identified=(replace(roll, selection=replace(
        roll.selection, alternatives=((rival, 0.0),))),))
    (pair,) = separations(doubtful, maps, Session.open(tmp_path), SOME)
    assert pair.rival.place.maps == (rolled,)
    assert pair.candidates[0].title == f"map {rolled} again, with the probe turned by 180° about z"
    assert {one.scan.map for one in pair.candidates if one.scan.mapped} == {rolled}
    assert min(pair.gains.values()) > -1e-6
    assert max(pair.gains.values()) > SEPARATING_GAIN


def test_nothing_is_named_of_maps_without_errors(generator, tmp_path):
    found = diagnose(study_of(), two_maps(generator, truth(generator)), Session.open(tmp_path),
                     effects=SOME)
    assert not found.found_anything
    assert found.unknown is None
    assert "these maps can show" in " ".join(answer(found).sentences)


def test_poses_that_are_open_hide_no_effect_and_take_none(generator, tmp_path):
    """Both stages are off by half a millimetre; one probe has an offset, and a block is weak."""
    magnet_of = truth(generator)
    weak = next(one for one in magnet_of.sources if one.position[2] > 0)
    weak.polarization = np.array(weak.polarization) * (1 - WEAK)
    maps = displaced_maps(generator, magnet_of)
    maps["fringe"] = with_offset(maps["fringe"], [4e-4, 0.0, 0.0])
    found = diagnose(campaign_study(), maps, Session.open(tmp_path), effects=SOME)
    assert sorted(named(found)) == [("block_demagnetized", "r02s01"), ("offset_x", "map fringe")]
    assert found.after.prior_conflict < found.after.conflict_limit
    # what is written states the poses as they were known, lest the readings count twice
    assert found.study.maps[0] == found.corrected_study.maps[0]
    assert found.study.of_map(1).instrument.translation_m == (0.0, 0.0, 0.05)
    assert found.after.study.of_map(1).instrument.translation_m[2] != 0.05
    # what would tell the offset from a field outside, with poses as open as before
    offset = next(one for one in found.identified if one.hypothesis.effect.name == "offset_x")
    doubtful = replace(found, identified=(replace(offset, selection=replace(
        offset.selection, alternatives=((Candidate("background", "", ()), 0.0),))),))
    (pair,) = separations(doubtful, maps, Session.open(tmp_path), SOME)
    assert pair.recommended is not None
    assert pair.recommended.name == "probe_rolled"


def test_what_nobody_listed_is_unknown_and_named_with_its_map(generator, tmp_path):
    """The probe of one map shows more where the stage is in the middle of its travel."""
    def read(name, field):
        wave = np.sin(0.11 * np.arange(len(field))) ** 3
        return field + (5e-4 * wave[:, None] * [0.0, 0.0, 1.0] if name == "fringe" else 0.0)

    found = diagnose(study_of(), two_maps(generator, truth(generator), read=read),
                     Session.open(tmp_path), effects=SOME)
    assert named(found) == []
    assert found.unknown is not None
    assert found.unknown.kind == "instrument"
    assert {part.map for part in found.unknown.parts} == {"fringe"}
    assert "in map fringe" in " ".join(answer(found).sentences)


def test_the_command_names_the_probe_that_maps_share(generator, tmp_path, capsys):
    """And writes what concerns each map: scores, floors, groups, and the study with their files."""
    maps = two_maps(generator, truth(generator), read=lambda _, field: field * [1, 1 + GAIN, 1])
    for name, data in maps.items():
        write_map(data, tmp_path / f"{name}.csv")
    (tmp_path / "study.toml").write_text(text_of("hall"))
    (tmp_path / "check.json").write_text(json.dumps({
        "floor_T": [1e-5, 2e-5, 3e-5],
        "maps_sha256": {"map": readings_sha256(maps["fringe"])}}))
    out, check = tmp_path / "out", str(tmp_path / "check.json")
    command = ["diagnose", str(tmp_path / "study.toml"), "-o", str(out),
               "--effects", "background,block_demagnetized,gain_y,drift"]
    for wrong in (["--check", check], ["--check", f"side={check}"],
                  ["--check", f"body={check}", "--check", f"body={check}"]):
        assert main([*command, *wrong]) == 4
        assert "body, fringe" in capsys.readouterr().err
    assert main([*command, "--check", f"body={check}"]) == 4
    assert "another map" in capsys.readouterr().err
    assert main([*command, "--dry-run", "--json"]) == 0
    # a background, 16 blocks, a gain of the probe and a drift of each map
    assert json.loads(capsys.readouterr().out)["signatures"] == 1 + 16 + 1 + 2
    assert not out.exists()
    assert main([*command, "--check", f"fringe={check}"]) == 0
    found = json.loads((out / "diagnosis.json").read_text())
    (effect,) = found["effects"]
    assert (effect["effect"], effect["place"]) == ("gain_y", "probe hall")
    assert effect["maps"] == ["body", "fringe"]
    assert found["floor_T"] == {"fringe": {"Bx": 1e-5, "By": 2e-5, "Bz": 3e-5}}
    assert {group["name"] for group in found["groups"]["after"] if group["kind"] == "map"} == {
        "body", "fringe"}
    scores = {(one["part"], one["region"]) for one in found["scores"]["after"]}
    assert scores == {(part, name) for part in ("training", "held out")
                      for name in ("all", "body", "fringe")}
    page = (out / "diagnosis.html").read_text()
    for text in ("probe hall", "training, fringe", "The maps are explained by"):
        assert text in page
    diagnosed = read_study(out / "study.diagnosed.toml")
    assert list(read_maps(diagnosed, out)) == ["body", "fringe"]
    assert "# of two" in (out / "study.diagnosed.toml").read_text()
    assert len({one.instrument.gain for one in diagnosed.maps}) == 1
    (gain,) = effect["parameters"]
    assert diagnosed.of_map(1).instrument.gain[1] == gain["value"]
    assert gain["value"] == pytest.approx(GAIN, abs=4 * gain["sd"])


def empty_maps():
    return {name: field_map((points - POSES[name][1]) @ POSES[name][0].as_matrix(), 0 * points)
            for name, points in POINTS.items()}


def test_an_effect_belongs_to_a_map_or_to_the_probe():
    study = study_of("hall")
    campaign = Campaign.of(study, empty_maps())
    catalogued = {effect.name: effect for effect in catalogue()}

    def places(name):
        return [(place.name, place.maps) for place in campaign.places(catalogued[name], study)]

    assert places("mapper_roll") == [("map body", ("body",)), ("map fringe", ("fringe",))]
    assert places("drift") == places("offset_x") == places("mapper_roll")  # from day to day
    for name in ("gain_x", "misalignment_xy", "sensor_position_z", "planar_hall_x"):
        assert places(name) == [("probe hall", ("body", "fringe"))]
    assert places("background") == [("", ())]
    # maps on one stage lie wrong together, or one of them by itself
    study = study.with_(maps=tuple(one.with_(stage="table") for one in study.maps))
    campaign = Campaign.of(study, empty_maps())
    assert places("mapper_translation") == [("stage table", ("body", "fringe")),
                                            ("map body", ("body",)), ("map fringe", ("fringe",))]
    # unless it is stated, as by an overlap, how far one may have moved: that is a reading
    first, second = study.maps
    study = study.with_(maps=(first, second.with_(stage_shift_sd_m=(1e-4, 1e-4, 2e-5))))
    assert places("mapper_translation") == [("stage table", ("body", "fringe"))]
    assert len(places("mapper_tilt_x")) == 3  # which is said of shifts only
    assert places("arm_sag") == [("map body", ("body",)), ("map fringe", ("fringe",))]
    single = study.of_map(0)
    assert [place.name for place in Campaign.of(single, empty_maps()["body"]).places(
        catalogued["gain_x"], single)] == [""]
    # what is applied, and what is seen
    for name in ("mapper_roll", "gain_x"):
        place = campaign.places(catalogued[name], study)[-1]
        hypothesis = Hypothesis(catalogued[name], place)
        changed = hypothesis.apply(study, [0.01])
        for number, one in enumerate(study.maps):
            same = changed.of_map(number).instrument == study.of_map(number).instrument
            assert same == (one.name not in place.maps)
        shown = np.abs(campaign.scene(study).signature(hypothesis)).max(axis=(0, 2))
        assert [shown[:len(POINTS["body"])].any(), shown[len(POINTS["body"]):].any()] == [
            "body" in place.maps, "fringe" in place.maps]


@pytest.mark.parametrize("effect", [one for one in catalogue() if one.kind == "instrument"
                                    and not one.of_total_field],  # these maps have components
                         ids=lambda effect: effect.name)
def test_signatures_hold_at_the_pose_of_a_map(effect):
    """Against the law of the instrument, of a stage upside down and half a magnet away."""
    study, maps = study_of(), empty_maps()
    if effect.name == "lag":  # of a stage that goes to and fro
        maps = {name: data.isel(point=np.concatenate([
            line[::(-1) ** number] for number, line in enumerate(
                np.arange(data.sizes["point"]).reshape(25, -1))])) for name, data in maps.items()}
    campaign, blocks = Campaign.of(study, maps), build_magnet(study).blocks
    place = campaign.places(effect, study)[-1]
    hypothesis = Hypothesis(effect, place)

    def shown(changed):
        found = []
        for one in campaign.maps:
            instrument = one.study_of(changed).instrument
            used = sensor_model(instrument, one.points)
            linear = (used.operator @ field_of(blocks, used.points).ravel()).reshape(-1, 3)
            found.append(with_memory(
                instrument, linear + nonlinear_part(instrument, linear, one.time), one.time))
        return np.concatenate(found)

    signature = campaign.scene(study).signature(hypothesis)
    for number, parameter in enumerate(effect.parameters):
        step = parameter.sd * (0.001 if effect.name in ("wrong_line", "wrong_radius") else 0.02)
        values = step * np.eye(len(effect.parameters))[number]
        change = shown(hypothesis.apply(study, values.tolist())) - shown(study)
        # what is not linear, as in the test of a mapper along the magnet's axes
        assert np.abs(change - step * signature[number]).max() < 1e-2 * np.abs(change).max()
        assert not signature[number][:len(POINTS["body"])].any()


def test_gross_errors_of_one_map(generator):
    magnet_of, study = truth(generator), study_of()
    maps = two_maps(generator, magnet_of)
    assert correct_map_errors(study, maps, None, SOME) == ((), study, ())  # negative control
    milli = field_map(points_of(maps["fringe"]), 1e3 * maps["fringe"]["B_T"].values)
    (error,), corrected, starts = correct_map_errors(study, maps | {"fringe": milli}, None, SOME)
    assert (error.map, error.names) == ("fringe", ("millitesla",))
    assert error.text.startswith("map fringe: ")
    assert corrected.maps[0] == study.maps[0]
    assert corrected.of_map(1).instrument.flux_density_unit_T == 1e-3
    assert not starts
    # a map that is centimetres off starts the search, with its name
    away = field_map(np.add(points_of(maps["fringe"]), [0.0, 0.012, 0.0]),
                     maps["fringe"]["B_T"].values)
    line = [one for one in catalogue() if one.name == "wrong_line"]
    errors, _, starts = correct_map_errors(study, maps | {"fringe": away}, None, line)
    assert errors == ()
    assert {effect.name for start in starts for effect in start} == {"wrong_line map fringe"}


def test_one_map_of_another_magnet_is_refused(generator):
    """Turned by two blocks: the other map shows that the magnet is not."""
    magnet_of, study = truth(generator), study_of()
    maps = two_maps(generator, magnet_of)
    magnet_of.rotate_from_angax(90.0, "z", anchor=0)
    with pytest.raises(MeasurementError, match=r"'fringe'.*same magnet"):
        correct_map_errors(study, maps | {"fringe": two_maps(generator, magnet_of)["fringe"]},
                           None, SOME)
    # of a magnet that is turned itself, both maps agree
    errors, corrected, _ = correct_map_errors(study, two_maps(generator, magnet_of), None, SOME)
    assert len(errors) == 1
    assert corrected.array != study.array
