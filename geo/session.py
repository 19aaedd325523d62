"""One private Gmsh session: Gmsh keeps global state, so nothing of it may leak."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import gmsh

from halbach_fe.core.errors import HalbachError, MeshError

_ALONE = threading.Lock()
"""There is one Gmsh in a process, whatever its threads would like."""


@contextmanager
def gmsh_session(name: str) -> Iterator[None]:
    """Start Gmsh quietly and reproducibly, and stop it whatever happens.

    Raises
    ------
    MeshError
        In place of Gmsh's bare exceptions.
    """
    with _ALONE:
        yield from _session(name)


def _session(name: str) -> Iterator[None]:
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                signal.signal(number, handler)  # Gmsh resets them
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)  # the same mesh on every machine
        gmsh.option.setNumber("Mesh.MshFileVersion", 2.2)  # the newest that GetDP reads here
        gmsh.option.setNumber("Mesh.Binary", 1)
        gmsh.model.add(name)
        yield
    except HalbachError:
        raise
    except Exception as error:  # gmsh raises plain Exception
        raise MeshError(
            f"Gmsh could not mesh study '{name}': {error}. Check radii, gaps and element sizes."
        ) from error
    finally:
        gmsh.finalize()


def write_mesh(path: Path) -> None:
    """Write the current model; the file appears whole or not at all."""
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        gmsh.write(str(temporary))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
