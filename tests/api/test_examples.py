"""The Python interface: its names, its examples, and how light it is to import."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys

import numpy as np
import pytest
import tomlkit

import halbach_fe as hf
from halbach_fe.core.interface import ShownInNotebook
from tests.conftest import DIPOLE, changed
from tests.support import cuboids

MODULES = sorted(
    module.name for module in pkgutil.walk_packages(hf.__path__, "halbach_fe.")
    if not module.name.endswith("__main__"))
FUNCTIONS = [name for name in hf.__all__ if inspect.isfunction(inspect.unwrap(getattr(hf, name)))
             or inspect.isfunction(getattr(getattr(hf, name), "dispatch", None))]
HEAVY = {"numpy", "scipy", "pydantic", "xarray", "matplotlib", "gmsh", "rich", "arviz", "plotly"}


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A folder with the files that the examples name: studies, map, block table, spare blocks."""
    folder = tmp_path_factory.mktemp("examples")
    study = changed(DIPOLE, array__recoil_permeability=1.0,
                    noise={"regions": [{"name": "all", "sigma_T": 1e-5}]})
    (folder / "dipole.toml").write_text(tomlkit.dumps(study))
    (folder / "mri.toml").write_text(tomlkit.dumps(cuboids.DOCUMENT))
    hf.write_report(hf.simulate_measurement(hf.read_study(folder / "dipole.toml")), folder)
    header, *rows = [line for line in (folder / "blocks.csv").read_text().splitlines()
                     if not line.startswith("#")]
    names = header.split(",")
    place = [names.index(name) for name in ("serial", "ring", "slot")]
    for row in rows[:2]:  # two more blocks of the first types
        cells = row.split(",")
        for number, value in zip(place, (f"spare-{cells[place[0]]}", "", ""), strict=True):
            cells[number] = value
        rows.append(",".join(cells))
    (folder / "spares.csv").write_text("\n".join([header, *rows, ""]))
    return folder


def examples():
    finder = doctest.DocTestFinder(exclude_empty=True)
    for name in ("halbach_fe", *MODULES):
        for found in finder.find(importlib.import_module(name), name):
            if found.examples:
                yield pytest.param(found, id=found.name)


@pytest.mark.parametrize("example", list(examples()))
def test_examples_run(example, campaign, monkeypatch):
    monkeypatch.chdir(campaign)
    said = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    runner.run(example, out=said.append, clear_globs=False)
    assert runner.failures == 0, "".join(said)


def test_a_wrong_example_is_seen(campaign):
    wrong = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, 0)
    runner = doctest.DocTestRunner()
    runner.run(wrong, out=lambda text: None)
    assert runner.failures == 1


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_has_an_example(name):
    assert ">>>" in (inspect.getdoc(getattr(hf, name)) or "")


def sections(docstring):
    """The titles of the numpydoc sections of a docstring that are not empty."""
    lines = inspect.cleandoc(docstring or "").splitlines()
    return {title for title, rule, *content in (lines[i:i + 3] for i in range(len(lines) - 2))
            if title and rule == "-" * len(title) and content[0].strip()}


def documented_parameters(docstring):
    """The names in the section Parameters of a docstring."""
    _, _, text = inspect.cleandoc(docstring or "").partition("Parameters\n----------\n")
    section = text.partition("\n\n")[0].splitlines()
    return {name.strip() for line in section if line[:1].strip() and " : " in line
            for name in line.partition(" : ")[0].split(",")} | {
        line.lstrip("*") for line in section if line.lstrip("*").isidentifier()}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_documents_parameters_and_result(name):
    function = getattr(hf, name)
    docstring = inspect.getdoc(function)
    assert {"Parameters", "Returns", "Examples"} <= sections(docstring)
    assert set(inspect.signature(function).parameters) == documented_parameters(docstring)


@pytest.mark.parametrize("name", sorted(set(hf.__all__) - set(FUNCTIONS) - {
    "Study",  # its docstring is the description of the JSON schema, which lists the keys itself
    "HalbachWarning"}))
def test_every_class_documents_its_attributes(name):
    assert "Attributes" in sections(vars(getattr(hf, name))["__doc__"])


def test_seeds_are_those_of_the_commands():
    """A function without a seed returns what its command does: the rings of a design differed."""
    seeds = {name: inspect.signature(getattr(hf, name)).parameters["seed"].default
             for name in FUNCTIONS if "seed" in inspect.signature(getattr(hf, name)).parameters}
    assert len(seeds) > 3
    assert set(seeds.values()) == {1}  # the default of --seed


def test_missing_sections_and_parameters_are_seen():
    lacking = """Solve.

    Parameters
    ----------
    magnet : Magnet
    swaps, turns : int
        Numbers of moves.

    Returns
    -------
    """
    assert sections(lacking) == {"Parameters"}
    assert sections("Parameters\n---\nmagnet\n") == set()  # the rule is too short
    assert documented_parameters(lacking) == {"magnet", "swaps", "turns"}
    assert documented_parameters("Solve.") == set()


def test_the_functions_are_all_there():
    assert len(FUNCTIONS) >= 16
    assert set(hf.__all__) <= set(dir(hf))
    assert len(set(dir(hf))) == len(dir(hf))
    assert "importlib" not in dir(hf)
    with pytest.raises(AttributeError, match="no attribute"):
        _ = hf.nothing_like_it


def test_a_report_replaces_no_other_result(dipole, tmp_path):
    """A folder belongs to one command and one study, in Python too."""
    study = dipole(array__recoil_permeability=1.0, noise={"regions": [
        {"name": "all", "sigma_T": 1e-4}]})
    campaign = hf.simulate_measurement(study)
    folder, session = tmp_path / "results", hf.Session.open(tmp_path / "runs")
    result = hf.infer(hf.build_magnet(study), campaign.readings, session)
    page = hf.write_report(result, folder).read_bytes()
    other = hf.simulate_measurement(study.with_(name="other"))
    for one, said in ((campaign, "halbach-fe infer"), (other, "halbach-fe infer")):
        with pytest.raises(hf.HalbachError, match=f"holds results of `{said}` of study dipole"):
            hf.write_report(one, folder)
    another = hf.infer(hf.build_magnet(study.with_(name="other")), campaign.readings, session)
    with pytest.raises(hf.HalbachError, match="one command and one study"):
        hf.write_report(another, folder)
    assert (folder / "report.html").read_bytes() == page
    assert hf.write_report(result, folder) == folder / "report.html"
    with pytest.raises(hf.HalbachError, match="has returned; instead received a NoneType"):
        hf.write_report(None, tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_every_result_has_a_command():
    from halbach_fe.cli.verbs import VERBS
    from halbach_fe.report.joint_report_folders import ORDER
    from halbach_fe.report.page import PAGES

    named = {name: re.findall(r' Page\(\s*"([a-z-]+)"', inspect.getsource(
        importlib.import_module(f"halbach_fe.report.{name}"))) for name in PAGES.values()}
    assert [name for name, verbs in named.items() if not verbs] == []
    assert {verb for verbs in named.values() for verb in verbs} <= set(ORDER) <= set(VERBS)
    shown = {name for name in hf.__all__ if isinstance(kind := getattr(hf, name), type)
             and issubclass(kind, ShownInNotebook)}
    assert set(PAGES) == shown - {"Magnet"}  # which has a picture instead
    results = re.search(r"result : (.*?)\n {8}", hf.write_report.__doc__, re.S)[1]
    assert set(re.findall(r"[A-Z]\w+", results)) == set(PAGES)


def test_every_result_and_function_is_known_to_type_checkers():
    """They read imports, which are not run; the control is one import less."""
    source = inspect.getsource(hf)
    assert checked_names(source) == set(hf.__all__)
    less = source.replace("    from halbach_fe.api import sort as sort\n", "")
    assert checked_names(less) == set(hf.__all__) - {"sort"}


def checked_names(source):
    """Names that the imports for type checkers give to a module."""
    names = (alias.asname for part in ast.parse(source).body if isinstance(part, ast.If)
             for line in part.body if isinstance(line, ast.ImportFrom) for alias in line.names)
    return set(filter(None, names))


RESULT, TABLE = object.__new__(hf.InferenceResult), object.__new__(hf.BlockTable)
"""Nothing is asked of them, as a number is wrong."""

SEEDS = "seed .* a whole number of at least 0; instead received -1"


@pytest.mark.parametrize(("use", "said"), [
    (lambda magnet, session: hf.Session.open(session.folder, jobs=0), "jobs .* at least 1"),
    (lambda magnet, session: hf.plan(magnet, session, points=0), "points .* at least 1"),
    (lambda magnet, session: hf.tolerance(magnet, session, draws=0), "draws .* from 20 to 1e.06"),
    (lambda magnet, session: hf.tolerance(magnet, session, limit_units=-1), "from 1e-06 to 1e.06"),
    (lambda magnet, session: hf.shim(RESULT, session, swaps=-1), "swaps .* at least 0"),
    (lambda magnet, session: hf.shim(RESULT, session, swaps=1.5), "a whole number .* received 1.5"),
    (lambda magnet, session: hf.shim(RESULT, session, turns=True), "turns .* a number; .* True"),
    (lambda magnet, session: hf.demagnetization(magnet, session, across=0), "from 2 to 100"),
    (lambda magnet, session: hf.simulate_measurement(magnet.study, seed=-1), SEEDS),
    (lambda magnet, session: hf.sort(magnet, TABLE, session, seed=-1), SEEDS),
    (lambda magnet, session: hf.Region.sphere(float("nan")), "half_axes_m .* received nan"),
    (lambda magnet, session: hf.Region.sphere("0.1"), "half_axes_m .* received '0.1'"),
    (lambda magnet, session: hf.Region.sphere(-0.1), "half_axes_m .* above 0"),
    (lambda magnet, session: hf.Region.sphere(100), "below 10 m; .* in millimetres"),
    (lambda magnet, session: hf.Region("cube", (0.01,) * 3), "one of sphere"),
    (lambda magnet, session: hf.Region("cylinder", (0.01, 0.01)), "three numbers"),
    (lambda magnet, session: hf.Region("sphere", (0.01, 0.02, 0.01)), "equal along x, y and z"),
    (lambda magnet, session: hf.Region("cylinder", (0.01, 0.02, 0.03)), "an ellipsoid"),
    (lambda magnet, session: hf.homogeneity(magnet, session, degrees=1000), "from 1 to 20"),
    (lambda magnet, session: hf.MultipoleReference(0.02, (0, 1)), "orders .* from 1 to 100"),
    (lambda magnet, session: hf.MultipoleReference(0.02, (1.5,)), "orders .* received 1.5"),
    (lambda magnet, session: hf.MultipoleReference(0.02, (2, 3000)), "orders .* from 1 to 100"),
    (lambda magnet, session: hf.MultipoleReference(0.02, "2..4"), "orders .* a tuple of"),
    (lambda magnet, session: hf.MultipoleReference(float("nan")), "radius_m .* finite"),
    (lambda magnet, session: hf.design_rings(magnet.study, session, seed=-1), SEEDS),
    (lambda magnet, session: hf.sort(magnet, TABLE, session, turns="no"), "True or False"),
    (lambda magnet, session: hf.simulate_measurement(magnet.study, hide="gain_x"), "a list")])
def test_numbers_out_of_range(dipole, session, use, said):
    """They are refused before anything is solved, as on the command line."""
    with pytest.raises(hf.HalbachError, match=said):
        use(hf.build_magnet(dipole()), session)


def test_forces_of_no_magnet(short_dipole, session):
    magnet = hf.build_magnet(short_dipole(array__recoil_permeability=1.0))
    for options, said in (({"density_kg_per_m3": 7.5}, "from 1000 to 20000"),
                          ({"price_per_kg": float("nan")}, "price_per_kg .* finite")):
        with pytest.raises(hf.HalbachError, match=said):
            hf.forces(magnet, session, **options)


DATA = hf.field_map([[0, 0, 0]], [[0.1, 0, 0]])


@pytest.mark.parametrize(("use", "said"), [
    (lambda magnet, session: hf.build_magnet("study.toml"), "a Study; .* by hf.read_study"),
    (lambda magnet, session: hf.read_study(magnet), "path of read_study must be a path"),
    (lambda magnet, session: hf.Session.open(magnet), "folder of Session.open must be a path"),
    (lambda magnet, session: hf.solve(), "must be magnet, session; instead: missing"),
    (lambda magnet, session: hf.write_report(magnet), "must be result, folder; instead: missing"),
    (lambda magnet, session: hf.campaign_report("solved", "page.html"), "a list of folders"),
    (lambda magnet, session: hf.solve(session, magnet), "magnet of solve must be a Magnet"),
    (lambda magnet, session: hf.solve(magnet.study, session), "hf.build_magnet makes one"),
    (lambda magnet, session: hf.infer(magnet, DATA, "results"), "hf.Session.open makes one"),
    (lambda magnet, session: hf.infer(magnet, DATA, session, "b.csv"), "by hf.read_blocks"),
    (lambda magnet, session: hf.sort(magnet, "b.csv", session), "by hf.read_blocks"),
    (lambda magnet, session: hf.cad(magnet, "b.csv"), "by hf.read_blocks"),
    (lambda magnet, session: hf.shim(magnet, session), "result of shim must be an InferenceRes"),
    (lambda magnet, session: hf.multipoles(magnet, session, 0.02), "a MultipoleReference; "),
    (lambda magnet, session: hf.homogeneity(magnet, session, region="sphere"), "a Region"),
    (lambda magnet, session: hf.simulate_measurement(magnet), "study of simulate_measurement")])
def test_objects_of_another_kind(dipole, session, use, said):
    with pytest.raises(hf.HalbachError, match=said):
        use(hf.build_magnet(dipole()), session)


def run(*command):
    return subprocess.run([sys.executable, *command], capture_output=True, text=True, check=True)


@pytest.mark.parametrize("command", [
    ("-c", "import halbach_fe"), ("-m", "halbach_fe", "--help"),
    ("-m", "halbach_fe", "infer", "--help")], ids=["import", "help", "verb"])
def test_nothing_heavy_is_imported_for_help(command):
    done = run("-X", "importtime", *command)
    imported = {line.rpartition("|")[2].strip().partition(".")[0]
                for line in done.stderr.splitlines()}
    assert "argparse" in imported or command[0] == "-c"  # the list is not empty
    assert not imported & HEAVY


def test_results_for_scripts_load_no_matplotlib(campaign):
    """With --json a command that writes no page, and any --dry-run, does without pictures."""
    code = ("import sys; from halbach_fe.cli import main; "
            f"main(['solve', '{campaign}/dipole.toml', '-o', '{campaign}/none', '--dry-run', "
            "'--json']); sys.exit('matplotlib' in sys.modules)")
    run("-c", code)


def test_a_notebook_shows_the_main_figure(campaign, session):
    magnet = hf.build_magnet(hf.read_study(campaign / "dipole.toml"))
    solution = hf.solve(magnet, session)
    shown = solution._repr_html_()
    assert "data:image/png;base64," in shown
    assert "http" not in shown.replace("http://www.w3.org", "")
    assert "dipole" in magnet._repr_html_()


def test_labelled_arrays_come_out(campaign, session):
    magnet = hf.build_magnet(hf.read_study(campaign / "dipole.toml"))
    result = hf.infer(magnet, hf.read_map(campaign / "map.csv"), session)
    one = result.magnetizations.sel(parameter="r01s05.Mx")
    assert np.isfinite(float(one["posterior_mean"]))
    assert float(one["posterior_sd"]) < float(one["prior_sd"])
    assert result.predictions.sizes["reading"] == len(result.observation)
