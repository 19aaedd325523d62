"""The verbs on measurements: check, register, prior, infer, diagnose, explain, report, simulate."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import io
import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import halbach_fe as hf
from halbach_fe.cli import common
from halbach_fe.cli.common import question
from halbach_fe.cli.shared_options import (
    AXES,
    BLOCKS,
    GETDP_LIMIT_S,
    HELD_OUT,
    JSON,
    MAP_OR_LISTED,
    OUTPUT,
    SEED,
    SOLVED,
    SOLVER_WITHOUT_LIMIT,
    STUDY,
    VERBS,
    choice,
    dry_run,
    finite_number,
    input_file,
    map_format,
    option,
    parser,
    path,
    positive,
    positive_number,
    verb,
    whole,
    within,
)
from halbach_fe.core.errors import (
    CommandLineError,
    MeasurementError,
    OutputError,
    StudyError,
    must_be,
)
from halbach_fe.core.files import InputFile
from halbach_fe.core.numbers import parse_number
from halbach_fe.core.progress import Say, quiet
from halbach_fe.measurement.formats.declared_format import DeclaredFormat

if TYPE_CHECKING:
    import xarray as xr

    from halbach_fe.diagnosis.cost_estimate import DiagnosisEstimate
    from halbach_fe.diagnosis.effects.base import Effect
    from halbach_fe.diagnosis.result import Floor
    from halbach_fe.inference.pose_result import OpenKey
    from halbach_fe.report.answer import Answer
    from halbach_fe.report.page import Page
    from halbach_fe.synthetic.hidden_effects import RequestedEffect


@verb(
    option("map", input_file, "MAP", "field map (CSV, HDF5 or VTU)"),
    option("others", input_file, "MAP",
           "other maps of the same magnet, to be joined with the first one", nargs="*"),
    option("-o --output", path, "DIR", "folder for the page and its files"),
    option("--turn-rad", within(positive_number, 0, math.pi / 2), "SD",
           "prior standard deviation of the turns of several maps against each other (default: "
           "0.05); of one stage that was only shifted it is some 0.001"),
    JSON, map_format("MAP"))
def check(arguments: argparse.Namespace) -> int:
    """Check a field map against Maxwell's equations, before any magnet.

    Fits the map by a field of sources outside the mapped region together with the parameters of a
    three-axis probe. Says which signs or exchanged axes make the map obey div B = 0 and curl B = 0,
    where the sensors are, how the probe is turned, which rows are broken, and which noise remains:
    no model of a magnet can explain the map any better. With an output folder, also writes
    check.json, check.csv (the residual of every reading), check.html and its figures,
    oriented_map.csv, the map without broken rows and with its components along the right axes,
    inner_map.csv, its region that a field without sources describes, if it is not all, and
    corrected_map.csv, what a probe without errors would have read. A map of one or two components
    is judged by what these show. Of a map of |B| alone only rows that are broken, repeated places
    and noise are checked, and the folder has check.json and check.html.

    Several maps of one magnet are checked one by one and then joined: their relative poses follow
    from where they overlap and from one field without sources for all, no magnet is assumed. Maps
    that contradict each other are named. The folder then has joined.json (poses with their
    covariance), joined.csv (all maps in the frame of the first one), joined.html, and a folder for
    each map.
    """
    from halbach_fe.measurement.field_map import is_total_field

    files = [arguments.map, *arguments.others]
    if arguments.turn_rad and not arguments.others:
        raise CommandLineError(must_be(
            "--turn-rad", "the command line", "left out for a single map", "given",
            "It is of maps that are joined."))
    if arguments.others:
        arguments.listed_maps = _by_name(files)
    maps = [common.read_one(arguments, file) for file in files]
    if arguments.output is not None:  # before the check, which may take a minute
        other = "check.json" if arguments.others else "joined.json"
        if (arguments.output / other).exists():
            raise OutputError(f"Folder {arguments.output} has {other}, of a check of "
                              f"{'a single map' if arguments.others else 'several maps'}, which "
                              "this one would remove. Name another folder, or remove this one.")
        common.own_folder(arguments)
    say = quiet if arguments.json else common.say
    found: object
    with common.progress_bar("checking") as show:
        if arguments.others:
            from halbach_fe.measurement.map_join_fit import TURN_RAD

            found = hf.join_maps(dict(zip(arguments.listed_maps, maps, strict=True)), say, show,
                                 arguments.turn_rad or TURN_RAD)
        elif is_total_field(maps[0]):
            from halbach_fe.measurement.suspect_rows import check_total
            from halbach_fe.report.map_check_page import total_page

            found = total_page(maps[0], check_total(maps[0]))
        else:
            found = hf.check_map(maps[0], say, show)
    return common.finish(arguments, found)


def _by_name(files: list[InputFile]) -> dict[str, InputFile]:
    """Return the files by the names of their maps, which are those of the files or their folders.

    CommandLineError if that does not tell them apart.
    """
    for names in ([file.stem for file in files],
                  [f"{file.parent.name}_{file.stem}" for file in files]):
        if len(set(names)) == len(files):
            return dict(zip(names, files, strict=True))
    raise CommandLineError(must_be(
        "MAP", "command line", "maps of different names", " and ".join(map(str, files)),
        "Leave out the one that was given twice, or rename one of two different maps."))


def _open_key(text: str) -> OpenKey:
    from halbach_fe.inference.pose_result import OpenKey

    key, _, sd = text.partition("=")
    try:
        value = parse_number(sd)
    except ValueError:
        value = math.nan
    if not key or not (0 < value < math.inf):
        raise argparse.ArgumentTypeError(
            f"must be KEY=SD with a positive number, such as array.remanence_T=0.02, not '{text}'")
    return OpenKey(key, value)


def _open_keys(text: str) -> list[OpenKey]:
    found = [_open_key(part.strip()) for part in text.split(",")]
    keys = [each.key for each in found]
    for key in keys:
        if keys.count(key) > 1:
            raise argparse.ArgumentTypeError(f"must name {key} once")
    return found


class _DifferentKeys(argparse.Action):
    """An option that can be given several times, for another key each time."""

    def __call__(
        self, parser: object, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        before = getattr(namespace, self.dest)
        if any(each.key == values.key for each in before):
            raise argparse.ArgumentError(self, f"is given twice for {values.key}; leave one out")
        setattr(namespace, self.dest, [*before, values])


@question(
    SOLVED, map_format("--measurements"), MAP_OR_LISTED,
    option("--fit", _open_key, "KEY=SD", "a number of the study that is open, with its standard "
           "deviation, such as array.remanence_T=0.02, or instrument.z_scale=0.02 for the step of "
           "the map; can be given several times", action=_DifferentKeys, default=[]),
    option("--alternative", _open_keys, "KEY=SD,...", "other numbers that may be open in place of "
           "those of --fit; their odds are compared; can be given several times", action="append",
           default=[]),
    option("--most", positive, "N", "largest number of poses that are fitted with the blocks "
           "(default: 4, or 8 on a line, of those that the search finds)"),
    # as far as all lengths of a study
    option("--across-m", within(positive_number, 0, 10.0), "SD",
           "prior standard deviation of the map's distance from the axis, for a map that does not "
           "determine it (default: the blocks' outer radius)"),
    option("--turn-rad", within(positive_number, 0, math.pi / 2), "SD",
           "prior standard deviation of the map's turns from right angles, for a map that does not "
           "determine them (default: 0.1)"),
    option("--joined", input_file, "JSON",
           "joined.json of `halbach-fe check MAP MAP`: where overlaps of the maps that the study "
           "lists have them without a magnet, which poses must not contradict"))
def register(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Find where a field map lies in the magnet, and the probe's axes.

    Needs no first guess: every rotation by right angles and every place along the axis is tried,
    then pose and probe are fitted together with the blocks. Numbers that a drawing leaves open can
    be fitted too, and sets of them are compared with --alternative. Writes study.registered.toml
    (the study's own file with the instrument and these numbers), registration.json,
    registration.html and its figure. A symmetric magnet allows several poses, all of which are
    reported with their odds; the file has the most probable one, or of those between which the
    readings do not decide the one that is turned least. If the study lists maps, they are
    registered one after the other, each in the magnet as those before it have updated it, and each
    gets a folder with its own page. With --joined a pose that contradicts the overlap of maps is
    said, and the overlap is a datum of the update by maps on one stage.
    """
    from halbach_fe.inference.pose_result import PosePrior
    from halbach_fe.report.registration_page import page

    study = magnet.study
    data = common.read_measurements(arguments, study)
    say = quiet if arguments.json else common.say
    if isinstance(data, dict):
        for name in ("alternative", "most", "across_m", "turn_rad"):
            if getattr(arguments, name):
                option = f"--{name.replace('_', '-')}"
                raise StudyError(must_be(
                    option, "the command line", "left out for a study that lists several maps",
                    "given", "Register one of the maps alone with it."))
        return _run_campaign(arguments, study, data, say)
    if arguments.joined:
        raise StudyError(must_be(
            "--joined", "the command line", "left out for a single map", "given",
            "List the maps that were joined in the study ([[maps]])."))
    pose = PosePrior(arguments.across_m, arguments.turn_rad or PosePrior.turn_rad)
    with common.session(arguments, study) as session:
        found = hf.register(magnet, data, session, open_keys=arguments.fit,
                            alternatives=arguments.alternative, most=arguments.most, pose=pose,
                            say=say)
    return page(study, data, found)


def _run_campaign(
    arguments: argparse.Namespace, study: hf.Study, data: dict[str, xr.Dataset],
    say: Say,
) -> int:
    """Register all maps that the study lists, each with a page in a folder of its own."""
    from halbach_fe.core.files import make_folder
    from halbach_fe.inference.registration import register_maps, registered_study
    from halbach_fe.measurement.campaign_maps import maps_of
    from halbach_fe.measurement.map_join import read_joined
    from halbach_fe.report.page import write_changed_study, write_files
    from halbach_fe.report.registration_page import NOTE, STUDY_FILE, pages_of_maps

    maps, joined = maps_of(study, data), arguments.joined and read_joined(arguments.joined)
    with common.session(arguments, study) as session:
        found = register_maps(hf.build_magnet(study.with_(maps=())), maps, session, arguments.fit,
                              say, joined)
    write_changed_study(arguments.output / STUDY_FILE,
                        [(registered_study(study, maps, found, joined), NOTE)], arguments.study)
    pages = pages_of_maps(maps, found)
    paths = {name: write_files(page, make_folder(arguments.output / name))
             for name, page in pages.items()}
    if arguments.json:
        common.print_json({"maps": {name: page.summary for name, page in pages.items()}})
        return 0
    for name, page in pages.items():
        common.say(f"Map {name}:")
        common.say_page(arguments, page, paths[name])
    return 0


@question(STUDY, OUTPUT, option("blocks", input_file, "BLOCKS", "table of measured blocks (CSV)"),
          JSON)
def prior(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Turn moments of single blocks, measured in a Helmholtz coil, into a prior.

    Writes prior.h5 (mean and covariance), prior.json, prior.html and its figure. `halbach-fe infer
    --blocks` uses the same prior directly.
    """
    return hf.prior(magnet, hf.read_blocks(arguments.blocks))


@question(
    SOLVED, dry_run, MAP_OR_LISTED, BLOCKS, HELD_OUT,
    map_format("--measurements and --held-out"),
    option("--samples", positive, "N", "for iron with an H(B) curve: sample the non-linear "
           "posterior by four Markov chains of N draws each, instead of linearizing"),
    option("--seed", positive, "N",
           "seed of the random numbers of the chains of --samples (default: 1)"))
def infer(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Update a study's block magnetizations with a measured field map.

    Writes posterior.h5, prediction.csv, summary.json, report.html and its figures, and, if the map
    has full circles, multipoles.csv. `halbach-fe multipoles` computes the multipoles from
    posterior.h5 for any map. If the study lists maps, all of them update the magnet together, and
    test each other where they overlap. Terms of instruments of which the study states a standard
    deviation are estimated with the magnetizations; study.updated.toml, the study's own file, then
    has the instruments that were found.
    """
    from halbach_fe.inference.infer import observation_of
    from halbach_fe.measurement.field_map import refuse_total_field

    study = magnet.study
    data = common.read_measurements(arguments, study)
    blocks, validation_map = common.blocks_and_held_out(arguments, study)
    if arguments.samples and not magnet.is_nonlinear:
        raise StudyError(
            f"Input --samples must go with iron that has an H(B) curve; study {magnet.name} is "
            "linear, and its posterior has a closed form. Leave it out.")
    if arguments.seed and not arguments.samples:
        raise StudyError(must_be(
            "--seed", "the command line", "beside --samples, whose chains alone are random",
            "given alone", "Leave it out."))
    if arguments.samples:
        from halbach_fe.inference.mcmc import check_sampling

        check_sampling(magnet)
        for one in [validation_map, *(data.values() if isinstance(data, dict) else [data])]:
            if one is not None:
                refuse_total_field(one, "--samples")
    if arguments.dry_run:
        from halbach_fe.response.resource_estimate import estimate_infer

        if arguments.samples:
            common.say("The estimate does not include the chains of --samples.")
        observation = observation_of(magnet, data, blocks, validation_map)
        return common.print_estimate(
            estimate_infer(magnet, observation, common.jobs(arguments)), arguments.json)
    with common.session(arguments, study) as session:
        result = hf.infer(magnet, data, session, blocks, linearized_only=bool(arguments.samples),
                          validation_map=validation_map, say=common.say)
        if arguments.samples:
            from halbach_fe.inference.mcmc import sample_posterior, with_samples, write_sampled

            with common.workers(arguments) as pool:
                sampled = sample_posterior(
                    result, session, arguments.samples, seed=arguments.seed or 1, say=common.say,
                    mapped=pool.map)
            result = with_samples(result, sampled)
            write_sampled(sampled, arguments.output)
        result = replace(
            result, magnetic_axis=hf.magnetic_axis(magnet, session, result.posterior),
            stray_field=hf.stray_field(magnet, session, result.posterior))
    if result.response.reused:
        common.say("The response matrix of an earlier run in this folder fits and was reused.")
    return result


def effects_of(text: str) -> list[Effect]:
    """Parse a comma-separated list of names of effects."""
    from halbach_fe.diagnosis.effects import catalogue

    effect_by_name = {effect.name: effect for effect in catalogue()}
    for name in text.split(","):
        if name not in effect_by_name:
            near = difflib.get_close_matches(name, effect_by_name, 1, 0.5)
            raise argparse.ArgumentTypeError(
                f"no effect is called '{name}'"
                + (f"; did you mean {near[0]}?" if near
                   else f"; there are {', '.join(effect_by_name)}"))
    return [effect_by_name[name] for name in dict.fromkeys(text.split(","))]


@question(
    STUDY, OUTPUT, SOLVER_WITHOUT_LIMIT, JSON, dry_run, MAP_OR_LISTED, BLOCKS, HELD_OUT,
    map_format("--measurements and --held-out"),
    option("--time-limit", positive_number, "SECONDS", "time in s after which the search ends with "
           "what it has so far; the step under way is finished (default: none)",
           dest="diagnosis_limit"),
    option("--check", str, "[MAP=]JSON",
           "check.json of halbach-fe check for this map, whose model-free floor is shown beside "
           "the results; for each map that the study lists, with its name", action="append"),
    option("--effects", effects_of, "NAME,NAME...",
           "candidate effects (default: all effects of the catalogue)"))
def diagnose(magnet: hf.Magnet, arguments: argparse.Namespace) -> object:
    """Find which effects a study lacks to explain measured field maps, and add them to the study.

    If the study lists maps, all of them are diagnosed together: an effect of the magnet must
    explain all maps, and one of an instrument is named with its map, or with the probe that maps
    share.

    Writes diagnosis.html and its figures, diagnosis.json, and study.diagnosed.toml: the study's own
    file with the identified effects added, which `halbach-fe solve` and `halbach-fe infer` can use
    without further changes; and blocks.csv, the table of --blocks as it fits that study, if its
    rings are others.
    """
    from halbach_fe.diagnosis.discriminating_measurements import separations
    from halbach_fe.report.diagnosis_page import page

    study = magnet.study
    data = common.read_measurements(arguments, study)
    blocks, validation_map = common.blocks_and_held_out(arguments, study)
    floor = floors_of(arguments.check, data)
    if arguments.dry_run:
        from halbach_fe.diagnosis.cost_estimate import estimate_diagnosis

        return print_cost(estimate_diagnosis(study, data, blocks, arguments.effects,
                                             validation_map, common.jobs(arguments)),
                          arguments.json)
    # no process may take longer than GetDP's own limit, unless the whole diagnosis may
    arguments.time_limit = max(GETDP_LIMIT_S, arguments.diagnosis_limit or 0.0)
    with common.session(arguments, study, told=False) as session:
        diagnosis = hf.diagnose(magnet, data, session, blocks, arguments.effects, validation_map,
                                common.say, floor, arguments.diagnosis_limit)
        separating = separations(diagnosis, data, session, arguments.effects)
    return page(diagnosis, separating, study, blocks)


def floors_of(
    given: Sequence[str] | None, data: xr.Dataset | dict[str, xr.Dataset]
) -> Floor | None:
    """Return the model-free floor of the map, or of each map that a study lists, by name.

    Raises
    ------
    MeasurementError
        If a file is not one of `halbach-fe check` or belongs to another map, or the names of the
        maps are not those of the study.
    """
    if not given:
        return None
    if not isinstance(data, dict) and len(given) == 1:
        return floor_of(InputFile(given[0]), data)
    maps = data if isinstance(data, dict) else {}
    pairs = [text.partition("=") for text in given]
    wrong = [text for text, (name, sign, _) in zip(given, pairs, strict=True)
             if not sign or name not in maps]
    if wrong or len({name for name, *_ in pairs}) < len(pairs):
        raise MeasurementError(must_be(
            "--check", "the command line", "given once for each map, as NAME=JSON" if maps
            else "given once, since there is one map", " ".join(wrong or given),
            f"The study's maps are {', '.join(maps)}." if maps else ""))
    return {name: floor_of(InputFile(path), maps[name]) for name, _, path in pairs}


def floor_of(path: Path, data: xr.Dataset) -> dict[str, float]:
    """Return the model-free floor in T by component from the check.json of a map.

    Raises
    ------
    MeasurementError
        If the file is not one of `halbach-fe check`, or belongs to another map.
    """
    from halbach_fe.measurement.field_map import readings_sha256

    try:
        found = json.loads(path.read_text("utf-8"))
        floor = [0.0 if value is None else float(value) for value in found["floor_T"]]
        maps = set(found["maps_sha256"].values())
    except OSError as error:
        raise MeasurementError(must_be("file --check", str(path), "a readable file",
                                       f"'{error.strerror}'", "Check the path.")) from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        floor, maps = [], set[str]()
    if len(floor) != len(AXES) or not all(0 <= value < math.inf for value in floor):
        raise MeasurementError(must_be(
            "file --check", str(path), "a check.json that `halbach-fe check` wrote",
            "a file without a floor of three components and the hashes of its maps"))
    if readings_sha256(data) not in maps:
        raise MeasurementError(must_be(
            "file --check", str(path), "that of the map that is diagnosed", "that of another map",
            "Run `halbach-fe check` with this map."))
    return {f"B{name}": value for name, value, own in zip(
        AXES, floor, found["floor_T"], strict=True) if own is not None}


def print_cost(estimate: DiagnosisEstimate, as_json: bool) -> int:
    """Print what a diagnosis would solve; return 0."""
    if as_json:
        common.print_json(estimate.as_dict())
        return 0
    from halbach_fe.core.progress import duration
    from halbach_fe.report.words import counted
    from halbach_fe.response.resource_estimate import TIME_FACTOR

    common.print_estimate(estimate.update, as_json=False)
    rounds = estimate.as_dict()["rounds"]
    times = " to ".join(map(duration, (estimate.shortest_s, estimate.longest_s)))
    common.say(f"That is one round; a diagnosis that finds something takes {rounds[0]} to "
               f"{rounds[1]}. The first one compares "
               f"{counted(estimate.signatures, 'hypothesis', 'hypotheses')}, for which it solves "
               f"{counted(estimate.fields, 'more field')} of whole magnets. In all {times}, within "
               f"a factor of about {TIME_FACTOR:g}.")
    return 0


@dataclass
class _Explanation:
    """The commands that were run, and the study and map with which the next one goes on."""

    arguments: argparse.Namespace
    study: Path
    map: Path
    folders: list[Path] = field(default_factory=list)

    def run(self, verb: str, folder: str, *names: Path) -> Answer:
        """Run a command into a folder, with the options of this one that it has, and return what
        its page says.
        """
        from halbach_fe.report.answer import PAGE_RECORD, PageRecord

        output = self.arguments.output / folder
        words = [verb, *map(str, names), "-o", str(output)]
        if verb != "check":
            words += ["--measurements", str(self.map)]
        common.say(f"\nhalbach-fe {shlex.join(words)}")
        of_format = {"format", *(each.name for each in fields(DeclaredFormat))}
        own = parser([verb]).parse_args([*words, "--json"])
        for name in vars(own).keys() & vars(self.arguments).keys() - {
                "verb", "study", "map", "output", "json"}:
            if self.map == self.arguments.map or name not in of_format:
                setattr(own, name, getattr(self.arguments, name))
        with contextlib.redirect_stdout(io.StringIO()):
            common.with_folder(VERBS[verb].run, own)
        self.folders.append(output)
        said = PageRecord.model_validate_json((output / PAGE_RECORD).read_bytes()).answer
        assert said is not None  # every command that is run here has an answer
        for sentence in (said.said, said.trust):
            common.say(sentence)
        return said

    def check(self) -> None:
        """Check the map by itself, and go on with the map in the right axes if it is not, or with
        what its answer says to use.
        """
        try:
            found = self.run("check", "check", self.map)
        except MeasurementError as error:
            if not self.map.is_file():
                raise
            common.say(f"The map cannot be checked by itself: {error}")
            return
        oriented = self.arguments.output / "check" / "oriented_map.csv"
        corrected = oriented.with_name("corrected_map.csv")
        if corrected.name in found.command:
            self.map = InputFile(corrected)
        elif oriented.exists():
            self.map = InputFile(oriented)

    def infer(self, folder: str) -> bool:
        """Update the magnet, and tell whether it explains the map."""
        return self.run("infer", folder, self.study).sound

    def register(self) -> bool:
        """Find where the map lies, and tell whether its pose there may be used."""
        from halbach_fe.report.registration_page import STUDY_FILE

        try:
            found = self.run("register", "registered", self.study)
        except (MeasurementError, StudyError) as error:  # of a plane; or diagnose knows why
            common.say(f"The map cannot be registered: {error}")
            return False
        if STUDY_FILE in found.command:
            self.study = InputFile(self.arguments.output / "registered" / STUDY_FILE)
        else:  # nothing follows from it
            self.folders.pop()
        return found.sound

    def diagnose(self) -> bool:
        """Look for what the study lacks, and tell whether it was found and may be used."""
        from halbach_fe.diagnosis.summary import BLOCKS_FILE, STUDY_FILE

        found = self.run("diagnose", "diagnosed", self.study)
        if found.changes_study:
            folder = self.arguments.output / "diagnosed"
            self.study = InputFile(folder / STUDY_FILE)
            if (folder / BLOCKS_FILE).exists():
                self.arguments.blocks = InputFile(folder / BLOCKS_FILE)
        return found.sound and found.changes_study


@verb(
    SOLVED,
    option("map", input_file, "MAP",
           "measured field map (CSV, HDF5, or any that import-map reads)"),
    option("--blocks", input_file, "CSV", "measured moments of the single blocks"),
    HELD_OUT, map_format("MAP and --held-out"))
def explain(arguments: argparse.Namespace) -> int:
    """Explain a field map: whether it is sound, where it lies, of what magnet, and what is missing.

    Runs the commands that lead from a map to the magnet that was measured, each as far as it is
    needed: check (does the map obey Maxwell's equations?), infer (update the magnet), and where the
    update does not explain the map register (where does the map lie?) and diagnose (what does the
    study lack?), with a new update after each. Says every command line, so that any of them can be
    run again by itself. Writes the folders check, inferred, registered, updated, diagnosed and
    explained, as far as there are such, and explanation.html, which joins their pages.
    """
    from halbach_fe.core.result_folder import RECORD
    from halbach_fe.explanation import follow

    if hf.read_study(arguments.study).maps:
        raise StudyError(must_be(
            "`maps`", f"study {arguments.study}", "left out for explain, which takes one map",
            "a list of maps", "Of maps that a study lists, run halbach-fe check, register, infer "
            "and diagnose; they take all of them."))
    if (arguments.output / RECORD).exists():
        raise OutputError(
            f"Folder {arguments.output} holds results of another command. The results of explain "
            "are folders, one for each of its steps: name a folder for these.")
    steps = _Explanation(arguments, arguments.study, arguments.map)
    follow(steps)
    common.say("")
    return VERBS["report"].run(argparse.Namespace(
        folders=steps.folders, output=arguments.output / "explanation.html", json=arguments.json))


@verb(
    option("folders", path, "DIR", "folder of results, of solve, infer, diagnose and so on",
           nargs="+"),
    option("-o --output", path, "PAGE", "page to write (.html), or a folder for report.html",
           required=True),
    JSON)
def report(arguments: argparse.Namespace) -> int:
    """Join the results of one magnet into one page: the answer of every command, with links.

    Reads folders that other commands have written, and says what does not fit together: results of
    an earlier version of the study, of another map, or changed since. Nothing is computed. The page
    needs no network; its links need the folders where they are.
    """
    from halbach_fe.report.joint_report import read_campaign, write_campaign_report

    campaign = read_campaign(arguments.folders, arguments.output)
    page = write_campaign_report(campaign, arguments.output)
    if arguments.json:
        common.print_json(campaign.plain())
        return 0
    common.print_table([{"results": chapter.label, "command": chapter.verb, "answer": answer.said}
                        for chapter, _, answer in campaign.answered], campaign.study.name)
    for sentence in (*campaign.versions, *campaign.doubts):
        common.say(sentence)
    common.say_answer(argparse.Namespace(), campaign.answer, page)
    return 0


def _hidden_effects(parser: argparse.ArgumentParser) -> None:
    """Add --coil-sd and --hide."""
    from halbach_fe.synthetic.hidden_effects import EFFECTS, parse_hidden_effect, signature
    from halbach_fe.synthetic.simulate import COIL_SD

    def effect(text: str) -> RequestedEffect:
        """Parse ``NAME`` or ``NAME=VALUE,...``."""
        try:
            return parse_hidden_effect(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    parser.epilog = "effects to hide:\n" + "\n".join(
        f"  {name}" + (f"={signature(effect)}" if effect.parameters else "")
        for name, effect in EFFECTS.items())
    option("--coil-sd", within(finite_number, 1e-9, 0.3), "F",
           "noise of the measured moment of a block, relative to the moment (default: %(default)g)",
           default=COIL_SD)(parser)
    option("--hide", effect, "NAME[=VALUE,...]", "hide an effect: the simulated magnet has it, the "
           "study does not; its size is random unless VALUE is given; may be repeated",
           action="append", default=[])(parser)


@question(
    STUDY, OUTPUT, SEED, _hidden_effects,
    option("--placed", input_file, "CSV", "assemble the blocks of this seed in the places of this "
           "table: the blocks.sorted.csv that halbach-fe sort made of the blocks.csv of an earlier "
           "simulation with the same seed"),
    option("--hide-random", positive, "K",
           "hide K effects of the field or the instrument that are drawn at random", default=0),
    choice("--component", ("abs",), "make maps of |B| alone, as of an NMR teslameter; the "
           "components of B are those of observation.components in the study"),
    option("--element-size", within(finite_number, 1e-5, 10), "M",
           "size in m of the largest elements of NGSolve (default: a third of the blocks' "
           "thickness, in 2D half of that)"),
    option("--order", within(whole, 1, 10), "N",
           "order of NGSolve's elements (default: 3 in 3D, 5 in 2D)"),
    JSON)
def simulate_measurement(magnet: hf.Magnet, arguments: argparse.Namespace) -> Page:
    """Simulate a measurement campaign of a magnet whose blocks deviate from their nominal values.

    Magnetizations are drawn from the study's prior. magpylib and NGSolve compute the field, never
    halbach-fe's own model. Writes blocks.csv (single blocks in a Helmholtz coil), map.csv,
    held-out.csv (points halfway between those of the map), truth/truth.json, and campaign.html with
    its figures, which do not reveal the truth. The maps name the SHA-256 of truth.json, so that the
    truth cannot be changed afterwards.
    """
    from halbach_fe.measurement.probe_law import check_total_field
    from halbach_fe.report.simulated_campaign_page import page
    from halbach_fe.synthetic.ngsolve_reaction import Elements
    from halbach_fe.synthetic.simulate import simulate_campaign

    study = magnet.study
    if arguments.component == "abs":
        check_total_field(study.instrument)
    # before the simulation, which may take long; a refused study leaves no folder all the same
    common.own_folder(arguments, study.name)
    elements = Elements(arguments.element_size, arguments.order)
    alone = "." if elements == Elements() or arguments.hide or arguments.hide_random else (
        " alone: --element-size and --order of NGSolve make no difference.")
    placed = common.blocks_of(arguments.placed)
    said = arguments.json

    def progress(done: int, total: int) -> None:
        """Say that the computation has begun: what is hidden has been checked by then."""
        nonlocal said
        if not said:
            common.say("Computing the field with magpylib" + (
                alone if magnet.is_vacuum else " and NGSolve, which may take minutes."))
        said = True
        show(done, total)

    with common.progress_bar("magpylib") as show:
        campaign = simulate_campaign(study, arguments.seed, arguments.coil_sd, arguments.hide,
                                     arguments.hide_random, elements, progress, placed,
                                     arguments.component == "abs")
    made = page(campaign)
    return replace(made, summary={**made.summary, "files": [
        str(arguments.output / name) for name in made.files]})
