"""Gross errors: a map in other units, along other axes, or of another magnet than the study's.

They are no small effects, about which a model could be linearized, and they must be gone before
anything is inferred. The map is compared with the field of the nominal blocks in vacuum, at some of
its points: as it stands, and with every error in question put right, single errors first. A common
factor near 1 is free, for iron and temperature. What other blocks and effects of usual size leave
is known; a gross error is named only if the misfit is far larger, and if it explains nearly all of
it. What the symmetry of the magnet makes the same, as z reversed and Bz of the wrong sign where
both ends are alike, is named together; measured blocks have no symmetry, and decide.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from pydantic import ValidationError
from scipy.optimize import least_squares, minimize_scalar

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import HalbachError, HalbachWarning
from halbach_fe.diagnosis.map_conventions import (
    ALL_AXES,
    AXES_BY_ERRORS,
    FLUX_DENSITIES,
    LENGTHS,
    SAME,
    ArrayVariant,
    MapConvention,
    array_variants,
    axis_errors,
    rank,
    then,
)
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.field_map import points_of
from halbach_fe.measurement.instrument import along_axes, probe_points, sensor_matrix
from halbach_fe.solver.external_field import external_field
from halbach_fe.solver.vacuum_field import unit_fields
from halbach_fe.study.materials import MU_0
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS, Component

POINTS = 160
"""Of the map, that are compared."""

LEAST_READINGS = 12
"""Fewer are explained by anything."""

PANEL = 0.2
"""Of the inner radius: panels of the exact field, good to 1e-3 at that distance."""

BLOCK_SD = 0.02
"""Of the magnetization, along each axis: blocks may be off by this much, and twice."""

USUAL = 0.003
"""Of the main field: what effects of usual size add to a reading."""

SCALE = 0.1
"""Iron, permeability and temperature may change the whole field by this fraction."""

FAR = 2.0
"""Misfit, over what blocks and usual effects make, from which an error is looked for. Blocks of 1 %
and 1 deg leave 0.5, with an effect of three standard deviations up to 1; a block upside down in an
array of 64 leaves 4 to 6, which no error explains."""

DECISIVE = 3.0
"""By how much an error must reduce the misfit. The best wrong one reduces that of an upside-down or
missing block, or of sensors 6 mm off, to no less than half."""

CLOSE = 0.05
"""Of the map's rms: what it may leave."""

ALIKE = 1.2
"""Ratio of misfits of errors that the map does not tell apart."""

MOST = 3
"""Errors at a time, of which no single one explains anything."""

SEVERAL = 0.15
OTHER_UNIT = 0.5
"""Misfits over the map's rms that several errors together, or another unit, make at least."""

LEAST_RADIUS = 0.03
LEAST_SHIFT_M = 0.006
"""Less is a small effect, six standard deviations of those in the catalogue."""

RADII = tuple(float(one) for one in np.geomspace(0.4, 2.5, 17) if abs(one - 1) > 0.01)
OFFSETS = tuple(float(one) for one in np.linspace(-0.5, 0.5, 11) if abs(one) > 0.01)
"""Of the radius, as a factor, and over the bore's radius, from which the best is looked for."""

@dataclass(frozen=True)
class GrossError:
    """Gross errors that a map has together.

    Attributes
    ----------
    reading : Reading
    alternatives : tuple of Reading
        Others that explain the map as well.
    misfit_before, misfit_after : float
        From the nominal magnet, rms over the rms of the map.
    """

    reading: MapConvention
    alternatives: tuple[MapConvention, ...]
    misfit_before: float
    misfit_after: float

    @property
    def names(self) -> tuple[str, ...]:
        """Standard names of the errors."""
        return self.reading.names

    @property
    def start(self) -> dict[str, tuple[float, ...]]:
        """Amplitudes of effects of the catalogue, by name, if it is nothing else: a search begins
        with them, which a small effect's signature could not reach.
        """
        rest = replace(self.reading, offset_m=0.0, shift_m=(0.0, 0.0, 0.0))
        if rest.errors:
            return {}
        offset, shift = (self.reading.offset_m,), self.reading.shift_m
        return {name: values for name, values in (("wrong_radius", offset), ("wrong_line", shift))
                if any(values)}

    def apply(self, study: Study) -> Study:
        """The study that reads the map right."""
        return self.reading.apply(study)


@dataclass(frozen=True)
class _Misfit:
    """``standard`` is over what blocks and usual effects make, ``relative`` over the map's rms."""

    standard: float
    relative: float


NOWHERE = _Misfit(np.inf, np.inf)


def find_gross_errors(
    study: Study, data: xr.Dataset, blocks: BlockTable | None = None
) -> tuple[GrossError, ...]:
    """Find gross errors of a map, in the order in which they are to be put right."""
    found: list[GrossError] = []
    rows = np.unique(np.linspace(0, data.sizes["point"] - 1, POINTS).round().astype(int))
    some = data.isel(point=rows)
    while len(found) < MOST:
        one = _Search(
            study, points_of(some), np.asarray(some["B_T"].values, float), blocks).find()
        if one is None:
            break
        found.append(one)
        study = one.apply(study)
    return tuple(found)


class _Search:
    """The search for one gross error, or several that explain nothing by themselves.

    ``points`` (n, 3) and ``values`` (n, 3) are the map's, as its file has them.
    """

    def __init__(
        self, study: Study, points: Floats, values: Floats, table: BlockTable | None = None
    ) -> None:
        self.study, self.points, self.values, self.table = study, points, values, table
        others = array_variants(study)
        self.turned = tuple(one for one in others if one.turn_rad is not None)
        self.other = tuple(one for one in others if one.turn_rad is None)
        self.observed = np.array([name in _observed(study) for name in COMPONENTS])
        self.present = int((~np.isnan(values) & self.observed).sum())
        self.blocks: dict[ArrayVariant | None, tuple[MagnetBlock, ...]] = {}
        self.lengths, self.flux_densities = (1.0, *LENGTHS), (1.0, *FLUX_DENSITIES)
        self.computed: dict[MapConvention, _Nominal | None] = {}

    def find(self) -> GrossError | None:
        """The simplest, and of those the likeliest."""
        before = self.misfit(MapConvention())
        if before.standard <= FAR or self.present < LEAST_READINGS:
            return None
        if before.relative < OTHER_UNIT:
            self.lengths = self.flux_densities = (1.0,)
        for level in range(1, MOST + 1 if before.relative > SEVERAL else 2):
            for readings in (self.readings(level), self.elsewhere(level)):
                tried = [(self.misfit(one), one) for one in readings]
                good = [one for one in tried if self.explains(before, *one)]
                if good:
                    break
            if good:
                alike = _best(good)
                if self.table and len(alike) > 1:
                    alike = _best([(self.misfit(one, built=True), one) for _, one in alike])
                (after, reading), *others = sorted(alike, key=lambda one: rank(one[1]))
                if _small(reading):
                    return None
                return GrossError(reading, tuple(one for _, one in others), before.relative,
                             after.relative)
        return None

    def explains(self, before: _Misfit, after: _Misfit, reading: MapConvention) -> bool:
        """Whether it leaves next to nothing of what was there."""
        if not (after.standard <= before.standard / DECISIVE and after.relative <= CLOSE):
            return False
        try:
            reading.apply(self.study)
        except ValidationError:
            return False
        return True

    def readings(self, level: int) -> Iterator[MapConvention]:
        """All with that many errors, of units, axes and magnet."""
        flat = self.study.dimension == 2
        singles = [
            *(MapConvention(positions=one) for one in ALL_AXES if not (flat and one[2] != "z")
              and 0 < len(axis_errors(one, SAME)) <= min(level, 2)),
            *(MapConvention(magnet=one) for one in self.other)]
        for unit in self.lengths:
            yield from self.of_source(MapConvention(length_unit=unit), level)
            for one in singles:
                if unit == 1 or len(one.errors) < level:
                    yield from self.of_source(replace(one, length_unit=unit), level)

    def of_source(self, source: MapConvention, level: int) -> Iterator[MapConvention]:
        """All with that many errors, of points and a magnet that are given."""
        left = level - len(replace(source, positions=SAME).errors)
        for unit in self.flux_densities:
            for magnet in (source.magnet,) if source.magnet else (None, *self.turned):
                more = (unit != 1) + (magnet is not source.magnet)
                for fields in AXES_BY_ERRORS[source.positions].get(left - more, ()):
                    yield replace(source, fields=fields, flux_density_unit=unit, magnet=magnet)

    def elsewhere(self, level: int) -> Iterator[MapConvention]:
        """The best with points at other radii, or shifted, and as many errors in all."""
        radii = np.hypot(self.points[:, 0], self.points[:, 1])
        circles, smallest = radii.any(), radii[radii > 0].min(initial=np.inf)
        size = self.study.array.inner_radius_m
        for unit in self.lengths if level > 1 else (1.0,):
            source = MapConvention(length_unit=unit)
            families = [[replace(source, offset_m=size * one) for one in OFFSETS
                         if unit * smallest + size * one > 0]]
            if circles:
                families.append([replace(source, radius=one) for one in RADII])
            for family in families:
                tried = [one for start in family for one in self.of_source(start, level)]
                best = min(tried, key=lambda one: self.misfit(one).standard, default=None)
                if best:
                    yield from self.decided(self.refined(best))
        if level == 1:
            yield from self.shifted()

    def refined(self, best: MapConvention) -> MapConvention:
        """The same with the best radius."""
        def at(value: float) -> MapConvention:
            if best.offset_m:
                return replace(best, offset_m=float(value))
            return replace(best, radius=float(value))

        step = (OFFSETS[1] - OFFSETS[0]) * self.study.array.inner_radius_m
        ratio = RADII[1] / RADII[0]
        found = minimize_scalar(
            lambda value: min(self.misfit(at(value)).standard, 1e9), method="bounded",
            bounds=((best.offset_m - step, best.offset_m + step) if best.offset_m
                    else (best.radius / ratio, best.radius * ratio)), options={"xatol": 1e-4})
        return at(found.x)

    def shifted(self) -> Iterator[MapConvention]:
        """The best with points that are all elsewhere by the same."""
        size = self.study.array.inner_radius_m
        starts = [np.zeros(3)] + [
            size * part * np.array([np.cos(angle), np.sin(angle), 0.0])
            for part in (0.2, 0.5) for angle in np.pi / 4 * np.arange(8)]
        if self.study.dimension == 3:
            starts += [np.array([0.0, 0.0, sign * part * size])
                       for part in (0.25, 0.5, 1.0) for sign in (-1, 1)]

        def reading(shift: Floats) -> MapConvention:
            x, y, z = shift.tolist()
            return MapConvention(shift_m=(x, y, z))

        def residual(shift: Floats) -> Floats:
            own = self.residual(reading(shift))
            return np.full(self.present, 1e3) if own is None else own[0]

        best = min(starts, key=lambda one: self.misfit(reading(one)).standard)
        found = least_squares(residual, best, x_scale=size, diff_step=1e-4, max_nfev=8).x
        yield from self.decided(reading(found))

    def decided(self, moved: MapConvention) -> Iterator[MapConvention]:
        """A reading of points elsewhere, unless those on the other side do as well, as they do
        from the axis of a symmetric magnet: anything even would then explain the map.
        """
        x, y, z = (-one for one in moved.shift_m)
        opposite = replace(moved, offset_m=-moved.offset_m, shift_m=(x, y, z))
        if opposite == moved or (
                self.misfit(opposite).standard > ALIKE * self.misfit(moved).standard):
            yield moved

    def misfit(self, reading: MapConvention, built: bool = False) -> _Misfit:
        """How far the map so read is from the nominal magnet, or that of the measured blocks."""
        found = self.residual(reading, built)
        if found is None:
            return NOWHERE
        residual, relative = found
        return _Misfit(float(np.sqrt(np.mean(residual**2))), relative)

    def residual(self, reading: MapConvention, built: bool = False) -> tuple[Floats, float] | None:
        """Standardized residuals (values,) and their rms over that of the map; None of readings
        inside of material, or of none that the study observes.
        """
        turned = reading.magnet if reading.magnet in self.turned else None
        nominal = self.nominal(replace(
            reading, fields=SAME, flux_density_unit=1.0,
            magnet=None if turned else reading.magnet))
        if nominal is None:
            return None
        field = nominal.field(turned.turn_rad if turned and turned.turn_rad else 0.0)
        if built:
            field = self.of_measured_blocks(reading, field)
        old = self.study.instrument
        shown = along_axes(then(old.field_axes, reading.fields), self.values) * (
            old.flux_density_unit_T * reading.flux_density_unit)
        used = ~np.isnan(shown) & self.observed
        if not used.any() or 2 * used.sum() < self.present:
            return None
        whole = max(_size(shown), 1e-300)
        sd = np.sqrt(nominal.variance[used] + (USUAL * max(whole, _size(field))) ** 2)
        shown, field = shown[used], field[used]
        weighted = field / sd
        scale = np.clip(weighted @ (shown / sd) / max(float(weighted @ weighted), 1e-300),
                        1 - SCALE, 1 + SCALE)
        difference = shown - scale * field
        return difference / sd, float(np.sqrt(np.sum(difference**2) / len(self.values)) / whole)

    def of_measured_blocks(self, reading: MapConvention, nominal: Floats) -> Floats:
        """B (n, 3) in T of the blocks of the table, or the nominal one if they do not fit."""
        assert self.table is not None
        try:
            study = reading.apply(self.study)
            with warnings.catch_warnings(action="ignore", category=HalbachWarning):
                measured = prior_from_blocks(build_magnet(study), self.table).gaussian.mean
        except (ValidationError, HalbachError):
            return nominal
        blocks = build_magnet(study).blocks
        mean = np.pad(measured.reshape(len(blocks), -1), ((0, 0), (0, 3 - study.dimension)))
        points = _probe_points(study.instrument, self.points)
        panel = PANEL * study.array.inner_radius_m
        total = external_field(build_magnet(study), points)
        for block, one, unit in zip(blocks, mean, unit_fields(blocks, points, 4, panel),
                                    strict=True):
            total += unit @ (MU_0 * block.recoil_tensor @ one)
        return np.asarray(total @ sensor_matrix(study.instrument).T)

    def nominal(self, source: MapConvention) -> _Nominal | None:
        """The nominal magnet's field where the points then are; None inside of material."""
        if source not in self.computed:
            try:
                study = source.apply(self.study)
                if source.magnet not in self.blocks:
                    self.blocks[source.magnet] = build_magnet(study).blocks
                self.computed[source] = _Nominal.of(
                    study, self.blocks[source.magnet], self.points)
            except (ValidationError, HalbachError):
                self.computed[source] = None
        return self.computed[source]


@dataclass(frozen=True)
class _Nominal:
    """Field (n, 3) in T of the nominal blocks in vacuum as the sensors see it, the same with their
    magnetization turned by a right angle, what else there is, and the variance (n, 3) in T^2 that
    other blocks make.
    """

    blocks: Floats
    across: Floats
    external: Floats
    variance: Floats

    @classmethod
    def of(
        cls, study: Study, blocks: Sequence[MagnetBlock], shown: Floats
    ) -> _Nominal | None:
        """At the points (n, 3) that a map shows; None if one is inside of material."""
        points = _probe_points(study.instrument, shown)
        if any(block.contains(points).any() for block in blocks):
            return None
        field, across, variance = (np.zeros_like(points) for _ in range(3))
        for block, unit in zip(blocks, unit_fields(
                blocks, points, 4, PANEL * study.array.inner_radius_m), strict=True):
            x, y, _ = block.easy_axis
            field += unit @ (np.array(block.easy_axis) * block.remanence)
            across += unit @ (np.array([-y, x, 0.0]) * block.remanence)
            variance += np.sum((BLOCK_SD * block.remanence * unit) ** 2, axis=2)
        sensors = sensor_matrix(study.instrument).T
        return cls(field @ sensors, across @ sensors,
                   external_field(build_magnet(study), points) @ sensors, variance)

    def field(self, turn: float) -> Floats:
        """B (n, 3) in T with the magnetization of all blocks turned by an angle in rad."""
        return np.cos(turn) * self.blocks + np.sin(turn) * self.across + self.external


def _small(reading: MapConvention) -> bool:
    """Whether it is an effect of the catalogue, which is found from where the map says it is."""
    moved = np.linalg.norm([reading.offset_m, *reading.shift_m])
    return bool(0 < abs(reading.radius - 1) < LEAST_RADIUS or 0 < moved < LEAST_SHIFT_M)


def _best(found: Sequence[tuple[_Misfit, MapConvention]]) -> list[tuple[_Misfit, MapConvention]]:
    """Those that explain the map as well as any."""
    least = min(misfit.standard for misfit, _ in found)
    return [one for one in found if one[0].standard <= ALIKE * least]


def _probe_points(instrument: Instrument, shown: Floats) -> Floats:
    """Where the probe was, (n, 3) in m, at points (n, 3) of a map's file."""
    read = along_axes(instrument.position_axes, shown) * instrument.length_unit_m
    return probe_points(instrument, read)


def _observed(study: Study) -> tuple[Component, ...]:
    one = study.observation
    return one.components if one.quantity == "flux_density" else ("x", "y")


def _size(vectors: Floats) -> float:
    """Rms magnitude of vectors (n, 3), of their components that are known."""
    return float(np.sqrt(np.nansum(vectors**2) / len(vectors)))
