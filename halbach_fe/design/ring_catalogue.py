"""The rings that a design search may choose, and the field of each at each place along z."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import asin, atan, floor, pi, sqrt

import numpy as np

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.geometry.array_layout import nominal_blocks
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.geometry.overlaps import overlapping_blocks
from halbach_fe.response.region import Region
from halbach_fe.solver.exact_block_field import field_of
from halbach_fe.study.array_keys import Array, Ring
from halbach_fe.study.design_keys import Design, DesignLayer
from halbach_fe.study.external_keys import External
from halbach_fe.study.model import Study

DECIMALS = 9
"""Decimals of lengths in m, so that a study shows what was meant."""

ROUNDING_M = 1e-9
"""Overlap of rings that is rounding."""


@dataclass(frozen=True)
class RingOfBlocks:
    """A ring of equal blocks."""

    radius_m: float
    """Of the blocks' middles."""
    size_m: float
    """Thickness of the blocks along the radius."""
    blocks: int

    def table(self, array: Array, z: float) -> Ring:
        """Return the ring at z in m as a table of the study, with the values of an array."""
        block, length = array.block, array.ring_length_m
        if block.shape == "cuboid":
            block, length = block.with_(width_m=round(self.size_m, DECIMALS)), self.size_m
        inner, outer, length = (value and round(value, DECIMALS) for value in (
            self.radius_m - self.size_m / 2, self.radius_m + self.size_m / 2, length))
        return Ring(z_m=z, inner_radius_m=inner, outer_radius_m=outer, ring_length_m=length,
                    blocks_per_ring=self.blocks, block=block)


Option = tuple[RingOfBlocks | None, ...]
"""The ring of each layer at one place; None where it is empty."""


@dataclass(frozen=True)
class Sample:
    """Points of a region at which the fields of designs are compared."""

    points: Floats
    """Of points at which all rings have the same field by symmetry, one. Shape (k, 3), in m."""
    weights: Floats
    """In means over the volume. Shape (k,)."""
    surface: Bools
    """Which of them are on the surface, where a harmonic function has its extremes. Shape (k,)."""
    direction: Floats
    """Direction of the main field. Shape (3,)."""

    @classmethod
    def of(cls, region: Region, fields: Callable[[Floats], Floats]) -> Sample:
        """Return the points of a region for fields (rings, n, 3) at points (n, 3)."""
        points, weights = _points(region)
        field = fields(points)
        mean = np.einsum("n,rnc->c", weights, field)
        direction = mean / np.linalg.norm(mean)
        along = field @ direction
        size = np.linalg.norm(field, axis=2)  # of each ring two numbers: one may agree by chance
        # difference of fields, relative to the largest, up to which two points are alike
        alike_fields = 1e-7
        alike = np.vstack([along / size.max(), size / size.max(), weights > 0]) / alike_fields
        _, first, group = np.unique(alike.round(), axis=1, return_index=True, return_inverse=True)
        summed: Floats = np.asarray(np.bincount(group.ravel(), weights), float)
        return cls(points[first], summed, weights[first] == 0, direction)


@dataclass(frozen=True)
class Catalogue:
    """What a search may choose, with its field in vacuum at the points that decide."""

    study: Study
    z_m: Floats
    """Places of rings from the middle upwards; each but that at 0 stands for that at -z too.
    Shape (p,)."""
    options: tuple[Option, ...]
    sample: Sample
    field_T: Floats
    """Component of B along the main field of each option in each place, and in its mirror image.
    Shape (p, o, k)."""
    mass_kg: Floats
    """Shape (p, o)."""
    density_kg_per_m3: float

    @classmethod
    def of(cls, study: Study, region: Region, density_kg_per_m3: float) -> Catalogue:
        """Compute the fields of all rings that the study's design may choose."""
        design = design_of(study)
        steps = np.arange(design.rings) - (design.rings - 1) / 2
        z: Floats = np.array(design.spacing_m * steps[steps >= 0], float)
        options = tuple(_options(study, design))
        rings = sorted({ring for option in options for ring in option if ring}, key=str)
        _check_places(study, rings, z, region)
        sample = Sample.of(region, lambda points: np.concatenate([
            fields_with_images(study, ring, z[-1:], points) for ring in rings]))
        field: dict[RingOfBlocks | None, Floats] = {None: np.zeros((len(z), len(sample.points)))}
        mass: dict[RingOfBlocks | None, Floats] = {None: np.zeros(len(z))}
        for ring in rings:
            field[ring] = fields_with_images(study, ring, z, sample.points) @ sample.direction
            volume = sum(block.volume for block in ring_of(study, ring))
            mass[ring] = np.where(z > ROUNDING_M, 2, 1) * density_kg_per_m3 * volume

        def table(of_ring: dict[RingOfBlocks | None, Floats]) -> Floats:
            return np.stack([np.sum([of_ring[ring] for ring in option], axis=0)
                             for option in options], axis=1)

        return cls(study, z, options, sample, table(field), table(mass), density_kg_per_m3)

    @property
    def design(self) -> Design:
        """What the study asks for."""
        return design_of(self.study)

    @property
    def decide(self) -> Bools:
        """Which points of the sample decide, by the objective."""
        sample = self.sample
        return sample.weights > 0 if self.design.objective == "rms" else sample.surface

    def rings(self, chosen: Ints) -> tuple[Option, ...]:
        """Return the rings of a choice (p,) of options."""
        return tuple(self.options[number] for number in chosen)

    def blocks_of(self, rings: Sequence[Option]) -> int:
        """Return the number of blocks of a design, mirror images and all."""
        return sum(copies * ring.blocks for copies, ring in self._every(rings))

    def mass_of(self, rings: Sequence[Option]) -> float:
        """Return the mass of a design in kg."""
        return self.density_kg_per_m3 * sum(
            copies * block.volume for copies, ring in self._every(rings)
            for block in ring_of(self.study, ring))

    def _every(self, rings: Sequence[Option]) -> Iterator[tuple[int, RingOfBlocks]]:
        """Yield the number of copies of each ring, and the ring."""
        for z, option in zip(self.z_m, rings, strict=True):
            yield from ((2 if z > ROUNDING_M else 1, ring) for ring in option if ring)


def design_of(study: Study) -> Design:
    """Return the design of a study.

    Raises
    ------
    StudyError
        If it has none, or what it asks for is not known here.
    """
    if (reason := obstacle(study)) is not None:
        what, *sentence = reason
        raise StudyError(must_be(what, f"study {study.name}", *sentence))
    if study.design is None:
        raise StudyError(must_be(
            "`design`", f"study {study.name}", "a table with the rings to choose from", "nothing",
            "Add a table [design] with, for example, rings = 5, spacing_m = 0.022, least_field_T = "
            "0.05 and layer = [{ radii_m = [0.15, 0.155], sizes_m = [0.012] }]."))
    return study.design


def obstacle(study: Study) -> tuple[str, str, str, str] | None:
    """Return why no rings can be designed for a magnet: key, expected, received, what to do.

    None if a table [design] is all that is needed.
    """
    array = study.array
    if study.dimension == 2:
        return "`dimension`", "3, for a design of rings", "2", ""
    external = study.external
    if study.iron_ring or study.iron or external != External():
        return ("`design`", "of a magnet without iron and fields from outside",
                "one with iron, background_T, neighbours, coils or dipoles",
                "Leave them out of the search, and look at the result with them.")
    if array.free_blocks is not None or array.exceptions:
        return ("`array`", "of rings without exceptions, for a design",
                "one with free blocks or exceptions",
                "Write a study of rings (halbach-fe new) with [design]." if array.free_blocks
                else "Leave them out.")
    if array.of_ring(1).multipole_order != 1:
        return ("`array.multipole_order`", "1: the field of a design is homogeneous",
                str(array.of_ring(1).multipole_order), "")
    return None


def tables_of(study: Study, z_m: Floats, chosen: Sequence[Option]) -> list[Ring]:
    """Return rings at places (p,) and their mirror images as tables of the study, along z."""
    array = study.array.of_ring(1)
    every = [(float(sign * z), ring) for z, option in zip(z_m, chosen, strict=True)
             for sign in ((-1, 1) if z > ROUNDING_M else (1,)) for ring in option if ring]
    every.sort(key=lambda one: one[0])
    return [ring.table(array, round(z, DECIMALS)) for z, ring in every]


def designed(study: Study, rings: Sequence[Ring]) -> Study:
    """Return the study with the rings of a design in place of its own.

    If all blocks are of one type, they are so in the new rings too.
    """
    types, array = study.prior.types, study.array
    if len(types) == 1:
        most = max(ring.blocks_per_ring or array.blocks_per_ring for ring in rings)
        types = {label: tuple(range(1, most + 1)) for label in types}
    return study.with_(array=array.with_(ring=tuple(rings), rings=len(rings)), prior__types=types)


def about_origin(study: Study) -> Magnet:
    """Return the magnet of a study with its rings stacked about z = 0, as those of a design are.

    Raises
    ------
    StudyError
        If rings cannot be designed for the study, such as beside iron that they may overlap.
    """
    design_of(study)
    return build_magnet(study.with_(array__ring=[
        ring.with_(z_m=None) for ring in study.array.ring]))


def ring_of(study: Study, ring: RingOfBlocks) -> tuple[MagnetBlock, ...]:
    """Return the blocks of a ring at z = 0."""
    table = ring.table(study.array.of_ring(1), 0.0)
    return nominal_blocks(designed(study, [table]).array, study.dimension)


def largest_number(array: Array, radius: float, size: float, gap: float) -> int:
    """Return how many blocks of a size in m fit into a ring at least a gap in m apart.

    Cubes that are turned with their magnetization need the room of their diagonal.
    """
    block = array.block
    if block.shape != "cuboid":
        return array.blocks_per_ring
    if block.orientation == "magnetization":
        half = (sqrt(2) * size + gap) / (2 * radius)
        return floor(pi / asin(half) + ROUNDING_M) if half < 1 else 0
    room = radius - size / 2
    return floor(pi / atan((size + gap) / (2 * room)) + ROUNDING_M) if room > 0 else 0


def _options(study: Study, design: Design) -> Iterator[Option]:
    """Yield the rings of all layers that fit inside one another at one place."""
    layers = [list(_rings(study, layer)) for layer in design.layer]
    ranges = {ring: reach(study, ring) for layer in layers for ring in layer}
    every: Iterable[Option]
    # largest number of combinations of rings at a place, which limits memory and time
    most_options = 2000
    if design.layers_together:
        every = zip(*layers, strict=True)
        if any(layer.may_be_empty for layer in design.layer):
            every = [*every, (None,) * len(layers)]
    else:
        size = int(np.prod([len(layer) + one.may_be_empty for layer, one in zip(
            layers, design.layer, strict=True)]))
        if size > most_options:
            raise StudyError(must_be(
                "`design.layer`", f"study {study.name}", f"at most {most_options} combinations of "
                "rings at a place", str(size), "Leave out radii or sizes, or set layers_together."))
        every = product(*([*layer, None] if one.may_be_empty else layer for layer, one in zip(
            layers, design.layer, strict=True)))
    fit = 0
    for option in every:
        reaches = [ranges[ring] for ring in option if ring]
        if all(outer[0] >= inner[1] - ROUNDING_M for inner, outer in pairwise(reaches)):
            fit += 1
            yield option
    if not fit:
        raise StudyError(must_be(
            "`design.layer`", f"study {study.name}", "rings that fit inside one another",
            "only layers that overlap, or are listed from the outside",
            "List layers from the inside, and move their radii apart."))


def reach(study: Study, ring: RingOfBlocks) -> tuple[float, float]:
    """Return the least and the largest radius of a ring's material in m."""
    array = study.array.of_ring(1)
    half = ring.size_m / 2
    if array.block.shape == "cuboid" and array.block.orientation == "magnetization":
        half *= sqrt(2)
    corners = [float(np.hypot(*edge.start)) for block in ring_of(study, ring)
               for edge in block.outline]
    return ring.radius_m - half, max(corners)


def _rings(study: Study, layer: DesignLayer) -> Iterator[RingOfBlocks]:
    """Yield the rings of a layer: for each size those of each radius."""
    array = study.array.of_ring(1)
    if layer.gap_m and array.block.shape != "cuboid":
        raise StudyError(must_be(
            "`design.layer.gap_m`", f"study {study.name}", "left out, but for cuboids",
            f"{layer.gap_m:g} m of a {array.block.shape}", "Its gaps are those of array.block."))
    sizes = layer.sizes_m or (array.outer_radius_m - array.inner_radius_m,)
    for size in sizes:
        for number, radius in enumerate(layer.radii_m):
            most = largest_number(array, radius, size, layer.gap_m)
            blocks = layer.blocks_per_ring[number] if layer.blocks_per_ring else most
            if blocks < 4 or size / 2 >= radius:
                raise StudyError(must_be(
                    "`design.layer.radii_m`", f"study {study.name}",
                    "so large that four blocks fit",
                    f"{radius:g} with blocks of {1e3 * size:g} mm"
                    + f", {1e3 * layer.gap_m:g} mm apart" * bool(layer.gap_m)))
            ring = RingOfBlocks(radius, size, blocks)
            if blocks > most and (layer.gap_m or overlapping_blocks(ring_of(study, ring))):
                raise StudyError(must_be(
                    "`design.layer.blocks_per_ring`", f"study {study.name}",
                    f"so small that blocks of {1e3 * size:g} mm fit at the radius {radius:g} m"
                    + f", {1e3 * layer.gap_m:g} mm apart" * bool(layer.gap_m),
                    blocks, f"{most} do."))
            yield ring


def fields_with_images(study: Study, ring: RingOfBlocks, z: Floats, points: Floats) -> Floats:
    """Return B (p, n, 3) in T of a ring at each of some places (p,) in m and its mirror image.

    The ring at z = 0 is its own image, and counts once.
    """
    heights = np.append(z, -z[z > ROUNDING_M])
    moved = points - np.outer(heights, [0.0, 0.0, 1.0])[:, None]  # (places and images, n, 3)
    found = field_of(ring_of(study, ring), moved.reshape(-1, 3)).reshape(moved.shape)
    found[:len(z)][z > ROUNDING_M] += found[len(z):]
    return found[:len(z)]


def _points(region: Region) -> tuple[Floats, Floats]:
    """Return points (n, 3) in m and weights (n,) of means over the volume, 0 on the surface."""
    # number of points of a circle about the axis, or through the poles. It is divisible by 4, so
    # that points which are alike by symmetry count once, and those on the axes of symmetry, where
    # extremes often are, are among them.
    angles = 48
    points, weights = region.points(angles - 1)
    if region.shape == "cylinder":
        return points, weights
    theta, phi = np.meshgrid(np.linspace(0, np.pi, angles // 2 + 1),
                             2 * np.pi * np.arange(angles) / angles)
    surface = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)],
                       axis=-1).reshape(-1, 3) * region.half_axes_m + region.centre_m
    inside = weights > 0
    return (np.vstack([surface, points[inside]]),
            np.append(np.zeros(len(surface)), weights[inside]))


def _check_places(
    study: Study, rings: Sequence[RingOfBlocks], z: Floats, region: Region
) -> None:
    """Raise a StudyError if rings would overlap along z, or reach into the region."""
    design, array = design_of(study), study.array.of_ring(1)
    lengths = [ring.table(array, 0.0).ring_length_m or 0.0 for ring in rings]
    longest = max(lengths)
    if len(z) > 1 and longest > design.spacing_m + ROUNDING_M:
        raise StudyError(must_be(
            "`design.spacing_m`", f"study {study.name}", f"at least {longest:g}, the length of a "
            "ring", f"{design.spacing_m:g}"))
    for ring in rings:
        radii, angles, heights = np.meshgrid(
            np.linspace(*reach(study, ring), 5), 2 * np.pi * np.arange(24) / 24,
            (z[:, None] + np.linspace(-0.5, 0.5, 9) * longest).ravel())
        material = np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=-1)
        both = np.concatenate([material.reshape(-1, 3), material.reshape(-1, 3) * [1, 1, -1]])
        if region.contains(both).any():
            raise StudyError(must_be(
                "the region", f"study {study.name}", "within all rings of `design.layer`",
                f"{region.text}, into which a ring of radius {1e3 * ring.radius_m:.4g} mm "
                "reaches", "Choose a smaller region, or leave out small radii."))
