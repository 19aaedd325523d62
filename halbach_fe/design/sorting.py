"""Sorting: the assignment of measured blocks to slots, before the magnet is assembled.

The values that the study asks to be small (see `halbach_fe.design.objective`) are sums over the
slots of the contributions of the blocks in them. The search starts from a random assignment and
makes exchanges of two or three blocks of the same type, exchanges with blocks left over and, if
allowed, turns of blocks in their slots, until none lowers the sum of squares. The best of several
random starts is the result. The slot of a missing block stays empty.

An "order" is an assignment: an array (slots,) with the row of the table of the block in each slot.

Values ``x = x_0 + sum_s T_s p_s`` are linear in the magnetizations p_s of the blocks in the slots,
in own axes. A block b that is turned by R in slot s has ``p_s = R m_b``. Taking it there changes x
by ``T_s d`` with ``d = R m_b - p_s``, and so changes ``|x|^2`` by ``2 g_s d + d K_s d``, with ``g_s
= T_s' x`` and ``K_s = T_s' T_s``. Two blocks that change places add ``2 d_s T_s' T_u d_u`` to the
sum of their own changes. So all exchanges of a slot, with all turns of both blocks, are evaluated
at once from small matrices, without the values themselves. A cycle of three is an exchange of two
after a block was put into its slot, with the block from there in hand.

If mounting turns a block by small random angles, of covariance C_b in its own axes, the expected
sum of squares has ``tr(K_s R C_b R')`` in addition.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.errors import HalbachWarning, MeasurementError, must_be
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.core.progress import Progress, quiet
from halbach_fe.design.objective import DeviationModel, Objective
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.remounting import LARGEST_ANGLE, Mounts, as_meant, mounts_of, rotation_deg
from halbach_fe.inference.block_prior import (
    as_mounted,
    first_of_types,
    loose_blocks,
    prior_from_blocks,
    types_of,
    with_types,
)
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.response.block_variation import study_prior
from halbach_fe.response.homogeneity import Homogeneity
from halbach_fe.response.multipoles import MultipoleModel
from halbach_fe.stats.gaussian import Gaussian
from halbach_fe.study.model import Study

STARTS = 20
"""Largest number of random assignments from which the search starts."""


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
    doubts : tuple of str
        Sentences about a table that may be of another magnet, see `MeasuredPrior`.
    limit : float or None
        Limit of all |c_n| in units of 1e-4, or of the rms deviation in ppm.
    left_over : int
        Number of blocks without a slot.
    has_choice : bool
        Whether any block fits more than one slot, or any slot more than one block.
    """

    study: Study
    model: Objective
    table: BlockTable
    best: Any
    numbered: Any
    fields: tuple[Homogeneity, Homogeneity] | None
    random: Floats
    own_order: str
    alike: dict[str, tuple[int, ...]]
    doubts: tuple[str, ...] = ()
    limit: float | None = None

    @property
    def left_over(self) -> int:
        """Number of blocks without a slot."""
        return int(np.sum(self.table.ring == 0))

    @property
    def has_choice(self) -> bool:
        """Whether any block fits more than one slot, or any slot more than one block."""
        return len(set(self.table.type)) < len(self.table)

    @property
    def types_in_words(self) -> str:
        """Types that the study could state, see `types_in_words`."""
        return types_in_words(self.alike, self.own_order != "as numbered")

    @property
    def matters(self) -> bool:
        """Whether orders differ at all in what is made small.

        Blocks that only change rings do not: the multipoles are those of the field along all of z.
        """
        # part of their mean by which random orders differ at most where the order does not matter
        rounding = 1e-4
        return bool(np.ptp(self.random) > rounding * np.mean(self.random))

    @property
    def turn_deg(self) -> Floats:
        """Rotation vectors (blocks, 3) in degrees, along its own axes, by which each block is to be
        turned in its slot from how it was measured.
        """
        turns = self.table.turn_deg
        return np.zeros((len(self.table), 3)) if turns is None else turns

    @property
    def turned(self) -> int:
        """Number of blocks that are turned in their slots."""
        return int(np.sum(self.turn_deg.any(axis=1)))


@dataclass(frozen=True)
class _Blocks:
    """The measured blocks, and what each of them does in each slot."""

    slots: Slots
    offset: Floats
    """The values without blocks. Shape (q,)."""
    types: Ints
    slot_types: Ints
    """Number of the type of each block, and of the blocks that each slot takes.
    Shape (blocks,) and (slots,)."""


def sort_blocks(
    magnet: Magnet, table: BlockTable, model: Objective,
    generator: np.random.Generator,
    progress: Progress = quiet, turns: bool = False,
) -> SortedBlocks:
    """Assign measured blocks to slots of their type such that the values of a model are small.

    Parameters
    ----------
    table : BlockTable
        The measured blocks.
    model : MultipoleModel or DeviationModel
        What to make small.
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
    placed = _placed_order(table, magnet)
    if len(set(table.type)) == len(table):
        types = types_in_words(alike, placed is not None)
        warnings.warn(f"Every block of study {magnet.name} is of a different type and fits only "
                      "one slot: there is nothing to sort. State in prior.types which slots take "
                      f"the same blocks{types}, or measure spare blocks.", HalbachWarning,
                      stacklevel=2)
    count = len(model.orders) if isinstance(model, MultipoleModel) else 1
    numbered = _name_places(magnet, table, _order(blocks))
    known = _assembled(magnet, numbered, model)
    as_numbered = model.of(known)
    floor = float(np.sum(as_numbered.root ** 2))
    peers = [np.flatnonzero(blocks.slot_types == number) for number in blocks.slot_types]
    fitting = [np.flatnonzero(blocks.types == number) for number in blocks.slot_types]
    best = Assignment.of(blocks.slots, _order(blocks), blocks.offset)
    # slots of all starts together: local optima of large magnets differ less, and take longer to
    # find
    started_slots = 2000
    starts = min(STARTS, max(1, started_slots // len(blocks.slot_types)))
    # smallest decrease of the sum of squares for which blocks are exchanged, relative to what the
    # measurement's uncertainty contributes to that sum, which no assignment changes
    worthwhile = 1e-3
    for start in range(starts):
        found = Assignment.of(blocks.slots, _order(blocks, generator), blocks.offset)
        descend(found, peers, fitting, worthwhile * floor, floor)
        if not start or found.square < best.square:
            best = found
        progress(start + 1, starts)
    random_orders = 2000  # number of random assignments with which the result is compared
    random = np.array([Assignment.of(
        blocks.slots, _order(blocks, generator), blocks.offset).square
        for _ in range(random_orders)])
    # assignments count in units of a main multipole that no order changes; results in their own
    in_these_units = Assignment.of(blocks.slots, _order(blocks), blocks.offset).square / count
    unit = as_numbered.rms_of_mean / np.sqrt(in_these_units) if in_these_units else 1.0
    if placed is not None:
        known = _assembled(magnet, _name_places(magnet, table, placed), model)
    result = _name_places(magnet, table, best.order, mounts.turns[best.turn])
    after = _assembled(magnet, result, model)
    return SortedBlocks(
        magnet.study, model, result, model.of(after), model.of(known),
        (model.homogeneity.of(after), model.homogeneity.of(known))
        if isinstance(model, DeviationModel) else None,
        unit * np.sqrt(random / count),
        "as numbered" if placed is None else "as placed in the table", alike,
        prior_from_blocks(magnet, result).doubts)


def types_in_words(alike: dict[str, tuple[int, ...]], given: bool) -> str:
    """Return the types that a study could state, as its file would; nothing if all slots differ.

    Blocks whose places are not ``given`` need these names, which is said too.
    """
    if all(len(slots) == 1 for slots in alike.values()):
        return ""
    found = []
    shown_slots = 6  # largest number of slots of a type that are listed one by one
    for name, slots in alike.items():
        text = ", ".join(map(str, slots))
        if len(slots) > shown_slots and slots == tuple(range(slots[0], slots[-1] + 1)):
            text = f"{slots[0]}, {slots[0] + 1}, ..., {slots[-1]}"
        found.append(f"{name} = [{text}]")
    named = "" if given else (", and write these names into the column type of the table, with "
                              "moments as mounted in the first slot of each")
    return f" ({'; '.join(found)}){named}"


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
              mounts.turns[:, :size, :size],
              classes[:, :, None] & np.eye(classes.shape[1], dtype=bool),  # others fit no slot
              class_of.ravel()[slot_types], class_of.ravel()[types]),
        model.units(np.append(main, model.offset[1:])), types, slot_types)


def _assembled(magnet: Magnet, placed: BlockTable, model: Objective) -> Gaussian:
    """Return the distribution of all parameters of an assembled magnet.

    It has the uncertainty of the measured moments, of the coil's calibration and of the mounting.
    """
    return study_prior(magnet, len(model.nominal), prior_from_blocks(magnet, placed).gaussian)


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


def _order(blocks: _Blocks, generator: np.random.Generator | None = None) -> Ints:
    """Return the assignment (slots,) that takes the blocks of each type in the table's order, or in
    random order.
    """
    order = np.empty(len(blocks.slot_types), int)
    for number in np.unique(blocks.slot_types):
        slots = np.flatnonzero(blocks.slot_types == number)
        members = np.flatnonzero(blocks.types == number)
        order[slots] = (members if generator is None
                        else generator.permutation(members))[:len(slots)]
    return order


def _placed_order(table: BlockTable, magnet: Magnet) -> Ints | None:
    """Return the assignment by the table's own rings and slots, or None if a slot has no block."""
    row_of = {place: row for row, place in enumerate(table.places) if place[0]}
    places = [magnet.blocks[number].place for number in present(magnet)]
    if not all(place in row_of for place in places):
        return None
    return np.array([row_of[place] for place in places])


def _name_places(
    magnet: Magnet, table: BlockTable, order: Ints, turns: Floats | None = None
) -> BlockTable:
    """Return the table with ring and slot of each block, and moments in the axes of these slots.

    ``turns`` (slots, 3, 3) are the rotations of the blocks in their own axes. Ring and slot of
    blocks that are left over are 0, and their moments are in the axes of the first slot of their
    type. A turn that a block has already in the table remains.
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
    before = np.eye(3) if table.turn_deg is None else Rotation.from_rotvec(
        table.turn_deg, degrees=True).as_matrix()
    turn_deg = np.array([rotation_deg(turn) for turn in turned @ before])
    return replace(table, ring=ring, slot=slot, turn_deg=turn_deg if turn_deg.any() else None,
                   moment=as_mounted(magnet, table, places, turned))


Change = tuple[float, tuple[tuple[int, int, int], ...]]
"""The change of the sum of squares by placements of blocks: slot, block and number of the turn."""


@dataclass(frozen=True)
class Slots:
    """Slots, and the blocks that may stand in them; S slots, B blocks, q values, dimension D."""

    effect: Floats
    """Change of the values by magnetizations in A/m in the own axes of each slot.
    Shape (q, S, D)."""
    blocks: Floats
    """Mean magnetizations of the blocks in own axes. Shape (B, D), in A/m."""
    spread: Floats
    """Covariances that mounting adds, in own axes. Shape (B, D, D), in A^2/m^2."""
    turns: Floats
    """Rotations of a block in its own axes; the first is the identity. Shape (n, D, D)."""
    fits: Bools
    """Turns by which blocks of a class C fit into slots of a class A. Shape (n, A, C)."""
    slot_class: Ints
    block_class: Ints
    """Shape (S,) and (B,)."""

    @cached_property
    def products(self) -> Floats:
        """K of every slot, (S, D, D)."""
        return np.einsum("qsi,qsj->sij", self.effect, self.effect)

    @cached_property
    def flat(self) -> Floats:
        """The effects as a matrix (q, S D)."""
        return np.ascontiguousarray(self.effect.reshape(len(self.effect), -1))

    @cached_property
    def choices(self) -> tuple[Ints, Bools]:
        """Numbers of the turns of each pair of classes (A, C, k), and which of them there are."""
        most = int(self.fits.sum(axis=0).max(initial=1))
        order = np.argsort(~self.fits, axis=0, kind="stable")[:most]
        return (np.moveaxis(order, 0, -1),
                np.moveaxis(np.take_along_axis(self.fits, order, 0), 0, -1))

    def gradient(self, values: Floats) -> Floats:
        """Return g of every slot, (S, D), for values (q,)."""
        return (values @ self.flat).reshape(self.effect.shape[1:])

    def mixed(self, slot: int) -> Floats:
        """Return the products (S, D, D) of the effects of a slot with those of all slots."""
        found = self.effect[:, slot].T @ self.flat
        return found.reshape(-1, *self.effect.shape[1:]).swapaxes(0, 1)

    def placed(
        self, slots: Ints, blocks: Ints, present: Floats, gradient: Floats
    ) -> tuple[Floats, Floats, Ints]:
        """Return what blocks change if they are put into slots, by all their turns.

        Parameters
        ----------
        slots, blocks : ndarray of int, shape (P,)
        present : ndarray, shape (S, D), in A/m
            Magnetizations that are in the slots now.
        gradient : ndarray, shape (S, D)

        Returns
        -------
        delta : ndarray, shape (P, k, D), in A/m
            Changes of the magnetizations in the slots.
        cost : ndarray, shape (P, k)
            Changes of the expected sum of squares; infinite for turns that do not fit.
        turn : ndarray of int, shape (P, k)
        """
        numbers, there = self.choices
        classes = self.slot_class[slots], self.block_class[blocks]
        turn = numbers[classes]
        turned = self.turns[turn]
        delta = np.einsum("pkij,pj->pki", turned, self.blocks[blocks]) - present[slots, None]
        products = self.products[slots]
        cost = np.einsum("pki,pki->pk", delta, 2 * gradient[slots, None] + delta @ products)
        if self.spread.any():
            own = turned @ self.spread[blocks, None] @ turned.swapaxes(-1, -2)
            cost = cost + np.einsum("pij,pkij->pk", products, own)
        return delta, np.where(there[classes], cost, np.inf), turn

    def exchanges(
        self, slot: int, hand: int, others: Ints, order: Ints, present: Floats, gradient: Floats
    ) -> tuple[Floats, Ints, Ints]:
        """Return the changes by putting a block in hand into other slots, whose blocks come here.

        Parameters
        ----------
        slot : int
            Takes the block of each of the other slots.
        hand : int
            The block that goes to the other slot: that of ``slot`` in an exchange of two.
        others : ndarray of int, shape (P,)
        order : ndarray of int, shape (S,)
            Block in each slot.
        present, gradient : ndarray, shape (S, D)
            See `placed`.

        Returns
        -------
        cost : ndarray, shape (P,)
            Least change of the sum of squares over all turns of both blocks.
        here, there : ndarray of int, shape (P,)
            Turns of the block that comes, and of the block in hand.
        """
        came, came_cost, came_turn = self.placed(
            np.full(len(others), slot), order[others], present, gradient)
        went, went_cost, went_turn = self.placed(
            others, np.full(len(others), hand), present, gradient)
        carried = came @ self.mixed(slot)[others]
        cost = came_cost[:, :, None] + went_cost[:, None] + 2 * carried @ went.swapaxes(1, 2)
        best = cost.reshape(len(others), -1).argmin(axis=1)
        first, second = np.divmod(best, cost.shape[2])
        every = np.arange(len(others))
        return cost[every, first, second], came_turn[every, first], went_turn[every, second]


@dataclass
class Assignment:
    """Which block stands in which slot by which turn, and the values that result."""

    slots: Slots
    order: Ints
    turn: Ints
    """Shape (S,)."""
    present: Floats
    """Magnetizations in the slots, in own axes. Shape (S, D), in A/m."""
    values: Floats
    """Shape (q,)."""

    @classmethod
    def of(cls, slots: Slots, order: Ints, start: Floats) -> Assignment:
        """Return the assignment of blocks (S,) that are not turned; ``start`` (q,) is x_0."""
        present = slots.blocks[order]
        return cls(slots, order.copy(), np.zeros(len(order), int), present,
                   start + slots.flat @ present.ravel())

    @property
    def square(self) -> float:
        """The sum of squares of the values."""
        return float(self.values @ self.values)

    @cached_property
    def gradient(self) -> Floats:
        """See `Slots.gradient`."""
        return self.slots.gradient(self.values)

    def put(self, placements: Sequence[tuple[int, int, int]]) -> None:
        """Put blocks into slots: slot, block and turn of each."""
        for slot, block, turn in placements:
            new = self.slots.turns[turn] @ self.slots.blocks[block]
            self.values = self.values + self.slots.effect[:, slot] @ (new - self.present[slot])
            self.present[slot], self.order[slot], self.turn[slot] = new, block, turn
        self.__dict__.pop("gradient", None)

    def best_placement(self, slot: int, blocks: Ints) -> Change:
        """Return the best of some blocks for a slot, and its turn: the own block, or spare ones."""
        _, cost, turn = self.slots.placed(
            np.full(len(blocks), slot), blocks, self.present, self.gradient)
        row, column = np.unravel_index(int(np.argmin(cost)), cost.shape)
        return float(cost[row, column]), ((slot, int(blocks[row]), int(turn[row, column])),)

    def best_exchange(self, slot: int, others: Ints) -> Change:
        """Return the best exchange of the block in a slot with that of another slot."""
        hand = int(self.order[slot])
        cost, here, there = self.slots.exchanges(
            slot, hand, others, self.order, self.present, self.gradient)
        best = int(np.argmin(cost))
        other = int(others[best])
        return float(cost[best]), ((slot, int(self.order[other]), int(here[best])),
                                   (other, hand, int(there[best])))

    def best_cycle(self, slot: int, others: Ints, firsts: int) -> Change:
        """Return the best cycle of three that begins with a block from another slot.

        The blocks of ``firsts`` other slots are tried, those that alone would help here most.
        """
        alone, cost, turn = self.slots.placed(
            np.full(len(others), slot), self.order[others], self.present, self.gradient)
        hand = int(self.order[slot])
        best: Change = (np.inf, ())
        column = np.argmin(cost, axis=1)
        least = cost[np.arange(len(others)), column]
        for row in np.argsort(least, kind="stable")[:firsts].tolist():
            if not np.isfinite(least[row]):
                break
            second, choice = int(others[row]), int(column[row])
            after = self.values + self.slots.effect[:, slot] @ alone[row, choice]
            third = np.delete(others, row)
            more, here, there = self.slots.exchanges(
                second, hand, third, self.order, self.present, self.slots.gradient(after))
            end = int(np.argmin(more))
            if least[row] + more[end] < best[0]:
                last = int(third[end])
                best = (float(least[row] + more[end]), (
                    (slot, int(self.order[second]), int(turn[row, choice])),
                    (second, int(self.order[last]), int(here[end])),
                    (last, hand, int(there[end]))))
        return best


def descend(assignment: Assignment, peers: Sequence[Ints], block_peers: Sequence[Ints],
            least: float, floor: float) -> None:
    """Improve an assignment by exchanges and turns, and where these do not help by cycles.

    Sweeps over all slots end when one gains less than 1 %. Magnets of more than 500
    slots are left without cycles: pairs suffice there, and cycles take long.

    Parameters
    ----------
    peers : sequence of ndarray of int
        For each slot, the slots whose blocks fit into it, itself among them.
    block_peers : sequence of ndarray of int
        For each slot, the blocks that fit into it.
    least : float
        Smallest gain for which blocks are moved.
    floor : float
        Part of the expected sum of squares that no order changes.
    """
    firsts = 8  # number of blocks that are tried in a slot as the first of a cycle of three
    def improve(slot: int, cycles: bool) -> float:
        """Make the best change at a slot; return what it gains."""
        others = peers[slot][peers[slot] != slot]
        spare = np.setdiff1d(block_peers[slot], assignment.order[peers[slot]])
        found = [assignment.best_placement(slot, np.append(spare, assignment.order[slot]))]
        if cycles and len(others) > 1:
            found.append(assignment.best_cycle(slot, others, firsts))
        elif len(others):
            found.append(assignment.best_exchange(slot, others))
        change, placements = min(found, key=lambda each: each[0])
        if change >= -least:
            return 0.0
        assignment.put(placements)
        return -change

    count, cycles = len(assignment.order), False
    most_cycles = 500  # largest number of slots for which cycles of three are tried
    # gain of a sweep over all slots, relative to the sum of squares, below which the search ends
    enough = 0.01
    while True:
        gained = sum(improve(slot, cycles) for slot in range(count))
        if gained > enough * (assignment.square + floor):
            cycles = False
        elif cycles or count > most_cycles:
            return
        else:
            cycles = True
