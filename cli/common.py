"""Functions that all verbs share: input files, folders, sessions, progress bars, tables."""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import multiprocessing
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import halbach_fe as hf
from halbach_fe.cli.process import claim_buffers, guarded, show
from halbach_fe.cli.process import say as say
from halbach_fe.cli.shared_options import (
    SOLVER,
    Options,
    Run,
    declared,
    describes_a_format,
    format_words,
    option,
    path,
    together,
    verb,
)
from halbach_fe.core.errors import (
    MAX_QUOTED,
    MeasurementError,
    OutputError,
    StudyError,
    must_be,
    printable,
)
from halbach_fe.core.files import InputFile
from halbach_fe.core.numbers import decimals
from halbach_fe.core.progress import Pace, quiet
from halbach_fe.measurement.formats.declared_format import DeclaredFormat

if TYPE_CHECKING:
    import xarray as xr

    from halbach_fe.inference.posterior_files import StoredPosterior
    from halbach_fe.report.answer import Answer
    from halbach_fe.report.page import Page
    from halbach_fe.response.resource_estimate import Estimate
    from halbach_fe.solver.getdp_cache import Cache


def question(*options: Options) -> Callable[
        [Callable[[hf.Magnet, argparse.Namespace], object]], Run]:
    """Declare a verb that asks something of the magnet of STUDY: its function gets the magnet, and
    returns the result or its page, or an exit code if all has been said.
    """
    def declared(ask: Callable[[hf.Magnet, argparse.Namespace], object]) -> Run:
        @wraps(ask)
        def run(arguments: argparse.Namespace) -> int:
            answer = ask(hf.build_magnet(hf.read_study(arguments.study)), arguments)
            return answer if isinstance(answer, int) else finish(arguments, answer)

        return verb(*options)(run)

    return declared


def print_estimate(estimate: Estimate, as_json: bool) -> int:
    """Print the estimated cost of a run, and warn if it needs too much memory; return 0."""
    from halbach_fe.response.resource_estimate import TIME_FACTOR

    if as_json:
        print_json(estimate.as_dict())
    else:
        print_table([{
            "mesh": problem.what, "route": problem.route, "elements": str(problem.elements),
            "unknowns": str(problem.unknowns), "processes": str(problem.processes),
            "solves each": str(problem.solves), "GiB each": f"{problem.memory_GiB:.2g}",
            "s each": f"{problem.seconds:.2g}"} for problem in estimate.problems], "Runs of GetDP")
        available = estimate.available_GiB
        print_table([{"quantity": quantity, "value": value} for quantity, value in {
            "route": estimate.route, "blocks": str(estimate.blocks),
            "readings": str(estimate.readings), "parameters": str(estimate.parameters),
            "GetDP processes": f"{estimate.processes}, up to {estimate.jobs} at a time",
            "solves": str(estimate.solves),
            "memory": f"{estimate.memory_GiB:.2g} GiB in all processes together"
            + ("" if available is None else f", of {available:.2g} GiB available"),
            "disk": f"{estimate.disk_GiB:.2g} GiB at most",
            "time": f"{decimals(estimate.seconds, 2)} s, within a factor of about {TIME_FACTOR:g}",
        }.items()], f"{estimate.study}, estimated")
    if estimate.warning is not None:
        say(f"warning: {estimate.warning}")
    return 0


def run_study(
    description: str, study: Path, output: str, run: Callable[[argparse.Namespace], int],
    *options: Options,
) -> int:
    """Parse the command line of a shipped study and run it; return the exit code.

    ``options`` adds the study's own options to the parser.
    """
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.set_defaults(study=InputFile(study))
    option("-o --output", path, "DIR", "folder for results (default: %(default)s)",
           default=Path("results", output))(parser)
    together(SOLVER, *options)(parser)
    arguments = parser.parse_args()

    def whole(arguments: argparse.Namespace) -> int:
        own_folder(arguments, command=f"study {output}", solving=True)
        return run(arguments)

    return guarded(lambda: with_folder(whole, arguments))


def with_folder(
    run: Callable[[argparse.Namespace], int], arguments: argparse.Namespace
) -> int:
    """Call ``run`` and return its exit code; then give back what `own_folder` took meanwhile."""
    with ExitStack() as stack:
        arguments.at_end = stack
        return int(run(arguments))


DESCRIPTIONS = {"study": "study file", "held_out": "held-out map", "order": "order of assembly"}
"""What files of the command line are on pages, by the names of their arguments, where that differs
from the latter."""


def own_folder(
    arguments: argparse.Namespace, study: str = "", command: str = "", solving: bool = False
) -> None:
    """Take the output folder for this command and study until the end of the run.

    The command is by default the verb.

    It is called before the first file is written, and after the input was read, so that a refused
    input leaves no folder. See `halbach_fe.core.result_folder.result_folder`. Pages that are
    written until then name the files of the command line.
    """
    from halbach_fe.core.result_folder import result_folder
    from halbach_fe.report.answer import LISTED_MAPS, MAP_OPTIONS, known_inputs, known_paths

    inputs = [value for value in (*vars(arguments).values(),
                                  *getattr(arguments, "listed_maps", {}).values())
              if isinstance(value, InputFile)]
    # a map that needs options is not known by its path alone
    named = {word: path for word, path in _given(arguments).items() if path in inputs
             and not (word == "MAP" and describes_a_format(arguments))}
    arguments.owns_folder = True
    arguments.at_end.enter_context(result_folder(
        arguments.output, command or f"halbach-fe {arguments.verb}", study, inputs, named, solving))
    arguments.at_end.enter_context(known_paths({
        word: path if word in (MAP_OPTIONS, LISTED_MAPS) else _from_here(path)
        for word, path in _paths_of(arguments).items()}))
    arguments.at_end.enter_context(known_inputs(_described(arguments)))


def _described(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the `digest` of every file that the command reads, by what it is.

    A posterior comes with the files that its update has read, if its folder still tells.
    """
    from halbach_fe.core.result_folder import inputs_behind

    files = {DESCRIPTIONS.get(name, name.replace("_", " ")): value
             for name, value in vars(arguments).items() if isinstance(value, InputFile)}
    listed = getattr(arguments, "listed_maps", {})
    files = {name: file for name, file in files.items() if file not in listed.values()} | {
        f"map {name}": file for name, file in listed.items()}
    found = {}
    for name, file in files.items():
        with suppress(OSError):  # whoever reads it says what is wrong
            found[name] = digest(file)
    if isinstance(posterior := getattr(arguments, "posterior", None), InputFile) and (
            behind := inputs_behind(posterior)):
        found["read for the posterior"] = "; ".join(
            printable(f"{Path(path).name}{_if_simulated(Path(path))}, SHA-256 {value}", MAX_QUOTED)
            for path, value in behind.items())
    return found


def own_file(arguments: argparse.Namespace, *inputs: Path) -> None:
    """Take the output file, which is none of the inputs, for this verb until the end of the run.

    Raises
    ------
    OutputError
        If it is one of them. A link at its place would be replaced, not followed.
    """
    from halbach_fe.core.result_folder import single_file

    output = arguments.output
    for one in inputs:
        if not output.is_symlink() and output.exists() and one.exists() and one.samefile(output):
            raise OutputError(must_be("-o", "the command line", "a file other than the input",
                                      str(output), "Name another file."))
    arguments.at_end.enter_context(single_file(output, f"halbach-fe {arguments.verb}"))


SIMULATED = b"# source: synthetic"
"""How a map or block table (CSV) begins that `halbach-fe simulate-measurement` wrote."""


def digest(path: Path) -> str:
    """Return the name of a file and the SHA-256 of what was read, for the provenance of a page.

    It says if the file is one that `halbach-fe simulate-measurement` wrote.
    """
    content = path.read_bytes()
    simulated = ", simulated" if content.startswith(SIMULATED) else ""
    return f"{path.name}{simulated}, SHA-256 {hashlib.sha256(content).hexdigest()}"


def _if_simulated(path: Path) -> str:
    """Return a word for a simulated map that an earlier run has read, if it is still there."""
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as file:
                return ", simulated" if file.read(len(SIMULATED)) == SIMULATED else ""
    return ""


def reference(arguments: argparse.Namespace) -> hf.MultipoleReference | None:
    """Return the reference that options `MULTIPOLES` describe, if any is given."""
    from halbach_fe.response.multipoles import DEFAULT_ORDERS

    given = (arguments.reference_radius_m, arguments.orders, arguments.at_z_m)
    if all(option is None for option in given):
        return None
    return hf.MultipoleReference(arguments.reference_radius_m, arguments.orders or DEFAULT_ORDERS,
                                 arguments.at_z_m)


def region_of(arguments: argparse.Namespace, magnet: hf.Magnet) -> hf.Region | None:
    """Return the region of a magnet that the options describe; None for the default one.

    Raises
    ------
    StudyError
        If only its centre is given.
    """
    from halbach_fe.response.region import default_centre

    region = hf.Region.of(arguments.sphere_m, arguments.ellipsoid_m, arguments.cylinder_m,
                          arguments.centre_m or default_centre(magnet))
    if region is None and arguments.centre_m:
        raise StudyError(must_be("--centre-m", "the command line", "beside a region",
                                 "given alone", "Add --sphere-m R."))
    return region


def blocks_and_held_out(
    arguments: argparse.Namespace, study: hf.Study
) -> tuple[hf.BlockTable | None, xr.Dataset | None]:
    """Read the block table and the held-out map; None stands for a file not given."""
    return (blocks_of(arguments.blocks),
            read_one(arguments, arguments.held_out, study) if arguments.held_out else None)


def blocks_of(path: Path | None) -> hf.BlockTable | None:
    """Read a table of measured blocks, if it is given."""
    return hf.read_blocks(path) if path else None


def posterior_of(arguments: argparse.Namespace, magnet: hf.Magnet) -> StoredPosterior | None:
    """Read the posterior of the magnet, if it is given."""
    from halbach_fe.inference.posterior_files import read_posterior

    return read_posterior(magnet, arguments.posterior) if arguments.posterior else None


def read_measurements(
    arguments: argparse.Namespace, study: hf.Study
) -> xr.Dataset | dict[str, xr.Dataset]:
    """Read the map of --measurements, or all maps that the study lists, by name.

    Raises
    ------
    StudyError
        If both or neither are given, or options describe the format of maps that are listed.
    """
    from halbach_fe.measurement.campaign_maps import different_maps

    if bool(study.maps) == (arguments.measurements is not None):
        raise StudyError(must_be(
            "--measurements", "the command line", "given, or maps listed by the study",
            "both" if study.maps else "neither",
            "Leave --measurements out." if study.maps else "Add --measurements, or [[maps]]."))
    if study.maps:
        if getattr(arguments, "held_out", None) is None and describes_a_format(arguments):
            raise StudyError(must_be(
                "options of the format", "the command line", "left out, as the study lists its "
                "maps", "given", "State maps.instrument.length_unit_m and flux_density_unit_T in "
                "the study, or convert its maps by halbach-fe import-map."))
        return different_maps(study, _listed(arguments, study))
    return read_one(arguments, arguments.measurements, study)


def read_one(
    arguments: argparse.Namespace, path: Path, study: hf.Study | None = None
) -> xr.Dataset:
    """Read a map, of a magnet's study if there is one, and refuse units that both state."""
    from halbach_fe.measurement.formats.import_export import refuse_units_twice

    data = _read_one(arguments, path)
    if study is not None:
        refuse_units_twice(data, study.instrument, path)
    return data


def _read_one(arguments: argparse.Namespace, path: Path) -> xr.Dataset:
    """Read a map in halbach-fe's own columns, as the options of `import-map` describe it, or as
    the file itself says.
    """
    from halbach_fe.measurement.field_map import FOREIGN
    from halbach_fe.measurement.formats.import_export import import_map

    if describes_a_format(arguments):
        imported = import_map(path, declared(arguments, DeclaredFormat), arguments.format)
    else:
        try:
            return hf.read_map(path)
        except MeasurementError as refused:
            if FOREIGN not in str(refused):  # it is our own, and has a fault
                raise
            try:
                imported = import_map(path, DeclaredFormat())
            except MeasurementError:
                raise refused from None
        say(f"Read {path.name} as {imported.format}, with positions in "
            f"{', '.join(imported.length_units)} and B in {', '.join(imported.field_units)}.")
    for remark in imported.remarks:
        say(remark)
    data = imported.data
    data.encoding["source"] = str(path)
    return data


def _listed(arguments: argparse.Namespace, study: hf.Study) -> dict[str, InputFile]:
    """Return the files of the maps that the study lists, the same objects whenever it is called."""
    if not hasattr(arguments, "listed_maps"):
        arguments.listed_maps = {
            one.name: InputFile(arguments.study.parent / one.file) for one in study.maps}
    return dict(arguments.listed_maps)


@contextmanager
def session(
    arguments: argparse.Namespace, study: hf.Study | None = None, told: bool = True
) -> Iterator[hf.Session]:
    """Open a session in the output folder; show its progress, see `progress_bar`.

    The folder becomes that of this verb and ``study``; shipped studies own theirs already.
    """
    from halbach_fe.report.answer import inputs_of_command, known_inputs
    from halbach_fe.solver.getdp import getdp_or_none
    from halbach_fe.solver.session import connected

    getdp = getdp_or_none(arguments.getdp)
    if study is not None:
        own_folder(arguments, study.name, solving=True)
    arguments.at_end.enter_context(known_inputs({"GetDP": getdp.version, **inputs_of_command()}))
    with progress_bar("solving", told) as show, ExitStack() as stack:
        opened = hf.Session(
            getdp=getdp, folder=arguments.output, jobs=jobs(arguments),
            time_limit_s=arguments.time_limit, progress=show, cache=cache(arguments),
            processes=arguments.mpi)
        if arguments.scheduler is not None:
            cluster = stack.enter_context(connected(arguments.scheduler, say))
            opened = replace(opened, run=cluster.run, jobs=arguments.jobs or cluster.cores)
        yield opened


def cache(arguments: argparse.Namespace) -> Cache | None:
    """Return the cache of GetDP's answers, or None if it is switched off."""
    from halbach_fe.solver.getdp_cache import default_cache

    return None if arguments.no_cache else default_cache(arguments.cache)


@contextmanager
def workers(arguments: argparse.Namespace) -> Iterator[Executor]:
    """Open an executor: processes of this machine, or the workers of --scheduler."""
    if arguments.scheduler is not None:
        from halbach_fe.solver.session import connected

        with connected(arguments.scheduler, say) as cluster:
            yield cluster.executor
        return
    pool = ProcessPoolExecutor(jobs(arguments), multiprocessing.get_context("spawn"),
                               _begin_worker, (os.getpid(),))
    try:
        yield pool
    except BaseException:  # drop the waiting calls, and end those that run
        for process in multiprocessing.active_children():
            process.terminate()
        # without waiting, Python may write to the pool's closed pipe at exit, and say so on stderr
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    pool.shutdown()


def _begin_worker(parent: int) -> None:
    """Prepare a worker process that ends itself once its parent has ended for whatever reason."""
    claim_buffers()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def jobs(arguments: argparse.Namespace) -> int:
    """Return the number of GetDP runs at a time on this machine."""
    return int(arguments.jobs or min(2, os.cpu_count() or 1))


@contextmanager
def progress_bar(label: str, told: bool = False) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar on stderr if that is a terminal; if not, tell the progress in lines if it
    is to be ``told``.

    The context is a function that takes the number of steps done and the total.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    pace = Pace(say if told and not console.is_terminal else quiet)
    pace.begin(label)
    with Progress(TextColumn("[progress.description]{task.description}"), BarColumn(),
                  MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"),
                  TimeRemainingColumn(), console=console, transient=True,
                  disable=not console.is_terminal) as bar:
        task = bar.add_task(label, total=None)

        def show(done: int, total: int) -> None:
            if not done:  # the next step has a pace of its own
                bar.reset(task)
            bar.update(task, completed=done, total=total)
            pace.advance(done, total)

        yield show


def finish(arguments: argparse.Namespace, result: object) -> int:
    """Write the files of a result, or of its page, and print it as JSON, or its tables and its
    answer; return 0.

    A verb that has not taken its folder yet does so now, by `own_folder`.
    """
    from halbach_fe.report.page import Page, page_of, write_files

    page = result if isinstance(result, Page) else page_of(result)
    if arguments.output is not None and not getattr(arguments, "owns_folder", False):
        own_folder(arguments, page.study.name if page.study is not None else "")
    path = None if arguments.output is None else write_files(
        page, arguments.output, getattr(arguments, "study", None))
    if arguments.json:
        print_json(page.summary)
        return 0
    say_page(arguments, page, path)
    return 0


def say_page(arguments: argparse.Namespace, page: Page, path: Path | None) -> None:
    """Print the tables and the answer of a page, and where it is if it was written."""
    for sentence in filter(None, page.remarks):
        say(sentence)
    for title, rows in page.tables.items():
        print_table(rows, title)
    if page.new_study is not None and path is not None:
        say(f"Study: {arguments.output / page.new_study[0]}")
    say_answer(arguments, page.answer, path)


def say_answer(arguments: argparse.Namespace, answer: Answer, page: Path | None) -> None:
    """Say the answer of a command, the command to go on with, and where its page is."""
    named = answer.with_paths(_paths_of(arguments))
    for sentence in named.sentences:
        say(sentence)
    if named.command:
        say(f"  {named.command}")
        if named.to_fill_in:
            say(f"  {named.to_fill_in}")
    if page is not None:
        say(f"Report: {page}")


def _paths_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the paths that are known by the words for them in commands of an answer.

    With the path of the map come the options with which it was read. The paths are those of the
    command line. A posterior that is among them is of a map and blocks, which the record of its
    folder names.
    """
    from halbach_fe.core.result_folder import named_inputs
    from halbach_fe.report.answer import LISTED_MAPS, MAP_OPTIONS

    given = {word: path for word, path in _given(arguments).items() if path is not None}
    posterior = given.get("POSTERIOR")
    behind = named_inputs(posterior.parent) if posterior else {}
    options = format_words(arguments) if "MAP" in given and describes_a_format(arguments) else []
    return {**{word: path for word, path in behind.items() if word in ("MAP", "BLOCKS")}, **given,
            "DIR": getattr(arguments, "output", None), MAP_OPTIONS: options,
            LISTED_MAPS: _lists_maps(given.get("STUDY"))}


def _lists_maps(study: Path | None) -> bool:
    """Return whether a study file, which a command has read before, has a list of maps."""
    try:
        text = study.read_text("utf-8-sig") if study else ""
    except (OSError, UnicodeDecodeError):  # gone meanwhile
        return False
    return re.search(r"^\s*(\[\[\s*maps\s*\]\]|maps\s*=)", text, re.MULTILINE) is not None


def _given(arguments: argparse.Namespace) -> dict[str, Path | None]:
    """Return the input files of the command line by the words for them in commands."""
    return {
        "STUDY": getattr(arguments, "study", None), "BLOCKS": getattr(arguments, "blocks", None),
        "MAP": getattr(arguments, "measurements", getattr(arguments, "map", None)),
        "POSTERIOR": getattr(arguments, "posterior", None),
        "HELD_OUT": getattr(arguments, "held_out", None)}


def _from_here(path: Path | None) -> str | None:
    """Return a path for a page, relative to the current folder if it is in it."""
    if path is None:
        return None
    here = Path.cwd()
    return printable(str(path.relative_to(here) if path.is_relative_to(here) else path), MAX_QUOTED)


def print_json(value: object) -> None:
    """Print machine-readable results on stdout."""
    show(json.dumps(value, indent=1, allow_nan=False) + "\n")


def print_table(rows: Sequence[Mapping[str, str]], title: str = "") -> None:
    """Print rows of text as a table on stdout; print nothing if there are no rows."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    def cell(value: str) -> Text:
        """Return a text that is neither interpreted as markup nor by the terminal."""
        return Text(printable(value, MAX_QUOTED))

    if not rows:
        return
    # rich would write to standard output, if only an empty text: it gets another file like it
    like_stdout = io.TextIOWrapper(io.BytesIO(), encoding=sys.stdout.encoding)
    console = Console(file=like_stdout, force_terminal=sys.stdout.isatty() or None,
                      width=None if sys.stdout.isatty() else 140)
    table = Table(title=title or None, title_justify="left")
    for number, name in enumerate(rows[0]):
        table.add_column(cell(name), justify="left" if number < 2 else "right")
    for row in rows:
        table.add_row(*map(cell, row.values()))
    with console.capture() as captured:
        console.print(table)
    show(captured.get())
