"""The folders of results of one magnet: what they say, in which order, and whether they fit.

Everything that is read here is data of unknown origin: run.json, page.json and figures in PNG. The
HTML of a folder is never read.
"""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath

import numpy as np
from pydantic import ValidationError

from halbach_fe.core.errors import MAX_QUOTED, OutputError, must_be, printable
from halbach_fe.core.result_folder import Record, Results, finished_results
from halbach_fe.geometry.array_layout import nominal_blocks
from halbach_fe.report.page_record import PAGE_RECORD, PageRecord, Picture
from halbach_fe.study.model import Study, differences, magnet_description

ORDER = ("design", "solve", "verify", "demagnetization", "forces", "tolerance", "plan", "sort",
         "cad", "simulate-measurement", "check", "register", "prior", "infer", "multipoles",
         "homogeneity", "diagnose", "shim", "shim-tray")
"""Commands in the order in which data flow; others come last."""

TELLING = {"solve": "field", "diagnose": "diagnosis_profile", "shim": "shim_moves",
           "simulate-measurement": "campaign_field", "infer": "profile"}
"""How the name of the figure begins that says most, where that is not the first which is not of the
geometry."""

SAME_PLACE = 0.03
"""Distance of nominal places, as a fraction of a block's width, up to which two studies describe
one magnet. A diagnosis moves them by fractions of a millimetre (gaps, radii, lengths)."""

SAME_DIRECTION = 0.98
"""Smallest cosine between nominal easy axes of one magnet: other orders differ by far more."""

MOST_RECORD_BYTES, MOST_FIGURE_BYTES = 2**27, 2**24
"""Largest sizes of page.json (100 000 free blocks take a tenth of it) and of a figure."""

PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Page:
    """A page of a folder.

    Attributes
    ----------
    path : str
        Its file, within the folder.
    said : PageRecord
    picture : Picture or None
        Its most telling figure.
    """

    path: str
    said: PageRecord
    picture: Picture | None


@dataclass(frozen=True, eq=False)
class Chapter:
    """The results in a folder.

    Attributes
    ----------
    folder : Path
    label : str
        The folder's name in texts.
    record : Record
    pages : tuple of Page
    changed : tuple of str
        Results that somebody has changed since.
    """

    folder: Path
    label: str
    record: Record
    pages: tuple[Page, ...]
    changed: tuple[str, ...]

    @property
    def verb(self) -> str:
        """The command without ``halbach-fe``."""
        return self.record.command.rpartition(" ")[2]

    @property
    def study(self) -> Study | None:
        """The study that the results are of, if they are of one."""
        return self.pages[0].said.study

    @property
    def sound(self) -> bool:
        """Whether all its answers may be used as they stand."""
        return all(page.said.answer is None or page.said.answer.sound for page in self.pages)

    @cached_property
    def digests(self) -> dict[str, str]:
        """The results that are not mere copies of an input: names by SHA-256."""
        return {digest: name for name, digest in self.record.files.items()
                if digest not in self.record.inputs.values()}

    def uses(self, other: Chapter) -> list[str]:
        """Return the results of another folder that were inputs here."""
        return [other.digests[digest] for digest in self.record.inputs.values()
                if other is not self and digest in other.digests]

    def has_study_of(self, other: Chapter) -> bool:
        """Tell whether the study is one that the other command has written."""
        return any(name.endswith(".toml") for name in self.uses(other))


def read_chapters(folders: Sequence[Path]) -> list[Chapter]:
    """Read folders of results, and bring them into the order in which data flow.

    Raises
    ------
    OutputError
        If one of them holds no finished results, is given twice, or is of another magnet.
    """
    labels = _labels(folders)
    with ExitStack() as stack:
        chapters = [_chapter(stack.enter_context(finished_results(folder)), label)
                    for folder, label in zip(folders, labels, strict=True)]
    chapters = in_order(chapters)
    _check_same_magnet(chapters)
    return chapters


def _labels(folders: Sequence[Path]) -> list[str]:
    """Return the paths of folders from the folder that all lie in."""
    places = [folder.resolve() for folder in folders]
    for number, place in enumerate(places):
        if place in places[:number]:
            raise OutputError(must_be("DIR", "the report", "given once", f"{folders[number]} twice",
                                      "Leave one out."))
    common = Path(os.path.commonpath([place.parent for place in places]))
    return [printable(place.relative_to(common), MAX_QUOTED) for place in places]


def _chapter(results: Results, label: str) -> Chapter:
    """Return what a folder says; raise OutputError if it is not as a command leaves it."""
    record = results.record

    def refused(expected: str, received: str) -> OutputError:
        return OutputError(must_be("DIR", "the report", expected, f"{results.folder}, {received}",
                                   "Leave it out, or run the command again."))

    if not re.fullmatch("halbach-fe [a-z][a-z-]*", record.command) or (
            record.command == "halbach-fe report"):
        raise refused("results of a command of halbach-fe", f"of `{record.command}`")
    pages = []
    for name in record.files:
        if PurePath(name).name != PAGE_RECORD:
            continue
        try:
            said = PageRecord.model_validate_json(results.read(name, MOST_RECORD_BYTES))
        except ValidationError:
            raise refused(f"results with a sound {PAGE_RECORD}", "whose is damaged or of another "
                          "version of halbach-fe") from None
        except (OSError, ValueError) as error:
            raise refused(f"results with a sound {PAGE_RECORD}",
                          f"whose cannot be read ({error})") from None
        if said.study is not None and said.study.name != record.study:
            raise refused(f"results of study {record.study}", f"with a page of {said.study.name}")
        path = PurePath(name).parent / said.page
        if str(path) not in record.files:
            raise refused("results with their page", f"whose {said.page} is none")
        pages.append(Page(str(path), said, _picture(results, path.parent, said)))
    if not pages:
        raise refused("results with a page", f"which has no {PAGE_RECORD}")
    return Chapter(results.folder, label, record, tuple(pages), tuple(results.changed()))


def _picture(results: Results, folder: PurePath, said: PageRecord) -> Picture | None:
    """Return the most telling figure of a page, if there is one."""
    verb = results.record.command.rpartition(" ")[2]
    figures = [one for one in said.figures if "geometry" not in one.file]
    figures.sort(key=lambda one: not one.file.startswith(TELLING.get(verb, one.file)))
    for one in figures:
        try:
            content = results.read(str(folder / one.file), MOST_FIGURE_BYTES)
        except (OSError, ValueError):
            continue  # somebody has removed it
        if content.startswith(PNG):
            return Picture(base64.b64encode(content).decode(), one.caption, one.file)
    return None


def in_order(chapters: Sequence[Chapter]) -> list[Chapter]:
    """Return chapters in the order in which data flow, each after those whose results it used."""
    def rank(chapter: Chapter) -> tuple[int, str, str]:
        place = ORDER.index(chapter.verb) if chapter.verb in ORDER else len(ORDER)
        return place, chapter.record.ended, chapter.label

    waiting, found = sorted(chapters, key=rank), list[Chapter]()
    while waiting:
        free = (one for one in waiting if not any(map(one.uses, waiting)))
        found.append(next(free, waiting[0]))  # a circle can only be forged
        waiting.remove(found[-1])
    return found


def _check_same_magnet(chapters: Sequence[Chapter]) -> None:
    """Refuse results of several magnets.

    A study that another of these commands has written (study.diagnosed.toml) is one of the same
    magnet, whatever it changed.
    """
    of_study = [(one, one.study) for one in chapters if one.study is not None]
    if not of_study:
        raise OutputError(must_be("DIR", "the report", "results of a magnet",
                                  "results without a study only", "Add a folder, of solve, say."))
    first, its_study = of_study[0]
    for one, study in of_study[1:]:
        if study.name != its_study.name:
            raise OutputError(must_be(
                "DIR", "the report", "results of one magnet", f"{first.folder} of study "
                f"{its_study.name} and {one.folder} of study {study.name}", "Leave one out."))
        if not any(map(one.has_study_of, chapters)) and not is_same_magnet(its_study, study):
            changed = differences(magnet_description(its_study), magnet_description(study))
            key = next(iter(changed), "array")
            raise OutputError(must_be(
                "DIR", "the report", "results of one magnet",
                f"{first.folder} and {one.folder} of magnets with another `{key}`",
                "Leave one out, or add the folder of the command that changed the study."))


def is_same_magnet(one: Study, other: Study) -> bool:
    """Tell whether two studies describe one magnet: as many blocks, in nearly the same places.

    Properties of the material, deviations of single blocks and iron may differ.
    """
    if one.dimension != other.dimension:
        return False
    blocks, others = (nominal_blocks(each.array, each.dimension) for each in (one, other))
    if len(blocks) != len(others):
        return False
    apart = np.linalg.norm([a.middle - b.middle for a, b in zip(blocks, others, strict=True)],
                           axis=1)
    widths = np.sqrt([abs(block.area) for block in blocks])
    along = np.einsum("ij,ij->i", [block.easy_axis for block in blocks],
                      [block.easy_axis for block in others])
    return bool((apart <= SAME_PLACE * widths).all() and (along >= SAME_DIRECTION).all())
