"""Every block of code in the documentation runs, in the order of its page, and the pages build."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from halbach_fe.cli.verbs import VERBS
from halbach_fe.solver.getdp_cache import FOLDER_VARIABLE, LIMIT_VARIABLE
from halbach_fe.study.model import Study
from tests.conftest import ROOT
from tests.support.warm_process import run_warm

DOCS = ROOT / "docs"
TUTORIAL = DOCS / "tutorial.md"
EXAMPLES = sorted(path for path in DOCS.glob("examples/*.md"))
PAGES = sorted(path for path in DOCS.rglob("*.md")
               if path.parent.name != "reference" and path not in (TUTORIAL, *EXAMPLES))
CELL = re.compile(r"^```\{code-cell\}\n(.*?)^```$", re.M | re.S)
FENCE = re.compile(r"^```(?:\{code-block\} )?(\w+)\n(.*?)^```$", re.M | re.S)
OPTION = re.compile(r"^:(\w+): *(.*)\n", re.M)
ELSEWHERE = ("make setup-test", ". .venv/bin/activate")
"""Done by what runs this test."""


@dataclass(frozen=True)
class Block:
    """A block of code: its language, its text, the file it is, whether it must fail."""

    language: str
    text: str
    file: str = ""
    fails: bool = False


def blocks_of(text):
    for language, body in FENCE.findall(text):
        options = dict(OPTION.findall(body.partition("\n\n")[0] + "\n")) if body[:1] == ":" else {}
        code = body.partition("\n\n")[2] if options else body
        yield Block(language, code, options.get("caption", ""), options.get("class") == "fails")


def run_page(text, folder):
    """Run a page's blocks; AssertionError with what was said if one does not do as it should.

    What a block of the page has solved the next finds in a cache, as on the machine of a reader.
    """
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "OMP_NUM_THREADS": "1"}
    cached = environment | {FOLDER_VARIABLE: str(folder / ".cache"), LIMIT_VARIABLE: "1"}
    for block in blocks_of(text):
        if block.file:
            (folder / block.file).write_text(block.text, encoding="utf-8")
            continue
        if block.language == "toml":
            tomllib.loads(block.text)
            continue
        if block.language == "text":
            continue
        if block.language not in ("sh", "python"):
            raise AssertionError(f"a block of {block.language} that nobody runs: {block.text}")
        code = "\n".join(line for line in block.text.splitlines() if line not in ELSEWHERE)
        # with --mpi several processes are to solve what one has solved
        done = run_block(block.language, code, folder, environment if "--mpi" in code else cached)
        if done is None:
            continue  # nothing but what was done before
        assert (done.returncode != 0) == block.fails, f"{code}\n{done.stdout}\n{done.stderr}"
        if block.fails:
            assert "error: Input" in done.stderr


SHELL = re.compile(r"[*|;&<>`]|\$\(")
"""What only a shell understands."""


def run_block(language, code, folder, environment):
    """Run a program, or commands one after the other until one fails."""
    if language == "python":
        return run_warm(code, folder, environment)
    options = {"cwd": folder, "capture_output": True, "text": True, "timeout": 1200}
    if SHELL.search(code):
        return subprocess.run(["bash", "-e", "-c", code], env=environment, **options)
    done = None
    for line in code.replace("\\\n", "").replace("$PWD", str(folder)).splitlines():
        match shlex.split(line, comments=True):
            case "export", assignment:
                environment = environment | dict([assignment.split("=", 1)])
            case "halbach-fe", *arguments:
                done = run_warm(arguments, folder, environment)
            case [_, *_] as words:
                done = subprocess.run(words, env=environment, **options)
        if done and done.returncode:
            break
    return done


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_every_block_runs(page, tmp_path):
    (tmp_path / "studies").symlink_to(ROOT / "studies")
    run_page(page.read_text(encoding="utf-8"), tmp_path)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_runs(example, tmp_path):
    """All cells of a notebook, one after the other; `make docs` shows what they print."""
    cells = CELL.findall(example.read_text(encoding="utf-8"))
    assert cells
    run_page("```python\n" + "".join(cells) + "```\n", tmp_path)


def test_tutorial_finds_what_it_says(tmp_path):
    """Its text names the displacement that it hides, and figures that are these."""
    text = TUTORIAL.read_text(encoding="utf-8")
    run_page(text, tmp_path)
    found = json.loads((tmp_path / "diagnosis" / "diagnosis.json").read_text())
    (effect,) = found["effects"]
    assert effect["effect"] == "mapper_translation"
    hidden = re.search(r"mapper_translation=([\d.,-]+)", text)[1].split(",")
    for one, true in zip(effect["parameters"][:2], hidden, strict=False):
        assert abs(one["value"] - float(true)) < 4 * one["sd"]
    before, after = (next(row["chi2_per_reading"] for row in found["scores"][when]
                          if row["part"] == "held out") for when in ("before", "after"))
    assert round(before) == int(re.search(r"It is about (\d+)", text)[1])
    assert after < 1.5
    better = json.loads((tmp_path / "better" / "summary.json").read_text())
    assert better


def test_a_wrong_block_is_seen(tmp_path):
    for text in ("```sh\nhalbach-fe solve nothing.toml -o there\n```\n",
                 "```python\nassert 1 == 2\n```\n", "```ruby\nputs 1\n```\n",
                 "```{code-block} sh\n:class: fails\n\ntrue\n```\n"):
        with pytest.raises(AssertionError):
            run_page(text, tmp_path)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """All pages, without the sidebar of the theme, which takes a quarter of the time."""
    folder = tmp_path_factory.mktemp("docs")
    subprocess.run([sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", DOCS,
                    folder, "-D", "nb_execution_mode=off", "-D", "html_theme=basic",
                    "-d", folder / ".doctrees"], check=True, timeout=600)
    return folder


def test_examples_are_offered_as_notebooks(built):
    """With the cells that `test_every_example_runs` runs."""
    for example in EXAMPLES:
        assert f'href="{example.stem}.ipynb"' in (
            built / "examples" / f"{example.stem}.html").read_text(encoding="utf-8")
        notebook = json.loads((built / "examples" / f"{example.stem}.ipynb").read_text())
        cells = ["".join(cell["source"]).strip() for cell in notebook["cells"]
                 if cell["cell_type"] == "code"]
        assert cells == [cell.strip() for cell in CELL.findall(
            example.read_text(encoding="utf-8"))]


def test_reference_has_all_keys_and_verbs(built):
    study = (built / "reference" / "study.html").read_text(encoding="utf-8")
    assert all(f">{key}<" in study for key in Study.model_fields)
    commands = (built / "reference" / "commands.html").read_text(encoding="utf-8")
    assert all(f'id="{verb}"' in commands for verb in VERBS)
