"""What is made of a result: its files and its page, and what a notebook shows."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from functools import singledispatch
from pathlib import Path

from matplotlib.figure import Figure

from halbach_fe.core.arguments import typed
from halbach_fe.core.result_folder import result_folder
from halbach_fe.diagnosis.discriminating_measurements import Separation
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.diagnosis.summary import write_study, write_summary
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.result import InferenceResult
from halbach_fe.inference.storage import write_inference
from halbach_fe.measurement.positions import points_from
from halbach_fe.report import (
    assembly,
    campaign,
    demagnetization,
    forces,
    homogeneity,
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
from halbach_fe.report.diagnosis import change_table, found_table, write_diagnosis_report
from halbach_fe.report.diagnosis_answer import answer as answer_of_diagnosis
from halbach_fe.report.inference import write_inference_report
from halbach_fe.report.page import geometry_figure, own_style, page_of, write_files
from halbach_fe.report.prediction import prediction_profile_figure
from halbach_fe.study.edit_file import study_text
from halbach_fe.study.model import Study

QUESTIONS = (assembly, campaign, demagnetization, forces, homogeneity, multipoles, plan,
             ring_design, shim_tray, shimming, solution, sorting, tolerance, verification)
"""Modules that register the page of their result, see `page_of`."""

DOTS_PER_INCH = 100


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
    TypeError
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
    if isinstance(result, InferenceResult):
        with result_folder(folder, "halbach-fe infer", result.study.name):
            write_inference(result, folder)
            write_inference_report(result, folder)
        return folder / "report.html"
    if isinstance(result, Diagnosis):
        study = result.corrected_study
        with result_folder(folder, "halbach-fe diagnose", study.name):
            return write_diagnosis(result, (), study, study_text(study), folder)
    page = page_of(result)
    with result_folder(folder, f"halbach-fe {page.command}", page.study.name):
        return write_files(page, folder)


def write_diagnosis(
    diagnosis: Diagnosis, separations: Sequence[Separation], study: Study, text: str, folder: Path,
    assumptions: Sequence[str] = (), origin: Path | None = None,
) -> Path:
    """Write summary and page of a diagnosis, and the study with the identified effects added.

    Parameters
    ----------
    diagnosis : Diagnosis
    separations : sequence of Separation
        Further measurements that would distinguish rival effects.
    study : Study
        The study before the diagnosis.
    text : str
        Text of the study's file, whose comments are kept in study.diagnosed.toml.
    folder : Path
    assumptions : sequence of str
        Sentences that are shown at the top of the page.
    origin : Path, optional
        Folder of the study's file, from which paths of maps start.

    Returns
    -------
    Path
        Path of the page.
    """
    write_summary(diagnosis, separations, folder)
    write_diagnosis_report(diagnosis, separations, folder, assumptions)
    write_study(text, study, diagnosis, folder, origin)
    return folder / "diagnosis.html"


@own_style
def html_of(result: object) -> str:
    """Return what a notebook shows of a result, as HTML that needs no other file: the answer, and
    the main figure or tables.

    Raises
    ------
    TypeError
        If the result is of a type without a page.
    """
    return _html_of(result)


@singledispatch
def _html_of(result: object) -> str:
    page = page_of(result)
    return words(page.answer) + "".join(
        [picture(page.figures[name][0](), page.figures[name][1]) for name in page.shown]
        or map(table, page.tables.values()))


@_html_of.register
def _(magnet: Magnet) -> str:
    points = points_from(magnet.study.observation.positions)
    return picture(geometry_figure(magnet, points), f"The magnet {magnet.name}, with the "
                   "magnetization of its blocks and the positions of its study")


@_html_of.register
def _(result: InferenceResult) -> str:
    return picture(prediction_profile_figure(result), "Readings, and what the model predicts "
                   "before and after the update")


@_html_of.register
def _(diagnosis: Diagnosis) -> str:
    return (words(answer_of_diagnosis(diagnosis)) + table(found_table(diagnosis))
            + table(change_table(diagnosis)))


def words(answer: Answer) -> str:
    """Return an answer as a paragraph."""
    return f"<p>{html.escape(' '.join(answer.sentences))}</p>"


def picture(figure: Figure, text: str) -> str:
    """Return a figure as an HTML image element with an alternative text."""
    raw = io.BytesIO()
    figure.savefig(raw, format="png", dpi=DOTS_PER_INCH)
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
