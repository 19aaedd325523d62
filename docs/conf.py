"""Sphinx settings.

The reference is written from the code before every build, and the examples as notebooks after it.
The table of contents stands here and not in index.md, which is read on GitHub too,
where a directive would be shown as text.
"""

import re
import sys
from importlib import metadata
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from docutils import nodes
from generate import write_notebooks, write_reference
from latex2mathml.converter import convert

project = "halbach-fe"
release = metadata.version("halbach-fe")
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_execution_timeout = 120  # in s, of a cell
autosummary_generate = True
autodoc_typehints = "description"
napoleon_google_docstring = False
napoleon_use_ivar = True  # an attribute whose default is a function is not documented twice
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["formulas.css"]
html_show_copyright = False
html_theme = "furo"
html_title = f"halbach-fe {release}"
# words of shapes are no cross-references; without execution no kernel tells a cell's language
suppress_warnings = ["ref.python", "myst-nb.lexer"]
exclude_patterns = ["_build"]

CONTENTS = {
    "Start": ("tutorial", "from-python", "coming-from", "questions", "glossary"),
    "Examples": ("examples", *(f"examples/{example}" for example in (
        "ring", "quadrupole", "mri", "magpylib", "iron", "undulator", "check", "register", "infer",
        "diagnose", "forces", "corner", "tolerance", "shim"))),
    "Gallery": ("gallery", *(f"gallery/{study}" for study in (
        "paper", "faser", "linear-3d", "nonlinear-2d", "quadrupole", "cubes", "mri", "mandhala",
        "mri4all", "mri-large", "emphatic", "hybrid-quadrupole", "mri-plates",
        "hybrid-undulator", "sensitivity", "calibration", "diagnosis"))),
    "How to": ("how-to/describe-your-magnet", "how-to/own-geometry", "how-to/own-steel",
               "how-to/own-effect", "how-to/own-map", "how-to/next-magnet", "how-to/many-cores",
               "how-to/cluster"),
    "In depth": ("study-file", "file-formats", "theory", "accuracy", "inference", "diagnosis",
                 "design", "simulated-campaigns", "scaling", "reliability", "security"),
    "Reference": ("reference/study", "reference/commands", "reference/python")}
"""Pages of the documentation, by caption in the sidebar."""


def inline(translator, node):
    """A formula as MathML, which browsers draw without a network."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def block(translator, node):
    """A formula on a line of its own."""
    translator.body.append(convert(node.astext(), display="block"))
    raise nodes.SkipNode


def add_contents(app, page, source):
    """Append the table of contents to the first page."""
    if page == app.config.root_doc:
        source[0] += "".join(
            "\n".join(["\n```{toctree}", ":hidden:", f":caption: {caption}\n", *pages, "```\n"])
            for caption, pages in CONTENTS.items())


def offer_notebook(app, page, source):
    """Let a page that is a notebook end with a link to it, see `write_notebooks`."""
    if page.startswith("examples/"):
        name = f"{page.partition('/')[2]}.ipynb"
        source[0] += f'\n\n<a href="{name}" download>Download this page as a notebook</a>\n'


def escape_bars(app, what, name, obj, options, lines):
    """Keep reStructuredText from taking the bars of an absolute value for a substitution."""
    lines[:] = [line if line.lstrip().startswith((">>>", "...")) else "".join(
        part if part.startswith("``") else part.replace("|", "\\|")
        for part in re.split(r"(``.*?``)", line)) for line in lines]


def setup(app):
    """Connect what writes the reference, adds the table of contents and draws formulas."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.connect("source-read", add_contents)
    app.connect("source-read", offer_notebook)
    app.connect("build-finished", lambda app, error: write_notebooks(
        Path(app.srcdir) / "examples", Path(app.outdir) / "examples"))
    app.connect("autodoc-process-docstring", escape_bars, priority=900)  # after napoleon
    app.connect("builder-inited", lambda app: write_reference(Path(app.srcdir) / "reference"))
