"""Shimming: which blocks to exchange, turn or replace so that the field becomes better.

What is to become small are the values of an `halbach_fe.design.objective`: unwanted multipoles in
units of 1e-4, or deviations of |B| in ppm. They are linear in the magnetizations, and a moved block
keeps its magnetization in its own axes. What a block changes in a slot is therefore a product with
a matrix, as when blocks are sorted, so that a hundred thousand swaps are evaluated quickly. A slot
takes part in at most one move. Moves are added one after another, each time the one with the
largest expected decrease of the sum of squares, until this decrease is no larger than its own
standard deviation. Then each move is replaced by a better one as long as that lowers the sum.

The distribution of the moved blocks is the transformed posterior, which is exact. If the blocks
were measured before they were mounted, the magnetization of a mounted block is ``p = w + u``. Here
w is the magnetization of the block itself, and ``u = t x w`` the change by the small angles t of
its mounting. Taking the block out removes u, and mounting it again adds another, independent one.
With the prior ``p ~ N(m_0, C_0)``, of which ``u ~ N(0, U)`` is a part,

    ``u = K (p - m_0) + e``,  ``K = U C_0^-1``,  ``e ~ N(0, U - U C_0^-1 U)``,

and e is independent of the readings, which depend on p only.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, Literal

import numpy as np
import scipy.linalg as linalg

from halbach_fe.core.arrays import Bools, Floats, Ints
from halbach_fe.core.errors import MeasurementError, StudyError, must_be
from halbach_fe.core.interface import ShownInNotebook
from halbach_fe.design.objective import DeviationModel, Known, Objective
from halbach_fe.design.sorting import Slots
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.remounting import Mounts, as_meant, mounts_of, remounted
from halbach_fe.inference.block_prior import first_of_types, loose_blocks, with_types
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.response.block_variation import prior_of_blocks
from halbach_fe.response.homogeneity import Homogeneity
from halbach_fe.stats.gaussian import Gaussian, nominal_prior, rotation_roots
from halbach_fe.study.model import Study

Kind = Literal["swap", "cycle", "turn", "replace"]

GAIN_SDS = 1.0
"""Smallest ratio of the expected gain of a move to the standard deviation of that gain, for which
the move is made."""

MOST_NUMBERS = 3e8
"""Largest number of ways to put a block into a slot, and twice that of possible swaps: more take
too much memory and time."""

STOPS = {"target": "the limit is met", "uncertainty": "further moves would gain less than the "
         "uncertainty of what they gain", "budget": "the allowed number of moves is reached",
         "nothing": "no other block fits into any slot"}
"""Reasons for the end of the search, in words."""


@dataclass(frozen=True)
class Placement:
    """A block put into a slot."""

    to: int
    """The new slot, counted from 0, ring by ring."""
    block: int
    """The slot that the block was in, or, for spare blocks, the number of slots plus the number of
    the spare block."""
    turn: int
    """Number of the block's rotation in `Mounts.turns`."""


@dataclass(frozen=True)
class Move:
    """A swap (two placements), a cyclic exchange of three blocks (three placements), a turn or a
    replacement (one placement each).
    """

    kind: Kind
    placements: tuple[Placement, ...]


@dataclass(frozen=True)
class Step:
    """A move, its expected gain, and the values after it.

    The gain is the decrease of the sum of squares in units^2, or of the mean square deviation in
    ppm^2, with its standard deviation.
    """

    move: Move
    gain: float
    gain_sd: float
    after: Known


@dataclass(frozen=True)
class Shim(ShownInNotebook):
    """Moves of blocks in their order, and the multipoles, or the field, before and after.

    Attributes
    ----------
    result : InferenceResult
        The inference from which the moves are chosen.
    model : MultipoleModel or DeviationModel
        What the study asks for: small multipoles, or a homogeneous field.
    mounts : Mounts
        The slots of the magnet.
    spares : tuple of str
        Names of the spare blocks.
    before : Multipoles or Deviations
    steps : tuple of Step
    stop : str
        Reason for the end of the search, a key of `STOPS`.
    tried : dict
        Number of possible moves of each kind.
    limit : float or None
        Limit of all |c_n| in units of 1e-4, or of the rms deviation in ppm.
    within : tuple of two floats, or None
        Probabilities that the limit is met, before and after the moves; None without a limit.
    fields : tuple of two Homogeneity, or None
        The field in the study's region before and after the moves; None if the study asks for
        multipoles.
    after : Multipoles or Deviations
        The same as ``before``, after all moves.
    shimmed_study : Study or None
        The study with the moves of blocks as exceptions; None if a study cannot express them, or
        need not.
    """

    result: InferenceResult
    model: Any
    mounts: Mounts
    spares: tuple[str, ...]
    before: Any
    steps: tuple[Step, ...]
    stop: str
    tried: dict[Kind, int]
    limit: float | None
    within: tuple[float, float] | None
    fields: tuple[Homogeneity, Homogeneity] | None

    @property
    def after(self) -> Any:
        """Multipoles or deviations after all moves."""
        return self.steps[-1].after if self.steps else self.before

    @property
    def magnet(self) -> Magnet:
        """The measured magnet, before the moves."""
        return self.result.magnet

    @property
    def study(self) -> Study:
        """The study of the measured magnet."""
        return self.magnet.study

    @cached_property
    def shimmed_study(self) -> Study | None:
        """The study with the moves of blocks as exceptions, or None if it cannot express them.

        A replaced block is one as designed, because a study does not identify individual blocks;
        None also if the study says that already.
        """
        changed = self._changed
        return None if changed is None or changed.study == self.study else changed.study

    @property
    def unsaid(self) -> bool:
        """Whether the exceptions of a study cannot express the moves."""
        return self._changed is None

    @cached_property
    def _changed(self) -> Magnet | None:
        """The magnet after the moves, see `remounted`.

        Uncertain amplitudes of exceptions, which moves renumber, are left out if there are any.
        """
        slots, magnet = len(self.mounts.places), self.magnet
        every = [placement for step in self.steps for placement in step.move.placements]
        if every:
            magnet = magnet.with_(uncertain=tuple(
                one for one in self.study.uncertain
                if not any(name.startswith("array.exceptions") for name in one.change)))
        return remounted(
            magnet, [(placement.to, placement.block, self.matrix(placement))
                     for placement in every if placement.block < slots],
            [placement.to for placement in every if placement.block >= slots])

    def matrix(self, placement: Placement) -> Floats:
        """Return the rotation (3, 3) of a block's magnetization from its old to its new slot."""
        return (self.mounts.carried(placement.to, placement.turn)
                @ self.mounts.frames[placement.block].T)


@dataclass(frozen=True)
class SpareBlocks:
    """Spare blocks that may replace others, with independent uncertainties."""

    names: tuple[str, ...]
    mean: Floats
    """Means of the magnetizations in own axes (see `halbach_fe.geometry.remounting`).
    Shape (n, 3), in A/m."""
    covariance: Floats
    """Covariances of the magnetizations in own axes. Shape (n, 3, 3), in A^2/m^2."""
    direction: Floats
    """Directions of the nominal magnetizations in own axes. Shape (n, 3)."""
    kind: Ints
    """Kinds of the blocks as in `Mounts.kinds`. Shape (n,)."""
    slot: Ints
    """The only slot, counted from 0, that a block may go into; -1 for blocks without such a
    restriction. Shape (n,)."""


@dataclass(frozen=True)
class _Goal:
    """The limit of the values, and standard normal numbers (draws, k) to test it with."""

    limit: float | None
    normals: Floats

    def within(self, known: Known) -> float:
        """Return the probability that the limit is met; 0 without a limit."""
        return 0.0 if self.limit is None else known.share_within(self.limit, self.normals)

    def met(self, known: Known) -> bool:
        """Return whether the values are within the limit with sufficient probability."""
        sure = 0.95  # probability that the limit is met, at which the search ends
        return self.within(known) >= sure


@dataclass(frozen=True)
class _MoveModel:
    """Distribution of the blocks in their slots and taken out, from which moves are evaluated.

    S is the number of slots, B that of blocks including the spare ones, D the dimension.
    """

    model: Objective
    mounts: Mounts
    mean: Floats
    """Posterior mean of the mounted blocks, along the axes of the magnet. Shape (S, D), in A/m."""
    placed: Floats
    """Covariance factor of the mounted blocks, along the axes of the magnet.
    Shape (S, D, q), in A/m."""
    beside: Gaussian | None
    """Uncertain amplitudes and what the blocks of neighbours deviate, with the same columns."""
    loose_mean: Floats
    """Mean of the blocks once they are taken out, in own axes. Shape (B, D), in A/m."""
    loose: Floats
    """Covariance factor of the same, with the same q columns as ``placed``.
    Shape (B, D, q), in A/m."""
    own: Floats
    """Covariance factor of the independent error of each block when it is mounted again, in own
    axes; for spare blocks it includes their own uncertainty. Shape (B, D, D), in A/m."""
    fits: Bools
    """Which blocks fit which slots by which turns. Shape (turns, S, B)."""

    @property
    def size(self) -> int:
        """Dimension of the magnet, D."""
        return self.mean.shape[1]

    @cached_property
    def columns(self) -> Any:
        """The matrix of the objective, shape (1 + k, S, D)."""
        return self._of_blocks(self.model.matrix)

    def _of_blocks(self, rows: Any) -> Any:
        """Return the part (k, S, D) of rows (k, parameters) that is of the blocks."""
        return rows[:, :self.mean.size].reshape(len(rows), *self.mean.shape)

    @cached_property
    def start(self) -> tuple[Any, Any]:
        """Mean (1 + k,) and root (1 + k, q) of the products with the matrix, without moves."""
        model: Any = self.model
        blocks, others = np.hsplit(model.matrix, [self.mean.size])
        mean, root = Gaussian(
            self.mean.ravel(), self.placed.reshape(self.mean.size, -1), self.beside).products(
                blocks, np.hstack([others, model.of_neighbours]))
        return model.offset + mean, root

    @cached_property
    def slots(self) -> Slots:
        """What every block changes in every slot, relative to the main multipole or mean field as
        it is, which moves hardly change.
        """
        scaled = self._of_blocks(self.model.scaled(self.main))
        return Slots(np.einsum("qsi,sij->qsj", scaled, self.frames), self.loose_mean,
                     self.own @ self.own.transpose(0, 2, 1),
                     self.mounts.turns[:, :self.size, :self.size], self.fits,
                     np.arange(len(self.mean)), np.arange(len(self.loose_mean)))

    @property
    def main(self) -> float:
        """Main multipole or mean field, without moves."""
        return float(abs(self.start[0][0]))

    @property
    def frames(self) -> Floats:
        """`Mounts.frames` reduced to the dimension of the magnet, (S, D, D)."""
        return self.mounts.frames[:, :self.size, :self.size]

    @cached_property
    def present(self) -> Floats:
        """The means of the mounted blocks in the own axes of their slots, (S, D)."""
        return np.einsum("sij,si->sj", self.frames, self.mean)

    def values(self, chosen: Sequence[Move]) -> Floats:
        """Return the means of the values (k,) after moves, relative to `main`."""
        mean, _ = self.products(chosen)
        return self.model.units(np.concatenate([[self.main], mean[1:]]))

    def carried(self, placement: Placement) -> Floats:
        """Return `Mounts.carried` reduced to the dimension of the magnet, (D, D)."""
        return self.mounts.carried(placement.to, placement.turn)[:self.size, :self.size]

    def products(self, moves: Sequence[Move]) -> tuple[Any, Any]:
        """Return mean and root of the products with the matrix after moves, which are exact."""
        return reduce(self.moved, moves, self.start)

    def moved(self, before: tuple[Any, Any], move: Move) -> tuple[Any, Any]:
        """Return mean and root of the products with the matrix after a further move.

        The independent errors of the newly mounted blocks are appended to the root as columns.
        """
        mean, root = before
        width = self.start[1].shape[1]
        root, fresh = root[:, :width], [root[:, width:]]
        for placement in move.placements:
            to, block = placement.to, placement.block
            columns = self.columns[:, to]
            carried = columns @ self.carried(placement)
            mean = mean + carried @ self.loose_mean[block] - columns @ self.mean[to]
            root = root + carried @ self.loose[block] - columns @ self.placed[to]
            fresh.append(carried @ self.own[block])
        return mean, np.hstack([root, *fresh])

    def after(self, moves: Sequence[Move]) -> Any:
        """Return the values after moves."""
        return self.model.known(*self.products(moves))

    def magnetizations(self, moves: Sequence[Move]) -> Gaussian:
        """Return the distribution of the mounted blocks after moves, in A/m."""
        mean, root = self.mean.copy(), self.placed.copy()
        fresh = []
        for placement in (placement for move in moves for placement in move.placements):
            to, block = placement.to, placement.block
            carried = self.carried(placement)
            mean[to], root[to] = carried @ self.loose_mean[block], carried @ self.loose[block]
            fresh.append(np.zeros((*mean.shape, self.size)))
            fresh[-1][to] = carried @ self.own[block]
        every = np.concatenate([root, *fresh], axis=2).reshape(mean.size, -1)
        return Gaussian(mean.ravel(), every, _widened(self.beside, every.shape[1]))

    def gains(
        self, chosen: Sequence[Move], further: Sequence[Move]
    ) -> list[tuple[float, float]]:
        """Return expected gain and its standard deviation of each further move (see `gain`)."""
        state = self.products(chosen)
        now = self.model.known(*state)
        return [gain(now, self.model.known(*self.moved(state, move))) for move in further]


def shim(
    result: InferenceResult, model: Objective, generator: np.random.Generator,
    budget: Mapping[Kind, int], limit: float | None = None, stock: BlockTable | None = None,
) -> Shim:
    """Choose moves that make the multipoles, or the deviations of |B|, of a measured magnet small.

    Parameters
    ----------
    result : InferenceResult
        The inference whose posterior describes the blocks.
    model : MultipoleModel or DeviationModel
        What the same study asks for; |B| linearized about the posterior mean.
    generator : numpy.random.Generator
        Draws the samples from which the probability of meeting the limit is estimated.
    budget : mapping
        Largest number of moves of each kind.
    limit : float, optional
        Limit of every |c_n| in units of 1e-4, or of the rms deviation in ppm. The search ends when
        it is met. Without a limit it ends when further moves would gain too little.
    stock : BlockTable, optional
        Measured blocks that may replace others. Default: new blocks that are distributed as in the
        study's prior.

    Raises
    ------
    StudyError
        If the study has variations inside blocks, or there are too many possible moves.
    MeasurementError
        If the stock does not fit the study, or its blocks are in the magnet.
    """
    check_shimming(result.study)
    magnet = result.magnet
    if stock:
        check_stock(magnet, stock, result.measured_blocks)
    mounts = mounts_of(magnet)
    spares = _measured_spares(magnet, mounts, stock) if stock else _nominal_spares(magnet, mounts)
    if not budget.get("replace"):
        spares = _no_spares()
    move_model = _build_move_model(result, model, mounts, spares)
    tried = {kind: count for kind, count in _possible_moves(move_model).items()
             if budget.get(kind)}
    before = model.of(result.posterior)
    # number of samples from which that probability is estimated, with a standard error of 0.3 %
    draws = 4000
    goal = _Goal(limit, generator.standard_normal((draws, len(before.mean))))
    chosen, stop = _search(move_model, budget, goal)
    steps = _steps_by_gain(move_model, chosen, goal)
    within = None
    if limit is not None:
        within = goal.within(before), goal.within(steps[-1].after if steps else before)
    fields = None
    if isinstance(model, DeviationModel):
        shimmed = move_model.magnetizations([step.move for step in steps])
        fields = model.homogeneity.of(result.posterior), model.homogeneity.of(shimmed)
    return Shim(result, model, mounts, spares.names, before, steps, stop, tried,
                limit, within, fields)


def check_shimming(study: Study) -> None:
    """Raise a StudyError if blocks of this study cannot be moved to other slots.

    The amplitudes of variations inside blocks belong to the field of a block in its own slot.
    """
    if study.prior.variation_sd:
        raise StudyError(must_be(
            "`prior.variation_sd`", f"study {study.name}", "0 for shimming",
            f"{study.prior.variation_sd:g}", "Remove prior.variation_sd and "
            "prior.variation_length_m: a moved block's own variation is not known in its new "
            "slot."))


def check_stock(
    magnet: Magnet, stock: BlockTable, mounted: Collection[str] | None
) -> None:
    """Refuse a stock whose blocks do not fit the magnet, or stand in it already.

    ``mounted``: serial numbers of the blocks in the magnet, if they are known.

    Raises
    ------
    MeasurementError
        If a block has a place, or the serial number of a block in the magnet, or does not fit.
    """
    for serial, (ring, slot) in zip(stock.serial, stock.places, strict=True):
        if ring:
            raise MeasurementError(must_be(
                f"ring and slot of block {serial}", stock.source,
                "empty, as a block of the stock stands in no slot", f"ring {ring}, slot {slot}",
                "Remove the blocks that are in the magnet, and state the type of the others."))
        if serial in (mounted or ()):
            raise MeasurementError(must_be(
                "serial", stock.source, "of blocks that are not in the magnet",
                f"{serial}, which the table of the magnet's blocks has too", "Remove it from one "
                "of the tables."))
    _measured_spares(magnet, mounts_of(magnet), stock)


def taken_out(result: InferenceResult) -> tuple[Floats, Floats, Floats]:
    """Return the distribution of the blocks once they are taken out of their mounts.

    In the notation of this module's docstring, the magnetization of mounted blocks is p and that
    of blocks that are taken out is w.

    Returns
    -------
    mean : ndarray, shape (m,), in A/m
        Mean of w, along the axes of the magnet.
    loose, placed : ndarray, shape (m, q), in A/m
        Covariance factors of w and of p. Their columns belong to the same independent variables, so
        that they also give the covariance between w and p.
    """
    study, blocks, rounding = result.study, result.of_blocks, 1e-9
    before, after = blocks.prior, blocks.posterior
    sd, root = np.radians(study.prior.mounting_sd_deg), np.asarray(after.root)
    if not sd:  # the prior has no mounting errors
        return after.mean, root, root
    alone = prior_of_blocks(result.magnet)
    if result.measured_blocks is None and (before.sd < (1 - rounding) * alone.sd).any():
        before = alone  # that was an earlier update, which does not say what is of the mounting
    turns = linalg.block_diag(*_turn_covariance(
        before.mean.reshape(-1, study.dimension), sd))
    share = _times_inverse(turns, before.covariance)
    rest = _covariance_root(turns - share @ turns)
    whole = np.eye(len(share)) - share
    return (after.mean - share @ (after.mean - before.mean),
            np.hstack([whole @ root, -rest]),
            np.hstack([root, np.zeros_like(rest)]))


def _times_inverse(matrix: Floats, covariance: Floats) -> Floats:
    """Return a matrix times the inverse of a covariance.

    If the covariance is singular, as with missing blocks, it is the pseudo-inverse.
    """
    try:
        return np.asarray(linalg.cho_solve(linalg.cho_factor(covariance), matrix.T).T)
    except linalg.LinAlgError:
        return np.asarray(matrix @ linalg.pinvh(covariance))


def _turn_covariance(vectors: Floats, sd: float) -> Floats:
    """Return covariances (n, d, d) of the change of magnetizations (n, d) by random rotations.

    ``sd`` is the standard deviation of the angles about each axis, in rad.
    """
    root = rotation_roots(vectors, sd)
    return np.asarray(root @ root.transpose(0, 2, 1))


def _covariance_root(covariance: Floats) -> Floats:
    """Return a square root (..., d, d) of covariances, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0))[..., None, :])


def _build_move_model(
    result: InferenceResult, model: Objective, mounts: Mounts, spares: SpareBlocks
) -> _MoveModel:
    """Transform the posterior of the mounted blocks to own axes, and append the spare blocks."""
    size, count = result.study.dimension, len(mounts.places)
    known = result.of_blocks.posterior
    mean, loose, placed = taken_out(result)
    back = mounts.frames[:, :size, :size].transpose(0, 2, 1)
    own_mean = np.vstack([np.einsum("nij,nj->ni", back, mean.reshape(count, size)),
                          spares.mean[:, :size]])
    columns = loose.shape[1]
    own_loose = np.concatenate([back @ loose.reshape(count, size, columns),
                                np.zeros((len(spares.names), size, columns))])
    alone = _turn_covariance(own_mean, np.radians(result.study.prior.mounting_sd_deg))
    alone[count:] += spares.covariance[:, :size, :size]
    fits = mounts.fits(np.vstack([mounts.current, spares.direction]),
                       np.concatenate([mounts.current_kinds, spares.kind]))
    bound = np.flatnonzero(spares.slot >= 0)  # only into their own slot, and not turned
    fits[:, :, count + bound] = False
    fits[0, spares.slot[bound], count + bound] = True
    return _MoveModel(
        model, mounts, known.mean.reshape(count, size),
        placed.reshape(count, size, columns), _widened(known.beside, columns), own_mean,
        own_loose, _covariance_root(alone), fits)


def _widened(known: Gaussian | None, columns: int) -> Gaussian | None:
    """Return a distribution whose root has so many columns, the last of them zeros."""
    if known is None:
        return None
    root = np.asarray(known.root)
    return Gaussian(known.mean, np.pad(root, ((0, 0), (0, columns - root.shape[1]))))


def _no_spares() -> SpareBlocks:
    """Return an empty set of spare blocks."""
    return SpareBlocks((), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)),
                       np.zeros(0, int), np.zeros(0, int))


def _nominal_spares(magnet: Magnet, mounts: Mounts) -> SpareBlocks:
    """Return a new block for every slot with a block, distributed as in the study's prior."""
    size, settings = magnet.dimension, magnet.study.prior
    vectors = np.array([block.magnetization for block in as_meant(magnet).blocks])
    prior = nominal_prior(vectors[:, :size].ravel(), size, settings.magnitude_sd,
                        settings.direction_sd_deg, magnet.study.shared_sds)
    roots = np.asarray(prior.root).reshape(len(vectors), size, -1)
    own = np.zeros((len(vectors), 3, 3))
    for number, rows in enumerate(roots):
        back = mounts.frames[number, :size, :size].T
        own[number, :size, :size] = back @ rows @ rows.T @ back.T
    mean = np.einsum("nji,nj->ni", mounts.frames, vectors)
    there = np.flatnonzero(mounts.designed.any(axis=1))
    return SpareBlocks(("nominal",) * len(there), mean[there], own[there],
                       mounts.designed[there], mounts.kinds[there], there)


def _measured_spares(magnet: Magnet, mounts: Mounts, table: BlockTable) -> SpareBlocks:
    """Return the blocks of a table; the error of their coil's calibration counts for each block.

    The calibration error is common to all blocks. It is treated as independent here, because
    `SpareBlocks` have independent uncertainties.
    """
    size = magnet.dimension
    table = with_types(as_meant(magnet), table)
    mean, root = loose_blocks(magnet, table)
    number = first_of_types(as_meant(magnet)) | first_of_types(magnet)
    first = np.array([number[label] for label in table.type])
    own, spread = np.zeros((len(table), 3)), np.zeros((len(table), 3, 3))
    own[:, :size], spread[:, :size, :size] = mean, root
    common = magnet.study.prior.calibration_sd**2 * np.einsum("ni,nj->nij", own, own)
    covariance = spread @ spread.transpose(0, 2, 1) + common
    return SpareBlocks(table.serial, own, covariance, mounts.designed[first], mounts.kinds[first],
                       np.full(len(table), -1))


def _possible_moves(move_model: _MoveModel) -> dict[Kind, int]:
    """Return the number of possible moves of each kind; of cycles without their turns.

    StudyError if there are more than `MOST_NUMBERS` allows.
    """
    slots = len(move_model.mean)
    ways = move_model.fits.sum(axis=0, dtype=float)
    inside = ways[:, :slots] - np.diag(move_model.fits[0].diagonal())  # without those that stay
    apart = inside - np.diag(inside.diagonal())
    there = np.minimum(apart, 1)
    swaps = float(np.sum(apart * apart.T)) / 2
    if max(move_model.fits.size, 2 * swaps) > MOST_NUMBERS:
        raise StudyError(must_be(
            "magnet", "shim", "one of a few hundred blocks",
            f"one of {slots} with {swaps:.0f} possible swaps",
            "Sort its blocks before it is assembled (halbach-fe sort), and fill a tray with small "
            "magnets after it is measured (halbach-fe shim-tray)."))
    return {"cycle": round(float(np.einsum("ij,ji->", there @ there, there)) / 3),
            "swap": round(swaps), "turn": round(float(np.trace(inside))),
            "replace": round(float(ways[:, slots:].sum()))}


def _search(
    move_model: _MoveModel, budget: Mapping[Kind, int], goal: _Goal
) -> tuple[list[Move], str]:
    """Return the chosen moves, and the reason for the end of the search (a key of `STOPS`).

    Moves are added and then replaced by better ones, alternately, until none can be added.
    """
    chosen: list[Move] = []
    stop = "nothing"
    while True:
        count = len(chosen)
        chosen, stop = _add_moves(move_model, budget, goal, chosen)
        if len(chosen) == count:
            return chosen, stop
        chosen = _exchange_moves(move_model, chosen)


def _add_moves(
    move_model: _MoveModel, budget: Mapping[Kind, int], goal: _Goal, chosen: list[Move],
) -> tuple[list[Move], str]:
    """Add the moves of largest expected gain one by one; return them and why no more are added."""
    # number of moves of each kind, the best by an approximate gain, whose exact gain is computed
    shortlist_size = 24
    while True:
        now = move_model.after(chosen)
        if goal.met(now):
            return chosen, "target"
        left = [kind for kind in budget
                if sum(move.kind == kind for move in chosen) < budget[kind]]
        if not left:
            return chosen, "budget"
        shortlist = [move for kind in left
                     for move in _best_moves(move_model, kind, chosen, shortlist_size)]
        if not shortlist:
            return chosen, "nothing"
        gains = move_model.gains(chosen, shortlist)
        best = int(np.argmax([expected for expected, _ in gains]))
        if gains[best][0] <= GAIN_SDS * gains[best][1]:
            return chosen, "uncertainty"
        chosen = [*chosen, shortlist[best]]


def _exchange_moves(move_model: _MoveModel, chosen: list[Move]) -> list[Move]:
    """Replace each move by the best of its kind, given the others, until no move improves."""
    better = True
    # smallest relative decrease of the sum for which a move is replaced by another
    least_gain = 1e-6
    while better:
        better = False
        for move in list(chosen):
            others = [other for other in chosen if other is not move]
            found = _best_moves(move_model, move.kind, others, 1)
            now = move_model.after(chosen).expected_square
            if found and move_model.after([*others, found[0]]).expected_square < (
                    1 - least_gain) * now:
                chosen, better = [*others, found[0]], True
    return chosen


def _best_moves(
    move_model: _MoveModel, kind: Kind, chosen: Sequence[Move], count: int
) -> list[Move]:
    """Return the best moves of a kind, with slots and blocks that no chosen move uses.

    They are ranked by the sum of squares of the mean after the move plus the variance that
    mounting adds. The change of the remaining variance is neglected.
    """
    used = {number for move in chosen for placement in move.placements
            for number in (placement.to, placement.block)}
    free = np.array([number for number in range(len(move_model.own)) if number not in used])
    own, spares = free[free < len(move_model.mean)], free[free >= len(move_model.mean)]
    now = move_model.values(chosen)
    changes = (_swaps(move_model, own, now) if kind == "swap" else
               _cycles(move_model, own, now) if kind == "cycle" else
               _single(move_model, own, spares if kind == "replace" else None, now))
    every = [each for each in changes if len(each[0])]
    if not every:
        return []
    costs, placements = map(np.concatenate, zip(*every, strict=True))
    best = np.argsort(costs, kind="stable")[:count]
    return [Move(kind, tuple(Placement(*each) for each in placements[number].tolist()))
            for number in best if np.isfinite(costs[number])]


Changes = Iterator[tuple[Floats, Ints]]
"""Changes (n,) of the expected sum of squares by moves, and their placements (n, parts, 3): slot,
block and turn of each."""


def _single(model: _MoveModel, own: Ints, spares: Ints | None, now: Floats) -> Changes:
    """Yield the effects of putting spare blocks into slots; without these, of turns."""
    gradient = model.slots.gradient(now)
    for slot in own.tolist():
        blocks = np.array([slot]) if spares is None else spares
        _, cost, turn = model.slots.placed(
            np.full(len(blocks), slot), blocks, model.present, gradient)
        stays = (blocks[:, None] == slot) & (turn == 0)
        yield np.where(stays, np.inf, cost).ravel(), np.stack([
            np.full_like(turn, slot), np.broadcast_to(blocks[:, None], turn.shape), turn],
            axis=-1).reshape(-1, 1, 3)


def _swaps(model: _MoveModel, own: Ints, now: Floats) -> Changes:
    """Yield the effects of exchanging two blocks, by the best of their turns."""
    gradient, order = model.slots.gradient(now), np.arange(len(model.mean))
    for slot in own[:-1].tolist():
        others = own[own > slot]
        cost, here, there = model.slots.exchanges(
            slot, slot, others, order, model.present, gradient)
        this = np.full(len(others), slot)
        yield cost, np.stack([np.column_stack([this, others, here]),
                              np.column_stack([others, this, there])], axis=1)


def _cycles(model: _MoveModel, own: Ints, now: Floats) -> Changes:
    """Yield the effects of cyclic exchanges of three blocks.

    All possible ones are too many. They begin with the 200 best placements by themselves, i into j;
    each goes on with j into every m, and m into i, by the best of their turns.
    """
    first_of_cycles = 200
    slots, order = model.slots, np.arange(len(model.mean))
    to, block = (each.ravel() for each in np.meshgrid(own, own, indexing="ij"))
    to, block = to[to != block], block[to != block]
    delta, cost, turn = slots.placed(to, block, model.present, slots.gradient(now))
    best = np.argsort(cost, axis=None, kind="stable")[:first_of_cycles]
    for number in best if len(own) > 2 else ():
        row, column = np.unravel_index(number, cost.shape)
        j, i = int(to[row]), int(block[row])
        others = own[(own != i) & (own != j)]
        after = now + slots.effect[:, j] @ delta[row, column]
        more, here, there = slots.exchanges(
            i, j, others, order, model.present, slots.gradient(after))
        same = np.ones(len(others), int)
        yield cost[row, column] + more, np.stack([
            np.column_stack([j * same, i * same, turn[row, column] * same]),
            np.column_stack([others, j * same, there]),
            np.column_stack([i * same, others, here])], axis=1)


def _steps_by_gain(
    move_model: _MoveModel, moves: Sequence[Move], goal: _Goal
) -> tuple[Step, ...]:
    """Return the moves in the order of their gain.

    The list ends as soon as the limit is met. Moves at its end whose gain is not worth the work
    (see `GAIN_SDS`) are left out.
    """
    left, steps = list(moves), []
    now = move_model.after([])
    done: list[Move] = []
    while left and not goal.met(now):
        gains = move_model.gains(done, left)
        best = int(np.argmax([expected for expected, _ in gains]))
        done.append(left.pop(best))
        now = move_model.after(done)
        steps.append(Step(done[-1], *gains[best], now))
    while steps and steps[-1].gain <= GAIN_SDS * steps[-1].gain_sd:
        steps.pop()
    return tuple(steps)


def gain(before: Known, after: Known) -> tuple[float, float]:
    """Return the expected decrease of the sum of squares, and its standard deviation.

    The decrease is a quadratic form ``x' A x`` of the normal vector x = (before, after) with mean m
    and covariance C. Its mean is ``m' A m + tr(A C)`` and its variance ``4 m' A C A m +
    2 tr(A C A C)`` (A. M. Mathai, S. B. Provost, Quadratic Forms in Random Variables, 1992, sec.
    3.2). Columns of the two covariance factors with the same number belong to the same independent
    variable.
    """
    width = max(before.root.shape[1], after.root.shape[1])
    root = np.vstack([np.pad(known.root, ((0, 0), (0, width - known.root.shape[1])))
                      for known in (before, after)])
    mean = np.concatenate([before.mean, after.mean])
    sign = np.repeat([1.0, -1.0], len(before.mean))
    product = sign[:, None] * (root @ root.T)
    signed = sign * mean
    variance = 2 * np.sum(product * product.T) + 4 * float(np.sum((signed @ root) ** 2))
    return before.expected_square - after.expected_square, float(np.sqrt(max(variance, 0.0)))
