"""The bodies of iron that a study describes: coaxial tubes and discs, and prisms along z."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from halbach_fe.core.arrays import Floats
from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.blocks import rotation_about_z
from halbach_fe.geometry.free_blocks import counter_clockwise
from halbach_fe.geometry.outline import Outline, closed_outline
from halbach_fe.geometry.surface import Contact, contact_of_prism, contact_of_tube
from halbach_fe.study.iron import Iron, IronRing


@dataclass(frozen=True)
class IronSolid:
    """One body of iron.

    Attributes
    ----------
    inner_radius, outer_radius : float, in m
        Of a tube about the z axis; the inner radius of a disc is 0. Of a prism, the radii of the
        cylinders about the z axis that it lies between.
    z_min, z_max : float, in m
        Infinite in 2D.
    outline : Outline, optional
        Outline of a prism in the (x, y) plane; None for a tube.
    """

    inner_radius: float
    outer_radius: float
    z_min: float
    z_max: float
    outline: Outline | None = None

    @property
    def name(self) -> str:
        """What sentences call it."""
        return "the iron"

    @property
    def radius(self) -> float:
        """Radius in m of the cylinder about the z axis around the body."""
        return self.outer_radius

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Tell which points (n, 3) in m lie inside the body, and not on its surface."""
        return self.contact(points).inside

    def contact(self, points: Floats) -> Contact:
        """Return where points (n, 3) in m lie relative to the body's surface."""
        if self.outline is not None:
            return contact_of_prism(self.outline, self.z_min, self.z_max, points)
        return contact_of_tube(self.inner_radius, self.outer_radius, self.z_min, self.z_max,
                               points)


def iron_solids(
    dimension: int, ring: IronRing | None, iron: Iron | None, array_half_length: float
) -> tuple[IronSolid, ...]:
    """Return the bodies of a study's iron; those without a length are as long as the array."""
    def limits(length: float | None, z: float = 0.0) -> tuple[float, float]:
        if dimension == 2:
            return -np.inf, np.inf
        half = length / 2 if length else array_half_length
        return z - half, z + half

    if ring is not None:
        return (IronSolid(ring.inner_radius_m, ring.outer_radius_m, *limits(ring.length_m)),)
    solids: list[IronSolid] = []
    for body in iron.bodies if iron else ():
        ends = limits(body.length_m, body.z_m)
        if body.kind == "tube":
            solids.append(IronSolid(body.inner_radius_m, body.outer_radius_m, *ends))
            continue
        corners = counter_clockwise(np.array(body.outline_m))
        for number in range(body.copies):
            outline = closed_outline(
                corners @ rotation_about_z(2 * np.pi * number / body.copies)[:2, :2].T)
            t = np.linspace(0.0, 1.0, 17)
            radii = np.hypot(*np.vstack([edge.at(t)[0] for edge in outline]).T)
            solids.append(IronSolid(float(radii.min()), float(radii.max()), *ends, outline))
    return tuple(solids)


def check_iron_ring(ring: IronRing, array_outer_radius: float) -> None:
    """Refuse an iron ring that does not lie outside the blocks.

    Raises
    ------
    StudyError
    """
    if ring.inner_radius_m < array_outer_radius * (1 - 1e-9):
        raise StudyError(
            f"Input `iron_ring.inner_radius_m` of study must be at least {array_outer_radius:.6g}, "
            f"where the blocks end; instead received {ring.inner_radius_m:g}. Enlarge the ring.")
