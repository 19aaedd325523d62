"""The study file: what is accepted, and the sentence for what is not."""

from __future__ import annotations

import contextlib
import math

import pytest
import tomlkit
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from halbach_fe.core.errors import HalbachError, HalbachWarning, StudyError
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.iron_keys import TableCurve
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import curve_of
from halbach_fe.study.reader import parse_study, read_study
from halbach_fe.study.types import StudyModel
from tests.conftest import DIPOLE, ROOT, changed

STUDIES = sorted((ROOT / "studies").rglob("*.toml"))
H_B = {"H_A_per_m": [100.0, 160.0, 382.0, 758.0, 1837.0], "B_T": [0.1, 0.25, 1.0, 1.3, 1.5]}


def iron(**curve):
    """An iron ring with an H(B) curve."""
    return {"inner_radius_m": 0.2, "outer_radius_m": 0.24, "curve": curve}


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.parent.name)
def test_shipped_studies_are_valid(path):
    study = read_study(path)
    assert len(build_magnet(study).blocks) == sum(study.array.blocks_by_ring)


def test_studies_are_frozen(dipole):
    with pytest.raises(ValueError, match="frozen"):
        dipole().array.rings = 3


DEMAGNETIZATION = {"remanence_coefficient_per_K": -1.2e-3, "coercivity_coefficient_per_K": -6e-3}
HOT = DEMAGNETIZATION | {"intrinsic_coercivity_A_per_m": 955e3, "temperature_C": 80}


@pytest.mark.parametrize(("changes", "said"), [
    ({"array__inner_radius": 0.1}, "Did you mean `inner_radius_m`?"),
    ({"arry": {}}, "Did you mean `array`?"),
    ({"array__dimension": 2}, "`dimension` stands at the top of the file"),
    ({"array__block": {"shape": "sector", "angular_gap": 1}}, "Did you mean `angular_gap_deg`?"),
    ({"array__inner_radius_m": 104}, "Was it meant in millimetres? Then write 0.104."),
    ({"array__inner_radius_m": 10}, "Was it meant in millimetres? Then write 0.01."),
    ({"external__dipoles": [{"position_m": [0, 0, 1], "moment_A_m2": [0, 0, 2e6]}]},
     "Was it meant in A mm²? Then write 2."),
    ({"array__remanence_T": 1060}, "Was it meant in millitesla? Then write 1.06."),
    ({"array__remanence_T": 13000}, "Was it meant in gauss? Then write 1.3."),
    ({"array__remanence_T": 13}, "Was it meant in kilogauss? Then write 1.3."),
    ({"array__remanence_T": 1e6}, "Correct the value."),
    ({"demagnetization": DEMAGNETIZATION | {"intrinsic_coercivity_A_per_m": 955}},
     "Was it meant in kiloamperes per metre? Then write 955000."),
    ({"demagnetization": DEMAGNETIZATION | {"intrinsic_coercivity_A_per_m": 2e9}},
     "Correct the value."),
    ({"demagnetization": HOT | {"remanence_coefficient_per_K": 1.2e-3}},
     "Was it meant with the other sign? Then write -0.0012."),
    ({"demagnetization": HOT | {"intrinsic_coercivity_A_per_m": 12000}},
     "Was it meant in oersted? Then write 954930."),
    ({"demagnetization": HOT | {"remanence_coefficient_per_K": -6e-3,
                                "coercivity_coefficient_per_K": -1.2e-3}},
     "are the two exchanged?"),
    ({"shim_tray": {"places_m": [[0, 0, 0]], "strength_sd": 2, "magnets": [
        {"name": "a", "size_m": [1e-3, 1e-3, 1e-3], "remanence_T": 1, "count": 1}]}},
     "Was it meant in per cent? Then write 0.02."),
    ({"array__inner_radius_m": 0.2}, "must be larger than inner_radius_m"),
    ({"array__inner_radius_m": math.nan}, "`array.inner_radius_m`"),
    ({"array__block": {"shape": "hexagon"}}, "`array.block.shape`"),
    ({"array__blocks_per_ring": 16.5}, "`array.blocks_per_ring`"),
    ({"array__block_moment_A_m2": 330}, "exactly one of remanence_T and block_moment_A_m2"),
    ({"dimension": 3}, "ring_length_m"),
    ({"array__rings": 2}, "array.rings must be 1"),
    ({"mesh": {}}, "`mesh.block_size_m`"),
    ({"name": "../../etc"}, "`name`"),
    ({"observation__positions": {"kind": "circles", "radius_m": 0.07, "angles": 8, "count": 3}},
     "make no sense"),
    ({"observation__positions": {"kind": "circles", "radius_m": [0.07, 50], "angles": 8}},
     "Was it meant in millimetres? Then write 0.05."),
    ({"design": {"rings": 3, "spacing_m": 0.02, "least_field_T": 0.02, "most_mass_kg": 40,
                 "layer": [{"radii_m": [0.07, 80], "sizes_m": [0.012]}]}},
     "Was it meant in millimetres? Then write 0.08."),
    ({"observation__positions": {"kind": "circles", "radius_m": [0.07, 0.07], "angles": 8}},
     "name each radius once"),
    ({"observation__positions": {"kind": "circles", "radius_m": [], "angles": 8}},
     "`observation.positions.radius_m`"),
    ({"observation__positions": {"kind": "grid", "start_m": [0, 0, 0], "end_m": [0, 0, 0.1],
                                 "count": [1, 2, 5]}}, "2 points from y = 0.0 to 0.0 make no"),
    ({"observation__positions": {"kind": "grid", "start_m": [0, 0, 0.1], "end_m": [0, 0, 0],
                                 "count": [1, 1, 5]}}, "5 points from z = 0.1 to 0.0 make no"),
    ({"observation__positions": {"kind": "grid", "start_m": [0, 0, 0], "end_m": [1, 1, 1],
                                 "count": [200, 200, 200]}}, "may have 1000000 points"),
    ({"observation__positions": {"kind": "grid", "start_m": [0, 0, 0], "end_m": [0, 0, 100],
                                 "count": [1, 1, 0]}}, "`observation.positions.count[3]`"),
    ({"observation": {"quantity": "fourier_coefficients", "harmonics": 8, "positions": {
        "kind": "circles", "radius_m": 0.07, "angles": 16}}}, "more than 16 angles"),
    ({"iron_ring": {"inner_radius_m": 0.3, "outer_radius_m": 0.2, "relative_permeability": 100}},
     "`iron_ring`"),
    ({"noise": {"regions": [{"name": "a", "z_min_m": -430, "z_max_m": 420, "sigma_T": 1e-4}]}},
     "Was it meant in millimetres?"),
    ({"noise": {"regions": [{"name": "a", "z_min_m": 0.4, "z_max_m": 0.1, "sigma_T": 1e-4}]}},
     "must be below z_max_m"),
    ({"mesh__block_size_m": 8.0}, "is it in millimetres?"),
    ({"instrument": {"field_axes": ["x", "-x", "z"]}}, "field_axes must name x, y and z once each"),
    ({"instrument": {"position_axes": ["x", "y"]}}, "`instrument.position_axes"),
    ({"instrument": {"length_unit_m": 0.0}}, "`instrument.length_unit_m`"),
    ({"inference": {"excluded_readings": [0]}}, "`inference.excluded_readings[1].row`"),
    ({"inference": {"excluded_readings": [{"row": 3, "components": ["w"]}]}},
     "`inference.excluded_readings[1].components[1]`"),
    ({"prior": {"types": {"a": [1, 2]}}}, "prior.types must name every slot from 1 to 16 once"),
    ({"prior": {"types": {"a": list(range(1, 17)), "b": [3]}}}, "every slot from 1 to 16 once"),
    ({"prior": {"temperature_coefficient_per_K": -1e-3}}, "together, or neither"),
    ({"prior": {"temperature_coefficient_per_K": -0.1, "reference_temperature_C": 20}},
     "`prior.temperature_coefficient_per_K`"),
    ({"prior": {"mounting_sd_deg": -1}}, "`prior.mounting_sd_deg`"),
    ({"noise": {"regions": [{"name": "all", "sigma_T": -1e-4}]}}, "`noise.regions[1].sigma_T`"),
    ({"noise": {"regions": [{"name": "all", "components": ["w"], "sigma_T": 1e-4}]}},
     "`noise.regions[1].components[1]`"),
    ({"noise": {"regions": [{"name": "all", "components": [], "sigma_T": 1e-4}]}},
     "`noise.regions[1].components`"),
    ({"noise": {"regions": [{"name": "all", "sigma_T": 1e-4}, {
        "name": "fringe", "z_min_m": 0.1, "sigma_T": 1e-3}]}}, "holds all of 'fringe'"),
    ({"noise": {}}, "give regions, position_sd_m, or both"),
    ({"noise": {"position_sd_m": -1e-4}}, "`noise.position_sd_m[1]`"),
    ({"noise": {"position_sd_m": 0.1}}, "less than or equal to 0.01"),
    ({"noise": {"position_sd_m": [1e-4, 1e-4]}}, "one value or three, for x, y and z, not 2"),
    ({"noise": {"position_sd_m": "much"}}, "`noise.position_sd_m[1]`"),
    ({"observation": {"quantity": "fourier_coefficients", "harmonics": 4, "positions": {
        "kind": "circles", "radius_m": 0.07, "angles": 16}},
      "noise": {"regions": [{"name": "all", "components": ["x"], "sigma_T": 1e-4}]}},
     "noise.regions may name components of flux_density only"),
    ({"observation": {"quantity": "fourier_coefficients", "harmonics": 4, "positions": {
        "kind": "circles", "radius_m": 0.07, "angles": 16}},
      "inference": {"held_out": {"components": ["x"]}}},
     "inference.held_out may name components of flux_density only"),
    ({"inference": {"held_out": {"radii_m": [0.05], "window": 3}}}, "window needs every"),
    ({"inference": {"held_out": {"z_ranges_m": [[0.1, -0.1]]}}}, "a lower and an upper limit"),
    ({"inference": {"held_out": {"radii_m": [-0.05]}}}, "`inference.held_out.radii_m[1]`"),
    ({"inference": {"held_out": {"components": ["r"]}}}, "`inference.held_out.components[1]`"),
    ({"inference": {"held_out": {"every": 1}}}, "`inference.held_out.every`"),
    ({"iron_ring": {"inner_radius_m": 0.2, "outer_radius_m": 0.24}},
     "exactly one of relative_permeability and curve"),
    ({"iron_ring": iron(kind="table", **H_B) | {"relative_permeability": 100}},
     "exactly one of relative_permeability and curve"),
    ({"iron_ring": iron(kind="steel", name="1010")},
     "there are aisi_1008, aisi_1010, pure_iron_rfe80, vacoflux_50."),
    ({"iron_ring": iron(kind="steel", nme="aisi_1010")}, "Did you mean `name`?"),
    ({"iron_ring": iron(kind="table")}, "give a file, or H_A_per_m and B_T."),
    ({"iron_ring": iron(kind="table", file="x.csv", **H_B)}, "not both"),
    ({"iron_ring": iron(kind="table", H_A_per_m=H_B["H_A_per_m"], B_T=H_B["B_T"][:-1])},
     "`iron_ring.curve` of study file x.toml must be consistent: H and B must be lists of equal"),
    ({"iron_ring": iron(kind="table", H_A_per_m=["a"], B_T=[1])}, "`iron_ring.curve.H_A_per_m[1]`"),
    ({"iron_ring": iron(kind="table", H_A_per_m=H_B["B_T"], B_T=H_B["H_A_per_m"])},
     "`iron_ring.curve` of study file x.toml must be consistent: H and B look exchanged"),
    ({"iron_ring": iron(kind="brauer", k1_m_per_H=1e6, k2_per_T2=1, k3_m_per_H=0)},
     "k1 + k3 must be a reluctivity"),
    ({"iron_ring": iron(kind="froehlich_kennelly", initial_relative_permeability=1000,
                        saturation_polarization_T=2100)}, "Was it meant in millitesla?"),
    ({"iron_ring": iron(kind="froehlich_kennelly", initial_relative_permeability=1e6,
                        saturation_polarization_T=0.01)}, "must rise between the points"),
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


STUDY_WITH_TABLE = """
name = "iron"
dimension = 2
mesh.block_size_m = 0.02
[array]
blocks_per_ring = 8
inner_radius_m = 0.05
outer_radius_m = 0.09
remanence_T = 1.0
block.shape = "sector"
[iron_ring]
inner_radius_m = 0.1
outer_radius_m = 0.12
curve = { kind = "table", file = "steels/mine.csv" }
[observation]
quantity = "flux_density"
positions = { kind = "circles", radius_m = 0.03, angles = 10 }
"""


@pytest.fixture
def with_table(tmp_path, monkeypatch):
    """A study with its H(B) file in a folder beside it, read from elsewhere; and that file."""
    folder = tmp_path / "study"
    (folder / "steels").mkdir(parents=True)
    (folder / "study.toml").write_text(STUDY_WITH_TABLE)
    table = folder / "steels" / "mine.csv"
    table.write_text("# made up\nH_A_per_m,B_T\n" + "".join(
        f"{h},{b}\n" for h, b in zip(H_B["H_A_per_m"], H_B["B_T"], strict=True)))
    monkeypatch.chdir(tmp_path)
    return folder / "study.toml", table


def test_a_table_is_found_beside_its_study_and_kept_as_numbers(with_table, dipole):
    """What is downstream depends on what the file holds, not on what it is called."""
    path, table = with_table
    study = read_study(path)
    curve = study.iron_ring.curve
    assert (curve.file, list(curve.H_A_per_m), list(curve.B_T)) == (None, *H_B.values())
    inline = dipole(iron_ring=iron(kind="table", **H_B)).iron_ring.curve
    assert curve == inline
    table.rename(table.with_name("other.csv"))
    path.write_text(STUDY_WITH_TABLE.replace("mine.csv", "other.csv"))
    assert read_study(path) == study
    other = table.with_name("other.csv")
    other.write_text(other.read_text().replace("100.0,", "101.0,"))
    assert read_study(path) != study


def test_every_kind_of_curve_is_a_curve(dipole):
    for kind in ({"kind": "table", **H_B}, {"kind": "steel", "name": "aisi_1008"},
                 {"kind": "froehlich_kennelly", "initial_relative_permeability": 1000,
                  "saturation_polarization_T": 2.1},
                 {"kind": "brauer", "k1_m_per_H": 3.8, "k2_per_T2": 2.17, "k3_m_per_H": 396.2}):
        curve = curve_of(dipole(iron_ring=iron(**kind)))
        assert 1.3 < curve.B[-1] - MU_0 * curve.H[-1] < 2.2
    assert curve_of(dipole()) is None


def test_a_file_needs_a_folder(dipole):
    """A study that was not read from a file does not know where its table is."""
    with pytest.raises(StudyError, match=r"`curve\.file` of the iron of study dipole .*read_study"):
        curve_of(dipole(iron_ring=iron(kind="table", file="x.csv")))


@pytest.mark.parametrize(("old", "new", "said"), [
    (b"758.0", b"300.0", "H must rise from point to point"),
    (b",1.3", b",0.9", "B must rise from point to point"),
    (b"100.0,0.1\n160.0,0.25\n382.0,1.0\n", b"", "needs 4 to 10000 points"),
    (b"1837.0,1.5", b"1837.0,1500", "is it in mT or gauss?"),
    (b"1837.0,1.5", b"1837.0,-1.5", "is negative; give the first quadrant only"),
    (b"1837.0,1.5", b"1837.0,nan", "line 7 must hold two numbers"),
    (b"H_A_per_m,B_T", b"B_T,H_A_per_m", "H and B look exchanged"),
    (b"H_A_per_m,B_T", b"H_kA_per_m,B_T", "its header must be H_A_per_m,B_T."),
    (b"160.0,0.25", b"160.0,0.25 about", "line 4 must hold two numbers"),
    (b"# made up", b"# Fr\xf6hlich", "it must be UTF-8 text"),
    (None, b"", "it is empty"),
    (None, None, "No such file")])
def test_bad_tables_are_refused_with_their_place(with_table, old, new, said):
    """Study, key and table are named."""
    path, table = with_table
    read_study(path)  # the control
    content = table.read_bytes()
    assert old is None or old in content
    table.unlink()
    if new is not None:
        table.write_bytes(new if old is None else content.replace(old, new))
    with pytest.raises(StudyError) as caught:
        read_study(path)
    sentence = str(caught.value)
    assert said in sentence
    assert sentence.startswith(f"Input `iron_ring.curve.file` of study file {path} must be")
    assert str(table) in sentence


@pytest.mark.parametrize("name", [".", "steels", "no\\u0000name", "two\\nlines"])
def test_files_that_cannot_be_are_refused_in_one_line(with_table, name):
    path, _ = with_table
    path.write_text(STUDY_WITH_TABLE.replace("steels/mine.csv", name))
    with pytest.raises(StudyError, match=r"^Input `iron_ring\.curve\.file` of .*\.$"):
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
    block = build_magnet(dipole(array__recoil_permeability=1.25)).blocks[0]
    assert math.hypot(*block.magnetization) == pytest.approx(1.06 / (MU_0 * 1.25), rel=1e-12)
    assert math.hypot(*block.magnetization) != pytest.approx(1.06 / MU_0, rel=1e-2)


def test_moment_gives_remanence(short_dipole):
    """FASER's 330 A m2 in a full sector of 83.3 mm is 1.06 T."""
    study = short_dipole(array__remanence_T=None, array__block_moment_A_m2=330.0,
                         array__ring_length_m=1 / 12)
    block = build_magnet(study).blocks[0]
    volume = math.pi * (0.1865**2 - 0.104**2) / 16 / 12
    assert block.volume == pytest.approx(volume, rel=1e-12)
    assert block.remanence == pytest.approx(MU_0 * 330 / volume, rel=1e-12)


def test_moment_in_wrong_unit_is_refused(short_dipole):
    study = short_dipole(array__remanence_T=None, array__block_moment_A_m2=330e3)
    with pytest.raises(StudyError, match="block_moment_A_m2"):
        build_magnet(study)


@pytest.mark.parametrize(("key", "value", "said"), [
    ("array__remanence_T", True, "`remanence_T` is a number, not true"),
    ("array__blocks_per_ring", "16", "`blocks_per_ring` is a number, not the text"),
    ("noise__position_sd_m", [True, 1e-5, 1e-5], "`position_sd_m` is a number, not true"),
])
def test_words_are_no_numbers(dipole, key, value, said):
    """They would be converted to 1 T, or to 16 blocks."""
    table, _, name = key.partition("__")
    data = dipole().model_dump(mode="json", exclude_none=True)
    data.setdefault(table, {})[name] = value
    with pytest.raises(StudyError, match=said):
        parse_study(data)


@pytest.mark.parametrize(("positions", "said"), [
    ({"kind": "circles", "radius_m": 0.05, "angles": 10_000, "count": 100_000, "z_max_m": 0.1},
     "circles may have 1000000 points together, not 1000000000"),
    ({"kind": "circles", "radius_m": [0.05, 0.06], "angles": 1000, "count": 501, "z_max_m": 0.1},
     "not 1002000"),
    ({"kind": "grid", "start_m": [0, 0, 0], "end_m": [0.1, 0.1, 0.1], "count": [101, 100, 100]},
     "not 1010000"),
    ({"kind": "line", "start_m": [0, 0, 0], "end_m": [0, 0, 1], "count": 1_000_001}, "1000001"),
])
def test_positions_have_a_limit(positions, said):
    """A wrong count would otherwise take all memory; so of a plan's candidates."""
    for changes in ({"observation__positions": positions}, {"plan__candidates": [positions]}):
        with pytest.raises(StudyError, match=said):
            parse_study(changed(DIPOLE, **changes))


def test_candidates_have_a_limit_together():
    line = {"kind": "line", "start_m": [0, 0, 0], "end_m": [0, 0, 1], "count": 400_000}
    assert len(parse_study(changed(DIPOLE, plan__candidates=[line] * 2)).plan.candidates) == 2
    with pytest.raises(StudyError, match="1000000 points together, not 1200000"):
        parse_study(changed(DIPOLE, plan__candidates=[line] * 3))


def test_no_number_is_nan_or_infinite():
    """Limits do not hold for nan by themselves: every key of every table is tried."""
    def tables(kind):
        for one in kind.__subclasses__():
            yield one
            yield from tables(one)

    accepted = set()
    for table in tables(StudyModel):
        for name, field in table.model_fields.items():
            adapter = TypeAdapter(field.rebuild_annotation())
            for value in (math.nan, math.inf, -math.inf):
                for tried in (value, [value], [value] * 3, [[value] * 3] * 3):
                    with contextlib.suppress(ValidationError):
                        adapter.validate_python(tried)
                        accepted.add(f"{table.__name__}.{name}")
    # which are checked together
    assert accepted == {"TableCurve.H_A_per_m", "TableCurve.B_T"}
    for value in (math.nan, math.inf):
        with pytest.raises(ValidationError):
            TableCurve(kind="table", H_A_per_m=(1.0, 2.0, value), B_T=(0.1, 0.2, 0.3))
        with pytest.raises(ValidationError):
            TableCurve(kind="table", H_A_per_m=(1.0, 2.0, 3.0), B_T=(0.1, 0.2, value))


@pytest.mark.parametrize(("change", "said"), [
    ({"array__remanence": 1.2}, "Did you mean `remanence_T`?"),
    ({"zzz": "red"}, "Known keys here: name, "),
    ({"iron_ring__relative_permeability": 500.0}, "instead received nothing. Give `iron_ring`"),
    ({"instrument": {"gain": [1.02, 1, 1]}}, "1.02 is the whole factor, write 0.02;"),
    ({"array__inner_radius_m": 50.0}, "Was it meant in millimetres? Then write 0.05."),
    ({"dimension__x": 2}, "`dimension` of changed Study must be a table")])
def test_with_refuses_keys_and_tables_that_are_not_there(change, said):
    """A slip in a name was a TypeError, or an AttributeError of None."""
    study = parse_study(DIPOLE, "study file x.toml")
    with pytest.raises(StudyError) as caught:
        study.with_(**change)
    assert said in str(caught.value)
    assert study.with_(array__remanence_T=1.2).array.remanence_T == 1.2  # the control


def test_keys_of_a_table_that_need_each_other_are_changed_together():
    """They were changed one after the other, and refused. Control: one of them alone still is."""
    study = parse_study(DIPOLE, "study file x.toml")
    both = {"prior__temperature_coefficient_per_K": -1e-3, "prior__reference_temperature_C": 20.0}
    prior = study.with_(**both).prior
    assert (prior.temperature_coefficient_per_K, prior.reference_temperature_C) == (-1e-3, 20.0)
    assert prior.magnitude_sd == study.prior.magnitude_sd
    with pytest.raises(StudyError, match="together, or neither"):
        study.with_(prior__reference_temperature_C=20.0)


def test_a_map_in_place_of_the_study(tmp_path):
    """Of the two files of most commands, the study comes first. Control: a line of a study."""
    for name, said in (("map.csv", "take the study file first"), ("s.toml", "Correct that line")):
        (tmp_path / name).write_text("x_m,y_m,z_m,Bx_T\n0,0,0,1\n")
        with pytest.raises(StudyError, match=said):
            read_study(tmp_path / name)


@pytest.mark.parametrize(("turn", "asked"), [
    ("2", "by 115°. Were degrees meant\\? Then write 0.0349 for 2."), ("0.5", "by 29°"),
    ("1.57", ""), ("3.14", ""), ("0.7854", ""), ("0.2", ""), ("-1.2345", "")])
def test_a_turn_in_degrees_is_asked_about(tmp_path, turn, asked):
    """Right angles, and what `register` finds, are the controls."""
    path = tmp_path / "study.toml"
    path.write_text((ROOT / "studies/quadrupole/study.toml").read_text()
                    + f"\n[instrument]\nrotation_rad = [0, 0, {turn}]\n")
    with pytest.warns(HalbachWarning, match=asked) if asked else contextlib.nullcontext():
        read_study(path)


@pytest.mark.parametrize(("keys", "asked"), [
    ("memory_rows = 10", "memory_rows` is without effect"), ("memory_rows = 10\nmemory = 0.1", "")])
def test_a_memory_of_nothing_is_said(tmp_path, keys, asked):
    path = tmp_path / "study.toml"
    path.write_text(tomlkit.dumps(DIPOLE) + f"\n[instrument]\n{keys}\n")
    with pytest.warns(HalbachWarning, match=asked) if asked else contextlib.nullcontext():
        read_study(path)


@pytest.mark.parametrize(("outer", "asked"), [("1.5", "its blocks are 1.4 m thick"), ("0.9", "")])
def test_blocks_of_tons_are_asked_about(tmp_path, outer, asked):
    path = tmp_path / "study.toml"
    path.write_text(tomlkit.dumps(changed(DIPOLE, array__inner_radius_m=0.1,
                                          array__outer_radius_m=float(outer))))
    with pytest.warns(HalbachWarning, match=asked) if asked else contextlib.nullcontext():
        read_study(path)


SHORT = changed(DIPOLE, dimension=3, array__ring_length_m=0.05, array__rings=2)
TUBE = {"kind": "tube", "inner_radius_m": 1.0, "outer_radius_m": 1.2, "length_m": 0.01}


@pytest.mark.parametrize(("changes", "far"), [
    ({"array__ring_gap_m": 9.0}, 9.0), ({"array__ring_gap_m": 0.1}, None),
    ({"array__ring": [{"z_m": -6.0}, {"z_m": 6.0}]}, 11.95),
    ({"external": {"neighbours": [{"z_m": 9.95}]}}, 9.85),
    ({"external": {"neighbours": [{"z_m": 0.5}]}}, None),
    ({"iron": {"relative_permeability": 100.0, "bodies": [TUBE | {"z_m": 0.1}]}}, None)])
def test_sources_far_from_each_other_along_z_are_asked_about(changes, far):
    """The field was zero without a word; iron 60 m away was meshed for minutes before any."""
    study = parse_study(changed(SHORT, **changes))
    said = f"leave {far:.3g} m between each other along z" if far else ""
    with pytest.warns(HalbachWarning, match=said) if far else contextlib.nullcontext():
        build_magnet(study)


@pytest.mark.parametrize("changes", [
    {"array__ring": [{"z_m": -12.0}, {"z_m": 12.0}]}, {"external": {"neighbours": [{"z_m": 80.0}]}},
    {"iron": {"relative_permeability": 100.0, "bodies": [TUBE | {"z_m": 60.0}]}},
    {"shim_tray": {"rings": [{"radius_m": 0.03, "count": 4, "z_m": [20.0]}], "magnets": [
        {"name": "c", "size_m": [0.003] * 3, "remanence_T": 1.2, "count": 4}]}}])
def test_places_along_z_in_mm_are_refused(changes):
    with pytest.raises(StudyError, match="Was it meant in millimetres"):
        parse_study(changed(SHORT, **changes))


@pytest.mark.parametrize(("keys", "asked"), [
    ("background_T = [0, 0.5, 0]", r"500 mT, 10000 times the earth's field.* 1 G is 1e-4 T"),
    ("background_T = [0.03, 0.03, 0.03]", "52 mT, "), ("background_T = [0, 5e-5, 1e-3]", ""),
    ("dipoles = [{position_m = [0, 0, 0.5], moment_A_m2 = [0, 0, 2e5]}]", "up to 320 mT at the"),
    ("dipoles = [{position_m = [0, 0, 0.5], moment_A_m2 = [0, 0, 20]}]", "")])
def test_fields_that_no_surroundings_have_are_asked_about(tmp_path, keys, asked):
    """0.5 G, 30 uT or 0.2 A m2 in the unit of another program; 1 mT and 20 A m2 are the controls.

    On its axis a dipole of 2e5 A m2 makes 2e-7 * 2e5 / 0.5^3 T at 0.5 m.
    """
    path = tmp_path / "study.toml"
    path.write_text(tomlkit.dumps(DIPOLE) + f"\n[external]\n{keys}\n")
    study = read_study(path)
    for made in (lambda: build_magnet(study),
                 lambda: build_magnet(parse_study(DIPOLE)).with_(external=study.external)):
        with pytest.warns(HalbachWarning, match=asked) if asked else contextlib.nullcontext():
            made()


@pytest.mark.parametrize(("line", "said"), [
    ("radius_m = 0,012", "Write decimals with a point in “radius_m = 0,012”"),
    ("[array]", "Join the two tables or keys into one"), ("radius_m = ", "Correct that line")])
def test_lines_that_toml_does_not_allow(tmp_path, line, said):
    path = tmp_path / "study.toml"
    path.write_text(tomlkit.dumps(DIPOLE) + f"\n{line}\n")
    with pytest.raises(StudyError, match=said):
        read_study(path)


def test_what_is_uncertain_of_the_instrument_of_a_map(dipole):
    """The study of one map has what an amplitude changes of its own instrument, which is that of
    the study if it states none.
    """
    study = dipole(
        maps=[{"name": "body", "file": "a.csv"},
              {"name": "fringe", "file": "b.csv", "instrument": {"z_scale": 0.01}}],
        uncertain=[{"name": "scale", "sd": 1e-3, "change": {
            "instrument.z_scale": 1.0, "maps[2].instrument.z_scale": 2.0}},
            {"name": "weak", "sd": 0.01, "change": {"array.remanence_T": 1.0}}])
    for number, change in enumerate((1.0, 2.0)):
        first, second = study.of_map(number).uncertain
        assert first.change == {"instrument.z_scale": change}
        assert second == study.uncertain[1]


@pytest.mark.parametrize("name", [
    "prior.magnitude_sd", "mesh.block_size_m", "noise.regions[1].sigma_T",
    "observation.positions.end_m[1]", "instrument.length_unit_m", "instrument.flux_density_unit_T",
    "demagnetization.squareness", "maps[1].noise.regions[1].sigma_T"])
def test_what_no_update_estimates_is_not_uncertain(dipole, name):
    """Such tables were taken, and the bars stayed those without them: of a unit 1 % off, too."""
    material = {"intrinsic_coercivity_A_per_m": 955e3, "remanence_coefficient_per_K": -0.0012,
                "coercivity_coefficient_per_K": -0.006}
    noise = {"regions": [{"name": "all", "sigma_T": 1e-5}]}

    def study(key):
        return dipole(demagnetization=material, noise=noise, maps=[
            {"name": "body", "file": "a.csv", "noise": noise, "instrument": {"z_scale": 0.01}}],
            uncertain=[{"name": "u", "sd": 1e-3, "change": {key: 1.0}}])

    with pytest.raises(StudyError, match="which no update estimates"):
        study(name)
    for known in ("instrument.z_scale", "maps[1].instrument.z_scale", "array.remanence_T"):
        assert study(known).uncertain
