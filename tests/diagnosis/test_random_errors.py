"""Readings that are off singly, and positions that shake: found where they are, and only there."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sparse

from halbach_fe.diagnosis.diagnose import vibration_beyond
from halbach_fe.diagnosis.marginal_evidence import Marginal
from halbach_fe.diagnosis.random_errors import (
    Outlier,
    PositionNoise,
    estimate_position_noise,
    excluding,
    find_outliers,
    have_settled,
    outliers_of,
    with_position_noise,
)
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.campaign_maps import ONLY_MAP
from halbach_fe.measurement.field_map import field_map
from halbach_fe.solver.exact_block_field import gradient_of, unit_fields
from halbach_fe.stats.gaussian import independent_noise
from halbach_fe.study.reader import parse_study
from tests.conftest import circle
from tests.diagnosis.campaign import DOCUMENT, NOISE_T, STUDY

POINTS = np.vstack([circle(radius, 24, z, 0.1) for radius in (0.05, 0.07)
                    for z in np.linspace(-0.2, 0.2, 28)])
LABELS = ["Bx", "By", "Bz"] * len(POINTS)
COUNT = len(LABELS)  # 4032
OFF_T = 5e-3
BLOCKS = build_magnet(STUDY).blocks
LARGEST_T = 0.5


@pytest.fixture(scope="module")
def root():
    """Readings (n, m) in T as the polarization of every block is off by 1 %, along each axis."""
    return np.hstack([0.01 * 1.2 * unit.reshape(COUNT, 3) for unit in unit_fields(BLOCKS, POINTS)])


@pytest.fixture(scope="module")
def gradient():
    """(n, 3, 3) in T/m."""
    return gradient_of(BLOCKS, POINTS)


@pytest.fixture
def clean(root, generator):
    """Residual (n,) in T of blocks that are off, and noise."""
    return (root @ generator.standard_normal(root.shape[1])
            + NOISE_T * generator.standard_normal(COUNT))


def odd_ones(root, residual, training=None):
    training = np.ones(COUNT, bool) if training is None else training
    return np.flatnonzero(find_outliers(
        root, residual, independent_noise(np.full(COUNT, NOISE_T)), training, LABELS,
        np.repeat(POINTS, 3, axis=0), LARGEST_T))


def unmodelled(name, root, gradient):
    """What a model may lack, (n,) in T."""
    if name == "translation":
        return 1e-3 * gradient[:, :, 0].ravel()
    if name == "demagnetized":  # a third of one block
        return root[:, 15:18] @ (np.array(BLOCKS[5].easy_axis) * -0.3 / 0.01)
    if name == "ring":  # as iron: a fraction of everything, and a field that grows outwards
        total = root @ np.concatenate([one.easy_axis for one in BLOCKS]) / 0.01
        sextupole = POINTS[:, :2] ** 2 @ [[1, 0], [-1, 0]] - 2j * np.prod(POINTS[:, :2], axis=1)[
            :, None] * [1, 0]
        field = np.column_stack([sextupole[:, 0].real, sextupole[:, 0].imag, 0 * POINTS[:, 0]])
        return 0.03 * total + 2.0 * field.ravel()
    return np.zeros(COUNT)


@pytest.mark.parametrize("lacking", ["nothing", "translation", "demagnetized", "ring"])
def test_outliers(lacking, root, gradient, clean, generator):
    residual = clean + unmodelled(lacking, root, gradient)
    if lacking != "nothing":  # or it would be no test
        assert np.abs(residual - clean).max() > 10 * NOISE_T
    assert len(odd_ones(root, residual)) == 0  # negative control
    true = np.sort(generator.choice(COUNT, 20, replace=False))
    residual[true] += OFF_T * generator.uniform(0.5, 1.5, 20) * generator.choice([-1, 1], 20)
    found = odd_ones(root, residual).tolist()
    # where much is lacking, the local scale is large, and a few of the smaller ones hide
    assert set(found) <= set(true.tolist())
    assert len(found) == 20 if lacking == "nothing" else len(found) >= 15


def test_several_outliers_side_by_side(root, clean, monkeypatch):
    """Pairs spoil each other's neighbourhood; a crowd of them is a small thing close by."""
    crowd = np.sort(3 * np.argsort(np.linalg.norm(POINTS - POINTS[1000], axis=1))[:3] + 1)
    crowded = clean.copy()
    crowded[crowd] += OFF_T
    pairs = [1500, 1506, 4002, 4008]
    clean[pairs] += OFF_T
    assert odd_ones(root, clean).tolist() == pairs
    assert len(odd_ones(root, crowded)) == 0
    # negative control
    monkeypatch.setattr("halbach_fe.diagnosis.random_errors.CROWD_PROBABILITY", 0.0)
    assert odd_ones(root, crowded).tolist() == crowd.tolist()


def test_outliers_among_held_out_readings(root, clean, generator):
    training = np.repeat(np.arange(len(POINTS)) // 24 % 4 != 3, 3)
    clean[[5, 3000]] += OFF_T
    clean[np.flatnonzero(~training)[100]] -= OFF_T
    assert odd_ones(root, clean, training).tolist() == sorted(
        [5, 3000, np.flatnonzero(~training)[100]])


def test_more_noise_is_no_outlier(root, clean, generator):
    """Negative controls: noise that is ten times as large, or five times in one place."""
    noise = NOISE_T * generator.standard_normal(COUNT)
    assert len(odd_ones(root, clean + 10 * noise)) == 0
    assert len(odd_ones(root, clean + np.where(np.arange(COUNT) < 600, 5 * noise, 0))) == 0


def update_of(residual, root, points=POINTS):
    """What of an update these look at."""
    count = len(residual)
    observation = SimpleNamespace(
        analysis=sparse.eye_array(count).tocsr(), labels=LABELS[:count], map_points=points,
        components=[label[1:] for label in LABELS[:count]], map_rows=np.arange(count) // 3,
        positions=np.repeat(points, 3, axis=0),
        read=lambda fields: fields.reshape(len(fields), -1))
    return SimpleNamespace(
        study=STUDY, magnet=build_magnet(STUDY), noise_magnet=build_magnet(STUDY),
        observation=observation,
        errors=independent_noise(np.full(count, NOISE_T)),
        held_out=np.zeros(count, bool), parts=("training",) * count, maps=(ONLY_MAP,) * count,
        readings=residual,
        prediction_prior=SimpleNamespace(mean=np.zeros(count), root=root.__getitem__))


def campaign_of(points=POINTS):
    return Campaign.of(STUDY, field_map(points, np.zeros(points.shape)))


def test_outliers_are_told_and_left_out(root, clean):
    clean[[4, 5, 3000]] += OFF_T
    found = outliers_of(update_of(clean, root), campaign_of())
    assert [(one.row, one.component) for one in found] == [(2, "y"), (2, "z"), (1001, "x")]
    assert found[2].at_m == tuple(POINTS[1000])
    assert all(abs(one.off_T - OFF_T) < 5 * one.sd_T < 0.1 * OFF_T for one in found)
    study = excluding(STUDY, found)
    assert parse_study(study.model_dump()).inference.excluded_readings == tuple(
        study.inference.excluded_readings)
    assert [(one.row, one.components) for one in study.inference.excluded_readings] == [
        (2, ("y", "z")), (1001, ("x",))]
    # coefficients are made of many readings
    update = update_of(clean, root)
    update.observation.components = [""] * COUNT
    assert outliers_of(update, campaign_of()) == ()


SHAKEN_M = 1e-4


@pytest.mark.parametrize("added", [
    "vibration", "nothing", "noise", "one sensor", "smooth", "translation"])
def test_vibration(added, root, gradient, clean, generator):
    """Where it is there, and the negative controls: more noise, of one sensor too, smooth errors
    that are no effect of the catalogue, and what is one.
    """
    shift = SHAKEN_M * generator.standard_normal((len(POINTS), 3))
    residual = clean + {
        "vibration": np.einsum("ncj,nj->nc", gradient, shift).ravel(),
        "noise": 2 * NOISE_T * generator.standard_normal(COUNT),
        "one sensor": 3 * NOISE_T * (generator.standard_normal((len(POINTS), 3))
                                      * [0.0, 0.0, 1.0]).ravel(),
        "smooth": 20 * NOISE_T * np.sin(25 * POINTS @ [[0.3, 0, 0], [0.5, 0, 0], [1, 1, 0]]
                                        ).ravel(),
        "translation": unmodelled("translation", root, gradient)}.get(added, 0.0)
    columns = gradient[:, :, [0]].reshape(COUNT, 1) * 1e-3 / NOISE_T
    some = np.arange(len(POINTS)) % 6 == 0  # lest it take long
    rows = np.repeat(some, 3)
    found = estimate_position_noise(
        update_of(residual[rows], root[rows], POINTS[some]), campaign_of(POINTS[some]),
        Marginal.of(root[rows] / NOISE_T), columns[rows], residual[rows] / NOISE_T, ())
    if added == "vibration":
        (found,) = found
        # of 672 readings half are in the fringe, which smooth terms halve again: 5 %; 3 sd
        assert found.sd_m == pytest.approx(SHAKEN_M, rel=0.15)
        assert found.log_bayes_factor > 50
    else:
        assert found == ()


@pytest.mark.parametrize("gain", [1e2, 1e6])
def test_vibration_in_place_of_terms_of_any_shape(gain, root, gradient, clean, generator):
    """Terms with as many functions as there are points explain vibration as well. It is named if
    its evidence is larger than theirs: here 500 or so, of 168 readings.
    """
    shift = SHAKEN_M * generator.standard_normal((len(POINTS), 3))
    residual = clean + np.einsum("ncj,nj->nc", gradient, shift).ravel()
    some = np.arange(len(POINTS)) % 24 == 0
    rows = np.repeat(some, 3)
    search = SimpleNamespace(marginal=Marginal.of(root[rows] / NOISE_T), candidates=(),
                             columns=np.zeros((rows.sum(), 0)), training=residual[rows] / NOISE_T)
    judgement = SimpleNamespace(
        fits=True, best=SimpleNamespace(effects=(), log_odds=gain),
        competition=SimpleNamespace(explanation=lambda *of: SimpleNamespace(log_odds=0.0)))
    found = vibration_beyond(judgement, update_of(residual[rows], root[rows], POINTS[some]),
                             campaign_of(POINTS[some]), search, ())
    if gain > 1e3:
        assert found == ()
    else:  # 56 points along three axes, of which the blocks take a part: 4 sd
        assert found[0].sd_m == pytest.approx(SHAKEN_M, rel=0.3)
        assert gain < found[0].over_none < 1e6


def test_a_study_with_vibration():
    found = PositionNoise(20.0, 3e-4)
    assert with_position_noise(STUDY, ()) == STUDY
    assert with_position_noise(STUDY, [found]).noise.position_sd_m == (3e-4,)
    assert with_position_noise(STUDY, [found]).noise.regions == STUDY.noise.regions
    shaky = parse_study(DOCUMENT | {"noise": {"position_sd_m": [4e-4, 0.0, 4e-4]}})
    assert with_position_noise(shaky, [found]).noise.position_sd_m == pytest.approx(
        (5e-4, 3e-4, 5e-4))
    assert have_settled([], [])
    assert have_settled([found], [PositionNoise(1.0, 3.1e-4)])
    assert not have_settled([found], [])
    assert not have_settled([], [found])
    larger = [PositionNoise(1.0, 4e-4)]
    assert not have_settled([found], larger)
    # of two that take turns the smaller is the last, and a third is none of them
    assert have_settled([found], larger, [[], larger])
    assert not have_settled(larger, [found], [[], [found]])
    assert not have_settled([found], [PositionNoise(1.0, 5e-4)], [[], larger])
    assert have_settled([found], [], [[]])
    assert not have_settled([], [found], [[], [found]])


def test_outliers_and_vibration_belong_to_a_map():
    study = parse_study(DOCUMENT | {"maps": [
        {"name": "one", "file": "1.csv"},
        {"name": "two", "file": "2.csv", "inference": {"excluded_readings": [3]}}]})
    odd = excluding(study, [Outlier(7, "y", (0.0, 0.0, 0.0), 1.0, 0.1, "two")])
    assert odd.maps[0] == study.maps[0]
    assert [one.row for one in odd.of_map(1).inference.excluded_readings] == [3, 7]
    shaken = with_position_noise(study, [PositionNoise(20.0, 3e-4, "two")])
    assert shaken.maps[0] == study.maps[0]
    assert shaken.of_map(1).noise.position_sd_m == (3e-4,)
    assert shaken.of_map(1).noise.regions == study.noise.regions
