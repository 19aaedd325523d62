"""Which blocks to swap, turn or replace so that unwanted multipoles become small.

Multipoles are linear in the magnetizations, and a block that is moved takes its own along: the
effect of every move is a product of columns that are computed once, those of moves in different
slots add up, and every one of a hundred thousand swaps is tried in a moment. A slot takes part in
one move at most. Moves are taken one after another, each for the largest expected fall of
``sum |c_n|^2``, until it is no larger than its own standard deviation; then each is exchanged for a
better one as long as there is any.

What is known of the moved blocks is what the posterior says, exactly transformed. If the blocks
were measured before they were mounted, p is a block's own magnetization w and the turn u = t x w
that its mounting gave it; taking it out undoes u, mounting it again brings another. With the prior
``p ~ N(m_0, C_0)`` and ``u ~ N(0, U)`` a part of it, ``u = K (p - m_0) + e``, ``K = U C_0^-1``,
``e ~ N(0, U - U C_0^-1 U)``, whatever was read since.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Literal

import numpy as np
import scipy.linalg as linalg
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.design.remounting import Mounts, mounts_of, remounted
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.geometry.mounting import as_meant
from halbach_fe.inference.block_prior import loose_blocks, types_of
from halbach_fe.inference.result import InferenceResult
from halbach_fe.measurement.block_table import BlockTable
from halbach_fe.response.multipoles import Complexes, MultipoleModel, Multipoles, met
from halbach_fe.stats.gaussian import nominal_prior, rotated
from halbach_fe.study.model import Study

Kind = Literal["swap", "turn", "replace"]

GAIN_SDS = 1.0
"""A move is worth its work if it is expected to gain more than so many standard deviations of what
it gains."""

SURE = 0.95
"""Probability that all multipoles are within the limit at which no more is done."""

DRAWS = 4000
"""For that probability: known to 0.3 %."""

SHORTLIST = 24
"""Moves of each kind, the best by the mean, whose gain is computed with its uncertainty."""

AT_ONCE = 100_000
"""Moves that are tried at a time."""

BETTER = 1e-6
"""Relative fall of the sum for which one move is exchanged for another."""

STOPS = {"target": "the limit is met", "uncertainty": "further moves would gain less than the "
         "uncertainty of what they gain", "budget": "as many moves as were allowed",
         "nothing": "no other block fits anywhere"}


@dataclass(frozen=True)
class Placement:
    """A block put into a slot.

    Attributes
    ----------
    to : int
        Slot from 0, ring by ring.
    block : int
        The slot that it stood in, or the number of slots and more for a spare block.
    turn : int
        Of `Mounts.turns`.
    """

    to: int
    block: int
    turn: int


@dataclass(frozen=True)
class Move:
    """A swap (two placements), a turn or a replacement (one)."""

    kind: Kind
    placements: tuple[Placement, ...]


@dataclass(frozen=True)
class Step:
    """A move, what it gains in the sum of |c_n|^2 in units^2, and the multipoles after it."""

    move: Move
    gain: float
    gain_sd: float
    after: Multipoles


@dataclass(frozen=True)
class Shim:
    """Moves in their order, and what they do.

    Attributes
    ----------
    stop : str
        A key of `STOPS`.
    tried : dict
        How many moves of each kind there are.
    within : tuple of two floats, or None
        Probability that all multipoles are within the limit, before and after.
    """

    magnet: Magnet
    model: MultipoleModel
    mounts: Mounts
    spares: tuple[str, ...]
    before: Multipoles
    steps: tuple[Step, ...]
    stop: str
    tried: dict[str, int]
    limit: float | None
    within: tuple[float, float] | None

    @property
    def after(self) -> Multipoles:
        """Multipoles when all is done."""
        return self.steps[-1].after if self.steps else self.before

    @property
    def study(self) -> Study:
        """The study whose magnet it is."""
        return self.magnet.study

    @cached_property
    def shimmed_study(self) -> Study | None:
        """The study with the blocks that were moved, or None if it cannot say that: of a block
        that was replaced it has nothing to say.
        """
        slots = len(self.mounts.places)
        moved = [(one.to, one.block, self.matrix(one)) for step in self.steps
                 for one in step.move.placements if one.block < slots]
        changed = remounted(self.magnet, moved) if moved else None
        return None if changed is None else changed.study

    def matrix(self, placement: Placement) -> Floats:
        """From a block's magnetization where it stood to that where it goes, (3, 3)."""
        carried = self.mounts.carried(np.array([placement.to]), np.array([placement.turn]))[0]
        return carried @ self.mounts.frames[placement.block].T


@dataclass(frozen=True)
class Spares:
    """Blocks that may replace others; what is known of each is independent.

    Attributes
    ----------
    names : tuple of str
    mean : ndarray, shape (n, 3), in A/m
        Along the own axes of their shape.
    covariance : ndarray, shape (n, 3, 3)
    direction : ndarray, shape (n, 3)
        Nominal, in own axes.
    kind : ndarray of int, shape (n,)
    slot : ndarray of int, shape (n,)
        The only one that it can go to, from 0; -1 for none in particular.
    """

    names: tuple[str, ...]
    mean: Floats
    covariance: Floats
    direction: Floats
    kind: Ints
    slot: Ints


@dataclass(frozen=True)
class _Goal:
    """Limit for every |c_n|, if there is one, and standard normal numbers (draws, 2 k)."""

    limit: float | None
    normals: Floats

    def within(self, known: Multipoles) -> float:
        """Probability that no multipole is above the limit; 0 without one."""
        return 0.0 if self.limit is None else met(known.sizes_of(self.normals), self.limit)

    def met(self, known: Multipoles) -> bool:
        """Whether no more has to be done."""
        return self.within(known) >= SURE


@dataclass(frozen=True)
class _Bench:
    """All that is needed to try moves; S slots, B blocks with the spares, D dimensions.

    ``placed`` and ``loose`` are the roots of what is known of the blocks as they stand (S, D, q)
    and once they are taken out (B, D, q, in own axes), with the same q columns; ``own`` (B, D, D)
    the root of what every block has for itself when it is mounted.
    """

    model: MultipoleModel
    mounts: Mounts
    mean: Floats
    placed: Floats
    loose_mean: Floats
    loose: Floats
    own: Floats
    fits: NDArray[np.bool_]

    @property
    def size(self) -> int:
        """Dimensions."""
        return self.mean.shape[1]

    @cached_property
    def columns(self) -> Complexes:
        """The model's matrix, (1 + k, S, D)."""
        return self.model.matrix.reshape(len(self.model.matrix), *self.mean.shape)

    @cached_property
    def start(self) -> tuple[Complexes, Complexes]:
        """Mean (1 + k,) and root (1 + k, q) of the magnet as it is."""
        matrix = self.model.matrix
        return (self.model.offset + matrix @ self.mean.ravel(),
                matrix @ self.placed.reshape(self.mean.size, -1))

    def carried(self, to: Ints, turn: Ints) -> Floats:
        """See `Mounts.carried`, in the magnet's dimensions."""
        return self.mounts.carried(to, turn)[:, :self.size, :self.size]

    def coefficients(self, moves: Sequence[Move]) -> tuple[Complexes, Complexes]:
        """Mean and root of C after some moves, exactly."""
        return reduce(self.moved, moves, self.start)

    def moved(
        self, before: tuple[Complexes, Complexes], move: Move
    ) -> tuple[Complexes, Complexes]:
        """Mean and root of C after one more move; the columns that it adds to the root come
        behind those that were there.
        """
        mean, root = before
        width = self.start[1].shape[1]
        root, fresh = root[:, :width], [root[:, width:]]
        for one in move.placements:
            columns = self.columns[:, one.to]
            carried = columns @ self.carried(np.array([one.to]), np.array([one.turn]))[0]
            mean = mean + carried @ self.loose_mean[one.block] - columns @ self.mean[one.to]
            root = root + carried @ self.loose[one.block] - columns @ self.placed[one.to]
            fresh.append(carried @ self.own[one.block])
        return mean, np.hstack([root, *fresh])

    def multipoles(self, moves: Sequence[Move]) -> Multipoles:
        """Multipoles after some moves."""
        return self.model.known(*self.coefficients(moves))

    def gains(
        self, chosen: Sequence[Move], further: Sequence[Move]
    ) -> list[tuple[float, float]]:
        """What each further move would gain, and its standard deviation; see `gain`."""
        state = self.coefficients(chosen)
        now = self.model.known(*state)
        return [gain(now, self.model.known(*self.moved(state, move))) for move in further]


@dataclass(frozen=True)
class _Candidates:
    """Moves of one kind: their placements' numbers (n, 1 or 2) in a `_Field`."""

    kind: Kind
    parts: Ints


@dataclass(frozen=True)
class _Field:
    """All placements, ``to``, ``block`` and ``turn`` (n,), what each changes of b_n, a_n (n, 2 k),
    and the variance that it adds to them in all (n,).
    """

    to: Ints
    block: Ints
    turn: Ints
    change: Floats
    noise: Floats

    def move(self, kind: Kind, parts: Ints) -> Move:
        """One of the candidates."""
        return Move(kind, tuple(Placement(int(self.to[i]), int(self.block[i]), int(self.turn[i]))
                                for i in parts))


def shim(
    update: InferenceResult, model: MultipoleModel, generator: np.random.Generator,
    budget: Mapping[Kind, int], limit: float | None = None, stock: BlockTable | None = None,
) -> Shim:
    """Choose moves.

    Parameters
    ----------
    update : Update
        Whose posterior tells what the blocks are.
    model : MultipoleModel
        Of the same study.
    generator : numpy Generator
        For the probability that the limit is met.
    budget : mapping
        How many moves of each kind are allowed.
    limit : float, optional
        For every |c_n|, in units of 1e-4; without it multipoles are made as small as is worth it.
    stock : BlockTable, optional
        Measured blocks to replace others with; without it nominal ones, of the study's prior.

    Raises
    ------
    MeasurementError
        If the stock does not fit the study.
    """
    magnet = update.magnet
    mounts = mounts_of(magnet)
    spares = _stock(magnet, mounts, stock) if stock else _nominal(magnet, mounts)
    if not budget.get("replace"):
        spares = _none()
    bench = _bench(update, model, mounts, spares)
    field = _field(bench)
    candidates = [one for one in _candidates(field, len(mounts.places)) if budget.get(one.kind)]
    before = model.of(update.posterior)
    goal = _Goal(limit, generator.standard_normal((DRAWS, len(before.mean))))
    moves, stop = _search(bench, field, candidates, budget, goal)
    steps = _steps(bench, moves, goal)
    within = None
    if limit is not None:
        within = goal.within(before), goal.within(steps[-1].after if steps else before)
    return Shim(magnet, model, mounts, spares.names, before, steps, stop,
                {one.kind: len(one.parts) for one in candidates}, limit, within)


def taken_out(update: InferenceResult) -> tuple[Floats, Floats, Floats]:
    """What is known of the blocks once they are out of their mounts, and as they stand.

    Returns
    -------
    mean : ndarray, shape (m,), in A/m
        Of w, along the magnet's axes.
    loose, placed : ndarray, shape (m, q), in A/m
        Roots of w and of p with common columns.
    """
    study, after = update.study, update.posterior
    sd, root = np.radians(study.prior.mounting_sd_deg), np.asarray(after.root)
    if not sd or update.measured_blocks is None:  # then no mounting is part of the prior
        return after.mean, root, root
    before = update.prior
    turns = linalg.block_diag(*_turn_covariance(
        before.mean.reshape(-1, study.dimension), sd))
    share = _times_inverse(turns, before.covariance)
    rest = _root(turns - share @ turns)
    whole = np.eye(len(share)) - share
    return (after.mean - share @ (after.mean - before.mean),
            np.hstack([whole @ root, -rest]),
            np.hstack([root, np.zeros_like(rest)]))


def _times_inverse(matrix: Floats, covariance: Floats) -> Floats:
    """Matrix times the inverse of a covariance, or, of a missing block, its pseudo-inverse."""
    try:
        return np.asarray(linalg.cho_solve(linalg.cho_factor(covariance), matrix.T).T)
    except linalg.LinAlgError:
        return np.asarray(matrix @ linalg.pinvh(covariance))


def _turn_covariance(vectors: Floats, sd: float) -> Floats:
    """Covariances (n, d, d) of what turns of an sd in rad do to magnetizations (n, d)."""
    root = rotated(vectors, sd)
    return np.asarray(root @ root.transpose(0, 2, 1))


def _root(covariance: Floats) -> Floats:
    """A root (..., d, d) of covariances that may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0))[..., None, :])


def _bench(update: InferenceResult, model: MultipoleModel, mounts: Mounts,
           spares: Spares) -> _Bench:
    size, count = update.study.dimension, len(mounts.places)
    mean, loose, placed = taken_out(update)
    back = mounts.frames[:, :size, :size].transpose(0, 2, 1)
    own_mean = np.vstack([np.einsum("nij,nj->ni", back, mean.reshape(count, size)),
                          spares.mean[:, :size]])
    columns = loose.shape[1]
    own_loose = np.concatenate([back @ loose.reshape(count, size, columns),
                                np.zeros((len(spares.names), size, columns))])
    alone = _turn_covariance(own_mean, np.radians(update.study.prior.mounting_sd_deg))
    alone[count:] += spares.covariance[:, :size, :size]
    fits = mounts.fits(np.vstack([mounts.there, spares.direction]),
                       np.concatenate([mounts.kinds_there, spares.kind]))
    bound = np.flatnonzero(spares.slot >= 0)  # nominal spares are for one slot, as it was meant
    fits[:, :, count + bound] = False
    fits[0, spares.slot[bound], count + bound] = True
    return _Bench(model, mounts, update.posterior.mean.reshape(count, size),
                  placed.reshape(count, size, columns), own_mean, own_loose, _root(alone), fits)


def _none() -> Spares:
    return Spares((), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, int),
                  np.zeros(0, int))


def _nominal(magnet: Magnet, mounts: Mounts) -> Spares:
    """A new block for every slot, of which no more is known than the study's prior says."""
    size, settings = magnet.dimension, magnet.study.prior
    vectors = np.array([block.magnetization for block in as_meant(magnet).blocks])
    prior = nominal_prior(vectors[:, :size].ravel(), size, settings.magnitude_sd,
                        settings.direction_sd_deg, settings.common_mode_sd)
    roots = np.asarray(prior.root).reshape(len(vectors), size, -1)
    own = np.zeros((len(vectors), 3, 3))
    for number, rows in enumerate(roots):
        back = mounts.frames[number, :size, :size].T
        own[number, :size, :size] = back @ rows @ rows.T @ back.T
    return Spares(("nominal",) * len(vectors), np.einsum("nji,nj->ni", mounts.frames, vectors), own,
                  mounts.wanted, mounts.kinds, np.arange(len(vectors)))


def _stock(magnet: Magnet, mounts: Mounts, table: BlockTable) -> Spares:
    """Measured blocks; the calibration of their coil counts as an error of each."""
    size = magnet.dimension
    mean, root = loose_blocks(magnet, table)
    first = np.array([types_of(magnet)[label][0] - 1 for label in table.type])
    own, spread = np.zeros((len(table), 3)), np.zeros((len(table), 3, 3))
    own[:, :size], spread[:, :size, :size] = mean, root
    covariance = spread @ spread.transpose(0, 2,
                                           1) + magnet.study.prior.common_mode_sd**2 * np.einsum(
        "ni,nj->nij", own, own)
    return Spares(table.serial, own, covariance, mounts.wanted[first], mounts.kinds[first],
                  np.full(len(table), -1))


def _field(bench: _Bench) -> _Field:
    """All placements of blocks where they fit, but for those that change nothing."""
    stay = np.zeros_like(bench.fits)
    every = np.arange(len(bench.mean))
    stay[0, every, every] = True
    turn, to, block = np.nonzero(bench.fits & ~stay)
    carried = bench.carried(to, turn)
    scaled = bench.model.scaled(float(abs(bench.start[0][0]))).reshape(-1, *bench.mean.shape)
    new = np.einsum("nij,nj->ni", carried, bench.loose_mean[block]) - bench.mean[to]
    change, noise = np.empty((len(to), len(scaled))), np.empty(len(to))
    for first in range(0, len(to), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        columns = np.moveaxis(scaled[:, to[part]], 0, 1)
        change[part] = np.einsum("nki,ni->nk", columns, new[part])
        noise[part] = np.sum((columns @ (carried[part] @ bench.own[block[part]]))**2, axis=(1, 2))
    return _Field(to, block, turn, change, noise)


def _candidates(field: _Field, slots: int) -> list[_Candidates]:
    """All moves: of every two placements that exchange two blocks, a swap."""
    number = np.arange(len(field.to))
    inside = field.block < slots
    turns = number[inside & (field.block == field.to)]
    spare = number[~inside]
    moved = number[inside & (field.block != field.to)]
    # placements of i in j, and those of j in i, next to each other by the pair {i, j}
    low, high = (np.minimum(field.to, field.block), np.maximum(field.to, field.block))
    up = moved[field.to[moved] < field.block[moved]]
    down = moved[field.to[moved] > field.block[moved]]
    key = low * slots + high
    down = down[np.argsort(key[down], kind="stable")]
    start, stop = (np.searchsorted(key[down], key[up], side) for side in ("left", "right"))
    count = stop - start
    first = np.repeat(up, count)
    offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    second = down[np.repeat(start, count) + offset]
    return [_Candidates("swap", np.column_stack([first, second])),
            _Candidates("turn", turns[:, None]), _Candidates("replace", spare[:, None])]


def _search(
    bench: _Bench, field: _Field, candidates: Sequence[_Candidates], budget: Mapping[Kind, int],
    goal: _Goal,
) -> tuple[list[Move], str]:
    """Moves one after another, then each again as long as that is better; and why no more."""
    chosen: list[Move] = []
    stop = "nothing"
    while True:
        count = len(chosen)
        chosen, stop = _greedy(bench, field, candidates, budget, goal, chosen)
        if len(chosen) == count:
            return chosen, stop
        chosen = _exchanged(bench, field, candidates, chosen)


def _greedy(
    bench: _Bench, field: _Field, candidates: Sequence[_Candidates], budget: Mapping[Kind, int],
    goal: _Goal, chosen: list[Move],
) -> tuple[list[Move], str]:
    """More moves, each for the largest expected gain; and why it stopped."""
    while True:
        now = bench.multipoles(chosen)
        if goal.met(now):
            return chosen, "target"
        left = [one for one in candidates
                if sum(move.kind == one.kind for move in chosen) < budget[one.kind]]
        if candidates and not left:
            return chosen, "budget"
        shortlist = [move for one in left
                     for move in _best(bench, field, one, chosen, SHORTLIST)]
        if not shortlist:
            return chosen, "nothing"
        gains = bench.gains(chosen, shortlist)
        best = int(np.argmax([expected for expected, _ in gains]))
        if gains[best][0] <= GAIN_SDS * gains[best][1]:
            return chosen, "uncertainty"
        chosen = [*chosen, shortlist[best]]


def _exchanged(
    bench: _Bench, field: _Field, candidates: Sequence[_Candidates], chosen: list[Move]
) -> list[Move]:
    """Every move again, given the others, until none can be better."""
    better = True
    while better:
        better = False
        for move in list(chosen):
            others = [one for one in chosen if one is not move]
            kind = next(one for one in candidates if one.kind == move.kind)
            found = _best(bench, field, kind, others, 1)
            now = bench.multipoles(chosen).expected_square
            if found and bench.multipoles([*others, found[0]]).expected_square < (
                    1 - BETTER) * now:
                chosen, better = [*others, found[0]], True
    return chosen


def _best(
    bench: _Bench, field: _Field, candidates: _Candidates, chosen: Sequence[Move], count: int
) -> list[Move]:
    """The best moves of a kind by the mean, in slots and with blocks that are free."""
    used = [one for move in chosen for one in move.placements]
    free = ~(np.isin(field.to, [one.to for one in used])
             | np.isin(field.block, [one.block for one in used]))
    parts = candidates.parts[free[candidates.parts].all(axis=1)]
    if not len(parts):
        return []
    mean, _ = bench.coefficients(chosen)
    # with the main multipole that the changes are scaled by: moves hardly change it
    now = bench.model.units(np.concatenate([[abs(bench.start[0][0])], mean[1:]]))
    score = np.empty(len(parts))
    for first in range(0, len(parts), AT_ONCE):
        some = parts[first:first + AT_ONCE]
        after = now + field.change[some].sum(axis=1)
        score[first:first + AT_ONCE] = np.einsum("ij,ij->i", after, after) + field.noise[some].sum(
            axis=1)
    few = np.argpartition(score, count)[:count] if count < len(score) else np.arange(len(score))
    return [field.move(candidates.kind, parts[i]) for i in few[np.argsort(score[few])]]


def _steps(
    bench: _Bench, moves: Sequence[Move], goal: _Goal
) -> tuple[Step, ...]:
    """The moves in the order of what they gain, as far as that is worth it, or as is needed."""
    left, steps = list(moves), []
    now = bench.multipoles([])
    done: list[Move] = []
    while left and not goal.met(now):
        gains = bench.gains(done, left)
        best = int(np.argmax([expected for expected, _ in gains]))
        done.append(left.pop(best))
        now = bench.multipoles(done)
        steps.append(Step(done[-1], *gains[best], now))
    while steps and steps[-1].gain <= GAIN_SDS * steps[-1].gain_sd:
        steps.pop()
    return tuple(steps)


def gain(before: Multipoles, after: Multipoles) -> tuple[float, float]:
    """Expected fall of the sum of |c_n|^2 in units^2, and its standard deviation.

    Of normal x = (before, after) and ``x' A x``: mean ``m' A m + tr(A C)``, variance
    ``4 m' A C A m + 2 tr(A C A C)`` (A. M. Mathai, S. B. Provost, Quadratic Forms in Random
    Variables, 1992, sec. 3.2). The columns of both roots are the same as far as both have them.
    """
    width = max(before.root.shape[1], after.root.shape[1])
    root = np.vstack([np.pad(one.root, ((0, 0), (0, width - one.root.shape[1])))
                      for one in (before, after)])
    mean = np.concatenate([before.mean, after.mean])
    sign = np.repeat([1.0, -1.0], len(before.mean))
    product = sign[:, None] * (root @ root.T)
    signed = sign * mean
    variance = 2 * np.sum(product * product.T) + 4 * float(np.sum((signed @ root) ** 2))
    return before.expected_square - after.expected_square, float(np.sqrt(max(variance, 0.0)))
