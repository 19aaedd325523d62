"""Effects on the magnetization of blocks: lost, uneven, and of blocks in other slots or turned."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError, must_be
from halbach_fe.diagnosis.effects.base import (
    Effect,
    MagnetizationEffect,
    Parameter,
    Place,
    blocks_at,
    can_be_uneven,
    each_block,
    each_ring,
    place_of,
    together,
    unchecked_blocks,
    with_exceptions,
)
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.blocks import MagnetBlock, rotation_matrix
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.geometry.remounting import (
    Move,
    moves_of_rings,
    remounted,
    turns_in_slot,
    turns_over,
)
from halbach_fe.study.array_keys import BlockException
from halbach_fe.study.model import Study


class BlockMissingEffect(Effect):
    """One block is missing."""

    name = "block_missing"
    title = "missing block"
    parameters = (Parameter("there", "1", 1.0),)
    is_binary = True
    applied_in_full = True
    factor = 0.0  # by which the block's magnetization is multiplied

    def places(self, study: Study) -> Sequence[Place]:
        return each_block(study)

    def magnetization_change(
        self, nominal: NominalFields, place: Place
    ) -> Mapping[int, Floats] | None:
        (block,) = blocks_at(nominal.blocks, place)
        return {block: (self.factor - 1) * nominal.magnetizations[block]}

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return with_exceptions(study, [BlockException(
            ring=place.ring, slot=place.slot, magnetization_factor=self.factor)])


class BlockFlippedEffect(BlockMissingEffect):
    """One block has the opposite magnetization."""

    name = "block_flipped"
    title = "block with its magnetization reversed"
    factor = -1.0


class BlockDemagnetizedEffect(MagnetizationEffect):
    """One block has lost a fraction of its magnetization.

    The prior standard deviation is far larger than a block's own tolerance, which belongs to the
    prior of the magnetizations.
    """

    name = "block_demagnetized"
    title = "demagnetized block"
    parameters = (Parameter("loss", "1", 0.1),)

    def places(self, study: Study) -> Sequence[Place]:
        return each_block(study)

    def rates(self, magnet: Magnet, place: Place) -> Mapping[int, Sequence[float]]:
        return dict.fromkeys(blocks_at(magnet.blocks, place), (-1.0,))


class RingDemagnetizedEffect(BlockDemagnetizedEffect):
    """All blocks of a ring are weaker by the same fraction: of another batch or grade, or warmer.

    The remanences of two grades that follow each other differ by 3 to 4 %.
    """

    name = "ring_demagnetized"
    title = "ring of weaker blocks"
    parameters = (Parameter("loss", "1", 0.03),)

    def places(self, study: Study) -> Sequence[Place]:
        """Return several rings: of one alone, it is what all blocks share."""
        return rings if len(rings := each_ring(study)) > 1 else []


class MagnetizationGradientEffect(Effect):
    """The outer half of the blocks is stronger than the inner one, in all blocks or in one.

    The parameter is the difference as a fraction of the mean.
    """

    name = "magnetization_gradient"
    title = "magnetization gradient inside the blocks"
    parameters = (Parameter("gradient", "1", 0.02),)

    def places(self, study: Study) -> Sequence[Place]:
        blocks = unchecked_blocks(study)
        uneven = {block.place for block in blocks if can_be_uneven(block)}
        each = [place for place in each_block(study) if (place.ring, place.slot) in uneven]
        return [Place(), *each] if len(uneven) == len(blocks) else each

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        per_unit = nominal.gradient_fields
        return np.asarray(per_unit[blocks_at(nominal.blocks, place)].sum(axis=0))[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return _more_uneven(study, place, values[0], "magnetization_gradient", "gradient")


def _more_uneven(study: Study, place: Place, change: float, key: str, name: str) -> Study:
    """Return the study in which a property of the blocks at a place is larger by ``change``.

    ``key`` is its key in exceptions, ``name`` that of the attribute of blocks.
    """
    blocks = unchecked_blocks(study)
    present = {number: getattr(blocks[number], name) for number in blocks_at(blocks, place)}
    return with_exceptions(study, [
        BlockException.model_validate(where | {key: value + float(change)})
        for where, value in together(blocks, present)])


class CornersDemagnetizedEffect(Effect):
    """Both inner corners of all blocks have lost a fraction of their magnetization.

    The study's ``inner_corner_loss`` defines the size of a corner.
    """

    name = "corners_demagnetized"
    title = "demagnetized corners at the bore"
    parameters = (Parameter("loss", "1", 0.1),)

    def places(self, study: Study) -> Sequence[Place]:
        return [Place()] if all(map(can_be_uneven, unchecked_blocks(study))) else []

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        lost = [replace(block, corner_loss=block.corner_loss + 1) for block in nominal.blocks]
        return (nominal.fields_of(lost) - nominal.block_fields).sum(axis=0)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        return _more_uneven(study, place, values[0], "inner_corner_loss", "corner_loss")


# --- blocks in other slots, or in another orientation: exact, however large the change is

SHORTLIST = 40
"""Number of places whose signatures are compared; all of them are ranked by an estimate of their
evidence."""

Sources = Sequence[tuple[int, int, Floats]]
"""Number from 0 of every slot that changes, and of the slot from which the block that is there
comes; and the rotation (3, 3) of this block."""


class AssemblyEffect(Effect):
    """Whole blocks are in other slots, or in other orientations, in which they fit."""

    parameters = (Parameter("there", "1", 1.0),)
    is_binary = True
    applied_in_full = True

    @abstractmethod
    def sources(self, magnet: Magnet, place: Place) -> Sources:
        """Return which blocks are where, and how they are turned."""

    def simpler(self, magnet: Magnet) -> Sequence[Sources]:
        """Return changes by other effects, which explain a map in place of equal ones of this."""
        return ()

    def shortlist(
        self, study: Study, mean: Floats, information: Floats, score: Floats
    ) -> Sequence[Place]:
        """Return the places of the largest estimated evidence, see `Effect.shortlist`.

        The evidence of a known change c of the magnetizations is c' score - c' information c / 2.
        Of places that change them equally, as far as they are known, the first is returned.
        """
        magnet, size = build_magnet(study), study.dimension
        vectors = mean.reshape(-1, size)
        places, evidence = [], []
        known = {_rounded(_change(each, vectors), vectors) for each in self.simpler(magnet)}
        known.add(())  # no change
        for place in self.places(study):
            change = _change(self.sources(magnet, place), vectors)
            rounded = _rounded(change, vectors)
            if rounded in known:
                continue
            known.add(rounded)
            places.append(place)
            index = (np.array(list(change))[:, None] * size + np.arange(size)).ravel()
            values = np.concatenate(list(change.values()))
            evidence.append(float(values @ score[index]
                                  - values @ information[np.ix_(index, index)] @ values / 2))
        return [places[k] for k in np.argsort(-np.array(evidence), kind="stable")[:SHORTLIST]]

    def magnetization_change(
        self, nominal: NominalFields, place: Place
    ) -> Mapping[int, Floats] | None:
        return _change(self.sources(nominal.magnet, place), nominal.magnetizations)

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`.

        Raises
        ------
        StudyError
            If exceptions cannot say the move, see `remounted`.
        """
        magnet = build_magnet(study)
        moved = remounted(magnet, self.sources(magnet, place))
        if moved is None:
            raise StudyError(must_be(
                self.title, f"study {study.name}", "a move that exceptions can say", place.name))
        return moved.study


def _change(sources: Sources, magnetizations: Floats) -> dict[int, Floats]:
    """Return the change (D,) in A/m of the magnetization of every block, by its number."""
    size = magnetizations.shape[1]
    return {to: np.asarray(turn[:size, :size] @ magnetizations[source] - magnetizations[to])
            for to, source, turn in sources}


def _rounded(change: dict[int, Floats], vectors: Floats) -> tuple[tuple[int, ...], ...]:
    """Return the blocks that change, and their changes in units of what counts as none."""
    # Difference of magnetizations below which there is none, as a fraction of the largest one.
    no_change = 1e-5
    unit = no_change * float(np.abs(vectors).max())
    whole = {number: np.rint(value / unit).astype(int) for number, value in change.items()}
    return tuple((number, *value.tolist()) for number, value in sorted(whole.items())
                 if np.abs(value).max() > 1)


class BlockPutInWronglyEffect(AssemblyEffect):
    """One block is turned by a large angle, so that it fits its slot again."""

    name = "block_put_in_wrongly"
    title = "block put in the wrong way"

    def places(self, study: Study) -> Sequence[Place]:
        return list(dict.fromkeys(
            _place(block, np.array(turn)) for block in unchecked_blocks(study)
            if block.remanence for turn in (*turns_in_slot(block), *turns_over(block))))

    def simpler(self, magnet: Magnet) -> Sequence[Sources]:
        """See `AssemblyEffect.simpler`: half a turn reverses a block, and is another effect where
        a deviation of its magnetization is known, which is then on the other side.
        """
        return [[(number, number, -np.eye(3))] for number in range(len(magnet.blocks))]

    def sources(self, magnet: Magnet, place: Place) -> Sources:
        number = magnet.number_of(place.ring, place.slot)
        return [(number, number, Rotation.from_rotvec(np.radians(place.at_m)).as_matrix())]


def _place(block: MagnetBlock, turn: Floats) -> Place:
    """Return a place whose ``at_m`` are the components of a rotation vector in degrees."""
    vector = Rotation.from_matrix(turn).as_rotvec(degrees=True)
    vector *= np.sign(vector[np.abs(vector) > 1e-6][-1]) if abs(
        np.linalg.norm(vector) - 180) < 1e-6 else 1.0  # half turns of both signs are the same
    x, y, z = (vector.round(6) + 0.0).tolist()
    return Place(block.ring, block.slot, at_m=(x, y, z), words=(
        f"{block.name}, {_angle_in_words(block, vector)}"))


def _angle_in_words(block: MagnetBlock, vector: Floats) -> str:
    """Describe a rotation vector (3,) in degrees of a block."""
    size = float(np.linalg.norm(vector))
    angle = next((words for known, words in ((90, "a quarter turn"), (180, "half a turn"))
                  if abs(size - known) < 0.1), f"by {size:.0f}°")
    radial = rotation_matrix((0.0, 0.0, np.radians(block.angle_deg))).T @ vector / size
    for axis, name in zip(np.eye(3), ("its radius", "its azimuthal direction", "z"), strict=True):
        if abs(abs(axis @ radial) - 1) < 1e-3:
            sign = "-" if axis @ radial < 0 and size < 179.9 else ""  # half turns have none
            return f"{angle} about {sign}{name}"
    x, y, z = vector / size + 0.0
    return f"{angle} about ({x:.3g}, {y:.3g}, {z:.3g})"


class BlocksSwappedEffect(AssemblyEffect):
    """Two blocks are exchanged, and each keeps its magnetization in the axes of its shape.

    The magnetization thus turns by the angle between the shapes in the two slots. Blocks that are
    oriented along their magnetization are alike but for their errors.
    """

    name = "blocks_swapped"
    title = "two blocks that changed places"

    def places(self, study: Study) -> Sequence[Place]:
        """Return pairs of successive blocks of a ring, as examples; the search uses `shortlist`."""
        rings: dict[int, list[MagnetBlock]] = {}
        for block in unchecked_blocks(study):
            rings.setdefault(block.ring, []).append(block)
        return [place_of(block, after) for ring in rings.values()
                for block, after in zip(ring, ring[1:] + ring[:1], strict=True)
                if _interchangeable(block, after) and block is not after]

    def shortlist(
        self, study: Study, mean: Floats, information: Floats, score: Floats
    ) -> Sequence[Place]:
        """Return the pairs of the largest estimated evidence, see `Effect.shortlist`.

        The exchange of two blocks changes the magnetizations by a known vector c, so that the log
        evidence of the exchange is c' score - c' information c / 2. Both terms follow for all pairs
        at once from the entries of the two blocks.
        """
        blocks, size = unchecked_blocks(study), study.dimension
        vectors = mean.reshape(len(blocks), size)
        turns = np.array([block.shape_axes[:size, :size] for block in blocks])
        own = np.einsum("jba,jb->ja", turns, vectors)
        # change of the magnetization at place i when it receives the block of place j
        change = np.einsum("iab,jb->ija", turns, own) - vectors[:, None]
        weights = information.reshape(len(blocks), size, len(blocks), size)
        here = np.einsum("ija,iaib,ijb->ij", change, weights, change, optimize=True)
        cross = np.einsum("ija,iajb,jib->ij", change, weights, change, optimize=True)
        gain = np.einsum("ija,ia->ij", change, score.reshape(len(blocks), size))
        evidence = gain + gain.T - (here + here.T + 2 * cross) / 2
        kinds = {key: number for number, key in enumerate(dict.fromkeys(map(_kind, blocks)))}
        kind = np.array([kinds[_kind(block)] for block in blocks])
        there = np.array([block.remanence != 0 for block in blocks])
        possible = (kind[:, None] == kind) & np.outer(there, there)
        first, second = np.nonzero(np.triu(possible, 1))
        best = np.argsort(-evidence[first, second])[:SHORTLIST]
        return [place_of(blocks[i], blocks[j])
                for i, j in zip(first[best], second[best], strict=True)]

    def sources(self, magnet: Magnet, place: Place) -> Sources:
        pair = magnet.number_of(place.ring, place.slot), magnet.number_of(*place.other)
        return [(to, source, magnet.blocks[to].carried_from(magnet.blocks[source]))
                for to, source in (pair, pair[::-1])]


def _kind(block: MagnetBlock) -> tuple[float, float]:
    """Return cross-section and length, which blocks share that could have changed places."""
    return float(f"{block.area:.6g}"), float(f"{block.z_max - block.z_min:.6g}")


def _interchangeable(block: MagnetBlock, other: MagnetBlock) -> bool:
    """Tell whether two blocks could have changed places: neither is missing, and they are alike."""
    return bool(block.remanence and other.remanence) and _kind(block) == _kind(other)


KINDS = ("exchanged", "turned", "upside down")
"""Moves of rings, the simplest first."""


class RingsMovedEffect(AssemblyEffect):
    """Whole rings are moved, after which every block fits a slot again."""

    def __init__(self, name: str, title: str, move: str) -> None:
        self.name = name
        self.title = title
        self.move = move

    def places(self, study: Study) -> Sequence[Place]:
        return [Place(words=words) for words in moves_of_rings(build_magnet(study), self.move)]

    def simpler(self, magnet: Magnet) -> Sequence[Sources]:
        """See `AssemblyEffect.simpler`: a ring of a regular order that is upside down may be equal
        to one that is turned, and exchanged halves to turned ones.
        """
        kinds = KINDS[:KINDS.index(self.move)]
        return [_moved(magnet, move) for kind in kinds
                for move in moves_of_rings(magnet, kind).values()]

    def sources(self, magnet: Magnet, place: Place) -> Sources:
        return _moved(magnet, moves_of_rings(magnet, self.move)[place.words])


def _moved(magnet: Magnet, move: Move) -> Sources:
    """Return which blocks are where after a move of rings."""
    return [(to, source, magnet.blocks[to].carried_from(magnet.blocks[source])
             if move.turn is None else np.array(move.turn)) for to, source in move.pairs]


EFFECTS = (
    BlockMissingEffect(), BlockFlippedEffect(), BlockDemagnetizedEffect(),
    RingDemagnetizedEffect(), MagnetizationGradientEffect(), CornersDemagnetizedEffect(),
    BlockPutInWronglyEffect(), BlocksSwappedEffect(),
    RingsMovedEffect("rings_swapped", "two rings or halves that changed places", "exchanged"),
    RingsMovedEffect("rings_turned", "ring or half turned by slots", "turned"),
    RingsMovedEffect("rings_upside_down", "ring or half put in upside down", "upside down"))
