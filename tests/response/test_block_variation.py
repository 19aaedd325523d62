"""Magnetizations that vary inside blocks: their field against magpylib, and what is inferred."""

from __future__ import annotations

import tomllib

import magpylib
import numpy as np
import pytest

import halbach_fe as hf
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.response.block_variation import Variations, neighbour_deviations
from halbach_fe.solver.exact_block_field import external_field
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study

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
    sd = np.linalg.norm(neighbour_deviations(magnet, points), axis=0)
    np.testing.assert_allclose(sd, 0.01 * np.abs(external_field(magnet, points)), rtol=1e-6,
                               atol=1e-10)  # of the blocks by themselves: 2e-11
