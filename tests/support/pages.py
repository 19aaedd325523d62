"""What every page must be: whole without a network, its pictures in words, its origin stated."""

from __future__ import annotations

from html.parser import HTMLParser


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
    assert "halbach-fe 0" in text
    return text
