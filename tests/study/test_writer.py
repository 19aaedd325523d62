"""Studies changed in the user's own file: it reads back to the same study, and keeps the rest."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
import tomlkit
from pydantic import ValidationError

from halbach_fe.core.errors import StudyError
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import Place
from halbach_fe.study import writer
from halbach_fe.study.iron_keys import IronRing, SteelCurve
from halbach_fe.study.reader import parse_study, read_study
from halbach_fe.study.writer import REWRITTEN_NOTE, edited_text, study_text
from tests.conftest import ROOT

EFFECTS = {effect.name: effect for effect in catalogue()}
PLAIN = (ROOT / "studies" / "faser" / "study.toml").read_text()

BARE = """name = "bare"
[mesh]
block_size_m = 0.03
[observation]
quantity = "flux_density"
positions = { kind = "circles", radius_m = 0.05, angles = 8 }
"""
RINGS = """rings = 3  # as ordered
blocks_per_ring = 8
inner_radius_m = 0.1
outer_radius_m = 0.18
ring_length_m = 0.08
remanence_T = 1.0
"""
KEYS = [line.partition(" #")[0] for line in RINGS.splitlines()]
LAYOUTS = {
    "faser": PLAIN,
    "quadrupole": (ROOT / "studies" / "quadrupole" / "study.toml").read_text(),
    "cubes": (ROOT / "studies" / "cubes" / "study.toml").read_text(),
    "iron": (ROOT / "studies" / "faser" / "iron.toml").read_text(),
    "tables last": BARE + f'[array]\n{RINGS}[array.block]\nshape = "sector"',
    "exceptions": BARE + f'[array]\n{RINGS}[array.block]\nshape = "sector"\n'
    "[[array.exceptions]]  # mine\nring = 2\nmagnetization_factor = 0.9  # weak\n",
    "objects": BARE + f'[array]\n{RINGS}block.shape = "sector"\n[[external.coils]]  # mine\n'
    'kind = "round"\nradius_m = 0.3\ncurrent_A = 1e3\n[iron]\nrelative_permeability = 30.0\n'
    '[[iron.bodies]]\nkind = "sphere"\nradius_m = 0.05\ncentre_m = [0.5, 0.0, 0.0]  # beside it\n',
    "in line": BARE.replace("[mesh]", "array = {" + ", ".join(KEYS) + ', block = {shape = '
                            '"trapezoid"}}  # all of it\ninstrument = {gain = [0.001, 0, 0]}\n'
                            "[mesh]"),
    "dotted": BARE.replace("[mesh]", "\n".join(f"array.{key}" for key in KEYS) + '\narray.block.'
                           'shape = "sector"\narray.exceptions = [\n  {ring = 2},  # mine\n]\n'
                           "instrument.crosstalk.zx = 1e-3\nexternal.background_T = [0, 0, 1e-4]\n"
                           "[mesh]"),
    "out of order": '[array]\n' + RINGS + "[instrument.crosstalk]\nzx = 1e-3\n[external]\n"
    '[array.block]\nshape = "sector"\n[instrument]\ngain = [0.001, 0, 0]\n',
    "in pieces": f'[array]\n{RINGS}block.shape = "sector"\n[[array.exceptions]]\nring = 2\n'
    "[external]\n[[array.exceptions]]\nring = 3\n"}
for name in ("out of order", "in pieces"):
    LAYOUTS[name] = BARE.replace("[mesh]", LAYOUTS[name] + "[mesh]")


def with_effects(study, names, generator):
    """Studies on the way to one with effects of random sizes at random places, and notes."""
    found = []
    for name in names:
        effect = EFFECTS[name]
        places = effect.places(study)
        if not places:
            continue
        place = places[generator.integers(len(places))]
        values = [1.0] if effect.is_binary else [
            parameter.sd * float(generator.standard_normal()) for parameter in effect.parameters]
        try:
            now = effect.apply(study, place, values)
            parse_study(now.model_dump())
        except (StudyError, ValidationError):  # a gap or a loss below 0
            continue
        study = now
        found.append((study, f"{name} {place.name}: {values[0]:.3g}"))
    return found


@pytest.mark.parametrize("name", EFFECTS)
def test_files_read_back_to_the_study(name):
    """With the effect after two others, in the next layout where it has a place."""
    generator, steps = np.random.default_rng([*EFFECTS].index(name)), []
    for layout in generator.permutation([*LAYOUTS]):
        study = parse_study(tomllib.loads(LAYOUTS[layout]))
        steps = with_effects(study, [*generator.choice([*EFFECTS], 2), name], generator)
        if steps and steps[-1][1].startswith(f"{name} "):
            break
    assert steps
    text = LAYOUTS[layout]
    changed = edited_text(text, steps)
    assert parse_study(tomllib.loads(changed)) == steps[-1][0]
    for before, (after, note) in zip([study, *(one for one, _ in steps)], steps, strict=False):
        assert before == after or note in changed
    if layout not in ("in pieces", "out of order", "dotted"):  # tables in several pieces
        assert REWRITTEN_NOTE not in changed
        for line in text.splitlines():
            assert line.partition("#")[2].strip() in changed


def test_a_byte_order_mark_is_no_part_of_the_study():
    study = read_study(ROOT / "studies" / "faser" / "study.toml")
    after = study.with_(array__inner_radius_m=0.9 * study.array.inner_radius_m)
    assert edited_text(f"\ufeff{PLAIN}", [(after, "why")]) == edited_text(PLAIN, [(after, "why")])


@pytest.mark.parametrize(("ring", "tables"), [(1, 2), (3, 4)], ids=["one", "of three equal ones"])
def test_a_listed_ring_changes_alone(ring, tables):
    """Also one of equal rings, for which a single table stands in the file."""
    text = BARE + "[array]\n" + RINGS.partition("\n")[2] + """
block.shape = "sector"

[[array.ring]]
inner_radius_m = 0.11  # the step

[[array.ring]]  # equal rings
count = 3
inner_radius_m = 0.1
"""
    before = parse_study(tomllib.loads(text))
    for name, change in (("inner_radius", 1e-4), ("length", 1e-3)):
        after = EFFECTS[name].apply(before, Place(ring), [change])
        edited = edited_text(text, [(after, "why")])
        assert parse_study(tomllib.loads(edited)) == after != before
        assert edited.count("[[array.ring]]") == tables
        assert "# the step" in edited  # not rewritten in full
        assert "# equal rings" in edited


@pytest.mark.parametrize("layout", ["faser", "exceptions", "in line", "dotted", "in pieces"])
def test_exceptions_that_are_gone(layout):
    """As after a block that was put in wrongly is replaced."""
    study = parse_study(tomllib.loads(LAYOUTS[layout]))
    there = study.array.exceptions
    more = study.with_(array__exceptions=(*there, {"ring": 1, "slot": 1, "twist_deg": 1.0},
                                          {"ring": 1, "slot": 2, "twist_deg": 2.0}))
    text = edited_text(LAYOUTS[layout], [(more, "more")])
    for left in (more.array.exceptions[-1:], ()):
        fewer = study.with_(array__exceptions=left)
        assert parse_study(tomllib.loads(edited_text(text, [(fewer, "gone")]))) == fewer


@pytest.mark.parametrize("layout", LAYOUTS)
def test_free_blocks_that_are_added(layout, tmp_path):
    """Those of a filled tray: in a table beside the study, and more of them in a further step."""
    study = parse_study(tomllib.loads(LAYOUTS[layout]))
    columns = {"name": ["a", "b"], "shape": ["cuboid"] * 2, "x_m": [0.01, -0.01], "y_m": [0, 0],
               "z_m": [0, 0], "size_x_m": [1e-3] * 2, "size_y_m": [1e-3] * 2,
               "size_z_m": [1e-3] * 2, "remanence_T": [1.2, 1.3]}
    one, two = (study.with_(array__free_blocks={key: values[:count] for key, values in
                                                columns.items()}) for count in (1, 2))
    path = tmp_path / "study.toml"
    writer.write_edited(path, LAYOUTS[layout], [(one, "filled")])
    assert read_study(path) == one
    writer.write_edited(path, path.read_text(), [(two, "filled again")])
    assert read_study(path) == two


def test_nothing_to_change_is_the_file_itself():
    study = parse_study(tomllib.loads(PLAIN))
    assert edited_text(PLAIN, [(study, "not needed")]) == PLAIN


def test_order_and_comments_stay():
    study = parse_study(tomllib.loads(PLAIN))
    (background,) = with_effects(study, ["background"], np.random.default_rng(1))
    gap = EFFECTS["ring_gap"]
    wide = gap.apply(background[0], gap.places(study)[2], [1e-4, 0.0])
    longer = EFFECTS["length"].apply(wide, EFFECTS["length"].places(study)[0], [1e-3])
    changed = edited_text(PLAIN, [background, (wide, "the gap"), (longer, "the length")])
    lines = changed.splitlines()
    kept = [line for line in PLAIN.splitlines()
            if not line.startswith(("ring_length_m", "block_moment_A_m2"))]
    rest = iter(lines)
    assert all(line in rest for line in kept)  # in the same order
    (length,) = [line for line in lines if line.startswith("ring_length_m")]
    assert length.endswith("# inferred: 1.0 m / 12; the length")
    (moment,) = [line for line in lines if "block_moment_A_m2" in line]
    assert moment.startswith("# block_moment_A_m2 = 330.0  # the paper;")
    # of every ring, so that what is uncertain of the gap has a key to refer to
    assert lines.count("[[array.exceptions]]  # the gap") == study.array.rings
    (field,) = [line for line in lines if line.startswith("background_T")]
    assert field.endswith(background[1])
    assert "\n\n\n" not in changed


def test_an_iron_table_comes_along(tmp_path):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "steel.csv").write_text(
        "H_A_per_m,B_T\n100,0.1\n160,0.25\n382,1.0\n758,1.3\n1837,1.5\n")
    text = LAYOUTS["tables last"] + (
        "\n[iron_ring]\ninner_radius_m = 0.2\nouter_radius_m = 0.22\n[iron_ring.curve]\n"
        'kind = "table"\nfile = "steel.csv"  # of the supplier\n')
    (tmp_path / "here" / "study.toml").write_text(text)
    study = read_study(tmp_path / "here" / "study.toml")
    changed = edited_text(text, [(study, "so that it needs no other file")])
    (tmp_path / "there.toml").write_text(changed)
    assert read_study(tmp_path / "there.toml") == study
    assert '# file = "steel.csv"  # of the supplier' in changed


def test_iron_in_place_of_none():
    study = parse_study(tomllib.loads(PLAIN))
    iron = IronRing(inner_radius_m=0.19, outer_radius_m=0.2,
                    curve=SteelCurve(kind="steel", name="aisi_1010"))
    changed = edited_text(PLAIN, [(study.with_(iron_ring=iron), "a ring")])
    assert changed.startswith(PLAIN.rstrip("\n"))
    assert "[iron_ring]  # a ring\n" in changed


def test_a_file_that_cannot_be_changed_is_written_anew(monkeypatch):
    """Negative control: if setting keys did nothing, that would show."""
    study = parse_study(tomllib.loads(PLAIN))
    (step,) = with_effects(study, ["gain_x"], np.random.default_rng(1))
    assert REWRITTEN_NOTE not in edited_text(PLAIN, [step])
    monkeypatch.setattr(writer, "_set", lambda *_: None)
    changed = edited_text(PLAIN, [step])
    assert changed.startswith(f"# {REWRITTEN_NOTE}\n# {step[1]}\n")
    assert parse_study(tomllib.loads(changed)) == step[0]


def test_impossible_studies_are_refused():
    study = parse_study(tomllib.loads(PLAIN))
    gap = EFFECTS["azimuthal_gap"]
    with pytest.raises(StudyError, match=r"angular_gap_deg.*greater than or equal to 0"):
        gap.apply(study, gap.places(study)[0], [-1e-3])
    block = study.array.block.model_copy(update={"angular_gap_deg": -0.1})
    narrow = study.model_copy(update={"array": study.array.model_copy(update={"block": block})})
    with pytest.raises(StudyError, match=r"angular_gap_deg.*greater than or equal to 0"):
        edited_text(PLAIN, [(narrow, "")])


def test_study_with_empty_cells_is_written():
    """A table of several shapes has empty cells, which TOML does not have: it stays a file."""
    study = parse_study({
        "name": "rod", "dimension": 3, "mesh": {"block_size_m": 0.01},
        "array": {"recoil_permeability": 1.0, "free_blocks": {
            "name": ["rod", "cube"], "shape": ["cylinder", "cuboid"], "x_m": [0.0, 0.1],
            "y_m": [0.0, 0.0], "z_m": [0.0, 0.0], "radius_m": [0.01, None],
            "size_x_m": [None, 0.02], "size_y_m": [None, 0.02], "size_z_m": [0.02, 0.02],
            "remanence_T": [1.2, 1.3]}},
        "observation": {"quantity": "flux_density", "positions": {
            "kind": "points", "points_m": [[0.0, 0.0, 0.1]]}}})
    text = study_text(study)
    assert tomllib.loads(text)["array"]["free_blocks"] == {"file": "free_blocks.csv"}
    changed = study.with_(name="wand")
    assert 'name = "wand"' in edited_text(text, [(changed, "renamed")])
    with pytest.raises(tomlkit.exceptions.ConvertError):  # the control
        tomlkit.dumps(study.model_dump(mode="json", exclude_defaults=True))
