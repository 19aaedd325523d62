"""The types of hidden effects, and functions that draw their amplitudes.

A hidden effect has a name, parameters, and a function that applies their values to the true magnet
or to the mapper.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from halbach_fe.measurement.positions import points_from
from halbach_fe.study.model import Study
from halbach_fe.study.types import Component
from halbach_fe.synthetic.bodies import TrueMagnet, Vector
from halbach_fe.synthetic.faulty_instrument import FaultyInstrument
from halbach_fe.synthetic.positions import between

Need = Literal["3d", "rings", "no iron", "x", "y", "z", "circles"]
"""A requirement of an effect on the study.

These are three dimensions, several rings, no iron in the study, an observed component x, y or z,
and points off the axis (``circles``).
"""

REFERENCE_OUTER_RADIUS_M = 0.2
"""Outer radius in m of the magnets whose tolerances are drawn here.

Lengths are drawn smaller in proportion for smaller magnets, and not larger for larger ones.
"""


@dataclass(frozen=True)
class Site:
    """The sizes of a study's magnet and map, from which amplitudes are drawn.

    Attributes
    ----------
    dimension, rings, slots : int
        Dimension of the study, number of rings, and number of blocks per ring.
    inner, outer, half_length : float, in m
        Radii and half length of the array; infinite length in two dimensions.
    permeability : float
        Relative recoil permeability.
    has_iron : bool
        Whether the study has an iron ring.
    components : tuple of str
        Components of B that are observed.
    radius, z_min, z_max : float, in m
        Largest radius and limits of z of all points, the held-out ones included.
    """

    dimension: int
    rings: int
    slots: int
    inner: float
    outer: float
    half_length: float
    permeability: float
    has_iron: bool
    components: tuple[Component, ...]
    radius: float
    z_min: float
    z_max: float

    @property
    def scale(self) -> float:
        """Factor of lengths that are drawn, see `REFERENCE_OUTER_RADIUS_M`."""
        return min(1.0, self.outer / REFERENCE_OUTER_RADIUS_M)

    def has(self, need: Need) -> bool:
        """Tell whether the study meets a requirement."""
        if need in ("x", "y", "z"):
            return need in self.components
        return {"3d": self.dimension == 3, "rings": self.rings > 1, "no iron": not self.has_iron,
                "circles": self.radius > 0}[need]


def site_of(study: Study, magnet: TrueMagnet) -> Site:
    """Return the site of a study, whose nominal magnet is ``magnet``."""
    array, observed = study.array, study.observation
    points = np.vstack([points_from(observed.positions), between(observed.positions)])
    return Site(
        study.dimension, array.rings, array.blocks_per_ring, array.inner_radius_m,
        array.outer_radius_m,
        max(body.centre[2] + body.shape.length / 2 for body in magnet.bodies),
        array.recoil_permeability, study.iron_ring is not None,
        ("x", "y") if observed.quantity == "fourier_coefficients" else observed.components,
        float(np.hypot(points[:, 0], points[:, 1]).max()), float(points[:, 2].min()),
        float(points[:, 2].max()))


@dataclass(frozen=True)
class HiddenParameter:
    """A parameter of an effect; without a unit it is a count, a fraction or a factor."""

    name: str
    unit: str = ""


Draw = Callable[[Site, np.random.Generator], tuple[float, ...]]
"""Function that draws the values of an effect's parameters."""


@dataclass(frozen=True)
class HiddenEffect:
    """A deviation from the study that a campaign can hide in its truth.

    Attributes
    ----------
    name : str
    group : str
        ``field`` for effects of the magnet or its surroundings, ``instrument`` for those of the
        mapper, ``gross`` for gross errors.
    parameters : tuple of HiddenParameter
    draw : callable
        Function of site and random generator that returns values. Their size is realistic, and
        large enough to be visible in a map.
    magnet, instrument : callable, optional
        Function of a magnet (or an instrument), the site and the values that returns the magnet (or
        instrument) with the effect; an effect has one of the two.
    needs : tuple of Need
        Requirements on the study.
    of_blocks : bool
        Whether the blocks have the effect before they are mounted, so that the Helmholtz coil
        measures it too.
    """

    name: str
    group: Literal["field", "instrument", "gross"]
    parameters: tuple[HiddenParameter, ...]
    draw: Draw
    magnet: Callable[..., TrueMagnet] | None = None
    instrument: Callable[..., FaultyInstrument] | None = None
    needs: tuple[Need, ...] = ()
    of_blocks: bool = False


@dataclass(frozen=True)
class ChosenEffect:
    """An effect to hide, with its values."""

    effect: HiddenEffect
    values: tuple[float, ...]

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
    return float(generator.integers(1, site.rings + 1)), float(
        generator.integers(1, site.slots + 1))


def draw_number(low: float, high: float, either_sign: bool = True) -> Draw:
    """Return a function that draws one number between limits of its size, not scaled."""
    return lambda site, generator: (
        (signed_log_uniform if either_sign else log_uniform)(generator, low, high),)


def draw_length(low: float, high: float, either_sign: bool = True) -> Draw:
    """Return a function that draws one length in m, scaled to the size of the magnet."""
    return lambda site, generator: (
        site.scale * (signed_log_uniform if either_sign else log_uniform)(generator, low, high),)


