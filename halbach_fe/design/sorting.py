"""Which of the measured blocks should go into which slot, before the magnet is assembled.

The multipoles are sums over the slots of what a block does there. From a random order, slot after
slot makes the exchange with another of its type, or with a block left over, that lowers
``sum |c_n|^2`` most, until none lowers it; the best of several random starts counts. All exchanges
of a slot are tried at once, by columns that are computed once.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.errors import HalbachWarning, MeasurementError, must_be
from halbach_fe.geometry.array_layout import facing_angle_deg
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.symmetry import rotation_about_z
from halbach_fe.inference.block_prior import as_mounted, loose_blocks, types_of
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.response.multipoles import Complexes, MultipoleModel, Multipoles
from halbach_fe.stats.gaussian import rotated
from halbach_fe.study.model import Study

STARTS = 20
RANDOM_ORDERS = 2000

ENOUGH = 1e-3
"""An exchange that lowers the sum by less than this part of its variance, which no order can
change, is not worth it."""


@dataclass(frozen=True)
class Sorted:
    """A table of blocks with their slots, and what comes of it.

    Attributes
    ----------
    table : BlockTable
        With ring and slot; blocks left over have none.
    best, numbered : Multipoles
        Of this order, and of that in which the table has them.
    random : ndarray, shape (orders,)
        Root mean square of |c_n| in units, of the mean of random orders.
    reference : str
        What the table's own order is.
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
        """Blocks without a slot."""
        return int(np.sum(self.table.ring == 0))


@dataclass(frozen=True)
class _Bench:
    """What every block does in every slot of its type.

    Attributes
    ----------
    mean : ndarray of complex, shape (1 + k, blocks, slots)
        Of C; meaningless in slots of other types.
    unwanted : ndarray, shape (blocks, slots, 2 k)
        The same in units of the nominal main multipole.
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
        """b_n, a_n (2 k,) of an order, the block in each slot (slots,)."""
        return np.asarray(
            self.offset + self.unwanted[order, np.arange(len(order))].sum(axis=0))


def sort_blocks(
    magnet: Magnet, table: BlockTable, model: MultipoleModel, generator: np.random.Generator,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Sorted:
    """Assign blocks to slots within each type.

    Raises
    ------
    MeasurementError
        If the table does not fit the study, or has too few blocks of a type.
    """
    bench = _bench(magnet, table, model)
    _check_numbers(magnet, table)
    if len(set(table.type)) == len(table):
        warnings.warn(f"Every block of study {magnet.name} is of a type of its own and fits one "
                      "slot only: there is nothing to sort. Say in prior.types which slots take "
                      "the same blocks, or measure spare ones.", HalbachWarning, stacklevel=2)
    tolerance = ENOUGH * float(np.sum(_known(magnet, bench, _numbered(bench)).root ** 2))
    best, least = _numbered(bench), np.inf
    for start in range(STARTS):
        order, square = _descent(bench, _random(bench, generator), tolerance)
        if square < least:
            best, least = order, square
        progress(start + 1, STARTS)
    placed = _as_placed(table, magnet)
    own = _numbered(bench) if placed is None else placed
    totals = np.array([bench.total(_random(bench, generator)) for _ in range(RANDOM_ORDERS)])
    return Sorted(
        magnet.study, model, _with_places(magnet, table, best), _known(magnet, bench, best),
        _known(magnet, bench, own), np.sqrt(np.sum(totals**2, axis=1) / len(model.orders)),
        "as numbered" if placed is None else "as placed in the table")


def _bench(magnet: Magnet, table: BlockTable, model: MultipoleModel) -> _Bench:
    size, blocks = magnet.dimension, magnet.blocks
    vectors, roots = loose_blocks(magnet, table)
    turns = np.array([rotation_about_z(np.radians(facing_angle_deg(magnet.array, block.slot)))
                      for block in blocks])[:, :size, :size]
    columns = model.matrix.reshape(len(model.matrix), len(blocks), size)
    carried = np.einsum("ksi,sij->ksj", columns, turns)
    mean = np.einsum("ksj,bj->kbs", carried, vectors)
    labels = {label: number for number, label in enumerate(types_of(magnet))}
    of_slot = {slot: labels[label] for label, slots in types_of(magnet).items() for slot in slots}
    # with the main multipole that the blocks have on average
    main = model.nominal_main * float(np.median(np.linalg.norm(vectors, axis=1))
                                      / np.median(_sizes(model.nominal, size)))

    def units(values: Complexes) -> Floats:
        return 1e4 / main * np.concatenate([values[1:].real, values[1:].imag])

    return _Bench(model, vectors, roots, turns, mean, np.moveaxis(units(mean), 0, 2),
                  units(model.offset), np.array([labels[label] for label in table.type]),
                  np.array([of_slot[block.slot] for block in blocks]))


def _sizes(vectors: Floats, size: int) -> Floats:
    return np.linalg.norm(vectors.reshape(-1, size), axis=1)


def _check_numbers(magnet: Magnet, table: BlockTable) -> None:
    for label, slots in types_of(magnet).items():
        needed, there = len(slots) * magnet.array.rings, table.type.count(label)
        if there < needed:
            raise MeasurementError(must_be(
                f"blocks of type {label}", table.source, f"enough for the {needed} slots of that "
                "type", str(there), "Measure more, or join types in the study's prior.types."))


def _numbered(bench: _Bench) -> Ints:
    """Blocks of each type in the order of the table, the block in each slot (slots,)."""
    order = np.empty(len(bench.slot_types), int)
    for number in np.unique(bench.slot_types):
        slots = np.flatnonzero(bench.slot_types == number)
        order[slots] = np.flatnonzero(bench.types == number)[:len(slots)]
    return order


def _random(bench: _Bench, generator: np.random.Generator) -> Ints:
    order = np.empty(len(bench.slot_types), int)
    for number in np.unique(bench.slot_types):
        slots = np.flatnonzero(bench.slot_types == number)
        members = generator.permutation(np.flatnonzero(bench.types == number))
        order[slots] = members[:len(slots)]
    return order


def _as_placed(table: BlockTable, magnet: Magnet) -> Ints | None:
    """The order that the table itself has, if every slot has a block."""
    there = {place: row for row, place in enumerate(table.places) if place[0]}
    places = [(block.ring, block.slot) for block in magnet.blocks]
    if not all(place in there for place in places):
        return None
    return np.array([there[place] for place in places])


def _descent(bench: _Bench, order: Ints, tolerance: float) -> tuple[Ints, float]:
    """The order with the best exchange made for one slot after another, until none gains more than
    the tolerance; and its sum of squares.
    """
    order = order.copy()
    now, idle, slot = bench.total(order), 0, 0
    peers = [np.flatnonzero(bench.slot_types == number) for number in bench.slot_types]
    while idle < len(order):
        gain, block, other = _best_exchange(bench, order, slot, peers[slot], now)
        if gain > tolerance:
            if other is not None:
                order[other] = order[slot]
            order[slot] = block
            now, idle = bench.total(order), 0
        else:
            idle += 1
        slot = (slot + 1) % len(order)
    return order, float(now @ now)


def _best_exchange(
    bench: _Bench, order: Ints, slot: int, peers: Ints, now: Floats
) -> tuple[float, int, int | None]:
    """What the best exchange of a slot's block gains; its new block, and the slot that gets the old
    one, None if that is left over.
    """
    own, others = order[slot], order[peers]
    spare = np.setdiff1d(np.flatnonzero(bench.types == bench.slot_types[slot]), others)
    unwanted = bench.unwanted
    both = (unwanted[others, slot] + unwanted[own, peers] - unwanted[own, slot]
            - unwanted[others, peers])
    changes = np.vstack([both, unwanted[spare, slot] - unwanted[own, slot]])
    falls = -(2 * changes @ now + np.einsum("ik,ik->i", changes, changes))
    falls[:len(peers)][peers == slot] = -np.inf  # the block with itself
    best = int(np.argmax(falls))
    if best < len(peers):
        return float(falls[best]), int(others[best]), int(peers[best])
    return float(falls[best]), int(spare[best - len(peers)]), None


def _known(magnet: Magnet, bench: _Bench, order: Ints) -> Multipoles:
    """Multipoles of an order, with what the table, the coil's calibration and the mounting leave
    open.
    """
    every, size = np.arange(len(order)), bench.vectors.shape[1]
    columns = bench.model.matrix.reshape(len(bench.model.matrix), len(order), size)
    carried = np.einsum("ksi,sij->ksj", columns, bench.turns)
    vectors = bench.vectors[order]
    mean = bench.model.offset + bench.mean[:, order, every].sum(axis=1)
    own = np.einsum("ksi,sij->ksj", carried, bench.roots[order]).reshape(len(mean), -1)
    common = magnet.study.prior.common_mode_sd * np.einsum("ksi,si->k", carried, vectors)
    turns = np.einsum("ksi,sia->ksa", carried, rotated(
        vectors, np.radians(magnet.study.prior.mounting_sd_deg)))
    return bench.model.known(mean, np.hstack([
        own, common[:, None], turns.reshape(len(mean), -1)]))


def _with_places(magnet: Magnet, table: BlockTable, order: Ints) -> BlockTable:
    """The table with ring and slot; blocks left over have none, and the axes of the first slot."""
    ring, slot = np.zeros(len(table), int), np.zeros(len(table), int)
    places = np.array([types_of(magnet)[label][0] - 1 for label in table.type])
    for number, (row, block) in enumerate(zip(order, magnet.blocks, strict=True)):
        ring[row], slot[row], places[row] = block.ring, block.slot, number
    return replace(table, ring=ring, slot=slot, moment=as_mounted(magnet, table, places))
