"""Sphinx settings; the reference is written from the code before every build."""

import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from docutils import nodes
from generate import write_reference
from latex2mathml.converter import convert

project = "halbach-fe"
release = metadata.version("halbach-fe")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
autosummary_generate = True
autodoc_typehints = "description"
napoleon_google_docstring = False
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["formulas.css"]
html_theme = "furo"
html_title = f"halbach-fe {release}"
suppress_warnings = ["ref.python"]  # words of shapes are no cross-references
exclude_patterns = ["_build"]


def inline(translator, node):
    """A formula as MathML, which browsers draw without a network."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def block(translator, node):
    """A formula on a line of its own."""
    translator.body.append(convert(node.astext(), display="block"))
    raise nodes.SkipNode


def setup(app):
    """Write what is generated; draw formulas."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.connect("builder-inited", lambda app: write_reference(Path(app.srcdir) / "reference"))
