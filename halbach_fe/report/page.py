"""Parts that all pages share: colours, figures as files and in pages, and the page itself."""

from __future__ import annotations

import base64
import html
import importlib
import io
import json
import platform
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, singledispatch
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
import tomlkit
from markupsafe import Markup
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.legend import Legend
from matplotlib.ticker import FuncFormatter, LogFormatter
from tomlkit.items import Array, Trivia, Whitespace

import halbach_fe
from halbach_fe.core.arrays import Floats, degrees_of, radii_of
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.core.files import atomic, make_folder, write_text
from halbach_fe.core.installation import version
from halbach_fe.core.interface import typed
from halbach_fe.core.result_folder import result_folder
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.measurement.campaign_maps import with_paths_from
from halbach_fe.measurement.positions import points_from
from halbach_fe.measurement.text_tables import write_csv
from halbach_fe.report.answer import (
    DPI,
    SMALLEST_PT,
    WIDEST_IN,
    Answer,
    Picture,
    inputs_of_command,
    write_record,
)
from halbach_fe.report.words import faults_in_words, listed
from halbach_fe.study.model import Study, is_nonlinear
from halbach_fe.study.reader import read_study
from halbach_fe.study.writer import study_text, write_edited

# M. Okabe and K. Ito's palette, whose colours differ for every kind of colour vision
PRIOR, POSTERIOR, PUBLISHED, MEASURED = "#E69F00", "#0072B2", "#999999", "#000000"
SECOND, THIRD = "#009E73", "#CC79A7"
IRON = "#56B4E9"
COLOURS_OF_COMPONENTS = (POSTERIOR, PRIOR, SECOND)

PROGRAMS = ("halbach-fe", "gmsh", "numpy", "scipy")
"""Packages whose versions each page states."""

UNITS = "%|ppm|[mµ]?T|[mµ]?m|mrad|kA/m|N|k?g|°C|kelvin"
"""Regular expression of what stays beside the number before it."""

SMALL = SMALLEST_PT
"""Size of the small texts of figures in points; a figure has no smaller ones."""

COMPLETE_NOTE = "copied from another file, so that this one is complete"
"""Note in a changed study on what its file has read from others."""

own_style = style.context("default")
"""Decorator of functions that draw figures, in matplotlib's style instead of the user's, which may
need LaTeX, or a font that is not there."""


MOST_MEASURED = 10_000
"""Largest number of blocks that a page lists in its study, and whose sides are searched for their
distance from the axis; of more the corners are drawn."""

LISTED = 12
"""Number of rows that a page or the terminal lists of many: the largest ones, or the first."""

Rows = list[dict[str, str]]
"""Rows of text, each by the names of its columns."""

Plain = dict[str, object]
"""Plain data, the content of a JSON file."""

Figures = Mapping[str, tuple[Callable[[], Figure], str]]
"""How figures are drawn, and their captions, by file name."""


class Text(NamedTuple):
    """A paragraph; words between backticks are code, those between pairs of asterisks bold,
    and [words](page.html) a link.
    """

    text: str
    kind: str = ""
    """"small", or "warning"."""


class Items(NamedTuple):
    """Sentences in a list."""

    sentences: Sequence[str]


class Table(NamedTuple):
    """Rows of text; nothing is shown if there are none."""

    rows: Sequence[Mapping[str, str]]
    kind: str = ""
    """"numbers" if the second column has numbers, or "turned" for a column per row."""


class Drawn(NamedTuple):
    """A figure of the page, in its place among the texts."""

    file: str


class View(NamedTuple):
    """A magnet in three dimensions."""

    view: Callable[[], Markup]
    points: str
    """What its colours are."""


@dataclass(frozen=True)
class Section:
    """Texts, tables and figures of a page in their order."""

    parts: Sequence[str | Text | Items | Table | Drawn | View | Callable[[], Markup]]
    """A plain string is a paragraph; a function returns HTML that only the page has. What has no
    text is not shown."""
    title: str = ""
    """What stands above them; empty if nothing does."""
    folded: bool | None = None
    """Whether the section is folded until it is clicked on; None if it cannot be folded."""
    about: object = True
    """Rows, or whatever else it is about: without any, the page does not have the section."""


@dataclass(frozen=True)
class Page:
    """All that a command says of its result: on its page and terminal, in files and notebooks."""

    command: str
    """The verb of halbach-fe."""
    title: str
    """Title of the page, after the study's name."""
    study: Study | None
    """None of what needs no study."""
    answer: Answer
    summary: Mapping[str, object]
    """What the option --json prints, and the file .json holds."""
    sections: Sequence[Section]
    tables: Mapping[str, Sequence[Mapping[str, str]]] = field(default_factory=dict)
    """What terminal and notebooks show, by title. The first table is in page.json too."""
    rows: Sequence[Mapping[str, str]] = ()
    """The table of page.json, if it is another one."""
    figures: Figures = field(default_factory=dict)
    """How each figure is drawn, and its caption, by file name. Of those that no section has, the
    first of all stands below the answer, and the others after all sections."""
    shown: tuple[str, ...] = ()
    """Figures that a notebook shows in place of tables."""
    files: Mapping[str, Callable[[Path], object] | None] = field(default_factory=dict)
    """How each further file is written, by name; None if the one before it is written with it."""
    new_study: tuple[str, Callable[[], Iterable[tuple[Study, str]]]] | None = None
    """File of a changed study; the studies after each change, with a note that says it there. It
    is written last, as one that is not valid is refused."""
    folders: Mapping[str, Page] = field(default_factory=dict)
    """Pages of parts of the result, each in a folder of its own beside the page, by its name."""
    remarks: Sequence[str] = ()
    """Sentences that the terminal says before its tables; empty ones are left out."""
    stored: bool = True
    """Whether the summary is a file, too."""
    stem: str = ""
    """Name of .html and .json; that of the command if it is empty."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    """Entries of the table of provenance by name, beside the files that were read."""

    @property
    def name(self) -> str:
        """Name of .html and .json."""
        return self.stem or self.command.replace("-", "_")

    @property
    def beside(self) -> list[str]:
        """Names of the files beside the page and its figures."""
        study = [] if self.new_study is None else [self.new_study[0]]
        return [*study, *self.files, *([f"{self.name}.json"] if self.stored else []),
                *(f"{name}/" for name in self.folders)]

    @property
    def unplaced(self) -> list[str]:
        """Figures that no section has."""
        placed = {part.file for section in self.sections if section.about
                  for part in section.parts if isinstance(part, Drawn)}
        return [name for name in self.figures if name not in placed]


def last_sections(figures: Figures, model: Mapping[str, str]) -> list[Section]:
    """Return the pictures but that below the answer, and what model the results are of."""
    return [Section([*map(Drawn, [*figures][1:])], "Pictures"),
            Section([Table(listed(model))], "Model")]


PAGES = {
    "Assembly": "assembly_page", "SimulatedCampaign": "simulated_campaign_page",
    "DemagnetizationMap": "demagnetization_page", "Diagnosis": "diagnosis_page",
    "FieldOnLines": "field_page", "Forces": "forces_page",
    "HomogeneityResult": "homogeneity_page", "InferenceResult": "inference_page",
    "MapCheck": "map_check_page", "JoinedMaps": "map_check_page",
    "MultipoleTables": "multipoles_page", "MeasurementPlan": "plan_page",
    "MeasuredPrior": "prior_page", "Designed": "ring_design_page",
    "FilledTray": "shim_tray_page", "Shim": "shimming_page", "Solution": "solution_page",
    "SortedBlocks": "sorting_page", "Tolerance": "tolerance_page",
    "HomogeneityTolerance": "tolerance_page", "Verification": "verification_page"}
"""Module of this room whose function ``page`` returns the page of each result."""


@singledispatch
def page_of(result: object) -> Page:
    """Return the page of a result: of this room, or one that another package has registered.

    Raises
    ------
    StudyError
        If there is no page for such an object.
    """
    name = type(result).__name__
    if name in PAGES and type(result) is getattr(halbach_fe, name):
        page: Page = importlib.import_module(f"halbach_fe.report.{PAGES[name]}").page(result)
        return page
    raise StudyError(must_be(
        "result", "write_report", "what a function such as hf.solve or hf.infer has returned",
        f"a {name}", "Of hf.register the command of this name writes the files."))


def csv_file(
    columns: Mapping[str, Any], attributes: Mapping[str, str]
) -> Callable[[Path], None]:
    """Return how a table is written, for `Page.files`; ``attributes`` are comments at its top.

    Columns are of equal length, and of any kind: lists, tuples, arrays.
    """
    def write(path: Path) -> None:
        with atomic(path) as temporary:
            write_csv(columns, attributes, temporary)

    return write


def attributes(of: object, *names: str) -> Plain:
    """Return some attributes of an object as plain data."""
    return {name: getattr(of, name) for name in names}


def columns_by_axis(name: str, values: Floats) -> dict[str, Floats]:
    """Return the components of vectors (..., 3) as columns; {} in ``name`` stands for the axis."""
    return {name.format(axis): values[..., number].ravel() for number, axis in enumerate("xyz")}


@own_style
def write_files(page: Page, folder: Path, file: Path | None = None) -> Path:
    """Write all files of a page into a folder, and return the path of the page itself.

    ``file`` is that of the study, if there is one: a changed study keeps its comments.
    """
    for name, part in page.folders.items():
        write_files(part, make_folder(folder / name))
    for name, write in page.files.items():
        if write is not None:
            write(folder / name)
    if page.stored:
        write_text(folder / f"{page.name}.json",
                   json.dumps(page.summary, indent=1, allow_nan=False) + "\n")
    pictures = save(page.figures, folder)
    path = folder / f"{page.name}.html"
    write_page(path, page, pictures)
    if page.new_study is not None:
        name, steps = page.new_study
        write_changed_study(folder / name, steps(), file, page.study)
    return path


def write_changed_study(
    path: Path, steps: Iterable[tuple[Study, str]], file: Path | None, whole: Study | None = None,
) -> None:
    """Write a study after some changes, which finds the maps that it lists.

    It is edited from the text of the study's ``file``, or else from that of a ``whole`` study.
    """
    if file is None:
        write_edited(path, "" if whole is None else study_text(whole), steps)
        return
    before = read_study(file)
    if before.maps:
        steps = [(with_paths_from(study, file.parent, path.parent), note)
                 for study, note in [(before, "path from this folder"), *steps]]
    write_edited(path, file.read_text(encoding="utf-8-sig"), [(before, COMPLETE_NOTE), *steps])


def linearized(study: Study) -> str:
    """Return the sentence about a nonlinear iron; empty without one."""
    return "The iron is linearized about the nominal magnet." if is_nonlinear(study) else ""


def save(
    figures: Mapping[str, tuple[Figure | Callable[[], Figure], str]], folder: Path
) -> list[Picture]:
    """Write figures as PNG files into a folder, and return them for a page.

    ``figures``: figure, or how it is drawn, and caption, by file name.
    """
    pictures = []
    for name, (figure, caption) in figures.items():
        png = png_of(figure() if callable(figure) else figure)
        with atomic(folder / name) as temporary:
            temporary.write_bytes(png)
        pictures.append(Picture(base64.b64encode(png).decode(), caption, name))
    return pictures


def png_of(figure: Figure) -> bytes:
    """Return a figure as the content of a PNG file."""
    figure.dpi = DPI
    buffer = io.BytesIO()
    # savefig would draw everything twice, the first time to lay it out
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def write_page(path: Path, page: Page, pictures: Sequence[Picture]) -> None:
    """Write a page as self-contained HTML, and page.json beside it; ``pictures`` are from `save`.

    It ends with its provenance: the entries of its own, the files that the command has read, the
    versions of the programs, and the text of the study file as it was read.
    """
    given = page.provenance
    read = {name: file for name, file in inputs_of_command().items()
            if file not in given.values()}
    provenance = {**given, **read, "programs": programs()}
    rows = page.rows or next(iter(page.tables.values()), ())
    text = rendered("page.html.j2", page.study, page=page, pictures=pictures, provenance=provenance,
                    drawn={picture.file: picture for picture in pictures},
                    simulated=simulated_files(provenance), answer=page.answer.with_known_paths())
    write_text(path, text)
    title = re.search("<title>(.*?)</title>", text, re.S)
    write_record(path, html.unescape(title[1]) if title else "",
                 page.answer.with_known_paths(folder=False), pictures, rows, provenance, page.study)


def simulated_files(provenance: Mapping[str, str]) -> str:
    """Say which of the files that were read are simulated; nothing if none is."""
    files = [(name, file) for name, text in provenance.items() for file in text.split("; ")
             if ", simulated, SHA-256" in file]
    of_blocks = [name in ("blocks", "stock") or file.startswith("blocks") for name, file in files]
    if not files:
        return ""
    return ("The measurements of the blocks are" if all(of_blocks) else
            "The map and the measurements of the blocks are" if any(of_blocks) else
            "The map is") + " simulated, not measured."


def programs() -> str:
    """Return the names and versions of the programs that a page is made with."""
    return ", ".join([*(f"{name} {version(name)}" for name in PROGRAMS),
                      f"Python {platform.python_version()}"])


def rendered(template: str, study: Study | None = None, **data: object) -> str:
    """Return the HTML of a template of this folder; all texts in ``data`` are escaped."""
    return _templates().get_template(template).render(
        study=study, study_text=None if study is None else _study_text(study), **data)


def _study_text(study: Study) -> str:
    """Return the text of a study as it was read; page.json alone has a very large table."""
    keys = study.model_dump(mode="json", exclude_unset=True, exclude_none=True)
    table, remark = study.array.free_blocks, ""
    if table is not None and len(table) > MOST_MEASURED:
        del keys["array"]["free_blocks"]
        remark = (f"# array.free_blocks, a table of {len(table)} blocks, is in page.json beside "
                  "this page.\n")
    return remark + tomlkit.dumps({key: _item(value) for key, value in keys.items()})


@cache
def _templates() -> jinja2.Environment:
    """Return the templates of this folder, which are compiled once in a process."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("halbach_fe", "report"), autoescape=True,
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.globals |= {"faults_of": faults_in_words}
    environment.filters |= {"units_kept": units_kept, "marked": _marked}
    environment.tests |= {kind.__name__.lower(): lambda part, kind=kind: isinstance(part, kind)
                          for kind in (Text, Items, Table, Drawn, View)}
    environment.tests["empty"] = lambda part: not (
        part[0] if isinstance(part, Text | Items | Table) else part)
    return environment


def _marked(text: str) -> Markup:
    """Return a text as HTML, see `Text`."""
    text = re.sub("`(.*?)`", r"<code>\1</code>", html.escape(text))
    text = re.sub(r"\[([^]]+)\]\((\w[\w-]*(?:/\w[\w-]*)*\.html)\)", r'<a href="\2">\1</a>', text)
    return Markup(re.sub(r"\*\*(.*?)\*\*", r"<strong>\1</strong>", text))


def units_kept(text: str) -> str:
    """Return a text in which no line ends between a number and its unit or error."""
    return re.sub(rf"(?<=\d) (?=(?:{UNITS})(?!\w))|(?<=\d) (?=± \d)|(?<=±) (?=\d)", "\u00a0", text)


def _item(value: Any) -> Any:
    """Return keys and values for tomlkit, with "" for empty cells, which TOML does not have.

    A list is made at once: tomlkit appends to it in a time that grows with its length.
    """
    if isinstance(value, dict):
        return {key: _item(one) for key, one in value.items()}
    if not isinstance(value, list):
        return "" if value is None else value
    items = [_item(one) for one in value]
    if any(isinstance(one, dict) for one in items):
        return items
    parts = [part for one in items for part in (Whitespace(", "), tomlkit.item(one))]
    return Array(parts[1:], Trivia())


def figure_of(height_in: float, width_in: float = WIDEST_IN) -> Figure:
    """Return an empty figure of a height and width in inches, no wider than `WIDEST_IN`."""
    return Figure(figsize=(min(width_in, WIDEST_IN), height_in), layout="constrained")


def chart(
    height_in: float, width_in: float = WIDEST_IN, grid: bool = True
) -> tuple[Figure, Axes]:
    """Return a figure and its only axes, with a grid or without."""
    figure = figure_of(height_in, width_in)
    axis = figure.subplots()
    if grid:
        axis.grid(alpha=0.3)
    return figure, axis


def charts(
    height_in: float, rows: int = 1, columns: int = 1, **layout: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes with grids, row by row; ``layout`` is that of
    `Figure.subplots`.
    """
    figure = figure_of(height_in)
    axes = figure.subplots(rows, columns, squeeze=False, **layout).ravel().tolist()
    for axis in axes:
        axis.grid(alpha=0.3)
    return figure, axes


def legend_above(
    figure: Figure, *axes: Axes, columns: int = 2, markerscale: float | None = None
) -> Legend:
    """Put the names of what is drawn above a figure, where they hide nothing; return them.

    What several axes name alike is named once.
    """
    named = {name: shown for axis in axes for shown, name in zip(
        *axis.get_legend_handles_labels(), strict=True)}
    return figure.legend(named.values(), named.keys(), loc="outside upper center", frameon=False,
                         ncols=min(columns, len(named)), markerscale=markerscale)


def magnet_panels(what: str) -> tuple[Figure, Axes, Axes]:
    """Return a figure, and its axes for points along the magnet, over ``what``, and across it."""
    figure, (along, across) = charts(3.6, 1, 2, width_ratios=(2, 1))
    along.set(xlabel="z in the magnet in mm", ylabel=what)
    across.set(xlabel="x in the magnet in mm", ylabel="y in the magnet in mm")
    across.set_aspect("equal", adjustable="datalim")
    return figure, along, across


def draw_by_slot(axis: Axes, values: Floats, **colours: Any) -> AxesImage:
    """Draw values (rings, slots) of blocks as the colours of a grid."""
    rings, slots = values.shape
    return axis.imshow(values, aspect="auto", origin="lower",
                       extent=(0.5, slots + 0.5, 0.5, rings + 0.5), **colours)


def label_logarithmic(axis: Axis) -> None:
    """Label a logarithmic axis with numbers, such as 300, in place of powers of ten."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(LogFormatter())


def begin_at_zero(axis: Axes) -> None:
    """Let the x axis of what is drawn begin at 0, unless that would hide how the values differ."""
    low, high = axis.get_xlim()
    if low < high / 2:
        axis.set_xlim(0, None)


def axis_of_points(points: Floats) -> tuple[Floats, str]:
    """Return the abscissae (n,) of points (n, 3) in m in a figure, and the label of that axis.

    The abscissa is z; for points in a single plane the angle about z; and if one of them is on the
    axis, the number of the point.
    """
    if np.ptp(points[:, 2]) > 0:
        return 1e3 * points[:, 2], "z in mm"
    if radii_of(points).min() > 0:
        return degrees_of(points), "angle in degrees"
    return np.arange(1.0, len(points) + 1), "number of the point"


@typed
def write_report(result: object, folder: str | Path) -> Path:
    """Write the files of a result into a folder: its tables, and its HTML page with all figures.

    Parameters
    ----------
    result : Solution, InferenceResult, Diagnosis, Verification, FieldOnLines, MultipoleTables, \
HomogeneityResult, Forces, MeasuredPrior, MeasurementPlan, Designed, FilledTray, Shim, \
SortedBlocks, Assembly, Tolerance, HomogeneityTolerance, DemagnetizationMap, MapCheck, JoinedMaps \
or SimulatedCampaign
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
        drawn = importlib.import_module("halbach_fe.report.point_maps")
        return picture(drawn.geometry_figure(result, points), f"The magnet {result.name}, with the "
                       "magnetization of its blocks and the positions of its study")
    page = page_of(result)
    return f"<p>{html.escape(' '.join(page.answer.sentences))}</p>" + "".join(
        [picture(page.figures[name][0](), page.figures[name][1]) for name in page.shown]
        or map(table, page.tables.values()))


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
