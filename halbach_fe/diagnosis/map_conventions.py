"""Conventions by which a map can be misread: units, axes, another magnet, and positions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.measurement.probe_law import to_magnet_axes
from halbach_fe.study.array_keys import check_order
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS, Axes, Component

LENGTH_UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 0.0254: "inches"}
"""Length units by their size in m."""

FLUX_DENSITY_UNITS = {1e-3: "millitesla", 1e-4: "gauss", 0.1: "kilogauss"}
"""Flux density units by their size in T."""

ALL_AXES: tuple[Axes, ...] = tuple(
    tuple(sign + name for sign, name in zip(signs, names, strict=True))  # type: ignore[misc]
    for names in permutations(COMPONENTS) for signs in product(("", "-"), repeat=3))
"""All assignments of three columns to signed axes."""

IDENTITY_AXES: Axes = ("x", "y", "z")
"""Columns along x, y and z."""


@dataclass(frozen=True)
class ArrayVariant:
    """A magnet that may have been measured in place of the study's."""

    name: str
    """Standard name of the error."""
    title: str
    """Description for a report."""
    change: Callable[[Study], Study] = field(compare=False)
    """From the study to that of the true magnet."""
    turn_rad: float | None = None
    """Angle by which the magnetization of each block is turned, if this is the only difference."""


@dataclass(frozen=True)
class MapConvention:
    """The convention by which a map is to be read, and the magnet that it shows.

    The defaults are those of the study. Each difference from them is a gross error.
    """

    length_unit: float = 1.0
    flux_density_unit: float = 1.0
    """Units of the map in the study's units."""
    positions: Axes = IDENTITY_AXES
    fields: Axes = IDENTITY_AXES
    """Axes of the columns, see `halbach_fe.study.measurement_keys.Instrument`."""
    magnet: ArrayVariant | None = None
    """The magnet that was measured in place of the study's."""
    radius: float = 1.0
    """Factor of the points' distances from the axis."""
    offset_m: float = 0.0
    """Offset of the points' distances from the axis."""
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement of all points."""
    components: tuple[Component, ...] = ()
    """Components that the map shows and the study does not observe, such as z if it is what a study
    of y alone calls so."""

    @property
    def errors(self) -> tuple[tuple[str, str], ...]:
        """Standard name and description of each error."""
        found = []
        if self.length_unit != 1:
            name = LENGTH_UNITS[self.length_unit]
            found.append((name, f"coordinates in {name}"))
        if self.flux_density_unit != 1:
            name = FLUX_DENSITY_UNITS[self.flux_density_unit]
            found.append((name, f"flux densities in {name}"))
        found += axis_errors(self.positions, self.fields)
        if self.magnet:
            found.append((self.magnet.name, self.magnet.title))
        if self.radius != 1:
            found.append(("wrong_radius", f"{self.radius:.3g} times the map's radius"))
        if self.offset_m:
            found.append(("wrong_radius", f"points {1e3 * self.offset_m:.1f} mm farther out"))
        if any(self.shift_m):
            shift = ", ".join(f"{1e3 * component:.1f}" for component in self.shift_m)
            found.append(("wrong_line", f"points displaced by ({shift}) mm"))
        return tuple(found)

    @property
    def is_only_elsewhere(self) -> bool:
        """Whether it changes nothing but the radius of the points, or their place."""
        return replace(self, radius=1.0, offset_m=0.0, shift_m=(0.0, 0.0, 0.0)).errors == ()

    @property
    def names(self) -> tuple[str, ...]:
        """Standard names of the errors."""
        return tuple(name for name, _ in self.errors)

    @property
    def text(self) -> str:
        """Description of all errors in one phrase."""
        return " and ".join(text for _, text in self.errors)

    def apply(self, study: Study) -> Study:
        """Return the study that reads the map by this convention.

        Raises
        ------
        ValidationError
            If no valid study has this convention.
        """
        if self.magnet:
            study = self.magnet.change(study)
        old = study.instrument
        changes = {
            "length_unit_m": old.length_unit_m * self.length_unit,
            "flux_density_unit_T": old.flux_density_unit_T * self.flux_density_unit,
            "position_axes": compose_axes(old.position_axes, self.positions),
            "field_axes": compose_axes(old.field_axes, self.fields),
            "radius_scale": (1 + old.radius_scale) * self.radius - 1,
            "radius_offset_m": old.radius_offset_m * self.radius + self.offset_m,
            "translation_m": tuple(np.add(old.translation_m, self.shift_m).tolist())}
        study = study.with_(instrument=old.with_(**changes))
        observed = study.observation
        if not self.components or observed.quantity != "flux_density":
            return study
        return study.with_(observation=observed.with_(
            components=(*observed.components, *self.components)))


def array_variants(study: Study) -> tuple[ArrayVariant, ...]:
    """Return magnets that may have been measured by mistake in place of the study's."""
    # Largest difference between the numbers of rings of the true magnet and of the study's.
    max_ring_difference = 4
    array = study.array
    if not array.is_uniform:
        return ()
    pitch = 360.0 / array.blocks_per_ring
    found: list[ArrayVariant] = []
    is_round = study.iron is None or build_magnet(study).iron_is_axisymmetric
    for blocks in range(1 - array.blocks_per_ring // 2, array.blocks_per_ring // 2 + 1):
        if blocks and is_round:  # other iron would have to turn, too
            angle = blocks * pitch
            found.append(ArrayVariant(
                "rotated_by_one_block", f"the map turned by {_count(blocks, 'block')}",
                partial(_rotated_magnet, angle_deg=-angle),
                # a rotation by whole blocks changes the magnetizations, but not the positions
                turn_rad=float(np.radians(array.multipole_order * angle))))
    turns = {round(pitch * k, 9) for k in range(1, array.blocks_per_ring)} | {
        45.0 * k for k in range(1, 8)}
    for angle in sorted(turns, key=lambda turn: (turn % 90 != 0, turn)):
        found.append(ArrayVariant(
            "wrong_magnetization_direction", f"all magnetizations turned by {angle:g} deg",
            partial(_with_array, first_magnetization_angle_deg=_wrapped(
                array.first_magnetization_angle_deg + angle)),
            turn_rad=float(np.radians(angle))))
    if study.dimension == 3:
        fewest = max(1, array.rings - max_ring_difference)
        for rings in range(fewest, array.rings + max_ring_difference + 1):
            if rings != array.rings:
                found.append(ArrayVariant(
                    "wrong_ring_count", f"a magnet of {_count(rings, 'ring')}",
                    partial(_with_array, rings=rings)))
    for order in range(1, 5):
        if order != array.multipole_order and _is_possible(order, array.blocks_per_ring):
            found.append(ArrayVariant(
                "wrong_multipole_order", f"a magnet of multipole order {order}",
                partial(_with_array, multipole_order=order)))
    return tuple(found)


def _is_possible(order: int, blocks: int) -> bool:
    """Tell whether a ring of so many blocks can make a multipole of this order."""
    try:
        check_order(order, blocks)
    except ValueError:
        return False
    return True


def _rotated_magnet(study: Study, angle_deg: float) -> Study:
    """Return the study with magnet and external sources rotated about the magnet's axis."""
    turn = rotation_matrix((0.0, 0.0, float(np.radians(angle_deg))))

    def around(vector: tuple[float, float, float]) -> tuple[float, ...]:
        return tuple((turn @ vector).tolist())

    array, external = study.array, study.external
    exceptions = tuple(exception.with_(
        shift_m=around(exception.shift_m), tilt_deg=around((*exception.tilt_deg, 0.0))[:2],
        magnetization_angle_deg=None if exception.magnetization_angle_deg is None
        else _wrapped(exception.magnetization_angle_deg + angle_deg))
        for exception in array.exceptions)
    dipoles = tuple(
        dipole.with_(position_m=around(dipole.position_m), moment_A_m2=around(dipole.moment_A_m2))
        for dipole in external.dipoles)
    coils = tuple(coil.with_(centre_m=around(coil.centre_m), rotation_deg=tuple(np.degrees(
        Rotation.from_matrix(turn @ rotation_matrix(tuple(np.radians(coil.rotation_deg).tolist()))
                             ).as_rotvec()).tolist())) for coil in external.coils)
    return _with_array(
        study, exceptions=exceptions,
        first_block_angle_deg=_wrapped(array.first_block_angle_deg + angle_deg),
        first_magnetization_angle_deg=_wrapped(array.first_magnetization_angle_deg + angle_deg),
    ).with_(external=external.with_(
        background_T=around(external.background_T), dipoles=dipoles, coils=coils))


def _with_array(study: Study, **keys: object) -> Study:
    """Return the study with other keys of its array."""
    return study.with_(array=study.array.with_(**keys))


def _wrapped(angle_deg: float) -> float:
    """Return an angle in the range from 0 to 360 deg, without rounding errors."""
    return round(angle_deg % 360.0, 9)


def _count(number: int, noun: str) -> str:
    """Return a number with a noun, in the plural if needed."""
    return f"{number} {noun}{'s' if abs(number) != 1 else ''}"


def _matrix(axes: Axes) -> Floats:
    """Return the matrix whose product with columns (n, 3), from the right, is along x, y, z."""
    return to_magnet_axes(axes, np.eye(3))


@cache
def compose_axes(first: Axes, second: Axes) -> Axes:
    """Return the axes that correct columns which were already converted by other axes."""
    rows = _matrix(first) @ _matrix(second)
    x, y, z = (("-" if row.sum() < 0 else "") + COMPONENTS[int(np.argmax(np.abs(row)))]
               for row in rows)
    return x, y, z  # type: ignore[return-value]


def axis_errors(positions: Axes, fields: Axes) -> tuple[tuple[str, str], ...]:
    """Return the errors of axes: exchanged columns, and columns of the wrong sign.

    An exchange that coordinates and field have in common counts as one error, and so does a common
    sign.
    """
    found = []
    order, field_order = (tuple(axis[-1] for axis in axes) for axes in (positions, fields))
    both = order == field_order
    for columns, axes in (("x, y, z and Bx, By, Bz", order),) if both else (
            ("x, y, z", order), ("Bx, By, Bz", field_order)):
        if axes != IDENTITY_AXES:
            found.append(("swapped_axes", f"columns {columns} that are along {', '.join(axes)}"))
    for name in COMPONENTS:
        signs = f"-{name}" in positions, f"-{name}" in fields
        if any(signs):
            columns = {(True, False): name, (False, True): f"B{name}",
                       (True, True): f"{name} and B{name}"}[signs]
            reverse = name == "z" and signs[0]
            found.append(("reversed_z" if reverse else "sign_flipped_axis",
                          f"{columns} with the wrong sign"))
    return tuple(found)


def _field_axes_by_error_count() -> dict[Axes, dict[int, list[Axes]]]:
    """Return the axes of the field by axes of the coordinates and number of errors of both."""
    found: dict[Axes, dict[int, list[Axes]]] = {}
    for positions, fields in product(ALL_AXES, repeat=2):
        count = len(axis_errors(positions, fields))
        found.setdefault(positions, {}).setdefault(count, []).append(fields)
    return found


FIELD_AXES_BY_ERROR_COUNT = _field_axes_by_error_count()
"""Axes of the field, by the axes of the coordinates and by the number of errors of both."""

ERRORS_BY_PLAUSIBILITY = (
    *LENGTH_UNITS.values(), *FLUX_DENSITY_UNITS.values(), "reversed_z", "sign_flipped_axis",
    "swapped_axes", "rotated_by_one_block", "wrong_magnetization_direction", "wrong_ring_count",
    "wrong_multipole_order", "wrong_radius", "wrong_line")
"""Standard names of all gross errors. Of errors that a map does not distinguish, the first in this
order is corrected."""


def rank(convention: MapConvention) -> tuple[int, ...]:
    """Return a key that sorts equivalent conventions by their plausibility."""
    turn = convention.magnet.turn_rad if convention.magnet and convention.magnet.turn_rad else 0.0
    order = (ERRORS_BY_PLAUSIBILITY.index(name) for name in convention.names)
    return (*order, round(1e3 * abs(turn)))
