"""What an effect is: parameters with their prior widths, places, signature, and how it is applied.

Every effect has a name, parameters with priors, the places where it can occur, a signature (the
change of the readings per unit of each parameter, to first order) and a method that applies it to a
study in full.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, Literal, TypeVar

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.array_layout import blocks_of_array
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.study.array_keys import BlockException
from halbach_fe.study.measurement_keys import Instrument
from halbach_fe.study.model import Study

T = TypeVar("T")

STEP = 1e-3
"""Step of the differences by an instrument, in prior standard deviations of an effect: small
enough for all laws of an instrument to be linear to 1e-6, and far above rounding."""


@dataclass(frozen=True)
class Parameter:
    """An amplitude of an effect.

    Attributes
    ----------
    name : str
    unit : str
        SI unit; ``"1"`` for a pure number.
    sd : float
        Prior standard deviation about 0.
    minimum : float
        Smallest amplitude that is physically possible, such as 0 for a gap that cannot be negative.
    longest_step : float
        Largest change of the amplitude between two solutions of the full model, for effects that
        are far from linear.
    """

    name: str
    unit: str
    sd: float
    minimum: float = -np.inf
    longest_step: float = np.inf


@dataclass(frozen=True)
class Place:
    """Where an effect acts.

    Attributes
    ----------
    ring, slot : int
        Ring and slot of a block, both counted from 1; 0 stands for all of them.
    at_m : tuple of float
        Coordinates or lengths in m, whose meaning depends on the effect.
    other : (int, int)
        Ring and slot of the second block of effects that concern two; (0, 0) for others.
    words : str
        Description of a place that is no position; empty for others.
    labels : tuple of str
        Names of these blocks, of which free blocks have their own; empty to number them.
    instrument : str
        Whose instrument an effect changes, of a campaign: ``map fringe``, ``probe hall`` or
        ``stage table``; empty for effects of the magnet, and for the only instrument.
    maps : tuple of str
        Names of the maps that have this instrument.
    """

    ring: int = 0
    slot: int = 0
    at_m: tuple[float, ...] = ()
    other: tuple[int, int] = (0, 0)
    words: str = ""
    labels: tuple[str, ...] = field(default=(), compare=False)
    instrument: str = ""
    maps: tuple[str, ...] = field(default=(), compare=False)

    @property
    def name(self) -> str:
        """The label of the place in reports; empty if the effect has a single place."""
        return ", ".join(filter(None, [self.instrument, self._within]))

    @property
    def _within(self) -> str:
        """The label of the place in the magnet, or in an instrument."""
        ring, slot = (f"{letter}{number:02d}" if number else ""
                      for letter, number in (("r", self.ring), ("s", self.slot)))
        if self.words:
            return self.words
        if self.at_m:
            lengths = (round(length, 6) + 0.0 for length in self.at_m)  # no -0, no 1e-18
            return f"at {', '.join(f'{length:.4g}' for length in lengths)} m"
        if self.labels:
            return ", ".join(self.labels)
        if self.other[0]:
            return f"{ring}{slot}, r{self.other[0]:02d}s{self.other[1]:02d}"
        return ring + slot


class Effect(ABC):
    """A deviation of the real magnet or mapper from the study.

    Attributes
    ----------
    name : str
        Identifier in tables, files and options.
    title : str
        Name in words, for reports.
    kind : str
        ``field`` if it changes the magnet or its surroundings, ``instrument`` if it changes the
        mapper.
    parameters : tuple of Parameter
        Amplitudes that are estimated together, one signature each.
    refinements : tuple of Parameter
        Further amplitudes, which are estimated only after the effect has been found and applied to
        the study; see `refine`.
    is_binary : bool
        Whether the effect is either absent or present with amplitude 1, as a missing block. No
        amplitude is then estimated: the evidence compares exactly 1 with exactly 0.
    unique : bool
        Whether the effect can occur at one place at most, as an iron ring; several blocks, on the
        other hand, can be displaced.
    applied_in_full : bool
        Whether `apply` puts the whole effect into a study and ignores the first amplitude, since no
        study can contain, for instance, half an iron ring. With such an effect in the model, its
        signature is the difference between the study with it and without it.
    defining : tuple of str
        Names of the parameters that give the effect its name: it is named only if one of them is
        determined away from zero. By default all of them do. The others are shared with effects
        that have names of their own.
    is_divisible : bool
        Whether some of the parameters may be exactly zero, so that the effect competes by its
        parts, such as a displacement along z alone. A vector that has any direction is not
        divisible.
    of_total_field : bool
        Whether it is an effect of probes of |B|, whose three columns have one sensor.
    relative_odds : float
        Prior odds that the effect is missing, relative to those of other effects.
    is_solved : bool
        Whether signatures are differences of solved fields of whole magnets, which may take long.
        They are computed after all others, so that a time limit leaves these out last.
    """

    name: str
    title: str
    kind: Literal["field", "instrument"] = "field"
    parameters: tuple[Parameter, ...]
    refinements: tuple[Parameter, ...] = ()
    is_binary: bool = False
    unique: bool = False
    applied_in_full: bool = False
    defining: tuple[str, ...] = ()
    is_divisible: bool = True
    of_total_field: bool = False
    relative_odds: float = 1.0
    is_solved: bool = False

    @property
    def shared(self) -> tuple[int, ...]:
        """Numbers of the parameters that do not give the effect its name."""
        return tuple(number for number, parameter in enumerate(self.parameters)
                     if self.defining and parameter.name not in self.defining)

    @property
    def parts(self) -> tuple[tuple[int, ...], ...]:
        """Sets of parameters, by number, that may be free together while the others are zero.

        Each has a parameter that gives the effect its name.
        """
        numbers = range(len(self.parameters))
        if not self.is_divisible or self.is_binary or self.applied_in_full or len(numbers) < 2:
            return ()
        sizes = range(1, len(numbers) + 1)
        return tuple(part for size in sizes for part in combinations(numbers, size)
                     if not set(part) <= set(self.shared))

    def places(self, study: Study) -> Sequence[Place]:
        """Return the places where the effect can occur; none if the study rules it out."""
        return [Place()]

    def shortlist(
        self, study: Study, mean: Floats, information: Floats, score: Floats
    ) -> Sequence[Place]:
        """Return the places whose signatures are to be computed, by default all of `places`.

        An effect that has too many places for that ranks them here by a cheaper estimate.

        Parameters
        ----------
        mean : ndarray, shape (m,), in A/m
            Prior mean of the magnetizations.
        information, score : ndarray, shape (m, m) and (m,)
            H' S^-1 H and H' S^-1 r of the response matrix H of the magnetizations and the residual
            r, with the blocks integrated out; see `halbach_fe.diagnosis.marginal_evidence`.
        """
        return self.places(study)

    def representatives(self, places: Sequence[Place]) -> Sequence[Place]:
        """Return the places whose signatures are computed first, by default all of ``places``.

        Signatures at the other places must resemble these, after the blocks have absorbed their
        part, and take long to compute: they are computed only if one of these is noticed.
        """
        return places

    def magnetization_change(
        self, nominal: NominalFields, place: Place
    ) -> Mapping[int, Floats] | None:
        """Return the changes (D,) in A/m of blocks' magnetizations per unit, by the blocks' numbers
        from 0.

        It is None of an effect that is more than such a change, or has several parameters. The
        response matrix turns these changes into readings, with all that permeable blocks and iron
        add, whereas `signature` holds in vacuum.
        """
        return None

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """Return the change of the readings (k, n, 3) in T per unit of each of the k parameters.

        By default, that by `magnetization_change` in vacuum. An effect that is applied in full may
        add those of its refinements, by which its places are then compared.
        """
        change = self.magnetization_change(nominal, place)
        if change is None:
            raise NotImplementedError(f"effect {self.name} has no signature")
        return np.sum([nominal.field_with(block, vector) for block, vector in change.items()],
                      axis=0)[None]

    def rough_signature(self, nominal: NominalFields, place: Place) -> Floats | None:
        """Return a signature (k, n, 3) in T that resembles `signature`, and takes far less time.

        Its size does not matter. It serves to tell whether the effect can be what is missing: only
        then is `signature` computed. None if that takes little time itself, as by default.
        """
        return None

    def refine(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """Return the change of the readings (r, n, 3) in T per unit of each of the r refinements.

        The derivative is taken at ``values``, which are those of all parameters followed by those
        of the refinements. ``nominal`` does not contain the effect.
        """
        return np.empty((0, *nominal.points.shape))

    def derivative(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """Return the change of the readings (k + r, n, 3) in T per unit of all amplitudes.

        That is at ``values``, of an effect in the model that is not applied in full: the signature
        followed by the refinements.
        """
        return np.concatenate([self.signature(nominal, place),
                               self.refine(nominal, place, values)])

    @abstractmethod
    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """Return the study with the effect applied in full, not only to first order.

        The amplitudes ``values`` add to those that the study has already. ``values`` can include
        those of the refinements.
        """

    def refined_place(self, place: Place, values: Sequence[float]) -> Place:
        """Return where the effect is by its amplitudes; by default its place."""
        return place

    def reported(self, place: Place, values: Floats, sd: Floats) -> tuple[Floats, Floats]:
        """Return amplitudes (k,) and their standard deviations (k,) as reports state them.

        They are the fitted ones, unless other numbers mean more to people.
        """
        return values, sd


class MagnetizationEffect(Effect):
    """An effect by which magnetizations are larger or smaller by fractions of what they were."""

    @abstractmethod
    def rates(self, magnet: Magnet, place: Place) -> Mapping[int, Sequence[float]]:
        """Return the relative changes (k,) of magnetizations per unit of each of the k parameters,
        by the blocks' numbers from 0.
        """

    def magnetization_change(
        self, nominal: NominalFields, place: Place
    ) -> Mapping[int, Floats] | None:
        return None if len(self.parameters) > 1 else {
            number: rate * nominal.magnetizations[number]
            for number, (rate,) in self.rates(nominal.magnet, place).items()}

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        return self.derivative(nominal, place, [0.0] * len(self.parameters))

    def derivative(self, nominal: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """See `Effect.derivative`: per unit of the magnetizations without the effect."""
        rates = self.rates(nominal.magnet, place)
        weights = [np.divide(rate, one_and(np.dot(rate, values))) for rate in rates.values()]
        return np.einsum("bk,bnc->knc", weights, nominal.block_fields[list(rates)])

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        magnet = build_magnet(study)
        # which blocks share an exception must not depend on the values: a study at an amplitude of
        # 0 has the numbers that change with it
        rates = {number: tuple(rate) for number, rate in self.rates(magnet, place).items()}
        return with_exceptions(study, [
            BlockException(**where, magnetization_factor=one_and(np.dot(rate, values)))
            for where, rate in together(magnet.blocks, rates)])


class InstrumentEffect(Effect):
    """An effect of the mapper, which changes the study's instrument."""

    kind = "instrument"

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """Return the derivative of the law of the instrument, by differences."""
        found = []
        for parameter, unit in zip(self.parameters, np.eye(len(self.parameters)), strict=True):
            step = STEP * parameter.sd
            more, less = (nominal.shown(self.apply(
                nominal.study, place, (sign * step * unit).tolist()).instrument)
                for sign in (1, -1))
            found.append((more - less) / (2 * step))
        return np.array(found)

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        change = self.change(study.instrument, values)
        return study.with_(instrument=study.instrument.with_(**change))

    @abstractmethod
    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """Return the keys of the instrument that change, with their new values."""


def added(values: Sequence[float], change: Sequence[float]) -> tuple[float, ...]:
    """Return the sum of two vectors as a tuple, for a key of a study."""
    return tuple(float(value) + float(more) for value, more in zip(values, change, strict=True))


def one_and(fraction: float) -> float:
    """Return 1 + fraction, or 1e-9 in place of 0: a derivative is divided by this factor."""
    return 1 + float(fraction) or 1e-9


def together(
    blocks: Sequence[MagnetBlock], values: Mapping[int, T]
) -> list[tuple[dict[str, int], T]]:
    """Return ring and slot of block exceptions, and what each says, for values by the blocks'
    numbers: one exception for all blocks, rings or slots if these are alike.
    """
    for of in ((), ("ring",), ("slot",)) if len(values) > 1 else ():
        groups: dict[tuple[int, ...], set[T | None]] = {}
        for number, block in enumerate(blocks):
            key = tuple(getattr(block, name) for name in of)
            groups.setdefault(key, set()).add(values.get(number))
        if all(len(group) == 1 for group in groups.values()):
            return [(dict(zip(of, key, strict=True)), value)
                    for key, (value,) in groups.items() if value is not None]
    return [({"ring": blocks[number].ring, "slot": blocks[number].slot}, value)
            for number, value in values.items()]


def with_exceptions(study: Study, exceptions: Sequence[BlockException]) -> Study:
    """Return the study with further block exceptions after those it has."""
    array = study.array.with_(exceptions=(*study.array.exceptions, *exceptions))
    return study.with_(array=array)


def with_array(study: Study, **keys: Any) -> Study:
    """Return the study with some keys of its array replaced."""
    return study.with_(array=study.array.with_(**keys))


def unchecked_blocks(study: Study) -> tuple[MagnetBlock, ...]:
    """Return the blocks of a study; those that overlap are refused where its magnet is built."""
    return blocks_of_array(study.array, study.dimension)


def blocks_at(blocks: Sequence[MagnetBlock], place: Place) -> list[int]:
    """Return the numbers of the blocks at a place, counted from 0."""
    return [number for number, block in enumerate(blocks)
            if place.ring in (0, block.ring) and place.slot in (0, block.slot)]


def each_block(study: Study) -> list[Place]:
    """Return a place for every block that is not missing."""
    return [place_of(block) for block in unchecked_blocks(study) if block.remanence]


def place_of(block: MagnetBlock, other: MagnetBlock | None = None) -> Place:
    """Return the place of a block, or of two blocks of an effect that concerns both."""
    both = [block] if other is None else [block, other]
    return Place(block.ring, block.slot, other=other.place if other else (0, 0),
                 labels=tuple(one.name for one in both))


def can_be_uneven(block: MagnetBlock) -> bool:
    """Tell whether a block can have a gradient or lost corners."""
    return block.has_four_edges


def each_ring(study: Study) -> list[Place]:
    """Return a place for every ring; none in two dimensions."""
    rings = {block.ring for block in unchecked_blocks(study) if block.remanence}
    return [] if study.dimension == 2 else [Place(ring) for ring in sorted(rings)]


def with_remanence(study: Study) -> Study:
    """Return the study with the remanence of its blocks in place of their moment.

    With a moment given, a change of the blocks' volume would change their remanence as well.
    """
    if study.array.remanence_T is not None:
        return study
    bare = with_array(study, exceptions=())
    return with_array(study, block_moment_A_m2=None,
                      remanence_T=build_magnet(bare).blocks[0].remanence)


def changed(nominal: NominalFields, study: Study) -> Floats:
    """Return B (n, 3) in T of the nominal blocks of ``study``, less that of ``nominal``."""
    blocks = unchecked_blocks(study)
    others = np.flatnonzero([new != old for new, old in zip(blocks, nominal.blocks, strict=True)])
    return np.asarray(nominal.fields_of([blocks[number] for number in others]).sum(axis=0)
                      - nominal.block_fields[others].sum(axis=0))


@dataclass(frozen=True)
class Hypothesis:
    """An effect at a place.

    Attributes
    ----------
    effect : Effect
    place : Place
        Block, ring, seam or point at which the effect acts, or the instrument that it changes;
        empty for effects of the whole magnet.
    """

    effect: Effect
    place: Place

    @property
    def name(self) -> str:
        """Effect and place."""
        return f"{self.effect.name} {self.place.name}".strip()

    @property
    def key(self) -> tuple[str, Place]:
        """The name of the effect and its place, which outlive the object of the effect."""
        return self.effect.name, self.place

    def apply(self, study: Study, values: Sequence[float]) -> Study:
        """Return the study with the effect, see `Effect.apply`; in a campaign, in its maps."""
        if not self.place.maps:
            return self.effect.apply(study, self.place, values)
        return study.with_tables({
            one.name: {"instrument": self.effect.apply(
                study.of_map(number), self.place, values).instrument}
            for number, one in enumerate(study.maps) if one.name in self.place.maps})
