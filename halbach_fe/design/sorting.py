"""Sorting: the assignment of measured blocks to slots, before the magnet is assembled.

The values that the study asks to be small (see `halbach_fe.design.objective`) are sums over the
slots of the contributions of the blocks in them. The search starts from a random assignment and
makes exchanges of two or three blocks of the same type, exchanges with blocks left over and, if
allowed, turns of blocks in their slots, until none lowers the sum of squares (see
`halbach_fe.design.exchange_search`). The best of several random starts is the result. The slot of a
missing block stays empty.

An "order" is an assignment: an array (slots,) with the row of the table of the block in each slot.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import HalbachWarning, MeasurementError, must_be
from halbach_fe.core.notebook import ShownInNotebook
from halbach_fe.design.exchange_search import Assignment, Slots, descend
from halbach_fe.design.objective import Objective
from halbach_fe.design.remounting import LARGEST_ANGLE, Mounts, mounts_of, rotation_deg
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.mounting import as_meant
from halbach_fe.inference.block_prior import (
    as_mounted,
    first_of_types,
    loose_blocks,
    prior_from_blocks,
    types_of,
    with_types,
)
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.response.block_variation import with_variations
from halbach_fe.response.deviations import DeviationModel
from halbach_fe.response.homogeneity import Homogeneity
from halbach_fe.response.multipoles import MultipoleModel
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.model import Study

STARTS, STARTED_SLOTS = 20, 2000
"""Largest number of random assignments from which the search starts, and the slots of all of them
together: local optima of large magnets differ less, and take longer to find."""

RANDOM_ORDERS = 2000
"""Number of random assignments with which the result is compared."""

SHOWN_SLOTS = 6
"""Largest number of slots of a type that are listed one by one."""

WORTHWHILE = 1e-3
"""Smallest decrease of the sum of squares for which blocks are exchanged, relative to what the
measurement's uncertainty contributes to that sum, which no assignment changes."""


SAME = 1e-4
"""Part of their mean by which random orders differ at most where the order does not matter."""


@dataclass(frozen=True)
class SortedBlocks(ShownInNotebook):
    """Measured blocks assigned to slots, and what results.

    Attributes
    ----------
    study : Study
    model : MultipoleModel or DeviationModel
    table : BlockTable
        The table of blocks with ring and slot of each; those of blocks left over are 0. Moments are
        those of the turned blocks.
    turn_deg : ndarray, shape (blocks, 3)
        Rotation vector in degrees, along its own axes, by which each block is to be turned in its
        slot.
    best, numbered : Multipoles or Deviations
        Of this assignment, and of the blocks in the order of the given table.
    fields : tuple of two Homogeneity, or None
        The same if the study asks for a homogeneous field.
    random : ndarray, shape (orders,)
        Root mean square of the |c_n| of the mean in units, or of the deviations in ppm, for random
        assignments.
    own_order : str
        Description of the order of the given table.
    alike : dict of str to tuple of int
        Slots that could take the same blocks, by a name for their type.
    left_over : int
        Number of blocks without a slot.
    has_choice : bool
        Whether any block fits more than one slot, or any slot more than one block.
    """

    study: Study
    model: MultipoleModel | DeviationModel
    table: BlockTable
    turn_deg: Floats
    best: Any
    numbered: Any
    fields: tuple[Homogeneity, Homogeneity] | None
    random: Floats
    own_order: str
    alike: dict[str, tuple[int, ...]]

    @property
    def left_over(self) -> int:
        """Number of blocks without a slot."""
        return int(np.sum(self.table.ring == 0))

    @property
    def has_choice(self) -> bool:
        """Whether any block fits more than one slot, or any slot more than one block."""
        return len(set(self.table.type)) < len(self.table)

    @property
    def matters(self) -> bool:
        """Whether orders differ at all in what is made small.

        Blocks that only change rings do not: the multipoles are those of the field along all of z.
        """
        return bool(np.ptp(self.random) > SAME * np.mean(self.random))

    @property
    def turned(self) -> int:
        """Number of blocks that are turned in their slots."""
        return int(np.sum(self.turn_deg.any(axis=1)))


@dataclass(frozen=True)
class _Blocks:
    """The measured blocks, and what each of them does in each slot.

    Attributes
    ----------
    slots : Slots
    offset : ndarray, shape (q,)
        The values without blocks.
    types, slot_types : ndarray of int, shape (blocks,) and (slots,)
        Number of the type of each block, and of the blocks that each slot takes.
    """

    slots: Slots
    offset: Floats
    types: Ints
    slot_types: Ints


def sort_blocks(
    magnet: Magnet, table: BlockTable, model: MultipoleModel | DeviationModel,
    generator: np.random.Generator,
    progress: Callable[[int, int], None] = lambda done, total: None, turns: bool = False,
) -> SortedBlocks:
    """Assign measured blocks to slots of their type such that the values of a model are small.

    Parameters
    ----------
    magnet : Magnet
    table : BlockTable
        The measured blocks.
    model : MultipoleModel or DeviationModel
        What to make small.
    generator : numpy.random.Generator
    progress : callable, optional
        Is called with the number of starts done and their total number.
    turns : bool
        Whether blocks may be turned in their slots, as far as their shapes and nominal
        magnetizations allow.

    Raises
    ------
    MeasurementError
        If the table does not fit the study, or has too few blocks of a type.
    """
    table = sortable(magnet, table)
    mounts = mounts_of(as_meant(magnet))
    blocks = _blocks(magnet, table, model, mounts, turns)
    alike = _alike(magnet, mounts)
    if len(set(table.type)) == len(table):
        warnings.warn(f"Every block of study {magnet.name} is of a different type and fits only "
                      "one slot: there is nothing to sort. State in prior.types which slots take "
                      f"the same blocks{types_in_words(alike)}, or measure spare blocks.",
                      HalbachWarning, stacklevel=2)
    count = len(model.orders) if isinstance(model, MultipoleModel) else 1
    numbered = _with_places(magnet, table, _table_order(blocks))
    known = _assembled(magnet, numbered, model)
    as_numbered = model.of(known)
    floor = float(np.sum(as_numbered.root ** 2))
    peers = [np.flatnonzero(blocks.slot_types == number) for number in blocks.slot_types]
    fitting = [np.flatnonzero(blocks.types == number) for number in blocks.slot_types]
    best = Assignment.of(blocks.slots, _table_order(blocks), blocks.offset)
    starts = min(STARTS, max(1, STARTED_SLOTS // len(blocks.slot_types)))
    for start in range(starts):
        found = Assignment.of(blocks.slots, _random_order(blocks, generator), blocks.offset)
        descend(found, peers, fitting, WORTHWHILE * floor, floor)
        if not start or found.square < best.square:
            best = found
        progress(start + 1, starts)
    random = np.array([Assignment.of(
        blocks.slots, _random_order(blocks, generator), blocks.offset).square
        for _ in range(RANDOM_ORDERS)])
    # assignments count in units of a main multipole that no order changes; results in their own
    in_these_units = Assignment.of(blocks.slots, _table_order(blocks), blocks.offset).square / count
    unit = as_numbered.rms_of_mean / np.sqrt(in_these_units) if in_these_units else 1.0
    if (placed := _placed_order(table, magnet)) is not None:
        known = _assembled(magnet, _with_places(magnet, table, placed), model)
    turned = np.zeros((len(table), 3))
    turned[best.order] = np.array([rotation_deg(turn) for turn in mounts.turns])[best.turn]
    result = _with_places(magnet, table, best.order, mounts.turns[best.turn])
    after = _assembled(magnet, result, model)
    return SortedBlocks(
        magnet.study, model, result, turned, model.of(after), model.of(known),
        (model.homogeneity.of(after), model.homogeneity.of(known))
        if isinstance(model, DeviationModel) else None,
        unit * np.sqrt(random / count),
        "as numbered" if placed is None else "as placed in the table", alike)


def types_in_words(alike: dict[str, tuple[int, ...]]) -> str:
    """Return the types that a study could state, as its file would; nothing if all slots differ."""
    if all(len(slots) == 1 for slots in alike.values()):
        return ""
    found = []
    for name, slots in alike.items():
        text = ", ".join(map(str, slots))
        if len(slots) > SHOWN_SLOTS and slots == tuple(range(slots[0], slots[-1] + 1)):
            text = f"{slots[0]}, {slots[0] + 1}, ..., {slots[-1]}"
        found.append(f"{name} = [{text}]")
    return f" ({'; '.join(found)})"


def _alike(magnet: Magnet, mounts: Mounts) -> dict[str, tuple[int, ...]]:
    """Return slots whose blocks are equal from their own axes, by names a, b, ..."""
    seen: dict[tuple[object, ...], list[int]] = {}
    blocks = as_meant(magnet).blocks
    by_slot: dict[int, list[tuple[object, ...]]] = {}
    for block, kind, direction in zip(blocks, mounts.kinds.tolist(), mounts.designed, strict=True):
        by_slot.setdefault(block.slot, []).append((kind, *(direction.round(6) + 0.0).tolist()))
    for slot, kinds in sorted(by_slot.items()):
        if len(set(kinds)) == 1:
            seen.setdefault(kinds[0], []).append(slot)
        else:  # rings differ here
            seen.setdefault(tuple(kinds), []).append(slot)
    return {f"type_{number}": tuple(slots) for number, slots in enumerate(seen.values(), start=1)}


def _blocks(
    magnet: Magnet, table: BlockTable, model: Objective, mounts: Mounts, turns: bool
) -> _Blocks:
    """Compute the effects of magnetizations in all slots, and which turns are possible."""
    size = magnet.dimension
    vectors, _ = loose_blocks(magnet, table)
    there = present(magnet)
    frames = np.array([magnet.blocks[number].shape_axes for number in there])[:, :size, :size]
    # The order hardly changes the main multipole: scale it with the blocks' median strength.
    nominal = magnet.nominal_magnetization.reshape(-1, size)[there]
    main = model.nominal_main * float(np.median(np.linalg.norm(vectors, axis=1))
                                      / np.median(np.linalg.norm(nominal, axis=1)))
    columns = model.scaled(main)[:, :size * len(magnet.blocks)]  # not those inside blocks
    effect = columns.reshape(len(columns), len(magnet.blocks), size)[:, there]
    labels = {label: number for number, label in enumerate(types_of(magnet))}
    type_of = {number: labels[label] for label, members in types_of(magnet).items()
               for number in members}
    types = np.array([labels[label] for label in table.type])
    slot_types = np.array([type_of[number] for number in there.tolist()])
    # blocks of a type are alike from their own axes, and so are their turns
    possible = mounts.allowed & (np.einsum(
        "si,tij,sj->ts", mounts.designed, mounts.turns, mounts.designed) > np.cos(LARGEST_ANGLE))
    first = {type_of[number]: number for number in reversed(there.tolist())}
    by_type = np.array([possible[:, first[number]] if turns and number in first
                        else np.arange(len(possible)) == 0 for number in range(len(labels))]).T
    classes, class_of = np.unique(by_type, axis=1, return_inverse=True)
    spread = np.zeros((len(table), size, size))  # no order changes what mounting adds
    return _Blocks(
        Slots(np.einsum("qsi,sij->qsj", effect, frames), vectors, spread,
              mounts.turns[:, :size, :size], _same(classes), class_of.ravel()[slot_types],
              class_of.ravel()[types]),
        model.units(np.append(main, model.offset[1:])), types, slot_types)


def _same(classes: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return turns (n, A, A) of blocks in slots of their own class (n, A); none in others."""
    return np.asarray(classes[:, :, None] & np.eye(classes.shape[1], dtype=bool))


def _assembled(magnet: Magnet, placed: BlockTable, model: MultipoleModel | DeviationModel
               ) -> Gaussian:
    """Return the distribution of the magnetizations, and variations inside, of an assembled magnet.

    It has the uncertainty of the measured moments, of the coil's calibration and of the mounting.
    """
    known = prior_from_blocks(magnet, placed).gaussian
    return with_variations(known, len(model.nominal) - len(known.mean))


def present(magnet: Magnet) -> Ints:
    """Return the numbers of the slots that get a block: those where none is missing."""
    return np.array([number for number, block in enumerate(magnet.blocks) if block.remanence])


def sortable(magnet: Magnet, table: BlockTable) -> BlockTable:
    """Return a table with the types of all blocks, if they can be sorted into the magnet.

    Raises
    ------
    MeasurementError
        If the table does not fit the study, or has too few blocks of a type.
    """
    table = with_types(as_meant(magnet), table)
    loose_blocks(magnet, table)  # which refuses blocks of another magnet
    for label, members in types_of(magnet).items():
        needed = sum(bool(magnet.blocks[number].remanence) for number in members)
        measured = table.type.count(label)
        if measured < needed:
            raise MeasurementError(must_be(
                f"blocks of type {label}", table.source, f"enough for the {needed} slots of that "
                "type", str(measured),
                "Measure more blocks, or join types in the study's prior.types."))
    return table


def _table_order(blocks: _Blocks) -> Ints:
    """Return the assignment (slots,) that takes the blocks of each type in the table's order."""
    order = np.empty(len(blocks.slot_types), int)
    for number in np.unique(blocks.slot_types):
        slots = np.flatnonzero(blocks.slot_types == number)
        order[slots] = np.flatnonzero(blocks.types == number)[:len(slots)]
    return order


def _random_order(blocks: _Blocks, generator: np.random.Generator) -> Ints:
    """Return an assignment (slots,) that takes the blocks of each type in random order."""
    order = np.empty(len(blocks.slot_types), int)
    for number in np.unique(blocks.slot_types):
        slots = np.flatnonzero(blocks.slot_types == number)
        members = generator.permutation(np.flatnonzero(blocks.types == number))
        order[slots] = members[:len(slots)]
    return order


def _placed_order(table: BlockTable, magnet: Magnet) -> Ints | None:
    """Return the assignment by the table's own rings and slots, or None if a slot has no block."""
    row_of = {place: row for row, place in enumerate(table.places) if place[0]}
    places = [(magnet.blocks[number].ring, magnet.blocks[number].slot)
              for number in present(magnet)]
    if not all(place in row_of for place in places):
        return None
    return np.array([row_of[place] for place in places])


def _with_places(
    magnet: Magnet, table: BlockTable, order: Ints, turns: Floats | None = None
) -> BlockTable:
    """Return the table with ring and slot of each block, and moments in the axes of these slots.

    ``turns`` (slots, 3, 3) are the rotations of the blocks in their own axes. Ring and slot of
    blocks that are left over are 0, and their moments are in the axes of the first slot of their
    type.
    """
    ring, slot = np.zeros(len(table), int), np.zeros(len(table), int)
    first = first_of_types(as_meant(magnet))
    places = np.array([first[label] for label in table.type])
    turned = np.tile(np.eye(3), (len(table), 1, 1))
    if turns is not None:
        turned[order] = turns
    for number, row in zip(present(magnet), order, strict=True):
        block = magnet.blocks[number]
        ring[row], slot[row], places[row] = block.ring, block.slot, number
    return replace(table, ring=ring, slot=slot, moment=as_mounted(magnet, table, places, turned))
