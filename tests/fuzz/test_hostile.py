"""What was found, each by name, and small files that promise much."""

from __future__ import annotations

import json
import subprocess
import sys

import h5py
import pytest

from halbach_fe.core.errors import MeasurementError
from halbach_fe.measurement.field_map import read_map
from halbach_fe.solver.session import newton_residuals
from tests.conftest import ROOT
from tests.fuzz.bombs import BOMBS, SECRET
from tests.fuzz.contract import refusal
from tests.fuzz.readers import BLOCKS_CSV, LOG, MAP_CSV, STEEL, WITH_STEEL, by_name, run_of_getdp

STUDY = (ROOT / "studies/faser/study.toml").read_bytes()
LARGE_ENTITY = b"1 1000000000000000000 0 2 0 0\n$EndDofData"

# Each of these raised something else, warned, printed, or was taken for a number.
FOUND = {
    "nested arrays": ("study", b"a = " + b"[" * 5000, "TOML of a few levels"),
    "an integer of 5000 digits": ("study", b"a = 1" + b"0" * 5000, "complete TOML"),
    "a hexadecimal of 10000 digits": ("study", STUDY.replace(
        b"blocks_per_ring = 16", b"blocks_per_ring = 0x" + b"f" * 10_000), "thousands of digits"),
    "an integer beyond floats": ("study", STUDY.replace(
        b"blocks_per_ring = 16", b"blocks_per_ring = 1" + b"0" * 400), "less than or equal to 512"),
    "a terminal's escape sequence": ("study", STUDY + b'\n"\\u001b[31m" = 1\n', "`?[31m`"),
    "a key of 5000 letters": ("study", STUDY + b"\n" + b"a" * 5000 + b" = 1\n", "aaa..."),
    "a device for a table": ("study", WITH_STEEL.replace("steel.csv", "/dev/zero").encode(),
                             "must be a file"),
    "a name of 300 letters": ("study", WITH_STEEL.replace("steel.csv", "a" * 300).encode(),
                              "File name too long"),
    "an underscore in H": ("steel", STEEL.replace(b"100.0", b"1_00.0"), "line 3 must hold two"),
    "digits of another script in H": ("steel", STEEL.replace(b"100.0", "١٠٠".encode()), "line 3"),
    "an underscore in a map": ("map (CSV)", MAP_CSV.replace(b"0.25", b"0.2_5"), "'0.2_5'"),
    "digits of another script": ("map (CSV)", MAP_CSV.replace(b"0.25", "٠.٢٥".encode()), "'٠.٢٥'"),
    "digits of another script in a foreign map": ("import: columns", (
        "x[mm] y[mm] z[mm] Bx[T]\n1 2 3 0.5\n1 2 4 ٠.٥\n").encode() + b"\n" * 3, "Bx in line 3"),
    "an escape sequence in a scan": ("map (CSV)", MAP_CSV.replace(b"first", b"fi\x1b[31mrst"),
                                     "without control characters"),
    "a header of 200 000 letters": ("map (CSV)", b"a," * 50_000 + b"\n", "..."),
    "a VTU that meshio prints about": ("map (VTU)", b"<VTKFile", "a VTU file"),
    "a place of 1e300": ("block table", BLOCKS_CSV.replace(b"a,1,1,", b"a,1e300,1,"),
                         "1 to 100000"),
    "a moment of 1e308": ("block table", BLOCKS_CSV.replace(b"500.0", b"1e308"), "below 1e+12"),
    "a serial number that is a comment": ("block table", BLOCKS_CSV.replace(b"A-001", b'"#1"'),
                                          "not begin with #"),
    "a table of 40 000 blocks": ("block table", b"serial,type,mx_A_m2,my_A_m2,mz_A_m2,sigma_A_m2\n"
                                 + b"".join(b"%d,a,1,0,0,0.1\n" % n for n in range(40_000)), ""),
    "a mesh that ends the program": ("mesh", b"$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n1\n"
                                     b"1 0 0 0\n$EndNodes\n$x\n$Elements\n0\n$EndElements", "Mesh"),
    "elements of two types": ("mesh", None, "in place of one"),
    "nodes without a place": ("mesh", None, "without finite coordinates"),
    "a block's name that is GetDP's": ("regions", None, "one written beside a mesh"),
    "an unknown of node 1e18": ("GetDP: unknowns", None, "impossibly large"),
    "an unknown that is not there": ("GetDP: unknowns", None, "within 1 to 72"),
    "nothing at all": ("GetDP: vectors", b"\n", "holds 0 rows"),
    "a residual that is no number": ("GetDP: log", LOG[2], "which is no number"),
    "a residual that is infinite": ("GetDP: log", b"KSP Residual norm inf", "which is no number"),
    "a line of 50 000 digits": ("GetDP: log", b"KSP\n" + b"1" * 50_000 + b" KSP Residual norm x",
                                "which is no number"),
    "a count of 5000 digits": ("GetDP: log", LOG[4], "no unknowns"),
}


def found(name: str) -> tuple[str, bytes, str]:
    """The file of a defect; some are made from what GetDP and Gmsh write."""
    reader, content, said = FOUND[name]
    left = run_of_getdp()
    seeds = by_name(reader).seeds
    if name == "elements of two types":  # the first triangle becomes a quadrangle
        lines = seeds[1].split(b"\n")
        place = next(n for n, line in enumerate(lines) if line.split()[1:2] == [b"9"])
        lines[place] = b" ".join([*lines[place].split()[:1], b"3", *lines[place].split()[2:9]])
        return reader, b"\n".join(lines), said
    if name == "nodes without a place":
        lines = seeds[1].split(b"\n")
        place = lines.index(b"$Nodes") + 2
        lines[place] = b"1 nan 0 0"
        return reader, b"\n".join(lines), said
    if content is None:
        content = {
            "a block's name that is GetDP's": left["regions"].replace(
                b'"r01s01"', b'"r\\n}; Exit; Group {"'),
            "an unknown of node 1e18": left["pre"].replace(b"$EndDofData", LARGE_ENTITY),
            "an unknown that is not there": left["pre"].replace(b"1 2 0 1 1 1", b"1 2 0 1 99 1"),
        }[name]
    if reader == "GetDP: log":
        lines = left["log"].split(b"\n")
        place = next(n for n, line in enumerate(lines)
                     if (b"KSP Residual" if b"KSP" in content else b"Dofs") in line)
        lines[place] = (b"0 " if content.startswith(b"KSP") else b"") + content
        content = b"\n".join(lines)
    return reader, content, said


@pytest.fixture
def folder(tmp_path):
    inside = tmp_path / "folder"
    inside.mkdir()
    return inside


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found(name, folder):
    """Where nothing is said, it took too long."""
    reader, content, said = found(name)
    answer = refusal(by_name(reader), content, folder)
    assert said in answer
    assert bool(said) == bool(answer)


def test_residuals_of_newton_that_are_none():
    found = newton_residuals(["NEWTON 1 3 1e-9", "NEWTON 1 0 x", "NEWTON 1 0 1e-2",
                              "NEWTON 1 1 1.5e-08", "NEWTON 1 2 " + "1" * 50_000 + "x"])
    assert found == [[1e-2, 1.5e-8]]


def test_small_files_that_promise_much():
    """With 512 MiB; without our guard four of them break the promise (the control)."""
    run = subprocess.run([sys.executable, "-m", "tests.fuzz.bombs"], capture_output=True, text=True,
                         cwd=ROOT, check=True, timeout=300)
    said = json.loads(run.stdout)
    for name in BOMBS:
        assert said[name], name
        assert not said[name].startswith("broken"), said[name]
        assert not any(word in said[name].lower() for word in ("memory", "alloc")), said[name]
        assert SECRET[:6].decode() not in said[name]
    assert "MemoryError" in said["rows that are not there, unguarded"]
    for name in ("data of another file", "a link to another file", "a view of another file"):
        assert "another file" in said[name]
    assert "a heap without end" in said["a heap without end"]
    for name in ("rows that are not there", "rows of zeros, compressed"):
        assert "bytes, in a file too small" in said[name]


def test_hdf5_would_show_another_file(folder, monkeypatch):
    """What the guard is for: h5py itself reads the secret, as numbers."""
    monkeypatch.chdir(folder)
    (folder / "secret.txt").write_bytes(SECRET)
    (folder / "map.h5").write_bytes(BOMBS["data of another file"][1])
    with h5py.File(folder / "map.h5") as file:
        assert file["B_T"][()].tobytes() == SECRET[:48]
    with pytest.raises(MeasurementError, match="takes its data from another file"):
        read_map(folder / "map.h5")
