"""The rules of the house: who may import what."""

from __future__ import annotations

import ast
import tomllib

import pytest

from tests.conftest import LONGEST, QUICK_FILES, ROOT

FILES = [path for folder in ("halbach_fe", "geo", "cli", "pro")
         for path in (ROOT / folder).rglob("*.py")]

# The rooms in the order of the flow: later ones may import earlier ones, never the other way round.
# geo, pro and cli lie at the top of the checkout; the others are the folders of halbach_fe.
# api, magnets and explanation are modules.
ROOMS = ["core", "study", "geometry", "geo", "stats", "solver", "measurement", "response",
         "inference", "diagnosis", "design", "synthetic", "api", "magnets", "report", "explanation",
         "cli"]
AT_THE_TOP, SINGLE_MODULES = {"geo", "cli", "pro"}, {"api", "magnets", "explanation"}
MOST_ROOMS = 12
MOST_MODULES, MOST_CONSTANTS = 220, 550  # a new one takes the place of another

# What a library may be imported by: a room, or a module of it.
ONLY_IN = {"gmsh": "geo", "subprocess": "solver.getdp", "matplotlib": "report",
           "numba": "core.threads",
           # extras, which only `core.installation.import_extra` imports, when they are needed
           "magpylib": "", "ngsolve": "", "netgen": ""}

# Statistics see arrays only; the closed form is an oracle; and a synthetic campaign tests the model
# of the field, so it must not come from it: of geometry it may ask whether its own bodies overlap.
MAY_IMPORT = {
    "stats": ("core",), "solver.ring_harmonics_2d": ("core",),
    "synthetic": ("core", "study", "measurement.field_map", "measurement.block_table",
                  "measurement.positions", "measurement.reading_noise", "geometry.convex_pieces",
                  "geometry.outline", "geometry.overlaps", "geometry.surface")}


def imports(path):
    """Modules that a file imports, at its top and inside functions, but for type checkers only."""
    waiting = [ast.parse(path.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        waiting += ast.iter_child_nodes(node)
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = node.module or ""
            names = [f"{module}.{alias.name}" for alias in node.names]
            yield from (name if own(name) in MODULES else module for name in names)


def module_of(path):
    """Name of a file's module within the package: ``solver.mesh``, ``geo.magnet_meshes``."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts[1:] if parts[0] == "halbach_fe" else parts
    return ".".join(parts).removesuffix(".__init__")


MODULES = {module_of(path): path for path in FILES}


def own(name):
    """Name of a module within the package; None if it is another's, or the package itself."""
    package, _, rest = name.partition(".")
    return rest if package == "halbach_fe" and rest else None


def is_in(module, places):
    return any(module == place or module.startswith(f"{place}.") for place in places)


def violations(me, names):
    """What the imports of a module break."""
    found, room = [], me.partition(".")[0]
    for name in names:
        top, other = name.partition(".")[0], own(name)
        if top in ONLY_IN and not is_in(me, [ONLY_IN[top]]):
            found.append(f"{me} imports {top}")
        if other is None or other.partition(".")[0] not in ROOMS:
            continue
        for place, allowed in MAY_IMPORT.items():
            if is_in(me, [place]) and not is_in(other, [place, *allowed]) and other in MODULES:
                found.append(f"{me} imports {other}")
        # by hand, `python -m halbach_fe.geo` and `python -m halbach_fe` start from later rooms
        if room in ROOMS and not me.endswith("__main__") and (
                ROOMS.index(other.partition(".")[0]) > ROOMS.index(room)):
            found.append(f"{me} imports {other}")
    return found


def graph():
    """Which modules each module imports."""
    return {me: {other for name in imports(path) if (other := own(name)) in MODULES} - {me}
            for me, path in MODULES.items()}


def cycle(arrows):
    """Modules that import one another in a circle; none if there is no circle."""
    left = dict(arrows)
    while free := [me for me, others in left.items() if not others & left.keys()]:
        for me in free:
            del left[me]
    return sorted(left)


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
        if reads and path.name != "untrusted_files.py":
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
    assert dangers(ROOT / "halbach_fe" / "solver" / "mesh.py", text)
    assert not dangers(ROOT / "halbach_fe" / "core" / "untrusted_files.py",
                       "re.compile(text)\nh5py.File(x, 'r')")


@pytest.mark.parametrize("me", MODULES)
def test_imports_point_one_way(me):
    assert violations(me, imports(MODULES[me])) == []


@pytest.mark.parametrize(("me", "name"), [
    ("solver.session", "subprocess"), ("inference.infer", "gmsh"),
    ("solver.mesh", "halbach_fe.report"), ("study.model", "halbach_fe.geometry.blocks"),
    ("solver.ring_harmonics_2d", "halbach_fe.study.model"),
    ("stats.posteriors", "halbach_fe.solver.getdp"),
    ("inference.infer", "matplotlib.figure"),
    ("measurement.formats.grid_formats", "halbach_fe.design"),
    ("synthetic.magpylib_field", "halbach_fe.solver.exact_block_field"),
    ("synthetic.true_magnet_of_study", "halbach_fe.geometry.blocks"),
    ("synthetic.true_magnet_of_study", "magpylib")])
def test_the_rules_can_be_broken(me, name):
    assert me in MODULES
    assert violations(me, [name])


def test_no_circle():
    arrows = graph()
    assert cycle(arrows) == []
    assert len(arrows["response.response_matrix"]) > 5  # the graph is not empty
    planted = {**arrows, "core.errors": {"response.response_matrix"}}
    assert {"core.errors", "response.response_matrix"} <= set(cycle(planted))


def rooms_of(modules):
    return {me.partition(".")[0] for me in modules} - {"__init__", "__main__", "halbach_fe"}


def test_every_room_is_ordered_and_there_are_few():
    rooms = rooms_of(MODULES)
    assert rooms - {"pro"} == set(ROOMS)
    assert len(rooms - AT_THE_TOP - SINGLE_MODULES) <= MOST_ROOMS
    folders = {path.name for path in (ROOT / "halbach_fe").iterdir()
               if path.is_dir() and path.name != "__pycache__"}
    assert folders == rooms - AT_THE_TOP - SINGLE_MODULES
    assert rooms_of({*MODULES, "attic.boxes"}) - {"pro"} != set(ROOMS)


def constants(text):
    """Count the numbers with names in capitals at the top of a module; each of a tuple counts."""
    found = 0
    for node in ast.parse(text).body:
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and all(
                isinstance(name, ast.Name) and name.id.lstrip("_").isupper()
                for target in targets for name in getattr(target, "elts", [target])):
            values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
            found += sum(isinstance(value, ast.UnaryOp | ast.BinOp)
                         or type(getattr(value, "value", None)) in (int, float)
                         for value in values)
    return found


def test_the_house_does_not_grow():
    assert len(MODULES) <= MOST_MODULES
    assert sum(constants(path.read_text(encoding="utf-8")) for path in FILES) <= MOST_CONSTANTS
    assert constants("A, B = 1, -2.0\n_C: float = 2**30\nD = 'm'\nlower = 3\nE = True") == 3


def test_every_package_is_installed():
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"][
        "packages"])
    packages = {f"halbach_fe.{me}" for me, path in MODULES.items() if path.name == "__init__.py"}
    assert listed == packages - {"halbach_fe.__init__"} | {"halbach_fe"}


def of_benchmarks(path):
    return [name for name in imports(path) if name.partition(".")[0] == "benchmarks"]


def test_tests_import_no_benchmarks():
    """Benchmarks import the oracles and the support of the tests, never the other way round."""
    assert not [path for path in (ROOT / "tests").rglob("*.py") if of_benchmarks(path)]
    assert of_benchmarks(ROOT / "benchmarks" / "run.py")  # an import would be seen


def test_lists_of_test_files_are_up_to_date():
    """A file of another name would be left out of `make test-quick`, or begin last."""
    listed = {*QUICK_FILES, *(ROOT / "tests" / name for name in LONGEST)}
    assert listed <= set((ROOT / "tests").rglob("test_*.py"))
    assert not QUICK_FILES & {ROOT / "tests" / name for name in LONGEST}
