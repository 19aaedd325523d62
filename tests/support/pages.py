"""What every page must be: whole without a network, its pictures in words, its origin stated."""

from __future__ import annotations

import html
import json
import re
from html.parser import HTMLParser

from halbach_fe.core.installation import version
from halbach_fe.report.answer import PAGE_RECORD, Answer
from halbach_fe.report.page import Page, Section, Table, page_of, write_files, write_page


def write_any_page(path, pictures, study=None, provenance=None, answer=None, rows=()):
    """Write a page with a table and pictures, as those of all commands are."""
    write_page(path, Page(
        "any", "Calibration", study, answer or Answer("What?", "That.", "Yes: so.", "Nothing."), {},
        [Section([Table(rows)])], rows=rows, provenance=provenance or {},
        figures={each.file: (None, each.caption) for each in pictures}), pictures)
    if answer is None:  # as of versions of halbach-fe that had no answers
        record = path.with_name(PAGE_RECORD)
        record.write_text(json.dumps(json.loads(record.read_text()) | {"answer": None}))


class _Parts(HTMLParser):
    """Texts of pictures, what is loaded from elsewhere, and headings."""

    def __init__(self):
        super().__init__()
        self.texts, self.loaded, self.headings, self.inside = [], [], [], ""

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.inside = tag
        if tag == "img" or named.get("role") == "img":
            self.texts.append(named.get("alt") or named.get("aria-label") or "")
        self.loaded += [value for key, value in attributes
                        if key in ("href", "src", "srcset", "data")
                        and not (value or "").startswith("data:")]
        self.loaded += [tag] if tag in ("link", "iframe", "object") else []

    def handle_data(self, data):
        if self.inside in ("h1", "h2"):
            self.headings.append(data.strip())


def page(path):
    """The text of a page; AssertionError if it needs anything else or leaves anything out."""
    text = path.read_text(encoding="utf-8")
    parts = _Parts()
    parts.feed(text)
    assert parts.texts
    assert all(len(one) > 20 for one in parts.texts)
    assert not parts.loaded
    assert "Provenance" in parts.headings
    assert f"halbach-fe {version('halbach-fe')}" in text
    answer_of(path)
    return text


def answer_of(path):
    """What a page says first, by its parts; AssertionError if anything of it is missing."""
    text = path.read_text(encoding="utf-8")
    first = re.search(r'<section class="answer.*?</section>', text, re.DOTALL)
    assert first is not None
    assert text.index("</h1>") < first.start() < text.index("<h2>")
    parts = re.search(r'asked">(?P<asked>.*?)</p>.*?said">(?P<said>.*?)</p>'
                      r".*?<dd>(?P<trust>.*?)</dd>.*?<dd>(?P<step>.*?)(<code>.*)?</dd>",
                      first[0], re.DOTALL)
    assert parts is not None
    whole = re.search(r"In full</summary>\s*<p>(?P<said>.*?)</p>\s*<p>(?P<trust>.*?)</p>",
                      first[0], re.DOTALL)
    found = {name: html.unescape(part) for name, part in {
        **parts.groupdict(), **(whole.groupdict() if whole else {})}.items()}
    assert all(len(part) > 10 for part in found.values())
    return found


def command_of(path):
    """The command of a page's next step, as it is copied from there."""
    code = re.search(r"<code>(.*?)</code>", path.read_text(encoding="utf-8"), re.DOTALL)
    return " ".join(html.unescape(re.sub("<.*?>", "", code[1])).split())


def write_result(result, folder):
    """Write the page of a result and its files into any folder, also one of another command."""
    return write_files(page_of(result), folder)
