"""What a file says beside points and field (noise, times, scans, symmetry) is not lost."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
import xarray as xr

from halbach_fe.core.errors import HalbachWarning, MeasurementError
from halbach_fe.measurement.field_map import field_map, points_of, read_map, write_map
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.import_export import export_map, import_map

POINTS = np.array([[0.0, 0.0, 0.01 * n] for n in range(6)])
FIELD = np.random.default_rng(3).normal(0.1, 0.01, (6, 3))


def imported(tmp_path, text, **declared):
    path = tmp_path / "hall.txt"
    path.write_text(text)
    return import_map(path, DeclaredFormat(**declared))


def full_map():
    data = field_map(POINTS, FIELD, sigma_T=1e-5 * (1 + np.arange(18).reshape(6, 3)),
                     attributes={"probe": "Hall, serial 0815", "temperature": "21 °C"})
    return data.assign(time_s=("point", 3.25 + 1.5 * np.arange(6)),
                       scan=("point", np.array(["a", "a", "b", "b", "7", "7"])))


@pytest.mark.parametrize("suffix", [".csv", ".h5", ".vtu"])
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.1, -0.2, 0.3)])
def test_options_lose_nothing_of_an_own_map(tmp_path, suffix, origin):
    """The importer reads a map in halbach-fe's own columns as `read_map` does."""
    path = tmp_path / f"map{suffix}"
    # a VTU file has no place for the names of scans
    with (pytest.warns(HalbachWarning, match="scan") if suffix == ".vtu" else nullcontext()):
        write_map(full_map(), path)
    plain = read_map(path)
    found = import_map(path, DeclaredFormat(origin_m=origin)).data
    np.testing.assert_allclose(points_of(found), points_of(plain) + origin, rtol=0, atol=1e-16)
    for name in ("B_T", "sigma_T", "time_s", "scan"):
        assert (name in found) == (name in plain)
        if name in plain:
            np.testing.assert_array_equal(found[name], plain[name])
    assert plain.attrs.items() <= found.attrs.items()
    if suffix != ".csv":  # units cannot be stated anew
        with pytest.raises(MeasurementError, match="Only --origin-m"):
            import_map(path, DeclaredFormat(length_unit="mm"))
    else:
        with pytest.raises(MeasurementError, match="m in the file and --length-unit mm"):
            import_map(path, DeclaredFormat(length_unit="mm"))


@pytest.mark.parametrize(("header", "expected"), [
    ("Bx_std_G", [1e-4, np.nan, np.nan]), ("err", [1e-3, 1e-3, 1e-3]),
    ("sigma_B", [1e-3, 1e-3, 1e-3]), ("dBx[mT]", [1e-3, np.nan, np.nan]),
    ("sigma(Bx) [T]", [1.0, np.nan, np.nan]), ("error [G]", [1e-4] * 3),
    ("u(Bx)[mT]", [1e-3, np.nan, np.nan]), ("Bx_err [mT]", [1e-3, np.nan, np.nan]),
    ("uncertainty", [1e-3] * 3), ("stdev", [1e-3] * 3)])
def test_columns_of_noise(tmp_path, header, expected):
    """A column without a unit is in that of the field; factor 0.5 for a number of its own."""
    components = ("Bx",) if np.isnan(expected[1]) else ("Bx", "By", "Bz")
    names = ["x[mm]", "y[mm]", "z[mm]", *(f"{name} [mT]" for name in components), header]
    factor = 0.05
    rows = "".join(f"0;0;{n};{';'.join(['100'] * len(components))};{factor}\n" for n in range(3))
    found = imported(tmp_path, ";".join(names) + "\n" + rows)
    np.testing.assert_allclose(found.data["sigma_T"], [factor * np.array(expected)] * 3)
    assert found.ignored == ()
    assert any(f"'{header}'" in said and "standard deviation" in said
               for said in found.remarks)
    without = imported(tmp_path, ";".join(names) + "\n" + rows, columns=(
        "x", "y", "z", *components, "-"))
    assert "sigma_T" not in without.data


@pytest.mark.parametrize("name", ["error code", "x_err", "dBx/dz", "B_mod", "terror", "dx"])
def test_other_columns_are_no_noise(tmp_path, name):
    found = imported(tmp_path, f"x[mm];y[mm];z[mm];Bx[mT];{name}\n0;0;1;100;1\n0;0;2;90;1\n")
    assert "sigma_T" not in found.data
    assert found.ignored == (name,)
    assert any("noise.position_sd_m" in said for said in found.remarks) == (
        name == "x_err")


@pytest.mark.parametrize(("cells", "asked"), [
    (("0.1", "0"), "standard deviation of Bx in reading 2"), (("0.1", ""), "instead received none"),
    (("0.1", "wide"), "sigma in line 3"), (("0.5", "5000"), "in reading 2")])
def test_absurd_noise_is_refused(tmp_path, cells, asked):
    text = "x[mm];y[mm];z[mm];Bx[mT];err\n" + "".join(
        f"0;0;{n};100;{cell}\n" for n, cell in enumerate(cells))
    with pytest.raises(MeasurementError) as caught:
        imported(tmp_path, text)
    assert asked in str(caught.value)


def test_noise_of_cylindrical_components(tmp_path):
    """By the propagation of errors: at 90 degrees Bphi is -Bx."""
    found = imported(tmp_path, "r[mm],phi[deg],z[mm],Br[mT],Bphi[mT],Br_std[mT],Bphi_std[mT]\n"
                     "10,0,0,1,1,0.1,0.2\n10,90,0,1,1,0.1,0.2\n10,45,0,1,1,0.1,0.2\n")
    both = np.sqrt(0.5 * (0.1**2 + 0.2**2))
    np.testing.assert_allclose(found.data["sigma_T"][:, :2].values * 1e3, [
        [0.1, 0.2], [0.2, 0.1], [both, both]])
    assert "were independent" in " ".join(found.remarks)


@pytest.mark.parametrize(("cells", "seconds"), [
    (("14:23:59", "14:24:01", "14:24:03.5"), [0, 2, 4.5]),
    (("23:59:50", "00:00:10", "00:00:30"), [0, 20, 40]),
    (("2024-05-31T23:59:50", "2024-06-01T00:00:10", "2024-06-01 00:00:30"),
     [0, 20, 40]),
    (("2024-05-31T12:00:00Z", "2024-05-31T14:00:10+02:00", "2024-05-31T12:00:20Z"),
     [0, 10, 20])])
def test_times_of_day_and_stamps(tmp_path, cells, seconds):
    text = "time,x[mm],y[mm],z[mm],Bx[mT]\n" + "".join(
        f"{cell},0,0,{n},100\n" for n, cell in enumerate(cells))
    assert imported(tmp_path, text).data["time_s"].values.tolist() == seconds


def timed(tmp_path, header, cells, **declared):
    return imported(tmp_path, f"{header},x[mm],y[mm],z[mm],Bx[mT]\n" + "".join(
        f"{cell},0,0,{n},100\n" for n, cell in enumerate(cells)), **declared)


@pytest.mark.parametrize(("head", "right"), [
    ("x/(mm);y/(mm);z/(mm);Hx/(kA/m)", 4e-2 * np.pi),
    ("x_mm;y_mm;z_mm;Hx_kA/m", 4e-2 * np.pi),
    ("x / mm;y / mm;z / mm;Bx in kA/m", 4e-2 * np.pi), ("x/mm;y/mm;z/mm;Bx/mT", 0.1)])
def test_units_behind_a_slash(tmp_path, head, right):
    """Refused: of kA/m the unit was m, and a slash before brackets belonged to the name."""
    found = imported(tmp_path, f"{head}\n1;2;3;100\n2;2;3;100\n").data
    np.testing.assert_allclose(found["B_T"].sel(component="x"), right, rtol=1e-6)
    assert float(found["x_m"][0]) == 0.001


def test_hhmmss(tmp_path):
    """142359 is 14:23:59, two seconds before 142401; as seconds it would be 42."""
    cells = (142355, 142359, 142401)
    right = [0.0, 4.0, 6.0]
    assert timed(tmp_path, "hhmmss", cells).data["time_s"].values.tolist() == right
    assert timed(tmp_path, "time [HHMMSS]", cells).data["time_s"].values.tolist() == right
    columns = ("t[hhmmss]", "x", "y", "z", "Bx")
    assert timed(tmp_path, "time", cells, columns=columns).data["time_s"].values.tolist() == right
    unstated = timed(tmp_path, "time", cells)
    assert "time_s" not in unstated.data
    assert "they look like HHMMSS" in " ".join(unstated.remarks)
    for header, declared in (("time [s]", {}), ("time", {"columns": ("t[s]", *columns[1:])})):
        with pytest.raises(MeasurementError, match=r"t\[hhmmss\]"):
            timed(tmp_path, header, cells, **declared)
    with pytest.raises(MeasurementError, match="times of day HHMMSS"):
        timed(tmp_path, "hhmmss", (142355, 142399))
    # seconds that cannot be, or are not taken for, times of day
    for seconds in ((142355, 142405, 142395), (142301, 142303, 142307), (1, 2, 3),
                    (10000.5, 10101.5, 10202.5)):
        found = timed(tmp_path, "time [s]", seconds).data["time_s"].values
        assert found.tolist() == list(seconds)


@pytest.mark.parametrize("header", ["time", "time [min:s]"])
def test_times_that_may_be_minutes_and_seconds(tmp_path, header):
    """00:23 of a stopwatch was 23 minutes. Control: with seconds it is a time of day."""
    found = timed(tmp_path, header, ("00:23", "01:24", "02:26"))
    assert "time_s" not in found.data
    assert "neither times of day HH:MM:SS nor stamps" in " ".join(found.remarks)
    whole = timed(tmp_path, "time", ("00:00:23", "00:01:24", "00:02:26"))
    assert whole.data["time_s"].values.tolist() == [0.0, 61.0, 123.0]


def test_of_two_columns_of_times_the_one_in_a_unit_is_read(tmp_path):
    """Times of day beside it were said to be none. Control: alone they are read."""
    rows = zip(("23:59:58", "23:59:59", "00:00:01"), (0, 1, 3), strict=True)
    found = timed(tmp_path, "time,time_s", [f"{clock},{t}" for clock, t in rows])
    assert found.data["time_s"].values.tolist() == [0.0, 1.0, 3.0]
    assert "The times in 'time' are not used: those in 'time_s' are." in found.remarks
    alone = timed(tmp_path, "time", ("23:59:58", "23:59:59", "00:00:01"))
    assert alone.data["time_s"].values.tolist() == [0.0, 1.0, 3.0]
    assert not [said for said in alone.remarks if "not used" in said]


def test_own_times_that_are_no_seconds_are_refused(tmp_path):
    path = tmp_path / "map.csv"
    lines = "".join(f"0,0,0.0{n},0.1,{t}\n" for n, t in enumerate((142355, 142359, 142401)))
    path.write_text("x_m,y_m,z_m,Bx_T,time_s\n" + lines)
    with pytest.raises(MeasurementError, match="HHMMSS"):
        read_map(path)
    path.write_text("x_m,y_m,z_m,Bx_T,time_s\n" + lines.replace("142359", "142395"))
    assert read_map(path)["time_s"][1] == 142395
    path.write_text("x_m,y_m,z_m,Bx_T,time_s\n" + lines.replace("142359", "14:23:59"))
    with pytest.raises(MeasurementError, match="import-map"):
        read_map(path)


QUADRANT = "param normB=1.0 current=1.0\ngrid X0=0 Y0=0 Z0=-20 nX=2 nY=2 nZ=5 dX=10 dY=10 dZ=10\n"


def quadrant(symmetry="extendX flip=By,Bz\n", head=QUADRANT):
    return f"* of a test\n{head}{symmetry}data\n" + "".join(
        f"{x} {y} {z} {0.1 + 2e-3 * y:.6g} {2e-3 * x:.6g} 0\n"
        for x in (0, 10) for y in (0, 10) for z in range(-20, 21, 10))


def test_a_part_of_a_g4beamline_map_is_called_a_part(tmp_path):
    """Mirrored values would count as readings, so the map has the 20 points of the file."""
    found = imported(tmp_path, quadrant())
    points, field = points_of(found.data), found.data["B_T"].values
    assert (found.format, len(points)) == ("g4beamline", 20)
    np.testing.assert_allclose(field[:, 0], 0.1 + 2 * points[:, 1], atol=1e-12)
    np.testing.assert_allclose(field[:, 1], 2 * points[:, 0], atol=1e-12)
    said, = found.remarks
    assert "only a part, x from 0 to 10 mm" in said
    assert "By and Bz reversed" in said
    assert "no field without sources" not in said
    assert imported(tmp_path, quadrant("")).remarks == ()
    impossible, = imported(tmp_path, quadrant("extendX flip=Bx,By\n")).remarks
    assert "no field without sources" in impossible
    assert len(imported(tmp_path, quadrant("extendX flip=Bx\nextendY flip=By\n"
                                           "extendZ flip=Bz\n")).remarks) == 3


def test_g4beamline_scale_and_current(tmp_path):
    head = QUADRANT.replace("normB=1.0 current=1.0", "normB=1e-4 current=5")
    found = imported(tmp_path, quadrant("", head))
    plain = imported(tmp_path, quadrant(""))
    np.testing.assert_allclose(found.data["B_T"], 1e-4 * plain.data["B_T"], rtol=1e-12)
    assert ["normB=0.0001" in found.remarks[0],
            "current 5" in found.remarks[1]] == [True, True]


@pytest.mark.parametrize(("old", "new", "asked"), [
    ("nX=2", "nX=1", "X of point 11"), ("dY=10", "dY=7", "Y of point 6"),
    ("param", "time period=3\nparam", "static"), ("flip=By", "flop=By", "extendX with flip"),
    ("normB=1.0", "normB=x", "normB"), ("data\n", "Bx\n", "point by point"),
    ("data\n", "data\n0 0 -20 0.1 0.2\n", "5 values")])
def test_other_g4beamline_files_are_refused(tmp_path, old, new, asked):
    with pytest.raises(MeasurementError) as caught:
        imported(tmp_path, quadrant().replace(old, new, 1))
    assert asked in str(caught.value)


def test_a_cylinder_of_g4beamline(tmp_path):
    text = "cylinder R0=0 Z0=0 nR=2 nZ=2 dR=10 dZ=5\nextendZ flip=Br\ndata\n" + (
        "0 0 0 0.5\n10 0 0.1 0.5\n0 5 0 0.4\n10 5 0.2 0.4\n")
    found = imported(tmp_path, text)
    np.testing.assert_allclose(points_of(found.data)[1], [0.01, 0, 0])
    np.testing.assert_allclose(found.data["B_T"][1], [0.1, np.nan, 0.5])
    assert "-z the field is the same with Br reversed" in found.remarks[0]
    assert "half-plane" in found.remarks[1]


def test_bdsim_maps_are_read_as_they_are_written(tmp_path):
    axes = np.meshgrid([-0.01, 0.01], [0.0, 0.005, 0.01], [0.1, 0.2], indexing="ij")
    points = np.stack(axes, axis=-1).reshape(-1, 3)
    field = np.column_stack([0.5 + points @ [1, 10, 0.1], points @ [3, -2, 0.2],
                             points @ [1, 7, -0.3]])
    path = tmp_path / "map.dat"
    export_map(field_map(points, field), "bdsim", path)
    found = import_map(path, DeclaredFormat())
    assert found.format == "bdsim"
    order = np.lexsort(points_of(found.data).T[::-1])
    np.testing.assert_allclose(points_of(found.data)[order], points, atol=1e-15)
    np.testing.assert_array_equal(found.data["B_T"].values[order], field)
    text = path.read_text()
    assert not found.remarks
    for old, new, asked in (
            ("nx> 2", "nx> 3", "18 points"), ("Fz", "t", "does not change"),
            ("nx> 2\n", "nx> -2\nny> -3\n", "0 points"),
            ("xmin> -1.0", "xmin> -10.0", "column X .* from -10.0 to 1.0 cm"),  # keys in mm
            ("zmax> 20.0", "zmax> 0.2", "column Z")):
        path.write_text(text.replace(old, new))
        with pytest.raises(MeasurementError, match=asked):
            import_map(path, DeclaredFormat())
    path.write_text(text.replace("xyzt", "tzyx"))  # BDSIM would give the readings to other points
    assert "order" in import_map(path, DeclaredFormat()).remarks[0]


@pytest.mark.parametrize(("line", "told"), [
    ("# symmetry: quarter, mirrored at x = 0", True), ("scale factor 1e-4", True),
    ("% MAGNET CENTER IN LAB: x 100.00 mm", True), ("# probe 3", False)])
def test_lines_that_may_change_the_numbers_are_told(tmp_path, line, told):
    found = imported(tmp_path, f"{line}\nx[mm];y[mm];z[mm];Bx[mT]\n0;0;1;100\n")
    assert any(line[:40] in said for said in found.remarks) == told


def test_units_and_variables_of_own_hdf5_are_not_ignored(tmp_path):
    """B in mT, or noise under another name, would be lost without a word."""
    path = tmp_path / "map.h5"
    data = field_map(POINTS, FIELD)
    write_map(data, path)
    assert read_map(path).sizes["point"] == 6
    for changed, asked in (
            (data.assign(B_T=data["B_T"].assign_attrs(units="mT")), "unit of `B_T`"),
            (data.assign_coords(x_m=data["x_m"].assign_attrs(units="mm")), "unit of `x_m`"),
            (data.assign(sigma=("point", np.full(6, 1e-5))), "`sigma_T`")):
        assert isinstance(changed, xr.Dataset)
        changed.to_netcdf(path, engine="h5netcdf")
        with pytest.raises(MeasurementError, match=asked):
            read_map(path)


def test_a_header_with_norm_is_used(tmp_path):
    """COMSOL calls |B| mf.normB: the header is no line of which nothing was used."""
    head = ("% Model: a.mph\n% Dimension: 3\n% Length unit: mm\n"
            "% x  y  z  mf.Bx (mT)  mf.normB (mT)\n")
    rows = "0 0 -10 731 731.1\n0 0 0 730 730.1\n0 0 10 731 731.1\n"
    assert not any("nothing" in said for said in imported(tmp_path, head + rows).remarks)
    said = imported(tmp_path, "% divided by a factor of 2\n" + head + rows).remarks
    assert any("factor of 2" in each for each in said)


@pytest.mark.parametrize("unit", ["C", "°C", "degC", "K"])
def test_a_temperature_is_no_time(tmp_path, unit):
    table = "x[mm],y[mm],z[mm],Bx[mT],By[mT],Bz[mT],T[{}]\n0,0,0,7,1,1,20\n0,0,10,7,1,1,25\n"
    stated, bare = (imported(tmp_path, text).remarks
                    for text in (table.format(unit), table.replace("[{}]", "")))
    assert not any("times" in said for said in stated)
    assert any("times" in said for said in bare)


def test_noise_of_one_component_alone_says_how_to_state_it(tmp_path):
    table = "x[mm],y[mm],z[mm],Bx[mT],By[mT],{}\n0,0,0,7,1,0.1\n0,0,10,7,1,0.1\n"
    with pytest.raises(MeasurementError, match=r"By has none.*name one column sigma"):
        imported(tmp_path, table.format("std Bx (mT)"))
    columns = "x[mm],y[mm],z[mm],Bx[mT],By[mT],sigma[mT]"
    data = imported(tmp_path, table.format("std Bx (mT)"), columns=tuple(columns.split(","))).data
    np.testing.assert_allclose(data["sigma_T"], 1e-4)
