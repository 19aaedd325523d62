"""The check of pages, and that it fails."""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
import subprocess
import sys
from argparse import Namespace

import matplotlib
import matplotlib.image
import pytest
import tomlkit
from matplotlib.figure import Figure

import halbach_fe as hf
from halbach_fe.cli import common, main
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report.answer import DPI, LEGIBLE_PX, Answer
from halbach_fe.report.page import (
    SMALL,
    Items,
    Page,
    Section,
    Text,
    own_style,
    save,
    simulated_files,
    write_page,
)
from tests.conftest import DIPOLE, ROOT, parse_study
from tests.support.pages import page, write_any_page

ANSWER = Answer("Is this a page?", "It is 1 page.", "Yes: it is a test.", "Read it to its end.")
SEEN = "what the picture shows, in words"


@pytest.fixture
def written(tmp_path):
    study = parse_study(DIPOLE | {"description": "<b>not bold</b>"})
    path = tmp_path / "page.html"
    write_any_page(path, save({"one.png": (Figure(), SEEN)}, tmp_path), study,
               {"source": "a test"}, ANSWER)
    return path


def test_a_page_is_whole(written):
    text = page(written)
    assert (written.parent / "one.png").read_bytes().startswith(b"\x89PNG")
    assert "a test" in text
    assert "remanence_T = 1.06" in text  # the study as it was read
    assert "recoil_permeability_across" not in text  # and no more
    assert "<b>not bold" not in text


@pytest.mark.parametrize(("old", "new"), [
    ("src=\"data:", "src=\"https://example.org/"), (f"alt=\"{SEEN}\"", "alt=\"\""),
    (">Provenance<", ">Origin<"), ("<body>", "<body><script src=\"plotly.js\"></script>"),
    ("It is 1 page.", ""), ("What next?</dt><dd>", "What next?</dt>"),
    ('class="answer"', 'class="words"'), ("</h1>", "</h1><h2>First something else</h2>"),
    ("<style>", "<link rel=\"stylesheet\" href=\"page.css\"><style>")])
def test_pages_that_are_not(written, old, new):
    text = written.read_text()
    assert old in text
    written.write_text(text.replace(old, new))
    with pytest.raises(AssertionError):
        page(written)


HOSTILE = {"text.usetex": True, "figure.facecolor": "red", "savefig.format": "pdf",
           "axes.prop_cycle": matplotlib.cycler(color=["y"]), "font.size": 40.0}
EXAMPLE = ROOT / "studies" / "quadrupole"


def test_figures_are_the_same_whatever_the_settings(tmp_path):
    """A user's matplotlibrc may need LaTeX, which is not there; and it is left alone."""
    magnet = build_magnet(parse_study(DIPOLE))

    def drawn(name):
        folder = tmp_path / name
        assert main(["prior", str(EXAMPLE / "study.toml"), str(EXAMPLE / "campaign" / "blocks.csv"),
                     "-o", str(folder), "--json"]) == 0
        return [path.read_bytes() for path in sorted(folder.glob("*.png"))], magnet._repr_html_()

    figures, shown = drawn("plain")
    assert figures
    with matplotlib.rc_context(HOSTILE):
        assert drawn("hostile") == (figures, shown)
        assert matplotlib.rcParams["text.usetex"]
    with matplotlib.rc_context(HOSTILE | {"text.usetex": False}):  # the control
        def plain():
            return save({"one.png": (Figure(), SEEN)}, tmp_path)

        assert plain() != own_style(plain)()


def test_every_page_has_its_own_style():
    """Whatever saves figures draws them in it."""
    for path in (ROOT / "halbach_fe" / "report").glob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef) and "save(" in ast.unparse(node) and (
                    path.name, node.name) != ("page.py", "save"):
                assert [ast.unparse(one) for one in node.decorator_list] == ["own_style"], node.name


def test_texts_of_figures_can_be_read(tmp_path):
    """On a narrow screen a figure is pushed sideways instead of shrunk to nothing."""
    figure = Figure(figsize=(8, 1))
    figure.text(0.5, 0.5, "small", fontsize=SMALL)
    picture, = save({"one.png": (figure, SEEN)}, tmp_path)
    width_px = matplotlib.image.imread(tmp_path / "one.png").shape[1]
    assert SMALL / 72 * DPI * picture.legible_px / width_px >= LEGIBLE_PX  # of the text, as shown
    path = tmp_path / "page.html"
    write_any_page(path, [picture], parse_study(DIPOLE), answer=ANSWER)
    style = f"min-width: {picture.legible_px}px; --width: {picture.width_in}in"
    assert f'style="{style}"' in path.read_text()
    assert re.search(r'<div class="wide"><img [^>]*><div class="more"></div></div><figcaption>',
                     path.read_text())


def test_figures_are_made_no_wider_than_paper():
    """All by `figure_of`."""
    found = {path.name: path.read_text().count("Figure(figsize=")
             for path in (ROOT / "halbach_fe" / "report").glob("*.py")}
    assert {name for name, count in found.items() if count} == {"page.py"}


def test_no_text_of_a_figure_is_smaller():
    found = {path.name: small_texts(path.read_text())
             for path in (ROOT / "halbach_fe" / "report").glob("*.py")}
    assert not any(found.values()), found
    for code in ('axis.legend(fontsize="small")', "axis.text(0, 0, 'x', fontsize=7)",
                 "axis.tick_params(labelsize=8)"):  # the controls
        assert small_texts(code)


def small_texts(code):
    """Sizes of texts in a program that are neither SMALL nor as large as the others."""
    allowed = {"SMALL", "'medium'", "'large'"}
    return [ast.unparse(node.value) for node in ast.walk(ast.parse(code))
            if isinstance(node, ast.keyword) and node.arg in ("fontsize", "labelsize")
            and ast.unparse(node.value) not in allowed]


@pytest.mark.parametrize("backend", ["module://matplotlib_inline.backend", "nonsense", "tkagg"])
def test_the_backend_of_a_notebook_is_not_needed(backend):
    """Which a terminal started from it inherits."""
    code = ("import sys; from halbach_fe.cli.process import guarded; "
            "sys.exit(guarded(lambda: bool(__import__('halbach_fe.report.page') and 0)))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          check=False, env=os.environ | {"MPLBACKEND": backend})
    assert (done.returncode, done.stderr) == (0, "")


def test_what_was_simulated_is_said():
    """Of the map, of the blocks, or of both; also if a posterior was computed with them."""
    of_map, of_blocks = "map.csv, simulated, SHA-256 12", "coil.csv, simulated, SHA-256 34"
    measured = {"measurements": "map.csv, SHA-256 12", "blocks": "coil.csv, SHA-256 34"}
    assert simulated_files(measured) == ""
    assert simulated_files(measured | {"blocks": of_blocks}).startswith("The measurements of the b")
    assert simulated_files(measured | {"measurements": of_map}).startswith("The map is simulated")
    both = "The map and the measurements of the blocks are simulated"
    assert simulated_files({"measurements": of_map, "blocks": of_blocks}).startswith(both)
    behind = f"{of_map}; blocks.csv, simulated, SHA-256 34"
    assert simulated_files({"read for the posterior": behind}).startswith(both)


def test_a_question_is_one_module(dipole, tmp_path, capsys, monkeypatch):
    """The example of CONTRIBUTING: files, page, record, notebook and terminal say the same."""
    code = re.search("```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)[1]
    (tmp_path / "toy_question.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    toy = importlib.import_module("toy_question")
    found = toy.tally(build_magnet(dipole()))
    said = f"There are {sum(found.blocks)}."
    shown = hf.write_report(found, tmp_path / "api")
    assert sorted(path.name for path in shown.parent.iterdir()) == [
        "page.json", "run.json", "tally.csv", "tally.html", "tally.json"]
    record = json.loads((tmp_path / "api" / "page.json").read_text())
    assert record["answer"]["said"] == said
    assert record["rows"] == [{"ring": "1", "blocks": str(found.blocks[0])}]
    assert said in shown.read_text()
    assert "tally.csv, tally.json, page.json" in shown.read_text()
    assert said in found._repr_html_()
    study = tmp_path / "study.toml"
    study.write_text(tomlkit.dumps(DIPOLE))
    for as_json in (False, True):
        arguments = Namespace(verb="tally", study=study, output=tmp_path / "cli", json=as_json)
        assert common.with_folder(
            lambda given: common.finish(given, toy.page(found)), arguments) == 0
        printed = capsys.readouterr()
        assert (said in printed.err) != as_json
        assert ("Blocks by ring" in printed.out) != as_json
    assert json.loads(printed.out)["blocks"] == list(found.blocks)
    assert json.loads((tmp_path / "cli" / "run.json").read_text())["command"] == "halbach-fe tally"
    with pytest.raises(hf.HalbachError, match="has returned; instead received a str"):
        hf.write_report("text", tmp_path / "none")


def test_a_page_leaves_out_what_says_nothing(tmp_path):
    """A section about no rows, and texts and lists without words. Control: others are there."""
    sections = [Section(["said"], "Of a row", about=[1]), Section(["unsaid"], "Of none", about=[]),
                Section(["", Text(""), Items([]), Items(["in a list"])], "Of words")]
    path = tmp_path / "page.html"
    write_page(path, Page("solve", "of sections", None, ANSWER, {}, sections), ())
    body = path.read_text().partition("Of a row")[2]
    assert "<p>said</p>" in body
    assert "unsaid" not in body
    assert "Of none" not in body
    assert body.count("<ul>") == body.count("in a list") == 1
    assert "<p></p>" not in body
