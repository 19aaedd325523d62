"""Magnetization curves: tables refused by name, and laws that are what they are made from."""

from __future__ import annotations

import contextlib
import math
import re
import subprocess

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.interpolate import PchipInterpolator

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.observation_operator import observe
from halbach_fe.response.response_matrix import _key
from halbach_fe.solver.magnetostatics import CROSS_SECTION, fill_run_folder
from halbach_fe.solver.mesh import build_mesh, verify_mesh
from halbach_fe.solver.session import Session
from halbach_fe.study import materials
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import curve_of
from tests.conftest import circle


def test_a_curve_that_bends_at_its_first_point_has_a_start():
    """Three points tell PCHIP a slope of zero at the origin, an infinite permeability."""
    H, B = np.array([100.0, 1e3, 5e3, 2e4]), np.array([1.0, 1.2, 1.5, 1.8])
    curve = materials.table_curve(H, B)
    first = B[0] / (MU_0 * H[0])
    assert first <= curve.initial <= first / materials.LEAST_START
    # the control: where PCHIP's slope is sound, it stays
    B = np.linspace(0, 1.5, 7)
    H = 200 * B * np.exp(B)
    slope = float(PchipInterpolator(B, H).derivative()(0.0))
    assert slope > materials.LEAST_START * H[1] / B[1]
    assert materials.table_curve(H, B).initial == pytest.approx(1 / (MU_0 * slope), rel=1e-12)


@pytest.mark.parametrize("law", ["reluctivity", "permeability"])
def test_any_argument_is_answered_without_a_warning(law):
    """From zero to the largest number; warnings are errors here."""
    law = getattr(materials.froehlich_kennelly(5000, 2.1), law)
    squares = np.array([0.0, 5e-324, 1e-250, 1.0, law.squares[-1], 1e100, 1e250,
                        np.finfo(float).max])
    for found in (law.coefficient(squares), law.slope(squares), law.differential(squares)):
        assert np.isfinite(found).all()
    np.testing.assert_allclose(law.coefficient(squares)[[0, -1]], [law.values[0], law.limit])
    np.testing.assert_allclose(law.differential(squares)[[0, -1]], [law.values[0], law.limit])


def test_a_stored_response_is_that_of_the_steels_numbers(dipole, tmp_path, monkeypatch, getdp):
    """Another table under the same name is another material."""
    study = dipole(iron_ring={"inner_radius_m": 0.2, "outer_radius_m": 0.24,
                              "curve": {"kind": "steel", "name": "aisi_1010"}})
    points = circle(0.05, 4)
    session = Session(getdp, tmp_path)

    def key():
        return _key(build_magnet(study), observe(study, points, np.ones_like(points, bool)),
                    session)

    shipped = key()
    assert key() == shipped
    text = materials.steels()["aisi_1010"].read_text()
    other = tmp_path / "aisi_1010.csv"
    monkeypatch.setattr(materials, "steels", lambda: {"aisi_1010": other})
    other.write_text(text)
    assert key() == shipped
    other.write_text(text.replace("238.7,", "238.8,"))
    assert key() != shipped


# A table of a low-carbon steel, thinned: the control of every bad one below.
H = np.array([100.0, 160, 242, 382, 758, 1837, 5259, 14884, 39054, 90000])
B = np.array([0.1, 0.25, 0.55, 1.0, 1.3, 1.5, 1.7, 1.9, 2.1, 2.18])


def replaced(values, index, value):
    return np.array([value if i == index else v for i, v in enumerate(values)])


def test_a_good_table_passes():
    """With its origin or without; the control of all that is refused below."""
    for add in ((), (0.0,)):
        curve = materials.table_curve(np.append(add, H), np.append(add, B))
        np.testing.assert_array_equal(curve.B[::materials.SUBDIVISION], np.append(0, B))


BAD_TABLES = {
    "H falls": (replaced(H, 4, 300.0), B, "H must rise from point to point, but H = 300, point 5"),
    "H repeated": (replaced(H, 4, 382.0), B, "is not clearly above 382 before"),
    "B falls": (H, replaced(B, 4, 0.9), "B must rise from point to point, but B = 0.9, point 5"),
    "remanence": (np.append(0, H), np.append(0.05, B), "H = 0, point 1 after the origin"),
    "two points": (H[:2], B[:2], "needs 4 to 10000 points besides the origin, not 2; give more"),
    "two and the origin": (np.append(0, H[:2]), np.append(0, B[:2]), "not 2; give more"),
    "too many": (np.arange(10_001.0), np.arange(10_001.0) + 1, "not 10001; give fewer"),
    "mT": (H, B * 1e3, "B goes up to 2180, which no iron has in tesla; is it in mT or gauss?"),
    "gauss": (H, B * 1e4, "B goes up to 21800, which no iron has in tesla; is it in mT or gauss?"),
    "kA/m": (H / 1e3, B, "is H in kA/m or Oe? Give A/m"),
    "mA/m": (H * 1e3, B, "the polarization B - mu_0 H falls by 111 T"),
    "uA/m": (H * 1e6, B, "B / (mu_0 H) goes up to 0.00208 only, and in iron far higher"),
    "polarization for B": (H[3:], np.array([1.0, 1.3, 1.5, 1.699, 1.89, 1.9, 1.901]),
                           "the polarization B - mu_0 H falls by 0.0"),
    "too much iron": (H, B * 1.4, "the polarization B - mu_0 H goes up to 2.94 T"),
    "negative H": (replaced(H, 2, -242.0), B, "point 3 (H = -242, B = 0.55) is negative"),
    "negative B": (H, replaced(B, 2, -0.55), "point 3 (H = 242, B = -0.55) is negative"),
    "exchanged": (B, H, "H and B look exchanged: B goes up to 90000 T, and H only to 2.18 A/m"),
    "not a number": (replaced(H, 2, np.nan), B, "point 3 (H = nan, B = 0.55) is not finite"),
    "infinite": (H, replaced(B, 9, np.inf), "point 10 (H = 90000, B = inf) is not finite"),
    "lengths": (H, B[:-1], "H has 10 values and B has 9; give a B for every H"),
    "no numbers": (replaced(H, 0, 1e-320), B, "B / (mu_0 H) is inf at 0.1 T"),
    "one jump": (np.array([100.0, 101, 20000, 20010, 20020]), np.array([0.1, 0.6, 0.7, 1.2, 1.7]),
                 "the curve must rise between the points too, and does not near"),
}


@pytest.mark.parametrize(("field", "flux_density", "said"), BAD_TABLES.values(), ids=BAD_TABLES)
def test_bad_tables_are_refused_by_name(field, flux_density, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        materials.table_curve(field, flux_density)


def test_which_wrong_units_of_h_are_not_noticed():
    """H in Oe is H / 79.58, and 80 times the permeability is good iron; only saturation tells."""
    oersted = 1e3 / (4 * np.pi)
    materials.table_curve(H / oersted, B)  # passes, and is wrong
    far = np.append(H, 1e6), np.append(B, 2.1 + MU_0 * 1e6)
    materials.table_curve(*far)
    with pytest.raises(ValueError, match="is H in kA/m or Oe"):
        materials.table_curve(far[0] / oersted, far[1])
    # kA/m is noticed from 1.5 T on, or in good iron
    materials.table_curve(H[:4] / 1e3, B[:4] / 1.5)  # passes, and is wrong
    with pytest.raises(ValueError, match="is H in kA/m or Oe"):
        materials.table_curve(H[:6] / 1e3, B[:6])


@given(hnp.arrays(float, st.integers(0, 12), elements=st.floats(width=64)), st.data())
def test_any_numbers_are_refused_or_make_a_curve(field, data):
    """Nothing but a ValueError, and no warning (they are errors here)."""
    flux_density = data.draw(hnp.arrays(float, len(field), elements=st.floats(width=64)))
    with contextlib.suppress(ValueError):
        materials.table_curve(field, flux_density)
    with contextlib.suppress(ValueError):  # in order, and not too large, it goes further
        materials.table_curve(np.sort(np.abs(field)), np.sort(np.minimum(np.abs(flux_density), 9)))


@pytest.mark.parametrize(("content", "said"), [
    (b"", "it is empty"), (b"# only a comment\n\n", "it is empty"),
    (b"H,B\n0,0\n", "its header must be H_A_per_m,B_T$"),
    (b"H_A_per_m;B_T\n0;0\n", "its header must be"), (b"100,0.1\n200,0.2\n", "its header must be"),
    (b"H_A_per_m,H_A_per_m\n0,0\n", "its header must be"),
    (b"# c\nH_A_per_m,B_T\n0,0\nhello\n", "line 4 must hold two numbers and a comma between$"),
    (b"H_A_per_m,B_T\n0,0\n1,2,3\n", "line 3 must"), (b"H_A_per_m,B_T\n1,5,0,2\n", "line 2 must"),
    (b'H_A_per_m,B_T\n"1,2\n3,4\n', "line 2 must"), (b"H_A_per_m,B_T\n\x00\x01\n", "line 2 must"),
    (b"H_A_per_m,B_T\n100\xb5,0.1\n", "UTF-8")])
def test_bad_files_are_refused_by_name(tmp_path, content, said):
    path = tmp_path / "x.csv"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=said):
        materials.read_table(path)


@pytest.mark.parametrize("content", [
    b"H_A_per_m,B_T\n0,0\n100,0.5\n", b"\xef\xbb\xbfH_A_per_m,B_T\r\n0,0\r\n100,0.5\r\n",
    b"# where from\n B_T , H_A_per_m\n\n0,0\n # more\n0.5, 100"])
def test_good_files_are_read(tmp_path, content):
    """Also a spreadsheet's, with its mark and line ends, and columns in the other order."""
    path = tmp_path / "x.csv"
    path.write_bytes(content)
    assert materials.read_table(path) == ((0, 100), (0, 0.5))


@st.composite
def tables(draw):
    """H(B) whose differential permeability rises, then falls, by at most 3 from point to point:
    measured, these always pass; from 5 on some are refused.
    """
    count = draw(st.integers(materials.MIN_POINTS, 25))
    rising = draw(st.integers(0, count // 2))
    factors = np.array(draw(st.lists(st.floats(1, 3), min_size=count, max_size=count)))
    widths = np.array(draw(st.lists(st.floats(0.2, 1), min_size=count, max_size=count)))
    factors[rising:] = 1 / factors[rising:]
    relative = np.clip(1000 * np.cumprod(factors), 1.2, 3e4)
    flux_density = np.cumsum(widths) * draw(st.floats(0.5, 2.4)) / widths.sum()
    return np.cumsum(np.diff(flux_density, prepend=0) / (MU_0 * relative)), flux_density


def ends(law):
    return math.sqrt(law.squares[-1])


@given(tables())
@settings(max_examples=40)
def test_laws_of_sensible_tables(table):
    field, flux_density = table
    curve = materials.table_curve(field, flux_density)
    # through the table's points; rounding
    np.testing.assert_allclose(
        curve.reluctivity.coefficient(flux_density**2) * flux_density, field, rtol=1e-12)
    np.testing.assert_allclose(
        curve.permeability.coefficient((MU_0 * field) ** 2) * MU_0 * field, flux_density,
        rtol=1e-12)
    for law, start, vacuum in ((curve.reluctivity, 1 / (MU_0 * curve.initial), 1 / MU_0),
                               (curve.permeability, curve.initial, 1.0)):
        x = np.linspace(0, 1.5 * ends(law), 3001)
        y = law.coefficient(x**2) * x
        assert (np.diff(y) > 0).all()
        # sound at the origin
        assert law.coefficient(np.zeros(1))[0] == law.differential(np.zeros(1))[0]
        assert law.coefficient(np.zeros(1))[0] == pytest.approx(start, rel=1e-12)
        assert np.isfinite(law.slope(np.zeros(1))).all()
        # continuous at the last point (to the step there and back), and vacuum's slope beyond
        last = law.squares[-1]
        around = law.coefficient(np.array([last * (1 - 1e-12), last, last * (1 + 1e-12)]))
        np.testing.assert_allclose(around, law.values[-1], rtol=2e-8)
        beyond = last * np.array([1 + 1e-12, 2.0, 1e3])
        np.testing.assert_allclose(law.differential(beyond), vacuum, rtol=1e-9)


def derivative_error(law, slope):
    """Largest difference of a slope from differences of the coefficient, in the middle of every
    interval and beyond the last, relative to the slopes that the interval's ends allow.
    """
    knots = np.append(law.squares, law.squares[-1] * 2)
    middle, step = (knots[1:] + knots[:-1]) / 2, np.diff(knots) / 8
    # of fourth order, exact for cubics; beyond the last, 1/16 of the radius leaves 1e-5
    difference = (8 * (law.coefficient(middle + step) - law.coefficient(middle - step))
                  - law.coefficient(middle + 2 * step) + law.coefficient(middle - 2 * step)
                  ) / (12 * step)
    ends = np.abs(law.slope(knots))
    scale = np.maximum(ends[1:], ends[:-1]) + np.abs(difference) + law.values.max() * 1e-9 / step
    return (np.abs(slope(middle) - difference) / scale).max()


@given(tables())
@settings(max_examples=40)
def test_the_slope_is_the_coefficients_derivative(table):
    """To 1e-4 (see there); a slope that is 1 % off is noticed."""
    curve = materials.table_curve(*table)
    for law in (curve.reluctivity, curve.permeability):
        assert derivative_error(law, law.slope) < 1e-4
        assert derivative_error(law, lambda square, law=law: 1.01 * law.slope(square)) > 1e-3


@pytest.mark.parametrize(("steel", "tolerance"), [
    ("aisi_1008", 1e-4), ("aisi_1010", 4e-3), ("pure_iron_rfe80", 5e-4), ("vacoflux_50", 1e-5)])
def test_both_laws_are_one_curve(monkeypatch, steel, tolerance):
    """B(H(B)) = B; measured 4.4e-5, 2.5e-3, 2.9e-4, 2.9e-6. It is Akima's error: four times the
    points leave at most a tenth of it, which a law of another material would not (next line).
    """
    table = map(np.array, materials.read_table(materials.steels()[steel]))
    field, flux_density = table

    def error(H, of=1.0):
        curve, B = materials.table_curve(H, flux_density), np.linspace(0.001, 3.0, 20001)
        g = MU_0 * curve.reluctivity.coefficient(B**2) * B
        other = materials.table_curve(H * of, flux_density).permeability
        return np.abs(other.coefficient(g**2) * g / B - 1).max()

    coarse = error(field)
    assert coarse < tolerance
    monkeypatch.setattr(materials, "SUBDIVISION", 4 * materials.SUBDIVISION)
    assert error(field) < coarse / 8
    assert error(field, of=1.01) > coarse / 8


def froehlich_kennelly_inverse(flux_density, initial, saturation):
    """H of B = mu_0 H + J_s H / (h + H): the positive root of a quadratic equation, in the form
    that does not cancel.
    """
    half = saturation / (MU_0 * (initial - 1))
    linear = MU_0 * half + saturation - flux_density
    root = np.sqrt(linear**2 + 4 * MU_0 * flux_density * half)
    return np.where(linear > 0, 2 * flux_density * half / (linear + root),
                    (root - linear) / (2 * MU_0))


@pytest.mark.parametrize("initial", [2.0, 100.0, 5000.0, 1e5])
@pytest.mark.parametrize("saturation", [0.5, 2.1])
def test_froehlich_kennelly_is_its_closed_form(initial, saturation):
    """Between its points it is that to 2e-5 (measured, in the first interval, where a function of
    B^2 starts like |B|), from a hundredth of half saturation on to 5e-6 (nu), 1e-5 (mu_r).
    """
    curve = materials.froehlich_kennelly(initial, saturation)
    assert curve.initial == initial

    def errors(least, saturation=saturation):
        B = np.geomspace(least, 0.999 * curve.B[-1], 20001)
        H = froehlich_kennelly_inverse(B, initial, saturation)
        g = MU_0 * H
        return (np.abs(curve.reluctivity.coefficient(B**2) * B / H - 1).max(),
                np.abs(curve.permeability.coefficient(g**2) * g / B - 1).max())

    assert max(errors(1e-6 * saturation)) < 3e-5
    upper = errors(saturation / 100)
    assert upper[0] < 5e-6
    assert upper[1] < 1e-5
    assert min(errors(saturation / 100, 1.001 * saturation)) > 1e-4  # the control: 0.1 % more iron
    for law, start in ((curve.reluctivity, 1 / (MU_0 * initial)), (curve.permeability, initial)):
        assert law.coefficient(np.zeros(1))[0] == pytest.approx(start, rel=1e-12)


@pytest.mark.parametrize("constants", [(3.8, 2.17, 396.2), (49.4, 1.46, 520.6), (0.1, 3.0, 100.0)])
def test_brauer_is_its_closed_form(constants):
    """nu to 2e-6, mu_r to 2e-5 (measured 1.4e-6 and 1.5e-5), up to where dH/dB is vacuum's."""
    k1, k2, k3 = constants
    curve = materials.brauer(k1, k2, k3)
    end = curve.B[-1]
    assert k1 * math.exp(k2 * end**2) * (1 + 2 * k2 * end**2) + k3 == pytest.approx(1 / MU_0)

    def errors(k1):
        B = np.linspace(1e-3, end, 20001)
        H = (k1 * np.exp(k2 * B**2) + k3) * B
        g = MU_0 * H
        return (np.abs(curve.reluctivity.coefficient(B**2) * B / H - 1).max(),
                np.abs(curve.permeability.coefficient(g**2) * g / B - 1).max())

    assert errors(k1)[0] < 2e-6
    assert errors(k1)[1] < 2e-5
    assert min(errors(1.001 * k1)) > 3e-5  # the control: 0.1 % of one constant
    assert curve.initial == pytest.approx(1 / (MU_0 * (k1 + k3)), rel=1e-12)
    # no kink at the end: the slope of vacuum on either side, to the rounding of bisection
    around = curve.reluctivity.differential(end**2 * np.array([1 - 1e-9, 1 + 1e-9]))
    np.testing.assert_allclose(around, 1 / MU_0, rtol=1e-3)


@pytest.mark.parametrize(("constants", "said"), [
    ((1e6, 1.0, 0.0), "reluctivity of 0.398 to 5.31e+05 m/H"), ((0.1, 1.0, 0.0), "instead it is 0"),
    ((100.0, 1e-9, 0.0), "goes up to 10 T, which no iron has; give a larger k2")])
def test_brauer_of_no_iron_is_refused(constants, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        materials.brauer(*constants)
    materials.brauer(100.0, 100.0, 0.0)  # exp(k2 B^2) overflows beyond its end


def test_there_are_steels():
    assert set(materials.steels()) == {"aisi_1008", "aisi_1010", "pure_iron_rfe80", "vacoflux_50"}


@pytest.mark.parametrize(("steel", "saturation", "permeability"), [
    ("aisi_1008", (2.0, 2.2), (1000, 4000)), ("aisi_1010", (1.95, 2.2), (700, 4000)),
    ("pure_iron_rfe80", (2.1, 2.2), (4000, 20_000)), ("vacoflux_50", (2.25, 2.45), (3000, 20_000))])
def test_shipped_steels_are_plausible(steel, saturation, permeability):
    """Saturation and largest permeability as in handbooks; where the numbers come from is said."""
    path = materials.steels()[steel]
    curve = materials.table_curve(*map(np.array, materials.read_table(path)))
    assert saturation[0] < (curve.B - MU_0 * curve.H).max() < saturation[1]
    assert permeability[0] < (curve.B[1:] / (MU_0 * curve.H[1:])).max() < permeability[1]
    comment = "".join(re.findall(r"^# .*\n", path.read_text(encoding="utf-8"), re.MULTILINE))
    assert "Roschke" in comment or "as quoted by" in comment


def roschke(flux_density, initial, scale, a, b, exponent):
    """H of the fit mu_r(B) in the steels' comments."""
    x = flux_density / scale
    return flux_density / MU_0 / (1 + (initial - 1 + a * x) / (1 + b * x + x**exponent))


@pytest.mark.parametrize("steel", ["aisi_1008", "pure_iron_rfe80", "vacoflux_50"])
def test_shipped_fits_are_those_of_their_comments(steel):
    """To the six digits written."""
    path = materials.steels()[steel]
    field, flux_density = map(np.array, materials.read_table(path))
    found = re.search(r"mu_i = (.*?), B_m = (.*?) T, c_a = (.*?), c_b = (.*?), n = (.*?):",
                      path.read_text(encoding="utf-8"))
    constants = [float(text) for text in found.groups()]
    np.testing.assert_allclose(field, roschke(flux_density, *constants), rtol=1e-5)
    for which in range(5):  # the control: every constant matters, by 0.1 %
        other = [c * (1.001 if n == which else 1) for n, c in enumerate(constants)]
        assert np.abs(field[1:] / roschke(flux_density[1:], *other) - 1).max() > 1e-4


LAW = """
Include "magnetostatics_2d.pro";
b() = {%s};
g() = {%s};
PostProcessing {
  { Name Law; NameOfFormulation Magnetostatics; NameOfSystem A;
    Quantity {
      { Name nu; Value { Local { [ Vector[ nu[Vector[$x, 0, 0]],
        CompXX[ dnu[Vector[$x, 0, 0]] ], 0 ] ]; In Vol_Curve; Jacobian Volume; } } }
      { Name mur; Value { Local { [ Vector[ mur[Vector[$x, 0, 0]],
        CompXX[ dmur[Vector[$x, 0, 0]] ], 0 ] ]; In Vol_Curve; Jacobian Volume; } } }
    }
  }
}
PostOperation {
  For n In {0:1}
  { Name Law~{n}; NameOfPostProcessing Law; LastTimeStepOnly;
    Operation {
      If(n) Print[ mur, OnPoint {0.22, 0.001, 0}, Format SimpleTable, File >> "mur.txt" ];
      Else Print[ nu, OnPoint {0.22, 0.001, 0}, Format SimpleTable, File >> "nu.txt" ]; EndIf
    }
  }
  EndFor
}
Resolution {
  { Name Law; System { { Name A; NameOfFormulation Magnetostatics; } }
    Operation {
      InitSolution[A]; SaveSolution[A];
      Evaluate[ $source = 0, $sample = 0 ];
      For i In {0:#b()-1}
        Evaluate[ $x = b(i) ]; PostOperation[Law~{0}];
        Evaluate[ $x = g(i) ]; PostOperation[Law~{1}];
      EndFor
    }
  }
}
"""


def test_getdp_has_the_same_law(dipole, getdp, tmp_path):
    """The generated problem's nu, dnu, mur, dmur, printed by GetDP with 17 digits: to rounding,
    inside the points, at them, and beyond.
    """
    study = dipole(mesh__block_size_m=0.06, mesh__growth=3.0, iron_ring={
        "inner_radius_m": 0.2, "outer_radius_m": 0.24,
        "curve": {"kind": "steel", "name": "aisi_1010"}})
    folder = tmp_path / "run"
    folder.mkdir()
    mesh = verify_mesh(build_mesh(build_magnet(study), tmp_path / "mesh"))
    fill_run_folder(build_magnet(study), mesh, circle(0.07, 2), folder, CROSS_SECTION)
    curve = curve_of(study)
    laws = {"nu": curve.reluctivity, "mur": curve.permeability}
    arguments = {name: np.sqrt(np.concatenate([
        law.squares[:80:4], law.squares[-2:], np.linspace(0, 1.3 * law.squares[-1], 40),
        np.geomspace(1e-9, 1.0, 60) * law.squares[-1]])) for name, law in laws.items()}
    (folder / "law.pro").write_text(LAW % tuple(
        ", ".join(f"{value:.17g}" for value in x) for x in arguments.values()))
    done = subprocess.run([getdp.executable, "law.pro", "-msh", "mesh.msh", "-solve", "Law"],
                          cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for name, law in laws.items():
        x = arguments[name]
        printed, differential = np.loadtxt(folder / f"{name}.txt")[:, 3:5].T
        np.testing.assert_allclose(printed, law.coefficient(x**2), rtol=1e-12)
        # 1e-9 elsewhere: a slope is a difference of close numbers
        np.testing.assert_allclose(differential, 2 * x**2 * law.slope(x**2),
                                   atol=1e-12 * np.abs(differential).max(), rtol=1e-9)
        # the control: another interpolation through the same points
        inside = x**2 < law.squares[-1]
        other = PchipInterpolator(law.squares, law.values)(x[inside] ** 2)
        assert np.abs(other / printed[inside] - 1).max() > 1e-4
