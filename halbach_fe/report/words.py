"""Quantities as people read them, with a unit that suits their size, and magnets in words."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import TypeVar

import numpy as np

from halbach_fe.core.numbers import EMPTY_CELL, first_of
from halbach_fe.core.numbers import decimals as decimals
from halbach_fe.core.numbers import in_a_row as in_a_row
from halbach_fe.geometry.blocks import MagnetBlock, block_in_words
from halbach_fe.geometry.iron import IronSolid
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.geometry.remounting import as_meant, is_as_meant
from halbach_fe.study.model import Study, iron_of
from halbach_fe.study.types import COMPONENTS

T = TypeVar("T")

ROUNDING = 1e-11
"""Fraction of a field below which its error is the rounding of the computer."""

CERTAIN = 100
"""Power of ten beyond which a Bayes factor is not told in detail."""

PERCENT_FROM = 0.01
"""Part of 1 from which it is told in per cent, not in ppm."""

INTEGRATED = {"racetrack": "1e-3", "round": "1e-6"}
"""Kinds of coils whose field is no closed form, and how far it was measured to be off beside their
windings, of its largest value."""

RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")

TO_ONE = "\u00a0:\u00a01"

BAYES_FACTOR_IN_WORDS = ("The Bayes factor of an effect says how many times as probable the "
                         "readings are with it as without it.")


def coils_in_words(magnet: Magnet) -> str:
    """Say how far the field of coils is off; nothing where it is a closed form."""
    kinds = {coil.kind for coil in magnet.external.coils}
    return next((f" That of the coils is integrated, and up to {off} of its largest value off."
                 for kind, off in INTEGRATED.items() if kind in kinds), "")


def flux_density(value: float, digits: int = 3, zeros: bool = False) -> str:
    """Format a flux density in T as mT, or as T or µT if it is large or small.

    With ``zeros`` the last digits are there if they are 0 too, as beside numbers that have them.
    """
    # Flux density below which texts and tables give it in µT, and from which they give it in T. A
    # residual of 120 µT stands beside one of 5 µT without a change of unit.
    small_t, large_t = 1e-3, 1.0
    if np.isnan(value):
        return EMPTY_CELL
    size, unit = ((value, "T") if abs(value) >= large_t else (1e3 * value, "mT")
                  if abs(value) >= small_t or not value else (1e6 * value, "µT"))
    text = decimals(size, digits)
    if zeros and text != "0":
        text = f"{size:#.{digits}g}".rstrip(".") if abs(size) < 10**digits else text
    return f"{text}\u00a0{unit}"


def with_error(value: float, sd: float) -> str:
    """Return a number and its standard deviation, with two digits of the latter."""
    if not abs(sd) > ROUNDING * abs(value):
        return f"{value:.6g}"
    places = int(np.clip(1 - np.floor(np.log10(sd)), 0, 9))
    rounded = round(value, places) + 0.0  # without a sign where it is 0
    return f"{rounded:.{places}f}\u00a0±\u00a0{sd:.{places}f}"


def with_unit(value: float, sd: float, unit: str) -> str:
    """Return a number in SI and its standard deviation in a unit: per cent, or one of a thousandth
    (mm, mT m) or a millionth (µT) if it begins with m or µ.
    """
    scale = {"%": 100.0, "m": 1e3, "µ": 1e6}.get(unit[0], 1.0)
    return f"{with_error(scale * value, scale * sd)}\u00a0{unit}"


def by_axis(name: str, values: Iterable[float], sd: Iterable[float]) -> dict[str, str]:
    """Return components along x, y and z with their standard deviations, from m in mm or from rad
    in mrad; {} in ``name`` stands for the axis.
    """
    return {name.format(axis): with_error(1e3 * value, 1e3 * bar)
            for axis, value, bar in zip(COMPONENTS, values, sd, strict=True)}


def point_mm(values: Iterable[float], sd: Iterable[float]) -> str:
    """Return a point in m, with its standard deviations, in mm."""
    return f"({', '.join(by_axis('{}', values, sd).values())})"


def ppm(value: float) -> str:
    """Return a number of ppm as text, without an exponent."""
    return (f"{value:,.0f}".replace(",", "\u202f") if abs(value) >= 999.5
            else "0" if abs(value) < 1e-3 else f"{value:.3g}")


def relative(share: float) -> str:
    """Return a part of 1 in ppm, or in per cent from 10 000 ppm on."""
    return (f"{decimals(100 * share)}\u00a0%" if abs(share) >= PERCENT_FROM
            else f"{ppm(1e6 * share)}\u00a0ppm")


def probability(share: float) -> str:
    """Return a probability in per cent, without claiming certainty."""
    return ("less than 0.1\u00a0%" if share < 1e-3 else "more than 99.9\u00a0%"
            if share > 0.999 else f"{100 * share:.3g}\u00a0%")


def bayes_factor(log_bayes_factor: float) -> str:
    """Return how many times as probable the readings are with an effect as without it.

    Large factors are powers of ten, and no larger one than `CERTAIN` is claimed.
    """
    if np.isnan(log_bayes_factor):
        return EMPTY_CELL
    power = log_bayes_factor / np.log(10)
    if power >= CERTAIN:
        return f"over 10{str(CERTAIN).translate(RAISED)}{TO_ONE}"
    if power >= 4:
        return f"10{str(int(power)).translate(RAISED)}{TO_ONE}"
    return f"{decimals(float(np.exp(log_bayes_factor)), 2)}{TO_ONE}"


def p_value(value: float) -> str:
    """Return a p-value as text, without an exponent."""
    return "less than 0.0001" if value < 1e-4 else f"{value:.2g}"


def whole(number: int) -> str:
    """Return a whole number with its thousands apart."""
    return f"{number:,}".replace(",", "\u202f") if abs(number) >= 10_000 else str(number)


def share_in_words(share: float, sd: float | None) -> str:
    """Return a share of what was drawn in per cent, with its standard deviation; in words if it is
    none or all, of which the draws tell no standard deviation.
    """
    if share in (0.0, 1.0):
        return "All" if share else "None"
    return with_unit(share, sd or 0.0, "%")


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return a number and its noun, perhaps with its verb: 1 move, 2 moves; 1 is, 2 are."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def is_fourier(study: Study) -> bool:
    """Whether a reading of the study is a Fourier coefficient of B_r, not a component of B."""
    return study.observation.quantity == "fourier_coefficients"


def faults_in_words(study: Study) -> str:
    """Say which blocks the study has reversed, turned, missing or in places of others; empty if
    none.

    A block that was moved or turned so that magnetization and shape are those of its slot is as
    designed, as those are that `halbach_fe.shim` moves.
    """
    # Largest angle of a block that is mounted as ordered, in degrees: a slot lets it turn by a few
    # degrees, and a wrong orientation is a quarter or half turn, or the step to the next slot.
    as_ordered_deg = 10.0
    places = {study.array.block_of(one) for one in study.array.exceptions
              if one.magnetization_factor <= 0 or one.mounted_from is not None
              or math.hypot(*one.rotation_deg) > as_ordered_deg} - {None}
    if not places:
        return ""
    magnet = build_magnet(study)
    found: dict[str, list[str]] = {}
    for block, meant in zip(magnet.blocks, as_meant(magnet).blocks, strict=True):
        if block.place not in places or (
                block.remanence and is_as_meant(block, meant, math.radians(as_ordered_deg))):
            continue
        kind = ("missing" if not block.remanence else "reversed" if block.remanence < 0 else
                "made for another place"
                if block.mounted_from not in (None, block.place) else
                "put in the wrong way")
        found.setdefault(kind, []).append(block_in_words(block.ring, block.slot))
    # largest number of blocks that a line names
    most_places = 4
    return "; ".join(
        f"{kind}: " + ("; ".join(names) if len(names) <= most_places else f"{len(names)} blocks")
        for kind, names in found.items())


def place_of(block: MagnetBlock) -> str:
    """Describe a block by its own label, or else by ring and slot."""
    return block_in_words(block.ring, block.slot, block.label or "")


def fraction(value: float) -> str:
    """Format a fraction in percent, with one decimal."""
    return f"{100 * value:.1f}\u00a0%"


def best_known(by_name: Mapping[str, T]) -> tuple[str, T]:
    """Return the last of some magnets, which is the best known one, and its name."""
    return list(by_name.items())[-1]


def listed(values: Mapping[str, str]) -> list[dict[str, str]]:
    """Return a row of text for each quantity."""
    return [{"quantity": name, "value": value} for name, value in values.items()]


def magnet_rows(magnet: Magnet) -> dict[str, str]:
    """Return the properties of a magnet that its pages list, by name."""
    array, blocks = magnet.array, magnet.blocks
    outer = f"{1e3 * magnet.array_outer_radius:.6g} mm"
    rows = [("dimension", f"{magnet.dimension}D"), ("blocks", layout(magnet)),
            ("radius of the bore, outer radius",
             f"{1e3 * magnet.free_radius:.6g} mm, {outer}") if magnet.has_bore else (
                "outer radius", f"{outer}, without a bore"),
            ("remanence", f"{_range((abs(block.remanence) for block in blocks), 4)} T"),
            ("recoil permeability along, across the easy axis",
             f"{_range((block.recoil_permeability for block in blocks), 3)}, "
             f"{_range((block.recoil_permeability_across for block in blocks), 3)}"),
            ("main multipole", str(array.multipole_order))]
    if magnet.dimension == 3:
        rows.insert(3, ("length", f"{1e3 * float(np.ptp(magnet.array_ends)):.6g} mm"))
    return dict([*rows, ("iron", iron_description(magnet))])


def in_one_line(magnet: Magnet) -> str:
    """Return the magnet in a line: blocks, bore, length, remanence, iron."""
    length = (f", {1e3 * float(np.ptp(magnet.array_ends)):.4g} mm long" if magnet.dimension == 3
              else ", in cross-section")
    iron = "without iron" if iron_of(magnet.study) is None else f"iron: {iron_description(magnet)}"
    bore = f"bore {2e3 * magnet.free_radius:.4g} mm" if magnet.has_bore else "no bore"
    return (f"{layout(magnet)}{length}, {bore}, "
            f"outer diameter {2e3 * magnet.array_outer_radius:.4g} mm, remanence "
            f"{_range((abs(block.remanence) for block in magnet.blocks), 3)} T, {iron}")


def layout(magnet: Magnet) -> str:
    """Return the number of rings and blocks in words, for example "3 rings of 16 sectors"."""
    most_sizes = 3  # largest number of different rings whose numbers of blocks are listed
    array = magnet.array
    count = len(array.blocks_by_ring) if array.free_blocks is None else array.rings
    texts = []
    if count:
        sizes = sorted(set(array.blocks_by_ring[:count]))
        shapes = dict.fromkeys((ring.block or array.block).shape for ring in array.ring)
        blocks = (' or '.join(map(str, sizes)) if len(sizes) <= most_sizes
                  else f"{sizes[0]} to {sizes[-1]}")
        texts.append(f"{count} ring{'s' * (count > 1)} of {blocks} "
                     f"{', '.join(f'{shape}s' for shape in shapes or [array.block.shape])}")
    if array.free_blocks is not None:
        kinds = ", ".join(dict.fromkeys(array.free_blocks.shape))
        texts.append(f"{len(array.free_blocks)} free blocks ({kinds})")
    return " and ".join(texts)


def _middle_mm(body: IronSolid) -> list[float]:
    """Return the middle of the box around a body in mm, to a micrometre."""
    return [round(500 * float(part.min() + part.max()), 3) + 0.0 for part in body.surface]


def iron_description(magnet: Magnet) -> str:
    """Return the bodies of iron and their material in words."""
    iron = iron_of(magnet.study)
    if iron is None:
        return "none"
    bodies = []
    for body in magnet.iron:
        if body.sphere or not body.in_place:
            size = "x".join(f"{1e3 * float(np.ptp(part)):.4g}" for part in body.surface)
            bodies.append(f"{'sphere' if body.sphere else 'body'} within {size} mm about "
                          f"({', '.join(f'{part:g}' for part in _middle_mm(body))}) mm")
            continue
        kind = "tube" if body.outline is None else "prism"
        length = "" if np.isinf(body.z_max) else (
            f", z {1e3 * body.z_min:g} to {1e3 * body.z_max:g} mm")
        bodies.append(f"{kind}, r {1e3 * body.inner_radius:g} to "
                      f"{1e3 * body.outer_radius:g} mm{length}")
    if any(body.own_material for body in getattr(iron, "bodies", ())):
        material = "iron of several materials"
    elif iron.curve is None:
        material = f"relative permeability {iron.relative_permeability:g}"
    else:
        material = f"magnetization curve ({iron.curve.kind.replace('_', '–').title()})"
        if iron.curve.kind == "steel":
            material = f"steel {iron.curve.name}"
    return f"{material}; {first_of(bodies, 4, '; ')}"


def capital(text: str) -> str:
    """Return a text whose first letter is large, as that of a sentence."""
    return f"{text[0].upper()}{text[1:]}"


def within_a_sentence(text: str) -> str:
    """Return a sentence whose first letter is small, unless it is that of a name such as Bx.

    Examples
    --------
    >>> within_a_sentence("The noise is known"), within_a_sentence("Bx and By disagree")
    ('the noise is known', 'Bx and By disagree')
    """
    first = re.match(r"[A-Z][a-z]*(?![\w|²'])", text)
    name = first is None or re.fullmatch(r"[B-Z]|B(?:[xyzr]|phi|abs)", first[0])
    return text if name else f"{text[0].lower()}{text[1:]}"


def _range(values: Iterable[float], digits: int) -> str:
    """Return the value that all have in common, or the smallest and the largest."""
    low, high = np.min(found := np.fromiter(values, float)), np.max(found)
    return f"{low:.{digits}f}" if high - low < 10.0**-digits else (
        f"{low:.{digits}f} to {high:.{digits}f}")
