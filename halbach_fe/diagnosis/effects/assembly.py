"""Base of effects of assembly: blocks in other slots, or in another orientation.

They are exact: which magnetization every block then has is known, however large the change is.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from halbach_fe.core.arrays import Floats
from halbach_fe.diagnosis.effects.base import Effect, Parameter, Place, with_exceptions
from halbach_fe.diagnosis.nominal_fields import NominalFields
from halbach_fe.geometry.blocks import MagnetBlock, rotation_matrix
from halbach_fe.geometry.magnet import Magnet, build_magnet
from halbach_fe.study.array import BlockException
from halbach_fe.study.model import Study

SHORTLIST = 40
"""Number of places whose signatures are compared; all of them are ranked by an estimate of their
evidence."""

NO_CHANGE = 1e-5
"""Difference of magnetizations below which there is none, as a fraction of the largest one."""

Sources = tuple[tuple[tuple[int, int], ...], Floats]
"""Number from 0 of every slot that changes, and of the slot from which the block that is there
comes; and the rotation (3, 3) of these blocks."""


class AssemblyEffect(Effect):
    """Whole blocks are in other slots, or in other orientations, in which they fit."""

    kind = "field"
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
        """See `Effect.magnetization_change`."""
        return _change(self.sources(nominal.magnet, place), nominal.magnetizations)

    def signature(self, nominal: NominalFields, place: Place) -> Floats:
        """See `Effect.signature`."""
        change = _change(self.sources(nominal.magnet, place), nominal.magnetizations)
        return np.sum([nominal.field_with(block, value) for block, value in change.items()],
                      axis=0)[None]

    def apply(self, study: Study, place: Place, values: Sequence[float]) -> Study:
        """See `Effect.apply`."""
        magnet = build_magnet(study)
        pairs, turn = self.sources(magnet, place)
        return with_exceptions(study, [
            _exception(magnet.blocks[to], magnet.blocks[source], turn) for to, source in pairs])


def _change(sources: Sources, magnetizations: Floats) -> dict[int, Floats]:
    """Return the change (D,) in A/m of the magnetization of every block, by its number."""
    pairs, turn = sources
    size = magnetizations.shape[1]
    return {to: np.asarray(turn[:size, :size] @ magnetizations[source] - magnetizations[to])
            for to, source in pairs}


def _rounded(change: dict[int, Floats], vectors: Floats) -> tuple[tuple[int, ...], ...]:
    """Return the blocks that change, and their changes in units of what counts as none."""
    unit = NO_CHANGE * float(np.abs(vectors).max())
    whole = {number: np.rint(value / unit).astype(int) for number, value in change.items()}
    return tuple((number, *value.tolist()) for number, value in sorted(whole.items())
                 if np.abs(value).max() > 1)


def _exception(to: MagnetBlock, source: MagnetBlock, turn: Floats) -> BlockException:
    """Return the exception by which a block from another slot is turned by a rotation (3, 3)."""
    rest = turn @ to.carried_from(source).T
    axes = rotation_matrix((0.0, 0.0, np.radians(to.angle_deg)))
    x, y, z = np.degrees(axes.T @ Rotation.from_matrix(rest).as_rotvec()).round(9).tolist()
    came = None if to is source else (source.ring, source.slot)
    return BlockException(ring=to.ring, slot=to.slot, mounted_from=came, rotation_deg=(x, y, z),
                          **brought_along(to, source))


def brought_along(to: MagnetBlock, source: MagnetBlock) -> dict[str, Any]:
    """Return the keys of an exception for what a block from another slot has with it: its material.

    They are empty if the material is the same in both slots.
    """
    names = ("remanence", "recoil_permeability", "recoil_permeability_across")
    mine, theirs = ([getattr(block, name) for name in names] for block in (to, source))
    if mine == theirs or not source.remanence:
        return {}
    return {"remanence_T": abs(source.remanence), "recoil_permeability": theirs[1],
            "recoil_permeability_across": theirs[2]}
