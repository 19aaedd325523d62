"""How far the magnet reaches, and where the field is cut off."""

from __future__ import annotations

from halbach_fe.core.errors import StudyError
from halbach_fe.geometry.magnet import array_half_length, array_outer_radius, iron_half_length
from halbach_fe.study.model import Study

BOUNDARY_RATIO = {"cross_section": 30.0, "extruded": 10.0, "meridian": 20.0}
"""Boundary over magnet radius, by kind of mesh. A block's far field falls as 1/r^2 in 2D and 1/r^3
in 3D, and so does what the boundary changes: 1e-3 of it. Elements grow towards the boundary; in
the half-plane, where they are cheapest, it is farther."""


def magnet_radius(study: Study) -> float:
    """Radius in m of everything that is not air."""
    radius = array_outer_radius(study)
    if study.iron_ring is None:
        return radius
    if study.iron_ring.inner_radius_m < radius * (1 - 1e-9):
        raise StudyError(
            f"Input `iron_ring.inner_radius_m` of study must be at least {radius:.6g}, where the "
            f"blocks end; instead received {study.iron_ring.inner_radius_m:g}. Enlarge the ring."
        )
    return study.iron_ring.outer_radius_m


def magnet_half_length(study: Study) -> float:
    """Half the length in m of everything that is not air."""
    return max(array_half_length(study), iron_half_length(study))


def boundary_radius(study: Study, mesh: str) -> float:
    """Radius in m where a kind of mesh (a key of BOUNDARY_RATIO) ends."""
    inside = magnet_radius(study)
    default = BOUNDARY_RATIO[mesh] * inside
    radius = study.open_boundary.radius_m or default
    if radius <= 1.2 * inside:
        raise StudyError(
            f"Input `open_boundary.radius_m` of study must be well beyond the magnet "
            f"({inside:g} m); instead received {radius:g}. Leave it out for {default:g}."
        )
    return radius


def boundary_half_length(study: Study, mesh: str) -> float:
    """Half the length in m of a kind of mesh."""
    end, radius = magnet_half_length(study), magnet_radius(study)
    default = end + BOUNDARY_RATIO[mesh] * radius
    half = study.open_boundary.half_length_m or default
    if half <= end + 0.2 * radius:
        raise StudyError(
            f"Input `open_boundary.half_length_m` of study must be well beyond the magnet's end "
            f"({end:g} m); instead received {half:g}. Leave it out for {default:g}."
        )
    return half
