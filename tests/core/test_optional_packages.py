"""What is missing is installed from where halbach-fe itself came from."""

import json
import sys
from importlib import metadata
from types import SimpleNamespace

import pytest

from halbach_fe.core.errors import ExtraMissingError
from halbach_fe.core.optional_packages import import_extra, install_command

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
