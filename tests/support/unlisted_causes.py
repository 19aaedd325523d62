"""Causes outside the catalogue of effects, drawn at random, and maps of magnets that have them.

Either the instrument does something that nobody listed: positions or readings are off by a random
function of z, the azimuth, the radius, the time or the magnitude of the field. Or there is a source
that nobody listed: a loop of current, a group of dipoles, or a magnetized plate beside the magnet.

Random functions are Gaussian processes, drawn by the Cholesky factor of their covariance. (The
diagnosis describes such errors by Fourier series, see `halbach_fe.diagnosis`.) Smooth ones have a
squared-exponential covariance, rough ones an exponential one. Nothing is taken out of the functions
that an effect of the catalogue could be, such as their constant part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr

from halbach_fe.core.arrays import Floats
from halbach_fe.core.installation import import_extra
from halbach_fe.measurement.field_map import field_map
from halbach_fe.measurement.positions import points_from
from halbach_fe.study.model import Study
from halbach_fe.synthetic.hidden_effects.effect_types import site_of
from halbach_fe.synthetic.simulate import SECONDS, check_air, draw_magnet, point_noise, true_field
from halbach_fe.synthetic.true_magnet_of_study import magnet_of

Coordinate = Literal["z", "angle", "radius", "time", "field"]
"""What a random function depends on; ``field`` is the magnitude of B."""

COORDINATES: tuple[Coordinate, ...] = ("z", "angle", "radius", "time", "field")
INSTRUMENT = tuple(
    (acts_on, coordinate, kind) for acts_on in ("positions", "readings")
    for coordinate in COORDINATES for kind in ("smooth", "rough"))
SOURCES = ("loop", "dipoles", "plate")

SMOOTH_LENGTHS = (0.12, 0.3)

SIZES = (5.0, 50.0)
"""Rms change of the readings that a cause acts on, in units of their noise."""

FieldAt = Callable[[Floats], Floats]
"""Function of points (n, 3) in m that returns the true field (n, 3) in T."""


@dataclass(frozen=True)
class UnlistedCause:
    """What was drawn, in words and numbers."""

    acts_on: str
    """``positions``, ``readings`` or ``source``."""
    varies_along: str
    """The coordinate of the random function, or which source it is."""
    texture: str
    """``smooth`` or ``rough``; fields of sources are smooth."""
    axes: tuple[int, ...]
    """Components of the position, or sensors, that are off."""
    rms_T: float
    """Rms change of the readings without noise that it causes, over all components."""
    rms_over_noise: float
    """The same for the whitened readings."""

    @property
    def family(self) -> str:
        """Name of the family."""
        return f"{self.acts_on}-{self.varies_along}-{self.texture}"


def families() -> tuple[tuple[str, str, str], ...]:
    """Return all families: what they act on, along what they vary, and how smooth they are."""
    return INSTRUMENT + tuple(("source", name, "smooth") for name in SOURCES)


def simulate_unlisted(
    study: Study, seed: int, family: tuple[str, str, str] | None = None
) -> tuple[xr.Dataset, UnlistedCause]:
    """Draw a magnet and a cause outside the catalogue, and return the map and the cause.

    The field is magpylib's, as in `halbach_fe.synthetic.simulate`. The order in which the points
    were measured is drawn, too: circle by circle along z, or line by line.

    ``family``: one of `families`; drawn if left out.
    """
    # Displacement by which the change of the readings per displacement is found.
    trial_displacement_m = 1e-4
    # Largest rms displacement of the probe; larger ones would be seen by eye.
    largest_displacement_m = 2e-3
    magnet_part, cause_part, noise_part = np.random.SeedSequence(seed).spawn(3)
    generator = np.random.default_rng(cause_part)
    nominal = magnet_of(study)
    magnet = draw_magnet(study, nominal, np.random.default_rng(magnet_part)).mounted
    points = points_from(study.observation.positions)
    angle = np.arctan2(points[:, 1], points[:, 0]).round(9)
    radius = np.hypot(points[:, 0], points[:, 1]).round(9)
    keys = [(radius, angle, points[:, 2]), (points[:, 2], angle, radius)][generator.integers(2)]
    points = points[np.lexsort(keys)]
    check_air(magnet, points, len(points))
    sigma = point_noise(study, points)

    def field_at(places: Floats) -> Floats:
        check_air(magnet, places, len(places))
        return true_field(magnet, places)

    chosen = families()[generator.integers(len(families()))] if family is None else family
    ideal = field_at(points)
    if chosen[0] == "source":
        axes: tuple[int, ...] = (0, 1, 2)
        change = source_field(chosen[1], site_of(study, nominal).outer, points, generator)
        change *= strength(generator) / rms(change / sigma)
    else:
        axes = ((0,), (1,), (2,), (0, 1, 2))[generator.integers(4)]
        time = np.arange(len(points)) / max(1, len(points) - 1)
        functions = np.zeros(points.shape)
        for axis in axes:
            functions[:, axis] = random_function(
                coordinate_of(chosen[1], points, time, ideal), chosen[1] == "angle",
                chosen[2] == "smooth", generator)
        if chosen[0] == "readings":
            change = functions * strength(generator) * np.nanmean(sigma)
        else:
            per_trial = field_at(points + trial_displacement_m * functions) - ideal
            wanted = strength(generator) / rms(per_trial / sigma) * trial_displacement_m
            change = field_at(points + min(wanted, largest_displacement_m) * functions) - ideal
    readings = ideal + change
    noise = np.random.default_rng(noise_part).standard_normal(points.shape)
    data = field_map(points, readings + np.nan_to_num(sigma) * noise).assign(
        time_s=("point", SECONDS * np.arange(len(points))))
    return data, UnlistedCause(*chosen, axes, rms(change), rms(change / sigma))


def rms(values: Floats) -> float:
    """Return the root mean square, NaN left out."""
    return float(np.sqrt(np.nanmean(values**2)))


def strength(generator: np.random.Generator) -> float:
    """Draw a size from `SIZES`, equally probable per octave."""
    return float(np.exp(generator.uniform(*np.log(SIZES))))


def coordinate_of(name: str, points: Floats, time: Floats, field: Floats) -> Floats:
    """Return the coordinate (n,) of each point, scaled to a range of 1; angles stay in rad."""
    if name == "angle":
        return np.arctan2(points[:, 1], points[:, 0])
    value = {"z": points[:, 2], "radius": np.hypot(points[:, 0], points[:, 1]), "time": time,
             "field": np.linalg.norm(field, axis=1)}[name]
    return np.asarray((value - value.min()) / (np.ptp(value) or 1.0))


def random_function(
    coordinate: Floats, periodic: bool, smooth: bool, generator: np.random.Generator
) -> Floats:
    """Return values (n,) of a Gaussian process of variance 1, with an rms of 1 at the points."""
    # Correlation lengths as fractions of the range of the coordinate (of the circle's radius for
    # angles).
    rough_lengths = (0.04, 0.12)
    places, inverse = np.unique(coordinate.round(9), return_inverse=True)
    apart = np.abs(places[:, None] - places)
    if periodic:
        apart = 2 * np.sin(apart / 2)
    length = generator.uniform(*(SMOOTH_LENGTHS if smooth else rough_lengths))
    scaled = apart / (length * (2.0 if periodic else 1.0))
    covariance = np.exp(-scaled**2 / 2) if smooth else np.exp(-scaled)
    values, vectors = np.linalg.eigh(covariance)  # chordal distances and rounding: near-zero ones
    drawn = vectors @ (np.sqrt(np.maximum(values, 0.0)) * generator.standard_normal(len(places)))
    return np.asarray(drawn[inverse] / rms(drawn[inverse]))


def source_field(
    name: str, outer: float, points: Floats, generator: np.random.Generator
) -> Floats:
    """Return B (n, 3) in T of a source beside a magnet of outer radius ``outer`` in m.

    Its strength is arbitrary, its place, size and direction are drawn.
    """
    magpylib = import_extra("magpylib")
    along = np.ptp(points[:, 2]) / 2

    def place() -> Floats:
        angle, distance = generator.uniform(0, 2 * np.pi), outer * generator.uniform(1.2, 1.8)
        return np.array([distance * np.cos(angle), distance * np.sin(angle),
                         along * generator.uniform(-1, 1)])

    def direction() -> Floats:
        drawn = generator.standard_normal(3)
        return np.asarray(drawn / np.linalg.norm(drawn))

    if name == "loop":
        source = magpylib.current.Circle(
            current=1.0, diameter=2 * outer * generator.uniform(1.1, 1.8),
            position=(0, 0, along * generator.uniform(-1, 1)))
        source.rotate_from_rotvec(0.2 * generator.standard_normal(3))
        return np.asarray(source.getB(points))
    if name == "plate":
        source = magpylib.magnet.Cuboid(
            polarization=direction(), position=(centre := place()),
            dimension=outer * np.array([0.1, *generator.uniform(1, 2, 2)]))
        source.rotate_from_angax(np.degrees(np.arctan2(centre[1], centre[0])), "z", anchor=None)
        return np.asarray(source.getB(points))
    return np.asarray(sum(magpylib.misc.Dipole(
        moment=direction() * generator.uniform(0.5, 1.5), position=place()).getB(points)
        for _ in range(generator.integers(3, 6))))
