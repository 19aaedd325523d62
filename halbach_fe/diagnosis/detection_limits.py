"""The smallest change of a block that a map would have shown.

A change of known size makes the log Bayes factor of its effect rise with the square of the
amplitude, by the information matrix of its signatures with the blocks integrated out. The limit is
the amplitude at which the posterior odds pass the threshold of naming, without noise: about half of
all changes of that size would be named, and nearly all of half again as much.
"""

from __future__ import annotations

import numpy as np

from halbach_fe.core.arrays import Floats, slices
from halbach_fe.diagnosis.effects.base import Effect, Hypothesis, each_block
from halbach_fe.diagnosis.effects.blocks import BlockDemagnetizedEffect
from halbach_fe.diagnosis.effects.shape import BLOCK_DISPLACED
from halbach_fe.diagnosis.linearization import Training
from halbach_fe.diagnosis.model_selection import (
    DETECTION_LOG_ODDS,
    EFFECT_PRIOR_ODDS,
    WIDE_PRIOR_SD,
)
from halbach_fe.diagnosis.result import DetectionLimits
from halbach_fe.diagnosis.scene import Campaign
from halbach_fe.inference.result import InferenceResult


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

