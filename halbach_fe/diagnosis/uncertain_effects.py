"""How well a map knows effects: those that were found, and changes too small to be found.

What is uncertain of the effects that were found becomes tables ``[[uncertain]]`` of the study. The
standard deviation in such a table is the prior one of the effect, about the amplitude that was
found. The posterior one would count the readings twice: `infer` uses the same map again, and finds
the amplitude anew, with its correlations with all blocks and other amplitudes. What the readings do
not tell from an effect is in the study beside it.

The smallest change of a block that a map would have shown: a change of known size makes the log
Bayes factor of its effect rise with the square of the amplitude, by the information matrix of its
signatures with the blocks integrated out. The limit is the amplitude at which the posterior odds
pass the threshold of naming, without noise: about half of all changes of that size would be named,
and nearly all of half again as much.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from pydantic import ValidationError

from halbach_fe.core.arrays import Floats, slices
from halbach_fe.core.errors import StudyError
from halbach_fe.diagnosis.effect_selection import (
    DETECTION_LOG_ODDS,
    EFFECT_PRIOR_ODDS,
    WIDE_PRIOR_FROM,
    WIDE_PRIOR_SD,
)
from halbach_fe.diagnosis.effects.base import Effect, Hypothesis, Parameter, each_block
from halbach_fe.diagnosis.effects.magnetization import BlockDemagnetizedEffect
from halbach_fe.diagnosis.effects.places_and_shapes import BLOCK_DISPLACED
from halbach_fe.diagnosis.linearization import Training, apply_effects
from halbach_fe.diagnosis.result import DetectionLimits, IdentifiedEffect
from halbach_fe.diagnosis.scanned_maps import Campaign
from halbach_fe.inference.result import InferenceResult
from halbach_fe.study.inference_keys import Uncertain, number_changes
from halbach_fe.study.model import Study

STEP = 1e-3
"""Step of the differences by an amplitude, in its prior standard deviations, see
`halbach_fe.diagnosis.effects.base.STEP`."""


def with_uncertain_effects(
    study: Study, identified: Sequence[IdentifiedEffect],
    suspected: Sequence[IdentifiedEffect] = ()
) -> Study:
    """Return a study without some effects, with these at their amplitudes, which stay uncertain.

    What explains the readings as well as one of them, or is suspected beside them, is in it with
    an amplitude of 0, which is uncertain too: readings that do not tell them apart determine a
    combination of them. Amplitudes that were not fitted (a block is missing or it is not) are
    exact, but for those of refinements: the place of an object is uncertain too if it was taken
    from a search.
    """
    effects = [_with_refinements(effect) for effect in identified]
    widths = [_prior_sds(effect) for effect in effects]
    for rival in _rivals(effects, suspected):
        nothing = replace(rival, values=0.0 * rival.values)
        if _is_neutral(apply_effects(study, effects), nothing):
            effects.append(nothing)
            widths.append(_prior_sds(rival))
    found, tables = apply_effects(study, effects), list(study.uncertain)
    for number, (effect, sds) in enumerate(zip(effects, widths, strict=True)):
        for which, sd in enumerate(sds):
            change = _change(study, effects, (number, which)) if sd else {}
            if change:
                tables.append(Uncertain(
                    name=_name(effect, effect.parameters[which], {one.name for one in tables}),
                    sd=sd, change=change))
    return found.with_(uncertain=tuple(tables))


def is_uncertain(study: Study, effect: IdentifiedEffect) -> bool:
    """Tell whether a study has amplitudes of an effect as uncertain numbers.

    Of an effect that is there or not, as a missing block, it has none.
    """
    return any(re.fullmatch(rf"(\d+\. )?{re.escape(effect.name)}\..*", one.name)
               for one in study.uncertain)


def can_be_uncertain(study: Study, effect: IdentifiedEffect) -> bool:
    """Tell whether a study can have amplitudes of an effect as uncertain numbers about 0."""
    return is_uncertain(with_uncertain_effects(study, (), [effect]), effect)


def _rivals(
    effects: Sequence[IdentifiedEffect], suspected: Sequence[IdentifiedEffect]
) -> list[IdentifiedEffect]:
    """Return all rivals of some effects, and what is suspected, that are none of these.

    An effect whose place is fitted is one rival, at its likeliest place, and none of itself.
    """
    found = {effect.hypothesis: effect for effect in effects}
    placed = {one.effect for one in found if one.effect.refinements}
    for rival in (*(each for effect in effects for each in effect.rivals), *suspected):
        own = rival.hypothesis.effect
        if own not in placed:
            found.setdefault(rival.hypothesis, rival)
            placed |= {own} if own.refinements else set()
    return list(found.values())[len(effects):]


def _is_neutral(study: Study, nothing: IdentifiedEffect) -> bool:
    """Tell whether an effect with amplitudes of 0 changes nothing but the shape of a study.

    It may add an exception of a block. Rotations that follow each other are rounded.
    """
    rounding = 1e-12  # of rotations in rad
    if _switches(nothing):
        return False
    try:
        changes = number_changes(study, apply_effects(study, [nothing]))
        return all(abs(change) < rounding for change in changes.values())
    except (StudyError, ValidationError):
        return False
    except ValueError:  # the shape
        return True


def _switches(effect: IdentifiedEffect) -> int:
    """Return how many of the first amplitudes only say whether an effect is present: 0 or 1."""
    own = effect.hypothesis.effect
    return int(own.is_binary or own.applied_in_full)


def _with_refinements(identified: IdentifiedEffect) -> IdentifiedEffect:
    """Return an effect with the amplitudes of its refinements, which are 0 at its place."""
    effect = identified.hypothesis.effect
    missing = [parameter.sd for parameter in (
        *effect.parameters, *effect.refinements)[len(identified.values):]]
    return replace(identified, values=np.append(identified.values, 0.0 * np.array(missing)),
                   sd=np.append(identified.sd, missing))


def _prior_sds(effect: IdentifiedEffect) -> list[float]:
    """Return the prior standard deviations with which amplitudes are fitted; 0 of switches.

    Those that are 0 in the likeliest part of an effect may be free as well.
    """
    return [0.0 if which < _switches(effect) else parameter.sd * (
        WIDE_PRIOR_SD if abs(value) > WIDE_PRIOR_FROM * parameter.sd else 1.0)
        for which, (parameter, value) in enumerate(zip(
            effect.parameters, effect.values.tolist(), strict=True))]


def _change(
    study: Study, effects: Sequence[IdentifiedEffect], amplitude: tuple[int, int]
) -> dict[str, float]:
    """Return the change of the numbers of a study per unit of an amplitude of an effect.

    It is empty if the amplitude is no number of the study. ``amplitude`` has the numbers of the
    effect and of its parameter.
    """
    number, which = amplitude
    effect = effects[number]
    step = STEP * effect.parameters[which].sd
    sides = []
    for sign in (1, 0, -1):
        values = effect.values + sign * step * np.eye(len(effect.values))[which]
        try:
            sides.append((sign, apply_effects(study, [
                *effects[:number], replace(effect, values=values), *effects[number + 1:]])))
        except (StudyError, ValidationError):  # beyond the limit of a key
            continue
    between = (sides[0][0] - sides[-1][0]) * step
    if not between:
        return {}
    try:
        changes = number_changes(sides[-1][1], sides[0][1])
    except ValueError:
        return {}
    # digits of a derivative that differences have, of which rounding leaves no more
    digits = 9
    return {name: float(f"{change / between:.{digits}g}") for name, change in changes.items()}


def _name(effect: IdentifiedEffect, parameter: Parameter, taken: set[str]) -> str:
    """Return a name for an amplitude that no other has, with its unit at the end."""
    unit = {"1": ""}.get(parameter.unit, "_" + parameter.unit.replace(" ", "_"))
    name = f"{effect.name}.{parameter.name.replace(' ', '_')}{unit}"
    return next(each for each in _numbered(name) if each not in taken)


def _numbered(name: str) -> Iterator[str]:
    """Yield a name, and then the name with numbers."""
    yield name
    number = 2
    while True:
        yield f"{number}. {name}"
        number += 1


def detection_limits(
    update: InferenceResult, campaign: Campaign, columns: Floats
) -> DetectionLimits | None:
    """Return the smallest changes of single blocks that the training readings would have shown.

    Parameters
    ----------
    update : InferenceResult
        The inference with the identified effects in the model.
    columns : ndarray, shape (rows, k)
        Whitened signatures of the identified effects per prior standard deviation, whose amplitudes
        are free.

    Returns
    -------
    DetectionLimits or None
        None if no block is magnetized.
    """
    # Number of blocks whose signatures are kept at a time, to bound their memory.
    blocks_at_once = 100
    places = each_block(update.study)
    if not places:
        return None
    training = Training.of(update, campaign)
    scene = campaign.scene(update.study)  # changes of single blocks need their field in vacuum only
    threshold = DETECTION_LOG_ODDS - float(np.log(EFFECT_PRIOR_ODDS / len(places)))

    def limits(effect: Effect, count: int) -> Floats:
        """Return the limits (places,) of an effect by its first ``count`` parameters."""
        sd, found = effect.parameters[0].sd, []
        for part in slices(len(places), blocks_at_once):
            signatures = [sd * training.shown(scene.signature(Hypothesis(effect, place))[:count])
                          for place in places[part]]
            evidence = training.marginal.evidence(np.hstack([columns, *signatures]),
                                         np.zeros(len(columns))).given(range(columns.shape[1]))
            for number in range(len(signatures)):
                own = slice(columns.shape[1] + count * number, columns.shape[1] + count * (
                    number + 1))
                found.append(sd * smallest_amplitude(
                    evidence.information[own, own], threshold + np.log(max(1, len(effect.parts)))))
        return np.array(found)

    return DetectionLimits(
        tuple(place.name for place in places), limits(BlockDemagnetizedEffect(), 1),
        limits(BLOCK_DISPLACED, update.magnet.dimension))


def smallest_amplitude(information: Floats, threshold: float) -> float:
    """Return the amplitude at which the log Bayes factor of an effect passes a threshold.

    ``information`` (k, k): of its signatures, per prior standard deviation of their amplitudes. The
    amplitudes are in the direction in which they are least visible.

    Returns
    -------
    float
        In prior standard deviations; infinite if the readings show nothing of the effect.
    """
    visible = np.maximum(np.linalg.eigvalsh(information), 0.0)
    if visible[0] <= np.finfo(float).eps * visible[-1] or not visible[-1]:
        return float("inf")
    found = []
    for precision in (1.0, WIDE_PRIOR_SD**-2):  # both priors have the probability 1/2
        gain = visible[0]**2 / (visible[0] + precision)
        cost = threshold + float(np.log(2) + np.log1p(visible / precision).sum() / 2)
        found.append(float(np.sqrt(2 * cost / gain)))
    return min(found)
