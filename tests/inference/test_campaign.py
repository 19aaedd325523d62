"""Two maps of one magnet that magpylib computed, each with a probe and a pose of its own."""

from __future__ import annotations

import json
import re
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy import stats
from scipy.spatial.transform import Rotation

from halbach_fe.cli import main
from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.geometry.array_layout import position_angle_deg
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference import infer as infer_module
from halbach_fe.inference.infer import infer
from halbach_fe.inference.posterior_files import inference_summary
from halbach_fe.inference.registration import contradictions
from halbach_fe.measurement.campaign_maps import maps_of, read_maps
from halbach_fe.measurement.field_map import field_map, write_map
from halbach_fe.measurement.map_join import MapPose
from halbach_fe.measurement.observation_operator import concatenate, observe
from halbach_fe.report.inference_answer import answer
from halbach_fe.response.block_variation import Deviations
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import root_matrix
from halbach_fe.study.materials import MU_0
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.reader import parse_study, read_study
from tests.support.short_dipole import (
    BODY,
    FRINGE,
    NOISE_T,
    TEXT,
    campaign_study,
    measured,
    polarization_of,
    reading,
    truth,
)

POSES = {"body": (Rotation.from_rotvec([0.004, -0.003, 0.006]), np.array([3e-4, -2e-4, 5e-4])),
         "fringe": (Rotation.from_rotvec([-0.005, 0.004, 0.002]), np.array([-4e-4, 3e-4, 0.0503]))}
"""A stage has coordinates s; the place in the magnet is turn s + shift."""

MIXING = np.eye(3) + np.array([[0, 0.004, 0], [0, 0.003, -0.005], [0.002, 0, 0]])
"""Crosstalk, and 0.3 % more gain of By."""


def two_maps(generator, magnet_of=None, other=None, mixing=None):
    """Maps of a magnet, the second one perhaps of another."""
    magnet_of = magnet_of or truth(generator)
    return {"body": reading(magnet_of, generator, BODY, POSES["body"], mixing),
            "fringe": reading(other or magnet_of, generator, FRINGE, POSES["fringe"], mixing)}


def terms(result):
    """Change and standard deviation of each term."""
    return dict(zip(result.terms.names, zip(result.terms.change, result.terms.sd, strict=True),
                    strict=True))


def test_two_maps_find_their_poses_and_agree(generator, tmp_path):
    result = infer(build_magnet(campaign_study()), two_maps(generator), Session.open(tmp_path))
    assert result.terms.at_rest
    found = terms(result)
    for name, points, start in (("body", BODY, [0, 0, 0]), ("fringe", FRINGE, [0, 0, 0.05])):
        turn, shift = POSES[name]
        stated = (points - shift) @ turn.as_matrix()
        middle = (stated.min(axis=0) + stated.max(axis=0)) / 2
        right = turn.apply(middle) + shift - middle - start
        for number, axis in enumerate("xyz"):
            value, sd = found[f"{name}.translation_{axis}_m"]
            assert value == pytest.approx(right[number], abs=4 * sd)
            assert sd < 1e-4
            value, sd = found[f"{name}.rotation_{axis}_rad"]
            assert value == pytest.approx(turn.as_rotvec()[number], abs=4 * sd)
    assert not result.disagreement
    assert {(each.name, each.by) for each in result.overlaps} == {
        ("fringe", "body"), ("body", "fringe")}
    for each in result.overlaps:
        assert each.held_out
        assert each.readings > 40
        assert each.chi2 == pytest.approx(1.0, abs=5 * np.sqrt(2 / each.readings))
    assert [each.name for each in result.regions_left_out] == ["body", "fringe"]
    for left in result.regions_left_out:
        assert left.readings > 500
        assert left.noise_T < left.allowed_T
        assert 0.3 < left.rms_T / left.allowed_T < 2  # of a few blocks that the others hardly see
        assert left.chi2 == pytest.approx(1.0, abs=5 * np.sqrt(2 / left.readings))
        assert not left.disagreement
    assert {score.region for score in result.scores} == {"body", "fringe"}
    for score in result.scores:
        if score.part == "held out":
            assert score.chi2_posterior == pytest.approx(1.0, abs=5 * np.sqrt(2 / score.readings))
    # the strongest reading is said where it lies, with the error of the pose that was found
    said = re.search(r"at \((.*?)\) mm of the magnet", answer(result).said)[1]
    place, sd = (1e-3 * np.array(each) for each in zip(*(
        map(float, part.split("\xa0±\xa0")) for part in said.split(", ")),
        strict=True))
    away = np.abs(np.vstack([BODY, FRINGE]) - place)
    assert (away[np.argmin(away.sum(axis=1))] < 4 * sd).all()
    assert ((sd > 1e-7) & (sd < 2e-4)).all()
    # the study that is returned has the poses that were found
    fringe = result.study.maps[1].instrument
    assert Rotation.from_rotvec(fringe.rotation_rad).as_matrix() == pytest.approx(
        POSES["fringe"][0].as_matrix(), abs=1e-3)


def distance_of_truth(result, magnet_of):
    """The squared distance of magpylib's magnetizations from the posterior, in its covariance."""
    right = np.empty_like(result.posterior.mean).reshape(-1, 3)
    for number, block in enumerate(result.magnet.blocks):
        centre = np.mean([block.z_min, block.z_max])
        angle = position_angle_deg(result.study.array, block.slot)
        (source,) = [each for each in magnet_of.sources if np.isclose(each.position[2], centre)
                     and abs((np.degrees(np.arctan2(*each.position[1::-1])) - angle + 180)
                             % 360 - 180) < 1]
        right[number] = polarization_of(source) / MU_0
    error = result.posterior.mean - right.ravel()
    root = root_matrix(result.posterior.root)
    covariance = np.asarray((root @ root.T).todense() if sparse.issparse(root) else root @ root.T)
    return error @ np.linalg.solve(covariance, error)


IN_PROPORTION = stats.chi2(48).ppf([1e-4, 1 - 1e-4])
"""Where the distance of 48 values lies but in one of 5000 cases."""


def test_both_maps_say_more_than_one_and_cover_the_truth(generator, tmp_path):
    magnet_of = truth(generator)
    maps, study = two_maps(generator, magnet_of), campaign_study()
    magnet = build_magnet(study)
    both = infer(magnet, maps, Session.open(tmp_path / "both"))
    low, high = IN_PROPORTION
    assert low < distance_of_truth(both, magnet_of) < high
    for number, name in enumerate(maps):
        one = infer(magnet.with_study(study.of_map(number)), maps[name],
                    Session.open(tmp_path / name))
        assert (both.posterior.sd <= one.posterior.sd * (1 + 1e-6)).all()
        assert both.posterior.sd.mean() < 0.95 * one.posterior.sd.mean()
        assert not one.is_campaign
        assert not one.overlaps


def test_large_deviations_turn_the_gradient_too(generator, tmp_path, monkeypatch):
    """Blocks that differ by 20 %: at the same time the poses are wrong by half a millimetre."""
    magnet_of = truth(generator, magnitude=0.2)
    study = campaign_study()
    study = study.with_(prior=study.prior.with_(magnitude_sd=0.2, direction_sd_deg=3.0))
    maps, magnet = two_maps(generator, magnet_of), build_magnet(study)
    low, high = IN_PROPORTION
    result = infer(magnet, maps, Session.open(tmp_path / "updated"))
    assert result.terms.at_rest
    assert low < distance_of_truth(result, magnet_of) < high
    # negative control: the gradient of the nominal magnet
    monkeypatch.setattr(Deviations, "field", lambda self, deviations, points: 0 * points)
    nominal = infer(magnet, maps, Session.open(tmp_path / "nominal"))
    assert distance_of_truth(nominal, magnet_of) > high


def test_readings_are_solved_for_where_the_sensors_are(generator, tmp_path, monkeypatch):
    """Control: only the nominal field moves, and what the last update found of the deviations.

    Then the next deviations act where the sensors were, and the terms chase what they do.
    """
    maps, magnet = two_maps(generator, mixing=MIXING), build_magnet(stage_study("table"))
    assert infer(magnet, maps, Session.open(tmp_path / "solved")).terms.at_rest
    monkeypatch.setattr(infer_module._Solved, "neglected", lambda *arguments: 0.0)
    with pytest.raises(HalbachWarning, match="not come to rest"):
        infer(magnet, maps, Session.open(tmp_path / "control"))


def test_changes_of_terms_that_are_too_large_are_halved(generator, tmp_path, monkeypatch):
    """Derivatives of 0.45 of their size make changes 2.2 times too large.

    Control: taken as they are, each is 1.2 times the one before, until readings lie in blocks.
    """
    columns = infer_module.OpenTerms.columns
    monkeypatch.setattr(infer_module.OpenTerms, "columns",
                        lambda self, *arguments: 0.45 * columns(self, *arguments))
    maps, magnet = two_maps(generator), build_magnet(campaign_study())
    said: list[str] = []
    halved = infer(magnet, maps, Session.open(tmp_path / "halved"), say=said.append)
    assert halved.terms.at_rest
    assert said[0].startswith("update 1, of at most 16: the terms of the instruments change by up")
    assert any("of which 50 % are taken" in line for line in said)
    found = terms(halved)
    for name, (turn, _) in POSES.items():
        for axis, right in zip("xyz", turn.as_rotvec(), strict=True):
            value, sd = found[f"{name}.rotation_{axis}_rad"]
            assert value == pytest.approx(right, abs=4 * sd)
    monkeypatch.setattr(infer_module, "NO_WORSE", np.inf)
    with pytest.raises(MeasurementError, match="inside magnet"):
        infer(magnet, maps, Session.open(tmp_path / "control"))


def test_terms_that_wander_within_their_bars_are_at_rest(generator, tmp_path, monkeypatch):
    """Derivatives of half their size make every change twice too large: terms that are nearly right
    go to and fro for ever, and the readings do not tell which is better.

    Controls: without the rule of `LEVEL` they never rest, and far from the truth they are no rest.
    """
    maps = two_maps(generator)
    near = infer(build_magnet(campaign_study()), maps, Session.open(tmp_path / "near"))
    columns = infer_module.OpenTerms.columns
    monkeypatch.setattr(infer_module.OpenTerms, "columns",
                        lambda self, *arguments: 0.5 * columns(self, *arguments))
    monkeypatch.setattr(infer_module, "AT_REST", 1e-4)
    monkeypatch.setattr(infer_module, "ROUNDS", 5)

    def wandering(magnet, folder):
        return infer(magnet, maps, Session.open(tmp_path / folder)).terms.at_rest

    assert wandering(build_magnet(near.magnet.study), "wandering")
    with pytest.warns(HalbachWarning, match="not come to rest"):
        assert not wandering(build_magnet(campaign_study()), "far")
    monkeypatch.setattr(infer_module, "LEVEL", np.inf)
    with pytest.warns(HalbachWarning, match="not come to rest"):
        assert not wandering(build_magnet(near.magnet.study), "never")


def test_one_probe_is_estimated_from_both_maps(generator, tmp_path):
    maps = two_maps(generator, mixing=MIXING)
    open_terms = {"crosstalk": 0.02, "gain": 0.003}
    shared = infer(build_magnet(campaign_study("hall", **open_terms)), maps,
                   Session.open(tmp_path / "shared"))
    apart = infer(build_magnet(campaign_study(**open_terms)), maps,
                  Session.open(tmp_path / "apart"))
    one, two = terms(shared), terms(apart)
    assert "fringe.crosstalk_yz" in two
    assert "fringe.crosstalk_yz" not in one
    for pair in ("xy", "xz", "yx", "yz", "zx", "zy"):
        value, sd = one[f"hall.crosstalk_{pair}"]
        row, column = ("xyz".index(letter) for letter in pair)
        assert value == pytest.approx(MIXING[row, column], abs=4 * sd)
        alone = [two[f"{name}.crosstalk_{pair}"][1] for name in maps]
        assert sd <= min(alone) * 1.001
    assert not shared.disagreement
    for each in (*shared.overlaps, *apart.overlaps):
        assert each.chi2 < each.limit
    # control: with a probe that is known for exact, the maps do not fit
    closed = infer(build_magnet(campaign_study()), maps, Session.open(tmp_path / "closed"))
    assert closed.prior_conflict > closed.conflict_limit


def test_a_map_of_another_magnet_is_told(generator, tmp_path):
    """Control: the second map is of a magnet whose blocks have other errors."""
    maps = two_maps(generator, truth(generator), truth(generator))
    result = infer(build_magnet(campaign_study()), maps, Session.open(tmp_path))
    for each in result.overlaps:
        assert each.chi2 > 10 * each.limit
        assert "not of the same magnet" in each.disagreement
    assert "not of the same magnet" in result.disagreement
    assert all("left out, is predicted by the others" in each.disagreement
               for each in result.regions_left_out)


@pytest.mark.parametrize("stretch", [1.0, 1.03])
def test_the_ends_of_a_single_map_are_left_out(generator, tmp_path, stretch):
    """Control: rings are 3 % longer than the study says, which the middle does not show."""
    turn, shift = Rotation.identity(), np.array([0.0, 0.0, -0.045])
    data = measured(truth(generator, stretch=stretch), generator, turn, shift)
    study = parse_study(tomllib.loads(TEXT + "[instrument]\ntranslation_m = [0, 0, -0.045]"))
    result = infer(build_magnet(study), data, Session.open(tmp_path))
    (left,) = result.regions_left_out
    assert left.name == ""
    assert left.readings == 25 * 6 * 3  # of 16 places along z, three at each end
    right = stretch == 1.0
    assert (left.chi2 == pytest.approx(1.0, abs=5 * np.sqrt(2 / left.readings))) == right
    assert (left.rms_T < 2 * left.allowed_T) == right
    assert (not left.disagreement) == right
    assert answer(result).sound == right
    assert (left.in_words in answer(result).trust) == right or left.disagreement in (
        result.disagreement)
    summary = inference_summary(result)["regions_left_out"]
    assert summary[0]["over_noise"] == pytest.approx(left.rms_T / left.noise_T)
    ends = left.stretches
    assert {one.axis for one in ends} == {"z"}
    assert sum(one.readings for one in ends) == left.readings
    assert sum(one.readings * one.rms_T**2 for one in ends) == pytest.approx(
        left.readings * left.rms_T**2)
    assert summary[0]["stretches"][0]["over_noise"] == pytest.approx(ends[0].over_noise)
    if right:
        assert left.worst is None
        assert "the worst" not in left.in_words
    else:  # the field is steepest where the magnet ends, at 45 mm
        assert left.worst is not None
        assert min(abs(abs(end) - 0.045) for end in (left.worst.from_m, left.worst.to_m)) < 0.02
        assert f"times at {left.worst.where} of the magnet" in left.in_words


def test_a_sensor_out_of_place_in_one_map_only(generator):
    """Readings of both know their own sensors: the magnitude of the field is taken there."""
    study = campaign_study().with_(maps=())
    probe = Instrument(sensor_position_m=((0, 0, 1e-3), (0, 0, 0), (0, 0, -1e-3)))
    apart = study.with_(instrument=probe)
    every = np.ones((10, 3), bool)
    one, two = observe(apart, BODY[:10], every), observe(study, FRINGE[:10], every)
    fields = [generator.standard_normal(each.points.shape) for each in (one, two)]
    both = concatenate(one, two)
    assert both.magnitude(np.vstack(fields)) == pytest.approx(
        np.linalg.norm(np.vstack([fields[0], np.repeat(fields[1], 3, axis=0)]), axis=1))
    assert both.places[:3] == pytest.approx(BODY[0] + np.outer([1e-3, 0, -1e-3], [0, 0, 1]))


def test_sensors_whose_places_are_uncertain(generator, tmp_path):
    """One sensor is 2 mm out of place, with the map where it is said to be, by magpylib."""
    source = truth(generator)
    places = [BODY + np.array([0.002, 0, 0]), BODY, BODY]
    field = np.stack([source.getB(points)[:, axis] for axis, points in enumerate(places)], axis=1)
    data = field_map(BODY, field + NOISE_T * generator.standard_normal(field.shape))
    study = campaign_study().with_(maps=(), instrument_sd={"sensor_position_m": 2e-3})
    result = infer(build_magnet(study), data, Session.open(tmp_path))
    found = {name.split(".")[-1]: value for name, value in terms(result).items()}
    for sensor, apart in zip("xyz", np.array([2, 0, 0]) - 2 / 3, strict=True):
        change, sd = found[f"sensor_{sensor}_x_m"]
        assert abs(change - 1e-3 * apart) < 4 * sd
        assert sd < 2e-4
    common, sd = found["translation_x_m"]  # what all have in common is a shift of the map
    assert abs(common - 2e-3 / 3) < 4 * sd
    assert result.disagreement == ""


def test_turns_after_each_other():
    """What a result states as the change of a turn is that of its rotation vector: the sum of two
    turns was off by 2 mrad, 300 of its bars. All other terms add up.
    """
    study = campaign_study().with_(maps=(), instrument_sd={
        "translation_m": 3e-3, "rotation_rad": 0.05, "gain": 0.01})
    maps = maps_of(study, field_map(BODY, np.ones_like(BODY)))
    open_terms = infer_module.OpenTerms.of(maps)
    one = np.array([1e-3, 0, 0, 0.02, -0.03, 0.01, 0.01, 0, 0])
    two = np.array([0, 2e-3, 0, 0.01, 0.03, 0.05, 0.01, 0, 0])
    both = open_terms.together(one, two)
    found = open_terms.applied(open_terms.applied(maps, one), two)[0].study.instrument
    assert both[3:6] == pytest.approx(found.rotation_rad, abs=1e-12)
    assert np.abs(one + two - both)[3:6].max() > 5e-4  # the control
    assert (one + two - both)[[0, 1, 2, 6, 7, 8]] == pytest.approx(0, abs=1e-15)


def campaign_file(folder, maps, extra=""):
    """A study file that lists two maps, which are written beside it."""
    for name, data in maps.items():
        write_map(data, folder / f"{name}.csv")
    path = folder / "campaign.toml"
    path.write_text(f"""{TEXT}
[instrument_sd]
translation_m = 1e-3
rotation_rad = 0.01

[[maps]]
name = "body"
file = "body.csv"        # the bore
{extra}
[[maps]]
name = "fringe"
file = "fringe.csv"
""")
    return path


def test_maps_are_registered_and_update_the_magnet_together(generator, tmp_path, capsys):
    path = campaign_file(tmp_path, two_maps(generator))
    registered = tmp_path / "out" / "study.registered.toml"
    assert main(["register", str(path), "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert "Map fringe:" in said
    assert "as the maps before have updated it" in said
    for name in ("body", "fringe"):
        page = (tmp_path / "out" / name / "registration.html").read_text()
        assert f"Where does map {name} lie" in page
    study = read_study(registered)
    assert "# the bore" in registered.read_text()  # comments stay
    assert list(read_maps(study, registered.parent)) == ["body", "fringe"]
    # the magnet looks almost the same from both ends, but the maps must agree on one
    (turn, shift), (_, other) = POSES.values()
    one, two = (each.instrument for each in study.maps)
    apart = np.array(two.translation_m) - one.translation_m
    assert Rotation.from_rotvec(one.rotation_rad).inv().apply(apart) == pytest.approx(
        turn.inv().apply(other - shift), abs=5e-4)
    assert main(["infer", str(registered), "-o", str(tmp_path / "inferred")]) == 0
    assert "they agree" in capsys.readouterr().out
    summary = json.loads((tmp_path / "inferred" / "summary.json").read_text())
    assert not summary["disagreement"]
    assert summary["instrument_at_rest"]
    page = (tmp_path / "inferred" / "report.html").read_text()
    for text in ("Do the maps agree?", "The instruments", "Map fringe."):
        assert text in page
    updated = tmp_path / "inferred" / "study.updated.toml"
    again = infer(build_magnet(read_study(updated)), read_maps(read_study(updated), updated.parent),
                  Session.open(tmp_path / "again"))
    assert (np.abs(again.terms.change) < 0.3 * again.terms.sd).all()
    assert main(["multipoles", str(path), "--posterior", str(tmp_path / "inferred/posterior.h5"),
                 "-o", str(tmp_path / "multipoles")]) == 0


@pytest.mark.parametrize(("extra", "sentence"), [
    ("colour = 1", "must be a known key"),
    ("probe = 'hall'", None),
])
def test_keys_of_maps(generator, tmp_path, extra, sentence):
    path = campaign_file(tmp_path, two_maps(generator), extra)
    if sentence is None:
        assert read_study(path).maps[0].probe == "hall"
        return
    with pytest.raises(StudyError, match=sentence):
        read_study(path)


def test_bad_campaigns_get_a_sentence(generator, tmp_path, capsys):
    maps = two_maps(generator)
    path = campaign_file(tmp_path, maps)
    study = read_study(path)
    for option in (["--alternative", "array.remanence_T=0.02"], ["--most", "1"],
                   ["--across-m", "0.01"], ["--turn-rad", "0.02"]):
        assert main(["register", str(path), "-o", str(tmp_path / "x"), *option]) == 3
        assert f"{option[0]} of the command line must be left out" in " ".join(
            capsys.readouterr().err.split())
    write_map(maps["body"], tmp_path / "fringe.csv")
    with pytest.raises(MeasurementError, match="same readings"):
        read_maps(study, tmp_path)
    (tmp_path / "fringe.csv").unlink()
    with pytest.raises(MeasurementError, match=r"fringe\.csv"):
        read_maps(study, tmp_path)
    assert main(["infer", str(path), "-o", str(tmp_path / "x")]) == 4
    assert not (tmp_path / "x").exists()
    twice = path.read_text().replace('file = "fringe.csv"', 'file = "body.csv"')
    with pytest.raises(StudyError, match="a file of its own"):
        parse_study(tomllib.loads(twice))
    assert main(["infer", str(path), "--measurements", str(tmp_path / "body.csv"),
                 "-o", str(tmp_path / "x")]) == 3
    assert "Leave --measurements out" in capsys.readouterr().err
    (tmp_path / "single.toml").write_text(TEXT)
    assert main(["infer", str(tmp_path / "single.toml"), "-o", str(tmp_path / "x")]) == 3
    assert "Add --measurements" in capsys.readouterr().err
    with pytest.raises(StudyError, match="the only maps of the campaign"):
        diagnose(study, maps["body"], Session.open(tmp_path / "d"))
    with pytest.raises(StudyError, match="those that are given, by name"):
        maps_of(study, {"body": maps["body"]})
    with pytest.raises(StudyError, match=r"the same instrument\.gain"):
        parse_study(tomllib.loads(TEXT) | {"maps": [
            {"name": "one", "file": "1.csv", "probe": "p"},
            {"name": "two", "file": "2.csv", "probe": "p",
             "instrument": {"gain": [0.01, 0, 0]}}]})
    with pytest.raises(StudyError, match="3D"):
        flat = tomllib.loads(TEXT) | {"dimension": 2, "instrument_sd": {"gain": 0.01}}
        flat["array"] = {key: value for key, value in flat["array"].items() if key != "rings"}
        parse_study(flat)


def stage_study(name, shift=(0, 0, 0.005)):
    """The study of two maps by one probe; ``name`` is that of their common stage, if any."""
    known = {"translation_m": 2e-3, "rotation_rad": 0.01, "crosstalk": 0.02, "gain": 0.003}
    shared = {"probe": "hall"} | ({"stage": name} if name else {})
    return parse_study(tomllib.loads(TEXT) | {"instrument_sd": known, "maps": [
        {"name": "body", "file": "body.csv"} | shared,
        {"name": "fringe", "file": "fringe.csv", "instrument": {"translation_m": [0, 0, 0.05]}}
        | shared | ({"stage_shift_sd_m": shift} if name else {})]})


SHIFTED = (POSES["body"][0], POSES["body"][1] + POSES["body"][0].apply([0, 0, 0.0513]))
"""Pose of a second map on the stage of the first: its origin was set 1.3 mm further on than the
study says."""


def test_maps_on_one_stage_know_their_poses_better(generator, tmp_path, monkeypatch):
    monkeypatch.setitem(POSES, "fringe", SHIFTED)
    maps = two_maps(generator, mixing=MIXING)
    shared, apart = (infer(build_magnet(stage_study(name)), maps,
                           Session.open(tmp_path / str(name))) for name in ("table", None))
    found = terms(shared)
    assert not any(name.startswith("fringe.translation") for name in found)
    value, sd = found["fringe.stage_shift_z_m"]
    assert value == pytest.approx(1.3e-3, abs=4 * sd)
    assert not shared.disagreement
    ratios = []
    for one, other in zip(shared.terms.poses, apart.terms.poses, strict=True):
        turn, shift = POSES[one.name]
        stated = ({"body": BODY, "fringe": FRINGE}[one.name] - shift) @ turn.as_matrix()
        right = turn.apply((stated.min(axis=0) + stated.max(axis=0)) / 2) + shift
        score = (np.array(one.middle_m) - right) / one.middle_sd_m
        assert np.abs(score).max() < 4
        ratios += np.divide(one.middle_sd_m + one.turn_sd_rad,
                            other.middle_sd_m + other.turn_sd_rad).tolist()
    assert max(ratios) < 1.01
    assert min(ratios) < 0.8  # the turn of the short map is that of the long one


def test_maps_that_are_not_on_one_stage_disagree(generator, tmp_path):
    """Control: the second map is turned by 9 mrad against the first."""
    result = infer(build_magnet(stage_study("table")), two_maps(generator, mixing=MIXING),
                   Session.open(tmp_path))
    assert result.disagreement


@pytest.mark.parametrize(("sd_m", "contradicts"), [(2e-5, True), (4e-4, False)])
def test_where_a_map_lies_in_an_uncertain_frame(sd_m, contradicts):
    """The bar of the frame's own place is in the comparison with what the overlap says."""
    exact = np.full(3, 1e-6)
    frame = SimpleNamespace(instrument=Instrument(), middle_m=np.zeros(3),
                            translation_sd_m=np.full(3, sd_m), rotation_sd_rad=exact)
    best = SimpleNamespace(instrument=Instrument(translation_m=(0.0, 0.0, 4e-4)),
                           translation_sd_m=exact, rotation_sd_rad=exact)
    known = MapPose("fringe", np.zeros(3), np.zeros(3), exact, np.zeros(3), exact, 1)
    assert [one.name for one in contradictions(best, known, frame)] == (
        ["along_z"] if contradicts else [])


def test_a_campaign_on_one_stage_is_registered(generator, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(POSES, "fringe", SHIFTED)
    path = campaign_file(tmp_path, two_maps(generator), "stage = 'table'\n")
    path.write_text(path.read_text() + "stage = 'table'\nstage_shift_sd_m = [0, 0, 5e-3]\n")
    assert main(["register", str(path), "-o", str(tmp_path / "out")]) == 0
    body, fringe = (one.instrument for one in read_study(
        tmp_path / "out" / "study.registered.toml").maps)
    turn = Rotation.from_rotvec(body.rotation_rad)
    assert fringe.rotation_rad == pytest.approx(body.rotation_rad, abs=1e-12)
    assert turn.inv().apply(np.subtract(fringe.translation_m, body.translation_m)) == (
        pytest.approx([0, 0, 0.0513], abs=2e-4))
    # where the overlap of both maps has the second one, which the registration need not believe
    at = (FRINGE - SHIFTED[1]) @ SHIFTED[0].as_matrix()
    for off_m in (0.0, 4e-4):
        overlap = {"frame": "body", "poses": [{
            "name": "fringe", "middle_m": ((at.min(axis=0) + at.max(axis=0)) / 2).tolist(),
            "shift_m": [0.0, 0.0, 0.0513 + off_m], "shift_sd_m": [1e-4, 1e-4, 2e-5],
            "rotation_rad": [0.0] * 3, "rotation_sd_rad": [1e-3] * 3, "sign": 1}]}
        (tmp_path / "joined.json").write_text(json.dumps(overlap))
        capsys.readouterr()
        assert main(["register", str(path), "-o", str(tmp_path / "joined"), "--joined",
                     str(tmp_path / "joined.json")]) == 0
        said = " ".join(capsys.readouterr().err.split())
        _, fringe = read_study(tmp_path / "joined" / "study.registered.toml").maps
        assert fringe.stage_shift_sd_m == (1e-4, 1e-4, 2e-5)
        place = turn.inv().apply(np.subtract(fringe.instrument.translation_m, body.translation_m))
        assert place == pytest.approx([0, 0, 0.0513 + off_m], abs=1e-6)
        assert ("from where its overlap with the other maps has it" in said) == bool(off_m)
        best, *_ = json.loads((tmp_path / "joined" / "fringe" / "registration.json").read_text())[
            "poses"]
        # if there is no other overlap, the map in whose frame it lies may be the one that is wrong
        frame, *_ = json.loads((tmp_path / "joined" / "body" / "registration.json").read_text())[
            "poses"]
        for one in (best, frame):
            assert [term["name"] for term in one["apart"]] == (["along_z"] if off_m else [])
            assert one["sound"] == (not off_m)
        assert said.count("The overlap needs no magnet") == 2 * bool(off_m)
    (apart,) = best["apart"]  # the model wants the map before where the overlap has it
    assert frame["apart"][0]["value"] == -apart["value"]
    assert apart["value"] == pytest.approx(-4e-4, abs=4 * apart["prior_sd"])
    assert apart["prior_sd"] < 1e-4
    for text, sentence in (('{"frame": "body", "poses": [{"name": "x"}]}', "a joined.json that"),
                           (json.dumps(overlap | {"frame": "else"}), "at least two of its maps"),
                           (json.dumps({"frame": "fringe", "poses": [
                               overlap["poses"][0] | {"name": "body"}]}),
                            "in the frame of the first map of their stage, body")):
        (tmp_path / "joined.json").write_text(text)
        assert main(["register", str(path), "-o", str(tmp_path / "none"), "--joined",
                     str(tmp_path / "joined.json")]) in (3, 4)
        assert sentence in " ".join(capsys.readouterr().err.split())
    # control: a map whose stage was turned by a right angle about the axis
    quarter = Rotation.from_euler("z", 90, degrees=True)
    monkeypatch.setitem(POSES, "fringe", (SHIFTED[0] * quarter, SHIFTED[1]))
    write_map(two_maps(generator)["fringe"], tmp_path / "fringe.csv")
    assert main(["register", str(path), "-o", str(tmp_path / "other")]) == 4
    said = " ".join(capsys.readouterr().err.split())
    assert "turned like the one before it on the same stage; instead received turned by 90°" in said


@pytest.mark.parametrize(("keys", "sentence"), [
    ({"stage_shift_sd_m": [0, 0, 1e-3]}, "needs a stage"),
    ({"stage": "fringe"}, "has the name of a map"),
    ({"stage": "table", "instrument_sd": {"translation_m": 1e-4}},
     "must state the same instrument_sd.translation_m"),
])
def test_bad_stages(keys, sentence):
    maps = [{"name": "body", "file": "body.csv"} | keys,
            {"name": "fringe", "file": "fringe.csv"}
            | ({"stage": "table"} if keys.get("stage") == "table" else {})]
    with pytest.raises(StudyError, match=sentence):
        parse_study(tomllib.loads(TEXT) | {"maps": maps})


def test_an_amplitude_of_the_instrument_that_maps_share(generator, tmp_path):
    """Once the pose was estimated, every map had an instrument of its own, and none the offset."""
    offset_T, shift, magnet_of = 3e-3, np.array([3e-4, -2e-4, 4e-4]), truth(generator)
    maps = {name: reading(magnet_of, generator, points, (Rotation.identity(), shift))
            for name, points in (("body", BODY[::2]), ("fringe", FRINGE[::2]))}
    for one in maps.values():
        one["B_T"][:, 0] += offset_T
    magnet = build_magnet(parse_study(tomllib.loads(TEXT) | {
        "instrument_sd": {"translation_m": 1e-3},
        "uncertain": [{"name": "offset", "sd": offset_T,
                       "change": {"instrument.offset_T[1]": 1.0}}],
        "maps": [{"name": name, "file": f"{name}.csv", "stage": "stage"} for name in maps]}))
    result = infer(magnet, maps, Session.open(tmp_path))
    (_, change, sd, _), = result.amplitudes.rows()
    assert change == pytest.approx(offset_T, abs=4 * sd)
    assert sd < 1e-4  # of hundreds of readings of 2e-5 T beside a field that is as uniform
    assert result.disagreement == ""
    # the study that is returned, too, has the amplitude in both maps
    for number in range(2):
        assert [one.change for one in result.study.of_map(number).uncertain] == [
            {"instrument.offset_T[1]": 1.0}]
