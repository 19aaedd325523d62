"""Gmsh sessions that leave no state behind: Gmsh's state is global to the process."""

from __future__ import annotations

import errno
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import gmsh

from halbach_fe.core.errors import HalbachError, MeshError
from halbach_fe.core.files import atomic, is_full

_GMSH_LOCK = threading.Lock()
"""Held during a session, because all threads of a process share one Gmsh."""


@contextmanager
def gmsh_session(name: str) -> Iterator[None]:
    """Run Gmsh without terminal output and with reproducible options, and finalize it at the end.

    Raises
    ------
    MeshError
        If Gmsh fails; Gmsh itself raises plain `Exception`.
    """
    with _GMSH_LOCK:
        yield from _session(name)


def _session(name: str) -> Iterator[None]:
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                signal.signal(number, handler)  # gmsh.initialize replaced them
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("General.NumThreads", 1)  # the same mesh on every machine
        gmsh.option.setNumber("Mesh.MshFileVersion", 2.2)  # the newest that GetDP 3.2 reads
        gmsh.option.setNumber("Mesh.Binary", 1)
        gmsh.model.add(name)
        yield
    except HalbachError:
        raise
    except Exception as error:
        if "alloc" in str(error):  # C++ says std::bad_alloc
            raise MemoryError(f"Gmsh: {error}") from None
        raise MeshError(
            f"Gmsh could not mesh study '{name}': {error}. Check radii, gaps and element sizes."
        ) from error
    finally:
        gmsh.finalize()


def write_mesh(path: Path) -> None:
    """Write the current model atomically: the file appears complete or not at all.

    Raises
    ------
    OutputError
        If it cannot be written. Gmsh itself does not notice a full disk.
    """
    with atomic(path) as temporary:
        gmsh.write(str(temporary))
        with temporary.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(-min(size, 32), os.SEEK_END)
            if not file.read().rstrip().endswith(b"$EndElements"):
                number = errno.ENOSPC if is_full(path.parent) else errno.EFBIG
                raise OSError(number, f"{os.strerror(number)}; only {size} bytes could be written")
