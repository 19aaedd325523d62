"""What permeability adds to the field of separate blocks, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.synthetic import ngsolve_reaction, reaction
from halbach_fe.synthetic.ngsolve_reaction import Elements
from halbach_fe.synthetic.shapes import CylinderBody, PolygonBody, PrismBody, SectorBody
from halbach_fe.synthetic.simulate import coil_table, moments
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import circle
from tests.oracles.lone_block import block_mesh, moment_matrix
from tests.solver.test_iron_bodies import study_with
from tests.synthetic.test_all_keys import PLAIN, POLYGON, PRISM, study_of, table_of

POINTS = np.vstack([circle(0.05, 6, z) for z in (0.0, 0.06)])
CUBES = {"blocks_per_ring": 4, "rings": 1, "inner_radius_m": 0.08, "outer_radius_m": 0.12,
         "ring_length_m": 0.04, "remanence_T": 1.2, "recoil_permeability": 1.06,
         "recoil_permeability_across": 1.15, "block": {"shape": "cuboid", "width_m": 0.05}}
FREE = {"free_blocks": table_of(
    PLAIN | {"recoil_permeability": 1.1, "rotation_x_deg": 20.0, "rotation_y_deg": 0.0},
    POLYGON | {"recoil_permeability": 1.1, "x_m": -0.1, "rotation_x_deg": 0.0,
               "rotation_y_deg": 50.0}),
    "exceptions": [{"ring": 1, "slot": 2, "remanence_T": 0.8}]}


@pytest.mark.parametrize("array", [CUBES, FREE], ids=["cubes", "tilted"])
def test_separate_blocks_against_finite_elements(array):
    """3 mT and 0.8 mT of reaction. Measured 0.3 % apart for the cubes, and 1.3 % for the tilted
    blocks, of which the field is small at these points.
    """
    magnet = magnet_of(study_of(array))
    theirs = ngsolve_reaction.reaction_field(magnet, POINTS)
    ours = reaction.separate_reaction(magnet, POINTS)
    size = np.abs(theirs).max()
    np.testing.assert_allclose(ours, theirs, atol=(1e-2 if array is CUBES else 2e-2) * size)
    # negative controls: a block less, and no anisotropy
    alone = reaction.separate_reaction(
        replace(magnet, bodies=magnet.bodies[:1]), POINTS)
    assert np.abs(alone - theirs).max() > 0.1 * size
    if array is CUBES:
        isotropic = magnet_of(study_of(array | {"recoil_permeability_across": 1.06}))
        other = reaction.separate_reaction(isotropic, POINTS)
        assert np.abs(other - theirs).max() > 0.05 * size


def test_far_blocks_count_as_dipoles(monkeypatch):
    """Closed forms for all pairs, as for neighbours, change the reaction by little: measured 1e-4
    of it. Without the far blocks it changes by much more.
    """
    array = CUBES | {"blocks_per_ring": 12, "block": {"shape": "cuboid", "width_m": 0.02},
                     "inner_radius_m": 0.1}
    magnet = magnet_of(study_of(array))
    ours = reaction.separate_reaction(magnet, POINTS)
    size = np.abs(ours).max()
    with monkeypatch.context() as patch:
        patch.setattr(reaction, "NEAR", 100.0)
        exact = reaction.separate_reaction(magnet, POINTS)
    np.testing.assert_allclose(ours, exact, atol=2e-3 * size)
    monkeypatch.setattr(reaction, "moment_field",
                        lambda places, moments, points: np.zeros_like(points))
    assert np.abs(reaction.separate_reaction(magnet, POINTS) - exact).max() > 1e-2 * size


SHAPES = [PrismBody(0.02, 0.03, 0.03, 0.04), PrismBody(0.02, 0.02, 0.04, 0.03, 0.3),
          SectorBody(0.05, 0.07, 0.3, 0.03), CylinderBody(0.01, 0.03),
          PolygonBody(tuple(0.02 * np.exp(2j * np.pi * np.arange(5) / 5)), 0.03),
          PolygonBody((-0.02 - 0.015j, 0.02 - 0.015j, 0.02 + 0.025j, -0.02j / 4, -0.02 + 0.025j),
                      0.03)]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_lone_moment_of_every_shape(shape):
    """Gauss points against NGSolve with coarse elements of order 2: measured 2e-4 to 3e-4, and up
    to 6e-4 of polygons; with fine ones of order 3 measured 3e-5. Self-demagnetization is 3 %.
    """
    mu = np.diag([1.05, 1.1, 1.1])
    theirs = moment_matrix(shape, mu, block_mesh(shape, shape.thickness / 1.7, 1), 2)
    ours = reaction.lone_moment_matrix(shape, mu)
    size = theirs[0, 0]
    np.testing.assert_allclose(ours, theirs, atol=1e-3 * size)
    assert np.abs(shape.volume / (4e-7 * np.pi) * np.eye(3) - theirs).max() > 1e-2 * size


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
def test_nodes_fill_the_shape(shape):
    """Volumes and first moments, against points drawn at random: 200 000, four sigma."""
    nodes, volumes = shape.nodes(4)
    assert volumes.sum() == pytest.approx(shape.volume, rel=1e-12)
    assert shape.holds(nodes).all()
    reach = shape.reach
    assert np.linalg.norm(nodes, axis=1).max() < reach
    points = np.random.default_rng(3).uniform(-reach, reach, (200_000, 3))
    inside = points[shape.holds(points)]
    spread = inside.std(axis=0) / np.sqrt(len(inside))
    middle = volumes @ nodes / volumes.sum()
    assert np.all(np.abs(inside.mean(axis=0) - middle) < 5 * spread)
    assert len(inside) / len(points) * 8 * reach**3 == pytest.approx(shape.volume, rel=0.03)


def test_moments_are_in_the_axes_of_the_place():
    """A block's moment turns with its place, not with its seat; two seats of one cube agree."""
    row = PLAIN | {"size_y_m": 0.03, "size_z_m": 0.03, "recoil_permeability": 1.1}
    vector = {"remanence_x_T": 0.3, "remanence_y_T": 0.4, "remanence_z_T": 0.5}
    row = {key: value for key, value in row.items() if key != "remanence_T"} | vector
    bodies = magnet_of(study_of({"free_blocks": table_of(
        row, row | {"rotation_x_deg": 90.0, "y_m": 0.1})})).bodies
    first, second = moments(bodies, 1.0)
    turned = [body.orientation.apply(moment) for body, moment in zip(
        bodies, (first, second), strict=True)]
    np.testing.assert_allclose(turned[0], turned[1], atol=1e-3 * np.linalg.norm(first))
    assert np.abs(first - second).max() > 1e-2 * np.linalg.norm(first)


def test_methods():
    """NGSolve for sections, sectors and iron; Gauss points for cuboids and free blocks."""
    iron = {"bodies": [{"kind": "tube", "inner_radius_m": 0.3, "outer_radius_m": 0.32}],
            "relative_permeability": 100.0}
    many = CUBES | {"blocks_per_ring": 36, "rings": 12, "block": {"shape": "cuboid",
                                                                 "width_m": 0.01}}
    sectors = many | {"block": {"shape": "sector"}}
    assert not reaction.by_elements(magnet_of(study_of(CUBES)))
    assert reaction.by_elements(magnet_of(study_of(sectors)))
    assert not reaction.by_elements(magnet_of(study_of(many)))
    assert not reaction.by_elements(magnet_of(study_of(FREE)))
    assert reaction.by_elements(magnet_of(study_of(FREE, iron=iron)))
    with pytest.raises(StudyError, match="of at most 400 cuboids and free blocks"):
        reaction.reaction_field(magnet_of(study_of(many, iron=iron)), POINTS)


@pytest.mark.parametrize("row", [PRISM, POLYGON, PLAIN | {
    "shape": "cylinder", "size_x_m": None, "size_y_m": None, "radius_m": 0.01}],
    ids=lambda row: row["shape"])
def test_uneven_blocks_need_four_edges(row):
    study = study_of({"free_blocks": table_of(row), "exceptions": [{"inner_corner_loss": 0.1}]})
    with pytest.raises(StudyError, match="four edges"):
        magnet_of(study)


def test_iron_of_every_kind_in_three_dimensions():
    """A disc of iron and a pole: the parts that NGSolve meshes hold their volumes."""
    iron = {"relative_permeability": 100.0, "bodies": [
        {"kind": "tube", "inner_radius_m": 0.0, "outer_radius_m": 0.1, "length_m": 0.02,
         "z_m": 0.1},
        {"kind": "prism", "outline_m": [[0.15, -0.02], [0.2, -0.02], [0.2, 0.02]], "copies": 2,
         "length_m": 0.05}]}
    magnet = magnet_of(study_of(FREE, iron=iron))
    mesh = ngsolve_reaction.mesh_of(magnet, POINTS, Elements(0.02))
    ngs = pytest.importorskip("ngsolve")
    volume = ngs.Integrate(ngs.CF(1.0), mesh, definedon=mesh.Materials("iron"), order=6)
    assert volume == pytest.approx(np.pi * 0.1**2 * 0.02 + 2 * 0.05 * 0.05 * 0.04 / 2, rel=1e-3)
    for number, body in enumerate(magnet.bodies):
        region = mesh.Materials(f"block{number}")
        assert ngs.Integrate(ngs.CF(1.0), mesh, definedon=region) == pytest.approx(
            body.shape.volume, rel=1e-9)
        middle = [ngs.Integrate(axis, mesh, definedon=region) for axis in (ngs.x, ngs.y, ngs.z)]
        nodes, volumes = body.shape.nodes(3)
        expected = volumes @ (body.shape_orientation.apply(nodes) + body.position)
        np.testing.assert_allclose(middle, expected, atol=1e-9 * body.shape.volume)


def test_elements_are_small_at_the_ends_of_tubes():
    """Vertices on the rims of a tube are hardly farther apart than it is thick, unless a size is
    asked for, which is the control. By a point next to it an edge has the size of a tip.
    """
    thickness, outer, half = 0.01, 0.1, 0.02
    iron = {"relative_permeability": 100.0, "bodies": [
        {"kind": "tube", "inner_radius_m": outer - thickness, "outer_radius_m": outer,
         "length_m": 2 * half, "z_m": 0.0}]}
    magnet = magnet_of(study_of({"free_blocks": table_of(PLAIN)}, iron=iron))

    def farthest(elements, points=POINTS):
        mesh = ngsolve_reaction.mesh_of(magnet, points, elements)
        places = np.array([vertex.point for vertex in mesh.vertices])
        rim = (np.abs(np.hypot(*places[:, :2].T) - outer) < 1e-6) & (
            np.abs(places[:, 2] - half) < 1e-6)
        angles = np.sort(np.arctan2(places[rim, 1], places[rim, 0]))
        return outer * np.diff(angles, append=angles[0] + 2 * np.pi).max()

    assert farthest(Elements()) < 1.3 * thickness
    assert farthest(Elements(0.03)) > 1.7 * thickness
    assert farthest(Elements(0.03, edge=0.006)) < 1.3 * 0.006
    tip, middle = Elements(0.03, edge=0.015, tip=0.006), np.array([[0.0, 0.0, half]])
    assert farthest(tip, middle) < 1.3 * 0.006
    assert farthest(tip, 2 * middle + 0.1) > 1.7 * 0.006


def test_block_table_of_a_magnet_of_all_kinds():
    """Places, types and moments: of blocks before they were mounted; missing ones are left out."""
    array = CUBES | {"recoil_permeability": 1.0, "recoil_permeability_across": 1.0,
                     "free_blocks": table_of(PLAIN | {"z_m": 0.2, "type": "shim"}),
                     "exceptions": [{"ring": 1, "slot": 1, "mounted_from": (1, 2)},
                                    {"ring": 1, "slot": 2, "mounted_from": (1, 1),
                                     "magnetization_factor": -1.0},
                                    {"ring": 1, "slot": 3, "magnetization_factor": 0.0}]}
    study = study_of(array)
    nominal = magnet_of(study)
    table, _ = coil_table(study, nominal, nominal, 1e-8, np.random.default_rng(1))
    assert table.places == [(1, 2), (1, 1), (1, 4), (2, 1)]
    assert table.serial == ("B0001", "B0002", "B0004", "B0005")
    assert table.type == ("2", "1", "4", "shim")
    plain = build_magnet(study_of({key: value for key, value in array.items()
                                   if key != "exceptions"}))
    for place, moment in zip(table.places, table.moment, strict=True):
        block = plain.blocks[plain.number_of(*place)]
        angle = np.radians(block.angle_deg)
        x, y, z = block.magnetization * block.volume
        expected = [x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle),
                    z]
        np.testing.assert_allclose(moment, expected, atol=1e-6 * np.linalg.norm(expected))
    with pytest.warns(HalbachWarning, match="better than any coil"):  # so that it is exact
        found = prior_from_blocks(build_magnet(study), table).gaussian.mean.reshape(-1, 3)
    true = np.array([body.magnetization for body in nominal.bodies])
    np.testing.assert_allclose(found, true, atol=1e-6 * np.abs(true).max())


class Far:
    """Nothing is near any point."""

    def __init__(self, points):
        self.points = points

    def query(self, places):
        return np.full(places.shape[:-1], np.inf), None


@pytest.mark.parametrize(("near", "fails"), [(KDTree, False), (Far, True)])
def test_readings_nearer_to_iron_than_its_elements(near, fails, monkeypatch):
    """1.5 mm off a box, by elements of 10 mm, against such of 3 mm. 17 % of the largest field were
    measured; 1.2 times that field, where the rule of the quadrature does not see what is near.
    """
    magnet = magnet_of(study_with({"kind": "box", "size_m": [0.02, 0.02, 0.01]}))
    points = np.array([[x, y, z] for x in (-0.004, 0.0, 0.003) for y in (0.0, 0.004)
                       for z in (0.0065, -0.0065)])
    truth = ngsolve_reaction.reaction_field(magnet, points, Elements(size=0.003))
    monkeypatch.setattr(ngsolve_reaction, "KDTree", near)
    coarse = ngsolve_reaction.reaction_field(magnet, points, Elements(size=0.01))
    assert (np.abs(coarse - truth).max() > 0.4 * np.abs(truth).max()) == fails


@pytest.mark.parametrize(("mirrored", "right"), [((1, -1, -1), True), ((1, 1, -1), False)])
def test_an_eighth_of_a_symmetric_magnet(mirrored, right):
    """Two cuboids magnetized along z, one against the other, between four poles: the potential is
    even in x and odd in y and z. 0.4 % of the largest field were measured, from two meshes.
    """
    blocks = {"name": ["above", "below"], "shape": ["cuboid"] * 2, "x_m": [0.0] * 2,
              "y_m": [0.02, -0.02], "z_m": [0.0] * 2, "recoil_permeability": [1.1] * 2,
              "remanence_x_T": [0.0] * 2, "remanence_y_T": [0.0] * 2, "remanence_z_T": [1.2, -1.2],
              **{f"size_{axis}_m": [0.016] * 2 for axis in "xyz"}}
    magnet = magnet_of(study_with(
        {"kind": "box", "size_m": [0.016, 0.016, 0.006], "centre_m": [0.0, 0.02, 0.012],
         "mirrored": ["y", "z"]}, array={"free_blocks": blocks}))
    points = np.array([[x, y, z] for x in (-0.004, 0.003) for y in (-0.005, 0.002, 0.006)
                       for z in (-0.01, 0.0, 0.004)])
    whole, eighth = (ngsolve_reaction.reaction_field(magnet, points, Elements(
        size=0.004, mirrored=each)) for each in ((0, 0, 0), mirrored))
    assert (np.abs(eighth - whole).max() < 0.01 * np.abs(whole).max()) == right
