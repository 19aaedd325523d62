"""The answer of an inference in a few sentences, for its page and the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.core.arrays import Bools, Floats, Ints, rms
from halbach_fe.inference.registration import moved_by_turns
from halbach_fe.inference.result import HELD_OUT, HELD_OUT_MAP, InferenceResult, far_in_words
from halbach_fe.report.answer import STATE_NOISE, Answer, along_the_axis
from halbach_fe.report.multipoles_page import MultipoleTable, main_field_in_words
from halbach_fe.report.words import (
    decimals,
    faults_in_words,
    flux_density,
    fraction,
    place_of,
    with_error,
    with_unit,
)
from halbach_fe.solver.routes import finer_in_words
from halbach_fe.study.types import COMPONENTS

LOOK = ("Look for what the study lacks. (Before that, halbach-fe check tests the map by itself, "
        "and register finds where it lies.)", "halbach-fe diagnose STUDY --measurements MAP -o DIR")
"""The next step, and its command, if model and measurement disagree, or a block and its prior."""

AGAIN = ("State in the study how far that may be off, and update again.",
         "halbach-fe infer STUDY --measurements MAP -o DIR")
"""The next step, and its command, if something of all blocks is in doubt."""


OF_THE_TABLE = ("Answer what is asked of the table of blocks, correct it or the study, and update "
                "again.", "halbach-fe infer STUDY --measurements MAP --blocks BLOCKS -o DIR")
"""The next step, and its command, if the table of blocks may not be of this magnet."""


AS_FOUND = ("Update again with study.updated.toml, the study with the amplitudes that were found: "
            "an update is linear in them.",
            "halbach-fe infer DIR/study.updated.toml --measurements MAP -o DIR")
"""The next step, and its command, if amplitudes moved farther than the update is linear in them."""


def answer(result: InferenceResult, tables: Sequence[MultipoleTable] = ()) -> Answer:
    """Say what field the updated magnet has, how well it predicts, and what to do next.

    The field is the main one of ``tables``, the multipoles of the study's circles.
    """
    said = f"{_prediction(result)} {_blocks(result)}"
    numbers = distances(result, result)
    question = "What is the measured magnet like?"
    solver, far = _of_the_solver(result), far_in_words(result.far_amplitudes)
    if result.disagreement:
        wrong = ("Model and measurement agree better than the stated noise allows"
                 if result.disagreement == result.too_near else "Model and measurement disagree")
        return Answer(question, f"{wrong}, so that these numbers and their "
                      f"error bars are not to be used as they stand. {said}",
                      f"No. {result.disagreement}{solver}"
                      f"{' ' * bool(far)}{far}",
                      *_after_a_conflict(result), sound=False, numbers=numbers,
                      gist=f"{wrong}: these numbers are not to be used.")
    tested = "" if result.held_out.any() else (
        " No reading was held out, so that this is no test of the predictions: hold some out by "
        "[inference.held_out] or --held-out.")
    at_rest = ("" if result.terms is None or result.terms.at_rest else
               " The instruments have not come to rest: their error bars may be too small.")
    far = "" if far in result.reservation else far
    single, shared = result.held_back, result.shared_doubts
    verdict = (f"{result.reservation} {'But model' if shared else 'Model'}"
               if result.reservation else "Yes. Model")
    worst = max(result.regions_left_out, key=lambda one: one.over_noise, default=None)
    unseen = "" if worst is None or worst.in_words in verdict else f" {worst.in_words}."
    main = main_field_in_words(tables, result.magnet) or _largest_field(result)
    return Answer(
        question, f"{main} {said}".lstrip(),
        f"{verdict} and readings agree: chi² per reading before the update is "
        f"{decimals(result.prior_conflict)}, where 1 is expected and more than "
        f"{result.conflict_limit:.2g} is rare.{unseen}{tested}{at_rest}"
        f"{_of_the_probe(result)}{_of_the_sign(result)}{solver}"
        f"{' ' * bool(far)}{far}",
        *(LOOK if single or (shared and "update again" not in result.reservation) else
          AGAIN if shared else OF_THE_TABLE if result.table_doubts else
          AS_FOUND if result.study_as_found is not result.study else
          LOOK if result.far_amplitudes else _after_agreement(result)),
        sound=not result.reservation,
        gist=_blocks(result, "The blocks deviate"), numbers=numbers)


def _after_agreement(result: InferenceResult) -> tuple[str, str]:
    """Return the next step, and its command, if model and measurement agree."""
    # the field of a quadrupole is not meant to be the same everywhere
    of_order = result.magnet.dimension == 2 or result.magnet.array.multipole_order > 1
    faults = faults_in_words(result.study)
    mend = "" if not faults else (
        f"This is the magnet with blocks that are not as designed ({faults}): put that right and "
        "measure again, or go on with it as it is. ")
    if result.magnet.cancels_along_z and not result.magnet.study.homogeneity:
        said, command = along_the_axis(result.magnet, "--posterior DIR/posterior.h5 ")
        return mend + said, command
    return (f"{mend}See {'its multipoles' if of_order else 'how homogeneous it is'}; halbach-fe "
            f"{'' if of_order else 'multipoles and '}shim {'says' if of_order else 'say'} more.",
            f"halbach-fe {'multipoles' if of_order else 'homogeneity'} STUDY --posterior "
            "DIR/posterior.h5 -o DIR")


def _of_the_probe(result: InferenceResult) -> str:
    """Say what the error bars take as exact of the probe: its calibration, and stated offsets."""
    study = result.study
    instruments = [(study.instrument, study.instrument_sd), *(
        (one.instrument or study.instrument, one.instrument_sd or study.instrument_sd)
        for one in study.maps)]
    said = ""
    if not any(known.gain for _, known in instruments):
        how = " ([instrument_sd] can say how well it is known)" if study.dimension == 3 else ""
        said = (f" The error bars take the calibration of the probe as exact{how}: if its gain is "
                "0.1\u00a0% off, so is the field of the magnet.")
    offset = max((max(map(abs, each.offset_T)) for each, known in instruments
                  if not known.offset_T), default=0.0)
    if offset:
        said += (f" They take its offset of {flux_density(offset, 2)} as exact, too. If that was "
                 "found from the map itself, a magnet's uniform field may be in it: "
                 "state the standard deviation that it had before, [instrument_sd] offset_T.")
    return said


def _of_the_solver(result: InferenceResult) -> str:
    """Say that the solver's error dominates the error bars, and what lowers it; else nothing."""
    if result.solver_over_noise < 1:
        return ""
    keys = finer_in_words(result.magnet, result.observation.points)
    falls = f"It falls with {keys}." if keys else (
        "No key of the mesh lowers it: the grid of the iron is fixed on this route.")
    return (" The model's own error dominates: the solver is off by up to "
            f"{flux_density(float(result.response.error.max()))}, rms "
            f"{decimals(result.solver_over_noise, 2)} times the noise of the readings, and the "
            f"error bars include it. {falls}")


def _after_a_conflict(result: InferenceResult) -> tuple[str, str]:
    """Return the next step, and its command, if model and measurement disagree."""
    if result.disagreement == result.too_near:
        return STATE_NOISE
    if result.solver_over_noise >= 1:
        return ("First lower the solver's error, as is said above, and update again: as it is, it "
                "hides what the study may lack. This command shows how it falls.",
                "halbach-fe verify STUDY -o DIR")
    return AS_FOUND if result.study_as_found is not result.study else LOOK


def _of_the_sign(result: InferenceResult) -> str:
    """Say that |B| does not tell the sign of the field, if it is all that was read."""
    return "" if not result.observation.of_total_field.all() else (
        " All readings are |B|, which is the same if the field is reversed everywhere: the sign is "
        "that of the study.")


def _largest_field(result: InferenceResult) -> str:
    """Say how strong the updated field is where it is strongest; empty if no reading has one."""
    # Angle in rad up to which the direction of a sensor counts as an axis: of 1 T across it shows 1
    # µT.
    along_an_axis = 1e-6
    field = result.field
    most = field.strongest
    if most is None:
        return ""
    place, along = 1e3 * field.places[most], field.along[most]
    main = int(np.argmax(np.abs(along)))
    component = f"B{COMPONENTS[main]}" if np.linalg.norm(np.delete(along, main)) < along_an_axis \
        else f"B along ({_numbers(along, '.4f')})"
    moved = np.abs(place - 1e3 * result.observation.positions[most]).max() > 1e-3
    sd = 1e3 * _sd_of_place(result, most)
    numbers = (", ".join(map(with_error, (place.round(9) + 0.0).tolist(), sd.tolist())) if sd.any()
               else _numbers(place.round(3), ".5g"))
    where = f"({numbers}) mm{' of the magnet' if moved or sd.any() else ''}"
    what = ("The strongest component of the updated field at the map's positions, "
            f"{component} at {where}, is ")
    if result.observation.of_total_field[most]:
        what = ("The updated field is strongest, of the map's positions, where |B| at "
                f"{where} is ")
    return (f"{what}"
            f"{with_error(1e3 * abs(field.mean[most]), 1e3 * field.sd[most])} mT.")


def _sd_of_place(result: InferenceResult, number: int) -> Floats:
    """Return the standard deviations (3,) in m of where a reading lies in the magnet, along its
    axes: of a map whose pose was found. Shift and turns are taken as independent.
    """
    pose = next((one for one in (result.terms.poses if result.terms else ())
                 if one.name == result.maps[number]), None)
    if pose is None:
        return np.zeros(3)
    return np.hypot(pose.middle_sd_m, moved_by_turns(
        result.field.places[number] - pose.middle_m, np.array(pose.turn_sd_rad)))


def _numbers(values: Floats, form: str) -> str:
    """Return numbers in a row, none of them -0."""
    return ", ".join(f"{value:{form}}" for value in values.round(9) + 0.0)


def _prediction(result: InferenceResult) -> str:
    """Say how far the predictions are from readings, if possible from ones that it has not seen."""
    part, chosen = _tested(result)
    before, after = (rms((result.readings - each.mean)[chosen])
                     for each in (result.prediction_prior, result.prediction_posterior))
    if part is None:
        return (f"The updated magnet differs from the readings by {_field(after)} rms, "
                f"before the update {_before(result)} differed by {_field(before)}.")
    bands = [(score.readings, score.coverage95_posterior) for score in result.scores
             if score.part == part and score.coverage95_posterior is not None]
    held = sum(count * share for count, share in bands) / sum(count for count, _ in bands)
    of = ("readings of the held-out map" if part == HELD_OUT_MAP
          else "readings that were held out")
    return (f"The updated magnet predicts {chosen.sum()} {of} to "
            f"{_field(after)} rms, where its error bars and the noise allow "
            f"{_field(_expected(result))}; before the update, {_before(result)} was "
            f"{_field(before)} off. "
            f"The 95 % band holds {fraction(held)} of them.")


def _tested(result: InferenceResult) -> tuple[str | None, Bools]:
    """Return the part of the readings that the update has not seen, and a mask (readings,) of it;
    None and all readings if it has seen all.
    """
    parts = np.array(result.parts)
    part = next((name for name in (HELD_OUT_MAP, HELD_OUT) if (parts == name).any()), None)
    return part, parts == part if part else np.ones(len(parts), bool)


def _expected(result: InferenceResult) -> float:
    """Return the rms difference in T that error bars and noise allow."""
    _, chosen = _tested(result)
    return rms(np.hypot(result.prediction_posterior.sd, result.errors.sd)[chosen])


def distances(first: InferenceResult, last: InferenceResult) -> tuple[tuple[str, str], ...]:
    """Return how far the model is off before the first of two updates, and after the last one."""
    off = [rms((result.readings - prediction.mean)[_tested(result)[1]]) for result, prediction in (
        (first, first.prediction_prior), (last, last.prediction_posterior))]
    return (("off before", _field(off[0])), ("after", _field(off[1])),
            ("noise and error bars", _field(_expected(last))))


def _before(result: InferenceResult) -> str:
    """Say which magnet the update starts from."""
    return ("the nominal magnet" if result.measured_blocks is None
            else "the magnet of the measured blocks")


def easy_axes(result: InferenceResult) -> tuple[Ints, Floats, Floats]:
    """Return the numbers (n,) of the blocks that are not missing, the unit vectors (n, D) of their
    nominal magnetizations, and the sizes (n,) of these in A/m.
    """
    nominal = result.by_block(result.response.nominal)
    size = np.linalg.norm(nominal, axis=1)
    there = np.flatnonzero(size)
    return there, nominal[there] / size[there, None], size[there]


def along_easy_axes(result: InferenceResult) -> Floats:
    """Return the changes (blocks,) from nominal along the easy axes, relative to the nominal
    magnetizations; NaN for missing blocks.
    """
    there, axes, size = easy_axes(result)
    found = np.full(len(result.magnet.blocks), np.nan)
    found[there] = np.einsum("ij,ij->i", result.by_block(
        result.posterior.mean - result.response.nominal)[there], axes) / size
    return found


def _blocks(result: InferenceResult, start: str = (
        "Along their easy axes the blocks deviate from the study")) -> str:
    """Say how the magnetizations along the easy axes deviate from the nominal ones."""
    there, axes, size = easy_axes(result)
    mean = along_easy_axes(result)[there]
    worst = int(np.argmax(np.abs(mean)))
    row = np.zeros((1, len(result.posterior.mean)))
    result.by_block(row[0])[there[worst]] = axes[worst] / size[worst]
    sd, block = result.posterior.sd_of(row)[0], result.magnet.blocks[there[worst]]
    start = f"{start} by {fraction(rms(mean))} rms, the most {place_of(block)}"
    if result.disagreement:  # error bars that are not to be used are not stated
        sign = "" if mean[worst] < 0 else "+"
        return (f"{start}, which seems to be missing or reversed." if mean[worst] < -1 else
                f"{start} by {sign}{decimals(100 * mean[worst], 2)}\u00a0%.")
    if mean[worst] < -1:
        return (f"{start}, which is reversed: magnetized the other way round, with "
                f"{with_unit(-(1 + mean[worst]), sd, '%')} of its strength.")
    return (f"{start} by {'+' if mean[worst] > 0 else ''}"
            f"{with_unit(mean[worst], sd, '%')}.")


def _field(size: float) -> str:
    """Return a flux density in T as the table of the page has it."""
    return flux_density(size, zeros=True)
