"""Files of other programs and instruments read rightly, or are refused with advice that works."""

from __future__ import annotations

import re
import subprocess
from contextlib import nullcontext

import meshio
import numpy as np
import pytest

from halbach_fe.core.errors import MeasurementError
from halbach_fe.measurement.field_map import field_map, points_of, write_map
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.import_export import import_map
from halbach_fe.measurement.text_tables import undecorated
from tests.conftest import processor_time
from tests.measurement.foreign_files import (
    FIELD,
    FILES,
    LENGTH,
    POINTS,
    TRIPLE,
    VTK,
    Foreign,
    mm_T,
    table,
)

ROUNDED = 2e-6
"""Largest error in T: FLUKA's fixed columns and MATLAB's text hold four to eight digits, all others
nine or more."""


HEADER = "x[mm],y[mm],z[mm],Bx[T],By[T],Bz[T]\n"


def ordered(points, field):
    order = np.lexsort(np.round(np.hstack([points, np.nan_to_num(field)]), 9).T)
    return points[order], field[order]


def same(data, points=POINTS, field=FIELD):
    found = points_of(data), data["B_T"].values
    return len(found[0]) == len(points) and all(
        np.allclose(one, other, rtol=0, atol=limit, equal_nan=True)
        for one, other, limit in zip(ordered(*found), ordered(points, field), (1e-8, ROUNDED),
                                     strict=True))


@pytest.mark.parametrize("case", FILES, ids=lambda case: case.name)
def test_what_people_have(tmp_path, case: Foreign):
    """Negative control: the same field with exchanged components is another."""
    path, positions = tmp_path / "file.txt", tmp_path / "positions.csv"
    path.write_bytes(case.text if isinstance(case.text, bytes) else case.text.encode())
    positions.write_text("x[mm],y[mm],z[mm]\n" + table(",", mm_T()[:3]))
    stated = dict(case.stated)
    if stated.pop("positions", False):
        stated["positions"] = positions
    if stated:
        with pytest.raises(MeasurementError) as caught:
            import_map(path, DeclaredFormat())
        for asked in case.asked:
            assert asked in str(caught.value)
    found = import_map(path, DeclaredFormat(**stated)).data
    assert same(found, case.points, case.field)
    assert not same(found, case.points, case.field[:, ::-1])


@pytest.mark.parametrize(("text", "asked"), [
    (b"\x1f\x8b\x08\0" + bytes(40), "gzip.*Unpack it"),
    (b"\x93NUMPY\x01\0v\0" + bytes(40), "NumPy.*numpy.savetxt"),
    (b"\x5e\xa4\x02\0" + bytes(range(256)), "binary file. Unpack"),
    (b"MATLAB 5.0 MAT-file" + bytes(200), "MATLAB.*savetxt"),
    (HEADER + table(",") + "1,1,1,9999,9999,9999\n", "9999, which looks like .* write nan"),
    (HEADER + table(",") + "1,1,1,1e30,1e30,1e30\n", "1e.30 T.*write nan"),
    (HEADER + table(",") + "1,1,1,1e38,1e38,1e38\n", "1e.38, which looks like .* write nan"),
    (HEADER + table(",") + "1,1,1,OL,0,0\n", "write nan"),
    (HEADER + table(",") + "Mean,,,1,2,3\n", "begin it with #"),
    (HEADER + table(",") + "END\n", r"begin it with #\.$"),
    (HEADER + "10 mm,0 mm,0 mm,0.1 T,0 T,0 T\n" * 2, r"its unit in the header, as in Bx\[mT\]"),
    (HEADER + "10,0,0,0.1±0.01,0±0.01,0±0.01\n" * 2, "sigma_Bx"),
    ("r[mm],theta[deg],phi[deg],|B|[T]\n8,30,0,0.1\n8,270,40,0.1\n", "exchange theta and phi"),
    ("r[mm],angle[deg],phi[deg],|B|[T]\n8,30,0,0.1\n8,270,40,0.1\n", "from the z axis theta"),
    ("r[mm],latitude[deg],phi[deg],|B|[T]\n8,30,0,0.1\n8,40,40,0.1\n", "of 90 degrees less it"),
    ("r[mm],theta[deg],phi[deg],Br[T],Bphi[T]\n8,30,0,0.1,0\n", "Btheta, without which Br and"),
    ("theta[deg],phi[deg],|B|[T]\n30,0,0.1\n", r"does not say r \(--at r=0.01 in m"),
    ("r[mm],theta[deg],phi[deg],Br[T],Btheta[T],Bphi[T],sigma_Br[T]\n8,30,0,0.1,0,0,1e-4\n",
     "one for all components"),
    ("3 -1 0 1\n3 -1 0 1\n3 -2 0 2\n" + "0.1 0.2 0.3\n" * 9, "ASTRA.*from its three files"),
    ("3DMagnetoStatic XYZ\n-1 1 2\n-1 1 2\n-2 2 4\n" + "0 0.1 0\n" * 45, "OPAL.*skip-lines 4"),
    ("2 0.02\n2 -0.01 0.01\n2 -0.01 0.01\n1\n" + "0.1\n" * 27, "TraceWin.*x changes fastest"),
    ("x[m] y[m] z[m] mf.Bx[T]\n" + "0 0 1 0.1+0i\n" * 2, r"real\(mf.Bx\)"),
    ("# ID kick map\n# Horizontal kick angles (T2m2)\nSTART\n-1 0 1\n-1 1 2 3\n", "map of kicks"),
    (HEADER + "10,0,0,0.1+0.0i,0+0i,0.2+0i\n" * 2, "Write real parts alone"),
    ("x[mm],y[mm],z[mm],dB [ppm]\n0,0,0,12\n", r"\(1 \+ ppm / 1e6\) times"),
    (HEADER.replace("mm", "ft") + "1,0,0,1,0,0\n" * 2, r"the unit of x, y, z, .*x\[N m\], with"),
    (HEADER + "1,5,2,0,3,0,0,1,0,2,0,3\n" * 2, "decimal commas too, write the file anew"),
    ("x_mm,y_mm,z_mm,component,B_mT\n0,0,0,x,1\n0,0,0,y,2\n", "pivot table"),
    ("x[mm],-1,0,1\ny[mm],0,0,0\nBx[T],1,2,3\n", "a row of its own, make it a column"),
    ("\n".join(" ".join(str(n * m % 7) for m in range(40)) for n in range(6)), "row of its own"),
    ("x[mm],y[mm],z[mm],dB0[ppm]\n0,0,0,12\n", r"\(1 \+ ppm / 1e6\) times"),
    ("z,z,z,z,z,Bx\n" + "0,0,0,0,0,1\n" * 2, "'z' or 'z' or 'z' or 2 more"),
    (",-10,0,10\n-10,1,2,3\n0,1,2,3\n10,1,2,3\n", "matrix .* a row x, y, B"),
    ("Y columns by X rows\n\nX Values:-1,0,1\n\n" + "1.5,2.5,1.5,2.5,1,3,2,2,1,1,2,3,9,\n" * 2,
     "matrix over two axes"),
    (",".join(f"log {n}" for n in range(40)) + "\n" + (",".join(["1"] * 40) + "\n") * 2,
     "'log 11' and 28 more"),
    ("1 0.5\n2 0.6\n", "--columns z,Bz and --at x=0,y=0; .* --columns Bx,By and --positions"),
    ("Distance [mm],Bx[T],By[T],Bz[T]\n1,0,0,1\n", "nothing is known of 'Distance .mm.'"),
    ("".join(f"run {n}\n1 2\n3 4\n5 6 7\n" for n in range(4)), "tables are below each other"),
    (HEADER + "1,2,3,0,0,1\n,,,0,0,2\n", "If the row is no reading, remove it"),
    ('[{"x": 0, "y": 0, "z": 0, "Bx": 0.1}]', "x, y, z, Bx, By, Bz of numbers for each point"),
    ('{\n "x": [1, 2,\n 3],\n "B": [\n 1, 2,\n 3]\n}', "JSON.*to_csv"),
], ids=str)
def test_what_is_no_table_says_what_to_do(tmp_path, text, asked):
    path = tmp_path / "file.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(MeasurementError, match=asked):
        import_map(path, DeclaredFormat())


@pytest.mark.parametrize(("field", "cells", "stated"), [
    ("Bx[T],By[T],Bz[T]", "0.1,0.2,0.3", {}), ("B[T]", "0.1", {"component": "z"})])
def test_scans_that_are_named_after_their_axis_are_no_components(tmp_path, field, cells, stated):
    """Negative control of components in rows of their own: three scans that cross in one point."""
    path = tmp_path / "file.txt"
    path.write_text(f"scan,x[mm],y[mm],z[mm],{field}\n" + "".join(
        f"{name},{','.join(str(at * (axis == name)) for axis in 'xyz')},{cells}\n"
        for name in "xyz" for at in range(-2, 3)))
    found = import_map(path, DeclaredFormat(**stated)).data
    assert found["scan"].values.tolist() == [*"xxxxxyyyyyzzzzz"]


@pytest.mark.parametrize("name", ["Standard deviation of B{}", "Std. dev. of B{}", "delta {}",
                                  "Gradient {}", "Background {}", "residual B{}", "B{}-B0",
                                  "Campo {} - B mean"])
def test_what_is_no_component_is_not_known_by_its_axis(tmp_path, name):
    path = tmp_path / "file.txt"
    path.write_text("x[mm],y[mm],z[mm]," + ",".join(name.format(axis) + " (mT)" for axis in "xyz")
                    + "\n1,2,3,0.1,0.1,0.1\n")
    with pytest.raises(MeasurementError, match="which columns are Bx, By or Bz"):
        import_map(path, DeclaredFormat())


@pytest.mark.parametrize("name", ["-Bx [T]", "- mf.Bx (T)", "\u2212Bx [T]"])
def test_a_minus_before_a_name_is_not_lost(tmp_path, name):
    """-Bx was read as Bx. Negative controls: a dash within a name, and --columns."""
    path = tmp_path / "file.txt"
    header = "x[mm],y[mm],z[mm],{},By[T],Bz[T]\n" + table(",")
    path.write_text(header.format(name))
    with pytest.raises(MeasurementError, match="with a minus before it"):
        import_map(path, DeclaredFormat())
    assert same(import_map(path, DeclaredFormat(columns=TRIPLE)).data)
    path.write_text(header.format("B-x [T]"))
    assert same(import_map(path, DeclaredFormat()).data)


@pytest.mark.parametrize("imaginary", [0.0, 0.2])
def test_imaginary_parts_are_told_of(tmp_path, imaginary):
    """Negative control: those that are zero."""
    path = tmp_path / "file.txt"
    path.write_text("x[mm],y[mm],z[mm],BxRe[T],BxIm[T],ByRe[T],BzRe[T]\n" + table(
        ",", [*mm_T()[:4], imaginary + 0 * LENGTH, *FIELD.T[1:]]))
    found = import_map(path, DeclaredFormat())
    assert same(found.data)
    assert any("'BxIm[T]' is not zero, up to 0.2" in remark
               for remark in found.remarks) == bool(imaginary)


def test_vectors_of_other_programs_in_vtu(tmp_path):
    """Which vector is B is not guessed. Negative control: that of halbach-fe itself has units."""
    path, units = tmp_path / "file.vtu", {"length_unit": "mm", "field_unit": "T"}
    cells = [("vertex", np.arange(len(POINTS))[:, None])]

    def written(**vectors):
        meshio.write(path, meshio.Mesh(1e3 * POINTS, cells, point_data=vectors))

    written(B=FIELD, J=2 * FIELD)
    assert same(import_map(path, DeclaredFormat(**units)).data)
    written(H=2 * FIELD, A=FIELD)
    with pytest.raises(MeasurementError, match=r"one vector B; .* '[HA]', '[HA]'. .*--columns"):
        import_map(path, DeclaredFormat(**units))
    names = ("x", "y", "z", *(("Bx", "By", "Bz") if one == "A" else ("-",) * 3
                              for one in meshio.read(path).point_data))
    assert same(import_map(path, DeclaredFormat(columns=tuple(np.hstack(names)), **units)).data)
    written(B=LENGTH)
    with pytest.raises(MeasurementError, match=r"no vector\. .*Cell Data to Point Data"):
        import_map(path, DeclaredFormat(**units))
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(MeasurementError, match=r"damaged.*Save Data"):
        import_map(path, DeclaredFormat(**units))
    own = path.with_name("own.vtu")
    write_map(field_map(POINTS, FIELD), own)
    assert same(import_map(own, DeclaredFormat()).data)


@pytest.mark.parametrize(("says", "claims"), [
    ("DIMENSIONS 2 2 1", "DIMENSIONS 3000 3000 3000"), ("POINT_DATA 4", "POINT_DATA 99999999999"),
    ("B 3 4 double", "B 3 99999999999 double"), ("", "")])
def test_a_vtk_file_that_claims_more_than_it_holds(tmp_path, says, claims):
    """meshio makes room for what a file claims. Negative control: the sound file."""
    path = tmp_path / "file.vtk"
    path.write_text((VTK + "STRUCTURED_POINTS\nDIMENSIONS 2 2 1\nORIGIN 0 0 0\nSPACING 1 1 1\n"
                     "POINT_DATA 4\nFIELD FieldData 1\nB 3 4 double\n" + "0.1 0 0.2\n" * 4).replace(
                         says, claims))
    declared = DeclaredFormat(length_unit="mm", field_unit="T")
    if not says:
        assert import_map(path, declared).data.sizes["point"] == 4
        return
    with pytest.raises(MeasurementError, match="that is whole"):
        import_map(path, declared)


@pytest.mark.parametrize(("name", "is_b"), [
    ("magnetic_flux_density", True), ("B_field", True), ("magnetic_field", False), ("H", False)])
def test_a_vector_of_a_vtk_file_that_may_be_h_is_not_read_as_b(tmp_path, name, is_b):
    path = tmp_path / "file.vtk"
    path.write_text(VTK + "STRUCTURED_POINTS\nDIMENSIONS 2 2 1\nORIGIN 0 0 0\nSPACING 1 1 1\n"
                    f"POINT_DATA 4\nVECTORS {name} double\n" + "0.1 0 0.2\n" * 4)
    declared = DeclaredFormat(length_unit="mm", field_unit="T")
    if is_b:
        assert import_map(path, declared).data.sizes["point"] == 4
        return
    with pytest.raises(MeasurementError, match="one vector B"):
        import_map(path, declared)


def test_the_noise_of_x_in_a_unit_of_the_field_is_that_of_Bx(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("x[mm],y[mm],z[mm],Bx[mT],By[mT],Bz[mT],sd x (mT),sd y (mT),sd z (mT)\n"
                    "1,2,3,100,100,100,0.1,0.2,0.3\n")
    data = import_map(path, DeclaredFormat()).data
    assert np.allclose(data["sigma_T"], [[1e-4, 2e-4, 3e-4]], rtol=1e-12)


def test_long_rows_are_read_in_a_time_that_grows_as_they_do():
    """Of a row with many blanks its end was sought once for all pairs of blanks."""
    def read(numbers):
        row = (" " * 15).join(["1.234567e-3"] * numbers)
        assert undecorated(row) == row
        assert undecorated(f"{row};") == row

    # Ten times as long, where it was a hundred times; a call of 1e-4 s may be interrupted.
    assert min(processor_time(read, 600) for _ in range(3)) < 30 * processor_time(read, 60)


def test_rows_that_begin_as_a_grid_of_astra_are_rows(tmp_path):
    """The first cell of each is the number of cells after it."""
    path = tmp_path / "file.txt"
    path.write_text("".join(f"5 0 {z} 10 11 12\n" for z in range(1, 6)))
    columns = ("x[mm]", "y[mm]", "z[mm]", "Bx[mT]", "By[mT]", "Bz[mT]")
    for stated in ({"columns": columns}, {}):
        with nullcontext() if stated else pytest.raises(
                MeasurementError, match="what its 6 columns are"):
            assert import_map(path, DeclaredFormat(**stated)).data.sizes["point"] == 5


def test_limits_above_rows_are_no_readings(tmp_path):
    """With --columns too. Negative control: rows of three numbers that are no such limits."""
    path, declared = tmp_path / "file.txt", DeclaredFormat(
        columns=("z[mm]", "Bx[mT]", "By[mT]"), at={"x": 0.0, "y": 0.0})
    for rows in (45, 46):
        path.write_text("-1 1 3\n-2 2 3\n-3 3 5\n" + "".join(f"{n} {n} 1\n" for n in range(rows)))
        with pytest.raises(MeasurementError, match="skip-lines 3") if rows == 45 else (
                nullcontext()):
            assert import_map(path, declared).data.sizes["point"] == 3 + rows


@pytest.mark.parametrize("last", ["999,0,0", "9.99,1,0", "0,0,0.099"])
def test_nines_beside_others_of_their_size_are_readings(tmp_path, last):
    """Negative control of placeholders: what the others are a third of may have been read."""
    path = tmp_path / "file.txt"
    path.write_text(HEADER.replace("T", "mT") + "0,0,0,900,0,0\n1,0,0,5,4,1\n2,0,0," + last + "\n")
    assert import_map(path, DeclaredFormat()).data.sizes["point"] == 3


@pytest.mark.parametrize(("text", "asked", "stated"), [
    ('X, Y, Z, Scalar data "Mag_B"\n' + table(" ", [*mm_T(1.0)[:3], LENGTH]), "unit of Babs",
     {"length_unit": "m", "field_unit": "T"}),
    ("x[mm],y[mm],z[mm],f[MHz]\n" + table(",", [*mm_T()[:3], LENGTH / 0.0234872]),
     r"Babs\[0.0234872 T\]", {"columns": ("x[mm]", "y[mm]", "z[mm]", "Babs[0.0234872 T]")}),
    ("x_mm,y_mm,z_mm,Magnetic_Field_Reading\n" + table(",", [*mm_T()[:3], LENGTH]),
     "--component abs", {"component": "abs", "field_unit": "T"}),
    ("x_mm,y_mm,z_mm,NMR field (T)\n" + table(",", [*mm_T()[:3], LENGTH]), "", {})])
def test_magnitudes(tmp_path, text, asked, stated):
    path = tmp_path / "file.txt"
    path.write_text(text)
    if asked:
        with pytest.raises(MeasurementError, match=asked):
            import_map(path, DeclaredFormat())
    found = import_map(path, DeclaredFormat(**stated)).data
    np.testing.assert_allclose(found["Babs_T"], LENGTH, atol=ROUNDED)
    np.testing.assert_allclose(points_of(found), POINTS, atol=1e-8)


@pytest.mark.parametrize("header", [
    "x[mm],y[mm],z[mm],Bx1[mT],By1[mT],Bz1[mT],Bx2[mT],By2[mT],Bz2[mT]",
    "x[mm],y[mm],z[mm],X error[mT],Y error[mT],Z error[mT],a,b,c",
    "X offset[mm],Y offset[mm],Z offset[mm],Bx[mT],By[mT],Bz[mT],a,b,c"])
def test_axes_in_names_of_other_columns(tmp_path, header):
    """Negative controls: two probes, deviations and offsets are no positions or components."""
    path = tmp_path / "file.txt"
    path.write_text(f"{header}\n1,2,3,4,5,6,7,8,9\n2,2,3,4,5,6,7,8,9\n")
    with pytest.raises(MeasurementError, match="does not say"):
        import_map(path, DeclaredFormat())


@pytest.mark.parametrize(("unit", "stated", "advice"), [
    ("m", {}, r"Is m, the unit.*x\[mm\]"), ("", {"length_unit": "m"}, "give --length-unit mm")])
def test_points_far_away_say_what_can_be_followed(tmp_path, unit, stated, advice):
    path = tmp_path / "file.txt"
    path.write_text(f"x[{unit}],y[{unit}],z[{unit}],Bx[T],By[T],Bz[T]\n" + table(","))
    found = import_map(path, DeclaredFormat(**stated))
    assert re.search(advice, found.remarks[-1])
    followed = {"columns": TRIPLE} if unit else {"length_unit": "mm"}
    assert same(import_map(path, DeclaredFormat(**followed)).data)


@pytest.mark.parametrize(("name", "stated", "advice"), [
    ("map.h5", {}, "columns of the map, as CSV, x_mm, y_mm, z_mm"),
    ("file.txt", {"at": {"r": 10.0, "z": 0.0}}, "mm[?] --at is in m[.]$")])
def test_what_states_no_length_is_not_sent_to_its_unit(tmp_path, name, stated, advice):
    """It is refused for maps of halbach-fe's own, and where all positions are of an option."""
    path = tmp_path / name
    if name.endswith("h5"):
        write_map(field_map(1e3 * POINTS, FIELD), path)
    else:
        path.write_text("phi[deg],Br[T],Bphi[T]\n0,0.1,0.1\n90,0.2,0.1\n")
    assert re.search(advice, import_map(path, DeclaredFormat(**stated)).remarks[-1])
    with pytest.raises(MeasurementError):
        import_map(path, DeclaredFormat(**stated, length_unit="mm"))


def test_a_factor_in_the_place_of_a_unit_is_not_left_out(tmp_path):
    """The message says how to state it; 1 is none."""
    path = tmp_path / "file.txt"
    for factor, read in (("1.0", 4.0), ("1e-3", 4e-3)):
        path.write_text(f"x[mm],y[mm],z[mm],Bx[{factor}]\n1,2,3,4\n")
        with nullcontext() if factor == "1.0" else pytest.raises(
                MeasurementError, match=r"--columns \.\.\.Bx\[1e-3 T\]"):
            import_map(path, DeclaredFormat(field_unit="T"))
        data = import_map(path, DeclaredFormat(columns=(
            "x[mm]", "y[mm]", "z[mm]", f"Bx[{factor} T]"))).data
        assert np.isclose(data["B_T"].values[0, 0], read, rtol=1e-12)


def test_a_sphere_of_one_radius(tmp_path):
    """Its radius may be an option, as that of a circle."""
    path = tmp_path / "file.txt"
    path.write_text("theta[deg],phi[deg],Br[mT],Btheta[mT],Bphi[mT]\n90,90,1,2,3\n")
    data = import_map(path, DeclaredFormat(at={"r": 0.01})).data
    assert np.allclose(points_of(data), [[0, 0.01, 0]], rtol=0, atol=1e-17)
    assert np.allclose(data["B_T"], [[-3e-3, 1e-3, -2e-3]], rtol=0, atol=1e-17)


@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_rows_and_header_that_a_delimiter_ends(tmp_path, mark):
    path = tmp_path / "file.txt"
    path.write_text(HEADER.replace(",", mark).replace("\n", f"{mark}\n")
                    + table(mark).replace("\n", f"{mark}\n"))
    assert same(import_map(path, DeclaredFormat()).data)


def test_number_of_files():
    assert len({case.name for case in FILES}) == len(FILES) > 60


def test_a_line_of_counts_that_does_not_count(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("3 3 4\n" + table(" "))
    with pytest.raises(MeasurementError, match="--skip-lines 1"):
        import_map(path, DeclaredFormat(columns=("x", "y", "z", "Bx", "By", "Bz"),
                                        length_unit="mm", field_unit="T"))


@pytest.mark.parametrize("mark", ",;\t")
def test_whole_numbers_above_a_row_with_an_empty_cell_are_no_counts(tmp_path, mark):
    """They were read as counts of points, so that a reading was lost."""
    path = tmp_path / "file.txt"
    path.write_text("x[mm],y[mm],z[mm],Bx[mT]\n1,2,3,100\n1,2,4,\n1,2,5,101\n".replace(",", mark))
    found = import_map(path, DeclaredFormat()).data
    np.testing.assert_allclose(found["B_T"][:, 0], [0.1, 0.101])


@pytest.mark.parametrize(("again", "refused"), [
    (HEADER, False), (HEADER.replace("T", "mT"), True), ("x,y,z,Bx,By,Bz\n", False),
    ("z[mm],y[mm],x[mm],Bx[T],By[T],Bz[T]\n", True), ("second scan, from z = 0\n", False),
    ("x, = 0,y, = 5,z, = 1\n", False)])
def test_a_header_that_comes_again_is_the_same(tmp_path, again, refused):
    """Rows below another one were read in the units of the first."""
    path, rows = tmp_path / "file.txt", table(",").splitlines(True)
    path.write_text("".join(["#", HEADER, *rows[:20], "#", again, *rows[20:]]))
    if not refused:
        assert same(import_map(path, DeclaredFormat()).data)
        return
    with pytest.raises(MeasurementError, match=r"line 22 .* a header as that above the table"):
        import_map(path, DeclaredFormat())


@pytest.mark.parametrize("counts", ["45", "3 3 5"])
def test_counts_above_a_header(tmp_path, counts):
    """The header was counted as a row. Negative control: a count of other rows."""
    path = tmp_path / "file.txt"
    path.write_text(f"{counts}\n" + HEADER.replace(",", " ") + table(" "))
    assert same(import_map(path, DeclaredFormat()).data)
    path.write_text(f"{counts}\n" + HEADER.replace(",", " ") + table(" ") + "9 9 9 0 0 0\n")
    with pytest.raises(MeasurementError, match="counts of the 46 rows"):
        import_map(path, DeclaredFormat())


def test_a_centre_in_a_comment_says_how_to_use_it(tmp_path):
    path = tmp_path / "file.txt"
    lab = mm_T()
    path.write_text("# magnet center in lab: x 100.00 mm, y 200.00 mm, z -50.00 mm\n"
                    "# X[mm],Y[mm],Z[mm],B0_x[T],B0_y[T],B0_z[T]\n" + table(",", [
                        lab[0] + 100, lab[1] + 200, lab[2] - 50, *lab[3:]]))
    found = import_map(path, DeclaredFormat())
    assert "--origin-m=-0.1,-0.2,0.05," in found.remarks[0]
    assert not same(found.data)
    assert same(import_map(path, DeclaredFormat(origin_m=(-0.1, -0.2, 0.05))).data)


def test_the_header_is_overridden_and_that_is_said(tmp_path):
    path = tmp_path / "file.txt"
    path.write_text("x[cm],y[cm],z[cm],By[mT],Bx[mT],Bz[mT]\n" + table(","))
    found = import_map(path, DeclaredFormat(columns=(
        "x[mm]", "y[mm]", "z[mm]", "Bx[T]", "By[T]", "Bz[T]")))
    assert same(found.data)
    assert len(found.remarks) == 6
    with pytest.raises(MeasurementError, match="cm in the file and --length-unit mm"):
        import_map(path, DeclaredFormat(length_unit="mm"))


def test_positions_of_another_length(tmp_path):
    path, positions = tmp_path / "file.txt", tmp_path / "positions.csv"
    path.write_text("Bx[T],By[T],Bz[T]\n" + table(",", FIELD.T))
    for text, asked in (("x[mm],y[mm],z[mm]\n0,0,0\n", "45 rows"),
                        ("x,y,z\n0,0,0\n", "their units")):
        positions.write_text(text)
        with pytest.raises(MeasurementError, match=asked):
            import_map(path, DeclaredFormat(positions=positions))
    positions.write_text("x,y,z\n" + table(",", mm_T()[:3]))
    assert same(import_map(path, DeclaredFormat(positions=positions, length_unit="mm")).data)
    positions.write_text("x[mm],y[mm],z[mm]\n" + table(",", mm_T()[:3]))
    with pytest.raises(MeasurementError, match="mm in the file and --length-unit cm"):
        import_map(path, DeclaredFormat(positions=positions, length_unit="cm"))


def carried_out(path, sentence):
    """Run the command that a sentence advises, from FILE to NEW; return the path of NEW."""
    (command,) = re.findall(r": (.* NEW)\.", sentence)
    new = path.with_name("new.txt")
    subprocess.run(["sh", "-c", re.sub(r"\bFILE\b", str(path), command).replace("NEW", str(new))],
                   check=True)
    return new


def without_letter(value):
    """Return a number as programs of old print it: 1.23450-05."""
    return f"{value:.9e}".replace("e", "")


def over_lines(number, separator=" "):
    """Return the rows of `table` with a new line after every so many numbers."""
    rows = [row.split(separator) for row in table(separator, number="{:.9f}").splitlines()]
    return "".join(separator.join(row[n:n + number]) + "\n"
                   for row in rows for n in range(0, len(row), number))


@pytest.mark.parametrize(("text", "columns"), [
    (HEADER + "".join(",".join(map(without_letter, row)) + "\n"
                      for row in np.column_stack(mm_T())), False),
    (over_lines(3), True), (over_lines(2, ","), True), (over_lines(4, ","), True),
    ("# of Tuesday\n" + over_lines(3, "\t"), True),
    ("# " + HEADER + over_lines(4, ","), False)])
def test_commands_that_are_advised_work(tmp_path, text, columns):
    """Numbers without the letter of their exponent, and readings of several lines."""
    path = tmp_path / "file.txt"
    path.write_text(text)
    stated = DeclaredFormat() if not columns else DeclaredFormat(
        columns=("x", "y", "z", "Bx", "By", "Bz"), length_unit="mm", field_unit="T")
    with pytest.raises(MeasurementError) as caught:
        import_map(path, stated)
    assert same(import_map(carried_out(path, str(caught.value)), stated).data)


@pytest.mark.parametrize("text", [
    HEADER + table(",") + "1,2,3,4\n5,6\n",  # cut short, not spread
    HEADER + table(",").replace("10,10,10,", "10,10,10,,", 1)])
def test_rows_of_other_lengths_are_not_spread(tmp_path, text):
    """Control: their advice is another."""
    path = tmp_path / "file.txt"
    path.write_text(text)
    with pytest.raises(MeasurementError, match="cut short"):
        import_map(path, DeclaredFormat())
