"""Names of unfinished files and folders, and removal of those that killed processes left behind.

Output appears complete or not at all: it is written under a temporary name in the same folder and
then renamed. A process that is killed cannot remove its unfinished output. The temporary name holds
the machine and the process number, so that a later process can tell that nobody works on it any
more.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import re
import shutil
import socket
import tempfile
import uuid
from pathlib import Path

_NAME = re.compile(r"\..+~(?P<host>[^~]+)~(?P<process>\d+)~")


def temporary_name(name: str) -> str:
    """Return the first part of a file's or folder's name while this process writes it."""
    return f".{name}~{_here()}~{os.getpid()}~"


def temporary_path(path: Path) -> Path:
    """Return a path in the same folder for a file or folder while this process writes it.

    Nobody can guess it, and put a link there that leads elsewhere. Whoever creates it himself, and
    does not use the module tempfile, gives it the permissions of the user's umask.
    """
    return path.with_name(f"{temporary_name(path.stem)}{uuid.uuid4().hex[:8]}{path.suffix}")


def folder_until_exit() -> Path:
    """Return a new folder that is removed when Python ends."""
    folder = Path(tempfile.mkdtemp(prefix="halbach-fe-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def remove_orphans(folder: Path) -> None:
    """Remove unfinished output from a folder if a process of this machine that has ended left it.

    Output of processes on other machines, which may share the folder, stays.
    """
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            match = _NAME.match(path.name)
            if match and match["host"] == _here() and not _runs(int(match["process"])):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)


def _here() -> str:
    """Return the name of the machine and of its process name space (containers have their own)."""
    with contextlib.suppress(OSError):
        return f"{socket.gethostname()}-{os.stat('/proc/self/ns/pid').st_ino}"
    return socket.gethostname()


def _runs(process: int) -> bool:
    """Tell whether a process of this number runs, as far as that can be known."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # another user's process, or an impossible number
        pass
    return True
