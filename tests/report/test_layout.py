"""How pages are laid out on paper and on a narrow screen, in Chromium."""

from __future__ import annotations

import pytest
from matplotlib.figure import Figure

from halbach_fe.cli import main
from halbach_fe.report.answer import WIDEST_IN
from halbach_fe.report.page import SMALL, figure_of, label_logarithmic, save, units_kept
from tests.report.conftest import PATIENCE_MS
from tests.report.test_page import ANSWER, SEEN
from tests.support.pages import write_any_page
from tests.support.results import STUDY
from tests.support.short_dipole import TEXT

PAPER_PX = round(180 / 25.4 * 96)
"""Width of A4 between the margins of pages; US letter is wider."""

SMALLEST_ON_PAPER_PX = 12
"""9 pt, the size of footnotes in print."""

SIZES = """() => [...document.querySelectorAll('body *')].filter(
    one => one.checkVisibility() && !one.closest('svg') && [...one.childNodes].some(
        child => child.nodeType == 3 && child.textContent.trim()))
    .map(one => parseFloat(getComputedStyle(one).fontSize))"""
"""Sizes in px of the texts that are shown, but for those of drawings."""

FOLDED = "<details><summary>More</summary><p id=folded>folded</p></details>"

LINES = """cells => cells.map(cell => {
    const range = document.createRange(); range.selectNodeContents(cell);
    return new Set([...range.getClientRects()].map(one => Math.round(one.top))).size; })"""
"""How many lines the texts of cells have."""


def written(folder, *sizes_in):
    """A page with figures of some sizes in inches."""
    figures = {}
    for number, size_in in enumerate(sizes_in or [(6, 4)]):
        figure = Figure(figsize=size_in)
        figure.text(0.5, 0.5, "text", fontsize=SMALL)
        figures[f"{number}.png"] = figure, SEEN
    write_any_page(folder / "page.html", save(figures, folder), STUDY,
               answer=ANSWER)
    return folder / "page.html"


@pytest.fixture
def opened(browser):
    """Open a page of a width in px."""
    contexts = []

    def opened(path, width_px=700):
        context = browser.new_context(offline=True, viewport={"width": width_px, "height": 800})
        contexts.append(context)
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        page.goto(path.as_uri())
        return page

    yield opened
    for context in contexts:
        context.close()


def test_paper_shows_what_is_folded(opened, tmp_path):
    path = written(tmp_path)
    text = path.read_text()
    path.write_text(text.replace("<h2>Provenance", f"{FOLDED}<h2>Provenance"))
    page = opened(path)

    def shown(selector):
        return page.locator(selector).evaluate("one => one.checkVisibility()")

    assert not shown("#folded")
    assert shown("text=The study as it was read")
    page.emulate_media(media="print")
    assert shown("#folded")
    assert not shown("text=The study as it was read")  # the study file has it
    page.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    assert shown("text=The study as it was read")  # whoever unfolds it has it


def test_texts_of_pictures_keep_their_size_on_paper(opened, tmp_path):
    """The control is wider than `figure_of` makes any."""
    widest, tall, control = (WIDEST_IN, 3), (5.5, 9), (10, 3)
    page = opened(written(tmp_path, widest, tall, control), PAPER_PX)
    page.emulate_media(media="print")
    scales = [page.locator("img").nth(number).bounding_box()["width"] / 96 / size_in[0]
              for number, size_in in enumerate((widest, tall, control))]
    assert scales[:2] == pytest.approx([1, 1], abs=0.01)
    assert scales[2] < 0.8
    assert figure_of(3, 10).get_size_inches()[0] == WIDEST_IN


def test_a_picture_is_not_pushed_sideways_at_500_px(opened, tmp_path):
    page = opened(written(tmp_path, (WIDEST_IN, 3), (10, 3)), 500)
    widths = [page.locator("img").nth(number).bounding_box()["width"] for number in (0, 1)]
    assert widths[0] <= 500 < widths[1]


def test_nothing_on_paper_is_too_small_or_cut(opened, tmp_path):
    (tmp_path / "study.toml").write_text(TEXT)
    assert main(["homogeneity", str(tmp_path / "study.toml"), "-o", str(tmp_path / "out"),
                 "--sphere-m", "0.006", "--degrees", "3", "--json"]) == 0
    page = opened(tmp_path / "out" / "homogeneity.html", PAPER_PX)
    page.emulate_media(media="print")
    assert min(page.evaluate(SIZES)) >= SMALLEST_ON_PAPER_PX
    assert page.evaluate("document.documentElement.scrollWidth") <= PAPER_PX
    page.add_style_tag(content="table { font-size: 8.5pt !important; width: 90em; }")
    assert min(page.evaluate(SIZES)) < SMALLEST_ON_PAPER_PX  # the control
    assert page.evaluate("document.documentElement.scrollWidth") > PAPER_PX


@pytest.mark.parametrize("width_px", [1400, 500])
def test_numbers_stay_on_one_line(opened, tmp_path, width_px):
    (tmp_path / "study.toml").write_text(TEXT)
    assert main(["homogeneity", str(tmp_path / "study.toml"), "-o", str(tmp_path / "out"),
                 "--sphere-m", "0.006", "--degrees", "3", "--json"]) == 0
    page = opened(tmp_path / "out" / "homogeneity.html", width_px)
    numbers = page.locator("table.numbers").first.locator("td")
    names = page.locator("table.numbers").first.locator("tbody th").all_inner_texts()
    lines = dict(zip(names, numbers.evaluate_all(LINES), strict=True))
    assert {name for name, count in lines.items() if count > 1} <= {"direction of the mean B"}
    assert page.evaluate("document.documentElement.scrollWidth") <= width_px
    page.add_style_tag(content=".short { white-space: normal; } table { width: 9em; }")
    assert max(numbers.evaluate_all(LINES)) > 1  # the control


@pytest.mark.parametrize(("text", "kept"), [
    ("38 774 ppm rms", "38 774\u00a0ppm rms"),
    ("by 0.2 %, at 20 °C", "by 0.2\u00a0%, at 20\u00a0°C"),
    ("200.03 ± 0.16 %", "200.03\u00a0±\u00a00.16\u00a0%"), ("of 3 maps", "of 3 maps"),
    ("5 mm, 3 mrad", "5\u00a0mm, 3\u00a0mrad"),
    ("8 Tables", "8 Tables"), ("ring 1, slot 2", "ring 1, slot 2")])
def test_units_stay_beside_their_number(text, kept):
    assert units_kept(text) == kept


def test_logarithmic_axes_have_numbers():
    """Within a decade too, where others have 3 × 10²."""
    for limits in ((150, 400), (1, 1e4)):
        axis = Figure().subplots()
        axis.set(yscale="log", ylim=limits)

        def labels(axis=axis):
            axis.figure.draw_without_rendering()
            return [label.get_text() for label in (*axis.yaxis.get_majorticklabels(),
                                                   *axis.yaxis.get_minorticklabels())]

        assert any("10^" in label for label in labels())
        label_logarithmic(axis.yaxis)
        found = [float(label) for label in labels() if label]
        assert any(limits[0] <= value <= limits[1] for value in found)


def test_what_is_cut_fades_at_that_edge(opened, tmp_path):
    """However little is cut; scrolled to the end it is the other edge. The control fits."""
    page = opened(written(tmp_path), 500)
    page.evaluate("""document.querySelector('.wide').innerHTML =
        '<div id=inside style="width: 100%; height: 9px"></div>'""")

    def fades(width, start):
        """Tell whether the mask begins so within some frames, of which a busy machine has few."""
        page.evaluate(f"document.querySelector('#inside').style.width = '{width}'")
        for _ in range(25):
            page.wait_for_timeout(200)
            if page.evaluate("getComputedStyle(document.querySelector('.wide')).maskImage"
                             ).startswith(start):
                return True
        return False

    assert fades("100%", "none")
    assert fades("calc(100% + 8px)", "linear-gradient(to left, rgba(0, 0, 0, 0.0")
    page.evaluate("document.querySelector('.wide').scrollLeft = 99")
    assert fades("calc(100% + 8px)", "linear-gradient(to right, rgba(0, 0, 0, 0.0")
