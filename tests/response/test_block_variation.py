"""Magnetizations that vary inside blocks: their field against magpylib, and what is inferred."""

from __future__ import annotations

import tomllib

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import halbach_fe as hf
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.response.block_variation import Variations, neighbour_columns, neighbour_prior
from halbach_fe.response.field_on_lines import field_on_lines
from halbach_fe.response.homogeneity import DRAWS
from halbach_fe.response.multipoles import multipole_models
from halbach_fe.solver.exact_block_field import external_field
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.reader import parse_study
from tests.support import short_dipole

TEXT = """
name = "four"
[array]
multipole_order = 1
rings = 1
blocks_per_ring = 4
inner_radius_m = 0.02
outer_radius_m = 0.032
ring_length_m = 0.012
remanence_T = 1.3
[array.block]
shape = "cuboid"
width_m = 0.012
[mesh]
block_size_m = 0.01
[observation]
quantity = "flux_density"
[observation.positions]
kind = "circles"
radius_m = 0.01
angles = 8
[[noise.regions]]
name = "bore"
sigma_T = 2e-6
[prior]
magnitude_sd = 0.002
direction_sd_deg = 0.1
variation_sd = 0.1
variation_length_m = 0.008
[inference.held_out]
scan_lines_every = 5
"""
SIDE = 0.012
GRID = np.stack(np.meshgrid(0.003 * np.arange(-3, 4), 0.003 * np.arange(-3, 4),
                            0.004 * np.arange(-4, 5), indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module")
def magnet():
    return build_magnet(parse_study(tomllib.loads(TEXT)))


def pieces(block, shape):
    """The field of a block in magpylib whose magnetization is 1 + shape(place), in 8^3 pieces."""
    steps = SIDE / 8 * (np.arange(8) - 3.5)
    local = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    places = local + block.middle  # the blocks lie along the axes
    easy = np.array(block.easy_axis) * block.remanence
    return magpylib.Collection(*(
        magpylib.magnet.Cuboid(polarization=easy * (1 + shape(at)), dimension=(SIDE / 8,) * 3,
                               position=place) for at, place in zip(local, places, strict=True)))


def test_the_modes_have_the_field_of_their_magnetization(magnet):
    """Every mode's polarization, as dipoles of its parts, makes the field far away."""
    found = Variations.of(magnet)
    assert len(found.names) == sum(each.shape[-1] for each in found.polarization) > 8
    assert found.names[0] == "r01s01.v01"
    cells = found.interaction.cells
    far = np.array([[0.3, 0.2, 0.1], [-0.1, 0.3, -0.2]])
    fields = found.fields(far)
    number = 0
    for block, polarization in enumerate(found.polarization):
        mine = slice(found.starts[block], found.starts[block + 1])
        moments = polarization * (cells.weights * cells.volume[:, None])[mine][..., None, None]
        for mode in range(polarization.shape[-1]):
            sources = magpylib.misc.Dipole(moment=(0, 0, 1))
            total = np.zeros((2, 3))
            for place, moment in zip(cells.nodes[mine].reshape(-1, 3),
                                     moments[..., mode].reshape(-1, 3), strict=True):
                sources.position, sources.moment = place, moment / (4e-7 * np.pi)
                total += sources.getB(far)
            # parts of 2 mm are no dipoles: (2/300)^2 of their field
            assert fields[:, :, number] == pytest.approx(
                total, abs=2e-3 * np.abs(fields).max()), (block, mode)
            number += 1


def test_a_varying_block_is_inferred(magnet, generator, tmp_path):
    """A block that has lost at its inner face: uniform blocks cannot explain its field."""
    def lost(place):
        depth = place[0] + SIDE / 2  # from the inner face of the block at angle 0
        return -0.3 * np.exp(-depth / 0.003)

    sources = [pieces(block, lost if number == 0 else lambda _: 0.0)
               for number, block in enumerate(magnet.blocks)]
    field = sum(source.getB(GRID) for source in sources)
    data = field_map(GRID, field + 2e-6 * generator.standard_normal(field.shape))
    result = infer(magnet, data, Session.open(tmp_path / "with"))
    plain = infer(magnet.with_(prior=magnet.study.prior.with_(
        variation_sd=0.0, variation_length_m=None)), data, Session.open(tmp_path / "without"))
    left, uniform = (np.sqrt(np.mean(
        (each.readings - each.prediction_posterior.mean)[each.held_out]**2))
        for each in (result, plain))
    assert left < 0.1 * uniform  # control: without variations the blocks cannot
    assert left < 6e-6
    score = next(each for each in result.scores if each.part == "held out")
    assert 0.5 < score.chi2_posterior < 2.0
    assert len(result.contraction) == 4
    assert result.by_block(result.posterior.mean).shape == (4, 3)


@pytest.mark.filterwarnings("ignore:.*lie around an axis at x")
def test_variations_of_a_magnet_beside_the_axis():
    """They are those of the magnet on the z axis: modes are told apart by the field in its bore."""
    angle = 2 * np.pi * np.arange(8) / 8

    def fields(x_m):
        magnet = build_magnet(parse_study({
            "name": "beside", "dimension": 3, "mesh": {"block_size_m": 0.01},
            "prior": {"variation_sd": 0.01, "variation_length_m": 0.008},
            "array": {"free_blocks": {
                "name": [f"b{number}" for number in range(8)], "shape": ["cuboid"] * 8,
                "x_m": (0.05 * np.cos(angle) + x_m).tolist(),
                "y_m": (0.05 * np.sin(angle)).tolist(), "z_m": [0.0] * 8,
                **{f"size_{axis}_m": [0.02] * 8 for axis in "xyz"},
                "rotation_z_deg": np.degrees(angle).tolist(),
                "remanence_x_T": (1.3 * np.cos(2 * angle)).tolist(),
                "remanence_y_T": (1.3 * np.sin(2 * angle)).tolist(), "remanence_z_T": [0.0] * 8}},
            "observation": {"quantity": "flux_density", "positions": {
                "kind": "points", "points_m": [[x_m, 0.0, 0.0]]}}}))
        found = Variations.of(magnet).fields(np.array([[x_m + 0.03, 0.0, 0.0]]))
        return np.linalg.norm(found, axis=2)

    np.testing.assert_allclose(fields(0.3), fields(0.0), rtol=1e-6)


def test_too_fine_variations_are_refused(magnet):
    fine = magnet.with_(prior__variation_length_m=1e-3)
    with pytest.raises(StudyError, match=r"at least 0\.0017 m"):  # 1.7 parts of 12 mm / 12
        Variations.of(fine)


def test_incomplete_keys_are_refused():
    study = tomllib.loads(TEXT)
    for change in ({"prior": {"variation_sd": 0.1}}, {"prior": {"variation_length_m": 0.01}},
                   {"iron_ring": {"inner_radius_m": 0.05, "outer_radius_m": 0.06,
                                  "relative_permeability": 100.0}}):
        with pytest.raises(StudyError, match="variation"):
            parse_study(study | change)


@pytest.mark.parametrize("permeability", [1.0, 1.1])
def test_neighbours_deviate_as_their_field_does(permeability):
    """A strength that all blocks of a neighbour share changes its field by as much of it, whatever
    the recoil permeability of the blocks; by that factor it was too small.
    """
    magnet = hf.halbach_ring(
        blocks=8, inner_radius_m=0.03, outer_radius_m=0.05, length_m=0.06, remanence_T=1.2)
    magnet = magnet.with_(
        array__recoil_permeability=permeability, external={"neighbours": [{"z_m": 0.1}]},
        prior={"magnitude_sd": 1e-9, "direction_sd_deg": 1e-9, "common_mode_sd": 0.01})
    points = np.array([[0.0, 0.0, 0.03], [0.005, 0.0, 0.02]])
    root = np.asarray(neighbour_prior(magnet).root)
    sd = np.linalg.norm(neighbour_columns(magnet, points) @ root, axis=2)
    np.testing.assert_allclose(sd, 0.01 * np.abs(external_field(magnet, points)), rtol=1e-6,
                               atol=1e-10)  # of the blocks by themselves: 2e-11


@pytest.mark.parametrize("turn_deg", [0.0, 40.0])
def test_bars_before_a_map_have_the_blocks_of_neighbours(turn_deg):
    """Strengths and directions of the blocks of both magnets vary alone, and all strengths of a
    magnet together, by standard deviations whose fields magpylib computes. Control: the bars of the
    magnet's own blocks alone are others.
    """
    place_m, radius_m, at_m = 0.08, 0.005, 0.04  # between both magnets
    magnet = build_magnet(parse_study(tomllib.loads(short_dipole.TEXT) | {
        "external": {"neighbours": [{"z_m": place_m, "turn_deg": turn_deg}]}}))
    prior, session = magnet.study.prior, Session.temporary()
    nominal = np.array([block.polarization for block in magnet.blocks])
    sources = short_dipole.truth(np.random.default_rng(0)).sources

    def modes(points, turn):
        """Fields (modes, n, 3) of one standard deviation each of a magnet's blocks."""
        matrix = Rotation.from_euler("z", turn, degrees=True).as_matrix()

        units = np.array([[source.copy(polarization=source.orientation.inv().apply(one)).getB(
            points @ matrix) for one in np.eye(3)] for source in sources]) @ matrix.T
        strong = prior.magnitude_sd * nominal
        tilted = np.radians(prior.direction_sd_deg) * np.array([
            [np.cross(along, [0, 0, 1.0]), [0, 0, np.linalg.norm(along)]] for along in nominal])
        changes = np.concatenate([strong[:, None], tilted], axis=1)
        alone = np.einsum("bij,bjnk->bink", changes, units)
        together = np.einsum("bj,bjnk->nk", prior.common_mode_sd * nominal, units)
        return np.concatenate([alone.reshape(-1, *together.shape), together[None]])

    def bars(points, of):
        """Standard deviations of values of fields (modes, n, 3): of both magnets, and of one."""
        own, other = (np.sum(of(modes(points - [0, 0, z], turn))**2, axis=0)
                      for z, turn in ((0.0, 0.0), (place_m, turn_deg)))
        return np.sqrt(own + other), np.sqrt(own)

    line = np.column_stack([np.zeros((3, 2)), np.linspace(0.035, 0.045, 3)])
    both, alone = bars(line, lambda fields: fields)
    found = hf.field(magnet, hf.Lines(line[0], line[-1], count=3), session)
    np.testing.assert_allclose(found.sd[0], both, rtol=1e-6)
    assert (alone < 0.9 * both).any()

    angle = 2 * np.pi * np.arange(16) / 16
    radial = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    reference = hf.MultipoleReference(radius_m, (2, 3), at_m)
    tables = hf.multipoles(magnet, session, reference).tables
    heights = np.arange(-0.6, 0.6 + place_m, 0.004)  # beyond, the field of a mode is below 1e-5
    for (model, known), z in zip(tables, (heights, np.array([at_m])), strict=True):
        points = (radius_m * radial + np.array([0, 0, 1.0]) * z[:, None, None]).reshape(-1, 3)
        wave = np.exp(-1j * (angle - model.turn))  # -turn is that of the nominal field

        def main(fields, z=z, wave=wave):
            shown = np.einsum("mzai,ai,a->mz", fields.reshape(-1, len(z), 16, 3), radial, wave)
            return np.abs((shown / 8).sum(axis=1).imag) * (0.004 if len(z) > 1 else 1)

        both, alone = bars(points, main)
        assert known["prior"].main_sd == pytest.approx(both, rel=1e-3)
        assert alone < 0.9 * both

    region = hf.Region.sphere(0.004, (0.0, 0.0, at_m))
    # the mean over a sphere is the field in its middle
    both, alone = bars(np.array(2 * [[0, 0, at_m]]), lambda fields: fields[:, 0])
    share = 4 / np.sqrt(2 * DRAWS)  # of a standard deviation of so many draws: 4 sigma
    found = hf.homogeneity(magnet, session, region).by_name["prior"]
    along = found.direction**2
    assert found.mean_sd_T == pytest.approx(np.sqrt(along @ both**2), rel=share)
    assert np.sqrt(along @ alone**2) < (1 - share) * found.mean_sd_T
    drawn = hf.tolerance(magnet, session, draws=DRAWS, reference=reference).main
    assert drawn.std() == pytest.approx(tables[1][1]["prior"].main_sd, rel=share)


def test_iron_answers_to_what_blocks_of_neighbours_deviate():
    """Beside a box of iron bars and readings are changes of the nominal field by a neighbour that
    is 1 % stronger; those of vacuum, which they were, are the control, up to twice as long.
    """
    def beside(strength):
        return hf.halbach_ring(
            blocks=4, inner_radius_m=0.03, outer_radius_m=0.05, length_m=0.03, remanence_T=1.2,
        ).with_(mesh__block_size_m=0.012, external={
            "neighbours": [{"z_m": 0.12, "factor": strength}]}, iron={
                "relative_permeability": 1000.0, "bodies": [{
                    "kind": "box", "size_m": [0.08, 0.02, 0.06], "centre_m": [0.0, 0.08, 0.10]}]})

    share, magnet, session = 0.01, beside(1.0), Session.temporary()
    nominal = magnet.nominal_magnetization
    known = Gaussian(nominal, 0 * nominal[:, None]).with_beside(
        Gaussian(0 * nominal, share * nominal[:, None]))
    line = hf.Lines((0, 0.03, 0.06), (0, 0.055, 0.06), count=6)
    points = line.points.reshape(-1, 3)
    weak, strong = (solve_nominal(beside(factor), points, session.within(str(factor)))
                    for factor in (1.0, 1.0 + share))
    found = field_on_lines(magnet, line, known, session).root[0, ..., -1]
    alone = share * external_field(magnet, points)
    change = strong - weak
    # blocks answer on a mesh of twice the size of elements: 1 % of what iron adds
    np.testing.assert_allclose(found, change, atol=0.02 * np.abs(change - alone).max())
    assert np.abs(alone - change).max() > 0.3 * np.abs(change).max()
    again = neighbour_columns(magnet, points) @ nominal * share
    np.testing.assert_allclose(again, alone, atol=1e-9)
    references = [hf.MultipoleReference(0.01, (2, 3), z_m) for z_m in (0.05, None)]
    (weak, _), (strong, _) = (multipole_models(beside(factor), references, session.within(
        f"multipoles {factor}")) for factor in (1.0, 1.0 + share))
    for one, more in zip(weak, strong, strict=True):  # near the end of the magnet, and integrated
        change = more.offset + more.matrix @ nominal - one.offset - one.matrix @ nominal
        found = share * one.of_neighbours @ nominal
        np.testing.assert_allclose(found, change, atol=0.01 * np.abs(change).max())
