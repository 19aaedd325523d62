"""One page of all results of a magnet: what it says, what it refuses, and what it doubts."""

from __future__ import annotations

import fcntl
import json
import os
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
import tomlkit

import halbach_fe as hf
from halbach_fe.cli import main
from halbach_fe.cli.verbs import VERBS
from halbach_fe.core.files import write_text
from halbach_fe.core.result_folder import RECORD, result_folder
from halbach_fe.report.answer import PAGE_RECORD, Answer, Picture
from halbach_fe.report.joint_report import _parts, read_campaign
from halbach_fe.report.joint_report_folders import ORDER, TELLING, _short, is_same_magnet
from halbach_fe.report.words import within_a_sentence
from tests.conftest import changed, parse_study
from tests.support.pages import write_any_page
from tests.support.results import STUDY, TINY, results


class Parts(HTMLParser):
    """Elements with the names of their attributes, links, anchors, sources, and all text."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.links, self.anchors, self.sources, self.text = [], [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.elements.append((tag, *named))
        self.links += [named["href"]] if "href" in named else []
        self.anchors += [named["id"]] if "id" in named else []
        self.sources += [named["src"]] if "src" in named else []

    def handle_data(self, data):
        self.text += data


def parts_of(path):
    return Parts(path.read_text(encoding="utf-8"))


def unresolved(path):
    """Links that lead nowhere."""
    page = parts_of(path)
    return [link for link in page.links
            if not (link[1:] in page.anchors if link.startswith("#")
                    else (path.parent / unquote(link)).is_file())]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A measured magnet, as the commands leave it."""
    home = tmp_path_factory.mktemp("campaign")
    study, made = home / "study.toml", home / "results" / "simulated"
    study.write_text(tomlkit.dumps(TINY))

    def run(verb, folder, *options, of=study):
        assert main([verb, str(of), "-o", str(home / "results" / folder), "--json", *map(
            str, options)]) == 0

    run("simulate-measurement", "simulated")
    run("solve", "field")
    run("infer", "inferred", "--measurements", made / "map.csv")
    run("multipoles", "multipoles", "--posterior", home / "results" / "inferred" / "posterior.h5")
    return home / "results"


def test_every_answer_is_on_the_page(campaign, capsys):
    folders = [campaign / name for name in ("multipoles", "inferred", "simulated", "field")]
    capsys.readouterr()
    assert main(["report", *map(str, folders), "-o", str(campaign / "all.html"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["folder"] for one in found["results"]] == [
        "field", "simulated", "inferred", "multipoles"]
    assert (found["doubts"], found["versions"]) == ([], [])
    page = parts_of(campaign / "all.html")
    for one in found["results"]:
        said = json.loads((campaign / one["folder"] / PAGE_RECORD).read_text())
        assert one["answer"] == said["answer"]
        for key in ("question", "said", "trust", "step"):
            assert said["answer"][key] in page.text
    assert ("These are 4 results of one magnet. The map of folder simulated is simulated, not "
            "measured. The answers may be used, for a test.") in page.text
    assert "1 ring of 4 sectors" in page.text
    assert [one for one in page.links if one.startswith("#")] == [
        *(f"#part-{number}" for number in (1, 2, 3, 4, 4, 3, 4))]  # contents, next steps
    assert unresolved(campaign / "all.html") == []
    assert "inferred/report.html" in page.links
    assert len(page.sources) == 5  # the magnet, and a figure of each
    assert all(one.startswith("data:image/png;base64,") for one in page.sources)
    assert not {"script", "link", "iframe", "object"} & {tag for tag, *_ in page.elements}
    # but for the map of the posterior, which a command names as the user did
    assert str(campaign) not in page.text.replace(str(campaign / "simulated" / "map.csv"), "")


def test_the_map_and_blocks_that_all_results_use_are_named(tmp_path, monkeypatch):
    """In commands of other chapters too; if there are two maps, none is."""
    monkeypatch.chdir(tmp_path)
    results(tmp_path / "field", "solve", answer=Answer(
        "Which?", "Some.", "Yes.", "Update.", "halbach-fe infer STUDY --measurements MAP -o DIR"))
    for name, maps in (("one", ["map.csv"]), ("two", ["map.csv", "other.csv"])):
        folders = [tmp_path / "field"]
        for number, map_ in enumerate(maps):
            (tmp_path / map_).write_text(map_)
            results(tmp_path / f"{name}-{number}", "diagnose")
            record = tmp_path / f"{name}-{number}" / "run.json"
            record.write_text(json.dumps(json.loads(record.read_text()) | {
                "named": {"MAP": map_}}))
            folders.append(tmp_path / f"{name}-{number}")
        commands = [answer.command for chapter, _, answer in read_campaign(folders).answered
                    if chapter.verb == "solve"]
        assert ("--measurements map.csv" in commands[0]) == (name == "one")


@pytest.mark.parametrize("there", [True, False])
def test_a_study_that_is_not_here_is_not_named(tmp_path, monkeypatch, there):
    """A path that held in the folder of the run leads nowhere from another one."""
    monkeypatch.chdir(tmp_path)
    results(tmp_path / "field", "solve", answer=Answer(
        "Which?", "Some.", "Yes.", "Next.", "halbach-fe verify r.toml -o DIR"),
        named={"STUDY": "r.toml"})
    if there:
        (tmp_path / "r.toml").touch()
    (_, _, answer), = read_campaign([tmp_path / "field"]).answered
    assert answer.command == f"halbach-fe verify {'r.toml' if there else 'STUDY'} -o DIR"


def test_the_page_may_be_elsewhere(campaign, tmp_path):
    """Its links start from where it is; in a folder, that is owned."""
    path = hf.campaign_report([campaign / "field", str(campaign / "inferred")], tmp_path / "of all")
    assert path == tmp_path / "of all" / "report.html"
    assert unresolved(path) == []
    (path.parent / "deeper").mkdir()
    moved = path.rename(path.parent / "deeper" / "report.html")
    assert len(unresolved(moved)) > 10  # the control
    assert json.loads((tmp_path / "of all" / RECORD).read_text())["command"] == "halbach-fe report"


def test_what_a_person_sees(campaign, capsys):
    assert main(["report", str(campaign / "field"), "-o", str(campaign / "one.html")]) == 0
    shown = capsys.readouterr()
    assert "nominal magnet" in " ".join(shown.out.split())
    assert f"Report: {campaign / 'one.html'}" in shown.err


def test_results_are_not_replaced(campaign, capsys):
    before = (campaign / "inferred" / "report.html").read_bytes()
    for output, said in (("inferred/report.html", "is a result of `halbach-fe infer`"),
                         ("inferred", "holds results of `halbach-fe infer`")):
        assert main(["report", str(campaign / "field"), "-o", str(campaign / output)]) == 8
        assert said in capsys.readouterr().err
    assert (campaign / "inferred" / "report.html").read_bytes() == before


def test_its_own_folder_is_left_out(tmp_path):
    """As wildcards may name it when it is written again."""
    folders = [results(tmp_path / "field", "solve"), tmp_path / "all"]
    for _ in range(2):
        assert hf.campaign_report(folders, tmp_path / "all").is_file()
    with pytest.raises(hf.HalbachError, match="halbach-fe report"):
        hf.campaign_report(folders, tmp_path / "other")


# --- what is refused ----------------------------------------------------------------------------


def another(**keys):
    return parse_study(changed(TINY, **keys))


@pytest.mark.parametrize(("study", "said"), [
    (another(name="other"), "study tiny and .*two of study other"),
    (another(array__inner_radius_m=0.12), "another `array.inner_radius_m`"),
    (another(array__blocks_per_ring=8), "another `array.blocks_per_ring`"),
    (another(array__multipole_order=2), "another `array.multipole_order`"),
    (another(dimension=3, array__ring_length_m=0.1), "another `dimension`")])
def test_results_of_two_magnets(tmp_path, study, said):
    folders = [results(tmp_path / "one", "solve"), results(tmp_path / "two", "infer", study)]
    with pytest.raises(hf.HalbachError, match=said) as refused:
        hf.campaign_report(folders, tmp_path / "all.html")
    assert refused.value.exit_code == 8
    assert not (tmp_path / "all.html").exists()


@pytest.mark.parametrize("keys", [
    {"array__remanence_T": 1.2}, {"array__inner_radius_m": 0.1045},
    {"array__exceptions": [{"ring": 1, "slot": 2, "magnetization_factor": 0.0}]},
    {"array__exceptions": [{"shift_m": [0.002, 0, 0]}]}, {"prior": {"common_mode_sd": 0.01}}])
def test_deviations_make_no_other_magnet(keys):
    """The control."""
    assert is_same_magnet(STUDY, another(**keys))
    assert not is_same_magnet(STUDY, another(array__blocks_per_ring=8, **keys))


def test_a_study_that_was_written_is_of_the_same_magnet(tmp_path):
    """Whatever a diagnosis has changed; without its folder nobody knows."""
    first = results(tmp_path / "field", "solve")
    found = results(tmp_path / "diagnosis", "diagnose", files=["study.diagnosed.toml"])
    after = results(tmp_path / "better", "infer", another(
        array__inner_radius_m=0.12, array__exceptions=[
            {"shift_m": [0.002, 0, 0]}, {"ring": 1}, {"inner_corner_loss": 0.0}]),
        [found / "study.diagnosed.toml"])
    page = parts_of(hf.campaign_report([first, after, found], tmp_path / "all.html"))
    assert ("better is of diagnosis/study.diagnosed.toml, which halbach-fe diagnose wrote: "
            "array.inner_radius_m is 0.12 instead of 0.104; array.exceptions has all "
            "blocks (moved by x 2.000, y 0.000, z 0.000 mm) besides.") in page.text
    assert re.findall(r"folder (\w+),", page.text) == [
        "field", "diagnosis", "better"]
    with pytest.raises(hf.HalbachError, match="of one magnet"):
        hf.campaign_report([first, after], tmp_path / "all.html")


def test_a_diagnosis_may_find_a_magnet_of_another_order(tmp_path):
    """Both began with one file, as in `explain` of a quadrupole's map with a study of a dipole,
    which ended in a refusal. Control: files that differ.
    """
    (tmp_path / "dipole.toml").write_text("one file")
    (tmp_path / "other.toml").write_text("another")
    first = results(tmp_path / "first", "infer", STUDY, [tmp_path / "dipole.toml"])
    order = another(array__multipole_order=2)
    found = results(tmp_path / "found", "diagnose", order, [tmp_path / "dipole.toml"],
                    files=["study.diagnosed.toml"])
    assert hf.campaign_report([first, found], tmp_path / "all.html").exists()
    apart = results(tmp_path / "apart", "diagnose", order, [tmp_path / "other.toml"])
    with pytest.raises(hf.HalbachError, match="of one magnet"):
        hf.campaign_report([first, apart], tmp_path / "all.html")


def no_page(folder):
    with result_folder(folder, "halbach-fe solve", "tiny"):
        write_text(folder / "field.csv", "1")


def edited_record(**keys):
    def make(folder):
        path = results(folder, "solve") / RECORD
        path.write_text(json.dumps(json.loads(path.read_text()) | keys))
    return make


def edited_page(content):
    return lambda folder: (results(folder, "solve") / PAGE_RECORD).write_text(content)


@pytest.mark.parametrize(("make", "said"), [
    (lambda folder: None, "does not exist"), (lambda folder: folder.write_text("1"), "a file"),
    (lambda folder: folder.mkdir(), "no run.json"), (no_page, "no page.json"),
    (edited_record(ended=""), "failed, was killed"), (edited_record(files={}), "no page.json"),
    (edited_record(command="rm -rf /"), "of `rm -rf /`"),
    (edited_record(command="halbach-fe report"), "halbach-fe report"),
    (edited_record(study="other"), "with a page of tiny"),
    (edited_page(""), "page.json"), (edited_page("[" * 100_000), "page.json"),
    (edited_page('{"page": "page.html", "title": "", "unknown": 1}'), "another version"),
    (edited_page('{"page": "../../field/page.html", "title": ""}'), "whose .* is none"),
    (lambda folder: results(folder, "check", None), "without a study only")])
def test_folders_that_are_none(tmp_path, make, said):
    make(tmp_path / "field")
    with pytest.raises(hf.HalbachError, match=said):
        hf.campaign_report([tmp_path / "field"], tmp_path / "all.html")
    assert not (tmp_path / "all.html").exists()


def test_a_stray_file_and_a_folder_twice(tmp_path, capsys):
    folder = results(tmp_path / "field", "solve")
    (tmp_path / "notes.txt").write_text("mine")
    for words, said in (([folder, tmp_path / "notes.txt"], "notes.txt, a file. Leave it out."),
                        ([folder, folder / "."], "twice")):
        assert main(["report", *map(str, words), "-o", str(tmp_path / "all.html")]) == 8
        assert said in capsys.readouterr().err
    with pytest.raises(hf.HalbachError, match="a list of folders"):
        hf.campaign_report([], tmp_path / "all.html")
    with pytest.raises(hf.HalbachError, match="a list of folders"):
        hf.campaign_report(str(folder), tmp_path / "all.html")


def test_a_folder_in_use(tmp_path):
    folder = results(tmp_path / "field", "solve")
    with (folder / RECORD).open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(hf.HalbachError, match="in use by a run"):
            hf.campaign_report([folder], tmp_path / "all.html")
    assert hf.campaign_report([folder], tmp_path / "all.html").is_file()


# --- what does not fit together -----------------------------------------------------------------


@pytest.fixture
def home(tmp_path):
    """A study, a map, and results of them that fit together."""
    for name in ("study.toml", "map.csv"):
        (tmp_path / name).write_text(name)
    study, readings = tmp_path / "study.toml", tmp_path / "map.csv"
    results(tmp_path / "field", "solve", reads=[study])
    results(tmp_path / "check", "check", None, [readings])
    results(tmp_path / "inferred", "infer", reads=[study, readings], files=["posterior.h5"])
    posterior = tmp_path / "inferred" / "posterior.h5"
    results(tmp_path / "ppm", "homogeneity", reads=[study, posterior])
    return tmp_path


def found_in(home, *names):
    names = names or sorted(path.parent.name for path in home.glob(f"*/{RECORD}"))
    return read_campaign([home / name for name in names])


def test_what_fits(home):
    """The control of all that follow."""
    assert found_in(home).doubts == found_in(home).versions == []
    assert found_in(home).answer.sound


def another_posterior(home):
    with result_folder(home / "inferred", "halbach-fe infer", "tiny", [home / "map.csv"]):
        write_text(home / "inferred" / "posterior.h5", "another")
        write_any_page(home / "inferred" / "page.html", [], STUDY)


def another_map(home):
    (home / "map.csv").write_text("another")
    results(home / "inferred", "infer", reads=[home / "study.toml", home / "map.csv"],
            files=["posterior.h5"])


def unused_finding(home, finds=True, verb="diagnose", concern=""):
    results(home / "diagnosis", verb, reads=[home / "study.toml"],
            files=["study.diagnosed.toml"], answer=Answer(
                "What?", "That.", "Yes.", "Step after diagnose.", concern=concern,
                changes_study=finds))


def another_material(home):
    results(home / "ppm", "homogeneity", another(array__remanence_T=1.2),
            [home / "study.toml", home / "inferred" / "posterior.h5"])


def other_results(home):
    for name, verb, read, wrote in (("one", "sort", ["map.csv", "blocks.csv"], []),
                                    ("two", "simulate-measurement", [], ["map.csv", "blocks.csv"])):
        for file in read:
            (home / file).write_text("an older one")
        results(home / name, verb, reads=[home / "study.toml", *(home / file for file in read)],
                files=wrote)


@pytest.mark.parametrize(("change", "said"), [
    (other_results, "one is out of date: it was computed with another map.csv and blocks.csv than "
     "two holds. Run halbach-fe sort again, or leave out what does not belong to it."),
    (lambda home: (home / "field" / "solve.png").write_text("x"),
     "Changed since the run in field: solve.png."),
    (lambda home: (home / "inferred" / "posterior.h5").unlink(),
     "Changed since the run in inferred: posterior.h5 (removed)."),
    (another_posterior, "ppm is out of date: it was computed with another posterior.h5 than "
     "inferred holds."),
    (another_map, "check and inferred read different files called map.csv."),
    (another_map, "check is of a file that no other result here is of: "),
    (unused_finding, "No result here is of diagnosis/study.diagnosed.toml: inferred and ppm are "
     "without what halbach-fe diagnose has found."),
    (another_material, "ppm is of another version of the study than field: array.remanence_T is "
     "1.2 instead of 1.06.")])
def test_what_does_not_fit(home, change, said):
    change(home)
    campaign = found_in(home)
    assert any(sentence.startswith(said) for sentence in campaign.doubts)
    assert not campaign.answer.sound
    assert "may be used as they stand" not in campaign.answer.said
    page = parts_of(hf.campaign_report([one.folder for one in campaign.chapters],
                                       home / "all.html"))
    assert said in page.text
    assert "What does not fit together" in page.text


@pytest.mark.parametrize("verb", ["diagnose", "register"])
def test_a_study_that_says_nothing_new_need_not_be_used(home, verb):
    """A diagnosis that found nothing, or a map that lies where the study says."""
    unused_finding(home, finds=False, verb=verb)
    assert found_in(home).doubts == []
    unused_finding(home, verb=verb)
    assert found_in(home).doubts != []  # the control


def test_measured_blocks_that_some_results_are_without(home):
    """Of one magnet, they would contradict those with them; the same command twice is a study of
    what the blocks tell.
    """
    blocks = {"MAP": home / "map.csv", "BLOCKS": home / "blocks.csv"}
    results(home / "sorted", "sort", named={"BLOCKS": home / "blocks.csv"})
    results(home / "shimmed", "shim", named={"MAP": home / "map.csv"})
    campaign = found_in(home, "field", "sorted", "shimmed")
    assert campaign.doubts == [
        "shimmed is without the measured blocks that sorted has read, and knows less of the "
        "magnet: run halbach-fe shim again with --blocks."]
    assert campaign.answer.step.startswith("Mend what does not fit together")
    results(home / "shimmed-too", "shim", named=blocks)
    assert found_in(home, "field", "sorted", "shimmed-too").doubts == []
    assert found_in(home, "field", "sorted", "shimmed", "shimmed-too").doubts == []


def test_other_settings_are_said_but_no_doubt(home):
    results(home / "field", "solve", another(mesh__block_size_m=0.01), [home / "study.toml"])
    campaign = found_in(home)
    assert campaign.doubts == []
    assert campaign.versions == ["inferred and ppm are of another version of the study than field: "
                                 "mesh.block_size_m is 0.02 instead of 0.01."]


def test_the_study_of_register_is_said_in_words(home):
    """Poses and errors of the probe are what it writes; what else differs is said, but not all."""
    results(home / "registered", "register", reads=[home / "study.toml", home / "map.csv"],
            files=["study.registered.toml"])
    registered = [home / "registered" / "study.registered.toml", home / "map.csv"]
    found = {"instrument": {"translation_m": [1e-3, 0, 0], "gain": [0.01, 0, 0]}}
    results(home / "better", "infer", another(**found), registered)
    of = ("better is of registered/study.registered.toml, which halbach-fe register wrote with the "
          "poses of maps and the errors of the probe that it found")
    assert found_in(home, "field", "registered", "better").versions == [
        f"{of}; nothing else differs."]
    results(home / "better", "infer", another(
        **found, mesh__block_size_m=0.01, prior__magnitude_sd=0.02, prior__direction_sd_deg=2.0,
        array__remanence_T=1.2), registered)
    said, = found_in(home, "field", "registered", "better").versions
    assert said.startswith(f"{of}. Beside these: ")
    assert said.count(" instead of ") == 3
    assert said.endswith(" and 1 more.")
    assert "instrument." not in said
    # of several maps, register's page of each is of a study of that map alone, with its own tables
    table = {"excluded_readings": [1, 2]}
    maps = [{"name": "low", "file": "map.csv", "instrument": found["instrument"],
             "inference": table}, {"name": "high", "file": "high.csv"}]
    results(home / "of-low", "register", another(**found, inference=table),
            [home / "study.toml", home / "map.csv"], ["study.registered.toml"])
    results(home / "of-both", "infer", another(maps=maps),
            [home / "of-low" / "study.registered.toml", home / "map.csv"])
    said, = found_in(home, "of-low", "of-both").versions
    assert said.endswith("; nothing else differs.")
    # a control: the same numbers from a diagnosis are named
    results(home / "diagnosed", "diagnose", reads=[home / "study.toml"],
            files=["study.diagnosed.toml"])
    results(home / "better", "infer", another(**found),
            [home / "diagnosed" / "study.diagnosed.toml", home / "map.csv"])
    assert "instrument.translation_m is" in found_in(home, "field", "diagnosed",
                                                     "better").versions[0]


def test_the_next_step_is_not_one_that_is_done_or_was_before(home):
    """An update with a map of the unsorted blocks does not follow sorting."""
    sort = Answer("Which block?", "These.", "Yes.", "Assemble.",
                  "halbach-fe infer STUDY --measurements MAP --blocks DIR/blocks.csv -o DIR")
    study, readings = home / "study.toml", home / "map.csv"
    results(home / "sorted", "sort", reads=[study], files=["blocks.csv"], answer=sort)

    def part_of(label):
        campaign = found_in(home)
        return next(part for part in _parts(campaign, home / "all.html") if part["name"] == label)

    assert part_of("sorted")["next"] is None
    results(home / "inferred", "infer", reads=[study, readings, home / "sorted" / "blocks.csv"],
            files=["posterior.h5"])
    assert part_of("sorted")["where"] == "below"
    posterior = home / "inferred" / "posterior.h5"
    results(home / "ppm", "homogeneity", reads=[study, posterior])
    results(home / "tray", "shim-tray", reads=[study, posterior], answer=Answer(
        "Which?", "Some.", "Yes.", "Look.", "halbach-fe homogeneity STUDY -o DIR"))
    assert part_of("tray")["where"] == "above"
    assert part_of("tray")["next"] == part_of("ppm")["number"]
    last = found_in(home).answer
    assert (last.step, last.command) == ("Look. See folder ppm for that.", "")
    # a control: another posterior was read there
    (home / "other.h5").write_text("another")
    results(home / "tray", "shim-tray", reads=[study, home / "other.h5"], answer=Answer(
        "Which?", "Some.", "Yes.", "Look.", "halbach-fe homogeneity STUDY -o DIR"))
    assert part_of("tray")["next"] is None
    # of the readings, as the posterior that was read there is; a control: of other ones
    for read, number in ((readings, part_of("ppm")["number"]), (home / "other.h5", None)):
        results(home / "moves", "shim", reads=[study, read], answer=Answer(
            "Which?", "None.", "Yes.", "Look.", "halbach-fe homogeneity STUDY -o DIR"))
        assert part_of("moves")["next"] == number


def test_the_next_command_names_the_folder_of_its_answer(home):
    """Neither that of the page, nor a word."""
    unused_finding(home)
    results(home / "diagnosis", "diagnose", answer=Answer(
        "What?", "That.", "Yes.", "Update.", "halbach-fe verify DIR/new.toml -o DIR", False))
    assert found_in(home, "field", "diagnosis").answer.command == (
        f"halbach-fe verify {home / 'diagnosis' / 'new.toml'} -o DIR")


def test_what_is_bad_about_the_magnet_is_said_first(home):
    """However many results come after it, unless a later one of that command is good."""
    bad = Answer("Do they?", "No.", "Yes.", "Choose.", concern="At 60 °C, half of it is lost.")
    results(home / "a-hot", "demagnetization", answer=bad)
    said = found_in(home, "field", "a-hot", "inferred").answer.said
    assert bad.concern in said
    assert said.index(bad.concern) < said.index("results of one magnet")
    assert bad.concern not in found_in(home, "field", "inferred").answer.said  # the control
    assert "as far as the magnet keeps its magnetization" in said
    assert found_in(home, "field", "a-hot", "inferred").answer.step.startswith("Settle first")
    assert "Settle" not in found_in(home, "field", "inferred").answer.step
    results(home / "b-cool", "demagnetization", answer=replace(bad, said="Yes.", concern=""))
    assert bad.concern not in found_in(home, "field", "a-hot", "b-cool").answer.said


def test_a_better_answer_replaces_one_that_is_not_sound(home):
    """Which the diagnosis of it led to; alone it makes the whole page doubtful."""
    study = home / "study.toml"
    results(home / "inferred", "infer", reads=[study, home / "map.csv"],
            files=["posterior.h5"], answer=Answer(
                "Like what?", "Bad.", "No.", "Diagnose.", "halbach-fe diagnose STUDY", False))
    unused_finding(home)
    alone = found_in(home, "field", "inferred").answer
    assert (alone.sound, alone.step) == (False, "Diagnose.")
    assert "Not to be trusted as it is: folder inferred." in alone.said
    assert alone.trust.startswith("Not folder inferred: for the reasons that stand below. The "
                                  "others, yes: they are of one study, and no file")
    assert "model and readings agree" not in alone.trust
    results(home / "sound", "infer", reads=[study, home / "map.csv"], answer=Answer(
        "Like what?", "Good.", "Yes. Model and readings agree: chi² is 1. More.", "", ""))
    assert found_in(home, "sound").answer.trust.startswith(
        "Yes: model and readings agree: chi² is 1. The results are of one study, and")
    bad = found_in(home, "inferred").answer.trust
    assert bad.startswith("No: for the reasons that stand below. But the results belong together: "
                          "they")
    results(home / "better", "infer", another(instrument={"translation_m": [1e-3, 0, 0]}),
            [home / "diagnosis" / "study.diagnosed.toml", home / "map.csv"])
    campaign = found_in(home, "field", "inferred", "better", "diagnosis")
    assert [one.label for one in campaign.chapters] == ["field", "inferred", "diagnosis", "better"]
    assert campaign.answer.said.endswith("Do not trust folder inferred: folder better takes "
                                         "its place. All others may be used as they stand.")
    assert campaign.answer.trust.startswith("Yes: trust in infer. The results are of")
    assert "simulated" not in campaign.answer.said
    assert (campaign.answer.sound, campaign.answer.step) == (True, "Step after infer.")


def test_a_good_and_a_refuted_update_do_not_follow_from_each_other(home):
    """Nor are all to be trusted; versions that a command wrote do follow, and are the control."""
    refuted = Answer("Like what?", "Bad.", "No. Model and map disagree. More.", "Diagnose.",
                     "halbach-fe diagnose STUDY", False)
    results(home / "refuted", "infer", another(prior__magnitude_sd=1e-4),
            [home / "study.toml", home / "map.csv"], answer=refuted)
    found = found_in(home, "inferred", "refuted")
    assert "Not to be trusted as it is: folder refuted." in found.answer.said
    assert found.answer.trust.startswith(
        "Not folder refuted: model and map disagree. The others, yes: trust in infer. The results "
        "are of versions of the study that have the same magnet and differ as is said below,")
    assert not found.answer.sound
    assert "prior.magnitude_sd is 0.0001 instead of" in found.versions[0]
    unused_finding(home)
    results(home / "better", "infer", another(instrument={"translation_m": [1e-3, 0, 0]}),
            [home / "diagnosis" / "study.diagnosed.toml", home / "map.csv"])
    control = found_in(home, "field", "diagnosis", "better").answer
    assert control.trust.startswith(
        "Yes: trust in infer. The results are of versions of the study that follow from each "
        "other,")


def updates_of_two_maps(home, first_T, second_T, sound, study="study.toml"):
    """An update by two maps, sound or not, and one by the first of them, which is sound.

    ``study`` is that of the first.
    """
    (home / "second.csv").write_text("second")
    poor = Answer("Like what?", "Much.", "Only in part.", "Look.", "", sound)
    for name, field_T, maps, answer in (("both", first_T, ["map.csv", "second.csv"], poor),
                                        ("one", second_T, ["map.csv"], None)):
        with result_folder(home / name, "halbach-fe infer", "tiny",
                           [home / (study if name == "both" else "study.toml"),
                            *(home / one for one in maps)]):
            write_text(home / name / "summary.json", json.dumps({"strongest_field": {
                "at_m": [0.01, 0, 0], "along": [1, 0, 0], "mean_T": field_T, "sd_T": 2e-5}}))
            write_any_page(home / name / "page.html", [], STUDY, answer=answer or Answer(
                "Like what?", "Little.", "Yes.", "Look.", ""))
    return found_in(home, "both", "one")


def test_a_sound_update_by_less_data_takes_no_place(home):
    """By one of two maps, whose probe is 1 % off, it is sound and wrong."""
    found = updates_of_two_maps(home, 0.353590, 0.357113, sound=False)
    assert "takes its place" not in found.answer.said
    assert found.doubts == [
        "both and one contradict each other: at (10, 0, 0) mm they have fields of 353.59 and "
        "357.113 mT, 3.52 mT apart, with error bars of 0.02 and 0.02 mT. At least one of them "
        "leaves out an error of its probe: give `instrument_sd.gain`, or compare their maps by "
        "halbach-fe check."]
    assert found.answer.trust.startswith("No: they do not all fit together")


def test_updates_that_agree_within_their_bars_fit(home):
    assert updates_of_two_maps(home, 0.353590, 0.353600, sound=True).answer.sound


def test_an_update_of_what_was_found_stands_for_the_one_before(home):
    """Control: one of the same study."""
    results(home / "diagnosis", "diagnose", reads=[home / "study.toml", home / "map.csv"],
            files=["study.diagnosed.toml"])
    updates_of_two_maps(home, 0.353590, 0.357113, True, "diagnosis/study.diagnosed.toml")
    assert found_in(home, "diagnosis", "both", "one").doubts == []
    updates_of_two_maps(home, 0.353590, 0.357113, True)
    assert any("contradict" in said for said in found_in(home, "diagnosis", "both", "one").doubts)


def test_the_instrument_that_an_update_found_makes_no_other_version(home):
    """Control: another instrument in another file."""
    found = another(instrument={"gain": [0.01, 0.01, 0.01]})
    results(home / "found", "infer", found, [home / "study.toml", home / "map.csv"])
    assert found_in(home, "field", "found").versions == []
    (home / "other.toml").write_text("other")
    results(home / "other", "infer", found, [home / "other.toml", home / "map.csv"])
    assert "another version" in found_in(home, "field", "other").versions[0]


def test_a_diagnosis_takes_the_place_of_the_registration_before_it(home):
    """Which lacked the cause; it fits the pose anew. Control: a diagnosis of another study."""
    poor = Answer("Where?", "There.", "No.", "Diagnose.", "halbach-fe diagnose STUDY", False)
    results(home / "registered", "register", reads=[home / "study.toml", home / "map.csv"],
            files=["study.registered.toml"], answer=poor)
    results(home / "control", "diagnose", reads=[home / "study.toml", home / "map.csv"])
    assert "Not to be trusted as it is: folder registered." in found_in(
        home, "registered", "control").answer.said
    results(home / "diagnosis", "diagnose", reads=[
        home / "registered" / "study.registered.toml", home / "map.csv"])
    found = found_in(home, "registered", "diagnosis").answer
    assert "Do not trust folder registered: folder diagnosis takes its place." in found.said
    assert found.sound


def test_what_ignores_a_diagnosis_is_repeated_with_it(home):
    """A command is not told to diagnose what has been diagnosed; the control has no diagnosis."""
    results(home / "shimmed", "shim", reads=[home / "study.toml", home / "map.csv"],
            files=["study.shimmed.toml"], answer=Answer(
                "Which?", "Some.", "No.", "Diagnose.", "halbach-fe diagnose STUDY", False))
    assert found_in(home, "field", "shimmed").answer.step == "Diagnose."
    unused_finding(home)
    last = found_in(home, "field", "shimmed", "diagnosis").answer
    assert last.step.startswith("Repeat shimmed with diagnosis/study.diagnosed.toml")
    assert not last.sound
    assert last.trust.startswith(("No", "Only"))
    unused_finding(home, concern="The magnet was not assembled as designed: turn a block.")
    by_hand = found_in(home, "field", "shimmed", "diagnosis").answer
    assert by_hand.step.startswith("Put right what was not assembled as designed, and measure "
                                   "again. Or, if it stays, repeat shimmed with diagnosis/")
    assert "turn a block" in by_hand.said
    # what is not of the measured magnet is not repeated with the diagnosis
    results(home / "rough", "solve", reads=[home / "study.toml"], answer=Answer(
        "How?", "Some.", "No.", "Refine.", "halbach-fe verify STUDY", False))
    assert found_in(home, "rough", "shimmed", "diagnosis").answer.step == "Refine."


def test_a_diagnosis_that_is_not_sound_says_itself_what_to_do(home):
    """Of an unknown cause: its study is not one to repeat anything with."""
    results(home / "shimmed", "shim", reads=[home / "study.toml", home / "map.csv"],
            files=["study.shimmed.toml"], answer=Answer(
                "Which?", "Some.", "No.", "Diagnose.", "halbach-fe diagnose STUDY", False))
    results(home / "diagnosis", "diagnose", reads=[home / "study.toml", home / "map.csv"],
            files=["study.diagnosed.toml"], answer=Answer(
                "What?", "Unknown.", "No.", "Measure elsewhere.", "halbach-fe plan STUDY", False))
    assert found_in(home, "field", "shimmed", "diagnosis").answer.step == "Measure elsewhere."


def test_commands_name_the_folder_that_holds_their_file(home):
    results(home / "shimmed", "shim", reads=[home / "study.toml", home / "map.csv"],
            files=["study.shimmed.toml"], answer=Answer(
                "Which?", "Some.", "Yes.", "Measure.",
                "halbach-fe infer DIR/study.shimmed.toml -o DIR"))
    assert found_in(home, "field", "shimmed").answer.command == (
        "halbach-fe infer shimmed/study.shimmed.toml -o DIR")


def test_the_order_is_that_of_the_data(tmp_path):
    """And every command has its place in it."""
    for number, verb in enumerate(reversed(ORDER)):
        results(tmp_path / f"{number:02}", verb)
    results(tmp_path / "99", "of-later-versions")
    assert [one.verb for one in found_in(tmp_path).chapters] == [*ORDER, "of-later-versions"]
    assert set(ORDER) <= set(VERBS)
    assert set(TELLING) <= set(ORDER)


# --- files are data -----------------------------------------------------------------------------

PLANTED = ("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "</title></style><b>",
           "{{ 7*7 }}", "javascript:alert(1)", "\x1b[31m\u202e")


def everywhere(home, text):
    """Results with a text in every place where there may be any, past what writes them."""
    folder = results(home / "field", "solve", files=["a.csv"])
    said = json.loads((folder / PAGE_RECORD).read_text())
    said |= {"title": text, "rows": [{text or "x": text}], "provenance": {"programs": text},
             "answer": {key: text if isinstance(value, str) else False
                        for key, value in said["answer"].items()} | {"numbers": [[text, text]]}}
    said["figures"][0]["caption"] = text
    said["study"]["description"] = text.replace("\x1b", "").replace("\u202e", "")
    (folder / PAGE_RECORD).write_text(json.dumps(said))
    record = json.loads((folder / RECORD).read_text())
    record |= {"ended": text, "inputs": {f"{text}.csv": text}}
    (folder / RECORD).write_text(json.dumps(record))
    return folder


@pytest.mark.parametrize("text", PLANTED)
def test_planted_texts_stay_texts(tmp_path, text):
    """The page has the elements of one with harmless texts of the same words and folders."""
    def page(word, name):
        (tmp_path / name).mkdir()
        return parts_of(hf.campaign_report([everywhere(tmp_path / name, word)],
                                           tmp_path / name / "all.html"))

    planted, harmless = page(text, "planted"), page(re.sub("[^/ ]", "x", text), "harmless")
    assert planted.elements == harmless.elements
    assert len(planted.sources) == 2
    assert "\x1b" not in planted.text
    assert "\u202e" not in planted.text
    if text.isprintable():
        assert planted.text.count(text) >= 10
    assert Parts(text).elements or "<" not in text  # the control: it would be an element


@pytest.mark.parametrize("name", ["javascript:alert(1)", '"><b>', "a b#c?d", "%2e%2e", "Größe",
                                  os.fsdecode(b"\xff")])
def test_names_of_folders_are_no_markup(tmp_path, name):
    path = hf.campaign_report([results(tmp_path / name, "solve")], tmp_path / "all.html")
    page = parts_of(path)
    assert not {"script", "b"} & {tag for tag, *_ in page.elements}
    assert not any(":" in link for link in page.links)
    files = [link for link in page.links if not link.startswith("#")]
    assert all(os.path.isfile(os.fsencode(tmp_path) + b"/" + unquote_bytes(link))
               for link in files)
    assert len(files) == 4  # the page, and three files


def unquote_bytes(link):
    return os.fsencode(unquote(link, errors="surrogateescape"))


@pytest.fixture
def secret(tmp_path):
    path = tmp_path / "secret.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\nsecret")
    return path


def pointing(name):
    def change(folder, secret):
        said = json.loads((folder / PAGE_RECORD).read_text())
        said["figures"][0]["file"] = name.replace("SECRET", str(secret))
        (folder / PAGE_RECORD).write_text(json.dumps(said))
    return change


def linked(folder, secret):
    (folder / "solve.png").unlink()
    (folder / "solve.png").symlink_to(secret)


def no_picture(folder, secret):
    (folder / "solve.png").write_text("<svg onload='alert(1)'>secret")


def endless(folder, secret):
    (folder / "solve.png").unlink()
    os.mkfifo(folder / "solve.png")


@pytest.mark.parametrize("change", [
    pointing("../secret.png"), pointing("SECRET"), pointing("a.csv"), pointing(""), linked,
    no_picture, endless])
def test_figures_are_png_of_the_folder(tmp_path, secret, change):
    """Nothing else gets into the page."""
    folder = results(tmp_path / "field", "solve", files=["a.csv"])
    assert len(parts_of(hf.campaign_report([folder], tmp_path / "all.html")).sources) == 2
    change(folder, secret)
    assert len(parts_of(hf.campaign_report([folder], tmp_path / "all.html")).sources) == 1


def test_page_records_are_of_what_is_on_the_page(tmp_path):
    """What a page says, it says to machines too."""
    write_any_page(tmp_path / "one.html", [Picture("", "what is seen", "a.png")],
               STUDY, {"map": "m.csv"}, Answer("q", "s", "t", "n"), [{"a": "1"}])
    said = json.loads(Path(tmp_path, PAGE_RECORD).read_text())
    assert said["provenance"].pop("programs").startswith("halbach-fe")
    assert said.pop("study")["name"] == "tiny"
    assert said == {
        "page": "one.html", "title": "tiny: Calibration", "rows": [{"a": "1"}],
        "figures": [{"file": "a.png", "caption": "what is seen"}], "provenance": {"map": "m.csv"},
        "answer": {"question": "q", "said": "s", "trust": "t", "step": "n", "command": "",
                   "sound": True, "concern": "", "changes_study": True, "gist": "", "numbers": []}}


def test_numbers_beside_infinite_ones():
    """Control: what is nothing beside finite ones is 0."""
    assert _short([1.0, float("inf"), 1e-12]) == "1, inf, 0"
    assert _short([float("nan"), 2.0]) == "nan, 2"


@pytest.mark.parametrize(("sentence", "within"), [
    ("Bx and By of 3 readings disagree", "Bx and By of 3 readings disagree"),
    ("Bz, which is small", "Bz, which is small"), ("|B| is known", "|B| is known"),
    ("NMR readings", "NMR readings"), ("Maxwell's equations", "Maxwell's equations"),
    ("It is noise", "it is noise"), ("A reading is wrong", "a reading is wrong"),
    ("The readings, all", "the readings, all"), ("B is large", "B is large"), ("", "")])
def test_names_keep_their_first_letter(sentence, within):
    assert within_a_sentence(sentence) == within
