"""What a diagnosis says first: what the study lacks, how sure that is, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from halbach_fe.diagnosis.effect_selection import DETECTION_LOG_ODDS, MAX_EFFECTS
from halbach_fe.diagnosis.effects import catalogue
from halbach_fe.diagnosis.effects.base import place_of
from halbach_fe.diagnosis.result import (
    Diagnosis,
    IdentifiedEffect,
    Suspicion,
    UnknownCause,
    UnknownPart,
)
from halbach_fe.diagnosis.summary import (
    PRESENT,
    STUDY_FILE,
    amounts,
    hidden_by_solver,
    label_in_words,
    limits_in_words,
    other_findings,
    place_in_words,
    position_in_words,
    region_scores,
    rivals,
)
from halbach_fe.diagnosis.uncertain_effects import is_uncertain
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.geometry.symmetry import symmetry_images
from halbach_fe.inference.result import TRAINING
from halbach_fe.report.answer import Answer
from halbach_fe.report.inference_answer import distances
from halbach_fe.report.words import bayes_factor, counted, decimals, in_a_row
from halbach_fe.solver.routes import Route, choose_route, finer_in_words

COORDINATES = {
    "z": "z", "angle": "the azimuth", "radius": "the radius", "time": "the time",
    "order": "the order of the rows",
    "field": "the magnitude of B", "z and angle": "z and the azimuth"}
"""Coordinates in words."""

HALF_WAVES = {"z": (1e3, "mm"), "radius": (1e3, "mm"), "angle": (1.0, "°"), "field": (1e3, "mT"),
              "time": (100.0, "% of the map's time"), "order": (100.0, "% of the map's rows"),
              "z and angle": (1e3, "mm along z")}
"""Factor and unit of a distance along a coordinate."""

UNKNOWN_ADVICE = {
    "field": "Look for a source outside the bore, near the point at which the unexplained field is "
             "largest. Readings beyond the end of the map at that point would show more of the "
             "field.",
    "instrument": "The same map with the probe turned by 180° shows which sensor is in error: the "
                  "error turns with the sensor.",
    "either": "The same map with the probe turned by 180° tells a field from the sensors: errors "
              "of the sensors turn with the probe."}
"""Advice on the next measurement by the kind of an unknown cause."""

ADVICE_BY_COORDINATE = {
    "time": "The same lines again in another order show whether it goes with the time.",
    "order": "The map states no times: the same lines again in another order show whether it goes "
             "with them.",
    "z": "The same lines in another order and with the probe turned by 180° show whether it goes "
         "with the drive along z, the time or the sensor.",
    "angle": "The same circles begun at another angle show whether it goes with the rotary stage.",
    "radius": "The same circles in another order of the radii show whether it goes with the radius "
              "or the time.",
    "field": "A calibration of the probe against NMR at several fields shows its errors by |B|."}
"""Further advice by the coordinate of an unlisted error of the instrument."""

UNKNOWN_KINDS = {
    "field": "a smooth field from another source",
    "instrument": "something that the instrument does and no field could be",
    "either": "a field, or something that the instrument does"}
"""Description of an unknown cause by its kind."""


def outside(diagnosis: Diagnosis) -> str:
    """Return what an unknown cause is outside of: the catalogue, or what of it was compared."""
    return "outside the catalogue" if not diagnosis.is_partial else (
        "outside the effects that were compared")


def not_compared(diagnosis: Diagnosis) -> str:
    """Say what of the catalogue was compared; empty if all of it was."""
    few = 6  # effects that are named
    names, said = diagnosis.looked_for, []
    if names is not None:
        said.append(f"{len(names)} of {len(catalogue())}" + (
            f": {', '.join(names)}" if len(names) <= few else ""))
    if diagnosis.uncompared:
        said.append(counted(diagnosis.uncompared, "hypothesis was", "hypotheses were")
                    + " not compared for want of time")
    return "; ".join(said)


def unknown_sentences(diagnosis: Diagnosis, unknown: UnknownCause) -> list[str]:
    """Describe what is outside the catalogue, or outside what of it was compared."""
    where, beside_effects = outside(diagnosis), bool(diagnosis.identified)
    if extent := not_compared(diagnosis):
        where += f" ({extent})"
    x, y, z = (f"{1e3 * component:.0f}" for component in unknown.at_m)
    start = (f"A single cause {where} could equally well take the place of all of them"
             if unknown.ambiguous else f"Something {where} "
             + ("remains" if beside_effects else "is missing"))
    sentences = [f"{start}: {UNKNOWN_KINDS[unknown.kind]}, largest at ({x}, {y}, {z}) mm with "
                 f"{decimals(1e3 * unknown.largest_T, 2)} mT (Bayes factor "
                 f"{bayes_factor(unknown.log_bayes_factor)})."]
    if unknown.parts:
        sentences.append("It looks like " + "; and ".join(map(part_in_words, unknown.parts)) + ".")
    if unknown.source_m is not None:
        x, y, z = (f"{1e3 * component:.0f}" for component in unknown.source_m)
        sentences.append("If the source is a small magnetized object, it is near "
                         f"({x}, {y}, {z}) mm.")
    return sentences


def unknown_advice(unknown: UnknownCause) -> str:
    """Say what to measure next."""
    along = unknown.parts[0].along if unknown.parts else ""
    return " ".join(filter(None, [UNKNOWN_ADVICE[unknown.kind], ADVICE_BY_COORDINATE.get(along)]))


def part_in_words(part: UnknownPart) -> str:
    """Describe one term of an unknown cause."""
    rms, largest = (decimals(1e3 * one, 2) for one in (part.rms_T, part.largest_T))
    size = f"{rms} mT rms and {largest} mT at most"
    if part.acts_on == "field":
        return f"{_target(part)}, {size}"
    texture = "smooth" if part.smooth else "rough"
    text = f"{_target(part)}, a {texture} function of {COORDINATES[part.along]}"
    if part.half_wave is not None:
        factor, unit = HALF_WAVES[part.along]
        text += f" that changes within some {decimals(factor * part.half_wave, 2)} {unit}"
    text += f" ({size} in the readings"
    if part.or_else:
        text += "; as well explained by " + ", ".join(map(_alternative, part.or_else))
    return text + ")"


def _target(part: UnknownPart) -> str:
    """Say what of the readings one term of an unknown cause changes, and by how much."""
    names = ", ".join(part.components)
    target = {
        "field": "a field that Maxwell's equations allow in the bore",
        "readings": f"an error of the readings of B{names.replace(', ', ', B')}",
        "gains": f"an error of {decimals(1e2 * part.size, 2)} % rms of the gain of B"
                 f"{names.replace(', ', ', B')}",
        "positions": f"an error of {decimals(1e3 * part.size, 2)} mm rms of the probe's position "
                     f"along {names}"}[part.acts_on]
    return target + (f" in map {part.map}" if part.map and part.acts_on != "field" else "")


def _alternative(text: str) -> str:
    """Describe another family by its name, see `Family.name`."""
    family, _, where = text.partition(" in map ")
    acts_on, _, along = family.partition(" ")
    said = f"{acts_on} along {COORDINATES[along]}" if along else "a field"
    return f"{said} in map {where}" if where else said


NOT_NAMED = {
    "odds": "Suspected with a probability of {} % (odds {} : 1), which is too little to name it: "
            "{}.",
    "which": "Something is missing (odds {1} : 1), but the map does not tell which of these it is, "
             "so that none is named: {2}.",
    "impossible": "Suspected (odds {1} : 1), but not named, as no valid study has it at the size "
                  "that the readings ask for: {2}. Another cause may look like it.",
    "roughly": "Suspected (odds {1} : 1), but not named, as its field was only estimated: {2}.",
    "dropped": "Suspected (odds {1} : 1), but not named, as the search dropped it again beside the "
               "other effects: {2}."}
"""What is said of a suspicion, by the reason for which it is not named."""


def suspicion_in_words(suspicion: Suspicion, titles: dict[str, str]) -> str:
    """Say what is suspected, with its odds, and why it is not named."""
    many_to_one = 1000.0  # odds beyond which their number says nothing more
    place = place_in_words(suspicion.hypothesis.place)
    first = titles.get(suspicion.effects[0], suspicion.effects[0]) + (f", {place}" if place else "")
    odds = suspicion.probability / max(1 - suspicion.probability, 1e-9)
    others = [f"{titles.get(name, name)} ({100 * share:.0f} %)"
              for name, share in zip(suspicion.effects[1:], suspicion.shares[1:], strict=True)]
    together = f", or else {', '.join(others)}" if others else ""
    return NOT_NAMED[suspicion.reason].format(
        f"{100 * suspicion.probability:.0f}", f"{odds:.1f}" if odds < many_to_one else
        f"over {many_to_one:.0f}", first + together)


def more_readings(suspicion: Suspicion) -> str:
    """Say how often the map would have to be repeated for a decision.

    The expected log Bayes factor rises in proportion to the number of readings.
    """
    if suspicion.reason not in ("odds", "which"):
        return ("Look at magnet and mapper for what is suspected: the same map again would not "
                "decide it.")
    factor = max(suspicion.log_bayes_factor, 1.0)
    prior = np.log(suspicion.shares[0] / max(1 - suspicion.probability, 1e-9)) - factor
    times = max(2, int(np.ceil((DETECTION_LOG_ODDS - prior) / factor)))
    return (f"Measure the same map {times} times in all to decide on what is suspected: if it is "
            "there, the mean of these maps is enough to name it; if not, the suspicion fades.")


OTHER_SOURCES = ("background", "ferromagnetic_object")
"""Effects by which a neighbouring magnet's field can be corrected."""

REMEDIES = {
    "block_flipped": "the block of {} is the wrong way round or wrongly magnetized: turn it, or "
                     "replace it by one that is not",
    "block_missing": "put the missing block of {} in",
    "block_put_in_wrongly": "turn the block back: {}",
    "blocks_swapped": "exchange the blocks of {}",
    "rings_swapped": "exchange {}",
    "rings_turned": "turn back {}",
    "rings_upside_down": "turn {} over"}
"""What to do at the magnet about an effect that is an error of assembly, by the effect's name."""


def answer(diagnosis: Diagnosis) -> Answer:
    """Say what the study lacks, how sure that is, and what to do next."""
    found, doubts = _found(diagnosis), _doubts(diagnosis)
    # what was named stands, whatever is suspected besides
    only_suspected = diagnosis.suspected and not diagnosis.identified
    sound = not (diagnosis.unknown or only_suspected or diagnosis.solver_error or _fails(
        diagnosis) or diagnosis.after.held_out_conflict or _is_restless(diagnosis)
        or _is_made_small(diagnosis) or _misread_alike(diagnosis))
    imitation = _imitated_in_words(diagnosis)
    if imitation and not _has_imitated(diagnosis):
        doubts.append(imitation)
    if diagnosis.identified and doubts:
        # besides how well the model fits now, and error bars that are too wide
        doubtful = len(doubts) > 1 + bool(diagnosis.after.too_near)
        wrong = (diagnosis.unknown or diagnosis.solver_error or _fails(diagnosis)
                 or diagnosis.after.held_out_conflict or _is_restless(diagnosis))
        verdict = ("No" if wrong else "Only in part" if doubtful else
                   "Yes, but what is suspected is not in the model" if diagnosis.suspected else
                   "Yes")
        if verdict == "Only in part":
            doubts.insert(0, doubts.pop())  # the reason comes before how well the model fits
        doubts[0] = f"{verdict}. {doubts[0]}"
    if exchanged := _also_possible(diagnosis):
        doubts.append(exchanged)
    if imitation and _has_imitated(diagnosis):
        doubts.append(imitation)
    if not diagnosis.identified:
        doubts.insert(0, _trust(diagnosis, sound))
    remedies = _remedies(diagnosis) if sound else []
    step = _next(diagnosis)
    gross = diagnosis.gross_errors  # which says itself whether a factor explains the map as well
    factor = "" if gross else diagnosis.before.common_factor
    if _is_made_small(diagnosis) or ((
            factor or any(one.factor for one in gross)) and (not sound or _unusual(diagnosis))):
        found = [factor] * bool(factor) + found
        step = ("Look at the unit, the sign and the factor of the readings and at the remanence "
                "first, correct the map or the study, and diagnose again.", _again(diagnosis))
    return Answer("What does the study lack?", " ".join(found), " ".join(doubts) or _trust(
        diagnosis, sound), *step, sound, "" if not remedies else (
            f"The magnet was not assembled as designed: {in_a_row(remedies)}, or use "
            f"{STUDY_FILE}, which describes it with these errors."),
        diagnosis.found_anything, _gist(diagnosis), distances(diagnosis.before, diagnosis.after))


def _gist(diagnosis: Diagnosis) -> str:
    """Say in large type what an unknown cause looks like; empty to begin as the answer does."""
    unknown = diagnosis.unknown
    if unknown is None or not unknown.parts or diagnosis.identified or diagnosis.gross_errors:
        return ""
    return (f"Something {outside(diagnosis)} is missing. It looks like "
            f"{'; and '.join(map(_target, unknown.parts))}.")


def _trust(diagnosis: Diagnosis, sound: bool) -> str:
    """Say whether an answer without named effects can be trusted."""
    chi2 = f"chi² per training reading is {decimals(diagnosis.after.prior_conflict)}"
    if sound and (hidden_by_solver(diagnosis.after) or (
            diagnosis.imitated is not None and not _has_imitated(diagnosis))):
        return ("Only as far as this map shows: the readings are explained to their noise, with "
                "the blocks' tolerances integrated out.")
    if sound:
        return ("Yes: the readings are explained to their noise, with the blocks' tolerances "
                "integrated out.")
    if _is_made_small(diagnosis):
        return ("No: so corrected the map agrees with the study far better than its noise allows, "
                "as one does that a wrong unit has made too small.")
    if diagnosis.solver_error:
        return "No: the mesh is too coarse for readings of this noise."
    if diagnosis.unknown:
        return (f"No: what is missing can be described but not added to the model ({chi2} without "
                "it). It is no random noise, so that error bars of an update with this map are "
                "too small.")
    if diagnosis.suspected:
        return f"Only in part: a suspicion is no certainty. Without it {chi2}."
    if not _fails(diagnosis) and _misread_alike(diagnosis):
        return "Only in part: the map can be read in several ways that explain it alike."
    if not _fails(diagnosis):
        return f"No. {diagnosis.after.held_out_conflict or 'The search did not come to rest.'}"
    return f"No: {chi2}."


def _misread_alike(diagnosis: Diagnosis) -> list[str]:
    """Say how a map may have been misread as well, if that gives other blocks.

    A map of a magnet that is its own mirror image looks the same with the other sign of z and of
    Bz, and blocks and rings then change sides. Where blocks were measured, they tell which it is.
    """
    if diagnosis.before.measured_blocks is not None:
        return []
    return [f"{f'Map {error.map}' if error.map else 'The map'} would be the same with "
            f"{joined_by_or([each.text for each in error.alternatives])}, and blocks of an update "
            "others: how it was taken tells which it is."
            for error in diagnosis.gross_errors if error.alternatives]


def _is_made_small(diagnosis: Diagnosis) -> bool:
    """Tell whether a corrected map lies nearer to the model than its noise allows.

    A quadrupole agrees at a thousandth of its lengths with a thousandth of its readings.
    """
    return bool(diagnosis.gross_errors and diagnosis.after.too_near)


def _again(diagnosis: Diagnosis) -> str:
    """Return the command that diagnoses again."""
    maps = "" if diagnosis.before.is_campaign else " --measurements MAP"
    return f"halbach-fe diagnose STUDY{maps} -o DIR"


def _next(diagnosis: Diagnosis) -> tuple[str, str]:
    """Return the next step, and its command."""
    campaign = diagnosis.before.is_campaign
    maps = "" if campaign else " --measurements MAP"
    infer = f"halbach-fe infer DIR/{STUDY_FILE}{maps} -o DIR"
    again = _again(diagnosis)
    if diagnosis.solver_error:
        before = diagnosis.before
        place = before.magnet, before.observation.points
        keys = finer_in_words(*place)
        boundary = ", or move `open_boundary` outwards" * (
            choose_route(*place) is not Route.MOMENTS)
        return (f"Take {keys}{boundary}, and diagnose again." if keys else "No key of the mesh "
                "lowers it: the grid of the iron is fixed on this route."), again
    if diagnosis.is_partial and not diagnosis.identified and not diagnosis.suspected and (
            diagnosis.unknown is not None or _fails(diagnosis) or _is_restless(diagnosis)):
        options = in_a_row(["--effects"] * (diagnosis.looked_for is not None)
                           + ["--time-limit"] * bool(diagnosis.uncompared))
        return (f"Compare all effects of the catalogue: diagnose again without {options}.", again)
    if diagnosis.unknown is not None:
        return unknown_advice(diagnosis.unknown), again
    suspicions = " ".join(map(more_readings, diagnosis.suspected))
    if any(is_uncertain(diagnosis.study, one)
           for each in diagnosis.suspected for one in each.fitted):
        suspicions += (f" Until then {STUDY_FILE} has its amplitude as uncertain about 0: an "
                       "update with that study is right whether it is there or not.")
    if suspicions and not diagnosis.identified:
        return suspicions, again
    if _fails(diagnosis):
        check = "halbach-fe check MAP -o DIR"
        return ("Check the map without any magnet: it says which noise and which rows are in it.",
                check)
    if diagnosis.after.held_out_conflict:
        return ("Let the diagnosis see readings like those that were held out, which contradict "
                "it: hold out others, spread over the whole map ([inference.held_out]), and "
                "diagnose again. If they are a map of its own, test first whether it is of the "
                "same magnet in the same state.", again)
    if _is_restless(diagnosis):
        return ("Do not use these effects: they changed from round to round, as they do where the "
                "cause is not in the catalogue. Repeat some lines in another order and with the "
                "probe turned by 180°: that shows whether magnet or instrument is in error.", again)
    if _misread_alike(diagnosis):
        return ("Find out how the map was taken, correct it or the study, and diagnose again: "
                f"{STUDY_FILE} has the first of the ways in which it can be read.", again)
    if diagnosis.found_anything:
        changed = f"Update the magnet with {STUDY_FILE}, the study with what was found."
        if any(map(rivals, diagnosis.identified)):
            return ("Measure what tells apart the causes that explain the map equally well: the "
                    f"page says what. Until then {STUDY_FILE} has the first of them"
                    f"{_beside(diagnosis)}.", infer)
        if remedies := _remedies(diagnosis):
            changed = (f"Look at the magnet: {in_a_row(remedies)}, and measure again. If it "
                       f"stays as it is, update it with {STUDY_FILE}, the study with what was "
                       "found.")
        return f"{changed} {suspicions}".strip(), infer
    if _has_imitated(diagnosis):
        return (f"Update the magnet with {STUDY_FILE}, the study with what blocks may imitate.",
                infer)
    these = "these maps" if diagnosis.after.is_campaign else "this map"
    return f"Update the magnet with {these}.", f"halbach-fe infer STUDY{maps} -o DIR"


def _beside(diagnosis: Diagnosis) -> str:
    """Say which of the causes that explain the map equally well the diagnosed study has, too."""
    titles = catalogue_titles(diagnosis)
    others = [one for effect in diagnosis.identified for one in effect.rivals]
    present = {effect.hypothesis.effect.name for effect in diagnosis.identified}
    exact = dict.fromkeys(title_of(one.hypothesis.effect.name, titles) for one in others
                          if not is_uncertain(diagnosis.study, one)
                          and one.hypothesis.effect.name not in present)
    inside = any(is_uncertain(diagnosis.study, one) for one in others)
    return (", and beside it the others with uncertain amplitudes about 0, so that an update is "
            "right whichever it is" if inside else "") + (
        f"; without {joined_by_or(list(exact))}" if exact else "")


def _remedies(diagnosis: Diagnosis) -> list[str]:
    """Say what can be put right at the magnet itself, by hand."""
    return [REMEDIES[effect.hypothesis.effect.name].format(place_in_words(effect.place))
            for effect in diagnosis.identified if effect.hypothesis.effect.name in REMEDIES]


def _has_imitated(diagnosis: Diagnosis) -> bool:
    """Tell whether the diagnosed study has all that blocks may imitate as uncertain numbers."""
    fitted = () if diagnosis.imitated is None else diagnosis.imitated.fitted
    return bool(fitted) and all(is_uncertain(diagnosis.study, one) for one in fitted)


def _imitated_in_words(diagnosis: Diagnosis) -> str:
    """Say what may be missing that no reading shows; nothing if that is negligible."""
    imitation, titles = diagnosis.imitated, catalogue_titles(diagnosis)
    if imitation is None:
        return ""
    shown = 4  # most of them by name
    parts = [f"{title_of(name, titles)} {decimals(100 * share)} %" for name, share in zip(
        imitation.effects, imitation.shares, strict=True)]
    if len(parts) > shown + 1:
        rest = sum(imitation.shares[shown:])
        parts[shown:] = [f"one of {len(parts) - shown} others {decimals(100 * rest)} %"]
    return (f"With a probability of {decimals(100 * imitation.probability)} % something is missing "
            f"that no reading shows, as the blocks imitate it ({in_a_row(parts)}): "
            "the blocks of an update without it are then off by more than their error bars. "
            + (f"{STUDY_FILE} has it as uncertain about 0: an update with that study is right "
               "whether it is there or not." if _has_imitated(diagnosis) else
               "What is possible belongs into the study as [[uncertain]] or [instrument_sd]."))


def _also_possible(diagnosis: Diagnosis) -> str:
    """Say which other blocks it can be if the pose of the map was found from the map itself.

    A turn that brings the nominal magnet onto itself then changes nothing but names of blocks.
    Where the study leaves the map as it is, or blocks were measured, they are known.
    """
    study = diagnosis.before.study
    instruments = [study.of_map(number).instrument for number in range(len(study.maps))] or [
        study.instrument]
    if diagnosis.before.measured_blocks is not None or not diagnosis.identified or not all(
            any(one.rotation_rad) or any(one.translation_m) for one in instruments):
        return ""
    magnet = build_magnet(study)
    images = symmetry_images(magnet)
    said = []
    for effect in diagnosis.identified:
        place = effect.place
        own = sorted(magnet.number_of(ring, slot) for ring, slot in (
            (place.ring, place.slot), place.other) if ring and slot)
        if own:
            others = dict.fromkeys(tuple(sorted(image[each] for each in own)) for image in images)
            others.pop(tuple(own), None)
            if others:
                blocks = " or ".join(place_in_words(place_of(*(
                    magnet.blocks[each] for each in other))) for other in others)
                said.append(f"{place_in_words(place)} may be {blocks} as well")
    return (f"If where the map lies was found from the map itself (register), {in_a_row(said)}, "
            "as the nominal magnet is the same after a turn: only a mark on the magnet tells which "
            "it is.") if said else ""


def _is_restless(diagnosis: Diagnosis) -> bool:
    """Whether the search had time, and did not come to rest at what predicts best."""
    return not diagnosis.is_at_rest and diagnosis.uncompared is None


def _fails(diagnosis: Diagnosis) -> bool:
    """Whether the readings disagree with what the diagnosis leaves."""
    return diagnosis.after.prior_conflict > diagnosis.after.conflict_limit


def _found(diagnosis: Diagnosis) -> list[str]:
    """Describe in sentences what is missing."""
    titles = catalogue_titles(diagnosis)
    after, unknown = diagnosis.after, diagnosis.unknown
    sentences = [finding.sentence for finding in other_findings(diagnosis)]
    if diagnosis.solver_error:
        return sentences
    if diagnosis.identified:
        fits = diagnosis.is_at_rest and not (
            _fails(diagnosis) or diagnosis.after.held_out_conflict)
        start = f"{_maps(diagnosis)} explained by" if fits else (
            "The best explanation of those that were compared is" if diagnosis.is_partial else
            "The best explanation from the catalogue is")
        sentences.append(f"{start}: " + "; ".join(
            _effect_in_words(effect, titles) for effect in diagnosis.identified) + ".")
    elif diagnosis.suspected:
        sentences.append("Nothing can be named for certain.")
    elif unknown is None and not _fails(diagnosis):
        several = after.is_campaign
        these = "these maps" if several else "this map"
        start = ("Nothing was found so far:" if diagnosis.uncompared is not None else
                 f"Nothing else is missing that {these} can show: with that," if sentences
                 else f"Nothing is missing that {these} can show:"
                 if diagnosis.looked_for is None else
                 f"Of what was looked for ({', '.join(diagnosis.looked_for)}) nothing is missing "
                 f"that {these} can show:")
        agree = "the maps agree" if several else "the map agrees"
        if diagnosis.after.held_out_conflict:
            start = "Something is missing that was not found: readings that were held out disagree."
            agree = f"The others of {these} agree"
        sentences.append(f"{start} {agree} with the study within noise (chi² per reading "
                         f"{decimals(after.prior_conflict)}).")
    if not diagnosis.identified and _is_restless(diagnosis):
        sentences.append(
            f"Nothing {'that was compared' if diagnosis.is_partial else 'in the catalogue'} "
            f"explains {'the maps' if after.is_campaign else 'the map'}: "
            f"of {diagnosis.rounds} rounds the study without any effect predicts held-out readings "
            "best.")
    if unknown is not None:
        sentences += unknown_sentences(diagnosis, unknown)
    elif not diagnosis.identified and not diagnosis.suspected and _fails(diagnosis):
        disagree = "The maps disagree" if after.is_campaign else "The map disagrees"
        effect = ("no effect of the catalogue" if not diagnosis.is_partial else
                  f"none of the effects that were compared ({not_compared(diagnosis)})")
        other = " The cause may be another effect of the catalogue." * diagnosis.is_partial
        sentences.append(
            f"{disagree} with the study (chi² per reading "
            f"{decimals(after.prior_conflict)}, where {after.conflict_limit:.3g} would be rare), "
            f"and {effect} explains the difference, nor does a smooth field or sensor error."
            f"{other} The readings scatter as if their noise were "
            f"{np.sqrt(after.prior_conflict):.2g} times as large as the study says: check that, "
            "and what may change them from one to the next (mains, backlash, steps of a display).")
    for suspicion in diagnosis.suspected:
        sentences.append(suspicion_in_words(suspicion, titles))
    return sentences


def _doubts(diagnosis: Diagnosis) -> list[str]:
    """Say in sentences how far to trust what was found."""
    titles = catalogue_titles(diagnosis)
    before, after = diagnosis.before, diagnosis.after
    sentences = ([] if diagnosis.uncompared is None
                 else [_cut_in_words(diagnosis.uncompared, diagnosis.rounds)])
    if diagnosis.solver_error:
        return sentences
    if diagnosis.identified:
        held = ["".join(f", and {decimals(fit.chi2_per_reading)} for held-out readings"
                        for fit in [each for each in fits if each.part != TRAINING][:1])
                for fits in (region_scores(before, diagnosis.loo_residuals_before),
                              region_scores(after, diagnosis.loo_residuals_after))]
        added = "this effect" if len(diagnosis.identified) == 1 else "these effects"
        sentences.append(
            f"With {added} in the model, chi² per training reading is "
            f"{decimals(after.prior_conflict)}{held[1]} (before: "
            f"{decimals(before.prior_conflict)}{held[0]}).")
        if _fails(diagnosis) and diagnosis.unknown is None:
            sentences.append("That is still too large: another cause is missing.")
        elif diagnosis.after.held_out_conflict:
            sentences.append(
                "The held-out readings contradict that, as their chi² should be about 1: another "
                f"cause looks like {added} where the other readings are.")
    sentences += [
        f"{_maps(diagnosis, 'do')} not tell {_told_apart(effect, titles)} "
        f"from {joined_by_or(titles_of_rivals(effect, titles))}."
        for effect in diagnosis.identified if rivals(effect)]
    sentences += _misread_alike(diagnosis)
    if diagnosis.identified and diagnosis.positions:
        sentences.append(
            "The magnet is the same from several sides, so that the readings may be displaced by "
            f"{joined_by_or([position_in_words(each) for each in diagnosis.positions])}; the "
            "first is used here.")
    names = [effect.hypothesis.effect.name for effect in diagnosis.identified]
    sources = [title_of(name, titles) for name in names if name in OTHER_SOURCES]
    if "neighbour_magnet" in names and sources:
        sentences.append(
            f"{in_a_row(sources).capitalize()} may be how the neighbouring magnet differs from a "
            "copy of this one, which its model is.")
    unusual = [f"{title_of(effect.hypothesis.effect.name, titles)} "
               f"({_over_prior_sd(effect):.0f} times)" for effect in _unusual(diagnosis)]
    if unusual:
        sentences.append(
            "Far larger than usual (relative to the prior's standard deviation): "
            f"{', '.join(unusual)}. Unless another measurement confirms such an effect, "
            "suspect another cause.")
    if diagnosis.identified and _is_restless(diagnosis):
        sentences.append(
            f"The search had not converged after {diagnosis.rounds} rounds: the effects or "
            "their amplitudes still changed." if diagnosis.answer in (0, diagnosis.rounds) else
            f"The search ended after {diagnosis.rounds} rounds, of which round {diagnosis.answer} "
            "predicts held-out readings best; what later rounds added made the prediction worse.")
    if diagnosis.unsolved:
        sentences.append("A further step led to a model without a solution, which is left out.")
    if len(diagnosis.identified) == MAX_EFFECTS:
        sentences.append(
            f"These are {MAX_EFFECTS} effects, the largest number that is searched for. So "
            "many effects together are a fit rather than a diagnosis, and some of them take "
            "the place of another cause.")
    sentences += filter(None, (hidden_by_solver(after), after.too_near))
    nothing = not (diagnosis.identified or diagnosis.suspected or diagnosis.unknown
                   or _fails(diagnosis))
    if nothing and diagnosis.looked_for is not None:
        sentences.append(
            "Only the effects that were chosen (--effects) were looked for: others may be missing.")
    if nothing and diagnosis.limits and (diagnosis.looked_for is None or {
            "block_demagnetized", "block_displaced"} <= {*diagnosis.looked_for}):
        sentences.append(limits_in_words(diagnosis.limits))
    return sentences


def _maps(diagnosis: Diagnosis, verb: str = "are") -> str:
    """Return the map, or the maps, as the subject of a sentence with a verb."""
    if diagnosis.after.is_campaign:
        return f"The maps {verb}"
    return f"The map {'is' if verb == 'are' else 'does'}"


def _cut_in_words(uncompared: int, rounds: int) -> str:
    """Say that the time limit cut the search."""
    text = ("The time limit cut the search after "
            f"{rounds} {'rounds' if rounds > 1 else 'round'}: this is what it had so far")
    return f"{text}, with {uncompared} hypotheses not compared." if uncompared else f"{text}."


def _over_prior_sd(identified: IdentifiedEffect) -> float:
    """Return the largest ratio of an amplitude to its prior standard deviation.

    Amplitudes that only say whether an effect is present are ignored.
    """
    effect = identified.hypothesis.effect
    first = int(effect.is_binary or effect.applied_in_full)
    return max((abs(value) / parameter.sd for value, parameter in zip(
        identified.values[first:], identified.parameters[first:], strict=True)), default=0.0)


def _unusual(diagnosis: Diagnosis) -> list[IdentifiedEffect]:
    """Return the effects that are far larger than their priors expect."""
    # Amplitude in prior standard deviations above which the page warns and does not say "Yes":
    # twice the standard deviation of the wide prior (`WIDE_PRIOR_SD`), far beyond the errors of a
    # magnet that is built with care.
    unusual_amplitude = 10.0
    return [each for each in diagnosis.identified if _over_prior_sd(each) > unusual_amplitude]


def _effect_in_words(identified: IdentifiedEffect, titles: dict[str, str]) -> str:
    """Describe an effect with its place and amplitudes."""
    effect = identified.hypothesis.effect
    parts = [title_of(effect.name, titles), place_in_words(identified.place),
             "; ".join(text for text in amounts(identified) if text != PRESENT)]
    others = titles_of_rivals(identified, titles)
    return ", ".join(part for part in parts if part) + (
        f" (or, as well: {joined_by_or(others)})" if others else "")


def catalogue_titles(diagnosis: Diagnosis) -> dict[str, str]:
    """Return the descriptions of all effects by name."""
    return {effect.name: effect.title for effect in (
        *catalogue(), *(identified.hypothesis.effect for identified in diagnosis.identified))}


def titles_of_rivals(identified: IdentifiedEffect, titles: dict[str, str]) -> list[str]:
    """Return the descriptions of an effect's rivals, with the place of those that differ by it."""
    return [title_of(candidate.effect, titles) + (
        f", {label_in_words(candidate.place)}"
        if candidate.effect == identified.hypothesis.effect.name else "")
        for candidate, _ in rivals(identified)]


def _told_apart(identified: IdentifiedEffect, titles: dict[str, str]) -> str:
    """Return the description of an effect, with its place if rivals differ from it by the place."""
    name = identified.hypothesis.effect.name
    same = any(candidate.effect == name for candidate, _ in rivals(identified))
    return title_of(name, titles) + (f", {place_in_words(identified.place)}" if same else "")


def title_of(name: str, titles: dict[str, str]) -> str:
    """Return the description of an effect, with its name if other effects have the same
    description.
    """
    title = titles.get(name, name)
    return f"{title} ({name})" if list(titles.values()).count(title) > 1 else title


def joined_by_or(parts: Sequence[str]) -> str:
    """Join phrases by commas and a final "or"."""
    return " or ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else parts[0]
