"""Sentences on what is outside the catalogue, and on what is suspected."""

from __future__ import annotations

import numpy as np

from halbach_fe.diagnosis.model_selection import DETECTION_LOG_ODDS
from halbach_fe.diagnosis.result import Suspicion, UnknownCause, UnknownPart
from halbach_fe.diagnosis.summary import place_in_words
from halbach_fe.report.words import bayes_factor, decimals

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
    "field": "a smooth field from a source that is not in the catalogue",
    "instrument": "something that the instrument does and no field could be",
    "either": "a field, or something that the instrument does"}
"""Description of an unknown cause by its kind."""


def unknown_sentences(unknown: UnknownCause, beside_effects: bool) -> list[str]:
    """Describe what is outside the catalogue."""
    x, y, z = (f"{1e3 * component:.0f}" for component in unknown.at_m)
    start = ("A single cause outside the catalogue could equally well take the place of all of "
             "them" if unknown.ambiguous else "Something outside the catalogue "
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
        return f"a field that Maxwell's equations allow in the bore, {size}"
    texture = "smooth" if part.smooth else "rough"
    names = ", ".join(part.components)
    target = {
        "readings": f"an error of the readings of B{names.replace(', ', ', B')}",
        "gains": f"an error of {decimals(1e2 * part.size, 2)} % rms of the gain of B"
                 f"{names.replace(', ', ', B')}",
        "positions": f"an error of {decimals(1e3 * part.size, 2)} mm rms of the probe's position "
                     f"along {names}"}[part.acts_on]
    where = f" in map {part.map}" if part.map else ""
    text = f"{target}{where}, a {texture} function of {COORDINATES[part.along]}"
    if part.half_wave is not None:
        factor, unit = HALF_WAVES[part.along]
        text += f" that changes within some {decimals(factor * part.half_wave, 2)} {unit}"
    text += f" ({size} in the readings"
    if part.or_else:
        text += "; as well explained by " + ", ".join(map(_alternative, part.or_else))
    return text + ")"


def _alternative(text: str) -> str:
    """Describe another family by its name, see `Family.name`."""
    family, _, where = text.partition(" in map ")
    acts_on, _, along = family.partition(" ")
    said = f"{acts_on} along {COORDINATES[along]}" if along else "a field"
    return f"{said} in map {where}" if where else said


MANY_TO_ONE = 1000.0
"""Odds beyond which their number says nothing more."""

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
    place = place_in_words(suspicion.hypothesis.place)
    first = titles.get(suspicion.effects[0], suspicion.effects[0]) + (f", {place}" if place else "")
    odds = suspicion.probability / max(1 - suspicion.probability, 1e-9)
    others = [f"{titles.get(name, name)} ({100 * share:.0f} %)"
              for name, share in zip(suspicion.effects[1:], suspicion.shares[1:], strict=True)]
    together = f", or else {', '.join(others)}" if others else ""
    return NOT_NAMED[suspicion.reason].format(
        f"{100 * suspicion.probability:.0f}", f"{odds:.1f}" if odds < MANY_TO_ONE else
        f"over {MANY_TO_ONE:.0f}", first + together)


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
