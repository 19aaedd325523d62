"""A digest of the program's own text, by which stored results are known to be of older code.

A response matrix or a chain that an earlier version of a formula computed must not be reused. Which
files it depends on is found from the import statements themselves, so that no list of folders can
go out of date.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path


@lru_cache(maxsize=8)
def code_digest(module: str) -> bytes:
    """SHA-256 of a module and of all that it imports from its own package, however indirectly.

    Where a package is imported, the data files beside its ``__init__`` (templates, GetDP problems)
    count as well.

    Examples
    --------
    >>> len(code_digest("halbach_fe.core.code_digest"))
    32
    """
    digest = hashlib.sha256()
    for path in sources(module):
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)}\n".encode())
        digest.update(content)
    return digest.digest()


def sources(module: str) -> list[Path]:
    """Files that `code_digest` reads, sorted by the names of their modules."""
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
    """The file of a module; None if the name is that of a class or function within one."""
    parent = module.rpartition(".")[0]
    if parent:
        inside = _path_of(parent)
        if inside is None or inside.name != "__init__.py":
            return None
    spec = importlib.util.find_spec(module)
    return None if spec is None or spec.origin is None else Path(spec.origin)


def _imported(path: Path, name: str) -> Iterator[str]:
    """Modules that a file may import, at its top or inside functions, in absolute imports."""
    for node in ast.walk(ast.parse(path.read_bytes(), filename=name)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
