"""The rules of the house: who may import what."""

from __future__ import annotations

import ast

import pytest

from tests.conftest import ROOT

FILES = [path for folder in ("halbach_fe", "geo", "cli", "pro")
         for path in (ROOT / folder).rglob("*.py")]

# Later rooms may import earlier ones, never the other way round.
ORDER = ["errors", "cells", "foreign", "analytic", "materials", "study", "study_file", "blocks", "symmetry", "extent",
         "regions", "exact_field", "external", "geo", "mesh", "field_map", "formats", "new_study",
         "instrument", "block_table", "getdp", "solutions", "evaluation", "condensed", "inference",
         "measured_prior", "solve", "azimuthal", "routes", "observation", "discretization",
         "response", "nonlinear", "update", "sampled",
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
