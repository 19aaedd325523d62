"""The check of pages, and that it fails."""

from __future__ import annotations

import pytest
from matplotlib.figure import Figure

from halbach_fe.report.page import save, write_page
from tests.conftest import DIPOLE, parse_study
from tests.support.pages import page

SEEN = "what the picture shows, in words"


@pytest.fixture
def written(tmp_path):
    study = parse_study(DIPOLE | {"description": "<b>not bold</b>"})
    path = tmp_path / "page.html"
    write_page(path, "calibration.html.j2", save({"one.png": (Figure(), SEEN)}, tmp_path), study,
               {"source": "a test"}, results={})
    return path


def test_a_page_is_whole(written):
    text = page(written)
    assert (written.parent / "one.png").read_bytes().startswith(b"\x89PNG")
    assert "a test" in text
    assert "remanence_T = 1.06" in text  # the study as it was read
    assert "recoil_permeability_across" not in text  # and no more
    assert "<b>not bold" not in text


@pytest.mark.parametrize(("old", "new"), [
    ("src=\"data:", "src=\"https://example.org/"), (f"alt=\"{SEEN}\"", "alt=\"\""),
    (">Provenance<", ">Origin<"), ("<body>", "<body><script src=\"plotly.js\"></script>"),
    ("<style>", "<link rel=\"stylesheet\" href=\"page.css\"><style>")])
def test_pages_that_are_not(written, old, new):
    text = written.read_text()
    assert old in text
    written.write_text(text.replace(old, new))
    with pytest.raises(AssertionError):
        page(written)
