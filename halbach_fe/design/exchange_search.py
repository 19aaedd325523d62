"""Exchanges of blocks that make a sum of squares small: of two blocks, of three, and turns.

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

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints

Change = tuple[float, tuple[tuple[int, int, int], ...]]
"""The change of the sum of squares by placements of blocks: slot, block and number of the turn."""

FIRSTS = 8
"""Number of blocks that are tried in a slot as the first of a cycle of three."""

MOST_CYCLES = 500
"""Largest number of slots for which cycles of three are tried."""

ENOUGH = 0.01
"""Gain of a sweep over all slots, relative to the sum of squares, below which the search ends."""


@dataclass(frozen=True)
class Slots:
    """Slots, and the blocks that may stand in them; S slots, B blocks, q values, dimension D.

    Attributes
    ----------
    effect : ndarray, shape (q, S, D)
        Change of the values by magnetizations in A/m in the own axes of each slot.
    blocks : ndarray, shape (B, D), in A/m
        Mean magnetizations of the blocks in own axes.
    spread : ndarray, shape (B, D, D), in A^2/m^2
        Covariances that mounting adds, in own axes.
    turns : ndarray, shape (n, D, D)
        Rotations of a block in its own axes; the first is the identity.
    fits : ndarray of bool, shape (n, A, C)
        Turns by which blocks of a class C fit into slots of a class A.
    slot_class, block_class : ndarray of int, shape (S,) and (B,)
    """

    effect: Floats
    blocks: Floats
    spread: Floats
    turns: Floats
    fits: NDArray[np.bool_]
    slot_class: Ints
    block_class: Ints

    @cached_property
    def products(self) -> Floats:
        """K of every slot, (S, D, D)."""
        return np.einsum("qsi,qsj->sij", self.effect, self.effect)

    @cached_property
    def flat(self) -> Floats:
        """The effects as a matrix (q, S D)."""
        return np.ascontiguousarray(self.effect.reshape(len(self.effect), -1))

    @cached_property
    def choices(self) -> tuple[Ints, NDArray[np.bool_]]:
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
    """Which block stands in which slot by which turn, and the values that result.

    Attributes
    ----------
    slots : Slots
    order, turn : ndarray of int, shape (S,)
    present : ndarray, shape (S, D), in A/m
        Magnetizations in the slots, in own axes.
    values : ndarray, shape (q,)
    """

    slots: Slots
    order: Ints
    turn: Ints
    present: Floats
    values: Floats

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

    Sweeps over all slots end when one gains less than `ENOUGH`. Magnets of more than `MOST_CYCLES`
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
    def improve(slot: int, cycles: bool) -> float:
        """Make the best change at a slot; return what it gains."""
        others = peers[slot][peers[slot] != slot]
        spare = np.setdiff1d(block_peers[slot], assignment.order[peers[slot]])
        found = [assignment.best_placement(slot, np.append(spare, assignment.order[slot]))]
        if cycles and len(others) > 1:
            found.append(assignment.best_cycle(slot, others, FIRSTS))
        elif len(others):
            found.append(assignment.best_exchange(slot, others))
        change, placements = min(found, key=lambda each: each[0])
        if change >= -least:
            return 0.0
        assignment.put(placements)
        return -change

    count, cycles = len(assignment.order), False
    while True:
        gained = sum(improve(slot, cycles) for slot in range(count))
        if gained > ENOUGH * (assignment.square + floor):
            cycles = False
        elif cycles or count > MOST_CYCLES:
            return
        else:
            cycles = True
