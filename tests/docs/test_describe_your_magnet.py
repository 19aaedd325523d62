"""The examples of the page "Describe your magnet" are studies, and its pictures show them."""

from __future__ import annotations

import re
import struct
import tomllib

import numpy as np
import pytest

from halbach_fe.core.errors import StudyError
from halbach_fe.study.free_blocks import COLUMNS, SIZES
from halbach_fe.study.materials import grades
from tests.conftest import ROOT, module_of

gallery = module_of("gallery", ROOT / "docs" / "gallery.py")
PAGE = gallery.EXAMPLES.read_text(encoding="utf-8")
FRAGMENTS = gallery.fragments(PAGE)


def test_every_example_has_a_name():
    assert len(FRAGMENTS) == len(re.findall(r"^```\{code-block\} toml\n:name:", PAGE, re.M))
    others = re.findall(r"^```(?:\{code-block\} )?toml\n(?!:name:)(.*)$", PAGE, re.M)
    assert others == [":caption: overlap.toml"]  # which must be refused


@pytest.mark.parametrize("name", FRAGMENTS)
def test_every_example_is_a_magnet(name):
    magnet = gallery.magnet_of(FRAGMENTS[name], PAGE)
    assert len(magnet.blocks) > 1
    if name in ("material", "coils"):  # a ring like the first one
        return
    assert f"](../_static/magnets/{name}.png)" in PAGE
    picture = ROOT / "docs" / "_static" / "magnets" / f"{name}.png"
    width, height = struct.unpack(">II", picture.read_bytes()[16:24])
    assert width > height > 300


def test_an_example_that_is_wrong_is_seen():
    with pytest.raises(StudyError):
        gallery.magnet_of(FRAGMENTS["trapezoids"].replace("side_gap_m", "gap_m"), PAGE)
    with pytest.raises(StudyError):
        gallery.magnet_of(FRAGMENTS["free-blocks"], PAGE.replace("hexagon,polygon", "hexagon,"))


def test_what_the_page_says_of_the_examples():
    def blocks(name):
        return {block.name: block for block in gallery.magnet_of(FRAGMENTS[name], PAGE).blocks}

    shapes = gallery.magnet_of(FRAGMENTS["free-blocks"], PAGE).array.free_blocks.shape
    assert set(shapes) == set(SIZES)
    layers = blocks("layers")
    assert layers["r02s01"].easy_axis == pytest.approx((0, 1, 0), abs=1e-12)
    assert layers["r01s01"].z_min == layers["r02s01"].z_min == -0.03
    exceptions = blocks("exceptions")
    assert exceptions["r01s03"].remanence == 0
    assert exceptions["r01s05"].displacement_m == pytest.approx((-0.004, 0, 0), abs=1e-12)
    own = gallery.magnet_of(FRAGMENTS["own-rings"], PAGE)
    assert [radii[1] for _, radii in own.ring_sections] == pytest.approx([0.09, 0.08, 0.09])
    assert len(gallery.magnet_of(FRAGMENTS["iron-bodies"], PAGE).iron) == 6


def test_all_columns_shapes_and_grades_are_described():
    for name in (*COLUMNS, *SIZES):
        assert f"`{name}`" in PAGE, name
    for grade in grades():
        assert f"\n| `{grade}` |" in PAGE, grade


def test_pictures_show_missing_and_tilted_blocks():
    """A missing block is not drawn; the shadow of a tilted cylinder is its side."""
    assert len(gallery.middle_blocks(gallery.magnet_of(FRAGMENTS["exceptions"], PAGE))) == 7
    blocks = {block.name: block for block in gallery.magnet_of(
        FRAGMENTS["free-blocks"], PAGE).blocks}
    assert np.ptp(gallery.shadow(blocks["rod"], (0, 1)), axis=0) == pytest.approx((0.06, 0.008))
    assert np.ptp(gallery.shadow(blocks["cylinder"], (0, 1)), axis=0) == pytest.approx(
        (0.04, 0.04), rel=0.01)


def test_the_refused_study_is_whole():
    (text,) = re.findall(r"^:caption: overlap.toml\n\n(.*?)^```$", PAGE, re.M | re.S)
    assert tomllib.loads(text)["array"] == {"free_blocks": {"file": "overlap.csv"}}
