"""What is made of a result: its files and its page, and what a notebook shows."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from halbach_fe.core.arguments import typed
from halbach_fe.core.result_folder import result_folder
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.positions import points_from
from halbach_fe.report import (
    assembly,
    campaign,
    demagnetization,
    diagnosis,
    forces,
    homogeneity,
    inference,
    multipoles,
    plan,
    ring_design,
    shim_tray,
    shimming,
    solution,
    sorting,
    tolerance,
    verification,
)
from halbach_fe.report.answer import Answer
from halbach_fe.report.page import geometry_figure, own_style, page_of, write_files

QUESTIONS = (assembly, campaign, demagnetization, diagnosis, forces, homogeneity, inference,
             multipoles, plan, ring_design, shim_tray, shimming, solution, sorting, tolerance,
             verification)
"""Modules that register the page of their result, see `page_of`."""


@typed
def write_report(result: object, folder: str | Path) -> Path:
    """Write the files of a result into a folder: its tables, and its HTML page with all figures.

    Parameters
    ----------
    result : Solution, InferenceResult, Diagnosis, Verification, MultipoleTables, \
HomogeneityResult, Forces, MeasurementPlan, FilledTray, Shim, SortedBlocks, Assembly, \
Tolerance, HomogeneityTolerance, DemagnetizationMap or SimulatedCampaign
        The result of a function of `halbach_fe`.
    folder : str or Path
        Folder for the files; it is made if it does not exist. As on the command line, it belongs to
        one command and one study: results that it holds of these are replaced.

    Returns
    -------
    Path
        Path of the page, which needs no network and no other file.

    Raises
    ------
    OutputError
        If a file cannot be written, another run is using the folder, or it holds results of
        another command or study.
    StudyError
        If ``result`` is of any other type.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> solution = hf.solve(magnet, hf.Session.open("results"))
    >>> hf.write_report(solution, "field").name
    'report.html'
    """
    folder = Path(folder)
    page = page_of(result)
    study = page.study.name if page.study else ""
    with result_folder(folder, f"halbach-fe {page.command}", study):
        return write_files(page, folder)


@own_style
def html_of(result: object) -> str:
    """Return what a notebook shows of a result, as HTML that needs no other file: the answer, and
    the main figure or tables.

    Raises
    ------
    StudyError
        If the result is of a type without a page.
    """
    if isinstance(result, Magnet):
        points = points_from(result.study.observation.positions)
        return picture(geometry_figure(result, points), f"The magnet {result.name}, with the "
                       "magnetization of its blocks and the positions of its study")
    page = page_of(result)
    return words(page.answer) + "".join(
        [picture(page.figures[name][0](), page.figures[name][1]) for name in page.shown]
        or map(table, page.tables.values()))


def words(answer: Answer) -> str:
    """Return an answer as a paragraph."""
    return f"<p>{html.escape(' '.join(answer.sentences))}</p>"


def picture(figure: Figure, text: str) -> str:
    """Return a figure as an HTML image element with an alternative text."""
    raw = io.BytesIO()
    figure.savefig(raw, format="png", dpi=100)
    data = base64.b64encode(raw.getvalue()).decode("ascii")
    return f'<img alt="{html.escape(text)}" src="data:image/png;base64,{data}">'


def table(rows: Sequence[Mapping[str, str]]) -> str:
    """Return rows of text as an HTML table; an empty text if there are no rows."""
    if not rows:
        return ""
    head = "".join(f"<th>{html.escape(name)}</th>" for name in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{html.escape(value)}</td>" for value in row.values())
                   + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"
