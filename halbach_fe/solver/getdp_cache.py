"""GetDP's answers, kept by all that they depend on.

An entry is a folder, named by the SHA-256 of everything GetDP was given: the files of its run
folder (mesh, problem, generated part), the options and constants of the job, and GetDP's version
and build. It holds what GetDP wrote, and a manifest with the SHA-256 of every file; those are
compared whenever it is used. Entries appear whole (a rename) and belong to nobody, so that several
processes may share a cache. When it is larger than its limit, the entries that were not used for
longest go.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError

from halbach_fe.core.errors import HalbachWarning, OutputError
from halbach_fe.core.temporary_files import remove_orphans, temporary_name
from halbach_fe.solver.getdp import LOG_NAME, GetDP, Job

FOLDER_VARIABLE = "HALBACH_FE_CACHE"
LIMIT_VARIABLE = "HALBACH_FE_CACHE_LIMIT_GIB"
DEFAULT_LIMIT_GIB = 20.0
MANIFEST = "manifest.json"


class Kept(BaseModel):
    """A file of an entry."""

    model_config = ConfigDict(extra="forbid", strict=True)
    bytes: NonNegativeInt
    sha256: str


class Manifest(BaseModel):
    """What an entry holds, and of what."""

    model_config = ConfigDict(extra="forbid", strict=True)
    problem: str
    resolution: str
    unknowns: int | None
    solves: int
    getdp: str
    files: dict[str, Kept]


@dataclass(frozen=True)
class Stored:
    """An entry as `Cache.entries` finds it: its size, and when it was used, in s since 1970."""

    folder: Path
    bytes: int
    used: float

    @property
    def manifest(self) -> Manifest | None:
        """What it says of itself; None if that cannot be read."""
        return _manifest(self.folder)


@dataclass(frozen=True)
class Cache:
    """A folder of entries, and how large it may grow."""

    folder: Path
    limit_bytes: float = DEFAULT_LIMIT_GIB * 2**30

    def entry(self, getdp: GetDP, job: Job, run_folder: Path) -> Entry:
        """The place of a job's answer; ``run_folder`` holds what GetDP will be given."""
        digest = hashlib.sha256()
        asked = asdict(job) | {"numbers": sorted(job.numbers.items())}
        del asked["time_limit_s"]  # an answer is the same whenever it comes
        said: list[object] = [getdp.version, *getdp.build_options, getdp.petsc]
        with contextlib.suppress(OSError):  # one of the same version may be built anew
            there = getdp.executable.stat()
            said += [there.st_size, there.st_mtime_ns]
        digest.update(json.dumps([asked, said], sort_keys=True).encode())
        given = sorted(path.name for path in run_folder.iterdir())
        for name in given:
            digest.update(f"{name} {_digest(run_folder / name)}".encode())
        key = digest.hexdigest()
        return Entry(self, self.folder / key[:2] / key, run_folder, frozenset(given), job,
                     getdp.version)

    def entries(self) -> list[Stored]:
        """All entries, those used last first."""
        found = []
        for folder in self._folders():
            try:
                size = sum(path.stat().st_size for path in folder.iterdir())
                used = (folder / MANIFEST).stat().st_mtime
            except OSError:  # another process has just removed it, or it is damaged
                size, used = 0, 0.0
            found.append(Stored(folder, size, used))
        return sorted(found, key=lambda one: -one.used)

    def clear(self) -> None:
        """Remove all entries."""
        for folder in self._folders():
            _remove(folder)

    def trim(self) -> None:
        """Remove entries until the rest is within the limit."""
        total = 0
        for one in self.entries():
            total += one.bytes
            if total > self.limit_bytes:
                _remove(one.folder)

    def _folders(self) -> Iterator[Path]:
        for folder in sorted(self.folder.glob("[0-9a-f][0-9a-f]")):
            remove_orphans(folder)
            with contextlib.suppress(OSError):
                yield from [path for path in sorted(folder.iterdir())
                            if re.fullmatch("[0-9a-f]{64}", path.name)]


@dataclass(frozen=True)
class Entry:
    """The place of one answer."""

    cache: Cache
    folder: Path
    run_folder: Path
    given: frozenset[str]
    job: Job
    version: str

    def restore(self, on_line: Callable[[str], None]) -> bool:
        """Put a stored answer into the run folder and show its log; tell whether there was one.

        One that is damaged is removed, with a warning.
        """
        if not os.path.isdir(self.folder):  # False too where it may not be looked at
            return False
        manifest = _manifest(self.folder)
        try:
            if manifest is None or LOG_NAME not in manifest.files:
                raise ValueError("its manifest cannot be read")
            for name, kept in manifest.files.items():
                if Path(name).name != name or name in self.given:
                    raise ValueError(f"it has a file {name!r}")
                shutil.copyfile(self.folder / name, self.run_folder / name)
                if _digest(self.run_folder / name) != kept.sha256:
                    raise ValueError(f"{name} is not what was stored")
        except (OSError, ValueError) as error:
            for path in self.run_folder.iterdir():
                if path.name not in self.given:
                    path.unlink()
            damaged = isinstance(error, ValueError | FileNotFoundError | IsADirectoryError)
            # otherwise another process has removed it meanwhile, or it cannot be had
            if damaged and os.path.isdir(self.folder):
                warnings.warn(f"An entry of the cache is damaged ({error}) and is computed again: "
                              f"{self.folder}", HalbachWarning, stacklevel=2)
                _remove(self.folder)
            return False
        with contextlib.suppress(OSError):  # it may be another's
            os.utime(self.folder / MANIFEST)
        log = (self.run_folder / LOG_NAME).read_text(encoding="utf-8")
        for line in log.splitlines()[1:]:  # the first has the options
            on_line(line)
        return True

    def store(self) -> bool:
        """Keep what GetDP wrote into the run folder, unless it is there already; tell whether the
        cache has grown.
        """
        if os.path.isdir(self.folder):
            return False
        written = [path for path in self.run_folder.iterdir() if path.name not in self.given]
        if sum(path.stat().st_size for path in written) > self.cache.limit_bytes:
            return False
        try:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            making = self.folder.with_name(  # of the mode that others may use it by
                temporary_name(self.folder.name[:8]) + uuid.uuid4().hex)
            making.mkdir()
            try:
                self._fill(making, written)
                making.rename(self.folder)
            finally:
                shutil.rmtree(making, ignore_errors=True)
        except OSError as error:
            if not os.path.isdir(self.folder):  # otherwise another process was faster
                warnings.warn(
                    f"Results are not kept in the cache {self.cache.folder} ({error.strerror}). "
                    f"Free some space, or name another folder in {FOLDER_VARIABLE}.",
                    HalbachWarning, stacklevel=2)
            return False
        return True

    def _fill(self, making: Path, written: list[Path]) -> None:
        files = {}
        for path in written:
            shutil.copyfile(path, making / path.name)
            files[path.name] = Kept(bytes=path.stat().st_size, sha256=_digest(path))
        manifest = Manifest(
            problem=self.job.problem, resolution=self.job.resolution, unknowns=self.job.unknowns,
            solves=self.job.solves, getdp=self.version, files=files)
        (making / MANIFEST).write_text(manifest.model_dump_json(indent=1), encoding="utf-8")


def default_cache(folder: Path | None = None) -> Cache | None:
    """The user's cache: in ``folder``, else as the environment says; None if its limit is 0.

    Raises
    ------
    OutputError
        If the limit in the environment is no number.
    """
    said = os.environ.get(LIMIT_VARIABLE, str(DEFAULT_LIMIT_GIB))
    try:
        limit = float(said)
    except ValueError:
        limit = -1.0
    if not limit >= 0:
        raise OutputError(f"{LIMIT_VARIABLE} must be the size of the cache in GiB, 0 for none; "
                          f"instead it is '{said}'.")
    if limit == 0:
        return None
    named = folder or os.environ.get(FOLDER_VARIABLE)
    if not named:
        home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
        if home.startswith("~"):  # some have no home
            return None
        named = Path(home, "halbach-fe")
    return Cache(Path(named), limit * 2**30)


def _manifest(folder: Path) -> Manifest | None:
    try:
        return Manifest.model_validate_json((folder / MANIFEST).read_bytes())
    except (OSError, ValidationError):
        return None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _remove(folder: Path) -> None:
    """Remove an entry, so that nobody ever sees a part of it."""
    going = folder.with_name(f"{temporary_name('going')}{time.monotonic_ns()}")
    try:
        folder.rename(going)
    except OSError:  # another process removes it
        return
    shutil.rmtree(going, ignore_errors=True)
