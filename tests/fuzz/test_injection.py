"""Study files are data: nothing in them becomes code of GetDP, a path, HTML, or a command."""

from __future__ import annotations

import json
from html.parser import HTMLParser

import numpy as np
import pytest
import tomlkit

from halbach_fe.cli import main
from halbach_fe.cli.common import print_table
from halbach_fe.core.errors import MeasurementError, MeshError, StudyError
from halbach_fe.geometry.domain import Regions
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.block_table import read_blocks
from halbach_fe.measurement.field_map import field_map, read_map, write_map
from halbach_fe.report.answer import Picture
from halbach_fe.solver.magnetostatics import CROSS_SECTION, fill_run_folder
from halbach_fe.solver.mesh import build_mesh, verify_mesh
from halbach_fe.study.model import Study
from halbach_fe.study.reader import parse_study, read_study
from tests.conftest import DIPOLE, changed, circle
from tests.fuzz.documents import HOSTILE
from tests.fuzz.readers import FREE_CSV, STEEL, WITH_STEEL
from tests.support.pages import write_any_page

TINY = changed(DIPOLE, array__blocks_per_ring=4, mesh__block_size_m=0.18, mesh__growth=4.0,
               open_boundary={"radius_m": 0.3}, prior={"types": {"a": [1, 2], "b": [3, 4]}},
               noise={"regions": [{"name": "bore", "sigma_T": 1e-4}]}, description="plain")



def tray(**keys):
    """A shim tray of one place, with one magnet."""
    return {"places_m": [[0.05, 0.0, 0.0]], "magnets": [
        {"name": "cube", "size_m": [0.005] * 3, "count": 1} | keys]}


FIELDS = {
    "name": lambda text: {"name": text},
    "description": lambda text: {"description": text},
    "noise.regions.name": lambda text: {
        "noise": {"regions": [{"name": text, "sigma_T": 1e-4}]}},
    "prior.types": lambda text: {"prior": {"types": {text: [1, 2], "b": [3, 4]}}},
    "iron_ring.curve.name": lambda text: {"iron_ring": {
        "inner_radius_m": 0.2, "outer_radius_m": 0.24, "curve": {"kind": "steel", "name": text}}},
    "array.material": lambda text: {"array__material": text},
    "maps.name": lambda text: {"maps": [{"name": text, "file": "map.csv"}]},
    "maps.probe": lambda text: {"maps": [{"name": "a", "file": "map.csv", "probe": text}]},
    "maps.stage": lambda text: {"maps": [{"name": "a", "file": "map.csv", "stage": text}]},
    "shim_tray.magnets.name": lambda text: {"shim_tray": tray(name=text, remanence_T=1.0)},
    "shim_tray.magnets.material": lambda text: {"shim_tray": tray(material=text)},
    "uncertain.name": lambda text: {"uncertain": [
        {"name": text, "sd": 0.1, "change": {"array.remanence_T": 1.0}}]},
    "uncertain.change": lambda text: {"uncertain": [
        {"name": "a", "sd": 0.1, "change": {text: 1.0}}]},
    "array.ring.material": lambda text: {"array__ring": [{"material": text}]},
}
"""All free text of a study, with what makes a study of it; names of files have tests below."""


def text_fields(schema):
    """Where a schema has strings that are not of a list, by model and key."""
    for model, definition in [("Study", schema), *schema["$defs"].items()]:
        for key, value in definition.get("properties", {}).items():
            ways = [value, *value.get("anyOf", ())]
            if any(way.get("type") == "string" and not {"enum", "const"} & set(way)
                   for way in ways):
                yield f"{model}.{key}"
            if "additionalProperties" in value and "propertyNames" not in value:
                yield f"{model}.{key}"


def test_there_is_no_other_text():
    """Whoever adds a field of text to the study decides here where it may go."""
    assert set(text_fields(Study.model_json_schema())) == {
        "Study.name", "Study.description", "NoiseRegion.name", "Prior.types", "SteelCurve.name",
        "TableCurve.file", "IronMesh.file", "Array.material", "Ring.material", "FreeBlocks.file",
        "MapSettings.name", "MapSettings.file", "MapSettings.probe", "MapSettings.stage",
        "ShimMagnet.name", "ShimMagnet.material", "Uncertain.name", "Uncertain.change"}


def hostile_studies():
    for field, change in FIELDS.items():
        for text in HOSTILE:
            yield field, text, changed(TINY, **change(text))


@pytest.fixture(scope="module")
def staged(tmp_path_factory):
    """All files of a run of GetDP, as text."""
    mesh = verify_mesh(build_mesh(build_magnet(parse_study(TINY)), tmp_path_factory.mktemp("mesh")))

    def files(study):
        folder = tmp_path_factory.mktemp("run")
        fill_run_folder(build_magnet(study), mesh, circle(0.05, 3), folder, CROSS_SECTION)
        return {path.name: path.read_text() for path in folder.iterdir() if path.suffix == ".pro"}
    return files


def test_nothing_of_a_study_becomes_code_of_getdp(staged):
    """The files are those of the harmless study, but for its name in a comment."""
    harmless, taken, refused = staged(parse_study(TINY)), set(), set()
    for field, text, document in hostile_studies():
        try:
            study = parse_study(document)
        except StudyError:
            refused.add(field)
            continue
        taken.add(field)
        files = staged(study)
        for name, content in files.items():
            content = content.replace(f"study {study.name},", "study dipole,")
            assert content == harmless[name], (field, text)
    assert taken == {"name", "description", "noise.regions.name", "prior.types", "maps.name",
                     "maps.probe", "maps.stage", "shim_tray.magnets.name", "uncertain.name"}
    assert refused == set(FIELDS)
    for payload in ("}; Exit; Group {", "../../../etc/passwd", "a\nb", "<< 7*7 >>"):
        with pytest.raises(StudyError):
            parse_study(changed(TINY, name=payload))
    # the control: a name that the study would not take shows in the file
    raw = parse_study(TINY).model_copy(update={"name": "a\nExit;"})
    assert "\nExit;" in staged(raw)["case.pro"]


def test_names_of_regions_are_no_code(tmp_path):
    path = tmp_path / "regions.json"
    sound = {"study": "a", "dimension": 2, "air": 1, "iron": None, "outer_boundary": 10,
             "blocks": [{"name": "r01s01", "ring": 1, "slot": 1, "tag": 1001}]}
    path.write_text(json.dumps(sound))
    Regions.read(path)  # the control
    for text in HOSTILE:
        if text in ("nan", "0", "x", "_hidden"):  # names like others
            continue
        for wrong in ({"study": text}, {"blocks": [sound["blocks"][0] | {"name": text}]}):
            path.write_text(json.dumps(sound | wrong))
            with pytest.raises(MeshError):
                Regions.read(path)


# --- paths --------------------------------------------------------------------------------------


def never_quotes(study, table, *damaged):
    """A study that names a table is refused, without a word from the table."""
    for secret in (b"root:x:0:0:secret\n", b"secret\xff", *damaged):
        table.write_bytes(secret)
        with pytest.raises(StudyError) as refused:
            read_study(study)
        assert "secret" not in str(refused.value)


def test_tables_may_be_anywhere_but_are_only_read_and_never_quoted(tmp_path):
    (tmp_path / "studies").mkdir()
    (tmp_path / "other").mkdir()
    study, table = tmp_path / "studies" / "study.toml", tmp_path / "other" / "steel.csv"
    for name in ("../other/steel.csv", str(table)):
        study.write_text(WITH_STEEL.replace("steel.csv", name))
        table.write_bytes(STEEL)
        assert read_study(study).iron_ring.curve.B_T[-1] == 1.5
        never_quotes(study, table, STEEL.replace(b"382.0", b"secret"),
                     STEEL.replace(b"H_A_per_m", b"secret"))
        assert sorted(path.name for path in tmp_path.rglob("*")) == [
            "other", "steel.csv", "studies", "study.toml"]


def test_tables_of_free_blocks_are_never_quoted(tmp_path):
    (tmp_path / "other").mkdir()
    study, table = tmp_path / "study.toml", tmp_path / "other" / "free.csv"
    document = changed(TINY, dimension=3, mesh__block_size_m=0.01,
                       array={"free_blocks": {"file": "other/free.csv"}})
    document.pop("prior")
    study.write_text(tomlkit.dumps(document))
    table.write_bytes(FREE_CSV)
    assert len(build_magnet(read_study(study)).blocks) == 4  # the control
    never_quotes(study, table, FREE_CSV.replace(b"200", b"secret"),
                 FREE_CSV.replace(b"angle_deg", b"secret_deg"))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    r"""A hostile study whose map is its own field, as `solve` and `infer` leave them.

    Their figures take no text of the study: its dollars would be formulas, and no formula is
    ``\\frac`` alone.
    """
    above = tmp_path_factory.mktemp("above")
    home = above / "home"
    home.mkdir()
    hostile = "<script>alert(1)</script>{{ 7*7 }}$\\frac$[red]日本語 ../../x"
    document = changed(
        TINY, description=f"{hostile}\n</pre><img src=x onerror=alert(1)>",
        noise={"regions": [{"name": hostile, "sigma_T": 1e-4}]}, array__ring_length_m=0.08,
        prior={"types": {f"{hostile}{slot}": [slot] for slot in range(1, 5)}})
    study, blocks = home / "study.toml", home / "blocks.csv"
    study.write_text(tomlkit.dumps(document), encoding="utf-8")
    rows = [f"# {hostile}: {hostile}", "serial,type,ring,slot,mx_A_m2,my_A_m2,mz_A_m2,sigma_A_m2"]
    for block in build_magnet(parse_study(document)).blocks:
        outward = np.append(block.middle[:2], 0) / np.hypot(*block.middle[:2])
        moment = 0.08 * block.area * block.magnetization
        rows.append(f'"{hostile}{block.slot}","{hostile}{block.slot}",1,{block.slot},'
                    f"{moment @ outward},{moment @ np.cross([0, 0, 1], outward)},0,0.5")
    blocks.write_text("\n".join(rows), encoding="utf-8")

    def run(verb, *arguments):
        assert main([verb, str(study), *map(str, arguments), "-o", str(home / verb)]) == 0

    run("solve")
    data = read_map(home / "solve" / "field_map.h5")
    data.attrs = {"note\n0,0,0,1,1,1": hostile}
    data["B_T"] = data["B_T"] + 1e-5
    write_map(data, home / "map.csv")
    run("infer", "--measurements", home / "map.csv")
    run("prior", blocks)
    run("sort", blocks)
    return above, hostile


def test_nothing_is_written_but_in_the_folder(campaign):
    above, _ = campaign
    assert [path.name for path in above.iterdir()] == ["home"]
    assert sorted(path.name for path in (above / "home").iterdir()) == [
        ".hf.write_map", "blocks.csv", "infer", "map.csv", "prior", "solve", "sort",
        "study.toml"]


def test_serial_numbers_come_back(campaign):
    above, hostile = campaign
    table = read_blocks(above / "home" / "sort" / "blocks.sorted.csv")
    assert sorted(table.serial) == [f"{hostile}{slot}" for slot in range(1, 5)]


# --- pages --------------------------------------------------------------------------------------


class Parts(HTMLParser):
    """Elements and names of attributes, in their order, and all text."""

    def __init__(self, page):
        super().__init__()
        self.parts, self.text = [], ""
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.parts.append((tag, *(name for name, _ in attributes)))

    def handle_data(self, data):
        self.text += data


def test_pages_hold_no_elements_of_names(campaign):
    above, hostile = campaign
    pages = sorted((above / "home").rglob("*.html"))
    assert [path.parent.name for path in pages] == ["infer", "prior", "solve", "sort"]
    for path in pages:
        text = path.read_text(encoding="utf-8")
        page = Parts(text)
        assert ("img", "src", "onerror") not in page.parts
        assert "onerror=alert(1)" in page.text  # as text, of the study's description
        assert "<script>alert" not in text
        assert hostile in page.text


@pytest.mark.parametrize("text", [*HOSTILE, "</title><b>", '" onload="x', "</script><!--", "-->"])
def test_templates_escape(tmp_path, text):
    """The frame that all pages share, text in every place; the harmless page is the control."""
    def parts(word):
        study = parse_study(TINY).model_copy(update={"description": word})
        write_any_page(tmp_path / "page.html", [Picture("", word)], study,
                   {word or "x": word})
        return Parts((tmp_path / "page.html").read_text(encoding="utf-8"))
    found = parts(text.replace("\ud7ff", ""))
    assert found.parts == parts("harmless").parts


def test_escaping_can_fail():
    """The control of the two above."""
    assert Parts("<p><b>x</b></p>").parts != Parts("<p>x</p>").parts


# --- terminals and tables -----------------------------------------------------------------------


@pytest.mark.parametrize("text", HOSTILE)
def test_terminals_get_text(capsys, text):
    print_table([{"name": text, "of": ":smile: [bold]x[/bold]"}], "title")
    shown = capsys.readouterr().out
    assert ":smile: [bold]x[/bold]" in shown
    assert all(c.isprintable() or c == "\n" for c in shown)
    if text.isprintable() and 0 < len(text.strip()) < 50:
        assert text.strip() in shown


@pytest.mark.parametrize("text", HOSTILE)
def test_errors_are_one_printable_line(text):
    for error in (MeasurementError(text), StudyError(f"x {text} y" * 1000)):
        assert str(error).isprintable()
        assert len(str(error)) < 4000


def test_attributes_and_scans_add_no_rows(tmp_path):
    """Of a file in HDF5, which can hold any text, a CSV file is made whose rows are the map's."""
    data = field_map(np.eye(3), np.ones((3, 3)), attributes={
        "a\n9,9,9,1,1,1": "b\n8,8,8,1,1,1", "c": "d\x0b7,7,7,1,1,1\u20286,6,6,1,1,1"})
    write_map(data, tmp_path / "map.h5")
    write_map(read_map(tmp_path / "map.h5"), tmp_path / "map.csv")
    assert read_map(tmp_path / "map.csv").sizes["point"] == 3
    data["scan"] = ("point", ["a", "b\n5,5,5,1,1,1", "c"])
    write_map(data, tmp_path / "map.h5")
    with pytest.raises(MeasurementError, match="scan of map"):
        read_map(tmp_path / "map.h5")
