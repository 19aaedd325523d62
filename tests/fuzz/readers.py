"""All readers of files, each with what it reads."""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import h5py
import meshio
import numpy as np
import xarray as xr

from halbach_fe.core import untrusted_files
from halbach_fe.core.errors import (
    GetDPError,
    HalbachWarning,
    MeasurementError,
    MeshError,
    OutputError,
    StudyError,
)
from halbach_fe.geometry.domain import Regions
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference import mcmc, posterior_files
from halbach_fe.inference.mcmc import _Run
from halbach_fe.inference.posterior_files import _stored_root, read_posterior
from halbach_fe.measurement.block_table import BlockTable, read_blocks, read_order, write_blocks
from halbach_fe.measurement.field_map import checked_readings, field_map, read_map, write_map
from halbach_fe.measurement.formats.block_tables import DeclaredBlocks, import_blocks
from halbach_fe.measurement.formats.declared_format import DeclaredFormat
from halbach_fe.measurement.formats.grid_formats import grid_of
from halbach_fe.measurement.formats.import_export import READERS as FORMATS
from halbach_fe.measurement.formats.import_export import import_map
from halbach_fe.measurement.formats.openpmd import content as openpmd_content
from halbach_fe.measurement.map_join import MapPose, read_joined
from halbach_fe.report.joint_report import read_campaign
from halbach_fe.response import response_matrix as matrix_module
from halbach_fe.response.response_matrix import Response, StoredMatrix, _beside
from halbach_fe.response.response_matrix import _read as read_response
from halbach_fe.response.response_matrix import _write as write_response
from halbach_fe.solver.getdp import GetDP, Job, _check_log, find_getdp, read_vectors
from halbach_fe.solver.getdp_cache import MANIFEST, Cache, Kept, Manifest
from halbach_fe.solver.getdp_files import read_matrix, read_saved, read_solutions, read_unknowns
from halbach_fe.solver.mesh import MeshFiles, build_mesh, verify_mesh
from halbach_fe.solver.routes import finite_element_part
from halbach_fe.solver.session import Session, newton_residuals
from halbach_fe.stats.gaussian import CovarianceFactor, Gaussian, nominal_prior
from halbach_fe.study.free_blocks import COLUMNS as FREE_COLUMNS
from halbach_fe.study.free_blocks import (
    FreeBlocks,
    free_blocks_of_file,
    read_free_blocks,
    write_free_blocks,
)
from halbach_fe.study.model import Study, curve_of
from halbach_fe.study.reader import _with_table, parse_study, read_study
from halbach_fe.study.writer import edited_text
from tests.conftest import DIPOLE, ROOT, changed, circle
from tests.fuzz.contract import Reader
from tests.fuzz.documents import FREE, RICH, document
from tests.measurement.foreign_files import fluka, srw
from tests.measurement.test_import_map import (
    COMSOL,
    FIELD,
    MM_MT,
    OPERA,
    POINTS,
    SPREADSHEET,
    comsol_grid,
    comsol_sections,
    rows,
)
from tests.solver.test_getdp_files import ROWS, SOLUTIONS, matrix, saved, vectors
from tests.support.results import results

TINY = parse_study(changed(
    DIPOLE, array__blocks_per_ring=4, mesh__block_size_m=0.18, mesh__growth=4.0,
    open_boundary={"radius_m": 0.3}))
PLACES = circle(0.05, 3)

STEEL = b"""# made up
H_A_per_m,B_T
100.0,0.1
160.0,0.25
382.0,1.0
758.0,1.3
1837.0,1.5
"""
WITH_STEEL = """
name = "with-steel"
dimension = 2
array = { blocks_per_ring = 8, inner_radius_m = 0.1, outer_radius_m = 0.18, remanence_T = 1.0, \
block = { shape = "sector" } }
iron_ring = { inner_radius_m = 0.19, outer_radius_m = 0.21, curve = { kind = "table", \
file = "steel.csv" } }
mesh = { block_size_m = 0.02 }
observation = { quantity = "flux_density", positions = { kind = "points", points_m = [[0, 0, 0]] } }
"""

VTK = (b"# vtk DataFile Version 3.0\nof a magnet\nASCII\nDATASET STRUCTURED_POINTS\n"
       b"DIMENSIONS 2 2 1\nORIGIN 0 0 0\nSPACING 1 1 1\nPOINT_DATA 4\nVECTORS B double\n"
       + b"0.1 0 -0.2\n" * 4)
STL = b"solid a\n" + b"".join(
    b"facet normal 0 0 0\nouter loop\n" + b"".join(
        b"vertex %g %g %g\n" % corner for corner in corners) + b"endloop\nendfacet\n"
    for corners in (((0, 0, 0), (0, 50, 0), (50, 0, 0)), ((0, 0, 0), (50, 0, 0), (0, 0, 50)),
                    ((0, 0, 0), (0, 0, 50), (0, 50, 0)), ((50, 0, 0), (0, 50, 0), (0, 0, 50)))
) + b"endsolid a\n"
WITH_STL = WITH_STEEL.replace("with-steel", "with-stl").replace("dimension = 2", "").replace(
    "remanence_T", "ring_length_m = 0.1, remanence_T").replace(
    WITH_STEEL[WITH_STEEL.index("iron_ring"):WITH_STEEL.index("mesh =")],
    'iron = { relative_permeability = 9.0, bodies = [{ kind = "stl", file = "body.stl" }] }\n')

MAP_CSV = b"""# instrument: probe 7
x_m,y_m,z_m,Bx_T,By_T,Bz_T,sigma_T,time_s,scan
0.0,0.0,0.0,0.5,-0.01,,1e-4,0,first
0.01,0,0.25,0.52,,0.001,1e-4,1.5,"second, again"
-1e-2,.5,1.,+0.5,0,0,2E-4,2,first
"""
BLOCKS_CSV = b"""# coil: Helmholtz 3
serial,type,ring,slot,mx_A_m2,my_A_m2,mz_A_m2,sigma_A_m2,volume_m3,temperature_C
A-001,a,1,1,500.0,1.5,-2.25,0.5,5e-4,21.5
A-002,a,1,2,501.0,-1.5,2.0,0.5,,
A-003,"b, new",,,499.0,0,0,0.5,5e-4,20
"""
FREE_CSV = b"""# by hand
name,type,shape,ring,slot,x_m,y_m,z_m,rotation_z_deg,size_x_m,size_y_m,size_z_m,inner_radius_m,\
outer_radius_m,angle_deg,radius_m,sides,outline_m,material,remanence_T,remanence_x_T,remanence_y_T,\
remanence_z_T,recoil_permeability,magnetization_gradient
a,"new, coated",cuboid,1,1,0.1,0,0,45,0.01,.02,3e-2,,,,,,,N42,,,,,1.05,0.1
b,,sector,1,2,0,0.1,-0.0,,,,0.03,0.01,0.02,200,,,,,1.3,,,,,
c,,polygon,1,3,-1D-1,0,0,-720,,,0.03,,,,0.01,7,,,,0.1,-2,0,,
d,,prism,2,1,0,0,0.5,,,,0.03,,,,,,0 0; 0.01 0; 0 0.01,n42sh,1.1,,,,,
"""


def written(suffix: str, write, *args) -> bytes:
    """What a writer of ours makes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"made{suffix}"
        write(*args, path)
        return path.read_bytes()


def a_map(scans: bool = True) -> xr.Dataset:
    data = field_map(POINTS[:5], FIELD[:5], np.full((5, 3), 1e-4), {"instrument": "probe 7"})
    data["time_s"] = ("point", np.arange(5.0))
    if scans:
        data["scan"] = ("point", ["first", "first", "second", "second", "third"])
    return data


def compact_hdf5() -> bytes:
    """A map as others would write it: big-endian, single precision, compressed."""
    return written(".h5", lambda path: a_map().to_netcdf(path, engine="h5netcdf", encoding={
        "B_T": {"dtype": ">f4", "zlib": True, "shuffle": True, "chunksizes": (2, 3)}}))


def posterior() -> bytes:
    nominal = np.concatenate([block.magnetization[:2] for block in build_magnet(TINY).blocks])
    count = len(nominal)
    data = xr.Dataset(
        {name: ("parameter", nominal * factor) for name, factor in (
            ("nominal", 1), ("prior_mean", 1), ("prior_sd", 0.01), ("posterior_mean", 1.01),
            ("posterior_sd", 0.001))},
        coords={"parameter": [f"p{n}" for n in range(count)]},
        attrs={"study": TINY.model_dump_json()})
    prior = nominal_prior(nominal, 2, 0.01, 1.0, 0.005)
    size = prior.root.shape[1]
    after = Gaussian(nominal, CovarianceFactor(
        prior.root.outer, np.eye(size)[:, :3], np.array([0.1, 0.2, 1.0])))
    for name, one in (("prior", prior), ("posterior", after)):
        data.update(_stored_root(name, one, prior))
    return written(".h5", lambda path: data.to_netcdf(path, engine="h5netcdf"))


def a_response() -> bytes:
    built = Response(np.ones((3, 2)), ("r01s01.Mx", "r01s01.My"), np.ones(2), np.zeros(3),
                     np.zeros(3), 1e-9)
    return written(".h5", lambda path: write_response(path, "the key", built))


def unverified(module: ModuleType, read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """A reader that takes every checksum for right: who makes a hostile file can compute it."""
    def reading(path: Path) -> Any:
        with mock.patch.object(module, "read_hdf5", untrusted_files.read_dataset):
            return read(path)
    return reading


RESULTS_OF_TESTS = tempfile.TemporaryDirectory()
"""Where results are for as long as the tests run."""


@cache
def sound_results(name: str) -> Path:
    return results(Path(RESULTS_OF_TESTS.name) / name, "solve")


def in_results(path: Path) -> dict[str, object]:
    """Read a file in its place in a folder of results, beside a sound one."""
    folder = sound_results(path.name)  # so that whatever names the folder names the file
    (folder / path.name).write_bytes(path.read_bytes())
    return read_campaign([sound_results("sound"), folder]).plain()


def a_matrix() -> bytes:
    return written(".npy", lambda path: StoredMatrix.of([np.ones((3, 2))], (3, 2), path))


@cache
def without_matrix() -> bytes:
    """A response that names a matrix in a file of its own, by a checksum of zeros."""
    return written(".h5", lambda path: write_response(path, "the key", Response(
        StoredMatrix(_beside(path, "the key"), (3, 2), "0" * 64),
        ("r01s01.Mx", "r01s01.My"), np.ones(2), np.zeros(3), np.zeros(3), 1e-9)))


def with_matrix(path: Path) -> np.ndarray | None:
    """A response whose matrix is in a file of its own, of which it has the checksum."""
    with tempfile.TemporaryDirectory() as folder:
        main = Path(folder, "response.h5")
        beside = _beside(main, "the key")
        beside.write_bytes(path.read_bytes())
        main.write_bytes(without_matrix())
        with h5py.File(main, "r+") as file:
            file.attrs["matrix_sha256"] = hashlib.sha256(beside.read_bytes()).hexdigest()
        found = read_response(main, "the key")
        return None if found is None else found.whole


def check_matrix(found: np.ndarray | None) -> None:
    assert found is None or (found.shape == (3, 2) and found.dtype == float)


def chains() -> bytes:
    return written(".nc", lambda path: mcmc._store(
        path, "the key", [_Run(np.random.default_rng(n), np.zeros(2), np.ones((5, 2)), 0.3)
                          for n in range(2)], ("a", "b"), 7))


def resumed(path: Path) -> tuple[int, list[_Run], list[dict]]:
    """What of an interrupted run goes on, with the states that nothing had gone on from."""
    runs = [_Run(np.random.default_rng(n + 10), np.full(2, 9.0)) for n in range(2)]
    before = [run.generator.bit_generator.state for run in runs]
    return mcmc._resume(path, "the key", runs, 2), runs, before


def check_resumed(found: tuple[int, list[_Run], list[dict]]) -> None:
    solves, runs, before = found
    lengths = {len(run.samples) for run in runs}
    assert len(lengths) == 1
    if lengths == {0}:  # nothing was taken over, not even by half
        assert solves == 0
        assert all((run.last == 9).all() for run in runs)
        assert [run.generator.bit_generator.state for run in runs] == before
    for run in runs:
        assert np.isfinite(run.samples).all()
        assert np.isfinite(run.last).all()
        assert run.last.shape == (2,)
        assert not len(run.samples) or run.samples.shape[1] == 2
        run.generator.standard_normal(3)


def check_response(found: Response | None) -> None:
    if found is None:
        return
    readings, parameters = found.matrix.shape
    assert len(found.offset) == len(found.error) == readings
    assert len(found.nominal) == len(found.parameters) == parameters
    for part in (found.matrix, found.offset, found.error, found.nominal):
        assert np.isfinite(part).all()


def check_posterior(found) -> None:
    for one in found.values():
        assert one.mean.shape == (8,)
        assert np.isfinite(one.mean).all()
        assert np.asarray(one.root).shape[0] == 8
        assert np.isfinite(np.asarray(one.root)).all()


def check_map(data: xr.Dataset) -> None:
    checked_readings(data, Path("map"))
    assert data["B_T"].dtype.kind == "f"
    for value in data.attrs.values():
        str(value)


def check_finite(found) -> None:
    assert np.isfinite(found).all()


def check_blocks(table: BlockTable) -> None:
    written(".csv", write_blocks, table)


def free_hdf5() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "free.csv")
        path.write_bytes(FREE_CSV)
        return written(".h5", write_free_blocks, free_blocks_of_file(path))


def check_free_blocks(table: FreeBlocks) -> None:
    assert FreeBlocks.model_validate(table.model_dump()) == table
    assert len(table.places) == len(table.origins_m) == len(table)
    assert sum(table.radii_m) > 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "free.csv")
        write_free_blocks(table, path)
        assert FreeBlocks.model_validate(read_free_blocks(path)) == table


def check_study(study: Study) -> None:
    assert parse_study(study.model_dump()) == study
    assert study.model_dump_json()
    curve_of(study)


def with_table(path: Path) -> Study:
    """The study beside a table of H(B)."""
    study = parse_study(tomllib.loads(WITH_STEEL))
    return _with_table(study, path.parent, "study file study.toml")


def with_stl(path: Path) -> Study:
    """The study beside a body of iron in an STL file."""
    study = parse_study(tomllib.loads(WITH_STL))
    return _with_table(study, path.parent, "study file study.toml")


def changed_study(path: Path) -> tuple[str, Study]:
    study = read_study(path)
    after = study.with_(array__inner_radius_m=study.array.inner_radius_m * 0.9,
                        array__recoil_permeability=1.0625, external__background_T=(1e-5, 0.0, 0.0))
    try:
        parse_study(after.model_dump())
    except StudyError:
        return "", study
    return edited_text(path.read_bytes().decode(), [(after, "for a reason")]), after


def check_changed(found: tuple[str, Study]) -> None:
    text, study = found
    if text:
        assert parse_study(tomllib.loads(text)) == study


VARIANTS = (
    DeclaredFormat(), DeclaredFormat(length_unit="mm", field_unit="mT"),
    DeclaredFormat(length_unit="m", field_unit="T", columns=("x", "y", "z", "Bx", "By", "Bz")),
    DeclaredFormat(length_unit="cm", field_unit="G", component="z", at={"x": 0.0, "y": 0.0}),
    DeclaredFormat(length_unit="inch", field_unit="kG", angle_unit="deg", decimal_comma=True),
    DeclaredFormat(encoding="latin-1", origin_m=(0.0, 0.0, -0.5), length_unit="mm", field_unit="T"),
    DeclaredFormat(encoding="utf-16", length_unit="mm", field_unit="T"))


def imported(name: str):
    """Import a map, as the first of the variants says with which it can be read."""
    def read(path: Path):
        refused = []
        for number in range(len(VARIANTS)):
            variant = VARIANTS[(path.stat().st_size + number) % len(VARIANTS)]
            try:
                return import_map(path, variant, name)
            except MeasurementError as error:
                refused.append(error)
        raise refused[0]
    return read


@cache
def run_of_getdp() -> dict[str, bytes]:
    """Mesh, regions and all that GetDP leaves of a tiny problem."""
    with tempfile.TemporaryDirectory() as folder:
        files = build_mesh(build_magnet(TINY), Path(folder))
        session = Session(find_getdp(), Path(folder) / "work", jobs=1)
        finite_element_part(build_magnet(TINY), PLACES, session)
        run = session.folder / "getdp-real"
        return {"mesh": files.mesh.read_bytes(), "regions": files.regions.read_bytes(),
                "pre": (run / "magnetostatics_2d.pre").read_bytes(),
                "vectors": (run / "flux_density.txt").read_bytes(),
                "log": (run / "getdp.log").read_bytes()}


def edge_elements() -> bytes:
    """The list of unknowns with edges and faces of two tetrahedra."""
    return (b"$Resolution /* 'Magnetostatics' */\n0 1\n$EndResolution\n"
            b"$ElementsXEdges /* #0 */\n2\n1 6 1 -2 3 4 5 6\n2 6 1 2 -3 4 7 8\n$EndElementsXEdges\n"
            b"$ElementsXFacets /* #0 */\n2\n1 4 1 2 3 4\n2 4 1 5 6 7\n$EndElementsXFacets\n"
            b"$DofData /* #0 */\n0 0\n1 0\n1 0\n1 0\n8 6\n" + b"".join(
                b"1 %d 0 %d %d 0\n" % (n, 1 if n < 7 else 2, n if n < 7 else 0)
                for n in range(1, 9)) + b"$EndDofData\n")


def check_unknowns(found) -> None:
    assert found.count > 0
    for function in found.functions:
        assert function.min() >= -1
        assert function.max() < found.count


def mesh_beside(regions: bytes):
    """A reader of meshes; their regions are sound, and elsewhere."""
    def read(path: Path):
        with tempfile.TemporaryDirectory() as folder:
            other = Path(folder, "regions.json")
            other.write_bytes(regions)
            return verify_mesh(MeshFiles(path, other))
    return read


def log_of(path: Path) -> None:
    """As the lines of a running GetDP are read."""
    lines = path.read_bytes().decode(errors="replace").split("\n")
    try:
        _check_log(lines, Job("p.pro", path.name, "R", ()), path.parent)
        newton_residuals(lines)
    except GetDPError as error:
        raise GetDPError(f"{error} {path.name}") from None


CACHED = {"getdp.log": b"-solve R\nInfo\n", "out.txt": b"1 2 3\n"}


def manifest() -> bytes:
    """Of an entry of the cache that holds `CACHED`."""
    return Manifest(
        problem="p.pro", resolution="R", unknowns=7, solves=1, getdp="3.2.0",
        files={name: Kept(bytes=len(content), sha256=hashlib.sha256(content).hexdigest())
               for name, content in CACHED.items()}).model_dump_json(indent=1).encode()


def restored(path: Path) -> tuple[bool, set[str], set[str]]:
    """Whether the cache gives an answer by a manifest, and the files in the run folder, and in
    the one above it.
    """
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        root, run = Path(name), Path(name, "run")
        run.mkdir()
        (run / "p.pro").write_text("given")
        entry = Cache(root / "cache").entry(
            GetDP(Path("getdp"), "3.2.0", (), ""), Job("p.pro", "mesh.msh", "R", ()), run)
        entry.folder.mkdir(parents=True)
        for file, content in CACHED.items():
            (entry.folder / file).write_bytes(content)
        (entry.folder / MANIFEST).write_bytes(path.read_bytes())
        answered = entry.restore(lambda line: None)
        assert all(issubclass(one.category, HalbachWarning) for one in said)
        assert bool(said) != answered
        assert (run / "p.pro").read_text() == "given"
        return answered, {one.name for one in run.iterdir()}, {one.name for one in root.iterdir()}


def check_restored(found: tuple[bool, set[str], set[str]]) -> None:
    answered, here, above = found
    assert above == {"run", "cache"}
    assert here <= {"p.pro", *CACHED} if answered else here == {"p.pro"}


HDF5 = (b"\x89HDF\r\n\x1a\n", b"OHDR", b"TREE", b"SNOD", b"HEAP", b"FRHP", b"GCOL", b"BTHD",
        b"_FillValue", b"scale_factor", b"add_offset", b"units", b"days since 1-1-1",
        b"coordinates", b"DIMENSION_LIST", b"_Unsigned", b"dtype", b"bool", b"B_T", b"x_m",
        b"component", b"point", b"calendar", b"_Encoding")
TOML = (b"[[array.exceptions]]\n", b"[iron_ring]\n", b"[iron_ring.curve]\n", b"[noise]\n",
        b"[[noise.regions]]\n", b"[prior.types]\n", b"[external]\n", b"curve", b"file", b"kind",
        b'"steel"', b'"table"', b'"brauer"', b"neighbours", b"name = ", b"exceptions = [[1]]\n")
COLUMNS = (b"x_m", b"y_m", b"z_m", b"Bx_T", b"By_T", b"Bz_T", b"sigma_T", b"sigma_Bx_T", b"time_s",
           b"scan", b"# key: value\n", b"serial", b"type", b"ring", b"slot", b"mx_A_m2",
           b"volume_m3", b"temperature_C")
FORMAT = (b"[mm]", b"(mT)", b"X", b"Bx", b"Br", b"phi", b"r", b"[METRE]", b"[LENGU]",
          b"% Grid\n", b"% Data\n", b"% Coordinates\n", b"% Elements\n", b"% Nodes: 24\n",
          b"% Length unit: mm\n", b" 0\n", b" 7 BW [TESLA]\n", b"2 3 4 2\n", b"@ t=0", b"mf.Bx (T)",
          b"100000 100000 1\n")
XML = (b"<DataArray", b"</DataArray>", b"NumberOfComponents", b'"1000000000"', b'format="ascii"',
       b'format="appended"', b"<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///etc/passwd'>]>", b"&b;",
       b"vtkLZMADataCompressor", b"header_type='UInt64'", b"<AppendedData>", b"Float32", b"Int8",
       b"<Piece", b"offset")
MSH = (b"$Nodes\n", b"$EndNodes\n", b"$Elements\n", b"$EndElements", b"$Periodic\n", b"$NodeData\n",
       b"$PhysicalNames\n", b"1000000000\n", b"2.2 0 8\n")
RESULTS = (b'"../page.html"', b'"/etc/passwd"', b'"\\u001b[31m"', b'"\\ud800"', b"null", b"[", b"{",
           b"1e999", b'"command"', b'"halbach-fe check"', b'"ended"', b'"study": null', b'"rows"')
LOG = (b"  0 KSP Residual norm 1.0\n", b"KSP Residual norm nan\n", b" 3 KSP Residual norm x\n",
       b"System 1/1: 72 Dofs\n", b"System 1/1: %s Dofs\n" % (b"1" * 5000), b"Warning : ",
       b"NEWTON 1 0 x\n", b"NEWTON 1 3 1e-9\n", b"Error : ")


ORDER_CSV = b"block,step\nr01s02,1\nr01s01,2\n"


def check_order(names: tuple[str, ...]) -> None:
    """Every row has a name."""
    assert names


JOINED = json.dumps({"frame": "body", "poses": [{
    "name": "fringe", "middle_m": [0, 0, 0.1], "shift_m": [0, 0, 0.05], "shift_sd_m": [1e-4] * 3,
    "rotation_rad": [0, 0, 0.1], "rotation_sd_rad": [1e-3] * 3, "sign": 1}]}).encode()


def check_joined(found: tuple[str, tuple[MapPose, ...]]) -> None:
    """Every pose is one, with bars."""
    for one in found[1]:
        assert np.isfinite(one.translation_m).all()
        assert (one.shift_sd_m > 0).all()
        assert (one.rotation_sd_rad > 0).all()


NAMES = (
    "study", "changed study", "steel", "body of iron", "free blocks (CSV)",
    "free blocks (HDF5)", "map (CSV)",
    "map (HDF5)", "map (VTU)", "block table", "order of assembly", "joined maps",
    "import: columns", "import: opera", "import: comsol",
    "import: openpmd", "import: paraview", "import as columns", "import as opera",
    "import as comsol", "import as openpmd",
    "posterior", "stored response", "stored matrix", "stored chains",
    "results: run.json", "results: page.json", "mesh",
    "regions", "GetDP: unknowns", "GetDP: unknowns of edges", "GetDP: solutions",
    "GetDP: saved solutions", "GetDP: matrix", "GetDP: vectors", "GetDP: log", "cached answer")
"""To collect tests by, without making the seeds."""


@cache
def readers() -> tuple[Reader, ...]:
    """All of them."""
    left = run_of_getdp()
    places = np.loadtxt(io.BytesIO(left["vectors"]))[:, :3]
    ascii_mesh = written(".msh", lambda path: _ascii(left["mesh"], path))
    texts = (path.read_bytes() for path in sorted(ROOT.glob("studies/*/study.toml")))
    studies = tuple(text for text in texts if b"free_blocks" not in text)  # their tables: FREE_CSV
    table = Reader("steel", "steel.csv", (STEEL, STEEL.replace(b"# made up\n", b"\xef\xbb\xbf")),
                   with_table, StudyError, check_study, (b"H_A_per_m", b"B_T"))
    grid = openpmd_content(grid_of(field_map(POINTS, FIELD), "map"))
    sheet = (COMSOL + SPREADSHEET + rows(field=FIELD * [1, 1, 1000])).encode()
    columns = tuple(f"{header}\n{rows(mark)}".encode() for mark, header in (
        ("  ", "  ".join(MM_MT)), (",", ",".join(MM_MT)),
        (";", "X;Y;Z;Bx;By;Bz\nmm;mm;mm;mT;mT;mT"), (" ", "# x y z Bx By Bz"),
        (",", "r[mm],phi[deg],z[mm],Br[mT],Bphi[mT],Bz[mT]")))
    foreign = Reader("", "hall.txt", (), imported(""), MeasurementError,
                     lambda found: check_map(found.data), FORMAT)
    return (
        Reader("study", "study.toml", (*studies, RICH, FREE), read_study, StudyError, check_study,
               TOML, document),
        Reader("changed study", "study.toml", (*studies, RICH, FREE), changed_study, StudyError,
               check_changed, TOML, document),
        table,
        Reader("body of iron", "body.stl", (STL,), with_stl, StudyError, check_study,
               (b"vertex", b"facet normal")),
        Reader("free blocks (CSV)", "free.csv", (FREE_CSV,), free_blocks_of_file, StudyError,
               check_free_blocks, tuple(name.encode() for name in FREE_COLUMNS)),
        Reader("free blocks (HDF5)", "free.h5", (free_hdf5(),), free_blocks_of_file, StudyError,
               check_free_blocks, (*HDF5, *(name.encode() for name in FREE_COLUMNS))),
        Reader("map (CSV)", "map.csv", (MAP_CSV, written(".csv", write_map, a_map())), read_map,
               MeasurementError, check_map, COLUMNS),
        Reader("map (HDF5)", "map.h5", (written(".h5", write_map, a_map()), compact_hdf5()),
               read_map, MeasurementError, check_map, HDF5),
        Reader("map (VTU)", "map.vtu", (written(".vtu", write_map, a_map(False)), ascii_vtu()),
               read_map, MeasurementError, check_map, XML),
        Reader("block table", "blocks.csv", (BLOCKS_CSV,), read_blocks, MeasurementError,
               check_blocks, COLUMNS),
        Reader("order of assembly", "order.csv", (ORDER_CSV,),
               partial(read_order, blocks=("r01s01", "r01s02")), MeasurementError,
               check_order, (b"block",)),
        Reader("joined maps", "joined.json", (JOINED,), read_joined, MeasurementError,
               check_joined, (b"NaN", b"1e999", b"null", b"[]", b'"poses"')),
        replace(foreign, name="import: columns", seeds=columns),
        replace(foreign, name="import: opera", seeds=((OPERA + rows(field=FIELD)).encode(),)),
        replace(foreign, name="import: comsol", seeds=(
            sheet, comsol_grid().encode(), comsol_grid(brackets=True).encode(),
            comsol_sections().encode())),
        replace(foreign, name="import: srw and fluka", seeds=(srw().encode(), fluka().encode())),
        replace(foreign, name="import: paraview", seeds=(ascii_vtu().replace(b"B_T", b"B"), VTK),
                tokens=(*XML, b"POINT_DATA", b"DIMENSIONS 2 2 1", b"BINARY", b"VECTORS B float")),
        Reader("blocks in own columns", "own.csv", (
            b"id;ring;slot;Jx [mT];Jy [mT];Jz [mT];Volume [cm^3];sd [%]\nA;1;1;1300;0;0;12;0.1\n",
            b"id,shape,xc [mm],yc [mm],zc [mm],dx [mm],dy [mm],dz [mm],Br [T]\n"
            b"a,cuboid,1,2,3,10,10,10,1.3\n"),
            lambda path: import_blocks(path, DeclaredBlocks()), MeasurementError, len,
            (b"[A m^2]", b"rotation_x", b"#")),
        replace(foreign, name="import: openpmd", seeds=(grid,), tokens=(*HDF5, b"gridSize",
                b"%T", b"complex", b"magneticField", b"axisLabels", b"unitSI")),
        *(replace(foreign, name=f"import as {name}", read=imported(name),
                  seeds=(columns[0], (OPERA + rows(field=FIELD)).encode(), sheet, grid))
          for name in FORMATS),
        Reader("posterior", "posterior.h5", (posterior(),),
               unverified(posterior_files, lambda path: read_posterior(build_magnet(TINY), path)),
               MeasurementError,
               check_posterior, HDF5),
        Reader("stored response", "response.h5", (a_response(),),
               unverified(matrix_module, lambda path: read_response(path, "the key")), None,
               check_response, HDF5),
        Reader("stored matrix", "response.npy", (a_matrix(),),
               unverified(matrix_module, with_matrix), None, check_matrix,
               (b"'descr'", b"'<f8'", b"'|O'", b"'fortran_order': True", b"(3, 2)", b"(10**9, 2)",
                b"(-1, 2)", b"(", b"{", b"\x93NUMPY\x02\x00")),
        Reader("stored chains", "chains.nc", (chains(),), unverified(mcmc, resumed), None,
               check_resumed, (*HDF5, b"PCG64", b"bit_generator", b"state", b"has_uint32")),
        *(Reader(f"results: {name}", name, ((sound_results("sound") / name).read_bytes(),),
                 in_results, OutputError, json.dumps, RESULTS)
          for name in ("run.json", "page.json")),
        Reader("mesh", "mesh.msh", (left["mesh"], ascii_mesh), mesh_beside(
            left["regions"]), MeshError, tokens=MSH),
        Reader("regions", "regions.json", (left["regions"],), Regions.read, MeshError,
               lambda found: found.names, (b'"axis"', b"null", b'"blocks"', b"[", b"{")),
        Reader("GetDP: unknowns", "p.pre", (left["pre"],),
               lambda path: read_unknowns(path, "triangle6"), GetDPError, check_unknowns,
               (b"$DofData", b"$EndDofData", b"$ElementsXEdges", b"$ElementsXFacets")),
        Reader("GetDP: unknowns of edges", "p.pre", (edge_elements(),),
               lambda path: read_unknowns(path, "tetra10"), GetDPError, check_unknowns,
               (b"$DofData", b"$EndDofData", b"$ElementsXEdges", b"$ElementsXFacets")),
        Reader("GetDP: solutions", "x.bin", (vectors(SOLUTIONS),),
               lambda path: read_solutions(path, 3, 2), GetDPError,
               check_finite),
        Reader("GetDP: saved solutions", "x.res", (saved(SOLUTIONS).encode(),),
               lambda path: read_saved(path, 3, 2), GetDPError, check_finite,
               (b"$Solution", b"$End")),
        Reader("GetDP: matrix", "m.bin", (matrix(ROWS),), lambda path: read_matrix(path, 3),
               GetDPError, lambda found: found @ np.ones(3)),
        Reader("GetDP: vectors", "flux_density.txt", (left["vectors"],),
               lambda path: read_vectors(path, places), GetDPError, check_finite),
        Reader("GetDP: log", "getdp.log", (left["log"],), log_of, GetDPError, tokens=LOG),
        Reader("cached answer", "manifest.json", (manifest(),), restored, None, check_restored,
               (b'"out.txt"', b'"../out.txt"', b'"/etc/passwd"', b'"p.pro"', b'""', b'"."', b'".."',
                b"null", b'"\\u0000"')),
    )


def ascii_vtu() -> bytes:
    def numbers(values):
        return " ".join(f"{value:.9g}" for value in np.ravel(values))

    def array(name, values, components, kind="Float64"):
        return (f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{components}" '
                f'format="ascii">{numbers(values)}</DataArray>')
    return (
        '<?xml version="1.0"?><VTKFile type="UnstructuredGrid" version="0.1" '
        'byte_order="LittleEndian"><UnstructuredGrid><Piece NumberOfPoints="4" NumberOfCells="4">'
        f'<Points>{array("Points", POINTS[:4], 3)}</Points><Cells>'
        '<DataArray type="Int64" Name="connectivity" format="ascii">0 1 2 3</DataArray>'
        '<DataArray type="Int64" Name="offsets" format="ascii">1 2 3 4</DataArray>'
        '<DataArray type="UInt8" Name="types" format="ascii">1 1 1 1</DataArray></Cells>'
        f'<PointData>{array("B_T", FIELD[:4], 3)}</PointData></Piece></UnstructuredGrid></VTKFile>'
    ).encode()


def _ascii(binary: bytes, path: Path) -> None:
    """The same mesh as text."""
    source = path.with_name("source.msh")
    source.write_bytes(binary)
    meshio.write(path, meshio.read(source), file_format="gmsh22", binary=False)


def by_name(name: str) -> Reader:
    """One of them."""
    return next(reader for reader in readers() if reader.name == name)
