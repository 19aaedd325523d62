"""The field of an updated magnet is not the reading of a probe that is roughly known."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import halbach_fe as hf
from halbach_fe.diagnosis.summary import main_field_T
from halbach_fe.geometry.magnet import build_magnet, neighbour_blocks
from halbach_fe.inference.infer import infer
from halbach_fe.inference.posterior_files import inference_summary, read_posterior, write_inference
from halbach_fe.inference.result import PREDICTION_COLUMNS
from halbach_fe.measurement.field_map import field_map
from halbach_fe.report.inference_answer import answer
from halbach_fe.response.multipoles import circle_models
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import MU_0
from halbach_fe.study.reader import parse_study
from tests.support.short_dipole import BODY, NOISE_T, TEXT, reading, truth

GAIN_SD = 0.02
STRAIGHT = (Rotation.identity(), np.zeros(3))


def updated(tmp_path, data, **known):
    study = parse_study(tomllib.loads(TEXT) | known)
    return infer(build_magnet(study), data, Session.open(tmp_path / "work"))


def drawn(generator):
    """A magnet of the study's prior."""
    magnet_of = truth(generator)
    common = 1 + 0.01 * generator.standard_normal()
    for source in magnet_of.sources:
        source.polarization = source.polarization * common
    return magnet_of


def true_field(magnet_of, result):
    """magpylib's field at the places and along the directions of `InferenceResult.field`."""
    places, number = np.unique(result.field.places, axis=0, return_inverse=True)
    return np.sum(magnet_of.getB(places)[number.ravel()] * result.field.along, axis=1)


def said_field(result):
    """Value and standard deviation in mT of the first sentence of the answer."""
    return tuple(map(float, re.match(
        r"The strongest component of the updated field .*, is ([\d.]+)\xa0±\xa0([\d.]+) mT\.",
        answer(result).said).groups()))


def test_a_gain_that_is_not_known(generator, tmp_path):
    """Of a map times 1.02 the field is within its bars; the reading is not, by far."""
    magnet_of = truth(generator)
    result = updated(tmp_path, reading(magnet_of, generator, BODY, STRAIGHT, 1.02 * np.eye(3)),
                     instrument_sd={"gain": GAIN_SD})
    most = result.field.strongest
    true = true_field(magnet_of, result)[most]
    value, sd = said_field(result)
    assert value == pytest.approx(1e3 * abs(true), abs=3 * sd)
    # blocks of the prior are known to 1 % together, and a gain to 2 %
    assert 0.005 * value < sd < 0.012 * value
    old = result.prediction_posterior
    assert abs(old.mean[most] - true) > 100 * old.sd[most]  # the negative control
    table = result.predictions
    assert tuple(map(str, table)) == PREDICTION_COLUMNS
    assert table["field_T"].values[most] == result.field.mean[most]
    assert table["posterior_mean_T"].values[most] == old.mean[most]
    summary = inference_summary(result)["strongest_field"]
    assert 1e3 * abs(summary["mean_T"]) == pytest.approx(value, abs=sd / 10)
    assert summary["at_m"] == pytest.approx(result.field.places[most].tolist())
    # and the page of a diagnosis has parts of the field, too
    assert main_field_T(SimpleNamespace(after=result)) == abs(result.field.mean[most])


def test_mean_and_sd_are_those_of_magpylib_s_blocks(generator, tmp_path):
    """With the posterior's mean and covariance of the magnetizations, at the places of a pose."""
    pose = Rotation.from_rotvec([0.004, -0.003, 0.006]), np.array([3e-4, -2e-4, 5e-4])
    result = updated(tmp_path, reading(truth(generator), generator, BODY, pose),
                     instrument_sd={"gain": 0.01, "translation_m": 1e-3, "rotation_rad": 0.01})
    field = result.field
    assert result.terms.at_rest
    some = np.arange(0, len(field.mean), 97)
    places, along = field.places[some], field.along[some]
    # which are near those of the map, and not the same
    assert 1e-4 < np.abs(places - result.observation.positions[some]).max() < 2e-3
    rows = []
    for source in truth(generator).sources:
        for axis in np.eye(3):
            source.polarization = source.orientation.inv().apply(MU_0 * axis)
            rows.append(np.sum(source.getB(places) * along, axis=1))
    columns = np.array(rows).T
    mean = columns @ result.posterior.mean
    sd = np.sqrt(np.einsum("ij,jk,ik->i", columns, result.posterior.covariance, columns))
    # a response is moved with the sensors, up to parts of the standard deviations
    np.testing.assert_allclose(field.mean[some], mean, atol=0.1 * sd.max())
    np.testing.assert_allclose(field.sd[some], sd, rtol=0.01, atol=1e-3 * sd.max())


def test_coverage(tmp_path):
    """Over campaigns of magnets, gains, crosstalk and poses that are drawn.

    The sum of squares of 10 scores is within 1.5 to 30 with a probability of 0.998. That of the
    readings that are predicted, the negative control, is not.
    """
    field, readings = [], []
    for number in range(10):
        generator = np.random.default_rng(number)
        magnet_of = drawn(generator)
        mixing = np.eye(3) + 0.003 * generator.standard_normal((3, 3))
        mixing += np.diag(GAIN_SD * generator.standard_normal(3))
        pose = (Rotation.from_rotvec(0.005 * generator.standard_normal(3)),
                5e-4 * generator.standard_normal(3))
        result = updated(tmp_path / str(number), reading(
            magnet_of, generator, BODY[::2], pose, mixing), instrument_sd={
                "gain": float(np.hypot(GAIN_SD, 0.003)), "crosstalk": 0.003,
                "translation_m": 5e-4, "rotation_rad": 0.005})
        most = result.field.strongest
        true = true_field(magnet_of, result)[most]
        field.append((result.field.mean[most] - true) / result.field.sd[most])
        old = result.prediction_posterior
        readings.append((old.mean[most] - true) / old.sd[most])
    low, high = stats.chi2(len(field)).ppf([1e-3, 0.999])
    assert low < np.sum(np.square(field)) < high
    assert np.sum(np.square(readings)) > 100 * high


def test_without_open_terms_it_is_what_is_predicted(generator, tmp_path):
    """By an exact probe; a stated gain is taken out, and a turned sensor reads along itself."""
    magnet_of = truth(generator)
    exact = updated(tmp_path / "exact", reading(magnet_of, generator, BODY, STRAIGHT))
    np.testing.assert_array_equal(exact.field.mean, exact.prediction_posterior.mean)
    np.testing.assert_array_equal(exact.field.sd, exact.prediction_posterior.sd)
    assert re.search(r", Bx at \([^)]+\) mm, is", answer(exact).said)
    mixing = np.array([[1.02, 0.03, 0], [0, 1, 0], [0, 0, 1]])
    known = {"gain": [0.02, 0, 0], "crosstalk": {"xy": 0.03}}
    result = updated(tmp_path / "gain", reading(magnet_of, generator, BODY, STRAIGHT, mixing),
                     instrument=known)
    off = result.field.mean - true_field(magnet_of, result)
    np.testing.assert_allclose(off / result.field.sd, 0, atol=5)  # of 975 normal ones
    most = result.field.strongest
    assert abs(result.prediction_posterior.mean[most] - true_field(magnet_of, result)[most]) > (
        100 * result.field.sd[most])
    assert "B along (0.9996, 0.0294, 0.0000) at (" in answer(result).said


def test_an_offset_that_is_an_uncertain_amplitude(generator, tmp_path):
    """The field is without it, as without one of `instrument_sd`; it was 3 mT off, 340 bars."""
    magnet_of, offset_T = truth(generator), 3e-3
    data = reading(magnet_of, generator, BODY, STRAIGHT)
    data["B_T"][:, 0] += offset_T
    result = updated(tmp_path, data, uncertain=[{
        "name": "offset", "sd": offset_T, "change": {"instrument.offset_T[1]": 1.0}}])
    off = (result.field.mean - true_field(magnet_of, result)) / result.field.sd
    np.testing.assert_allclose(off, 0, atol=5)  # of 975 normal numbers
    read = result.prediction_posterior.mean - result.field.mean
    np.testing.assert_allclose(read, offset_T * result.field.along[:, 0], atol=5e-5)


def test_what_blocks_of_neighbours_deviate_is_field(generator):
    """Beside an open gain of the probe the field lacked what the update found of them, and was 36
    bars off (rms). 600 scores of one magnet have an rms of about 1.
    """
    magnet = hf.halbach_ring(
        blocks=8, inner_radius_m=0.03, outer_radius_m=0.05, length_m=0.06, remanence_T=1.2).with_(
            noise={"regions": [{"name": "all", "sigma_T": 1e-5}]}, inference={},
            external={"neighbours": [{"z_m": 0.075}]}, instrument_sd={"gain": 1e-3})
    line = 0.008 * np.arange(-2, 3)
    points = np.stack(np.meshgrid(line, line, 0.01 * np.arange(-3, 5)), axis=-1).reshape(-1, 3)
    blocks = [replace(block, remanence=block.remanence * (1 + 0.01 * deviation))
              for block, deviation in zip(
                  [*magnet.blocks, *neighbour_blocks(magnet.blocks, magnet.external.neighbours)],
                  generator.standard_normal(2 * len(magnet.blocks)), strict=True)]
    true = field_of(blocks, points)
    field = infer(magnet, field_map(
        points, true + 1e-5 * generator.standard_normal(true.shape))).field
    off = np.sum(field_of(blocks, field.places) * field.along, axis=1) - field.mean
    assert np.sqrt(np.mean((off / field.sd)**2)) < 3


NEIGHBOUR = {"z_m": 0.08, "turn_deg": 40.0}
"""It begins 20 mm beyond the end of the magnet."""
REFERENCE = hf.MultipoleReference(0.01, (2, 3, 4), 0.02)


@pytest.fixture(scope="module")
def beside_a_neighbour(tmp_path_factory):
    """Magnets beside others, all with errors of their own, and their updates: fields of magpylib,
    read on circles.
    """
    angle, heights = 2 * np.pi * np.arange(12) / 12, np.linspace(-0.03, 0.03, 13)
    circle = 0.01 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    points = (circle + heights[:, None, None] * np.array([0, 0, 1.0])).reshape(-1, 3)
    observed = {"quantity": "flux_density", "positions": {
        "kind": "circles", "radius_m": 0.01, "angles": 12, "z_min_m": -0.03, "z_max_m": 0.03,
        "count": 13}}
    found = []
    for seed in range(4):
        generator = np.random.default_rng(seed)
        own, other = truth(generator), truth(generator)
        other.rotate_from_angax(NEIGHBOUR["turn_deg"], "z", anchor=0)
        other.move((0, 0, NEIGHBOUR["z_m"]))

        def field(points, own=own, other=other):
            return own.getB(points) + other.getB(points)

        data = field_map(points, field(points) + NOISE_T * generator.standard_normal(points.shape))
        found.append((field, updated(
            tmp_path_factory.mktemp("update"), data, observation=observed, inference={},
            external={"neighbours": [NEIGHBOUR]})))
    return found


def true_multipoles(field, turn):
    """C_1 to C_4 in T on the circle of `REFERENCE`, in axes turned by an angle about z."""
    angle = 2 * np.pi * np.arange(32) / 32
    radial = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    shown = np.sum(field(REFERENCE.radius_m * radial + [0, 0, REFERENCE.z_m]) * radial, axis=1)
    order = np.arange(1, 5)[:, None]
    return 2j / 32 * np.exp(-1j * order * (angle - turn)) @ shown


def rms_pull(off, sd):
    return np.sqrt(np.mean((np.concatenate(off) / np.concatenate(sd))**2))


def test_an_update_knows_its_neighbours_blocks(beside_a_neighbour):
    """Multipoles, fields on a line, mean field and roll are off by some of their bars. They were
    those of nominal neighbours, without a bar: 2.5, 16, 2.8 and 7.5 bars off (rms).
    """
    line = hf.Lines((0.005, 0, -0.03), (0.005, 0, 0.03), count=13)
    region = hf.Region.sphere(0.008)
    off, sd = ({"multipoles": [], "line": [], "mean": [], "roll": []} for _ in range(2))
    for field, result in beside_a_neighbour:
        session = Session.temporary()
        model, known = hf.multipoles(
            result.magnet, session.within("m"), REFERENCE, result).tables[-1]
        true = true_multipoles(field, model.turn)
        on_line = hf.field(result.magnet, line, session.within("l"), result)
        mean = hf.homogeneity(result.magnet, session.within("h"), region, result)
        inner = mean.model.sampling.points
        true_mean = mean.model.weights @ np.linalg.norm(field(inner), axis=1)
        mean, known = mean.by_name["posterior"], known["posterior"]
        for name, one, other, bar in (
                ("multipoles", known.mean, model.units(true), known.sd),
                ("line", on_line.mean.ravel(), field(line.points.reshape(-1, 3)).ravel(),
                 on_line.sd.ravel()),
                ("mean", [mean.mean_T], true_mean, [mean.mean_sd_T]),
                ("roll", [known.roll], -np.angle(true[0]), [known.roll_sd])):
            off[name].append(np.asarray(one) - other)
            sd[name].append(bar)
    for name in off:  # of 4 numbers, which have an rms above 2 with a probability of 0.3 %
        assert rms_pull(off[name], sd[name]) < 2, name


def test_what_an_update_knows_of_neighbours_is_everywhere(beside_a_neighbour, tmp_path):
    """Shims, the tables of circles and files have the same multipoles. A file without neighbours'
    blocks, as earlier versions wrote, says so, and its bars are those of unknown neighbours.
    """
    _, result = beside_a_neighbour[0]
    magnet, session = result.magnet, Session.temporary()

    def known(posterior):
        return hf.multipoles(magnet, session, REFERENCE, posterior).tables[-1][1]["posterior"]

    exact = known(result)
    np.testing.assert_allclose(hf.shim(
        result, session, REFERENCE, swaps=0, turns=0).before.mean, exact.mean, atol=1e-9)
    circle = next(one for one in circle_models(
        magnet, result.observation, result.response) if one.z == pytest.approx(0.02))
    same = circle.of(result.posterior)
    rows = [circle.orders.index(order) for order in REFERENCE.orders]
    np.testing.assert_allclose(  # in axes of another turn about z, and of another main one
        same.main * same.sizes[rows], exact.main * exact.sizes, rtol=1e-6)
    write_inference(result, tmp_path)
    stored = read_posterior(magnet, tmp_path / "posterior.h5")
    assert not stored.disagreement
    np.testing.assert_allclose(known(stored).mean, exact.mean, atol=1e-9)
    np.testing.assert_allclose(known(stored).sd, exact.sd, rtol=1e-9)
    write_inference(replace(result, prior=replace(result.prior, beside=None), posterior=replace(
        result.posterior, beside=None)), tmp_path)
    earlier = read_posterior(magnet, tmp_path / "posterior.h5")
    assert "neighbours' blocks" in earlier.disagreement
    assert (known(earlier).sd > exact.sd).all()
    assert known(earlier).main_sd > 10 * exact.main_sd


def test_one_map_after_the_other_beside_a_neighbour(beside_a_neighbour):
    """Updates by one half of a map and then by the other find what one by the whole map does."""
    _, result = beside_a_neighbour[0]
    magnet = result.magnet.with_(observation={"quantity": "flux_density", "positions": {
        "kind": "points", "points_m": [[0.0, 0.0, 0.0]]}})
    points = result.observation.map_points
    data = field_map(points, result.readings.reshape(-1, 3))
    first = infer(magnet, data.isel(point=slice(0, None, 2)), Session.temporary())
    both = infer(magnet, data.isel(point=slice(1, None, 2)), Session.temporary(),
                 prior=first.posterior)
    np.testing.assert_allclose(both.prior.stacked.sd, first.posterior.stacked.sd, rtol=1e-6)
    for one, whole in ((both.posterior, result.posterior),
                       (both.posterior.beside, result.posterior.beside)):
        np.testing.assert_allclose(one.sd, whole.sd, rtol=1e-4)
        np.testing.assert_allclose(one.mean, whole.mean, atol=0.01 * whole.sd.min())


def test_circles_that_the_mapper_has_moved_are_none_of_the_magnet(generator, tmp_path):
    """Their middle is not that of the magnet; the field is said at its place in the magnet."""
    angle = 2 * np.pi * np.arange(16) / 16
    ring = 0.01 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    points = (ring + np.array([[[0, 0, 0]], [[0, 0, 0.05]]])).reshape(-1, 3)
    observed = {"quantity": "flux_density", "positions": {
        "kind": "circles", "radius_m": 0.01, "angles": 16, "z_min_m": 0, "z_max_m": 0.05,
        "count": 2}}
    magnet_of = truth(generator)
    for shift, count in (([0, 0, 0], 2), ([0, 0, 0.05], 0), ([1e-3, 0, 0], 0)):
        field = magnet_of.getB(points + np.array(shift))
        data = field_map(points, field + NOISE_T * generator.standard_normal(field.shape))
        result = updated(tmp_path / str(shift), data, observation=observed, inference={},
                         instrument={"translation_m": shift})
        found = circle_models(result.magnet, result.observation, result.response)
        assert len(found) == count
        assert ("mm of the magnet, is" in answer(result).said) == (count == 0)
        field = result.field
        assert abs(field.mean[field.strongest]) == pytest.approx(np.abs(
            true_field(magnet_of, result)).max(), abs=5 * field.sd.max())


def test_fourier_coefficients_are_no_field_at_a_place(generator, tmp_path):
    """They are sums over circles; their place alone is known."""
    angle = 2 * np.pi * np.arange(16) / 16
    ring = 0.01 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    data = field_map(ring, truth(generator).getB(ring))
    result = updated(tmp_path, data, inference={}, observation={
        "quantity": "fourier_coefficients", "harmonics": 3, "positions": {
            "kind": "circles", "radius_m": 0.01, "angles": 16}})
    assert result.field.strongest is None
    assert np.isnan(result.field.mean).all()
    assert inference_summary(result)["strongest_field"] is None
    assert "strongest component" not in answer(result).said
    assert main_field_T(SimpleNamespace(after=result)) == np.abs(
        result.prediction_posterior.mean).max()


def test_the_solver_s_error_is_in_the_bars_and_in_words(generator, tmp_path):
    """Where it is above the noise; readings that are nearer than it do not blame the noise."""
    result = updated(tmp_path, reading(truth(generator), generator, BODY, STRAIGHT))
    permeable = result.magnet.with_(array__recoil_permeability=1.05, solver__route="moments")

    def with_error(size, **changes):
        return replace(result, magnet=permeable, response=replace(
            result.response, error=np.full(len(result.readings), size)), **changes)

    large = with_error(30 * result.noise.sd.max())
    assert large.field.sd.min() > 30 * result.noise.sd.min()
    said = answer(large)
    assert ("The model's own error dominates: the solver is off by up to 600\u00a0µT, rms 30 "
            "times the noise of the readings") in said.trust
    assert "It falls with a larger mesh.cells_per_side (now" in said.trust
    assert "block_size_m" not in said.trust
    near = with_error(30 * result.noise.sd.max(), prior_conflict=0.01)
    assert near.disagreement == ""
    far = answer(with_error(30 * result.noise.sd.max(), prior_conflict=9.0))
    assert "own error dominates" in far.trust
    assert far.command == "halbach-fe verify STUDY -o DIR"
    # the controls: an error below the noise
    small = with_error(0.1 * result.noise.sd.min(), prior_conflict=0.01)
    assert "their noise and the prior allow" in small.disagreement
    assert answer(small).command == "halbach-fe check MAP -o DIR"  # which says what the noise is
    assert "own error dominates" not in answer(small).trust
