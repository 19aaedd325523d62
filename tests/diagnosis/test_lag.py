"""Readings that lag behind a stage that scans to and fro."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.core.errors import MeasurementError
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.registration import register
from halbach_fe.measurement.campaign_maps import maps_of
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.positions import follows_times, motion
from halbach_fe.measurement.probe_law import row_order_note, sensor_positions
from halbach_fe.report.diagnosis_page import page as page_of_diagnosis
from halbach_fe.report.inference_page import page as page_of_update
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.reader import parse_study
from studies.diagnosis.drawn_studies import goes_both_ways
from tests.support.short_dipole import BODY, NOISE_T, TEXT, truth

LAG_M = 1e-4
LINES = BODY.reshape(25, -1, 3)
SERPENTINE = np.vstack([line[::(-1) ** number] for number, line in enumerate(LINES)])
STUDY = parse_study(tomllib.loads(TEXT))
SOME = [effect for effect in catalogue() if effect.name in (
    "gain_x", "lag", "mapper_roll", "mapper_translation", "offset_x", "z_scale")]
(LAG,) = [effect for effect in SOME if effect.name == "lag"]


def map_of(points, lag_m, generator):
    """A map by magpylib; the probe is behind on its way along z, and at rest when it begins one."""
    behind = np.zeros_like(points)
    step = np.diff(points[:, 2], prepend=points[0, 2])
    behind[:, 2] = -lag_m * np.sign(np.where(np.abs(step) < 0.01, step, 0.0))
    field = truth(generator).getB(points + behind)
    return field_map(points, field + NOISE_T * generator.standard_normal(field.shape))


def test_a_lag_is_named(session, generator):
    """0.1 mm, of a step of 6 mm; with it in the study the update agrees with the map."""
    data = map_of(SERPENTINE, LAG_M, generator)
    found = diagnose(STUDY, data, session, effects=SOME)
    assert [one.hypothesis.effect.name for one in found.identified] == ["lag"]
    assert found.unknown is None
    lag = found.identified[0]
    assert lag.values == pytest.approx([LAG_M], abs=4 * lag.sd[0])
    assert lag.sd[0] < LAG_M / 10
    assert found.study.instrument.lag_m == pytest.approx(LAG_M, abs=4 * lag.sd[0])
    update = infer(build_magnet(found.study), data, session)
    assert update.prior_conflict < update.conflict_limit
    for page in (page_of_diagnosis(found), page_of_update(update)):  # the order is no time
        assert "counts on rows in the order in which they were read" in page.remarks[-1]
        assert page.summary["row_order"] == page.remarks[-1]
    assert not row_order_note(found.before.study)
    assert "(lag_m) and a memory" in row_order_note(STUDY.with_(
        instrument={"lag_m": LAG_M, "memory": 0.01}))
    # times count, however the rows are sorted
    assert "unless a column time_s says when" in row_order_note(STUDY.with_(
        instrument__drift_T=(0.0, 0.0, 1e-4)))
    assert "has a drift (drift_T). It" in row_order_note(STUDY.with_(
        instrument={"drift_T": (0.0, 1e-4, 0.0)}))
    assert "(gain_drift). It" in row_order_note(STUDY.with_(instrument={"gain_drift": 0.01}))
    # control: without it the update does not agree
    assert found.before.prior_conflict > found.before.conflict_limit


def test_a_lag_in_lines_of_one_direction(session, generator):
    """It is a shift of all readings but the first of each line, where the stage is at rest."""
    found = diagnose(STUDY, map_of(BODY, LAG_M, generator), session, effects=SOME)
    assert [one.hypothesis.effect.name for one in found.identified] == ["lag"]
    assert found.unknown is None
    lag = found.identified[0]
    assert lag.values == pytest.approx([LAG_M], abs=4 * lag.sd[0])
    # control: a map that is displaced has no lag
    moved = map_of(BODY, 0.0, generator)
    moved = moved.assign_coords(z_m=moved["z_m"] + LAG_M)
    found = diagnose(STUDY, moved, session, effects=SOME)
    assert [one.selection.effects for one in found.identified] == [("mapper_translation",)]


def test_the_way_of_a_stage():
    points = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 2], [1, 0, 2], [1, 0, 1], [1, 0, 0],
                       [9, 0, 0]])
    way = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, -1], [0, 0, -1], [0, 0, 0]])
    np.testing.assert_array_equal(motion(points), way)
    turn = Rotation.from_rotvec([0.1, -0.4, 0.3])
    np.testing.assert_allclose(motion(turn.apply(points)), turn.apply(way), atol=1e-12)
    np.testing.assert_allclose(
        sensor_positions(Instrument(lag_m=0.05), points)[:, 0], points - 0.05 * way)
    assert not motion(np.zeros((3, 3))).any()
    twice = np.repeat(points, 2, axis=0)  # every point is read twice
    np.testing.assert_array_equal(motion(twice), np.repeat(way, 2, axis=0))
    line = np.array([[0.0, 0, z] for z in (0, 1, 2, 4, 5, 6, 10, 14, 15)])  # steps of many lengths
    np.testing.assert_array_equal(motion(line)[1:], np.tile([0.0, 0, 1], (8, 1)))


def test_times_tell_that_a_table_was_sorted(session, generator):
    """Its rows are in no order for a lag: a study that states one refuses it, and says what to do,
    and none is offered.
    """
    study = STUDY.with_(instrument={"lag_m": LAG_M})
    data = map_of(SERPENTINE, LAG_M, generator)
    data = data.assign_coords(time_s=("point", 2.0 * np.arange(len(SERPENTINE))))
    order = np.lexsort(SERPENTINE.T[::-1])  # every line upwards along z
    table = data.isel(point=order)
    with pytest.raises(MeasurementError, match=r"rows of `map`.*Sort the table by time_s"):
        infer(build_magnet(study), table, session)
    with pytest.raises(MeasurementError, match="Sort the table by time_s"):
        register(build_magnet(study), table, session)
    back = table.isel(point=np.argsort(table["time_s"].values))
    maps_of(study, back)  # as the sentence says
    maps_of(STUDY, table)
    maps_of(study, table.drop_vars("time_s"))
    assert Campaign.of(STUDY, back).places(LAG, STUDY)
    # control: rows of a serpentine whose times are those of lines in one sense
    other = data.assign_coords(time_s=("point", np.argsort(order).astype(float)))
    assert Campaign.of(STUDY, other).places(LAG, STUDY) == []
    # times that start again on every second line say nothing of the order
    assert follows_times(SERPENTINE, np.arange(len(SERPENTINE)) % (len(SERPENTINE) // 2))


def circles(angles, radii, heights, to_and_fro):
    """Points on circles, which are read in one sense or to and fro."""
    angle = 2 * np.pi * np.arange(angles) / angles
    found = [np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle + height])
             for radius in radii for height in heights]
    return np.vstack([one[::(-1) ** number] if to_and_fro else one
                      for number, one in enumerate(found)])


@pytest.mark.parametrize(("angles", "radii", "heights"), [
    (24, (1.0,), (0.0, 0.2)), (7, (0.015,), (0.0, 0.02, 0.04)), (8, (0.015,), (0.0, 0.02)),
    (24, (5.0, 10.0, 30.0), (0.0, 1.0))])
def test_circles_in_one_sense(angles, radii, heights):
    one_sense = circles(angles, radii, heights, False)
    assert not goes_both_ways(one_sense)
    assert goes_both_ways(circles(angles, radii, heights, True))
    # of each circle all points, perhaps without the first
    assert motion(one_sense).any(axis=1).sum() >= len(one_sense) * (angles - 1) // angles


@pytest.mark.parametrize("apart", [0.3, 1.0, 10.0])
def test_lines_to_and_fro(apart):
    lines = np.array([[[x, 0.0, z] for z in np.arange(30.0)] for x in apart * np.arange(5)])
    assert not goes_both_ways(lines.reshape(-1, 3))
    lines[1::2] = lines[1::2, ::-1]
    assert goes_both_ways(lines.reshape(-1, 3))
