"""Gross errors of maps by magpylib, named and put right; effects of usual size are none."""

from __future__ import annotations

import numpy as np
import pytest

import halbach_fe as hf
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.gross_errors import find_gross_errors
from halbach_fe.diagnosis.map_conventions import array_variants
from halbach_fe.geometry.blocks import rotation_about_z
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.field_map import field_map, points_of
from halbach_fe.measurement.probe_law import in_si_and_magnet_axes, nonlinear_part, sensor_model
from halbach_fe.report.diagnosis_answer import answer
from halbach_fe.solver.exact_block_field import external_field, field_of
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import parse_study
from tests.conftest import circle
from tests.diagnosis.campaign import CIRCLES, STUDY, drawn, field, measured, table_of, with_array

NONE = np.eye(3)


@pytest.fixture(scope="module")
def right():
    return measured(STUDY, np.random.default_rng(7))


def written(data, positions=NONE, fields=NONE):
    """A map whose columns are those of the right one times matrices."""
    return field_map(points_of(data) @ np.transpose(positions),
                     data["B_T"].values @ np.transpose(fields))


def flipped(*names):
    return np.diag([-1.0 if name in names else 1.0 for name in "xyz"])


def swapped(order):
    return np.eye(3)[["xyz".index(name) for name in order]]


def about_z(degrees):
    angle = np.radians(degrees)
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0],
                     [0, 0, 1]])


WRITTEN = {
    "millimetres": (1e3 * NONE, NONE), "centimetres": (100 * NONE, NONE),
    "millitesla": (NONE, 1e3 * NONE), "gauss": (NONE, 1e4 * NONE),
    "reversed_z": (flipped("z"), NONE),
    "sign_flipped_axis x": (NONE, flipped("x")), "sign_flipped_axis y": (NONE, flipped("y")),
    "sign_flipped_axis frame": (flipped("x"), flipped("x")),
    "swapped_axes probe": (NONE, swapped("xzy")), "swapped_axes points": (swapped("zyx"), NONE),
    "swapped_axes frame": (swapped("yxz"), swapped("yxz")),
    "rotated_by_one_block": (about_z(30), about_z(30)),
    "rotated_by_one_block 3 back": (about_z(-90), about_z(-90)),
    "wrong_radius 0.5": (np.diag([2.0, 2.0, 1.0]), NONE),  # then inside of the magnet
    "wrong_radius 1.25": (np.diag([0.8, 0.8, 1.0]), NONE)}


@pytest.mark.parametrize("case", WRITTEN)
def test_a_map_that_is_written_wrongly(case, right):
    """One error, which may have others that the magnet's symmetry makes the same."""
    data = written(right, *WRITTEN[case])
    (found,) = find_gross_errors(STUDY, data)
    assert len(found.names) == 1
    assert case.split()[0] in {*found.names, *(name for one in found.alternatives
                                               for name in one.names)}
    # blocks of 1 % leave 0.6 % here, and 0.8 % of a flipped By, which is 5 % of the field
    assert found.misfit_after < 0.01 < 0.04 < found.misfit_before
    study = found.apply(STUDY)
    assert find_gross_errors(study, data) == ()
    if case.startswith(("milli", "centi", "gauss", "wrong_radius", "swapped_axes p")):
        # without a symmetry it is the map that it was
        read = in_si_and_magnet_axes(study.instrument, data)
        factor = 1 + study.instrument.radius_scale
        np.testing.assert_allclose(points_of(read) * [factor, factor, 1], points_of(right),
                                   atol=2e-3)  # a radius to 2 %, by a field that is off by 1 %
        np.testing.assert_allclose(read["B_T"], right["B_T"], atol=1e-12)


@pytest.mark.parametrize("case", ["rolled", "gauss", "swapped_axes points"])
def test_what_is_open_of_the_instrument_is_no_gross_error(right, case):
    """A probe that is rolled by 3 % of the field, where the study says as much the other way: the
    mirror image of the map would hide it. The registered map of an MRI magnet was such a one.
    """
    rolled = np.array([[1, 0, 0], [0.03, 1, 0], [0, 0, 1]])
    positions, fields = (NONE, rolled) if case == "rolled" else WRITTEN[case]
    data = written(right, positions, fields)
    said = STUDY.with_(instrument__crosstalk={"yx": -0.03} if case == "rolled" else {})
    stated = said.with_(instrument_sd={"crosstalk": 0.03, "rotation_rad": 0.03, "gain": 3e-3})
    names = [error.names for error in find_gross_errors(said, data)]
    assert names == [("sign_flipped_axis",)] if case == "rolled" else names  # the control
    assert [error.names for error in find_gross_errors(stated, data)] == (
        [] if case == "rolled" else names)


@pytest.mark.parametrize("shown", "yz")
def test_the_only_column_is_of_another_component(right, shown):
    """A study that observes y alone, and a map whose column By has that component."""
    study = STUDY.with_(observation=STUDY.observation.with_(components=("y",)))
    data = right.copy(deep=True)
    data["B_T"].values[:] = np.nan
    data["B_T"].values[:, 1] = right["B_T"].values[:, "xyz".index(shown)]
    found = find_gross_errors(study, data)
    assert [error.names for error in found] == [("swapped_axes",)] * (shown != "y")
    for error in found:
        read = in_si_and_magnet_axes(error.apply(study).instrument, data)["B_T"].values
        np.testing.assert_array_equal(read[:, 2], right["B_T"].values[:, 2])
        assert error.apply(study).observation.components == ("y", "z")


@pytest.mark.parametrize("case", ["reversed_z", "right", "displaced", "without a table"])
def test_an_error_that_only_measured_blocks_show(case, generator):
    """Of Bx and By alone the two ends of this magnet are alike, but for its blocks. A map that is
    displaced by as much as usual is none.
    """
    built = drawn(STUDY, generator)
    at = CIRCLES * [1, 1, 1 if case in ("right", "displaced") else -1]
    true = field(STUDY, built, at + np.array([0.0, 0.0, 1e-3]) * (case == "displaced"))
    data = field_map(CIRCLES, np.where([True, True, False], true, np.nan))
    table = None if case == "without a table" else table_of(STUDY, built, generator)
    found = [error.names for error in find_gross_errors(STUDY, data, table)]
    assert found == ([("reversed_z",)] if case == "reversed_z" else [])


def test_a_magnet_beside_a_box_of_iron_is_not_turned():
    """The iron would have to turn with it; a tube looks the same from all sides."""
    box = {"kind": "box", "size_m": [0.1, 0.02, 0.1], "centre_m": [0.0, 0.5, 0.0]}
    tube = {"kind": "tube", "inner_radius_m": 1.0, "outer_radius_m": 1.1}
    for body, turned in ((box, False), (tube, True)):
        study = STUDY.with_(iron={"relative_permeability": 100.0, "bodies": [body]})
        names = {one.name for one in array_variants(study)}
        assert ("rotated_by_one_block" in names) == turned


def test_a_magnet_is_turned_with_what_exceptions_say_of_it():
    """A ring that is tilted, displaced or of another magnetization, with its direction."""
    study = STUDY.with_(array__exceptions=[
        {"ring": 1, "tilt_deg": (0.5, 0.1), "shift_m": (1e-3, 0.0, 0.0)},
        {"slot": 2, "magnetization_angle_deg": 20.0}])
    turn = next(one for one in array_variants(study) if one.name == "rotated_by_one_block")
    before, after = (build_magnet(each).blocks for each in (study, turn.change(study)))
    move = rotation_about_z(np.radians(after[0].angle_deg - before[0].angle_deg))
    assert move[0, 1] != 0
    for old, new in zip(before, after, strict=True):
        for key in ("mounted_middle", "polarization", "rotation_rad"):
            np.testing.assert_allclose(
                getattr(new, key), move @ np.array(getattr(old, key)), atol=1e-9)


@pytest.mark.parametrize(("case", "keys"), {
    "wrong_ring_count": {"rings": 4}, "wrong_ring_count less": {"rings": 2},
    "wrong_magnetization_direction": {"first_magnetization_angle_deg": 0.0},
    "wrong_magnetization_direction 90": {"first_magnetization_angle_deg": 270.0},
    "wrong_multipole_order": {"multipole_order": 2}}.items())
def test_another_magnet(case, keys, generator):
    built = with_array(**keys)
    data = measured(built, generator)
    (found,) = find_gross_errors(STUDY, data)
    assert case.split()[0] in {*found.names, *(name for one in found.alternatives
                                               for name in one.names)}
    study = found.apply(STUDY)
    assert find_gross_errors(study, data) == ()
    if found.names == (case.split()[0],):
        assert study.array == built.array


def test_points_that_were_elsewhere(generator):
    shift = np.array([0.012, -0.005, 0.02])
    data = measured(STUDY, generator, at=CIRCLES + shift)
    (found,) = find_gross_errors(STUDY, data)
    assert found.names == ("wrong_line",)
    # blocks of 1 % move the field by as much as 1 mm does
    np.testing.assert_allclose(found.apply(STUDY).instrument.translation_m, shift, atol=1e-3)


def test_several_errors(right):
    """In mm and mT, with Bx of the wrong sign: each alone explains nothing."""
    data = written(right, 1e3 * NONE, 1e3 * flipped("x"))
    (found,) = find_gross_errors(STUDY, data)
    assert found.names == ("millimetres", "millitesla", "sign_flipped_axis")
    study = found.apply(STUDY)
    np.testing.assert_allclose(in_si_and_magnet_axes(study.instrument, data)["B_T"], right["B_T"],
                               atol=1e-12)


def test_what_the_study_knows_is_no_error(right):
    data = written(right, 1e3 * NONE)
    study = STUDY.with_(instrument__length_unit_m=1e-3)
    assert find_gross_errors(study, data) == ()


def test_a_line_with_one_component(generator):
    """Of the axis little is to be seen; what is, is named with all that it may be."""
    line = np.column_stack([np.zeros((41, 2)), np.linspace(-0.2, 0.2, 41)])
    data = measured(STUDY, generator, line)
    data["B_T"].values[:, 1:] = np.nan
    assert find_gross_errors(STUDY, data) == ()
    assert find_gross_errors(STUDY, field_map(-line, data["B_T"].values)) == ()  # it looks the same
    (found,) = find_gross_errors(STUDY, field_map(1e3 * line, data["B_T"].values))
    assert found.names == ("millimetres",)
    data["B_T"].values[:, 0] *= -1
    (found,) = find_gross_errors(STUDY, data)
    assert found.names == ("sign_flipped_axis",)
    assert {"wrong_magnetization_direction", "rotated_by_one_block"} <= {
        name for one in found.alternatives for name in one.names}


def test_a_clean_map(right):
    assert find_gross_errors(STUDY, right) == ()


SOLVED = {"iron_ring", "iron_saturation", "knee", "recoil_permeability",
          "recoil_permeability_across"}
GROSS = {"wrong_line", "wrong_radius"}
"""Where the catalogue and the gross errors meet; smaller ones are the former's."""


@pytest.mark.parametrize("effect", [
    one for one in catalogue() if one.name not in SOLVED | GROSS and one.name[-2:] not in (
        "_y", "_z") and one.places(STUDY)],  # it has neither iron nor coils
                         ids=lambda one: one.name)
def test_effects_of_usual_size_are_no_gross_errors(effect, right, generator):
    """Negative control: three standard deviations of anything in the catalogue; of sensors that
    differ by their component one.
    """
    places = effect.places(STUDY)
    place = places[int(generator.integers(len(places)))]
    values = [(1 if effect.is_binary else 3) * one.sd for one in effect.parameters]
    true = effect.apply(STUDY, place, values)

    def shown(study):
        used = sensor_model(study.instrument, CIRCLES)
        linear = (used.operator
                  @ (field_of(build_magnet(study).blocks, used.points) + external_field(
            build_magnet(study), used.points)).ravel()).reshape(-1, 3)
        return linear + nonlinear_part(study.instrument, linear, np.linspace(0, 1, len(CIRCLES)))

    change = shown(true) - shown(STUDY)
    found = find_gross_errors(STUDY, field_map(CIRCLES, right["B_T"].values + change))
    assert found == ()


def test_what_no_error_explains_is_not_named(right, generator):
    """Negative controls: readings in disorder, another bore."""
    order = generator.permutation(len(CIRCLES))
    assert find_gross_errors(STUDY, field_map(CIRCLES, right["B_T"].values[order])) == ()
    other = measured(with_array(inner_radius_m=0.12, outer_radius_m=0.17), generator)
    assert find_gross_errors(STUDY, other) == ()


LINE = np.column_stack([np.zeros((41, 2)), np.linspace(-0.2, 0.2, 41)])


@pytest.mark.parametrize("shift", [(0.04, 0.0, 0.0), (0.0, 0.04, 0.0)])
def test_sides_that_one_component_does_not_tell_apart(generator, shift):
    """Bx is the same on both sides of the axis: all are told, the true one among them."""
    data = measured(STUDY, generator, LINE, at=LINE + np.array(shift))
    data["B_T"].values[:, 1:] = np.nan
    (found,) = find_gross_errors(STUDY, data)
    assert found.names == ("wrong_line",)
    sides = np.array([start["wrong_line"] for start in found.starts])
    # along the axis every displacement is sharp; across, Bx of blocks of 1 % is flat
    assert np.abs(sides[:, 2]).max() < 1e-3
    along = sides[:, int(np.argmax(shift))]
    assert max(np.abs(along - 0.04).min(), np.abs(along + 0.04).min()) < 4e-3
    assert found.convention not in found.alternatives


def test_a_side_that_three_components_tell(generator):
    """Negative control: Bz is opposite on the other side."""
    data = measured(STUDY, generator, LINE, at=np.add(LINE, [0.04, 0.0, 0.0]))
    (found,) = find_gross_errors(STUDY, data)
    assert found.alternatives == ()
    assert found.convention.shift_m == pytest.approx((0.04, 0.0, 0.0), abs=2e-3)


def test_an_error_is_not_its_own_alternative(generator):
    """On the axis a wrong sign of x changes no position, and is that of Bx alone."""
    data = measured(STUDY, generator, LINE)
    (found,) = find_gross_errors(STUDY, field_map(LINE, data["B_T"].values * [-1, 1, 1]))
    assert found.names == ("sign_flipped_axis",)
    read = [in_si_and_magnet_axes(each.apply(STUDY).instrument, data)
            for each in (found.convention, *found.alternatives) if each.magnet is None]
    assert len({(each["B_T"].values.tobytes(), points_of(each).tobytes()) for each in read}) == len(
        read)


@pytest.mark.parametrize("lacking", [1, 2])
def test_a_wrong_block_is_not_another_number_of_rings(generator, lacking):
    """In millimetres, with one of eight blocks of a ring missing or upside down."""
    study = with_array(blocks_per_ring=8, rings=2, block={"shape": "sector"})
    blocks, points = build_magnet(study).blocks, CIRCLES * [0.9, 0.9, 0.4]
    true = field_of(blocks, points) - lacking * field_of(blocks[3:4], points)
    data = field_map(1e3 * points, true + 5e-5 * generator.standard_normal(true.shape))
    (found,) = find_gross_errors(study, data)
    assert found.names == ("millimetres",)
    assert found.misfit_after > 0.05  # by itself it would not have been believed
    assert find_gross_errors(found.apply(study), data) == ()


@pytest.fixture(scope="module")
def yoked(getdp, tmp_path_factory):
    """A quadrupole in an iron ring, in cross-section, and its field on two circles.

    The iron changes the field more than a wrong block does, and the search does not know of it.
    """
    study = parse_study({
        "name": "yoked", "dimension": 2,
        "array": {"multipole_order": 2, "blocks_per_ring": 16, "inner_radius_m": 0.02,
                  "outer_radius_m": 0.036, "remanence_T": 1.3, "block": {"shape": "sector"}},
        "iron_ring": {"inner_radius_m": 0.038, "outer_radius_m": 0.046,
                      "relative_permeability": 1000.0},
        "mesh": {"block_size_m": 0.004, "bore_size_m": 0.004},
        "observation": {"quantity": "flux_density", "components": ["x", "y"], "positions": {
            "kind": "circles", "radius_m": [0.0067, 0.0133], "angles": 32}},
        "noise": {"regions": [{"name": "all", "sigma_T": 7e-5}]}})
    points = np.vstack([circle(0.0067, 32), circle(0.0133, 32)])
    field = solve_nominal(build_magnet(study), points,
                          Session(getdp, tmp_path_factory.mktemp("yoked")))
    return study, points, np.column_stack([field[:, :2], np.full(len(points), np.nan)])


@pytest.mark.parametrize(("columns", "names"), [
    ([1, 2], []), ([1, -2], ["sign_flipped_axis"]), ([2, 1], ["swapped_axes"])])
def test_no_component_of_a_cross_section_is_put_along_z(yoked, generator, columns, names):
    """There it would not be compared, so that any field would be explained."""
    study, points, field = yoked
    shown = field.copy()
    shown[:, :2] = np.sign(columns) * field[:, np.abs(columns) - 1]
    data = field_map(points, shown + 7e-5 * generator.standard_normal(shown.shape))
    found = find_gross_errors(study, data)
    assert [name for each in found for name in each.names] == names
    for error in found:
        possible = [one.fields for one in (error.convention, *error.alternatives)]
        assert all(fields[2] == "z" for fields in possible)
        # or positions that are mirrored, of which a quadrupole makes the same readings
        assert tuple(f"{'-' * (column < 0)}{'xyz'[abs(column) - 1]}"
                     for column in (*columns, 3)) in possible


@pytest.mark.parametrize("unit_m", [1.0, 1e-3])
def test_a_stated_unit_that_is_wrong_is_no_gross_error_of_the_map(unit_m):
    """At a thousandth of its lengths a quadrupole has a thousandth of its field, so that readings
    "in mT" agreed with it, beside a "Yes". Control: the right unit.
    """
    ring = hf.halbach_ring(order=2, blocks=8, inner_radius_m=0.05, outer_radius_m=0.09)
    angle, radius = np.meshgrid(2 * np.pi * np.arange(24) / 24, (0.02, 0.033))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], -1)
    points = points.reshape(-1, 3)
    noise = 1e-4 * np.random.default_rng(1).standard_normal(points.shape) * [1, 1, 0]
    data = hf.field_map(points, ring.field_T(points) + noise, sigma_T=1e-4)
    found = answer(hf.diagnose(ring.with_(
        instrument={"length_unit_m": unit_m}, noise__position_sd_m=1e-5), data))
    assert found.sound == (unit_m == 1)
    assert ("a wrong unit has made too small" in found.trust) != found.sound
    assert found.step.startswith("Look at the unit") != found.sound
