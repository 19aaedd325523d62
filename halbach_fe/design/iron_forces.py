"""Forces on bodies of iron, by what the iron does to all else.

The force of blocks and coils on a body is, by Newton's third law, minus that of the body's own
field on them: on the surface charge of the blocks (`halbach_fe.design.forces`) and on the current
of the coils. Blocks may touch the iron. The force between two bodies is the integral of the mixed
part of Maxwell's stress tensor,

    ``1/mu_0 int (B_1 (B_2.n) + B_2 (B_1.n) - (B_1.B_2) n) dS``,

with B_1 and B_2 the fields of the polarization of each alone, over a plane that separates them (J.
D. Jackson, Classical Electrodynamics, 3rd ed., section 6.7); whatever else lies across the plane
takes no part. Bodies that touch, or that no plane separates, feel one force together. The change
from a mesh twice as coarse is the error bar.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components

from halbach_fe.core.arrays import Floats
from halbach_fe.geometry.blocks import rotation_matrix
from halbach_fe.geometry.magnet import Magnet
from halbach_fe.solver.coil_field import current_elements
from halbach_fe.solver.iron_bodies import BodiesReaction
from halbach_fe.study.materials import MU_0

if TYPE_CHECKING:
    from halbach_fe.solver.axisymmetric_iron import IronReaction

Field = Callable[[Floats], Floats]
"""Takes points (n, 3) in m and returns B (n, 3) in T."""


@dataclass(frozen=True)
class IronLoads:
    """Forces on bodies of iron.

    Attributes
    ----------
    names : tuple of str
        ``iron 1`` for the first body; bodies that feel one force together are one name.
    force_N : ndarray, shape (bodies, 3)
        Along x, y and z of the magnet.
    error_N : ndarray, shape (bodies,)
        Error bars.
    """

    names: tuple[str, ...]
    force_N: Floats
    error_N: Floats


@dataclass(frozen=True)
class Gap:
    """A plane through ``origin`` (3,) in m between two bodies, with ``normal`` (3,) to the second.

    ``width`` in m is the distance of the bodies across it; ``low`` and ``high`` (2,) in m are how
    far both reach along it, on the axes of `tangents`.
    """

    origin: Floats
    normal: Floats
    width: float
    low: Floats
    high: Floats

    @property
    def tangents(self) -> Floats:
        """Two unit vectors (2, 3) along the plane."""
        return _tangents(self.normal)

    def points(self, panels: int) -> tuple[Floats, Floats]:
        """Return points (n, 3) in m of the plane and their areas (n,), to infinity.

        Each side has at most ``panels`` parts of four Gauss points, as wide as the gap or wider.
        """
        rules = [_line(low, high, max(1, min(panels, int(np.ceil((high - low) / self.width)))))
                 for low, high in zip(self.low, self.high, strict=True)]
        (u, of_u), (v, of_v) = rules
        places = (u[:, None, None] * self.tangents[0] + v[:, None] * self.tangents[1]
                  + (self.origin @ self.normal) * self.normal)
        return places.reshape(-1, 3), np.outer(of_u, of_v).ravel()


def _tangents(normal: Floats) -> Floats:
    seed = np.eye(3)[np.abs(normal).argmin()]
    first = np.cross(normal, seed)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(normal, first)])


def _line(low: float, high: float, panels: int) -> tuple[Floats, Floats]:
    """Return points and weights from minus to plus infinity, in equal panels between two places."""
    x, weight = np.polynomial.legendre.leggauss(4)
    x, weight = (x + 1) / 2, weight / 2
    step = (high - low) / panels
    inner = (low + step * (np.arange(panels)[:, None] + x)).ravel()
    # outside, x = high + size t / (1 - t): products of two dipoles' fields fall with the power 6
    t, of_t = np.polynomial.legendre.leggauss(8)
    t, of_t = (t + 1) / 2, of_t / 2
    away, of_away = (high - low) * t / (1 - t), (high - low) * of_t / (1 - t) ** 2
    return (np.concatenate([low - away, inner, high + away]),
            np.concatenate([of_away, np.tile(step * weight, panels), of_away]))


def iron_loads(magnet: Magnet, charges: Sequence[tuple[Floats, Floats]],
               iron: IronReaction | BodiesReaction) -> IronLoads:
    """Compute the forces on the iron of a magnet.

    Parameters
    ----------
    magnet : Magnet
    charges : sequence of two pairs
        Points (n, 3) in m on the faces of the blocks, and their magnetic charges (n,) in A m: of a
        good quadrature, and of a coarser one for the error bar.
    iron : IronReaction or BodiesReaction
        Its solution, with a coarser one for the error bar.
    """
    if not isinstance(iron, BodiesReaction):
        rough = iron.coarse or iron
        found, other = (_of_sources(magnet, charge, each.field)
                        for charge, each in zip(charges, (iron, rough), strict=True))
        return IronLoads(("iron",), found[None], np.array([np.linalg.norm(found - other)]))
    groups, gaps = _groups(iron)
    found, other = (_of_bodies(magnet, charge, each, groups, gaps, panels) for charge, each, panels
                    in zip(charges, (iron, iron.coarse or iron), (40, 20), strict=True))
    return IronLoads(tuple(f"iron {' and '.join(str(number + 1) for number in group)}"
                           for group in groups), found, np.linalg.norm(found - other, axis=1))


def _of_bodies(magnet: Magnet, charge: tuple[Floats, Floats], iron: BodiesReaction,
               groups: Sequence[tuple[int, ...]], gaps: dict[tuple[int, int], Gap], panels: int
               ) -> Floats:
    """Return the forces (groups, 3) in N on groups of bodies, see `iron_loads` and `_groups`."""
    def field(number: int) -> Field:
        return lambda points: iron.field_of_bodies(groups[number], points)

    found = np.array([_of_sources(magnet, charge, field(number)) for number in range(len(groups))])
    for (first, second), gap in gaps.items():
        points, areas = gap.points(panels)
        one, other = field(first)(points), field(second)(points)
        stress = (one * (other @ gap.normal)[:, None] + other * (one @ gap.normal)[:, None]
                  - np.einsum("ni,ni->n", one, other)[:, None] * gap.normal)
        force = areas @ stress / MU_0
        found[first] += force
        found[second] -= force
    return found


def _of_sources(magnet: Magnet, charge: tuple[Floats, Floats], field: Field) -> Floats:
    """Return the force (3,) in N of blocks and coils on iron with a field of its own."""
    points, charges = charge
    found = -charges @ field(points)
    for coil in magnet.external.coils:
        places, currents = current_elements(coil)
        found -= np.cross(currents, field(places)).sum(axis=0)
    return np.asarray(found)


def _groups(iron: BodiesReaction) -> tuple[list[tuple[int, ...]], dict[tuple[int, int], Gap]]:
    """Return the bodies that feel a force together, and the gaps between two such groups."""
    problem = iron.problem
    places = [problem.places[problem.body == number].reshape(-1, 3)
              for number in range(len(problem.bodies))]
    label = np.arange(len(places))
    while True:
        numbers = [tuple(np.flatnonzero(label == one).tolist()) for one in np.unique(label)]
        gaps, joined = {}, np.eye(len(numbers))
        for first, second in combinations(range(len(numbers)), 2):
            axes = [rotation_matrix(problem.bodies[number].turn_rad).T
                    for number in (*numbers[first], *numbers[second])]
            one, other = (np.vstack([places[number] for number in numbers[each]])
                          for each in (first, second))
            gap = _gap(one, other, np.vstack([np.eye(3), *axes]))
            if gap is None:
                joined[first, second] = 1.0
            else:
                gaps[first, second] = gap
        count, group = connected_components(sparse.csr_array(joined), directed=False)
        if count == len(numbers):
            return numbers, gaps
        for members, together in zip(numbers, group, strict=True):
            label[list(members)] = together


def _gap(first: Floats, second: Floats, axes: Floats) -> Gap | None:
    """Return the widest gap between points (n, 3) and (m, 3) across one of the axes (k, 3)."""
    both = np.vstack([first, second])
    between = second.mean(axis=0) - first.mean(axis=0)
    axes = np.vstack([axes, between / (np.linalg.norm(between) or 1.0)])
    axes = np.vstack([axes, -axes])
    widths = (second @ axes.T).min(axis=0) - (first @ axes.T).max(axis=0)
    best = int(widths.argmax())
    touching = 1e-6 * float(np.ptp(both, axis=0).max())
    if widths[best] <= touching:
        return None
    normal = axes[best]
    along = both @ _tangents(normal).T
    return Gap(((first @ normal).max() + widths[best] / 2) * normal, normal, float(widths[best]),
               along.min(axis=0), along.max(axis=0))
