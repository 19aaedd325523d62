"""Every failure that GetDP passes over in silence is provoked here, caught, and named."""

from __future__ import annotations

import dataclasses
import os
import platform
import stat
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from halbach_fe.core.errors import GetDPError, GetDPNotFoundError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.solver.getdp import (
    ENVIRONMENT_VARIABLE,
    GetDP,
    Job,
    _check_log,
    _check_residuals,
    _tether,
    declared_constants,
    find_getdp,
    read_vectors,
    run,
)
from halbach_fe.solver.magnetostatics import (
    CROSS_SECTION,
    FLUX_DENSITY_FILE,
    SOLUTIONS_FILE,
    edge_elements,
    fill_run_folder,
)
from halbach_fe.solver.mesh import build_mesh, verify_mesh
from halbach_fe.solver.routes import solve_nominal
from halbach_fe.solver.session import Session
from tests.conftest import circle

POINTS = circle(0.07, 5)


@pytest.fixture
def staged(dipole, tmp_path):
    """A run folder ready for GetDP, and its job."""
    study = dipole(mesh__block_size_m=0.03)
    folder = tmp_path / "run"
    folder.mkdir()
    mesh = verify_mesh(build_mesh(build_magnet(study), tmp_path / "mesh"))
    return folder, fill_run_folder(build_magnet(study), mesh, POINTS, folder, CROSS_SECTION)


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text, "the edit would do nothing"
    path.write_text(text.replace(old, new))


def test_a_sound_run_passes(getdp, staged):
    """The control of everything below."""
    folder, job = staged
    log = run(getdp, job, folder)
    assert any("SOURCE 0" in line for line in log)
    field = read_vectors(folder / FLUX_DENSITY_FILE, POINTS)
    assert field.shape == (5, 3)
    assert (folder / "getdp.log").read_text().startswith("magnetostatics_2d.pro -msh mesh.msh")


def test_a_run_leaves_nothing_else(getdp, staged):
    """PETSc would write its options beside the solutions, as ``solutions.bin.info``."""
    folder, job = staged
    before = {path.name for path in folder.iterdir()}
    run(getdp, job, folder)
    left = {path.name for path in folder.iterdir()} - before
    assert left == {FLUX_DENSITY_FILE, SOLUTIONS_FILE, "getdp.log", "magnetostatics_2d.pre"}


@pytest.mark.parametrize("other", ["exit 1", ""])
def test_a_setpriv_that_cannot_is_left_out(getdp, staged, tmp_path, monkeypatch, other):
    """BusyBox's and old ones know no --pdeathsig; elsewhere there is none."""
    folder, job = staged
    path = tmp_path / "bin"
    path.mkdir()
    if other:
        (path / "setpriv").write_text(f"#!/bin/sh\n{other}\n")
        (path / "setpriv").chmod(0o755)
    monkeypatch.setenv("PATH", str(path) + ("" if not other else os.pathsep + os.environ["PATH"]))
    _tether.cache_clear()
    try:
        assert run(getdp, job, folder)
        assert _tether() == []
    finally:
        _tether.cache_clear()


def test_options_that_nobody_would_know_of_later_do_not_count(getdp, staged, monkeypatch):
    folder, job = staged
    monkeypatch.setenv("PETSC_OPTIONS", "-ksp_type nonsense")
    assert run(getdp, job, folder)
    monkeypatch.setenv("HOME", str(folder))
    (folder / ".petscrc").write_text("-ksp_type nonsense\n")
    assert run(getdp, job, folder)
    with pytest.raises(GetDPError, match="Unknown type"):  # the control: such an option counts
        run(getdp, dataclasses.replace(job, options=("-ksp_type", "nonsense")), folder)


def test_runs_by_hand_without_options(getdp, staged):
    """The files stand on their own: no -setnumber needed."""
    folder, job = staged
    run(getdp, dataclasses.replace(job, numbers={}), folder)


def test_unknown_setnumber(getdp, staged):
    folder, job = staged
    assert declared_constants(folder) == {
        "VACUUM", "FIRST_SOURCE", "LAST_SOURCE", "TOLERANCE", "MAX_STEPS", "LINE_SEARCH", "COLD",
        "GATEAUX"}
    with pytest.raises(GetDPError, match="-setnumber VACUM sets a constant that no"):
        run(getdp, dataclasses.replace(job, numbers={"VACUM": 1}), folder)


@pytest.mark.parametrize(("file", "old", "new", "said"), [
    ("magnetostatics_2d.pro",
     "{ NameOfCoef an; EntityType NodesOf; NameOfConstraint MagneticInsulation; }", "",
     r"unknowns where the mesh gives .*boundary condition"),
    # a region that the problem forgets leaves a system of the wrong size
    ("problem_data.pro", "Vol_All = Region[ {Vol_Air, Vol_Iron, Vol_Mag} ]",
     "Vol_All = Region[ {Vol_Iron, Vol_Mag} ]", "a region is missing"),
    # GetDP only warns when IterativeLoop gives up
    ("solve_sources.pro", "Generate[A]; Solve[A]; PostOperation[FluxDensity];",
     """InitSolution[A];
      IterativeLoop[1, 1e-30, 1]{ GenerateJac[A]; SolveJac[A]; }
      PostOperation[FluxDensity];""", "an iteration did not converge"),
    ("solve_sources.pro", "Evaluate[ $source = FIRST_SOURCE, $sample = 0 ];", "",
     r"run-time variable was never set"),
    ("sources.pro", "Function {", "Function { Exit;", "syntax error"),
], ids=["boundary condition", "region", "iteration", "run-time variable", "syntax"])
def test_an_edited_problem_is_refused(getdp, staged, file, old, new, said):
    folder, job = staged
    edit(folder / file, old, new)
    with pytest.raises(GetDPError, match=said):
        run(getdp, job, folder)


def test_unconverged_krylov_solver(getdp, staged):
    folder, job = staged
    options = ("-petsc_prealloc", "100", "-ksp_type", "cg", "-pc_type", "none", "-ksp_max_it", "3")
    with pytest.raises(GetDPError, match="linear solver did not converge"):
        run(getdp, dataclasses.replace(job, options=options), folder)


def test_mumps_out_of_memory(getdp, staged):
    folder, job = staged
    options = (*job.options, "-mat_mumps_icntl_14", "-99", "-mat_mumps_icntl_23", "1")
    with pytest.raises(GetDPError, match=r"MUMPS|did not converge"):
        run(getdp, dataclasses.replace(job, options=options), folder)


def test_missing_gauge(getdp, short_dipole, tmp_path):
    study = short_dipole()
    mesh = verify_mesh(build_mesh(build_magnet(study), tmp_path / "mesh"))
    folder = tmp_path / "run"
    folder.mkdir()
    job = fill_run_folder(build_magnet(study), mesh, POINTS, folder, edge_elements(1))
    gauge = ("{ NameOfCoef ae; EntityType EdgesOfTreeIn; EntitySubType StartingOn;\n"
             "        NameOfConstraint TreeGauge; }")
    edit(folder / job.problem, gauge, "")
    with pytest.raises(GetDPError, match="a gauge"):
        run(getdp, job, folder)


def test_residual_that_stays_large_is_caught_without_petscs_help(tmp_path):
    job_log = ["Info : System 1/1: 10 Dofs", "  0 KSP Residual norm 1e5",
               "  1 KSP Residual norm 1e-7"]
    job = Job("a.pro", "m.msh", "R", ())
    with pytest.raises(GetDPError, match="residuals of 0 of 1 solves"):
        _check_log(job_log[:1], job, tmp_path)
    _check_log(job_log, job, tmp_path)
    for bad in ("1e2", "nan"):
        with pytest.raises(GetDPError, match="did not converge"):
            _check_log([*job_log[:2], f"  1 KSP Residual norm {bad}"], job, tmp_path)


def test_stale_output(getdp, staged):
    """An output of an earlier run is no output of this one."""
    folder, job = staged
    run(getdp, job, folder)
    edit(folder / "solve_sources.pro", "PostOperation[FluxDensity];", "")
    with pytest.raises(GetDPError, match=r"did not write flux_density\.txt"):
        run(getdp, job, folder)


def test_point_outside_the_mesh(getdp, dipole, tmp_path):
    study = dipole(mesh__block_size_m=0.03)
    mesh = verify_mesh(build_mesh(build_magnet(study), tmp_path / "mesh"))
    points = np.vstack([POINTS, [[100.0, 0, 0]]])
    folder = tmp_path / "run"
    folder.mkdir()
    job = fill_run_folder(build_magnet(study), mesh, points, folder, CROSS_SECTION)
    with pytest.raises(GetDPError, match=r"point outside the mesh|outside"):
        run(getdp, job, folder)
        read_vectors(folder / FLUX_DENSITY_FILE, points)


def rows(values):
    """A SimpleTable of POINTS with given field values."""
    return "\n".join(f"{x!r} {y!r} {z!r} {b}" for (x, y, z), b in
                     zip(POINTS.tolist(), values, strict=True)) + "\n"


@pytest.mark.parametrize(("text", "said"), [
    (rows(["1 2 3"] * 4 + ["0 0 0"]), "exactly zero"),
    (rows(["1 2 3"] * 4 + ["0"]), "table of six columns"),
    (rows(["1 2 3"] * 4 + ["1 2 nan"]), "not finite"),
    (rows(["1 2 3"] * 4 + ["1 2 inf"]), "not finite"),
    (rows(["1 2"] * 5), "5 columns"),
    ("".join(rows(["1 2 3"] * 5).splitlines(keepends=True)[:4]), "4 rows"),
    (rows(["1 2 3"] * 5).replace("0.0 1 2 3", "0.5 1 2 3"), "other points"),
])
def test_bad_tables_are_refused(tmp_path, text, said):
    path = tmp_path / "flux_density.txt"
    path.write_text(rows(["1 2 3"] * 5))
    assert read_vectors(path, POINTS)[0].tolist() == [1, 2, 3]
    path.write_text(text)
    with pytest.raises(GetDPError, match=said):
        read_vectors(path, POINTS)


def test_a_deep_run_folder_is_no_long_path(getdp, dipole, tmp_path):
    """GetDP sees short names only; 256 characters of folder do not matter."""
    folder = tmp_path
    while len(str(folder)) < 400:
        folder = folder / ("deep" * 10)
    folder.mkdir(parents=True)
    study = dipole(mesh__block_size_m=0.03)
    mesh = verify_mesh(build_mesh(build_magnet(study), folder / "mesh"))
    job = fill_run_folder(build_magnet(study), mesh, POINTS, folder, CROSS_SECTION)
    run(getdp, job, folder)
    read_vectors(folder / FLUX_DENSITY_FILE, POINTS)


def test_an_over_long_name_is_refused(getdp, staged):
    folder, job = staged
    name = "m" * 230 + ".msh"
    (folder / name).write_bytes(b"")
    with pytest.raises(GetDPError, match="buffers end at 256"):
        run(getdp, dataclasses.replace(job, mesh=name), folder)


def test_missing_files_are_named(getdp, staged):
    folder, job = staged
    (folder / job.mesh).unlink()
    with pytest.raises(GetDPError, match=r"mesh\.msh is missing"):
        run(getdp, job, folder)


def test_mesh_with_no_elements(getdp, staged):
    folder, job = staged
    (folder / job.mesh).write_text("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n0\n$EndNodes\n"
                                   "$Elements\n0\n$EndElements\n")
    with pytest.raises(GetDPError):
        run(getdp, job, folder)


def fake(tmp_path: Path, body: str) -> GetDP:
    """An executable that claims to be GetDP."""
    path = tmp_path / "getdp"
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)
    return GetDP(path, "3.2.0", (), "")


@pytest.mark.parametrize(("body", "said"), [
    ("kill -SEGV $$", r"crashed \(SIGSEGV\)"),
    ("kill -KILL $$", r"crashed \(SIGKILL; out of memory\?\)"),
    ("echo 'Error   : std::bad_alloc'; exit 1", "memory ran out"),
    ("echo 'Warning : MUMPS: INFOG(1)=-9'; exit 0", "MUMPS could not factorize"),
    ("echo 'Warning : something new'; exit 0", "GetDP warned: 'something new'"),
    ("exit 0", "no unknowns"),
    ("echo 'Info : System 1/1: 0 Dofs'", "no unknowns"),
    ("exit 3", "exit code 3"),
])
def test_failures_of_the_process_are_named(tmp_path, staged, body, said):
    folder, job = staged
    with pytest.raises(GetDPError, match=said):
        run(fake(tmp_path, body), job, folder)


def test_a_hanging_getdp_is_ended_with_its_children(tmp_path, staged):
    folder, job = staged
    marker = tmp_path / "pid"
    started = time.monotonic()
    with pytest.raises(GetDPError, match=r"time limit of 0\.5 s"):
        run(fake(tmp_path, f"sleep 60 & echo $! > {marker}; wait"),
            dataclasses.replace(job, time_limit_s=0.5), folder)
    assert time.monotonic() - started < 30
    with pytest.raises(ProcessLookupError):
        for _ in range(100):  # the kernel reaps in its own time
            os.kill(int(marker.read_text()), 0)
            if "State:\tZ" in Path(f"/proc/{marker.read_text().strip()}/status").read_text():
                raise ProcessLookupError
            time.sleep(0.02)


def test_cancelling_ends_the_run(tmp_path, staged):
    folder, job = staged
    cancel = threading.Event()
    threading.Timer(0.2, cancel.set).start()
    with pytest.raises(GetDPError, match="cancelled"):
        run(fake(tmp_path, "sleep 60"), job, folder, cancel=cancel)


def test_getdp_is_found_as_named_then_by_environment_then_on_path(tmp_path, monkeypatch, getdp):
    answer = "echo 'Version          : 9.9.9' >&2; echo 'Build options    : 64Bit PETSc' >&2"
    one = fake(tmp_path, answer)
    assert find_getdp(one.executable).version == "9.9.9"
    assert find_getdp(one.executable).build_options == ("64Bit", "PETSc")
    assert fake(tmp_path, answer.replace("9.9.9", "9.9.80")).executable == one.executable
    assert find_getdp(one.executable).version == "9.9.80"  # another file of the same name
    fake(tmp_path, answer)
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(one.executable))
    assert find_getdp().version == "9.9.9"
    assert find_getdp(getdp.executable).version == getdp.version
    monkeypatch.delenv(ENVIRONMENT_VARIABLE)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_getdp().version == "9.9.9"


@pytest.mark.usefixtures("no_getdp")
def test_no_getdp_says_how_to_get_it(tmp_path):
    with pytest.raises(GetDPNotFoundError, match="apt-get install getdp"):
        find_getdp()
    other = fake(tmp_path, "echo hello")
    with pytest.raises(GetDPNotFoundError, match="does not answer like GetDP"):
        find_getdp(other.executable)


@pytest.fixture
def no_getdp(tmp_path, monkeypatch):
    """A machine without GetDP."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    monkeypatch.setattr("halbach_fe.solver.getdp._packaged", lambda: None)


@pytest.mark.usefixtures("no_getdp")
def test_without_getdp_only_finite_elements_are_refused(dipole, tmp_path):
    session = Session.open(tmp_path / "work")
    vacuum = dipole(array__recoil_permeability=1.0)
    exact = solve_nominal(build_magnet(vacuum), POINTS, session)
    assert np.abs(exact).max() > 0.1
    with pytest.raises(GetDPNotFoundError, match=r"needs finite elements.*pip install"):
        solve_nominal(build_magnet(dipole(array__recoil_permeability=1.05)), POINTS, session)


@pytest.fixture
def packaged(tmp_path, monkeypatch):
    """The static build of GetDP's makers: PETSc 3.10, complex, which logs less than Debian's."""
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin")
    monkeypatch.delenv(ENVIRONMENT_VARIABLE, raising=False)
    if platform.machine() != "x86_64" or platform.system() != "Linux":
        pytest.skip("the package has a build for Linux on x86-64 only")
    monkeypatch.setattr("shutil.which", lambda name: None if name == "getdp" else name)
    return find_getdp()


def test_the_static_build_of_its_makers_gives_the_same(packaged, getdp, dipole, tmp_path):
    """Direct and reaction, linear and with iron that saturates; to rounding, of 1e-13 of the field.

    Factors of two builds differ in the order of elimination, which leaves some 1e-12; Newton's
    method ends at 1e-10 of the field.
    """
    assert "complex" in packaged.petsc
    steel = {"inner_radius_m": 0.2, "outer_radius_m": 0.24,
             "curve": {"kind": "steel", "name": "aisi_1010"}}
    for number, (keys, tolerance) in enumerate([
            ({"solver__method": "direct"}, 1e-11), ({"solver__method": "reaction"}, 1e-11),
            ({"iron_ring": steel}, 1e-8)]):
        study = dipole(mesh__block_size_m=0.05, array__recoil_permeability=1.05, **keys)
        ours, theirs = (
            solve_nominal(build_magnet(study), POINTS, Session(build, tmp_path / f"{number}{name}"))
            for name, build in [("debian", getdp), ("makers", packaged)])
        assert np.abs(ours - theirs).max() <= tolerance * np.abs(ours).max()


def test_another_file_in_the_package_is_not_started(packaged, monkeypatch):
    assert packaged.version
    monkeypatch.setattr("halbach_fe.solver.getdp._PACKAGED_SHA256", "0" * 64)
    with pytest.raises(GetDPNotFoundError, match="was not found"):
        find_getdp()


def test_a_solve_without_source_shows_one_residual():
    """PETSc 3.10 ends at iteration 0; a source that was not solved for is refused."""
    assert _check_residuals(["  0 KSP Residual norm 0.0"], 1e-8, Path()) == 1
    with pytest.raises(GetDPError, match="residual"):
        _check_residuals(["  0 KSP Residual norm 1e-3"], 1e-8, Path())
