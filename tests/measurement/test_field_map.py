"""Maps survive their files, and files that are no maps are refused by name."""

from __future__ import annotations

import meshio
import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from halbach_fe.api import export
from halbach_fe.core.errors import HalbachWarning, MeasurementError, OutputError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.registration import register
from halbach_fe.measurement.campaign_maps import maps_of
from halbach_fe.measurement.field_map import (
    check_magnitudes,
    checked_map,
    field_map,
    points_of,
    read_map,
    write_map,
)
from halbach_fe.measurement.map_check import check_map
from halbach_fe.solver.session import Session

HEADER = "x_m,y_m,z_m,Bx_T,By_T,Bz_T\n"
finite = st.floats(-9, 9, allow_nan=False)


@pytest.mark.parametrize("suffix", [".csv", ".h5"])
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(finite, finite, finite), min_size=1, max_size=5, unique=True),
       st.randoms(use_true_random=False))
def test_round_trip_is_exact(tmp_path, suffix, points, random):
    points = np.array(points)
    if len(np.unique(points, axis=0)) < len(points):  # 0.0 and -0.0
        return
    values = np.array([[random.uniform(-1, 1) for _ in range(3)] for _ in points])
    values[0, random.randrange(3)] = np.nan
    data = field_map(points, values, np.full_like(values, 1e-4), {"coil": "A 7", "note": "x: y"})
    data["time_s"] = ("point", np.arange(len(points), dtype=float))
    data["scan"] = ("point", [f"s{i}" for i in range(len(points))])
    write_map(data, tmp_path / f"map{suffix}")
    again = read_map(tmp_path / f"map{suffix}")
    for name in ("B_T", "x_m", "y_m", "z_m", "sigma_T", "time_s", "scan"):
        np.testing.assert_array_equal(again[name].values, data[name].values)
    assert again.attrs == data.attrs


def test_vtu_reads_back(tmp_path):
    data = field_map(np.eye(3), np.arange(9.0).reshape(3, 3))
    write_map(data, tmp_path / "map.vtu")
    mesh = meshio.read(tmp_path / "map.vtu")
    np.testing.assert_allclose(mesh.points, np.eye(3))
    np.testing.assert_allclose(mesh.point_data["B_T"], data["B_T"].values)
    data["B_T"].values[1, 1] = np.nan
    data["sigma_T"] = (("point", "component"), np.full((3, 3), 1e-4))
    write_map(data, tmp_path / "map.vtu")
    again = read_map(tmp_path / "map.vtu")
    for name in ("B_T", "sigma_T", "x_m", "y_m", "z_m"):
        np.testing.assert_array_equal(again[name].values, data[name].values)
    (tmp_path / "map.vtu").write_text("<VTKFile")
    with pytest.raises(MeasurementError, match="VTU"):
        read_map(tmp_path / "map.vtu")


def test_columns_in_any_order_and_missing_components(tmp_path):
    path = tmp_path / "map.csv"
    path.write_text("# probe: 3D Hall\nBz_T,z_m,x_m,y_m,Bx_T,sigma_Bz_T,sigma_Bx_T\n"
                    "0.1,3,1,2,,1e-4,\n0.2,3,1,4,0.5,1e-4,2e-4\n", encoding="utf-8")
    data = read_map(path)
    np.testing.assert_array_equal(points_of(data), [[1, 2, 3], [1, 4, 3]])
    np.testing.assert_array_equal(data["B_T"].values, [[np.nan, np.nan, 0.1], [0.5, np.nan, 0.2]])
    np.testing.assert_array_equal(data["sigma_T"].values[1], [2e-4, np.nan, 1e-4])
    assert data.attrs["probe"] == "3D Hall"


@pytest.mark.parametrize(("text", "said"), [
    ("", "an empty file"),
    ("# only: comments\n", "only comments"),
    (HEADER, "a header alone"),
    ("x_m,y_m,Bx_T\n0,0,1\n", "complete with z_m"),
    ("x_m,y_m,z_m\n0,0,0\n", "at least one of Bx_T"),
    ("x_mm,y_m,z_m,Bx_T\n0,0,0,1\n", "column 'x_mm'"),
    ("x_m,y_m,z_m,Bx_T,Bx_T\n0,0,0,1,1\n", "repeated"),
    ("x_m,y_m,z_m,Bx_T,sigma_T,sigma_Bx_T\n0,0,0,1,1,1\n", "not both"),
    (HEADER + "0,0,0,1,1\n", "cut short"),
    (HEADER + "0,0,0,inf,1,1\n", "Bx_T in line 2"),
    (HEADER + "0,0,inf,1,1,1\n", "z_m in line 2"),
    (HEADER + "0,0,,1,1,1\n", "z_m in line 2"),
    (HEADER + "0,0,0,one,1,1\n", "'one'"),
    (HEADER + "0,0,0,,,\n0,0,1,nan,,\n", "at least one reading; instead received 2 rows without"),
    (HEADER + "0,0,0,.1,.1,.1\n0,0,1,.1,.1,.1\n0,0,0,.1,.1,.1\n", "reading 3"),
    ("x_m,y_m,z_m,Bx_T,sigma_T\n0,0,0,1,0\n", "sigma"),
    ("x_m,y_m,z_m,Bx_T,sigma_T\n0,0,0,1,-1\n", "sigma"),
    (HEADER + "0,0,0,1,1," + "1" * 200_000 + "\n", "line 2"),
])
def test_bad_csv_is_refused_by_name(tmp_path, text, said):
    path = tmp_path / "map.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MeasurementError) as caught:
        read_map(path)
    assert said in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("blank", [("", "", ""), ("nan", "NaN", "")])
@pytest.mark.parametrize("suffix", [".csv", ".h5", "in Python"])
def test_rows_that_the_mapper_missed_are_left_out_and_counted(tmp_path, blank, suffix):
    """Rows with a component stay, whichever is missing; a map without such rows says nothing."""
    cells = [("0.1", "0.2", "0.3"), blank, ("0.1", blank[0], "0.3"), blank]
    (tmp_path / "map.csv").write_text("# probe: 3\n" + HEADER[:-1] + ",time_s\n" + "".join(
        f"0,0,{number},{','.join(row)},{number}\n" for number, row in enumerate(cells)))
    whole = np.array([[float(cell or "nan") for cell in row] for row in cells])
    data = field_map([[0, 0, z] for z in range(4)], whole, attributes={"probe": "3"})
    data["time_s"] = "point", np.arange(4.0)
    write_map(data, tmp_path / "map.h5")
    with pytest.warns(HalbachWarning, match="Left out: 2 of 4 rows of map .*; the first is row 2"):
        found = checked_map(data, "`data`") if suffix == "in Python" else (
            read_map(tmp_path / f"map{suffix}"))
    np.testing.assert_array_equal(found["B_T"].values, whole[[0, 2]])
    np.testing.assert_array_equal(found["time_s"].values, [0, 2])
    np.testing.assert_array_equal(found["z_m"].values, [0, 2])
    assert found.attrs == {"probe": "3"}
    assert suffix == "in Python" or found.encoding["source"].endswith(suffix)
    assert checked_map(found, "`data`").sizes["point"] == 2


def test_repeated_readings_need_a_time_or_scan(tmp_path):
    path = tmp_path / "map.csv"
    path.write_text("x_m,y_m,z_m,Bx_T,time_s\n0,0,0,1,1\n0,0,0,1,2\n", encoding="utf-8")
    assert read_map(path).sizes["point"] == 2


@pytest.mark.parametrize("damage", ["missing", "binary", "truncated", "other", "infinite"])
def test_bad_files_are_refused(tmp_path, damage):
    path = tmp_path / "map.h5"
    write_map(field_map(np.eye(3), np.ones((3, 3))), path)
    if damage == "missing":
        path = tmp_path / "none.h5"
    elif damage == "binary":
        path = tmp_path / "map.csv"
        path.write_bytes(bytes(range(256)))
    elif damage == "truncated":
        path.write_bytes(path.read_bytes()[:-500])
    elif damage == "other":
        xr.Dataset({"a": ("b", [1.0])}).to_netcdf(path, engine="h5netcdf")
    else:
        write_map(field_map(np.eye(3), np.full((3, 3), np.inf)), path)
    with pytest.raises(MeasurementError, match=path.name):
        read_map(path)


@pytest.mark.parametrize(("name", "value", "said"), [
    ("B_T", (("point", "component"), np.full((3, 3), "a")), "`B_T`"),
    ("time_s", ("point", np.array(["2026-01-01"] * 3, "datetime64[s]")), "`time_s`"),
    ("x_m", ((), 1.0), "`x_m`"),
    ("sigma_T", (("point", "other"), np.ones((3, 2))), "`sigma_T`"),
])
def test_hdf5_of_another_make_is_refused(tmp_path, name, value, said):
    data = field_map(np.eye(3), np.ones((3, 3))).drop_vars([name], errors="ignore")
    data[name] = value
    data.to_netcdf(tmp_path / "map.h5", engine="h5netcdf")
    with pytest.raises(MeasurementError, match=said):
        read_map(tmp_path / "map.h5")


def test_hdf5_sigma_for_all_components_at_once(tmp_path):
    data = field_map(np.eye(3), np.ones((3, 3)))
    data["sigma_T"] = ("point", [1e-4, 2e-4, 3e-4])
    data.to_netcdf(tmp_path / "map.h5", engine="h5netcdf")
    assert read_map(tmp_path / "map.h5")["sigma_T"].values[:, 2].tolist() == [1e-4, 2e-4, 3e-4]


@pytest.mark.parametrize("name", ["sigma_T", "sigma_By_T"])
def test_noise_that_is_none_is_named_by_its_row(name, tmp_path):
    path = tmp_path / "map.csv"
    path.write_text(f"x_m,y_m,z_m,By_T,{name}\n0,0,0,0.5,1e-4\n0,0,0.1,0.4,-2e-4\n")
    with pytest.raises(MeasurementError, match=r"sigma of reading 2 of .*received -0\.0002\. "
                                               r"Correct it, or remove"):
        read_map(path)
    path.write_text("x_m,y_m,z_m,By_T\n0,0,0,0.5\n0,0,0.1,0.4\n")  # what is advised
    assert "sigma_T" not in read_map(path)


def test_hdf5_without_readings_is_refused(tmp_path):
    field_map(np.zeros((0, 3)), np.zeros((0, 3))).to_netcdf(tmp_path / "map.h5",
                                                            engine="h5netcdf")
    with pytest.raises(MeasurementError, match="at least one reading"):
        read_map(tmp_path / "map.h5")


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "map.csv"
    write_map(field_map(np.eye(3), np.ones((3, 3))), path)
    before = path.read_bytes()

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("halbach_fe.measurement.text_tables._cell", full)
    with pytest.raises(OutputError, match="No space left"):
        write_map(field_map(np.eye(3), np.zeros((3, 3))), path)
    assert path.read_bytes() == before
    assert {one.name for one in tmp_path.iterdir()} == {path.name, ".hf.write_map"}


def test_single_rows_that_are_no_readings():
    """9999 in one row of many is no matter of the unit of all of them."""
    points = 1e-3 * np.arange(120.0).reshape(40, 3)
    field = 0.1 + points
    field[7, 1] = 9999.0
    with pytest.raises(MeasurementError, match=r"reading 8 .*1 of 40 rows"):
        check_magnitudes(field_map(points, field))
    field[3, 0] = 35.0  # the row is that of the number that is told
    with pytest.raises(MeasurementError, match=r"reading 8 .* 9999, .*2 of 40 rows"):
        check_magnitudes(field_map(points, field))
    with pytest.raises(MeasurementError, match="Are they in gauss"):
        check_magnitudes(field_map(points, 1e4 * (0.1 + points)))
    tail = 300 * np.exp(-(np.arange(40.0) / 1.5)**2)  # in mT, of a short magnet
    with pytest.raises(MeasurementError, match=r"reading 1 .* all of the map in millitesla"):
        check_magnitudes(field_map(points, np.tile(tail[:, None], 3)))




def test_unknown_suffix_and_unwritable_folder(tmp_path):
    data = field_map(np.eye(3), np.ones((3, 3)))
    with pytest.raises(OutputError, match="suffix"):
        write_map(data, tmp_path / "map.xls")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="Cannot write"):
        write_map(data, tmp_path / "file" / "map.csv")


def made(**variables):
    """A map of three points, as a user makes it in Python."""
    data = field_map(np.arange(9.0).reshape(3, 3) / 100, np.full((3, 3), 0.1))
    return data.assign(variables)


@pytest.mark.parametrize(("data", "said"), [
    (None, "must be a Dataset; instead received a NoneType"),
    ("map.csv", "must be a Dataset; instead received a str"),
    ([made()], "must be a Dataset; instead received a list"),
    (made().transpose(), "data.transpose"),
    (made().sel(component=["z", "y", "x"]), "components z, y, x"),
    (made().sel(component=["x"]), "components x"),
    (made().sel(component="x"), "components x\\. .* choose one by a list"),
    (made().drop_vars("component"), "components unnamed"),
    (made().drop_vars("x_m"), "`x_m`"),
    (made().isel(point=slice(0)), "at least one reading"),
    (made().assign_coords(x_m=("point", [0.0, np.nan, 0.02])), "reading 2 .* finite numbers"),
    (made(B_T=(("point", "component"), np.full((3, 3), "much"))), "numbers labelled"),
    (made(sigma_T=(("other",), [1e-4, 1e-4])), "`sigma_T` .* labelled"),
    (made(sigma_T=(("point", "component"), np.full((3, 3), -1e-4))), "sigma .* positive"),
    (made(time_s=("point", [0.0, np.nan, 1.0])), "`time_s`")])
def test_maps_that_are_made_in_python(dipole, data, said):
    study = dipole()
    for use in (lambda: maps_of(study, data), lambda: check_map(data),
                lambda: register(build_magnet(study), data, Session.counting(1))):
        with pytest.raises(MeasurementError, match=said):
            use()
    if data is not None:
        with pytest.raises(MeasurementError, match=said):
            maps_of(study, made(), data)
    listed = dipole(maps=[{"name": "a", "file": "a.csv"}])
    with pytest.raises(MeasurementError, match=said):
        maps_of(listed, {"a": data})


@pytest.mark.parametrize("changed", [
    made().transpose(), made().sel(component=["z", "y", "x"]), made().sel(component="x"),
    made().drop_vars("x_m"), made().rename(B_T="B_mT"),
    made().assign_coords(x_m=("point", [0.0, 10.0, 20.0], {"units": "mm"}))])
def test_maps_that_were_changed_are_not_written_under_wrong_names(tmp_path, changed):
    written = tmp_path / "map.csv"
    for write in (lambda: write_map(changed, written), lambda: export(changed, written),
                  lambda: export(changed, tmp_path / "map.table", "geant4")):
        with pytest.raises(MeasurementError, match="map must be"):
            write()
    assert not list(tmp_path.iterdir())


def test_what_a_refused_map_is_advised_can_be_done(tmp_path):
    data, wanted = made(B_T=(("point", "component"), np.arange(9.0).reshape(3, 3))), ["x", "y", "z"]
    for changed in (data.transpose(), data.sel(component=["z", "y", "x"]), data):
        arranged = changed.transpose("point", "component").reindex(component=wanted)
        export(arranged, tmp_path / "map.csv")
        assert np.array_equal(read_map(tmp_path / "map.csv")["B_T"], data["B_T"])
    one = data.sel(component=["x"]).transpose("point", "component").reindex(component=wanted)
    export(one, tmp_path / "map.csv")
    np.testing.assert_array_equal(read_map(tmp_path / "map.csv")["B_T"],
                                  data["B_T"].where(data["component"] == "x"))


def test_sigma_of_one_number_holds_for_all_components():
    assert checked_map(made(sigma_T=1e-4), "a")["sigma_T"].dims == ("point", "component")
    assert checked_map(made(), "a").identical(made())


def test_arguments_in_another_order(tmp_path):
    data = field_map([[0, 0, 0], [0, 0, 0.01]], [[0, 0.1, 0], [0, 0.2, 0]])
    write_map(data, tmp_path / "map.csv")
    with pytest.raises(MeasurementError, match="data of write_map must be a Dataset; instead"):
        write_map(tmp_path / "map.csv", data)
    with pytest.raises(MeasurementError, match="must be arrays of numbers"):
        field_map("map.csv", data)


def test_placeholders_and_copies(tmp_path):
    """9999 is no field in gauss, and copies are no readings, whatever times are given to them."""
    points = np.column_stack([np.zeros(21), np.zeros(21), 0.001 * np.arange(21)])
    field = np.random.default_rng(1).normal(0.1, 0.01, (21, 3))
    field[::7, 0] = 9999
    with pytest.raises(MeasurementError, match=r"placeholder, one of 3 of 21 .* leave the cell"):
        check_magnitudes(field_map(points, field))
    field[::7, 0] = 3210.0
    with pytest.raises(MeasurementError, match="Are they in gauss"):
        check_magnitudes(field_map(points, field))
    field[::7, 0] = 0.1
    write_map(field_map(np.tile(points, (2, 1)), np.tile(field, (2, 1))), tmp_path / "map.csv")
    with pytest.raises(MeasurementError, match=r"Remove them: what is read again differs") as said:
        read_map(tmp_path / "map.csv")
    assert "time_s" not in str(said.value)


def test_tables_in_another_order_are_refused():
    """Positions and readings of rows that were sorted apart were paired by their places."""
    pandas = pytest.importorskip("pandas")
    points = pandas.DataFrame([[0.0, 0.0, 0.2], [0.0, 0.0, 0.1]], columns=["x_m", "y_m", "z_m"])
    field = pandas.DataFrame([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]], columns=["Bx_T", "By_T", "Bz_T"])
    with pytest.raises(MeasurementError, match=r"same order.*to_numpy"):
        field_map(points.sort_values("z_m"), field)
    sigma = pandas.Series([1e-3, 2e-3])
    with pytest.raises(MeasurementError, match=r"sigma_T.*same order"):
        field_map(points, field, sigma.sort_values(ascending=False))
    assert field_map(points, field, sigma)["sigma_T"][1, 0] == 2e-3
    labelled = field.rename_axis("index").rename_axis("component", axis=1).stack().to_xarray()
    with pytest.raises(MeasurementError, match="same order"):
        field_map(points, labelled.isel(index=[1, 0]))
    np.testing.assert_allclose(field_map(points, labelled)["B_T"][:, 0], [1.0, 2.0])
    for places in (points, points.set_index(pandas.Index(["a", "b"])),
                   points.sort_values("z_m").to_numpy()[::-1]):
        np.testing.assert_allclose(field_map(places, field)["B_T"][:, 0], [1.0, 2.0])
