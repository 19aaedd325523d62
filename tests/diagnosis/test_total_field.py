"""Diagnosis of maps of |B| alone: truth by magpylib, with and without a hidden effect."""

from __future__ import annotations

import numpy as np
import pytest

from halbach_fe.core.errors import HalbachWarning
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Hypothesis
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.synthetic.hidden_effects import parse_hidden_effect
from halbach_fe.synthetic.simulate import simulate_campaign
from tests.inference.test_total_field import study_of

OF_A_SENSOR = {"gain_x", "offset_y", "drift"}
OF_MAGNITUDE = {f"{name}_of_magnitude" for name in (
    "gain", "offset", "drift", "quadratic_nonlinearity", "cubic_nonlinearity")}
FEW = tuple(effect for effect in catalogue() if effect.name in {
    "block_displaced", "mapper_translation", *OF_A_SENSOR, *OF_MAGNITUDE})


def found_in(data, session):
    with pytest.warns(HalbachWarning, match="no gross errors are looked for"):
        return diagnose(study_of(1), data, session, effects=FEW)


def test_a_displaced_block_is_found(session):
    hidden = parse_hidden_effect("block_displaced")
    campaign = simulate_campaign(study_of(1), 7, hide=[hidden], magnitude=True)
    truth = {each["name"]: each["value"] for each in campaign.truth["effects"][0]["parameters"]}
    found = found_in(campaign.readings, session)
    (effect,) = found.identified
    assert effect.hypothesis.effect.name == "block_displaced"
    assert (effect.hypothesis.place.ring, effect.hypothesis.place.slot) == (
        truth["ring"], truth["slot"])
    # its axial part is determined; 4 sd
    assert effect.values[2] == pytest.approx(truth["z"], abs=4 * effect.sd[2])
    assert abs(truth["z"]) > 20 * effect.sd[2]
    # the map's noise is all that is left: chi² of 216 readings has an sd of 0.1
    left = found.after.readings - found.after.prediction_posterior.mean
    assert np.std(left) < 1.3e-5 < np.std(
        found.before.readings - found.before.prediction_posterior.mean)


def test_a_clean_map_with_a_spike(session):
    """Nothing is found, and the reading that is 1 mT off is left out."""
    data = simulate_campaign(study_of(1), 8, magnitude=True).readings
    data["Babs_T"].values[100] += 1e-3
    found = found_in(data, session)
    assert not found.identified
    assert [(one.row, one.component) for one in found.outliers] == [(101, "abs")]
    assert found.outliers[0].off_T == pytest.approx(1e-3, abs=1e-4)


def test_a_probe_of_the_magnitude_has_no_sensors():
    """Effects of one of three sensors are no candidates; of a map of components they are."""
    for magnitude in (True, False):
        data = simulate_campaign(study_of(1), 8, magnitude=magnitude).readings
        campaign = Campaign.of(study_of(1), data)
        possible = {effect.name for effect in FEW if campaign.places(effect, study_of(1))}
        assert possible == {effect.name for effect in FEW} - (
            OF_A_SENSOR if magnitude else OF_MAGNITUDE)


def test_a_planar_hall_effect_needs_all_components():
    """A map that reads x alone cannot be corrected for it."""
    effect = next(one for one in catalogue() if one.name == "planar_hall_x")
    data = simulate_campaign(study_of(1), 8).readings
    assert Campaign.of(study_of(1), data).places(effect, study_of(1))
    data["B_T"].values[:, 1:] = np.nan
    assert not Campaign.of(study_of(1), data).places(effect, study_of(1))


def test_the_probe_of_the_magnitude_drifts(session):
    data = simulate_campaign(study_of(1), 8, magnitude=True).readings
    count = data.sizes["point"]
    data["Babs_T"].values[:] += 4e-4 * np.arange(count) / (count - 1)
    (effect,) = found_in(data, session).identified
    assert effect.hypothesis.effect.name == "drift_of_magnitude"
    assert effect.values[0] == pytest.approx(4e-4, abs=4 * effect.sd[0])
    assert effect.sd[0] < 4e-5


@pytest.mark.parametrize("name", sorted(OF_MAGNITUDE))
def test_signatures_of_the_probe_are_those_of_its_number(name):
    """Along the field, which is what |B| shows."""
    study = study_of(1)
    scene = Campaign.of(study, simulate_campaign(study, 8, magnitude=True).readings).scene(study)
    (effect,) = (effect for effect in FEW if effect.name == name)
    size = np.linalg.norm(scene.field, axis=1)
    expected = {"gain": size, "offset": np.ones_like(size), "drift": scene.fields[0].time,
                "quadratic_nonlinearity": size**2, "cubic_nonlinearity": size**3}[
                    name.removesuffix("_of_magnitude")]
    shown = scene.signature(Hypothesis(effect, effect.places(study)[0]))[0]
    np.testing.assert_allclose(np.sum(shown * scene.field, axis=1) / size, expected, rtol=1e-5,
                               atol=1e-12)


def test_a_slow_probe_remembers_one_number():
    """It lags behind |B|: the part of the field before that is along the field now is another."""
    study = study_of(1)
    campaign = Campaign.of(study, simulate_campaign(study, 8, magnitude=True).readings)
    (slow,) = (effect for effect in catalogue() if effect.name == "slow_readings")
    place = campaign.places(slow, study)[0]  # of the reading before
    scene = campaign.scene(study)
    shown = scene.signature(Hypothesis(slow, place))[0]
    size = np.linalg.norm(scene.field, axis=1)
    along = scene.field / size[:, None]
    expected = np.append(0.0, size[:-1] - size[1:])
    np.testing.assert_allclose(np.sum(shown * along, axis=1), expected, atol=1e-9)
    other = np.sum(scene.field[:-1] * along[1:], axis=1) - size[1:]  # the control
    assert np.abs(other - expected[1:]).max() > 1e-4
