"""Irreversible losses against a scalar equation, magpylib, finer cells, and where none are."""

from __future__ import annotations

import re
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from scipy.optimize import brentq, root

from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.magnets import magnet_of_blocks
from halbach_fe.solver.moments.solve import KneeLaw, System, solve_irreversible
from halbach_fe.solver.routes import check_points
from halbach_fe.solver.separate_blocks import solve_separate
from halbach_fe.solver.session import Session
from halbach_fe.study.materials import MU_0, Demagnetization, grade
from halbach_fe.study.reader import parse_study
from tests.solver.moments.bodies import cuboid

LAW = KneeLaw(0.45, 0.8)  # a cube of 1.3 T opposes itself by a third of that
SIDE = 0.012
CHI = 0.05


@pytest.fixture
def cube():
    return replace(cuboid((SIDE,) * 3, easy=(0.0, 0.0, 1.0)), remanence=1.3,
                   recoil_permeability=1 + CHI, recoil_permeability_across=1 + CHI)


def polarization(moments, block):
    """Mean polarization in T along the easy axis."""
    return (moments.block_moments()[0] / block.volume) @ block.easy_axis + block.remanence


def test_the_law_has_its_knee_where_the_standard_says():
    assert LAW.kept(-0.8 * 0.45) == pytest.approx(0.9)
    assert LAW.kept(-0.45) == pytest.approx(0.0)
    h = np.linspace(-0.6, 0.2, 9)
    assert LAW.slope(h) == pytest.approx((LAW.kept(h + 1e-6) - LAW.kept(h - 1e-6)) / 2e-6,
                                         rel=1e-4, abs=1e-8)


def test_coercivity_falls_with_temperature():
    keys = {"intrinsic_coercivity_A_per_m": 9e5, "squareness": 0.9, "irreversible": True,
            "remanence_coefficient_per_K": -1e-3, "coercivity_coefficient_per_K": -6e-3}
    assert KneeLaw.of(Demagnetization(**keys, temperature_C=70.0)).coercivity_T == pytest.approx(
        0.7 / 0.95 * MU_0 * 9e5)


def test_hot_blocks_are_in_a_weaker_field(cube):
    """The part that is lost is that of a cube of the remanence at its temperature, which is 12 %
    less; by the coercivity alone it was a third more, at 80 degrees twice as much.
    """
    material = Demagnetization(**grade("N42").demagnetization_defaults, temperature_C=120.0)
    hot, at_hot = 1 + 100 * material.remanence_coefficient_per_K, MU_0 * (
        1 + 100 * material.coercivity_coefficient_per_K) * material.intrinsic_coercivity_A_per_m
    parts = []
    for remanence, law in ((1.3, KneeLaw.of(material)), (1.3 * hot, KneeLaw(at_hot, 0.9)),
                           (1.3, KneeLaw(at_hot, 0.9))):
        system = System.of([replace(cube, remanence=remanence)], cells_per_side=3)
        parts.append(solve_irreversible(system, law)[1].mean() / remanence)
    stated, expected, by_coercivity = parts
    assert stated == pytest.approx(expected, rel=1e-3)
    assert by_coercivity > 1.2 * expected


def test_one_cube_in_one_cell_keeps_what_its_own_field_leaves(cube):
    """The mean field of a uniform cube in itself is a third of its polarization, by symmetry."""
    moments, lost = solve_irreversible(System.of([cube], cells_per_side=1), LAW, by_mean=True)

    def surplus(value):
        return cube.remanence * LAW.kept(-value / 3) - CHI * value / 3 - value

    exact = brentq(surplus, 0.0, cube.remanence)
    # Newton's method ends at 1e-4 of the remanence
    assert polarization(moments, cube) == pytest.approx(exact, abs=3e-4)
    assert lost[0] == pytest.approx(cube.remanence * (1 - LAW.kept(-exact / 3)), abs=1e-3)
    assert lost[0] > 0.1 * cube.remanence  # the law bites


def thirds(middle, easy):
    """27 equal parts of a cube: the nodes (27, n, 3) in m of each, their weights (n,), and mean
    mu_0 H along the easy axis in each per polarization of each, by magpylib.
    """
    steps = SIDE / 3 * np.array([-1, 0, 1])
    places = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    places = places + middle
    nodes, weights = np.polynomial.legendre.leggauss(6)
    inside = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), -1).reshape(-1, 3) * SIDE / 6
    share = np.einsum("i,j,k->ijk", weights, weights, weights).ravel() / 8
    sources = [magpylib.magnet.Cuboid(polarization=easy, dimension=(SIDE / 3,) * 3, position=place)
               for place in places]
    matrix = MU_0 * np.array([[share @ (source.getH(place + inside) @ easy) for source in sources]
                              for place in places])
    return places[:, None] + inside, share, matrix


def test_cells_agree_with_magpylib(cube):
    """magpylib's field, averaged over each of 27 cuboids, makes a system that scipy solves."""
    matrix = thirds(cube.from_frame(np.zeros((1, 3))), np.array(cube.easy_axis))[2]
    found = root(lambda j: cube.remanence * LAW.kept(matrix @ j) + CHI * matrix @ j - j,
                 np.full(27, 0.8 * cube.remanence), tol=1e-12)
    assert found.success
    moments, lost = solve_irreversible(System.of([cube], cells_per_side=3), LAW, by_mean=True)
    truth = cube.remanence * (1 - LAW.kept(matrix @ found.x))
    # the field across the easy axis induces a polarization that magpylib's system leaves out, and
    # 216 nodes integrate the singular edges to some 1e-3
    assert polarization(moments, cube) == pytest.approx(np.mean(found.x), abs=5e-3)
    assert np.sort(lost) == pytest.approx(np.sort(truth), abs=0.02)
    assert np.ptp(truth) > 0.1  # the loss differs from place to place


def test_a_loss_raises_the_field_where_it_is():
    """The part p solves its equation; where nothing else lowers the field, less is lost."""
    field, mean = np.linspace(-0.6, 0.0, 13), 1.2
    part, slope = LAW.kept_in_tubes(field, np.array(1.3), np.array(mean))
    assert part == pytest.approx(LAW.kept(field - (1.3 * part - mean) / 2), abs=1e-9)
    more = LAW.kept_in_tubes(field + 1e-6, np.array(1.3), np.array(mean))[0]
    assert slope == pytest.approx((more - part) / 1e-6, rel=1e-3, abs=1e-5)
    assert np.all((part > LAW.kept(field)) == (1.3 * part < mean))


def test_few_cells_find_what_is_lost_at_edges():
    """The field of what a cube in vacuum has lost, against that extrapolated from many cells.

    Cells that lose by the mean of the field, the negative control, miss most of it.
    """
    cube = replace(cuboid((SIDE,) * 3, easy=(0.0, 0.0, 1.0)), remanence=1.3,
                   recoil_permeability=1.0, recoil_permeability_across=1.0)
    law = KneeLaw(0.8, 0.85)
    points = cube.from_frame(2 * SIDE * np.array([[0, 0, 1.0], [0, 1, 0], [0.7, 0, 0.7]]))

    def field(cells, by_mean=False):
        system = System.of([cube], cells_per_side=cells)
        return solve_irreversible(system, law, by_mean=by_mean)[0].reaction(points)

    coarse, fine = field(5, by_mean=True), field(7, by_mean=True)
    truth = fine + (fine - coarse) / ((7 / 5)**2 - 1)  # by the square of the size of the cells
    size = np.linalg.norm(truth)
    # measured: 0.06; the law of the mean leaves 0.71
    assert np.linalg.norm(field(3) - truth) < 0.2 * size
    assert np.linalg.norm(field(3, by_mean=True) - truth) > 0.6 * size


def test_without_a_knee_nothing_is_lost(cube):
    other = replace(cube, displacement_m=(0.02, 0.0, 0.0))
    system = System.of([cube, other])
    linear = system.solve().block_moments()
    moments, lost = solve_irreversible(system, KneeLaw(5.0, 0.9))
    assert np.abs(lost).max() < 1e-10
    # second-order terms of the linear solver are left out, 4e-3 of the reaction
    assert moments.block_moments() == pytest.approx(linear, abs=6e-3 * np.abs(linear).max())


STUDY = {
    "name": "two", "array": {"multipole_order": 1, "rings": 1, "blocks_per_ring": 8,
                             "inner_radius_m": 0.02, "outer_radius_m": 0.05, "ring_length_m": 0.04,
                             "remanence_T": 1.4, "recoil_permeability": 1.05,
                             "block": {"shape": "sector"}},
    "mesh": {"block_size_m": 0.01}, "observation": {
        "quantity": "flux_density", "positions": {"kind": "points", "points_m": [[0, 0, 0]]}},
    "demagnetization": {"intrinsic_coercivity_A_per_m": 8e5, "squareness": 0.9,
                        "remanence_coefficient_per_K": -1e-3, "coercivity_coefficient_per_K": -6e-3,
                        "irreversible": True}}


def test_what_contradicts_losses_is_refused():
    parse_study(STUDY)
    for change, sentence in (({"solver": {"route": "azimuthal_modes"}}, "moments"),
                             ({"demagnetization": STUDY["demagnetization"] | {"squareness": 1.0}},
                              "squareness")):
        with pytest.raises(StudyError, match=sentence):
            parse_study(STUDY | change)


def test_losses_of_cubes_of_two_grades():
    """Far apart, each loses what it loses alone by its own coercivity."""
    magnet = magnet_of_blocks({
        "shape": ["cuboid"] * 2, "x_m": [0.0, 100 * SIDE], "y_m": [0.0] * 2, "z_m": [0.0] * 2,
        "material": ["N42SH", "N42"], **{f"size_{axis}_m": [SIDE] * 2 for axis in "xyz"}})
    study = magnet.study.with_(array__material="N42SH", demagnetization=Demagnetization(
        **grade("N42SH").demagnetization_defaults, temperature_C=120.0, irreversible=True))
    points = np.array([[0.0, 0.0, 2 * SIDE], [100 * SIDE, 0.0, 2 * SIDE]])
    both = solve_separate(magnet.with_study(study), Session.temporary()).field(points)
    for number, name in enumerate(("N42SH", "N42")):
        alone = {of: solve_irreversible(System.of([magnet.blocks[number]]), KneeLaw.of(
            study.demagnetization.with_(**grade(of).demagnetization_defaults)))[0].reaction(points)
            for of in ("N42SH", "N42")}
        # the field of the other cube, 100 sides away, is 1e-6 T
        assert both[number] == pytest.approx(alone.pop(name)[number], abs=1e-5)
        (other,) = alone.values()
        assert np.abs(both[number] - other[number]).max() > 1e-3


@pytest.fixture
def hot_cube():
    """A magnet of one cube, which has been at 100 °C."""
    magnet = magnet_of_blocks({
        "shape": ["cuboid"], "x_m": [0.0], "y_m": [0.0], "z_m": [0.0], "material": ["N42"],
        **{f"size_{axis}_m": [SIDE] for axis in "xyz"}})
    return magnet.with_study(magnet.study.with_(
        array__material="N42", mesh__cells_per_side=3, demagnetization=Demagnetization(
            **grade("N42").demagnetization_defaults, temperature_C=100.0, irreversible=True)))


@pytest.mark.filterwarnings("ignore:.*1200 times the earth")
@pytest.mark.parametrize("external", ["neighbour", "background"])
def test_losses_count_the_external_field(hot_cube, external):
    """The mean polarization of a hot cube, whose equations are solved at its temperature: there its
    remanence and that of a neighbour are lower, but not the field of a background.
    """
    block, (material,) = hot_cube.blocks[0], hot_cube.demagnetizations
    easy, chi = np.array(block.easy_axis), block.recoil_permeability - 1
    warmer, coercivity = (1 + 80 * each for each in (
        material.remanence_coefficient_per_K, material.coercivity_coefficient_per_K))
    law = KneeLaw(MU_0 * coercivity * material.intrinsic_coercivity_A_per_m, material.squareness)
    nodes, share, matrix = thirds(np.zeros(3), easy)
    if external == "neighbour":
        beside = hot_cube.with_(external__neighbours=[{"z_m": 1.2 * SIDE}])
        other = magpylib.magnet.Cuboid(polarization=block.remanence * easy, dimension=(SIDE,) * 3,
                                       position=(0, 0, 1.2 * SIDE))
        field = other.getB(nodes.reshape(-1, 3)).reshape(nodes.shape) @ easy @ share
        there = warmer * field
    else:
        beside = hot_cube.with_(external__background_T=(-0.06 * easy).tolist())
        field = there = np.full(27, -0.06)

    def mean(there, field):
        """Mean polarization at 20 °C, where nothing more is lost."""
        hot = root(lambda j: block.remanence * warmer * law.kept(matrix @ j + there)
                   + chi * (matrix @ j + there) - j, np.full(27, block.remanence), tol=1e-12)
        kept = block.remanence * law.kept(matrix @ hot.x + there)
        return np.linalg.solve(np.eye(27) - chi * matrix, kept + chi * field).mean()

    alone, opposed = ([polarization(each, block) for each in solve_separate(
        magnet, Session.temporary()).blocks] for magnet in (hot_cube, beside))
    expected, near = mean(there, field), 3e-3  # without an external field they differ by 1e-3
    assert opposed[1] == pytest.approx(expected, abs=near)
    for wrong in (0.0, warmer, 1 / warmer):  # of no heat, or of sources that answer it as others do
        assert abs(mean(wrong * there, field) - expected) > 2 * near
    # what the field takes by the law of the nodes, too much by up to 0.05; without heat it is
    # 0.07 less of the background
    taken = mean(0 * there, 0 * field) - expected
    assert alone[0] - opposed[0] == pytest.approx(taken, rel=0.06)


@pytest.mark.filterwarnings("ignore:.*1200 times the earth")
def test_iron_far_away_changes_no_losses(hot_cube):
    """Beside iron of any shape the background counts in full in the heat, as it does without."""
    block = hot_cube.blocks[0]
    beside = hot_cube.with_(external__background_T=(-0.06 * np.array(block.easy_axis)).tolist())
    near_iron = beside.with_(mesh__growth=4.0, mesh__block_size_m=0.006, iron={
        "relative_permeability": 10.0, "bodies": [
            {"kind": "box", "size_m": [2e-3] * 3, "centre_m": [0.05, 0.0, 0.0]}]})
    alone, other = (polarization(solve_separate(magnet, Session.temporary(), False).blocks[0],
                                 block) for magnet in (beside, near_iron))
    assert other == pytest.approx(alone, abs=3e-4)  # as Newton ends


def test_weak_fields_and_those_that_iron_may_shield_change_no_losses(hot_cube):
    """The earth's field needs no solution of its own. Beside coaxial iron, which does not answer to
    external fields, the losses do not either, as a warning says; without iron there is none.
    """
    session, point = Session.temporary(), np.array([[0.0, 2 * SIDE, 0.0]])
    assert solve_separate(hot_cube.with_(external__background_T=(5e-5, 0.0, 0.0)),
                          session) is solve_separate(hot_cube, session)
    beside = hot_cube.with_(external__neighbours=[{"z_m": 1.2 * SIDE}])
    check_points(beside, point)
    in_tube = beside.with_(iron_ring={"inner_radius_m": 0.1, "outer_radius_m": 0.11,
                                      "relative_permeability": 1000.0})
    with pytest.warns(HalbachWarning) as caught:
        check_points(in_tube, point)
    assert re.search(r"up to 55\.2 mT in the middles .* left out of", " ".join(
        str(each.message) for each in caught))


def test_newtons_steps_are_few(cube):
    """Its matrix is nearly the derivative, that by a cell's own polarization included: 5
    steps. Without that one every step leaves a half to 0.7 of the residual, and it takes 13.
    """
    others = [replace(cube, origin_m=(1.1 * SIDE * i, 0.0, 1.1 * SIDE * k))
              for i in range(2) for k in range(2)]
    moments, _ = solve_irreversible(System.of(others, cells_per_side=3), LAW)
    assert 2 < moments.steps < 9
