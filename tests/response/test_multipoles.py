"""Multipoles of magnets, by other means: magpylib's field, and closed forms."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from halbach_fe import api
from halbach_fe.core.arrays import radii_of
from halbach_fe.core.errors import HalbachWarning, StudyError
from halbach_fe.geometry.coils import distance_from_axis, points_in_winding
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.magnets import halbach_ring, magnet_of_blocks
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.measurement.positions import points_from
from halbach_fe.report.multipoles_page import answer, middle_circle, reference_text
from halbach_fe.response import multipoles
from halbach_fe.response.multipoles import (
    UNITS,
    MultipoleReference,
    circle_models,
    met,
    multipole_model,
    multipole_models,
    solved_circles,
    unwanted_orders,
)
from halbach_fe.response.response_matrix import Response, response_matrix
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.solver.session import NOT_KEPT, Session
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.external_keys import External
from halbach_fe.study.inference_keys import shifted
from halbach_fe.study.reader import parse_study
from halbach_fe.synthetic.magpylib_field import vacuum_field
from halbach_fe.synthetic.true_magnet_of_study import magnet_of
from tests.conftest import DIPOLE, changed

ORDERS = (1, 2, 3, 4, 5, 6)


def study_of(**changes):
    return parse_study(changed(DIPOLE, array__recoil_permeability=1.0,
                               array__blocks_per_ring=12, **changes))


def fourier(field, angle, order):
    """C_n of B (..., angles, 3) on a circle, B_y + i B_x = sum C_n e^{i (n-1) phi}."""
    values = field[..., 1] + 1j * field[..., 0]
    return np.mean(values * np.exp(-1j * (order - 1) * angle), axis=-1)


def deviating(study, generator):
    """A magnet with errors of 2 %, and its magnetizations."""
    nominal = magnet_of(study)
    size = study.dimension
    bodies = tuple(body.with_magnetization(body.magnetization + np.pad(
        0.02 * np.linalg.norm(body.magnetization) * generator.standard_normal(size),
        (0, 3 - size))) for body in nominal.bodies)
    return bodies, np.concatenate([body.magnetization[:size] for body in bodies])


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_cross_section_is_magpylibs(session, generator, order):
    """Both fields are exact: 1e-8 of the main multipole, what sums over angles leave."""
    study = study_of(array__multipole_order=order, array__first_magnetization_angle_deg=70.0)
    model = multipole_model(build_magnet(study), MultipoleReference(0.06, ORDERS), session)
    bodies, magnetizations = deviating(study, generator)
    angle = 2 * np.pi * np.arange(200) / 200
    points = 0.06 * np.column_stack([np.cos(angle + model.turn), np.sin(angle + model.turn),
                                     0 * angle])
    c, s = np.cos(model.turn), np.sin(model.turn)
    field = vacuum_field(bodies, points) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    main = abs(fourier(field, angle, order))
    known = model.of(Gaussian(magnetizations, np.zeros((len(magnetizations), 1))))
    assert known.main == pytest.approx(main, rel=1e-6)
    truth = np.array([fourier(field, angle, n) for n in model.orders]) * UNITS / main
    found = known.mean.reshape(2, -1)
    np.testing.assert_allclose(found[0] + 1j * found[1], truth, atol=1e-3)
    assert model.orders == tuple(n for n in ORDERS if n != order)
    assert np.abs(truth).max() > 10
    # the nominal main multipole is normal: C_N of these axes is real and positive
    nominal = vacuum_field(magnet_of(study).bodies, points) @ np.array(
        [[c, -s, 0], [s, c, 0], [0, 0, 1]])
    own = fourier(nominal, angle, order)
    assert own.real == pytest.approx(abs(own), rel=1e-9)
    roll = -np.angle(fourier(field, angle, order)) / order
    assert known.roll == pytest.approx(roll, abs=1e-8)
    # negative control: another reference radius
    other = multipole_model(build_magnet(study), MultipoleReference(0.066, ORDERS), session).of(
        Gaussian(magnetizations, np.zeros((len(magnetizations), 1))))
    assert np.abs(other.mean - known.mean).max() > 1


def test_a_short_magnet_integrated_along_z(session, generator):
    """magpylib's field summed over z, to 20 outer radii beyond the ends in fine steps."""
    study = parse_study(changed(
        DIPOLE, dimension=3, array__recoil_permeability=1.0, array__blocks_per_ring=8,
        array__ring_length_m=0.08, array__rings=2))
    model = multipole_model(build_magnet(study), MultipoleReference(0.05, (2, 3, 4)), session)
    assert model.integrated
    bodies, magnetizations = deviating(study, generator)
    angle = 2 * np.pi * np.arange(32) / 32
    z, weight = np.polynomial.legendre.leggauss(24)
    edges = np.array([0, 0.05, 0.1, 0.17, 0.3, 0.6, 1.5, 4.0])
    heights = np.concatenate([(a + b) / 2 + (b - a) / 2 * z for a, b in pairwise(edges)])
    weights = np.concatenate([(b - a) / 2 * weight for a, b in pairwise(edges)])
    heights, weights = np.concatenate([-heights, heights]), np.tile(weights, 2)
    turned = angle + model.turn
    points = np.array([[0.05 * np.cos(phi), 0.05 * np.sin(phi), height]
                       for height in heights for phi in turned])
    c, s = np.cos(model.turn), np.sin(model.turn)
    field = (vacuum_field(bodies, points) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])).reshape(
        len(heights), 32, 3)
    truth = np.array([weights @ fourier(field, angle, n) for n in (1, 2, 3, 4)])
    known = model.of(Gaussian(magnetizations, np.zeros((len(magnetizations), 1))))
    assert known.main == pytest.approx(abs(truth[0]), rel=1e-4)
    found = known.mean.reshape(2, -1)
    relative = UNITS * truth[1:] / abs(truth[0])
    np.testing.assert_allclose(found[0] + 1j * found[1], relative, atol=0.02)
    assert np.abs(relative).max() > 10
    # negative control: the circle in the middle is not the integral
    local = multipole_model(build_magnet(study), MultipoleReference(0.05, (2, 3, 4), 0.0), session)
    assert not local.integrated
    middle = local.of(Gaussian(magnetizations, np.zeros((len(magnetizations), 1)))).mean
    assert np.abs(middle - known.mean).max() > 1


ALONE = {"shape": ["cuboid"], "x_m": [0.04], "y_m": [0.0], "z_m": [0.0], "size_x_m": [0.02],
         "size_y_m": [0.02], "size_z_m": [0.02], "remanence_T": [1.3]}
TURNED = {
    "shape": ["cuboid", "sector"], "x_m": [0.05, 0.0], "y_m": [0.0, 0.0], "z_m": [0.0, 0.06],
    "size_x_m": [0.02, None], "size_y_m": [0.03, None], "size_z_m": [0.03, 0.02],
    "inner_radius_m": [None, 0.04], "outer_radius_m": [None, 0.06], "angle_deg": [None, 50.0],
    "remanence_x_T": [1.0, -0.2], "remanence_y_T": [0.5, 0.7], "remanence_z_T": [0.3, 0.4],
    "rotation_x_deg": [30.0, 10.0], "rotation_y_deg": [20.0, 0.0], "rotation_z_deg": [0.0, 200.0]}


def test_the_lowest_order_that_a_ring_as_designed_makes(session):
    """12 blocks of a dipole make order 11 on circles of a short ring, order 13 alone in a
    cross-section; what answers to them makes order 11 there too.
    """
    flat = study_of()
    short = parse_study(changed(
        DIPOLE, dimension=3, array__recoil_permeability=1.0, array__blocks_per_ring=12,
        array__ring_length_m=0.02, array__rings=1))
    angle = 2 * np.pi * np.arange(200) / 200
    points = 0.06 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    circle, plane = MultipoleReference(0.06, ORDERS, 0.0), MultipoleReference(0.06, ORDERS)
    for study, reference, lowest in ((short, circle, 11), (flat, plane, 13)):
        field = vacuum_field(magnet_of(study).bodies, points)
        radial = np.abs(np.fft.rfft(np.sum(field * points, axis=1)))
        assert np.flatnonzero(radial[2:] > 1e-6 * radial[1])[0] + 2 == lowest
        model = multipole_model(build_magnet(study), reference, session)
        assert f"of rings as designed is {lowest}," in reference_text(model, study)
    permeable = flat.with_(array__recoil_permeability=1.1)
    assert "of rings as designed is 11," in reference_text(model, permeable)


@pytest.mark.parametrize("table", [ALONE, TURNED], ids=["one cube", "turned in space"])
def test_blocks_without_symmetry_integrated_along_all_z(session, table):
    """magpylib's field over +-20 m; beyond it a dipole leaves (0.05 m / 20 m)^2 = 6e-6 of it.

    The control is the sum that was taken before, to 4.5 radii beyond the ends.
    """
    magnet = magnet_of_blocks(table)
    radius, orders = 0.02, (2, 3, 4, 6, 10)
    model = multipole_model(magnet, MultipoleReference(radius, orders), session)
    bodies = magnet_of(magnet.study).bodies
    angle = 2 * np.pi * np.arange(48) / 48
    nodes, weight = np.polynomial.legendre.leggauss(16)

    def summed(edges):
        edges = np.concatenate([-np.array(edges[:0:-1]), edges])
        heights = np.concatenate([(a + b) / 2 + (b - a) / 2 * nodes for a, b in pairwise(edges)])
        weights = np.concatenate([(b - a) / 2 * weight for a, b in pairwise(edges)])
        z, phi = (part.ravel() for part in np.meshgrid(heights, angle, indexing="ij"))
        field = vacuum_field(bodies, np.column_stack([
            radius * np.cos(phi), radius * np.sin(phi), z]))
        order = np.array([1, *orders])
        found = np.array([weights @ fourier(field.reshape(len(heights), -1, 3), angle, n)
                          for n in order]) * np.exp(1j * model.turn * order)
        return found[0], UNITS * found[1:] / abs(found[0])

    steps = [0.0, 0.02, 0.04, 0.06, 0.08, 0.11, 0.16]
    main, truth = summed([*steps, 0.3, 0.6, 1.2, 2.5, 5.0, 10.0, 20.0])
    known = model.of(Gaussian(model.nominal, np.zeros((len(model.nominal), 1))))
    assert known.main == pytest.approx(abs(main), rel=2e-5)
    b, a = known.mean.reshape(2, -1)
    np.testing.assert_allclose(b + 1j * a, truth, rtol=2e-5, atol=1e-3)
    assert 0 < known.error.max() < 1e-6  # units: it is stated, and what the quadrature leaves
    _, short = summed([*steps, magnet.field_reach])
    assert np.abs(short - truth).max() > 1


@pytest.mark.parametrize("order", [1, 2])
def test_a_quadrupole_of_free_blocks_whose_order_was_forgotten(session, order):
    """Its order 2 has the bar that it has where the order is stated, not that of a quotient by a
    dipole that is not there; the advice is to state it. The circle is about its middle.
    """
    angle = 2 * np.pi * np.arange(8) / 8
    magnet = magnet_of_blocks({
        "shape": ["cuboid"] * 8, "x_m": 0.06 * np.cos(angle), "y_m": 0.06 * np.sin(angle),
        "z_m": [0.7] * 8, "size_x_m": [0.02] * 8, "size_y_m": [0.02] * 8, "size_z_m": [0.04] * 8,
        "rotation_z_deg": np.degrees(3 * angle) % 360,
        "remanence_T": 1.3 + 1e-3 * np.arange(8)}, order=order)
    found = api.multipoles(magnet, session, MultipoleReference(0.02))
    said = answer(found.tables, None)
    stated = api.multipoles(magnet.with_(array__multipole_order=2), session,
                            MultipoleReference(0.02))
    for (model, magnets), (right, others) in zip(found.tables, stated.tables, strict=True):
        known, quadrupole = magnets["prior"], others["prior"]
        assert model.z == right.z in (None, 0.7)
        if order == 1:
            normal, skew = known.absolute.mean.reshape(2, -1)[:, 0]
            size = np.hypot(normal, skew)
            along = np.array([normal, skew]) / size @ known.absolute.root.reshape(2, 9, -1)[:, 0]
            assert size == pytest.approx(1e3 * quadrupole.main, rel=1e-9)
            assert np.linalg.norm(along) == pytest.approx(1e3 * quadrupole.main_sd, rel=0.01)
            by_quotient = 1e3 * known.main / UNITS * known.sd[0]  # the control
            assert by_quotient > 10 * np.linalg.norm(along)
    assert ("multipole_order = 2 below [array]" in said.step) == (order == 1)


@pytest.mark.filterwarnings("ignore:.*earth's field")
def test_the_integral_of_external_fields(session):
    """That of a uniform one is infinite, and left out; a dipole's is a plane dipole's, wherever it
    is. The control is the circle at z, which has the uniform field.
    """
    magnet = magnet_of_blocks(ALONE)
    place, moment = np.array([0.3, 0.1, 2.0]), np.array([300.0, 100.0, 50.0])
    around = magnet.with_(external={
        "background_T": [0.1, 0.0, 0.0],
        "dipoles": [{"position_m": place.tolist(), "moment_A_m2": moment.tolist()}]},
        uncertain=[{"name": "background", "sd": 1.0, "change": {"external.background_T[1]": 1e-3}}])
    reference = MultipoleReference(0.02, (2, 3))
    bare, model = (multipole_model(one, reference, session) for one in (magnet, around))
    at_z = multipole_model(around, replace(reference, z_m=0.0), session)
    order = np.array([1, 2, 3])
    plane = 2e-7 * 1j * order * 0.02**(order - 1) * (moment[0] + 1j * moment[1]) / (
        place[0] + 1j * place[1])**(order + 1)  # mu_0 / 2 pi is 2e-7 T m/A
    turned = np.exp(1j * model.turn * order)
    np.testing.assert_allclose(model.offset, plane * turned, rtol=1e-9)
    assert model.left_out_T == (0.1, 0.0, 0.0)
    assert (bare.left_out_T, at_z.left_out_T) == ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert abs(at_z.offset[0]) == pytest.approx(0.1, rel=1e-3)
    # nor does it widen the integral by what is not known of it
    assert np.abs(model.matrix[:, -1]).max() < 1e-12
    assert abs(at_z.matrix[0, -1]) == pytest.approx(1e-3, rel=1e-9)


def test_the_integral_beside_a_coaxial_coil_takes_no_time(monkeypatch, session):
    """It is zero, to which no relative error is ever reached: that took 301 000 fields, a minute.
    The coil off the axis, whose integral is none, is the control.
    """
    calls, field = [], multipoles.external_field
    monkeypatch.setattr(multipoles, "external_field", lambda *of: calls.append(1) or field(*of))
    for centre, size in (((0.0, 0.0, 0.1), 0.0), ((0.3, 0.0, 0.1), None)):
        calls.clear()
        magnet = magnet_of_blocks(ALONE).with_(external={"coils": [{
            "kind": "round", "radius_m": 0.1, "current_A": 1e4, "centre_m": list(centre),
            "rotation_deg": [0.0, 0.0 if size == 0 else 30.0, 0.0]}]})
        model = multipole_model(magnet, MultipoleReference(0.02, (2, 3)), session)
        assert len(calls) < 3000
        if size == 0.0:
            assert np.abs(model.offset).max() < 1e-12
        else:
            assert np.abs(model.offset).max() > 1e-6


ACROSS = {"kind": "polygon", "current_A": 5.0, "points_m": [
    [-1.5, 0.003, 1.5], [1.5, 0.003, 1.5], [1.5, 2.06, 1.5], [-1.5, 2.06, 1.5]]}


def test_how_far_windings_are_from_the_axis():
    """Of 200 points of a long loop none was in a circle that its wire crosses, the control."""
    wire, sheet, thick = External(coils=[ACROSS, {
        "kind": "round", "radius_m": 0.1, "section_m": [0.0, 0.02], "current_A": 5.0}, {
        "kind": "round", "radius_m": 0.1, "section_m": [0.01, 0.02], "current_A": 5.0,
        "centre_m": [0.1, 0.0, 0.0]}]).coils
    found = [distance_from_axis(coil, 1e-5) for coil in (wire, sheet, thick)]
    assert found == pytest.approx([0.003, 0.1, -0.005], abs=1e-5)
    assert radii_of(points_in_winding(wire)).min() > 0.02


@pytest.mark.parametrize(("external", "named"), [
    ({"coils": [{"kind": "round", "radius_m": 0.1, "section_m": [0, 0], "current_A": 5.0,
                 "centre_m": [0.01, 0, 0.4], "rotation_deg": [0, 90, 0]}]}, r"coils\[1\]"),
    ({"coils": [ACROSS]}, r"coils\[1\]"),
    ({"dipoles": [{"position_m": [0.0, 0.01, 1.0], "moment_A_m2": [0, 3, 0]}]}, r"dipoles\[1\]")])
def test_an_integral_that_has_sources_within_its_circle(session, external, named):
    """It is no multipole series: a wire across the axis made multipoles of all orders. On a circle
    at one z there is one.
    """
    magnet = magnet_of_blocks(ALONE).with_(external=external)
    reference = MultipoleReference(0.02, (2, 3))
    with pytest.raises(StudyError, match=f"{named}.* outside the circle.*--at-z-m"):
        multipole_model(magnet, reference, session)
    at_z = replace(reference, z_m=0.0)
    assert len(multipole_model(magnet, at_z, session).offset) == 3
    # beside that circle, as the command asks for both, the table of the integral is left out
    with pytest.warns(HalbachWarning, match="along z has a coil or dipole within the circle"):
        models, said = multipoles.multipole_models(magnet, (reference, at_z), session)
    assert [model.z for model in models] == [0.0]
    assert len(said) == 1


def test_a_circle_that_is_left_out_is_named_without_its_rounding(session):
    """One of 21 heights from -0.055 to 0.055 m is -7e-18 m."""
    dipole = {"position_m": [0.0, 0.01, 0.0], "moment_A_m2": [0, 1e-4, 0]}
    magnet = magnet_of_blocks(ALONE).with_(external={"dipoles": [dipole]})
    circles = [MultipoleReference(0.02, (2, 3), z_m) for z_m in (-7e-18, 0.02)]
    with pytest.warns(HalbachWarning, match=r"The circle at z = 0 mm has a coil or dipole within"):
        multipoles.multipole_models(magnet, circles, session)


def loop_beside_the_axis(x, half_length=0.1):
    """100 A up at x, and down at x = 0.3 m."""
    return {"coils": [{"kind": "polygon", "current_A": 100.0, "points_m": [
        [x, 0, -half_length], [x, 0, half_length], [0.3, 0, half_length], [0.3, 0, -half_length]]}]}


def test_a_wire_just_beyond_the_circle(session):
    """Its high orders were mistaken for low ones: c_10 of the circle half of its size, and c_2 of
    the integral 6 % off, without a word. Truth: B_y + i B_x = mu_0 I L / 2 pi (z - x), integrated;
    on the circle magpylib, by many angles. The control is that of as few angles as before.
    """
    magpylib = pytest.importorskip("magpylib")
    radius, x, order = 0.02, 0.0222, np.arange(1, 11)
    external = loop_beside_the_axis(x)
    magnet = magnet_of_blocks(ALONE | {"x_m": [-0.04]}).with_(external=external)
    model = multipole_model(magnet, MultipoleReference(radius), session)
    wires = -2e-7 * 100.0 * 0.2 * radius**(order - 1) * (x**-order - 0.3**-order)
    np.testing.assert_allclose(model.offset, wires * np.exp(1j * model.turn * order), rtol=1e-6)
    at_z = multipole_model(magnet, MultipoleReference(radius, z_m=0.01), session)
    corners = external["coils"][0]["points_m"]
    wire = magpylib.current.Polyline(current=100.0, vertices=[*corners, corners[0]])

    def on_circle(angles):
        angle = 2 * np.pi * np.arange(angles) / angles
        points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle + 0.01])
        radial = np.einsum("nc,nc->n", wire.getB(points)[:, :2], points[:, :2]) / radius
        return 2j * np.exp(-1j * np.outer(order, angle)) @ radial / angles

    found = at_z.offset * np.exp(-1j * at_z.turn * order)
    np.testing.assert_allclose(found, on_circle(2000), rtol=1e-6)
    assert np.abs(found / on_circle(45) - 1).max() > 0.01


def test_a_wire_just_beyond_the_circles_of_a_study(session):
    """What 32 angles mistake of it was in c_10 of a solved field and of an update: a quarter of it.
    Truth and control: by many angles, and by these alone.
    """
    radius, order = 0.02, np.arange(1, 11)
    study = parse_study(changed(
        DIPOLE, array__recoil_permeability=1.0, dimension=3, array__ring_length_m=0.1,
        external=loop_beside_the_axis(0.0225), observation__positions={
            "kind": "circles", "radius_m": radius, "angles": 32}))
    points, ring = points_from(study.observation.positions), build_magnet(study)
    (solved, _), = solved_circles(ring, points, ring.field_T(points), np.zeros(3 * len(points)))
    observation = observe(study, points, np.ones_like(points, bool))
    updated, = circle_models(ring, observation, response_matrix(ring, observation, session))

    def by(angles):
        angle = 2 * np.pi * np.arange(angles) / angles
        places = radius * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        radial = np.einsum("nc,nc->n", ring.field_T(places), places) / radius
        return 2j * np.exp(-1j * np.outer(order, angle)) @ radial / angles

    for model in (solved, updated):
        found = (model.offset + model.matrix @ model.nominal)[1:] * np.exp(
            -1j * model.turn * order)
        np.testing.assert_allclose(found[4:], by(2000)[4:], rtol=1e-5)
    assert np.abs(by(32) / by(2000) - 1)[-1] > 0.2


@pytest.mark.filterwarnings("ignore:.*earth's field")
@pytest.mark.parametrize(("external", "named"), [
    (loop_beside_the_axis(0.0199), r"coils\[1\]"),
    ({"coils": [{"kind": "racetrack", "size_m": [0.012, 0.008], "section_m": [0, 0.004],
                 "current_A": 5.0}]}, r"coils\[1\]"),
    ({"coils": [{"kind": "round", "radius_m": 0.04, "section_m": [0.002, 0.002], "current_A": 5,
                 "centre_m": [0, 0.0357, 0.0306], "rotation_deg": [50, 0, 0]}]}, r"coils\[1\]"),
    ({"dipoles": [{"position_m": [0.0, 0.01, 0.0], "moment_A_m2": [0, 3, 0]}]}, r"dipoles\[1\]")])
def test_a_circle_around_sources(session, external, named):
    """Its B_r was given as multipoles with Yes, though no series of them is the field in it. The
    controls are circles that the coil passes by.
    """
    magnet = magnet_of_blocks(ALONE).with_(external=external)
    with pytest.raises(StudyError, match=f"free of coils and dipoles within it.*{named}.*solve"):
        multipole_model(magnet, MultipoleReference(0.02, (2, 3), 0.0), session)
    assert multipole_model(magnet, MultipoleReference(0.02, (2, 3), 0.15), session)
    study = parse_study(changed(DIPOLE, array__recoil_permeability=1.0, dimension=3,
                                array__ring_length_m=0.1, external=external,
                                observation__positions={
        "kind": "circles", "radius_m": 0.02, "angles": 32, "z_min_m": 0.0, "z_max_m": 0.15,
        "count": 2}))
    points, ring = points_from(study.observation.positions), build_magnet(study)
    tables = solved_circles(ring, points, ring.field_T(points), np.zeros(3 * len(points)))
    assert [model.z for model, _ in tables] == [0.15]


def test_the_axes_beside_a_turned_neighbour(session):
    """They were those of the blocks alone, so that the magnet as ordered had a roll of 0.1 rad."""
    magnet = magnet_of_blocks(ALONE).with_(
        external={"neighbours": [{"z_m": 0.06, "turn_deg": 40.0}]})
    for z in (None, 0.02):
        model = multipole_model(magnet, MultipoleReference(0.02, (2, 3), z), session)
        nominal = model.of(Gaussian(model.nominal, np.zeros((len(model.nominal), 1))))
        assert abs(nominal.roll) < 1e-12
        bare = multipole_model(magnet.with_(external={}), MultipoleReference(0.02, (2, 3), z),
                               session)
        assert abs(bare.turn - model.turn) > 0.05


def test_what_is_cut_off_of_permeability_is_in_the_bar(session, monkeypatch):
    """The same cube summed over three times the distance. Measured: the continuation beyond the
    ends misses 8 % of itself, and all of it is in the bar; the control is the sum without it.
    """
    magnet = magnet_of_blocks(ALONE | {"recoil_permeability": [1.3]})
    known, errors = [], []
    for reach in (magnet.field_reach, 3 * magnet.field_reach):
        monkeypatch.setattr(type(magnet), "field_reach", reach)
        model = multipole_model(magnet, MultipoleReference(0.02, (2, 3)), session)
        known.append(abs(model.offset + model.matrix @ model.nominal)[0])
        errors.append(model.error[0])
    change, bar = abs(known[1] - known[0]), errors[0] - errors[1]  # that of the mesh is the same
    assert change < 0.2 * bar
    assert bar > 5e-4 * known[0]  # which the sum without the continuation is off


def test_covariances_are_those_of_samples(session, generator):
    """Of 4000 magnets, the covariance of c_n with the main multipole that each has: 5 % of the
    largest variance (sqrt(2/4000) = 2.2 %).
    """
    study = study_of()
    model = multipole_model(build_magnet(study), MultipoleReference(0.06, ORDERS), session)
    root = 0.01 * np.abs(model.nominal).max() * generator.standard_normal((24, 24)) / 5
    drawn = Gaussian(model.nominal, root).sample(4000, generator)
    values = model.units(model.offset + drawn @ model.matrix.T)
    known = model.of(Gaussian(model.nominal, root))
    scale = np.diag(known.covariance).max()
    np.testing.assert_allclose(np.cov(values.T), known.covariance, atol=0.05 * scale)
    # a common factor moves the main multipole and nothing else; relative to a fixed one it would
    common = model.of(Gaussian(drawn[0], 0.1 * drawn[0][:, None]))
    assert np.sqrt(np.diag(common.covariance)).max() < 1e-9 * UNITS
    assert common.main_sd == pytest.approx(0.1 * common.main, rel=1e-9)
    fixed = model.scaled(model.nominal_main) @ (0.1 * drawn[0])
    assert np.abs(fixed).max() > 1
    sizes = known.sizes_of(generator.standard_normal((4000, 2 * len(known.orders))))
    mine, real = np.mean(sizes**2, axis=0), np.mean(
        np.sum(values.reshape(-1, 2, len(known.orders))**2, axis=1), axis=0)
    np.testing.assert_allclose(mine, real, rtol=0.15)
    assert met(sizes, float(sizes.max())) == 1.0
    assert met(sizes, 0.0) == 0.0


def test_the_radius_is_that_of_the_studys_circle(session):
    assert multipole_model(build_magnet(study_of()), MultipoleReference(), session).radius == 0.075
    line = study_of(observation__positions={
        "kind": "line", "start_m": [0, 0, 0], "end_m": [0.05, 0, 0], "count": 3})
    assert multipole_model(build_magnet(line), MultipoleReference(),
                           session).radius == pytest.approx(0.104 * 2 / 3)


def test_what_the_mapper_does_is_no_multipole(session):
    """The reference circle is no measurement: a probe's gain does not come into it."""
    study = study_of(instrument={"gain": [0.1, 0.0, 0.0], "offset_T": [0.01, 0, 0]})
    one, other = (multipole_model(build_magnet(some), MultipoleReference(0.06, ORDERS), session)
                  for some in (study, study_of()))
    np.testing.assert_array_equal(one.matrix, other.matrix)


def test_permeability_and_its_error(session):
    """A symmetric dipole has no unwanted multipoles; the error bar allows for those of the mesh."""
    study = parse_study(DIPOLE)
    model = multipole_model(build_magnet(study), MultipoleReference(0.06, (3, 5)), session)
    assert model.error.max() > 0
    known = model.of(Gaussian(model.nominal, np.zeros((32, 1))))
    assert np.abs(known.mean).max() < 3 * known.sd.max()
    assert known.sd.max() < 1


RINGS = {"dimension": 3, "array__ring_length_m": 0.08, "array__rings": 2}
CIRCLES = {"kind": "circles", "radius_m": 0.06, "angles": 40, "z_min_m": -0.05, "z_max_m": 0.1,
           "count": 4}


def circles_of(study, session, measured=None):
    points = points_from(study.observation.positions)
    observation = observe(study, points, np.ones_like(points, bool) if measured is None
                          else measured)
    return circle_models(build_magnet(study), observation,
                         response_matrix(build_magnet(study), observation, session))


@pytest.mark.parametrize("quantity", ["flux_density", "fourier_coefficients"])
def test_circles_that_are_read(session, generator, quantity):
    """Without permeability both fields are exact; each circle is in units of the one at z = 0."""
    observed = {"quantity": quantity, "positions": CIRCLES}
    if quantity == "fourier_coefficients":
        observed["harmonics"] = 6
    study = study_of(**RINGS, observation=observed)
    models = circles_of(study, session)
    assert [model.z for model in models] == pytest.approx([-0.05, 0, 0.05, 0.1])
    bodies, magnetizations = deviating(study, generator)
    angle = 2 * np.pi * np.arange(40) / 40
    exact = Gaussian(magnetizations, np.zeros((len(magnetizations), 1)))

    def analysed(field, order):  # B_r, as a study's coefficients are
        radial = field[:, 0] * np.cos(angle) + field[:, 1] * np.sin(angle)
        return 2 * np.mean(radial * (np.sin(order * angle) + 1j * np.cos(order * angle)))

    turn = -models[0].turn
    fields = [vacuum_field(bodies, np.column_stack(
        [0.06 * np.cos(angle), 0.06 * np.sin(angle), 0 * angle + model.z])) for model in models]
    main = abs(analysed(fields[1], 1))
    for model, field in zip(models, fields, strict=True):
        truth = np.array([analysed(field, n) * np.exp(-1j * turn * n) for n in model.orders])
        known = model.of(exact)
        assert known.main == pytest.approx(main, rel=1e-8)
        b, a = known.mean.reshape(2, -1)
        np.testing.assert_allclose(b + 1j * a, UNITS * truth / main, atol=1e-4)
    assert models[3].of(exact).mean[0] < 0.8 * UNITS  # the ends are weaker


def test_circles_are_in_units_of_the_one_in_the_middle_of_the_magnet():
    """Those of rings that their z_m put elsewhere were in units of the field at an end, which the
    answer took for that in the middle. Control: the field at that end.
    """
    def found(z):
        magnet = build_magnet(study_of(dimension=3, array__ring_length_m=0.1, array__rings=2,
            array__ring=[{"z_m": z}, {"z_m": z + 0.1}], observation={
                "quantity": "flux_density", "positions": {
                    "kind": "circles", "radius_m": 0.06, "angles": 16, "z_min_m": z - 0.1,
                    "z_max_m": z + 0.2, "count": 7}}))
        points = points_from(magnet.study.observation.positions)
        tables = [(model, {"": known}) for model, known in solved_circles(
            magnet, points, magnet.field_T(points), np.zeros(3 * len(points)))]
        middle, known = middle_circle(tables, magnet)
        return middle.z - z, known[""].main, tables[0][1][""].mean[0]

    moved = found(0.1)
    assert moved == pytest.approx(found(-0.05), rel=1e-9)
    assert moved[0] == pytest.approx(0.05)
    assert moved[2] < 0.5 * UNITS


def test_a_negative_quadrupole_has_the_same_axes_on_all_circles(session):
    """Rounding took some for turned by 90 degrees and others by -90, in whose axes odd orders have
    opposite signs. Control: a quadrupole that is turned otherwise.
    """
    ring = halbach_ring(order=2, blocks=16, inner_radius_m=0.02, outer_radius_m=0.04)

    def turns(angle):
        magnet = ring.with_(array__first_magnetization_angle_deg=angle)
        return [multipole_model(magnet, MultipoleReference(radius), session).turn
                for radius in np.linspace(0.004, 0.015, 12).tolist()]

    assert turns(90.0) == pytest.approx([-np.pi / 2] * 12)
    assert turns(80.0) != pytest.approx([-np.pi / 2] * 12, abs=0.01)


def test_a_main_multipole_that_is_lost_in_the_error_is_no_unit():
    """As between the poles of an undulator, whose field on the axis changes its sign there."""
    magnet = build_magnet(study_of(**RINGS, observation={
        "quantity": "flux_density", "positions": CIRCLES}))
    points = points_from(magnet.study.observation.positions)
    field = field_of(magnet.blocks, points)
    main = solved_circles(magnet, points, field, np.zeros(field.size))[0][1].main
    for error, found in ((0.1, 4), (2.0, 0)):  # each of a component of B
        assert len(solved_circles(magnet, points, field, np.full(field.size, error * main))
                   ) == found
    middle = np.abs(points[:, 2]) < 1e-9
    for factor, found in ((0.1, 4), (0.01, 0)):  # of the field in the middle alone
        weak = np.where(middle[:, None], factor, 1.0) * field
        assert len(solved_circles(magnet, points, weak, np.zeros(field.size))) == found


@pytest.mark.parametrize("quantity", ["flux_density", "fourier_coefficients"])
def test_few_angles_do_not_mistake_high_orders_for_low_ones(
        session, generator, monkeypatch, quantity):
    """Twelve angles, first of them at 0, against 240. Control: their sums, aliases included."""
    observed = {"quantity": quantity, "positions": CIRCLES | {"angles": 12}}
    if quantity == "fourier_coefficients":
        observed["harmonics"] = 5
    study = study_of(**RINGS, observation=observed)
    bodies, magnetizations = deviating(study, generator)
    angle = 2 * np.pi * np.arange(240) / 240
    exact = Gaussian(magnetizations, np.zeros((len(magnetizations), 1)))
    errors = {}
    for name in ("without", "with"):
        if name == "with":
            monkeypatch.setattr(multipoles, "_aliases", lambda *arguments: 3 * (0.0,))
        models = circles_of(study, session)
        main = None
        for model in sorted(models, key=lambda one: abs(one.z)):
            field = vacuum_field(bodies, np.column_stack(
                [0.06 * np.cos(angle), 0.06 * np.sin(angle), 0 * angle + model.z]))
            radial = field[:, 0] * np.cos(angle) + field[:, 1] * np.sin(angle)
            truth = np.array([2 * np.mean(radial * (np.sin(n * angle) + 1j * np.cos(n * angle)))
                              * np.exp(1j * model.turn * n) for n in model.orders])
            main = main or abs(truth[0])
            b, a = model.of(exact).mean.reshape(2, -1)
            errors.setdefault(name, []).append(np.abs(b + 1j * a - UNITS * truth / main).max())
    assert max(errors["without"]) < 1e-4  # units of the main multipole; measured 2e-6
    assert min(errors["with"]) > 0.5  # and 0.9 to 4.7


def test_circles_that_are_none(session):
    """Nothing is said of a line, of half a circle, of one component, or through a probe's gain."""
    study = study_of()
    count = len(points_from(study.observation.positions))
    assert circles_of(study, session)
    measured = np.ones((count, 3), bool)
    measured[::3] = False
    assert circles_of(study, session, measured) == []
    for changes in ({"observation__components": ["x"]}, {"instrument": {"gain": [0.1, 0, 0]}},
                    {"observation__positions": {"kind": "line", "start_m": [0, 0, 0],
                                                "end_m": [0.05, 0, 0], "count": 3}}):
        assert circles_of(study_of(**changes), session) == []


def test_references_solved_together(session):
    """Are the same as one by one."""
    study = study_of(**RINGS)
    wanted = MultipoleReference(0.05, (2, 3)), MultipoleReference(0.05, (2, 4), 0.02)
    together, left_out = multipole_models(build_magnet(study), wanted, session)
    for one, reference in zip(together, wanted, strict=True):
        alone = multipole_model(build_magnet(study), reference, session)
        np.testing.assert_allclose(one.matrix, alone.matrix, rtol=1e-12, atol=1e-20)
        assert (one.orders, one.z, one.integrated) == (alone.orders, alone.z, alone.integrated)
    assert left_out == ()
    assert together[0].integrated
    assert not together[1].integrated


def test_the_main_multipole_has_the_solver_s_error(session):
    """As the unwanted ones have; the control is the same model without an error."""
    model = multipole_model(build_magnet(study_of()), MultipoleReference(0.06, ORDERS), session)
    size = len(model.nominal)
    exact = Gaussian(model.nominal, np.zeros((size, 1)))
    off = replace(model, error=np.full(len(model.error), 3e-4))
    assert model.of(exact).main_sd < 1e-12
    known = off.of(exact)
    assert known.main_sd == pytest.approx(3e-4)
    assert known.roll_sd == pytest.approx(3e-4 / known.main)  # of a dipole
    assert known.sd == pytest.approx(UNITS * 3e-4 / known.main)
    # beside what the blocks leave open
    root = np.zeros((size, 1))
    root[:, 0] = 1e-3 * model.nominal
    assert off.of(Gaussian(model.nominal, root)).main_sd == pytest.approx(
        np.hypot(1e-3 * known.main, 3e-4))


POLES = {
    "name": "poles", "dimension": 2, "mesh": {"block_size_m": 0.003, "bore_size_m": 0.0015},
    "array": {"multipole_order": 2, "free_blocks": {
        "name": ["right", "top", "left", "bottom"], "shape": ["cuboid"] * 4,
        "x_m": [0.038, 0.0, -0.038, 0.0], "y_m": [0.0, 0.038, 0.0, -0.038], "z_m": [0.0] * 4,
        "size_x_m": [0.032, 0.01, 0.032, 0.01], "size_y_m": [0.01, 0.032, 0.01, 0.032],
        "remanence_x_T": [0.0, 1.25, 0.0, -1.25], "remanence_y_T": [1.25, 0.0, -1.25, 0.0],
        "remanence_z_T": [0.0] * 4}},
    "iron": {"relative_permeability": 1000.0, "bodies": [{
        "kind": "prism", "copies": 4, "outline_m": [
            [0.01061, 0.01061], [0.02, 0.0056], [0.06, 0.0456], [0.0456, 0.06], [0.0056, 0.02]]}]},
    "observation": {"quantity": "flux_density", "positions": {
        "kind": "circles", "radius_m": 0.01, "angles": 8}}}


def test_circles_beside_poles_of_iron_have_enough_angles(monkeypatch):
    """The poles begin at 15 mm, the blocks at 22 mm.

    Orders up to 300 that are alike at 15 mm are no part of those up to 10; with the angles that the
    blocks need they were hundreds of units of them.
    """
    def response(magnet, observation, session):
        place = (observation.points[:, 0] + 1j * observation.points[:, 1]) / 0.015
        field = sum(place**(order - 1) for order in (2, *range(40, 301)))
        readings = observation.apply(np.column_stack([field.imag, field.real, 0 * field.real]))
        return Response(readings[:, None], ("strength",), np.ones(1), *2 * (0 * readings,), 0.0,
                        of_neighbours=np.zeros((len(readings), 0)))

    monkeypatch.setattr(multipoles, "response_matrix", response)
    magnet = build_magnet(parse_study(POLES))
    model = multipole_model(magnet, MultipoleReference(0.014, tuple(range(1, 11))), NOT_KEPT)
    assert np.abs(model.units(model.offset + model.matrix[:, 0])).max() < 0.1
    assert multipole_model(magnet, MultipoleReference(), NOT_KEPT).radius == 0.01


def test_circles_that_all_but_touch_poles_are_refused(session):
    magnet = build_magnet(parse_study(POLES))
    with pytest.raises(StudyError, match=r"to 0\.01425 m, as the poles' inner radius is 0\.015 m"):
        multipole_model(magnet, MultipoleReference(0.0145), session)


@pytest.mark.parametrize(("length_m", "z_m"), [(None, None), (0.1, None), (0.1, 0.0)])
@pytest.mark.parametrize("wall_m", [0.0003, 0.01])
def test_circles_around_iron_are_refused(session, length_m, z_m, wall_m):
    """They are all in air, but iron within them has a field of its own. Walls thinner than the
    steps in which iron is looked for were not seen. Controls: a circle within, and one beside it.
    """
    tube = {"kind": "tube", "inner_radius_m": 0.0201, "outer_radius_m": 0.0201 + wall_m}
    magnet = halbach_ring(blocks=8, inner_radius_m=0.05, outer_radius_m=0.07, length_m=length_m
                          ).with_(iron={"relative_permeability": 100.0, "bodies": [tube]})
    with pytest.raises(StudyError, match=r"at most 0\.0201 m, where iron begins.* received 0\.035"):
        multipole_model(magnet, MultipoleReference(0.035, z_m=z_m), session)
    assert unwanted_orders(magnet, MultipoleReference(0.018, z_m=z_m))[1] == 0.018
    if z_m is not None:
        assert unwanted_orders(magnet, MultipoleReference(0.035, z_m=0.06))[1] == 0.035


@pytest.mark.parametrize(("external", "key", "sd"), [
    ({"coils": [{"kind": "round", "centre_m": [0.0, 0.09, 0.0], "radius_m": 0.025,
                 "rotation_deg": [70.0, 20.0, 0.0], "current_A": 1000.0}]},
     "coils[1].current_A", 50.0),
    ({"dipoles": [{"position_m": [0.1, 0.05, 0.02], "moment_A_m2": [10.0, 5.0, 3.0]}]},
     "dipoles[1].moment_A_m2[1]", 1.0),
    ({"neighbours": [{"z_m": 0.15}]}, "neighbours[1].factor", 0.05)])
def test_amplitudes_of_sources_are_integrated_along_all_of_z(external, key, sd):
    """Their columns are by how much the nominal multipoles change with them. Sums over some length,
    continued as a multipole falls, were 1 to 2 % off beside bars of zero.
    """
    magnet = halbach_ring(
        blocks=8, inner_radius_m=0.03, outer_radius_m=0.05, length_m=0.06,
        remanence_T=1.2).with_(external=external, uncertain=[
            {"name": "source", "sd": sd, "change": {f"external.{key}": 1.0}}])
    reference = MultipoleReference(radius_m=0.02, orders=(2, 3, 4))

    def nominal(amount):
        changed = build_magnet(shifted(magnet.study, magnet.study.uncertain[0], amount * sd))
        model = multipole_model(changed, reference, Session.temporary())
        return (model.offset + model.matrix @ model.nominal) * np.exp(
            -1j * model.turn * np.array([model.main, *model.orders]))

    model = multipole_model(magnet, reference, Session.temporary())
    column = model.matrix[:, -1] * np.exp(-1j * model.turn * np.array([1, 2, 3, 4]))
    change = (nominal(0.1) - nominal(-0.1)) / 0.2
    np.testing.assert_allclose(column, change, atol=1e-6 * np.abs(change).max())
