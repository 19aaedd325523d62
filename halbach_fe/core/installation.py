"""What is installed: a digest of the program's own source code, versions of packages, and extras.

The digest reveals results that older code computed. A response matrix or a Markov chain that an
earlier version of a formula computed must not be reused. The files that a result depends on are
found from the import statements themselves, so that no hand-written list of folders can go out of
date. Extras are optional packages; an error names the command that installs them.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
from functools import cache, lru_cache
from importlib import import_module, metadata
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from halbach_fe.core.errors import ExtraMissingError


@lru_cache(maxsize=8)
def code_digest(module: str) -> bytes:
    """Return the SHA-256 of a module and of all modules of its package that it imports.

    Indirect imports count too. Where a package is imported, the digest also covers the data files
    beside its ``__init__`` (templates, GetDP problems).

    Examples
    --------
    >>> len(code_digest("halbach_fe.core.installation"))
    32
    """
    digest = hashlib.sha256()
    for path in sources(module):
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)}\n".encode())
        digest.update(content)
    return digest.digest()


def sources(module: str) -> list[Path]:
    """Return the files that `code_digest` reads, sorted by the names of their modules."""
    package = module.partition(".")[0]
    found: dict[str, Path] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name in found or name.partition(".")[0] != package:
            continue
        path = _path_of(name)
        if path is None:
            continue
        found[name] = path
        waiting += _imported(path, name)
        waiting.append(name.rpartition(".")[0])
    files = []
    for name in sorted(found):
        files.append(found[name])
        if found[name].name == "__init__.py":
            files += sorted(path for path in found[name].parent.iterdir()
                            if path.is_file() and path.suffix not in (".py", ".pyc"))
    return files


def _path_of(module: str) -> Path | None:
    """Return the file of a module, or None if the name is that of a class or function."""
    parent = module.rpartition(".")[0]
    if parent:
        inside = _path_of(parent)
        if inside is None or inside.name != "__init__.py":
            return None
    spec = importlib.util.find_spec(module)
    return None if spec is None or spec.origin is None else Path(spec.origin)


@cache
def _imported(path: Path, name: str) -> tuple[str, ...]:
    """Return the names that a file imports absolutely, at its top or inside functions.

    From ``from a import b`` both ``a`` and ``a.b`` follow, because ``b`` may be a module. Imports
    for type checkers (``if TYPE_CHECKING``) do not count: they are never executed. An import is a
    statement, so that the expressions, most of the tree, need not be searched.
    """
    found: list[str] = []
    waiting: list[ast.AST] = [ast.parse(path.read_bytes(), filename=name)]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            waiting += node.orelse
        elif isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.module:
                found += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            for block in ("body", "orelse", "finalbody", "handlers", "cases"):
                waiting += getattr(node, block, [])
    return tuple(found)


@cache
def version(package: str) -> str:
    """Return the version of an installed package, read once: its metadata take 5 ms to parse."""
    return metadata.version(package)


_CAMPAIGN = "Simulated campaigns, and magnets of magpylib, need magpylib and NGSolve"


def install_command(extra: str) -> str:
    """Return the command that adds an extra to halbach-fe from where it was installed (PEP 610).

    A clone or a wheel is named by its own place: an index of packages may not hold it.
    """
    # a folder of sources on the path has records of its own, without the place
    records = (one.read_text("direct_url.json") for one in metadata.distributions(
        name="halbach-fe"))
    origin = json.loads(next(filter(None, records), "{}"))
    url = origin.get("url", "")
    if "dir_info" in origin:
        editable = "-e " if origin["dir_info"].get("editable") else ""
        return f"pip install {editable}'{unquote(urlsplit(url).path)}[{extra}]'"
    if "vcs_info" in origin:
        url = f"{origin['vcs_info']['vcs']}+{url}"
    return f"pip install 'halbach-fe[{extra}]{' @ ' if url else ''}{url}'"


def import_extra(module: str, extra: str = "campaign", purpose: str = _CAMPAIGN) -> Any:
    """Import a module of an optional extra by its name; `purpose` begins the error's sentence.

    Raises
    ------
    ExtraMissingError
        If the module, or one that it needs, is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ExtraMissingError(
            f"{purpose}, but {error.name or module} cannot be imported here. Install what is "
            f"missing: {install_command(extra)}") from None
