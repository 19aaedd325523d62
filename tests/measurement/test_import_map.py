"""Maps of other makes are read as they come, or refused with what is missing."""

from __future__ import annotations

import re
import shlex

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from halbach_fe.cli import main
from halbach_fe.core.errors import MeasurementError
from halbach_fe.measurement.field_map import (
    check_magnitudes,
    field_map,
    points_of,
    read_map,
    write_map,
)
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.import_export import export_map, format_of, import_map
from halbach_fe.measurement.formats.units import in_si, unit_symbol
from tests.conftest import ROOT

AXES = [-0.01, 0.01], [0.0, 0.005, 0.01], [0.1, 0.2, 0.3, 0.4]
POINTS = np.stack(np.meshgrid(*AXES, indexing="ij"), axis=-1).reshape(-1, 3)
FIELD = np.round(np.column_stack([
    0.5 + POINTS @ [1, 10, 0.1], POINTS @ [3, -2, 0.25], -0.2 + POINTS @ [0.5, 7, -0.3]]), 9)
"""Another along every axis and in every component, so that no exchange goes unnoticed."""

MM_MT = "X [mm]", "Y [mm]", "Z [mm]", "Bx [mT]", "By [mT]", "Bz [mT]"
DEFAULTS = DeclaredFormat()


def rows(separator="  ", points=POINTS * 1000, field=FIELD * 1000, order=range(6)):
    table = np.hstack([points, field])[:, list(order)]
    return "".join(separator.join(f"{value:.9g}" for value in row) + "\n" for row in table)


def imported(tmp_path, text, name="", **declared):
    path = tmp_path / "hall.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return import_map(path, DeclaredFormat(**declared), name)


def same(found, points=POINTS, field=FIELD):
    """Nine digits were written."""
    return (np.allclose(points_of(found.data), points, rtol=1e-8, atol=1e-12)
            and np.allclose(found.data["B_T"], field, rtol=1e-8, atol=1e-12, equal_nan=True))


def said(tmp_path, text, **declared):
    with pytest.raises(MeasurementError) as caught:
        imported(tmp_path, text, **declared)
    assert "hall.txt" in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(("separator", "header"), [
    ("  ", "  ".join(MM_MT)), (",", ",".join(MM_MT)), (";", ";".join(MM_MT)),
    ("\t", "\t".join(MM_MT)), (",", "# " + "  ".join(MM_MT)), ("  ", "% " + "  ".join(MM_MT)),
    (" ", "x(mm) y(mm) z(mm) Bx(mT) By(mT) Bz(mT)"), (" ", "! x/mm y/mm z/mm Bx/mT By/mT Bz/mT"),
    (",", "x_mm,y_mm,z_mm,Bx_mT,By_mT,Bz_mT"),
    (" ", "POS_X [ MM ] POS_Y [ MM ] POS_Z [ MM ] B_x [millitesla] B_y (mT) B_z (mT)"),
    (";", "X;Y;Z;Bx;By;Bz\nmm;mm;mm;mT;mT;mT"),
    (" ", "Hall map of magnet 3\n# probe: 7 cm, of x, y\nX Y Z Bx By Bz\n# mm mm mm mT mT mT")])
def test_headers_say_columns_and_units(tmp_path, separator, header):
    found = imported(tmp_path, f"{header}\n{rows(separator)}")
    assert (found.format, found.ignored) == ("columns", ())
    assert found.length_units == ("mm",)
    assert same(found)
    assert not same(found, POINTS[:, [1, 0, 2]])
    assert not same(found, field=FIELD[:, [1, 0, 2]])
    assert not same(found, field=np.roll(FIELD, 1, axis=0))


def test_columns_in_another_order_and_others_beside_them(tmp_path):
    header = "n,Bz[T],z[m],time,By[T],y[m],|B|,x[m],Bx[T]\n"
    body = "".join(f"{n},{b[2]},{p[2]},12:30,{b[1]},{p[1]},9,{p[0]},{b[0]}\n".replace(":", ".")
                   for n, (p, b) in enumerate(zip(POINTS, FIELD, strict=True)))
    found = imported(tmp_path, header + body)
    assert same(found)
    assert found.ignored == ("n", "time", "|B|")


def test_columns_of_text(tmp_path):
    """Times and names of scans beside the numbers do no harm, unless they are what is needed."""
    header = "Map of 2024 05 01 12 30 h\nscan;time;" + ";".join(MM_MT) + "\n"
    body = [f"s{n};12:30:{n:02d};{line}" for n, line in enumerate(rows(";").splitlines())]
    found = imported(tmp_path, header + "\n".join(body))
    assert same(found)
    assert found.ignored == ()
    assert found.data["scan"].values.tolist() == [f"s{n}" for n in range(24)]
    assert found.data["time_s"].values.tolist() == list(range(24))
    spoilt = [*body[:7], body[7].rpartition(";")[0] + ";OVERLOAD", *body[8:]]
    assert "Bz in line 10 of map" in said(tmp_path, header + "\n".join(spoilt))
    lost = ["s;12:30;" + ";".join(["OVERLOAD"] * 5 + ["7"]), *body]
    assert "'s;12:30;OVERLOAD;" in said(tmp_path, header + "\n".join(lost))
    without = imported(tmp_path, "\n".join(body), columns=(
        "-", "-", "x", "y", "z", "Bx", "By", "Bz"), length_unit="mm", field_unit="mT")
    assert same(without)  # no row is lost for a header


def test_declared_columns_and_units(tmp_path):
    text = rows(order=[2, 1, 0, 5, 4, 3])
    declared = {"length_unit": "mm", "field_unit": "mT"}
    columns = ("z", "y", "x", "Bz", "By", "Bx")
    assert same(imported(tmp_path, text, columns=columns, **declared))
    swapped = imported(tmp_path, text, columns=("x", "y", "z", "Bz", "By", "Bx"), **declared)
    assert not same(swapped)
    assert same(imported(tmp_path, text, columns=(
        "z[mm]", "y[mm]", "x[mm]", "Bz[mT]", "By[mT]", "Bx[mT]")))
    left = imported(tmp_path, text, columns=("z", "y", "x", "-", "-", "Bx"), **declared)
    assert same(left, field=np.where([True, False, False], FIELD, np.nan))
    ended = text.replace("\n", ",\n").replace("  ", ",")  # a comma at the end of every line
    assert same(imported(tmp_path, ended, columns=(*columns, "-"), **declared))
    assert "of 6 columns" in said(tmp_path, ended, columns=(*columns, "t"), **declared)


STAGE = ["dx[mm]", "dy[mm]", "dz[mm]", "Bx[T]", "By[T]", "Bz[T]", "t[min]"]


def test_moves_and_times_of_a_stage(tmp_path):
    """Moves from reading to reading, times with separated thousands, remarks in brackets."""
    moves = np.diff(POINTS, axis=0, prepend=0) * 1e3
    body = "".join(f'{",".join(map(str, (*move, *b)))},"{1000 + n:,}.5"\n'
                   for n, (move, b) in enumerate(zip(moves, FIELD, strict=True)))
    header = "dx,dy,dz (stage),Hall 1,Hall 2,Hall 3,clock\n"
    found = imported(tmp_path, header + body, columns=tuple(STAGE))
    assert same(found)
    assert found.data["time_s"].values == pytest.approx(60 * (1000.5 + np.arange(len(POINTS))))
    assert not same(found, np.cumsum(POINTS, axis=0))  # positions that were taken for moves
    # nothing is guessed: dx of a header may be anything
    assert "(--columns" in said(tmp_path, header + body, length_unit="mm", field_unit="T")
    assert "t[s]" in said(tmp_path, header + body, columns=(*STAGE[:-1], "t"))


@pytest.mark.parametrize(("length", "field", "metre", "tesla"), [
    ("m", "T", 1, 1), ("mm", "mT", 1000, 1000), ("cm", "G", 100, 1e4), ("um", "uT", 1e6, 1e6),
    ("inch", "kG", 1 / 0.0254, 10)])
def test_units(tmp_path, length, field, metre, tesla):
    text = "x y z Bx By Bz\n" + rows(points=POINTS * metre, field=FIELD * tesla)
    found = imported(tmp_path, text, length_unit=length, field_unit=field)
    assert same(found)
    wrong = DeclaredFormat(length_unit="cm" if length != "cm" else "mm", field_unit=field)
    try:
        assert not same(import_map(tmp_path / "hall.txt", wrong))
    except MeasurementError as error:  # or so wrong that it is refused
        assert "Is the unit right?" in str(error)


def test_a_power_of_ten_is_exact():
    values = np.array([0.1, 123.456, 7.0])
    assert in_si(values * 1000, "mm").tolist() == [0.1, 0.123456 * 1000, 7.0]
    assert [unit_symbol(text) for text in ("MT", "t", "M", "METRE", "Tesla", "kg", "")] == [
        "", "", "m", "m", "T", "", ""]


def test_everything_missing_is_asked_for_at_once(tmp_path):
    sentence = said(tmp_path, rows())
    assert sentence.startswith("Input content of map ")
    for asked in ("its 6 columns are (--columns x,y,z,Bx,By,Bz", "positions (--length-unit m, cm",
                  "of B (--field-unit T, mT", "nothing is guessed"):
        assert asked in sentence
    sentence = said(tmp_path, "z [mm]  B\n0 1\n1 2\n")
    for asked in ("x, y (--at x=0,y=0 in m", "which component B is (--component x, y or z)",
                  "the unit of B (--field-unit"):
        assert asked in sentence
    assert "--length-unit" not in sentence
    assert "Br, Bphi" not in sentence


@pytest.mark.parametrize("header", [
    "x,y,z [mm],Bx,By,Bz [G]", "x [mm],y,z,Bx [G],By,Bz", "x,y,z,Bx,By,Bz\nmm,,,G,,",
    "x (mm),y (mm),z (mm),Bx,By,Bz (G)"])
def test_one_unit_for_the_columns_beside_it(tmp_path, header):
    """It had been refused. A sentence says which columns do not state their own."""
    found = imported(tmp_path, f"{header}\n1,2,3,4000,5000,6000\n")
    assert re.search("'By'.* were read in the unit of the column beside", " ".join(found.remarks))
    data = found.data
    np.testing.assert_allclose(data["B_T"], [[0.4, 0.5, 0.6]])
    np.testing.assert_allclose(data["z_m"], 0.003)


@pytest.mark.parametrize(("header", "asked"), [
    ("x [mm],y [cm],z,Bx,By,Bz [G]", "unit of z "),  # two units
    ("x,y [mm],z,Bx,By,Bz [G]", "unit of x, z "),  # in the middle
    ("x,Bx,y,By,z [mm],Bz [G]", "unit of x, y .*; the unit of Bx, By ")])  # not side by side
def test_a_unit_that_may_be_that_of_its_column_alone(tmp_path, header, asked):
    with pytest.raises(MeasurementError, match=asked):
        imported(tmp_path, f"{header}\n1,2,3,4,5,6\n")


def test_one_component_along_a_line(tmp_path):
    found = imported(tmp_path, "z [mm]  B [G]\n0 100\n10 200\n", component="y",
                     at={"x": 0.01, "y": 0.0}, origin_m=(0.0, 0.0, -0.5))
    np.testing.assert_allclose(points_of(found.data), [[0.01, 0, -0.5], [0.01, 0, -0.49]])
    np.testing.assert_allclose(found.data["B_T"], [[np.nan, 0.01, np.nan], [np.nan, 0.02, np.nan]])


@pytest.mark.parametrize(("header", "declared", "asked"), [
    (MM_MT, {"length_unit": "cm"}, "unit of x of map"),
    (MM_MT, {"field_unit": "T"}, "mT in the file and --field-unit T"),
    (MM_MT, {"columns": ("x", "y", "z")}, "of 6 columns"),
    (MM_MT, {"columns": ("x", "y", "z", "Bx", "By", "Hz")}, "'Hz'"),
    (MM_MT, {"component": "z"}, "Bx, By, Bz in the file and --component z"),
    (MM_MT, {"at": {"x": 0.0}}, "a column x in the file and --at x="),
    ((*MM_MT[:5], "By [mT]"), {}, "one column By"),
    (("x[A]", *MM_MT[1:]), {}, "unit of x"),
    ((*MM_MT[:3], "Bx [A/m]", *MM_MT[4:]), {"field_unit": "T"}, "A/m in the file"),
    ((*MM_MT[:3], "Bx [mm]", *MM_MT[4:]), {}, "unit of Bx"),
    ((*MM_MT, "more"), {}, "of 6 names"),
])
def test_contradictions_are_refused(tmp_path, header, declared, asked):
    assert asked in said(tmp_path, ",".join(header) + "\n" + rows(","), **declared)


@pytest.mark.parametrize(("text", "asked"), [
    ("", "an empty file"), ("# only\n% comments\n", "lines of numbers"),
    ("x,y,z,Bx\nnone,of,it,number\n", "lines of numbers"),
    ("0,1;0,2;0,3\n", "--decimal-comma"), ("0,1 0,2 0,3\n", "--decimal-comma"),
    ("x[m];y[m];z[m];Bx[T]\n0;0;0;1\n0;0;1,5;1\n", "--decimal-comma"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0,1\n0,0,1\n", "line 3"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0,1\n0,0,1_0,1\n", "'1_0'"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0,1\n0,0,inf,1\n", "'inf'"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0,1\n0,0,1e999,1\n", "'1e999'"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0,1\n0,0,1e300,1\n", "below 1e+30"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0,1\n0,0,,1\n", "reading 2"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0,1\n0,0,0,1\n", "no copy of another row"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0,\n", "lines of numbers"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0,520\n", "below 10 T"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,400,0.5\n", "within 100 m"),
    ("x[m],y[m],z[m],Bx[T]\n0,0,0," + "1" * 200_000 + "\n", "lines of numbers"),
    (b"x[mm] \xb5\n1\n", "--encoding latin-1"),
])
def test_bad_tables_are_refused_by_name(tmp_path, text, asked):
    if asked == "lines of numbers" and text.endswith(",\n"):
        asked = "at least one reading; instead received 1 rows without a number in 'Bx[T]'"
    assert asked in said(tmp_path, text)


def test_an_unknown_encoding(tmp_path):
    assert "'klingon'" in said(tmp_path, rows(), encoding="klingon")
    assert "'rot13'" in said(tmp_path, rows(), encoding="rot13")
    text = "x[µm];y[µm];z[µm];Bx[T]\n0;0;5000;0,25\n".encode("latin-1")
    found = imported(tmp_path, text, encoding="latin-1", decimal_comma=True)
    np.testing.assert_allclose(found.data["z_m"], [0.005])
    np.testing.assert_allclose(found.data["B_T"][0, 0], 0.25)


def test_points_without_a_reading_are_left_out(tmp_path):
    found = imported(tmp_path, "x[m],y[m],z[m],Bx[T],Bz[T]\n0,0,0,,\n0,0,1,1,\n0,0,2,nan,NaN\n")
    assert (found.data.sizes["point"], found.dropped) == (1, 2)
    assert found.remarks[-1].startswith("Left out: 2 of 3 rows of map ")
    assert found.remarks[-1].endswith("; the first is row 1. Rows are counted without them.")


def test_cylindrical_columns(tmp_path):
    radius, angle, z = 0.05, np.deg2rad([0.0, 30, 100, 250]), 0.1
    field = np.array([[0.3, -0.1, 0.02]] * 4) * [[1], [2], [3], [-1]]
    cos, sin = np.cos(angle), np.sin(angle)
    radial = np.column_stack([field[:, 0] * cos + field[:, 1] * sin,
                              field[:, 1] * cos - field[:, 0] * sin, field[:, 2]])
    header = "r[mm],phi[deg],z[mm],Br[T],Bphi[T],Bz[T]\n"
    text = "".join(f"{radius * 1e3},{np.rad2deg(a)},{z * 1e3},{b[0]:.12g},{b[1]:.12g},{b[2]:.12g}\n"
                   for a, b in zip(angle, radial, strict=True))
    points = np.column_stack([radius * cos, radius * sin, [z] * 4])
    assert same(imported(tmp_path, header + text), points, field)
    assert "Are they in degrees?" in said(tmp_path, header.replace("deg", "rad") + text)
    assert "the unit of phi (--angle-unit" in said(tmp_path, header.replace("[deg]", "") + text)
    other = header.replace("r[mm]", "x[mm]").replace("phi[deg]", "y[mm]")
    assert not same(imported(tmp_path, other + text), points, field)
    assert "on it, where they have no" in said(tmp_path, other + "0,0,0,1,1,1\n")
    assert "Bphi, without which" in said(tmp_path, header.replace("Bphi", "Bother") + text)
    assert "phi (--columns)" in said(tmp_path, header.replace("phi[deg]", "w") + text)
    assert "either Bx, By or" in said(tmp_path, header.replace("Bz", "Bx") + text)


OPERA = """
 2 3 4 2
 1 X [MM]
 2 Y [MM]
 3 Z [MM]
 4 BX [TESLA]
 5 BY [TESLA]
 6 BZ [TESLA]
 0
"""


def test_opera_tables(tmp_path):
    text = OPERA + rows(field=FIELD)
    found = imported(tmp_path, text)
    assert found.format == "opera"
    assert same(found)
    assert not same(imported(tmp_path, text.replace("4 BX", "4 BY", 1).replace("5 BY", "5 BX")))
    listed = text.replace(" 2 3 4 2", " 24 24 24")
    assert same(imported(tmp_path, listed))
    assert "2 x 3 x 4 points" in said(tmp_path, text[:text.rindex("10")].rpartition("\n")[0])
    assert "2 x 3 x 5 points" in said(tmp_path, text.replace(" 2 3 4 2", " 2 3 5 2"))


def test_opera_units_are_in_the_header_or_asked_for(tmp_path):
    silent = OPERA.replace("[MM]", "[LENGU]").replace("[TESLA]", "[FLUXU]") + rows()
    sentence = said(tmp_path, silent)
    assert "x, y, z (--length-unit" in sentence
    assert "Bx, By, Bz (--field-unit" in sentence
    assert same(imported(tmp_path, silent, length_unit="mm", field_unit="mT"))
    bare = OPERA.replace(" [MM]", "").replace("TESLA", "1").replace(" 0\n", " 0 [MM]\n")
    assert same(imported(tmp_path, bare + rows(), field_unit="mT"))
    assert "--length-unit m" in said(tmp_path, bare + rows(), field_unit="mT", length_unit="m")
    assert "'WEBER'" in said(tmp_path, OPERA.replace("TESLA", "WEBER") + rows())


@pytest.mark.parametrize(("old", "new", "asked"), [
    (" 0\n", "", "column 7 of the header"), (" 3 Z [MM]\n", "", "column 3 of the header"),
    (" 0\n", " fieldNormalisation 2\n 0\n", "column 7"), (" 6 BZ [TESLA]\n", "", "line 9")])
def test_damaged_opera_tables(tmp_path, old, new, asked):
    assert asked in said(tmp_path, OPERA.replace(old, new, 1) + rows())


COMSOL = """% Model:              magnet.mph
% Version:            COMSOL 6.1.0.252
% Date:               Mar 13 2023, 16:27
% Dimension:          3
% Nodes:              24
% Expressions:        3
% Description:        Magnetic flux density, x-component, Magnetic flux density, y-component
% Length unit:        mm
"""
SPREADSHEET = "% X                Y          Z   mf.Bx (T)    mf.By (T)    mf.Bz (mT)\n"


def comsol_grid(points=POINTS, brackets=False):
    text = COMSOL + "% Grid\n" + "".join(
        " ".join(f"{1000 * value:.9g}" for value in axis) + "\n" for axis in AXES)
    for name, values in zip(("mf.Bx (T)", "mf.By (T)", "mf.Bz (T)"), FIELD.T, strict=True):
        text += f"% Data ({name})\n" if brackets else f"% Data\n% {name}\n"
        by_row = values.reshape(2, 3, 4).transpose(2, 1, 0).reshape(12, 2)  # x along a row
        text += "".join(" ".join(f"{value:.12g}" for value in row) + "\n" for row in by_row)
    return text


def comsol_sections():
    text = COMSOL + "% Coordinates\n" + "".join(
        " ".join(f"{1000 * value:.9g}" for value in point) + "\n" for point in POINTS)
    text += "% Elements (tetrahedra)\n1 2 3 4\n2 3 4 5\n"
    for name, values in zip(("mf.Bx (T)", "mf.By (T)", "mf.Bz (T)"), FIELD.T, strict=True):
        text += f"% Data ({name})\n" + "".join(f"{value:.12g}\n" for value in values)
    return text


def test_comsol_spreadsheets(tmp_path):
    text = COMSOL + SPREADSHEET + rows(field=FIELD * [1, 1, 1000])
    found = imported(tmp_path, text)
    assert found.format == "comsol"
    assert same(found)
    assert not same(imported(tmp_path, text.replace("unit:        mm", "unit:        cm")))
    assert "--length-unit" in said(tmp_path, text.replace("% Length unit:        mm\n", ""))
    for one, remark in (("% X (cm) Y Z mf.Bx (T) mf.By (T) mf.Bz (T)\n", ""), (
            "% X Y Z mf.Bx (T) mf.By mf.Bz\n", "'mf.By' and 'mf.Bz' were read in the unit of")):
        found = imported(tmp_path, COMSOL + one + rows(field=FIELD))
        assert remark in " ".join(found.remarks)
        np.testing.assert_allclose(found.data["z_m"], POINTS[:, 2])  # in the unit of the file
        np.testing.assert_allclose(found.data["B_T"], FIELD, rtol=1e-8)
    commas = (COMSOL.replace(":  ", ",") + SPREADSHEET.replace("% X", "% X,").replace(
        "    m", ",m").replace("   mf.Bx", ",mf.Bx").replace("Y    ", "Y,")
        + rows(",", field=FIELD * [1, 1, 1000]))
    assert same(imported(tmp_path, commas))
    assert "24 points" in said(tmp_path, "".join(text.splitlines(keepends=True)[:-1]))
    turned = text.replace("mf.Bx (T)", "-mf.Bx (T)")
    assert "'-mf.Bx(T)', with a minus before it" in said(tmp_path, turned)
    assert same(imported(tmp_path, turned, columns=("x", "y", "z", "-", "By", "Bz")),
                field=np.where([False, True, True], FIELD, np.nan))


@pytest.mark.parametrize("text", [comsol_grid(), comsol_grid(brackets=True), comsol_sections()])
def test_comsol_grids_and_sections(tmp_path, text):
    found = imported(tmp_path, text)
    order = np.lexsort(points_of(found.data).T[::-1])
    ordered = found.data.isel(point=order)
    np.testing.assert_allclose(points_of(ordered), POINTS, atol=1e-12)
    np.testing.assert_allclose(ordered["B_T"], FIELD, atol=1e-12)
    assert "Is the file cut short?" in said(tmp_path, "\n".join(text.splitlines()[:-1]))
    assert "x, y and z" in said(tmp_path, "\n".join(
        line for n, line in enumerate(text.splitlines()) if n != 10).replace("100\n", "\n", 1)
        if "Grid" in text else text.replace("Coordinates\n-10 ", "Coordinates\n"))


def test_comsol_grid_with_y_fastest_would_be_seen(tmp_path):
    """The control of the order: the same numbers along y in a row are another field."""
    text = comsol_grid()
    head, *blocks = text.split("% Data\n")
    turned = []
    for block in blocks:
        name, *numbers = block.splitlines()
        values = np.array(" ".join(numbers).split(), float).reshape(4, 3, 2).transpose(0, 2, 1)
        turned.append("\n".join([name, *(f"{value:.12g}" for value in values.ravel()), ""]))
    found = imported(tmp_path, "% Data\n".join([head, *turned]))
    order = np.lexsort(points_of(found.data).T[::-1])
    assert not np.allclose(found.data["B_T"].values[order], FIELD, atol=1e-3)


@pytest.mark.parametrize(("old", "new", "asked"), [
    ("mf.Bx (T)", "mf.Bx (T) @ t=0.1", "one static solution"),
    ("mf.Bx (T)", "mf.Bx (T) @ freq=50", "@ freq=50"),
    ("% Grid", "% Elements", "beginning with Grid"),
    ("mf.Bz (T)", "mf.Bx (T)", "one column Bx"), ("0.5", "0.5+0.1i", "real numbers")])
def test_other_comsol_files_are_refused(tmp_path, old, new, asked):
    assert asked in said(tmp_path, comsol_grid().replace(old, new, 1))


def test_what_was_read_can_be_read_again(tmp_path):
    found = imported(tmp_path, "# Süd: probe é\n" + " ".join(MM_MT) + "\n" + rows())
    for suffix in (".csv", ".h5", ".vtu"):
        write_map(found.data, tmp_path / f"map{suffix}")
        again = read_map(tmp_path / f"map{suffix}")
        np.testing.assert_array_equal(again["B_T"], found.data["B_T"])
        np.testing.assert_array_equal(points_of(again), points_of(found.data))
    again = read_map(tmp_path / "map.csv")
    assert again.attrs["imported_as"] == "columns"
    assert "Süd: probe é" in again.attrs["comments"]
    own = import_map(tmp_path / "map.csv", DEFAULTS)  # units are in the names
    np.testing.assert_array_equal(own.data["B_T"], found.data["B_T"])


SEEDS = [OPERA + rows(field=FIELD), COMSOL + SPREADSHEET + rows(), comsol_grid(),
         comsol_sections(), " ".join(MM_MT) + "\n" + rows(), ";".join(MM_MT) + "\n" + rows(";")]


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_text_is_refused_or_read(tmp_path, data):
    """Never another error, whatever is cut, exchanged or put in between."""
    text = data.draw(st.sampled_from(SEEDS)).encode()
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text)))
        upto = min(len(text), at + data.draw(st.sampled_from([0, 1, 7, 300])))
        text = text[:at] + data.draw(st.one_of(
            st.binary(max_size=8), st.sampled_from([b"", b"\n", b"%", b" 0\n", b"% Data\n", b"nan",
                                                    b"1e30 ", b"\x00", b"9" * 30]))) + text[upto:]
    try:
        found = imported(tmp_path, text, name=data.draw(st.sampled_from(
            ["", "columns", "opera", "comsol", "openpmd"])))
    except MeasurementError:
        return
    assert found.data.sizes["point"] > 0
    for suffix in (".csv", ".h5"):
        write_map(found.data, tmp_path / f"map{suffix}")
        assert read_map(tmp_path / f"map{suffix}").sizes == found.data.sizes


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200), st.sampled_from(["", "columns", "opera", "comsol", "openpmd"]))
def test_any_bytes_are_refused(tmp_path, raw, name):
    with pytest.raises(MeasurementError):
        imported(tmp_path, raw, name=name)


@pytest.mark.parametrize("line", [
    " " * 300_000 + "[", "1" * 300_000 + "x", "(" * 300_000, "1 X " + "[" * 300_000,
    "x " * 150_000, "% " + "@ " * 150_000, "a" * 300_000 + " (T)"])
def test_long_lines_take_no_time(tmp_path, line):
    """A pattern that tries every split of such a line would take hours."""
    for text in (f"{line}\n1 2 3\n", f"% Version: 1\n% Nodes: 1\n% {line}\n1 2 3\n",
                 f"1 1 1\n{line}\n", f"1 1 1\n 1 X\n{line}\n 0\n1 2 3\n"):
        said(tmp_path, text)


def test_the_structure_tells_the_format(tmp_path):
    for text, name in zip(SEEDS, ("opera", *["comsol"] * 3, *["columns"] * 2), strict=True):
        assert format_of(text.encode(), DEFAULTS, "map") == name
    found = imported(tmp_path, SEEDS[4])
    export_map(found.data, "geant4", tmp_path / "map.TABLE")
    assert format_of((tmp_path / "map.TABLE").read_bytes(), DEFAULTS, "map") == "opera"


@pytest.mark.parametrize(("unit", "factor"), [("mT", 1e3), ("G", 1e4)])
def test_what_is_advised_for_another_unit_can_be_followed(tmp_path, unit, factor):
    """The names of the sentence in place of those of the file, and nothing else."""
    path = tmp_path / "map.csv"
    write_map(field_map(POINTS, FIELD), path)
    rows = path.read_text().split("\n")
    head = next(number for number, row in enumerate(rows) if row.startswith("x_m"))
    rows[head + 1:] = [
        ",".join([*cells[:3], *(repr(factor * float(cell)) for cell in cells[3:])])
        for cells in (row.split(",") for row in rows[head + 1:] if row)]
    with pytest.raises(MeasurementError, match=rf"name the columns Bx_{unit}, .* and convert"):
        path.write_text("\n".join(rows))
        check_magnitudes(read_map(path))
    rows[head] = rows[head].replace("_T", f"_{unit}")
    assert same(imported(tmp_path, "\n".join(rows)))


def test_planes_that_comments_place(tmp_path):
    """One plane comes again; the comment above the first of them is in the preface."""
    planes = [(0, POINTS[:6]), (10, POINTS[6:12]), (0, POINTS[12:18])]
    text = "".join(f"# z = {z} mm\n" + ("" if number else "# x[mm] y[mm] Bx[T] By[T] Bz[T]\n")
                   + rows(" ", np.column_stack([1e3 * part[:, :2], FIELD[:6]]), np.zeros((6, 1)),
                          range(5))
                   for number, (z, part) in enumerate(planes))
    found = points_of(imported(tmp_path, text).data)
    assert found[:, 2].tolist() == [0.0] * 6 + [0.01] * 6 + [0.0] * 6
    np.testing.assert_allclose(found[:, :2], POINTS[:18, :2])


def test_a_first_row_that_runs_together(tmp_path):
    """The most negative corner of a grid in columns of fixed width."""
    table = np.abs(np.hstack([POINTS, FIELD]))
    table[0] = -0.1, -0.2, -0.3, -0.4, -0.5, -0.6
    text = "  X  Y  Z  Bx  By  Bz\n" + "".join(
        "".join(f"{value:8.5f}" for value in row) + "\n" for row in table)
    assert text.splitlines()[1].count(" ") == 0
    found = imported(tmp_path, text, length_unit="m", field_unit="T")
    np.testing.assert_allclose(points_of(found.data), table[:, :3], atol=1e-5)
    table = -np.abs(table)
    every = "".join("".join(f"{value:8.5f}" for value in row) + "\n" for row in table)
    found = imported(tmp_path, every, columns=("x", "y", "z", "Bx", "By", "Bz"),
                     length_unit="m", field_unit="T")
    np.testing.assert_allclose(points_of(found.data), table[:, :3], atol=1e-5)


def test_commands_of_the_measured_studies_read_their_maps(tmp_path):
    """What the Makefile has `halbach-fe import-map` do with the measured maps works."""
    text = (ROOT / "Makefile").read_text().replace("\\\n", " ")
    recipes = re.findall(r"^results/\S+: (\S+) .*\n\t\.venv/bin/halbach-fe (import-map .*)", text,
                         re.MULTILINE)
    assert len(recipes) == 3
    probe = ROOT / "studies/emphatic/measured/probe_calibration.csv"
    for number, (source, recipe) in enumerate(recipes):
        output = tmp_path / f"{number}.csv"
        words = shlex.split(recipe.replace("$<", str(ROOT / source)).replace("$@", str(output))
                            .replace("$(EMPHATIC_PROBE)", str(probe)))
        assert main(words) == 0
        assert len(points_of(read_map(output))) > 1000
