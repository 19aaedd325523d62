"""The types of hidden effects, and functions that draw their amplitudes.

A hidden effect has a name, parameters, and a function that applies their values to the true magnet
or to the mapper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from halbach_fe.core.arrays import radii_of
from halbach_fe.measurement.positions import between, points_from
from halbach_fe.study.model import Study
from halbach_fe.study.types import Component
from halbach_fe.synthetic.shapes import Vector
from halbach_fe.synthetic.true_magnet import TrueMagnet

if TYPE_CHECKING:  # effects of this type belong to it
    from halbach_fe.synthetic.hidden_effects.instrument_effects import FaultyInstrument

Need = Literal["3d", "rings", "equal rings", "four edges", "no iron", "vacuum", "few blocks",
               "x", "y", "z", "circles", "axes"]
"""A requirement of an effect on the study.

These are three dimensions, several rings, nothing but equal rings, only blocks of four edges, no
iron in the study, blocks in vacuum besides, at most `FEW_BLOCKS` of them, an observed component x,
y or z, points off the axis (``circles``), and readings of components, of which maps of |B| have
none (``axes``).
"""

FEW_BLOCKS = 64
"""Largest number of blocks of a magnet whose losses are simulated, in a minute or two."""


@dataclass(frozen=True)
class Site:
    """The sizes of a study's magnet and map, from which amplitudes are drawn."""

    dimension: int
    rings: int
    slots: int
    """Dimension of the study, number of rings, and largest number of blocks per ring."""
    inner: float
    outer: float
    half_length: float
    """Radii and half length of the array; infinite length in two dimensions. In m."""
    permeability: float
    most_permeable: float
    """Smallest and largest relative recoil permeability."""
    has_iron: bool
    """Whether the study has an iron ring."""
    components: tuple[Component, ...]
    """Components of B that are observed."""
    radius: float
    z_min: float
    z_max: float
    """Largest radius and limits of z of all points, the held-out ones included. In m."""
    places: tuple[tuple[int, int], ...]
    """Ring and slot of every block."""
    is_uniform: bool
    """Whether the array consists of equal rings only."""
    has_four_edges: bool
    """Whether all blocks have four edges."""
    is_of_length: bool = False
    """Whether the map is of |B|: its probe is a single sensor, that of x, and has no axes."""

    @property
    def scale(self) -> float:
        """Factor of lengths that are drawn for a magnet of a certain size."""
        # Outer radius in m of the magnets whose tolerances are drawn here. Lengths are drawn
        # smaller in proportion for smaller magnets, and not larger for larger ones.
        reference_outer_radius_m = 0.2
        return min(1.0, self.outer / reference_outer_radius_m)

    def has(self, need: Need) -> bool:
        """Tell whether the study meets a requirement."""
        if need in ("x", "y", "z"):
            return need in (("x",) if self.is_of_length else self.components)
        return {"3d": self.dimension == 3, "rings": self.rings > 1, "no iron": not self.has_iron,
                "few blocks": len(self.places) <= FEW_BLOCKS,
                "vacuum": not self.has_iron and self.permeability == self.most_permeable == 1.0,
                "equal rings": self.is_uniform, "four edges": self.has_four_edges,
                "circles": self.radius > 0, "axes": not self.is_of_length}[need]

    def slots_of(self, ring: float) -> list[int]:
        """Return the slots of a ring that have a block, in their order."""
        return sorted(slot for own, slot in self.places if own == ring)


def site_of(study: Study, magnet: TrueMagnet) -> Site:
    """Return the site of a study, whose nominal magnet is ``magnet``."""
    array, observed = study.array, study.observation
    points = np.vstack([points_from(observed.positions), between(observed.positions)])
    sizes = array.blocks_by_ring
    inner, outer = array.inner_radius_m, array.outer_radius_m
    if not array.is_uniform:
        radii = np.concatenate([np.hypot(*body.rim[:, :2].T) for body in magnet.bodies])
        inner, outer = float(radii.min()), float(radii.max())
    return Site(
        study.dimension, len(sizes), max(sizes), inner, outer, magnet.half_length,
        min(min(body.along, body.across) for body in magnet.bodies),
        max(max(body.along, body.across) for body in magnet.bodies), magnet.iron is not None,
        ("x", "y") if observed.quantity == "fourier_coefficients" else observed.components,
        float(radii_of(points).max()), float(points[:, 2].min()),
        float(points[:, 2].max()), tuple((body.ring, body.slot) for body in magnet.bodies),
        array.is_uniform, all(body.shape.has_four_edges for body in magnet.bodies))


LARGEST = {"m": 0.1, "rad": np.pi, "T": 1.0, "K": 500.0, "1/K": 0.1, "1/T": 10.0, "1/T^2": 10.0,
           "A/m": 1e8, "m^3": 1.0}
"""Largest absolute value of a parameter by its unit: what is beyond was meant in another unit."""

METRES = (-1.0, 1.0)
"""Limits in m of a place, and of the whole map's displacement."""


@dataclass(frozen=True)
class HiddenParameter:
    """A parameter of an effect; without a unit it is a count, a fraction or a factor."""

    name: str
    unit: str = ""
    least: float | None = None
    most: float | None = None
    """Smallest and largest value that a magnet or an instrument can have; by default those of the
    unit, of either sign."""

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest value."""
        no_unit_largest = 1e3  # the same of a count, a fraction or a factor
        largest = LARGEST.get(self.unit, no_unit_largest)
        return (-largest if self.least is None else self.least,
                largest if self.most is None else self.most)


def parameters(
    text: str, **limits: tuple[float | None] | tuple[float | None, float]
) -> tuple[HiddenParameter, ...]:
    """Return parameters that are stated as ``name unit, ...``.

    Some have a smallest value, or a smallest and a largest one, other than that of their unit.
    """
    names = [one.partition(" ")[::2] for one in text.split(", ") if one]
    return tuple(HiddenParameter(name, unit, *limits.get(name, ())) for name, unit in names)


Draw = Callable[[Site, np.random.Generator], tuple[float, ...]]
"""Function that draws the values of an effect's parameters."""

Values = Mapping[str, float]
"""The values of an effect by the names of their parameters."""
Refused = tuple[str, str, float] | None
"""What is refused of values, what it must be, and what it is; None if they can be."""
Check = Callable[[Site, Values], Refused]


@dataclass(frozen=True)
class HiddenEffect:
    """A deviation from the study that a campaign can hide in its truth."""

    name: str
    group: Literal["field", "instrument", "gross"]
    """``field`` for effects of the magnet or its surroundings, ``instrument`` for those of the
    mapper, ``gross`` for gross errors."""
    parameters: tuple[HiddenParameter, ...]
    draw: Draw
    """Function of site and random generator that returns values. Their size is realistic, and large
    enough to be visible in a map."""
    magnet: Callable[..., TrueMagnet] | None = None
    instrument: Callable[..., FaultyInstrument] | None = None
    """Function of a magnet (or an instrument), the site and the values that returns the magnet (or
    instrument) with the effect; an effect has one of the two."""
    needs: tuple[Need, ...] = ()
    """Requirements on the study."""
    of_blocks: bool = False
    """Whether the blocks have the effect before they are mounted, so that the Helmholtz coil
    measures it too."""
    check: Check | None = None
    """Refuses values that are possible alone, but not together or not in this magnet."""


@dataclass(frozen=True)
class ChosenEffect:
    """An effect to hide, with its values."""

    effect: HiddenEffect
    values: tuple[float, ...]

    @property
    def by_name(self) -> Values:
        """The values by the names of their parameters."""
        return {parameter.name: value for parameter, value in zip(
            self.effect.parameters, self.values, strict=True)}

    def plain(self) -> dict[str, object]:
        """Return the effect as plain data for the truth."""
        return {"name": self.effect.name, "group": self.effect.group, "parameters": [
            {"name": parameter.name, "unit": parameter.unit, "value": value}
            for parameter, value in zip(self.effect.parameters, self.values, strict=True)]}


# --- draws -------------------------------------------------------------------------------------


def log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    """Draw a positive number whose logarithm is uniform between those of two limits."""
    return float(np.exp(generator.uniform(np.log(low), np.log(high))))


def signed_log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    """Draw a number as `log_uniform` does, and give it a random sign."""
    return float(generator.choice([-1.0, 1.0])) * log_uniform(generator, low, high)


def draw_direction(generator: np.random.Generator, dimension: int = 3) -> Vector:
    """Draw a unit vector; in two dimensions it lies in the plane of the ring."""
    values = generator.standard_normal(3) * [1, 1, dimension == 3]
    x, y, z = (float(value) for value in values / np.linalg.norm(values))
    return x, y, z


def draw_place(site: Site, generator: np.random.Generator) -> tuple[float, float]:
    """Draw the ring and slot of a block."""
    ring = float(generator.integers(1, site.rings + 1))
    slots = site.slots_of(ring)
    return ring, float(slots[generator.integers(0, len(slots))])


def draw_number(low: float, high: float, either_sign: bool = True) -> Draw:
    """Return a function that draws one number between limits of its size, not scaled."""
    return lambda site, generator: (
        (signed_log_uniform if either_sign else log_uniform)(generator, low, high),)


def draw_length(low: float, high: float, either_sign: bool = True) -> Draw:
    """Return a function that draws one length in m, scaled to the size of the magnet."""
    return lambda site, generator: (
        site.scale * (signed_log_uniform if either_sign else log_uniform)(generator, low, high),)
