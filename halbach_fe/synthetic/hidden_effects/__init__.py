"""Effects that a synthetic campaign can hide, each with its full application to the truth.

They know nothing of what any diagnosis makes of a map.
"""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

import numpy as np

from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.synthetic.bodies import TrueMagnet
from halbach_fe.synthetic.hidden_effects import gross, instrument, magnet
from halbach_fe.synthetic.hidden_effects.kinds import ChosenEffect, HiddenEffect, Site
from halbach_fe.synthetic.instrument import FaultyInstrument

EFFECTS: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (*magnet.EFFECTS, *instrument.EFFECTS, *gross.EFFECTS)}

Wanted = tuple[HiddenEffect, tuple[float, ...] | None]
"""An effect, and its values unless they are to be drawn."""


def signature(effect: HiddenEffect) -> str:
    """The names of an effect's values, with their units."""
    return ", ".join(f"{one.name}{f' in {one.unit}' if one.unit else ''}"
                     for one in effect.parameters)


def wanted(text: str) -> Wanted:
    """Read ``NAME`` or ``NAME=value,value``.

    Raises
    ------
    ValueError
        With what is wrong with it.
    """
    name, equals, rest = text.partition("=")
    if name not in EFFECTS:
        near = get_close_matches(name, EFFECTS, 1, 0.5)
        raise ValueError(f"no effect is called '{name}'; " + (
            f"did you mean {near[0]}?" if near else f"there are {', '.join(EFFECTS)}"))
    effect = EFFECTS[name]
    if not equals:
        return effect, None
    needed = signature(effect)
    try:
        values = tuple(float(value) for value in rest.split(",")) if rest else ()
    except ValueError:
        raise ValueError(f"{name} needs numbers ({needed}), not '{rest}'") from None
    if len(values) != len(effect.parameters) or not np.isfinite(values).all():
        raise ValueError(f"{name} needs {len(effect.parameters)} finite values ({needed}), not "
                         f"'{rest}'")
    return effect, values


def chosen(
    site: Site, effects: Sequence[Wanted], at_random: int, generator: np.random.Generator
) -> tuple[ChosenEffect, ...]:
    """All effects to hide with their values: those wanted, and more at random.

    Gross errors are hidden only where they are wanted.

    Raises
    ------
    StudyError
        If the study cannot have one of them.
    """
    for effect, _ in effects:
        lacking = [need for need in effect.needs if not site.has(need)]
        if lacking:
            raise StudyError(must_be(f"--hide {effect.name}", "the study",
                                     "an effect that it can show",
                                     f"one that needs: {', '.join(lacking)}"))
    others = [effect for effect in EFFECTS.values()
              if effect.group != "gross" and effect not in [one for one, _ in effects]
              and all(site.has(need) for need in effect.needs)]
    if at_random > len(others):
        raise StudyError(must_be("--hide-random", "the study", f"at most {len(others)}",
                                 str(at_random)))
    picked = generator.choice(len(others), at_random, replace=False)
    found = [ChosenEffect(effect, values if values is not None else effect.draw(site, generator))
             for effect, values in [*effects, *((others[n], None) for n in picked)]]
    for one in found:
        _check_place(site, one)
    return tuple(found)


def _check_place(site: Site, hidden: ChosenEffect) -> None:
    """Refuse blocks and seams that the magnet has not."""
    least = 0 if hidden.effect.name == "magnetization_gradient" else 1
    limits = {"ring": site.rings, "slot": site.slots, "other_ring": site.rings,
              "other_slot": site.slots, "seam": site.rings - 1, "axis": 3, "first": 3, "second": 3}
    if least == 0 and (hidden.values[0] == 0) != (hidden.values[1] == 0):
        raise StudyError(must_be(f"ring and slot of --hide {hidden.effect.name}", "the study",
                                 "those of a block, or both 0 for all", "one of them 0"))
    for parameter, value in zip(hidden.effect.parameters, hidden.values, strict=True):
        most = limits.get(parameter.name)
        if most is not None and (value != int(value) or not least <= value <= most):
            raise StudyError(must_be(f"{parameter.name} of --hide {hidden.effect.name}",
                                     "the study", f"a whole number from {least} to {most}",
                                     f"{value:g}"))


def with_effects(
    magnet: TrueMagnet, site: Site, hidden: Sequence[ChosenEffect], single: bool = False
) -> TrueMagnet:
    """The magnet with effects; of ``single`` blocks only those that they have before assembly."""
    for one in hidden:
        if one.effect.magnet is not None and (one.effect.of_blocks or not single):
            magnet = one.effect.magnet(magnet, site, *one.values)
    return magnet


def instrument_with(site: Site, hidden: Sequence[ChosenEffect]) -> FaultyInstrument:
    """The instrument with effects."""
    faulty = FaultyInstrument()
    for one in hidden:
        if one.effect.instrument is not None:
            faulty = one.effect.instrument(faulty, site, *one.values)
    return faulty
