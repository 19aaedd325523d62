"""The study file: what is accepted, and the sentence for what is not."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from halbach_fe.blocks import blocks_of
from halbach_fe.errors import HalbachError, StudyError
from halbach_fe.study import MU_0, parse_study, read_study
from tests.conftest import DIPOLE, ROOT, changed

STUDIES = sorted((ROOT / "studies").rglob("*.toml"))


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.parent.name)
def test_shipped_studies_are_valid(path):
    study = read_study(path)
    assert len(blocks_of(study)) == study.array.rings * study.array.blocks_per_ring


def test_studies_are_frozen(dipole):
    with pytest.raises(ValueError, match="frozen"):
        dipole().array.rings = 3


@pytest.mark.parametrize(("changes", "said"), [
    ({"array__inner_radius": 0.1}, "Did you mean `inner_radius_m`?"),
    ({"arry": {}}, "Did you mean `array`?"),
    ({"array__block": {"shape": "sector", "angular_gap": 1}}, "Did you mean `angular_gap_deg`?"),
    ({"array__inner_radius_m": 104}, "Was it meant in millimetres? Then write 0.104."),
    ({"array__remanence_T": 1060}, "Was it meant in millitesla? Then write 1.06."),
    ({"array__inner_radius_m": 0.2}, "must be larger than inner_radius_m"),
    ({"array__inner_radius_m": math.nan}, "`array.inner_radius_m`"),
    ({"array__block": {"shape": "hexagon"}}, "`array.block`"),
    ({"array__blocks_per_ring": 16.5}, "`array.blocks_per_ring`"),
    ({"array__block_moment_A_m2": 330}, "exactly one of remanence_T and block_moment_A_m2"),
    ({"dimension": 3}, "ring_length_m"),
    ({"array__rings": 2}, "array.rings must be 1"),
    ({"mesh": {}}, "`mesh.block_size_m`"),
    ({"name": "../../etc"}, "`name`"),
    ({"observation__positions": {"kind": "circles", "radius_m": 0.07, "angles": 8, "count": 3}},
     "make no sense"),
    ({"observation": {"quantity": "fourier_coefficients", "harmonics": 8, "positions": {
        "kind": "circles", "radius_m": 0.07, "angles": 16}}}, "more than 16 angles"),
    ({"iron_ring": {"inner_radius_m": 0.3, "outer_radius_m": 0.2, "relative_permeability": 100}},
     "`iron_ring`"),
    ({"noise": {"regions": [{"name": "a", "z_min_m": -430, "z_max_m": 420, "sigma_T": 1e-4}]}},
     "Was it meant in millimetres?"),
    ({"noise": {"regions": [{"name": "a", "z_min_m": 0.4, "z_max_m": 0.1, "sigma_T": 1e-4}]}},
     "must be below z_max_m"),
    ({"mesh__block_size_m": 8.0}, "is it in millimetres?"),
    ({"noise": {"regions": [{"name": "all", "sigma_T": -1e-4}]}}, "`noise.regions[0].sigma_T`"),
])
def test_bad_values_are_refused_by_name(changes, said):
    with pytest.raises(StudyError) as caught:
        parse_study(changed(DIPOLE, **changes), "study file x.toml")
    sentence = str(caught.value)
    assert said in sentence
    assert sentence.startswith("Input `")
    assert "of study file x.toml must be" in sentence


@pytest.mark.parametrize(("content", "said"), [
    (b"", "an empty file"),
    (b"  \n\n", "an empty file"),
    (b"[array\nrings = 1", "must be complete TOML"),
    (b"name = \"x\xff\"", "must be UTF-8"),
])
def test_unreadable_files_are_refused(tmp_path, content, said):
    path = tmp_path / "study.toml"
    path.write_bytes(content)
    with pytest.raises(StudyError, match=said):
        read_study(path)


def test_missing_file_and_folder_are_refused(tmp_path):
    for path in (tmp_path / "none.toml", tmp_path):
        with pytest.raises(StudyError, match="must be a readable file"):
            read_study(path)


def test_every_truncation_is_refused_or_complete(tmp_path):
    """A study cut anywhere either still says everything that is required, or is refused."""
    text = (ROOT / "studies/faser/study.toml").read_bytes()
    path = tmp_path / "study.toml"
    refused = 0
    for cut in range(0, len(text), 97):
        path.write_bytes(text[:cut])
        try:
            read_study(path)
        except StudyError:
            refused += 1
    assert refused > 10


@given(st.recursive(st.none() | st.booleans() | st.floats() | st.text() | st.integers(),
                    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
                    max_leaves=8),
       st.sampled_from(["array", "mesh", "observation", "noise", "name", "dimension", "iron_ring"]))
def test_any_nonsense_gives_one_sentence(nonsense, key):
    try:
        parse_study(DIPOLE | {key: nonsense})
    except HalbachError as error:
        assert str(error).startswith("Input")


def test_magnetization_convention(dipole):
    """nu B = H + M: M = B_r / (mu_0 mu_r), not B_r / mu_0."""
    block = blocks_of(dipole(array__recoil_permeability=1.25))[0]
    assert math.hypot(*block.magnetization) == pytest.approx(1.06 / (MU_0 * 1.25), rel=1e-12)
    assert math.hypot(*block.magnetization) != pytest.approx(1.06 / MU_0, rel=1e-2)


def test_moment_gives_remanence(short_dipole):
    """FASER's 330 A m2 in a full sector of 83.3 mm is 1.06 T."""
    study = short_dipole(array__remanence_T=None, array__block_moment_A_m2=330.0,
                         array__ring_length_m=1 / 12)
    block = blocks_of(study)[0]
    volume = math.pi * (0.1865**2 - 0.104**2) / 16 / 12
    assert block.volume == pytest.approx(volume, rel=1e-12)
    assert block.remanence == pytest.approx(MU_0 * 330 / volume, rel=1e-12)


def test_moment_in_wrong_unit_is_refused(short_dipole):
    study = short_dipole(array__remanence_T=None, array__block_moment_A_m2=330e3)
    with pytest.raises(StudyError, match="block_moment_A_m2"):
        blocks_of(study)
