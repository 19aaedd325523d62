"""Find gross errors of a map: wrong units, wrong axes, wrong positions, or another magnet.

Gross errors are too large for a linearized model, and must be corrected before any inference. Some
points of the map are compared with the field of the nominal blocks in vacuum, first as the map
stands and then with every gross error corrected in turn, single errors before combinations. A
common factor near 1 is fitted, which absorbs coaxial iron, permeability and temperature. What iron
of any shape adds is no factor: it is given, and with it no other magnet is tried.

The misfit that tolerances of blocks and effects of usual size cause is known. A gross error is
reported only if the misfit is far larger, and if correcting the error removes nearly all of it.
Errors that are equivalent by the magnet's symmetry are reported together: if both ends of the
magnet are alike, a reversed z axis is equivalent to a wrong sign of Bz, and a displacement to
either side of the axis may be the same. Measured blocks break the symmetry, and then decide between
such errors. A block that is missing or upside down is no gross error; it is taken into account
where it would be mistaken for one.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import xarray as xr
from scipy.optimize import least_squares, minimize_scalar

from halbach_fe.core.arrays import Floats, radii_of, rms, unit_circle
from halbach_fe.core.errors import HalbachError, HalbachWarning, StudyError
from halbach_fe.diagnosis.map_conventions import (
    ALL_AXES,
    FIELD_AXES_BY_ERROR_COUNT,
    FLUX_DENSITY_UNITS,
    IDENTITY_AXES,
    LENGTH_UNITS,
    ArrayVariant,
    MapConvention,
    array_variants,
    axis_errors,
    compose_axes,
    rank,
)
from halbach_fe.geometry.blocks import rotation_about_z
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.inference.block_prior import prior_from_blocks
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.measurement.field_map import points_of
from halbach_fe.measurement.probe_law import probe_points, sensor_matrix, to_magnet_axes
from halbach_fe.solver.exact_block_field import external_field, unit_fields
from halbach_fe.solver.separate_blocks import Field
from halbach_fe.study.materials import MU_0
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS, Axes, Component

MIN_READINGS = 12
"""Smallest number of readings for the search. With fewer readings some gross error would fit any
map."""

INDISTINGUISHABLE_MISFIT_RATIO = 1.2
"""Ratio of misfits below which the map does not distinguish two errors."""

MAX_ERRORS = 3
"""Largest number of errors in a combination, and of successive corrections."""

MIN_SHIFT_M = 0.006
"""Smallest displacement of the points that is a gross error: six standard deviations of the effects
in the catalogue."""

RADIUS_FACTORS = tuple(float(factor) for factor in np.geomspace(0.4, 2.5, 17)
                       if abs(factor - 1) > 0.01)
"""Factors of the radius from which the search for the best factor starts."""

RADIUS_OFFSETS = tuple(float(offset) for offset in np.linspace(-0.5, 0.5, 11)
                       if abs(offset) > 0.01)
"""Offsets of the radius, relative to the bore's radius, from which the search for the best offset
starts."""


@dataclass(frozen=True)
class GrossError:
    """A gross error of a map, or several that occur together."""

    convention: MapConvention
    """The convention by which the map is to be read."""
    alternatives: tuple[MapConvention, ...]
    """Other conventions that explain the map equally well."""
    misfit_before: float
    misfit_after: float
    """Rms difference from the nominal magnet, relative to the map's rms."""
    map: str | None = None
    """Name of the map among those that the study lists; None if it lists none."""
    factor: float | None = None
    """Factor of all readings that explains the map as well, if there is one."""

    @property
    def names(self) -> tuple[str, ...]:
        """Standard names of the errors."""
        return self.convention.names

    @property
    def starts(self) -> tuple[dict[str, tuple[float, ...]], ...]:
        """Amplitudes by name of the catalogue's effects that are equivalent to this error.

        Those of the alternatives follow, such as a displacement to the other side. The tuple is
        empty if other errors are involved. The search for effects starts from these amplitudes,
        which are too large for a linear signature to find.
        """
        found = [_start_of(each) for each in (self.convention, *self.alternatives)]
        return tuple(start for start in found if start) if found[0] else ()

    @property
    def text(self) -> str:
        """Description of all errors in one phrase, with the name of the map among several."""
        return self.convention.text if self.map is None else f"map {self.map}: " + (
            self.convention.text)

    def apply(self, study: Study) -> Study:
        """Return the study that reads the map by the corrected convention."""
        if self.map is None:
            return self.convention.apply(study)
        number = [one.name for one in study.maps].index(self.map)
        own = self.convention.apply(study.of_map(number))
        corrected = study.with_tables({self.map: {"instrument": own.instrument}})
        return corrected.with_(array=own.array, external=own.external)


@dataclass(frozen=True)
class _Misfit:
    """Rms difference between a map and a magnet."""

    standard: float
    """Relative to what tolerances of blocks and usual effects cause."""
    relative: float
    """Relative to the map's rms."""
    factor: float = 1.0
    """Common factor of the readings."""


NOT_COMPARED = np.zeros(0), _Misfit(np.inf, np.inf)
"""Residuals and misfit of a convention that cannot be compared with the magnet."""


def find_gross_errors(
    study: Study, data: xr.Dataset, blocks: BlockTable | None = None, iron: Field | None = None
) -> tuple[GrossError, ...]:
    """Find the gross errors of a map, in the order in which they are to be corrected.

    Parameters
    ----------
    data : Dataset
        The map, as `halbach_fe.measurement.field_map.read_map` returns it.
    blocks : BlockTable, optional
        Measured blocks, which decide between errors that the nominal magnet's symmetry makes
        equivalent.
    iron : callable, optional
        What iron of any shape adds to the field (n, 3) in T at points (n, 3) in m.
    """
    found: list[GrossError] = []
    while len(found) < MAX_ERRORS:
        error = _search(study, data, blocks, iron).find()
        if error is None:
            break
        found.append(error)
        study = error.apply(study)
    return tuple(found)


def misfit_of(study: Study, data: xr.Dataset, iron: Field | None) -> float:
    """Return the rms difference of a map from the nominal magnet, relative to the map's rms.

    Infinite if the study places points of the map inside material.
    """
    return _search(study, data, None, iron).misfit(MapConvention()).relative


def _search(study: Study, data: xr.Dataset, blocks: BlockTable | None, iron: Field | None
            ) -> _Search:
    """Return the search with some points of a map."""
    # number of points of the map that are compared
    most_points = 160
    rows = np.unique(np.linspace(0, data.sizes["point"] - 1, most_points).round().astype(int))
    thinned = data.isel(point=rows)
    return _Search(study, points_of(thinned), np.asarray(thinned["B_T"].values, float), blocks,
                   iron)


class _Search:
    """The search for one gross error, or for several that must be corrected together.

    Parameters
    ----------
    study : Study
    points : ndarray, shape (n, 3)
        Points as the map's file lists them.
    values : ndarray, shape (n, 3)
        Readings as the map's file lists them; NaN where a component is missing.
    table : BlockTable, optional
    iron : callable, optional
        See `find_gross_errors`.
    """

    def __init__(
        self, study: Study, points: Floats, values: Floats, table: BlockTable | None,
        iron: Field | None,
    ) -> None:
        self.study, self.points, self.values, self.table = study, points, values, table
        self.iron = iron
        others = array_variants(study) if iron is None else ()
        self.turned = tuple(variant for variant in others if variant.turn_rad is not None)
        self.other = tuple(variant for variant in others if variant.turn_rad is None)
        self.observed = np.array([name in _observed(study) for name in COMPONENTS])
        self.present = int((~np.isnan(values) & self.observed).sum())
        self.magnets: dict[ArrayVariant | None, Magnet] = {}
        self.lengths, self.flux_densities = (1.0, *LENGTH_UNITS), (1.0, *FLUX_DENSITY_UNITS)
        self.computed: dict[MapConvention, _Nominal | None] = {}

    def find(self) -> GrossError | None:
        """Return the error with the fewest corrections, and of those the most plausible.

        None if the map has no gross error, or no error explains the misfit.
        """
        # Smallest misfit, relative to the map's rms, at which other units are tried.
        min_misfit_of_wrong_unit = 0.5
        # Smallest misfit, relative to the map's rms, at which combinations of errors are tried.
        min_misfit_of_several_errors = 0.15
        # Misfit above which a gross error is searched, relative to that of blocks and usual
        # effects. Blocks with errors of 1 % and 1 deg cause 0.5, with an effect of three standard
        # deviations up to 1. One block upside down in an array of 64 causes 4 to 6, and no gross
        # error explains it.
        min_misfit = 2.0
        before = self.misfit(MapConvention())
        if self.present < MIN_READINGS:
            return None
        if before.standard <= min_misfit:
            return self.hidden_by_symmetry(before) if self.table else None
        if before.relative < min_misfit_of_wrong_unit:
            self.lengths = self.flux_densities = (1.0,)
        combined = before.relative > min_misfit_of_several_errors
        good = next(filter(None, self.explaining(before, MAX_ERRORS if combined else 1)), None)
        if good is None or self.is_a_wrong_block(before, good):
            return None
        equivalent = _best(good)
        if self.table and len(equivalent) > 1:
            equivalent = _best([
                (self.misfit(each, measured_blocks=True), each) for _, each in equivalent])
        (_, convention), *others = sorted(
            equivalent, key=lambda trial: (rank(trial[1]), trial[0].standard))
        if _small(convention):
            return None
        after = self.misfit(convention)
        return GrossError(
            convention, self.distinct(convention, [each for _, each in others]),
            before.relative, after.relative,
            factor=self.factor_as_good(after) if convention.is_only_elsewhere else None)

    def explaining(
        self, before: _Misfit, most_errors: int
    ) -> Iterator[list[tuple[_Misfit, MapConvention]]]:
        """Yield the conventions that explain the map, with their misfits: of ever more errors, and
        of as many those with points at other positions last.
        """
        for level in range(1, most_errors + 1):
            for conventions in (self.conventions(level), self.elsewhere(level)):
                tried = [(self.misfit(each), each) for each in conventions]
                yield [trial for trial in tried if self.explains(before, *trial)] or (
                    self.beside_a_wrong_block(before, tried))

    def is_a_wrong_block(
        self, before: _Misfit, good: Sequence[tuple[_Misfit, MapConvention]]
    ) -> bool:
        """Tell whether a single block, the simpler cause, explains the map as well."""
        alone = self.with_a_wrong_block(MapConvention())
        return self.explains(before, alone, MapConvention()) and (
            alone.standard <= INDISTINGUISHABLE_MISFIT_RATIO * min(
                misfit.standard for misfit, _ in good))

    def factor_as_good(self, after: _Misfit) -> float | None:
        """Return the factor of all readings that explains the map as well as a correction does
        that leaves a misfit; None if none does.
        """
        _, nominal = self.nominal_of(MapConvention())
        if nominal is None:
            return None
        _, found = self.compared(MapConvention(), nominal.field(0.0), nominal.variance, np.inf)
        return found.factor if (
            found.standard <= INDISTINGUISHABLE_MISFIT_RATIO * after.standard) else None

    def hidden_by_symmetry(self, nominal: _Misfit) -> GrossError | None:
        """Return the single error that changes nothing in the nominal magnet, but in the measured
        blocks, such as a reversed z axis. None if no error explains more than that there is none.

        Other causes are the same in both, so that they do not seem to be such an error: it must
        leave a third of what disagrees with the measured blocks.
        """
        self.lengths = self.flux_densities = (1.0,)
        before = self.misfit(MapConvention(), measured_blocks=True)
        good = [(misfit, each) for each in self.conventions(1) if each.magnet not in self.other
                and self.misfit(each).standard <= INDISTINGUISHABLE_MISFIT_RATIO * nominal.standard
                and self.explains(before, misfit := self.misfit(each, measured_blocks=True), each)]
        if not good:
            return None
        (after, convention), *others = sorted(
            _best(good), key=lambda trial: (rank(trial[1]), trial[0].standard))
        return GrossError(convention, self.distinct(convention, [each for _, each in others]),
                          before.relative, after.relative)

    def beside_a_wrong_block(
        self, before: _Misfit, tried: Sequence[tuple[_Misfit, MapConvention]]
    ) -> list[tuple[_Misfit, MapConvention]]:
        """Return the conventions that explain the map if one block is missing or upside down.

        The block is then left to the catalogue of effects. Without this, the fewest further errors
        would be looked for that happen to imitate the block, such as another number of rings.
        """
        # Largest number of conventions that are tried with every block missing and upside down.
        max_tried_with_a_block = 4
        # Largest misfit relative to the map's rms at which a missing or upside-down block is tried
        # beside an error: two of eight blocks of the only ring.
        max_of_a_block = 0.5
        near = sorted((trial for trial in tried if trial[0].relative <= max_of_a_block),
                      key=lambda trial: trial[0].standard)[:max_tried_with_a_block]
        found = [(self.with_a_wrong_block(convention), convention) for _, convention in near]
        return [trial for trial in found if self.explains(before, *trial)]

    def distinct(
        self, convention: MapConvention, others: Sequence[MapConvention]
    ) -> tuple[MapConvention, ...]:
        """Return those of the other conventions that read the map differently, or another magnet.

        With a single radius, for example, a factor of the radius and an offset are the same.
        """
        found = [convention]
        for other in others:
            if not any(self.same(other, each) for each in found):
                found.append(other)
        return tuple(found[1:])

    def same(self, first: MapConvention, second: MapConvention) -> bool:
        """Tell whether two conventions read the same positions and values for the same magnet."""
        if first.magnet != second.magnet:
            return False
        one, other = (each.apply(self.study).instrument for each in (first, second))
        values, changed = (to_magnet_axes(used.field_axes, self.values) * used.flux_density_unit_T
                           for used in (one, other))
        moved = _probe_points(one, self.points) - _probe_points(other, self.points)
        return bool(np.array_equal(values, changed, equal_nan=True)
                    and np.linalg.norm(moved, axis=1).max() < MIN_SHIFT_M)

    def explains(self, before: _Misfit, after: _Misfit, convention: MapConvention) -> bool:
        """Tell whether a convention removes nearly all of the misfit and fits a valid study."""
        # Largest misfit that may remain after the correction, relative to the map's rms.
        max_remaining_misfit = 0.05
        # Factor by which correcting an error must reduce the misfit. The best wrong error reduces
        # the misfit of an upside-down or missing block, or of sensors displaced by 6 mm, by no more
        # than a factor of 2.
        min_misfit_reduction = 3.0
        if not (after.standard <= before.standard / min_misfit_reduction
                and after.relative <= max_remaining_misfit):
            return False
        try:
            convention.apply(self.study)
        except StudyError:
            return False
        return True

    def conventions(self, level: int) -> Iterator[MapConvention]:
        """Yield all conventions with ``level`` errors of units, axes and magnet."""
        flat = self.study.dimension == 2
        singles = [
            *(MapConvention(positions=axes) for axes in ALL_AXES if not (flat and axes[2] != "z")
              and 0 < len(axis_errors(axes, IDENTITY_AXES)) <= min(level, 2)),
            *(MapConvention(magnet=variant) for variant in self.other)]
        for unit in self.lengths:
            yield from self.of_source(MapConvention(length_unit=unit), level)
            for single in singles:
                if unit == 1 or len(single.errors) < level:
                    yield from self.of_source(replace(single, length_unit=unit), level)

    def of_source(self, source: MapConvention, level: int) -> Iterator[MapConvention]:
        """Yield all conventions with ``level`` errors for given coordinates and a given magnet."""
        left = level - len(replace(source, positions=IDENTITY_AXES).errors)
        for unit in self.flux_densities:
            for magnet in (source.magnet,) if source.magnet else (None, *self.turned):
                more = (unit != 1) + (magnet is not source.magnet)
                for fields in FIELD_AXES_BY_ERROR_COUNT[source.positions].get(left - more, ()):
                    yield replace(source, fields=fields, flux_density_unit=unit, magnet=magnet,
                                  components=self.components(fields))

    def components(self, fields: Axes) -> tuple[Component, ...]:
        """Return the components that are to be observed as well if the columns are of other axes.

        They are those of the columns that were observed, unless the map has what the study observes
        in its other columns.
        """
        old = self.study.instrument.field_axes
        observed = {*_observed(self.study)}
        present = [(was[-1], now[-1]) for was, now, column in zip(
            old, compose_axes(old, fields), self.values.T, strict=True)
            if not np.isnan(column).all()]
        if self.study.observation.quantity != "flux_density" or observed <= {
                now for _, now in present}:
            return ()
        return tuple(now for was, now in present if was in observed and now not in observed
                     and now in COMPONENTS[:self.study.dimension])

    def elsewhere(self, level: int) -> Iterator[MapConvention]:
        """Yield the best conventions with ``level`` errors and points at other positions.

        The points are at another radius or, if that is the only error, all displaced alike.
        """
        radii = radii_of(self.points)
        circles, smallest = radii.any(), radii[radii > 0].min(initial=np.inf)
        size = build_magnet(self.study).bore_radius
        for unit in self.lengths if level > 1 else (1.0,):
            source = MapConvention(length_unit=unit)
            families: list[list[MapConvention]] = []  # points on the axis have no radius
            if circles:
                families = [[replace(source, offset_m=size * offset) for offset in RADIUS_OFFSETS
                             if unit * smallest + size * offset > 0],
                            [replace(source, radius=factor) for factor in RADIUS_FACTORS]]
            for family in families:
                tried = [each for start in family for each in self.of_source(start, level)]
                best = min(tried, key=lambda each: self.misfit(each).standard, default=None)
                if best:
                    yield self.refined(best)
        if level == 1:
            yield from self.shifted()

    def refined(self, best: MapConvention) -> MapConvention:
        """Return the convention with the radius that minimizes the misfit."""
        def at(value: float) -> MapConvention:
            if best.offset_m:
                return replace(best, offset_m=float(value))
            return replace(best, radius=float(value))

        step = (RADIUS_OFFSETS[1] - RADIUS_OFFSETS[0]) * build_magnet(self.study).bore_radius
        ratio = RADIUS_FACTORS[1] / RADIUS_FACTORS[0]
        found = minimize_scalar(
            lambda value: min(self.misfit(at(value)).standard, 1e9), method="bounded",
            bounds=((best.offset_m - step, best.offset_m + step) if best.offset_m
                    else (best.radius / ratio, best.radius * ratio)), options={"xatol": 1e-4})
        return at(found.x)

    def shifted(self) -> Iterator[MapConvention]:
        """Yield the best convention with all points displaced by the same vector."""
        size = build_magnet(self.study).bore_radius
        starts = [np.zeros(3)] + [
            size * part * unit_circle(angle)
            for part in (0.2, 0.5) for angle in np.pi / 4 * np.arange(8)]
        if self.study.dimension == 3:
            starts += [np.array([0.0, 0.0, sign * part * size])
                       for part in (0.25, 0.5, 1.0) for sign in (-1, 1)]

        def convention(shift: Floats) -> MapConvention:
            x, y, z = shift.tolist()
            return MapConvention(shift_m=(x, y, z))

        def residual(shift: Floats) -> Floats:
            own, _ = self.fit(convention(shift))
            return own if len(own) else np.full(self.present, 1e3)

        def improved(moved: MapConvention) -> MapConvention:
            return convention(least_squares(residual, np.array(moved.shift_m), x_scale=size,
                                            diff_step=1e-4, max_nfev=8).x)

        rated = sorted(starts, key=lambda shift: self.misfit(convention(shift)).standard)
        # the field may change as much from the axis along x as along y
        for along in (0, 1):
            best = next(shift for shift in rated
                        if not shift[:2].any() or np.argmax(np.abs(shift[:2])) == along)
            yield from self.mirrored(improved(convention(best)), improved)

    def mirrored(
        self, moved: MapConvention, improved: Callable[[MapConvention], MapConvention]
    ) -> Iterator[MapConvention]:
        """Yield a convention with displaced points, and its mirror images that fit as well.

        From the axis of a symmetric magnet a displacement to either side fits equally well. Nothing
        in the map tells the sides apart, so that all of them are possible. ``improved`` takes a
        convention and returns the best one near it.
        """
        yield moved
        limit = INDISTINGUISHABLE_MISFIT_RATIO * self.misfit(moved).standard
        for signs in product((1.0, -1.0), repeat=3):
            x, y, z = np.multiply(moved.shift_m, signs).tolist()
            if min(signs) < 0 and max(map(abs, (x, y, z))) > MIN_SHIFT_M:
                image = improved(replace(moved, shift_m=(x, y, z)))
                if self.misfit(image).standard <= limit:
                    yield image

    def misfit(self, convention: MapConvention, measured_blocks: bool = False) -> _Misfit:
        """Return the misfit of a map read by a convention, see `fit`."""
        return self.fit(convention, measured_blocks)[1]

    def fit(
        self, convention: MapConvention, measured_blocks: bool = False
    ) -> tuple[Floats, _Misfit]:
        """Compare the map, read by a convention, with the nominal magnet, or with that of
        ``measured_blocks``, see `compared`; not if points are inside material.
        """
        turned, nominal = self.nominal_of(convention)
        if nominal is None:
            return NOT_COMPARED
        field = nominal.field(turned.turn_rad if turned and turned.turn_rad else 0.0)
        if measured_blocks:
            field = self.of_measured_blocks(convention, field)
        return self.compared(convention, field, nominal.variance)

    def with_a_wrong_block(self, convention: MapConvention) -> _Misfit:
        """Return the smallest misfit with one block missing or upside down."""
        # Multiple of a block's field that is lacking if it is missing, and if it is upside down.
        wrong_block_factors = (1.0, 2.0)
        turned, nominal = self.nominal_of(convention)
        if nominal is None:
            return NOT_COMPARED[1]
        turn = turned.turn_rad if turned and turned.turn_rad else 0.0
        study = (replace(convention, magnet=None) if turned else convention).apply(self.study)
        points, sensors = _probe_points(study.instrument, self.points), sensor_matrix(
            study.instrument).T
        whole, best = nominal.field(turn), NOT_COMPARED[1]
        blocks = self.magnets[None if turned else convention.magnet].blocks
        for block, unit in zip(blocks, unit_fields(blocks, points), strict=True):
            own = unit @ (rotation_about_z(turn) @ block.easy_axis) * block.remanence @ sensors
            for factor in wrong_block_factors if block.remanence else ():
                _, found = self.compared(convention, whole - factor * own, nominal.variance)
                best = min(best, found, key=lambda each: each.standard)
        return best

    def compared(
        self, convention: MapConvention, field: Floats, variance: Floats,
        max_scale_change: float = 0.1,
    ) -> tuple[Floats, _Misfit]:
        """Return standardized residuals (values,) from a field (n, 3) in T of given variance, and
        the misfit; `NOT_COMPARED` if too few of the observed values remain.

        Iron, permeability and temperature may cause a relative change of the whole field, of 0.1 at
        most. What the study states to be open of the instrument is no gross error: a probe that
        is rolled by 30 mrad picks up 3 % of the main field, which a wrong sign may happen to hide.
        """
        # Standard deviation that effects of usual size add to a reading, relative to the main
        # field.
        effect_field_sd = 0.003
        # Smallest share of the observed values that a convention must use. One that puts a
        # component of a cross-section along z, which is not observed there, has less to explain
        # than the others.
        least_used = 0.9
        old = self.study.instrument
        shown = to_magnet_axes(compose_axes(old.field_axes, convention.fields), self.values) * (
            old.flux_density_unit_T * convention.flux_density_unit)
        used = ~np.isnan(shown) & (self.observed | np.isin(COMPONENTS, convention.components))
        if not used.any() or used.sum() < least_used * self.present:
            return NOT_COMPARED
        whole, of = max(_size(shown), 1e-300), self.study.instrument_sd
        squares = field**2
        variance = variance + (of.crosstalk**2 + of.rotation_rad**2) * (
            squares.sum(axis=1, keepdims=True) - squares) + of.gain**2 * squares + of.offset_T**2
        sd = np.sqrt(variance[used] + (effect_field_sd * max(whole, _size(field))) ** 2)
        shown, field = shown[used], field[used]
        weighted = field / sd
        scale = np.clip(weighted @ (shown / sd) / max(float(weighted @ weighted), 1e-300),
                        1 - max_scale_change, 1 + max_scale_change)
        difference = shown - scale * field
        residual = difference / sd
        return residual, _Misfit(
            rms(residual),
            float(np.sqrt(np.sum(difference**2) / len(self.values)) / whole), float(scale))

    def of_measured_blocks(self, convention: MapConvention, nominal: Floats) -> Floats:
        """Return B (n, 3) in T of the measured blocks.

        It is ``nominal`` if the table of blocks does not fit the magnet.
        """
        assert self.table is not None
        try:
            study = convention.apply(self.study)
            with warnings.catch_warnings(action="ignore", category=HalbachWarning):
                measured = prior_from_blocks(build_magnet(study), self.table).gaussian.mean
        except HalbachError:
            return nominal
        blocks = build_magnet(study).blocks
        mean = np.pad(measured.reshape(len(blocks), -1), ((0, 0), (0, 3 - study.dimension)))
        points = _probe_points(study.instrument, self.points)
        total = external_field(build_magnet(study), points) + (
            self.iron(points) if self.iron else 0.0)
        for block, magnetization, unit in zip(blocks, mean, unit_fields(blocks, points),
                                              strict=True):
            total += unit @ (MU_0 * block.recoil_tensor @ magnetization)
        return np.asarray(total @ sensor_matrix(study.instrument).T)

    def nominal_of(
        self, convention: MapConvention
    ) -> tuple[ArrayVariant | None, _Nominal | None]:
        """Return the magnet of a convention if it is a turned one, and the field before that turn.

        The field is None where `nominal` has none.
        """
        turned = convention.magnet if convention.magnet in self.turned else None
        return turned, self.nominal(replace(
            convention, fields=IDENTITY_AXES, flux_density_unit=1.0, components=(),
            magnet=None if turned else convention.magnet))

    def nominal(self, source: MapConvention) -> _Nominal | None:
        """Return the nominal field at the points of a convention.

        None if a point is inside material, or no valid study has the convention.
        """
        if source not in self.computed:
            try:
                study = source.apply(self.study)
                if source.magnet not in self.magnets:
                    self.magnets[source.magnet] = build_magnet(study)
                self.computed[source] = _Nominal.of(
                    study.instrument, self.magnets[source.magnet], self.points, self.iron)
            except HalbachError:
                self.computed[source] = None
        return self.computed[source]


@dataclass(frozen=True)
class _Nominal:
    """The field of the nominal magnet in the axes of the sensors."""

    blocks: Floats
    """Field of the nominal blocks in vacuum. Shape (n, 3), in T."""
    across: Floats
    """The same with the magnetization of all blocks turned by 90 deg. Shape (n, 3), in T."""
    external: Floats
    """Field of external sources and of iron of any shape. Shape (n, 3), in T."""
    variance: Floats
    """Variance that the tolerances of the blocks cause. Shape (n, 3), in T^2."""

    @classmethod
    def of(
        cls, instrument: Instrument, magnet: Magnet, shown: Floats, iron: Field | None
    ) -> _Nominal | None:
        """Compute it at the points (n, 3) of a map's file; None if a point is inside material."""
        # Standard deviation of a block's magnetization along each axis, relative to its nominal
        # magnitude.
        block_magnetization_sd = 0.02
        points, blocks = _probe_points(instrument, shown), magnet.blocks
        if any(block.contains(points).any() for block in blocks) or (
                iron is not None and any(body.contains(points).any() for body in magnet.iron)):
            return None
        external = external_field(magnet, points) + (iron(points) if iron else 0.0)
        field, across, variance = (np.zeros_like(points) for _ in range(3))
        for block, unit in zip(blocks, unit_fields(blocks, points), strict=True):
            x, y, _ = block.easy_axis
            field += unit @ block.polarization
            across += unit @ (np.array([-y, x, 0.0]) * block.remanence)
            variance += np.sum((block_magnetization_sd * block.remanence * unit) ** 2, axis=2)
        sensors = sensor_matrix(instrument).T
        return cls(field @ sensors, across @ sensors, external @ sensors, variance)

    def field(self, turn: float) -> Floats:
        """Return B (n, 3) in T with the magnetization of all blocks turned by an angle in rad."""
        return np.cos(turn) * self.blocks + np.sin(turn) * self.across + self.external


def _start_of(convention: MapConvention) -> dict[str, tuple[float, ...]]:
    """Return amplitudes of the effects that a convention amounts to; empty if there are none."""
    if replace(convention, offset_m=0.0, shift_m=(0.0, 0.0, 0.0)).errors:
        return {}
    offset, shift = (convention.offset_m,), convention.shift_m
    return {name: values for name, values in (("wrong_radius", offset), ("wrong_line", shift))
            if any(values)}


def _small(convention: MapConvention) -> bool:
    """Tell whether an error is small enough for the catalogue's effects, which are found by
    linearization.
    """
    # Smallest relative change of the radius that is a gross error. Smaller changes are effects of
    # the catalogue.
    min_radius_change = 0.03
    moved = np.linalg.norm([convention.offset_m, *convention.shift_m])
    return bool(0 < abs(convention.radius - 1) < min_radius_change or 0 < moved < MIN_SHIFT_M)


def _best(found: Sequence[tuple[_Misfit, MapConvention]]) -> list[tuple[_Misfit, MapConvention]]:
    """Return the conventions whose misfits cannot be distinguished from the smallest."""
    least = min(misfit.standard for misfit, _ in found)
    return [one for one in found if one[0].standard <= INDISTINGUISHABLE_MISFIT_RATIO * least]


def _probe_points(instrument: Instrument, shown: Floats) -> Floats:
    """Return the positions (n, 3) in m of the probe for points (n, 3) of a map's file."""
    converted = to_magnet_axes(instrument.position_axes, shown) * instrument.length_unit_m
    return probe_points(instrument, converted)


def _observed(study: Study) -> tuple[Component, ...]:
    """Return the components that the study observes."""
    settings = study.observation
    return settings.components if settings.quantity == "flux_density" else ("x", "y")


def _size(vectors: Floats) -> float:
    """Return the rms magnitude of vectors (n, 3), ignoring components that are NaN."""
    return float(np.sqrt(np.nansum(vectors**2) / len(vectors)))
