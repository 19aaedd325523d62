"""How a map may be misread (units, axes, magnet, places), and the study that reads it right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import permutations, product

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.measurement.instrument import along_axes
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS, Axes

LENGTHS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches"}
FLUX_DENSITIES = {1e-3: "millitesla", 1e-4: "gauss", 0.1: "kilogauss"}
RINGS = 4
"""More or less than the study has, at most."""

ALL_AXES: tuple[Axes, ...] = tuple(
    tuple(sign + name for sign, name in zip(signs, names, strict=True))  # type: ignore[misc]
    for names in permutations(COMPONENTS) for signs in product(("", "-"), repeat=3))
SAME: Axes = ("x", "y", "z")


@dataclass(frozen=True)
class ArrayVariant:
    """Another magnet than the study's: the name of the error, in words, and the right study.

    ``turn_rad`` is by how much the magnetization of each block is turned, if that is all.
    """

    name: str
    title: str
    change: Callable[[Study], Study] = field(compare=False)
    turn_rad: float | None = None


@dataclass(frozen=True)
class MapConvention:
    """How a map is to be read, and of what magnet: gross errors put right.

    Attributes
    ----------
    length_unit, flux_density_unit : float
        In m and T.
    positions, fields : tuple of str
        Axes of the columns, see `halbach_fe.study.measurement.Instrument`.
    magnet : Magnet or None
    radius : float
        Factor of the distances from the axis.
    offset_m : float
        Added to them.
    shift_m : tuple of float
        Of the points.
    """

    length_unit: float = 1.0
    flux_density_unit: float = 1.0
    positions: Axes = SAME
    fields: Axes = SAME
    magnet: ArrayVariant | None = None
    radius: float = 1.0
    offset_m: float = 0.0
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def errors(self) -> tuple[tuple[str, str], ...]:
        """Standard names of the errors, and what each is in words."""
        found = []
        if self.length_unit != 1:
            name = LENGTHS[self.length_unit]
            found.append((name, f"coordinates in {name}"))
        if self.flux_density_unit != 1:
            name = FLUX_DENSITIES[self.flux_density_unit]
            found.append((name, f"flux densities in {name}"))
        found += axis_errors(self.positions, self.fields)
        if self.magnet:
            found.append((self.magnet.name, self.magnet.title))
        if self.radius != 1:
            found.append(("wrong_radius", f"{self.radius:.3g} times the map's radius"))
        if self.offset_m:
            found.append(("wrong_radius", f"points {1e3 * self.offset_m:.1f} mm farther out"))
        if any(self.shift_m):
            shift = ", ".join(f"{1e3 * one:.1f}" for one in self.shift_m)
            found.append(("wrong_line", f"points that are off by ({shift}) mm"))
        return tuple(found)

    @property
    def names(self) -> tuple[str, ...]:
        """Standard names of the errors."""
        return tuple(name for name, _ in self.errors)

    @property
    def text(self) -> str:
        """The errors in words."""
        return " and ".join(text for _, text in self.errors)

    def apply(self, study: Study) -> Study:
        """The study that reads the map right.

        Raises
        ------
        ValidationError
            If there is no such study.
        """
        if self.magnet:
            study = Study.model_validate(self.magnet.change(study).model_dump())
        old = study.instrument
        changes = {
            "length_unit_m": old.length_unit_m * self.length_unit,
            "flux_density_unit_T": old.flux_density_unit_T * self.flux_density_unit,
            "position_axes": then(old.position_axes, self.positions),
            "field_axes": then(old.field_axes, self.fields),
            "radius_scale": (1 + old.radius_scale) * self.radius - 1,
            "radius_offset_m": old.radius_offset_m * self.radius + self.offset_m,
            "translation_m": tuple(np.add(old.translation_m, self.shift_m).tolist())}
        return study.with_(instrument=old.with_(**changes))


def array_variants(study: Study) -> tuple[ArrayVariant, ...]:
    """Magnets that may be another than the study's by mistake."""
    array = study.array
    pitch = 360.0 / array.blocks_per_ring
    found = []
    for blocks in range(1 - array.blocks_per_ring // 2, array.blocks_per_ring // 2 + 1):
        if blocks:
            angle = blocks * pitch
            found.append(ArrayVariant(
                "rotated_by_one_block", f"the map turned by {_count(blocks, 'block')}",
                partial(turned_magnetizations, angle_deg=-angle),
                # in its places, an array that is turned differs in its magnetization only
                turn_rad=float(np.radians(array.multipole_order * angle))))
    turns = {round(pitch * k, 9) for k in range(1, array.blocks_per_ring)} | {
        45.0 * k for k in range(1, 8)}
    for angle in sorted(turns, key=lambda one: (one % 90 != 0, one)):
        found.append(ArrayVariant(
            "wrong_magnetization_direction", f"all magnetizations turned by {angle:g} deg",
            partial(_with_array, first_magnetization_angle_deg=_wrapped(
                array.first_magnetization_angle_deg + angle)),
            turn_rad=float(np.radians(angle))))
    if study.dimension == 3:
        for rings in range(max(1, array.rings - RINGS), array.rings + RINGS + 1):
            if rings != array.rings:
                found.append(ArrayVariant(
                    "wrong_ring_count", f"a magnet of {_count(rings, 'ring')}",
                    partial(_with_array, rings=rings)))
    for order in range(1, 5):
        if order != array.multipole_order:
            found.append(ArrayVariant(
                "wrong_multipole_order", f"a magnet of multipole order {order}",
                partial(_with_array, multipole_order=order)))
    return tuple(found)


def turned_magnetizations(study: Study, angle_deg: float) -> Study:
    """The same magnet, turned about its axis with all that is around it."""
    turn = rotation_matrix((0.0, 0.0, float(np.radians(angle_deg))))

    def around(vector: tuple[float, float, float]) -> tuple[float, ...]:
        return tuple((turn @ vector).tolist())

    array, external = study.array, study.external
    exceptions = tuple(one.with_(
        shift_m=around(one.shift_m),
        magnetization_angle_deg=None if one.magnetization_angle_deg is None
        else _wrapped(one.magnetization_angle_deg + angle_deg)) for one in array.exceptions)
    dipoles = tuple(
        one.with_(position_m=around(one.position_m), moment_A_m2=around(one.moment_A_m2))
        for one in external.dipoles)
    return _with_array(
        study, exceptions=exceptions,
        first_block_angle_deg=_wrapped(array.first_block_angle_deg + angle_deg),
        first_magnetization_angle_deg=_wrapped(array.first_magnetization_angle_deg + angle_deg),
    ).with_(external=external.with_(background_T=around(external.background_T), dipoles=dipoles))


def _with_array(study: Study, **keys: object) -> Study:
    return study.with_(array=study.array.with_(**keys))


def _wrapped(angle_deg: float) -> float:
    return round(angle_deg % 360.0, 9)


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'s' if abs(number) != 1 else ''}"


def _matrix(axes: Axes) -> Floats:
    """From columns (n, 3), by product from the right, to components."""
    return along_axes(axes, np.eye(3))


def then(first: Axes, second: Axes) -> Axes:
    """Axes that put the columns right that were put along the first ones wrongly."""
    rows = _matrix(first) @ _matrix(second)
    x, y, z = (("-" if row.sum() < 0 else "") + COMPONENTS[int(np.argmax(np.abs(row)))]
               for row in rows)
    return x, y, z  # type: ignore[return-value]


def axis_errors(positions: Axes, fields: Axes) -> tuple[tuple[str, str], ...]:
    """Columns exchanged, then of the wrong sign: in coordinates, in B, or alike in both."""
    found = []
    order, field_order = (tuple(axis[-1] for axis in axes) for axes in (positions, fields))
    both = order == field_order
    for what, one in (("x, y, z and Bx, By, Bz", order),) if both else (
            ("x, y, z", order), ("Bx, By, Bz", field_order)):
        if one != SAME:
            found.append(("swapped_axes", f"columns {what} that are along {', '.join(one)}"))
    for name in COMPONENTS:
        signs = f"-{name}" in positions, f"-{name}" in fields
        if any(signs):
            what = {(True, False): name, (False, True): f"B{name}",
                    (True, True): f"{name} and B{name}"}[signs]
            reverse = name == "z" and signs[0]
            found.append(("reversed_z" if reverse else "sign_flipped_axis",
                          f"{what} with the wrong sign"))
    return tuple(found)


def _by_errors() -> dict[Axes, dict[int, list[Axes]]]:
    """For axes of the coordinates, those of B by the number of errors of both."""
    found: dict[Axes, dict[int, list[Axes]]] = {}
    for positions, fields in product(ALL_AXES, repeat=2):
        count = len(axis_errors(positions, fields))
        found.setdefault(positions, {}).setdefault(count, []).append(fields)
    return found


AXES_BY_ERRORS = _by_errors()

PLAUSIBLE = (
    *LENGTHS.values(), *FLUX_DENSITIES.values(), "reversed_z", "sign_flipped_axis", "swapped_axes",
    "rotated_by_one_block", "wrong_magnetization_direction", "wrong_ring_count",
    "wrong_multipole_order", "wrong_radius", "wrong_line")
"""Of errors that a map does not tell apart, the first is put right."""


def rank(reading: MapConvention) -> tuple[int, ...]:
    """Order of readings that explain a map equally."""
    turn = reading.magnet.turn_rad if reading.magnet and reading.magnet.turn_rad else 0.0
    return (*(PLAUSIBLE.index(name) for name in reading.names), round(1e3 * abs(turn)))
