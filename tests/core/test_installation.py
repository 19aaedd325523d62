"""What is stored is computed again when a formula that it came from has changed, and only then.

What is missing is installed from where halbach-fe itself came from.
"""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import metadata
from types import SimpleNamespace

import pytest

from halbach_fe.core.errors import ExtraMissingError
from halbach_fe.core.installation import import_extra, install_command, sources

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
        [sys.executable, "-c", "from halbach_fe.core.installation import code_digest\n"
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
    names = {f"{path.parent.name}/{path.name}"
             for path in sources("halbach_fe.response.response_matrix")}
    assert {"geo/magnet_meshes.py", "pro/azimuthal_modes.pro", "pro/case.pro.j2",
            "stats/posteriors.py", "solver/exact_block_field.py"} <= names
    assert not any(name.startswith(("report/", "cli/", "diagnosis/")) for name in names)


def test_chains_depend_on_the_sampler_too():
    names = {path.name for path in sources("halbach_fe.inference.mcmc")}
    assert {"posteriors.py", "nonlinear.py", "response_matrix.py", "magnetostatics_2d.pro"} <= names


ORIGINS = {  # what pip wrote of the installation (PEP 610), and the command that adds an extra
    "index": (None, "pip install 'halbach-fe[campaign]'"),
    "clone": ({"url": "file:///home/a%20b/halbach-fe", "dir_info": {"editable": True}},
              "pip install -e '/home/a b/halbach-fe[campaign]'"),
    "folder": ({"url": "file:///src/halbach-fe", "dir_info": {}},
               "pip install '/src/halbach-fe[campaign]'"),
    "wheel": ({"url": "file:///w/halbach_fe-1.0.0-py3-none-any.whl", "archive_info": {}},
              "pip install 'halbach-fe[campaign] @ file:///w/halbach_fe-1.0.0-py3-none-any.whl'"),
    "repository": ({"url": "https://host/x.git", "vcs_info": {"vcs": "git", "commit_id": "1"}},
                   "pip install 'halbach-fe[campaign] @ git+https://host/x.git'"),
}


@pytest.mark.parametrize("origin", ORIGINS)
def test_the_command_names_the_place_of_the_installation(origin, monkeypatch):
    written, command = ORIGINS[origin]
    records = {"direct_url.json": json.dumps(written)} if written else {}
    monkeypatch.setattr(metadata, "distributions", lambda name: [
        SimpleNamespace(read_text={}.get), SimpleNamespace(read_text=records.get)])
    assert install_command("campaign") == command


def test_a_package_that_is_not_installed(monkeypatch):
    """One sentence says what it is for, and how to install it."""
    monkeypatch.setitem(sys.modules, "magpylib", None)
    with pytest.raises(ExtraMissingError, match=r"Simulated .*: pip install .*\[campaign"):
        import_extra("magpylib")
