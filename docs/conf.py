"""Sphinx settings; the reference is written from the code before every build."""

import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from generate import write_reference

project = "halbach-fe"
release = metadata.version("halbach-fe")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon",
              "sphinx.ext.mathjax"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
autosummary_generate = True
autodoc_typehints = "description"
napoleon_google_docstring = False
html_theme = "furo"
html_title = f"halbach-fe {release}"
suppress_warnings = ["ref.python"]  # words of shapes are no cross-references
exclude_patterns = ["_build"]


def setup(app):
    """Write what is generated."""
    app.connect("builder-inited", lambda app: write_reference(Path(app.srcdir) / "reference"))
