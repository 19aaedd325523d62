"""What an effect is: a name, numbers, and what they do to the true magnet or its mapper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from halbach_fe.measurement.positions import points_from
from halbach_fe.study.model import Study
from halbach_fe.study.types import Component
from halbach_fe.synthetic.bodies import TrueMagnet, Vector
from halbach_fe.synthetic.instrument import FaultyInstrument
from halbach_fe.synthetic.positions import between

Need = Literal["3d", "rings", "no iron", "x", "y", "z", "circles"]
"""What an effect cannot do without: three dimensions, several rings, no iron in the study, a
component that is observed, points off the axis."""

USUAL = 0.2
"""Outer radius in m from which on magnets are built to the tolerances that are drawn here; smaller
ones have smaller errors."""


@dataclass(frozen=True)
class Site:
    """What amplitudes are drawn for: the study's magnet, and where it is measured."""

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
        """Of lengths that are drawn."""
        return min(1.0, self.outer / USUAL)

    def has(self, need: Need) -> bool:
        """Tell whether a need is met."""
        if need in ("x", "y", "z"):
            return need in self.components
        return {"3d": self.dimension == 3, "rings": self.rings > 1, "no iron": not self.has_iron,
                "circles": self.radius > 0}[need]


def site_of(study: Study, magnet: TrueMagnet) -> Site:
    """The site of a study."""
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
    """A number of an effect; without a unit it is a count, a fraction or a factor."""

    name: str
    unit: str = ""


Draw = Callable[[Site, np.random.Generator], tuple[float, ...]]


@dataclass(frozen=True)
class HiddenEffect:
    """Something that a campaign can hide.

    Attributes
    ----------
    name : str
    group : str
    parameters : tuple of Parameter
    draw : callable
        Site and generator to values of a size that is realistic and can be seen.
    magnet, instrument : callable
        Magnet or instrument, the site, and the values to what it makes of it; one of the two.
    needs : tuple
    of_blocks : bool
        Whether the single blocks have it too, before they are mounted: a coil sees it.
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
    """An effect with its values."""

    effect: HiddenEffect
    values: tuple[float, ...]

    def plain(self) -> dict[str, object]:
        """As it stands in the truth."""
        return {"name": self.effect.name, "group": self.effect.group, "parameters": [
            {"name": parameter.name, "unit": parameter.unit, "value": value}
            for parameter, value in zip(self.effect.parameters, self.values, strict=True)]}


# --- draws -------------------------------------------------------------------------------------


def log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return float(np.exp(generator.uniform(np.log(low), np.log(high))))


def signed_log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    """The same, of either sign."""
    return float(generator.choice([-1.0, 1.0])) * log_uniform(generator, low, high)


def draw_direction(generator: np.random.Generator, dimension: int = 3) -> Vector:
    """A unit vector, in the plane of the ring if that is all there is."""
    values = generator.standard_normal(3) * [1, 1, dimension == 3]
    x, y, z = (float(value) for value in values / np.linalg.norm(values))
    return x, y, z


def draw_place(site: Site, generator: np.random.Generator) -> tuple[float, float]:
    """Ring and slot of some block."""
    return float(generator.integers(1, site.rings + 1)), float(
        generator.integers(1, site.slots + 1))


def draw_number(low: float, high: float, either_sign: bool = True) -> Draw:
    """Draw one number between limits of its size, in units that need no scale."""
    return lambda site, generator: (
        (signed_log_uniform if either_sign else log_uniform)(generator, low, high),)


def draw_length(low: float, high: float, either_sign: bool = True) -> Draw:
    """Draw one length in m."""
    return lambda site, generator: (
        site.scale * (signed_log_uniform if either_sign else log_uniform)(generator, low, high),)


