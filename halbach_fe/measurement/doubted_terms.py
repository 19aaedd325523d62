"""The law by which terms of a fit are doubted that lie many prior standard deviations away.

`check`, `register` and `infer` fit terms of pose, instrument and blocks, each with a prior. A good
chi-squared alone does not make their answer right: a wrong map is explained too, by terms that
nothing real has. Such terms are named, and forbid a "Yes".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special as special
from scipy.sparse.csgraph import connected_components

from halbach_fe.core.arrays import Floats, Ints
from halbach_fe.core.numbers import decimals, in_a_row
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.stats.gaussian import Gaussian

CHANCE = 2e-3
"""Probability that of all terms of a fit, if they are as their priors say, one is doubted. The
limit is 4.0 prior standard deviations for the 27 terms of a map's instrument, and 5.1 for those and
the 1 728 of 576 blocks."""

UNLIKE = 0.5
"""Cosine between readings and model below which no factor relates them: that of exchanged
components is about 0, and blocks at the edge of what is accepted leave 0.9."""

FACTORS = {
    1e-4: "as if numbers in T were taken for G", 1e-3: "as if numbers in T were taken for mT",
    0.1: "as if numbers in mT were taken for G", 0.5: "half", 2.0: "twice", -1.0: "the opposite",
    10.0: "as if numbers in G were taken for mT", 1e3: "as if numbers in mT were taken for T",
    1e4: "as if numbers in G were taken for T"}
"""Ratios of readings to fields that errors of a file make."""

WELL_TOLD, HARDLY_TOLD = 0.05, 0.5
"""Bars, in units of the prior's, below which a term is known well with whatever else it trades off,
and above which the readings say little of it."""

NOT_APART = 0.9
"""Correlation of the errors of two terms, by themselves or with all others held, from which they
are called hardly told apart: the bar of each is 2.3 times as long as if the other were known. In
the uniform field of an MRI magnet a turn, the angle of a sensor and its offset were told as a sum,
with correlations of 0.2 to 0.6, which are 0.99 with the third one held."""

ALL_BLOCKS = "strength of all blocks together"
"""Name of the median deviation of all blocks, and of the mean one."""

ALL_AXES = "turn of all magnetizations together"
"""Name of the mean turn of all blocks, before its axis."""

MOST_NAMED = 5
"""Largest number of doubted terms that a sentence names."""

UNITS = {"m": ("mm", 1e3), "rad": ("mrad", 1e3), "T": ("mT", 1e3), "": ("%", 100.0)}
"""Unit that people read, and its factor, by the SI unit of a term."""


@dataclass(frozen=True)
class Term:
    """A number of a fit, and what was known of it before."""

    name: str
    """What it is, in words: "gain of Bx"."""
    unit: str
    """Its SI unit: m, rad, T, or nothing for parts of 1."""
    value: float
    """Its change from the mean of its prior."""
    prior_sd: float

    @property
    def distance(self) -> float:
        """How many prior standard deviations it lies away."""
        return abs(self.value) / self.prior_sd if self.prior_sd else 0.0

    @property
    def size(self) -> str:
        """Its change, for people."""
        unit, factor = UNITS[self.unit]
        sign = "\u2212" if self.value < 0 else "+"
        return f"{sign}{decimals(factor * abs(self.value))}\u00a0{unit}"

    @property
    def known(self) -> str:
        """What was known of it before, for people."""
        unit, factor = UNITS[self.unit]
        return f"±\u00a0{decimals(factor * self.prior_sd, 2)}\u00a0{unit}"

    @property
    def in_words(self) -> str:
        """The term with its prior, for people."""
        if self.name == ALL_BLOCKS:
            return (f"the blocks would have to be {decimals(100 * abs(self.value))}\u00a0% "
                    f"{'weaker' if self.value < 0 else 'stronger'} than was known before "
                    f"({decimals(self.distance, 2)} standard deviations of a block, "
                    f"{self.known})")
        return (f"{self.name} by {self.size}, where {self.known} was known before "
                f"({decimals(self.distance, 2)} standard deviations)")

    def plain(self) -> dict[str, object]:
        """Return it as plain data."""
        return {"name": self.name, "unit": self.unit, "value": self.value,
                "prior_sd": self.prior_sd, "prior_sds_away": self.distance}


def doubted_from(count: int) -> float:
    """Return the prior standard deviations from which one of so many terms is doubted."""
    return float(-special.ndtri(CHANCE / 2 / max(count, 1)))


def doubts(terms: Sequence[Term], others: int = 0) -> tuple[Term, ...]:
    """Return the terms that are farther from their priors than chance takes them, farthest first.

    ``others`` is the number of further terms of which these are the farthest.
    """
    limit = doubted_from(len(terms) + others)
    return tuple(sorted((one for one in terms if one.distance > limit),
                        key=lambda one: -one.distance))


def doubts_in_words(found: Sequence[Term]) -> str:
    """Say which terms are doubted; nothing if none is."""
    if not found:
        return ""
    more = len(found) - MOST_NAMED
    named = "; ".join(one.in_words for one in found[:MOST_NAMED])
    return ("To agree with the readings, these would have to be changed far beyond what was known "
            f"before: {named}{f'; and {more} more' if more > 0 else ''}.")


def trade_offs(
    names: Sequence[str], covariance: Floats, prior_sd: Floats
) -> tuple[tuple[str, ...], ...]:
    """Return the names of terms that readings hardly tell one by one, only together.

    Parameters
    ----------
    names : sequence of str
        Of n terms.
    covariance : ndarray, shape (n, n)
        After the fit.
    prior_sd : ndarray, shape (n,)
        Before it. Of what it leaves nearly as open, or knows well whatever the others are, there is
        nothing to say.
    """
    sd = np.sqrt(np.diag(covariance))
    told = np.flatnonzero((sd > WELL_TOLD * prior_sd) & (sd < HARDLY_TOLD * prior_sd))
    correlation = covariance[np.ix_(told, told)] / np.outer(sd[told], sd[told])
    inverse = np.linalg.inv(correlation)
    scale = np.sqrt(np.diag(inverse))
    partial = inverse / np.outer(scale, scale)  # with all others held, but for the sign
    count, group = connected_components(np.maximum(
        np.abs(correlation), np.abs(partial)) > NOT_APART)
    return tuple(tuple(names[one] for one in told[group == number])
                 for number in range(count) if np.sum(group == number) > 1)


def trade_offs_in_words(found: Sequence[tuple[str, ...]]) -> str:
    """Say which terms readings hardly tell one by one; nothing if there are none."""
    return "" if not found else (
        f"The map hardly tells apart {'; or '.join(in_a_row(names) for names in found)}: it knows "
        "them better together than one by one, and if one is off, so is the other. Take none of "
        "these numbers for a finding by itself.")


def shared_in_words(found: Sequence[Term], cross_section: bool) -> str:
    """Say what all blocks would share far beyond their prior, and what else does the same."""
    said = []
    for each in found:
        turn = each.name != ALL_BLOCKS
        what = (f"turned by {each.size} about {each.name[-1]}" if turn else
                f"{decimals(100 * abs(each.value))}\u00a0% "
                f"{'weaker' if each.value < 0 else 'stronger'}")
        keys = [] if cross_section else [
            f"[instrument_sd] {'rotation_rad' if turn else 'gain'}"]
        keys += [] if turn else ["[prior] common_mode_sd"]
        said.append(
            f"All blocks would be {what} together, which is {decimals(each.distance, 2)} standard "
            f"deviations of what their prior allows ({each.known}). "
            f"{'A turn of the map' if turn else 'A gain of the instrument'} does the same, and the "
            "readings cannot tell which it is" + (
                f": state how far {'either' if len(keys) > 1 else 'the latter'} may be off "
                f"({' and '.join(keys)}), and update again."
                if keys else "."))
    return " ".join(said)


def held_back_in_words(blocks: Sequence[Term], measured: bool) -> str:
    """Say which blocks are so far off that their prior is wrong and still acts; else nothing."""
    if not blocks:
        return ""
    first, one = blocks[0], len(blocks) == 1
    named = in_a_row([each.name.removeprefix("block ") for each in blocks[:MOST_NAMED]])
    more = f" and {len(blocks) - MOST_NAMED} more" if len(blocks) > MOST_NAMED else ""
    return (f"{'Block' if one else 'Blocks'} {named}{more} {'is' if one else 'are'} up to "
            f"{decimals(first.distance, 2)} standard deviations away from what "
            f"{'was measured of single blocks' if measured else 'the study says'}, "
            f"which still draws {'it' if one else 'them'} back: the error bars of "
            f"{'this block and its' if one else 'these blocks and their'} neighbours are too "
            "short. Find out what is the matter (diagnose), or " + (
                "look whether it stands in that slot, " if measured else
                "state it in the study ([[array.exceptions]], or a wider [prior]), ")
            + "and update again.")


def words_of(name: str) -> tuple[str, str]:
    """Return the words and the SI unit of a term of `instrument.NAMES`, or of a stage.

    A probe of |B| has terms without an axis: ``gain``, ``offset_T``, ``drift_T``.
    The name of a map, stage or probe may stand before it: ``fringe.gain_x``.
    """
    owner, _, term = name.rpartition(".")
    kind, *axes = term.replace("stage_shift", "shift").split("_")
    unit = axes.pop() if axes and axes[-1] in UNITS else ""
    first, last = (axes[0], axes[-1]) if axes else ("", "")
    of = f"B{first}" if first else "|B|"
    said = {"translation": f"place along {first}", "rotation": f"turn about {first}",
            "shift": f"place along {first} of the stage",
            "crosstalk": f"turn of the B{first[:1]} sensor towards {last[-1:]}",
            "gain": f"gain of {of}", "offset": f"offset of {of}",
            "drift": f"drift of {of}", "sensor": f"place of the B{first} sensor along {last}"}
    return (said[kind] + (f" ({owner})" if owner else ""),
            "rad" if kind == "crosstalk" else unit)


def block_doubts(magnet: Magnet, mean: Floats, prior_mean: Floats, prior_sd: Floats,
                 ) -> tuple[Term, ...]:
    """Return the doubts about what an update has done to the blocks.

    ``mean``, ``prior_mean`` and ``prior_sd`` (m,) in A/m: parameters of the magnet, of which the
    first are the magnetizations of its blocks.

    Returns
    -------
    tuple of Term
        The median of all blocks along their magnetizations in parts of 1 (a reversed block moves
        the mean), compared with the standard deviation of one block; or the block that is farthest
        from its prior.
    """
    of = _Changes.of(magnet, mean - prior_mean, prior_sd)
    if not len(of.numbers):
        return ()
    own = float(np.sqrt(np.mean(np.sum(of.axes**2 * of.sd**2, axis=1))))
    common = Term(ALL_BLOCKS, "", float(np.median(np.sum(of.axes * of.change, axis=1))), own)
    if found := doubts([common], of.sd.size):
        return found
    block, axis = np.unravel_index(int(np.argmax(of.away)), of.away.shape)
    label = magnet.blocks[of.numbers[block]].name
    return doubts([Term(f"magnetization of block {label} along {'xyz'[axis]}", "",
                        float(of.change[block, axis]), float(of.sd[block, axis]))], of.sd.size)


def held_back(magnet: Magnet, mean: Floats, sd: Floats, prior: Gaussian) -> tuple[Term, ...]:
    """Return the blocks that an update takes far from their priors, which still hold them back.

    Without its prior of standard deviation p, a block with the mean m and the standard deviation s
    after the update would be at ``m / (1 - (s / p)**2)``. Where the readings alone determine a
    block, that is m, however far m is. Where they do not, its error bar is not to be believed.

    ``mean`` and ``sd`` (m,) in A/m: after the update, of all parameters, of which the first are the
    magnetizations of blocks.

    Returns
    -------
    tuple of Term
        Of each such block the direction that is farthest off, the farthest block first.
    """
    of = _Changes.of(magnet, mean - prior.mean, prior.sd)
    after = sd[:magnet.dimension * len(magnet.blocks)].reshape(
        len(magnet.blocks), -1)[of.numbers] / of.size[:, None]
    ratio = np.minimum(after / np.where(of.sd > 0, of.sd, np.inf), np.sqrt(0.5))
    held = (of.away > doubted_from(of.sd.size)) & (of.away * ratio / (1 - ratio**2) > 1)
    found = []
    for number in np.flatnonzero(held.any(axis=1)):
        axis = int(np.argmax(np.where(held[number], of.away[number], 0.0)))
        found.append(Term(f"block {magnet.blocks[of.numbers[number]].name}", "",
                          float(of.change[number, axis]), float(of.sd[number, axis])))
    return tuple(sorted(found, key=lambda one: -one.distance))


def shared_doubts(magnet: Magnet, mean: Floats, prior: Gaussian, model_error: float = 0.0,
                  ) -> tuple[Term, ...]:
    """Return the doubts about what an update has done to all blocks alike, in strength and turn.

    Of n independent blocks of 2 % the mean is known to 2 %/sqrt(n): all of them 2 % stronger is
    nothing that chance does, though no single block is suspicious.

    Parameters
    ----------
    mean : ndarray, shape (m,), in A/m
        Parameters of the magnet, of which the first are the magnetizations of its blocks.
    prior : Gaussian
        Of the parameters, with all that blocks share.
    model_error : float
        Relative error of the model's field, which all blocks may share too.

    Returns
    -------
    tuple of Term
        The mean strength and the turns, of the blocks that are not suspicious by themselves (a
        reversed block is no common deviation) unless most are.
    """
    of = _Changes.of(magnet, mean - prior.mean, prior.sd)
    if not len(of.numbers):
        return ()
    near = (of.away <= doubted_from(of.sd.size)).all(axis=1)
    near = near if 2 * near.sum() > near.size else np.ones(near.size, bool)
    axes, size = of.axes[near], magnet.dimension
    moves = {ALL_BLOCKS: ("", axes)}
    for axis in range(0 if size == 3 else 2, 3):
        turned = np.cross(np.eye(3)[axis], np.pad(axes, ((0, 0), (0, 3 - size))))[:, :size]
        moves[f"{ALL_AXES} about {'xyz'[axis]}"] = ("rad", turned)
    found = []
    for name, (unit, move) in moves.items():
        if (power := float(np.sum(move**2))) < 1e-9 * len(move):
            continue  # a turn about what all blocks are magnetized along
        row = np.zeros((len(magnet.blocks), size))
        row[of.numbers[near]] = move / power / of.size[near, None]
        whole = np.pad(row.ravel(), (0, len(mean) - row.size))[None]
        found.append(Term(name, unit, float(np.sum(move * of.change[near])) / power, float(
            np.hypot(prior.sd_of(whole)[0], model_error))))
    return doubts(found, of.sd.size)


@dataclass(frozen=True)
class _Changes:
    """What an update has done to the blocks that may change, relative to their nominal size.

    ``numbers`` (n,) are those of the blocks, ``size`` (n,) their magnetizations in A/m, ``axes``
    (n, d) their directions, ``change`` and ``sd`` (n, d) the changes and what the prior allows.
    """

    numbers: Ints
    size: Floats
    axes: Floats
    change: Floats
    sd: Floats

    @classmethod
    def of(cls, magnet: Magnet, change: Floats, prior_sd: Floats) -> _Changes:
        """Return the changes of all parameters (m,), of which the first are those of blocks."""
        count = len(magnet.blocks)
        own, sd, nominal = (values[:magnet.dimension * count].reshape(count, -1) for values in (
            change, prior_sd, magnet.nominal_magnetization))
        size = np.linalg.norm(nominal, axis=1)
        there = np.flatnonzero((size > 0) & (sd > 0).any(axis=1))
        scale = size[there, None]
        return cls(there, size[there], nominal[there] / scale, own[there] / scale,
                   sd[there] / scale)

    @property
    def away(self) -> Floats:
        """The changes (n, d) in standard deviations of the prior."""
        return np.asarray(np.abs(self.change) / np.where(self.sd > 0, self.sd, np.inf))


def factor_in_words(factor: float, likeness: float = 1.0) -> str:
    """Say that readings are a factor times the field of the model, or that they are not like it.

    ``likeness`` is that of `likeness_of`. Nothing is said of a factor near 1.
    """
    # Part by which readings must differ in size from the model for their unit to be suspected:
    # blocks of another grade are a few per cent off.
    factor_off = 0.1
    if abs(likeness) < UNLIKE:
        return ("The readings are not like the field expected of the magnet, by whatever "
                "factor: look at the names of their components, at their axes, and at the places "
                "and their unit (mm for m?, places and readings exchanged?) in the file first.")
    if abs(factor - 1) < factor_off:
        return ""
    known = f" ({words})" if (words := known_factor(factor)) else ""
    return (f"The readings are {decimals(factor)} times the field expected of the magnet"
            f"{known}: look at their unit, sign and factor in the file first, and at the remanence "
            "in the study (with --blocks, at the moments in that table).")


def known_factor(factor: float) -> str:
    """Return what error of a file a factor is near to, in words; nothing if none."""
    # Part by which a factor may differ from that of a known error: blocks of another batch or
    # temperature are a few per cent off.
    near_factor = 0.05
    return next((words for value, words in FACTORS.items()
                 if abs(factor / value - 1) < near_factor), "")


def likeness_of(readings: Floats, field: Floats) -> float:
    """Return the cosine (-1 to 1) between readings (n,) and a field (n,); 1 where one is zero."""
    size = float(np.linalg.norm(readings) * np.linalg.norm(field))
    return float(field @ readings) / size if size else 1.0


def factor_of(readings: Floats, field: Floats) -> float:
    """Return the factor by which a field (n,) is nearest to readings (n,); 1 where it is zero."""
    power = float(field @ field)
    return float(field @ readings) / power if power else 1.0
