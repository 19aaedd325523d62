"""Positions of a displaced map that a symmetric magnet hardly distinguishes, compared by evidence.

The nominal magnet makes some displacements of a map equal: from the axis of a symmetric magnet, one
to either side. What little tells them apart is in the magnet's own model and in the measured
blocks. Every possible position is therefore refined by steps of Gauss and Newton with the blocks
integrated out. The search for effects starts from the most probable one, and the others that the
readings do not exclude are results too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.diagnosis.hypothesis import Hypothesis
from halbach_fe.diagnosis.model_selection import (
    INDISTINGUISHABLE_LOG_EVIDENCE,
    Candidate,
    SelectedEffect,
)
from halbach_fe.diagnosis.result import IdentifiedEffect, PossiblePosition
from halbach_fe.diagnosis.scene import Campaign
from halbach_fe.diagnosis.search import marginal_of
from halbach_fe.inference.result import InferenceResult

STEPS = 2
"""Number of steps that refine a position: it starts from a fit of nominal blocks, within 2 mm."""

Start = tuple[IdentifiedEffect, ...]
"""Effects that amount to a displacement of the map."""


@dataclass(frozen=True)
class _Refined:
    """A position with its evidence."""

    start: Start
    log_evidence: float


def possible_positions(
    starts: Sequence[Start], updated: Callable[[Start, str], InferenceResult], campaign: Campaign,
) -> tuple[Start, tuple[PossiblePosition, ...]]:
    """Return the most probable position, and all that the readings do not exclude.

    Parameters
    ----------
    starts : sequence of Start
        The positions.
    updated : callable
        Takes a position and a name, and returns the inference with that position.
    campaign : Campaign

    Returns
    -------
    start : tuple of IdentifiedEffect
        The most probable position.
    positions : tuple of PossiblePosition
        It and the others, the most probable first. The tuple is empty if there are no others.
    """
    if len(starts) < 2:
        return (starts[0] if starts else ()), ()
    refined = sorted((_refined(start, f"position-{number}", updated, campaign)
                      for number, start in enumerate(starts, start=1)),
                     key=lambda each: -each.log_evidence)
    best = refined[0]
    near = [each for each in refined
            if each.log_evidence >= best.log_evidence - INDISTINGUISHABLE_LOG_EVIDENCE]
    weights = np.exp([each.log_evidence - best.log_evidence for each in near])
    return best.start, tuple(
        PossiblePosition({effect.name: tuple(effect.values.tolist())
                          for effect in each.start}, float(weight / weights.sum()))
        for each, weight in zip(near, weights, strict=True)) if len(near) > 1 else ()


def start_of(
    amplitudes: Mapping[str, tuple[float, ...]], hypotheses: Mapping[str, Hypothesis]
) -> Start:
    """Return effects of given amplitudes, by name, as if they had been found."""
    return tuple(
        IdentifiedEffect(hypotheses[name], np.array(values), np.zeros(len(values)),
                         SelectedEffect(Candidate(name, hypotheses[name].place.name, ()),
                                        0.0, 0.0, ()))
        for name, values in amplitudes.items())


def _refined(
    start: Start, name: str, updated: Callable[[Start, str], InferenceResult],
    campaign: Campaign,
) -> _Refined:
    """Return the position to which a few steps lead, and its log evidence."""
    for step in range(STEPS + 1):
        update = updated(start, name)
        if step == STEPS:
            break
        whitened, _, marginal, training = marginal_of(update, campaign)
        scene = campaign.scene(update.study)  # displacements need the field in vacuum only
        columns = np.hstack([whitened(update.observation.read(
            scene.signature(effect.hypothesis))) for effect in start])
        sd = np.array([parameter.sd for effect in start for parameter in effect.parameters])
        change = sd * marginal.evidence(columns * sd, training).fit(range(len(sd))).mean
        ends = np.cumsum([len(effect.values) for effect in start])[:-1]
        start = tuple(replace(effect, values=effect.values + part) for effect, part in zip(
            start, np.split(change, ends), strict=True))
    return _Refined(start, update.log_evidence)

