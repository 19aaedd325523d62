"""The magnet that a study describes: its blocks, its iron ring, and its outer dimensions.

`build_magnet` builds it once; all functions that compute a field take it as an argument.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.core.notebook import ShownInNotebook
from halbach_fe.geometry.array_layout import blocks_of_array, ring_limits
from halbach_fe.geometry.blocks import MagnetBlock
from halbach_fe.study.magnet import Array, External, IronRing
from halbach_fe.study.materials import Curve
from halbach_fe.study.model import Study, curve_of, is_nonlinear
from halbach_fe.study.types import COMPONENTS

SHAPE_KEYS = ("dimension", "array")
"""Keys of a study that the blocks depend on."""


@dataclass(frozen=True)
class Magnet(ShownInNotebook):
    """The blocks of a magnet, together with the study that describes them.

    Use `build_magnet` to make one.

    Attributes
    ----------
    study : Study
    blocks : tuple of MagnetBlock
        Ring by ring (lowest z first), slot by slot.
    parameter_names : tuple of str
        Names of the magnetization components that the inference determines, block by block.
    nominal_magnetization : ndarray, shape (parameters,), in A/m
        Nominal values of these components.
    radius, half_length : float
        Outer radius and half the length of the magnet in m, including the iron ring; the length of
        a 2D magnet is infinite.

    Examples
    --------
    >>> from halbach_fe.study.reader import parse_study
    >>> magnet = build_magnet(parse_study({
    ...     "name": "ring", "dimension": 2, "mesh": {"block_size_m": 0.01},
    ...     "array": {"blocks_per_ring": 8, "inner_radius_m": 0.05, "outer_radius_m": 0.08,
    ...               "remanence_T": 1.3, "block": {"shape": "sector"}},
    ...     "observation": {"quantity": "flux_density", "positions": {
    ...         "kind": "points", "points_m": [[0, 0, 0]]}}}))
    >>> len(magnet.blocks), magnet.radius, magnet.parameter_names[:2]
    (8, 0.08, ('r01s01.Mx', 'r01s01.My'))
    """

    study: Study
    blocks: tuple[MagnetBlock, ...]

    @property
    def name(self) -> str:
        """Name of the study."""
        return self.study.name

    @property
    def dimension(self) -> int:
        """2 for a cross-section, 3 for a magnet of finite length."""
        return self.study.dimension

    @property
    def array(self) -> Array:
        """The array of blocks as the study gives it."""
        return self.study.array

    @property
    def iron_ring(self) -> IronRing | None:
        """The iron tube around the blocks, or None."""
        return self.study.iron_ring

    @property
    def external(self) -> External:
        """Sources of magnetic field outside the magnet."""
        return self.study.external

    @cached_property
    def curve(self) -> Curve | None:
        """Magnetization curve of the iron ring, or None if there is none."""
        return curve_of(self.study)

    @property
    def is_nonlinear(self) -> bool:
        """Whether the field is a non-linear function of the magnetizations (iron with a curve)."""
        return is_nonlinear(self.study)

    @cached_property
    def is_vacuum(self) -> bool:
        """Whether all permeabilities are 1, so that the closed-form field needs no correction."""
        return self.iron_ring is None and all(
            block.isotropic and block.recoil_permeability == 1.0 for block in self.blocks)

    @cached_property
    def nominal_magnetization(self) -> Floats:
        """Nominal M of all blocks, (parameters,) in A/m; two components per block in 2D."""
        return np.concatenate([block.magnetization[:self.dimension] for block in self.blocks])

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the magnetization parameters; ``r01s05.Mx`` is M_x of ring 1, slot 5."""
        components = COMPONENTS[:self.dimension]
        return tuple(f"{block.name}.M{c}" for block in self.blocks for c in components)

    @cached_property
    def ring_limits(self) -> tuple[tuple[float, float], ...]:
        """Limits of z in m of every ring; the array is centred at z = 0, infinite in 2D."""
        return tuple(ring_limits(self.study))

    @property
    def array_half_length(self) -> float:
        """Half the length of the array in m; infinite in 2D."""
        return self.ring_limits[-1][1]

    @cached_property
    def array_outer_radius(self) -> float:
        """Radius in m of the smallest cylinder about the z axis around all nominal blocks."""
        slots = self.array.blocks_per_ring
        return max(edge.radius for block in self.blocks[:slots] for edge in block.outline)

    @property
    def iron_half_length(self) -> float:
        """Half the length of the iron ring in m (default: that of the array); infinite in 2D."""
        iron = self.iron_ring
        if self.dimension == 3 and iron is not None and iron.length_m:
            return iron.length_m / 2
        return self.array_half_length

    @cached_property
    def radius(self) -> float:
        """Outer radius in m of the magnet, including the iron ring.

        Raises
        ------
        StudyError
            If the iron ring overlaps the blocks.
        """
        radius = self.array_outer_radius
        if self.iron_ring is None:
            return radius
        if self.iron_ring.inner_radius_m < radius * (1 - 1e-9):
            raise StudyError(
                f"Input `iron_ring.inner_radius_m` of study must be at least {radius:.6g}, where "
                f"the blocks end; instead received {self.iron_ring.inner_radius_m:g}. Enlarge the "
                "ring.")
        return self.iron_ring.outer_radius_m

    @property
    def half_length(self) -> float:
        """Half the length of the magnet in m, including the iron ring."""
        return max(self.array_half_length, self.iron_half_length)

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m lie inside a block or the iron ring."""
        inside = np.zeros(len(points), bool)
        for block in self.blocks:
            inside |= block.contains(points)
        ring = self.iron_ring
        if ring is not None:
            radius = np.hypot(points[:, 0], points[:, 1])
            inside |= ((radius >= ring.inner_radius_m) & (radius <= ring.outer_radius_m)
                       & (np.abs(points[:, 2]) <= self.iron_half_length))
        return inside

    def with_(self, **changes: Any) -> Magnet:
        """Return the magnet of the same study with other values of some keys, see `Study.with_`."""
        return self.with_study(self.study.with_(**changes))

    def with_study(self, study: Study) -> Magnet:
        """Return the magnet of another study; blocks are built again only if they may differ."""
        same = all(getattr(study, key) == getattr(self.study, key) for key in SHAPE_KEYS)
        return Magnet(study, self.blocks) if same else build_magnet(study)


def build_magnet(study: Study) -> Magnet:
    """Build the magnet that a study describes.

    Parameters
    ----------
    study : Study
        The study, see `halbach_fe.read_study`.

    Returns
    -------
    Magnet

    Raises
    ------
    StudyError
        If the blocks cannot be built as described, for example because neighbours overlap.

    Examples
    --------
    >>> import halbach_fe as hf
    >>> hf.build_magnet(hf.read_study("dipole.toml")).blocks[0].name
    'r01s01'
    """
    return Magnet(study, blocks_of_array(study))
