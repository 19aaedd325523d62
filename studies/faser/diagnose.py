"""The first FASER dipole: what the published profile is a profile of, and what is left.

The profile is published by index, as the field on the magnet's axis. Several answers are compared
on readings that were held out: the axis or a line beside it, with the step of the readings, the
length of the magnet or its inner radius open. The best one is registered in all of its poses,
updated and diagnosed::

    python studies/faser/diagnose.py -o results/faser-diagnosis

With ``--quick`` the axis and a line beside it are compared, with the length open: that is
`make demo`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from averages import READINGS, Fitted, fit
from matplotlib.figure import Figure
from published import PublishedErrors
from published import page as page_beside_the_paper
from run import HERE, Z_STEP_M, profile_to_map

from halbach_fe.cli import common
from halbach_fe.core.arrays import Floats
from halbach_fe.core.files import write_text
from halbach_fe.diagnosis.diagnose import diagnose
from halbach_fe.diagnosis.discriminating_measurements import separations
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.infer import infer
from halbach_fe.inference.pose_result import OpenKey, PosePrior, Registration
from halbach_fe.inference.registration import EQUAL_LOG_EVIDENCE, odds, register
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.field_map import read_map
from halbach_fe.report import diagnosis_page, registration_page
from halbach_fe.report.answer import Answer as PageAnswer
from halbach_fe.report.page import (
    MEASURED,
    POSTERIOR,
    PRIOR,
    PUBLISHED,
    SECOND,
    Items,
    Page,
    Section,
    Table,
    Text,
    write_files,
)
from halbach_fe.report.point_maps import draw_cross_section
from halbach_fe.report.registration_page import place_table, pose_table
from halbach_fe.solver.session import Session
from halbach_fe.study.reader import read_study

STUDY = HERE / "profile.toml"
TURN_RAD = 0.02
"""Prior standard deviation of the mapper's turns: 16 mm at the end of the profile."""
ON_THE_AXIS, ANYWHERE = PosePrior(0.001, TURN_RAD), PosePrior(None, TURN_RAD)
"""What is published, within 1 mm, and what is not."""
STEP = OpenKey("instrument.z_scale", 0.05)
LENGTH = OpenKey("array.ring_length_m", 0.004)
RADIUS = OpenKey("array.inner_radius_m", 0.004)
MAPPER_RADIUS_M, MAPPER_RADIUS_SD_M = 0.075, 0.001
"""Radius of the circles on which the magnet was mapped, as published, and how exact it may be."""
FRINGE = (35, 121)
"""Last and first index of the fringe field, as published."""


@dataclass(frozen=True)
class Hypothesis:
    """What the profile may be a profile of."""

    name: str
    open_keys: tuple[OpenKey, ...]
    pose: PosePrior


CERTAIN = 6
"""Power of ten of the largest odds that are stated. Beyond it they are the noise model's: nobody
knows its tails so far out.
"""

TERMINAL_COLUMNS = ("a profile of", "odds", "fringe", "homogeneous")
"""Columns of the table of hypotheses that fit a terminal of 80 characters."""
ANSWER = 2
"""Number of sentences, of where the profile lies and what that explains, above that table."""

SHOWN_SHARE = 1e-3
"""Probability down to which it is shown in per cent."""

ALL = (STEP, LENGTH, RADIUS)
ALL_HYPOTHESES = (
    Hypothesis("the axis; all as assumed", (), ON_THE_AXIS),
    Hypothesis("the axis; length fitted", (LENGTH,), ON_THE_AXIS),
    Hypothesis("the axis; step fitted", (STEP,), ON_THE_AXIS),
    Hypothesis("the axis; step, length, radius open", ALL, ON_THE_AXIS),
    Hypothesis("a line beside the axis; all as assumed", (), ANYWHERE),
    Hypothesis("a line beside the axis; step fitted", (STEP,), ANYWHERE),
    Hypothesis("a line beside the axis; length fitted", (LENGTH,), ANYWHERE),
    Hypothesis("a line beside the axis; step, length, radius open", ALL, ANYWHERE))
QUICK_HYPOTHESES = tuple(each for each in ALL_HYPOTHESES if each.open_keys == (LENGTH,))


@dataclass(frozen=True)
class Answer:
    """A hypothesis, its best pose, and the errors of what it predicts.

    Attributes
    ----------
    error : ndarray, shape (n,)
        Relative error of B_x by the updated magnet at every reading.
    """

    hypothesis: Hypothesis
    registration: Registration
    update: InferenceResult
    error: Floats

    def medians(self) -> tuple[float, float]:
        """Return the median errors in the fringe and in the homogeneous field, held out."""
        return medians(self.error, self.update)


def medians(error: Floats, update: InferenceResult) -> tuple[float, float]:
    """Return the medians of errors (n,) over held-out readings: fringe, homogeneous field."""
    index = np.arange(1, len(error) + 1)
    fringe = (index <= FRINGE[0]) | (index >= FRINGE[1])
    apart = update.held_out
    return float(np.median(error[fringe & apart])), float(np.median(error[~fringe & apart]))


def answers_of(hypotheses: Sequence[Hypothesis], pose: PosePrior, data: xr.Dataset,
               session: Session) -> list[Answer]:
    """Register the profile by all hypotheses about a place, in one of its equal poses each."""
    own = [each for each in hypotheses if each.pose is pose]
    found = register(
        build_magnet(read_study(STUDY)), data, session, open_keys=own[0].open_keys,
        alternatives=[each.open_keys for each in own[1:]], pose=pose, most=1, say=common.say)
    by_keys = {frozenset(each.open_keys): each for each in reversed(found)}  # the best of each
    answers = []
    for each in own:
        registration = by_keys[frozenset(key.key for key in each.open_keys)]
        answers.append(answer_of(each, registration, data, session))
    return answers


def answer_of(hypothesis: Hypothesis, registration: Registration, data: xr.Dataset,
              session: Session) -> Answer:
    """Update the registered magnet with the profile."""
    update = infer(build_magnet(registration.study), data, session)
    left = update.prediction_posterior.mean - update.readings  # offset and all
    return Answer(hypothesis, registration, update, np.abs(left) / data["B_T"].values[:, 0])


def hypothesis_table(answers: list[Answer], published: PublishedErrors) -> list[dict[str, str]]:
    """Return rows of text, the paper's first, then the most probable answer."""
    update = answers[0].update
    paper = medians(published.posterior, update)
    rows = [{"a profile of": "the axis, as in the paper", "odds": "", "fringe": f"{paper[0]:.3f}",
             "homogeneous": f"{paper[1]:.1e}", "chi²/reading": "", "x, y in mm": "0, 0",
             "step in mm": "", "length in mm": "", "inner radius in mm": ""}]
    for each, probability in zip(answers, odds([one.registration for one in answers]), strict=True):
        found, study = each.registration, each.registration.study
        x, y = (f"{abs(1e3 * value):.1f} ± {1e3 * sd:.1f}" for value, sd in zip(
            found.middle_m[:2], found.translation_sd_m[:2], strict=True))
        fringe, homogeneous = each.medians()
        rows.append({
            "a profile of": each.hypothesis.name,
            "odds": f"{100 * probability:.3g} %" if probability > SHOWN_SHARE else _power((
                found.log_evidence - max(one.registration.log_evidence for one in answers))
                / np.log(10)),
            "fringe": f"{fringe:.3f}", "homogeneous": f"{homogeneous:.1e}",
            "chi²/reading": f"{found.chi2:.3g}",
            "x, y in mm": f"{x}, {y}" if each.hypothesis.pose is ANYWHERE else "0, 0",
            "step in mm": _fitted(found, STEP, 1e3 * Z_STEP_M, 1e3 * Z_STEP_M),
            "length in mm": _fitted(found, LENGTH, 0.0, 1e3 * study.array.rings,
                                    study.array.ring_length_m),
            "inner radius in mm": _fitted(found, RADIUS, 0.0, 1e3, study.array.inner_radius_m)})
    return rows


def _fitted(found: Registration, key: OpenKey, base: float, unit: float,
            given: float | None = 0.0) -> str:
    """Return a number with its standard deviation, or without one if it was not open."""
    if key.key not in found.open_keys:
        return f"{base + unit * (given or 0.0):.4g}"
    value, sd = found.open_keys[key.key]
    return f"{base + unit * value:.2f} ± {unit * sd:.2f}"


def columns_of(best: Answer, data: xr.Dataset) -> list[Fitted]:
    """Fit what the column may hold, at the published radius and with the step open."""
    magnet = build_magnet(read_study(STUDY))
    noise = magnet.study.noise
    assert noise is not None
    assert noise.position_sd_m is not None
    return [fit(magnet, reading, data["z_m"].values, data["B_T"].values[:, 0],
                ~best.update.held_out, MAPPER_RADIUS_SD_M, noise.regions[0].sigma_T,
                noise.position_sd_m[0]) for reading in READINGS]


def column_table(fitted: list[Fitted], update: InferenceResult) -> list[dict[str, str]]:
    """Return rows of text, one per kind of reading."""
    rows, most = [], max((each.log_evidence for each in fitted), default=0.0)
    for each in fitted:
        fringe, homogeneous = medians(each.error, update)
        turn = f"{np.degrees(each.parameters[3]):.0f} ± {np.degrees(each.sd[3]):.0f}"
        rows.append({
            "the column holds": each.reading.name,
            "probability": _power((each.log_evidence - most) / np.log(10)),
            "fringe": f"{fringe:.3f}", "homogeneous": f"{homogeneous:.1e}",
            "radius in mm": f"{1e3 * each.parameters[2]:.1f} ± {1e3 * each.sd[2]:.1f}",
            "angle in degrees": turn if each.reading.has_angle else "all"})
    return rows


def _power(exponent: float) -> str:
    """Return a probability relative to the largest: small ones are not stated, see `CERTAIN`."""
    if exponent < -CERTAIN:
        return f"< 10^-{CERTAIN}"
    return "1" if exponent == 0 else f"10^{exponent:.0f}"


def _times(exponent: float) -> str:
    """Return a ratio of probabilities in words."""
    return "more than a million" if exponent > CERTAIN else f"{10**exponent:.2g}"


def sentences(best: Answer, answers: list[Answer], fitted: list[Fitted],
              published: PublishedErrors) -> list[str]:
    """Return what was found, the answer first."""
    found = best.registration
    x, y = np.abs(1e3 * found.middle_m[:2])
    radius, radius_sd = distance_mm(found)
    angle = float(np.degrees(np.arctan2(y, x)))
    paper, here = medians(published.posterior, best.update), best.medians()
    axis = max((each for each in answers if each.hypothesis.pose is ON_THE_AXIS),
               key=lambda each: each.registration.log_evidence)
    log_odds = (best.registration.log_evidence - axis.registration.log_evidence) / np.log(10)
    said = [
        "The published profile is that of the axis, as it says."
        if best is axis else
        f"The published profile is not that of the axis. It is the profile of B_x on a line "
        f"beside the axis, {radius:.1f} ± {radius_sd:.1f} mm from it and about {angle:.0f}° from "
        f"the direction of the field; the mapper's circles have a radius of "
        f"{1e3 * MAPPER_RADIUS_M:.0f} mm.",
        f"So read, the median relative error of held-out readings in the fringe field falls from "
        f"{paper[0]:.2f} in the paper to {here[0]:.3f}, and in the homogeneous field from "
        f"{paper[1]:.1e} to {here[1]:.1e}.",
        f"The best answer on the axis, {axis.hypothesis.name.partition('; ')[2]}, is less probable "
        f"by a factor of {_times(log_odds)}, and leaves {axis.medians()[0]:.3f} in the fringe, "
        f"with blocks bent to chi² of {axis.registration.chi2:.2g} per reading.",
    ]
    line = fitted[0] if fitted else None
    others = [f"{each.reading.name} by a factor of "
              f"{_times((line.log_evidence - each.log_evidence) / np.log(10))}"
              for each in fitted[1:] if line]
    if line:
        said.append(
            f"At the published radius of the circles, {line.reading.name} at "
            f"{np.degrees(line.parameters[3]):.0f} ± {np.degrees(line.sd[3]):.0f}° is more "
            f"probable than {', '.join(others)}.")
    said.append(
        "B_x of a dipole is even in x, y and z: lines in other quadrants or in the other direction "
        "explain the profile equally well, and one component on one line cannot tell them apart.")
    said += _step_or_length(answers)
    return said


def answer_page(answers: list[Answer], found: list[str], published: PublishedErrors,
                quick: bool) -> PageAnswer:
    """Return the answer of the page; ``found`` is what `sentences` says of the answers."""
    best = answers[0]
    asked, said = "What does the published profile of the FASER dipole show?", found[0]
    step = ("For a map of your own: `halbach-fe new study.toml` writes a file in which to describe "
            "its magnet, then:" if quick else "Read what is left, and the further pages below.")
    own = "halbach-fe explain study.toml map.csv -o results"  # no STUDY, which is this one
    if best.hypothesis.pose is ON_THE_AXIS:
        return PageAnswer(asked, said, " ".join(found[1:]), step)
    array = best.registration.study.array
    assert array.ring_length_m is not None
    radius, radius_sd = distance_mm(best.registration)
    paper, here = medians(published.posterior, best.update)[0], best.medians()[0]
    axis = min(each.medians()[0] for each in answers if each.hypothesis.pose is ON_THE_AXIS)
    left = best.registration.held_out_chi2
    sound = best.registration.explains
    trust = [
        f"{'Yes' if sound else 'No'}: with positions uncertain by 1 mm, chi² of held-out readings "
        f"is {left:.2g} each, where 1 is expected; but which of four lines, equal by symmetry, "
        "it is, the profile cannot tell.",
        *found[1:]]
    if not best.registration.at_rest:
        trust.append("The search for the line ended before it came to rest, so that the line may "
                     "lie farther from the place given here than the error bars say.")
    return PageAnswer(
        asked, said, " ".join(trust), step, own if quick else "",
        sound=sound,
        gist=f"It is the profile of a line {radius:.0f} ± {radius_sd:.0f} mm beside the axis, "
        f"in a magnet {array.rings * array.ring_length_m:.3g} m long.",
        numbers=((f"median error in the fringe, of the paper and here (on the axis: "
                  f"{100 * axis:.2g} %)",
                  f"{100 * paper:.0f} % → {100 * here:.1g} %"),))


def distance_mm(found: Registration) -> tuple[float, float]:
    """Return the distance of a line along z from the axis in mm, and its error bar."""
    x, y = np.abs(1e3 * found.middle_m[:2])
    sd = 1e3 * found.translation_sd_m
    radius = float(np.hypot(x, y))
    return radius, float(np.hypot(x * sd[0], y * sd[1]) / radius)


def _step_or_length(answers: list[Answer]) -> list[str]:
    """Return a sentence on the answers in which only the step, or only the length, is open."""
    alone = {key.key: each.registration for each in answers for key in (STEP, LENGTH)
             if each.hypothesis.open_keys == (key,) and each.hypothesis.pose is ANYWHERE}
    if len(alone) < 2:
        return []
    by_step, by_length = alone[STEP.key], alone[LENGTH.key]
    step = Z_STEP_M * (1 + by_step.open_keys[STEP.key][0])
    array = by_length.study.array
    assert array.ring_length_m is not None
    apart = (by_step.log_evidence - by_length.log_evidence) / np.log(10)
    return [f"The edges of the field fix the ratio of the magnet's length to the step. If only one "
            f"of them is not as assumed, either a step is {1e3 * step:.2f} mm, or the magnet is "
            f"{1e3 * array.rings * array.ring_length_m:.0f} mm long; by the stated noise and "
            f"errors of blocks the {'step' if apart > 0 else 'length'} is the likelier by a "
            f"factor of {_times(abs(apart))}."]


def profile_figure(answers: list[Answer], published: PublishedErrors) -> Figure:
    """Draw the readings, and the relative errors of the paper and of two answers."""
    best = answers[0]
    axis = next(each for each in answers if each.hypothesis.pose is ON_THE_AXIS)
    index = np.arange(1, len(best.error) + 1)
    figure = Figure(figsize=(8, 6.4), layout="constrained")
    field, error = figure.subplots(2, 1, sharex=True)
    for each, colour in ((axis, PRIOR), (best, POSTERIOR)):
        nominal = each.update.prediction_prior.mean
        scale = np.median(each.update.readings[60:100] / nominal[60:100])
        field.semilogy(index, 1e3 * scale * nominal, color=colour, label=(
            f"ordered blocks: {each.hypothesis.name}"))
        error.semilogy(index, each.error, color=colour, lw=0.8)
        apart = each.update.held_out
        error.semilogy(index[apart], each.error[apart], ".", color=colour,
                       label=f"fitted blocks: {each.hypothesis.name}; dots were held out")
    field.semilogy(index, 1e3 * best.update.readings, ".", ms=4, color=MEASURED, label="readings")
    error.semilogy(index, published.posterior, color=PUBLISHED,
                   label="the magnet that the paper fitted")
    for axes in (field, error):
        axes.axvspan(1, FRINGE[0], color="0.93")
        axes.axvspan(FRINGE[1], len(index), color="0.93")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    field.set_ylabel("B_x in mT")
    error.set(ylabel="relative error of B_x", xlabel="index of the reading", ylim=(1e-6, 2))
    return figure


def place_figure(poses: list[Registration]) -> Figure:
    """Draw the lines that explain the profile in the cross-section of the magnet."""
    figure = Figure(figsize=(5.5, 5.5), layout="constrained")
    axes = figure.subplots()
    draw_cross_section(axes, build_magnet(poses[0].study))
    turn = np.linspace(0, 2 * np.pi, 181)
    radius = 1e3 * MAPPER_RADIUS_M
    axes.plot(radius * np.cos(turn), radius * np.sin(turn), ":", color=SECOND,
              label=f"circle of the mapper, {radius:.0f} mm")
    for number, each in enumerate(poses):
        (x, y), (dx, dy) = 1e3 * each.middle_m[:2], 1e3 * each.translation_sd_m[:2]
        axes.errorbar(x, y, dy, dx, fmt=".", color=POSTERIOR, capsize=2,
                      label="line of the profile, ± 1 sd" if number == 0 else None)
    axes.set(aspect="equal", xlabel="x in mm", ylabel="y in mm")
    axes.legend(fontsize=8, loc="upper right")
    return figure


def run(arguments: argparse.Namespace) -> int:
    """Compare the answers, register, update and diagnose by the best, write the page."""
    folder = arguments.output
    measured = folder / "measured.csv"
    published = profile_to_map(HERE / "fig4_faser_on_axis.csv", measured, Z_STEP_M)
    data = read_map(measured)
    with common.session(arguments) as session:
        hypotheses = QUICK_HYPOTHESES if arguments.quick else ALL_HYPOTHESES
        answers = [each for pose in (ANYWHERE, ON_THE_AXIS)
                   for each in answers_of(hypotheses, pose, data, session)]
        answers.sort(key=lambda each: -each.registration.log_evidence)
        best = answers[0]
        poses = [best.registration] if arguments.quick else register(
            build_magnet(read_study(STUDY)), data, session, say=common.say,
            open_keys=best.hypothesis.open_keys, pose=best.hypothesis.pose)
        if best.registration.log_evidence > poses[0].log_evidence + EQUAL_LOG_EVIDENCE:
            poses.insert(0, best.registration)
        else:  # of equal poses, all pages show the same one
            best = answers[0] = answer_of(best.hypothesis, poses[0], data, session)
        fitted = []
        if not arguments.quick:
            common.say("comparing what the column may hold")
            fitted = columns_of(best, data)
        found, rows = (sentences(best, answers, fitted, published),
                       hypothesis_table(answers, published))
        for sentence in found[:ANSWER]:
            common.say(sentence)
        common.print_table([{name: row[name] for name in TERMINAL_COLUMNS} for row in rows],
                           "Median relative error of B_x at held-out readings")
        for name, page in (("registration", registration_page.page(read_study(STUDY), data, poses)),
                           ("inferred", page_beside_the_paper(best.update, published, ()))):
            command = page.answer.command.replace("DIR/", f"DIR/{name}/").replace(
                " MAP", f" DIR/{measured.name}")
            if name == "inferred":  # the posterior is that of the registered study
                command = command.replace(" STUDY", " DIR/registration/study.registered.toml")
            write_files(replace(page, answer=replace(page.answer, command=command)),
                        folder / name, STUDY)
        left = [f"The best answer ({best.hypothesis.name}) leaves chi² of "
                f"{best.registration.chi2:.2g} per reading that was fitted and "
                f"{best.registration.held_out_chi2:.2g} per reading that was held out, if a "
                "position is uncertain by 1 mm."]
        further = ["[Poses and probe](registration/registration.html)",
                   "[The updated magnet](inferred/report.html)"]
        if not arguments.quick:
            left += diagnosed(best, data, session, folder / "diagnosis")
            further.append("[What the registered model lacks](diagnosis/diagnosis.html)")
        else:
            left.append("make study-faser-diagnosis compares more answers and all poses.")
    write_summary(answers, poses, folder / "profile.json")
    columns = column_table(fitted, best.update)
    write_files(Page(
        "register", "What its published profile shows", read_study(STUDY),
        answer_page(answers, found, published, arguments.quick), {}, [
            Section([Text(
                "Every fifth reading (index 5, 10, ..., 155) was set aside before anything was "
                "fitted. Errors are medians of |predicted / measured - 1| of B_x over these, as "
                "the paper defines them: in its fringe field (index 1-35 and 121-156) and in its "
                "homogeneous field. Odds are by the evidence of the readings that were fitted, "
                "with all blocks integrated out.", "small"),
                Table(rows, "turned" if arguments.quick else "")], "What was compared"),
            Section([Table(columns)] if columns else [], "What the column may hold"),
            Section([] if arguments.quick else [
                Table(pose_table(poses)), Table(place_table(poses), "numbers")],
                "Poses that explain the readings equally well"),
            Section([Items(left)], "What is left"),
            Section([Items(further)], "Further pages")],
        figures={
            "profile.png": (
                partial(profile_figure, answers, published), "The readings with the magnet "
                "as ordered, scaled to the middle, and the relative errors of B_x. The profile is "
                "published by the index of its readings, and the shaded parts are its fringe"),
            "places.png": (partial(place_figure, poses),
                           "Where the profile lies in the cross-section")},
        files=dict.fromkeys(("profile.json", "measured.csv")), stored=False, stem="profile"),
        folder)
    for sentence in found[ANSWER:] + left:
        common.say(sentence)
    common.say(f"Report: {folder / 'profile.html'}")
    return 0


def diagnosed(
    best: Answer, data: xr.Dataset, session: Session, folder: Path
) -> list[str]:
    """Diagnose the registered study, write its page, return what it says first."""
    study = best.registration.study
    found = diagnose(study, data, session, say=common.say)
    page = diagnosis_page.page(found, separations(found, data, session), study)
    write_files(page, folder, STUDY)
    common.say(page.answer.said)
    return [page.answer.said, page.answer.trust]


def write_summary(answers: list[Answer], poses: list[Registration], path: Path) -> None:
    """Write the answers and poses as plain data."""
    probability = odds([each.registration for each in answers])
    write_text(path, json.dumps({
        "hypotheses": [{
            "name": each.hypothesis.name, "odds": float(one),
            "log_evidence": each.registration.log_evidence,
            "fringe_median_error": each.medians()[0],
            "homogeneous_median_error": each.medians()[1],
            "chi2": each.registration.chi2, "held_out_chi2": each.registration.held_out_chi2,
            "middle_m": each.registration.middle_m.tolist(),
            "translation_sd_m": each.registration.translation_sd_m.tolist(),
            "open_keys": {key: list(value) for key, value in each.registration.open_keys.items()},
        } for each, one in zip(answers, probability, strict=True)],
        "poses": [{"odds": float(one), "middle_m": each.middle_m.tolist(),
                   "undetermined": list(each.undetermined)}
                  for each, one in zip(poses, odds(poses), strict=True)],
    }, indent=1, allow_nan=False) + "\n")


def options(parser: argparse.ArgumentParser) -> None:
    """Add this study's own options."""
    parser.add_argument("--quick", action="store_true",
                        help="compare two of the answers, without further poses and a diagnosis")


if __name__ == "__main__":
    sys.exit(common.run_study(__doc__ or "", STUDY, "faser-diagnosis", run, options))
