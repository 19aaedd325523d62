"""Two maps of one magnet that magpylib computed, each with a probe and a pose of its own."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.measurement.field_map import field_map
from halbach_fe.study.reader import parse_study
from tests.inference.test_registration import TEXT, session, truth

NOISE_T = 2e-5
SPACING_M = 0.006
BODY, FRINGE = (np.stack(np.meshgrid(
    0.005 * np.arange(-2, 3), 0.005 * np.arange(-2, 3), z, indexing="ij"),
    axis=-1).reshape(-1, 3) for z in (SPACING_M * np.arange(-6, 7), SPACING_M * np.arange(4, 14)))
"""Points in the magnet: through the bore of 60 mm, and from within it to 50 mm before it."""


def reading(magnet_of, generator, points, turn, shift, mixing=None, offset=0.0):
    """A map whose stage has coordinates s: the place in the magnet is turn s + shift."""
    matrix = turn.as_matrix()
    field = magnet_of.getB(points) @ matrix @ (np.eye(3) if mixing is None else mixing).T + offset
    return field_map((points - shift) @ matrix,
                     field + NOISE_T * generator.standard_normal(field.shape))


POSES = [(Rotation.from_rotvec([0.004, -0.003, 0.006]), np.array([3e-4, -2e-4, 5e-4])),
         (Rotation.from_rotvec([-0.005, 0.004, 0.002]), np.array([-4e-4, 3e-4, 0.0503]))]
UNCERTAIN = {"translation_m": 1e-3, "rotation_rad": 0.01}


def campaign_study(**changes):
    """The study of both maps: their stages are known to a millimetre."""
    return parse_study(tomllib.loads(TEXT) | {"instrument_sd": UNCERTAIN, "maps": [
        {"name": "body", "file": "body.csv"},
        {"name": "fringe", "file": "fringe.csv", "instrument": {"translation_m": [0, 0, 0.05]}},
    ]} | changes)


def two_maps(generator, magnet_of=None, other=None, mixings=(None, None), offset=0.0):
    """Maps of a magnet, the second one perhaps of another."""
    magnet_of = magnet_of or truth(generator)
    return {name: reading(of, generator, points, *pose, mixing, offset)
            for name, of, points, pose, mixing in zip(
                ("body", "fringe"), (magnet_of, other or magnet_of), (BODY, FRINGE), POSES,
                mixings, strict=True)}


def test_two_maps_find_their_poses_and_agree(generator, tmp_path):
    maps = two_maps(generator)
    result = infer(build_magnet(campaign_study()), maps, session(tmp_path))
    assert result.terms.at_rest
    assert result.terms.names[:2] == ("body.translation_x_m", "body.translation_y_m")
    found = dict(zip(result.terms.names, zip(result.terms.change, result.terms.sd), strict=True))
    for name, (turn, shift), points, start in (("body", POSES[0], BODY, np.zeros(3)),
                                               ("fringe", POSES[1], FRINGE, [0, 0, 0.05])):
        stated = (points - shift) @ turn.as_matrix()
        middle = (stated.min(axis=0) + stated.max(axis=0)) / 2
        right = turn.apply(middle) + shift - middle - start
        for number, axis in enumerate("xyz"):
            value, sd = found[f"{name}.translation_{axis}_m"]
            assert value == pytest.approx(right[number], abs=4 * sd + 1e-6)
            assert sd < 2e-4
    assert not result.disagreement
    assert result.overlaps
    for each in result.overlaps:
        assert each.held_out
        assert each.chi2 == pytest.approx(1.0, abs=5 * np.sqrt(2 / each.readings))
    regions = {score.region for score in result.scores}
    assert regions == {"body", "fringe"}
    for score in result.scores:
        if score.part == "held out":
            assert score.chi2_posterior == pytest.approx(1.0, abs=5 * np.sqrt(2 / score.readings))
