"""Sorting: the assignment of measured blocks to slots, before the magnet is assembled.

The multipoles are sums over the slots of the contributions of the blocks in them. The search starts
from a random assignment. It visits one slot after another, and makes the exchange with another slot
of the same type, or with a block left over, that lowers ``sum |c_n|^2`` most, until no exchange
lowers the sum. The best of several random starts is the result. All exchanges of a slot are
evaluated at once from the contribution of every block in every slot, which is computed beforehand.
The slot of a missing block stays empty.

An "order" is an assignment: an array (slots,) with the row of the table of the block in each slot.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import HalbachWarning, MeasurementError, must_be
from halbach_fe.core.notebook import ShownInNotebook
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.mounting import as_meant
from halbach_fe.inference.block_prior import (
    as_mounted,
    first_of_types,
    loose_blocks,
    shape_axes,
    types_of,
    with_types,
)
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.response.multipoles import Complexes, MultipoleModel, Multipoles
from halbach_fe.stats.gaussian import rotation_roots
from halbach_fe.study.model import Study

STARTS = 20
"""Number of random assignments from which the search starts."""

RANDOM_ORDERS = 2000
"""Number of random assignments with which the result is compared."""

WORTHWHILE = 1e-3
"""Smallest decrease of ``sum |c_n|^2`` for which blocks are exchanged, relative to the contribution
of the measurement's uncertainty to that sum, which no assignment changes."""


@dataclass(frozen=True)
class SortedBlocks(ShownInNotebook):
    """Measured blocks assigned to slots, and the multipoles that result.

    Attributes
    ----------
    study : Study
    model : MultipoleModel
    table : BlockTable
        The table of blocks with ring and slot of each; those of blocks left over are 0.
    best, numbered : Multipoles
        Multipoles of this assignment, and of the blocks in the order of the given table.
    random : ndarray, shape (orders,)
        Root mean square of the |c_n| of the mean for random assignments, in units.
    own_order : str
        Description of the order of the given table.
    left_over : int
        Number of blocks without a slot.
    """

    study: Study
    model: MultipoleModel
    table: BlockTable
    best: Multipoles
    numbered: Multipoles
    random: Floats
    own_order: str

    @property
    def left_over(self) -> int:
        """Number of blocks without a slot."""
        return int(np.sum(self.table.ring == 0))


@dataclass(frozen=True)
class _SlotResponses:
    """Contribution of every block to the multipoles in every slot.

    The contributions have no meaning for slots of a type that is not the block's.

    Attributes
    ----------
    model : MultipoleModel
    vectors : ndarray, shape (blocks, D), in A/m
        Measured magnetizations in the own axes of the blocks.
    roots : ndarray, shape (blocks, D, D), in A/m
        Covariance factors (square roots) of the measurements.
    turns : ndarray, shape (slots, D, D)
        Rotations from the own axes of a block in a slot to the axes of the magnet.
    mean : ndarray of complex, shape (1 + k, blocks, slots)
        Contributions to the coefficients C_n, the main one first.
    unwanted : ndarray, shape (blocks, slots, 2 k)
        Contributions to b_n and a_n, in units of the main multipole of blocks of average strength.
    offset : ndarray, shape (2 k,)
        The part of b_n and a_n that does not depend on the blocks.
    types, slot_types : ndarray of int, shape (blocks,) and (slots,)
        Number of the type of each block, and of the blocks that each slot takes.
    """

    model: MultipoleModel
    vectors: Floats
    roots: Floats
    turns: Floats
    mean: Complexes
    unwanted: Floats
    offset: Floats
    types: Ints
    slot_types: Ints

    def total(self, order: Ints) -> Floats:
        """Return b_n and a_n (2 k,) of an order (slots,), the block in each slot."""
        return np.asarray(
            self.offset + self.unwanted[order, np.arange(len(order))].sum(axis=0))


def sort_blocks(
    magnet: Magnet, table: BlockTable, model: MultipoleModel, generator: np.random.Generator,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SortedBlocks:
    """Assign measured blocks to slots of their type such that unwanted multipoles are small.

    Parameters
    ----------
    magnet : Magnet
    table : BlockTable
        The measured blocks.
    model : MultipoleModel
        Multipoles to make small.
    generator : numpy.random.Generator
    progress : callable, optional
        Is called with the number of starts done and their total number.

    Raises
    ------
    MeasurementError
        If the table does not fit the study, or has too few blocks of a type.
    """
    table = sortable(magnet, table)
    responses = _slot_responses(magnet, table, model)
    if len(set(table.type)) == len(table):
        warnings.warn(f"Every block of study {magnet.name} is of a different type and fits only "
                      "one slot: there is nothing to sort. State in prior.types which slots take "
                      "the same blocks, or measure spare blocks.", HalbachWarning, stacklevel=2)
    tolerance = WORTHWHILE * float(np.sum(
        _multipoles_of(magnet, responses, _table_order(responses)).root ** 2))
    best, least = _table_order(responses), np.inf
    for start in range(STARTS):
        order, square = _descent(responses, _random_order(responses, generator), tolerance)
        if square < least:
            best, least = order, square
        progress(start + 1, STARTS)
    placed = _placed_order(table, magnet)
    own = _table_order(responses) if placed is None else placed
    totals = np.array([responses.total(_random_order(responses, generator))
                       for _ in range(RANDOM_ORDERS)])
    return SortedBlocks(
        magnet.study, model, _with_places(magnet, table, best),
        _multipoles_of(magnet, responses, best), _multipoles_of(magnet, responses, own),
        np.sqrt(np.sum(totals**2, axis=1) / len(model.orders)),
        "as numbered" if placed is None else "as placed in the table")


def _slot_responses(magnet: Magnet, table: BlockTable, model: MultipoleModel) -> _SlotResponses:
    """Compute the contribution of every block to the multipoles in every slot."""
    size = magnet.dimension
    vectors, roots = loose_blocks(magnet, table)
    there = present(magnet)
    blocks = [magnet.blocks[number] for number in there]
    turns = np.array([shape_axes(block) for block in blocks])[:, :size, :size]
    columns = _columns(magnet, model)
    carried = np.einsum("ksi,sij->ksj", columns, turns)
    mean = np.einsum("ksj,bj->kbs", carried, vectors)
    labels = {label: number for number, label in enumerate(types_of(magnet))}
    type_of = {number: labels[label] for label, members in types_of(magnet).items()
               for number in members}
    # The order hardly changes the main multipole: scale it with the blocks' median strength.
    nominal = magnet.nominal_magnetization.reshape(-1, size)[there]
    main = model.nominal_main * float(np.median(np.linalg.norm(vectors, axis=1))
                                      / np.median(np.linalg.norm(nominal, axis=1)))

    def units(values: Complexes) -> Floats:
        return 1e4 / main * np.concatenate([values[1:].real, values[1:].imag])

    return _SlotResponses(
        model, vectors, roots, turns, mean, np.moveaxis(units(mean), 0, 2), units(model.offset),
        np.array([labels[label] for label in table.type]),
        np.array([type_of[number] for number in there.tolist()]))


def present(magnet: Magnet) -> Ints:
    """Return the numbers of the slots that get a block: those where none is missing."""
    return np.array([number for number, block in enumerate(magnet.blocks) if block.remanence])


def _columns(magnet: Magnet, model: MultipoleModel) -> Complexes:
    """Return the columns (1 + k, slots, D) of the model that belong to the slots with a block."""
    uniform = model.matrix[:, :magnet.dimension * len(magnet.blocks)]  # not those inside blocks
    return uniform.reshape(
        len(uniform), len(magnet.blocks), magnet.dimension)[:, present(magnet)]


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


def _table_order(responses: _SlotResponses) -> Ints:
    """Return the assignment (slots,) that takes the blocks of each type in the table's order."""
    order = np.empty(len(responses.slot_types), int)
    for number in np.unique(responses.slot_types):
        slots = np.flatnonzero(responses.slot_types == number)
        order[slots] = np.flatnonzero(responses.types == number)[:len(slots)]
    return order


def _random_order(responses: _SlotResponses, generator: np.random.Generator) -> Ints:
    """Return an assignment (slots,) that takes the blocks of each type in random order."""
    order = np.empty(len(responses.slot_types), int)
    for number in np.unique(responses.slot_types):
        slots = np.flatnonzero(responses.slot_types == number)
        members = generator.permutation(np.flatnonzero(responses.types == number))
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


def _descent(responses: _SlotResponses, order: Ints, tolerance: float) -> tuple[Ints, float]:
    """Improve an order by exchanges until none gains more than a tolerance.

    Returns
    -------
    order : ndarray of int, shape (slots,)
    square : float
        Its ``sum |c_n|^2`` in units^2, without the uncertainty.
    """
    order = order.copy()
    now, idle, slot = responses.total(order), 0, 0
    peers = [np.flatnonzero(responses.slot_types == number) for number in responses.slot_types]
    while idle < len(order):
        gain, block, other = _best_exchange(responses, order, slot, peers[slot], now)
        if gain > tolerance:
            if other is not None:
                order[other] = order[slot]
            order[slot] = block
            now, idle = responses.total(order), 0
        else:
            idle += 1
        slot = (slot + 1) % len(order)
    return order, float(now @ now)


def _best_exchange(
    responses: _SlotResponses, order: Ints, slot: int, peers: Ints, now: Floats
) -> tuple[float, int, int | None]:
    """Find the exchange of the block in a slot that lowers the sum of squares most.

    Parameters
    ----------
    order : ndarray of int, shape (slots,)
    slot : int
    peers : ndarray of int
        The slots that take the same type of block.
    now : ndarray, shape (2 k,)
        b_n and a_n of the order.

    Returns
    -------
    gain : float
        Decrease of ``sum |c_n|^2`` in units^2.
    block : int
        New block of the slot.
    other : int or None
        The slot that gets the old block; None if the old block is left over.
    """
    own, others = order[slot], order[peers]
    spare = np.setdiff1d(np.flatnonzero(responses.types == responses.slot_types[slot]), others)
    unwanted = responses.unwanted
    both = (unwanted[others, slot] + unwanted[own, peers] - unwanted[own, slot]
            - unwanted[others, peers])
    changes = np.vstack([both, unwanted[spare, slot] - unwanted[own, slot]])
    falls = -(2 * changes @ now + np.einsum("ik,ik->i", changes, changes))
    falls[:len(peers)][peers == slot] = -np.inf  # exchange of the block with itself
    best = int(np.argmax(falls))
    if best < len(peers):
        return float(falls[best]), int(others[best]), int(peers[best])
    return float(falls[best]), int(spare[best - len(peers)]), None


def _multipoles_of(magnet: Magnet, responses: _SlotResponses, order: Ints) -> Multipoles:
    """Return the multipoles of an order with their uncertainty.

    The uncertainty is that of the measured moments, of the coil's calibration and of the mounting.
    """
    every = np.arange(len(order))
    columns = _columns(magnet, responses.model)
    carried = np.einsum("ksi,sij->ksj", columns, responses.turns)
    vectors = responses.vectors[order]
    mean = responses.model.offset + responses.mean[:, order, every].sum(axis=1)
    own = np.einsum("ksi,sij->ksj", carried, responses.roots[order]).reshape(len(mean), -1)
    common = magnet.study.prior.common_mode_sd * np.einsum("ksi,si->k", carried, vectors)
    turns = np.einsum("ksi,sia->ksa", carried, rotation_roots(
        vectors, np.radians(magnet.study.prior.mounting_sd_deg)))
    inside = responses.model.matrix[:, len(magnet.blocks) * magnet.dimension:]  # each of sd 1
    return responses.model.known(mean, np.hstack([
        own, common[:, None], turns.reshape(len(mean), -1), inside]))


def _with_places(magnet: Magnet, table: BlockTable, order: Ints) -> BlockTable:
    """Return the table with ring and slot of each block, and moments in the axes of these slots.

    Ring and slot of blocks that are left over are 0, and their moments are in the axes of the first
    slot of their type.
    """
    ring, slot = np.zeros(len(table), int), np.zeros(len(table), int)
    first = first_of_types(as_meant(magnet))
    places = np.array([first[label] for label in table.type])
    for number, row in zip(present(magnet), order, strict=True):
        block = magnet.blocks[number]
        ring[row], slot[row], places[row] = block.ring, block.slot, number
    return replace(table, ring=ring, slot=slot, moment=as_mounted(magnet, table, places))
