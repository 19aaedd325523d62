"""Effects that a synthetic campaign can hide in its truth, each applied in full.

They share no code with the effects of `halbach_fe.diagnosis`, which are to find them.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches

import numpy as np

from halbach_fe.core.errors import HalbachWarning, StudyError, must_be
from halbach_fe.study.types import wrong_unit
from halbach_fe.synthetic.hidden_effects import instrument_effects, magnet_effects
from halbach_fe.synthetic.hidden_effects.effect_types import ChosenEffect, HiddenEffect, Site
from halbach_fe.synthetic.hidden_effects.instrument_effects import FaultyInstrument
from halbach_fe.synthetic.true_magnet import TrueMagnet

EFFECTS: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (*magnet_effects.EFFECTS, *instrument_effects.EFFECTS)}

AXES, COUNTS = ("axis", "first", "second"), ("blocks", "more")
"""Names of parameters that are axes, from 1 or as letters, and of those that count."""

RequestedEffect = tuple[HiddenEffect, tuple[float, ...] | None]
"""An effect and its values; None if these are to be drawn."""


def signature(effect: HiddenEffect) -> str:
    """Return the names of an effect's parameters with their units, as text."""
    return ", ".join(f"{parameter.name}{f' in {parameter.unit}' if parameter.unit else ''}"
                     for parameter in effect.parameters)


def parse_hidden_effect(text: str) -> RequestedEffect:
    """Parse an effect of the form ``NAME`` or ``NAME=value,value``, axes as numbers or letters.

    Raises
    ------
    ValueError
        If the name is unknown, or the values do not fit the effect.
    """
    name, equals, rest = text.partition("=")
    if name not in EFFECTS:
        near = get_close_matches(name, EFFECTS, 1, 0.5)
        raise ValueError(f"no effect is called '{name}'; " + (
            f"did you mean {near[0]}?" if near else f"the effects are {', '.join(EFFECTS)}"))
    effect = EFFECTS[name]
    if not equals:
        return effect, None
    parameters = signature(effect)
    of_axes = {parameter.name for parameter in effect.parameters} <= {*AXES}
    axes = {"x": 1, "y": 2, "z": 3} if of_axes else {}
    try:
        values = tuple(float(axes.get(value.strip(), value))
                       for value in rest.split(",")) if rest else ()
    except ValueError:
        raise ValueError(f"{name} needs numbers ({parameters}), not '{rest}'") from None
    if len(values) != len(effect.parameters) or not np.isfinite(values).all():
        raise ValueError(f"{name} needs {len(effect.parameters)} finite values ({parameters}), not "
                         f"'{rest}'")
    return effect, values


def choose_effects(
    site: Site, effects: Sequence[RequestedEffect], at_random: int, generator: np.random.Generator
) -> tuple[ChosenEffect, ...]:
    """Return all effects to hide, with their values: the requested ones, and others at random.

    Gross errors are hidden only on request, not at random.

    Raises
    ------
    StudyError
        If the study cannot have one of the effects, has no block or ring at its place, or can have
        fewer than ``at_random`` further effects.
    """
    for effect, _ in effects:
        lacking = [need for need in effect.needs if not site.has(need)]
        if lacking:
            raise StudyError(must_be(f"--hide {effect.name}", "the study",
                                     "an effect whose needs the study meets",
                                     f"one that also needs: {', '.join(lacking)}",
                                     "Choose another effect, or change the study."
                                     + (" A map of |B| has a single sensor, called x, without axes."
                                        if site.is_of_length else "")))
    others = [effect for effect in EFFECTS.values()
              if effect.group != "gross" and effect not in [requested for requested, _ in effects]
              and all(site.has(need) for need in effect.needs)]
    if at_random > len(others):
        raise StudyError(must_be("--hide-random", "the study", f"at most {len(others)}",
                                 str(at_random)))
    picked = generator.choice(len(others), at_random, replace=False)
    hidden = [ChosenEffect(effect, values if values is not None else effect.draw(site, generator))
              for effect, values in [*effects, *((others[n], None) for n in picked)]]
    for effect_with_values in hidden:
        _check_place(site, effect_with_values)
        _check_size(site, effect_with_values)
    names = [_as_named(one) for one in hidden[:len(effects)]]
    if twice := next((name for name in names if names.count(name) > 1), ""):
        raise StudyError(must_be(f"--hide {twice}", "the command line", "given once",
                                 "two of them", "Leave one out."))
    return tuple(hidden)


WHOLE_BLOCK = ("block_missing", "block_flipped", "block_put_in_wrongly")
"""Effects of which a block has one: what is not there cannot lie the wrong way round."""


def _as_named(hidden: ChosenEffect) -> str:
    """Return the name of an effect with the block or ring that it is of."""
    place = [f"{value:g}" for name, value in hidden.by_name.items() if name in ("ring", "slot")]
    name = " or ".join(WHOLE_BLOCK) if hidden.effect.name in WHOLE_BLOCK else hidden.effect.name
    return f"{name}={','.join(place)}" if place else name


def _check_size(site: Site, hidden: ChosenEffect) -> None:
    """Raise a StudyError if a value of an effect cannot belong to any magnet or instrument."""
    def refuse(what: str, expected: str, received: float, hint: str = "") -> None:
        raise StudyError(must_be(f"{what} of --hide {hidden.effect.name}", "the study", expected,
                                 f"{received:g}", hint))

    for parameter, value in zip(hidden.effect.parameters, hidden.values, strict=True):
        unit = f" {parameter.unit}" if parameter.unit else ""
        low, high = parameter.limits
        if not low <= value <= high:
            key = ("coefficient_per_K" if parameter.unit == "1/K"
                   else f"_{parameter.unit.replace('/', '_per_')}")
            refuse(parameter.name, f"from {low:.3g} to {high:.3g}{unit}", value,
                   wrong_unit(key, value, {"ge": low, "le": high}))
        if parameter.name in COUNTS and value != int(value):
            refuse(parameter.name, "a whole number", value)
    if hidden.effect.check and (refused := hidden.effect.check(site, hidden.by_name)):
        refuse(*refused)


def doubt_size(site: Site, hidden: ChosenEffect) -> None:
    """Warn of values that are far beyond those that effects of this name usually have."""
    if hidden.effect.group == "gross":
        return
    generator, draws, far = np.random.default_rng(0), 64, 10.0
    drawn = np.abs([hidden.effect.draw(site, generator) for _ in range(draws)])
    places = {*AXES, "ring", "slot", "other_ring", "other_slot", "seam",
              *("xyz" if "volume" in hidden.by_name else ())}
    sizes = [(parameter, value, most) for parameter, value, most in zip(
        hidden.effect.parameters, hidden.values, drawn.max(axis=0), strict=True)
        if parameter.name not in places]
    for parameter, value, _ in sizes:
        most = max(other for one, _, other in sizes if one.unit == parameter.unit)
        if most and abs(value) > far * most:
            unit = f" {parameter.unit}" if parameter.unit else ""
            warnings.warn(
                f"{parameter.name} of --hide {hidden.effect.name} is {value:g}{unit}, where such "
                f"effects have up to some {most:.1g}{unit}."
                + (f" If a factor is meant, give what it is above 1: {value - 1:.3g}."
                   if parameter.name == "fraction" and 0.5 < value < 2 else ""), HalbachWarning,
                stacklevel=3)


def _check_place(site: Site, hidden: ChosenEffect) -> None:
    """Raise a StudyError if an effect is at a ring, slot, seam or axis that does not exist."""
    limits = {"ring": site.rings, "slot": site.slots, "other_ring": site.rings,
              "other_slot": site.slots, "seam": site.rings - 1, **dict.fromkeys(AXES, 3)}
    values = hidden.by_name
    for parameter, value in zip(hidden.effect.parameters, hidden.values, strict=True):
        highest, lowest = limits.get(parameter.name), 1 if parameter.least is None else 0
        if highest is not None and (value != int(value) or not lowest <= value <= highest):
            raise StudyError(must_be(f"{parameter.name} of --hide {hidden.effect.name}",
                                     "the study", f"a whole number from {lowest} to {highest}",
                                     f"{value:g}"))
    if (values.get("ring") == 0) != (values.get("slot") == 0):  # 0 stands for all blocks
        raise StudyError(must_be(f"ring and slot of --hide {hidden.effect.name}", "the study",
                                 "those of a block, or both 0 for all", "one of them 0"))
    for prefix in ("", "other_"):
        place = values.get(f"{prefix}ring", 0.0), values.get(f"{prefix}slot", 0.0)
        if all(place) and place not in site.places:
            raise StudyError(must_be(f"ring and slot of --hide {hidden.effect.name}", "the study",
                                     "those of a block", f"{place[0]:g} and {place[1]:g}"))


def with_effects(
    magnet: TrueMagnet, site: Site, hidden: Sequence[ChosenEffect], single: bool = False
) -> TrueMagnet:
    """Return the magnet with hidden effects.

    With ``single`` only those are applied that the blocks have before they are mounted, which the
    Helmholtz coil therefore measures. A copy of the magnet beside it has none of them.
    """
    faulty = magnet
    for chosen in hidden:
        if chosen.effect.magnet is not None and (chosen.effect.of_blocks or not single):
            faulty = chosen.effect.magnet(faulty, site, *chosen.values)
    return replace(faulty, copies=tuple(
        replace(copy, bodies=magnet.bodies, iron=magnet.iron) for copy in faulty.copies))


def instrument_with(site: Site, hidden: Sequence[ChosenEffect]) -> FaultyInstrument:
    """Return the instrument with hidden effects."""
    faulty = FaultyInstrument()
    for chosen in hidden:
        if chosen.effect.instrument is not None:
            faulty = chosen.effect.instrument(faulty, site, *chosen.values)
    return faulty
