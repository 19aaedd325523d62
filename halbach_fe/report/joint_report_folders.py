"""The folders of results of one magnet: what they say, in which order, and whether they fit.

Everything that is read here is data of unknown origin: run.json, page.json and figures in PNG. The
HTML of a folder is never read.
"""

from __future__ import annotations

import base64
import json
import math
import os
import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from halbach_fe.core.errors import MAX_QUOTED, OutputError, must_be, printable
from halbach_fe.core.numbers import first_of
from halbach_fe.core.result_folder import Record, Results, finished_results
from halbach_fe.geometry.array_layout import nominal_blocks
from halbach_fe.geometry.blocks import block_in_words
from halbach_fe.report.answer import PAGE_RECORD, PageRecord, Picture
from halbach_fe.report.words import counted, in_a_row
from halbach_fe.study.array_keys import BlockException
from halbach_fe.study.model import Study, differences, magnet_description

ORDER = ("design", "solve", "verify", "demagnetization", "forces", "tolerance", "plan", "sort",
         "cad", "simulate-measurement", "check", "register", "prior", "infer", "field",
         "multipoles", "homogeneity", "diagnose", "shim", "shim-tray")
"""Commands in the order in which data flow; others come last."""

TELLING = {"solve": "field", "diagnose": "diagnosis_profile", "shim": "shim_moves",
           "simulate-measurement": "campaign_field", "infer": "profile"}
"""How the name of the figure begins that says most, where that is not the first which is not of the
geometry."""

SAME_PLACE = 0.03
"""Distance of nominal places, as a fraction of a block's width, up to which two studies describe
one magnet. A diagnosis moves them by fractions of a millimetre (gaps, radii, lengths)."""

MOST_RECORD_BYTES, MOST_FIGURE_BYTES = 2**27, 2**24
"""Largest sizes of page.json (100 000 free blocks take a tenth of it) and of a figure."""

SUMMARY = "summary.json"
"""The main figures of an update."""

PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True)
class Page:
    """A page of a folder."""

    path: str
    """Its file, within the folder."""
    said: PageRecord
    picture: Picture | None
    """Its most telling figure."""


class Component(BaseModel):
    """A component of the updated field, as summary.json has it."""

    at_m: tuple[float, float, float]
    along: tuple[float, float, float]
    mean_T: float
    sd_T: float


@dataclass(frozen=True, eq=False)
class Chapter:
    """The results in a folder."""

    folder: Path
    label: str
    """The folder's name in texts."""
    record: Record
    pages: tuple[Page, ...]
    changed: tuple[str, ...]
    """Results that somebody has changed or, but for figures, removed since."""
    field: Component | None = None
    """The strongest component of the field, of an update."""

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

    def shares_study_with(self, other: Chapter) -> bool:
        """Tell whether both commands began with one file of a study.

        That of a diagnosis is what it found, which may be a magnet of another order.
        """
        mine, others = ({digest for name, digest in one.record.inputs.items()
                         if name.endswith(".toml")} for one in (self, other))
        return bool(mine & others)

    def reads_data_of(self, other: Chapter) -> bool:
        """Tell whether this command read at least the data that another one did, by their names.

        Maps and tables may have been corrected in between, and studies may be other versions.
        """
        mine, others = ({PurePath(path).name for path in one.record.inputs
                         if not path.endswith(".toml")} for one in (self, other))
        return mine >= others


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
            raise refused(f"results with a sound {PAGE_RECORD}", "whose own is damaged or of "
                          "another version of halbach-fe") from None
        except (OSError, ValueError) as error:
            raise refused(f"results with a sound {PAGE_RECORD}",
                          f"whose own cannot be read ({error})") from None
        if said.study is not None and said.study.name != record.study:
            raise refused(f"results of study {record.study}", f"with a page of {said.study.name}")
        path = PurePath(name).parent / said.page
        if str(path) not in record.files:
            raise refused("results with their page", f"whose {said.page} is none")
        pages.append(Page(str(path), said, _picture(results, path.parent, said)))
    if not pages:
        raise refused("results with a page", f"which has no {PAGE_RECORD}")
    removed = [f"{name} (removed)" for name in results.removed() if not name.endswith(".png")]
    return Chapter(results.folder, label, record, tuple(pages), (*results.changed(), *removed),
                   _field(results))


def _field(results: Results) -> Component | None:
    """Return the strongest component of the field of an update, if its summary tells."""
    if SUMMARY not in results.record.files:
        return None
    try:
        summary = json.loads(results.read(SUMMARY, MOST_RECORD_BYTES))
        return Component.model_validate(summary["strongest_field"])
    except (OSError, ValueError, KeyError, TypeError):
        return None  # changed since, or of another command


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
    magnet, whatever it changed, and so is what two commands found that began with one file.
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
        if not (any(map(one.has_study_of, chapters)) or one.shares_study_with(first)
                or is_same_magnet(its_study, study)):
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
    # Smallest cosine between nominal easy axes of one magnet: other orders differ by far more.
    same_direction = 0.98
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
    return bool((apart <= SAME_PLACE * widths).all() and (along >= same_direction).all())


FINDING = ("register", "diagnose")
"""Commands that write a study which later results should be of."""

OF_MEASURED = ("infer", "field", "multipoles", "homogeneity", "shim", "shim-tray")
"""Commands whose results are of the measured magnet, and should be of such a study."""

UPDATED_BY_MAP = ("infer", "diagnose", "shim", "shim-tray")
"""Commands that update the blocks by a map, and take measured blocks too."""

EXCEPTIONS = "array.exceptions"
"""Key of the blocks that deviate from the array."""

MOST_FILES, MOST_KEYS, MOST_VALUE = 6, 3, 40
"""Largest numbers of files and of keys that a sentence names, and of characters of a value."""

WRITTEN, OF_SAME_MAGNET, OF_ANOTHER_MAGNET = "written", "of the same magnet", "of another magnet"
"""How a version of the study belongs to the first one: a command wrote it, or it has the same
magnet, or neither."""

OF_MAPPER = ("instrument", "instrument_sd", "maps")
"""Tables of the study in which register writes the poses of maps and the probe."""


def doubts(chapters: Sequence[Chapter]) -> list[str]:
    """Return a sentence for everything that does not fit together."""
    return [*_changed(chapters), *_out_of_date(chapters), *_other_files(chapters),
            *_unused_findings(chapters), *_unused_blocks(chapters), *_unrelated(chapters),
            *_contradictions(chapters),
            *(text for text, kind in _versions(chapters) if kind == OF_ANOTHER_MAGNET)]


def versions(chapters: Sequence[Chapter]) -> list[tuple[str, str]]:
    """Return a sentence for every version of the study of which there are results by intent.

    Each comes with whether a command wrote that version, `WRITTEN`, or not, `OF_SAME_MAGNET`.
    """
    return [(text, kind) for text, kind in _versions(chapters) if kind != OF_ANOTHER_MAGNET]


def _changed(chapters: Sequence[Chapter]) -> list[str]:
    """Name results that are not as their run has left them."""
    return [f"Changed since the run in {one.label}: {', '.join(one.changed[:MOST_FILES])}."
            for one in chapters if one.changed]


def _out_of_date(chapters: Sequence[Chapter]) -> list[str]:
    """Name results that were computed with an earlier version of another one."""
    present = {digest for one in chapters for digest in one.record.files.values()}
    found = []
    for one in chapters:
        names: dict[str, list[str]] = {}
        for path, digest in one.record.inputs.items():
            name = PurePath(path).name
            holders = [other for other in chapters if other is not one
                       and name in {PurePath(file).name for file in other.digests.values()}]
            if holders and digest not in present:
                hold = _listed(holders, "holds", "hold")
                names.setdefault(hold, []).append(name)
        found += [f"{one.label} is out of date: it was computed with another {in_a_row(files)} "
                  f"than {hold}. Run {one.record.command} again, or leave out what does not belong "
                  "to it." for hold, files in names.items()]
    return found


def _other_files(chapters: Sequence[Chapter]) -> list[str]:
    """Name files of one name that had different contents; studies are compared by their keys."""
    by_name: dict[str, dict[str, set[str]]] = {}
    results = {PurePath(file).name for one in chapters for file in one.digests.values()}
    for one in chapters:
        for path, digest in one.record.inputs.items():
            by_name.setdefault(PurePath(path).name, {}).setdefault(one.label, set()).add(digest)
    found = []
    for name, by_label in by_name.items():
        if name.endswith(".toml") or name in results:
            continue
        apart = [pair for pair in combinations(by_label, 2)
                 if not by_label[pair[0]] & by_label[pair[1]]]
        if apart:
            found.append(f"{' and '.join(apart[0])} read different files called {name}.")
    return found


def _unused_findings(chapters: Sequence[Chapter]) -> list[str]:
    """Name studies with findings that no result here is of."""
    found = []
    for one in chapters:
        found_nothing = not any(page.said.answer is None or page.said.answer.changes_study
                                for page in one.pages) or (
            # a pose in which the magnet does not explain the map is none to use
            one.verb == "register" and not one.sound)
        written = [] if found_nothing or not one.record.inputs else [
            name for name in one.digests.values() if name.endswith(".toml")]
        later = [other for other in chapters if other.verb in OF_MEASURED]
        if one.verb in FINDING and written and later and not any(
                other.has_study_of(one) for other in chapters):
            found.append(f"No result here is of {one.label}/{written[0]}: {_listed(later)} "
                         f"without what {one.record.command} has found.")
    return found


def _unused_blocks(chapters: Sequence[Chapter]) -> list[str]:
    """Name updates by a map without the measured blocks that other results here are of."""
    known = [one for one in chapters if "BLOCKS" in one.record.named]
    verbs = {one.verb for one in known}
    without = [one for one in chapters if one.verb in UPDATED_BY_MAP and one.verb not in verbs
               and "MAP" in one.record.named and "BLOCKS" not in one.record.named]
    if not known or not without:
        return []
    return [f"{_listed(without)} without the measured blocks that "
            f"{_listed(known, 'has', 'have')} read, and "
            f"{'knows' if len(without) == 1 else 'know'} less of the magnet: run "
            f"{in_a_row(list(dict.fromkeys(one.record.command for one in without)))} again with "
            "--blocks."]


def _contradictions(chapters: Sequence[Chapter]) -> list[str]:
    """Name updates whose fields at one place differ by more than their error bars allow.

    A sound one stands for another that read no more data, if that is not sound, or if it is itself
    of a study that a command has written, such as that of a diagnosis.
    """
    allowed = 5.0  # standard deviations of the difference, as if the updates shared nothing
    found = []
    for (one, mine), (other, its) in combinations([
            (each, each.field) for each in chapters if each.field is not None], 2):
        apart = abs(mine.mean_T - its.mean_T)
        is_settled = any(
            good.sound and good.reads_data_of(bad) and (
                not bad.sound or any(map(good.has_study_of, chapters)))
            for good, bad in ((one, other), (other, one)))
        if (mine.at_m, mine.along) == (its.at_m, its.along) and not is_settled and (
                apart > allowed * math.hypot(mine.sd_T, its.sd_T)):
            place = ", ".join(f"{round(1e3 * value, 6) + 0.0:.6g}" for value in mine.at_m)
            found.append(
                f"{one.label} and {other.label} contradict each other: at ({place}) mm they have "
                f"fields of {1e3 * mine.mean_T:.6g} and {1e3 * its.mean_T:.6g} mT, "
                f"{1e3 * apart:.3g} mT apart, with error bars of {1e3 * mine.sd_T:.2g} and "
                f"{1e3 * its.sd_T:.2g} mT. At least one of them leaves out an error of its probe: "
                "give `instrument_sd.gain`, or compare their maps by halbach-fe check.")
    return found


def _unrelated(chapters: Sequence[Chapter]) -> list[str]:
    """Name results without a study whose input no other result has to do with."""
    found = []
    for one in chapters:
        inputs = set(one.record.inputs.values())
        others = [other for other in chapters if other is not one]
        if one.study is None and not any(
                inputs & {*other.record.inputs.values(), *other.record.files.values()}
                or other.uses(one) for other in others):
            found.append(f"{one.label} is of a file that no other result here is of: "
                         f"{', '.join(one.record.inputs) or 'an unknown one'}.")
    return found


def _versions(chapters: Sequence[Chapter]) -> list[tuple[str, str]]:
    """Say how each version of the study differs from the first, and how it belongs to that."""
    groups: list[tuple[Study, list[Chapter]]] = []
    for one in chapters:
        if (study := one.study) is None:
            continue
        of_same = [group for version, group in groups if all(
            # the study of an update has the instrument that it found
            key.partition(".")[0] in OF_MAPPER and any(map(one.shares_study_with, group))
            for key in differences(_plain(version), _plain(study)))]
        if of_same:
            of_same[0].append(one)
        else:
            groups.append((study, [one]))
    found = []
    for study, group in groups[1:]:
        first = groups[0][0]
        source = next(((other, name) for one in group for other in chapters
                       for name in one.uses(other) if name.endswith(".toml")), None)
        changed = differences(_plain(first), _plain(study))
        if source is not None and source[0].verb == "register":
            if study.maps and not first.maps:  # the page of one map is of a study of that alone
                changed = min((differences(_plain(first), _plain(study.of_map(number)))
                               for number in range(len(study.maps))), key=len)
            # its numbers are on its own page
            changed = {key: values for key, values in changed.items()
                       if key.partition(".")[0] not in OF_MAPPER}
        texts = [_difference(key, old, new) for key, (old, new) in changed.items()]
        changes = first_of(texts, MOST_KEYS, "; ")
        of = f"{_listed(group)} of"
        if source is not None:
            other, name = source
            wrote = f"{of} {other.label}/{name}, which {other.record.command} wrote"
            if other.verb == "register":
                wrote += (" with the poses of maps and the errors of the probe that it found"
                          f"{'. Beside these' if changes else '; nothing else differs'}")
            found.append((f"{wrote}{f': {changes}' if changes else ''}.", WRITTEN))
        else:
            same = magnet_description(first) == magnet_description(study)
            found.append((f"{of} another version of the study than {groups[0][1][0].label}: "
                          f"{changes}.", OF_SAME_MAGNET if same else OF_ANOTHER_MAGNET))
    return found


def _plain(study: Study) -> dict[str, Any]:
    """Return a study as plain data, without paths, which start from the folder of its file."""
    found = study.model_dump(mode="json", exclude={"description"})
    found["maps"] = [one | {"file": None} for one in found["maps"]]
    # those by 0 only hold what `uncertain` changes
    found["array"]["exceptions"] = [one for one in found["array"]["exceptions"] if _own(one)]
    return found


def _difference(key: str, old: Any, new: Any) -> str:
    """Say how a key differs between two versions of a study."""
    if any(isinstance(value, list) and value and isinstance(value[0], dict)
           for value in (old, new)):
        before, now = len(old or ()), len(new or ())
        if key == EXCEPTIONS and 0 < now - before <= MOST_KEYS and new[:before] == (old or []):
            return f"{key} has {in_a_row([_exception(one) for one in new[before:]])} besides"
        if before == now:
            return f"{key} has {counted(now, 'entry', 'entries')}, as before, but not the same"
        return f"{key} has {counted(now, 'entry', 'entries') if now else 'no entry'}, and " + (
            f"{before or 'none'} before")
    if old in (None, []):
        return f"{key} is {'given' if isinstance(new, dict) else _short(new)}, and was not before"
    if new in (None, []):
        known = "given" if isinstance(old, dict) else _short(old)
        return f"{key} is not given, and was {known} before"
    return f"{key} is {_short(new)} instead of {_short(old)}"


def _exception(entry: dict[str, Any]) -> str:
    """Return an entry of `array.exceptions` in words: the block, and what it deviates by."""
    own = ", ".join(_key_in_words(key, value) for key, value in _own(entry).items())
    place = block_in_words(entry["ring"] or 0, entry["slot"] or 0) or "all blocks"
    return f"{place} ({own})"


def _own(entry: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of an entry of `array.exceptions` by which blocks deviate."""
    usual = BlockException().model_dump(mode="json")
    return {key: value for key, value in entry.items() if key not in ("ring", "slot")
            and value != usual[key]
            and (value or key not in ("inner_corner_loss", "magnetization_gradient"))}


def _key_in_words(key: str, value: Any) -> str:
    """Return a key and its value; a displacement in mm."""
    if key == "shift_m":
        x, y, z = (f"{1e3 * part:.3f}".replace("-", "\u2212") for part in value)
        return f"moved by x {x}, y {y}, z {z} mm"
    return f"{key} = {_short(value)}"


def _short(value: Any) -> str:
    """Return a value of a key as a short text."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list) and all(isinstance(one, float) for one in value):
        rounding = 1e-9 * max((abs(one) for one in value if math.isfinite(one)), default=0.0)
        text = ", ".join(f"{0.0 if abs(one) <= rounding else one:.4g}" for one in value)
    else:
        text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= MOST_VALUE else f"{text[:MOST_VALUE]}…"


def _listed(chapters: Sequence[Chapter], singular: str = "is", plural: str = "are") -> str:
    """Return the names of folders in words, and the verb of the sentence."""
    return (f"{in_a_row([one.label for one in chapters])} "
            f"{singular if len(chapters) == 1 else plural}")
