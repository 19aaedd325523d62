"""One page of all results of a magnet: the answer of every command, and links to their pages."""

from __future__ import annotations

import base64
import os
import re
import shlex
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path, PurePath
from urllib.parse import quote

from halbach_fe.core.errors import MAX_QUOTED, MAX_SENTENCE, OutputError, must_be, printable
from halbach_fe.core.files import as_path, write_text
from halbach_fe.core.interface import typed
from halbach_fe.core.result_folder import result_folder, single_file
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.positions import points_from
from halbach_fe.report.answer import Answer, Picture
from halbach_fe.report.joint_report_folders import (
    OF_MEASURED,
    WRITTEN,
    Chapter,
    Page,
    doubts,
    read_chapters,
    versions,
)
from halbach_fe.report.page import Plain, Rows, own_style, png_of, programs, rendered
from halbach_fe.report.point_maps import geometry_figure
from halbach_fe.report.words import counted, in_a_row, in_one_line, within_a_sentence
from halbach_fe.study.model import Study

PAGE, PAGES = "report.html", (".html", ".htm")

DIAGNOSED = "study.diagnosed.toml"
"""The study that halbach-fe diagnose writes, with what was missing."""

POSTERIOR = "posterior.h5"
"""The updated blocks that halbach-fe infer writes."""


@dataclass(frozen=True)
class Campaign:
    """What folders of results say about one magnet."""

    chapters: tuple[Chapter, ...]
    """In the order in which data flow."""

    @cached_property
    def study(self) -> Study:
        """The study of the first results."""
        return next(one.study for one in self.chapters if one.study is not None)

    @cached_property
    def doubts(self) -> list[str]:
        """What does not fit together, in sentences."""
        return [printable(text, MAX_SENTENCE) for text in doubts(self.chapters)]

    @cached_property
    def versions(self) -> list[str]:
        """How versions of the study differ by intent, in sentences."""
        return [printable(text, MAX_SENTENCE) for text, _ in versions(self.chapters)]

    @property
    def _studies(self) -> str:
        """What studies the results are of, in words."""
        if not self.versions:
            return "one study"
        if all(kind == WRITTEN for _, kind in versions(self.chapters)):
            return "versions of the study that follow from each other"
        return "versions of the study that have the same magnet and differ as is said below"

    @property
    def answered(self) -> list[tuple[Chapter, Page, Answer]]:
        """All answers, with the folders that hold what their commands name."""
        return [(chapter, page, _with_folder(page.said.answer, chapter).with_paths(self.named))
                for chapter in self.chapters for page in chapter.pages
                if page.said.answer is not None]

    @cached_property
    def named(self) -> dict[str, str]:
        """Maps, blocks and posterior, if all results use the same, by the words of commands."""
        found: dict[str, set[str | None]] = {word: set() for word in ("MAP", "BLOCKS", "HELD_OUT")}
        found["POSTERIOR"] = {
            _from_here(one.folder / POSTERIOR) for one in self.chapters if one.verb == "infer"
            and POSTERIOR in one.record.files and self.replaced(one) is None}
        for one in self.chapters:
            for word in found.keys() & one.record.named.keys():
                found[word].add(_from_here(Path(one.record.named[word])))
        return {word: path for word, paths in found.items()
                if len(paths) == 1 and (path := paths.pop()) is not None}

    def continued(self, chapter: Chapter, answer: Answer) -> Chapter | None:
        """Return the later chapter of the command that an answer names as the next step.

        A command that names files which ``chapter`` has written is that of results with these
        files only: a map that was there before blocks were sorted is not of the sorted blocks.
        """
        verb = re.match("halbach-fe ([a-z-]+)", answer.command)
        later = self.chapters[self.chapters.index(chapter) + 1:]
        names = {PurePath(word.strip("'")).name for word in answer.command.split() if "/" in word}
        own = names & {PurePath(name).name for name in chapter.record.files}
        return next((one for one in later if verb and one.verb == verb[1] and (
            not own or one.uses(chapter))), None)

    def done_before(self, chapter: Chapter, answer: Answer) -> Chapter | None:
        """Return an earlier chapter of the command of an answer, if it read what this one did.

        Or if it is of a result that did, as of the posterior by the same map. A command that names
        files which ``chapter`` has written, or new ones, was not run before.
        """
        verb = re.match("halbach-fe ([a-z-]+)", answer.command)
        new = {*(PurePath(name).name for name in chapter.record.files), "NEW_MAP"}
        if new & {PurePath(word.strip("'")).name for word in answer.command.split()}:
            return None
        return next((one for one in self.chapters[:self.chapters.index(chapter)]
                     if verb and verb[1] == one.verb != chapter.verb
                     and set(chapter.record.inputs.values()) <= self._read_for(one)), None)

    def _read_for(self, chapter: Chapter) -> set[str]:
        """Return the digests of all that a chapter and the results behind it have read."""
        return set(chapter.record.inputs.values()).union(*(
            other.record.inputs.values() for other in self.chapters if chapter.uses(other)))

    def replaced(self, chapter: Chapter) -> Chapter | None:
        """Return a later chapter of the same command, whose answers may all be used.

        It read the same data or more: by one of two maps, whose probes disagree, the answer may be
        sound and wrong. A diagnosis of the study that `register` wrote fits the pose anew, with the
        cause that the registration lacked, and so takes its place.
        """
        later = self.chapters[self.chapters.index(chapter) + 1:]
        return next((one for one in later if one.sound and one.reads_data_of(chapter) and (
            one.verb == chapter.verb or (
                (chapter.verb, one.verb) == ("register", "diagnose") and one.uses(chapter)))), None)

    @property
    def answer(self) -> Answer:
        """What is known of the magnet, what may be used as it stands, and what is left to do."""
        unsound = list(dict.fromkeys(each for each, _, answer in self.answered if not answer.sound))
        left = [each.label for each in unsound if self.replaced(each) is None]
        instead = [f"Do not trust folder {each.label}: folder {better.label} takes its place."
                   for each in unsound if (better := self.replaced(each)) is not None]
        simulated = [f"folder {one.label}" for one in self.chapters
                     if one.verb == "simulate-measurement"]
        loses = any(chapter.verb == "demagnetization" for chapter in self._concerned())
        said = " ".join([
            *self._newest(), *self._concerns(),
            f"{'This is' if len(self.chapters) == 1 else 'These are'} "
            f"{counted(len(self.chapters), 'result')} of one magnet.",
            *([f"The map of {in_a_row(simulated)} is simulated, not measured."] if simulated
              else []), *instead,
            f"Not to be trusted as {'it is' if len(left) == 1 else 'they are'}: "
            f"{', '.join(f'folder {each}' for each in left)}."
            if left else "They do not all fit together." if self.doubts else
            "The other answers hold as far as the magnet keeps its magnetization." if loses else
            f"{'All others' if instead else 'The answers'} may be used"
            f"{', for a test' if simulated else ' as they stand'}."])
        trust = (
            "No: they do not all fit together, as is said below." if self.doubts else
            f"{self._verdict(left)}: {self._trust_of_update()} of {self._studies}, and no file was "
            "changed since. How far each can be trusted stands with it below.")
        last = self._next()
        step = last.step if last else "Nothing that the results name is left to do."
        if loses:
            step = (f"Settle first what is said above of losses at its temperature, as what comes "
                    f"after rests on the magnetization. Then: {step}")
        if simulated:
            step = f"If this were a measured magnet: {step}"
        if self.doubts and not left:
            step = f"Mend what does not fit together, as the list below says. After that: {step}"
        return Answer("What is known of this magnet?", said, trust, step,
                      last.command if last else "", sound=not (self.doubts or left),
                      gist=self._gist(), numbers=self._numbers())

    def _used(self, *verbs: str) -> list[tuple[Page, Answer]]:
        """Return the pages and answers of commands that no later result replaces, sound ones if
        there are any, in the order of ``verbs`` and then of the page.
        """
        found = [(page, answer) for verb in verbs for chapter, page, answer in self.answered
                 if chapter.verb == verb and self.replaced(chapter) is None]
        return [each for each in found if each[1].sound] or found

    def _numbers(self) -> tuple[tuple[str, str], ...]:
        """Return the field in the region of an MRI magnet, and the largest force; or else how far
        off the first update began and the last one ended; or else what the last result says.
        """
        region = [one.numbers for _, one in self._used("homogeneity")[-1:]]
        if region and region[0]:
            return region[0] + tuple(each for _, one in self._used("forces")[-1:]
                                     for each in one.numbers)
        updates = [answer.numbers for chapter, _, answer in self.answered
                   if chapter.verb == "infer" and answer.numbers]
        last = [answer.numbers for _, answer in self._used("infer") if answer.numbers]
        if updates:
            return updates[0][:1] + (last or updates)[-1][1:]
        return next((answer.numbers for _, _, answer in reversed(self.answered)
                     if answer.numbers), ())

    def _gist(self) -> str:
        """Say what is known of the magnet and, if large type has room for it, of its map; empty
        without either.
        """
        updates = [answer for _, answer in self._used("infer")]
        explained = bool(updates) and updates[-1].sound
        found = [answer for _, answer in self._used("diagnose")
                 if answer.changes_study or not explained]
        magnet = found[-1:] or updates[-1:]
        of_map = [answer for _, answer in self._used("check", "register")[-1:]]
        said = [one.headline for one in magnet + of_map]
        both = Answer("", "", "", "", gist=" ".join(said), numbers=self._numbers())
        return both.gist if both.headline == both.gist else said[0]

    def lead(self) -> Picture | None:
        """Return the picture that says most of all: of the region, or of the last update."""
        return next((page.picture for verb in ("homogeneity", "infer", "diagnose")
                     for page, _ in reversed(self._used(verb)) if page.picture is not None), None)

    def _verdict(self, left: Sequence[str]) -> str:
        """Say whether all answers can be trusted, and else why not the last of those that cannot,
        whose folders are ``left``.
        """
        if not left:
            return "Yes"
        last = [answer for chapter, _, answer in self.answered
                if chapter.label == left[-1] and not answer.sound][-1].short_trust
        why = re.match(r"No[:.,] (.*?)\.?$", last)
        reason = within_a_sentence(why[1]) if why else "for the reasons that stand below"
        if not any(answer.sound for _, _, answer in self.answered):
            return f"No: {reason}. But the results belong together"
        return f"Not {in_a_row([f'folder {each}' for each in left])}: {reason}. The others, yes"

    def _trust_of_update(self) -> str:
        """Say why the last update can be trusted, unless it cannot, and begin the sentence that
        says which studies the results are of.
        """
        said = [answer.trust.removeprefix("Yes. ").partition(". ")[0].rstrip(".")
                for _, answer in self._used("infer")[-1:] if answer.sound]
        return f"{within_a_sentence(said[0])}. The results are" if said else "they are"

    def _newest(self) -> list[str]:
        """Return the last answer about the measured magnet that may be used, and before it that of
        its diagnosis.
        """
        sound = [(chapter.verb, answer.said) for chapter, _, answer in self.answered
                 if answer.sound]
        found = [said for verb, said in sound if verb == "diagnose"]
        measured = [(verb, said) for verb, said in sound if verb in OF_MEASURED]
        field = [said.partition(". ")[0] + "." for verb, said in measured[:-1] if verb == "infer"]
        return [*found[-1:], *field[-1:], *(said for _, said in measured[-1:])]

    def _concerns(self) -> list[str]:
        """Return what is bad about the magnet, unless a later result of that command is good."""
        concerned = self._concerned()
        return list(dict.fromkeys(answer.concern for chapter, _, answer in self.answered
                                  if answer.concern and chapter in concerned))

    def _concerned(self) -> list[Chapter]:
        """Return the chapters that say something bad about the magnet."""
        return [chapter for chapter, _, answer in self.answered
                if answer.concern and self.replaced(chapter) is None]

    def _next(self) -> Answer | None:
        """Return the answer whose next step is the one to take.

        It is that of an answer which may not be used; or else of the last one about the measured
        magnet, if there is any. Its command names the folder of that answer.
        """
        left = [(chapter, self._unless_done(chapter, answer.with_paths({"DIR": chapter.folder})))
                for chapter, _, answer in self.answered if self.continued(chapter, answer) is None]
        unsound = [self._with_what_was_found(chapter, answer) for chapter, answer in left
                   if not answer.sound and self.replaced(chapter) is None]
        measured = [answer for chapter, answer in reversed(left) if chapter.verb in OF_MEASURED]
        return next(iter([*unsound, *measured, *(answer for _, answer in reversed(left))]), None)

    def _unless_done(self, chapter: Chapter, answer: Answer) -> Answer:
        """Return an answer without the command that an earlier chapter has run already."""
        earlier = self.done_before(chapter, answer)
        return answer if earlier is None else replace(
            answer, step=f"{answer.step} See folder {earlier.label} for that.", command="")

    def _with_what_was_found(self, chapter: Chapter, answer: Answer) -> Answer:
        """Return the next step of an answer that may not be used.

        It is its own, or for results of the measured magnet to repeat their commands if the study
        has been diagnosed already; if that diagnosis may not be used either, it is what the
        diagnosis says.
        """
        found = next((one for one in self.chapters if one.verb == "diagnose"
                      and DIAGNOSED in one.record.files and not chapter.has_study_of(one)), None)
        if found is None or chapter.verb not in (*OF_MEASURED, "register"):
            return answer
        if not found.sound:
            return next(own.with_paths({"DIR": found.folder}) for one, _, own in self.answered
                        if one is found)
        again = [one.label for one in dict.fromkeys(each for each, _, own in self.answered
                                                    if not own.sound)
                 if one.verb in (*OF_MEASURED, "register") and self.replaced(one) is None
                 and not one.has_study_of(found)]
        repeat = (f"Repeat {in_a_row(again)} with {found.label}/{DIAGNOSED}, which has what "
                  f"{'its' if len(again) == 1 else 'their'} study lacks.")
        concern = next((own.concern for one, _, own in self.answered
                        if one is found and own.concern), "")
        return replace(answer, command="", step=repeat if not concern else (
            "Put right what was not assembled as designed, and measure again. Or, if it stays, "
            f"{within_a_sentence(repeat)}"))

    def plain(self) -> Plain:
        """Return the answers and what does not fit as plain data."""
        return {"study": self.study.name, "answer": asdict(self.answer), "doubts": self.doubts,
                "versions": self.versions, "results": [
                    {"folder": chapter.label, "command": chapter.record.command,
                     "ended": chapter.record.ended, "page": page.path,
                     "answer": None if page.said.answer is None else asdict(page.said.answer)}
                    for chapter in self.chapters for page in chapter.pages]}


def _from_here(path: Path) -> str | None:
    """Return a path relative to the current folder, where commands are run; None if it is not in
    it: the page says nothing of other folders.
    """
    here, whole = Path.cwd(), path.absolute()
    return printable(str(whole.relative_to(here)), MAX_QUOTED) if (
        whole.is_relative_to(here) and ".." not in whole.parts) else None


def _with_folder(answer: Answer, chapter: Chapter) -> Answer:
    """Return an answer whose command has the folder of the files that its own command wrote.

    An input whose path leads nowhere from the current folder is called by its word, as STUDY: the
    path was that from the folder in which the command ran.
    """
    gone = {path: word for word, path in chapter.record.named.items() if not Path(path).exists()}

    def named(found: re.Match[str]) -> str:
        if found[1] not in chapter.record.files:
            return found[0]
        place = chapter.folder / found[1]  # as it was given; the page names no absolute path
        return shlex.quote(_from_here(place) or printable(
            f"{chapter.label}/{found[1]}" if place.is_absolute() else str(place), MAX_QUOTED))

    words = (gone.get(word, word) for word in answer.command.split(" "))
    return replace(answer, command=re.sub(r"DIR/(\S+)", named, " ".join(words)))


def read_campaign(folders: Sequence[str | Path], output: Path | None = None) -> Campaign:
    """Read the results of one magnet; see `campaign_report`.

    The folder ``output`` of the report itself, which wildcards may name too, is left out. A file
    that would be no page is refused by an OutputError.
    """
    if output is not None and output.suffix[1:].isalpha() and not (
            output.suffix.lower() in PAGES or output.is_dir()):
        raise OutputError(must_be(
            "-o", "halbach-fe report", "a page (.html), or a folder for report.html",
            f"'{output}'", f"Write {output.with_suffix(PAGES[0])}."))
    paths = [] if isinstance(folders, str | Path) else [
        path for path in map(as_path, folders) if output is None
        or path.resolve() != output.resolve()]
    if not paths:
        raise OutputError(must_be(
            "folders", "the report", "a list of folders of results other than its own",
            str(folders) if isinstance(folders, str | Path)
            else ", ".join(map(str, folders)) or "none"))
    return Campaign(tuple(read_chapters(paths)))


@typed
def campaign_report(folders: Sequence[str | Path], output: str | Path) -> Path:
    """Join the results of one magnet into a page: the answer of every command, with links.

    Nothing is computed: the page says what the folders hold, in the order in which data flow, and
    what does not fit together. It needs no network; its links need the folders where they are.

    Parameters
    ----------
    folders : sequence of str or Path
        Folders of results, of one magnet. Several may be of one command.
    output : str or Path
        The page, if its name ends with .html; otherwise a folder for report.html.

    Returns
    -------
    Path
        Path of the page.

    Raises
    ------
    OutputError
        If a folder holds no finished results, results belong to several magnets, or the page
        cannot be written.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> session = hf.Session.open("results")
    >>> _ = hf.write_report(hf.solve(magnet, session), "solved")
    >>> _ = hf.write_report(hf.verify(magnet, session), "verified")
    >>> hf.campaign_report(["solved", "verified"], "dipole.html").name
    'dipole.html'
    """
    output = as_path(output)
    return write_campaign_report(read_campaign(folders, output), output)


def write_campaign_report(campaign: Campaign, output: Path) -> Path:
    """Write the page of a campaign; see `campaign_report`. Return its path."""
    with ExitStack() as stack:
        if output.suffix.lower() in PAGES:
            path = output
            stack.enter_context(single_file(path, "halbach-fe report"))
        else:
            path = output / PAGE
            stack.enter_context(result_folder(output, "halbach-fe report", campaign.study.name))
        write_text(path, _html(campaign, path))
    return path


@own_style
def _html(campaign: Campaign, path: Path) -> str:
    """Return the page, with links that start from where it will be."""
    magnet = build_magnet(campaign.study)
    picture = geometry_figure(magnet, points_from(campaign.study.observation.positions))
    return rendered(
        "joint_report.html.j2", campaign.study, answer=campaign.answer, pictures=[],
        magnet=in_one_line(magnet), lead=(lead := campaign.lead()), picture=Picture(
            base64.b64encode(png_of(picture)).decode(),
            "The blocks with their magnetization, and the positions of the study"),
        doubts=campaign.doubts, versions=campaign.versions,
        parts=_parts(campaign, path, lead),
        folders=_folder_rows(campaign), inputs=_input_rows(campaign),
        provenance={"programs": programs()})


def _parts(
    campaign: Campaign, output: Path, lead: Picture | None = None
) -> list[Plain]:
    """Return what the template shows of every page; the picture ``lead`` stands at the top."""
    most_rows = 40  # largest number of rows of a folded table. All of them are on its page
    pages = [(chapter, page) for chapter in campaign.chapters for page in chapter.pages]
    first = {chapter.label: number for number, (chapter, _) in reversed(list(enumerate(pages, 1)))}
    found = []
    for number, (chapter, page) in enumerate(pages, 1):
        answer, rows = page.said.answer and _with_folder(page.said.answer, chapter), page.said.rows
        later = campaign.continued(chapter, answer) if answer else None
        earlier = campaign.done_before(chapter, answer) if answer and not later else None
        done = later or earlier
        files = {name: _link(chapter.folder / name, output) for name in chapter.record.files
                 if (chapter.folder / name).exists()}
        of = (f"{other.label}/{name}" for other in campaign.chapters
              for name in chapter.uses(other) if name.endswith(".toml"))
        found.append({
            "number": number, "title": answer.question if answer else page.said.title,
            "name": _shown(PurePath(chapter.label) / PurePath(page.path).parent),
            "of": _shown(next(of, "")),
            "command": chapter.record.command, "ended": _date(chapter.record.ended),
            "answer": answer, "gist": answer.headline if answer else "",
            "next": done and first[done.label],
            "where": "above" if earlier else "below",
            "picture": None if page.picture is lead else page.picture,
            "rows": rows[:most_rows], "all_rows": len(rows), "page": files.get(page.path),
            "files": {_shown(name): address for name, address in files.items()}})
    return found


def _shown(text: object) -> str:
    """Return a text of a folder without control characters."""
    return printable(text, MAX_QUOTED)


def _link(path: Path, output: Path) -> str:
    """Return the relative address of a file from the page; no name becomes a scheme or markup."""
    return quote(os.fsencode(os.path.relpath(path.resolve(), output.parent.resolve())))


def _date(ended: str) -> str:
    """Return the time at which a run ended as people write it."""
    try:
        return f"{datetime.fromisoformat(ended):%d %B %Y, %H:%M} UTC"
    except ValueError:
        return "an unknown time"


def _folder_rows(campaign: Campaign) -> Rows:
    """Return rows of text: which command wrote each folder, and when; with which programs, if
    these are not those of the page itself.
    """
    of = [one.pages[0].said.provenance.get("programs", "") for one in campaign.chapters]
    others = set(of) - {"", programs()}
    return [{"results": one.label, "command": one.record.command, "ended": _date(one.record.ended)}
            | ({"programs": used} if others else {})
            for one, used in zip(campaign.chapters, of, strict=True)]


def _input_rows(campaign: Campaign) -> Rows:
    """Return rows of text: which files the commands read, and which of them wrote these."""
    short_digest = 16  # digits of SHA-256 that the page shows
    rows: dict[str, dict[str, str]] = {}
    for one in campaign.chapters:
        for path, digest in one.record.inputs.items():
            row = rows.setdefault(digest, {
                "file": _shown(os.path.basename(path)),
                "SHA-256": printable(digest, short_digest),
                "read by": "", "written by": ", ".join(
                    other.label for other in campaign.chapters if digest in other.digests)})
            row["read by"] += f"{', ' * bool(row['read by'])}{one.label}"
    return list(rows.values())
