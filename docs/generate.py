"""Write the reference from the code: keys of a study, commands, the Python API. Write notebooks."""

from __future__ import annotations

import argparse
import inspect
from pathlib import Path

from halbach_fe.cli.verbs import VERBS, parser
from halbach_fe.study.model import Study

MODULES = (
    "study.reader", "study.model", "study.array_keys", "study.free_blocks", "study.iron_keys",
    "study.external_keys", "study.materials", "study.measurement_keys", "study.inference_keys",
    "geometry.magnet", "stats.gaussian", "stats.posteriors",
    "solver.exact_block_field", "solver.ring_harmonics_2d",
    "measurement.field_map", "measurement.block_table", "measurement.campaign_maps",
    "measurement.observation_operator",
    "response.response_matrix", "inference.infer", "inference.result",
    "diagnosis.diagnose", "diagnosis.result", "diagnosis.marginal_evidence",
    "diagnosis.effect_selection", "diagnosis.effects.base")
"""Modules documented after the API, in the order of the rooms."""


def write_notebooks(source: Path, folder: Path) -> None:
    """Write the pages of a folder that are notebooks in text as files of Jupyter."""
    import nbformat  # of the extra docs
    from myst_nb.core.read import read_myst_markdown_notebook
    from myst_parser.config.main import MdParserConfig

    folder.mkdir(parents=True, exist_ok=True)
    for page in source.glob("*.md"):
        notebook = read_myst_markdown_notebook(page.read_text(encoding="utf-8"), MdParserConfig())
        nbformat.write(notebook, folder / f"{page.stem}.ipynb")


def write_reference(folder: Path) -> None:
    """Write all generated pages into a folder; pages that have not changed are left alone."""
    folder.mkdir(parents=True, exist_ok=True)
    pages = {"study.md": study_page(), "commands.md": commands_page(),
             "python.md": python_page()}
    for path in folder.glob("*.md"):
        if path.name not in pages:  # of an earlier version
            path.unlink()
    for name, text in pages.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def study_page() -> str:
    """Every table and key of a study, from its JSON schema."""
    schema = Study.model_json_schema()
    parts = ["# Keys of a study", "Lengths are in m, flux densities in T, angles in degrees; "
             "unknown keys are errors. `halbach-fe schema` prints the same as JSON schema.",
             _table("Study", schema)]
    parts += [_table(name, one) for name, one in schema["$defs"].items()]
    return "\n\n".join(parts) + "\n"


def _table(name: str, schema: dict) -> str:
    rows = ["| key | type | default |", "|---|---|---|"]
    required = schema.get("required", [])
    for key, one in schema.get("properties", {}).items():
        default = "required" if key in required else f"`{one.get('default', 'none')}`"
        rows.append(f"| `{key}` | {_type(one)} | {default} |")
    text = inspect.cleandoc(schema.get("description", ""))
    return "\n\n".join(part for part in (f"## {name}", text, "\n".join(rows)) if part)


def _type(schema: dict) -> str:
    """A JSON schema's type in words."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "const" in schema:
        return f'`"{schema["const"]}"`'
    if "enum" in schema:
        return " or ".join(f"`{one!r}`".replace("'", '"') for one in schema["enum"])
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return " or ".join(_type(one) for one in schema[key] if one.get("type") != "null")
    if schema.get("type") == "array":
        if "prefixItems" in schema:
            return f"{len(schema['prefixItems'])} × {_type(schema['prefixItems'][0])}"
        return f"list of {_type(schema.get('items', {}))}"
    limits = [f"{sign} {schema[name]:g}" for name, sign in (
        ("minimum", "≥"), ("exclusiveMinimum", "\\>"), ("maximum", "≤"), ("exclusiveMaximum", "<"))
        if name in schema]
    return " ".join([schema.get("type", "any"), ", ".join(limits)]).strip()


def commands_page() -> str:
    """Help of every verb."""
    parts = ["# Commands"]
    actions = next(action for action in parser()._actions
                   if isinstance(action, argparse._SubParsersAction))
    for name in VERBS:
        actions.choices[name].formatter_class = lambda prog: argparse.RawDescriptionHelpFormatter(
            prog, width=96)
        parts.append(f"## {name}\n\n```text\n{actions.choices[name].format_help()}```")
    return "\n\n".join(parts) + "\n"


def python_page() -> str:
    """The Python API, which is the package itself, and then the modules it is made of."""
    parts = ["# Python", _module("halbach_fe", ":imported-members:")]
    parts += [_module(f"halbach_fe.{name}") for name in MODULES]
    return "\n\n".join(parts) + "\n"


def _module(name: str, *options: str) -> str:
    """A section with the docstrings of a module's public members."""
    lines = [f".. automodule:: {name}", "   :members:", *(f"   {option}" for option in options)]
    return "\n".join([f"## {name}\n", "```{eval-rst}", *lines, "```"])
