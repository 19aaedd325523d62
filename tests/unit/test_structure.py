"""The rules of the house: who may import what."""

from __future__ import annotations

import ast

import pytest

from tests.conftest import ROOT

FILES = [path for folder in ("halbach_fe", "geo", "cli", "pro")
         for path in (ROOT / folder).rglob("*.py")]

# Later rooms may import earlier ones, never the other way round.
ORDER = ["code_digest", "errors", "in_the_making", "cells", "foreign", "analytic", "materials", "study",
         "study_file", "blocks", "symmetry", "extent", "regions", "exact_field", "external", "geo",
         "mesh", "field_map", "formats", "new_study", "instrument", "block_table", "getdp", "cache",
         "cluster", "solutions", "evaluation", "condensed", "inference", "measured_prior", "solve",
         "azimuthal", "routes", "observation", "discretization", "response", "nonlinear", "update",
         "sampled",
         "scene", "effects", "diagnosis", "diagnose", "next_measurement", "diagnosed",
         "planning", "sensitivity", "demagnetization", "verification", "cost", "multipoles",
         "remounting", "shimming", "sorting", "tolerance", "campaign", "report", "cli"]

# A synthetic campaign tests the model of the field, so it must not come from it.
CAMPAIGN = (None, "campaign", "errors", "materials", "study", "field_map", "block_table",
            "observation")


def imports(path):
    """Modules that a file imports, at its top and inside functions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def room(name):
    parts = name.split(".")
    return parts[1] if parts[0] == "halbach_fe" and len(parts) > 1 else None


def own_room(path):
    relative = path.relative_to(ROOT)
    folder, name = relative.parts[:2]
    return name.removesuffix(".py") if folder == "halbach_fe" else folder


def violations(path, names):
    """What the imports of a file break."""
    me, found = own_room(path), []
    for name in names:
        top = name.split(".")[0]
        if top == "gmsh" and me != "geo":
            found.append(f"{path.name} imports gmsh")
        if top == "subprocess" and me != "getdp":
            found.append(f"{path.name} imports subprocess")
        if top == "matplotlib" and me != "report":
            found.append(f"{path.name} imports matplotlib")
        if me == "inference" and room(name) not in (None, "inference", "errors", "blocks"):
            found.append(f"{path.name} imports {name}")
        if me == "campaign" and room(name) not in CAMPAIGN:
            found.append(f"{path.name} imports {name}")
        if top in ("magpylib", "ngsolve", "netgen"):  # an extra: `campaign.extras.needed`
            found.append(f"{path.name} imports {top}")
        if me == "analytic" and top == "halbach_fe":
            found.append(f"{path.name} imports {name}")
        other = room(name)
        # by hand, `python -m halbach_fe.geo` starts from a later room
        if other in ORDER and me in ORDER and path.name != "__main__.py" and (
                ORDER.index(other) > ORDER.index(me)):
            found.append(f"{me} imports {other}")
    return found


CODE = {"pickle", "marshal", "shelve", "dill", "joblib", "cloudpickle", "yaml", "jsonpickle"}
RUN = {"eval", "exec", "compile", "__import__", "input"}
STARTS = {"system", "popen", "execv", "execve", "execvp", "spawnl", "spawnv"}
READS = {"open_dataset", "load_dataset", "open_mfdataset", "open_datatree"}


def dangers(path, text):
    """What a file does that could make data of unknown origin into code, or skips our guards."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names] + [getattr(node, "module", None) or ""]
            found += [name for name in names if name.split(".")[0] in CODE]
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        owner = getattr(getattr(called, "value", None), "id", "")
        name = getattr(called, "attr", getattr(called, "id", ""))
        if isinstance(called, ast.Name) and name in RUN:
            found.append(name)
        if owner == "os" and name in STARTS:
            found.append(f"os.{name}")
        found += [keyword.arg for keyword in node.keywords
                  if keyword.arg in ("shell", "allow_pickle")
                  and getattr(keyword.value, "value", None) is True]
        reads = name in READS or (owner, name) == ("meshio", "read") or (
            (owner, name) == ("h5py", "File") and len(node.args) > 1
            and getattr(node.args[1], "value", "") != "w")
        if reads and path.name != "foreign.py":
            found.append(f"{owner}.{name}")
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_that_are_read_are_data(path):
    assert dangers(path, path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("text", [
    "import pickle", "from joblib import load", "import yaml", "eval('1')", "exec(text)",
    "import os\nos.system('ls')", "run(command, shell=True)", "np.load(x, allow_pickle=True)",
    "__import__(name)", "xr.open_dataset(path)", "h5py.File(path, 'r')", "meshio.read(path)"])
def test_the_rules_on_data_can_be_broken(text):
    assert dangers(ROOT / "halbach_fe" / "solve.py", text)
    assert not dangers(ROOT / "halbach_fe" / "foreign.py", "re.compile(text)\nh5py.File(x, 'r')")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_one_way(path):
    assert violations(path, imports(path)) == []


@pytest.mark.parametrize(("file", "name"), [
    ("solve.py", "subprocess"), ("update.py", "gmsh"), ("solve.py", "halbach_fe.report"),
    ("study.py", "halbach_fe.blocks"), ("analytic.py", "halbach_fe.study"),
    ("inference/linear.py", "halbach_fe.getdp"), ("update.py", "matplotlib.figure"),
    ("campaign/vacuum.py", "halbach_fe.exact_field"), ("campaign/bodies.py", "halbach_fe.blocks"),
    ("campaign/vacuum.py", "magpylib")])
def test_the_rules_can_be_broken(file, name):
    assert violations(ROOT / "halbach_fe" / file, [name])


def test_every_room_is_ordered():
    rooms = {own_room(path) for path in FILES} - {"__init__", "__main__", "pro"}
    assert rooms == set(ORDER)
