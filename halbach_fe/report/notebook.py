"""The HTML that a notebook shows for a result: its main figure, or a table."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping, Sequence
from functools import singledispatch

from matplotlib.figure import Figure

from halbach_fe.api import HomogeneityResult, MultipoleTables
from halbach_fe.diagnosis.result import Diagnosis
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.field_map import points_of
from halbach_fe.measurement.positions import points_from
from halbach_fe.report.answer import Answer
from halbach_fe.report.diagnosis import change_table, found_table
from halbach_fe.report.diagnosis_answer import answer as answer_of_diagnosis
from halbach_fe.report.homogeneity import homogeneity_rows
from halbach_fe.report.multipoles import multipole_figure
from halbach_fe.report.page import geometry_figure, own_style, page_of
from halbach_fe.report.prediction import prediction_profile_figure
from halbach_fe.report.solution import field_figure
from halbach_fe.report.verification import answer as answer_of_verification
from halbach_fe.report.verification import difference_table
from halbach_fe.response.discretization_error import Verification
from halbach_fe.response.solution import Solution
from halbach_fe.synthetic.simulate import SimulatedCampaign

DOTS_PER_INCH = 100


@own_style
def html_of(result: object) -> str:
    """Return the main figure or table of a result as HTML that needs no other file.

    Raises
    ------
    TypeError
        If the result is of a type without figure or table.
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
def _(solution: Solution) -> str:
    return picture(field_figure(solution), f"The field of {solution.magnet.name} at the study's "
                   "positions, and the solver's error bar of each reading")


@_html_of.register
def _(result: InferenceResult) -> str:
    return picture(prediction_profile_figure(result), "Readings, and what the model predicts "
                   "before and after the update")


@_html_of.register
def _(diagnosis: Diagnosis) -> str:
    return (words(answer_of_diagnosis(diagnosis)) + table(found_table(diagnosis))
            + table(change_table(diagnosis)))


@_html_of.register
def _(result: MultipoleTables) -> str:
    return "".join(picture(multipole_figure(multipoles, None), "Multipoles in units of 1e-4")
                   for _, multipoles in result.tables)


@_html_of.register
def _(result: HomogeneityResult) -> str:
    return table(homogeneity_rows(result.by_name))


@_html_of.register
def _(verification: Verification) -> str:
    return words(answer_of_verification(verification)) + table(difference_table(verification))


@_html_of.register
def _(campaign: SimulatedCampaign) -> str:
    points = points_of(campaign.readings)
    return table([{"study": campaign.study.name, "points": str(len(points)),
                   "blocks": str(len(campaign.blocks))}])


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
