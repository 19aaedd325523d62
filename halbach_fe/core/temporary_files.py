"""Names of files and folders in the making, and what is left of them when a process was killed.

Whatever is written appears whole or not at all: it is made under a name of its own beside its
place, and renamed. A process that is killed cannot tidy up; who comes next sees by the name that
nobody works on it any more.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import socket
from pathlib import Path

_NAME = re.compile(r"\..+~(?P<host>[^~]+)~(?P<process>\d+)~")


def temporary_name(name: str) -> str:
    """How the name of something begins while this process is making it."""
    return f".{name}~{_here()}~{os.getpid()}~"


def remove_orphans(folder: Path) -> None:
    """Remove what processes of this machine that are gone were making in a folder."""
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            match = _NAME.match(path.name)
            if match and match["host"] == _here() and not _runs(int(match["process"])):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)


def _here() -> str:
    """The machine, and the name space of its process numbers: a container has its own."""
    with contextlib.suppress(OSError):
        return f"{socket.gethostname()}-{os.stat('/proc/self/ns/pid').st_ino}"
    return socket.gethostname()


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # another's, or no number of a process
        pass
    return True
