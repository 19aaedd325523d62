"""Readings of what deviates besides uniform magnetizations: variations in blocks, and amplitudes.

The magnetization along a block's easy axis deviates from a uniform one by a smooth random function
of the place, see ``variation_sd`` of `halbach_fe.study.inference_keys.Prior`. Most of what it can
be makes no field where a probe can be. Each block therefore gets as many modes as change the field
in the bore noticeably: the singular vectors of the field on a cylinder near the blocks, weighted by
the prior. Amplitudes are in prior standard deviations. The field is that of small uniform parts of
the block in vacuum. What permeable blocks answer to it is neglected, some 5 % of a variation that
is small itself.

An uncertain amplitude (`halbach_fe.study.inference_keys.Uncertain`) is a parameter of the magnet
after its magnetizations, in units of its prior standard deviation. The magnetization is always that
of the blocks: if an amplitude changes what blocks are expected to have (a temperature), it is a
deviation that they share in the prior, and its own column has only what the amplitude changes at
given magnetizations.

`Deviations` is the field of all of these. It is exact in vacuum. What permeable blocks and iron
answer to deviations is some per cent of a field that is small itself, up to a quarter near an iron
tube. It is neglected, but for what blocks answer where that is asked for: use the field for error
bars and small corrections.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints, radii_of, slices
from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError, must_be
from halbach_fe.geometry.blocks import MagnetBlock, rotation_about_z, vector
from halbach_fe.geometry.magnet import Magnet, build_magnet, neighbour_blocks
from halbach_fe.measurement.observation_operator import Observation
from halbach_fe.solver.exact_block_field import external_field, field_of, unit_fields
from halbach_fe.solver.moments.cells import Cells, cells_of
from halbach_fe.solver.moments.interaction import Interaction
from halbach_fe.solver.moments.solve import solve_moments
from halbach_fe.solver.routes import (
    fields_of_others,
    finite_element_part,
    solve_nominal,
    vacuum_part,
)
from halbach_fe.solver.session import Session
from halbach_fe.stats.gaussian import (
    Gaussian,
    block_diagonal_root,
    nominal_prior,
    root_matrix,
    rotation_roots,
    stacked_root,
    with_independent,
)
from halbach_fe.study.inference_keys import Uncertain, shifted
from halbach_fe.study.materials import MU_0
from halbach_fe.study.model import Study


@dataclass(frozen=True)
class Variations:
    """The variations inside the blocks of a magnet, as polarizations of cells."""

    interaction: Interaction
    starts: Ints
    """Number of the first cell of every block. Shape (blocks + 1,)."""
    polarization: tuple[Floats, ...]
    """For every block the polarization of the parts of its cells per amplitude.
    Shape (cells of a block, q, 3, modes), in T."""
    names: tuple[str, ...]
    """Names of all amplitudes, block by block, such as ``r01s05.v03``."""

    @classmethod
    def of(cls, magnet: Magnet) -> Variations | None:
        """Return the variations of a magnet's prior; None if it has none."""
        prior = magnet.study.prior
        if not prior.variation_sd or prior.variation_length_m is None:
            return None
        side = float(np.cbrt(np.median([block.volume for block in magnet.blocks])))
        # parts of a block per correlation length along each direction. With 1.1 of them, readings 8
        # mm off the blocks of a dipole of 1.7 T saw the parts: held-out residuals were 1.05 mT, and
        # 0.72 mT with 1.7.
        parts_per_length = 1.7
        per_side = max(1, int(np.ceil(parts_per_length * side / prior.variation_length_m / 2)))
        # largest number of cells, of two parts each, along the sides of a cube: the correlations
        # between 12^3 parts of a block take 24 MB
        most_cells = 6
        if per_side > most_cells:
            least = parts_per_length * side / most_cells / 2
            raise StudyError(must_be(
                "`prior.variation_length_m`", f"study {magnet.name}",
                f"at least {least:.2g} m for blocks of {side:.2g} m",
                f"{prior.variation_length_m:g}", "Shorter variations have no field in the bore."))
        return cls._of_blocks(tuple(magnet.blocks), prior.variation_sd, prior.variation_length_m,
                              per_side, magnet.middle_m)

    @classmethod
    @lru_cache(maxsize=2)  # every map of a campaign asks for those of the same blocks
    def _of_blocks(
        cls, blocks: tuple[MagnetBlock, ...], sd: float, length_m: float, per_side: int,
        middle_m: tuple[float, float, float],
    ) -> Variations:
        """Return the variations of blocks about a middle, with ``per_side`` cells along a side."""
        cells = cells_of(blocks, per_side)
        starts = np.searchsorted(cells.block, np.arange(len(blocks) + 1))
        interaction, found, names = Interaction(cells), [], []
        # rms field on the cylinder below which a mode is left out, at one prior standard deviation
        noticeable_T = 2e-5
        for number, block in enumerate(blocks):
            mine = slice(starts[number], starts[number + 1])
            places = cells.nodes[mine]
            flat = places.reshape(-1, 3)
            easy = block.polarization
            own = Interaction(_select_cells(cells, mine))
            effect = (own.readings(_cylinder(flat, middle_m)) @ easy).reshape(-1, len(flat))
            distance = np.sum((flat[:, None] - flat)**2, axis=2)
            spread = sd**2 * np.exp(-distance / (2 * length_m**2)) @ effect.T
            # the singular vectors of the effect, weighted by the prior, by its Gram matrix, which
            # is smaller: sizes of interest are above 1e-4 of the largest one
            squares, vectors = np.linalg.eigh(effect @ spread)
            kept = np.flatnonzero(squares > noticeable_T**2 * len(effect) / 3)[::-1]
            shapes = (spread @ (vectors[:, kept] / np.sqrt(squares[kept]))).reshape(
                *places.shape[:2], 1, -1)
            found.append(shapes * easy[:, None])
            names += [f"{block.name}.v{1 + mode:02d}" for mode in range(len(kept))]
        return cls(interaction, starts, tuple(found), tuple(names))

    def readings(self, observation: Observation, rows: slice) -> Floats:
        """Return some readings (k, amplitudes) in T per amplitude."""
        found = []
        for some in self._shares(range(len(observation))[rows]):
            seen, operator = observation.part(slice(some.start, some.stop))
            points = np.ascontiguousarray(observation.points[seen], float)
            by_part = self.interaction.readings(points)
            # each sensor reads one component: two thirds of the field need no sum over the parts
            found.append(self._of_amplitudes(operator @ by_part.reshape(3 * len(points), -1)))
        return np.concatenate(found)

    def fields(self, points: Floats) -> Floats:
        """Return B (k, 3, amplitudes) in T per amplitude at points (k, 3) in m."""
        found = []
        for some in self._shares(range(len(points))):
            by_part = self.interaction.readings(
                np.ascontiguousarray(points[some.start:some.stop], float))
            found.append(self._of_amplitudes(by_part.reshape(3 * len(by_part), -1)).reshape(
                len(by_part), 3, -1))
        return np.concatenate(found)

    def _shares(self, every: range) -> Iterator[range]:
        """Yield parts of a range for which the fields of all parts of cells fit into memory."""
        # number of field components of parts at points that are in memory at a time, 240 MB
        numbers_at_once = 30_000_000
        step = max(1, numbers_at_once // (9 * self.interaction.cells.weights.size))
        return (every[part] for part in slices(len(every), step))

    def _of_amplitudes(self, by_part: Floats) -> Floats:
        """Return values (r, amplitudes) per amplitude of those (r, parts 3) per polarization."""
        columns = by_part.shape[1] // len(self.interaction.cells)  # per cell
        return np.hstack([
            by_part[:, columns * first:columns * last] @ polarization.reshape(
                -1, polarization.shape[-1])
            for first, last, polarization in zip(
                self.starts[:-1], self.starts[1:], self.polarization, strict=True)])

    def field(self, amplitudes: Floats, points: Floats) -> Floats:
        """Return B (n, 3) in T of all variations together at points (n, 3) in m.

        Distant cells are summed by expansions.
        """
        parts = np.split(amplitudes, np.cumsum([each.shape[-1] for each in self.polarization])[:-1])
        polarization = np.concatenate([
            each @ part for each, part in zip(self.polarization, parts, strict=True)])
        return self.interaction.field_at(points, polarization)


def _select_cells(cells: Cells, chosen: slice) -> Cells:
    """Return some of the cells."""
    return replace(cells, **{name: getattr(cells, name)[chosen] for name in (
        "block", "centre", "axes", "vertices", "half", "cuboid")})


def _cylinder(places: Floats, middle_m: tuple[float, float, float]) -> Floats:
    """Return points (n, 3) in m in the bore near a block whose parts are at places (m, 3) in m, of
    a cylinder along z about a middle.
    """
    axis = np.array([*middle_m[:2], 0.0])
    radius = radii_of(places - axis)
    angle = np.arctan2(*(places.mean(axis=0) - axis)[[1, 0]])
    low, high = places[:, 2].min(), places[:, 2].max()
    reach = (high - low) / 2
    n_around, n_along = 9, 13  # numbers of points of the cylinder about a block and along it
    phi, z = np.meshgrid(angle + np.linspace(-0.5, 0.5, n_around) * np.pi,
                         np.linspace(low - reach, high + reach, n_along))
    # radius of the cylinder on which modes are compared, relative to the distance of a block from
    # the axis
    near_wall = 0.8
    near = near_wall * radius.min()
    return np.asarray(axis + np.column_stack([
        near * np.cos(phi).ravel(), near * np.sin(phi).ravel(), z.ravel()]))


def prior_of_blocks(magnet: Magnet) -> Gaussian:
    """Return the study's prior of the magnetizations of an assembled magnet in A/m.

    It has the tolerances of the blocks, the errors that they share, and the random angles by which
    blocks are turned when they are mounted.
    """
    settings, size, nominal = magnet.study.prior, magnet.dimension, magnet.nominal_magnetization
    blocks = nominal_prior(nominal, size, settings.magnitude_sd, settings.direction_sd_deg,
                           magnet.study.shared_sds)
    if not settings.mounting_sd_deg:
        return blocks
    turns = rotation_roots(nominal.reshape(-1, size), np.radians(settings.mounting_sd_deg))
    return Gaussian(blocks.mean, stacked_root(blocks.root, block_diagonal_root(turns)))


def study_prior(magnet: Magnet, parameters: int, measured: Gaussian | None = None) -> Gaussian:
    """Return the study's prior of all ``parameters`` of an assembled magnet in A/m.

    After the magnetizations, whose prior ``measured`` blocks may have, are the amplitudes of
    variations, followed by uncertain amplitudes of the magnet; beside all of these is what the
    blocks of neighbours deviate.
    """
    others = parameters - len(magnet.parameter_names)
    prior = prior_of_blocks(magnet) if measured is None else measured
    return with_neighbours(magnet, with_amplitudes(with_variations(
        prior, others - len(magnet.study.uncertain_of_magnet)), magnet))


def neighbour_prior(magnet: Magnet) -> Gaussian:
    """Return the prior of what the magnetizations of neighbours' blocks deviate, in A/m.

    They are Mx, My and Mz of the blocks of every neighbour, along the axes of this magnet before it
    is moved there. These blocks are others than this magnet's, and were not measured.
    """
    neighbours = magnet.study.external.neighbours
    root = sparse.csr_array(root_matrix(prior_of_blocks(magnet).root))
    return Gaussian(np.zeros(neighbour_parameters(magnet)), stacked_root(
        sparse.csr_array(sparse.kron(sparse.eye_array(len(neighbours)), root))))


def neighbour_parameters(magnet: Magnet) -> int:
    """Return the number of parameters of the `neighbour_prior`."""
    return len(magnet.study.external.neighbours) * len(magnet.nominal_magnetization)


def with_neighbours(magnet: Magnet, distribution: Gaussian) -> Gaussian:
    """Return a distribution of a magnet's parameters with those of neighbours' blocks beside.

    They are distributed as in the `neighbour_prior` unless they are known.
    """
    count, beside = neighbour_parameters(magnet), distribution.beside
    if count == (0 if beside is None else len(beside.mean)):
        return distribution
    alone = replace(distribution, beside=None)
    return alone.with_beside(neighbour_prior(magnet)) if count else alone


def neighbour_remanences(magnet: Magnet) -> list[tuple[tuple[MagnetBlock, ...], Floats]]:
    """Return the blocks of each neighbour, and the matrices (blocks, 3, 3) from what their
    magnetizations deviate in A/m, see `neighbour_prior`, to T of remanence.
    """
    own = MU_0 * np.array([block.recoil_tensor for block in magnet.blocks])
    return [(neighbour_blocks(magnet.blocks, (one,)),
             one.factor * rotation_about_z(np.radians(one.turn_deg)) @ own)
            for one in magnet.study.external.neighbours]


def neighbour_columns(magnet: Magnet, points: Floats, session: Session | None = None) -> Floats:
    """Return B (n, 3, parameters) in T at points (n, 3) in m per A/m of the parameters of
    `neighbour_prior`, in vacuum or, by a ``session``, with what iron answers.
    """
    return np.concatenate([np.zeros((*points.shape, 0)), *(
        unit @ matrix for blocks, matrices in neighbour_remanences(magnet)
        for unit, matrix in zip(
            unit_fields(blocks, points) if session is None else fields_of_others(
                magnet, blocks, points, session), matrices, strict=True))], axis=2)


def with_variations(prior: Gaussian, count: int) -> Gaussian:
    """Return a prior of magnetizations, and ``count`` amplitudes of variations after them."""
    return with_independent(prior, np.zeros(count), np.ones(count)) if count else prior


STEP = 1e-3
"""Step of the differences of exact fields, magnetizations and readings, in standard deviations:
geometry, materials and laws of instruments are linear to 1e-6 over it, and rounding is 1e-12."""


def amplitude_names(magnet: Magnet) -> tuple[str, ...]:
    """Return the names of the uncertain amplitudes of a magnet."""
    return tuple(one.name for one in magnet.study.uncertain_of_magnet)


def shared_deviations(magnet: Magnet) -> Floats:
    """Return the change (parameters, amplitudes) in A/m of the nominal magnetizations."""
    return changes_by_amplitudes(magnet, lambda other: other.nominal_magnetization)


def vacuum_changes(magnet: Magnet, points: Floats) -> Floats:
    """Return the change (amplitudes, n, 3) in T of the field of blocks in vacuum and of external
    sources at points (n, 3) in m, magnetizations changed as in `shared_deviations`.
    """
    return changes_by_amplitudes(magnet, lambda other: vacuum_part(other, points)).transpose(
        2, 0, 1)


def field_changes(magnet: Magnet, points: Floats, session: Session) -> Floats:
    """Return `vacuum_changes` with those of what permeability and iron add."""
    def solved(other: Magnet) -> Floats:
        if other.is_vacuum and other.study.solver.method == "reaction":
            return np.zeros(points.shape)
        return finite_element_part(other, points, session.within("uncertain"), columns=False,
                                   estimate=False).nominal

    changes = vacuum_changes(magnet, points)
    # step of the differences of what permeability and iron add, in standard deviations: large
    # enough for differences between meshes, which a small step would magnify
    solved_step = 0.1
    return changes + changes_by_amplitudes(magnet, solved, solved_step).transpose(2, 0, 1)


def with_amplitudes(prior: Gaussian, magnet: Magnet) -> Gaussian:
    """Return a prior of a magnet's other parameters (m,), and its uncertain amplitudes after them.

    They are 0 with a standard deviation of 1, and shared by the magnetizations.
    """
    count = len(magnet.study.uncertain_of_magnet)
    if not count:
        return prior
    shared = np.zeros((len(prior.mean), count))
    shared[:len(magnet.parameter_names)] = shared_deviations(magnet)
    root = sparse.bmat([[sparse.csr_array(root_matrix(prior.root)), sparse.csr_array(shared)],
                        [None, sparse.eye_array(count)]], format="csr")
    return Gaussian(np.concatenate([prior.mean, np.zeros(count)]),
                    stacked_root(sparse.csr_array(root)))


def changes_by_amplitudes(
    magnet: Magnet, of: Callable[[Magnet], NDArray[Any]], step: float = STEP
) -> NDArray[Any]:
    """Return the derivatives (..., amplitudes), per standard deviation, of values of a magnet."""
    found = []
    for one in magnet.study.uncertain_of_magnet:
        (more, less), between = _either_side(magnet.study, one, step)
        found.append((of(build_magnet(more)) - of(build_magnet(less))) / between)
    return np.stack(found, axis=-1)


def _either_side(
    study: Study, uncertain: Uncertain, step: float
) -> tuple[tuple[Study, Study], float]:
    """Return the study with a larger and with a smaller amplitude, and how far these are apart.

    The step and that distance are in standard deviations. At the limit of a key, such as a
    permeability of 1, one of both is the study itself.
    """
    sides, between = [], 0.0
    for sign in (1, -1):
        try:
            sides.append(shifted(study, uncertain, sign * step * uncertain.sd))
            between += step
        except StudyError:
            sides.append(study)
    if not between:
        try:
            shifted(study, uncertain, step * uncertain.sd)
        except StudyError as error:
            raise StudyError(must_be(
                f"`uncertain.sd` of '{uncertain.name}'", f"study {study.name}",
                f"small enough that the study can be changed by {step:g} of it",
                f"{uncertain.sd:g} (in the unit of the key, as m and T)",
                f"Correct it. The change by that step: {error}")) from None
    return (sides[0], sides[1]), between


def distribution_of(magnet: Magnet, distribution: object, name: str) -> Gaussian:
    """Return a distribution of a magnet's parameters in A/m.

    Raises
    ------
    MeasurementError
        If it is none, has another number of parameters, or is of a magnet without a field.

    Warns
    -----
    HalbachWarning
        If it can hardly be of this magnet: a Gaussian does not say of which it is.
    """
    if not isinstance(distribution, Gaussian):
        raise MeasurementError(must_be(
            name, f"study {magnet.name}", "a Gaussian", f"a {type(distribution).__name__}"))
    expected = len(nominal_parameters(magnet))
    if len(distribution.mean) != expected:
        raise MeasurementError(must_be(
            name, f"study {magnet.name}", f"of the {expected} parameters of its magnet",
            str(len(distribution.mean)), "Is it that of another magnet?"))
    nominal = magnet.nominal_magnetization
    off = float(np.linalg.norm(distribution.mean[:len(nominal)] - nominal))
    doubted = 1.2  # times nominal; none magnetized is 1, a third of the blocks upside down 1.15
    if off > doubted * np.linalg.norm(nominal) > 0:
        warnings.warn(f"As they were given or found, the blocks of magnet {magnet.name} are "
                      "farther from the nominal ones than if none were magnetized, by "
                      f"{off / np.linalg.norm(nominal):.0%} of these. Are they, or the map, of "
                      "another magnet?", HalbachWarning, stacklevel=2)
    return magnetized(magnet, with_neighbours(magnet, distribution), name)


def nominal_parameters(magnet: Magnet) -> Floats:
    """Return the nominal parameters of a magnet in A/m: 0 for all but the magnetizations."""
    variations = Variations.of(magnet)
    return np.append(magnet.nominal_magnetization, np.zeros(
        (len(variations.names) if variations else 0) + len(magnet.study.uncertain_of_magnet)))


def magnetized(magnet: Magnet, distribution: Gaussian, name: str) -> Gaussian:
    """Return a distribution of parameters, those of the blocks first, if there is a field of them.

    Raises
    ------
    MeasurementError
    """
    blocks = distribution.mean[:len(magnet.nominal_magnetization)]
    if not np.isfinite(distribution.mean).all() or not blocks.any():
        raise MeasurementError(must_be(
            f"mean of {name}", f"study {magnet.name}", "finite, and of blocks with a magnetization",
            "zeros" if not blocks.any() else "what is not finite", "Was the array changed?"))
    return distribution


Field = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns a field (n, 3) in T."""


@dataclass(frozen=True)
class Deviations:
    """The blocks of a magnet whose magnetizations deviate, and vary within the blocks."""

    magnet: Magnet
    variations: Variations | None

    @classmethod
    def of(cls, magnet: Magnet) -> Deviations:
        """Return those of the study's parameters."""
        return cls(magnet, Variations.of(magnet))

    @property
    def count(self) -> int:
        """The number of parameters."""
        varying = 0 if self.variations is None else len(self.variations.names)
        return (len(self.magnet.parameter_names) + varying
                + len(self.magnet.study.uncertain_of_magnet))

    def field(self, deviations: Floats, points: Floats) -> Floats:
        """Return B (n, 3) in T at points (n, 3) in m outside of the blocks.

        ``deviations`` (parameters,) are those of the magnetizations in A/m, followed by the
        amplitudes of variations and of what is uncertain.
        """
        first = len(self.magnet.parameter_names)
        last = self.count - len(self.magnet.study.uncertain_of_magnet)
        uniform, amplitudes, uncertain = np.split(deviations, [first, last])
        if uncertain.any():
            uniform = uniform - shared_deviations(self.magnet) @ uncertain
        found = field_of(with_magnetizations(self.magnet, uniform), points)
        if uncertain.any():
            found = found + np.tensordot(uncertain, vacuum_changes(self.magnet, points), 1)
        if self.variations is not None:
            found = found + self.variations.field(amplitudes, points)
        return found

    def answered(self, deviations: Floats) -> Field:
        """Return a function of points (n, 3) in m that computes `field` and the answer of permeable
        blocks to it, with one cell a block as in the response matrix.
        """
        blocks = with_magnetizations(
            self.magnet, deviations[:len(self.magnet.parameter_names)])
        if self.magnet.dimension == 2 or not any(
                np.any(block.recoil_tensor != np.eye(3)) for block in blocks):
            return partial(self.field, deviations)
        polarized = solve_moments(blocks, cells_per_side=1)

        def field(points: Floats) -> Floats:
            return self.field(deviations, points) + polarized.reaction(points)

        return field

    def columns(self, points: Floats) -> Floats:
        """Return the matrix (3 n, parameters) from deviations to B at points (n, 3) in m, in T.

        Its rows are Bx, By and Bz of the first point, then those of the second.
        """
        size = self.magnet.dimension
        found = [unit[:, :, :size] @ (MU_0 * block.recoil_tensor[:size, :size])
                 for block, unit in zip(self.magnet.blocks, unit_fields(
                     self.magnet.blocks, points), strict=True)]
        matrix = np.concatenate(found, axis=2).reshape(3 * len(points), -1)
        columns = [matrix]
        if self.variations is not None:
            columns.append(self.variations.fields(points).reshape(3 * len(points), -1))
        if self.magnet.study.uncertain_of_magnet:
            changes = vacuum_changes(self.magnet, points).reshape(-1, 3 * len(points))
            columns.append(changes.T - matrix @ shared_deviations(self.magnet))
        return np.hstack(columns)


def with_magnetizations(magnet: Magnet, values: Floats) -> tuple[MagnetBlock, ...]:
    """Return the blocks of a magnet with magnetizations (parameters,) in A/m.

    The axes of an anisotropic permeability turn with them, by fractions of a degree.
    """
    blocks, size = [], magnet.dimension
    for block, magnetization in zip(magnet.blocks, values.reshape(-1, size), strict=True):
        remanence = MU_0 * block.recoil_tensor[:, :size] @ magnetization
        strength = float(np.linalg.norm(remanence))
        axis = vector(remanence / strength) if strength else block.easy_axis
        blocks.append(replace(block, remanence=strength, easy_axis=axis))
    return tuple(blocks)


def updated_field(
    magnet: Magnet, values: Floats, points: Floats, session: Session, estimate: bool = False
) -> Floats:
    """Return B (n, 3) in T at points (n, 3) in m of a magnet with magnetizations (parameters,) in
    A/m, by `solve_nominal`.

    Blocks of neighbours are others, and stay as they are, but for what iron of any shape answers.
    """
    updated = Magnet(magnet.study, with_magnetizations(magnet, values))
    return (solve_nominal(updated, points, session, estimate)
            + external_field(magnet, points) - external_field(updated, points))
