"""What every effect has: a name, parameters with priors, a signature, and its way into a study."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.magnet import BlockException
from halbach_fe.study.measurement import Instrument
from halbach_fe.study.model import Study
from halbach_fe.study.types import COMPONENTS


@dataclass(frozen=True)
class Parameter:
    """An amplitude of an effect: its name, unit, prior standard deviation about 0, and the smallest
    one that there can be.
    """

    name: str
    unit: str
    sd: float
    least: float = -np.inf


@dataclass(frozen=True)
class Place:
    """Where an effect may be: a ring, a slot of it (0 is all), coordinates or lengths in m;
    ``other`` is the ring and slot of a second block.
    """

    ring: int = 0
    slot: int = 0
    at_m: tuple[float, ...] = ()
    other: tuple[int, int] = (0, 0)

    @property
    def name(self) -> str:
        """Label in reports."""
        ring, slot = (f"{letter}{number:02d}" if number else ""
                      for letter, number in (("r", self.ring), ("s", self.slot)))
        if self.at_m:
            places = (round(one, 6) + 0.0 for one in self.at_m)  # no -0, no 1e-18
            return f"at {', '.join(f'{one:.4g}' for one in places)} m"
        if self.other[0]:
            return f"{ring}{slot}, r{self.other[0]:02d}s{self.other[1]:02d}"
        return ring + slot


class Effect(ABC):
    """Something that a model may lack.

    Attributes
    ----------
    name : str
        Standard name.
    title : str
        In words, for a report.
    kind : str
        ``field``: the magnet or what is around it; ``instrument``: the mapper.
    parameters : tuple of Parameter
    refinements : tuple of Parameter
        More of them, that are looked for once the effect is in the model.
    certain : bool
        Whether it is there with amplitude 1 or not at all, as a block upside down.
    only : bool
        Whether it is in one place at most, as an iron ring.
    discrete : bool
        Whether `apply` puts all of it into a study, whatever its amplitude.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    kind: ClassVar[Literal["field", "instrument"]]
    parameters: tuple[Parameter, ...]
    refinements: ClassVar[tuple[Parameter, ...]] = ()
    certain: ClassVar[bool] = False
    only: ClassVar[bool] = False
    discrete: ClassVar[bool] = False

    def places(self, study: Study) -> Sequence[Place]:
        """Where in a study it may be; none if the study rules it out."""
        return [Place()]

    def shortlist(
        self, study: Study, mean: Floats, information: Floats, score: Floats
    ) -> Sequence[Place]:
        """The places worth a look, where there are too many for a signature of each.

        Parameters
        ----------
        mean : ndarray, shape (m,), in A/m
            Of the prior of the magnetizations.
        information, score : ndarray, shape (m, m) and (m,)
            H' S^-1 H and H' S^-1 r, see `halbach_fe.diagnosis.evidence`.
        """
        return self.places(study)

    @abstractmethod
    def signature(self, scene: NominalFields, place: Place) -> Floats:
        """Change of the readings of a map, (k, n, 3) in T per unit of each parameter."""

    def refine(self, scene: NominalFields, place: Place, values: Sequence[float]) -> Floats:
        """Change of the readings of a map, (r, n, 3) in T per unit of each refinement, at values of
        all parameters, in a scene without the effect.
        """
        return np.empty((0, *scene.points.shape))

    @abstractmethod
    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """The study with the effect, in full, its amplitudes (k,) added to what is there."""


class InstrumentEffect(Effect):
    """An effect of the mapper: a change of the study's instrument."""

    kind = "instrument"

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        change = self.change(study.instrument, values)
        instrument = Instrument.model_validate(study.instrument.model_dump() | dict(change))
        return study.with_(instrument=instrument)

    @abstractmethod
    def change(self, instrument: Instrument, values: Sequence[float]) -> Mapping[str, Any]:
        """The instrument's keys that change, with their new values."""


def added(values: Sequence[float], change: Sequence[float]) -> tuple[float, ...]:
    """Sum of two vectors, for a key of a study."""
    return tuple(float(one) + float(other) for one, other in zip(values, change, strict=True))


def along(axis: str, value: float) -> tuple[float, float, float]:
    """A vector along x, y or z."""
    x, y, z = (value if name == axis else 0.0 for name in COMPONENTS)
    return x, y, z


def with_exceptions(study: Study, exceptions: Sequence[BlockException]) -> Study:
    """The study with more exceptions to its blocks."""
    array = study.array.with_(exceptions=(*study.array.exceptions, *exceptions))
    return study.with_(array=array)


def with_array(study: Study, **keys: Any) -> Study:
    """The study with other keys of its array."""
    return study.with_(array=study.array.with_(**keys))


def blocks_at(scene: NominalFields, place: Place) -> list[int]:
    """Numbers of the blocks of a place."""
    return [number for number, block in enumerate(scene.blocks)
            if place.ring in (0, block.ring) and place.slot in (0, block.slot)]


def each_block(study: Study) -> list[Place]:
    """A place for every block."""
    array = study.array
    return [Place(ring, slot) for ring in range(1, array.rings + 1)
            for slot in range(1, array.blocks_per_ring + 1)]


def each_ring(study: Study) -> list[Place]:
    """A place for every ring; none in a cross-section."""
    return [] if study.dimension == 2 else [Place(ring) for ring in range(1, study.array.rings + 1)]


def with_remanence(study: Study) -> Study:
    """The study with its remanence in place of a moment, which would change with the blocks."""
    if study.array.remanence_T is not None:
        return study
    bare = with_array(study, exceptions=())
    return with_array(study, block_moment_A_m2=None,
                      remanence_T=build_magnet(bare).blocks[0].remanence)


def changed(scene: NominalFields, study: Study) -> Floats:
    """How B (n, 3) in T of the nominal blocks differs in another study."""
    return np.asarray(scene.block_fields_of(study).sum(axis=0)
                      - scene.block_fields.sum(axis=0))
