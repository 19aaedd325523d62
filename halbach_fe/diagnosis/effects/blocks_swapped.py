"""Two blocks that were mounted in each other's places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.assembly import SHORTLIST, brought_along
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, place_of, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.geometry.magnet import build_magnet
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study


class BlocksSwappedEffect(Effect):
    """Two blocks are exchanged, and each keeps its magnetization in the axes of its shape.

    The magnetization thus turns by the angle between the shapes in the two slots. Blocks that are
    oriented along their magnetization are alike but for their errors.
    """

    name = "blocks_swapped"
    title = "two blocks that changed places"
    kind = "field"
    parameters = (Parameter("there", "1", 1.0),)
    is_binary = True
    applied_in_full = True

    def places(self, study: Study) -> Sequence[Place]:
        """Return pairs of successive blocks of a ring, as examples; the search uses `shortlist`."""
        rings: dict[int, list[MagnetBlock]] = {}
        for block in build_magnet(study).blocks:
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
        blocks, size = build_magnet(study).blocks, study.dimension
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

    def magnetization_change(
        self, nominal: NominalFields, place: Place
    ) -> Mapping[int, Floats] | None:
        """See `Effect.magnetization_change`."""
        return self._change(nominal, place)

    def _change(self, nominal: NominalFields, place: Place) -> dict[int, Floats]:
        """Return the change (D,) in A/m of the magnetization at both places."""
        where = [(block.ring, block.slot) for block in nominal.blocks]
        here, there = where.index((place.ring, place.slot)), where.index(place.other)
        size, change = nominal.study.dimension, {}
        for to, source in ((here, there), (there, here)):
            turn = nominal.blocks[to].carried_from(nominal.blocks[source])
            change[to] = np.asarray(turn[:size, :size] @ nominal.magnetizations[source]
                                    - nominal.magnetizations[to])
        return change

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        return np.sum([nominal.field_with(block, change) for block, change in self._change(
            nominal, place).items()], axis=0)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        here, magnet = (place.ring, place.slot), build_magnet(study)
        one, other = (magnet.blocks[magnet.number_of(*slot)] for slot in (here, place.other))
        return with_exceptions(study, [
            BlockException(ring=here[0], slot=here[1], mounted_from=place.other,
                           **brought_along(one, other)),
            BlockException(ring=place.other[0], slot=place.other[1], mounted_from=here,
                           **brought_along(other, one))])


def _kind(block: MagnetBlock) -> tuple[float, float]:
    """Return cross-section and length, which blocks share that could have changed places."""
    return float(f"{block.area:.6g}"), float(f"{block.z_max - block.z_min:.6g}")


def _interchangeable(block: MagnetBlock, other: MagnetBlock) -> bool:
    """Tell whether two blocks could have changed places: neither is missing, and they are alike."""
    return bool(block.remanence and other.remanence) and _kind(block) == _kind(other)


EFFECTS = (BlocksSwappedEffect(),)
