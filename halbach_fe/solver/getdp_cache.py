"""A cache of results of GetDP, with all inputs of a run as the key.

An entry is a folder. Its name is the SHA-256 of all inputs of the run: the files of the run folder
(mesh, problem, generated data), the options and constants of the job, and the version and build of
GetDP. The entry holds the files that GetDP wrote, and a manifest with the SHA-256 of each of them,
which is verified whenever the entry is used. Entries are complete when they become visible (by a
rename), and no process owns them, so that several processes may share a cache. When the cache
exceeds its size limit, the least recently used entries are removed.

The hashes reveal damage, not malice: whoever may write into the cache can replace an answer
together with its hash. So a cache that other users may write to is refused unless the user trusts
them.
"""

from __future__ import annotations

import contextlib
import grp
import hashlib
import json
import os
import pwd
import re
import shutil
import stat
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError

from halbach_fe.core.errors import MAX_QUOTED, HalbachWarning, OutputError, printable
from halbach_fe.core.files import remove_orphans, temporary_name
from halbach_fe.solver.getdp import LOG_NAME, GetDP, Job

FOLDER_VARIABLE = "HALBACH_FE_CACHE"
"""Environment variable with the folder of the cache."""

LIMIT_VARIABLE = "HALBACH_FE_CACHE_LIMIT_GIB"
"""Environment variable with the size limit of the cache in GiB; 0 switches the cache off."""

TRUST_VARIABLE = "HALBACH_FE_CACHE_TRUSTED"
"""Environment variable that is 1 if a cache to which other users may write is used as well."""

DEFAULT_LIMIT_GIB = 20.0
MANIFEST = "manifest.json"


class Kept(BaseModel):
    """A file of an entry, as the manifest describes it."""

    model_config = ConfigDict(extra="forbid", strict=True)
    bytes: NonNegativeInt
    sha256: str


class Manifest(BaseModel):
    """The files of an entry, and a description of the run that wrote them."""

    model_config = ConfigDict(extra="forbid", strict=True)
    problem: str
    resolution: str
    unknowns: int | None
    solves: int
    getdp: str
    files: dict[str, Kept]


@dataclass(frozen=True)
class Stored:
    """An existing entry."""

    folder: Path
    bytes: int
    """Size of all its files."""
    used: float
    """Time of the last use in s since 1970."""

    @property
    def manifest(self) -> Manifest | None:
        """The manifest of the entry; None if it cannot be read."""
        return _manifest(self.folder)


@dataclass(frozen=True)
class Cache:
    """A folder of entries, and the limit of its size in bytes."""

    folder: Path
    limit_bytes: float = DEFAULT_LIMIT_GIB * 2**30

    def entry(self, getdp: GetDP, job: Job, run_folder: Path) -> Entry:
        """Return the entry of a job, whether it exists already or not.

        ``run_folder`` must hold exactly the input files of the run.
        """
        digest = hashlib.sha256()
        settings = asdict(job) | {"numbers": sorted(job.numbers.items())}
        del settings["time_limit_s"]  # the result does not depend on it
        build: list[object] = [getdp.version, *getdp.build_options, getdp.petsc]
        with contextlib.suppress(OSError):  # the same version may be compiled again
            status = getdp.executable.stat()
            build += [status.st_size, status.st_mtime_ns]
        digest.update(json.dumps([settings, build], sort_keys=True).encode())
        given = sorted(path.name for path in run_folder.iterdir())
        for name in given:
            digest.update(f"{name} {_digest(run_folder / name)}".encode())
        key = digest.hexdigest()
        return Entry(self, self.folder / key[:2] / key, run_folder, frozenset(given), job,
                     getdp.version)

    def entries(self) -> list[Stored]:
        """Return all entries, the most recently used first."""
        entries = []
        for folder in self._folders():
            try:
                size = sum(path.stat().st_size for path in folder.iterdir())
                used = (folder / MANIFEST).stat().st_mtime
            except OSError:  # another process has just removed it, or it is damaged
                size, used = 0, 0.0
            entries.append(Stored(folder, size, used))
        return sorted(entries, key=lambda entry: -entry.used)

    def clear(self) -> None:
        """Remove all entries."""
        for folder in self._folders():
            _remove(folder)

    def trim(self) -> None:
        """Remove the least recently used entries until the rest is within the limit."""
        total = 0
        for entry in self.entries():
            total += entry.bytes
            if total > self.limit_bytes:
                _remove(entry.folder)

    def _folders(self) -> Iterator[Path]:
        """Yield the folders of all entries; remove what crashed processes left beside them."""
        for folder in sorted(self.folder.glob("[0-9a-f][0-9a-f]")):
            remove_orphans(folder)
            with contextlib.suppress(OSError):
                yield from [path for path in sorted(folder.iterdir())
                            if re.fullmatch("[0-9a-f]{64}", path.name)]


@dataclass(frozen=True)
class Entry:
    """The place in the cache for the result of one run."""

    cache: Cache
    folder: Path
    """Folder of the entry, which need not exist."""
    run_folder: Path
    """Folder of the run."""
    given: frozenset[str]
    """Names of the run's input files."""
    job: Job
    version: str
    """Version of GetDP."""

    def restore(self, on_line: Callable[[str], None]) -> bool:
        """Copy the stored result into the run folder; return False if there is none.

        ``on_line`` receives the lines of the stored log. A damaged entry is removed with a warning,
        and counts as missing.
        """
        if not os.path.isdir(self.folder):  # also False without the right to read the parent
            return False
        manifest = _manifest(self.folder)
        try:
            if manifest is None or LOG_NAME not in manifest.files:
                raise ValueError("its manifest cannot be read")
            for name, stored in manifest.files.items():
                if Path(name).name != name or name in self.given:
                    raise ValueError(f"it has a file {name!r}")
                shutil.copyfile(self.folder / name, self.run_folder / name)
                if _digest(self.run_folder / name) != stored.sha256:
                    raise ValueError(f"{name} is not what was stored")
        except (OSError, ValueError) as error:
            for path in self.run_folder.iterdir():
                if path.name not in self.given:
                    path.unlink()
            damaged = isinstance(error, ValueError | FileNotFoundError | IsADirectoryError)
            # otherwise another process has removed the entry meanwhile, or it may not be read
            if damaged and os.path.isdir(self.folder):
                warnings.warn(f"An entry of the cache is damaged ({error}) and is computed again: "
                              f"{self.folder}", HalbachWarning, stacklevel=2)
                _remove(self.folder)
            return False
        with contextlib.suppress(OSError):  # the entry may belong to another user
            os.utime(self.folder / MANIFEST)
        log = (self.run_folder / LOG_NAME).read_text(encoding="utf-8")
        for line in log.splitlines()[1:]:  # the first line has the options of the run
            on_line(line)
        return True

    def store(self) -> bool:
        """Store the files that GetDP wrote into the run folder; return whether the cache has grown.

        It does not grow if the entry exists already, exceeds the limit of the cache by itself, or
        cannot be written, which causes a warning.
        """
        if os.path.isdir(self.folder):
            return False
        written = [path for path in self.run_folder.iterdir() if path.name not in self.given]
        if sum(path.stat().st_size for path in written) > self.cache.limit_bytes:
            return False
        try:
            # whatever the umask, others may not write
            self.cache.folder.mkdir(0o755, parents=True, exist_ok=True)
            self.folder.parent.mkdir(0o755, exist_ok=True)
            # not by tempfile.mkdtemp, whose folders only their owner may read
            temporary = self.folder.with_name(
                temporary_name(self.folder.name[:8]) + uuid.uuid4().hex)
            temporary.mkdir()
            try:
                self._fill(temporary, written)
                temporary.rename(self.folder)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
        except OSError as error:
            if not os.path.isdir(self.folder):  # otherwise another process was faster
                warnings.warn(
                    f"Results are not kept in the cache {self.cache.folder} ({error.strerror}). "
                    f"Free some space, or name another folder in {FOLDER_VARIABLE}.",
                    HalbachWarning, stacklevel=2)
            return False
        return True

    def _fill(self, temporary: Path, written: list[Path]) -> None:
        """Copy files into a temporary folder, and write the manifest there."""
        files = {}
        for path in written:
            shutil.copyfile(path, temporary / path.name)
            files[path.name] = Kept(bytes=path.stat().st_size, sha256=_digest(path))
        manifest = Manifest(
            problem=self.job.problem, resolution=self.job.resolution, unknowns=self.job.unknowns,
            solves=self.job.solves, getdp=self.version, files=files)
        (temporary / MANIFEST).write_text(manifest.model_dump_json(indent=1), encoding="utf-8")


def default_cache(folder: Path | None = None) -> Cache | None:
    """Return the user's cache, or None if the limit in the environment is 0.

    ``folder``: folder of the cache; by default that of $HALBACH_FE_CACHE, else ``halbach-fe`` in
    $XDG_CACHE_HOME or ``~/.cache``. None is also returned if the user has no home folder.

    Raises
    ------
    OutputError
        If the limit in the environment is not a number of at least 0, or other users may write to
        the cache and $HALBACH_FE_CACHE_TRUSTED is not 1.
    """
    text = os.environ.get(LIMIT_VARIABLE, str(DEFAULT_LIMIT_GIB))
    try:
        limit = float(text)
    except ValueError:
        limit = -1.0
    if not limit >= 0:
        raise OutputError(f"Environment variable {LIMIT_VARIABLE} must be the size of the cache in "
                          f"GiB, 0 for no cache; instead received '{text}'. Correct or unset it.")
    if limit == 0:
        return None
    named = folder or os.environ.get(FOLDER_VARIABLE)
    if not named:
        home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        if home.startswith("~"):  # the user has no home folder
            return None
        named = Path(home, "halbach-fe")
    if Path(named).exists() and not Path(named).is_dir():
        raise OutputError(f"The cache {printable(named, MAX_QUOTED)} must be a folder, but is a "
                          "file. Name another folder.")
    if os.environ.get(TRUST_VARIABLE) != "1" and _others_may_write(Path(named)):
        raise OutputError(
            f"Other users may write to the cache {printable(named, MAX_QUOTED)}, so that its "
            f"answers may be made up. Set {TRUST_VARIABLE}=1 if you trust all of them, or name "
            f"another folder in {FOLDER_VARIABLE}.")
    return Cache(Path(named), limit * 2**30)


def _others_may_write(folder: Path) -> bool:
    """Tell whether a folder exists that users other than this one and root may write to.

    A group that has the user's name is the user's own, as most systems make one for every user.
    """
    try:
        status = folder.stat()
    except OSError:
        return False
    if status.st_uid not in (os.geteuid(), 0) or status.st_mode & stat.S_IWOTH:
        return True
    if not status.st_mode & stat.S_IWGRP or status.st_gid == 0:
        return False
    try:
        group, user = grp.getgrgid(status.st_gid), pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return True
    return group.gr_name != user or bool(set(group.gr_mem) - {user})


def _manifest(folder: Path) -> Manifest | None:
    """Return the manifest of an entry; None if it cannot be read."""
    try:
        return Manifest.model_validate_json((folder / MANIFEST).read_bytes())
    except (OSError, ValidationError):
        return None


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _remove(folder: Path) -> None:
    """Remove an entry, renamed first, so that no process ever sees an incomplete entry."""
    removed = folder.with_name(f"{temporary_name('going')}{time.monotonic_ns()}")
    try:
        folder.rename(removed)
    except OSError:  # another process removes it
        return
    shutil.rmtree(removed, ignore_errors=True)
