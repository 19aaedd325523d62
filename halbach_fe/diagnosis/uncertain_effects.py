"""What is uncertain of the effects that were found, as tables ``[[uncertain]]`` of the study.

The standard deviation in such a table is the prior one of the effect, about the amplitude that was
found. The posterior one would count the readings twice: `infer` uses the same map again, and finds
the amplitude anew, with its correlations with all blocks and other amplitudes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from pydantic import ValidationError

from halbach_fe.core.errors import StudyError
from halbach_fe.diagnosis.effects.base import Parameter
from halbach_fe.diagnosis.model_selection import WIDE_PRIOR_FROM, WIDE_PRIOR_SD
from halbach_fe.diagnosis.result import IdentifiedEffect
from halbach_fe.study.model import Study
from halbach_fe.study.uncertain import Uncertain, number_changes

STEP = 1e-3
"""Step of the differences by an amplitude, in its prior standard deviations, see
`halbach_fe.diagnosis.effects.base.STEP`."""

DIGITS = 9
"""Digits of a derivative that differences have, of which rounding leaves no more."""


def with_uncertain_effects(study: Study, identified: Sequence[IdentifiedEffect]) -> Study:
    """Return a study without some effects, with these at their amplitudes, which stay uncertain.

    Amplitudes that were not fitted (a block is missing or it is not) are exact, but for those of
    refinements: the place of an object is uncertain too if it was taken from a search.
    """
    found, tables = study, list(study.uncertain)
    identified = [_with_refinements(effect) for effect in identified]
    for number, effect in enumerate(identified):
        found = effect.hypothesis.apply(found, effect.values.tolist())
        before, after = identified[:number], identified[number + 1:]
        for which, parameter in enumerate(effect.parameters):
            is_switch = which == 0 and effect.hypothesis.effect.applied_in_full
            if effect.sd[which] > 0 and not is_switch:
                change = _change(study, (before, effect, after), which, parameter)
                if change:
                    tables.append(Uncertain(
                        name=_name(effect, parameter, {one.name for one in tables}),
                        sd=_prior_sd(effect, which, parameter), change=change))
    return found.with_(uncertain=tuple(tables))


def _with_refinements(identified: IdentifiedEffect) -> IdentifiedEffect:
    """Return an effect with the amplitudes of its refinements, which are 0 at its place."""
    effect = identified.hypothesis.effect
    missing = [parameter.sd for parameter in (
        *effect.parameters, *effect.refinements)[len(identified.values):]]
    return replace(identified, values=np.append(identified.values, 0.0 * np.array(missing)),
                   sd=np.append(identified.sd, missing))


def _prior_sd(effect: IdentifiedEffect, which: int, parameter: Parameter) -> float:
    """Return the prior standard deviation with which an amplitude was fitted."""
    wide = abs(effect.values[which]) > WIDE_PRIOR_FROM * parameter.sd
    return parameter.sd * (WIDE_PRIOR_SD if wide else 1.0)


def _change(
    study: Study,
    identified: tuple[Sequence[IdentifiedEffect], IdentifiedEffect, Sequence[IdentifiedEffect]],
    which: int, parameter: Parameter
) -> dict[str, float]:
    """Return the change of the numbers of a study per unit of an amplitude of an effect.

    It is empty if the amplitude is no number of the study. ``identified`` are the effects before,
    that one, and those after it.
    """
    before, effect, after = identified
    sides, between = [], 0.0
    for sign in (1, 0, -1):
        values = effect.values + sign * STEP * parameter.sd * np.eye(len(effect.values))[which]
        changed = replace(effect, values=values)
        try:
            other = study
            for each in (*before, changed, *after):
                other = each.hypothesis.apply(other, each.values.tolist())
        except (StudyError, ValidationError):  # beyond the limit of a key
            continue
        sides.append((sign, other))
    between = (sides[0][0] - sides[-1][0]) * STEP * parameter.sd
    if not between:
        return {}
    try:
        changes = number_changes(sides[-1][1], sides[0][1])
    except ValueError:
        return {}
    return {name: float(f"{change / between:.{DIGITS}g}") for name, change in changes.items()}


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
