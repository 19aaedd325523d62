"""Maps are written for other programs, as those read them."""

from __future__ import annotations

import io
import re
import warnings

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from halbach_fe.core.errors import MeasurementError, OutputError
from halbach_fe.measurement.field_map import field_map, points_of, read_map
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.import_export import WRITERS, export_map, import_map
from tests.measurement.test_import_map import FIELD, POINTS

with warnings.catch_warnings():  # its plots use what matplotlib will drop
    warnings.simplefilter("ignore", PendingDeprecationWarning)
    from beamphysics import FieldMesh


@pytest.fixture
def shuffled(generator):
    """The same points in no order."""
    order = generator.permutation(len(POINTS))
    return field_map(POINTS[order], FIELD[order])


def ordered(data):
    order = np.lexsort(points_of(data).round(9).T[::-1])
    return points_of(data)[order], data["B_T"].values[order]


def agrees(data):
    """B exactly, positions but for the rounding of origin + i step."""
    points, field = ordered(data)
    return np.allclose(points, POINTS, rtol=1e-14, atol=1e-16) and np.array_equal(field, FIELD)


def exchanged(data):
    """A control: the same numbers with the grid's order of x and z exchanged."""
    field = FIELD.reshape(2, 3, 4, 3).transpose(2, 1, 0, 3).reshape(-1, 3)
    return data.assign(B_T=(("point", "component"), field))


@pytest.mark.parametrize("name", ["openpmd", "geant4", "csv"])
def test_what_is_exported_reads_back(tmp_path, shuffled, name):
    path = tmp_path / ("map.h5" if name == "openpmd" else f"map.{name}")
    export_map(shuffled, name, path)
    assert agrees(import_map(path, DeclaredFormat()).data)
    points, field = ordered(shuffled)
    export_map(exchanged(field_map(points, field)), name, path)
    assert not agrees(import_map(path, DeclaredFormat()).data)
    assert list(tmp_path.iterdir()) == [path]


def test_vtu_reads_back(tmp_path, shuffled):
    export_map(shuffled, "vtu", tmp_path / "map.vtu")
    assert agrees(read_map(tmp_path / "map.vtu"))


def mesh_of(path):
    """As openpmd-beamphysics reads it: axes, and B along x, y, z."""
    mesh = FieldMesh(str(path))
    assert (mesh.geometry, mesh.is_static, mesh.is_pure_magnetic) == ("rectangular", True, True)
    return mesh.coord_vecs, np.stack([mesh["Bx"], mesh["By"], mesh["Bz"]], axis=-1)


def test_openpmd_beamphysics_reads_our_mesh(tmp_path, shuffled):
    path = tmp_path / "map.h5"
    export_map(shuffled, "openpmd", path)
    axes, field = mesh_of(path)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(points, POINTS, rtol=1e-14, atol=1e-16)
    np.testing.assert_array_equal(field.reshape(-1, 3), FIELD)
    assert FieldMesh(str(path)).units("Bx").unitSymbol == "T"
    export_map(exchanged(field_map(*ordered(shuffled))), "openpmd", path)
    assert not np.allclose(mesh_of(path)[1].reshape(-1, 3), FIELD)


def mesh_file(path, labels=("x", "y", "z"), values=None, unit=1.0, attributes=None,
              components="xyz", component=None):
    """A mesh as openpmd-beamphysics writes it, with changes."""
    grid = FIELD.reshape(2, 3, 4, 3) if values is None else values
    data = {"attrs": {
        "eleAnchorPt": "center", "gridGeometry": "rectangular", "axisLabels": ("x", "y", "z"),
        "gridLowerBound": (0, 0, 0), "gridSize": (2, 3, 4), "gridSpacing": (0.02, 0.005, 0.1),
        "gridOriginOffset": (-0.01, 0.0, 0.1), "harmonic": 0, "fundamentalFrequency": 0.0},
        "components": {f"magneticField/{name}": grid[..., index] / unit
                       for index, name in enumerate("xyz") if name in components}}
    mesh = FieldMesh(data=data)
    mesh.write(str(path))
    with h5py.File(path, "r+") as file:
        group = file[next(iter(file["ExternalFieldPath"].values())).name]
        for name in components:
            node = group[f"magneticField/{name}"]
            if labels == ("z", "y", "x"):
                turned = node[()].T
                kept = dict(node.attrs)
                del group[f"magneticField/{name}"]
                node = group.create_dataset(f"magneticField/{name}", data=turned)
                node.attrs.update(kept)
            node.attrs["unitSI"] = unit
            node.attrs.update(component or {})
        group.attrs["axisLabels"] = np.array(labels, "S")
        for key, value in (attributes or {}).items():
            if value is None:
                del group.attrs[key]
            else:
                group.attrs[key] = value
    return path


def imported(path, **declared):
    return import_map(path, DeclaredFormat(**declared)).data


def test_meshes_of_openpmd_beamphysics_are_read(tmp_path):
    path = tmp_path / "mesh.h5"
    assert agrees(imported(mesh_file(path)))
    assert agrees(imported(mesh_file(path, labels=("z", "y", "x"))))
    turned = mesh_file(path, values=np.ascontiguousarray(
        FIELD.reshape(2, 3, 4, 3)[:, :, ::-1]))
    assert not agrees(imported(turned))
    lower = {"gridLowerBound": (0, -2, 1), "gridOriginOffset": (-0.01, 0.01, 0.0)}
    assert agrees(imported(mesh_file(path, attributes=lower)))
    assert not agrees(imported(mesh_file(path, attributes={"gridLowerBound": (0, -2, 1)})))
    scaled = imported(mesh_file(path, attributes={"fieldScale": -2.0}))
    np.testing.assert_allclose(ordered(scaled)[1], -2 * FIELD, rtol=1e-15)
    gauss = imported(mesh_file(path, unit=1e-4))
    np.testing.assert_allclose(ordered(gauss)[1], FIELD, rtol=1e-15)
    without = imported(mesh_file(path, components="xz"))
    np.testing.assert_array_equal(ordered(without)[1], FIELD * [1, 0, 1])
    constant = FIELD.reshape(2, 3, 4, 3).copy()
    constant[..., 1] = 0.25  # a group with value and shape
    np.testing.assert_array_equal(ordered(imported(mesh_file(path, values=constant)))[1],
                                  np.where([False, True, False], 0.25, FIELD))
    legacy = mesh_file(path, labels=("z", "y", "x"), component={"gridDataOrder": np.bytes_("F")},
                       attributes={"axisLabels": np.array(["x", "y", "z"], "S")})
    assert agrees(imported(legacy))


@pytest.mark.parametrize("angles", [1, 4])
def test_cylindrical_meshes(tmp_path, angles):
    """Positions r, theta, z and components along them; with a single angle, as the file has it."""
    path = tmp_path / "mesh.h5"
    radius, angle, z = [0.01, 0.02], 0.5 + np.arange(angles) * np.pi / 2, [0.1, 0.2, 0.3]
    r, a, height = (one.ravel() for one in np.meshgrid(radius, angle, z, indexing="ij"))
    points = np.column_stack([r * np.cos(a), r * np.sin(a), height])
    field = np.column_stack([0.1 + 2 * points[:, 1], 2 * points[:, 0], 0 * r])
    turned = np.column_stack([field[:, 0] * np.cos(a) + field[:, 1] * np.sin(a),
                              field[:, 1] * np.cos(a) - field[:, 0] * np.sin(a), field[:, 2]])
    with h5py.File(path, "w") as file:
        file.attrs["externalFieldPath"] = np.bytes_("/mesh/%T/")
        group = file.create_group("/mesh/01")
        group.attrs.update({
            "gridGeometry": np.bytes_("cylindrical"), "eleAnchorPt": np.bytes_("center"),
            "axisLabels": np.array(["r", "theta", "z"], "S"), "gridSize": (2, angles, 3),
            "gridSpacing": (0.01, np.pi / 2, 0.1), "gridOriginOffset": (0.01, 0.5, 0.1),
            "gridLowerBound": (0, 0, 0), "harmonic": 0})
        for column, name in enumerate(("r", "theta", "z")):
            node = group.create_dataset(f"magneticField/{name}",
                                        data=turned[:, column].reshape(2, angles, 3))
            node.attrs.update({"unitSI": 1.0, "unitDimension": (0, 1, -2, -1, 0, 0, 0)})
    found = import_map(path, DeclaredFormat())
    np.testing.assert_allclose(points_of(found.data), points, atol=1e-15)
    np.testing.assert_allclose(found.data["B_T"], field, atol=1e-15)
    assert any("rotational symmetry" in said for said in found.remarks) == (angles == 1)


@pytest.mark.parametrize(("changes", "asked"), [
    ({"attributes": {"harmonic": 1}}, "a static field"),
    ({"attributes": {"RFphase": 0.5}}, "`RFphase`"),
    ({"attributes": {"gridGeometry": np.bytes_("spherical")}}, "must be rectangular or"),
    ({"attributes": {"gridGeometry": np.bytes_("cylindrical")}}, "r, theta and z"),
    ({"attributes": {"gridCurvatureRadius": 2.0}}, "a straight grid"),
    ({"attributes": {"gridSpacing": None}}, "`gridSpacing`"),
    ({"attributes": {"gridSize": (3, 2, 4)}}, "shape of magneticField/x"),
    ({"attributes": {"gridSize": (10**6, 10**6, 10**6)}}, "10000000 points"),
    ({"attributes": {"gridSpacing": (0.02, np.nan, 0.1)}}, "three finite numbers"),
    ({"attributes": {"axisLabels": np.array(["z", "y", "x"], "S")}}, "gridSize along z, y, x"),
    ({"attributes": {"axisLabels": np.array(["r", "y", "x"], "S")}}, "`axisLabels`"),
    ({"attributes": {"eleAnchorPt": np.bytes_("beginning")}}, "--origin-m=X,Y,Z"),
    ({"values": FIELD.reshape(2, 3, 4, 3) * (1 + 0.1j)}, "complex numbers"),
    ({"component": {"unitDimension": (1.0, 1, -3, -1, 0, 0, 0)}}, "flux density"),
    ({"values": 100 * FIELD.reshape(2, 3, 4, 3)}, "below 10 T")])
def test_other_meshes_are_refused(tmp_path, changes, asked):
    path = mesh_file(tmp_path / "mesh.h5", **{"components": "xyz"} | changes)
    with pytest.raises(MeasurementError, match="mesh") as caught:
        imported(path)
    assert asked in str(caught.value)


def test_an_anchor_that_is_not_the_centre(tmp_path):
    path = mesh_file(tmp_path / "mesh.h5", attributes={
        "eleAnchorPt": np.bytes_("beginning"), "gridOriginOffset": (-0.01, 0.0, 0.6)})
    assert agrees(imported(path, origin_m=(0.0, 0.0, -0.5)))
    with pytest.raises(MeasurementError, match="m in the file and --length-unit mm"):
        imported(path, origin_m=(0.0, 0.0, -0.5), length_unit="mm")


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_meshes_are_refused_or_read(tmp_path, data):
    path = tmp_path / "mesh.h5"
    export_map(field_map(POINTS, FIELD), "openpmd", path)
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        raw[data.draw(st.integers(8, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw[:data.draw(st.sampled_from([len(raw), len(raw), 500, 2000]))])
    try:
        assert imported(path).sizes["point"] > 0
    except MeasurementError as error:
        assert "mesh.h5" in str(error)


def bdsim_loader(text):
    """What BDSIM's loader makes of a file, by its source: keys, the columns of the ! line, and
    values by their order alone; its arrays are [x][y][z].
    """
    keys, lines = {}, iter(text.splitlines())
    order = "xyzt"
    for line in lines:
        if found := re.search(r"(\w*)\s*>\s*([0-9eE.+-]+)", line):
            keys[found[1].lower()] = float(found[2])
        elif found := re.search(r"(\w+)\s*>\s*([a-zA-Z]{1,4})\b\s*", line):
            order = found[2]
        elif line.startswith("!"):
            names = line[1:].split()
            break
    size = [int(keys[f"n{axis}"]) for axis in "xyz"]
    rows = np.array([[float(cell) for cell in line.split()] for line in lines])
    field = rows[:, [names.index(name) for name in ("Fx", "Fy", "Fz")]]
    field = (field.reshape(*size, 3) if order == "tzyx" else
             field.reshape(*size[::-1], 3).transpose(2, 1, 0, 3))
    axes = [np.linspace(0.01 * keys[f"{a}min"], 0.01 * keys[f"{a}max"], n)
            for a, n in zip("xyz", size, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return points, field.reshape(-1, 3), rows


def test_bdsim_reads_our_map(tmp_path, shuffled):
    path = tmp_path / "map.dat"
    export_map(shuffled, "bdsim", path)
    points, field, rows = bdsim_loader(path.read_text())
    np.testing.assert_allclose(points, POINTS, atol=1e-15)
    np.testing.assert_array_equal(field, FIELD)
    np.testing.assert_allclose(np.unique(rows[:, 2]), [10, 20, 30, 40])  # cm
    assert rows[1, 0] > rows[0, 0]  # x changes fastest
    for old, new in (("loopOrder> xyzt", "loopOrder> tzyx"), ("Fx Fy", "Fy Fx")):
        assert not np.allclose(bdsim_loader(path.read_text().replace(old, new))[1], FIELD)
    assert not re.search(r"^\s|\s>", path.read_text(), re.M)  # no blanks before or in keys


def geant4_reader(text):
    """What PurgMagTabulatedField3D makes of a file: lengths in m, arrays [x][y][z]."""
    stream = io.StringIO(text)
    assert stream.readline() == "\n"
    rest = stream.readline()
    buffer = ["?"] * 256  # as getline fills it
    nx, ny, nz = (int(word) for word in rest.split()[:3])
    line = re.sub(r"^\s*\d+\s+\d+\s+\d+", "", rest).rstrip("\n")
    while True:
        assert len(line) < 255
        buffer[:len(line) + 1] = [*line, "\0"]
        if buffer[1] == "0":
            break
        line = stream.readline().rstrip("\n")
    values = np.array(stream.read().split(), float).reshape(-1, 7)
    assert len(values) == nx * ny * nz
    low, high = values[0, :3], values[-1, :3]
    axes = [np.linspace(*limits) for limits in zip(low, high, (nx, ny, nz), strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), values[:, 3:6]


def test_geant4_reads_our_map(tmp_path, shuffled):
    path = tmp_path / "map.TABLE"
    export_map(shuffled, "geant4", path)
    points, field = geant4_reader(path.read_text())
    np.testing.assert_allclose(points, POINTS, atol=1e-15)
    np.testing.assert_array_equal(field, FIELD)
    export_map(exchanged(field_map(*ordered(shuffled))), "geant4", path)
    assert not np.allclose(geant4_reader(path.read_text())[1], FIELD)


CIRCLE = np.column_stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4),
                          np.arange(8)]) / 10


@pytest.mark.parametrize(("points", "asked"), [
    (CIRCLE, "Input x of the points of map"), (CIRCLE * [0, 0, 1], "0 m alone"),
    (POINTS[1:], "2 x 3 x 4 = 24 points, each once; instead received 23"),
    (POINTS + np.where(np.arange(24) == 5, 1.1e-3, 0)[:, None] * [0, 0.005, 0], "y of the points"),
    (np.vstack([POINTS[:-1], POINTS[:1] + 1e-9]), "some twice and others never"),
    (POINTS * [1, 1, 0] + [0, 0, 1] * POINTS ** 2, "z of the points")])
@pytest.mark.parametrize("name", ["openpmd", "bdsim", "geant4"])
def test_points_that_are_no_grid_are_refused(tmp_path, points, asked, name):
    data = field_map(points, np.ones((len(points), 3)))
    with pytest.raises(MeasurementError) as caught:
        export_map(data, name, tmp_path / ("map.h5" if name == "openpmd" else "map.txt"))
    assert asked in str(caught.value)
    assert 'kind = "grid"' in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_rounded_coordinates_make_a_grid(tmp_path):
    """Off by 0.9e-3 of a step; beyond 1e-3 they are refused, above."""
    rounded = POINTS + np.where(np.arange(24) == 5, 0.9e-3, 0)[:, None] * [0, 0.005, 0]
    export_map(field_map(rounded, FIELD), "geant4", tmp_path / "map.TABLE")
    points, field = ordered(import_map(tmp_path / "map.TABLE", DeclaredFormat()).data)
    np.testing.assert_allclose(points, POINTS, atol=1e-15)
    np.testing.assert_array_equal(field, FIELD)


def test_missing_components_and_suffixes(tmp_path):
    data = field_map(POINTS, np.where(np.arange(72).reshape(24, 3) == 7, np.nan, FIELD))
    for name in WRITERS[:3]:
        with pytest.raises(MeasurementError, match="none of By in reading 3"):
            export_map(data, name, tmp_path / ("map.h5" if name == "openpmd" else "map.txt"))
    export_map(data, "csv", tmp_path / "map.csv")
    for name in ("csv", "openpmd"):
        with pytest.raises(OutputError, match="suffix"):
            export_map(data, name, tmp_path / "map.vtu")
    with pytest.raises(OutputError, match="Cannot write"):
        export_map(field_map(POINTS, FIELD), "bdsim", tmp_path / "map.csv" / "map.dat")
