"""What is stored is computed again when a formula that it came from has changed, and only then."""

from __future__ import annotations

import subprocess
import sys

import pytest

from halbach_fe.core.code_digest import sources

MODEL = {
    "toy/__init__.py": "",
    "toy/matrix.py": "from typing import TYPE_CHECKING\nfrom toy.solver import field\n"
                     "if TYPE_CHECKING:\n    from toy.report import page\n",
    "toy/solver/__init__.py": "",
    "toy/solver/field.py": "def f():\n    from toy.solver.closed_forms.cuboid import g\n",
    "toy/solver/closed_forms/__init__.py": "",
    "toy/solver/closed_forms/cuboid.py": "from toy import problems\n\ndef g():\n    return 1\n",
    "toy/problems/__init__.py": "",
    "toy/problems/magnetostatics.pro": "Group{}\n",
    "toy/report/__init__.py": "",
    "toy/report/page.py": "from toy import matrix\n",
    "toy/report/page.html.j2": "<p>\n",
}


def digest(folder):
    """The digest in a process of its own, as imports are remembered."""
    return subprocess.run(
        [sys.executable, "-c", "from halbach_fe.core.code_digest import code_digest\n"
         "print(code_digest('toy.matrix').hex())"],
        cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def toy(tmp_path):
    for name, text in MODEL.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


@pytest.mark.parametrize(("changed", "matters"), [
    ("toy/solver/closed_forms/cuboid.py", True), ("toy/problems/magnetostatics.pro", True),
    ("toy/solver/field.py", True), ("toy/report/page.html.j2", False),
    ("toy/report/page.py", False)])
def test_only_what_is_imported_counts(toy, changed, matters):
    before = digest(toy)
    path = toy / changed
    path.write_text(path.read_text() + "# another formula\n")
    assert (digest(toy) != before) == matters


def test_the_response_depends_on_solver_and_problems_but_not_on_pages():
    names = {f"{path.parent.name}/{path.name}" for path in sources("halbach_fe.response.matrix")}
    assert {"geo/extruded.py", "pro/azimuthal_modes.pro", "pro/case.pro.j2",
            "stats/linear_gaussian.py", "solver/exact_block_field.py"} <= names
    assert not any(name.startswith(("report/", "cli/", "diagnosis/")) for name in names)


def test_chains_depend_on_the_sampler_too():
    names = {path.name for path in sources("halbach_fe.inference.mcmc")}
    assert {"pcn.py", "nonlinear.py", "matrix.py", "magnetostatics_2d.pro"} <= names
