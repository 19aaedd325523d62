"""Rotationally symmetric iron against closed forms, against NGSolve, and against itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from halbach_fe.core.errors import GetDPError, PointsOutsideError, StudyError
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver import axisymmetric_iron, iron_modes
from halbach_fe.solver.axisymmetric_iron import coupled_modes, solve_iron, to_angles, to_modes
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.iron_modes import Resolution, grid_lines, iron_cells
from halbach_fe.solver.ring_harmonics_2d import ideal_sectors, layered_bore_field
from halbach_fe.study.materials import froehlich_kennelly
from halbach_fe.synthetic import ngsolve_reaction
from halbach_fe.synthetic.true_magnet import FroehlichLaw
from tests.oracles.sectors import bore_field

IRON = {"initial": 200.0, "saturation": 1.0}
CURVE = froehlich_kennelly(**IRON)
TUBE = IronSolid(0.03, 0.036, -0.025, 0.025, law=CURVE)
POINTS = np.array([[0, 0, 0], [0.008, 0.003, 0.01], [-0.005, 0.008, -0.02], [0.004, -0.009, 0.03]])
FEW = Resolution(edge=0.4, growth=2.2, largest=0.15, modes=8, boundary=10.0)
"""For what holds on any mesh."""


def dipole(moment, place=(0.008, 0.0, 0.005)):
    """mu_0 H of a dipole; ``moment`` is mu_0 m in T m^3 (Jackson, equation 5.56)."""
    def field(points):
        d = points - np.array(place)
        r = np.linalg.norm(d, axis=1)[:, None]
        along = (d @ np.array(moment))[:, None]
        return (3 * d * along / r**5 - np.array(moment) / r**3) / (4 * np.pi)
    return field


STRONG = dipole((3e-4, 0.9e-4, 1.5e-4))  # makes some 0.9 T at the tube and saturates it


def worst(found, truth):
    return np.abs(found - truth).max() / np.abs(truth).max()


def test_infinitely_long_tube_in_closed_form(short_dipole, session):
    """The reaction of a long tube, in the middle, is that of the two-dimensional closed form.

    The blocks are infinitely long, and all magnetized along x, because a Halbach dipole has no
    field outside. The ends of the tube, at L = 12 m, change its magnetization in the middle by some
    (R / L)^2 = 3e-4.
    """
    magnet = build_magnet(short_dipole(
        array__recoil_permeability=1.0, array__rings=1))
    array = magnet.array
    tube = IronSolid(0.2, 0.21, -12.0, 12.0, law=100.0)
    blocks = [replace(block, easy_axis=(1.0, 0.0, 0.0), z_min=-np.inf, z_max=np.inf)
              for block in magnet.blocks]
    found = solve_iron([tube], lambda points: field_of(blocks, points), session,
                       resolution=Resolution(largest=5.0, modes=18), estimate=False)
    angle = np.linspace(0, 2 * np.pi, 7)
    ring = np.column_stack([0.06 * np.cos(angle), 0.06 * np.sin(angle)])
    sectors = ideal_sectors(-1, array.blocks_per_ring, array.remanence_T,
                            np.radians(array.first_block_angle_deg))
    radii = array.inner_radius_m, array.outer_radius_m

    def truth(permeability):
        return layered_bore_field(sectors, *radii, 1.0, ring, (0.2, 0.21, permeability)
                                  ) - bore_field(sectors, *radii, ring)

    reaction = found.field(np.column_stack([ring, np.zeros(7)]))
    assert worst(reaction[:, :2], truth(100.0)) < 2e-3
    assert worst(reaction[:, :2], truth(90.0)) > 1e-2  # negative control: another permeability


def test_thick_plate_mirrors_a_dipole(session):
    """A plate of permeability mu reflects a dipole with the factor (mu - 1) / (mu + 1).

    The plate is a disc with the axis inside, 20 times as wide as the dipole's distance: the rest
    of the half-space makes 20^-3 of the field. All modes matter, since the dipole is off the axis.
    """
    place, mirrored = (0.01, 0.005, 0.02), (0.01, 0.005, -0.02)
    plate = IronSolid(0.0, 0.4, -0.3, 0.0, law=50.0)
    found = solve_iron([plate], dipole((1e-6, 2e-6, 3e-6), place), session,
                       resolution=Resolution(edge=0.01, growth=1.3, largest=0.3, modes=10))
    k = 49 / 51
    points = np.array([[0, 0, 0.01], [0.01, 0, 0.03], [-0.02, 0.01, 0.005], [0.03, 0.03, 0.04]])
    image = dipole((-k * 1e-6, -k * 2e-6, k * 3e-6), mirrored)(points)
    error = np.abs(found.field(points) - image)
    assert error.max() < 0.01 * np.abs(image).max()
    assert (error <= 2 * found.error(points) + 20.0**-3 * np.abs(image).max()).mean() >= 0.95
    assert worst(found.field(points), -image) > 1  # negative control: the sign


def by_ngsolve(bodies, source, points, size=0.012, order=2):
    """The reaction of tubes by NGSolve, with the reduced potential and a dipole's exact field.

    Where iron saturates, reduced potentials do not suffer from cancellation.
    """
    ngs, occ = pytest.importorskip("ngsolve"), pytest.importorskip("netgen.occ")
    solids = []
    for body in bodies:
        axes = occ.Axes((0, 0, body.z_min), occ.Z)
        height = body.z_max - body.z_min
        solids.append(occ.Cylinder(axes, body.outer_radius, height)
                      - occ.Cylinder(axes, body.inner_radius, height))
        solids[-1].mat("iron")
        solids[-1].maxh = size
    world = occ.Sphere(occ.Pnt(0, 0, 0), 0.4)
    world.faces.name = "far"
    air = world - occ.Glue(solids)
    air.mat("air")
    mesh = ngs.Mesh(occ.OCCGeometry(occ.Glue([*solids, air])).GenerateMesh(maxh=0.1, grading=0.5))
    mesh.Curve(3)
    moment, place = source
    d = [x - a for x, a in zip((ngs.x, ngs.y, ngs.z), place, strict=True)]
    r = ngs.sqrt(d[0]**2 + d[1]**2 + d[2]**2)
    along = sum(a * b for a, b in zip(d, moment, strict=True))
    own = ngs.CF(tuple((3 * a * along / r**5 - b / r**3) / (4 * np.pi)
                       for a, b in zip(d, moment, strict=True)))
    space = ngs.H1(mesh, order=order, dirichlet="far")
    u, v = space.TnT()

    def polarization(potential):
        field = own - ngs.grad(potential)
        law = ngsolve_reaction.permeability(
            FroehlichLaw(**IRON), field * field)
        return (law - 1) * field

    form = ngs.BilinearForm(space, condense=True)
    form += ngs.grad(u) * ngs.grad(v) * ngs.dx
    form += -polarization(u) * ngs.grad(v) * ngs.dx("iron", bonus_intorder=4)
    solution = ngs.GridFunction(space)
    ngsolve_reaction.newton(form, solution, iterate=True)
    rule = ngs.IntegrationRule(ngs.TET, 2 * order)
    where = mesh.MapToAllElements({ngs.TET: rule}, mesh.Materials("iron"))
    places = np.array(ngs.CF((ngs.x, ngs.y, ngs.z))(where))
    jacobian = np.array(ngs.specialcf.JacobianMatrix(3, 3)(where)).reshape(-1, 3, 3)
    weights = np.resize(rule.weights, len(places)) * np.abs(np.linalg.det(jacobian))
    moments = np.array(polarization(solution)(where)) * weights[:, None]
    return ngsolve_reaction.moment_field(places, moments, points)


@pytest.mark.parametrize("bodies", [
    (TUBE,), (replace(TUBE, outer_radius=0.032), IronSolid(0.012, 0.036, 0.027, 0.031, law=CURVE))
], ids=["thick tube", "thin tube and end plate"])
def test_saturating_iron_against_ngsolve(bodies, session):
    """Non-linear iron near a dipole off the axis, where all modes are coupled.

    NGSolve with elements of order 2 and 12 mm differs by 4e-3, with order 3 and 8 mm by 1.6e-3 in
    the thick tube and 6e-4 with the end plate.
    """
    moment, place = (3e-4, 0.9e-4, 1.5e-4), (0.008, 0.0, 0.005)
    points = POINTS[:3]
    truth = by_ngsolve(bodies, (moment, place), points)
    found = solve_iron(bodies, dipole(moment, place), session, estimate=False)
    assert worst(found.field(points), truth) < 8e-3
    other = [replace(body, law=froehlich_kennelly(IRON["initial"], 0.9)) for body in bodies]
    # negative control: another saturation, 9e-2 off; with the right one this mesh is 4e-3 off
    wrong = solve_iron(other, dipole(moment, place), session, resolution=FEW, estimate=False)
    assert worst(wrong.field(points), truth) > 0.03


def test_bars_cover_the_error_and_are_no_longer_than_needed(session):
    """At the corners of a map beyond the ends of a tube, against elements of half the size.

    With elements of the air up to 0.08 of the iron's outer radius, 7 % of these points were more
    than two bars off. That bars are at most five times the error is what issue 51 asks.
    """
    grid = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3), axis=3).reshape(-1, 3)
    points = grid * [0.016, 0.016, 0.03]
    own = Resolution(modes=12)
    fine = Resolution(own.edge / 2, 1.35, own.largest / 2, own.modes)
    found = solve_iron([TUBE], STRONG, session, resolution=own)
    error = np.linalg.norm(found.field(points) - solve_iron(
        [TUBE], STRONG, session, resolution=fine, estimate=False).field(points), axis=1)
    bars = found.error(points)[:, 0]
    assert np.mean(error <= 2 * bars) >= 0.95
    assert np.linalg.norm(bars) < 5 * np.linalg.norm(error)


def test_iron_of_another_law_is_not_assembled_again(session, monkeypatch):
    """A diagnosis compares iron of several saturations in one place. The controls are another
    thickness, which is, and the field, which is that of the other law.
    """
    def solved(body):
        return solve_iron([body], STRONG, session, resolution=FEW, estimate=False).field(POINTS)

    softer = replace(TUBE, law=froehlich_kennelly(IRON["initial"], 0.9))
    axisymmetric_iron._assembled.cache_clear()
    alone = solved(softer)
    axisymmetric_iron._assembled.cache_clear()
    made, assemble = [], axisymmetric_iron.assemble_modes
    monkeypatch.setattr(axisymmetric_iron, "assemble_modes",
                        lambda *given: made.append(given) or assemble(*given))
    first, second = solved(TUBE), solved(softer)
    assert len(made) == 1
    np.testing.assert_allclose(second, alone, atol=1e-12 * np.abs(alone).max())
    assert worst(first, second) > 0.03
    solved(replace(TUBE, outer_radius=1.1 * TUBE.outer_radius))
    assert len(made) == 2


def test_a_weak_source_sees_the_initial_permeability(session):
    """At 1e-5 of the strong source the curve is linear: |H| is then 1e-4 of the half field."""
    weak = dipole((3e-9, 0.9e-9, 1.5e-9))
    curve = solve_iron([TUBE], weak, session, resolution=FEW, estimate=False).field(POINTS)
    linear = solve_iron([replace(TUBE, law=IRON["initial"])], weak, session, resolution=FEW,
                        estimate=False)
    assert worst(curve, linear.field(POINTS)) < 1e-3
    assert len(linear.residuals) <= 4  # a linear problem needs no more than rounding demands
    strong = solve_iron([TUBE], STRONG, session, resolution=FEW, estimate=False).field(POINTS)
    assert worst(1e-5 * strong, curve) > 0.1  # negative control: a saturated tube


def test_tangent_of_linear_iron_is_its_reaction(session):
    found = solve_iron([replace(TUBE, law=30.0)], STRONG, session, resolution=FEW, estimate=False)
    once = found.tangent([STRONG], POINTS, modes=8)[0]
    assert worst(once, found.field(POINTS)) < 1e-5  # the tolerance of conjugate gradients
    nodes = found.nodes(64)
    assert worst(found.tangent(STRONG(nodes)[None], POINTS, modes=8)[0], once) < 1e-5


def test_tangent_against_finite_differences(session):
    """The derivative at a saturated state; the error of central differences is the step squared."""
    state = solve_iron([TUBE], STRONG, session, resolution=FEW, estimate=False)
    more = dipole((1e-6, -2e-6, 1e-6), (0.0, -0.01, -0.005))
    up, down = (solve_iron([TUBE], lambda points, sign=sign: STRONG(points) + sign * more(points),
                           session, resolution=FEW, estimate=False, start=state).field(POINTS)
                for sign in (1, -1))
    tangent = state.tangent([more], POINTS, modes=8)[0]
    assert worst(tangent, (up - down) / 2) < 1e-3
    linear = solve_iron([replace(TUBE, law=IRON["initial"])], more, session, resolution=FEW,
                        estimate=False).field(POINTS)
    assert worst(tangent, linear) > 0.1  # negative control: iron that does not saturate


def test_split_iron_is_the_same_iron(session):
    """Two rectangles that touch are one body; only the grid differs, by 0.5 % of the reaction."""
    halves = [replace(TUBE, z_max=0.01), replace(TUBE, z_min=0.01)]
    whole, split = (solve_iron(bodies, STRONG, session, resolution=FEW, estimate=False
                               ).field(POINTS) for bodies in ([TUBE], halves))
    assert worst(split, whole) < 5e-3
    gap = solve_iron([replace(TUBE, z_max=0.005), halves[1]], STRONG, session, resolution=FEW,
                     estimate=False).field(POINTS)
    assert worst(gap, whole) > 0.01  # negative control: a gap of 5 mm


def test_modes_that_iron_couples():
    """A dipole of eight sectors has modes 1, 7, 9, ...; iron adds the other odd ones."""
    assert coupled_modes([1, 7, 9], 9).tolist() == [1, 3, 5, 7, 9]
    assert coupled_modes([2, 6, 10], 10).tolist() == [2, 6, 10]
    assert coupled_modes([1, 2], 4).tolist() == [0, 1, 2, 3, 4]
    assert coupled_modes([0], 4).tolist() == [0]
    assert coupled_modes([4], 12).tolist() == [4, 12]


def test_fourier_transforms():
    numbers = np.array([0, 1, 3])
    c = np.array([2.0, 1 - 2j, 0.5j])
    angle = 2 * np.pi * np.arange(8) / 8
    values = sum((a * np.exp(1j * m * angle)).real for a, m in zip(c, numbers, strict=True))
    assert np.allclose(to_angles(c, numbers, 8), values)
    assert np.allclose(to_modes(values, numbers), c)


def test_grid_holds_every_edge_of_the_iron():
    bodies = [TUBE, IronSolid(0.0, 0.02, 0.04, 0.05, law=10.0)]
    r, z = grid_lines(bodies, Resolution())
    for lines, edges in ((r, (0.0, 0.02, 0.03, 0.036)), (z, (-0.025, 0.025, 0.04, 0.05))):
        assert (np.diff(lines) > 0).all()
        assert all(np.abs(lines - edge).min() < 1e-12 for edge in edges)
    area = np.outer(np.diff(r), np.diff(z))
    number = iron_cells(bodies, r, z)
    assert np.isclose(area[number == 0].sum(), 0.006 * 0.05)
    assert np.isclose(area[number == 1].sum(), 0.02 * 0.01)


@pytest.mark.parametrize("second", [replace(TUBE, z_min=0.0, z_max=0.05),
                                    replace(TUBE, outer_radius=0.02)])
def test_impossible_iron(second, session):
    with pytest.raises(StudyError):
        solve_iron([TUBE, second], STRONG, session)


def test_points_in_iron_are_refused(session):
    found = solve_iron([replace(TUBE, law=30.0)], STRONG, session, resolution=FEW, estimate=False)
    with pytest.raises(PointsOutsideError):
        found.field(np.array([[0.033, 0, 0]]))


def test_a_matrix_that_is_not_ours_is_refused(session, monkeypatch):
    """Another rule of integration stands for another numbering of the unknowns."""
    monkeypatch.setattr(np.polynomial.legendre, "leggauss",
                        lambda count: (np.array([-0.7, 0, 0.7]), np.array([5, 8, 5]) / 9))
    with pytest.raises(GetDPError, match="matrix differs"):
        iron_modes.assemble_modes("tube", [TUBE], FEW, session)
