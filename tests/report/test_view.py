"""The view of the magnet, opened and clicked in Chromium, offline."""

from __future__ import annotations

import io

import numpy as np
import pytest
from matplotlib.image import imread

from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.report import magnet_view_3d
from halbach_fe.report.magnet_view_3d import (
    BlockValues,
    Colours,
    magnet_view,
    prism,
    residual_points,
)
from halbach_fe.study.reader import read_study
from tests.conftest import ROOT
from tests.report.conftest import PATIENCE_MS

STUDIES = ("quadrupole", "cubes", "faser")


def study_of(name):
    return read_study(ROOT / "studies" / name / "study.toml")


def known_of(study):
    blocks = build_magnet(study).blocks
    percent = np.linspace(-2, 2, len(blocks))
    magnetization = np.array([block.magnetization[:study.dimension] for block in blocks])
    return BlockValues(magnetization, Colours(
        percent, "in %", [f"{one:+.2f} ± 0.40 %" for one in percent]))


@pytest.fixture
def page(browser, tmp_path):
    """Open a part of a page; errors in it fail the test.

    At half its width: WebGL by software takes as long as there are pixels.
    """
    errors = []
    context = browser.new_context(offline=True, viewport={"width": 500, "height": 400})
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    page.on("pageerror", lambda error: errors.append(str(error)))

    def opened(part):
        path = tmp_path / "page.html"
        path.write_text(f'<!doctype html><meta charset="utf-8"><body>{part}</body>',
                        encoding="utf-8")
        page.goto(path.as_uri())
        page.wait_for_selector("#magnet-view canvas")
        page.wait_for_function("document.getElementById('magnet-view')._fullLayout")
        return page

    yield opened
    context.close()
    assert not errors


def coloured(page):
    """How many pixels of the picture are of no grey and no pale colour."""
    page.wait_for_timeout(1500)  # WebGL by software
    picture = imread(io.BytesIO(page.locator("#magnet-view").screenshot()))[:, :, :3]
    return int((np.ptp(picture, axis=2) > 0.25).sum())


def words(page):
    """What is shown as the pointer goes over the picture."""
    box, found = page.locator("#magnet-view").bounding_box(), set()
    for along in np.linspace(0.3, 0.6, 3):
        for down in np.linspace(0.35, 0.7, 3):
            page.mouse.move(box["x"] + along * box["width"], box["y"] + down * box["height"])
            page.wait_for_timeout(60)
            found.update(page.evaluate(
                "[...document.querySelectorAll('#magnet-view g.hovertext')]"
                ".map(one => one.textContent)"))
    return found


def test_blocks_tell_their_numbers_and_can_be_hidden(page):
    study = study_of("quadrupole")
    known = known_of(study)
    shown = page(
        magnet_view(build_magnet(study), known, residual_points(np.zeros((1, 3)), np.array([2.5]))))
    assert coloured(shown) > 10_000
    found = words(shown)
    own = [one for one in found if "ring 1, slot" in one]
    assert len(own) > 1  # 3 of 9 points were over blocks
    for text in own:
        slot = int(text.split("slot ")[1].split("M")[0])
        assert known.colours.words[slot - 1] in text
    shown.locator("#magnet-view .legendtoggle").first.click()
    shown.wait_for_function(
        "document.getElementById('magnet-view').data[0].visible == 'legendonly'")
    assert not any("slot" in one for one in words(shown))


def test_the_field_and_residuals_are_shown_when_asked_for(page):
    """Hidden at first; each text of a block is in the page once."""
    study = study_of("quadrupole")
    points = np.array([[0.01, 0.0, 0.0], [0.0, 0.01, 0.0]])
    view = magnet_view(build_magnet(study), known_of(study), None,
                       (points, np.array([[2e-5, 0, 0], [0, 1e-5, 0]])))
    assert view.count("ring 1, slot 7") == 1
    shown = page(view)
    hidden = shown.evaluate("document.getElementById('magnet-view').data.filter("
                            "one => one.visible == 'legendonly').map(one => one.name)")
    assert hidden == ["residuals, up to 20\u00a0µT", "|B| in a plane"]
    before = coloured(shown)
    shown.evaluate("Plotly.restyle('magnet-view', {visible: true})")
    assert coloured(shown) > before + 500
    texts = shown.evaluate("document.getElementById('magnet-view').data[0].text")
    assert len(texts) > 12
    assert len(set(texts)) == 12


def test_names_hide_nothing(page):
    """They are below the picture of the magnet, on wide and on narrow screens."""
    study = study_of("quadrupole")
    shown = page(magnet_view(build_magnet(study), known_of(study)))
    for width in (1400, 500):
        shown.set_viewport_size({"width": width, "height": 1000})
        shown.wait_for_timeout(1000)
        scene, names = (shown.locator(f"#magnet-view {one}").first.bounding_box()
                        for one in (".gl-container canvas, .svg-container canvas", ".legend"))
        assert 0.8 * width < scene["width"] <= width  # it has followed the screen
        assert names["height"] > 10
        assert names["y"] >= scene["y"] + scene["height"] - 1  # a px of rounding
        assert names["x"] >= 0
        assert names["x"] + names["width"] <= width


def test_blocks_that_were_found_are_named():
    """The control has none."""
    study = study_of("quadrupole")
    magnet, known = build_magnet(study), known_of(study)
    name = '"text":["","ring 1, slot 3",""]'
    assert name in magnet_view(magnet, known, named={(1, 3), (0, 0)})
    assert name not in magnet_view(magnet, known)


def test_the_camera_is_on_the_side_of_what_was_found():
    """Slot 13 of 24 is at negative x; the control, slot 1, at positive x."""
    study = study_of("cubes")
    magnet, known = build_magnet(study), known_of(study)
    behind = '"eye":{"x":-'
    assert behind in magnet_view(magnet, known, named={(1, 13)})
    assert behind not in magnet_view(magnet, known, named={(1, 1)})


@pytest.mark.parametrize("name", STUDIES)
def test_studies_are_shown(page, name):
    study = study_of(name)
    shown = page(magnet_view(build_magnet(study), known_of(study)))
    whole = coloured(shown)
    shown.evaluate("Plotly.restyle('magnet-view', {visible: false}, [0])")
    assert coloured(shown) < 0.2 * whole  # the iron stays


def test_of_too_many_blocks_neighbouring_rings_are_one(short_dipole, monkeypatch):
    """What changed most in them is shown, and the whole length."""
    study = short_dipole(array__rings=7, array__recoil_permeability=1.0)
    blocks = build_magnet(study).blocks
    values = np.zeros(len(blocks))
    values[16 * 3 + 4], values[16 * 6 + 1] = -5.0, 2.0  # ring 4, slot 5; ring 7, slot 2
    known = BlockValues(np.array([block.magnetization for block in blocks]), Colours(
        values, "change", [f"{one:g} %" for one in values]))
    every, _ = magnet_view_3d._merge_rings(build_magnet(study), known)
    assert len(every) == len(blocks)
    monkeypatch.setattr(magnet_view_3d, "MOST_BLOCKS", 40)
    few, shown = magnet_view_3d._merge_rings(build_magnet(study), known)
    assert len(few) == len(shown.magnetization) == len(shown.colours.words) == 48  # rings by three
    assert shown.colours.values[16 + 4] == -5.0
    assert shown.colours.words[16 + 4] == "largest in ring 4: -5 %"
    text = magnet_view_3d._hover_text(few[16 + 4], 2, shown, 16 + 4)
    assert text.startswith("rings 4 to 6, slot 5")
    assert shown.colours.values[32 + 1] == 2.0
    assert (few[0].z_min, few[-1].z_max) == (blocks[0].z_min, blocks[-1].z_max)
    assert sum(block.volume for block in few) == pytest.approx(
        sum(block.volume for block in blocks))


@pytest.mark.parametrize("name", STUDIES)
def test_surface_of_a_block_is_closed_and_has_its_volume(name):
    study = study_of(name)
    for block in build_magnet(study).blocks[:5]:
        points, faces = prism(block, 0.01)
        edges = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        _, count = np.unique(edges, axis=0, return_counts=True)
        assert (count == 2).all()
        height = 0.01 if np.isinf(block.z_max) else block.z_max - block.z_min
        assert np.ptp(points[:, 2]) == pytest.approx(height)
        corners = points[faces]
        low = corners[np.isclose(corners[:, :, 2], points[:, 2].min()).all(axis=1), :, :2]
        (x1, y1), (x2, y2) = (low[:, 1] - low[:, 0]).T, (low[:, 2] - low[:, 0]).T
        area = float(np.abs(x1 * y2 - x2 * y1).sum() / 2)
        # arcs of 22.5 degrees in four chords: 1 - sinc, 2e-3 of the area they bound, both ways
        assert area == pytest.approx(block.area, rel=1e-2)
