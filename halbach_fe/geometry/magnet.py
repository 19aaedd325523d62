"""The magnet that a study describes: its blocks, its iron, and its outer dimensions.

`build_magnet` builds it once; all functions that compute a field take it as an argument.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from halbach_fe.core.arrays import Bools, Floats, box_middle, radii_of
from halbach_fe.core.errors import HalbachWarning, StudyError, must_be
from halbach_fe.core.interface import ShownInNotebook, typed
from halbach_fe.geometry.array_layout import blocks_of_array, nominal_blocks, ring_limits
from halbach_fe.geometry.blocks import (
    MagnetBlock,
    bore_radius,
    moved_block,
    present_blocks,
    rotation_matrix,
)
from halbach_fe.geometry.coils import (
    closest,
    distance_in_magnet,
    in_winding,
    points_in_winding,
    runs_into,
)
from halbach_fe.geometry.iron import IronSolid, check_iron_ring, iron_solids
from halbach_fe.geometry.outline import at_heights, points_on
from halbach_fe.geometry.overlaps import (
    SQUEEZED,
    block_in_iron,
    block_in_others,
    overlapping_blocks,
    points_of_block,
)
from halbach_fe.geometry.surface import Body, Surroundings, surroundings
from halbach_fe.study.array_keys import Array
from halbach_fe.study.external_keys import AnyCoil, External, Neighbour
from halbach_fe.study.iron_keys import Iron, IronRing
from halbach_fe.study.materials import Curve, Demagnetization
from halbach_fe.study.model import MAGNET_KEYS, Study, curve_of, is_nonlinear
from halbach_fe.study.types import COMPONENTS, look_like_mm

SOLVED_BY = "halbach_fe.solver.routes"
"""The module that solves for the field of a magnet."""


@dataclass(frozen=True)
class Magnet(ShownInNotebook):
    """The blocks of a magnet, together with the study that describes them.

    Use `build_magnet` to make one.

    Attributes
    ----------
    study : Study
    blocks : tuple of MagnetBlock
        Ring by ring (lowest z first), slot by slot.
    parameter_names : tuple of str
        Names of the magnetization components that the inference determines, block by block.
    nominal_magnetization : ndarray, shape (parameters,), in A/m
        Nominal values of these components.
    radius, half_length : float
        Outer radius and half the length of the magnet in m, including its iron; the length of a 2D
        magnet is infinite.

    Examples
    --------
    >>> from halbach_fe.study.reader import parse_study
    >>> magnet = build_magnet(parse_study({
    ...     "name": "ring", "dimension": 2, "mesh": {"block_size_m": 0.01},
    ...     "array": {"blocks_per_ring": 8, "inner_radius_m": 0.05, "outer_radius_m": 0.08,
    ...               "remanence_T": 1.3, "block": {"shape": "sector"}},
    ...     "observation": {"quantity": "flux_density", "positions": {
    ...         "kind": "points", "points_m": [[0, 0, 0]]}}}))
    >>> len(magnet.blocks), round(magnet.radius, 6), magnet.parameter_names[:2]
    (8, 0.08, ('r01s01.Mx', 'r01s01.My'))
    """

    study: Study
    blocks: tuple[MagnetBlock, ...]

    @property
    def name(self) -> str:
        """Name of the study."""
        return self.study.name

    @property
    def dimension(self) -> int:
        """2 for a cross-section, 3 for a magnet of finite length."""
        return self.study.dimension

    @property
    def array(self) -> Array:
        """The array of blocks as the study gives it."""
        return self.study.array

    @cached_property
    def iron(self) -> tuple[IronSolid, ...]:
        """The bodies of iron; none if the magnet has no iron."""
        study = self.study
        return iron_solids(self.dimension, study.iron_ring, study.iron, self.array_half_length)

    @property
    def iron_permeability(self) -> float:
        """Constant relative permeability of the iron; 1 without iron or with a curve."""
        law = self.iron[0].law if self.iron else 1.0
        return law if isinstance(law, float) else 1.0

    @property
    def iron_is_axisymmetric(self) -> bool:
        """Whether all bodies of iron are coaxial tubes or discs."""
        return all(body.is_coaxial for body in self.iron)

    @property
    def iron_is_along_z(self) -> bool:
        """Whether the iron is of one material, and of prisms along z and coaxial tubes or discs."""
        laws = {body.law if isinstance(body.law, float) else id(body.law) for body in self.iron}
        return len(laws) < 2 and all(body.in_place and not body.sphere for body in self.iron)

    @property
    def external(self) -> External:
        """Sources of magnetic field outside the magnet."""
        return self.study.external

    @cached_property
    def curve(self) -> Curve | None:
        """Magnetization curve of the iron, or None if there is none."""
        return curve_of(self.study)

    @property
    def is_nonlinear(self) -> bool:
        """Whether the field is a non-linear function of the magnetizations (iron with a curve)."""
        return is_nonlinear(self.study)

    @property
    def materials(self) -> tuple[str | None, ...]:
        """Name of the grade of every block; None where the study names none."""
        return tuple(name for name, _ in self.array.grades)

    @cached_property
    def demagnetizations(self) -> tuple[Demagnetization, ...]:
        """What the material of every block withstands, see `Study.demagnetization_of`."""
        known = {name: self.study.demagnetization_of(name) for name in dict.fromkeys(
            self.materials)}
        return tuple(known[name] for name in self.materials)

    @property
    def has_losses(self) -> bool:
        """Whether the blocks have lost remanence irreversibly in the field that they are in."""
        return self.study.demagnetization is not None and self.study.demagnetization.irreversible

    @cached_property
    def is_vacuum(self) -> bool:
        """Whether all permeabilities are 1 and nothing is lost, so that the closed-form field needs
        no correction.
        """
        return not self.has_losses and not self.iron and not any(
            block.is_permeable for block in self.blocks)

    @property
    def nominal_magnetization(self) -> Floats:
        """Nominal M of all blocks, (parameters,) in A/m; two components per block in 2D."""
        return self._nominal_magnetization.copy()  # whoever changes it changes no later answer

    @cached_property
    def _nominal_magnetization(self) -> Floats:
        return np.concatenate([block.magnetization[:self.dimension] for block in self.blocks])

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the magnetization parameters; ``r01s05.Mx`` is M_x of ring 1, slot 5."""
        components = COMPONENTS[:self.dimension]
        return tuple(f"{block.name}.M{c}" for block in self.blocks for c in components)

    @cached_property
    def ring_limits(self) -> tuple[tuple[float, float], ...]:
        """Limits of z in m of every ring without its free blocks; infinite in 2D."""
        return tuple(ring_limits(self.array, self.dimension))

    @cached_property
    def blocks_by_ring(self) -> tuple[int, ...]:
        """Number of slots of every ring; free blocks form rings after the others."""
        return self.array.blocks_by_ring

    @cached_property
    def _numbers(self) -> dict[tuple[int, int], int]:
        return {block.place: number for number, block in enumerate(self.blocks)}

    def number_of(self, ring: int, slot: int) -> int:
        """Return the number of a block, from 0 in the order of `blocks`.

        Raises
        ------
        KeyError
            If there is no such block.
        """
        return self._numbers[ring, slot]

    def by_ring(self, values: Floats) -> Floats:
        """Return values of blocks (blocks,) as a table (rings, slots), NaN where no block is."""
        table = np.full((len(self.blocks_by_ring), max(self.blocks_by_ring)), np.nan)
        for value, block in zip(values, self.blocks, strict=True):
            table[block.ring - 1, block.slot - 1] = value
        return table

    @cached_property
    def _corners(self) -> tuple[Floats, ...]:
        """Points (n, 3) in m on the edges of every block's nominal place.

        z is 0 for infinite blocks.
        """
        found = []
        for block in self.blocks:
            ends = (0.0,) if np.isinf(block.z_max) else (block.z_min, block.z_max)
            points = at_heights(points_on(block.outline), *ends)
            found.append(points @ rotation_matrix(block.orientation_rad).T + block.origin_m)
        return tuple(found)

    @cached_property
    def ring_sections(self) -> tuple[tuple[tuple[float, float], tuple[float, float]], ...]:
        """Limits of z and of the distance from the z axis, in m, of every ring in 3D.

        Free blocks of the same height count as a ring.
        """
        found: dict[int, list[Floats]] = {}
        for block, points in zip(self.blocks, self._corners, strict=True):
            found.setdefault(block.ring, []).append(points)
        sections = []
        for points in map(np.vstack, found.values()):
            radius = radii_of(points)
            sections.append(((float(points[:, 2].min()), float(points[:, 2].max())),
                             (float(radius.min()), float(radius.max()))))
        return tuple(sections)

    @cached_property
    def array_ends(self) -> tuple[float, float]:
        """Smallest and largest z in m of the nominal blocks; infinite in 2D."""
        if self.dimension == 2:
            return -np.inf, np.inf
        heights = np.concatenate([points[:, 2] for points in self._corners])
        return float(heights.min()), float(heights.max())

    @property
    def array_half_length(self) -> float:
        """Largest |z| in m of the nominal blocks; infinite in 2D."""
        return max(map(abs, self.array_ends))

    @cached_property
    def array_outer_radius(self) -> float:
        """Radius in m of the smallest cylinder about the z axis around all nominal blocks."""
        return max(float(np.hypot(*points[:, :2].T).max()) for points in self._corners)

    @property
    def field_reach(self) -> float:
        """Distance in m from the origin up to which there is some field; of a 3D magnet."""
        # distance by which the field is summed beyond the ends, relative to the magnet's outer
        # radius, of what permeability and iron add: `halbach_fe.response.multipoles`. It falls as
        # 1/z^3, so that about 1e-3 of its integral of order 1 lies beyond. The distance is half of
        # that to the boundary of 3D meshes.
        reach_per_radius = 4.5
        return self.half_length + reach_per_radius * self.radius

    def refuse_without_field(self, what: str, distance_m: float, given: str) -> None:
        """Raise StudyError if what reaches ``distance_m`` from the origin has hardly any field."""
        if distance_m > self.field_reach:
            in_mm = look_like_mm(np.array([[distance_m, 0.0, 0.0]]),
                                 max(self.radius, self.half_length))[0]
            raise StudyError(must_be(
                what, f"study {self.name}", f"within {self.field_reach:.3g} m of the origin, where "
                "there is some field of the magnet", given, "Was it meant in millimetres?" if in_mm
                else "Stay nearer to the magnet."))

    @cached_property
    def middle_z_m(self) -> float:
        """Place in m of the middle along z: 0 of stacks of rings, else halfway between the ends."""
        stacked = not self.array.free_blocks and all(ring.z_m is None for ring in self.array.ring)
        if self.dimension == 2 or stacked:
            return 0.0
        low, high = self.array_ends
        # what is left of blocks about z = 0 by rounding, relative to their length
        rounding = 1e-9
        return 0.0 if abs(low + high) / 2 < rounding * (high - low) else (low + high) / 2

    @cached_property
    def middle_m(self) -> tuple[float, float, float]:
        """Middle of the magnet in m: on the z axis, unless blocks are around another axis and that
        one lies beside them all.
        """
        places = np.array([block.middle[:2] for block in self.blocks])
        x, y = middle = box_middle(places)
        is_beside = np.hypot(*middle) > radii_of(places - middle).max()
        if is_beside and self._is_around(x, y):
            return float(x), float(y), self.middle_z_m
        return 0.0, 0.0, self.middle_z_m

    @property
    def axis_beside(self) -> str:
        """Advice if the z axis, about which multipoles are, lies beside the blocks; else empty."""
        x, y, _ = self.middle_m
        if not (x or y):
            return ""
        change = [round(-each, 7) + 0.0 for each in (x, y)]
        rows = " and ".join(f"{each:g} to {axis}_m" for each, axis in zip(
            change, "xy", strict=True) if each)
        return (f"The blocks lie around an axis at x = {x:.4g} and y = {y:.4g} m, beside the z "
                f"axis: add {rows} of the table, move what else the study places, and read its "
                f"maps by instrument.translation_m = [{change[0]:g}, {change[1]:g}, 0.0].")

    @cached_property
    def bore_radius(self) -> float:
        """Radius in m of the largest cylinder along z about `middle_m` that the blocks leave free.

        For equal rings it is their inner radius, which corners of turned cuboids may pass. Of a
        magnet without a bore it is a length scale only, see `has_bore`.
        """
        return self.array.inner_radius_m if self.array.is_uniform else self.free_radius

    @cached_property
    def free_radius(self) -> float:
        """The same by the corners of turned cuboids too."""
        return bore_radius(self.blocks, np.array(self.middle_m[:2]))

    @cached_property
    def has_bore(self) -> bool:
        """Whether the z axis is free, with blocks around it and not on one side only."""
        return self._is_around(0.0, 0.0)

    def _is_around(self, x: float, y: float) -> bool:
        """Tell whether a line along z is free, with blocks around it and not on one side only."""
        angles = np.sort([np.arctan2(block.middle[1] - y, block.middle[0] - x)
                          for block in self.blocks])
        widest = np.diff(angles, append=angles[0] + 2 * np.pi).max()
        reach = 0.0 if self.dimension == 2 else self.half_length
        z = np.linspace(-reach, reach, 33)
        axis = np.column_stack([x + 0 * z, y + 0 * z, z])
        # angle in rad beyond half a turn without blocks about the axis, from which blocks are on
        # one side. Two opposite poles leave half a turn, but for the rounding of their tables to
        # micrometres.
        rounding_rad = 1e-6
        return bool(widest < np.pi + rounding_rad and not self.contains(axis).any())

    @cached_property
    def cancels_along_z(self) -> bool:
        """Whether what the blocks make on the z axis cancels along it, as in an undulator.

        Their moments count as dipoles, whose field integrated along z is m / w^2 at a distance w.
        Of a quadrupole there is no field anywhere on the axis, which is no undulator's.
        """
        small, weak = 0.01, 0.1  # of what they could make together: along the axis, and at a place
        blocks = [block for block in present_blocks(self.blocks) if np.hypot(*block.middle[:2])]
        if self.dimension == 2 or not blocks:
            return False
        moments = np.array([block.volume * block.magnetization for block in blocks])
        places = np.array([block.middle for block in blocks])[:, :2] @ [1, 1j]
        apart = np.abs(places) ** 2
        most = small * float(np.sum(np.linalg.norm(moments, axis=1) / apart))
        across = abs(np.sum(moments[:, :2] @ [1, 1j] / places ** 2))
        if not (across <= most and abs(np.sum(moments[:, 2] / apart)) <= most):
            return False
        for z in np.unique([round(block.middle[2], 6) for block in blocks])[:200]:
            away = np.array([0.0, 0.0, z]) - [block.middle for block in blocks]
            far = np.linalg.norm(away, axis=1)[:, None]
            along = np.einsum("ij,ij->i", away, moments)[:, None]
            field = 3 * along * away / far**5 - moments / far**3
            if np.linalg.norm(field.sum(axis=0)) > weak * np.linalg.norm(field, axis=1).sum():
                return True
        return False

    @property
    def iron_half_length(self) -> float:
        """Largest |z| in m of the iron, or of the array without iron; infinite in 2D."""
        if self.dimension == 2 or not self.iron:
            return self.array_half_length
        return max(body.half_length for body in self.iron)

    @cached_property
    def radius(self) -> float:
        """Outer radius in m of the magnet, including its iron."""
        return max([self.array_outer_radius, *(body.radius for body in self.iron)])

    @property
    def half_length(self) -> float:
        """Half the length of the magnet in m, including its iron."""
        return max(self.array_half_length, self.iron_half_length)

    @property
    def half_length_about_middle(self) -> float:
        """Half the length in m, including its iron, of the magnet as seen from `middle_z_m`."""
        ends = np.array([self.array_ends, *(body.ends for body in self.iron)])
        return float(np.abs(ends - self.middle_z_m).max())

    def contains(self, points: Floats) -> Bools:
        """Tell which points (n, 3) in m are not in air.

        These are inside a block, a neighbour's block or the iron, on an edge, or between two bodies
        that touch. A point on a face is in air.
        """
        return self.surroundings(points).no_air

    def surroundings(self, points: Floats) -> Surroundings:
        """Return where points (n, 3) in m lie relative to blocks, neighbours and iron."""
        if not len(points):
            return surroundings((), points)
        size = min(self.dimension, 3)  # blocks of a cross-section have no middle along z
        middles = np.array([block.mounted_middle for block in self.blocks])
        distance, _ = KDTree(points[:, :size]).query(middles[:, :size])
        near = [self.blocks[number] for number in np.flatnonzero(distance <= self._reaches)]
        others = neighbour_blocks(self.blocks, self.external.neighbours)
        found = surroundings((*near, *others, *self.iron), points)
        reach = self.radius if self.dimension == 2 else max(self.radius, self.half_length)
        return replace(found, reach=reach)

    @cached_property
    def _reaches(self) -> Floats:
        """Distance (blocks,) in m from the middle of every block within which it lies.

        The `_corners` of arcs of up to half a turn are at most 0.5 % nearer than the arcs.
        """
        return np.array([
            1.02 * np.linalg.norm((points - block.middle)[:, :self.dimension], axis=1).max()
            for block, points in zip(self.blocks, self._corners, strict=True)])

    def __repr__(self) -> str:
        """Return the name and the size."""
        return f"Magnet({self.name}: {len(self.blocks)} blocks in {self.dimension}D)"

    def field_T(self, points_m: ArrayLike) -> Floats:  # noqa: N802 - T is the unit
        """Return B in T of the nominal magnet at points in air.

        Finite elements are solved where the magnet needs any. `halbach_fe.solve` keeps their files,
        and has error bars.

        Parameters
        ----------
        points_m : array_like, shape (..., 3), in m
            Of a DataArray, DataFrame, Series or dict that names x, y and z, these, in any order.

        Returns
        -------
        ndarray, shape (..., 3), in T

        Raises
        ------
        StudyError
            If a point is not in air.
        """
        # the way to the solver, which is a later room: what a magnet is used for most is a method
        return np.asarray(import_module(SOLVED_BY).field_at(self, points_m))

    def with_(self, **changes: Any) -> Magnet:
        """Return the magnet of the same study with other values of some keys, see `Study.with_`."""
        magnet = self.with_study(self.study.with_(**changes))
        if any(getattr(magnet.study, key) != getattr(self.study, key)
               for key in MAGNET_KEYS | {"external"}):
            known = _doubts_of_sources(self)
            _ask(magnet, [each for each in _doubts_of_sources(magnet) if each not in known])
        return magnet

    def with_study(self, study: Study) -> Magnet:
        """Return the magnet of another study; blocks are built again only if they may differ."""
        same = all(getattr(study, key) == getattr(self.study, key) for key in MAGNET_KEYS)
        if not same:
            return _built(study)
        _check_external(study)
        return Magnet(study, self.blocks)


@typed
def build_magnet(study: Study) -> Magnet:
    """Build the magnet that a study describes.

    Parameters
    ----------
    study : Study
        The study, see `halbach_fe.read_study`.

    Returns
    -------
    Magnet

    Raises
    ------
    StudyError
        If the blocks cannot be built as described, for example because neighbours overlap.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hf.build_magnet(hf.read_study("dipole.toml")).blocks[0].name
    'r01s01'
    """
    magnet = _built(study)
    _ask(magnet, _doubts_of_sources(magnet))
    return magnet


def _doubts_of_sources(magnet: Magnet) -> list[str]:
    """Return sentences about fields from outside that no surroundings have, and about sources that
    are so far from each other along z that this may be in mm; a search may try them.
    """
    doubts = magnet.external.doubts
    if magnet.dimension == 3:
        half = np.array([-0.5, 0.5])
        own = np.array([one.mounted_middle[2] + half * (one.z_max - one.z_min)
                        for one in magnet.blocks])
        ends = np.vstack([own, *(own + one.z_m for one in magnet.external.neighbours), *(
            [body.surface[2].min(), body.surface[2].max()] for body in magnet.iron)])
        ends = ends[np.lexsort(ends.T[::-1])]
        gaps, radius = ends[1:, 0] - np.maximum.accumulate(ends[:-1, 1]), magnet.radius
        if (far := float(gaps.max(initial=0.0))) and look_like_mm(
                np.array([[far, 0.0, 0.0]]), radius)[0]:
            doubts.append(
                f"blocks, neighbours and iron leave {far:.3g} m between each other along z, and "
                f"reach {radius:.3g} m from the axis: there is hardly any field in between. Are "
                "z_m or gaps in mm? Then write 0.01 for 10 mm.")
    return doubts


def _ask(magnet: Magnet, doubts: Sequence[str]) -> None:
    """Warn of what is doubted of a magnet."""
    for doubt in doubts:
        warnings.warn(f"Study {magnet.name}: {doubt}", HalbachWarning, stacklevel=4)


def _built(study: Study) -> Magnet:
    """Return the magnet of a study, see `build_magnet`."""
    magnet = Magnet(study, blocks_of_array(study.array, study.dimension))
    strongest = max(abs(block.remanence) for block in magnet.blocks)
    # smallest remanence in T of a magnet's strongest block; results are relative to it
    weakest_T = 1e-6
    if strongest < weakest_T:
        raise StudyError(must_be(
            "`array`", f"study {study.name}", "a magnet with at least one magnetized block",
            f"{len(magnet.blocks)} blocks that are missing" if not strongest
            else f"{len(magnet.blocks)} blocks of at most {strongest:g} T",
            "Correct remanence_T, or magnetization_factor of the exceptions."))
    if study.dimension == 2 and not magnet.iron_is_along_z:
        raise StudyError(must_be(
            "`iron.bodies`", f"study {study.name}", "tubes and prisms without holes along z, "
            "of one material, since it is 2D", "a body of another shape, place or material",
            "Set dimension = 3, or leave that body out."))
    if study.iron_ring is not None:
        check_iron_ring(study.iron_ring, magnet.array_outer_radius)
    _check_overlaps(study.dimension, study.array, study.iron_ring, study.iron)
    _check_external(study)
    _doubt_metres(magnet)
    _doubt_axis(magnet)
    _doubt_iron(magnet)
    return magnet


def _doubt_metres(magnet: Magnet) -> None:
    """Warn of blocks so large that their lengths may be in mm."""
    reach = magnet.array_outer_radius
    if look_like_mm(np.array([[reach, 0.0, 0.0]]))[0]:
        warnings.warn(f"Blocks of {magnet.name} reach {reach:.3g} m from the z axis. Are their "
                      "lengths in mm? Then write 0.01 for 10 mm.", HalbachWarning, stacklevel=3)


def _doubt_axis(magnet: Magnet) -> None:
    """Warn of blocks around another axis than the z axis, about which all is that turns."""
    if magnet.axis_beside:
        warnings.warn(
            f"Multipoles, circles, rolls, turns of rings and radial displacements of {magnet.name} "
            f"are about the z axis. {magnet.axis_beside}", HalbachWarning, stacklevel=3)


def _doubt_iron(magnet: Magnet) -> None:
    """Warn of iron that is as long as the array, whose middle is elsewhere."""
    iron = magnet.study.iron
    bodies = [magnet.study.iron_ring, *(iron.each if iron else ())]
    if magnet.middle_z_m and any(getattr(body, "length_m", 0.0) is None for body in bodies):
        low, high = magnet.array_ends
        warnings.warn(
            f"Iron of {magnet.name} has no length_m: it is {2 * max(-low, high):.4g} m long, about "
            f"z = 0 or its z_m, and the blocks lie between z = {low:.4g} and {high:.4g} m. State "
            "length_m, and z_m of a tube in iron.bodies.", HalbachWarning, stacklevel=3)


def _check_external(study: Study) -> None:
    """Refuse neighbouring magnets and coils in the place of the magnet."""
    if study.external.neighbours:
        _check_neighbours(study.dimension, study.array, study.iron_ring, study.iron,
                          study.external.neighbours)
    if study.external.coils:
        _check_windings(study.external.coils)
        _check_coils(study.dimension, study.array, study.iron_ring, study.iron,
                     study.external.coils)


def neighbour_blocks(
    blocks: tuple[MagnetBlock, ...], neighbours: tuple[Neighbour, ...]
) -> tuple[MagnetBlock, ...]:
    """Return the blocks of neighbouring magnets, which are those of the magnet, moved."""
    return tuple(moved_block(block, float(np.radians(one.turn_deg)), one.z_m, one.factor)
                 for one in neighbours for block in blocks)


@lru_cache(maxsize=128)
def _check_neighbours(
    dimension: int, array: Array, iron_ring: IronRing | None, iron: Iron | None,
    neighbours: tuple[Neighbour, ...],
) -> None:
    """Refuse neighbouring magnets in the place of the magnet or of one another."""
    own = tuple(block for block in blocks_of_array(array, dimension) if block.remanence)
    reach = max(abs(end) for block in own for end in (block.z_min, block.z_max))
    solids = iron_solids(dimension, iron_ring, iron, reach)
    taken = own
    for one in neighbours:
        blocks = neighbour_blocks(own, (one,))
        found = block_in_others(blocks, taken, SQUEEZED) or (
            block_in_iron(blocks, solids, SQUEEZED) if solids else None)
        if found is not None:
            raise StudyError(must_be(
                "`external.neighbours`", "study", "other magnets, beside this one",
                f"one at z_m = {one.z_m:g} whose block {own[found[0]].name} is where blocks or "
                "iron are already", "Move it along z by more than the length of the magnet."))
        taken += blocks


WIDER = 1.1
"""Size of a sphere or a box around a body, relative to that around points of it: arcs reach beyond
them."""

NEAR = 0.1
"""Distance of the points of a winding that are tested, relative to what they must not cross."""


@lru_cache(maxsize=128)
def _check_windings(coils: tuple[AnyCoil, ...]) -> None:
    """Refuse coils in the winding of another one; they may touch."""
    windings = [points_in_winding(coil) for coil in coils]
    steps = [np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)) for points in windings]
    middles = np.array([points.mean(axis=0) for points in windings])
    sizes = np.array([np.linalg.norm(points - middle, axis=1).max()
                      for points, middle in zip(windings, middles, strict=True)])

    def meet(one: int, other: int) -> bool:
        winding = coils[one]
        if winding.kind == "polygon" or not all(winding.section_m):
            return False
        near = distance_in_magnet(winding, windings[other]).min() < steps[other]
        return bool(near) and runs_into(
            coils[other], partial(_distance_from_winding, winding), NEAR * min(winding.section_m))

    for number in range(len(coils)):
        apart = np.linalg.norm(middles[:number] - middles[number], axis=1)
        for other in np.flatnonzero(apart < sizes[:number] + sizes[number]).tolist():
            if meet(number, other) or meet(other, number):
                raise StudyError(must_be(
                    f"`external.coils[{number + 1}]`", "study", "clear of other coils",
                    f"a winding in that of `external.coils[{other + 1}]`",
                    "Move one of them, or join both in one coil of more turns."))


def _distance_from_winding(coil: AnyCoil, points: Floats) -> Floats:
    """Return how far points (n, 3) in m are from a winding, negative within it; it may touch."""
    return distance_in_magnet(coil, points) + closest(coil)


def _distance_from_body(body: Body, surface: Floats, points: Floats) -> Floats:
    """Return how far points (n, 3) in m are at least from a body, negative within it.

    ``surface`` (m, 3) are points of it, around which it lies in a box.
    """
    low, high = surface.min(axis=0), surface.max(axis=0)
    off = np.abs(points - (low + high) / 2) - WIDER * (high - low) / 2
    found = np.linalg.norm(np.maximum(off, 0.0), axis=1)
    found[body.contact(points).inside] = -1.0
    return np.asarray(found)


@lru_cache(maxsize=128)
def _check_coils(dimension: int, array: Array, iron_ring: IronRing | None, iron: Iron | None,
                 coils: tuple[AnyCoil, ...]) -> None:
    """Refuse blocks and iron in windings; they may touch.

    Points of bodies are tested, and points of windings, so that thin ones are found too. Blocks and
    iron of a cross-section have no ends, so that the height of a coil does not matter.
    """
    blocks = tuple(block for block in blocks_of_array(array, dimension) if block.remanence)
    reach = max((abs(end) for block in blocks for end in (block.z_min, block.z_max)), default=0.0)
    solids = iron_solids(dimension, iron_ring, iron, reach)
    if dimension == 2:
        coils = tuple(coil.model_copy(update={"centre_m": (*coil.centre_m[:2], 0.0)})
                      for coil in coils)
        reach = 1e-3 + max(float(np.abs(points_in_winding(coil)[:, 2]).max()) for coil in coils)
        blocks = tuple(replace(block, z_min=-reach, z_max=reach) for block in blocks)
        solids = tuple(replace(solid, z_min=-reach, z_max=reach) for solid in solids)
    if not blocks and not solids:
        return
    bodies = [(f"block {block.name}", block, points_of_block(block)) for block in blocks] + [
        (f"body {number + 1} of iron", solid, np.stack(solid.surface, axis=-1).reshape(-1, 3))
        for number, solid in enumerate(solids)]
    owner = np.repeat(np.arange(len(bodies)), [len(points) for _, _, points in bodies])
    everywhere = np.vstack([points for _, _, points in bodies])
    middles = np.array([points.mean(axis=0) for _, _, points in bodies])
    sizes = WIDER * np.array([np.linalg.norm(points - middle, axis=1).max()
                              for (_, _, points), middle in zip(bodies, middles, strict=True)])
    for number, coil in enumerate(coils, start=1):
        inside = owner[in_winding(coil, everywhere)].tolist()
        near = np.flatnonzero(distance_in_magnet(coil, middles) < sizes).tolist()
        cut = (one for one in near if runs_into(
            coil, partial(_distance_from_body, *bodies[one][1:]), NEAR * bodies[one][1].thickness))
        if (body := next(iter(inside), next(cut, None))) is not None:
            raise StudyError(must_be(
                f"`external.coils[{number}]`", "study", "clear of blocks and iron",
                f"a winding in {bodies[body][0]}", "Move the coil, or what is in its winding."))


@lru_cache(maxsize=128)  # a diagnosis builds the same magnets hundreds of times
def _check_overlaps(
    dimension: int, array: Array, iron_ring: IronRing | None, iron: Iron | None
) -> None:
    """Refuse blocks that overlap one another or iron, in their nominal or in their real places."""
    # overlap of nominal blocks that is rounding, as a fraction of a block's half width. Tables of
    # blocks are often rounded to a micrometre, 1e-4 of the half width of a block of 20 mm.
    rounding_overlap, table_overlap = 1e-6, 2e-4
    contact = table_overlap if array.free_blocks else rounding_overlap
    cases = [(nominal_blocks(array, dimension), contact, "")]
    blocks = blocks_of_array(array, dimension)
    if dimension == 2:  # where a small tilt turns magnetizations, and moves nothing in the plane
        blocks = tuple(replace(block, rotation_rad=(0.0, 0.0, block.rotation_rad[2]))
                       for block in blocks)
    if not all(block.in_place for block in blocks):
        cases.append((blocks, SQUEEZED, ", where they are mounted"))
    for placed, tolerance, where in cases:
        blocks = tuple(block for block in placed if block.remanence)  # the others are missing
        pair = overlapping_blocks(blocks, tolerance)
        if pair is not None:
            first, second = (blocks[number].name for number in pair[:2])
            raise StudyError(
                f"Input `array` of the study must leave blocks apart; instead blocks {first} and "
                f"{second} overlap by at least {1e3 * pair[2]:.3g} mm{where}. Make the blocks "
                "smaller, or move them apart.")
        reach = max(abs(end) for block in placed for end in (block.z_min, block.z_max))
        solids = iron_solids(dimension, iron_ring, iron, reach)
        found = block_in_iron(blocks, solids, tolerance) if solids else None
        if found is not None:
            raise StudyError(
                f"Input `iron` of the study must leave the blocks room; instead block "
                f"{blocks[found[0]].name} and body {found[1] + 1} of iron overlap by at least "
                f"{1e3 * found[2]:.3g} mm{where}. Move the iron away.")
