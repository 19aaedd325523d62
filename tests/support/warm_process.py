"""Python code in processes of its own whose libraries are imported already.

An import of scipy, xarray and matplotlib costs more than most examples of the documentation. A fork
server imports them once; every process is a fork of it, so that nothing that one example defines,
changes or exports reaches another.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from halbach_fe.cli import main
from halbach_fe.core.installation import code_digest
from halbach_fe.report import page
from halbach_fe.response import response_matrix

IMPORTED = ["halbach_fe.api", "halbach_fe.cli.verbs", "halbach_fe.report.page",
            "matplotlib.pyplot", "scipy.stats", "magpylib", __name__]

# kept by all processes: to read all sources takes half a second
code_digest(response_matrix.__name__)

FIGURE = Figure(figsize=(1, 1))
"""Every figure of a page: to draw them takes as long as the rest, and tests of pages do so."""


@dataclass(frozen=True)
class Done:
    """What a process came to, as of `subprocess.run`."""

    returncode: int | None
    stdout: str
    stderr: str


def run_warm(code: str | list[str], folder: Path, environment: Mapping[str, str],
             timeout_s: float = 1200.0) -> Done:
    """Run a Python program, or a ``halbach-fe`` command with these arguments, in a folder."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(IMPORTED)
    outputs = [folder / f".{name}" for name in ("stdout", "stderr")]
    process = context.Process(target=_run, args=(code, folder, dict(environment), *outputs))
    process.start()
    process.join(timeout_s)
    if process.is_alive():
        process.kill()
        process.join()
    said = [path.read_text(encoding="utf-8") for path in outputs]
    for path in outputs:
        path.unlink()
    return Done(process.exitcode, *said)


def _run(code: str | list[str], folder: Path, environment: dict[str, str], stdout: Path,
         stderr: Path) -> None:
    """Become a process as the shell would start it, and run; never return."""
    gc.freeze()  # as in `tests.conftest`
    gc.set_threshold(10_000)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    for number, path in ((1, stdout), (2, stderr)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.stdout, sys.stderr = (open(number, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
                              for number in (1, 2))
    save = page.save
    page.save = lambda figures, folder: save(
        {name: (FIGURE, caption) for name, (_, caption) in figures.items()}, folder)
    if isinstance(code, list):
        sys.argv = ["halbach-fe", *code]
        sys.exit(main(code))
    sys.path.insert(0, "")
    warnings.simplefilter("error")
    exec(compile(code, "<example>", "exec"), {"__name__": "__main__"})
