"""A folder of results belongs to one command and one study, and to one run at a time.

The file run.json in the folder names both, what the run read, and the results that runs have
written there. A study is known by its name and its file: two files of one name are two studies, but
a file may be changed. A later run of the same command and study replaces the results, and removes
those that it did not write again: a table that the study no longer asks for would pass for a result
of the study as it is. Another command or study is refused, and so is a folder with any other file
of a name that the command writes, or with a result that somebody has changed. While a run goes on,
it locks the file; functions of the Python interface lock it too. A single file, which some commands
write, has its record beside it, see `single_file`.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from fnmatch import fnmatch
from io import BufferedReader
from pathlib import Path
from typing import Annotated, BinaryIO

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError
from pydantic_core import from_json

from halbach_fe.core.errors import MAX_QUOTED, OutputError, must_be, printable
from halbach_fe.core.files import is_told, make_folder, telling
from halbach_fe.core.numbers import first_of

RECORD = "run.json"

KEPT = ("*.msh", "*regions.json", "response.h5", "response-*.npy", "chains.nc",
        "[0-9][0-9][0-9][0-9]-*.json")
"""Files that a later run may read instead of writing them again. The last are results of sealed
cases, which are read as they are; each of the others is verified when it is read."""

_OF_RUNS = ("mesh.msh", "meridian.msh", "iron.msh", "regions.json", "meridian-regions.json",
            "iron-regions.json", "response.h5", "response-*.npy", "chains.nc", "getdp-*")
"""Those of them that a command writes into its folder itself, and the folders of GetDP's runs."""

WRITES = {
    "solve": ("field_map.*", "readings.csv", "multipoles.csv", "report.html", "geometry.png",
              "field.png", "stray_field.png"),
    "infer": ("posterior.h5", "prediction.csv", "summary.json", "sampled.json", "sampled.csv",
              "multipoles.csv", "study.updated.toml", "report.html", "blocks.png",
              "contraction.png", "maps.png", "profile*.png", "quantiles.png", "relative_error.png",
              "residual*.png", "stray_field.png"),
    "diagnose": ("diagnosis.json", "diagnosis.html", "diagnosis_*.png", "study.diagnosed.toml",
                 "blocks.csv"),
    "verify": ("verification.*", "verification_*.png"),
    "multipoles": ("multipoles.*", "multipoles_*.png"),
    "homogeneity": ("homogeneity.*", "harmonics.csv", "harmonics.png", "stray_field.png"),
    "forces": ("forces.*",), "field": (
        "field.*", "field_map.csv", "integrals.csv", "kick_map.txt"),
    "design": ("design.json", "design.html", "rings.csv", "rings.png", "front.png", "slices.png",
               "study.designed.toml"),
    "cad": ("blocks.step", "blocks.stl", "holder*.step", "holder*.stl", "magnet.step",
            "assembly.*"),
    "plan": ("plan.*", "plan_*.png"),
    "prior": ("prior.*", "prior_*.png"),
    "shim": ("shim.*", "shim_*.png", "study.shimmed.toml"),
    "shim-tray": ("shim_tray.*", "before.png", "after.png", "study.filled.toml",
                  "free_blocks.csv"),
    "sort": ("sort.*", "sort_*.png", "blocks.sorted.csv"),
    "tolerance": ("tolerance.*", "tolerance_*.png"),
    "demagnetization": ("demagnetization.*", "demagnetization_*.png"),
    "simulate-measurement": ("blocks.csv", "map.csv", "map.h5", "held-out.csv", "held-out.h5",
                             "truth/truth.json", "campaign.html", "campaign_*.png"),
    "check": ("check.*", "check_*.png", "oriented_map.csv", "inner_map.csv",
              "corrected_map.csv", "joined.*", "*/check.*", "*/check_*.png", "*/*_map.csv",
              "*/page.json"),
    "register": ("registration.*", "*/registration.*", "*/page.json", "study.registered.toml"),
    "report": ("report.html",)}
"""Names of the results of every command, beside page.json: what it must not find in its folder
unless it is its own. A name that is missing here is refused only as it is written."""


RUNS = "getdp-"
"""Beginning of the names of run folders of GetDP."""

_HELD: ContextVar[tuple[Path, ...]] = ContextVar("held", default=())
"""The folders that this run, or this thread, has locked."""


def _inside(name: str) -> str:
    """Return the path of a file, relative to the folder of results, if it is inside of it."""
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise ValueError("not in the folder")
    return name


class Record(BaseModel):
    """The content of run.json."""

    model_config = ConfigDict(extra="forbid")
    command: str
    study: str
    """What the folder belongs to; ``study`` is empty for a command without a study."""
    files: dict[Annotated[str, AfterValidator(_inside)], str] = {}
    """SHA-256 of every result, by its path within the folder."""
    inputs: dict[str, str] = {}
    """SHA-256 of every file that the run was given, by its path."""
    named: dict[str, str] = {}
    """Path of an input by the word that stands for it in commands: STUDY, MAP, BLOCKS,
    POSTERIOR."""
    ended: str = ""
    """When the run ended, in ISO 8601 (UTC); empty until it has ended well."""
    kept: list[Annotated[str, AfterValidator(_inside)]] | None = None
    """Those of the files `KEPT` that runs have written; None in records of earlier versions."""
    writing: dict[Annotated[str, AfterValidator(_inside)], str] = {}
    """SHA-256 of a result that is about to appear. A run that is killed then leaves it, or the one
    before it."""


@dataclass(frozen=True)
class Results:
    """The results of a run that has ended."""

    folder: Path
    record: Record

    def read(self, name: str, most_bytes: int) -> bytes:
        """Return the content of a result.

        Raises
        ------
        OSError
            If the file cannot be read.
        ValueError
            If it is no result of the run, lies behind a link, or is larger than ``most_bytes``.
        """
        if name not in self.record.files:
            raise ValueError(f"{name} is no result of this run")
        if not (self.folder / name).resolve().is_relative_to(self.folder.resolve()):
            raise ValueError(f"{name} is not in the folder")
        with _regular(self.folder / name) as file:
            content = file.read(most_bytes + 1)
        if len(content) > most_bytes:
            raise ValueError(f"it has more than {most_bytes} bytes")
        return content

    def removed(self) -> list[str]:
        """Return the results that somebody has removed."""
        return [name for name in self.record.files if not (self.folder / name).exists()]

    def changed(self) -> list[str]:
        """Return the results that somebody has changed, or put something else in place of."""
        found = []
        for name, digest in self.record.files.items():
            try:
                with _regular(self.folder / name) as file:
                    same = hashlib.file_digest(file, "sha256").hexdigest() == digest
            except FileNotFoundError:  # it was removed
                continue
            except (OSError, ValueError):
                same = False
            if not same:
                found.append(name)
        return found


class _Writer:
    """Renames complete files in a folder, and records them; refuses to replace any others.

    Attributes
    ----------
    base : Path
        The folder, as an absolute path.
    record : Record
    other : str
        What a user who is refused may name another of: folder or file.
    file : BinaryIO, optional
        The open record; without it nothing can be written, but `refuse` works.
    written : set of str
        Names of the results of this run.
    """

    def __init__(
        self, base: Path, record: Record, other: str, file: BinaryIO | None = None
    ) -> None:
        self.base, self.record, self.other, self.file = base, record, other, file
        self.written: set[str] = set()

    @contextlib.contextmanager
    def __call__(self, path: Path, temporary: Path) -> Iterator[None]:
        """Record a file as the block renames it."""
        path, record = path.absolute(), self.record
        if not path.is_relative_to(self.base):
            yield
            return
        self.refuse([path])
        name = str(path.relative_to(self.base))
        if _is_kept(path):
            if record.kept is not None and name not in record.kept:
                record.kept.append(name)
                self.save()
            yield
            return
        record.writing[name] = _digest(temporary) or ""
        self.save()
        yield
        record.files[name] = record.writing.pop(name)
        self.written.add(name)
        self.save()

    def save(self) -> None:
        """Write the record in its place, by one call of the system: a run may be killed any time.

        A renamed file would lose the lock. What is left of a longer record is blank.
        """
        assert self.file is not None
        try:
            content = self.record.model_dump_json(indent=1).encode() + b"\n"
            padded = content.ljust(os.fstat(self.file.fileno()).st_size)
            self.file.seek(0)
            if self.file.write(padded) < len(padded):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self.file.truncate(len(content))
        except OSError as error:
            raise OutputError(f"Cannot write {self.file.name}: {error.strerror}.") from None

    def refuse(self, paths: Iterable[Path]) -> None:
        """Raise OutputError if this run would replace what no run of its own has written."""
        foreign = [path for path in paths if os.path.lexists(path) and not self._owns(path)]
        if not foreign:
            return
        names = [str(path.relative_to(self.base)) for path in foreign]
        changed = set(names) <= self.record.files.keys()
        most_named = 5  # files of a refusal
        raise OutputError(
            f"File {first_of(names, most_named)} in folder {self.base} "
            + (f"changed after `{self.record.command}` had written it" if changed else
               f"was not written by `{self.record.command}`")
            + f", which would replace it. Name another {self.other}, or move this elsewhere.")

    def _owns(self, path: Path) -> bool:
        """Tell whether runs have written what is at a path, and nobody has changed it since."""
        name, record = str(path.relative_to(self.base)), self.record
        if path.name.startswith(RUNS):
            return is_run_folder(path)
        if path.is_symlink() or not path.is_file():
            return False
        if _is_kept(path):
            return (record.kept is None or name in record.kept or _is_of_another(path, self.base)
                    or _is_of_a_run(path))
        own = [known[name] for known in (record.files, record.writing) if name in known]
        return bool(own) and _digest(path) in own

    def remove_stale(self) -> None:
        """Remove the results of earlier runs that this run, which has ended, did not write."""
        for name in self.record.files.keys() - self.written:
            # else somebody has changed it
            if _digest(self.base / name) == self.record.files.pop(name):
                (self.base / name).unlink(missing_ok=True)
        self.record.ended = datetime.now(UTC).isoformat(timespec="seconds")
        self.save()


@contextlib.contextmanager
def result_folder(
    folder: Path, command: str, study: str, inputs: Iterable[Path] = (),
    named: Mapping[str, Path] = {}, solving: bool = False,
) -> Iterator[None]:
    """Own a folder while the block writes results of a command and a study into it.

    ``named`` are those of the inputs that commands name, see `Record`. A block that is ``solving``
    writes meshes, matrices and run folders of GetDP too.

    If the block succeeds, results of earlier runs that it did not write again are removed, unless
    somebody has changed them since.

    Raises
    ------
    OutputError
        If the folder cannot be written, another run is using it, it belongs to another command,
        study or study file, one of the files ``inputs`` is a result in it, which this run would
        replace, or it has another file of a name that the command writes.
    """
    base, inputs = folder.absolute(), list(inputs)
    with _locked(folder) as file:
        before = _read_or_refuse(file, folder / RECORD)
        if before is None or not any(
                (folder / name).exists() for name in (*before.files, *before.writing)):
            before = Record(command=command, study=study, kept=before.kept if before else [])
        if (before.command, before.study) != (command, study):
            of_study = f" of study {before.study}" if before.study else ""
            raise OutputError(
                f"Folder {folder} holds results of `{before.command}`{of_study}. A folder belongs "
                "to one command and one study, so that results are not mixed up. Name another "
                "folder, or remove this one.")
        if other := _other_study(before, named):
            raise OutputError(
                f"Folder {folder} holds results of `{before.command}` of another study file, "
                f"{other}, whose name is {study} too, but not its content. A folder belongs to "
                "one study, so that results are not mixed up. Name another folder, or remove this "
                "one.")
        for path in inputs:
            if any(path.resolve() == (base / name).resolve() for name in before.files):
                raise OutputError(
                    f"Input {path} is a result of an earlier run in folder {folder}, which this "
                    "run would replace. Name another folder, or copy the input to another place.")
        writer = _Writer(base, before.model_copy(deep=True), "folder", file)
        every = tuple(name for names in WRITES.values() for name in names)
        results = WRITES.get(command.removeprefix("halbach-fe "), every)  # a study's own writes any
        writer.refuse(_writable_paths(base, (*results, "page.json"), solving))
        writer.record.inputs, writer.record.ended = _inputs(inputs), ""
        writer.record.named = {
            word: printable(path, MAX_QUOTED) for word, path in named.items()}
        writer.save()
        with telling(writer):
            try:
                yield
            except BrokenPipeError:  # nobody reads what is printed, but all files are written
                writer.remove_stale()
                raise
        writer.remove_stale()


def _other_study(before: Record, named: Mapping[str, Path]) -> str:
    """Return the study file of an earlier run if that is another one than that of this run.

    A study may be changed, moved, or copied as it is; a file that is there beside this one, with
    another content, is another study. It is empty if nothing says so.
    """
    earlier, now = before.named.get("STUDY", ""), named.get("STUDY")
    if not earlier or now is None or before.inputs.get(earlier) in (None, _digest(now)):
        return ""
    there = os.path.lexists(earlier)
    same = Path(earlier).resolve() == now.resolve() if there else Path(earlier).name == now.name
    return "" if same else earlier


def _writable_paths(base: Path, results: Sequence[str], solving: bool) -> Iterator[Path]:
    """Yield the paths in a folder of results, and of what a block that is ``solving`` writes.

    A folder within that has a record of its own belongs to another run.
    """
    for name in (*results, *(_OF_RUNS if solving else ())):
        if "*" not in name:
            yield base / name
        else:
            yield from (path for path in sorted(base.glob(name))
                        if path.parent == base or not (path.parent / RECORD).exists())


def is_run_folder(path: Path) -> bool:
    """Tell whether a path is the folder of a run of GetDP, which has a problem in it."""
    return path.is_dir() and not path.is_symlink() and any(path.glob("*.pro"))


@contextlib.contextmanager
def single_file(path: Path, command: str, *beside: Path) -> Iterator[None]:
    """Let a command write one file in the block, but replace only one that it has written itself.

    The same holds for files ``beside`` it, in the same folder. Each is known by its SHA-256 in a
    note of its own, in a hidden folder of each command; earlier versions wrote the notes of all
    files into one. Within a run that has a record of its own, that decides.

    Raises
    ------
    OutputError
        If the file is a result of a run or a folder, or the command has not written it as it is.
    """
    if path.is_dir():
        raise OutputError(must_be("output", f"`{command}`", "a file", f"the folder '{path}'",
                                  "Name a file in it, with its suffix."))
    if is_told():
        yield
        return
    for one in (path, *beside):
        keep_results(one)
    whole = path.absolute()
    notes = whole.with_name(f".{command.replace(' ', '-')}")

    def note_of(one: Path) -> Path:
        """Return the path of the note about a file."""
        return notes / f"{hashlib.sha256(os.fsencode(one.name)).hexdigest()[:32]}.json"

    def noted_before(one: Path) -> Record:
        """Return the record of a file that has no note of its own."""
        there = os.path.lexists(one)
        earlier = _record_at(notes.with_name(f"{notes.name}.json")) if there else None
        files, writing = ({name: digest for name, digest in known.items() if name == one.name}
                          for known in ((earlier.files, earlier.writing) if earlier else ({}, {})))
        return Record(command=command, study="", kept=[], files=files, writing=writing)

    for one in (whole, *(other.absolute() for other in beside)):
        _Writer(whole.parent, _record_at(note_of(one)) or noted_before(one), "file").refuse([one])

    @contextlib.contextmanager
    def writing(target: Path, temporary: Path) -> Iterator[None]:
        target = target.absolute()
        if target.parent != whole.parent:
            yield
            return
        if notes.is_symlink():
            raise OutputError(f"Cannot write into {notes}, which is a link. Remove it.")
        note = make_folder(notes) / note_of(target).name
        with _opened(note, wait=True) as file:
            record = _read_or_refuse(file, note) or noted_before(target)
            with _Writer(whole.parent, record, "file", file)(target, temporary):
                yield

    with telling(writing):
        yield


@contextlib.contextmanager
def finished_results(folder: Path) -> Iterator[Results]:
    """Yield the results in a folder, and keep runs out of it while the block reads them.

    Raises
    ------
    OutputError
        If it is no folder of results, a run is using it, or its last run has not ended well.
    """
    def refused(expected: str, received: str, hint: str) -> OutputError:
        return OutputError(must_be("DIR", "the report", expected, f"{folder}, {received}", hint))

    expected, leave = f"a folder of results, with {RECORD}", "Leave it out."
    if not folder.is_dir():
        raise refused(expected, "a file" if folder.exists() else "which does not exist", leave)
    try:
        number = os.open(folder / RECORD,
                         os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise refused(expected, f"which has no {RECORD}", leave) from None
    except OSError as error:
        raise refused(expected, f"whose {RECORD} cannot be read ({error.strerror})",
                      leave) from None
    with os.fdopen(number, "rb") as file:
        try:
            fcntl.flock(number, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(f"Folder {folder} is in use by a run of halbach-fe. Wait for it, or "
                              "leave it out.") from None
        except OSError:  # this file system has no locks
            pass
        regular = stat.S_ISREG(os.fstat(number).st_mode)
        record = _read(file) if regular else None
        if record is None:
            raise refused(expected, f"whose {RECORD} is damaged or of another program", leave)
        if not record.ended:
            raise refused("the results of a run that has ended",
                          f"where `{record.command}` failed, was killed, or is of an earlier "
                          "version", "Run it again, or leave it out.")
        yield Results(folder, record)


def keep_results(path: Path) -> None:
    """Refuse to write a file over a result of a run.

    Raises
    ------
    OutputError
    """
    for folder in path.absolute().parents:
        record = _record_at(folder / RECORD)
        if record and str(path.absolute().relative_to(folder)) in record.files:
            raise OutputError(f"File {path} is a result of `{record.command}`, which this run "
                              "would replace. Name another file.")


def named_inputs(folder: Path) -> dict[str, Path]:
    """Return the files that the run in a folder was given, by the words for them in commands.

    Files that are not there any more, or have changed, are left out; so are all of a folder whose
    record cannot be read.
    """
    record = _record_at(folder / RECORD)
    return {} if record is None else {
        word: Path(path) for word, path in record.named.items()
        if path in record.inputs and _digest(Path(path)) == record.inputs[path]}


def inputs_behind(path: Path) -> dict[str, str]:
    """Return the SHA-256 of what the run has read that wrote a file, by path; not its study.

    It is empty if the record of the file's folder does not have the file as it is.
    """
    record = _record_at(path.parent / RECORD)
    digest = next(iter(_inputs([path]).values()), None)
    if record is None or digest is None or record.files.get(path.name) != digest:
        return {}
    return {name: found for name, found in record.inputs.items()
            if name != record.named.get("STUDY")}


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Keep other runs out of a folder while the block writes what later runs may read into it.

    Unlike a `result_folder`, it belongs to no command: its record has files `KEPT` only. A folder
    inside one that this run has locked belongs to it.

    Raises
    ------
    OutputError
        If another run, or another thread of this process, is using the folder, or it has a file
        that would be replaced and that no run has written.
    """
    whole = folder.resolve()
    if any(whole.is_relative_to(held) for held in _HELD.get()):
        yield
        return
    with _locked(folder) as file:
        record = _read_or_refuse(file, folder / RECORD) or Record(
            command="halbach-fe", study="", kept=[])
        writer = _Writer(folder.absolute(), record, "folder", file)
        writer.refuse(_writable_paths(writer.base, (), solving=True))
        with telling(writer):
            yield


def _inputs(paths: Iterable[Path]) -> dict[str, str]:
    """Return the SHA-256 of what was read of files, by their paths."""
    found = {}
    for path in paths:
        with contextlib.suppress(OSError):  # whoever reads it says what is wrong
            found[printable(path, MAX_QUOTED)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


@contextlib.contextmanager
def _regular(path: Path) -> Iterator[BufferedReader]:
    """Open a regular file that is no link; raise OSError or ValueError if it is none."""
    number = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(number, "rb") as file:
        if not stat.S_ISREG(os.fstat(number).st_mode):
            raise ValueError("it is no file")
        yield file


def _digest(path: Path) -> str | None:
    """Return the SHA-256 of a file; None if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[BinaryIO]:
    """Make a folder, and open and lock its record.

    Afterwards the record is removed if nothing is recorded, and so is the folder, if it was made
    for this and is empty.
    """
    made, path = not folder.exists(), make_folder(folder) / RECORD
    with _opened(path) as file:
        token = _HELD.set((*_HELD.get(), folder.resolve()))
        try:
            yield file
        finally:
            _HELD.reset(token)
            record = _read(file)
            if not (record.files or record.kept or record.writing if record
                    else os.fstat(file.fileno()).st_size):
                path.unlink(missing_ok=True)
                with contextlib.suppress(OSError):
                    if made:
                        folder.rmdir()


def _opened(path: Path, wait: bool = False) -> BinaryIO:
    """Open and lock a file, which is created if it does not exist; ``wait`` until it is free."""
    while True:
        try:
            number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise OutputError(f"Cannot write {path}: {error.strerror}.") from None
        file = os.fdopen(number, "r+b", buffering=0)
        try:
            fcntl.flock(number, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            file.close()
            raise OutputError(f"Folder {path.parent} is in use by another run of halbach-fe. Wait "
                              "for it, or name another folder.") from None
        except OSError:  # this file system has no locks
            return file
        if os.fstat(number).st_nlink:  # else a run that ended meanwhile has removed it
            return file
        file.close()


def _read(file: BinaryIO) -> Record | None:
    """Return the record in a file; None if it is new, or cannot be read."""
    file.seek(0)
    try:
        return Record.model_validate_json(file.read())
    except ValidationError:
        return None


def _record_at(path: Path) -> Record | None:
    """Return the record at a path; None if there is none that can be read."""
    try:
        with _regular(path) as file:
            return _read(file)
    except (OSError, ValueError):
        return None


def _read_or_refuse(file: BinaryIO, path: Path) -> Record | None:
    """Return the record in a file, None if it is new or damaged; refuse JSON of other programs."""
    record = _read(file)
    if record is None:
        file.seek(0)
        with contextlib.suppress(ValueError):
            from_json(file.read())
            raise OutputError(f"File {path} is not one of halbach-fe, which would replace it. "
                              "Name another folder, or remove this file.")
    return record


def _is_of_a_run(path: Path) -> bool:
    """Tell by its content whether a file without a record is one that a run keeps for later ones.

    Functions below the interface, such as `halbach_fe.response.response_matrix.response_matrix`,
    leave no record in a session's folder, and earlier versions left none at all. Somebody's own
    mesh.msh has no regions.json with these keys beside it.
    """
    if fnmatch(path.name, "response-*.npy"):  # a part of the response beside it
        path = path.with_name("response.h5")
    if path.name == "response.h5":
        import h5py  # late, as few folders have such a file without a record

        try:
            with h5py.File(path) as file:
                return {"key", "content_sha256"} <= file.attrs.keys()
        except OSError:
            return False
    if path.suffix == ".msh":
        own = path.stem.partition("mesh")[0]
        path = path.with_name(f"{own}-regions.json" if own else "regions.json")
    if not path.name.endswith("regions.json"):
        return False
    try:
        found = from_json(path.read_bytes())
    except (OSError, ValueError):
        return False
    return isinstance(found, dict) and {"study", "dimension", "air"} <= found.keys()


def _is_of_another(path: Path, base: Path) -> bool:
    """Tell whether a file `KEPT` is recorded in another folder, inside or around ``base``."""
    for folder in path.parents:
        record = None if folder == base else _record_at(folder / RECORD)
        if record and str(path.relative_to(folder)) in (record.kept or []):
            return True
    return False


def _is_kept(path: Path) -> bool:
    """Tell whether a later run may read a file instead of writing it again."""
    return any(fnmatch(path.name, pattern) for pattern in KEPT)
