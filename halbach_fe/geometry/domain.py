"""The computational domain of a finite-element solve: radius and length of its outer boundary."""

from __future__ import annotations

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import Magnet

BOUNDARY_RATIO = {"cross_section": 30.0, "extruded": 10.0, "meridian": 20.0}
"""Ratio of the boundary's radius to the magnet's radius, by kind of mesh. The far field of a block
falls as 1/r^2 in 2D and 1/r^3 in 3D, and so does the relative error that the boundary causes: 1e-3
at these ratios. Elements grow towards the boundary, so that distance is cheap, and cheapest in the
(r, z) half-plane, where the boundary is therefore farther than in the extruded mesh."""


def boundary_radius(magnet: Magnet, mesh: str) -> float:
    """Return the radius in m of the outer boundary of a kind of mesh (a key of BOUNDARY_RATIO).

    Raises
    ------
    StudyError
        If the study puts the boundary too close to the magnet.
    """
    inside = magnet.radius
    default = BOUNDARY_RATIO[mesh] * inside
    radius = magnet.study.open_boundary.radius_m or default
    if radius <= 1.2 * inside:
        raise StudyError(
            f"Input `open_boundary.radius_m` of study must be well beyond the magnet "
            f"({inside:g} m); instead received {radius:g}. Leave it out for {default:g}."
        )
    return radius


def boundary_half_length(magnet: Magnet, mesh: str) -> float:
    """Return half the length in m of a kind of mesh (a key of BOUNDARY_RATIO).

    Raises
    ------
    StudyError
        If the study puts the boundary too close to the magnet.
    """
    end, radius = magnet.half_length, magnet.radius
    default = end + BOUNDARY_RATIO[mesh] * radius
    half = magnet.study.open_boundary.half_length_m or default
    if half <= end + 0.2 * radius:
        raise StudyError(
            f"Input `open_boundary.half_length_m` of study must be well beyond the magnet's end "
            f"({end:g} m); instead received {half:g}. Leave it out for {default:g}."
        )
    return half
