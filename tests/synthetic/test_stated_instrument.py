"""The instrument that a study states makes the map, and its correction finds the field again."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from halbach_fe.api import simulate_measurement
from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError
from halbach_fe.measurement.field_map import is_total_field, points_of, read_map
from halbach_fe.measurement.probe_law import (
    in_si_and_magnet_axes,
    nonlinear_part,
    sensor_model,
    sensor_positions,
    with_memory,
)
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.hidden_effects.instrument_effects import stated_places, stated_readings
from halbach_fe.synthetic.simulate import simulate_campaign

STATED = {
    "translation_m": [0.001, -0.002, 0.003], "rotation_rad": [0.02, -0.01, 0.03],
    "z_scale": 0.01, "radius_scale": -0.02, "radius_offset_m": 3e-4,
    "eccentricity_m": [2e-4, -1e-4], "arm_sag_m": 5e-4, "lag_m": 1e-4,
    "sensor_position_m": [[0, 0.002, 0], [0.001, 0, 0], [0, -0.002, 0.001]],
    "gain": [0.01, -0.02, 0.03], "crosstalk": {"xy": 0.004, "zx": -0.006},
    "planar_hall_per_T": [0.01, 0.02, -0.03], "quadratic_per_T": [0.01, 0.0, 0.02],
    "cubic_per_T2": [0.02, -0.01, 0.0], "offset_T": [1e-4, 2e-4, -3e-4],
    "drift_T": [1e-4, -1e-4, 2e-4], "gain_drift": 2e-3, "memory": 0.02}


def field(points):
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([0.3 + 2 * x - z, 0.1 * y + z**2, 0.2 - x * y * 30], axis=-1)


@pytest.mark.parametrize("keys", [
    *[[key] for key in STATED], list(STATED), ["memory", "memory_rows"]])
def test_it_is_what_the_correction_undoes(keys):
    """Two ways of writing the law of `Instrument`: they agree to rounding."""
    angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    points = np.concatenate([np.column_stack(
        [0.02 * np.cos(angle), 0.02 * np.sin(angle), np.full(8, z)]) for z in (-0.03, 0.0, 0.04)])
    instrument = Instrument.model_validate({key: (STATED | {"memory_rows": 3.0})[key]
                                            for key in keys})
    places = stated_places(instrument, points)
    np.testing.assert_allclose(places.transpose(1, 0, 2), sensor_positions(instrument, points),
                               rtol=0, atol=1e-15)
    time = np.linspace(0, 1, len(points))
    shown = stated_readings(instrument, field(places), time)
    model = sensor_model(instrument, points)
    linear = (model.operator @ field(model.points).ravel()).reshape(-1, 3)
    seen = [np.asarray(each) for each in field(places)]
    turned = Instrument(rotation_rad=instrument.rotation_rad)
    rest = np.column_stack([
        nonlinear_part(instrument, stated_readings(turned, np.array([each] * 3), time),
                       time)[:, sensor] for sensor, each in enumerate(seen)])
    np.testing.assert_allclose(shown, with_memory(instrument, linear + rest, time),
                               rtol=0, atol=1e-14)
    ideal = stated_readings(Instrument(), field(np.array([points] * 3)), time)
    assert np.abs(shown - ideal).max() > 1e-6  # the control: every key changes the readings


STUDY = """
name = "small"
dimension = 2
array = { blocks_per_ring = 8, inner_radius_m = 0.03, outer_radius_m = 0.05, \
remanence_T = 1.3, recoil_permeability = 1.0, multipole_order = 1, rings = 1, \
block = { shape = "sector" } }
mesh = { block_size_m = 0.01 }
[observation]
quantity = "flux_density"
components = ["x", "y"]
positions = { kind = "circles", radius_m = 0.01, angles = 12 }
[[noise.regions]]
name = "bore"
sigma_T = 1e-6
"""


def parsed(text):
    return parse_study(tomllib.loads(text))


def test_a_map_is_written_in_its_units_and_axes():
    """Without errors of the probe, the converted map is that of a study without [instrument]."""
    plain = simulate_campaign(parsed(STUDY), 3)
    stated = parsed(STUDY + """
[instrument]
length_unit_m = 0.001
flux_density_unit_T = 1e-4
position_axes = ["y", "-x", "z"]
field_axes = ["-y", "x", "z"]
""")
    found = simulate_campaign(stated, 3)
    for name in ("readings", "held_out"):
        raw, one = getattr(found, name), getattr(plain, name)
        read = in_si_and_magnet_axes(stated.instrument, raw)
        np.testing.assert_allclose(points_of(read), points_of(one), atol=1e-15)
        np.testing.assert_allclose(read["B_T"], one["B_T"], atol=2e-12, equal_nan=True)
        assert np.linalg.norm(points_of(raw), axis=1).max() == pytest.approx(10)  # mm
        assert np.nanmax(np.abs(raw["B_T"])) > 10  # gauss
    assert found.truth["stated_instrument"]["length_unit_m"] == 0.001
    assert "stated_instrument" not in plain.truth


def test_gain_and_offset_are_in_the_readings():
    plain = simulate_campaign(parsed(STUDY), 3)
    found = simulate_campaign(parsed(
        STUDY + "[instrument]\ngain = [0.01, 0.02, 0.0]\noffset_T = [1e-3, 0, 0]\n"), 3)
    expected = plain.without_noise[:, :2] * [1.01, 1.02] + [1e-3, 0]
    np.testing.assert_allclose(found.without_noise[:, :2], expected, atol=2e-12)
    assert np.abs(found.without_noise - plain.without_noise).max() > 1e-3


def test_a_map_of_the_magnitude(tmp_path, capsys):
    """|B| is the length of what three sensors show without errors, with the probe's one gain and
    offset, in the file's unit; a turned probe reads the same, and three gains are refused.
    """
    turned = "\n[instrument]\nrotation_rad = [0, 0, 0.3]\n"
    plain = simulate_campaign(parsed(STUDY + turned), 3)
    size = np.linalg.norm(plain.without_noise[:, :2], axis=1)
    stated = parsed(STUDY + turned + """
flux_density_unit_T = 1e-3
gain = [0.02, 0.02, 0.02]
offset_T = [1e-3, 1e-3, 1e-3]
""")
    found = simulate_campaign(stated, 3, magnitude=True)
    np.testing.assert_allclose(found.without_noise[:, 0], 1.02 * size + 1e-3, atol=2e-12)
    assert np.abs(found.without_noise[:, 0] - size).max() > 1e-3  # the control
    read = in_si_and_magnet_axes(stated.instrument, found.readings)
    assert is_total_field(read)
    noise = (read["Babs_T"].values - found.without_noise[:, 0]) / 1e-6
    assert 0.4 < noise.std() < 1.7  # of 12 readings; 4 sigma of chi
    with pytest.raises(MeasurementError, match="three equal entries"):
        simulate_measurement(parsed(STUDY + "[instrument]\ngain = [0.01, 0, 0]\n"), 3,
                             magnitude=True)
    study = tmp_path / "study.toml"
    study.write_text(STUDY)
    assert main(["simulate-measurement", str(study), "-o", str(tmp_path / "campaign"),
                 "--component", "abs"]) == 0
    assert is_total_field(read_map(tmp_path / "campaign" / "map.csv"))
    assert "|B|" in capsys.readouterr().out
