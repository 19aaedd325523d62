"""The prior from moments of single blocks, measured before the magnet was assembled.

The moment m of a block of the volume V is corrected for the self-demagnetization of the single
block, ``B_r = (1 + (mu - 1) N) mu_0 m / V`` (`remanence_per_polarization`; of a table of B_r there
is nothing to correct). The parameter of the model is ``M = B_r / (mu_0 mu)``, where mu and N are
tensors. The formula assumes that the block is magnetized uniformly, an error of
second order in mu - 1: for a single sector of the FASER dipole M is too large by 7e-5 at mu = 1.05
and by 2e-3 at mu = 1.3 (NGSolve, order 4). Without the correction the errors would be 1.5e-2 and
8e-2.

Deviations from the nominal magnetization are taken along it, across it in the plane of the ring,
and along z. If the place of every block is known, the prior of a block is its own measurement.
Otherwise the measured blocks of a type are samples of a normal distribution, which is the prior of
all blocks of that type. A missing block has the prior mean 0 and no uncertainty, whether its table
has a row for it or not.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Set
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import poisson

from halbach_fe.core.arrays import Floats, Ints, rms
from halbach_fe.core.errors import HalbachWarning, MeasurementError, StudyError, must_be
from halbach_fe.core.interface import ShownInNotebook, typed
from halbach_fe.core.numbers import MAD_TO_SD, decimals
from halbach_fe.geometry.blocks import MagnetBlock, rotation_about_z
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.remounting import as_meant, mountings
from halbach_fe.measurement.block_table import REMANENT, BlockTable
from halbach_fe.solver.exact_block_field import remanence_per_polarization
from halbach_fe.stats.gaussian import (
    Gaussian,
    anderson_darling,
    holm,
    measured_prior,
    predictive_covariance,
    remounted_root,
)

DIRECTIONS = ("along", "across", "z")
"""Axes of deviations: along the nominal magnetization, across it in the ring's plane, and z."""

MIN_SAMPLES = 3
"""Smallest number of measured blocks of a type from which its distribution is estimated."""

NOT_NORMAL = 0.05
"""Adjusted p-value below which samples count as not normal. A table of normally distributed blocks
is suspected in 5 % of all cases."""

OTHER_RINGS = ("If the magnet has the blocks of the table, and no others, correct rings and blocks "
               "of [array] in the study.")
"""What to do with a table of other places than the study's."""

FAR = 0.5
"""Limit of the deviation relative to the nominal magnetization: 50 %, or 29 degrees. No intact
block exceeds it; a larger deviation indicates a wrong unit, wrong axes, or a wrong type."""

MANY_SD = 5.0
"""Number of the study's standard deviations by which no mean of its own blocks is off by chance."""


@dataclass(frozen=True)
class TypeSamples:
    """The measured blocks of one type."""

    label: str
    """Name of the type."""
    deviations: Floats
    """Relative deviations from the nominal magnetization, along `DIRECTIONS`; the deviations across
    it are angles in rad. Shape (n, d)."""
    intensity: float | None
    """Intensity of the shrinkage of the covariance, if it is estimated from the samples."""
    p: Floats
    """p-values of the Anderson-Darling test for each direction, adjusted for the number of types
    and directions; NaN if a direction was not tested. Shape (d,)."""

    @property
    def normal(self) -> bool:
        """Whether the test rejects normality in no direction; True if nothing was tested."""
        return not (self.p < NOT_NORMAL).any()


@dataclass(frozen=True)
class MeasuredPrior(ShownInNotebook):
    """The prior of a magnet's magnetizations that follows from a table of measured blocks.

    Attributes
    ----------
    magnet : Magnet
    gaussian : Gaussian
        Prior of the parameters, block by block, in A/m.
    placed : bool
        Whether the prior of a block is its own measurement, not the distribution of its type.
    types : tuple of TypeSamples
        The measured blocks of every type.
    doubts : tuple of str
        Sentences about why the table and the study may not be of the same blocks.
    far : str
        A sentence that names single blocks far from the others; empty if there are none.
    """

    magnet: Magnet
    gaussian: Gaussian
    placed: bool
    types: tuple[TypeSamples, ...]
    doubts: tuple[str, ...] = ()
    far: str = ""

    @property
    def nominal(self) -> Floats:
        """Nominal magnetization (parameters,) in A/m."""
        return self.magnet.nominal_magnetization

    @property
    def count(self) -> int:
        """Number of measured blocks."""
        return sum(len(samples.deviations) for samples in self.types)


@typed
def prior_from_blocks(magnet: Magnet, table: BlockTable) -> MeasuredPrior:
    """Turn a table of measured blocks into the prior of a study.

    Parameters
    ----------
    magnet : Magnet
    table : BlockTable

    Returns
    -------
    MeasuredPrior

    Raises
    ------
    MeasurementError
        If the table does not fit the study.
    StudyError
        If the study's blocks of a type differ from each other.

    Warns
    -----
    HalbachWarning
        If the prior is the distribution of the samples of a type that do not look normal, if the
        blocks were measured at another temperature than that of the study, or if their mean is many
        of the study's standard deviations from nominal.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> magnet = hf.build_magnet(hf.read_study("dipole.toml"))
    >>> prior = hf.prior_from_blocks(magnet, hf.read_blocks("blocks.csv"))
    >>> len(prior.gaussian.mean) == len(magnet.parameter_names)
    True
    """
    size = magnet.dimension
    moves = mountings(magnet)
    meant = _prior_as_meant(as_meant(magnet), table,
                            {source for source, matrix in moves if matrix.any()})
    sources = np.array([source for source, _ in moves])
    turns = np.array([matrix * bool(block.remanence) for (_, matrix), block in zip(
        moves, magnet.blocks, strict=True)])[:, :size, :size]
    mean = meant.gaussian.mean.reshape(len(moves), size, 1)[sources]
    return replace(meant, magnet=magnet, gaussian=Gaussian(
        (turns @ mean).ravel(), remounted_root(meant.gaussian.root, turns, sources)))


def _prior_as_meant(magnet: Magnet, table: BlockTable, used: Set[int]) -> MeasuredPrior:
    """Return the prior of a magnet whose blocks are all mounted in their intended slots.

    ``used`` are the numbers of the blocks that the real magnet has; of others nothing need be
    known.
    """
    blocks, size = magnet.blocks, magnet.dimension
    members_of = types_of(magnet)
    table = with_types(magnet, table)
    _check_types(magnet, table)
    _check_complete(magnet, table, used)
    index, conversion, measured, deviations = _measured(magnet, table)
    frames = np.array([_frame(block) for block in blocks])
    deviations, frames = deviations[:, :size], frames[:, :size, :size]
    placed = bool(table.ring.any())
    members = {label: deviations[np.array(table.type) == label]
               for label, numbers in members_of.items()
               if label in table.type or (not placed and not used.isdisjoint(numbers))}
    intensities: dict[str, float | None] = dict.fromkeys(members)
    mean, own = np.zeros((len(blocks), size)), np.zeros((len(blocks), size, size))
    shared = [np.zeros((len(blocks), size, 0))]
    if placed:
        rows = np.flatnonzero(table.ring)
        mean[index[rows]] = measured[rows, :size]
        roots = table.sigma[rows, None, None] * conversion[rows]
        own[index[rows]] = (roots @ roots.transpose(0, 2, 1))[:, :size, :size]
    else:
        _check_alike(magnet,
                     lambda block: rotation_about_z(np.radians(block.angle_deg)),
                     "Give ring and slot of every measured block.")
        for label, samples in members.items():
            _check_samples(table, label, samples)
            covariance, intensities[label] = predictive_covariance(samples)
            frame = np.zeros_like(frames)
            frame[list(members_of[label])] = frames[list(members_of[label])]
            mean += frame @ (np.eye(size)[0] + samples.mean(axis=0))
            own += frame @ covariance @ frame.transpose(0, 2, 1)
            shared.append(frame @ np.linalg.cholesky(covariance / len(samples)))  # of the mean
    own[~own.any(axis=(1, 2))] = np.eye(size)  # of blocks that the magnet does not have
    gaussian = measured_prior(mean, own, np.concatenate(shared, axis=2),
                              np.radians(magnet.study.prior.mounting_sd_deg),
                              magnet.study.prior.calibration_sd)
    types = _tested(members, intensities)
    odd = [samples.label for samples in types if not samples.normal]
    if odd and not placed:
        warnings.warn(
            f"The measured blocks of type {', '.join(odd)} do not look normally distributed "
            f"(Anderson-Darling, p < {NOT_NORMAL:g} after Holm), but the prior assumes that they "
            "are: give ring and slot of every block.", HalbachWarning, stacklevel=2)
    doubts = (*_temperature_doubts(magnet, table), *_mean_doubts(magnet, members),
              *(_noise_doubts(magnet, gaussian) if placed else ()))
    far = _far_blocks(magnet, table, deviations)
    for said in (*doubts, far):
        if said:
            warnings.warn(said, HalbachWarning, stacklevel=2)
    return MeasuredPrior(magnet, gaussian, placed, types, doubts, far)


def _far_blocks(magnet: Magnet, table: BlockTable, deviations: Floats) -> str:
    """Name the blocks that deviate from nominal many times farther than the others, from their
    median and beyond what the study states; return nothing if there are none.

    ``deviations`` (rows, d) are along the nominal magnetization, and angles across it.
    """
    most_named = 3  # number of blocks far from the others that a sentence names
    if len(deviations) < MIN_SAMPLES:
        return ""
    settings = magnet.study.prior
    away = deviations - np.median(deviations, axis=0)
    stated = np.array([settings.magnitude_sd, *2 * (np.radians(settings.direction_sd_deg),)])
    usual = np.maximum(MAD_TO_SD * np.median(np.abs(away), axis=0), stated[:away.shape[1]])
    times = np.abs(away) / np.where(usual > 0, usual, np.inf)
    far = np.flatnonzero(times.max(axis=1) > MANY_SD)
    far = far[np.argsort(-times.max(axis=1)[far])]
    if not len(far):
        return ""

    def words(row: int) -> str:
        along, angle = float(away[row, 0]), float(np.degrees(np.linalg.norm(away[row, 1:])))
        if np.argmax(times[row]):
            return f"{table.serial[row]} is turned by {angle:.2g}°"
        side = "stronger" if along > 0 else "weaker"
        return f"{table.serial[row]} is {100 * abs(along):.2g} % {side}"

    named = ", block ".join(map(words, far[:most_named].tolist()))
    more = f" and {len(far) - most_named} more are so far off" if len(far) > most_named else ""
    return (f"Relative to the median of all, block {named}{more}: up to {times.max():.0f} times "
            "what is usual here. Are these rows of the table right?")


def _temperature_doubts(magnet: Magnet, table: BlockTable) -> list[str]:
    """Return a sentence if the table's temperature is not that of the study and nothing corrects.

    Tables whose temperatures differ from each other are refused elsewhere.
    """
    # Temperature coefficient of the remanence of NdFeB, for the size of the error that is told.
    ndfeb_per_k = -0.0012
    # Temperature in degrees Celsius at which data sheets state remanences, and the distance in K
    # from it at which the moments of NdFeB change by more than 1 %, a usual tolerance.
    room_c, other_temperature_k = 20.0, 10.0
    known = table.temperature[~np.isnan(table.temperature)]
    if magnet.study.prior.temperature_coefficient_per_K is not None or not len(known):
        return []
    demagnetization = magnet.study.demagnetization
    reference = room_c if demagnetization is None else demagnetization.reference_temperature_C
    away = float(np.median(known)) - reference
    if abs(away) <= other_temperature_k:
        return []
    return [f"The blocks were measured at {np.median(known):g} °C, {abs(away):g} K from "
            f"{reference:g} °C, and the study has no temperature coefficient: their moments count "
            f"as they were read there, for NdFeB some {abs(100 * ndfeb_per_k * away):.2g} % off. "
            "Add temperature_coefficient_per_K and reference_temperature_C to [prior]."]


def _mean_doubts(magnet: Magnet, members: dict[str, Floats]) -> list[str]:
    """Return a sentence if the mean of all blocks is many of the study's deviations from nominal.

    The mean of n independent blocks would be nearer by the root of n; but a table may be of blocks
    of one batch, which share a deviation that the study did not state.
    """
    deviations = np.concatenate(list(members.values()))
    settings = magnet.study.prior
    mean = float(deviations[:, 0].mean())
    sd = float(np.hypot(settings.magnitude_sd, settings.shared_sd))
    if abs(mean) <= MANY_SD * sd:
        return []
    side = "stronger" if mean > 0 else "weaker"
    return [f"The measured blocks are on average {100 * abs(mean):.2g} % {side} than the study "
            f"says, {abs(mean) / sd:.0f} times the {100 * sd:.2g} % that its [prior] allows: are "
            "remanence_T, the temperature and the unit of the moments right, and is it the table "
            "of this magnet?"]


def _noise_doubts(magnet: Magnet, gaussian: Gaussian) -> list[str]:
    """Return a sentence if the table leaves the blocks less known than the study without it, or
    better than any coil measures.

    The table takes the place of the study's own deviations, so that a sigma in another unit would
    spoil what is known, and not only add nothing.
    """
    own, across = magnet.study.prior, magnet.dimension - 1
    stated = float(np.linalg.norm((own.magnitude_sd, own.shared_sd,
                                   *across * (np.radians(own.direction_sd_deg),))))
    known = rms(gaussian.sd) / rms(magnet.nominal_magnetization)
    best = 1e-5  # of a moment: good coils repeat within some 1e-4, and are calibrated less well
    if known < best:
        return [f"With this table each block is known to {1e6 * known:.2g} ppm, better than any "
                "coil measures: is sigma_A_m2 in A m^2, and with the coil's calibration?"]
    if known <= MANY_SD * stated:
        return []
    return [f"With this table each block is known to {100 * known:.2g} % only, where the study "
            f"alone states {100 * stated:.2g} %: is sigma_A_m2 in A m^2? If the coil is so "
            "uncertain, leave the table out."]


def loose_blocks(magnet: Magnet, table: BlockTable) -> tuple[Floats, Floats]:
    """Return the magnetizations of measured blocks that are not mounted yet.

    They are given in the axes of the block's faces, so that they hold for any slot of its type.

    Returns
    -------
    mean : ndarray, shape (rows, d), in A/m
        x points radially outward, y is azimuthal, and z along the magnet. For cuboids that are
        oriented along their magnetization, x points along it. The moment of a row without a place
        is taken to be given in the axes of the first slot of its type.
    root : ndarray, shape (rows, d, d), in A/m
        Root of the covariance of each row, without the error of the coil's calibration.

    Raises
    ------
    MeasurementError
        If the table does not fit the study.
    StudyError
        If the study's blocks of a type differ from each other.
    """
    magnet, size = as_meant(magnet), magnet.dimension
    table = with_types(magnet, table)
    _check_types(magnet, table)
    _check_alike(magnet, lambda block: block.shape_axes, "Name them as types of their own.",
                 OF_OTHER_RINGS if magnet.array.rings else OF_FREE_BLOCKS)
    index, conversion, measured, _ = _measured(magnet, table)
    own = np.array([magnet.blocks[i].shape_axes.T for i in index])
    roots = own @ conversion * table.sigma[:, None, None]
    return np.einsum("nij,nj->ni", own, measured)[:, :size], roots[:, :size, :size]


def _measured(magnet: Magnet, table: BlockTable) -> tuple[Ints, Floats, Floats, Floats]:
    """Return the blocks (rows,) of a table, the factors (rows, 3, 3) of their moments, and their
    magnetizations (rows, 3) in A/m, also relative to nominal in the axes of `_frame`.
    """
    index = _block_of_rows(magnet, table)
    conversion = _conversions(magnet, table, index)
    measured = np.einsum("nij,nj->ni", conversion, _at_reference_temperature(magnet, table))
    frames = np.array([_frame(block) for block in magnet.blocks])[index]
    deviations = np.linalg.solve(frames, measured[:, :, None])[:, :, 0] - [1, 0, 0]
    _check_near(table, deviations)
    return index, conversion, measured, deviations


def as_mounted(
    magnet: Magnet, table: BlockTable, places: Ints, turned: Floats | None = None
) -> Floats:
    """Return the moments (rows, 3) in A m^2 of blocks in the axes of new slots.

    A block keeps the orientation of its faces relative to those of the slot, unless it is turned.

    Parameters
    ----------
    places : ndarray of int, shape (rows,)
        New slot of each block, counted from 0, ring by ring.
    turned : ndarray, shape (rows, 3, 3), optional
        Rotation of each block in its own axes.
    """
    index = _block_of_rows(as_meant(magnet), table)
    own = np.array([rotation_about_z(-np.radians(block.angle_deg)) @ block.shape_axes
                    for block in magnet.blocks])  # axes of the shape in those of the place
    turns = own[places] @ (np.eye(3) if turned is None else turned) @ own[index].transpose(0, 2, 1)
    return np.einsum("nij,nj->ni", turns, table.moment)


def _tested(
    members: dict[str, Floats], intensities: dict[str, float | None]
) -> tuple[TypeSamples, ...]:
    """Return the samples of every type with their tests of normality."""
    p = holm(np.array([anderson_darling(column)[1] for samples in members.values()
                       for column in samples.T])).reshape(len(members), -1)
    return tuple(TypeSamples(label, samples, intensities[label], row)
                 for (label, samples), row in zip(members.items(), p, strict=True))


def types_of(magnet: Magnet) -> dict[str, tuple[int, ...]]:
    """Return the numbers of the blocks of every type, from 0, by the label of the type.

    The study's ``prior.types`` names slots. Without it, a free block has the type of its table,
    and every other slot is a type of its own.
    """
    blocks, table = magnet.blocks, magnet.array.free_blocks
    label_of = {slot: label for label, slots in magnet.study.prior.types.items() for slot in slots}
    labels = [label_of.get(block.slot, str(block.slot)) for block in blocks]
    if table is not None and table.type and not label_of:
        first = len(blocks) - len(table)
        labels[first:] = [own or label for own, label in zip(
            table.type, labels[first:], strict=True)]
    listed = [slot for slots in magnet.study.prior.types.values() for slot in slots]
    rank = {slot: place for place, slot in enumerate(listed)}
    order = sorted(range(len(blocks)), key=lambda number: (
        rank.get(blocks[number].slot, blocks[number].slot), number))
    found: dict[str, list[int]] = {label: [] for label in magnet.study.prior.types}
    for number in order:
        found.setdefault(labels[number], []).append(number)
    return {label: tuple(members) for label, members in found.items()}


def with_types(magnet: Magnet, table: BlockTable) -> BlockTable:
    """Return a table with the types that follow from the places of its blocks, where it states
    none, or that of a slot which the study has in no other type.

    Raises
    ------
    MeasurementError
        If the table is not valid any more, as its arrays were changed after it was read.
    """
    types = types_of(magnet)
    label_of = {(magnet.blocks[number].ring, magnet.blocks[number].slot): label
                for label, members in types.items() for number in members}
    # the number of its slot is the type of a block before the study's prior.types names others
    return replace(table, type=tuple(
        label_of.get(place, "") if own == str(place[1]) and own not in types else
        own or label_of.get(place, "")
        for own, place in zip(table.type, table.places, strict=True)))


def first_of_types(magnet: Magnet) -> dict[str, int]:
    """Return the number of the first block of every type, from 0, by the label of the type.

    It is in the first slot of the type; types without blocks are left out.
    """
    present = {label: [number for number in members if magnet.blocks[number].remanence]
               for label, members in types_of(magnet).items()}
    return {label: members[0] for label, members in present.items() if members}


def _frame(block: MagnetBlock) -> Floats:
    """Return `DIRECTIONS` as columns (3, 3) of the length of the nominal magnetization in A/m."""
    x, y, _ = block.easy_axis
    level = np.hypot(x, y)
    across = np.array([-y, x, 0.0]) / level if level > 1e-9 else np.array([0.0, 1.0, 0.0])
    axes = np.column_stack([block.easy_axis, across, np.cross(block.easy_axis, across)])
    return np.asarray(axes * float(np.linalg.norm(block.magnetization)))


def _conversions(magnet: Magnet, table: BlockTable, index: Ints) -> Floats:
    """Return the matrices (rows, 3, 3) from the moments of a table in A m^2 to M in A/m.

    M is along the array's axes. A block of the study gets the measured moment, which is what its
    field is made of, and M is therefore the moment per volume of the study's block even where the
    real volume differs a little. In 2D blocks get the length of the rings, or else the median of
    those that follow from their volumes.
    """
    # Largest deviation of a measured volume from that of the study's block, relative to the latter.
    # The chamfers and tolerances of blocks change it by less.
    volume_tolerance = 0.1
    blocks, flat = magnet.blocks, magnet.dimension == 2
    length = magnet.array.ring_length_m
    if flat and not length:
        unknown = np.flatnonzero(np.isnan(table.volume))
        if len(unknown):
            raise MeasurementError(must_be(
                f"volume_m3 of block {table.serial[unknown[0]]}", table.source,
                "given for a 2D study without array.ring_length_m", "an empty cell"))
        length = float(np.median(table.volume / [blocks[number].area for number in index]))
    real = []
    for row, number in enumerate(index):
        block, volume = blocks[number], table.volume[row]
        if flat and length:
            block = replace(block, z_min=-length / 2, z_max=length / 2)
        if abs(volume / block.volume - 1) > volume_tolerance:  # False for NaN, an unknown volume
            raise MeasurementError(must_be(
                f"volume_m3 of block {table.serial[row]}", table.source,
                f"near the study's, within {100 * volume_tolerance:g} % of the "
                f"{block.volume:.4g} m^3 of its block {block.name}", f"{volume:.4g} m^3",
                "Check its unit, and the sizes of the study's blocks."))
        real.append(block)
    factors = [np.eye(3)] * len(real) if REMANENT.items() <= table.attributes.items(
        ) else remanence_per_polarization(real)
    return np.array([
        np.linalg.solve(block.recoil_tensor, factor @ rotation_about_z(np.radians(block.angle_deg)))
        / block.volume for block, factor in zip(real, factors, strict=True)])


def _at_reference_temperature(magnet: Magnet, table: BlockTable) -> Floats:
    """Return the moments (rows, 3) in A m^2 at the study's reference temperature.

    They are not changed if the study has no temperature coefficient.

    MeasurementError if a temperature is missing, or if temperatures differ and the study has no
    coefficient.
    """
    # Largest difference of temperatures at which moments count as measured at the same one. It
    # changes the moment of NdFeB, of -0.0012/K, by 0.24 %, no more than usual coils determine it.
    same_temperature_k = 2.0
    coefficient = magnet.study.prior.temperature_coefficient_per_K
    reference = magnet.study.prior.reference_temperature_C
    if coefficient is None or reference is None:  # the study has both or neither
        known = table.temperature[~np.isnan(table.temperature)]
        if len(known) and np.ptp(known) > same_temperature_k:
            raise MeasurementError(must_be(
                "temperature_C", table.source, f"the same for all blocks, to {same_temperature_k:g}"
                " K, since the study has no temperature coefficient",
                f"{known.min():g} to {known.max():g} °C", "Add temperature_coefficient_per_K and "
                "reference_temperature_C to [prior] of the study, or convert the moments."))
        return table.moment
    for serial, temperature in zip(table.serial, table.temperature, strict=True):
        if np.isnan(temperature):
            raise MeasurementError(must_be(
                f"temperature_C of block {serial}", table.source,
                "given, since the study has a temperature coefficient", "an empty cell"))
    factor = 1 + coefficient * (table.temperature - reference)
    return np.asarray(table.moment / factor[:, None])


def _check_types(magnet: Magnet, table: BlockTable) -> None:
    """Raise a MeasurementError if a type or place is not in the study."""
    places = {(block.ring, block.slot) for block in magnet.blocks if block.remanence}
    first, types = first_of_types(magnet), types_of(magnet)
    for serial, label, (ring, slot) in zip(table.serial, table.type, table.places, strict=True):
        if label and label not in first:
            raise MeasurementError(must_be(
                f"type of block {serial}", table.source,
                f"one of the study's: {', '.join(first)}", f"'{label}'",
                "Name the slots of each type in the study's prior.types, or leave the type out "
                "where ring and slot are given."))
        if ring and (ring, slot) not in places:
            raise MeasurementError(must_be(
                f"place of block {serial}", table.source,
                f"within {len(magnet.blocks_by_ring)} rings of "
                f"{', '.join(map(str, sorted(set(magnet.blocks_by_ring))))} blocks",
                f"ring {ring}, slot {slot}", OTHER_RINGS))
        if slot and magnet.number_of(ring, slot) not in types[label]:
            slots = dict.fromkeys(magnet.blocks[number].slot for number in types[label])
            raise MeasurementError(must_be(
                f"type of block {serial}", table.source, f"that of its slot {slot}",
                f"'{label}', which belongs to slot {', '.join(map(str, slots))}"))


def _check_complete(magnet: Magnet, table: BlockTable, used: Set[int]) -> None:
    """Raise a MeasurementError if some blocks have a place but not every place has a block.

    That holds for the places of the blocks with the numbers ``used``.
    """
    places = {(block.ring, block.slot) for number, block in enumerate(magnet.blocks)
              if number in used and block.remanence}
    missing = sorted(places - set(table.places))
    if table.ring.any() and missing:
        raise MeasurementError(must_be(
            "places", table.source, "given for every block of the magnet, or for none",
            f"none for ring {missing[0][0]}, slot {missing[0][1]} ({len(missing)} such places)",
            OTHER_RINGS))


def _block_of_rows(magnet: Magnet, table: BlockTable) -> Ints:
    """Return the block number (rows,) of each row; without a place, the first of its type."""
    first = first_of_types(magnet)
    return np.array([
        magnet.number_of(ring, slot) if ring else first[label]
        for label, (ring, slot) in zip(table.type, table.places, strict=True)])


def _check_near(table: BlockTable, deviations: Floats) -> None:
    """Raise a MeasurementError if a block deviates from its nominal magnetization by over `FAR`."""
    # Angle in degrees within which a moment lies along the nominal one: easy axes of blocks are a
    # few degrees off, other axes of a block 90.
    along_deg = 5.0
    ratios = np.linalg.norm(deviations + np.eye(3)[0], axis=1)
    far = np.flatnonzero(np.linalg.norm(deviations, axis=1) > FAR)
    if not len(far):
        return
    row = int(far[0])
    ratio = ratios[row]
    angle = np.degrees(np.arccos(np.clip((deviations[row, 0] + 1) / ratio, -1, 1)))
    where = "as mounted" if table.ring[row] else "as mounted in the first slot of its type"
    hint = (f"Are the moments in the block's own axes {where} (x radially outward), and is that "
            "its type?")
    if not 0.03 < np.median(ratios) < 30 or (
            angle < along_deg and np.ptp(ratios) < FAR * np.median(ratios)):
        hint = "Are moments and volumes in A m^2 and m^3?"
    raise MeasurementError(must_be(
        f"moment of block {table.serial[row]}", table.source,
        f"within {100 * FAR:g} % of the study's nominal one",
        f"{decimals(ratio)} times as large, {angle:.3g} degrees away ({len(far)} such blocks)",
        hint))


def _check_samples(table: BlockTable, label: str, deviations: Floats) -> None:
    """Raise a MeasurementError if a type has too few samples, samples without any spread, or the
    same sample twice, whose spread is none of theirs.
    """
    if len(deviations) < MIN_SAMPLES:
        raise MeasurementError(must_be(
            f"blocks of type {label}", table.source,
            f"at least {MIN_SAMPLES} where places are not given", str(len(deviations)),
            "Give ring and slot of every block, or join types in the study's prior.types."))
    constant = np.ptp(deviations, axis=0) == 0
    if constant.any():
        name = DIRECTIONS[int(np.argmax(constant))]
        raise MeasurementError(must_be(
            f"blocks of type {label}", table.source, "different in every direction",
            f"the same moment {name} in all", "Was that component measured?"))
    of_type = np.flatnonzero(np.array(table.type) == label)
    moments = table.moment[of_type]
    _, first = np.unique(moments, axis=0, return_index=True)
    rare = 1e-3  # probability of as many equal moments by rounding alone
    if len(first) < len(moments) and poisson.sf(
            len(moments) - len(first) - 1, _equal_by_rounding(moments)) < rare:
        again = int(np.setdiff1d(np.arange(len(moments)), first)[0])
        same = int(np.flatnonzero((moments == moments[again]).all(axis=1))[0])
        raise MeasurementError(must_be(
            f"blocks of type {label}", table.source, "measured one by one",
            f"{len(moments) - len(first)} with the moment of another one, digit for digit, such as "
            f"{table.serial[of_type[again]]} and {table.serial[of_type[same]]}",
            "Leave the copies out."))


def _equal_by_rounding(moments: Floats) -> float:
    """Return how many pairs of different samples (n, 3) are expected to have the same moment.

    Two normal samples that are rounded to steps q agree with a probability q / (2 sqrt(pi) sd). The
    steps are taken for the smallest differences between samples.
    """
    probability = 1.0
    for values in moments.T:
        distinct = np.unique(values)
        step = float(np.diff(distinct).min()) if len(distinct) > 1 else np.inf
        probability *= min(1.0, step / (2 * np.sqrt(np.pi) * max(values.std(), 1e-300)))
    return probability * len(moments) * (len(moments) - 1) / 2


OF_OTHER_RINGS = (
    "A type has the same slots in all rings. Where rings differ, list the blocks as "
    "`array.free_blocks` (halbach-fe export STUDY --format blocks), add a column `type` to that "
    "table, and leave the types out of the table of measured blocks.")
"""What to do about blocks of one slot that are not alike."""

OF_FREE_BLOCKS = (
    "Add a column `type` to the table of `array.free_blocks`, equal for blocks that may change "
    "places, and leave the types out of the table of measured blocks.")
"""What to do about free blocks whose types are not stated and that are not alike."""


def _check_alike(
    magnet: Magnet, axes: Callable[[MagnetBlock], Floats], hint: str, of_a_slot: str = ""
) -> None:
    """Raise a StudyError if the study's blocks of a type differ, seen from their own axes.

    ``axes`` returns the axes of a block as columns (3, 3). A moment must mean the same deviation
    from the nominal magnetization for all blocks of a type. The advice ``of_a_slot`` takes the
    place of ``hint`` if the blocks have the same slot.
    """
    blocks = magnet.blocks
    finite = [replace(block, z_min=0.0, z_max=1.0) if magnet.dimension == 2 else block
              for block in blocks]
    factors = remanence_per_polarization(finite)
    seen = np.array([
        np.linalg.solve(block.recoil_tensor @ _frame(block), factor @ axes(block)) / block.volume
        if block.remanence else np.zeros((3, 3))
        for block, factor in zip(finite, factors, strict=True)])
    for label, own in types_of(magnet).items():
        members = [number for number in own if blocks[number].remanence]
        first = members[0] if members else -1
        for number in members[1:]:
            if np.abs(seen[number] - seen[first]).max() > 1e-6 * np.abs(seen[first]).max():
                stated = label in magnet.study.prior.types
                alike = blocks[number].slot == blocks[first].slot
                raise StudyError(must_be(
                    f"`prior.types.{label}`" if stated else f"type {label}",
                    f"study {magnet.name}", "of blocks that are alike from their own axes",
                    f"{blocks[first].name} and {blocks[number].name}, of another magnetization, "
                    "permeability or shape", (alike and of_a_slot) or hint))
